"""How do pictures become a recording? Folders (PNG, JPEG, PGM), stacks (``.npz``) and videos, with a geometry file."""

from __future__ import annotations

import math
import os
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import csr_array, vstack

from mitsonar.errors import MitsonarError, count_noun, missing_package_error
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.files import FileArray, read_bytes, read_npz
from mitsonar.io.runs import RunDirectory, RunKind
from mitsonar.recordings.picture_geometry import (
    ANY_ELEVATION_DEG,
    ANY_RATE_HZ,
    SEE,
    PictureGeometry,
    doubts,
    find_geometry_file,
    load_geometry,
)
from mitsonar.recordings.recording import ELEVATION_PATTERN, Facts, Part, Pixels, Recording, in_time_order
from mitsonar.records.frames import MAX_NPZ_FRAMES, FrameStore, SonarFrames

__all__ = [
    "CONVERSION",
    "SUFFIXES",
    "FanSampler",
    "Grey",
    "Pictures",
    "geometry_for",
    "holds_pictures",
    "is_complete",
    "is_picture_stack",
    "is_video",
    "natural_key",
    "picture_paths",
    "picture_size",
    "polar_frames",
    "read_picture",
    "read_picture_folder",
    "read_picture_stack",
    "read_picture_video",
    "recording_of",
    "refuse_size",
    "times_in_names",
    "write_frames",
]


Grey = NDArray[np.generic]
"""Grey values ``(rows, columns)``: uint8 in 0..255, or float32 in 0..1."""

SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm")
"""Suffixes of picture files."""

FORMATS = ("PNG", "JPEG", "PPM")
"""Formats that Pillow may detect, whatever the suffix of a file."""

MAX_PIXELS = 2**25
"""Maximum number of pixels of a picture."""

PNG, END_OF_PNG = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
"""First and last bytes of a PNG file."""


def picture_size(path: Path) -> tuple[int, int]:
    """Return the number of rows and columns of a picture from its header, without decoding it.

    Raises:
        MitsonarError: if the file is not a picture, or is larger than any sonar picture.
    """
    with _opened(path) as picture:
        columns, rows = picture.size
    refuse_size(rows, columns, str(path))
    return rows, columns


def refuse_size(rows: int, columns: int, source: str) -> None:
    """Raise an error if pictures are larger than any sonar picture, or have a single row or column.

    Raises:
        MitsonarError: if the size is not that of a sonar picture.
    """
    if rows * columns > MAX_PIXELS or min(rows, columns) < 2:
        raise MitsonarError(
            f"{source} has {columns:,} x {rows:,} pixels; pictures of sonars have at least 2 x 2, and at most "
            f"{MAX_PIXELS:,} in all: it is damaged, or not a sonar picture"
        )


def is_complete(path: Path) -> bool:
    """Return whether a path is a file that is not obviously truncated.

    A PNG file must have its final chunk; any other file must not be empty.
    """
    if not os.path.isfile(path):  # reading a pipe would never end
        return False
    try:
        with path.open("rb") as file:
            if file.read(len(PNG)) != PNG:
                return path.stat().st_size > 0
            file.seek(0, 2)
            file.seek(max(0, file.tell() - 64))
            return END_OF_PNG in file.read()
    except OSError:
        return False


def read_picture(path: Path, shape: tuple[int, int]) -> Grey:
    """Read the grey values of a picture; colours are converted to luminance.

    Args:
        path: path of the file.
        shape: number of rows and columns that it must have.

    Returns:
        Values ``(rows, columns)``: uint8 in 0..255, or float32 in 0..1 if the picture has 16 bits per value.

    Raises:
        MitsonarError: if the picture is not complete, or has another size.
    """
    rows, columns = picture_size(path)
    if (rows, columns) != shape:
        raise MitsonarError(f"{path} has {columns:,} x {rows:,} pixels, the others {shape[1]:,} x {shape[0]:,}: remove it")
    with _opened(path) as picture:
        try:
            if picture.mode.startswith("I"):
                return np.asarray(np.clip(np.asarray(picture, dtype=np.float32) / 65535, 0, 1), dtype=np.float32)
            return np.array(picture.convert("L"), dtype=np.uint8)
        except Exception as error:  # damaged bytes raise errors of many kinds
            raise MitsonarError(
                f"cannot read the picture {path}: {' '.join(str(error).split())[:160]}; it is damaged: remove it"
            ) from None


