"""How the estimator ``likelihood`` finds the motion of maximum likelihood, for unknown scatterers.

:mod:`mitsonar.estimation.channel.covariance` gives the covariance of the responses. Motions are first searched coarsely
(:class:`Search`), then refined by scoring. With the covariance R, its derivative D and responses z of level s:

    gradient = z* R^-1 D R^-1 z / s - tr R^-1 D,    information = tr R^-1 D R^-1 D.

For many pings the likelihood of each is conditioned on the few before it. Pairs of pings may fit several motions equally:
across the axis of a beam only the loss of coherence is observable, not its side. The estimate is then the mean of the
motions, weighted by their probability, with a covariance that spans them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator, RectBivariateSpline
from scipy.ndimage import maximum_filter
from threadpoolctl import threadpool_limits

from mitsonar.estimation.channel.correlation import Band, assumed_height, bands_of, pings_of, reach_of
from mitsonar.estimation.channel.covariance import ResponseCovariance, block_toeplitz
from mitsonar.estimation.estimator import Estimate, PlainTable, rejected
from mitsonar.instruments.hydrophones import ChannelSonar, Hydrophone
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.responses import ImpulseResponses

__all__ = [
    "Likelihood",
    "MotionScore",
    "ReceiverBand",
    "Search",
    "judged",
    "receiver_bands_of",
    "response_covariance_of",
    "single_receiver",
]


Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

CONDITIONING_PINGS = 3
"""Number of pings on which the next one is conditioned."""

MAX_STEPS = 8
"""Largest number of scoring steps; the iteration ends when a step is below a fifth of a standard deviation."""

MAX_DECREASE = 0.05
"""Largest decrease of the log likelihood in a step."""

LONGEST_STEP = 3e-3
"""Longest step [m, rad]."""

MODE_SEPARATION = 5.0
"""Distance of two modes [standard deviations]; nearer ones count as one mode."""

NEAR_WAVELENGTHS = 0.1
"""Distance [wavelengths] within which a start leads to a known mode."""

INITIAL_TURNS_RAD = (-0.006, -0.003, 0.003, 0.006)
"""Initial turns over all pings [rad]."""

MOST_WAVES = 25.0
"""Longest motion between pings that is searched, in both directions [wavelengths]."""

SAMPLED_MOTIONS = 33
"""Number of motions across an axis for which the likelihood is computed."""

AMBIGUOUS_SHARE = 0.01
"""Probability from which a mode counts as ambiguous."""

LARGEST_STD_WAVELENGTHS = 0.15
"""Largest standard deviation of a valid motion [wavelengths]."""

MAX_DEFICIT = 25.0
"""Largest deficit of the log likelihood of a start relative to the best."""

LEAST_GAIN = 12.0
"""Smallest excess of the log likelihood over that of unrelated pings."""


class Mode(NamedTuple):
    """A local maximum of the likelihood over motions from ping to ping.

    Attributes:
        motion: sideways, forward [m], yaw [rad], rise [m].
        covariance: of its free parameters ``(k, k)``.
        likelihood: its log likelihood.
        noise: noise of the receivers, as fractions of their power.
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
        height_m: height of the transmitter over the ground; default: that of the responses.
        yaw: whether the vehicle may turn; otherwise its heading is constant.
        heave: whether it may rise or sink between pings.
        speed: highest speed along an axis that is searched [m/s].
        turn_rate: highest valid turn rate [rad/s].
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

        Linear algebra uses one thread: its matrices have some 90 rows, for which threads would wait for each other much
        longer than they compute.

        Raises:
            MitsonarError: invalid records, see :func:`mitsonar.estimation.channel.correlation.pings_of`, or no height.
        """
        with threadpool_limits(1, "blas"):
            return self._estimate(responses)

    def _estimate(self, responses: ImpulseResponses) -> Estimate:
        pings = pings_of(responses)
        height = assumed_height(responses, "likelihood", self.height_m)
        received = [k for k, one in enumerate(responses.sonar.receivers) if one.name not in pings.silent]
        if not received:
            return rejected("no receiver has any echo")
        reach = reach_of(pings.interval_s, self.speed, responses.sonar.wavelength_m, MOST_WAVES)
        bands = bands_of(responses.sonar)
        receiver_bands, data = [], []
        for band in bands:
            part = band.part_of(pings.response)
            for receiver_band in receiver_bands_of(band.sonar, height, pings.interval_s, 1.1 * reach):
                if receiver_band.number in received:
                    receiver_bands.append(receiver_band)
                    data.append(part[:, receiver_band.number, receiver_band.law.taps])
        search = Search.from_response(bands, pings.response, height, pings.interval_s, reach, received)
        modes = self._modes(receiver_bands, data, search)
        unrelated = sum(
            judged(receiver_band, z, np.zeros(4), (), 0).likelihood
            for receiver_band, z in zip(receiver_bands, data, strict=True)
        )
        return self._combined(modes, unrelated, responses, pings.silent)

    @property
    def free(self) -> tuple[int, ...]:
        """Return which of the four parameters of a motion are estimated."""
        return (0, 1, *((2,) if self.yaw else ()), *((3,) if self.heave else ()))

    def _modes(self, receiver_bands: list[ReceiverBand], data: list[Complex], search: Search) -> list[Mode]:
        """Return the modes, the most probable first."""
        near_m = NEAR_WAVELENGTHS * receiver_bands[0].law.sonar.wavelength_m
        # 1. refine the best motion of the search, then others along its less certain axis
        modes = [refined(receiver_bands, data, np.array([*search.peaks()[0], 0.0, 0.0]), self.free, 1)]
        for number, start in enumerate(across_from(receiver_bands, data, search, modes[0])[: self.modes + 1]):
            if number == 0 or all(np.abs(start - one.motion[:2]).max() > near_m for one in modes):
                mode = refined(receiver_bands, data, np.array([*start, 0.0, 0.0]), self.free, 1)
                if all(_distance(mode, known) > MODE_SEPARATION for known in modes):
                    modes.append(mode)
        # 2. add turns; their sign is hardly observable
        if self.yaw:
            modes = self._with_turns(receiver_bands, data, modes)
        # 3. refine the probable modes again, conditioned on more pings
        depth = min(CONDITIONING_PINGS, len(data[0]) - 1)
        if depth > 1:
            best = max(one.mass for one in modes)
            modes = [refined(receiver_bands, data, one.motion, self.free, depth) for one in modes if one.mass > best - 20]
        return sorted(modes, key=lambda one: -one.mass)

    def _with_turns(self, receiver_bands: list[ReceiverBand], data: list[Complex], modes: list[Mode]) -> list[Mode]:
        """Add modes from initial turns to both sides, since the loss of coherence hardly shows the sign of a turn."""
        extended = list(modes)
        for mode in modes:
            for yaw in INITIAL_TURNS_RAD:
                turned = refined(
                    receiver_bands, data, np.array([*mode.motion[:2], yaw / max(1, len(data[0]) - 1), 0.0]), self.free, 1
                )
                if turned.likelihood > modes[0].likelihood - 20 and all(_is_distinct(turned, one) for one in extended):
                    extended.append(turned)
        return extended

    def _combined(
        self, modes: list[Mode], unrelated: float, responses: ImpulseResponses, silent: tuple[str, ...]
    ) -> Estimate:
        """Combine several modes into one estimate."""
        intervals, wavelength_m = len(responses) - 1, responses.sonar.wavelength_m
        # mean and covariance of the mixture of modes
        mass = np.array([one.mass for one in modes])
        share = np.exp(mass - mass.max())
        share /= share.sum()
        free = list(self.free)
        motions = np.array([one.motion for one in modes])
        mean = share @ motions
        spread = np.zeros((4, 4))
        for part, one in zip(share, modes, strict=True):
            spread[np.ix_(free, free)] += part * one.covariance
            spread += part * np.outer(one.motion - mean, one.motion - mean)
        # a motion must explain more than unrelated pings do
        gain = modes[0].likelihood - unrelated
        listed = list(zip(share, modes, strict=True)) if gain >= LEAST_GAIN else []
        about: PlainTable = {
            "modes": [(float(part), *(float(v) for v in _over_intervals(one.motion, intervals))) for part, one in listed],
            "spreads": [_covariance_of(one, free, intervals) for _, one in listed],
            "noise": [float(v) for v in modes[0].noise],
            "gain": gain,
            "silent": silent,
        }
        # reject unrelated pings, fast turns and ambiguous motions
        reason = ""
        if gain < LEAST_GAIN:
            reason = "the pings have nothing in common"
        covariance = intervals**2 * spread[:3, :3]
        ambiguous = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:2, :2])[-1], 0.0)))
        turn, span = float(intervals * mean[2]), float(responses.time_s[-1] - responses.time_s[0])
        if not reason and abs(turn) > self.turn_rate * span:
            reason = f"turns by {np.degrees(turn):.2g} deg, faster than {np.degrees(self.turn_rate):.3g} deg/s"
        if not reason and ambiguous > LARGEST_STD_WAVELENGTHS * wavelength_m:
            count = int((share > AMBIGUOUS_SHARE).sum())
            reason = f"{f'{count} motions fit equally well: ' if count > 1 else ''}known to {1e3 * ambiguous:.0f} mm only"
        return Estimate(_over_intervals(mean, intervals), covariance, not reason, reason, about)


def _covariance_of(mode: Mode, free: list[int], intervals: int) -> list[list[float]]:
    """Return the covariance of sideways, forward [m], yaw [rad] of a mode over all intervals."""
    spread = np.zeros((4, 4))
    spread[np.ix_(free, free)] = mode.covariance
    return [[float(value) for value in row] for row in intervals**2 * spread[:3, :3]]


def across_from(receiver_bands: list[ReceiverBand], data: list[Complex], search: Search, mode: Mode) -> Array:
    """Return motions ``(n, 2)`` that differ from a mode along its less certain axis and may fit as well.

    The first is the mirrored motion, followed by the most likely ones. Receivers along that axis have many maxima, which the
    search has scored. For the other receivers a motion appears as a loss of coherence, so their likelihood is computed for a
    few motions.
    """
    # likelihood along the less certain axis, summed over the receivers
    axis = int(np.diag(mode.covariance)[:2].argmax())
    total = np.zeros(len(search.line))
    sampled = np.linspace(search.line[0], search.line[-1], SAMPLED_MOTIONS)
    for number, (receiver_band, z) in enumerate(zip(receiver_bands, data, strict=True)):
        if abs(receiver_band.turn[1, axis]) > 0.5:
            total += search.along(number, mode.motion, axis)
        else:
            values = np.array(
                [judged(receiver_band, z, _with_component(mode.motion, axis, place), (), 1).likelihood for place in sampled]
            )
            total += PchipInterpolator(sampled, values)(search.line)
    # its maxima that are not hopeless, best first
    peaks = np.flatnonzero(total == maximum_filter(total, size=5))
    peaks = peaks[(total > total.max() - MAX_DEFICIT)[peaks]]
    peaks = peaks[np.argsort(-total[peaks])]
    places = [-mode.motion[axis], *search.line[peaks]]
    return np.array([_with_component(mode.motion, axis, float(place))[:2] for place in places])


def _with_component(motion: Array, axis: int, value: float) -> Array:
    """Return a motion with another value along an axis."""
    moved = motion.copy()
    moved[axis] = value
    return moved


def _distance(one: Mode, other: Mode) -> float:
    """Return the distance of two modes in standard deviations of the less certain one."""
    difference = (one.motion - other.motion)[:2]
    return float(np.sqrt(min(difference @ np.linalg.solve(mode.covariance[:2, :2], difference) for mode in (one, other))))


def _is_distinct(one: Mode, other: Mode) -> bool:
    """Return whether two modes differ by more than a few standard deviations in position or turn."""
    difference = (one.motion - other.motion)[:3]
    spread = np.sqrt(np.maximum(np.diag(one.covariance)[:3], np.diag(other.covariance)[:3]))
    return bool((np.abs(difference) > MODE_SEPARATION * np.maximum(spread, 1e-6)).any())


def _over_intervals(motion: Array, intervals: int) -> Motion:
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

    def scores_at(at_motion: Array) -> list[MotionScore]:
        return [
            judged(receiver_band, z, at_motion, free, depth) for receiver_band, z in zip(receiver_bands, data, strict=True)
        ]

    scores = scores_at(motion)
    for _ in range(MAX_STEPS):
        # scoring step from all receivers, limited in length
        total = sum(one.likelihood for one in scores)
        information = sum((one.information for one in scores), np.zeros((len(free),) * 2))
        step = np.linalg.lstsq(information, sum((one.gradient for one in scores), np.zeros(len(free))), rcond=None)[0]
        step *= min(1.0, LONGEST_STEP / float(np.abs(step).max() + 1e-12))
        # halve the step until the log likelihood decreases by less than MAX_DECREASE
        for _ in range(4):
            trial = motion.copy()
            trial[columns] += step
            trial_scores = scores_at(trial)
            if sum(one.likelihood for one in trial_scores) > total - MAX_DECREASE:
                motion, scores = trial, trial_scores
                break
            step /= 2
        else:
            break
        if step @ information @ step < 0.2**2 * len(free):
            break
    information = sum((one.information for one in scores), np.zeros((len(free),) * 2))
    covariance = np.linalg.pinv(information, hermitian=True)
    return Mode(
        motion,
        np.asarray(covariance, dtype=float),
        sum(one.likelihood for one in scores),
        np.array([one.noise for one in scores]),
    )


# ---------------- Likelihood of one motion by one receiver


NOISE_CANDIDATES = np.logspace(-6, 1.5, 46)
"""Candidate variances of noise, as fractions of the mean power; the error of the covariance integral lies below them."""


class MotionScore(NamedTuple):
    """The log likelihood of a motion by one receiver.

    Attributes:
        likelihood: log likelihood.
        gradient: by the free parameters of the motion ``(k,)``.
        information: Fisher information of the free parameters ``(k, k)``.
        noise: variance of the noise, as a fraction of the mean power.
    """

    likelihood: float
    gradient: Array
    information: Array
    noise: float


def judged(receiver_band: ReceiverBand, response: Complex, motion: Array, free: Sequence[int], depth: int) -> MotionScore:
    """Score a motion from ping to ping by the pings of one receiver ``(pings, taps)``.

    Each ping is conditioned on the ``depth`` pings before it. Level and variance of noise take their most likely values.
    """
    # 1. covariances by lag, and their derivatives, in the axes of the receiver
    receiver_motion, turn = receiver_band.turn @ motion, receiver_band.turn[np.ix_(free, free)]
    blocks = [receiver_band.law.slopes(receiver_motion, lag, free if lag else ()) for lag in range(depth + 1)]
    taps = blocks[0].shape[1]
    power = float(np.diag(blocks[0][0]).real.mean())
    # 2. conditioning: likelihood of the long runs minus that of the runs that are conditioned on
    runs = [
        _PingRuns.from_response(response, [block[0] for block in blocks[:pings]], sign)
        for pings, sign in ((depth + 1, 1), (depth, -1))
    ]
    parts = [part for part in runs if part is not None]
    # 3. most likely level for each candidate variance of noise, then the most likely variance
    noise = NOISE_CANDIDATES * power
    energy = sum(part.sign * (part.power[:, None] / (part.size[:, None] + noise)).sum(axis=0) for part in parts)
    positive = energy > 0  # the conditional energy may vanish where a motion does not fit at all
    level = np.where(positive, energy, 1.0) / response.size
    log = sum(part.sign * part.count * np.log(part.size[:, None] + noise).sum(axis=0) for part in parts)
    likelihood = np.where(positive, -response.size * np.log(level) - log, -np.inf)
    best = int(likelihood.argmax())
    # 4. gradient and information at these values
    gradient, information = np.zeros(len(free)), np.zeros((len(free),) * 2)
    for part in parts if free and positive[best] else []:
        slopes = [
            block_toeplitz([np.zeros((taps, taps), dtype=complex), *(block[1 + k] for block in blocks[1 : part.pings])])
            for k in range(len(free))
        ]
        one, two = part.score(slopes, noise[best], float(level[best]))
        gradient, information = gradient + part.sign * one, information + part.sign * two
    return MotionScore(
        float(likelihood[best]), turn.T @ gradient, turn.T @ information @ turn, float(NOISE_CANDIDATES[best])
    )


@dataclass(frozen=True)
class _PingRuns:
    """Runs of consecutive pings, with the eigenvectors of their covariance.

    Attributes:
        sign: 1, or -1 for the pings that are conditioned on.
        pings: number of pings in a run.
        size: eigenvalues ``(n,)``.
        vectors: eigenvectors ``(n, n)``.
        coefficients: the runs as coefficients of the eigenvectors ``(n, runs)``.
    """

    sign: int
    pings: int
    size: Array
    vectors: Complex
    coefficients: Complex

    @classmethod
    def from_response(cls, response: Complex, blocks: list[Complex], sign: int) -> _PingRuns | None:
        """Collect all runs with one ping per block; runs that are conditioned on begin with the second ping."""
        first = 0 if sign > 0 else 1
        last = len(response) - len(blocks) + (0 if sign > 0 else -1)
        if not blocks or last < first:
            return None
        runs = np.array([response[k : k + len(blocks)].ravel() for k in range(first, last + 1)]).T
        size, vectors = np.linalg.eigh(block_toeplitz(blocks))
        return cls(sign, len(blocks), np.maximum(size, 0.0), vectors, vectors.conj().T @ runs)

    @property
    def count(self) -> int:
        """Return the number of runs."""
        return int(self.coefficients.shape[1])

    @property
    def power(self) -> Array:
        """Return the power along each eigenvector, summed over all runs."""
        return np.asarray((np.abs(self.coefficients) ** 2).sum(axis=1))

    def score(self, slopes: list[Complex], noise: float, level: float) -> tuple[Array, Array]:
        """Return gradient ``(k,)`` and information ``(k, k)``."""
        solved = self.vectors @ (self.coefficients / (self.size + noise)[:, None])
        inverse = (self.vectors / (self.size + noise)) @ self.vectors.conj().T
        turned = [inverse @ slope for slope in slopes]
        gradient = [
            np.vdot(solved, slope @ solved).real / level - self.count * np.trace(one).real
            for slope, one in zip(slopes, turned, strict=True)
        ]
        information = [[self.count * float(np.sum(one * two.T).real) for two in turned] for one in turned]
        return np.array(gradient), np.array(information)


# ---------------- Coarse search over all motions

WHITENING_FLOOR = 1e-2
"""Fraction of the mean power below which a direction of responses is not used."""

MOTIONS_ALONG, MOTIONS_ACROSS = 7.5, 1.9
"""Motions of the grid per wavelength, along the axis of a receiver and across."""

CELLS_PER_WAVELENGTH = 15.0
"""Cells per wavelength of the map in which the scores of all receivers are added."""

MAX_PEAKS = 40
"""Number of maxima of the map that are used."""


class ReceiverBand(NamedTuple):
    """A receiver turned to face forward, so that receivers of one kind share computations.

    Attributes:
        law: covariance of its responses.
        turn: matrix from motions of the vehicle to motions in the receiver's axes ``(4, 4)``.
        number: its index among the receivers of the sonar.
    """

    law: ResponseCovariance
    turn: Array
    number: int


def single_receiver(sonar: ChannelSonar, receiver: Hydrophone) -> ChannelSonar:
    """Return the instrument with this receiver only, turned so that it faces forward."""
    heading = math.radians(receiver.field.heading_deg)
    x, y, z = receiver.position
    cos, sin = math.cos(heading), math.sin(heading)
    position = (round(x * cos - y * sin, 9) + 0.0, round(x * sin + y * cos, 9) + 0.0, z)
    field = receiver.field.model_copy(update={"heading_deg": 0.0})
    sender = sonar.transmitter
    if sender.shape != "all":
        sender = sender.model_copy(update={"heading_deg": sender.heading_deg - receiver.field.heading_deg})
    one = Hydrophone(name="forward", position=position, field=field)
    return sonar.model_copy(update={"receivers": (one,), "transmitter": sender, "name": "one", "seed": 0})


@lru_cache(maxsize=32)
def response_covariance_of(single: ChannelSonar, height_m: float, interval_s: float, reach_m: float) -> ResponseCovariance:
    """Return the response covariance of an instrument of one receiver, cached."""
    return ResponseCovariance(single, single.receivers[0], height_m, interval_s, reach_m)


def receiver_bands_of(sonar: ChannelSonar, height_m: float, interval_s: float, reach_m: float) -> list[ReceiverBand]:
    """Return all receivers of an instrument, each turned forward."""
    receiver_bands = []
    for number, receiver in enumerate(sonar.receivers):
        heading = math.radians(receiver.field.heading_deg)
        cos, sin = math.cos(heading), math.sin(heading)
        turn = np.eye(4)
        turn[:2, :2] = [[cos, -sin], [sin, cos]]
        receiver_bands.append(
            ReceiverBand(
                response_covariance_of(single_receiver(sonar, receiver), height_m, interval_s, reach_m), turn, number
            )
        )
    return receiver_bands


@dataclass(frozen=True)
class CovarianceTable:
    """Cross-covariances of two pings for motions on a grid along the axis of a receiver and across, computed once.

    Responses are first whitened in the strong directions of a single ping. In these a hypothesis is a matrix C of the
    cross-covariance, and its score for responses b_1, b_2 is 2 Re b_1* C b_2 - |C|^2: least squares of their products.

    Attributes:
        along: motions along the axis of the receiver ``(a,)`` [m].
        across: motions across the axis ``(b,)`` [m].
        basis: matrix from taps to directions of equal strength ``(directions, taps)``.
        shared: C of each motion ``(a, b, directions, directions)`` complex64.
    """

    along: Array
    across: Array
    basis: Complex
    shared: NDArray[np.complex64]

    @classmethod
    def from_covariance(cls, law: ResponseCovariance) -> Self:
        """Compute the table for all motions within the reach of the covariance."""
        # whiten the strong directions of a single ping
        single = law.covariance((0, 0, 0), 0)
        power = float(np.diag(single).real.mean())
        size, vectors = np.linalg.eigh(single + WHITENING_FLOOR * power * np.eye(len(single)))
        strong = size > 2 * WHITENING_FLOOR * power
        basis = (vectors[:, strong] / np.sqrt(size[strong])).conj().T
        along, across = (_grid(law.reach_m, law.sonar.wavelength_m / parts) for parts in (MOTIONS_ALONG, MOTIONS_ACROSS))
        # a receiver in the plane of its axis has equal covariances for motions to port and to starboard
        symmetric = law.receiver.position[0] == 0 and law.sonar.transmitter.shape == "all"
        shared = np.empty((len(along), len(across), len(basis), len(basis)), dtype=np.complex64)
        for i, j in np.ndindex(len(along), len(across)):
            if symmetric and across[j] > 0:
                shared[i, j] = shared[i, len(across) - 1 - j]
            else:
                shared[i, j] = basis @ law.covariance(np.array([across[j], along[i], 0.0])) @ basis.conj().T
        return cls(along, across, basis, shared)

    def score(self, response: Complex) -> Array:
        """Score each motion of the grid ``(a, b)`` by pings ``(pings, taps)``."""
        b = response @ self.basis.T
        size = float(np.mean(np.abs(b) ** 2))
        product = (b[:-1].T @ b[1:].conj()) / (size or 1.0)
        matched = 2 * np.tensordot(self.shared, product.conj().astype(np.complex64), 2).real
        return np.asarray(matched - (len(b) - 1) * (np.abs(self.shared) ** 2).sum(axis=(2, 3)), dtype=float)


def _grid(reach: float, step: float) -> Array:
    count = max(math.ceil(reach / step), 4)
    return np.linspace(-1, 1, 2 * count + 1) * reach


@lru_cache(maxsize=32)
def _table_of(single: ChannelSonar, height_m: float, interval_s: float, reach_m: float) -> CovarianceTable:
    return CovarianceTable.from_covariance(response_covariance_of(single, height_m, interval_s, reach_m))


@dataclass(frozen=True)
class Search:
    """The scores of all receivers for all motions that a vehicle can make.

    Attributes:
        line: motions along either axis, from ping to ping ``(n,)`` [m].
        scores: of each receiver in each band for sideways and forward motions ``(bands x receivers, n, n)``.
    """

    line: Array
    scores: Array

    @classmethod
    def from_response(
        cls, bands: list[Band], response: Complex, height_m: float, interval_s: float, reach_m: float, received: list[int]
    ) -> Self:
        """Score pings ``(pings, receivers, taps)`` by the receivers ``received``, for motions up to ``reach_m`` [m]."""
        line = _grid(reach_m, min(band.sonar.wavelength_m for band in bands) / CELLS_PER_WAVELENGTH)
        plane, scores = np.stack(np.meshgrid(line, line, indexing="ij")), []
        for band in bands:
            part = band.part_of(response)
            for receiver_band in receiver_bands_of(band.sonar, height_m, interval_s, 1.5 * reach_m):
                if receiver_band.number in received:
                    table = _table_of(receiver_band.law.sonar, height_m, interval_s, 1.5 * reach_m)
                    across, along = np.tensordot(receiver_band.turn[:2, :2], plane, 1)
                    score = RectBivariateSpline(
                        table.along, table.across, table.score(part[:, receiver_band.number, receiver_band.law.taps])
                    )
                    scores.append(score.ev(along.ravel(), across.ravel()).reshape(along.shape))
        return cls(line, np.array(scores))

    def peaks(self) -> Array:
        """Return the motions ``(n, 2)`` [m] of the largest scores, best first."""
        total = self.scores.sum(axis=0)
        peaks = np.argwhere(total == maximum_filter(total, size=5))
        return np.asarray(self.line[peaks[np.argsort(-total[tuple(peaks.T)])][:MAX_PEAKS]])

    def along(self, receiver: int, motion: Array, axis: int) -> Array:
        """Return the scores of one receiver on the line through a motion along an axis ``(n,)``."""
        index = int(np.abs(self.line - motion[1 - axis]).argmin())
        return self.scores[receiver, :, index] if axis == 0 else self.scores[receiver, index]
