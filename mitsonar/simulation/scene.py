"""Scenes from Mitsuba XML files, the user's or shipped ones, and the sonar in them."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from mitsonar.errors import MitsonarError, argument, nearest_names
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import refuse_beyond_memory
from mitsonar.io.runs import digest, file_digest
from mitsonar.motion.bodies import VEHICLE, BodyMotion, Deforming, MeshSequence, files_of, read_motions
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plugins.native_plugins import file_resolver, load_dict, own_code_only, search_in
from mitsonar.simulation.device import ensure_variant
from mitsonar.worlds.scene_check import check_mesh, check_parsed, check_text

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = [
    "MOST_FACES",
    "Said",
    "Triangles",
    "channel_sonar_in",
    "covered_squares_in",
    "digests_of",
    "find_scene",
    "load_meshes",
    "load_motions",
    "load_scene",
    "motions_of",
    "object_names_in",
    "read_said",
    "refuse_motion",
    "refuse_unread_motions",
    "said_by",
    "said_in",
    "scale_notes",
    "shape_boxes_in",
    "shape_names_in",
    "shipped_scenes",
    "shipped_trajectory",
    "sonar_in",
    "triangles_in",
]


MOST_OBJECTS = 1_000_000
"""Objects that are named; beyond, their numbers have to do."""

QUOTING = {
    r"(failed to load spectrum from file \".*?\"): .*": r"\1: it must hold a wavelength and a value in each line",
    r"(Error while loading .*? curve\(s\) from \".*?\"): .*": r"\1: it must hold x, y, z and a radius in each line",
}
"""Mitsuba's errors that quote the file which the scene names, and what is shown of them."""

LONGEST_REASON = 600
"""Letters of Mitsuba's errors that are shown."""


TOO_LARGE = 20
"""Ends of the window [m] that a body's smallest extent may have before its unit is doubted."""

FARTHEST_WINDOW_M = 500.0
"""End of a window beyond the reach of imaging sonars [m]: those of 100 kHz see some hundred metres."""


def shipped_scenes() -> dict[str, Path]:
    """Return the scenes of the package by name; a trajectory of the same name lies beside each."""
    folder = Path(str(files("mitsonar.scenes")))
    return {path.stem: path for path in sorted(folder.glob("*.xml"))}


def shipped_trajectory(name: str) -> Path:
    """Return the file of the trajectory for a shipped scene (TUM).

    Raises:
        MitsonarError: no such scene.
    """
    return find_scene(name).with_suffix(".tum")


def find_scene(name_or_file: str | Path) -> Path:
    """Return the XML file at a path, or the shipped scene of that name.

    Raises:
        MitsonarError: there is neither.
    """
    path = Path(name_or_file)
    if os.path.isfile(path):
        return path
    shipped = shipped_scenes()
    if str(name_or_file) in shipped:
        return shipped[str(name_or_file)]
    if os.path.isdir(path):
        raise MitsonarError(f"scene {path} is a folder: give the XML file in it")
    names = nearest_names(path.stem, shipped)
    raise MitsonarError(f"no scene file {path}: give a Mitsuba XML file or the name of a shipped scene, {names}")


def load_scene(name_or_file: str | Path, **parameters: object) -> mi.Scene:
    """Load a Mitsuba scene; ``parameters`` replace its ``$name`` values, as in ``mi.load_file``.

    The scene may be a stranger's: unlike ``mi.load_file``, this loads no library from the scene's folder, and checks the
    files that the scene names before Mitsuba reads them (SECURITY.md).

    Raises:
        MitsonarError: missing file, malformed XML, an unknown plugin, a damaged mesh or picture, a plugin that refuses its
            properties, a trajectory that no shape reads.
    """
    path = find_scene(name_or_file)
    variant = ensure_variant()
    import mitsuba as mi

    try:
        scene = _loaded(path, variant, {key: str(value) for key, value in parameters.items()})
    except MitsonarError as error:
        raise MitsonarError(f"cannot load scene {path}: {error}") from None
    except Exception as error:
        raise MitsonarError(f"cannot load scene {path}: {_reason(error)}{_parameters(path, error)}") from error
    if not isinstance(scene, mi.Scene):
        raise MitsonarError(f"{path} holds a {type(scene).__name__.lower()}, not a scene: wrap it in <scene>")
    return scene


