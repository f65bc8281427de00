"""How are public data sets read? CANOE (Oculus as PNG), UXO of DFKI (ARIS as PGM), and views of neusis (pickles).

No recording of CANOE or UXO was available when their readers were written; :func:`read_canoe`, :func:`read_uxo` and
:func:`read_neusis` name the sources of the layouts.
"""

from __future__ import annotations

import io
import math
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, argument, count_noun
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.csv_table import CsvTable
from mitsonar.io.files import FileArray, PlainValue, finite_number, read_bytes, read_json
from mitsonar.motion.pose import poses_from
from mitsonar.recordings.pictures import Grey, is_complete, natural_key, picture_size, read_picture
from mitsonar.recordings.recording import ELEVATION_PATTERN, Facts, Header, Part, Pixels, Recording, in_time_order, runs_of
from mitsonar.recordings.sound_metrics import (
    BEAMS,
    FRAME,
    KINDS,
    attitude_of,
    empty_aris_frames,
    facts_of,
    height_of,
    notes_of,
    windows_of,
)
from mitsonar.records.frames import SonarFrames

__all__ = ["is_canoe", "is_neusis", "is_uxo", "read_canoe", "read_neusis", "read_pickled_arrays", "read_uxo"]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

POSES = "novatel/sonar_poses.csv"

RANGE_MAX = 30.0
CARRIER_HZ, ELEVATION_DEG = 1.2e6, 20.0
"""Window [m] and carrier [Hz] from the reference of the data set; elevation aperture [deg] from a data sheet (not seen)."""

HEAD_ROWS = 2
"""Number of rows with bearings above the range bins."""

STEP_DEG = (0.01, 5.0)
"""Smallest and largest plausible step between beams [deg]."""

MAX_BEARING_DEG = 90.0
"""Largest plausible bearing [deg]."""

POSE_COLUMNS = 16

VELOCITY_TOLERANCE = 0.2
"""Largest median difference between the world velocity and the rotated sensor velocity, as a fraction of the speed."""

MIN_UPRIGHT = 0.7
MIN_SAILING_RATIO = 3.0
"""Minimum mean vertical component of the up axis; minimum ratio of mean velocities along and across the sonar."""


def is_canoe(path: Path, first: bytes) -> bool:
    """Return whether a path is the folder of a CANOE sequence, with or without poses."""
    if first or not (path / "sonar").is_dir() or not ((path / "novatel").is_dir() or (path / "calib").is_dir()):
        return False
    return any(_time_us(one) for one in (path / "sonar").glob("*.png"))


def read_canoe(path: Path) -> Recording:
    """Open a sequence of CANOE; pictures are read on demand. A change of the picture size starts a new part.

    Source of the layout: the reference of the data set, github.com/utiasASRL/pycanoe (``DATA_REFERENCE.md``,
    ``pycanoe/data``). The sonar is an Oculus M3000d.

    | file | content |
    |---|---|
    | ``sonar/<microseconds since 1970>.png`` | two rows: the bearing of each column, int16 in 0.01 deg; then a row per bin |
    | ``novatel/sonar_poses.csv`` | a row per picture, columns as below |

    The columns are ``t, x, y, z, r, p, y, vx, vy, vz, wx, wy, wz, vx_bod, vy_bod, vz_bod``.
    The reference leaves some questions open, which are resolved as follows:

    - Byte order of a bearing: every order is tried, and the one that gives evenly rising or falling bearings is used.
    - Window: 0 to 30 m, as the reference states for the sonar; the first range bin is the nearest.
    - Side: negative bearings are to port, as in the messages of an Oculus. Check it by the rotation of the pictures.
    - Axes of the sensor frame of the poses: up is the axis that stays upright, forward is the level axis along which the
      boat sails.
    - Coding: amplitude^0.5, which is usual for an Oculus.

    Raises:
        MitsonarError: if no picture can be read, or bearings are not plausible.
    """
    # 1. List the complete pictures and their times.
    pictures = sorted((time, one) for one in (path / "sonar").glob("*.png") if (time := _time_us(one)))
    complete = [(time, one) for time, one in pictures if is_complete(one)]
    notes = (
        [f"left out: {count_noun(len(pictures) - len(complete), 'picture')} cut off"]
        if len(complete) < len(pictures)
        else []
    )
    if not complete:
        raise MitsonarError(f"{path / 'sonar'} holds no complete picture")
    stamps, files = np.array([time for time, _ in complete], dtype=np.int64), [one for _, one in complete]
    # 2. Assign poses, and leave out pictures without one if there are any poses.
    poses, pose_notes = _canoe_poses(path / POSES, stamps)
    if poses is not None and not np.isfinite(poses).all():
        posed = np.flatnonzero(np.isfinite(poses).all(axis=1))
        notes.append(f"left out: {count_noun(len(files) - len(posed), 'picture')} without a pose")
        stamps, files, poses = stamps[posed], [files[place] for place in posed], poses[posed]
    # 3. Make a part of each run of pictures of the same size.
    times = np.asarray(stamps * 1e-6, dtype=float)
    order, order_notes = in_time_order(times)
    sizes = [picture_size(files[place]) for place in order]
    parts = []
    for size, run in runs_of(sizes):
        assert isinstance(size, tuple)  # the keys of runs_of are the sizes
        parts.append(_canoe_part([files[place] for place in order[run]], size, times[order[run]], poses, order[run]))
    facts: Facts = {"pictures": len(files), "rows": sizes[0][0], "columns": sizes[0][1]}
    assumed = f"the window 0..{RANGE_MAX:g} m and the coding amplitude^0.5 are assumed: the files do not state them"
    return Recording(
        str(path), "CANOE data set (Oculus as PNG)", tuple(parts), facts, (*notes, *order_notes, *pose_notes, assumed)
    )


