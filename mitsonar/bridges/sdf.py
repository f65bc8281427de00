"""How an SDF file is read: the links of a world's models, of nested models, and of included files."""

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
from mitsonar.errors import MitsonarError, short_repr, suggest_names
from mitsonar.worlds.meshes import UNCOLOURED, Piece, reduce_colour

__all__ = ["Scope", "pose_of", "read_sdf"]


# ---------------- Frames


SELF_NAMES = ("__model__", "world", "")
"""Names that refer to the frame of the scope itself."""

MAX_CHAIN = 1000
"""Largest length of a chain of frames that are relative to one another."""


def pose_of(path: Path, element: Element) -> tuple[Matrix, str]:
    """Return the pose of an element, and the name of the frame that it is relative to (empty: the default frame).

    Raises:
        MitsonarError: the child ``pose`` has no finite numbers, or an unknown format.
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
        raise refused(path, element, f"rotation_format must be euler_rpy or quat_xyzw: got {short_repr(form)}")
    numbers = numbers_of(path, element, pose.text, 6, (0,) * 6)
    degrees = pose.get("degrees", "false").strip().lower() in ("true", "1")
    return placed(numbers[:3], Rotation.from_euler("xyz", numbers[3:], degrees=degrees)), frame


class Scope:
    """The frames of one model, or of the world.

    Args:
        path: the file, for error messages.

    Attributes:
        nested: scopes of the nested models, keyed by name.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.nested: dict[str, Scope] = {}
        self._definitions: dict[str, tuple[str, Matrix]] = {}
        self._poses: dict[str, Matrix] = {}

    def add(self, name: str, base: str, pose: Matrix) -> None:
        """Add a frame whose pose is relative to the frame ``base``.

        Raises:
            MitsonarError: the name is already in use.
        """
        if name in self._definitions or name in SELF_NAMES:
            raise MitsonarError(
                f"{self.path}: the name {short_repr(name)} is given twice, or is reserved for the model itself"
            )
        self._definitions[name] = (base, pose)

    def pose(self, name: str) -> Matrix:
        """Return the pose of a frame in the axes of the scope; ``model::frame`` is a frame of a nested model.

        Raises:
            MitsonarError: there is no such frame, or frames are relative to each other in a circle.
        """
        chain: dict[str, Matrix] = {}
        frame = name
        while frame not in SELF_NAMES and frame not in self._poses:
            if frame in chain or len(chain) > MAX_CHAIN:
                raise MitsonarError(
                    f"{self.path}: the pose of {short_repr(name)} is relative to itself, or "
                    f"has a chain of more than {MAX_CHAIN} frames"
                )
            base, chain[frame] = self._base_of(frame)
            frame = base
        pose = self._poses.get(frame, np.eye(4))
        for key in reversed(chain):
            pose = pose @ chain[key]
            self._poses[key] = pose
        return pose

    def _base_of(self, name: str) -> tuple[str, Matrix]:
        """Return the name of the frame that a frame is relative to, and its pose there."""
        if name in self._definitions:
            return self._definitions[name]
        model, _, inner = name.partition("::")
        if inner and model in self.nested:
            return model, self.nested[model].pose(inner)
        raise MitsonarError(f"{self.path} names the frame {short_repr(name)}, which does not exist")


# ---------------- Models, links and geometries


MAX_NESTING = 20
"""Largest depth of nested includes, and of nested models."""

MAX_MODELS = 10_000
"""Largest number of models including those of included files, since a few files can place a model very often."""

UNSUPPORTED = ("heightmap", "polyline", "image")
"""Geometries that are left out."""


@dataclass
class _Model:
    """A model that is being read.

    Attributes:
        name: name with those of the models around it, such as ``rov::arm``.
        file: file that contains the model; the names of its meshes are relative to it.
        element: XML element of the model.
        scope: frames of the model.
        models: nested models, keyed by name.
    """

    name: str
    file: Path
    element: Element
    scope: Scope
    models: dict[str, _Model] = field(default_factory=dict)


