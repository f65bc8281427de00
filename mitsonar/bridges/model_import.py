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
from mitsonar.errors import MitsonarError, MitsonarWarning, argument, nearest_names
from mitsonar.motion.trajectory import CONVENTIONS
from mitsonar.worlds.meshes import Piece, merged, overview, random_seabed, reflectivity_of
from mitsonar.worlds.world import Mesh, Standpoint, World

__all__ = ["SCENE_FORMATS", "ImportedView", "imported_world", "view_of_objects"]


Point: TypeAlias = NDArray[np.float64]
Groups: TypeAlias = Mapping[str, Sequence[Piece]]

REACH = {"didson300": 15.0, "oculus-m1200d-1200khz": 40.0}
"""Largest range at which each preset is used [m], within the limits of its instrument, in ascending order."""

NEAREST_M = 1.0
"""Smallest distance of the sonar from its target [m]."""

PART_M = 1.2
"""Radius of the part of a shape that the sonar looks at if no shape fits into its view [m]."""

FLAT, LOW, WIDE = 1e-3, 0.2, 0.5
"""Limits for ground: a flat shape's height over its diagonal; a low shape's, and its share of the area of all shapes."""

TURNS_DEG = (0, 45, -45, 90, -90, 135, -135, 180)
"""Headings of the view in the order in which they are tried [deg]; 0 looks along +y."""

TRIANGLES = 2**17
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
    boxes = {name: _box(pieces) for name, pieces in groups.items()}
    objects = {name: box for name, box in boxes.items() if not _is_ground(box, _union(list(boxes.values())))}
    objects = objects or boxes
    # 2. Choose the target: everything, the largest object that fits, or a part of the largest object.
    whole = _union(list(objects.values()))
    fitting = {name: box for name, box in objects.items() if _fits(box)}
    if _fits(whole):
        chosen, what = whole, next(iter(objects)) if len(objects) == 1 else f"all {len(objects)} shapes"
    elif fitting:
        what = max(fitting, key=lambda name: _radius(fitting[name]))
        chosen = fitting[what]
    else:
        name = max(objects, key=lambda one: _radius(objects[one]))
        chosen, what = _part(groups[name], objects[name]), f"a part of {name}"
    stand, away = _clear_view(groups, chosen)
    return ImportedView(stand, f"the sonar looks at {what[:80]} from {away:.3g} m", not (_fits(whole) or fitting))


def _box(pieces: Sequence[Piece]) -> Point:
    """Return the lowest and the highest corner of the geometries' bounding box ``(2, 3)`` [m]."""
    corners = np.concatenate([piece.vertices[np.unique(piece.faces)] for piece in pieces])
    return np.array([corners.min(axis=0), corners.max(axis=0)])


def _union(boxes: Sequence[Point]) -> Point:
    return np.array([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])


def _radius(box: Point) -> float:
    return max(float(np.linalg.norm(box[1] - box[0])) / 2, 0.05)


def _fits(box: Point) -> bool:
    """Return whether a box fits into the view of a sonar of :data:`REACH`."""
    return _overview(box).window[1] <= max(REACH.values())


def _overview(box: Point) -> Standpoint:
    low, high = box
    foot = (*(low + high)[:2] / 2, low[2])
    return overview(_radius(box), float(high[2] - low[2]), foot, nearest=NEAREST_M)


def _is_ground(box: Point, whole: Point) -> bool:
    """Return whether a shape is flat and level, or low and as wide as half of the scene."""
    edges, all_edges = box[1] - box[0], whole[1] - whole[0]
    across = float(np.linalg.norm(edges[:2]))
    wide = edges[0] * edges[1] >= WIDE * all_edges[0] * all_edges[1]
    return bool(edges[2] <= FLAT * across or (wide and edges[2] < LOW * across))


def _part(pieces: Sequence[Piece], box: Point) -> Point:
    """Return the box of a part of a shape, around the first hit of a ray along the view through the shape's centre."""
    middle, along = box.mean(axis=0), _forward(0)
    begin = middle - 2 * _radius(box) * along
    met = begin + _first_hit(pieces, begin, along) * along
    centre = met if np.isfinite(met).all() else middle
    return np.array([centre - PART_M / np.sqrt(3), centre + PART_M / np.sqrt(3)])


