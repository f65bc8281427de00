"""Echoes of a scene at a receiver: delay and amplitude of each, from scatterers of the world or from rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.instruments.channel_sonar import PADDING, ChannelSonar, FieldOfView, Maths
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.plugins.surfaces import Surfaces
from mitsonar.simulation.device_arrays import DeviceArray, LaunchTables, padded
from mitsonar.simulation.propagation_delay import delay_exact, delay_iterated
from mitsonar.simulation.scatterers import Scatterers
from mitsonar.simulation.tracing import height_below, hidden
from mitsonar.simulation.variant import replayed

__all__ = ["ChannelTracer", "EchoBatch", "EchoValues"]

EchoValues: TypeAlias = dict[str, NDArray[Any]]
"""Fields of :class:`EchoBatch` by name as NumPy arrays ``(points,)``, numbers or truth values."""

_Launch: TypeAlias = Callable[..., list[DeviceArray]]
"""A frozen launch: indices, scene, link table and tables to values."""

DRJIT = Maths(dr.asin, dr.atan2, dr.cos, dr.clip, dr.select)


class ChannelTracer:
    """Trace the echoes of a scene at the receivers of a channel sonar.

    Attributes:
        notes: what a user should know about the scene's BSDFs.

    Raises:
        MitsonarError: no surface can carry scatterers.
    """

    def __init__(self, scene: mi.Scene, sonar: ChannelSonar, like: ChannelTracer | None = None) -> None:
        self.scene, self.sonar = scene, sonar
        surfaces = Surfaces.of(scene)
        self.notes = surfaces.notes
        self.source: _WorldScatterers | _VehicleRays
        if sonar.model == "scatterers":
            shared = (
                like.source
                if like is not None and like.scene is scene and isinstance(like.source, _WorldScatterers)
                else None
            )
            self.source = _WorldScatterers(scene, sonar, shared)
        else:
            self.source = _VehicleRays(sonar, surfaces)
        self.launches: dict[tuple[int, tuple[str, ...]], _Launch] = {}

    def trace(
        self,
        pose: NDArray[np.float64],
        velocity: NDArray[np.float64],
        receiver: int,
        wanted: tuple[str, ...],
        asked: NDArray[np.uint32] | None = None,
    ) -> EchoValues:
        """Trace one ping at one receiver: values of :class:`EchoBatch`, one for each point that it may receive from.

        Args:
            pose: of the transmitter ``(6,)`` [m, rad].
            velocity: of the vehicle in its own axes ``(4,)`` [m/s, rad/s].
            receiver: its index.
            wanted: names of the values.
            asked: indices of the points to trace; default: those that the receiver may receive from.
        """
        asked = self.source.asked(pose, receiver) if asked is None else asked
        if not len(asked):
            return {name: np.zeros(0) for name in wanted}
        if (receiver, wanted) not in self.launches:
            self.launches[receiver, wanted] = self._compile(receiver, wanted)
        table = mi.Float64(link_table(self.sonar, receiver, pose, velocity))
        launch, inputs = self.launches[receiver, wanted], (mi.UInt32(padded(asked)), self.scene, table)
        received = replayed(launch, *inputs, self.source.tables(receiver))
        return {name: np.broadcast_to(np.array(values), len(asked)) for name, values in zip(wanted, received, strict=True)}

    def height_m(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height of each pose over what is straight below it ``(pings,)`` [m]; nan where there is nothing."""
        place = mi.Point3f(*(mi.Float(padded(axis.astype(np.float32))) for axis in poses[:, :3].T))
        return np.array(height_below(self.scene, place), dtype=float)

    def _compile(self, receiver: int, wanted: tuple[str, ...]) -> _Launch:
        """Record a receiver's launch; later calls replay it (``dr.freeze``)."""

        @dr.freeze
        def launch(index: mi.UInt32, scene: mi.Scene, table: mi.Float64, tables: DeviceArray) -> list[DeviceArray]:
            received = self.source.received(LinkGeometry(self.sonar, receiver, table), index, scene, tables)
            values = [getattr(received, name) for name in wanted]
            dr.eval(values)
            return values

        return launch


