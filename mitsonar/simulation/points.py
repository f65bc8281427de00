"""Scatterers that no memory holds: points on a lattice of the world, placed and weighted by a hash of their cell.

A surface is divided by a lattice over the two axes of the world that its normal leans on least. Cell (i, j) of shape, axis
and side holds one point. A hash of these gives its place in the cell and its complex Gaussian weight of mean power 1, so
the point is the same from everywhere, in every ping, for any rays.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.speckle import BLENDED, patch_amplitudes
from mitsonar.plugins.native_plugins import load_dict
from mitsonar.plugins.surfaces import Hit, Surfaces
from mitsonar.simulation.device import DeviceArray, padded

__all__ = [
    "MOST_CANDIDATES",
    "HashedPoints",
    "Patches",
    "Point",
    "SurfacePoints",
    "lattice_key",
    "lattice_points",
    "lattice_size",
    "nearest_axis",
    "patch_weight",
    "pick",
    "place_in_cell",
    "weight_of",
]


LEAST_COSINE = 4e-3
"""Grazing cosine below which a ray's cell is no longer stretched along the surface."""

MOST_CANDIDATES = 4096
"""Lattice cells that one ray may look through."""

LARGEST_COUNT = 2.0**30
"""Largest number of lattice cells that is told."""


@dataclass
class Point:
    """A point of the lattice: coordinates ``p``, ``q``, ``a`` in the order of :func:`pick`, weight and turn of phase.

    Attributes:
        p, q, a: position [m].
        amplitude: of the weight.
        turn: phase of the weight, in turns 0..1.
    """

    p: DeviceArray
    q: DeviceArray
    a: DeviceArray
    amplitude: DeviceArray
    turn: DeviceArray


def pick(axis: DeviceArray, v: DeviceArray) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Return the components of a vector along the lattice's two axes, and along the third, ``axis``."""
    along_x, along_z = axis == 0, axis == 2
    p = dr.select(along_z, v.x, dr.select(along_x, v.y, v.z))
    q = dr.select(along_z, v.y, dr.select(along_x, v.z, v.x))
    a = dr.select(along_z, v.z, dr.select(along_x, v.x, v.y))
    return p, q, a


class HashedPoints:
    """The lattice cells around the points where rays hit surfaces.

    Args:
        hit: where the rays end.
        place: these points [m].
        over_column, over_row: change of the point by one step to the next ray, on the tangent plane [m].
        pitch: of the lattice [m].
        patch: side of a patch of one mean strength, which goes evenly over into its neighbours' [m].
        seed: of the hash.

    Attributes:
        axis: the axis of the world nearest to each normal, 0 to 2.
        count: lattice cells that may hold a point of the ray.
        wanted: lattice cells around each ray's cell, 2^30 at most.
        cut: rays with more than :data:`MOST_CANDIDATES` of them.
        strength: root of reflectivity times the area of a lattice cell [m].
    """

    def __init__(
        self,
        hit: Hit,
        place: DeviceArray,
        over_column: DeviceArray,
        over_row: DeviceArray,
        *,
        pitch: float,
        patch: float,
        seed: int,
    ) -> None:
        self.pitch, self.patch = pitch, patch
        self.axis = nearest_axis(hit.n)
        self.normal = pick(self.axis, hit.n)
        self.middle = pick(self.axis, place)
        across, down = pick(self.axis, over_column), pick(self.axis, over_row)
        low, high = [], []
        for k in range(2):  # half a step each way, and a little for rounding
            half = (dr.abs(across[k]) + dr.abs(down[k])) * 0.55
            low.append(mi.Int32(dr.floor((self.middle[k] - half) * (1 / pitch))))
            high.append(mi.Int32(dr.floor((self.middle[k] + half) * (1 / pitch))))
        self.low = low
        self.wide = high[0] - low[0] + 1
        wanted = mi.Float(self.wide) * mi.Float(high[1] - low[1] + 1)
        self.wanted: DeviceArray = dr.select(wanted < LARGEST_COUNT, wanted, LARGEST_COUNT)
        self.cut = hit.valid & (wanted > MOST_CANDIDATES)
        self.count = dr.select(hit.valid, mi.Int32(dr.select(self.cut, MOST_CANDIDATES, wanted)), 0)
        side = dr.select(self.normal[2] > 0, mi.UInt32(1), mi.UInt32(0))
        self.key = lattice_key(mi.UInt32(hit.shape_id), self.axis, side, seed)
        self.strength = dr.sqrt(hit.reflectivity * (pitch * pitch) / dr.abs(self.normal[2]))

    def point(self, number: DeviceArray, patches: mi.Float, many: int) -> Point:
        """Return the point in one of each ray's cells.

        Args:
            number: of the cell, 0 to ``count`` - 1.
            patches: amplitudes of patches by equal probabilities, of :func:`mitsonar.acoustics.speckle.patch_amplitudes`.
            many: entries of that table.
        """
        i, j = self.low[0] + number % self.wide, self.low[1] + number // self.wide
        p, q, bits = place_in_cell(i, j, self.key, self.pitch)
        slope = 1 / self.normal[2]
        a = self.middle[2] - slope * (self.normal[0] * (p - self.middle[0]) + self.normal[1] * (q - self.middle[1]))
        amplitude, turn, bits = weight_of(bits)
        if many > 1:
            amplitude = amplitude * patch_weight((p, q), bits, self.key, patches, many, self.patch)
        return Point(p, q, a, amplitude, turn)


