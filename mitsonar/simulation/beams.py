"""How a coherent field becomes beams and bins: its grid, the matrices of pattern and pulse, and the beam of a direction.

The response of a line array depends only on the difference of the sines of two bearings. One grid over (sine, range)
therefore serves all beams. Each wave is shared among six nodes, linearly over the sine and by a kernel of three nodes over
range, and two banded matrices apply pattern and pulse. Both are band-limited, so dividing the spectrum of the shares out of
the matrices leaves an error of -47 dB (-43 dB for a uniform one-way aperture), as in a non-uniform FFT (Fessler and
Sutton 2003, IEEE Trans. Signal Process. 51:560).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

import drjit as dr
import finufft
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from mitsonar.instruments.beams import Aperture, Pulse, Spectrum
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar, rays_over_elevation
from mitsonar.simulation.device import DeviceArray, current_variant

__all__ = [
    "TOLERANCE",
    "Banded",
    "BeamFormer",
    "CommonFan",
    "angles_of",
    "beam_at",
    "beam_of",
    "elevation_end",
    "elevation_gain",
    "elevation_gain_of_ends",
    "kernel_spectrum",
    "kernel_weights",
    "phasor_sums",
    "phasors",
    "side_lobes",
]


LINES_A_LOBE = 5.0
"""Grid lines in sine per wavelength over aperture; 1, or 2 for a two-way pattern, would do if every wave lay on a node."""

RANGES_A_LOBE = 2.0
"""Grid lines in range per lobe of the pulse, which is the inverse of the bandwidth as a range; likewise 1."""

CENTRE = (0.71734221, -1.02560928, 0.55875532)
SIDE = (0.14092481, -0.52929438, 0.5352748, 0.15025906, -0.39685318)
"""Kernel over range at distances d and 1 + d of -0.5 to 0.5 grid lines, as polynomials in d^2 and d. It is close to a
multiple of I0(7 sqrt(1 - (t / 1.5)^2)), after Kaiser and Bessel, with an integral of 1."""

DRAWS_A_LOBE = 1.25
"""Draws of white noise per lobe of the pulse; from 1 on, the power after the pulse is the same everywhere."""

NEGLIGIBLE = 10 ** (-75 / 20)
"""Entries of a matrix that are neglected, relative to the largest."""

BLOCK, ROWS_IN_CACHE = 32, 256
"""Rows of a banded matrix that are multiplied together, and rows of its other factor."""

SIDE_LOBES_DB, MOST_LOBES = 45.0, 8
"""Side-lobe level down to which echoes beside the fan are kept, and the limit in wavelengths over aperture."""

PULSE_LENGTHS = 4
"""Distance beside the window within which echoes are kept, in resolutions."""

ELEVATION_END = {"receive": 1.0, "two_way": 0.845}
"""Edge of the fan over elevation, as x of sinc(x): the first zero for a one-way pattern, -30 dB for a two-way one."""

ELEVATION_HALF = {"receive": 0.442946, "two_way": 0.318883}
"""Half-power point of the pattern, as x of sinc(x)."""

COLUMNS_A_BEAM = {"draft": 2, "standard": 4, "fine": 8}
"""Number of ray columns across the width of a beam, by quality."""

STEEPEST_DEG = 85.0
"""Largest elevation of the fan [deg]."""

FOCUS_BLOCKS = 24
"""Number of range blocks, each with its pattern, of an array focused at one range."""


@dataclass(frozen=True)
class CommonFan:
    """Rays of a coherent ping, evenly spaced in the sine of the bearing and the tangent of the elevation.

    Attributes:
        columns, rows: number of rays across and over elevation.
        sine: largest sine of a bearing.
        tangent: largest tangent of an elevation.
    """

    columns: int
    rows: int
    sine: float
    tangent: float

    @classmethod
    def from_sonar(cls, sonar: Sonar) -> CommonFan:
        """Derive the fan of a sonar, with the ray density of its quality."""
        end = elevation_end(sonar)
        sine = min(0.999, math.sin(math.radians(sonar.azimuth_fov_deg) / 2) + side_lobes(sonar.aperture))
        columns = math.ceil(2 * sine / sonar.beam_width_rad * COLUMNS_A_BEAM[sonar.quality])
        rows = 2 * rays_over_elevation(sonar.quality, 2 * end)
        return cls(8 * math.ceil(columns / 8), rows, sine, math.tan(end))

    @property
    def rays(self) -> int:
        """Return the number of rays."""
        return self.columns * self.rows


def elevation_end(sonar: Sonar) -> float:
    """Return the largest elevation of rays [rad]: the edge of the field of view or of the pattern over elevation."""
    half = math.radians(sonar.elevation_fov_deg) / 2
    if sonar.vertical_pattern == "box":
        return half
    stretched = math.sin(half) * ELEVATION_END[sonar.vertical_pattern] / ELEVATION_HALF[sonar.vertical_pattern]
    return max(half, min(math.radians(STEEPEST_DEG), math.asin(min(1.0, stretched))))


def side_lobes(aperture: Aperture) -> float:
    """Return the distance from a beam's axis within which side lobes count, as a difference of sines."""
    return min(aperture.reach(SIDE_LOBES_DB), MOST_LOBES / aperture.length)


