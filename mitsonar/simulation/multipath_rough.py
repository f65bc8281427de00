"""Paths of several reflections in pings of the model ``physical``: which beams hear them, and exact sums of their levels."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from mitsonar.acoustics.noise import uniform
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import Whole
from mitsonar.motion.pose import to_world_matrices
from mitsonar.plugins.imaging_sonar_sensor import Fan
from mitsonar.plugins.material_laws import material_of
from mitsonar.plugins.surfaces import Hit, Surfaces
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.beams import RANGES_A_PULSE, SINES_A_LOBE, angles_of, beam_at, elevation_gain_of_ends
from mitsonar.simulation.binning import ViewEchoes, WholeTracer, accumulate, fraction_bits, half_path_rate
from mitsonar.simulation.coherent_tracing import ADD, CoherentTracer, FanRays
from mitsonar.simulation.device import DeviceArray, Frozen, LaunchTables, replayed
from mitsonar.simulation.mirrors import Mirroring, SecondMirrors, mirror_of, parts_at, smooth_share, without_mirror_part
from mitsonar.simulation.moving import scene_at
from mitsonar.simulation.tracing import MovingSurfaces, going_on, hidden, lambert_direction, overlap, reflected

if TYPE_CHECKING:
    from mitsonar.simulation.tracing import Rays

__all__ = ["Arrival", "BounceSums", "DiffuseField", "Vertex", "Walk", "at_most_one"]


MOST_OF_A_RAY = 64
"""Levels of a ray's arrivals in one bin, at most, in levels of one reflection at the same ranges: C is at most 1."""


