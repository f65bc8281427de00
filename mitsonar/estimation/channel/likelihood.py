"""The estimator ``likelihood``: the motion of maximum likelihood, for unknown scatterers.

:mod:`mitsonar.estimation.channel.response_covariance` gives the covariance of the responses. Motions are first searched
coarsely (:mod:`mitsonar.estimation.channel.motion_search`), then refined by scoring. With the covariance R, its derivative D
and responses z of level s:

    gradient = z* R^-1 D R^-1 z / s - tr R^-1 D,    information = tr R^-1 D R^-1 D.

Of many pings the likelihood of each is conditioned on the few before it. Pairs of pings may fit several motions equally:
across the axis of a beam only the loss of coherence shows, and not its side. The estimate is then the mean of the motions,
weighted by their probability, with a covariance that spans them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import maximum_filter
from threadpoolctl import threadpool_limits

from mitsonar.estimation.channel.motion_score import MotionScore, judged
from mitsonar.estimation.channel.motion_search import ReceiverBand, Search, receiver_bands_of
from mitsonar.estimation.channel.pings import assumed_height, pings_of, reach_of
from mitsonar.estimation.channel.sub_bands import bands_of
from mitsonar.estimation.estimator import Estimate, PlainTable, rejected
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.responses import ImpulseResponses

__all__ = ["Likelihood"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

SURE_PINGS = 3
"""Number of pings on which the next one is conditioned."""

STEPS = 8
"""Most steps of scoring; it ends when a step is below a fifth of a standard deviation."""

LEVEL = 0.05
"""Largest decrease of the log likelihood in a step."""

LONGEST = 3e-3
"""Longest step [m, rad]."""

APART = 5.0
"""Distance of two modes [standard deviations]; nearer ones are one mode."""

NEAR = 0.1
"""Distance [wavelengths] within which a start leads to a known mode."""

TURNS = (-0.006, -0.003, 0.003, 0.006)
"""Initial turns over all pings [rad]."""

MOST_WAVES = 25.0
"""Longest motion between pings that is searched, in both directions [wavelengths]."""

PLACES = 33
"""Number of motions across an axis for which the likelihood is computed."""

ALIKE = 0.01
"""Probability from which a mode counts as ambiguous."""

UNSURE = 0.15
"""Largest standard deviation of a valid motion [wavelengths]."""

HOPELESS = 25.0
"""Largest deficit of the log likelihood of a start against the best."""

LEAST_GAIN = 12.0
"""Least excess of the log likelihood over that of unrelated pings."""


class Mode(NamedTuple):
    """A motion from ping to ping that fits better than those around it.

    Attributes:
        motion: sideways, forward [m], yaw [rad], rise [m].
        covariance: of its free parameters ``(k, k)``.
        likelihood: its log likelihood.
        noise: of the receivers, as parts of their power.
    """

    motion: Array
    covariance: Array
    likelihood: float
    noise: Array

    @property
    def mass(self) -> float:
        """Return the logarithm of its probability, up to a constant."""
        return self.likelihood + float(np.linalg.slogdet(self.covariance)[1]) / 2


@dataclass(frozen=True)
class Likelihood:
    """Estimates the motion of maximum likelihood.

    Args:
        height_m: of the transmitter over the ground; default: that of the responses.
        yaw: whether the vehicle may turn; otherwise its heading is constant.
        heave: whether it may rise or sink between pings.
        speed: the fastest that is searched along an axis [m/s].
        turn_rate: the fastest valid turn [rad/s].
        modes: number of motions of the search that are compared in full.
    """

    height_m: float | None = None
    yaw: bool = False
    heave: bool = False
    speed: float = 2.1
    turn_rate: float = 0.4
    modes: int = 5

    consumes = ImpulseResponses
    inputs = "height"
    digest = ""

    def estimate(self, responses: ImpulseResponses, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion and its covariance; a prior is ignored: the search covers all motions up to ``speed``.

        Linear algebra uses one thread: its matrices have some 90 rows, for which threads wait for each other much longer
        than they compute.

        Raises:
            MitsonarError: records of :func:`mitsonar.estimation.channel.pings.pings_of`, or no height.
        """
        with threadpool_limits(1, "blas"):
            return self._estimate(responses)

    def _estimate(self, responses: ImpulseResponses) -> Estimate:
        pings = pings_of(responses)
        height = assumed_height(responses, "likelihood", self.height_m)
        received = [k for k, one in enumerate(responses.sonar.receivers) if one.name not in pings.silent]
        if not received:
            return rejected("no receiver heard anything")
        reach = reach_of(pings.interval_s, self.speed, responses.sonar.wavelength_m, MOST_WAVES)
        bands = bands_of(responses.sonar)
        receiver_bands, data = [], []
        for band in bands:
            part = band.of(pings.response)
            for receiver_band in receiver_bands_of(band.sonar, height, pings.interval_s, 1.1 * reach):
                if receiver_band.number in received:
                    receiver_bands.append(receiver_band)
                    data.append(part[:, receiver_band.number, receiver_band.law.taps])
        search = Search.of(bands, pings.response, height, pings.interval_s, reach, received)
        found = self._modes(receiver_bands, data, search)
        alone = sum(
            judged(receiver_band, z, np.zeros(4), (), 0).likelihood
            for receiver_band, z in zip(receiver_bands, data, strict=True)
        )
        return self._answer(found, alone, responses, pings.silent)

    @property
    def free(self) -> tuple[int, ...]:
        """Return which of the four parameters of a motion are estimated."""
        return (0, 1, *((2,) if self.yaw else ()), *((3,) if self.heave else ()))

    def _modes(self, receiver_bands: list[ReceiverBand], data: list[Complex], search: Search) -> list[Mode]:
        """Return the modes, the most probable first."""
        near = NEAR * receiver_bands[0].law.sonar.wavelength_m
        found = [refined(receiver_bands, data, np.array([*search.peaks()[0], 0.0, 0.0]), self.free, 1)]
        for number, start in enumerate(across_from(receiver_bands, data, search, found[0])[: self.modes + 1]):
            if number == 0 or all(np.abs(start - one.motion[:2]).max() > near for one in found):
                mode = refined(receiver_bands, data, np.array([*start, 0.0, 0.0]), self.free, 1)
                if all(_apart(mode, other) > APART for other in found):
                    found.append(mode)
        if self.yaw:
            found = self._turned(receiver_bands, data, found)
        depth = min(SURE_PINGS, len(data[0]) - 1)
        if depth > 1:
            best = max(one.mass for one in found)
            found = [refined(receiver_bands, data, one.motion, self.free, depth) for one in found if one.mass > best - 20]
        return sorted(found, key=lambda one: -one.mass)

    def _turned(self, receiver_bands: list[ReceiverBand], data: list[Complex], found: list[Mode]) -> list[Mode]:
        """Add modes from initial turns to both sides: the loss of coherence hardly shows the sign of a turn."""
        all_ = list(found)
        for mode in found:
            for yaw in TURNS:
                other = refined(
                    receiver_bands, data, np.array([*mode.motion[:2], yaw / max(1, len(data[0]) - 1), 0.0]), self.free, 1
                )
                if other.likelihood > found[0].likelihood - 20 and all(_far(other, one) for one in all_):
                    all_.append(other)
        return all_

    def _answer(self, found: list[Mode], alone: float, responses: ImpulseResponses, silent: tuple[str, ...]) -> Estimate:
        """Return one estimate from several modes."""
        intervals, wavelength_m = len(responses) - 1, responses.sonar.wavelength_m
        mass = np.array([one.mass for one in found])
        share = np.exp(mass - mass.max())
        share /= share.sum()
        free = list(self.free)
        places = np.array([one.motion for one in found])
        mean = share @ places
        spread = np.zeros((4, 4))
        for part, one in zip(share, found, strict=True):
            spread[np.ix_(free, free)] += part * one.covariance
            spread += part * np.outer(one.motion - mean, one.motion - mean)
        gain = found[0].likelihood - alone
        listed = list(zip(share, found, strict=True)) if gain >= LEAST_GAIN else []
        about: PlainTable = {
            "modes": [(float(part), *(float(v) for v in _whole(one.motion, intervals))) for part, one in listed],
            "spreads": [_spread_of(one, free, intervals) for _, one in listed],
            "noise": [float(v) for v in found[0].noise],
            "gain": gain,
            "silent": silent,
        }
        reason = ""
        if gain < LEAST_GAIN:
            reason = "the pings have nothing in common"
        covariance = intervals**2 * spread[:3, :3]
        ambiguous = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:2, :2])[-1], 0.0)))
        turn, span = float(intervals * mean[2]), float(responses.time_s[-1] - responses.time_s[0])
        if not reason and abs(turn) > self.turn_rate * span:
            reason = f"turns by {np.degrees(turn):.2g} deg, faster than {np.degrees(self.turn_rate):.3g} deg/s"
        if not reason and ambiguous > UNSURE * wavelength_m:
            alike = int((share > ALIKE).sum())
            reason = f"{f'{alike} motions fit alike: ' if alike > 1 else ''}known to {1e3 * ambiguous:.0f} mm only"
        return Estimate(_whole(mean, intervals), covariance, not reason, reason, about)


