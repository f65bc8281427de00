"""How a scene is loaded and what it contains: names, boxes, sonars, triangles and the motion of its shapes.

Scenes are Mitsuba XML files, either the user's or those shipped with the package.
"""

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

from mitsonar.errors import MitsonarError, argument, suggest_names
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
    "MotionSpec",
    "Triangles",
    "channel_sonar_in",
    "covered_squares_in",
    "digests_of",
    "find_scene",
    "load_meshes",
    "load_motions",
    "load_scene",
    "motion_specs_in",
    "motion_specs_of",
    "motions_of",
    "object_names_in",
    "read_motion_specs",
    "refuse_unread_motions",
    "scale_notes",
    "shape_boxes_in",
    "shape_names_in",
    "shipped_scenes",
    "shipped_trajectory",
    "sonar_in",
    "triangles_in",
]


MOST_OBJECTS = 1_000_000
"""Largest number of objects that get names; beyond it, objects are known by number only."""

QUOTING = {
    r"(failed to load spectrum from file \".*?\"): .*": r"\1: it must hold a wavelength and a value in each line",
    r"(Error while loading .*? curve\(s\) from \".*?\"): .*": r"\1: it must hold x, y, z and a radius in each line",
}
"""Patterns of Mitsuba errors that quote the contents of a file named by the scene, and what is shown instead."""

LONGEST_REASON = 600
"""Number of characters of a Mitsuba error that are shown."""


TOO_LARGE = 20
"""Smallest extent of a shape, in multiples of the far end of the window, above which its unit is doubted."""

FARTHEST_WINDOW_M = 500.0
"""Far end of a window beyond the reach of imaging sonars [m]: those of 100 kHz see a few hundred metres."""


def shipped_scenes() -> dict[str, Path]:
    """Return the scene files shipped with the package, keyed by name; a trajectory of the same name accompanies each."""
    folder = Path(str(files("mitsonar.scenes")))
    return {path.stem: path for path in sorted(folder.glob("*.xml"))}


def shipped_trajectory(name: str) -> Path:
    """Return the trajectory file (TUM format) of a shipped scene.

    Raises:
        MitsonarError: there is no such scene.
    """
    return find_scene(name).with_suffix(".tum")


def find_scene(name_or_file: str | Path) -> Path:
    """Return the XML file at a path, or the shipped scene of that name.

    Raises:
        MitsonarError: neither exists.
    """
    path = Path(name_or_file)
    if os.path.isfile(path):
        return path
    shipped = shipped_scenes()
    if str(name_or_file) in shipped:
        return shipped[str(name_or_file)]
    if os.path.isdir(path):
        raise MitsonarError(f"scene {path} is a folder: give the XML file in it")
    names = suggest_names(path.stem, shipped)
    raise MitsonarError(f"no scene file {path}: give a Mitsuba XML file or the name of a shipped scene, {names}")


def load_scene(name_or_file: str | Path, **parameters: object) -> mi.Scene:
    """Load a Mitsuba scene; ``parameters`` replace its ``$name`` values, as in ``mi.load_file``.

    The scene may come from an untrusted source. Unlike ``mi.load_file``, this function loads no library from the scene's
    folder, and it checks the files that the scene names before Mitsuba reads them (SECURITY.md).

    Raises:
        MitsonarError: the file is missing or is malformed XML; a plugin is unknown or rejects its properties; a mesh or
            picture is damaged; no shape reads a trajectory.
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
    """Parse a scene's XML, check it, and create its objects from the same parsed state that was checked."""
    import mitsuba as mi

    parser = mi.parser
    config = parser.ParserConfig(variant)
    config.merge_equivalent = config.merge_meshes = False  # merged meshes would lose their ids
    config.parallel = False  # in parallel, about one load in 150 failed on a valid file, and none was faster
    with search_in([path.parent]):
        check_text(path, parameters, [Path(str(folder)) for folder in file_resolver()])
        state = parser.parse_file(config, str(path), **parameters)
        checked = parser.ParserState(state)  # a copy: Mitsuba rejects properties that nothing has queried
        check_parsed(checked)
        refuse_unread_motions(checked)
        parser.transform_all(config, state)
        with own_code_only(node.props.plugin_name() for node in state.nodes):
            return parser.instantiate(config, state)


