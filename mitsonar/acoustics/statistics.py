"""Compute statistics that distinguish real sonar frames from simulated ones: grain, persistence, stripes, smear, edges.

Frames are ``(frames, bins, beams)``. Levels are in dB and finite; intensities are linear, 0 or more. *Detrended* means that
the local mean of the levels over :data:`WINDOW` cells is subtracted, which leaves the grain and removes the picture.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, stats

__all__ = [
    "RAYLEIGH_DB",
    "WINDOW",
    "autocorrelation",
    "beam_stripes_db",
    "bright_over_median_db",
    "correlation_by_level",
    "decibels",
    "detrended",
    "edge_steps_db",
    "frame_correlation",
    "intensity_contrast",
    "leak_power",
    "local_mean",
    "local_std_db",
    "near_glow_db",
    "percentile_span_db",
    "ping_groups",
    "range_profile_db",
    "smear_db",
    "stripes_by_group_db",
    "tail_db",
    "window_values",
    "zero_share",
]

Array = NDArray[np.float64]

WINDOW = (31, 9)
"""Bins and beams of the window of the local mean."""

RAYLEIGH_DB = 10 / np.log(10) * np.pi / np.sqrt(6)
"""Standard deviation of exponential intensities in dB: 5.57."""

STRIPE_BLOCKS = 8
"""Number of blocks of bins whose stripes must agree, so that speckle is not counted as stripes."""

GLOW_BINS, TREND_BINS = 20, 60
"""Number of bins of the near glow, and of the bins behind it that define the trend."""

LEAK_GUARD, LEAK_BINS, LEAK_ROWS, LEAK_SURE = 8, 8, 12, 3
"""Parameters of the smear estimate.

In order: bins between a row and the rows that it is compared with; number of these rows on each side; rows compared per
frame, those with the largest excess; standard errors that a leak must exceed.
"""

LEAK_CONTRAST = 1000.0
"""Smallest ratio of a row's brightest cell to its quiet beams; below 30 dB, a leak of -50 dB is not visible."""

GROUP_WINDOW, GROUP_LAG, MOST_GROUPS = (15, 9), 48, 16
"""Parameters of the search for ping groups: window of the local mean, greatest distance [beams], most groups."""

GROUP_SURE, GROUP_RISE = 4.5, 0.005
"""How far the correlation at the distances of a group must rise: standard errors, and the mean rise.

Groups of six frames of an HAUV's DIDSON and of two recordings of an ARIS 3000 reach 3.5 to 10.5 and 0.007 to 0.019. Without
groups, recordings and simulated scenes stay below 3.9 and 0.0035.
"""

MEDIAN_ABOVE_MEAN_DB = float(10 * np.log10(np.log(2)) + 10 / np.log(10) * np.euler_gamma)
"""Median of exponential intensities in dB minus the mean of their dB values: 0.91."""


def decibels(intensity: ArrayLike, least_db: float = -200.0) -> Array:
    """Convert intensities to levels [dB], not below ``least_db``, of the same shape."""
    value = np.maximum(np.asarray(intensity, dtype=float), 10 ** (least_db / 10))
    return np.asarray(10 * np.log10(value), dtype=np.float64)


# ---------------- Range of levels


def percentile_span_db(level_db: ArrayLike, low: float = 1.0, high: float = 99.9) -> float:
    """Return the difference of two percentiles of all levels [dB]."""
    below, above = np.percentile(np.asarray(level_db, dtype=float), [low, high])
    return float(above - below)


def bright_over_median_db(level_db: ArrayLike) -> float:
    """Return the 99.9th percentile of all levels relative to their median [dB]."""
    return percentile_span_db(level_db, 50.0, 99.9)


def zero_share(values: ArrayLike) -> float:
    """Return the fraction of cells whose value is exactly 0."""
    return float(np.mean(np.asarray(values) == 0))


# ---------------- Grain


def local_mean(values: ArrayLike, window: tuple[int, int] = WINDOW) -> Array:
    """Return the mean over a window of bins and beams around each cell, of the same shape. Edge values are repeated."""
    values = np.asarray(values, dtype=float)
    size = (*(1 for _ in values.shape[:-2]), *window)
    return np.asarray(ndimage.uniform_filter(values, size, mode="nearest"), dtype=np.float64)


