"""Bundle adjustment: exact observations give the truth back, noisy ones the promised covariance."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mitsonar.geometry.fan import Views, polar_of
from mitsonar.instruments.sonar import Bearing
from mitsonar.mapping.bundle import Adjusted, Observations, adjusted

Array = NDArray[np.float64]

NOISE = np.array([5e-4, 5e-4])
STD = np.array([1e-4, 1e-5, 1e-5])


def path(views: int, step: tuple[float, float] = (0.03, 0.12)) -> Array:
    """Return poses that go forward and aside, turning a little."""
    table = np.zeros((views, 6))
    table[:, 0], table[:, 1] = step[0] * np.arange(views), step[1] * np.arange(views)
    table[:, 2], table[:, 3], table[:, 5] = 2.5, np.radians(35), 0.01 * np.arange(views)
    return table


def ground(count: int = 150, seed: int = 1) -> Array:
    """Return landmarks in view: an exponential relief of 0.2 m."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.8, 1.0, count), rng.uniform(2.5, 5.0, count), rng.exponential(0.2, count)])


def observed(poses: Array, points: Array, bearing: Bearing, noise: float = 0.0, seed: int = 0) -> Observations:
    """Return what all views receive of all points."""
    rng, rows = np.random.default_rng(seed), []
    for pose in poses:
        rows.append(polar_of(points, Views.of(pose), bearing))
    polar = np.concatenate(rows) + noise * NOISE * rng.standard_normal((len(poses) * len(points), 2))
    view, landmark = (axis.ravel() for axis in np.meshgrid(np.arange(len(poses)), np.arange(len(points)), indexing="ij"))
    return Observations(view, landmark, polar, np.tile(np.diag(NOISE**2), (len(view), 1, 1)))


def solved(poses: Array, points: Array, seen: Observations, bearing: Bearing) -> Adjusted:
    """Adjust until nothing moves."""
    for _ in range(6):
        result = adjusted(poses, 1, poses[1:, 2:5], STD, points, seen, bearing, 0.2)
        poses, points = result.poses, result.points
    return result


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_exact_observations_give_the_truth(bearing: Bearing) -> None:
    true, points = path(10), ground()
    rng = np.random.default_rng(2)
    start = true.copy()
    start[1:, [0, 1]] += rng.normal(0, 0.02, (9, 2))
    start[1:, 5] += rng.normal(0, 0.005, 9)
    result = solved(start, points + rng.normal(0, 0.03, points.shape), observed(true, points, bearing), bearing)
    np.testing.assert_allclose(result.poses[:, 0], true[:, 0], atol=1e-3)
    np.testing.assert_allclose(result.poses[:, 5], true[:, 5], atol=5e-4)
    # the law of heights holds the scale, to half a percent where few views tell heights
    assert result.poses[-1, 1] / true[-1, 1] == pytest.approx(1, abs=0.005)
    assert np.median(np.abs(result.points - points)) < 0.02


def test_the_ground_gives_the_scale_that_bearings_and_ranges_leave_open() -> None:
    true, points = path(5, step=(0.0, 0.06)), ground()
    start = true.copy()
    start[:, 1] *= 1.03
    seen = observed(true, points, "cone", noise=1.0)
    result = solved(start, points, seen, "cone")
    assert result.poses[-1, 1] / true[-1, 1] == pytest.approx(1, abs=0.01)


def variance_ratio(grounds: list[Array]) -> Array:
    """Return the variances of x, y and heading of the last pose over the stated ones, with new noise over each ground."""
    true, errors, stated = path(8), [], []
    for seed, points in enumerate(grounds):
        result = solved(true, points, observed(true, points, "cone", 1.0, seed), "cone")
        errors.append((result.poses - true)[-1, [0, 1, 5]])
        stated.append(result.last_covariance)
    return np.asarray(np.var(errors, axis=0) / np.diagonal(np.mean(stated, axis=0)))


@pytest.mark.thorough
def test_covariance_of_the_last_pose_is_that_of_repeated_noise() -> None:
    ratio = variance_ratio([ground(80)] * 30)
    assert ratio.min() > 0.3
    assert ratio.max() < 2.5


@pytest.mark.thorough
def test_covariance_of_the_last_pose_holds_over_other_grounds() -> None:
    # uncertain heights go to the mean of relief: drawn to the ground, they made this 5
    assert variance_ratio([ground(80, seed) for seed in range(60)]).max() < 4


def test_landmarks_that_move_with_a_shadow_do_not_pull() -> None:
    true, points = path(10), ground()
    seen = observed(true, points, "cone", noise=1.0)
    moving = seen.landmark < 30
    seen.polar[moving, 0] += 0.004 * seen.view[moving]
    result, plain = solved(true, points, seen, "cone"), solved(true, points, observed(true, points, "cone", 1.0), "cone")
    assert np.abs((result.poses - plain.poses)[:, :2]).max() < 2e-3, "they are left out"
    assert np.median(result.faults[:30]) > 5 * np.median(result.faults[30:])
