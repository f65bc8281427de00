"""Motions of bodies that files say: read by the ids of the shapes, from a scene's own shapes or a YAML file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, argument
from mitsonar.io.files import refuse_beyond_memory
from mitsonar.io.runs import digest, file_digest
from mitsonar.motion.bodies import VEHICLE, BodyMotion, Deforming, MeshSequence, files_of, read_motions
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plugins.native_plugins import load_dict
from mitsonar.worlds.scene_check import check_mesh

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = [
    *("Said", "digests_of", "load_meshes", "load_motions", "motions_of", "read_said"),
    *("refuse_motion", "refuse_unread_motions", "said_by", "said_in"),
]

STAYS = Trajectory(np.zeros((1, 6)), np.zeros(1))
"""The path of a body that stays where the scene has it."""

BYTES_A_VERTEX = 12


class Said(NamedTuple):
    """What is said of a shape's motion.

    Attributes:
        name: id of the shape.
        motion: of it.
        folders: one of which holds the files that it names.
    """

    name: str
    motion: BodyMotion
    folders: Sequence[Path]


def load_motions(file: str | Path) -> dict[str, Any]:
    """Read the motions in a YAML file, as ``moving`` of :class:`mitsonar.Simulator`; paths are relative to its folder.

    Raises:
        MitsonarError: unreadable files, wrong keys.
    """
    return read_said(said_in(file))


def motions_of(scene: mi.Scene) -> dict[str, Any]:
    """Return what the shapes of a scene say of their motion, by their ids; empty where all stand still.

    Raises:
        MitsonarError: unreadable files, or wrong keys.
    """
    return read_said(said_by(scene))


def said_in(file: str | Path) -> list[Said]:
    """Return what a YAML file says; the files that it names are not read."""
    return [Said(name, motion, [Path(file).parent]) for name, motion in read_motions(file).items()]


def said_by(scene: mi.Scene) -> list[Said]:
    """Return what the shapes of a scene say; the files that they name are not read."""
    from mitsonar.plugins.trajectory_texture import MOTION

    found = []
    for shape in scene.shapes():
        if not shape.has_attribute(MOTION)[0]:
            continue
        texture: Any = shape.texture_attribute(MOTION)
        fields = getattr(texture, "fields", None)
        if fields is None:
            raise MitsonarError(f"the texture {MOTION} of {shape.id()} must be a trajectory: see docs/guides/moving.md")
        found.append(Said(shape.id(), BodyMotion.create(shape.id(), fields), texture.folders))
    return found


def read_said(said: Sequence[Said]) -> dict[str, Any]:
    """Read the files that are named, and return motions by the ids of the shapes.

    Raises:
        MitsonarError: unreadable files; a body that deforms or follows the vehicle, in several places.
    """
    found: dict[str, Any] = {}
    for name, motion, folders in said:
        one = _loaded(name, motion, folders)
        if name in found and not (isinstance(one, list) and isinstance(found[name], list)):
            raise MitsonarError(f"moving: {name} deforms or follows the vehicle, and is in one place: give it one motion")
        found[name] = found[name] + one if name in found else one
    return found


def digests_of(said: Sequence[Said]) -> dict[str, str]:
    """Return what tells the motions again: their keys and the digests of their files, by the ids of the shapes."""
    found: dict[str, str] = {}
    for name, motion, folders in said:
        named = [one for one in (motion.path, motion.meshes) if one and one != VEHICLE]
        parts = [motion.model_dump_json(), *(file_digest(file) for one in named for file in _found(one, folders))]
        found[name] = digest(found.get(name, "").encode(), *(part.encode() for part in parts))
    return found


def refuse_motion(scene: mi.Scene, what: str) -> None:
    """Refuse a scene whose shapes say that they move.

    Raises:
        MitsonarError: one does.
    """
    said = said_by(scene)
    if said:
        raise MitsonarError(f"{what} are of still scenes: {said[0].name} has a trajectory; take the texture motion out")


def refuse_unread_motions(state: mi.parser.ParserState) -> None:
    """Refuse a texture ``trajectory`` that no shape holds under the name ``motion``: Mitsuba leaves it out without a word.

    Args:
        state: of the parsed scene, not instantiated yet.

    Raises:
        MitsonarError: there is one.
    """
    import mitsuba as mi

    from mitsonar.plugins.trajectory_texture import MOTION

    kinds = mi.Properties.Type
    paths = [number for number, node in enumerate(state.nodes) if node.props.plugin_name() == "trajectory"]
    ids = {state.nodes[number].props.id() for number in paths} - {""}
    for node in state.nodes if paths else ():
        if node.type == mi.ObjectType.Scene:  # there a texture only waits to be referred to
            continue
        for name in list(node.props):
            kind, held = node.props.type(name), node.props[name]
            inside = kind == kinds.ResolvedReference and held.index() in paths
            named = kind == kinds.Reference and held.id() in ids
            if (inside or named) and (name != MOTION or node.type != mi.ObjectType.Shape):
                shown = "without a name" if name.startswith("_arg_") else f'with name="{name[:80]}"'
                where = f"{node.props.plugin_name()} {node.props.id()}".strip()
                raise MitsonarError(
                    f"the texture trajectory in {where} stands there {shown}: nothing would move; write "
                    f'name="{MOTION}", in a shape'
                )


def load_meshes(files: Sequence[Path], rate_hz: float, *, loop: bool = True) -> MeshSequence:
    """Read PLY meshes of the same triangles that follow one another.

    Args:
        files: in the order of time.
        rate_hz: meshes a second.
        loop: after the last comes the first.

    Raises:
        MitsonarError: no mesh, a damaged one, other triangles, or more than the memory holds.
    """
    if isinstance(files, str | Path) or not len(files):
        raise MitsonarError(
            f"{argument('files')} are PLY meshes in the order of time: got {str(files)!r}; give a list of them"
        )
    first, faces = _mesh(files[0])
    refuse_beyond_memory(len(files) * len(first) * BYTES_A_VERTEX, f"{len(files)} meshes like {files[0]}")
    vertices = np.empty((len(files), *first.shape), np.float32)
    for number, file in enumerate(files):
        one, own = _mesh(file)
        if one.shape != first.shape or not np.array_equal(own, faces):
            raise MitsonarError(f"{file} has other triangles than {files[0]}: meshes of a body that deforms share them")
        vertices[number] = one
    return MeshSequence(vertices, rate_hz, loop)


def _mesh(file: Path) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices and triangles of a PLY file."""
    import mitsuba as mi

    check_mesh(file, "ply")
    values = mi.traverse(load_dict({"type": "ply", "filename": str(file)}))
    return np.array(values["vertex_positions"]).reshape(-1, 3), np.array(values["faces"])


