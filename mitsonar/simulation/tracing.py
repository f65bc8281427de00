"""How a scene is traced: the rays of a sonar, their echoes, moving bodies, reflected rays and clearances.

Only this file and the plugins call the ray tracer.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import to_world_matrices
from mitsonar.plugins import echo_integrator, imaging_sonar_sensor, surfaces
from mitsonar.plugins.echo_integrator import steep
from mitsonar.plugins.hashed_texture import ROUNDS
from mitsonar.plugins.imaging_sonar_sensor import Fan
from mitsonar.plugins.native_plugins import load_dict
from mitsonar.plugins.surfaces import Hit, Surfaces
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.device import DeviceArray, Frozen, LaunchTables, replayed
from mitsonar.simulation.moving import MovingScene, SceneMotion, carried_back

__all__ = [
    "Buried",
    "Clearance",
    "MovingSurfaces",
    "MovingTracer",
    "Rays",
    "Tracer",
    "buried_in",
    "free_distance",
    "going_on",
    "half_path_rate",
    "height_below",
    "hidden",
    "lambert_direction",
    "mirrored_lines",
    "overlap",
    "reflected",
    "surfaces_of",
    "tracer_of",
]


OFF_SURFACE = 1e-5
"""Offset of a ray's origin from a surface, as a fraction of the coordinates: ten times their rounding error."""


class Rays:
    """Indices of the rays of a launch: their ping, beam, row, column and film pixel.

    Rays are numbered down strips of a few columns, so that rays traced together are neighbours.

    Attributes:
        ping: index of the ray's ping in the launch.
        moment: index of the ray's pose in the launch: that of its ping, or of its group of beams.
        ray: index of the ray in its ping.
        column: index of the ray across the fan, ``beam * across + k``.
        row: index of the ray over elevation; 0 is the highest.
        beam: index of the beam that the ray belongs to.
        film: pixel of the ray on the sensor's film.

    Args:
        sonar: the instrument.
        index: ray numbers in the launch, as returned by :meth:`numbered`.
    """

    def __init__(self, sonar: Sonar, index: mi.UInt32) -> None:
        # 1. Ping, and place of the ray in its strip: rays run along the rows of a strip, then down.
        wide = strip_columns(sonar)
        self.ping, self.ray = index // sonar.rays, index % sonar.rays
        strip, offset = self.ray // (wide * sonar.rays_per_beam), self.ray % (wide * sonar.rays_per_beam)
        self.column, self.row = strip * wide + offset % wide, offset // wide
        self.beam = self.column // sonar.across
        # 2. Pose: one for each ping, or one for each group of beams of a ping.
        self.moment = self.ping
        if sonar.ping_groups > 1:
            # as in group_of_beams
            beam, groups = self.beam, sonar.ping_groups
            if sonar.group_order == "interleaved_starboard":
                beam = sonar.beams - 1 - beam
            group = beam * groups // sonar.beams if sonar.group_order == "sequential" else beam % groups
            self.moment = self.ping * groups + group
        self.film = self.row * sonar.columns + self.column

    @staticmethod
    def numbered(sonar: Sonar, pings: int) -> mi.UInt32:
        """Return 0, 1, 2 ... for all rays of a launch, as an evaluated array.

        A frozen launch derives its width from its inputs. Without an input as wide as the launch, Dr.Jit 1.5 infers the
        width from any input that divides it, including the data of virtual calls, and a replay can lose rays.
        """
        index = dr.arange(mi.UInt32, pings * sonar.rays)
        dr.make_opaque(index)
        return index


def strip_columns(sonar: Sonar) -> int:
    """Return the columns of a strip: a power of two that divides all columns and makes 16 rays nearly square."""
    across = sonar.beam_width_rad / sonar.across
    down = math.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam
    columns = 2 ** min(4, max(0, round(math.log2(math.sqrt(16 * down / across)))))
    return math.gcd(columns, sonar.columns)


