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

MOSTLY = 0.5
"""Part of the window that must show lit ground for the outline of the light to be left in."""

LIT = 0.9
"""Part of the field of view's elevation that is free of its outline."""


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
        frames, step = nodes.frames, level.step
        self.nodes = nodes
        self.grid = cell_grid(tuple(frames.range_m.tolist()), tuple(frames.bearing_rad.tolist()), step)
        self.row, self.column = self.grid.row, self.grid.column
        self.patch = max(FEWEST_ROWS, PATCH[0] // step), PATCH[1]
        self.patches = cell_blocks((len(self.grid.range_m), len(self.grid.bearing_rad)), self.patch)
        self.derivative = self._on_patches(nodes.derivative)
        known = nodes.known
        first = float(nodes.axes[0][int(known.any(axis=1).argmax())]) if known.any() else np.inf
        self.usable = slice(int(np.searchsorted(self.grid.range_m, first)), None)
        reach = tuple(2 * int(np.ceil(2 * s / k)) + 1 for s, k in zip(level.smoothing[::-1], (1, step), strict=True))
        self.seen = self._seen(np.radians(frames.sonar.elevation_fov_deg) / 2, reach)

    def _seen(self, half_elevation: float, reach: tuple[int, ...]) -> Floats | None:
        """Return 1 where a cell shows ground to be matched, else 0 ``(bins, beams)``; None where all cells do.

        The outline of the lit ground moves with the sonar and biases motions to zero. It is masked where the ground is even,
        and where most of the fan is not lit. Rocks blur it, and those that rise beyond it help.
        """
        known, lit = self.nodes.known, self.nodes.lit(LIT * half_elevation)
        mask_lit = self.nodes.attitude.even or lit.mean() < MOSTLY
        shown = known & lit if mask_lit else known
        if shown[self.nodes.from_node[0].min() :].all():
            return None
        row, column = (
            np.abs(values[:, None] - nodes).argmin(axis=1)
            for values, nodes in zip((self.grid.range_m, self.grid.bearing_rad), self.nodes.axes, strict=True)
        )
        on_all = shown[row][:, column].astype(np.uint8)
        return np.asarray(cv2.erode(on_all, np.ones(reach[::-1], np.uint8)) if mask_lit else on_all, dtype=np.float32)

    def _on_all(self, nodes: Doubles) -> Floats:
        """Interpolate from the nodes to all cells ``(2, bins, beams)``, in bins and beams."""
        full = self.grid.over_bins @ nodes.astype(np.float32) @ self.grid.over_beams
        return np.asarray(full)

    def _on_patches(self, nodes: Doubles) -> Doubles:
        """Interpolate from the nodes to the middles of the patches ``(..., 2, patches)``, in bins and beams."""
        shape = len(self.grid.range_m), len(self.grid.bearing_rad)
        row, column = (
            np.minimum(np.arange(count) * edge + edge // 2, size - 1)
            for count, edge, size in zip(self.patches, self.patch, shape, strict=True)
        )
        middles = self.grid.over_bins[:, row] @ nodes @ self.grid.over_beams[:, :, column]
        return np.asarray(middles.reshape(*nodes.shape[:-2], -1), dtype=np.float64)

    def shift(self, v: Doubles, *, back: bool = False, lift_m: float = 0.0) -> Floats:
        """Return the displacement of the ground of each cell ``(2, bins, beams)`` from the first frame to the second.

        It is in bins and beams; ``back``: from the second frame to the first; ``lift_m``: of ground so much higher.
        """
        return self._on_all(self.nodes.shift(v, back=back, lift_m=lift_m))

    def lifted_shift(self, v: Doubles) -> Doubles:
        """Return the derivative of :meth:`shift` by the height at the middles of the patches ``(2, patches)`` [1/m]."""
        return self._on_patches(self.nodes.lifted_shift(v))


class CellGrid(NamedTuple):
    """Cells of every so many bins, and splines from the nodes to all of them, in bins ``[0]`` and beams ``[1]``."""

    range_m: Doubles
    bearing_rad: Doubles
    over_bins: Floats
    over_beams: Floats
    row: Floats
    column: Floats


@lru_cache(maxsize=16)
def cell_grid(range_m: tuple[float, ...], bearing_rad: tuple[float, ...], step: int) -> CellGrid:
    ranges, axes = np.array(range_m)[step // 2 :: step], np.array(bearing_rad)
    splines = [
        np.asarray(make_interp_spline(node, np.eye(len(node)), 3)(values))
        for node, values in zip(node_axes(np.array(range_m), axes), (ranges, axes), strict=True)
    ]
    bin_m, beam_rad = (np.gradient(values)[:, None] for values in (ranges, axes))
    over_bins = np.stack([splines[0] / bin_m, splines[0]]).astype(np.float32)
    over_beams = np.stack([splines[1].T, (splines[1] / beam_rad).T]).astype(np.float32)
    row = np.arange(len(ranges), dtype=np.float32)[:, None]
    column = np.arange(len(axes), dtype=np.float32)[None, :]
    return CellGrid(ranges, axes, over_bins, over_beams, row, column)
