"""Shapes whose parts are narrower than a few rays, such as rods, ropes, chains and rubble: all of their lattice points.

Rays find only the points in their own cells, and may pass by a narrow part. The points of such shapes are listed once, and
in each ping one ray to each point decides whether it is seen. They are the points that rays would find.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.speckle import BLENDED_VARIANCE, patch_amplitudes
from mitsonar.plugins.surfaces import grain_key
from mitsonar.simulation.beams import CommonFan
from mitsonar.simulation.device import DeviceArray, padded
from mitsonar.simulation.points import (
    Patches,
    lattice_key,
    lattice_points,
    nearest_axis,
    patch_weight,
    place_in_cell,
    weight_of,
)
from mitsonar.simulation.shape_pieces import COLUMNS, FLAT, MOST_FACETS, pieces_of, sphere_and_width, triangles_of

__all__ = ["ThinShapes"]

Array = NDArray[np.float64]

MOST_POINTS = 200_000
"""Largest number of points of all thin shapes; those with the most points are left to the rays."""

MOST_CANDIDATES = 4_000_000
"""Largest number of lattice cells to search for a shape's points, some seconds: slanted triangles cover many cells."""

CANDIDATES_AT_A_TIME = 2**19
"""Number of lattice cells that are searched at a time."""


@dataclass(frozen=True)
class ThinShapes:
    """Points of the thin shapes of a scene.

    Attributes:
        thin: whether each shape of the scene is thin ``(shapes,)``.
        place, normal: positions [m] and unit normals ``(points, 3)``.
        strength: amplitude of the weight times the root of the area that a point represents ``(points,)`` [m].
        turn: phase of the weight in turns ``(points,)``.
        reflectivity: that of round shapes, all but meshes and flat ones, which rays may miss by rounding; 0 of others
            ``(points,)``.
        shape: number of the shape of each point ``(points,)``.
    """

    thin: NDArray[np.bool_]
    place: Array
    normal: Array
    strength: Array
    turn: Array
    reflectivity: Array
    shape: NDArray[np.int64]

    @classmethod
    def from_scene(
        cls, scene: mi.Scene, fan: CommonFan, reach_m: float, pitch: float, seed: int, patches: Patches | None
    ) -> ThinShapes | None:
        """Find the thin shapes of a scene and their points; None if there are none.

        Args:
            scene: the scene.
            fan: rays of the sonar.
            reach_m: range at which parts count as narrow [m].
            pitch: pitch of the lattice [m].
            seed: seed of its hash.
            patches: patches of unequal strength; None: none.
        """
        # 1. Thin shapes, those with few points first.
        step = max(2 * fan.sine / fan.columns, 2 * fan.tangent / fan.rows)
        areas = {}
        for number, shape in enumerate(scene.shapes()):
            if shape.class_name() == "Instance" or (isinstance(shape, mi.Mesh) and shape.face_count() > MOST_FACETS):
                continue
            corners = triangles_of(shape)
            area = float(
                np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
            )
            if area < MOST_POINTS * pitch**2 and _narrowest(corners) < COLUMNS * step * reach_m:
                areas[number] = area
        # 2. Their points, as far as there is room.
        parts, thin, room = [], np.zeros(len(scene.shapes()), dtype=bool), MOST_POINTS
        for number in sorted(areas, key=areas.__getitem__):
            shape = scene.shapes()[number]
            points = _points(shape, grain_key(shape.id(), number), pitch, seed, patches)
            if points is None or not 0 < len(points[0]) <= room:
                continue
            count = len(points[0])
            room, thin[number] = room - count, True
            parts.append((*points, np.full(count, number)))
        return cls(thin, *(np.concatenate(values) for values in zip(*parts, strict=True))) if thin.any() else None

    def inputs(self) -> dict[str, DeviceArray]:
        """Return the arrays of points as inputs of a launch."""
        vectors = {
            name: [padded(column) for column in getattr(self, name).T.astype(np.float32)] for name in ("place", "normal")
        }
        return {
            **{name: mi.Vector3f(*(mi.Float(column) for column in columns)) for name, columns in vectors.items()},
            **{
                name: mi.Float(padded(getattr(self, name).astype(np.float32)))
                for name in ("strength", "turn", "reflectivity")
            },
            "shape": mi.Int32(padded(self.shape.astype(np.int32))),
        }


def _narrowest(corners: Array) -> float:
    """Return the least width of the connected parts of triangles ``(n, 3, 3)`` [m]."""
    return min((sphere_and_width(part)[2] for part in pieces_of(corners)), default=np.inf)


