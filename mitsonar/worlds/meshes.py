"""Read model files (glTF, OBJ, STL, COLLADA, PLY) as geometries with reflectivities, and build worlds from them."""

from __future__ import annotations

import io
import os
import struct
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from mitsonar.errors import MitsonarError, argument, did_you_mean
from mitsonar.io.files import parse_json, whole_number
from mitsonar.worlds.scene_check import check_counts
from mitsonar.worlds.world import Floor, Mesh, Standpoint, World

__all__ = [
    "FORMATS",
    "MAX_TRIANGLES",
    "UNCOLOURED",
    "UP",
    "Piece",
    "merged",
    "mesh_world",
    "overview",
    "random_seabed",
    "read_pieces",
    "reduce_colour",
    "reflectivity_of",
]


FORMATS = (".glb", ".gltf", ".obj", ".stl", ".dae", ".ply")
UNCOLOURED = 0.5
"""Reflectivity of a model without colours, equal to that of a BSDF without reflectance."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
UP = {"x": ((0, 1, 0), (0, 0, 1), (1, 0, 0)), "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)), "z": np.eye(3)}
"""Rows of the rotation that turns each axis upwards; none is a reflection."""

MAX_TRIANGLES = 50_000_000
"""Maximum number of triangles of a model, including all copies."""

MAX_PIXELS = 2**26
"""Maximum number of pixels of a picture in a model."""

MAX_FILE_BYTES = 2**32
"""Maximum size of a model file [bytes]."""


@dataclass(frozen=True)
class Piece:
    """One geometry of a model: triangles with one reflectivity each, or with texture coordinates and a picture.

    Attributes:
        vertices: vertex positions ``(vertices, 3)``.
        faces: vertex indices of the triangles ``(faces, 3)``.
        reflectivity: reflectivity of each face ``(faces,)``, unless a picture gives it.
        uv: texture coordinates ``(vertices, 2)``, v from the top row, as in Mitsuba; only with a picture.
        picture: reflectivity as a greyscale PNG file.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    reflectivity: NDArray[np.float64] | None = None
    uv: NDArray[np.float64] | None = None
    picture: bytes | None = None

    def moved(self, turn: NDArray[np.float64], shift: NDArray[np.float64]) -> Self:
        """Return the geometry with vertices ``turn @ v - shift``; reflections keep the front sides of triangles."""
        faces = self.faces[:, ::-1] if np.linalg.det(turn) < 0 else self.faces
        return replace(self, vertices=self.vertices @ turn.T - shift, faces=faces)

    def uniform(self, reflectivity: float) -> Self:
        """Return the geometry with the same reflectivity everywhere, and without a picture."""
        return replace(self, reflectivity=np.full(len(self.faces), reflectivity), uv=None, picture=None)


def reflectivity_of(reflectivity: str | float) -> str | float:
    """Validate the choice of a reflectivity: return ``red``, ``luminance``, or a number 0..1.

    Raises:
        MitsonarError: the value is none of these.
    """
    if reflectivity in ("red", "luminance"):
        return reflectivity
    try:
        number = float(reflectivity)
    except ValueError:
        number = np.nan
    if not 0 <= number <= 1:
        raise MitsonarError(
            f"{argument('reflectivity')} must be red, luminance or a number 0..1: got {reflectivity!r}"
            f"{did_you_mean(reflectivity, ('red', 'luminance'))}"
        )
    return number


def read_pieces(path: Path, value: str | float) -> list[Piece]:
    """Read the geometries of a model file with their reflectivity.

    Args:
        path: glTF, OBJ, STL, COLLADA or PLY file.
        value: ``red``, ``luminance``, or one reflectivity for all triangles, as :func:`reflectivity_of` returns it.

    Raises:
        MitsonarError: the file is missing, damaged, too large, or has no triangles.
    """
    geometries = _geometries(path)
    try:
        return [_piece(geometry, value) for geometry in geometries]
    except Exception as error:  # damaged colours and pictures raise errors of any type
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise MitsonarError(f"cannot read the colours of {path}: {reason}; export the model again") from None