def _loaded(path: Path, variant: str, parameters: dict[str, str]) -> object:
    """Read a scene's XML, check it, and create its objects; what was checked is what is created."""
    import mitsuba as mi

    parser = mi.parser
    config = parser.ParserConfig(variant)
    config.merge_equivalent = config.merge_meshes = False  # merged meshes would lose their ids
    config.parallel = False  # in parallel, one load in some 150 failed on a good file, and none is faster
    with search_in([path.parent]):
        check_text(path, parameters, [Path(str(folder)) for folder in file_resolver()])
        state = parser.parse_file(config, str(path), **parameters)
        looked_at = parser.ParserState(state)  # a copy: Mitsuba refuses properties that nothing has looked at
        check_parsed(looked_at)
        refuse_unread_motions(looked_at)
        parser.transform_all(config, state)
        with own_code_only(node.props.plugin_name() for node in state.nodes):
            return parser.instantiate(config, state)


def shape_names_in(scene: mi.Scene) -> tuple[str, ...]:
    """Return the name of each shape of a scene, by its place there, which is its ``shape_id``.

    The name is the shape's id. Without one it is the stem of the mesh file, the id of the shape group that is placed, or
    the type of the plugin: ``pot01``, ``cannon_parts``, ``sphere``.
    """
    return tuple(shape.id() or _name_without_id(shape) for shape in scene.shapes())


def _name_without_id(shape: mi.Shape) -> str:
    kind, text = shape.class_name(), str(shape)
    named = re.search(r'^ +name = "([^"]+)"', text, flags=re.MULTILINE) if shape.is_mesh() or kind == "Instance" else None
    return Path(named[1]).stem if named else kind.lower()


def shape_boxes_in(scene: mi.Scene) -> NDArray[np.float64]:
    """Return the box around each shape of a scene: least and largest x, y, z ``(shapes, 2, 3)`` [m]."""
    boxes = [(shape.bbox().min, shape.bbox().max) for shape in scene.shapes()]
    corners = [[np.array(corner, dtype=float).ravel() for corner in box] for box in boxes]
    return np.array(corners, dtype=np.float64).reshape(-1, 2, 3)


def covered_squares_in(scene: mi.Scene) -> NDArray[np.float64]:
    """Return half the edge of the square around the origin that each shape covers, seen from above ``(shapes,)`` [m].

    Of a mesh that of its convex hull counts, of another shape that of its box; 0 where the origin is outside.
    """
    halves = []
    for shape, (low, high) in zip(scene.shapes(), shape_boxes_in(scene), strict=True):
        half = float(min(*-low[:2], *high[:2]))
        if shape.is_mesh() and half > 0:
            points = np.array(shape.vertex_positions_buffer(), dtype=float).reshape(-1, 3)[:, :2]
            try:
                normals = ConvexHull(points).equations  # n x + d <= 0 inside
            except QhullError:  # upright: it covers nothing
                normals = np.array([[1.0, 0.0, 0.0]])
            half = float((-normals[:, 2] / np.abs(normals[:, :2]).sum(axis=1)).min())
        halves.append(max(0.0, half))
    return np.array(halves, dtype=np.float64)


def object_names_in(scene: mi.Scene) -> tuple[str, ...]:
    """Return the name of each object of a scene's meshes, by the number that ``object_id`` tells: ``cubes 12``.

    An object is what a mesh numbers by its attribute ``face_id``. Number 0 is what no mesh numbers; its name is empty.
    """
    names: dict[int, str] = {}
    for shape in scene.shapes():
        if shape.is_mesh() and shape.has_attribute("face_id")[0]:
            for number in np.unique(np.array(shape.attribute_buffer("face_id"))).astype(int):
                names.setdefault(int(number), f"{shape.id()} {number}" if number else "")
    last = max(names, default=-1)
    return tuple(names.get(number, "") for number in range(last + 1)) if 0 < last < MOST_OBJECTS else ()


