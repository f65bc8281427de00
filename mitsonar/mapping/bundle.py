"""Bundle adjustment: poses and landmarks that explain where the landmarks were received.

Range and bearing of a point do not tell its elevation. Several of them from different places do (Huang and Kaess, 2015).
The landmarks are eliminated first (Schur complement), so that the cost is that of the poses. Landmarks lie on the ground or
above it: their heights have an exponential law, of relief above the ground and of errors below it. It fixes the scale, which
range and bearing alone tell badly.
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
"""Place of x, y and heading in a pose."""

ROUNDS = 3
STILL = 1e-6
"""Gauss-Newton iterations at most, and the step below which they end [m, rad]."""

OUTLYING = 4.0
"""Squared errors, in covariances, of so much have half the weight."""

TRACK = 1.2
"""Landmarks whose mean squared error is so many times the usual one have half the weight: what moves with a shadow."""

HARSH = 3
"""Power by which landmarks that fit worse lose weight: 2 leaves sideways paths over rocks more drift, 4 forward ones."""

BELOW_M = 0.02
"""Mean of the errors of heights below the ground [m]."""

UNKNOWN_M = 0.1
"""Heights that the observations tell no better than this are held to the mean of the law too [m]: its mode is no mean."""

NEAREST_M = 0.01
"""Heights nearer to the ground than this count as so far: the law has a corner there [m]."""

LARGEST = 50.0
"""Squared error above which an observation says no more of its landmark."""

LEAST_MEDIAN = 0.2
"""Least usual error of the observations, in their covariances."""

LOOSE = 1e-6
"""Information that every unknown has [1/m^2, 1/rad^2]."""


class Observations(NamedTuple):
    """Where landmarks were received.

    Attributes:
        view: number of the pose ``(n,)``.
        landmark: number of the landmark ``(n,)``.
        polar: range [m] and bearing [rad] ``(n, 2)``.
        covariance: of these ``(n, 2, 2)``.
    """

    view: Index
    landmark: Index
    polar: Array
    covariance: Array

    def take(self, index: Index | NDArray[np.bool_]) -> Observations:
        """Return some of the observations."""
        return Observations(self.view[index], self.landmark[index], self.polar[index], self.covariance[index])


class Adjusted(NamedTuple):
    """Result of a bundle adjustment.

    Attributes:
        poses: ``(k, 6)`` [m, rad].
        points: of the landmarks ``(l, 3)`` [m].
        point_covariance: ``(l, 3, 3)``, given the poses.
        faults: mean squared error of each landmark, in those of the usual one ``(l,)``.
        last_covariance: of x, y [m] and heading [rad] of the last pose, given those held ``(3, 3)``.
    """

    poses: Array
    points: Array
    point_covariance: Array
    faults: Array
    last_covariance: Array


class _Blocks(NamedTuple):
    """The normal equations: of poses, of landmarks, and between them."""

    poses: Array
    pull: Array
    between: Array
    landmarks: Array
    landmark_pull: Array
    faults: Array


def cauchy(squared: Array) -> Array:
    """Return the weights of observations with these squared errors, in covariances."""
    return np.asarray(1 / (1 + squared / OUTLYING))


def track_weight(faults: Array) -> Array:
    """Return the weights of landmarks with these mean squared errors, in those of the usual one."""
    return np.asarray(1 / (1 + (faults / TRACK) ** HARSH))


def adjusted(
    poses: Array,
    held: int,
    told: Array,
    attitude_std: Array,
    points: Array,
    seen: Observations,
    bearing: Bearing,
    relief_m: float,
) -> Adjusted:
    """Adjust poses and landmarks.

    Args:
        poses: ``(k, 6)`` [m, rad].
        held: so many poses from the first stay as they are.
        told: heights [m], pitches and rolls [rad] of the others, as sensors tell them ``(k - held, 3)``.
        attitude_std: standard deviations of these heights [m], pitches and rolls [rad] ``(3,)``.
        points: of the landmarks ``(l, 3)``, in metres over the ground.
        seen: observations of them.
        bearing: kind of the bearings.
        relief_m: mean height of what is seen over the ground.

    Raises:
        LinAlgError: observations that do not suffice.
    """
    found, place = poses.copy(), points.copy()
    for _ in range(ROUNDS):
        blocks = _normal_equations(found, held, place, seen, bearing)
        _add_heights(blocks, place[:, 2], relief_m)
        _add_attitudes(blocks, found[held:, 2:5], told, attitude_std)
        inverse = np.asarray(np.linalg.inv(blocks.landmarks), dtype=np.float64)
        crossed = _crossed(blocks.between, inverse)
        reduced = blocks.poses - crossed @ blocks.between.T
        factor = cho_factor(reduced)
        step = cho_solve(factor, blocks.pull - crossed @ blocks.landmark_pull.ravel())
        rest = blocks.landmark_pull - (blocks.between.T @ step).reshape(-1, 3)
        found[held:] += step.reshape(-1, 6)
        place += np.einsum("lab,lb->la", inverse, rest)
        if np.abs(step).max() < STILL:
            break
    last = cho_solve(factor, np.eye(len(reduced))[:, -6:])[-6:]
    return Adjusted(found, place, inverse, blocks.faults, last[np.ix_(PLANAR, PLANAR)])


def _normal_equations(poses: Array, held: int, points: Array, seen: Observations, bearing: Bearing) -> _Blocks:
    """Sum the observations, with weights that outliers lose."""
    count, free = len(points), len(poses) - held
    projected = projection_of(points[seen.landmark], Views.of(poses).take(seen.view), bearing)
    error = seen.polar - projected.polar
    information = np.linalg.inv(seen.covariance)
    squared = np.einsum("ni,nij,nj->n", error, information, error)
    times = np.bincount(seen.landmark, minlength=count)
    mean = np.bincount(seen.landmark, np.minimum(squared, LARGEST), minlength=count) / np.maximum(times - 1.5, 1) / 2
    usual = max(float(np.median(mean[times > 0])), LEAST_MEDIAN)
    faults = mean / usual
    information *= (cauchy(squared) * track_weight(faults)[seen.landmark] / usual)[:, None, None]
    of_point = projected.by_point.transpose(0, 2, 1) @ information
    landmarks = _summed(of_point @ projected.by_point, seen.landmark, count) + LOOSE * np.eye(3)
    landmark_pull = _summed((of_point @ error[:, :, None])[:, :, 0], seen.landmark, count)
    moves = seen.view >= held
    view, landmark = seen.view[moves] - held, seen.landmark[moves]
    of_pose = projected.by_pose[moves].transpose(0, 2, 1) @ information[moves]
    own = _summed(of_pose @ projected.by_pose[moves], view, free) + LOOSE * np.eye(6)
    pull = _summed((of_pose @ error[moves][:, :, None])[:, :, 0], view, free)
    between = np.zeros((free, count, 6, 3))
    between[view, landmark] = of_pose @ projected.by_point[moves]
    whole = np.zeros((free, 6, free, 6))
    whole[np.arange(free), :, np.arange(free)] = own
    table = between.transpose(0, 2, 1, 3).reshape(6 * free, 3 * count)
    return _Blocks(whole.reshape(6 * free, 6 * free), pull.ravel(), table, landmarks, landmark_pull, faults)


def _crossed(between: Array, inverse: Array) -> Array:
    """Multiply the blocks between poses and landmarks with the inverse of the landmarks' own."""
    rows = between.reshape(len(between), -1, 3)
    return np.asarray(np.einsum("pla,lab->plb", rows, inverse, optimize=True).reshape(between.shape))