def shape_names_in(scene: mi.Scene) -> tuple[str, ...]:
    """Return the name of each shape of a scene, indexed by ``shape_id``, its position in the scene.

    The name is the shape's id. A shape without an id is named after its mesh file, the shape group that it instantiates,
    or its plugin type, for example ``pot01``, ``cannon_parts`` or ``sphere``.
    """
    return tuple(shape.id() or _name_without_id(shape) for shape in scene.shapes())


def _name_without_id(shape: mi.Shape) -> str:
    kind, text = shape.class_name(), str(shape)
    named = re.search(r'^ +name = "([^"]+)"', text, flags=re.MULTILINE) if shape.is_mesh() or kind == "Instance" else None
    return Path(named[1]).stem if named else kind.lower()


def shape_boxes_in(scene: mi.Scene) -> NDArray[np.float64]:
    """Return the bounding box of each shape of a scene: minimum and maximum x, y, z ``(shapes, 2, 3)`` [m]."""
    boxes = [(shape.bbox().min, shape.bbox().max) for shape in scene.shapes()]
    corners = [[np.array(corner, dtype=float).ravel() for corner in box] for box in boxes]
    return np.array(corners, dtype=np.float64).reshape(-1, 2, 3)


def covered_squares_in(scene: mi.Scene) -> NDArray[np.float64]:
    """Return half the edge of the largest square around the origin that each shape covers from above ``(shapes,)`` [m].

    A mesh is represented by its convex hull, any other shape by its bounding box. The value is 0 if the origin lies outside.
    """
    halves = []
    for shape, (low, high) in zip(scene.shapes(), shape_boxes_in(scene), strict=True):
        half = float(min(*-low[:2], *high[:2]))
        if shape.is_mesh() and half > 0:
            points = np.array(shape.vertex_positions_buffer(), dtype=float).reshape(-1, 3)[:, :2]
            try:
                normals = ConvexHull(points).equations  # n x + d <= 0 inside
            except QhullError:  # an upright mesh covers nothing
                normals = np.array([[1.0, 0.0, 0.0]])
            half = float((-normals[:, 2] / np.abs(normals[:, :2]).sum(axis=1)).min())
        halves.append(max(0.0, half))
    return np.array(halves, dtype=np.float64)


def object_names_in(scene: mi.Scene) -> tuple[str, ...]:
    """Return the name of each object of a scene's meshes, indexed by ``object_id``, for example ``cubes 12``.

    A mesh numbers its objects in the attribute ``face_id``. Number 0 means that no mesh numbers the object; its name is
    empty.
    """
    names: dict[int, str] = {}
    for shape in scene.shapes():
        if shape.is_mesh() and shape.has_attribute("face_id")[0]:
            for number in np.unique(np.array(shape.attribute_buffer("face_id"))).astype(int):
                names.setdefault(int(number), f"{shape.id()} {number}" if number else "")
    last = max(names, default=-1)
    return tuple(names.get(number, "") for number in range(last + 1)) if 0 < last < MOST_OBJECTS else ()


def sonar_in(scene: mi.Scene, index: int = 0) -> tuple[Sonar, Pose] | None:
    """Return sonar and pose of the scene's ``imaging_sonar`` number ``index``; None if there is none.

    Cameras are ignored.
    """
    from mitsonar.plugins.imaging_sonar_sensor import is_imaging_sonar

    sonars = [sensor for sensor in scene.sensors() if is_imaging_sonar(sensor)]
    return (sonars[index].sonar, sonars[index].pose) if index < len(sonars) else None


