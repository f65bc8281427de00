"""SDF: the links of a world's models, of models within models, and of included files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from mitsonar.bridges.model_files import (
    PLANE_M,
    Body,
    Matrix,
    ModelSearch,
    ReadScene,
    Shapes,
    attribute_of,
    number_of,
    numbers_of,
    placed,
    primitive,
    read_xml,
    refused,
)
from mitsonar.bridges.urdf import joint_motion
from mitsonar.errors import MitsonarError, nearest_names, shortened
from mitsonar.worlds.meshes import UNCOLOURED, Piece, one_number

__all__ = ["Scope", "pose_of", "read_sdf"]


# ---------------- Frames of SDF: poses relative to named frames, within models and models within these


OWN = ("__model__", "world", "")
"""Names of the frame of a scope itself."""

DEEPEST = 1000
"""Longest chain of frames that are relative to one another."""


def pose_of(path: Path, element: Element) -> tuple[Matrix, str]:
    """Return the child ``pose`` of an element, and the name of the frame that it is relative to; empty: the default.

    Raises:
        MitsonarError: no finite numbers, or an unknown format.
    """
    pose = element.find("pose")
    if pose is None:
        return np.eye(4), ""
    frame = pose.get("relative_to", pose.get("frame", ""))
    form = pose.get("rotation_format", "euler_rpy")
    if form == "quat_xyzw":
        numbers = numbers_of(path, element, pose.text, 7, (0, 0, 0, 0, 0, 0, 1))
        if not np.linalg.norm(numbers[3:]) >= 1e-6:
            raise refused(path, element, "the quaternion of its pose has length 0")
        return placed(numbers[:3], Rotation.from_quat(numbers[3:])), frame
    if form != "euler_rpy":
        raise refused(path, element, f"rotation_format is euler_rpy or quat_xyzw: got {shortened(form)}")
    numbers = numbers_of(path, element, pose.text, 6, (0,) * 6)
    degrees = pose.get("degrees", "false").strip().lower() in ("true", "1")
    return placed(numbers[:3], Rotation.from_euler("xyz", numbers[3:], degrees=degrees)), frame


class Scope:
    """The frames of one model, or of the world.

    Args:
        path: of the file, for errors.

    Attributes:
        nested: the models in it, by their names.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.nested: dict[str, Scope] = {}
        self._given: dict[str, tuple[str, Matrix]] = {}
        self._known: dict[str, Matrix] = {}

    def add(self, name: str, base: str, pose: Matrix) -> None:
        """Add a frame; ``base`` names the frame that its pose is relative to.

        Raises:
            MitsonarError: the name is taken.
        """
        if name in self._given or name in OWN:
            raise MitsonarError(f"{self.path}: the name {shortened(name)} is given twice, or means the model itself")
        self._given[name] = (base, pose)

    def pose(self, name: str) -> Matrix:
        """Return the pose of a frame in the axes of the scope; ``model::frame`` is one of a model in it.

        Raises:
            MitsonarError: there is no such frame, or frames are relative to each other in a circle.
        """
        chain: dict[str, Matrix] = {}
        one = name
        while one not in OWN and one not in self._known:
            if one in chain or len(chain) > DEEPEST:
                raise MitsonarError(
                    f"{self.path}: the pose of {shortened(name)} is relative to itself, or by a long way round"
                )
            base, chain[one] = self._step(one)
            one = base
        pose = self._known.get(one, np.eye(4))
        for key in reversed(chain):
            pose = pose @ chain[key]
            self._known[key] = pose
        return pose

    def _step(self, name: str) -> tuple[str, Matrix]:
        """Return the frame that a frame is given in, and its pose there."""
        if name in self._given:
            return self._given[name]
        model, _, inner = name.partition("::")
        if inner and model in self.nested:
            return model, self.nested[model].pose(inner)
        raise MitsonarError(f"{self.path} names the frame {shortened(name)}, which is not there")


# ---------------- sdf file


MOST_INCLUDES = 20
"""Longest chain of files that include one another, and of models within models."""

MOST_MODELS = 10_000
"""Models of a file with all that it includes: a short chain of files may place one very often."""