def _add_heights(blocks: _Blocks, height: Array, relief_m: float) -> None:
    """Hold the heights ``(l,)`` of landmarks to their law: exponential above the ground, and below it."""
    variance = np.linalg.inv(blocks.landmarks)[:, 2, 2]
    known = UNKNOWN_M**2 / (UNKNOWN_M**2 + variance)
    law = known * np.where(height > 0, 1 / relief_m, 1 / BELOW_M) / np.maximum(np.abs(height), NEAREST_M)
    mean = (1 - known) / relief_m**2
    blocks.landmarks[:, 2, 2] += law + mean
    blocks.landmark_pull[:, 2] += mean * (relief_m - height) - law * height


def _add_attitudes(blocks: _Blocks, attitudes: Array, told: Array, std: Array) -> None:
    """Hold heights, pitches and rolls ``(poses, 3)`` to what sensors tell."""
    information, off = np.zeros(6), np.zeros((len(told), 6))
    information[2:5], off[:, 2:5] = 1 / std**2, told - attitudes
    blocks.poses[np.diag_indices(len(blocks.poses))] += np.tile(information, len(told))
    blocks.pull[:] += (information * off).ravel()


def _summed(values: Array, group: Index, groups: int) -> Array:
    """Sum rows of equal group ``(groups, ...)``."""
    flat = values.reshape(len(values), -1)
    sums = np.stack([np.bincount(group, column, minlength=groups) for column in flat.T], axis=1)
    return np.asarray(sums.reshape(groups, *values.shape[1:]))
