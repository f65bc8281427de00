"""Compute the image that a sonar makes of a height map, with its derivatives by the heights.

The ground is divided into columns of equal azimuth around the sonar. Along a column, the tangent of the elevation at which
the sonar sees the ground is t = (z - z_sonar) / r. Where t exceeds its maximum over nearer ground, the sonar sees the
ground, and the increase of this maximum is the elevation that a segment of the column fills. Its level is that of the model
``physical``, C cos(theta) dOmega R^(g - 2) (:func:`mitsonar.acoustics.levels.level`), times the pattern over elevation.
Shadows and silhouettes have derivatives, because a segment that is partly hidden fills less elevation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from mitsonar.acoustics.water import loss_of, noise_of, undone_absorption
from mitsonar.geometry.ground import GroundGeometry, moved
from mitsonar.instruments.beams import Pulse, half_power
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose, vehicle_rotation

__all__ = ["GroundCells", "ReliefView", "lit_ground"]

Array = NDArray[np.float64]
Sparse: TypeAlias = "sparse.csr_array[Any, Any]"

POINTS_PER_BLOCK = 2
"""Number of columns per block of beams, and of points of a column per block of bins."""

STEP_M = 1e-6
"""Step of the finite differences within a segment [m]."""

LAGS = 12
"""Largest distance, in beams or bins, at which speckle is correlated."""

MOST_COLUMNS = 4096

FAINTEST = 0.01
"""Smallest power of the pattern over elevation at which ground counts as lit, relative to the axis."""


@dataclass(frozen=True)
class GroundCells:
    """Square cells of level ground in world axes.

    Attributes:
        west_m: western edge [m].
        south_m: southern edge [m].
        cell_m: edge of a cell [m].
        cells: number of cells along an edge; maps are ``(cells, cells)``, with the southernmost row first.
        ground_m: height of the plane that maps are measured from, and of the ground outside the cells [m].
    """

    west_m: float
    south_m: float
    cell_m: float
    cells: int
    ground_m: float

    @property
    def centres(self) -> tuple[Array, Array]:
        """Return x and y of the centres ``(cells, cells)`` [m]."""
        steps = (np.arange(self.cells) + 0.5) * self.cell_m
        x, y = np.meshgrid(self.west_m + steps, self.south_m + steps)
        return x, y

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return whether points ``(..., 2)`` [m] lie within the cells; nan does not."""
        offset = (points - [self.west_m, self.south_m]) / self.cell_m
        return np.asarray(((offset >= 0) & (offset <= self.cells)).all(axis=-1))

    def interpolation(self, x: Array, y: Array) -> Sparse:
        """Return the matrix ``(points, cells^2)`` of bilinear interpolation between centres; rows outside are empty."""
        u, v = (x.ravel() - self.west_m) / self.cell_m - 0.5, (y.ravel() - self.south_m) / self.cell_m - 0.5
        inside = np.flatnonzero((np.minimum(u, v) >= -0.5) & (np.maximum(u, v) <= self.cells - 0.5))
        u, v = (np.clip(place[inside], 0, self.cells - 1) for place in (u, v))
        column, row = (np.minimum(place.astype(int), self.cells - 2) for place in (u, v))
        u, v = u - column, v - row
        corners = [(0, 0, (1 - u) * (1 - v)), (0, 1, u * (1 - v)), (1, 0, (1 - u) * v), (1, 1, u * v)]
        index = np.concatenate([(row + up) * self.cells + column + right for up, right, _ in corners])
        weight = np.concatenate([weight for _, _, weight in corners])
        return sparse.csr_array((weight, (np.tile(inside, 4), index)), shape=(x.size, self.cells**2))


