"""Files of poses: TUM (``time x y z qx qy qz qw`` a line) and CSV (columns by name), in any convention by name."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.io.files import at_most, write_whole
from mitsonar.motion.conventions import Convention

__all__ = ["read_csv", "read_tum", "write_csv", "write_tum"]

Table = NDArray[np.float64]

OURS = "(starboard, forward, up to world)"
"""End of the first line of a TUM file in mitsonar's own convention."""

ALIASES = {
    "time": ("time_s", "time", "timestamp"),
    **{axis: (f"{axis}_m", axis) for axis in "xyz"},
    **{f"q{axis}": (f"q{axis}",) for axis in "xyzw"},
}
"""Names of columns; the first is written."""

COLUMNS = (
    "time_s (or time, timestamp), x, y, z (or x_m, y_m, z_m), and either qx, qy, qz, qw or roll, pitch and heading (or yaw) "
    "with _deg or _rad"
)


def read_tum(path: str | Path, convention: Convention) -> Table:
    """Read the numbers of a TUM file ``(poses, 8)``: time [s], position [m], quaternion (x, y, z, w).

    Raises:
        MitsonarError: unreadable file, a broken line, with its number, or a file that names another convention.
    """
    rows: list[list[float]] = []
    for number, line in enumerate(_text(path).splitlines(), start=1):
        if line.lstrip().startswith("#"):
            _refuse_another(path, line, convention)
        elif line.strip():
            rows.append(_tum_row(path, number, line))
            _refuse_disorder(path, number, rows)
    if not rows:
        raise MitsonarError(f"trajectory {path} holds no pose: give lines of `time x y z qx qy qz qw`")
    return np.array(rows)


def write_tum(path: str | Path, table: Table, convention: Convention) -> None:
    """Write a TUM file.

    Args:
        path: of the file, which is replaced.
        table: time, position, quaternion ``(poses, 8)``, in the convention.
        convention: named in the first line.
    """
    axes = OURS if convention.name == "mitsonar" else f"(frame {convention.name}: {convention.axes})"
    np.savetxt(path, table, fmt="%.9f", header=f"time_s x y z qx qy qz qw {axes}")


LARGEST = 2**30
"""Bytes of a trajectory, at most."""

FARTHEST = 1e12
"""Largest position [m], time [s] and number of a quaternion in a file."""


def read_csv(path: str | Path, convention: Convention) -> tuple[Table, Table, Table | None]:
    """Read the numbers of a CSV file. Other columns are not read, nor lines that hold a time and other columns only.

    Returns:
        Times [s] and positions [m] ``(poses, 4)``; then quaternions ``(poses, 4)`` and None, or twice the angles pitch, roll
        and turn about the vertical ``(poses, 3)`` [rad].

    Raises:
        MitsonarError: unreadable file, columns that are missing or double, a broken line, with its number.
    """
    try:
        lines = list(csv.reader(io.StringIO(_text(path))))
    except csv.Error as error:
        raise MitsonarError(f"cannot read trajectory {path}: it is no table of CSV ({error}); write it again") from None
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
    """Write a CSV file: ``time_s,x_m,y_m,z_m,roll_deg,pitch_deg,heading_deg`` (``yaw_deg`` in ros-enu), whole or absent.

    Args:
        path: of the file, which is replaced.
        table: time, position [m], pitch, roll, turn about the vertical [rad] ``(poses, 7)``, in the convention.
        convention: has the name of that turn.
    """
    names = ["time_s", "x_m", "y_m", "z_m", "roll_deg", "pitch_deg", f"{convention.turn[0]}_deg"]
    shown = np.column_stack([table[:, :4], np.degrees(table[:, [5, 4, 6]])])
    text = io.StringIO()
    np.savetxt(text, shown, fmt="%.9f", delimiter=",", header=",".join(names), comments="")
    write_whole(Path(path), text.getvalue().encode())


def _text(path: str | Path) -> str:
    try:
        content = at_most(path, LARGEST)
        text = content.decode("utf-8-sig")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not text"
        raise MitsonarError(f"cannot read trajectory {path}: {reason}; give a TUM or CSV file") from None
    if len(content) > LARGEST:
        raise MitsonarError(f"trajectory {path} is larger than {LARGEST:,} bytes: it is no TUM or CSV file, or cut it")
    return text


def _refuse_another(path: str | Path, line: str, convention: Convention) -> None:
    """Refuse a file of mitsonar that names another convention."""
    named = re.search(r"\(frame ([\w-]+):", line)
    name = named.group(1) if named else "mitsonar" if OURS in line else convention.name
    if name != convention.name:
        raise MitsonarError(f"trajectory {path} says that it is {name}, and --frame {convention.name} is asked: give {name}")


