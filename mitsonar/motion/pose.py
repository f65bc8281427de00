"""Pose, motion and trajectory: conventions, composition (Almanza-Medina, eq. 3.4), sampling, files of poses.

World: right-handed, z up. Vehicle: x sideways to starboard, y forward, z up. Heading is 0 along +y and grows
clockwise seen from above; pitch > 0 looks down; roll > 0 puts starboard down. Rotation = heading, then pitch, then
roll, intrinsic.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.motion.conventions import CONVENTIONS, Convention, convention_named, sideways_or_up
from mitsonar.motion.trajectory_files import read_csv, read_tum, write_csv, write_tum

__all__ = [
    "Motion",
    "Pose",
    "Trajectory",
    "compose",
    "inverse",
    "motions",
    "mounted",
    "pose_from_to_world",
    "steady",
    "to_world_matrices",
    "velocities",
]

# Mitsuba's sensor frame in the vehicle's: local x = port, local y = up, local z = forward (columns)
SENSOR_IN_VEHICLE = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


LARGEST_TUM = 2**30
"""Bytes of a trajectory."""

FARTHEST = 1e12
"""Of places [m], times [s] and numbers of a quaternion in a file."""


class Pose(NamedTuple):
    """Where the sonar is: x, y, z [m], pitch, roll, heading [rad]."""

    x: float
    y: float
    z: float
    pitch: float = 0.0
    roll: float = 0.0
    heading: float = 0.0

    @classmethod
    def from_degrees(cls, numbers: ArrayLike) -> Self:
        """The pose of ``x, y, z, pitch, roll, heading`` with metres and degrees.

        Raises:
            MitsonarError: not six finite numbers.
        """
        values = np.asarray(numbers, dtype=float)
        if values.shape != (6,):
            raise MitsonarError(f"a pose is six numbers x,y,z,pitch,roll,heading (m, deg): got {values.size}")
        if not np.isfinite(values).all():
            raise MitsonarError(f"a pose must be finite: got {','.join(f'{v:g}' for v in values)}; give m and deg")
        return cls(*values[:3], *np.radians(values[3:]))


class Motion(NamedTuple):
    """Between two pings: sideways [m], forward [m], yaw [rad], in the frame of the second heading (eq. 3.4)."""

    sideways: float
    forward: float
    yaw: float


def compose(pose: Pose, motion: Motion) -> Pose:
    """The pose after a motion (Almanza-Medina, eq. 3.4): along the *new* heading."""
    heading = pose.heading + motion.yaw
    sin, cos = np.sin(heading), np.cos(heading)
    x = pose.x + motion.forward * sin + motion.sideways * cos
    y = pose.y + motion.forward * cos - motion.sideways * sin
    return Pose(float(x), float(y), pose.z, pose.pitch, pose.roll, float(heading))


def inverse(motion: Any) -> Any:
    """The motions that undo motions ``(..., 3)`` (sideways, forward, yaw; eq. 3.4), NumPy or torch."""
    xp = array_namespace(motion)
    sideways, forward, yaw = (motion[..., k] for k in range(3))
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    return xp.stack([-(sideways * cos + forward * sin), -(forward * cos - sideways * sin), -yaw], axis=-1)


def motions(poses: ArrayLike) -> NDArray[np.float64]:
    """What :func:`compose` needs from each pose ``(frames, 6)`` to the next: ``(frames - 1, 3)`` sideways, forward [m], yaw
    [rad] within -pi..pi (Almanza-Medina, eq. 3.4)."""
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    (x, y), heading = np.diff(table[:, :2], axis=0).T, table[1:, 5]
    sin, cos = np.sin(heading), np.cos(heading)
    turn = np.diff(table[:, 5])
    yaw = turn - 2 * np.pi * np.rint(turn / (2 * np.pi))
    return np.column_stack([x * cos - y * sin, x * sin + y * cos, yaw])


def velocities(flown: Trajectory) -> NDArray[np.float64]:
    """Velocity along a trajectory in the vehicle's own axes: starboard, forward, up [m/s], turn to starboard [rad/s]
    ``(frames, 4)``; of each step, the last again (one pose: zero).

    A velocity that is kept leads along an arc; its chord lies half a turn off the first heading, shorter by the sinc of half
    a turn: exact for level vehicles, as :func:`steady` drives them.
    """
    if len(flown) == 1:
        return np.zeros((1, 4))
    step = np.diff(flown.time_s)[:, None]
    chord = vehicle_rotation(flown.poses[:-1]).inv().apply(np.diff(flown.poses[:, :3], axis=0))
    turn = np.diff(flown.poses[:, 5])
    turn -= 2 * np.pi * np.rint(turn / (2 * np.pi))
    shorter = np.sinc(turn / (2 * np.pi))
    sin, cos = np.sin(turn / 2) / shorter, np.cos(turn / 2) / shorter
    starboard, forward, up = chord.T
    table = np.column_stack([starboard * cos - forward * sin, forward * cos + starboard * sin, up, turn]) / step
    return np.concatenate([table, table[-1:]])


def steady(
    start: Pose, velocity: tuple[float, float, float], frames: int, rate_hz: float
) -> tuple[Trajectory, NDArray[np.float64]]:
    """``frames`` poses of a level vehicle that keeps its velocity, starboard and forward [m/s] and turn [rad/s] in its own
    axes, along an arc; and that velocity as :func:`velocities` has it ``(frames, 4)``."""
    sideways, forward, turn = velocity
    time = np.arange(frames) / rate_hz
    angle = turn * time
    # integral of the velocity turned by the heading: sin(a)/a and (1 - cos a)/a along the arc
    along, beside = time * np.sinc(angle / np.pi), time * np.sin(angle / 2) * np.sinc(angle / (2 * np.pi))
    sin, cos = np.sin(start.heading), np.cos(start.heading)
    right, ahead = sideways * along + forward * beside, forward * along - sideways * beside
    poses = np.tile(np.array(start, dtype=float), (frames, 1))
    poses[:, 0] += right * cos + ahead * sin
    poses[:, 1] += ahead * cos - right * sin
    poses[:, 5] += angle
    return Trajectory(poses, time), np.tile([sideways, forward, 0.0, turn], (frames, 1))


def mounted(poses: ArrayLike, mount: Pose) -> NDArray[np.float64]:
    """Poses ``(frames, 6)`` of a sonar on a vehicle at ``poses``; ``mount`` is the sonar's pose in the vehicle's axes.

    A mount that only pitches keeps position, heading and roll of a level vehicle as they are, to the bit.
    """
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    if not any((*mount[:3], mount.roll, mount.heading)) and not table[:, 3:5].any():
        return table + np.array([0, 0, 0, mount.pitch, 0, 0])
    turn = vehicle_rotation(table)
    return poses_from(table[:, :3] + turn.apply(mount[:3]), turn * vehicle_rotation(mount))


def vehicle_rotation(poses: ArrayLike) -> Rotation:
    """Rotations from (starboard, forward, up) to the world for poses ``(frames, 6)``."""
    pitch, roll, heading = np.atleast_2d(np.asarray(poses, dtype=float))[:, 3:].T
    return Rotation.from_euler("ZXY", np.column_stack([-heading, -pitch, roll]))


def poses_from(position: ArrayLike, rotation: Rotation) -> NDArray[np.float64]:
    """Poses ``(frames, 6)`` of positions ``(frames, 3)`` and the rotations of (starboard, forward, up) to the world."""
    matrix = np.atleast_3d(rotation.as_matrix().reshape(-1, 3, 3))
    starboard, forward, up = matrix[:, :, 0], matrix[:, :, 1], matrix[:, :, 2]
    pitch = np.arcsin(np.clip(-forward[:, 2], -1, 1))
    level = np.hypot(forward[:, 0], forward[:, 1]) > 1e-9
    # looking straight up or down, heading and roll are one angle: it is given to the heading
    heading = np.where(level, np.arctan2(forward[:, 0], forward[:, 1]), np.arctan2(-starboard[:, 1], starboard[:, 0]))
    roll = np.where(level, np.arctan2(-starboard[:, 2], up[:, 2]), 0.0)
    return np.column_stack([np.asarray(position, dtype=float).reshape(-1, 3), pitch, roll, heading])


def to_world_matrices(poses: ArrayLike) -> NDArray[np.float64]:
    """Mitsuba's ``to_world`` of each pose ``(frames, 4, 4)``: local +z the acoustic axis, +y up, +x port."""
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    matrices = np.tile(np.eye(4), (len(table), 1, 1))
    matrices[:, :3, :3] = vehicle_rotation(table).as_matrix() @ SENSOR_IN_VEHICLE
    matrices[:, :3, 3] = table[:, :3]
    return matrices


