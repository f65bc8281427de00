"""Pattern over elevation: a uniform aperture whose power is one half at the edges of the field of view."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mitsonar.instruments.imaging_sonar import Sonar
from mitsonar.simulation.beam_former import ELEVATION_HALF
from mitsonar.simulation.device_arrays import DeviceArray

__all__ = ["elevation_gain"]


def elevation_gain(sonar: Sonar, tangent: DeviceArray) -> DeviceArray:
    """Return the amplitude at a tangent of the elevation, of a ``mi.Float``: a uniform aperture's, or 1."""
    pattern = sonar.vertical_pattern
    if pattern == "box":
        return mi.Float(1)
    half = math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    x = tangent * dr.rsqrt(1 + tangent * tangent) * (ELEVATION_HALF[pattern] * math.pi / half)
    one_way = dr.select(dr.abs(x) > 1e-4, dr.sin(x) / x, 1)
    return one_way * one_way if pattern == "two_way" else one_way
