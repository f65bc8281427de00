"""Multipath of the model ``coherent``: how mirrors echo, how scatterers appear via mirrors, and how corners reflect.

The field of mirrors is Kirchhoff's integral over the surfaces that rays meet, with a plane for each ray's cell::

    s = sum j k / 2 pi V exp(-2 k^2 h^2 cos^2) cos dA sinc(g_u / 2) sinc(g_t / 2) exp(-2 j k R) / R^2

with g = 2 k d . dX, where dX is the step of the hit on its tangent plane by one column (u) or row (t), and
sinc x = sin x / x. The echo of a mirror plane is thus 1 / 2R, and that of a rigid sphere a / 2 R^2 (target strength
a^2 / 4).

The cells of a plane join exactly. On curved bodies and at edges the cells of the common fan are too coarse, and a first
launch finds where. It divides a cell until it is at most a quarter of the Fresnel radius sqrt(lambda a R / (2 (a + R))),
where a is the radius of curvature from the normals of neighbouring hits. Cells at edges that face the sonar are divided
most. So are all cells that may contain a mirror narrower than four columns, which rays of the fan may pass by
(:mod:`mitsonar.simulation.narrow_mirrors`). A second launch traces these finer rays.

Facets of meshes are treated as planes, and vertex normals are ignored. A mesh that approximates a curved body needs facets
below half the Fresnel radius: larger ones glint like the faces of a polyhedron.

Beyond 30 deg from the normal the integral fades, and it ends at 45 deg. A mirror sends nothing back there, and the rest of
the sum is due to the edge of the fan. Bodies with a radius below about five wavelengths (k a < 30) are therefore too weak.

The levels of an image are those of a box as wide as the beam and as long as a bin, so its peak is not a target strength.
The target strength in dB follows from their sum: 10 log10(sum of the levels over bins and beams around the echo, without
gain, times spacing over width of the beams) + 40 log10(R), plus absorption.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarWarning
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import to_world_matrices
from mitsonar.plugins.surfaces import Hit, Surfaces
from mitsonar.simulation.beams import BeamFormer, CommonFan, elevation_gain_of_ends
from mitsonar.simulation.coherent_tracing import STRIP, CoherentTracer, FanRays, FieldSums, elevation_gain
from mitsonar.simulation.device import DeviceArray, Frozen, padded, replayed
from mitsonar.simulation.mirrors import Mirrors, SecondMirrors, parts_at, smooth_share, without_mirror_part
from mitsonar.simulation.moving import SceneMotion, scene_at
from mitsonar.simulation.narrow_mirrors import NarrowMirrors
from mitsonar.simulation.points import HashedPoints, Point
from mitsonar.simulation.tracing import MovingSurfaces, going_on, hidden, mirrored_lines, overlap, reflected, surfaces_of

__all__ = [
    "LEVEL_PART",
    "NEIGHBOURS",
    "CornerTracer",
    "FinerRays",
    "GhostTracer",
    "MirrorTracer",
    "MirroredRays",
    "facing_share",
    "mirrored_on",
    "rows_of",
    "sinc",
]


FADING, LAST = 0.866, 0.707
"""Cosines between normal and ray at which the integral begins to fade, and at which it ends."""

FACING = 0.985
"""Cosine above which an edge counts as facing the sonar: beyond 10 deg its echo is far below the mirror's."""

FINEST = 16
"""Largest number of parts of a ray's cell in each direction; used at edges."""

FRESNEL_PARTS = 4
"""Desired number of cells per Fresnel radius; at least two are needed."""

NEIGHBOURS = [(over, down) for over in (-1, 0, 1) for down in (-1, 0, 1) if (over, down) != (0, 0)]

TURN_PART = 1.5
"""A mirror may face the sonar between hits if this factor times the turn of the normal to the next exceeds its slope."""

LEVEL_PART = 0.3
"""Largest distance from the tangent plane of neighbouring hits on one surface, as a fraction of their distance."""

MOST_RAYS = 2**20
"""Largest number of rays in the second launch."""

MOST_NARROW_RAYS = 2**18
"""Largest number of rays through all cells of narrow mirrors."""


