"""Ghosts of the model ``coherent``: hash-anchored scatterers seen by way of mirrors, in one launch.

A ray that meets a mirror goes on, and looks at the surface behind it from the image of the sonar: the sonar mirrored at the
plane that the ray met. So :class:`~mitsonar.simulation.coherent_tracing.FanRays` of mirrored axes see each point of the
lattice at the range R' of the image. A point at the range R that the sonar sees straight as well gives two paths of length
R + R', there and back the other way round, of amplitude

    V exp(-2 k^2 h^2 cos^2) zeta sqrt(C cos cos' dA) / (R R')

By the same mirror both ways it gives one of length 2 R', of three reflections, and by another mirror back one of R' + R''.
Points, weights and grid are those of one reflection, so ghosts carry the speckle of what they are ghosts of. Whether the
sonar sees a point straight is tested once a ray, at the point that the ray meets.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.motion.pose import to_world_matrices
from mitsonar.plugins.surfaces import Hit, Surfaces
from mitsonar.simulation.coherent_tracing import CoherentTracer, FanRays, add_waves
from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.elevation_pattern import elevation_gain_of_ends
from mitsonar.simulation.hashed_points import HashedPoints, Point
from mitsonar.simulation.mirror_parts import Mirrors, parts_at, smooth_share, without_mirror_part
from mitsonar.simulation.moving_scene import scene_at
from mitsonar.simulation.moving_tracing import MovingSurfaces
from mitsonar.simulation.reflections import going_on, mirrored_lines, overlap
from mitsonar.simulation.second_mirrors import SecondMirrors
from mitsonar.simulation.tracing import hidden
from mitsonar.simulation.variant import Frozen, replayed

__all__ = ["GhostTracer", "MirroredRays", "mirrored_on"]

PATHS = 4
"""Waves of a point in one cell of the grid, at most, in waves of one reflection."""


@dataclass
class MirroredRays:
    """Rays of a fan behind mirrors.

    Attributes:
        rays: as they are seen from the image of the sonar.
        hit: where they end now, ``t`` from that image [m].
        gain: amplitude that the mirrors have left.
        body: number of the body that they meet; 0: what stands still.
    """

    rays: FanRays
    hit: Hit
    gain: DeviceArray
    body: DeviceArray


class GhostTracer:
    """Sum the echoes of scatterers that are seen by way of mirrors.

    Args:
        tracer: of one reflection, with mirrors.
        mirrors: of the scene, for ways by one of them there and another back; default: no such ways.
    """

    def __init__(self, tracer: CoherentTracer, mirrors: Mirrors | None = None) -> None:
        self.direct, self.sonar, self.former = tracer, tracer.sonar, tracer.former
        self.wavenumber = 2 * math.pi / tracer.wavelength
        self.nearest = max(tracer.former.first_range, tracer.sonar.bin_m)
        self.last = self.former.first_range + (self.former.ranges - 1) * self.former.range_step
        self.second = SecondMirrors.of(tracer.scene, mirrors, self.wavenumber) if self.sonar.bounces > 2 else None
        more = 0 if self.second is None else len(self.second.mirrors)
        self.bits = tracer.bits - math.ceil(math.log2(PATHS + more))
        self.launch = self._compile()

    def add(self, pose: NDArray[np.float64], field: NDArray[np.complex64], time_s: float = 0.0) -> None:
        """Add the ghosts of one ping to its field ``(sines, ranges)``, in place, at a pose ``(6,)`` and a time [s]."""
        direct = self.direct
        rows = mi.Float64(to_world_matrices(pose.reshape(1, 6))[0, :3].astype(np.float64).ravel().tolist())
        scene = scene_at(direct.scene, direct.motion, time_s)
        bodies = None if direct.motion is None else mi.Float64(direct.motion.body_lines(time_s).ravel().tolist())
        inputs = direct.index, scene, rows, direct.surfaces.arrays(), direct.patches, direct.mirrors, bodies
        real, imag = replayed(self.launch, *inputs)
        field.real += np.array(real, copy=False).reshape(field.shape)
        field.imag += np.array(imag, copy=False).reshape(field.shape)

    def _compile(self) -> Callable[..., Any]:
        @Frozen
        def launch(index: Any, scene: Any, rows: Any, tables: Any, patches: Any, mirrors: Any, bodies: Any) -> Any:
            lines = [[dr.gather(mi.Float64, rows, mi.UInt32(4 * i + j)) for j in range(4)] for i in range(3)]
            rays = FanRays(self.direct.fan, self.sonar, index, lines)
            surfaces = replace(self.direct.surfaces, **tables)
            hit = surfaces.hit(scene, mi.Ray3f(rays.origin, rays.d))
            now = MirroredRays(rays, hit, mi.Float(1), mi.UInt32(0))
            sums = tuple(dr.zeros(mi.UInt64, self.former.sines * self.former.ranges) for _ in range(2))
            for number in range(2, self.sonar.bounces + 1):
                first = rays.origin + rays.d * now.hit.t, now.hit.n
                now = mirrored_on(scene, surfaces, now, mirrors, self.wavenumber)
                retro = number == 2 and self.sonar.bounces > 2
                own = first if retro else None
                self._sum(scene, rays, now, mirrors, patches, (sums[0], sums[1]), first=own, bodies=bodies)
            dr.eval(sums)
            return tuple(mi.Float(mi.Float64(mi.Int64(part)) * 2.0**-self.bits) for part in sums)

        return launch

    def _sum(
        self,
        scene: DeviceArray,
        rays: FanRays,
        now: MirroredRays,
        mirrors: mi.Float,
        patches: mi.Float,
        sums: tuple[mi.UInt64, mi.UInt64],
        *,
        first: tuple[DeviceArray, DeviceArray] | None,
        bodies: mi.Float64 | None,
    ) -> None:
        """Sum the points that rays behind mirrors look through.

        ``first`` is place and normal of the only mirror so far, where the way back may be by mirrors as well.
        """
        hit = without_mirror_part(mirrors, now.hit, now.rays.d, self.wavenumber)
        place: DeviceArray = now.rays.origin + now.rays.d * hit.t
        way: DeviceArray = place - rays.origin
        distance = dr.norm(way)
        u = way / distance
        matt = hit.valid & (hit.reflectivity > 0)
        straight = matt & (dr.dot(hit.n, u) * dr.dot(hit.n, now.rays.d) > 0)
        straight &= self._within((hit.t + distance) * 0.5, now)
        straight &= ~hidden(scene, mi.Point3f(place), hit.n, u, distance, straight)
        back = matt & self._within(hit.t, now) if first is not None else mi.Bool(False)
        ways: list[tuple[FanRays, DeviceArray, DeviceArray]] = []
        if first is not None and self.second is not None:
            for way in self.second.ways(scene, rays.origin, (place, hit.n), first, matt):
                beyond = rays.from_lines(mirrored_lines(rays.lines, way.mirror.normal, way.mirror.place))
                facing = dr.dot(hit.n, way.u) * dr.dot(hit.n, now.rays.d) > 0
                ways.append((beyond, way.factor, way.is_open & facing & self._within((hit.t + way.distance) * 0.5, now)))
        if bodies is not None:  # all that follows is in the axes of the body that is hit
            assert isinstance(self.direct.surfaces, MovingSurfaces)
            turn = [[dr.gather(mi.Float64, bodies, now.body * 12 + (4 * i + j)) for j in range(4)] for i in range(3)]
            rays, now = in_body(turn, rays), replace(now, rays=in_body(turn, now.rays))
            ways = [(in_body(turn, beyond), factor, is_open) for beyond, factor, is_open in ways]
            normal = [mi.Float(row[0]) * hit.n.x + mi.Float(row[1]) * hit.n.y + mi.Float(row[2]) * hit.n.z for row in turn]
            lattice = self.direct.surfaces.own_lattice(scene, hit, now.body)
            hit, place = replace(hit, n=mi.Normal3f(*normal), shape_id=lattice), now.rays.origin + now.rays.d * hit.t
        points = HashedPoints(
            replace(hit, valid=straight | back | _any_of(ways)),
            place,
            *now.rays.steps_on(hit),
            pitch=self.direct.pitch,
            patch=self.sonar.speckle_patch_m,
            seed=self.sonar.seed,
        )

        def step(number: mi.Int32) -> tuple[mi.Int32]:
            point = points.point(number, patches, self.direct.patch_entries)
            held = number < points.count
            self._deposit((rays, now), points, point, sums, (held & straight, held & back if first is not None else None))
            for beyond, factor, is_open in ways:
                self._deposit_by((now, beyond, factor), points, point, sums, held & is_open)
            return (number + 1,)

        begin = mi.Int32(0) + dr.zeros(mi.Int32, self.direct.fan.rays)
        dr.while_loop((begin,), lambda number: number < points.count, step)

    def _within(self, range_m: DeviceArray, now: MirroredRays) -> DeviceArray:
        """Test whether paths by way of a ray's cell may lie in the window."""
        across, down = now.rays.steps_on(now.hit)
        wide = dr.norm(across) + dr.norm(down)
        return (range_m + wide > self.former.first_range) & (range_m - wide < self.last)

    def _deposit(
        self,
        ways: tuple[FanRays, MirroredRays],
        points: HashedPoints,
        point: Point,
        sums: tuple[mi.UInt64, mi.UInt64],
        active: tuple[DeviceArray, DeviceArray | None],
    ) -> None:
        """Add the paths of one point of each ray to the grid."""
        rays, now = ways
        there, here = now.rays.seen(points, point), rays.seen(points, point)
        far, near = (self._clear(seen.range_m) for seen in (there, here))
        level = points.strength * point.amplitude * now.gain
        both = level * dr.sqrt(there.cosine * here.cosine) / (far * near)
        half = (there.range_m + here.range_m) * 0.5
        wave = (half, *self._turned(half, point))
        seen = active[0] & there.mine & here.ahead
        if self.sonar.beam_pattern == "two_way":
            gain = elevation_gain_of_ends(self.sonar, there.tangent, here.tangent) * overlap(
                self.sonar, there.sine - here.sine
            )
            self._add(sums, (there.sine + here.sine) * 0.5, both * gain * 2, wave, seen)
        else:
            for one, other in ((there, here), (here, there)):
                gain = elevation_gain_of_ends(self.sonar, one.tangent, other.tangent)
                self._add(sums, one.sine, both * gain, wave, seen)
        if active[1] is not None:
            gain = (
                now.gain * there.cosine / dr.square(far) * elevation_gain_of_ends(self.sonar, there.tangent, there.tangent)
            )
            wave = (there.range_m, *self._turned(there.range_m, point))
            self._add(sums, there.sine, level * gain, wave, active[1] & there.mine)

    def _deposit_by(
        self,
        way: tuple[MirroredRays, FanRays, DeviceArray],
        points: HashedPoints,
        point: Point,
        sums: tuple[mi.UInt64, mi.UInt64],
        active: DeviceArray,
    ) -> None:
        """Add the path of one point of each ray that leaves by another mirror; its reverse is another ray's."""
        now, beyond, factor = way
        there, other = now.rays.seen(points, point), beyond.seen(points, point)
        half = (there.range_m + other.range_m) * 0.5
        level = points.strength * point.amplitude * now.gain * factor * dr.sqrt(there.cosine * other.cosine)
        level /= self._clear(there.range_m) * self._clear(other.range_m)
        level *= elevation_gain_of_ends(self.sonar, there.tangent, other.tangent)
        sine = there.sine
        if self.sonar.beam_pattern == "two_way":
            level *= overlap(self.sonar, there.sine - other.sine)
            sine = (there.sine + other.sine) * 0.5
        self._add(sums, sine, level, (half, *self._turned(half, point)), active & there.mine & other.ahead)

    def _clear(self, range_m: DeviceArray) -> DeviceArray:
        """Return ranges for spreading, which is held constant nearer than the window or one bin."""
        near = mi.Float(range_m)
        return dr.select(near > self.nearest, near, self.nearest)

    def _turned(self, half: DeviceArray, point: Point) -> tuple[DeviceArray, DeviceArray]:
        """Return cosine and sine of the phase of paths of half a length."""
        turns = half * (self.wavenumber / math.pi)
        sin, cos = dr.sincos((mi.Float(dr.round(turns) - turns) + point.turn) * (2 * math.pi))
        return cos, sin

    def _add(
        self,
        sums: tuple[mi.UInt64, mi.UInt64],
        sine: DeviceArray,
        level: DeviceArray,
        wave: tuple[DeviceArray, ...],
        active: DeviceArray,
    ) -> None:
        """Add waves of a half path, cosine and sine of the phase to the grid."""
        half, cos, sin = wave
        add_waves(self.former, self.bits, sums, (sine, half, level, cos, sin), active)