def _opened(path: Path) -> Image.Image:
    """Open a picture, reading only its header."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            return Image.open(path, formats=FORMATS)
    except FileNotFoundError:
        raise MitsonarError(f"no such file: {path}") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise MitsonarError(
            f"{path} has more pixels than any picture of a sonar, {MAX_PIXELS:,}, according to its header: it is damaged"
        ) from None
    except Exception as error:  # damaged bytes raise errors of many kinds
        reason = " ".join(str(error).split())[:160]
        raise MitsonarError(f"cannot read the picture {path}: {reason}; give PNG, JPEG or PGM") from None


# ---------------- Folders of pictures


Array = NDArray[np.float64]

EPOCH_S = (946_684_800, 4_102_444_800)
"""Range of times that are recognised in names: 2000 to 2100 [s since 1970]."""

TIMES_IN_NAMES = (
    (re.compile(r"(?<!\d)(\d{19})(?!\d)"), 1e-9),
    (re.compile(r"(?<!\d)(\d{16})(?!\d)"), 1e-6),
    (re.compile(r"(?<!\d)(\d{13})(?!\d)"), 1e-3),
    (re.compile(r"(?<!\d)(\d{10})(?!\d)"), 1.0),
)
"""Patterns of whole numbers that look like times, and the unit of each [s]."""

SPLIT_TIME = re.compile(r"(?<!\d)(\d{10})[._](\d{1,9})(?!\d)")
"""Pattern of seconds and their decimals; after ``_`` come nanoseconds, as ROS writes them."""

MAX_PICTURES = 2_000_000
"""Maximum number of pictures in a folder, or of frames in a video."""


def holds_pictures(path: Path, first: bytes) -> bool:
    """Return whether a path is a folder of pictures, and not the folder of a run."""
    if first or not path.is_dir() or any((path / name).exists() for name in ("run.json", "zarr.json", "frames.npz")):
        return False
    try:
        return any(one.suffix.lower() in SUFFIXES for one in path.iterdir())
    except OSError:
        return False


def read_picture_folder(path: Path, geometry: Path | None = None) -> Recording:
    """Open a folder of pictures of one size; they are read on demand.

    Pictures are sorted natural_key. Their times are taken from their names if these look like times.

    Args:
        path: path of the folder.
        geometry: a geometry file; default: ``geometry.yaml`` in the folder or next to it.

    Raises:
        MitsonarError: if there is no geometry or no readable picture, or if the geometry does not fit the pictures.
    """
    picture_geometry, geometry_path = geometry_for(path, geometry)
    files, shape, notes = _select_one_size(picture_paths(path), path)
    names = tuple(file.name for file in files)
    first = read_picture(files[0], shape)
    if _has_colours(files[0]):
        notes.append(
            "the pictures have colours: their luminance is read, which is not a level if the colours are a colour scale"
        )
    bits = 8 if first.dtype == np.uint8 else 16

    def read(place: int) -> Grey:
        return read_picture(files[place], shape)

    pictures = Pictures(
        path,
        "folder of pictures",
        shape,
        names,
        read,
        times_in_names(names),
        numbers=_numbers(names),
        facts={"bits": bits},
        notes=tuple(notes),
    )
    return recording_of(pictures, picture_geometry, geometry_path)


def picture_paths(folder: Path) -> list[Path]:
    """Return the picture files of a folder in natural order.

    Raises:
        MitsonarError: if the folder cannot be read, or holds too many pictures.
    """
    try:
        pictures = [one for one in folder.iterdir() if one.suffix.lower() in SUFFIXES and not one.name.startswith(".")]
    except OSError as error:
        raise MitsonarError(f"cannot read the folder {folder}: {error.strerror}") from None
    if len(pictures) > MAX_PICTURES:
        raise MitsonarError(f"{folder} holds {len(pictures):,} pictures, more than {MAX_PICTURES:,}: split it")
    return sorted(pictures, key=lambda one: natural_key(one.name))


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key that puts names in natural order: ``f2`` before ``f10``."""
    parts = re.split(r"(\d+)", name)
    return tuple((0, int(part)) if place % 2 else (1, part.lower()) for place, part in enumerate(parts))


def times_in_names(names: Sequence[str]) -> Array | None:
    """Return the times ``(names,)`` [s since 1970] that names contain; None if a name contains none.

    The number of digits decides whether a time is in nanoseconds, microseconds, milliseconds or seconds. Seconds may also
    have decimals, or be followed by ``_`` and nanoseconds. Only times from 2000 to 2100 are accepted.
    """
    if not names:
        return None
    split_matches = [SPLIT_TIME.search(name) for name in names]
    if all(split_matches):
        groups = [one.groups() for one in split_matches if one is not None]
        decimals = [name[one.end(1)] == "." for name, one in zip(names, split_matches, strict=True) if one is not None]
        times = [
            float(f"{whole}.{rest}") if point else int(whole) + int(rest) * 1e-9
            for (whole, rest), point in zip(groups, decimals, strict=True)
        ]
        return _times_if_plausible(np.array(times))
    for pattern, unit in TIMES_IN_NAMES:
        matches = [pattern.search(name) for name in names]
        if all(matches):
            return _times_if_plausible(np.array([int(one[1]) for one in matches if one is not None]) * unit)
    return None


def _times_if_plausible(times: Array) -> Array | None:
    return times if ((times >= EPOCH_S[0]) & (times <= EPOCH_S[1])).all() else None


def _numbers(names: Sequence[str]) -> Array | None:
    """Return the last number in each name ``(names,)``, in units of the smallest step; None if they do not increase."""
    digits = [re.findall(r"\d{1,15}", Path(name).stem) for name in names]
    if not all(digits):
        return None
    numbers = np.array([float(one[-1]) for one in digits])
    steps = np.diff(numbers)
    return numbers / steps.min() if len(steps) and steps.min() > 0 else None


