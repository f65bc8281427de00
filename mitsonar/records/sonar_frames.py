"""Sonar images in the one form that everything downstream reads, simulated or real; ``frames.npz`` holds exactly it."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.levels import decoded
from mitsonar.errors import MitsonarError, shortened
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import read_npz, refuse_beyond_memory
from mitsonar.records.columns import Column, check_column, number_of, open_group, table_in, text_of

__all__ = ["LABELS", "LEVELS", "SonarFrames", "to_float32", "to_uint8"]

LEVELS = ("linear", "dB", "gamma", "contrast")
"""How image values stand for level; ``contrast`` is :class:`~mitsonar.acoustics.levels.LocalContrast`'s."""

FLOOR_DB = -100.0
"""Least level over full scale [dB]: an image has zeros."""

LABELS = {"elevation_rad": np.float32, "shape_id": np.int32, "object_id": np.int32, "shadow": np.uint8}
"""Per-pixel truth: name and type. Where a pixel holds no echo: nan, -1; ``shadow`` is said in :class:`SonarFrames`."""

BODIES = ("body_poses", "body_velocities")

PER_FRAME = ("image", "time_s", "poses", "beam_poses", *BODIES, "attitude_rad", "height_m", *LABELS)

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
"""What the arrays of a file must be."""


@dataclass
class SonarFrames:
    """Frames of one sonar.

    Attributes:
        image: ``(frames, bins, beams)`` float32 in 0..1 (or uint8 in 0..255); row 0 nearest, column 0 most to port;
            zero means no echo.
        range_m: centres of the bins ``(bins,)`` [m].
        bearing_rad: axes of the beams ``(beams,)`` [rad], starboard positive, not necessarily even.
        time_s: time of each frame ``(frames,)``, or of each beam ``(frames, beams)`` [s].
        poses: x, y, z [m], pitch, roll, heading [rad] of the sonar ``(frames, 6)``, where known.
        beam_poses: poses of the sonar at the time of each beam ``(frames, beams, 6)``, where beams ping one after another.
        body_poses: poses of the scene's bodies that move ``(frames, bodies, 6)`` [m, rad], by ``body_names``.
        body_velocities: of these in the world's axes: of the origin [m/s], turn a second [rad/s] ``(frames, bodies, 6)``.
        height_m: height over the ground below, measured straight down ``(frames,)``; nan where nothing is below.
        level: how image values stand for level: ``linear`` (level = value * level_scale), ``dB``, ``gamma`` or ``contrast``.
        level_scale: what undoes the constant gain.
        sonar: the instrument.
        elevation_rad: elevation of the strongest echo of each pixel, like ``image``, float32.
        shape_id: the shape of that echo (its place in the scene), int32.
        object_id: the object of that echo, as its mesh numbers them (attribute ``face_id``; 0 without it), int32.
        shape_names: name of each shape by its ``shape_id``; empty where they are not known.
        object_names: name of each object by its ``object_id``, the shape that it is part of and its number: ``cubes 12``;
            empty where they are not known.
        shadow: 0 not in shadow; 1 no echo here, but echoes before and sound or echoes beyond; 2 no echo here and all
            sound of the beam was intercepted before (an object's shadow that nothing ends, or past the lit floor).
        attitude_rad: pitch, roll, heading [rad] of the sonar by its own sensors ``(frames, 3)``; nan where unknown.
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

    def __post_init__(self) -> None:
        frames, bins, beams = self.image.shape if self.image.ndim == 3 else (0, 0, 0)
        if (bins, beams) != (len(self.range_m), len(self.bearing_rad)) or len(self.time_s) != frames:
            raise MitsonarError(
                f"image must be (frames, bins, beams) = ({len(self.time_s)}, {len(self.range_m)}, "
                f"{len(self.bearing_rad)}) after time_s, range_m and bearing_rad: got {self.image.shape}"
            )
        if self.level not in LEVELS:
            raise MitsonarError(f"level must be one of {', '.join(LEVELS)}: got {shortened(self.level)}")
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
        """Pitch of each frame ``(frames,)`` [rad], where poses are known."""
        return None if self.poses is None else self.poses[:, 3]

    def decibels_of(self, value: float) -> float:
        """Return the level that a value 0..1 of the image stands for [dB re 1 uPa], with the gain of the sonar.

        Relative to the source where the sonar has no ``source_level_db``. A value of 0 of a linear image is -inf.
        """
        with np.errstate(divide="ignore"):
            level = 10 * np.log10(decoded(value, self.sonar, self.level) * self.level_scale)
        return float(level) + self.sonar.source_level_db

    def to_linear(self) -> SonarFrames:
        """Return the same frames with images that are levels: float32 in 0..1, relative to full scale.

        Codings ``dB`` and ``gamma`` are undone with the numbers of the sonar. A value 0 of the coding dB becomes its least
        level.

        Raises:
            MitsonarError: images of contrast, of which levels cannot be had back.
        """
        return replace(self, image=self.linear_values(), level="linear")

    def linear_values(self) -> NDArray[np.float32]:
        """Return the levels of the images as float32, as parts of full scale, like ``image``.

        Raises:
            MitsonarError: images of contrast, of which levels cannot be had back.
        """
        if self.level == "contrast":
            raise MitsonarError("images of contrast hold no levels: take the frames before their contrast")
        values = to_float32(self.image)
        if self.level == "linear":
            return values
        return np.asarray(decoded(np.clip(values, 0, 1), self.sonar, self.level), dtype=np.float32)

    def in_decibels(self) -> NDArray[np.float32]:
        """Return levels relative to full scale, like ``image`` [dB], -100 at least.

        Raises:
            MitsonarError: as :meth:`linear_values`.
        """
        level = np.maximum(self.linear_values(), np.float32(10 ** (FLOOR_DB / 10)))
        return np.asarray(10 * np.log10(level), dtype=np.float32)

    def matching_values(self) -> NDArray[np.float32]:
        """Return the images as float32 in 0..1, as estimators and mosaics match them, like ``image``.

        Linear images and those of contrast are as they are. Of images in the codings ``dB`` and ``gamma`` the root of the
        amplitude is returned: of level, amplitude, its root and dB it made the smallest errors on speckle, with all
        estimators.
        """
        if self.level == "contrast":
            return to_float32(self.image)
        return self.linear_values() if self.level == "linear" else self.linear_values() ** np.float32(0.25)

    def select(self, index: slice | NDArray[Any]) -> SonarFrames:
        """Return some of the frames."""
        picked = {name: getattr(self, name)[index] for name in PER_FRAME if getattr(self, name) is not None}
        rest = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in picked}
        return SonarFrames(**picked, **rest)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what ``frames.npz`` holds, by name; ``sonar``, ``about`` and ``names`` are JSON texts."""
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
        """Frames from what :meth:`arrays` gave; ``source`` is named in errors."""
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
        """Write ``frames.npz``."""
        table: dict[str, Any] = self.arrays()
        np.savez_compressed(Path(path), **table)

    @classmethod
    def load(cls, path: str | Path) -> SonarFrames:
        """Read ``frames.npz``, or the ``frames.zarr`` of a long run, or the folder of a run that holds either.

        Raises:
            MitsonarError: no such file, or not frames.
        """
        path = Path(path)
        if os.path.isdir(path) and path.suffix != ".zarr":
            found = [path / name for name in ("frames.npz", "frames.zarr") if os.path.exists(path / name)]
            if not found:
                raise MitsonarError(f"{path} holds no frames.npz or frames.zarr: give the folder of a finished run")
            path = found[0]
        if not os.path.exists(path):
            raise MitsonarError(f"there are no frames at {path}: give frames.npz or a run's folder")
        try:
            if os.path.isdir(path):
                table, done = open_group(path, COLUMNS, "time_s", "frames_done")
                refuse_beyond_memory(sum(getattr(values, "nbytes", 0) for values in table.values()), str(path))
                arrays = {name: values for name, values in table.items() if not isinstance(values, np.ndarray)}
                table |= {name: one[:done] if name in PER_FRAME else one[...] for name, one in arrays.items()}
            else:
                table = read_npz(path)
        except Exception as error:  # a damaged zip or Zarr raises whatever its bytes lead to
            reason = " ".join(str(error).split())[:300] or type(error).__name__
            raise MitsonarError(f"cannot read frames {path}: {reason}; give frames.npz or a run's folder") from None
        return cls.from_arrays(table, str(path))