def channel_sonar_in(scene: mi.Scene, index: int = 0) -> tuple[ChannelSonar, Pose] | None:
    """Return instrument and pose of the scene's ``channel_sonar`` number ``index``; None if there is none."""
    from mitsonar.plugins.channel_sonar_sensor import is_channel_sonar

    sonars = [sensor for sensor in scene.sensors() if is_channel_sonar(sensor)]
    return (sonars[index].sonar, sonars[index].pose) if index < len(sonars) else None


def scale_notes(scene: mi.Scene, sonar: Sonar) -> list[str]:
    """Return a warning if the sizes in a scene suggest that it is not in metres; an empty list otherwise.

    A shape is too large if its smallest extent (floors are flat) exceeds :data:`TOO_LARGE` times the far end of the window.
    A window is too long if it ends beyond :data:`FARTHEST_WINDOW_M`. A scene is too small if it fits into a range bin.
    """
    advice = (
        'scenes are in metres; if this one is in millimetres, give its shapes <scale value="0.001"/>, or `mitsonar '
        "world mesh` --scale 0.001"
    )
    for shape in scene.shapes():
        extents = np.ravel(np.array(shape.bbox().extents(), dtype=float))
        if np.isfinite(extents).all() and extents.min() > TOO_LARGE * sonar.range_max:
            size = " x ".join(f"{edge:.3g}" for edge in extents)
            return [
                f"shape {shape.id()} is {size} m large, and the window of the sonar ends at {sonar.range_max:g} m: {advice}"
            ]
    if sonar.range_max > FARTHEST_WINDOW_M:
        return [f"the window ends at {sonar.range_max:g} m, farther than imaging sonars reach: {advice}"]
    diagonal = float(np.linalg.norm(np.ravel(np.array(scene.bbox().extents(), dtype=float)))) if scene.shapes() else 0.0
    if 0 < diagonal < sonar.bin_m:
        return [
            f"the whole scene is {1e3 * diagonal:.3g} mm large, less than a range bin of {1e3 * sonar.bin_m:.3g} mm: scenes "
            "are in metres; give its shapes a <scale/>, or `mitsonar world mesh` a larger --scale"
        ]
    return []


def _parameters(path: Path, error: BaseException) -> str:
    """Suggest the known parameters of a scene if the error is an unknown parameter; otherwise return an empty string."""
    unknown = re.search(r"unused parameters:\s*-?\s*\$(\w+)", str(error))
    if unknown is None:
        return ""
    known = re.findall(r"<default\s+name=[\"'](\w+)[\"']", path.read_text(encoding="utf-8", errors="replace"))
    return f"; {suggest_names(unknown[1], known)}" if known else "; the scene has no parameters"


def _reason(error: BaseException) -> str:
    """Condense a Mitsuba error to one line: the MitsonarError a plugin raised, else the text without its traceback."""
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


# ---------------- Shapes as triangles, for drawing


MOST_FACES = 300_000
"""Largest number of faces of a mesh that is drawn; a larger mesh is drawn as its bounding box."""

STEPS = 24
"""Number of segments that approximate a circle."""

BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
BOX_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


class Triangles(NamedTuple):
    """Triangle mesh of one shape.

    Attributes:
        name: id of the shape.
        vertices: world coordinates ``(vertices, 3)`` [m].
        faces: three vertex indices per triangle ``(faces, 3)``.
        whole: False if the mesh is only the bounding box of the shape.
    """

    name: str
    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    whole: bool


def triangles_in(scene: mi.Scene) -> list[Triangles]:
    """Return all shapes of a scene as triangles.

    Meshes of up to :data:`MOST_FACES` faces are returned unchanged. Rectangles, disks, cylinders and spheres are
    approximated. Every other shape, such as an instance, is replaced by its bounding box.
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
    """Triangulate a surface sampled at points ``(rows, columns, 3)``; return vertices and faces."""
    rows, columns = points.shape[:2]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, below = corner + 1, corner + columns
    faces = np.concatenate([np.stack([corner, right, below], 1), np.stack([right, below + 1, below], 1)])
    return points.reshape(-1, 3), faces


def _round(radius: NDArray[np.float64], height: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Triangulate a surface of revolution about z, given radius and height along its profile."""
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
"""Vertices and faces of Mitsuba's analytic shapes in object coordinates, keyed by class name."""


