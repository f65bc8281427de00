"""The estimator protocol: consecutive records in; motion, covariance and validity out."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.motion.errors import in_units
from mitsonar.records.frames import SonarFrames, ViewFrames
from mitsonar.records.responses import ImpulseResponses

__all__ = [
    "FEWEST_BLOCKS",
    "INPUTS",
    "LEAST_AT_BEST",
    "UNMEASURED",
    "AnyEstimator",
    "Estimate",
    "Estimator",
    "Excess",
    "Options",
    "PlainTable",
    "Record",
    "ambiguity",
    "blank",
    "correlation_excess",
    "correlation_of",
    "correlation_rejection",
    "matching_rejection",
    "prior_rejection",
    "rejected",
    "spread_of",
    "stands_out",
    "two_frames",
    "without_slow",
]


INPUTS = "pitch; height where no first echoes show"
"""Inputs of methods that know the geometry, beside the images; see :mod:`mitsonar.geometry.ground`."""

FEWEST_CELLS = 8
"""Fewest bins and beams of an image that can be registered."""

LEAST_CORRELATION = 8.0
"""Least correlation of registered frames, in standard deviations for independent noise in as many cells."""

LEAST_AT_BEST = 0.3
"""Least correlation of registered frames: a maximum among noise reaches 0.1 to 0.2."""

LEAST_EXCESS = 5.0
"""Least excess, in the same standard deviations, of frames that correlate by less: noise hides what they have in common.

Frames of two places of a hull reach 4.1 in high noise, 120 pairs.
"""

LEAST_OVER_SCATTER = 4.0
"""Least excess over noise and the scatter of displaced frames together.

A few large rocks scatter more than noise does: frames of two places of a rocky field reach 6.3 in noise alone, 3.9 here.
"""

AMBIGUOUS = 12.0
"""Excess, in the same standard deviations, at which noise doubles the covariance; see :func:`ambiguity`."""

FEWEST_BLOCKS = 8.0
"""Fewest blocks of a frame that share the matched energy: a single object is too little, its height is not known."""


LARGEST_REUSED = 2**24
"""Bytes of the largest arrays whose memory is kept."""

Options = dict[str, Any]
"""Options of an estimator by name."""

PlainTable = dict[str, Any]
"""What JSON holds, by key: texts, numbers, lists, tables and None."""

Real = NDArray[np.integer | np.floating]
"""An array of real numbers."""

Record = SonarFrames | ViewFrames | ImpulseResponses
"""What an estimator may consume."""


@dataclass(frozen=True)
class Estimate:
    """The estimate of a motion between two frames.

    Attributes:
        motion: sideways, forward [m], yaw [rad] (Almanza-Medina, eq. 3.4); zero where nothing can be estimated.
        covariance: of the motion ``(3, 3)`` [m, m, rad], where the estimator knows it.
        valid: False where the motion must not be used.
        reason: of a rejection.
        about: further results: correlation, iterations, candidates ...
    """

    motion: Motion
    covariance: NDArray[np.float64] | None = None
    valid: bool = True
    reason: str = ""
    about: PlainTable = field(default_factory=dict)

    def __repr__(self) -> str:
        if not self.valid:
            return f"Estimate(rejected: {self.reason[:160]})"
        motion = f"sideways {self.motion.sideways:+.4g} m, forward {self.motion.forward:+.4g} m"
        return f"Estimate({motion}, yaw {math.degrees(self.motion.yaw):+.4g} deg{self._deviations})"

    @property
    def _deviations(self) -> str:
        """Return the standard deviations in words, where they are known."""
        if self.covariance is None:
            return ""
        sideways, forward, yaw = np.sqrt(np.diag(self.covariance))
        return f"; std {sideways:.2g} m, {forward:.2g} m, {math.degrees(yaw):.2g} deg"


def rejected(reason: str) -> Estimate:
    """Return no motion, with the reason of the rejection."""
    return Estimate(Motion(0.0, 0.0, 0.0), None, False, reason)


Record_contra = TypeVar("Record_contra", contravariant=True)


class Estimator(Protocol[Record_contra]):
    """Estimates the motion from the first to the last of consecutive frames, views or impulse responses.

    Attributes:
        consumes: the class of the records: ``SonarFrames``, ``ViewFrames`` or ``ImpulseResponses``; ``object`` for any.
        inputs: what it needs beside them: ``nothing``, ``height and pitch`` ...
        digest: of the weights of a trained one; empty for the others.
    """

    @property
    def consumes(self) -> type:
        """Return the class of the records that it reads; ``object`` for any."""

    @property
    def inputs(self) -> str:
        """Return what it needs beside the records, in words."""

    @property
    def digest(self) -> str:
        """Return the digest of the weights of a trained one; empty for the others."""

    def estimate(self, records: Record_contra, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion from the first to the last record.

        Args:
            records: consecutive ones.
            prior: what is expected of the motion before; an estimator that searches from no motion ignores it.

        Raises:
            MitsonarError: too few or too many records, or records without what the estimator needs.
        """