def _geometries(path: Path) -> list[trimesh.Trimesh]:
    """Read the triangle meshes of a file, transformed by its scene graph."""
    if not os.path.isfile(path):
        raise MitsonarError(f"no model file {path}: give a {', '.join(FORMATS)} file")
    if path.suffix.lower() not in FORMATS:
        raise MitsonarError(f"cannot read models of type {path.suffix or '(none)'}: {path}; supported: {', '.join(FORMATS)}")
    if path.suffix.lower() == ".dae" and find_spec("collada") is None:
        raise MitsonarError(
            f"cannot read {path}: COLLADA needs the package pycollada, which is not installed; pip install "
            "'mitsonar[meshes]', or export the model as glb, obj, stl or ply"
        )
    try:
        _check_file(path)
        scene = trimesh.load_scene(path, process=False)
        _check_copies(scene)
        geometries = [geometry for geometry in scene.dump() if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces)]
        for geometry in geometries:
            if np.shape(geometry.vertices)[1:] != (3,) or np.shape(geometry.faces)[1:] != (3,):
                raise ValueError("a vertex or a triangle does not have three components")
            if geometry.faces.min() < 0 or geometry.faces.max() >= len(geometry.vertices):
                raise ValueError("a triangle refers to a vertex that does not exist")
    except Exception as error:  # readers of damaged files raise errors of any type
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise MitsonarError(f"cannot read {path}: {reason}; export the model again") from None
    if not geometries:
        raise MitsonarError(f"{path} contains no triangles: export a mesh, not points or lines")
    return geometries


def _check_file(path: Path) -> None:
    """Check the counts in a file against its size, before a reader allocates memory for them.

    Raises:
        ValueError: the file is too large, or its header declares more data than it contains.
    """
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise ValueError(f"it has {size:,} bytes, more than {MAX_FILE_BYTES:,}")
    kind = path.suffix.lower()
    if kind == ".ply":
        check_counts(path)
    if kind == ".dae" and b"<!DOCTYPE" in path.read_bytes().replace(b"\0", b""):  # also matches UTF-16
        raise ValueError("it has a document type declaration (<!DOCTYPE>), which models do not need")
    if kind in (".glb", ".gltf"):
        _check_gltf(path, size)


def _check_gltf(path: Path, size: int) -> None:
    """Check the sizes of accessors and buffers of a glTF file against the data available."""
    content = path.read_bytes()
    if path.suffix.lower() == ".glb":
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    tree = parse_json(content, "its JSON")
    for accessor in tree.get("accessors", []):
        view = tree["bufferViews"][accessor["bufferView"]] if "bufferView" in accessor else {"byteLength": 16 * size}
        count = whole_number(accessor["count"], "count of an accessor", 0, 2**40)
        if count > whole_number(view["byteLength"], "byteLength", 0, 2**40):
            raise ValueError(f"an accessor declares {count:,} values in {view['byteLength']:,} bytes")
    for buffer in tree.get("buffers", []):
        available = [size] if "uri" not in buffer or str(buffer["uri"]).startswith("data:") else []
        available += [(path.parent / str(buffer["uri"])).stat().st_size] if not available else []
        if whole_number(buffer["byteLength"], "byteLength", 0, 2**40) > available[0]:
            raise ValueError(f"a buffer declares {buffer['byteLength']:,} bytes, but its data has only {available[0]:,}")


def _check_copies(scene: trimesh.Scene) -> None:
    """Check the number of triangles of a scene graph, which may copy a geometry many times, and the size of its pictures."""
    total = 0
    for node in scene.graph.nodes_geometry:
        geometry = scene.geometry[scene.graph[node][1]]
        total += len(getattr(geometry, "faces", ()))
        material = getattr(geometry.visual, "material", None)
        for name in ("baseColorTexture", "image"):
            picture = getattr(material, name, None)
            if picture is not None and picture.width * picture.height > MAX_PIXELS:
                raise ValueError(f"a picture has {picture.width:,} x {picture.height:,} pixels, more than {MAX_PIXELS:,}")
    if total > MAX_TRIANGLES:
        raise ValueError(f"it has {total:,} triangles with all copies, more than {MAX_TRIANGLES:,}")


def _piece(geometry: trimesh.Trimesh, value: str | float) -> Piece:
    """Return a geometry with the reflectivity of its texture, its vertices or its faces."""
    vertices, faces = np.asarray(geometry.vertices, dtype=float), np.asarray(geometry.faces)
    if not isinstance(value, str):
        return Piece(vertices, faces, np.full(len(faces), value))
    visual: Any = geometry.visual
    if visual.kind == "texture":
        material = visual.material
        picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        factor = _tint(material, value)
        if picture is None or visual.uv is None or len(visual.uv) != len(vertices):
            return Piece(vertices, faces, np.full(len(faces), factor))
        # In trimesh v points upwards; Mitsuba's bitmaps count it from the top row.
        uv = np.asarray(visual.uv, dtype=float) * (1, -1) + (0, 1)
        return Piece(vertices, faces, uv=uv, picture=_grey_png(picture, value, factor))
    if visual.kind is None:
        return Piece(vertices, faces, np.full(len(faces), UNCOLOURED))
    if visual.kind == "vertex":
        return Piece(vertices, faces, reduce_colour(_colours(visual.vertex_colors), value)[faces].mean(axis=1))
    return Piece(vertices, faces, reduce_colour(_colours(visual.face_colors), value))


