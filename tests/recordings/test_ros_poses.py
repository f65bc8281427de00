"""Poses, attitudes and heights in ROS bags: transforms, odometry, poses, mounts, worlds, and what is ambiguous."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bags import KINDS, TIME, Maker, pings, smooth, write_bag
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar import open_recording
from mitsonar.mapping.sources import open_frames
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import CONVENTIONS


def flown() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses of a vehicle at every 50 ms in mitsonar's convention, and their times."""
    time = TIME[0] + np.arange(-2, 24) * 0.05
    t = time - TIME[0]
    return np.column_stack([0.3 * t, 0.5 * t, 2 + 0.1 * t, 0.02 * t, 0.01 * t, 0.4 + 0.3 * t]), time


MOUNT = Rotation.from_euler("y", 30, degrees=True)
"""Of the sonar on the vehicle in forward, left, up: 30 deg down."""


def expected(frame: str) -> NDArray[np.float64]:
    """Poses of the sonar at the times of the frames by the angles alone: pitch adds up on a level vehicle."""
    t = TIME - TIME[0]
    pitch = np.radians(30) if frame else 0
    return np.column_stack([0.3 * t, 0.5 * t, 2 + 0.1 * t, 0.02 * t + pitch, 0 * t, 0.4 + 0.3 * t])


def in_ros(poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    place, turn = CONVENTIONS["ros-enu"].from_mitsonar(poses[:, :3], vehicle_rotation(poses))
    return place, turn.as_quat()


def to_message_axes(mount: Rotation) -> NDArray[np.float64]:
    """Rotation of (down, left, forward) in the vehicle's axes."""
    return np.asarray((mount * Rotation.from_matrix([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])).as_quat())


@pytest.mark.parametrize("source", ["tf", "odometry"])
@pytest.mark.parametrize("name", KINDS[:2])
def test_poses_are_those_of_transforms_or_odometry_with_the_mount(tmp_path: Path, source: str, name: str) -> None:
    maker = Maker(name.endswith(".bag"))
    poses, times = flown()
    poses[:, 4] = 0
    place, quaternion = in_ros(poses)
    sent = [("/tf_static", TIME[0], maker.transform(0.0, "base_link", "sonar", [0, 0, 0], to_message_axes(MOUNT)))]
    for time, where, turn in zip(times, place, quaternion, strict=True):
        if source == "tf":
            sent.append(("/tf", time, maker.transform(time, "odom", "base_link", where, turn)))
        else:
            sent.append(("/odom", time, maker.odometry(time, where, turn, "base_link")))
    recording = open_recording(write_bag(tmp_path / name, maker, [*pings(maker, smooth()), *sent]))
    assert recording.part().poses == pytest.approx(expected("mount"), abs=1e-4)
    assert recording.facts["poses"].endswith("in the frame 'odom'")
    assert open_frames(tmp_path / name).true is not None


def test_poses_without_a_mount_count_as_the_sonars_and_a_note_says_so(tmp_path: Path) -> None:
    maker = Maker(False)
    poses, times = flown()
    poses[:, 4] = 0
    sent = [("/pose", time, maker.pose_stamped(time, *one)) for time, *one in zip(times, *in_ros(poses), strict=True)]
    path = write_bag(tmp_path / "two", maker, [*pings(maker, smooth(), forward="x"), *sent])
    recording = open_recording(path)
    assert recording.part().poses == pytest.approx(expected(""), abs=1e-4)
    assert any("are assumed to be those of the sonar" in note for note in recording.notes)


def test_a_world_of_north_east_down_is_turned(tmp_path: Path) -> None:
    maker = Maker(False)
    poses, times = flown()
    poses[:, 4] = 0
    turn = vehicle_rotation(poses)
    down = Rotation.from_matrix(CONVENTIONS["ned"].world)
    body = Rotation.from_matrix(CONVENTIONS["ros-enu"].body)
    place, quaternion = down.inv().apply(poses[:, :3]), (down.inv() * turn * body.inv()).as_quat()
    sent = [
        ("/odom", time, maker.odometry(time, where, one, "sonar", "world_ned"))
        for time, where, one in zip(times, place, quaternion, strict=True)
    ]
    path = write_bag(tmp_path / "two", maker, [*pings(maker, smooth(), forward="x"), *sent])
    assert open_recording(path).part().poses == pytest.approx(expected(""), abs=1e-4)


def test_ambiguous_or_short_poses_are_not_used(tmp_path: Path) -> None:
    maker = Maker(False)
    level = [0, 0, 0, 1]
    two = [(topic, time, maker.odometry(time, [0, 0, 0], level, "sonar")) for topic in ("/a", "/b") for time in TIME]
    recording = open_recording(write_bag(tmp_path / "two", maker, [*pings(maker, smooth()), *two]))
    assert recording.part().poses is None
    assert any("several topics of odometry (/a, /b)" in note for note in recording.notes)
    short = [("/a", time, maker.odometry(time, [0, 0, 0], level, "sonar")) for time in TIME[:3]]
    recording = open_recording(write_bag(tmp_path / "short", maker, [*pings(maker, smooth()), *short]))
    assert recording.part().poses is None
    assert any("does not cover" in note for note in recording.notes)