class BounceSums:
    """Sum the levels of paths of several reflections.

    Args:
        scene: to trace.
        sonar: tells the patterns.
        traced: its hard boxes; the sonar itself without a pattern.
        mirroring: mirror parts of shapes.

    Attributes:
        tracer: of the whole view; its fraction bits are those of these sums, apart from those of one reflection.

    Raises:
        MitsonarError: rough mirrors and no carrier.
    """

    def __init__(self, scene: mi.Scene, sonar: Sonar, traced: Sonar, mirroring: Mirroring) -> None:
        self.sonar, self.traced, self.tracer = sonar, traced, WholeTracer(Whole(traced))
        found = mirror_of(scene, mirroring)
        if found is not None and sonar.frequency_hz is None and (found.roughness_m * (found.reflection != 0)).any():
            raise MitsonarError(
                "what a rough mirror loses depends on the carrier: got a rms height and no frequency_hz; give frequency_hz"
            )
        self.wavenumber = 2 * math.pi * (sonar.frequency_hz or 0.0) / sonar.sound_speed
        self.nearest = max(traced.range_min, traced.bin_m)
        # the last surface may be near and the path long: R^g / nearest^2 against the R^(g - 2) of one reflection
        spread = max(1.0, traced.range_max / self.nearest) ** min(traced.gain_exponent, 2)
        self.tracer.bits = fraction_bits(traced, traced.rays, MOST_OF_A_RAY * spread)
        self.second = SecondMirrors.of(scene, found, self.wavenumber) if sonar.bounces > 2 else None
        self.tables_of_mirrors: LaunchTables | None = None
        if found is not None:
            lawless = [float(shape.bsdf() is None or material_of(shape) is None) for shape in scene.shapes()]
            self.tables_of_mirrors = {"parts": found.table(), "lawless": mi.Float([*lawless, 0.0])}
            dr.eval(self.tables_of_mirrors)

    def scattered(self, echoes: Echoes, mirrors: LaunchTables | None) -> tuple[Echoes, DeviceArray]:
        """Return echoes without the mirrors' part, and the amplitude that mirrors leave; 0: no mirror."""
        if mirrors is None:
            return echoes, mi.Float(0)
        known = (echoes.hit > 0) & (echoes.shape_id >= 0)
        place = mi.UInt32(dr.select(known, echoes.shape_id, 0))
        pair = dr.gather(mi.Vector2f, mirrors["parts"], place, known)
        share = smooth_share(pair.y, echoes.cosine, self.wavenumber)
        taken = (pair.x != 0) & (dr.gather(mi.Float, mirrors["lawless"], place, known) > 0)
        kept = dr.select(taken, echoes.reflectivity * (1 - dr.square(share)), echoes.reflectivity)
        return replace(echoes, reflectivity=kept), pair.x * share

    def sums(
        self,
        scene: mi.Scene,
        surfaces: Surfaces,
        rays: Rays,
        lines: list[mi.Vector4f],
        seen: tuple[Fan, Echoes, DeviceArray],
        keys: DeviceArray,
        mirrors: LaunchTables | None,
        pings: int,
    ) -> mi.UInt64:
        """Return the sums of a launch ``(pings, beams, stride)``, flat, as :func:`mitsonar.simulation.binning.accumulate`.

        Args:
            scene: to trace.
            surfaces: its tables.
            rays: of the launch.
            lines: three rows of ``to_world`` for each ray.
            seen: fan in world axes, echoes of one reflection and amplitudes of :meth:`scattered`, without a pattern.
            keys: of the draws, one for each ray.
            mirrors: tables of :attr:`tables_of_mirrors`.
            pings: number of pings in the launch.
        """
        fan, echoes, reflection = seen
        mirror = reflection != 0
        begin = Vertex(
            valid=echoes.hit > 0,
            place=mi.Point3f(echoes.x, echoes.y, echoes.z),
            n=mi.Normal3f(echoes.nx, echoes.ny, echoes.nz),
            d=fan.d,
            lift=fan.lift,
            side=fan.side,
            reflectivity=at_most_one(echoes.reflectivity),
            reflection=reflection,
            length=echoes.range_m,
            gain=mi.Float(1),
            pure=mi.Bool(True),
            first=mirror,
        )
        origin = mi.Point3f(*(line.w for line in lines))
        table, width = None if mirrors is None else mirrors["parts"], (echoes.far_m - echoes.near_m) * 0.25
        moment: DeviceArray = mi.Float(rays.moment) if isinstance(surfaces, MovingSurfaces) else None
        cell = fan.below, fan.above, fan.aside, width
        walk = Walk(scene, surfaces, table, self.sonar.bounces, self.wavenumber, origin, *cell, moment, self.second)
        sums: mi.UInt64 | None = None
        for arrival in walk.arrivals(begin, rays.ray, keys):
            for heard in self._heard(arrival, echoes, fan, lines, rays):
                sums = accumulate(heard, rays.ping, pings, self.tracer, sums, counted=False)
        assert sums is not None
        return sums

    def _heard(self, arrival: Arrival, echoes: Echoes, fan: Fan, lines: list[mi.Vector4f], rays: Rays) -> list[ViewEchoes]:
        """Return the arrivals in the beams that hear them, a path and its reverse where both are to be added."""
        sonar, traced = self.sonar, self.traced
        level = self._levels(arrival, echoes)
        if arrival.same:
            gain = dr.square(self._vertical(fan.elevation, fan.elevation))
            return [ViewEchoes(_scaled(level, gain), rays.beam, arrival.active, fan.elevation)]
        bearing, elevation = self._angles(fan.d, lines)
        other, lift = self._angles(arrival.toward, lines)
        at, inside = beam_at(traced, other)
        high: DeviceArray = dr.abs(lift)
        active = arrival.active & inside & (high <= math.radians(traced.elevation_fov_deg) / 2)
        there, back = dr.square(self._vertical(elevation, lift)), dr.square(self._vertical(lift, elevation))
        if sonar.beam_pattern == "two_way":  # heard in the beams between both ends, a path and its reverse in phase
            part = dr.square(overlap(sonar, dr.sin(bearing) - dr.sin(other))) * dr.select(arrival.reverse, 4.0, 2.0)
            middle, known = beam_at(traced, (bearing + other) * 0.5)
            return [ViewEchoes(_scaled(level, there * part), middle, active & known, fan.elevation)]
        if sonar.beam_pattern == "box":
            together = dr.select(at == rays.beam, 2.0, 1.0)
        else:
            together = 1 + overlap(sonar, dr.sin(bearing) - dr.sin(other))
        found = [ViewEchoes(_scaled(level, there * together), rays.beam, active, fan.elevation)]
        found += [ViewEchoes(_scaled(level, back * together), at, active & arrival.reverse, fan.elevation)]
        return found

    def _levels(self, arrival: Arrival, echoes: Echoes) -> Echoes:
        """Return arrivals as echoes of which :func:`mitsonar.acoustics.levels.level` makes their level."""
        radius, distance = (dr.select(v > self.nearest, v, self.nearest) for v in (arrival.range_m, arrival.distance))
        return replace(
            echoes,
            hit=dr.select(arrival.active, mi.Float(1), 0),
            range_m=arrival.range_m,
            near_m=arrival.low_m,
            far_m=arrival.high_m,
            reflectivity=arrival.reflectivity,
            cosine=arrival.cosine,
            solid_angle_sr=echoes.solid_angle_sr * dr.square(radius / distance),
        )

    def _vertical(self, arrival: DeviceArray, departure: DeviceArray) -> DeviceArray:
        """Return the amplitude of the pattern over elevation; 1 without a pattern of the beams."""
        if self.sonar.beam_pattern == "box":
            return mi.Float(1)
        return elevation_gain_of_ends(self.sonar, dr.tan(arrival), dr.tan(departure))

    def _angles(self, u: DeviceArray, lines: list[mi.Vector4f]) -> tuple[DeviceArray, DeviceArray]:
        """Return bearing and elevation of directions in the world [rad]."""
        port, up, forward = (sum(line[axis] * u[row] for row, line in enumerate(lines)) for axis in range(3))
        return angles_of(self.traced, -port, forward, up)


