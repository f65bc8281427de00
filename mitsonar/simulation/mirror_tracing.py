"""The field of mirrors: Kirchhoff's integral over the surfaces that rays meet, a plane for each ray's cell.

    s = sum j k / 2 pi V exp(-2 k^2 h^2 cos^2) cos dA sinc(g_u / 2) sinc(g_t / 2) exp(-2 j k R) / R^2

with g = 2 k d . dX, where dX is the step of the hit on its tangent plane by one column (u) or row (t), and
sinc x = sin x / x. So the echo of a mirror plane is 1 / 2R, that of a rigid sphere a / 2 R^2 (target strength a^2 / 4).

A plane's cells join exactly. On curved bodies and at edges the cells of the common fan are too coarse, so a first launch
finds where: a cell is divided until it is at most a quarter of the Fresnel radius sqrt(lambda a R / (2 (a + R))), a being
the radius of curvature from the normals of neighbouring hits; at edges that face the sonar it is divided most. A second
launch traces these finer rays. Bodies between the rays of the fan are not found.

Facets of meshes are planes here. A mesh that stands for a curved body needs facets below half the Fresnel radius: larger
ones glint as the polyhedron that they are. Vertex normals count for nothing.

Beyond 30 deg from the normal the integral fades and ends at 45 deg: a mirror sends nothing back there, and what is left of
the sum is the edge of the fan. So bodies of less than some five wavelengths' radius (k a < 30) are too weak.

An image's levels are those of a box as wide as the beam and as long as a bin, so its peak is no target strength. Their sum
is: 10 log10(sum of the levels over bins and beams around the echo, without gain, times spacing over width of the beams)
+ 40 log10(R) is the target strength in dB, and absorption comes on top.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarWarning
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import to_world_matrices
from mitsonar.plugins.surfaces import Hit, Surfaces
from mitsonar.simulation.beam_former import BeamFormer, CommonFan
from mitsonar.simulation.coherent_tracing import STRIP, FanRays, add_waves, elevation_gain
from mitsonar.simulation.device_arrays import DeviceArray, padded
from mitsonar.simulation.mirror_parts import Mirrors, parts_at, smooth_share
from mitsonar.simulation.moving_scene import SceneMotion, scene_at
from mitsonar.simulation.moving_tracing import surfaces_of
from mitsonar.simulation.variant import Frozen, replayed

__all__ = ["LEVEL_PART", "NEIGHBOURS", "FinerRays", "MirrorTracer", "facing_share", "rows_of", "sinc"]

FADING, LAST = 0.866, 0.707
"""Cosines between normal and ray where the integral begins to fade, and where it ends."""

FACING = 0.985
"""Cosine above which an edge counts as facing the sonar: beyond 10 deg its echo is far below the mirror's."""

FINEST = 16
"""Parts that a ray's cell is divided into each way, at most and at edges."""

FRESNEL_PARTS = 4
"""Cells a Fresnel radius that are wanted; two are needed."""

NEIGHBOURS = [(over, down) for over in (-1, 0, 1) for down in (-1, 0, 1) if (over, down) != (0, 0)]

TURN_PART = 1.5
"""A mirror may face the sonar between hits where this times the turn of the normal to the next exceeds its slope."""

LEVEL_PART = 0.3
"""Neighbouring hits are on one surface where they leave the tangent plane by less than this part of their distance."""

MOST_RAYS = 2**20
"""Rays of the second launch, at most."""