def lit_ground(
    sonar: Sonar, bearing_rad: Array, range_m: Array, pose: Array, ground_m: float, *, in_view: bool = False
) -> Array:
    """Compute the points of level ground that the cells of an image show, in world axes.

    Args:
        sonar: the instrument.
        bearing_rad: bearings of the cells ``(beams,)`` [rad].
        range_m: ranges of the cells ``(bins,)`` [m].
        pose: pose of the sonar ``(6,)`` [m, rad].
        ground_m: height of the ground [m].
        in_view: whether only ground within the elevation field of view counts, not what the pattern lights beyond it.

    Returns:
        Points ``(bins, beams, 2)`` [m]; nan where a cell shows no lit ground.
    """
    geometry = GroundGeometry(range_m, bearing_rad, sonar.bearing, float(pose[2] - ground_m), float(pose[3]), float(pose[4]))
    points = geometry.points
    with np.errstate(invalid="ignore"):
        most = math.radians(sonar.elevation_fov_deg) / 2 if in_view else _lit_elevation(sonar)
        lit = np.abs(geometry.elevation(points)) <= most
    world = np.asarray(moved(points, (0.0, 0.0, -float(pose[5]))), dtype=float) + pose[:2]
    return np.where(lit[..., None], world, np.nan)


def _lit_elevation(sonar: Sonar) -> float:
    """Return the largest elevation at which the pattern has the power :data:`FAINTEST` [rad]."""
    half = math.radians(sonar.elevation_fov_deg) / 2
    if sonar.vertical_pattern == "box":
        return half
    elevation = np.linspace(0, math.pi / 2, 1000)
    faint = _elevation_power(sonar, elevation) < FAINTEST
    return float(elevation[np.argmax(faint)]) if faint.any() else math.pi / 2


def _elevation_power(sonar: Sonar, elevation: Array) -> Array:
    """Return the two-way power of the pattern over elevation, without lobes beside the main one; 1 on the axis."""
    half = math.radians(sonar.elevation_fov_deg) / 2
    if sonar.vertical_pattern == "box":
        return (np.abs(elevation) <= half).astype(float)
    power = 4 if sonar.vertical_pattern == "two_way" else 2
    x = np.sin(elevation) * half_power((), power) / math.sin(half)
    return np.asarray(np.where(np.abs(x) < 1, np.sinc(x) ** power, 0.0))


