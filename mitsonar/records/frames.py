"""Store sonar images, simulated or real, in the common format of ``frames.npz`` that all later processing reads."""

from __future__ import annotations

import io
import json
import math
import os
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import IO, Any, Literal, Self, TypeAlias, cast

import numpy as np
import zarr
from numpy.typing import NDArray

from mitsonar.acoustics.levels import decoded
from mitsonar.errors import MitsonarError, short_repr
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import (
    FileArray,
    PlainValue,
    finite_number,
    missing_file,
    parse_json,
    read_json,
    read_npz,
    refuse_beyond_memory,
    whole_file,
    whole_number,
)

__all__ = [
    "ALWAYS_ACCEPTED_ROWS",
    "LABELS",
    "LEVELS",
    "MAX_NPZ_FRAMES",
    "Column",
    "FrameStore",
    "SonarFrames",
    "StoredArray",
    "ViewFrames",
    "arrays_in",
    "check_column",
    "frames_in",
    "max_plausible_rows",
    "number_of",
    "open_group",
    "table_in",
    "text_of",
    "to_float32",
    "to_uint8",
]


# ---------------- Pings in several views


@dataclass(frozen=True)
class ViewFrames:
    """Consecutive pings in several views, as images or as sums over the beams.

    Views are portions of the field of view of a downward-looking sonar.

    Attributes:
        kind: ``image``, or ``vector`` for sums over the beams.
        values: arrays by view; images are ``(n, bins, beams)`` uint8 or float in 0..1, vectors ``(n, bins)`` in units of the
            largest pixel value.
        sonars: the sonar of each view.
        bearing_rad: beam bearings of each view.
        time_s: times of the pings ``(n,)``.
        poses: poses of the sonar ``(n, 6)``, if known.
        height_m: heights over the ground ``(n,)``, if known.

    Raises:
        MitsonarError: inconsistent shapes.
    """

    kind: str
    values: dict[str, FileArray]
    sonars: dict[str, Sonar]
    bearing_rad: dict[str, NDArray[np.float64]]
    time_s: NDArray[np.float64]
    poses: NDArray[np.float64] | None = None
    height_m: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        for view, values in self.values.items():
            shape = (len(self.time_s), self.sonars[view].range_bins)
            expected_shape = shape if self.kind == "vector" else (*shape, len(self.bearing_rad[view]))
            if values.shape != expected_shape:
                raise MitsonarError(f"{self.kind}s of view {view} must have the shape {expected_shape}: got {values.shape}")

    def __len__(self) -> int:
        return len(self.time_s)

    def select(self, which: slice) -> Self:
        """Return a subset of the pings."""
        return replace(
            self,
            values={view: values[which] for view, values in self.values.items()},
            time_s=self.time_s[which],
            poses=None if self.poses is None else self.poses[which],
            height_m=None if self.height_m is None else self.height_m[which],
        )

    def profiles(self) -> NDArray[np.float32]:
        """Sum the images over the beams; return ``(views, n, bins)`` float32, in units of the largest pixel value."""
        scale = {np.dtype(np.uint8): np.float32(1 / 255)}
        scaled = [values * scale.get(values.dtype, np.float32(1)) for values in self.values.values()]
        return np.stack([array if self.kind == "vector" else array.sum(axis=-1) for array in scaled]).astype(np.float32)


# ---------------- Validation of stored arrays


StoredArray: TypeAlias = Any
"""An array of NumPy or Zarr, with ``dtype``, ``shape`` and ``ndim``."""

MAX_DIMENSIONS = 4
MAX_CHUNKS_PER_ROW = 64
"""Largest number of chunks per row of an array."""

MAX_ROWS_PER_BYTE = 200
"""Largest number of rows per byte of a compressed array, since times and poses differ from row to row."""

ALWAYS_ACCEPTED_ROWS = 100_000
"""Number of rows that is accepted whatever the file size."""


