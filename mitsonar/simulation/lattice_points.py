"""All points that the hashed lattice puts on one shape: those that images of the model ``coherent`` find by their rays.

Rays along each axis of the world pass through the places that the hash draws. They end on the surfaces that lean on that
axis most. Any shape that can be traced has its points so, exactly on its surface.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.speckle import BLENDED, patch_amplitudes
from mitsonar.plugins.native_plugins import load_dict
from mitsonar.plugins.surfaces import Hit, Surfaces
from mitsonar.simulation.device_arrays import DeviceArray, padded
from mitsonar.simulation.hashed_points import lattice_key, nearest_axis, patch_weight, pick, place_in_cell, weight_of

__all__ = ["Patches", "SurfacePoints", "lattice_points", "lattice_size"]

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
    """Return the vector whose components :func:`~mitsonar.simulation.hashed_points.pick` returns."""
    return (mi.Vector3f(a, p, q), mi.Vector3f(q, a, p), mi.Vector3f(p, q, a))[axis]
