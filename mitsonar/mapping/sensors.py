"""Sensors of a vehicle from the topics of a ROS bag: IMU and velocities, with the covariances that their messages tell."""

from __future__ import annotations

import os
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.mapping.series import path_of
from mitsonar.motion.composition import motions
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import ROOT_HOUR, DeadReckoning, Readings, VehicleSensors, load_sensors, straight_poses
from mitsonar.motion.trajectory import Trajectory
from mitsonar.recordings.ros_messages import BagFile, Message, Topic, is_ros_bag

__all__ = ["SensorNoise", "open_sensors", "sensors_in_bag", "simulated_sensors"]


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


# ---------------- Readings that sensors of given noise would have along a true path: for tests, benchmarks and what-
# if runs


@dataclass(frozen=True)
class SensorNoise:
    """Noise of the sensors that a vehicle has; None: it has no such sensor.

    Attributes:
        gyro_deg_rth: noise of the gyroscope [deg/h^0.5].
        gyro_bias_deg_h: standard deviation of its constant bias [deg/h].
        velocity_m_s: standard deviation of each velocity of a DVL [m/s].
        depth_m: of each depth [m].
        compass_deg: of each heading [deg].
        walk: of dead reckoning, after a second [m, deg].
        rate_hz: readings a second of each sensor.
    """

    gyro_deg_rth: float | None = None
    gyro_bias_deg_h: float = 0.0
    velocity_m_s: float | None = None
    depth_m: float | None = None
    compass_deg: float | None = None
    walk: tuple[float, float] | None = None
    rate_hz: float = 20.0


def simulated_sensors(true: Trajectory, noise: SensorNoise, seed: int = 0) -> VehicleSensors:
    """Draw the readings of sensors along a true path.

    A reading of a rate or a velocity is the mean around its time; between the poses of the path they are constant.

    Raises:
        MitsonarError: no sensor, a path shorter than a reading, a rate that is not above 0.
    """
    span = float(true.time_s[-1] - true.time_s[0])
    if not (noise.rate_hz > 0 and span * noise.rate_hz >= 1):
        raise MitsonarError(f"a path of {span:g} s is too short for {noise.rate_hz:g} readings a second")
    rng = np.random.default_rng([seed, 22])
    count = int(np.ceil(span * noise.rate_hz))
    edges = np.linspace(true.time_s[0], true.time_s[-1], count + 1)
    step, time = np.diff(edges), (edges[1:] + edges[:-1]) / 2
    on_edges = straight_poses(true, edges)
    moved = motions(on_edges)
    # every draw is made, so that a sensor's errors do not depend on which others there are
    draws = rng.normal(size=(7, count))
    bias = rng.normal()
    yaw_rate = sideways = forward = depth = heading = dead = None
    bias_std = noise.gyro_bias_deg_h * np.radians(1) / 3600
    if noise.gyro_deg_rth is not None:
        density = noise.gyro_deg_rth * ROOT_HOUR
        rate = moved[:, 2] / step + density / np.sqrt(step) * draws[0] + bias_std * bias
        yaw_rate = Readings(time, rate, np.full(count, density))
    if noise.velocity_m_s is not None:
        std = np.full(count, noise.velocity_m_s)
        sin, cos = np.sin(moved[:, 2] / 2), np.cos(moved[:, 2] / 2)
        sideways = Readings(time, (moved[:, 0] * cos + moved[:, 1] * sin) / step + std * draws[1], std)
        forward = Readings(time, (moved[:, 1] * cos - moved[:, 0] * sin) / step + std * draws[2], std)
    at = straight_poses(true, time)
    if noise.depth_m is not None:
        depth = Readings(time, -at[:, 2] + noise.depth_m * draws[3], np.full(count, noise.depth_m))
    if noise.compass_deg is not None:
        std = np.full(count, np.radians(noise.compass_deg))
        heading = Readings(time, at[:, 5] + std * draws[4], std)
    if noise.walk is not None:
        dead = _simulated_reckoning(on_edges, edges, noise.walk, draws[[5, 6, 4]].T)
    return VehicleSensors(yaw_rate, sideways, forward, depth, heading, dead, bias_std, "simulated sensors")


def _simulated_reckoning(poses: Array, time_s: Array, walk: tuple[float, float], draws: Array) -> DeadReckoning:
    """Return poses whose position and heading wander from the true ones."""
    off = np.cumsum(np.sqrt(np.diff(time_s))[:, None] * [walk[0], walk[0], np.radians(walk[1])] * draws, axis=0)
    # the walk turns with the vehicle: what it adds is of the motion, in axes of the path
    moved = motions(poses) + np.diff(off, axis=0, prepend=0)
    wandered = path_of(moved, Pose.from_row(poses[0]), time_s)
    return DeadReckoning(wandered, walk[0], float(np.radians(walk[1])))
