"""Perlin's noise in plain NumPy, for reflectivities that are stored with a mesh: the same bits on every machine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["perlin_reflectivity"]

PERIOD = 256
OCTAVES = 2
CONTRAST = 1.5
BLOCK = 2**15  # points at a time: their data fit the cache
GRADIENTS = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if abs(x) + abs(y) + abs(z) == 2], dtype=float
)
"""The twelve edges of a cube: no sine is needed, so nothing depends on a machine's mathematics library."""


def perlin_reflectivity(
    places: NDArray[np.float64], cell_m: float, span: tuple[float, float], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Compute reflectivities by Perlin's noise (Improving Noise, 2002): two octaves, contrast 1.5.

    Args:
        places: points ``(n, 3)`` [m].
        cell_m: edge of a lattice cell of the first octave [m]; the lattice repeats after 256 cells.
        span: range of the reflectivity.
        rng: draws the lattice.

    Returns:
        One value for each point ``(n,)``.
    """
    order = np.argsort(rng.random(PERIOD)).astype(np.int16)
    kinds = (rng.random(PERIOD) * len(GRADIENTS)).astype(np.int16)
    total = np.zeros(len(places))
    for start in range(0, len(places), BLOCK):
        here = slice(start, start + BLOCK)
        for octave in range(OCTAVES):
            total[here] += 0.5**octave * _noise(places[here] / cell_m * 2**octave, order, kinds)
    level = np.clip(0.5 + 0.5 * CONTRAST * total / (2 - 0.5 ** (OCTAVES - 1)), 0, 1)
    low, high = span
    return low + (high - low) * level


def _noise(places: NDArray[np.float64], order: NDArray[np.int16], kinds: NDArray[np.int16]) -> NDArray[np.float64]:
    """Compute one octave, about -1..1, at ``places`` in lattice cells."""
    x, y, z = places.T
    corner = [np.floor(axis) for axis in (x, y, z)]
    inside = [axis - low for axis, low in zip((x, y, z), corner, strict=True)]
    ease = [t * t * t * (t * (t * 6 - 15) + 10) for t in inside]
    whole = [low.astype(np.int64) for low in corner]
    value = np.zeros(len(places))
    for dx in (0, 1):
        first = order[(whole[0] + dx) % PERIOD]
        across = ease[0] if dx else 1 - ease[0]
        for dy in (0, 1):
            second = order[(first + whole[1] + dy) % PERIOD]
            along = across * (ease[1] if dy else 1 - ease[1])
            for dz in (0, 1):
                gradient = GRADIENTS[kinds[(second + whole[2] + dz) % PERIOD]]
                ramp = (
                    gradient[:, 0] * (inside[0] - dx) + gradient[:, 1] * (inside[1] - dy) + gradient[:, 2] * (inside[2] - dz)
                )
                value += along * (ease[2] if dz else 1 - ease[2]) * ramp
    return value