class _Reader:
    """A reader of an SDF file and the files that it includes."""

    def __init__(self, search: ModelSearch, shapes: Shapes, joints: Mapping[str, float], collision: bool) -> None:
        self.search, self.shapes, self.joints, self.collision = search, shapes, dict(joints), collision
        self.scene = ReadScene()
        self.joint_names: list[str] = []
        self.models = 0

    # ---------------- Models and their frames

    def model(self, file: Path, element: Element, name: str, files: tuple[Path, ...], depth: int) -> _Model:
        """Read the frames of a model and of its nested models; geometries are read later."""
        if depth > MAX_NESTING:
            raise refused(file, element, f"models are nested more than {MAX_NESTING} deep")
        self.models += 1
        if self.models > MAX_MODELS:
            raise refused(file, element, f"there are more than {MAX_MODELS:,} models, with those of included files")
        model = _Model(name, file, element, Scope(file))
        for child in element:
            if child.tag in ("link", "frame", "joint"):
                self._frame(model, child)
            elif child.tag == "model":
                child_name = attribute_of(file, child, "name")
                self._nest(
                    model, self.model(file, child, _joined(name, child_name), files, depth + 1), child_name, child, file
                )
            elif child.tag == "include":
                self._include(model, child, files, depth + 1)
            elif child.tag in ("actor", "population", "road"):
                self.scene.leave_out(child.tag)
        return model

    def _frame(self, model: _Model, child: Element) -> None:
        """Add the frame that a link, joint or frame element defines."""
        name = attribute_of(model.file, child, "name")
        pose, base = pose_of(model.file, child)
        if not base and child.tag == "frame":
            base = child.get("attached_to", "")
        if not base and child.tag == "joint":
            base = (child.findtext("child") or "").strip()
        model.scope.add(name, base, pose)

    def _nest(self, model: _Model, inner: _Model, name: str, placement: Element, file: Path) -> None:
        """Place a model in another, at the pose of the element ``placement``; the pose applies to the placement frame."""
        has_pose = placement.find("pose") is not None
        pose, base = pose_of(file, placement if has_pose else inner.element)
        frame = (
            placement.get("placement_frame") or placement.findtext("placement_frame") or inner.element.get("placement_frame")
        )
        if frame:
            pose = pose @ np.linalg.inv(inner.scope.pose(frame.strip()))
        model.scope.add(name, base, pose)
        model.scope.nested[name] = inner.scope
        model.models[name] = inner

    def _include(self, model: _Model, include: Element, files: tuple[Path, ...], depth: int) -> None:
        """Read an included model."""
        uri = (include.findtext("uri") or "").strip()
        if not uri:
            raise refused(model.file, include, "it has no uri")
        file = _sdf_file(self.search.find(uri, model.file), self.search)
        if file in files or len(files) > MAX_NESTING:
            raise refused(model.file, include, f"{file.name} includes itself, or files include each other in a long chain")
        root = _root(file)
        element = root.find("model")
        if element is None:
            self.scene.leave_out(next((child.tag for child in root), "empty file"))
            return
        name = (include.findtext("name") or element.get("name") or "").strip()
        if not name:
            raise refused(file, element, "the attribute name is missing")
        inner = self.model(file, element, _joined(model.name, name), (*files, file), depth)
        self._nest(model, inner, name, include, model.file)

    # ---------------- Links

    def collect(self, model: _Model, model_pose: Matrix, parents: tuple[str, ...]) -> None:
        """Collect the links of a model and of its nested models; ``model_pose`` is the pose of the model in the world."""
        groups = (*parents, model.name) if model.name else parents
        if model.name:
            self.scene.frames[model.name] = model_pose
        link_poses = self._link_poses(model)
        for link in model.element.findall("link"):
            link_name = attribute_of(model.file, link, "name")
            name, pose = _joined(model.name, link_name), model_pose @ link_poses[link_name]
            self.scene.frames[name] = pose
            pieces = [
                piece
                for element in link.findall("collision" if self.collision else "visual")
                for piece in self._pieces(model.file, element, model.scope, link_name)
            ]
            if pieces:
                self.scene.bodies.append(Body(name, pose, pieces, groups))
        for model_name, inner in model.models.items():
            self.collect(inner, model_pose @ link_poses[model_name], groups)

    def _link_poses(self, model: _Model) -> dict[str, Matrix]:
        """Return the poses of links and nested models in their model.

        Joints with a value move their child and everything attached to it. A joint to a link of a nested model moves that
        model.
        """
        # 1. Collect the parent of each link, and the motion of the joint between them in the axes of the model.
        links = [attribute_of(model.file, link, "name") for link in model.element.findall("link")]
        poses = {name: model.scope.pose(name) for name in (*links, *model.models)}
        joints: dict[str, tuple[str, Matrix]] = {}
        for joint in model.element.findall("joint"):
            name = attribute_of(model.file, joint, "name")
            ends = [(joint.findtext(tag) or "").strip() for tag in ("parent", "child")]
            parent, child = (nested if (nested := end.partition("::")[0]) in model.models else end for end in ends)
            if joint.get("type") in ("revolute", "continuous", "prismatic"):
                self.joint_names.append(_joined(model.name, name))
            value = self.joints.get(_joined(model.name, name), self.joints.get(name, 0.0))
            joint_pose = model.scope.pose(name)
            motion = joint_pose @ self._joint_transform(model, joint, value) @ np.linalg.inv(joint_pose)
            if parent != child or child in links:  # not between two links of one nested model
                joints[child] = (parent, motion)
        # 2. Apply the motions of all joints between each link and the root.
        if not self.joints:
            return poses
        for link in poses:
            ancestor, seen = link, set[str]()
            while ancestor in joints:
                if ancestor in seen:
                    raise refused(model.file, model.element, f"the joints of link {short_repr(link)} form a circle")
                seen.add(ancestor)
                ancestor, motion = joints[ancestor]
                poses[link] = motion @ poses[link]
        return poses

    def _joint_transform(self, model: _Model, joint: Element, value: float) -> Matrix:
        """Return the transform by which a joint moves its child, in the axes of the joint."""
        axis = joint.find("axis/xyz")
        if axis is None or value == 0:
            direction: tuple[float, ...] = (0.0, 0.0, 1.0)
        else:
            direction = numbers_of(model.file, joint, axis.text, 3, (0.0, 0.0, 1.0))
            frame = axis.get("expressed_in", "")
            if frame:
                rotation = (
                    model.scope.pose(attribute_of(model.file, joint, "name"))[:3, :3].T @ model.scope.pose(frame)[:3, :3]
                )
                direction = tuple((rotation @ direction).tolist())
        return joint_motion(model.file, joint, joint.get("type", ""), direction, value)

    # ---------------- Geometries and colours of links

    def _pieces(self, file: Path, element: Element, scope: Scope, link: str) -> list[Piece]:
        """Return the geometries of a visual or collision element, in the axes of its link."""
        geometry = element.find("geometry")
        kind = None if geometry is None else next(iter(geometry), None)
        if kind is None or kind.tag == "empty":
            return []
        if kind.tag in UNSUPPORTED or kind.find("submesh") is not None:
            self.scene.leave_out("submesh" if kind.tag == "mesh" else kind.tag)
            return []
        colour = self._reflectivity(file, element)
        if kind.tag == "mesh":
            scale = numbers_of(file, kind, kind.findtext("scale"), 3, (1.0, 1.0, 1.0))
            uri = (kind.findtext("uri") or "").strip()
            pieces = self.shapes.of_file(self.search.find(uri, file), scale, colour)
        else:
            solid = primitive(kind.tag, _size(file, kind), UNCOLOURED if colour is None else colour, f"{file}, <{kind.tag}>")
            pieces = self.shapes.count_noun([solid], str(file))
        pose, base = pose_of(file, element)
        if base:
            pose = np.linalg.inv(scope.pose(link)) @ scope.pose(base) @ pose
        if kind.tag == "plane":
            normal = numbers_of(file, kind, kind.findtext("normal"), 3, (0.0, 0.0, 1.0))
            pose = pose @ _rotation_to_normal(file, kind, normal)
        return [piece.moved(pose[:3, :3], -pose[:3, 3]) for piece in pieces]

    def _reflectivity(self, file: Path, element: Element) -> float | None:
        """Return the reflectivity of the diffuse colour of a visual; None without a colour."""
        if not isinstance(self.shapes.value, str):
            return float(self.shapes.value)
        text = element.findtext("material/diffuse")
        if text is None:
            return None
        rgb = numbers_of(file, element, " ".join(text.split()[:3]), 3, (0.7, 0.7, 0.7))
        return float(reduce_colour(np.clip(np.array([rgb]), 0, 1), self.shapes.value)[0])


