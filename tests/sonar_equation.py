"""The sonar equation: levels of echoes, reverberation and noise in dB, and the same as factors.

A level is ``10 log10`` of an intensity relative to that of a plane wave of 1 uPa rms. A source level refers to 1 m. Ranges
are in m, above 0; absorptions in dB/m, one way. Numbers and arrays of NumPy and torch may be mixed, where one library's
arrays broadcast. Sources: Urick, Principles of Underwater Sound, 3rd edition (1983), where nothing else is said.

Echoes of the model ``physical`` have no unit: their reflectivity C is Lambert's mu itself, not pi mu. A surface of C = 1
scatters pi times what arrives, 5 dB more than it can. A level in dB re 1 uPa needs ``mu = C / pi`` or less, see
:mod:`mitsonar.acoustics.materials`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from array_api_compat import array_namespace
from scipy.special import sici

from mitsonar.arrays import AnyArray
from mitsonar.errors import MitsonarError, argument, short_repr

__all__ = [
    "ambient_noise_db",
    "apply_tvg",
    "area_strength_db",
    "decibels",
    "echo_level_db",
    "intensity_ratio",
    "level_of_pressure",
    "line_directivity_db",
    "noise_level_db",
    "noise_warning",
    "power_sum_db",
    "pressure_of_level",
    "rectangle_directivity_db",
    "thermal_noise_db",
    "transmission_loss_db",
    "tvg_db",
    "two_way_amplitude",
    "two_way_intensity",
    "undo_tvg",
    "volume_reverberation_db",
    "volume_strength_db",
]

NEPERS = math.log(10) / 20
"""Nepers of a dB: a loss of L dB multiplies an amplitude by ``exp(-NEPERS L)``."""


# ---------------------------------------------------------------- dB and factors


def decibels(ratio: AnyArray) -> AnyArray:
    """Return ``10 log10`` of a ratio of intensities ``(...)`` [dB]; zero becomes minus infinity."""
    with np.errstate(divide="ignore"):
        return 10.0 * _library(ratio).log10(ratio)


def intensity_ratio(level_db: AnyArray) -> AnyArray:
    """Return the ratio of intensities ``(...)`` of a level [dB]: the inverse of :func:`decibels`."""
    return 10.0 ** (level_db / 10.0)


def level_of_pressure(pressure_upa: AnyArray) -> AnyArray:
    """Return the level [dB re 1 uPa] of a pressure [uPa rms] ``(...)``."""
    return decibels(pressure_upa * pressure_upa)


def pressure_of_level(level_db: AnyArray) -> AnyArray:
    """Return the pressure [uPa rms] ``(...)`` of a level [dB re 1 uPa]: the inverse of :func:`level_of_pressure`."""
    return 10.0 ** (level_db / 20.0)


def power_sum_db(*levels_db: AnyArray) -> AnyArray:
    """Add levels whose phases are unrelated: 10 log10 of the sum of their intensities ``(...)`` [dB].

    Raises:
        MitsonarError: no level is given.
    """
    if not levels_db:
        raise MitsonarError("a sum of levels needs at least one: got none")
    return decibels(sum(intensity_ratio(one) for one in levels_db))


# ---------------------------------------------------------------- echoes


def transmission_loss_db(range_m: AnyArray, absorption_db_per_m: AnyArray) -> AnyArray:
    """Compute the loss of one way [dB]: ``20 log R + alpha R``, spherical spreading and absorption."""
    return 2.0 * decibels(range_m) + absorption_db_per_m * range_m


def echo_level_db(
    source_level_db: AnyArray, range_m: AnyArray, absorption_db_per_m: AnyArray, strength_db: AnyArray
) -> AnyArray:
    """Compute the level of an echo [dB re 1 uPa]: ``EL = SL - 40 log R - 2 alpha R + TS``.

    Args:
        source_level_db: SL [dB re 1 uPa at 1 m], towards the target.
        range_m: R ``(...)``.
        absorption_db_per_m: alpha.
        strength_db: target strength TS of a body, :func:`area_strength_db` of a piece of surface, or
            :func:`volume_strength_db` of a piece of water ``(...)``.
    """
    return source_level_db - 2.0 * transmission_loss_db(range_m, absorption_db_per_m) + strength_db


def area_strength_db(sigma: AnyArray, area_m2: AnyArray) -> AnyArray:
    """Compute the strength of a piece of surface [dB re 1 m^2]: ``10 log(sigma dA)``.

    Args:
        sigma: scattering cross-section per unit area and steradian ``(...)`` [1/sr]; ``mu cos^2`` for Lambert.
        area_m2: dA, the area that sounds at once ``(...)``.
    """
    return decibels(sigma * area_m2)


def volume_strength_db(sv_db: AnyArray, range_m: AnyArray, solid_angle_sr: AnyArray, extent_m: AnyArray) -> AnyArray:
    """Compute the strength of the water that sounds at once [dB re 1 m^2]: ``Sv + 10 log V``, ``V = R^2 Omega extent``.

    Args:
        sv_db: Sv, volume scattering strength [dB re 1/m].
        range_m: R ``(...)``.
        solid_angle_sr: Omega, equivalent solid angle of the beam, there and back.
        extent_m: length along the range: ``c tau / 2`` of a pulse of tau seconds, or that of a range bin.
    """
    return sv_db + decibels(range_m * range_m * solid_angle_sr * extent_m)


def volume_reverberation_db(
    source_level_db: AnyArray,
    range_m: AnyArray,
    absorption_db_per_m: AnyArray,
    sv_db: AnyArray,
    *,
    solid_angle_sr: AnyArray,
    extent_m: AnyArray,
) -> AnyArray:
    """Compute the level of volume reverberation [dB re 1 uPa]: the echo of :func:`volume_strength_db`."""
    strength = volume_strength_db(sv_db, range_m, solid_angle_sr, extent_m)
    return echo_level_db(source_level_db, range_m, absorption_db_per_m, strength)


def two_way_amplitude(
    range_m: AnyArray, absorption_db_per_m: float, exp: Callable[[AnyArray], AnyArray] | None = None
) -> AnyArray:
    """Compute the factor of an echo's amplitude: ``R^-2 10^(-alpha R / 10)``, in float64.

    Args:
        range_m: R ``(...)``.
        absorption_db_per_m: alpha.
        exp: exponential function of the arrays' library; needed for Dr.Jit alone, whose arrays must be float64 already.
    """
    if exp is None:
        library = _library(range_m)
        range_m = library.astype(library.asarray(range_m), library.float64)
        exp = library.exp
    return exp(range_m * (-2.0 * NEPERS * absorption_db_per_m)) / (range_m * range_m)


def two_way_intensity(
    range_m: AnyArray, absorption_db_per_m: float, exp: Callable[[AnyArray], AnyArray] | None = None
) -> AnyArray:
    """Compute the factor of an echo's intensity, ``R^-4 10^(-2 alpha R / 10)``: the square of :func:`two_way_amplitude`."""
    factor = two_way_amplitude(range_m, absorption_db_per_m, exp)
    return factor * factor


