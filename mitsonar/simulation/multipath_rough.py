"""Multipath via rough surfaces: how the energies of paths with several reflections are traced.

The model ``physical`` sums the levels of these paths exactly, in the beams that receive them
(:class:`~mitsonar.simulation.models.physical.BounceSums`). The model ``coherent`` adds them as speckle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from mitsonar.acoustics.noise import uniform
from mitsonar.motion.pose import to_world_matrices
from mitsonar.plugins.surfaces import Hit, Surfaces
from mitsonar.simulation.beams import elevation_gain_of_ends
from mitsonar.simulation.coherent_tracing import ADD, CoherentTracer, FanRays
from mitsonar.simulation.device import DeviceArray, Frozen, replayed
from mitsonar.simulation.mirrors import SecondMirrors, parts_at, smooth_share, without_mirror_part
from mitsonar.simulation.moving import scene_at
from mitsonar.simulation.points import seed_bits
from mitsonar.simulation.tracing import going_on, half_path_rate, hidden, lambert_direction, overlap, reflected

__all__ = ["Arrival", "DiffuseField", "Vertex", "Walk", "at_most_one"]


MOST_OF_A_RAY = 64
"""Bound of the levels of a ray's arrivals in one bin, relative to one reflection at the same ranges with C = 1."""

DRAWS = 0x6D756C74
"""Key that separates the random directions from the random jitter."""


