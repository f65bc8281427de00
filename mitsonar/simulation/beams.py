"""How a coherent field becomes beams and bins: its grid, the matrices of pattern and pulse, and the beam of a direction.

The response of a line array depends only on the difference of the sines of two bearings. One grid over (sine, range)
therefore serves all beams: a banded matrix over range applies the pulse, and a dense matrix over the sine applies the
pattern.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import drjit as dr
import finufft
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mitsonar.instruments.beams import Aperture, Pulse
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar, rays_over_elevation
from mitsonar.simulation.device import DeviceArray, current_variant

__all__ = [
    "TOLERANCE",
    "BeamFormer",
    "CommonFan",
    "angles_of",
    "beam_at",
    "beam_of",
    "elevation_end",
    "elevation_gain",
    "elevation_gain_of_ends",
    "phasor_sums",
    "phasors",
    "side_lobes",
]


SINES_A_LOBE, RANGES_A_PULSE = 8, 4
"""Grid lines per wavelength over aperture in sine, and per resolution in range."""

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
    the model ``physical``. The power that linear deposit on the grid loses is divided out.

    Attributes:
        sines, ranges: numbers of grid lines.
        first_sine, sine_step: first line and spacing in sine.
        first_range, range_step: first line and spacing in range [m].
    """

    def __init__(self, sonar: Sonar) -> None:
        self.sonar, self.aperture, self.pulse = sonar, sonar.aperture, Pulse(sonar.resolution_m)
        fan = CommonFan.from_sonar(sonar)
        self.sine_step = 1 / (SINES_A_LOBE * self.aperture.length)
        self.first_sine = -fan.sine - self.sine_step
        self.sines = math.ceil(2 * fan.sine / self.sine_step) + 4
        self.range_step = min(sonar.bin_m, self.pulse.resolution_m) / RANGES_A_PULSE
        guard = PULSE_LENGTHS * self.pulse.resolution_m
        self.first_range = max(sonar.range_min - guard, self.range_step)
        self.ranges = math.ceil((sonar.range_max + guard - self.first_range) / self.range_step) + 2

    @cached_property
    def over_range(self) -> csr_array[Any, Any]:
        """Return the pulse as a banded matrix ``(bins, ranges)`` float32."""
        # 1. Grid columns within reach of each bin's pulse.
        sonar, pulse = self.sonar, self.pulse
        reach = math.ceil(PULSE_LENGTHS * pulse.resolution_m / self.range_step)
        middle = np.round((sonar.range_m - self.first_range) / self.range_step).astype(int)
        column = middle[:, None] + np.arange(-reach, reach + 1)
        inside = (column >= 0) & (column < self.ranges)
        away = sonar.range_m[:, None] - (self.first_range + column * self.range_step)
        # 2. Pulse shape at these columns, scaled to the energy of a bin and corrected for the linear deposit.
        preserved = _preserved_power(pulse.shape, self.range_step, 20 * pulse.resolution_m)
        value = pulse.shape(away) * math.sqrt(sonar.bin_m / (pulse.equivalent_m * preserved))
        row = np.broadcast_to(np.arange(sonar.range_bins)[:, None], column.shape)
        entries = (value[inside].astype(np.float32), (row[inside], column[inside]))
        return csr_array(entries, shape=(sonar.range_bins, self.ranges))

    @cached_property
    def _gain(self) -> float:
        """Return the factor that gives a beam the level of a box of the same width."""
        preserved = _preserved_power(self.aperture.pattern, self.sine_step, 40 / self.aperture.length)
        return math.sqrt(self.sonar.beam_width_rad / (self.aperture.equivalent_width * preserved))

    @cached_property
    def preserved_power(self) -> float:
        """Return the fraction of power that linear deposit on the grid preserves, over sine and range."""
        over_range = _preserved_power(self.pulse.shape, self.range_step, 20 * self.pulse.resolution_m)
        return over_range * _preserved_power(self.aperture.pattern, self.sine_step, 40 / self.aperture.length)

    @cached_property
    def _away(self) -> NDArray[np.float64]:
        """Return the sine of each beam's axis minus that of each grid line ``(beams, sines)``."""
        line = self.first_sine + np.arange(self.sines) * self.sine_step
        return np.asarray(np.sin(self.sonar.bearing_rad)[:, None] - line, dtype=np.float64)

    @cached_property
    def over_sine(self) -> NDArray[np.float32]:
        """Return the pattern as a matrix ``(beams, sines)``, for an array focused at every range."""
        return np.asarray(self.aperture.pattern(self._away) * self._gain, dtype=np.float32)

    @cached_property
    def focused(self) -> list[tuple[slice, NDArray[np.complex64]]]:
        """Return blocks of bins and their pattern matrices ``(beams, sines)``, for an array focused at one range."""
        sonar = self.sonar
        assert sonar.focus_m is not None
        assert sonar.frequency_hz is not None
        wavelength = sonar.sound_speed / sonar.frequency_hz
        blocks = []
        for part in np.array_split(np.arange(sonar.range_bins), min(FOCUS_BLOCKS, sonar.range_bins)):
            curvature = float(np.mean(1 / sonar.range_m[part])) - 1 / sonar.focus_m
            matrix = np.stack([self.aperture.defocused(row, curvature, wavelength) for row in self._away]) * self._gain
            blocks.append((slice(int(part[0]), int(part[-1]) + 1), matrix.astype(np.complex64)))
        return blocks

    def beams(self, field: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Compute the complex image ``(bins, beams)`` of a field ``(sines, ranges)``."""
        # pulse first; real and imaginary part stay apart because both matrices are real unless the array is focused
        parts = self.over_range @ np.concatenate([field.real, field.imag]).T  # (bins, 2 sines)
        real, imag = parts[:, : self.sines], parts[:, self.sines :]
        if self.sonar.focus_m is None:
            turned = self.over_sine.T
            image: NDArray[np.complex64] = np.ascontiguousarray(real) @ turned + 1j * (np.ascontiguousarray(imag) @ turned)
            return image
        sums = real + 1j * imag
        return np.concatenate([sums[bins] @ matrix.T for bins, matrix in self.focused])


def _preserved_power(shape: Any, step: float, reach: float) -> float:
    """Return the fraction of power that linear deposit on a grid preserves, averaged over positions between lines."""
    x = np.linspace(-reach, reach, 40_001)
    places = (np.arange(32) + 0.5) / 32
    power = [np.trapezoid(((1 - part) * shape(x) + part * shape(x - step)) ** 2, x) for part in places]
    return float(np.mean(power) / np.trapezoid(shape(x) ** 2, x))


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


def elevation_gain(sonar: Sonar, tangent: DeviceArray) -> DeviceArray:
    """Return the amplitude of the pattern over elevation at a tangent of the elevation, a ``mi.Float``.

    The pattern is that of a uniform aperture with half power at the edges of the field of view, or 1 without a pattern.
    """
    pattern = sonar.vertical_pattern
    if pattern == "box":
        return mi.Float(1)
    one_way = _one_way(sonar, tangent)
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


def _one_way(sonar: Sonar, tangent: DeviceArray) -> DeviceArray:
    """Return the one-way amplitude sinc(x) of the uniform aperture at a tangent of the elevation."""
    half = math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    x = tangent * dr.rsqrt(1 + tangent * tangent) * (ELEVATION_HALF[sonar.vertical_pattern] * math.pi / half)
    return dr.select(dr.abs(x) > 1e-4, dr.sin(x) / x, 1)
