"""The estimator protocol: consecutive records in, the motion between them out, its covariance, and whether it is valid."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import Motion
from mitsonar.records.impulse_responses import ImpulseResponses
from mitsonar.records.sonar_frames import SonarFrames
from mitsonar.records.view_frames import ViewFrames

__all__ = [
    "FEWEST_BLOCKS",
    "INPUTS",
    "LEAST_AT_BEST",
    "LEAST_CORRELATION",
    "AnyEstimator",
    "Estimate",
    "Estimator",
    "PlainTable",
    "Record",
    "blank",
    "correlation_of",
    "matching_rejection",
    "rejected",
    "spread_of",
    "two_frames",
]

INPUTS = "pitch; height where no first echoes show"
"""What methods that know the geometry are given beside the images; see :mod:`mitsonar.geometry.attitude`."""

FEWEST_CELLS = 8
"""Bins and beams of an image that can be registered."""

LEAST_CORRELATION = 8.0
"""Of frames as matched, in standard deviations of the correlation of independent noise in as many cells."""

LEAST_AT_BEST = 0.3
"""Of frames that were brought together: a maximum found among noise reaches 0.1 to 0.2."""

FEWEST_BLOCKS = 8.0
"""Parts of a frame that share what is matched: one object alone tells little, and its height is not known."""


PlainTable = dict[str, Any]
"""What JSON holds, by key: texts, numbers, lists, tables and None."""

Real = NDArray[np.integer | np.floating]
"""An array of real numbers."""

Record = SonarFrames | ViewFrames | ImpulseResponses
"""What an estimator may consume."""


@dataclass(frozen=True)
class Estimate:
    """What an estimator says of two frames.

    Attributes:
        motion: sideways, forward [m], yaw [rad] (eq. 3.4); zero where nothing can be said.
        covariance: of these ``(3, 3)``, where the estimator knows it.
        believe: False where it should not be used.
        reason: why not.
        about: what else it tells: correlation, iterations ...
    """

    motion: Motion
    covariance: NDArray[np.float64] | None = None
    valid: bool = True
    reason: str = ""
    about: PlainTable = field(default_factory=dict)


def rejected(reason: str) -> Estimate:
    """No motion, and why not to believe it."""
    return Estimate(Motion(0.0, 0.0, 0.0), None, False, reason)


Record_contra = TypeVar("Record_contra", contravariant=True)


class Estimator(Protocol[Record_contra]):
    """Consecutive records (frames, views or impulse responses) to the motion from the first to the last.

    Attributes:
        consumes: the class of the records: ``SonarFrames``, ``ViewFrames`` or ``ImpulseResponses``; ``object`` for any.
        inputs: what it needs beside them: ``nothing``, ``height and pitch`` ...
        digest: of the weights of a trained one; empty for the others.
    """

    @property
    def consumes(self) -> type: ...
    @property
    def inputs(self) -> str: ...
    @property
    def digest(self) -> str: ...

    def estimate(self, records: Record_contra, /) -> Estimate:
        """Estimate the motion from the first to the last record.

        Raises:
            MitsonarError: too few or too many records, or records without what the estimator needs.
        """


AnyEstimator = Estimator[Any]
"""An estimator, whatever records it consumes."""


def two_frames(frames: SonarFrames) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The two images as fractions of the maximum, float32.

    Raises:
        MitsonarError: not two frames, too few bins or beams or in disorder, levels that are not linear or not finite.
    """
    if len(frames) != 2:
        raise MitsonarError(f"an estimator takes two frames: got {len(frames)}")
    kind = frames.image.dtype
    if frames.level != "linear" or not (kind == np.uint8 or np.issubdtype(kind, np.floating)):
        raise MitsonarError(
            f"estimators take linear images, uint8 or float in 0..1: got {kind}, {frames.level}; convert them first"
        )
    rising = (np.diff(frames.range_m) > 0).all() and (np.diff(frames.bearing_rad) > 0).all()
    if min(frames.image.shape[1:]) < FEWEST_CELLS or not rising:
        raise MitsonarError(
            f"estimators need {FEWEST_CELLS} bins and beams or more, ranges and bearings that rise: got "
            f"{frames.image.shape[1]} x {frames.image.shape[2]}; sort rows and columns"
        )
    if not np.isfinite(frames.image).all():
        raise MitsonarError("the images hold nan or inf: set pixels without echo to 0")
    scale = np.float32(1 / 255 if frames.image.dtype == np.uint8 else 1)
    first, second = (np.asarray(image, dtype=np.float32) * scale for image in frames.image)
    return first, second


def blank(image: NDArray[np.float32]) -> bool:
    """Whether all pixels are the same."""
    return bool(image.size == 0 or image.min() == image.max())


def correlation_of(first: Real, second: Real) -> float:
    """Correlation coefficient of two arrays of one shape; 0 where either is constant."""
    a, b = first - first.mean(), second - second.mean()
    size = float(np.sqrt(np.vdot(a, a) * np.vdot(b, b)))
    return float(np.vdot(a, b)) / size if size > 0 else 0.0


def spread_of(shares: NDArray[np.floating]) -> float:
    """How many blocks share what is matched, from the energy of each; few bright ones do not hide many faint ones."""
    amplitude = np.sqrt(np.maximum(shares, 0))
    energy = float((amplitude**2).sum())
    return float(amplitude.sum()) ** 2 / energy if energy > 0 else 0.0


def matching_rejection(first: Real, second: Real, inside: NDArray[np.bool_], *, alike: float, block: int = 32) -> str:
    """What speaks against two images ``(rows, columns)`` that should now be alike; empty where nothing does.

    Args:
        first: one.
        second: the other, as matched.
        inside: which pixels count.
        alike: how many neighbouring pixels count as one, since they were smoothed.
        block: edge of the blocks over which what is matched must be spread [pixels].
    """
    count = int(inside.sum())
    if count < alike:
        return "nothing in the frames to match"
    # what is slow belongs to the sonar's lighting, not to the ground
    first, second = (image - cv2.blur(image, (block // 2, block // 2)) for image in (first, second))
    correlation = correlation_of(first[inside], second[inside])
    if correlation < max(LEAST_AT_BEST, LEAST_CORRELATION / np.sqrt(count / alike)):
        return f"the frames as matched correlate by {correlation:.2f} only"
    product = np.where(inside, (first - first[inside].mean()) * (second - second[inside].mean()), 0).astype(np.float64)
    rows, columns = (np.arange(0, size, block) for size in product.shape)
    if spread_of(np.add.reduceat(np.add.reduceat(product, rows, axis=0), columns, axis=1)) < FEWEST_BLOCKS:
        return "too small a part of the frames holds anything to match"
    return ""
