"""Any recording, by its content: a file's first bytes or a folder's files tell the format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mitsonar.errors import MitsonarError
from mitsonar.recordings.aris import SIGNATURE, read_aris
from mitsonar.recordings.didson import SIGNATURES, read_didson
from mitsonar.recordings.oculus import read_oculus
from mitsonar.recordings.oculus_messages import is_oculus
from mitsonar.recordings.recording import Recording

__all__ = ["FORMATS", "Format", "format_of", "open_recording"]

FIRST_BYTES = 16
"""Bytes by which formats are told from each other."""


class Format(NamedTuple):
    """A format: in words, whether a path with these first bytes (empty for a folder) has it, and what reads it."""

    words: str
    fits: Callable[[Path, bytes], bool]
    read: Callable[[Path], Recording]


FORMATS: tuple[Format, ...] = (
    Format("ARIS (.aris)", lambda path, first: first.startswith(SIGNATURE), read_aris),
    Format("DIDSON (.ddf)", lambda path, first: first[:4] in SIGNATURES, read_didson),
    Format("Oculus (.raw, .oculus)", is_oculus, read_oculus),
)
"""All formats, in the order in which they are tried."""


def format_of(path: str | Path) -> Format | None:
    """Return the format of a file or folder; None where it is no recording, or is not there."""
    path = Path(path)
    first = b""
    if path.is_file():
        try:
            with path.open("rb") as file:
                first = file.read(FIRST_BYTES)
        except OSError:
            return None
    elif not path.is_dir():
        return None
    return next((one for one in FORMATS if one.fits(path, first)), None)


def open_recording(path: str | Path) -> Recording:
    """Open a recording of a real sonar; pixels are read on demand.

    Args:
        path: of a file or folder in one of :data:`FORMATS`; its content tells which.

    Raises:
        MitsonarError: nothing there, no known format, or damaged.
    """
    found = format_of(path)
    if found is None:
        if not Path(path).exists():
            raise MitsonarError(f"no such file: {path}")
        known = ", ".join(one.words for one in FORMATS)
        raise MitsonarError(f"{path} is no recording that mitsonar reads: it reads {known}")
    return found.read(Path(path))
