"""Motions become a path: eq. 3.4, scale factors, splines, Kalman filter with RTS smoother, covariance of the pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.optimize import minimize_scalar
from scipy.stats import chi2, multivariate_normal

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.mapping.series import (
    MotionSeries,
    bridged,
    ellipse,
    fit_noise,
    fit_scale,
    fit_wander,
    kalman_smoothed,
    path_of,
    pose_covariances,
    scaled,
    spline_period,
    spline_smoothed,
)
from mitsonar.motion.composition import Motion, compose, motions
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory

Array = NDArray[np.float64]
Smoother = Callable[[MotionSeries], MotionSeries]

START = Pose(3.0, -2.0, 2.5, np.radians(35), 0.02, 3.0)
STD = np.array([1.3e-3, 0.8e-3, 5e-4])
"""Errors of a good estimator at high noise [m, m, rad]."""


def uneven_times(frames: int, seed: int = 1) -> Array:
    """About 21 frames a second, with hitches."""
    return np.cumsum(np.random.default_rng(seed).uniform(0.03, 0.08, frames))


def random_covariances(count: int, seed: int = 2) -> Array:
    """Full 3 x 3 covariances of different sizes, correlated."""
    rng = np.random.default_rng(seed)
    root = (np.eye(3) + 0.5 * rng.normal(size=(count, 3, 3))) * STD[:, None] * rng.uniform(0.5, 2, (count, 1, 1))
    return np.asarray(root @ root.swapaxes(1, 2))


def drawn(covariances: Array, rng: np.random.Generator) -> Array:
    """One error for each covariance."""
    return (np.linalg.cholesky(covariances) @ rng.normal(size=(*covariances.shape[:-1], 1)))[..., 0]


def swaying(frames: int, seed: int = 3) -> tuple[Array, MotionSeries]:
    """Motions of a vehicle that sways slowly, and measurements of them at uneven times."""
    time = uneven_times(frames, seed)
    covariances = random_covariances(frames - 1, seed)
    middle, step = (time[1:] + time[:-1]) / 2, np.diff(time)[:, None]
    velocity = np.column_stack([0.2 * np.sin(middle), 0.3 + 0.1 * np.cos(0.7 * middle), 0.1 * np.sin(0.5 * middle)])
    noise = drawn(covariances, np.random.default_rng(seed))
    return velocity * step, MotionSeries(velocity * step + noise, time, covariances)


# ---------------------------------------------------------------- composition


@pytest.mark.parametrize("count", [1, 2, 500])
def test_a_path_composes_its_motions(count: int) -> None:
    driven = np.random.default_rng(0).uniform(-1, 1, (count, 3)) * [0.5, 0.5, 3.0]
    time = uneven_times(count + 1)
    path = path_of(driven, START, time)
    poses = [START]
    for motion in driven:
        poses.append(compose(poses[-1], Motion(*motion)))
    np.testing.assert_allclose(path.poses, poses, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(path.time_s, time)
    np.testing.assert_allclose(motions(path.poses), driven, rtol=0, atol=1e-12)


def test_constant_motions_drive_a_circle_that_closes() -> None:
    """Chords d at turns of 2 pi / n: a polygon in a circle of radius d / (2 sin(pi / n)), driven clockwise."""
    n, d = 360, 0.05
    path = path_of(np.tile([0, d, 2 * np.pi / n], (n, 1)), Pose(1, 2, 3), np.arange(n + 1) / 21)
    np.testing.assert_allclose(path.poses[-1], [1, 2, 3, 0, 0, 2 * np.pi], atol=1e-12)
    assert path.poses[n // 4, 0] > 1  # to starboard
    radius = np.linalg.norm(path.poses[:-1, :2] - path.poses[:-1, :2].mean(axis=0), axis=1)
    np.testing.assert_allclose(radius, d / (2 * np.sin(np.pi / n)), rtol=1e-12)


def test_a_pitched_path_goes_through_a_tum_file(tmp_path: Path) -> None:
    driven, _ = swaying(50)
    start = START._replace(roll=0.0)
    path = path_of(driven, start, uneven_times(50))
    path.save_tum(tmp_path / "path.tum")
    back = Trajectory.load_tum(tmp_path / "path.tum")
    np.testing.assert_allclose(motions(back.poses), driven, atol=2e-8)
    np.testing.assert_allclose(back.poses[:, 2:5], np.tile([2.5, np.radians(35), 0], (50, 1)), atol=1e-8)


@pytest.mark.parametrize(
    ("driven", "time", "message"),
    [
        (np.zeros((0, 3)), [0.0], "two frames or more: got 1"),
        (np.zeros((2, 3)), [0.0, 1.0], r"\(1, 3\) for 2 frame times: got \(2, 3\)"),
        (np.zeros((2, 2)), [0.0, 1.0, 2.0], r"\(2, 3\) for 3 frame times: got \(2, 2\)"),
        ([[0, 0, 0], [0, np.nan, 0]], [0.0, 1.0, 2.0], "from frame 1 to 2 is not finite"),
        (np.zeros((2, 3)), [0.0, 1.0, 1.0], "increase"),
        (np.zeros((2, 3)), [0.0, np.nan, 1.0], "finite"),
    ],
)
def test_motions_that_are_no_path(driven: Array, time: Array, message: str) -> None:
    with pytest.raises(MitsonarError, match=message):
        path_of(driven, START, time)


# ---------------------------------------------------------------- series


def test_a_series_of_estimates() -> None:
    good = Estimate(Motion(1, 2, 3), np.eye(3))
    none = Estimate(Motion(0, 0, 0), valid=False)
    series = MotionSeries.from_estimates([good, none, good], np.arange(4.0))
    assert series.is_valid.tolist() == [True, False, True]
    assert series.covariances is not None
    np.testing.assert_array_equal(series.covariances[2], np.eye(3))
    assert MotionSeries.from_estimates([good, Estimate(Motion(0, 0, 0))], np.arange(3.0)).covariances is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"covariances": np.zeros((3, 3))}, r"covariances must be \(9, 3, 3\)"),
        ({"covariances": np.full((9, 3, 3), np.nan)}, "frame 0 to 1 has a covariance that is not finite .9 of 9"),
        ({"covariances": np.tile(np.diag([1, 1, -1e-6]), (9, 1, 1))}, "negative variance"),
        ({"covariances": np.tile([[1, 0.5, 0], [0, 1, 0], [0, 0, 1]], (9, 1, 1))}, "asymmetric"),
        ({"valid": np.zeros(9, dtype=bool)}, "none of 9 motions is valid"),
        ({"valid": np.ones(8, dtype=bool)}, r"valid must be \(9,\)"),
        ({"with_next": np.zeros((9, 3, 3))}, r"with_next must be \(8, 3, 3\)"),
    ],
)
def test_a_series_refuses_what_it_cannot_mean(change: dict[str, Any], message: str) -> None:
    with pytest.raises(MitsonarError, match=message):
        replace(swaying(10)[1], **change)


# ---------------------------------------------------------------- scale


def test_scale_factors_are_found_again() -> None:
    true, measured = swaying(200)
    np.testing.assert_allclose(fit_scale(true / [2.3, 4.0, 1.1], true), [2.3, 4.0, 1.1], rtol=1e-12)
    factors = fit_scale(measured.motions, true)
    rest = true - measured.motions * factors
    np.testing.assert_allclose((rest * measured.motions).sum(axis=0), 0, atol=1e-12)  # nothing more to gain
    assert fit_scale([[0, 1, 1]], [[5, 2, 3]]).tolist() == [1, 2, 3]


def test_covariances_are_scaled_with_the_motions() -> None:
    measured = kalman_smoothed(swaying(20)[1])
    factors = np.array([2.3, -1.0, 0.5])
    larger = scaled(measured, factors)
    np.testing.assert_allclose(larger.motions, measured.motions * factors)
    for got, before in ((larger.covariances, measured.covariances), (larger.with_next, measured.with_next)):
        assert got is not None
        assert before is not None
        np.testing.assert_allclose(got, np.diag(factors) @ before @ np.diag(factors), rtol=1e-14)


def test_scale_factors_that_cannot_be() -> None:
    measured = swaying(5)[1]
    with pytest.raises(MitsonarError, match="three finite numbers"):
        scaled(measured, [1, 2])
    with pytest.raises(MitsonarError, match="three finite numbers"):
        scaled(measured, [1, 2, np.nan])
    with pytest.raises(MitsonarError, match=r"true and estimated motions .* got \(4, 3\) and \(3, 3\)"):
        fit_scale(measured.motions, np.zeros((3, 3)))


# ---------------------------------------------------------------- splines


def test_the_period_is_halved() -> None:
    frames = 2000
    time = np.arange(frames) / 20
    middle = (time[1:] + time[:-1]) / 2
    for period, stored in ((2.0, 1 / 2), (4.0, 1 / (1 + 2.0**-4)), (1.0, 1 / (1 + 2.0**4))):
        swing = np.sin(2 * np.pi * middle / period)
        smooth = spline_smoothed(MotionSeries(np.column_stack([swing] * 3) / 20, time), 2.0).motions * 20
        inside = slice(400, -400)
        np.testing.assert_allclose(smooth[inside, 1] @ swing[inside] / (swing[inside] @ swing[inside]), stored, rtol=2e-3)


@pytest.mark.thorough
def test_the_period_minimises_generalised_cross_validation() -> None:
    """Against the definition: the hat matrix of SciPy's spline, column by column."""
    _, measured = swaying(40)
    measured = replace(measured, valid=np.random.default_rng(0).random(39) > 0.2)
    at = measured.is_valid
    assert measured.covariances is not None
    middle, variance = measured.middle_s[at], np.diagonal(measured.covariances, axis1=1, axis2=2)[at]
    n, gap = at.sum(), (middle[-1] - middle[0]) / (at.sum() - 1)
    chosen = spline_period(measured)
    for axis in range(3):
        weight = measured.step_s[at] ** 2 / variance[:, axis]
        values = measured.velocity[at, axis]

        def score(log_period: float, w: Array = weight, y: Array = values) -> float:
            strength = (np.exp(log_period) / (2 * np.pi)) ** 4 * w.mean() / gap
            hat = np.column_stack([make_smoothing_spline(middle, unit, w=w, lam=strength)(middle) for unit in np.eye(n)])
            return float(n * (w * (y - hat @ y) ** 2).sum() / (n - np.trace(hat)) ** 2)

        best = np.log(chosen[axis])
        result = minimize_scalar(score, bounds=(best - 0.5, best + 0.5), method="bounded", options={"xatol": 1e-3})
        assert abs(result.x - best) < 3e-3, f"period {np.exp(result.x):.4f} s, chosen {chosen[axis]:.4f} s"


