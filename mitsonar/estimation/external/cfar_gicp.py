"""The estimator ``cfar-gicp``: points by cell-averaging CFAR on the ground plane, registered by small_gicp."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.estimator import INPUTS, Estimate, rejected, two_frames
from mitsonar.estimation.external.ground_pair import package
from mitsonar.geometry.ground import Attitude, attitude_of
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import SonarFrames

__all__ = ["CfarGicp"]

GUARD, TRAINING = 4, 20
"""Bins on either side of a cell that are left out, and to which the mean of its surroundings reaches beyond them."""

SMOOTH = (3, 5)
"""Beams and bins over which levels are averaged before detection, so that a point is an echo and no grain."""

NEIGHBOURS_M, VOXEL_M = (0.3, 0.1), 0.01
"""Largest distance of points that correspond, far then near, and edge of the cells in which points are joined [m]."""

FEWEST = 30
"""Fewest points of a frame that are registered."""


@dataclass(frozen=True)
class CfarGicp:
    """Detections above the mean of their surroundings in range, as points of level ground.

    Args:
        threshold: level over the mean of the surroundings at which a cell is a detection.

    Raises:
        MitsonarError: small_gicp is not installed.
    """

    threshold: float = 1.5

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def __post_init__(self) -> None:
        package("small_gicp")

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; a prior is where the registration begins.

        Raises:
            MitsonarError: frames of :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
        """
        images = two_frames(frames)
        attitude = attitude_of(frames, "cfar-gicp", None, None)
        clouds = [self._points(image, frames, attitude) for image in images]
        if attitude.reason or min(len(cloud) for cloud in clouds) < FEWEST:
            return rejected(attitude.reason or f"fewer than {FEWEST} detections")
        to_first, settled = _to_first(Motion(0.0, 0.0, 0.0) if prior is None else prior.motion), False
        for distance in NEIGHBOURS_M:
            found = package("small_gicp").align(
                *clouds,
                init_T_target_source=to_first,
                downsampling_resolution=VOXEL_M,
                max_correspondence_distance=distance,
                max_iterations=50,
                rotation_epsilon=1e-5,
                translation_epsilon=1e-5,
            )
            to_first, settled = found.T_target_source, bool(found.converged)
        return Estimate(_motion_of(to_first)) if settled else rejected("the registration does not converge")

    def _points(self, image: NDArray[np.float32], frames: SonarFrames, attitude: Attitude) -> NDArray[np.float64]:
        """Return detections as points ``(n, 3)`` [m]: starboard, forward, 0."""
        level = cv2.blur(image, SMOOTH)
        wide, narrow = (2 * (GUARD + TRAINING) + 1, 2 * GUARD + 1)
        sums = [count * cv2.blur(image, (1, count)) for count in (wide, narrow)]
        around = (sums[0] - sums[1]) / (wide - narrow)
        summit = level >= cv2.dilate(level, np.ones((3, 3), np.uint8))
        points = attitude.ground(frames).points[summit & (level > self.threshold * around)]
        points = points[np.isfinite(points).all(axis=1)]
        return np.column_stack([points, np.zeros(len(points))])


def _to_first(motion: Motion) -> NDArray[np.float64]:
    """Return the matrix ``(4, 4)`` that takes points of the second frame to the first, after a motion (eq. 3.4)."""
    cos, sin = np.cos(motion.yaw), np.sin(motion.yaw)
    matrix = np.eye(4)
    matrix[:2, :2] = [[cos, sin], [-sin, cos]]
    matrix[:2, 3] = matrix[:2, :2] @ [motion.sideways, motion.forward]
    return matrix


def _motion_of(to_first: NDArray[np.float64]) -> Motion:
    """Return the motion of a matrix, the inverse of :func:`_to_first`."""
    yaw = float(np.arctan2(to_first[0, 1], to_first[0, 0]))
    sideways, forward = to_first[:2, :2].T @ to_first[:2, 3]
    return Motion(float(sideways), float(forward), yaw)