class Tracer:
    """Ray tracer of a scene for one sonar.

    Attributes:
        notes: warnings about the scene's BSDFs and materials.
        deforms: whether a body deforms, which limits a launch to one moment.
    """

    deforms = False

    def __init__(self, scene: mi.Scene, sonar: Sonar) -> None:
        self.scene = scene
        self.sonar = sonar
        given = {name: value for name, value in sonar.model_dump(exclude={"name"}).items() if value is not None}
        self.sensor: imaging_sonar_sensor.ImagingSonar = load_dict({"type": "imaging_sonar", **given})
        self.surfaces = surfaces.Surfaces.from_scene(scene).at_frequency_of(sonar)
        self.notes = self.surfaces.notes

    def inputs(self, poses: ArrayLike, numbers: Sequence[int]) -> tuple[mi.Float, mi.UInt32, LaunchTables]:
        """Return the inputs of a launch: poses as rows of ``to_world``, jitter keys, and surface tables.

        Args:
            poses: ``(pings, 6)``, or ``(pings, groups, 6)`` where groups of beams ping one after another.
            numbers: numbers of the pings, which determine their jitter.
        """
        matrices = to_world_matrices(np.reshape(poses, (-1, 6)))[:, :3].astype(np.float32)
        keys = [self.sensor.key(number) for number in numbers]
        # Copy: NumPy memory has arbitrary alignment, and a frozen launch is recorded again for each alignment.
        return mi.Float(matrices.ravel().tolist()), mi.UInt32(keys), self.surfaces.arrays()

    def rays_of(self, rays: Rays, rows: mi.Float, keys: mi.UInt32) -> tuple[mi.Ray3f, imaging_sonar_sensor.Fan]:
        """Return the rays in world coordinates, and their fan with directions in world axes."""
        fan = self.sensor.fan(rays.column, rays.row, dr.gather(mi.UInt32, keys, rays.ping))
        lines = [dr.gather(mi.Vector4f, rows, rays.moment * 3 + axis) for axis in range(3)]
        fan = fan.carried(lines)
        return mi.Ray3f(mi.Point3f(*(line.w for line in lines)), fan.d), fan

    def echoes(self, scene: DeviceArray, ray: mi.Ray3f, fan: imaging_sonar_sensor.Fan, tables: LaunchTables) -> Echoes:
        """Trace the rays returned by :meth:`rays_of`; the echoes are not evaluated yet."""
        edges = self.sonar.model == "physical"
        return echo_integrator.Echo.measure(scene, replace(self.surfaces, **tables), ray, fan, edges=edges)

    def scene_at(self, time_s: ArrayLike) -> DeviceArray:
        """Return the scene to trace at the moments of a launch's pings [s]; a static scene is always the same."""
        return self.scene

    def film_echoes(self, pose: ArrayLike, ping: int, time_s: float = 0.0) -> Echoes:
        """Trace one ping and return its echoes as NumPy arrays ``(rays_per_beam * columns,)``, in film order.

        All beams ping at the same time.
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
        """Return the height of each pose above the surface straight below it [m]; nan where there is none."""
        line = dr.arange(mi.UInt32, dr.width(rows) // 12) * 3
        return height_below(scene, mi.Point3f(*(dr.gather(mi.Vector4f, rows, line + axis).w for axis in range(3))))


def height_below(scene: mi.Scene, place: mi.Point3f) -> DeviceArray:
    """Return the height of points above the surface straight below them [m]; nan where there is none."""
    intersection = scene.ray_intersect_preliminary(mi.Ray3f(place, mi.Vector3f(0, 0, -1)))
    return dr.select(intersection.is_valid(), intersection.t, dr.nan)


def free_distance(scene: DeviceArray, ray: mi.Ray3f) -> DeviceArray:
    """Return the distance to the nearest surface along rays [m]; infinite where there is none."""
    intersection = scene.ray_intersect_preliminary(ray)
    return dr.select(intersection.is_valid(), intersection.t, dr.inf)


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
        scene: the scene to trace.
        point: points on the surface [m].
        normal: unit normal of the surface at each point; its sign does not matter.
        u: unit direction from the receiver to the point.
        distance: distance from the receiver to the point [m].
        active: which points to test.
        moment: index of the moment of each ray in a moving scene; default: 0, or a static scene.
    """
    # start off the surface, on the receiver's side, so that the ray does not hit the surface itself
    size = dr.select(dr.abs(point.x) > dr.abs(point.y), dr.abs(point.x), dr.abs(point.y)) + dr.abs(point.z)
    off = (1 + size) * OFF_SURFACE
    begin = point + normal * dr.select(dr.dot(normal, u) > 0, -off, off)
    ray = mi.Ray3f(begin, -u)
    ray.maxt = distance * (1 - mi.math.ShadowEpsilon)
    if moment is not None:
        ray.time = moment
    return scene.ray_test(ray, True, active)  # type: ignore[call-overload]  # the stubs want mi.Bool for coherent


