"""Scene, sonar and poses to echoes: only this file and the plugins call the ray tracer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import to_world_matrices
from mitsonar.plugins import echo_integrator, imaging_sonar_sensor, surfaces
from mitsonar.plugins.native_plugins import load_dict
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.device_arrays import DeviceArray, LaunchTables

__all__ = ["Rays", "Tracer", "free_way", "height_below", "hidden"]

OFF_SURFACE = 1e-5
"""Distance off a surface at which a shadow ray begins, as a part of the coordinates' size: ten times their rounding."""


class Rays:
    """Number the rays of a launch.

    Rays run down strips of a few columns, so that rays that are traced together are neighbours.

    Attributes:
        ping: number of the ping in the launch.
        moment: number of the pose in the launch: that of the ping, or of its group of beams.
        ray: number of the ray in its ping.
        column: ray across, ``beam * across + k``.
        row: ray over elevation, 0 the highest.
        beam: the sonar's beam that the ray belongs to.
        film: pixel of the ray on the sensor's film.

    Args:
        sonar: the instrument.
        index: numbers of the rays in the launch, of :meth:`numbered`.
    """

    def __init__(self, sonar: Sonar, index: mi.UInt32) -> None:
        wide = strip_columns(sonar)
        self.ping, self.ray = index // sonar.rays, index % sonar.rays
        strip, place = self.ray // (wide * sonar.rays_per_beam), self.ray % (wide * sonar.rays_per_beam)
        self.column, self.row = strip * wide + place % wide, place // wide
        self.beam = self.column // sonar.across
        self.moment = self.ping
        if sonar.ping_groups > 1:
            every = sonar.group_order == "interleaved"
            group = self.beam % sonar.ping_groups if every else self.beam * sonar.ping_groups // sonar.beams
            self.moment = self.ping * sonar.ping_groups + group
        self.film = self.row * sonar.columns + self.column

    @staticmethod
    def numbered(sonar: Sonar, pings: int) -> mi.UInt32:
        """Return 0, 1, 2 ... for all rays of a launch, evaluated: the width of a frozen launch follows from its inputs.

        Without an input as wide as the launch, Dr.Jit 1.5 infers the width from any input that divides it, the
        data of virtual calls too, and a replay can lose rays.
        """
        index = dr.arange(mi.UInt32, pings * sonar.rays)
        dr.make_opaque(index)
        return index


def strip_columns(sonar: Sonar) -> int:
    """Return the columns of a strip: a power of two that divides all columns and makes 16 rays nearly a square."""
    across = sonar.beam_width_rad / sonar.across
    down = math.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam
    wanted = 2 ** min(4, max(0, round(math.log2(math.sqrt(16 * down / across)))))
    return math.gcd(wanted, sonar.columns)