def read_sdf(
    path: Path, search: ModelSearch, shapes: Shapes, joints: Mapping[str, float], collision: bool = False
) -> ReadScene:
    """Read the links of an SDF file, which contains a world or models.

    Args:
        path: SDF file.
        search: search for its meshes, and for the models that it includes.
        shapes: reader of geometries.
        joints: values of joints, keyed by name such as ``arm`` or ``rov::arm`` [rad, m]; others are at 0.
        collision: whether to read the collision shapes instead of the visual ones.

    Raises:
        MitsonarError: the file is damaged, or refers to something that is missing.
    """
    root = _root(path)
    worlds = root.findall("world")
    if len(worlds) > 1:
        raise MitsonarError(f"{path} contains {len(worlds)} worlds: keep only one")
    reader = _Reader(search, shapes, joints, collision)
    root_element = worlds[0] if worlds else root
    model = reader.model(path, root_element, "", (path.resolve(),), 0)
    reader.collect(model, np.eye(4), ())
    for name in joints:
        if name not in reader.joint_names and not any(known.endswith(f"::{name}") for known in reader.joint_names):
            hint = suggest_names(name, reader.joint_names) if reader.joint_names else "it has none"
            raise MitsonarError(f"{path} has no joint {short_repr(name)} that moves: {hint}")
    return reader.scene