@dataclass
class EchoBatch:
    """Echoes as Dr.Jit arrays that are not evaluated yet, one value for each point.

    Attributes:
        delay: of the echo [s].
        amplitude: magnitude of the echo.
        phase: of the scatterer itself, beside that of the delay [rad]; one 0 for all in the model rays.
        doppler: shift of the carrier [Hz].
        counts: whether there is an echo within ``range_max``.
        beyond: whether there is an echo from beyond ``range_max``.
        turn: phase of the delay at the finest frequency, -pi..pi, for the transform [rad].
        real, imag: the amplitude with the scatterer's and the carrier's phase.
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

    Three numbers each: positions of transmitter and receiver [m], their velocities [m/s]. Nine numbers each: axes of the
    receiver's field of view, and of the transmitter's.
    """
    turn = vehicle_rotation(pose).as_matrix()[0]
    one = sonar.receivers[receiver]
    offset = np.array(one.position)
    swing = velocity[:3] + np.cross([0.0, 0.0, -velocity[3]], offset)
    axes = [field.axes @ turn.T for field in (one.field, sonar.transmitter)]
    places, velocities = (pose[:3], pose[:3] + turn @ offset), (turn @ velocity[:3], turn @ swing)
    return np.concatenate([*places, *velocities, *(each.ravel() for each in axes)])


class LinkGeometry:
    """Geometry between transmitter and receiver in one ping, on the device; what affects the phase is float64.

    Args:
        sonar: the instrument.
        receiver: its index.
        table: of :func:`link_table`.
    """

    def __init__(self, sonar: ChannelSonar, receiver: int, table: mi.Float64) -> None:
        self.sonar = sonar
        self.numbers = [dr.gather(mi.Float64, table, mi.UInt32(k)) for k in range(30)]
        dr.eval(self.numbers)  # read once, not once a point
        self.listens: FieldOfView = sonar.field_of_view[sonar.receivers[receiver].name]
        self.sends: FieldOfView = sonar.transmitter

    def vector(self, start: int) -> list[DeviceArray]:
        """Return three numbers of the table."""
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
        """Return the vectors from the transmitter and from the receiver to points of the world [m]."""
        sent, received = ([p - a for p, a in zip(point, self.vector(start), strict=True)] for start in (0, 3))
        return sent, received

    def sensitivity(self, sent: DeviceArray, received: DeviceArray) -> DeviceArray:
        """Return the sensitivity of transmitter and receiver together, given unit directions to the points."""
        ahead, aside, above = (dr.dot(axis, received) for axis in self.axes(0))
        both = self.listens.sensitivity(ahead, aside, above, DRJIT)
        if self.sends.shape != "all":
            ahead, aside, above = (dr.dot(axis, sent) for axis in self.axes(1))
            both = both * self.sends.sensitivity(ahead, aside, above, DRJIT)
        return both

    def doppler(self, sent: DeviceArray, received: DeviceArray) -> DeviceArray:
        """Return the shift of the carrier [Hz], given unit directions to the points.

        It is positive where the vehicle approaches the point: both parts of the path get shorter. In a turn transmitter and
        receiver have velocities of their own. Terms of second order in velocity over sound speed are left out.
        """
        sender, receiver = (mi.Vector3f(*self.vector(start)) for start in (6, 9))
        return (dr.dot(sent, sender) + dr.dot(received, receiver)) * (1 / self.sonar.wavelength_m)

    def echo_batch(
        self, delay: DeviceArray, amplitude: DeviceArray, phase: DeviceArray, doppler: DeviceArray, valid: DeviceArray
    ) -> EchoBatch:
        """Return the echoes, divided into those within ``range_max`` and those from beyond."""
        beyond = valid & (delay > 2 * self.sonar.range_max / self.sonar.sound_speed)
        turn = delay * (self.sonar.frequency_step_hz / PADDING)
        turns = delay * self.sonar.carrier_hz
        sin, cos = dr.sincos(mi.Float((turns - dr.round(turns)) * (2 * math.pi)) - phase)  # float32 once the turns are away
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


