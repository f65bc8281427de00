"""Files of a vehicle's sensors: CSV, columns by name with their unit; cells may be empty where sensors have other times."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, MitsonarWarning, nearest_names
from mitsonar.io.csv_table import CsvTable
from mitsonar.io.files import write_whole
from mitsonar.mapping.vehicle_sensors import DeadReckoning, Readings, VehicleSensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.motion.trajectory_files import ALIASES

__all__ = ["COLUMNS", "ROOT_HOUR", "load_sensors", "save_sensors"]

Array = NDArray[np.float64]

ROOT_HOUR = float(np.radians(1) / 60)
"""One deg/h^0.5 as rad per root second: the noise of a gyroscope."""

DEG = float(np.radians(1))

COLUMNS = {
    "yaw_rate_deg_s": ("yaw_rate_noise_deg_rth", DEG, ROOT_HOUR),
    "sideways_m_s": ("sideways_std_m_s", 1.0, 1.0),
    "forward_m_s": ("forward_std_m_s", 1.0, 1.0),
    "depth_m": ("depth_std_m", 1.0, 1.0),
    "heading_deg": ("heading_std_deg", DEG, DEG),
    "compass_deg": ("compass_std_deg", DEG, DEG),
}
"""Columns of readings; the column of their noise; the factors of both to m, rad and s."""

RECKONED = ("reckoned_x_m", "reckoned_y_m", "reckoned_heading_deg")
WALKS = ("reckoned_walk_m_rts", "reckoned_walk_deg_rts")
"""Columns of poses by dead reckoning, and of their random walk per root second."""

OF_POSES = {name for axis in "xy" for name in ALIASES[axis]}
"""Columns of positions. Beside them ``heading_deg`` is the heading of a pose, which may be the true one."""

BIAS = "yaw_rate_bias_deg_h"
TIMES = ("time_s", "time", "timestamp")

LARGEST = 1e12
"""Largest number of a file; times may be those of Unix."""


def load_sensors(path: str | Path) -> VehicleSensors:
    """Load the readings of sensors from a CSV file.

    Its first line names the columns: ``time_s`` (or ``time``, ``timestamp``), and those of the sensors there are. A sensor's
    noise is a column of its own; its first number counts where later ones are missing. Other columns are not read: the file
    may be a trajectory (:meth:`mitsonar.Trajectory.load`), whose poses may be the true ones.

    | sensor | columns | columns of its noise |
    |---|---|---|
    | gyroscope | ``yaw_rate_deg_s``, clockwise seen from above | ``yaw_rate_noise_deg_rth`` (deg/h^0.5) |
    | | | ``yaw_rate_bias_deg_h``; none: 0 |
    | DVL | ``sideways_m_s`` to starboard, ``forward_m_s`` | ``sideways_std_m_s``, ``forward_std_m_s``, of a reading |
    | depth | ``depth_m`` | ``depth_std_m`` |
    | compass | ``heading_deg``, clockwise from north | ``heading_std_deg`` |
    | | or ``compass_deg``; beside columns of poses only this | ``compass_std_deg`` |
    | dead reckoning | ``reckoned_x_m``, ``reckoned_y_m`` | ``reckoned_walk_m_rts``, after a second |
    | | ``reckoned_heading_deg`` | ``reckoned_walk_deg_rts`` |

    Raises:
        MitsonarError: unreadable file, no column of a sensor, one without its noise, words that are no numbers, times that
            do not increase.
    """
    table = CsvTable(Path(path))
    time = _column(table, _time_name(table), whole=True)
    known = _sensor_columns(table)
    if not known:
        wanted = ", ".join((*COLUMNS, *RECKONED))
        raise MitsonarError(f"{path} has no column of a sensor ({', '.join(table.names)[:80]}): known are {wanted}")
    doubled = sorted({name for name in table.names if table.names.count(name) > 1})
    if doubled:
        raise MitsonarError(f"{path} has the column {doubled[0]} more than once: leave one out")
    if {"heading_deg", "compass_deg"} <= set(known):
        raise MitsonarError(f"{path} has headings of a compass twice, heading_deg and compass_deg: leave one out")
    readings = {name: _readings(table, time, name) for name in known if name in COLUMNS}
    bias = _first(table, BIAS) * DEG / 3600 if BIAS in table.names else 0.0
    return VehicleSensors(
        readings.get("yaw_rate_deg_s"),
        readings.get("sideways_m_s"),
        readings.get("forward_m_s"),
        readings.get("depth_m"),
        readings.get("compass_deg", readings.get("heading_deg")),
        _reckoned(table, time) if set(known) & set(RECKONED) else None,
        bias,
        f"the sensors of {Path(path).name}",
    )


def save_sensors(path: str | Path, sensors: VehicleSensors) -> None:
    """Write sensors to a CSV file that :func:`load_sensors` reads, whole or absent; a row for each time of any sensor."""
    columns: dict[str, tuple[Array, Array]] = {}
    for name, one in _named(sensors).items():
        noise, unit, noise_unit = COLUMNS[name]
        columns[name] = one.time_s, one.values / unit
        columns[noise] = one.time_s, one.std / noise_unit
    if sensors.dead_reckoning is not None:
        dead = sensors.dead_reckoning
        unit_poses = dead.path.poses[:, [0, 1, 5]] / [1, 1, DEG]
        walks = np.tile([dead.walk_m, dead.walk_rad / DEG], (len(dead.path), 1))
        for name, values in zip((*RECKONED, *WALKS), np.column_stack([unit_poses, walks]).T, strict=True):
            columns[name] = dead.path.time_s, values
    if sensors.bias_std and sensors.yaw_rate is not None:
        columns[BIAS] = sensors.yaw_rate.time_s[:1], np.array([sensors.bias_std * 3600 / DEG])
    times = np.unique(np.concatenate([time for time, _ in columns.values()]))
    cells = np.full((len(times), len(columns)), "", dtype=object)
    for number, (time, values) in enumerate(columns.values()):
        cells[np.searchsorted(times, time), number] = [f"{value:.12g}" for value in values]
    lines = [",".join(["time_s", *columns])]
    lines += [",".join([f"{time:.9f}", *row]) for time, row in zip(times, cells, strict=True)]
    write_whole(Path(path), ("\n".join(lines) + "\n").encode())


def _named(sensors: VehicleSensors) -> Mapping[str, Readings]:
    """Return the readings by the name of their column."""
    every = {
        "yaw_rate_deg_s": sensors.yaw_rate,
        "sideways_m_s": sensors.sideways,
        "forward_m_s": sensors.forward,
        "depth_m": sensors.depth,
        "heading_deg": sensors.heading,
    }
    return {name: one for name, one in every.items() if one is not None}


def _sensor_columns(table: CsvTable) -> list[str]:
    """Return the columns of readings that a table has; beside poses ``heading_deg`` is none."""
    found = [name for name in (*COLUMNS, *RECKONED) if name in table.names]
    if not OF_POSES & set(table.names) or "heading_deg" not in found:
        return found
    if COLUMNS["heading_deg"][0] in table.names:
        message = f"{table.path}: heading_deg is that of the poses beside it, and is not read"
        warnings.warn(f"{message}: name the column of a compass compass_deg, and its noise", MitsonarWarning, stacklevel=3)
    found.remove("heading_deg")
    return found


def _time_name(table: CsvTable) -> str:
    there = [name for name in TIMES if name in table.names]
    if len(there) != 1:
        raise MitsonarError(f"{table.path} needs one column of times, {', '.join(TIMES)}: got {', '.join(table.names)[:80]}")
    return there[0]


def _column(table: CsvTable, name: str, *, whole: bool = False) -> Array:
    """Return a column; empty cells are nan, and refused where it must be whole."""
    column = table.names.index(name)
    numbers = table.at(column)
    for row, (words, number) in enumerate(zip(table.rows, numbers, strict=True), start=2):
        word = words[column].strip()
        if (word or whole) and not (abs(number) <= LARGEST and "_" not in word):
            raise MitsonarError(f"{table.path}, row {row:,}: {name} must be a number: got {word[:40]!r}")
    return numbers


def _first(table: CsvTable, name: str) -> float:
    """Return the first number of a column."""
    numbers = _column(table, name)
    known = numbers[np.isfinite(numbers)]
    if not known.size:
        raise MitsonarError(f"{table.path}: the column {name} is empty")
    return float(known[0])


def _readings(table: CsvTable, time: Array, name: str) -> Readings | None:
    """Return the readings of a column; None where it is empty."""
    noise, unit, noise_unit = COLUMNS[name]
    values = _column(table, name)
    known = np.isfinite(values)
    if not known.any():
        return None
    if noise not in table.names:
        raise MitsonarError(f"{table.path} has {name}, but not its noise: add the column {noise} ({_hint(table, noise)})")
    first, std = _first(table, noise), _column(table, noise)
    std = np.where(np.isfinite(std), std, first)
    try:
        return Readings(time[known], values[known] * unit, std[known] * noise_unit)
    except MitsonarError as error:
        raise MitsonarError(f"{table.path}, column {name}: {error}") from None


def _hint(table: CsvTable, noise: str) -> str:
    return nearest_names(noise, [name for name in table.names if name]) if table.names else ""


def _reckoned(table: CsvTable, time: Array) -> DeadReckoning:
    """Return the dead reckoning of a table."""
    missing = [name for name in (*RECKONED, *WALKS) if name not in table.names]
    if missing:
        raise MitsonarError(f"{table.path} has poses by dead reckoning, but no column {', '.join(missing)}: add it")
    numbers = np.column_stack([_column(table, name) for name in RECKONED])
    known = np.isfinite(numbers).all(axis=1)
    poses = np.zeros((int(known.sum()), 6))
    poses[:, [0, 1, 5]] = numbers[known] * [1, 1, DEG]
    try:
        return DeadReckoning(Trajectory(poses, time[known]), _first(table, WALKS[0]), _first(table, WALKS[1]) * DEG)
    except MitsonarError as error:
        raise MitsonarError(f"{table.path}, dead reckoning: {error}") from None
