"""What a recording tells of the water: the glow near the sonar, and what drifts and scatters in every ping anew."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics import image_statistics as statistics
from mitsonar.acoustics.sonar_losses import loss_of
from mitsonar.instruments.imaging_sonar import Sonar

__all__ = ["moved_correlation", "near_glow", "volume"]

Array = NDArray[np.float64]

FEWEST, WITHIN = 3, 0.25
"""Bins of the shortest glow, and the part of the window in which it ends."""

LEAST_FALL_DB, STEEPER = 10.0, 4.0
"""What a glow falls by, and how many times more steeply than the profile behind it."""

MOST_GLOW_DB = 120.0
"""Largest ``near_glow_db``."""

NEW = 0.3
"""Correlation of bright grain from frame to frame below which it is new."""

ABOVE = 3.0
"""Least ratio of a bin's mean to the noise where volume is read."""

UNEVEN_DB = 3.0
"""Half the spread, 10th to 90th percentile, of the profile about that of noise and volume, above which it is no volume."""


def near_glow(flat: Array, noise: float, range_m: Array) -> tuple[float, float] | None:
    """Return the noise at range 0 above the noise behind [dB], and the range at which it is gone [m]; None without glow.

    Two straight lines in dB are fitted to the medians of the first quarter of the bins, from the
    highest of the first :data:`~mitsonar.acoustics.image_statistics.GLOW_BINS` on. The first one is the glow.

    Args:
        flat: intensities before the gain ``(frames, bins, beams)``.
        noise: their mean where there is noise alone.
        range_m: of the bins.
    """
    excess = statistics.decibels(np.median(flat, axis=(0, 2)) / math.log(2) / noise)
    first = int(np.argmax(excess[: statistics.GLOW_BINS]))
    last = max(2 * FEWEST, round(len(excess) * WITHIN))
    at, excess = range_m[first : first + last], excess[first : first + last]
    best: tuple[float, int, Array, Array] | None = None
    for end in range(FEWEST, last - FEWEST):
        lines = [np.polyfit(at[part], excess[part], 1) for part in (slice(end), slice(end, None))]
        model = np.where(np.arange(last) < end, np.polyval(lines[0], at), np.polyval(lines[1], at))
        missed = float(np.square(excess - model).sum())
        if best is None or missed < best[0]:
            best = missed, end, lines[0], lines[1]
    assert best is not None
    _, end, (slope, start), (behind, _) = best
    fall = -slope * (at[end - 1] - at[0])
    if fall < LEAST_FALL_DB or -slope < STEEPER * abs(behind):
        return None
    if start <= MOST_GLOW_DB:
        return float(start), float(-start / slope)
    middle = float(at[:end].mean())  # the line of 120 dB at range 0 through the middle of the glow
    height = min(start + slope * middle, 0.95 * MOST_GLOW_DB)
    return MOST_GLOW_DB, middle / (1 - height / MOST_GLOW_DB)


def moved_correlation(level_db: Array) -> float:
    """Return the largest correlation of consecutive detrended frames in their brighter half, over all shifts of cells."""
    grain, mean = statistics.detrended(level_db), statistics.local_mean(level_db)
    grain = np.where(mean >= np.median(mean), grain, 0)
    found = []
    for one, other in pairwise(grain):
        across = np.fft.irfft2(np.conj(np.fft.rfft2(one)) * np.fft.rfft2(other), one.shape)
        found.append(across.max() / max(math.sqrt(np.square(one).sum() * np.square(other).sum()), 1e-30))
    return float(np.mean(found)) if found else math.nan


def volume(flat: Array, level_db: Array, noise: float, sonar: Sonar, notes: list[str]) -> float | None:
    """Return the volume scattering strength relative to full scale at 1 m, in the units of ``flat`` [dB re 1/m].

    Bright speckle that is new in every frame of a resting sonar is no surface. None where it is not new, where a shift finds
    it again, so that the sonar moved, where the profile is not that of volume, or where nothing exceeds the noise.

    Args:
        flat: intensities before the gain ``(frames, bins, beams)``.
        level_db: levels of the frames.
        noise: mean of ``flat`` where there is noise alone.
        sonar: gives beam width, field of view over elevation, absorption.
        notes: sentences are added here.
    """
    if len(flat) < 2 or not float(statistics.correlation_by_level(level_db)[1][-3:].mean()) < NEW:
        return None
    if moved_correlation(level_db) > NEW:
        return None
    echo = flat.mean(axis=(0, 2)) - noise
    kept = echo > (ABOVE - 1) * noise
    kept[: statistics.GLOW_BINS] = False
    if kept.sum() < statistics.WINDOW[0]:
        return None
    held = sonar.beam_width_rad * math.radians(sonar.elevation_fov_deg) * sonar.bin_m / sonar.range_m**2 * loss_of(sonar)
    strength = statistics.decibels(echo[kept] / held[kept])
    found = float(np.median(strength))
    rest = statistics.decibels((echo + noise) / (noise + 10 ** (found / 10) * held))[statistics.GLOW_BINS :]
    if np.diff(np.percentile(rest, [10, 90]))[0] / 2 > UNEVEN_DB:
        return None
    notes.append(
        "bright speckle is new in every frame and falls with range as volume does, so it is taken for it (volume_db): "
        "this holds for a sonar that rests"
    )
    return found