class MirrorTracer:
    """Tracer that sums the echoes of mirrors.

    Args:
        scene: scene to trace.
        sonar: sonar of the model ``coherent``.
        former: beamformer that gives the grid.
        mirrors: mirror parts of the scene's shapes.
        finest: largest number of parts of a ray's cell in each direction.
        motion: motion of the scene's bodies, which may hide mirrors; default: nothing moves.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sonar: Sonar,
        former: BeamFormer,
        mirrors: Mirrors,
        *,
        finest: int = FINEST,
        motion: SceneMotion | None = None,
    ) -> None:
        assert sonar.frequency_hz is not None
        self.scene, self.sonar, self.former, self.finest = scene, sonar, former, finest
        self.motion, self.fan, self.table = motion, CommonFan.from_sonar(sonar), mirrors.table()
        self.surfaces = Surfaces.from_scene(scene) if motion is None else surfaces_of(scene, sonar, motion)
        self.wavelength = sonar.sound_speed / sonar.frequency_hz
        self.wavenumber = 2 * math.pi / self.wavelength
        self.last = former.first_range + (former.ranges - 1) * former.range_step
        # fixed point: the amplitudes in a cell of the grid sum to less than k / pi times its solid angle, at most twice this
        loudest = 16 / self.wavelength * former.sine_step * self.fan.tangent
        self.sums = FieldSums(former, 2 * max(loudest, 1.0))
        self.index = dr.arange(mi.UInt32, self.fan.rays)
        dr.make_opaque(self.index)
        dr.eval(self.table)
        self.survey, self.launch = self._compile_survey(), self._compile_sum()
        self.narrow = NarrowMirrors.from_scene(scene, mirrors)
        self.warned, self.warned_narrow = False, False

    def field(self, pose: NDArray[np.float64]) -> NDArray[np.complex64]:
        """Return the field of one ping ``(ranges, sines)`` at a pose ``(6,)`` [m, rad]; see :meth:`add`."""
        field = np.zeros((self.former.ranges, self.former.sines), np.complex64)
        self.add(pose, field)
        return field

    def add(self, pose: NDArray[np.float64], field: NDArray[np.complex64], time_s: float = 0.0) -> None:
        """Add the mirrors' echoes of one ping to its field, in place.

        Args:
            pose: pose of the sonar ``(6,)`` [m, rad].
            field: field on the grid ``(ranges, sines)``.
            time_s: time that determines the poses of moving bodies [s].

        Warns:
            MitsonarWarning: once, if cells exceed half the Fresnel radius, or a mirror is narrower than four of the finest.
        """
        lines = to_world_matrices(pose.reshape(1, 6))[0, :3].astype(np.float64)
        rows = mi.Float64(lines.ravel().tolist())
        scene = scene_at(self.scene, self.motion, time_s)
        desired = np.array(replayed(self.survey, self.index, scene, rows, self.surfaces.arrays(), self.table))
        self._divide_narrow(desired, lines)
        cell = np.flatnonzero(desired)
        if not len(cell):
            return
        parts = self._parts(np.abs(desired[cell]))
        self._warn_if_coarse(desired[cell], parts)
        inputs = tuple(mi.UInt32(padded(part)) for part in _expanded(cell, parts))
        values = replayed(self.launch, inputs, scene, rows, self.surfaces.arrays(), self.table)
        self.sums.add_to(field, values)

    def _divide_narrow(self, desired: NDArray[np.float32], lines: NDArray[np.float64]) -> None:
        """Divide the cells of narrow mirrors most, in place; if they are many, only those that the survey left out."""
        cells, narrowest = self.narrow.cells(self.fan, lines, cone=self.sonar.bearing == "cone", finest=self.finest)
        column, row = cells.T
        index = column // STRIP * (STRIP * self.fan.rows) + row * STRIP + column % STRIP
        few = len(index) * self.finest**2 <= MOST_NARROW_RAYS
        index = index[(desired[index] <= self.finest) & (few | (desired[index] == 0))]
        desired[index] = -float(self.finest)
        if narrowest and not self.warned_narrow:
            self.warned_narrow = True
            warnings.warn(
                f"{', '.join(narrowest)}: narrower than four of the finest rays, so the mirrored echo may be missing or "
                "wrong: choose a finer quality, a nearer pose, or a larger mirror",
                MitsonarWarning,
                stacklevel=4,
            )

    def _parts(self, desired: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the number of parts of cells in each direction: powers of two, reduced if there are too many rays."""
        parts = 2 ** np.ceil(np.log2(np.clip(desired, 1, self.finest)) - 1e-6).astype(np.int64)
        parts = np.minimum(parts, self.finest)
        while (parts * parts).sum() > MOST_RAYS and parts.max() > 1:
            parts = np.minimum(parts, parts.max() // 2)
        return parts

    def _warn_if_coarse(self, desired: NDArray[np.float32], parts: NDArray[np.int64]) -> None:
        """Warn, once, if cells of a curved mirror remain larger than half the Fresnel radius."""
        excess = np.where(desired > 0, desired, 0) / parts * (2 / FRESNEL_PARTS)
        if self.warned or not (excess > 1).any():
            return
        self.warned = True
        rays = self.fan.rays * float(excess.max()) ** 2
        warnings.warn(
            f"cells of rays on mirrors are up to {excess.max():.2g} times half the Fresnel radius: their echoes are "
            f"wrong by decibels; {rays:,.0f} rays are needed, and the fan has {self.fan.rays:,}: choose a finer "
            "quality or a lower frequency",
            MitsonarWarning,
            stacklevel=2,
        )

    # ---------------- First launch: which cells to divide

    def _compile_survey(self) -> Callable[..., Any]:
        @Frozen
        def survey(index: Any, scene: Any, rows: Any, tables: Any, table: Any) -> Any:
            # 1. mirrors within the window; kind -1 is anything else
            rays = FanRays(self.fan, self.sonar, index, rows_of(rows))
            hit = replace(self.surfaces, **tables).hit(scene, mi.Ray3f(rays.origin, rays.d))
            mirror = hit.valid & (parts_at(table, hit)[0] != 0)
            mirror &= rays.may_reach(hit, self.former.first_range, self.last)
            kind = dr.select(mirror, mi.Int32(hit.shape_id), -1)
            place: DeviceArray = rays.d * hit.t
            # 2. comparison with neighbours, which are gathered from evaluated arrays
            seen = kind, place, mi.Vector3f(hit.n), dr.dot(hit.n, rays.d)
            dr.eval(*seen, hit.t)
            facing, needed, mixed = self._compare_neighbours(rays, hit, seen)
            dr.eval(facing)
            near = facing
            for over, down in NEIGHBOURS:
                near |= dr.gather(mi.Bool, facing, self._neighbour(rays, over, down))
            # 3. parts for the curvature; the most, marked by a negative sign, at edges near a mirror that faces the sonar
            smooth = dr.select(mirror & (dr.abs(seen[-1]) > LAST), dr.select(needed > 1, needed, 1), 0)
            return dr.select(mixed & near & (smooth <= self.finest), -float(self.finest), smooth)

        return survey

    def _compare_neighbours(self, rays: FanRays, hit: Hit, seen: tuple[Any, ...]) -> tuple[DeviceArray, ...]:
        """Compare each hit with its neighbours.

        Returns:
            Whether a mirror there may face the sonar, how many parts in each direction its curvature needs, and whether an
            edge is near.
        """
        kind, place, normal, along = seen
        steps = [dr.norm(step) for step in rays.steps_on(hit)]
        mixed, turned, needed = mi.Bool(False), mi.Float(0), mi.Float(0)
        same: dict[tuple[int, int], DeviceArray] = {}
        for offset in NEIGHBOURS:
            # 1. is the neighbour on the same surface: the same kind, and close to the tangent plane?
            neighbour = self._neighbour(rays, *offset)
            chord: DeviceArray = dr.gather(mi.Vector3f, place, neighbour) - place
            length = dr.norm(chord)
            same_kind = dr.gather(mi.Int32, kind, neighbour) == kind
            same[offset] = same_kind & ((kind < 0) | (dr.abs(dr.dot(normal, chord)) <= LEVEL_PART * length))
            mixed |= ~same[offset]
            # 2. turn of the normal; along columns and rows it gives the curvature, and that the size of a cell
            turn = dr.select(same_kind, dr.norm(dr.gather(mi.Vector3f, normal, neighbour) - normal), 0)
            turned = dr.select(turn > turned, turn, turned)
            if 0 in offset:
                curvature = dr.select(same[offset] & (length > 0), turn / length, 0)
                parts = self._cells(steps[offset.index(0) ^ 1], curvature, hit.t)
                needed = dr.select(parts > needed, parts, needed)
        # 3. a body without a neighbour on its surface on either side is not resolved: assume a radius of one step
        thin = ~(same[1, 0] | same[-1, 0]) | ~(same[0, 1] | same[0, -1])
        shorter_step = dr.select(steps[0] < steps[1], steps[0], steps[1])
        unresolved = dr.select(thin, self._cells(shorter_step, 1 / shorter_step, hit.t), 0)
        # 4. a mirror faces the sonar if its normal does here, or may do between this hit and the next
        steep = dr.sqrt(dr.select(along * along < 1, 1 - along * along, 0))
        facing = (kind >= 0) & ((dr.abs(along) > FACING) | thin | (turned * TURN_PART > steep))
        return facing, dr.select(unresolved > needed, unresolved, needed), mixed

    def _cells(self, step: DeviceArray, curvature: DeviceArray, range_m: DeviceArray) -> DeviceArray:
        """Return the ratio of a step to the desired size of a cell on a surface of the given curvature [1/m]."""
        return step * FRESNEL_PARTS * dr.sqrt((curvature + 1 / range_m) * (2 / self.wavelength))

    def _neighbour(self, rays: FanRays, over: int, down: int) -> mi.UInt32:
        """Return the index of each ray's neighbour; the ray itself at the border of the fan."""
        column, row = rays.column + over, rays.row + down
        column = dr.select((column >= 0) & (column < self.fan.columns), column, rays.column)
        row = dr.select((row >= 0) & (row < self.fan.rows), row, rays.row)
        return mi.UInt32(column // STRIP * (STRIP * self.fan.rows) + row * STRIP + column % STRIP)

    # ---------------- Second launch: sum over the finer rays

    def _compile_sum(self) -> Callable[..., Any]:
        @Frozen
        def launch(inputs: Any, scene: Any, rows: Any, tables: Any, table: Any) -> Any:
            rays = FinerRays(self.fan, self.sonar, inputs, rows_of(rows))
            sums = self.sums.zeros()
            self._sum(scene, tables, rays, table, sums)
            dr.eval(sums)
            return self.sums.values(sums)

        return launch

    def _sum(self, scene: mi.Scene, tables: Any, rays: FinerRays, table: mi.Float, sums: list[mi.UInt64]) -> None:
        """Add the echo of each ray's cell to the grid."""
        # 1. trace, and look up the mirror part
        hit = replace(self.surfaces, **tables).hit(scene, mi.Ray3f(rays.origin, rays.d))
        wavenumber = self.wavenumber
        reflection, roughness_m = parts_at(table, hit)
        cosine = dr.abs(dr.dot(hit.n, rays.d))
        across, down = rays.steps_on(hit)
        # 2. magnitude of the integral over the cell, see the module's docstring
        level = reflection * smooth_share(roughness_m, cosine, wavenumber) * _fading(cosine)
        level *= (wavenumber / (2 * math.pi)) * cosine * dr.norm(dr.cross(across, down)) / dr.square(hit.t)
        level *= sinc(dr.dot(rays.d, across) * wavenumber) * sinc(dr.dot(rays.d, down) * wavenumber)
        level *= elevation_gain(self.sonar, rays.tangent)
        # 3. phase in cycles, in float64; the quarter is the factor j
        range_m = mi.Float64(hit.t)
        turns = range_m * (2 / self.wavelength)
        sin, cos = dr.sincos((mi.Float(dr.round(turns) - turns) + 0.25) * (2 * math.pi))
        wave = rays.sine, range_m, level, cos, sin
        self.sums.add(sums, wave, hit.valid & (reflection != 0) & (cosine > LAST))


class FinerRays(FanRays):
    """Rays through parts of a fan's cells.

    Args:
        fan: fan of the sonar.
        sonar: sonar that defines the bearing.
        inputs: for each ray, index of the cell, number of its parts in each direction, and column and row of the part.
        lines: first three rows of ``to_world`` in double precision.

    Attributes:
        sine, tangent: sine of the bearing and tangent of the elevation of each ray.
    """

    def __init__(self, fan: CommonFan, sonar: Sonar, inputs: tuple[mi.UInt32, ...], lines: list[list[Any]]) -> None:
        cell, parts, over, down = inputs
        super().__init__(fan, sonar, cell, lines)
        self.inputs = inputs
        self.sine_step: DeviceArray = self.sine_step / mi.Float(parts)
        self.tangent_step: DeviceArray = self.tangent_step / mi.Float(parts)
        column = mi.Float(self.column * mi.Int32(parts) + mi.Int32(over)) + 0.5
        row = mi.Float(self.row * mi.Int32(parts) + mi.Int32(down)) + 0.5
        self.sine, self.tangent = column * self.sine_step - fan.sine, fan.tangent - row * self.tangent_step
        self._aim(self.sine, self.tangent)

    def from_lines(self, lines: list[list[Any]]) -> FinerRays:
        """Return the same rays for a sonar at another pose."""
        return FinerRays(self.fan, self.sonar, self.inputs, lines)


def _expanded(cell: NDArray[np.intp], parts: NDArray[np.int64]) -> tuple[NDArray[np.uint32], ...]:
    """Return, for each ray, cell, parts in each direction, and the part's column and row, given cells and parts ``(n,)``.

    The integers are divided on the host, because a processor ends the process if idle lanes of a kernel divide by 0.
    """
    count = parts * parts
    number = np.arange(count.sum(), dtype=np.uint32) - np.repeat((np.cumsum(count) - count).astype(np.uint32), count)
    cells, each = (np.repeat(part.astype(np.uint32), count) for part in (cell, parts))
    return cells, each, number % each, number // each


def rows_of(rows: mi.Float64) -> list[list[Any]]:
    """Gather three rows of four numbers from an array of twelve."""
    return [[dr.gather(mi.Float64, rows, mi.UInt32(4 * i + j)) for j in range(4)] for i in range(3)]


def _fading(cosine: DeviceArray) -> DeviceArray:
    """Return a factor that falls smoothly from 1 at :data:`FADING` to 0 at :data:`LAST`."""
    x = (cosine - LAST) * (1 / (FADING - LAST))
    inner: DeviceArray = dr.select(x > 0, x * x * (3 - 2 * x), 0)
    return dr.select(x < 1, inner, 1)


def facing_share(cosine: DeviceArray) -> DeviceArray:
    """Return the weight of a mirror's cell, given the cosine between its mirrored ray and the line to the sonar.

    A ray that meets a single mirror at an angle from its normal leaves at twice this angle from the line back.
    """
    return _fading(dr.sqrt((1 + dr.select(cosine > -1, cosine, -1)) * 0.5))


def sinc(x: DeviceArray) -> DeviceArray:
    """Return sin(x) / x."""
    size: DeviceArray = dr.abs(x)
    return dr.select(size > 1e-3, dr.sin(x) / x, 1 - x * x / 6)


# ---------------- Ghosts: scatterers seen via mirrors


PATHS = 4
"""Bound of a point's waves in one cell of the grid, relative to its wave of one reflection."""


@dataclass
class MirroredRays:
    """Rays of a fan after reflection by mirrors.

    Attributes:
        rays: the rays as seen from the image of the sonar.
        hit: where the rays currently end, with ``t`` from that image [m].
        gain: factor of the mirrors on the amplitude.
        body: number of the body that the rays meet; 0 for still shapes.
    """

    rays: FanRays
    hit: Hit
    gain: DeviceArray
    body: DeviceArray


class GhostTracer:
    """Tracer that sums the echoes of hash-anchored scatterers seen via mirrors, in one launch.

    A ray that meets a mirror continues, and sees the surface behind it from the image of the sonar: the sonar mirrored at
    the plane that the ray met. :class:`~mitsonar.simulation.coherent_tracing.FanRays` with mirrored axes therefore see each
    point of the lattice at its range R' from the image. A point that the sonar also sees directly, at the range R, gives two
    paths of length R + R', one the reverse of the other, with the amplitude::

        V exp(-2 k^2 h^2 cos^2) zeta sqrt(C cos cos' dA) / (R R')

    Out and back via the same mirror, it gives a path of length 2 R' with three reflections; back via another mirror, one of
    length R' + R''. Points, weights and grid are those of one reflection, so ghosts have the speckle of their originals.
    Whether the sonar sees a point directly is tested once per ray, at the point that the ray meets.

    Args:
        tracer: tracer of one reflection, with mirrors.
        mirrors: mirrors of the scene, for paths out via one of them and back via another; default: no such paths.
    """

    def __init__(self, tracer: CoherentTracer, mirrors: Mirrors | None = None) -> None:
        self.direct, self.sonar, self.former = tracer, tracer.sonar, tracer.former
        self.wavenumber = 2 * math.pi / tracer.wavelength
        self.nearest = max(tracer.former.first_range, tracer.sonar.bin_m)
        self.last = self.former.first_range + (self.former.ranges - 1) * self.former.range_step
        self.second = SecondMirrors.from_scene(tracer.scene, mirrors, self.wavenumber) if self.sonar.bounces > 2 else None
        more = 0 if self.second is None else len(self.second.mirrors)
        self.sums = FieldSums(self.former, tracer.loudest * (PATHS + more))
        self.launch = self._compile()

    def add(self, pose: NDArray[np.float64], field: NDArray[np.complex64], time_s: float = 0.0) -> None:
        """Add the ghosts of one ping to its field ``(ranges, sines)``, in place, at a pose ``(6,)`` and a time [s]."""
        direct = self.direct
        rows = mi.Float64(to_world_matrices(pose.reshape(1, 6))[0, :3].astype(np.float64).ravel().tolist())
        scene = scene_at(direct.scene, direct.motion, time_s)
        bodies = None if direct.motion is None else mi.Float64(direct.motion.body_lines(time_s).ravel().tolist())
        inputs = direct.index, scene, rows, direct.surfaces.arrays(), direct.patches, direct.mirrors, bodies
        self.sums.add_to(field, replayed(self.launch, *inputs))

    def _compile(self) -> Callable[..., Any]:
        @Frozen
        def launch(index: Any, scene: Any, rows: Any, tables: Any, patches: Any, mirrors: Any, bodies: Any) -> Any:
            # 1. the rays of the fan and their first hits
            lines = [[dr.gather(mi.Float64, rows, mi.UInt32(4 * i + j)) for j in range(4)] for i in range(3)]
            rays = FanRays(self.direct.fan, self.sonar, index, lines)
            surfaces = replace(self.direct.surfaces, **tables)
            hit = surfaces.hit(scene, mi.Ray3f(rays.origin, rays.d))
            mirrored = MirroredRays(rays, hit, mi.Float(1), mi.UInt32(0))
            sums = self.sums.zeros()
            # 2. follow them from mirror to mirror, and sum the points that they meet
            for number in range(2, self.sonar.bounces + 1):
                first = rays.origin + rays.d * mirrored.hit.t, mirrored.hit.n
                mirrored = mirrored_on(scene, surfaces, mirrored, mirrors, self.wavenumber)
                retro = number == 2 and self.sonar.bounces > 2
                only_mirror = first if retro else None
                self._sum(scene, rays, mirrored, mirrors, patches, sums, first=only_mirror, bodies=bodies)
            dr.eval(sums)
            return self.sums.values(sums)

        return launch

    def _sum(
        self,
        scene: DeviceArray,
        rays: FanRays,
        mirrored: MirroredRays,
        mirrors: mi.Float,
        patches: mi.Float,
        sums: list[mi.UInt64],
        *,
        first: tuple[DeviceArray, DeviceArray] | None,
        bodies: mi.Float64 | None,
    ) -> None:
        """Sum the points in the cells of mirrored rays.

        ``first`` is position and normal of the only mirror so far, given if the return path may also be via mirrors.
        """
        # 1. return paths: directly to the sonar, if the point is visible from it and the path lies in the window ...
        hit = without_mirror_part(mirrors, mirrored.hit, mirrored.rays.d, self.wavenumber)
        place: DeviceArray = mirrored.rays.origin + mirrored.rays.d * hit.t
        to_point: DeviceArray = place - rays.origin
        distance = dr.norm(to_point)
        u = to_point / distance
        matt = hit.valid & (hit.reflectivity > 0)
        straight = matt & (dr.dot(hit.n, u) * dr.dot(hit.n, mirrored.rays.d) > 0)
        straight &= self._within((hit.t + distance) * 0.5, mirrored)
        straight &= ~hidden(scene, mi.Point3f(place), hit.n, u, distance, straight)
        # ... via the same mirror ...
        back = matt & self._within(hit.t, mirrored) if first is not None else mi.Bool(False)
        # ... and via each other mirror
        returns: list[tuple[FanRays, DeviceArray, DeviceArray]] = []
        if first is not None and self.second is not None:
            for path in self.second.return_paths(scene, rays.origin, (place, hit.n), first, matt):
                beyond = rays.from_lines(mirrored_lines(rays.lines, path.mirror.normal, path.mirror.place))
                facing = dr.dot(hit.n, path.u) * dr.dot(hit.n, mirrored.rays.d) > 0
                returns.append(
                    (beyond, path.factor, path.is_open & facing & self._within((hit.t + path.distance) * 0.5, mirrored))
                )
        # 2. points are anchored to bodies: everything below is in the axes of the body that is hit
        if bodies is None:
            hit = replace(hit, shape_id=self.direct.surfaces.grain(hit))
        else:
            assert isinstance(self.direct.surfaces, MovingSurfaces)
            turn = [[dr.gather(mi.Float64, bodies, mirrored.body * 12 + (4 * i + j)) for j in range(4)] for i in range(3)]
            rays, mirrored = in_body(turn, rays), replace(mirrored, rays=in_body(turn, mirrored.rays))
            returns = [(in_body(turn, beyond), factor, is_open) for beyond, factor, is_open in returns]
            normal = [mi.Float(row[0]) * hit.n.x + mi.Float(row[1]) * hit.n.y + mi.Float(row[2]) * hit.n.z for row in turn]
            grain = self.direct.surfaces.grain_on(scene, hit, mirrored.body)
            hit, place = (
                replace(hit, n=mi.Normal3f(*normal), shape_id=grain),
                mirrored.rays.origin + mirrored.rays.d * hit.t,
            )
        # 3. add the waves of all points in each ray's cell
        points = HashedPoints(
            replace(hit, valid=straight | back | _any_of(returns)),
            place,
            *mirrored.rays.steps_on(hit),
            pitch=self.direct.pitch,
            patch=self.sonar.speckle_patch_m,
            seed=self.sonar.seed,
        )

        def step(number: mi.Int32) -> tuple[mi.Int32]:
            point = points.point(number, patches, self.direct.patch_entries)
            exists = number < points.count
            self._deposit(
                (rays, mirrored), points, point, sums, (exists & straight, exists & back if first is not None else None)
            )
            for beyond, factor, is_open in returns:
                self._deposit_return((mirrored, beyond, factor), points, point, sums, exists & is_open)
            return (number + 1,)

        begin = mi.Int32(0) + dr.zeros(mi.Int32, self.direct.fan.rays)
        dr.while_loop((begin,), lambda number: number < points.count, step)

    def _within(self, range_m: DeviceArray, mirrored: MirroredRays) -> DeviceArray:
        """Test whether paths via a ray's cell may lie in the window."""
        across, down = mirrored.rays.steps_on(mirrored.hit)
        wide = dr.norm(across) + dr.norm(down)
        return (range_m + wide > self.former.first_range) & (range_m - wide < self.last)

    def _deposit(
        self,
        views: tuple[FanRays, MirroredRays],
        points: HashedPoints,
        point: Point,
        sums: list[mi.UInt64],
        active: tuple[DeviceArray, DeviceArray | None],
    ) -> None:
        """Add the paths of one point of each ray to the grid."""
        # 1. the point as seen via the mirrors (there) and directly (here)
        rays, mirrored = views
        there, here = mirrored.rays.seen(points, point), rays.seen(points, point)
        far, near = (self._clear(seen.range_m) for seen in (there, here))
        level = points.strength * point.amplitude * mirrored.gain
        both = level * dr.sqrt(there.cosine * here.cosine) / (far * near)
        # 2. the path and its reverse: one length, with both ends' patterns exchanged
        half = (there.range_m + here.range_m) * 0.5
        wave = (half, *self._turned(half, point))
        seen = active[0] & there.in_cell & here.ahead
        if self.sonar.beam_pattern == "two_way":
            gain = elevation_gain_of_ends(self.sonar, there.tangent, here.tangent) * overlap(
                self.sonar, there.sine - here.sine
            )
            self._add(sums, (there.sine + here.sine) * 0.5, both * gain * 2, wave, seen)
        else:
            for arrival, departure in ((there, here), (here, there)):
                gain = elevation_gain_of_ends(self.sonar, arrival.tangent, departure.tangent)
                self._add(sums, arrival.sine, both * gain, wave, seen)
        # 3. out and back via the same mirrors
        if active[1] is not None:
            gain = (
                mirrored.gain
                * there.cosine
                / dr.square(far)
                * elevation_gain_of_ends(self.sonar, there.tangent, there.tangent)
            )
            wave = (there.range_m, *self._turned(there.range_m, point))
            self._add(sums, there.sine, level * gain, wave, active[1] & there.in_cell)

    def _deposit_return(
        self,
        path: tuple[MirroredRays, FanRays, DeviceArray],
        points: HashedPoints,
        point: Point,
        sums: list[mi.UInt64],
        active: DeviceArray,
    ) -> None:
        """Add the path of one point of each ray that returns via another mirror; its reverse belongs to another ray."""
        mirrored, beyond, factor = path
        there, back = mirrored.rays.seen(points, point), beyond.seen(points, point)
        half = (there.range_m + back.range_m) * 0.5
        level = points.strength * point.amplitude * mirrored.gain * factor * dr.sqrt(there.cosine * back.cosine)
        level /= self._clear(there.range_m) * self._clear(back.range_m)
        level *= elevation_gain_of_ends(self.sonar, there.tangent, back.tangent)
        sine = there.sine
        if self.sonar.beam_pattern == "two_way":
            level *= overlap(self.sonar, there.sine - back.sine)
            sine = (there.sine + back.sine) * 0.5
        self._add(sums, sine, level, (half, *self._turned(half, point)), active & there.in_cell & back.ahead)

    def _clear(self, range_m: DeviceArray) -> DeviceArray:
        """Return ranges for spreading, which is constant closer than the window or one bin."""
        near = mi.Float(range_m)
        return dr.select(near > self.nearest, near, self.nearest)

    def _turned(self, half: DeviceArray, point: Point) -> tuple[DeviceArray, DeviceArray]:
        """Return cosine and sine of the phase of paths, given half their length."""
        turns = half * (self.wavenumber / math.pi)
        sin, cos = dr.sincos((mi.Float(dr.round(turns) - turns) + point.turn) * (2 * math.pi))
        return cos, sin

    def _add(
        self,
        sums: list[mi.UInt64],
        sine: DeviceArray,
        level: DeviceArray,
        wave: tuple[DeviceArray, ...],
        active: DeviceArray,
    ) -> None:
        """Add waves to the grid; ``wave`` holds half the path, and cosine and sine of the phase."""
        half, cos, sin = wave
        self.sums.add(sums, (sine, half, level, cos, sin), active)


def _any_of(returns: list[tuple[FanRays, DeviceArray, DeviceArray]]) -> DeviceArray:
    """Return which rays have an open path via another mirror."""
    any_open = mi.Bool(False)
    for _, _, is_open in returns:
        any_open |= is_open
    return any_open


def mirrored_on(
    scene: DeviceArray, surfaces: Surfaces, mirrored: MirroredRays, mirrors: mi.Float, wavenumber: float
) -> MirroredRays:
    """Follow rays that meet mirrors to the next surface; other rays end.

    Args:
        scene: scene to trace.
        surfaces: surface tables of the scene.
        mirrored: rays and their current hits.
        mirrors: table of mirror parts.
        wavenumber: wavenumber of the carrier [1/m].
    """
    rays, hit = mirrored.rays, mirrored.hit
    reflection, roughness_m = parts_at(mirrors, hit)
    active = hit.valid & (reflection != 0)
    place: DeviceArray = rays.origin + rays.d * hit.t
    beyond = rays.from_lines(mirrored_lines(rays.lines, hit.n, place))
    begin = going_on(place, beyond.d, hit.n)
    onward, body = mi.Ray3f(mi.Point3f(place + beyond.d * begin), beyond.d), mi.UInt32(0)
    if isinstance(surfaces, MovingSurfaces):
        next_hit, body = surfaces.hit_and_body(scene, onward, active)
    else:
        next_hit = surfaces.hit(scene, onward, active)
    length = dr.norm(place - beyond.origin) + begin + next_hit.t
    gain = mirrored.gain * reflection * smooth_share(roughness_m, dr.dot(hit.n, rays.d), wavenumber)
    return MirroredRays(beyond, replace(next_hit, t=length, valid=next_hit.valid & active), gain, body)


def in_body(turn: list[list[DeviceArray]], rays: FanRays) -> FanRays:
    """Transform rays to the axes of bodies.

    Args:
        turn: three rows of the transform from the world to each ray's body, in double precision.
        rays: rays in the world.
    """
    lines = rays.lines
    carried = [[sum(row[k] * lines[k][column] for k in range(3)) for column in range(4)] for row in turn]
    for row, line in zip(turn, carried, strict=True):
        line[3] += row[3]
    return rays.from_lines(carried)


# ---------------- Corners: two or three mirrors in sequence


ONE_PLANE = 1e-4
"""Largest distance between the images of the sonar in one chain of planes, as a fraction of the range."""

MOST_STRETCH = 16.0
"""Largest factor by which range or slant at the last mirror may exceed those of the direct line to it."""


@dataclass
class LastMirror:
    """Last mirror of each ray.

    Attributes:
        from_sonar: vector from the sonar to the point on the mirror, in double precision [m].
        distance: length of that vector, in double precision [m].
        length: distance of the point from the image of the sonar, in double precision [m].
        u: unit direction from the sonar to the point.
        reflection: factor of all mirrors on the amplitude.
        share: weight of Kirchhoff's integral, given the direction in which the ray leaves the mirror.
        reflects_back: whether the mirror sends anything back.
    """

    from_sonar: DeviceArray
    distance: DeviceArray
    length: DeviceArray
    u: DeviceArray
    reflection: DeviceArray
    share: DeviceArray
    reflects_back: DeviceArray


class CornerTracer(MirrorTracer):
    """Tracer that sums the echoes of two or more mirrors in sequence; arguments as for :class:`MirrorTracer`.

    A ray goes from mirror to mirror. Kirchhoff's integral over the last one gives the echo of the ray's cell there, which is
    treated as a plane around the point P::

        s = sum j k / 2 pi V1 V2 .. (cos + cos') / 2 dA sinc(g_u / 2) sinc(g_t / 2) exp(-j k (L + R)) / (L R)

    L is the distance of P from the image of the sonar, R that from the sonar itself, cos and cos' those of both lines, dA
    the area of the cell on the last mirror, dX its steps by one column (u) and row (t), g = k (d + (P - O) / R) . dX.
    This is "shooting and bouncing rays" (Ling, Chou, Lee 1989). The ray determines how the path leaves the sonar; the line
    to P determines how it arrives. The reverse path belongs to another ray.

    As for one mirror, a first launch finds the cells to divide: cells whose neighbours meet other mirrors are divided most.
    The integral fades if a ray leaves the last mirror farther than 60 deg from the line to the sonar, and ends at 90 deg.
    """

    def _chains(
        self, scene: mi.Scene, tables: Any, rays: FanRays, table: mi.Float
    ) -> Iterator[tuple[MirroredRays, LastMirror]]:
        """Yield rays at their second mirror, then at their third, each with what that mirror sends back."""
        surfaces = replace(self.surfaces, **tables)
        mirrored = MirroredRays(rays, surfaces.hit(scene, mi.Ray3f(rays.origin, rays.d)), mi.Float(1), mi.UInt32(0))
        for _ in range(2, self.sonar.bounces + 1):
            mirrored = mirrored_on(scene, surfaces, mirrored, table, self.wavenumber)
            yield mirrored, self._last(scene, rays, mirrored, table)

    def _last(self, scene: mi.Scene, rays: FanRays, mirrored: MirroredRays, table: mi.Float) -> LastMirror:
        """Return the surface that rays meet as a mirror, and whether it sends anything back."""
        # 1. distances from the sonar and from its image, in float64 for the phase
        hit, d = mirrored.hit, mirrored.rays.d
        reflection, roughness_m = parts_at(table, hit)
        image, origin = (mi.Point3d(*(line[3] for line in one.lines)) for one in (mirrored.rays, rays))
        ray: DeviceArray = mi.Vector3d(d)
        place: DeviceArray = image + ray * mi.Float64(hit.t)
        from_sonar = place - origin
        distance, length = dr.norm(from_sonar), dr.norm(place - image)
        u: DeviceArray = mi.Vector3f(from_sonar / distance)
        # 2. what counts: a mirror that faces the sonar from the side that the ray meets, within the window, and visible
        share = facing_share(dr.dot(reflected(d, hit.n), -u))
        reflects_back = hit.valid & (reflection != 0) & (share > 0) & (length < distance * MOST_STRETCH)
        reflects_back &= dr.dot(hit.n, u) * dr.dot(hit.n, d) > 0
        half = mi.Float(length + distance) * 0.5
        reflects_back &= (half > self.former.first_range) & (half < self.last)
        reflects_back &= ~hidden(scene, mi.Point3f(place), hit.n, u, mi.Float(distance), reflects_back)
        left = smooth_share(roughness_m, dr.dot(hit.n, d), self.wavenumber)
        return LastMirror(from_sonar, distance, length, u, mirrored.gain * reflection * left, share, reflects_back)

    # ---------------- First launch: which cells to divide

    def _compile_survey(self) -> Callable[..., Any]:
        @Frozen
        def survey(index: Any, scene: Any, rows: Any, tables: Any, table: Any) -> Any:
            rays = FanRays(self.fan, self.sonar, index, rows_of(rows))
            parts: DeviceArray = mi.Float(0)
            for mirrored, last in self._chains(scene, tables, rays, table):
                chain_parts: DeviceArray = self._parts_of(rays, mirrored, last)
                parts = dr.select(dr.square(chain_parts) > dr.square(parts), chain_parts, parts)
            return parts

        return survey

    def _parts_of(self, rays: FanRays, mirrored: MirroredRays, last: LastMirror) -> DeviceArray:
        """Return the number of parts of cells in each direction: 0 if nothing is sent back, negative at edges."""
        reflects_back, image, normal = last.reflects_back, mi.Vector3f(mirrored.rays.origin), mi.Vector3f(mirrored.hit.n)
        place: DeviceArray = mi.Vector3f(image + mirrored.rays.d * mirrored.hit.t)
        dr.eval(reflects_back, image, normal, place)
        near, mixed = reflects_back, mi.Bool(False)
        # 1. edges: a neighbour sends nothing back, or belongs to another chain of planes or another surface
        for offset in NEIGHBOURS:
            neighbour = self._neighbour(rays, *offset)
            neighbour_reflects = dr.gather(mi.Bool, reflects_back, neighbour)
            chord: DeviceArray = dr.gather(mi.Vector3f, place, neighbour) - place
            apart: DeviceArray = dr.norm(dr.gather(mi.Vector3f, image, neighbour) - image)
            same_plane = (apart <= ONE_PLANE * (1 + mirrored.hit.t)) & (
                dr.abs(dr.dot(normal, chord)) <= LEVEL_PART * dr.norm(chord)
            )
            mixed |= (neighbour_reflects != reflects_back) | (neighbour_reflects & reflects_back & ~same_plane)
            near |= neighbour_reflects
        # 2. parts for the width of the cell across the ray
        d = mirrored.rays.d
        steps = [dr.norm(step - d * dr.dot(d, step)) for step in mirrored.rays.steps_on(mirrored.hit)]
        longest = dr.select(steps[0] > steps[1], steps[0], steps[1])
        needed = self._cells(longest, mi.Float(0), mi.Float(last.distance))
        smooth = dr.select(reflects_back, dr.select(needed > 1, needed, 1), 0)
        return dr.select(mixed & near, -float(self.finest), smooth)

    # ---------------- Second launch: sum over the finer rays

    def _sum(self, scene: mi.Scene, tables: Any, rays: FinerRays, table: mi.Float, sums: list[mi.UInt64]) -> None:
        """Add the echo of each ray's cell to the grid."""
        for mirrored, last in self._chains(scene, tables, rays, table):
            self._add_last(rays, mirrored, last, sums)

    def _add_last(self, rays: FinerRays, mirrored: MirroredRays, last: LastMirror, sums: list[mi.UInt64]) -> None:
        """Add what the last mirror sends back to the grid."""
        # 1. magnitude of the integral over the cell, see the class's docstring
        hit, d = mirrored.hit, mirrored.rays.d
        across, down = mirrored.rays.steps_on(hit)
        steep, back = dr.abs(dr.dot(hit.n, d)), dr.abs(dr.dot(hit.n, last.u))
        length, distance = mi.Float(last.length), mi.Float(last.distance)
        level = last.reflection * last.share * (self.wavenumber / (4 * math.pi)) * (steep + back)
        level *= dr.norm(dr.cross(across, down)) / (length * distance)
        turn: DeviceArray = (d + last.u) * (self.wavenumber / 2)
        level *= sinc(dr.dot(turn, across)) * sinc(dr.dot(turn, down))
        # 2. pattern: the path leaves along the ray and arrives along the line to the last mirror
        sine, tangent, ahead = rays.direction(last.u)
        level *= elevation_gain_of_ends(self.sonar, tangent, rays.tangent)
        if self.sonar.beam_pattern == "two_way":
            level *= overlap(self.sonar, sine - rays.sine)
            sine = (sine + rays.sine) * 0.5
        # 3. phase in cycles, in float64; the quarter is the factor j
        half = (last.length + last.distance) * 0.5
        turns = half * (2 / self.wavelength)
        sin, cos = dr.sincos((mi.Float(dr.round(turns) - turns) + 0.25) * (2 * math.pi))
        valid = last.reflects_back & ahead & (steep + back < 2 * MOST_STRETCH * steep)
        self.sums.add(sums, (sine, half, level, cos, sin), valid)
