"""Level ground at a few nodes of a frame, and how it moves with the sonar: what lies between them is smooth."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mitsonar.geometry.ground import Attitude, GroundGeometry, margin_of_light, moved, nearest_known
from mitsonar.motion.composition import Motion, inverse
from mitsonar.records.frames import SonarFrames

__all__ = ["NODES", "GroundNodes", "node_axes"]

Doubles = NDArray[np.float64]

NODES = (33, 17)
"""Nodes along range and bearing."""

LEAN_STEP = 1e-4
"""Step of heights [m], pitch and roll [rad] of a frame for numerical derivatives."""

HEIGHT_STEP = 0.05
"""Step of the height for numerical derivatives, as a part of it."""


def node_axes(range_m: Doubles, bearing_rad: Doubles) -> tuple[Doubles, Doubles]:
    """Return ranges [m] and bearings [rad] of the nodes: from the first to the last cell."""
    return np.linspace(range_m[0], range_m[-1], NODES[0]), np.linspace(bearing_rad[0], bearing_rad[-1], NODES[1])


class GroundNodes:
    """The nodes of a pair of frames, which all levels share.

    Args:
        frames: whose axes they span.
        attitude: of the sonar.
        heave: whether the derivative has a fourth component, by the sonar's height.

    Attributes:
        known: whether a node meets the ground ``(nodes, nodes)``.
        derivative: of range [m] and bearing [rad] by motion (and heave) ``(3 or 4, 2, nodes, nodes)``.
    """

    def __init__(self, frames: SonarFrames, attitude: Attitude, *, heave: bool) -> None:
        self.frames, self.attitude, self.heave = frames, attitude, heave
        self.axes = node_axes(frames.range_m, frames.bearing_rad)
        self.ground = self._ground(None)
        self.known = np.asarray(np.isfinite(self.ground.points).all(axis=-1), dtype=bool)
        self.from_node = nearest_known(self.known)
        self.derivative = self._derivative(self.ground)

    def _ground(self, number: int | None, lift_m: float = 0.0) -> GroundGeometry:
        """Return the geometry of the nodes, of the frames' mean or of one frame, over ground raised by ``lift_m``."""
        attitude = self.attitude
        mean = attitude.height_m - lift_m, attitude.pitch_rad, attitude.roll_rad
        pose = mean if number is None else attitude.of_frame(number, lift_m)
        return GroundGeometry(*self.axes, self.frames.sonar.bearing, *pose)

    @cached_property
    def _of_frames(self) -> tuple[GroundGeometry, GroundGeometry]:
        """Return the geometry of the nodes in each frame."""
        return (self._ground(0), self._ground(1)) if self.attitude.apart else (self.ground, self.ground)

    @cached_property
    def _from_nodes_of_frames(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Return the nodes of each frame whose values its nodes take."""
        if not self.attitude.apart:
            return [self.from_node, self.from_node]
        return [nearest_known(np.asarray(np.isfinite(one.points).all(axis=-1))) for one in self._of_frames]

    def _derivative(self, ground: GroundGeometry) -> Doubles:
        """Return the derivative by motion (and heave), that of the nearest node where a node meets no ground."""
        nodes = np.moveaxis(ground.derivative, (3, 2), (0, 1))
        if self.heave:
            nodes = np.concatenate([nodes, np.moveaxis(ground.derivative_by_height, 2, 0)[None]])
        return np.nan_to_num(nodes[:, :, self.from_node[0], self.from_node[1]])

    @cached_property
    def shown(self) -> tuple[NDArray[np.bool_], bool]:
        """Return which nodes show ground to be matched ``(nodes, nodes)``, and whether the outline of the light is masked.

        See :func:`mitsonar.geometry.ground.margin_of_light`.
        """
        margin = margin_of_light(self.ground, self.attitude, self.frames.sonar.elevation_fov_deg)
        return (self.known, False) if margin is None else (self.known & (margin >= 0), True)

    @cached_property
    def key(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return ranges and bearings of the frames' cells, to be looked up by."""
        return tuple(self.frames.range_m.tolist()), tuple(self.frames.bearing_rad.tolist())

    def shift(self, v: Doubles, *, back: bool, lift_m: float) -> Doubles:
        """Return the displacement of the nodes in range [m] and bearing [rad]; see :meth:`Cells.shift`."""
        ground, other = self._of_frames[:: -1 if back else 1]
        if lift_m:
            ground, other = (replace(one, height_m=one.height_m - lift_m) for one in (ground, other))
        if self.heave:
            half = float(v[3]) / (2 if back else -2)
            ground, other = replace(ground, height_m=ground.height_m + half), replace(other, height_m=other.height_m - half)
        nodes = self._between(ground, other, inverse(v[:3]) if back else v[:3])
        # a cell that meets level ground may not meet ground that lies lower
        known = self._from_nodes_of_frames[int(back)]
        row, column = nearest_known(np.asarray(np.isfinite(nodes).all(axis=0), dtype=bool)) if lift_m else known
        return np.asarray(nodes[:, row, column], dtype=np.float64)

    def _between(self, ground: GroundGeometry, other: GroundGeometry, motion: Doubles | Motion) -> Doubles:
        """Return the displacement of the ground of the nodes of one frame in another ``(2, nodes, nodes)``; nan off it."""
        radius, bearing = other.to_polar(moved(ground.points, motion))
        return np.stack([radius - self.axes[0][:, None], bearing - self.axes[1]])

    def leaning_shift(self, v: Doubles) -> Doubles:
        """Return the derivative of :meth:`shift` by what the second frame's height, pitch and roll exceed the first's.

        Returns:
            Ranges [m] and bearings [rad] a metre of height, a radian of pitch and of roll ``(3, 2, nodes, nodes)``; 0 where
            nothing is unknown.
        """
        if not any(self.attitude.unsure):
            return np.zeros((3, *self.derivative.shape[1:]))
        row, column = self._from_nodes_of_frames[0]
        changes = []
        for name in ("height_m", "pitch_rad", "roll_rad"):
            ends = []
            for sign in (-1, 1):
                ground, other = (
                    replace(one, **{name: getattr(one, name) + way * sign * LEAN_STEP / 2})
                    for one, way in zip(self._of_frames, (-1, 1), strict=True)
                )
                ends.append(self._between(ground, other, v[:3]))
            changes.append((ends[1] - ends[0]) / (2 * LEAN_STEP))
        return np.nan_to_num(np.stack(changes)[:, :, row, column])

    def lifted_shift(self, v: Doubles) -> Doubles:
        """Return the derivative of :meth:`shift` by the height [m/m, rad/m]."""
        change = HEIGHT_STEP * self.attitude.height_m
        higher, lower = (self.shift(v, back=False, lift_m=lift_m) for lift_m in (-change, change))
        return (higher - lower) / (2 * change)
