"""How the complex field of a coherent ping is summed over hashed scatterers, in two launches.

The field is a function of the sine of the bearing and the range. In the first launch, each ray lists the points of the
lattice (:mod:`mitsonar.simulation.points`) in or near its cell of the surface, a half to a fifth of those that it visits.
The second launch sums them, without idle lanes. A point counts if its direction lies in the cell of that ray, so on a plane
each point counts exactly once, for any set of rays. Shapes with parts narrower than a few rays have a launch of their own,
with a ray to each of their points (:mod:`mitsonar.simulation.thin_shapes`). The echo of a point is zeta sqrt(C cos^2 dA) /
R^2, times the pattern over elevation and exp(-2 j k R). Sums are fixed point, so they do not depend on the order of the
points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.speckle import BLENDED_VARIANCE, patch_amplitudes
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import to_world_matrices
from mitsonar.plugins.surfaces import Hit
from mitsonar.simulation.beams import BeamFormer, CommonFan, elevation_gain, kernel_weights
from mitsonar.simulation.device import DeviceArray, Frozen, replayed
from mitsonar.simulation.mirrors import Mirrors, without_mirror_part
from mitsonar.simulation.moving import SceneMotion, scene_at
from mitsonar.simulation.points import LEAST_COSINE, HashedPoints, Patches, Point, pick
from mitsonar.simulation.thin_shapes import ThinShapes
from mitsonar.simulation.tracing import MovingSurfaces, surfaces_of

__all__ = ["STRIP", "CoherentTracer", "FanRays", "FieldCounts", "FieldSums", "elevation_gain"]

ADD = dr.ReduceMode.Direct
"""Mode of the scatter-additions: half the time of ``Local`` here. Dr.Jit's default assumes an unchanged number of threads
when a launch is replayed."""

STRIP = 8
"""Columns of a strip of rays, so that rays traced together are neighbours."""

LARGEST_SUM = 2.0**14
"""Largest sum at a node, as a multiple of the amplitude of one point that reflects everything. The sum of n points with
random phases exceeds 6 sqrt(n) with a probability of 1e-15, and a resolution cell holds a few thousand at most."""

POINTS_A_RAY = 4.0
"""Number of points to a ray for which there is room at first."""

MOST_IN_A_CELL = 2.0**16
"""Number of points in phase that one node can hold in 64-bit sums."""

LARGEST_WEIGHT = 4.2
"""Largest amplitude of a weight: the square root of -log 2^-25."""

SEEN, ROUNDING = 3e-5, 4e-6
"""Largest distance between a point of a thin shape and what its ray meets, as a fraction of range and of coordinates."""

COUNTED = ("inside", "nearer", "farther", "missed", "cut", "points", "widest")


@dataclass(frozen=True)
class FieldCounts:
    """Numbers of rays and of points of a ping.

    Attributes:
        inside, nearer, farther, missed: rays whose hit lies inside the window, nearer, farther; rays that hit nothing.
        cut: rays whose cell of the surface holds more points than one ray may visit.
        points: points that were summed.
        widest: number of lattice cells that the largest cell of a cut ray covers.
    """

    inside: int
    nearer: int
    farther: int
    missed: int
    cut: int
    points: int
    widest: int

    @staticmethod
    def joined(counts: Sequence[FieldCounts]) -> FieldCounts:
        """Combine the counts of several parts: their sums, and the widest cell of all."""
        if len(counts) == 1:
            return counts[0]
        sums = FieldCounts(*(sum(numbers) for numbers in zip(*map(astuple, counts), strict=True)))
        return replace(sums, widest=max(one.widest for one in counts))


class CoherentTracer:
    """Tracer of the echoes of hashed scatterers, for one sonar and one or both sides of the elevation.

    Args:
        scene: the scene to trace.
        sonar: a sonar of the model ``coherent``.
        former: beam former, which defines the grid.
        mirrors: mirror parts of shapes, which do not scatter; default: none.
        side: side of the elevation whose points are summed: +1 up, -1 down, 0 both.
        motion: motion of the scene's bodies, whose points move with them; default: nothing moves.

    Attributes:
        pitch: pitch of the lattice [m].
    """

    def __init__(
        self,
        scene: mi.Scene,
        sonar: Sonar,
        former: BeamFormer,
        mirrors: Mirrors | None = None,
        side: int = 0,
        motion: SceneMotion | None = None,
    ) -> None:
        assert sonar.frequency_hz is not None
        self.side, self.motion = side, motion
        self.scene, self.sonar, self.former, self.fan = scene, sonar, former, CommonFan.from_sonar(sonar)
        self.surfaces = surfaces_of(scene, sonar, motion)
        self.wavelength = sonar.sound_speed / sonar.frequency_hz
        self.pitch = point_pitch(sonar)
        table = patch_amplitudes(None if sonar.speckle_nu is None else BLENDED_VARIANCE * sonar.speckle_nu)
        self.patch_entries, self.patches = len(table), mi.Float(np.resize(table, max(2, len(table))))
        self.sums = FieldSums(former, LARGEST_SUM * float(table.max()) * self.pitch, packed=True)
        # bound on the field of points that add up in phase, which other paths use
        nearest = max(former.first_range, sonar.bin_m)
        self.loudest = LARGEST_WEIGHT * float(table.max()) * self.pitch / nearest**2 * MOST_IN_A_CELL
        self.index = dr.arange(mi.UInt32, self.fan.rays)
        dr.make_opaque(self.index)
        dr.eval(self.patches)
        self.mirrors = None if mirrors is None else mirrors.table()
        self.room: int = math.ceil(POINTS_A_RAY * self.fan.rays)
        # thin shapes, whose points have rays of their own; a moving scene has none
        patches = None if sonar.speckle_nu is None else Patches(sonar.speckle_nu, sonar.speckle_patch_m)
        still = motion is None
        thin = ThinShapes.from_scene(scene, self.fan, sonar.range_max, self.pitch, sonar.seed, patches) if still else None
        self.is_thin = None if thin is None else mi.Bool(thin.thin)
        self.thin_points = None if thin is None else thin.inputs()
        self.list, self.sum, self.sum_thin = self._compile_list(), self._compile_sum(), self._compile_thin()

    def field(self, pose: NDArray[np.float64], time_s: float = 0.0) -> tuple[NDArray[np.complex64], FieldCounts]:
        """Return the field ``(ranges, sines)`` of one ping at a pose ``(6,)`` [m, rad] and a time [s], and its counts."""
        # 1. Poses of the sonar, and the surfaces.
        scene = scene_at(self.scene, self.motion, time_s)
        lines = to_world_matrices(pose.reshape(1, 6))[0, :3].astype(np.float64)
        if self.motion is not None:
            lines = self.motion.sonar_lines(pose, time_s)
        rows = mi.Float64(lines.ravel().tolist())
        # 2. List the points near the rays; if there are more than room, make room and list them again.
        listed, size, counts, hits = replayed(
            self.list, self.index, scene, rows, self.surfaces.arrays(), self.mirrors, self.is_thin
        )
        total = int(np.array(size)[0])
        if total > self.room:
            self.room, self.list = 2 * total, self._compile_list()
            listed, size, counts, hits = replayed(
                self.list, self.index, scene, rows, self.surfaces.arrays(), self.mirrors, self.is_thin
            )
        # 3. Sum them, and those of thin shapes.
        field, outcomes = np.zeros((self.former.ranges, self.former.sines), np.complex64), np.array(counts)
        if total:
            inputs = [dr.gather(mi.UInt32, part, dr.arange(mi.UInt32, total)) for part in listed]
            dr.eval(inputs)
            values, points = replayed(self.sum, *inputs, rows, hits, self.patches)
            self.sums.add_to(field, values)
            outcomes[COUNTED.index("points")] = int(np.array(points)[0])
        if self.thin_points is not None:
            values, points = replayed(self.sum_thin, self.thin_points, scene, rows, self.surfaces.arrays(), self.mirrors)
            self.sums.add_to(field, values)
            outcomes[COUNTED.index("points")] += int(np.array(points)[0])
        return field, FieldCounts(*map(int, outcomes))

    # ---------------- First launch: list the points near each ray

    def _compile_list(self) -> Callable[..., Any]:
        @Frozen
        def launch(index: Any, scene: Any, rows: Any, tables: Any, mirrors: Any, thin: Any) -> Any:
            # 1. Hits of the rays, in the axes of the body that is hit.
            rays, body = self._rays(rows, index, mi.UInt32(0)), mi.UInt32(0)
            ray, surfaces = mi.Ray3f(rays.origin, rays.d), replace(self.surfaces, **tables)
            if isinstance(surfaces, MovingSurfaces):
                hit, body = surfaces.hit_in_body(scene, ray)
                rays = self._rays(rows, index, body)
            else:
                hit = surfaces.hit(scene, ray)
            if mirrors is not None:
                hit = without_mirror_part(mirrors, hit, rays.d, 2 * math.pi / self.wavelength)
            grain = surfaces.grain(hit)
            if isinstance(surfaces, MovingSurfaces):
                grain = surfaces.grain_on(scene, hit, body)
            # 2. Lattice cells around those that may contribute to the grid.
            former = self.former
            last = former.first_range + (former.ranges - 1) * former.range_step
            reached = rays.on_side & hit.valid & (hit.reflectivity > 0) & rays.may_reach(hit, former.first_range, last)
            if thin is not None:
                reached &= ~dr.gather(mi.Bool, thin, mi.UInt32(hit.shape_id), reached)
            points = self._points(rays, replace(hit, valid=reached, shape_id=grain))
            counts = dr.zeros(mi.UInt32, len(COUNTED))
            self._count(counts, rays, hit, points)
            # 3. Visit them in turn, and list those near the cell of the ray; rays end their loop independently.
            listed, size = [dr.empty(mi.UInt32, self.room) for _ in range(2)], dr.zeros(mi.UInt32, 1)

            def step(number: mi.Int32) -> tuple[mi.Int32]:
                near = (number < points.count) & points.near(number)
                slot: DeviceArray = dr.scatter_inc(size, mi.UInt32(0), near)
                for values, value in zip(listed, (index, mi.UInt32(number)), strict=True):
                    dr.scatter(values, value, slot, near & (slot < self.room))
                return (number + 1,)

            begin = mi.Int32(0) + dr.zeros(mi.Int32, self.fan.rays)
            dr.while_loop((begin,), lambda number: number < points.count, step)
            hits = hit.t, hit.n, hit.reflectivity, grain, body + dr.zeros(mi.UInt32, self.fan.rays)
            dr.eval(listed, size, counts, hits)
            return listed, size, counts, hits

        return launch

    def _rays(self, rows: Any, index: mi.UInt32, body: mi.UInt32) -> FanRays:
        """Return rays in the axes of bodies; body 0 is the world, or the only one."""
        lines = [[dr.gather(mi.Float64, rows, body * 12 + (4 * i + j)) for j in range(4)] for i in range(3)]
        return FanRays(self.fan, self.sonar, index, lines, self.side)

    def _points(self, rays: FanRays, hit: Hit) -> HashedPoints:
        """Return the lattice cells around the hits of rays."""
        place: DeviceArray = rays.origin + rays.d * hit.t
        steps, seed = rays.steps_on(hit), self.sonar.seed
        return HashedPoints(hit, place, *steps, pitch=self.pitch, patch=self.sonar.speckle_patch_m, seed=seed)

    def _count(self, counts: mi.UInt32, rays: FanRays, hit: Hit, points: HashedPoints) -> None:
        """Count the outcomes of the rays in the field of view; rays beside it only carry side lobes and skirts."""
        near, far = hit.valid & (hit.t < self.sonar.range_min), hit.valid & (hit.t >= self.sonar.range_max)
        for counter, outcome in enumerate((hit.valid & ~near & ~far, near, far, ~hit.valid, points.cut)):
            counted = outcome & rays.inside
            dr.scatter_reduce(dr.ReduceOp.Add, counts, mi.UInt32(1), mi.UInt32(counter), counted, mode=dr.ReduceMode.Local)
        widest, cut = mi.UInt32(COUNTED.index("widest")), points.cut & rays.inside
        dr.scatter_reduce(dr.ReduceOp.Max, counts, mi.UInt32(points.covered), widest, cut, mode=dr.ReduceMode.Local)

    # ---------------- Second launch: sum the points

    def _compile_sum(self) -> Callable[..., Any]:
        @Frozen
        def launch(index: Any, number: Any, rows: Any, hits: Any, patches: Any) -> Any:
            # 1. The ray of each point, and its hit.
            t, n, reflectivity, grain, body = (dr.gather(type(values), values, index) for values in hits)
            rays, valid = self._rays(rows, index, body), mi.Bool(True)
            hit = Hit(valid, t, n, reflectivity, grain, mi.Float(0), mi.Int32(-1))
            # 2. Sum those that lie in the cell of their ray.
            sums = self.sums.zeros()
            deposited = self._deposit(rays, self._points(rays, hit), mi.Int32(number), patches, sums)
            points = dr.count(deposited)
            dr.eval(sums, points)
            return self.sums.values(sums), points

        return launch

    def _deposit(
        self, rays: FanRays, points: HashedPoints, number: mi.Int32, patches: mi.Float, sums: list[mi.UInt64]
    ) -> DeviceArray:
        """Add a point of each ray to the grid; return which lie in the cell of their ray, and on the grid."""
        # 1. Position and weight of the point, and how the sonar sees it.
        point = points.point(number, patches, self.patch_entries)
        seen = rays.seen(points, point)
        # 2. Deposit, if the point lies in the cell of this ray.
        return self._add(seen, points.strength * point.amplitude, point.turn, sums, seen.in_cell)

    def _add(
        self, seen: SeenPoint, strength: DeviceArray, turn: DeviceArray, sums: list[mi.UInt64], active: DeviceArray
    ) -> DeviceArray:
        """Add the echoes of points to the grid; return which lie on the grid."""
        # 1. Phase in turns; whole turns are removed in double precision, since R is many wavelengths.
        turns = seen.range_m * (2 / self.wavelength)
        sin, cos = dr.sincos((mi.Float(dr.round(turns) - turns) + turn) * (2 * math.pi))
        # 2. Amplitude: strength, cosine, two-way spreading and pattern over elevation.
        level = strength * seen.cosine / dr.square(mi.Float(seen.range_m)) * elevation_gain(self.sonar, seen.tangent)
        return self.sums.add(sums, (seen.sine, seen.range_m, level, cos, sin), active)

    # ---------------- Points of thin shapes

    def _compile_thin(self) -> Callable[..., Any]:
        @Frozen
        def launch(listed: Any, scene: Any, rows: Any, tables: Any, mirrors: Any) -> Any:
            # 1. A ray to each point.
            place, normal, rounded = mi.Point3f(listed["place"]), listed["normal"], listed["reflectivity"] > 0
            rays = self._rays(rows, dr.zeros(mi.UInt32, dr.width(listed["turn"])), mi.UInt32(0))
            away = place - rays.origin
            range_m = dr.norm(away)
            ray = mi.Ray3f(rays.origin, mi.Vector3f(away / range_m))
            hit = replace(self.surfaces, **tables).hit(scene, ray)
            if mirrors is not None:
                hit = without_mirror_part(mirrors, hit, ray.d, 2 * math.pi / self.wavelength)
            # 2. Points that it meets, in the fan; of round shapes those that face the sonar, and that nothing else hides.
            size = dr.abs(place.x) + dr.abs(place.y) + dr.abs(place.z)
            same = hit.valid & (hit.shape_id == listed["shape"])
            met = same & (dr.abs(hit.t - range_m) <= SEEN * range_m + ROUNDING * size)
            faces = (dr.dot(normal, away) < 0) & (same | ~hit.valid | (hit.t > range_m))
            met, reflectivity = dr.select(rounded, faces, met), dr.select(same, hit.reflectivity, listed["reflectivity"])
            seen = rays.seen_at(place, normal)
            met &= seen.ahead if self.side == 0 else seen.ahead & ((seen.tangent > 0) == (self.side > 0))
            strength = listed["strength"] * dr.sqrt(reflectivity)
            # 3. Sum them.
            sums = self.sums.zeros()
            deposited = self._add(seen, strength, listed["turn"], sums, met & (reflectivity > 0))
            points = dr.count(deposited)
            dr.eval(sums, points)
            return self.sums.values(sums), points

        return launch


class FieldSums:
    """Sums of waves at the nodes of a beam former's grid, in fixed point.

    Packed sums hold real and imaginary part in the halves of one 64-bit number, times the square of the range of the node:
    that takes half as many additions.

    Args:
        former: beam former, which defines the grid.
        largest: bound on the sum at a node; packed: times the square of its range.
        packed: whether the sums are packed.
    """

    def __init__(self, former: BeamFormer, largest: float, *, packed: bool = False) -> None:
        self.former, self.packed = former, packed
        self.bits = (31 if packed else 62) - math.ceil(math.log2(largest))

    def zeros(self) -> list[mi.UInt64]:
        """Return the sums of no wave, which :meth:`add` changes in place."""
        return [dr.zeros(mi.UInt64, self.former.sines * self.former.ranges) for _ in range(1 if self.packed else 2)]

    def add(self, sums: list[mi.UInt64], wave: tuple[DeviceArray, ...], active: DeviceArray) -> DeviceArray:
        """Add waves to the six nodes around each; return which waves lie on the grid.

        Args:
            sums: from :meth:`zeros`.
            wave: sine of the bearing, range [m], amplitude, cosine and sine of the phase.
            active: which waves to add.
        """
        # 1. Grid coordinates, the lower of both lines around each wave, and the nearest range.
        former = self.former
        sine, range_m, level, cos, sin = wave
        at_sine = (sine - former.first_sine) * (1 / former.sine_step)
        at_range = mi.Float(range_m - former.first_range) * (1 / former.range_step)
        line, row = dr.floor(at_sine), dr.round(at_range)
        inside = active & (row >= 1) & (row < former.ranges - 1) & (line >= 0) & (line < former.sines - 1)
        node = mi.UInt32(dr.select(inside, row - 1, 0)) * former.sines + mi.UInt32(dr.select(inside, line, 0))
        # 2. Amplitudes at three ranges, in units of the fixed point.
        amplitude = [level * 2.0**self.bits * share for share in kernel_weights(at_range - row)]
        if self.packed:
            first = row * former.range_step + (former.first_range - former.range_step)
            amplitude = [one * dr.square(first + k * former.range_step) for k, one in enumerate(amplitude)]
        # 3. Linear shares of both lines; sums of integers do not depend on the order of the waves.
        part = at_sine - line
        for k, one in enumerate(amplitude):
            for next_line, share in enumerate((1 - part, part)):
                where = node + (k * former.sines + next_line)
                for total, value in zip(sums, self._fixed(one * share * cos, one * share * sin), strict=True):
                    dr.scatter_reduce(dr.ReduceOp.Add, total, value, where, inside, mode=ADD)
        return inside

    def _fixed(self, real: DeviceArray, imag: DeviceArray) -> list[mi.UInt64]:
        if not self.packed:
            return [mi.UInt64(mi.Int64(mi.Float64(part))) for part in (real, imag)]
        high, low = (mi.Int64(mi.Int32(dr.round(part))) for part in (real, imag))
        return [mi.UInt64((high << 32) + low)]

    def values(self, sums: list[mi.UInt64]) -> tuple[mi.Float, mi.Float]:
        """Return real and imaginary part of the sums ``(ranges * sines,)``, for :meth:`add_to`."""
        if not self.packed:
            real, imag = (mi.Float(mi.Float64(mi.Int64(part)) * 2.0**-self.bits) for part in sums)
            return real, imag
        low = mi.Int32(mi.UInt32(sums[0] & mi.UInt64(0xFFFFFFFF)))
        high = mi.Int32((mi.Int64(sums[0]) - mi.Int64(low)) >> 32)
        return mi.Float(high) * 2.0**-self.bits, mi.Float(low) * 2.0**-self.bits

    def add_to(self, field: NDArray[np.complex64], values: tuple[mi.Float, mi.Float]) -> None:
        """Add :meth:`values` to a field ``(ranges, sines)``, in place."""
        former = self.former
        range_m = former.first_range + np.arange(former.ranges) * former.range_step
        spreading = (range_m**-2 if self.packed else np.ones(former.ranges)).astype(np.float32)[:, None]
        field.real += np.array(values[0], copy=False).reshape(field.shape) * spreading
        field.imag += np.array(values[1], copy=False).reshape(field.shape) * spreading


@dataclass
class SeenPoint:
    """A point as the sonar sees it.

    Attributes:
        range_m: range in double precision [m].
        sine: sine of the bearing.
        tangent: tangent of the elevation.
        cosine: absolute cosine between the surface normal and the line of sight.
        in_cell: whether the point's direction lies in the cell of the ray.
        ahead: whether the point's direction lies in the fan.
    """

    range_m: DeviceArray
    sine: DeviceArray
    tangent: DeviceArray
    cosine: DeviceArray
    in_cell: DeviceArray
    ahead: DeviceArray


class FanRays:
    """Rays of a common fan in the world.

    The direction at bearing b and elevation e, as (starboard, forward, up), is (sin b, cos b cos e, cos b sin e) for a
    bearing ``cone``, and (cos e sin b, cos e cos b, sin e) for ``azimuth``.

    Args:
        fan: fan of the sonar.
        sonar: the instrument, which defines the kind of bearing.
        index: number of each ray.
        lines: first three rows of ``to_world`` in double precision.
        side: side of the elevation: +1 up, -1 down, 0 both.

    Attributes:
        sine, tangent: sine of the bearing and tangent of the elevation of each ray.
        on_side: whether the ray is on that side; a point's side is that of its ray.
        inside: whether the ray is on that side and in the field of view.
    """

    def __init__(self, fan: CommonFan, sonar: Sonar, index: mi.UInt32, lines: list[list[Any]], side: int = 0) -> None:
        self.fan, self.cone, self.lines, self.sonar, self.index = fan, sonar.bearing == "cone", lines, sonar, index
        # 1. Column and row of each ray; rays run along the rows of a strip, then down.
        strip, offset = index // (STRIP * fan.rows), index % (STRIP * fan.rows)
        self.column, self.row = mi.Int32(strip * STRIP + offset % STRIP), mi.Int32(offset // STRIP)
        # 2. Direction through the middle of each cell; row 0 is the highest.
        self.sine_step, self.tangent_step = 2 * fan.sine / fan.columns, 2 * fan.tangent / fan.rows
        u = (mi.Float(self.column) + 0.5) * self.sine_step - fan.sine
        t: DeviceArray = fan.tangent - (mi.Float(self.row) + 0.5) * self.tangent_step
        # 3. Side of the elevation, and field of view: the fan reaches beyond it.
        sides = math.sin(math.radians(sonar.azimuth_fov_deg) / 2), math.tan(math.radians(sonar.elevation_fov_deg) / 2)
        self.on_side = mi.Bool(True) if side == 0 else (t > 0) == (side > 0)
        aside: DeviceArray = dr.abs(u)
        lift: DeviceArray = dr.abs(t)
        self.inside = (aside <= sides[0]) & (lift <= sides[1]) & self.on_side
        self.sine: DeviceArray = u
        self.tangent: DeviceArray = t
        self._aim(u, t)

    def _aim(self, u: DeviceArray, t: DeviceArray) -> None:
        """Set ray directions and their derivatives from sines of the bearing ``u`` and tangents of the elevation ``t``."""
        cos_b, cos_e = dr.sqrt(1 - u * u), dr.rsqrt(1 + t * t)
        sin_e, zero = cos_e * t, mi.Float(0)
        if self.cone:
            self.d = self._world(u, cos_b * cos_e, cos_b * sin_e)
            by_sine = (mi.Float(1), -u / cos_b * cos_e, -u / cos_b * sin_e)
            by_tangent = (zero, -cos_b * cos_e * cos_e * sin_e, cos_b * cos_e * cos_e * cos_e)
        else:
            self.d = self._world(cos_e * u, cos_e * cos_b, sin_e)
            by_sine = (cos_e, -cos_e * u / cos_b, zero)
            by_tangent = (-cos_e * cos_e * sin_e * u, -cos_e * cos_e * sin_e * cos_b, cos_e * cos_e * cos_e)
        self.by_sine, self.by_tangent = self._world(*by_sine), self._world(*by_tangent)
        self.origin = mi.Point3f(*(mi.Float(line[3]) for line in self.lines))

    def from_lines(self, lines: list[list[Any]]) -> FanRays:
        """Return the same rays for a sonar at another pose, on both sides of the elevation."""
        return FanRays(self.fan, self.sonar, self.index, lines)

    def _world(self, starboard: DeviceArray, forward: DeviceArray, up: DeviceArray) -> mi.Vector3f:
        """Rotate (starboard, forward, up) into world axes."""
        rows = [[mi.Float(value) for value in line[:3]] for line in self.lines]
        return mi.Vector3f(*(row[0] * -starboard + row[1] * up + row[2] * forward for row in rows))

    def direction(self, u: DeviceArray) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
        """Return sine of the bearing and tangent of the elevation of directions, and whether they lie in the fan."""
        port, up, forward = (sum(mi.Float(line[axis]) * u[row] for row, line in enumerate(self.lines)) for axis in range(3))
        level = dr.sqrt(port * port + forward * forward)
        sine, tangent = -port if self.cone else -port / level, up / (forward if self.cone else level)
        aside: DeviceArray = dr.abs(sine)
        lift: DeviceArray = dr.abs(tangent)
        return sine, tangent, (forward > 0) & (aside <= self.fan.sine) & (lift <= self.fan.tangent)

    def _steep(self, hit: Hit) -> DeviceArray:
        """Return the cosine between normal and ray, bounded away from 0 by :data:`LEAST_COSINE`."""
        along = dr.dot(hit.n, self.d)
        return dr.select(dr.abs(along) > LEAST_COSINE, along, dr.select(along > 0, LEAST_COSINE, -LEAST_COSINE))

    def steps_on(self, hit: Hit) -> tuple[DeviceArray, DeviceArray]:
        """Return the displacement of the hit on its tangent plane for one column and for one row [m]."""
        steep = self._steep(hit)
        across: DeviceArray = hit.t * (self.by_sine - self.d * (dr.dot(hit.n, self.by_sine) / steep))
        down: DeviceArray = hit.t * (self.by_tangent - self.d * (dr.dot(hit.n, self.by_tangent) / steep))
        return across * self.sine_step, down * self.tangent_step

    def may_reach(self, hit: Hit, first: float, last: float) -> DeviceArray:
        """Test whether a ray's cell on the surface may overlap a window of ranges [m]."""
        down = dr.abs(dr.dot(hit.n, self.by_tangent) / self._steep(hit)) * hit.t * self.tangent_step
        across = dr.abs(dr.dot(hit.n, self.by_sine) / self._steep(hit)) * hit.t * self.sine_step
        return (hit.t + down + across > first) & (hit.t - down - across < last)

    def seen(self, points: HashedPoints, point: Point) -> SeenPoint:
        """Return range, direction and cosine of points, and whether their direction lies in the cell of the ray."""
        return self._seen(points.axis, (point.p, point.q, point.a), points.normal)

    def seen_at(self, place: mi.Point3f, normal: DeviceArray) -> SeenPoint:
        """Return the same for points at any place in world axes [m]."""
        return self._seen(mi.UInt32(2), (place.x, place.y, place.z), (normal.x, normal.y, normal.z))

    def _seen(self, axis: DeviceArray, place: Sequence[DeviceArray], normal: Sequence[DeviceArray]) -> SeenPoint:
        # 1. Line of sight and range, in double precision because the phase needs fractions of a wavelength.
        origin = pick(axis, mi.Vector3d(*(line[3] for line in self.lines)))
        exact = [mi.Float64(coordinate) - begin for coordinate, begin in zip(place, origin, strict=True)]
        range_m = dr.sqrt(sum(value * value for value in exact))
        line_of_sight = [mi.Float(value) for value in exact]
        # 2. Direction in the axes of the sonar.
        starboard, up, forward = (self._along(axis, line_of_sight, column) for column in (0, 1, 2))
        starboard, radius = -starboard, mi.Float(range_m)
        level = dr.sqrt(starboard * starboard + forward * forward)
        sine = starboard / (radius if self.cone else level)
        tangent = up / (forward if self.cone else level)
        # 3. Cosine of the angle of incidence.
        cosine = dr.abs(sum(n * v for n, v in zip(normal, line_of_sight, strict=True))) / radius
        # 4. Column and row of the fan, to compare with those of the ray: this assigns each point to one ray.
        column = mi.Int32(dr.floor((sine + self.fan.sine) * (1 / self.sine_step)))
        row = mi.Int32(dr.floor((self.fan.tangent - tangent) * (1 / self.tangent_step)))
        in_cell = (column == self.column) & (row == self.row) & (forward > 0)
        ahead = (forward > 0) & (dr.abs(sine) <= self.fan.sine) & (dr.abs(tangent) <= self.fan.tangent)
        return SeenPoint(range_m, sine, tangent, cosine, in_cell, ahead)

    def _along(self, lattice_axis: DeviceArray, vector: list[DeviceArray], column: int) -> DeviceArray:
        """Return the component of vectors along one axis of the sensor."""
        axis = pick(lattice_axis, mi.Vector3f(*(mi.Float(line[column]) for line in self.lines)))
        return sum(component * part for component, part in zip(axis, vector, strict=True))


def point_pitch(sonar: Sonar) -> float:
    """Return the pitch of the lattice [m]: as given, or for ``scatterers_per_cell`` points per cell at mid range."""
    if sonar.scatterer_spacing_m is not None:
        return sonar.scatterer_spacing_m
    middle = (sonar.range_min + sonar.range_max) / 2
    return math.sqrt(middle * sonar.beam_width_rad * sonar.resolution_m / sonar.scatterers_per_cell)
