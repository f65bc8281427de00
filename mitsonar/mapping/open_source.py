"""How the records of one run are opened for odometry and maps: as frames, views of a data set, or impulse responses.

:func:`open_source` opens what an estimator consumes, with the options of a :class:`Reading`.
"""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol, Self, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel, format_snr, load_noise, parse_snr
from mitsonar.datasets.responses import with_noise
from mitsonar.errors import MitsonarError, MitsonarWarning, suggest_names
from mitsonar.estimation.estimator import AnyEstimator
from mitsonar.estimation.named import height_estimator_from
from mitsonar.mapping.sources import FrameSource, is_recording, measured, open_frames, sequence_in
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames, ViewFrames
from mitsonar.records.responses import ImpulseResponses

if TYPE_CHECKING:
    from mitsonar.datasets.store import DataStore
    from mitsonar.estimation.height import HeightEstimator

__all__ = [
    "LOOP",
    "Reading",
    "ResponseSource",
    "Source",
    "ViewSource",
    "frames_for",
    "holds_responses",
    "open_responses",
    "open_source",
    "open_views",
    "record_at",
    "usual_loop",
    "views_for",
    "with_assumed_plane",
]


# ---------------- Views of a data set


@dataclass(frozen=True)
class ViewSource:
    """The pings of one sequence of a data set in several views, read a few at a time.

    Attributes:
        name: name of the source, for messages.
        store: store of the data set.
        views: names of the views to read, in this order.
        kind: ``image`` or ``vector``.
        first: number of the first frame of the sequence in the store.
        time_s: times of the pings ``(n,)`` [s].
        poses: true poses of the vehicle ``(n, 6)`` [m, rad], whose motion the networks of data sets estimate.
        sonar_poses: true poses of the sonar on the vehicle ``(n, 6)`` [m, rad].
        height_m: height over the ground ``(n,)`` [m].
        noise: noise added to the pings when they are read, as to samples of the data set.
        seed: seed of the noise.
        note: which sequence this is.
        altimeter: measures the height of each ping as it is read, in place of ``height_m``.
        contrast: always None: networks of data sets are trained on levels.
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
    given_height_m: float | None = None
    pitch_rad: float | None = None
    altimeter: HeightEstimator | None = None
    contrast: ClassVar[None] = None

    def __len__(self) -> int:
        """Return the number of pings."""
        return len(self.time_s)

    def with_noise(self, noise: NoiseModel, seed: int = 0) -> Self:
        """Return the same pings with noise, which is a function of the seed and the frame number."""
        return self if noise.is_none else replace(self, noise=noise, seed=seed)

    def with_heights_by(self, estimator: HeightEstimator) -> Self:
        """Return the same pings with heights that an estimator measures in its views as they are read.

        Raises:
            MitsonarError: the data set lacks these views.
        """
        if estimator.views is not None:
            _check_views(self.store, estimator.views, estimator.kind)
        return replace(self, altimeter=estimator)

    @property
    def true(self) -> Trajectory:
        """Return the true path of the vehicle."""
        return Trajectory(self.poses, self.time_s)

    def check_times(self) -> None:
        """Do nothing: the times of a sequence always increase."""

    def read(self, index: ArrayLike) -> ViewFrames:
        """Read the pings with these numbers ``(n,)``, with zero position and heading so that no ground truth can leak.

        Raises:
            MitsonarError: an array cannot be read.
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

        # one slice from the first to the last ping, from which the chosen ones are picked
        here = slice(self.first + int(chosen[0]), self.first + int(chosen[-1]) + 1)
        offsets = chosen - chosen[0]
        values, known = {}, {view.name: view for view in self.store.recipe.views}
        arrangement = arrangement_of(self.store.recipe, views=views, kind=kind, noise=self.noise or "none")
        for number, view in enumerate(views):
            frames = {
                (view if stored == kind else f"nonzero_{view}"): self.store.read(name, here)[offsets][None]
                for name, (stored, stored_view) in array_names(self.store.recipe).items()
                if stored_view == view and (stored == kind or (stored == "nonzero" and kind == "vector"))
            }
            # noise is a function of the frame number in the store, and of the seed, which differs between views
            numbers = (self.first + chosen.astype(np.int64))[None]
            values[view] = np.asarray(arrangement.noisy(frames, view, numbers, self.seed + number))[0]
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
        """Return the SHA-256 of all data except the views, of which the first and the last ping enter."""
        digest = hashlib.sha256(self.store.recipe.model_dump_json().encode())
        for values in (self.time_s, self.poses, self.sonar_poses, self.height_m):
            digest.update(np.ascontiguousarray(values, dtype=float).tobytes())
        digest.update(repr((self.views, self.kind, self.noise, self.seed, self.first, self.altimeter)).encode())
        for number in (0, len(self) - 1):
            digest.update(self.read([number]).profiles().tobytes())
        return digest.hexdigest()


