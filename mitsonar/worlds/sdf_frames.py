"""Frames of SDF: poses relative to named frames, within models and models within these."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, shortened
from mitsonar.worlds.plain_xml import numbers_of, refused
from mitsonar.worlds.scene_parts import Matrix, placed

__all__ = ["Scope", "pose_of"]

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
