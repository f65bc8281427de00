"""Frames of runs and recordings with their poses, in stretches: what a data set is made of that was not rendered for it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.sonar_fit import NOISE_FIELDS, as_instrument
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.runs import shown
from mitsonar.mapping.sources import is_data_set, poses_at, recording_at, stretches
from mitsonar.motion.trajectory import Trajectory
from mitsonar.recordings.recording import Part
from mitsonar.records.frames import SonarFrames, to_float32

__all__ = ["Axes", "FramesWithPoses", "Stretch", "as_pixels", "axes_of", "frames_with_poses"]

Array = NDArray[np.float64]

TENTH = 0.1
"""Largest distance of a bin or beam from its place in the sonar, as part of the step from one to the next."""

EXACT = 1e-6
"""The same, below which axes are those of the sonar: files round them."""

SAME = 1e-3
"""Largest difference of numbers of one sonar in two files, as part of them."""

OTHER = ("name", "seed", "frame_rate_hz", "quality", "thesis_rays", "rays_per_beam", "rays_across", "jitter", *NOISE_FIELDS)
"""Fields of a sonar in which frames of one data set may differ."""

AXES = ("range_min", "range_max", "azimuth_fov_deg", "beam_layout")
"""Fields that are compared as ranges and bearings."""


@dataclass(frozen=True)
class Axes:
    """The sonar of frames, whose window and bins are theirs.

    Attributes:
        sonar: the instrument.
        bearing_rad: axes of the beams ``(beams,)`` [rad], where they are not those of the sonar.
        level: how pixels stand for levels.
    """

    sonar: Sonar
    bearing_rad: Array | None
    level: str

    @property
    def bearings(self) -> Array:
        """Return the axes of the beams ``(beams,)`` [rad]."""
        return self.sonar.bearing_rad if self.bearing_rad is None else self.bearing_rad

    def other(self, than: Axes) -> list[str]:
        """List what differs from another sonar, with both values: ``range_bins 128, not 256``."""
        mine, its = ({**one.sonar.model_dump(), "level": one.level} for one in (self, than))
        keys = [key for key in mine if key not in (*OTHER, *AXES) and not _same(mine[key], its[key])]
        if self.sonar.range_bins == than.sonar.range_bins and not _near(self.sonar.range_m, than.sonar.range_m, TENTH):
            keys += ["range_min", "range_max"]
        if self.sonar.beams == than.sonar.beams and not _near(self.bearings, than.bearings, TENTH):
            keys += ["azimuth_fov_deg", "bearings"]
        mine, its = ({**table, "bearings": "of other beams"} for table in (mine, its))
        return [f"{key} {shown(mine[key])}, not {shown(its[key])}" for key in keys]


@dataclass(frozen=True)
class Stretch:
    """Consecutive frames of a part, two or more, each with a pose.

    Attributes:
        part: of a recording.
        first: number of the first frame in the part.
        time_s: of the frames ``(frames,)`` [s].
        poses: of the sonar ``(frames, 6)`` [m, rad].
        height_m: over the ground ``(frames,)``; nan where unknown.
    """

    part: Part
    first: int
    time_s: Array
    poses: Array
    height_m: Array

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time_s)

    def read(self, here: slice) -> SonarFrames:
        """Read some of the frames, by their numbers in the stretch."""
        return self.part.read(np.arange(self.first + here.start, self.first + here.stop))


@dataclass(frozen=True)
class FramesWithPoses:
    """What was taken from one file or run.

    Attributes:
        name: of the file, as it was given.
        format: in words.
        poses: where the poses come from.
        axes: of its frames.
        level_scale: level of a pixel of 1.
        stretches: the frames.
        left_out: number of frames without a pose, of another geometry, or with no neighbour.
        notes: sentences on the recording.
    """

    name: str
    format: str
    poses: str
    axes: Axes
    level_scale: float
    stretches: list[Stretch]
    left_out: int
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of frames that were taken."""
        return sum(map(len, self.stretches))


