"""Pose: position and attitude of a sonar or vehicle, as six numbers, rotations and matrices."""

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
"""Largest angle of a pose that is typed in [rad]."""

SENSOR_IN_VEHICLE = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])

FARTHEST = 1e12
"""Largest coordinate of a pose [m]: farther away, single precision cannot hold a scene."""

MOST_TURNED = 1e6
"""Largest angle of a pose [rad]: larger ones no longer say where it points."""


def plain_number(value: object) -> object:
    """Return a number of NumPy as one of Python; others as they are."""
    return value.item() if isinstance(value, np.generic) else value


class _Six(NamedTuple):
    """The six numbers of a pose, unchecked."""

    x: float
    y: float
    z: float
    pitch: float = 0.0
    roll: float = 0.0
    heading: float = 0.0


class Pose(_Six):
    """Position and attitude of the sonar: x, y, z [m], pitch, roll, heading [rad].

    Raises:
        MitsonarError: an angle beyond a full turn: degrees, in all likelihood. :meth:`from_degrees` takes degrees,
            :meth:`from_row` a heading that has turned several times.
    """

    __slots__ = ()

    def __new__(cls, x: float, y: float, z: float, pitch: float = 0.0, roll: float = 0.0, heading: float = 0.0) -> Self:
        """Make a pose from metres and radians."""
        for name, angle in (("pitch", pitch), ("roll", roll), ("heading", heading)):
            if abs(angle) > FULL_TURN:
                raise MitsonarError(
                    f"{name} of a pose is in radians, at most a full turn of {FULL_TURN:.4g} rad: got {angle:g}; of degrees "
                    "make it by Pose.from_degrees or np.radians, of a heading that went on turning by Pose.from_row"
                )
        return super().__new__(cls, x, y, z, pitch, roll, heading)

    def __reduce__(self) -> tuple[object, ...]:
        """Copy and pickle without the check of angles."""
        return type(self).from_row, (tuple(self),)

    @classmethod
    def from_row(cls, row: Iterable[float]) -> Self:
        """Make a pose from a row of a trajectory: six numbers in metres and radians, with a heading of any size."""
        return cls._make(row)

    def __repr__(self) -> str:
        return f"Pose({', '.join(f'{name}={plain_number(value)!r}' for name, value in self._asdict().items())})"

    @classmethod
    def from_degrees(cls, numbers: ArrayLike) -> Self:
        """Make a pose from ``x, y, z, pitch, roll, heading`` in metres and degrees.

        Raises:
            MitsonarError: not six finite numbers, or too large ones.
        """
        values = np.asarray(numbers, dtype=float)
        if values.shape != (6,):
            raise MitsonarError(f"a pose is six numbers x,y,z,pitch,roll,heading (m, deg): got {values.size}")
        if not np.isfinite(values).all():
            raise MitsonarError(f"a pose must be finite: got {','.join(f'{v:g}' for v in values)}; give m and deg")
        made = cls.from_row([*values[:3], *np.radians(values[3:])])
        refuse_beyond_reach([made])
        return made


def refuse_beyond_reach(poses: ArrayLike) -> None:
    """Refuse poses ``(..., 6)`` [m, rad] whose numbers are so large that nothing could be rendered there.

    Raises:
        MitsonarError: a coordinate or an angle is beyond its bound.
    """
    table = np.abs(np.asarray(poses, dtype=float).reshape(-1, 6))
    for what, unit, values, bound in (
        ("position", "m", table[:, :3], FARTHEST),
        ("angle", "rad", table[:, 3:], MOST_TURNED),
    ):
        if values.size and values.max() > bound:
            raise MitsonarError(f"a pose's {what} must be at most {bound:g} {unit}: got {values.max():g} {unit}")


def mounted(poses: ArrayLike, mount: Pose) -> NDArray[np.float64]:
    """Compute the poses ``(frames, 6)`` of a sonar on a vehicle.

    A mount that only pitches keeps position, heading and roll of a level vehicle to the bit.

    Args:
        poses: of the vehicle ``(frames, 6)`` [m, rad].
        mount: pose of the sonar in the vehicle's axes.
    """
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    if not any((*mount[:3], mount.roll, mount.heading)) and not table[:, 3:5].any():
        pitched: NDArray[np.float64] = table + np.array([0, 0, 0, mount.pitch, 0, 0])
        return pitched
    turn = vehicle_rotation(table)
    return poses_from(table[:, :3] + turn.apply(mount[:3]), turn * vehicle_rotation(mount))


def mount_between(vehicle: Pose, sensor: Pose) -> Pose:
    """Return the mount that puts a sensor where it is on a vehicle: ``mounted(vehicle, mount)`` is the sensor's pose."""
    turn = vehicle_rotation(vehicle).inv()
    place = turn.apply(np.subtract(sensor[:3], vehicle[:3]))
    return Pose(*(float(value) for value in poses_from(place, turn * vehicle_rotation(sensor))[0]))


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
    # straight up or down, heading and roll are one angle: the heading takes it
    heading = np.where(level, np.arctan2(forward[:, 0], forward[:, 1]), np.arctan2(-starboard[:, 1], starboard[:, 0]))
    roll = np.where(level, np.arctan2(-starboard[:, 2], up[:, 2]), 0.0)
    return np.column_stack([np.asarray(position, dtype=float).reshape(-1, 3), pitch, roll, heading])


def to_world_matrices(poses: ArrayLike) -> NDArray[np.float64]:
    """Return Mitsuba's ``to_world`` of poses ``(frames, 4, 4)``: local +z the acoustic axis, +y up, +x port."""
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    matrices = np.tile(np.eye(4), (len(table), 1, 1))
    matrices[:, :3, :3] = vehicle_rotation(table).as_matrix() @ SENSOR_IN_VEHICLE
    matrices[:, :3, 3] = table[:, :3]
    return matrices


def pose_from_to_world(matrix: ArrayLike) -> Pose:
    """Recover the pose from a sensor's ``to_world`` ``(4, 4)``.

    Raises:
        MitsonarError: the matrix is not finite, scales, shears or mirrors.
    """
    matrix = np.asarray(matrix, dtype=float)
    turn = matrix[:3, :3]
    if not np.isfinite(matrix).all():
        raise MitsonarError("the sonar's to_world must be finite: got inf or nan; give a lookat, translate or rotate")
    if not np.allclose(turn.T @ turn, np.eye(3), atol=1e-4) or np.linalg.det(turn) < 0:
        raise MitsonarError("the sonar's to_world may only turn and move: got a scale, shear or mirror; remove it")
    poses = poses_from(matrix[:3, 3], Rotation.from_matrix(turn @ SENSOR_IN_VEHICLE.T))
    return Pose(*(float(value) for value in poses[0]))
