"""A sequence of pictures with a geometry becomes a recording: polar pictures are put in order, fans are resampled."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import read_bytes
from mitsonar.recordings.fan_outline import doubts
from mitsonar.recordings.fan_sampler import FanSampler
from mitsonar.recordings.geometry_file import (
    ANY_ELEVATION_DEG,
    ANY_RATE_HZ,
    SEE,
    PictureGeometry,
    geometry_beside,
    load_geometry,
)
from mitsonar.recordings.picture_file import Grey
from mitsonar.recordings.recording import Facts, Part, Pixels, Recording, in_time_order
from mitsonar.records.frames import SonarFrames

__all__ = ["Pictures", "geometry_for", "polar_frames", "recording_of"]

Array = NDArray[np.float64]

OUTLINE_PICTURES = 16
"""Pictures that the outline of a fan is taken from, at most."""

LARGEST_TIMES = 2**26
"""Bytes of a file of times, at most."""


@dataclass(frozen=True)
class Pictures:
    """Pictures of one size, in their own order.

    Attributes:
        source: path of the file or folder.
        format: in words.
        shape: rows and columns of each.
        names: of the pictures, for messages and files of times.
        read: reads one by its place.
        time_s: of each ``(pictures,)`` [s], where known.
        rate_hz: of the pictures, where the file tells it.
        numbers: that each has in its name ``(pictures,)``, where known.
        facts: what the file tells, by name.
        notes: sentences on what was left out.
    """

    source: Path
    format: str
    shape: tuple[int, int]
    names: tuple[str, ...]
    read: Callable[[int], Grey]
    time_s: Array | None = None
    rate_hz: float | None = None
    numbers: Array | None = None
    facts: Facts = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def geometry_for(source: Path, geometry: Path | None, inside: PictureGeometry | None = None) -> tuple[PictureGeometry, Path]:
    """Return the geometry of pictures and the file that tells it: the given one, the one beside them, or the one inside.

    Raises:
        MitsonarError: there is none, or it is damaged.
    """
    found = geometry or geometry_beside(source)
    if found is not None:
        return load_geometry(found), found
    if inside is None:
        raise MitsonarError(
            f"{source} holds pictures, which do not tell their geometry: give a geometry file (--geometry FILE), or lay "
            f"geometry.yaml beside them{SEE}"
        )
    return inside, source


def recording_of(pictures: Pictures, geometry: PictureGeometry, told_by: Path) -> Recording:
    """Make a recording of pictures.

    Args:
        pictures: in their own order.
        geometry: of each of them.
        told_by: file of the geometry, from which the path of a file of times counts.

    Raises:
        MitsonarError: a geometry that does not fit the pictures; times that cannot be read.
    """
    times, notes = _times(pictures, geometry, told_by)
    kept, sorting = in_time_order(times, pictures.numbers)
    rate = _rate(times[kept], geometry)
    notes = [*pictures.notes, *notes, *sorting, *geometry.notes()]
    images: _Polar | _Fan
    if geometry.layout == "polar":
        shape = pictures.shape[::-1] if geometry.transposed else pictures.shape
        images, like = _Polar(pictures, kept, geometry), polar_frames(geometry, *shape, rate)
    else:
        sampler = FanSampler.of(geometry, *pictures.shape)
        images = _Fan(pictures, kept, sampler)
        like = _fan_frames(geometry, sampler, rate)
        some = np.unique(np.linspace(0, len(kept) - 1, OUTLINE_PICTURES).astype(np.intp)) if len(kept) else kept
        if len(some):
            notes += doubts(geometry, np.max([_bytes(pictures.read(int(place))) for place in kept[some]], axis=0))
    part = Part(
        like, times[kept], images, attitude_rad=_attitude(geometry, len(kept)), height_m=_height(geometry, len(kept))
    )
    facts: Facts = {"pictures": len(pictures.names), "rows": pictures.shape[0], "columns": pictures.shape[1]}
    facts |= {"layout": geometry.layout, "geometry": str(told_by)} | pictures.facts
    return Recording(str(pictures.source), pictures.format, (part,), facts, tuple(notes))


def polar_frames(geometry: PictureGeometry, bins: int, beams: int, rate_hz: float) -> SonarFrames:
    """Return frames without images for polar pictures: sonar, ranges [m] and bearings [rad], most to port first.

    Raises:
        MitsonarError: bearings that are not one a beam, or a sonar that cannot be.
    """
    if geometry.bearings_deg is None:
        sonar = _sonar(geometry, bins, beams, float(geometry.azimuth_fov_deg or 0.0), rate_hz)
        return _like(geometry, sonar, sonar.bearing_rad)
    if len(geometry.bearings_deg) != beams:
        raise MitsonarError(
            f"the geometry has {len(geometry.bearings_deg):,} bearings_deg, and the pictures have {beams:,} beams: give "
            "one a beam"
        )
    bearings = np.sort(np.radians(geometry.bearings_deg))
    fov = min(360.0, math.degrees(bearings[-1] - bearings[0]) * beams / (beams - 1))
    return _like(geometry, _sonar(geometry, bins, beams, fov, rate_hz), bearings)


def _fan_frames(geometry: PictureGeometry, sampler: FanSampler, rate_hz: float) -> SonarFrames:
    """Return frames without images for fans that are resampled."""
    sonar = _sonar(geometry, sampler.bins, sampler.beams, 2 * float(geometry.half_angle_deg or 0.0), rate_hz)
    return _like(geometry, sonar, sonar.bearing_rad)


def _sonar(geometry: PictureGeometry, bins: int, beams: int, fov_deg: float, rate_hz: float) -> Sonar:
    near, far = geometry.window_m
    return Sonar.create(
        name=geometry.name,
        azimuth_fov_deg=fov_deg,
        elevation_fov_deg=geometry.elevation_fov_deg or ANY_ELEVATION_DEG,
        beams=beams,
        range_min=near,
        range_max=far,
        range_bins=bins,
        sound_speed=geometry.sound_speed,
        bearing=geometry.bearing_of(fov_deg / 2),
        beam_layout=geometry.beam_layout,
        frequency_hz=geometry.frequency_hz,
        frame_rate_hz=rate_hz,
        coding=geometry.level or "linear",
        coding_db=geometry.coding_db,
        coding_gamma=geometry.coding_gamma,
    )


def _like(geometry: PictureGeometry, sonar: Sonar, bearing_rad: Array) -> SonarFrames:
    return SonarFrames(
        image=np.zeros((0, sonar.range_bins, sonar.beams), np.uint8),
        range_m=sonar.range_m,
        bearing_rad=bearing_rad,
        time_s=np.zeros(0),
        sonar=sonar,
        level=geometry.level or "linear",
    )


@dataclass(frozen=True)
class _Polar:
    """Polar pictures as images."""

    pictures: Pictures
    places: NDArray[np.intp]
    geometry: PictureGeometry

    def __call__(self, index: NDArray[np.intp]) -> Pixels:
        """Return ``(n, bins, beams)``, row 0 nearest, column 0 most to port."""
        turned = self.geometry.transposed
        shape = self.pictures.shape[::-1] if turned else self.pictures.shape
        read = [self.pictures.read(int(place)) for place in self.places[index]]
        stacked = np.stack([one.T if turned else one for one in read]) if read else np.zeros((0, *shape), np.uint8)
        rows = slice(None, None, 1 if self.geometry.rows == "near-to-far" else -1)
        told = self.geometry.bearings_deg
        falls = self.geometry.mirror if told is None else told[0] > told[-1]
        return stacked[:, rows, :: -1 if falls else 1]


@dataclass(frozen=True)
class _Fan:
    """Fans as images of beams and bins."""

    pictures: Pictures
    places: NDArray[np.intp]
    sampler: FanSampler

    def __call__(self, index: NDArray[np.intp]) -> Pixels:
        """Return ``(n, bins, beams)`` float32, resampled when they are read."""
        made = np.zeros((len(index), self.sampler.bins, self.sampler.beams), np.float32)
        for place, number in enumerate(self.places[index]):
            made[place] = self.sampler.apply(self.pictures.read(int(number)))
        return made


def _bytes(picture: Grey) -> Grey:
    """Return a picture in 0..255."""
    return picture if picture.dtype == np.uint8 else np.asarray(np.clip(picture, 0, 1) * 255, dtype=np.uint8)


def _times(pictures: Pictures, geometry: PictureGeometry, told_by: Path) -> tuple[Array, list[str]]:
    """Return the times ``(pictures,)`` [s] of the pictures, and sentences on what is assumed."""
    if geometry.times is not None:
        return _times_in(told_by.parent / geometry.times, pictures.names), []
    if pictures.time_s is not None:
        return pictures.time_s, []
    rate = geometry.frame_rate_hz or pictures.rate_hz
    assumed = [] if rate else [f"nothing tells the times of the pictures: {ANY_RATE_HZ:g} a second are assumed"]
    steps = (
        np.arange(len(pictures.names), dtype=float) if pictures.numbers is None else pictures.numbers - pictures.numbers[0]
    )
    return steps / (rate or ANY_RATE_HZ), assumed


def _times_in(path: Path, names: tuple[str, ...]) -> Array:
    """Read a file of times: a line ``TIME`` for each picture in order, or lines ``NAME, TIME``; # begins a comment."""
    text = read_bytes(path, "file of times", LARGEST_TIMES).decode("utf-8", "replace")
    rows = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
    rows = [row for row in rows if row]
    try:
        times = [float(row[-1]) for row in rows]
    except ValueError:
        raise MitsonarError(f"{path} must hold lines `TIME` or `NAME, TIME` with times [s]{SEE}") from None
    if rows and all(len(row) == 2 for row in rows):
        by_name = {row[0]: time for row, time in zip(rows, times, strict=True)}
        found = np.array([by_name.get(name, np.nan) for name in names])
        if not np.isfinite(found).any():
            raise MitsonarError(f"{path} names none of the pictures, such as {names[0] if names else '-'}")
        return found
    if len(times) != len(names) or any(len(row) != 1 for row in rows):
        raise MitsonarError(f"{path} must hold a time for each of {len(names):,} pictures: it holds {len(times):,} lines")
    return np.array(times)


def _rate(times: Array, geometry: PictureGeometry) -> float:
    """Return the frames a second: as told, or by the times."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return geometry.frame_rate_hz or (min(1e6, 1 / step) if step > 0 else ANY_RATE_HZ)


def _attitude(geometry: PictureGeometry, frames: int) -> Array | None:
    """Return pitch, roll, heading ``(frames, 3)`` [rad] where the geometry tells the pitch."""
    if geometry.pitch_deg is None:
        return None
    return np.tile([math.radians(geometry.pitch_deg), math.radians(geometry.roll_deg), np.nan], (frames, 1))


def _height(geometry: PictureGeometry, frames: int) -> Array | None:
    """Return the heights ``(frames,)`` [m] where the geometry tells one."""
    return None if geometry.height_m is None else np.full(frames, geometry.height_m)
