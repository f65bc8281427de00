"""The six courses of chapter 5: number of positions, speeds, shape."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import steady
from mitsonar.motion.courses import COURSES, course
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import velocities

POSITIONS = {"square": 400, "stairs": 400, "zigzag": 340, "circle": 400, "sinusoid": 400, "diagonal": 200}
SPEEDS = {
    "square": (0.5, 1.5),
    "stairs": (0.5, 1.5),
    "zigzag": (0.5, 1.5),
    "circle": (1.57, 1.58),
    "sinusoid": (0.6, 2.0),
    "diagonal": (1.41, 1.42),
}


def test_courses_are_those_of_the_thesis_in_its_order() -> None:
    assert list(COURSES) == list(POSITIONS)


@pytest.mark.parametrize("name", POSITIONS)
def test_positions_and_speeds(name: str) -> None:
    flown = course(name, Pose(3, -4, 10, heading=0.7))
    assert len(flown) == POSITIONS[name]
    assert (flown.poses[:, 2] == 10).all()
    assert (flown.poses[:, 5] == 0.7).all()
    assert np.allclose(np.diff(flown.time_s), 0.05)
    middle = course(name, Pose(0, 0, 10)).poses[:, :2]
    assert np.allclose(middle.min(axis=0) + middle.max(axis=0), 0, atol=1e-12)
    velocity = velocities(flown)
    speed = np.linalg.norm(velocity[:, :3], axis=1)
    low, high = SPEEDS[name]
    assert speed.min() == pytest.approx(low, abs=0.02)
    assert speed.max() == pytest.approx(high, abs=0.02)
    assert not velocity[:, 2:].any()


def test_loops_close() -> None:
    """The square lacks the last of its 400 displacements, 25 mm."""
    for name, gap in (("square", 0.025), ("circle", 0.0)):
        places = course(name, Pose(0, 0, 10)).poses[:, :2]
        assert np.hypot(*(places[-1] - places[0])) == pytest.approx(gap, abs=1e-9)
    assert np.ptp(course("circle", Pose(0, 0, 10)).poses[:, 0]) == pytest.approx(10, abs=1e-3)
    assert np.ptp(course("square", Pose(0, 0, 10)).poses[:, 0]) == pytest.approx(5, abs=1e-9)


def test_an_unknown_course_is_answered() -> None:
    with pytest.raises(MitsonarError, match=r"unknown course 'sqare'.*square"):
        course("sqare", Pose(0, 0, 10))


def test_steady_motion_keeps_its_velocity() -> None:
    """The arc against small steps, and :func:`velocities` against what was asked."""
    start, speed = Pose(1, 2, 10, heading=0.4), (1.5, -0.7, 0.3)
    flown, velocity = steady(start, speed, 5, 2.0)
    fine, _ = steady(start, speed, 40_001, 2.0 * 10_000)
    assert np.allclose(flown.poses, fine.poses[::10_000], atol=1e-12)
    assert np.allclose(velocities(fine)[:, :2], (1.5, -0.7), atol=1e-4)
    assert np.allclose(velocities(fine)[:, 3], 0.3)
    assert (velocity == [1.5, -0.7, 0, 0.3]).all()
    assert (steady(start, (1.0, 0.0, 0.0), 3, 1.0)[0].poses[:, 5] == 0.4).all()
