"""Shapes of a scene as triangles, for those who draw it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = ["MOST_FACES", "Triangles", "triangles_in"]

MOST_FACES = 300_000
"""Faces of a mesh that is drawn; of a larger one, its box is."""

STEPS = 24
"""Corners of a circle."""

BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
BOX_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


class Triangles(NamedTuple):
    """One shape.

    Attributes:
        name: of the shape.
        vertices: ``(vertices, 3)`` [m] in the world.
        faces: three vertices each ``(faces, 3)``.
        whole: False where it is only the box around the shape.
    """

    name: str
    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    whole: bool


def triangles_in(scene: mi.Scene) -> list[Triangles]:
    """Return all shapes of a scene as triangles.

    Meshes are as they are, up to :data:`MOST_FACES`. Rectangles, disks, cylinders and spheres are approximated. Of all
    others, such as instances, the box around them is returned.
    """
    return [_triangles_of(shape) for shape in scene.shapes()]


def _triangles_of(shape: mi.Shape) -> Triangles:
    import mitsuba as mi

    name = shape.id()
    if isinstance(shape, mi.Mesh) and shape.face_count() <= MOST_FACES:
        corners = np.array(shape.vertex_positions_buffer(), dtype=np.float32).reshape(-1, 3)
        return Triangles(name, corners, np.array(shape.faces_buffer(), dtype=np.uint32).reshape(-1, 3), True)
    kind = shape.class_name() if not isinstance(shape, mi.Mesh) else "Mesh"
    if kind in UNIT:
        turned = np.array(mi.traverse(shape)["to_world"].matrix, dtype=float).reshape(4, 4, -1)[..., 0]
        vertices, faces = UNIT[kind]
        placed = vertices @ turned[:3, :3].T + turned[:3, 3]
        return Triangles(name, placed.astype(np.float32), faces.astype(np.uint32), True)
    box = shape.bbox()
    low, high = (np.array(end, dtype=float).reshape(3) for end in (box.min, box.max))
    return Triangles(name, (low + BOX * (high - low)).astype(np.float32), BOX_FACES.astype(np.uint32), False)


def _grid(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices and faces of a surface that is sampled at ``(rows, columns, 3)``."""
    rows, columns = points.shape[:2]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, below = corner + 1, corner + columns
    faces = np.concatenate([np.stack([corner, right, below], 1), np.stack([right, below + 1, below], 1)])
    return points.reshape(-1, 3), faces


def _round(radius: NDArray[np.float64], height: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a surface of revolution about z, from its radius by height."""
    turn = np.linspace(0, 2 * np.pi, STEPS + 1)
    circle = np.stack([np.cos(turn), np.sin(turn)], -1)
    across = radius[:, None, None] * circle[None]
    return _grid(np.concatenate([across, np.broadcast_to(height[:, None, None], (*across.shape[:2], 1))], -1))


SLOPE = np.linspace(-np.pi / 2, np.pi / 2, STEPS // 2 + 1)

UNIT = {
    "Rectangle": _grid(np.array([[[-1.0, -1, 0], [1, -1, 0]], [[-1, 1, 0], [1, 1, 0]]])),
    "Disk": _round(np.array([0.0, 1.0]), np.zeros(2)),
    "Cylinder": _round(np.ones(2), np.array([0.0, 1.0])),
    "Sphere": _round(np.cos(SLOPE), np.sin(SLOPE)),
}
"""Vertices and faces of Mitsuba's own shapes, in their own axes, by the name of their class."""
