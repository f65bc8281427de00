"""How is a recording of a Tritech Gemini read? GLF files (``.glf``), whose records ``pytritech`` parses.

No real file was available: the reader is tested on files of our tests, written by the layout that ``pytritech`` reads. The
sources disagree on the order of samples and on the unit of bearings, so both are determined from the file.
"""

from __future__ import annotations

import contextlib
import io
import math
import zipfile
import zlib
from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun, missing_package_error
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import preset
from mitsonar.io.files import INFLATION, refuse_beyond_memory, refuse_irregular
from mitsonar.recordings.recording import (
    ELEVATION_PATTERN,
    Bytes,
    Facts,
    Part,
    Pixels,
    Recording,
    in_time_order,
    mapped,
    runs_of,
)
from mitsonar.recordings.ros_pings import is_beam_major
from mitsonar.records.frames import SonarFrames

__all__ = ["is_gemini", "read_gemini"]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

Record: TypeAlias = Any
"""An image record of ``pytritech``."""

ZIP = b"PK\x03\x04"

DEFLATED, PLAIN = 0, 1
"""Codes of the compression of an image; 2 is H.264, which is not read."""

MAX_CELLS = 2**26
"""Largest plausible number of cells of an image."""

SPEED_TOLERANCE = 0.002
"""Relative change of the range step up to which a window counts as the same: the sound speed drifts."""

ORDER_FRAMES = 8
"""Number of images from which the order of samples is determined."""

MODELS = {1: "gemini-720is", 4: "gemini-1200ik"}
"""Presets by the code of the model; they supply the carrier, elevation aperture and beam width."""

HIGH_FREQUENCY = 1
"""Bit of the ping flags: a Gemini 1200ik uses its high frequency."""

ELEVATION_DEG = 20.0
"""Elevation aperture if no preset supplies it [deg]."""


def is_gemini(path: Path, first: bytes) -> bool:
    """Return whether a file with these first bytes is a GLF file: a zip archive whose name ends with ``.glf``."""
    return first.startswith(ZIP) and path.suffix.lower() == ".glf"


def read_gemini(path: str | Path) -> Recording:
    """Open a GLF file; pixels are read on demand, and records are parsed by ``pytritech``, which must be installed.

    Line i lies at (i + 1/2) c / 2f for the sound speed c and modulation frequency f of the record. Bearings are those of
    the record, assumed to be positive to starboard, in degrees if any exceeds pi and otherwise in radians. Whether samples
    run along ranges or beams follows from their correlation. Samples are read as amplitudes. Times are those of
    transmission, in UTC.

    Raises:
        MitsonarError: if ``pytritech`` is missing, the file is damaged, or it holds no image that can be read.
    """
    refuse_irregular(path, "a GLF file")
    records = _records(Path(path))
    data = _image_data(Path(path))
    # 1. Leave out records whose sizes or compression are unfit, and sort the others by time.
    fit = [one for one in records if _is_plausible(one, len(data))]
    notes = [f"left out: {count_noun(len(records) - len(fit), 'image')} that are damaged or compressed by H.264"]
    notes = notes if len(fit) < len(records) else []
    if not fit:
        raise MitsonarError(f"{path} holds no image that can be read: it has {count_noun(len(records), 'record')} of images")
    order, more = in_time_order([one.db_tx_time.timestamp() for one in fit])
    fit = [fit[place] for place in order]
    # 2. Determine the order of samples.
    shapes = [(int(one.range_end) - int(one.range_start), int(one.bearing_end) - int(one.bearing_start)) for one in fit]
    images = _Images(str(path), data, fit, shapes, False)
    same = [place for place, shape in enumerate(shapes) if shape == shapes[0]][:ORDER_FRAMES]
    flat = [samples for place in same if (samples := images.samples(place)) is not None]
    beam_major = is_beam_major(flat, *shapes[0]) if flat else False
    images = _Images(str(path), data, fit, shapes, beam_major)
    if beam_major:
        notes.append("samples are stored beam by beam, according to their correlation")
    # 3. Make a part of each run of records with one geometry.
    parts = tuple(_part(images, run) for _, run in runs_of(_windows(fit)))
    notes += [*more, "the side of positive bearings is not published: starboard is assumed (info --handedness checks it)"]
    notes.append("the scale of the samples is not published: they are read as amplitudes")
    return Recording(str(path), "Gemini (.glf)", parts, _facts(fit), tuple(notes))


