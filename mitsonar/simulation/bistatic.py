"""What a receiver beside the transmitter hears (Almanza-Medina, 3.6): the transmitter's rays, seen from elsewhere."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion import Pose, mounted, to_world_matrices
from mitsonar.simulation.echoes import Echoes
from mitsonar.simulation.views import Seen, fraction_bits
from mitsonar.sonar import Sonar

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.plugins.imaging_sonar import Fan
    from mitsonar.simulation.tracing import Rays

__all__ = ["Receiver"]

FEWEST_ACROSS = 8
"""Jittered rays of the transmitter across a receiver's beam, below which images have stripes."""


class Receiver:
    """One receiver of a bistatic sonar.

    A ray of the transmitter A hits P. The image's range is half of |P - A| + |B - P|, its beam the bearing of P in B's
    frame; P outside B's field of view, hidden from B, or lit on its other side does not count. Level, ``thesis``: C times
    the transmitter's cosine, as its rays know it. ``physical``: C cos(theta_B) dOmega r^g / R_B^2, the cosine the
    receiver's, since the transmitter's cancels in the lit area dA = R_A^2 dOmega / cos(theta_A); it becomes the monostatic
    law where B is A. The ground point of a cell lies on an ellipsoid with A and B as its foci.

    Args:
        transmitter: whose rays are traced: at least eight jittered columns across one of the receiver's beams.
        sonar: of the receiver: its field of view, beams and range bins; model and gain as the transmitter's.
        offset: pose of the receiver in the transmitter's axes (starboard, forward, up).
        name: of the view.

    Raises:
        MitsonarError: too few columns, beams that overlap, another model or gain than the transmitter's, a window that
            begins nearer than half the distance between transmitter and receiver.
    """

    rays_a_beam: NDArray[np.int64] | None = None

    def __init__(self, transmitter: Sonar, sonar: Sonar, offset: Pose, name: str) -> None:
        self.sonar, self.offset, self.name = sonar, offset, name
        self.bearing_rad = sonar.bearing_rad
        self._check(transmitter)
        apart = math.dist(offset[:3], (0, 0, 0))
        # r = (R_A + R_B) / 2 <= R_B + apart / 2, and r is at least the window's begin where it counts
        nearest = max(sonar.range_min, sonar.bin_m)
        gain = (nearest / (nearest - apart / 2)) ** 2 if sonar.model == "physical" else 1.0
        self.bits = fraction_bits(transmitter.replace(**_window(sonar)), transmitter.rays, gain)

    def _check(self, transmitter: Sonar) -> None:
        sonar, name = self.sonar, self.name
        if (sonar.model, sonar.gain_exponent) != (transmitter.model, transmitter.gain_exponent):
            raise MitsonarError(f"receiver {name} must have the transmitter's model and gain_exponent")
        if sonar.beam_width_deg is not None and sonar.beam_width_rad > sonar.beam_spacing_rad * (1 + 1e-9):
            raise MitsonarError(f"receiver {name}: beams may not overlap; leave beam_width_deg out")
        across = transmitter.columns / transmitter.azimuth_fov_deg * sonar.azimuth_fov_deg / sonar.beams
        if across < FEWEST_ACROSS * (1 - 1e-9) or not transmitter.jittered:
            raise MitsonarError(
                f"receiver {name}: the transmitter needs {FEWEST_ACROSS} jittered columns of rays across a receiver's beam, "
                f"or stripes appear: got {across:.3g}, jitter {transmitter.jittered}; raise beams (thesis) or rays_across"
            )
        if math.dist(self.offset[:3], (0, 0, 0)) / 2 >= max(sonar.range_min, sonar.bin_m) and sonar.model == "physical":
            raise MitsonarError(f"receiver {name}: range_min must exceed half its distance from the transmitter")

    def tables(self, poses: ArrayLike) -> dict[str, Any]:
        """Where the receiver is: three rows of ``to_world`` a ping."""
        import mitsuba as mi

        rows = to_world_matrices(mounted(poses, self.offset))[:, :3].astype(np.float32)
        return {"rows": mi.Float(rows.ravel().tolist())}

    def see(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: dict[str, Any]) -> Seen:
        """The echoes as the receiver has them."""
        import drjit as dr
        import mitsuba as mi

        from mitsonar.simulation.tracing import hidden

        lines = [dr.gather(mi.Vector4f, tables["rows"], rays.ping * 3 + axis) for axis in range(3)]
        u: Any
        point, normal = mi.Point3f(echoes.x, echoes.y, echoes.z), mi.Normal3f(echoes.nx, echoes.ny, echoes.nz)
        way = mi.Vector3f(*(p - line.w for p, line in zip(point, lines, strict=True)))
        distance = dr.norm(way)
        u = way / distance
        port, up, forward = (sum(line[axis] * u[row] for row, line in enumerate(lines)) for axis in range(3))
        beam, inside, elevation = self._beam(-port, forward, up)
        toward = dr.dot(normal, u)
        lit = (echoes.hit > 0) & inside & (toward * dr.dot(normal, fan.d) > 0)
        active = lit & ~hidden(scene, point, normal, u, distance, lit)
        return Seen(self._heard(echoes, fan, u, distance, normal), dr.select(active, beam, 0), active, elevation)

    def _beam(self, starboard: Any, forward: Any, up: Any) -> tuple[Any, Any, Any]:
        """Beam, whether the direction lies in the field of view, and elevation [rad]."""
        import drjit as dr
        import mitsuba as mi

        sonar = self.sonar
        half = math.radians(sonar.azimuth_fov_deg) / 2
        if sonar.bearing == "azimuth":
            bearing, elevation = dr.atan2(starboard, forward), _asin(up)
        else:
            bearing, elevation = _asin(starboard), dr.atan2(up, forward)
        if sonar.beam_layout == "even":
            place = bearing * (sonar.beams / (2 * half)) + sonar.beams / 2
        else:
            place = dr.sin(bearing) * (sonar.beams / (2 * math.sin(half))) + sonar.beams / 2
        inside = (place >= 0) & (place < sonar.beams) & (dr.abs(bearing) <= half)
        inside &= dr.abs(elevation) <= math.radians(sonar.elevation_fov_deg) / 2
        beam = mi.UInt32(dr.select(inside, place, 0))
        if sonar.beam_width_deg is not None and sonar.model == "physical":
            axes = mi.Float(sonar.bearing_rad.tolist())
            inside &= dr.abs(bearing - dr.gather(mi.Float, axes, beam)) <= sonar.beam_width_rad / 2
        return beam, inside, elevation

    def _heard(self, echoes: Echoes, fan: Fan, u: Any, distance: Any, normal: Any) -> Echoes:
        """Range, footprint, cosine and weight of the echoes between transmitter and receiver."""
        import drjit as dr

        half = (echoes.range_m + distance) * 0.5
        heard = replace(echoes, **{field.name: getattr(echoes, field.name) for field in fields(Echoes)})
        heard.range_m = half
        if self.sonar.model == "thesis":
            heard.near_m = heard.far_m = half
            return heard
        lift = self._rate(echoes, fan.d, fan.lift, u, normal)
        side = self._rate(echoes, fan.d, fan.side, u, normal)
        middle = half + side * fan.aside
        low, high = middle + lift * fan.below, middle + lift * fan.above
        heard.near_m, heard.far_m = dr.select(low < high, low, high), dr.select(low < high, high, low)
        cosine = dr.abs(dr.dot(normal, u))
        heard.cosine = dr.select(cosine < 1, cosine, 1)
        # spreading is 1/R_B^2, and the law of levels divides by half the path squared
        heard.solid_angle_sr = echoes.solid_angle_sr * (half / distance) ** 2
        return heard

    @staticmethod
    def _rate(echoes: Echoes, d: Any, turn: Any, u: Any, normal: Any) -> Any:
        """Change of half the path by an angle of the transmitter's ray, on the tangent plane [m/rad]."""
        import drjit as dr

        from mitsonar.plugins.echo import steep

        along = -echoes.range_m * dr.dot(normal, turn) / steep(dr.dot(normal, d))
        return (along + dr.dot(u, d * along + turn * echoes.range_m)) * 0.5


def _window(sonar: Sonar) -> dict[str, Any]:
    return {name: getattr(sonar, name) for name in ("range_min", "range_max", "range_bins")}


def _asin(value: Any) -> Any:
    import drjit as dr

    return dr.asin(dr.select(value < 1, dr.select(value > -1, value, -1), 1))
