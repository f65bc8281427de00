"""What an estimator takes and returns, and when its estimate is rejected.

An estimator takes consecutive records and returns the motion, its covariance and whether it is valid.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, did_you_mean
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
    "checked_options",
    "correlation_excess",
    "correlation_of",
    "correlation_rejection",
    "is_distinct",
    "matching_rejection",
    "prior_rejection",
    "rejected",
    "spread_of",
    "two_frames",
    "without_slow",
]


INPUTS = "pitch; height where no first echoes show"
"""Inputs of methods that use the geometry, besides the images; see :mod:`mitsonar.geometry.ground`."""

FEWEST_CELLS = 8
"""Smallest number of bins and of beams of an image that can be registered."""

LEAST_CORRELATION = 8.0
"""Smallest valid correlation of registered frames, in standard deviations for independent noise in as many cells."""

LEAST_AT_BEST = 0.3
"""Smallest valid correlation of registered frames: a maximum among noise reaches 0.1 to 0.2."""

LEAST_EXCESS = 5.0
"""Smallest excess of frames that correlate by less, in the same standard deviations: noise hides their common content.

Frames of two different places of a hull reach 4.1 in high noise (120 pairs).
"""

LEAST_OVER_SCATTER = 4.0
"""Smallest ratio of the excess to noise and the scatter of displaced frames combined.

A few large rocks scatter more than noise does: frames of two different places of a rocky field reach 6.3 relative to
noise alone, and 3.9 here.
"""

AMBIGUOUS = 12.0
"""Excess, in the same standard deviations, at which noise doubles the covariance; see :func:`ambiguity`."""

FEWEST_BLOCKS = 8.0
"""Smallest number of blocks that share the matched energy: one object is not enough, since its height is unknown."""


LARGEST_REUSED = 2**24
"""Size of the largest arrays whose memory is reused [bytes]."""

Options = dict[str, Any]
"""Options of an estimator, by name."""

PlainTable = dict[str, Any]
"""A JSON object: strings, numbers, lists, nested objects and None, by key."""

Real = NDArray[np.integer | np.floating]
"""An array of real numbers."""

Record = SonarFrames | ViewFrames | ImpulseResponses
"""A record that an estimator may consume."""


@dataclass(frozen=True)
class Estimate:
    """The estimated motion between two frames.

    Attributes:
        motion: sideways, forward [m], yaw [rad] (Almanza-Medina, eq. 3.4); zero where nothing can be estimated.
        covariance: of the motion ``(3, 3)`` [m, m, rad]; None where it is unknown.
        valid: False where the motion must not be used.
        reason: why the estimate was rejected; empty if it is valid.
        about: further results, such as correlation, iterations and candidates.
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
        """Return the standard deviations as text; empty where they are unknown."""
        if self.covariance is None:
            return ""
        sideways, forward, yaw = np.sqrt(np.diag(self.covariance))
        return f"; std {sideways:.2g} m, {forward:.2g} m, {math.degrees(yaw):.2g} deg"


def rejected(reason: str) -> Estimate:
    """Return a rejected estimate of zero motion, with the reason."""
    return Estimate(Motion(0.0, 0.0, 0.0), None, False, reason)


Record_contra = TypeVar("Record_contra", contravariant=True)