def test_the_period_is_in_seconds() -> None:
    """The same motions ten times slower have ten times the period; units of length do not matter."""
    _, measured = swaying(120)
    slower = replace(measured, time_s=measured.time_s * 10)
    np.testing.assert_allclose(spline_period(slower), 10 * spline_period(measured), rtol=1e-9)
    np.testing.assert_allclose(spline_period(scaled(measured, [1e3, 1e-3, 7])), spline_period(measured), rtol=1e-6)


@pytest.mark.parametrize("smooth", [spline_smoothed, kalman_smoothed])
@pytest.mark.parametrize("known", [True, False])
def test_smoothing_comes_nearer_to_smooth_motions(smooth: Smoother, known: bool) -> None:
    true, measured = swaying(300)
    measured = measured if known else replace(measured, covariances=None)
    before, after = (np.sqrt(np.mean((s.motions - true) ** 2, axis=0)) for s in (measured, smooth(measured)))
    assert (after < before / 2).all(), f"RMSE {after} after {before}"


@pytest.mark.parametrize("smooth", [spline_smoothed, kalman_smoothed])
def test_estimates_that_are_not_believed_are_bridged(smooth: Smoother) -> None:
    """Whatever they say; between, the velocity goes on smoothly; before the first and after the last it stays."""
    true, measured = swaying(200)
    valid = np.ones(199, dtype=bool)
    valid[:4] = valid[60:70] = valid[-3:] = False
    wild = np.where(valid[:, None], measured.motions, np.nan)
    one = smooth(replace(measured, valid=valid))
    second = smooth(replace(measured, motions=wild, valid=valid))
    np.testing.assert_array_equal(one.motions, second.motions)
    np.testing.assert_allclose(one.motions[60:70], true[60:70], atol=6 * STD.max())
    velocity = one.velocity
    np.testing.assert_allclose(velocity[:4], np.tile(velocity[4], (4, 1)), rtol=1e-9)
    np.testing.assert_allclose(velocity[-3:], np.tile(velocity[-4], (3, 1)), rtol=1e-9)


