"""Where the scatterers of a surface lie: points on a world lattice, placed and weighted by a hash instead of stored.

A surface is divided by a lattice over two world axes, all but the one nearest to its normal. Each cell (i, j) of a shape,
axis and side holds one point. A hash of these gives its position in the cell and its complex Gaussian weight of mean power
1. The point is therefore the same from every viewpoint, in every ping and for any set of rays.
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

from mitsonar.acoustics.speckle import BLENDED_VARIANCE, patch_amplitudes
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
    "seed_bits",
    "weight_of",
]


LEAST_COSINE = 4e-3
"""Grazing cosine below which a ray's cell on the surface is not stretched further."""

NEAR = 0.55
"""Distance from the middle of a ray's cell within which points are evaluated, in sides of the cell on the tangent plane."""

MOST_CANDIDATES = 4096
"""Largest number of lattice cells that one ray may visit."""

LARGEST_COUNT = 2.0**30
"""Largest number of lattice cells that is reported."""


@dataclass
class Point:
    """A point of the lattice.

    Attributes:
        p, q, a: position, in the order of :func:`pick` [m].
        amplitude: amplitude of the weight.
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
    """Lattice cells around the points where rays hit surfaces.

    Args:
        hit: hits of the rays, the keys of their grain in place of shapes.
        place: the points hit [m].
        over_column, over_row: displacement of the point for one step to the next ray, on the tangent plane [m].
        pitch: pitch of the lattice [m].
        patch: side of a patch of uniform mean strength, which blends smoothly into its neighbours [m].
        seed: seed of the hash.

    Attributes:
        axis: world axis nearest to each normal, 0 to 2.
        count: number of lattice cells to visit, which may hold a point of the ray.
        covered: number of lattice cells that each ray's cell covers, at most 2^30.
        cut: whether the ray covers more than :data:`MOST_CANDIDATES` of them.
        strength: square root of the reflectivity times the area of surface in a lattice cell [m].
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
        # 1. Express everything in lattice axes: two that span the lattice, and the one nearest to the normal.
        self.pitch, self.patch = pitch, patch
        self.axis = nearest_axis(hit.n)
        self.normal = pick(self.axis, hit.n)
        self.middle = pick(self.axis, place)
        across, down = pick(self.axis, over_column), pick(self.axis, over_row)
        self.steps = across, down
        # 2. Bound the ray's cell by a rectangle of lattice cells: half a step each way, plus a margin for rounding.
        low, high = [], []
        for k in range(2):
            half = (dr.abs(across[k]) + dr.abs(down[k])) * 0.55
            low.append(mi.Int32(dr.floor((self.middle[k] - half) * (1 / pitch))))
            high.append(mi.Int32(dr.floor((self.middle[k] + half) * (1 / pitch))))
        self.low = low
        # 3. Count them in floating point, since integers would overflow at grazing incidence.
        self.wide = high[0] - low[0] + 1
        covered = mi.Float(self.wide) * mi.Float(high[1] - low[1] + 1)
        self.covered: DeviceArray = dr.select(covered < LARGEST_COUNT, covered, LARGEST_COUNT)
        self.cut = hit.valid & (covered > MOST_CANDIDATES)
        self.count = dr.select(hit.valid, mi.Int32(dr.select(self.cut, MOST_CANDIDATES, covered)), 0)
        # 4. Choose the hash of this lattice, and project the area of a lattice cell onto the surface.
        side = dr.select(self.normal[2] > 0, mi.UInt32(1), mi.UInt32(0))
        self.key = lattice_key(mi.UInt32(hit.shape_id), self.axis, side, seed)
        self.strength = dr.sqrt(hit.reflectivity * (pitch * pitch) / dr.abs(self.normal[2]))

    def near(self, number: DeviceArray) -> DeviceArray:
        """Test whether the point in one of each ray's lattice cells lies in or near the ray's cell of the tangent plane."""
        i, j = self.low[0] + number % self.wide, self.low[1] + number // self.wide
        p, q, _ = place_in_cell(i, j, self.key, self.pitch)
        across, down = self.steps
        p, q, area = p - self.middle[0], q - self.middle[1], dr.abs(across[0] * down[1] - across[1] * down[0])
        columns, rows = dr.abs(p * down[1] - q * down[0]), dr.abs(q * across[0] - p * across[1])
        return (columns <= NEAR * area) & (rows <= NEAR * area)

    def point(self, number: DeviceArray, patches: mi.Float, entries: int) -> Point:
        """Return the point in one of each ray's lattice cells.

        Args:
            number: index of the cell, 0 to ``count`` - 1.
            patches: equiprobable patch amplitudes from :func:`mitsonar.acoustics.speckle.patch_amplitudes`.
            entries: number of entries of that table.
        """
        i, j = self.low[0] + number % self.wide, self.low[1] + number // self.wide
        p, q, bits = place_in_cell(i, j, self.key, self.pitch)
        slope = 1 / self.normal[2]
        a = self.middle[2] - slope * (self.normal[0] * (p - self.middle[0]) + self.normal[1] * (q - self.middle[1]))
        amplitude, turn, bits = weight_of(bits)
        if entries > 1:
            amplitude = amplitude * patch_weight((p, q), bits, self.key, patches, entries, self.patch)
        return Point(p, q, a, amplitude, turn)


