"""How a scene of another simulator (URDF, SDF, USD) becomes a world, with a sonar that looks at its objects."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.materials import named_materials
from mitsonar.bridges.model_files import Matrix, ModelSearch, ReadScene, Shapes, rigid
from mitsonar.bridges.sdf import read_sdf
from mitsonar.bridges.urdf import read_urdf
from mitsonar.bridges.usd import read_usd
from mitsonar.errors import MitsonarError, MitsonarWarning, argument, suggest_names
from mitsonar.motion.trajectory import CONVENTIONS
from mitsonar.worlds.meshes import Piece, merged, overview, random_seabed, reflectivity_of
from mitsonar.worlds.world import Mesh, Standpoint, World

__all__ = ["SCENE_FORMATS", "ImportedView", "imported_world", "view_of_objects"]


Point: TypeAlias = NDArray[np.float64]
Groups: TypeAlias = Mapping[str, Sequence[Piece]]

REACH = {"didson300": 15.0, "oculus-m1200d-1200khz": 40.0}
"""Largest range at which each preset is used [m], within the limits of its instrument, in ascending order."""

MIN_DISTANCE_M = 1.0
"""Smallest distance of the sonar from its target [m]."""

PART_RADIUS_M = 1.2
"""Radius of the part of a shape that the sonar looks at if no shape fits into its view [m]."""

FLAT_RATIO, LOW_RATIO, WIDE_FRACTION = 1e-3, 0.2, 0.5
"""Limits for ground: a flat shape's height over its diagonal; a low shape's, and its share of the area of all shapes."""

HEADINGS_DEG = (0, 45, -45, 90, -90, 135, -135, 180)
"""Headings of the view in the order in which they are tried [deg]; 0 looks along +y."""

CHUNK_TRIANGLES = 2**17
"""Number of triangles intersected with a ray at once, to bound the memory."""


class ImportedView(NamedTuple):
    """The view of the sonar in an imported scene.

    Attributes:
        stand: position and window of the sonar.
        about: description of what the sonar sees.
        part: whether the sonar sees only a part of a shape, because no shape fits into its view.
    """

    stand: Standpoint
    about: str
    part: bool


def view_of_objects(groups: Groups) -> ImportedView:
    """Choose a view of all objects, of the largest object that fits into a sonar's view, or of a part of one.

    Args:
        groups: geometries of each shape, in the axes of the world [m].
    """
    # 1. Ignore the ground, unless there is nothing else.
    boxes = {name: _box_of_pieces(pieces) for name, pieces in groups.items()}
    objects = {name: box for name, box in boxes.items() if not _is_ground(box, _bounding_box(list(boxes.values())))}
    objects = objects or boxes
    # 2. Choose the target: everything, the largest object that fits, or a part of the largest object.
    all_objects = _bounding_box(list(objects.values()))
    fitting = {name: box for name, box in objects.items() if _fits(box)}
    if _fits(all_objects):
        target, target_name = all_objects, next(iter(objects)) if len(objects) == 1 else f"all {len(objects)} shapes"
    elif fitting:
        target_name = max(fitting, key=lambda name: _radius(fitting[name]))
        target = fitting[target_name]
    else:
        name = max(objects, key=lambda shape: _radius(objects[shape]))
        target, target_name = _part_of_shape(groups[name], objects[name]), f"a part of {name}"
    stand, distance_m = _clear_view(groups, target)
    return ImportedView(
        stand, f"the sonar looks at {target_name[:80]} from {distance_m:.3g} m", not (_fits(all_objects) or fitting)
    )


def _box_of_pieces(pieces: Sequence[Piece]) -> Point:
    """Return the lowest and the highest corner of the geometries' bounding box ``(2, 3)`` [m]."""
    corners = np.concatenate([piece.vertices[np.unique(piece.faces)] for piece in pieces])
    return np.array([corners.min(axis=0), corners.max(axis=0)])


def _bounding_box(boxes: Sequence[Point]) -> Point:
    return np.array([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])


def _radius(box: Point) -> float:
    return max(float(np.linalg.norm(box[1] - box[0])) / 2, 0.05)


def _fits(box: Point) -> bool:
    """Return whether a box fits into the view of a sonar of :data:`REACH`."""
    return _overview(box).window[1] <= max(REACH.values())


