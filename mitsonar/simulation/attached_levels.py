"""Expected levels of a ping with derivatives: its rays, and what edges sweep."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsonar.acoustics.levels import level
from mitsonar.acoustics.water import sonar_absorption
from mitsonar.instruments.sonar import Sonar
from mitsonar.plugins.echo_integrator import Echo
from mitsonar.plugins.imaging_sonar_sensor import Fan
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.beams import angles_of, beam_at, elevation_gain
from mitsonar.simulation.device import DeviceArray, clipped
from mitsonar.simulation.edges import EdgePieces, Edges, Outline, SonarView, crossings, pieces_of, without_derivatives
from mitsonar.simulation.models.physical import ExpectedFormer
from mitsonar.simulation.models.thesis import footprint
from mitsonar.simulation.tracing import Rays, Tracer

__all__ = ["AttachedLevels"]

ASIDE_RAD = 2e-6
"""Angle between an edge and the rays on both of its sides [rad]."""

NEARER = 1e-3
"""Distance at which a ray beside an edge may hit, relative to that of the edge, without hiding it."""

PLANE_RAD = 4 * ASIDE_RAD
"""Angle that the edge appears off the tangent plane of such a hit without being hidden, however far away [rad]."""

TURNED = 0.1
"""Largest cosine of a curved surface close to its outline."""

GOLDEN = (math.sqrt(5) - 1) / 2
"""Golden ratio less 1: its multiples fill 0..1 evenly."""

CURVED = ("Sphere", "Cylinder")
"""Shapes of Mitsuba that are curved."""

STEP = 1e-3
"""Relative step of the difference that gives the derivative of beam patterns by their width."""


@dataclass(frozen=True)
class AttachedLevels:
    """Levels of a scene at rest with derivatives, for one sonar of the model ``physical``.

    Attributes:
        scene: the scene.
        sonar: the sonar.
        edges: edges of the scene.
        edge_points: number of points on edges; 0 leaves edges out.
    """

    scene: mi.Scene
    sonar: Sonar
    edges: list[Edges]
    edge_points: int

    @cached_property
    def former(self) -> ExpectedFormer | None:
        """Return the operator of beam pattern and pulse; None without a pattern."""
        return None if self.sonar.beam_pattern == "box" else ExpectedFormer(self.sonar)

    @cached_property
    def curved(self) -> list[int]:
        """Return the numbers of the shapes that are curved."""
        return [number for number, shape in enumerate(self.scene.shapes()) if shape.class_name() in CURVED]

    @cached_property
    def traced(self) -> Sonar:
        """Return the sonar whose boxes are traced."""
        return self.sonar if self.former is None else self.former.traced

    @cached_property
    def tracer(self) -> Tracer:
        """Return the tracer of its rays."""
        return Tracer(self.scene, self.traced)

    def levels(self, pose: list[mi.Float], ping: int, given: dict[str, mi.Float]) -> mi.TensorXf:
        """Compute the levels ``(bins, beams)`` of a ping.

        Args:
            pose: x, y, z [m], pitch, roll, heading [rad].
            ping: number of the ping, for the jitter.
            given: properties of the instrument in place of those of the sonar.
        """
        lines = to_world(pose)
        # 1. Trace one echo for each ray, over materials as they are now.
        self.tracer.surfaces.renew_laws(self.traced)
        tracer, key = self.tracer, dr.opaque(mi.UInt32, self.tracer.sensor.key(ping))
        rays = Rays(self.traced, Rays.numbered(self.traced, 1))
        fan = tracer.sensor.fan(rays.column, rays.row, key).carried(lines)
        ray = mi.Ray3f(mi.Point3f(*(line.w for line in lines)), fan.d)
        echoes = Echo.measure(self.scene, tracer.surfaces, ray, fan, edges=True, attached=True)
        moving = self.edge_points > 0 and dr.grad_enabled(echoes.range_m, echoes.cosine)
        if moving and self.curved:
            echoes = self._without_derivatives_on_curved(echoes)
        steps = self._steps(echoes, fan.elevation, rays.beam, given)
        # 2. Add what edges sweep and what curved surfaces change, which is 0 and has derivatives.
        if moving:
            still = [dr.detach(line) for line in lines]
            if self.curved:
                steps += self._on_curved(lines, given)
            pieces = pieces_of(self.edges, self.traced, lines, self.edge_points)
            for part in pieces + crossings(self.scene, tracer, lines):
                steps += self._swept(part, still, given)
        # 3. Each footprint is a step up at its begin and a step down at its end: their running sum is the share of each bin.
        shape = (self.traced.range_bins + 2, self.traced.beams)
        tensor: DeviceArray = dr.tensor_t(mi.Float64)
        sums: DeviceArray = dr.cumsum(tensor(steps, shape), axis=0)
        boxes = mi.TensorXf(mi.Float(sums.array), shape)[: shape[0] - 2]
        return self._formed(boxes, given)

    def _steps(self, echoes: Echoes, elevation: DeviceArray, beam: DeviceArray, given: dict[str, mi.Float]) -> DeviceArray:
        """Return densities of levels as steps ``(bins + 2, beams)``, flat: up where footprints begin, down at the end."""
        sonar = self.traced
        stretch: DeviceArray = 1.0
        if "sound_speed" in given:
            stretch = sonar.sound_speed / mi.Float64(given["sound_speed"])
        exact = Echoes(**{field.name: mi.Float64(getattr(echoes, field.name)) for field in fields(Echoes)})
        begin, end, length = footprint(replace(exact, near_m=exact.near_m * stretch, far_m=exact.far_m * stretch), sonar)
        gain = elevation_gain(self.sonar, dr.tan(elevation), given.get("elevation_fov_deg"))
        # the gain of the receiver follows the range that it shows
        density = level(exact, sonar, dr.select) * mi.Float64(gain * gain) * stretch**sonar.gain_exponent / length
        density = dr.select(exact.hit > 0, density, 0)
        steps = dr.zeros(mi.Float64, (sonar.range_bins + 2) * sonar.beams)
        for place, height in ((begin, density), (end, -density)):
            inside: DeviceArray = clipped(place, 0, sonar.range_bins)
            first, part = dr.floor(inside), inside - dr.floor(inside)
            for offset, share in ((0, 1 - part), (1, part)):
                where = (mi.UInt32(first) + offset) * sonar.beams + beam
                dr.scatter_reduce(dr.ReduceOp.Add, steps, height * share, where, exact.hit > 0)
        return steps

    def _swept(self, pieces: EdgePieces, lines: list[mi.Vector4f], given: dict[str, mi.Float]) -> DeviceArray:
        """Return the steps of what edges sweep: what lies on one side grows, and what lies on the other side shrinks."""
        # 1. Cell of each piece in the fan.
        sonar, middle = self.traced, pieces.direction
        bearing, elevation = angles_of(sonar, -middle.x, middle.z, middle.y)
        beam, inside = beam_at(sonar, bearing)
        lift: DeviceArray = dr.abs(elevation)
        inside &= lift <= math.radians(sonar.elevation_fov_deg) / 2
        # 2. Echoes on both sides. What lies at the edge has its range, so that rounding moves nothing to another bin.
        origin, sides = mi.Point3f(*(line.w for line in lines)), []
        for side in (-1, 1):
            direction = dr.normalize(middle + pieces.across * (side * ASIDE_RAD))
            zero, none = mi.Float(0), mi.Vector3f(0)
            fan = Fan(direction, none, none, zero, zero, zero, mi.Float(1), elevation).carried(lines)
            with without_derivatives():
                echoes = Echo.measure(self.scene, self.tracer.surfaces, mi.Ray3f(origin, fan.d), fan, attached=True)
            behind = echoes.range_m - pieces.distance
            level = -behind * echoes.cosine <= PLANE_RAD * pieces.distance  # of a grazing facet that ends at the edge
            inside &= (echoes.hit == 0) | (behind >= -NEARER * pieces.distance) | level
            near = behind <= NEARER * pieces.distance
            range_m = dr.select(near, pieces.distance, echoes.range_m)
            dark = near & pieces.smooth & (echoes.cosine < TURNED)
            echoes = replace(echoes, hit=dr.select(dark, 0, echoes.hit), range_m=range_m, near_m=range_m, far_m=range_m)
            sides.append(replace(echoes, solid_angle_sr=-side * pieces.swept))
        dr.eval(inside, beam, elevation, sides)  # smaller kernels compile faster
        # 3. Their levels, by the solid angle that is swept.
        one, other = (replace(echoes, hit=dr.select(inside, echoes.hit, 0)) for echoes in sides)
        return self._steps(one, elevation, beam, given) + self._steps(other, elevation, beam, given)

    def _without_derivatives_on_curved(self, echoes: Echoes) -> Echoes:
        """Return echoes of which those of curved surfaces have no derivatives."""
        table = np.zeros(len(self.scene.shapes()), dtype=np.uint32)
        table[self.curved] = 1
        valid = echoes.shape_id >= 0
        curved = dr.gather(mi.UInt32, mi.UInt32(table), mi.UInt32(dr.select(valid, echoes.shape_id, 0)), valid) > 0
        parts = {field.name: getattr(echoes, field.name) for field in fields(Echoes)}
        return Echoes(**{name: dr.select(curved, dr.detach(part), part) for name, part in parts.items()})

    def _on_curved(self, lines: list[mi.Vector4f], given: dict[str, mi.Float]) -> DeviceArray:
        """Return the steps of rays to points that cover curved surfaces evenly: 0, with derivatives.

        The cosine changes as 1 / cosine towards an outline, where few rays of the fan meet the surface and their mean has
        no finite variance. Per area instead of per angle, the change is finite.
        """
        # 1. Points on the surfaces, and the solid angle that each represents.
        view = SonarView(self.traced, [dr.detach(line) for line in lines])
        with without_derivatives():
            shapes: DeviceArray = self.scene.shapes()
            weights = [float(Outline(shapes[number]).weights(view)[0]) ** 2 for number in self.curved]
            parts = []
            for number, weight in zip(self.curved, weights, strict=True):
                if size := math.ceil(self.edge_points * weight / (sum(weights) or 1)):
                    count = np.arange(size) + 0.5
                    sample = np.stack([count * GOLDEN % 1, count / size]).astype(np.float32)  # a Fibonacci lattice
                    place = shapes[number].sample_position(0.0, mi.Point2f(sample))
                    away = place.p - view.origin
                    met: DeviceArray = dr.zeros(mi.PreliminaryIntersection3f, size)
                    met.t, met.shape, met.valid = dr.norm(away), mi.ShapePtr(shapes[number]), mi.Bool(True)
                    ray = mi.Ray3f(view.origin, away / met.t)
                    facing = dr.dot(met.compute_surface_interaction(ray, mi.RayFlags.Minimal).n, ray.d)
                    area = 1 / (place.pdf * size * dr.square(met.t))
                    parts.append([*away, met.t, facing, area, dr.full(mi.Float, number, size)])
            if not parts:
                return 0
            columns: list[DeviceArray] = [dr.concat([mi.Float(part[k]) for part in parts]) for k in range(7)]
            x, y, z, distance, facing, area, owner = columns
            direction: DeviceArray = view.to_sonar(mi.Vector3f(x, y, z)) / distance
            bearing, elevation = angles_of(self.traced, -direction.x, direction.z, direction.y)
            beam, inside = beam_at(self.traced, bearing)
            lift: DeviceArray = dr.abs(elevation)
            inside &= lift <= math.radians(self.traced.elevation_fov_deg) / 2
            dr.eval(beam, inside, bearing, elevation, distance, facing, area, owner)
        # 2. Echoes of those that are visible: from the same side of the same surface.
        fan = self.tracer.sensor.fan_at(beam, bearing, elevation).carried(lines)
        ray = mi.Ray3f(mi.Point3f(*(line.w for line in lines)), fan.d)
        echoes = Echo.measure(self.scene, self.tracer.surfaces, ray, fan, attached=True)
        side = dr.dot(mi.Vector3f(echoes.nx, echoes.ny, echoes.nz), fan.d)
        inside &= (echoes.shape_id == owner) & (side * facing > 0)
        off: DeviceArray = dr.abs(echoes.range_m - distance)
        inside &= off <= NEARER * distance
        solid_angle = area * dr.detach(echoes.cosine)  # of the hit: where it is 0, its change is infinite
        echoes = replace(echoes, hit=dr.select(inside, echoes.hit, 0), solid_angle_sr=solid_angle)
        steps = self._steps(echoes, elevation, beam, {name: dr.detach(value) for name, value in given.items()})
        return steps - dr.detach(steps)

    def _formed(self, boxes: mi.TensorXf, given: dict[str, mi.Float]) -> mi.TensorXf:
        """Apply pattern, pulse, losses and taper to levels in boxes."""
        sonar, former, levels = self.sonar, self.former, boxes
        # 1. Beam pattern and pulse; the sonar's absorption is part of the latter.
        if former is not None:
            pattern = mi.TensorXf(former.over_beams)
            if "beam_width_deg" in given:
                width = given["beam_width_deg"]
                value = float(dr.detach(width)[0])
                low, middle, high = (former.pattern_over_beams(value * (1 + step)) for step in (-STEP, 0, STEP))
                slope = mi.TensorXf(np.asarray((high - low) / (2 * STEP * value), dtype=np.float32))
                pattern = mi.TensorXf(middle) + slope * mi.TensorXf(width - dr.detach(width), shape=(1, 1))
            levels = mi.TensorXf(former.over_bins) @ levels @ pattern
        # 2. Losses over the true range, in place of those of the sonar over the range that it shows; taper across the fan.
        if "absorption_db_per_m" in given or "sound_speed" in given:
            known = sonar_absorption(sonar)
            loss = given.get("absorption_db_per_m", mi.Float(known))
            slower = given.get("sound_speed", mi.Float(sonar.sound_speed)) / sonar.sound_speed
            more = mi.TensorXf(loss * slower - known, shape=(1, 1))
            loss_db = mi.TensorXf((-2 * sonar.range_m).astype(np.float32)[:, None]) * more
            levels = levels * dr.exp(loss_db * (math.log(10) / 10))
        if "taper_db" in given:
            sine = np.square(np.sin(sonar.bearing_rad))
            fall_db = mi.TensorXf((-sine / max(float(sine.max()), 1e-12)).astype(np.float32)[None])
            levels = levels * dr.exp(fall_db * mi.TensorXf(given["taper_db"], shape=(1, 1)) * (math.log(10) / 10))
        return levels


def to_world(pose: list[mi.Float]) -> list[mi.Vector4f]:
    """Return the first three rows of ``to_world`` of a pose, with derivatives."""
    (sin_p, cos_p), (sin_r, cos_r), (sin_h, cos_h) = (dr.sincos(angle) for angle in pose[3:])

    def turned(starboard: float, forward: float, up: float) -> tuple[DeviceArray, ...]:
        # roll, starboard side down; pitch, bow down; heading, to starboard
        x, z = cos_r * starboard + sin_r * up, cos_r * up - sin_r * starboard
        y, z = cos_p * forward + sin_p * z, cos_p * z - sin_p * forward
        return cos_h * x + sin_h * y, cos_h * y - sin_h * x, z

    columns = [turned(-1, 0, 0), turned(0, 0, 1), turned(0, 1, 0), tuple(pose[:3])]  # +x port, +y up, +z forward
    return [mi.Vector4f(*(column[row] for column in columns)) for row in range(3)]
