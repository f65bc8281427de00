"""Steering: level vehicles that move with a constant velocity in their own axes for a while."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["steered"]


def steered(poses: ArrayLike, velocity: ArrayLike, step_s: float) -> NDArray[np.float64]:
    """Return the poses after a step: the inverse of :func:`mitsonar.motion.trajectory.velocities`.

    A constant velocity and turn lead along an arc, whose chord is shorter by the sinc of half the turn. Pitch and roll stay.

    Args:
        poses: before ``(n, 6)`` [m, rad].
        velocity: to starboard, forward, up [m/s], and turn to starboard [rad/s] ``(n, 4)``.
        step_s: duration [s].
    """
    poses, velocity = np.asarray(poses, dtype=float), np.asarray(velocity, dtype=float)
    starboard, forward, up, turn = (velocity * step_s).T
    middle = poses[:, 5] + turn / 2
    shorter = np.sinc(turn / (2 * np.pi))
    sin, cos = np.sin(middle) * shorter, np.cos(middle) * shorter
    after = poses.copy()
    after[:, 0] += starboard * cos + forward * sin
    after[:, 1] += forward * cos - starboard * sin
    after[:, 2] += up
    after[:, 5] += turn
    return after