def _select_one_size(files: list[Path], folder: Path) -> tuple[list[Path], tuple[int, int], list[str]]:
    """Return the complete pictures of the most frequent size, that size, and sentences on the others."""
    complete = [file for file in files if is_complete(file)]
    sizes: dict[Path, tuple[int, int]] = {}
    reason = ""
    for file in complete:
        try:
            sizes[file] = picture_size(file)
        except MitsonarError as error:
            reason = reason or str(error)
    if not sizes:
        raise MitsonarError(reason or f"{folder} holds no complete picture: all are empty or cut off")
    shape = Counter(sizes.values()).most_common(1)[0][0]
    same_size = [file for file, size in sizes.items() if size == shape]
    notes = []
    if len(sizes) < len(files):
        notes.append(f"left out: {count_noun(len(files) - len(sizes), 'picture')} cut off or damaged")
    if len(same_size) < len(sizes):
        others = len(sizes) - len(same_size)
        notes.append(f"left out: {count_noun(others, 'picture')} of another size than {shape[1]:,} x {shape[0]:,} pixels")
    return same_size, shape, notes


def _has_colours(path: Path) -> bool:
    """Return whether a picture has colours other than grey."""
    from PIL import Image

    with Image.open(path) as picture:
        if picture.mode not in ("RGB", "RGBA", "P"):
            return False
        red, green, blue = (np.asarray(one, dtype=int) for one in picture.convert("RGB").split())
    return bool(max(abs(red - green).max(), abs(green - blue).max()) > 8)


# ---------------- Stacks of pictures (.npz)


NAMES = ("frames", "images")
"""Possible names of the array of pictures."""

TIME_ARRAYS = ("time_s", "times", "timestamps")
RATES = ("fps", "frame_rate_hz")
"""Possible names of the arrays of times [s] and of the frame rate [Hz]."""

FAN = {"apex_xy": "apex_px", "rmin_px": "near_px", "rmax_px": "far_px", "half_fov_deg": "half_angle_deg", "kx": "stretch"}
"""Arrays that describe the geometry of a fan, and the corresponding keys of a geometry file."""


def is_picture_stack(path: Path, first: bytes) -> bool:
    """Return whether a file is an npz file of pictures, and not one of mitsonar frames."""
    if not first.startswith(b"PK") or path.suffix.lower() != ".npz":
        return False
    try:
        with zipfile.ZipFile(path) as file:
            names = {name.removesuffix(".npy") for name in file.namelist()}
    except Exception:  # damaged bytes raise errors of many kinds
        return False
    return bool(names & set(NAMES)) and not {"image", "sonar"} <= names


def read_picture_stack(path: Path, geometry: Path | None = None) -> Recording:
    """Open an npz file of pictures ``(pictures, rows, columns)``: uint8, or floats in 0..1.

    Args:
        path: path of the file. Pictures are in the array ``frames`` or ``images``. Without a geometry file, the arrays
            ``apex_xy``, ``rmin_px``, ``rmax_px``, ``half_fov_deg`` and ``kx`` (optional) describe a fan of unknown metric
            scale. The array ``fps`` or ``time_s`` determines the times.
        geometry: a geometry file; default: ``FILE.yaml`` or ``geometry.yaml`` next to the file.

    Raises:
        MitsonarError: if the file is damaged, or holds no pictures, or if there is no geometry.
    """
    try:
        table = read_npz(path)
    except MitsonarError:
        raise
    except Exception as error:  # damaged bytes raise errors of many kinds
        raise MitsonarError(f"cannot read {path}: {' '.join(str(error).split())[:200]}; it is damaged") from None
    name = next(one for one in NAMES if one in table)
    stack = _stack(table[name], f"{name} of {path}")
    picture_geometry, geometry_path = geometry_for(path, geometry, _geometry_in_arrays(table, path))
    times = next((table[one] for one in TIME_ARRAYS if one in table and table[one].shape == (len(stack),)), None)
    rate = next((_number(table[one], one, path) for one in RATES if one in table), None)

    def read(place: int) -> Grey:
        return np.asarray(stack[place])

    pictures = Pictures(
        path,
        "stack of pictures (.npz)",
        (stack.shape[1], stack.shape[2]),
        tuple(str(number) for number in range(len(stack))),
        read,
        None if times is None else np.asarray(times, dtype=float),
        rate_hz=rate,
        facts={"values": str(stack.dtype)},
    )
    return recording_of(pictures, picture_geometry, geometry_path)


def _stack(values: FileArray, what: str) -> Grey:
    """Validate pictures and return them as uint8, or as float32 in 0..1."""
    if values.ndim != 3 or not len(values) or values.dtype.kind not in "uf":
        raise MitsonarError(f"{what} must be pictures (pictures, rows, columns), uint8 or floats: got {values.shape}")
    refuse_size(values.shape[1], values.shape[2], what)
    if values.dtype == np.uint8:
        return values
    if values.dtype == np.uint16:
        return np.asarray(values / np.float32(65535), dtype=np.float32)
    if values.dtype.kind == "u" or not np.isfinite(values).all() or values.min() < 0 or values.max() > 1 + 1e-5:
        raise MitsonarError(f"{what} must be uint8, uint16, or floats in 0..1: divide them by their largest value")
    return values.astype(np.float32)