@dataclass(frozen=True)
class Column:
    """Required type, shape and values of an array.

    Attributes:
        dims: names of the dimensions; equal names have equal lengths throughout a file.
        kinds: NumPy type codes that are accepted: f float, u and i integers, c complex.
        low: smallest value.
        high: largest value.
        nan: whether the array may contain nan.
        order: order along the first dimension: ``strict`` is increasing, ``same`` is non-decreasing, ``any`` is unordered.
    """

    dims: tuple[str, ...]
    kinds: str = "f"
    low: float = -math.inf
    high: float = math.inf
    nan: bool = False
    order: Literal["strict", "same", "any"] = "any"


def check_column(values: StoredArray, name: str, column: Column, sizes: Mapping[str, int], source: str) -> None:
    """Check the type, shape and values of an array.

    Args:
        values: the array; for a Zarr array, only type and shape are checked.
        name: name of the array in error messages.
        column: the requirements.
        sizes: known lengths of dimensions.
        source: name of the file in error messages.

    Raises:
        MitsonarError: the array does not meet the requirements.
    """
    expected_shape = tuple(sizes.get(dim, length) for dim, length in zip(column.dims, values.shape, strict=False))
    if values.dtype.kind not in column.kinds or values.ndim != len(column.dims) or values.shape != expected_shape:
        shape = ", ".join(f"{dim} {sizes[dim]:,}" if dim in sizes else dim for dim in column.dims)
        kinds = " or ".join({"f": "float", "i": "int", "u": "uint", "c": "complex"}[kind] for kind in column.kinds)
        raise MitsonarError(
            f"{source}: {name} must be {kinds} of the shape ({shape}): got {str(values.dtype)[:20]} {str(values.shape)[:60]}"
        )
    if isinstance(values, np.ndarray) and values.size:
        _check_column_values(values, name, column, source)


def _check_column_values(values: FileArray, name: str, column: Column, source: str) -> None:
    if values.dtype.kind in "fc" and not np.isfinite(values).all():
        if not column.nan or np.isinf(values).any():
            raise MitsonarError(f"{source}: {name} holds nan or inf; the file is damaged, or was written by something else")
        if np.isnan(values).all():
            return
    if values.dtype.kind != "c":
        low, high = np.nanmin(values), np.nanmax(values)
        if low < column.low or high > column.high:
            raise MitsonarError(f"{source}: {name} must lie in {column.low:g}..{column.high:g}: got {low:.6g}..{high:.6g}")
    if column.order != "any" and len(values) > 1:
        steps = np.diff(values, axis=0)
        if (steps < 0).any() or (column.order == "strict" and not (steps > 0).all()):
            requirement = "increase" if column.order == "strict" else "not decrease"
            raise MitsonarError(f"{source}: {name} must {requirement} from row to row")


def text_of(table: Mapping[str, StoredArray], name: str, default: str | None = None) -> str:
    """Return a string stored in a table of arrays.

    Raises:
        MitsonarError: the entry is not a single string.
    """
    value = np.asarray(table[name]) if name in table else np.asarray(default)
    if value.ndim or value.dtype.kind != "U":
        raise MitsonarError(f"{name} must be a single string: got {str(value.dtype)[:20]} {str(value.shape)[:40]}")
    return str(value)


def number_of(table: Mapping[str, StoredArray], name: str, default: float) -> float:
    """Return a finite positive number stored in a table of arrays.

    Raises:
        MitsonarError: the entry is not such a number.
    """
    value = np.asarray(table.get(name, default))
    single = value.ndim == 0 and value.dtype.kind in "fiu"
    return finite_number(float(value) if single else str(value), name, above=0)


def table_in(table: Mapping[str, StoredArray], name: str, source: str, default: str | None = None) -> dict[str, PlainValue]:
    """Parse a JSON object stored as a string in a table of arrays.

    Raises:
        MitsonarError: the string is not a JSON object.
    """
    try:
        value = parse_json(text_of(table, name, default), f"the field {name}")
    except MitsonarError as error:
        raise MitsonarError(f"{source}: the field {name} is not JSON ({error}); the file is damaged") from None
    if not isinstance(value, dict):
        raise MitsonarError(f"{source}: the field {name} is not a JSON object; the file is damaged")
    return value


# ---------------- Reading Zarr groups