def detrended(level_db: ArrayLike, window: tuple[int, int] = WINDOW) -> Array:
    """Subtract the local mean from levels [dB], preserving the shape."""
    return np.asarray(np.asarray(level_db, dtype=float) - local_mean(level_db, window), dtype=np.float64)


def local_std_db(level_db: ArrayLike, window: tuple[int, int] = WINDOW) -> float:
    """Return the root mean square of detrended levels [dB]; 5.57 for exponential intensities.

    Subtracting the mean of n cells removes 1 / n of the variance of uncorrelated grain, which is corrected for.
    """
    cells = window[0] * window[1]
    return float(np.sqrt(np.mean(detrended(level_db, window) ** 2) * cells / (cells - 1)))


def window_values(values: ArrayLike, window: tuple[int, int] = WINDOW) -> Array:
    """Return the values of non-overlapping windows ``(windows, cells)``; incomplete windows at the ends are dropped."""
    values = np.asarray(values, dtype=float)
    frames, bins, beams = values.shape
    tall, wide = min(window[0], bins), min(window[1], beams)
    whole = values[:, : bins // tall * tall, : beams // wide * wide]
    parts = whole.reshape(frames, bins // tall, tall, beams // wide, wide).transpose(0, 1, 3, 2, 4)
    return np.asarray(parts.reshape(-1, tall * wide), dtype=np.float64)


def intensity_contrast(intensity: ArrayLike, window: tuple[int, int] = WINDOW) -> Array:
    """Return the standard deviation of the intensities over their mean in each window with any intensity ``(windows,)``.

    Exponential intensities have a contrast of 1. The median over windows characterises a picture.
    """
    parts = window_values(intensity, window)
    mean = parts.mean(axis=1)
    nonzero = mean > 0
    return np.asarray(parts[nonzero].std(axis=1, ddof=1) / mean[nonzero], dtype=np.float64)


# ---------------- Correlation between frames and cells


def _correlation(one: Array, other: Array) -> float:
    """Return the correlation of two arrays; 0 if one of them is constant."""
    one, other = one - one.mean(), other - other.mean()
    power = float(np.sqrt(np.mean(one * one) * np.mean(other * other)))
    return float(np.mean(one * other)) / power if power > 0 else 0.0


def frame_correlation(level_db: ArrayLike) -> float:
    """Return the mean correlation of consecutive frames, without detrending them; nan for a single frame."""
    level = np.asarray(level_db, dtype=float)
    pairs = [_correlation(one, other) for one, other in pairwise(level)]
    return float(np.mean(pairs)) if pairs else float("nan")


def correlation_by_level(level_db: ArrayLike, parts: int = 10, window: tuple[int, int] = WINDOW) -> tuple[Array, Array]:
    """Return the correlation of consecutive detrended frames as a function of the local mean level.

    Cells are sorted by the mean of their local means in both frames, so that the grain does not affect the selection.

    Returns:
        Mean level of each part [dB], and correlation within it ``(parts,)``, darkest first.
    """
    level = np.asarray(level_db, dtype=float)
    mean = local_mean(level, window)
    grain = level - mean
    by_frame = []
    for k in range(len(level) - 1):
        mean_level = ((mean[k] + mean[k + 1]) / 2).ravel()
        one, other = grain[k].ravel(), grain[k + 1].ravel()
        cells = np.array_split(np.argsort(mean_level, kind="stable"), parts)
        by_frame.append([(float(mean_level[part].mean()), _correlation(one[part], other[part])) for part in cells])
    table = np.mean(by_frame, axis=0) if by_frame else np.full((parts, 2), np.nan)
    return np.asarray(table[:, 0]), np.asarray(table[:, 1])


def autocorrelation(level_db: ArrayLike, axis: int, lags: tuple[int, ...] = (1, 2)) -> Array:
    """Return the correlation of detrended levels with those a number of cells away ``(lags,)``.

    A complex Gaussian field of coherence c gives Li2(c^2) / (pi^2 / 6), where Li2 is the dilogarithm.

    Args:
        level_db: ``(frames, bins, beams)``.
        axis: 1 for range, 2 for beams.
        lags: distances [cells].
    """
    grain = detrended(level_db)
    cells = grain.shape[axis]
    pairs = [(np.take(grain, range(lag, cells), axis), np.take(grain, range(cells - lag), axis)) for lag in lags]
    return np.array([_correlation(one, other) for one, other in pairs])


# ---------------- Effects of the instrument


def ping_groups(level_db: ArrayLike) -> int:
    """Return the number of interleaved ping groups; 1 if none are seen.

    Beams of one ping share what leaks between channels, so that in the correlation of beams over their distance the
    multiples of the number of groups rise above their neighbours. Frames without crosstalk, or with groups of adjacent
    beams, do not show it.

    Args:
        level_db: ``(frames, bins, beams)``; another monotonic coding of levels does as well.
    """
    level = np.asarray(level_db, dtype=float)
    beams = level.shape[-1]
    most = min(beams // 2, GROUP_LAG)
    if most < 4:
        return 1
    # 1. correlation of the grain of each two beams, by their distance; beams count equally
    grain = detrended(level, GROUP_WINDOW)
    grain -= grain.mean(axis=(0, 1))
    spread = grain.std(axis=(0, 1))
    grain /= np.where(spread > 0, spread, 1.0)
    correlation = np.array([(grain[..., lag:] * grain[..., : beams - lag]).mean() for lag in range(most + 2)])
    # 2. rise of each distance over its neighbours, without the next beam, which overlaps the beam
    lags = np.arange(2, most + 1)
    rise = _over_neighbours(correlation)[1:]
    best, best_rise, sure = 1, 0.0, False
    for groups in range(2, min(MOST_GROUPS, most // 2) + 1):
        multiple = lags % groups == 0
        mean, root = float(rise[multiple].mean()), math.sqrt(multiple.sum())
        if mean * root > best_rise:
            comb = _over_neighbours((np.arange(most + 2) % groups == 0).astype(float))[1:]
            rest = rise - comb * (rise @ comb) / (comb @ comb)
            best, best_rise = groups, mean * root
            scatter = min(stats.median_abs_deviation(one, scale="normal") for one in (rise, rest))
            sure = mean > GROUP_RISE and mean * root > GROUP_SURE * scatter
    return best if sure else 1


def _over_neighbours(values: Array) -> Array:
    return np.asarray(values[1:-1] - (values[:-2] + values[2:]) / 2, dtype=np.float64)


def beam_stripes_db(level_db: ArrayLike, window: int = 9) -> float:
    """Return the standard deviation of the gains of individual beams [dB]; 0 if beams agree.

    The gain of a beam is the median of its levels over a block of bins, relative to its neighbours. Only the part shared by
    different blocks counts, since speckle differs from block to block.
    """
    return math.sqrt(_shared_variance(_beam_gains_db(level_db, window)) * window / (window - 1))


def stripes_by_group_db(level_db: ArrayLike, groups: ArrayLike, window: int = 9) -> tuple[float, float]:
    """Return the standard deviations of the gains of beams within their ping group, and of ping groups [dB].

    Args:
        level_db: ``(frames, bins, beams)``.
        groups: ping group of each beam ``(beams,)``; interleaved, or else groups count as one.
        window: neighbours to which a beam is compared; raised to the number of groups.
    """
    group = np.asarray(groups)
    if (np.diff(group) == 0).any():  # the mean of neighbours in one group hides its gain
        group = np.zeros_like(group)
    member = group[:, None] == np.unique(group)
    count = member.sum(axis=0)
    window = max(window, 2 * (member.shape[1] // 2) + 1)
    whole = beam_stripes_db(level_db, window) ** 2
    if member.shape[1] < 2 or count.min() < 2:
        return math.sqrt(whole), 0.0
    # a group's mean gain varies by that of the group, and by those of its beams
    mean = _beam_gains_db(level_db, window) @ (member / count)
    size = float(count.mean())
    of_groups = (size * _shared_variance(mean) - whole) / (size - 1)
    of_groups = min(max(of_groups, 0.0), whole)
    return math.sqrt(whole - of_groups), math.sqrt(of_groups)


def _beam_gains_db(level_db: ArrayLike, window: int) -> Array:
    """Return the level of each beam relative to its neighbours in blocks of bins ``(blocks, beams)`` [dB]."""
    level = np.asarray(level_db, dtype=float).mean(axis=0)
    blocks = np.stack([np.median(part, axis=0) for part in np.array_split(level, STRIPE_BLOCKS)])
    blocks = blocks - ndimage.uniform_filter1d(blocks, window, axis=1, mode="nearest")
    return np.asarray(blocks - blocks.mean(axis=1, keepdims=True))


def _shared_variance(blocks: Array) -> float:
    """Return the variance that different blocks share ``(blocks, n)``: the median of their covariances, at least 0."""
    if len(blocks) < 2:
        return 0.0
    products = blocks @ blocks.T / blocks.shape[1]
    return max(float(np.median(products[np.triu_indices(len(blocks), 1)])), 0.0)


BEHIND_BINS, BRIGHT_SHARE = (10, 25, 50), 0.3
"""Distances behind the brightest cells at which their tail is measured [bins], and the share of the brightest cells [%]."""


def tail_db(level_db: ArrayLike) -> Array:
    """Return the median level behind the brightest cells of each frame, relative to them, :data:`BEHIND_BINS` ``(3,)`` [dB].

    Distances beyond the image are NaN.
    """
    level = np.asarray(level_db, dtype=float)
    falls: list[list[float]] = [[] for _ in BEHIND_BINS]
    for frame in level:
        bins, beams = np.nonzero(frame >= np.percentile(frame, 100 - BRIGHT_SHARE))
        for fall, behind in zip(falls, BEHIND_BINS, strict=True):
            inside = bins + behind < len(frame)
            if inside.any():
                fall.append(
                    float(np.median(frame[bins[inside] + behind, beams[inside]] - frame[bins[inside], beams[inside]]))
                )
    return np.array([np.mean(fall) if fall else np.nan for fall in falls])


def range_profile_db(level_db: ArrayLike) -> Array:
    """Return the mean intensity of each bin over frames and beams, as a level ``(bins,)`` [dB]."""
    return decibels(np.mean(10 ** (np.asarray(level_db, dtype=float) / 10), axis=(0, 2)))


def near_glow_db(level_db: ArrayLike) -> Array:
    """Return the excess of the first bins over the trend of the bins behind them ``(GLOW_BINS,)`` [dB].

    The level of a bin is the median over frames and beams. The trend is a straight line through the next bins.
    """
    profile = np.median(np.asarray(level_db, dtype=float), axis=(0, 2))
    glow = min(GLOW_BINS, len(profile) // 3)
    behind = np.arange(glow, min(glow + TREND_BINS, len(profile)))
    slope, start = np.polyfit(behind, profile[behind], 1)
    return np.asarray(profile[:glow] - (start + slope * np.arange(glow)), dtype=np.float64)


def edge_steps_db(level_db: ArrayLike, part: float = 0.05) -> tuple[float, float]:
    """Return the largest rise and the largest fall of the range profile over a fraction of the window, both positive [dB].

    These are the edges of the lit patch. The first bins, where real sonars glow, are excluded.
    """
    profile = ndimage.uniform_filter1d(range_profile_db(level_db), 5, mode="nearest")[GLOW_BINS:]
    lag = max(1, round(part * len(profile)))
    step = profile[lag:] - profile[:-lag]
    return float(max(step.max(), 0.0)), float(max(-step.min(), 0.0))


# ---------------- Smear across beams


def _rows_and_neighbours(values: Array) -> tuple[Array, Array, Array]:
    """Return the rows with neighbours on both sides, and two means of these neighbours, each ``(frames, rows, beams)``.

    The means are over alternate neighbours: one selects the quiet beams, the other is compared with the rows. A single mean
    would select beams by its own grain.
    """
    reach = LEAK_GUARD + LEAK_BINS
    rows = values.shape[1] - 2 * reach
    away = [-reach + k for k in range(LEAK_BINS)] + [LEAK_GUARD + 1 + k for k in range(LEAK_BINS)]
    one, other = (sum(values[:, reach + k : reach + k + rows] for k in half) for half in (away[::2], away[1::2]))
    return values[:, reach : reach + rows], np.asarray(one) / LEAK_BINS, np.asarray(other) / LEAK_BINS


class _Rows(NamedTuple):
    """Rows with the strongest potential leak, ``(rows,)`` each, and the variation expected by chance.

    Attributes:
        excess: sum of the excess over the other beams.
        lift: median ratio of the quiet beams to their neighbours, in units of exponential intensities of mean 1.
        level: mean of the neighbours of the quiet beams.
        top: the largest cell.
        chance: standard error of the median lift.
    """

    excess: Array
    lift: Array
    level: Array
    top: Array
    chance: float


def _leaking_rows(intensity: Array) -> _Rows | None:
    """Return the rows of each frame with the strongest potential leak; None if no row can leak."""
    if intensity.shape[1] < 4 * (LEAK_GUARD + LEAK_BINS):
        return None
    row, chooser, around = _rows_and_neighbours(intensity)
    # Quiet beams are the darkest 40 % by one mean of the neighbours; ratios are taken to the other mean.
    quiet = (chooser <= np.percentile(chooser, 40, axis=2, keepdims=True)) & (around > 0)
    excess = np.where(quiet, 0, row - around).sum(axis=2)
    ratio = np.divide(row, around, out=np.full_like(row, np.nan), where=quiet)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a row without a quiet beam is nan, and is not used
        median, level = np.nanmedian(ratio, axis=2), np.nanmean(np.where(quiet, around, np.nan), axis=2)
    # Only rows whose brightest cell is far above their quiet beams can show a leak.
    top = row.max(axis=2)
    usable = np.isfinite(median) & (level > 0) & (excess > 0) & (top > LEAK_CONTRAST * level)
    if not usable.any():
        return None
    lift = median * np.log(2) / np.nanmedian(median)  # normalised, since the mean of few neighbours raises all ratios
    spread = 1.4826 * np.nanmedian(np.abs(lift - np.log(2)))
    # Select the rows of each frame whose excess is largest relative to their quiet beams.
    score = np.where(usable, excess / np.where(level > 0, level, 1), -np.inf)
    best = np.argsort(score, axis=1)[:, -LEAK_ROWS:]
    best_usable = np.take_along_axis(usable, best, axis=1)
    excess, lift, level, top = (np.take_along_axis(table, best, axis=1)[best_usable] for table in (excess, lift, level, top))
    return _Rows(excess, lift, level, top, float(1.25 * spread / np.sqrt(LEAK_ROWS)))


def leak_power(intensities: Sequence[ArrayLike], limit: float = np.inf) -> float:
    """Return the power that leaks into every beam of a ping, relative to the summed intensity of its beams.

    In rows with a strong target, the quiet beams are compared with the same beams in rows before and behind. The leak has
    another phase and amplitude in every beam, so it raises their median as it raises their mean. Rows with a cell at or
    above ``limit`` are excluded, since their clipped intensity is unknown.

    Args:
        intensities: intensities ``(frames, bins, beams)`` of each group of beams that ping together.
        limit: intensity at which values are clipped.

    Returns:
        The median over the strongest rows of all groups; 0 if quiet beams rise by no more than chance.
    """
    groups = [one for group in intensities if (one := _leaking_rows(np.asarray(group, dtype=float))) is not None]
    if not groups:
        return 0.0
    excess, lift, level, top = (np.concatenate([group[k] for group in groups]) for k in range(4))
    below_limit = top < limit
    chance = float(np.mean([group.chance for group in groups])) / math.sqrt(len(groups))
    if not below_limit.any() or np.median(lift[below_limit]) < np.log(2) + LEAK_SURE * chance:
        return 0.0
    leaked = (lift[below_limit] / np.log(2) - 1) * level[below_limit] / excess[below_limit]
    return max(0.0, float(np.median(leaked)))


def smear_db(level_db: ArrayLike) -> float:
    """Return the median excess of the quiet beams near the brightest target of each frame over the rows around it [dB]."""
    level = np.asarray(level_db, dtype=float)
    if level.shape[1] < 4 * (LEAK_GUARD + LEAK_BINS):
        return 0.0
    row, chooser, around = _rows_and_neighbours(level)
    brightest = row.max(axis=2).argmax(axis=1)
    excess_db = []
    for k, brightest_row in enumerate(brightest):
        quiet = chooser[k, brightest_row] <= np.percentile(chooser[k, brightest_row], 60)
        excess_db.append(float(np.median((row[k, brightest_row] - around[k, brightest_row])[quiet])))
    return float(np.median(excess_db)) - MEDIAN_ABOVE_MEAN_DB
