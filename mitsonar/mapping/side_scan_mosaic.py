"""How do the pings of a side-scan become a map? Their echoes are laid on level ground, across the track.

The strip between two pings is filled with levels interpolated between them, so that a map without holes results from any
size of cells. Cells hold mean, standard deviation and count over the pings, as in :class:`mitsonar.mapping.mosaic.Mosaic`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.geometry.side_scan import GroundLines, at_ground_range, ground_lines
from mitsonar.mapping.mosaic import Box, Mosaic, MosaicOptions
from mitsonar.records.soundings import Echogram

__all__ = ["CELL_M", "build_side_scan_mosaic"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

CELL_M = 0.1
"""Default size of a cell [m], which suits the beam width of side-scans better than that of :class:`MosaicOptions`."""

SPAN_DB = 60.0
"""Levels so far below full scale are 0, and full scale is 1 [dB]."""

POINTS_A_CELL = 1.5
"""Points laid per cell and direction, so that no cell of a strip stays empty."""

WIDEST_GAP = 5.0
"""Strips are left open where pings lie farther apart than this multiple of the median distance."""

SHARPEST_TURN = math.radians(5)
"""Strips are left open where the heading turns more between two pings."""

MOST_POINTS = 2**20
"""Points of a strip that are laid at a time."""

ANGLES = 90
"""Number of angles, from straight down to the horizon, for which levels are made even."""

FLATTENING_PINGS = 2000
"""Number of pings, spread over the recording, that determine the level at each angle."""

LEAST_PINGS = 0.1
"""Share of these pings, on both sides, that must have echoes at an angle."""

LARGEST_REACH = 1e6
"""Positions are at most so far from each other [m]."""


def build_side_scan_mosaic(
    echogram: Echogram,
    height_m: ArrayLike,
    options: MosaicOptions = MosaicOptions(cell_m=CELL_M),
    *,
    flatten: bool = True,
    progress: Callable[[int], object] = lambda count: None,
) -> Mosaic:
    """Build the map of the ground that a side-scan recorded.

    The level of a cell is 1 at full scale and 0 at 60 dB below. The ground is assumed level below every ping.

    Args:
        echogram: levels and poses of the pings.
        height_m: height of the sonar over the ground ``(pings,)``, or one for all [m], such as that of
            :func:`mitsonar.geometry.side_scan.track_bottom`.
        options: size of cells, and largest number of cells. The blend is always that of all echoes.
        flatten: subtract the median level at each angle from straight down and add the median of all, so that neither the
            beam pattern nor spreading shades the map. Levels may then lie outside 0..1.
        progress: function that is called with the number of pings done since its last call.

    Returns:
        The map, whose frames are pings.

    Raises:
        MitsonarError: a height is not above 0, the map would exceed ``most_cells``, or no ping shows ground.
    """
    lines = ground_lines(echogram.poses, height_m)
    fan = echogram.sounder.fan
    far = np.sqrt(np.maximum(fan.range_max**2 - lines.nearest_m**2, 0))
    if not (far > 0).any():
        raise MitsonarError(
            f"no ping shows ground: the window ends at {fan.range_max:g} m, the ground is {lines.nearest_m.min():g} m away"
        )
    # 1. levels over ground range, in even steps finer than the cells
    step = options.cell_m / POINTS_A_CELL
    columns = math.ceil(float(far.max()) / step)
    if columns > options.most_cells:
        raise MitsonarError(
            f"cells of {options.cell_m:g} m are too small for a window of {fan.range_max:g} m: take larger ones"
        )
    across: Array = (np.arange(columns, dtype=np.float64) + 0.5) * step
    level = _Levels(echogram, lines, across, flatten=flatten)
    # 2. the whole map at once, so that it does not grow ping by ping
    mosaic = Mosaic(options)
    reach = far[:, None] * lines.starboard
    ends = np.stack([lines.foot - reach, lines.foot + reach])
    if np.ptp(ends.reshape(-1, 2), axis=0).max() > LARGEST_REACH:
        raise MitsonarError("positions lie more than 1,000 km from each other: one of them is wrong")
    mosaic.reserve_box(_box(ends.reshape(-1, 2), options.cell_m))
    # 3. strip by strip
    followed = _followed(lines, echogram.poses[:, 5])
    here = level(0)
    for ping in range(len(echogram)):
        after = level(ping + 1) if ping + 1 < len(echogram) else here
        second = ping + 1 if followed[ping] else ping
        points = 1 if second == ping else _points_along(ends[:, ping], ends[:, second], step)
        share = (np.arange(points) + 0.5) / points if second != ping else np.zeros(1)
        shown = _lay_strip(mosaic, lines, (ping, second), share, across, here, after)
        mosaic.frames += 1
        mosaic.frames_without_ground += not shown
        here = after
        progress(1)
    mosaic.check_not_empty()
    return mosaic


class _Levels:
    """Function that returns the levels of both sides of a ping ``(2, columns)`` at given ground ranges; nan where unknown.

    Levels are 1 at full scale and 0 at :data:`SPAN_DB` below.
    """

    def __init__(self, echogram: Echogram, lines: GroundLines, across: Array, *, flatten: bool) -> None:
        self.fan = echogram.sounder.fan
        sides = [echogram.sounder.channels.index(side) for side in ("port", "starboard")]
        self.level = 1 + echogram.decibels(SPAN_DB)[:, sides] / np.float32(SPAN_DB)
        self.nearest_m, self.across = lines.nearest_m, across
        self.profile: Array | None = None
        if flatten:
            self.profile = self._median_over_angles()

    def __call__(self, ping: int) -> Floats:
        nearest = float(self.nearest_m[ping])
        values = at_ground_range(self.level[ping], self.fan, self.across, nearest)
        if self.profile is not None:
            place = self._angle_index(nearest / np.hypot(self.across, nearest))
            values -= np.stack([np.interp(place, np.arange(ANGLES), side) for side in self.profile])
        return values.astype(np.float32)

    def _angle_index(self, cosine: Array) -> Array:
        """Return the fractional index among :data:`ANGLES` of angles from straight down, given their cosines."""
        return np.arccos(np.clip(cosine, 0, 1)) * (2 / np.pi * ANGLES) - 0.5

    def _median_over_angles(self) -> Array:
        """Return the median level at each angle ``(2, ANGLES)``, less the median of all.

        Both sides share one curve, so that the shadow of a long object on one side does not bend it, and differ by a
        constant. Levels of 0 are no echoes, and do not count. An angle with few echoes takes the level of its neighbours.
        """
        some = range(0, len(self.level), max(1, len(self.level) // FLATTENING_PINGS))
        slant = self.fan.range_m
        values = np.full((len(some), 2, ANGLES), np.nan)
        for row, ping in enumerate(some):
            first = int(np.searchsorted(slant, self.nearest_m[ping]))
            place = np.rint(self._angle_index(self.nearest_m[ping] / slant[first:]))
            edges = first + np.searchsorted(place, np.arange(ANGLES + 1))  # angles grow with range
            for angle in range(ANGLES):
                for side, level in enumerate(self.level[ping, :, edges[angle] : edges[angle + 1]]):
                    echoes = level[level > 0]
                    if echoes.size:
                        values[row, side, angle] = np.median(echoes)
        known = np.flatnonzero(np.isfinite(values).sum(axis=(0, 1)) >= LEAST_PINGS * 2 * len(some))
        if not len(known):
            return np.zeros((2, ANGLES))
        both = np.nanmedian(values[:, :, known], axis=(0, 1))
        profile = np.tile(np.interp(np.arange(ANGLES), known, both) - np.median(both), (2, 1))
        for side in range(2):
            difference = values[:, side, known] - both
            if np.isfinite(difference).any():
                profile[side] += np.nanmedian(difference)
        return profile


def _followed(lines: GroundLines, heading: Array) -> NDArray[np.bool_]:
    """Return for each ping whether the strip to the next one is filled ``(pings,)``: not across gaps and sharp turns."""
    if len(heading) < 2:
        return np.zeros(len(heading), dtype=bool)
    distance = np.linalg.norm(np.diff(lines.foot, axis=0), axis=1)
    turn = np.abs(np.angle(np.exp(1j * np.diff(heading))))
    usual = float(np.median(distance[distance > 0])) if (distance > 0).any() else 0.0
    return np.append((distance <= WIDEST_GAP * usual) & (turn <= SHARPEST_TURN), False)


def _points_along(ends: Array, next_ends: Array, step: float) -> int:
    """Return how many points along the track fill a strip between two lines, given by their ends ``(2, 2)``."""
    return max(1, math.ceil(float(np.linalg.norm(next_ends - ends, axis=1).max()) / step))


def _lay_strip(
    mosaic: Mosaic, lines: GroundLines, pings: tuple[int, int], share: Array, across: Array, here: Floats, after: Floats
) -> bool:
    """Add the strip between two pings to a map; return whether it shows any ground.

    Args:
        mosaic: the map.
        lines: where the beams of all pings meet the ground.
        pings: the two pings.
        share: places of points from the first ping, 0, to the second, 1 ``(points,)``.
        across: distances of points from the track ``(columns,)`` [m].
        here: levels of the first ping ``(2, columns)``; nan where unknown.
        after: levels of the second ping.
    """
    known = np.isfinite(here) & np.isfinite(after)
    if not known.any():
        return False
    first, second = pings
    foot = lines.foot[first] + share[:, None] * (lines.foot[second] - lines.foot[first])
    starboard = lines.starboard[first] + share[:, None] * (lines.starboard[second] - lines.starboard[first])
    distance = np.concatenate([-across, across])[known.ravel()]
    begin, change = here[known], (after - here)[known]
    ends = distance[[int(np.argmin(distance)), int(np.argmax(distance))]]
    box = _box((foot[[0, -1], None] + ends[:, None] * starboard[[0, -1], None]).reshape(-1, 2), mosaic.cell_m)
    place, total, count = np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    step = max(1, MOST_POINTS // len(distance))
    for start in range(0, len(share), step):
        block = slice(start, start + step)
        values = begin + share[block, None].astype(np.float32) * change  # (points, columns)
        points = foot[block, None] + distance[:, None] * starboard[block, None]
        cells = np.floor(points / mosaic.cell_m).astype(np.int64).reshape(-1, 2)
        hit = (cells[:, 1] - box.south) * box.shape[1] + cells[:, 0] - box.west
        place, total, count = _sums_of_cells(
            np.append(place, hit), np.append(total, values.ravel()), np.append(count, np.ones(len(hit)))
        )
    mosaic.add_cells(box, place, (total / count).astype(np.float32))
    return True


def _sums_of_cells(place: NDArray[np.int64], total: Array, count: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Add up totals and counts ``(n,)`` of equal places; return each place once.

    Only cells that are hit take memory and time: the box around a strip at 45 deg may have hundreds of times as many.
    """
    order = np.argsort(place, kind="stable")  # fast, since places along each line are nearly sorted
    place = place[order]
    first = np.flatnonzero(np.append(True, np.diff(place) != 0))
    return place[first], np.add.reduceat(total[order], first), np.add.reduceat(count[order], first)


def _box(points: Array, cell_m: float) -> Box:
    """Return the box of the cells that hold points ``(n, 2)`` [m]."""
    west, south = np.floor(points.min(axis=0) / cell_m).astype(int)
    east, north = np.floor(points.max(axis=0) / cell_m).astype(int) + 1
    return Box(int(south), int(north), int(west), int(east))
