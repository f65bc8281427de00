"""Echoes at a receiver beside the transmitter (Almanza-Medina, 3.6): the transmitter's rays, seen from the receiver."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from mitsonar.instruments.sonar import RAYS, Sonar
from mitsonar.instruments.views import Receiver
from mitsonar.motion.pose import mounted, to_world_matrices
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.device_arrays import DeviceArray, LaunchTables
from mitsonar.simulation.view_echoes import ViewEchoes, fraction_bits

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.plugins.imaging_sonar_sensor import Fan
    from mitsonar.simulation.tracing import Rays

__all__ = ["ReceiverTracer", "half_path_rate"]


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

        from mitsonar.simulation.beam_of_direction import beam_of
        from mitsonar.simulation.tracing import hidden

        lines = [dr.gather(mi.Vector4f, tables["rows"], rays.ping * 3 + axis) for axis in range(3)]
        u: DeviceArray
        normal: DeviceArray = mi.Normal3f(echoes.nx, echoes.ny, echoes.nz)
        point = mi.Point3f(echoes.x, echoes.y, echoes.z)
        way = mi.Vector3f(*(p - line.w for p, line in zip(point, lines, strict=True)))
        distance = dr.norm(way)
        u = way / distance
        port, up, forward = (sum(line[axis] * u[row] for row, line in enumerate(lines)) for axis in range(3))
        beam, inside, elevation = beam_of(self.view.sonar, -port, forward, up)
        toward = dr.dot(normal, u)
        lit = (echoes.hit > 0) & inside & (toward * dr.dot(normal, fan.d) > 0)
        active = lit & ~hidden(scene, point, normal, u, distance, lit)
        return ViewEchoes(self._received(echoes, fan, way, distance, normal), dr.select(active, beam, 0), active, elevation)

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
        lift = half_path_rate(echoes.range_m, fan.d, fan.lift, u, normal)
        side = half_path_rate(echoes.range_m, fan.d, fan.side, u, normal)
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


def half_path_rate(
    range_m: DeviceArray, d: DeviceArray, turn: DeviceArray, u: DeviceArray, normal: DeviceArray
) -> DeviceArray:
    """Return the change of half a path by an angle of its ray, on the tangent plane [m/rad].

    Args:
        range_m: along the ray [m].
        d: direction of the ray.
        turn: its derivative by the angle.
        u: unit direction from the other end of the path to the point hit.
        normal: of the surface there.
    """
    import drjit as dr

    from mitsonar.plugins.echo_integrator import steep

    along = -range_m * dr.dot(normal, turn) / steep(dr.dot(normal, d))
    return (along + dr.dot(u, d * along + turn * range_m)) * 0.5


def _window(sonar: Sonar) -> dict[str, float]:
    return {name: getattr(sonar, name) for name in ("range_min", "range_max", "range_bins")}
