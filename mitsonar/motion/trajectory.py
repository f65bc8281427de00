"""How poses at times are held, interpolated, and read and written as TUM or CSV files in any of the conventions.

The class :class:`Trajectory` holds poses in the convention of mitsonar. :data:`CONVENTIONS` lists those of files.
"""

from __future__ import annotations

import csv
import io
import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from mitsonar.errors import MitsonarError, MitsonarWarning, count_noun, suggest_names
from mitsonar.io.files import missing_file, read_at_most, write_atomic
from mitsonar.motion.pose import Pose, poses_from, refuse_beyond_reach, vehicle_rotation

__all__ = [
    "CONVENTIONS",
    "Convention",
    "Trajectory",
    "convention_named",
    "read_csv",
    "read_tum",
    "sideways_or_up",
    "velocities",
    "write_csv",
    "write_tum",
]


def velocities(flown: Trajectory) -> NDArray[np.float64]:
    """Compute the velocities along a trajectory in the axes of the vehicle.

    A constant velocity leads along an arc. Its chord points half the turn off the first heading, and is shorter than the arc
    by the sinc of half the turn. This is exact for level vehicles, such as those of
    :func:`mitsonar.motion.composition.steady`.

    Returns:
        Velocity to starboard, forward, up [m/s], and turn rate to starboard [rad/s] ``(frames, 4)``. Each row is valid for
        the step after its pose; the last row repeats the one before. A single pose has velocity 0.
    """
    if len(flown) == 1:
        return np.zeros((1, 4))
    # 1. chord of each step in the axes of its first pose, and the shortest turn
    step = np.diff(flown.time_s)[:, None]
    chord = vehicle_rotation(flown.poses[:-1]).inv().apply(np.diff(flown.poses[:, :3], axis=0))
    turn = np.diff(flown.poses[:, 5])
    turn -= 2 * np.pi * np.rint(turn / (2 * np.pi))
    # 2. chord to arc: turn back by half the turn, and divide by the sinc
    chord_ratio = np.sinc(turn / (2 * np.pi))
    sin, cos = np.sin(turn / 2) / chord_ratio, np.cos(turn / 2) / chord_ratio
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

        The six numbers are interpolated linearly without wrapping: a heading from 350 to 370 deg turns 20 deg to starboard
        (:meth:`Pose.from_degrees` accepts angles beyond a full turn).

        Raises:
            MitsonarError: ``frames`` is less than 1.
        """
        if frames < 1:
            raise MitsonarError(f"frames must be at least 1: got {frames}")
        return cls(np.linspace(start, end, frames), np.arange(frames) / rate_hz)

    def resample(self, frames: int) -> Trajectory:
        """Interpolate ``frames`` poses equally spaced in time, along straight lines and shortest turns.

        Raises:
            MitsonarError: ``frames`` is less than 1.
        """
        if frames < 1:
            raise MitsonarError(f"frames must be at least 1: got {frames}")
        if len(self) == 1:
            return Trajectory(np.repeat(self.poses, frames, axis=0), np.arange(frames) + self.time_s[0])
        time = np.linspace(self.time_s[0], self.time_s[-1], frames)
        return Trajectory(self.at(time), time)

    def at(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Interpolate the poses ``(n, 6)`` at times ``(n,)`` [s], along straight lines and shortest turns.

        Times before the first or after the last take the first or the last pose.

        Raises:
            MitsonarError: the times of the trajectory do not increase.
        """
        time = np.clip(np.atleast_1d(np.asarray(time_s, dtype=float)), self.time_s[0], self.time_s[-1])
        if len(self) == 1:
            return np.repeat(self.poses, len(time), axis=0)
        if not (np.diff(self.time_s) > 0).all():
            raise MitsonarError("interpolation of a trajectory needs increasing times: got one that does not increase")
        position = np.column_stack([np.interp(time, self.time_s, axis) for axis in self.poses[:, :3].T])
        return poses_from(position, Slerp(self.time_s, vehicle_rotation(self.poses))(time))

    def extrapolated(self, seconds: float) -> Trajectory:
        """Extend the trajectory by one pose ``seconds`` before its first and one after its last [s].

        Velocity and rotation of the first and the last step continue. A trajectory of a single pose is returned unchanged.
        """
        if len(self) == 1 or seconds <= 0:
            return self
        ends, times = [], []
        for end, inner, sign in ((0, 1, -1.0), (-1, -2, 1.0)):
            ratio = seconds / abs(self.time_s[end] - self.time_s[inner])
            end_rotation, inner_rotation = vehicle_rotation(self.poses[end]), vehicle_rotation(self.poses[inner])
            extrapolated = Rotation.from_rotvec((end_rotation * inner_rotation.inv()).as_rotvec() * ratio)
            position = self.poses[end, :3] + (self.poses[end, :3] - self.poses[inner, :3]) * ratio
            ends.append(poses_from(position, extrapolated * end_rotation))
            times.append(self.time_s[end] + sign * seconds)
        poses = np.concatenate([ends[0], self.poses, ends[1]])
        return Trajectory(poses, np.concatenate([times[:1], self.time_s, times[1:]]))

    @classmethod
    def load(cls, path: str | Path, frame: str = "mitsonar", *, looks_ahead: bool = True) -> Self:
        """Read a TUM file, or a CSV file if the name ends with ``.csv``.

        A CSV file names its columns in its first line: ``time_s`` (or ``time``, ``timestamp``), ``x``, ``y``, ``z`` (or
        ``x_m`` ...), and either ``qx``, ``qy``, ``qz``, ``qw`` or ``roll``, ``pitch`` and ``heading`` (or ``yaw``; in
        ``ros-enu`` only ``yaw``), each with ``_deg`` or ``_rad``. Other columns are ignored.

        Args:
            path: path of the file.
            frame: convention of the file: ``mitsonar``, ``ros-enu`` or ``ned``;
                see :class:`~mitsonar.motion.trajectory.Convention`.
            looks_ahead: False if the sonar points down from a level vehicle; only affects the warning.

        Raises:
            MitsonarError: the convention is unknown, the file cannot be read, or a line is broken; the message names the
                line.

        Warns:
            MitsonarWarning: the sonar points sideways or at the sky in most frames; the convention is probably wrong.
        """
        convention = convention_named(frame)
        if Path(path).suffix.lower() != ".csv":
            table = read_tum(path, convention)
            poses_by_frame = {name: _poses_from_quaternions(table, candidate) for name, candidate in CONVENTIONS.items()}
        else:
            time_position, attitude, angles = read_csv(path, convention)
            table = np.column_stack([time_position, attitude])
            to_poses = _poses_from_quaternions if angles is None else _poses_from_angles
            poses_by_frame = {name: to_poses(table, candidate) for name, candidate in CONVENTIONS.items()}
        _warn_of_attitude(path, poses_by_frame, frame, looks_ahead)
        return cls(poses_by_frame[frame], table[:, 0])

    def save(self, path: str | Path, frame: str = "mitsonar") -> None:
        """Write a TUM file, or a CSV file if the name ends with ``.csv``.

        :meth:`load` reads it back to 1e-9 m and deg. Quaternions of TUM files have nine decimals: attitudes come back to
        2e-6 deg.

        Args:
            path: path of the file, which is replaced.
            frame: convention of the file: ``mitsonar``, ``ros-enu`` or ``ned``.

        Raises:
            MitsonarError: the convention is unknown.
        """
        convention = convention_named(frame)
        position, rotation = self.poses[:, :3], vehicle_rotation(self.poses)
        if frame != "mitsonar":  # the conversion would round the numbers
            position, rotation = convention.from_mitsonar(position, rotation)
        if Path(path).suffix.lower() == ".csv":
            angles = convention.angles_from_mitsonar(self.poses[:, 3:])
            write_csv(path, np.column_stack([self.time_s, position, angles]), convention)
        else:
            table = np.column_stack([self.time_s, position, rotation.as_quat(canonical=True)])
            write_tum(path, table, convention)

    @classmethod
    def load_tum(cls, path: str | Path) -> Self:
        """Read a TUM file in the convention of mitsonar: the quaternion rotates (starboard, forward, up) to the world.

        Raises:
            MitsonarError: the file cannot be read, or a line is broken; the message names the line.
        """
        table = read_tum(path, CONVENTIONS["mitsonar"])
        return cls(_poses_from_quaternions(table, CONVENTIONS["mitsonar"]), table[:, 0])

    def save_tum(self, path: str | Path) -> None:
        """Write a TUM file in the convention of mitsonar; see :meth:`save`."""
        quaternions = vehicle_rotation(self.poses).as_quat(canonical=True)
        write_tum(path, np.column_stack([self.time_s, self.poses[:, :3], quaternions]), CONVENTIONS["mitsonar"])


