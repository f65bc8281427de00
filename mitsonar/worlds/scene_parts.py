"""Bodies of a scene of another simulator: links or prims with a place and geometries of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError
from mitsonar.worlds.meshes import MOST_TRIANGLES, UP, Piece, read_pieces
from mitsonar.worlds.plain_xml import number_of, read_xml

__all__ = ["Body", "Matrix", "ReadScene", "Shapes", "placed", "primitive", "rigid"]

Matrix: TypeAlias = NDArray[np.float64]
"""From the axes of a body to others, ``(4, 4)``; lengths in m."""

SECTIONS = 96
"""Corners around a cylinder: its side is flat to 0.05 % of its radius."""

SUBDIVISIONS = 4
"""Halvings of the edges of a sphere, which is then flat to 0.1 % of its radius."""

PLANE_M = 100.0
"""Edge of a plane without a size [m]."""


@dataclass(frozen=True)
class Body:
    """A link or prim.

    Attributes:
        name: becomes the id of its shape.
        pose: from its axes to the world.
        pieces: in its axes.
        within: names of what it belongs to: models, prims above it, the robot.
    """

    name: str
    pose: Matrix
    pieces: list[Piece]
    within: tuple[str, ...] = ()


@dataclass
class ReadScene:
    """What was read of a file.

    Attributes:
        bodies: with geometries.
        frames: pose of each name that a body may have or lie within.
        left_out: what was not read, by kind, and how often.
    """

    bodies: list[Body] = field(default_factory=list)
    frames: dict[str, Matrix] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)

    def leave_out(self, kind: str) -> None:
        """Count something that is not read."""
        self.left_out[kind] = self.left_out.get(kind, 0) + 1


def placed(position: ArrayLike, rotation: Rotation | None = None) -> Matrix:
    """Return the matrix of a position ``(3,)`` [m] and a rotation."""
    matrix = np.eye(4)
    matrix[:3, 3] = position
    if rotation is not None:
        matrix[:3, :3] = rotation.as_matrix()
    return matrix


def rigid(matrix: Matrix) -> Matrix:
    """Return the nearest matrix that only turns and moves; scales, shears and mirrors are taken out."""
    first, _, last = np.linalg.svd(matrix[:3, :3])
    turn = first @ np.diag([1, 1, np.linalg.det(first @ last)]) @ last
    return placed(matrix[:3, 3], Rotation.from_matrix(turn))


def _box(size: Mapping[str, float]) -> trimesh.Trimesh:
    made: trimesh.Trimesh = trimesh.creation.box((size["x"], size["y"], size["z"]))
    return made


def _sphere(size: Mapping[str, float]) -> trimesh.Trimesh:
    made: trimesh.Trimesh = trimesh.creation.icosphere(SUBDIVISIONS, size["radius"])
    return made


def _ellipsoid(size: Mapping[str, float]) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(SUBDIVISIONS, 1.0)
    return trimesh.Trimesh(ball.vertices * (size["x"], size["y"], size["z"]), ball.faces, process=False)


def _cylinder(size: Mapping[str, float]) -> trimesh.Trimesh:
    made: trimesh.Trimesh = trimesh.creation.cylinder(size["radius"], size["length"], SECTIONS)
    return made


def _capsule(size: Mapping[str, float]) -> trimesh.Trimesh:
    made = trimesh.creation.capsule(size["length"], size["radius"], count=[SECTIONS, SECTIONS // 2])
    return trimesh.Trimesh(made.vertices - made.bounds.mean(axis=0), made.faces, process=False)


def _cone(size: Mapping[str, float]) -> trimesh.Trimesh:
    made = trimesh.creation.cone(size["radius"], size["length"], SECTIONS)
    return trimesh.Trimesh(made.vertices - (0, 0, size["length"] / 2), made.faces, process=False)


def _plane(size: Mapping[str, float]) -> trimesh.Trimesh:
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) / 2 * (size["x"], size["y"], 1)
    return trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], process=False)


PRIMITIVES: dict[str, Callable[[Mapping[str, float]], trimesh.Trimesh]] = {
    "box": _box,
    "sphere": _sphere,
    "ellipsoid": _ellipsoid,
    "cylinder": _cylinder,
    "capsule": _capsule,
    "cone": _cone,
    "plane": _plane,
}
"""Primitives about their middle, cylinders, capsules and cones along z; ``length`` of a capsule is that of its cylinder."""


def primitive(kind: str, size: Mapping[str, float], reflectivity: float, source: str) -> Piece:
    """Return a primitive of :data:`PRIMITIVES`.

    Args:
        kind: its name.
        size: ``x``, ``y``, ``z``, or ``radius`` and ``length`` [m].
        reflectivity: of all of it, 0..1.
        source: what names it, for errors.

    Raises:
        MitsonarError: a size is not above 0.
    """
    wrong = [f"{name} {value:g}" for name, value in size.items() if not 1e-6 <= value <= 1e6]
    if wrong:
        raise MitsonarError(f"{source}: a {kind} needs sizes of 1e-6 to 1e6 m: got {wrong[0]}")
    made = PRIMITIVES[kind](size)
    vertices, faces = np.asarray(made.vertices, dtype=float), np.asarray(made.faces)
    return Piece(vertices, faces, np.full(len(faces), reflectivity))


class Shapes:
    """Reads geometries, each file once, and bounds their number.

    Args:
        value: ``red``, ``luminance`` or a number: what of a colour is the reflectivity.
    """

    def __init__(self, value: str | float) -> None:
        self.value = value
        self._files: dict[Path, list[Piece]] = {}
        self._triangles = 0

    def counted(self, pieces: list[Piece], source: str) -> list[Piece]:
        """Return pieces, and count their triangles.

        Raises:
            MitsonarError: all together have too many.
        """
        self._triangles += sum(len(piece.faces) for piece in pieces)
        if self._triangles > MOST_TRIANGLES:
            raise MitsonarError(f"{source} places more than {MOST_TRIANGLES:,} triangles: give a smaller scene")
        return pieces

    def of_file(self, path: Path, scale: ArrayLike, reflectivity: float | None) -> list[Piece]:
        """Return the geometries of a model file, z upwards, in m.

        Args:
            path: of the file; glTF has y upwards, and COLLADA tells its unit.
            scale: along its axes ``(3,)``.
            reflectivity: of all of it, in place of its colours; default: by its colours.

        Raises:
            MitsonarError: it cannot be read.
        """
        if path not in self._files:
            self._files[path] = read_pieces(path, self.value)
        suffix = path.suffix.lower()
        unit = _unit_m(path) if suffix == ".dae" else 1.0
        turn = np.asarray(UP["y" if suffix in (".glb", ".gltf") else "z"], dtype=float) * unit
        pieces = [piece.moved(np.diag(np.asarray(scale, dtype=float)) @ turn, np.zeros(3)) for piece in self._files[path]]
        return [piece if reflectivity is None else piece.uniform(reflectivity) for piece in self.counted(pieces, str(path))]


def _unit_m(path: Path) -> float:
    """Return the unit of a COLLADA file [m]."""
    for element in read_xml(path, "COLLADA file").iter():
        if element.tag.endswith("}unit") or element.tag == "unit":
            unit = number_of(path, element, element.get("meter"), 1.0)
            return unit if 1e-9 <= unit <= 1e9 else 1.0
    return 1.0