def nearest_axis(normal: DeviceArray) -> DeviceArray:
    """Return the world axis nearest to each normal, 0 to 2."""
    leans: DeviceArray = dr.abs(normal)
    others = dr.select(leans.x >= leans.y, mi.UInt32(0), mi.UInt32(1))
    return dr.select((leans.z >= leans.x) & (leans.z >= leans.y), mi.UInt32(2), others)


def lattice_key(grain: DeviceArray, axis: DeviceArray, side: DeviceArray, seed: int) -> DeviceArray:
    """Return a 32-bit key that selects the hash of a lattice.

    Args:
        grain: key of the shape's scatterers, from :func:`mitsonar.plugins.surfaces.grain_key`.
        axis: world axis nearest to its normal, 0 to 2.
        side: 1 where the normal points along that axis, 0 where it points against it.
        seed: seed of the hash.
    """
    return _mixed(grain * 8 + axis * 2 + side + mi.UInt32(seed_bits(seed)))


def seed_bits(seed: int) -> int:
    """Return 32 bits that depend on all bits of a seed."""
    return (seed * 7919 + (seed >> 32) * 0x9E3779B1) & 0xFFFFFFFF


def place_in_cell(
    i: DeviceArray, j: DeviceArray, key: DeviceArray, pitch: float
) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Return the position of a lattice cell's point along both axes [m], and 32 bits for :func:`weight_of`.

    Args:
        i: index of the cell along the first axis.
        j: index of the cell along the second axis.
        key: key from :func:`lattice_key`.
        pitch: pitch of the lattice [m].
    """
    cell_bits = _hash(i, j, key)
    p = (mi.Float(i) + (mi.Float(cell_bits & 0xFFFF) + 0.5) * 2.0**-16) * pitch
    q = (mi.Float(j) + (mi.Float(cell_bits >> 16) + 0.5) * 2.0**-16) * pitch
    return p, q, cell_bits


def weight_of(cell_bits: DeviceArray) -> tuple[DeviceArray, DeviceArray, DeviceArray]:
    """Return amplitude and phase (turns 0..1) of a point's complex Gaussian weight, and 32 bits for further draws."""
    bits = _mixed(cell_bits ^ mi.UInt32(0x68BC21EB))
    return dr.sqrt(-dr.log(_unit(bits))), _unit(_mixed(bits + mi.UInt32(0x2545F491))), bits


def patch_weight(
    place: tuple[DeviceArray, DeviceArray], bits: DeviceArray, key: DeviceArray, patches: mi.Float, entries: int, side: float
) -> DeviceArray:
    """Return the amplitude of a point's patch, drawn from the four nearest patches with their bilinear weights.

    A resolution cell holds so many points that the mean power varies smoothly from patch to patch, without visible edges.

    Args:
        place: position of the point along both axes [m].
        bits: bits from :func:`weight_of`.
        key: key from :func:`lattice_key`.
        patches: equiprobable patch amplitudes from :func:`mitsonar.acoustics.speckle.patch_amplitudes`.
        entries: number of entries of that table, a power of 2.
        side: side of a patch [m].
    """
    # a shift by up to half a patch each way chooses a patch with exactly its bilinear weight
    drawn = _mixed(bits ^ mi.UInt32(0x1B56C4E9))
    moved = (mi.Float(drawn & 0xFFFF) * 2.0**-16 - 0.5, mi.Float(drawn >> 16) * 2.0**-16 - 0.5)
    i, j = (mi.Int32(dr.floor(v * (1 / side) + by)) for v, by in zip(place, moved, strict=True))
    return dr.gather(mi.Float, patches, _hash(i, j, key + 17) >> (32 - int(math.log2(entries))))


def _hash(i: DeviceArray, j: DeviceArray, key: DeviceArray) -> DeviceArray:
    """Hash a cell to 32 bits."""
    i_bits: DeviceArray = dr.reinterpret_array(mi.UInt32, i)
    j_bits: DeviceArray = dr.reinterpret_array(mi.UInt32, j)
    return _mixed(i_bits * mi.UInt32(0x9E3779B1) ^ _mixed(j_bits ^ key))


