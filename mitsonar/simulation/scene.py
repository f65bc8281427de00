"""Scenes from Mitsuba XML files, the user's or shipped ones, and the sonar in them."""

from __future__ import annotations

import os
import re
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.plugins.native_plugins import file_resolver, own_code_only, search_in
from mitsonar.simulation.moving_files import refuse_unread_motions
from mitsonar.simulation.variant import ensure_variant
from mitsonar.worlds.scene_check import check_parsed, check_text

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = [
    "channel_sonar_in",
    "covered_squares_in",
    "find_scene",
    "load_scene",
    "object_names_in",
    "scale_notes",
    "shape_boxes_in",
    "shape_names_in",
    "shipped_scenes",
    "shipped_trajectory",
    "sonar_in",
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