def _root(path: Path) -> Element:
    root = read_xml(path, "SDF file")
    if root.tag != "sdf":
        raise MitsonarError(f"{path} is not an SDF file: its root element is <{root.tag[:40]}>, not <sdf>")
    return root


def _joined(model: str, name: str) -> str:
    return f"{model}::{name}" if model else name


def _sdf_file(path: Path, search: ModelSearch) -> Path:
    """Return an SDF file, or that of a model's folder: the newest one in its model.config, or model.sdf."""
    if path.is_file():
        return path
    config = path / "model.config"
    if not config.is_file():
        return search.find(str(path / "model.sdf"), path)
    tree = read_xml(config, "model.config")
    files = [(element.get("version", ""), (element.text or "").strip()) for element in tree.findall("sdf")]
    if not files:
        raise MitsonarError(f"{config} names no SDF file")
    newest = max(files, key=lambda file: [int(part) if part.isdecimal() else 0 for part in file[0][:20].split(".")])
    return search.find(newest[1], config)


def _size(path: Path, kind: Element) -> dict[str, float]:
    """Return the sizes of a primitive [m], keyed by name."""
    if kind.tag == "box":
        return dict(zip("xyz", numbers_of(path, kind, kind.findtext("size"), 3, (1.0, 1.0, 1.0)), strict=True))
    if kind.tag == "ellipsoid":
        return dict(zip("xyz", numbers_of(path, kind, kind.findtext("radii"), 3, (1.0, 1.0, 1.0)), strict=True))
    if kind.tag == "plane":
        return dict(zip("xy", numbers_of(path, kind, kind.findtext("size"), 2, (PLANE_M, PLANE_M)), strict=True))
    keys = {"sphere": ("radius",), **dict.fromkeys(("cylinder", "capsule", "cone"), ("radius", "length"))}
    if kind.tag not in keys:
        raise refused(
            path,
            kind,
            f"a geometry must be box, sphere, cylinder, capsule, ellipsoid, cone, plane or mesh: got {kind.tag[:40]}",
        )
    return {key: number_of(path, kind, kind.findtext(key), 1.0) for key in keys[kind.tag]}


def _rotation_to_normal(path: Path, kind: Element, normal: tuple[float, ...]) -> Matrix:
    """Return the rotation that turns the normal z of a plane to the given normal."""
    length = float(np.linalg.norm(normal))
    if not length >= 1e-9:
        raise refused(path, kind, "its normal has length 0")
    z = np.asarray(normal) / length
    x = np.cross((0.0, 1.0, 0.0), z) if abs(z[1]) < 0.9 else np.cross((0.0, 0.0, 1.0), z)
    x = x / np.linalg.norm(x)
    rotation = np.eye(4)
    rotation[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    return rotation