def pose_from_to_world(matrix: ArrayLike) -> Pose:
    """The pose behind a sensor's ``to_world`` ``(4, 4)``.

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


@dataclass(frozen=True)
class Trajectory:
    """Poses ``(frames, 6)`` [m, rad] at times ``(frames,)`` [s]."""

    poses: NDArray[np.float64]
    time_s: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.poses.ndim != 2 or self.poses.shape != (len(self.time_s), 6) or not self.poses.size:
            raise MitsonarError(f"a trajectory is poses (frames, 6) with a time each: got {self.poses.shape}")
        if not (np.isfinite(self.poses).all() and np.isfinite(self.time_s).all()):
            raise MitsonarError("a trajectory must be finite: got inf or nan in a pose or a time")

    def __len__(self) -> int:
        return len(self.poses)

    @classmethod
    def between(cls, start: Pose, end: Pose, frames: int, rate_hz: float) -> Self:
        """``frames`` poses equally spaced from ``start`` to ``end`` (Almanza-Medina, 2.2.1).

        The six numbers run linearly, as they are given: heading 350 to 370 deg turns 20 deg to starboard.
        """
        if frames < 1:
            raise MitsonarError(f"frames must be at least 1: got {frames}")
        return cls(np.linspace(start, end, frames), np.arange(frames) / rate_hz)

    def resample(self, frames: int) -> Trajectory:
        """``frames`` poses equally spaced in time; straight lines and shortest turns between the given ones."""
        if frames < 1:
            raise MitsonarError(f"frames must be at least 1: got {frames}")
        if len(self) == 1:
            return Trajectory(np.repeat(self.poses, frames, axis=0), np.arange(frames) + self.time_s[0])
        time = np.linspace(self.time_s[0], self.time_s[-1], frames)
        position = np.column_stack([np.interp(time, self.time_s, axis) for axis in self.poses[:, :3].T])
        return Trajectory(poses_from(position, Slerp(self.time_s, vehicle_rotation(self.poses))(time)), time)

    @classmethod
    def load(cls, path: str | Path, frame: str = "mitsonar", *, looks_ahead: bool = True) -> Self:
        """Read a TUM file, or a CSV file where the name ends with ``.csv``.

        A CSV file names its columns in its first line: ``time_s`` (or ``time``, ``timestamp``), ``x``, ``y``, ``z`` (or
        ``x_m`` ...), and either ``qx``, ``qy``, ``qz``, ``qw`` or ``roll``, ``pitch`` and ``heading`` (or ``yaw``; in
        ``ros-enu`` only ``yaw``), each with ``_deg`` or ``_rad``; other columns are not read.

        Args:
            path: of the file.
            frame: its convention: ``mitsonar``, ``ros-enu`` or ``ned`` (:mod:`mitsonar.motion.conventions`).
            looks_ahead: False where the sonar looks down from a level vehicle; only decides what is warned of.

        Raises:
            MitsonarError: unknown convention; unreadable file, or a broken line, with its number.

        Warns:
            MitsonarWarning: in most frames the sonar would look sideways or at the sky, as in a wrong convention.
        """
        convention = convention_named(frame)
        if Path(path).suffix.lower() != ".csv":
            table = read_tum(path, convention)
            read = {name: _posed(table, one) for name, one in CONVENTIONS.items()}
        else:
            placed, attitude, angles = read_csv(path, convention)
            table = np.column_stack([placed, attitude])
            told = _posed if angles is None else _posed_by_angles
            read = {name: told(table, one) for name, one in CONVENTIONS.items()}
        _warn_of_attitude(path, read, frame, looks_ahead)
        return cls(read[frame], table[:, 0])

    def save(self, path: str | Path, frame: str = "mitsonar") -> None:
        """Write a TUM file, or a CSV file where the name ends with ``.csv``; :meth:`load` reads it back to 1e-9 m and deg.

        Args:
            path: is replaced.
            frame: the file's convention: ``mitsonar``, ``ros-enu`` or ``ned``.

        Raises:
            MitsonarError: unknown convention.
        """
        convention = convention_named(frame)
        position, rotation = self.poses[:, :3], vehicle_rotation(self.poses)
        if frame != "mitsonar":  # whose numbers stay as they are, to the bit
            position, rotation = convention.from_ours(position, rotation)
        if Path(path).suffix.lower() == ".csv":
            angles = convention.angles_from_ours(self.poses[:, 3:])
            write_csv(path, np.column_stack([self.time_s, position, angles]), convention)
        else:
            table = np.column_stack([self.time_s, position, rotation.as_quat(canonical=True)])
            write_tum(path, table, convention)

    @classmethod
    def load_tum(cls, path: str | Path) -> Self:
        """A TUM file in mitsonar's convention: the quaternion turns (starboard, forward, up) to the world.

        Raises:
            MitsonarError: unreadable file, or a broken line, with its number.
        """
        table = read_tum(path, CONVENTIONS["mitsonar"])
        return cls(_posed(table, CONVENTIONS["mitsonar"]), table[:, 0])

    def save_tum(self, path: str | Path) -> None:
        """Write a TUM file in mitsonar's convention; :meth:`load_tum` reads it back to 1e-9."""
        quaternions = vehicle_rotation(self.poses).as_quat(canonical=True)
        write_tum(path, np.column_stack([self.time_s, self.poses[:, :3], quaternions]), CONVENTIONS["mitsonar"])


