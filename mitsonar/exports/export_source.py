"""Frames with labels of a run, a recording or a data set, read some at a time."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.config.data import Split
from mitsonar.datasets.store import PARTS, DataStore, deal, names_of_scenes, world_of
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.mapping.sources import is_data_set, open_frames, view_in
from mitsonar.records.frames import COLUMNS, LABELS, SonarFrames, open_group

__all__ = ["ExportSource", "open_export"]

AT_ONCE_BYTES = 2**24
"""Approximate size of the pixels and labels that are read at a time [bytes]."""

Read = Callable[[slice], SonarFrames]


@dataclass(frozen=True)
class ExportSource:
    """Frames to export; pixels and labels are read on demand.

    Attributes:
        name: of the source.
        frames: number of them.
        sequence: number of the sequence of each frame ``(frames,)``.
        like: no frames, but all that is the same for each of them: sonar, ranges, bearings, names of shapes and objects.
        labels: names of the labels that there are.
        posed: whether poses are known.
        part: of each frame, ``train``, ``validation`` or ``test`` ``(frames,)``, as the recipe splits; else ``train``.
        read: reads frames with labels.
        about: what made them, for metadata.
        raised_db: by which the noise of each frame is above that of the sonar ``(frames,)`` [dB].
    """

    name: str
    frames: int
    sequence: NDArray[np.int64]
    like: SonarFrames
    labels: tuple[str, ...]
    posed: bool
    part: NDArray[np.str_]
    read: Read
    about: str = ""
    raised_db: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not len(self.raised_db):
            object.__setattr__(self, "raised_db", np.zeros(self.frames))

    def pieces(self) -> Iterator[tuple[int, SonarFrames]]:
        """Yield the frames a few at a time, with the number of the first."""
        cells = max(1, self.like.image.shape[1] * self.like.image.shape[2])
        many = max(1, AT_ONCE_BYTES // (cells * (4 + 4 * len(self.labels))))
        for first in range(0, self.frames, many):
            yield first, self.read(slice(first, min(first + many, self.frames)))


def open_export(
    where: str | Path, *, view: str | None = None, split: tuple[float, float, float] | None = None
) -> ExportSource:
    """Open the frames at a path or URL for export: all sequences of a data set, a run, or a recording.

    Args:
        where: a data set, ``frames.npz``, ``frames.zarr``, the folder of a run, or a recording.
        view: of a data set; default: the first.
        split: shares of training, validation and test. Sequences or scenes of a data set are dealt out, as its recipe says;
            frames of a run or a recording are cut into three stretches of time. Default: the recipe's; of a run all frames
            are for training.

    Raises:
        MitsonarError: no frames there, shares that do not add up to 1, too few sequences or frames for them.
    """
    if split is not None and not (min(split) >= 0 and abs(sum(split) - 1) < 1e-6):
        raise MitsonarError(f"--split is three shares that add up to 1, 0.7,0.15,0.15 for example: got {split}")
    if is_data_set(where):
        return _of_data_set(str(where), view, split)
    source = _of_frames(where, view)
    return source if split is None else replace(source, part=_stretches(source.frames, split))


def _of_frames(where: str | Path, view: str | None) -> ExportSource:
    """Take the frames of a run or of a recording."""
    if view is not None:
        raise MitsonarError(f"{where} is no data set: --view chooses among the views of one; leave it out")
    path = Path(where)
    if os.path.isdir(path):
        found = [path / name for name in ("frames.npz", "frames.zarr") if os.path.exists(path / name)]
        path = found[0] if found else path
    if path.suffix == ".npz":
        return _in_memory(SonarFrames.load(path), str(where))
    source = open_frames(where)
    if not len(source):
        raise MitsonarError(f"{source.name} holds no frames: give those of a finished run")
    stored, like = _labels_of_zarr(path) if path.suffix == ".zarr" else ({}, {})

    def read(part: slice) -> SonarFrames:
        index = np.arange(part.start, part.stop)
        frames = source.read(index)
        labels: dict[str, Any] = {name: np.asarray(array[part]) for name, array in stored.items()}
        # estimators are not given these, and exports are
        poses, attitude = (None if values is None else values[part] for values in (source.poses, source.attitude_rad))
        return replace(frames, poses=poses, attitude_rad=attitude, **like, **labels)

    base = replace(source.like, **like)
    sequence, posed = np.zeros(len(source), np.int64), source.poses is not None
    return ExportSource(source.name, len(source), sequence, base, tuple(stored), posed, _all_train(len(source)), read)


def _in_memory(frames: SonarFrames, name: str) -> ExportSource:
    """Take frames that are in memory."""
    if not len(frames):
        raise MitsonarError(f"{name} holds no frames: give those of a finished run")
    labels = tuple(label for label in LABELS if getattr(frames, label) is not None)
    sequence, posed = np.zeros(len(frames), np.int64), frames.poses is not None
    like = frames.select(slice(0))
    return ExportSource(name, len(frames), sequence, like, labels, posed, _all_train(len(frames)), frames.select)


def _all_train(frames: int) -> NDArray[np.str_]:
    return np.full(frames, "train", dtype="<U10")


def _labels_of_zarr(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the label arrays of a long run, unread, and the names that they refer to."""
    found, _ = open_group(path, COLUMNS, "time_s", "frames_done")
    stored = {name: found[name] for name in LABELS if name in found}
    nothing = {name: array for name, array in found.items() if isinstance(array, np.ndarray)}
    for name in COLUMNS:
        if name in found:
            nothing[name] = found[name][:0] if name not in ("range_m", "bearing_rad") else found[name][...]
    like = SonarFrames.from_arrays(nothing, str(path))
    return stored, {"shape_names": like.shape_names, "object_names": like.object_names}