def _mixed(x: DeviceArray) -> DeviceArray:
    """Mix 32 bits with Chris Wellons's integer hash `lowbias32`."""
    x = x ^ (x >> 16)
    x = x * mi.UInt32(0x7FEB352D)
    x = x ^ (x >> 15)
    x = x * mi.UInt32(0x846CA68B)
    return x ^ (x >> 16)


def _unit(bits: DeviceArray) -> DeviceArray:
    """Convert bits to a number between 0 and 1, both excluded."""
    return (mi.Float(bits >> 8) + 0.5) * 2.0**-24


# ---------------- All points of one shape


AT_A_TIME = 2**22
"""Number of rays of a launch."""

BEYOND = 1e-5
"""Fraction of a ray's length by which the next ray begins behind a surface that was hit."""


ROUNDING = 5e-6
"""The same as a fraction of the coordinate, 40 times its rounding; less, and a small, distant shape is hit endlessly."""


class SurfacePoints(NamedTuple):
    """Points of a shape.

    Attributes:
        place: positions ``(points, 3)`` float32 [m].
        normal: unit normal of the surface ``(points, 3)`` float32.
        strength: reflectivity times the area that a point represents, times the power of its weight ``(points,)`` [m2].
        phase: phase of its weight ``(points,)``, -pi..pi [rad].
    """

    place: NDArray[np.float32]
    normal: NDArray[np.float32]
    strength: NDArray[np.float32]
    phase: NDArray[np.float32]


class Patches(NamedTuple):
    """Patches whose mean power follows a Gamma distribution.

    Attributes:
        nu: shape parameter of the distribution.
        side_m: side of a patch [m].
    """

    nu: float
    side_m: float


class _Cells(NamedTuple):
    """Lattice cells that cover a shape, seen along one axis.

    Attributes:
        axis: world axis of the view, 0 to 2.
        low: indices of the first cell.
        wide, tall: numbers of cells along both lattice axes.
        ends: coordinates along ``axis`` just outside the shape [m].
    """

    axis: int
    low: tuple[int, int]
    wide: int
    tall: int
    ends: tuple[float, float]


def lattice_size(shape: mi.Shape, pitch: float, within: NDArray[np.float64] | None = None) -> float:
    """Return the number of lattice cells to search for a shape's points, over both sides of all axes."""
    return sum(2.0 * cells.wide * cells.tall for cells in _cells_of(shape, pitch, within))