def _poses_from_quaternions(table: NDArray[np.float64], convention: Convention) -> NDArray[np.float64]:
    """Make poses ``(n, 6)`` from times, positions and quaternions ``(n, 8)`` in a convention."""
    if convention.name == "mitsonar":
        return poses_from(table[:, 1:4], Rotation.from_quat(table[:, 4:]))
    return poses_from(*convention.to_mitsonar(table[:, 1:4], Rotation.from_quat(table[:, 4:])))


def _poses_from_angles(table: NDArray[np.float64], convention: Convention) -> NDArray[np.float64]:
    """Make poses ``(n, 6)`` from times, positions, pitch, roll and turn about the vertical ``(n, 7)`` in a convention."""
    position, _ = convention.to_mitsonar(table[:, 1:4], Rotation.identity(len(table)))
    return np.column_stack([position, convention.angles_to_mitsonar(table[:, 4:])])


def _warn_of_attitude(
    path: str | Path, poses_by_frame: dict[str, NDArray[np.float64]], frame: str, looks_ahead: bool
) -> None:
    """Warn if the sonar points sideways or at the sky in most frames; ``read`` holds the poses in every convention."""
    fraction = {name: sideways_or_up(poses, looks_ahead=looks_ahead).mean() for name, poses in poses_by_frame.items()}
    if fraction[frame] <= 0.5:
        return
    others = [name for name in poses_by_frame if name != frame and fraction[name] <= 0.5]
    better = f"read as {' or '.join(others)} it would not" if others else "nor would it look down in another convention"
    pitch, roll, heading = np.degrees(poses_by_frame[frame][0, 3:])
    frames = len(poses_by_frame[frame])
    count = round(fraction[frame] * frames)
    warnings.warn(
        f"the sonar looks sideways or at the sky in {count} of {count_noun(frames, 'frame')} of {path}, read as "
        f"{frame} (first pose: pitch {pitch:.3g}, roll {roll:.3g}, heading {heading:.3g} deg); {better}: name the file's "
        f"convention by --frame (frame= in Python), one of {', '.join(CONVENTIONS)}; ignore this if it is intended",
        MitsonarWarning,
        stacklevel=3,
    )