def _tint(material: trimesh.visual.material.Material, value: str) -> float:
    """Return the reflectivity 0..1 of a material's base colour, a factor of its picture."""
    if isinstance(material, trimesh.visual.material.PBRMaterial):  # glTF: linear values; the default is white
        factor = material.baseColorFactor
        colour = np.ones(3) if factor is None else _colours(factor)[0]
        return float(colour[0] if value == "red" else colour @ LUMINANCE)
    if getattr(material, "image", None) is not None:
        return 1.0
    return float(reduce_colour(_colours(material.main_color), value)[0])


def _colours(values: ArrayLike) -> NDArray[np.float64]:
    """Convert 8-bit or floating-point RGB(A) to RGB in 0..1 ``(n, 3)``."""
    table = np.atleast_2d(np.asarray(values))
    scale = 255 if np.issubdtype(table.dtype, np.integer) else 1
    return np.clip(table[:, :3].astype(float) / scale, 0, 1)


def reduce_colour(colours: NDArray[np.float64], value: str) -> NDArray[np.float64]:
    """Reduce stored sRGB colours ``(..., 3)`` to one number each: the red channel, or the luminance of linear light."""
    if value == "red":
        return colours[..., 0]
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear @ LUMINANCE, dtype=np.float64)


def _grey_png(picture: Image.Image, value: str, factor: float) -> bytes:
    """Return the reflectivity of a picture, times ``factor``, as a 16-bit greyscale PNG."""
    grey = reduce_colour(_colours(np.asarray(picture.convert("RGB")).reshape(-1, 3)), value) * factor
    pixels = np.rint(grey * 65535).astype(np.uint16).reshape(picture.height, picture.width)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def merged(
    pieces: list[Piece], name: str = "model", textured: str = "textured", first_id: int = 1, shape_id: str | None = None
) -> tuple[list[Mesh], dict[str, bytes]]:
    """Merge all untextured pieces into one mesh, and the pieces that share a picture into one mesh per picture.

    Args:
        pieces: geometries in the axes of the scene [m]; each becomes one object, numbered in order.
        name: name of the untextured mesh.
        textured: prefix of the names of the textured meshes.
        first_id: object number of the first piece.
        shape_id: id of the untextured shape and prefix of the ids of the others; default: the names of the meshes.

    Returns:
        The meshes, the untextured one first, and the pictures as files, keyed by their name in the world's folder.
    """
    groups: dict[bytes | None, list[tuple[int, Piece]]] = {}
    for number, piece in enumerate(pieces, start=first_id):
        groups.setdefault(piece.picture, []).append((number, piece))
    meshes: list[Mesh] = []
    content: dict[str, bytes] = {}
    for picture, members in sorted(groups.items(), key=lambda group: group[0] is not None):  # untextured first
        vertices = np.concatenate([piece.vertices for _, piece in members])
        offsets = np.cumsum([0, *(len(piece.vertices) for _, piece in members)])
        faces = np.concatenate([piece.faces + offset for (_, piece), offset in zip(members, offsets, strict=False)])
        ids = np.concatenate([np.full(len(piece.faces), number) for number, piece in members])
        if picture is None:
            reflectivity = np.concatenate([piece.reflectivity for _, piece in members if piece.reflectivity is not None])
            meshes.append(Mesh(name, vertices, faces, reflectivity, ids, shape_id=shape_id))
        else:
            file = f"{textured}_{len(content)}"
            uv = np.concatenate([piece.uv for _, piece in members if piece.uv is not None])
            content[f"textures/{file}.png"] = picture
            mesh_id = None if shape_id is None else f"{shape_id}/{file}"
            meshes.append(Mesh(file, vertices, faces, None, ids, uv, f"textures/{file}.png", shape_id=mesh_id))
    return meshes, content


# ---------------- Worlds from models


LARGEST_M = 1e6
"""Largest extent of a model [m]."""

FARTHEST_M = 1e9
"""Largest distance of a model from the file's origin [m]."""


