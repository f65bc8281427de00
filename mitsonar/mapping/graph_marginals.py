"""Marginal covariances of the poses of a long graph, exact, in time that grows with the number of poses.

Columns of the whole inverse are as many and as long as the poses. Here some poses are nodes. Each stretch between two nodes
depends on the rest only through them and the common errors: its covariance is the one given the nodes, plus that of the
nodes carried to it. The normal equations of the nodes are those of the graph without the stretches (Schur complement).
Both terms are covariances, so that their sum is positive definite.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csc_array, csr_array

from mitsonar.mapping.normal_factor import NormalFactor

__all__ = ["marginals_by_nodes"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

TOGETHER = 40
"""Stretches whose covariances are computed at a time."""


class _Stretch(NamedTuple):
    """Poses from one node to the next, both included.

    Attributes:
        poses: their numbers ``(n,)``.
        around: unknowns of both nodes, and the common ones ``(m,)``.
        own: covariances of the poses, given the nodes ``(n, 3, 3)``.
        following: those with the next pose ``(n - 1, 3, 3)``.
        gain: by which errors of ``around`` carry over to the poses ``(n, 3, m)``.
        added: what the stretch tells of ``around``: to be added to the normal equations ``(m, m)``.
    """

    poses: Index
    around: Index
    own: Array
    following: Array
    gain: Array
    added: Array


def marginals_by_nodes(normal: csc_array, pose_of: Index, states: Index, nodes: int) -> tuple[Array, Array]:
    """Return the marginal covariances of poses ``(poses, 3, 3)``, and those with the next pose ``(poses - 1, 3, 3)``.

    Args:
        normal: the normal equations ``(unknowns, unknowns)``.
        pose_of: number of the pose to which each unknown belongs; -1 of the last ones, common to all ``(unknowns,)``.
        states: place of x, y and heading of each pose among the unknowns; -1 where it is known ``(poses, 3)``.
        nodes: poses that are nodes, evenly spread; poses that are tied to others than their neighbours are nodes too.

    Raises:
        MitsonarError: poses that nothing ties.
    """
    order = np.argsort(np.where(pose_of < 0, len(states), pose_of), kind="stable")
    place = np.append(np.argsort(order), -1)  # the last one: what is known
    table = csr_array(normal)[order][:, order]
    begin = np.searchsorted(pose_of[order][pose_of[order] >= 0], np.arange(len(states) + 1))
    chosen = _nodes(csc_array(normal), pose_of, len(states), nodes)
    stretches = [_stretch(table, begin, place[states], *ends) for ends in pairwise(chosen)]
    return _joined(table, int((pose_of < 0).sum()), stretches)


def _nodes(normal: csc_array, pose_of: Index, count: int, nodes: int) -> Index:
    """Return the numbers of poses that are nodes, in order: some evenly spread, and all with ties beyond neighbours."""
    even = np.linspace(0, count - 1, min(nodes, count)).astype(np.intp)
    first, second = (pose_of[one] for one in normal.nonzero())
    beyond = (np.abs(first - second) > 1) & (first >= 0) & (second >= 0)
    return np.unique(np.concatenate([[0, count - 1], even, first[beyond]]))


def _stretch(table: csr_array, begin: Index, states: Index, first: int, last: int) -> _Stretch:
    """Return the poses between two nodes, given these, from normal equations in the order of poses."""
    start, stop, common = begin[first], begin[last + 1], np.arange(begin[-1], table.shape[0])
    whole = np.concatenate([np.arange(start, stop), common])
    inner = slice(begin[first + 1] - start, begin[last] - start)
    beside = np.delete(np.arange(len(whole)), inner)
    rows = table[begin[first + 1] : begin[last]][:, whole].toarray()
    # one row more than unknowns: what is known has no error
    covariance, gain = np.zeros((len(whole) + 1, len(whole) + 1)), np.zeros((len(whole) + 1, len(beside)))
    gain[beside] = np.eye(len(beside))
    if len(rows):
        covariance[inner, inner] = cho_solve(cho_factor(rows[:, inner]), np.eye(len(rows)))
        gain[inner] = -covariance[inner, inner] @ rows[:, beside]
    added = rows[:, beside].T @ gain[inner]
    poses = np.arange(first, last + 1)
    row = np.where(states[poses] < 0, len(whole), states[poses] - start)
    return _Stretch(
        poses,
        whole[beside],
        covariance[row[:, :, None], row[:, None]],
        covariance[row[:-1, :, None], row[1:, None]],
        gain[row],
        (added + added.T) / 2,
    )


def _reduced(table: csr_array, kept: Index, stretches: list[_Stretch]) -> csc_array:
    """Return the normal equations of the unknowns ``kept`` alone."""
    parts = [np.broadcast_arrays(one.added, one.around[:, None], one.around) for one in stretches]
    added, row, column = (np.concatenate([part[axis].ravel() for part in parts]) for axis in range(3))
    place = (np.searchsorted(kept, row), np.searchsorted(kept, column))
    return csc_array(table[kept][:, kept] + coo_array((added, place), shape=(len(kept), len(kept))))


def _joined(table: csr_array, common: int, stretches: list[_Stretch]) -> tuple[Array, Array]:
    """Return the covariances of all poses, from those given the nodes and those of the nodes."""
    kept = np.unique(np.concatenate([one.around for one in stretches]))
    factor = NormalFactor.of(_reduced(table, kept, stretches), common)
    last = int(stretches[-1].poses[-1])
    own, following = np.zeros((last + 1, 3, 3)), np.zeros((last, 3, 3))
    for begin in range(0, len(stretches), TOGETHER):
        part = stretches[begin : begin + TOGETHER]
        wanted = np.searchsorted(kept, np.unique(np.concatenate([one.around for one in part])))
        right = np.zeros((len(kept), len(wanted)))
        right[wanted, np.arange(len(wanted))] = 1.0
        inverse = factor.solve(right)[wanted]
        for one in part:
            place = np.searchsorted(kept[wanted], one.around)
            nodes = inverse[np.ix_(place, place)]
            carried = one.gain @ ((nodes + nodes.T) / 2)
            own[one.poses] = one.own + carried @ one.gain.swapaxes(1, 2)
            following[one.poses[:-1]] = one.following + carried[:-1] @ one.gain[1:].swapaxes(1, 2)
    return (own + own.swapaxes(1, 2)) / 2, following
