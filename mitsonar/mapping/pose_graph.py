"""How the poses that agree best with relative motions, loops and headings are found, with their covariances.

A :class:`PoseGraph` holds the measurements and the model of their errors, and :func:`solved` solves it. Motions are those of
Almanza-Medina, eq. 3.4, in axes of the second heading.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.linalg import SuperLU, splu
from scipy.stats import chi2

from mitsonar.errors import MitsonarError
from mitsonar.mapping.series import YAW_ADVICE, CorrelatedErrors
from mitsonar.motion.sensors import Headings, wrapped

__all__ = [
    "OUTLIER",
    "GraphSolution",
    "NormalFactor",
    "PoseEdges",
    "PoseGraph",
    "marginals_by_nodes",
    "motion_derivatives",
    "relative_motions",
    "solved",
]


Array = NDArray[np.float64]
Index = NDArray[np.intp]


class PoseEdges(NamedTuple):
    """Relative motions between poses.

    Attributes:
        first: index of the pose where each edge begins ``(edges,)``.
        second: index of the pose where each edge ends ``(edges,)``.
        motions: sideways, forward [m], yaw [rad] ``(edges, 3)``.
        covariances: covariances of the errors of the motions ``(edges, 3, 3)`` [m, m, rad].
    """

    first: Index
    second: Index
    motions: Array
    covariances: Array

    @classmethod
    def none(cls) -> Self:
        """Return an empty set of edges."""
        return cls(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros((0, 3, 3)))

    @classmethod
    def chain(cls, motions: ArrayLike, covariances: ArrayLike) -> Self:
        """Return the edges between consecutive poses, from motions ``(n, 3)`` and their covariances ``(n, 3, 3)``."""
        table = np.asarray(motions, dtype=float)
        first = np.arange(len(table), dtype=np.intp)
        return cls(first, first + 1, table, np.asarray(covariances, dtype=float))

    def select(self, chosen: ArrayLike) -> Self:
        """Return the edges selected by an index array or a boolean mask."""
        return type(self)(*(np.asarray(values)[np.asarray(chosen)] for values in self))

    @property
    def whitening(self) -> Array:
        """Return the inverse Cholesky factors of the covariances ``(edges, 3, 3)``.

        Raises:
            MitsonarError: a covariance is not positive definite.
        """
        try:
            return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariances)))
        except np.linalg.LinAlgError:
            raise MitsonarError(
                f"covariances of motions in a pose graph must be positive definite: got one that is not; {YAW_ADVICE}"
            ) from None


@dataclass(frozen=True)
class PoseGraph:
    """Measurements that constrain poses.

    Attributes:
        start: initial guess of the poses: x, y [m], heading [rad], not wrapped ``(poses, 3)``.
        chain: motions between poses whose errors are correlated as in ``correlated``.
        others: motions with independent errors, apart from a common bias.
        bias: change of the error of each of ``others`` per standard deviation of one unknown bias ``(others, 3)``; None for
            no bias.
        loops: motions with independent errors, some of which may be wrong.
        headings: absolute headings.
        correlated: correlation of the errors of the chain; None: they are independent.
        at_start: covariance of the first pose ``(3, 3)``; a component with variance 0 is known exactly.
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
        """Return the number of unknowns besides the poses: three errors per motion and nine slopes, and a bias, if any."""
        return (0 if self.correlated is None else 3 * len(self.chain.first) + 9) + (self.bias is not None)

    @property
    def pose_of(self) -> Index:
        """Return the pose to which each unknown belongs ``(unknowns,)``.

        The errors of a motion belong to its first pose. Unknowns common to all motions have -1.
        """
        errors = np.full(self.unknown_errors, -1, dtype=np.intp)
        if self.correlated is not None:
            errors[: 3 * len(self.chain.first)] = np.repeat(self.chain.first, 3)
        return np.concatenate([np.repeat(np.arange(len(self.start)), 3), errors])