def open_group(
    path: Path, columns: Mapping[str, Column], rows: str, done: str | None = None
) -> tuple[dict[str, StoredArray], int]:
    """Open the arrays and attributes of a Zarr group without reading the values.

    The types, shapes and chunks of all arrays are checked against each other and against the stored bytes of the array
    ``rows``.

    Args:
        path: path of the group.
        columns: requirements on its arrays; further arrays are allowed.
        rows: name of an array with one entry per row.
        done: name of the attribute that counts the rows written, if there is one.

    Returns:
        Zarr arrays and attributes (as NumPy arrays) by name, and the number of rows written.

    Raises:
        Exception: a damaged group raises many types of errors, which the caller turns into a message.
    """
    group, arrays = arrays_in(path, "r")
    if rows not in arrays or arrays[rows].ndim not in (1, 2) or arrays[rows].dtype.kind != "f":
        raise ValueError(f"it lacks {rows}, with a number per row")
    count = int(arrays[rows].shape[0])
    stored_bytes = sum(
        file.stat().st_size for file in (path / rows).rglob("*") if file.is_file() and file.name != "zarr.json"
    )
    if count > max_plausible_rows(stored_bytes):
        raise ValueError(f"{count:,} rows are more than the {stored_bytes:,} bytes of {rows} can hold")
    for name, array in arrays.items():
        _check_chunks(name, array)
        if name in columns and name != rows:
            check_column(array, name, columns[name], {columns[rows].dims[0]: count}, "it")
    attributes = dict(group.attrs)
    written = count if done is None else attributes.pop(done, count)
    written = whole_number(written, str(done), 0, count)
    return {**arrays, **{name: np.array(value) for name, value in attributes.items()}}, written


def arrays_in(path: Path, mode: Literal["r", "r+"]) -> tuple[zarr.Group, dict[str, StoredArray]]:
    """Open a Zarr group and its arrays by name, after checking their metadata.

    Arrays are opened one at a time. When several are opened together, Zarr prints the errors of all of them.

    Raises:
        Exception: a damaged group raises many types of errors, which the caller turns into a message.
    """
    import zarr

    from mitsonar.io.storage import refuse_codecs

    names = sorted(file.parent.name for file in path.glob("*/zarr.json"))
    for name in ("", *names):
        metadata = read_json(path / name / "zarr.json")
        for length in metadata["shape"] if name else ():
            whole_number(length, f"a length of {name}")
    group = zarr.open_group(path, mode=mode, zarr_format=3)
    arrays = {name: group[name] for name in names}
    if not all(isinstance(array, zarr.Array) for array in arrays.values()):
        raise ValueError("it holds groups where arrays should be")
    for array in arrays.values():
        refuse_codecs(cast("zarr.Array[Any]", array))
    return group, arrays


def max_plausible_rows(stored: int) -> int:
    """Return the largest plausible number of rows in ``stored`` compressed bytes."""
    return max(ALWAYS_ACCEPTED_ROWS, MAX_ROWS_PER_BYTE * stored)


