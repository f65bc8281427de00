"""Motions with six degrees of freedom: against the planar ones, rotations in axes that are written down, and inverted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import (
    DEGREES,
    PLANAR,
    Motion,
    compose,
    compose_six,
    degrees_named,
    six_between,
    six_of,
)
from mitsonar.motion.pose import Pose, mounted, vehicle_rotation

POSES = [Pose.from_degrees(row) for row in ([1, -2, 3, 35, 0, 20], [0, 0, 5, 90, 0, -90], [0.5, 0, 2, -10, 40, 170])]


@pytest.mark.parametrize("pose", POSES)
def test_planar_motions_are_those_of_eq_34_bit_for_bit(pose: Pose) -> None:
    motion = Motion(0.3, -0.2, 0.1)
    assert compose_six(pose, six_of(motion, PLANAR)) == compose(pose, motion)


@pytest.mark.parametrize("pose", POSES)
def test_angles_turn_about_level_axes_through_the_pose(pose: Pose) -> None:
    """Also of a sonar that looks straight down, where pitch, roll and heading of the pose itself are not independent."""
    sin, cos = np.sin(pose.heading), np.cos(pose.heading)
    starboard, ahead = np.array([cos, -sin, 0]), np.array([sin, cos, 0])
    for name, axis in (("pitch", -starboard), ("roll", ahead), ("yaw", np.array([0, 0, -1.0]))):
        moved = compose_six(pose, six_of([0.05], [name]))
        expected = Rotation.from_rotvec(0.05 * axis) * vehicle_rotation(pose)
        np.testing.assert_allclose(moved[:3], pose[:3], atol=1e-15)
        np.testing.assert_allclose(vehicle_rotation(moved).as_matrix(), expected.as_matrix(), atol=1e-7, err_msg=name)


def test_a_tilted_sonar_moves_as_on_its_level_vehicle() -> None:
    """Two routes: the motion of the sonar, and that of a vehicle at its place that carries it."""
    pose, motion = POSES[2], np.array([0.1, 0.2, -0.3, 0.04, -0.05, 0.06])
    vehicle = Pose(*pose[:3], 0.0, 0.0, pose.heading)
    carried = mounted([compose_six(vehicle, motion)], Pose(0, 0, 0, pose.pitch, pose.roll, 0))[0]
    np.testing.assert_allclose(compose_six(pose, motion), carried, atol=1e-12)
    assert compose_six(vehicle, six_of([0.3, 0.1], ["rise", "pitch"]))[2:4] == pytest.approx((pose.z + 0.3, 0.1))


@pytest.mark.parametrize("pose", [POSES[0], POSES[2]])
def test_the_motion_between_two_poses_leads_from_one_to_the_other(pose: Pose) -> None:
    motion = np.array([0.1, -0.2, 0.3, 0.07, -0.11, 0.4])
    np.testing.assert_allclose(six_between(pose, compose_six(pose, motion)), motion, atol=1e-12)
    np.testing.assert_allclose(six_between(pose, pose), 0, atol=1e-12)


def test_degrees_are_named() -> None:
    assert degrees_named("3") == PLANAR
    assert degrees_named("6") == tuple(DEGREES)
    assert degrees_named("yaw, rise") == ("rise", "yaw")
    for text, words in (("pich", "did you mean pitch"), ("", "rise"), ("7", "give 3, 6 or names")):
        with pytest.raises(MitsonarError, match=words):
            degrees_named(text)
