"""Level of an echo: its contribution to its bins.

The reflectivity C is Lambert's mu, what is scattered into a steradian: C = 1 scatters pi times what arrives, and a body that
reflects all has C = 1 / pi.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from mitsonar.arrays import AnyArray
from mitsonar.instruments.sonar import Sonar

__all__ = ["LevelParts", "largest_level", "level"]


class LevelParts(Protocol):
    """What a level is made of."""

    @property
    def reflectivity(self) -> AnyArray:
        """Lambert's mu."""

    @property
    def cosine(self) -> AnyArray:
        """Of the angle between ray and normal."""

    @property
    def solid_angle_sr(self) -> AnyArray:
        """Of the ray's cell [sr]."""

    @property
    def range_m(self) -> AnyArray:
        """To the surface [m]."""


def level(echoes: LevelParts, sonar: Sonar, where: Callable[..., AnyArray]) -> AnyArray:
    """Compute the level of each echo, float64, by plain IEEE products: NumPy and Dr.Jit agree to the bit.

    ``thesis``: C L, reflectivity times cosine (Almanza-Medina, eq. 2.2).

    ``physical``, monostatic: C cos(theta) dOmega / R^2 times the gain R^g [sr/m^2]. The factors are spreading 1/R^4 there
    and back, Lambert's law C cos^2(theta), and the lit area dA = R^2 dOmega / cos(theta), which cancels one cosine. C is
    Lambert's mu [1/sr]. The gain g = 2 undoes the spreading of one way, g = 4 that of both. R is clamped below to the
    window's begin or one bin, and above to four times the window's end, where only a footprint's tail reaches.

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
    """Return the largest level of one ray; ``solid_angle`` [sr] is the largest of a cell."""
    if sonar.model == "thesis":
        return 1.0
    largest: float = max(_spreading(end, sonar.gain_exponent) for end in _ends(sonar))
    return largest * solid_angle


def _ends(sonar: Sonar) -> tuple[float, float]:
    """Return the least and the greatest range of spreading and gain [m]."""
    nearest = max(sonar.range_min, sonar.bin_m)
    return nearest, max(4 * sonar.range_max, nearest)


def _spreading(radius: AnyArray, gain_exponent: int) -> AnyArray:
    """Compute R^(g - 2) by products, not powers."""
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
