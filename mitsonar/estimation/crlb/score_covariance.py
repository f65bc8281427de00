"""How scores of neighbouring cells covary, since array and pulse spread echoes and noise over some of them.

The information of n correlated values about a motion is J' W^1/2 C^-1 W^1/2 J: J how they change with it, W what each
tells, C the covariance of their standardised scores. It is what the best weighted sum of the scores can use. Parts of C are
products of a correlation over bins and one over beams.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mitsonar.errors import MitsonarError

__all__ = ["CellCorrelation", "ScoreCovariance"]

Complex = NDArray[np.complex128]
Floats = NDArray[np.float64]

TOLERANCE, MOST_STEPS = 1e-5, 2000
"""Relative residual at which the conjugate gradients end, and their steps at most."""


@dataclass(frozen=True)
class CellCorrelation:
    """The correlation of two cells: that of their bins times that of their beams.

    Attributes:
        over_bins: ``(bins, bins)``.
        over_beams: ``(beams, beams)``.
    """

    over_bins: csr_array[Any, Any]
    over_beams: Floats

    def __mul__(self, other: CellCorrelation) -> CellCorrelation:
        """Multiply cell by cell."""
        return CellCorrelation(csr_array(self.over_bins.multiply(other.over_bins)), self.over_beams * other.over_beams)

    def __matmul__(self, image: NDArray[Any]) -> NDArray[Any]:
        """Apply to an image ``(bins, beams)``."""
        return np.asarray((self.over_bins @ image) @ self.over_beams.T)


@dataclass(frozen=True)
class ScoreCovariance:
    """Covariance of the standardised scores of all cells: sums of Re(w_i* R_ij w_j), and a part that no two cells share.

    Attributes:
        parts: weights w ``(bins, beams)`` with the correlation R.
        own: variance that no two cells share ``(bins, beams)``, so that all have variance 1.
    """

    parts: list[tuple[NDArray[Any], CellCorrelation]]
    own: Floats

    @classmethod
    def of(cls, parts: list[tuple[NDArray[Any], CellCorrelation]], shape: tuple[int, int]) -> ScoreCovariance:
        """Add the part that makes all variances 1.

        Args:
            parts: see the attribute.
            shape: bins and beams.
        """
        shared = sum((np.abs(weight) ** 2 for weight, _ in parts), np.zeros(shape))
        return cls(parts, np.maximum(1 - shared, 1e-6))

    def __matmul__(self, values: Floats) -> Floats:
        """Apply to maps ``(k, bins, beams)``."""
        found = self.own * values
        for weight, correlation in self.parts:
            for total, one in zip(found, values, strict=True):
                total += (np.conj(weight) * (correlation @ (weight * one))).real
        return found

    def solve(self, values: Floats) -> Floats:
        """Return C^-1 of maps ``(k, bins, beams)``, by conjugate gradients.

        Raises:
            MitsonarError: they do not converge.
        """
        found, rest = np.zeros_like(values), values.copy()
        way, size = rest.copy(), np.einsum("kij,kij->k", rest, rest)
        goal = TOLERANCE**2 * size
        for _ in range(MOST_STEPS):
            if (size <= goal).all():
                return found
            spread = self @ way
            along = np.einsum("kij,kij->k", way, spread)
            step = np.divide(size, along, out=np.zeros_like(size), where=along > 0)[:, None, None]
            found += step * way
            rest -= step * spread
            before, size = size, np.einsum("kij,kij->k", rest, rest)
            way = rest + np.divide(size, before, out=np.zeros_like(size), where=before > 0)[:, None, None] * way
        raise MitsonarError("the covariance of the cells cannot be inverted: give beams nearer to the width of the spacing")
