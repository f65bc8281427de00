"""Echoes of a scene at a receiver: delay and amplitude of each, from scatterers of the world or from rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView
from mitsonar.plugins.surfaces import Surfaces, registry_index
from mitsonar.simulation.device_arrays import DeviceArray, LaunchTables, padded
from mitsonar.simulation.image_sources import MirrorWay, mirror_ways, mirrored_table
from mitsonar.simulation.link_geometry import EchoBatch, Leg, LinkGeometry, ScatteringPoints, link_table
from mitsonar.simulation.mirror_parts import Mirrors
from mitsonar.simulation.mirror_planes import FlatMirrors, flat_mirrors
from mitsonar.simulation.mirrored_link import MirroredLink
from mitsonar.simulation.propagation_delay import delay_exact, delay_iterated
from mitsonar.simulation.scatterers import Scatterers
from mitsonar.simulation.tracing import height_below
from mitsonar.simulation.variant import Frozen, replayed

__all__ = ["DIRECT", "ChannelTracer", "EchoValues", "ScattererWay"]

EchoValues: TypeAlias = dict[str, NDArray[Any]]
"""Fields of :class:`~mitsonar.simulation.link_geometry.EchoBatch` by name as NumPy arrays ``(points,)``."""

_Launch: TypeAlias = Callable[..., list[DeviceArray]]
"""A frozen launch: indices, scene, link table and tables to values."""


class ScattererWay(NamedTuple):
    """The mirrors between transmitter and scatterers, and those between receiver and scatterers."""

    out: MirrorWay = MirrorWay()
    back: MirrorWay = MirrorWay()

    @property
    def name(self) -> str:
        """Return the names of what sound meets, as ``surface-scatterer-seabed``."""
        return "-".join([name for name in (self.out.name, "scatterer", MirrorWay(self.back.planes[::-1]).name) if name])


DIRECT = ScattererWay()
"""The way without mirrors."""


class ChannelTracer:
    """Trace the echoes of a scene at the receivers of a channel sonar.

    Args:
        scene: any.
        sonar: the instrument.
        like: a tracer of the same scene, whose scatterers may be shared.
        mirrors: mirror parts of the scene's shapes.

    Attributes:
        notes: what a user should know about the scene's BSDFs.
        flat: the scene's mirrors.
        registry: index of each mirror's shape by its place in the scene.
        ways: by which scatterers are reached, the direct one first.

    Raises:
        MitsonarError: no surface can carry scatterers, or a mirror has too many triangles.
    """

    def __init__(
        self, scene: mi.Scene, sonar: ChannelSonar, like: ChannelTracer | None = None, mirrors: Mirrors | None = None
    ) -> None:
        self.scene, self.sonar = scene, sonar
        surfaces = Surfaces.of(scene)
        self.flat: FlatMirrors = flat_mirrors(scene, mirrors)
        self.notes = [*surfaces.notes, *self.flat.notes_on(sonar.bounces)]
        shapes = scene.shapes()
        self.registry = {plane.shape: registry_index(shapes[plane.shape]) for plane in self.flat.reflecting(2)}
        self.ways = _scatterer_ways(self.flat, sonar.bounces)
        self.source: _WorldScatterers | _VehicleRays
        if sonar.model == "scatterers":
            shared = (
                like.source
                if like is not None and like.scene is scene and isinstance(like.source, _WorldScatterers)
                else None
            )
            self.source = _WorldScatterers(scene, sonar, shared, mirrors)
        else:
            self.source = _VehicleRays(sonar, surfaces)
        self.launches: dict[tuple[int, tuple[str, ...], int, int], _Launch] = {}

    def trace(
        self,
        pose: NDArray[np.float64],
        velocity: NDArray[np.float64],
        receiver: int,
        wanted: tuple[str, ...],
        asked: NDArray[np.uint32] | None = None,
        way: ScattererWay = DIRECT,
    ) -> EchoValues:
        """Trace one ping at one receiver: values of an echo batch, one for each point that it may receive from.

        Args:
            pose: of the transmitter ``(6,)`` [m, rad].
            velocity: of the vehicle in its own axes ``(4,)`` [m/s, rad/s].
            receiver: its index.
            wanted: names of the values.
            asked: indices of the points to trace; default: those that the receiver may receive from.
            way: the mirrors between sonar and points.
        """
        asked = self.asked(pose, receiver, way) if asked is None else asked
        if not len(asked):
            return {name: np.zeros(0) for name in wanted}
        key = (receiver, wanted, len(way.out.planes), len(way.back.planes))
        if key not in self.launches:
            self.launches[key] = self._compile(*key)
        table = mi.Float64(padded(self._table(pose, velocity, receiver, way)))
        launch, inputs = self.launches[key], (mi.UInt32(padded(asked)), self.scene, table)
        received = replayed(launch, *inputs, self.source.tables(receiver))
        return {name: np.broadcast_to(np.array(values), len(asked)) for name, values in zip(wanted, received, strict=True)}

    def asked(self, pose: NDArray[np.float64], receiver: int, way: ScattererWay = DIRECT) -> NDArray[np.uint32]:
        """Return indices of the points that a receiver may receive from, by way of mirrors."""
        return self.source.asked(self._table(pose, np.zeros(4), receiver, way), receiver)

    def _table(
        self, pose: NDArray[np.float64], velocity: NDArray[np.float64], receiver: int, way: ScattererWay
    ) -> NDArray[np.float64]:
        table = link_table(self.sonar, receiver, pose, velocity)
        return table if way == DIRECT else mirrored_table(table, way.out, way.back, self.registry)

    def height_m(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height of each pose over what is straight below it ``(pings,)`` [m]; nan where there is nothing."""
        place = mi.Point3f(*(mi.Float(padded(axis.astype(np.float32))) for axis in poses[:, :3].T))
        return np.array(height_below(self.scene, place), dtype=float)

    def _compile(self, receiver: int, wanted: tuple[str, ...], out: int, back: int) -> _Launch:
        """Record a receiver's launch by a number of mirrors; later calls replay it (``dr.freeze``)."""

        @Frozen
        def launch(index: mi.UInt32, scene: mi.Scene, table: mi.Float64, tables: DeviceArray) -> list[DeviceArray]:
            link: LinkGeometry
            if out + back == 0:
                link = LinkGeometry(self.sonar, receiver, table)
            else:
                link = MirroredLink(self.sonar, receiver, table, out, back)
            received = self.source.received(link, index, scene, tables)
            values = [getattr(received, name) for name in wanted]
            dr.eval(values)
            return values

        return launch


