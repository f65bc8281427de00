"""How is a recording of a Water Linked Sonar 3D-15 read? The packets of its range image protocol, one after another.

Source: Water Linked, Integration API Sonar 3D-15, and the package wlsonar 0.5.5 (MIT), with whose packets the tests compare
this reader. A packet is ``RIP1`` or ``RIP2``, its length, a message of Protocol Buffers, which RIP2 packs with Snappy, and a
CRC-32. Its axes are forward, right, down: the first row of an image is the lowest, the first column the farthest to port.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.recordings.range_pings import RangePing, RangeRecording
from mitsonar.recordings.recording import Bytes, Facts, in_time_order, mapped
from mitsonar.recordings.side_scan import marked_packets

__all__ = ["is_range_images", "read_range_images"]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

HEAD = struct.Struct("<4sI")
"""Identifier of a packet, and its size [bytes]."""

PROTOCOLS = (b"RIP1", b"RIP2")

LEAST_BYTES, MOST_BYTES = 12, 65_507
"""Size of a packet, which fits into one UDP packet [bytes]."""

MOST_UNPACKED, MOST_FIELDS = 2**18, 100
"""Largest size of a message [bytes], and number of its fields; an image of 256 x 64 pixels takes 49 kB and 10 fields."""

CHECK_FACTOR = 16
"""Bytes whose checksum is wrong may be so many times those of the file, before the search for packets ends."""

RANGE_IMAGE, STRENGTH_IMAGE = "RangeImage", "BitmapImageGreyscale8"

MOST_PIXELS = 2**16

Fields: TypeAlias = dict[int, list["int | bytes"]]
"""Values of the fields of a message by number: whole numbers, or bytes."""


class _Image(NamedTuple):
    """A range image ``(rows, columns)``: time [s], number, raw ranges, unit [m], fields of view [rad], and settings."""

    time_s: float
    sequence: int
    pixels: NDArray[np.int64]
    scale_m: float
    fov_rad: tuple[float, float]
    frequency_hz: int
    sound_speed: float
    range_max: float


def is_range_images(path: Path, first: bytes) -> bool:
    """Return whether a file begins with a packet of the range image protocol."""
    return first[:4] in PROTOCOLS


def read_range_images(path: Path) -> RangeRecording:
    """Open a ``.sonar`` file; points are read on demand.

    Points are those of the pixels with a range. Their intensity is the logarithmic strength 0..1 of the strength image with
    the same number, if the file has one that fits. Numbers may begin anew: the nearest image before or behind counts.

    Raises:
        MitsonarError: if the file holds no range image that can be read.
    """
    data = mapped(path, "a recording of a Sonar 3D-15", LEAST_BYTES)
    images: list[list[float]] = []  # time, number, points, place, place of its strengths (-1: none)
    alone: dict[int, int] = {}  # images without strengths, by number
    strengths: dict[int, int] = {}  # places of strengths without image, by number
    first: _Image | None = None
    others = damaged = used = 0
    for begin, size in _packets(data):
        used += size
        try:
            kind, fields = _message(data, begin)
            if kind == RANGE_IMAGE:
                image = _range_image(fields)
                partner = strengths.pop(image.sequence, -1)
                if partner < 0:
                    alone[image.sequence] = len(images)
                images.append([image.time_s, image.sequence, int((image.pixels > 0).sum()), begin, partner])
                first = first or image
            elif kind == STRENGTH_IMAGE and not _number(fields, 5):
                _strengths(fields)
                number = _sequence(fields)
                if number in alone:
                    images[alone.pop(number)][4] = begin
                else:
                    strengths[number] = begin
            else:
                others += 1
        except ValueError:
            damaged += 1
    table = np.array(images, dtype=np.float64).reshape(-1, 5)
    order, notes = in_time_order(table[:, 0], table[:, 1], "image")
    if first is None or not len(order):
        raise MitsonarError(f"{path} holds no range image that can be read ({damaged:,} damaged packets, {others:,} others)")
    counts, places = table[order, 2].astype(np.intp), table[order, 3:].astype(np.int64)

    def read(index: Index) -> Iterator[RangePing]:
        for place, partner in places[index].tolist():
            image = _range_image(_message(data, place)[1])
            strength = np.full(image.pixels.shape, np.nan, np.float32)
            if partner >= 0:
                stated = _strengths(_message(data, partner)[1])
                strength = stated if stated.shape == strength.shape else strength
            yield _points(image, strength)

    if damaged:
        notes.append(f"left out: {count_noun(damaged, 'packet')} that cannot be decoded")
    if others:
        notes.append(f"left out: {count_noun(others, 'packet')} other than images of range and strength")
    if used < len(data):
        notes.append(f"skipped: {count_noun(len(data) - used, 'byte')} that belong to no complete packet")
    notes.append("the sonar states no motion: points are starboard, forward, up of its backplate")
    rows, columns = first.pixels.shape
    facts: Facts = {
        "image": f"{columns} x {rows}",
        "fov_deg": " x ".join(f"{math.degrees(one):.4g}" for one in first.fov_rad),
        "range_max": first.range_max,
        "frequency_hz": first.frequency_hz,
        "sound_speed": first.sound_speed,
    }
    return RangeRecording(path.name, "Sonar 3D-15 (.sonar)", table[order, 0], counts, read, None, facts, tuple(notes))


# ---------------- Packets


def _packets(data: Bytes) -> Iterator[tuple[int, int]]:
    """Yield the begin and size of each packet whose checksum is right [bytes]."""
    budget = CHECK_FACTOR * len(data) + MOST_BYTES

    def size_at(view: memoryview, at: int) -> int:
        nonlocal budget
        identifier, size = HEAD.unpack_from(view, at)
        if identifier not in PROTOCOLS or not LEAST_BYTES <= size <= min(MOST_BYTES, len(view) - at) or budget < 0:
            return 0
        (stated,) = struct.unpack_from("<I", view, at + size - 4)
        if zlib.crc32(view[at : at + size - 4]) == stated:
            return int(size)
        budget -= size
        return 0

    for begin, end in marked_packets(data, b"RIP", 0, LEAST_BYTES, size_at):
        yield begin, end - begin


def _message(data: Bytes, begin: int) -> tuple[str, Fields]:
    """Return the type and the fields of the message in a packet.

    Raises:
        ValueError: the packet is damaged.
    """
    identifier, size = HEAD.unpack_from(data.data, begin)
    payload = data[begin + HEAD.size : begin + size - 4].tobytes()
    if identifier == PROTOCOLS[1]:
        payload = _unpack_snappy(payload)
    any_message = _fields(_bytes(_fields(payload), 1))
    kind = _bytes(any_message, 1).decode("ascii", errors="replace").rpartition(".")[2]
    return kind, _fields(_bytes(any_message, 2))


def _range_image(fields: Fields) -> _Image:
    """Return a range image.

    Raises:
        ValueError: sizes or numbers are not plausible.
    """
    columns, rows, scale_m = _number(fields, 5), _number(fields, 6), _float(fields, 9)
    fov = math.radians(_float(fields, 7)), math.radians(_float(fields, 8))
    if not (columns > 1 and rows > 1 and columns * rows <= MOST_PIXELS):
        raise ValueError("images have from 2 x 2 pixels")
    if not (0 < scale_m < 1e3 and 0 < fov[0] <= 2 * math.pi and 0 < fov[1] <= math.pi):
        raise ValueError("invalid scale or field of view")
    pixels = _numbers(fields, 10)
    if len(pixels) != columns * rows or pixels.max() >= 2**16:
        raise ValueError("the number of pixels does not match width and height")
    header = _fields(_bytes(fields, 1))
    stamp = _fields(_bytes(header, 1))
    seconds, nanoseconds = _number(stamp, 1), _number(stamp, 2)
    if not (seconds < 2**40 and nanoseconds < 10**9):
        raise ValueError("invalid time")
    speed, farthest = (one if math.isfinite(one) else 0.0 for one in (_float(fields, 2), _float(fields, 3)))
    return _Image(
        seconds + nanoseconds * 1e-9,
        _number(header, 2),
        pixels.reshape(rows, columns),
        scale_m,
        fov,
        _number(fields, 4),
        speed,
        farthest,
    )


def _points(image: _Image, strength: NDArray[np.float32]) -> RangePing:
    """Return the pixels with a range as points."""
    rows, columns = np.nonzero(image.pixels)
    span = np.array(image.pixels.shape) - 1
    across = (columns / span[1] - 0.5) * image.fov_rad[0]
    up = (rows / span[0] - 0.5) * image.fov_rad[1]
    unit = np.column_stack([np.cos(up) * np.sin(across), np.cos(up) * np.cos(across), np.sin(up)])
    return RangePing(unit * (image.pixels[rows, columns] * image.scale_m)[:, None], strength[rows, columns])


def _strengths(fields: Fields) -> NDArray[np.float32]:
    """Return the logarithmic strengths of an image ``(rows, columns)``, 0..1.

    Raises:
        ValueError: the number of pixels does not match width and height.
    """
    columns, rows, values = _number(fields, 6), _number(fields, 7), np.frombuffer(_bytes(fields, 10), np.uint8)
    if not 0 < rows * columns == len(values):
        raise ValueError("the number of pixels does not match width and height")
    return np.asarray(values.reshape(rows, columns) / np.float32(255), dtype=np.float32)


# ---------------- Protocol Buffers


def _varint(content: bytes, at: int) -> tuple[int, int]:
    """Return the whole number at an offset, and the offset behind it."""
    value = 0
    for place in range(10):
        if at + place >= len(content):
            break
        byte = content[at + place]
        value |= (byte & 127) << 7 * place
        if byte < 128:
            return value & (2**64 - 1), at + place + 1
    raise ValueError("a number is cut off")


def _fields(content: bytes) -> Fields:
    """Return the fields of a message.

    Raises:
        ValueError: the message is cut off, or has fields of an unknown type or too many.
    """
    fields: Fields = {}
    at = count = 0
    while at < len(content):
        count += 1
        if count > MOST_FIELDS:
            raise ValueError("too many fields")
        key, at = _varint(content, at)
        number, kind = key >> 3, key & 7
        value: int | bytes
        if kind == 0:
            value, at = _varint(content, at)
        elif kind in (1, 2, 5):
            size, at = _varint(content, at) if kind == 2 else ({1: 8, 5: 4}[kind], at)
            if size > len(content) - at:
                raise ValueError("a field is cut off")
            value, at = content[at : at + size], at + size
        else:
            raise ValueError("unknown type of a field")
        fields.setdefault(number, []).append(value)
    return fields


def _bytes(fields: Fields, number: int) -> bytes:
    """Return a field of bytes; empty if it is absent."""
    value = fields.get(number, [b""])[-1]
    if not isinstance(value, bytes):
        raise ValueError("a field has another type")
    return value


def _number(fields: Fields, number: int) -> int:
    """Return a whole number; 0 if it is absent."""
    value = fields.get(number, [0])[-1]
    if not isinstance(value, int):
        raise ValueError("a field has another type")
    return value


def _float(fields: Fields, number: int) -> float:
    """Return a float of 4 bytes; 0 if it is absent."""
    value = _bytes(fields, number) or bytes(4)
    if len(value) != 4:
        raise ValueError("a field has another type")
    return float(struct.unpack("<f", value)[0])


def _sequence(fields: Fields) -> int:
    return _number(_fields(_bytes(fields, 1)), 2)


def _numbers(fields: Fields, number: int) -> NDArray[np.int64]:
    """Return a packed list of whole numbers of at most 28 bits."""
    content = np.frombuffer(b"".join(one for one in fields.get(number, []) if isinstance(one, bytes)), np.uint8)
    ends = np.flatnonzero(content < 128)
    if not len(ends) or ends[-1] != len(content) - 1:
        raise ValueError("a list of numbers is empty or cut off")
    begins = np.append(0, ends[:-1] + 1)
    place = np.arange(len(content)) - np.repeat(begins, ends - begins + 1)
    if place.max() > 3:
        raise ValueError("a number is too large")
    return np.add.reduceat((content & 127).astype(np.int64) << 7 * place, begins)


# ---------------- Snappy


def _unpack_snappy(content: bytes) -> bytes:
    """Unpack raw Snappy, by its published format (google/snappy, format_description.txt).

    Raises:
        ValueError: damaged content, or more than :data:`MOST_UNPACKED`.
    """
    size, at = _varint(content, 0)
    if size > MOST_UNPACKED:
        raise ValueError("the message is too large")
    result = bytearray()
    while at < len(content):
        tag = content[at]
        kind, length, at = tag & 3, tag >> 2, at + 1
        extra = (max(0, length - 59), 1, 2, 4)[kind]  # bytes of a long literal's length, or of a copy's offset
        if at + extra > len(content):
            raise ValueError("packed bytes are cut off")
        value, at = int.from_bytes(content[at : at + extra], "little"), at + extra
        if kind == 0:
            length = 1 + (value if extra else length)
            if length > len(content) - at:
                raise ValueError("packed bytes are cut off")
            result += content[at : at + length]
            at += length
        else:
            offset = value | (length >> 3) << 8 if kind == 1 else value
            length = 4 + (length & 7) if kind == 1 else 1 + length
            if not 0 < offset <= len(result):
                raise ValueError("a copy begins outside the message")
            begin = len(result) - offset
            repeated = result[begin : begin + length]  # shorter than its length where it repeats itself
            result += (repeated * -(-length // len(repeated)))[:length]
        if len(result) > size:
            raise ValueError("the message is longer than stated")
    if len(result) != size:
        raise ValueError("the message is shorter than stated")
    return bytes(result)