def _clear_view(groups: Groups, box: Point) -> tuple[Standpoint, float]:
    """Return the view of a box from the first heading with a free line of sight, and its distance [m]."""
    base = _overview(box)
    target = np.array(base.target)
    away = float(np.linalg.norm(target - np.array(base.origin)))
    preset = next((name for name, reach in REACH.items() if base.window[1] <= reach), list(REACH)[-1])
    everything = [piece for pieces in groups.values() for piece in pieces]
    origins = [target - away * _forward(turn) for turn in TURNS_DEG]
    clear = (
        origin
        for origin, turn in zip(origins, TURNS_DEG, strict=True)
        if _first_hit(everything, origin, _forward(turn)) >= base.window[0]
    )
    x, y, z = (float(value) for value in next(clear, origins[0]))
    return Standpoint((x, y, z), base.target, base.window, preset), away


def _forward(turn_deg: float) -> Point:
    """Return the direction of a view that looks down at 30 deg, with a given heading ``(3,)``."""
    turn, down = np.radians(turn_deg), np.radians(30)
    return np.array([np.sin(turn) * np.cos(down), np.cos(turn) * np.cos(down), -np.sin(down)])


def _first_hit(pieces: Sequence[Piece], origin: Point, along: Point) -> float:
    """Return the distance along a ray to the first triangle [m], inf if it hits none (Moeller, Trumbore 1997).

    A ray meets a triangle where its barycentric coordinates u, v satisfy u >= 0, v >= 0 and u + v <= 1.
    """
    nearest = np.inf
    for piece in pieces:
        for first in range(0, len(piece.faces), TRIANGLES):
            corner, second, third = np.moveaxis(piece.vertices[piece.faces[first : first + TRIANGLES]], 1, 0)
            one, other = second - corner, third - corner
            normal = np.cross(along, other)
            volume = (one * normal).sum(axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                since = origin - corner
                u = (since * normal).sum(axis=1) / volume
                across = np.cross(since, one)
                v = across @ along / volume
                distance = (other * across).sum(axis=1) / volume
                hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
            nearest = min(nearest, float(distance[hit].min(initial=np.inf)))
    return nearest


# ---------------- World of an imported scene


SCENE_FORMATS = (".urdf", ".sdf", ".world", ".usd", ".usda", ".usdc", ".usdz")

MOST_SHAPES = 5_000
"""Largest number of shapes of a scene; each costs time in every launch."""

FARTHEST_M = 1e6
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
    shapes, search_in = Shapes(reflectivity_of(reflectivity)), ModelSearch(path, search)
    joints = dict(joints or {})
    wrong = next((name for name, value in joints.items() if not abs(value) <= 1e6), None)
    if wrong is not None:
        raise MitsonarError(f"joint {wrong} needs a finite number [rad, m]: got {joints[wrong]:g}")
    if seabed_z is not None and not abs(seabed_z) <= FARTHEST_M:
        raise MitsonarError(f"{argument('seabed_z')} must be a height within {FARTHEST_M:g} m: got {seabed_z:g}")
    read = _read(path, search_in, shapes, joints, collision)
    if read.left_out:
        told = ", ".join(f"{count} {kind[:40]}" for kind, count in sorted(read.left_out.items()))
        warnings.warn(f"{path}: these are not read and left out: {told}", MitsonarWarning, stacklevel=2)
    # 2. Make one shape of each body, or of each name in `own_axes`.
    groups = _groups(path, read, own_axes)
    made, content = _meshes(path, groups, _checked_materials(path, read, materials or {}))
    still = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh in made])
    low, high = still.min(axis=0), still.max(axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, 0.05)
    half = float(np.abs([low, high])[:, :2].max()) + 3 * radius
    # 3. Place the sonar in front of the objects that do not move, if there are any.
    kind = "collision" if collision else "visual"
    view = view_of_objects({name: pieces for name, pieces in groups.items() if name not in own_axes} or groups)
    if view.part:
        told = "no shape is small enough for the sonar's reach: it sees a part; change its pose and window in scene.xml"
        warnings.warn(f"{path}: {view.about}; {told}", MitsonarWarning, stacklevel=2)
    return World(
        about=f"{path.name}: {len(made)} shapes of {kind} geometry, {sum(len(mesh.faces) for mesh in made)} triangles, "
        f"{' x '.join(f'{edge:.4g}' for edge in high - low)} m, reflectivity {reflectivity}; {view.about}",
        meshes=made,
        stand=view.stand,
        floor=None if seabed_z is None else random_seabed(half, seabed_z),
        content=content,
    )


