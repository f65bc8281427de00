"""Sequences of the CANOE data set: polar PNG of an Oculus M3000d with the bearings in two rows, poses as CSV.

Source of the layout: the data set's reference, github.com/utiasASRL/pycanoe (``DATA_REFERENCE.md``, ``pycanoe/data``). No
recording was at hand when this was written.

| file | content |
|---|---|
| ``sonar/<microseconds since 1970>.png`` | two rows: the bearing of each column, int16 in 0.01 deg; then a row a range bin |
| ``novatel/sonar_poses.csv`` | a row a picture: ``t, x, y, z, r, p, y, vx, vy, vz, wx, wy, wz, vx_bod, vy_bod, vz_bod`` |

What the reference does not tell, and what is done:

- The order of the bytes of a bearing. Every order is tried; the one that gives bearings which rise or fall evenly is taken.
- The window: 0 to 30 m, as the reference says of the sonar; the first range bin is the nearest.
- The side: negative bearings are to port, as in the messages of an Oculus. Check it by the rotation of the pictures.
- The axes of the poses' sensor frame. Up is the axis that stays upright, forward the level one along which the boat sails.
- The coding: amplitude^0.5, the usual one of an Oculus.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, counted
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.csv_table import CsvTable
from mitsonar.motion.pose import poses_from
from mitsonar.recordings.picture_file import Grey, is_whole, picture_size, read_picture
from mitsonar.recordings.recording import Facts, Part, Pixels, Recording, in_time_order, runs_of
from mitsonar.records.frames import SonarFrames

__all__ = ["is_canoe", "read_canoe"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

POSES = "novatel/sonar_poses.csv"

RANGE_MAX = 30.0
CARRIER_HZ, ELEVATION_DEG = 1.2e6, 20.0
"""Window [m] and carrier [Hz] by the reference; opening over elevation by the sonar's data sheet (not seen)."""

HEAD_ROWS = 2
"""Rows of bearings above the range bins."""

STEP_DEG = (0.01, 5.0)
"""Steps from beam to beam that can be [deg]."""

WIDEST_DEG = 90.0
"""Largest bearing [deg]."""

POSE_COLUMNS = 16

SAME_VELOCITY = 0.2
"""Largest difference of the velocity in the world and the turned one of the sensor, as part of it, in the median."""

UPRIGHT = 0.7
SAILS = 3.0
"""Least vertical part of the axis that is up; least ratio of the mean velocities along and across the sonar."""


def is_canoe(path: Path, first: bytes) -> bool:
    """Return whether a path is a sequence's folder of CANOE, with its poses or without."""
    if first or not (path / "sonar").is_dir() or not ((path / "novatel").is_dir() or (path / "calib").is_dir()):
        return False
    return any(_time_us(one) for one in (path / "sonar").glob("*.png"))


def read_canoe(path: Path) -> Recording:
    """Open a sequence of CANOE; pictures are read on demand. A change of the bearings makes a new part.

    Raises:
        MitsonarError: no picture that can be read, or bearings that cannot be.
    """
    found = sorted((time, one) for one in (path / "sonar").glob("*.png") if (time := _time_us(one)))
    whole = [(time, one) for time, one in found if is_whole(one)]
    notes = [f"left out: {counted(len(found) - len(whole), 'picture')} cut off"] if len(whole) < len(found) else []
    if not whole:
        raise MitsonarError(f"{path / 'sonar'} holds no whole picture")
    stamps, files = np.array([time for time, _ in whole], dtype=np.int64), [one for _, one in whole]
    poses, told = _poses(path / POSES, stamps)
    if poses is not None and not np.isfinite(poses).all():
        posed = np.flatnonzero(np.isfinite(poses).all(axis=1))
        notes.append(f"left out: {counted(len(files) - len(posed), 'picture')} without a pose")
        stamps, files, poses = stamps[posed], [files[place] for place in posed], poses[posed]
    times = np.asarray(stamps * 1e-6, dtype=float)
    kept, sorting = in_time_order(times)
    sizes = [picture_size(files[place]) for place in kept]
    parts = []
    for size, run in runs_of(sizes):
        assert isinstance(size, tuple)  # as they were given
        parts.append(_part([files[place] for place in kept[run]], size, times[kept[run]], poses, kept[run]))
    facts: Facts = {"pictures": len(files), "rows": sizes[0][0], "columns": sizes[0][1]}
    assumed = f"the window 0..{RANGE_MAX:g} m and the coding amplitude^0.5 are assumed: the files do not tell them"
    return Recording(str(path), "CANOE data set (Oculus as PNG)", tuple(parts), facts, (*notes, *sorting, *told, assumed))