# ---------------- Files of poses


Table = NDArray[np.float64]

MITSONAR_AXES = "(starboard, forward, up to world)"
"""End of the first line of a TUM file in the convention of mitsonar."""

ALIASES = {
    "time": ("time_s", "time", "timestamp"),
    **{axis: (f"{axis}_m", axis) for axis in "xyz"},
    **{f"q{axis}": (f"q{axis}",) for axis in "xyzw"},
}
"""Accepted names of each column, of which the first is written."""

COLUMNS = (
    "time_s (or time, timestamp), x, y, z (or x_m, y_m, z_m), and either qx, qy, qz, qw or roll, pitch and heading (or yaw) "
    "with _deg or _rad"
)


def read_tum(path: str | Path, convention: Convention) -> Table:
    """Read the numbers of a TUM file ``(poses, 8)``: time [s], position [m], quaternion (x, y, z, w).

    Each line of the file is ``time x y z qx qy qz qw``.

    Raises:
        MitsonarError: the file cannot be read or names another convention, or a line is broken; the message names the line.
    """
    rows: list[list[float]] = []
    for number, line in enumerate(_read_text(path).splitlines(), start=1):
        if line.lstrip().startswith("#"):
            _refuse_other_convention(path, line, convention)
        elif line.strip():
            rows.append(_tum_row(path, number, line))
            _refuse_disorder(path, number, rows)
    if not rows:
        raise MitsonarError(f"trajectory {path} holds no pose: give lines of `time x y z qx qy qz qw`")
    return np.array(rows)


