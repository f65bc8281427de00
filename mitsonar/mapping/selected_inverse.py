"""Entries of the inverse of a sparse symmetric matrix where its factor has entries: marginal covariances of long graphs.

Time and memory are those of the factor, not of the whole inverse (Takahashi, Fagan and Chin, 1973). Columns of the factor
with the same rows below them are taken together: such a front is a small dense matrix, and all that it needs of the inverse
is in the front of its parent in the elimination tree.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU

__all__ = ["inverse_entries"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class _Front(NamedTuple):
    """Consecutive columns of the factor that have the same rows below them."""

    first: int
    last: int
    below: Index

    @property
    def rows(self) -> Index:
        """Return the numbers of the columns, and the rows below them, ascending."""
        return np.concatenate([np.arange(self.first, self.last + 1), self.below])


def inverse_entries(factor: SuperLU, rows: Index, columns: Index) -> Array:
    """Compute entries of the inverse of a matrix ``(n,)``.

    Args:
        factor: of the symmetric matrix, pivoted along its diagonal.
        rows: of the entries ``(n,)``.
        columns: of the entries ``(n,)``.
    """
    order = np.asarray(factor.perm_c, dtype=np.int64)
    first, second = np.sort(np.stack([order[rows], order[columns]]), axis=0)
    keys, values = [], []
    for front, block in _blocks(factor, first, second):
        column = np.arange(front.first, front.last + 1)
        keys.append((column[:, None] * len(order) + front.rows).ravel())
        values.append(block[: len(column)].ravel())
    place = np.searchsorted(np.concatenate(keys[::-1]), first * len(order) + second)
    return np.asarray(np.concatenate(values[::-1])[place])


def _blocks(factor: SuperLU, first: Index, second: Index) -> Iterator[tuple[_Front, Array]]:
    """Yield the inverse among the rows of each front, the last front first."""
    lower, diagonal = csc_array(factor.L), factor.U.diagonal()
    fronts = _fronts(_structure(lower, first, second))
    home = np.repeat(np.arange(len(fronts)), [one.last - one.first + 1 for one in fronts])
    children = np.bincount([home[one.below[0]] for one in fronts if len(one.below)], minlength=len(fronts))
    kept: dict[int, Array] = {}
    for number in range(len(fronts) - 1, -1, -1):
        front, around = fronts[number], np.zeros((0, 0))
        if len(front.below):
            parent = int(home[front.below[0]])
            place = np.searchsorted(fronts[parent].rows, front.below)
            around = kept[parent][np.ix_(place, place)]
            children[parent] -= 1
            if not children[parent]:
                del kept[parent]
        block = _inverted(front, lower, diagonal, around)
        if children[number]:
            kept[number] = block
        yield front, block


def _structure(lower: csc_array, columns: Index, rows: Index) -> list[Index]:
    """Return the rows below the diagonal of each column of a factor, were there entries at these columns and rows too."""
    count = lower.shape[1]
    column = np.repeat(np.arange(count), np.diff(lower.indptr))
    first, second = np.concatenate([column, columns]), np.concatenate([lower.indices, rows])
    beside = first < second
    key = np.unique(first[beside] * np.int64(count) + second[beside])
    own = np.split(key % count, np.searchsorted(key, np.arange(1, count) * np.int64(count)))
    below: list[Index] = []
    handed: list[list[Index]] = [[] for _ in range(count)]
    for number in range(count):
        parts = handed[number]
        below.append(np.unique(np.concatenate([own[number], *parts])) if parts else own[number])
        parts.clear()
        if len(below[-1]) > 1:  # what a column links, its parent links too
            handed[below[-1][0]].append(below[-1][1:])
    return below


def _fronts(below: list[Index]) -> list[_Front]:
    """Join columns with those before them that have the same rows below."""
    fronts: list[_Front] = []
    first = 0
    for column, rows in enumerate(below):
        onward = below[column + 1] if column + 1 < len(below) else None
        if onward is None or len(rows) != len(onward) + 1 or rows[0] != column + 1:
            fronts.append(_Front(first, column, rows))
            first = column + 1
    return fronts


def _inverted(front: _Front, lower: csc_array, diagonal: Array, around: Array) -> Array:
    """Return the inverse among the rows of a front, from that among the rows below its columns."""
    rows, width = front.rows, front.last - front.first + 1
    table = np.zeros((len(rows), width))
    for number in range(width):
        part = slice(lower.indptr[front.first + number], lower.indptr[front.first + number + 1])
        table[np.searchsorted(rows, lower.indices[part]), number] = lower.data[part]
    own = solve_triangular(table[:width], np.eye(width), lower=True, unit_diagonal=True, check_finite=False)
    link = table[width:] @ own
    beside = -around @ link
    inverse = np.empty((len(rows), len(rows)))
    inverse[:width, :width] = (own.T / diagonal[front.first : front.last + 1]) @ own - link.T @ beside
    inverse[width:, :width], inverse[:width, width:], inverse[width:, width:] = beside, beside.T, around
    return inverse