def _time_us(path: Path) -> int:
    """Return the time that a picture's name tells [us since 1970]; 0 where it tells none."""
    return int(path.stem) if len(path.stem) == 16 and path.stem.isascii() and path.stem.isdigit() else 0


def _part(files: list[Path], size: tuple[int, int], times: Array, poses: Array | None, places: Index) -> Part:
    """Return the pictures of one size; their bearings are those of the first."""
    if size[0] < HEAD_ROWS + 2:
        raise MitsonarError(f"{files[0]} has {size[0]:,} rows: {HEAD_ROWS} of bearings and range bins are needed")
    head = read_picture(files[0], size)[:HEAD_ROWS]
    degrees = bearings_in(head, str(files[0]))
    rises = bool(degrees[-1] > degrees[0])
    bearings = np.radians(degrees if rises else degrees[::-1])
    bins, beams = size[0] - HEAD_ROWS, size[1]
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.1
    sonar = Sonar.create(
        name="oculus-m3000d",
        azimuth_fov_deg=min(180.0, float(np.degrees(bearings[-1] - bearings[0])) * beams / (beams - 1)),
        elevation_fov_deg=ELEVATION_DEG,
        beams=beams,
        range_min=0.0,
        range_max=RANGE_MAX,
        range_bins=bins,
        bearing="cone",
        frequency_hz=CARRIER_HZ,
        frame_rate_hz=min(1e6, 1 / step),
        coding="gamma",
        coding_gamma=0.5,
    )
    like = SonarFrames(np.zeros((0, bins, beams), np.uint8), sonar.range_m, bearings, np.zeros(0), sonar, level="gamma")
    return Part(like, times, _Png(tuple(files), size, head, rises), poses=None if poses is None else poses[places])


@dataclass(frozen=True)
class _Png:
    """Pictures below their rows of bearings, as images."""

    files: tuple[Path, ...]
    size: tuple[int, int]
    head: Grey
    rises: bool

    def __call__(self, index: Index) -> Pixels:
        """Return ``(n, bins, beams)`` uint8, column 0 most to port."""
        images = np.zeros((len(index), self.size[0] - HEAD_ROWS, self.size[1]), np.uint8)
        for place, number in enumerate(index):
            picture = read_picture(self.files[number], self.size)
            if picture.dtype != np.uint8 or not (picture[:HEAD_ROWS] == self.head).all():
                raise MitsonarError(f"{self.files[number]} has other bearings than the pictures before it: remove it")
            images[place] = picture[HEAD_ROWS:, :: 1 if self.rises else -1]
        return images


def bearings_in(head: Grey, source: str) -> Array:
    """Return the bearings ``(columns,)`` [deg] in two rows of bytes, in whichever order of bytes they rise or fall.

    Raises:
        MitsonarError: no order gives bearings that can be.
    """
    if head.dtype != np.uint8:
        raise MitsonarError(f"{source} has more than 8 bits a pixel: its bearings are bytes")
    columns = np.ascontiguousarray(head.T).astype(np.uint8)  # low and high byte of each column, one above the other
    along = np.ascontiguousarray(head).reshape(-1, 2)  # one beside the other, the first half of the columns first
    for pairs in (columns, along):
        for order in ("<i2", ">i2"):
            degrees = np.ascontiguousarray(pairs).view(order).ravel() * 0.01
            steps = np.diff(degrees) * np.sign(degrees[-1] - degrees[0])
            if steps.min() >= STEP_DEG[0] - 1e-9 and steps.max() <= STEP_DEG[1] and np.abs(degrees).max() <= WIDEST_DEG:
                return np.asarray(degrees, dtype=float)
    raise MitsonarError(f"the first two rows of {source} are no bearings that rise or fall: it is no picture of CANOE")