def _read(path: Path, search: ModelSearch, shapes: Shapes, joints: Mapping[str, float], collision: bool) -> ReadScene:
    """Read a file with the reader of its extension."""
    suffix = path.suffix.lower()
    if suffix not in SCENE_FORMATS:
        known = ", ".join(SCENE_FORMATS)
        raise MitsonarError(
            f"cannot read scenes of type {suffix or 'without ending'}: {path}; known: {known}; single models: mesh"
        )
    if suffix.startswith(".usd"):
        if joints:
            raise MitsonarError(f"joints are of URDF and SDF: got {next(iter(joints))} for {path}; leave them out")
        found = read_usd(path, search, shapes, collision)
    else:
        found = (read_urdf if suffix == ".urdf" else read_sdf)(path, search, shapes, joints, collision)
    if not found.bodies:
        other = "visual" if collision else "collision"
        raise MitsonarError(f"{path} holds no geometry of this kind: give a scene with shapes, or read its {other} shapes")
    return found


def _groups(path: Path, read: ReadScene, own_axes: Sequence[str]) -> dict[str, list[Piece]]:
    """Return the geometries of each shape: in the axes of the world, or for a name of ``own_axes`` in those of its body."""
    groups: dict[str, list[Piece]] = {}
    for name in own_axes:
        if name not in read.frames:
            raise MitsonarError(f"{path} has no link, model or prim {name[:80]}: {nearest_names(name, read.frames)}"[:400])
        groups[name] = []
    to_ours = np.eye(4)
    to_ours[:3, :3] = np.array(CONVENTIONS["ros-enu"].body).T  # from (forward, left, up) to (starboard, forward, up)
    for body in read.bodies:
        owner = next((name for name in own_axes if name == body.name or name in body.within), None)
        place: Matrix = body.pose if owner is None else to_ours @ np.linalg.inv(rigid(read.frames[owner])) @ body.pose
        moved = [piece.moved(place[:3, :3], -place[:3, 3]) for piece in body.pieces]
        groups.setdefault(owner or body.name, []).extend(moved)
    empty = next((name for name, pieces in groups.items() if not pieces), None)
    if empty is not None:
        raise MitsonarError(f"{path}: {empty[:80]} has no geometry of this kind: name a link, model or prim that has")
    return groups


def _meshes(path: Path, groups: dict[str, list[Piece]], materials: dict[str, str]) -> tuple[list[Mesh], dict[str, bytes]]:
    """Return the meshes of all shapes, and their pictures as files, keyed by name."""
    if len(groups) > MOST_SHAPES:
        raise MitsonarError(f"{path} has {len(groups):,} shapes, more than {MOST_SHAPES:,}: merge them before the export")
    made: list[Mesh] = []
    content: dict[str, bytes] = {}
    taken: set[str] = set()
    first = 1
    for number, (name, pieces) in enumerate(groups.items()):
        points = np.concatenate([piece.vertices for piece in pieces])
        if not (np.isfinite(points).all() and np.abs(points).max(initial=0) <= FARTHEST_M):
            raise MitsonarError(
                f"{path}: {name[:80]} has vertices that are not finite, or farther than {FARTHEST_M:g} m away"
            )
        shape_id = _free_id(name, taken)
        file = f"{number}_{re.sub('[^A-Za-z0-9_-]+', '_', shape_id)[-60:].strip('_')}"
        meshes, pictures = merged(pieces, file, f"{file}_textured", first, shape_id)
        first += len(pieces)
        material = materials.get(name)
        made += [mesh if material is None else replace(mesh, material=material) for mesh in meshes]
        content |= pictures
    return made, content


def _free_id(name: str, taken: set[str]) -> str:
    """Return an unused id for a shape: its name without special characters, with a number if the name is taken."""
    base = re.sub(r"[^A-Za-z0-9_:/.-]", "_", name)[:200] or "shape"
    found, number = base, 2
    while found in taken:
        found, number = f"{base}_{number}", number + 1
    taken.add(found)
    return found


def _checked_materials(path: Path, read: ReadScene, materials: Mapping[str, str]) -> dict[str, str]:
    """Return the material of each body, given for its own name or that of a model around it; the innermost name wins."""
    known = {name for body in read.bodies for name in (body.name, *body.within)}
    for name, material in materials.items():
        if name not in known:
            raise MitsonarError(f"{path} has no link, model or prim {name[:80]}: {nearest_names(name, sorted(known))}"[:400])
        if material not in named_materials():
            raise MitsonarError(f"unknown material {material[:80]!r}: {nearest_names(material, named_materials())}")
    found: dict[str, str] = {}
    for body in read.bodies:
        for name in (*body.within, body.name):
            if name in materials:
                found[body.name] = materials[name]
    return found | {name: material for name, material in materials.items() if name in read.frames}