@dataclass
class Vertex:
    """Point where a path meets a surface.

    Attributes:
        valid: whether the path meets a surface.
        place: position [m].
        n: unit normal.
        d: direction of the incident ray.
        lift, side: derivatives of ``d`` by the first ray's elevation and bearing, if all reflections so far were specular.
        reflectivity: reflectivity of the scattered part.
        reflection: amplitude factor of the mirror; 0 if the surface is not a mirror.
        length: length of the path so far [m].
        gain: gain of the energy so far.
        pure: whether all reflections so far were specular.
        first: whether the first reflection was specular.
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
    """Path that has returned along its ray.

    Attributes:
        active: whether the path exists.
        reflectivity: reflectivity of the last surface, times the gain of the energy along the path.
        cosine: cosine between the normal of the last surface and the line to the sonar.
        distance: distance of the last surface from the sonar [m].
        range_m: half the length of the path [m].
        low_m, high_m: nearest and farthest half length of the paths via the cell's lower and upper edge [m].
        toward: unit direction from the sonar to the last surface.
        reverse: whether the reverse path is to be added.
        pure: whether all reflections except that of the last surface were specular.
        same: whether the path also left along its ray.
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
    """Tracer that follows paths of two and three reflections from their first surface, one per ray.

    A ray that meets a mirror is reflected specularly, and its energy is multiplied by V^2 exp(-4 k^2 h^2 cos^2). A ray that
    meets another surface continues in a direction drawn from Lambert's law, and its energy is multiplied by pi C, so that
    the mean is the integral over all directions. Each further surface P of reflectivity C that the sonar sees sends back::

        level = product  C_P cos_P / R_P^2  dOmega

    with the angle and the range of P from the sonar: the source insonifies P directly, and the ray's cell dOmega receives
    it. The range is half the length of the path. A path and its reverse have the same length. A path that begins at a mirror
    is not drawn from its other end, so the caller adds the reverse. Further kinds, with three reflections, go to P via one
    mirror and return via the same or another one.

    Attributes:
        scene: scene to trace.
        surfaces: surface tables of the scene.
        mirrors: table of :class:`~mitsonar.simulation.mirrors.Mirrors`; None without mirrors.
        bounces: largest number of reflections.
        wavenumber: wavenumber of the carrier [1/m].
        origin: position of the sonar [m].
        below, above, aside: elevations of the edges and bearing of the centre of each ray's cell, relative to the ray [rad].
        width: half the width of the range interval of paths via rough surfaces [m].
        moment: index of the moment of each ray in a moving scene; None for a still scene.
        second: planes for return paths via another mirror; None if there are no such paths.
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
            key: 32-bit key of the random numbers.
        """
        vertex = begin
        for number in range(2, self.bounces + 1):
            vertex = self._next(vertex, ray, key + (DRAWS + number))
            if number == 2 and self.bounces > 2 and self.mirrors is not None:
                yield self._same_mirror_return(vertex)
                yield from self._other_mirror_returns(begin, vertex)
            yield self._direct_return(vertex)

    def _next(self, vertex: Vertex, ray: DeviceArray, key: DeviceArray) -> Vertex:
        """Follow paths to the next surface."""
        # 1. new direction and gain: specular at mirrors, drawn from Lambert's law at rough surfaces
        mirror = vertex.reflection != 0
        d = dr.select(mirror, reflected(vertex.d, vertex.n), lambert_direction(vertex.n, vertex.d, ray, key))
        gain = vertex.gain * dr.select(mirror, dr.square(vertex.reflection), vertex.reflectivity * dr.pi)
        # 2. trace on from just off the surface
        begin = going_on(vertex.place, d, vertex.n)
        active = vertex.valid & (gain > 0)
        onward = mi.Ray3f(vertex.place + d * begin, d)
        if self.moment is not None:
            onward.time = self.moment
        hit = self.surfaces.hit(self.scene, onward, active)
        # 3. split the next surface into its mirror part and its scattered part
        reflection: DeviceArray = mi.Float(0)
        if self.mirrors is not None:
            part, roughness_m = parts_at(self.mirrors, hit)
            reflection = part * smooth_share(roughness_m, dr.dot(hit.n, d), self.wavenumber)
            hit = without_mirror_part(self.mirrors, hit, d, self.wavenumber)
        # 4. lift and side are mirrored everywhere; after a rough surface they have no meaning, and ``pure`` is false
        along: DeviceArray = begin + hit.t
        return Vertex(
            valid=active & hit.valid,
            place=vertex.place + d * along,
            n=hit.n,
            d=d,
            lift=reflected(vertex.lift, vertex.n),
            side=reflected(vertex.side, vertex.n),
            reflectivity=at_most_one(hit.reflectivity),
            reflection=reflection,
            length=vertex.length + along,
            gain=gain,
            pure=vertex.pure & mirror,
            first=vertex.first,
        )

    def _direct_return(self, vertex: Vertex) -> Arrival:
        """Return what arrives from a surface that the sonar insonifies directly."""
        # 1. visible from the sonar, on the side that the path meets
        from_sonar: DeviceArray = vertex.place - self.origin
        distance = dr.norm(from_sonar)
        u = from_sonar / distance
        toward = dr.dot(vertex.n, u)
        lit = vertex.valid & (vertex.reflectivity > 0) & (toward * dr.dot(vertex.n, vertex.d) > 0)
        lit &= ~hidden(self.scene, mi.Point3f(vertex.place), vertex.n, u, distance, lit, self.moment)
        # 2. range interval: from the cell's edges after mirrors only, of constant width otherwise
        half = (vertex.length + distance) * 0.5
        low, high = self._edges(vertex, u, half)
        cosine = dr.abs(toward)
        return Arrival(
            active=lit,
            reflectivity=vertex.reflectivity * vertex.gain,
            cosine=dr.select(cosine < 1, cosine, 1),
            distance=distance,
            range_m=half,
            low_m=dr.select(vertex.pure, low, half - self.width),
            high_m=dr.select(vertex.pure, high, half + self.width),
            toward=u,
            reverse=vertex.first,
            pure=vertex.pure,
        )

    def _same_mirror_return(self, vertex: Vertex) -> Arrival:
        """Return what leaves and arrives via the same mirror."""
        low, high = self._edges(vertex, vertex.d, vertex.length)
        cosine = dr.abs(dr.dot(vertex.n, vertex.d))
        return Arrival(
            active=vertex.valid & vertex.pure & (vertex.reflectivity > 0),
            reflectivity=vertex.reflectivity * dr.square(vertex.gain),
            cosine=dr.select(cosine < 1, cosine, 1),
            distance=vertex.length,
            range_m=vertex.length,
            low_m=low,
            high_m=high,
            toward=vertex.d,
            reverse=mi.Bool(False),
            pure=vertex.pure,
            same=True,
        )

    def _other_mirror_returns(self, first: Vertex, vertex: Vertex) -> Iterator[Arrival]:
        """Yield what leaves via one mirror and arrives via another; the reverse belongs to the ray to the other mirror."""
        if self.second is None:
            return
        valid = vertex.valid & vertex.pure & (vertex.reflectivity > 0)
        point, mirror = (vertex.place, vertex.n), (first.place, first.n)
        for path in self.second.return_paths(self.scene, self.origin, point, mirror, valid, self.moment):
            half = (vertex.length + path.distance) * 0.5
            toward = dr.dot(vertex.n, path.u)
            cosine = dr.abs(toward)
            low, high = self._edges(vertex, path.u, half)
            yield Arrival(
                active=valid & path.is_open & (toward * dr.dot(vertex.n, vertex.d) > 0),
                reflectivity=vertex.reflectivity * vertex.gain * dr.square(path.factor),
                cosine=dr.select(cosine < 1, cosine, 1),
                distance=path.distance,
                range_m=half,
                low_m=low,
                high_m=high,
                toward=reflected(path.u, mi.Vector3f(path.mirror.normal)),
                reverse=mi.Bool(False),
                pure=mi.Bool(True),
            )

    def _edges(self, vertex: Vertex, u: DeviceArray, half: DeviceArray) -> tuple[DeviceArray, DeviceArray]:
        """Return the sorted half lengths of paths via a cell's lower and upper edge, on the tangent plane.

        ``u`` is the direction from the other end.
        """
        lift = half_path_rate(vertex.length, vertex.d, vertex.lift, u, vertex.n)
        middle = half + half_path_rate(vertex.length, vertex.d, vertex.side, u, vertex.n) * self.aside
        low, high = middle + lift * self.below, middle + lift * self.above
        return dr.select(low < high, low, high), dr.select(low < high, high, low)


