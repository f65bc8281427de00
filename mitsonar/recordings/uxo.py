"""Folders of the UXO data set (DFKI): raw ARIS samples as PGM, headers and poses of the rotator as CSV.

Source of the layout: scripts of the data set, github.com/dfki-ric/uxo-dataset2024 (``scripts/release_1_export.py``,
``common/aris_definitions.py``, ``common/tf_statics.yaml``). No recording was at hand when this was written.

| file | content |
|---|---|
| ``aris_raw/NNNN.pgm`` | samples x beams as the sonar recorded them, beam 0 most to starboard; NNNN is the frame's number |
| ``aris_frame_meta.csv`` | the header of each frame, columns by the names of the ARIS SDK |
| ``ar3.csv`` | pose of the rotator that carries the sonar: ``aris_frame_idx``, ``pos.x`` .., ``rot.x`` .. ``rot.w`` |
| ``gantry.csv`` | position of the crane, ``aris_frame_idx, x, y, z``; not used beside ``ar3.csv`` |
| ``aris_file_meta.yaml`` | the header of the file; not used, since the headers of the frames tell all of it |

Axes of the rotator are forward, starboard, down, by the place of the camera on it; the world's third axis is up. The sonar
is 0.109 m behind the rotator's axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, counted
from mitsonar.io.csv_table import CsvTable
from mitsonar.motion.pose import poses_from
from mitsonar.recordings.aris import BEAMS, FRAME, KINDS, facts_of, like_of, notes_of, windows_of
from mitsonar.recordings.header_motion import attitude_of, height_of
from mitsonar.recordings.picture_file import is_whole, read_picture
from mitsonar.recordings.ping_file import Header
from mitsonar.recordings.recording import Facts, Part, Pixels, Recording, in_time_order, runs_of

__all__ = ["is_uxo", "read_uxo"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

TABLE, IMAGES, ROTATOR = "aris_frame_meta.csv", "aris_raw", "ar3.csv"

NEEDED = {
    "index": "FrameIndex",
    "time_us": "FrameTime",
    "ping_mode": "PingMode",
    "sample_period_us": "SamplePeriod",
    "start_delay_us": "SampleStartDelay",
    "sound_speed": "SoundSpeed",
    "samples": "SamplesPerBeam",
}
"""Fields of a header and their columns, which must be there."""

OPTIONAL = {
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
"""Fields of a header, their columns, and what counts where a column is missing: an ARIS 3000 with its small lens."""

LIMITS = {"samples": (1, 65_536), "sample_period_us": (1, 1e6), "start_delay_us": (0, 1e8), "sound_speed": (1000, 2000)}
"""What a header may say, as in ARIS files."""

SONAR_AT = (-0.108725, 0.0, 0.0)
"""Place of the sonar in the rotator's axes [m]."""

FORWARD_STARBOARD_DOWN = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""Starboard, forward and up in the rotator's axes, as columns."""


def is_uxo(path: Path, first: bytes) -> bool:
    """Return whether a path is a recording's folder of the UXO data set."""
    return not first and (path / TABLE).is_file() and (path / IMAGES).is_dir()


def read_uxo(path: Path) -> Recording:
    """Open a recording of the UXO data set; its PGM files are read on demand.

    Ranges and beams are those of an ARIS file with the same headers. Poses are of the sonar, in the world of the tank, where
    ``ar3.csv`` has one for each frame. Pictures without a header, and headers without a picture, are left out.

    Raises:
        MitsonarError: a table that lacks a column, no frame that can be read.
    """
    table = CsvTable(path / TABLE)
    headers = _headers(table)
    files = {int(one.stem): one for one in (path / IMAGES).glob("*.pgm") if one.stem.isascii() and one.stem.isdigit()}
    whole = _whole(headers)
    there = np.array([int(index) in files and is_whole(files[int(index)]) for index in headers["index"]])
    notes = []
    if not whole.all():
        notes.append(f"left out: {counted(int((~whole).sum()), 'row')} of {TABLE} with numbers that cannot be")
    if not there.all():
        notes.append(f"left out: {counted(int((~there).sum()), 'frame')} of {TABLE} without a picture")
    extra = len(files) - len(set(files) & {int(index) for index in headers["index"]})
    if extra:
        notes.append(f"left out: {counted(extra, 'picture')} without a row in {TABLE}")
    usable = whole & there
    kept, sorting = in_time_order(np.where(usable, headers["time_us"] * 1e-6, np.nan), headers["index"])
    sorting = [note for note in sorting if "no valid time" not in note]
    poses, told = _poses(path / ROTATOR, headers["index"][kept])
    keys = [(int(headers["ping_mode"][k]), int(headers["samples"][k]), *key) for k, key in _keys(headers, kept)]
    parts = tuple(_part(headers[kept[run]], files, None if poses is None else poses[run]) for _, run in runs_of(keys))
    facts: Facts = facts_of(headers[kept], BEAMS[int(headers["ping_mode"][kept[0]])]) if len(kept) else {}
    return Recording(
        str(path), "UXO data set (ARIS as PGM)", parts, facts, (*notes, *sorting, *told, *notes_of(headers[kept]))
    )


