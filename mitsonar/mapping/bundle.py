"""How poses and landmarks are adjusted together to observed ranges and bearings (bundle adjustment).

One range and bearing of a point do not determine its elevation; several from different places do (Huang and Kaess, 2015).
Landmarks are eliminated first (Schur complement), so that the size of the equations is that of the poses. Landmarks lie on
the ground or above it: their heights have an exponential distribution, of relief above the ground and of errors below it.
This prior fixes the scale, which range and bearing alone determine poorly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from mitsonar.geometry.fan import Views, projection_of
from mitsonar.instruments.sonar import Bearing

__all__ = ["PLANAR", "Adjusted", "Observations", "adjusted", "cauchy", "track_weight"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

PLANAR = np.array([0, 1, 5])
"""Indices of x, y and heading in a pose."""

ROUNDS = 3
STILL = 1e-6
"""Largest number of Gauss-Newton iterations, and the step below which they end [m, rad]."""

OUTLYING = 4.0
"""Squared normalised error at which an observation has half the weight."""

TRACK = 1.2
"""Mean squared error, relative to the usual one, at which a landmark has half the weight: it may move with a shadow."""

HARSH = 3
"""Exponent of the weight loss of poorly fitting landmarks: with 2, sideways paths over rocks drift more; with 4, forward
ones."""

BELOW_M = 0.02
"""Mean of the errors of heights below the ground [m]."""

UNKNOWN_M = 0.03
"""Standard deviation beyond which an observed height is drawn to the mean of its distribution, not only to its mode [m].

