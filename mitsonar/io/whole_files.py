"""Files that are whole or absent, and readers that check sizes before they allocate."""

from __future__ import annotations

import io
import json
import math
import os
import stat
import zipfile
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.io.plain_data import PlainValue, parse_json, parse_yaml

__all__ = [
    "FileArray",
    "at_most",
    "read_bytes",
    "read_json",
    "read_npz",
    "read_yaml",
    "refuse_beyond_memory",
    "refuse_irregular",
    "write_json",
    "write_whole",
]

LARGEST_JSON = 2**27
"""Bytes of a JSON file, at most."""

LARGEST_YAML = 2**20
"""Bytes of a YAML file, at most; people write these files."""

INFLATION = 1032
"""Largest factor by which deflated data can grow."""

LAST_LETTER = 0x10FFFF
"""Largest number of a letter in Unicode."""

MOST_PARTS = 10_000
"""Arrays of an npz file, at most."""


FileArray: TypeAlias = NDArray[Any]
"""An array of a file: numbers of any type, or texts. Its reader checks which."""


def write_whole(path: str | Path, content: bytes) -> None:
    """Write a file under another name and rename it. A reader finds the old file, or the whole new one."""
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def write_json(path: str | Path, value: dict[str, PlainValue]) -> None:
    """Write a JSON file, whole or absent."""
    write_whole(path, (json.dumps(value, indent=2) + "\n").encode())


def at_most(path: str | Path, limit: int) -> bytes:
    """Read the bytes of a file, or the first ``limit`` + 1 of them; so also of a device that never ends.

    Raises:
        OSError, ValueError: as :func:`open` does.
    """
    parts: list[bytes] = []
    with Path(path).open("rb") as file:
        while sum(map(len, parts)) <= limit and (part := file.read(min(2**24, limit + 1))):
            parts.append(part)
    return b"".join(parts)[: limit + 1]


def refuse_irregular(path: str | Path, what: str, limit: int | None = None) -> None:
    """Refuse what is no file on a disk, such as a device that never ends or a pipe that nobody writes to.

    Args:
        path: that exists.
        what: kind of file, for errors.
        limit: largest size in bytes.

    Raises:
        MitsonarError: a folder, a device, a pipe or a socket; or larger than the limit.
    """
    try:
        known = Path(path).stat()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise MitsonarError(f"cannot read {what} {path}: {reason}; give an existing file") from None
    if not stat.S_ISREG(known.st_mode):
        raise MitsonarError(f"{what} {path} is a folder, a device or a pipe: give a file")
    if limit is not None and known.st_size > limit:
        raise MitsonarError(f"{what} {path} is larger than {limit:,} bytes: it is damaged, or something else")


def read_bytes(path: str | Path, what: str, limit: int) -> bytes:
    """Read the bytes of a file up to a limit.

    Args:
        path: of the file.
        what: kind of file, for errors.
        limit: largest size in bytes.

    Raises:
        MitsonarError: no such file, not readable, or larger than the limit.
    """
    try:
        content = at_most(path, limit)
    except FileNotFoundError:
        raise MitsonarError(f"no such file: {path}") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise MitsonarError(f"cannot read {what} {path}: {reason}; give an existing file") from None
    if len(content) > limit:
        raise MitsonarError(f"{what} {path} is larger than {limit:,} bytes: it is damaged, or something else")
    return content


def whole_lines(path: Path, what: str, limit: int) -> list[bytes]:
    """Read the lines of a file that lines are added to. Cut off one that a kill left half written.

    Args:
        path: of the file; where there is none, there are no lines.
        what: kind of file, for errors.
        limit: largest size in bytes.

    Raises:
        MitsonarError: not readable, or larger than the limit.
    """
    if not path.exists():
        return []
    content = read_bytes(path, what, limit)
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        with path.open("r+b") as file:
            file.truncate(len(whole))
    return whole.splitlines()


def read_json(path: str | Path, *, check: bool = True) -> dict[str, PlainValue]:
    """Read the object in a JSON file.

    Args:
        path: of the file.
        check: see :func:`~mitsonar.io.plain_data.parse_json`.

    Raises:
        MitsonarError: no such file, not JSON, not an object, or beyond the limits of size.
    """
    value = parse_json(read_bytes(path, "file", LARGEST_JSON), str(path), check=check)
    if not isinstance(value, dict):
        raise MitsonarError(f"{path} must hold a JSON object")
    return value


