"""Echoes of a scene at a receiver: delay and amplitude of each, from scatterers in the world or from rays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mitsonar.acoustics.water import delay_exact, delay_iterated
from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import PADDING, ChannelSonar, FieldOfView, Maths
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.plugins.bsdf_reflectance import is_black, reflectances_of, reflectivity_at
from mitsonar.plugins.cell_noise import CellNoise
from mitsonar.plugins.hashed_texture import ROUNDS
from mitsonar.plugins.surfaces import Surfaces, grain_key, registry_index
from mitsonar.simulation.device import DeviceArray, Frozen, LaunchTables, clipped, padded, replayed
from mitsonar.simulation.mirrors import (
    ROW,
    FlatMirrors,
    Mirrors,
    MirrorSequence,
    PlaneRow,
    ScatteringPoints,
    flat_mirrors,
    mirror_sequences,
    unfolded,
)
from mitsonar.simulation.moving import MovingScene, SceneMotion
from mitsonar.simulation.points import Patches, SurfacePoints, lattice_points, lattice_size
from mitsonar.simulation.shape_pieces import triangles_of
from mitsonar.simulation.tracing import height_below, hidden

__all__ = [
    *("DIRECT", "ChannelTracer", "EchoBatch", "EchoValues", "LinkGeometry", "Moment", "ScattererPath", "Scatterers"),
    *("absorption_rate", "link_table", "refuse_instances"),
]


EchoValues: TypeAlias = dict[str, NDArray[Any]]
"""Fields of :class:`EchoBatch` keyed by name, as NumPy arrays ``(points,)``."""

_Launch: TypeAlias = Callable[..., list[DeviceArray]]
"""A frozen launch, which maps indices, scene, link table and source tables to values."""


class ScattererPath(NamedTuple):
    """Mirrors between transmitter and scatterers, and between receiver and scatterers.

    Attributes:
        out: mirrors on the way out.
        back: mirrors on the way back, from the receiver.
        body: number of the moving body that the scatterers lie on, from 1; 0: still shapes.
        target: name of that body.
    """

    out: MirrorSequence = MirrorSequence()
    back: MirrorSequence = MirrorSequence()
    body: int = 0
    target: str = "scatterer"

    @property
    def name(self) -> str:
        """Return the names of what sound meets in turn, such as ``surface-scatterer-seabed``."""
        return "-".join([name for name in (self.out.name, self.target, MirrorSequence(self.back.planes[::-1]).name) if name])


class Moment(NamedTuple):
    """Moving bodies at the time of a ping.

    Attributes:
        scene: the scene at that time.
        to_world: first three rows of the transform from each body's axes to the world ``(bodies, 3, 4)``.
        velocity: of each body ``(bodies, 6)``, see :meth:`~mitsonar.motion.bodies.MovingBodies.velocities`.
    """

    scene: MovingScene
    to_world: NDArray[np.float64]
    velocity: NDArray[np.float64]

    @classmethod
    def at(cls, motion: SceneMotion, time_s: float) -> Moment:
        """Return the bodies of a scene at a time [s]."""
        bodies = motion.bodies
        return cls(motion.scene_at(time_s), bodies.to_world(time_s)[0], bodies.velocities(time_s)[0])

    def row(self, body: int) -> NDArray[np.float64]:
        """Return the 18 numbers of a body for a launch: its transform, its velocity and its rotation."""
        return np.concatenate([self.to_world[body - 1].ravel(), self.velocity[body - 1]])

    def from_world(self, body: int, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transform a place [m] in the world ``(3,)`` to the axes of a body."""
        rows = self.to_world[body - 1]
        return np.asarray(rows[:, :3].T @ (place - rows[:, 3]))


DIRECT = ScattererPath()
"""The path without mirrors."""


