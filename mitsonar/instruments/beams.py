"""Compute the beam patterns of line apertures and the shapes of compressed pulses.

The amplitude pattern is a function of the sine of the angle. It depends on the shading, on one-way or two-way use, and on
the focus. The pattern of a cosine-series shading is a sum of shifted sincs (Harris 1978, Proc. IEEE 66:51; Taylor 1955, IRE
Trans. AP-3:16), so one list of coefficients represents any of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["SHADINGS", "Aperture", "Pattern", "Pulse", "Shading", "half_power", "series", "shaded_sinc"]


Shading = Literal["uniform", "hann", "hamming", "taylor"]
Pattern = Literal["box", "receive", "two_way"]
"""Box with hard edges; pattern of the receiving array; pattern of an array that both transmits and receives."""

SHADINGS: tuple[str, ...] = get_args(Shading)

TAYLOR_LOBES, TAYLOR_DB = 4, 30.0
"""Parameters of the Taylor shading: three side lobes next to the main lobe, at about -30 dB."""

FOCUS_PARTS = 257
"""Number of elements that sample an aperture out of focus."""


@cache
def series(shading: Shading) -> tuple[float, ...]:
    """Return the coefficients F_m, m = 1, 2 ..., of the terms sinc(x - m) + sinc(x + m) that are added to sinc(x)."""
    match shading:
        case "uniform":
            return ()
        case "hann":
            return (0.5,)
        case "hamming":
            return (0.23 / 0.54,)
        case "taylor":
            return _taylor(TAYLOR_LOBES, TAYLOR_DB)


def _taylor(lobes: int, side_db: float) -> tuple[float, ...]:
    """Compute Taylor's coefficients for ``lobes`` - 1 side lobes at ``-side_db``."""
    a = math.acosh(10 ** (side_db / 20)) / math.pi
    stretch = lobes**2 / (a * a + (lobes - 0.5) ** 2)
    coefficients = []
    for m in range(1, lobes):
        top = math.prod(1 - m * m / (stretch * (a * a + (n - 0.5) ** 2)) for n in range(1, lobes))
        bottom = 2 * math.prod(1 - m * m / (n * n) for n in range(1, lobes) if n != m)
        coefficients.append(-((-1) ** m) * top / bottom)
    return tuple(coefficients)


def shaded_sinc(x: ArrayLike, coefficients: tuple[float, ...]) -> NDArray[np.float64]:
    """Evaluate sinc(x) + sum F_m (sinc(x - m) + sinc(x + m)); 1 at x = 0."""
    x = np.asarray(x, dtype=float)
    total = np.sinc(x)
    for m, part in enumerate(coefficients, 1):
        total = total + part * (np.sinc(x - m) + np.sinc(x + m))
    return np.asarray(total, dtype=np.float64)


@cache
def half_power(coefficients: tuple[float, ...], power: int) -> float:
    """Find the x at which the pattern to the ``power``-th is one half; use 2 for one-way, 4 for two-way patterns."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        if abs(float(shaded_sinc(middle, coefficients))) ** power > 0.5:
            low = middle
        else:
            high = middle
    return low


@dataclass(frozen=True)
class Aperture:
    """A line aperture, defined by the width of its beam.

    Attributes:
        width: full beam width at half power, as a difference of sines of the angle.
        shading: amplitude weighting over the aperture.
        two_way: whether the array both transmits and receives, so that the pattern is squared.
    """

    width: float
    shading: Shading = "hann"
    two_way: bool = True

    @cached_property
    def length(self) -> float:
        """Return the length of the aperture [wavelengths]."""
        return 2 * half_power(series(self.shading), 4 if self.two_way else 2) / self.width

    def pattern(self, u: ArrayLike) -> NDArray[np.float64]:
        """Return the amplitude at a sine of the angle ``u`` from the axis, of the same shape; 1 on the axis."""
        one_way = shaded_sinc(np.asarray(u, dtype=float) * self.length, series(self.shading))
        return one_way * one_way if self.two_way else one_way

    def defocused(self, u: ArrayLike, curvature: float, wavelength: float) -> NDArray[np.complex128]:
        """Return the complex pattern of an aperture focused at another range, in the Fresnel approximation.

        Args:
            u: sine of the angle from the axis ``(...)``.
            curvature: 1 / range - 1 / focal range [1/m].
            wavelength: wavelength [m].

        Returns:
            Amplitude ``(...)``; equal to the pattern for a curvature of 0.
        """
        x = (np.arange(FOCUS_PARTS) + 0.5) / FOCUS_PARTS - 0.5  # position along the aperture, relative to its length
        # Shading as a cosine series.
        weight = np.full(FOCUS_PARTS, 1 / FOCUS_PARTS)
        for m, part in enumerate(series(self.shading), 1):
            weight = weight + 2 * part / FOCUS_PARTS * np.cos(2 * math.pi * m * x)
        # Quadratic phase of the wavefront curvature, then the sum over the elements in each direction.
        bend = math.pi * (self.length * x) ** 2 * wavelength * curvature
        u = np.asarray(u, dtype=float)
        steer = np.exp(-2j * math.pi * self.length * u[..., None] * x)
        one_way = (steer * (weight * np.exp(-1j * bend))).sum(axis=-1)
        return np.asarray(one_way * one_way if self.two_way else one_way, dtype=np.complex128)

    @cached_property
    def equivalent_width(self) -> float:
        """Return the integral of the squared amplitude over u, which is the width of a box of equal energy."""
        u = np.linspace(-40, 40, 400_001) / self.length
        return float(np.trapezoid(self.pattern(u) ** 2, u))

    def reach(self, below_db: float) -> float:
        """Return the smallest u beyond which no lobe exceeds ``-below_db`` relative to the axis; at most 40 / length."""
        u = np.linspace(0, 40, 40_001) / self.length
        loud = np.flatnonzero(np.abs(self.pattern(u)) > 10 ** (-below_db / 20))
        return float(u[loud[-1]])


# ---------------- Compressed pulses


HANN = series("hann")


@dataclass(frozen=True)
class Pulse:
    """A pulse after its matched filter, with a Hann-weighted spectrum: side lobes of -31 dB or less.

    Attributes:
        resolution_m: full range width at half power [m].
    """

    resolution_m: float

    @classmethod
    def of_band(cls, bandwidth_hz: float, sound_speed: float) -> Pulse:
        """Return the pulse that occupies a bandwidth.

        Its width is 1.44 c / 2B, from the pattern of the window at x = B times the delay 2 r / c.
        """
        return cls(half_power(HANN, 2) * sound_speed / bandwidth_hz)

    def bandwidth_hz(self, sound_speed: float) -> float:
        """Return the bandwidth that the pulse occupies [Hz], the inverse of :meth:`of_band`."""
        return half_power(HANN, 2) * sound_speed / self.resolution_m

    def shape(self, r: ArrayLike) -> NDArray[np.float64]:
        """Return the amplitude at a range offset ``r`` [m] from the echo, of the same shape; 1 at 0."""
        return shaded_sinc(np.asarray(r, dtype=float) * (2 * half_power(HANN, 2) / self.resolution_m), HANN)

    @cached_property
    def equivalent_m(self) -> float:
        """Return the integral of the squared amplitude over range [m], which is the length of a box of equal energy."""
        r = np.linspace(-20, 20, 200_001) * self.resolution_m
        return float(np.trapezoid(self.shape(r) ** 2, r))
