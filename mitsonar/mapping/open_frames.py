"""Sonar frames at a path or URL: ``frames.npz``, ``frames.zarr`` of a long run, a sequence of a data set, a recording."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, MitsonarWarning, counted, nearest_names
from mitsonar.mapping.frame_source import FrameSource
from mitsonar.recordings.open import format_of, known_formats, open_recording
from mitsonar.recordings.recording import Pixels
from mitsonar.records.frames import COLUMNS, LABELS, PER_FRAME, SonarFrames, check_column, open_group

if TYPE_CHECKING:
    from mitsonar.datasets.store import DataStore

__all__ = ["StoredView", "is_data_set", "is_recording", "load_frames", "open_frames", "sequence_in", "view_in"]

Index = NDArray[np.intp]

StoredArray = Any
"""An array of Zarr, whichever form of its metadata; read by indices."""

FINDING = "give frames.npz, frames.zarr, the folder of a run, a data set or a recording"


def open_frames(
    where: str | Path, *, sequence: int | None = None, view: str | None = None, geometry: str | Path | None = None
) -> FrameSource:
    """Open the frames at a path or URL.

    Args:
        where: ``frames.npz``, ``frames.zarr``, the folder of a run that holds either, a data set, or a recording.
        sequence: of a data set, or part of a recording; default: the longest; of several, the first.
        view: of a data set, or topic of a ROS bag; default: the first, or the only one.
        geometry: file that tells how the pictures of a recording are laid out.

    Raises:
        MitsonarError: no frames there; a sequence or view that is not there; a geometry that is not needed.
    """
    path = Path(where)
    data_set = is_data_set(where)
    if not data_set and is_recording(where):
        return _of_recording(path, sequence, view, geometry)
    if geometry is not None:
        raise MitsonarError(f"{where} is no recording of pictures: it tells its geometry itself; leave {geometry} out")
    if data_set:
        return _of_data_set(str(where), sequence, view)
    if sequence is not None or view is not None:
        raise MitsonarError(f"{where} is no data set or recording: sequence and view choose among theirs; leave them out")
    if os.path.isdir(path) and not os.path.isfile(path / "zarr.json"):
        found = [path / name for name in ("frames.npz", "frames.zarr") if os.path.exists(path / name)]
        if not found:
            raise MitsonarError(f"{path} holds no frames.npz or frames.zarr: {FINDING}")
        path = found[0]
    return _of_zarr(path, str(where)) if os.path.isdir(path) else _of_npz(path, str(where))


def load_frames(
    where: str | Path, *, sequence: int | None = None, view: str | None = None, geometry: str | Path | None = None
) -> SonarFrames:
    """Load all frames at a path or URL into memory, with true poses where they are known.

    Labels are not loaded: :meth:`mitsonar.SonarFrames.load` loads those of a run.

    Args:
        where: ``frames.npz``, ``frames.zarr``, the folder of a run that holds either, a data set, or a recording.
        sequence: of a data set, or part of a recording; default: the longest; of several, the first.
        view: of a data set, or topic of a ROS bag; default: the first, or the only one.
        geometry: file that tells how the pictures of a recording are laid out.

    Raises:
        MitsonarError: no frames there; a sequence or view that is not there; a geometry that is not needed.
    """
    source = open_frames(where, sequence=sequence, view=view, geometry=geometry)
    return replace(source.read(np.arange(len(source))), poses=source.poses, attitude_rad=source.attitude_rad)


def is_data_set(where: str | Path) -> bool:
    """Return whether a data set is there. Every URL is one. Frames of a long run are Zarr too, with other attributes."""
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
    """Return whether a recording of a real sonar is there."""
    return "://" not in str(where) and format_of(where) is not None


def _of_recording(path: Path, number: int | None, view: str | None, geometry: str | Path | None) -> FrameSource:
    """Open a part of a recording."""
    recording = open_recording(path, geometry, view)
    for note in recording.notes:
        warnings.warn(f"{path}: {note}", MitsonarWarning, stacklevel=3)
    part, which = recording.part(number), ""
    if len(recording.parts) > 1:
        chosen = recording.longest if number is None else number
        longest = ", the longest" if number is None else ""
        which = f"part {chosen} of {len(recording.parts):,}{longest}: {counted(len(part), 'frame')}"
    return FrameSource.of_part(part, str(path), which)


def _of_npz(path: Path, name: str) -> FrameSource:
    """Take the frames of ``frames.npz``.

    Raises:
        MitsonarError: nothing there, a file of another kind, or a damaged one.
    """
    if not os.path.exists(path):
        raise MitsonarError(f"there are no frames at {path}: {FINDING}")
    if os.path.isfile(path) and os.access(path, os.R_OK) and not is_zipfile(path):
        empty = path.stat().st_size == 0
        reason = "it is empty" if empty else "it is neither a whole frames.npz nor a recording that mitsonar reads"
        raise MitsonarError(f"cannot read frames {path}: {reason}; {FINDING}: {known_formats()}")
    return FrameSource.of(SonarFrames.load(path), name)


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
    for known in ("poses", "attitude_rad", "height_m"):
        if known in table:
            check_column(table[known], known, COLUMNS[known], {"frames": done, "six": 6, "three": 3}, str(path))
    times = table["time_s"]
    if times.ndim == 1:
        check_column(times, "time_s", COLUMNS["time_s"], {"frames": done}, str(path))
    if done < image.shape[0]:
        message = f"{path} is not finished: {done:,} of {counted(image.shape[0], 'frame')} written"
        warnings.warn(message, MitsonarWarning, stacklevel=3)
    poses, attitude, height = table.get("poses"), table.get("attitude_rad"), table.get("height_m")

    def images(index: Index) -> Pixels:
        picked = _picked(image, index)
        check_column(picked, "image", COLUMNS["image"], {}, str(path))
        return picked

    return FrameSource.of_arrays(like, table["time_s"], poses, height, images, name, attitude_rad=attitude)


def _of_data_set(url: str, sequence: int | None, view: str | None) -> FrameSource:
    from mitsonar.datasets.store import DataStore  # its import takes half a second

    store = DataStore.open(url)
    chosen = view_in(store, view)
    here, number, which = sequence_in(store, sequence)
    image = store.array(chosen.array)
    return FrameSource.of_arrays(
        chosen.like,
        store.read("time_s", here),
        store.read("pose", here),
        store.read("height_m", here),
        lambda index: _picked(image, index + here.start),
        f"{url}, sequence {number}",
        first_number=here.start,
        note=which + (f", view {chosen.name}" if chosen.several else ""),
    )


class StoredView(NamedTuple):
    """A view of a data set: its name, its array of images, frames like them without images, and whether there are others."""

    name: str
    array: str
    like: SonarFrames
    several: bool


def view_in(store: DataStore, view: str | None = None) -> StoredView:
    """Return a view of a data set whose images are stored; default: the first.

    Raises:
        MitsonarError: no images, or no such view.
    """
    from mitsonar.config.data import array_names

    stored = {name: array for array, (kind, name) in array_names(store.recipe).items() if kind == "image"}
    if not stored:
        raise MitsonarError(f"{store.place.url} holds vectors, no images: give a data set of images")
    name = next(iter(stored)) if view is None else view
    if name not in stored:
        raise MitsonarError(f"{store.place.url} has no view {name!r}: {nearest_names(name, stored)}")
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
    longest = ", the longest" if sequence is None else ""
    which = f"sequence {number} of {len(lengths):,}{longest}: {counted(int(lengths[number]), 'frame')}"
    return slice(first, first + int(lengths[number])), number, which


def _picked(image: StoredArray, index: Index) -> Pixels:
    """Read frames of a Zarr array; those at equal steps at once."""
    if not len(index):
        return np.asarray(image[:0])
    steps = np.unique(np.diff(index))
    if len(steps) <= 1 and (not len(steps) or steps[0] > 0):
        return np.asarray(image[int(index[0]) : int(index[-1]) + 1 : int(steps[0]) if len(steps) else 1])
    return np.stack([np.asarray(image[int(one)]) for one in index])