class ChannelTracer:
    """Tracer of a scene's echoes at the receivers of a channel sonar.

    Args:
        scene: any Mitsuba scene.
        sonar: the instrument.
        like: a tracer of the same scene, whose scatterers may be shared.
        mirrors: mirror parts of the scene's shapes.
        within: box that holds all points that matter, see :meth:`Scatterers.from_scene`.
        motion: moving bodies of the scene; None if nothing moves.

    Attributes:
        notes: notes to the user about the scene's BSDFs.
        flat: the scene's mirrors.
        registry: registry index of each mirror's shape, keyed by the shape's index in the scene.
        paths: kinds of paths that reach scatterers, the direct one first.

    Raises:
        MitsonarError: no surface can carry scatterers, or a mirror has too many triangles.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sonar: ChannelSonar,
        like: ChannelTracer | None = None,
        mirrors: Mirrors | None = None,
        within: NDArray[np.float64] | None = None,
        motion: SceneMotion | None = None,
    ) -> None:
        self.scene, self.sonar, self.motion = scene, sonar, motion
        surfaces = Surfaces.from_scene(scene)
        self.flat: FlatMirrors = flat_mirrors(scene, mirrors)
        self.notes = [*surfaces.notes, *self.flat.notes_on(sonar.bounces)]
        shapes = scene.shapes()
        self.registry = {plane.shape: registry_index(shapes[plane.shape]) for plane in self.flat.reflecting(2)}
        bodies = () if motion is None else motion.bodies.names
        self.paths = _scatterer_paths(self.flat, sonar.bounces, bodies)
        self.source: _WorldScatterers | _VehicleRays
        if sonar.model == "scatterers":
            shared = (
                like.source
                if like is not None and like.scene is scene and isinstance(like.source, _WorldScatterers)
                else None
            )
            moved = {} if motion is None else motion.numbers
            still = None if motion is None else frozenset(range(len(shapes))) - frozenset(moved.values())
            self.source = _WorldScatterers(scene, sonar, shared, mirrors, within, still)
            on_bodies = {
                name: _WorldScatterers(scene, sonar, None, mirrors, None, frozenset({number}))
                for name, number in moved.items()
            }
            self.on_bodies = [] if motion is None else [on_bodies[name] for name in motion.bodies.shapes]
            sources = [self.source, *on_bodies.values()]
            if motion is not None and not any(len(source.scatterers) for source in sources):
                raise MitsonarError(NO_SCATTERERS)
        else:
            self.source = _VehicleRays(sonar, surfaces)
        self.launches: dict[tuple[int, tuple[str, ...], int, int, bool], _Launch] = {}

    def trace(
        self,
        pose: NDArray[np.float64],
        velocity: NDArray[np.float64],
        receiver: int,
        names: tuple[str, ...],
        points: NDArray[np.uint32] | None = None,
        path: ScattererPath = DIRECT,
        moment: Moment | None = None,
    ) -> EchoValues:
        """Trace one ping at one receiver; return echo values, one for each point that it may receive from.

        Args:
            pose: pose of the transmitter ``(6,)`` [m, rad].
            velocity: velocity of the vehicle in its own axes ``(4,)`` [m/s, rad/s].
            receiver: index of the receiver.
            names: names of the values to return.
            points: indices of the points to trace; default: those that the receiver may receive from.
            path: mirrors between sonar and points.
            moment: of the ping, if bodies move.
        """
        points = self.candidates(pose, receiver, path, moment) if points is None else points
        if not len(points):
            return {name: np.zeros(0) for name in names}
        key = (receiver, names, len(path.out.planes), len(path.back.planes), path.body > 0)
        if key not in self.launches:
            self.launches[key] = self._compile(*key)
        row = moment.row(path.body) if moment is not None and path.body else np.zeros(0)
        table = mi.Float64(padded(np.concatenate([self._table(pose, velocity, receiver, path), row])))
        scene = self.scene if moment is None else moment.scene
        launch, inputs = self.launches[key], (mi.UInt32(padded(points)), scene, table)
        received = replayed(launch, *inputs, self._source(path).tables(receiver))
        return {name: np.broadcast_to(np.array(values), len(points)) for name, values in zip(names, received, strict=True)}

    def candidates(
        self, pose: NDArray[np.float64], receiver: int, path: ScattererPath = DIRECT, moment: Moment | None = None
    ) -> NDArray[np.uint32]:
        """Return indices of the points that a receiver may receive from, via the given mirrors."""
        table = self._table(pose, np.zeros(4), receiver, path)
        if moment is not None and path.body:
            table[3:6] = moment.from_world(path.body, table[3:6])
            table[12:21] = (table[12:21].reshape(3, 3) @ moment.to_world[path.body - 1][:, :3]).ravel()
        return self._source(path).candidates(table, receiver)

    def _source(self, path: ScattererPath) -> _WorldScatterers | _VehicleRays:
        """Return the source of the echoes of a kind of path."""
        return self.on_bodies[path.body - 1] if path.body else self.source

    def _table(
        self, pose: NDArray[np.float64], velocity: NDArray[np.float64], receiver: int, path: ScattererPath
    ) -> NDArray[np.float64]:
        table = link_table(self.sonar, receiver, pose, velocity)
        straight = not path.out.planes and not path.back.planes
        return table if straight else mirrored_table(table, path.out, path.back, self.registry)

    def height_m(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height of each pose above the still surface straight below ``(pings,)`` [m]; nan if there is none."""
        place = mi.Point3f(*(mi.Float(padded(axis.astype(np.float32))) for axis in poses[:, :3].T))
        scene = self.scene if self.motion is None else self.motion.still  # where bodies are in their own axes, nothing is
        return np.array(height_below(scene, place), dtype=float)

    def _compile(self, receiver: int, names: tuple[str, ...], out: int, back: int, moves: bool) -> _Launch:
        """Record a receiver's launch for the given numbers of mirrors; later calls replay it (``dr.freeze``)."""
        source = self.on_bodies[0] if moves else self.source

        @Frozen
        def launch(index: mi.UInt32, scene: mi.Scene, table: mi.Float64, tables: DeviceArray) -> list[DeviceArray]:
            link: LinkGeometry
            if out + back == 0:
                link = LinkGeometry(self.sonar, receiver, table)
            else:
                link = MirroredLink(self.sonar, receiver, table, out, back)
            body = BodyPose.read(table, link.size) if moves else None
            received = source.received(link, index, scene, tables, body)
            values = [getattr(received, name) for name in names]
            dr.eval(values)
            return values

        return launch


NO_SCATTERERS = (
    "the scene has no surface that can carry scatterers: give it a shape with a diffuse BSDF, cell_noise or a bitmap as "
    "reflectance, or raise points_per_m2"
)


def _scatterer_paths(flat: FlatMirrors, bounces: int, bodies: Sequence[str] = ()) -> list[ScattererPath]:
    """Return all kinds of scatterer paths with up to ``bounces`` reflections, counting the scatterer as one."""
    return [
        ScattererPath(out, back, number, target)
        for number, target in enumerate(["scatterer", *bodies])
        for mirrors in range(bounces)
        for outward in range(mirrors + 1)
        for out in mirror_sequences(flat.reflecting(bounces), outward)
        for back in mirror_sequences(flat.reflecting(bounces), mirrors - outward)
    ]


class BodyPose(NamedTuple):
    """Pose and velocity of a moving body on the device: rows of its transform to the world, velocity and rotation."""

    rows: list[list[DeviceArray]]
    velocity: list[DeviceArray]
    rotation: list[DeviceArray]

    @classmethod
    def read(cls, table: mi.Float64, begin: int) -> BodyPose:
        """Read the numbers of :meth:`Moment.row` from a table."""
        numbers = [dr.gather(mi.Float64, table, mi.UInt32(begin + k)) for k in range(18)]
        dr.eval(numbers)
        return cls([numbers[start : start + 4] for start in (0, 4, 8)], numbers[12:15], numbers[15:18])

    def placed(self, point: list[DeviceArray]) -> list[DeviceArray]:
        """Transform points [m] from the body's axes to the world."""
        return [sum((a * b for a, b in zip(row, point, strict=False)), row[3]) for row in self.rows]

    def turned(self, normal: mi.Normal3f) -> mi.Normal3f:
        """Rotate normals from the body's axes to the world."""
        return mi.Normal3f(*(sum(mi.Float(row[k]) * normal[k] for k in range(3)) for row in self.rows))

    def velocity_at(self, place: list[DeviceArray]) -> list[DeviceArray]:
        """Return the velocity [m/s] of the body's points at places in the world."""
        arm = [p - row[3] for p, row in zip(place, self.rows, strict=True)]
        spin = self.rotation
        swing = [spin[(k + 1) % 3] * arm[(k + 2) % 3] - spin[(k + 2) % 3] * arm[(k + 1) % 3] for k in range(3)]
        return [v + w for v, w in zip(self.velocity, swing, strict=True)]


