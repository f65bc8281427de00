"""What a recording tells of the water: the glow near the sonar, and what drifts and scatters in every ping anew."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from mitsonar.acoustics import statistics
from mitsonar.acoustics.water import loss_of
from mitsonar.instruments.sonar import Sonar

__all__ = ["glow_by_beam", "moved_correlation", "near_glow", "volume"]

Array = NDArray[np.float64]

FEWEST, WITHIN = 3, 0.25
"""Bins of the shortest glow, and the part of the window in which it ends."""

LEAST_FALL_DB, STEEPER = 10.0, 4.0
"""What a glow falls by, and how many times more steeply than the profile behind it."""

MOST_GLOW_DB = 120.0
"""Largest ``near_glow_db``."""

GLOWING_DB, FEWEST_GLOWING = 10.0, 8
"""Least glow of the bins that tell how beams differ [dB], and the fewest bins."""

CLEAR_DB, FEWEST_CELLS = 15.0, 64
"""Least glow of the cells that tell what stays, so that noise takes 3 % at most, and the fewest cells."""

NEW = 0.3
"""Correlation of bright grain from frame to frame below which it is new."""

ABOVE = 3.0
"""Least ratio of a bin's mean to the noise where volume is read."""

UNEVEN_DB = 3.0
"""Half the spread, 10th to 90th percentile, of the profile about that of noise and volume, above which it is no volume."""


def near_glow(flat: Array, noise: float, range_m: Array) -> tuple[float, float] | None:
    """Return the noise at range 0 above the noise behind [dB], and the range at which it is gone [m]; None without glow.

    Two straight lines in dB are fitted to the medians of the first quarter of the bins, from the
    highest of the first :data:`~mitsonar.acoustics.statistics.GLOW_BINS` on. The first one is the glow.

    Args:
        flat: intensities before the gain ``(frames, bins, beams)``.
        noise: their mean where there is noise alone.
        range_m: of the bins.
    """
    excess = statistics.decibels(np.median(flat, axis=(0, 2)) / math.log(2) / noise)
    first = _first(excess)
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


def _first(excess_db: Array) -> int:
    """Return the bin from which a glow falls: windows may begin with darker bins."""
    return int(np.argmax(excess_db[: statistics.GLOW_BINS]))


def glow_by_beam(
    flat: Array, noise: float, range_m: Array, bearing_rad: Array, glow: tuple[float, float]
) -> tuple[float, ...]:
    """Return how the near glow differs from beam to beam, and how much of it stays from ping to ping.

    A beam's own glow is the median level of its bins over the line of all beams. Over the square of the bearing a straight
    line is fitted to it. What is left, without the grain of so many bins, is the spread. The part that stays follows from
    the correlation of consecutive frames' levels, which is Li2(c^2) / (pi^2 / 6) of complex Gaussian fields of coherence c.

    Args:
        flat: intensities before the gain ``(frames, bins, beams)``.
        noise: their mean where there is noise alone.
        range_m: of the bins.
        bearing_rad: of the beams.
        glow: of :func:`near_glow`.

    Returns:
        ``near_glow_edge_db``, ``near_glow_spread_db``, ``near_glow_still``; zeros where too few bins glow.
    """
    line = glow[0] * (1 - range_m / glow[1])
    first = _first(statistics.decibels(np.median(flat, axis=(0, 2)) / math.log(2) / noise))
    at = np.arange(len(range_m))
    kept = (at >= first) & (line > GLOWING_DB)
    if kept.sum() < FEWEST_GLOWING:
        return 0.0, 0.0, 0.0
    least = noise * 1e-3
    rest = statistics.decibels(np.maximum(flat[:, kept], least) / noise) - line[kept][None, :, None]
    own = np.median(rest, axis=(0, 1))
    square = (np.sin(bearing_rad) / np.sin(np.abs(bearing_rad).max())) ** 2
    found = optimize.least_squares(
        lambda x: x[0] - x[1] * square - own, (0.0, 0.0), loss="soft_l1", f_scale=statistics.RAYLEIGH_DB
    )
    miss = own - found.x[0] + found.x[1] * square
    spread = 1.4826 * float(np.median(np.abs(miss - np.median(miss))))
    still = _stays(rest - own, line[kept][:, None] + own > CLEAR_DB)
    frames = 1 + (len(flat) - 1) * (1 - still)  # what stays is one draw
    grain = 1.57 * statistics.RAYLEIGH_DB**2 / (frames * kept.sum() / 2)  # of a median; neighbouring bins share grain
    return float(found.x[1]), math.sqrt(max(spread**2 - grain, 0.0)), still


def _stays(grain_db: Array, clear: NDArray[np.bool_]) -> float:
    """Return the coherence of consecutive frames by the correlation of their levels in the clear cells."""
    if len(grain_db) < 2 or clear.sum() < FEWEST_CELLS:
        return 0.0
    grain = grain_db[:, clear]
    rho = float(np.mean([np.corrcoef(one, other)[0, 1] for one, other in pairwise(grain)]))
    top = math.pi**2 / 6
    return math.sqrt(optimize.brentq(lambda x: special.spence(1 - x) / top - min(max(rho, 0.0), 1.0), 0.0, 1.0))


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