def sonar_in(scene: mi.Scene, index: int = 0) -> tuple[Sonar, Pose] | None:
    """Return sonar and pose of the scene's ``imaging_sonar`` number ``index``, None without one; cameras are ignored."""
    from mitsonar.plugins.imaging_sonar_sensor import is_imaging_sonar

    found = [sensor for sensor in scene.sensors() if is_imaging_sonar(sensor)]
    return (found[index].sonar, found[index].pose) if index < len(found) else None


def channel_sonar_in(scene: mi.Scene, index: int = 0) -> tuple[ChannelSonar, Pose] | None:
    """Return instrument and pose of the scene's ``channel_sonar`` number ``index``; None where there is none."""
    from mitsonar.plugins.channel_sonar_sensor import is_channel_sonar

    found = [sensor for sensor in scene.sensors() if is_channel_sonar(sensor)]
    return (found[index].sonar, found[index].pose) if index < len(found) else None


def scale_notes(scene: mi.Scene, sonar: Sonar) -> list[str]:
    """Return a sentence where sizes show that a scene is probably not in metres.

    A body counts as too large where its smallest extent exceeds :data:`TOO_LARGE` windows (floors are flat), and a window
    where it reaches farther than an imaging sonar does. A scene counts as too small where it fits into a range bin.
    """
    do = (
        'scenes are in metres; where this one is in millimetres, give its shapes <scale value="0.001"/>, or `mitsonar '
        "world mesh` --scale 0.001"
    )
    for shape in scene.shapes():
        extents = np.ravel(np.array(shape.bbox().extents(), dtype=float))
        if np.isfinite(extents).all() and extents.min() > TOO_LARGE * sonar.range_max:
            size = " x ".join(f"{edge:.3g}" for edge in extents)
            return [f"shape {shape.id()} is {size} m large, and the window of the sonar ends at {sonar.range_max:g} m: {do}"]
    if sonar.range_max > FARTHEST_WINDOW_M:
        return [f"the window ends at {sonar.range_max:g} m, farther than imaging sonars reach: {do}"]
    diagonal = float(np.linalg.norm(np.ravel(np.array(scene.bbox().extents(), dtype=float)))) if scene.shapes() else 0.0
    if 0 < diagonal < sonar.bin_m:
        return [
            f"the whole scene is {1e3 * diagonal:.3g} mm large, less than a range bin of {1e3 * sonar.bin_m:.3g} mm: scenes "
            "are in metres; give its shapes a <scale/>, or `mitsonar world mesh` a larger --scale"
        ]
    return []


def _parameters(path: Path, error: BaseException) -> str:
    """Name the parameters of a scene, where the error is an unknown one; else return nothing."""
    wrong = re.search(r"unused parameters:\s*-?\s*\$(\w+)", str(error))
    if wrong is None:
        return ""
    known = re.findall(r"<default\s+name=[\"'](\w+)[\"']", path.read_text(encoding="utf-8", errors="replace"))
    return f"; {nearest_names(wrong[1], known)}" if known else "; the scene has no parameters"


def _reason(error: BaseException) -> str:
    """Return Mitsuba's error in one line: our own error where a plugin raised one, else the text without its traceback."""
    text = str(error).strip()
    ours = re.findall(r"^mitsonar\.errors\.MitsonarError: (.+)$", text, flags=re.MULTILINE)
    if ours:
        return str(ours[-1])
    head, _, trace = text.partition("Traceback (most recent call last):")
    shown = f"{head} {trace.strip().splitlines()[-1]}" if trace.strip() else head
    words = " ".join(re.sub(r"\[\w+\.cpp:\d+\] ", "", shown).split())
    for pattern, instead in QUOTING.items():
        words = re.sub(pattern, instead, words)
    return words if len(words) <= LONGEST_REASON else f"{words[:LONGEST_REASON]}..."


# ---------------- Shapes of a scene as triangles, for those who draw it


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


# ---------------- Motions of bodies that files say: read by the ids of the shapes, from a scene's own shapes or a
# YAML file


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
        one = _loaded_motion(name, motion, folders)
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


def _loaded_motion(name: str, motion: BodyMotion, folders: Sequence[Path]) -> Any:
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