def _overview(box: Point) -> Standpoint:
    low, high = box
    foot = (*(low + high)[:2] / 2, low[2])
    return overview(_radius(box), float(high[2] - low[2]), foot, nearest=MIN_DISTANCE_M)


def _is_ground(box: Point, scene_box: Point) -> bool:
    """Return whether a shape is flat and level, or low and as wide as half of the scene."""
    edges, all_edges = box[1] - box[0], scene_box[1] - scene_box[0]
    diagonal = float(np.linalg.norm(edges[:2]))
    wide = edges[0] * edges[1] >= WIDE_FRACTION * all_edges[0] * all_edges[1]
    return bool(edges[2] <= FLAT_RATIO * diagonal or (wide and edges[2] < LOW_RATIO * diagonal))


def _part_of_shape(pieces: Sequence[Piece], box: Point) -> Point:
    """Return the box of a part of a shape, around the first hit of a ray along the view through the shape's centre."""
    box_centre, direction = box.mean(axis=0), _forward(0)
    origin = box_centre - 2 * _radius(box) * direction
    hit = origin + _first_hit(pieces, origin, direction) * direction
    centre = hit if np.isfinite(hit).all() else box_centre
    return np.array([centre - PART_RADIUS_M / np.sqrt(3), centre + PART_RADIUS_M / np.sqrt(3)])


def _clear_view(groups: Groups, box: Point) -> tuple[Standpoint, float]:
    """Return the view of a box from the first heading with a free line of sight, and its distance [m]."""
    view = _overview(box)
    target = np.array(view.target)
    distance_m = float(np.linalg.norm(target - np.array(view.origin)))
    preset = next((name for name, reach in REACH.items() if view.window[1] <= reach), list(REACH)[-1])
    all_pieces = [piece for pieces in groups.values() for piece in pieces]
    origins = [target - distance_m * _forward(heading) for heading in HEADINGS_DEG]
    clear = (
        origin
        for origin, heading in zip(origins, HEADINGS_DEG, strict=True)
        if _first_hit(all_pieces, origin, _forward(heading)) >= view.window[0]
    )
    x, y, z = (float(value) for value in next(clear, origins[0]))
    return Standpoint((x, y, z), view.target, view.window, preset), distance_m


def _forward(heading_deg: float) -> Point:
    """Return the direction of a view that looks down at 30 deg, with a given heading ``(3,)``."""
    heading, depression = np.radians(heading_deg), np.radians(30)
    return np.array([np.sin(heading) * np.cos(depression), np.cos(heading) * np.cos(depression), -np.sin(depression)])