def _refuse_disorder(path: str | Path, number: int, rows: list[list[float]]) -> None:
    if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
        raise MitsonarError(
            f"trajectory {path}, line {number}: time must increase, got {rows[-1][0]:g} s after {rows[-2][0]:g} s; sort the "
            "lines"
        )


def _tum_row(path: str | Path, number: int, line: str) -> list[float]:
    words = line.split()
    try:
        row = [float(word) for word in words] if len(words) == 8 and "_" not in line else []
    except ValueError:
        row = []
    if len(row) != 8 or not (np.abs(row) <= FARTHEST).all() or not np.linalg.norm(row[4:]) >= 1e-6:
        raise MitsonarError(
            f"trajectory {path}, line {number}: expected `time x y z qx qy qz qw` as finite numbers with a "
            f"quaternion other than zero, got {line.strip()[:60]!r}"
        )
    return row


def _column(path: str | Path, names: list[str], key: str) -> int:
    """Return the column of a key."""
    found = [number for number, name in enumerate(names) if name in ALIASES[key]]
    if len(found) > 1:
        raise MitsonarError(f"trajectory {path} has {key} in {len(found)} columns: leave all but one out")
    if not found:
        raise MitsonarError(
            f"trajectory {path} has no column {key} ({', '.join(names)[:80]}): its columns must be {COLUMNS}"
        )
    return found[0]


def _attitude(path: str | Path, names: list[str], convention: Convention) -> tuple[list[int], Table | None]:
    """Return the columns of the attitude: a quaternion and None, or pitch, roll, turn and the factors to radians."""
    quaternion = [name for name in names if name in ("qx", "qy", "qz", "qw")]
    angles = [name for name in names if name.rsplit("_", 1)[0] in ("roll", "pitch", "heading", "yaw")]
    if quaternion and angles:
        raise MitsonarError(f"trajectory {path} has the attitude twice, {quaternion[0]} and {angles[0]}: leave one out")
    if quaternion:
        return [_column(path, names, f"q{axis}") for axis in "xyzw"], None
    found = [_angle(path, names, wanted, convention) for wanted in (("pitch",), ("roll",), convention.turn)]
    return [column for column, _ in found], np.array([unit for _, unit in found])


def _angle(path: str | Path, names: list[str], wanted: Sequence[str], convention: Convention) -> tuple[int, float]:
    """Return the column of an angle, and its factor to radians."""
    units = {"_deg": math.radians(1), "_rad": 1.0}
    known = {f"{name}{ending}": unit for name in wanted for ending, unit in units.items()}
    found = [number for number, name in enumerate(names) if name in known]
    if len(found) > 1:
        raise MitsonarError(f"trajectory {path} has {wanted[0]} in {len(found)} columns: leave all but one out")
    if found:
        return found[0], known[names[found[0]]]
    if set(wanted) & set(names):
        bare = next(name for name in wanted if name in names)
        raise MitsonarError(f"trajectory {path}: the column {bare} has no unit; name it {bare}_deg or {bare}_rad")
    if "yaw" in wanted and any(name.startswith("heading") for name in names):
        raise MitsonarError(
            f"trajectory {path} has a heading, which turns clockwise from north; {convention.name} has a yaw, which turns "
            "anticlockwise from east: name the column yaw_deg if it is that, or give the file's --frame"
        )
    near = nearest_names(f"{wanted[0]}_deg", known)
    raise MitsonarError(
        f"trajectory {path} has no column {wanted[0]} ({', '.join(names)[:80]}): {near}; columns are {COLUMNS}"
    )


def _readings_only(words: list[str], columns: list[int]) -> bool:
    """Return whether a line has a time and no pose, but something else: readings of sensors at a time of their own."""
    held = {number for number, word in enumerate(words) if word.strip()}
    return not held & set(columns[1:]) and columns[0] in held and len(held) > 1


def _csv_row(path: str | Path, number: int, words: list[str], columns: list[int]) -> list[float]:
    try:
        row = [] if "_" in "".join(words) else [float(words[column]) for column in columns]
    except (ValueError, IndexError):
        row = []
    zero = len(columns) == 8 and bool(row) and not np.linalg.norm(row[4:]) >= 1e-6
    if not row or not (np.abs(row) <= FARTHEST).all() or zero:
        raise MitsonarError(
            f"trajectory {path}, line {number}: expected finite numbers in the columns that its first line names, and no "
            f"quaternion of zero, got {','.join(words)[:60]!r}"
        )
    return row
