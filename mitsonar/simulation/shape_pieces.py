"""Triangles of a shape, the connected pieces that they form, and how wide a piece is."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

__all__ = ["COLUMNS", "FLAT", "MOST_FACETS", "pieces_of", "sphere_and_width", "triangles_of"]

FLAT = ("Rectangle", "Disk")
"""Flat shapes of Mitsuba."""

COLUMNS = 4.0
"""Width below which a piece is narrow, in columns or rows of a fan of rays."""

MOST_FACETS = 200_000
"""Number of triangles above which a shape is not divided into pieces, which takes seconds."""

BOX_FACES = [[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
             [1, 3, 7], [1, 7, 5]]  # fmt: skip
"""Triangles of a box, whose corner number holds the end along axis k in bit k."""


def triangles_of(shape: mi.Shape) -> NDArray[np.float64]:
    """Return the triangles of a mesh, of the square of a rectangle or disk, or of the box around another shape [m]."""
    if isinstance(shape, mi.Mesh):
        vertices = np.array(shape.vertex_positions_buffer(), dtype=float).reshape(-1, 3)
        return np.asarray(vertices[np.array(shape.faces_buffer(), dtype=np.int64).reshape(-1, 3)])
    if shape.class_name() in FLAT:
        matrix = np.array(mi.traverse(shape)["to_world"].matrix, dtype=float).reshape(4, 4, -1)[..., 0]
        square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) @ matrix[:3, :3].T + matrix[:3, 3]
        return np.asarray(square[[[0, 1, 2], [0, 2, 3]]])
    box = shape.bbox()
    ends = np.array([np.array(end, dtype=float).ravel() for end in (box.min, box.max)])
    corners = np.array([[ends[(corner >> axis) & 1, axis] for axis in range(3)] for corner in range(8)])
    return np.asarray(corners[BOX_FACES], dtype=np.float64)


def pieces_of(corners: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Divide triangles ``(n, 3, 3)`` into those that are connected by vertices."""
    if not 0 < len(corners) <= MOST_FACETS:
        return [corners] if len(corners) else []
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    first, second, third = index.reshape(-1, 3).T
    edges = np.concatenate([first, second]), np.concatenate([second, third])
    label = connected_components(coo_array((np.ones(len(edges[0])), edges), (len(vertices),) * 2), directed=False)[1][first]
    order = np.argsort(label, kind="stable")
    return np.split(corners[order], np.flatnonzero(np.diff(label[order])) + 1)


def sphere_and_width(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float]:
    """Return centre and radius of a sphere around triangles, and their second extent along their principal axes [m].

    Extents are those of a body with the same variances, evenly distributed along each axis.
    """
    points = corners.reshape(-1, 3)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weight = area / max(float(area.sum()), 1e-30)
    away = corners - weight @ corners.mean(axis=1)
    moments = np.einsum("tci,tcj->tij", away, away) + np.einsum("tci,tdj->tij", away, away)
    variance = np.linalg.eigvalsh(np.einsum("t,tij->ij", weight / 12, moments))
    return centre, float(np.linalg.norm(points - centre, axis=1).max()), float(np.sqrt(12 * max(variance[1], 0.0)))