class BeamFormer:
    """Beam former and matched filter for fields over (sine of the bearing, range).

    The level of even ground equals that of a box as wide as the beam and as long as a bin, so energies agree with those of
    the model ``physical``.

    Attributes:
        sines, ranges: numbers of grid lines.
        first_sine, sine_step: first line and spacing in sine.
        first_range, range_step: first line and spacing in range [m].
    """

    def __init__(self, sonar: Sonar) -> None:
        self.sonar, self.aperture, self.pulse = sonar, sonar.aperture, Pulse(sonar.resolution_m)
        fan = CommonFan.from_sonar(sonar)
        self.sine_step = 1 / (LINES_A_LOBE * self.aperture.length)
        self.first_sine = -fan.sine - self.sine_step
        self.sines = math.ceil(2 * fan.sine / self.sine_step) + 4
        self.range_step = 1 / (RANGES_A_LOBE * self.pulse.lobes_per_m)
        self._guard = PULSE_LENGTHS * self.pulse.resolution_m
        self.first_range = max(sonar.range_min - self._guard, self.range_step)
        self.ranges = math.ceil((sonar.range_max + self._guard - self.first_range) / self.range_step) + 3

    @cached_property
    def over_range(self) -> Banded:
        """Return the pulse as a matrix ``(bins, ranges)``, without the spectrum of the shares."""
        pulse = self.pulse
        spectrum = _divided(pulse.spectrum(), kernel_spectrum(pulse.spectrum().frequency * self.range_step))
        amplitude = _interpolated(spectrum, (PULSE_LENGTHS + 1) * pulse.resolution_m)
        gain = math.sqrt(self.sonar.bin_m / pulse.equivalent_m)
        return self._banded(lambda away: amplitude(away).real * gain, self.first_range, self.ranges, self.range_step)

    @cached_property
    def over_noise(self) -> Banded:
        """Return the pulse as a matrix ``(bins, draws)`` with rows of unit power, which filters white noise over range."""
        step = 1 / (DRAWS_A_LOBE * self.pulse.lobes_per_m)
        first = self.sonar.range_min - self._guard  # also before the ping, where there are no echoes
        draws = math.ceil((self.sonar.range_max - first + self._guard) / step) + 1
        power = np.square(self.pulse.shape(np.arange(-40, 41) * step)).sum()
        return self._banded(lambda away: self.pulse.shape(away) / math.sqrt(power), first, draws, step)

    def _banded(
        self, amplitude: Callable[[NDArray[np.float64]], NDArray[np.float64]], begin_m: float, lines: int, step: float
    ) -> Banded:
        """Return a function of the distance between bin and line [m] as a matrix ``(bins, lines)``.

        Lines are ``step`` apart, from ``begin_m`` on [m].
        """
        places = self.sonar.range_m
        reach = PULSE_LENGTHS * self.pulse.resolution_m
        blocks = []
        for begin in range(0, len(places), BLOCK):  # block by block, because the whole matrix grows with the square of bins
            rows = places[begin : begin + BLOCK]
            first = max(0, math.ceil((rows[0] - reach - begin_m) / step))
            last = min(lines, math.floor((rows[-1] + reach - begin_m) / step) + 1)
            away = rows[:, None] - (begin_m + np.arange(first, last) * step)
            block = np.where(np.abs(away) <= reach, amplitude(away), 0)
            blocks.append((first, block.astype(np.float32)))
        return Banded(len(places), blocks, lines)

    @cached_property
    def _gain(self) -> float:
        """Return the factor that gives a beam the level of a box of the same width."""
        return math.sqrt(self.sonar.beam_width_rad / self.aperture.equivalent_width)

    @cached_property
    def node_power(self) -> float:
        """Return the mean square of independent nodes that have the power of waves of mean square 1, one per node."""
        pulse, pattern = self.pulse.spectrum(), self.aperture.spectrum()
        parts = (
            (pulse, kernel_spectrum(pulse.frequency * self.range_step)),
            (pattern, np.sinc(pattern.frequency * self.sine_step) ** 2),
        )
        return math.prod(_power(whole) / _power(_divided(whole, shares)) for whole, shares in parts)

    @cached_property
    def _away(self) -> NDArray[np.float64]:
        """Return the sine of each beam's axis minus that of each grid line ``(beams, sines)``."""
        line = self.first_sine + np.arange(self.sines) * self.sine_step
        return np.asarray(np.sin(self.sonar.bearing_rad)[:, None] - line, dtype=np.float64)

    @cached_property
    def over_sine(self) -> Banded:
        """Return the pattern as a matrix ``(beams, sines)`` without the spectrum of the shares, in focus, without errors."""
        return Banded.of_matrix(self._over_sine().real.astype(np.float32))

    def _over_sine(self, curvature: float = 0.0) -> NDArray[np.complex128]:
        """Return the pattern as a matrix ``(beams, sines)``, out of focus by a curvature [1/m]."""
        sonar = self.sonar
        bend = 0.0 if sonar.frequency_hz is None else curvature * sonar.sound_speed / sonar.frequency_hz
        spectrum = self.aperture.spectrum(bend)
        spectrum = _divided(spectrum, np.sinc(spectrum.frequency * self.sine_step) ** 2)  # of linear shares
        return np.asarray(_interpolated(spectrum, float(np.abs(self._away).max()))(self._away) * self._gain)

    def ground_correlation(self) -> NDArray[np.float64]:
        """Return the covariance of beams ``(beams, beams)`` that see even ground, up to a factor."""
        pattern = self.aperture.pattern(self._away)
        return np.asarray(pattern @ pattern.T)

    @cached_property
    def focused(self) -> list[tuple[slice, NDArray[np.complex64]]]:
        """Return blocks of bins and their pattern matrices ``(beams, sines)``, complex out of focus or with array errors."""
        sonar = self.sonar
        if sonar.focus_m is None:
            return [(slice(0, sonar.range_bins), self._over_sine().astype(np.complex64))]
        blocks = []
        for part in np.array_split(np.arange(sonar.range_bins), min(FOCUS_BLOCKS, sonar.range_bins)):
            curvature = float(np.mean(1 / sonar.range_m[part])) - 1 / sonar.focus_m
            blocks.append((slice(int(part[0]), int(part[-1]) + 1), self._over_sine(curvature).astype(np.complex64)))
        return blocks

    def beams(self, field: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Compute the complex image ``(bins, beams)`` of a field ``(ranges, sines)``."""
        if self.sonar.focus_m is None and self.sonar.array_error == 0:
            # beams first, which are fewer than lines; real and imaginary part apart, because both matrices are real
            beams = self.over_sine.of_rows(np.concatenate([field.real, field.imag]))  # (2 ranges, beams)
            real, imag = (self.over_range @ part for part in np.split(beams, 2))
            image = np.empty(real.shape, np.complex64)
            image.real, image.imag = real, imag
            return image
        real, imag = (self.over_range @ np.ascontiguousarray(part) for part in (field.real, field.imag))
        sums = real + 1j * imag
        return np.concatenate([sums[bins] @ matrix.T for bins, matrix in self.focused])


class Banded(NamedTuple):
    """A real matrix of which each block of rows has few columns.

    Attributes:
        rows: number of rows.
        blocks: first column and dense part ``(rows, columns)`` float32 of each :data:`BLOCK` of rows.
        columns: number of columns.
    """

    rows: int
    blocks: list[tuple[int, NDArray[np.float32]]]
    columns: int

    @classmethod
    def of_matrix(cls, matrix: NDArray[np.float32]) -> Banded:
        """Cut the bands out of a dense matrix, without its :data:`NEGLIGIBLE` entries at both ends."""
        blocks, limit = [], NEGLIGIBLE * float(np.abs(matrix).max())
        for begin in range(0, len(matrix), BLOCK):
            block = matrix[begin : begin + BLOCK]
            used = np.flatnonzero((np.abs(block) > limit).any(axis=0))
            first, last = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, 1)
            blocks.append((first, np.ascontiguousarray(block[:, first:last])))
        return cls(len(matrix), blocks, matrix.shape[1])

    def __matmul__(self, columns: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the product with a matrix ``(columns, n)`` float32 on its right, ``(rows, n)``."""
        product = np.empty((self.rows, columns.shape[1]), np.float32)
        for number, (first, block) in enumerate(self.blocks):
            begin = number * BLOCK
            np.matmul(block, columns[first : first + block.shape[1]], out=product[begin : begin + len(block)])
        return product

    def of_rows(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the product of a matrix ``(n, columns)`` float32 with the transpose of this one, ``(n, rows)``."""
        product = np.empty((len(rows), self.rows), np.float32)
        turned = [(first, np.ascontiguousarray(block.T)) for first, block in self.blocks]
        for begin in range(0, len(rows), ROWS_IN_CACHE):
            part = rows[begin : begin + ROWS_IN_CACHE]
            for number, (first, block) in enumerate(turned):
                beams = slice(number * BLOCK, number * BLOCK + block.shape[1])
                product[begin : begin + len(part), beams] = part[:, first : first + len(block)] @ block
        return product


def kernel_weights(distance: Any) -> tuple[Any, Any, Any]:
    """Return the shares of the grid lines before, nearest to and after a wave.

    Args:
        distance: of the wave from the nearest line, in grid lines, -0.5..0.5; any array.
    """
    square = distance * distance
    even = SIDE[0] + square * (SIDE[2] + square * SIDE[4])
    odd = distance * (SIDE[1] + square * SIDE[3])
    return even + odd, CENTRE[0] + square * (CENTRE[1] + square * CENTRE[2]), even - odd


def kernel_spectrum(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the spectrum of :func:`kernel_weights` as a function of distance, at frequencies per grid line ``(n,)``."""
    distance = (np.arange(400) + 0.5) / 400 - 0.5
    lines = zip((-1, 0, 1), kernel_weights(distance), strict=True)
    waves = [weight * np.cos(2 * math.pi * frequency[:, None] * (distance - line)) for line, weight in lines]
    return np.asarray(np.mean(sum(waves, np.zeros(1)), axis=1), dtype=np.float64)


def _divided(spectrum: Spectrum, by: NDArray[np.float64]) -> Spectrum:
    return Spectrum(spectrum.frequency, spectrum.weight / by)


def _power(spectrum: Spectrum) -> float:
    return float(np.square(np.abs(spectrum.weight)).sum())


def _interpolated(spectrum: Spectrum, reach: float) -> CubicSpline:
    """Return the function with a spectrum, for offsets up to ``reach``, interpolated between 64 or more values a lobe."""
    frequency, weight = spectrum
    spacing = float(frequency[1] - frequency[0])
    size = 2 ** math.ceil(math.log2(64 * len(weight)))
    value = np.fft.fftshift(np.fft.ifft(weight, size)) * size  # sum of weight exp(2 j pi n k / size), n from 0
    offset = np.arange(-size // 2, size // 2) / (size * spacing)
    near = np.abs(offset) <= reach + 4 / (size * spacing)
    return CubicSpline(offset[near], value[near] * np.exp(2j * math.pi * frequency[0] * offset[near]))


# ---------------- Beam of a direction


def beam_of(
    sonar: Sonar, starboard: DeviceArray, forward: DeviceArray, up: DeviceArray
) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Return the beam of unit directions, whether they lie in the field of view, and their elevation [rad]."""
    bearing, elevation = angles_of(sonar, starboard, forward, up)
    beam, inside = beam_at(sonar, bearing)
    lift: DeviceArray = dr.abs(elevation)
    inside &= lift <= math.radians(sonar.elevation_fov_deg) / 2
    return beam, inside, elevation


def angles_of(
    sonar: Sonar, starboard: DeviceArray, forward: DeviceArray, up: DeviceArray
) -> tuple[DeviceArray, DeviceArray]:
    """Return bearing and elevation of unit directions [rad], by the sonar's kind of bearing."""
    if sonar.bearing == "azimuth":
        return dr.atan2(starboard, forward), _asin(up)
    return _asin(starboard), dr.atan2(up, forward)


def beam_at(sonar: Sonar, bearing: DeviceArray) -> tuple[DeviceArray, DeviceArray]:
    """Return the beam at bearings [rad], and whether a beam contains them."""
    # place in the fan in units of beams, by even angles or even sines
    position: DeviceArray
    half = math.radians(sonar.azimuth_fov_deg) / 2
    if sonar.beam_layout == "even":
        position = bearing * (sonar.beams / (2 * half)) + sonar.beams / 2
    else:
        position = dr.sin(bearing) * (sonar.beams / (2 * math.sin(half))) + sonar.beams / 2
    aside: DeviceArray = dr.abs(bearing)
    inside = (position >= 0) & (position < sonar.beams) & (aside <= half)
    beam = mi.UInt32(dr.select(inside, position, 0))
    if sonar.beam_width_deg is not None and sonar.model == "physical":
        # beams narrower than their spacing leave gaps: compare with the axis of the beam
        part = (mi.Float(beam) + (0.5 - sonar.beams / 2)) * (2 / sonar.beams)  # computed: a table would not be an input
        axis = part * half if sonar.beam_layout == "even" else dr.asin(part * math.sin(half))
        away: DeviceArray = dr.abs(bearing - axis)
        inside &= away <= sonar.beam_width_rad / 2
    return beam, inside


def _asin(value: DeviceArray) -> DeviceArray:
    return dr.asin(dr.select(value < 1, dr.select(value > -1, value, -1), 1))


# ---------------- Sums of phasors by non-uniform FFT


TOLERANCE = 1e-9
"""Relative error of the sums of phasors."""


def phasor_sums(turn: NDArray[np.float64], strength: NDArray[np.complex128], modes: int) -> NDArray[np.complex128]:
    """Sum strength exp(-i k turn) over echoes, for an odd number of integers k centred on 0.

    This is a non-uniform FFT of type 1. It is computed by finufft, or by cufinufft if it is installed and the renderer
    runs on CUDA.

    Args:
        turn: phase step of each echo, -pi..pi ``(n,)`` [rad].
        strength: complex amplitude of each echo ``(n,)``.
        modes: number of values of k.

    Returns:
        The sums ``(modes,)``.
    """
    if not len(turn):
        return np.zeros(modes, np.complex128)
    if current_variant().startswith("cuda") and _has_cufinufft():
        return _sums_on_device(turn, strength, modes)
    return np.asarray(finufft.nufft1d1(turn, strength, modes, eps=TOLERANCE, isign=-1, nthreads=1))


@cache
def _has_cufinufft() -> bool:
    """Test whether cufinufft is installed and loads; it uses the CUDA libraries of torch, if their versions agree."""
    try:
        import torch  # noqa: F401, I001  # first: makes its CUDA libraries available

        import cufinufft  # noqa: F401
    except (ImportError, OSError):
        return False
    return True


def _sums_on_device(turn: NDArray[np.float64], strength: NDArray[np.complex128], modes: int) -> NDArray[np.complex128]:
    import cufinufft
    import torch

    arrays = [torch.from_numpy(np.ascontiguousarray(values)).cuda() for values in (turn, strength)]
    return np.asarray(cufinufft.nufft1d1(*arrays, modes, eps=TOLERANCE, isign=-1).cpu().numpy())


def phasors(
    delay: NDArray[np.float64], amplitude: NDArray[np.inexact], sonar: ChannelSonar, padding: int
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Compute phase step and complex amplitude of echoes in NumPy, as a launch does on the device.

    Args:
        delay: delay of each echo ``(n,)`` [s].
        amplitude: amplitude of each echo ``(n,)``, before the phase of the carrier.
        sonar: the instrument, with its carrier and frequency step.
        padding: oversampling factor of the frequency response.

    Returns:
        Phase steps ``(n,)``, -pi..pi [rad], and complex amplitudes ``(n,)``.
    """
    # whole turns are removed before multiplying by 2 pi, to preserve precision
    turn, phase = delay * (sonar.frequency_step_hz / padding), delay * sonar.carrier_hz
    strength = amplitude * np.exp(-2j * np.pi * (phase - np.rint(phase)))
    return 2 * np.pi * (turn - np.rint(turn)), np.asarray(strength, np.complex128)


# ---------------- Pattern over elevation


def elevation_gain(sonar: Sonar, tangent: DeviceArray, fov_deg: DeviceArray = None) -> DeviceArray:
    """Return the amplitude of the pattern over elevation at a tangent of the elevation, a ``mi.Float``.

    The pattern is that of a uniform aperture with half power at the edges of the field of view, or 1 without a pattern.

    Args:
        sonar: the instrument.
        tangent: tangent of the elevation.
        fov_deg: field of view over elevation, with derivatives [deg]; default: that of the sonar.
    """
    pattern = sonar.vertical_pattern
    if pattern == "box":
        return mi.Float(1)
    one_way = _one_way(sonar, tangent, fov_deg)
    return one_way * one_way if pattern == "two_way" else one_way


def elevation_gain_of_ends(sonar: Sonar, arrival: DeviceArray, departure: DeviceArray) -> DeviceArray:
    """Return the amplitude of a path that arrives at a different elevation than it departed at.

    The pattern of a receiving array applies to the arrival only, that of a transmitting and receiving array to both ends.

    Args:
        sonar: the instrument, with its pattern over elevation.
        arrival: tangent of the elevation at which the path arrives.
        departure: tangent of the elevation at which the path departs.
    """
    pattern = sonar.vertical_pattern
    if pattern == "box":
        return mi.Float(1)
    gain = _one_way(sonar, arrival)
    return gain * _one_way(sonar, departure) if pattern == "two_way" else gain


def _one_way(sonar: Sonar, tangent: DeviceArray, fov_deg: DeviceArray = None) -> DeviceArray:
    """Return the one-way amplitude sinc(x) of the uniform aperture at a tangent of the elevation."""
    half: DeviceArray = math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    if fov_deg is not None:
        half = dr.sin(fov_deg * (math.pi / 360))
    x = tangent * dr.rsqrt(1 + tangent * tangent) * (ELEVATION_HALF[sonar.vertical_pattern] * math.pi / half)
    return dr.select(dr.abs(x) > 1e-4, dr.sin(x) / x, 1)
