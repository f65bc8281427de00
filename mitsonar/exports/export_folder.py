"""The folder of an export, whole or absent: it gets its name when all is in it."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mitsonar.errors import MitsonarError

__all__ = ["digest_of", "json_line", "new_folder", "png"]

MARK = ".mitsonar-export"
"""A file in a folder that is being written: only such a folder is removed."""


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Make a folder beside ``out``, which takes its name in the end; what is left of one that was broken off is removed.

    Raises:
        MitsonarError: something is there already.
    """
    part = out.with_name(f".{out.name}.part")
    if out.exists():
        raise MitsonarError(f"{out} exists and is kept as it is: choose another -o, or remove it")
    if part.exists() and not (part / MARK).is_file():
        raise MitsonarError(f"{part} is in the way and no export of mitsonar made it: remove it, or choose another -o")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        (part / MARK).touch()
        yield part
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    (part / MARK).unlink()
    part.rename(out)


def png(picture: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Return a grey picture as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()


def json_line(value: object) -> str:
    """Return a value as JSON in one line."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
