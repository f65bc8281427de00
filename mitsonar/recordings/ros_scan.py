"""One pass through a topic of a sonar: times, layouts and places of its messages, by which single ones are read again."""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, counted
from mitsonar.recordings.bag_file import BagFile, Message, Topic
from mitsonar.recordings.ros_messages import FANS, PROJECTED
from mitsonar.recordings.ros_pings import PingLayout, layout_of

__all__ = ["TopicScan"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

STAMP = 12
"""Bytes of a message up to the end of its time: of ROS 1 after a count, of ROS 2 after four bytes on the encoding."""

NEAR = 8
"""Frames between two that are wanted which are read rather than skipped."""


@dataclass
class TopicScan:
    """What one pass through a topic tells of its messages; memory grows by some tens of bytes a message.

    Attributes:
        bag: with the topic.
        topic: of the sonar.
        received: time of reception of each message that can be read [ns].
        nth: its number among those received at the same time.
        stamps: time in its header [s].
        numbers: of its layout.
        layouts: that differ.
        lost: messages that cannot be read.
        reason: why the first of them cannot.
        low: least sample, where samples are floats.
        high: greatest sample, where samples are floats.
        gaps: whether floats are not finite.
    """

    bag: BagFile
    topic: Topic
    received: list[int] = field(default_factory=list)
    nth: list[int] = field(default_factory=list)
    stamps: list[float] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    layouts: list[PingLayout] = field(default_factory=list)
    lost: int = 0
    reason: str = ""
    low: float = math.inf
    high: float = -math.inf
    gaps: bool = False

    def read(self) -> None:
        """Read all messages once. A message whose bytes before the samples were met before is not decoded again."""
        known: dict[bytes, int] = {}
        heads: dict[int, int] = {}
        last, count = -1, 0
        for time, raw in self.bag.messages(self.topic.name):
            count = count + 1 if time == last else 0
            last = time
            try:
                number = self._number(raw, known, heads)
            except (MitsonarError, ValueError, TypeError, AttributeError) as error:
                self.lost, self.reason = self.lost + 1, self.reason or str(error)
                continue
            self.received.append(time)
            self.nth.append(count)
            self.stamps.append(_stamp(raw, self.bag.is_ros1))
            self.numbers.append(number)

    def _number(self, raw: bytes, known: dict[bytes, int], heads: dict[int, int]) -> int:
        """Return the number of a message's layout; pictures have none."""
        if self.topic.kind in FANS:
            return 0
        head = heads.get(len(raw))
        if head is not None:
            number = known.get(_digest(raw[STAMP:head]))
            if number is not None:
                layout = self.layouts[number]
                self._measure(raw[head : head + layout.cells * np.dtype(layout.dtype).itemsize], number)
                return number
        message = self.bag.decode(raw, self.topic.kind)
        layout = layout_of(message, self.topic.kind)
        number = next((at for at, one in enumerate(self.layouts) if one.resembles(layout)), len(self.layouts))
        if number == len(self.layouts):
            self.layouts.append(layout)
        if self.topic.kind in PROJECTED:
            samples = np.asarray(message.image.data, np.uint8).tobytes()
            self._measure(samples, number)
            head = _head_of(raw, samples)
            if head is not None:
                heads[len(raw)] = head
                known[_digest(raw[STAMP:head])] = number
        return number

    def _measure(self, samples: bytes, number: int) -> None:
        """Note the least and the greatest of samples that are floats."""
        kind = np.dtype(self.layouts[number].dtype)
        if kind.kind == "f" and samples:
            values = np.frombuffer(samples, kind)
            finite = values[np.isfinite(values)]
            self.gaps |= len(finite) < len(values)
            if len(finite):
                self.low, self.high = min(self.low, float(finite.min())), max(self.high, float(finite.max()))

    def frame_times(self) -> Array:
        """Return the times of the frames ``(frames,)`` [s]: of the headers, or of reception."""
        if not self._is_stamped():
            return np.array(self.received, dtype=float) * 1e-9
        stamps = np.array(self.stamps)
        unset = (stamps < 0) | ((stamps == 0) & ((stamps == 0).sum() > 1))  # a simulation may begin at 0
        return np.where(unset, np.nan, stamps)

    def _is_stamped(self) -> bool:
        """Return whether the headers hold times."""
        return bool(np.any(self.stamps)) and (len(self.stamps) == 1 or np.ptp(self.stamps) > 0)

    def notes(self) -> list[str]:
        """Return sentences on what was left out or assumed."""
        notes = [] if not self.lost else [f"left out: {counted(self.lost, 'message')} that cannot be read: {self.reason}"]
        if not self._is_stamped():
            notes.append("the headers hold no times: times are those at which the messages were received")
        if self.gaps:
            notes.append("samples that are nan or inf are read as 0")
        return notes

    def frames(self, places: Index) -> Iterator[tuple[int, Message]]:
        """Read and decode the messages at these places, in rising order; yield place and message."""
        wanted = np.unique(places)
        if not len(wanted):
            return
        for run in np.split(wanted, np.flatnonzero(np.diff(wanted) > NEAR) + 1):
            at = {(self.received[place], self.nth[place]): int(place) for place in run}
            times = [time for time, _ in at]
            last, count = -1, 0
            for time, raw in self.bag.messages(self.topic.name, min(times), max(times) + 1):
                count = count + 1 if time == last else 0
                last = time
                if (time, count) in at:
                    yield at[time, count], self.bag.decode(raw, self.topic.kind)


def _stamp(raw: bytes, ros1: bool) -> float:
    """Return the time in the header with which a message begins [s]."""
    if len(raw) < STAMP:
        return 0.0
    order = "<" if ros1 or raw[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack(f"{order}{'I' if ros1 else 'i'}I", raw[4:STAMP])
    return float((seconds * 10**9 + nanoseconds) / 10**9)  # rounded once: times come back as they were written


def _head_of(raw: bytes, samples: bytes) -> int | None:
    """Return where the samples begin that end a message; up to three bytes may fill it up."""
    for filled in range(4):
        head = len(raw) - len(samples) - filled
        if (
            head >= STAMP + 4
            and int.from_bytes(raw[head - 4 : head], "little") == len(samples)
            and raw[head : head + len(samples)] == samples
        ):
            return head
    return None


def _digest(head: bytes) -> bytes:
    return hashlib.blake2b(head, digest_size=16).digest()
