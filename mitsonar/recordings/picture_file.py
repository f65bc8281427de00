"""One picture file (PNG, JPEG, PGM): its size before anything is decoded, and its grey values."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mitsonar.errors import MitsonarError

__all__ = ["SUFFIXES", "Grey", "is_whole", "picture_size", "read_picture", "refuse_size"]

Grey = NDArray[np.generic]
"""Values ``(rows, columns)``: uint8 in 0..255, or float32 in 0..1."""

SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm")
"""Endings of picture files."""

FORMATS = ("PNG", "JPEG", "PPM")
"""What Pillow may take a file for, whatever its ending."""

MOST_PIXELS = 2**25
"""Pixels of a picture, at most."""

PNG, END_OF_PNG = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
"""First and last bytes of a PNG file."""


def picture_size(path: Path) -> tuple[int, int]:
    """Return rows and columns of a picture, by its header; nothing is decoded.

    Raises:
        MitsonarError: no picture, or larger than any of a sonar.
    """
    with _opened(path) as picture:
        columns, rows = picture.size
    refuse_size(rows, columns, str(path))
    return rows, columns


def refuse_size(rows: int, columns: int, source: str) -> None:
    """Refuse pictures that are larger than any of a sonar, or have a single row or column.

    Raises:
        MitsonarError: they are.
    """
    if rows * columns > MOST_PIXELS or min(rows, columns) < 2:
        raise MitsonarError(
            f"{source} has {columns:,} x {rows:,} pixels; pictures of sonars have 2 x 2 to {MOST_PIXELS:,} in all: it is "
            "damaged, or something else"
        )


def is_whole(path: Path) -> bool:
    """Return whether a path is a file that is not visibly cut off: a PNG file ends as one, any other has bytes."""
    if not os.path.isfile(path):  # a pipe would never end
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
    """Read the grey values of a picture; of colours the luminance.

    Args:
        path: of the file.
        shape: rows and columns that it must have.

    Returns:
        ``(rows, columns)`` uint8 in 0..255, or of 16 bits a value float32 in 0..1.

    Raises:
        MitsonarError: not a whole picture, or one of another size.
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
    """Open a picture; only its header is read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            return Image.open(path, formats=FORMATS)
    except FileNotFoundError:
        raise MitsonarError(f"no such file: {path}") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise MitsonarError(
            f"{path} says that it has more pixels than any picture of a sonar, {MOST_PIXELS:,}: it is damaged"
        ) from None
    except Exception as error:  # damaged bytes raise errors of many kinds
        reason = " ".join(str(error).split())[:160]
        raise MitsonarError(f"cannot read the picture {path}: {reason}; give PNG, JPEG or PGM") from None
