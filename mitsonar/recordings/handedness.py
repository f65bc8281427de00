"""Whether pictures are mirrored: the rotation that they show against the one that a compass, or the user, tells.

A sonar that turns to starboard sees what is fixed move to port. In mirrored pictures it moves to starboard. Each pair of
frames is registered over bearing and range by cross-correlation. Bearings are searched to both sides alike, up to twice the
largest told rotation. Sideways motion moves bearings too, but has either sign. So over many pairs the sign of the
correlation tells the side.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument
from mitsonar.recordings.recording import Part

__all__ = ["Handedness", "handedness_of"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

STEPS = (1, 2, 4, 8, 16, 32, 64)
"""Frames between the two of a pair; the smallest that gives enough pairs is taken, else the one that gives most."""

LEAST_TURN = 1.5
"""Least rotation of a pair, in spacings of the beams."""

MOST_TURN = 0.25
"""Largest rotation of a pair, as part of the field of view: beyond, too little is seen twice."""

MOST_PAIRS = 120
ENOUGH_PAIRS = 40
FEWEST_PAIRS = 5
"""Pairs that are registered, at most; that are looked for; with fewer nothing is told."""

CLEAR, SIGMAS = 0.4, 3.0
"""Least correlation, and least multiple of its standard deviation without any relation, for a verdict."""

LEAST_SLOPE = 0.25
"""Least seen rotation for each told one, for a verdict."""

REACH = 2.0
"""Largest rotation that is searched, as a multiple of the largest told one."""

REACH_RANGE = 0.15
"""Largest shift over range that is searched, as part of the bins."""

MOST_ROWS = 192
"""Rows that pictures are averaged to."""


class Handedness(NamedTuple):
    """What the rotation of the pictures tells.

    Attributes:
        verdict: ``agree``, ``mirrored``, or ``unknown`` where the rotation is too small, or the two are not related.
        correlation: of told and seen rotations, -1..1, about zero; nan without pairs.
        slope: seen rotation for each told one; near 1 or -1 where field of view and headings are right; nan without pairs.
        pairs: of frames that were registered.
        turn_deg: told rotation of a pair, rms [deg].
        reason: why nothing is told; empty otherwise.
    """

    verdict: Literal["agree", "mirrored", "unknown"]
    correlation: float
    slope: float
    pairs: int
    turn_deg: float
    reason: str = ""


def handedness_of(part: Part, heading_rad: ArrayLike | None = None) -> Handedness:
    """Tell whether the pictures of a part rotate as its headings do.

    Args:
        part: of a recording.
        heading_rad: of each frame ``(frames,)`` [rad], clockwise; or one number, the turn from the first frame to the last,
            made evenly, > 0 to starboard. Default: that of the poses, else of the sonar's compass.

    Raises:
        MitsonarError: headings that are not one a frame; pictures that cannot be read.
    """
    heading = _headings(part, heading_rad)
    if heading is None:
        return _unknown("nothing tells the headings: there are no poses, no compass, and none was given")
    bearing = part.like.bearing_rad
    if len(bearing) < 8 or len(part) < FEWEST_PAIRS + 1:
        return _unknown("there are too few beams or frames")
    spacing, width = float(np.median(np.diff(bearing))), float(bearing[-1] - bearing[0])
    pairs = _pairs(heading, spacing, MOST_TURN * width)
    if pairs is None:
        return _unknown(f"no pairs of frames turn by {np.degrees(LEAST_TURN * spacing):.2g} deg and show the same ground")
    told = _turns(heading, pairs)
    seen = _seen_turns(part, pairs, REACH * float(np.abs(told).max()))
    kept = np.isfinite(seen)
    told, seen = told[kept], seen[kept]
    energy = float(np.sum(told**2)), float(np.sum(seen**2))
    if len(told) < FEWEST_PAIRS or min(energy) <= 0:
        return _unknown("the pictures show no contrast that moves", len(told))
    both = float(np.sum(told * seen))
    correlation, slope = both / math.sqrt(energy[0] * energy[1]), both / energy[0]
    clear = abs(correlation) >= max(CLEAR, SIGMAS / math.sqrt(len(told))) and abs(slope) >= LEAST_SLOPE
    rms = float(np.degrees(np.sqrt(np.mean(told**2))))
    if not clear:
        few = abs(correlation) >= CLEAR and abs(slope) >= LEAST_SLOPE
        reason = "there are too few pairs of frames to be sure" if few else "the pictures do not turn as it is told"
        return Handedness("unknown", correlation, slope, len(told), rms, reason)
    return Handedness("agree" if correlation > 0 else "mirrored", correlation, slope, len(told), rms)


def _unknown(reason: str, pairs: int = 0) -> Handedness:
    return Handedness("unknown", float("nan"), float("nan"), pairs, 0.0, reason)


def _headings(part: Part, given: ArrayLike | None) -> Array | None:
    """Return the heading of each frame ``(frames,)`` [rad]; None where nothing tells them."""
    if given is not None:
        heading = np.asarray(given, dtype=float)
        heading = np.linspace(0.0, float(heading), len(part)) if heading.ndim == 0 else heading
        if heading.shape != (len(part),) or not np.isfinite(heading).all():
            raise MitsonarError(
                f"{argument('heading_rad')} must be one finite number, or one for each of {len(part):,} frames: got shape "
                f"{np.shape(given)}"
            )
        return heading
    known = part.poses[:, 5] if part.poses is not None else None
    known = part.attitude_rad[:, 2] if known is None and part.attitude_rad is not None else known
    return known if known is not None and np.isfinite(known).sum() > FEWEST_PAIRS else None


def _turns(heading: Array, pairs: tuple[Index, Index]) -> Array:
    """Return the told rotation of each pair ``(pairs,)`` [rad], in -pi..pi."""
    turn = heading[pairs[1]] - heading[pairs[0]]
    return np.asarray((turn + np.pi) % (2 * np.pi) - np.pi, dtype=float)


def _pairs(heading: Array, spacing: float, most: float) -> tuple[Index, Index] | None:
    """Return the frames of pairs, first and second, that turn by enough and not too much; None where there are too few."""
    found: list[tuple[Index, Index]] = []
    for step in STEPS:
        first = np.arange(0, len(heading) - step)
        turn = _turns(heading, (first, first + step))
        first = first[np.isfinite(turn) & (np.abs(turn) <= most)]
        size = np.abs(_turns(heading, (first, first + step)))
        chosen = first[size >= LEAST_TURN * spacing]
        if len(chosen) >= FEWEST_PAIRS:
            spread = np.unique(np.linspace(0, len(chosen) - 1, min(MOST_PAIRS, len(chosen))).astype(np.intp))
            found.append((chosen[spread], chosen[spread] + step))
        if len(chosen) >= ENOUGH_PAIRS:
            break
    return max(found, key=lambda one: len(one[0])) if found else None


def _seen_turns(part: Part, pairs: tuple[Index, Index], most: float) -> Array:
    """Return the rotation that the pictures of each pair show ``(pairs,)`` [rad], to starboard; nan where none is seen.

    Args:
        part: of a recording.
        pairs: first and second frames.
        most: largest rotation that is searched [rad].
    """
    bearing = part.like.bearing_rad
    some = np.unique(np.concatenate(pairs))
    shown = some[np.unique(np.linspace(0, len(some) - 1, min(MOST_PAIRS // 4, len(some))).astype(np.intp))]
    still = np.mean([part.read([number]).matching_values()[0] for number in shown], axis=0)
    still = still if len(shown) >= FEWEST_PAIRS else np.zeros_like(still)
    even = np.linspace(bearing[0], bearing[-1], len(bearing))
    step = float(even[1] - even[0])
    turns = []
    for first, second in zip(*pairs, strict=True):
        a, b = (_contrast(one, still, bearing, even) for one in part.read([first, second]).matching_values())
        turns.append(-_shift(a, b, max(3, round(most / step))) * step)
    return np.array(turns)


def _contrast(image: NDArray[np.floating], still: NDArray[np.floating], bearing: Array, even: Array) -> Array:
    """Return what moves in a picture ``(rows, beams)``: on even bearings, without the mean of each range, tapered."""
    moving = np.asarray(image - still, dtype=float)
    together = -(-len(moving) // MOST_ROWS)
    moving = moving[: len(moving) // together * together].reshape(-1, together, moving.shape[1]).mean(axis=1)
    place = np.interp(even, bearing, np.arange(len(bearing)))
    left = np.minimum(place.astype(np.intp), len(bearing) - 2)
    over = place - left
    spread = moving[:, left] * (1 - over) + moving[:, left + 1] * over
    spread -= spread.mean(axis=1, keepdims=True)
    return np.asarray(spread * _taper(len(spread))[:, None] * _taper(len(even)), dtype=float)


def _taper(count: int) -> Array:
    return np.asarray(np.hanning(count + 2)[1:-1], dtype=float)


def _shift(a: Array, b: Array, reach: int) -> float:
    """Return by how many columns ``b`` is moved to starboard against ``a``, to a part of one; nan where no peak is inside.

    Args:
        a: first picture ``(rows, beams)``.
        b: second picture, like ``a``.
        reach: largest number of columns.
    """
    rows, beams = a.shape
    size = (2 * rows, 2 * beams)
    found = np.fft.irfft2(np.conj(np.fft.rfft2(a, size)) * np.fft.rfft2(b, size), size)
    over = [np.fft.irfft(np.abs(np.fft.rfft(_taper(count), 2 * count)) ** 2, 2 * count) for count in (rows, beams)]
    down, across = max(2, int(REACH_RANGE * rows)), min(reach, beams - 2)
    lags = np.arange(-down, down + 1), np.arange(-across, across + 1)
    score = found[np.ix_(*lags)] / (over[0][lags[0]][:, None] * over[1][lags[1]])
    row, best = np.unravel_index(int(score.argmax()), score.shape)
    if not score[row, best] > 0 or best in (0, len(lags[1]) - 1):
        return float("nan")
    before, peak, after = score[row, best - 1 : best + 2]
    bend = before - 2 * peak + after
    return float(lags[1][best] + (0.5 * (before - after) / bend if bend < 0 else 0.0))
