"""Correlation of the errors of consecutive motions: they are estimated over the same ground.

Relief over level ground, and the outline of the light, pull an estimate in one direction as long as the same ground is seen.
A covariance that tells the error of one motion rightly then tells that of a path far too small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.mapping.pose_graph import CorrelatedErrors

__all__ = ["ErrorCorrelation"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ErrorCorrelation:
    """How errors of motions over the same ground depend on each other.

    The defaults are measured on rocky fields with ``direct`` (``benchmarks/bench_loops.py``).

    Attributes:
        share: part of the variance that motions over the same ground have in common.
        length: of the ground's way through the window, after which that part correlates by 1/e, as a part of the reach.
        slope: standard deviation of a common error in proportion to the motion, as a scale by a wrong height is.

    Raises:
        MitsonarError: numbers outside their limits.
    """

    share: float = 0.9
    length: float = 0.12
    slope: float = 0.006

    def __post_init__(self) -> None:
        if not (0 <= self.share < 1 and 0 < self.length < np.inf and 0 < self.slope < np.inf):
            raise MitsonarError(
                "share must be 0 or more and below 1, length and slope above 0: got "
                f"{self.share:g}, {self.length:g} and {self.slope:g}"
            )

    def of(self, motions: ArrayLike, reach_m: float) -> CorrelatedErrors:
        """Return how the errors of consecutive motions ``(n, 3)`` depend on each other.

        Args:
            motions: sideways, forward [m], yaw [rad].
            reach_m: horizontal distance of the sonar from the middle of the ground that it sees [m].
        """
        moved = np.asarray(motions, dtype=float)
        way = np.hypot(moved[:, 0] + reach_m * moved[:, 2], moved[:, 1])
        between = (way[1:] + way[:-1]) / 2
        # a sonar at rest sees the same ground for good: errors stay, but the graph needs some change
        onward = np.exp(-np.maximum(between / (self.length * reach_m), 1e-6))
        lever = np.array([1.0, 1.0, 1.0 / reach_m])
        slope_std = self.slope * np.outer(lever, 1 / lever)
        return CorrelatedErrors(self.share, onward, slope_std, _spread(moved, onward))


def _spread(moved: Array, onward: Array) -> Array:
    """Spread each motion over those that see the same ground, so that their sum stays ``(n, 3)``.

    A slope over measured motions would take an error that two components share for an error in proportion.
    """
    total = _alike(np.ones((len(moved), 1)), onward)
    return _alike(moved / total, onward)


def _alike(values: Array, onward: Array) -> Array:
    """Sum values ``(n, k)`` with weights that are the correlations of their motions."""
    before, after = values.copy(), values.copy()
    for k, stays in enumerate(onward):
        before[k + 1] += stays * before[k]
    for k in range(len(onward) - 1, -1, -1):
        after[k] += onward[k] * after[k + 1]
    return np.asarray(before + after - values)
