"""A world from the scene of another simulator: URDF, SDF or USD."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsonar.acoustics.materials import named_materials
from mitsonar.errors import MitsonarError, MitsonarWarning, argument, nearest_names
from mitsonar.motion.trajectory import CONVENTIONS
from mitsonar.worlds.imported_view import view_of_objects
from mitsonar.worlds.meshes import Piece, merged, random_seabed, reflectivity_of
from mitsonar.worlds.model_search import ModelSearch
from mitsonar.worlds.scene_parts import Matrix, ReadScene, Shapes, rigid
from mitsonar.worlds.sdf_file import read_sdf
from mitsonar.worlds.urdf_file import read_urdf
from mitsonar.worlds.usd_file import read_usd
from mitsonar.worlds.world import Mesh, World

__all__ = ["SCENE_FORMATS", "imported_world"]

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