def nearest_axis(normal: DeviceArray) -> DeviceArray:
    """Return the axis of the world that normals lean on most, 0 to 2."""
    leans: DeviceArray = dr.abs(normal)
    others = dr.select(leans.x >= leans.y, mi.UInt32(0), mi.UInt32(1))
    return dr.select((leans.z >= leans.x) & (leans.z >= leans.y), mi.UInt32(2), others)


def lattice_key(shape: DeviceArray, axis: DeviceArray, side: DeviceArray, seed: int) -> DeviceArray:
    """Return 32 bits that choose the hash of a lattice.

    Args:
        shape: index of the shape in the scene.
        axis: of the world that its normal leans on most, 0 to 2.
        side: 1 where the normal points along that axis, 0 where against it.
        seed: of the hash.
    """
    return _mixed(shape * 8 + axis * 2 + side + mi.UInt32(seed * 7919 & 0xFFFFFFFF))


def place_in_cell(
    i: DeviceArray, j: DeviceArray, key: DeviceArray, pitch: float
) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Return where the point of a lattice's cell lies along both axes [m], and 32 bits for :func:`weight_of`.

    Args:
        i: of the cell along the first axis.
        j: along the second.
        key: of :func:`lattice_key`.
        pitch: of the lattice [m].
    """
    place = _hash(i, j, key)
    p = (mi.Float(i) + (mi.Float(place & 0xFFFF) + 0.5) * 2.0**-16) * pitch
    q = (mi.Float(j) + (mi.Float(place >> 16) + 0.5) * 2.0**-16) * pitch
    return p, q, place


def weight_of(place: DeviceArray) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Return amplitude and phase (turns 0..1) of a point's complex Gaussian weight, and bits for what else is drawn."""
    bits = _mixed(place ^ mi.UInt32(0x68BC21EB))
    return dr.sqrt(-dr.log(_unit(bits))), _unit(_mixed(bits + mi.UInt32(0x2545F491))), bits


def patch_weight(
    place: tuple[DeviceArray, DeviceArray], bits: DeviceArray, key: DeviceArray, patches: mi.Float, many: int, side: float
) -> DeviceArray:
    """Return the amplitude of a point's patch: of the four whose middles are nearest, each by its bilinear weight.

    The points of a resolution cell are so many that their mean power goes evenly from patch to patch: no edge shows.

    Args:
        place: of the point along both axes [m].
        bits: of :func:`weight_of`.
        key: of :func:`lattice_key`.
        patches: amplitudes of patches by equal probabilities, of :func:`mitsonar.acoustics.speckle.patch_amplitudes`.
        many: entries of that table, a power of 2.
        side: of a patch [m].
    """
    drawn = _mixed(bits ^ mi.UInt32(0x1B56C4E9))
    moved = (mi.Float(drawn & 0xFFFF) * 2.0**-16 - 0.5, mi.Float(drawn >> 16) * 2.0**-16 - 0.5)
    i, j = (mi.Int32(dr.floor(v * (1 / side) + by)) for v, by in zip(place, moved, strict=True))
    return dr.gather(mi.Float, patches, _hash(i, j, key + 17) >> (32 - int(math.log2(many))))


