"""Find the bottom below a side-scan, and correct its slant ranges to ground ranges.

The bottom is the first return: the range at which the dark water column ends. Over level ground at height *h* an echo at
slant range *r* lies sqrt(r^2 - h^2) to the side (slant-range correction). A vehicle that pitches tilts the plane of its
beams, so that the first return is the distance to the ground within that plane, h / cos(pitch), and its echoes lie
h tan(pitch) behind the vehicle, for a bow that points down. Roll turns that plane in itself and has no influence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter, uniform_filter1d

from mitsonar.errors import MitsonarError, argument
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.records.soundings import Echogram

__all__ = ["BottomTrack", "GroundLines", "GroundScan", "at_ground_range", "ground_lines", "to_ground_range", "track_bottom"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Index = NDArray[np.intp]

SPAN_DB = 60.0
"""Range of levels below full scale that is looked at [dB]."""

LEAST_SHARE = 0.02
"""Default of the smallest range of a first return, as a share of the window: nearer lies the transmitted pulse."""

BEHIND_SHARE = 1 / 32
"""Share of the bins of a side, behind the first return, that must show the bottom."""

FAINT_SHARE = 0.25
"""Threshold of the first return above the water, as a share of the difference between water and bottom in dB."""

LEAST_REACH_DB = 5.0
"""Least height of that threshold over the water, whose own spread is about as wide [dB]."""

NEIGHBOURS = 15
"""Number of pings over which the levels of water and bottom are taken."""

STEP_COST = 0.5
"""Cost of a change of the first return by one bin from ping to ping, in bins of contrary evidence."""

LEAST_CONTRAST = 0.25
"""A first return needs this contrast in the median, or there is no water column."""


# ---------------- Bottom


@dataclass(frozen=True)
class BottomTrack:
    """The first return of each ping.

    Attributes:
        range_m: slant range of the first return ``(pings,)`` [m].
        height_m: height of the sonar over the ground ``(pings,)`` [m], from range and pitch.
        contrast: evidence for the bottom ``(pings,)``: 1 if all bins before are dark and those behind bright, 0 for noise.
    """

    range_m: Array
    height_m: Array
    contrast: Array


def track_bottom(echogram: Echogram, least_m: float | None = None) -> BottomTrack:
    """Track the first return through all pings of a side-scan.

    Every sample counts for water or for bottom, by its level against a threshold. A ping's evidence for a first return at a
    bin is the number of bright samples just behind it, plus the dark ones just before it, less all bright ones before it,
    over both sides. The track has the most evidence over all pings, less a cost for each bin by which it moves between pings
    (dynamic programming). Pings without an echo take the track of their neighbours. A first pass takes one threshold for all
    pings (Otsu); a second one takes thresholds close above the water of each ping, since the bottom straight below is faint.

    Args:
        echogram: levels of port and starboard.
        least_m: smallest range of a first return [m]; default: 2 % of the window. Nearer echoes are ignored, such as the
            transmitted pulse, or the echo of the surface.

    Raises:
        MitsonarError: ``least_m`` lies outside the window, or there is no dark water column before the bottom.
    """
    fan = echogram.sounder.fan
    edges = np.linspace(fan.range_min, fan.range_max, fan.range_bins + 1)
    nearest = LEAST_SHARE * fan.range_max if least_m is None else least_m
    if not 0 <= nearest < fan.range_max:
        raise MitsonarError(f"{argument('least_m')} must lie within the window, 0..{fan.range_max:g} m: got {nearest:g} m")
    first = int(np.searchsorted(edges[:-1], nearest))
    behind = max(2, round(BEHIND_SHARE * fan.range_bins))
    if fan.range_bins - first < 2 * behind:
        raise MitsonarError(f"a bottom needs {2 * behind} bins or more behind {nearest:g} m: got {fan.range_bins - first}")
    level = _decibels(echogram.levels[:, :, first:])
    water_db, bottom_db = _two_classes(level)
    place, contrast = _track(level, np.full(len(level), water_db), np.full(len(level), bottom_db), 0.5, behind)
    place, contrast = _track(level, *_classes_about(level, place, behind), FAINT_SHARE, behind)
    if not np.median(contrast) >= LEAST_CONTRAST:
        raise MitsonarError(
            f"no water column ends in a bottom (contrast {np.median(contrast):.2f}, at least {LEAST_CONTRAST:g} is needed): "
            f"give {argument('height_m')}; samples may be corrected to ground range already"
        )
    range_m = edges[first + place]
    return BottomTrack(range_m, range_m * np.cos(echogram.poses[:, 3]), contrast)


def _decibels(levels: Floats) -> Floats:
    """Return levels ``(pings, sides, bins)`` [dB], at most 60 dB below full scale.

    They are means over three bins, the last of which is the bin itself, so that a rise stays where it is.
    """
    smooth = uniform_filter1d(levels, 3, axis=2, origin=1)
    full_scale = float(np.percentile(smooth[:: max(1, len(smooth) // 1000)], 99.9)) or 1.0
    return np.asarray(10 * np.log10(np.clip(smooth / np.float32(full_scale), 10 ** (-SPAN_DB / 10), 1)), dtype=np.float32)


def _track(level: Floats, water_db: Array, bottom_db: Array, share: float, behind: int) -> tuple[Index, Array]:
    """Return the first bin of the bottom and the contrast there ``(pings,)``.

    Args:
        level: levels ``(pings, sides, bins)`` [dB].
        water_db: level of the water in each ping ``(pings,)`` [dB].
        bottom_db: level of the bottom in each ping ``(pings,)`` [dB].
        share: height of the threshold between the two, 0..1.
        behind: number of bins behind the first return that must be bright.
    """
    # 1. evidence of every bin: -1 for water, 1 for bottom
    reach = np.maximum(share * (bottom_db - water_db), LEAST_REACH_DB)
    evidence = np.clip((level - (water_db + reach)[:, None, None]) / reach[:, None, None], -1, 1).mean(axis=1)
    # 2. evidence of a first return at the lower edge of every bin
    total = np.zeros((len(level), evidence.shape[1] + 1), np.float32)
    np.cumsum(evidence, axis=1, out=total[:, 1:])
    after = total[:, behind:] - total[:, :-behind]
    before = total[:, :-behind] - np.pad(total, ((0, 0), (behind, 0)))[:, : after.shape[1]]
    bright = np.cumsum(np.maximum(evidence, 0), axis=1)[:, : after.shape[1] - 1]
    score = after - before
    score[:, 1:] -= bright
    score[after.max(axis=1) <= 0] = 0  # pings without any bottom have no say
    place = _best_path(score)
    # 3. contrast of the bins behind the first return and before it
    rows, near = np.arange(len(place)), np.maximum(place - behind, 0)
    bottom = (total[rows, place + behind] - total[rows, place]) / behind
    water = (total[rows, place] - total[rows, near]) / np.maximum(place - near, 1)
    return place, np.maximum(0, (bottom - water) / 2).astype(float)


def _classes_about(level: Floats, place: Index, behind: int) -> tuple[Array, Array]:
    """Return the levels of water and bottom near a first track ``(pings,)`` [dB], medians over neighbouring pings."""
    water, bottom = np.empty(len(place)), np.empty(len(place))
    for row, first in enumerate(place):
        before = level[row, :, max(0, first - 3 * behind) : max(1, first - behind)]
        water[row] = np.median(before)
        bottom[row] = np.median(level[row, :, first : first + behind])
    return median_filter(water, NEIGHBOURS), median_filter(bottom, NEIGHBOURS)


def _two_classes(level: Floats) -> tuple[float, float]:
    """Return the means of the dark and of the bright values, split where their variance between is largest (Otsu 1979)."""
    count, edges = np.histogram(level, 256)
    centre = (edges[:-1] + edges[1:]) / 2
    dark = np.cumsum(count)[:-1]
    bright = count.sum() - dark
    sums = np.cumsum(count * centre)
    below, above = sums[:-1] / np.maximum(dark, 1), (sums[-1] - sums[:-1]) / np.maximum(bright, 1)
    split = int(np.argmax(dark * bright * (above - below) ** 2))
    return float(below[split]), float(above[split])


def _best_path(score: Floats) -> Index:
    """Return the column of each row ``(rows,)`` with the largest sum of scores less :data:`STEP_COST` a column of change."""
    rows, columns = score.shape
    number = np.arange(columns)
    cost = STEP_COST * number
    best, back = score[0].astype(float), np.zeros((rows, columns), np.int32)
    for row in range(1, rows):
        # the best predecessor among the columns to the left, and among those to the right
        left, right = best + cost, (best - cost)[::-1]
        largest_left, largest_right = np.maximum.accumulate(left), np.maximum.accumulate(right)
        from_left = np.maximum.accumulate(np.where(left == largest_left, number, 0))
        from_right = columns - 1 - np.maximum.accumulate(np.where(right == largest_right, number, 0))[::-1]
        via_left, via_right = largest_left - cost, largest_right[::-1] + cost
        back[row] = np.where(via_left >= via_right, from_left, from_right)
        best = np.maximum(via_left, via_right) + score[row]
    path = np.empty(rows, np.intp)
    path[-1] = int(np.argmax(best))
    for row in range(rows - 1, 0, -1):
        path[row - 1] = back[row, path[row]]
    return path


# ---------------- Slant range and ground range


@dataclass(frozen=True)
class GroundScan:
    """Levels of a side-scan over ground range.

    Attributes:
        across_m: distances from the track ``(columns,)`` [m], increasing, negative to port.
        levels: intensities ``(pings, columns)`` float32; nan where no echo of the ground lies in the window.
        echogram: the levels over slant range.
    """

    across_m: Array
    levels: Floats
    echogram: Echogram


def to_ground_range(echogram: Echogram, height_m: ArrayLike, columns: int | None = None) -> GroundScan:
    """Correct slant ranges to ground ranges over level ground.

    Args:
        echogram: levels of port and starboard.
        height_m: height of the sonar over the ground ``(pings,)``, or one for all [m].
        columns: number of columns over both sides; default: as many as bins, so that far away one column is about one bin.

    Raises:
        MitsonarError: a height is not above 0, or all exceed the window.
    """
    fan = echogram.sounder.fan
    first_return = ground_lines(echogram.poses, height_m).nearest_m
    if not (first_return < fan.range_max).any():
        raise MitsonarError(
            f"the ground is nowhere within the window of {fan.range_max:g} m: got {argument('height_m')} of "
            f"{float(np.min(height_m)):g} m and more"
        )
    far = float(np.sqrt(fan.range_max**2 - np.min(first_return) ** 2))
    count = 2 * fan.range_bins if columns is None else columns
    edges = np.linspace(-far, far, count + 1)
    across = (edges[:-1] + edges[1:]) / 2
    levels = np.empty((len(echogram), count), np.float32)
    sides = [(echogram.channel("port"), across < 0), (echogram.channel("starboard"), across >= 0)]
    for row, nearest in enumerate(first_return):
        for side, columns_of_side in sides:
            levels[row, columns_of_side] = at_ground_range(side[row, None], fan, across[columns_of_side], nearest)[0]
    return GroundScan(across, levels, echogram)


def at_ground_range(levels: Floats, fan: Sonar, across_m: Array, nearest_m: float) -> Array:
    """Interpolate one ping at ground ranges over level ground.

    Args:
        levels: values over slant range ``(sides, bins)``.
        fan: the window.
        across_m: distances from the track ``(columns,)`` [m], of either sign.
        nearest_m: range of the first return [m].

    Returns:
        Values ``(sides, columns)``; nan outside the window.
    """
    index = (np.hypot(across_m, nearest_m) - fan.range_min) / fan.bin_m - 0.5
    values = np.stack([np.interp(index, np.arange(fan.range_bins), side) for side in levels])
    values[:, (index < -0.5) | (index > fan.range_bins - 0.5)] = np.nan
    return values


@dataclass(frozen=True)
class GroundLines:
    """Where the plane of the beams meets level ground in each ping: a straight line across the track.

    Attributes:
        nearest_m: distance of the line from the sonar ``(pings,)`` [m], which is the range of the first return.
        foot: point of the line nearest to the sonar ``(pings, 2)``: x east, y north [m].
        starboard: direction of the line ``(pings, 2)``, a unit vector to starboard.
    """

    nearest_m: Array
    foot: Array
    starboard: Array


def ground_lines(poses: ArrayLike, height_m: ArrayLike) -> GroundLines:
    """Intersect the plane of the beams, across the vehicle, with level ground below.

    Args:
        poses: poses of the vehicle ``(pings, 6)`` [m, rad].
        height_m: height over the ground ``(pings,)``, or one for all [m].

    Raises:
        MitsonarError: a height is not above 0, or a vehicle points straight up or down.
    """
    table = np.asarray(poses, dtype=float)
    heights = np.asarray(height_m, dtype=float)
    if heights.shape not in ((), (len(table),)) or not (heights > 0).all() or not np.isfinite(heights).all():
        raise MitsonarError(
            f"{argument('height_m')} must be one number above 0, or one for each of {len(table):,} pings [m]: got shape "
            f"{heights.shape}, {np.min(heights):g} m and more"
        )
    forward = vehicle_rotation(table).apply([0.0, 1.0, 0.0])
    level = np.hypot(forward[:, 0], forward[:, 1])
    if not (level > 1e-3).all():
        raise MitsonarError("a side-scan whose vehicle points straight up or down sees no line across its track")
    ahead = forward[:, :2] / level[:, None]
    offset = heights * forward[:, 2] / level  # of the line ahead of the vehicle: behind it for a bow that points down
    foot = table[:, :2] + offset[:, None] * ahead
    return GroundLines(heights / level, foot, np.column_stack([ahead[:, 1], -ahead[:, 0]]))