# ---------------- Scenes with moving bodies


@dataclass
class MovingSurfaces(Surfaces):
    """Surface tables of a scene with moving bodies.

    Hits are read in the axes of the body and returned in those of the world.

    Attributes:
        first_object: object number just below that of the first body.
        motion: motion of the scene.
        versions: version of each deforming mesh at which its normals were last read.
    """

    first_object: int = 0
    motion: SceneMotion | None = None
    versions: tuple[int, ...] = ()

    @classmethod
    def from_motion(cls, motion: SceneMotion, sonar: Sonar) -> MovingSurfaces:
        """Return the tables of the scene that a motion belongs to, for one sonar's frequency and model."""
        tables = cls.from_scene(motion.scene, motion.shapes).at_frequency_of(sonar)
        assert isinstance(tables, MovingSurfaces)
        return replace(tables, first_object=motion.first_objects, motion=motion)

    def arrays(self) -> dict[str, DeviceArray]:
        """Return the tables by name, after updating the normals of meshes that have deformed."""
        deformed = () if self.motion is None else self.motion.deformed
        versions = tuple(one.version for one in deformed)
        if versions != self.versions:
            for one in deformed:
                self.turn_facets(one.mesh)
            self.versions = versions
        return super().arrays()

    def hit(
        self, scene: mi.Scene | MovingScene, ray: mi.Ray3f, active: DeviceArray = True, *, attached: bool = False
    ) -> Hit:
        """Trace rays to the nearest surface and return the hit in world axes; bodies that move have no derivatives."""
        assert isinstance(scene, MovingScene)
        assert not attached
        return self.hit_and_body(scene, ray, active)[0]

    def hit_and_body(self, scene: MovingScene, ray: mi.Ray3f, active: DeviceArray = True) -> tuple[Hit, DeviceArray]:
        """Trace rays to the nearest surface; return the hit in world axes and the number of the body."""
        hit, body = self.hit_in_body(scene, ray, active)
        return replace(hit, n=carried_back(scene.lines(mi.UInt32(ray.time), body), hit.n)), body

    def hit_in_body(self, scene: MovingScene, ray: mi.Ray3f, active: DeviceArray = True) -> tuple[Hit, DeviceArray]:
        """Trace rays to the nearest surface; return the hit in the axes of its body and the number of the body."""
        intersection, body = scene.find(ray, active)
        hit = self.read(intersection, scene.carried(ray, body), active)
        numbered = (body > 0) & (hit.object_id == 0)
        object_id = dr.select(numbered, mi.Float(body) + float(self.first_object), hit.object_id)
        return replace(hit, object_id=object_id), body

    def grain_on(self, scene: MovingScene, hit: Hit, body: DeviceArray) -> DeviceArray:
        """Return the key of the scatterers of each hit: that of the shape, or a new one for further bodies of one shape."""
        key, first = self.grain(hit), 1
        for copies in scene.copies:
            key = dr.select((body > first) & (body < first + copies), key + mi.UInt32(body) * mi.UInt32(0x9E3779), key)
            first += copies
        return key


