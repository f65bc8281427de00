"""How a URDF file is read: the links of a robot, placed by its joints.

mitsonar has its own reader because URDF and SDF share geometries, colours and poses, and no package on PyPI reads SDF.
yourdfpy 0.0.60, the usual package for URDF, opens any path that a file names, accepts document types and entities, repairs
broken XML silently, overlooks links with the same name, circles of joints, NaN and a mimic of a mimic, refuses capsules, and
installs the twenty packages of ``trimesh[easy]``.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from mitsonar.bridges.model_files import (
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
from mitsonar.errors import MitsonarError, MitsonarWarning, short_repr, suggest_names
from mitsonar.worlds.meshes import UNCOLOURED, Piece, reduce_colour

__all__ = ["check_joint_names", "joint_motion", "read_urdf"]

MOVING_TYPES = ("revolute", "continuous", "prismatic")
"""Types of joints with a single value; others are read as fixed."""

MAX_MIMICS = 20

MAX_ANGLE_RAD = 6.3
"""Angle above which a warning suspects degrees [rad]."""


def read_urdf(
    path: Path, search: ModelSearch, shapes: Shapes, joints: Mapping[str, float], collision: bool = False
) -> ReadScene:
    """Read the links of a URDF file; the root link lies at the origin.

    Args:
        path: URDF file; xacro must be expanded.
        search: search for its meshes.
        shapes: reader of geometries.
        joints: values of joints, keyed by name [rad, m]; others are at 0, or follow the joint that they mimic.
        collision: whether to read the collision shapes instead of the visual ones.

    Raises:
        MitsonarError: the file is damaged, or refers to something that is missing.
    """
    robot = read_xml(path, "URDF file")
    if robot.tag != "robot":
        raise MitsonarError(f"{path} is not a URDF file: its root element is <{robot.tag[:40]}>, not <robot>")
    links = _children_by_name(path, robot, "link")
    scene = ReadScene()
    scene.frames = _link_poses(path, links, _children_by_name(path, robot, "joint"), joints)
    name = robot.get("name", "")
    group = (name,) if name and name not in links else ()
    scene.frames |= {name: np.eye(4) for name in group}
    colours: dict[str, Element] = {}
    for material in (*robot.findall("material"), *robot.findall("link/visual/material")):
        if material.get("name") and material.find("color") is not None:  # a visual may define what later ones name
            colours.setdefault(material.get("name", ""), material)
    for link, element in links.items():
        pieces = [
            piece
            for child in element.findall("collision" if collision else "visual")
            for piece in _pieces(path, child, search, shapes, colours)
        ]
        if pieces:
            scene.bodies.append(Body(link, scene.frames[link], pieces, group))
    return scene


def _children_by_name(path: Path, parent: Element, tag: str) -> dict[str, Element]:
    """Return the children with a given tag, keyed by their names, which must be unique."""
    children: dict[str, Element] = {}
    for element in parent.findall(tag):
        name = attribute_of(path, element, "name")
        if name in children:
            raise refused(path, element, f"the name of this {tag} is used twice: give each another name")
        children[name] = element
    return children


# ---------------- Poses of links


def _link_poses(
    path: Path, links: dict[str, Element], joints: dict[str, Element], joint_values: Mapping[str, float]
) -> dict[str, Matrix]:
    """Return the pose of each link relative to the root, the only link that is not the child of a joint."""
    # 1. Collect the parent of each link, and the link's pose in the axes of its parent.
    check_joint_names(path, joint_values, [name for name, joint in joints.items() if joint.get("type") in MOVING_TYPES])
    parents: dict[str, tuple[str, Matrix]] = {}
    for name, joint in joints.items():
        ends = [_linked_name(path, joint, tag, links) for tag in ("parent", "child")]
        if ends[1] in parents:
            raise refused(path, joint, f"link {short_repr(ends[1])} is the child of two joints: URDF is a tree")
        value = _joint_value(path, name, joints, joint_values)
        origin = _origin(path, joint)
        axis = joint.find("axis")
        direction = (1.0, 0.0, 0.0) if axis is None else numbers_of(path, axis, axis.get("xyz"), 3, (1.0, 0.0, 0.0))
        kind = joint.get("type", "fixed")
        parents[ends[1]] = (ends[0], origin @ joint_motion(path, joint, kind, direction, value))
    # 2. Find the root.
    roots = [link for link in links if link not in parents]
    if len(roots) != 1:
        root_names = "none" if not roots else f"{len(roots)}: {', '.join(roots[:3])[:80]}"
        raise MitsonarError(
            f"{path}: exactly one link, the root of the tree, must not be the child of a joint: got {root_names}"
        )
    # 3. Follow each link up to one with a known pose, then multiply the poses on the way back down.
    poses = {roots[0]: np.eye(4)}
    for link in links:
        chain: dict[str, None] = {}
        ancestor = link
        while ancestor not in poses:
            if ancestor in chain:
                raise MitsonarError(f"{path}: the joints of link {short_repr(link)} form a circle")
            chain[ancestor] = None
            ancestor = parents[ancestor][0]
        for ancestor in reversed(chain):
            poses[ancestor] = poses[parents[ancestor][0]] @ parents[ancestor][1]
    return poses


def check_joint_names(path: Path, joint_values: Mapping[str, float], known: list[str]) -> None:
    """Check that requested joints exist, can move, and have finite values.

    Args:
        path: the file, for error messages.
        joint_values: requested values of joints, keyed by name [rad, m].
        known: names of the joints that can move.

    Raises:
        MitsonarError: a joint does not exist or cannot move, or a value is not finite.
    """
    for name, value in joint_values.items():
        if name not in known:
            hint = suggest_names(name, known) if known else "it has none"
            raise MitsonarError(f"{path} has no joint {short_repr(name)} that moves: {hint}"[:400])
        if not abs(value) <= 1e6:
            raise MitsonarError(f"joint {name} needs a finite number [rad, m]: got {value:g}")


def _linked_name(path: Path, joint: Element, tag: str, links: dict[str, Element]) -> str:
    """Return the name of a joint's parent or child link."""
    element = joint.find(tag)
    if element is None:
        raise refused(path, joint, f"it has no {tag}")
    name = attribute_of(path, element, "link")
    if name not in links:
        raise refused(path, joint, f"its {tag} is the link {short_repr(name)}, which does not exist")
    return name