def _geometry_in_arrays(table: dict[str, FileArray], path: Path) -> PictureGeometry | None:
    """Return the geometry described by the arrays of the file; None if they do not describe one."""
    if not set(FAN) - {"kx"} <= set(table):
        return None
    apex = np.asarray(table["apex_xy"])
    if apex.shape != (2,) or apex.dtype.kind not in "iuf" or not np.isfinite(apex).all():
        raise MitsonarError(f"apex_xy of {path} must be two numbers: column and row of the apex")
    numbers = {key: _number(table[name], name, path) for name, key in FAN.items() if name in table and name != "apex_xy"}
    return PictureGeometry.create(
        layout="fan", apex_px=(float(apex[0]), float(apex[1])), scale_known=False, name=path.stem[:200], **numbers
    )


def _number(values: FileArray, name: str, path: Path) -> float:
    """Return the only element of an array, which must be a finite number."""
    if values.size != 1 or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise MitsonarError(f"{name} of {path} must be one number: got shape {values.shape}")
    return float(values.reshape(()))


# ---------------- Videos (.avi, .mp4)


def is_video(path: Path, first: bytes) -> bool:
    """Return whether the first bytes of a file are those of an AVI or MP4 video."""
    return (first[:4] == b"RIFF" and first[8:12] == b"AVI ") or first[4:8] == b"ftyp"


def read_picture_video(path: Path, geometry: Path | None = None) -> Recording:
    """Open a video of fans or polar pictures; OpenCV counts its frames once, and decodes them on demand.

    Args:
        path: path of the video. Its nominal frame rate is used if the geometry gives none.
        geometry: a geometry file; default: ``FILE.yaml`` or ``geometry.yaml`` next to the video.

    Raises:
        MitsonarError: if OpenCV is not installed, the video is damaged, or there is no geometry.
    """
    picture_geometry, geometry_path = geometry_for(path, geometry)
    video = _Video(path)
    count, rate = video.count(), video.rate_hz
    pictures = Pictures(
        path,
        f"video ({path.suffix.lower() or 'no ending'})",
        video.shape,
        tuple(str(number) for number in range(count)),
        video.read,
        rate_hz=rate,
        facts={} if rate is None else {"nominal_rate_hz": rate},
    )
    return recording_of(pictures, picture_geometry, geometry_path)


