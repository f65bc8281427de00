"""How the readings of vehicle sensors are opened from a file or a ROS bag, or simulated along a true path."""

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
"""Message types of gyroscopes and of velocities; the first type of velocities that a bag holds is used."""

DOWN = ("ned", "frd")
"""Suffixes of the names of frames with axes forward, starboard, down; all others are forward, port, up (REP 103)."""

TRAJECTORY = "trajectory.csv"
"""File in a folder that may have columns of readings."""

LARGEST = 1e6
"""Largest velocity, rate and variance of a reading that is used."""


def open_sensors(path: str | Path) -> VehicleSensors:
    """Open the sensors of a CSV file (:func:`mitsonar.motion.sensors.load_sensors`) or of a ROS bag.

    Args:
        path: path of either, or of a folder with a ``trajectory.csv`` that has columns of sensors.

    Raises:
        MitsonarError: the file cannot be read, or holds no readings.
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
    """Read the gyroscope and the velocities of a ROS bag, with the covariances in the messages.

    Times are those in the headers of the messages. The gyroscope is the only topic of type ``sensor_msgs/Imu``. Velocities
    are those of the only topic of type ``geometry_msgs/TwistWithCovarianceStamped``, or else ``nav_msgs/Odometry``. The
    vehicle is assumed to be level, and the sensors to be mounted along its axes. Only readings with a variance above 0 are
    used.

    Raises:
        MitsonarError: the bag is damaged, has several topics of a type, or none whose messages hold a covariance.
    """
    bag = BagFile(path)
    topics = [one for one in bag.topics() if one.messages]
    yaw_rate = _gyroscope(bag, topics)
    sideways, forward = _velocities(bag, topics)
    if yaw_rate is None and sideways is None:
        raise MitsonarError(
            f"{path} holds no sensor whose messages state their covariance ({IMU}, {', '.join(TWISTS)}): write the readings "
            "to a CSV file, with their noise"
        )
    return VehicleSensors(yaw_rate, sideways, forward, name=f"the sensors of {Path(path).name}")


def _gyroscope(bag: BagFile, topics: list[Topic]) -> Readings | None:
    """Return the yaw rates of the only IMU; None if there is no IMU that reports its noise."""
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
    # the variance of a reading times the time between readings is the squared noise density
    step = float(np.median(np.diff(table[:, 0])))
    return Readings(table[:, 0], table[:, 1], np.sqrt(table[:, 2] * step))


def _velocities(bag: BagFile, topics: list[Topic]) -> tuple[Readings | None, Readings | None]:
    """Return the velocities to starboard and forward; None if there is no topic that reports their noise."""
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
    """Return the only topic of a type; None if there is none."""
    these = [one for one in topics if one.kind == kind]
    if len(these) > 1:
        names = ", ".join(one.name for one in these)
        raise MitsonarError(f"{bag.path} holds several topics of {kind} ({names}): write one to a CSV file")
    return these[0] if these else None


def _messages(bag: BagFile, topic: Topic) -> Iterator[Message]:
    for _, raw in bag.messages(topic.name):
        yield bag.decode(raw, topic.kind)


def _up(frame: object) -> float:
    """Return 1 if the axes of a frame are forward, port, up; -1 if they are forward, starboard, down."""
    return -1.0 if re.split("[_/]", str(frame).lower())[-1] in DOWN else 1.0


def _seconds(message: Message) -> float:
    stamp = message.header.stamp
    return float((int(stamp.sec) * 10**9 + int(stamp.nanosec)) / 10**9)


def _sound(rows: array[float], width: int) -> Array | None:
    """Return the valid readings in order of time ``(n, width)``; None if there are fewer than two.

    The columns are the time, and alternately a value and its variance.
    """
    table = np.array(rows, dtype=float).reshape(-1, width)
    values, variances = table[:, 1::2], table[:, 2::2]
    good = np.isfinite(table).all(axis=1) & (np.abs(values) < LARGEST).all(axis=1)
    good &= ((variances > 0) & (variances < LARGEST)).all(axis=1)
    table = table[good]
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    return table if len(table) >= 2 else None


# ---------------- Simulated sensors


@dataclass(frozen=True)
class SensorNoise:
    """Noise of the sensors of a vehicle; None where it has no such sensor.

    Attributes:
        gyro_deg_rth: angle random walk of the gyroscope [deg/h^0.5].
        gyro_bias_deg_h: standard deviation of the constant bias of the gyroscope [deg/h].
        velocity_m_s: standard deviation of each velocity of a DVL [m/s].
        depth_m: standard deviation of each depth [m].
        compass_deg: standard deviation of each heading [deg].
        walk: random walk of dead reckoning after one second [m, deg].
        rate_hz: readings per second of each sensor [Hz].
        attitude_deg: standard deviation of each pitch and roll [deg].
    """

    gyro_deg_rth: float | None = None
    gyro_bias_deg_h: float = 0.0
    velocity_m_s: float | None = None
    depth_m: float | None = None
    compass_deg: float | None = None
    walk: tuple[float, float] | None = None
    rate_hz: float = 20.0
    attitude_deg: float | None = None


def simulated_sensors(true: Trajectory, noise: SensorNoise, seed: int = 0) -> VehicleSensors:
    """Simulate the readings of noisy sensors along a true path, for tests, benchmarks and what-if runs.

    A reading of a rate or a velocity is the mean over the interval around its time. Rates and velocities are constant
    between the poses of the path.

    Args:
        true: true path of the vehicle.
        noise: noise of its sensors.
        seed: seed of the noise.

    Raises:
        MitsonarError: there is no sensor, the path is shorter than a reading, or the rate is not above 0.
    """
    # 1. intervals of the readings, and the true motion over each
    span = float(true.time_s[-1] - true.time_s[0])
    if not (noise.rate_hz > 0 and span * noise.rate_hz >= 1):
        raise MitsonarError(f"a path of {span:g} s is too short for {noise.rate_hz:g} readings a second")
    rng = np.random.default_rng([seed, 22])
    count = int(np.ceil(span * noise.rate_hz))
    edges = np.linspace(true.time_s[0], true.time_s[-1], count + 1)
    step, time = np.diff(edges), (edges[1:] + edges[:-1]) / 2
    on_edges = straight_poses(true, edges)
    moved = motions(on_edges)
    # 2. draw the noise of all sensors, so that the errors of one do not depend on which others there are
    draws = rng.normal(size=(7, count))
    bias = rng.normal()
    leaning = rng.normal(size=(2, count))
    # 3. rates and velocities: mean over the interval, with motions turned into the axes half-way through it
    yaw_rate = sideways = forward = depth = pitch = roll = heading = dead = None
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
    # 4. depth, attitude, compass and dead reckoning at the times themselves
    poses = straight_poses(true, time)
    if noise.depth_m is not None:
        depth = Readings(time, -poses[:, 2] + noise.depth_m * draws[3], np.full(count, noise.depth_m))
    if noise.attitude_deg is not None:
        std = np.full(count, np.radians(noise.attitude_deg))
        pitch, roll = (Readings(time, poses[:, 3 + k] + std * leaning[k], std) for k in (0, 1))
    if noise.compass_deg is not None:
        std = np.full(count, np.radians(noise.compass_deg))
        heading = Readings(time, poses[:, 5] + std * draws[4], std)
    if noise.walk is not None:
        dead = _simulated_reckoning(on_edges, edges, noise.walk, draws[[5, 6, 4]].T)
    return VehicleSensors(yaw_rate, sideways, forward, depth, heading, dead, bias_std, "simulated sensors", pitch, roll)


def _simulated_reckoning(poses: Array, time_s: Array, walk: tuple[float, float], draws: Array) -> DeadReckoning:
    """Return dead reckoning whose position and heading wander from the true ones as a random walk."""
    off = np.cumsum(np.sqrt(np.diff(time_s))[:, None] * [walk[0], walk[0], np.radians(walk[1])] * draws, axis=0)
    # the walk adds to the motions, in axes that turn with the vehicle
    moved = motions(poses) + np.diff(off, axis=0, prepend=0)
    wandered = path_of(moved, Pose.from_row(poses[0]), time_s)
    return DeadReckoning(wandered, walk[0], float(np.radians(walk[1])))