def write_tum(path: str | Path, table: Table, convention: Convention) -> None:
    """Write a TUM file.

    Args:
        path: path of the file, which is replaced.
        table: time, position, quaternion ``(poses, 8)``, in the convention.
        convention: convention of the table, which the first line names.
    """
    axes = MITSONAR_AXES if convention.name == "mitsonar" else f"(frame {convention.name}: {convention.axes})"
    np.savetxt(path, table, fmt="%.9f", header=f"time_s x y z qx qy qz qw {axes}")


LARGEST = 2**30
"""Largest size of a file [bytes]."""

FARTHEST = 1e12
"""Largest position [m], time [s] and quaternion component in a file."""


def read_csv(path: str | Path, convention: Convention) -> tuple[Table, Table, Table | None]:
    """Read the numbers of a CSV file, whose first line names the columns.

    Other columns are ignored, and so are lines with a time and values in other columns only.

    Returns:
        Times [s] and positions [m] ``(poses, 4)``; then quaternions ``(poses, 4)`` and None, or twice the angles pitch, roll
        and turn about the vertical ``(poses, 3)`` [rad].

    Raises:
        MitsonarError: the file cannot be read, a column is missing or duplicated, or a line is broken; the message names the
            line.
    """
    try:
        lines = list(csv.reader(io.StringIO(_read_text(path))))
    except csv.Error as error:
        raise MitsonarError(f"cannot read trajectory {path}: it is not a CSV table ({error}); write it again") from None
    if not lines or not any(word.strip() for word in lines[0]):
        raise MitsonarError(f"trajectory {path} holds no pose: its first line must name the columns, {COLUMNS}")
    names = [word.strip().lower() for word in lines[0]]
    columns = [_column(path, names, key) for key in ("time", "x", "y", "z")]
    attitude, units = _attitude(path, names, convention)
    rows: list[list[float]] = []
    for number, words in enumerate(lines[1:], start=2):
        if any(word.strip() for word in words) and not _readings_only(words, [*columns, *attitude]):
            rows.append(_csv_row(path, number, words, [*columns, *attitude]))
            _refuse_disorder(path, number, rows)
    if not rows:
        raise MitsonarError(f"trajectory {path} holds no pose: there is no line below the names of its columns")
    table = np.array(rows)
    if units is None:
        return table[:, :4], table[:, 4:], None
    angles = table[:, 4:] * units
    return table[:, :4], angles, angles


def write_csv(path: str | Path, table: Table, convention: Convention) -> None:
    """Write a CSV file ``time_s,x_m,y_m,z_m,roll_deg,pitch_deg,heading_deg`` (``yaw_deg`` in ros-enu).

    The file is replaced atomically: it is never left half written.

    Args:
        path: path of the file, which is replaced.
        table: time, position [m], pitch, roll, turn about the vertical [rad] ``(poses, 7)``, in the convention.
        convention: convention of the table, which names the turn about the vertical.
    """
    names = ["time_s", "x_m", "y_m", "z_m", "roll_deg", "pitch_deg", f"{convention.turn[0]}_deg"]
    shown = np.column_stack([table[:, :4], np.degrees(table[:, [5, 4, 6]])])
    text = io.StringIO()
    np.savetxt(text, shown, fmt="%.9f", delimiter=",", header=",".join(names), comments="")
    write_atomic(Path(path), text.getvalue().encode())


