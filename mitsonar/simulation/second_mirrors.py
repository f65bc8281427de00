"""The way back by another mirror than the way out: image sources of the sonar behind the planes of a scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsonar.plugins.surfaces import registry_index
from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.link_geometry import ScatteringPoints
from mitsonar.simulation.mirror_parts import Mirroring, Mirrors, mirror_of
from mitsonar.simulation.mirror_planes import MirrorPlane, mirror_planes
from mitsonar.simulation.mirrored_link import PlaneRow, unfolded

__all__ = ["SecondMirror", "SecondMirrors", "WayBack", "second_notes"]

MOST_SECOND = 8
"""Planes that are looked through for the way back, at most: each costs two rays for every ray."""

ON_PLANE = 1e-4
"""Part of its distance from the origin by which a point may lie off a plane that it is on."""


@dataclass(frozen=True)
class SecondMirror:
    """A plane of a mirror, and the index of its shape by which kernels know it."""

    plane: MirrorPlane
    registry: int

    @property
    def normal(self) -> mi.Vector3d:
        """Return the unit normal."""
        return mi.Vector3d(*self.plane.normal.tolist())

    @property
    def place(self) -> mi.Vector3d:
        """Return a point on the plane [m]."""
        return mi.Vector3d(*(self.plane.normal * self.plane.offset).tolist())


@dataclass(frozen=True)
class WayBack:
    """The way from points back to the sonar by one plane.

    Attributes:
        mirror: the plane.
        u: direction from the image of the sonar to the points.
        distance: from that image [m].
        factor: amplitude that the mirror leaves.
        is_open: whether nothing is in between, and the plane is not that of the way out.
    """

    mirror: SecondMirror
    u: DeviceArray
    distance: DeviceArray
    factor: DeviceArray
    is_open: DeviceArray


@dataclass(frozen=True)
class SecondMirrors:
    """Planes for the way back.

    Attributes:
        mirrors: the planes.
        wavenumber: of the carrier [1/m].
    """

    mirrors: tuple[SecondMirror, ...]
    wavenumber: float

    @classmethod
    def of(cls, scene: mi.Scene, mirrors: Mirrors | None, wavenumber: float) -> SecondMirrors | None:
        """Find the planes of a scene's mirrors; None where there are not two, or more than :data:`MOST_SECOND`."""
        planes = mirror_planes(scene, mirrors)
        if not 2 <= len(planes) <= MOST_SECOND:
            return None
        shapes = scene.shapes()
        return cls(tuple(SecondMirror(plane, registry_index(shapes[plane.shape])) for plane in planes), wavenumber)

    def ways(
        self,
        scene: DeviceArray,
        origin: DeviceArray,
        point: tuple[DeviceArray, DeviceArray],
        first: tuple[DeviceArray, DeviceArray],
        active: DeviceArray,
        moment: DeviceArray = None,
    ) -> Iterator[WayBack]:
        """Yield the way back by each plane.

        Args:
            scene: to trace.
            origin: place of the sonar [m].
            point: place and normal where rays meet a rough surface.
            first: place and normal where they met their mirror.
            active: rays to follow.
            moment: number of the moment of each ray in a scene that moves.
        """
        place, normal = point
        exact = [mi.Float64(value) for value in place]
        sonar: DeviceArray = mi.Vector3d(origin)
        scattering = ScatteringPoints(mi.Point3f(place), exact, normal)
        for mirror in self.mirrors:
            plane, facing = mirror.plane, mirror.normal
            image = sonar - facing * (2 * (dr.dot(facing, sonar) - plane.offset))
            way: DeviceArray = mi.Vector3d(*exact) - image
            distance = dr.norm(way)
            row = PlaneRow(
                image=list(sonar),
                normal=[mi.Float64(value) for value in plane.normal.tolist()],
                offset=mi.Float64(plane.offset),
                reflection=mi.Float64(plane.reflection),
                roughness_m=mi.Float64(plane.roughness_m),
                slab_m=mi.Float64(0),
                registry=mi.UInt32(mirror.registry),
            )
            other = active & ~_on(plane, *first)
            is_open, factor = unfolded(scene, scattering, list(image), [row], self.wavenumber, other, moment)
            yield WayBack(mirror, mi.Vector3f(way / distance), mi.Float(distance), factor, is_open)


def _on(plane: MirrorPlane, place: DeviceArray, normal: DeviceArray) -> DeviceArray:
    """Test whether mirrors that rays met lie in a plane."""
    facing: DeviceArray = mi.Vector3f(*plane.normal.tolist())
    along: DeviceArray = dr.abs(dr.dot(facing, normal))
    off: DeviceArray = dr.abs(dr.dot(facing, place) - plane.offset)
    size = float(1 + np.abs(plane.offset))
    return (along > 1 - ON_PLANE) & (off < ON_PLANE * (size + dr.norm(place)))


def second_notes(scene: mi.Scene, mirrors: Mirroring) -> list[str]:
    """Return a sentence where mirrors have too many planes for ways by one there and another back."""
    count = len(mirror_planes(scene, mirror_of(scene, mirrors)))
    if count <= MOST_SECOND:
        return []
    return [
        f"the mirrors have {count} planes: ghosts by way of one there and another back are for {MOST_SECOND} at most, and "
        "are left out"
    ]