NOT_READ = ("heightmap", "polyline", "image")
"""Geometries that are left out."""


@dataclass
class _Model:
    """A model while it is read.

    Attributes:
        name: with those of the models around it: ``rov::arm``.
        file: that its files are named in.
        element: its XML.
        scope: its frames.
        models: within it.
    """

    name: str
    file: Path
    element: Element
    scope: Scope
    models: dict[str, _Model] = field(default_factory=dict)


class _Reader:
    """Reads a file and those that it includes."""

    def __init__(self, search: ModelSearch, shapes: Shapes, joints: Mapping[str, float], collision: bool) -> None:
        self.search, self.shapes, self.joints, self.collision = search, shapes, dict(joints), collision
        self.found = ReadScene()
        self.joint_names: list[str] = []
        self.models = 0

    # ---------------------------------------------------------------- models and their frames

    def model(self, file: Path, element: Element, name: str, files: tuple[Path, ...], depth: int) -> _Model:
        """Read the frames of a model, and of the models in it; geometries are read later."""
        if depth > MOST_INCLUDES:
            raise refused(file, element, f"models lie within each other more than {MOST_INCLUDES} deep")
        self.models += 1
        if self.models > MOST_MODELS:
            raise refused(file, element, f"there are more than {MOST_MODELS:,} models, with those of included files")
        made = _Model(name, file, element, Scope(file))
        for child in element:
            if child.tag in ("link", "frame", "joint"):
                self._frame(made, child)
            elif child.tag == "model":
                own = attribute_of(file, child, "name")
                self._nest(made, self.model(file, child, _joined(name, own), files, depth + 1), own, child, file)
            elif child.tag == "include":
                self._include(made, child, files, depth + 1)
            elif child.tag in ("actor", "population", "road"):
                self.found.leave_out(child.tag)
        return made

    def _frame(self, model: _Model, child: Element) -> None:
        """Add the frame of a link, a joint or a frame."""
        name = attribute_of(model.file, child, "name")
        pose, base = pose_of(model.file, child)
        if not base and child.tag == "frame":
            base = child.get("attached_to", "")
        if not base and child.tag == "joint":
            base = (child.findtext("child") or "").strip()
        model.scope.add(name, base, pose)

    def _nest(self, model: _Model, inner: _Model, own: str, placing: Element, file: Path) -> None:
        """Place a model in another: where the element that places it says, by its placement frame."""
        has_pose = placing.find("pose") is not None
        pose, base = pose_of(file, placing if has_pose else inner.element)
        frame = placing.get("placement_frame") or placing.findtext("placement_frame") or inner.element.get("placement_frame")
        if frame:
            pose = pose @ np.linalg.inv(inner.scope.pose(frame.strip()))
        model.scope.add(own, base, pose)
        model.scope.nested[own] = inner.scope
        model.models[own] = inner

    def _include(self, model: _Model, include: Element, files: tuple[Path, ...], depth: int) -> None:
        """Read an included model."""
        uri = (include.findtext("uri") or "").strip()
        if not uri:
            raise refused(model.file, include, "it names no uri")
        file = _sdf_in(self.search.find(uri, model.file), self.search)
        if file in files or len(files) > MOST_INCLUDES:
            raise refused(model.file, include, f"{file.name} includes itself, or files include each other in a long chain")
        root = _root(file)
        element = root.find("model")
        if element is None:
            self.found.leave_out(next((child.tag for child in root), "empty file"))
            return
        own = (include.findtext("name") or element.get("name") or "").strip()
        if not own:
            raise refused(file, element, "the attribute name is missing")
        inner = self.model(file, element, _joined(model.name, own), (*files, file), depth)
        self._nest(model, inner, own, include, model.file)

    # ---------------------------------------------------------------- links

    def collect(self, model: _Model, place: Matrix, within: tuple[str, ...]) -> None:
        """Collect the links of a model that lies at a place in the world, and of the models in it."""
        groups = (*within, model.name) if model.name else within
        if model.name:
            self.found.frames[model.name] = place
        moved = self._moved_links(model)
        for link in model.element.findall("link"):
            own = attribute_of(model.file, link, "name")
            name, pose = _joined(model.name, own), place @ moved[own]
            self.found.frames[name] = pose
            pieces = [
                piece
                for part in link.findall("collision" if self.collision else "visual")
                for piece in self._pieces(model.file, part, model.scope, own)
            ]
            if pieces:
                self.found.bodies.append(Body(name, pose, pieces, groups))
        for own, inner in model.models.items():
            self.collect(inner, place @ model.scope.pose(own), groups)

    def _moved_links(self, model: _Model) -> dict[str, Matrix]:
        """Return the poses of links in their model; joints with a value move their child and all that hangs on it."""
        links = [attribute_of(model.file, link, "name") for link in model.element.findall("link")]
        poses = {link: model.scope.pose(link) for link in links}
        joints: dict[str, tuple[str, Matrix]] = {}
        for joint in model.element.findall("joint"):
            name = attribute_of(model.file, joint, "name")
            parent, child = ((joint.findtext(tag) or "").strip() for tag in ("parent", "child"))
            if joint.get("type") in ("revolute", "continuous", "prismatic"):
                self.joint_names.append(_joined(model.name, name))
            value = self.joints.get(_joined(model.name, name), self.joints.get(name, 0.0))
            at = model.scope.pose(name)
            joints[child] = (parent, at @ self._turn(model, joint, value) @ np.linalg.inv(at))
        if not self.joints:
            return poses
        for link in links:
            one, seen = link, set[str]()
            while one in joints:
                if one in seen:
                    raise refused(model.file, model.element, f"the joints of link {shortened(link)} lead round in a circle")
                seen.add(one)
                one, motion = joints[one]
                poses[link] = motion @ poses[link]
        return poses

    def _turn(self, model: _Model, joint: Element, value: float) -> Matrix:
        """Return the motion of a joint in its own axes."""
        axis = joint.find("axis/xyz")
        if axis is None or value == 0:
            along: tuple[float, ...] = (0.0, 0.0, 1.0)
        else:
            along = numbers_of(model.file, joint, axis.text, 3, (0.0, 0.0, 1.0))
            frame = axis.get("expressed_in", "")
            if frame:
                turn = model.scope.pose(attribute_of(model.file, joint, "name"))[:3, :3].T @ model.scope.pose(frame)[:3, :3]
                along = tuple((turn @ along).tolist())
        return joint_motion(model.file, joint, joint.get("type", ""), along, value)

    # ---------------------------------------------------------------- what links look like

    def _pieces(self, file: Path, part: Element, scope: Scope, link: str) -> list[Piece]:
        """Return the geometry of a visual or collision in the axes of its link."""
        geometry = part.find("geometry")
        kind = None if geometry is None else next(iter(geometry), None)
        if kind is None or kind.tag == "empty":
            return []
        if kind.tag in NOT_READ or kind.find("submesh") is not None:
            self.found.leave_out("submesh" if kind.tag == "mesh" else kind.tag)
            return []
        colour = self._reflectivity(file, part)
        if kind.tag == "mesh":
            scale = numbers_of(file, kind, kind.findtext("scale"), 3, (1.0, 1.0, 1.0))
            uri = (kind.findtext("uri") or "").strip()
            pieces = self.shapes.of_file(self.search.find(uri, file), scale, colour)
        else:
            made = primitive(kind.tag, _size(file, kind), UNCOLOURED if colour is None else colour, f"{file}, <{kind.tag}>")
            pieces = self.shapes.counted([made], str(file))
        pose, base = pose_of(file, part)
        if base:
            pose = np.linalg.inv(scope.pose(link)) @ scope.pose(base) @ pose
        if kind.tag == "plane":
            normal = numbers_of(file, kind, kind.findtext("normal"), 3, (0.0, 0.0, 1.0))
            pose = pose @ _upon(file, kind, normal)
        return [piece.moved(pose[:3, :3], -pose[:3, 3]) for piece in pieces]

    def _reflectivity(self, file: Path, part: Element) -> float | None:
        """Return the reflectivity of a visual's own diffuse colour; None without one."""
        if not isinstance(self.shapes.value, str):
            return float(self.shapes.value)
        text = part.findtext("material/diffuse")
        if text is None:
            return None
        rgb = numbers_of(file, part, " ".join(text.split()[:3]), 3, (0.7, 0.7, 0.7))
        return float(one_number(np.clip(np.array([rgb]), 0, 1), self.shapes.value)[0])