# ---------------------------------------------------------------- time-varying gain


def tvg_db(range_m: AnyArray, log: float, absorption_db_per_m: float) -> AnyArray:
    """Compute a time-varying gain ``(...)`` [dB]: ``log log10(R) + 2 alpha R``.

    Args:
        range_m: R ``(...)``.
        log: 40 holds a point target level, 30 a short-pulse bottom at an angle, 20 volume reverberation, 0 does nothing.
        absorption_db_per_m: alpha, as the instrument assumes it.
    """
    return (log / 10.0) * decibels(range_m) + 2.0 * absorption_db_per_m * range_m


def apply_tvg(level_db: AnyArray, range_m: AnyArray, log: float, absorption_db_per_m: float) -> AnyArray:
    """Add the time-varying gain :func:`tvg_db` to levels ``(...)`` [dB]."""
    return level_db + tvg_db(range_m, log, absorption_db_per_m)


def undo_tvg(level_db: AnyArray, range_m: AnyArray, log: float, absorption_db_per_m: float) -> AnyArray:
    """Remove the time-varying gain :func:`tvg_db` from levels ``(...)`` [dB]: the inverse of :func:`apply_tvg`."""
    return level_db - tvg_db(range_m, log, absorption_db_per_m)


# ---------------------------------------------------------------- noise