def _read_text(path: str | Path) -> str:
    try:
        content = read_at_most(path, LARGEST)
        text = content.decode("utf-8-sig")
    except FileNotFoundError:
        raise missing_file(path, "give a TUM or CSV file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not text"
        raise MitsonarError(f"cannot read trajectory {path}: {reason}; give a TUM or CSV file") from None
    if len(content) > LARGEST:
        raise MitsonarError(f"trajectory {path} is larger than {LARGEST:,} bytes: give a TUM or CSV file, or a shorter one")
    return text


def _refuse_other_convention(path: str | Path, line: str, convention: Convention) -> None:
    """Raise a MitsonarError if a comment line written by mitsonar names another convention."""
    match = re.search(r"\(frame ([\w-]+):", line)
    name = match.group(1) if match else "mitsonar" if MITSONAR_AXES in line else convention.name
    if name != convention.name:
        raise MitsonarError(
            f"trajectory {path} is in the convention {name}, but --frame is {convention.name}: give --frame {name}, or "
            f"a path in the convention {convention.name}"
        )


def _refuse_disorder(path: str | Path, number: int, rows: list[list[float]]) -> None:
    if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
        raise MitsonarError(
            f"trajectory {path}, line {number}: time must increase, got {rows[-1][0]:.15g} s after {rows[-2][0]:.15g} s; "
            "sort the lines, and leave out repeated times"
        )


def _tum_row(path: str | Path, number: int, line: str) -> list[float]:
    words = line.split()
    try:
        row = [float(word) for word in words] if len(words) == 8 and "_" not in line else []
    except ValueError:
        row = []
    if len(row) != 8 or not (np.abs(row) <= FARTHEST).all() or not np.linalg.norm(row[4:]) >= 1e-6:
        raise MitsonarError(
            f"trajectory {path}, line {number}: expected `time x y z qx qy qz qw` as finite numbers up to "
            f"{FARTHEST:g} (times in s) with a quaternion other than zero, got {line.strip()[:60]!r}"
        )
    return row


def _column(path: str | Path, names: list[str], key: str) -> int:
    """Return the index of the column of a key of :data:`ALIASES`."""
    matches = [number for number, name in enumerate(names) if name in ALIASES[key]]
    if len(matches) > 1:
        raise MitsonarError(f"trajectory {path} has {key} in {len(matches)} columns: leave all but one out")
    if not matches:
        raise MitsonarError(
            f"trajectory {path} has no column {key} ({', '.join(names)[:80]}): its columns must be {COLUMNS}"
        )
    return matches[0]


def _attitude(path: str | Path, names: list[str], convention: Convention) -> tuple[list[int], Table | None]:
    """Return the columns of a quaternion and None, or those of pitch, roll, turn and their factors to radians."""
    quaternion = [name for name in names if name in ("qx", "qy", "qz", "qw")]
    angles = [name for name in names if name.rsplit("_", 1)[0] in ("roll", "pitch", "heading", "yaw")]
    if quaternion and angles:
        raise MitsonarError(f"trajectory {path} has the attitude twice, {quaternion[0]} and {angles[0]}: leave one out")
    if quaternion:
        return [_column(path, names, f"q{axis}") for axis in "xyzw"], None
    columns = [_angle(path, names, aliases, convention) for aliases in (("pitch",), ("roll",), convention.turn)]
    return [column for column, _ in columns], np.array([unit for _, unit in columns])


def _angle(path: str | Path, names: list[str], aliases: Sequence[str], convention: Convention) -> tuple[int, float]:
    """Return the column of an angle, and its factor to radians."""
    units = {"_deg": math.radians(1), "_rad": 1.0}
    unit_by_column = {f"{name}{ending}": unit for name in aliases for ending, unit in units.items()}
    matches = [number for number, name in enumerate(names) if name in unit_by_column]
    if len(matches) > 1:
        raise MitsonarError(f"trajectory {path} has {aliases[0]} in {len(matches)} columns: leave all but one out")
    if matches:
        return matches[0], unit_by_column[names[matches[0]]]
    if set(aliases) & set(names):
        bare = next(name for name in aliases if name in names)
        raise MitsonarError(f"trajectory {path}: the column {bare} has no unit; name it {bare}_deg or {bare}_rad")
    if "yaw" in aliases and any(name.startswith("heading") for name in names):
        raise MitsonarError(
            f"trajectory {path} has a heading, which turns clockwise from north; {convention.name} has a yaw, which turns "
            "anticlockwise from east: name the column yaw_deg if it is that, or give the file's --frame"
        )
    suggestion = suggest_names(f"{aliases[0]}_deg", unit_by_column)
    raise MitsonarError(
        f"trajectory {path} has no column {aliases[0]} ({', '.join(names)[:80]}): {suggestion}; columns are {COLUMNS}"
    )


def _readings_only(cells: list[str], columns: list[int]) -> bool:
    """Return whether a line has a time and values but no pose: readings of sensors between poses."""
    filled = {number for number, cell in enumerate(cells) if cell.strip()}
    return not filled & set(columns[1:]) and columns[0] in filled and len(filled) > 1


def _csv_row(path: str | Path, number: int, words: list[str], columns: list[int]) -> list[float]:
    try:
        row = [] if "_" in "".join(words) else [float(words[column]) for column in columns]
    except (ValueError, IndexError):
        row = []
    zero = len(columns) == 8 and bool(row) and not np.linalg.norm(row[4:]) >= 1e-6
    if not row or not (np.abs(row) <= FARTHEST).all() or zero:
        raise MitsonarError(
            f"trajectory {path}, line {number}: expected finite numbers up to {FARTHEST:g} (times in s) in the columns that "
            f"its first line names, and no quaternion of zero, got {','.join(words)[:60]!r}"
        )
    return row


# ---------------- Conventions
# | name | world: x, y, z | body: x, y, z | pitch > 0 | roll > 0 | turn about the vertical |
# |---|---|---|---|---|---|
# | ``mitsonar`` | east, north, up | starboard, forward, up | looks down | starboard down | heading, clockwise from north |
# | ``ros-enu`` | east, north, up | forward, left, up | looks down | starboard down | yaw, anticlockwise from east |
# | ``ned`` | north, east, down | forward, right, down | looks up | starboard down | heading, clockwise from north |


@dataclass(frozen=True)
class Convention:
    """A convention for the poses of a file: that of mitsonar, of ROS (REP 103), or of navigation at sea.

    East and north only name the horizontal axes of the world; the user chooses their directions on Earth.

    Attributes:
        name: name of the convention for users, such as ``ros-enu``.
        axes: description of the axes of world and body.
        world: its world axes in the world of mitsonar, as columns ``(3, 3)``.
        body: starboard, forward and up in its body axes, as columns ``(3, 3)``.
        signs: signs of pitch, roll and the turn about the vertical, relative to those of mitsonar.
        north: its turn about the vertical at heading 0 [rad].
        turn: names of the column of that turn in a table, of which the first is written.
    """

    name: str
    axes: str
    world: tuple[tuple[int, int, int], ...]
    body: tuple[tuple[int, int, int], ...]
    signs: tuple[int, int, int]
    north: float
    turn: tuple[str, ...]

    def to_mitsonar(self, position: Table, rotation: Rotation) -> tuple[Table, Rotation]:
        """Convert positions and attitudes to the convention of mitsonar.

        Args:
            position: positions in the world of this convention ``(n, 3)`` [m].
            rotation: rotations from its body to its world.

        Returns:
            Positions ``(n, 3)`` in the world of mitsonar [m], and rotations from (starboard, forward, up) to it.
        """
        world, body = Rotation.from_matrix(self.world), Rotation.from_matrix(self.body)
        return world.apply(position), world * rotation * body

    def from_mitsonar(self, position: Table, rotation: Rotation) -> tuple[Table, Rotation]:
        """Convert positions and attitudes from the convention of mitsonar, the inverse of :meth:`to_mitsonar`."""
        world, body = Rotation.from_matrix(self.world), Rotation.from_matrix(self.body)
        return world.inv().apply(position), world.inv() * rotation * body.inv()

    def angles_to_mitsonar(self, angles: Table) -> Table:
        """Convert angles to pitch, roll, heading of mitsonar ``(n, 3)`` [rad].

        Args:
            angles: pitch, roll and turn about the vertical ``(n, 3)`` [rad]; the rotation applies the turn first, then
                pitch, then roll.
        """
        return np.asarray((angles - (0, 0, self.north)) * self.signs)

    def angles_from_mitsonar(self, angles: Table) -> Table:
        """Convert angles from the convention of mitsonar, the inverse of :meth:`angles_to_mitsonar`."""
        return np.asarray(angles * self.signs + (0, 0, self.north))


CONVENTIONS = {
    one.name: one
    for one in (
        Convention(
            "mitsonar",
            "world east, north, up; body starboard, forward, up",
            ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
            ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
            (1, 1, 1),
            0.0,
            ("heading", "yaw"),
        ),
        Convention(
            "ros-enu",
            "world east, north, up; body forward, left, up",
            ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
            ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
            (1, 1, -1),
            math.pi / 2,
            ("yaw",),
        ),
        Convention(
            "ned",
            "world north, east, down; body forward, right, down",
            ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
            ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
            (-1, 1, 1),
            0.0,
            ("heading", "yaw"),
        ),
    )
}
"""The supported conventions of pose files, by name."""


def convention_named(name: str) -> Convention:
    """Return the convention with a name.

    Raises:
        MitsonarError: the name is unknown.
    """
    if name not in CONVENTIONS:
        raise MitsonarError(f"unknown frame {name!r} of poses: {suggest_names(name, CONVENTIONS)}")
    return CONVENTIONS[name]


LEVEL = math.sin(math.radians(10))
"""Vertical component of an axis below which the axis counts as level."""

ON_ITS_SIDE = math.sin(math.radians(45))
"""Vertical component of the starboard axis above which a sonar lies on its side."""

ALONG = math.cos(math.radians(60))
"""Component of the axis along the course, ahead or astern, below which a sonar points across its course."""


def sideways_or_up(poses: Table, *, looks_ahead: bool = True) -> NDArray[np.bool_]:
    """Detect the frames in which a sonar points at the sky or sideways, as in a file read in the wrong convention.

    A sonar points at the sky if its axis rises by more than 10 deg. It points sideways if its starboard axis is 45 deg or
    more off the level. It also points sideways if its acoustic axis is level to within 10 deg while its starboard axis is
    not, or while it moves across that axis (60..120 deg).

    Args:
        poses: x, y, z [m], pitch, roll, heading [rad] ``(frames, 6)``.
        looks_ahead: False for a sonar that points down from a level vehicle, as hydrophones do. It points sideways if the
            axes of the vehicle are 45 deg off the level, and at the sky if the vehicle is upside down.

    Returns:
        True for these frames ``(frames,)``.
    """
    # vertical components of the acoustic axis, of the starboard axis (absolute) and of the up axis
    pitch, roll, heading = poses[:, 3:].T
    rises, leans, up = -np.sin(pitch), np.abs(np.sin(roll) * np.cos(pitch)), np.cos(roll) * np.cos(pitch)
    if not looks_ahead:
        return np.asarray(up < ON_ITS_SIDE)
    level = np.abs(rises) < LEVEL
    # direction of motion relative to the horizontal acoustic axis; frames without motion do not count
    displacement = np.gradient(poses[:, :2], axis=0) if len(poses) > 1 else np.zeros((1, 2))
    length = np.linalg.norm(displacement, axis=1)
    ahead = np.abs(displacement[:, 0] * np.sin(heading) + displacement[:, 1] * np.cos(heading))
    across = (length > 1e-6) & (ahead < ALONG * length)
    return np.asarray((rises > LEVEL) | (leans > ON_ITS_SIDE) | (level & ((leans > LEVEL) | across)))
