"""Paths of several reflections in pings of the model ``physical``: which beams hear them, and exact sums of their levels."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import Whole
from mitsonar.plugins.imaging_sonar_sensor import Fan
from mitsonar.plugins.material_laws import material_of
from mitsonar.plugins.surfaces import Surfaces
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.beam_of_direction import angles_of, beam_at
from mitsonar.simulation.binning import accumulate
from mitsonar.simulation.bounce_walk import Arrival, Vertex, Walk, at_most_one
from mitsonar.simulation.device_arrays import DeviceArray, LaunchTables
from mitsonar.simulation.elevation_pattern import elevation_gain_of_ends
from mitsonar.simulation.mirror_parts import Mirroring, mirror_of, smooth_share
from mitsonar.simulation.moving_tracing import MovingSurfaces
from mitsonar.simulation.reflections import overlap
from mitsonar.simulation.second_mirrors import SecondMirrors
from mitsonar.simulation.view_echoes import ViewEchoes, WholeTracer, fraction_bits

if TYPE_CHECKING:
    from mitsonar.simulation.tracing import Rays

__all__ = ["BounceSums"]

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