class _Video:
    """A video that is decoded forwards; reading an earlier frame restarts from the beginning."""

    def __init__(self, path: Path) -> None:
        try:
            import cv2
        except ModuleNotFoundError as error:
            raise missing_package_error(error) from None
        self.cv2, self.path = cv2, path
        self.capture: Any = None
        self.position = 0
        self._begin()
        opened: Any = self.capture
        rows, columns = (int(opened.get(one)) for one in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH))
        refuse_size(rows, columns, str(path))
        rate = float(opened.get(cv2.CAP_PROP_FPS))
        self.shape, self.rate_hz = (rows, columns), rate if np.isfinite(rate) and 0 < rate < 1e4 else None

    def _begin(self) -> None:
        """Open the video, or reopen it, at its first frame."""
        if self.capture is not None:
            self.capture.release()
        self.capture = self.cv2.VideoCapture(str(self.path))
        self.position = 0
        if not self.capture.isOpened():
            raise MitsonarError(f"OpenCV cannot open the video {self.path}: it is damaged, or its codec is not available")

    def count(self) -> int:
        """Return the number of frames that can be decoded; the number in the header is unreliable."""
        while self.capture.grab():
            self.position += 1
            if self.position > MAX_PICTURES:
                raise MitsonarError(f"{self.path} holds more than {MAX_PICTURES:,} frames: cut it")
        count = self.position
        self._begin()
        if not count:
            raise MitsonarError(f"{self.path} holds no frame that can be decoded: it is damaged")
        return count

    def read(self, place: int) -> Grey:
        """Decode the frame with this index ``(rows, columns)`` as uint8; colours are converted to luminance."""
        if place < self.position:
            self._begin()
        while self.position < place:
            if not self.capture.grab():
                break
            self.position += 1
        decoded, picture = self.capture.read()
        self.position += 1
        if not decoded or picture.shape[:2] != self.shape:
            raise MitsonarError(f"frame {place:,} of {self.path} cannot be decoded: the video is damaged")
        grey: Grey = self.cv2.cvtColor(picture, self.cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
        return np.asarray(grey, dtype=np.uint8)


# ---------------- Resampling of fans to beams and bins


Doubles = NDArray[np.float64]

MAX_WEIGHTS = 2**25
"""Maximum number of weights of a sampler: a quarter of a GiB."""

MAX_BEAMS = 1024
"""Maximum number of beams if the geometry gives none."""

WEIGHTS_PER_BLOCK = 2**20
"""Number of weights that are computed at a time."""


@dataclass(frozen=True)
class FanSampler:
    """A linear map from a fan picture to beams and bins; each cell is the mean of its area in the picture.

    Attributes:
        weights: weights of the pixels in each cell ``(bins * beams, rows * columns)`` float32. The row of a cell inside the
            picture sums to 1, that of any other cell is empty.
        bins: number of range bins.
        beams: number of beams.
    """

    weights: csr_array
    bins: int
    beams: int

    @classmethod
    def from_geometry(cls, geometry: PictureGeometry, rows: int, columns: int) -> FanSampler:
        """Build the map for pictures ``(rows, columns)``.

        Evenly spaced points cover each cell, about one per pixel along range and across. Each point reads the picture by
        bilinear interpolation, so that a cell smaller than a pixel is interpolated and a larger one is averaged. Averages
        are taken over picture values, and so over dB if the picture shows dB.

        Raises:
            MitsonarError: if the fan lies outside the picture, or the map takes too much memory.
        """
        # 1. Choose the number of points per cell by its largest size in pixels, at the far arc.
        bins, beams = cell_counts(geometry)
        half = math.radians(float(geometry.half_angle_deg or 0.0))
        step = (geometry.far - geometry.near) / bins
        width = 2 * half / beams * geometry.far / max(1.0, geometry.stretch)
        across, along = (max(1, math.ceil(size - 1e-6)) for size in (width, step))
        count = bins * beams * across * along * 4
        if count > MAX_WEIGHTS:
            raise MitsonarError(
                f"a fan of {bins:,} bins and {beams:,} beams takes {count:,} weights: {MAX_WEIGHTS:,} at most; give "
                "smaller bins and beams in the geometry"
            )
        # 2. Place the points at the centres of equal subdivisions of range and angle.
        radius = geometry.near + (np.arange(bins * along) + 0.5) * (step / along)
        angle = -half + (np.arange(beams * across) + 0.5) * (2 * half / (beams * across))
        # 3. Compute the weights of some range bins at a time, which limits the memory for intermediate arrays.
        blocks = []
        bins_per_block = max(1, WEIGHTS_PER_BLOCK // (beams * across * along * 4))
        for first in range(0, bins, bins_per_block):
            block_radius = radius[first * along : (first + bins_per_block) * along].astype(float)
            blocks.append(_weights(geometry, block_radius, angle.astype(float), (along, across), (rows, columns)))
        weights = vstack(blocks, format="csr")
        if not weights.nnz:
            raise MitsonarError(
                f"the fan of the geometry lies outside the pictures of {columns:,} x {rows:,} pixels: check apex_px, "
                "near_px, far_px and forward"
            )
        return cls(weights, bins, beams)

    def apply(self, picture: NDArray[np.generic]) -> NDArray[np.float32]:
        """Resample a picture ``(rows, columns)`` to ``(bins, beams)`` float32 in 0..1; cells outside the picture are 0.

        Pictures are uint8 in 0..255, or float32 in 0..1.
        """
        values = np.ravel(picture).astype(np.float32)
        if picture.dtype == np.uint8:
            values *= np.float32(1 / 255)
        sampled = np.minimum(self.weights @ values, np.float32(1))  # rounded weights may sum to slightly more than 1
        return np.asarray(sampled, dtype=np.float32).reshape(self.bins, self.beams)


def cell_counts(geometry: PictureGeometry) -> tuple[int, int]:
    """Return the number of bins and beams of a fan: as given, or about one per pixel (beams: at mid range)."""
    bins = geometry.bins or max(2, round(geometry.far - geometry.near))
    half = math.radians(float(geometry.half_angle_deg or 0.0))
    arc = (geometry.near + geometry.far) / 2 * 2 * half / max(1.0, geometry.stretch)
    return bins, geometry.beams or int(np.clip(round(arc), 2, MAX_BEAMS))


def _weights(
    geometry: PictureGeometry, radius: Doubles, angle: Doubles, points: tuple[int, int], shape: tuple[int, int]
) -> csr_array:
    """Return the weights of some bins.

    Args:
        geometry: geometry of the fan.
        radius: distances of the points from the apex ``(bins * points[0],)`` [px].
        angle: angles of the points ``(beams * points[1],)`` [rad], from port to starboard.
        points: number of points of a cell along range and across.
        shape: number of rows and columns of the picture.
    """
    # 1. Locate the points in the picture: column u, row v.
    rows, columns = shape
    column, row = geometry.apex_px or (0.0, 0.0)
    sideways = (-1.0 if geometry.mirror else 1.0) / geometry.stretch
    u = column + sideways * radius[:, None] * np.sin(angle)
    v = row - (1.0 if geometry.forward == "up" else -1.0) * radius[:, None] * np.cos(angle)
    # 2. Find the cell of each point, and keep the points that lie on a pixel of the picture.
    cell = np.arange(len(radius))[:, None] // points[0] * (len(angle) // points[1]) + np.arange(len(angle)) // points[1]
    inside = ((u >= -0.5) & (u <= columns - 0.5) & (v >= -0.5) & (v <= rows - 0.5)).ravel()
    u, v = (np.clip(axis.ravel()[inside], 0, most) for axis, most in ((u, columns - 1), (v, rows - 1)))
    # 3. Compute the bilinear weights of the four pixels around each point.
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    over, below = u - left, v - top
    pixels, parts = [], []
    for down in (0, 1):
        for right in (0, 1):
            pixels.append(np.minimum(top + down, rows - 1) * columns + np.minimum(left + right, columns - 1))
            parts.append((below if down else 1 - below) * (over if right else 1 - over))
    # 4. Sum the weights of a cell's points (csr_array adds up duplicates), and normalise each row to 1. Cells that are
    #    partly outside the picture become the mean of the part inside, and cells fully outside keep an empty row.
    cells = len(radius) // points[0] * (len(angle) // points[1])
    index = np.tile(cell.ravel()[inside], 4)
    weights = csr_array((np.concatenate(parts), (index, np.concatenate(pixels))), shape=(cells, rows * columns))
    total = weights.sum(axis=1)
    scale = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0)
    weights.data *= np.repeat(scale, np.diff(weights.indptr))
    weights.eliminate_zeros()
    return weights.astype(np.float32)


# ---------------- Recording of a sequence of pictures


OUTLINE_PICTURES = 16
"""Maximum number of pictures from which the outline of a fan is determined."""

MAX_TIMES_BYTES = 2**26
"""Maximum size of a file of times [bytes]."""


@dataclass(frozen=True)
class Pictures:
    """Pictures of one size, in the order of the file or folder.

    Attributes:
        source: path of the file or folder.
        format: readable name of the format.
        shape: number of rows and columns of each picture.
        names: names of the pictures, for messages and files of times.
        read: function that reads the picture with a given index.
        time_s: time of each picture ``(pictures,)`` [s], if known.
        rate_hz: frame rate [Hz], if the file holds one.
        numbers: number in the name of each picture ``(pictures,)``, if known.
        facts: values that the file holds, keyed by name.
        notes: sentences on what was left out.
    """

    source: Path
    format: str
    shape: tuple[int, int]
    names: tuple[str, ...]
    read: Callable[[int], Grey]
    time_s: Array | None = None
    rate_hz: float | None = None
    numbers: Array | None = None
    facts: Facts = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def geometry_for(source: Path, geometry: Path | None, inside: PictureGeometry | None = None) -> tuple[PictureGeometry, Path]:
    """Return the geometry of pictures and the path of its file.

    Args:
        source: path of the pictures.
        geometry: a geometry file; default: the one next to the pictures.
        inside: geometry contained in the file of the pictures, which is used if there is no geometry file.

    Raises:
        MitsonarError: if there is no geometry, or the geometry file is damaged.
    """
    geometry_path = geometry or find_geometry_file(source)
    if geometry_path is not None:
        return load_geometry(geometry_path), geometry_path
    if inside is None:
        raise MitsonarError(
            f"{source} holds pictures without their geometry: give a geometry file (--geometry FILE), or put geometry.yaml "
            f"next to them{SEE}"
        )
    return inside, source


def recording_of(pictures: Pictures, geometry: PictureGeometry, geometry_path: Path) -> Recording:
    """Create a recording of pictures; polar pictures are reordered, fans are resampled to beams and bins.

    Args:
        pictures: pictures in the order of their source.
        geometry: geometry that they share.
        geometry_path: file of the geometry; the path of a file of times is relative to its folder.

    Raises:
        MitsonarError: if the geometry does not fit the pictures, or times cannot be read.
    """
    times, notes = _times(pictures, geometry, geometry_path)
    order, sorting = in_time_order(times, pictures.numbers)
    rate = _rate(times[order], geometry)
    notes = [*pictures.notes, *notes, *sorting, *geometry.notes()]
    images: _Polar | _Fan
    if geometry.layout == "polar":
        shape = pictures.shape[::-1] if geometry.transposed else pictures.shape
        images, like = _Polar(pictures, order, geometry), polar_frames(geometry, *shape, rate)
    else:
        sampler = FanSampler.from_geometry(geometry, *pictures.shape)
        images = _Fan(pictures, order, sampler)
        like = _fan_frames(geometry, sampler, rate)
        sample = np.unique(np.linspace(0, len(order) - 1, OUTLINE_PICTURES).astype(np.intp)) if len(order) else order
        if len(sample):
            notes += doubts(geometry, np.max([_bytes(pictures.read(int(place))) for place in order[sample]], axis=0))
    height_m = None if geometry.height_m is None else np.full(len(order), geometry.height_m)
    part = Part(like, times[order], images, attitude_rad=_fixed_attitude(geometry, len(order)), height_m=height_m)
    facts: Facts = {"pictures": len(pictures.names), "rows": pictures.shape[0], "columns": pictures.shape[1]}
    facts |= {"layout": geometry.layout, "geometry": str(geometry_path)} | pictures.facts
    return Recording(str(pictures.source), pictures.format, (part,), facts, tuple(notes))


def polar_frames(geometry: PictureGeometry, bins: int, beams: int, rate_hz: float) -> SonarFrames:
    """Return empty frames with the geometry of polar pictures: sonar, ranges [m], and bearings [rad] from port to starboard.

    Raises:
        MitsonarError: if the number of bearings is not that of beams, or the parameters of the sonar are invalid.
    """
    if geometry.bearings_deg is None:
        sonar = _sonar(geometry, bins, beams, float(geometry.azimuth_fov_deg or 0.0), rate_hz)
        return _empty_frames(geometry, sonar, sonar.bearing_rad)
    if len(geometry.bearings_deg) != beams:
        raise MitsonarError(
            f"the geometry has {len(geometry.bearings_deg):,} bearings_deg, and the pictures have {beams:,} beams: give "
            "one per beam"
        )
    bearings = np.sort(np.radians(geometry.bearings_deg))
    fov = min(360.0, math.degrees(bearings[-1] - bearings[0]) * beams / (beams - 1))
    return _empty_frames(geometry, _sonar(geometry, bins, beams, fov, rate_hz), bearings)


def _fan_frames(geometry: PictureGeometry, sampler: FanSampler, rate_hz: float) -> SonarFrames:
    """Return empty frames with the geometry of resampled fans."""
    sonar = _sonar(geometry, sampler.bins, sampler.beams, 2 * float(geometry.half_angle_deg or 0.0), rate_hz)
    return _empty_frames(geometry, sonar, sonar.bearing_rad)


def _sonar(geometry: PictureGeometry, bins: int, beams: int, fov_deg: float, rate_hz: float) -> Sonar:
    near, far = geometry.window_m
    return Sonar.create(
        name=geometry.name,
        azimuth_fov_deg=fov_deg,
        elevation_fov_deg=geometry.elevation_fov_deg or ANY_ELEVATION_DEG,
        elevation_pattern=ELEVATION_PATTERN,
        beams=beams,
        range_min=near,
        range_max=far,
        range_bins=bins,
        sound_speed=geometry.sound_speed,
        bearing=geometry.bearing_of(fov_deg / 2),
        beam_layout=geometry.beam_layout,
        frequency_hz=geometry.frequency_hz,
        frame_rate_hz=rate_hz,
        coding=geometry.level or "linear",
        coding_db=geometry.coding_db,
        coding_gamma=geometry.coding_gamma,
    )


def _empty_frames(geometry: PictureGeometry, sonar: Sonar, bearing_rad: Array) -> SonarFrames:
    return SonarFrames(
        image=np.zeros((0, sonar.range_bins, sonar.beams), np.uint8),
        range_m=sonar.range_m,
        bearing_rad=bearing_rad,
        time_s=np.zeros(0),
        sonar=sonar,
        level=geometry.level or "linear",
    )


@dataclass(frozen=True)
class _Polar:
    """Function that reads the images of a part of polar pictures."""

    pictures: Pictures
    places: NDArray[np.intp]
    geometry: PictureGeometry

    def __call__(self, index: NDArray[np.intp]) -> Pixels:
        """Return images ``(n, bins, beams)``, row 0 nearest, column 0 farthest to port."""
        transposed = self.geometry.transposed
        shape = self.pictures.shape[::-1] if transposed else self.pictures.shape
        images = [self.pictures.read(int(place)) for place in self.places[index]]
        stacked = np.stack([one.T if transposed else one for one in images]) if images else np.zeros((0, *shape), np.uint8)
        rows = slice(None, None, 1 if self.geometry.rows == "near-to-far" else -1)
        bearings_deg = self.geometry.bearings_deg
        flipped = self.geometry.mirror if bearings_deg is None else bearings_deg[0] > bearings_deg[-1]
        return stacked[:, rows, :: -1 if flipped else 1]


@dataclass(frozen=True)
class _Fan:
    """Function that reads the images of a part of fans, resampled to beams and bins."""

    pictures: Pictures
    places: NDArray[np.intp]
    sampler: FanSampler

    def __call__(self, index: NDArray[np.intp]) -> Pixels:
        """Return images ``(n, bins, beams)`` float32, row 0 nearest, column 0 farthest to port."""
        images = np.zeros((len(index), self.sampler.bins, self.sampler.beams), np.float32)
        for place, number in enumerate(self.places[index]):
            images[place] = self.sampler.apply(self.pictures.read(int(number)))
        return images


def _bytes(picture: Grey) -> Grey:
    """Return a picture as uint8 in 0..255."""
    return picture if picture.dtype == np.uint8 else np.asarray(np.clip(picture, 0, 1) * 255, dtype=np.uint8)


def _times(pictures: Pictures, geometry: PictureGeometry, geometry_path: Path) -> tuple[Array, list[str]]:
    """Return the times of the pictures ``(pictures,)`` [s], and sentences on what is assumed."""
    if geometry.times is not None:
        return _read_times(geometry_path.parent / geometry.times, pictures.names), []
    if pictures.time_s is not None:
        return pictures.time_s, []
    rate = geometry.frame_rate_hz or pictures.rate_hz
    assumed = [] if rate else [f"the times of the pictures are unknown: {ANY_RATE_HZ:g} per second are assumed"]
    steps = (
        np.arange(len(pictures.names), dtype=float) if pictures.numbers is None else pictures.numbers - pictures.numbers[0]
    )
    return steps / (rate or ANY_RATE_HZ), assumed


def _read_times(path: Path, names: tuple[str, ...]) -> Array:
    """Read a file of times: one line ``TIME`` per picture in order, or lines ``NAME, TIME``; ``#`` begins a comment.

    Times ``(names,)`` [s] are nan for pictures whose name is missing.
    """
    text = read_bytes(path, "file of times", MAX_TIMES_BYTES).decode("utf-8", "replace")
    rows = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
    rows = [row for row in rows if row]
    try:
        times = [float(row[-1]) for row in rows]
    except ValueError:
        raise MitsonarError(f"{path} must hold lines `TIME` or `NAME, TIME` with times [s]{SEE}") from None
    if rows and all(len(row) == 2 for row in rows):
        by_name = {row[0]: time for row, time in zip(rows, times, strict=True)}
        named_times = np.array([by_name.get(name, np.nan) for name in names])
        if not np.isfinite(named_times).any():
            raise MitsonarError(f"{path} lists none of the pictures, such as {names[0] if names else '-'}")
        return named_times
    if len(times) != len(names) or any(len(row) != 1 for row in rows):
        raise MitsonarError(f"{path} must hold a time for each of {len(names):,} pictures: it holds {len(times):,} lines")
    return np.array(times)


def _rate(times: Array, geometry: PictureGeometry) -> float:
    """Return the frame rate [Hz]: as given by the geometry, or computed from the times."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return geometry.frame_rate_hz or (min(1e6, 1 / step) if step > 0 else ANY_RATE_HZ)


def _fixed_attitude(geometry: PictureGeometry, frames: int) -> Array | None:
    """Return pitch, roll, heading ``(frames, 3)`` [rad] if the geometry gives the pitch; the heading is nan."""
    if geometry.pitch_deg is None:
        return None
    return np.tile([math.radians(geometry.pitch_deg), math.radians(geometry.roll_deg), np.nan], (frames, 1))


# ---------------- Conversion to mitsonar frames


CONVERSION = RunKind("recording", ("frames.npz", "frames.zarr"), {"frames": int, "frames_done": int})

CHUNK_BYTES = 32 * 2**20
"""Approximate amount of pixel data that is copied at a time [bytes]."""


def write_frames(
    recording: Recording,
    number: int | None,
    folder: str | Path,
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Copy a part of a recording to a run folder in constant memory; an interrupted copy can be resumed.

    Args:
        recording: recording of any format.
        number: index of the part; None selects the longest.
        folder: folder to create.
        overwrite: whether to replace an existing copy.
        resume: whether to continue an existing copy.
        progress: function that is called with the number of newly copied frames.

    Returns:
        Path of ``frames.npz`` for at most 1,000 frames, or of ``frames.zarr`` for more.

    Raises:
        MitsonarError: if the folder holds other files, or a copy that is neither resumed nor replaced.
    """
    part = recording.part(number)
    chosen = recording.longest if number is None else number
    request = {"of": recording.name, "format": recording.format, "part": chosen, "frames": len(part)}
    run = RunDirectory.begin(folder, CONVERSION, request, resume=resume, overwrite=overwrite)
    run.start(frames=len(part), frames_done=0)
    report_progress = progress or (lambda done: None)
    npz_path, zarr_path = run.path / "frames.npz", run.path / "frames.zarr"
    if run.finished and (npz_path.exists() or zarr_path.exists()):
        report_progress(len(part))
        return npz_path if npz_path.exists() else zarr_path
    store, done = _store(run, recording, part, zarr_path)
    report_progress(done)
    step = max(1, CHUNK_BYTES // (part.like.image.dtype.itemsize * len(part.like.range_m) * len(part.like.bearing_rad)))
    for start in range(done, len(part), step):
        frames = part.read(np.arange(start, min(start + step, len(part))))
        store.write(start, frames)
        run.note(frames_done=start + len(frames))
        report_progress(len(frames))
    if len(part) <= MAX_NPZ_FRAMES:
        store.pack(npz_path)
    run.finish()
    return npz_path if npz_path.exists() else zarr_path


def _store(run: RunDirectory, recording: Recording, part: Part, zarr_path: Path) -> tuple[FrameStore, int]:
    """Return the existing store, or a new one, and the number of frames that it holds."""
    if run.resumed and zarr_path.exists():
        store = FrameStore.open(zarr_path)
        done = min(run.count("frames_done", len(part)), store.done)
        store.check(len(part), part.like.sonar, done)
        return store, done
    if run.resumed and run.count("frames_done", len(part)):
        raise MitsonarError(
            f"{zarr_path} is missing, although run.json states that it was begun: copy again with --overwrite"
        )
    about = {"recording": recording.name, "format": recording.format, "notes": list(recording.notes)}
    return FrameStore.create(zarr_path, len(part), replace(part.read([]), about=about)), 0
