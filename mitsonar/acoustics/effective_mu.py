"""Materials as rays read them: the reflectivity, Lambert's mu, that scatters as much at a ray's angle.

A surface of cross-section sigma at the grazing angle g has the effective reflectivity C = sigma / sin^2 g. A ray then needs
one number, whatever the law is. The sine of the grazing angle is the cosine of incidence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.backscatter import GRAZING_DEG, Material, band_warning, sigma_table

__all__ = [
    "FLATTEST",
    "MuTable",
    "depends_on_frequency",
    "hearing_notes",
    "mu_at",
    "mu_table",
    "normal_mu",
    "reference_hz",
    "single_mu",
]

FLATTEST = 1e-3
"""Sine of the flattest grazing angle that a law is asked for; flatter, its reflectivity stays what it is there."""

POWERS = {"lambert": 2, "lommel-seeliger": 1, "rough-fluid": 2, "table": 0}
"""Power of the sine that is taken out of each law's table, so that what is left is smooth between whole degrees."""

UNBOUNDED_HZ = 100e3
"""Frequency at which a material without a band is taken where the sonar has none [Hz]."""


class MuTable(NamedTuple):
    """A law as ``C = value sin^(power - 2)``, linear between whole degrees.

    Attributes:
        values: at grazing angles of 0, 1 ... 90 deg ``(91,)``.
        power: of the sine that was taken out of the cross-sections.
    """

    values: NDArray[np.float64]
    power: int


def mu_table(material: Material, frequency_hz: float, sound_speed_m_s: float = 1500.0) -> MuTable:
    """Compute the table of a material's effective reflectivity [1/sr].

    A law ``lambert`` is constant, exactly. Between whole degrees a ``table`` is linear in sigma, as ``sigma_at`` is;
    ``rough-fluid`` is linear in C, which meets the law within 2 % from 5 deg on, and 12 % at 1.5 deg.

    Args:
        material: the material.
        frequency_hz: of the carrier.
        sound_speed_m_s: in the water.

    Raises:
        MitsonarError: a frequency or speed that is not above 0.
    """
    power = POWERS[material.law]
    sigma = sigma_table(material, frequency_hz, sound_speed_m_s)
    sine = np.sin(np.radians(GRAZING_DEG))
    values = sigma.copy()
    if power:
        values[1:] = sigma[1:] / sine[1:] ** power
        values[0] = max(0.0, 2 * values[1] - values[2])
    return MuTable(values, power)


def mu_at(table: MuTable, cosine: ArrayLike) -> NDArray[np.float64]:
    """Compute the effective reflectivity at angles of incidence, as rays read it, in float64.

    It is bounded by 1 / cosine, or a sonar's sums could overflow: cross-sections above the cosine are clipped to it.

    Args:
        table: of :func:`mu_table`.
        cosine: of the angle between ray and normal ``(...)``, 0..1; at least :data:`FLATTEST` counts.
    """
    given = np.asarray(cosine, dtype=np.float64)
    steep = np.maximum(given, FLATTEST)
    degrees = np.degrees(np.arcsin(np.minimum(given, 1.0)))
    law = np.interp(degrees, GRAZING_DEG, table.values) * steep ** (table.power - 2)
    return np.asarray(np.minimum(law, 1 / steep))


def single_mu(material: Material, frequency_hz: float | None = None, sound_speed_m_s: float = 1500.0) -> float:
    """Return one reflectivity for all angles: mu of the law ``lambert``, else sigma / sin^2 at 45 deg of grazing [1/sr].

    Impulse responses use it. A mirror part is not taken off.

    Args:
        material: the material.
        frequency_hz: of the carrier; default: :func:`reference_hz`.
        sound_speed_m_s: in the water.
    """
    if material.law == "lambert" and material.mu is not None:
        return material.mu
    frequency = reference_hz(material) if frequency_hz is None else frequency_hz
    return 2 * float(sigma_table(material, frequency, sound_speed_m_s)[45])


def normal_mu(material: Material, frequency_hz: float, sound_speed_m_s: float = 1500.0) -> float:
    """Return the reflectivity of the model ``thesis``: the law's mu, or sigma at normal incidence without one [1/sr]."""
    return float(sigma_table(material, frequency_hz, sound_speed_m_s)[90]) if material.mu is None else material.mu


def reference_hz(material: Material) -> float:
    """Return the frequency at which a material is taken where none is given: the middle of its band, or its only end."""
    low, high = material.band_hz
    if low and math.isfinite(high):
        return math.sqrt(low * high)
    return low or (high if math.isfinite(high) else UNBOUNDED_HZ)


def depends_on_frequency(material: Material) -> bool:
    """Return whether a material's cross-section depends on the frequency."""
    return material.law == "rough-fluid" or material.has_mirror


def hearing_notes(materials: Sequence[Material], frequency_hz: float | None, sound_speed_m_s: float = 1500.0) -> list[str]:
    """Say in a sentence each what a user should know about materials at a sonar's frequency.

    They are: a frequency that is not given, one outside a material's band, and cross-sections that are clipped.

    Args:
        materials: of a scene.
        frequency_hz: of the sonar; None where it has none.
        sound_speed_m_s: in the water.
    """
    notes = []
    for one in materials:
        if frequency_hz is None and depends_on_frequency(one):
            notes.append(
                f"the sonar has no frequency_hz: material {one.name} is taken at {reference_hz(one) / 1000:,.4g} kHz; give "
                "the sonar its carrier"
            )
        warning = None if frequency_hz is None else band_warning(one, frequency_hz)
        notes += [warning] if warning else []
        sigma = sigma_table(one, frequency_hz or reference_hz(one), sound_speed_m_s)
        above = np.flatnonzero(sigma[1:] > np.sin(np.radians(GRAZING_DEG[1:])) * (1 + 1e-9)) + 1
        if len(above):
            notes.append(
                f"material {one.name} scatters more than sonars can sum: sigma above the sine of the grazing angle is "
                f"clipped to it, from {above[0]} to {above[-1]} deg"
            )
    return notes
