"""How the estimator ``correlation`` finds a motion, as correlation velocity logs and displaced-phase-centre navigation do.

After a motion d of the vehicle towards level ground at incidence theta, its echo arrives earlier by 2 d sin(theta) / c. The
taps of a receiver rotate by 4 pi d sin(theta) / lambda from ping to ping; later taps rotate more.

The coarse step finds the motion whose phase-compensated products of taps have the largest sum over all receivers. The slope
of the phase over delay resolves whole turns. The fine step fits the residual phases in short windows along delay by weighted
least squares. Motions across the axis of a receiver are not modelled, though they reduce the correlation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from mitsonar.errors import MitsonarError, argument
from mitsonar.estimation.estimator import Estimate, rejected
from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.responses import ImpulseResponses

__all__ = ["BAND_HZ", "Band", "Correlation", "Pings", "assumed_height", "bands_of", "pings_of", "reach_of"]


Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

BEAM_ANGLES = 41
"""Number of angles across a beam over which directions are averaged."""

STEP = 1 / 16
"""Step of the motions that are searched [wavelengths]."""

WINDOW_TAPS = 8
"""Number of taps whose products are averaged."""

MOST_WAVES = 50.0
"""Longest motion between pings that is searched, in both directions [wavelengths]."""

LEAST_MAXIMUM = 4.0
"""Smallest valid maximum of the sum, in standard deviations of the sum of unrelated pings."""

AMBIGUOUS_RATIO = 0.9
"""Fraction of the largest sum from which a second maximum makes the motion ambiguous."""


class Products(NamedTuple):
    """Products of consecutive pings of one receiver.

    Attributes:
        product: product of each tap of a ping with the conjugate of that of the next, summed over all pairs ``(taps,)``.
        energy: energy of both pings ``(taps,)``.
        turn: phase by which taps rotate with a motion along the axis ``(taps,)`` [rad/m].
        axis: direction of the axis of the receiver: to starboard, forward ``(2,)``.
    """

    product: Complex
    energy: Array
    turn: Array
    axis: Array


@dataclass(frozen=True)
class Correlation:
    """Ping-to-ping correlation, coarse to fine, with two degrees of freedom; the heading is assumed constant.

    Args:
        height_m: height of the transmitter over the ground; default: that of the responses.
        speed: highest speed along an axis that is searched [m/s].
    """

    height_m: float | None = None
    speed: float = 2.1

    consumes = ImpulseResponses
    inputs = "height"
    digest = ""

    def estimate(self, responses: ImpulseResponses, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; a prior is ignored: the search covers all motions up to ``speed``.

        Raises:
            MitsonarError: invalid records, see :func:`mitsonar.estimation.channel.correlation.pings_of`, or no height.
        """
        pings = pings_of(responses)
        height = assumed_height(responses, "correlation", self.height_m)
        received = [_products(responses.sonar, z, number, height) for number, z in enumerate(pings.response.swapaxes(0, 1))]
        received = [one for one in received if one.energy.any()]
        if not received:
            return rejected("no receiver has any echo")
        if np.linalg.matrix_rank(np.array([one.axis for one in received]), tol=0.1) < 2:
            silent = f" (silent: {', '.join(pings.silent)})" if pings.silent else ""
            return rejected(f"the receivers with echoes look along one line{silent}: motions across it do not show")
        reach = reach_of(pings.interval_s, self.speed, responses.sonar.wavelength_m, MOST_WAVES)
        coarse, reason = _coarse(received, reach, responses.sonar.wavelength_m * STEP)
        motion = (len(responses) - 1) * _fine(received, coarse)
        return Estimate(Motion(float(motion[0]), float(motion[1]), 0.0), None, not reason, reason)


def _products(sonar: ChannelSonar, response: Complex, number: int, height_m: float) -> Products:
    """Return the products of one receiver's pings ``(pings, taps)``; 0 outside the echoes of its field of view."""
    field = sonar.receivers[number].field
    cosine = height_m / np.maximum(sonar.delay_s * sonar.sound_speed / 2, height_m)
    sine = _along(field, cosine)
    widest = math.radians(field.tilt_deg + field.along_deg / 2) if field.shape == "rectangular" else math.pi / 2
    inside = (cosine < 1) & (cosine > math.cos(min(widest, math.pi / 2)))
    product = np.where(inside, (response[:-1] * response[1:].conj()).sum(axis=0), 0)
    energy = np.where(inside, np.sqrt((np.abs(response[:-1]) ** 2).sum(axis=0) * (np.abs(response[1:]) ** 2).sum(axis=0)), 0)
    heading = math.radians(field.heading_deg)
    return Products(product, energy, 4 * np.pi / sonar.wavelength_m * sine, np.array([math.sin(heading), math.cos(heading)]))