def open_views(url: str, views: Sequence[str], kind: str, *, sequence: int | None = None) -> ViewSource:
    """Open views of a sequence of a data set, by default the longest sequence, the first if several are equally long.

    Raises:
        MitsonarError: there is no data set, or it lacks these views, this kind or this sequence.
    """
    from mitsonar.datasets.store import DataStore  # its import takes half a second

    store = DataStore.open(url)
    _check_views(store, views, kind)
    here, number, note = sequence_in(store, sequence)
    time_s, sonar_poses, height_m = (store.read(name, here) for name in ("time_s", "pose", "height_m"))
    poses = store.read("vehicle_pose", here) if "vehicle_pose" in store.group else sonar_poses
    name, which = f"{url}, sequence {number}", f"{note}, {kind}s of {', '.join(views)}"
    return ViewSource(name, store, tuple(views), kind, here.start, time_s, poses, sonar_poses, height_m, note=which)


def _check_views(store: DataStore, views: Sequence[str], kind: str) -> None:
    """Check that a data set holds these views.

    Raises:
        MitsonarError: a view is missing.
    """
    from mitsonar.config.data import array_names

    available = {view for kind_there, view in array_names(store.recipe).values() if kind_there == kind}
    missing = [view for view in views if view not in available]
    if missing:
        hint = suggest_names(missing[0], sorted(available)) if available else f"it holds no {kind}s"
        raise MitsonarError(f"{store.place.url} has no {kind}s of view {missing[0]!r}: {hint}")


# ---------------- Impulse responses


@dataclass(frozen=True)
class ResponseNoise:
    """White complex noise at a signal-to-noise ratio [dB]."""

    snr_db: float

    def model_dump(self) -> dict[str, str]:
        """Return the kind and ratio of the noise, for the record of a run."""
        return {"kind": "white", "snr": format_snr(self.snr_db)}