def mesh_world(
    path: str | Path,
    *,
    scale: float = 1.0,
    up: str | None = None,
    reflectivity: str | float = "luminance",
    floor: bool = True,
    floor_m: float | None = None,
) -> World:
    """Build a world from a model file: scaled, z upwards, and centred above the origin with its lowest point at z = 0.

    Args:
        path: glTF, OBJ, STL, COLLADA or PLY file.
        scale: metres per unit of the file.
        up: axis of the file that points up, x, y or z; default: y for glTF, z otherwise.
        reflectivity: ``luminance`` (of linear light, as Mitsuba computes it), ``red`` (the stored red channel, as in
            Almanza-Medina), or one number for the whole model.
        floor: whether to add a seabed of random 15 mm cells at z = 0.
        floor_m: side length of that seabed [m]; default: three times the model's diagonal.

    Raises:
        MitsonarError: the model is unreadable, damaged or empty; or scale, axis or reflectivity is invalid.
    """
    # 1. Read the model. Only vertices of triangles count towards its extent.
    path = Path(path)
    up = up or ("y" if path.suffix.lower() in (".glb", ".gltf") else "z")
    _check_options(up, scale, floor_m)
    pieces = read_pieces(path, reflectivity_of(reflectivity))
    turn = np.array(UP[up], dtype=float) * scale
    vertices = np.concatenate([(piece.vertices @ turn.T)[np.unique(piece.faces)] for piece in pieces])
    _check_extent(path, vertices, scale)
    # 2. Centre the model above the origin, on z = 0.
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    shift = np.array([*(low + high)[:2] / 2, low[2]])
    meshes, content = merged([piece.moved(turn, shift) for piece in pieces])
    # 3. Add the seabed, and a sonar that sees the whole model.
    radius = float(np.linalg.norm(high - low)) / 2
    half = 3 * radius if floor_m is None else floor_m / 2
    return World(
        about=f"{path.name}: {sum(len(piece.faces) for piece in pieces)} triangles, "
        f"{' x '.join(f'{edge:.4g}' for edge in high - low)} m, reflectivity {reflectivity}",
        meshes=meshes,
        stand=overview(radius, (high - low)[2]),
        floor=random_seabed(half) if floor else None,
        content=content,
    )


def _check_options(up: str, scale: float, floor_m: float | None) -> None:
    """Check the options of :func:`mesh_world`.

    Raises:
        MitsonarError: an option is invalid.
    """
    if up not in UP:
        raise MitsonarError(f"{argument('up')} must be x, y or z: got {up!r}{did_you_mean(up, UP)}")
    if not (np.isfinite(scale) and scale > 0):
        raise MitsonarError(
            f"{argument('scale')} must be a finite number above 0, metres per unit of the file: got {scale:g}"
        )
    if floor_m is not None and not 0 < floor_m <= 10_000:
        raise MitsonarError(f"{argument('floor_m')} must lie in 0..10000 m: got {floor_m:g}")


def _check_extent(path: Path, vertices: NDArray[np.float64], scale: float) -> None:
    """Check that the vertices of a model ``(n, 3)`` [m] are finite, do not all coincide, and are not too far apart.

    Raises:
        MitsonarError: a check fails.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        extent = float(np.ptp(vertices, axis=0).max())
    if not np.isfinite(vertices).all() or extent <= 0:
        raise MitsonarError(f"{path} is damaged: its vertices are not finite or all coincide; export it again")
    if not (extent <= LARGEST_M and np.abs(vertices).max() <= FARTHEST_M):
        raise MitsonarError(
            f"{path} spans {extent:.4g} m with scale {scale:g}: a model may span at most {LARGEST_M:g} m; give the scale in "
            "metres per unit of the file"
        )


def random_seabed(half_m: float, z_m: float = 0.0) -> Floor:
    """Return a square seabed of random 15 mm cells, with half a side length of ``half_m`` [m], at height ``z_m`` [m]."""
    return Floor(half_m, Floor.cells(int(np.clip(round(2 * half_m / 0.015), 1, 2**20)), (0, 1), 0), z_m)


def overview(radius: float, height: float, foot: ArrayLike = (0.0, 0.0, 0.0), *, nearest: float = 0.0) -> Standpoint:
    """Return a standpoint from which the sonar sees a whole model, looking down at 30 deg.

    From there, the model fills a field of view of 29 deg.

    Args:
        radius: half the diagonal of the model's bounding box [m].
        height: height of the model [m].
        foot: point below the model's centre, at its lowest z ``(3,)`` [m].
        nearest: minimum distance of the sonar [m].
    """
    distance = max(1.1 * radius / np.tan(np.radians(14.5)), nearest)
    x, y, z = (float(value) for value in np.asarray(foot))
    centre_z = z + height / 2
    sin, cos = np.sin(np.radians(30)), np.cos(np.radians(30))
    window = (max(distance - 1.5 * radius, 0.01), distance + 2.5 * radius)
    return Standpoint((x, y - distance * cos, centre_z + distance * sin), (x, y, centre_z), window=window)
