"""Target strength of an elastic sphere by partial waves: the measured standard of sonars, for tests of mirrors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import spherical_jn, spherical_yn


class Sphere(NamedTuple):
    """An elastic sphere: radius [m], density [kg/m3], speeds of its longitudinal and transverse waves [m/s]."""

    radius: float
    density: float
    longitudinal: float
    transverse: float

    def reflection(self, density: float, sound_speed: float) -> float:
        """Return the reflection coefficient of a plane of its material in water, at normal incidence."""
        solid, water = self.density * self.longitudinal, density * sound_speed
        return (solid - water) / (solid + water)


CARBIDE = Sphere(0.01905, 14_900.0, 6853.0, 4171.0)
"""Calibration sphere of 38.1 mm: tungsten carbide with 6 % cobalt, as spherets has it."""


def length_at(
    sphere: Sphere, frequency_hz: ArrayLike, density: float = 1025.0, sound_speed: float = 1490.0
) -> NDArray[np.complex128]:
    """Compute the complex length ``(n,)`` [m] whose square is the backscattering cross-section; a / 2 where large and rigid.

    MacLennan, The Theory of Solid Spheres as Sonar Calibration Targets, Scottish Fisheries Research Report 22 (1981), as in
    the packages spherets and echosms. The phase refers to the sphere's centre, of exp(+i k r).
    """
    q = 2 * np.pi * np.atleast_1d(np.asarray(frequency_hz, dtype=float)) * sphere.radius / sound_speed
    q1, q2 = q * sound_speed / sphere.longitudinal, q * sound_speed / sphere.transverse
    alpha = 2 * (sphere.density / density) * (sphere.transverse / sound_speed) ** 2
    beta = (sphere.density / density) * (sphere.longitudinal / sound_speed) ** 2 - alpha
    total = np.zeros(len(q), dtype=complex)
    for n in range(int(q.max() + 4 * q.max() ** (1 / 3)) + 12):
        j, j1, j2 = (spherical_jn(n, x) for x in (q, q1, q2))
        slope, slope1, slope2 = (spherical_jn(n, x, True) for x in (q, q1, q2))
        bend1, bend2 = (-2 / x * dj - (1 - n * (n + 1) / x**2) * jn for x, jn, dj in ((q1, j1, slope1), (q2, j2, slope2)))
        a2 = (n * n + n - 2) * j2 + q2**2 * bend2
        a1 = 2 * n * (n + 1) * (q1 * slope1 - j1)
        b2 = a2 * q1**2 * (beta * j1 - alpha * bend1) - a1 * alpha * (j2 - q2 * slope2)
        b1 = q * (a2 * q1 * slope1 - a1 * j2)
        above = b2 * slope - b1 * j
        below = b2 * spherical_yn(n, q, True) - b1 * spherical_yn(n, q)
        safe = np.isfinite(below) & (below != 0)  # where functions of high order underflow the term vanishes
        phase = np.arctan(np.divide(-above, below, out=np.zeros_like(q), where=safe))
        total += (-1) ** n * (2 * n + 1) * np.sin(phase) * np.exp(1j * phase)
    return np.asarray(-total / q * sphere.radius)


def strength(lengths: NDArray[np.complex128]) -> float:
    """Return the target strength of a mean over a band [dB re 1 m2]."""
    return float(10 * np.log10(np.mean(np.abs(lengths) ** 2)))