def relative_motions(poses: Array, first: ArrayLike, second: ArrayLike) -> Array:
    """Return the motions ``(edges, 3)`` from first to second poses, given x, y, heading ``(poses, 3)`` (eq. 3.4)."""
    there = poses[np.asarray(second)]
    x, y, yaw = (there - poses[np.asarray(first)]).T
    sin, cos = np.sin(there[:, 2]), np.cos(there[:, 2])
    return np.column_stack([x * cos - y * sin, x * sin + y * cos, wrapped(yaw)])


# ---------------- Marginal covariances of long graphs


TOGETHER = 40
"""Number of stretches whose covariances are computed at a time."""


class _Stretch(NamedTuple):
    """The poses from one node to the next, both included, conditioned on the nodes and the common unknowns.

    Attributes:
        poses: indices of the poses ``(n,)``.
        around: unknowns of both nodes, and the common unknowns ``(m,)``.
        covariances: covariances of the poses, given ``around`` ``(n, 3, 3)``.
        following: covariances of each pose with the next, given ``around`` ``(n - 1, 3, 3)``.
        gain: derivative of the poses by ``around`` ``(n, 3, m)``.
        added: Schur complement to add to the normal equations of ``around`` ``(m, m)``.
    """

    poses: Index
    around: Index
    covariances: Array
    following: Array
    gain: Array
    added: Array


def marginals_by_nodes(normal: csc_array, pose_of: Index, states: Index, nodes: int) -> tuple[Array, Array]:
    """Return the marginal covariances of the poses of a long graph, and those with the next pose.

    The result is exact, in time proportional to the number of poses; the whole inverse would need quadratic time and memory.
    Some poses are nodes. The stretch between two nodes depends on the rest only through them and the common unknowns, so
    that its covariance is the covariance given the nodes, plus that of the nodes propagated to it. The normal equations of
    the nodes follow by eliminating the stretches (Schur complement). Both terms are covariances, so that their sum is
    positive definite.

    Args:
        normal: normal equations ``(unknowns, unknowns)``.
        pose_of: pose to which each unknown belongs ``(unknowns,)``; -1 for the last ones, common to all poses.
        states: index of x, y and heading of each pose among the unknowns ``(poses, 3)``; -1 where it is known.
        nodes: number of evenly spread nodes; poses with edges beyond their neighbours become nodes too.

    Returns:
        Covariances ``(poses, 3, 3)``, and covariances with the next pose ``(poses - 1, 3, 3)``.

    Raises:
        MitsonarError: some poses are not connected by any measurement.
    """
    # 1. sort the unknowns by pose, so that every stretch is a contiguous block, with the common ones last
    order = np.argsort(np.where(pose_of < 0, len(states), pose_of), kind="stable")
    place = np.append(np.argsort(order), -1)  # -1, for known components, stays -1
    table = csr_array(normal)[order][:, order]
    begin = np.searchsorted(pose_of[order][pose_of[order] >= 0], np.arange(len(states) + 1))
    # 2. condition each stretch on its nodes, and join them by the covariance of the nodes
    chosen = _nodes(csc_array(normal), pose_of, len(states), nodes)
    stretches = [_stretch(table, begin, place[states], *ends) for ends in pairwise(chosen)]
    return _joined(table, int((pose_of < 0).sum()), stretches)


def _nodes(normal: csc_array, pose_of: Index, count: int, nodes: int) -> Index:
    """Return the indices of the nodes, in order: evenly spread poses, and all poses with edges beyond their neighbours."""
    even = np.linspace(0, count - 1, min(nodes, count)).astype(np.intp)
    first, second = (pose_of[one] for one in normal.nonzero())
    beyond = (np.abs(first - second) > 1) & (first >= 0) & (second >= 0)
    return np.unique(np.concatenate([[0, count - 1], even, first[beyond]]))


