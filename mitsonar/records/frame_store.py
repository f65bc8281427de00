"""Frames on disk, written as they are made, in constant memory: a Zarr group, at the end of a short run ``frames.npz``."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
import zarr

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import FileArray, whole_number
from mitsonar.records.columns import StoredArray, arrays_in, check_column
from mitsonar.records.sonar_frames import COLUMNS, PER_FRAME, SonarFrames

__all__ = ["LONGEST_NPZ", "FrameStore"]

LONGEST_NPZ = 1000
"""Most frames of a run that ends as one ``frames.npz``. Longer runs keep ``frames.zarr``."""


class FrameStore:
    """The frames of one run, on disk as ``frames.zarr`` (Zarr v3, one chunk a frame).

    The group holds the arrays of ``frames.npz`` by the same names. ``sonar``, ``level``, ``level_scale``, ``about`` and
    ``names`` are attributes. So is ``frames_done``, the number of frames that are written.
    """

    def __init__(self, group: zarr.Group, path: Path) -> None:
        self.group, self.path = group, path

    @classmethod
    def create(cls, path: Path, frames: int, like: SonarFrames) -> FrameStore:
        """Create an empty store for ``frames`` frames with the arrays and attributes of ``like``."""
        group = zarr.open_group(path, mode="w", zarr_format=3)
        table = like.arrays()
        for name in ("level", "level_scale", "sonar", "about", "names"):
            if name in table:
                group.attrs[name] = table.pop(name).item()
        for name, values in table.items():
            each = name in PER_FRAME or name == "pitch_rad"
            shape = (frames, *values.shape[1:]) if each else values.shape
            chunks = (1, *shape[1:]) if len(shape) == 3 else shape
            array = group.create_array(name, shape=shape, chunks=chunks, dtype=values.dtype, fill_value=0)
            if not each:
                array[...] = values
        group.attrs["frames_done"] = 0
        return cls(group, path)

    @classmethod
    def open(cls, path: Path) -> FrameStore:
        """Open a store that was begun, and remove what a kill left half written.

        Raises:
            MitsonarError: there is none, or it is damaged.
        """
        try:
            store = cls(arrays_in(path, "r+")[0], path)
            store.frames, store.done  # noqa: B018
            for left in path.rglob("*.partial"):  # Zarr writes a file under such a name, then renames it
                left.unlink()
        except Exception as error:  # a damaged Zarr raises errors of many kinds
            raise MitsonarError(f"cannot go on with {path}: {error}; render again with --overwrite") from None
        return store

    def check(self, frames: int, sonar: Sonar, done: int) -> None:
        """Check that the store is that of a run.

        Args:
            frames: of the whole run.
            sonar: its instrument.
            done: frames that are written, according to the run.

        Raises:
            MitsonarError: arrays are missing, have other shapes or chunks, or fewer frames are written.
        """
        cells = (sonar.range_bins, sonar.beams)
        sizes = {"frames": frames, "bins": cells[0], "beams": cells[1], "six": 6}
        try:
            whole_number(self.group.attrs["frames_done"], "frames_done")
            if not done <= self.done <= frames:
                raise ValueError(f"it holds {self.done:,} frames, run.json says {done:,} of {frames:,}")
            _, arrays = arrays_in(self.path, "r+")
            for name, array in arrays.items():
                if name in COLUMNS and not (name == "time_s" and array.shape == (frames, cells[1])):
                    check_column(array, name, COLUMNS[name], sizes, "it")
                wanted = (1, *array.shape[1:]) if array.ndim == 3 else array.shape
                if array.chunks != wanted:
                    raise ValueError(f"{name} is cut into pieces of {array.chunks}, not {wanted}")
            lacking = {"image", "range_m", "bearing_rad", "time_s"} - set(arrays)
            if lacking:
                raise ValueError(f"it lacks {', '.join(sorted(lacking))}")
        except Exception as error:
            raise MitsonarError(f"cannot go on with {self.path}: {error}; render again with --overwrite") from None

    @property
    def frames(self) -> int:
        """Return the number of frames of the whole run."""
        return int(self.group["image"].shape[0])  # type: ignore[union-attr]

    @property
    def done(self) -> int:
        """Return the number of frames that are written."""
        return int(self.group.attrs["frames_done"])  # type: ignore[arg-type]

    def write(self, first: int, frames: SonarFrames) -> None:
        """Write consecutive frames. They count as done once all of them are on disk."""
        table = frames.arrays()
        for name in [*PER_FRAME, "pitch_rad"]:
            if name in table:
                self.group[name][first : first + len(frames)] = table[name]  # type: ignore[index]
        self.group.attrs["frames_done"] = first + len(frames)

    def pack(self, path: Path) -> None:
        """Turn a finished store into ``frames.npz``, frame by frame, and remove it. Equal frames become equal bytes."""
        part = path.with_name(f".{path.name}.part")
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1, allowZip64=True) as file:
            for name, array in sorted(self.group.arrays()):  # which lists a folder
                with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    _write_npy(entry, array)
            for name, value in sorted(self.group.attrs.items()):
                if name != "frames_done":
                    buffer = io.BytesIO()
                    np.save(buffer, np.array(value))
                    with file.open(f"{name}.npy", "w") as entry:  # writestr would add the time of the clock
                        entry.write(buffer.getvalue())
        part.replace(path)
        shutil.rmtree(self.path)


def _write_npy(entry: IO[bytes], array: StoredArray) -> None:
    """Write an array as .npy, one frame at a time."""
    header = {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.shape}
    np.lib.format.write_array_header_2_0(entry, header)
    for piece in _pieces(array):
        entry.write(np.ascontiguousarray(piece).tobytes())


def _pieces(array: StoredArray) -> Iterator[FileArray]:
    """Yield an array frame by frame, or whole where it has no frames."""
    if array.ndim < 3:
        yield np.asarray(array[...])
        return
    for index in range(array.shape[0]):
        yield np.asarray(array[index])
