"""Frames as seen from above: projected to the level ground, for methods that register maps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.geometry.ground import Attitude, GroundGeometry, moved
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion
from mitsonar.records.frames import SonarFrames

__all__ = ["GroundView", "fan_places"]

Floats = NDArray[np.float32]

MOST_CELLS = 2**20
"""Of a view: a window of many metres gets larger cells."""


@dataclass(frozen=True)
class GroundView:
    """The part of the ground that a fan shows, as an image: row 0 farthest forward, column 0 most to port.

    Args:
        frames: whose cells are projected.
        attitude: height over what is seen, pitch, roll.
        cell_m: edge of a pixel; larger where the view would have more than a million.
        most_along: pixels along the longer side; they are larger where it would have more.
    """

    frames: SonarFrames
    attitude: Attitude
    cell_m: float
    most_along: int = MOST_CELLS

    @cached_property
    def _geometry(self) -> GroundGeometry:
        return self.attitude.ground(self.frames)

    @cached_property
    def edge(self) -> float:
        """Edge of a pixel [m]."""
        left, right, near, far = self.reach
        whole = float(np.sqrt((right - left) * (far - near) / MOST_CELLS))
        return max(self.cell_m, whole, max(right - left, far - near) / self.most_along)

    @cached_property
    def reach(self) -> tuple[float, float, float, float]:
        """Ground seen: starboard from, to, forward from, to [m]; all 0 where the fan meets no ground."""
        f = self.frames
        few = (f.range_m[::8], f.bearing_rad[::4]), (f.range_m[[0, -1]], f.bearing_rad)
        geometries = [replace(self._geometry, range_m=ranges, bearing_rad=bearings) for ranges, bearings in few]
        points = np.concatenate([geometry.points.reshape(-1, 2) for geometry in geometries])
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            return 0.0, 0.0, 0.0, 0.0
        (left, near), (right, far) = points.min(axis=0), points.max(axis=0)
        return float(left), float(right), float(near), float(far)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Ground of each pixel: starboard, forward [m] ``(rows, columns, 2)``."""
        left, right, near, far = self.reach
        x = np.arange(left, right, self.edge) + self.edge / 2
        y = np.arange(far, near, -self.edge) - self.edge / 2
        return np.stack(np.meshgrid(x, y), axis=-1)

    @cached_property
    def _pixel_positions(self) -> list[tuple[Floats, Floats, NDArray[np.bool_]]]:
        """Row and column in each frame of each pixel, and whether it is inside and lit ``(rows, columns)``."""
        numbers = range(len(self.attitude.apart)) if self.attitude.apart else (None,)
        return [fan_places(self.attitude.ground(self.frames, k), self.frames.sonar, self.points) for k in numbers]

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Pixels within the fans that the sonar can light, were the ground level ``(rows, columns)``.

        What lies around them is dark in every frame: an outline that moves with the sonar.
        """
        return np.asarray(np.all([lit for _, _, lit in self._pixel_positions], axis=0))

    def draw(self, image: Floats, number: int = 0) -> Floats:
        """Draw the image ``(bins, beams)`` of a frame as seen from above ``(rows, columns)``; 0 outside the fan."""
        row, column, _ = self._pixel_positions[number if self.attitude.apart else 0]
        if not row.size:
            return np.zeros((0, 0), dtype=np.float32)
        finer = self.edge / float(np.median(np.diff(self.frames.range_m)))
        if finer > 1:  # bins are finer than pixels
            border = cv2.BORDER_REPLICATE
            image = np.asarray(
                cv2.GaussianBlur(image, (1, 0), sigmaX=1e-3, sigmaY=0.4 * finer, borderType=border), np.float32
            )
        return np.asarray(cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), np.float32)

    def warp(self, motion: Motion) -> NDArray[np.float32]:
        """Where a motion takes a pixel (column, row) of the first frame, as a matrix ``(2, 3)``."""
        corner = np.array([self.reach[0], self.reach[3]]) + self.edge / 2 * np.array([1, -1])
        pixels = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        there = moved(corner + pixels * [self.edge, -self.edge], motion)
        there = (there - corner) / [self.edge, -self.edge]
        return np.column_stack([there[1] - there[0], there[2] - there[0], there[0]]).astype(np.float32)

    def motion(self, warp: NDArray[np.floating]) -> Motion:
        """Return the motion of a warp, the inverse of :meth:`warp`."""
        yaw = float(np.arctan2(warp[0, 1], warp[0, 0]))
        still = self.warp(Motion(0.0, 0.0, yaw)).astype(float)
        step = (warp[:, 2] - still[:, 2]) * self.edge
        return Motion(float(-step[0]), float(step[1]), yaw)


def fan_places(
    ground: GroundGeometry, sonar: Sonar, points: NDArray[np.float64]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Find the cells of a frame that show points of the ground.

    Args:
        ground: under the frame, with its ranges and bearings.
        sonar: that received it: it lights what is within the opening of its beams.
        points: starboard, forward [m] ``(..., 2)``.

    Returns:
        Row and column in the frame, -1 beyond its cells; and whether a point is within them and lit; each ``(...)``.
    """
    radius, bearing = ground.to_polar(points)
    row = np.interp(radius, ground.range_m, np.arange(len(ground.range_m)), left=-1, right=-1)
    column = np.interp(bearing, ground.bearing_rad, np.arange(len(ground.bearing_rad)), left=-1, right=-1)
    lit = np.abs(ground.elevation(points)) <= np.radians(sonar.elevation_fov_deg) / 2
    return row.astype(np.float32), column.astype(np.float32), (row >= 0) & (column >= 0) & lit
