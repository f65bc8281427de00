"""Covariances of the poses along a path, from the covariances of its motions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from mitsonar.errors import MitsonarError
from mitsonar.mapping.motion_series import MotionSeries, path_of
from mitsonar.motion.pose import Pose

__all__ = ["Ellipse", "ellipse", "pose_covariances"]

Array = NDArray[np.float64]


def pose_covariances(series: MotionSeries, start: Pose, at_start: ArrayLike | None = None) -> Array:
    """Return the covariances of x, y [m] and heading [rad] of every frame ``(frames, 3, 3)`` along a path, to first order.

    Args:
        series: the motions with their covariances, all valid: smooth a series with gaps first.
        start: the first pose.
        at_start: its covariance ``(3, 3)``; not given: known exactly.

    Raises:
        MitsonarError: no covariances, or an invalid motion, whose error is not known.
    """
    if series.covariances is None:
        raise MitsonarError("the pose's covariance needs those of the motions: give them, or use kalman_smoothed")
    if not series.believed.all():
        gaps = int((~series.believed).sum())
        raise MitsonarError(f"{gaps} motions are not valid, so that their errors are not known: use kalman_smoothed first")
    poses = path_of(series.motions, start, series.time_s).poses
    along, fresh = _dependence(series.covariances, series.with_next)
    found = np.zeros((len(poses), 3, 3))
    joint = np.zeros((6, 6))  # of the pose and of the last motion
    joint[:3, :3] = found[0] = 0.0 if at_start is None else np.asarray(at_start, dtype=float)
    for k, (x, y) in enumerate(np.diff(poses[:, :2], axis=0)):
        sin, cos = np.sin(poses[k + 1, 5]), np.cos(poses[k + 1, 5])
        pose = np.array([[1, 0, y], [0, 1, -x], [0, 0, 1]])  # derivatives of eq. 3.4: by the pose,
        motion = np.array([[cos, sin, y], [-sin, cos, -x], [0, 0, 1]])  # and by the motion
        onward = np.block([[pose, motion @ along[k]], [np.zeros((3, 3)), along[k]]])
        fresh_by = np.vstack([motion, np.eye(3)])
        joint = onward @ joint @ onward.T + fresh_by @ fresh[k] @ fresh_by.T
        joint = (joint + joint.T) / 2
        found[k + 1] = joint[:3, :3]
    return found


def _dependence(covariances: Array, with_next: Array | None) -> tuple[Array, Array]:
    """Return the regression of each motion's error on the one before ``(n, 3, 3)``, and the covariance of its innovation."""
    along, fresh = np.zeros_like(covariances), covariances.copy()
    if with_next is not None and len(with_next):
        along[1:] = np.linalg.solve(covariances[:-1], with_next).swapaxes(1, 2)
        fresh[1:] -= along[1:] @ with_next
    return along, fresh


class Ellipse(NamedTuple):
    """A confidence ellipse: half axes [m], and the bearing of the longer one [rad], clockwise from +y as a heading."""

    major_m: float
    minor_m: float
    heading: float


def ellipse(covariance: ArrayLike, probability: float = 0.95) -> Ellipse:
    """Return the ellipse that holds a position with a probability, from a covariance that begins with x, y ``(2.., 2..)``.

    Raises:
        MitsonarError: a probability that is not between 0 and 1.
    """
    if not 0 < probability < 1:
        raise MitsonarError(f"probability must be between 0 and 1: got {probability:g}")
    variance, axes = np.linalg.eigh(np.asarray(covariance, dtype=float)[:2, :2])
    minor, major = np.sqrt(np.maximum(variance, 0) * chi2.ppf(probability, 2))
    return Ellipse(float(major), float(minor), float(np.arctan2(axes[0, 1], axes[1, 1]) % np.pi))
