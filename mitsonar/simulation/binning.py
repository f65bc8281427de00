"""Sum echoes in range bins and beams, in one kernel and exactly.

Every sum is 64-bit fixed point, so it does not depend on the order of rays, threads or batches. The scale follows from the
largest possible sum, so nothing can overflow.

``thesis``: a ray adds its level to the bin that holds its range (Almanza-Medina, eq. 2.2-2.3). ``physical``: its level is
spread evenly over the range interval that its elevation cell covers. A box of density q over [a, b) is kept as its
derivative by bins, four additions for any length: q (1 - frac a) at floor a, q frac a at the next bin, and the same at b
with the other sign. One running sum over the bins then gives the image.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.levels import level
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import View
from mitsonar.records.echoes import Echoes
from mitsonar.simulation.device_arrays import DeviceArray
from mitsonar.simulation.view_echoes import NARROWEST, ViewEchoes, ViewTracer

__all__ = ["Counts", "accumulate", "develop", "fetch", "strongest"]

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