class MirrorTracer:
    """Sum the echoes of mirrors.

    Args:
        scene: to trace.
        sonar: of the model ``coherent``.
        former: gives the grid.
        mirrors: of the scene's shapes.
        finest: parts that a ray's cell is divided into each way, at most.
        motion: of bodies of the scene, which may hide mirrors; default: all stands still.
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
        self.motion, self.fan, self.table = motion, CommonFan.of(sonar), mirrors.table()
        self.surfaces = Surfaces.of(scene) if motion is None else surfaces_of(scene, sonar, motion)
        self.wavelength = sonar.sound_speed / sonar.frequency_hz
        self.wavenumber = 2 * math.pi / self.wavelength
        self.last = former.first_range + (former.ranges - 1) * former.range_step
        # the sum of all amplitudes in a cell of the grid is below k / pi times its solid angle, at most twice this
        loudest = 16 / self.wavelength * former.sine_step * self.fan.tangent
        self.bits = 61 - math.ceil(math.log2(max(loudest, 1.0)))
        self.index = dr.arange(mi.UInt32, self.fan.rays)
        dr.make_opaque(self.index)
        dr.eval(self.table)
        self.survey, self.launch = self._compile_survey(), self._compile_sum()
        self.told = False

    def field(self, pose: NDArray[np.float64]) -> NDArray[np.complex64]:
        """Return the field of one ping ``(sines, ranges)`` at a pose ``(6,)`` [m, rad]; see :meth:`add`."""
        field = np.zeros((self.former.sines, self.former.ranges), np.complex64)
        self.add(pose, field)
        return field

    def add(self, pose: NDArray[np.float64], field: NDArray[np.complex64], time_s: float = 0.0) -> None:
        """Add the mirrors' echoes of one ping to its field, in place.

        Args:
            pose: of the sonar ``(6,)`` [m, rad].
            field: on the grid ``(sines, ranges)``.
            time_s: when bodies that move are where they are [s].

        Warns:
            MitsonarWarning: once, where cells exceed half the Fresnel radius and no finer ones were traced.
        """
        rows = mi.Float64(to_world_matrices(pose.reshape(1, 6))[0, :3].astype(np.float64).ravel().tolist())
        scene = scene_at(self.scene, self.motion, time_s)
        wanted = np.array(replayed(self.survey, self.index, scene, rows, self.surfaces.arrays(), self.table))
        cell = np.flatnonzero(wanted)
        if not len(cell):
            return
        parts = self._parts(np.abs(wanted[cell]))
        self._tell(wanted[cell], parts)
        inputs = tuple(mi.UInt32(padded(part)) for part in _expanded(cell, parts))
        real, imag = replayed(self.launch, inputs, scene, rows, self.surfaces.arrays(), self.table)
        field.real += np.array(real, copy=False).reshape(field.shape)
        field.imag += np.array(imag, copy=False).reshape(field.shape)

    def _parts(self, wanted: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return into how many parts each way cells are divided: powers of two, fewer where rays are too many."""
        parts = 2 ** np.ceil(np.log2(np.clip(wanted, 1, self.finest)) - 1e-6).astype(np.int64)
        parts = np.minimum(parts, self.finest)
        while (parts * parts).sum() > MOST_RAYS and parts.max() > 1:
            parts = np.minimum(parts, parts.max() // 2)
        return parts

    def _tell(self, wanted: NDArray[np.float32], parts: NDArray[np.int64]) -> None:
        """Warn where the cells of a curved mirror stay larger than half the Fresnel radius."""
        excess = np.where(wanted > 0, wanted, 0) / parts * (2 / FRESNEL_PARTS)
        if self.told or not (excess > 1).any():
            return
        self.told = True
        rays = self.fan.rays * float(excess.max()) ** 2
        warnings.warn(
            f"cells of rays on mirrors are up to {excess.max():.2g} times half the Fresnel radius: their echoes are "
            f"wrong by decibels; {rays:,.0f} rays would do, of {self.fan.rays:,} now: choose a finer quality or a lower "
            "frequency",
            MitsonarWarning,
            stacklevel=2,
        )

    # ---------------------------------------------------------------- first launch

    def _compile_survey(self) -> Callable[..., Any]:
        @Frozen
        def survey(index: Any, scene: Any, rows: Any, tables: Any, table: Any) -> Any:
            rays = FanRays(self.fan, self.sonar, index, rows_of(rows))
            hit = replace(self.surfaces, **tables).hit(scene, mi.Ray3f(rays.origin, rays.d))
            mirror = hit.valid & (parts_at(table, hit)[0] != 0)
            mirror &= rays.may_reach(hit, self.former.first_range, self.last)
            kind = dr.select(mirror, mi.Int32(hit.shape_id), -1)
            place: DeviceArray = rays.d * hit.t
            seen = kind, place, mi.Vector3f(hit.n), dr.dot(hit.n, rays.d)
            dr.eval(*seen, hit.t)
            facing, needed, mixed = self._around(rays, hit, seen)
            dr.eval(facing)
            near = facing
            for over, down in NEIGHBOURS:
                near |= dr.gather(mi.Bool, facing, self._beside(rays, over, down))
            smooth = dr.select(mirror & (dr.abs(seen[-1]) > LAST), dr.select(needed > 1, needed, 1), 0)
            return dr.select(mixed & near & (smooth <= self.finest), -float(self.finest), smooth)

        return survey

    def _around(self, rays: FanRays, hit: Hit, seen: tuple[Any, ...]) -> tuple[DeviceArray, ...]:
        """Compare each hit with those around it.

        Returns:
            Whether a mirror there may face the sonar, how many parts each way its curvature needs, whether an edge is near.
        """
        kind, place, normal, along = seen
        steps = [dr.norm(step) for step in rays.steps_on(hit)]
        mixed, turned, needed = mi.Bool(False), mi.Float(0), mi.Float(0)
        same: dict[tuple[int, int], DeviceArray] = {}
        for beside in NEIGHBOURS:
            other = self._beside(rays, *beside)
            chord: DeviceArray = dr.gather(mi.Vector3f, place, other) - place
            length = dr.norm(chord)
            alike = dr.gather(mi.Int32, kind, other) == kind
            same[beside] = alike & ((kind < 0) | (dr.abs(dr.dot(normal, chord)) <= LEVEL_PART * length))
            mixed |= ~same[beside]
            turn = dr.select(alike, dr.norm(dr.gather(mi.Vector3f, normal, other) - normal), 0)
            turned = dr.select(turn > turned, turn, turned)
            if 0 in beside:
                bent = dr.select(same[beside] & (length > 0), turn / length, 0)
                wanted = self._cells(steps[beside.index(0) ^ 1], bent, hit.t)
                needed = dr.select(wanted > needed, wanted, needed)
        thin = ~(same[1, 0] | same[-1, 0]) | ~(same[0, 1] | same[0, -1])
        least = dr.select(steps[0] < steps[1], steps[0], steps[1])
        unresolved = dr.select(thin, self._cells(least, 1 / least, hit.t), 0)
        steep = dr.sqrt(dr.select(along * along < 1, 1 - along * along, 0))
        facing = (kind >= 0) & ((dr.abs(along) > FACING) | thin | (turned * TURN_PART > steep))
        return facing, dr.select(unresolved > needed, unresolved, needed), mixed

    def _cells(self, step: DeviceArray, bent: DeviceArray, range_m: DeviceArray) -> DeviceArray:
        """Return a step over the wanted size of a cell, where the surface has that curvature [1/m]."""
        return step * FRESNEL_PARTS * dr.sqrt((bent + 1 / range_m) * (2 / self.wavelength))

    def _beside(self, rays: FanRays, over: int, down: int) -> mi.UInt32:
        """Return the index of the neighbour of each ray, itself at the border of the fan."""
        column, row = rays.column + over, rays.row + down
        column = dr.select((column >= 0) & (column < self.fan.columns), column, rays.column)
        row = dr.select((row >= 0) & (row < self.fan.rows), row, rays.row)
        return mi.UInt32(column // STRIP * (STRIP * self.fan.rows) + row * STRIP + column % STRIP)

    # ---------------------------------------------------------------- second launch

    def _compile_sum(self) -> Callable[..., Any]:
        @Frozen
        def launch(inputs: Any, scene: Any, rows: Any, tables: Any, table: Any) -> Any:
            rays = FinerRays(self.fan, self.sonar, inputs, rows_of(rows))
            sums = tuple(dr.zeros(mi.UInt64, self.former.sines * self.former.ranges) for _ in range(2))
            self._sum(scene, tables, rays, table, (sums[0], sums[1]))
            dr.eval(sums)
            return tuple(mi.Float(mi.Float64(mi.Int64(part)) * 2.0**-self.bits) for part in sums)

        return launch

    def _sum(
        self, scene: mi.Scene, tables: Any, rays: FinerRays, table: mi.Float, sums: tuple[mi.UInt64, mi.UInt64]
    ) -> None:
        """Add the echo of each ray's cell to the grid."""
        hit = replace(self.surfaces, **tables).hit(scene, mi.Ray3f(rays.origin, rays.d))
        wavenumber = self.wavenumber
        reflection, roughness_m = parts_at(table, hit)
        cosine = dr.abs(dr.dot(hit.n, rays.d))
        across, down = rays.steps_on(hit)
        level = reflection * smooth_share(roughness_m, cosine, wavenumber) * _fading(cosine)
        level *= (wavenumber / (2 * math.pi)) * cosine * dr.norm(dr.cross(across, down)) / dr.square(hit.t)
        level *= sinc(dr.dot(rays.d, across) * wavenumber) * sinc(dr.dot(rays.d, down) * wavenumber)
        level *= elevation_gain(self.sonar, rays.tangent)
        range_m = mi.Float64(hit.t)
        turns = range_m * (2 / self.wavelength)
        sin, cos = dr.sincos((mi.Float(dr.round(turns) - turns) + 0.25) * (2 * math.pi))
        wave = rays.sine, range_m, level, cos, sin
        add_waves(self.former, self.bits, sums, wave, hit.valid & (reflection != 0) & (cosine > LAST))


class FinerRays(FanRays):
    """Rays of parts of a fan's cells.

    Args:
        fan: of the sonar.
        sonar: tells the bearing.
        inputs: index of the cell, parts of it each way, the part's column and row, of each ray.
        lines: first three rows of ``to_world`` in double precision.

    Attributes:
        sine, tangent: of the bearing and of the elevation of each ray.
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
        """Return the same rays of a sonar elsewhere."""
        return FinerRays(self.fan, self.sonar, self.inputs, lines)


def _expanded(cell: NDArray[np.intp], parts: NDArray[np.int64]) -> tuple[NDArray[np.uint32], ...]:
    """Return cell, parts each way, the part's column and row of each ray, for cells and their parts ``(n,)``.

    Divided on the host: the processor ends the process where idle lanes of a kernel divide integers by 0.
    """
    count = parts * parts
    number = np.arange(count.sum(), dtype=np.uint32) - np.repeat((np.cumsum(count) - count).astype(np.uint32), count)
    cells, each = (np.repeat(part.astype(np.uint32), count) for part in (cell, parts))
    return cells, each, number % each, number // each


def rows_of(rows: mi.Float64) -> list[list[Any]]:
    """Return three rows of four numbers of an array of twelve."""
    return [[dr.gather(mi.Float64, rows, mi.UInt32(4 * i + j)) for j in range(4)] for i in range(3)]


def _fading(cosine: DeviceArray) -> DeviceArray:
    """Return a factor that falls smoothly from 1 at :data:`FADING` to 0 at :data:`LAST`."""
    x = (cosine - LAST) * (1 / (FADING - LAST))
    inner: DeviceArray = dr.select(x > 0, x * x * (3 - 2 * x), 0)
    return dr.select(x < 1, inner, 1)


def facing_share(cosine: DeviceArray) -> DeviceArray:
    """Return what counts of a mirror's cell, by the cosine between its mirrored ray and the line to the sonar.

    A ray that meets one mirror at an angle from its normal leaves at twice this angle from the line back.
    """
    return _fading(dr.sqrt((1 + dr.select(cosine > -1, cosine, -1)) * 0.5))


def sinc(x: DeviceArray) -> DeviceArray:
    """Return sin(x) / x."""
    size: DeviceArray = dr.abs(x)
    return dr.select(size > 1e-3, dr.sin(x) / x, 1 - x * x / 6)