class ReliefView:
    """The image of a height map in one frame, averaged over blocks of bins and beams that are about half a cell wide.

    Args:
        sonar: the instrument, with the window of the frame.
        bearing_rad: bearings of the frame ``(beams,)`` [rad].
        pose: pose of the sonar ``(6,)`` [m, rad].
        grid: cells of the map.

    Attributes:
        bins: number of bins in a block.
        beams: number of beams in a block.
        shape: number of blocks along range and bearing.
        used: blocks whose ground is lit and lies within the cells, shaped so.
        in_view: those of them whose ground lies within the elevation field of view, shaped so.
        noise: mean level of the receiver noise, shaped so.
        looks: number of independent samples of speckle in a block; infinite without speckle.
    """

    def __init__(self, sonar: Sonar, bearing_rad: Array, pose: Array, grid: GroundCells) -> None:
        self.sonar, self.grid, self.position = sonar, grid, np.asarray(pose[:3], dtype=float)
        self.axes = vehicle_rotation(Pose.from_row(pose)).as_matrix().reshape(3, 3)
        points = lit_ground(sonar, bearing_rad, sonar.range_m, pose, grid.ground_m)
        inside = grid.contains(points)
        # 1. Blocks about half a cell wide, but not narrower than a beam.
        middle = float(np.median(sonar.range_m[inside.any(axis=1)])) if inside.any() else sonar.range_max
        spacing = float(np.diff(bearing_rad).mean())
        width = max(0.5 * grid.cell_m / middle, sonar.beam_width_rad)
        self.bins = int(np.clip(round(0.5 * grid.cell_m / sonar.bin_m), 1, max(1, sonar.range_bins // 8)))
        self.beams = int(np.clip(round(width / spacing), 1, max(1, len(bearing_rad) // 4)))
        self.shape = sonar.range_bins // self.bins, len(bearing_rad) // self.beams
        self.block_m = self.bins * sonar.bin_m
        middles = (np.arange(self.shape[0]) + 0.5) * self.block_m
        self.range_m: Array = np.asarray(sonar.range_min + middles, dtype=np.float64)
        self.bearing_rad = self._blocks(np.broadcast_to(bearing_rad, (sonar.range_bins, len(bearing_rad))))[0]
        shown = [
            lit_ground(sonar, self.bearing_rad, self.range_m, pose, grid.ground_m, in_view=part) for part in (False, True)
        ]
        self.used, self.in_view = (grid.contains(ground) for ground in shown)
        self.noise = self._blocks(np.broadcast_to(noise_of(sonar)[:, None], (sonar.range_bins, len(bearing_rad))))
        # 2. A block collects the echoes of its bins and beams; a beam has the level of a box as wide as itself.
        apart = np.gradient(self.bearing_rad)
        if sonar.beam_pattern != "box":
            apart = apart * np.cos(self.bearing_rad)  # the width of a pattern is a difference of sines
        self._scale = sonar.beam_width_rad / apart / self.bins
        self._gain = sonar.range_m ** (sonar.gain_exponent - 2.0) * loss_of(sonar) * undone_absorption(sonar)
        self._columns(points[np.isfinite(points).all(axis=-1)])

    def _columns(self, ground: Array) -> None:
        """Place the columns: azimuths, radii, and the interpolation of heights at their points."""
        offset = ground - self.position[:2]
        radius = np.hypot(*offset.T)
        forward = math.atan2(self.axes[0, 1], self.axes[1, 1])
        turn = (np.arctan2(offset[:, 0], offset[:, 1]) - forward + np.pi) % (2 * np.pi) - np.pi
        apart = float(np.diff(self.bearing_rad).mean())
        low, high = max(turn.min() - 2 * apart, -math.pi), min(turn.max() + 2 * apart, math.pi)
        count = min(MOST_COLUMNS, math.ceil((high - low) / apart * POINTS_PER_BLOCK))
        self._width = (high - low) / count
        self.azimuth = forward + low + (np.arange(count) + 0.5) * self._width
        margin = 2 * self.grid.cell_m
        near = max(radius.min() - margin, 0.25 * self.block_m)
        self.radius = np.arange(near, radius.max() + margin, self.block_m / POINTS_PER_BLOCK)
        x = self.position[0] + np.sin(self.azimuth)[:, None] * self.radius
        y = self.position[1] + np.cos(self.azimuth)[:, None] * self.radius
        self._heights = self.grid.interpolation(x, y)

    def _blocks(self, values: Array) -> Array:
        """Average values ``(bins, beams)`` over blocks."""
        rows, columns = self.shape
        cut = values[: rows * self.bins, : columns * self.beams]
        return np.asarray(cut.reshape(rows, self.bins, columns, self.beams).mean(axis=(1, 3)), dtype=np.float64)

    def averaged(self, levels: NDArray[np.floating]) -> Array:
        """Return the mean levels of an image ``(bins, beams)`` in its blocks."""
        return self._blocks(np.asarray(levels, dtype=float))

    @cached_property
    def looks(self) -> float:
        """Return the number of independent samples of speckle per block: its cells, less what neighbours share."""
        sonar = self.sonar
        if sonar.model != "coherent":
            return math.inf
        lags = np.arange(-LAGS, LAGS + 1)
        apart = float(np.diff(np.sin(self.bearing_rad)).mean()) / self.beams
        samples = float(sonar.looks * self.bins * self.beams)
        for spectrum, step in ((Pulse(sonar.resolution_m).spectrum(), sonar.bin_m), (sonar.aperture.spectrum(), apart)):
            samples /= max(1.0, float(np.square(spectrum.coherence(lags * step)).sum()))
        return samples

    def blocks_of(self, points: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the row and column of the blocks that hold points ``(..., 3)`` [m]; -1 beyond the beams."""
        offset = (points - self.position) @ self.axes
        distance = np.linalg.norm(offset, axis=-1)
        starboard, forward = offset[..., 0], offset[..., 1]
        cone = np.arcsin(np.clip(starboard / distance, -1, 1))
        bearing = cone if self.sonar.bearing == "cone" else np.arctan2(starboard, forward)
        row = np.floor((distance - self.range_m[0]) / self.block_m + 0.5).astype(np.intp)
        numbers = np.arange(len(self.bearing_rad))
        column = np.rint(np.interp(bearing, self.bearing_rad, numbers, left=-1, right=-1)).astype(np.intp)
        return row, np.where(forward > 0, column, -1)

    # ---------------- Levels and derivatives

    def levels(self, height_m: Array) -> Array:
        """Compute the mean levels of a height map ``(cells, cells)`` [m] of reflectivity 1, without noise, in the blocks."""
        return self._render(height_m)[0]

    def derivative(self, height_m: Array) -> tuple[Array, Sparse]:
        """Compute the levels in the blocks, and their derivatives ``(blocks, cells^2)`` by the heights [1/m]."""
        levels, segments = self._render(height_m)
        count, points = len(segments.level), self._heights.shape[0]
        # 1. Derivatives of each segment by its ends, by the height that hides its begin, and by its slope across.
        changes: list[list[Array]] = [[], [], []]
        for number in range(len(segments.heights)):
            ends = []
            for sign in (1, -1):
                changed = list(segments.heights)
                changed[number] = changed[number] + sign * STEP_M
                ends.append(self._segment(changed, segments))
            for change, high, low in zip(changes, *ends, strict=True):
                change.append((high - low) / (2 * STEP_M))
        # 2. By the heights of the points: the slope is a difference of the neighbouring columns.
        rows = np.tile(np.arange(count), 3 + len(segments.across))
        columns = np.concatenate([*segments.points, *(index for index, _ in segments.across)])

        def by_points(parts: list[Array]) -> Sparse:
            values = [*parts[:3], *(parts[3] * sign for _, sign in segments.across)]
            return sparse.csr_array((np.concatenate(values), (rows, columns)), shape=(count, points)) @ self._heights

        # 3. The level of a segment that changes its range or bearing moves from one block to the next.
        by_level, by_range, by_bearing = changes
        total = self._deposit(segments) @ by_points(by_level)
        for axis, change in enumerate((by_range, by_bearing)):
            moved_levels = by_points([values * segments.level for values in change])
            total = total + self._deposit(segments, axis) @ moved_levels
        return levels, total.tocsr()

    def _render(self, height_m: Array) -> tuple[Array, _Segments]:
        """Return the levels in the blocks, and the segments that the sonar sees."""
        ground, columns, points = self.grid.ground_m, len(self.azimuth), len(self.radius)
        height = (self._heights @ (height_m.ravel() - ground)).reshape(columns, points) + ground
        # 1. Segments are seen where the tangent exceeds its maximum over nearer points.
        tangent = (height - self.position[2]) / self.radius
        highest = np.maximum.accumulate(tangent, axis=1)
        column, begin = np.nonzero(tangent[:, 1:] > highest[:, :-1])
        hiding = np.maximum.accumulate(np.where(tangent >= highest, np.arange(points), 0), axis=1)[column, begin]
        # 2. Slope across, from the neighbouring columns.
        right, left = np.minimum(column + 1, columns - 1), np.maximum(column - 1, 0)
        middle = (self.radius[begin] + self.radius[begin + 1]) / 2
        share = 1 / (2 * (right - left) * self._width * middle)
        across = [(side * points + begin + end, sign * share) for side, sign in ((right, 1), (left, -1)) for end in (0, 1)]
        flat = height.ravel()
        slope = np.sum([sign * flat[index] for index, sign in across], axis=0)
        indices = [column * points + begin, column * points + begin + 1, column * points + hiding]
        segments = _Segments(
            points=indices,
            across=across,
            heights=[*(flat[index] for index in indices), slope],
            radius=(self.radius[begin], self.radius[begin + 1], self.radius[hiding]),
            sine=np.sin(self.azimuth)[column],
            cosine=np.cos(self.azimuth)[column],
        )
        segments.level, segments.range_m, segments.bearing_rad = self._segment(segments.heights, segments)
        image = (self._deposit(segments) @ segments.level).reshape(self.shape)
        return image, segments

    def _segment(self, heights: list[Array], segments: _Segments) -> tuple[Array, Array, Array]:
        """Return the level, range [m] and bearing [rad] of segments with given heights of their ends, and slope across."""
        begin, end, hiding, across = heights
        near, far, hidden = segments.radius
        # 1. Range and angle of incidence in the middle.
        radius, below = (near + far) / 2, self.position[2] - (begin + end) / 2
        along = (end - begin) / (far - near)
        distance = np.sqrt(radius * radius + below * below)
        facing = np.maximum(below + radius * along, 0) / (distance * np.sqrt(1 + along * along + across * across))
        # 2. Sines of the elevations between which it is seen; their difference times the azimuth is its solid angle.
        sines = []
        for height, place in ((end, far), (hiding, hidden)):
            tangent = (height - self.position[2]) / place
            sines.append(tangent / np.sqrt(1 + tangent * tangent))
        # 3. Bearing and elevation in the axes of the sonar.
        world = radius * segments.sine, radius * segments.cosine, -below
        starboard, forward, up = (sum(world[i] * self.axes[i, k] for i in range(3)) for k in range(3))
        if self.sonar.bearing == "cone":
            bearing, elevation = np.arcsin(np.clip(starboard / distance, -1, 1)), np.arctan2(up, forward)
        else:
            bearing, elevation = np.arctan2(starboard, forward), np.arctan2(up, np.hypot(starboard, forward))
        gain = np.interp(distance, self.sonar.range_m, self._gain)
        level = facing * (sines[0] - sines[1]) * self._width * gain * _elevation_power(self.sonar, elevation)
        return level, distance, bearing

    def _deposit(self, segments: _Segments, moving: int | None = None) -> Sparse:
        """Return the share of each segment in each block ``(blocks, segments)``, linear between the centres of blocks.

        With ``moving``, it is the derivative of the share by the range (0) [1/m] or the bearing (1) [1/rad].
        """
        # 1. Blocks on both sides along range and bearing, their shares, and the derivatives of these.
        sides = []
        for value, centres, axis in ((segments.range_m, self.range_m, 0), (segments.bearing_rad, self.bearing_rad, 1)):
            block = np.clip(np.searchsorted(centres, value) - 1, 0, len(centres) - 2)
            apart = np.diff(centres)[block]
            part = (value - centres[block]) / apart
            block, part = block + np.floor(part).astype(int), part - np.floor(part)  # beyond the ends, blocks repeat
            shares = (-1 / apart, 1 / apart) if moving == axis else (1 - part, part)
            sides.append([(block + step, shares[step]) for step in (0, 1)])
        # 2. The four blocks around each segment.
        parts = []
        for row, down in sides[0]:
            for column, right in sides[1]:
                within = (row >= 0) & (row < self.shape[0]) & (column >= 0) & (column < self.shape[1])
                where = np.flatnonzero(within)
                block_column = column[where]
                share = (down * right)[where] * self._scale[block_column]
                parts.append((share, row[where] * self.shape[1] + block_column, where))
        share, block, segment = (np.concatenate(part) for part in zip(*parts, strict=True))
        return sparse.csr_array((share, (block, segment)), shape=(math.prod(self.shape), len(segments.level)))


@dataclass
class _Segments:
    """Segments that the sonar sees.

    Attributes:
        points: flat indices of the points where each begins and ends, and of the nearer point that hides its begin.
        across: flat indices of four points of the neighbouring columns, with the factors that give the slope across [1/m].
        heights: heights of the three points [m], and the slope across.
        radius: horizontal distances of the three points [m].
        sine: sine of the azimuth.
        cosine: cosine of the azimuth.
        level: level of each segment.
        range_m: range of its middle [m].
        bearing_rad: bearing of its middle [rad].
    """

    points: list[NDArray[np.intp]]
    across: list[tuple[NDArray[np.intp], Array]]
    heights: list[Array]
    radius: tuple[Array, Array, Array]
    sine: Array
    cosine: Array
    level: Array = None  # type: ignore[assignment]  # set right after the segments are made
    range_m: Array = None  # type: ignore[assignment]
    bearing_rad: Array = None  # type: ignore[assignment]