def thermal_noise_db(frequency_hz: AnyArray, bandwidth_hz: float = 1.0, directivity_index_db: float = 0.0) -> AnyArray:
    """Compute the level of thermal noise [dB re 1 uPa]: ``NL = -15 + 20 log f_kHz + 10 log B - DI``.

    Motion of the water's molecules; it rules above 100 kHz. Source: Mellen, The thermal-noise limit in the detection of
    underwater acoustic signals, J. Acoust. Soc. Am. 24 (1952), 478-480. Between 0 and 30 deg C it changes by 0.5 dB.

    Args:
        frequency_hz: f ``(...)``.
        bandwidth_hz: B of the receiver.
        directivity_index_db: DI of the receiver.

    Raises:
        MitsonarError: a bandwidth that is not above 0.
    """
    return -15.0 + 2.0 * decibels(frequency_hz * 1e-3) + _band_db(bandwidth_hz, directivity_index_db)


def ambient_noise_db(
    frequency_hz: AnyArray,
    *,
    wind_m_s: float,
    shipping: float = 0.5,
    bandwidth_hz: float = 1.0,
    directivity_index_db: float = 0.0,
) -> AnyArray:
    """Compute the level of the sea's noise [dB re 1 uPa]: turbulence, shipping, wind and thermal noise as powers.

    Four straight lines through the curves of Wenz (1962), given by Coates, Underwater Acoustic Systems (1990), as quoted by
    Stojanovic, On the relationship between capacity and distance in an underwater acoustic communication channel (2007),
    eq. 7 (second hand). They are made for 1 Hz to 100 kHz. Beyond, thermal noise rules.

    Args:
        frequency_hz: ``(...)``.
        wind_m_s: speed of the wind [m/s].
        shipping: activity of ships, 0..1.
        bandwidth_hz: of the receiver.
        directivity_index_db: of the receiver. The noise is taken to come evenly from all directions.

    Raises:
        MitsonarError: a negative wind, a shipping outside 0..1, a bandwidth that is not above 0.
    """
    if not 0 <= wind_m_s < math.inf:
        raise MitsonarError(f"{argument('wind_m_s')} must be a finite speed from 0: got {short_repr(wind_m_s)}")
    if not 0 <= shipping <= 1:
        raise MitsonarError(f"{argument('shipping')} must lie in 0..1: got {short_repr(shipping)}")
    khz = frequency_hz * 1e-3
    log = decibels(khz) / 10.0
    turbulence = 17.0 - 30.0 * log
    ships = 40.0 + 20.0 * (shipping - 0.5) + 26.0 * log - 6.0 * decibels(khz + 0.03)
    wind = 50.0 + 7.5 * math.sqrt(wind_m_s) + 20.0 * log - 4.0 * decibels(khz + 0.4)
    spectrum = power_sum_db(turbulence, ships, wind, thermal_noise_db(frequency_hz))
    return spectrum + _band_db(bandwidth_hz, directivity_index_db)


def noise_level_db(
    frequency_hz: AnyArray,
    bandwidth_hz: float,
    directivity_index_db: float = 0.0,
    *,
    wind_m_s: float | None = None,
    shipping: float = 0.5,
    receiver_db: float | None = None,
) -> AnyArray:
    """Compute the level of all noise in a receiver's band [dB re 1 uPa].

    Args:
        frequency_hz: ``(...)``.
        bandwidth_hz: of the receiver.
        directivity_index_db: of the receiver.
        wind_m_s: speed of the wind; None for thermal noise alone, as suits sonars above 100 kHz, and tanks.
        shipping: activity of ships 0..1, with ``wind_m_s``.
        receiver_db: level of the electronics in the same band, referred to the water [dB re 1 uPa]; None for none.

    Raises:
        MitsonarError: as :func:`ambient_noise_db`.
    """
    if wind_m_s is None:
        noise = thermal_noise_db(frequency_hz, bandwidth_hz, directivity_index_db)
    else:
        band = {"bandwidth_hz": bandwidth_hz, "directivity_index_db": directivity_index_db}
        noise = ambient_noise_db(frequency_hz, wind_m_s=wind_m_s, shipping=shipping, **band)
    return noise if receiver_db is None else power_sum_db(noise, receiver_db)