class Tracer:
    """Trace the echoes of a scene for one sonar.

    Attributes:
        notes: what a user should know about the scene's BSDFs and materials.
        deforms: whether a body deforms, so that a launch is of one moment.
    """

    deforms = False

    def __init__(self, scene: mi.Scene, sonar: Sonar) -> None:
        self.scene = scene
        self.sonar = sonar
        given = {name: value for name, value in sonar.model_dump(exclude={"name"}).items() if value is not None}
        self.sensor: imaging_sonar_sensor.ImagingSonar = load_dict({"type": "imaging_sonar", **given})
        self.surfaces = surfaces.Surfaces.of(scene).heard_by(sonar)
        self.notes = self.surfaces.notes

    def inputs(self, poses: ArrayLike, numbers: Sequence[int]) -> tuple[mi.Float, mi.UInt32, LaunchTables]:
        """Return the inputs of a launch: poses as rows of ``to_world``, keys of the jitter, tables of the surfaces.

        ``numbers`` are those of the pings. Poses are ``(pings, 6)``, or ``(pings, groups, 6)`` where groups of beams ping
        one after another.
        """
        matrices = to_world_matrices(np.reshape(poses, (-1, 6)))[:, :3].astype(np.float32)
        keys = [self.sensor.key(number) for number in numbers]
        # copies: memory that NumPy owns is aligned by chance, and a frozen launch is recorded anew for each alignment
        return mi.Float(matrices.ravel().tolist()), mi.UInt32(keys), self.surfaces.arrays()

    def rays_of(self, rays: Rays, rows: mi.Float, keys: mi.UInt32) -> tuple[mi.Ray3f, imaging_sonar_sensor.Fan]:
        """Return the rays in the world, and their fan with its directions in world axes."""
        fan = self.sensor.fan(rays.column, rays.row, dr.gather(mi.UInt32, keys, rays.ping))
        lines = [dr.gather(mi.Vector4f, rows, rays.moment * 3 + axis) for axis in range(3)]
        fan = fan.carried(lines)
        return mi.Ray3f(mi.Point3f(*(line.w for line in lines)), fan.d), fan

    def echoes(self, scene: DeviceArray, ray: mi.Ray3f, fan: imaging_sonar_sensor.Fan, tables: LaunchTables) -> Echoes:
        """Trace the rays of :meth:`rays_of`; the echoes are not evaluated yet."""
        edges = self.sonar.model == "physical"
        return echo_integrator.Echo.measure(scene, replace(self.surfaces, **tables), ray, fan, edges=edges)

    def scene_at(self, time_s: ArrayLike) -> DeviceArray:
        """Return what is traced at the moments of a launch's pings [s]: the scene, for nothing moves here."""
        return self.scene

    def film_echoes(self, pose: ArrayLike, ping: int, time_s: float = 0.0) -> Echoes:
        """Trace one ping and return its echoes as NumPy arrays ``(rays_per_beam * columns,)``, in the order of the film.

        All beams ping at once.
        """
        rays = Rays(self.sonar, Rays.numbered(self.sonar, 1))
        scene = self.scene_at([time_s] * self.sonar.ping_groups)
        rows, keys, tables = self.inputs(np.tile(np.reshape(pose, (1, 1, 6)), (1, self.sonar.ping_groups, 1)), [ping])
        traced = self.echoes(scene, *self.rays_of(rays, rows, keys), tables)
        values = {field.name: dr.zeros(mi.Float, self.sonar.rays) for field in fields(Echoes)}
        for name, target in values.items():
            dr.scatter(target, getattr(traced, name), rays.film)
        dr.eval(values)
        return Echoes(**{name: np.array(value) for name, value in values.items()})

    def height_m(self, scene: DeviceArray, rows: mi.Float) -> DeviceArray:
        """Return the height of each pose over what is straight below it [m]; nan where there is nothing."""
        line = dr.arange(mi.UInt32, dr.width(rows) // 12) * 3
        return height_below(scene, mi.Point3f(*(dr.gather(mi.Vector4f, rows, line + axis).w for axis in range(3))))


def height_below(scene: mi.Scene, place: mi.Point3f) -> DeviceArray:
    """Return the height of points over what is straight below them [m]; nan where there is nothing."""
    found = scene.ray_intersect_preliminary(mi.Ray3f(place, mi.Vector3f(0, 0, -1)))
    return dr.select(found.is_valid(), found.t, dr.nan)


def free_way(scene: DeviceArray, ray: mi.Ray3f) -> DeviceArray:
    """Return the distance to the nearest surface along rays [m]; infinite where there is none."""
    found = scene.ray_intersect_preliminary(ray)
    return dr.select(found.is_valid(), found.t, dr.inf)


def hidden(
    scene: mi.Scene,
    point: DeviceArray,
    normal: DeviceArray,
    u: DeviceArray,
    distance: DeviceArray,
    active: DeviceArray,
    moment: DeviceArray = None,
) -> DeviceArray:
    """Test whether a surface blocks the line between points of a surface and a receiver.

    Args:
        scene: to trace.
        point: on the surface [m].
        normal: unit normal of the surface there; its sign does not matter.
        u: unit direction from the receiver to the point.
        distance: from the receiver to the point [m].
        active: points to test.
        moment: number of the moment of each ray in a scene that moves; default: 0, or a still scene.
    """
    size = dr.select(dr.abs(point.x) > dr.abs(point.y), dr.abs(point.x), dr.abs(point.y)) + dr.abs(point.z)
    off = (1 + size) * OFF_SURFACE
    begin = point + normal * dr.select(dr.dot(normal, u) > 0, -off, off)
    ray = mi.Ray3f(begin, -u)
    ray.maxt = distance * (1 - mi.math.ShadowEpsilon)
    if moment is not None:
        ray.time = moment
    return scene.ray_test(ray, True, active)  # type: ignore[call-overload]  # the stubs want mi.Bool for coherent
