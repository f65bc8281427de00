"""Several views of a sequence of a data set, as images or vectors, read some pings at a time."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.mapping.measured_heights import measured
from mitsonar.mapping.open_frames import sequence_in
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import ViewFrames

if TYPE_CHECKING:
    from mitsonar.datasets.store import DataStore
    from mitsonar.estimation.height import HeightEstimator

__all__ = ["ViewSource", "open_views"]


@dataclass(frozen=True)
class ViewSource:
    """The pings of one sequence.

    Attributes:
        name: of the source, for messages.
        store: of the data set.
        views: that are read, in this order.
        kind: ``image`` or ``vector``.
        first: number of the first frame of the sequence in the store.
        time_s: of the pings ``(n,)`` [s].
        poses: true poses of the vehicle, whose motion networks of data sets estimate ``(n, 6)`` [m, rad].
        sonar_poses: of the sonar on it ``(n, 6)`` [m, rad].
        height_m: over the ground ``(n,)``.
        noise: added to the pings that are read, as to samples of the data set.
        seed: of the noise.
        note: which sequence this is.
        altimeter: measures the height of each ping that is read, in place of ``height_m``.
        contrast: none: networks of data sets are trained on levels.
    """

    name: str
    store: DataStore
    views: tuple[str, ...]
    kind: str
    first: int
    time_s: NDArray[np.float64]
    poses: NDArray[np.float64]
    sonar_poses: NDArray[np.float64]
    height_m: NDArray[np.float64]
    noise: NoiseModel | None = None
    seed: int = 0
    note: str = ""
    told_height_m: float | None = None
    pitch_rad: float | None = None
    altimeter: HeightEstimator | None = None
    contrast: ClassVar[None] = None

    def __len__(self) -> int:
        """Return the number of pings."""
        return len(self.time_s)

    def with_noise(self, noise: NoiseModel, seed: int = 0) -> Self:
        """Return the same pings with noise: a function of the seed and the number of each frame."""
        return self if noise.is_none else replace(self, noise=noise, seed=seed)

    def with_heights_by(self, estimator: HeightEstimator) -> Self:
        """Return the same pings, whose heights an estimator measures in its views when they are read.

        Raises:
            MitsonarError: the data set lacks these views.
        """
        if estimator.views is not None:
            _check_there(self.store, estimator.views, estimator.kind)
        return replace(self, altimeter=estimator)

    @property
    def true(self) -> Trajectory:
        """Return the true path of the vehicle."""
        return Trajectory(self.poses, self.time_s)

    def check_times(self) -> None:
        """Check nothing: the times of a sequence increase."""

    def read(self, index: ArrayLike) -> ViewFrames:
        """Read pings of these numbers ``(n,)`` with position and heading 0, so that no truth can leak.

        Raises:
            MitsonarError: arrays that cannot be read.
        """
        chosen = np.asarray(index, dtype=np.intp)
        frames = self._read(chosen, self.views, self.kind)
        if self.altimeter is None:
            return frames
        views, kind = self.altimeter.views or self.views, self.altimeter.kind if self.altimeter.views else self.kind
        same = (views, kind) == (self.views, self.kind)
        return measured(frames, self.altimeter, frames if same else self._read(chosen, views, kind))[0]

    def _read(self, chosen: NDArray[np.intp], views: tuple[str, ...], kind: str) -> ViewFrames:
        """Read pings as they are stored, with noise."""
        from mitsonar.config.data import array_names
        from mitsonar.datasets.arrangement import arrangement_of

        here = slice(self.first + int(chosen[0]), self.first + int(chosen[-1]) + 1)
        kept = chosen - chosen[0]
        values, known = {}, {view.name: view for view in self.store.recipe.views}
        made = arrangement_of(self.store.recipe, views=views, kind=kind, noise=self.noise or "none")
        for number, view in enumerate(views):
            frames = {
                (view if stored == kind else f"nonzero_{view}"): self.store.read(name, here)[kept][None]
                for name, (stored, of) in array_names(self.store.recipe).items()
                if of == view and (stored == kind or (stored == "nonzero" and kind == "vector"))
            }
            numbers = (self.first + chosen.astype(np.int64))[None]
            values[view] = np.asarray(made.noisy(frames, view, numbers, self.seed + number))[0]
        return ViewFrames(
            kind=kind,
            values=values,
            sonars={view: known[view].sonar for view in views},
            bearing_rad={view: known[view].bearing_rad for view in views},
            time_s=self.time_s[chosen],
            poses=self.sonar_poses[chosen] * [0, 0, 1, 1, 1, 0],
            height_m=self.height_m[chosen],
        )

    def digest(self) -> str:
        """Return the SHA-256 of all data but the views, and of the views of the first and the last ping."""
        digest = hashlib.sha256(self.store.recipe.model_dump_json().encode())
        for values in (self.time_s, self.poses, self.sonar_poses, self.height_m):
            digest.update(np.ascontiguousarray(values, dtype=float).tobytes())
        digest.update(repr((self.views, self.kind, self.noise, self.seed, self.first, self.altimeter)).encode())
        for number in (0, len(self) - 1):
            digest.update(self.read([number]).profiles().tobytes())
        return digest.hexdigest()


def open_views(url: str, views: Sequence[str], kind: str, *, sequence: int | None = None) -> ViewSource:
    """Open views of a sequence of a data set. Default: the longest sequence; of several, the first.

    Raises:
        MitsonarError: no data set, or one without such views, kind or sequence.
    """
    from mitsonar.datasets.store import DataStore  # its import takes half a second

    store = DataStore.open(url)
    _check_there(store, views, kind)
    here, number, note = sequence_in(store, sequence)
    time_s, sonar_poses, height_m = (store.read(name, here) for name in ("time_s", "pose", "height_m"))
    poses = store.read("vehicle_pose", here) if "vehicle_pose" in store.group else sonar_poses
    name, which = f"{url}, sequence {number}", f"{note}, {kind}s of {', '.join(views)}"
    return ViewSource(name, store, tuple(views), kind, here.start, time_s, poses, sonar_poses, height_m, note=which)


def _check_there(store: DataStore, views: Sequence[str], kind: str) -> None:
    """Check that a data set holds these views.

    Raises:
        MitsonarError: it does not.
    """
    from mitsonar.config.data import array_names

    there = {view for kind_there, view in array_names(store.recipe).values() if kind_there == kind}
    lacking = [view for view in views if view not in there]
    if lacking:
        had = nearest_names(lacking[0], sorted(there)) if there else f"it holds no {kind}s"
        raise MitsonarError(f"{store.place.url} has no {kind}s of view {lacking[0]!r}: {had}")