def test_few_motions_are_joined_by_straight_lines() -> None:
    time = np.array([0.0, 1, 3, 4, 5, 7])
    driven = np.array([[1.0, 0, 2]] * 5) * np.diff(time)[:, None] * [[1], [9], [9], [9], [3]]
    series = MotionSeries(driven, time, valid=np.array([True, False, False, False, True]))
    # velocities 1 at 0.5 s and 3 at 6 s
    expected = np.interp(series.middle_s, [0.5, 6], [1, 3])[:, None] * [1, 0, 2] * series.step_s[:, None]
    np.testing.assert_allclose(spline_smoothed(series).motions, expected, atol=1e-14)
    with pytest.raises(MitsonarError, match="needs 5 valid motions: got 2"):
        spline_period(series)


def test_one_motion_stays_as_it_is() -> None:
    single = MotionSeries(np.array([[0.01, 0.02, 0.003]]), np.array([1.0, 1.05]), random_covariances(1))
    for smooth in (spline_smoothed, kalman_smoothed):
        np.testing.assert_allclose(smooth(single).motions, single.motions, rtol=1e-12)
    smoothed = kalman_smoothed(single).covariances
    assert smoothed is not None
    assert single.covariances is not None
    np.testing.assert_allclose(smoothed, single.covariances, rtol=1e-9)