def _texts(names: dict[str, Any], key: str, source: str) -> tuple[str, ...]:
    """Return the texts of a list in the field ``names``.

    Raises:
        MitsonarError: it is no list of texts.
    """
    found = names.get(key, [])
    if not (isinstance(found, list) and all(isinstance(one, str) for one in found)):
        raise MitsonarError(f"{source}: {key} of the field names must be a list of texts; the file is damaged")
    return tuple(found)


def _check_values(values: dict[str, NDArray[Any]], source: str) -> None:
    """Check the arrays of frames against each other and against what they may be.

    Raises:
        MitsonarError: types, shapes or values that cannot be.
    """
    sizes: dict[str, int] = {}
    for name in ("range_m", "bearing_rad"):
        check_column(values[name], name, COLUMNS[name], sizes, source)
        sizes[COLUMNS[name].dims[0]] = len(values[name])
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
    """Return 0..255 of uint8, or 0..1, as float32 in 0..1: always a copy."""
    return np.asarray(image, dtype=np.float32) * np.float32(1 / 255 if image.dtype == np.uint8 else 1)


def to_uint8(image: NDArray[Any]) -> NDArray[np.uint8]:
    """0..1 to 0..255, a non-zero echo at least 1, so that zero means no echo."""
    values = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    return np.where((image > 0) & (values == 0), np.uint8(1), values)