def _scatterer_ways(flat: FlatMirrors, bounces: int) -> list[ScattererWay]:
    """Return all ways of scatterers of up to ``bounces`` reflections; that of the scatterer counts as one."""
    return [
        ScattererWay(out, back)
        for mirrors in range(bounces)
        for there in range(mirrors + 1)
        for out in mirror_ways(flat.reflecting(bounces), there)
        for back in mirror_ways(flat.reflecting(bounces), mirrors - there)
    ]


class _WorldScatterers:
    """Echoes of the world's own scatterers."""

    def __init__(self, scene: mi.Scene, sonar: ChannelSonar, like: _WorldScatterers | None, mirrors: Mirrors | None) -> None:
        self.sonar = sonar
        self.scatterers: Scatterers
        self.stored: mi.Float
        self.smooth: frozenset[int] | None = None
        if mirrors is not None or sonar.direct:
            places = (
                [] if mirrors is None else np.flatnonzero((mirrors.reflection != 0) & (mirrors.roughness_m == 0)).tolist()
            )
            self.smooth = frozenset(places)
        if like is not None and _points_of(like.sonar) == _points_of(sonar) and like.smooth == self.smooth:
            self.scatterers, self.stored = like.scatterers, like.stored
        else:
            self.scatterers = Scatterers.of(scene, sonar, self.smooth)
            self.stored = self._rows()
        self.wavenumber = 2 * math.pi / sonar.wavelength_m
        self.roughness: mi.Float | None = None  # rms height of each point's mirror; below 0: it is no mirror
        if mirrors is not None:
            height = np.where(mirrors.reflection == 0, -1.0, mirrors.roughness_m).astype(np.float32)
            self.roughness = mi.Float(height[self.scatterers.shape])

    def _rows(self) -> mi.Float:
        """Return place, strength, normal and phase of all points."""
        rows = np.zeros((len(self.scatterers), 8), np.float32)  # two fetches of 16 bytes a point
        rows[:, :3], rows[:, 3] = self.scatterers.place, self.scatterers.strength
        rows[:, 4:7], rows[:, 7] = self.scatterers.normal, self.scatterers.phase
        return mi.Float(rows.ravel())

    def asked(self, table: NDArray[np.float64], receiver: int) -> NDArray[np.uint32]:
        """Return indices of the scatterers that a receiver may receive from, given the geometry of its link."""
        return self.scatterers.within(table[3:6], table[12:21].reshape(3, 3), self.sonar.receivers[receiver].field)

    def tables(self, receiver: int) -> list[mi.Float]:
        """Return the inputs of a launch: position, strength, normal and phase of all points; roughness with mirrors."""
        return [self.stored] if self.roughness is None else [self.stored, self.roughness]

    def received(self, link: LinkGeometry, index: mi.UInt32, scene: mi.Scene, tables: list[mi.Float]) -> EchoBatch:
        """Return the echoes of the scatterers that transmitter and receiver see."""
        first: DeviceArray = dr.gather(mi.Vector4f, tables[0], index * 2)
        second: DeviceArray = dr.gather(mi.Vector4f, tables[0], index * 2 + 1)
        at, strength, normal = mi.Point3f(first.x, first.y, first.z), first.w, mi.Normal3f(second.x, second.y, second.z)
        exact = [mi.Float64(value) for value in at]
        to_point, from_receiver = link.to_point(exact)
        delay = delay_exact(to_point, from_receiver, link.velocity, self.sonar.sound_speed)
        way_out, way_back = mi.Vector3f(*to_point), mi.Vector3f(*from_receiver)
        sent, received = dr.norm(way_out), dr.norm(way_back)
        u_sent: DeviceArray = way_out / sent
        u_received: DeviceArray = way_back / received
        weight = link.sensitivity(u_sent, u_received)
        cosines = dr.dot(normal, u_sent), dr.dot(normal, u_received)
        lambert = cosines[0] * cosines[1]
        inside = (weight > 0) & (lambert > 0)
        point = ScatteringPoints(at, exact, normal)
        open_, factor = link.reached(scene, point, Leg(u_sent, sent), Leg(u_received, received), inside)
        seen = inside & open_
        amplitude = weight * dr.sqrt(dr.select(seen, strength * lambert, 0))
        if self.sonar.spreads:
            amplitude /= sent * received
        if factor is not None:
            amplitude *= factor
        if len(tables) > 1:  # a mirror scatters what its roughness takes from the mirror's echo
            height = dr.gather(mi.Float, tables[1], index)
            lost = 1 - dr.exp(-dr.square(height * self.wavenumber * (cosines[0] + cosines[1])))
            amplitude *= dr.sqrt(dr.select(height < 0, 1, lost))
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

    def asked(self, table: NDArray[np.float64], receiver: int) -> NDArray[np.uint32]:
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
