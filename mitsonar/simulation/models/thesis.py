"""Model ``thesis``: many pings in one launch, whose echoes are summed exactly in range bins and beams, for each view.

Every sum is 64-bit fixed point, so it does not depend on the order of rays, threads or batches. The scale follows from the
largest possible sum, so nothing can overflow.

In the model ``thesis`` a ray adds its level to the bin that contains its range (Almanza-Medina, eq. 2.2-2.3). In the model
``physical`` its level is spread evenly over the range interval that its elevation cell covers. A box of density q over
[a, b) is stored as its difference from bin to bin, which takes four additions for any length: q (1 - frac a) at floor a,
q frac a at the next bin, and the same at b with opposite sign. A running sum over the bins then gives the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.levels import largest_level, level
from mitsonar.acoustics.water import loss_notes
from mitsonar.instruments.sonar import RAYS, Sonar
from mitsonar.instruments.views import Receiver, Segment, View, Whole
from mitsonar.motion.pose import mounted, to_world_matrices
from mitsonar.plugins.echo_integrator import edge_direction, flatter
from mitsonar.plugins.imaging_sonar_sensor import Fan
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.beams import beam_of
from mitsonar.simulation.device import DeviceArray, Frozen, LaunchTables, clipped, replayed
from mitsonar.simulation.pings import Counts, RenderedPings, labels_of
from mitsonar.simulation.tracing import Rays, Tracer, half_path_rate, hidden, surfaces_of

__all__ = [
    "NARROWEST",
    "ImageLaunch",
    "ReceiverTracer",
    "SegmentTracer",
    "ThesisModel",
    "ViewEchoes",
    "ViewTracer",
    "WholeTracer",
    "accumulate",
    "develop",
    "fetch",
    "fraction_bits",
    "strongest",
]


ADD = dr.ReduceMode.Local
"""Mode of the scatter-additions; Dr.Jit's default assumes an unchanged number of threads when a launch is replayed."""

COUNTERS = 3
"""Number of counter cells after the bins of a beam: returns nearer than the window, returns farther, and misses."""

NARROWEST = 2.0**-6
"""Shortest footprint [bins]: at normal incidence the footprint has no length, and the density would be infinite."""


