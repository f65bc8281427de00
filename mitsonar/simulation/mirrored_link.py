"""Ways by mirrors, unfolded: where each leg meets its mirror, whether nothing is in between, what the mirrors leave."""

from __future__ import annotations

import math
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.image_sources import ROW
from mitsonar.simulation.link_geometry import LINK, Leg, LinkGeometry, ScatteringPoints
from mitsonar.simulation.mirror_parts import smooth_share
from mitsonar.simulation.propagation_delay import dot, length
from mitsonar.simulation.tracing import OFF_SURFACE, hidden

__all__ = ["MirroredLink", "PlaneRow", "unfolded"]


class PlaneRow(NamedTuple):
    """One mirror of a way on the device; see :meth:`~mitsonar.simulation.image_sources.MirrorWay.rows`.

    Attributes:
        image: of the transducer by the mirrors before this one, three arrays [m].
        normal: three arrays.
        offset: of the plane [m].
        reflection: coefficient of pressures.
        roughness_m: rms height [m].
        slab_m: how far the mirror's points lie off the plane, at most [m].
        registry: index of the shape.
    """

    image: list[DeviceArray]
    normal: list[DeviceArray]
    offset: DeviceArray
    reflection: DeviceArray
    roughness_m: DeviceArray
    slab_m: DeviceArray
    registry: DeviceArray

    @classmethod
    def of(cls, numbers: list[DeviceArray]) -> PlaneRow:
        """Take the eleven numbers of a row."""
        return cls(numbers[:3], numbers[3:6], *numbers[6:])


def unfolded(
    scene: mi.Scene,
    point: ScatteringPoints,
    image: list[DeviceArray],
    rows: list[PlaneRow],
    wavenumber: float,
    active: DeviceArray,
    moment: DeviceArray = None,
) -> tuple[DeviceArray, DeviceArray]:
    """Follow ways from points back to a transducer by its mirrors.

    Args:
        scene: to trace.
        point: where the ways begin; a normal of 0 where that is no surface.
        image: of the transducer by all mirrors [m].
        rows: the mirrors in the order from the transducer on.
        wavenumber: [rad/m].
        active: ways to follow.
        moment: number of the moment of each way in a scene that moves; default: 0, or a still scene.

    Returns:
        Which ways are open: each leg meets its mirror first, and the last one the transducer. And the product of the
        mirrors' reflection coefficients.
    """
    at, normal, far, factor = point.exact, point.normal, image, mi.Float(1)
    slab: DeviceArray = mi.Float(0)  # of the mirror that a leg leaves; waves in it hide nothing
    for row in reversed(rows):
        above, below = (dot(row.normal, place) - row.offset for place in (at, far))
        size = dr.abs(at[0]) + dr.abs(at[1]) + dr.abs(at[2]) + 1
        # a point on the mirror itself has no way by it
        active = active & (above * below < 0) & (dr.abs(above) > size * OFF_SURFACE + row.slab_m)
        active = active & (dr.abs(below) > row.slab_m)
        part = above / (above - below)
        foot = [a + (b - a) * part for a, b in zip(at, far, strict=True)]
        way = [b - a for a, b in zip(at, foot, strict=True)]
        u = mi.Vector3f(*(axis / length(way) for axis in way))
        active = active & _meets(scene, mi.Point3f(*at) + u * slab, normal, u, row, active, moment)
        normal = mi.Normal3f(*row.normal)
        facing: DeviceArray = mi.Vector3f(*row.normal)
        cosine = dr.abs(dr.dot(facing, u))
        factor = factor * mi.Float(row.reflection) * smooth_share(mi.Float(row.roughness_m), cosine, wavenumber)
        at, far = foot, row.image
        slab = mi.Float(row.slab_m) / cosine
    last = [a - b for a, b in zip(at, far, strict=True)]
    distance = length(last)
    u = mi.Vector3f(*(axis / distance for axis in last))
    start = mi.Point3f(*at) - u * slab
    return active & ~hidden(scene, start, normal, u, mi.Float(distance) - slab, active, moment), factor


def _meets(
    scene: mi.Scene,
    at: DeviceArray,
    normal: DeviceArray,
    u: DeviceArray,
    row: PlaneRow,
    active: DeviceArray,
    moment: DeviceArray = None,
) -> DeviceArray:
    """Test whether rays from points meet a mirror's plane before anything else."""
    off = (1 + dr.abs(at.x) + dr.abs(at.y) + dr.abs(at.z)) * OFF_SURFACE
    ray = mi.Ray3f(at + normal * dr.select(dr.dot(normal, u) > 0, off, -off), u)
    if moment is not None:
        ray.time = moment
    found = scene.ray_intersect_preliminary(ray, coherent=True, active=active)  # type: ignore[call-overload]
    index: DeviceArray = dr.reinterpret_array(mi.UInt32, found.shape)
    met = ray.o + u * found.t
    size = 1 + dr.abs(met.x) + dr.abs(met.y) + dr.abs(met.z)
    # a mesh may have several planes
    aside = dr.abs(dr.dot(mi.Vector3f(*row.normal), met) - mi.Float(row.offset))
    near = 4 * size * OFF_SURFACE + mi.Float(row.slab_m)
    return found.is_valid() & (index == mi.UInt32(row.registry)) & (aside < near)


class MirroredLink(LinkGeometry):
    """Geometry between the images of transmitter and receiver.

    Args:
        sonar: the instrument.
        receiver: its index.
        table: of :func:`~mitsonar.simulation.image_sources.mirrored_table`.
        out: number of mirrors between transmitter and points.
        back: number of mirrors between points and receiver.
    """

    def __init__(self, sonar: ChannelSonar, receiver: int, table: mi.Float64, out: int, back: int) -> None:
        self.out, self.back = out, back
        super().__init__(sonar, receiver, table)
        self.wavenumber = 2 * math.pi / sonar.wavelength_m

    @property
    def size(self) -> int:
        """Return how many numbers the table has."""
        return LINK + (ROW + 1) * (self.out + self.back)

    def reached(
        self, scene: mi.Scene, point: ScatteringPoints, sent: Leg, received: Leg, active: DeviceArray
    ) -> tuple[DeviceArray, DeviceArray]:
        """Return which points sound reaches by the mirrors, there and back, and the mirrors' factor."""
        starts = [LINK + (ROW + 1) * k for k in range(self.out + self.back)]
        rows = [PlaneRow.of(self.numbers[start : start + ROW + 1]) for start in starts]
        active, there = unfolded(scene, point, self.vector(0), rows[: self.out], self.wavenumber, active)
        active, back = unfolded(scene, point, self.vector(3), rows[self.out :], self.wavenumber, active)
        return active, there * back