def _first_hit(pieces: Sequence[Piece], origin: Point, direction: Point) -> float:
    """Return the distance along a ray to the first triangle [m], inf if it hits none (Moeller, Trumbore 1997).

    A ray meets a triangle where its barycentric coordinates u, v satisfy u >= 0, v >= 0 and u + v <= 1.
    """
    nearest = np.inf
    for piece in pieces:
        for first in range(0, len(piece.faces), CHUNK_TRIANGLES):
            corner, second, third = np.moveaxis(piece.vertices[piece.faces[first : first + CHUNK_TRIANGLES]], 1, 0)
            edge_1, edge_2 = second - corner, third - corner
            normal = np.cross(direction, edge_2)
            volume = (edge_1 * normal).sum(axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                offset = origin - corner
                u = (offset * normal).sum(axis=1) / volume
                offset_normal = np.cross(offset, edge_1)
                v = offset_normal @ direction / volume
                distance = (edge_2 * offset_normal).sum(axis=1) / volume
                hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
            nearest = min(nearest, float(distance[hit].min(initial=np.inf)))
    return nearest


# ---------------- World of an imported scene


SCENE_FORMATS = (".urdf", ".sdf", ".world", ".usd", ".usda", ".usdc", ".usdz")

MAX_SHAPES = 5_000
"""Largest number of shapes of a scene; each costs time in every launch."""

MAX_COORDINATE_M = 1e6
"""Largest distance of a vertex from the origin [m]."""


def imported_world(
    path: str | Path,
    *,
    joints: Mapping[str, float] | None = None,
    search: Sequence[str | Path] = (),
    collision: bool = False,
    reflectivity: str | float = "luminance",
    materials: Mapping[str, str] | None = None,
    own_axes: Sequence[str] = (),
    seabed_z: float | None = None,
) -> World:
    """Build the world of a scene of another simulator, with one shape for each link or prim.

    The axes of the world are kept: x and y of the file are mitsonar's, z is up (USD stages with y up are rotated), and
    lengths are in metres.

    Args:
        path: ``.urdf``, ``.sdf``, ``.world``, ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
        joints: values of joints of URDF and SDF, keyed by name [rad, m]; others are at 0.
        search: folders with models and packages; files outside them and outside the scene's folder are refused.
        collision: whether to read the collision shapes instead of the visual ones.
        reflectivity: ``luminance`` or ``red`` of diffuse colours, or one number for all; 0.5 without a colour.
        materials: acoustic materials, keyed by the name of a link, model or prim.
        own_axes: links, models or prims to write around the origin with the bow along +y, each as one shape, so that they
            can follow a trajectory, ``moving={name: path}``.
        seabed_z: height of a seabed of random cells to add [m]; default: none.

    Raises:
        MitsonarError: the file is damaged, refers to something that is missing or not allowed, or contains no geometry.

    Warns:
        MitsonarWarning: geometries are left out, or the sonar sees only a part of a shape.
    """
    # 1. Read the scene.
    path = Path(path)
    shapes, file_search = Shapes(reflectivity_of(reflectivity)), ModelSearch(path, search)
    joints = dict(joints or {})
    invalid = next((name for name, value in joints.items() if not abs(value) <= 1e6), None)
    if invalid is not None:
        raise MitsonarError(f"joint {invalid} needs a finite number [rad, m]: got {joints[invalid]:g}")
    if seabed_z is not None and not abs(seabed_z) <= MAX_COORDINATE_M:
        raise MitsonarError(f"{argument('seabed_z')} must be a height within {MAX_COORDINATE_M:g} m: got {seabed_z:g}")
    scene = _read_scene(path, file_search, shapes, joints, collision)
    if scene.left_out:
        left_out = ", ".join(f"{count} {kind[:40]}" for kind, count in sorted(scene.left_out.items()))
        warnings.warn(
            f"{path}: these elements are not supported and are left out: {left_out}", MitsonarWarning, stacklevel=2
        )
    # 2. Make one shape of each body, or of each name in `own_axes`.
    groups = _groups(path, scene, own_axes)
    meshes, content = _meshes(path, groups, _checked_materials(path, scene, materials or {}))
    points = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh in meshes])
    low, high = points.min(axis=0), points.max(axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, 0.05)
    half_edge = float(np.abs([low, high])[:, :2].max()) + 3 * radius
    # 3. Place the sonar in front of the objects that do not move, if there are any.
    kind = "collision" if collision else "visual"
    view = view_of_objects({name: pieces for name, pieces in groups.items() if name not in own_axes} or groups)
    if view.part:
        message = (
            "no shape is small enough for the sonar's range: it sees only a part; change its pose and window in scene.xml"
        )
        warnings.warn(f"{path}: {view.about}; {message}", MitsonarWarning, stacklevel=2)
    return World(
        about=f"{path.name}: {len(meshes)} shapes of {kind} geometry, {sum(len(mesh.faces) for mesh in meshes)} triangles, "
        f"{' x '.join(f'{edge:.4g}' for edge in high - low)} m, reflectivity {reflectivity}; {view.about}",
        meshes=meshes,
        stand=view.stand,
        floor=None if seabed_z is None else random_seabed(half_edge, seabed_z),
        content=content,
    )


def _read_scene(path: Path, search: ModelSearch, shapes: Shapes, joints: Mapping[str, float], collision: bool) -> ReadScene:
    """Read a file with the reader of its extension."""
    suffix = path.suffix.lower()
    if suffix not in SCENE_FORMATS:
        known = ", ".join(SCENE_FORMATS)
        raise MitsonarError(
            f"cannot read scenes of type {suffix or '(no extension)'}: {path}; known: {known}; single models: mesh"
        )
    if suffix.startswith(".usd"):
        if joints:
            raise MitsonarError(f"joints apply only to URDF and SDF: got {next(iter(joints))} for {path}; leave them out")
        scene = read_usd(path, search, shapes, collision)
    else:
        scene = (read_urdf if suffix == ".urdf" else read_sdf)(path, search, shapes, joints, collision)
    if not scene.bodies:
        other_kind = "visual" if collision else "collision"
        raise MitsonarError(
            f"{path} contains no geometry of this kind: give a scene with shapes, or read its {other_kind} shapes"
        )
    return scene


