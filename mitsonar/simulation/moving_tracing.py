"""Echoes of a scene whose bodies move: hits are read in the axes of the body and told in those of the world."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mitsonar.instruments.sonar import Sonar
from mitsonar.plugins.imaging_sonar_sensor import Fan
from mitsonar.plugins.surfaces import Hit, Surfaces
from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.moving_scene import MovingScene, SceneMotion, carried_back
from mitsonar.simulation.tracing import Rays, Tracer

__all__ = ["MovingSurfaces", "MovingTracer", "surfaces_of", "tracer_of"]


@dataclass
class MovingSurfaces(Surfaces):
    """Tables of a scene's shapes, read where bodies have moved.

    Attributes:
        first_object: number below that of the first body's object.
        shape_count: shapes of the scene.
        motion: of the scene.
        versions: of the meshes that deform, when their normals were read.
    """

    first_object: int = 0
    shape_count: int = 0
    motion: SceneMotion | None = None
    versions: tuple[int, ...] = ()

    @classmethod
    def of_motion(cls, motion: SceneMotion, sonar: Sonar) -> MovingSurfaces:
        """Return the tables of the scene that a motion belongs to, for one sonar."""
        tables = cls.of(motion.scene, motion.shapes).heard_by(sonar)
        assert isinstance(tables, MovingSurfaces)
        return replace(tables, first_object=motion.first_objects, shape_count=len(motion.shapes), motion=motion)

    def arrays(self) -> dict[str, DeviceArray]:
        """Return the tables by name, with the normals that meshes have now."""
        deformed = () if self.motion is None else self.motion.deformed
        now = tuple(one.version for one in deformed)
        if now != self.versions:
            for one in deformed:
                self.turn_facets(one.mesh)
            self.versions = now
        return super().arrays()

    def hit(self, scene: mi.Scene | MovingScene, ray: mi.Ray3f, active: DeviceArray = True) -> Hit:
        """Trace rays to the nearest surface; directions are of the world."""
        assert isinstance(scene, MovingScene)
        return self.hit_and_body(scene, ray, active)[0]

    def hit_and_body(self, scene: MovingScene, ray: mi.Ray3f, active: DeviceArray = True) -> tuple[Hit, DeviceArray]:
        """Trace rays to the nearest surface; return the hit in the axes of the world, and the number of the body."""
        hit, body = self.hit_in_body(scene, ray, active)
        return replace(hit, n=carried_back(scene.lines(mi.UInt32(ray.time), body), hit.n)), body

    def hit_in_body(self, scene: MovingScene, ray: mi.Ray3f, active: DeviceArray = True) -> tuple[Hit, DeviceArray]:
        """Trace rays to the nearest surface; return the hit in the axes of its body, and the number of the body."""
        found, body = scene.find(ray, active)
        hit = self.read(found, scene.carried(ray, body), active)
        numbered = (body > 0) & (hit.object_id == 0)
        object_id = dr.select(numbered, mi.Float(body) + float(self.first_object), hit.object_id)
        return replace(hit, object_id=object_id), body

    def own_lattice(self, scene: MovingScene, hit: Hit, body: DeviceArray) -> DeviceArray:
        """Return the number of the lattice of points on each hit: the shape's, of further bodies of one shape their own."""
        number, first = hit.shape_id, 1
        for copies in scene.copies:
            number = dr.select((body > first) & (body < first + copies), self.shape_count + mi.Int32(body), number)
            first += copies
        return number


class MovingTracer(Tracer):
    """Trace the echoes of a scene whose bodies move.

    Args:
        motion: of the scene.
        sonar: the instrument.
    """

    def __init__(self, motion: SceneMotion, sonar: Sonar) -> None:
        super().__init__(motion.scene, sonar)
        self.motion, self.deforms = motion, bool(motion.deformed)
        self.surfaces = MovingSurfaces.of_motion(motion, sonar)

    def scene_at(self, time_s: ArrayLike) -> MovingScene:
        """Return the scene at the moments of a launch's pings [s]."""
        return self.motion.at(np.ravel(time_s))

    def rays_of(self, rays: Rays, rows: mi.Float, keys: mi.UInt32) -> tuple[mi.Ray3f, Fan]:
        """Return the rays in the world, each with the number of its moment, and their fan."""
        ray, fan = super().rays_of(rays, rows, keys)
        moment: DeviceArray = mi.Float(rays.moment)
        ray.time = moment
        return ray, fan

    def height_m(self, scene: DeviceArray, rows: mi.Float) -> DeviceArray:
        """Return the height of each pose over the still shapes straight below it [m]; nan where there is nothing."""
        assert isinstance(scene, MovingScene)
        return super().height_m(scene.still, rows)


def tracer_of(scene: mi.Scene, sonar: Sonar, motion: SceneMotion | None) -> Tracer:
    """Return what traces a scene for a sonar, with bodies that move or without."""
    return Tracer(scene, sonar) if motion is None else MovingTracer(motion, sonar)


def surfaces_of(scene: mi.Scene, sonar: Sonar, motion: SceneMotion | None) -> Surfaces:
    """Return the tables of a scene's shapes for a sonar, with bodies that move or without."""
    return Surfaces.of(scene).heard_by(sonar) if motion is None else MovingSurfaces.of_motion(motion, sonar)