@dataclass(frozen=True)
class ResponseSource:
    """The impulse responses of one run; the counterpart of :class:`~mitsonar.mapping.sources.FrameSource`.

    Attributes:
        name: name of the source, for messages.
        responses: impulse responses of all pings.
        given_height_m: height that the user gave for responses without one [m].
        noise: noise added to the pings when they are read.
        seed: seed of the noise.
        note: always empty; data sets are read by their samples.
        contrast: always None for impulse responses.
    """

    name: str
    responses: ImpulseResponses
    given_height_m: float | None = None
    noise: ResponseNoise | None = None
    seed: int = 0
    note: str = ""
    pitch_rad: float | None = None
    contrast: ClassVar[None] = None

    def __len__(self) -> int:
        """Return the number of pings."""
        return len(self.responses)

    @property
    def time_s(self) -> NDArray[np.float64]:
        """Return the times of the pings ``(pings,)`` [s]."""
        return self.responses.time_s

    @property
    def poses(self) -> NDArray[np.float64] | None:
        """Return the true poses of the transmitter ``(pings, 6)`` [m, rad]; None if they are not known."""
        return self.responses.poses

    @property
    def height_m(self) -> NDArray[np.float64] | None:
        """Return the height over the ground ``(pings,)`` [m]; None if it is not known."""
        return self.responses.height_m

    @property
    def true(self) -> Trajectory | None:
        """Return the true path of the transmitter; None if it is not known."""
        return None if self.poses is None else Trajectory(self.poses, self.time_s)

    def with_noise(self, snr: str, seed: int = 0) -> Self:
        """Return the same pings with noise at a signal-to-noise ratio such as ``20 dB``.

        Raises:
            MitsonarError: ``snr`` is not a ratio.
        """
        ratio = parse_snr(snr)
        return replace(self, noise=None if ratio is None else ResponseNoise(ratio), seed=seed)

    def with_height(self, height_m: float | None) -> Self:
        """Return the same pings with a height [m] where they lack it.

        Raises:
            MitsonarError: the height is not above 0, or would not be used.
        """
        if height_m is None:
            return self
        if not 0 < height_m < np.inf:
            raise MitsonarError(f"the height must be above 0: got {height_m:g} m")
        known = self.responses.height_m
        if known is not None and np.isfinite(known).all():
            raise MitsonarError(f"{self.name} holds heights, so that {height_m:g} m would not be used: leave it out")
        responses = replace(self.responses, height_m=np.full(len(self), height_m))
        return replace(self, responses=responses, given_height_m=height_m)

    def check_times(self) -> None:
        """Check that the times of the pings increase.

        Raises:
            MitsonarError: the times do not increase, or are not finite.
        """
        if not (np.isfinite(self.time_s).all() and (np.diff(self.time_s) > 0).all()):
            raise MitsonarError(f"{self.name}: times of pings must be finite and increase; write the pings in order")

    def read(self, index: ArrayLike) -> ImpulseResponses:
        """Read the pings with these numbers ``(n,)`` as an estimator may see them.

        They have height and attitude, but neither position, heading nor velocity, so that no ground truth can leak.
        """
        chosen = np.asarray(index, dtype=np.intp)
        picked = self.responses.select(chosen)
        response = picked.response
        if self.noise is not None:
            response = with_noise(response, chosen, self.noise.snr_db, self.seed)
        poses = None if picked.poses is None else picked.poses * [0, 0, 1, 1, 1, 0]
        return replace(picked, response=response.astype(np.complex64), poses=poses, velocity=None)

    def digest(self) -> str:
        """Return the SHA-256 of the responses with their times, poses, heights and noise."""
        digest = hashlib.sha256(self.responses.sonar.model_dump_json().encode())
        for values in (self.responses.response, self.time_s, self.poses, self.height_m):
            digest.update(b"-" if values is None else np.ascontiguousarray(values).tobytes())
        digest.update(repr((self.noise, self.seed)).encode())
        return digest.hexdigest()


def holds_responses(where: str | Path) -> bool:
    """Return whether a path holds impulse responses: a folder of ``mitsonar impulse``, or its responses.npz or .zarr."""
    path = Path(where)
    if path.name.startswith("responses."):
        return os.path.exists(path)
    return os.path.isdir(path) and os.path.isfile(path / "responses.npz")


def open_responses(where: str | Path) -> ResponseSource:
    """Open the impulse responses at a path.

    Raises:
        MitsonarError: there are no responses, or the file is damaged.
    """
    return ResponseSource(str(where), ImpulseResponses.load(where))


# ---------------- Records for an estimator


Source = FrameSource | ResponseSource | ViewSource

Framed = TypeVar("Framed", FrameSource, ViewSource)


class ViewReader(Protocol):
    """An estimator that reads views of a data set, with their names and their kind, ``image`` or ``vector``."""

    @property
    def views(self) -> tuple[str, ...]: ...
    @property
    def kind(self) -> str: ...