class _WorldScatterers:
    """Source of echoes from scatterers that are fixed in the world, or in the axes of a moving body."""

    def __init__(
        self,
        scene: mi.Scene,
        sonar: ChannelSonar,
        like: _WorldScatterers | None,
        mirrors: Mirrors | None,
        within: NDArray[np.float64] | None,
        among: frozenset[int] | None = None,
    ) -> None:
        self.sonar, self.within, self.among = sonar, within, among
        self.scatterers: Scatterers
        self.stored: mi.Float
        self.smooth: frozenset[int] | None = None
        if mirrors is not None or sonar.direct:
            places = (
                [] if mirrors is None else np.flatnonzero((mirrors.reflection != 0) & (mirrors.roughness_m == 0)).tolist()
            )
            self.smooth = frozenset(places)
        same = like is not None and _points_of(like.sonar) == _points_of(sonar) and like.smooth == self.smooth
        if like is not None and same and like.among == among and np.array_equal(like.within, within):  # type: ignore[arg-type]
            self.scatterers, self.stored = like.scatterers, like.stored
        else:
            self.scatterers = Scatterers.from_scene(scene, sonar, self.smooth, within, among)
            self.stored = self._rows()
        self.wavenumber = 2 * math.pi / sonar.wavelength_m
        self.roughness: mi.Float | None = None  # rms height of each point's mirror; negative if it is no mirror
        if mirrors is not None:
            height = np.where(mirrors.reflection == 0, -1.0, mirrors.roughness_m).astype(np.float32)
            self.roughness = mi.Float(height[self.scatterers.shape])

    def _rows(self) -> mi.Float:
        """Return position, strength, normal and phase of all points."""
        rows = np.zeros((len(self.scatterers), 8), np.float32)  # two fetches of 16 bytes per point
        rows[:, :3], rows[:, 3] = self.scatterers.place, self.scatterers.strength
        rows[:, 4:7], rows[:, 7] = self.scatterers.normal, self.scatterers.phase
        return mi.Float(rows.ravel())

    def candidates(self, table: NDArray[np.float64], receiver: int) -> NDArray[np.uint32]:
        """Return indices of the scatterers that a receiver may receive from, given the geometry of its link."""
        return self.scatterers.within(table[3:6], table[12:21].reshape(3, 3), self.sonar.receivers[receiver].field)

    def tables(self, receiver: int) -> list[mi.Float]:
        """Return the inputs of a launch: position, strength, normal and phase of all points; with mirrors also roughness."""
        return [self.stored] if self.roughness is None else [self.stored, self.roughness]

    def received(
        self, link: LinkGeometry, index: mi.UInt32, scene: mi.Scene, tables: list[mi.Float], body: BodyPose | None = None
    ) -> EchoBatch:
        """Return the echoes of the scatterers that transmitter and receiver see."""
        # 1. fetch position, strength, normal and phase
        first: DeviceArray = dr.gather(mi.Vector4f, tables[0], index * 2)
        second: DeviceArray = dr.gather(mi.Vector4f, tables[0], index * 2 + 1)
        position, strength, normal = (
            mi.Point3f(first.x, first.y, first.z),
            first.w,
            mi.Normal3f(second.x, second.y, second.z),
        )
        # 2. delay in double precision, since it determines the phase of the carrier
        exact = [mi.Float64(value) for value in position]
        moves: list[DeviceArray] | None = None
        if body is not None:
            exact, normal = body.placed(exact), body.turned(normal)
            position, moves = mi.Point3f(*exact), body.velocity_at(exact)
        to_point, from_receiver = link.to_point(exact)
        delay = delay_exact(to_point, from_receiver, link.velocity, self.sonar.sound_speed, moves)
        # 3. directions and distances; single precision is enough for amplitudes
        way_out, way_back = mi.Vector3f(*to_point), mi.Vector3f(*from_receiver)
        sent, received = dr.norm(way_out), dr.norm(way_back)
        u_sent: DeviceArray = way_out / sent
        u_received: DeviceArray = way_back / received
        # 4. sensitivity and Lambert's cosines; both ends must be on the same side of the surface
        weight = link.sensitivity(u_sent, u_received)
        cosines = dr.dot(normal, u_sent), dr.dot(normal, u_received)
        lambert = cosines[0] * cosines[1]
        inside = (weight != 0) & (lambert > 0)  # the lobes of a line change sign
        # 5. shadow rays, only for points that could contribute
        point = ScatteringPoints(position, exact, normal)
        open_, factor = link.reached(scene, point, Leg(u_sent, sent), Leg(u_received, received), inside)
        seen = inside & open_
        # 6. amplitude: the strength is an energy; spreading and mirrors act on the pressure
        amplitude = weight * dr.sqrt(dr.select(seen, strength * lambert, 0))
        if self.sonar.spreads:
            amplitude /= sent * received
        if factor is not None:
            amplitude *= factor
        if len(tables) > 1:  # a mirror scatters the energy that its roughness removes from the specular echo
            height = dr.gather(mi.Float, tables[1], index)
            lost = 1 - dr.exp(-dr.square(height * self.wavenumber * (cosines[0] + cosines[1])))
            amplitude *= dr.sqrt(dr.select(height < 0, 1, lost))
        return link.echo_batch(delay, amplitude, second.w, link.doppler(u_sent, u_received, moves), seen)


def _points_of(sonar: ChannelSonar) -> tuple[float | None, ...]:
    """Return the keys of a sonar that determine the points of a scene."""
    return sonar.points_per_m2, sonar.scatterer_spacing_m, sonar.speckle_nu, sonar.speckle_patch_m, sonar.seed