def _check_chunks(name: str, array: StoredArray) -> None:
    """Check that an array can be read in finite time and memory."""
    if array.ndim > MAX_DIMENSIONS or array.dtype.kind not in "biufc":
        raise ValueError(f"{name} holds no numbers, or has more than {MAX_DIMENSIONS} dimensions")
    if any(chunk < 1 for chunk in array.chunks):
        raise ValueError(f"{name} has empty chunks")
    chunks = math.prod(-(-length // chunk) for length, chunk in zip(array.shape, array.chunks, strict=True))
    if chunks > MAX_CHUNKS_PER_ROW * max(1, array.shape[0] if array.ndim else 1):
        raise ValueError(f"{name} has {chunks:,} chunks, too many")
    refuse_beyond_memory(math.prod(array.chunks) * array.dtype.itemsize, name)


# ---------------- Sonar frames


LEVELS = ("linear", "dB", "gamma", "contrast")
"""How image values encode levels; ``contrast`` is that of :class:`~mitsonar.acoustics.levels.LocalContrast`."""

FLOOR_DB = -100.0
"""Lowest level relative to full scale [dB], which replaces the level of zeros."""

LABELS = {"elevation_rad": np.float32, "shape_id": np.int32, "object_id": np.int32, "shadow": np.uint8}
"""Types of the per-pixel labels by name; pixels without an echo hold nan or -1. See :class:`SonarFrames` for ``shadow``."""

BODIES = ("body_poses", "body_velocities")

PER_FRAME = ("image", "time_s", "poses", "beam_poses", *BODIES, "attitude_rad", "attitude_std", "height_m", *LABELS)

IMAGE = ("frames", "bins", "beams")

COLUMNS = {
    "image": Column(IMAGE, "fu", low=0, high=255),
    "range_m": Column(("bins",), low=0, high=1e6, order="strict"),
    "bearing_rad": Column(("beams",), low=-math.pi, high=math.pi, order="strict"),
    "time_s": Column(("frames",), order="same"),
    "poses": Column(("frames", "six"), low=-1e9, high=1e9),
    "beam_poses": Column(("frames", "beams", "six"), low=-1e9, high=1e9),
    "body_poses": Column(("frames", "bodies", "six"), low=-1e9, high=1e9),
    "body_velocities": Column(("frames", "bodies", "six"), low=-1e9, high=1e9),
    "attitude_rad": Column(("frames", "three"), low=-7, high=7, nan=True),
    "height_m": Column(("frames",), low=0, nan=True),
    "elevation_rad": Column(IMAGE, low=-math.pi, high=math.pi, nan=True),
    "shape_id": Column(IMAGE, "i", low=-1),
    "object_id": Column(IMAGE, "i"),
    "shadow": Column(IMAGE, "u", low=0, high=2),
}
"""Requirements on the arrays of a file."""


@dataclass
class SonarFrames:
    """Frames of one sonar, with optional poses and per-pixel labels.

    Attributes:
        image: ``(frames, bins, beams)`` float32 in 0..1 (or uint8 in 0..255); row 0 is the nearest, column 0 the farthest to
            port; zero means no echo.
        range_m: centres of the bins ``(bins,)`` [m].
        bearing_rad: axes of the beams ``(beams,)`` [rad], starboard positive, not necessarily evenly spaced.
        time_s: time of each frame ``(frames,)``, or of each beam ``(frames, beams)`` [s].
        poses: x, y, z [m], pitch, roll, heading [rad] of the sonar ``(frames, 6)``, if known.
        beam_poses: poses of the sonar at the time of each beam ``(frames, beams, 6)``, if beams ping one after another.
        body_poses: poses of the moving bodies of the scene ``(frames, bodies, 6)`` [m, rad], in the order of ``body_names``.
        body_velocities: their velocities in world axes ``(frames, bodies, 6)``: of the origin [m/s], and angular [rad/s].
        body_names: names of the moving bodies.
        height_m: height over the ground vertically below ``(frames,)``; nan where there is no ground below.
        level: how image values encode levels: ``linear`` (level = value * level_scale), ``dB``, ``gamma`` or ``contrast``.
        level_scale: factor that undoes the constant gain.
        sonar: the instrument.
        elevation_rad: elevation of the strongest echo of each pixel, like ``image``, float32.
        shape_id: shape that returned this echo (its index in the scene), int32.
        object_id: object that returned this echo, as numbered by its mesh (attribute ``face_id``; 0 without it), int32.
        shape_names: name of each shape, indexed by ``shape_id``; empty if not known.
        object_names: name of each object, indexed by ``object_id``: its shape and its number, such as ``cubes 12``; empty if
            not known.
        shadow: 0 not in shadow; 1 no echo here, but nearer echoes and sound or echoes beyond; 2 no echo here and all sound
            of the beam was intercepted at shorter range (an object's shadow that extends to the end, or past the lit floor).
        attitude_rad: pitch, roll, heading [rad] from the sonar's own sensors ``(frames, 3)``; nan where unknown.
        about: further metadata that can be stored as JSON.
        attitude_std: standard deviations of the height [m], pitch and roll [rad] in ``poses`` by a vehicle's sensors
            ``(frames, 3)``; not stored.
    """

    image: NDArray[Any]
    range_m: NDArray[np.float64]
    bearing_rad: NDArray[np.float64]
    time_s: NDArray[np.float64]
    sonar: Sonar
    poses: NDArray[np.float64] | None = None
    height_m: NDArray[np.float64] | None = None
    level: str = "linear"
    level_scale: float = 1.0
    elevation_rad: NDArray[np.float32] | None = None
    shape_id: NDArray[np.int32] | None = None
    object_id: NDArray[np.int32] | None = None
    shadow: NDArray[np.uint8] | None = None
    shape_names: tuple[str, ...] = ()
    object_names: tuple[str, ...] = ()
    attitude_rad: NDArray[np.float64] | None = None
    beam_poses: NDArray[np.float64] | None = None
    body_poses: NDArray[np.float64] | None = None
    body_velocities: NDArray[np.float64] | None = None
    body_names: tuple[str, ...] = ()
    about: dict[str, Any] = field(default_factory=dict)
    attitude_std: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        frames, bins, beams = self.image.shape if self.image.ndim == 3 else (0, 0, 0)
        if (bins, beams) != (len(self.range_m), len(self.bearing_rad)) or len(self.time_s) != frames:
            raise MitsonarError(
                f"image must be (frames, bins, beams) = ({len(self.time_s)}, {len(self.range_m)}, "
                f"{len(self.bearing_rad)}) after time_s, range_m and bearing_rad: got {self.image.shape}"
            )
        if self.image.dtype.kind == "u" and self.image.dtype != np.uint8:
            raise MitsonarError(
                f"image must be uint8 in 0..255, or floats in 0..1: got {self.image.dtype}; divide it by its largest value"
            )
        if self.level not in LEVELS:
            raise MitsonarError(f"level must be one of {', '.join(LEVELS)}: got {short_repr(self.level)}")
        for name in PER_FRAME:
            values = getattr(self, name)
            if values is not None and len(values) != frames:
                raise MitsonarError(f"{name} must hold {frames} frames: got {len(values)}")

    def __len__(self) -> int:
        return len(self.image)

    def __repr__(self) -> str:
        known = [name for name in ("poses", "height_m", *LABELS) if getattr(self, name) is not None]
        near, far = (self.range_m[0], self.range_m[-1]) if len(self.range_m) else (0.0, 0.0)
        return (
            f"SonarFrames({len(self)} frames of {len(self.range_m)} bins x {len(self.bearing_rad)} beams, "
            f"{near:.4g}..{far:.4g} m, {self.image.dtype}, level {self.level}, sonar {self.sonar.name}; "
            f"{', '.join(known) or 'no poses'})"
        )

    @property
    def pitch_rad(self) -> NDArray[np.float64] | None:
        """Return the pitch of each frame ``(frames,)`` [rad]; None if poses are not known."""
        return None if self.poses is None else self.poses[:, 3]

    def decibels_of(self, value: float) -> float:
        """Return the level that an image value in 0..1 represents [dB re 1 uPa], including the gain of the sonar.

        The level is relative to the source if the sonar has no ``source_level_db``. A value of 0 in a linear image gives
        -inf.
        """
        with np.errstate(divide="ignore"):
            level = 10 * np.log10(decoded(value, self.sonar, self.level) * self.level_scale)
        return float(level) + self.sonar.source_level_db

    def to_linear(self) -> SonarFrames:
        """Return the frames with linear images: levels relative to full scale, float32 in 0..1.

        The codings ``dB`` and ``gamma`` are inverted with the parameters of the sonar. In the dB coding, a value of 0
        becomes the lowest level of the coding.

        Raises:
            MitsonarError: contrast images, whose levels cannot be recovered.
        """
        return replace(self, image=self.linear_values(), level="linear")

    def linear_values(self) -> NDArray[np.float32]:
        """Return the levels of the images relative to full scale, float32, like ``image``.

        Raises:
            MitsonarError: contrast images, whose levels cannot be recovered.
        """
        if self.level == "contrast":
            raise MitsonarError("contrast images hold no levels: use the frames from before the conversion to contrast")
        values = to_float32(self.image)
        if self.level == "linear":
            return values
        return np.asarray(decoded(np.clip(values, 0, 1), self.sonar, self.level), dtype=np.float32)

    def in_decibels(self) -> NDArray[np.float32]:
        """Return levels relative to full scale, like ``image`` [dB], not below -100 dB.

        Raises:
            MitsonarError: as for :meth:`linear_values`.
        """
        level = np.maximum(self.linear_values(), np.float32(10 ** (FLOOR_DB / 10)))
        return np.asarray(10 * np.log10(level), dtype=np.float32)

    def matching_values(self) -> NDArray[np.float32]:
        """Return the images as float32 in 0..1 for matching by estimators and mosaics, like ``image``.

        Linear and contrast images are unchanged. For the codings ``dB`` and ``gamma``, the square root of the amplitude is
        returned. Among level, amplitude, its square root and dB, it gave the smallest errors on speckle with all estimators.
        """
        if self.level == "contrast":
            return to_float32(self.image)
        return self.linear_values() if self.level == "linear" else self.linear_values() ** np.float32(0.25)

    def select(self, index: slice | NDArray[Any]) -> SonarFrames:
        """Return a subset of the frames."""
        selected = {name: getattr(self, name)[index] for name in PER_FRAME if getattr(self, name) is not None}
        unchanged = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in selected}
        return SonarFrames(**selected, **unchanged)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of ``frames.npz`` by name; ``sonar``, ``about`` and ``names`` are JSON strings."""
        table = {
            "image": self.image,
            "range_m": self.range_m,
            "bearing_rad": self.bearing_rad,
            "time_s": self.time_s,
            "level": np.array(self.level),
            "level_scale": np.array(self.level_scale),
            "sonar": np.array(self.sonar.model_dump_json()),
            "about": np.array(json.dumps(self.about)),
        }
        optional = ("poses", "beam_poses", *BODIES, "attitude_rad", "height_m", *LABELS)
        table |= {name: getattr(self, name) for name in optional if getattr(self, name) is not None}
        names = {"shapes": self.shape_names, "objects": self.object_names}
        names |= {"bodies": self.body_names} if self.body_names else {}
        if any(names.values()):
            table["names"] = np.array(json.dumps(names))
        return table | ({} if self.poses is None else {"pitch_rad": self.poses[:, 3]})

    @classmethod
    def from_arrays(cls, table: dict[str, NDArray[Any]], source: str = "frames") -> SonarFrames:
        """Create frames from the arrays that :meth:`arrays` returns.

        Args:
            table: arrays by name.
            source: name of the file in error messages.

        Raises:
            MitsonarError: missing arrays, or arrays that are not valid.
        """
        needed = ("image", "range_m", "bearing_rad", "time_s", "sonar")
        missing = [name for name in needed if name not in table]
        if missing:
            raise MitsonarError(f"{source} lacks {', '.join(missing)}: it is not a frames file of mitsonar")
        sonar = Sonar.create(**table_in(table, "sonar", source))
        about = table_in(table, "about", source, "{}")
        names = table_in(table, "names", source, "{}")
        try:
            level, scale = text_of(table, "level", "linear"), number_of(table, "level_scale", 1.0)
        except MitsonarError as error:
            raise MitsonarError(f"{source}: {error}") from None
        values = {name: table[name] for name in COLUMNS if name in table}
        _check_values(values, source)
        shapes, objects, bodies = (_texts(names, key, source) for key in ("shapes", "objects", "bodies"))
        return cls(
            **values,
            sonar=sonar,
            level=level,
            level_scale=scale,
            about=about,
            shape_names=shapes,
            object_names=objects,
            body_names=bodies,
        )

    def save(self, path: str | Path) -> None:
        """Write ``frames.npz``; the file is complete, or what was there before. Names without a suffix get ``.npz``."""
        path, table = Path(path), dict[str, Any](self.arrays())
        with whole_file(path if path.suffix == ".npz" else path.with_name(f"{path.name}.npz")) as file:
            np.savez_compressed(file, **table)

    @classmethod
    def load(cls, path: str | Path) -> SonarFrames:
        """Read ``frames.npz``, the ``frames.zarr`` of a long run, or the folder of a run that contains either.

        Raises:
            MitsonarError: no such file, or a file that does not hold frames.
        """
        path = Path(path)
        if os.path.isdir(path) and path.suffix != ".zarr":
            stored = frames_in(path)
            if stored is None:
                raise MitsonarError(f"{path} holds no frames.npz or frames.zarr: give the folder of a finished run")
            path = stored
        if not os.path.exists(path):
            raise missing_file(path, "give frames.npz or a run's folder")
        try:
            if os.path.isdir(path):
                table, done = open_group(path, COLUMNS, "time_s", "frames_done")
                refuse_beyond_memory(sum(getattr(values, "nbytes", 0) for values in table.values()), str(path))
                arrays = {name: values for name, values in table.items() if not isinstance(values, np.ndarray)}
                table |= {name: array[:done] if name in PER_FRAME else array[...] for name, array in arrays.items()}
            else:
                table = read_npz(path)
        except Exception as error:  # a damaged zip or Zarr may raise any error
            reason = " ".join(str(error).split())[:300] or type(error).__name__
            raise MitsonarError(f"cannot read frames {path}: {reason}; give frames.npz or a run's folder") from None
        return cls.from_arrays(table, str(path))


def _texts(names: dict[str, Any], key: str, source: str) -> tuple[str, ...]:
    """Return a list of strings from the field ``names``.

    Raises:
        MitsonarError: the entry is not a list of strings.
    """
    texts = names.get(key, [])
    if not (isinstance(texts, list) and all(isinstance(text, str) for text in texts)):
        raise MitsonarError(f"{source}: {key} of the field names must be a list of strings; the file is damaged")
    return tuple(texts)


def _check_values(values: dict[str, NDArray[Any]], source: str) -> None:
    """Check the arrays of frames for valid values and consistent shapes.

    Raises:
        MitsonarError: types, shapes or values that are not valid.
    """
    sizes: dict[str, int] = {}
    # The axes define the lengths that all other arrays must match.
    for name in ("range_m", "bearing_rad"):
        check_column(values[name], name, COLUMNS[name], sizes, source)
        sizes[COLUMNS[name].dims[0]] = len(values[name])
    # Times are per frame or per beam.
    time = values["time_s"]
    column = COLUMNS["time_s"] if time.ndim != 2 else replace(COLUMNS["time_s"], dims=("frames", "beams"))
    check_column(time, "time_s", column, sizes, source)
    sizes["frames"] = len(time)
    sizes |= {"six": 6, "three": 3}
    for name in [name for name in values if name not in ("range_m", "bearing_rad", "time_s")]:
        check_column(values[name], name, COLUMNS[name], sizes, source)
    image = values["image"]
    if image.dtype.kind == "f" and image.size and image.max() > 1 + 1e-5:
        raise MitsonarError(f"{source}: image must lie in 0..1, or be uint8: got up to {image.max():.6g}")


def to_float32(image: NDArray[Any]) -> NDArray[np.float32]:
    """Convert an image from uint8 in 0..255, or from 0..1, to float32 in 0..1; always returns a copy."""
    return np.asarray(image, dtype=np.float32) * np.float32(1 / 255 if image.dtype == np.uint8 else 1)


def to_uint8(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert an image from 0..1 to 0..255, mapping non-zero echoes to at least 1, since zero means no echo."""
    values = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    return np.where((image > 0) & (values == 0), np.uint8(1), values)


# ---------------- Incremental storage on disk


MAX_NPZ_FRAMES = 1000
"""Largest number of frames that a run packs into one ``frames.npz``. Longer runs remain as ``frames.zarr``."""


def frames_in(run: str | Path) -> Path | None:
    """Return the file or group in the folder of a run that holds its frames; None if there is neither."""
    paths = (Path(run) / name for name in ("frames.npz", "frames.zarr"))
    return next((path for path in paths if os.path.exists(path)), None)


class FrameStore:
    """The frames of a run on disk as ``frames.zarr`` (Zarr v3, one chunk per frame), written in constant memory.

    At the end of a short run, the store becomes ``frames.npz``. The group holds the arrays of ``frames.npz`` under the same
    names. ``sonar``, ``level``, ``level_scale``, ``about`` and ``names`` are attributes, as is ``frames_done``, the number
    of frames written.
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
            per_frame = name in PER_FRAME or name == "pitch_rad"
            shape = (frames, *values.shape[1:]) if per_frame else values.shape
            chunks = (1, *shape[1:]) if len(shape) == 3 else shape
            array = group.create_array(name, shape=shape, chunks=chunks, dtype=values.dtype, fill_value=0)
            if not per_frame:
                array[...] = values
        group.attrs["frames_done"] = 0
        return cls(group, path)

    @classmethod
    def open(cls, path: Path) -> FrameStore:
        """Open an existing store for writing, and remove files that an interrupted run left incomplete.

        Raises:
            MitsonarError: there is no store, or it is damaged.
        """
        try:
            store = cls(arrays_in(path, "r+")[0], path)
            store.frames, store.done  # noqa: B018
            for partial in path.rglob("*.partial"):  # Zarr writes to a temporary name, then renames the file
                partial.unlink()
        except Exception as error:  # a damaged Zarr raises many types of errors
            raise MitsonarError(f"cannot continue {path}: {error}; render again with --overwrite") from None
        return store

    def check(self, frames: int, sonar: Sonar, done: int) -> None:
        """Check that the store belongs to a run.

        Args:
            frames: number of frames of the whole run.
            sonar: the instrument of the run.
            done: number of frames written according to the run.

        Raises:
            MitsonarError: arrays are missing or have other shapes or chunks, or fewer frames are written.
        """
        cells = (sonar.range_bins, sonar.beams)
        sizes = {"frames": frames, "bins": cells[0], "beams": cells[1], "six": 6}
        try:
            whole_number(self.group.attrs["frames_done"], "frames_done")
            if not done <= self.done <= frames:
                raise ValueError(f"it holds {self.done:,} frames, run.json states {done:,} of {frames:,}")
            _, arrays = arrays_in(self.path, "r+")
            for name, array in arrays.items():
                if name in COLUMNS and not (name == "time_s" and array.shape == (frames, cells[1])):
                    check_column(array, name, COLUMNS[name], sizes, "it")
                expected_chunks = (1, *array.shape[1:]) if array.ndim == 3 else array.shape
                if array.chunks != expected_chunks:
                    raise ValueError(f"{name} has chunks of {array.chunks}, not {expected_chunks}")
            missing = {"image", "range_m", "bearing_rad", "time_s"} - set(arrays)
            if missing:
                raise ValueError(f"it lacks {', '.join(sorted(missing))}")
        except Exception as error:
            raise MitsonarError(f"cannot continue {self.path}: {error}; render again with --overwrite") from None

    @property
    def frames(self) -> int:
        """Return the number of frames of the whole run."""
        return int(self.group["image"].shape[0])  # type: ignore[union-attr]

    @property
    def done(self) -> int:
        """Return the number of frames written."""
        return int(self.group.attrs["frames_done"])  # type: ignore[arg-type]

    def write(self, first: int, frames: SonarFrames) -> None:
        """Write consecutive frames, which count as done once all of their arrays are on disk."""
        table = frames.arrays()
        for name in [*PER_FRAME, "pitch_rad"]:
            if name in table:
                self.group[name][first : first + len(frames)] = table[name]  # type: ignore[index]
        self.group.attrs["frames_done"] = first + len(frames)

    def pack(self, path: Path) -> None:
        """Convert a complete store to ``frames.npz`` frame by frame, and remove it. Equal frames give identical bytes."""
        part = path.with_name(f".{path.name}.part")
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1, allowZip64=True) as file:
            for name, array in sorted(self.group.arrays()):  # a folder listing has no fixed order
                with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    _write_npy(entry, array)
            for name, value in sorted(self.group.attrs.items()):
                if name != "frames_done":
                    buffer = io.BytesIO()
                    np.save(buffer, np.array(value))
                    with file.open(f"{name}.npy", "w") as entry:  # writestr would add the current time
                        entry.write(buffer.getvalue())
        part.replace(path)
        shutil.rmtree(self.path)


def _write_npy(entry: IO[bytes], array: StoredArray) -> None:
    """Write an array in the .npy format, one frame at a time."""
    header = {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.shape}
    np.lib.format.write_array_header_2_0(entry, header)
    for frame in _frames_of(array):
        entry.write(np.ascontiguousarray(frame).tobytes())


def _frames_of(array: StoredArray) -> Iterator[FileArray]:
    """Yield an array frame by frame, or as a whole if it has no frames."""
    if array.ndim < 3:
        yield np.asarray(array[...])
        return
    for index in range(array.shape[0]):
        yield np.asarray(array[index])