def test_smoothing_needs_errors_above_zero() -> None:
    exact = replace(swaying(10)[1], covariances=np.tile(np.diag([1e-6, 0, 1e-6]), (9, 1, 1)))
    for smooth in (spline_smoothed, kalman_smoothed):
        with pytest.raises(MitsonarError, match="variances above zero: got 0 for forward"):
            smooth(exact)
    with pytest.raises(MitsonarError, match="period_s must be a positive number"):
        spline_smoothed(swaying(10)[1], 0.0)


# ---------------------------------------------------------------- Kalman filter


def least_squares(measured: MotionSeries, wander: Array) -> tuple[Array, Array]:
    """The Gaussian model solved at once: all velocities ``(n, 3)`` and their covariance ``(3 n, 3 n)``."""
    n = len(measured)
    rows, right = [], []
    assert measured.covariances is not None
    for k in np.flatnonzero(measured.is_valid).tolist():
        root = np.linalg.inv(np.linalg.cholesky(measured.covariances[k]))
        row = np.zeros((3, n, 3))
        row[:, k] = root * measured.step_s[k]
        rows.append(row)
        right.append(root @ measured.motions[k])
    middle = (measured.time_s[1:] + measured.time_s[:-1]) / 2
    for k in range(n - 1):
        row = np.zeros((3, n, 3))
        row[:, k + 1] = np.diag(1 / (wander * np.sqrt(middle[k + 1] - middle[k])))
        row[:, k] = -row[:, k + 1]
        rows.append(row)
        right.append(np.zeros(3))
    matrix = np.concatenate(rows).reshape(-1, 3 * n)
    solution = np.linalg.lstsq(matrix, np.concatenate(right))[0]
    return np.asarray(solution.reshape(n, 3), dtype=float), np.asarray(np.linalg.inv(matrix.T @ matrix), dtype=float)


WANDER = np.array([0.05, 0.08, 0.02])