class _VehicleRays:
    """Source of echoes from rays fixed to the vehicle that cover each field of view evenly (Almanza-Medina, 5.2.1)."""

    def __init__(self, sonar: ChannelSonar, surfaces: Surfaces) -> None:
        self.sonar, self.surfaces = sonar, surfaces
        directions = [_even_directions(field, sonar.rays) for field in sonar.field_of_view.values()]
        self.numbers = [np.arange(len(each), dtype=np.uint32) for each in directions]
        self.stored = [mi.Float64(each.ravel()) for each in directions]

    def candidates(self, table: NDArray[np.float64], receiver: int) -> NDArray[np.uint32]:
        """Return indices of the rays that belong to a receiver."""
        return self.numbers[receiver]

    def tables(self, receiver: int) -> tuple[mi.Float64, LaunchTables]:
        """Return the inputs of a launch: directions of the rays, and tables of the surfaces."""
        return self.stored[receiver], self.surfaces.arrays()

    def received(
        self,
        link: LinkGeometry,
        index: mi.UInt32,
        scene: mi.Scene,
        tables: tuple[mi.Float64, LaunchTables],
        body: BodyPose | None = None,
    ) -> EchoBatch:
        """Return the echoes of the points that the rays hit, on still shapes."""
        # 1. turn the directions from the axes of the field of view to the world
        directions, facets = tables
        local = [dr.gather(mi.Float64, directions, index * 3 + k) for k in range(3)]
        axes = [link.vector(12 + 3 * k) for k in range(3)]
        u = [sum(local[k] * axes[k][axis] for k in range(3)) for axis in range(3)]
        u_sent = mi.Vector3f(*u)
        # 2. trace from the transmitter; the point stays in double precision for the phase
        hit = replace(self.surfaces, **facets).hit(scene, mi.Ray3f(mi.Point3f(*link.sent_from), u_sent))
        point = [a + axis * mi.Float64(hit.t) for a, axis in zip(link.sent_from, u, strict=True)]
        # 3. delay and amplitude of the path via the point
        to_point, from_receiver = link.to_point(point)
        delay = delay_iterated(to_point, from_receiver, link.velocity, self.sonar.sound_speed)
        way_back = mi.Vector3f(*from_receiver)
        received = dr.norm(way_back)
        weight = link.sensitivity(u_sent, way_back / received)
        amplitude = weight * hit.reflectivity * dr.abs(dr.dot(hit.n, u_sent))
        if self.sonar.spreads:
            amplitude /= hit.t * received
        doppler = link.doppler(u_sent, way_back / received)
        return link.echo_batch(delay, amplitude, mi.Float(0), doppler, hit.valid & (weight > 0))


def _even_directions(field: FieldOfView, rays: int) -> NDArray[np.float64]:
    """Return directions that cover a field of view evenly, along its axes ``(n, 3)``; about ``rays`` lie within it.

    They exceed the field by :data:`MARGIN_DEG`, since the field is the receiver's but rays begin at the transmitter.
    """
    match field.shape:
        case "rectangular":
            wide, tall = math.radians(field.across_deg), math.radians(field.along_deg)
        case "circular":
            wide = tall = math.radians(field.across_deg)
            rays = round(rays * 4 / math.pi)
        case _:
            wide, tall = math.pi, 2 * math.pi
    step = math.sqrt(wide * tall / rays)
    margin = 0.0 if field.shape == "all" else math.radians(MARGIN_DEG)
    across = (np.arange(math.ceil((wide + 2 * margin) / step)) + 0.5) * step - wide / 2 - margin
    along = (np.arange(math.ceil((tall + 2 * margin) / step)) + 0.5) * step - tall / 2 - margin
    a, e = (angle.ravel() for angle in np.meshgrid(across, along))
    return np.column_stack([np.cos(a) * np.cos(e), np.sin(a), np.cos(a) * np.sin(e)])


MARGIN_DEG = 2.0
"""Angle by which the rays exceed a receiver's field of view: 0.1 m at 3 m."""


# ---------------- Geometry of a link: where both ends are in one ping, and what echoes they exchange via points


LINK = 30
"""Length of :func:`link_table`."""

DRJIT = Maths(dr.asin, dr.atan2, dr.sin, dr.cos, clipped, dr.select)


class Leg(NamedTuple):
    """Unit direction from transmitter or receiver (or its image) to points, and distance [m]."""

    u: DeviceArray
    length: DeviceArray


@dataclass
class EchoBatch:
    """Echoes as unevaluated Dr.Jit arrays, one value for each point.

    Attributes:
        delay: delay of the echo [s].
        amplitude: magnitude of the echo.
        phase: phase of the scatterer, without that of the delay [rad]; a single 0 in the model ``rays``.
        doppler: Doppler shift of the carrier [Hz].
        counts: whether there is an echo within ``range_max``.
        beyond: whether there is an echo from beyond ``range_max``.
        turn: phase of the delay at the finest frequency step, -pi..pi, for the transform [rad].
        real, imag: complex amplitude, with the phases of the scatterer and the carrier.
    """

    delay: DeviceArray
    amplitude: DeviceArray
    phase: DeviceArray
    doppler: DeviceArray
    counts: DeviceArray
    beyond: DeviceArray
    turn: DeviceArray
    real: DeviceArray
    imag: DeviceArray


