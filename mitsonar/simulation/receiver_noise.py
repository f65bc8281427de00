"""How a receiver changes a coherent ping: tails and crosstalk, volume scattering, noise with glow, saturation, stripes.

:data:`PROCESSES` names what is added after the echoes, in the order of the instrument. A process is a function
``process(receiver, image, ping, side) -> image`` of the complex image ``(bins, beams)``. Its draws are functions of (seed,
ping, cell), so an image does not depend on the order in which pings are rendered.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special
from scipy.sparse import csr_array, diags_array

from mitsonar.acoustics.noise import uniform
from mitsonar.acoustics.water import loss_of
from mitsonar.instruments.beams import series, shaded_sinc
from mitsonar.instruments.sonar import Sonar, crosstalk_amplitude, group_of_beams
from mitsonar.simulation.beams import PULSE_LENGTHS, BeamFormer

__all__ = ["PROCESSES", "EchoTail", "ReceiverNoise", "crosstalk", "saturation_notes"]

Image = NDArray[np.complex64]
"""A complex image ``(bins, beams)``: amplitudes relative to the source at 1 m."""

STRIPES, NOISE, VOLUME, GLOW, CROSSTALK = 0x57121, 0x6E6F6973, 0x766F6C75, 0x676C6F77, 0x63726F73
TAIL, DISTORTION, GROUPS, OFFSET = 0x7461696C, 0x636C6970, 0x67726F75, 0x6F666673
"""Salts of the seed that make the draws of the processes independent."""

TAPS, TAP_SPREAD = 64, 0.5
"""Number of taps of a beam's tail, and the standard deviation of the logarithm of their amplitudes, beyond that of complex
Gaussian ones. Tails are patchy, as behind targets in real frames; with 16 taps they are rows of dots."""

TAIL_LENGTHS = 6.0
"""Range at which a tail ends, relative to ``tail_m``."""

MEDIAN_SQUARE = 0.25
"""Median of the squared bearing over evenly spaced beams, relative to the outermost beam."""

SIDE_SALT = {0: 0, 1: 0x7570 << 32, -1: 0x646F << 32}
"""Salts of the seed that make the noise of both sides of the elevation independent, keyed by side."""


class ReceiverNoise:
    """Noise of a receiver and of the water in front of it.

    Args:
        sonar: a sonar of the model ``coherent``.
        former: its beamformer, whose aperture and pulse filter the noise as they filter echoes.
        looks: number of looks that a bin averages; the sonar has a bin for each.
        groups: ping group of each beam ``(beams,)``; default: those of the sonar.
    """

    def __init__(self, sonar: Sonar, former: BeamFormer, looks: int = 1, groups: NDArray[np.int64] | None = None) -> None:
        self.sonar, self.former, self.looks = sonar, former, looks
        self.groups = group_of_beams(sonar) if groups is None else groups
        self._cached_waves: dict[int, NDArray[np.float32]] = {}

    def add(self, image: NDArray[Any], ping: int, side: int = 0) -> Image:
        """Apply all :data:`PROCESSES` to the echoes of one ping.

        Args:
            image: echoes ``(bins, beams)``.
            ping: number of the ping, on which the noise depends.
            side: side of the elevation: 0 for the whole view, +1 and -1 for portions.
        """
        for process in PROCESSES:
            image = process(self, image, ping, side)
        return np.asarray(image, dtype=np.complex64)

    @cached_property
    def stripes(self) -> NDArray[np.float32]:
        """Return the amplitude gain of each beam ``(beams,)``, by the seed for beams and ping groups, and by the taper."""
        sonar = self.sonar
        drawn_db = np.random.default_rng([abs(sonar.seed), STRIPES]).normal(0, sonar.stripes_db, sonar.beams)
        of_group = np.random.default_rng([abs(sonar.seed), GROUPS]).normal(0, sonar.group_stripes_db, self.groups.max() + 1)
        gain_db = drawn_db + of_group[self.groups] - sonar.taper_db * self._aside**2
        return np.asarray(10 ** (gain_db / 20), dtype=np.float32)

    @cached_property
    def offset(self) -> NDArray[np.float32]:
        """Return the constant power that the detector adds to each beam ``(beams,)``."""
        sonar = self.sonar
        if sonar.detector_offset_db is None:
            return np.zeros(sonar.beams, np.float32)
        drawn_db = np.random.default_rng([abs(sonar.seed), OFFSET]).normal(0, sonar.detector_spread_db, sonar.beams)
        return np.asarray(10 ** ((sonar.detector_offset_db + drawn_db - sonar.source_level_db) / 10), dtype=np.float32)

    @property
    def _aside(self) -> NDArray[np.float64]:
        """Return the sine of the bearing of each beam, relative to the outermost ``(beams,)``."""
        sine = np.sin(self.sonar.bearing_rad)
        return np.asarray(sine / max(float(np.abs(sine).max()), 1e-12), dtype=np.float64)

    # ---------------- Noise and volume reverberation

    def noise(self, ping: int, side: int = 0) -> NDArray[np.complex64]:
        """Return the receiver noise of one ping ``(bins, beams)``: complex Gaussian, filtered as echoes are.

        White noise from the water and the array elements passes the array, which correlates neighbouring beams, and the
        matched filter. The noise may rise near the sonar (near glow). Each value is a function of (seed, ping, cell); the
        part of the glow that is constant over pings is a function of (seed, cell).
        """
        sonar, amplitude, salt = self.sonar, self._noise_amplitude, SIDE_SALT[side]
        if sonar.near_glow_still == 0 or sonar.near_glow_db == 0:
            return self._white(ping, NOISE ^ salt, 1) * np.asarray(amplitude, np.float32)
        # split the excess power of the glow into a part that is constant over pings and a part drawn for each ping
        power = np.square(amplitude)
        still = sonar.near_glow_still * power * (1 - 10 ** (-self._glow / 10))
        per_ping = self._white(ping, NOISE ^ salt, 1) * np.asarray(np.sqrt(power - still), np.float32)
        constant = self._white(0, GLOW ^ salt, 1) * np.asarray(np.sqrt(still), np.float32)
        return np.asarray(per_ping + constant, dtype=np.complex64)

    @cached_property
    def _glow(self) -> NDArray[np.float64]:
        """Return the excess of the noise near the sonar over that farther away ``(bins, 1)`` or ``(bins, beams)`` [dB]."""
        sonar = self.sonar
        fall = (sonar.near_glow_db * (1 - sonar.range_m / sonar.near_glow_m))[:, None]
        if sonar.near_glow_db == 0 or (sonar.near_glow_edge_db == 0 and sonar.near_glow_spread_db == 0):
            return np.asarray(np.maximum(0, fall), dtype=np.float64)
        drawn = np.random.default_rng([abs(sonar.seed), GLOW]).normal(0, sonar.near_glow_spread_db, sonar.beams)
        return np.asarray(np.maximum(0, fall - sonar.near_glow_edge_db * (self._aside**2 - MEDIAN_SQUARE) + drawn))

    def volume(self, ping: int, side: int = 0) -> NDArray[np.complex64]:
        """Return the volume reverberation of one ping ``(bins, beams)``, drawn anew for each ping.

        Its power is Sv times the volume of the cell over R^4. One side of the elevation contains half of the volume.
        """
        amplitude = np.asarray(self._volume_amplitude * (math.sqrt(0.5) if side else 1), np.float32)
        return self._white(ping, VOLUME ^ SIDE_SALT[side], 2) * amplitude[:, None]

    def clipped(self, image: NDArray[Any], ping: int, side: int = 0) -> NDArray[np.complex64]:
        """Return an image ``(bins, beams)`` whose elements clip amplitudes at ``saturation_db``.

        The elements receive the sum of what comes from all bearings, a complex Gaussian signal. A soft limiter multiplies it
        by a gain and adds a distortion that is independent of it (Bussgang 1952), here spread evenly over the beams: echoes
        are compressed, and all beams are brighter at their ranges.
        """
        sonar = self.sonar
        # 1. Power of the elements, relative to the limit.
        power = np.square(np.abs(image)).mean(axis=1)
        received = power * (sonar.beams * sonar.beam_spacing_rad / sonar.beam_width_rad)
        assert sonar.saturation_db is not None
        limit = 10 ** ((sonar.saturation_db - sonar.source_level_db) / 10)
        clips = received > LEAST_CLIPPED * limit
        result = np.array(image, dtype=np.complex64)
        if not clips.any():
            return result
        # 2. Gain and distortion.
        gain, distortion = limiter(limit / received[clips])
        amplitude = np.sqrt(power[clips] * distortion)
        noise = self._white(ping, DISTORTION ^ SIDE_SALT[side], 1)[clips]
        result[clips] = result[clips] * gain[:, None].astype(np.float32) + noise * amplitude[:, None].astype(np.float32)
        return result

    def noise_powers(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the mean powers of noise and of volume in averaged bins, two arrays ``(bins,)``; 0 where there is none.

        Glow that differs from beam to beam is averaged over the beams.
        """
        sonar, none = self.sonar, np.zeros(self.sonar.range_bins)
        noise = none if sonar.noise_level_db is None else np.square(self._noise_amplitude).mean(axis=1) + none
        volume = none if sonar.volume_db is None else np.square(self._volume_amplitude)
        noise, volume = (power.reshape(-1, self.looks).mean(axis=1) for power in (noise, volume))
        return noise, volume

    def beam_correlations(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the beam correlations ``(beams, beams)`` of noise, volume reverberation, and speckle on even ground."""
        noise, volume = (self._plane_waves(passes).astype(float) for passes in (1, 2))
        return noise.T @ noise, volume.T @ volume, _correlation(self.former.ground_correlation())

    def bin_correlation(self) -> csr_array[Any, Any]:
        """Return the bin correlation ``(bins, bins)`` due to the pulse, the same for noise, volume and speckle."""
        size, pulse = self.sonar.range_bins, self.former.pulse
        offset = np.arange(1 - size, size)
        offset = offset[np.abs(offset) * self.sonar.bin_m <= 2 * PULSE_LENGTHS * pulse.resolution_m]
        value = pulse.spectrum().coherence(offset * self.sonar.bin_m)
        return csr_array(diags_array(list(value), offsets=list(offset), shape=(size, size)))

    @cached_property
    def _noise_amplitude(self) -> NDArray[np.float64]:
        """Return the amplitude of the receiver noise including glow ``(bins, 1)`` or ``(bins, beams)``."""
        sonar = self.sonar
        assert sonar.noise_level_db is not None
        return np.asarray(10 ** ((sonar.noise_level_db - sonar.source_level_db + self._glow) / 20), dtype=np.float64)

    @cached_property
    def _volume_amplitude(self) -> NDArray[np.float64]:
        """Return the amplitude of the volume reverberation ``(bins,)``."""
        sonar = self.sonar
        assert sonar.volume_db is not None
        volume = sonar.range_m**2 * sonar.beam_width_rad * math.radians(sonar.elevation_fov_deg) * sonar.bin_m * self.looks
        power = 10 ** (sonar.volume_db / 10) * volume / sonar.range_m**4 * loss_of(sonar)
        return np.asarray(np.sqrt(power), dtype=np.float64)

    def _plane_waves(self, passes: int) -> NDArray[np.float32]:
        """Return :meth:`_waves` from a cache."""
        if passes not in self._cached_waves:
            self._cached_waves[passes] = self._waves(passes)
        return self._cached_waves[passes]

    def _white(self, ping: int, salt: int, passes: int) -> NDArray[np.complex64]:
        """Return complex Gaussian noise of unit power ``(bins, beams)``, filtered by the array and the matched filter."""
        waves, over_range = self._plane_waves(passes), self.former.over_noise
        shape = 1, over_range.columns, len(waves)
        drawn = uniform(shape, seed=self.sonar.seed ^ salt, frames=np.array([ping]), like=np.empty(0))
        first, second = (values[0].astype(np.float32) for values in drawn)
        # 1. Draw complex Gaussian noise of every plane wave and range (Box-Muller).
        radius, angle = np.sqrt(-np.log(first)), np.float32(2 * math.pi) * second
        # 2. Apply the matched filter over range, then the array over plane waves.
        filtered = [(over_range @ (radius * turn(angle))) @ waves for turn in (np.cos, np.sin)]
        noise = np.empty(filtered[0].shape, np.complex64)
        noise.real, noise.imag = filtered
        return noise

    def _waves(self, passes: int) -> NDArray[np.float32]:
        """Return the amplitude of plane waves in each beam ``(waves, beams)``, for a one-way or two-way pattern.

        Waves are 1 / (passes x length) apart in sine, which resolves that pattern. Each beam has unit power.
        """
        length = self.former.aperture.length
        reach = math.sin(math.radians(self.sonar.azimuth_fov_deg) / 2) + 4 / length
        wave = np.arange(-reach, reach, 1 / (passes * length))
        away = np.sin(self.sonar.bearing_rad)[:, None] - wave
        amplitude = shaded_sinc(away * length, series(self.sonar.shading)) ** passes
        amplitude /= np.sqrt(np.square(amplitude).sum(axis=1, keepdims=True))
        return np.ascontiguousarray(amplitude.T, dtype=np.float32)


def _with_volume(receiver: ReceiverNoise, image: NDArray[Any], ping: int, side: int) -> NDArray[Any]:
    return image if receiver.sonar.volume_db is None else image + receiver.volume(ping, side)


def _with_noise(receiver: ReceiverNoise, image: NDArray[Any], ping: int, side: int) -> NDArray[Any]:
    return image if receiver.sonar.noise_level_db is None else image + receiver.noise(ping, side)


def _with_saturation(receiver: ReceiverNoise, image: NDArray[Any], ping: int, side: int) -> NDArray[Any]:
    return image if receiver.sonar.saturation_db is None else receiver.clipped(image, ping, side)


def _with_stripes(receiver: ReceiverNoise, image: NDArray[Any], ping: int, side: int) -> NDArray[Any]:
    sonar = receiver.sonar
    even = sonar.stripes_db == 0 and sonar.group_stripes_db == 0 and sonar.taper_db == 0
    return image if even else image * receiver.stripes


PROCESSES: tuple[Callable[[ReceiverNoise, NDArray[Any], int, int], NDArray[Any]], ...] = (
    _with_volume,
    _with_noise,
    _with_saturation,
    _with_stripes,
)
"""Processes that act on the echoes of a ping, in the order of the instrument."""


LEAST_CLIPPED = 0.05
"""Power of the elements, relative to the limit, below which they do not clip: their distortion is below -100 dB."""


def saturation_notes(sonar: Sonar) -> list[str]:
    """Return a one-sentence note if the elements clip noise alone, which leaves no picture."""
    if sonar.saturation_db is None or sonar.noise_level_db is None or sonar.saturation_db > sonar.noise_level_db:
        return []
    return [
        f"saturation_db {sonar.saturation_db:g} is below the noise, {sonar.noise_level_db:g} dB, so all is clipped: it "
        "is a level at the elements, dB re 1 uPa; give one above the noise, or leave it out"
    ]


def limiter(limit: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what a soft limiter of the envelope does to complex Gaussian signals: gain, and power of the distortion.

    Args:
        limit: squared largest amplitude, relative to the mean power of each signal.

    Returns:
        Amplitude gain of the signal, and power of the distortion relative to that of the signal.
    """
    root = np.sqrt(limit)
    gain = -np.expm1(-limit) + math.sqrt(math.pi) / 2 * root * special.erfc(root)
    return gain, np.maximum(-np.expm1(-limit) - gain**2, 0)


class EchoTail:
    """Tails of echoes: ringing of the transducer and paths by way of the ground near a target.

    Each beam has :data:`TAPS` taps with delays and complex gains by the seed, the same in all pings. Delays have an
    exponential law; over all beams, the power of the taps is ``tail_db``.

    Args:
        sonar: a sonar with a tail, and a bin for each look.

    Attributes:
        response: what follows an echo of amplitude 1 in bin 0 ``(bins, beams)``.
    """

    def __init__(self, sonar: Sonar) -> None:
        assert sonar.tail_db is not None
        rng = np.random.default_rng([abs(sonar.seed), TAIL])
        longest = min(sonar.range_bins - 1, math.ceil(TAIL_LENGTHS * sonar.tail_m / sonar.bin_m))
        delay_m = sonar.resolution_m + rng.exponential(sonar.tail_m, (TAPS, sonar.beams))
        bins = np.maximum(np.rint(delay_m / sonar.bin_m).astype(int), 1)
        real, imag = rng.normal(size=(2, TAPS, sonar.beams))
        gain = (real + 1j * imag) * np.exp(rng.normal(0, TAP_SPREAD, (TAPS, sonar.beams)))
        gain *= 10 ** (sonar.tail_db / 20) / math.sqrt(float(np.square(np.abs(gain)).sum(axis=0).mean()))
        gain[bins > longest] = 0
        self.response = np.zeros((longest + 1, sonar.beams), np.complex64)
        np.add.at(self.response, (np.minimum(bins, longest), np.arange(sonar.beams)), gain)
        self._length = fft.next_fast_len(sonar.range_bins + longest)
        self._spectrum = fft.fft(self.response, self._length, axis=0)

    def add(self, image: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return an image ``(bins, beams)`` with the tails of its echoes."""
        tails = fft.ifft(fft.fft(image, self._length, axis=0) * self._spectrum, axis=0)[: len(image)]
        return np.asarray(image + tails, dtype=np.complex64)


def crosstalk(sonar: Sonar, groups: NDArray[np.int64] | None = None) -> NDArray[np.complex64] | None:
    """Return the amplitudes with which beams leak into each other ``(from, to)``; None if they do not.

    Each pair of beams has a complex gain, drawn from the seed, whose mean square is that of
    :func:`~mitsonar.instruments.sonar.crosstalk_amplitude`.

    Args:
        sonar: the instrument.
        groups: ping group of each beam ``(beams,)``; default: those of the sonar.
    """
    if sonar.crosstalk_db is None:
        return None
    parts = np.random.default_rng([abs(sonar.seed), CROSSTALK]).normal(0, math.sqrt(0.5), (2, sonar.beams, sonar.beams))
    gain = crosstalk_amplitude(sonar, sonar.crosstalk_db, groups) * (parts[0] + 1j * parts[1])
    return np.asarray(gain, dtype=np.complex64)


def _correlation(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert a covariance matrix ``(n, n)`` to a correlation matrix."""
    std = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(std, std), dtype=np.float64)
