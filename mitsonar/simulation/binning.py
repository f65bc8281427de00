"""Sum echoes in range bins and beams, in one kernel and exactly.

Every sum is 64-bit fixed point, so it does not depend on the order of rays, threads or batches. The scale follows from the
largest possible sum, so nothing can overflow.

``thesis``: a ray adds its level to the bin that holds its range (Almanza-Medina, eq. 2.2-2.3). ``physical``: its level is
spread evenly over the range interval that its elevation cell covers. A box of density q over [a, b) is kept as its
derivative by bins, four additions for any length: q (1 - frac a) at floor a, q frac a at the next bin, and the same at b
with the other sign. One running sum over the bins then gives the image.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.levels import largest_level, level
from mitsonar.instruments.sonar import RAYS, Sonar
from mitsonar.instruments.views import Receiver, Segment, View, Whole
from mitsonar.motion.pose import mounted, to_world_matrices
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.device import DeviceArray, LaunchTables

if TYPE_CHECKING:
    from mitsonar.plugins.imaging_sonar_sensor import Fan
    from mitsonar.simulation.tracing import Rays

__all__ = [
    "NARROWEST",
    "Counts",
    "ReceiverTracer",
    "SegmentTracer",
    "ViewEchoes",
    "ViewTracer",
    "WholeTracer",
    "accumulate",
    "develop",
    "fetch",
    "fraction_bits",
    "half_path_rate",
    "strongest",
    "view_tracers",
]


ADD = dr.ReduceMode.Local
"""Mode of the additions: Dr.Jit's default assumes that the number of threads is the same when a launch is replayed."""

COUNTERS = 3
"""Cells of a beam after its bins: returns nearer than the window, returns farther than it, and misses."""


@dataclass
class Counts:
    """Numbers of rays of each beam ``(frames, beams)``: inside the window, nearer, farther, missed.

    Where the rays of a beam differ from ping to ping (``View.rays_a_beam`` is None), ``inside`` is -1.
    """

    inside: NDArray[np.int64]
    nearer: NDArray[np.int64]
    farther: NDArray[np.int64]
    missed: NDArray[np.int64]


def stride(sonar: Sonar) -> int:
    """Return the cells of a beam in the sums: bins, the cell after the last, counters."""
    return sonar.range_bins + 1 + COUNTERS


def accumulate(
    seen: ViewEchoes, ping: mi.UInt32, pings: int, tracer: ViewTracer, more: mi.UInt64 | None = None, *, counted: bool = True
) -> mi.UInt64:
    """Sum the levels of a launch; joins the kernel that traces the echoes.

    Args:
        seen: Dr.Jit arrays, one value for each ray.
        ping: index of each ray's ping in the launch.
        pings: number of pings in the launch.
        tracer: of the view.
        more: sums that these levels are added to; default: none.
        counted: whether the rays that bring nothing into the window are counted.

    Returns:
        The sums ``(pings, beams, stride)``, flat.
    """
    sonar, active, beams = tracer.view.sonar, seen.active, len(tracer.view.bearing_rad)
    exact = _exact(seen.echoes)
    hit = exact.hit > 0
    sums = dr.zeros(mi.UInt64, pings * beams * stride(sonar)) if more is None else more
    start = (ping * beams + seen.beam) * stride(sonar)
    value = level(exact, sonar, dr.select) * 2.0**tracer.bits
    if sonar.model == "thesis":
        place = (exact.range_m - sonar.range_min) * (1 / sonar.bin_m)
        inside = active & hit & (place >= 0) & (place < sonar.range_bins)
        cell = dr.select(inside, _whole(place), _counter(hit, place < 0, sonar))
        dr.scatter_reduce(dr.ReduceOp.Add, sums, dr.select(inside, mi.UInt64(value), 1), start + cell, active, mode=ADD)
        return sums
    a, b, width = footprint(exact, sonar)
    inside = active & hit & (b > 0) & (a < sonar.range_bins)
    a, b = _clip(a, sonar.range_bins), _clip(b, sonar.range_bins)
    first, last = _whole(a), _whole(b)
    density = value / width
    whole, late, left = (mi.UInt64(density * part) for part in (1, a - dr.floor(a), b - dr.floor(b)))
    cell = dr.select(inside, first, _counter(hit, b <= 0, sonar))
    # additions to one cell are joined: a footprint within a bin takes two, across one border three
    same, apart = inside & (last == first), inside & (last > first + 1)
    second = dr.select(same, late - left, dr.select(apart, late, late + left - whole))
    begin = dr.select(inside, dr.select(same, left, whole) - late, 1)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, begin, start + cell, active if counted else inside, mode=ADD)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, second, start + first + 1, inside, mode=ADD)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, left - whole, start + last, apart, mode=ADD)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, mi.UInt64(0) - left, start + last + 1, inside & ~same & (left > 0), mode=ADD)
    return sums