class MovingTracer(Tracer):
    """Ray tracer of a scene with moving bodies, for one sonar.

    Args:
        motion: motion of the scene.
        sonar: the instrument.
    """

    def __init__(self, motion: SceneMotion, sonar: Sonar) -> None:
        super().__init__(motion.scene, sonar)
        self.motion, self.deforms = motion, bool(motion.deformed)
        self.surfaces = MovingSurfaces.from_motion(motion, sonar)

    def scene_at(self, time_s: ArrayLike) -> MovingScene:
        """Return the scene at the moments of a launch's pings [s]."""
        return self.motion.scene_at(np.ravel(time_s))

    def rays_of(self, rays: Rays, rows: mi.Float, keys: mi.UInt32) -> tuple[mi.Ray3f, Fan]:
        """Return the rays in world coordinates, each carrying the index of its moment as its time, and their fan."""
        ray, fan = super().rays_of(rays, rows, keys)
        moment: DeviceArray = mi.Float(rays.moment)
        ray.time = moment
        return ray, fan

    def height_m(self, scene: DeviceArray, rows: mi.Float) -> DeviceArray:
        """Return the height of each pose above the static shapes straight below it [m]; nan where there is none."""
        assert isinstance(scene, MovingScene)
        return super().height_m(scene.still, rows)


def tracer_of(scene: mi.Scene, sonar: Sonar, motion: SceneMotion | None) -> Tracer:
    """Return the tracer of a scene for a sonar, with or without moving bodies."""
    return Tracer(scene, sonar) if motion is None else MovingTracer(motion, sonar)


def surfaces_of(scene: mi.Scene, sonar: Sonar, motion: SceneMotion | None) -> Surfaces:
    """Return the surface tables of a scene for a sonar, with or without moving bodies."""
    return Surfaces.from_scene(scene).at_frequency_of(sonar) if motion is None else MovingSurfaces.from_motion(motion, sonar)


# ---------------- Reflected and scattered rays


FLATTEST = 0.02
"""Smallest cosine to the normal used to place the origin of the next ray: it bounds the offset of grazing rays."""

HALF_LOG_2 = math.log(2) / 2


def reflected(v: DeviceArray, normal: DeviceArray) -> DeviceArray:
    """Reflect vectors in a mirror with the given unit normal."""
    return v - normal * (2 * dr.dot(normal, v))


def going_on(place: DeviceArray, direction: DeviceArray, normal: DeviceArray) -> DeviceArray:
    """Return how far along its direction the next ray must begin to clear the surface that it leaves [m]."""
    size = dr.select(dr.abs(place.x) > dr.abs(place.y), dr.abs(place.x), dr.abs(place.y)) + dr.abs(place.z)
    along: DeviceArray = dr.abs(dr.dot(normal, direction))
    return (1 + size) * OFF_SURFACE / dr.select(along > FLATTEST, along, FLATTEST)


def lambert_direction(normal: DeviceArray, d: DeviceArray, ray: DeviceArray, key: DeviceArray) -> mi.Vector3f:
    """Draw scattered directions by Lambert's law on the side of a surface that rays meet, from a hash.

    Args:
        normal: unit normal of the surface; its sign does not matter.
        d: directions of the incident rays.
        ray: number of each ray.
        key: 32-bit key of the draw.
    """
    first, second = mi.sample_tea_32(ray, key, ROUNDS)
    sample = mi.Point2f((mi.Float(first >> 8) + 0.5) * 2.0**-24, (mi.Float(second >> 8) + 0.5) * 2.0**-24)
    facing: DeviceArray = mi.Vector3f(normal * dr.select(dr.dot(normal, d) > 0, -1.0, 1.0))
    drawn: DeviceArray = mi.warp.square_to_cosine_hemisphere(sample)
    return mi.Vector3f(mi.Frame3f(facing).to_world(drawn))


def mirrored_lines(lines: list[list[Any]], normal: DeviceArray, place: DeviceArray) -> list[list[Any]]:
    """Return the rows of ``to_world`` of a sonar's image in a plane mirror, in double precision.

    Args:
        lines: the sonar's ``to_world``, three rows of four numbers.
        normal: normal of the mirror, of any length.
        place: a point on the mirror [m].
    """
    n: DeviceArray = mi.Vector3d(normal)
    n = n * dr.rsqrt(dr.squared_norm(n))
    columns: list[DeviceArray] = [mi.Vector3d(*(line[column] for line in lines)) for column in range(4)]
    turned = [reflected(column, n) for column in columns[:3]]
    turned.append(columns[3] - n * (2 * dr.dot(n, columns[3] - mi.Vector3d(place))))
    return [[column[row] for column in turned] for row in range(3)]