@pytest.mark.parametrize("frames", [3, 40])
@pytest.mark.parametrize("gaps", [False, True])
def test_the_smoother_is_the_least_squares_solution(frames: int, gaps: bool) -> None:
    """Two routes: filter and smoother against one dense solve, with full covariances, uneven times and gaps."""
    _, measured = swaying(frames)
    n = frames - 1
    valid = np.ones(n, dtype=bool)
    if gaps:
        valid[0] = False
        valid[n // 2 : n // 2 + n // 4] = False
        valid[-1] = n < 3
    measured = replace(measured, valid=valid)
    smooth = kalman_smoothed(measured, WANDER)
    velocity, covariance = least_squares(measured, WANDER)
    blocks = covariance.reshape(n, 3, n, 3)
    step = measured.step_s
    assert smooth.covariances is not None
    assert smooth.with_next is not None
    np.testing.assert_allclose(smooth.motions, velocity * step[:, None], rtol=0, atol=1e-11)
    for k in range(n):
        np.testing.assert_allclose(smooth.covariances[k], blocks[k, :, k] * step[k] ** 2, rtol=1e-7, atol=1e-16)
        if k < n - 1:
            expected = blocks[k, :, k + 1] * step[k] * step[k + 1]
            np.testing.assert_allclose(smooth.with_next[k], expected, rtol=1e-7, atol=1e-16)


def test_smoothed_covariances_are_symmetric_and_positive() -> None:
    """Also over many frames with errors that differ a million times."""
    frames = 500
    covariances = random_covariances(frames - 1) * 10.0 ** np.random.default_rng(5).uniform(-6, 6, (frames - 1, 1, 1))
    measured = replace(swaying(frames)[1], covariances=covariances)
    for wander in (WANDER, 1e-6 * WANDER, 1e4 * WANDER):
        smooth = kalman_smoothed(measured, wander).covariances
        assert smooth is not None
        np.testing.assert_array_equal(smooth, smooth.swapaxes(1, 2))
        assert np.linalg.eigvalsh(smooth).min() > 0
        # knowing more never makes less certain
        assert np.linalg.eigvalsh(covariances - smooth)[:, 0].min() > -1e-9 * covariances.max()


def walking(frames: int, rng: np.random.Generator) -> tuple[Array, MotionSeries]:
    """Motions drawn from the filter's own model, and measurements of them."""
    time = uneven_times(frames)
    covariances = random_covariances(frames - 1)
    middle = (time[1:] + time[:-1]) / 2
    steps = rng.normal(size=(frames - 2, 3)) * WANDER * np.sqrt(np.diff(middle))[:, None]
    velocity = np.cumsum(np.vstack([rng.normal(size=3) * [0.2, 0.3, 0.05], steps]), axis=0)
    true = velocity * np.diff(time)[:, None]
    return true, MotionSeries(true + drawn(covariances, rng), time, covariances)


def test_errors_are_as_large_as_the_covariances_say() -> None:
    """Normalised squared errors of single motions and of the path's end follow chi-square, with gaps, 0.1 % two-sided."""
    rng, runs, frames = np.random.default_rng(6), 80, 31
    middle, end, careless = 0.0, 0.0, 0.0
    for _ in range(runs):
        true, measured = walking(frames, rng)
        valid = np.ones(frames - 1, dtype=bool)
        valid[10:16] = False
        smooth = kalman_smoothed(replace(measured, valid=valid), WANDER)
        miss = smooth.motions[13] - true[13]
        assert smooth.covariances is not None
        middle += float(miss @ np.linalg.solve(smooth.covariances[13], miss))
        start = Pose(0, 0, 2)
        pose, expected = (path_of(m, start, measured.time_s).poses[-1, [0, 1, 5]] for m in (smooth.motions, true))
        miss = pose - expected
        end += float(miss @ np.linalg.solve(pose_covariances(smooth, start)[-1], miss))
        careless += float(miss @ np.linalg.solve(pose_covariances(replace(smooth, with_next=None), start)[-1], miss))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * runs) / runs
    assert low < middle / runs < high, f"{middle / runs:.2f} not in {low:.2f}..{high:.2f}"
    assert low < end / runs < high, f"{end / runs:.2f} not in {low:.2f}..{high:.2f}"
    assert careless / runs > 2 * high  # smoothed errors taken as independent: far too sure


def test_wander_has_the_greatest_likelihood() -> None:
    """Against the law of the measurements' differences, which no first velocity enters."""
    _, measured = walking(80, np.random.default_rng(7))
    valid = np.ones(79, dtype=bool)
    valid[20:30] = False
    measured = replace(measured, valid=valid)
    got = fit_wander(measured)
    assert measured.covariances is not None
    gap, n = np.diff(measured.middle_s[valid]), valid.sum()
    difference = np.diff(np.eye(n), axis=0)
    for axis in range(3):
        noise = measured.covariances[valid, axis, axis] / measured.step_s[valid] ** 2
        seen = difference @ measured.velocity[valid, axis]

        def unlikely(log_wander: float, noise: Array = noise, seen: Array = seen) -> float:
            law = difference @ np.diag(noise) @ difference.T + np.exp(2 * log_wander) * np.diag(gap)
            return -float(multivariate_normal.logpdf(seen, cov=law))

        result = minimize_scalar(unlikely, bounds=(np.log(1e-3), np.log(1.0)), method="bounded", options={"xatol": 1e-6})
        assert abs(result.x - np.log(got[axis])) < 2e-3, f"{np.exp(result.x)} and {got[axis]}"


