"""Bottom detection: the range of the first or of the strongest echo in a beam, finer than a bin, with a quality."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Detected", "first_echoes", "strongest_echoes"]

Array = NDArray[np.float64]


class Detected(NamedTuple):
    """An echo in each beam; nan where there is none.

    Attributes:
        range_m: of the echo ``(...)``.
        level_db: of its strongest bin ``(...)``.
        quality: part of the beam's energy above the noise that lies in the echo ``(...)``, 0..1.
    """

    range_m: Array
    level_db: Array
    quality: Array


def first_echoes(levels: Array, range_m: Array, noise: Array, *, below_db: float, above_noise_db: float) -> Detected:
    """Find where the first echo of each beam begins, as an altimeter does.

    It begins where levels rise over the threshold, interpolated between the middles of two bins. The threshold lies
    ``below_db`` under the strongest bin, and ``above_noise_db`` over the noise at least.

    Args:
        levels: intensities ``(..., bins)``.
        range_m: middles of the bins ``(bins,)``, at equal steps.
        noise: mean intensity of the noise ``(bins,)``; 0: none.
        below_db: of the threshold under the strongest bin.
        above_noise_db: of the threshold over the noise.
    """
    levels, limit, above = _thresholds(levels, noise, below_db, above_noise_db)
    first = above.argmax(axis=-1)[..., None]
    before = np.maximum(first - 1, 0)
    here, low, wanted = (np.take_along_axis(one, at, -1) for one, at in ((levels, first), (levels, before), (limit, first)))
    rise = np.where(here > low, here - low, 1.0)
    back = np.where(first > 0, np.clip((here - wanted) / rise, 0, 1), 0)
    place = (range_m[first] - back * (range_m[1] - range_m[0] if len(range_m) > 1 else 0))[..., 0]
    return _told(levels, noise, above, _joined(above, first), place)


def strongest_echoes(levels: Array, range_m: Array, noise: Array, *, below_db: float, above_noise_db: float) -> Detected:
    """Find the middle of the strongest echo of each beam: the centroid of its energy.

    The echo is the run of bins around the strongest that exceed the threshold of :func:`first_echoes`, with one bin on each
    side; speckle may interrupt it for two bins. Noise is taken off.

    Args:
        levels: intensities ``(..., bins)``.
        range_m: middles of the bins ``(bins,)``.
        noise: mean intensity of the noise ``(bins,)``; 0: none.
        below_db: of the threshold under the strongest bin.
        above_noise_db: of the threshold over the noise.
    """
    levels, _, above = _thresholds(levels, noise, below_db, above_noise_db)
    strongest = np.where(above, levels, 0).argmax(axis=-1)[..., None]
    wide = above.copy()
    wide[..., 1:] |= above[..., :-1]
    wide[..., :-1] |= above[..., 1:]
    echo = _joined(wide, strongest)
    energy = np.where(echo, np.maximum(levels - noise, 0), 0)
    total = energy.sum(axis=-1)
    middle = (energy * range_m).sum(axis=-1) / np.where(total > 0, total, 1)
    return _told(levels, noise, above, echo, middle)


def _thresholds(
    levels: Array, noise: Array, below_db: float, above_noise_db: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return levels, the threshold of each bin, and which bins exceed it."""
    levels = np.asarray(levels, dtype=float)
    peak = levels.max(axis=-1, keepdims=True)
    limit = np.maximum(peak * 10 ** (-below_db / 10), noise * 10 ** (above_noise_db / 10))
    return levels, limit, (levels >= limit) & (levels > 0)


def _joined(above: NDArray[np.bool_], at: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return the run of bins around ``at`` ``(..., 1)`` of which all are above the threshold."""
    gaps = np.cumsum(~above, axis=-1)
    return np.asarray(above & (gaps == np.take_along_axis(gaps, at, -1)))


def _told(levels: Array, noise: Array, above: NDArray[np.bool_], echo: NDArray[np.bool_], place: Array) -> Detected:
    """Return detections, nan where no bin is above the threshold."""
    there = above.any(axis=-1)
    energy = np.maximum(levels - noise, 0)
    total, inside = energy.sum(axis=-1), np.where(echo, energy, 0).sum(axis=-1)
    peak = np.where(echo, levels, 0).max(axis=-1)
    quality = np.where(there, inside / np.where(total > 0, total, 1), 0.0)
    level = 10 * np.log10(np.where(there, peak, 1.0))
    return Detected(np.where(there, place, np.nan), np.where(there, level, np.nan), quality)