def _spread_of(mode: Mode, free: list[int], intervals: int) -> list[list[float]]:
    """Return the covariance of sideways, forward [m], yaw [rad] of a mode over all intervals."""
    spread = np.zeros((4, 4))
    spread[np.ix_(free, free)] = mode.covariance
    return [[float(value) for value in row] for row in intervals**2 * spread[:3, :3]]


def across_from(receiver_bands: list[ReceiverBand], data: list[Complex], search: Search, mode: Mode) -> Array:
    """Return motions ``(n, 2)`` that differ from a mode along its less certain axis and may fit as well.

    The first is the mirrored motion, then come the most likely ones. Receivers along that axis have many maxima, which the
    search has scored. For the others a motion is a loss of coherence: their likelihood is computed for a few motions.
    """
    axis = int(np.diag(mode.covariance)[:2].argmax())
    total = np.zeros(len(search.line))
    few = np.linspace(search.line[0], search.line[-1], PLACES)
    for number, (receiver_band, z) in enumerate(zip(receiver_bands, data, strict=True)):
        if abs(receiver_band.turn[1, axis]) > 0.5:
            total += search.along(number, mode.motion, axis)
        else:
            values = np.array(
                [judged(receiver_band, z, _moved(mode.motion, axis, place), (), 1).likelihood for place in few]
            )
            total += PchipInterpolator(few, values)(search.line)
    peaks = np.flatnonzero(total == maximum_filter(total, size=5))
    peaks = peaks[(total > total.max() - HOPELESS)[peaks]]
    peaks = peaks[np.argsort(-total[peaks])]
    places = [-mode.motion[axis], *search.line[peaks]]
    return np.array([_moved(mode.motion, axis, float(place))[:2] for place in places])


