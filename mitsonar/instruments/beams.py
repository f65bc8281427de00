"""Compute the beam patterns of line apertures and the shapes of compressed pulses.

The amplitude pattern is a function of the sine of the angle. It depends on the shading, on one-way or two-way use, and on
the focus. The pattern of a cosine-series shading is a sum of shifted sincs (Harris 1978, Proc. IEEE 66:51; Taylor 1955, IRE
Trans. AP-3:16), so one list of coefficients represents any of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["SHADINGS", "Aperture", "Pattern", "Pulse", "Shading", "Spectrum", "half_power", "series", "shaded_sinc"]


Shading = Literal["uniform", "hann", "hamming", "taylor"]
Pattern = Literal["box", "receive", "two_way"]
"""Box with hard edges; pattern of the receiving array; pattern of an array that both transmits and receives."""

SHADINGS: tuple[str, ...] = get_args(Shading)

TAYLOR_LOBES, TAYLOR_DB = 4, 30.0
"""Parameters of the Taylor shading: three side lobes next to the main lobe, at about -30 dB."""

SAMPLES, SAMPLES_A_WAVELENGTH = 257, 8
"""Number of samples of an aperture or a band, at least, and per wavelength."""

ELEMENTS_A_WAVELENGTH, ARRAY = 2, 0x61727279
"""Number of elements of an array per wavelength, and the salt of the seed of their errors."""


class Spectrum(NamedTuple):
    """Amplitudes of the waves that add up to a pattern or pulse: the sum of weight exp(2 j pi frequency x) at an offset x.

    Attributes:
        frequency: evenly spaced ``(n,)``, in the inverse unit of the offset.
        weight: complex amplitudes ``(n,)``.
    """

    frequency: NDArray[np.float64]
    weight: NDArray[np.complex128]

    def at(self, offset: ArrayLike) -> NDArray[np.complex128]:
        """Return the sum at some offsets, of the same shape."""
        return np.asarray(np.exp(2j * math.pi * np.asarray(offset, dtype=float)[..., None] * self.frequency) @ self.weight)

    def coherence(self, offset: ArrayLike) -> NDArray[np.float64]:
        """Return the correlation of white noise that has passed it, at some distances, of the same shape."""
        power = Spectrum(self.frequency, np.square(np.abs(self.weight)).astype(complex))
        return np.asarray(power.at(offset).real / power.weight.real.sum(), dtype=np.float64)


def _shaded(x: NDArray[np.float64], coefficients: tuple[float, ...]) -> NDArray[np.complex128]:
    """Return a cosine series at places -0.5..0.5 ``(n,)``, such that its sum is 1."""
    waves = [part * 2 * np.cos(2 * math.pi * m * x) for m, part in enumerate(coefficients, 1)]
    return np.asarray((1 + sum(waves, np.zeros(len(x)))) / len(x), dtype=np.complex128)


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
        error: rms error of its elements, complex and relative to their amplitude. Elements half a wavelength apart with
            weights w, whose sum is 1, give lobes of a mean power of error^2 sum w^2 at all angles.
        seed: seed of these errors.
    """

    width: float
    shading: Shading = "hann"
    two_way: bool = True
    error: float = 0.0
    seed: int = 0

    @cached_property
    def length(self) -> float:
        """Return the length of the aperture [wavelengths]."""
        return 2 * half_power(series(self.shading), 4 if self.two_way else 2) / self.width

    def pattern(self, u: ArrayLike) -> NDArray[np.float64]:
        """Return the amplitude at a sine of the angle ``u`` from the axis, same shape; 1 on the axis; without errors."""
        one_way = shaded_sinc(np.asarray(u, dtype=float) * self.length, series(self.shading))
        return one_way * one_way if self.two_way else one_way

    def elements(self, bend: float = 0.0) -> Spectrum:
        """Return positions along the aperture [wavelengths] and the amplitudes of its elements, out of focus by ``bend``.

        Args:
            bend: wavelength times (1 / range - 1 / focal range), in the Fresnel approximation; 0 in focus.
        """
        size = max(SAMPLES, math.ceil(SAMPLES_A_WAVELENGTH * self.length))
        x = (np.arange(size) + 0.5) / size - 0.5  # position along the aperture, relative to its length
        curvature = np.exp(-1j * math.pi * (self.length * x) ** 2 * bend)
        weight = _shaded(x, series(self.shading)) * curvature
        if self.error > 0:
            elements = math.ceil(ELEMENTS_A_WAVELENGTH * self.length)
            real, imag = np.random.default_rng([abs(self.seed), ARRAY]).normal(0, self.error / math.sqrt(2), (2, elements))
            weight *= 1 + (real + 1j * imag)[((x + 0.5) * elements).astype(int)]
        return Spectrum(self.length * x, weight)

    def spectrum(self, bend: float = 0.0) -> Spectrum:
        """Return the waves that add up to the pattern: those of :meth:`elements`, convolved with themselves if two-way."""
        place, weight = one_way = self.elements(bend)
        if not self.two_way:
            return one_way
        return Spectrum(2 * np.linspace(place[0], place[-1], 2 * len(place) - 1), np.convolve(weight, weight))

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

    @property
    def lobes_per_m(self) -> float:
        """Return the bandwidth as waves per metre of range; its inverse is the spacing of the pulse's zeros [1/m]."""
        return 2 * half_power(HANN, 2) / self.resolution_m

    def shape(self, r: ArrayLike) -> NDArray[np.float64]:
        """Return the amplitude at a range offset ``r`` [m] from the echo, of the same shape; 1 at 0."""
        return shaded_sinc(np.asarray(r, dtype=float) * self.lobes_per_m, HANN)

    def spectrum(self) -> Spectrum:
        """Return the waves over range [1/m] that add up to the pulse, and their amplitudes."""
        x = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
        return Spectrum(self.lobes_per_m * x, _shaded(x, HANN))

    @cached_property
    def equivalent_m(self) -> float:
        """Return the integral of the squared amplitude over range [m], which is the length of a box of equal energy."""
        r = np.linspace(-20, 20, 200_001) * self.resolution_m
        return float(np.trapezoid(self.shape(r) ** 2, r))
