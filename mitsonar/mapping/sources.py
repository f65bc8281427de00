"""How the sonar frames of one run are opened and read, from a simulated run, a data set or a recording.

:class:`FrameSource` reads frames a few at a time, and :func:`open_frames` opens one at a path or URL. :func:`recording_at`
gives the same frames as a recording, with labels. :func:`poses_at` interpolates a path at the times of frames.
"""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeAlias, TypeVar
from zipfile import is_zipfile

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Slerp

from mitsonar.acoustics.levels import LocalContrast, fitted_contrast
from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError, MitsonarWarning, argument, count_noun, suggest_names
from mitsonar.geometry.ground import UNKNOWN_MOST, UNKNOWN_PER_S, USUAL_LEAN_RAD
from mitsonar.io.files import missing_file
from mitsonar.io.runs import kind_of_run
from mitsonar.motion.errors import associated
from mitsonar.motion.pose import poses_from, vehicle_rotation
from mitsonar.motion.sensors import VehicleSensors, leaning_mount, smoothed_change
from mitsonar.motion.trajectory import Trajectory
from mitsonar.recordings.recording import CHUNK_BYTES, Part, Pixels, Recording
from mitsonar.records.frames import COLUMNS, LABELS, PER_FRAME, SonarFrames, check_column, frames_in, open_group, to_float32

if TYPE_CHECKING:
    from mitsonar.datasets.store import DataStore
    from mitsonar.estimation.estimator import Record
    from mitsonar.estimation.height import HeightEstimate, HeightEstimator
    from mitsonar.records.frames import ViewFrames

__all__ = [
    "FrameSource",
    "LabelledPart",
    "StoredView",
    "is_data_set",
    "is_recording",
    "load_frames",
    "measured",
    "open_frames",
    "poses_at",
    "recording_at",
    "sequence_in",
    "stretches",
    "view_in",
    "without_height",
]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

PATTERN_FRAMES = 64
"""Largest number of frames that are averaged to a static pattern."""

FITTED, FITTED_RUNS = 3, 4
"""Number of consecutive frames in a run for fitting the contrast, and the number of such runs."""

LARGE_NOISE = 5.0
"""Noise of a gyroscope by the unknown roll, over its own, from which a warning is due."""

PLANAR = 1e-6
"""Smallest change of height, pitch or roll that makes a path non-planar [m, rad]: files round them."""