def _time_us(path: Path) -> int:
    """Return the time in the name of a picture [us since 1970]; 0 if there is none."""
    return int(path.stem) if len(path.stem) == 16 and path.stem.isascii() and path.stem.isdigit() else 0


def _canoe_part(files: list[Path], size: tuple[int, int], times: Array, poses: Array | None, places: Index) -> Part:
    """Return a part of pictures of one size; their bearings are those of the first picture."""
    if size[0] < HEAD_ROWS + 2:
        raise MitsonarError(f"{files[0]} has {size[0]:,} rows: it needs {HEAD_ROWS} rows of bearings, and range bins")
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
        elevation_pattern=ELEVATION_PATTERN,
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
    """Function that reads the images of a part of CANOE, without their rows of bearings."""

    files: tuple[Path, ...]
    size: tuple[int, int]
    head: Grey
    rises: bool

    def __call__(self, index: Index) -> Pixels:
        """Return images ``(n, bins, beams)`` uint8, column 0 farthest to port."""
        images = np.zeros((len(index), self.size[0] - HEAD_ROWS, self.size[1]), np.uint8)
        for place, number in enumerate(index):
            picture = read_picture(self.files[number], self.size)
            if picture.dtype != np.uint8 or not (picture[:HEAD_ROWS] == self.head).all():
                raise MitsonarError(
                    f"{self.files[number]} has different bearings from those of the pictures before it: remove it"
                )
            images[place] = picture[HEAD_ROWS:, :: 1 if self.rises else -1]
        return images


def bearings_in(head: Grey, source: str) -> Array:
    """Decode the bearings ``(columns,)`` [deg] in two rows of bytes, in the byte order in which they rise or fall.

    Raises:
        MitsonarError: if no byte order gives plausible bearings.
    """
    if head.dtype != np.uint8:
        raise MitsonarError(f"{source} has more than 8 bits per pixel, but bearings are bytes: it is not a picture of CANOE")
    columns = np.ascontiguousarray(head.T).astype(np.uint8)  # the two bytes of a bearing are above one another
    along = np.ascontiguousarray(head).reshape(-1, 2)  # they are side by side; row 0 holds the first half of the columns
    for pairs in (columns, along):
        for order in ("<i2", ">i2"):
            degrees = np.ascontiguousarray(pairs).view(order).ravel() * 0.01
            steps = np.diff(degrees) * np.sign(degrees[-1] - degrees[0])
            if steps.min() >= STEP_DEG[0] - 1e-9 and steps.max() <= STEP_DEG[1] and np.abs(degrees).max() <= MAX_BEARING_DEG:
                return np.asarray(degrees, dtype=float)
    raise MitsonarError(
        f"the first two rows of {source} are not increasing or decreasing bearings: it is not a picture of CANOE"
    )


