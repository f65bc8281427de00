"""What the water takes from a sonar's echoes, and what the sonar's gain gives back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.sea_water import Water, absorption_db_per_m, absorption_warning
from mitsonar.instruments.sonar import Sonar

__all__ = [
    "absorption_line",
    "gain_of",
    "loss_notes",
    "loss_of",
    "noise_of",
    "sonar_absorption",
    "undone_absorption",
    "water_of",
]


EXTRAPOLATED_HZ = 1e6
"""Carrier above which the formula extrapolates by the viscosity of pure water."""


def water_of(sonar: Sonar) -> Water:
    """Return the water around a sonar.

    Raises:
        MitsonarError: no such water.
    """
    return Water.create(
        temperature_c=sonar.temperature_c, salinity_psu=sonar.salinity_psu, depth_m=sonar.water_depth_m, ph=sonar.ph
    )


def sonar_absorption(sonar: Sonar) -> float:
    """Return the absorption one way [dB/m]: as given; else by carrier and water; 0 with hard boxes (see Sonar.pattern)."""
    if sonar.absorption_db_per_m is not None:
        return sonar.absorption_db_per_m
    if sonar.beam_pattern == "box" or sonar.frequency_hz is None:
        return 0.0
    return float(absorption_db_per_m(sonar.frequency_hz, water_of(sonar)))


def loss_notes(sonar: Sonar) -> list[str]:
    """Return a sentence where carrier or water lie outside the band of the absorption's formula."""
    if sonar.absorption_db_per_m is not None or sonar.beam_pattern == "box" or sonar.frequency_hz is None:
        return []
    if sonar.frequency_hz > EXTRAPOLATED_HZ:  # so is that of every imaging sonar above 1 MHz: no warning, but a line
        return []
    note = absorption_warning(sonar.frequency_hz, water_of(sonar))
    return [] if note is None else [f"{note}; or give absorption_db_per_m"]


def absorption_line(sonar: Sonar) -> str | None:
    """Return a line on the absorption that follows from carrier and water; None where it is given or absent."""
    if sonar.absorption_db_per_m is not None or sonar.beam_pattern == "box" or sonar.frequency_hz is None:
        return None
    beyond = ", extrapolated: Francois and Garrison hold to 1 MHz" if sonar.frequency_hz > EXTRAPOLATED_HZ else ""
    return f"absorption at {sonar.frequency_hz / 1000:,.4g} kHz: {sonar_absorption(sonar):.3g} dB/m one way{beyond}"


def loss_of(sonar: Sonar) -> NDArray[np.float64]:
    """Return what absorption leaves of the intensity, there and back ``(bins,)``."""
    return np.asarray(10 ** (-2 * sonar_absorption(sonar) * sonar.range_m / 10), dtype=np.float64)


def undone_absorption(sonar: Sonar) -> NDArray[np.float64]:
    """Return the gain of intensities that undoes absorption ``(bins,)``, or ones."""
    return 1 / loss_of(sonar) if sonar.gain_absorption else np.ones(sonar.range_bins)


def gain_of(sonar: Sonar) -> NDArray[np.float64]:
    """Return the time-varying gain of intensities ``(bins,)``: R^gain_exponent, and absorption where it is undone."""
    return np.asarray(sonar.range_m**sonar.gain_exponent * undone_absorption(sonar), dtype=np.float64)


def noise_of(sonar: Sonar) -> NDArray[np.float64]:
    """Return the mean power of the receiver's noise in each bin, after the gain ``(bins,)``; 0 without noise.

    It is relative to the source, as echoes are. Glow near the sonar counts as that of a beam halfway from the middle.
    """
    if sonar.noise_level_db is None:
        return np.zeros(sonar.range_bins)
    glow = np.maximum(0.0, sonar.near_glow_db * (1 - sonar.range_m / sonar.near_glow_m))
    power = 10 ** ((sonar.noise_level_db - sonar.source_level_db + glow) / 10)
    return np.asarray(power * gain_of(sonar), dtype=np.float64)