def _groups(path: Path, scene: ReadScene, own_axes: Sequence[str]) -> dict[str, list[Piece]]:
    """Return the geometries of each shape: in the axes of the world, or for a name of ``own_axes`` in those of its body."""
    groups: dict[str, list[Piece]] = {}
    for name in own_axes:
        if name not in scene.frames:
            raise MitsonarError(f"{path} has no link, model or prim {name[:80]}: {suggest_names(name, scene.frames)}"[:400])
        groups[name] = []
    to_mitsonar = np.eye(4)
    to_mitsonar[:3, :3] = np.array(CONVENTIONS["ros-enu"].body).T  # from (forward, left, up) to (starboard, forward, up)
    for body in scene.bodies:
        frame = next((name for name in own_axes if name == body.name or name in body.within), None)
        transform: Matrix = (
            body.pose if frame is None else to_mitsonar @ np.linalg.inv(rigid(scene.frames[frame])) @ body.pose
        )
        moved = [piece.moved(transform[:3, :3], -transform[:3, 3]) for piece in body.pieces]
        groups.setdefault(frame or body.name, []).extend(moved)
    empty = next((name for name, pieces in groups.items() if not pieces), None)
    if empty is not None:
        raise MitsonarError(f"{path}: {empty[:80]} has no geometry of this kind: give a link, model or prim with geometry")
    return groups


def _meshes(path: Path, groups: dict[str, list[Piece]], materials: dict[str, str]) -> tuple[list[Mesh], dict[str, bytes]]:
    """Return the meshes of all shapes, and their pictures as files, keyed by name."""
    if len(groups) > MAX_SHAPES:
        raise MitsonarError(f"{path} has {len(groups):,} shapes, more than {MAX_SHAPES:,}: merge them before the export")
    all_meshes: list[Mesh] = []
    content: dict[str, bytes] = {}
    used_ids: set[str] = set()
    first = 1
    for number, (name, pieces) in enumerate(groups.items()):
        points = np.concatenate([piece.vertices for piece in pieces])
        if not (np.isfinite(points).all() and np.abs(points).max(initial=0) <= MAX_COORDINATE_M):
            raise MitsonarError(
                f"{path}: {name[:80]} has vertices that are not finite, or farther than {MAX_COORDINATE_M:g} m away"
            )
        shape_id = _free_id(name, used_ids)
        file = f"{number}_{re.sub('[^A-Za-z0-9_-]+', '_', shape_id)[-60:].strip('_')}"
        meshes, pictures = merged(pieces, file, f"{file}_textured", first, shape_id)
        first += len(pieces)
        material = materials.get(name)
        all_meshes += [mesh if material is None else replace(mesh, material=material) for mesh in meshes]
        content |= pictures
    return all_meshes, content


def _free_id(name: str, used_ids: set[str]) -> str:
    """Return an unused id for a shape: its name without special characters, with a number if the name is taken."""
    base = re.sub(r"[^A-Za-z0-9_:/.-]", "_", name)[:200] or "shape"
    unused, number = base, 2
    while unused in used_ids:
        unused, number = f"{base}_{number}", number + 1
    used_ids.add(unused)
    return unused


def _checked_materials(path: Path, scene: ReadScene, materials: Mapping[str, str]) -> dict[str, str]:
    """Return the material of each body, given for its own name or that of a model around it; the innermost name wins."""
    known = {name for body in scene.bodies for name in (body.name, *body.within)}
    for name, material in materials.items():
        if name not in known:
            raise MitsonarError(f"{path} has no link, model or prim {name[:80]}: {suggest_names(name, sorted(known))}"[:400])
        if material not in named_materials():
            raise MitsonarError(f"unknown material {material[:80]!r}: {suggest_names(material, named_materials())}")
    material_of: dict[str, str] = {}
    for body in scene.bodies:
        for name in (*body.within, body.name):
            if name in materials:
                material_of[body.name] = materials[name]
    return material_of | {name: material for name, material in materials.items() if name in scene.frames}
