"""The cells of a frame over level ground, and how a motion shifts them."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from mitsonar.estimation.image.direct_blocks import cell_blocks
from mitsonar.estimation.image.direct_nodes import GroundNodes, node_axes

__all__ = ["Cells", "DirectLevel"]

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


class DirectLevel(NamedTuple):
    """One step from coarse to fine.

    Attributes:
        step: every so many bins are used.
        smoothing: of the frames, in bins and beams.
        slopes: further smoothing of their mean, before its slopes are taken.
        iterations: at most.
    """

    step: int
    smoothing: tuple[float, float]
    slopes: tuple[float, float]
    iterations: int


PATCH = (8, 4)
"""Bins and beams that are summed first: the geometry is constant there."""

FEWEST_ROWS = 2
"""Fewest rows of a patch of a coarse level."""


class Cells:
    """The cells of one level: where they are, and how they move with the sonar, in bins and beams.

    Attributes:
        patch: rows and columns of the patches over which cells are summed.
        patches: number of them along rows and columns.
        derivative: of the displacement of the patches' middles by motion (and heave) ``(3 or 4, 2, patches)``.
        usable: rows that meet the ground.
        seen: 1 where a cell shows ground to be matched, else 0 ``(bins, beams)``; None where all cells do.
    """

    def __init__(self, nodes: GroundNodes, level: DirectLevel) -> None:
        self.nodes, self.grid = nodes, cell_grid(*nodes.key, level.step)
        self.row, self.column, self.patch, self.patches = self.grid.row, self.grid.column, self.grid.patch, self.grid.patches
        self.derivative = self._on_patches(nodes.derivative)
        known = nodes.known
        first = float(nodes.axes[0][int(known.any(axis=1).argmax())]) if known.any() else np.inf
        self.usable = slice(int(np.searchsorted(self.grid.range_m, first)), None)
        self.seen = self._seen(level)

    def _seen(self, level: DirectLevel) -> Floats | None:
        """Return 1 where a cell shows ground to be matched, else 0 ``(bins, beams)``; None where all cells do."""
        shown, masked = self.nodes.shown
        if shown[self.nodes.from_node[0].min() :].all():
            return None
        row, column = (
            np.abs(values[:, None] - nodes).argmin(axis=1)
            for values, nodes in zip((self.grid.range_m, self.grid.bearing_rad), self.nodes.axes, strict=True)
        )
        on_all = shown[row][:, column].astype(np.uint8)
        reach = [2 * int(np.ceil(2 * s / k)) + 1 for s, k in zip(level.smoothing, (level.step, 1), strict=True)]
        return np.asarray(cv2.erode(on_all, np.ones(reach, np.uint8)) if masked else on_all, dtype=np.float32)

    def _on_all(self, nodes: Doubles) -> Floats:
        """Interpolate from the nodes to all cells ``(2, bins, beams)``, in bins and beams."""
        return np.asarray(self.grid.over_bins @ nodes.astype(np.float32) @ self.grid.over_beams)

    def _on_patches(self, nodes: Doubles) -> Doubles:
        """Interpolate from the nodes to the middles of the patches ``(..., 2, patches)``, in bins and beams."""
        middles = self.grid.over_rows @ nodes @ self.grid.over_columns
        return np.asarray(middles.reshape(*nodes.shape[:-2], -1))

    def shift(self, v: Doubles, *, back: bool = False, lift_m: float = 0.0) -> Floats:
        """Return the displacement of the ground of each cell ``(2, bins, beams)`` from the first frame to the second.

        It is in bins and beams; ``back``: from the second frame to the first; ``lift_m``: of ground so much higher.
        """
        return self._on_all(self.nodes.shift(v, back=back, lift_m=lift_m))

    def lifted_shift(self, v: Doubles) -> Doubles:
        """Return the derivative of :meth:`shift` by the height at the middles of the patches ``(2, patches)`` [1/m]."""
        return self._on_patches(self.nodes.lifted_shift(v))

    def leaning_shift_of_cells(self, v: Doubles) -> list[Floats]:
        """Return the derivatives of :meth:`shift` by how frames lean, each ``(2, bins, beams)``."""
        return [self._on_all(nodes) for nodes in self.nodes.leaning_shift(v)]

    def leaning_shift(self, v: Doubles) -> Doubles:
        """Return the derivatives of :meth:`shift` by how frames lean, in the middles of the patches ``(3, 2, patches)``."""
        return self._on_patches(self.nodes.leaning_shift(v))


class CellGrid(NamedTuple):
    """Cells of every so many bins and their patches; splines from the nodes, in bins ``[0]`` and beams ``[1]``.

    ``over_bins`` and ``over_beams`` lead to all cells, ``over_rows`` and ``over_columns`` to the middles of the patches.
    """

    range_m: Doubles
    bearing_rad: Doubles
    row: Floats
    column: Floats
    over_bins: Floats
    over_beams: Floats
    patch: tuple[int, int]
    patches: tuple[int, int]
    over_rows: Doubles
    over_columns: Doubles


@lru_cache(maxsize=16)
def cell_grid(range_m: tuple[float, ...], bearing_rad: tuple[float, ...], step: int) -> CellGrid:
    ranges, axes = np.array(range_m)[step // 2 :: step], np.array(bearing_rad)
    splines = [
        np.asarray(make_interp_spline(node, np.eye(len(node)), 3)(values))
        for node, values in zip(node_axes(np.array(range_m), axes), (ranges, axes), strict=True)
    ]
    bin_m, beam_rad = (np.gradient(values)[:, None] for values in (ranges, axes))
    over_bins = np.stack([splines[0] / bin_m, splines[0]])
    over_beams = np.stack([splines[1].T, (splines[1] / beam_rad).T])
    patch = max(FEWEST_ROWS, PATCH[0] // step), PATCH[1]
    patches = cell_blocks((len(ranges), len(axes)), patch)
    rows, columns = (
        np.minimum(np.arange(count) * edge + edge // 2, size - 1)
        for count, edge, size in zip(patches, patch, (len(ranges), len(axes)), strict=True)
    )
    return CellGrid(
        ranges,
        axes,
        row=np.arange(len(ranges), dtype=np.float32)[:, None],
        column=np.arange(len(axes), dtype=np.float32)[None, :],
        over_bins=over_bins.astype(np.float32),
        over_beams=over_beams.astype(np.float32),
        patch=patch,
        patches=patches,
        over_rows=over_bins[:, rows],
        over_columns=np.ascontiguousarray(over_beams[:, :, columns]),
    )