def _points(
    shape: mi.Shape, grain: int, pitch: float, seed: int, patches: Patches | None
) -> tuple[Array, Array, Array, Array, Array] | None:
    """Return the attributes of all lattice points of a shape, place to reflectivity; None if they take too long to find."""
    if not isinstance(shape, mi.Mesh):
        alone = lattice_points(shape, grain, pitch, seed, patches, weighed=False)
        place, normal, power, phase = (values.astype(float) for values in alone)
        reflectivity = np.zeros_like(power)
        if shape.class_name() not in FLAT:
            reflectivity = lattice_points(shape, grain, pitch, seed, patches).strength.astype(float) / power
        # normals of round shapes point outwards, whatever the scene says
        box = shape.bbox()
        outward = ((place - np.array(box.center(), dtype=float).ravel()) * normal).sum(axis=1)
        normal *= np.where(outward < 0, -1, 1)[:, None]
        return place, normal, np.sqrt(power), phase / (2 * np.pi), reflectivity
    corners = triangles_of(shape)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    whole = np.linalg.norm(normal, axis=1)
    corners, normal = corners[whole > 0], normal[whole > 0] / whole[whole > 0, None]
    if not len(normal):
        return None
    axis = np.array(nearest_axis(mi.Vector3f(*(mi.Float(padded(column.astype(np.float32))) for column in normal.T))))
    parts = []
    for view in range(3):
        for side in (1, 0):
            chosen = (axis == view) & ((normal[:, view] > 0) == bool(side))
            key = lattice_key(mi.UInt32(grain), mi.UInt32(view), mi.UInt32(side), seed)
            points = _on_triangles(corners[chosen], normal[chosen], view, key, pitch, patches)
            if points is None:
                return None
            parts.append(points)
    place, normals, strength, turn = _joined(parts)
    return place, normals, strength, turn, np.zeros_like(turn)


def _joined(parts: list[tuple[Array, Array, Array, Array]]) -> tuple[Array, Array, Array, Array]:
    place, normals, strength, turn = (np.concatenate(values) for values in zip(*parts, strict=True))
    return place, normals, strength, turn


def _on_triangles(
    corners: Array, normal: Array, view: int, key: mi.UInt32, pitch: float, patches: Patches | None
) -> tuple[Array, Array, Array, Array] | None:
    """Return places, normals, strengths and turns of the lattice points on triangles that are seen along one axis."""
    # 1. Lattice cells that the triangles may cover, some triangles at a time.
    order = [(view + 1) % 3, (view + 2) % 3, view]
    flat = corners[:, :, order]
    low, high = (np.floor(end / pitch).astype(np.int64) for end in (flat[:, :, :2].min(axis=1), flat[:, :, :2].max(axis=1)))
    wide, tall = (high - low + 1).T if len(low) else np.zeros((2, 0), dtype=np.int64)
    count = wide * tall
    if count.sum() > MOST_CANDIDATES:
        return None
    if len(count) > 1 and count.sum() > CANDIDATES_AT_A_TIME:
        middle = len(count) // 2
        halves = [
            _on_triangles(corners[part], normal[part], view, key, pitch, patches)
            for part in (slice(middle), slice(middle, None))
        ]
        return _joined([half for half in halves if half is not None])
    triangle = np.repeat(np.arange(len(count)), count)
    if not len(triangle):
        return np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0)
    number = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    i = mi.Int32(padded((low[triangle, 0] + number % wide[triangle]).astype(np.int32)))
    j = mi.Int32(padded((low[triangle, 1] + number // wide[triangle]).astype(np.int32)))
    # 2. Position and weight of their points.
    p, q, bits = place_in_cell(i, j, key, pitch)
    amplitude, turn, bits = weight_of(bits)
    if patches is not None:
        table = mi.Float(patch_amplitudes(BLENDED_VARIANCE * patches.nu))
        amplitude *= patch_weight((p, q), bits, key, table, len(table), patches.side_m)
    at = np.stack([np.array(p), np.array(q)], axis=1).astype(float)
    # 3. Those inside the triangles, by barycentric coordinates.
    first, second, third = (flat[triangle, corner] for corner in range(3))
    u, v, w = (end[:, :2] - first[:, :2] for end in (second, third, at))
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        by_second = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / area
        by_third = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / area
    inside = np.flatnonzero((by_second >= 0) & (by_third >= 0) & (by_second + by_third < 1))
    away = first[:, 2] + by_second * (second[:, 2] - first[:, 2]) + by_third * (third[:, 2] - first[:, 2])
    place = np.empty((len(inside), 3))
    place[:, order] = np.column_stack([at, away])[inside]
    strength = np.array(amplitude)[inside] * pitch / np.sqrt(np.abs(normal[triangle[inside], view]))
    return place, normal[triangle[inside]], strength, np.array(turn)[inside].astype(float)