def lattice_points(
    shape: mi.Shape,
    grain: int,
    pitch: float,
    seed: int,
    patches: Patches | None = None,
    *,
    weighed: bool = True,
    within: NDArray[np.float64] | None = None,
) -> SurfacePoints:
    """Find all points that the hashed lattice places on one shape, those that coherent images find with their rays.

    Rays along each world axis pass through the positions that the hash draws. Where they hit a surface whose normal is
    nearest to that axis, they give a point exactly on it.

    Args:
        shape: any shape that can be traced.
        grain: key of its scatterers, from :func:`mitsonar.plugins.surfaces.grain_key`.
        pitch: pitch of the lattice [m].
        seed: seed of the hash.
        patches: patches of unequal strength; default: none.
        weighed: whether strengths contain the reflectivity.
        within: two opposite corners of a box ``(2, 3)`` [m]; points outside may be left out, and those inside stay the same.
    """
    search = _Search(shape, pitch, patches, weighed)
    parts = []
    for cells in _cells_of(shape, pitch, within):
        for side in (1, 0):
            key = lattice_key(mi.UInt32(grain), mi.UInt32(cells.axis), mi.UInt32(side), seed)
            count = cells.wide * cells.tall
            for begin in range(0, count, AT_A_TIME):
                parts += search.on_rays(cells, side, key, np.arange(begin, min(begin + AT_A_TIME, count), dtype=np.uint32))
    if not parts:  # the box holds nothing of the shape
        none = np.zeros((0, 3), np.float32)
        return SurfacePoints(none, none, none[:, 0], none[:, 0])
    return SurfacePoints(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _cells_of(shape: mi.Shape, pitch: float, within: NDArray[np.float64] | None = None) -> Iterator[_Cells]:
    """Yield the lattice cells that cover a shape, or what lies of it within a box, along each world axis."""
    low, high = _reach(shape)
    ends = low, high
    if within is not None:
        low, high = np.maximum(low, within[0]), np.minimum(high, within[1])
        if (low > high).any():
            return
    for axis in range(3):
        p_axis, q_axis = (axis + 1) % 3, (axis + 2) % 3
        first = [math.floor(low[k] / pitch) for k in (p_axis, q_axis)]
        count = [math.floor(high[k] / pitch) - begin + 1 for k, begin in zip((p_axis, q_axis), first, strict=True)]
        margin = pitch + 1e-4 * (ends[1][axis] - ends[0][axis])
        yield _Cells(axis, (first[0], first[1]), count[0], count[1], (ends[0][axis] - margin, ends[1][axis] + margin))


def _reach(shape: mi.Shape) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the minimum and maximum coordinates of a shape [m]."""
    if isinstance(shape, mi.Mesh):  # the bounding box of meshes merged by Mitsuba is that of only one of them
        vertex = np.array(shape.vertex_positions_buffer(), dtype=float).reshape(-1, 3)
        return vertex.min(axis=0), vertex.max(axis=0)
    box = shape.bbox()
    return np.array(box.min, dtype=float).ravel(), np.array(box.max, dtype=float).ravel()


class _Search:
    """Search for the points of one shape, by rays that pass through all of its surfaces."""

    def __init__(self, shape: mi.Shape, pitch: float, patches: Patches | None, weighed: bool) -> None:
        name = shape.id()
        self.scene: mi.Scene = load_dict({"type": "scene", "shape": shape})
        shape.set_id(name)  # Mitsuba renames it
        self.surfaces = Surfaces.from_scene(self.scene)
        self.pitch, self.patches, self.weighed = pitch, patches, weighed
        self.table = None if patches is None else mi.Float(patch_amplitudes(BLENDED_VARIANCE * patches.nu))

    def on_rays(self, cells: _Cells, side: int, key: DeviceArray, numbers: NDArray[np.uint32]) -> list[SurfacePoints]:
        """Return the points on the rays through some cells: at their first hits, their second hits, and so on."""
        # 1. Position and weight of the point in each cell, as the hash draws them.
        cell = mi.UInt32(padded(numbers))
        i = mi.Int32(cell % cells.wide) + cells.low[0]
        j = mi.Int32(cell // cells.wide) + cells.low[1]
        p, q, bits = place_in_cell(i, j, key, self.pitch)
        amplitude, turn, bits = weight_of(bits)
        if self.patches is not None and self.table is not None:
            amplitude *= patch_weight((p, q), bits, key, self.table, dr.width(self.table), self.patches.side_m)
        # 2. Start each ray outside the shape, on the side that the surfaces face.
        begin, sign = (cells.ends[1], -1.0) if side else (cells.ends[0], 1.0)
        reach = max(BEYOND * (cells.ends[1] - cells.ends[0]), ROUNDING * max(abs(end) for end in cells.ends))
        a, skip = dr.full(mi.Float, begin, len(numbers)), sign * reach
        u = _along(cells.axis, mi.Float(0), mi.Float(0), mi.Float(sign))
        # 3. Trace, keep the points on suitable surfaces, and continue behind every hit until no ray hits anything.
        parts: list[SurfacePoints] = []
        while True:
            hit = self.surfaces.hit(self.scene, mi.Ray3f(mi.Point3f(_along(cells.axis, p, q, a)), u))
            a_hit = a + sign * hit.t
            parts.append(self._suitable_points(cells.axis, side, hit, (p, q, a_hit), (amplitude, turn)))
            going = np.flatnonzero(np.array(hit.valid))
            if not len(going):
                return parts
            remaining = mi.UInt32(padded(going.astype(np.uint32)))
            p, q, amplitude, turn, a_hit = (
                dr.gather(mi.Float, value, remaining) for value in (p, q, amplitude, turn, a_hit)
            )
            a = a_hit + skip
            dr.eval(p, q, amplitude, turn, a)

    def _suitable_points(
        self, axis: int, side: int, hit: Hit, place: tuple[DeviceArray, ...], weight: tuple[DeviceArray, ...]
    ) -> SurfacePoints:
        """Return the hits on scattering surfaces whose normal is nearest to the axis and points to the given side."""
        along = pick(mi.UInt32(axis), hit.n)[2]
        suitable = hit.valid & (nearest_axis(hit.n) == axis) & ((along > 0) == bool(side)) & (hit.reflectivity > 0)
        strength: DeviceArray = dr.square(weight[0] * self.pitch) / dr.abs(along)
        if self.weighed:
            strength *= hit.reflectivity
        positions = _along(axis, *place)
        dr.eval(suitable, positions, hit.n, strength, weight[1])
        keep = np.flatnonzero(np.array(suitable))
        points, normals = (np.ascontiguousarray(np.array(values).T[keep], np.float32) for values in (positions, hit.n))
        turn = np.array(weight[1])[keep]
        phase = np.asarray((turn - np.rint(turn)) * (2 * np.pi), np.float32)
        return SurfacePoints(points, normals, np.array(strength)[keep], phase)


def _along(axis: int, p: DeviceArray, q: DeviceArray, a: DeviceArray) -> mi.Vector3f:
    """Return the vector with the given lattice components, the inverse of :func:`pick`."""
    return (mi.Vector3f(a, p, q), mi.Vector3f(q, a, p), mi.Vector3f(p, q, a))[axis]
