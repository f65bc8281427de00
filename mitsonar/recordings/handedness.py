"""Detect mirrored pictures: compare the rotation that they show with the rotation given by a compass or the user.

When a sonar turns to starboard, fixed objects move to port. In mirrored pictures they move to starboard. Each pair of frames
is registered over bearing and range by cross-correlation. Bearings are searched symmetrically on both sides, up to
twice the largest given rotation. Sideways motion shifts bearings too, but with either sign. Over many pairs, the sign of the
correlation between given and observed rotations therefore decides.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument
from mitsonar.recordings.recording import Part

__all__ = ["Handedness", "check_handedness"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

STEPS = (1, 2, 4, 8, 16, 32, 64)
"""Candidate frame distances within a pair; the smallest that gives enough pairs is used, or else that with the most."""

MIN_TURN = 1.5
"""Minimum rotation of a pair, in units of the beam spacing."""

MAX_TURN = 0.25
"""Maximum rotation of a pair, as a fraction of the field of view; beyond it, too little is visible in both frames."""

MAX_PAIRS = 120
ENOUGH_PAIRS = 40
MIN_PAIRS = 5
"""Maximum number of pairs to register; sufficient number; minimum number for a verdict."""

MIN_CORRELATION, SIGMAS = 0.4, 3.0
"""Minimum correlation for a verdict, absolute and in standard deviations of the correlation of unrelated rotations."""

MIN_SLOPE = 0.25
"""Minimum ratio of observed to given rotation for a verdict."""

MAX_TURN_RATIO = 2.0
"""Maximum rotation that is searched, as a multiple of the largest given one."""

MAX_RANGE_SHIFT = 0.15
"""Maximum shift over range that is searched, as a fraction of the number of bins."""

MAX_ROWS = 192
"""Maximum number of rows to which pictures are averaged."""


class Handedness(NamedTuple):
    """Result of comparing the rotation of pictures with the given headings.

    Attributes:
        verdict: ``agree``, ``mirrored``, or ``unknown`` if the rotation is too small or the two rotations are unrelated.
        correlation: correlation about zero of given and observed rotations, -1..1; nan without pairs.
        slope: ratio of observed to given rotation; near 1 or -1 if field of view and headings are right; nan without pairs.
        pairs: number of registered pairs of frames.
        turn_deg: rms given rotation of a pair [deg].
        reason: why the verdict is ``unknown``; empty otherwise.
    """

    verdict: Literal["agree", "mirrored", "unknown"]
    correlation: float
    slope: float
    pairs: int
    turn_deg: float
    reason: str = ""


def check_handedness(part: Part, heading_rad: ArrayLike | None = None) -> Handedness:
    """Determine whether the pictures of a part rotate as its headings do.

    Args:
        part: part of a recording.
        heading_rad: heading of each frame ``(frames,)`` [rad], clockwise; or one number, the total turn from the first frame
            to the last at a constant rate, > 0 to starboard. Default: headings of the poses, or else of the sonar's compass.

    Raises:
        MitsonarError: the numbers of headings and frames differ, or pictures cannot be read.
    """
    heading = _headings(part, heading_rad)
    if heading is None:
        return _unknown("the headings are unknown: the recording has no poses and no compass, and none were given")
    bearing = part.like.bearing_rad
    if len(bearing) < 8 or len(part) < MIN_PAIRS + 1:
        return _unknown("there are too few beams or frames")
    # 1. Choose pairs of frames that turn by a measurable angle and still show the same ground.
    spacing, width = float(np.median(np.diff(bearing))), float(bearing[-1] - bearing[0])
    pairs = _pairs(heading, spacing, MAX_TURN * width)
    if pairs is None:
        return _unknown(f"no pairs of frames turn by {np.degrees(MIN_TURN * spacing):.2g} deg and show the same ground")
    # 2. Measure the rotation that the pictures show, and drop pairs for which there is none.
    given_turns = _given_turns(heading, pairs)
    observed_turns = _observed_turns(part, pairs, MAX_TURN_RATIO * float(np.abs(given_turns).max()))
    measured = np.isfinite(observed_turns)
    given_turns, observed_turns = given_turns[measured], observed_turns[measured]
    # 3. Correlate both about zero rather than about their means, which preserves the information in a turn to one side.
    energy = float(np.sum(given_turns**2)), float(np.sum(observed_turns**2))
    if len(given_turns) < MIN_PAIRS or min(energy) <= 0:
        return _unknown("the pictures show no moving contrast", len(given_turns))
    product = float(np.sum(given_turns * observed_turns))
    correlation, slope = product / math.sqrt(energy[0] * energy[1]), product / energy[0]
    # 4. Decide by the sign of the correlation, if it is significant: for unrelated rotations, its standard deviation is
    #    1 / sqrt(pairs).
    significant = abs(correlation) >= max(MIN_CORRELATION, SIGMAS / math.sqrt(len(given_turns))) and abs(slope) >= MIN_SLOPE
    rms = float(np.degrees(np.sqrt(np.mean(given_turns**2))))
    if not significant:
        too_few = abs(correlation) >= MIN_CORRELATION and abs(slope) >= MIN_SLOPE
        reason = (
            "there are too few pairs of frames for a verdict"
            if too_few
            else "the rotation of the pictures does not follow the given headings"
        )
        return Handedness("unknown", correlation, slope, len(given_turns), rms, reason)
    return Handedness("agree" if correlation > 0 else "mirrored", correlation, slope, len(given_turns), rms)


def _unknown(reason: str, pairs: int = 0) -> Handedness:
    return Handedness("unknown", float("nan"), float("nan"), pairs, 0.0, reason)


def _headings(part: Part, given: ArrayLike | None) -> Array | None:
    """Return the heading of each frame ``(frames,)`` [rad]; None if headings are unknown."""
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
    return known if known is not None and np.isfinite(known).sum() > MIN_PAIRS else None


def _given_turns(heading: Array, pairs: tuple[Index, Index]) -> Array:
    """Return the given rotation of each pair ``(pairs,)`` [rad], in -pi..pi."""
    turn = heading[pairs[1]] - heading[pairs[0]]
    return np.asarray((turn + np.pi) % (2 * np.pi) - np.pi, dtype=float)


def _pairs(heading: Array, spacing: float, max_turn: float) -> tuple[Index, Index] | None:
    """Return the first and second frames of pairs whose rotation is suitable; None if there are too few.

    Args:
        heading: heading of each frame ``(frames,)`` [rad].
        spacing: beam spacing, which determines the minimum rotation [rad].
        max_turn: maximum rotation [rad].
    """
    candidates: list[tuple[Index, Index]] = []
    for step in STEPS:
        first = np.arange(0, len(heading) - step)
        turn = _given_turns(heading, (first, first + step))
        first = first[np.isfinite(turn) & (np.abs(turn) <= max_turn)]
        turn_size = np.abs(_given_turns(heading, (first, first + step)))
        chosen = first[turn_size >= MIN_TURN * spacing]
        if len(chosen) >= MIN_PAIRS:
            subset = np.unique(np.linspace(0, len(chosen) - 1, min(MAX_PAIRS, len(chosen))).astype(np.intp))
            candidates.append((chosen[subset], chosen[subset] + step))
        if len(chosen) >= ENOUGH_PAIRS:
            break
    return max(candidates, key=lambda one: len(one[0])) if candidates else None


def _observed_turns(part: Part, pairs: tuple[Index, Index], max_turn: float) -> Array:
    """Return the rotation that the pictures of each pair show ``(pairs,)`` [rad], to starboard; nan if there is none.

    Args:
        part: part of a recording.
        pairs: first and second frames.
        max_turn: largest rotation that is searched [rad].
    """
    # 1. Average some pictures. Stationary content, such as the beam pattern, would bias the result towards no rotation.
    bearing = part.like.bearing_rad
    frames = np.unique(np.concatenate(pairs))
    sampled = frames[np.unique(np.linspace(0, len(frames) - 1, min(MAX_PAIRS // 4, len(frames))).astype(np.intp))]
    stationary = np.mean([part.read([number]).matching_values()[0] for number in sampled], axis=0)
    stationary = stationary if len(sampled) >= MIN_PAIRS else np.zeros_like(stationary)
    # 2. Register each pair on evenly spaced bearings. The scene moves against the rotation of the sonar: negate the shift.
    even = np.linspace(bearing[0], bearing[-1], len(bearing))
    step = float(even[1] - even[0])
    turns = []
    for first, second in zip(*pairs, strict=True):
        a, b = (_moving_content(one, stationary, bearing, even) for one in part.read([first, second]).matching_values())
        turns.append(-_shift(a, b, max(3, round(max_turn / step))) * step)
    return np.array(turns)


def _moving_content(image: NDArray[np.floating], stationary: NDArray[np.floating], bearing: Array, even: Array) -> Array:
    """Return the moving content of a picture ``(rows, beams)`` on even bearings, prepared for correlation.

    Args:
        image: picture ``(bins, beams)``.
        stationary: mean picture ``(bins, beams)``, which is subtracted.
        bearing: bearings of the picture ``(beams,)`` [rad].
        even: evenly spaced bearings of the result ``(beams,)`` [rad].
    """
    # 1. Subtract the stationary content, and average bins to at most MAX_ROWS rows.
    moving = np.asarray(image - stationary, dtype=float)
    bins_per_row = -(-len(moving) // MAX_ROWS)
    moving = moving[: len(moving) // bins_per_row * bins_per_row].reshape(-1, bins_per_row, moving.shape[1]).mean(axis=1)
    # 2. Interpolate to even bearings, on which a rotation is the same shift in all columns.
    position = np.interp(even, bearing, np.arange(len(bearing)))
    left = np.minimum(position.astype(np.intp), len(bearing) - 2)
    weight = position - left
    resampled = moving[:, left] * (1 - weight) + moving[:, left + 1] * weight
    # 3. Remove the mean of each range and taper the borders, so that neither rings nor borders dominate the correlation.
    resampled -= resampled.mean(axis=1, keepdims=True)
    return np.asarray(resampled * _taper(len(resampled))[:, None] * _taper(len(even)), dtype=float)


def _taper(count: int) -> Array:
    return np.asarray(np.hanning(count + 2)[1:-1], dtype=float)


def _shift(a: Array, b: Array, reach: int) -> float:
    """Return the shift of ``b`` to starboard relative to ``a`` [fractional columns]; nan without a peak inside the range.

    Args:
        a: first picture ``(rows, beams)``.
        b: second picture ``(rows, beams)``.
        reach: largest shift that is searched [columns].
    """
    # 1. Cross-correlate by FFT, padded with zeros to twice the size to avoid wrap-around.
    rows, beams = a.shape
    size = (2 * rows, 2 * beams)
    correlation = np.fft.irfft2(np.conj(np.fft.rfft2(a, size)) * np.fft.rfft2(b, size), size)
    # 2. Divide by the autocorrelation of the tapers: the overlap shrinks with the shift, which would favour small shifts.
    taper_correlations = [
        np.fft.irfft(np.abs(np.fft.rfft(_taper(count), 2 * count)) ** 2, 2 * count) for count in (rows, beams)
    ]
    down, across = max(2, int(MAX_RANGE_SHIFT * rows)), min(reach, beams - 2)
    lags = np.arange(-down, down + 1), np.arange(-across, across + 1)
    score = correlation[np.ix_(*lags)] / (taper_correlations[0][lags[0]][:, None] * taper_correlations[1][lags[1]])
    # 3. Find the peak. One at the end of the search interval is not a maximum.
    row, peak_column = np.unravel_index(int(score.argmax()), score.shape)
    if not score[row, peak_column] > 0 or peak_column in (0, len(lags[1]) - 1):
        return float("nan")
    # 4. Refine it by the vertex of the parabola through the peak and its neighbours.
    before, peak, after = score[row, peak_column - 1 : peak_column + 2]
    curvature = before - 2 * peak + after
    return float(lags[1][peak_column] + (0.5 * (before - after) / curvature if curvature < 0 else 0.0))