def _headers(table: CsvTable) -> Header:
    """Return the rows of the table as headers of ARIS frames; numbers that are none become 0."""
    headers: Header = np.zeros(len(table), dtype=[(name, FRAME[name]) for name in FRAME.names or ()])
    for name, column in NEEDED.items():
        if headers.dtype[name].kind == "f":
            headers[name] = table.numbers(column)
        else:
            values = table.whole(column)
            most = min(int(np.iinfo(headers.dtype[name]).max), 2**62)
            headers[name] = np.where((values >= 0) & (values <= most), values, 0)
    for name, (column, default) in OPTIONAL.items():
        numbers = table.numbers(column, default)
        if headers.dtype[name].kind != "f":
            numbers = np.where((numbers >= 0) & (numbers < 2**31), numbers, 0)
        headers[name] = np.where(np.abs(numbers) < 1e12, numbers, np.nan if headers.dtype[name].kind == "f" else 0)
    return headers


def _whole(headers: Header) -> NDArray[np.bool_]:
    """Return which headers can be ``(frames,)``."""
    whole = np.isin(headers["ping_mode"], list(BEAMS)) & np.isin(headers["system"], list(KINDS)) & (headers["time_us"] > 0)
    for name, (low, high) in LIMITS.items():
        whole &= (headers[name] >= low) & (headers[name] <= high)
    return whole


def _keys(headers: Header, kept: Index) -> list[tuple[int, tuple[float, ...]]]:
    """Return the places of the kept frames with what their geometry follows from."""
    return list(zip(map(int, kept), windows_of(headers[kept]), strict=True))


def _part(mine: Header, files: dict[int, Path], poses: Array | None) -> Part:
    samples, beams = int(mine["samples"][0]), BEAMS[int(mine["ping_mode"][0])]
    paths = tuple(files[int(index)] for index in mine["index"])
    return Part(
        like=like_of(mine, samples, beams),
        time_s=mine["time_us"] * 1e-6,
        images=_Pgm(paths, (samples, beams)),
        poses=poses,
        attitude_rad=attitude_of(mine),
        height_m=height_of(mine),
        gain_db=mine["gain_db"].astype(float),
    )


@dataclass(frozen=True)
class _Pgm:
    """PGM files of samples as images."""

    paths: tuple[Path, ...]
    shape: tuple[int, int]

    def __call__(self, index: Index) -> Pixels:
        """Return ``(n, bins, beams)`` uint8, column 0 most to port."""
        images = np.zeros((len(index), *self.shape), np.uint8)
        for place, number in enumerate(index):
            picture = read_picture(self.paths[number], self.shape)
            if picture.dtype != np.uint8:
                raise MitsonarError(f"{self.paths[number]} has more than 8 bits a sample: ARIS samples have 8")
            images[place] = picture[:, ::-1]
        return images


def _poses(path: Path, index: NDArray[np.integer]) -> tuple[Array | None, list[str]]:
    """Return the poses ``(frames, 6)`` of the sonar by the rotator's, and a sentence where they are not known."""
    if not path.is_file():
        return None, [f"there is no {ROTATOR}: poses are not known"]
    table = CsvTable(path)
    rows = {int(number): row for row, number in enumerate(table.whole("aris_frame_idx"))}
    position = np.column_stack([table.numbers(f"pos.{axis}") for axis in "xyz"])
    turn = np.column_stack([table.numbers(f"rot.{axis}") for axis in "xyzw"])
    fine = np.isfinite(position).all(axis=1) & np.isfinite(turn).all(axis=1) & (np.abs(position).max(axis=1) < 1e6)
    fine &= np.abs(np.linalg.norm(np.where(np.isfinite(turn), turn, 0), axis=1) - 1) < 0.01
    found = np.array([rows.get(int(number), -1) for number in index], dtype=np.intp)
    if (found < 0).any() or not fine[found].all():
        lacking = int(((found < 0) | ~fine[found]).sum())
        return None, [f"left out: the poses, for {ROTATOR} has no valid one for {counted(lacking, 'frame')}"]
    rotation = Rotation.from_quat(turn[found])
    return poses_from(position[found] + rotation.apply(SONAR_AT), rotation * FORWARD_STARBOARD_DOWN), []
