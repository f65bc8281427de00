"""The six courses of Almanza-Medina, 5.4.5, by name: a vehicle that keeps its heading, a position every 50 ms.

Some of the text's lists are garbled. :data:`LEGS` and the formulas below replace them. Each course keeps the text's number
of positions and its speeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, suggest_names
from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory

__all__ = ["COURSES", "LEGS", "course"]

STEP_S = 0.05
"""Time between positions."""

AHEAD, BACK, LEFT, RIGHT = (0.0, 1.0), (0.0, -1.0), (-1.0, 0.0), (1.0, 0.0)
"""Directions as (starboard, forward)."""

Leg = tuple[int, tuple[float, float], float]

LEGS: dict[str, tuple[Leg, ...]] = {
    # 5 m a side; one displacement short of the start, since 400 positions make 399 displacements
    "square": ((100, LEFT, 1.0), (100, AHEAD, 1.0), (50, RIGHT, 1.5), (50, RIGHT, 0.5), (50, BACK, 1.5), (49, BACK, 0.5)),
    "stairs": ((100, AHEAD, 1.0), (100, RIGHT, 1.0), (50, AHEAD, 1.5), (50, AHEAD, 0.5), (50, RIGHT, 1.5), (49, RIGHT, 0.5)),
    # the list of the text up to its first repetition, then ahead up to 340 positions
    "zigzag": (
        (80, BACK, 1.0),
        (50, LEFT, 1.0),
        (40, AHEAD, 0.5),
        (50, LEFT, 1.5),
        (40, BACK, 0.5),
        (50, LEFT, 0.5),
        (29, AHEAD, 0.5),
    ),
    "diagonal": ((199, (1.0, 1.0), 1.0),),
}
"""Courses of straight legs: displacements, direction (starboard, forward), speed along each of them [m/s]."""


def _legs(name: str) -> NDArray[np.float64]:
    """Return positions ``(n, 2)`` along straight legs, starboard and forward [m]."""
    steps = [np.tile(np.array(direction) * speed * STEP_S, (count, 1)) for count, direction, speed in LEGS[name]]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(np.concatenate(steps), axis=0)])


def _circle() -> NDArray[np.float64]:
    """Return a circle of 5 m radius, 400 positions: 1.57 m/s."""
    angle = 2 * math.pi * np.arange(400) / 399
    return 5.0 * np.column_stack([np.cos(angle) - 1, np.sin(angle)])


def _sinusoid() -> NDArray[np.float64]:
    """Return 0.6 m/s to starboard, and three waves ahead and back at up to 1.908 m/s: 0.6 to 2 m/s, 400 positions."""
    time = STEP_S * np.arange(400)
    pulsation = 2 * math.pi * 3 / time[-1]
    return np.column_stack([0.6 * time, math.sqrt(2.0**2 - 0.6**2) / pulsation * np.sin(pulsation * time)])


COURSES: dict[str, Callable[[], NDArray[np.float64]]] = {
    "square": partial(_legs, "square"),
    "stairs": partial(_legs, "stairs"),
    "zigzag": partial(_legs, "zigzag"),
    "circle": _circle,
    "sinusoid": _sinusoid,
    "diagonal": partial(_legs, "diagonal"),
}
"""Almanza-Medina's trajectories 1 to 6, in that order."""


def course(name: str, around: Pose) -> Trajectory:
    """Return a course whose middle lies at ``around``, with the height, attitude and heading of that pose.

    Raises:
        MitsonarError: unknown name.
    """
    if name not in COURSES:
        raise MitsonarError(f"unknown course {name!r}: {suggest_names(name, COURSES)}")
    flat = COURSES[name]()
    flat = flat - (flat.min(axis=0) + flat.max(axis=0)) / 2
    level = vehicle_rotation(around._replace(pitch=0.0, roll=0.0))
    poses = np.tile(np.array(around, dtype=float), (len(flat), 1))
    poses[:, :3] += level.apply(np.column_stack([flat, np.zeros(len(flat))]))
    return Trajectory(poses, np.arange(len(flat), dtype=np.float64) * STEP_S)