@dataclass(frozen=True)
class FrameSource:
    """The frames of one run, whose pixels are read on demand.

    Attributes:
        name: name of the source, for messages.
        like: a record of zero frames that holds what all frames share: sonar, bins, beams, level.
        time_s: times of the frames ``(frames,)`` [s]; the mean over the beams if each beam has its own time.
        images: reads the frames with the given numbers ``(n,)`` as ``(n, bins, beams)``.
        poses: true poses of the sonar ``(frames, 6)`` [m, rad], if known.
        attitude_rad: pitch, roll, heading measured by the sensors of the sonar ``(frames, 3)`` [rad], if known; nan where
            not.
        height_m: height over the ground ``(frames,)`` [m], if known; nan where nothing is below.
        pitch_rad: pitch of the sonar [rad], if its poses are not known.
        given_height_m: height that the user gave for frames without one [m].
        rise_m: rise of each frame above the first, from a depth sensor ``(frames,)`` [m], if known and poses are not.
        attitude_std: standard deviations of the height [m], pitch and roll [rad] of each frame by a vehicle's sensors
            ``(frames, 3)``: their noise, or if they measure only depth, the lean that goes with the heave. None: not known.
        assumed_height: whether ``height_m`` is an assumption, because neither the frames nor the user give a height.
        noise: noise added to the frames when they are read.
        seed: seed of the noise.
        first_number: number of the first frame; the noise is a function of the frame number.
        note: which frames these are, if the name does not show it.
        altimeter: measures the height of each frame as it is read, in place of ``height_m``.
        contrast: converts levels to local contrast when frames are read.
        pattern_db: static pattern ``(bins, beams)`` [dB] that moves with the sonar, subtracted before the contrast.
    """

    name: str
    like: SonarFrames
    time_s: Array
    images: Callable[[Index], Pixels]
    poses: Array | None = None
    attitude_rad: Array | None = None
    height_m: Array | None = None
    pitch_rad: float | None = None
    given_height_m: float | None = None
    rise_m: Array | None = None
    attitude_std: Array | None = None
    assumed_height: bool = False
    noise: NoiseModel | None = None
    seed: int = 0
    first_number: int = 0
    note: str = ""
    altimeter: HeightEstimator | None = None
    contrast: LocalContrast | None = None
    pattern_db: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time_s)

    @classmethod
    def of(cls, frames: SonarFrames, name: str = "the frames") -> Self:
        """Make a source of frames in memory; labels are dropped."""
        nothing: dict[str, Any] = dict.fromkeys(LABELS)
        frames = replace(frames, **nothing)
        like, images = frames.select(slice(0)), frames.image.__getitem__
        known = frames.poses, frames.height_m
        return cls.of_arrays(like, frames.time_s, *known, images, name, attitude_rad=frames.attitude_rad)

    @classmethod
    def of_part(cls, part: Part, name: str, note: str = "") -> Self:
        """Make a source of a part of a recording."""
        known, attitude = (part.poses, part.height_m), part.attitude_rad
        return cls.of_arrays(part.like, part.time_s, *known, part.images, name, attitude_rad=attitude, note=note)

    @classmethod
    def of_arrays(
        cls,
        like: SonarFrames,
        time_s: Array,
        poses: Array | None,
        height_m: Array | None,
        images: Callable[[Index], Pixels],
        name: str,
        *,
        attitude_rad: Array | None = None,
        first_number: int = 0,
        note: str = "",
    ) -> Self:
        """Make a source of times, poses, attitudes and heights in memory, with images that are read on demand."""
        time = np.asarray(time_s, dtype=float)
        time = time.mean(axis=1) if time.ndim == 2 else time
        # truth is dropped, as labels are
        like = replace(like, beam_poses=None, body_names=(), body_poses=None, body_velocities=None)
        return cls(name, like, time, images, poses, attitude_rad, height_m, first_number=first_number, note=note)

    def with_noise(self, noise: NoiseModel, seed: int = 0) -> Self:
        """Return the same frames with noise, which is a function of the seed and the frame number."""
        return self if noise.is_none else replace(self, noise=noise, seed=seed)

    def with_contrast(self, contrast: LocalContrast | None = None, *, moving: bool = False) -> Self:
        """Return the same frames as local contrast, which removes illumination that moves with the sonar.

        Args:
            contrast: conversion to use; by default, the least smoothing at which consecutive frames correlate well, fitted
                to some of these frames.
            moving: also subtract the mean of frames over the whole run. This removes the scene of a sonar at rest.
        """
        plain = replace(self, altimeter=None)
        pattern = None
        if moving:
            some = np.unique(np.linspace(0, len(self) - 1, PATTERN_FRAMES).astype(np.intp))
            levels = np.stack([plain.read([one]).in_decibels()[0] for one in some])
            pattern = np.asarray(levels.mean(axis=0), dtype=np.float32)
        if contrast is None:
            starts = np.unique(np.linspace(0, max(0, len(self) - FITTED), FITTED_RUNS).astype(np.intp))
            runs = [plain.read(np.arange(start, min(start + FITTED, len(self)))).in_decibels() for start in starts]
            contrast = fitted_contrast([run if pattern is None else run - pattern for run in runs])
        return replace(self, contrast=contrast, pattern_db=pattern)

    def with_heights_by(self, estimator: HeightEstimator) -> Self:
        """Return the same frames with heights that an estimator measures as they are read.

        Raises:
            MitsonarError: the estimator reads views of a data set, not frames.
        """
        if estimator.views is not None:
            raise MitsonarError(
                f"{self.name}: heights are estimated from {estimator.kind}s of {', '.join(estimator.views)}, the frames are "
                "images of one view: give direct, or a network that was trained on such images"
            )
        return replace(self, altimeter=estimator)

    def with_geometry(self, height_m: float | None = None, pitch_rad: float | None = None) -> Self:
        """Return the same frames with a height [m] and a pitch [rad] where they lack them.

        Raises:
            MitsonarError: the frames already have the height or pitch, or a number is outside its limits.
        """
        lacking = self.height_m is None or not np.isfinite(self.height_m).all()
        if height_m is not None and not lacking:
            raise MitsonarError(
                f"{self.name}: the frames have heights, so that {height_m:g} m would not be used: leave it out, "
                "or give it to the estimator, as NAME:height_m=2.5"
            )
        if pitch_rad is not None and self.poses is not None:
            raise MitsonarError(
                f"{self.name}: the frames have a pitch, so that {np.degrees(pitch_rad):g} deg would not be used: leave "
                "it out, or give it to the estimator, as NAME:pitch_deg=35"
            )
        lean = np.zeros((0, 2)) if self.attitude_rad is None else self.attitude_rad[:, :2]
        if pitch_rad is not None and (count := int(np.isfinite(lean).all(axis=1).sum())):
            frames = "each frame" if count == len(lean) else f"{count:,} of {count_noun(len(lean), 'frame')}"
            warnings.warn(
                f"{self.name}: a pitch of {np.degrees(pitch_rad):g} deg replaces the pitch and roll of {frames}, which "
                "sensors measured: leave it out to use them",
                MitsonarWarning,
                stacklevel=3,
            )
        if height_m is not None and not 0 < height_m < np.inf:
            raise MitsonarError(f"the height must be above 0: got {height_m:g} m")
        if height_m is not None and height_m > self.like.range_m[-1]:
            raise MitsonarError(
                f"{self.name}: the window ends at {self.like.range_m[-1]:g} m, and no ground is seen from a height of "
                f"{height_m:g} m: give heights in metres, below that"
            )
        if pitch_rad is not None and not abs(pitch_rad) <= np.pi / 2:
            raise MitsonarError(f"the pitch must lie in -90..90 deg: got {np.degrees(pitch_rad):g} deg")
        heights = self.height_m
        if height_m is not None:
            known = np.full(len(self), np.nan) if heights is None else heights
            heights = np.where(np.isfinite(known), known, height_m)
        return replace(
            self,
            height_m=heights,
            given_height_m=self.given_height_m if height_m is None else height_m,
            pitch_rad=pitch_rad if self.pitch_rad is None else self.pitch_rad,
        )

    def with_sensors(self, sensors: VehicleSensors, every: int = 1) -> tuple[Self, VehicleSensors]:
        """Return the same frames with the rise and the attitude that a vehicle's sensors measured, if they lack them.

        A given height is then the mean over the run, and a given pitch that of the mount.

        Args:
            sensors: sensors of the vehicle.
            every: number of frames from one that is used to the next, over which an unknown roll turns the sonar.

        Returns:
            The frames, and the sensors in the axes of the sonar.

        Raises:
            MitsonarError: the sensors measure the attitude of the vehicle, and neither frames nor user give a pitch.
        """
        for name, readings in (("depth", sensors.depth), ("attitude", sensors.pitch)):
            if readings is not None and not readings.reaches(self.time_s):
                warnings.warn(
                    f"{self.name}: the {name} of {sensors.name} is not used, as it does not reach from the first frame to "
                    f"the last, {self.time_s[0]:.10g}..{self.time_s[-1]:.10g} s: use the frames that it covers",
                    MitsonarWarning,
                    stacklevel=3,
                )
        lean, aided, std = sensors.attitudes(self.time_s), self, sensors.attitude_std(self.time_s)
        if self.poses is None and (rise := sensors.rises(self.time_s)) is not None:
            heights = self.height_m
            if heights is not None and np.ptp(heights) == 0:
                heights = heights + rise - rise.mean()
            # the attitude is unknown; a vehicle that heaves faster than on a calm day also leans more
            usual = max(1.0, _heave_rate(self.time_s, rise, std[:, 0]) / UNKNOWN_PER_S.height_m) * USUAL_LEAN_RAD
            leans = np.column_stack([std[:, 0], np.full((len(self), 2), usual * (self.pitch_rad is not None))])
            aided = replace(self, rise_m=rise, height_m=heights, attitude_std=leans)
        if lean is None:
            return aided, self._with_unknown_roll(sensors, every)
        known = self.attitudes(np.arange(len(self)))
        if known is None or np.isnan(known[:, 3]).all():
            raise MitsonarError(
                f"{self.name}: {sensors.name} hold the attitude of the vehicle, but the pitch of the sonar on it is not "
                f"known: give {argument('pitch_rad')}, 0 for a sonar that looks straight ahead"
            )
        if self.poses is None and self.pitch_rad is not None:
            on_mount = std / [1, 1, np.cos(self.pitch_rad)] * [aided.rise_m is not None, 1, 1]
            lean = leaning_mount(lean, self.pitch_rad)
            aided = replace(aided, attitude_rad=lean, pitch_rad=None, attitude_std=on_mount)
            return aided, sensors.on_mount(self.pitch_rad)
        return aided, sensors.on_mount(float(np.nanmean(known[:, 3] - lean[:, 0])))

    def _with_unknown_roll(self, sensors: VehicleSensors, every: int) -> VehicleSensors:
        """Return sensors whose gyroscope has the noise of turns that the vehicle's roll gives a pitched sonar."""
        gyro = sensors.yaw_rate
        if gyro is None or self.pitch_rad is None or self.poses is not None:
            return sensors
        step_s = every * float(np.median(np.diff(self.time_s)))
        # on a calm day, whose rolls are bounded over long steps
        turn = abs(math.tan(self.pitch_rad)) * min(UNKNOWN_PER_S.roll_rad * step_s, UNKNOWN_MOST.roll_rad)
        noise = turn / math.sqrt(step_s)
        if noise > LARGE_NOISE * float(np.median(gyro.std)):
            warnings.warn(
                f"{self.name}: as the vehicle rolls, a sonar pitched by {math.degrees(self.pitch_rad):.3g} deg turns by "
                f"some {math.degrees(turn):.2g} deg in a motion, which the gyroscope of {sensors.name} does not "
                "see: add vehicle_pitch_deg and vehicle_roll_deg, or it hardly counts",
                MitsonarWarning,
                stacklevel=4,
            )
        return replace(sensors, yaw_rate=replace(gyro, std=np.hypot(gyro.std, noise)))

    @property
    def sonar_poses(self) -> Array | None:
        """Return the poses of the sonar ``(frames, 6)`` [m, rad]; None if they are not known."""
        return self.poses

    @property
    def true(self) -> Trajectory | None:
        """Return the true path of the sonar; None if it is not known."""
        return None if self.poses is None else Trajectory(self.poses, self.time_s)

    def check_times(self) -> None:
        """Check that the times of the frames increase.

        Raises:
            MitsonarError: the times do not increase, or are not finite.
        """
        bad = np.flatnonzero(~(np.diff(self.time_s) > 0))
        if not np.isfinite(self.time_s).all() or bad.size:
            where = int(bad[0]) if bad.size else 0
            times = ", ".join(f"{time:.15g}" for time in self.time_s[where : where + 2])
            raise MitsonarError(
                f"{self.name}: frame times must be finite and increase: got {times} s at frame {where}; write the frames in "
                "order, with time_s"
            )

    def read(self, index: ArrayLike) -> SonarFrames:
        """Read the frames with these numbers ``(n,)`` as an estimator may see them.

        Their poses have height, pitch and roll, but zero position and heading, so that no ground truth can leak. If only
        pitch and roll are known, the height is nan. A pitch that is only that of the mount comes with attitudes of nan.

        Raises:
            MitsonarError: a frame does not exist, or its pixels cannot be read.
        """
        chosen = np.asarray(index, dtype=np.intp)
        beyond = chosen[(chosen < 0) | (chosen >= len(self))]
        if beyond.size:
            raise MitsonarError(f"{self.name} has no frame {beyond[0]}: it holds {len(self):,}, numbered from 0")
        try:
            image = self.images(chosen)
        except (OSError, ValueError, RuntimeError, KeyError) as error:
            reason = " ".join(str(error).split())[:160]
            raise MitsonarError(f"{self.name}: frames {chosen[0]}..{chosen[-1]} cannot be read: {reason}") from None
        if self.noise is not None:
            numbers = chosen.astype(np.int64) + self.first_number
            image = self.noise.apply(to_float32(image), seed=self.seed, frames=numbers)
        poses = self.attitudes(chosen)
        if poses is not None and self.poses is None and self.rise_m is None:
            poses[:, 2] = np.nan
        unmeasured = self.rise_m is not None and self.pitch_rad is not None
        frames = replace(
            self.like,
            image=image,
            time_s=self.time_s[chosen],
            poses=poses,
            attitude_rad=np.full((len(chosen), 3), np.nan) if unmeasured else None,
            height_m=None if self.height_m is None else self.height_m[chosen],
            attitude_std=None if self.attitude_std is None else self.attitude_std[chosen],
        )
        if self.altimeter is not None:
            frames = measured(frames, self.altimeter)[0]
        return frames if self.contrast is None else self._contrast_of(frames, self.contrast)

    def _contrast_of(self, frames: SonarFrames, contrast: LocalContrast) -> SonarFrames:
        level = frames.in_decibels()
        level = level if self.pattern_db is None else level - self.pattern_db
        return replace(frames, image=contrast.apply(level), level="contrast")

    def attitudes(self, chosen: Index) -> Array | None:
        """Return poses without position and heading ``(n, 6)``; None if neither poses, pitch nor attitudes are known."""
        if self.poses is not None:
            return self.poses[chosen] * [0, 0, 1, 1, 1, 0]
        if self.pitch_rad is None and self.attitude_rad is None:
            return None
        poses = np.zeros((len(chosen), 6))
        poses[:, 2] = 0.0 if self.rise_m is None else self.rise_m[chosen]
        if self.pitch_rad is not None:
            poses[:, 3] = self.pitch_rad
        elif self.attitude_rad is not None:
            poses[:, 3:5] = self.attitude_rad[chosen, :2]
        return poses

    def chunks(self, index: ArrayLike) -> Iterator[SonarFrames]:
        """Read the frames with these numbers ``(n,)``, a few at a time: a lone frame shows no motion of grouped beams."""
        chosen = np.asarray(index, dtype=np.intp)
        for some in np.array_split(chosen, max(1, -(-len(chosen) // max(3, self.frames_per_chunk)))):
            if len(some):
                yield self.read(some)

    def along(self, path: Trajectory, tolerance_s: float = 0.01) -> tuple[Index, Array]:
        """Return the numbers ``(n,)`` of the frames for which a path has a pose, and these poses ``(n, 6)``.

        If height, pitch and roll are constant along the path, as from planar odometry, pitch and roll are taken from the
        frames, if known.

        Raises:
            MitsonarError: no frame lies within the tolerance of the time of a pose.
        """
        self.check_times()
        try:
            there, index = associated(path.time_s, self.time_s, tolerance_s)
        except MitsonarError:
            raise MitsonarError(
                f"the path lasts from {path.time_s[0]:.15g} to {path.time_s[-1]:.15g} s, {self.name} from "
                f"{self.time_s[0]:.15g} to {self.time_s[-1]:.15g} s, and no pose is within {tolerance_s:g} s of a frame: "
                "give the path of this run"
            ) from None
        poses = path.poses[there].copy()
        attitudes = self.attitudes(index)
        if attitudes is not None and (np.ptp(path.poses[:, 2:5], axis=0) < PLANAR).all():
            known = np.isfinite(attitudes[:, 3:5]).all(axis=1)
            poses[known, 3:5] = attitudes[known, 3:5]
        return index, poses

    def heights_along(self, index: Index, poses: Array) -> Array | None:
        """Return the heights over the ground of the frames ``index`` ``(n,)`` [m] along a path; None if they are not known.

        A height that is given or assumed, the same for all frames, is the mean over a path that heaves.

        Args:
            index: numbers of the frames ``(n,)``.
            poses: poses of the path at these frames ``(n, 6)`` [m, rad].

        Raises:
            MitsonarError: the path falls below level ground.
        """
        if self.height_m is None:
            return None
        heights = self.height_m[index]
        if not (self.assumed_height or self.given_height_m is not None) or np.ptp(heights) > 0:
            return heights
        heave = poses[:, 2] - poses[:, 2].mean()
        if (heights + heave <= 0).any():
            raise MitsonarError(
                f"{self.name}: the path heaves by {heave.min():.4g}..{heave.max():.4g} m about its mean, more than the "
                f"height of {heights[0]:g} m over level ground: give the mean height, and the heights of the path in metres"
            )
        return np.asarray(heights + heave, dtype=np.float64)

    @property
    def frames_per_chunk(self) -> int:
        """Return the number of frames that are read at a time."""
        return max(1, CHUNK_BYTES // max(1, len(self.like.range_m) * len(self.like.bearing_rad) * 4))

    def digest(self) -> str:
        """Return the SHA-256 of all data except the images, of which the first, middle and last enter."""
        digest = hashlib.sha256(self.like.sonar.model_dump_json().encode())
        for values in (self.like.range_m, self.like.bearing_rad, self.time_s, self.poses, self.height_m):
            digest.update(b"-" if values is None else np.ascontiguousarray(values, dtype=float).tobytes())
        for extra in (self.attitude_rad, self.rise_m, self.attitude_std, self.pattern_db):
            digest.update(b"" if extra is None else np.ascontiguousarray(extra, dtype=float).tobytes())
        if (self.like.level, self.like.level_scale) != ("linear", 1.0):
            digest.update(repr((self.like.level, self.like.level_scale)).encode())
        digest.update(repr((self.pitch_rad, self.noise, self.seed, self.first_number)).encode())
        digest.update(b"" if self.altimeter is None else repr(self.altimeter).encode())
        digest.update(b"" if self.contrast is None else repr(self.contrast).encode())
        if len(self):
            some = np.unique(np.linspace(0, len(self) - 1, 3).astype(np.intp))
            digest.update(np.ascontiguousarray(self.read(some).image).tobytes())
        return digest.hexdigest()


def _heave_rate(time_s: Array, rise_m: Array, std_m: Array) -> float:
    """Return the rms rate of the heave [m/s] without its noise; dives for less than half the time do not count."""
    step = np.diff(time_s)
    rate, noise = np.diff(rise_m) / step, smoothed_change(std_m[:-1], std_m[1:], step) / step
    # half of a sway's squares lie below their mean
    return float(np.sqrt(max(0.0, float(np.median((rate - np.median(rate)) ** 2 - noise**2)))))


# ---------------- Frames at a path or URL


StoredArray = Any
"""A Zarr array of either metadata format, read by indexing."""

FINDING = "give frames.npz, frames.zarr, the folder of a run, a data set or a recording"


def open_frames(
    where: str | Path, *, sequence: int | None = None, view: str | None = None, geometry: str | Path | None = None
) -> FrameSource:
    """Open the frames at a path or URL.

    Args:
        where: ``frames.npz``, ``frames.zarr``, the folder of a run that holds either, a data set, or a recording.
        sequence: number of the sequence of a data set, or of the part of a recording; by default the longest, the
            first if several are equally long.
        view: view of a data set, or topic of a ROS bag; by default the first, or the only one.
        geometry: file that describes the layout of the pictures of a recording.

    Raises:
        MitsonarError: there are no frames, the sequence or view does not exist, or the geometry is not needed.
    """
    path = Path(where)
    data_set = is_data_set(where)
    if not data_set and is_recording(where):
        return _open_recording(path, sequence, view, geometry)
    if geometry is not None:
        raise MitsonarError(f"{where} is not a recording of pictures, and states its geometry: leave {geometry} out")
    if data_set:
        return _open_data_set(str(where), sequence, view)
    if sequence is not None or view is not None:
        raise MitsonarError(f"{where} is neither a data set nor a recording: leave sequence and view out")
    if os.path.isdir(path) and not os.path.isfile(path / "zarr.json"):
        stored = frames_in(path)
        if stored is None:
            from mitsonar.recordings.open import recordings_in

            if kind_of_run(path) == "odometry":
                raise MitsonarError(
                    f"{path} is the folder of an odometry, which holds no frames: give the run or recording of the frames"
                )
            raise MitsonarError(f"{path} holds no frames.npz or frames.zarr: {recordings_in(path) or FINDING}")
        path = stored
    return _open_zarr(path, str(where)) if os.path.isdir(path) else _open_npz(path, str(where))


def load_frames(
    where: str | Path, *, sequence: int | None = None, view: str | None = None, geometry: str | Path | None = None
) -> SonarFrames:
    """Load all frames at a path or URL into memory, with true poses if they are known.

    Labels are not loaded; use :meth:`mitsonar.SonarFrames.load` for those of a run.

    Args:
        where: ``frames.npz``, ``frames.zarr``, the folder of a run that holds either, a data set, or a recording.
        sequence: number of the sequence of a data set, or of the part of a recording; by default the longest, the
            first if several are equally long.
        view: view of a data set, or topic of a ROS bag; by default the first, or the only one.
        geometry: file that describes the layout of the pictures of a recording.

    Raises:
        MitsonarError: there are no frames, the sequence or view does not exist, or the geometry is not needed.
    """
    source = open_frames(where, sequence=sequence, view=view, geometry=geometry)
    return replace(source.read(np.arange(len(source))), poses=source.poses, attitude_rad=source.attitude_rad)


def is_data_set(where: str | Path) -> bool:
    """Return whether a path or URL is a data set.

    Every URL counts as one. The frames of a long run are a Zarr group too, distinguished by its attributes.
    """
    path = Path(where)
    if "://" in str(where):
        return True
    if not os.path.isfile(path / "zarr.json"):
        return False
    import zarr

    try:
        return bool(zarr.open_group(path, mode="r").attrs.get("kind") == "mitsonar data set")
    except Exception:  # a damaged Zarr may raise anything
        return False


def is_recording(where: str | Path) -> bool:
    """Return whether a path is a recording of a real sonar; the readers are not loaded for a run of mitsonar."""
    run = os.path.isfile(Path(where) / "run.json") and frames_in(where) is not None
    if run or "://" in str(where):
        return False
    from mitsonar.recordings.open import detect_format

    return detect_format(where) is not None


def _open_recording(path: Path, number: int | None, view: str | None, geometry: str | Path | None) -> FrameSource:
    """Open a part of a recording, by default the longest."""
    from mitsonar.recordings.open import open_recording

    recording = open_recording(path, geometry, view)
    for note in recording.notes:
        warnings.warn(f"{path}: {note}", MitsonarWarning, stacklevel=3)
    part, which = recording.part(number), ""
    if len(recording.parts) > 1:
        chosen = recording.longest if number is None else number
        longest = ", the longest" if number is None else ""
        which = f"part {chosen} of {len(recording.parts):,}{longest}: {count_noun(len(part), 'frame')}"
    return FrameSource.of_part(part, str(path), which)


def _open_npz(path: Path, name: str) -> FrameSource:
    """Open the frames of ``frames.npz``.

    Raises:
        MitsonarError: the file is missing, of another kind, or damaged.
    """
    if not os.path.exists(path):
        raise missing_file(path, FINDING)
    if os.path.isfile(path) and os.access(path, os.R_OK) and not is_zipfile(path):
        from mitsonar.recordings.open import frameless_words, known_formats

        if words := frameless_words(path):
            raise MitsonarError(words)
        empty = path.stat().st_size == 0
        reason = "it is empty" if empty else "it is neither a whole frames.npz nor a recording that mitsonar reads"
        raise MitsonarError(f"cannot read frames {path}: {reason}; {FINDING}: {known_formats()}")
    return FrameSource.of(SonarFrames.load(path), name)


def _open_zarr(path: Path, name: str) -> FrameSource:
    """Open the frames of a long run, even if it is not finished."""
    # 1. read everything but images and labels, up to the frames that are written
    try:
        columns, done = open_group(path, COLUMNS, "time_s", "frames_done")
        arrays = {name: one for name, one in columns.items() if not isinstance(one, np.ndarray)}
        arrays = {name: array for name, array in arrays.items() if name not in (*LABELS, "pitch_rad")}
        image = arrays["image"]
        table: dict[str, Any] = {
            name: array[:done] if name in PER_FRAME else array[...] for name, array in arrays.items() if name != "image"
        }
        table |= {name: value for name, value in columns.items() if isinstance(value, np.ndarray)}
        nothing = np.zeros((0, *image.shape[1:]), dtype=image.dtype)
        none_of = {name: values[:0] for name, values in table.items() if name in PER_FRAME}
    except Exception as error:
        raise MitsonarError(f"cannot read frames {path}: {' '.join(str(error).split())[:160]}; {FINDING}") from None
    # 2. validate: a record of zero frames for what all frames share, the columns per frame by themselves
    like = SonarFrames.from_arrays(table | none_of | {"image": nothing}, str(path))
    for known in ("poses", "attitude_rad", "height_m"):
        if known in table:
            check_column(table[known], known, COLUMNS[known], {"frames": done, "six": 6, "three": 3}, str(path))
    times = table["time_s"]
    if times.ndim == 1:
        check_column(times, "time_s", COLUMNS["time_s"], {"frames": done}, str(path))
    if done < image.shape[0]:
        message = f"{path} is not finished: {done:,} of {count_noun(image.shape[0], 'frame')} written"
        warnings.warn(message, MitsonarWarning, stacklevel=3)
    poses, attitude, height = table.get("poses"), table.get("attitude_rad"), table.get("height_m")

    def images(index: Index) -> Pixels:
        picked = _picked(image, index)
        check_column(picked, "image", COLUMNS["image"], {}, str(path))
        return picked

    return FrameSource.of_arrays(like, table["time_s"], poses, height, images, name, attitude_rad=attitude)


def _open_data_set(url: str, sequence: int | None, view: str | None) -> FrameSource:
    from mitsonar.datasets.store import DataStore  # its import takes half a second

    store = DataStore.open(url)
    chosen = view_in(store, view)
    here, number, which = sequence_in(store, sequence)
    image = store.array(chosen.array)
    return FrameSource.of_arrays(
        replace(chosen.like, level_scale=store.level_scale_of(int(store.read("scene", here)[0]))),
        store.read("time_s", here),
        store.read("pose", here),
        store.read("height_m", here),
        lambda index: _picked(image, index + here.start),
        f"{url}, sequence {number}",
        first_number=here.start,
        note=which + (f", view {chosen.name}" if chosen.several else ""),
    )


class StoredView(NamedTuple):
    """A view of a data set.

    Attributes:
        name: name of the view.
        array: name of the array that holds its images.
        like: a record of zero frames with the sonar, bins, beams and level of the images.
        several: whether the data set has other views.
    """

    name: str
    array: str
    like: SonarFrames
    several: bool


def view_in(store: DataStore, view: str | None = None) -> StoredView:
    """Return a view of a data set whose images are stored; by default the first.

    Raises:
        MitsonarError: the data set holds no images, or no such view.
    """
    from mitsonar.config.data import array_names

    stored = {name: array for array, (kind, name) in array_names(store.recipe).items() if kind == "image"}
    if not stored:
        raise MitsonarError(f"{store.place.url} holds vectors but no images: give a data set of images")
    name = next(iter(stored)) if view is None else view
    if name not in stored:
        raise MitsonarError(f"{store.place.url} has no view {name!r}: {suggest_names(name, stored)}")
    known = {one.name: one for one in store.recipe.views}[name]
    image = store.array(stored[name])
    like = SonarFrames(
        image=np.zeros((0, *image.shape[1:]), dtype=image.dtype),
        range_m=known.sonar.range_m,
        bearing_rad=known.bearing_rad,
        time_s=np.zeros(0),
        sonar=known.sonar,
        level=store.recipe.level_of(known),
        level_scale=float(store.about["level_scale"]),
    )
    return StoredView(name, stored[name], like, len(stored) > 1)


def sequence_in(store: DataStore, sequence: int | None = None) -> tuple[slice, int, str]:
    """Return the frames of a sequence of a data set, its number and a description.

    The default is the longest sequence, the first if several are equally long.

    Raises:
        MitsonarError: there is no such sequence.
    """
    sequences = store.read("sequence")
    lengths = np.bincount(sequences)
    number = int(lengths.argmax()) if sequence is None else sequence
    if not (0 <= number < len(lengths) and lengths[number]):
        raise MitsonarError(f"{store.place.url} has no sequence {number}: it has {len(lengths):,}, numbered from 0")
    first = int(np.argmax(sequences == number))
    longest = ", the longest" if sequence is None else ""
    which = f"sequence {number} of {len(lengths):,}{longest}: {count_noun(int(lengths[number]), 'frame')}"
    return slice(first, first + int(lengths[number])), number, which


def _picked(image: StoredArray, index: Index) -> Pixels:
    """Read frames of a Zarr array; evenly spaced frames are read in one slice."""
    if not len(index):
        return np.asarray(image[:0])
    steps = np.unique(np.diff(index))
    if len(steps) <= 1 and (not len(steps) or steps[0] > 0):
        return np.asarray(image[int(index[0]) : int(index[-1]) + 1 : int(steps[0]) if len(steps) else 1])
    return np.stack([np.asarray(image[int(one)]) for one in index])


# ---------------- Frames as a recording, with labels


Labels: TypeAlias = dict[str, Any]
"""Arrays of per-pixel ground truth, keyed by the names in :data:`~mitsonar.records.frames.LABELS`."""


@dataclass(frozen=True)
class LabelledPart(Part):
    """A part of a recording with per-pixel ground truth.

    Attributes:
        labels: reads the labels of the frames with the given numbers ``(n,)``, by name, as ``(n, bins, beams)``.
    """

    labels: Callable[[Index], Labels] = lambda index: {}

    def read(self, index: ArrayLike) -> SonarFrames:
        """Read the frames with these numbers ``(n,)``, including labels.

        Raises:
            MitsonarError: a frame does not exist, or cannot be read.
        """
        return replace(super().read(index), **self.labels(np.asarray(index, dtype=np.intp)))

    def _read_within(self, rows: slice, columns: slice) -> dict[str, Any]:
        """Return the fields that read pixels and labels, restricted to these bins and beams."""

        def labels(index: Index) -> Labels:
            return {name: values[:, rows, columns] for name, values in self.labels(index).items()}

        return {**super()._read_within(rows, columns), "labels": labels}


def recording_at(
    where: str | Path, *, sequence: int | None = None, view: str | None = None, geometry: str | Path | None = None
) -> Recording:
    """Open frames at a path or URL as a recording.

    Args:
        where: a recording of a real sonar, ``frames.npz``, ``frames.zarr``, the folder of a run, or a data set.
        sequence: number of the sequence of a data set.
        view: view of a data set, or topic of a ROS bag.
        geometry: file that describes the layout of pictures.

    Raises:
        MitsonarError: there are no frames, or the options do not fit them.
    """
    data_set = is_data_set(where)
    if not data_set and is_recording(where):
        from mitsonar.recordings.open import open_recording

        return open_recording(where, geometry, view)
    source = open_frames(where, sequence=sequence if data_set else None, view=view, geometry=geometry)
    labels = None if data_set else _labels_at(Path(where))
    times, beam_poses = (None, None) if data_set else _beam_motion_at(Path(where), len(source))
    part = LabelledPart(
        like=source.like,
        time_s=source.time_s,
        images=source.images,
        poses=source.poses,
        attitude_rad=source.attitude_rad,
        height_m=source.height_m,
        beam_time_s=times,
        beam_poses=beam_poses,
        labels=(lambda index: {}) if labels is None else labels,
    )
    words = "data set of mitsonar" if data_set else "run of mitsonar"
    return Recording(str(where), words, (part,), {}, (source.note,) if source.note else ())


def _beam_motion_at(path: Path, frames: int) -> tuple[Array | None, Array | None]:
    """Return the times ``(frames, beams)`` and poses ``(frames, beams, 6)`` of the beams of a run, as far as it has them."""
    if os.path.isdir(path) and path.suffix != ".zarr":
        path = frames_in(path) or path
    if os.path.isfile(path):
        table: dict[str, Any] = SonarFrames.load(path).arrays()
    else:
        try:
            table = open_group(path, COLUMNS, "time_s", "frames_done")[0]
        except Exception as error:  # a damaged Zarr raises errors of many kinds
            raise MitsonarError(f"cannot read the times of {path}: {' '.join(str(error).split())[:160]}") from None
    times, poses = table["time_s"], table.get("beam_poses")
    return None if times.ndim == 1 else np.asarray(times[:frames]), None if poses is None else np.asarray(poses[:frames])


def _labels_at(path: Path) -> Callable[[Index], Labels] | None:
    """Return a function that reads the labels of a run by frame number; None if the run has no labels."""
    if os.path.isdir(path) and path.suffix != ".zarr":
        path = frames_in(path) or path
    if os.path.isfile(path):
        frames = SonarFrames.load(path)
        labels = {name: getattr(frames, name) for name in LABELS if getattr(frames, name) is not None}
        return (lambda index: {name: values[index] for name, values in labels.items()}) if labels else None
    try:
        arrays = {name: one for name, one in open_group(path, COLUMNS, "time_s", "frames_done")[0].items() if name in LABELS}
    except Exception as error:  # a damaged Zarr raises errors of many kinds
        raise MitsonarError(f"cannot read the labels of {path}: {' '.join(str(error).split())[:160]}") from None

    def stored(index: Index) -> Labels:
        return {
            name: np.stack([np.asarray(one[int(number)]) for number in index]) if len(index) else np.asarray(one[:0])
            for name, one in arrays.items()
        }

    return stored if arrays else None


# ---------------- Heights measured in the frames


Framed = TypeVar("Framed", bound="SonarFrames | ViewFrames")


def measured(
    frames: Framed, by: HeightEstimator, like: SonarFrames | ViewFrames | None = None
) -> tuple[Framed, list[HeightEstimate]]:
    """Measure the height in each frame; return the frames with these heights, and the estimates.

    Heights are nan where the estimate is not valid. The poses take the same heights, so that no recorded height remains.

    Args:
        frames: frames whose heights are replaced.
        by: measures the heights.
        like: the same pings in the form that the estimator reads; None: ``frames``.

    Raises:
        MitsonarError: the estimator cannot read the frames.
    """
    read = frames if like is None else like
    estimates = [by.height(read.select(slice(k, k + 1))) for k in range(len(read))]
    heights = np.array([one.height_m if one.valid else np.nan for one in estimates])
    return replace(frames, height_m=heights, poses=_with_heights(frames.poses, heights)), estimates


def without_height(frames: Record) -> bool:
    """Return whether heights were measured in these frames, but none was found."""
    heights, poses = getattr(frames, "height_m", None), frames.poses
    if heights is None or np.isfinite(heights).any():
        return False
    return poses is None or not np.isfinite(poses[:, 2]).any()


def _with_heights(poses: NDArray[np.float64] | None, heights: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return poses with these heights over the ground."""
    if poses is None:
        return None
    moved = poses.copy()
    moved[:, 2] = heights
    return moved


# ---------------- Poses at the times of frames


SAME_S = 0.01
"""Largest time between a frame and a pose that count as simultaneous [s]: times in files are rounded."""

LONGEST_GAP_S = 1.0
"""Longest step of a path over which poses are interpolated [s]."""

PAUSE = 5.0
"""Multiple of the median step between frames above which a step ends a stretch."""


def poses_at(
    path: Trajectory, time_s: Array, name: str, attitude_rad: Array | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Interpolate a path at the times of frames.

    A frame has a pose if a pose of the path is within 10 ms of it, or if it lies between two poses at most a second apart.
    If height, pitch and roll are constant along the path, as from planar odometry, pitch and roll are taken from the frames,
    if known.

    Args:
        path: path with increasing times.
        time_s: times of the frames ``(frames,)`` [s].
        name: name of the frames, for error messages.
        attitude_rad: pitch, roll, heading of the frames measured by the sensors of the sonar ``(frames, 3)`` [rad]; nan
            where unknown.

    Returns:
        Poses ``(frames, 6)`` [m, rad], nan where there is none, and whether each frame has one ``(frames,)``.

    Raises:
        MitsonarError: the times of the path do not increase, or no frame has a pose.
    """
    times = path.time_s
    if not (np.diff(times) > 0).all():
        raise MitsonarError("the times of the path must increase: sort its poses")
    # 1. the poses of the path before and after each frame, and whether they are close enough
    after = np.clip(np.searchsorted(times, time_s), 1, max(1, len(times) - 1)).astype(np.intp)
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    near = np.minimum(np.abs(times[before] - time_s), np.abs(times[after] - time_s)) <= SAME_S + 1e-9
    between = (times[before] <= time_s) & (time_s <= times[after]) & (times[after] - times[before] <= LONGEST_GAP_S)
    known = near | between
    if not known.any():
        raise MitsonarError(
            f"no pose for the frames of {name}: the path lasts from {times[0]:.10g} to {times[-1]:.10g} s, the frames from "
            f"{time_s[0]:.10g} to {time_s[-1]:.10g} s; give a path with the times of the frames"
        )
    # 2. interpolate; a planar path carries no attitudes, so those of the frames replace them
    poses = np.full((len(time_s), 6), np.nan)
    poses[known] = _interpolated(path, np.clip(time_s[known], times[0], times[-1]))
    if attitude_rad is not None and (np.ptp(path.poses[:, 2:5], axis=0) < PLANAR).all():
        has_attitude = known[:, None] & np.isfinite(attitude_rad[:, :2])
        poses[:, 3:5] = np.where(has_attitude, attitude_rad[:, :2], poses[:, 3:5])
    return poses, known


def stretches(known: NDArray[np.bool_], time_s: Array) -> list[slice]:
    """Return the stretches of two or more consecutive frames that have poses and follow each other without a pause.

    Args:
        known: whether each frame has a pose ``(frames,)``.
        time_s: times of the frames ``(frames,)`` [s].
    """
    steps = np.diff(time_s)
    usual = float(np.median(steps)) if len(steps) else 0.0
    ends = np.flatnonzero(~(known[1:] & known[:-1]) | (steps > PAUSE * usual)) + 1
    borders = [0, *ends.tolist(), len(known)]
    return [slice(begin, end) for begin, end in pairwise(borders) if end - begin > 1]


def _interpolated(path: Trajectory, time_s: Array) -> Array:
    """Interpolate a path at times within it ``(n, 6)``: positions linearly, attitudes spherically (slerp).

    At a time of the path, the result is the pose of the path, bit for bit.
    """
    if len(path) == 1:
        return np.repeat(path.poses, len(time_s), axis=0)
    position = np.column_stack([np.interp(time_s, path.time_s, axis) for axis in path.poses[:, :3].T])
    poses = poses_from(position, Slerp(path.time_s, vehicle_rotation(path.poses))(time_s))
    place = np.minimum(np.searchsorted(path.time_s, time_s), len(path) - 1)
    same = path.time_s[place] == time_s
    poses[same] = path.poses[place[same]]
    return np.asarray(poses, dtype=np.float64)