def _joint_value(path: Path, name: str, joints: dict[str, Element], joint_values: Mapping[str, float]) -> float:
    """Return the value of a joint: the requested value, that of the joint that it mimics, or 0 [rad, m]."""
    factor, offset = 1.0, 0.0
    for _ in range(MAX_MIMICS):
        joint = joints[name]
        mimic = joint.find("mimic")
        if name in joint_values or mimic is None:
            limit = joint.find("limit")
            value = joint_values.get(name, 0.0)
            if name in joint_values and limit is not None and joint.get("type") != "continuous":
                low = number_of(path, joint, limit.get("lower"), 0.0)
                high = number_of(path, joint, limit.get("upper"), 0.0)
                if not low <= value <= high:
                    raise MitsonarError(f"joint {name} must lie in {low:g}..{high:g} [rad, m]: got {value:g}")
            if joint.get("type") == "continuous":
                _warn_of_degrees(f"joint {name}", [value])
            return factor * value + offset
        offset += factor * number_of(path, joint, mimic.get("offset"), 0.0)
        factor *= number_of(path, joint, mimic.get("multiplier"), 1.0)
        name = attribute_of(path, mimic, "joint")
        if name not in joints:
            raise refused(path, joint, f"it mimics the joint {short_repr(name)}, which does not exist")
    raise refused(path, joints[name], "joints mimic each other in a circle")


