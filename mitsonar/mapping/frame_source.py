"""Sonar frames of one run, read some at a time: of a simulated run, a data set or a recording."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.levels import LocalContrast, fitted_contrast
from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError
from mitsonar.mapping.measured_heights import measured
from mitsonar.motion.bodies import BodyStates
from mitsonar.motion.errors import associated
from mitsonar.motion.trajectory import Trajectory
from mitsonar.recordings.recording import CHUNK_BYTES, Part, Pixels
from mitsonar.records.frames import LABELS, SonarFrames, to_float32

if TYPE_CHECKING:
    from mitsonar.estimation.height import HeightEstimator

__all__ = ["FrameSource"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

PATTERN_FRAMES = 64
"""Frames of which a static pattern is the mean, at most."""

FITTED, FITTED_RUNS = 3, 4
"""Consecutive frames of a run by which the contrast is fitted, and the number of such runs."""

PLANAR = 1e-6
"""Smallest change of height, pitch or roll along a path [m, rad]: files round them."""


@dataclass(frozen=True)
class FrameSource:
    """The frames of one run; pixels are read on demand.

    Attributes:
        name: of the source, for messages.
        like: no frames, but all that is the same for each of them: sonar, bins, beams, level.
        time_s: of the frames ``(frames,)`` [s]; where each beam has its own, their mean.
        images: reads the frames of given numbers ``(n,)``: ``(n, bins, beams)``.
        poses: true poses of the sonar ``(frames, 6)`` [m, rad], where known.
        attitude_rad: pitch, roll, heading by the sonar's own sensors ``(frames, 3)`` [rad], where known; nan where not.
        height_m: over the ground ``(frames,)``, where known; nan where nothing is below.
        pitch_rad: of the sonar, where its poses are not known.
        told_height_m: the height that the user gave for frames without one.
        assumed_height: whether ``height_m`` is assumed, since nobody tells it.
        noise: added to the frames that are read.
        seed: of the noise.
        first_number: number of the first frame, of which the noise is a function.
        note: which frames these are, where the name does not say it.
        altimeter: measures the height of each frame that is read, in place of ``height_m``.
        contrast: turns levels into local contrast when frames are read.
        pattern_db: static pattern ``(bins, beams)`` [dB] that moves with the sonar, taken out before the contrast.
    """

    name: str
    like: SonarFrames
    time_s: Array
    images: Callable[[Index], Pixels]
    poses: Array | None = None
    attitude_rad: Array | None = None
    height_m: Array | None = None
    pitch_rad: float | None = None
    told_height_m: float | None = None
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
        """Take frames that are in memory; labels are not kept."""
        nothing: dict[str, Any] = dict.fromkeys(LABELS)
        frames = replace(frames, **nothing)
        like, images = frames.select(slice(0)), frames.image.__getitem__
        known = frames.poses, frames.height_m
        return cls.of_arrays(like, frames.time_s, *known, images, name, attitude_rad=frames.attitude_rad)

    @classmethod
    def of_part(cls, part: Part, name: str, note: str = "") -> Self:
        """Take a part of a recording."""
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
        """Take frames whose times, poses, attitudes and heights are in memory, and whose images are read on demand."""
        time = np.asarray(time_s, dtype=float)
        time = time.mean(axis=1) if time.ndim == 2 else time
        like = replace(like, beam_poses=None, **BodyStates().fields())  # as labels: truth that is not kept
        return cls(name, like, time, images, poses, attitude_rad, height_m, first_number=first_number, note=note)

    def with_noise(self, noise: NoiseModel, seed: int = 0) -> Self:
        """Return the same frames with noise: a function of the seed and the number of each frame."""
        return self if noise.is_none else replace(self, noise=noise, seed=seed)

    def with_contrast(self, contrast: LocalContrast | None = None, *, moving: bool = False) -> Self:
        """Return the same frames as local contrast: without the light that moves with the sonar.

        Args:
            contrast: how; default: smoothed as little as makes consecutive frames alike, by some of these frames.
            moving: take out the mean of frames over the whole run too. A sonar at rest loses its scene by that.
        """
        plain = replace(self, altimeter=None)
        pattern = None
        if moving:
            some = np.unique(np.linspace(0, len(self) - 1, PATTERN_FRAMES).astype(np.intp))
            levels = np.stack([plain.read([one]).in_decibels()[0] for one in some])
            pattern = np.asarray(levels.mean(axis=0), dtype=np.float32)
        if contrast is None:
            starts = np.unique(np.linspace(0, max(0, len(self) - FITTED), FITTED_RUNS).astype(np.intp))
            runs = [plain.read(np.arange(at, min(at + FITTED, len(self)))).in_decibels() for at in starts]
            contrast = fitted_contrast([run if pattern is None else run - pattern for run in runs])
        return replace(self, contrast=contrast, pattern_db=pattern)

    def with_heights_by(self, estimator: HeightEstimator) -> Self:
        """Return the same frames, whose heights an estimator measures when they are read.

        Raises:
            MitsonarError: an estimator that reads views, not frames.
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
            MitsonarError: they lack nothing, or a number outside its limits.
        """
        lacking = self.height_m is None or not np.isfinite(self.height_m).all()
        if height_m is not None and not lacking:
            raise MitsonarError(
                f"{self.name}: the frames tell their heights, so that {height_m:g} m would not be used: leave it out, "
                "or give it to the estimator, as NAME:height_m=2.5"
            )
        if pitch_rad is not None and self.poses is not None:
            raise MitsonarError(
                f"{self.name}: the frames tell their pitch, so that {np.degrees(pitch_rad):g} deg would not be used: leave "
                "it out, or give it to the estimator, as NAME:pitch_deg=35"
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
            self, height_m=heights, told_height_m=height_m, pitch_rad=pitch_rad if self.pitch_rad is None else self.pitch_rad
        )

    @property
    def sonar_poses(self) -> Array | None:
        """Return the poses of the sonar ``(frames, 6)`` [m, rad]; None where they are not known."""
        return self.poses

    @property
    def true(self) -> Trajectory | None:
        """Return the true path of the sonar; None where it is not known."""
        return None if self.poses is None else Trajectory(self.poses, self.time_s)

    def check_times(self) -> None:
        """Check that the times of the frames increase.

        Raises:
            MitsonarError: they do not, or are not finite.
        """
        bad = np.flatnonzero(~(np.diff(self.time_s) > 0))
        if not np.isfinite(self.time_s).all() or bad.size:
            where = int(bad[0]) if bad.size else 0
            times = ", ".join(f"{time:g}" for time in self.time_s[where : where + 2])
            raise MitsonarError(
                f"{self.name}: frame times must be finite and increase: got {times} s at frame {where}; write the frames in "
                "order, with time_s"
            )

    def read(self, index: ArrayLike) -> SonarFrames:
        """Read frames of these numbers ``(n,)`` as estimators may use them.

        Their poses have height, pitch and roll, but position and heading 0, so that no truth can leak. Where only pitch and
        roll are known, the height is nan.

        Raises:
            MitsonarError: frames that are not there, or pixels that cannot be read.
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
        if poses is not None and self.poses is None:
            poses[:, 2] = np.nan
        frames = replace(
            self.like,
            image=image,
            time_s=self.time_s[chosen],
            poses=poses,
            attitude_rad=None,
            height_m=None if self.height_m is None else self.height_m[chosen],
        )
        if self.altimeter is not None:
            frames = measured(frames, self.altimeter)[0]
        return frames if self.contrast is None else self._contrast_of(frames, self.contrast)

    def _contrast_of(self, frames: SonarFrames, contrast: LocalContrast) -> SonarFrames:
        level = frames.in_decibels()
        level = level if self.pattern_db is None else level - self.pattern_db
        return replace(frames, image=contrast.apply(level), level="contrast")

    def attitudes(self, chosen: Index) -> Array | None:
        """Return poses of frames without position and heading ``(n, 6)``; None where neither poses nor pitch are known."""
        if self.poses is not None:
            return self.poses[chosen] * [0, 0, 1, 1, 1, 0]
        if self.pitch_rad is not None:
            return np.tile([0.0, 0, 0, self.pitch_rad, 0, 0], (len(chosen), 1))
        if self.attitude_rad is None:
            return None
        pitch_roll = self.attitude_rad[chosen, :2]
        return np.column_stack([np.zeros((len(chosen), 3)), pitch_roll, np.zeros(len(chosen))])

    def chunks(self, index: ArrayLike) -> Iterator[SonarFrames]:
        """Read frames of these numbers, some at a time."""
        chosen = np.asarray(index, dtype=np.intp)
        count = self.frames_a_chunk
        for start in range(0, len(chosen), count):
            yield self.read(chosen[start : start + count])

    def along(self, path: Trajectory, tolerance_s: float = 0.01) -> tuple[Index, Array]:
        """Return the numbers ``(n,)`` of the frames for which a path has a pose, and these poses ``(n, 6)``.

        A path of odometry has one height, pitch and roll throughout. Pitch and roll are then those of the frames, if known.

        Raises:
            MitsonarError: no frame is at the time of a pose, within the tolerance.
        """
        self.check_times()
        try:
            there, index = associated(path.time_s, self.time_s, tolerance_s)
        except MitsonarError:
            raise MitsonarError(
                f"the path lasts from {path.time_s[0]:g} to {path.time_s[-1]:g} s, {self.name} from {self.time_s[0]:g} to "
                f"{self.time_s[-1]:g} s, and no pose is within {tolerance_s:g} s of a frame: give the path of this run"
            ) from None
        poses = path.poses[there].copy()
        attitudes = self.attitudes(index)
        if attitudes is not None and (np.ptp(path.poses[:, 2:5], axis=0) < PLANAR).all():
            poses[:, 3:5] = attitudes[:, 3:5]
        return index, poses

    @property
    def frames_a_chunk(self) -> int:
        """Return how many frames are read at a time."""
        return max(1, CHUNK_BYTES // max(1, len(self.like.range_m) * len(self.like.bearing_rad) * 4))

    def digest(self) -> str:
        """Return the SHA-256 of all data but the images, and of the first, the middle and the last image."""
        digest = hashlib.sha256(self.like.sonar.model_dump_json().encode())
        for values in (self.like.range_m, self.like.bearing_rad, self.time_s, self.poses, self.height_m):
            digest.update(b"-" if values is None else np.ascontiguousarray(values, dtype=float).tobytes())
        digest.update(b"" if self.attitude_rad is None else np.ascontiguousarray(self.attitude_rad, dtype=float).tobytes())
        digest.update(repr((self.pitch_rad, self.noise, self.seed, self.first_number)).encode())
        digest.update(b"" if self.altimeter is None else repr(self.altimeter).encode())
        digest.update(b"" if self.contrast is None else repr(self.contrast).encode())
        if len(self):
            some = np.unique(np.linspace(0, len(self) - 1, 3).astype(np.intp))
            digest.update(np.ascontiguousarray(self.read(some).image).tobytes())
        return digest.hexdigest()