def overlap(sonar: Sonar, apart: DeviceArray) -> DeviceArray:
    """Return a beam's amplitude for a path that leaves and arrives at different bearings.

    The amplitude is relative to a path that leaves and arrives in the middle of both. The product of two Gaussian main
    lobes, one steered to each end, equals a lobe in the middle times this factor.

    Args:
        sonar: the instrument, with its beam width and pattern.
        apart: difference between the sines of both bearings.
    """
    lobes = 1 if sonar.beam_pattern == "two_way" else 2
    return dr.exp(dr.square(apart * (1 / sonar.beam_width_rad)) * (-HALF_LOG_2 * lobes))


def half_path_rate(
    range_m: DeviceArray, d: DeviceArray, turn: DeviceArray, u: DeviceArray, normal: DeviceArray
) -> DeviceArray:
    """Return the derivative of half a path by an angle of its ray, on the tangent plane [m/rad].

    Args:
        range_m: range along the ray [m].
        d: direction of the ray.
        turn: derivative of the direction by the angle.
        u: unit direction from the other end of the path to the point hit.
        normal: unit normal of the surface at that point.
    """
    along = -range_m * dr.dot(normal, turn) / steep(dr.dot(normal, d))
    return (along + dr.dot(u, d * along + turn * range_m)) * 0.5


# ---------------- Clearance of vehicles and buried poses


AROUND = np.array([way for way in itertools.product((-1, 0, 1), repeat=3) if any(way)], dtype=float)
"""Directions in which to search for surfaces: towards the faces, edges and corners of a cube."""