class Estimator(Protocol[Record_contra]):
    """Interface of an estimator of the motion from the first to the last of consecutive records.

    Attributes:
        consumes: class of the records: ``SonarFrames``, ``ViewFrames`` or ``ImpulseResponses``; ``object`` for any.
        inputs: what it needs besides the records, e.g. ``nothing`` or ``height and pitch``.
        digest: digest of the weights of a trained estimator; empty for the others.
    """

    @property
    def consumes(self) -> type:
        """Return the class of the records it consumes; ``object`` for any."""

    @property
    def inputs(self) -> str:
        """Return what it needs besides the records, as text."""

    @property
    def digest(self) -> str:
        """Return the digest of the weights of a trained estimator; empty for the others."""

    def estimate(self, records: Record_contra, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion from the first to the last record.

        Args:
            records: consecutive records.
            prior: the expected motion; an estimator that always searches from zero motion ignores it.

        Raises:
            MitsonarError: too few or too many records, or records that lack what the estimator needs.
        """


AnyEstimator = Estimator[Any]
"""An estimator of any kind of record."""


def two_frames(frames: SonarFrames) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the two images as float32 in 0..1, as given by :meth:`SonarFrames.matching_values`.

    Raises:
        MitsonarError: not two frames, too few bins or beams, axes that do not increase, values that are not finite.
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
            f"estimators need {FEWEST_CELLS} bins and beams or more, and increasing ranges and bearings: got "
            f"{frames.image.shape[1]} x {frames.image.shape[2]}; sort rows and columns"
        )
    if not np.isfinite(frames.image).all():
        raise MitsonarError("the images hold nan or inf: set pixels without echo to 0")
    first, second = frames.matching_values()
    return first, second


def reuse_freed_memory() -> None:
    """Make glibc reuse freed arrays: once an array of this size is freed, it returns no memory to the system.

    A pair of frames allocates and frees images by the hundred; fresh pages took a fifth of the time of ``direct``.
    """
    np.empty(LARGEST_REUSED, dtype=np.uint8)


def blank(image: NDArray[np.float32]) -> bool:
    """Return whether all pixels are equal."""
    return bool(image.size == 0 or image.min() == image.max())


def correlation_of(first: Real, second: Real) -> float:
    """Return the correlation coefficient of two arrays of equal shape; 0 if either is constant or empty."""
    if not first.size:
        return 0.0
    a, b = first - first.mean(), second - second.mean()
    size = float(np.sqrt(np.vdot(a, a) * np.vdot(b, b)))
    return float(np.vdot(a, b)) / size if size > 0 else 0.0


class Excess(NamedTuple):
    """How much more two frames correlate than displaced ones, and the standard deviation of the latter.

    The scatter is large where the frames show only a few rocks.
    """

    mean: float = 0.0
    scatter: float = 0.0


UNMEASURED = Excess()
"""Excess of frames for which none was measured."""


def correlation_rejection(correlation: float, independent: float, excess: Excess = UNMEASURED) -> str:
    """Return why the correlation of registered frames is too low; empty if it suffices.

    Args:
        correlation: of the matched frames.
        independent: number of cells with independent noise.
        excess: result of :func:`correlation_excess`, if it was measured.
    """
    if correlation >= max(LEAST_AT_BEST, LEAST_CORRELATION / np.sqrt(independent)) or is_distinct(independent, excess):
        return ""
    return f"the matched frames correlate by {correlation:.2f} only"


def is_distinct(independent: float, excess: Excess) -> bool:
    """Return whether registered frames correlate far more than displaced ones do.

    Args:
        independent: number of cells with independent noise.
        excess: result of :func:`correlation_excess`.
    """
    noise = 1 / np.sqrt(independent)
    return bool(excess.mean >= max(LEAST_EXCESS * noise, LEAST_OVER_SCATTER * np.hypot(noise, excess.scatter)))


def correlation_excess(first: Real, second: Real, inside: NDArray[np.bool_], aside: int) -> Excess:
    """Return how much more two registered images correlate than with one of them displaced across the beams.

    Correlation that comes from the lighting alone is the same in all beams, so it cancels.

    Args:
        first: image ``(rows, columns)``.
        second: the other image, registered to the first.
        inside: which pixels count.
        aside: smallest displacement [columns]; once and twice this displacement are used, to both sides.
    """
    displaced: list[float] = []
    for shift in (-2 * aside, -aside, aside, 2 * aside):
        first_columns, second_columns = (
            slice(max(shift, 0), min(shift, 0) or None),
            slice(max(-shift, 0), min(-shift, 0) or None),
        )
        both = inside[:, first_columns] & inside[:, second_columns]
        displaced.append(
            correlation_of(first[:, first_columns][both], second[:, second_columns][both]) if both.any() else 1.0
        )
    excess = correlation_of(first[inside], second[inside]) - float(np.mean(displaced))
    return Excess(excess, float(np.std(displaced, ddof=1)))


def ambiguity(excess: float, independent: float) -> float:
    """Return the factor by which the covariance grows where a match is hardly distinct.

    There, noise adds curvature that the covariance does not account for. Without this factor, squared errors of ``direct``
    on hulls in high noise were 5.0 times the covariance at an excess of 6 to 8 standard deviations, 2.6 times at 10 to 14,
    1.3 times at 14 to 30 and 1.2 times beyond.

    Args:
        excess: mean of :func:`correlation_excess`.
        independent: number of cells with independent noise.
    """
    return 1 + (AMBIGUOUS / max(excess * float(np.sqrt(independent)), 1.0)) ** 2


def spread_of(shares: NDArray[np.floating]) -> float:
    """Return the effective number of blocks, given the energy of each; a few bright blocks do not hide many faint ones."""
    amplitude = np.sqrt(np.maximum(shares, 0))
    energy = float((amplitude**2).sum())
    return float(amplitude.sum()) ** 2 / energy if energy > 0 else 0.0


def without_slow(image: Real, block: int) -> Real:
    """Remove what varies slowly over blocks of this edge [pixels]: it comes from the lighting, not from the ground."""
    return np.asarray(image - cv2.blur(image, (block // 2, block // 2)))


def matching_rejection(
    first: Real, second: Real, inside: NDArray[np.bool_], *, correlated: float, block: int = 32, aside: int = 0
) -> str:
    """Return why two registered images ``(rows, columns)`` do not match; empty if they do.

    Args:
        first: image ``(rows, columns)``.
        second: the other image, registered to the first.
        inside: which pixels count.
        correlated: number of neighbouring pixels that count as one, since the images are smooth.
        block: edge of the blocks over which the matched energy must be spread [pixels].
        aside: displacement against which a low correlation is compared, see :func:`correlation_excess`; 0: no comparison.
    """
    count = int(inside.sum())
    if count < correlated:
        return "nothing in the frames to match"
    first, second = without_slow(first, block), without_slow(second, block)
    correlation = correlation_of(first[inside], second[inside])
    excess = correlation_excess(first, second, inside, aside) if aside and correlation < LEAST_AT_BEST else UNMEASURED
    reason = correlation_rejection(correlation, count / correlated, excess)
    if reason:
        return reason
    product = np.where(inside, (first - first[inside].mean()) * (second - second[inside].mean()), 0).astype(np.float64)
    rows, columns = (np.arange(0, size, block) for size in product.shape)
    if spread_of(np.add.reduceat(np.add.reduceat(product, rows, axis=0), columns, axis=1)) < FEWEST_BLOCKS:
        return "too small a part of the frames holds anything to match"
    return ""


# ---------------- Check against the prior


LARGEST_SQUARE = 21.1
"""Quantile 0.9999 of chi-square with three degrees of freedom: one correct estimate in ten thousand exceeds it."""


FROM_PRIOR = "from the prior"
"""Words by which the reason of a motion that contradicts its prior is recognised."""


def prior_rejection(motion: Motion, covariance: NDArray[np.float64] | None, prior: MotionPrior | None) -> str:
    """Return why a motion contradicts its prior; empty if it does not, or if there is no prior.

    The squared Mahalanobis distance under the sum of both covariances is compared with the 0.9999 quantile of chi-square
    with three degrees of freedom.

    Args:
        motion: estimated from the frames alone.
        covariance: of the motion ``(3, 3)`` [m, m, rad]; None: unknown, and taken as zero.
        prior: the expected motion.
    """
    if prior is None:
        return ""
    difference = np.array(motion) - np.array(prior.motion)
    total = prior.covariance if covariance is None else prior.covariance + covariance
    std = np.sqrt(np.diag(total))
    std[std == 0] = 1
    scaled = difference / std  # otherwise the solver drops all but a component of large variance
    square = float(scaled @ np.linalg.lstsq(total / np.outer(std, std), scaled, rcond=None)[0])
    if square <= LARGEST_SQUARE:
        return ""
    sideways, forward, yaw = in_units(difference)
    deviations = np.sqrt(square)
    return (
        f"the motion is {sideways:.0f}, {forward:.0f} mm, {yaw:.2f} deg {FROM_PRIOR}: {deviations:.1f} standard deviations"
    )


# ---------------- Options of estimators


def checked_options(name: str, options: Options, factory: Callable[..., object], but: int = 0) -> Options:
    """Check the names of options, and return the options.

    Args:
        name: name of the estimator, for the message.
        options: options by name.
        factory: the function or class that takes them.
        but: number of its first arguments that are not options.

    Raises:
        MitsonarError: an option that it does not take.
    """
    try:
        parameters = list(inspect.signature(factory).parameters.values())[but:]
    except (TypeError, ValueError):  # implemented in C, without a signature
        return options
    if any(one.kind is one.VAR_KEYWORD for one in parameters):
        return options
    known = [one.name for one in parameters if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)]
    for key in options:
        if key not in known:
            raise MitsonarError(
                f"unknown option {key!r}: {name} takes {', '.join(known) or 'none'}{did_you_mean(key, known)}"
            )
    return options