class ThesisModel:
    """Renderer of levels: the level of each ray is added to the bin and the beam of its echo.

    Implements :class:`~mitsonar.simulation.models.create.PingModel`.

    Args:
        launch: launch that renders pings.
        rays_per_launch: upper bound on the rays of a launch and on its image cells.

    Attributes:
        launches: compiled launches and their rays, keyed by number of pings and whether there are labels.
    """

    imager = None

    def __init__(self, launch: ImageLaunch, rays_per_launch: int) -> None:
        self.launch, self.tracer, self.views = launch, launch.tracer, launch.views
        self.notes = [*self.tracer.notes, *loss_notes(self.tracer.sonar)]
        cells = sum(len(view.bearing_rad) * view.sonar.range_bins for view in self.views)
        # a launch holds one state of each deforming body, hence one ping
        self.pings_per_launch = 1 if self.tracer.deforms else max(1, rays_per_launch // max(self.tracer.sonar.rays, cells))
        self.launches: dict[tuple[int, bool], tuple[Callable[..., Any], DeviceArray]] = {}

    def adopt(self, scene: mi.Scene) -> bool:
        """Take over the surface tables of a changed scene at rest; return False if the model must be rebuilt."""
        return self.tracer.surfaces.adopt(surfaces_of(scene, self.tracer.sonar, None))

    def render(
        self, poses: NDArray[np.float64], time_s: NDArray[np.float64], numbers: list[int], labels: bool
    ) -> Iterator[list[RenderedPings]]:
        """Yield batches of pings, one entry for each view; see :class:`~mitsonar.simulation.models.create.PingModel`."""
        for start in range(0, len(poses), self.pings_per_launch):
            part = slice(start, start + self.pings_per_launch)
            yield self._batch(poses[part], time_s[part], numbers[part], labels)

    def _batch(
        self, poses: NDArray[np.float64], time_s: NDArray[np.float64], numbers: list[int], labels: bool
    ) -> list[RenderedPings]:
        """Render pings in a single launch."""
        # 1. Compile the launch, once for each number of pings.
        key, tracer = (len(poses), labels), self.tracer
        if key not in self.launches:
            self.launches[key] = self.launch.compiled(*key)
        launch, rays = self.launches[key]
        # 2. Run it. The scene comes first: it deforms bodies, and the inputs include their normals.
        scene = tracer.scene_at(time_s)
        inputs = tracer.inputs(poses, numbers)
        tables = [view_tracer.tables(poses) for view_tracer in self.launch.view_tracers]
        height, images = replayed(launch, rays, scene, *inputs, tables, self.launch.mirrors)
        height_m = np.array(height, dtype=float).reshape(len(poses), -1)[:, tracer.sonar.ping_groups // 2]
        # 3. Copy levels, counts and labels of each view to NumPy.
        rendered = []
        for view, (image, counters, truth, single) in zip(self.views, images, strict=True):
            pings = RenderedPings(numbers[0], *fetch(image, counters, len(poses), view), height_m)
            if labels:
                pings.expected = None if single is None else fetch(single, counters, len(poses), view)[0]
                pings.labels = labels_of(pings, truth, tracer.sonar.rays)
            rendered.append(pings)
        return rendered


@dataclass(frozen=True)
class ImageLaunch:
    """Compiler of launches that render a given number of pings.

    It holds no compiled launch: a launch refers to its compiler, and a circle of references would outlive the simulator.

    Attributes:
        tracer: tracer of the rays.
        views: views that are rendered.
    """

    tracer: Tracer
    views: Sequence[View]

    @cached_property
    def view_tracers(self) -> list[ViewTracer]:
        """Return the view tracer of each view."""
        return [TRACERS[type(view)](view) for view in self.views]

    @property
    def mirrors(self) -> LaunchTables | None:
        """Return the tables of mirrors, an input of the launch; None without mirrors."""
        return None

    def compiled(self, pings: int, labels: bool) -> tuple[Callable[..., Any], DeviceArray]:
        """Compile the launch of a number of pings; also return its first input, the numbers of the rays.

        The launch is recorded once and then replayed (``dr.freeze``), so a single ping costs its rays and hardly any Python.
        Its inputs are the ray numbers, the scene, the rows of the poses, the jitter keys, and the tables of surfaces, views
        and mirrors. It returns the heights and, for each view, the levels, the counters, the truth for labels, and the
        levels of single reflections if labels are derived from these.
        """
        tracer = self.tracer

        @Frozen
        def launch(index: Any, scene: Any, rows: Any, keys: Any, surfaces: Any, tables: Any, mirrors: Any) -> Any:
            # 1. Trace one echo for each ray.
            rays = Rays(tracer.sonar, index)
            ray, fan = tracer.rays_of(rays, rows, keys)
            echoes = tracer.echoes(scene, ray, fan, surfaces)
            # 2. Sum paths with several reflections; the mirror part of a surface does not scatter.
            echoes, more = self.bounced(scene, rays, fan, echoes, (rows, keys, surfaces, mirrors), pings)
            # 3. Sum the echoes of each view, and find the strongest ray of each cell for labels.
            weighted = self.weighted(fan, echoes)
            seen = [
                view_tracer.view_echoes(scene, rays, fan, weighted, table)
                for view_tracer, table in zip(self.view_tracers, tables, strict=True)
            ]
            sums = [
                accumulate(one, rays.ping, pings, view_tracer)
                for one, view_tracer in zip(seen, self.view_tracers, strict=True)
            ]
            truths = [
                (strongest(one, rays.ping, rays.ray, pings, view), one.elevation, one.echoes.shape_id, one.echoes.object_id)
                if labels
                else None
                for one, view in zip(seen, self.views, strict=True)
            ]
            # 4. Evaluate everything that reads the echoes in one kernel, before any sum is read: rays are traced only once.
            dr.eval(sums, more, truths)
            # 5. Turn the sums into levels and counters.
            images = []
            for total, view_tracer, truth in zip(sums, self.view_tracers, truths, strict=True):
                single = develop(total, pings, view_tracer)
                levels, counters = single if more is None else develop(total, pings, view_tracer, more)
                images.append((levels, counters, truth, single[0] if labels and more is not None else None))
            return tracer.height_m(scene, rows), images

        return launch, Rays.numbered(tracer.sonar, pings)

    def weighted(self, fan: Fan, echoes: Echoes) -> Echoes:
        """Return the echoes as they are summed; a pattern over elevation would weigh them here."""
        return echoes

    def bounced(
        self, scene: Any, rays: Rays, fan: Fan, echoes: Echoes, inputs: tuple[Any, ...], pings: int
    ) -> tuple[Echoes, tuple[mi.UInt64, int] | None]:
        """Return the echoes of one reflection, and the sums over paths of several; None if the model has none of these.

        Args:
            scene: scene to trace.
            rays: rays of the launch.
            fan: fan of the rays, in world axes.
            echoes: echo of each ray.
            inputs: inputs of the launch: rows of the poses, jitter keys, tables of surfaces and of mirrors.
            pings: number of pings in the launch.

        Returns:
            The echoes; the sums ``(pings, beams, stride)``, flat, with their number of fraction bits.
        """
        return echoes, None


# ---------------- Sums in range bins and beams


def stride(sonar: Sonar) -> int:
    """Return the number of cells of a beam in the sums: the bins, one cell after the last, and the counters."""
    return sonar.range_bins + 1 + COUNTERS


def accumulate(
    seen: ViewEchoes,
    ping: mi.UInt32,
    pings: int,
    tracer: ViewTracer,
    more: mi.UInt64 | None = None,
    *,
    counted: bool = True,
) -> mi.UInt64:
    """Sum the levels of a launch, in the same kernel that traces the echoes.

    Args:
        seen: echoes of the view, as Dr.Jit arrays with one value for each ray.
        ping: index of each ray's ping in the launch.
        pings: number of pings in the launch.
        tracer: tracer of the view.
        more: sums to which these levels are added; default: none.
        counted: whether to count the rays without an echo in the window (model ``physical``).

    Returns:
        The sums ``(pings, beams, stride)``, flat.
    """
    # 1. Find each ray's row of cells, and its level in fixed point.
    sonar, active, beams = tracer.view.sonar, seen.active, len(tracer.view.bearing_rad)
    exact = _exact(seen.echoes)
    hit = exact.hit > 0
    sums = dr.zeros(mi.UInt64, pings * beams * stride(sonar)) if more is None else more
    start = (ping * beams + seen.beam) * stride(sonar)
    value = level(exact, sonar, dr.select) * 2.0**tracer.bits
    # 2. Model thesis: one addition to the bin that contains the range, or 1 to a counter.
    if sonar.model == "thesis":
        position = (exact.range_m - sonar.range_min) * (1 / sonar.bin_m)
        inside = active & hit & (position >= 0) & (position < sonar.range_bins)
        cell = dr.select(inside, _whole(position), _counter(hit, position < 0, sonar))
        dr.scatter_reduce(dr.ReduceOp.Add, sums, dr.select(inside, mi.UInt64(value), 1), start + cell, active, mode=ADD)
        return sums
    # 3. Model physical: clip the footprint to the window; its density stays that of the whole footprint.
    a, b, width = footprint(exact, sonar)
    inside = active & hit & (b > 0) & (a < sonar.range_bins)
    a, b = clipped(a, 0, sonar.range_bins), clipped(b, 0, sonar.range_bins)
    first, last = _whole(a), _whole(b)
    # 4. Round the density and its fractional parts once, so that the four additions of a box cancel exactly.
    density = value / width
    whole, late, left = (mi.UInt64(density * part) for part in (1, a - dr.floor(a), b - dr.floor(b)))
    cell = dr.select(inside, first, _counter(hit, b <= 0, sonar))
    # 5. Add the differences. Additions to the same cell are merged: a footprint within a bin takes two, one that crosses
    # a single border takes three.
    same, apart = inside & (last == first), inside & (last > first + 1)
    second = dr.select(same, late - left, dr.select(apart, late, late + left - whole))
    begin = dr.select(inside, dr.select(same, left, whole) - late, 1)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, begin, start + cell, active if counted else inside, mode=ADD)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, second, start + first + 1, inside, mode=ADD)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, left - whole, start + last, apart, mode=ADD)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, mi.UInt64(0) - left, start + last + 1, inside & ~same & (left > 0), mode=ADD)
    return sums


