"""Drift over segments of a path, as the KITTI odometry benchmark defines it (Geiger et al., 2012), with intervals.

Segments of given lengths begin at every frame (KITTI: at every tenth). The error of a segment is the motion between its ends
as estimated, seen from the true one: its distance over the length, and its angle over the length. The drift is the mean over
all segments of all lengths. KITTI takes lengths of 100 to 800 m; a sonar's path is shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.motion_errors import cluster_resamples
from mitsonar.motion.trajectory import Trajectory
from mitsonar.motion.trajectory_errors import distance_driven, relative_errors

__all__ = ["SegmentDrift", "segment_drift"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SegmentDrift:
    """The errors of all segments of a path.

    Attributes:
        lengths_m: lengths that fit into the path [m].
        length_m: of each segment ``(n,)`` [m].
        translation: error of each, as a part of its length ``(n,)``.
        rotation_rad_per_m: angle between the attitudes over its length ``(n,)`` [rad/m].
        start_m: distance driven before each begins ``(n,)`` [m].
    """

    lengths_m: tuple[float, ...]
    length_m: Array
    translation: Array
    rotation_rad_per_m: Array
    start_m: Array

    @property
    def percent(self) -> float:
        """Return the mean translation error in percent of the length."""
        return 100 * float(self.translation.mean())

    @property
    def deg_per_100m(self) -> float:
        """Return the mean rotation error in deg per 100 m."""
        return 100 * float(np.degrees(self.rotation_rad_per_m.mean()))

    @property
    def blocks(self) -> NDArray[np.int64]:
        """Return the block of each segment ``(n,)``: those that begin within one shortest length belong together."""
        return np.asarray((self.start_m + 1e-9) // min(self.lengths_m), dtype=np.int64)

    def intervals(self, *, seed: int = 0) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return 95 % intervals of percent and of deg per 100 m, by a bootstrap over blocks of the path.

        Segments overlap and are no independent draws; blocks are nearly so. With fewer than ten blocks the intervals are
        too narrow, see :func:`mitsonar.motion.motion_errors.cluster_resamples`.
        """
        drawn = cluster_resamples(self.blocks, seed=seed)
        tables = 100 * self.translation, 100 * np.degrees(self.rotation_rad_per_m)
        ends = [np.percentile(table[drawn].mean(axis=1), [2.5, 97.5]) for table in tables]
        return (float(ends[0][0]), float(ends[0][1])), (float(ends[1][0]), float(ends[1][1]))


def segment_drift(estimated: Trajectory, true: Trajectory, lengths_m: Sequence[float]) -> SegmentDrift | None:
    """Compute the errors of all segments; one begins at every frame.

    Args:
        estimated: the path to judge.
        true: the true path, with the same frames.
        lengths_m: of the segments [m], along the true path. Those that are longer than the path are left out.

    Returns:
        The errors; None where no length fits into the path.

    Raises:
        MitsonarError: another number of poses, or a length that is not above 0.
    """
    if not lengths_m or min(lengths_m) <= 0:
        raise MitsonarError(f"lengths of segments must be above 0 m: got {list(lengths_m)}")
    driven = distance_driven(true)
    fitting = tuple(length for length in lengths_m if driven[-1] >= length * (1 - 1e-9))
    if not fitting:
        return None
    parts = []
    for length in fitting:
        distance, angle = relative_errors(estimated, true, length, "metres", overlapping=True)
        parts.append([np.full(len(distance), length), distance / length, angle / length, driven[: len(distance)]])
    length_m, translation, rotation, start = (np.concatenate(column) for column in zip(*parts, strict=True))
    return SegmentDrift(fitting, length_m, translation, rotation, start)