def _stretch(table: csr_array, begin: Index, states: Index, first: int, last: int) -> _Stretch:
    """Return the stretch between two nodes, from normal equations sorted by pose."""
    # 1. the rows of the inner unknowns; they connect only to the nodes and the common unknowns
    start, stop, common = begin[first], begin[last + 1], np.arange(begin[-1], table.shape[0])
    whole = np.concatenate([np.arange(start, stop), common])
    inner = slice(begin[first + 1] - start, begin[last] - start)
    outer = np.delete(np.arange(len(whole)), inner)
    rows = table[begin[first + 1] : begin[last]][:, whole].toarray()
    # 2. covariance of the inner unknowns given the others, and their response to the others; the extra last row of zeros
    # serves components that are known, which have no error
    covariance, gain = np.zeros((len(whole) + 1, len(whole) + 1)), np.zeros((len(whole) + 1, len(outer)))
    gain[outer] = np.eye(len(outer))
    if len(rows):
        covariance[inner, inner] = cho_solve(cho_factor(rows[:, inner]), np.eye(len(rows)))
        gain[inner] = -covariance[inner, inner] @ rows[:, outer]
    added = rows[:, outer].T @ gain[inner]
    # 3. the same for x, y and heading of each pose
    poses = np.arange(first, last + 1)
    row = np.where(states[poses] < 0, len(whole), states[poses] - start)
    return _Stretch(
        poses,
        whole[outer],
        covariance[row[:, :, None], row[:, None]],
        covariance[row[:-1, :, None], row[1:, None]],
        gain[row],
        (added + added.T) / 2,
    )


def _reduced(table: csr_array, remaining: Index, stretches: list[_Stretch]) -> csc_array:
    """Return the normal equations of the unknowns ``remaining`` after elimination of all others (Schur complement)."""
    parts = [np.broadcast_arrays(one.added, one.around[:, None], one.around) for one in stretches]
    added, row, column = (np.concatenate([part[axis].ravel() for part in parts]) for axis in range(3))
    place = (np.searchsorted(remaining, row), np.searchsorted(remaining, column))
    return csc_array(table[remaining][:, remaining] + coo_array((added, place), shape=(len(remaining), len(remaining))))


def _joined(table: csr_array, common: int, stretches: list[_Stretch]) -> tuple[Array, Array]:
    """Return the covariances of all poses: those given the nodes, plus those of the nodes propagated to the stretches."""
    remaining = np.unique(np.concatenate([one.around for one in stretches]))
    factor = NormalFactor.factorise(_reduced(table, remaining, stretches), common)
    last = int(stretches[-1].poses[-1])
    covariances, following = np.zeros((last + 1, 3, 3)), np.zeros((last, 3, 3))
    for begin in range(0, len(stretches), TOGETHER):
        # columns of the inverse for the nodes of a few stretches: bounded memory, and few solves
        part = stretches[begin : begin + TOGETHER]
        columns = np.searchsorted(remaining, np.unique(np.concatenate([one.around for one in part])))
        right = np.zeros((len(remaining), len(columns)))
        right[columns, np.arange(len(columns))] = 1.0
        inverse = factor.solve(right)[columns]
        for one in part:
            place = np.searchsorted(remaining[columns], one.around)
            nodes = inverse[np.ix_(place, place)]
            carried = one.gain @ ((nodes + nodes.T) / 2)
            covariances[one.poses] = one.covariances + carried @ one.gain.swapaxes(1, 2)
            following[one.poses[:-1]] = one.following + carried[:-1] @ one.gain[1:].swapaxes(1, 2)
    return (covariances + covariances.swapaxes(1, 2)) / 2, following


# ---------------- Factor of the normal equations


class NormalFactor(NamedTuple):
    """A sparse factorisation of normal equations.

    Attributes:
        lower_upper: LU factors of the equations.
        order: permutation of the unknowns before the factorisation ``(unknowns,)``; None for none.
    """

    lower_upper: SuperLU
    order: NDArray[np.intp] | None = None

    @classmethod
    def factorise(cls, normal: csc_array, common: int = 0) -> Self:
        """Factor normal equations.

        Args:
            normal: normal equations ``(unknowns, unknowns)``.
            common: number of unknowns, at the end, that are connected to most others and are eliminated last. With them, the
                search for a fill-reducing order would take quadratic time.

        Raises:
            MitsonarError: the equations are singular.
        """
        size = normal.shape[0]
        try:
            if not common:
                return cls(_split(normal, "MMD_AT_PLUS_A"))
            separate = size - common
            first = np.argsort(_split(csc_array(normal[:separate, :separate]), "MMD_AT_PLUS_A").perm_c)
            order = np.concatenate([first, np.arange(separate, size)])
            return cls(_split(csc_array(normal[order][:, order]), "NATURAL"), order)
        except RuntimeError:
            raise MitsonarError(
                "some poses of the graph are not connected by any measurement: give motions between all consecutive poses"
            ) from None

    def solve(self, right: Array) -> Array:
        """Solve the normal equations for a right-hand side ``(unknowns,)`` or ``(unknowns, n)``."""
        if self.order is None:
            return np.asarray(self.lower_upper.solve(right))
        solution = np.empty_like(right)
        solution[self.order] = self.lower_upper.solve(right[self.order])
        return solution


