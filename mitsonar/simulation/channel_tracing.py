"""What a receiver hears of a scene: delay and amplitude of every echo, from scatterers of the world or from rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.instruments.channel_sonar import PADDING, ChannelSonar, FieldOfView, Maths
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.plugins.surfaces import Surfaces
from mitsonar.simulation.propagation_delay import delay_exact, delay_iterated
from mitsonar.simulation.scatterers import Scatterers
from mitsonar.simulation.tracing import height_below, hidden
from mitsonar.simulation.variant import garbage_stays

__all__ = ["ChannelTracer", "EchoBatch"]

DRJIT = Maths(dr.asin, dr.atan2, dr.cos, dr.clip, dr.select)


class ChannelTracer:
    """A scene as the receivers of a channel sonar hear it.

    Attributes:
        notes: what a user should know about the scene's BSDFs.

    Raises:
        MitsonarError: no surface to carry scatterers.
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
        self.launches: dict[tuple[int, tuple[str, ...]], Callable[..., list[Any]]] = {}

    def trace(
        self,
        pose: NDArray[np.float64],
        velocity: NDArray[np.float64],
        receiver: int,
        wanted: tuple[str, ...],
        asked: NDArray[np.uint32] | None = None,
    ) -> dict[str, NDArray[Any]]:
        """What a receiver hears of one ping: values of :class:`EchoBatch`, one a point that it may hear.

        Args:
            pose: of the transmitter ``(6,)``.
            velocity: of the vehicle in its own axes ``(4,)``.
            receiver: number of the receiver.
            wanted: names of the values.
            asked: numbers of the points that it may hear, where they are known already.
        """
        asked = self.source.asked(pose, receiver) if asked is None else asked
        if not len(asked):
            return {name: np.zeros(0) for name in wanted}
        if (receiver, wanted) not in self.launches:
            self.launches[receiver, wanted] = self._compile(receiver, wanted)
        table = mi.Float64(link_table(self.sonar, receiver, pose, velocity))
        with garbage_stays():
            received = self.launches[receiver, wanted](mi.UInt32(asked), self.scene, table, self.source.tables(receiver))
        return {name: np.array(values) for name, values in zip(wanted, received, strict=True)}

    def height_m(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height of each pose over what is straight below it ``(pings,)`` [m]; nan where there is nothing."""
        place = mi.Point3f(*(mi.Float(axis.astype(np.float32)) for axis in poses[:, :3].T))
        return np.array(height_below(self.scene, place), dtype=float)

    def _compile(self, receiver: int, wanted: tuple[str, ...]) -> Callable[..., list[Any]]:
        """A receiver's launch, traced once and then replayed (``dr.freeze``)."""

        @dr.freeze
        def launch(index: Any, scene: Any, table: Any, tables: Any) -> list[Any]:
            received = self.source.received(LinkGeometry(self.sonar, receiver, table), index, scene, tables)
            values = [getattr(received, name) for name in wanted]
            dr.eval(values)
            return values

        return launch


@dataclass
class EchoBatch:
    """Dr.Jit arrays, not evaluated yet, one value a point.

    Attributes:
        delay: of the echo [s].
        amplitude: of the echo.
        doppler: shift of the carrier [Hz].
        counts: whether there is an echo.
        beyond: whether there was one, but from beyond ``range_max``.
        turn: for the transform, the delay in turns of the finest frequency, -pi..pi.
        real, imag: the amplitude with the carrier's phase.
    """

    delay: Any
    amplitude: Any
    doppler: Any
    counts: Any
    beyond: Any
    turn: Any
    real: Any
    imag: Any


def link_table(
    sonar: ChannelSonar, receiver: int, pose: NDArray[np.float64], velocity: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Of one ping: place of transmitter and receiver, the receiver's velocity, axes of its field of view and of the
    transmitter's, all in the world ``(27,)``."""
    turn = vehicle_rotation(pose).as_matrix()[0]
    one = sonar.receivers[receiver]
    offset = np.array(one.position)
    swing = velocity[:3] + np.cross([0.0, 0.0, -velocity[3]], offset)
    axes = [field.axes @ turn.T for field in (one.field, sonar.transmitter)]
    return np.concatenate([pose[:3], pose[:3] + turn @ offset, turn @ swing, *(each.ravel() for each in axes)])


class LinkGeometry:
    """Where transmitter and receiver are in a ping; on the device, what touches the phase in float64.

    Args:
        sonar: the instrument.
        receiver: which.
        table: of :func:`link_table`.
    """

    def __init__(self, sonar: ChannelSonar, receiver: int, table: mi.Float64) -> None:
        self.sonar = sonar
        self.numbers = [dr.gather(mi.Float64, table, mi.UInt32(k)) for k in range(27)]
        dr.eval(self.numbers)  # read once, not once a point
        self.listens: FieldOfView = sonar.field_of_view[sonar.receivers[receiver].name]
        self.sends: FieldOfView = sonar.transmitter

    def vector(self, place: int) -> list[Any]:
        """Three numbers of the table."""
        return self.numbers[place : place + 3]

    @property
    def sent_from(self) -> list[Any]:
        """Place of the transmitter."""
        return self.vector(0)

    @property
    def velocity(self) -> list[Any]:
        """Of the receiver."""
        return self.vector(6)

    def axes(self, place: int) -> list[mi.Vector3f]:
        """Of the receiver's field of view (0) or the transmitter's (1)."""
        return [mi.Vector3f(*self.vector(9 + 9 * place + 3 * k)) for k in range(3)]

    def to_point(self, point: list[Any]) -> tuple[list[Any], list[Any]]:
        """From transmitter and from receiver to points of the world."""
        return tuple([p - a for p, a in zip(point, self.vector(start), strict=True)] for start in (0, 3))  # type: ignore[return-value]

    def sensitivity(self, sent: Any, received: Any) -> Any:
        """Of transmitter and receiver together, given unit directions."""
        ahead, aside, above = (dr.dot(axis, received) for axis in self.axes(0))
        both = self.listens.sensitivity(ahead, aside, above, DRJIT)
        if self.sends.shape != "all":
            ahead, aside, above = (dr.dot(axis, sent) for axis in self.axes(1))
            both = both * self.sends.sensitivity(ahead, aside, above, DRJIT)
        return both

    def doppler(self, sent: Any, received: Any) -> Any:
        """Shift of the carrier [Hz]: both ways get shorter as the vehicle comes nearer."""
        velocity = mi.Vector3f(*self.velocity)
        return (dr.dot(sent, velocity) + dr.dot(received, velocity)) * (1 / self.sonar.wavelength_m)

    def told(self, delay: Any, amplitude: Any, doppler: Any, seen: Any) -> EchoBatch:
        """What is heard, nearer than ``range_max`` or from beyond."""
        beyond = seen & (delay > 2 * self.sonar.range_max / self.sonar.sound_speed)
        turn = delay * (self.sonar.frequency_step_hz / PADDING)
        phase = delay * self.sonar.carrier_hz
        sin, cos = dr.sincos(mi.Float((phase - dr.round(phase)) * (2 * math.pi)))  # float32 once the turns are away
        return EchoBatch(
            delay=delay,
            amplitude=amplitude,
            doppler=doppler,
            counts=seen & ~beyond,
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
        if like is not None and (like.sonar.points_per_m2, like.sonar.seed) == (sonar.points_per_m2, sonar.seed):
            self.scatterers, self.stored = like.scatterers, like.stored
            return
        self.scatterers = Scatterers.of(scene, sonar)
        rows = np.zeros((len(self.scatterers), 8), np.float32)  # two fetches of 16 bytes a point
        rows[:, :3], rows[:, 3] = self.scatterers.place, self.scatterers.strength
        rows[:, 4:7] = self.scatterers.normal
        self.stored = mi.Float(rows.ravel())

    def asked(self, pose: NDArray[np.float64], receiver: int) -> NDArray[np.uint32]:
        """Numbers of the scatterers that a receiver may hear."""
        turn = vehicle_rotation(pose).as_matrix()[0]
        one = self.sonar.receivers[receiver]
        return self.scatterers.within(pose[:3] + turn @ np.array(one.position), one.field.axes @ turn.T, one.field)

    def tables(self, receiver: int) -> mi.Float:
        """What a launch reads: place, strength and normal of all points."""
        return self.stored

    def received(self, ways: LinkGeometry, index: mi.UInt32, scene: mi.Scene, tables: mi.Float) -> EchoBatch:
        """Delay, amplitude and visibility of scatterers."""
        first: Any = dr.gather(mi.Vector4f, tables, index * 2)
        second: Any = dr.gather(mi.Vector4f, tables, index * 2 + 1)
        at, strength, normal = mi.Point3f(first.x, first.y, first.z), first.w, mi.Normal3f(second.x, second.y, second.z)
        to_point, from_receiver = ways.to_point([mi.Float64(value) for value in at])
        delay = delay_exact(to_point, from_receiver, ways.velocity, self.sonar.sound_speed)
        way_out, way_back = mi.Vector3f(*to_point), mi.Vector3f(*from_receiver)
        sent, received = dr.norm(way_out), dr.norm(way_back)
        u_sent: Any = way_out / sent
        u_heard: Any = way_back / received
        weight = ways.sensitivity(u_sent, u_heard)
        lambert = dr.dot(normal, u_sent) * dr.dot(normal, u_heard)
        inside = (weight > 0) & (lambert > 0)
        seen = inside & ~hidden(scene, at, normal, u_sent, sent, inside)
        amplitude = weight * dr.sqrt(dr.select(seen, strength * lambert, 0))
        if self.sonar.spreads:
            amplitude /= sent * received
        return ways.told(delay, amplitude, ways.doppler(u_sent, u_heard), seen)


class _VehicleRays:
    """Echoes of rays that are fixed to the vehicle, evenly over each receiver's field of view (the thesis's, 5.2.1)."""

    def __init__(self, sonar: ChannelSonar, surfaces: Surfaces) -> None:
        self.sonar, self.surfaces = sonar, surfaces
        directions = [_even(field, sonar.rays) for field in sonar.field_of_view.values()]
        self.numbers = [np.arange(len(each), dtype=np.uint32) for each in directions]
        self.stored = [mi.Float64(each.ravel()) for each in directions]

    def asked(self, pose: NDArray[np.float64], receiver: int) -> NDArray[np.uint32]:
        """Numbers of the rays that belong to a receiver."""
        return self.numbers[receiver]

    def tables(self, receiver: int) -> tuple[Any, ...]:
        """What a launch reads: directions of the rays, tables of the surfaces."""
        return self.stored[receiver], self.surfaces.arrays()

    def received(self, ways: LinkGeometry, index: mi.UInt32, scene: mi.Scene, tables: tuple[Any, ...]) -> EchoBatch:
        """Delay and amplitude of what the rays hit."""
        directions, facets = tables
        own = [dr.gather(mi.Float64, directions, index * 3 + k) for k in range(3)]
        axes = [ways.vector(9 + 3 * k) for k in range(3)]  # a direction is given along the axes of the field of view
        u = [sum(own[k] * axes[k][axis] for k in range(3)) for axis in range(3)]
        u_sent = mi.Vector3f(*u)
        hit = replace(self.surfaces, **facets).hit(scene, mi.Ray3f(mi.Point3f(*ways.sent_from), u_sent))
        point = [a + axis * mi.Float64(hit.t) for a, axis in zip(ways.sent_from, u, strict=True)]
        to_point, from_receiver = ways.to_point(point)
        delay = delay_iterated(to_point, from_receiver, ways.velocity, self.sonar.sound_speed)
        way_back = mi.Vector3f(*from_receiver)
        received = dr.norm(way_back)
        weight = ways.sensitivity(u_sent, way_back / received)
        amplitude = weight * hit.reflectivity * dr.abs(dr.dot(hit.n, u_sent))
        if self.sonar.spreads:
            amplitude /= hit.t * received
        return ways.told(delay, amplitude, ways.doppler(u_sent, way_back / received), hit.valid & (weight > 0))


def _even(field: FieldOfView, rays: int) -> NDArray[np.float64]:
    """Directions evenly over a field of view, along its axes ``(n, 3)``: about ``rays`` of them within it.

    A little more than the field is covered, since it is the receiver's and rays begin at the transmitter.
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
"""By which rays from the transmitter go beyond a receiver's field of view: 0.1 m at 3 m."""
