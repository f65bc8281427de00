"""Levels: what an echo contributes to its bins."""

from __future__ import annotations

from typing import Any

from mitsonar.simulation.echoes import Echoes
from mitsonar.sonar import Sonar

__all__ = ["largest_level", "level"]


def level(echoes: Echoes, sonar: Sonar, where: Any) -> Any:
    """Level of each echo, float64, with plain IEEE products so that NumPy and Dr.Jit agree to the bit.

    ``thesis``: C L, reflectivity times cosine (Almanza-Medina, eq. 2.2). ``physical``, monostatic: C cos(theta) dOmega
    / R^2 times the gain law R^g [sr/m^2]: spreading 1/R^4 there and back, Lambert's cosine squared, and the lit area
    dA = R^2 dOmega / cos(theta), which takes one cosine away again. Nearer than one bin the law is held.

    Args:
        echoes: arrays of float64.
        sonar: the instrument.
        where: ``where(condition, a, b)`` of the arrays' library.
    """
    lambert = echoes.reflectivity * echoes.cosine
    if sonar.model == "thesis":
        return lambert
    nearest = _nearest(sonar)
    radius = where(echoes.range_m > nearest, echoes.range_m, nearest)
    return lambert * echoes.solid_angle_sr * _spreading(radius, sonar.gain_exponent)


def largest_level(sonar: Sonar, solid_angle: float) -> float:
    """The most that one ray can contribute, ``solid_angle`` [sr] being the largest of a cell."""
    if sonar.model == "thesis":
        return 1.0
    ends = (_nearest(sonar), max(sonar.range_max, _nearest(sonar)))
    # a footprint that reaches into the window may be centred beyond it, where a rising gain law exceeds the end's
    beyond = 1.0 if sonar.gain_exponent <= 2 else 16.0
    return max(_spreading(end, sonar.gain_exponent) for end in ends) * solid_angle * beyond


def _nearest(sonar: Sonar) -> float:
    return max(sonar.range_min, sonar.bin_m)


def _spreading(radius: Any, gain_exponent: int) -> Any:
    """R^(g - 2) by products, not powers."""
    match gain_exponent:
        case 0:
            return 1 / (radius * radius)
        case 1:
            return 1 / radius
        case 2:
            return radius * 0 + 1
        case 3:
            return radius
        case _:
            return radius * radius
