"""The windows of a level of optical flow, and the displacements that a motion gives them over level ground."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.geometry.ground import GroundGeometry, moved
from mitsonar.instruments.sonar import Bearing

__all__ = ["FlowLevel", "WindowGrid", "window_grid"]

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


class FlowLevel(NamedTuple):
    """One step from coarse to fine: every so many bins of frames smoothed over bins and beams (standard deviations); windows
    of so many bins and beams; at most so many rounds of flow and match."""

    step: int
    bins: float
    beams: float
    window: tuple[int, int]
    rounds: int


HIGHER = 0.02
"""The step in height that the map's change is taken from, as a part of it."""


@dataclass(frozen=True)
class WindowGrid:
    """The cells of a level's frames over the ground, and the windows over them.

    Attributes:
        ground: of the first frame.
        other: of the second frame.
        level: of the windows.
    """

    ground: GroundGeometry
    other: GroundGeometry
    level: FlowLevel

    @cached_property
    def cells(self) -> Floats:
        """Ground points of all cells ``(bins, beams, 2)``."""
        return self.ground.points.astype(np.float32)

    @cached_property
    def window(self) -> tuple[int, int]:
        """Size of the windows in this level's rows and columns."""
        bins, beams = self.level.window
        return max(3, bins // self.level.step), beams

    @cached_property
    def centres(self) -> tuple[slice, slice]:
        """The cells in the middle of the windows; these overlap by half."""
        rows, columns = (max(1, size // 2) for size in self.window)
        return slice(rows // 2, None, rows), slice(columns // 2, None, columns)

    @cached_property
    def home(self) -> Doubles:
        """Range [m] and bearing [rad] of the windows' centres ``(n, m, 2)``."""
        return np.stack(np.meshgrid(self.ground.range_m, self.ground.bearing_rad, indexing="ij"), axis=-1)[self.centres]

    @cached_property
    def spacing(self) -> Doubles:
        """Metres of a row and radians of a column at the centres ``(n, m, 2)``."""
        steps = [np.gradient(axis) for axis in (self.ground.range_m, self.ground.bearing_rad)]
        return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1)[self.centres]

    @cached_property
    def points(self) -> Doubles:
        """Ground points of the centres ``(n, m, 2)``."""
        return self.ground.points[self.centres]

    @cached_property
    def derivative(self) -> Doubles:
        """Of the centres' displacement by the motion ``(n, m, 2, 3)``; zero where they show no ground."""
        return np.nan_to_num(self.ground.derivative[self.centres])

    @cached_property
    def _higher(self) -> tuple[GroundGeometry, GroundGeometry]:
        """The sonar of both frames :data:`HIGHER` times the height of the first further up."""
        ground, other = (replace(one, height_m=one.height_m + HIGHER * self.ground.height_m) for one in self._both)
        return ground, other

    @property
    def _both(self) -> tuple[GroundGeometry, GroundGeometry]:
        return self.ground, self.other

    @cached_property
    def _higher_points(self) -> Doubles:
        """Ground points of the centres, seen from there ``(n, m, 2)``."""
        return self._higher[0].points[self.centres]

    def map(self, v: Doubles) -> Doubles:
        """Return the modelled displacement map of a motion [m, rad] ``(n, m, 2)``; zero where no ground is shown."""
        return np.nan_to_num(np.stack(self.other.to_polar(moved(self.points, v)), axis=-1) - self.home)

    def by_height(self, v: Doubles) -> Doubles:
        """How that map changes with the height, in parts of it ``(n, m, 2, 1)``."""
        map_there = np.stack(self._higher[1].to_polar(moved(self._higher_points, v)), axis=-1) - self.home
        return (np.nan_to_num(map_there - self.map(v)) / HIGHER)[..., None]


@lru_cache(maxsize=16)
def window_grid(
    range_m: tuple[float, ...],
    bearing_rad: tuple[float, ...],
    bearing: Bearing,
    first: tuple[float, float, float],
    second: tuple[float, float, float],
    level: FlowLevel,
) -> WindowGrid:
    """Return the windows of a level over level ground; of each frame height [m], pitch and roll [rad]."""
    ranges = np.array(range_m)[level.step // 2 :: level.step]
    ground, other = (GroundGeometry(ranges, np.array(bearing_rad), bearing, *pose) for pose in (first, second))
    return WindowGrid(ground, other, level)