def test_wander_and_noise_are_found_again() -> None:
    """Within 15 %: 1500 motions tell a standard deviation to some 4 %."""
    true, measured = walking(1501, np.random.default_rng(8))
    np.testing.assert_allclose(fit_wander(measured), WANDER, rtol=0.15)
    noisy = true + np.random.default_rng(9).normal(size=true.shape) * STD
    unknown = replace(measured, motions=noisy, covariances=None)
    np.testing.assert_allclose(fit_noise(unknown), STD, rtol=0.15)
    smooth = kalman_smoothed(unknown)
    assert smooth.covariances is not None
    assert (np.sqrt(np.mean((smooth.motions - true) ** 2, axis=0)) < 0.8 * STD).all()


def test_constant_velocity_is_told_from_noise() -> None:
    """Where nothing wanders, the smoother averages: the error falls with the root of the number of motions."""
    rng, frames = np.random.default_rng(10), 401
    measured = MotionSeries(
        0.01 + rng.normal(size=(frames - 1, 3)) * STD, np.arange(frames) / 21, np.tile(np.diag(STD**2), (frames - 1, 1, 1))
    )
    smooth = kalman_smoothed(measured)
    miss = np.sqrt(np.mean((smooth.motions - 0.01) ** 2, axis=0)) / STD
    assert (miss < 5 / np.sqrt(frames)).all(), miss


def test_what_the_filter_cannot_work_with() -> None:
    _, measured = swaying(10)
    lonely = replace(measured, valid=np.arange(9) == 4)
    with pytest.raises(MitsonarError, match="shows no change of velocity: give wander"):
        kalman_smoothed(lonely)
    np.testing.assert_allclose(kalman_smoothed(lonely, WANDER).velocity, np.tile(measured.velocity[4], (9, 1)), rtol=1e-9)
    with pytest.raises(MitsonarError, match="wander must be three positive numbers"):
        kalman_smoothed(measured, [0, 1, 1])
    with pytest.raises(MitsonarError, match="five of them or more: got 4"):
        kalman_smoothed(MotionSeries(measured.motions[:4], measured.time_s[:5]))
    still = MotionSeries(measured.motions * [1, 0, 1], measured.time_s)
    with pytest.raises(MitsonarError, match="forward is the same in all motions"):
        kalman_smoothed(still)
    with pytest.raises(MitsonarError, match="fit_wander needs the motions' covariances"):
        fit_wander(still)


# ---------------------------------------------------------------- covariance of the pose


def test_a_straight_path_strays_as_the_closed_form_says() -> None:
    """Errors of the yaw make the end stray by d s sqrt(n (n + 1) (2 n + 1) / 6), of the way by s sqrt(n)."""
    n, d, s = 50, 0.1, 1e-3
    series = MotionSeries(np.tile([0, d, 0], (n, 1)), np.arange(n + 1.0), np.tile(np.diag([0, 4e-6, s * s]), (n, 1, 1)))
    end = pose_covariances(series, Pose(0, 0, 2))[-1]
    strayed = d * s * np.sqrt(n * (n + 1) * (2 * n + 1) / 6)
    np.testing.assert_allclose(np.sqrt(np.diag(end)), [strayed, 2e-3 * np.sqrt(n), s * np.sqrt(n)], rtol=1e-12)
    drift = ellipse(end, 0.95)
    np.testing.assert_allclose(drift[:2], np.sqrt(chi2.ppf(0.95, 2)) * np.sqrt([end[0, 0], end[1, 1]]), rtol=1e-12)
    np.testing.assert_allclose(drift.heading, np.pi / 2, atol=1e-12)  # athwart the path


