"""How the files of another simulator's scene are read safely: bodies, primitives, model files, file search, XML."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn, TypeAlias
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, short_repr
from mitsonar.io.files import read_bytes
from mitsonar.worlds.meshes import MAX_TRIANGLES, UP, Piece, read_pieces

__all__ = [
    "Body",
    "Matrix",
    "ModelSearch",
    "ReadScene",
    "Shapes",
    "attribute_of",
    "number_of",
    "numbers_of",
    "placed",
    "primitive",
    "read_xml",
    "refused",
    "rigid",
]


Matrix: TypeAlias = NDArray[np.float64]
"""Homogeneous transform from the axes of a body to others ``(4, 4)``; lengths in m."""

SECTIONS = 96
"""Corners around a cylinder; its facets deviate by 0.05 % of its radius."""

SUBDIVISIONS = 4
"""Number of times that the edges of a sphere's mesh are halved; its facets deviate by 0.1 % of its radius."""

PLANE_M = 100.0
"""Edge of a plane without a size [m]."""


@dataclass(frozen=True)
class Body:
    """A link or prim with geometries.

    Attributes:
        name: name of the body, from which the id of its shape is made.
        pose: transform from its axes to the world.
        pieces: geometries, in its axes.
        within: names of the models, prims or robot that contain it.
    """

    name: str
    pose: Matrix
    pieces: list[Piece]
    within: tuple[str, ...] = ()


@dataclass
class ReadScene:
    """The contents of a scene file.

    Attributes:
        bodies: bodies with geometries.
        frames: poses of all links, models and prims, keyed by name.
        left_out: number of elements that were not read, keyed by kind.
    """

    bodies: list[Body] = field(default_factory=list)
    frames: dict[str, Matrix] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)

    def leave_out(self, kind: str) -> None:
        """Count an element that is not read."""
        self.left_out[kind] = self.left_out.get(kind, 0) + 1


def placed(position: ArrayLike, rotation: Rotation | None = None) -> Matrix:
    """Return the transform of a position ``(3,)`` [m] and a rotation, by default none."""
    matrix = np.eye(4)
    matrix[:3, 3] = position
    if rotation is not None:
        matrix[:3, :3] = rotation.as_matrix()
    return matrix


def rigid(matrix: Matrix) -> Matrix:
    """Return the nearest rigid transform, without scale, shear or reflection."""
    left, _, right = np.linalg.svd(matrix[:3, :3])
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return placed(matrix[:3, 3], Rotation.from_matrix(rotation))


def _box(size: Mapping[str, float]) -> trimesh.Trimesh:
    mesh: trimesh.Trimesh = trimesh.creation.box((size["x"], size["y"], size["z"]))
    return mesh


def _sphere(size: Mapping[str, float]) -> trimesh.Trimesh:
    mesh: trimesh.Trimesh = trimesh.creation.icosphere(SUBDIVISIONS, size["radius"])
    return mesh


def _ellipsoid(size: Mapping[str, float]) -> trimesh.Trimesh:
    sphere = trimesh.creation.icosphere(SUBDIVISIONS, 1.0)
    return trimesh.Trimesh(sphere.vertices * (size["x"], size["y"], size["z"]), sphere.faces, process=False)


def _cylinder(size: Mapping[str, float]) -> trimesh.Trimesh:
    mesh: trimesh.Trimesh = trimesh.creation.cylinder(size["radius"], size["length"], SECTIONS)
    return mesh