def _scaled(echoes: Echoes, gain: DeviceArray) -> Echoes:
    """Return echoes of which a part is heard."""
    return replace(echoes, reflectivity=echoes.reflectivity * gain)


def bounce_sums(scene: mi.Scene, sonar: Sonar, traced: Sonar, mirroring: Mirroring) -> BounceSums | None:
    """Return what sums paths of several reflections in the model ``physical``; None where there is one reflection."""
    if sonar.bounces == 1 or sonar.model != "physical":
        return None
    return BounceSums(scene, sonar, traced, mirroring)


# ---------------- Paths of two and three reflections, one a ray: energies by way of mirrors and of rough surfaces
# A ray that meets a mirror goes on as from a mirror; what it brings back is multiplied by V^2 exp(-4 k^2 h^2 cos^2).
# One that meets another surface goes on in a direction drawn from Lambert's law, and is multiplied by pi C, so that its
# mean is the integral over all directions. Each further surface P of reflectivity C that the sonar sees sends back
#
#     level = product  C_P cos_P / R_P^2  dOmega
#
# with the angle and the range of P from the sonar: the source lights P straight, and the ray's cell dOmega hears it.
# The range is half of the path. A path and its reverse have one length. What begins at a mirror is not drawn from its
# other end, so the caller adds the reverse. Rays to P by one mirror and back by the same or another one are further
# kinds, of three.


DRAWS = 0x6D756C74
"""Keeps the draws of directions apart from those of the jitter."""


@dataclass
class Vertex:
    """Where a path meets a surface.

    Attributes:
        valid: whether it does.
        place: the point [m].
        n: unit normal.
        d: direction of the ray that meets it; ``lift`` and ``side``: how it turns with the first ray's angles, where all
            reflections so far were of mirrors.
        reflectivity: of what is scattered.
        reflection: amplitude that a mirror leaves; 0: it is none.
        length: of the path so far [m].
        gain: of the energy so far.
        pure: whether all reflections so far were of mirrors; ``first``: whether the first was.
    """

    valid: DeviceArray
    place: DeviceArray
    n: DeviceArray
    d: DeviceArray
    lift: DeviceArray
    side: DeviceArray
    reflectivity: DeviceArray
    reflection: DeviceArray
    length: DeviceArray
    gain: DeviceArray
    pure: DeviceArray
    first: DeviceArray


