"""Drift over segments: closed forms, and KITTI's own algorithm written out again."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.mapping.series import path_of
from mitsonar.motion.errors import segment_drift
from mitsonar.motion.pose import Pose, to_world_matrices
from mitsonar.motion.trajectory import Trajectory

Array = NDArray[np.float64]

START = Pose(3.0, -2.0, 2.5, np.radians(35), 0.0, 3.0)


def driven(motions: Array) -> Trajectory:
    return path_of(motions, START, np.arange(len(motions) + 1) / 20)


def straight(step: float = 0.025, yaw: float = 0.0, frames: int = 401) -> Trajectory:
    return driven(np.tile([0.0, step, yaw], (frames - 1, 1)))


def strays(seed: int = 0) -> tuple[Trajectory, Trajectory]:
    """A path that swings, and an estimate with random errors."""
    rng = np.random.default_rng(seed)
    t = np.arange(300) / 20
    true = np.column_stack([0.01 * np.sin(t), 0.02 + 0.005 * np.cos(2 * t), 0.01 * np.sin(0.7 * t)])
    return driven(true + rng.normal(size=true.shape) * [1e-3, 1e-3, 2e-3]), driven(true)


def test_a_scale_error_of_two_percent_is_a_drift_of_two_percent() -> None:
    drift = segment_drift(straight(0.0255), straight(), (1, 2, 5))
    assert drift is not None
    np.testing.assert_allclose(drift.translation, 0.02, rtol=1e-9)
    assert drift.percent == pytest.approx(2)
    assert drift.deg_per_100m == pytest.approx(0, abs=1e-9)
    assert drift.intervals()[0] == pytest.approx((2, 2))


def test_a_turn_of_a_degree_a_metre_is_100_deg_per_100_m_and_a_chord() -> None:
    """An arc against a straight line of equal steps: the chord of the polygon's ends."""
    turn = np.radians(1.0) * 0.025
    drift = segment_drift(straight(yaw=turn), straight(), (2,))
    assert drift is not None
    assert drift.deg_per_100m == pytest.approx(100)
    heading = turn * np.arange(1, 81)
    end = 0.025 * np.array([np.sin(heading).sum(), np.cos(heading).sum()])
    np.testing.assert_allclose(drift.translation, np.linalg.norm(end - [0, 2]) / 2, rtol=1e-9)


def test_a_right_path_has_no_drift() -> None:
    drift = segment_drift(straight(), straight(), (1,))
    assert drift is not None
    assert drift.percent == pytest.approx(0, abs=1e-9)


def kitti(estimated: Trajectory, true: Trajectory, lengths: tuple[float, ...]) -> Array:
    """`calcSequenceErrors` of KITTI's development kit, a segment from every frame: translation and rotation errors."""
    there, here = (to_world_matrices(path.poses) for path in (true, estimated))
    distance = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(there[:, :3, 3], axis=0), axis=1))])
    result = []
    for length in lengths:
        for first in range(len(there)):
            beyond = np.flatnonzero(distance > distance[first] + length)
            if not beyond.size:
                continue
            last = beyond[0]
            moved, took = (np.linalg.inv(path[first]) @ path[last] for path in (there, here))
            error = np.linalg.inv(took) @ moved
            angle = np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))
            result.append([np.linalg.norm(error[:3, 3]) / length, angle / length])
    return np.array(result)


def test_errors_are_those_of_the_development_kit_of_kitti() -> None:
    estimated, true = strays()
    drift = segment_drift(estimated, true, (1, 2, 5))
    assert drift is not None
    expected = kitti(estimated, true, (1, 2, 5))
    np.testing.assert_allclose(drift.translation, expected[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(drift.rotation_rad_per_m, expected[:, 1], rtol=0, atol=1e-7)
    assert drift.percent == pytest.approx(100 * expected[:, 0].mean())


def test_intervals_hold_the_drift_and_widen_with_fewer_blocks() -> None:
    estimated, true = strays()
    drift = segment_drift(estimated, true, (1, 2))
    assert drift is not None
    (low, high), (least, most) = drift.intervals()
    assert low < drift.percent < high
    assert least < drift.deg_per_100m < most
    assert len(np.unique(drift.blocks)) == int(np.ceil(drift.start_m.max()))


def test_lengths_that_do_not_fit_are_left_out() -> None:
    path = straight(frames=61)
    drift = segment_drift(path, path, (1, 2, 5))
    assert drift is not None
    assert drift.lengths_m == (1,)
    assert segment_drift(path, path, (2, 5)) is None
    with pytest.raises(MitsonarError, match="above 0 m"):
        segment_drift(path, path, (0.0, 1.0))