def _capsule(size: Mapping[str, float]) -> trimesh.Trimesh:
    mesh = trimesh.creation.capsule(size["length"], size["radius"], count=[SECTIONS, SECTIONS // 2])
    return trimesh.Trimesh(mesh.vertices - mesh.bounds.mean(axis=0), mesh.faces, process=False)


def _cone(size: Mapping[str, float]) -> trimesh.Trimesh:
    mesh = trimesh.creation.cone(size["radius"], size["length"], SECTIONS)
    return trimesh.Trimesh(mesh.vertices - (0, 0, size["length"] / 2), mesh.faces, process=False)


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
"""Primitives around their centre; cylinders, capsules and cones along z. A capsule's ``length`` is that of its cylinder."""


def primitive(kind: str, size: Mapping[str, float], reflectivity: float, source: str) -> Piece:
    """Return a primitive of :data:`PRIMITIVES`.

    Args:
        kind: name of the primitive.
        size: ``x``, ``y``, ``z``, or ``radius`` and ``length`` [m].
        reflectivity: uniform reflectivity, 0..1.
        source: file and element that define it, for error messages.

    Raises:
        MitsonarError: a size is not in 1e-6..1e6 m.
    """
    wrong = [f"{name} {value:g}" for name, value in size.items() if not 1e-6 <= value <= 1e6]
    if wrong:
        raise MitsonarError(f"{source}: a {kind} needs sizes of 1e-6 to 1e6 m: got {wrong[0]}")
    mesh = PRIMITIVES[kind](size)
    vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces)
    return Piece(vertices, faces, np.full(len(faces), reflectivity))


class Shapes:
    """A reader of geometries that reads each file once, and limits the total number of triangles.

    Args:
        value: reflectivity of a colour: ``red``, ``luminance`` or a number.
    """

    def __init__(self, value: str | float) -> None:
        self.value = value
        self._files: dict[Path, list[Piece]] = {}
        self._triangles = 0

    def count_noun(self, pieces: list[Piece], source: str) -> list[Piece]:
        """Count the triangles of geometries, and return the geometries.

        Raises:
            MitsonarError: there are too many triangles in total.
        """
        self._triangles += sum(len(piece.faces) for piece in pieces)
        if self._triangles > MAX_TRIANGLES:
            raise MitsonarError(f"{source} contains more than {MAX_TRIANGLES:,} triangles: give a smaller scene")
        return pieces

    def of_file(self, path: Path, scale: ArrayLike, reflectivity: float | None) -> list[Piece]:
        """Return the geometries of a model file, with z upwards, in m.

        Args:
            path: model file; glTF has y upwards, and COLLADA states its unit.
            scale: scale along the axes of the result ``(3,)``.
            reflectivity: uniform reflectivity instead of the file's colours; default: from the colours.

        Raises:
            MitsonarError: the file cannot be read, or there are too many triangles in total.
        """
        if path not in self._files:
            self._files[path] = read_pieces(path, self.value)
        suffix = path.suffix.lower()
        unit = _unit_m(path) if suffix == ".dae" else 1.0
        axes = np.asarray(UP["y" if suffix in (".glb", ".gltf") else "z"], dtype=float) * unit
        pieces = [piece.moved(np.diag(np.asarray(scale, dtype=float)) @ axes, np.zeros(3)) for piece in self._files[path]]
        return [
            piece if reflectivity is None else piece.uniform(reflectivity) for piece in self.count_noun(pieces, str(path))
        ]


def _unit_m(path: Path) -> float:
    """Return the length of the unit of a COLLADA file [m]; 1 if it is missing or implausible."""
    for element in read_xml(path, "COLLADA file").iter():
        if element.tag.endswith("}unit") or element.tag == "unit":
            unit = number_of(path, element, element.get("meter"), 1.0)
            return unit if 1e-9 <= unit <= 1e9 else 1.0
    return 1.0


# ---------------- File search


MAX_NAME_LENGTH = 1024
"""Largest length of a file name in a scene [characters]."""

PACKAGE_SCHEMES = ("model://", "package://")
"""Schemes of Gazebo and ROS, which are followed by the name of a folder."""


class ModelSearch:
    """A search for the files that a scene names, within the scene's folder and the folders that the user allows.

    Args:
        file: file of the scene.
        folders: further folders with models and packages.

    Attributes:
        roots: folders that a file must lie in, with symbolic links resolved.

    Raises:
        MitsonarError: the file or one of the folders does not exist.
    """

    def __init__(self, file: Path, folders: Sequence[str | Path] = ()) -> None:
        if not os.path.lexists(file):
            raise MitsonarError(f"no such file: {file}")
        missing = [folder for folder in folders if not os.path.isdir(folder)]
        if missing:
            raise MitsonarError(f"there is no folder {missing[0]} to search: give a folder that contains models or packages")
        roots = (_without_links(file).parent, *(_without_links(folder) for folder in folders))
        self.roots = list(dict.fromkeys(roots))  # without duplicates

    def find(self, name: str, referrer: Path) -> Path:
        """Find the file or folder that a scene names.

        Args:
            name: a path, possibly with the scheme ``model://``, ``package://`` or ``file://``. In ``model://NAME/...`` NAME
                is a folder within a searched folder, or the searched folder itself.
            referrer: file that contains the name; a path without a scheme is relative to its folder, or else to the searched
                folders.

        Raises:
            MitsonarError: the file does not exist, lies outside the folders, or is a network address.
        """
        name = name.strip()
        if len(name) > MAX_NAME_LENGTH or "\0" in name or not name:
            raise MitsonarError(
                f"{referrer} names the file {short_repr(name)}: give a path of 1 to {MAX_NAME_LENGTH} characters"
            )
        scheme = next((scheme for scheme in PACKAGE_SCHEMES if name.startswith(scheme)), "")
        if not scheme and "://" in name and not name.startswith("file://"):
            raise MitsonarError(
                f"{referrer} names {short_repr(name)}: nothing is downloaded; download it, name it model://..., and "
                "give its folder by --search"
            )
        for candidate in self._candidates(name, scheme, referrer):
            resolved = _without_links(candidate)
            if any(resolved.is_relative_to(root) for root in self.roots) and os.path.exists(resolved):
                return resolved
        candidates = [_without_links(path) for path in self._candidates(name, scheme, referrer)]
        inside = any(path.is_relative_to(root) for path in candidates for root in self.roots)
        outside = any(os.path.exists(path) for path in candidates)
        missing = "there is no such file" if inside and not outside else "which is not"
        raise MitsonarError(
            f"{referrer} names {short_repr(name)}, {missing} within {', '.join(map(str, self.roots))}: give the folder that "
            "contains it by --search"
        )

    def _candidates(self, name: str, scheme: str, referrer: Path) -> list[Path]:
        """Return the paths where a file may be, in the order of preference."""
        path = Path(name.removeprefix(scheme) if scheme else name.removeprefix("file://"))
        if not scheme:
            return [referrer.parent / path, *(root / path for root in self.roots)]
        package, *rest = [part for part in path.parts if part not in ("/", ".")] or [""]
        return [
            *(root / package / Path(*rest) for root in self.roots),
            *(root / Path(*rest) for root in self.roots if root.name == package),
        ]


def _without_links(path: str | Path) -> Path:
    """Return a path with symbolic links resolved; circular links are kept, for which :meth:`Path.resolve` raises."""
    return Path(os.path.realpath(path))


# ---------------- XML from untrusted sources


MAX_DEPTH = 100
"""Largest depth of nested elements."""

MAX_ELEMENTS = 2_000_000
"""Largest number of elements of a file."""

MAX_FILE_BYTES = 2**28
"""Largest size of a file [bytes]."""

MAX_NUMBER = 1e9
"""Largest magnitude of a number in a file [m, rad]."""


class _BoundedTreeBuilder(TreeBuilder):
    """A tree builder with limits of depth and size that accepts no document type."""

    def __init__(self) -> None:
        super().__init__()
        self.depth = self.count = 0

    def start(self, tag: str, attrs: dict[str, str]) -> Element:
        self.depth += 1
        self.count += 1
        if self.depth > MAX_DEPTH:
            raise ValueError(f"its elements nest more than {MAX_DEPTH} deep")
        if self.count > MAX_ELEMENTS:
            raise ValueError(f"it has more than {MAX_ELEMENTS:,} elements")
        return super().start(tag, attrs)

    def end(self, tag: str) -> Element:
        self.depth -= 1
        return super().end(tag)

    def doctype(self, name: str, pubid: str | None, system: str | None) -> NoReturn:
        """Refuse a document type before it is read: its entities may refer to files, or expand without limit."""
        raise ValueError("it has a document type (<!DOCTYPE>), which scenes do not need")


def read_xml(path: Path, what: str) -> Element:
    """Read the element tree of an XML file that may be hostile.

    Document types are refused, and with them entities. Size, depth and number of elements are limited.

    Args:
        path: XML file.
        what: kind of file, for error messages, such as ``URDF file``.

    Raises:
        MitsonarError: the file is unreadable, is not XML, has a document type, or is too large or too deep.
    """
    parser = XMLParser(target=_BoundedTreeBuilder())
    try:
        parser.feed(read_bytes(path, what, MAX_FILE_BYTES))
        tree = parser.close()
    except (ParseError, ValueError, LookupError) as error:
        if isinstance(error, MitsonarError):
            raise
        raise MitsonarError(f"{path} is not a valid {what}: {' '.join(str(error).split())[:160]}; export it again") from None
    assert isinstance(tree, Element)
    return tree


def refused(path: Path, element: Element, reason: str) -> MitsonarError:
    """Return an error for an element of a file; ``reason`` states what is wrong, what was found and what is allowed."""
    name = element.get("name")
    where = f"<{element.tag[:40]}{f' name={short_repr(name)}' if name else ''}>"
    return MitsonarError(f"{path}, {where}: {reason}")


def attribute_of(path: Path, element: Element, key: str) -> str:
    """Return a mandatory attribute.

    Raises:
        MitsonarError: the attribute is missing or empty.
    """
    value = element.get(key)
    if not value:
        raise refused(path, element, f"the attribute {key} is missing")
    return value


def numbers_of(path: Path, element: Element, text: str | None, count: int, default: tuple[float, ...]) -> tuple[float, ...]:
    """Parse the numbers of an attribute or of an element's text, separated by spaces.

    Args:
        path: the file, for error messages.
        element: the element, for error messages.
        text: text to parse; None or empty gives ``default``.
        count: number of numbers.
        default: numbers to return without text.

    Raises:
        MitsonarError: the text does not have ``count`` finite numbers, or one is too large.
    """
    if text is None or not text.strip():
        return default
    try:
        values = tuple(float(word) for word in text.split()) if "_" not in text else ()
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(value) and abs(value) <= MAX_NUMBER for value in values):
        raise refused(path, element, f"expected {count} finite numbers up to {MAX_NUMBER:g}: got {short_repr(text.strip())}")
    return values


def number_of(path: Path, element: Element, text: str | None, default: float | None = None) -> float:
    """Parse a single number, as :func:`numbers_of` does.

    Raises:
        MitsonarError: the text is not a finite number, or is missing without a default.
    """
    if default is None and (text is None or not text.strip()):
        raise refused(path, element, "a number is missing")
    return numbers_of(path, element, text, 1, (default or 0.0,))[0]
