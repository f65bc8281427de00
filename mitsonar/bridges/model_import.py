"""Where the sonar of an imported scene stands: a few metres from its objects, not from its ground."""

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
"""Farthest range at which each preset is used [m], within the limits of its instrument; the nearest first."""

NEAREST_M = 1.0
"""The sonar keeps this distance [m]."""

PART_M = 1.2
"""Radius of the part that is looked at where no shape fits [m]."""

FLAT, LOW, WIDE = 1e-3, 0.2, 0.5
"""Ground is flat, or low and wide: height over diagonal, and part of the area of all shapes."""

TURNS_DEG = (0, 45, -45, 90, -90, 135, -135, 180)
"""Directions that are tried, about the vertical; 0 looks along +y."""

TRIANGLES = 2**17
"""Triangles that a ray meets at once, a bound of memory."""


class ImportedView(NamedTuple):
    """What the sonar looks at.

    Attributes:
        stand: of the sonar.
        about: what it sees, in words.
        part: whether no shape fits, so that it sees a part of one.
    """

    stand: Standpoint
    about: str
    part: bool


def view_of_objects(groups: Groups) -> ImportedView:
    """Return the view of all objects, of the largest one that a sonar takes in, or of a part.

    Args:
        groups: the geometries of each shape, in the axes of the world [m].
    """
    boxes = {name: _box(pieces) for name, pieces in groups.items()}
    objects = {name: box for name, box in boxes.items() if not _is_ground(box, _union(list(boxes.values())))}
    objects = objects or boxes
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
    """Return the lowest and the highest corner of geometries ``(2, 3)`` [m]."""
    corners = np.concatenate([piece.vertices[np.unique(piece.faces)] for piece in pieces])
    return np.array([corners.min(axis=0), corners.max(axis=0)])


def _union(boxes: Sequence[Point]) -> Point:
    return np.array([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])


def _radius(box: Point) -> float:
    return max(float(np.linalg.norm(box[1] - box[0])) / 2, 0.05)


def _fits(box: Point) -> bool:
    """Return whether a sonar of :data:`REACH` takes it in."""
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
    """Return the box around the place that a ray along the view, through the middle, meets first."""
    middle, along = box.mean(axis=0), _forward(0)
    begin = middle - 2 * _radius(box) * along
    met = begin + _first_hit(pieces, begin, along) * along
    centre = met if np.isfinite(met).all() else middle
    return np.array([centre - PART_M / np.sqrt(3), centre + PART_M / np.sqrt(3)])


def _clear_view(groups: Groups, box: Point) -> tuple[Standpoint, float]:
    """Return the view of a box from the first direction without anything before it, and its distance [m]."""
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
    """Return the direction of a view 30 deg down, turned about the vertical."""
    turn, down = np.radians(turn_deg), np.radians(30)
    return np.array([np.sin(turn) * np.cos(down), np.cos(turn) * np.cos(down), -np.sin(down)])


def _first_hit(pieces: Sequence[Piece], origin: Point, along: Point) -> float:
    """Return the distance at which a ray meets triangles first [m], inf where it meets none (Moeller, Trumbore 1997)."""
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


# ---------------- A world from the scene of another simulator: URDF, SDF or USD


SCENE_FORMATS = (".urdf", ".sdf", ".world", ".usd", ".usda", ".usdc", ".usdz")

MOST_SHAPES = 5_000
"""Shapes of a scene, at most: each costs time in every launch."""

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
    """Build the world of a scene of another simulator: one shape for each link or prim, where the file has it.

    The axes of the world stay: x and y of the file are mitsonar's, z is up (USD stages with y up are turned), in metres.

    Args:
        path: ``.urdf``, ``.sdf``, ``.world``, ``.usd``, ``.usda``, ``.usdc`` or ``.usdz``.
        joints: values of joints of URDF and SDF by name [rad, m]; others are at 0.
        search: folders that hold models and packages; files elsewhere are refused, except beside the scene and below.
        collision: read the collision shapes, in place of the visual ones.
        reflectivity: ``luminance`` or ``red`` of diffuse colours, or one number for all; without a colour 0.5.
        materials: acoustic material by the name of a link, model or prim.
        own_axes: links, models or prims that are written about the origin, bow along +y, each as one shape: they follow a
            trajectory, ``moving={name: path}``.
        seabed_z: height of a seabed of random cells that is added [m]; default: none.

    Raises:
        MitsonarError: the file is damaged, names what is not there or not allowed, or holds no geometry.

    Warns:
        MitsonarWarning: geometries that are not read.
    """
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
    groups = _groups(path, read, own_axes)
    made, content = _meshes(path, groups, _checked_materials(path, read, materials or {}))
    still = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh in made])
    low, high = still.min(axis=0), still.max(axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, 0.05)
    half = float(np.abs([low, high])[:, :2].max()) + 3 * radius
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
    """Read a file by its ending."""
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
    """Return the geometries of each shape: of each body in the world, or of a name in its own axes."""
    groups: dict[str, list[Piece]] = {}
    for name in own_axes:
        if name not in read.frames:
            raise MitsonarError(f"{path} has no link, model or prim {name[:80]}: {nearest_names(name, read.frames)}"[:400])
        groups[name] = []
    to_ours = np.eye(4)
    to_ours[:3, :3] = np.array(CONVENTIONS["ros-enu"].body).T  # forward, left, up to starboard, forward, up
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
    """Return the meshes of all shapes, and their pictures."""
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
    """Return the id of a shape: its name with letters that XML and Mitsuba leave alone, and a number where it is taken."""
    base = re.sub(r"[^A-Za-z0-9_:/.-]", "_", name)[:200] or "shape"
    found, number = base, 2
    while found in taken:
        found, number = f"{base}_{number}", number + 1
    taken.add(found)
    return found


def _checked_materials(path: Path, read: ReadScene, materials: Mapping[str, str]) -> dict[str, str]:
    """Return the material of each body, by the name of itself or of what it lies within; the nearest name wins."""
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
