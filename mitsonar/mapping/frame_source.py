"""Sonar frames of one run, read some at a time: ``frames.npz``, ``frames.zarr`` of a long run, a sequence of a data set."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError, MitsonarWarning, nearest_names
from mitsonar.mapping.measured_heights import measured
from mitsonar.motion.trajectory import Trajectory
from mitsonar.motion.trajectory_errors import associated
from mitsonar.records.columns import check_column, open_group
from mitsonar.records.sonar_frames import COLUMNS, LABELS, PER_FRAME, SonarFrames

if TYPE_CHECKING:
    from mitsonar.datasets.store import DataStore
    from mitsonar.estimation.height.direct_height import HeightEstimator

__all__ = ["FrameSource", "is_data_set", "load_frames", "open_frames", "sequence_in"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

Pixels = NDArray[np.generic]
"""Images ``(n, bins, beams)``: uint8 in 0..255, or float32 in 0..1."""

StoredArray = Any
"""An array of Zarr, whichever form of its metadata; read by indices."""

CHUNK_BYTES = 8 * 2**20
"""Approximate size of the pixels that are read at a time [bytes]."""

PLANAR = 1e-6
"""Smallest change of height, pitch or roll along a path [m, rad]: files round them."""

FINDING = "give frames.npz, frames.zarr, the folder of a run, or a data set"


@dataclass(frozen=True)
class FrameSource:
    """The frames of one run; pixels are read on demand.

    Attributes:
        name: of the source, for messages.
        like: no frames, but all that is the same for each of them: sonar, bins, beams, level.
        time_s: of the frames ``(frames,)`` [s]; where each beam has its own, their mean.
        images: reads the frames of given numbers ``(n,)``: ``(n, bins, beams)``.
        poses: true poses of the sonar ``(frames, 6)`` [m, rad], where known.
        height_m: over the ground ``(frames,)``, where known; nan where nothing is below.
        pitch_rad: of the sonar, where its poses are not known.
        told_height_m: the height that the user gave for frames without one.
        noise: added to the frames that are read.
        seed: of the noise.
        first_number: number of the first frame, of which the noise is a function.
        note: which frames these are, where the name does not say it.
        altimeter: measures the height of each frame that is read, in place of ``height_m``.
    """

    name: str
    like: SonarFrames
    time_s: Array
    images: Callable[[Index], Pixels]
    poses: Array | None = None
    height_m: Array | None = None
    pitch_rad: float | None = None
    told_height_m: float | None = None
    noise: NoiseModel | None = None
    seed: int = 0
    first_number: int = 0
    note: str = ""
    altimeter: HeightEstimator | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time_s)

    @classmethod
    def of(cls, frames: SonarFrames, name: str = "the frames") -> Self:
        """Take frames that are in memory; labels are not kept."""
        nothing: dict[str, Any] = dict.fromkeys(LABELS)
        frames = replace(frames, **nothing)
        return cls._of(frames.select(slice(0)), frames.time_s, frames.poses, frames.height_m, frames.image.__getitem__, name)

    @classmethod
    def _of(
        cls,
        like: SonarFrames,
        time_s: Array,
        poses: Array | None,
        height_m: Array | None,
        images: Callable[[Index], Pixels],
        name: str,
        *,
        first_number: int = 0,
        note: str = "",
    ) -> Self:
        time = np.asarray(time_s, dtype=float)
        time = time.mean(axis=1) if time.ndim == 2 else time
        return cls(name, like, time, images, poses, height_m, first_number=first_number, note=note)

    def with_noise(self, noise: NoiseModel, seed: int = 0) -> Self:
        """Return the same frames with noise: a function of the seed and the number of each frame."""
        return self if noise.is_none else replace(self, noise=noise, seed=seed)

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

        Their poses have height, pitch and roll, but position and heading 0, so that no truth can leak.

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
            scale = np.float32(1 / 255 if image.dtype == np.uint8 else 1)
            image = self.noise.apply(
                image.astype(np.float32) * scale, seed=self.seed, frames=chosen.astype(np.int64) + self.first_number
            )
        frames = replace(
            self.like,
            image=image,
            time_s=self.time_s[chosen],
            poses=self._attitudes(chosen),
            height_m=None if self.height_m is None else self.height_m[chosen],
        )
        return frames if self.altimeter is None else measured(frames, self.altimeter)[0]

    def _attitudes(self, chosen: Index) -> Array | None:
        """Return poses without position and heading ``(n, 6)``; None where neither poses nor pitch are known."""
        if self.poses is not None:
            return self.poses[chosen] * [0, 0, 1, 1, 1, 0]
        return None if self.pitch_rad is None else np.tile([0.0, 0, 0, self.pitch_rad, 0, 0], (len(chosen), 1))

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
        attitudes = self._attitudes(index)
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
        digest.update(repr((self.pitch_rad, self.noise, self.seed, self.first_number)).encode())
        digest.update(b"" if self.altimeter is None else repr(self.altimeter).encode())
        if len(self):
            some = np.unique(np.linspace(0, len(self) - 1, 3).astype(np.intp))
            digest.update(np.ascontiguousarray(self.read(some).image).tobytes())
        return digest.hexdigest()


def open_frames(where: str | Path, *, sequence: int | None = None, view: str | None = None) -> FrameSource:
    """Open the frames at a path or URL.

    Args:
        where: ``frames.npz``, ``frames.zarr``, the folder of a run that holds either, or a data set.
        sequence: of a data set; default: the longest; of several, the first.
        view: of a data set; default: the first.

    Raises:
        MitsonarError: no frames there; a sequence or view that is not there.
    """
    path = Path(where)
    if is_data_set(where):
        return _of_data_set(str(where), sequence, view)
    if sequence is not None or view is not None:
        raise MitsonarError(f"{where} is no data set: sequence and view choose among those of a data set; leave them out")
    if path.is_dir() and not (path / "zarr.json").is_file():
        found = [path / name for name in ("frames.npz", "frames.zarr") if (path / name).exists()]
        if not found:
            raise MitsonarError(f"{path} holds no frames.npz or frames.zarr: {FINDING}")
        path = found[0]
    return _of_zarr(path, str(where)) if path.is_dir() else FrameSource.of(SonarFrames.load(path), str(where))


def load_frames(where: str | Path, *, sequence: int | None = None, view: str | None = None) -> SonarFrames:
    """Load all frames at a path or URL into memory; see :func:`open_frames`.

    Raises:
        MitsonarError: no frames there; a sequence or view that is not there.
    """
    source = open_frames(where, sequence=sequence, view=view)
    return source.read(np.arange(len(source)))


def is_data_set(where: str | Path) -> bool:
    """Return whether a data set is there. Every URL is one. Frames of a long run are Zarr too, with other attributes."""
    path = Path(where)
    if "://" in str(where):
        return True
    if not (path / "zarr.json").is_file():
        return False
    import zarr

    try:
        return bool(zarr.open_group(path, mode="r").attrs.get("kind") == "mitsonar data set")
    except Exception:  # a damaged Zarr may raise anything
        return False


def _of_zarr(path: Path, name: str) -> FrameSource:
    """Open the frames of a long run, also of one that is not finished."""
    try:
        found, done = open_group(path, COLUMNS, "time_s", "frames_done")
        arrays = {name: one for name, one in found.items() if not isinstance(one, np.ndarray)}
        arrays = {name: array for name, array in arrays.items() if name not in (*LABELS, "pitch_rad")}
        image = arrays["image"]
        table: dict[str, Any] = {
            name: array[:done] if name in PER_FRAME else array[...] for name, array in arrays.items() if name != "image"
        }
        table |= {name: value for name, value in found.items() if isinstance(value, np.ndarray)}
        nothing = np.zeros((0, *image.shape[1:]), dtype=image.dtype)
        none_of = {name: values[:0] for name, values in table.items() if name in PER_FRAME}
    except Exception as error:
        raise MitsonarError(f"cannot read frames {path}: {' '.join(str(error).split())[:160]}; {FINDING}") from None
    like = SonarFrames.from_arrays(table | none_of | {"image": nothing}, str(path))
    for known in ("poses", "height_m"):
        if known in table:
            check_column(table[known], known, COLUMNS[known], {"frames": done, "six": 6}, str(path))
    times = table["time_s"]
    if times.ndim == 1:
        check_column(times, "time_s", COLUMNS["time_s"], {"frames": done}, str(path))
    if done < image.shape[0]:
        message = f"{path} is not finished: {done:,} of {image.shape[0]:,} frames are there"
        warnings.warn(message, MitsonarWarning, stacklevel=3)
    poses, height = table.get("poses"), table.get("height_m")

    def images(index: Index) -> Pixels:
        picked = _picked(image, index)
        check_column(picked, "image", COLUMNS["image"], {}, str(path))
        return picked

    return FrameSource._of(like, table["time_s"], poses, height, images, name)


def _of_data_set(url: str, sequence: int | None, view: str | None) -> FrameSource:
    from mitsonar.config.data_recipe import array_names
    from mitsonar.datasets.store import DataStore  # its import takes half a second

    store = DataStore.open(url)
    stored = {name: array for array, (kind, name) in array_names(store.recipe).items() if kind == "image"}
    if not stored:
        raise MitsonarError(f"{url} holds vectors, no images: give a data set of images")
    views = {one.name: one for one in store.recipe.views}
    name = next(iter(stored)) if view is None else view
    if name not in stored:
        raise MitsonarError(f"{url} has no view {name!r}: {nearest_names(name, stored)}")
    here, number, which = sequence_in(store, sequence)
    image = store.array(stored[name])
    like = SonarFrames(
        image=np.zeros((0, *image.shape[1:]), dtype=image.dtype),
        range_m=views[name].sonar.range_m,
        bearing_rad=views[name].bearing_rad,
        time_s=np.zeros(0),
        sonar=views[name].sonar,
        level=views[name].sonar.value_coding,
        level_scale=float(store.about["level_scale"]),
    )
    return FrameSource._of(
        like,
        store.read("time_s", here),
        store.read("pose", here),
        store.read("height_m", here),
        lambda index: _picked(image, index + here.start),
        f"{url}, sequence {number}",
        first_number=here.start,
        note=which + (f", view {name}" if len(stored) > 1 else ""),
    )


def sequence_in(store: DataStore, sequence: int | None = None) -> tuple[slice, int, str]:
    """Return the frames of a sequence of a data set, its number, and a description. Default: the longest, or the first such.

    Raises:
        MitsonarError: no such sequence.
    """
    sequences = store.read("sequence")
    lengths = np.bincount(sequences)
    number = int(lengths.argmax()) if sequence is None else sequence
    if not (0 <= number < len(lengths) and lengths[number]):
        raise MitsonarError(f"{store.place.url} has no sequence {number}: it has {len(lengths):,}, numbered from 0")
    first = int(np.argmax(sequences == number))
    which = f"sequence {number} of {len(lengths):,}{', the longest' if sequence is None else ''}: {lengths[number]:,} frames"
    return slice(first, first + int(lengths[number])), number, which


def _picked(image: StoredArray, index: Index) -> Pixels:
    """Read frames of a Zarr array; those at equal steps at once."""
    if not len(index):
        return np.asarray(image[:0])
    steps = np.unique(np.diff(index))
    if len(steps) <= 1 and (not len(steps) or steps[0] > 0):
        return np.asarray(image[int(index[0]) : int(index[-1]) + 1 : int(steps[0]) if len(steps) else 1])
    return np.stack([np.asarray(image[int(one)]) for one in index])