def _canoe_poses(path: Path, stamps: NDArray[np.int64]) -> tuple[Array | None, list[str]]:
    """Return the poses ``(pictures, 6)``, nan for pictures without one, and sentences on why poses are unknown."""
    if not path.is_file():
        return None, [f"there is no {POSES}: poses are not known"]
    table = CsvTable(path)
    if len(table.names) < POSE_COLUMNS:
        raise MitsonarError(f"{path} has {len(table.names)} columns: {POSE_COLUMNS} are needed")
    # 1. Match rows and pictures by time, and drop rows with implausible values.
    rows = {int(time): row for row, time in enumerate(table.whole_at(0))}
    values = table.columns_at(range(1, POSE_COLUMNS))
    valid = np.isfinite(values).all(axis=1) & (np.abs(values).max(axis=1) < 1e9)
    row_index = np.array(
        [row if (row := rows.get(int(time), -1)) >= 0 and valid[row] else -1 for time in stamps], dtype=np.intp
    )
    if (row_index >= 0).sum() < max(2, len(stamps) // 2):
        return None, [
            f"left out: {POSES}, which has poses of {(row_index >= 0).sum():,} of {count_noun(len(stamps), 'picture')}"
        ]
    # 2. Determine which rotation the angles describe, and which of its axes are starboard, forward and up.
    values = values[row_index[row_index >= 0]]
    rotation = _sensor_to_world(values)
    body = None if rotation is None else _sensor_axes(rotation, values[:, 12:15])
    if rotation is None or body is None:
        why = "angles and velocities disagree" if rotation is None else "the boat does not sail along an axis of the sonar"
        return None, [f"the axes of {POSES} could not be found, since {why}: poses are left out"]
    poses = np.full((len(stamps), 6), np.nan)
    poses[row_index >= 0] = poses_from(values[:, :3], rotation * body)
    return poses, []


def _sensor_to_world(values: Array) -> Rotation | None:
    """Return the rotations from sensor to world; None if the velocities in both frames contradict them.

    The reference multiplies passive rotations, C1(r) C2(p) C3(y). The velocities decide whether this product or its inverse
    rotates the sensor velocity to the world velocity.
    """
    world_velocity, sensor_velocity = values[:, 6:9], values[:, 12:15]
    product = Rotation.from_euler("XYZ", -values[:, 3:6])
    speed = np.linalg.norm(world_velocity, axis=1)
    moving = speed > 0.1 * max(float(speed.max()), 1e-9)
    if not speed.max() > 0:
        return None
    candidates = []
    for rotation in (product, product.inv()):
        error = np.linalg.norm(rotation.apply(sensor_velocity) - world_velocity, axis=1)[moving] / speed[moving]
        candidates.append((float(np.median(error)), rotation))
    smallest_error, best = min(candidates, key=lambda one: one[0])
    return best if smallest_error < VELOCITY_TOLERANCE else None


def _sensor_axes(rotation: Rotation, velocity: Array) -> Rotation | None:
    """Return starboard, forward and up in the sensor's axes, as columns; None if they cannot be determined.

    Args:
        rotation: rotations from sensor to world.
        velocity: velocities in the sensor's axes ``(pictures, 3)`` [m/s].
    """
    upright = rotation.as_matrix()[:, 2, :].mean(axis=0)
    vertical = int(np.abs(upright).argmax())
    level = [axis for axis in range(3) if axis != vertical]
    mean = velocity.mean(axis=0)
    ahead, across = sorted(level, key=lambda axis: -abs(mean[axis]))
    if abs(upright[vertical]) < MIN_UPRIGHT or abs(mean[ahead]) < MIN_SAILING_RATIO * abs(mean[across]):
        return None
    up, forward = np.zeros(3), np.zeros(3)
    up[vertical], forward[ahead] = np.sign(upright[vertical]), np.sign(mean[ahead])
    return Rotation.from_matrix(np.column_stack([np.cross(forward, up), forward, up]))


# ---------------- UXO data set (DFKI)


TABLE, IMAGES, ROTATOR = "aris_frame_meta.csv", "aris_raw", "ar3.csv"

REQUIRED_COLUMNS = {
    "index": "FrameIndex",
    "time_us": "FrameTime",
    "ping_mode": "PingMode",
    "sample_period_us": "SamplePeriod",
    "start_delay_us": "SampleStartDelay",
    "sound_speed": "SoundSpeed",
    "samples": "SamplesPerBeam",
}
"""Columns of the required fields of a header."""

OPTIONAL_COLUMNS = {
    "gain_db": ("ReceiverGain", 0.0),
    "depth_m": ("Depth", 0.0),
    "altitude_m": ("Altitude", 0.0),
    "heading_deg": ("CompassHeading", np.nan),
    "pitch_deg": ("CompassPitch", np.nan),
    "roll_deg": ("CompassRoll", np.nan),
    "temperature_c": ("WaterTemp", np.nan),
    "high_frequency": ("FrequencyHiLow", 1.0),
    "pulse_us": ("PulseWidth", 0.0),
    "frame_rate_hz": ("FrameRate", 0.0),
    "large_lens": ("LargeLens", 0.0),
    "system": ("TheSystemType", 1.0),
    "serial": ("SonarSerialNumber", 0.0),
}
"""Columns and default values of the optional fields of a header; the defaults are an ARIS 3000 with its small lens."""

LIMITS = {"samples": (1, 65_536), "sample_period_us": (1, 1e6), "start_delay_us": (0, 1e8), "sound_speed": (1000, 2000)}
"""Plausible values of a header, as in ARIS files."""

SONAR_AT = (-0.108725, 0.0, 0.0)
"""Position of the sonar in the rotator's axes [m]."""

FORWARD_STARBOARD_DOWN = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""Starboard, forward and up in the rotator's axes, as columns."""


def is_uxo(path: Path, first: bytes) -> bool:
    """Return whether a path is the folder of a recording of the UXO data set."""
    return not first and (path / TABLE).is_file() and (path / IMAGES).is_dir()


def read_uxo(path: Path) -> Recording:
    """Open a recording of the UXO data set; its PGM files are read on demand.

    Ranges and beams are those of an ARIS file with the same headers. Poses are those of the sonar in the world frame of the
    tank, if ``ar3.csv`` has one for each frame. Pictures without a header and headers without a picture are left out.

    Source of the layout: scripts of the data set, github.com/dfki-ric/uxo-dataset2024 (``scripts/release_1_export.py``,
    ``common/aris_definitions.py``, ``common/tf_statics.yaml``).

    | file | content |
    |---|---|
    | ``aris_raw/NNNN.pgm`` | samples x beams as recorded by the sonar, beam 0 farthest to starboard; NNNN: frame number |
    | ``aris_frame_meta.csv`` | the header of each frame; columns are named as in the ARIS SDK |
    | ``ar3.csv`` | pose of the rotator that carries the sonar: ``aris_frame_idx``, ``pos.x`` .., ``rot.x`` .. ``rot.w`` |
    | ``gantry.csv`` | position of the crane, ``aris_frame_idx, x, y, z``; not used in addition to ``ar3.csv`` |
    | ``aris_file_meta.yaml`` | the header of the file; not used, since the frame headers contain all of it |

    The axes of the rotator are forward, starboard, down, according to the position of the camera on it. The third axis of
    the world points up. The sonar is 0.109 m behind the axis of the rotator.

    Raises:
        MitsonarError: if the table lacks a column, or no frame can be read.
    """
    # 1. Find the frames that have both a plausible header and a complete picture.
    table = CsvTable(path / TABLE)
    headers = _headers(table)
    files = {int(one.stem): one for one in (path / IMAGES).glob("*.pgm") if one.stem.isascii() and one.stem.isdigit()}
    plausible = _are_plausible(headers)
    has_picture = np.array([int(index) in files and is_complete(files[int(index)]) for index in headers["index"]])
    notes = []
    if not plausible.all():
        notes.append(f"left out: {count_noun(int((~plausible).sum()), 'row')} of {TABLE} with implausible numbers")
    if not has_picture.all():
        notes.append(f"left out: {count_noun(int((~has_picture).sum()), 'frame')} of {TABLE} without a picture")
    extra = len(files) - len(set(files) & {int(index) for index in headers["index"]})
    if extra:
        notes.append(f"left out: {count_noun(extra, 'picture')} without a row in {TABLE}")
    # 2. Sort them by time, assign poses, and make a part of each run of frames with the same geometry.
    usable = plausible & has_picture
    order, order_notes = in_time_order(np.where(usable, headers["time_us"] * 1e-6, np.nan), headers["index"])
    order_notes = [note for note in order_notes if "without a valid time" not in note]
    poses, pose_notes = _uxo_poses(path / ROTATOR, headers["index"][order])
    modes, samples = headers["ping_mode"][order].tolist(), headers["samples"][order].tolist()
    keys = [(*one, *window) for *one, window in zip(modes, samples, windows_of(headers[order]), strict=True)]
    parts = tuple(_uxo_part(headers[order[run]], files, None if poses is None else poses[run]) for _, run in runs_of(keys))
    facts: Facts = facts_of(headers[order], BEAMS[int(headers["ping_mode"][order[0]])]) if len(order) else {}
    return Recording(
        str(path), "UXO data set (ARIS as PGM)", parts, facts, (*notes, *order_notes, *pose_notes, *notes_of(headers[order]))
    )


def _headers(table: CsvTable) -> Header:
    """Return the rows of the table as headers of ARIS frames; invalid integers become 0, invalid floats nan."""
    headers: Header = np.zeros(len(table), dtype=[(name, FRAME[name]) for name in FRAME.names or ()])
    for name, column in REQUIRED_COLUMNS.items():
        if headers.dtype[name].kind == "f":
            headers[name] = table.numbers(column)
        else:
            values = table.whole(column)
            most = min(int(np.iinfo(headers.dtype[name]).max), 2**62)
            headers[name] = np.where((values >= 0) & (values <= most), values, 0)
    for name, (column, default) in OPTIONAL_COLUMNS.items():
        numbers = table.numbers(column, default)
        if headers.dtype[name].kind != "f":
            numbers = np.where((numbers >= 0) & (numbers < 2**31), numbers, 0)
        headers[name] = np.where(np.abs(numbers) < 1e12, numbers, np.nan if headers.dtype[name].kind == "f" else 0)
    return headers


def _are_plausible(headers: Header) -> NDArray[np.bool_]:
    """Return which headers ``(frames,)`` are plausible."""
    plausible = (
        np.isin(headers["ping_mode"], list(BEAMS)) & np.isin(headers["system"], list(KINDS)) & (headers["time_us"] > 0)
    )
    for name, (low, high) in LIMITS.items():
        plausible &= (headers[name] >= low) & (headers[name] <= high)
    return plausible


def _uxo_part(headers: Header, files: dict[int, Path], poses: Array | None) -> Part:
    samples, beams = int(headers["samples"][0]), BEAMS[int(headers["ping_mode"][0])]
    paths = tuple(files[int(index)] for index in headers["index"])
    return Part(
        like=empty_aris_frames(headers, samples, beams),
        time_s=headers["time_us"] * 1e-6,
        images=_Pgm(paths, (samples, beams)),
        poses=poses,
        attitude_rad=attitude_of(headers),
        height_m=height_of(headers),
        gain_db=headers["gain_db"].astype(float),
    )


@dataclass(frozen=True)
class _Pgm:
    """Function that reads the images of a part of UXO."""

    paths: tuple[Path, ...]
    shape: tuple[int, int]

    def __call__(self, index: Index) -> Pixels:
        """Return images ``(n, bins, beams)`` uint8, column 0 farthest to port."""
        images = np.zeros((len(index), *self.shape), np.uint8)
        for place, number in enumerate(index):
            picture = read_picture(self.paths[number], self.shape)
            if picture.dtype != np.uint8:
                raise MitsonarError(f"{self.paths[number]} has more than 8 bits per sample: ARIS samples have 8")
            images[place] = picture[:, ::-1]
        return images


def _uxo_poses(path: Path, index: NDArray[np.integer]) -> tuple[Array | None, list[str]]:
    """Return the poses of the sonar ``(frames, 6)`` from those of the rotator, or None and a sentence on why."""
    if not path.is_file():
        return None, [f"there is no {ROTATOR}: poses are not known"]
    table = CsvTable(path)
    rows = {int(number): row for row, number in enumerate(table.whole("aris_frame_idx"))}
    position = np.column_stack([table.numbers(f"pos.{axis}") for axis in "xyz"])
    quaternion = np.column_stack([table.numbers(f"rot.{axis}") for axis in "xyzw"])
    valid = np.isfinite(position).all(axis=1) & np.isfinite(quaternion).all(axis=1) & (np.abs(position).max(axis=1) < 1e6)
    valid &= np.abs(np.linalg.norm(np.where(np.isfinite(quaternion), quaternion, 0), axis=1) - 1) < 0.01
    row_index = np.array([rows.get(int(number), -1) for number in index], dtype=np.intp)
    if (row_index < 0).any() or not valid[row_index].all():
        missing = int(((row_index < 0) | ~valid[row_index]).sum())
        return None, [f"left out: the poses, because {ROTATOR} has no valid one for {count_noun(missing, 'frame')}"]
    rotation = Rotation.from_quat(quaternion[row_index])
    return poses_from(position[row_index] + rotation.apply(SONAR_AT), rotation * FORWARD_STARBOARD_DOWN), []


# ---------------- Views of neusis


IMAGE, POSE = "ImagingSonar", "PoseSensor"

RATE_HZ = 10.0
"""Assumed frame rate of views, which have no times [Hz]."""

MAX_CELLS = 2**25
"""Maximum number of cells of a view."""

FORWARD_PORT_UP = Rotation.from_matrix([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
"""Starboard, forward and up in the sensor's axes, as columns."""

ORTHOGONALITY_TOLERANCE = 1e-3
"""Largest tolerated error of the orthogonality of a rotation matrix."""


def is_neusis(path: Path, first: bytes) -> bool:
    """Return whether a path is a folder of views with their configuration."""
    return not first and (path / "Config.json").is_file() and (path / "Data").is_dir()


def read_neusis(path: Path) -> Recording:
    """Open a folder of views as stored by neusis and other acoustic radiance fields: pickles, and a JSON file of the sonar.

    Each view is read once for its pose and largest value, and again on demand.

    Source of the layout: github.com/rpl-cmu/neusis (``load_data.py``, ``helpers.py``), whose views come from HoloOcean.

    | file | content |
    |---|---|
    | ``Data/*.pkl`` | a dictionary with ``ImagingSonar`` (bins x beams) and ``PoseSensor`` (4 x 4, sensor to world) |
    | ``Config.json`` | of a sensor ``ImagingSonar``: ``Azimuth``, ``Elevation`` [deg], ``RangeMin``, ``RangeMax`` [m] |

    Row 0 is the nearest range. Column 0 has the bearing -Azimuth / 2 about the sensor's third axis. That axis points up and
    the first one forward, so that column 0 is the one farthest to starboard. Views have no times: they are ordered by name
    and assumed to be recorded at 10 Hz. Levels are assumed to be linear. If a value exceeds 1, all values are divided by the
    largest.

    Raises:
        MitsonarError: if there is no configuration or no readable view, views differ in size, or a pose is invalid.
    """
    settings = _sonar_settings(path / "Config.json")
    files = sorted((path / "Data").glob("*.pkl"), key=lambda one: natural_key(one.name))
    if not files:
        raise MitsonarError(f"{path / 'Data'} holds no .pkl file")
    shape, largest, matrices = None, 0.0, []
    for file in files:
        image, matrix = _view(file)
        if shape is not None and image.shape != shape:
            raise MitsonarError(f"{file} has {image.shape} cells, the others have {shape}: remove it")
        shape = image.shape
        largest = max(largest, float(image.max()))
        matrices.append(matrix)
    assert shape is not None  # there is a file
    poses = np.array(matrices)
    rotation = Rotation.from_matrix(poses[:, :3, :3])
    sonar = Sonar.create(
        name="imaging-sonar",
        azimuth_fov_deg=settings["Azimuth"],
        elevation_fov_deg=settings["Elevation"],
        range_min=settings["RangeMin"],
        range_max=settings["RangeMax"],
        beams=shape[1],
        range_bins=shape[0],
        frame_rate_hz=RATE_HZ,
    )
    part = Part(
        SonarFrames(np.zeros((0, *shape), np.float32), sonar.range_m, sonar.bearing_rad, np.zeros(0), sonar),
        np.arange(len(files)) / RATE_HZ,
        _Views(tuple(files), (shape[0], shape[1]), max(1.0, largest)),
        poses=poses_from(poses[:, :3, 3], rotation * FORWARD_PORT_UP),
    )
    facts: Facts = {"views": len(files), "largest_value": largest}
    notes = [f"views have no times: they are ordered by name, at an assumed {RATE_HZ:g} Hz"]
    if largest > 1:
        notes.append(f"values reach {largest:.4g}: they are divided by it")
    return Recording(str(path), "views (neusis)", (part,), facts, tuple(notes))


@dataclass(frozen=True)
class _Views:
    """Function that reads the images of views."""

    files: tuple[Path, ...]
    shape: tuple[int, int]
    largest: float

    def __call__(self, index: NDArray[np.intp]) -> Pixels:
        """Return images ``(n, bins, beams)`` float32 in 0..1, column 0 farthest to port."""
        images = np.zeros((len(index), *self.shape), np.float32)
        for place, number in enumerate(index):
            image, _ = _view(self.files[number])
            if image.shape != self.shape:
                raise MitsonarError(f"{self.files[number]} has changed while it was read")
            images[place] = np.clip(image[:, ::-1] / self.largest, 0, 1)
        return images


def _view(path: Path) -> tuple[FileArray, Array]:
    """Return the image ``(bins, beams)`` and the pose ``(4, 4)`` of a view."""
    table = read_pickled_arrays(path)
    missing = [name for name in (IMAGE, POSE) if name not in table]
    if missing:
        raise MitsonarError(f"{path} lacks {' and '.join(missing)}: it is not a view of a sonar")
    image, matrix = table[IMAGE], np.asarray(table[POSE], dtype=float)
    if image.ndim != 2 or min(image.shape) < 2 or image.size > MAX_CELLS or not np.isfinite(image).all() or image.min() < 0:
        raise MitsonarError(f"{IMAGE} of {path} must be an image (bins, beams) of finite values from 0: got {image.shape}")
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or np.abs(matrix[:3, 3]).max() > 1e6:
        raise MitsonarError(f"{POSE} of {path} must be a matrix (4, 4) of finite numbers: got shape {matrix.shape}")
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ORTHOGONALITY_TOLERANCE or np.linalg.det(rotation) < 0:
        raise MitsonarError(f"{POSE} of {path} holds no rotation: its columns must be orthogonal unit vectors")
    return image, matrix


def _sonar_settings(path: Path) -> dict[str, float]:
    """Return the field of view [deg] and the window [m] of the imaging sonar in a configuration of HoloOcean."""
    table = read_json(path)
    agents = table.get("agents")
    first: PlainValue = agents[0] if isinstance(agents, list) and agents and isinstance(agents[0], dict) else {}
    sensors = first.get("sensors")
    for sensor in sensors if isinstance(sensors, list) else []:
        if isinstance(sensor, dict) and sensor.get("sensor_type") == IMAGE and isinstance(sensor.get("configuration"), dict):
            values = sensor["configuration"]
            keys = ("Azimuth", "Elevation", "RangeMin", "RangeMax")
            return {key: finite_number(values.get(key), argument(f"{key} of {path}"), -1, 1e5) for key in keys}
    raise MitsonarError(f"{path} holds no sensor of type {IMAGE} with a configuration: give a Config.json of HoloOcean")


# ---------------- Safe reading of pickled arrays


MAX_PICKLE_BYTES = 2**30
"""Maximum size of a pickle [bytes]."""

MAX_DIMENSIONS = 8

NUMBER_KINDS = "biuf"
"""Supported kinds of NumPy type."""

PickledValue = Any
"""Content of a pickle: numbers, strings, bytes, tuples, lists, dictionaries, and the recording objects below."""


class _StandIn:
    """A stand-in for an object of a pickle, which only records its constructor arguments and its state."""

    def __init__(self, *arguments: PickledValue) -> None:
        self.arguments = arguments
        self.state: PickledValue = None

    def __setstate__(self, state: PickledValue) -> None:
        self.state = state


class _ArrayStandIn(_StandIn):
    """An array; its state is version, shape, type, Fortran order, bytes."""


class _TypeStandIn(_StandIn):
    """A NumPy type, constructed from its name; its state begins with version and byte order."""


class _ScalarStandIn(_StandIn):
    """A NumPy scalar, constructed from its type and bytes."""


class _ClassStandIn(_StandIn):
    """A class that is only referred to by name."""


def _encode(text: PickledValue, coding: PickledValue) -> bytes:
    """Return bytes that old pickles store as a Latin 1 string."""
    if not isinstance(text, str) or coding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError("bytes that are not Latin-1 text")
    return text.encode("latin1")


STAND_INS: dict[tuple[str, str], Any] = {
    **{
        (f"numpy.{core}.{module}", name): stand_in
        for core in ("core", "_core")
        for module, name, stand_in in (
            ("multiarray", "_reconstruct", _ArrayStandIn),
            ("multiarray", "scalar", _ScalarStandIn),
            ("numeric", "_frombuffer", _ArrayStandIn),
        )
    },
    ("numpy", "ndarray"): _ClassStandIn,
    ("numpy", "dtype"): _TypeStandIn,
    ("_codecs", "encode"): _encode,
}
"""Names that a pickle may contain, and the stand-ins for them."""


class _ArrayUnpickler(pickle._Unpickler):  # the Python implementation, whose memory use is bounded by the file size
    """Unpickler that accepts known names only, and sets the state of stand-ins only."""

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)
    stack: list[Any]

    def find_class(self, module: str, name: str) -> Any:
        """Return the stand-in for a name.

        Raises:
            UnpicklingError: if the name is not known.
        """
        if (module, name) not in STAND_INS:
            raise pickle.UnpicklingError(f"it names {module[:60]}.{name[:60]}, which is not part of an array")
        return STAND_INS[module, name]

    def persistent_load(self, pid: Any) -> Any:
        """Reject references to objects outside the file."""
        raise pickle.UnpicklingError("it refers to another file")

    def load_build(self) -> None:
        """Set the state of the object on the stack, which must be a stand-in."""
        if not isinstance(self.stack[-2], _StandIn):
            raise pickle.UnpicklingError("it changes something that is not an array")
        state = self.stack.pop()
        self.stack[-1].__setstate__(state)

    dispatch[pickle.BUILD[0]] = load_build


def read_pickled_arrays(path: Path) -> dict[str, FileArray]:
    """Read the arrays and numbers of a pickled dictionary, keyed by name; other values are left out.

    Pickles are programs, but nothing that the file names is executed. Only the few names that make up an array are accepted,
    and replaced by objects that record what they are given. Arrays are built from the recorded bytes after their sizes have
    been checked.

    Raises:
        MitsonarError: if the file does not exist, holds no dictionary, or refers to anything other than NumPy arrays.
    """
    content = read_bytes(path, "pickle", MAX_PICKLE_BYTES)
    try:
        table = _ArrayUnpickler(io.BytesIO(content)).load()
        if not isinstance(table, dict):
            raise pickle.UnpicklingError("it holds no dictionary")
        return {str(name): array for name, value in table.items() if (array := _array(value)) is not None}
    except Exception as error:  # damaged bytes raise errors of many kinds
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise MitsonarError(f"cannot read the pickle {path}: {reason}; only arrays of NumPy are read from pickles") from None


def _array(value: PickledValue) -> FileArray | None:
    """Return the array that a value of a pickle represents; None if it represents none."""
    if isinstance(value, bool | int | float):
        return np.asarray(value, dtype=float) if abs(value) < 1e300 or value != value else None
    if isinstance(value, _ScalarStandIn):
        kind, content = (*value.arguments, None, None)[:2]
        return _from_bytes(content, kind, (), "C")
    if not isinstance(value, _ArrayStandIn):
        return None
    if value.state is None:  # constructed by _frombuffer: bytes, type, shape, order
        content, kind, shape, order = (*value.arguments, None, None, None, None)[:4]
        return _from_bytes(content, kind, shape, order)
    if not isinstance(value.state, tuple) or len(value.state) != 5:
        raise ValueError("an array has an invalid state")
    _, shape, kind, fortran, content = value.state
    return _from_bytes(content, kind, shape, "F" if fortran else "C")


def _from_bytes(content: PickledValue, kind: PickledValue, shape: PickledValue, order: PickledValue) -> FileArray:
    """Build an array from bytes, after its type and shape have been checked against their number."""
    if not isinstance(kind, _TypeStandIn) or not kind.arguments or not isinstance(kind.arguments[0], str):
        raise ValueError("an array has an invalid type")
    name = kind.arguments[0]
    big_endian = isinstance(kind.state, tuple) and len(kind.state) > 1 and kind.state[1] == ">"
    if name[:1] not in NUMBER_KINDS or not name[1:].isdigit() or len(name) > 3:
        raise ValueError(f"an array of type {name[:20]} holds no numbers")
    dtype = np.dtype(name).newbyteorder(">" if big_endian else "<")
    if not isinstance(shape, tuple) or len(shape) > MAX_DIMENSIONS or order not in ("C", "F"):
        raise ValueError("an array has an invalid shape")
    if not all(type(length) is int and 0 <= length < 2**40 for length in shape):
        raise ValueError("an array has an invalid shape")
    if not isinstance(content, bytes | bytearray) or math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError("the number of bytes of an array does not match its shape")
    return np.frombuffer(bytes(content), dtype).reshape(shape, order=order).astype(dtype.newbyteorder("="))