def read_sdf(
    path: Path, search: ModelSearch, shapes: Shapes, joints: Mapping[str, float], collision: bool = False
) -> ReadScene:
    """Read the links of an SDF file, of a world or of models.

    Args:
        path: of the file.
        search: finds its meshes, and the models that it includes.
        shapes: reads geometries.
        joints: value of joints by name [rad, m], ``arm`` or ``rov::arm``; others are at 0.
        collision: whether the collision shapes are read, in place of the visual ones.

    Raises:
        MitsonarError: the file is damaged, or names what is not there.
    """
    root = _root(path)
    worlds = root.findall("world")
    if len(worlds) > 1:
        raise MitsonarError(f"{path} holds {len(worlds)} worlds: leave all but one out")
    reader = _Reader(search, shapes, joints, collision)
    top = worlds[0] if worlds else root
    whole = reader.model(path, top, "", (path.resolve(),), 0)
    reader.collect(whole, np.eye(4), ())
    for name in joints:
        if name not in reader.joint_names and not any(one.endswith(f"::{name}") for one in reader.joint_names):
            there = nearest_names(name, reader.joint_names) if reader.joint_names else "it has none"
            raise MitsonarError(f"{path} has no joint {shortened(name)} that moves: {there}")
    return reader.found


def _root(path: Path) -> Element:
    root = read_xml(path, "SDF file")
    if root.tag != "sdf":
        raise MitsonarError(f"{path} is no SDF file: its first element is <{root.tag[:40]}>, not <sdf>")
    return root


