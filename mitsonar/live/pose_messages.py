"""Poses as messages: JSON of six numbers, or of ROS and Foxglove, in and out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, meant, shortened
from mitsonar.io.files import PlainValue, parse_json
from mitsonar.motion.pose import Pose, poses_from, vehicle_rotation
from mitsonar.motion.trajectory import CONVENTIONS

__all__ = ["AskedPose", "asked_pose", "pose_from_ros", "pose_in_ros"]

SIX = ("x", "y", "z", "pitch", "roll", "heading")
ALSO = ("id", "header", "timestamp", "frame_id", "pose")

FARTHEST_M = 1e6
"""No pose lies farther from the origin [m]: single precision would round it to decimetres."""

LONGEST = 2**16
"""Bytes of a message that asks for a ping, at most."""

ROS = CONVENTIONS["ros-enu"]


@dataclass(frozen=True)
class AskedPose:
    """A pose that a client asks for.

    Attributes:
        pose: of the sonar [m, rad].
        mark: what the client's message has in ``id``, which the timing of the ping returns.
    """

    pose: Pose
    mark: PlainValue = None


def asked_pose(message: bytes) -> AskedPose:
    """Read a pose from JSON.

    Two forms are read. ``{"x", "y", "z", "pitch", "roll", "heading"}`` are mitsonar's own, in m and deg; what is left out is
    0. ``{"pose": {"position": {"x", "y", "z"}, "orientation": {"x", "y", "z", "w"}}}``, as ``foxglove.PoseInFrame`` and
    ``geometry_msgs/PoseStamped`` have it, follows REP 103: x forward, y to port, z up.

    Raises:
        MitsonarError: not JSON, unknown or missing keys, no numbers, a turn of length 0, or beyond 1000 km.
    """
    if len(message) > LONGEST:
        raise MitsonarError(f"a pose is at most {LONGEST:,} bytes: got {len(message):,}")
    table = parse_json(message, "the pose")
    if not isinstance(table, dict):
        raise MitsonarError(
            f"a pose is a JSON object of {', '.join(SIX)} (m, deg), or has a key pose: got {shortened(table)}"
        )
    unknown = [key for key in table if key not in (*SIX, *ALSO)]
    if unknown:
        raise MitsonarError(
            f"a pose has no key {shortened(unknown[0])}{meant(unknown[0], SIX)}: give {', '.join(SIX)} in m and deg, or pose"
        )
    mark = table.get("id")
    if not isinstance(mark, int | float | str | None) or (isinstance(mark, float) and not math.isfinite(mark)):
        raise MitsonarError(f"id of a pose is a finite number or a text: got {shortened(mark)}")
    if "pose" in table:
        both = [key for key in SIX if key in table]
        if both:
            raise MitsonarError(f"a pose gives pose or {both[0]}, not both")
        inner = _table(table["pose"], "pose", ("position", "orientation"))
        position = _numbers(inner.get("position", {}), "position", ("x", "y", "z"))
        turn = _numbers(inner.get("orientation", {"w": 1.0}), "orientation", ("x", "y", "z", "w"))
        return AskedPose(pose_from_ros(position, turn), mark)
    if not any(key in table for key in SIX):
        raise MitsonarError(f"a pose has none of {', '.join(SIX)}, and no pose: give numbers in m and deg")
    values = _numbers({key: table[key] for key in SIX if key in table}, "pose", SIX)
    return AskedPose(_near(Pose.from_degrees(values)), mark)


def pose_from_ros(position: ArrayLike, quaternion: ArrayLike) -> Pose:
    """Return mitsonar's pose for one of REP 103.

    Args:
        position: x, y, z [m], z up.
        quaternion: x, y, z, w, from (forward, port, up) to the world.

    Raises:
        MitsonarError: a quaternion of length 0, or a position beyond 1000 km.
    """
    turn = np.asarray(quaternion, dtype=float)
    length = float(np.linalg.norm(turn))
    if not 1e-6 < length < 1e6:
        raise MitsonarError(f"the orientation of a pose must be a quaternion of length 1: got length {length:g}")
    placed, rotation = ROS.to_ours(np.asarray(position, dtype=float).reshape(1, 3), Rotation.from_quat(turn[None] / length))
    return _near(Pose(*(float(value) for value in poses_from(placed, rotation)[0])))


def pose_in_ros(pose: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return position ``(3,)`` [m] and quaternion ``(4,)`` x, y, z, w of a pose, after REP 103."""
    table = np.atleast_2d(np.asarray(pose, dtype=float))
    position, rotation = ROS.from_ours(table[:, :3], vehicle_rotation(table))
    return position[0], rotation.as_quat(canonical=True)[0]


def _near(pose: Pose) -> Pose:
    """Return a pose whose numbers can be rendered.

    Raises:
        MitsonarError: they cannot.
    """
    if max(abs(value) for value in pose[:3]) > FARTHEST_M:
        raise MitsonarError(
            f"a pose must lie within {FARTHEST_M:g} m of the origin: got {', '.join(f'{v:g}' for v in pose[:3])}"
        )
    return pose


def _table(value: PlainValue, name: str, keys: tuple[str, ...]) -> dict[str, PlainValue]:
    """Return a table with known keys only.

    Raises:
        MitsonarError: it is no table, or has others.
    """
    if not isinstance(value, dict):
        raise MitsonarError(f"{name} must be an object with {', '.join(keys)}: got {shortened(value)}")
    unknown = [key for key in value if key not in keys]
    if unknown:
        raise MitsonarError(f"{name} has no key {shortened(unknown[0])}: it has {', '.join(keys)}")
    return value


def _numbers(value: PlainValue, name: str, keys: tuple[str, ...]) -> list[float]:
    """Return the numbers of a table; 0 where a key is left out.

    Raises:
        MitsonarError: other keys, or no finite numbers.
    """
    table = _table(value, name, keys)
    for key, number in table.items():
        fine = isinstance(number, int | float) and not isinstance(number, bool)
        if not fine or not math.isfinite(number):
            raise MitsonarError(f"{key} of {name} must be a finite number: got {shortened(number)}")
    return [float(table.get(key, 0.0)) for key in keys]
