"""Readings that sensors of given noise would have along a true path: for tests, benchmarks and what-if runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.mapping.motion_series import path_of
from mitsonar.motion.composition import motions
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import ROOT_HOUR, DeadReckoning, Readings, VehicleSensors, straight_poses
from mitsonar.motion.trajectory import Trajectory

__all__ = ["SensorNoise", "simulated_sensors"]

Array = NDArray[np.float64]


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
        dead = _reckoned(on_edges, edges, noise.walk, draws[[5, 6, 4]].T)
    return VehicleSensors(yaw_rate, sideways, forward, depth, heading, dead, bias_std, "simulated sensors")


def _reckoned(poses: Array, time_s: Array, walk: tuple[float, float], draws: Array) -> DeadReckoning:
    """Return poses whose position and heading wander from the true ones."""
    off = np.cumsum(np.sqrt(np.diff(time_s))[:, None] * [walk[0], walk[0], np.radians(walk[1])] * draws, axis=0)
    # the walk turns with the vehicle: what it adds is of the motion, in axes of the path
    moved = motions(poses) + np.diff(off, axis=0, prepend=0)
    wandered = path_of(moved, Pose.from_row(poses[0]), time_s)
    return DeadReckoning(wandered, walk[0], float(np.radians(walk[1])))