FRAME_OPTIONS = ("sequence", "view", "height_by", "pitch_rad", "geometry", "contrast")
"""Options of :class:`Reading` that do not apply to impulse responses."""


CONTRASTS = ("levels", "local", "moving")

ASSUMED_HEIGHT = 0.15
"""Assumed height over the ground where it is unknown, as a fraction of the largest range of the window."""

NEAREST = 0.25
"""Smallest range at which the assumed ground must be visible, as a fraction of the largest: windows may begin at 0."""

LOOP = 8
"""Default number of motions over which loops of contrast frames are closed."""


@dataclass(frozen=True)
class Reading:
    """Options for reading records: which ones, with which noise, and the height and pitch for records that lack them.

    Attributes:
        sequence: number of the sequence of a data set; None: the longest.
        view: view of a data set; None: the first.
        noise: name of a noise model, or a signal-to-noise ratio for impulse responses.
        seed: seed of the noise.
        height_m: height over the ground [m], for records that lack it.
        pitch_rad: pitch of the sonar [rad], for frames that lack poses.
        height_by: height estimator that measures the height in each frame: ``direct`` or a checkpoint.
        geometry: file that describes the layout of the pictures of a recording.
        contrast: quantity to match: ``levels``; ``local`` contrast; or ``moving``, local contrast without the pattern that
            moves with the sonar. None: ``local`` for recordings without heights, ``levels`` for all others.
    """

    sequence: int | None = None
    view: str | None = None
    noise: str = "none"
    seed: int = 0
    height_m: float | None = None
    pitch_rad: float | None = None
    height_by: str | None = None
    geometry: Path | None = None
    contrast: str | None = None


def record_at(where: str | Path) -> type[SonarFrames] | type[ImpulseResponses]:
    """Return the class of the records at a path or URL."""
    return ImpulseResponses if holds_responses(where) else SonarFrames


def open_source(where: str, estimator: AnyEstimator, reading: Reading) -> Source:
    """Open the records of a run in the form that an estimator consumes.

    Args:
        where: path or URL of the records.
        estimator: estimator that will read them.
        reading: options for reading.

    Raises:
        MitsonarError: there are no records, the estimator does not consume them, or the options do not fit them.
    """
    available, consumed = record_at(where), estimator.consumes
    if available is ImpulseResponses:
        _check_consumed(where, available, consumed)
        return _responses_for(where, reading)
    if consumed is ViewFrames:
        return _with_heights(_views_of(where, cast(ViewReader, estimator), reading), reading)
    if reading.height_m is not None and reading.height_by is not None:
        raise MitsonarError("--height gives the height and --height-by measures it: give only one of them")
    source = frames_for(where, reading)
    _check_consumed(where, available, consumed)
    source = _with_heights(source, reading)
    bare = not _has_height(source) and is_recording(where)
    return _with_contrast(with_assumed_plane(source) if bare else source, reading, bare=bare)


def frames_for(where: str, reading: Reading) -> FrameSource:
    """Open sonar frames with the noise, height and pitch of ``reading``.

    Raises:
        MitsonarError: there are no frames, or the options do not fit them.
    """
    noise = load_noise(reading.noise)
    source = open_frames(where, sequence=reading.sequence, view=reading.view, geometry=reading.geometry)
    if not len(source):
        raise MitsonarError(f"{source.name} holds no frames: give those of a finished run")
    return source.with_noise(noise, reading.seed).with_geometry(reading.height_m, reading.pitch_rad)


def views_for(where: str, views: tuple[str, ...], kind: str, reading: Reading) -> ViewSource:
    """Open views of a data set, of kind ``image`` or ``vector``, with the noise of ``reading``.

    Raises:
        MitsonarError: there are no such views.
    """
    return open_views(where, views, kind, sequence=reading.sequence).with_noise(load_noise(reading.noise), reading.seed)