# ---------------- Motion of shapes: from the scene or a YAML file


STAYS = Trajectory(np.zeros((1, 6)), np.zeros(1))
"""Trajectory of a body that stays where the scene places it."""

BYTES_A_VERTEX = 12
"""Memory of one vertex: three float32 coordinates."""


class MotionSpec(NamedTuple):
    """Motion specification of one shape, before its files are read.

    Attributes:
        name: id of the shape.
        motion: motion of the shape.
        folders: folders in which to look for the files that the motion names, in this order.
    """

    name: str
    motion: BodyMotion
    folders: Sequence[Path]


def load_motions(file: str | Path) -> dict[str, Any]:
    """Read the motions in a YAML file, in the form of ``moving`` of :class:`mitsonar.Simulator`.

    Paths in the file are relative to its folder.

    Raises:
        MitsonarError: a file is unreadable, or has wrong keys.
    """
    return read_motion_specs(motion_specs_in(file))


def motions_of(scene: mi.Scene) -> dict[str, Any]:
    """Return the motion of every moving shape of a scene, keyed by shape id; empty if nothing moves.

    Raises:
        MitsonarError: a file is unreadable, or the scene has wrong keys.
    """
    return read_motion_specs(motion_specs_of(scene))


def motion_specs_in(file: str | Path) -> list[MotionSpec]:
    """Return the motion specifications in a YAML file, without reading the files that they name."""
    return [MotionSpec(name, motion, [Path(file).parent]) for name, motion in read_motions(file).items()]


def motion_specs_of(scene: mi.Scene) -> list[MotionSpec]:
    """Return the motion specifications of the shapes of a scene, without reading the files that they name."""
    from mitsonar.plugins.trajectory_texture import MOTION

    specs = []
    for shape in scene.shapes():
        if not shape.has_attribute(MOTION)[0]:
            continue
        texture: Any = shape.texture_attribute(MOTION)
        fields = getattr(texture, "fields", None)
        if fields is None:
            raise MitsonarError(f"the texture {MOTION} of {shape.id()} must be a trajectory: see docs/guides/moving.md")
        specs.append(MotionSpec(shape.id(), BodyMotion.create(shape.id(), fields), texture.folders))
    return specs


def read_motion_specs(specs: Sequence[MotionSpec]) -> dict[str, Any]:
    """Read the files that motion specifications name, and return the motions keyed by shape id.

    Raises:
        MitsonarError: a file is unreadable; a shape that deforms or follows the vehicle has several motions.
    """
    motions: dict[str, Any] = {}
    for name, motion, folders in specs:
        loaded = _loaded_motion(name, motion, folders)
        if name in motions and not (isinstance(loaded, list) and isinstance(motions[name], list)):
            raise MitsonarError(f"moving: {name} deforms or follows the vehicle, and can have only one motion: give it one")
        motions[name] = motions[name] + loaded if name in motions else loaded
    return motions


def digests_of(specs: Sequence[MotionSpec]) -> dict[str, str]:
    """Return a digest of each shape's motion, over its specification and its files, keyed by shape id."""
    digests: dict[str, str] = {}
    for name, motion, folders in specs:
        named = [file_name for file_name in (motion.path, motion.meshes) if file_name and file_name != VEHICLE]
        parts = [
            motion.model_dump_json(),
            *(file_digest(file) for file_name in named for file in _files_named(file_name, folders)),
        ]
        digests[name] = digest(digests.get(name, "").encode(), *(part.encode() for part in parts))
    return digests