def read_yaml(path: str | Path, what: str, also: str = "") -> PlainValue:
    """Read the value in a YAML file.

    Args:
        path: of the file.
        what: kind of file, for errors.
        also: alternatives to a file, for errors.

    Raises:
        MitsonarError: no such file, not YAML, or beyond the limits of size.
    """
    try:
        content = at_most(path, LARGEST_YAML)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise MitsonarError(f"cannot read {what} {path}: {reason}; give a YAML file{also}") from None
    if len(content) > LARGEST_YAML:
        raise MitsonarError(f"{path} is larger than {LARGEST_YAML:,} bytes: it is no {what}")
    try:
        return parse_yaml(content.decode("utf-8"), str(path))
    except UnicodeDecodeError as error:
        raise MitsonarError(f"{path} is not YAML: byte {error.start:,} is no text in UTF-8") from None


def read_npz(path: str | Path) -> dict[str, FileArray]:
    """Read the arrays of an npz file by name: numbers and texts. Each is checked against its size in the file first.

    Raises:
        ValueError: nothing there, a folder, an empty file, another kind of file; a list of parts, a size or a type that
            cannot be.
        Exception: damaged bytes raise errors of many kinds. The caller puts them into words.
    """
    try:
        with Path(path).open("rb") as raw:
            begin = raw.read(1)
    except OSError as error:
        raise ValueError(f"{error.strerror or error}") from None
    if not begin:
        raise ValueError("it is empty")
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no npz file, or was cut off")
    with zipfile.ZipFile(path) as file:  # read each part to its end: only then is its checksum tested
        parts = file.infolist()
        if any(entry.comment for entry in parts):  # a damaged length of a comment hides other parts
            raise ValueError("its list of parts is damaged")
        if len(parts) > MOST_PARTS or len({entry.filename for entry in parts}) < len(parts):
            raise ValueError("its list of parts holds a name twice, or too many")
        if sum(entry.compress_size for entry in parts) > Path(path).stat().st_size:
            raise ValueError("its parts overlap")
        for entry in parts:
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{entry.filename} is packed in a way that NumPy does not use")
            if entry.file_size > INFLATION * entry.compress_size + 64:
                raise ValueError(f"{entry.filename} says that it unpacks to {entry.file_size:,} bytes, more than can be")
        refuse_beyond_memory(sum(entry.file_size for entry in parts), str(path))
        return {entry.filename.removesuffix(".npy"): _array_in(file.read(entry), entry.filename) for entry in parts}


def refuse_beyond_memory(size: int, source: str) -> None:
    """Refuse an array that this machine cannot hold.

    Args:
        size: of the array in bytes.
        source: is named in errors.

    Raises:
        MitsonarError: it exceeds half of the machine's memory.
    """
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if size > there // 2:
        raise MitsonarError(
            f"{source} would take {size / 2**30:,.4g} GiB of memory, this machine has {there / 2**30:,.4g}: it is damaged, "
            "or must be cut into pieces"
        )


def _array_in(content: bytes, name: str) -> FileArray:
    """Read one array of an npz file, after a check of its header."""
    part = io.BytesIO(content)
    versions = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    found = np.lib.format.read_magic(part)
    if found not in versions:
        raise ValueError(f"{name} has the version {found} of NumPy's format")
    shape, fortran_order, kind = versions[found](part)
    if kind.hasobject or kind.names is not None or kind.kind not in "biufcU":
        raise ValueError(f"{name} holds neither numbers nor text but {str(kind)[:60]}")
    if any(length < 0 for length in shape) or math.prod(shape) * kind.itemsize != len(content) - part.tell():
        raise ValueError(f"{name} says that its shape is {str(shape)[:60]}, its bytes are {len(content) - part.tell():,}")
    values = np.frombuffer(content, kind, math.prod(shape), part.tell()) if kind.itemsize and math.prod(shape) else None
    if values is not None and kind.kind == "U":
        letters = values.view(np.dtype(np.uint32).newbyteorder(kind.byteorder))
        if (letters > LAST_LETTER).any():  # NumPy makes a text of them, which ends others' readers
            raise ValueError(f"{name} holds text that is not Unicode")
    made = np.zeros(shape, kind) if values is None else values.reshape(shape, order="F" if fortran_order else "C")
    return np.array(made)  # writable
