"""Rays that go on from a surface: as from a mirror, or drawn from Lambert's law; and both ends of a path in one beam."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsonar.instruments.sonar import Sonar
from mitsonar.plugins.hashed_texture import ROUNDS
from mitsonar.simulation.device_arrays import DeviceArray

__all__ = ["going_on", "lambert_direction", "mirrored_lines", "overlap", "reflected"]

OFF_SURFACE = 1e-5
"""Distance off a surface at which the next ray begins, as a part of the coordinates' size: ten times their rounding."""

FLATTEST = 0.02
"""Cosine to the normal below which the next ray begins no farther along its direction."""

HALF_LOG_2 = math.log(2) / 2


def reflected(v: DeviceArray, normal: DeviceArray) -> DeviceArray:
    """Return vectors as a mirror of that unit normal turns them."""
    return v - normal * (2 * dr.dot(normal, v))


def going_on(place: DeviceArray, direction: DeviceArray, normal: DeviceArray) -> DeviceArray:
    """Return the distance along a direction at which the next ray begins, clear of the surface that it leaves [m]."""
    size = dr.select(dr.abs(place.x) > dr.abs(place.y), dr.abs(place.x), dr.abs(place.y)) + dr.abs(place.z)
    along: DeviceArray = dr.abs(dr.dot(normal, direction))
    return (1 + size) * OFF_SURFACE / dr.select(along > FLATTEST, along, FLATTEST)


def lambert_direction(normal: DeviceArray, d: DeviceArray, ray: DeviceArray, key: DeviceArray) -> mi.Vector3f:
    """Draw directions by Lambert's law around the side of a surface that rays meet, from a hash.

    Args:
        normal: unit normal of the surface; its sign does not matter.
        d: of the rays that meet it.
        ray: number of each ray.
        key: of the draw, 32 bits.
    """
    first, second = mi.sample_tea_32(ray, key, ROUNDS)
    place = mi.Point2f((mi.Float(first >> 8) + 0.5) * 2.0**-24, (mi.Float(second >> 8) + 0.5) * 2.0**-24)
    facing: DeviceArray = mi.Vector3f(normal * dr.select(dr.dot(normal, d) > 0, -1.0, 1.0))
    drawn: DeviceArray = mi.warp.square_to_cosine_hemisphere(place)
    return mi.Vector3f(mi.Frame3f(facing).to_world(drawn))


def mirrored_lines(lines: list[list[Any]], normal: DeviceArray, place: DeviceArray) -> list[list[Any]]:
    """Return the rows of a sonar's ``to_world`` as a plane mirror shows it, in double precision.

    Args:
        lines: three rows of four numbers.
        normal: of the mirror.
        place: a point on it [m].
    """
    n: DeviceArray = mi.Vector3d(normal)
    n = n * dr.rsqrt(dr.squared_norm(n))
    columns: list[DeviceArray] = [mi.Vector3d(*(line[column] for line in lines)) for column in range(4)]
    turned = [reflected(column, n) for column in columns[:3]]
    turned.append(columns[3] - n * (2 * dr.dot(n, columns[3] - mi.Vector3d(place))))
    return [[column[row] for column in turned] for row in range(3)]


def overlap(sonar: Sonar, apart: DeviceArray) -> DeviceArray:
    """Return the amplitude that a beam has for a path whose ends are ``apart``, relative to a path in the middle of both.

    Two beams of Gaussian main lobes, one steered to each end, make one in the middle times this. ``apart`` is a difference
    of sines of the bearing.
    """
    ways = 1 if sonar.beam_pattern == "two_way" else 2
    return dr.exp(dr.square(apart * (1 / sonar.beam_width_rad)) * (-HALF_LOG_2 * ways))