def _records(path: Path) -> list[Record]:
    """Return the image records of a file.

    Raises:
        MitsonarError: ``pytritech`` is missing, or cannot read the file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = [one.file_size for one in archive.infolist()]
            names = archive.namelist()
    except Exception as error:  # a damaged archive raises errors of many kinds
        raise MitsonarError(f"cannot read the GLF file {path}: {_reason(error)}") from None
    if sum(sizes) > INFLATION * path.stat().st_size or sum(".dat" in name for name in names) != 1:
        raise MitsonarError(
            f"{path} is no GLF file: it lacks a single .dat of plausible size, and holds {len(names):,} files"
        )
    refuse_beyond_memory(sum(sizes), str(path))
    try:
        from pytritech.glf import GLF
    except ModuleNotFoundError as error:
        raise missing_package_error(error) from None
    try:
        with contextlib.redirect_stdout(io.StringIO()), GLF(str(path)) as glf:  # it prints
            return list(glf.images)
    except Exception as error:  # it asserts what it expects
        raise MitsonarError(
            f"pytritech cannot read {path}: {_reason(error)}; the file is damaged or of a newer kind"
        ) from None


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__


def _image_data(path: Path) -> Bytes:
    """Return the content of the ``.dat`` file in the archive, mapped if it is not compressed."""
    try:
        with zipfile.ZipFile(path) as archive:
            info = next(one for one in archive.infolist() if ".dat" in one.filename)
            if info.compress_type != zipfile.ZIP_STORED:
                return np.frombuffer(archive.read(info), np.uint8)
            with archive.open(info) as member:
                start = int(member._orig_compress_start)  # type: ignore[attr-defined]
    except Exception as error:
        raise MitsonarError(f"cannot read the images of {path}: {_reason(error)}") from None
    return mapped(path, "a GLF file")[start : start + info.file_size]


def _is_plausible(record: Record, size: int) -> bool:
    """Return whether the numbers of a record fit together and its image lies within ``size`` bytes."""
    bins, beams = int(record.range_end) - int(record.range_start), int(record.bearing_end) - int(record.bearing_start)
    bearing = np.asarray(record.bearing_table, dtype=float)
    steps = np.diff(bearing)
    return (
        bins > 1
        and beams > 1
        and bins * beams <= MAX_CELLS
        and len(bearing) == beams
        and bool(np.isfinite(bearing).all() and (np.abs(bearing) <= 180).all())
        and bool((steps > 0).all() or (steps < 0).all())
        and record.compression_type in (DEFLATED, PLAIN)
        and 0 < int(record.image_data_size) <= size - int(record.image_data_ptr)
        and int(record.modulation_freq) > 0
        and 1000 < float(record.sos_at_xd) < 2000
    )


def _bearings(record: Record) -> Array:
    """Return the bearings of the columns of a record ``(beams,)`` [rad]."""
    bearing = np.asarray(record.bearing_table, dtype=np.float64)
    return np.asarray(np.radians(bearing) if np.abs(bearing).max() > math.pi else bearing, dtype=np.float64)


def _step(record: Record) -> float:
    """Return the distance of two range lines [m]."""
    return float(record.sos_at_xd) / 2 / float(record.modulation_freq)


def _windows(records: list[Record]) -> list[Hashable]:
    """Return keys that are equal for consecutive records of one geometry."""
    keys: list[Hashable] = []
    step = 0.0
    for record in records:
        if not math.isclose(_step(record), step, rel_tol=SPEED_TOLERANCE):
            step = _step(record)
        bearing = (len(record.bearing_table), record.bearing_table[0], record.bearing_table[-1])
        keys.append((step, int(record.range_start), int(record.range_end), bearing))
    return keys


@dataclass(frozen=True)
class _Images:
    """Images of all records.

    Attributes:
        name: name of the file.
        data: content of the ``.dat`` file.
        records: records in order of time.
        shapes: number of bins and beams of each.
        beam_major: whether the samples of each beam are contiguous.
    """

    name: str
    data: Bytes
    records: list[Record]
    shapes: list[tuple[int, int]]
    beam_major: bool

    def samples(self, place: int) -> NDArray[np.uint8] | None:
        """Return the samples of a record as they are stored ``(bins * beams,)``; None if it is damaged."""
        record, cells = self.records[place], math.prod(self.shapes[place])
        start = int(record.image_data_ptr)
        content = self.data[start : start + int(record.image_data_size)].tobytes()
        if record.compression_type == DEFLATED:
            try:
                content = zlib.decompressobj().decompress(content, cells + 1)  # no more than the record states
            except zlib.error:
                return None
        return np.frombuffer(content, np.uint8) if len(content) == cells else None

    def image(self, place: int) -> NDArray[np.uint8]:
        """Return an image ``(bins, beams)``, column 0 farthest to port.

        Raises:
            MitsonarError: the image is damaged.
        """
        flat, shape = self.samples(place), self.shapes[place]
        if flat is None:
            raise MitsonarError(f"{self.name}: image {place:,} is damaged: its samples do not match its {shape[1]:,} beams")
        image = flat.reshape(shape[::-1]).T if self.beam_major else flat.reshape(shape)
        table = self.records[place].bearing_table
        return image if table[0] < table[-1] else image[:, ::-1]


@dataclass(frozen=True)
class _PartImages:
    """Function that reads the images of a part.

    Attributes:
        images: images of the file.
        places: index of each frame among them.
    """

    images: _Images
    places: Index

    def __call__(self, index: Index) -> Pixels:
        """Return images ``(n, bins, beams)`` uint8, column 0 farthest to port."""
        shape = self.images.shapes[int(self.places[0])]
        chosen = [self.images.image(int(place)) for place in self.places[index]]
        return np.stack(chosen) if chosen else np.zeros((0, *shape), np.uint8)


def _part(images: _Images, run: Index) -> Part:
    """Return the part that consists of these records."""
    first = images.records[int(run[0])]
    times = np.array([images.records[int(place)].db_tx_time.timestamp() for place in run])
    bearing, step = np.sort(_bearings(first)), _step(first)
    bins, beams = images.shapes[int(run[0])]
    line = int(first.range_start) + np.arange(bins + 1)
    name = _preset_name(first)
    known = None if name is None else preset(name)
    span = float(bearing[-1] - bearing[0])
    gaps = np.diff(times)
    sonar = Sonar.create(
        name=name or "gemini",
        azimuth_fov_deg=min(180.0, math.degrees(span) * beams / (beams - 1)),
        elevation_fov_deg=known.elevation_fov_deg if isinstance(known, Sonar) else ELEVATION_DEG,
        elevation_pattern=ELEVATION_PATTERN,
        beam_width_deg=known.beam_width_deg if isinstance(known, Sonar) else None,
        beams=beams,
        range_min=float(line[0]) * step,
        range_max=float(line[-1]) * step,
        range_bins=bins,
        sound_speed=float(first.sos_at_xd),
        frequency_hz=known.frequency_hz if isinstance(known, Sonar) else None,
        bearing="cone" if span < math.pi else "azimuth",
        frame_rate_hz=float(np.clip(1 / np.median(gaps), 1e-3, 1e6)) if len(gaps) else 10.0,
        coding="gamma",
        coding_gamma=1.0,
    )
    like = SonarFrames(
        image=np.zeros((0, bins, beams), np.uint8),
        range_m=np.asarray((line[:-1] + 0.5) * step, dtype=np.float64),
        bearing_rad=bearing,
        time_s=np.zeros(0),
        sonar=sonar,
        level="gamma",
    )
    return Part(like, times, _PartImages(images, run))


def _preset_name(record: Record) -> str | None:
    """Return the name of the preset for the model and frequency of a record; None if there is none."""
    name = MODELS.get(int(record.platform))
    if name != "gemini-1200ik":
        return name
    high = int.from_bytes(record.ping_flags, "little") & HIGH_FREQUENCY
    return f"{name}-{1200 if high else 720}khz"


def _facts(records: list[Record]) -> Facts:
    """Return values of the records, keyed by name."""
    first = records[0]
    return {
        "device": int(first.header.device_id),
        "model": int(first.platform),
        "image_version": int(first.image_version),
        "modulation_frequency": int(first.modulation_freq),
        "gain_percent": int(first.percent_gain),
        "chirp": bool(first.chirp),
    }
