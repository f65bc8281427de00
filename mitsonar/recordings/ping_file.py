"""Files of pings, mapped into memory: bytes are read on demand, and sizes are checked before they are believed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError

__all__ = ["Bytes", "EqualFrames", "Header", "layout", "mapped"]

Bytes = NDArray[np.uint8]

Header = NDArray[Any]
"""A structured array: fields of a header by name."""


def mapped(path: str | Path, what: str, least: int = 1) -> Bytes:
    """Map a file into memory, read only.

    Args:
        path: of the file.
        what: kind of file, for errors.
        least: bytes that it must have.

    Raises:
        MitsonarError: no such file, no file, or too short.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise MitsonarError(f"no such file: {path}" if not os.path.exists(path) else f"{path} is no file: give {what}")
    size = path.stat().st_size
    if size < least:
        raise MitsonarError(
            f"{path} has {size:,} bytes, and {what} has {least:,} at least: the file is cut off or another one"
        )
    try:
        return np.memmap(path, dtype=np.uint8, mode="r")
    except (OSError, ValueError) as error:
        raise MitsonarError(f"cannot read {what} {path}: {error}") from None


def layout(fields: Mapping[str, tuple[int, str]], size: int) -> np.dtype[np.void]:
    """Return the type of a header of ``size`` bytes with fields at byte offsets, by name: ``(offset, NumPy's type)``."""
    offsets = [offset for offset, _ in fields.values()]
    formats = [kind for _, kind in fields.values()]
    table: Any = {"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": size}
    made: np.dtype[np.void] = np.dtype(table)
    return made


@dataclass(frozen=True)
class EqualFrames:
    """Frames of one size, one after the other: a header and samples each.

    Attributes:
        data: the whole file.
        start: offset of the first frame [bytes].
        header: type of a frame's header.
        samples: bytes of a frame's samples.
    """

    data: Bytes
    start: int
    header: np.dtype[np.void]
    samples: int

    @property
    def stride(self) -> int:
        """Return the size of a frame with its header [bytes]."""
        return self.header.itemsize + self.samples

    def __len__(self) -> int:
        """Return the number of whole frames; the file's size tells it, not its header."""
        return max(0, (len(self.data) - self.start) // self.stride)

    @property
    def left_over(self) -> int:
        """Return the bytes behind the last whole frame."""
        return max(0, len(self.data) - self.start - len(self) * self.stride)

    def headers(self) -> Header:
        """Return the headers ``(frames,)``: a view into the file."""
        return np.ndarray((len(self),), self.header, self.data, self.start, (self.stride,))

    def table(self) -> Header:
        """Return the headers ``(frames,)`` in memory, their known fields only."""
        names = self.header.names or ()
        return self.headers().astype([(name, self.header[name]) for name in names])

    def read(self, index: NDArray[np.intp], shape: tuple[int, int]) -> Bytes:
        """Return the samples of frames ``(n, *shape)``, copied."""
        begin = self.start + self.header.itemsize + index.astype(np.int64) * self.stride
        return (
            np.stack([self.data[at : at + self.samples].reshape(shape) for at in begin])
            if len(index)
            else np.zeros((0, *shape), np.uint8)
        )
