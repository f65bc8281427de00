"""The images in messages of an Oculus: counts of 8 to 32 bits, row by row, where asked with the gain of each row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.recordings.oculus_messages import Messages
from mitsonar.recordings.recording import Pixels

__all__ = ["OculusImages"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class OculusImages:
    """The images of a part's frames.

    Attributes:
        messages: of the file.
        place: number of each frame's message.
        offset: of each frame's image in its message [bytes].
        shape: bins and beams.
        width: bytes of a count.
        gained: each row begins with its gain.
        falling: the message's first beam is the one most to starboard.
    """

    messages: Messages
    place: Index
    offset: NDArray[np.int64]
    shape: tuple[int, int]
    width: int
    gained: bool
    falling: bool

    @property
    def eight_bit(self) -> bool:
        """Return whether images are the bytes of the file."""
        return self.width == 1 and not self.gained

    def __call__(self, index: Index) -> Pixels:
        """Return ``(n, bins, beams)``, column 0 most to port."""
        made: Pixels = np.empty((len(index), *self.shape), np.uint8 if self.eight_bit else np.float32)
        reference = self._rows(0)[0].min(initial=np.inf) if self.gained and len(index) else 1.0
        for one, frame in enumerate(index):
            gains, counts = self._rows(int(frame))
            if self.eight_bit:
                made[one] = counts
            else:
                scale = np.sqrt(reference / gains)[:, None] if self.gained else 1.0
                made[one] = np.minimum(counts * (scale / (256.0**self.width - 1)), 1.0)
        return made[:, :, ::-1] if self.falling else made

    def _rows(self, frame: int) -> tuple[Array, NDArray[Any]]:
        """Return the gains ``(bins,)`` and the counts ``(bins, beams)`` of a frame."""
        bins, beams = self.shape
        begin, stride = int(self.offset[frame]), beams * self.width + 4 * self.gained
        whole = self.messages.whole(int(self.place[frame]))
        rows = whole[begin : begin + bins * stride].reshape(bins, stride)
        if not self.gained:
            return np.ones(bins), _counts(rows, self.width)
        gains = np.ascontiguousarray(rows[:, :4]).view("<u4")[:, 0].astype(float)
        return np.maximum(gains, 1.0), _counts(rows[:, 4:], self.width)


def _counts(rows: NDArray[np.uint8], width: int) -> NDArray[Any]:
    """Return counts of 1 to 4 bytes each, the least significant byte first ``(bins, beams)``."""
    if width == 1:
        return rows
    parts = rows.reshape(len(rows), -1, width)
    made = np.zeros(parts.shape[:2], np.uint32)
    for one in range(width):
        made |= parts[:, :, one].astype(np.uint32) << np.uint32(8 * one)
    return made
