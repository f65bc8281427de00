"""Folders of pictures (PNG, JPEG, PGM): sorted naturally, with times from their names where these look like times."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, counted
from mitsonar.recordings.picture_file import SUFFIXES, Grey, is_whole, picture_size, read_picture
from mitsonar.recordings.picture_recording import Pictures, geometry_for, recording_of
from mitsonar.recordings.recording import Recording

__all__ = ["holds_pictures", "naturally", "picture_paths", "read_picture_folder", "times_in_names"]

Array = NDArray[np.float64]

EPOCH_S = (946_684_800, 4_102_444_800)
"""Times that names may tell: 2000 to 2100 [s since 1970]."""

TIMES = (
    (re.compile(r"(?<!\d)(\d{19})(?!\d)"), 1e-9),
    (re.compile(r"(?<!\d)(\d{16})(?!\d)"), 1e-6),
    (re.compile(r"(?<!\d)(\d{13})(?!\d)"), 1e-3),
    (re.compile(r"(?<!\d)(\d{10})(?!\d)"), 1.0),
)
"""Whole numbers that look like times, and their unit [s]."""

PARTED = re.compile(r"(?<!\d)(\d{10})[._](\d{1,9})(?!\d)")
"""Seconds, and what follows their decimal point; with `_` nanoseconds, as ROS writes them."""

MOST_PICTURES = 2_000_000
"""Files of a folder, at most."""


def holds_pictures(path: Path, first: bytes) -> bool:
    """Return whether a path is a folder of pictures, and no folder of a run."""
    if first or not path.is_dir() or any((path / name).exists() for name in ("run.json", "zarr.json", "frames.npz")):
        return False
    try:
        return any(one.suffix.lower() in SUFFIXES for one in path.iterdir())
    except OSError:
        return False


def read_picture_folder(path: Path, geometry: Path | None = None) -> Recording:
    """Open a folder of pictures of one size; they are read on demand.

    Args:
        path: of the folder.
        geometry: a geometry file; default: ``geometry.yaml`` in the folder or beside it.

    Raises:
        MitsonarError: no geometry, no picture that can be read, or a geometry that does not fit the pictures.
    """
    told, told_by = geometry_for(path, geometry)
    files, shape, notes = _of_one_size(picture_paths(path), path)
    names = tuple(file.name for file in files)
    first = read_picture(files[0], shape)
    if _has_colours(files[0]):
        notes.append("the pictures have colours: their luminance is read, which is no level where the colours are a scale")
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
    return recording_of(pictures, told, told_by)


def picture_paths(folder: Path) -> list[Path]:
    """Return the picture files of a folder, sorted naturally.

    Raises:
        MitsonarError: it cannot be read, or holds too many.
    """
    try:
        found = [one for one in folder.iterdir() if one.suffix.lower() in SUFFIXES and not one.name.startswith(".")]
    except OSError as error:
        raise MitsonarError(f"cannot read the folder {folder}: {error.strerror}") from None
    if len(found) > MOST_PICTURES:
        raise MitsonarError(f"{folder} holds {len(found):,} pictures, more than {MOST_PICTURES:,}: divide it")
    return sorted(found, key=lambda one: naturally(one.name))


def naturally(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return the key by which names sort naturally: ``f2`` before ``f10``."""
    parts = re.split(r"(\d+)", name)
    return tuple((0, int(part)) if place % 2 else (1, part.lower()) for place, part in enumerate(parts))


def times_in_names(names: Sequence[str]) -> Array | None:
    """Return the times ``(names,)`` [s since 1970] that all names tell; None where one does not.

    Nanoseconds, microseconds, milliseconds or seconds since 1970 by their number of digits, also seconds with decimals, or
    with ``_`` and nanoseconds. Only times from 2000 to 2100 count.
    """
    if not names:
        return None
    parted = [PARTED.search(name) for name in names]
    if all(parted):
        found = [one.groups() for one in parted if one is not None]
        decimals = [name[one.end(1)] == "." for name, one in zip(names, parted, strict=True) if one is not None]
        times = [
            float(f"{whole}.{rest}") if point else int(whole) + int(rest) * 1e-9
            for (whole, rest), point in zip(found, decimals, strict=True)
        ]
        return _plausible(np.array(times))
    for pattern, unit in TIMES:
        hits = [pattern.search(name) for name in names]
        if all(hits):
            return _plausible(np.array([int(one[1]) for one in hits if one is not None]) * unit)
    return None


def _plausible(times: Array) -> Array | None:
    return times if ((times >= EPOCH_S[0]) & (times <= EPOCH_S[1])).all() else None


def _numbers(names: Sequence[str]) -> Array | None:
    """Return the last number in each name, in steps of the smallest one ``(names,)``; None where they do not rise."""
    found = [re.findall(r"\d{1,15}", Path(name).stem) for name in names]
    if not all(found):
        return None
    numbers = np.array([float(one[-1]) for one in found])
    steps = np.diff(numbers)
    return numbers / steps.min() if len(steps) and steps.min() > 0 else None


def _of_one_size(files: list[Path], folder: Path) -> tuple[list[Path], tuple[int, int], list[str]]:
    """Return the whole pictures of the most frequent size, that size, and sentences on the others."""
    whole = [file for file in files if is_whole(file)]
    sizes: dict[Path, tuple[int, int]] = {}
    reason = ""
    for file in whole:
        try:
            sizes[file] = picture_size(file)
        except MitsonarError as error:
            reason = reason or str(error)
    if not sizes:
        raise MitsonarError(reason or f"{folder} holds no whole picture: all are empty or cut off")
    shape = Counter(sizes.values()).most_common(1)[0][0]
    kept = [file for file, size in sizes.items() if size == shape]
    notes = []
    if len(sizes) < len(files):
        notes.append(f"left out: {counted(len(files) - len(sizes), 'picture')} cut off or damaged")
    if len(kept) < len(sizes):
        others = len(sizes) - len(kept)
        notes.append(f"left out: {counted(others, 'picture')} of another size than {shape[1]:,} x {shape[0]:,} pixels")
    return kept, shape, notes


def _has_colours(path: Path) -> bool:
    """Return whether a picture has colours that differ from grey."""
    from PIL import Image

    with Image.open(path) as picture:
        if picture.mode not in ("RGB", "RGBA", "P"):
            return False
        red, green, blue = (np.asarray(one, dtype=int) for one in picture.convert("RGB").split())
    return bool(max(abs(red - green).max(), abs(green - blue).max()) > 8)