def test_the_ellipse_holds_its_share() -> None:
    covariance = np.array([[2.0, 1.2], [1.2, 1.0]])
    long, short, heading = ellipse(covariance, 0.8)
    points = np.random.default_rng(11).multivariate_normal([0, 0], covariance, 20000)
    along = points @ [np.sin(heading), np.cos(heading)]
    athwart = points @ [np.cos(heading), -np.sin(heading)]
    inside = np.mean((along / long) ** 2 + (athwart / short) ** 2 < 1)
    assert abs(inside - 0.8) < 4 * np.sqrt(0.16 / 20000)
    assert 0 < heading < np.pi / 2  # to the north-east
    with pytest.raises(MitsonarError, match="probability must be between 0 and 1: got 95"):
        ellipse(covariance, 95)


@pytest.mark.thorough
@pytest.mark.parametrize("smoothed", [False, True])
def test_pose_covariance_against_monte_carlo(smoothed: bool) -> None:
    """Independent errors, and the correlated ones of the smoother drawn from the dense solution."""
    rng, frames, draws = np.random.default_rng(12), 40, 4000
    _, measured = swaying(frames)
    measured = replace(measured, motions=measured.motions + np.array([0, 0, 0.04]))  # a curved path
    at_start = np.diag([1e-6, 4e-6, 1e-6])
    if smoothed:
        valid = np.ones(frames - 1, dtype=bool)
        valid[12:20] = False
        measured = replace(measured, valid=valid)
        _, joint = least_squares(measured, WANDER)
        each = np.repeat(measured.step_s, 3)
        series = kalman_smoothed(measured, WANDER)
        errors = (rng.normal(size=(draws, len(joint))) @ np.linalg.cholesky(joint).T * each).reshape(draws, -1, 3)
    else:
        series = measured
        assert measured.covariances is not None
        errors = drawn(np.tile(measured.covariances, (draws, 1, 1, 1)), rng)
    starts = rng.normal(size=(draws, 3)) * np.sqrt(np.diag(at_start))
    ends = [
        path_of(series.motions + error, START._replace(x=x, y=y, heading=3 + turn), series.time_s).poses[-1, [0, 1, 5]]
        for error, (x, y, turn) in zip(errors, starts, strict=True)
    ]
    message = pose_covariances(series, START._replace(x=0, y=0), at_start)
    np.testing.assert_array_equal(message[0], at_start)
    whiten = np.linalg.inv(np.linalg.cholesky(message[-1]))
    np.testing.assert_allclose(whiten @ np.cov(np.transpose(ends)) @ whiten.T, np.eye(3), atol=5 * np.sqrt(2 / draws))


def test_pose_covariance_of_smoothed_motions_is_exact() -> None:
    """To first order: the dense covariance of all motions carried by numeric derivatives of the path's end."""
    _, measured = swaying(30)
    measured = replace(measured, motions=measured.motions + np.array([0, 0, 0.05]), valid=np.arange(29) // 5 != 3)
    smooth = kalman_smoothed(measured, WANDER)
    _, joint = least_squares(measured, WANDER)
    each, nudge = np.repeat(measured.step_s, 3), 1e-5

    def end(change: Array) -> Array:
        return path_of(smooth.motions + change.reshape(-1, 3), START, measured.time_s).poses[-1, [0, 1, 5]]

    carried = np.column_stack([end(one) - end(-one) for one in nudge * np.eye(each.size)]) / (2 * nudge) * each
    np.testing.assert_allclose(pose_covariances(smooth, START)[-1], carried @ joint @ carried.T, rtol=1e-6, atol=1e-15)


def test_what_has_no_pose_covariance() -> None:
    _, measured = swaying(10)
    with pytest.raises(MitsonarError, match="needs those of the motions"):
        pose_covariances(replace(measured, covariances=None), START)
    with pytest.raises(MitsonarError, match="2 motions are not valid"):
        pose_covariances(replace(measured, valid=np.arange(9) > 1), START)


def test_one_valid_motion_bridges_with_its_own_size_as_error() -> None:
    moved = np.array([[np.nan] * 3, [0.01, 0.05, 0.02], [np.nan] * 3])
    covariances = np.tile(np.diag(STD**2), (3, 1, 1))
    filled = bridged(MotionSeries(moved, np.arange(4.0), covariances, np.array([False, True, False])))
    np.testing.assert_allclose(filled.motions, np.tile(moved[1], (3, 1)))
    assert filled.covariances is not None
    np.testing.assert_array_equal(filled.covariances[1], covariances[1])
    np.testing.assert_allclose(filled.covariances[0], np.diag(STD**2 + moved[1] ** 2))
