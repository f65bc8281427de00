"""Levels: what an echo contributes to its bins."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mitsonar.instruments.imaging_sonar import Sonar

if TYPE_CHECKING:
    from mitsonar.records.echoes import Echoes

__all__ = ["largest_level", "level"]


def level(echoes: Echoes, sonar: Sonar, where: Any) -> Any:
    """Level of each echo, float64, with plain IEEE products so that NumPy and Dr.Jit agree to the bit.

    ``thesis``: C L, reflectivity times cosine (Almanza-Medina, eq. 2.2). ``physical``, monostatic: C cos(theta) dOmega
    / R^2 times the gain law R^g [sr/m^2]: spreading 1/R^4 there and back, Lambert's cosine squared, and the lit area
    dA = R^2 dOmega / cos(theta), which takes one cosine away again. The law is held nearer than the window or one bin,
    and beyond four times the window's end (where only a footprint's tail can reach it).

    Args:
        echoes: arrays of float64.
        sonar: the instrument.
        where: ``where(condition, a, b)`` of the arrays' library.
    """
    lambert = echoes.reflectivity * echoes.cosine
    if sonar.model == "thesis":
        return lambert
    nearest, farthest = _ends(sonar)
    radius = where(echoes.range_m > nearest, where(echoes.range_m < farthest, echoes.range_m, farthest), nearest)
    return lambert * echoes.solid_angle_sr * _spreading(radius, sonar.gain_exponent)


def largest_level(sonar: Sonar, solid_angle: float) -> float:
    """The most that one ray can contribute, ``solid_angle`` [sr] being the largest of a cell."""
    if sonar.model == "thesis":
        return 1.0
    return max(_spreading(end, sonar.gain_exponent) for end in _ends(sonar)) * solid_angle


def _ends(sonar: Sonar) -> tuple[float, float]:
    """Where the law of spreading and gain begins and ends to hold [m]."""
    nearest = max(sonar.range_min, sonar.bin_m)
    return nearest, max(4 * sonar.range_max, nearest)


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