def _along(field: FieldOfView, cosine: Array) -> Array:
    """Return the component of unit directions of echoes along the axis of a receiver ``(taps,)``, averaged by energy.

    At a slant range R and an angle psi aside, sin^2 psi + along^2 + (height / R)^2 = 1.
    """
    aside = np.linspace(-0.5, 0.5, BEAM_ANGLES) * math.radians(min(field.across_deg, 90.0))
    energy = (
        field.sensitivity(np.cos(aside), np.sin(aside), 0 * aside) ** 2 if field.shape != "all" else np.ones(BEAM_ANGLES)
    )
    along = np.sqrt(np.maximum(np.cos(aside)[:, None] ** 2 - cosine**2, 0))
    return np.asarray((energy[:, None] * along).sum(axis=0) / energy.sum())


def _coarse(received: list[Products], reach: float, step: float) -> tuple[Array, str]:
    """Return the motion ``(2,)`` [m] whose compensated products have the largest sum, and the reason of a rejection."""
    line = np.linspace(-reach, reach, 2 * math.ceil(reach / step) + 1)
    sideways, forward = np.meshgrid(line, line, indexing="ij")
    total, spread = np.zeros(sideways.shape), 0.0
    displacements = np.linspace(-1.5 * reach, 1.5 * reach, 6 * math.ceil(reach / step) + 1)
    # compensate each receiver for motions along its axis, and add its sums to the map of motions
    for receiver in received:
        weight = receiver.product / max(float(receiver.energy.sum()), 1e-300)
        sums = (np.exp(1j * displacements[:, None] * receiver.turn) @ weight).real
        total += np.interp(receiver.axis[0] * sideways + receiver.axis[1] * forward, displacements, sums)
        spread += float((np.abs(weight) ** 2).sum()) / 2
    # compare the largest maximum with that of unrelated pings, and with the second
    peaks = np.argwhere((total == maximum_filter(total, size=5)) & (total > 0))
    if not len(peaks):
        return np.zeros(2), "the pings have nothing in common"
    peaks = peaks[np.argsort(-total[tuple(peaks.T)])]
    best = total[tuple(peaks[0])]
    reason = "" if best > LEAST_MAXIMUM * math.sqrt(spread) else "the pings have nothing in common"
    if not reason and len(peaks) > 1 and total[tuple(peaks[1])] > AMBIGUOUS_RATIO * best:
        reason = "two motions fit equally well"
    return line[peaks[0]], reason


def _fine(received: list[Products], motion: Array) -> Array:
    """Refine a motion ``(2,)`` [m] by the residual phases."""
    for _ in range(3):
        information, gradient = np.zeros((2, 2)), np.zeros(2)
        # residual phase of each window, after the current motion is compensated
        for receiver in received:
            product = _windows(receiver.product * np.exp(1j * (receiver.axis @ motion) * receiver.turn))
            energy = _windows(receiver.energy)
            turn = _windows(receiver.turn * receiver.energy) / np.maximum(energy, 1e-300)
            likeness = np.minimum(np.abs(product) / np.maximum(energy, 1e-300), 0.999)
            # variance of the phase of the mean of n products (Rodriguez and Martin, 1992)
            weight = np.where(energy > 0, 2 * WINDOW_TAPS * likeness**2 / (1 - likeness**2), 0)
            information += (weight * turn**2).sum() * np.outer(receiver.axis, receiver.axis)
            gradient += (weight * turn * -np.angle(product)).sum() * receiver.axis
        motion = motion + np.linalg.lstsq(information, gradient, rcond=None)[0]
    return motion


def _windows(taps: NDArray[np.inexact]) -> NDArray[np.inexact]:
    """Sum over windows of neighbouring taps."""
    used = len(taps) // WINDOW_TAPS * WINDOW_TAPS
    return np.asarray(taps[:used].reshape(-1, WINDOW_TAPS).sum(axis=1))


# ---------------- Checks shared by all channel estimators


INTERVAL_TOLERANCE = 0.01
"""Largest deviation of the time between pings, as a fraction of it."""


class Pings(NamedTuple):
    """Checked responses.

    Attributes:
        response: ``(pings, receivers, taps)`` complex128.
        interval_s: time from ping to ping [s].
        silent: names of the receivers without any echo in at least one ping.
    """

    response: NDArray[np.complex128]
    interval_s: float
    silent: tuple[str, ...]