def at_most_one(reflectivity: DeviceArray) -> DeviceArray:
    """Limit Lambert's mu of further reflections to 1, which scattering laws exceed at grazing incidence."""
    return dr.select(reflectivity < 1, reflectivity, 1)


# ---------------- Speckle in the model ``coherent``


GRAIN = 0x64696666
"""Key that separates the speckle of these paths from noise and volume."""

LINES_A_CELL = 3
"""Grid lines in a coarse cell, in sine and in range: about as much as beam and pulse resolve."""

SMOOTHED = 3
"""Number of coarse cells in each direction over which the energies of single rays are spread."""


class DiffuseField:
    """Field of paths via two and three rough surfaces, with speckle, in the model ``coherent``.

    The energies are sums over rays in coarse cells of sine and range, about as large as beam and pulse resolve. Each node of
    the grid in a cell gets its part of the energy times a complex Gaussian number, a hash of (seed, node). The speckle is
    therefore that of very many paths, and a sonar at rest sees it unchanged; its grain does not move with the ground.

    Args:
        tracer: tracer of one reflection.
    """

    def __init__(self, tracer: CoherentTracer) -> None:
        self.direct, self.sonar, self.former = tracer, tracer.sonar, tracer.former
        former = tracer.former
        self.wavenumber = 2 * math.pi / tracer.wavelength
        self.nearest = max(former.first_range, tracer.sonar.bin_m)
        self.shape = -(-former.ranges // LINES_A_CELL), -(-former.sines // LINES_A_CELL)
        fan = tracer.fan
        cell = 4 * fan.sine * fan.tangent / fan.rays
        loudest = MOST_OF_A_RAY * cell / self.nearest**2
        self.bits = 62 - math.ceil(math.log2(loudest * fan.rays))
        self.launch = self._compile()

    def add(self, pose: NDArray[np.float64], field: NDArray[np.complex64], time_s: float = 0.0) -> None:
        """Add these paths of one ping to its field ``(ranges, sines)``, in place, at a pose ``(6,)`` and a time [s]."""
        energy = self.energy(pose, time_s)
        if not energy.any():
            return
        smooth = uniform_filter(energy, SMOOTHED, mode="nearest")
        nodes = LINES_A_CELL**2
        amplitude = np.sqrt(np.maximum(smooth, 0) * (self.former.node_power / nodes)).astype(np.float32)
        grain = self._grain.reshape(self.shape[0], LINES_A_CELL, self.shape[1], LINES_A_CELL)
        speckle = (grain * amplitude[:, None, :, None]).reshape(self._grain.shape)
        field += speckle[: field.shape[0], : field.shape[1]]

    def energy(self, pose: NDArray[np.float64], time_s: float = 0.0) -> NDArray[np.float64]:
        """Return the energies of one ping in coarse cells ``self.shape``, relative to that of the source at 1 m."""
        direct = self.direct
        rows = mi.Float64(to_world_matrices(pose.reshape(1, 6))[0, :3].astype(np.float64).ravel().tolist())
        scene = scene_at(direct.scene, direct.motion, time_s)
        sums = replayed(self.launch, direct.index, scene, rows, direct.surfaces.arrays(), direct.mirrors)
        return np.array(sums, copy=False).reshape(self.shape).astype(np.float64) * 2.0**-self.bits

    @cached_property
    def _grain(self) -> NDArray[np.complex64]:
        """Return complex Gaussian numbers with mean power 1 on all nodes of the coarse cells."""
        shape = 1, self.shape[0] * LINES_A_CELL, self.shape[1] * LINES_A_CELL
        first, second = uniform(shape, seed=self.sonar.seed ^ GRAIN, frames=np.array([0]), like=np.empty(0))
        return np.asarray(np.sqrt(-np.log(first[0])) * np.exp(2j * math.pi * second[0]), dtype=np.complex64)

    def _compile(self) -> Callable[..., Any]:
        @Frozen
        def launch(index: Any, scene: Any, rows: Any, tables: Any, mirrors: Any) -> Any:
            # 1. the rays of the fan and their first surfaces
            lines = [[dr.gather(mi.Float64, rows, mi.UInt32(4 * i + j)) for j in range(4)] for i in range(3)]
            rays = FanRays(self.direct.fan, self.sonar, index, lines)
            surfaces = replace(self.direct.surfaces, **tables)
            hit = surfaces.hit(scene, mi.Ray3f(rays.origin, rays.d))
            begin = self._begin(rays, hit, mirrors)
            # 2. follow the paths; coarse cells need no range intervals
            none = mi.Float(0)
            origin: DeviceArray = rays.origin
            walk = Walk(scene, surfaces, mirrors, self.sonar.bounces, self.wavenumber, origin, none, none, none, none)
            # 3. energy of each arrival, from the solid angle of its ray's cell
            cell = dr.norm(dr.cross(rays.by_sine, rays.by_tangent)) * (rays.sine_step * rays.tangent_step)
            sums = dr.zeros(mi.UInt64, self.shape[0] * self.shape[1])
            for arrival in walk.arrivals(begin, index, mi.UInt32(seed_bits(self.sonar.seed))):
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
        """Add the energies of arrivals to the coarse cells of the beams that receive them."""
        end_sine, end_tangent, ahead = rays.direction(arrival.toward)
        sine, ray_tangent = rays.sine, rays.tangent
        distance = dr.select(arrival.distance > self.nearest, arrival.distance, self.nearest)
        level = arrival.reflectivity * arrival.cosine * cell / dr.square(distance)
        there = dr.square(elevation_gain_of_ends(self.sonar, ray_tangent, end_tangent))
        # paths via mirrors alone are left out: their fields have a phase, and GhostTracer sums them
        active, both = arrival.active & ~arrival.pure & ahead, overlap(self.sonar, sine - end_sine)
        if self.sonar.beam_pattern == "two_way":  # the beams between both ends receive path and reverse in phase
            level = level * there * dr.square(both) * dr.select(arrival.reverse, 4.0, 2.0)
            self._add(sums, (sine + end_sine) * 0.5, arrival.range_m, level, active)
            return
        back = dr.square(elevation_gain_of_ends(self.sonar, end_tangent, ray_tangent))
        self._add(sums, sine, arrival.range_m, level * there * (1 + both), active)
        self._add(sums, end_sine, arrival.range_m, level * back * (1 + both), active & arrival.reverse)

    def _add(
        self, sums: mi.UInt64, sine: DeviceArray, range_m: DeviceArray, level: DeviceArray, active: DeviceArray
    ) -> None:
        former = self.former
        sine_cell = (sine - former.first_sine) * (1 / (former.sine_step * LINES_A_CELL))
        range_cell = (range_m - former.first_range) * (1 / (former.range_step * LINES_A_CELL))
        inside = active & (range_cell >= 0) & (range_cell < self.shape[0]) & (sine_cell >= 0) & (sine_cell < self.shape[1])
        where = mi.UInt32(dr.select(inside, range_cell, 0)) * self.shape[1] + mi.UInt32(dr.select(inside, sine_cell, 0))
        value = mi.UInt64(mi.Float64(level) * 2.0**self.bits)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, value, where, inside, mode=ADD)
