"""Heights that are measured in the frames themselves, in place of recorded ones."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mitsonar.estimation.estimator import Record
    from mitsonar.estimation.height import HeightEstimate, HeightEstimator
    from mitsonar.records.frames import SonarFrames, ViewFrames

__all__ = ["measured", "without_height"]

Framed = TypeVar("Framed", bound="SonarFrames | ViewFrames")


def measured(
    frames: Framed, by: HeightEstimator, like: SonarFrames | ViewFrames | None = None
) -> tuple[Framed, list[HeightEstimate]]:
    """Measure the height in each frame, and return the frames with these heights, and the estimates.

    Heights are nan where the estimate is not valid. The poses take the same heights, so that no other can be read.

    Args:
        frames: whose heights are replaced.
        by: measures the heights.
        like: the same pings as the estimator reads them; None: the frames.

    Raises:
        MitsonarError: as the estimator does.
    """
    read = frames if like is None else like
    estimates = [by.height(read.select(slice(k, k + 1))) for k in range(len(read))]
    heights = np.array([one.height_m if one.valid else np.nan for one in estimates])
    return replace(frames, height_m=heights, poses=_at(frames.poses, heights)), estimates


def without_height(frames: Record) -> bool:
    """Return whether heights were measured in these frames, and none was found."""
    heights, poses = getattr(frames, "height_m", None), frames.poses
    if heights is None or np.isfinite(heights).any():
        return False
    return poses is None or not np.isfinite(poses[:, 2]).any()


def _at(poses: NDArray[np.float64] | None, heights: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return poses with these heights over the ground."""
    if poses is None:
        return None
    moved = poses.copy()
    moved[:, 2] = heights
    return moved