@dataclass
class Arrival:
    """A path that has come back along its ray.

    Attributes:
        active: whether it has.
        reflectivity: of the last surface, times the energy's gain on the way.
        cosine: to the normal there, of the line to the sonar.
        distance: of the last surface from the sonar [m].
        range_m: half of the path [m].
        low_m, high_m: of the path by the cell's lower and upper edge.
        toward: unit direction from the sonar to the last surface.
        reverse: whether the reverse is to be added.
        pure: whether all reflections but that of the last surface were of mirrors.
        same: whether it left along its ray as well.
    """

    active: DeviceArray
    reflectivity: DeviceArray
    cosine: DeviceArray
    distance: DeviceArray
    range_m: DeviceArray
    low_m: DeviceArray
    high_m: DeviceArray
    toward: DeviceArray
    reverse: DeviceArray
    pure: DeviceArray
    same: bool = False


@dataclass
class Walk:
    """Follow paths from their first surface on.

    Attributes:
        scene: to trace.
        surfaces: its tables.
        mirrors: table of :class:`~mitsonar.simulation.mirrors.Mirrors`; None: no mirrors.
        bounces: largest number of reflections.
        wavenumber: of the carrier [1/m].
        origin: of the sonar [m].
        below, above, aside: elevations of the edges and bearing of the middle of each ray's cell, relative to the ray [rad].
        width: half-length of the path's range interval by way of rough surfaces [m].
        moment: number of the moment of each ray in a scene that moves; None: a still scene.
        second: planes for ways back by another mirror; None: there are no such ways.
    """

    scene: mi.Scene
    surfaces: Surfaces
    mirrors: mi.Float | None
    bounces: int
    wavenumber: float
    origin: DeviceArray
    below: DeviceArray
    above: DeviceArray
    aside: DeviceArray
    width: DeviceArray
    moment: DeviceArray = None
    second: SecondMirrors | None = None

    def arrivals(self, begin: Vertex, ray: DeviceArray, key: DeviceArray) -> Iterator[Arrival]:
        """Yield the arrivals of two reflections, then those of three.

        Args:
            begin: the first surface of each ray.
            ray: number of each ray.
            key: of the draws, 32 bits.
        """
        now = begin
        for number in range(2, self.bounces + 1):
            now = self._next(now, ray, key + (DRAWS + number))
            if number == 2 and self.bounces > 2 and self.mirrors is not None:
                yield self._back_again(now)
                yield from self._by_others(begin, now)
            yield self._straight(now)

    def _next(self, now: Vertex, ray: DeviceArray, key: DeviceArray) -> Vertex:
        """Follow paths to the next surface."""
        mirror = now.reflection != 0
        # a drawn direction turns with no angle of the first ray, so what is turned of a rough surface's counts for nothing
        d = dr.select(mirror, reflected(now.d, now.n), lambert_direction(now.n, now.d, ray, key))
        gain = now.gain * dr.select(mirror, dr.square(now.reflection), now.reflectivity * dr.pi)
        begin = going_on(now.place, d, now.n)
        active = now.valid & (gain > 0)
        onward = mi.Ray3f(now.place + d * begin, d)
        if self.moment is not None:
            onward.time = self.moment
        hit = self.surfaces.hit(self.scene, onward, active)
        reflection: DeviceArray = mi.Float(0)
        if self.mirrors is not None:
            part, roughness_m = parts_at(self.mirrors, hit)
            reflection = part * smooth_share(roughness_m, dr.dot(hit.n, d), self.wavenumber)
            hit = without_mirror_part(self.mirrors, hit, d, self.wavenumber)
        along: DeviceArray = begin + hit.t
        return Vertex(
            valid=active & hit.valid,
            place=now.place + d * along,
            n=hit.n,
            d=d,
            lift=reflected(now.lift, now.n),
            side=reflected(now.side, now.n),
            reflectivity=at_most_one(hit.reflectivity),
            reflection=reflection,
            length=now.length + along,
            gain=gain,
            pure=now.pure & mirror,
            first=now.first,
        )

    def _straight(self, now: Vertex) -> Arrival:
        """Return what arrives from a surface that the sonar lights straight."""
        way: DeviceArray = now.place - self.origin
        distance = dr.norm(way)
        u = way / distance
        toward = dr.dot(now.n, u)
        lit = now.valid & (now.reflectivity > 0) & (toward * dr.dot(now.n, now.d) > 0)
        lit &= ~hidden(self.scene, mi.Point3f(now.place), now.n, u, distance, lit, self.moment)
        half = (now.length + distance) * 0.5
        low, high = self._edges(now, u, half)
        cosine = dr.abs(toward)
        return Arrival(
            active=lit,
            reflectivity=now.reflectivity * now.gain,
            cosine=dr.select(cosine < 1, cosine, 1),
            distance=distance,
            range_m=half,
            low_m=dr.select(now.pure, low, half - self.width),
            high_m=dr.select(now.pure, high, half + self.width),
            toward=u,
            reverse=now.first,
            pure=now.pure,
        )

    def _back_again(self, now: Vertex) -> Arrival:
        """Return what leaves and arrives by the same mirror."""
        low, high = self._edges(now, now.d, now.length)
        cosine = dr.abs(dr.dot(now.n, now.d))
        return Arrival(
            active=now.valid & now.pure & (now.reflectivity > 0),
            reflectivity=now.reflectivity * dr.square(now.gain),
            cosine=dr.select(cosine < 1, cosine, 1),
            distance=now.length,
            range_m=now.length,
            low_m=low,
            high_m=high,
            toward=now.d,
            reverse=mi.Bool(False),
            pure=now.pure,
            same=True,
        )

    def _by_others(self, first: Vertex, now: Vertex) -> Iterator[Arrival]:
        """Yield what left by one mirror and arrives by another. The reverse is that of the ray to the other mirror."""
        if self.second is None:
            return
        met = now.valid & now.pure & (now.reflectivity > 0)
        point, mirror = (now.place, now.n), (first.place, first.n)
        for way in self.second.ways(self.scene, self.origin, point, mirror, met, self.moment):
            half = (now.length + way.distance) * 0.5
            toward = dr.dot(now.n, way.u)
            cosine = dr.abs(toward)
            low, high = self._edges(now, way.u, half)
            yield Arrival(
                active=met & way.is_open & (toward * dr.dot(now.n, now.d) > 0),
                reflectivity=now.reflectivity * now.gain * dr.square(way.factor),
                cosine=dr.select(cosine < 1, cosine, 1),
                distance=way.distance,
                range_m=half,
                low_m=low,
                high_m=high,
                toward=reflected(way.u, mi.Vector3f(way.mirror.normal)),
                reverse=mi.Bool(False),
                pure=mi.Bool(True),
            )

    def _edges(self, now: Vertex, u: DeviceArray, half: DeviceArray) -> tuple[DeviceArray, DeviceArray]:
        """Return half the path by way of a cell's lower and upper edge, on the tangent plane; ``u`` from the other end."""
        lift = half_path_rate(now.length, now.d, now.lift, u, now.n)
        middle = half + half_path_rate(now.length, now.d, now.side, u, now.n) * self.aside
        low, high = middle + lift * self.below, middle + lift * self.above
        return dr.select(low < high, low, high), dr.select(low < high, high, low)