def _any_of(ways: list[tuple[FanRays, DeviceArray, DeviceArray]]) -> DeviceArray:
    """Return which rays have an open way by another mirror."""
    found = mi.Bool(False)
    for _, _, is_open in ways:
        found |= is_open
    return found


def mirrored_on(
    scene: DeviceArray, surfaces: Surfaces, now: MirroredRays, mirrors: mi.Float, wavenumber: float
) -> MirroredRays:
    """Follow rays that meet mirrors to the next surface; others end.

    Args:
        scene: to trace.
        surfaces: its tables.
        now: rays and where they end.
        mirrors: table of mirror parts.
        wavenumber: of the carrier [1/m].
    """
    rays, hit = now.rays, now.hit
    reflection, roughness_m = parts_at(mirrors, hit)
    active = hit.valid & (reflection != 0)
    place: DeviceArray = rays.origin + rays.d * hit.t
    beyond = rays.from_lines(mirrored_lines(rays.lines, hit.n, place))
    begin = going_on(place, beyond.d, hit.n)
    onward, body = mi.Ray3f(mi.Point3f(place + beyond.d * begin), beyond.d), mi.UInt32(0)
    if isinstance(surfaces, MovingSurfaces):
        found, body = surfaces.hit_and_body(scene, onward, active)
    else:
        found = surfaces.hit(scene, onward, active)
    length = dr.norm(place - beyond.origin) + begin + found.t
    gain = now.gain * reflection * smooth_share(roughness_m, dr.dot(hit.n, rays.d), wavenumber)
    return MirroredRays(beyond, replace(found, t=length, valid=found.valid & active), gain, body)


def in_body(turn: list[list[DeviceArray]], rays: FanRays) -> FanRays:
    """Return rays in the axes of bodies.

    Args:
        turn: three rows of what turns the world's axes to those of each ray's body, in double precision.
        rays: in the world.
    """
    lines = rays.lines
    carried = [[sum(row[k] * lines[k][column] for k in range(3)) for column in range(4)] for row in turn]
    for row, line in zip(turn, carried, strict=True):
        line[3] += row[3]
    return rays.from_lines(carried)
