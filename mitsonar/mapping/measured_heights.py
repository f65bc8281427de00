"""Heights that were measured from the frames themselves, in place of those that are told."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mitsonar.estimation.estimator import Record
    from mitsonar.estimation.height.direct_height import HeightEstimate, HeightEstimator
    from mitsonar.records.sonar_frames import SonarFrames
    from mitsonar.records.view_frames import ViewFrames

__all__ = ["measured", "without_height"]

Framed = TypeVar("Framed", "SonarFrames", "ViewFrames")


def measured(
    frames: Framed, by: HeightEstimator, like: SonarFrames | ViewFrames | None = None
) -> tuple[Framed, list[HeightEstimate]]:
    """Frames that tell the heights that an estimator finds in them, nan where it is not believed, and nothing else of their
    height; and what it said.

    Args:
        frames: whose heights are replaced.
        by: what tells them.
        like: the same pings as the estimator reads them; None: the frames.

    Raises:
        MitsonarError: as the estimator does.
    """
    seen = frames if like is None else like
    said = [by.height(seen.select(slice(k, k + 1))) for k in range(len(seen))]
    heights = np.array([one.height_m if one.valid else np.nan for one in said])
    return replace(frames, height_m=heights, poses=_at(frames.poses, heights)), said


def without_height(frames: Record) -> bool:
    """Whether heights were measured in these frames, and none was found."""
    told, poses = getattr(frames, "height_m", None), frames.poses
    if told is None or np.isfinite(told).any():
        return False
    return poses is None or not np.isfinite(poses[:, 2]).any()


def _at(poses: NDArray[np.float64] | None, heights: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Poses with these heights over the ground, so that no other is seen."""
    if poses is None:
        return None
    moved = poses.copy()
    moved[:, 2] = heights
    return moved
