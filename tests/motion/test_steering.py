"""Steering is the inverse of the velocities of a trajectory."""

from __future__ import annotations

import numpy as np

from mitsonar.motion.composition import steered
from mitsonar.motion.trajectory import Trajectory, velocities


def test_velocities_of_steered_poses_are_those_that_were_given() -> None:
    rng = np.random.default_rng(0)
    for velocity in rng.uniform(-1, 1, (20, 4)):
        first = np.array([[*rng.uniform(-5, 5, 3), 0, 0, rng.uniform(-3, 3)]])
        path = Trajectory(np.concatenate([first, steered(first, velocity[None], 0.5)]), np.array([0.0, 0.5]))
        np.testing.assert_allclose(velocities(path)[0], velocity, atol=1e-12)


def test_a_quarter_turn_ends_where_the_circle_does() -> None:
    after = steered(np.zeros((1, 6)), [[0, np.pi / 2, 0, np.pi / 2]], 1.0)[0]  # radius 1 m, to starboard
    np.testing.assert_allclose(after[[0, 1, 5]], [1, 1, np.pi / 2], atol=1e-12)
