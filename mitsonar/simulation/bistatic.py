"""Echoes at a receiver beside the transmitter (Almanza-Medina, 3.6): the transmitter's rays, seen from the receiver."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from mitsonar.instruments.imaging_sonar import RAYS, Sonar
from mitsonar.instruments.views import Receiver
from mitsonar.motion.pose import mounted, to_world_matrices
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.device_arrays import DeviceArray, LaunchTables
from mitsonar.simulation.view_echoes import ViewEchoes, fraction_bits

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.plugins.imaging_sonar_sensor import Fan
    from mitsonar.simulation.tracing import Rays

__all__ = ["ReceiverTracer"]


class ReceiverTracer:
    """The transmitter's echoes at a receiver beside it; see :class:`~mitsonar.instruments.views.Receiver`."""

    def __init__(self, view: Receiver) -> None:
        self.view = view
        sonar, apart = view.sonar, math.dist(view.offset[:3], (0, 0, 0))
        # r = (R_A + R_B) / 2 <= R_B + apart / 2, and r is at least the window's begin where it counts
        nearest = max(sonar.range_min, sonar.bin_m)
        gain = (nearest / (nearest - apart / 2)) ** 2 if sonar.model == "physical" else 1.0
        traced = {name: getattr(view.transmitter, name) for name in RAYS}  # another window would want others
        self.bits = fraction_bits(view.transmitter.replace(**_window(sonar), **traced), view.transmitter.rays, gain)

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return the receiver's poses: three rows of ``to_world`` for each ping."""
        import mitsuba as mi

        rows = to_world_matrices(mounted(poses, self.view.offset))[:, :3].astype(np.float32)
        return {"rows": mi.Float(rows.ravel().tolist())}

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return the echoes that the receiver measures."""
        import drjit as dr
        import mitsuba as mi

        from mitsonar.simulation.tracing import hidden

        lines = [dr.gather(mi.Vector4f, tables["rows"], rays.ping * 3 + axis) for axis in range(3)]
        u: DeviceArray
        normal: DeviceArray = mi.Normal3f(echoes.nx, echoes.ny, echoes.nz)
        point = mi.Point3f(echoes.x, echoes.y, echoes.z)
        way = mi.Vector3f(*(p - line.w for p, line in zip(point, lines, strict=True)))
        distance = dr.norm(way)
        u = way / distance
        port, up, forward = (sum(line[axis] * u[row] for row, line in enumerate(lines)) for axis in range(3))
        beam, inside, elevation = self._beam(-port, forward, up)
        toward = dr.dot(normal, u)
        lit = (echoes.hit > 0) & inside & (toward * dr.dot(normal, fan.d) > 0)
        active = lit & ~hidden(scene, point, normal, u, distance, lit)
        return ViewEchoes(self._received(echoes, fan, way, distance, normal), dr.select(active, beam, 0), active, elevation)

    def _beam(
        self, starboard: DeviceArray, forward: DeviceArray, up: DeviceArray
    ) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
        """Return beam, whether the direction lies in the field of view, and elevation [rad]."""
        import drjit as dr
        import mitsuba as mi

        place: DeviceArray
        sonar = self.view.sonar
        half = math.radians(sonar.azimuth_fov_deg) / 2
        if sonar.bearing == "azimuth":
            bearing, elevation = dr.atan2(starboard, forward), _asin(up)
        else:
            bearing, elevation = _asin(starboard), dr.atan2(up, forward)
        if sonar.beam_layout == "even":
            place = bearing * (sonar.beams / (2 * half)) + sonar.beams / 2
        else:
            place = dr.sin(bearing) * (sonar.beams / (2 * math.sin(half))) + sonar.beams / 2
        aside: DeviceArray = dr.abs(bearing)
        lift: DeviceArray = dr.abs(elevation)
        inside = (place >= 0) & (place < sonar.beams) & (aside <= half)
        inside &= lift <= math.radians(sonar.elevation_fov_deg) / 2
        beam = mi.UInt32(dr.select(inside, place, 0))
        if sonar.beam_width_deg is not None and sonar.model == "physical":
            axes = mi.Float(sonar.bearing_rad.tolist())
            inside &= dr.abs(bearing - dr.gather(mi.Float, axes, beam)) <= sonar.beam_width_rad / 2
        return beam, inside, elevation

    def _received(self, echoes: Echoes, fan: Fan, way: DeviceArray, distance: DeviceArray, normal: DeviceArray) -> Echoes:
        """Compute range, footprint, cosine and weight of the echoes between transmitter and receiver; ``way`` from it."""
        import drjit as dr

        half = (echoes.range_m + distance) * 0.5
        received = replace(echoes, **{field.name: getattr(echoes, field.name) for field in fields(Echoes)})
        received.range_m = half
        if self.view.sonar.model == "thesis":
            received.near_m = received.far_m = half
            return received
        u = way / distance
        lift = self._rate(echoes, fan.d, fan.lift, u, normal)
        side = self._rate(echoes, fan.d, fan.side, u, normal)
        middle = half + side * fan.aside
        rises = dr.dot(normal, fan.lift) * dr.dot(normal, fan.d) < 0
        ends = (dr.select(rises, echoes.near_m, echoes.far_m), dr.select(rises, echoes.far_m, echoes.near_m))
        low, high = (
            self._edge(echoes, fan, angle, end, way, normal, middle + lift * angle)
            for angle, end in zip((fan.below, fan.above), ends, strict=True)
        )
        received.near_m, received.far_m = dr.select(low < high, low, high), dr.select(low < high, high, low)
        cosine = dr.abs(dr.dot(normal, u))
        received.cosine = dr.select(cosine < 1, cosine, 1)
        # spreading is 1/R_B^2, and the sonar equation divides by half the path squared
        received.solid_angle_sr = echoes.solid_angle_sr * (half / distance) ** 2
        return received

    @staticmethod
    def _edge(
        echoes: Echoes,
        fan: Fan,
        angle: DeviceArray,
        end: DeviceArray,
        way: DeviceArray,
        normal: DeviceArray,
        otherwise: DeviceArray,
    ) -> DeviceArray:
        """Return half the path by way of a flat edge, ``end`` from the transmitter [m]; elsewhere ``otherwise``."""
        import drjit as dr

        from mitsonar.plugins.echo_integrator import edge_direction, flatter

        toward = edge_direction(fan, angle)
        back = dr.norm(way + toward * end - fan.d * echoes.range_m)
        return dr.select(flatter(normal, fan.d, toward), (end + back) * 0.5, otherwise)

    @staticmethod
    def _rate(echoes: Echoes, d: DeviceArray, turn: DeviceArray, u: DeviceArray, normal: DeviceArray) -> DeviceArray:
        """Return the change of half the path by an angle of the transmitter's ray, on the tangent plane [m/rad]."""
        import drjit as dr

        from mitsonar.plugins.echo_integrator import steep

        along = -echoes.range_m * dr.dot(normal, turn) / steep(dr.dot(normal, d))
        return (along + dr.dot(u, d * along + turn * echoes.range_m)) * 0.5


def _window(sonar: Sonar) -> dict[str, float]:
    return {name: getattr(sonar, name) for name in ("range_min", "range_max", "range_bins")}


def _asin(value: DeviceArray) -> DeviceArray:
    import drjit as dr

    return dr.asin(dr.select(value < 1, dr.select(value > -1, value, -1), 1))
