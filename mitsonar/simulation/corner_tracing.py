"""The field of corners: Kirchhoff's integral over the last of two or three mirrors, a plane for each ray's cell.

A ray goes from mirror to mirror. At the last one, at P, its cell sends back to the sonar what Kirchhoff's integral says,

    s = sum j k / 2 pi V1 V2 .. (cos + cos') / 2 dA sinc(g_u / 2) sinc(g_t / 2) exp(-j k (L + R)) / (L R)

L is the distance of P from the image of the sonar, R that from the sonar itself, cos and cos' those of both lines, dA the
area of the cell on the last mirror, dX its steps by one column (u) and row (t), g = k (d + (P - O) / R) . dX. This is
"shooting and bouncing rays" (Ling, Chou, Lee 1989). The ray tells how the path leaves; the line to P tells how it arrives.
Its reverse is another ray's.

As for one mirror a first launch finds what to divide: cells whose neighbours meet other mirrors are divided most. What
leaves the last mirror farther than 60 deg from the line to the sonar fades, and ends at 90 deg.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsonar.simulation.coherent_tracing import FanRays, add_waves
from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.elevation_pattern import elevation_gain_of_ends
from mitsonar.simulation.ghost_tracing import MirroredRays, mirrored_on
from mitsonar.simulation.mirror_parts import parts_at, smooth_share
from mitsonar.simulation.mirror_tracing import (
    LEVEL_PART,
    NEIGHBOURS,
    FinerRays,
    MirrorTracer,
    facing_share,
    rows_of,
    sinc,
)
from mitsonar.simulation.reflections import overlap, reflected
from mitsonar.simulation.tracing import hidden
from mitsonar.simulation.variant import Frozen

__all__ = ["CornerTracer"]

ONE_PLANE = 1e-4
"""Images of the sonar that are nearer than this part of their distance are those of one chain of planes."""

MOST_STRETCH = 16.0
"""Largest part by which range or slant at the last mirror may exceed those of the line straight to it."""


@dataclass
class LastMirror:
    """The last mirror of rays.

    Attributes:
        way: from the sonar to the point there, in double precision [m].
        distance: its length [m]; ``length``: from the image of the sonar [m]; both in double precision.
        u: its direction.
        reflection: amplitude that all mirrors leave.
        share: of Kirchhoff's integral, by what leaves the mirror.
        heard: whether it sends anything back.
    """

    way: DeviceArray
    distance: DeviceArray
    length: DeviceArray
    u: DeviceArray
    reflection: DeviceArray
    share: DeviceArray
    heard: DeviceArray


class CornerTracer(MirrorTracer):
    """Sum the echoes of two and more mirrors one after the other; arguments as of :class:`MirrorTracer`."""

    def _chains(
        self, scene: mi.Scene, tables: Any, rays: FanRays, table: mi.Float
    ) -> Iterator[tuple[MirroredRays, LastMirror]]:
        """Yield rays at their second mirror, at their third, and what these send back."""
        surfaces = replace(self.surfaces, **tables)
        now = MirroredRays(rays, surfaces.hit(scene, mi.Ray3f(rays.origin, rays.d)), mi.Float(1), mi.UInt32(0))
        for _ in range(2, self.sonar.bounces + 1):
            now = mirrored_on(scene, surfaces, now, table, self.wavenumber)
            yield now, self._last(scene, rays, now, table)

    def _last(self, scene: mi.Scene, rays: FanRays, now: MirroredRays, table: mi.Float) -> LastMirror:
        """Return what the surface that rays meet sends back as a mirror."""
        hit, d = now.hit, now.rays.d
        reflection, roughness_m = parts_at(table, hit)
        image, origin = (mi.Point3d(*(line[3] for line in one.lines)) for one in (now.rays, rays))
        ray: DeviceArray = mi.Vector3d(d)
        place: DeviceArray = image + ray * mi.Float64(hit.t)
        way = place - origin
        distance, length = dr.norm(way), dr.norm(place - image)
        u: DeviceArray = mi.Vector3f(way / distance)
        share = facing_share(dr.dot(reflected(d, hit.n), -u))
        heard = hit.valid & (reflection != 0) & (share > 0) & (length < distance * MOST_STRETCH)
        heard &= dr.dot(hit.n, u) * dr.dot(hit.n, d) > 0
        half = mi.Float(length + distance) * 0.5
        heard &= (half > self.former.first_range) & (half < self.last)
        heard &= ~hidden(scene, mi.Point3f(place), hit.n, u, mi.Float(distance), heard)
        left = smooth_share(roughness_m, dr.dot(hit.n, d), self.wavenumber)
        return LastMirror(way, distance, length, u, now.gain * reflection * left, share, heard)

    # ---------------------------------------------------------------- first launch

    def _compile_survey(self) -> Callable[..., Any]:
        @Frozen
        def survey(index: Any, scene: Any, rows: Any, tables: Any, table: Any) -> Any:
            rays = FanRays(self.fan, self.sonar, index, rows_of(rows))
            wanted: DeviceArray = mi.Float(0)
            for now, last in self._chains(scene, tables, rays, table):
                own: DeviceArray = self._parts_of(rays, now, last)
                wanted = dr.select(dr.square(own) > dr.square(wanted), own, wanted)
            return wanted

        return survey

    def _parts_of(self, rays: FanRays, now: MirroredRays, last: LastMirror) -> DeviceArray:
        """Return into how many parts each way cells are to be divided: 0 not at all heard, negative at edges."""
        heard, image, normal = last.heard, mi.Vector3f(now.rays.origin), mi.Vector3f(now.hit.n)
        place: DeviceArray = mi.Vector3f(image + now.rays.d * now.hit.t)
        dr.eval(heard, image, normal, place)
        near, mixed = heard, mi.Bool(False)
        for beside in NEIGHBOURS:
            other = self._beside(rays, *beside)
            also = dr.gather(mi.Bool, heard, other)
            chord: DeviceArray = dr.gather(mi.Vector3f, place, other) - place
            apart: DeviceArray = dr.norm(dr.gather(mi.Vector3f, image, other) - image)
            alike = (apart <= ONE_PLANE * (1 + now.hit.t)) & (dr.abs(dr.dot(normal, chord)) <= LEVEL_PART * dr.norm(chord))
            mixed |= (also != heard) | (also & heard & ~alike)
            near |= also
        d = now.rays.d
        steps = [dr.norm(step - d * dr.dot(d, step)) for step in now.rays.steps_on(now.hit)]
        longest = dr.select(steps[0] > steps[1], steps[0], steps[1])
        needed = self._cells(longest, mi.Float(0), mi.Float(last.distance))
        smooth = dr.select(heard, dr.select(needed > 1, needed, 1), 0)
        return dr.select(mixed & near, -float(self.finest), smooth)

    # ---------------------------------------------------------------- second launch

    def _sum(
        self, scene: mi.Scene, tables: Any, rays: FinerRays, table: mi.Float, sums: tuple[mi.UInt64, mi.UInt64]
    ) -> None:
        """Add the echo of each ray's cell to the grid."""
        for now, last in self._chains(scene, tables, rays, table):
            self._add_last(rays, now, last, sums)

    def _add_last(self, rays: FinerRays, now: MirroredRays, last: LastMirror, sums: tuple[mi.UInt64, mi.UInt64]) -> None:
        """Add what the last mirror sends back."""
        hit, d = now.hit, now.rays.d
        across, down = now.rays.steps_on(hit)
        steep, back = dr.abs(dr.dot(hit.n, d)), dr.abs(dr.dot(hit.n, last.u))
        length, distance = mi.Float(last.length), mi.Float(last.distance)
        level = last.reflection * last.share * (self.wavenumber / (4 * math.pi)) * (steep + back)
        level *= dr.norm(dr.cross(across, down)) / (length * distance)
        turn: DeviceArray = (d + last.u) * (self.wavenumber / 2)
        level *= sinc(dr.dot(turn, across)) * sinc(dr.dot(turn, down))
        sine, tangent, ahead = rays.direction(last.u)
        level *= elevation_gain_of_ends(self.sonar, tangent, rays.tangent)
        if self.sonar.beam_pattern == "two_way":
            level *= overlap(self.sonar, sine - rays.sine)
            sine = (sine + rays.sine) * 0.5
        half = (last.length + last.distance) * 0.5
        turns = half * (2 / self.wavelength)
        sin, cos = dr.sincos((mi.Float(dr.round(turns) - turns) + 0.25) * (2 * math.pi))
        kept = last.heard & ahead & (steep + back < 2 * MOST_STRETCH * steep)
        add_waves(self.former, self.bits, sums, (sine, half, level, cos, sin), kept)
