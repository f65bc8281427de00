"""One realisation of a sea: Gaussian heights on a grid at a time, of a spectrum and a seed.

Waves of the grid's own wave vectors are summed by an FFT. The innermost 9 x 9 of these vectors, among them what is longer
than the grid, are divided in three in each direction, again and again, until the rest has no energy. So long swells heave
and tilt a small patch, and nothing repeats within it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.worlds.wave_spectrum import WaveSpectrum, spreading
from mitsonar.worlds.world import stream

__all__ = ["SHORTEST", "Sea", "wave_heights"]

SHORTEST = 4
"""Steps of the grid in the shortest wave that it holds."""

INNER = 4
"""Wave vectors of up to this index along both axes are divided."""

CALM = 0.4
"""No wave vector below this part of the peak's is divided further: it has 1e-20 of the variance."""


class Sea(NamedTuple):
    """What the waves are like.

    Attributes:
        spectrum: of the heights.
        towards_rad: where the wind blows to, from +y towards +x [rad].
        spread: exponent s of :func:`~mitsonar.worlds.wave_spectrum.spreading`.
    """

    spectrum: WaveSpectrum
    towards_rad: float
    spread: float


class _Waves(NamedTuple):
    """Waves of a square lattice of wave vectors: x and y of the vectors ``(n,)`` [rad/m], and the lattice's step."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    step: float


def wave_heights(sea: Sea, count: int, step_m: float, seed: int, time_s: float) -> NDArray[np.float64]:
    """Return heights on a square grid whose middle is the origin ``(count, count)``, y first [m].

    Waves from :data:`SHORTEST` steps on are there. Their amplitudes are functions of the seed, so surfaces of one seed at
    several times belong to one sea.

    Args:
        sea: the waves.
        count: points along an edge.
        step_m: of the grid [m].
        seed: of the amplitudes.
        time_s: the time [s].
    """
    points = _smooth(count)
    lattice = 2 * math.pi / (points * step_m)
    index = np.rint(np.fft.fftfreq(points) * points)
    rows, columns = np.nonzero(
        ((np.abs(index)[:, None] > INNER) | (np.abs(index) > INNER))
        & (lattice * np.hypot(index[:, None], index) <= 2 * math.pi / (SHORTEST * step_m))
    )
    own = _Waves(index[columns] * lattice, index[rows] * lattice, lattice)
    values = np.zeros((points, points), np.complex128)
    values[rows, columns] = _amplitudes(sea, own, seed, 0, time_s)
    heights = (np.fft.ifft2(values) * points**2).real[:count, :count]
    place = np.arange(count) * step_m
    for number, waves in enumerate(_long_waves(sea, lattice, step_m), 1):
        amplitude = _amplitudes(sea, waves, seed, number, time_s)
        along = np.exp(1j * np.outer(place, waves.y)) * amplitude
        heights = heights + (along @ np.exp(1j * np.outer(waves.x, place))).real
    return np.asarray(heights)


def _long_waves(sea: Sea, lattice: float, step_m: float) -> list[_Waves]:
    """Return the waves within the innermost vectors of a lattice, in ever finer lattices."""
    calm = CALM * sea.spectrum.wavenumber(sea.spectrum.peak_rad_s)
    found = []
    outer = 3 * INNER + 1
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(-outer, outer + 1.0)] * 2))
    ring = np.maximum(np.abs(x), np.abs(y)) > INNER
    shortest = 2 * math.pi / (SHORTEST * step_m)
    while lattice * (INNER + 0.5) > calm:
        lattice /= 3
        kept = ring & (lattice * np.hypot(x, y) <= shortest)
        found.append(_Waves(x[kept] * lattice, y[kept] * lattice, lattice))
    return found


def _amplitudes(sea: Sea, waves: _Waves, seed: int, number: int, time_s: float) -> NDArray[np.complex128]:
    """Return the complex amplitudes of waves at a time ``(n,)`` [m]: Gaussian numbers of the seed, of their own variance."""
    wavenumber = np.hypot(waves.x, waves.y)
    rng = stream(seed, 1, number)
    # by Box and Muller: of the generator only the plain doubles are used, whose bits do not change
    length, turn = np.sqrt(-2 * np.log(1 - rng.random(len(wavenumber)))), 2 * np.pi * rng.random(len(wavenumber))
    turn -= sea.spectrum.frequency(wavenumber) * time_s
    return np.asarray(np.sqrt(_variance(sea, waves)) * length * np.exp(1j * turn))


def _variance(sea: Sea, waves: _Waves) -> NDArray[np.float64]:
    """Return the variance of each cell of a lattice of wave vectors ``(n,)`` [m^2], by Gauss' rule of four points."""
    total = np.zeros(len(waves.x))
    aside = waves.step / math.sqrt(12)
    for right in (-aside, aside):
        for up in (-aside, aside):
            x, y = waves.x + right, waves.y + up
            wavenumber = np.hypot(x, y)
            share = spreading(np.arctan2(x, y) - sea.towards_rad, sea.spread)
            total += sea.spectrum.density_of_wavenumber(wavenumber) / wavenumber * share
    return total / 4 * waves.step**2


def _smooth(count: int) -> int:
    """Return the least number of at least ``count`` that 2, 3 and 5 divide away: its FFT is fast."""
    while True:
        rest = count
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return count
        count += 1
