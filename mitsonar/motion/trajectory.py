"""Trajectory: poses at times, read and written in any of the conventions, and its velocities."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from mitsonar.errors import MitsonarError, MitsonarWarning, counted
from mitsonar.motion.conventions import CONVENTIONS, Convention, convention_named, sideways_or_up
from mitsonar.motion.pose import Pose, poses_from, refuse_beyond_reach, vehicle_rotation
from mitsonar.motion.trajectory_files import read_csv, read_tum, write_csv, write_tum

__all__ = ["Trajectory", "velocities"]


def velocities(flown: Trajectory) -> NDArray[np.float64]:
    """Compute the velocities along a trajectory in the vehicle's own axes.

    A constant velocity leads along an arc. Its chord lies half a turn off the first heading, and is shorter by the sinc of
    half a turn. This is exact for level vehicles, as :func:`steady` drives them.

    Returns:
        To starboard, forward, up [m/s], and turn to starboard [rad/s] ``(frames, 4)``. Each row holds for the step after its
        pose; the last row repeats the one before. A single pose has velocity 0.
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
        refuse_beyond_reach(self.poses)

    def __len__(self) -> int:
        return len(self.poses)

    def __repr__(self) -> str:
        low, high = self.poses[:, :3].min(axis=0), self.poses[:, :3].max(axis=0)
        reach = ", ".join(f"{axis} {a:.4g}..{b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))
        return f"Trajectory({len(self)} poses over {np.ptp(self.time_s):.4g} s; {reach} m)"

    @classmethod
    def between(cls, start: Pose, end: Pose, frames: int, rate_hz: float) -> Self:
        """Space ``frames`` poses equally from ``start`` to ``end`` (Almanza-Medina, 2.2.1).

        The six numbers run linearly without wrapping: heading 350 to 370 deg turns 20 deg to starboard
        (:meth:`Pose.from_degrees` takes angles beyond a full turn).

        Raises:
            MitsonarError: no frames.
        """
        if frames < 1:
            raise MitsonarError(f"frames must be at least 1: got {frames}")
        return cls(np.linspace(start, end, frames), np.arange(frames) / rate_hz)

    def resample(self, frames: int) -> Trajectory:
        """Interpolate ``frames`` poses equally spaced in time, along straight lines and shortest turns.

        Raises:
            MitsonarError: no frames.
        """
        if frames < 1:
            raise MitsonarError(f"frames must be at least 1: got {frames}")
        if len(self) == 1:
            return Trajectory(np.repeat(self.poses, frames, axis=0), np.arange(frames) + self.time_s[0])
        time = np.linspace(self.time_s[0], self.time_s[-1], frames)
        return Trajectory(self.at(time), time)

    def at(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Interpolate the poses ``(n, 6)`` at times ``(n,)`` [s], along straight lines and shortest turns.

        Before the first time and after the last one the first and the last pose hold.

        Raises:
            MitsonarError: times of the trajectory that do not grow.
        """
        time = np.clip(np.atleast_1d(np.asarray(time_s, dtype=float)), self.time_s[0], self.time_s[-1])
        if len(self) == 1:
            return np.repeat(self.poses, len(time), axis=0)
        if not (np.diff(self.time_s) > 0).all():
            raise MitsonarError("poses between those of a trajectory need times that grow: got one that does not")
        position = np.column_stack([np.interp(time, self.time_s, axis) for axis in self.poses[:, :3].T])
        return poses_from(position, Slerp(self.time_s, vehicle_rotation(self.poses))(time))

    def lengthened(self, seconds: float) -> Trajectory:
        """Return the trajectory with a pose this long before its first and one after its last, at the speed beside each.

        Turns go on about the axis of the step beside them. A single pose stands still.
        """
        if len(self) == 1 or seconds <= 0:
            return self
        ends, times = [], []
        for at, inner, way in ((0, 1, -1.0), (-1, -2, 1.0)):
            part = seconds / abs(self.time_s[at] - self.time_s[inner])
            last, before = vehicle_rotation(self.poses[at]), vehicle_rotation(self.poses[inner])
            onward = Rotation.from_rotvec((last * before.inv()).as_rotvec() * part)
            place = self.poses[at, :3] + (self.poses[at, :3] - self.poses[inner, :3]) * part
            ends.append(poses_from(place, onward * last))
            times.append(self.time_s[at] + way * seconds)
        poses = np.concatenate([ends[0], self.poses, ends[1]])
        return Trajectory(poses, np.concatenate([times[:1], self.time_s, times[1:]]))

    @classmethod
    def load(cls, path: str | Path, frame: str = "mitsonar", *, looks_ahead: bool = True) -> Self:
        """Read a TUM file, or a CSV file where the name ends with ``.csv``.

        A CSV file names its columns in its first line: ``time_s`` (or ``time``, ``timestamp``), ``x``, ``y``, ``z`` (or
        ``x_m`` ...), and either ``qx``, ``qy``, ``qz``, ``qw`` or ``roll``, ``pitch`` and ``heading`` (or ``yaw``; in
        ``ros-enu`` only ``yaw``), each with ``_deg`` or ``_rad``; other columns are not read.

        Args:
            path: of the file.
            frame: its convention: ``mitsonar``, ``ros-enu`` or ``ned`` (:mod:`mitsonar.motion.conventions`).
            looks_ahead: False where the sonar points down from a level vehicle; decides only on the warning.

        Raises:
            MitsonarError: unknown convention; unreadable file, or a broken line, with its number.

        Warns:
            MitsonarWarning: in most frames the sonar points sideways or at the sky. The convention is probably wrong.
        """
        convention = convention_named(frame)
        if Path(path).suffix.lower() != ".csv":
            table = read_tum(path, convention)
            read = {name: _posed(table, one) for name, one in CONVENTIONS.items()}
        else:
            placed, attitude, angles = read_csv(path, convention)
            table = np.column_stack([placed, attitude])
            to_poses = _posed if angles is None else _posed_by_angles
            read = {name: to_poses(table, one) for name, one in CONVENTIONS.items()}
        _warn_of_attitude(path, read, frame, looks_ahead)
        return cls(read[frame], table[:, 0])

    def save(self, path: str | Path, frame: str = "mitsonar") -> None:
        """Write a TUM file, or a CSV file where the name ends with ``.csv``. :meth:`load` reads it back to 1e-9 m and deg.

        Args:
            path: of the file, which is replaced.
            frame: the file's convention: ``mitsonar``, ``ros-enu`` or ``ned``.

        Raises:
            MitsonarError: unknown convention.
        """
        convention = convention_named(frame)
        position, rotation = self.poses[:, :3], vehicle_rotation(self.poses)
        if frame != "mitsonar":  # whose numbers keep their bits
            position, rotation = convention.from_ours(position, rotation)
        if Path(path).suffix.lower() == ".csv":
            angles = convention.angles_from_ours(self.poses[:, 3:])
            write_csv(path, np.column_stack([self.time_s, position, angles]), convention)
        else:
            table = np.column_stack([self.time_s, position, rotation.as_quat(canonical=True)])
            write_tum(path, table, convention)

    @classmethod
    def load_tum(cls, path: str | Path) -> Self:
        """Read a TUM file in mitsonar's convention: the quaternion turns (starboard, forward, up) to the world.

        Raises:
            MitsonarError: unreadable file, or a broken line, with its number.
        """
        table = read_tum(path, CONVENTIONS["mitsonar"])
        return cls(_posed(table, CONVENTIONS["mitsonar"]), table[:, 0])

    def save_tum(self, path: str | Path) -> None:
        """Write a TUM file in mitsonar's convention. :meth:`load_tum` reads it back to 1e-9."""
        quaternions = vehicle_rotation(self.poses).as_quat(canonical=True)
        write_tum(path, np.column_stack([self.time_s, self.poses[:, :3], quaternions]), CONVENTIONS["mitsonar"])


def _posed(table: NDArray[np.float64], convention: Convention) -> NDArray[np.float64]:
    """Make poses ``(n, 6)`` from times, positions and quaternions ``(n, 8)`` in a convention."""
    if convention.name == "mitsonar":
        return poses_from(table[:, 1:4], Rotation.from_quat(table[:, 4:]))
    return poses_from(*convention.to_ours(table[:, 1:4], Rotation.from_quat(table[:, 4:])))


def _posed_by_angles(table: NDArray[np.float64], convention: Convention) -> NDArray[np.float64]:
    """Make poses ``(n, 6)`` from times, positions, pitch, roll and turn about the vertical ``(n, 7)`` in a convention."""
    position, _ = convention.to_ours(table[:, 1:4], Rotation.identity(len(table)))
    return np.column_stack([position, convention.angles_to_ours(table[:, 4:])])


def _warn_of_attitude(path: str | Path, read: dict[str, NDArray[np.float64]], frame: str, looks_ahead: bool) -> None:
    """Warn where most frames point sideways or at the sky; ``read`` has the poses by convention."""
    share = {name: sideways_or_up(poses, looks_ahead=looks_ahead).mean() for name, poses in read.items()}
    if share[frame] <= 0.5:
        return
    others = [name for name in read if name != frame and share[name] <= 0.5]
    better = f"read as {' or '.join(others)} it would not" if others else "nor would it look down in another convention"
    pitch, roll, heading = np.degrees(read[frame][0, 3:])
    count = round(share[frame] * len(read[frame]))
    warnings.warn(
        f"the sonar looks sideways or at the sky in {count} of {counted(len(read[frame]), 'frame')} of {path}, read as "
        f"{frame} (first pose: pitch {pitch:.3g}, roll {roll:.3g}, heading {heading:.3g} deg); {better}: name the file's "
        f"convention by --frame (frame= in Python), one of {', '.join(CONVENTIONS)}; nothing is wrong where that is meant",
        MitsonarWarning,
        stacklevel=3,
    )
