"""The cells of a frame over level ground, and how a motion shifts them."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from mitsonar.geometry.attitude import Attitude
from mitsonar.geometry.ground_plane import GroundGeometry, moved, nearest_known
from mitsonar.geometry.lit_ground import margin_of_light
from mitsonar.motion.composition import inverse
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["Cells", "DirectLevel"]

Floats = NDArray[np.float32]


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


HEIGHT_STEP = 0.05
"""Step of the height for numerical derivatives, as a part of it."""


class Cells:
    """The cells of one level: where they are, and how they move with the sonar, in bins and beams."""

    def __init__(self, frames: SonarFrames, attitude: Attitude, level: DirectLevel, *, heave: bool) -> None:
        step = level.step
        reach = tuple(2 * int(np.ceil(2 * s / k)) + 1 for s, k in zip(level.smoothing[::-1], (1, step), strict=True))
        self.bearing, self.attitude, self.heave = frames.sonar.bearing, attitude, heave
        self.grid = cell_grid(tuple(frames.range_m.tolist()), tuple(frames.bearing_rad.tolist()), step)
        self.row, self.column = self.grid.row, self.grid.column
        self.ground = self._ground(attitude.height_m)
        known = np.asarray(np.isfinite(self.ground.points).all(axis=-1), dtype=bool)
        self.from_node = nearest_known(known)
        first = int(known.any(axis=1).argmax()) if known.any() else len(known)
        self.usable = slice(
            int(np.searchsorted(self.grid.range_m, self.grid.node_range[first])) if known.any() else 10**9, None
        )
        self.nodes = self._nodes(attitude.height_m)
        self.derivative = self._on_all(self.nodes)
        self.seen = self._seen(known, frames.sonar.elevation_fov_deg, reach)

    def _ground(self, height: float) -> GroundGeometry:
        """Return the geometry at the nodes."""
        grid, attitude = self.grid, self.attitude
        return GroundGeometry(
            grid.node_range, grid.node_bearing, self.bearing, height, attitude.pitch_rad, attitude.roll_rad
        )

    def _nodes(self, height: float) -> Floats:
        """Return the derivative at the nodes by motion (and heave) ``(3 or 4, 2, nodes, nodes)``."""
        ground = self._ground(height)
        nodes = np.moveaxis(ground.derivative, (3, 2), (0, 1))
        if self.heave:
            nodes = np.concatenate([nodes, np.moveaxis(ground.derivative_by_height, 2, 0)[None]])
        return np.nan_to_num(nodes[:, :, self.from_node[0], self.from_node[1]]).astype(np.float32)

    def _seen(self, known: NDArray[np.bool_], elevation_fov_deg: float, reach: tuple[int, ...]) -> Floats | None:
        """Return 1 where a cell shows ground to be matched, else 0 ``(bins, beams)``; None where all cells do.

        See :func:`mitsonar.geometry.lit_ground.margin_of_light`.
        """
        margin = margin_of_light(self.ground, self.attitude, elevation_fov_deg)
        shown = known if margin is None else known & (margin >= 0)
        if shown[self.from_node[0].min() :].all():
            return None
        grid = self.grid
        row, column = (
            np.abs(values[:, None] - nodes).argmin(axis=1)
            for values, nodes in ((grid.range_m, grid.node_range), (grid.bearing_rad, grid.node_bearing))
        )
        on_all = shown[row][:, column].astype(np.uint8)
        return np.asarray(
            cv2.erode(on_all, np.ones(reach[::-1], np.uint8)) if margin is not None else on_all, dtype=np.float32
        )

    def _on_all(self, nodes: Floats) -> Floats:
        """Interpolate from the nodes to all cells ``(..., 2, bins, beams)``, in bins and beams."""
        full = self.grid.over_bins @ nodes @ self.grid.over_beams.T
        full[..., 0, :, :] /= self.grid.bin_m[:, None]
        full[..., 1, :, :] /= self.grid.beam_rad
        return np.asarray(full)

    def shift(self, v: NDArray[np.float64], *, back: bool = False, lift_m: float = 0.0) -> Floats:
        """Return the displacement of the ground of each cell ``(2, bins, beams)`` from the first frame to the second.

        It is in bins and beams; ``back``: from the second frame to the first; ``lift_m``: of ground so much higher.
        """
        ground = other = self._ground(self.attitude.height_m - lift_m) if lift_m else self.ground
        if self.heave:
            half = float(v[3]) / (2 if back else -2)
            ground, other = (self._ground(self.attitude.height_m + change) for change in (half, -half))
        motion = inverse(v[:3]) if back else v[:3]
        radius, bearing = other.to_polar(moved(ground.points, motion))
        grid = self.grid
        nodes = np.stack([radius - grid.node_range[:, None], bearing - grid.node_bearing])
        # a cell that meets level ground may not meet ground that lies lower
        row, column = nearest_known(np.asarray(np.isfinite(nodes).all(axis=0), dtype=bool)) if lift_m else self.from_node
        return self._on_all(nodes[:, row, column].astype(np.float32))

    def lifted_shift(self, v: NDArray[np.float64]) -> Floats:
        """Return the derivative of :meth:`shift` by the height [1/m], to first order in the motion."""
        change = HEIGHT_STEP * self.attitude.height_m
        other = self._nodes(self.attitude.height_m + change)
        return self._on_all(np.tensordot(v.astype(np.float32) / np.float32(change), other - self.nodes, axes=1))

    def along(self, slopes: tuple[Floats, Floats], inner: tuple[slice, slice]) -> Floats:
        """Return the derivative of the image by each component of the motion ``(3 or 4, cells)``."""
        by_bin, by_beam = slopes[0][inner], slopes[1][inner]
        jacobian = np.empty((len(self.derivative), *by_bin.shape), dtype=np.float32)
        for out, (bins, beams) in zip(jacobian, self.derivative, strict=True):
            np.multiply(by_bin, bins[inner], out=out)
            out += by_beam * beams[inner]
            if self.seen is not None:
                out *= self.seen[inner]
        return jacobian.reshape(len(jacobian), -1)


class CellGrid(NamedTuple):
    """Cells of every so many bins, and splines from few nodes to all of them: the geometry is smooth."""

    range_m: NDArray[np.float64]
    bearing_rad: NDArray[np.float64]
    node_range: NDArray[np.float64]
    node_bearing: NDArray[np.float64]
    over_bins: Floats
    over_beams: Floats
    bin_m: Floats
    beam_rad: Floats
    row: Floats
    column: Floats


@lru_cache(maxsize=16)
def cell_grid(range_m: tuple[float, ...], bearing_rad: tuple[float, ...], step: int) -> CellGrid:
    ranges, axes = np.array(range_m)[step // 2 :: step], np.array(bearing_rad)
    nodes = [np.linspace(values[0], values[-1], count) for values, count in ((ranges, 33), (axes, 17))]
    splines = [
        np.asarray(make_interp_spline(node, np.eye(len(node)), 3)(values), dtype=np.float32)
        for node, values in zip(nodes, (ranges, axes), strict=True)
    ]
    row = np.arange(len(ranges), dtype=np.float32)[:, None]
    column = np.arange(len(axes), dtype=np.float32)[None, :]
    spacing = [np.gradient(values).astype(np.float32) for values in (ranges, axes)]
    return CellGrid(ranges, axes, nodes[0], nodes[1], splines[0], splines[1], spacing[0], spacing[1], row, column)