def _hash(i: DeviceArray, j: DeviceArray, key: DeviceArray) -> DeviceArray:
    """Return 32 bits of a cell."""
    one: DeviceArray = dr.reinterpret_array(mi.UInt32, i)
    other: DeviceArray = dr.reinterpret_array(mi.UInt32, j)
    return _mixed(one * mi.UInt32(0x9E3779B1) ^ _mixed(other ^ key))


def _mixed(x: DeviceArray) -> DeviceArray:
    """Mix 32 bits by Chris Wellons's integer hash `lowbias32`."""
    x = x ^ (x >> 16)
    x = x * mi.UInt32(0x7FEB352D)
    x = x ^ (x >> 15)
    x = x * mi.UInt32(0x846CA68B)
    return x ^ (x >> 16)


def _unit(bits: DeviceArray) -> DeviceArray:
    """Return a number in 0..1, neither 0 nor 1."""
    return (mi.Float(bits >> 8) + 0.5) * 2.0**-24


# ---------------- All points that the hashed lattice puts on one shape: those that images of the model ``coherent``
# find by their rays
# Rays along each axis of the world pass through the places that the hash draws. They end on the surfaces that lean on that
# axis most. Any shape that can be traced has its points so, exactly on its surface.


AT_A_TIME = 2**22
"""Rays of a launch."""

BEYOND = 1e-5
"""Part of a ray's length by which the next one begins behind a surface that was hit."""


ROUNDING = 5e-6
"""The same as a part of the coordinate, forty times its rounding: or a ray would meet a far, small shape without end."""


class SurfacePoints(NamedTuple):
    """Points of a shape.

    Attributes:
        place: ``(points, 3)`` float32 [m].
        normal: unit normal of the surface ``(points, 3)`` float32.
        strength: reflectivity times the area that a point represents, times the power of its weight ``(points,)`` [m2].
        phase: of its weight ``(points,)``, -pi..pi [rad].
    """

    place: NDArray[np.float32]
    normal: NDArray[np.float32]
    strength: NDArray[np.float32]
    phase: NDArray[np.float32]


class Patches(NamedTuple):
    """Patches whose mean power varies by a Gamma law: its shape, and their side [m]."""

    nu: float
    side_m: float


class _Cells(NamedTuple):
    """The lattice cells under a shape, seen along one axis: of the first, how many each way, and the shape's ends [m]."""

    axis: int
    low: tuple[int, int]
    wide: int
    tall: int
    ends: tuple[float, float]


def lattice_size(shape: mi.Shape, pitch: float) -> float:
    """Return how many cells a lattice has to be searched for a shape's points, both sides of all axes."""
    return sum(2.0 * cells.wide * cells.tall for cells in _cells_of(shape, pitch))


def lattice_points(shape: mi.Shape, number: int, pitch: float, seed: int, patches: Patches | None = None) -> SurfacePoints:
    """Find the points of one shape.

    Args:
        shape: any that can be traced.
        number: of the shape in its scene.
        pitch: of the lattice [m].
        seed: of the hash.
        patches: of unequal strength; default: none.
    """
    search = _Search(shape, pitch, patches)
    found = []
    for cells in _cells_of(shape, pitch):
        for side in (1, 0):
            key = lattice_key(mi.UInt32(number), mi.UInt32(cells.axis), mi.UInt32(side), seed)
            count = cells.wide * cells.tall
            for begin in range(0, count, AT_A_TIME):
                found += search.on_rays(cells, side, key, np.arange(begin, min(begin + AT_A_TIME, count), dtype=np.uint32))
    return SurfacePoints(*(np.concatenate(values) for values in zip(*found, strict=True)))


def _cells_of(shape: mi.Shape, pitch: float) -> Iterator[_Cells]:
    low, high = _reach(shape)
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        first = [math.floor(low[k] / pitch) for k in (one, other)]
        count = [math.floor(high[k] / pitch) - begin + 1 for k, begin in zip((one, other), first, strict=True)]
        margin = pitch + 1e-4 * (high[axis] - low[axis])
        yield _Cells(axis, (first[0], first[1]), count[0], count[1], (low[axis] - margin, high[axis] + margin))