def pings_of(responses: ImpulseResponses) -> Pings:
    """Check responses and convert them to complex128.

    Raises:
        MitsonarError: fewer than two pings, times that do not increase evenly, or values that are not finite.
    """
    if len(responses) < 2:
        raise MitsonarError(f"an estimator of motion takes two pings or more: got {len(responses)}; give a longer run")
    if not np.isfinite(responses.response).all():
        raise MitsonarError("the responses hold nan or inf: leave such pings out")
    steps = np.diff(responses.time_s)
    interval = float(steps.mean())
    if not (np.isfinite(interval) and interval > 0 and (np.abs(steps - interval) <= INTERVAL_TOLERANCE * interval).all()):
        raise MitsonarError(
            f"pings must be evenly spaced in increasing time: got steps of {steps.min():g} to {steps.max():g} s; select "
            "such pings"
        )
    quiet = np.asarray(~responses.response.any(axis=2).all(axis=0), dtype=bool)
    names = tuple(one.name for number, one in enumerate(responses.sonar.receivers) if quiet[number])
    return Pings(responses.response.astype(np.complex128), interval, names)


def reach_of(interval_s: float, speed: float, wavelength_m: float, most_waves: float) -> float:
    """Return the longest motion between pings [m].

    Raises:
        MitsonarError: more wavelengths than can be searched.
    """
    reach = speed * interval_s
    if reach > most_waves * wavelength_m:
        raise MitsonarError(
            f"pings {interval_s:g} s apart at up to {speed:g} m/s allow motions of up to {reach:.3g} m, "
            f"{reach / wavelength_m:.3g} wavelengths, of which {most_waves:g} can be searched: measure more often, "
            f"or give the estimator a lower speed (NAME:speed={most_waves * wavelength_m / interval_s:.2g})"
        )
    return reach


def assumed_height(responses: ImpulseResponses, name: str, height_m: float | None) -> float:
    """Return the height of the transmitter over the ground [m]: as given, or the mean of the responses' heights.

    Raises:
        MitsonarError: no height, or one that is not positive or beyond the instrument's range.
    """
    if height_m is not None:
        height = height_m
    elif responses.height_m is not None:
        height = float(np.mean(responses.height_m))
    else:
        raise MitsonarError(f"{name} needs the height over the ground: the responses hold none; give {argument('height_m')}")
    if not 0 < height < responses.sonar.range_max:
        raise MitsonarError(
            f"{name}: {argument('height_m')} must be above 0 and below range_max {responses.sonar.range_max:g} m: got "
            f"{height:g} m"
        )
    return height


# ---------------- Division of a wide band into narrow ones


BAND_HZ = 4800.0
"""Smallest bandwidth of a part [Hz]."""

FAINTEST_AMPLITUDE = 1e-3
"""Relative amplitude of the whole band below which frequencies are left out."""


class Band(NamedTuple):
    """A part of a band.

    Attributes:
        sonar: an instrument of this part alone.
        place: indices of its frequencies among those of the whole band's measurement ``(taps,)``.
        gain: factor from the whole band's spectrum to that of the part ``(taps,)``.
    """

    sonar: ChannelSonar
    place: NDArray[np.int64]
    gain: NDArray[np.float64]

    def part_of(self, response: Complex) -> Complex:
        """Return the response of this part ``(..., taps)`` from the response of the whole band."""
        return np.asarray(np.fft.ifft(np.fft.fft(response, axis=-1)[..., self.place] * self.gain, axis=-1))


def bands_of(sonar: ChannelSonar, width_hz: float = BAND_HZ) -> list[Band]:
    """Divide an instrument's band into equally sampled parts, the narrowest that are at least ``width_hz`` wide.

    For unknown scatterers, frequencies farther apart than one over the spread of delays (some 100 Hz) are independent. Parts
    of a band that do not overlap therefore hold independent information on the motion; each is a channel sonar with a
    separate carrier. The cost of a part grows with the cube of its taps: n parts cost n squared times less than the whole
    band. Only the correlation across their edges is lost.
    """
    count = max(1, int(sonar.bandwidth_hz / width_hz))
    while sonar.taps % count:
        count -= 1
    step, spacing = sonar.frequency_step_hz, (1 + sonar.rolloff) * sonar.bandwidth_hz / count
    bands = []
    for number in range(count):
        # the centre lies on the grid of frequencies, so that a part is a choice of the whole band's frequencies
        offset = step * round((number - (count - 1) / 2) * spacing / step)
        part = sonar.replace(
            carrier_hz=sonar.carrier_hz + offset,
            bandwidth_hz=sonar.bandwidth_hz / count,
            sampling_hz=sonar.sampling_hz / count,
        )
        frequency = np.asarray(np.fft.fftfreq(part.taps, 1 / part.sampling_hz), dtype=np.float64)
        whole = sonar.raised_cosine(frequency + offset)
        gain = (
            np.where(whole > FAINTEST_AMPLITUDE, part.raised_cosine(frequency) / np.maximum(whole, FAINTEST_AMPLITUDE), 0)
            / count
        )
        bands.append(Band(part, np.rint((frequency + offset) / step).astype(np.int64) % sonar.taps, gain))
    return bands