def footprint(exact: Echoes, sonar: Sonar) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Return begin, end and length of each ray's range interval [bins], at least :data:`NARROWEST` long."""
    a = (exact.near_m - sonar.range_min) * (1 / sonar.bin_m)
    b = (exact.far_m - sonar.range_min) * (1 / sonar.bin_m)
    wide = b - a > NARROWEST
    middle = (a + b) * 0.5
    a = dr.select(wide, a, middle - NARROWEST / 2)
    b = dr.select(wide, b, middle + NARROWEST / 2)
    return a, b, b - a


def develop(
    sums: mi.UInt64, pings: int, tracer: ViewTracer, more: tuple[mi.UInt64, int] | None = None
) -> tuple[mi.Float, mi.UInt64]:
    """Turn sums into levels ``(pings, beams, stride)`` and counters ``(COUNTERS, pings, beams)``, flat.

    Args:
        sums: of :func:`accumulate`.
        pings: number of pings in the launch.
        tracer: of the view.
        more: sums of other fraction bits, and these, whose levels are added; default: none.
    """
    view = tracer.view
    size, lines = stride(view.sonar), pings * len(view.bearing_rad)
    total = sums if view.sonar.model == "thesis" else dr.block_prefix_sum(sums, size, exclusive=False)
    index = dr.arange(mi.UInt32, lines * COUNTERS)
    counters = dr.gather(mi.UInt64, sums, index % lines * size + (view.sonar.range_bins + 1) + index // lines)
    levels: DeviceArray = mi.Float64(total) * 2.0**-tracer.bits
    if more is not None:
        levels = levels + mi.Float64(dr.block_prefix_sum(more[0], size, exclusive=False)) * 2.0 ** -more[1]
    return mi.Float(levels), counters


def fetch(image: mi.Float, counters: mi.UInt64, pings: int, view: View) -> tuple[NDArray[np.float32], Counts]:
    """Copy the results of :func:`develop` to NumPy: levels ``(pings, bins, beams)``, beam-major in memory, and counts.

    A transposition on the device would take ten times as long as the copy (scattered reads).
    """
    beams = len(view.bearing_rad)
    levels = np.array(image, copy=False).reshape(pings, beams, stride(view.sonar))[:, :, : view.sonar.range_bins]
    near, far, miss = np.array(counters).astype(np.int64).reshape(COUNTERS, pings, beams)
    inside = np.full_like(miss, -1) if view.rays_a_beam is None else view.rays_a_beam - near - far - miss
    return levels.transpose(0, 2, 1), Counts(inside, near, far, miss)


def strongest(seen: ViewEchoes, ping: mi.UInt32, ray: mi.UInt32, pings: int, view: View) -> mi.UInt64:
    """Find the strongest ray in each cell ``(pings, beams, bins)``.

    The high 32 bits hold the density, the low 32 bits the number of the ray in its ping.
    """
    sonar, beams = view.sonar, len(view.bearing_rad)
    exact = _exact(seen.echoes)
    best = dr.zeros(mi.UInt64, pings * beams * sonar.range_bins)
    value = level(exact, sonar, dr.select)
    if sonar.model == "thesis":
        place = (exact.range_m - sonar.range_min) * (1 / sonar.bin_m)
        a, b = dr.floor(place), dr.floor(place) + 1
    else:
        a, b, width = footprint(exact, sonar)
        value = value / width
    inside = seen.active & (exact.hit > 0) & (b > 0) & (a < sonar.range_bins) & (value > 0)
    a, b = _clip(a, sonar.range_bins), _clip(b, sonar.range_bins)
    strength: DeviceArray = dr.reinterpret_array(mi.UInt32, mi.Float(value))
    # a level below float32's smallest still beats an empty cell
    key = (mi.UInt64(dr.select(strength > 0, strength, 1)) << 32) | mi.UInt64(ray)
    start, bin_, end = (ping * beams + seen.beam) * sonar.range_bins, _whole(a), _whole(dr.ceil(b))

    def step(bin_: mi.UInt32) -> tuple[mi.UInt32]:
        dr.scatter_reduce(dr.ReduceOp.Max, best, key, start + bin_, inside & (bin_ < end))
        return (bin_ + 1,)

    dr.while_loop((bin_,), lambda bin_: inside & (bin_ < end), step)
    return best


def _exact(echoes: Echoes) -> Echoes:
    """Return the echoes in double precision, as NumPy computes them."""
    return Echoes(**{field.name: mi.Float64(getattr(echoes, field.name)) for field in fields(Echoes)})


def _counter(hit: mi.Bool, near: mi.Bool, sonar: Sonar) -> mi.UInt32:
    """Return the cell that counts a ray outside the window."""
    near_cell = mi.UInt32(sonar.range_bins + 1)
    return dr.select(hit, dr.select(near, near_cell, near_cell + 1), near_cell + 2)


def _clip(place: DeviceArray, bins: int) -> DeviceArray:
    """Clip into 0..bins by comparisons, since LLVM 15 and 16 abort on `max` (see simulation.variant)."""
    return dr.select(place > 0, dr.select(place < bins, place, bins), 0)


def _whole(place: DeviceArray) -> mi.UInt32:
    return mi.UInt32(dr.select(place > 0, place, 0))


# ---------------- Echoes of a view: all echoes of a ping, or those of a portion of the field of view


NARROWEST = 2.0**-6
"""Shortest footprint [bins]: a surface at normal incidence has none, and a density needs one."""


@dataclass(frozen=True)
class ViewEchoes:
    """The echoes of a launch in one view, one value for each ray, not evaluated yet.

    Attributes:
        echoes: with ranges and levels of this view.
        beam: index of the view's beam.
        active: whether the ray belongs to the view; other rays are not counted.
        elevation: of each ray in the view's own frame [rad].
    """

    echoes: Echoes
    beam: DeviceArray
    active: DeviceArray
    elevation: DeviceArray


class ViewTracer(Protocol):
    """Turn the echoes of a launch into those of one view.

    Attributes:
        bits: fraction bits of the fixed-point sums.
    """

    bits: int

    @property
    def view(self) -> View:
        """Return the view."""

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return the view's inputs of a launch, given the sonar's poses ``(pings, 6)`` [m, rad]."""

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return the echoes of a launch in this view; joins the kernel that traces them."""


class WholeTracer:
    """All echoes, each in the beam of its ray."""

    def __init__(self, view: Whole) -> None:
        self.view = view
        self.bits = fraction_bits(view.sonar, view.sonar.rays // view.sonar.beams)

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return an empty table: the view needs no inputs."""
        return {}

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return all echoes, each in the beam of its ray."""
        return ViewEchoes(echoes, rays.beam, True, fan.elevation)


class SegmentTracer:
    """The echoes of a portion of the field of view."""

    def __init__(self, view: Segment) -> None:
        self.view = view
        self.bits = fraction_bits(view.sonar, view.sonar.rays // view.sonar.beams)

    @cached_property
    def _on_device(self) -> LaunchTables:
        import drjit as dr
        import mitsuba as mi

        table = mi.Bool(self.view.member)
        dr.make_opaque(table)
        return {"member": table}

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return the pixels of the film that belong to the portion."""
        return self._on_device

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return the echoes of the portion; beams count from its first."""
        import drjit as dr
        import mitsuba as mi

        active = dr.gather(mi.Bool, tables["member"], rays.film)
        return ViewEchoes(echoes, dr.select(active, rays.beam - self.view.first_beam, 0), active, fan.elevation)


def fraction_bits(sonar: Sonar, rays: int, gain: float = 1.0) -> int:
    """Return the fraction bits of the fixed-point sums: ``rays`` of the largest level in one bin stay below 2^62.

    Args:
        sonar: the instrument.
        rays: largest number of rays in one bin.
        gain: largest factor by which a view multiplies a ray's level.
    """
    cell = sonar.beam_width_rad / sonar.across * math.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam
    largest = largest_level(sonar, cell) * rays * gain
    return 62 - math.ceil(math.log2(largest if sonar.model == "thesis" else largest / NARROWEST))


# ---------------- Echoes at a receiver beside the transmitter (Almanza-Medina, 3.6): the transmitter's rays, seen
# from the receiver


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

        from mitsonar.simulation.beams import beam_of
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


# ---------------- The tracer of each kind of view


TRACERS = {Whole: WholeTracer, Segment: SegmentTracer, Receiver: ReceiverTracer}


def view_tracers(views: Iterable[View]) -> list[ViewTracer]:
    """Return the tracer of each view, in their order."""
    return [TRACERS[type(view)](view) for view in views]
