"""Covariances of the poses along a path, from the covariances of its motions."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag
from scipy.stats import chi2

from mitsonar.errors import MitsonarError
from mitsonar.mapping.motion_series import MotionSeries, path_of
from mitsonar.mapping.pose_graph import CorrelatedErrors
from mitsonar.motion.pose import Pose

__all__ = ["Ellipse", "ellipse", "pose_covariances"]

Array = NDArray[np.float64]


def pose_covariances(
    series: MotionSeries,
    start: Pose,
    at_start: ArrayLike | None = None,
    correlated: CorrelatedErrors | None = None,
    alone: NDArray[np.bool_] | None = None,
) -> Array:
    """Return the covariances of x, y [m] and heading [rad] of every frame ``(frames, 3, 3)`` along a path, to first order.

    Args:
        series: the motions with their covariances, all valid: smooth a series with gaps first.
        start: the first pose.
        at_start: its covariance ``(3, 3)``; not given: known exactly.
        correlated: how errors of consecutive motions depend on each other; not given: as ``series.with_next`` says, or not.
        alone: motions that share no errors all the same ``(frames - 1,)``.

    Raises:
        MitsonarError: no covariances, or an invalid motion, whose error is not known.
    """
    if series.covariances is None:
        raise MitsonarError("the pose's covariance needs those of the motions: give them, or use kalman_smoothed")
    if not series.believed.all():
        gaps = int((~series.believed).sum())
        raise MitsonarError(f"{gaps} motions are not valid, so that their errors are not known: use kalman_smoothed first")
    poses = path_of(series.motions, start, series.time_s).poses
    found = np.zeros((len(poses), 3, 3))
    found[0] = 0.0 if at_start is None else np.asarray(at_start, dtype=float)
    if correlated is None:
        shared, steps = np.zeros((3, 3)), _as_next_says(series.covariances, series.with_next)
    else:
        # one slope stays for good; what wanders begins anew with the first motion
        shared, steps = np.diag([0.0] * 3 + [1.0] * 9), _correlated(series, correlated, alone)
    joint = block_diag(found[0], shared)  # of the pose and of what motions share
    for k, ((x, y), step) in enumerate(zip(np.diff(poses[:, :2], axis=0), steps, strict=True)):
        sin, cos = np.sin(poses[k + 1, 5]), np.cos(poses[k + 1, 5])
        pose = np.array([[1, 0, y], [0, 1, -x], [0, 0, 1]])  # derivatives of eq. 3.4: by the pose,
        motion = np.array([[cos, sin, y], [-sin, cos, -x], [0, 0, 1]])  # and by the motion
        by_shared = motion @ step.by_shared
        onward = np.block([[pose, by_shared @ step.onward], [np.zeros((len(step.onward), 3)), step.onward]])
        fresh_by = np.vstack([by_shared, np.eye(len(step.onward))])
        joint = onward @ joint @ onward.T + fresh_by @ step.fresh @ fresh_by.T
        joint[:3, :3] += motion @ step.own @ motion.T
        joint = (joint + joint.T) / 2
        found[k + 1] = joint[:3, :3]
    return found


class _Step(NamedTuple):
    """The error of a motion, by what it shares with others ``(m,)``: that before it times a matrix, and a fresh part.

    ``onward`` is the matrix ``(m, m)``; ``fresh`` the covariance of the fresh part ``(m, m)``; ``by_shared`` the derivative
    of the error ``(3, m)``; ``own`` the covariance of the rest ``(3, 3)``.
    """

    onward: Array
    fresh: Array
    by_shared: Array
    own: Array


def _as_next_says(covariances: Array, with_next: Array | None) -> Iterator[_Step]:
    """Regress each motion's error on the one before: it is itself what is shared."""
    along, fresh = np.zeros_like(covariances), covariances.copy()
    if with_next is not None and len(with_next):
        along[1:] = np.linalg.solve(covariances[:-1], with_next).swapaxes(1, 2)
        fresh[1:] -= along[1:] @ with_next
    for matrix, rest in zip(along, fresh, strict=True):
        yield _Step(matrix, rest, np.eye(3), np.zeros((3, 3)))


def _correlated(series: MotionSeries, correlated: CorrelatedErrors, alone: NDArray[np.bool_] | None) -> Iterator[_Step]:
    """Share errors that wander, in standard deviations, and slopes over the motion."""
    assert series.covariances is not None
    variance, axes = np.linalg.eigh(series.covariances)
    root = axes * np.sqrt(np.maximum(variance, 0))[:, None] @ axes.swapaxes(1, 2)
    wander = np.sqrt(correlated.share) * root
    by_shared = np.concatenate([wander, correlated.by_slopes()], axis=2)
    own = (1 - correlated.share) * series.covariances
    if alone is not None:
        by_shared[alone], own[alone] = 0.0, series.covariances[alone]
    for along, by, rest in zip(np.append(0.0, correlated.onward), by_shared, own, strict=True):
        onward, fresh = np.ones(12), np.zeros(12)
        onward[:3], fresh[:3] = along, 1 - along**2
        yield _Step(np.diag(onward), np.diag(fresh), by, rest)


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