With 0.1 m, many uncertain heights together pull the landmarks down, and paths ahead become too long. With 0.02 m,
stated variances of motions ahead are five times too large over one ground.
"""

NEAREST_M = 0.01
"""Smallest distance from the ground in the prior of heights, which has a corner there [m]."""

LARGEST = 50.0
"""Squared normalised error at which the contribution of an observation to the error of its landmark is capped."""

LEAST_MEDIAN = 0.2
"""Lower bound of the usual squared normalised error of the observations."""

LOOSE = 1e-6
"""Weak prior information on every unknown, against singular equations [1/m^2, 1/rad^2]."""


class Observations(NamedTuple):
    """Observed ranges and bearings of landmarks.

    Attributes:
        view: index of the pose ``(n,)``.
        landmark: index of the landmark ``(n,)``.
        polar: range [m] and bearing [rad] ``(n, 2)``.
        covariance: covariance of range and bearing ``(n, 2, 2)``.
    """

    view: Index
    landmark: Index
    polar: Array
    covariance: Array

    def take(self, index: Index | NDArray[np.bool_]) -> Observations:
        """Return the selected observations."""
        return Observations(self.view[index], self.landmark[index], self.polar[index], self.covariance[index])


class Adjusted(NamedTuple):
    """Result of a bundle adjustment.

    Attributes:
        poses: adjusted poses ``(k, 6)`` [m, rad].
        points: adjusted points of the landmarks ``(l, 3)`` [m].
        point_covariance: covariances of the points, given the poses ``(l, 3, 3)``.
        faults: mean squared error of each landmark, relative to the usual one ``(l,)``.
        last_covariance: covariance of x, y [m] and heading [rad] of the last pose, given the fixed poses ``(3, 3)``.
    """

    poses: Array
    points: Array
    point_covariance: Array
    faults: Array
    last_covariance: Array


class _Blocks(NamedTuple):
    """The blocks of the normal equations.

    Attributes:
        poses: matrix of the free poses ``(6 k, 6 k)``.
        pose_rhs: right-hand side of the free poses ``(6 k,)``.
        between: matrix between poses and landmarks ``(6 k, 3 l)``.
        landmarks: diagonal blocks of the landmarks ``(l, 3, 3)``.
        landmark_rhs: right-hand side of the landmarks ``(l, 3)``.
        faults: mean squared error of each landmark, relative to the usual one ``(l,)``.
    """

    poses: Array
    pose_rhs: Array
    between: Array
    landmarks: Array
    landmark_rhs: Array
    faults: Array


def cauchy(squared: Array) -> Array:
    """Return the Cauchy weights of observations with these squared normalised errors."""
    return np.asarray(1 / (1 + squared / OUTLYING))


def track_weight(faults: Array) -> Array:
    """Return the weights of landmarks with these mean squared errors, relative to the usual one."""
    return np.asarray(1 / (1 + (faults / TRACK) ** HARSH))


def adjusted(
    poses: Array,
    fixed: int,
    measured: Array,
    attitude_std: Array,
    points: Array,
    seen: Observations,
    bearing: Bearing,
    relief_m: float,
) -> Adjusted:
    """Adjust poses and landmarks to observations by Gauss-Newton.

    Args:
        poses: initial poses ``(k, 6)`` [m, rad].
        fixed: number of poses, from the first, that stay fixed.
        measured: measured heights [m], pitches and rolls [rad] of the other poses ``(k - fixed, 3)``.
        attitude_std: standard deviations of these heights [m], pitches and rolls [rad] ``(3,)``.
        points: initial points of the landmarks, with z as height over the ground ``(l, 3)`` [m].
        seen: observations of the landmarks.
        bearing: kind of the bearings.
        relief_m: mean height of visible relief over the ground [m].

    Returns:
        The adjusted poses and points, with covariances.

    Raises:
        LinAlgError: the observations do not suffice.
    """
    adjusted_poses, adjusted_points = poses.copy(), points.copy()
    for _ in range(ROUNDS):
        # 1. normal equations of the observations, with the priors of heights and attitudes
        blocks = _normal_equations(adjusted_poses, fixed, adjusted_points, seen, bearing)
        _add_heights(blocks, adjusted_points[:, 2], relief_m)
        _add_attitudes(blocks, adjusted_poses[fixed:, 2:5], measured, attitude_std)
        # 2. eliminate the landmarks, whose blocks are independent of each other, and solve for the poses
        inverse = np.asarray(np.linalg.inv(blocks.landmarks), dtype=np.float64)
        crossed = _crossed(blocks.between, inverse)
        reduced = blocks.poses - crossed @ blocks.between.T
        factor = cho_factor(reduced)
        step = cho_solve(factor, blocks.pose_rhs - crossed @ blocks.landmark_rhs.ravel())
        # 3. substitute back for the landmarks
        rest = blocks.landmark_rhs - (blocks.between.T @ step).reshape(-1, 3)
        adjusted_poses[fixed:] += step.reshape(-1, 6)
        adjusted_points += np.einsum("lab,lb->la", inverse, rest)
        if np.abs(step).max() < STILL:
            break
    # 4. marginal covariance of the last pose: the last block of the inverse
    last = cho_solve(factor, np.eye(len(reduced))[:, -6:])[-6:]
    return Adjusted(adjusted_poses, adjusted_points, inverse, blocks.faults, last[np.ix_(PLANAR, PLANAR)])


def _normal_equations(poses: Array, fixed: int, points: Array, seen: Observations, bearing: Bearing) -> _Blocks:
    """Return the normal equations of the observations, with robust weights."""
    # 1. errors of the observations, normalised by their covariances
    count, free = len(points), len(poses) - fixed
    projected = projection_of(points[seen.landmark], Views.of(poses).take(seen.view), bearing)
    error = seen.polar - projected.polar
    information = np.linalg.inv(seen.covariance)
    squared = np.einsum("ni,nij,nj->n", error, information, error)
    # 2. mean squared error of each landmark, whose point takes 3 degrees of freedom of its observations; the median is the
    # usual one
    times = np.bincount(seen.landmark, minlength=count)
    mean = np.bincount(seen.landmark, np.minimum(squared, LARGEST), minlength=count) / np.maximum(times - 1.5, 1) / 2
    usual = max(float(np.median(mean[times > 0])), LEAST_MEDIAN)
    faults = mean / usual
    # 3. weights: outliers and poorly fitting landmarks lose weight, and the usual error scales all covariances
    information *= (cauchy(squared) * track_weight(faults)[seen.landmark] / usual)[:, None, None]
    # 4. blocks of the landmarks
    of_point = projected.by_point.transpose(0, 2, 1) @ information
    landmarks = _summed(of_point @ projected.by_point, seen.landmark, count) + LOOSE * np.eye(3)
    landmark_rhs = _summed((of_point @ error[:, :, None])[:, :, 0], seen.landmark, count)
    # 5. blocks of the free poses, and between them and the landmarks; fixed poses only constrain landmarks
    moves = seen.view >= fixed
    view, landmark = seen.view[moves] - fixed, seen.landmark[moves]
    of_pose = projected.by_pose[moves].transpose(0, 2, 1) @ information[moves]
    pose_blocks = _summed(of_pose @ projected.by_pose[moves], view, free) + LOOSE * np.eye(6)
    pose_rhs = _summed((of_pose @ error[moves][:, :, None])[:, :, 0], view, free)
    between = np.zeros((free, count, 6, 3))
    between[view, landmark] = of_pose @ projected.by_point[moves]
    whole = np.zeros((free, 6, free, 6))
    whole[np.arange(free), :, np.arange(free)] = pose_blocks
    table = between.transpose(0, 2, 1, 3).reshape(6 * free, 3 * count)
    return _Blocks(whole.reshape(6 * free, 6 * free), pose_rhs.ravel(), table, landmarks, landmark_rhs, faults)


def _crossed(between: Array, inverse: Array) -> Array:
    """Multiply the blocks between poses and landmarks by the inverse blocks of the landmarks."""
    rows = between.reshape(len(between), -1, 3)
    return np.asarray(np.einsum("pla,lab->plb", rows, inverse, optimize=True).reshape(between.shape))


def _add_heights(blocks: _Blocks, height: Array, relief_m: float) -> None:
    """Add the prior of the heights ``(l,)`` of landmarks: exponential above the ground and below it.

    Where the observations hardly determine a height, the prior draws it to its mean instead of its mode, which is 0.
    """
    # weight of the exponential, from the variance given the poses; slope / |height| approximates it by a parabola (IRLS)
    variance = np.linalg.inv(blocks.landmarks)[:, 2, 2]
    known = UNKNOWN_M**2 / (UNKNOWN_M**2 + variance)
    law = known * np.where(height > 0, 1 / relief_m, 1 / BELOW_M) / np.maximum(np.abs(height), NEAREST_M)
    mean = (1 - known) / relief_m**2
    blocks.landmarks[:, 2, 2] += law + mean
    blocks.landmark_rhs[:, 2] += mean * (relief_m - height) - law * height


def _add_attitudes(blocks: _Blocks, attitudes: Array, measured: Array, std: Array) -> None:
    """Add the measured heights, pitches and rolls ``(poses, 3)`` as a prior of the poses."""
    information, off = np.zeros(6), np.zeros((len(measured), 6))
    information[2:5], off[:, 2:5] = 1 / std**2, measured - attitudes
    blocks.poses[np.diag_indices(len(blocks.poses))] += np.tile(information, len(measured))
    blocks.pose_rhs[:] += (information * off).ravel()


def _summed(values: Array, group: Index, groups: int) -> Array:
    """Sum the rows of each group ``(groups, ...)``."""
    flat = values.reshape(len(values), -1)
    sums = np.stack([np.bincount(group, column, minlength=groups) for column in flat.T], axis=1)
    return np.asarray(sums.reshape(groups, *values.shape[1:]))