def refuse_unread_motions(state: mi.parser.ParserState) -> None:
    """Reject a ``trajectory`` texture that no shape holds under the name ``motion``; Mitsuba ignores it silently.

    Args:
        state: parser state of the scene, not instantiated yet.

    Raises:
        MitsonarError: there is such a texture.
    """
    import mitsuba as mi

    from mitsonar.plugins.trajectory_texture import MOTION

    kinds = mi.Properties.Type
    paths = [number for number, node in enumerate(state.nodes) if node.props.plugin_name() == "trajectory"]
    ids = {state.nodes[number].props.id() for number in paths} - {""}
    for node in state.nodes if paths else ():
        if node.type == mi.ObjectType.Scene:  # a texture there is only a target of references
            continue
        for name in list(node.props):
            kind, value = node.props.type(name), node.props[name]
            inside = kind == kinds.ResolvedReference and value.index() in paths
            named = kind == kinds.Reference and value.id() in ids
            if (inside or named) and (name != MOTION or node.type != mi.ObjectType.Shape):
                shown = "without a name" if name.startswith("_arg_") else f'with name="{name[:80]}"'
                where = f"{node.props.plugin_name()} {node.props.id()}".strip()
                raise MitsonarError(
                    f"the texture trajectory in {where} is given {shown}, so nothing would move: write "
                    f'name="{MOTION}", in a shape'
                )


def load_meshes(files: Sequence[Path], rate_hz: float, *, loop: bool = True) -> MeshSequence:
    """Read a sequence of PLY meshes that share their triangles, the successive states of a deforming body.

    Args:
        files: mesh files in order of time.
        rate_hz: meshes per second.
        loop: whether the first mesh follows the last.

    Raises:
        MitsonarError: there is no mesh; a mesh is damaged or has other triangles; the sequence exceeds the memory.
    """
    if isinstance(files, str | Path) or not len(files):
        raise MitsonarError(f"{argument('files')} must be a list of PLY meshes in the order of time: got {str(files)!r}")
    first, faces = _mesh(files[0])
    refuse_beyond_memory(len(files) * len(first) * BYTES_A_VERTEX, f"{len(files)} meshes like {files[0]}")
    vertices = np.empty((len(files), *first.shape), np.float32)
    for number, file in enumerate(files):
        positions, triangles = _mesh(file)
        if positions.shape != first.shape or not np.array_equal(triangles, faces):
            raise MitsonarError(
                f"{file} has other triangles than {files[0]}: the meshes of a deforming body must share them"
            )
        vertices[number] = positions
    return MeshSequence(vertices, rate_hz, loop)


def _mesh(file: Path) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Read vertices and triangles of a PLY file."""
    import mitsuba as mi

    check_mesh(file, "ply")
    values = mi.traverse(load_dict({"type": "ply", "filename": str(file)}))
    return np.array(values["vertex_positions"]).reshape(-1, 3), np.array(values["faces"])


def _loaded_motion(name: str, motion: BodyMotion, folders: Sequence[Path]) -> Any:
    """Read the motion of a shape, in the form that :class:`mitsonar.Simulator` takes."""
    if motion.path == VEHICLE and motion.meshes is None:
        return VEHICLE
    if motion.path == VEHICLE:
        raise MitsonarError(f"moving: {name} follows the vehicle and deforms: give it a separate path")
    files = [] if motion.path is None else _files_named(motion.path, folders)
    paths = [Trajectory.load(file, motion.frame, looks_ahead=False) for file in files] or [STAYS]
    if motion.meshes is None:
        return paths
    if len(paths) > 1:
        raise MitsonarError(f"moving: {name} deforms and has {len(paths)} paths: give each body a separate shape")
    return Deforming(paths[0], load_meshes(_files_named(motion.meshes, folders), motion.rate_hz, loop=motion.loop))


def _files_named(name: str, folders: Sequence[Path]) -> list[Path]:
    """Return the files that a name denotes, in the first folder that contains all of them."""
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
