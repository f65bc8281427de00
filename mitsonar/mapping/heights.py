"""Heights that were measured from the frames themselves, in place of those that are told."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mitsonar.estimation.height import HeightEstimate, HeightEstimator
    from mitsonar.frames import SonarFrames
    from mitsonar.viewframes import ViewFrames

__all__ = ["measured"]


def measured(
    frames: SonarFrames | ViewFrames, by: HeightEstimator, like: SonarFrames | ViewFrames | None = None
) -> tuple[Any, list[HeightEstimate]]:
    """Frames that tell the heights that an estimator finds in them, and nothing else of their height; and what it said.

    Where it is not believed, the median of the others stands, or nan where there are none.

    Args:
        frames: whose heights are replaced.
        by: what tells them.
        like: the same pings as the estimator reads them; None: the frames.

    Raises:
        MitsonarError: as the estimator does.
    """
    seen = frames if like is None else like
    said = [by.height(seen.select(slice(k, k + 1))) for k in range(len(seen))]
    heights = np.array([one.height_m if one.believe else np.nan for one in said])
    known = heights[np.isfinite(heights)]
    heights = np.where(np.isfinite(heights), heights, np.median(known) if len(known) else np.nan)
    return replace(frames, height_m=heights, poses=_at(frames.poses, heights)), said


def _at(poses: NDArray[np.float64] | None, heights: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Poses with these heights over the ground, so that no other is seen."""
    if poses is None:
        return None
    moved = poses.copy()
    moved[:, 2] = heights
    return moved