def link_table(
    sonar: ChannelSonar, receiver: int, pose: NDArray[np.float64], velocity: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the geometry of one ping in the world ``(30,)``.

    The table holds the positions of transmitter and receiver [m] and their velocities [m/s], three numbers each, then the
    axes of the receiver's and of the transmitter's field of view, nine numbers each.
    """
    turn = vehicle_rotation(pose).as_matrix()[0]
    one = sonar.receivers[receiver]
    offset = np.array(one.position)
    swing = velocity[:3] + np.cross([0.0, 0.0, -velocity[3]], offset)
    axes = [field.axes @ turn.T for field in (one.field, sonar.transmitter)]
    places, velocities = (pose[:3], pose[:3] + turn @ offset), (turn @ velocity[:3], turn @ swing)
    return np.concatenate([*places, *velocities, *(each.ravel() for each in axes)])


def absorption_rate(sonar: ChannelSonar) -> float:
    """Return the rate at which absorption lowers the amplitude of an echo with its delay [1/s]."""
    return sonar.absorption_db_per_m * sonar.sound_speed * math.log(10) / 20


class LinkGeometry:
    """Geometry between transmitter and receiver in one ping, on the device.

    Quantities that affect the phase are float64.

    Args:
        sonar: the instrument.
        receiver: index of the receiver.
        table: as returned by :func:`link_table`.
    """

    def __init__(self, sonar: ChannelSonar, receiver: int, table: mi.Float64) -> None:
        self.sonar = sonar
        self.numbers = [dr.gather(mi.Float64, table, mi.UInt32(k)) for k in range(self.size)]
        dr.eval(self.numbers)  # read once, not once per point
        self.receiver_field: FieldOfView = sonar.field_of_view[sonar.receivers[receiver].name]
        self.transmitter_field: FieldOfView = sonar.transmitter

    @property
    def size(self) -> int:
        """Return the length of the table."""
        return LINK

    def vector(self, start: int) -> list[DeviceArray]:
        """Return three consecutive numbers of the table."""
        return self.numbers[start : start + 3]

    @property
    def sent_from(self) -> list[DeviceArray]:
        """Return the position of the transmitter [m]."""
        return self.vector(0)

    @property
    def velocity(self) -> list[DeviceArray]:
        """Return the velocity of the receiver [m/s]."""
        return self.vector(9)

    def axes(self, which: int) -> list[mi.Vector3f]:
        """Return the axes of the receiver's field of view (0) or the transmitter's (1)."""
        return [mi.Vector3f(*self.vector(12 + 9 * which + 3 * k)) for k in range(3)]

    def to_point(self, point: list[DeviceArray]) -> tuple[list[DeviceArray], list[DeviceArray]]:
        """Return the vectors from the transmitter and from the receiver to points in the world [m]."""
        sent, received = ([p - a for p, a in zip(point, self.vector(start), strict=True)] for start in (0, 3))
        return sent, received

    def sensitivity(self, sent: DeviceArray, received: DeviceArray) -> DeviceArray:
        """Return the combined sensitivity of transmitter and receiver, given unit directions to the points."""
        ahead, aside, above = (dr.dot(axis, received) for axis in self.axes(0))
        both = self.receiver_field.sensitivity(ahead, aside, above, DRJIT)
        if self.transmitter_field.shape != "all":
            ahead, aside, above = (dr.dot(axis, sent) for axis in self.axes(1))
            both = both * self.transmitter_field.sensitivity(ahead, aside, above, DRJIT)
        return both

    def reached(
        self, scene: mi.Scene, point: ScatteringPoints, sent: Leg, received: Leg, active: DeviceArray
    ) -> tuple[DeviceArray, DeviceArray | None]:
        """Return which points sound reaches, and the factor of mirrors on its amplitude; None without mirrors.

        Only the path from the transmitter is tested, since receivers are near it.
        """
        return ~hidden(scene, point.position, point.normal, sent.u, sent.length, active), None

    def doppler(
        self, sent: DeviceArray, received: DeviceArray, point_velocity: list[DeviceArray] | None = None
    ) -> DeviceArray:
        """Return the Doppler shift of the carrier [Hz], given unit directions to the points and their velocity.

        The shift is positive where the vehicle approaches the point, because both legs of the path get shorter. In a turn,
        transmitter and receiver have different velocities. Terms of second order in velocity over sound speed are neglected.
        """
        sender, receiver = (mi.Vector3f(*self.vector(start)) for start in (6, 9))
        if point_velocity is not None:
            point = mi.Vector3f(*point_velocity)
            sender, receiver = sender - point, receiver - point
        return (dr.dot(sent, sender) + dr.dot(received, receiver)) * (1 / self.sonar.wavelength_m)

    def echo_batch(
        self, delay: DeviceArray, amplitude: DeviceArray, phase: DeviceArray, doppler: DeviceArray, valid: DeviceArray
    ) -> EchoBatch:
        """Return the echoes, split into those within ``range_max`` and those from beyond."""
        if self.sonar.absorption_db_per_m > 0:
            amplitude = amplitude * dr.exp(mi.Float(delay) * -absorption_rate(self.sonar))
        beyond = valid & (delay > 2 * self.sonar.range_max / self.sonar.sound_speed)
        turn = delay * (self.sonar.frequency_step_hz / PADDING)
        turns = delay * self.sonar.carrier_hz
        # remove whole cycles in float64; the rest of the phase fits float32
        sin, cos = dr.sincos(mi.Float((turns - dr.round(turns)) * (2 * math.pi)) - phase)
        return EchoBatch(
            delay=delay,
            amplitude=amplitude,
            phase=phase,
            doppler=doppler,
            counts=valid & ~beyond,
            beyond=beyond,
            turn=(turn - dr.round(turn)) * (2 * math.pi),
            real=amplitude * cos,
            imag=-amplitude * sin,
        )


class MirroredLink(LinkGeometry):
    """Geometry between the images of transmitter and receiver.

    Args:
        sonar: the instrument.
        receiver: index of the receiver.
        table: as returned by :func:`mirrored_table`.
        out: number of mirrors between transmitter and points.
        back: number of mirrors between points and receiver.
    """

    def __init__(self, sonar: ChannelSonar, receiver: int, table: mi.Float64, out: int, back: int) -> None:
        self.out, self.back = out, back
        super().__init__(sonar, receiver, table)
        self.wavenumber = 2 * math.pi / sonar.wavelength_m

    @property
    def size(self) -> int:
        """Return the length of the table."""
        return LINK + (ROW + 1) * (self.out + self.back)

    def reached(
        self, scene: mi.Scene, point: ScatteringPoints, sent: Leg, received: Leg, active: DeviceArray
    ) -> tuple[DeviceArray, DeviceArray]:
        """Return which points sound reaches via the mirrors, out and back, and the product of the mirrors' factors."""
        starts = [LINK + (ROW + 1) * k for k in range(self.out + self.back)]
        rows = [PlaneRow.from_numbers(self.numbers[start : start + ROW + 1]) for start in starts]
        active, there = unfolded(scene, point, self.vector(0), rows[: self.out], self.wavenumber, active)
        active, back = unfolded(scene, point, self.vector(3), rows[self.out :], self.wavenumber, active)
        return active, there * back


def mirrored_table(
    table: NDArray[np.float64], out: MirrorSequence, back: MirrorSequence, registry: dict[int, int]
) -> NDArray[np.float64]:
    """Return the geometry of a link via mirrors: :func:`link_table` of the images.

    Positions, velocities and fields of view are those of the images; the rows of both sequences of mirrors follow.

    Args:
        table: table of the link without mirrors ``(30,)``.
        out: mirrors from the transmitter to the points.
        back: mirrors from the receiver to the points, backwards in time.
        registry: see :meth:`MirrorSequence.rows`.
    """
    places = out.images(table[0:3])[-1], back.images(table[3:6])[-1]
    velocities = out.turn @ table[6:9], back.turn @ table[9:12]
    axes = table[12:21].reshape(3, 3) @ back.turn.T, table[21:30].reshape(3, 3) @ out.turn.T
    rows = out.rows(table[0:3], registry), back.rows(table[3:6], registry)
    return np.concatenate([*places, *velocities, *(part.ravel() for part in (*axes, *rows))])


# ---------------- Scattering points, and their search
# A surface whose reflectivity comes in cells (``cell_noise`` over uv, or a picture) has one point in each cell. Its
# position is a hash of the cell. Any other surface has the points of a lattice in the world, the same as in images of the
# model ``coherent``. With ``scatterer_spacing_m`` all surfaces use the lattice, so that images and impulse responses come
# from one field. The points do not depend on the sonar's pose, the time or the number of rays.
#
# Each point scatters with an independent complex Gaussian number zeta, E|zeta|^2 = 1, which is a hash of its cell. Echoes of
# many points then add in power, as those of rough ground do. Their energy does not depend on the density of points.


MOST = 2**26
"""Largest number of points in a scene, 36 bytes each: position, normal, strength, phase and shape."""

POINTS_PER_BUCKET = 256
"""Approximate number of points in a bucket: few enough to fit a field of view closely, enough to keep the buckets few."""

BUCKETS_PER_BLOCK = 64
"""Number of buckets in a block; the search tests blocks first."""

BITS = 20
"""Number of bits of a bucket's position along each axis."""


@dataclass(frozen=True)
class Spheres:
    """Bounding spheres of groups of points, and the directions that their surfaces face.

    Attributes:
        middle: ``(groups, 3)`` [m].
        radius: ``(groups,)`` [m].
        facing: mean normal of a group on a closed body, which is visible from outside only; otherwise zero
            ``(groups, 3)``.
        spread: largest angle between ``facing`` and a normal of the group ``(groups,)`` [rad].
    """

    middle: NDArray[np.float64]
    radius: NDArray[np.float64]
    facing: NDArray[np.float64]
    spread: NDArray[np.float64]

    def may_be_seen(
        self, groups: NDArray[np.int64], eye: NDArray[np.float64], axes: NDArray[np.float64], field: FieldOfView
    ) -> NDArray[np.int64]:
        """Return the subset of groups that may have a visible point in a field of view at ``eye``."""
        # direction to each sphere, and its angular radius as a margin; the eye inside a sphere sees all of it
        from_eye = self.middle[groups] - eye
        distance = np.sqrt(np.einsum("gi,gi->g", from_eye, from_eye))
        unit, radius = from_eye / np.maximum(distance, 1e-12)[:, None], self.radius[groups]
        margin = np.where(distance > radius, np.arcsin(np.minimum(radius / np.maximum(distance, 1e-12), 1)), np.pi)
        # closed bodies: skip groups whose normals all face away from the eye
        away = np.einsum("gi,gi->g", self.facing[groups], unit) > np.sin(np.minimum(margin + self.spread[groups], np.pi / 2))
        ahead, aside, above = axes @ unit.T
        visible: NDArray[np.int64] = groups[field.may_see(ahead, aside, above, margin) & ~away]
        return visible


@dataclass(frozen=True)
class Scatterers:
    """Scattering points of a scene, sorted so that neighbours are adjacent.

    Attributes:
        place: positions ``(points, 3)`` float32 [m]; the float32 values are taken as exact.
        normal: unit normal of the surface ``(points, 3)`` float32.
        strength: reflectivity times the area that a point represents, times |zeta|^2 ``(points,)`` float32 [m2].
        phase: phase of zeta ``(points,)`` float32, -pi..pi [rad].
        shape: index in ``scene.shapes()`` of the shape that the point lies on ``(points,)`` int32.
        first: index of the first point of each bucket, and at the end the number of points ``(buckets + 1,)``.
        one_sided: whether a bucket's points lie on closed bodies, visible from outside only ``(buckets,)``.
    """

    place: NDArray[np.float32]
    normal: NDArray[np.float32]
    strength: NDArray[np.float32]
    phase: NDArray[np.float32]
    shape: NDArray[np.int32]
    first: NDArray[np.int64]
    one_sided: NDArray[np.bool_]

    @classmethod
    def from_scene(
        cls,
        scene: mi.Scene,
        sonar: ChannelSonar,
        smooth: frozenset[int] | None = None,
        within: NDArray[np.float64] | None = None,
        among: frozenset[int] | None = None,
    ) -> Scatterers:
        """Place scatterers on a scene's shapes.

        Args:
            scene: any Mitsuba scene.
            sonar: instrument that gives number and seed of the points.
            smooth: indices of perfect mirrors in the scene, which scatter nothing; if given, there may be no points at all.
            within: two opposite corners of a box ``(2, 3)`` [m]; points outside are left out, those inside stay the same.
            among: indices of the shapes that may carry points; if given, there may be no points at all.

        Raises:
            MitsonarError: no surface can carry scatterers, or there are more than :data:`MOST`.
        """
        parts, closed, shapes = [], [], []
        for number, shape in enumerate(scene.shapes()):
            chosen = among is None or number in among
            if chosen and shape.bsdf() is not None and number not in (smooth or ()) and not is_black(shape.bsdf()):
                refuse_instances([shape])
                grid = _grid_of(shape) if sonar.scatterer_spacing_m is None else None
                if grid is not None and not _is_covered_once(shape):
                    grid = None
                some = _in_cells(shape, grid, number) if grid else _on_lattice(shape, sonar, number, within)
                if within is not None:
                    inside = ((some.place >= within[0]) & (some.place <= within[1])).all(axis=1)
                    some = SurfacePoints(*(values[inside] for values in some))
                parts.append(some)
                closed.append(np.full(len(parts[-1].strength), isinstance(shape, mi.Mesh) and _is_closed(shape)))
                shapes.append(np.full(len(parts[-1].strength), number, np.int32))
        if not sum(map(len, closed)) and not (smooth is None and among is None):
            none = np.zeros((0, 3), np.float32)
            return cls(none, none, none[:, 0], none[:, 0], np.zeros(0, np.int32), np.zeros(1, np.int64), np.zeros(0, bool))
        if not sum(map(len, closed)):
            if within is not None:
                low, high = (", ".join(f"{edge:.4g}" for edge in corner) for corner in within)
                raise MitsonarError(
                    f"the scene has no surface within reach that can carry scatterers, from ({low}) to ({high}) m: move the "
                    "path, or raise range_max"
                )
            raise MitsonarError(NO_SCATTERERS)
        place, normal, strength, phase = (np.concatenate(values) for values in zip(*parts, strict=True))
        one_sided = np.concatenate(closed)
        order, first = _buckets(place, np.where(one_sided, _side(normal), 0))
        of_shape, sided = np.concatenate(shapes)[order], one_sided[order[first[:-1]]]
        return cls(place[order], normal[order], strength[order], phase[order], of_shape, first, sided)

    def __len__(self) -> int:
        return len(self.strength)

    @cached_property
    def spheres(self) -> tuple[Spheres, Spheres]:
        """Return the bounding spheres of the blocks, and those of the buckets."""
        buckets = np.arange(len(self.one_sided))
        blocks = self.first[:-1][::BUCKETS_PER_BLOCK]
        mixed = np.logical_and.reduceat(self.one_sided, buckets[::BUCKETS_PER_BLOCK])
        return self._spheres(blocks, mixed), self._spheres(self.first[:-1], self.one_sided)

    def _spheres(self, first: NDArray[np.int64], one_sided: NDArray[np.bool_]) -> Spheres:
        low, high = (reach.reduceat(self.place, first).astype(float) for reach in (np.minimum, np.maximum))
        count = np.diff(np.append(first, len(self)))
        mean = np.add.reduceat(self.normal, first, dtype=np.float64)
        mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
        along = np.einsum("pi,pi->p", self.normal, np.repeat(mean.astype(np.float32), count, axis=0))
        spread = np.arccos(np.clip(np.minimum.reduceat(along, first), -1, 1)) + 1e-3
        return Spheres((low + high) / 2, np.linalg.norm(high - low, axis=1) / 2, mean * one_sided[:, None], spread)

    def within(self, eye: NDArray[np.float64], axes: NDArray[np.float64], field: FieldOfView) -> NDArray[np.uint32]:
        """Return indices of the points that may lie in a field of view: all that do, and some just outside it.

        Args:
            eye: position of the receiver ``(3,)`` [m].
            axes: :attr:`FieldOfView.axes`, turned to the world ``(3, 3)``.
            field: shape of the field of view.
        """
        if not len(self):
            return np.zeros(0, np.uint32)
        blocks, buckets = self.spheres
        near = blocks.may_be_seen(np.arange(len(blocks.radius)), eye, axes, field)
        inner = (near[:, None] * BUCKETS_PER_BLOCK + np.arange(BUCKETS_PER_BLOCK)).ravel()
        return _ranges(self.first, buckets.may_be_seen(inner[inner < len(self.one_sided)], eye, axes, field))


def refuse_instances(shapes: Iterable[mi.Shape]) -> None:
    """Refuse shapes of a scene that would scatter and cannot carry scatterers.

    Raises:
        MitsonarError: a shape is an instance that is not black.
    """
    for shape in shapes:
        if shape.class_name() == "Instance" and shape.bsdf() is not None and not is_black(shape.bsdf()):
            raise MitsonarError(f"scatterers cannot lie on instances: got {shape.id()}; give the scene meshes instead")


def _side(normal: NDArray[np.float32]) -> NDArray[np.int64]:
    """Classify normals by the nearest of the six axis directions, 1 to 6."""
    axis = np.abs(normal).argmax(axis=1)
    return np.asarray(1 + 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] < 0))


