"""How position and attitude of a sonar or vehicle are expressed, as six numbers, rotations and matrices."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError

__all__ = [
    "Pose",
    "mount_between",
    "mounted",
    "pose_from_to_world",
    "poses_from",
    "refuse_beyond_reach",
    "to_world_matrices",
    "vehicle_rotation",
]

FULL_TURN = 2 * math.pi
"""Largest angle of a pose that is given by hand [rad]."""

SENSOR_IN_VEHICLE = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])

FARTHEST = 1e12
"""Largest coordinate of a pose [m]: farther away, single precision cannot represent a scene."""

MOST_TURNED = 1e6
"""Largest angle of a pose [rad]: larger ones no longer determine a direction precisely."""


def plain_number(value: object) -> object:
    """Convert a NumPy scalar to a Python number; return other values unchanged."""
    return value.item() if isinstance(value, np.generic) else value


class _PoseFields(NamedTuple):
    """The six numbers of a pose, unchecked."""

    x: float
    y: float
    z: float
    pitch: float = 0.0
    roll: float = 0.0
    heading: float = 0.0


class Pose(_PoseFields):
    """Position and attitude of a sonar or vehicle: x, y, z [m], pitch, roll, heading [rad].

    Raises:
        MitsonarError: an angle exceeds a full turn, probably because it is in degrees. Use :meth:`from_degrees` for degrees,
            and :meth:`from_row` for a heading that has turned several times.
    """

    __slots__ = ()

    def __new__(cls, x: float, y: float, z: float, pitch: float = 0.0, roll: float = 0.0, heading: float = 0.0) -> Self:
        """Make a pose from metres and radians."""
        for name, angle in (("pitch", pitch), ("roll", roll), ("heading", heading)):
            if abs(angle) > FULL_TURN:
                raise MitsonarError(
                    f"{name} of a pose is in radians, at most a full turn of {FULL_TURN:.4g} rad: got {angle:g}; use "
                    "Pose.from_degrees for degrees, or Pose.from_row for a heading that has turned several times"
                )
        return super().__new__(cls, x, y, z, pitch, roll, heading)

    def __reduce__(self) -> tuple[object, ...]:
        """Support copying and pickling without the check of angles."""
        return type(self).from_row, (tuple(self),)

    @classmethod
    def from_row(cls, row: Iterable[float]) -> Self:
        """Make a pose from a row of a trajectory: six numbers in metres and radians, with angles of any size."""
        return cls._make(row)

    def __repr__(self) -> str:
        return f"Pose({', '.join(f'{name}={plain_number(value)!r}' for name, value in self._asdict().items())})"

    @classmethod
    def from_degrees(cls, numbers: ArrayLike) -> Self:
        """Make a pose from ``x, y, z, pitch, roll, heading`` in metres and degrees.

        Raises:
            MitsonarError: ``numbers`` is not six finite numbers, or one is too large.
        """
        values = np.asarray(numbers, dtype=float)
        if values.shape != (6,):
            raise MitsonarError(f"a pose is six numbers x,y,z,pitch,roll,heading (m, deg): got {values.size}")
        if not np.isfinite(values).all():
            raise MitsonarError(f"a pose must be finite: got {','.join(f'{v:g}' for v in values)}; give m and deg")
        pose = cls.from_row([*values[:3], *np.radians(values[3:])])
        refuse_beyond_reach([pose])
        return pose


def refuse_beyond_reach(poses: ArrayLike) -> None:
    """Reject poses ``(..., 6)`` [m, rad] whose numbers are too large to render anything there.

    Raises:
        MitsonarError: a coordinate or an angle exceeds its bound.
    """
    table = np.abs(np.asarray(poses, dtype=float).reshape(-1, 6))
    for quantity, unit, values, bound in (
        ("position", "m", table[:, :3], FARTHEST),
        ("angle", "rad", table[:, 3:], MOST_TURNED),
    ):
        if values.size and values.max() > bound:
            raise MitsonarError(f"a pose's {quantity} must be at most {bound:g} {unit}: got {values.max():g} {unit}")


def mounted(poses: ArrayLike, mount: Pose) -> NDArray[np.float64]:
    """Compute the poses ``(frames, 6)`` [m, rad] of a sonar that is mounted on a vehicle.

    A mount that only pitches preserves position, heading and roll of a level vehicle bit for bit.

    Args:
        poses: poses of the vehicle ``(frames, 6)`` [m, rad].
        mount: pose of the sonar in the axes of the vehicle.
    """
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    if not any((*mount[:3], mount.roll, mount.heading)) and not table[:, 3:5].any():
        pitched: NDArray[np.float64] = table + np.array([0, 0, 0, mount.pitch, 0, 0])
        return pitched
    turn = vehicle_rotation(table)
    return poses_from(table[:, :3] + turn.apply(mount[:3]), turn * vehicle_rotation(mount))


def mount_between(vehicle: Pose, sensor: Pose) -> Pose:
    """Return the mount of a sensor on a vehicle, for which ``mounted(vehicle, mount)`` is the pose of the sensor."""
    to_vehicle = vehicle_rotation(vehicle).inv()
    position = to_vehicle.apply(np.subtract(sensor[:3], vehicle[:3]))
    return Pose(*(float(value) for value in poses_from(position, to_vehicle * vehicle_rotation(sensor))[0]))


def vehicle_rotation(poses: ArrayLike) -> Rotation:
    """Return the rotations from (starboard, forward, up) to the world for poses ``(frames, 6)`` [m, rad]."""
    pitch, roll, heading = np.atleast_2d(np.asarray(poses, dtype=float))[:, 3:].T
    return Rotation.from_euler("ZXY", np.column_stack([-heading, -pitch, roll]))


def poses_from(position: ArrayLike, rotation: Rotation) -> NDArray[np.float64]:
    """Make poses ``(frames, 6)`` from positions ``(frames, 3)`` and rotations of (starboard, forward, up) to the world."""
    matrix = np.atleast_3d(rotation.as_matrix().reshape(-1, 3, 3))
    starboard, forward, up = matrix[:, :, 0], matrix[:, :, 1], matrix[:, :, 2]
    pitch = np.arcsin(np.clip(-forward[:, 2], -1, 1))
    level = np.hypot(forward[:, 0], forward[:, 1]) > 1e-9
    # a forward axis straight up or down (gimbal lock) leaves one angle for heading and roll: the heading takes it
    heading = np.where(level, np.arctan2(forward[:, 0], forward[:, 1]), np.arctan2(-starboard[:, 1], starboard[:, 0]))
    roll = np.where(level, np.arctan2(-starboard[:, 2], up[:, 2]), 0.0)
    return np.column_stack([np.asarray(position, dtype=float).reshape(-1, 3), pitch, roll, heading])


def to_world_matrices(poses: ArrayLike) -> NDArray[np.float64]:
    """Return Mitsuba's ``to_world`` matrices of poses ``(frames, 4, 4)``; local +z is the acoustic axis, +y up, +x port."""
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    matrices = np.tile(np.eye(4), (len(table), 1, 1))
    matrices[:, :3, :3] = vehicle_rotation(table).as_matrix() @ SENSOR_IN_VEHICLE
    matrices[:, :3, 3] = table[:, :3]
    return matrices


def pose_from_to_world(matrix: ArrayLike) -> Pose:
    """Return the pose of a sensor with the matrix ``to_world`` ``(4, 4)``.

    Raises:
        MitsonarError: the matrix is not finite, scales, shears or mirrors.
    """
    matrix = np.asarray(matrix, dtype=float)
    turn = matrix[:3, :3]
    if not np.isfinite(matrix).all():
        raise MitsonarError("the sonar's to_world must be finite: got inf or nan; give a lookat, translate or rotate")
    if not np.allclose(turn.T @ turn, np.eye(3), atol=1e-4) or np.linalg.det(turn) < 0:
        raise MitsonarError("the sonar's to_world may only rotate and translate: got a scale, shear or mirror; remove it")
    poses = poses_from(matrix[:3, 3], Rotation.from_matrix(turn @ SENSOR_IN_VEHICLE.T))
    return Pose(*(float(value) for value in poses[0]))
