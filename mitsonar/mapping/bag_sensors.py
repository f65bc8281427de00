"""Sensors of a vehicle from the topics of a ROS bag: IMU and velocities, with the covariances that their messages tell."""

from __future__ import annotations

import os
import re
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.sensors import Readings, VehicleSensors, load_sensors
from mitsonar.recordings.ros_messages import BagFile, Message, Topic, is_ros_bag

__all__ = ["open_sensors", "sensors_in_bag"]

Array = NDArray[np.float64]

IMU = "sensor_msgs/msg/Imu"
TWISTS = ("geometry_msgs/msg/TwistWithCovarianceStamped", "nav_msgs/msg/Odometry")
"""Types of messages of gyroscopes, and of velocities; the first type that a bag has counts."""

DOWN = ("ned", "frd")
"""Ends of the names of frames whose axes are forward, starboard, down; the others are forward, port, up (REP 103)."""

TRAJECTORY = "trajectory.csv"
"""The file of a folder whose columns may hold readings."""

LARGEST = 1e6
"""Largest time step, velocity, rate and variance that counts."""


def open_sensors(path: str | Path) -> VehicleSensors:
    """Open the sensors of a CSV file (:func:`mitsonar.motion.sensors.load_sensors`) or of a ROS bag.

    Args:
        path: of either, or a folder that holds ``trajectory.csv``, with columns of sensors.

    Raises:
        MitsonarError: unreadable, or without readings.
    """
    where = Path(path)
    if os.path.isdir(where) and not is_ros_bag(where, b""):
        if not os.path.isfile(where / TRAJECTORY):
            raise MitsonarError(f"{path} holds no {TRAJECTORY}: give a CSV file of sensors, a folder with one, or a ROS bag")
        return load_sensors(where / TRAJECTORY)
    try:
        first = b""
        if os.path.isfile(where):
            with where.open("rb") as file:
                first = file.read(64)
    except OSError as error:
        raise MitsonarError(f"cannot read the sensors {path}: {error.strerror}") from None
    return sensors_in_bag(where) if is_ros_bag(where, first) else load_sensors(where)


def sensors_in_bag(path: str | Path) -> VehicleSensors:
    """Read the gyroscope and the velocities of a ROS bag, by the times in the headers of the messages.

    The gyroscope is the only topic of ``sensor_msgs/Imu``. Velocities are of the only topic of
    ``geometry_msgs/TwistWithCovarianceStamped``, or else of ``nav_msgs/Odometry``. The vehicle is taken for level, and the
    sensors for mounted along its axes. Readings count whose variance is told, and above 0.

    Raises:
        MitsonarError: a damaged bag, several topics of a kind, or none whose messages tell a covariance.
    """
    bag = BagFile(path)
    topics = [one for one in bag.topics() if one.messages]
    yaw_rate = _gyroscope(bag, topics)
    sideways, forward = _velocities(bag, topics)
    if yaw_rate is None and sideways is None:
        raise MitsonarError(
            f"{path} holds no sensor whose messages tell their covariance ({IMU}, {', '.join(TWISTS)}): write the readings "
            "to a CSV file, with their noise"
        )
    return VehicleSensors(yaw_rate, sideways, forward, name=f"the sensors of {Path(path).name}")


def _gyroscope(bag: BagFile, topics: list[Topic]) -> Readings | None:
    """Return the yaw rates of the only IMU; None without one that tells its noise."""
    topic = _only(bag, topics, IMU)
    if topic is None:
        return None
    rows = array("d")
    for message in _messages(bag, topic):
        sign = _up(message.header.frame_id)
        rows.extend((_seconds(message), -sign * message.angular_velocity.z, message.angular_velocity_covariance[8]))
    table = _sound(rows, 3)
    if table is None:
        return None
    # a variance of each reading is a noise density by the time between readings
    step = float(np.median(np.diff(table[:, 0])))
    return Readings(table[:, 0], table[:, 1], np.sqrt(table[:, 2] * step))


def _velocities(bag: BagFile, topics: list[Topic]) -> tuple[Readings | None, Readings | None]:
    """Return velocities to starboard and forward; None without a topic that tells their noise."""
    topic = next((one for one in (_only(bag, topics, kind) for kind in TWISTS) if one is not None), None)
    if topic is None:
        return None, None
    rows = array("d")
    for message in _messages(bag, topic):
        frame = message.child_frame_id if topic.kind == TWISTS[1] else message.header.frame_id
        speed, variance = message.twist.twist.linear, message.twist.covariance
        rows.extend((_seconds(message), -_up(frame) * speed.y, variance[7], speed.x, variance[0]))
    table = _sound(rows, 5)
    if table is None:
        return None, None
    sideways, forward = (Readings(table[:, 0], table[:, k], np.sqrt(table[:, k + 1])) for k in (1, 3))
    return sideways, forward


def _only(bag: BagFile, topics: list[Topic], kind: str) -> Topic | None:
    """Return the only topic of a type; None without one."""
    these = [one for one in topics if one.kind == kind]
    if len(these) > 1:
        names = ", ".join(one.name for one in these)
        raise MitsonarError(f"{bag.path} holds several topics of {kind} ({names}): write one to a CSV file")
    return these[0] if these else None


def _messages(bag: BagFile, topic: Topic) -> Iterator[Message]:
    for _, raw in bag.messages(topic.name):
        yield bag.decode(raw, topic.kind)


def _up(frame: object) -> float:
    """Return 1 where the axes of a frame are forward, port, up; -1 where they are forward, starboard, down."""
    return -1.0 if re.split("[_/]", str(frame).lower())[-1] in DOWN else 1.0


def _seconds(message: Message) -> float:
    stamp = message.header.stamp
    return float((int(stamp.sec) * 10**9 + int(stamp.nanosec)) / 10**9)


def _sound(rows: array[float], width: int) -> Array | None:
    """Return readings in the order of their times ``(n, width)``: time, then value and variance by turns; None below two."""
    table = np.array(rows, dtype=float).reshape(-1, width)
    values, variances = table[:, 1::2], table[:, 2::2]
    good = np.isfinite(table).all(axis=1) & (np.abs(values) < LARGEST).all(axis=1)
    good &= ((variances > 0) & (variances < LARGEST)).all(axis=1)
    table = table[good]
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    return table if len(table) >= 2 else None
