"""The beam that a direction lies in: bearing, elevation and index, for echoes that come another way than their ray."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.device_arrays import DeviceArray

__all__ = ["angles_of", "beam_at", "beam_of"]


def beam_of(
    sonar: Sonar, starboard: DeviceArray, forward: DeviceArray, up: DeviceArray
) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Return beam, whether the direction lies in the field of view, and elevation [rad]."""
    bearing, elevation = angles_of(sonar, starboard, forward, up)
    beam, inside = beam_at(sonar, bearing)
    lift: DeviceArray = dr.abs(elevation)
    inside &= lift <= math.radians(sonar.elevation_fov_deg) / 2
    return beam, inside, elevation


def angles_of(
    sonar: Sonar, starboard: DeviceArray, forward: DeviceArray, up: DeviceArray
) -> tuple[DeviceArray, DeviceArray]:
    """Return bearing and elevation of unit directions [rad]."""
    if sonar.bearing == "azimuth":
        return dr.atan2(starboard, forward), _asin(up)
    return _asin(starboard), dr.atan2(up, forward)


def beam_at(sonar: Sonar, bearing: DeviceArray) -> tuple[DeviceArray, DeviceArray]:
    """Return the beam at bearings [rad], and whether they lie in one."""
    place: DeviceArray
    half = math.radians(sonar.azimuth_fov_deg) / 2
    if sonar.beam_layout == "even":
        place = bearing * (sonar.beams / (2 * half)) + sonar.beams / 2
    else:
        place = dr.sin(bearing) * (sonar.beams / (2 * math.sin(half))) + sonar.beams / 2
    aside: DeviceArray = dr.abs(bearing)
    inside = (place >= 0) & (place < sonar.beams) & (aside <= half)
    beam = mi.UInt32(dr.select(inside, place, 0))
    if sonar.beam_width_deg is not None and sonar.model == "physical":
        part = (mi.Float(beam) + (0.5 - sonar.beams / 2)) * (2 / sonar.beams)  # a table would be no input of the launch
        axis = part * half if sonar.beam_layout == "even" else dr.asin(part * math.sin(half))
        away: DeviceArray = dr.abs(bearing - axis)
        inside &= away <= sonar.beam_width_rad / 2
    return beam, inside


def _asin(value: DeviceArray) -> DeviceArray:
    return dr.asin(dr.select(value < 1, dr.select(value > -1, value, -1), 1))