def _stretches(frames: int, split: tuple[float, float, float]) -> NDArray[np.str_]:
    """Cut frames into a stretch for each part, in the order of time.

    Raises:
        MitsonarError: fewer frames than parts.
    """
    wanted = [share > 0 for share in split]
    ends = np.rint(np.cumsum(split) * frames).astype(int)
    counts = np.maximum(np.diff(ends, prepend=0), wanted)
    counts[int(np.argmax(split))] -= counts.sum() - frames
    if (counts[wanted] < 1).any():
        raise MitsonarError(
            f"{frames} frames are too few for training, validation and test of {split}: give more, or another --split"
        )
    return np.repeat(np.array(PARTS, dtype="<U10"), counts)


def _of_data_set(url: str, view: str | None, split: tuple[float, float, float] | None) -> ExportSource:
    """Take all frames of one view of a data set.

    Raises:
        MitsonarError: too few sequences or scenes for a split that was given.
    """
    store = DataStore.open(url)
    chosen = view_in(store, view)
    labels = {label: f"{label}{store.recipe.suffix(chosen.name)}" for label in store.recipe.labels}
    scene = np.asarray(store.read("scene"))
    names, places = names_of_scenes(store) if "shape_id" in labels else ((), {})

    def read(part: slice) -> SonarFrames:
        told: dict[str, Any] = {label: store.read(array, part) for label, array in labels.items()}
        for number in np.unique(scene[part]) if places else ():
            own = scene[part] == number
            told["shape_id"][own] = places[int(number)][told["shape_id"][own]]
        return replace(
            chosen.like,
            image=store.read(chosen.array, part),
            time_s=store.read("time_s", part),
            poses=store.read("pose", part),
            height_m=store.read("height_m", part),
            shape_names=names,
            **told,
        )

    sequence = np.asarray(store.read("sequence"), dtype=np.int64)
    about = str(store.about["recipe"].get("about") or store.recipe.name)
    raised = store.recipe.noise_raised_db(scene)
    parts = _parts(store, split)
    return ExportSource(url, len(store), sequence, read(slice(0, 0)), tuple(labels), True, parts, read, about, raised)


def _parts(store: DataStore, shares: tuple[float, float, float] | None) -> NDArray[np.str_]:
    """Return the part of each frame by the recipe's split, or by shares; a split of samples does not divide frames.

    Raises:
        MitsonarError: too few sequences or worlds for shares that were given.
    """
    parts, split = _all_train(len(store)), store.recipe.split
    if shares is not None:
        by = "sequence" if split.by == "sample" else split.by
        split = Split(by=by, seed=split.seed, **dict(zip(PARTS, shares, strict=True)))
    if split.by == "sample":
        return parts
    sequence = np.asarray(store.read("sequence"), dtype=np.int32)
    world = world_of(store.recipe, store.scenes)[np.asarray(store.read("scene"))]
    try:
        for name in ("validation", "test"):
            if getattr(split, name) > 0:
                parts[deal(world, sequence, split, name)] = name
    except MitsonarError as error:  # too few sequences or worlds for its parts
        if shares is not None:
            raise
        warnings.warn(f"all frames are for training: {error}", MitsonarWarning, stacklevel=2)
        return _all_train(len(store))
    return parts