class _WorldScatterers:
    """Echoes of the world's own scatterers."""

    def __init__(self, scene: mi.Scene, sonar: ChannelSonar, like: _WorldScatterers | None) -> None:
        self.sonar = sonar
        self.scatterers: Scatterers
        self.stored: mi.Float
        if like is not None and _points_of(like.sonar) == _points_of(sonar):
            self.scatterers, self.stored = like.scatterers, like.stored
            return
        self.scatterers = Scatterers.of(scene, sonar)
        rows = np.zeros((len(self.scatterers), 8), np.float32)  # two fetches of 16 bytes a point
        rows[:, :3], rows[:, 3] = self.scatterers.place, self.scatterers.strength
        rows[:, 4:7], rows[:, 7] = self.scatterers.normal, self.scatterers.phase
        self.stored = mi.Float(rows.ravel())

    def asked(self, pose: NDArray[np.float64], receiver: int) -> NDArray[np.uint32]:
        """Return indices of the scatterers that a receiver may receive from."""
        turn = vehicle_rotation(pose).as_matrix()[0]
        one = self.sonar.receivers[receiver]
        return self.scatterers.within(pose[:3] + turn @ np.array(one.position), one.field.axes @ turn.T, one.field)

    def tables(self, receiver: int) -> mi.Float:
        """Return the inputs of a launch: position, strength, normal and phase of all points."""
        return self.stored

    def received(self, link: LinkGeometry, index: mi.UInt32, scene: mi.Scene, tables: mi.Float) -> EchoBatch:
        """Return the echoes of the scatterers that transmitter and receiver see."""
        first: DeviceArray = dr.gather(mi.Vector4f, tables, index * 2)
        second: DeviceArray = dr.gather(mi.Vector4f, tables, index * 2 + 1)
        at, strength, normal = mi.Point3f(first.x, first.y, first.z), first.w, mi.Normal3f(second.x, second.y, second.z)
        to_point, from_receiver = link.to_point([mi.Float64(value) for value in at])
        delay = delay_exact(to_point, from_receiver, link.velocity, self.sonar.sound_speed)
        way_out, way_back = mi.Vector3f(*to_point), mi.Vector3f(*from_receiver)
        sent, received = dr.norm(way_out), dr.norm(way_back)
        u_sent: DeviceArray = way_out / sent
        u_received: DeviceArray = way_back / received
        weight = link.sensitivity(u_sent, u_received)
        lambert = dr.dot(normal, u_sent) * dr.dot(normal, u_received)
        inside = (weight > 0) & (lambert > 0)
        seen = inside & ~hidden(scene, at, normal, u_sent, sent, inside)
        amplitude = weight * dr.sqrt(dr.select(seen, strength * lambert, 0))
        if self.sonar.spreads:
            amplitude /= sent * received
        return link.echo_batch(delay, amplitude, second.w, link.doppler(u_sent, u_received), seen)


def _points_of(sonar: ChannelSonar) -> tuple[float | None, ...]:
    """Return what the points of a scene follow from."""
    return sonar.points_per_m2, sonar.scatterer_spacing_m, sonar.speckle_nu, sonar.speckle_patch_m, sonar.seed


class _VehicleRays:
    """Echoes of rays that are fixed to the vehicle, evenly over each receiver's field of view (Almanza-Medina, 5.2.1)."""

    def __init__(self, sonar: ChannelSonar, surfaces: Surfaces) -> None:
        self.sonar, self.surfaces = sonar, surfaces
        directions = [_even(field, sonar.rays) for field in sonar.field_of_view.values()]
        self.numbers = [np.arange(len(each), dtype=np.uint32) for each in directions]
        self.stored = [mi.Float64(each.ravel()) for each in directions]

    def asked(self, pose: NDArray[np.float64], receiver: int) -> NDArray[np.uint32]:
        """Return indices of the rays that belong to a receiver."""
        return self.numbers[receiver]

    def tables(self, receiver: int) -> tuple[mi.Float64, LaunchTables]:
        """Return the inputs of a launch: directions of the rays, tables of the surfaces."""
        return self.stored[receiver], self.surfaces.arrays()

    def received(
        self, link: LinkGeometry, index: mi.UInt32, scene: mi.Scene, tables: tuple[mi.Float64, LaunchTables]
    ) -> EchoBatch:
        """Return the echoes of the points that the rays hit."""
        directions, facets = tables
        own = [dr.gather(mi.Float64, directions, index * 3 + k) for k in range(3)]
        axes = [link.vector(12 + 3 * k) for k in range(3)]  # a direction is given along the axes of the field of view
        u = [sum(own[k] * axes[k][axis] for k in range(3)) for axis in range(3)]
        u_sent = mi.Vector3f(*u)
        hit = replace(self.surfaces, **facets).hit(scene, mi.Ray3f(mi.Point3f(*link.sent_from), u_sent))
        point = [a + axis * mi.Float64(hit.t) for a, axis in zip(link.sent_from, u, strict=True)]
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


def _even(field: FieldOfView, rays: int) -> NDArray[np.float64]:
    """Return directions evenly over a field of view, along its axes ``(n, 3)``: about ``rays`` of them within it.

    They cover :data:`MARGIN_DEG` more: the field is the receiver's, but rays begin at the transmitter.
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
