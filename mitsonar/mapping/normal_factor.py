"""Factor of the normal equations of a pose graph."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU, splu

from mitsonar.errors import MitsonarError

__all__ = ["NormalFactor"]

Array = NDArray[np.float64]


class NormalFactor(NamedTuple):
    """A factor of normal equations: of these with their unknowns in some order ``(unknowns,)``; None: in their own."""

    lower_upper: SuperLU
    order: NDArray[np.intp] | None = None

    @classmethod
    def of(cls, normal: csc_array, common: int = 0) -> Self:
        """Factor normal equations.

        Args:
            normal: the normal equations ``(unknowns, unknowns)``.
            common: so many unknowns, the last ones, are tied to most others, and are eliminated last. The search for a good
                order takes the square of the time with them.

        Raises:
            MitsonarError: they are singular.
        """
        size = normal.shape[0]
        try:
            if not common:
                return cls(_split(normal, "MMD_AT_PLUS_A"))
            own = size - common
            first = np.argsort(_split(csc_array(normal[:own, :own]), "MMD_AT_PLUS_A").perm_c)
            order = np.concatenate([first, np.arange(own, size)])
            return cls(_split(csc_array(normal[order][:, order]), "NATURAL"), order)
        except RuntimeError:
            raise MitsonarError(
                "some poses of the graph are tied by nothing: give motions between all consecutive poses"
            ) from None

    def solve(self, right: Array) -> Array:
        """Return the unknowns ``(unknowns,)`` or ``(unknowns, n)`` of which the normal equations make ``right``."""
        if self.order is None:
            return np.asarray(self.lower_upper.solve(right))
        found = np.empty_like(right)
        found[self.order] = self.lower_upper.solve(right[self.order])
        return found


def _split(normal: csc_array, order: str) -> SuperLU:
    return splu(normal, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})