def _is_closed(mesh: mi.Mesh) -> bool:
    """Test whether a mesh bounds bodies with outward normals.

    This is so if each edge occurs once in each direction and each connected body has a volume above 0.
    """
    faces = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
    vertex = np.array(mesh.vertex_positions_buffer(), dtype=float).reshape(-1, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth, back = (np.sort(a * len(vertex) + b) for a, b in (edges.T, edges.T[::-1]))
    if (np.diff(forth) == 0).any() or not np.array_equal(forth, back):
        return False
    links = coo_array((np.ones(len(edges), np.int8), tuple(edges.T)), shape=2 * (len(vertex),))
    _, body = connected_components(links, directed=False)
    corner = vertex[faces] - vertex[faces[0, 0]]
    volume = np.bincount(body[faces[:, 0]], np.einsum("fi,fi->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])))
    return bool((volume[np.unique(body[faces[:, 0]])] > 0).all())


class _Grid(NamedTuple):
    """Cells over uv of a shape's reflectivity; ``texture`` is None for a picture."""

    texture: CellNoise | None
    columns: int
    rows: int


def _grid_of(shape: mi.Shape) -> _Grid | None:
    """Return the cells over uv of a shape's reflectivity; None if it has none."""
    textures = reflectances_of(shape.bsdf())
    if len(textures) != 1:
        return None
    texture: Any = textures[0]  # Mitsuba's type stub does not know the plugin's class
    # compare by name, since the class is created again for each variant
    if type(texture).__name__ == CellNoise.__name__ and texture.coordinates == "uv":
        fine = round(texture.cells * 2 ** (texture.octaves - 1))
        return _Grid(texture, fine, fine) if fine >= 1 else None
    if texture.class_name() == "BitmapTexture":
        size = texture.resolution()
        return _Grid(None, int(size[0]), int(size[1]))
    return None


UV_SAMPLES, COVERED = 512, 0.95
"""Points of uv along each axis that are tested, and the share of a mesh that they must cover."""


def _is_covered_once(shape: mi.Shape) -> bool:
    """Return whether each place of a shape has its uv in the unit square, and shares it with no other place.

    The uv of a mesh may repeat, or be the same on several facets, as on those of a cube: a cell then has several places.
    """
    if not isinstance(shape, mi.Mesh):
        return True
    if not shape.has_vertex_texcoords():
        return False
    number = dr.arange(mi.UInt32, UV_SAMPLES**2)
    uv = (mi.Point2f(mi.Float(number % UV_SAMPLES), mi.Float(number // UV_SAMPLES)) + 0.5) / UV_SAMPLES
    everywhere: DeviceArray = mi.Bool(True)
    si = shape.eval_parameterization(uv, mi.RayFlags.All, everywhere)
    area = dr.select(si.is_valid(), dr.norm(dr.cross(si.dp_du, si.dp_dv)), 0)
    corners = triangles_of(shape)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.array(area).mean()) > COVERED * float(np.linalg.norm(normal, axis=1).sum()) / 2


class _Zeta(NamedTuple):
    """Complex Gaussian numbers of points on the device: |zeta|^2 and phase [rad]."""

    power: DeviceArray
    phase: DeviceArray


def _in_cells(shape: mi.Shape, grid: _Grid, number: int) -> SurfacePoints:
    """Place one point in each cell.

    Position and zeta are hashes of the cell and the texture's seed (for a picture: the shape's number).
    """
    # 1. the cells that the unit square of uv covers, after the texture's transform
    texture, columns, rows = grid
    turn = np.eye(3)
    if texture is not None:
        turn[:2] = texture.to_uv
    back = np.linalg.inv(turn)
    corners = turn @ np.array([[0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 1.0]])
    low = np.floor(corners[:2].min(axis=1) * (columns, rows)).astype(int)
    wide, tall = np.ceil(corners[:2].max(axis=1) * (columns, rows)).astype(int) - low
    _check_count(shape, float(wide) * float(tall), "give its texture fewer cells, or a scatterer_spacing_m")
    # 2. a position in each cell, hashed from the cell's column and row
    cell = dr.arange(mi.UInt32, int(wide * tall))
    column, row = mi.Int32(cell % int(wide)) + int(low[0]), mi.Int32(cell // int(wide)) + int(low[1])
    seed = (texture.seed, 1) if texture is not None else (number, 0)
    bits: list[DeviceArray] = [dr.reinterpret_array(mi.UInt32, value) for value in (column, row)]
    first, second = mi.sample_tea_32(bits[0], bits[1] ^ _key(*seed, PLACE), ROUNDS)
    u, v = (mi.Float(column) + _fraction(first)) / columns, (mi.Float(row) + _fraction(second)) / rows
    # 3. back to the shape's uv; cells at the border may have their position outside
    uv = mi.Point2f(*(float(a) * u + float(b) * v + float(c) for a, b, c in back[:2]))
    inside = (uv.x >= 0) & (uv.x < 1) & (uv.y >= 0) & (uv.y < 1)
    # 4. position on the surface, and the area of the cell there
    si = shape.eval_parameterization(uv, mi.RayFlags.All, inside)
    area = dr.norm(dr.cross(si.dp_du, si.dp_dv)) * abs(float(np.linalg.det(back[:2, :2]))) / (columns * rows)
    return _scattering_points(shape, si, area, _zeta_of(bits[0], bits[1] ^ _key(*seed, ZETA)), inside & si.is_valid())


def _on_lattice(
    shape: mi.Shape, sonar: ChannelSonar, number: int, within: NDArray[np.float64] | None = None
) -> SurfacePoints:
    """Return the points of the world's lattice on a surface, one in each cell of the lattice."""
    pitch = sonar.lattice_pitch_m
    cells = lattice_size(shape, pitch, within) / 2
    enough = pitch * math.sqrt(cells / MOST) * 1.1
    advice = "lower points_per_m2" if sonar.scatterer_spacing_m is None else "raise scatterer_spacing_m"
    _check_count(shape, cells, f"{advice}; a spacing of {enough:.2g} m is enough")
    patches = None if sonar.speckle_nu is None else Patches(sonar.speckle_nu, sonar.speckle_patch_m)
    return lattice_points(shape, grain_key(shape.id(), number), pitch, sonar.seed, patches, within=within)


def _scattering_points(
    shape: mi.Shape, si: mi.SurfaceInteraction3f, area: DeviceArray, zeta: _Zeta, valid: DeviceArray
) -> SurfacePoints:
    """Return the points whose strength is above 0."""
    strength = dr.select(valid, reflectivity_at(shape.bsdf(), si) * area * zeta.power, 0)
    dr.eval(si.p, si.n, strength, zeta.phase)
    strengths = np.array(strength)
    keep = np.flatnonzero((strengths > 0) & np.isfinite(strengths))
    place, normal = (np.broadcast_to(np.array(values).T, (len(strengths), 3))[keep] for values in (si.p, si.n))
    return SurfacePoints(
        np.ascontiguousarray(place), np.ascontiguousarray(normal), strengths[keep], np.array(zeta.phase)[keep]
    )


def _check_count(shape: mi.Shape, count: float, advice: str) -> None:
    if count > MOST:
        raise MitsonarError(
            f"shape {shape.id() or 'of merged meshes'} would carry {count:,.0f} scatterers, more than {MOST:,}: {advice}"
        )


PLACE, ZETA = 82, 83
"""Last numbers of the keys for positions within cells, and for zeta."""


def _key(seed: int, kind: int, drawn: int) -> DeviceArray:
    """Return 32 bits that select a hash; they differ from those used to draw the reflectivity."""
    return mi.UInt32(int(np.random.SeedSequence([abs(seed), kind, drawn]).generate_state(1)[0]))


def _zeta_of(first: DeviceArray, second: DeviceArray) -> _Zeta:
    """Hash 64 bits to complex Gaussian numbers of variance 1 (Box and Muller)."""
    bits: tuple[DeviceArray, DeviceArray] = mi.sample_tea_32(first, second, ROUNDS)
    # 23 bits plus one half fit a float32 exactly, so that the logarithm of 1 is never taken
    return _Zeta(-dr.log((mi.Float(bits[0] >> 9) + 0.5) * 2.0**-23), (_fraction(bits[1]) - 0.5) * (2 * math.pi))


def _fraction(bits: mi.UInt32) -> mi.Float:
    return (mi.Float(bits >> 8) + 0.5) * 2.0**-24


def _buckets(place: NDArray[np.float32], side: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort points into buckets, each with the points of one cube that face one direction.

    Returns:
        The order of the points, with neighbouring cubes close to each other, and the index where each bucket begins,
        followed by the number of points.
    """
    low, high = place.min(axis=0).astype(float), place.max(axis=0).astype(float)
    reach = np.sort(high - low)[::-1]
    # the edge of a cube that holds POINTS_PER_BUCKET points, if they cover a surface as large as the two longest sides
    edge = math.sqrt(reach[0] * reach[1] * POINTS_PER_BUCKET / len(place))
    edge = max(edge, reach[0] / (2**BITS - 1), 1e-9)
    # key: side first, then the cube's position on Morton's curve
    key = side.astype(np.uint64) << np.uint64(3 * BITS)
    for axis, values in enumerate(((place - low) / edge).T):
        key |= _spaced(values.astype(np.uint64)) << np.uint64(axis)
    order = np.argsort(key, kind="stable")
    new = np.flatnonzero(np.diff(key[order])) + 1
    return order, np.concatenate([[0], new, [len(place)]])


def _spaced(number: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Insert two zeros before each bit of numbers below 2^21; three such numbers interleave to Morton's curve."""
    masks = (0x1F00000000FFFF, 0x1F0000FF0000FF, 0x100F00F00F00F00F, 0x10C30C30C30C30C3, 0x1249249249249249)
    for shift, mask in zip((32, 16, 8, 4, 2), masks, strict=True):
        number = (number | (number << np.uint64(shift))) & np.uint64(mask)
    return number


def _ranges(first: NDArray[np.int64], buckets: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Return the indices of all points in the given buckets."""
    begin, count = first[buckets], first[buckets + 1] - first[buckets]
    if not len(begin):
        return np.empty(0, np.uint32)
    # the differences between consecutive indices: 1 within a bucket, a jump to the start of the next
    jump = np.ones(count.sum(), np.int64)
    ends = np.cumsum(count)
    jump[0] = begin[0]
    jump[ends[:-1]] = begin[1:] - (begin[:-1] + count[:-1] - 1)
    return np.cumsum(jump).astype(np.uint32)
