"""Scatterers that no memory holds: points on a lattice of the world, placed and weighted by a hash of their cell.

A surface is divided by a lattice over the two axes of the world that its normal leans on least. Cell (i, j) of shape, axis
and side holds one point. A hash of these gives its place in the cell and its complex Gaussian weight of mean power 1, so
the point is the same from everywhere, in every ping, for any rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsonar.plugins.surfaces import Hit
from mitsonar.simulation.device_arrays import DeviceArray

__all__ = [
    "MOST_CANDIDATES",
    "HashedPoints",
    "Point",
    "lattice_key",
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