def _moved(motion: Array, axis: int, place: float) -> Array:
    """Return a motion with another value along an axis."""
    there = motion.copy()
    there[axis] = place
    return there


def _apart(one: Mode, other: Mode) -> float:
    """Return the distance of two modes in standard deviations of the less certain one."""
    way = (one.motion - other.motion)[:2]
    return float(np.sqrt(min(way @ np.linalg.solve(mode.covariance[:2, :2], way) for mode in (one, other))))


def _far(one: Mode, other: Mode) -> bool:
    """Return whether two modes differ by more than a few standard deviations in position or turn."""
    way = (one.motion - other.motion)[:3]
    spread = np.sqrt(np.maximum(np.diag(one.covariance)[:3], np.diag(other.covariance)[:3]))
    return bool((np.abs(way) > APART * np.maximum(spread, 1e-6)).any())


def _whole(motion: Array, intervals: int) -> Motion:
    """Compose a constant motion over many intervals, along the last heading (Almanza-Medina, eq. 3.4)."""
    sideways, forward, yaw = motion[:3]
    turn = (intervals - 1) * yaw / 2
    cos, sin = np.cos(turn), np.sin(turn)
    return Motion(
        float(intervals * (sideways * cos - forward * sin)),
        float(intervals * (forward * cos + sideways * sin)),
        float(intervals * yaw),
    )


def refined(receiver_bands: list[ReceiverBand], data: list[Complex], motion: Array, free: Sequence[int], depth: int) -> Mode:
    """Refine a motion to the nearest maximum of the likelihood."""
    columns = list(free)

    def judge(where: Array) -> list[MotionScore]:
        return [judged(receiver_band, z, where, free, depth) for receiver_band, z in zip(receiver_bands, data, strict=True)]

    said = judge(motion)
    for _ in range(STEPS):
        total = sum(one.likelihood for one in said)
        information = sum((one.information for one in said), np.zeros((len(free),) * 2))
        step = np.linalg.lstsq(information, sum((one.gradient for one in said), np.zeros(len(free))), rcond=None)[0]
        step *= min(1.0, LONGEST / float(np.abs(step).max() + 1e-12))
        for _ in range(4):
            there = motion.copy()
            there[columns] += step
            new = judge(there)
            if sum(one.likelihood for one in new) > total - LEVEL:
                motion, said = there, new
                break
            step /= 2
        else:
            break
        if step @ information @ step < 0.2**2 * len(free):
            break
    information = sum((one.information for one in said), np.zeros((len(free),) * 2))
    covariance = np.linalg.pinv(information, hermitian=True)
    return Mode(
        motion,
        np.asarray(covariance, dtype=float),
        sum(one.likelihood for one in said),
        np.array([one.noise for one in said]),
    )