def noise_warning(frequency_hz: float, *, wind_m_s: float | None = None) -> str | None:
    """Say in one sentence where noise lies outside the band of its formula; None where it holds.

    Thermal noise alone stands for all noise from 100 kHz on. The lines through Wenz's curves hold from 1 Hz to 100 kHz;
    above them thermal noise, which is added, takes over.

    Args:
        frequency_hz: of the receiver.
        wind_m_s: as of :func:`noise_level_db`; None for thermal noise alone.

    Raises:
        MitsonarError: a frequency that is not above 0.
    """
    khz = _length(frequency_hz, "frequency_hz") / 1000
    if wind_m_s is None and khz < 100:
        return f"thermal noise alone at {khz:,.4g} kHz is too low for the sea: it rules from 100 kHz on; give wind_m_s"
    if wind_m_s is not None and khz < 1e-3:
        return f"noise of the sea at {khz * 1000:,.4g} Hz is extrapolated: Wenz's curves begin at 1 Hz"
    return None


# ---------------------------------------------------------------- directivity


def line_directivity_db(length_m: float, wavelength_m: float) -> float:
    """Compute the directivity index of an even line array [dB], exact for every length.

    With x = pi L / lambda it is ``10 log(x / (Si(2 x) - sin^2(x) / x))``; long lines approach ``10 log(2 L / lambda)``.

    Args:
        length_m: L, the active length.
        wavelength_m: lambda, of the sound in water.

    Raises:
        MitsonarError: a length that is not above 0.
    """
    x = math.pi * _length(length_m, "length_m") / _length(wavelength_m, "wavelength_m")
    return 10.0 * math.log10(x / (float(sici(2 * x)[0]) - math.sin(x) ** 2 / x))


def rectangle_directivity_db(width_m: float, height_m: float, wavelength_m: float) -> float:
    """Compute the directivity index of an even rectangle in a baffle [dB]: ``10 log(4 pi A / lambda^2)``.

    It holds within 0.2 dB.

    Args:
        width_m: of the active area.
        height_m: of the active area.
        wavelength_m: lambda, of the sound in water.

    Raises:
        MitsonarError: a side below one wavelength, where the formula fails, or a length that is not above 0.
    """
    wavelength = _length(wavelength_m, "wavelength_m")
    sides = _length(width_m, "width_m"), _length(height_m, "height_m")
    if min(sides) < wavelength:
        raise MitsonarError(
            f"a rectangle's sides must be at least one wavelength, {wavelength:g} m: got {min(sides):g} m; "
            "line_directivity_db takes every length"
        )
    return 10.0 * math.log10(4 * math.pi * sides[0] * sides[1] / wavelength**2)


# ---------------------------------------------------------------- helpers


def _library(value: AnyArray) -> AnyArray:
    """Return the array library of a value; NumPy for numbers."""
    return array_namespace(np.zeros(0)) if isinstance(value, int | float) else array_namespace(value)


def _band_db(bandwidth_hz: float, directivity_index_db: float) -> float:
    """Return what a band and a directivity add to a spectrum [dB]."""
    return 10.0 * math.log10(_length(bandwidth_hz, "bandwidth_hz")) - directivity_index_db


def _length(value: float, name: str) -> float:
    """Check that a number is finite and above 0."""
    if not 0 < value < math.inf:
        raise MitsonarError(f"{argument(name)} must be a finite number above 0: got {short_repr(value)}")
    return float(value)