def _reach(shape: mi.Shape) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the least and the largest coordinates of a shape [m]."""
    if isinstance(shape, mi.Mesh):  # the box of meshes that Mitsuba has merged is that of one of them
        vertex = np.array(shape.vertex_positions_buffer(), dtype=float).reshape(-1, 3)
        return vertex.min(axis=0), vertex.max(axis=0)
    box = shape.bbox()
    return np.array(box.min, dtype=float).ravel(), np.array(box.max, dtype=float).ravel()


class _Search:
    """Follows rays through one shape."""

    def __init__(self, shape: mi.Shape, pitch: float, patches: Patches | None) -> None:
        name = shape.id()
        self.scene: mi.Scene = load_dict({"type": "scene", "shape": shape})
        shape.set_id(name)  # Mitsuba renames it
        self.surfaces = Surfaces.of(self.scene)
        self.pitch, self.patches = pitch, patches
        self.table = None if patches is None else mi.Float(patch_amplitudes(BLENDED * patches.nu))

    def on_rays(self, cells: _Cells, side: int, key: DeviceArray, numbers: NDArray[np.uint32]) -> list[SurfacePoints]:
        """Return the points on the rays through some cells: those of first hits, of second ones, and so on."""
        cell = mi.UInt32(padded(numbers))
        i = mi.Int32(cell % cells.wide) + cells.low[0]
        j = mi.Int32(cell // cells.wide) + cells.low[1]
        p, q, bits = place_in_cell(i, j, key, self.pitch)
        amplitude, turn, bits = weight_of(bits)
        if self.patches is not None and self.table is not None:
            amplitude *= patch_weight((p, q), bits, key, self.table, dr.width(self.table), self.patches.side_m)
        begin, way = (cells.ends[1], -1.0) if side else (cells.ends[0], 1.0)  # from where the surface faces
        reach = max(BEYOND * (cells.ends[1] - cells.ends[0]), ROUNDING * max(abs(end) for end in cells.ends))
        a, skip = dr.full(mi.Float, begin, len(numbers)), way * reach
        u = _along(cells.axis, mi.Float(0), mi.Float(0), mi.Float(way))
        made: list[SurfacePoints] = []
        while True:
            hit = self.surfaces.hit(self.scene, mi.Ray3f(mi.Point3f(_along(cells.axis, p, q, a)), u))
            at = a + way * hit.t
            made.append(self._kept(cells.axis, side, hit, (p, q, at), (amplitude, turn)))
            going = np.flatnonzero(np.array(hit.valid))
            if not len(going):
                return made
            kept = mi.UInt32(padded(going.astype(np.uint32)))
            p, q, amplitude, turn, at = (dr.gather(mi.Float, value, kept) for value in (p, q, amplitude, turn, at))
            a = at + skip
            dr.eval(p, q, amplitude, turn, a)

    def _kept(
        self, axis: int, side: int, hit: Hit, place: tuple[DeviceArray, ...], weight: tuple[DeviceArray, ...]
    ) -> SurfacePoints:
        """Return the hits where the surface leans on the axis most, to the side given, and scatters."""
        along = pick(mi.UInt32(axis), hit.n)[2]
        own = hit.valid & (nearest_axis(hit.n) == axis) & ((along > 0) == bool(side)) & (hit.reflectivity > 0)
        strength = hit.reflectivity * (self.pitch * self.pitch) / dr.abs(along) * weight[0] * weight[0]
        at = _along(axis, *place)
        dr.eval(own, at, hit.n, strength, weight[1])
        keep = np.flatnonzero(np.array(own))
        points, normals = (np.ascontiguousarray(np.array(values).T[keep], np.float32) for values in (at, hit.n))
        turn = np.array(weight[1])[keep]
        phase = np.asarray((turn - np.rint(turn)) * (2 * np.pi), np.float32)
        return SurfacePoints(points, normals, np.array(strength)[keep], phase)


def _along(axis: int, p: DeviceArray, q: DeviceArray, a: DeviceArray) -> mi.Vector3f:
    """Return the vector whose components :func:`~mitsonar.simulation.points.pick` returns."""
    return (mi.Vector3f(a, p, q), mi.Vector3f(q, a, p), mi.Vector3f(p, q, a))[axis]