def frames_with_poses(
    where: str,
    *,
    path: str | Path | None = None,
    frame: str = "mitsonar",
    height_m: float | None = None,
    cut: int | None = None,
    geometry: str | Path | None = None,
) -> FramesWithPoses:
    """Find the frames of a file or run whose poses are known. No pixels are read.

    Of a recording in several parts those are taken that have the geometry of the longest.

    Args:
        where: a recording of a real sonar, ``frames.npz``, ``frames.zarr``, or the folder of a run.
        path: file of poses, TUM or CSV; None: the poses of the frames.
        frame: convention of that file.
        height_m: over the ground [m], for frames without one.
        cut: frames of a stretch, at most.
        geometry: file that tells how the pictures of a recording are laid out.

    Raises:
        MitsonarError: no frames there, no poses, a sonar that a data set cannot hold.
    """
    if is_data_set(where):
        raise MitsonarError(f"{where} is a data set already: give runs or recordings")
    recording = recording_at(where, geometry=geometry)
    longest = recording.part()
    axes = axes_of(longest.like, where)
    known = None if path is None else Trajectory.load(path, frame)
    found: list[Stretch] = []
    for number, part in enumerate(recording.parts):
        if number == recording.longest or (len(part) and not axes_of(part.like, where).other(axes)):
            found += _stretches_of(part, where, known, height_m, cut)
    if not found:
        raise MitsonarError(
            f"{where} has no two consecutive frames with a pose: give --poses with a path that has the times of its frames"
        )
    taken = sum(map(len, found))
    poses = "its own" if path is None else str(path)
    scale = float(longest.like.level_scale)
    notes = recording.notes
    return FramesWithPoses(str(where), recording.format, poses, axes, scale, found, len(recording) - taken, notes)


def axes_of(like: SonarFrames, name: str) -> Axes:
    """Return the sonar of frames, fitted to their ranges and bearings where it has others.

    Args:
        like: frames, or none of them: their axes count.
        name: for errors.

    Raises:
        MitsonarError: frames of contrast; ranges at uneven steps.
    """
    if like.level == "contrast":
        raise MitsonarError(f"{name} holds contrast, no levels: give the frames before their contrast")
    sonar = like.sonar
    own = sonar.range_bins == len(like.range_m) and sonar.beams == len(like.bearing_rad)
    if not (own and _near(sonar.range_m, like.range_m, EXACT) and _near(sonar.bearing_rad, like.bearing_rad, EXACT)):
        if min(len(like.range_m), len(like.bearing_rad)) < 2:
            raise MitsonarError(f"{name} has frames of one bin or one beam: their sonar must tell its window")
        sonar = as_instrument(like)[0].sonar
    if not _near(sonar.range_m, like.range_m, TENTH):
        raise MitsonarError(
            f"the ranges of {name} are not at even steps, and a data set holds no others: resample its frames, or give a "
            "recording whose bins are even"
        )
    even = _near(sonar.bearing_rad, like.bearing_rad, EXACT)
    return Axes(sonar, None if even else np.asarray(like.bearing_rad, dtype=float), like.level)


def _stretches_of(part: Part, name: str, path: Trajectory | None, height_m: float | None, cut: int | None) -> list[Stretch]:
    """Return the stretches of a part whose frames have poses."""
    time = np.asarray(part.time_s, dtype=float)
    time = time.mean(axis=1) if time.ndim == 2 else time
    if not np.isfinite(time).all() or not (np.diff(time) > 0).all():
        raise MitsonarError(f"the times of {name} do not rise: its frames have no order")
    if path is not None:
        poses, known = poses_at(path, time, name, part.attitude_rad)
    elif part.poses is None:
        raise MitsonarError(
            f"{name} holds no poses: give --poses PATH.tum, the path of the sonar by DVL and INS, by another instrument or "
            "by `mitsonar odometry`"
        )
    else:
        poses = np.asarray(part.poses, dtype=float)
        known = np.asarray(np.isfinite(poses).all(axis=1))
    height = np.full(len(time), np.nan) if part.height_m is None else np.array(part.height_m, dtype=float)
    height = np.where(np.isfinite(height) | (height_m is None), height, np.nan if height_m is None else height_m)
    found = []
    for one in stretches(known, time):
        step = cut or one.stop - one.start
        for first in range(one.start, one.stop - 1, step):
            here = slice(first, min(first + step, one.stop))
            found.append(Stretch(part, first, time[here], poses[here], height[here]))
    return [one for one in found if len(one) > 1]


def as_pixels(image: NDArray[np.generic], pixel: str, name: str) -> NDArray[np.generic]:
    """Return images as a data set stores them: uint8 as they are, or float32 in 0..1.

    Raises:
        MitsonarError: values outside 0..1.
    """
    if pixel == "uint8" and image.dtype == np.uint8:
        return image
    values = to_float32(image)
    if not (values.size and values.min() >= 0 and values.max() <= 1):  # also of nan
        raise MitsonarError(f"{name} has pixels {values.min():g}..{values.max():g}, allowed 0..1: it is damaged")
    return values


def _near(one: Array, other: Array, part: float) -> bool:
    """Return whether two axes agree, within this part of their least step."""
    if len(one) != len(other):
        return False
    step = float(np.diff(other).min()) if len(other) > 1 else max(abs(float(other[0])), 1.0)
    return bool(np.abs(one - other).max() <= part * step)


def _same(one: object, other: object) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=SAME, abs_tol=1e-9)
    return one == other
