"""A pose graph: poses, relative motions between them, loops and headings, and how their errors depend on each other.

:mod:`mitsonar.mapping.graph_solver` solves it. Motions are those of Almanza-Medina, eq. 3.4, in axes of the second heading.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.sensors import Headings, wrapped

__all__ = ["CorrelatedErrors", "PoseEdges", "PoseGraph", "relative_motions"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class PoseEdges(NamedTuple):
    """Relative motions between poses.

    Attributes:
        first: numbers of the poses from which they lead ``(edges,)``.
        second: numbers of the poses to which they lead.
        motions: sideways, forward [m], yaw [rad] ``(edges, 3)``.
        covariances: of their errors ``(edges, 3, 3)`` [m, m, rad].
    """

    first: Index
    second: Index
    motions: Array
    covariances: Array

    @classmethod
    def none(cls) -> Self:
        """Return no edges."""
        return cls(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros((0, 3, 3)))

    @classmethod
    def chain(cls, motions: ArrayLike, covariances: ArrayLike) -> Self:
        """Return the edges of consecutive poses, from motions ``(n, 3)`` and their covariances ``(n, 3, 3)``."""
        table = np.asarray(motions, dtype=float)
        first = np.arange(len(table), dtype=np.intp)
        return cls(first, first + 1, table, np.asarray(covariances, dtype=float))

    def at(self, chosen: ArrayLike) -> Self:
        """Return some of the edges, by number or by truth."""
        return type(self)(*(np.asarray(values)[np.asarray(chosen)] for values in self))

    @property
    def whitening(self) -> Array:
        """Return the inverse Cholesky factors of the covariances ``(edges, 3, 3)``.

        Raises:
            MitsonarError: a covariance that is not positive.
        """
        try:
            return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariances)))
        except np.linalg.LinAlgError:
            raise MitsonarError("a pose graph needs covariances of motions that are positive: got one that is not") from None


class CorrelatedErrors(NamedTuple):
    """How errors of consecutive motions of the chain depend on each other.

    Attributes:
        share: part of the variance of each motion's error that consecutive motions have in common, 0 to below 1.
        onward: correlation of that part from each motion to the next ``(motions - 1,)``, 0 to below 1.
        slope_std: standard deviation of the slope of each component's error (rows) over each of the motion (columns), the
            same slopes for all motions ``(3, 3)``.
        sloped: what the slopes are over, the motions without the errors of single ones ``(motions, 3)``.
    """

    share: float
    onward: Array
    slope_std: Array
    sloped: Array

    def by_slopes(self) -> Array:
        """Return the derivative of errors by the nine slopes, in their standard deviations ``(motions, 3, 9)``."""
        table = np.zeros((len(self.sloped), 3, 3, 3))
        for axis in range(3):
            table[:, axis, axis] = self.sloped * self.slope_std[axis]
        return table.reshape(-1, 3, 9)


@dataclass(frozen=True)
class PoseGraph:
    """What is known of poses.

    Attributes:
        start: first guess: x, y [m], heading [rad], not wrapped ``(poses, 3)``.
        chain: motions between poses whose errors are as ``correlated`` says.
        others: motions with independent errors, but for a bias.
        bias: error of each of ``others`` by a standard deviation of one unknown bias ``(others, 3)``; None: no bias.
        loops: motions with independent errors, some of which may be wrong.
        headings: absolute ones.
        correlated: None: errors of the chain are independent.
        at_start: covariance of the first pose ``(3, 3)``; a component with variance 0 is known.
    """

    start: Array
    chain: PoseEdges
    others: PoseEdges = field(default_factory=PoseEdges.none)
    bias: Array | None = None
    loops: PoseEdges = field(default_factory=PoseEdges.none)
    headings: Headings = field(default_factory=Headings.none)
    correlated: CorrelatedErrors | None = None
    at_start: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def __post_init__(self) -> None:
        count = len(self.start)
        if self.start.shape != (count, 3) or count < 2:
            raise MitsonarError(f"a pose graph needs two poses (x, y, heading) or more: got {self.start.shape}")
        for edges in (self.chain, self.others, self.loops):
            ends = np.concatenate([edges.first, edges.second])
            if ends.size and not (ends.min() >= 0 and ends.max() < count):
                raise MitsonarError(f"an edge leads to pose {ends.max()}, and there are {count}, numbered from 0")
        if self.bias is not None and self.bias.shape != self.others.motions.shape:
            raise MitsonarError(
                f"a bias needs three numbers for each of {len(self.others.first)} motions: got {self.bias.shape}"
            )

    @property
    def unknown_errors(self) -> int:
        """Return the number of unknowns beside the poses: three errors a motion, nine slopes and a bias, where asked for."""
        return (0 if self.correlated is None else 3 * len(self.chain.first) + 9) + (self.bias is not None)

    @property
    def pose_of(self) -> Index:
        """Return the pose of each unknown; of a motion's errors its first pose, of common ones -1 ``(unknowns,)``."""
        errors = np.full(self.unknown_errors, -1, dtype=np.intp)
        if self.correlated is not None:
            errors[: 3 * len(self.chain.first)] = np.repeat(self.chain.first, 3)
        return np.concatenate([np.repeat(np.arange(len(self.start)), 3), errors])


def relative_motions(poses: Array, first: ArrayLike, second: ArrayLike) -> Array:
    """Return the motions ``(edges, 3)`` from the first to the second poses, of x, y, heading ``(poses, 3)`` (eq. 3.4)."""
    there = poses[np.asarray(second)]
    x, y, yaw = (there - poses[np.asarray(first)]).T
    sin, cos = np.sin(there[:, 2]), np.cos(there[:, 2])
    return np.column_stack([x * cos - y * sin, x * sin + y * cos, wrapped(yaw)])