class Clearance:
    """Clearance of vehicles to the nearest surface, traced for all of them in one launch.

    Args:
        tracer: tracer of the scene.
    """

    def __init__(self, tracer: Tracer) -> None:
        self.tracer = tracer
        self._directions = AROUND / np.linalg.norm(AROUND, axis=1, keepdims=True)
        self._launches: dict[int, Callable[..., Any]] = {}

    def of(
        self, before: NDArray[np.float64], after: NDArray[np.float64], time_s: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the distance to the nearest surface in 26 directions and along the path travelled ``(n,)`` [m].

        The distance is negative if the path passed through a surface. Thin objects between the directions are missed.

        Args:
            before: positions that the vehicles came from ``(n, 3)`` [m].
            after: positions of the vehicles ``(n, 3)`` [m].
            time_s: time of each position, at which moving bodies are placed ``(n,)`` [s].
        """
        count = len(after)
        if self.tracer.deforms and count > 1:  # a launch holds one state of each deforming body
            each = (slice(number, number + 1) for number in range(count))
            return np.concatenate([self.of(before[one], after[one], time_s[one]) for one in each])
        # direction of travel; straight down for a vehicle that did not move
        displacement = after - before
        travelled = np.linalg.norm(displacement, axis=1)
        ahead = np.where(travelled[:, None] > 0, displacement / np.maximum(travelled, 1e-12)[:, None], (0.0, 0.0, -1.0))
        # 26 rays from where each vehicle is, and one from where it was
        directions = np.concatenate(
            [np.broadcast_to(self._directions, (count, *self._directions.shape)), ahead[:, None]], axis=1
        )
        begin = np.concatenate([np.repeat(after[:, None], len(self._directions), axis=1), before[:, None]], axis=1)
        # trace; the launch is recorded once for each number of vehicles
        if count not in self._launches:
            self._launches[count] = Frozen(self._traced)
        number = mi.Float(np.repeat(np.arange(count), directions.shape[1]).astype(np.float32).tolist())
        rays = [mi.Float(part.ravel().astype(np.float32).tolist()) for part in (begin, directions)]
        free = replayed(self._launches[count], self.tracer.scene_at(time_s), number, *rays)
        distance = np.array(free, dtype=float).reshape(directions.shape[:2])
        distance[:, -1] -= travelled  # the last ray began at the old position
        return np.asarray(distance.min(axis=1))

    def straight(self, places: NDArray[np.float64], direction: tuple[float, float, float]) -> NDArray[np.float64]:
        """Return the distance from positions ``(n, 3)`` to the surface in one direction ``(n,)`` [m], at time 0; or inf."""
        begin = mi.Point3f(*(mi.Float(column.astype(np.float32).tolist()) for column in places.T))
        distance = free_distance(self.tracer.scene_at(np.zeros(len(places))), mi.Ray3f(begin, mi.Vector3f(*direction)))
        return np.array(distance, dtype=float)

    @staticmethod
    def _traced(scene: DeviceArray, number: mi.Float, begin: mi.Float, directions: mi.Float) -> DeviceArray:
        """Trace the rays of all vehicles; a ray carries the index of its vehicle, which is its moment, as its time."""
        index = dr.arange(mi.UInt32, dr.width(number))
        ray = mi.Ray3f(dr.gather(mi.Point3f, begin, index), dr.gather(mi.Vector3f, directions, index))
        time: DeviceArray = number
        ray.time = time
        return free_distance(scene, ray)


SEA_SURFACE = "surface"
"""Id of the sea surface in generated worlds; a pose below it is in the water."""


class Buried(NamedTuple):
    """A pose below the ground or inside an object.

    Attributes:
        frame: index of the pose.
        frames: number of such poses in total.
        text: predicate of a sentence that describes the fault.
        inside: whether the pose is inside an object.
    """

    frame: int
    frames: int
    text: str
    inside: bool


def buried_in(scene: mi.Scene, poses: NDArray[np.float64]) -> Buried | None:
    """Find poses below the ground or inside an object, where a ray straight up meets the back of a surface.

    Below the ground, a ray straight down meets nothing; inside an object, it meets the back of the same shape. Surfaces
    whose normals point down and moving scenes are not judged.

    Args:
        scene: a static scene.
        poses: poses of the sonar or vehicle ``(n, 6)`` [m, rad].

    Returns:
        The first such pose; None if all poses are in the water, or nothing shows that they are not.
    """
    # 1. Trace straight up and down from each pose; most often no ray meets the back of a surface.
    places = np.asarray(poses, dtype=float)[:, :3]
    begin = mi.Point3f(*(mi.Float(column.astype(np.float32).tolist()) for column in places.T))
    above, below = (scene.ray_intersect(mi.Ray3f(begin, mi.Vector3f(0, 0, direction))) for direction in (1, -1))
    roofed = np.array(above.is_valid()) & (np.array(above.n)[2] > 0)
    open_below = ~np.array(below.is_valid())
    if not roofed.any():
        return None
    # 2. Identify the shapes met, by their numbers in the registry of Dr.Jit.
    shapes = [dr.reinterpret_array(mi.UInt32, hit.shape) for hit in (above, below)]
    names = {
        number: shape.id()
        for shape in scene.shapes()
        for number in np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))
    }
    up, down = (np.array(number) for number in shapes)
    # 3. A back above means buried if nothing, or the back of the same shape, lies below; the sea surface does not count.
    wet = np.array([names.get(int(number), "") == SEA_SURFACE for number in up])
    inside = (up == down) & ~open_below & (np.array(below.n)[2] < 0)
    buried = np.flatnonzero(roofed & ~wet & (open_below | inside))
    if not len(buried):
        return None
    # 4. Describe the first of them.
    first = int(buried[0])
    x, y, z = places[first]
    where, name = f"at ({x:g}, {y:g}, {z:g}) m", names.get(int(up[first]), "")
    if inside[first]:
        return Buried(
            first, len(buried), inside=True, text=f"{where} is inside {f'the shape {name}' if name else 'an object'}"
        )
    depth = float(np.array(above.t)[first])
    ground = f"the ground, the shape {name}," if name else "the ground"
    text = f"{where} is {depth:.3g} m below {ground} at z = {z + depth:.3g} m (z points up)"
    return Buried(first, len(buried), text, inside=False)
