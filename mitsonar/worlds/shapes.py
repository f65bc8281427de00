"""Shapes of one unit in each direction, and many copies of a shape as a single mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    import trimesh

__all__ = ["Copies", "box", "capsule", "cylinder", "place", "slab"]

GRID_M = 1e-6
"""Grid of the vertices [m]: rounding to it removes the last bits of a library's sine from the file."""


@dataclass(frozen=True)
class Copies:
    """Copies of one shape.

    Attributes:
        vertices: ``(vertices, 3)`` [m].
        faces: ``(faces, 3)``.
        number: index of the copy that each face belongs to ``(faces,)``.
        count: number of copies.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    number: NDArray[np.int64]
    count: int

    @property
    def centres(self) -> NDArray[np.float64]:
        """Return the centre of each face ``(faces, 3)`` [m]."""
        return np.asarray(self.vertices[self.faces].mean(axis=1))


def box() -> trimesh.Trimesh:
    """Return a cube of 48 triangles, eight a side."""
    import trimesh

    return cast("trimesh.Trimesh", trimesh.creation.box().subdivide())


def slab() -> trimesh.Trimesh:
    """Return a cube of 12 triangles."""
    import trimesh

    return cast("trimesh.Trimesh", trimesh.creation.box())


def cylinder(sections: int = 12, rings: int = 2) -> trimesh.Trimesh:
    """Return a cylinder along z, its side cut into ``rings``."""
    import trimesh

    side = [(0.5, z) for z in np.linspace(-0.5, 0.5, rings + 1)]
    return trimesh.creation.revolve([(0, -0.5), *side, (0, 0.5)], sections=sections)


def capsule(sections: int = 12) -> trimesh.Trimesh:
    """Return a capsule along z: half spheres of two bands, twice as long as wide, squeezed to one unit."""
    import trimesh

    turn = np.radians([-90, -45, 0])
    low = np.column_stack([0.5 * np.cos(turn), (0.5 * np.sin(turn) - 0.5) / 2])
    low[0, 0] = 0  # the pole lies on the axis
    return trimesh.creation.revolve([*low, *(low[::-1] * (1, -1))], sections=sections)


def place(shape: trimesh.Trimesh, size: ArrayLike, turn: Rotation, centre: ArrayLike) -> Copies:
    """Copy a unit shape: scale it to ``size`` ``(n, 3)`` [m], turn it, move it to ``centre`` ``(n, 3)`` [m]."""
    size, centre = np.asarray(size, dtype=float), np.asarray(centre, dtype=float)
    count, each = len(size), len(shape.vertices)
    placed = (np.asarray(shape.vertices) * size[:, None]) @ turn.as_matrix().transpose(0, 2, 1) + centre[:, None]
    faces = np.asarray(shape.faces) + (np.arange(count) * each)[:, None, None]
    vertices = np.rint(placed.reshape(-1, 3) / GRID_M) * GRID_M
    return Copies(vertices, faces.reshape(-1, 3), np.repeat(np.arange(count), len(shape.faces)), count)
