"""Pattern over elevation: a uniform aperture whose power is one half at the edges of the field of view."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.beam_former import ELEVATION_HALF
from mitsonar.simulation.device_arrays import DeviceArray

__all__ = ["elevation_gain", "elevation_gain_of_ends"]


def elevation_gain(sonar: Sonar, tangent: DeviceArray) -> DeviceArray:
    """Return the amplitude at a tangent of the elevation, of a ``mi.Float``: a uniform aperture's, or 1."""
    pattern = sonar.vertical_pattern
    if pattern == "box":
        return mi.Float(1)
    one_way = _one_way(sonar, tangent)
    return one_way * one_way if pattern == "two_way" else one_way


def elevation_gain_of_ends(sonar: Sonar, arrival: DeviceArray, departure: DeviceArray) -> DeviceArray:
    """Return the amplitude of a path that comes back at another tangent of the elevation than it left at.

    An array that only receives hears the arrival; one that sends as well counts at both ends.
    """
    pattern = sonar.vertical_pattern
    if pattern == "box":
        return mi.Float(1)
    gain = _one_way(sonar, arrival)
    return gain * _one_way(sonar, departure) if pattern == "two_way" else gain


def _one_way(sonar: Sonar, tangent: DeviceArray) -> DeviceArray:
    half = math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    x = tangent * dr.rsqrt(1 + tangent * tangent) * (ELEVATION_HALF[sonar.vertical_pattern] * math.pi / half)
    return dr.select(dr.abs(x) > 1e-4, dr.sin(x) / x, 1)
