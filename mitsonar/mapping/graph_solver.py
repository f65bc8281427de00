"""Solution of a pose graph: the poses that agree best with all that is known, and their marginal covariances.

Sparse Gauss-Newton over x, y [m] and heading [rad]. Errors of consecutive motions may depend on each other (see
:mod:`mitsonar.mapping.error_correlation`): then each motion has an unknown error of its own, and these errors form a chain
of first order. Loops have Cauchy weights until outliers are out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csc_array, csr_array
from scipy.stats import chi2

from mitsonar.mapping.graph_marginals import marginals_by_nodes
from mitsonar.mapping.normal_factor import NormalFactor
from mitsonar.mapping.pose_graph import CorrelatedErrors, PoseEdges, PoseGraph, relative_motions
from mitsonar.motion.sensors import wrapped

__all__ = ["OUTLIER", "GraphSolution", "motion_derivatives", "solved"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

ITERATIONS = 50
SETTLED = 1e-10
"""Most steps of Gauss-Newton, and the step [m, rad] at which they end."""

CAUCHY = float(chi2.ppf(0.95, 3))
"""Squared residual over the covariance at which a loop has half its weight."""

OUTLIER = float(chi2.ppf(0.999, 3))
"""Squared residual over the covariance beyond which a loop is an outlier: of 1,000 true loops one is."""

COLUMNS = 384
"""Columns of the inverse that are computed at a time."""

LONG = 1000
"""Poses beyond which covariances are those of nodes and of stretches between them."""

STRETCH, NODES = 25, 1000
"""Poses from one node to the next, and nodes at most, those at the ends of loops not counted."""


@dataclass(frozen=True)
class GraphSolution:
    """The poses of a graph.

    Attributes:
        poses: x, y [m], heading [rad], not wrapped ``(poses, 3)``.
        kept: which loops agree with all else ``(loops,)``; the others are left out.
        squared: squared residual of each loop over its own covariance ``(loops,)``, with all poses as solved.
        factor: of the normal equations.
        states: place of each unknown among those of the factor; -1 where it is known.
        normal: the normal equations.
        pose_of: number of the pose to which each unknown of the factor belongs; -1 where it is common to all.
    """

    poses: Array
    kept: NDArray[np.bool_]
    squared: Array
    factor: NormalFactor
    states: Index
    normal: csc_array
    pose_of: Index

    def columns(self, poses: ArrayLike) -> Array:
        """Return the covariances of all poses with some of them ``(poses, 3, chosen, 3)``."""
        chosen = np.atleast_1d(np.asarray(poses, dtype=np.intp))
        wanted = (3 * chosen[:, None] + np.arange(3)).ravel()
        place = self.states[wanted]
        right = np.zeros((self.normal.shape[0], len(wanted)))
        right[place[place >= 0], np.flatnonzero(place >= 0)] = 1.0
        solution = np.vstack([self.factor.solve(right), np.zeros((1, len(wanted)))])  # the last row: what is known
        count = 3 * len(self.poses)
        return np.asarray(solution[self.states[:count]].reshape(-1, 3, len(chosen), 3))

    def covariances(self) -> tuple[Array, Array]:
        """Return the marginal covariances of poses ``(poses, 3, 3)``, and those with the next pose ``(poses - 1, 3, 3)``."""
        count = len(self.poses)
        if count > LONG:
            nodes = min(NODES, count // STRETCH + 1)
            return marginals_by_nodes(self.normal, self.pose_of, self.states[: 3 * count].reshape(-1, 3), nodes)
        own, following = np.zeros((count, 3, 3)), np.zeros((count - 1, 3, 3))
        for begin in range(0, count, COLUMNS // 3):
            chosen = np.arange(begin, min(begin + COLUMNS // 3, count))
            table = self.columns(chosen)
            own[chosen] = table[chosen, :, np.arange(len(chosen))]
            before = chosen[chosen > 0]
            following[before - 1] = table[before - 1, :, before - begin]
        return (own + own.swapaxes(1, 2)) / 2, following

    def motion_covariances(self, own: Array, following: Array) -> Array:
        """Return the covariances of motions from pose to pose ``(poses - 1, 3, 3)``, from :meth:`covariances`."""
        first = np.arange(len(self.poses) - 1)
        by_first, by_second = motion_derivatives(self.poses, first, first + 1)
        cross = by_first @ following @ by_second.swapaxes(1, 2)
        ends = by_first @ own[:-1] @ by_first.swapaxes(1, 2) + by_second @ own[1:] @ by_second.swapaxes(1, 2)
        return np.asarray(ends + cross + cross.swapaxes(1, 2))


def solved(graph: PoseGraph) -> GraphSolution:
    """Solve a graph: outlying loops are found with Cauchy weights, and left out of the solution.

    Raises:
        MitsonarError: covariances that are not positive, or poses that nothing ties.
    """
    kept = np.ones(len(graph.loops.first), dtype=bool)
    poses = graph.start
    while True:
        asked = replace(graph, loops=graph.loops.at(kept))
        if kept.any():
            poses = _gauss_newton(asked, poses, robust=True)[0]
            squared = _squared(graph.loops, poses)
            out = kept & (squared > OUTLIER)
            if out.any():
                kept &= ~out
                continue
        poses, normal, factor, states = _gauss_newton(asked, poses, robust=False)
        pose_of = asked.pose_of[states >= 0]
        return GraphSolution(poses, kept, _squared(graph.loops, poses), factor, states, normal, pose_of)


def _squared(edges: PoseEdges, poses: Array) -> Array:
    """Return the squared residuals of edges over their covariances ``(edges,)``."""
    return np.asarray((_residuals(edges, poses) ** 2).sum(axis=1))


def _residuals(edges: PoseEdges, poses: Array) -> Array:
    """Return the residuals of edges in standard deviations ``(edges, 3)``."""
    off = relative_motions(poses, edges.first, edges.second) - edges.motions
    off[:, 2] = wrapped(off[:, 2])
    return np.asarray((edges.whitening @ off[..., None])[..., 0])


def motion_derivatives(poses: Array, first: ArrayLike, second: ArrayLike) -> tuple[Array, Array]:
    """Return the derivatives of motions by the first and the second pose, each ``(edges, 3, 3)``."""
    there = poses[np.asarray(second)]
    sideways, forward, _ = relative_motions(poses, first, second).T
    sin, cos = np.sin(there[:, 2]), np.cos(there[:, 2])
    none, one = np.zeros_like(sin), np.ones_like(sin)
    by_second = np.array([[cos, -sin, -forward], [sin, cos, sideways], [none, none, one]]).transpose(2, 0, 1)
    by_first = -by_second
    by_first[:, :2, 2] = 0.0
    return by_first, by_second


# ---------------------------------------------------------------- Gauss-Newton


def _gauss_newton(graph: PoseGraph, start: Array, *, robust: bool) -> tuple[Array, csc_array, NormalFactor, Index]:
    """Return the poses, the normal equations there, their factor, and the place of each unknown."""
    total = 3 * len(start) + graph.unknown_errors
    unknown = np.ones(total, dtype=bool)
    unknown[:3] = np.diag(graph.at_start) > 0
    states = np.where(unknown, np.cumsum(unknown) - 1, -1)
    common = int((graph.pose_of < 0).sum()) if len(start) > LONG else 0
    poses, errors = start.copy(), np.zeros(graph.unknown_errors)
    for _ in range(ITERATIONS):
        normal, right = _normal_equations(graph, poses, errors, unknown, robust=robust)
        factor = NormalFactor.of(normal, common)
        step = np.zeros(total)
        step[unknown] = factor.solve(right)
        poses, errors = poses + step[: poses.size].reshape(-1, 3), errors + step[poses.size :]
        if np.abs(step[: poses.size]).max() < SETTLED:
            break
    return poses, normal, factor, states


def _normal_equations(
    graph: PoseGraph, poses: Array, errors: Array, unknown: NDArray[np.bool_], *, robust: bool
) -> tuple[csc_array, Array]:
    """Return the matrix and the right side of the equations of a step of the unknowns."""
    jacobian, residual = _linearised(graph, poses, errors, robust=robust)
    jacobian = jacobian[:, unknown]
    return csc_array(jacobian.T @ jacobian), -(jacobian.T @ residual)


class _Rows:
    """Rows of the Jacobian and their residuals, collected block by block."""

    def __init__(self, states: int) -> None:
        self.states, self.count = states, 0
        self.parts: list[tuple[Array, Index, Index]] = []
        self.residuals: list[Array] = []

    def add(self, residual: Array, *blocks: tuple[Index, Array]) -> None:
        """Add residuals ``(n, rows)``; each block has first states ``(n,)`` and derivatives ``(n, rows, states)``."""
        number, high = residual.shape
        row = self.count + np.arange(number * high).reshape(number, high, 1)
        for first, values in blocks:
            column = first[:, None, None] + np.arange(values.shape[2])
            where = np.broadcast_arrays(values, row, column)
            self.parts.append(tuple(one.ravel() for one in where))  # type: ignore[arg-type]
        self.residuals.append(residual.ravel())
        self.count += number * high

    def whole(self) -> tuple[csr_array, Array]:
        """Return the Jacobian and the residuals."""
        values, row, column = (np.concatenate(parts) for parts in zip(*self.parts, strict=True))
        return csr_array((values, (row, column)), shape=(self.count, self.states)), np.concatenate(self.residuals)


def _linearised(graph: PoseGraph, poses: Array, errors: Array, *, robust: bool) -> tuple[csr_array, Array]:
    """Return the Jacobian of all residuals in standard deviations, and the residuals."""
    rows = _Rows(poses.size + len(errors))
    _add_start(rows, graph, poses)
    if graph.bias is None:
        _add_edges(rows, graph.others, poses, np.ones(len(graph.others.first)))
    else:
        _add_biased(rows, graph.others, graph.bias, poses, errors[-1:])
    squared = _squared(graph.loops, poses)
    _add_edges(rows, graph.loops, poses, 1 / np.sqrt(1 + squared / CAUCHY) if robust else np.ones(len(squared)))
    pose, heading, std = graph.headings
    off = wrapped(poses[pose, 2] - heading)
    rows.add((off / std)[:, None], (3 * pose + 2, (1 / std)[:, None, None]))
    if graph.correlated is None:
        _add_edges(rows, graph.chain, poses, np.ones(len(graph.chain.first)))
    else:
        _add_correlated(rows, graph.chain, graph.correlated, poses, errors)
    return rows.whole()


def _add_start(rows: _Rows, graph: PoseGraph, poses: Array) -> None:
    """Add what is known of those components of the first pose that are unknown."""
    free = np.flatnonzero(np.diag(graph.at_start) > 0)
    if free.size:
        whitening = np.linalg.inv(np.linalg.cholesky(graph.at_start[np.ix_(free, free)]))
        off = whitening @ (poses[0] - graph.start[0])[free]
        derivative = np.zeros((1, len(free), 3))
        derivative[0][:, free] = whitening
        rows.add(off[None], (np.zeros(1, np.intp), derivative))


def _add_edges(rows: _Rows, edges: PoseEdges, poses: Array, weight: Array) -> None:
    """Add the residuals of edges with independent errors, times the roots of their weights."""
    whitening = edges.whitening * weight[:, None, None]
    by_first, by_second = motion_derivatives(poses, edges.first, edges.second)
    rows.add(
        _residuals(edges, poses) * weight[:, None],
        (3 * edges.first, whitening @ by_first),
        (3 * edges.second, whitening @ by_second),
    )


def _add_biased(rows: _Rows, edges: PoseEdges, bias: Array, poses: Array, size: Array) -> None:
    """Add the residuals of edges that share a bias, and its own; it is the last unknown."""
    whitening, last = edges.whitening, np.array([rows.states - 1])
    by_first, by_second = motion_derivatives(poses, edges.first, edges.second)
    by_bias = whitening @ bias[..., None]
    rows.add(
        _residuals(edges, poses) + by_bias[..., 0] * size,
        (3 * edges.first, whitening @ by_first),
        (3 * edges.second, whitening @ by_second),
        (np.repeat(last, len(bias)), by_bias),
    )
    rows.add(size[None], (last, np.ones((1, 1, 1))))


def _add_correlated(rows: _Rows, edges: PoseEdges, correlated: CorrelatedErrors, poses: Array, errors: Array) -> None:
    """Add the residuals of the chain, its errors that wander, and its slopes, all in standard deviations."""
    count = len(edges.first)
    wander, slopes = errors[: 3 * count].reshape(-1, 3), errors[3 * count : 3 * count + 9]
    own = 1 / np.sqrt(1 - correlated.share)
    whitening = edges.whitening * own
    by_first, by_second = motion_derivatives(poses, edges.first, edges.second)
    common = np.broadcast_to(np.sqrt(correlated.share) * own * np.eye(3), (count, 3, 3))
    by_slopes = whitening @ correlated.by_slopes()
    off = _residuals(edges, poses) * own + (common @ wander[..., None])[..., 0] + by_slopes @ slopes
    number, begin = np.arange(count), poses.size
    rows.add(
        off,
        (3 * edges.first, whitening @ by_first),
        (3 * edges.second, whitening @ by_second),
        (begin + 3 * number, common),
        (np.full(count, begin + 3 * count), by_slopes),
    )
    rows.add(wander[:1], (np.array([begin]), np.eye(3)[None]))
    fresh = 1 / np.sqrt(1 - correlated.onward**2)
    along = (fresh * correlated.onward)[:, None, None] * np.eye(3)
    rows.add(
        fresh[:, None] * wander[1:] - (fresh * correlated.onward)[:, None] * wander[:-1],
        (begin + 3 * number[:-1], -along),
        (begin + 3 * number[1:], fresh[:, None, None] * np.eye(3)),
    )
    rows.add(slopes[None], (np.array([begin + 3 * count]), np.eye(9)[None]))
