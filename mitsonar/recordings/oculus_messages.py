"""Where the messages of an Oculus lie in a file: back to back in a dump (``.raw``), or in the items of a log (``.oculus``).

Only headers are read to find them, so that a file of any size is opened at once. Source of both layouts: public readers,
liboculus (BSD-3-Clause) for messages and oculus_driver (its files under BSD-3-Clause) for logs. No log was at hand; the
authors of hydroformats (Apache-2.0) report that real ones have these headers.
"""

from __future__ import annotations

import re
import struct
import zlib
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.io.files import INFLATION
from mitsonar.recordings.ping_file import Bytes

__all__ = ["DUMP", "HEADER", "LOG", "PING", "Messages", "find_messages", "is_oculus"]

DUMP, LOG = b"SO", struct.pack("<I", 0x11223344)
"""First bytes of a message, and so of a dump; first bytes of a log."""

DATABASE = b"SQLite format 3\0"
"""First bytes of a log of ViewPoint 2, which is not read."""

ITEM = struct.pack("<I", 0xAABBCCDD)
"""First bytes of an item of a log."""

HEADER = struct.Struct("<HHHHHIH")
"""Of a message: mark, source, destination, kind, version, bytes that follow, spare."""

LOG_HEADER = struct.Struct("<II16sHH4xqd")
"""Of a log: mark, size of this header, source, version, encryption, key, time."""

ITEM_HEADER = struct.Struct("<IIHH4xdH2xII")
"""Of an item: mark, size of this header, kind, version, time [s], packing, bytes when unpacked, bytes that follow."""

PING = 0x23
"""Kind of a message with an image."""

KINDS = (0x15, 0x22, PING, 0x55, 0x80, 0xFF)
"""All kinds of messages."""

LATEST = 2
"""Version of a message, at most."""

MESSAGE_ITEM = 10
"""Kind of an item that is one message."""

LARGEST_HEADER = 4096
LARGEST_MESSAGE = 2**26
"""What is believed of a header of a log, and of a message that must be unpacked [bytes]."""

STEP = 4096
"""Packed bytes that are unpacked at a time."""


class _Place(NamedTuple):
    """A message in a file: begin, bytes there, bytes when unpacked (0: it is not packed), time of its item [s]."""

    begin: int
    stored: int
    unpacked: int
    time_s: float


@dataclass(frozen=True)
class Messages:
    """The messages with images of a file.

    Attributes:
        name: of the file.
        data: the whole file.
        begin: offset of each message ``(messages,)`` [bytes].
        stored: its bytes in the file ``(messages,)``.
        unpacked: its bytes when unpacked ``(messages,)``; 0 where it is not packed.
        time_s: by the log ``(messages,)`` [s]; nan where unknown.
        left_over: bytes of the file that belong to no message.
        skipped: messages of other kinds.
    """

    name: str
    data: Bytes
    begin: NDArray[np.int64]
    stored: NDArray[np.int64]
    unpacked: NDArray[np.int64]
    time_s: NDArray[np.float64]
    left_over: int = 0
    skipped: int = 0

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.begin)

    @property
    def size(self) -> NDArray[np.int64]:
        """Return the size of each message with its header ``(messages,)`` [bytes]."""
        return np.where(self.unpacked > 0, self.unpacked, self.stored)

    def head(self, number: int, count: int) -> bytes:
        """Return the first bytes of a message, at most ``count``; fewer where it is shorter or damaged."""
        begin, stored = int(self.begin[number]), int(self.stored[number])
        if not self.unpacked[number]:
            return self.data[begin : begin + min(stored, count)].tobytes()
        try:
            return _unpacked(self.data.data[begin : begin + stored], min(count, int(self.unpacked[number])))
        except zlib.error:
            return b""

    def whole(self, number: int) -> Bytes:
        """Return all bytes of a message.

        Raises:
            MitsonarError: packed bytes that are damaged.
        """
        begin, stored, size = int(self.begin[number]), int(self.stored[number]), int(self.unpacked[number])
        if not size:
            return self.data[begin : begin + stored]
        try:
            made = _unpacked(self.data.data[begin : begin + stored], size)
        except zlib.error as error:
            raise MitsonarError(f"{self.name}: the message at byte {begin:,} cannot be unpacked: {error}") from None
        if len(made) < size:
            raise MitsonarError(
                f"{self.name}: the message at byte {begin:,} unpacks to {len(made):,} bytes, not to {size:,}"
            )
        return np.frombuffer(made, np.uint8)


def is_oculus(path: Path, first: bytes) -> bool:
    """Return whether the first bytes of a file, 16 or more, are those of a dump or of a log."""
    if first.startswith(LOG) or (first.startswith(DATABASE) and path.suffix.lower() == ".oculus"):
        return True
    if not first.startswith(DUMP) or len(first) < HEADER.size:
        return False
    kind, version = HEADER.unpack_from(first)[3:5]
    return kind in KINDS and version <= LATEST