def _posed(table: NDArray[np.float64], convention: Convention) -> NDArray[np.float64]:
    """Poses ``(n, 6)`` of times, positions and quaternions ``(n, 8)`` in a convention."""
    if convention.name == "mitsonar":
        return poses_from(table[:, 1:4], Rotation.from_quat(table[:, 4:]))
    return poses_from(*convention.to_ours(table[:, 1:4], Rotation.from_quat(table[:, 4:])))


def _posed_by_angles(table: NDArray[np.float64], convention: Convention) -> NDArray[np.float64]:
    """Poses ``(n, 6)`` of times, positions, pitch, roll and turn about the vertical ``(n, 7)`` in a convention."""
    position, _ = convention.to_ours(table[:, 1:4], Rotation.identity(len(table)))
    return np.column_stack([position, convention.angles_to_ours(table[:, 4:])])


def _warn_of_attitude(path: str | Path, read: dict[str, NDArray[np.float64]], frame: str, looks_ahead: bool) -> None:
    """Warn where most frames would look sideways or at the sky; ``read`` has the poses by convention."""
    share = {name: sideways_or_up(poses, looks_ahead=looks_ahead).mean() for name, poses in read.items()}
    if share[frame] <= 0.5:
        return
    others = [name for name in read if name != frame and share[name] <= 0.5]
    better = f"read as {' or '.join(others)} it would not" if others else "nor would it look down in another convention"
    pitch, roll, heading = np.degrees(read[frame][0, 3:])
    count = round(share[frame] * len(read[frame]))
    warnings.warn(
        f"the sonar looks sideways or at the sky in {count} of {len(read[frame])} frames of {path}, read as {frame} (first "
        f"pose: pitch {pitch:.3g}, roll {roll:.3g}, heading {heading:.3g} deg); {better}: name the file's convention by "
        f"--frame (frame= in Python), one of {', '.join(CONVENTIONS)}; nothing is wrong where that is meant",
        MitsonarWarning,
        stacklevel=3,
    )
