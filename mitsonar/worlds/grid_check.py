"""Check pictures, grids and tables of a scene by their headers, before Mitsuba allocates what these promise."""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path

from mitsonar.errors import MitsonarError
from mitsonar.io.files import refuse_irregular

__all__ = ["check_grid", "check_tensors", "pixels_of"]

LONGEST_HEADER = 2**20
"""Bytes at the beginning of a picture that are searched for its size."""

INFLATION = 1100
"""Largest ratio of a picture's pixels to the bytes of its file, in bits of one channel: that of deflated data."""

FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of JPEG after which the size stands."""

TENSORS = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 8, 8: 8, 9: 2, 10: 4, 11: 8}
"""Bytes of the types of a table of tensors."""


def pixels_of(path: Path) -> int:
    """Return how many pixels a picture has, by its header: PNG, JPEG, OpenEXR, RGBE, PFM, PPM, BMP or TGA.

    Args:
        path: of the file.

    Raises:
        MitsonarError: no picture of these formats, one without pixels, or more of them than its bytes can hold.
    """
    refuse_irregular(path, "picture")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(LONGEST_HEADER)
        file.seek(max(0, size - 18))
        tail = file.read(18)
    try:
        wide, high, channels = _shape(head, tail)
    except (struct.error, ValueError, IndexError):
        raise MitsonarError(f"{path} is no picture that Mitsuba reads: export it again as PNG, JPEG or OpenEXR") from None
    if min(wide, high) < 1 or wide * high > 8 * INFLATION * size:
        raise MitsonarError(f"picture {path} is damaged: {wide:,} x {high:,} pixels in {size:,} bytes; export it again")
    return wide * high * max(1, (channels + 2) // 3)


def _shape(head: bytes, tail: bytes) -> tuple[int, int, int]:
    """Return width, height and channels of a picture from the beginning and the end of its file."""
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        wide, high = struct.unpack_from(">II", head, 16)
        return wide, high, 3
    if head.startswith(b"\xff\xd8"):
        return _jpeg_shape(head)
    if head.startswith(b"\x76\x2f\x31\x01"):
        return _exr_shape(head)
    if head.startswith(b"BM"):
        wide, high = struct.unpack_from("<ii", head, 18)
        return wide, abs(high), 3
    if head.startswith((b"PF", b"Pf", b"P6")):
        words = re.findall(rb"[^\s#]+", re.sub(rb"#[^\n]*", b"", head[2:2000]))
        return int(words[0]), int(words[1]), 3
    if head.startswith(b"#?"):
        found = re.search(rb"[+-][XY] (\d{1,9}) [+-][XY] (\d{1,9})\n", head[: 2**16])
        if found is None:
            raise ValueError
        return int(found[1]), int(found[2]), 3
    if tail != b"TRUEVISION-XFILE.\0":  # TGA tells itself by its end
        raise ValueError
    wide, high = struct.unpack_from("<HH", head, 12)
    return wide, high, 3


def _jpeg_shape(head: bytes) -> tuple[int, int, int]:
    place = 2
    while True:
        if head[place] != 0xFF:
            raise ValueError
        marker = head[place + 1]
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD7:  # filling, or without a length
            place += 1 if marker == 0xFF else 2
            continue
        length, _, high, wide, channels = struct.unpack_from(">HBHHB", head, place + 2)
        if marker in FRAMES:
            return wide, high, channels
        place += 2 + length


def _exr_shape(head: bytes) -> tuple[int, int, int]:
    """Return the size of the data window, or of the tiles where they are larger, and the number of channels."""
    place, wide, high, channels, tile = 8, 0, 0, 0, 0
    while head[place] != 0:
        name_end = head.index(b"\0", place)
        kind_end = head.index(b"\0", name_end + 1)
        (length,) = struct.unpack_from("<i", head, kind_end + 1)
        name, value = head[place:name_end], kind_end + 5
        if length < 0 or value + length > len(head):
            raise ValueError
        if name in (b"dataWindow", b"displayWindow"):
            left, top, right, bottom = struct.unpack_from("<4i", head, value)
            if right < left or bottom < top:
                raise ValueError
            wide, high = max(wide, right - left + 1), max(high, bottom - top + 1)
        elif name == b"channels":
            inner = value
            while head[inner] != 0:
                inner, channels = head.index(b"\0", inner) + 17, channels + 1
        elif name == b"tiles":
            tile = max(struct.unpack_from("<2I", head, value))
        place = value + length
    return max(wide, tile), max(high, tile), channels


def check_grid(path: Path) -> None:
    """Check a grid in Mitsuba's ``.vol``: its counts against the bytes of its file.

    Raises:
        MitsonarError: it has no such header, or other bytes than it promises.
    """
    refuse_irregular(path, "grid")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(48)
    if len(head) < 48 or head[:4] != b"VOL\x03":
        raise MitsonarError(f"grid {path} is damaged: it has no header of VOL, version 3; export it again")
    kind, *counts = struct.unpack_from("<5i", head, 4)
    numbers = struct.unpack_from("<6f", head, 24)
    if kind != 1 or min(counts) < 1 or 4 * math.prod(counts) != size - 48 or not all(map(math.isfinite, numbers)):
        shape = " x ".join(f"{count:,}" for count in counts)
        raise MitsonarError(f"grid {path} is damaged: {shape} numbers of type {kind} in {size:,} bytes; export it again")


def check_tensors(path: Path) -> None:
    """Check a table of tensors, as ``measured`` reads it: place and size of each against the bytes of its file.

    Raises:
        MitsonarError: it has no such header, or a tensor reaches beyond its end.
    """
    refuse_irregular(path, "table")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(LONGEST_HEADER)
    try:
        if not head.startswith(b"tensor_file\0"):
            raise ValueError
        (count,) = struct.unpack_from("<I", head, 14)
        place = 18
        for _ in range(count):
            (length,) = struct.unpack_from("<H", head, place)
            dimensions, kind, start = struct.unpack_from("<HBQ", head, place + 2 + length)
            place += 13 + length
            shape = struct.unpack_from(f"<{dimensions}Q", head, place)
            place += 8 * dimensions
            if start + math.prod(shape) * TENSORS[kind] > size:
                raise ValueError
    except (struct.error, ValueError, KeyError):
        raise MitsonarError(f"table {path} is damaged: its header promises what it does not hold; fetch it again") from None