def find_messages(data: Bytes, name: str) -> Messages:
    """Find all messages with images in a dump or a log.

    Bytes that are no message are passed over up to the next one.

    Args:
        data: the whole file.
        name: of the file, for errors.

    Raises:
        MitsonarError: neither of them, or an encrypted log.
    """
    first = data[:16].tobytes()
    if first.startswith(DATABASE):
        raise MitsonarError(f"{name} is a log of ViewPoint 2, a database: export it in the format of ViewPoint 1")
    if first.startswith(LOG):
        return _in_log(data, name)
    if not first.startswith(DUMP):
        raise MitsonarError(
            f"{name} is no recording of an Oculus: it begins with {first[:4]!r}, not with {DUMP!r} (.raw) or {LOG!r} "
            "(.oculus)"
        )
    return _in_dump(data, name)


class _Found:
    """Collects messages; arrays keep a few bytes of each."""

    def __init__(self) -> None:
        self.places = [array("q"), array("q"), array("q")]
        self.times = array("d")
        self.bytes = 0
        self.skipped = 0

    def add(self, place: _Place) -> None:
        for column, value in zip(self.places, place[:3], strict=True):
            column.append(value)
        self.times.append(place.time_s)

    def messages(self, data: Bytes, name: str) -> Messages:
        begin, stored, unpacked = (np.array(column, dtype=np.int64) for column in self.places)
        left_over = len(data) - self.bytes
        return Messages(name, data, begin, stored, unpacked, np.array(self.times), left_over, self.skipped)


def _in_dump(data: Bytes, name: str) -> Messages:
    found, view, mark, place = _Found(), data.data, re.compile(re.escape(DUMP)), 0
    while hit := mark.search(view, place):
        place = hit.start()
        if place + HEADER.size > len(view):
            break
        kind, version, follow = HEADER.unpack_from(view, place)[3:6]
        if kind not in KINDS or version > LATEST or place + HEADER.size + follow > len(view):
            place += 1
            continue
        size = HEADER.size + follow
        found.bytes += size
        if kind == PING:
            found.add(_Place(place, size, 0, np.nan))
        else:
            found.skipped += 1
        place += size
    return found.messages(data, name)


def _in_log(data: Bytes, name: str) -> Messages:
    view = data.data
    if len(view) < LOG_HEADER.size:
        raise MitsonarError(
            f"{name} has {len(view):,} bytes, and the header of a log {LOG_HEADER.size}: the file is cut off"
        )
    place, encryption = (LOG_HEADER.unpack_from(view)[one] for one in (1, 4))
    if encryption:
        raise MitsonarError(f"{name} is encrypted (kind {encryption}): export it without encryption")
    if not LOG_HEADER.size <= place <= LARGEST_HEADER:
        place = LOG_HEADER.size
    found, mark = _Found(), re.compile(re.escape(ITEM))
    found.bytes = place
    while hit := mark.search(view, place):
        place = hit.start()
        if place + ITEM_HEADER.size > len(view):
            break
        _, head, kind, _, time_s, packing, unpacked, follow = ITEM_HEADER.unpack_from(view, place)
        if not ITEM_HEADER.size <= head <= LARGEST_HEADER or place + head + follow > len(view):
            place += 1
            continue
        begin, time_s = place + head, time_s if abs(time_s) < 1e11 else np.nan
        found.bytes += head + follow
        if kind == MESSAGE_ITEM and follow > HEADER.size and packing in (0, 1):
            _add_item(found, view, _Place(begin, follow, unpacked if packing else 0, time_s))
        else:
            found.skipped += 1
        place = begin + follow
    return found.messages(data, name)


def _add_item(found: _Found, view: memoryview, item: _Place) -> None:
    """Keep an item whose message holds an image; a packed one has its size before it, most significant byte first."""
    if item.unpacked:
        size = int.from_bytes(view[item.begin : item.begin + 4], "big")
        most = min(LARGEST_MESSAGE, INFLATION * item.stored)
        if size != item.unpacked or not HEADER.size < size <= most:
            found.skipped += 1
            return
        item = item._replace(begin=item.begin + 4, stored=item.stored - 4)
        try:
            head = _unpacked(view[item.begin : item.begin + item.stored], HEADER.size)
        except zlib.error:
            head = b""
    else:
        head = bytes(view[item.begin : item.begin + HEADER.size])
    if len(head) == HEADER.size and head[:2] == DUMP and HEADER.unpack(head)[3] == PING:
        found.add(item)
    else:
        found.skipped += 1


def _unpacked(packed: memoryview, count: int) -> bytes:
    """Unpack the first ``count`` bytes, or fewer where there are no more; never makes more than these.

    Raises:
        zlib.error: damaged bytes.
    """
    made, unpacker = bytearray(), zlib.decompressobj()
    for start in range(0, len(packed), STEP):
        made += unpacker.decompress(packed[start : start + STEP], count - len(made))
        while unpacker.unconsumed_tail and len(made) < count:
            made += unpacker.decompress(unpacker.unconsumed_tail, count - len(made))
        if len(made) >= count or unpacker.eof:
            break
    return bytes(made)