def at_most_one(reflectivity: DeviceArray) -> DeviceArray:
    """Return Lambert's mu of further reflections, at most 1: laws of materials exceed it where a ray grazes."""
    return dr.select(reflectivity < 1, reflectivity, 1)


# ---------------- The field of paths by way of two and three rough surfaces, in the model ``coherent``
# Their energies are sums over rays (:mod:`mitsonar.simulation.multipath_rough`) in coarse cells of sine and range, about as
# large as beam and pulse resolve. Each node of the grid in a cell gets its part of the energy times a complex Gaussian
# number, a hash of (seed, node). So the speckle is that of very many paths, and a sonar at rest sees it unchanged; its
# grain does not move with the ground.


GRAIN = 0x64696666
"""Keeps the grain of these paths apart from noise and volume."""

SMOOTHED = 3
"""Coarse cells each way over which the energies of single rays are spread."""


class DiffuseField:
    """Sum the energies of paths by way of rough surfaces, and give them speckle.

    Args:
        tracer: of one reflection.
    """

    def __init__(self, tracer: CoherentTracer) -> None:
        self.direct, self.sonar, self.former = tracer, tracer.sonar, tracer.former
        former = tracer.former
        self.wavenumber = 2 * math.pi / tracer.wavelength
        self.nearest = max(former.first_range, tracer.sonar.bin_m)
        self.shape = -(-former.sines // SINES_A_LOBE), -(-former.ranges // RANGES_A_PULSE)
        fan = tracer.fan
        cell = 4 * fan.sine * fan.tangent / fan.rays
        loudest = MOST_OF_A_RAY * cell / self.nearest**2
        self.bits = 62 - math.ceil(math.log2(loudest * fan.rays))
        self.launch = self._compile()

    def add(self, pose: NDArray[np.float64], field: NDArray[np.complex64], time_s: float = 0.0) -> None:
        """Add these paths of one ping to its field ``(sines, ranges)``, in place, at a pose ``(6,)`` and a time [s]."""
        energy = self.energy(pose, time_s)
        if not energy.any():
            return
        smooth = uniform_filter(energy, SMOOTHED, mode="nearest")
        nodes = SINES_A_LOBE * RANGES_A_PULSE
        amplitude = np.sqrt(np.maximum(smooth, 0) * (self.former.kept / nodes)).astype(np.float32)
        grain = self._grain.reshape(self.shape[0], SINES_A_LOBE, self.shape[1], RANGES_A_PULSE)
        made = (grain * amplitude[:, None, :, None]).reshape(self._grain.shape)
        field += made[: field.shape[0], : field.shape[1]]

    def energy(self, pose: NDArray[np.float64], time_s: float = 0.0) -> NDArray[np.float64]:
        """Return the energies of one ping in coarse cells ``self.shape``, relative to the source's at 1 m."""
        direct = self.direct
        rows = mi.Float64(to_world_matrices(pose.reshape(1, 6))[0, :3].astype(np.float64).ravel().tolist())
        scene = scene_at(direct.scene, direct.motion, time_s)
        sums = replayed(self.launch, direct.index, scene, rows, direct.surfaces.arrays(), direct.mirrors)
        return np.array(sums, copy=False).reshape(self.shape).astype(np.float64) * 2.0**-self.bits

    @cached_property
    def _grain(self) -> NDArray[np.complex64]:
        """Return complex Gaussian numbers of mean power 1 on all nodes of the coarse cells."""
        shape = 1, self.shape[0] * SINES_A_LOBE, self.shape[1] * RANGES_A_PULSE
        first, second = uniform(shape, seed=self.sonar.seed ^ GRAIN, frames=np.array([0]), like=np.empty(0))
        return np.asarray(np.sqrt(-np.log(first[0])) * np.exp(2j * math.pi * second[0]), dtype=np.complex64)

    def _compile(self) -> Callable[..., Any]:
        @Frozen
        def launch(index: Any, scene: Any, rows: Any, tables: Any, mirrors: Any) -> Any:
            lines = [[dr.gather(mi.Float64, rows, mi.UInt32(4 * i + j)) for j in range(4)] for i in range(3)]
            rays = FanRays(self.direct.fan, self.sonar, index, lines)
            surfaces = replace(self.direct.surfaces, **tables)
            hit = surfaces.hit(scene, mi.Ray3f(rays.origin, rays.d))
            begin = self._begin(rays, hit, mirrors)
            none = mi.Float(0)
            origin: DeviceArray = rays.origin
            walk = Walk(scene, surfaces, mirrors, self.sonar.bounces, self.wavenumber, origin, none, none, none, none)
            cell = dr.norm(dr.cross(rays.by_sine, rays.by_tangent)) * (rays.sine_step * rays.tangent_step)
            sums = dr.zeros(mi.UInt64, self.shape[0] * self.shape[1])
            for arrival in walk.arrivals(begin, index, mi.UInt32(self.sonar.seed * 7919 & 0xFFFFFFFF)):
                if not arrival.same:
                    self._deposit(rays, arrival, cell, sums)
            dr.eval(sums)
            return mi.Float64(sums)

        return launch

    def _begin(self, rays: FanRays, hit: Hit, mirrors: mi.Float | None) -> Vertex:
        """Return the first surface of each ray."""
        reflection: DeviceArray = mi.Float(0)
        if mirrors is not None:
            part, roughness_m = parts_at(mirrors, hit)
            reflection = part * smooth_share(roughness_m, dr.dot(hit.n, rays.d), self.wavenumber)
            hit = without_mirror_part(mirrors, hit, rays.d, self.wavenumber)
        return Vertex(
            valid=hit.valid,
            place=rays.origin + rays.d * hit.t,
            n=hit.n,
            d=rays.d,
            lift=mi.Vector3f(0),
            side=mi.Vector3f(0),
            reflectivity=at_most_one(hit.reflectivity),
            reflection=reflection,
            length=hit.t,
            gain=mi.Float(1),
            pure=mi.Bool(True),
            first=reflection != 0,
        )

    def _deposit(self, rays: FanRays, arrival: Arrival, cell: DeviceArray, sums: mi.UInt64) -> None:
        """Add the energies of arrivals to the coarse cells of the beams that hear them."""
        other, tangent, ahead = rays.direction(arrival.toward)
        sine, own = rays.sine, rays.tangent
        distance = dr.select(arrival.distance > self.nearest, arrival.distance, self.nearest)
        level = arrival.reflectivity * arrival.cosine * cell / dr.square(distance)
        there = dr.square(elevation_gain_of_ends(self.sonar, own, tangent))
        active, both = arrival.active & ~arrival.pure & ahead, overlap(self.sonar, sine - other)
        if self.sonar.beam_pattern == "two_way":  # heard in the beams between both ends, a path and its reverse in phase
            level = level * there * dr.square(both) * dr.select(arrival.reverse, 4.0, 2.0)
            self._add(sums, (sine + other) * 0.5, arrival.range_m, level, active)
            return
        back = dr.square(elevation_gain_of_ends(self.sonar, tangent, own))
        self._add(sums, sine, arrival.range_m, level * there * (1 + both), active)
        self._add(sums, other, arrival.range_m, level * back * (1 + both), active & arrival.reverse)

    def _add(
        self, sums: mi.UInt64, sine: DeviceArray, range_m: DeviceArray, level: DeviceArray, active: DeviceArray
    ) -> None:
        former = self.former
        line = (sine - former.first_sine) * (1 / (former.sine_step * SINES_A_LOBE))
        place = (range_m - former.first_range) * (1 / (former.range_step * RANGES_A_PULSE))
        kept = active & (line >= 0) & (line < self.shape[0]) & (place >= 0) & (place < self.shape[1])
        where = mi.UInt32(dr.select(kept, line, 0)) * self.shape[1] + mi.UInt32(dr.select(kept, place, 0))
        value = mi.UInt64(mi.Float64(level) * 2.0**self.bits)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, value, where, kept, mode=ADD)