def _joined(model: str, name: str) -> str:
    return f"{model}::{name}" if model else name


def _sdf_in(found: Path, search: ModelSearch) -> Path:
    """Return the SDF file of a model's folder: the newest that its model.config names, or model.sdf."""
    if found.is_file():
        return found
    config = found / "model.config"
    if not config.is_file():
        return search.find(str(found / "model.sdf"), found)
    tree = read_xml(config, "model.config")
    files = [(one.get("version", ""), (one.text or "").strip()) for one in tree.findall("sdf")]
    if not files:
        raise MitsonarError(f"{config} names no sdf file")
    newest = max(files, key=lambda file: [int(part) if part.isdecimal() else 0 for part in file[0][:20].split(".")])
    return search.find(newest[1], config)


def _size(path: Path, kind: Element) -> dict[str, float]:
    """Return the sizes of a primitive."""
    if kind.tag == "box":
        return dict(zip("xyz", numbers_of(path, kind, kind.findtext("size"), 3, (1.0, 1.0, 1.0)), strict=True))
    if kind.tag == "ellipsoid":
        return dict(zip("xyz", numbers_of(path, kind, kind.findtext("radii"), 3, (1.0, 1.0, 1.0)), strict=True))
    if kind.tag == "plane":
        return dict(zip("xy", numbers_of(path, kind, kind.findtext("size"), 2, (PLANE_M, PLANE_M)), strict=True))
    keys = {"sphere": ("radius",), **dict.fromkeys(("cylinder", "capsule", "cone"), ("radius", "length"))}
    if kind.tag not in keys:
        raise refused(
            path, kind, f"geometries are box, sphere, cylinder, capsule, ellipsoid, cone, plane, mesh: got {kind.tag[:40]}"
        )
    return {key: number_of(path, kind, kind.findtext(key), 1.0) for key in keys[kind.tag]}


def _upon(path: Path, kind: Element, normal: tuple[float, ...]) -> Matrix:
    """Return the turn of a plane whose normal is not z."""
    length = float(np.linalg.norm(normal))
    if not length >= 1e-9:
        raise refused(path, kind, "its normal has length 0")
    z = np.asarray(normal) / length
    x = np.cross((0.0, 1.0, 0.0), z) if abs(z[1]) < 0.9 else np.cross((0.0, 0.0, 1.0), z)
    x = x / np.linalg.norm(x)
    made = np.eye(4)
    made[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    return made