def joint_motion(path: Path, joint: Element, kind: str, axis: tuple[float, ...], value: float) -> Matrix:
    """Return the transform by which a joint moves its child, in the axes of the joint.

    Args:
        path: the file, for error messages.
        joint: the joint, for error messages.
        kind: type of the joint; types without a single value do not move.
        axis: axis of the joint ``(3,)``.
        value: value of the joint [rad, m].

    Raises:
        MitsonarError: the axis has length 0.
    """
    if kind not in MOVING_TYPES or value == 0:
        return np.eye(4)
    length = float(np.linalg.norm(axis))
    if not length >= 1e-9:
        raise refused(path, joint, "its axis has length 0")
    motion = np.asarray(axis) / length * value
    return placed(motion) if kind == "prismatic" else placed(np.zeros(3), Rotation.from_rotvec(motion))


def _warn_of_degrees(what: str, angles: Iterable[float]) -> None:
    """Warn if an angle [rad] exceeds a full turn, because it is probably in degrees."""
    largest = max(map(abs, angles))
    if largest > MAX_ANGLE_RAD:
        message = f"{what} is in radians, but {largest:g} is more than a turn: are these degrees?"
        warnings.warn(message, MitsonarWarning, stacklevel=2)


def _origin(path: Path, element: Element) -> Matrix:
    """Return the pose in the child ``origin`` of an element; rpy are rotations about the fixed axes x, y, z."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    position = numbers_of(path, element, origin.get("xyz"), 3, (0.0, 0.0, 0.0))
    rpy = numbers_of(path, element, origin.get("rpy"), 3, (0.0, 0.0, 0.0))
    _warn_of_degrees(f"{path}, <{element.tag}>: rpy", rpy)
    return placed(position, Rotation.from_euler("xyz", rpy))


# ---------------- Geometries and colours of links


def _pieces(path: Path, element: Element, search: ModelSearch, shapes: Shapes, colours: dict[str, Element]) -> list[Piece]:
    """Return the geometries of a visual or collision element, in the axes of its link."""
    geometry = element.find("geometry")
    kind = None if geometry is None else next(iter(geometry), None)
    if kind is None:
        raise refused(path, element, "it has no geometry")
    colour = _reflectivity(path, element, shapes, colours)
    if kind.tag == "mesh":
        file = search.find(attribute_of(path, kind, "filename"), path)
        scale = numbers_of(path, kind, kind.get("scale"), 3, (1.0, 1.0, 1.0))
        pieces = shapes.of_file(file, scale, colour)
    else:
        size = _size(path, kind)
        solid = primitive(kind.tag, size, UNCOLOURED if colour is None else colour, f"{path}, <{kind.tag}>")
        pieces = shapes.count_noun([solid], str(path))
    pose = _origin(path, element)
    return [piece.moved(pose[:3, :3], -pose[:3, 3]) for piece in pieces]


def _size(path: Path, kind: Element) -> dict[str, float]:
    """Return the sizes of a primitive [m], keyed by name."""
    if kind.tag == "box":
        return dict(zip("xyz", numbers_of(path, kind, attribute_of(path, kind, "size"), 3, ()), strict=True))
    keys = {"sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}
    if kind.tag not in keys:
        raise refused(
            path, kind, f"a geometry must be a box, a cylinder, a sphere, a capsule or a mesh: got {kind.tag[:40]}"
        )
    return {key: number_of(path, kind, kind.get(key)) for key in keys[kind.tag]}


def _reflectivity(path: Path, element: Element, shapes: Shapes, colours: dict[str, Element]) -> float | None:
    """Return the reflectivity of the colour of a visual, or of the robot's material that it names; None without a colour."""
    if not isinstance(shapes.value, str):
        return float(shapes.value)
    material = element.find("material")
    if material is None:
        return None
    named = colours.get(material.get("name", ""), material)
    colour = material.find("color") if material.find("color") is not None else named.find("color")
    if colour is None:
        return None
    rgba = numbers_of(path, material, colour.get("rgba"), 4, (0.5, 0.5, 0.5, 1.0))
    return float(reduce_colour(np.clip(np.array([rgba[:3]]), 0, 1), shapes.value)[0])
