"""Model ``physical``: boxes of beams and bins, to which beam pattern, pulse, losses and further reflections are applied.

Without a pattern, the level of each ray is spread over the range interval of its cell, in hard-edged boxes
(:mod:`mitsonar.simulation.models.thesis`). With a pattern, the rays are binned in boxes that tile sine and range without
gaps, also beyond the field of view and the window. Matrices of the squared pattern and the squared pulse then spread the
levels. The result is the mean of many pings of the model ``coherent``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.water import net_loss, sonar_absorption
from mitsonar.errors import MitsonarError
from mitsonar.instruments.beams import Pulse
from mitsonar.instruments.sonar import RAYS, Sonar
from mitsonar.instruments.views import View, Whole
from mitsonar.plugins.imaging_sonar_sensor import Fan
from mitsonar.plugins.material_laws import material_of
from mitsonar.plugins.surfaces import Surfaces
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.beams import (
    PULSE_LENGTHS,
    angles_of,
    beam_at,
    elevation_end,
    elevation_gain,
    elevation_gain_of_ends,
    side_lobes,
)
from mitsonar.simulation.device import DeviceArray, LaunchTables
from mitsonar.simulation.mirrors import Mirroring, SecondMirrors, mirror_of, smooth_share
from mitsonar.simulation.models.thesis import ImageLaunch, ThesisModel, ViewEchoes, WholeTracer, accumulate, fraction_bits
from mitsonar.simulation.moving import SceneMotion
from mitsonar.simulation.multipath_rough import MOST_OF_A_RAY, Arrival, Vertex, Walk, at_most_one
from mitsonar.simulation.pings import RenderedPings
from mitsonar.simulation.tracing import MovingSurfaces, Rays, overlap, tracer_of

__all__ = ["BounceSums", "ExpectedFormer", "PhysicalModel"]

PARTS = 16
"""Number of points of the integral over a box."""


class PhysicalModel(ThesisModel):
    """Renderer of expected levels, in hard-edged boxes or with the sonar's beam pattern.

    Implements :class:`~mitsonar.simulation.models.create.PingModel`.

    The arguments are those of :func:`~mitsonar.simulation.models.create.create_model`.

    Attributes:
        former: operator that spreads the levels of boxes over beams and pulse; None without a pattern.

    Raises:
        MitsonarError: a sonar with a pattern has portions of the field of view or bistatic receivers; there is absorption
            without a pattern; mirrors are rough, but the sonar has no carrier.
    """

    def __init__(
        self,
        scene: mi.Scene,
        sonar: Sonar,
        views: Sequence[View] | None,
        mirrors: Mirroring,
        motion: SceneMotion | None,
        rays_per_launch: int,
    ) -> None:
        patterned = sonar.beam_pattern != "box"
        if not patterned and sonar_absorption(sonar):
            raise MitsonarError(
                "the model physical applies absorption only with a beam pattern: give pattern two_way as well"
            )
        if patterned and any(not isinstance(view, Whole) for view in views or ()):
            raise MitsonarError(
                "portions of the field of view and bistatic receivers have hard edges: leave pattern out, or render the "
                "whole view"
            )
        self.former = ExpectedFormer(sonar) if patterned else None
        traced = sonar if self.former is None else self.former.traced
        shown = [Whole(traced)] if views is None or patterned else views
        bounces = BounceSums(scene, sonar, traced, mirrors) if sonar.bounces > 1 else None
        super().__init__(PhysicalLaunch(tracer_of(scene, traced, motion), shown, sonar, bounces), rays_per_launch)

    def render(
        self, poses: NDArray[np.float64], time_s: NDArray[np.float64], numbers: list[int], labels: bool
    ) -> Iterator[list[RenderedPings]]:
        """Yield batches of pings, one entry for each view; see :class:`~mitsonar.simulation.models.create.PingModel`."""
        for batch in super().render(poses, time_s, numbers, labels):
            yield batch if self.former is None else [self.former.formed(pings) for pings in batch]


@dataclass(frozen=True)
class PhysicalLaunch(ImageLaunch):
    """Compiler of launches with the pattern over elevation, and with paths of several reflections.

    Attributes:
        sonar: sonar whose pattern over elevation weighs the echoes.
        bounces: sums over paths with several reflections; None: single reflections only.
    """

    sonar: Sonar
    bounces: BounceSums | None

    @property
    def mirrors(self) -> LaunchTables | None:
        """Return the tables of mirrors, an input of the launch; None without mirrors."""
        return None if self.bounces is None else self.bounces.mirrors

    def weighted(self, fan: Fan, echoes: Echoes) -> Echoes:
        """Return the echoes weighted by the pattern over elevation, if the beams have a pattern."""
        if self.sonar.beam_pattern == "box":
            return echoes
        return _scaled(echoes, dr.square(elevation_gain(self.sonar, dr.tan(fan.elevation))))

    def bounced(
        self, scene: Any, rays: Rays, fan: Fan, echoes: Echoes, inputs: tuple[Any, ...], pings: int
    ) -> tuple[Echoes, tuple[mi.UInt64, int] | None]:
        """Return the echoes without their mirror part, and the sums over paths of several reflections."""
        bounces, tracer, (rows, keys, surfaces, mirrors) = self.bounces, self.tracer, inputs
        if bounces is None:
            return echoes, None
        echoes, reflection = bounces.scattered(echoes, mirrors)
        key = dr.gather(mi.UInt32, keys, rays.ping) if tracer.sonar.jittered else mi.UInt32(tracer.sensor.key(0))
        lines = [dr.gather(mi.Vector4f, rows, rays.moment * 3 + axis) for axis in range(3)]
        known = replace(tracer.surfaces, **surfaces)
        sums = bounces.sums(scene, known, rays, lines, (fan, echoes, reflection), key, mirrors, pings)
        return echoes, (sums, bounces.tracer.bits)


# ---------------- Beam pattern and pulse


@dataclass(frozen=True)
class ExpectedFormer:
    """Linear operator that spreads the levels of hard-edged boxes over beams and pulse.

    Attributes:
        sonar: a sonar of the model ``physical`` with a beam pattern.
    """

    sonar: Sonar

    @cached_property
    def extra_beams(self) -> int:
        """Return the number of boxes traced beside the fan, on each side."""
        sonar = self.sonar
        edge = math.radians(sonar.azimuth_fov_deg) / 2
        if sonar.beam_layout == "sine":
            needed = side_lobes(sonar.aperture) / (2 * math.sin(edge) / sonar.beams)
            most = (1 / math.sin(edge) - 1) / 2 * sonar.beams
        else:
            needed = side_lobes(sonar.aperture) / sonar.beam_spacing_rad
            most = (math.pi / 2 / edge - 1) / 2 * sonar.beams
        return max(0, math.floor(min(math.ceil(needed), most)))

    @cached_property
    def extra_bins(self) -> tuple[int, int]:
        """Return the numbers of bins traced before the window and after it."""
        needed = math.ceil(PULSE_LENGTHS / 2 * self.sonar.resolution_m / self.sonar.bin_m)
        return min(needed, math.floor(self.sonar.range_min / self.sonar.bin_m)), needed

    @cached_property
    def traced(self) -> Sonar:
        """Return the sonar whose hard-edged boxes are traced: its fan and window include the boxes and bins beside them."""
        # 1. Fan: as many boxes of the same width more, on both sides.
        sonar, extra = self.sonar, self.extra_beams
        before, after = self.extra_bins
        beams = sonar.beams + 2 * extra
        if sonar.beam_layout == "sine":
            part = math.sin(math.radians(sonar.azimuth_fov_deg) / 2) * beams / sonar.beams
            fov = 2 * math.degrees(math.asin(min(1.0, part)))
        else:
            fov = sonar.azimuth_fov_deg * beams / sonar.beams
        # 2. Elevation: to the end of its pattern, with the same density of rays.
        elevation = 2 * math.degrees(elevation_end(sonar))
        given = {name: getattr(sonar, name) for name in RAYS if name in sonar.model_fields_set}
        if "rays_per_beam" in given:
            given["rays_per_beam"] = math.ceil(sonar.rays_per_beam * elevation / sonar.elevation_fov_deg / 2) * 2
        return sonar.replace(
            azimuth_fov_deg=fov,
            elevation_fov_deg=elevation,
            beams=beams,
            beam_width_deg=None,
            range_min=max(0.0, sonar.range_min - before * sonar.bin_m),  # not -1e-17 by rounding
            range_max=sonar.range_max + after * sonar.bin_m,
            range_bins=sonar.range_bins + before + after,
            **given,
        )

    @cached_property
    def over_beams(self) -> NDArray[np.float32]:
        """Return the fraction of each box's level that each beam receives ``(boxes, beams)``."""
        return self.pattern_over_beams()

    def pattern_over_beams(self, beam_width_deg: float | None = None) -> NDArray[np.float32]:
        """Compute the matrix of :attr:`over_beams`, for beams of another width or for those of the sonar."""
        # Sample the cell of each box, which is even in angle or in sine. A box counts for the angle of its whole cell.
        sonar, traced = self.sonar, self.traced
        aperture = sonar.aperture
        if beam_width_deg is not None:
            aperture = replace(aperture, width=math.radians(beam_width_deg))
        share = (np.arange(PARTS) + 0.5) / PARTS - 0.5
        angle = np.full(traced.beams, traced.beam_width_rad)
        if traced.beam_layout == "even":
            line = np.sin(traced.bearing_rad[:, None] + share * angle[:, None])
        else:
            step = 2 * math.sin(math.radians(traced.azimuth_fov_deg) / 2) / traced.beams
            line = np.sin(traced.bearing_rad)[:, None] + share * step
            edges = np.sin(traced.bearing_rad)[:, None] + step * np.array([-0.5, 0.5])
            angle = np.diff(np.arcsin(np.clip(edges, -1, 1)), axis=1)[:, 0]
        away = np.sin(sonar.bearing_rad)[None, :, None] - line[:, None, :]
        power = (aperture.pattern(away) ** 2).mean(axis=2) * (angle / traced.beam_width_rad)[:, None]
        return np.asarray(power * aperture.width / aperture.equivalent_width, dtype=np.float32)

    @cached_property
    def over_bins(self) -> NDArray[np.float32]:
        """Return the fraction of each traced bin's level in each bin, after losses and gain ``(bins, traced bins)``.

        The pulse is the same at all ranges, so the matrix has equal diagonals before losses: one row of values by the
        distance in bins, beginning with the farthest traced bin.
        """
        # 1. Mean squared pulse over a traced bin, for every possible distance in bins.
        sonar, bins, pulse = self.sonar, self.traced.range_bins, Pulse(self.sonar.resolution_m)
        share = (np.arange(PARTS) + 0.5) / PARTS - 0.5
        apart = np.arange(sonar.range_bins + bins - 1) - (bins - 1) + self.extra_bins[0]
        row = (pulse.shape((apart[:, None] - share) * sonar.bin_m) ** 2).mean(axis=1) * sonar.bin_m / pulse.equivalent_m
        # 2. Arrange the row as a matrix, and scale each bin by its losses and gain.
        power = row[np.arange(sonar.range_bins)[:, None] + np.arange(bins)[::-1]]
        return np.asarray(power * net_loss(sonar)[:, None], dtype=np.float32)

    def levels(self, boxes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the levels ``(pings, bins, beams)`` from those of the traced boxes."""
        return np.asarray(self.over_bins @ (boxes @ self.over_beams), dtype=np.float32)

    def crop(self, boxes: NDArray[Any]) -> NDArray[Any]:
        """Crop values of the traced boxes to the bins and beams of the sonar."""
        before, extra = self.extra_bins[0], self.extra_beams
        return boxes[:, before : before + self.sonar.range_bins, extra : extra + self.sonar.beams]

    def formed(self, pings: RenderedPings) -> RenderedPings:
        """Spread the levels of traced boxes over beams and pulse; the labels remain those of the boxes."""
        labels = {name: self.crop(values) for name, values in pings.labels.items()}
        left = net_loss(self.sonar).astype(np.float32)[:, None]
        expected = self.crop(pings.echoes) * left if labels else None
        return RenderedPings(pings.first, self.levels(pings.levels), pings.counts, pings.height_m, labels, expected)


# ---------------- Paths of several reflections


class BounceSums:
    """Sums of the levels of paths with several reflections.

    Args:
        scene: scene to trace.
        sonar: sonar that gives the beam patterns.
        traced: the sonar with hard boxes as beams; the sonar itself if it has no pattern.
        mirroring: mirror parts of shapes.

    Attributes:
        tracer: tracer of the whole view; its fraction bits are those of these sums, separate from those of one reflection.

    Raises:
        MitsonarError: mirrors are rough, but the sonar has no carrier.
    """

    def __init__(self, scene: mi.Scene, sonar: Sonar, traced: Sonar, mirroring: Mirroring) -> None:
        self.sonar, self.traced, self.tracer = sonar, traced, WholeTracer(Whole(traced))
        parts = mirror_of(scene, mirroring)
        if parts is not None and sonar.frequency_hz is None and (parts.roughness_m * (parts.reflection != 0)).any():
            raise MitsonarError(
                "the loss of a rough mirror depends on the carrier: got an rms height and no frequency_hz; give frequency_hz"
            )
        self.wavenumber = 2 * math.pi * (sonar.frequency_hz or 0.0) / sonar.sound_speed
        self.nearest = max(traced.range_min, traced.bin_m)
        # the last surface may be near and the path long: R^g / nearest^2 against the R^(g - 2) of one reflection
        spread = max(1.0, traced.range_max / self.nearest) ** min(traced.gain_exponent, 2)
        self.tracer.bits = fraction_bits(traced, traced.rays, MOST_OF_A_RAY * spread)
        self.second = SecondMirrors.from_scene(scene, parts, self.wavenumber) if sonar.bounces > 2 else None
        self.mirrors: LaunchTables | None = None
        if parts is not None:
            lawless = [float(shape.bsdf() is None or material_of(shape) is None) for shape in scene.shapes()]
            self.mirrors = {"parts": parts.table(), "lawless": mi.Float([*lawless, 0.0])}
            dr.eval(self.mirrors)

    def scattered(self, echoes: Echoes, mirrors: LaunchTables | None) -> tuple[Echoes, DeviceArray]:
        """Return echoes without the mirror part, and the amplitude factor of mirrors; 0 if there is no mirror."""
        if mirrors is None:
            return echoes, mi.Float(0)
        valid = (echoes.hit > 0) & (echoes.shape_id >= 0)
        shape_index = mi.UInt32(dr.select(valid, echoes.shape_id, 0))
        pair = dr.gather(mi.Vector2f, mirrors["parts"], shape_index, valid)
        share = smooth_share(pair.y, echoes.cosine, self.wavenumber)
        loses_mirror_part = (pair.x != 0) & (dr.gather(mi.Float, mirrors["lawless"], shape_index, valid) > 0)
        reflectivity = dr.select(loses_mirror_part, echoes.reflectivity * (1 - dr.square(share)), echoes.reflectivity)
        return replace(echoes, reflectivity=reflectivity), pair.x * share

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
        """Return the sums of a launch ``(pings, beams, stride)``, flat, as those of one reflection.

        Args:
            scene: scene to trace.
            surfaces: surface tables of the scene.
            rays: rays of the launch.
            lines: three rows of ``to_world`` for each ray.
            seen: fan in world axes, echoes of one reflection and amplitudes of :meth:`scattered`, without a pattern.
            keys: keys of the random numbers, one for each ray.
            mirrors: tables of :attr:`mirrors`.
            pings: number of pings in the launch.
        """
        # 1. the first surface of each ray, as traced for one reflection
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
        # 2. follow the paths, and add each arrival in the beams that receive it
        origin = mi.Point3f(*(line.w for line in lines))
        table, width = None if mirrors is None else mirrors["parts"], (echoes.far_m - echoes.near_m) * 0.25
        moment: DeviceArray = mi.Float(rays.moment) if isinstance(surfaces, MovingSurfaces) else None
        cell = fan.below, fan.above, fan.aside, width
        walk = Walk(scene, surfaces, table, self.sonar.bounces, self.wavenumber, origin, *cell, moment, self.second)
        sums: mi.UInt64 | None = None
        for arrival in walk.arrivals(begin, rays.ray, keys):
            for received in self._receive(arrival, echoes, fan, lines, rays):
                sums = accumulate(received, rays.ping, pings, self.tracer, sums, counted=False)
        assert sums is not None
        return sums

    def _receive(self, arrival: Arrival, echoes: Echoes, fan: Fan, lines: list[mi.Vector4f], rays: Rays) -> list[ViewEchoes]:
        """Return the arrivals in the beams that receive them: a path, and its reverse if that is to be added too."""
        sonar, traced = self.sonar, self.traced
        level = self._levels(arrival, echoes)
        # 1. a path that leaves along its ray as well has one direction only
        if arrival.same:
            gain = dr.square(self._vertical(fan.elevation, fan.elevation))
            return [ViewEchoes(_scaled(level, gain), rays.beam, arrival.active, fan.elevation)]
        # 2. angles of both ends; the other end must lie in the view, too
        bearing, elevation = self._angles(fan.d, lines)
        end_bearing, end_elevation = self._angles(arrival.toward, lines)
        end_beam, inside = beam_at(traced, end_bearing)
        high: DeviceArray = dr.abs(end_elevation)
        active = arrival.active & inside & (high <= math.radians(traced.elevation_fov_deg) / 2)
        there, back = (
            dr.square(self._vertical(elevation, end_elevation)),
            dr.square(self._vertical(end_elevation, elevation)),
        )
        # 3. two-way pattern: the beams between both ends receive the path and its reverse in phase
        if sonar.beam_pattern == "two_way":
            part = dr.square(overlap(sonar, dr.sin(bearing) - dr.sin(end_bearing))) * dr.select(arrival.reverse, 4.0, 2.0)
            middle, known = beam_at(traced, (bearing + end_bearing) * 0.5)
            return [ViewEchoes(_scaled(level, there * part), middle, active & known, fan.elevation)]
        # 4. otherwise each end receives one of them; they add coherently as far as the beams overlap
        if sonar.beam_pattern == "box":
            coherence = dr.select(end_beam == rays.beam, 2.0, 1.0)
        else:
            coherence = 1 + overlap(sonar, dr.sin(bearing) - dr.sin(end_bearing))
        received = [ViewEchoes(_scaled(level, there * coherence), rays.beam, active, fan.elevation)]
        received += [ViewEchoes(_scaled(level, back * coherence), end_beam, active & arrival.reverse, fan.elevation)]
        return received

    def _levels(self, arrival: Arrival, echoes: Echoes) -> Echoes:
        """Return arrivals as echoes from which :func:`mitsonar.acoustics.levels.level` computes their level."""
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
        """Return the amplitude of the pattern over elevation; 1 if the beams have no pattern."""
        if self.sonar.beam_pattern == "box":
            return mi.Float(1)
        return elevation_gain_of_ends(self.sonar, dr.tan(arrival), dr.tan(departure))

    def _angles(self, u: DeviceArray, lines: list[mi.Vector4f]) -> tuple[DeviceArray, DeviceArray]:
        """Return bearing and elevation of directions given in the world [rad]."""
        port, up, forward = (sum(line[axis] * u[row] for row, line in enumerate(lines)) for axis in range(3))
        return angles_of(self.traced, -port, forward, up)


def _scaled(echoes: Echoes, gain: DeviceArray) -> Echoes:
    """Return echoes with their reflectivity scaled."""
    return replace(echoes, reflectivity=echoes.reflectivity * gain)