def usual_loop(source: Source) -> int:
    """Return the default number of motions per loop; 0 for none.

    Loops are closed by default only for frames of contrast. Short records have shorter loops.
    """
    half = (len(source) - 1) // 2
    return 0 if source.contrast is None or half < 2 else min(LOOP, half)


def _views_of(where: str, estimator: ViewReader, reading: Reading) -> ViewSource:
    """Open the views that a network was trained on."""
    if any(option is not None for option in (reading.view, reading.height_m, reading.pitch_rad, reading.geometry)):
        raise MitsonarError(
            "--view, --height, --pitch-deg and --geometry are not for a network that reads views of a data set"
        )
    return views_for(where, estimator.views, estimator.kind, reading)


def _responses_for(where: str, reading: Reading) -> ResponseSource:
    """Open impulse responses with the noise and height of ``reading``."""
    if any(getattr(reading, name) is not None for name in FRAME_OPTIONS):
        raise MitsonarError(
            "--sequence, --view, --height-by, --pitch-deg and --geometry belong to frames, not to impulse responses"
        )
    return open_responses(where).with_noise(reading.noise, reading.seed).with_height(reading.height_m)


def _has_height(source: FrameSource) -> bool:
    """Return whether frames have heights, given or measured; an altimeter may miss some, whose motions are bridged."""
    return source.altimeter is not None or (source.height_m is not None and bool(np.isfinite(source.height_m).any()))


def _with_contrast(source: FrameSource, reading: Reading, *, bare: bool) -> FrameSource:
    """Return the same frames as levels or as contrast.

    Raises:
        MitsonarError: the contrast is not one of :data:`CONTRASTS`.
    """
    contrast = reading.contrast or ("local" if bare else "levels")
    if contrast not in CONTRASTS:
        raise MitsonarError(f"unknown contrast {contrast!r}: {suggest_names(contrast, CONTRASTS)}")
    return source if contrast == "levels" else source.with_contrast(moving=contrast == "moving")


def with_assumed_plane(source: FrameSource) -> FrameSource:
    """Assume a height and a pitch, with a warning, for frames without a height; return other frames unchanged.

    The assumed ground plane is visible over the whole range window within the vertical opening of the beams. Motions hardly
    depend on it: they scale with the cosine of the grazing angle at which the sonar looks at the ground.
    """
    if _has_height(source):
        return source
    # the depression angles asin(height / range) at both ends must fit in the opening, which bounds the height
    far = float(source.like.range_m[-1])
    near = max(float(source.like.range_m[0]), NEAREST * far)
    opening = math.radians(source.like.sonar.elevation_fov_deg)
    height = min(ASSUMED_HEIGHT * far, opening * near * far / max(far - near, 1e-3 * far))
    pitch = (math.asin(height / near) + math.asin(height / far)) / 2
    warnings.warn(
        f"{source.name} has no height over the ground: {height:.3g} m and a pitch of {math.degrees(pitch):.1f} deg are "
        "assumed, so that the beams meet the ground over the whole window; give --height and --pitch-deg",
        MitsonarWarning,
        stacklevel=3,
    )
    known = source.pitch_rad if source.pitch_rad is not None else pitch
    return replace(source, height_m=np.full(len(source), height), assumed_height=True, pitch_rad=known)


def _with_heights(source: Framed, reading: Reading) -> Framed:
    """Return the same records, with measured heights if ``reading`` requests them."""
    return source if reading.height_by is None else source.with_heights_by(height_estimator_from(reading.height_by))


def _check_consumed(where: str, available: type, consumed: type) -> None:
    if consumed not in (available, object):
        raise MitsonarError(
            f"{where} holds {WORDS[available]}, and this estimator reads {WORDS[consumed]}: choose another estimator"
        )


WORDS: dict[type, str] = {SonarFrames: "sonar frames", ImpulseResponses: "impulse responses", ViewFrames: "views"}
