"""How frames are read for export, with labels and poses, and how recorded frames become a data set."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import shutil
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mitsonar.acoustics.water import noise_of
from mitsonar.config.data import Recipe, Split, recipe_from
from mitsonar.datasets.modality import Scene, Values
from mitsonar.datasets.plan import Plan
from mitsonar.datasets.store import PACKAGES, PARTS, DataStore, frames_in_part, shape_names_of, world_numbers
from mitsonar.errors import MitsonarError, MitsonarWarning, count_noun, suggest_names
from mitsonar.estimation.sonar_fit import NOISE_FIELDS, as_instrument
from mitsonar.geometry.fan import nearest_cells
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.runs import shown, versions
from mitsonar.io.storage import Storage
from mitsonar.mapping.sources import is_data_set, open_frames, poses_at, recording_at, stretches, view_in
from mitsonar.motion.composition import motions
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.plotting.fans import FanPictures
from mitsonar.recordings.recording import Part
from mitsonar.records.frames import COLUMNS, LABELS, SonarFrames, open_group, to_float32, to_uint8

__all__ = [
    "LEAST_SNR_DB",
    "Axes",
    "ExportSource",
    "FramesWithPoses",
    "LabelledPictures",
    "PictureKind",
    "RecordedDataSet",
    "Region",
    "Shot",
    "Stretch",
    "as_json",
    "as_pixels",
    "axes_of",
    "class_rules",
    "compress_run_lengths",
    "digest_of",
    "frames_with_poses",
    "json_line",
    "labels_of",
    "new_folder",
    "open_export",
    "png",
    "pose_fields",
    "recorded_recipe",
    "region_fields",
    "require_labels",
    "require_poses",
    "run_lengths",
    "shots",
    "write_recorded",
]


CHUNK_BYTES = 2**24
"""Approximate size of the pixels and labels that are read at once [bytes]."""

Read = Callable[[slice], SonarFrames]


@dataclass(frozen=True)
class ExportSource:
    """Frames to export; pixels and labels are read on demand.

    Attributes:
        name: name of the source.
        frames: number of frames.
        sequence: number of the sequence of each frame ``(frames,)``.
        like: an empty set of frames with their common properties: sonar, ranges, bearings, names of shapes and objects.
        labels: names of the available labels.
        posed: whether poses are known.
        part: part of each frame, ``train``, ``validation`` or ``test`` ``(frames,)``; without a split all are ``train``.
        read: function that reads a slice of the frames, with labels.
        about: description of the source, for metadata.
        raised_db: level added to the noise of the sonar, relative to the full scale of ``like``, in each frame ``(frames,)``
            [dB].
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

    def chunks(self) -> Iterator[tuple[int, SonarFrames]]:
        """Yield the frames in chunks, each with the number of its first frame."""
        cells = max(1, self.like.image.shape[1] * self.like.image.shape[2])
        chunk_frames = max(1, CHUNK_BYTES // (cells * (4 + 4 * len(self.labels))))
        for first in range(0, self.frames, chunk_frames):
            yield first, self.read(slice(first, min(first + chunk_frames, self.frames)))


def open_export(
    where: str | Path, *, view: str | None = None, split: tuple[float, float, float] | None = None
) -> ExportSource:
    """Open the frames at a path or URL for export: all sequences of a data set, a run, or a recording.

    Args:
        where: a data set, ``frames.npz``, ``frames.zarr``, the folder of a run, or a recording.
        view: view of a data set; default: the first.
        split: shares of training, validation and test. A data set is divided by sequence or scene, as in its recipe; a run
            or a recording is cut into three intervals of time. Default: the split of the recipe; for a run or a recording
            all frames are for training.

    Raises:
        MitsonarError: there are no frames, the shares do not add up to 1, or there are too few sequences or frames for them.
    """
    if split is not None and not (min(split) >= 0 and abs(sum(split) - 1) < 1e-6):
        raise MitsonarError(f"--split must be three shares that add up to 1, such as 0.7,0.15,0.15: got {split}")
    if is_data_set(where):
        return _open_data_set(str(where), view, split)
    source = _open_frames(where, view)
    return source if split is None else replace(source, part=_parts_by_time(source.frames, split))


def _open_frames(where: str | Path, view: str | None) -> ExportSource:
    """Open the frames of a run or of a recording."""
    if view is not None:
        raise MitsonarError(f"{where} is not a data set, so it has no views: leave --view out")
    path = Path(where)
    if os.path.isdir(path):
        candidates = [path / name for name in ("frames.npz", "frames.zarr") if os.path.exists(path / name)]
        path = candidates[0] if candidates else path
    if path.suffix == ".npz":
        return _in_memory(SonarFrames.load(path), str(where))
    source = open_frames(where)
    if not len(source):
        raise MitsonarError(f"{source.name} contains no frames: give a finished run")
    stored, like = _labels_of_zarr(path) if path.suffix == ".zarr" else ({}, {})

    def read(span: slice) -> SonarFrames:
        index = np.arange(span.start, span.stop)
        frames = source.read(index)
        labels: dict[str, Any] = {name: np.asarray(array[span]) for name, array in stored.items()}
        # The source withholds these from estimators; exports include them.
        poses, attitude = (None if values is None else values[span] for values in (source.poses, source.attitude_rad))
        return replace(frames, poses=poses, attitude_rad=attitude, **like, **labels)

    template = replace(source.like, **like)
    sequence, posed = np.zeros(len(source), np.int64), source.poses is not None
    return ExportSource(source.name, len(source), sequence, template, tuple(stored), posed, _all_train(len(source)), read)


def _in_memory(frames: SonarFrames, name: str) -> ExportSource:
    """Return frames in memory as a source."""
    if not len(frames):
        raise MitsonarError(f"{name} contains no frames: give a finished run")
    labels = tuple(label for label in LABELS if getattr(frames, label) is not None)
    sequence, posed = np.zeros(len(frames), np.int64), frames.poses is not None
    like = frames.select(slice(0))
    return ExportSource(name, len(frames), sequence, like, labels, posed, _all_train(len(frames)), frames.select)


def _all_train(frames: int) -> NDArray[np.str_]:
    return np.full(frames, "train", dtype="<U10")


def _labels_of_zarr(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the label arrays of a long run, not read yet, and the names of shapes and objects that they refer to."""
    arrays, _ = open_group(path, COLUMNS, "time_s", "frames_done")
    stored = {name: arrays[name] for name in LABELS if name in arrays}
    empty_arrays = {name: array for name, array in arrays.items() if isinstance(array, np.ndarray)}
    for name in COLUMNS:
        if name in arrays:
            empty_arrays[name] = arrays[name][:0] if name not in ("range_m", "bearing_rad") else arrays[name][...]
    like = SonarFrames.from_arrays(empty_arrays, str(path))
    return stored, {"shape_names": like.shape_names, "object_names": like.object_names}


def _parts_by_time(frames: int, split: tuple[float, float, float]) -> NDArray[np.str_]:
    """Return the part of each frame ``(frames,)`` for a division into consecutive intervals, one for each part.

    Raises:
        MitsonarError: there are too few frames for the parts.
    """
    has_share = [share > 0 for share in split]
    ends = np.rint(np.cumsum(split) * frames).astype(int)
    counts = np.maximum(np.diff(ends, prepend=0), has_share)
    counts[int(np.argmax(split))] -= counts.sum() - frames
    if (counts[has_share] < 1).any():
        raise MitsonarError(
            f"the shares {split} of training, validation and test need at least one frame each: got {frames}; give more "
            "frames, or another --split"
        )
    return np.repeat(np.array(PARTS, dtype="<U10"), counts)


def _open_data_set(url: str, view: str | None, split: tuple[float, float, float] | None) -> ExportSource:
    """Open all frames of one view of a data set.

    Raises:
        MitsonarError: there are too few sequences or scenes for the given split.
    """
    store = DataStore.open(url)
    stored_view = view_in(store, view)
    labels = {label: f"{label}{store.recipe.suffix(stored_view.name)}" for label in store.recipe.labels}
    scene = np.asarray(store.read("scene"))
    shape_names, shape_indices = shape_names_of(store) if "shape_id" in labels else ((), {})

    def read(span: slice) -> SonarFrames:
        label_maps: dict[str, Any] = {label: store.read(array, span) for label, array in labels.items()}
        for number in np.unique(scene[span]) if shape_indices else ():
            in_scene = scene[span] == number
            shapes, known = label_maps["shape_id"][in_scene], len(shape_indices[int(number)]) - 1
            if shapes.size and not (shapes.min() >= -1 and shapes.max() < known):
                raise MitsonarError(
                    f"{url}: shape_id of scene {number} must lie in -1..{known - 1}: got {shapes.min()}..{shapes.max()}; it "
                    "is damaged"
                )
            label_maps["shape_id"][in_scene] = shape_indices[int(number)][shapes]
        return replace(
            stored_view.like,
            image=store.read(stored_view.array, span),
            time_s=store.read("time_s", span),
            poses=store.read("pose", span),
            height_m=store.read("height_m", span),
            shape_names=shape_names,
            **label_maps,
        )

    sequence, like = np.asarray(store.read("sequence"), dtype=np.int64), read(slice(0, 0))
    about = str(store.about["recipe"].get("about") or store.recipe.name)
    # Noise is relative to full scale, which differs between recorded scenes of other gains.
    scales = {number: store.level_scale_of(number) for number in store.scenes}
    scale = np.array([scales[int(number)] for number in scene])
    raised = store.recipe.noise_raised_db(scene) + 10 * np.log10(like.level_scale / scale)
    parts = _parts_by_split(store, split)
    return ExportSource(url, len(store), sequence, like, tuple(labels), True, parts, read, about, raised)


def _parts_by_split(store: DataStore, shares: tuple[float, float, float] | None) -> NDArray[np.str_]:
    """Return the part of each frame ``(frames,)`` by the recipe's split, or by the given shares.

    A split by sample does not divide frames: all are for training.

    Raises:
        MitsonarError: there are too few sequences or worlds for the given shares.
    """
    parts, split = _all_train(len(store)), store.recipe.split
    if shares is not None:
        by = "sequence" if split.by == "sample" else split.by
        split = Split(by=by, seed=split.seed, **dict(zip(PARTS, shares, strict=True)))
    if split.by == "sample":
        return parts
    sequence = np.asarray(store.read("sequence"), dtype=np.int32)
    world = world_numbers(store.recipe, store.scenes)[np.asarray(store.read("scene"))]
    try:
        for name in ("validation", "test"):
            if getattr(split, name) > 0:
                parts[frames_in_part(world, sequence, split, name)] = name
    except MitsonarError as error:  # too few sequences or worlds for the parts
        if shares is not None:
            raise
        warnings.warn(f"all frames are for training: {error}", MitsonarWarning, stacklevel=2)
        return _all_train(len(store))
    return parts


# ---------------- Writing an export


MARKER = ".mitsonar-export"
"""Name of a file that marks a folder being written; only marked folders are ever removed."""


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Yield a temporary folder next to ``out`` that is renamed to ``out`` on success, and removed on failure.

    The remains of an interrupted export are removed first.

    Raises:
        MitsonarError: ``out`` exists, or a foreign folder has the temporary name.
    """
    if out.exists():  # so does ".", which has no name
        raise MitsonarError(f"{out} exists and is kept as it is: choose another -o, or remove it")
    part = out.with_name(f".{out.name}.part")
    if part.exists() and not (part / MARKER).is_file():
        raise MitsonarError(f"{part} exists and is not an unfinished export of mitsonar: remove it, or choose another -o")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        (part / MARKER).touch()
        yield part
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    (part / MARKER).unlink()
    part.rename(out)


def png(picture: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Return a grey picture as a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()


def json_line(value: object) -> str:
    """Return a value as one line of JSON."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def digest_of(path: Path) -> str:
    """Return the SHA-256 digest of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# ---------------- One frame at a time


@dataclass(frozen=True)
class Shot:
    """One exported frame: its number, its part, and its index among the frames that were read together."""

    number: int
    part: str
    frames: SonarFrames
    index: int

    @property
    def name(self) -> str:
        """Return the name of the frame's files, without extension."""
        return f"{self.number:06d}"


def shots(source: ExportSource) -> Iterator[Shot]:
    """Yield the frames of a source one by one; only a few are in memory at a time."""
    for first, frames in source.chunks():
        for index in range(len(frames)):
            yield Shot(first + index, str(source.part[first + index]), frames, index)


def require_labels(source: ExportSource) -> None:
    """Check that frames have labels.

    Raises:
        MitsonarError: the frames have no ``shape_id``.
    """
    if "shape_id" not in source.labels:
        raise MitsonarError(
            f"{source.name} has no label shape_id: render with --labels, or give the recipe `labels: [shape_id, object_id]`"
        )


def require_poses(source: ExportSource) -> None:
    """Check that frames have poses.

    Raises:
        MitsonarError: the frames have no poses.
    """
    if not source.posed:
        raise MitsonarError(f"{source.name} has no poses, which this layout needs: choose another --to")


def region_fields(shot: Shot, pictures: LabelledPictures, source: ExportSource) -> dict[str, list[object]]:
    """Return boxes, classes, names and objects of a frame's regions as plain lists; empty without labels."""
    raised_db = float(source.raised_db[shot.number])
    regions = pictures.regions(shot.frames, shot.index, raised_db) if "shape_id" in source.labels else []
    return {
        "bbox": [list(region.box) for region in regions],
        "category": [region.kind for region in regions],
        "name": [pictures.classes[region.kind] for region in regions],
        "object": [region.number for region in regions],
    }


def pose_fields(shot: Shot) -> dict[str, float]:
    """Return the time and the pose of a frame [s, m, deg]; without a known pose, the time alone."""
    time = float(np.mean(shot.frames.time_s[shot.index]))
    if shot.frames.poses is None:
        return {"time_s": time}
    pose = shot.frames.poses[shot.index]
    angles = np.degrees(pose[3:])
    position = dict(zip(("x_m", "y_m", "z_m"), map(float, pose[:3]), strict=True))
    attitude = dict(zip(("pitch_deg", "roll_deg", "heading_deg"), map(float, angles), strict=True))
    return {"time_s": time, **position, **attitude}


def as_json(value: object) -> bytes:
    """Return a value as the content of a JSON file."""
    return (json.dumps(value, indent=2, allow_nan=False) + "\n").encode()


# ---------------- Pictures with labelled regions


PictureKind: TypeAlias = Literal["polar", "fan"]

Mask: TypeAlias = NDArray[np.bool_]

LEAST_SNR_DB = 3.0
"""Default of the smallest signal-to-noise ratio of a labelled object [dB]."""

FINAL_NUMBER = re.compile(r"[\s_.-]*\d+$")
"""Pattern of the number at the end of a shape's name, with its separator."""


@dataclass(frozen=True)
class Region:
    """The visible region of one object in a picture.

    Attributes:
        kind: number of its class, counted from 0; see :attr:`LabelledPictures.classes`.
        shape: index of its shape in the scene.
        number: number of the object within its shape; 0 if there is none.
        mask: mask of the region ``(rows, columns)``.
        box: bounding box: first column, first row, number of columns, number of rows [pixels].
    """

    kind: int
    shape: int
    number: int
    mask: Mask
    box: tuple[int, int, int, int]


class LabelledPictures:
    """Pictures of the frames of one sonar, polar or fan, with the regions of labelled objects.

    Args:
        like: frames that define ranges, bearings and shapes.
        picture: ``polar``, one row per range with the nearest on top; or ``fan``, forward up and starboard to the right.
        classes: globs of shape names, each with a class; the first matching glob counts, and an empty class leaves a shape
            out. The class of other shapes is their name; names that differ only by a final number share one class.
        least: smallest number of pixels of a region.
        least_snr_db: smallest signal-to-noise ratio of a region [dB]; see :meth:`snr_db`. ``-inf`` accepts all.

    Attributes:
        size: columns and rows of the pictures.
        classes: names of the classes, by number; for shapes without names, the classes met so far.
        left_out: names of the shapes without a class.
        boxes: number of regions counted, by part and class.
        faint: number of regions left out because their signal-to-noise ratio is too low.
        small: number of regions left out because they have too few pixels.

    Raises:
        MitsonarError: the kind of picture is unknown, a glob matches no shape, or no class is left.
    """

    def __init__(
        self,
        like: SonarFrames,
        picture: PictureKind = "polar",
        classes: Sequence[tuple[str, str]] = (),
        least: int = 1,
        least_snr_db: float = LEAST_SNR_DB,
    ) -> None:
        if picture not in ("polar", "fan"):
            raise MitsonarError(f"--picture must be polar or fan: got {picture!r}")
        self.picture_kind, self.least, self.least_snr_db = picture, least, least_snr_db
        self._rules = tuple(classes)
        names = like.shape_names
        for glob, _ in classes if names else ():
            if not any(fnmatchcase(name, glob) for name in names):
                raise MitsonarError(f"no shape is named {glob!r}: {suggest_names(glob, names)}")
        class_of = self._class_names(names)
        self.classes = list(dict.fromkeys(name for name in class_of if name))
        self.left_out = [shape for shape, name in zip(names, class_of, strict=True) if not name]
        if names and not self.classes:
            raise MitsonarError(
                f"all shapes are left out ({', '.join(names[:6])}), so no class is left: leave out fewer of them"
            )
        self._kinds = {index: self.classes.index(name) if name else None for index, name in enumerate(class_of)}
        self.fan = FanPictures(like) if picture == "fan" else None
        rows, columns = like.image.shape[1:] if self.fan is None else self.fan.fan.index.shape[1:]
        self.size = int(columns), int(rows)
        self.boxes: Counter[tuple[str, str]] = Counter()
        self.faint = self.small = 0

    def _class_names(self, names: Sequence[str]) -> list[str]:
        """Return the class of each shape; empty for shapes that are left out."""
        stems = [FINAL_NUMBER.sub("", name) or name for name in names]
        shared = Counter(stems)
        default_names = [stem if shared[stem] > 1 else name for name, stem in zip(names, stems, strict=True)]
        return [
            next((kind for glob, kind in self._rules if fnmatchcase(name, glob)), default)
            for name, default in zip(names, default_names, strict=True)
        ]

    def _class_number(self, shape: int) -> int | None:
        """Return the number of a shape's class, None if it is left out; shapes without names add their class."""
        if shape not in self._kinds:
            name = f"shape {shape}"
            kind = next((kind for glob, kind in self._rules if fnmatchcase(name, glob)), name)
            if kind and kind not in self.classes:
                self.classes.append(kind)
            self._kinds[shape] = self.classes.index(kind) if kind else None
        return self._kinds[shape]

    def picture(self, frames: SonarFrames, index: int) -> NDArray[np.uint8]:
        """Return the picture of a frame ``(rows, columns)``, with levels 0..255."""
        image = frames.image[index]
        if self.fan is not None:
            return self.fan.picture(image)
        return image if image.dtype == np.uint8 else to_uint8(image)

    def label(self, frames: SonarFrames, name: str, index: int) -> NDArray[np.int64]:
        """Return a label of a frame in the layout of the picture ``(rows, columns)``; -1 without a label.

        Raises:
            MitsonarError: the frames lack the label.
        """
        label_map = _label_map(frames, name, index)
        return label_map if self.fan is None else np.asarray(nearest_cells(self.fan.fan, label_map, -1), dtype=np.int64)

    def regions(self, frames: SonarFrames, index: int, raised_db: float = 0.0) -> list[Region]:
        """Return the region of each visible object in a frame, ordered by shape and object.

        Args:
            frames: frames with the label ``shape_id``.
            index: index of the frame.
            raised_db: level added to the noise of the sonar in this frame [dB].

        Raises:
            MitsonarError: the frames have no ``shape_id``.
        """
        shape_map = self.label(frames, "shape_id", index)
        object_map = self.label(frames, "object_id", index) if frames.object_id is not None else np.zeros_like(shape_map)
        snr = self.snr_db(frames, index, raised_db) if self.least_snr_db > -np.inf else {}
        regions = []
        for shape_index in (int(value) for value in np.unique(shape_map) if value >= 0):
            kind = self._class_number(shape_index)
            if kind is None:
                continue
            in_shape = shape_map == shape_index
            for object_number in (int(value) for value in np.unique(object_map[in_shape])):
                mask = in_shape & (object_map == object_number)
                if snr.get((shape_index, object_number), np.inf) < self.least_snr_db:
                    self.faint += 1
                elif np.count_nonzero(mask) < self.least:
                    self.small += 1
                else:
                    regions.append(Region(kind, shape_index, max(0, object_number), mask, _box(mask)))
        return regions

    def snr_db(self, frames: SonarFrames, index: int, raised_db: float = 0.0) -> dict[tuple[int, int], float]:
        """Compute the signal-to-noise ratio of each object in a frame [dB], keyed by shape and object.

        The signal is the mean level of the object's cells minus the mean level of the noise in these cells. For the model
        ``coherent`` the noise is known: that of the sonar, after the gain. For other models it is the mean level of the
        cells without an echo; if these are dark the ratio is infinite. For contrast images the ratio is unknown, and the
        result is empty.
        """
        if frames.level == "contrast":
            return {}
        # 1. Separate the cells with an echo, and determine the mean noise of each range.
        level = frames.select(slice(index, index + 1)).linear_values()[0].astype(float)
        shape_map = _label_map(frames, "shape_id", index)
        object_map = _label_map(frames, "object_id", index) if frames.object_id is not None else np.zeros_like(shape_map)
        echo = shape_map >= 0
        noise = _noise_levels(frames, raised_db)
        if noise is None:
            dark = level[~echo]
            noise = np.full(len(level), float(dark.mean()) if dark.size else 0.0)
        # 2. Sum level and noise over the cells of each object; the cell counts cancel in the ratio.
        pairs, pair_index = np.unique(np.stack([shape_map[echo], object_map[echo]], axis=-1), axis=0, return_inverse=True)
        pair_index = pair_index.ravel()
        noise_sum = np.bincount(pair_index, np.broadcast_to(noise[:, None], level.shape)[echo])
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(
                noise_sum > 0, np.maximum(0.0, np.bincount(pair_index, level[echo]) - noise_sum) / noise_sum, np.inf
            )
            decibels = 10 * np.log10(ratio)
        return {(int(shape), int(number)): float(value) for (shape, number), value in zip(pairs, decibels, strict=True)}

    def count(self, part: str, regions: Sequence[Region]) -> None:
        """Add the regions of a written frame to :attr:`boxes`."""
        self.boxes.update((part, self.classes[region.kind]) for region in regions)

    def require_regions(self, frames: int) -> None:
        """Check that at least one region was counted.

        Raises:
            MitsonarError: no region was counted.
        """
        if not self.boxes:
            raise MitsonarError(
                f"no object is visible in any of {frames:,} frames ({self.faint:,} are below --least-snr-db "
                f"{self.least_snr_db:g}, {self.small:,} have fewer pixels than --least {self.least}): move the sonar nearer "
                "to the objects, or lower these"
            )


def class_rules(text: str) -> list[tuple[str, str]]:
    """Parse the rules for classes of the command line: ``pillar*=pillar,seabed*=``.

    Raises:
        MitsonarError: a part is not GLOB=CLASS.
    """
    rules = []
    for rule in filter(None, (part.strip() for part in text.split(","))):
        glob, equals, kind = (word.strip() for word in rule.partition("="))
        if not glob or not equals:
            raise MitsonarError(
                f"--classes must be GLOB=CLASS, separated by commas (an empty class leaves shapes out): got {rule!r}"
            )
        rules.append((glob, kind))
    return rules


def _label_map(frames: SonarFrames, name: str, index: int) -> NDArray[np.int64]:
    """Return a label of a frame ``(bins, beams)``.

    Raises:
        MitsonarError: the frames lack the label.
    """
    values = getattr(frames, name)
    if values is None:
        raise MitsonarError(f"the frames have no {name}: render with --labels, or give the recipe `labels: [{name}]`")
    return np.asarray(values[index], dtype=np.int64)


def _noise_levels(frames: SonarFrames, raised_db: float) -> NDArray[np.float64] | None:
    """Return the mean level of the receiver noise in each bin, relative to full scale ``(bins,)``; None if unknown."""
    if frames.sonar.model != "coherent":
        return None
    return noise_of(frames.sonar) * 10 ** (raised_db / 10) / frames.level_scale


def _box(mask: Mask) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1


# ---------------- Run-length encoding of COCO's masks


def run_lengths(mask: NDArray[np.bool_]) -> list[int]:
    """Return the lengths of the runs of a mask ``(rows, columns)``, column by column, starting with a run of zeros."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    edges = np.concatenate([[0], changes, [flat.size]])
    lengths = np.diff(edges).tolist()
    return [0, *lengths] if flat[0] else lengths


def compress_run_lengths(runs: list[int]) -> str:
    """Encode run lengths in COCO's compressed text: differences to the run two places before, 5 bits per character."""
    letters = []
    for index, run in enumerate(runs):
        value = run - runs[index - 2] if index > 2 else run
        while True:
            bits = value & 31
            value >>= 5
            more = value != -1 if bits & 16 else value != 0
            letters.append(chr((bits | 32 if more else bits) + 48))
            if not more:
                break
    return "".join(letters)


# ---------------- Recorded frames with known poses


Array = NDArray[np.float64]

MAX_AXIS_DEVIATION = 0.1
"""Largest deviation of a bin or beam from its place in the sonar, as a fraction of the step to the next."""

EQUAL_AXIS_DEVIATION = 1e-6
"""Deviation, as such a fraction, below which ranges and bearings are those of the sonar; files round them."""

FIELD_TOLERANCE = 1e-3
"""Largest relative difference of numbers of one sonar between two files."""

IGNORED_FIELDS = (
    "name",
    "seed",
    "frame_rate_hz",
    "quality",
    "thesis_rays",
    "rays_per_beam",
    "rays_across",
    "jitter",
    *NOISE_FIELDS,
)
"""Fields of a sonar in which frames of one data set may differ."""

AXIS_FIELDS = ("range_min", "range_max", "azimuth_fov_deg", "beam_layout")
"""Fields that are compared as ranges and bearings."""


@dataclass(frozen=True)
class Axes:
    """The sonar of frames, with their window and bins.

    Attributes:
        sonar: the sonar.
        bearing_rad: bearings of the beams ``(beams,)`` [rad]; None if they are those of the sonar.
        level: coding of levels in the pixels.
    """

    sonar: Sonar
    bearing_rad: Array | None
    level: str

    @property
    def bearings(self) -> Array:
        """Return the bearings of the beams ``(beams,)`` [rad]."""
        return self.sonar.bearing_rad if self.bearing_rad is None else self.bearing_rad

    def differences_from(self, other: Axes) -> list[str]:
        """Return the differences from another sonar, with both values: ``range_bins 128, not 256``."""
        values, other_values = ({**axes.sonar.model_dump(), "level": axes.level} for axes in (self, other))
        keys = [
            key for key in values if key not in (*IGNORED_FIELDS, *AXIS_FIELDS) and not _same(values[key], other_values[key])
        ]
        if self.sonar.range_bins == other.sonar.range_bins and not _near(
            self.sonar.range_m, other.sonar.range_m, MAX_AXIS_DEVIATION
        ):
            keys += ["range_min", "range_max"]
        if self.sonar.beams == other.sonar.beams and not _near(self.bearings, other.bearings, MAX_AXIS_DEVIATION):
            keys += ["azimuth_fov_deg", "bearings"]
        values, other_values = ({**fields, "bearings": "of other beams"} for fields in (values, other_values))
        return [f"{key} {shown(values[key])}, not {shown(other_values[key])}" for key in keys]


@dataclass(frozen=True)
class Stretch:
    """Two or more consecutive frames of a part of a recording, each with a pose.

    Attributes:
        part: part of the recording.
        first: number of the first frame in the part.
        time_s: times of the frames ``(frames,)`` [s].
        poses: poses of the sonar ``(frames, 6)`` [m, rad].
        height_m: heights above the ground ``(frames,)`` [m]; nan if unknown.
    """

    part: Part
    first: int
    time_s: Array
    poses: Array
    height_m: Array

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time_s)

    def read(self, frame_slice: slice) -> SonarFrames:
        """Read a slice of the frames, counted from the start of the stretch."""
        return self.part.read(np.arange(self.first + frame_slice.start, self.first + frame_slice.stop))


@dataclass(frozen=True)
class FramesWithPoses:
    """The frames with poses of one file or run.

    Attributes:
        name: name of the file, as given.
        format: description of the format.
        poses: origin of the poses.
        axes: sonar of the frames.
        level_scale: level of a pixel of 1.
        stretches: the frames.
        left_out: number of frames without a pose, of another geometry, or without a neighbour.
        notes: notes on the recording, one sentence each.
        labels: names of the labels that the frames have.
        shape_names: name of each shape, by ``shape_id``; empty if unknown.
        world: digest of the world of a rendered data set; empty if unknown. Sources of one world stay in one part.
        recipe: recipe of the data set that the frames are taken from; None for runs and recordings.
        raised_db: level added to the noise of the sonar [dB].
    """

    name: str
    format: str
    poses: str
    axes: Axes
    level_scale: float
    stretches: list[Stretch]
    left_out: int
    notes: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()
    shape_names: tuple[str, ...] = ()
    world: str = ""
    recipe: Recipe | None = None
    raised_db: float = 0.0

    def __len__(self) -> int:
        """Return the number of frames in all stretches."""
        return sum(map(len, self.stretches))


def frames_with_poses(
    where: str,
    *,
    path: str | Path | None = None,
    frame: str = "mitsonar",
    height_m: float | None = None,
    cut: int | None = None,
    geometry: str | Path | None = None,
) -> FramesWithPoses:
    """Find the frames of a file or run whose poses are known, without reading pixels.

    If a recording has several parts, only parts with the geometry of the longest are used.

    Args:
        where: a recording of a real sonar, ``frames.npz``, ``frames.zarr``, or the folder of a run.
        path: file of poses, TUM or CSV; None: the poses of the frames.
        frame: convention of that file.
        height_m: height above the ground for frames that have none [m].
        cut: largest number of frames in a stretch.
        geometry: file that describes the layout of a recording's pictures.

    Raises:
        MitsonarError: there are no frames or no poses, or a data set cannot represent the sonar.
    """
    if is_data_set(where):
        raise MitsonarError(f"{where} is a data set: sources_of_data_set reads it")
    recording = recording_at(where, geometry=geometry)
    longest = recording.part()
    axes = axes_of(longest.like, where)
    known = None if path is None else Trajectory.load(path, frame)
    pieces: list[Stretch] = []
    for number, part in enumerate(recording.parts):
        if number == recording.longest or (len(part) and not axes_of(part.like, where).differences_from(axes)):
            pieces += _stretches_of(part, where, known, height_m, cut)
    if not pieces:
        raise MitsonarError(
            f"{where} has no two consecutive frames with a pose: give --poses with a path that has the times of its frames"
        )
    frame_count = sum(map(len, pieces))
    poses = "its own" if path is None else str(path)
    scale = float(longest.like.level_scale)
    labels, names = labels_of(longest)
    return FramesWithPoses(
        name=str(where),
        format=recording.format,
        poses=poses,
        axes=axes,
        level_scale=scale,
        stretches=pieces,
        left_out=len(recording) - frame_count,
        notes=recording.notes,
        labels=labels,
        shape_names=names,
    )


def labels_of(part: Part) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the labels of a part, and of its shapes by ``shape_id``, without reading pixels."""
    none = part.read(np.zeros(0, dtype=np.intp))
    return tuple(name for name in LABELS if getattr(none, name) is not None), none.shape_names


def axes_of(like: SonarFrames, name: str) -> Axes:
    """Return the sonar of frames, fitted to their ranges and bearings if they differ from its own.

    Args:
        like: frames, possibly none; only their ranges and bearings matter.
        name: name of the frames, for error messages.

    Raises:
        MitsonarError: the frames contain contrast, or their ranges are not evenly spaced.
    """
    if like.level == "contrast":
        raise MitsonarError(
            f"{name} contains contrast instead of levels: give the frames from which the contrast was computed"
        )
    sonar = like.sonar
    same_size = sonar.range_bins == len(like.range_m) and sonar.beams == len(like.bearing_rad)
    if not (
        same_size
        and _near(sonar.range_m, like.range_m, EQUAL_AXIS_DEVIATION)
        and _near(sonar.bearing_rad, like.bearing_rad, EQUAL_AXIS_DEVIATION)
    ):
        if min(len(like.range_m), len(like.bearing_rad)) < 2:
            raise MitsonarError(
                f"{name} has frames of one bin or one beam, and they do not match the window of their sonar: correct "
                "range_min, range_max and azimuth_fov_deg of the sonar"
            )
        sonar = as_instrument(like)[0].sonar
    if not _near(sonar.range_m, like.range_m, MAX_AXIS_DEVIATION):
        raise MitsonarError(
            f"the ranges of {name} are not at even steps, which a data set needs: resample its frames, or give a "
            "recording whose bins are even"
        )
    as_in_sonar = _near(sonar.bearing_rad, like.bearing_rad, EQUAL_AXIS_DEVIATION)
    return Axes(sonar, None if as_in_sonar else np.asarray(like.bearing_rad, dtype=float), like.level)


def _stretches_of(part: Part, name: str, path: Trajectory | None, height_m: float | None, cut: int | None) -> list[Stretch]:
    """Return the stretches of consecutive frames with poses in a part of a recording."""
    # 1. Determine the time of each frame; a frame with several times gets their mean.
    time = np.asarray(part.time_s, dtype=float)
    time = time.mean(axis=1) if time.ndim == 2 else time
    if not np.isfinite(time).all() or not (np.diff(time) > 0).all():
        raise MitsonarError(f"the times of {name} do not increase: sort its frames by time")
    # 2. Take the poses from the path, or from the frames.
    if path is not None:
        poses, known = poses_at(path, time, name, part.attitude_rad)
    elif part.poses is None:
        raise MitsonarError(
            f"{name} contains no poses: give --poses PATH.tum, the path of the sonar by DVL and INS, by another instrument "
            "or by `mitsonar odometry`"
        )
    else:
        poses = np.asarray(part.poses, dtype=float)
        known = np.asarray(np.isfinite(poses).all(axis=1))
    # 3. Fill in missing heights, and cut stretches that are too long.
    height = np.full(len(time), np.nan) if part.height_m is None else np.array(part.height_m, dtype=float)
    height = np.where(np.isfinite(height) | (height_m is None), height, np.nan if height_m is None else height_m)
    pieces = []
    for run in stretches(known, time):
        step = cut or run.stop - run.start
        for first in range(run.start, run.stop - 1, step):
            interval = slice(first, min(first + step, run.stop))
            pieces.append(Stretch(part, first, time[interval], poses[interval], height[interval]))
    return [run for run in pieces if len(run) > 1]


def as_pixels(image: NDArray[np.generic], pixel: str, name: str) -> NDArray[np.generic]:
    """Convert images to the pixels of a data set: uint8 unchanged, or float32 in 0..1.

    Raises:
        MitsonarError: values are outside 0..1.
    """
    if pixel == "uint8" and image.dtype == np.uint8:
        return image
    values = to_float32(image)
    if not (values.size and values.min() >= 0 and values.max() <= 1):  # also true of nan
        raise MitsonarError(f"{name} has pixels {values.min():g}..{values.max():g}, allowed 0..1: it is damaged")
    return values


def _near(axis: Array, other: Array, fraction: float) -> bool:
    """Return whether two axes agree within the fraction ``fraction`` of the smallest step."""
    if len(axis) != len(other):
        return False
    step = float(np.diff(other).min()) if len(other) > 1 else max(abs(float(other[0])), 1.0)
    return bool(np.abs(axis - other).max() <= fraction * step)


def _same(value: object, other: object) -> bool:
    if isinstance(value, float) and isinstance(other, float):
        return math.isclose(value, other, rel_tol=FIELD_TOLERANCE, abs_tol=1e-9)
    return value == other


# ---------------- Data set of recorded frames


GAIN_TOLERANCE = 0.01
"""Relative difference of the level scales of two files above which a note mentions it."""


@dataclass(frozen=True)
class RecordedDataSet:
    """A data set that was written from recorded frames.

    Attributes:
        path: folder of the data set.
        frames: number of frames.
        sequences: number of sequences.
        notes: notes for the user, one sentence each.
    """

    path: Path
    frames: int
    sequences: int
    notes: list[str]


def write_recorded(
    sources: Sequence[FramesWithPoses],
    out: str | Path,
    *,
    labels: bool = True,
    begun: Callable[[int, int], None] = lambda frames, done: None,
    progress: Callable[[int], None] = lambda frames: None,
) -> RecordedDataSet:
    """Write recorded frames with their poses as a data set.

    Each source becomes a scene, and each of its stretches a sequence. Pixels, levels, bearings and labels are unchanged. The
    folder is written completely or not at all; one shard at a time is in memory.

    Args:
        sources: files, runs and scenes of data sets, of one sonar.
        out: folder to create.
        labels: whether to write the labels of pixels, which all sources must have.
        begun: called at the start, with the number of frames of the data set and 0.
        progress: called with the number of frames written since the last call.

    Raises:
        MitsonarError: the folder exists, there are no sources, their sonars or labels differ, heights are unknown, or frames
            cannot be read.
    """
    if "://" in str(out):
        raise MitsonarError(f"-o must name a folder here: got {out}; copy the finished data set to its storage")
    path = Path(out)
    recipe = recorded_recipe(sources, path.stem, labels=labels)
    plan = _plan(sources)
    stretches = [stretch for source in sources for stretch in source.stretches]
    scale = sources[0].level_scale
    about = {"gain": 1 / scale, "level_scale": scale, "variant": "none", "versions": versions(PACKAGES)}
    if "shape_id" in recipe.labels and all(source.shape_names for source in sources):
        about["shape_names"] = [list(source.shape_names) for source in sources]
    begun(len(plan), 0)
    with new_folder(path) as folder:
        store = DataStore.create(Storage(folder), recipe, plan, about)
        for shard in range(store.shards):
            frame_slice = store.frames_of(shard)
            store.write_shard(shard, _shard_arrays(store, sources, frame_slice))
            progress(frame_slice.stop - frame_slice.start)
        store.finish()
    return RecordedDataSet(path, len(plan), len(stretches), _notes(sources, len(stretches)))


def recorded_recipe(sources: Sequence[FramesWithPoses], name: str, *, labels: bool = True) -> Recipe:
    """Return the recipe of a data set of recorded frames.

    Raises:
        MitsonarError: there are no sources, their sonars or labels differ, frames occur twice, or heights are unknown.
    """
    # 1. Check that the sources fit together.
    if not sources:
        raise MitsonarError("a data set needs frames: give at least one run or recording")
    first = sources[0]
    for source in sources[1:]:
        differences = source.axes.differences_from(first.axes)
        if differences:
            raise MitsonarError(
                f"{source.name} has another sonar than {first.name}: {'; '.join(differences[:6])}; make a data set for each"
            )
    names = [source.name for source in sources]
    duplicates = [name for name in names if names.count(name) > 1]
    if duplicates:
        raise MitsonarError(f"{duplicates[0]} is given twice: its frames would be in both training and validation")
    _refuse_common_sequences(sources)
    if labels:
        _check_labels(sources)
    # 2. Derive mount and flight from the poses: median attitude, range of heights, largest motion between frames.
    stretches = [stretch for source in sources for stretch in source.stretches]
    poses = np.concatenate([stretch.poses for stretch in stretches])
    steps = np.abs(np.concatenate([motions(stretch.poses) for stretch in stretches]))
    sideways, forward, yaw = steps.max(axis=0).tolist() if len(steps) else (0.0, 0.0, 0.0)
    low, high = _heights(stretches)
    pitch, roll = (float(np.round(np.degrees(np.median(poses[:, axis])), 2)) for axis in (3, 4))
    has_floats = any(stretch.part.like.image.dtype != np.uint8 for stretch in stretches)
    raised_db = [source.raised_db + _noise_above_db(source.axes.sonar, first.axes.sonar) for source in sources]
    bearings = first.axes.bearing_rad
    return recipe_from(
        {
            "name": name,
            "about": f"frames of {len(sources)} runs, recordings or scenes of data sets, with known poses",
            "scenes": [{"sequences": len(source.stretches)} for source in sources],
            "sonar": first.axes.sonar.model_dump(mode="json"),
            "mount": {"pitch_deg": pitch, "roll_deg": roll},
            "flight": {
                "kind": "recorded",
                "height_m": [low, high],
                "sideways_mm": 1e3 * sideways,
                "forward_mm": 1e3 * forward,
                "yaw_deg": math.degrees(yaw),
                "jump_m": None,
            },
            "pixel": "float32" if has_floats else "uint8",
            **({"labels": list(first.labels)} if labels else {}),
            **({"visible_labels": True} if labels and _shows_visible(first) else {}),
            **({"noise_db": raised_db} if any(raised_db) else {}),
            **_sample_keys(sources),
            "recorded": {
                "level": first.axes.level,
                "bearings": None if bearings is None else bearings.tolist(),
                "sources": [_source_fields(source) for source in sources],
            },
        }
    )


def _noise_above_db(sonar: Sonar, other: Sonar) -> float:
    """Return by how much the noise of a sonar exceeds that of another [dB]; 0 if the model has no noise of its own."""
    if sonar.model != "coherent" or sonar.noise_level_db is None or other.noise_level_db is None:
        return 0.0
    return sonar.noise_level_db - other.noise_level_db


def _sample_keys(sources: Sequence[FramesWithPoses]) -> dict[str, Any]:
    """Return the keys ``split`` and ``frames``: those of the data sets if all agree, else by scene if there are several."""
    recipes = [source.recipe for source in sources]
    agreed = {
        key: values[0]
        for key in ("split", "frames")
        if len(values := [recipe.model_dump(mode="json")[key] for recipe in recipes if recipe is not None]) == len(sources)
        and all(value == values[0] for value in values)
    }
    worlds = {source.world or source.name for source in sources}
    by_scene = {"split": {"by": "scene", "train": 0.8, "validation": 0.2, "test": 0.0}} if len(worlds) > 1 else {}
    return by_scene | agreed


def _shows_visible(source: FramesWithPoses) -> bool:
    return source.recipe is not None and source.recipe.visible_labels


def _check_labels(sources: Sequence[FramesWithPoses]) -> None:
    """Check that all sources have the same labels, with the same meaning.

    Raises:
        MitsonarError: they differ.
    """
    first = sources[0]
    remedy = "give --no-labels to leave labels out, or make a data set for each"

    def shown_labels(source: FramesWithPoses) -> str:
        return f"the labels {', '.join(source.labels)}" if source.labels else "no labels"

    for source in sources[1:]:
        if set(source.labels) != set(first.labels):
            raise MitsonarError(
                f"{first.name} has {shown_labels(first)}, {source.name} has {shown_labels(source)}: {remedy}"
            )
        if not first.labels:
            continue
        if _shows_visible(source) != _shows_visible(first):
            names = (first.name, source.name) if _shows_visible(first) else (source.name, first.name)
            raise MitsonarError(f"the labels of {names[0]} are visible_labels, those of {names[1]} are not: {remedy}")
        if "shape_id" in first.labels and bool(source.shape_names) != bool(first.shape_names):
            names = (first.name, source.name) if first.shape_names else (source.name, first.name)
            raise MitsonarError(
                f"{names[0]} names its shapes and {names[1]} does not, so their shape_id cannot be compared: {remedy}"
            )


def _refuse_common_sequences(sources: Sequence[FramesWithPoses]) -> None:
    """Check that no sequence of a rendered world occurs in two sources, such as a data set and a longer one of its recipe.

    Raises:
        MitsonarError: one does.
    """
    known: dict[tuple[str, float, bytes], str] = {}
    for source in sources:
        for stretch in source.stretches if source.world else ():
            poses = hashlib.sha256(np.ascontiguousarray(stretch.poses).tobytes()).digest()
            name = known.setdefault((source.world, source.raised_db, poses), source.name)
            if name != source.name:
                raise MitsonarError(
                    f"{source.name} and {name} have a sequence in common, with the same world and poses: its frames would "
                    "be in both training and validation; give one of them, or make the other with another --seed"
                )


def _source_fields(source: FramesWithPoses) -> dict[str, str | int | float]:
    """Return the keys that describe a source in the recipe."""
    return {
        "name": source.name,
        "format": source.format,
        "poses": source.poses,
        "frames": len(source),
        "left_out": source.left_out,
        "level_scale": source.level_scale,
        "start_s": float(source.stretches[0].time_s[0]),
        **({"world": source.world} if source.world else {}),
    }


def _heights(stretches: Sequence[Stretch]) -> tuple[float, float]:
    """Return the lowest and the highest height above the ground [m], or above z = 0 if no frame has a height.

    Raises:
        MitsonarError: no frame has a height, and not all poses lie above z = 0.
    """
    height_m = np.concatenate([stretch.height_m for stretch in stretches])
    height_m = height_m[np.isfinite(height_m) & (height_m > 0)]
    if not height_m.size:
        height_m = np.concatenate([stretch.poses[:, 2] for stretch in stretches])
    if height_m.min() <= 0:
        raise MitsonarError("no frame has a height above the ground, and some poses are not above z = 0: give --height")
    return float(height_m.min()), float(height_m.max())


def _plan(sources: Sequence[FramesWithPoses]) -> Plan:
    """Return the plan of the data set: scenes, sequences, times, poses and motions of all frames in stored order."""
    stretches = [stretch for source in sources for stretch in source.stretches]
    counts = [len(stretch) for stretch in stretches]
    scene = [number for number, source in enumerate(sources) for _ in source.stretches]
    poses = np.concatenate([stretch.poses for stretch in stretches])
    nan = np.full((1, 3), np.nan)
    return Plan(
        scenes=[Scene(number, number, 0, len(source.stretches)) for number, source in enumerate(sources)],
        scene=np.repeat(scene, counts).astype(np.int32),
        sequence=np.repeat(np.arange(len(counts)), counts).astype(np.int32),
        time_s=np.concatenate([stretch.time_s - stretch.time_s[0] for stretch in stretches]),
        vehicle=poses * [1, 1, 1, 0, 0, 1],
        poses=poses,
        motion=np.concatenate([rows for stretch in stretches for rows in (motions(stretch.poses), nan)]),
        velocity=np.concatenate([velocities(Trajectory(stretch.poses, stretch.time_s)) for stretch in stretches]),
    )


def _shard_arrays(store: DataStore, sources: Sequence[FramesWithPoses], frame_slice: slice) -> dict[str, Values]:
    """Read the frames of a shard, and return their stored arrays, keyed by name."""
    images, heights, first = [], [], 0
    label_maps: dict[str, list[Values]] = {name: [] for name in store.recipe.labels}
    for source, stretch in ((one, stretch) for one in sources for stretch in one.stretches):
        overlap = slice(max(frame_slice.start - first, 0), min(frame_slice.stop - first, len(stretch)))
        if overlap.start < overlap.stop:
            frames = stretch.read(overlap)
            images.append(as_pixels(frames.image, store.recipe.pixel, f"frame {first + overlap.start} and those after it"))
            heights.append(stretch.height_m[overlap])
            for name, maps in label_maps.items():
                maps.append(_label_values(frames, name, source))
        first += len(stretch)
    image = np.concatenate(images)
    full_scale = 255 if store.recipe.pixel == "uint8" else 1
    return {
        "image": image,
        "height_m": np.concatenate(heights),
        "dropped": np.zeros(len(image), dtype=np.uint32),
        "saturated": (image == full_scale).sum(axis=(1, 2), dtype=np.uint32),
        **{name: np.concatenate(maps) for name, maps in label_maps.items()},
    }


def _label_values(frames: SonarFrames, name: str, source: FramesWithPoses) -> Values:
    """Return a label of frames ``(frames, bins, beams)``.

    Raises:
        MitsonarError: the label is missing, or names a shape that does not exist.
    """
    values = getattr(frames, name)
    if values is None:
        raise MitsonarError(f"some frames of {source.name} have no {name}: give --no-labels to leave labels out")
    highest = len(source.shape_names) - 1 if source.shape_names else np.inf
    if name == "shape_id" and values.size and not (values.min() >= -1 and values.max() <= highest):
        raise MitsonarError(
            f"shape_id of {source.name} must lie in -1..{highest}: got {values.min()}..{values.max()}; it is damaged"
        )
    return np.asarray(values)


def _notes(sources: Sequence[FramesWithPoses], sequences: int) -> list[str]:
    """Return notes for the user, one sentence each."""
    notes = [f"{source.name}: {note}" for source in sources for note in source.notes]
    notes += [
        f"{source.name}: left out: {count_noun(source.left_out, 'frame')} without pose or neighbour, "
        "or with another geometry"
        for source in sources
        if source.left_out
    ]
    scales = np.array([source.level_scale for source in sources])
    if np.ptp(scales) > GAIN_TOLERANCE * scales.max():
        notes.append(
            f"the gains of the files differ (levels of a pixel of 1 from {scales.min():.3g} to {scales.max():.3g}): pixels "
            "are unchanged, and levels are comparable only within a file"
        )
    if not all(np.isfinite(stretch.height_m).all() for source in sources for stretch in source.stretches):
        notes.append("not all frames have a height above the ground, which most estimators need: give --height")
    if sequences == 1:
        notes.append(
            "one sequence cannot be split: read it with `--part all`, or cut it with --cut to train on some sequences and "
            "validate on others"
        )
    return notes
