"""Velocities of a DVL as the readings that odometry takes."""

from __future__ import annotations

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.motion.sensors import Readings, VehicleSensors
from mitsonar.records.soundings import DvlReadings

__all__ = ["dvl_sensors"]


def dvl_sensors(readings: DvlReadings) -> VehicleSensors:
    """Return velocities sideways and forward in level axes, with their standard deviations, of the pings with bottom lock.

    The correlation of both is left out; it is 0 while all beams of a symmetric DVL have an echo.

    Raises:
        MitsonarError: no bottom lock in any ping.
    """
    locked = readings.locked
    if not locked.any():
        raise MitsonarError("the DVL has no bottom lock in any ping: come nearer to the ground, or raise range_max")
    velocity, covariance = readings.level()
    time_s, std = readings.soundings.time_s[locked], np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[locked]
    sideways, forward = (Readings(time_s, velocity[locked, axis], std[:, axis]) for axis in (0, 1))
    return VehicleSensors(sideways=sideways, forward=forward, name="the DVL")