def _poses(path: Path, stamps: NDArray[np.int64]) -> tuple[Array | None, list[str]]:
    """Return the poses ``(pictures, 6)``, nan where a picture has none, and sentences on what was found."""
    if not path.is_file():
        return None, [f"there is no {POSES}: poses are not known"]
    table = CsvTable(path)
    if len(table.names) < POSE_COLUMNS:
        raise MitsonarError(f"{path} has {len(table.names)} columns: {POSE_COLUMNS} are needed")
    rows = {int(time): row for row, time in enumerate(table.whole_at(0))}
    values = table.columns_at(range(1, POSE_COLUMNS))
    fine = np.isfinite(values).all(axis=1) & (np.abs(values).max(axis=1) < 1e9)
    found = np.array([row if (row := rows.get(int(time), -1)) >= 0 and fine[row] else -1 for time in stamps], dtype=np.intp)
    if (found >= 0).sum() < max(2, len(stamps) // 2):
        return None, [f"left out: {POSES}, which has poses of {(found >= 0).sum():,} of {counted(len(stamps), 'picture')}"]
    values = values[found[found >= 0]]
    rotation = _to_world(values)
    body = None if rotation is None else _body(rotation, values[:, 12:15])
    if rotation is None or body is None:
        why = "angles and velocities disagree" if rotation is None else "the boat does not sail along an axis of the sonar"
        return None, [f"the axes of {POSES} could not be found, since {why}: poses are left out"]
    poses = np.full((len(stamps), 6), np.nan)
    poses[found >= 0] = poses_from(values[:, :3], rotation * body)
    return poses, []


def _to_world(values: Array) -> Rotation | None:
    """Return the rotations from sensor to world; None where the velocities in both contradict them.

    The reference multiplies passive rotations, C1(r) C2(p) C3(y). Whether its product or the inverse turns the sensor's
    velocity into the world's is tested.
    """
    world, own = values[:, 6:9], values[:, 12:15]
    product = Rotation.from_euler("XYZ", -values[:, 3:6])
    speed = np.linalg.norm(world, axis=1)
    moving = speed > 0.1 * max(float(speed.max()), 1e-9)
    if not speed.max() > 0:
        return None
    found = []
    for rotation in (product, product.inv()):
        off = np.linalg.norm(rotation.apply(own) - world, axis=1)[moving] / speed[moving]
        found.append((float(np.median(off)), rotation))
    least, best = min(found, key=lambda one: one[0])
    return best if least < SAME_VELOCITY else None


def _body(rotation: Rotation, velocity: Array) -> Rotation | None:
    """Return starboard, forward and up in the sensor's axes; None where they cannot be told.

    Args:
        rotation: from sensor to world.
        velocity: in the sensor's axes ``(pictures, 3)`` [m/s].
    """
    upright = rotation.as_matrix()[:, 2, :].mean(axis=0)
    vertical = int(np.abs(upright).argmax())
    level = [axis for axis in range(3) if axis != vertical]
    mean = velocity.mean(axis=0)
    ahead, across = sorted(level, key=lambda axis: -abs(mean[axis]))
    if abs(upright[vertical]) < UPRIGHT or abs(mean[ahead]) < SAILS * abs(mean[across]):
        return None
    up, forward = np.zeros(3), np.zeros(3)
    up[vertical], forward[ahead] = np.sign(upright[vertical]), np.sign(mean[ahead])
    return Rotation.from_matrix(np.column_stack([np.cross(forward, up), forward, up]))