def footprint(exact: Echoes, sonar: Sonar) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Return start, end and length of each ray's range interval [bins], at least :data:`NARROWEST` long."""
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
        sums: sums from :func:`accumulate`.
        pings: number of pings in the launch.
        tracer: tracer of the view.
        more: further sums whose levels are added, and their number of fraction bits; default: none.
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

    Transposing on the device would take ten times as long as the copy, because of scattered reads.
    """
    beams = len(view.bearing_rad)
    levels = np.array(image, copy=False).reshape(pings, beams, stride(view.sonar))[:, :, : view.sonar.range_bins]
    near, far, miss = np.array(counters).astype(np.int64).reshape(COUNTERS, pings, beams)
    inside = np.full_like(miss, -1) if view.rays_a_beam is None else view.rays_a_beam - near - far - miss
    return levels.transpose(0, 2, 1), Counts(inside, near, far, miss)


def strongest(seen: ViewEchoes, ping: mi.UInt32, ray: mi.UInt32, pings: int, view: View) -> mi.UInt64:
    """Find the strongest ray in each cell ``(pings, beams, bins)``.

    The high 32 bits of a result hold the density, the low 32 bits the index of the ray in its ping.
    """
    # 1. Compute the density of each ray, and the bins that it covers.
    sonar, beams = view.sonar, len(view.bearing_rad)
    exact = _exact(seen.echoes)
    best = dr.zeros(mi.UInt64, pings * beams * sonar.range_bins)
    value = level(exact, sonar, dr.select)
    if sonar.model == "thesis":
        position = (exact.range_m - sonar.range_min) * (1 / sonar.bin_m)
        a, b = dr.floor(position), dr.floor(position) + 1
    else:
        a, b, width = footprint(exact, sonar)
        value = value / width
    inside = seen.active & (exact.hit > 0) & (b > 0) & (a < sonar.range_bins) & (value > 0)
    a, b = clipped(a, 0, sonar.range_bins), clipped(b, 0, sonar.range_bins)
    # 2. Pack density and ray into one integer. The bits of positive floats order as the floats do, so a maximum finds both.
    strength: DeviceArray = dr.reinterpret_array(mi.UInt32, mi.Float(value))
    # a level that underflows float32 still beats an empty cell
    key = (mi.UInt64(dr.select(strength > 0, strength, 1)) << 32) | mi.UInt64(ray)
    start, bin_, end = (ping * beams + seen.beam) * sonar.range_bins, _whole(a), _whole(dr.ceil(b))

    # 3. Visit the covered bins of each ray in turn.
    def step(bin_: mi.UInt32) -> tuple[mi.UInt32]:
        dr.scatter_reduce(dr.ReduceOp.Max, best, key, start + bin_, inside & (bin_ < end))
        return (bin_ + 1,)

    dr.while_loop((bin_,), lambda bin_: inside & (bin_ < end), step)
    return best


def _exact(echoes: Echoes) -> Echoes:
    """Return the echoes in double precision, to match the results of NumPy."""
    return Echoes(**{field.name: mi.Float64(getattr(echoes, field.name)) for field in fields(Echoes)})


def _counter(hit: mi.Bool, near: mi.Bool, sonar: Sonar) -> mi.UInt32:
    """Return the counter cell of a ray outside the window, within its beam."""
    near_cell = mi.UInt32(sonar.range_bins + 1)
    return dr.select(hit, dr.select(near, near_cell, near_cell + 1), near_cell + 2)


def _whole(position: DeviceArray) -> mi.UInt32:
    return mi.UInt32(dr.select(position > 0, position, 0))


# ---------------- Views: the whole field of view or a portion


@dataclass(frozen=True)
class ViewEchoes:
    """Echoes of a launch in one view, one value for each ray, not evaluated yet.

    Attributes:
        echoes: echoes with the ranges and levels of this view.
        beam: index of the view's beam.
        active: whether the ray belongs to the view; other rays are not counted.
        elevation: elevation of each ray in the frame of the view [rad].
    """

    echoes: Echoes
    beam: DeviceArray
    active: DeviceArray
    elevation: DeviceArray


class ViewTracer(Protocol):
    """Protocol of an object that turns the echoes of a launch into those of one view.

    Attributes:
        bits: fraction bits of the fixed-point sums.
    """

    bits: int

    @property
    def view(self) -> View:
        """Return the view."""

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return the inputs that the view adds to a launch, for sonar poses ``(pings, 6)`` [m, rad]."""

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return the echoes of a launch in this view, in the same kernel that traces them."""


class WholeTracer:
    """View tracer of the whole field of view: every echo, in the beam of its ray."""

    def __init__(self, view: Whole) -> None:
        self.view = view
        self.bits = fraction_bits(view.sonar, view.sonar.rays // view.sonar.beams)

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return an empty dictionary: the view needs no inputs."""
        return {}

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return all echoes, each in the beam of its ray."""
        return ViewEchoes(echoes, rays.beam, True, fan.elevation)


class SegmentTracer:
    """View tracer of a portion of the field of view."""

    def __init__(self, view: Segment) -> None:
        self.view = view
        self.bits = fraction_bits(view.sonar, view.sonar.rays // view.sonar.beams)

    @cached_property
    def _on_device(self) -> LaunchTables:
        table = mi.Bool(self.view.member)
        dr.make_opaque(table)
        return {"member": table}

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return the mask of film pixels that belong to the portion."""
        return self._on_device

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return the echoes of the portion; beams are numbered from its first."""
        active = dr.gather(mi.Bool, tables["member"], rays.film)
        return ViewEchoes(echoes, dr.select(active, rays.beam - self.view.first_beam, 0), active, fan.elevation)


def fraction_bits(sonar: Sonar, rays: int, gain: float = 1.0) -> int:
    """Return the fraction bits of fixed-point sums such that ``rays`` of the largest level in one bin stay below 2^62.

    Args:
        sonar: the instrument.
        rays: largest number of rays in one bin.
        gain: largest factor by which a view multiplies a ray's level.
    """
    cell = sonar.beam_width_rad / sonar.across * math.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam
    largest = largest_level(sonar, cell) * rays * gain
    return 62 - math.ceil(math.log2(largest if sonar.model == "thesis" else largest / NARROWEST))


# ---------------- Views: a bistatic receiver


class ReceiverTracer:
    """View tracer of a receiver away from the transmitter (Almanza-Medina, 3.6): the transmitter's rays, seen from there.

    See :class:`~mitsonar.instruments.views.Receiver` for the geometry.
    """

    def __init__(self, view: Receiver) -> None:
        self.view = view
        sonar, apart = view.sonar, math.dist(view.offset[:3], (0, 0, 0))
        # r = (R_A + R_B) / 2 <= R_B + apart / 2, and r is at least the start of the window where it counts
        nearest = max(sonar.range_min, sonar.bin_m)
        gain = (nearest / (nearest - apart / 2)) ** 2 if sonar.model == "physical" else 1.0
        traced = {name: getattr(view.transmitter, name) for name in RAYS}  # another window would imply other ray counts
        self.bits = fraction_bits(view.transmitter.replace(**_window(sonar), **traced), view.transmitter.rays, gain)

    def tables(self, poses: ArrayLike) -> LaunchTables:
        """Return the poses of the receiver: three rows of ``to_world`` for each ping."""
        rows = to_world_matrices(mounted(poses, self.view.offset))[:, :3].astype(np.float32)
        return {"rows": mi.Float(rows.ravel().tolist())}

    def view_echoes(self, scene: mi.Scene, rays: Rays, fan: Fan, echoes: Echoes, tables: LaunchTables) -> ViewEchoes:
        """Return the echoes that the receiver measures."""
        # 1. Direction and distance from the receiver to the point that each ray hits.
        lines = [dr.gather(mi.Vector4f, tables["rows"], rays.ping * 3 + axis) for axis in range(3)]
        u: DeviceArray
        normal: DeviceArray = mi.Normal3f(echoes.nx, echoes.ny, echoes.nz)
        point = mi.Point3f(echoes.x, echoes.y, echoes.z)
        from_receiver = mi.Vector3f(*(p - line.w for p, line in zip(point, lines, strict=True)))
        distance = dr.norm(from_receiver)
        u = from_receiver / distance
        # 2. The receiver's beam in that direction.
        port, up, forward = (sum(line[axis] * u[row] for row, line in enumerate(lines)) for axis in range(3))
        beam, inside, elevation = beam_of(self.view.sonar, -port, forward, up)
        # 3. Visibility: both ends on the same side of the surface, and nothing between the point and the receiver.
        toward = dr.dot(normal, u)
        lit = (echoes.hit > 0) & inside & (toward * dr.dot(normal, fan.d) > 0)
        active = lit & ~hidden(scene, point, normal, u, distance, lit)
        return ViewEchoes(
            self._received(echoes, fan, from_receiver, distance, normal), dr.select(active, beam, 0), active, elevation
        )

    def _received(
        self, echoes: Echoes, fan: Fan, from_receiver: DeviceArray, distance: DeviceArray, normal: DeviceArray
    ) -> Echoes:
        """Compute range, footprint, cosine and weight of the echoes at the receiver.

        ``from_receiver`` is the vector from the receiver to the point hit, and ``distance`` its length [m].
        """
        # 1. The range is half of the path. The copy leaves the echoes of other views unchanged.
        half = (echoes.range_m + distance) * 0.5
        received = replace(echoes, **{field.name: getattr(echoes, field.name) for field in fields(Echoes)})
        received.range_m = half
        if self.view.sonar.model == "thesis":
            received.near_m = received.far_m = half
            return received
        # 2. Footprint: carry half the path from the ray to the lower and upper edge of its cell, on the tangent plane.
        # Jitter displaces the ray from the middle of its cell, by ``aside`` in bearing.
        u = from_receiver / distance
        lift = half_path_rate(echoes.range_m, fan.d, fan.lift, u, normal)
        side = half_path_rate(echoes.range_m, fan.d, fan.side, u, normal)
        middle = half + side * fan.aside
        # The nearer end of the monostatic footprint belongs to the lower edge where the range grows with elevation.
        rises = dr.dot(normal, fan.lift) * dr.dot(normal, fan.d) < 0
        ends = (dr.select(rises, echoes.near_m, echoes.far_m), dr.select(rises, echoes.far_m, echoes.near_m))
        low, high = (
            self._edge(echoes, fan, angle, end, from_receiver, normal, middle + lift * angle)
            for angle, end in zip((fan.below, fan.above), ends, strict=True)
        )
        received.near_m, received.far_m = dr.select(low < high, low, high), dr.select(low < high, high, low)
        # 3. The receiver's cosine, since the transmitter's cancels in the lit area.
        cosine = dr.abs(dr.dot(normal, u))
        received.cosine = dr.select(cosine < 1, cosine, 1)
        # 4. Spreading is 1 / R_B^2, whereas the sonar equation divides by half the path squared.
        received.solid_angle_sr = echoes.solid_angle_sr * (half / distance) ** 2
        return received

    @staticmethod
    def _edge(
        echoes: Echoes,
        fan: Fan,
        angle: DeviceArray,
        end: DeviceArray,
        from_receiver: DeviceArray,
        normal: DeviceArray,
        otherwise: DeviceArray,
    ) -> DeviceArray:
        """Return half the path via the edge of a cell at grazing incidence, and ``otherwise`` elsewhere [m].

        ``end`` is the distance of the edge from the transmitter [m], ``angle`` its elevation relative to the ray [rad].
        """
        toward = edge_direction(fan, angle)
        back = dr.norm(from_receiver + toward * end - fan.d * echoes.range_m)
        return dr.select(flatter(normal, fan.d, toward), (end + back) * 0.5, otherwise)


def _window(sonar: Sonar) -> dict[str, float]:
    return {name: getattr(sonar, name) for name in ("range_min", "range_max", "range_bins")}


# ---------------- View tracers by kind of view


TRACERS = {Whole: WholeTracer, Segment: SegmentTracer, Receiver: ReceiverTracer}