def _split(normal: csc_array, order: str) -> SuperLU:
    return splu(normal, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


# ---------------- Solution


ITERATIONS = 50
SETTLED = 1e-10
"""Largest number of Gauss-Newton steps, and the step size [m, rad] below which they end."""

CAUCHY = float(chi2.ppf(0.95, 3))
"""Squared normalised residual at which a loop has half its weight."""

OUTLIER = float(chi2.ppf(0.999, 3))
"""Squared normalised residual beyond which a loop is an outlier; one of 1,000 true loops exceeds it."""

COLUMNS = 384
"""Number of columns of the inverse that are computed at a time."""

LONG = 1000
"""Number of poses beyond which covariances are computed by :func:`marginals_by_nodes`."""

STRETCH, NODES = 25, 1000
"""Poses from one node to the next, and the largest number of nodes, not counting those at the ends of loops."""


@dataclass(frozen=True)
class GraphSolution:
    """The solved poses of a graph.

    Attributes:
        poses: x, y [m], heading [rad], not wrapped ``(poses, 3)``.
        accepted: whether each loop agrees with all other measurements ``(loops,)``; the others were left out.
        squared: squared residual of each loop normalised by its covariance ``(loops,)``, at the solution.
        factor: factor of the normal equations.
        states: index of each unknown among those of the factor; -1 where it is known.
        normal: normal equations at the solution.
        pose_of: pose to which each unknown of the factor belongs; -1 where it is common to all.
    """

    poses: Array
    accepted: NDArray[np.bool_]
    squared: Array
    factor: NormalFactor
    states: Index
    normal: csc_array
    pose_of: Index

    def columns(self, poses: ArrayLike) -> Array:
        """Return the covariances of all poses with the chosen ones ``(poses, 3, chosen, 3)``."""
        chosen = np.atleast_1d(np.asarray(poses, dtype=np.intp))
        unknowns = (3 * chosen[:, None] + np.arange(3)).ravel()
        place = self.states[unknowns]
        right = np.zeros((self.normal.shape[0], len(unknowns)))
        right[place[place >= 0], np.flatnonzero(place >= 0)] = 1.0
        solution = np.vstack([self.factor.solve(right), np.zeros((1, len(unknowns)))])  # the last row: known components
        count = 3 * len(self.poses)
        return np.asarray(solution[self.states[:count]].reshape(-1, 3, len(chosen), 3))

    def covariances(self) -> tuple[Array, Array]:
        """Return the marginal covariances of poses ``(poses, 3, 3)``, and those with the next pose ``(poses - 1, 3, 3)``.

        Long graphs use :func:`marginals_by_nodes`, short ones the columns of the inverse.
        """
        count = len(self.poses)
        if count > LONG:
            nodes = min(NODES, count // STRETCH + 1)
            return marginals_by_nodes(self.normal, self.pose_of, self.states[: 3 * count].reshape(-1, 3), nodes)
        marginal, following = np.zeros((count, 3, 3)), np.zeros((count - 1, 3, 3))
        for begin in range(0, count, COLUMNS // 3):
            chosen = np.arange(begin, min(begin + COLUMNS // 3, count))
            table = self.columns(chosen)
            marginal[chosen] = table[chosen, :, np.arange(len(chosen))]
            before = chosen[chosen > 0]
            following[before - 1] = table[before - 1, :, before - begin]
        return (marginal + marginal.swapaxes(1, 2)) / 2, following

    def motion_covariances(self, marginal: Array, following: Array) -> Array:
        """Return the covariances of the motions between consecutive poses ``(poses - 1, 3, 3)``.

        Args:
            marginal: marginal covariances of the poses, from :meth:`covariances`.
            following: covariances of each pose with the next, from :meth:`covariances`.
        """
        first = np.arange(len(self.poses) - 1)
        by_first, by_second = motion_derivatives(self.poses, first, first + 1)
        cross = by_first @ following @ by_second.swapaxes(1, 2)
        ends = by_first @ marginal[:-1] @ by_first.swapaxes(1, 2) + by_second @ marginal[1:] @ by_second.swapaxes(1, 2)
        return np.asarray(ends + cross + cross.swapaxes(1, 2))


def solved(graph: PoseGraph) -> GraphSolution:
    """Solve a pose graph for the poses that agree best with all measurements, by sparse Gauss-Newton.

    Loops have Cauchy weights until no outlier is left; outliers are left out of the solution. If errors of consecutive
    motions are correlated (see :mod:`mitsonar.mapping.series`), the errors themselves are unknowns that form a first-order
    chain.

    Raises:
        MitsonarError: a covariance is not positive definite, or some poses are not connected by any measurement.
    """
    accepted = np.ones(len(graph.loops.first), dtype=bool)
    poses = graph.start
    while True:
        closed = replace(graph, loops=graph.loops.select(accepted))
        # robust solution: drop the outliers among the loops, and repeat without them
        if accepted.any():
            poses = _gauss_newton(closed, poses, robust=True)[0]
            squared = _squared(graph.loops, poses)
            out = accepted & (squared > OUTLIER)
            if out.any():
                accepted &= ~out
                continue
        # final solution with full weights, whose normal equations give the covariances
        poses, normal, factor, states = _gauss_newton(closed, poses, robust=False)
        pose_of = closed.pose_of[states >= 0]
        return GraphSolution(poses, accepted, _squared(graph.loops, poses), factor, states, normal, pose_of)


def _squared(edges: PoseEdges, poses: Array) -> Array:
    """Return the squared residuals of edges, normalised by their covariances ``(edges,)``."""
    return np.asarray((_residuals(edges, poses) ** 2).sum(axis=1))


def _residuals(edges: PoseEdges, poses: Array) -> Array:
    """Return the residuals of edges in standard deviations ``(edges, 3)``."""
    off = relative_motions(poses, edges.first, edges.second) - edges.motions
    off[:, 2] = wrapped(off[:, 2])
    return np.asarray((edges.whitening @ off[..., None])[..., 0])


def motion_derivatives(poses: Array, first: ArrayLike, second: ArrayLike) -> tuple[Array, Array]:
    """Return the derivatives of motions by their first and second poses, each ``(edges, 3, 3)``."""
    there = poses[np.asarray(second)]
    sideways, forward, _ = relative_motions(poses, first, second).T
    sin, cos = np.sin(there[:, 2]), np.cos(there[:, 2])
    none, one = np.zeros_like(sin), np.ones_like(sin)
    by_second = np.array([[cos, -sin, -forward], [sin, cos, sideways], [none, none, one]]).transpose(2, 0, 1)
    by_first = -by_second
    by_first[:, :2, 2] = 0.0
    return by_first, by_second


# ---------------- Gauss-Newton


def _gauss_newton(graph: PoseGraph, start: Array, *, robust: bool) -> tuple[Array, csc_array, NormalFactor, Index]:
    """Return the poses, the normal equations there, their factor, and the index of each unknown (-1: known)."""
    # known components of the first pose are no unknowns; unknowns common to all poses are eliminated last in long graphs
    total = 3 * len(start) + graph.unknown_errors
    unknown = np.ones(total, dtype=bool)
    unknown[:3] = np.diag(graph.at_start) > 0
    states = np.where(unknown, np.cumsum(unknown) - 1, -1)
    common = int((graph.pose_of < 0).sum()) if len(start) > LONG else 0
    poses, errors = start.copy(), np.zeros(graph.unknown_errors)
    for _ in range(ITERATIONS):
        normal, right = _normal_equations(graph, poses, errors, unknown, robust=robust)
        factor = NormalFactor.factorise(normal, common)
        step = np.zeros(total)
        step[unknown] = factor.solve(right)
        poses, errors = poses + step[: poses.size].reshape(-1, 3), errors + step[poses.size :]
        if np.abs(step[: poses.size]).max() < SETTLED:
            break
    return poses, normal, factor, states


def _normal_equations(
    graph: PoseGraph, poses: Array, errors: Array, unknown: NDArray[np.bool_], *, robust: bool
) -> tuple[csc_array, Array]:
    """Return the matrix and the right-hand side of the normal equations of a Gauss-Newton step."""
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
        """Add residuals ``(n, rows)``.

        Args:
            residual: residuals in standard deviations ``(n, rows)``.
            blocks: pairs of the first state ``(n,)`` and the derivatives by it and the following ones ``(n, rows, states)``.
        """
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
    """Add the prior of those components of the first pose that are not known exactly."""
    free = np.flatnonzero(np.diag(graph.at_start) > 0)
    if free.size:
        whitening = np.linalg.inv(np.linalg.cholesky(graph.at_start[np.ix_(free, free)]))
        off = whitening @ (poses[0] - graph.start[0])[free]
        derivative = np.zeros((1, len(free), 3))
        derivative[0][:, free] = whitening
        rows.add(off[None], (np.zeros(1, np.intp), derivative))


def _add_edges(rows: _Rows, edges: PoseEdges, poses: Array, weight: Array) -> None:
    """Add the residuals of edges with independent errors, times ``weight``, the square roots of their weights."""
    whitening = edges.whitening * weight[:, None, None]
    by_first, by_second = motion_derivatives(poses, edges.first, edges.second)
    rows.add(
        _residuals(edges, poses) * weight[:, None],
        (3 * edges.first, whitening @ by_first),
        (3 * edges.second, whitening @ by_second),
    )


def _add_biased(rows: _Rows, edges: PoseEdges, bias: Array, poses: Array, size: Array) -> None:
    """Add the residuals of edges that share a bias, and the prior of the bias, which is the last unknown."""
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
    """Add the residuals of the chain, of its wandering errors, and of its slopes, all in standard deviations."""
    # 1. motions: the independent part of their errors whitens the residuals; the shared part and the slopes are unknowns
    count = len(edges.first)
    wander, slopes = errors[: 3 * count].reshape(-1, 3), errors[3 * count : 3 * count + 9]
    scale = 1 / np.sqrt(1 - correlated.share)
    whitening = edges.whitening * scale
    by_first, by_second = motion_derivatives(poses, edges.first, edges.second)
    common = np.broadcast_to(np.sqrt(correlated.share) * scale * np.eye(3), (count, 3, 3))
    by_slopes = whitening @ correlated.by_slopes()
    off = _residuals(edges, poses) * scale + (common @ wander[..., None])[..., 0] + by_slopes @ slopes
    number, begin = np.arange(count), poses.size
    rows.add(
        off,
        (3 * edges.first, whitening @ by_first),
        (3 * edges.second, whitening @ by_second),
        (begin + 3 * number, common),
        (np.full(count, begin + 3 * count), by_slopes),
    )
    # 2. the wandering errors are a first-order chain with unit variance: the first one, then the innovation of each next
    rows.add(wander[:1], (np.array([begin]), np.eye(3)[None]))
    fresh = 1 / np.sqrt(1 - correlated.onward**2)
    along = (fresh * correlated.onward)[:, None, None] * np.eye(3)
    rows.add(
        fresh[:, None] * wander[1:] - (fresh * correlated.onward)[:, None] * wander[:-1],
        (begin + 3 * number[:-1], -along),
        (begin + 3 * number[1:], fresh[:, None, None] * np.eye(3)),
    )
    # 3. the slopes have unit variance
    rows.add(slopes[None], (np.array([begin + 3 * count]), np.eye(9)[None]))