def _loaded(name: str, motion: BodyMotion, folders: Sequence[Path]) -> Any:
    """Return the motion of a shape as :class:`mitsonar.Simulator` takes it."""
    if motion.path == VEHICLE and motion.meshes is None:
        return VEHICLE
    if motion.path == VEHICLE:
        raise MitsonarError(f"moving: {name} follows the vehicle and deforms: give it a path of its own")
    files = [] if motion.path is None else _found(motion.path, folders)
    paths = [Trajectory.load(file, motion.frame, looks_ahead=False) for file in files] or [STAYS]
    if motion.meshes is None:
        return paths
    if len(paths) > 1:
        raise MitsonarError(f"moving: {name} deforms and has {len(paths)} paths: give each body a shape of its own")
    return Deforming(paths[0], load_meshes(_found(motion.meshes, folders), motion.rate_hz, loop=motion.loop))


def _found(name: str, folders: Sequence[Path]) -> list[Path]:
    """Return the files of a name in the first folder that has them."""
    errors = []
    for folder in folders:
        try:
            files = files_of(name, folder)
        except MitsonarError as error:
            errors.append(error)
            continue
        if all(os.path.isfile(file) for file in files):
            return files
    raise errors[0] if errors else MitsonarError(f"there is no {name} in {folders[0] if folders else Path()}")