AnyEstimator = Estimator[Any]
"""An estimator, whatever records it consumes."""


def two_frames(frames: SonarFrames) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the two images as float32 in 0..1, as :meth:`SonarFrames.matching_values` has them.

    Raises:
        MitsonarError: not two frames, too few bins or beams, axes that do not rise, values not finite.
    """
    if len(frames) != 2:
        raise MitsonarError(f"an estimator takes two frames: got {len(frames)}")
    reuse_freed_memory()
    kind = frames.image.dtype
    if not (kind == np.uint8 or np.issubdtype(kind, np.floating)):
        raise MitsonarError(f"estimators take images of uint8 or float in 0..1: got {kind}; convert them first")
    rising = (np.diff(frames.range_m) > 0).all() and (np.diff(frames.bearing_rad) > 0).all()
    if min(frames.image.shape[1:]) < FEWEST_CELLS or not rising:
        raise MitsonarError(
            f"estimators need {FEWEST_CELLS} bins and beams or more, ranges and bearings that rise: got "
            f"{frames.image.shape[1]} x {frames.image.shape[2]}; sort rows and columns"
        )
    if not np.isfinite(frames.image).all():
        raise MitsonarError("the images hold nan or inf: set pixels without echo to 0")
    first, second = frames.matching_values()
    return first, second


def reuse_freed_memory() -> None:
    """Have glibc keep freed arrays for the next ones: after one of this size was freed, it gives none back to the system.

    Images are made and freed by the hundred a pair; fresh pages took a fifth of the time of ``direct``.
    """
    np.empty(LARGEST_REUSED, dtype=np.uint8)


def blank(image: NDArray[np.float32]) -> bool:
    """Return whether all pixels are the same."""
    return bool(image.size == 0 or image.min() == image.max())


def correlation_of(first: Real, second: Real) -> float:
    """Return the correlation coefficient of two arrays of one shape; 0 where either is constant or empty."""
    if not first.size:
        return 0.0
    a, b = first - first.mean(), second - second.mean()
    size = float(np.sqrt(np.vdot(a, a) * np.vdot(b, b)))
    return float(np.vdot(a, b)) / size if size > 0 else 0.0


class Excess(NamedTuple):
    """By how much two frames correlate more than displaced ones, and the standard deviation of those: few rocks scatter."""

    mean: float = 0.0
    scatter: float = 0.0


UNMEASURED = Excess()
"""The excess of frames of which none was measured."""


def correlation_rejection(correlation: float, independent: float, excess: Excess = UNMEASURED) -> str:
    """Return why registered frames correlate too little; empty where they correlate enough.

    Args:
        correlation: of the frames as matched.
        independent: number of cells with independent noise.
        excess: of :func:`correlation_excess`, where it was measured.
    """
    if correlation >= max(LEAST_AT_BEST, LEAST_CORRELATION / np.sqrt(independent)) or stands_out(independent, excess):
        return ""
    return f"the frames as matched correlate by {correlation:.2f} only"


def stands_out(independent: float, excess: Excess) -> bool:
    """Return whether registered frames correlate by far more than displaced ones do.

    Args:
        independent: number of cells with independent noise.
        excess: of :func:`correlation_excess`.
    """
    noise = 1 / np.sqrt(independent)
    return bool(excess.mean >= max(LEAST_EXCESS * noise, LEAST_OVER_SCATTER * np.hypot(noise, excess.scatter)))


def correlation_excess(first: Real, second: Real, inside: NDArray[np.bool_], aside: int) -> Excess:
    """Return by how much two registered images correlate more than with one of them displaced across the beams.

    What the lighting alone correlates is alike in all beams, and counts on neither side.

    Args:
        first: one ``(rows, columns)``.
        second: the other, registered to it.
        inside: which pixels count.
        aside: the least displacement [columns]; once and twice as many are taken, to either side.
    """
    others: list[float] = []
    for shift in (-2 * aside, -aside, aside, 2 * aside):
        here, there = slice(max(shift, 0), min(shift, 0) or None), slice(max(-shift, 0), min(-shift, 0) or None)
        both = inside[:, here] & inside[:, there]
        others.append(correlation_of(first[:, here][both], second[:, there][both]) if both.any() else 1.0)
    excess = correlation_of(first[inside], second[inside]) - float(np.mean(others))
    return Excess(excess, float(np.std(others, ddof=1)))


def ambiguity(excess: float, independent: float) -> float:
    """Return the factor of the covariance where a match hardly stands out: noise makes curvature of its own.

    Without it, squared errors of ``direct`` on hulls in high noise were 5.0 times the covariance at an excess of 6 to 8
    standard deviations, 2.6 times at 10 to 14, 1.3 times at 14 to 30 and 1.2 times beyond.

    Args:
        excess: mean of :func:`correlation_excess`.
        independent: number of cells with independent noise.
    """
    return 1 + (AMBIGUOUS / max(excess * float(np.sqrt(independent)), 1.0)) ** 2


def spread_of(shares: NDArray[np.floating]) -> float:
    """Return the effective number of blocks, from the energy of each. A few bright ones do not hide many faint."""
    amplitude = np.sqrt(np.maximum(shares, 0))
    energy = float((amplitude**2).sum())
    return float(amplitude.sum()) ** 2 / energy if energy > 0 else 0.0


def without_slow(image: Real, block: int) -> Real:
    """Remove what varies slowly over blocks of this edge [pixels]: it belongs to the sonar's lighting, not to the ground."""
    return np.asarray(image - cv2.blur(image, (block // 2, block // 2)))


def matching_rejection(
    first: Real, second: Real, inside: NDArray[np.bool_], *, alike: float, block: int = 32, aside: int = 0
) -> str:
    """Return why two registered images ``(rows, columns)`` do not match; empty where they do.

    Args:
        first: one.
        second: the other, registered to it.
        inside: which pixels count.
        alike: number of neighbouring pixels that count as one, since the images are smooth.
        block: edge of the blocks over which the matched energy must be spread [pixels].
        aside: displacement with which a low correlation is compared, see :func:`correlation_excess`; 0: with none.
    """
    count = int(inside.sum())
    if count < alike:
        return "nothing in the frames to match"
    first, second = without_slow(first, block), without_slow(second, block)
    correlation = correlation_of(first[inside], second[inside])
    excess = correlation_excess(first, second, inside, aside) if aside and correlation < LEAST_AT_BEST else UNMEASURED
    reason = correlation_rejection(correlation, count / alike, excess)
    if reason:
        return reason
    product = np.where(inside, (first - first[inside].mean()) * (second - second[inside].mean()), 0).astype(np.float64)
    rows, columns = (np.arange(0, size, block) for size in product.shape)
    if spread_of(np.add.reduceat(np.add.reduceat(product, rows, axis=0), columns, axis=1)) < FEWEST_BLOCKS:
        return "too small a part of the frames holds anything to match"
    return ""


# ---------------- Estimates are held against what was expected: a motion that a prior all but excludes is rejected


LARGEST_SQUARE = 21.1
"""Chi-square of three numbers that one right estimate in ten thousand exceeds."""


def prior_rejection(motion: Motion, covariance: NDArray[np.float64] | None, prior: MotionPrior | None) -> str:
    """Return why a motion contradicts its prior; empty where it does not, or where there is no prior.

    The squared distance is measured by the sum of both covariances, and compared with chi-square of three numbers at 0.9999.

    Args:
        motion: estimated from the frames alone.
        covariance: of it ``(3, 3)`` [m, m, rad]; None: unknown, and not counted.
        prior: what was expected.
    """
    if prior is None:
        return ""
    apart = np.array(motion) - np.array(prior.motion)
    together = prior.covariance if covariance is None else prior.covariance + covariance
    std = np.sqrt(np.diag(together))
    std[std == 0] = 1
    scaled = apart / std  # else a component of large variance makes the solver drop the others
    square = float(scaled @ np.linalg.lstsq(together / np.outer(std, std), scaled, rcond=None)[0])
    if square <= LARGEST_SQUARE:
        return ""
    sideways, forward, yaw = in_units(apart)
    off = np.sqrt(square)
    return f"the motion is {sideways:.0f}, {forward:.0f} mm, {yaw:.2f} deg from the prior: {off:.1f} standard deviations"
