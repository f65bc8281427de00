"""Write points and triangles as binary PLY."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["ply_bytes", "ply_header"]

TYPES = {"<f4": "float", "<f8": "double"}
"""Names of types in PLY."""

CORNERS = (("count", "u1"), ("corners", "<i4", 3))
"""Begin of the row of a triangle; its other columns are single-precision numbers."""


def ply_header(columns: np.dtype[np.void], vertices: int, faces: int | None = None, *face_columns: str) -> bytes:
    """Return the header of a file whose rows of vertices, and then of triangles, follow.

    Args:
        columns: columns of the vertices, little-endian float32 or float64.
        vertices: number of vertices.
        faces: number of triangles; None without any.
        face_columns: names of further columns of the triangles.
    """
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {vertices}"]
    lines += [f"property {TYPES[columns[name].str]} {name}" for name in columns.names or ()]
    if faces is not None:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
        lines += [f"property float {name}" for name in face_columns]
    return "\n".join([*lines, "end_header", ""]).encode()


def ply_bytes(
    vertices: Mapping[str, tuple[str, ArrayLike]], corners: NDArray[np.integer], faces: Mapping[str, ArrayLike] = {}
) -> bytes:
    """Return a mesh as a binary PLY file.

    Args:
        vertices: type (``<f4`` or ``<f8``) and values of each column ``(vertices,)``: x, y, z and others.
        corners: vertices of each triangle ``(triangles, 3)``.
        faces: values of each further column of the triangles ``(triangles,)``.
    """
    count = len(np.asarray(vertices["x"][1]))
    points = np.empty(count, [(name, kind) for name, (kind, _) in vertices.items()])
    for name, (_, values) in vertices.items():
        points[name] = values
    triangles = np.empty(len(corners), [*CORNERS, *((name, "<f4") for name in faces)])
    triangles["count"], triangles["corners"] = 3, corners
    for name, column in faces.items():
        triangles[name] = column
    return ply_header(points.dtype, count, len(corners), *faces) + points.tobytes() + triangles.tobytes()
