"""Errors of motions: closed forms, and intervals that hold what they promise."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.motion.errors import cluster_resamples, in_units, motion_errors


def test_errors_of_a_method_that_shrinks_and_leans() -> None:
    """0.9 times the truth plus 1 mm: slope, bias and RMSE are known."""
    rng = np.random.default_rng(1)
    truth = rng.uniform(-1, 1, (4000, 3)) * [0.02, 0.02, 0.008]
    truth -= truth.mean(axis=0)
    result = motion_errors(0.9 * truth + [1e-3, 0, 0], truth, np.ones(4000, dtype=bool))
    spread = in_units(truth).std(axis=0)
    assert np.allclose(result.slope, 0.9, atol=2e-3)
    assert np.allclose(result.bias, [1, 0, 0], atol=1e-9)
    assert np.allclose(result.rmse, np.hypot(0.1 * spread, [1, 0, 0]))
    assert np.allclose(result.zero, spread)
    assert np.allclose(result.skill, 1 - result.rmse / spread)
    assert (result.large > result.rmse)[1:].all()
    assert np.isnan(result.nees)


def test_percentiles_and_large_motions() -> None:
    """Errors of 0 to 100 mm; and 1 mm for motions beyond half the largest only."""
    truth = np.zeros((101, 3))
    result = motion_errors(np.arange(101)[:, None] * np.full(3, 1e-3), truth, np.ones(101, bool))
    assert np.allclose(result.median[:2], 50)
    assert np.allclose(result.p95[:2], 95)
    assert np.isnan(result.large).all(), "there is no large motion"
    truth = np.linspace(-0.02, 0.02, 41)[:, None] * np.ones(3)
    large = np.abs(truth) > 0.01 + 1e-9
    assert np.allclose(motion_errors(truth + 1e-3 * large, truth, np.ones(41, bool)).large[:2], 1)


def test_failures_count_as_zero_motion() -> None:
    truth = np.full((4, 3), 0.01)
    wild = np.where(np.arange(4)[:, None] == 2, 5.0, truth)
    valid = np.arange(4) != 2
    result = motion_errors(wild, truth, valid)
    assert result.failures == 1
    assert np.allclose(result.rmse[:2], 10 / 2)  # one of four is off by 10 mm
    assert np.allclose(result.believed, 0)
    assert np.allclose(result.median, 0)


def test_honest_covariances_have_a_nees_of_one() -> None:
    rng = np.random.default_rng(2)
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, -0.5], [0.0, -0.5, 1.0]]) * 1e-6
    error = rng.multivariate_normal(np.zeros(3), covariance, 5000)
    truth = rng.uniform(-0.02, 0.02, (5000, 3))
    stacked = np.tile(covariance, (5000, 1, 1))
    assert motion_errors(truth + error, truth, np.ones(5000, bool), stacked).nees == pytest.approx(1, abs=0.05)
    stacked[::2] = np.nan  # those without a covariance do not count
    assert motion_errors(truth + error, truth, np.ones(5000, bool), stacked).nees == pytest.approx(1, abs=0.07)


@pytest.mark.thorough
def test_clustered_intervals_cover_where_plain_ones_do_not() -> None:
    """Scenes with errors of their own: intervals by scene hold the true RMSE far more often than plain ones."""
    rng = np.random.default_rng(3)
    stored = {"clustered": 0, "plain": 0}
    trials, scene = 40, np.repeat(np.arange(40), 10)
    for trial in range(trials):
        size = np.exp(0.6 * rng.standard_normal(40))[scene]  # errors differ from scene to scene
        error = size[:, None] * rng.standard_normal((400, 3)) * 1e-3
        expected = np.exp(0.6**2)  # root of the mean of exp(2 * 0.6 n), in mm
        for name, groups in (("clustered", scene), ("plain", np.arange(400))):
            table = cluster_resamples(groups, count=200, seed=trial)
            result = motion_errors(error, np.zeros((400, 3)), np.ones(400, bool), None, table)
            stored[name] += int(result.rmse_low[0] <= expected <= result.rmse_high[0])
    assert stored["clustered"] > 0.8 * trials
    assert stored["plain"] < stored["clustered"] - 0.1 * trials


def test_resamples_keep_scenes_together() -> None:
    scene = np.repeat([3, 7, 9], [4, 4, 4])
    table = cluster_resamples(scene, count=50)
    assert table.shape == (50, 12)
    assert all(set(np.bincount(scene[row], minlength=10)[[3, 7, 9]] % 4) == {0} for row in table)


def test_resamples_of_scenes_of_different_sizes() -> None:
    scene = np.repeat([0, 1, 2], [2, 5, 9])
    table = cluster_resamples(scene, count=200)
    assert table.shape == (200, 16)
    assert ((table >= 0) & (table < 16)).all()
    assert all(len(np.unique(scene[row])) <= 3 for row in table)
    assert len(np.unique(table)) == 16
    assert any(len(np.unique(scene[row])) == 1 for row in table), "a scene may be drawn three times"


def test_shapes_that_do_not_fit_are_said() -> None:
    with pytest.raises(MitsonarError, match="equal numbers of estimated and true motions"):
        motion_errors(np.zeros((3, 3)), np.zeros((2, 3)), np.ones(3, bool))
    with pytest.raises(MitsonarError, match="at least one"):
        motion_errors(np.zeros((0, 3)), np.zeros((0, 3)), np.ones(0, bool))
