"""Write files atomically, and read files of unknown origin with size checks before any allocation."""

from __future__ import annotations

import datetime
import difflib
import io
import itertools
import json
import math
import os
import stat
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
import yaml
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, short_repr
from mitsonar.io.system import memory_bytes

__all__ = [
    "FileArray",
    "PlainValue",
    "check_plain_value",
    "finite_number",
    "missing_file",
    "parse_json",
    "parse_yaml",
    "read_at_most",
    "read_bytes",
    "read_json",
    "read_npz",
    "read_yaml",
    "refuse_beyond_memory",
    "refuse_irregular",
    "whole_file",
    "whole_number",
    "write_atomic",
    "write_json",
]


MAX_JSON_BYTES = 2**27
"""Largest size of a JSON file [bytes]."""

MAX_YAML_BYTES = 2**20
"""Largest size of a YAML file, which is written by hand [bytes]."""

INFLATION = 1032
"""Largest factor by which deflated data can grow on decompression."""

MAX_CODE_POINT = 0x10FFFF
"""Largest Unicode code point."""

MAX_PARTS = 10_000
"""Largest number of arrays in an npz file."""


FileArray: TypeAlias = NDArray[Any]
"""An array read from a file: numbers of any type, or strings. Its reader checks which."""


def write_atomic(path: str | Path, content: bytes) -> None:
    """Write a file atomically, by renaming a temporary file: a reader finds either the old or the complete new file.

    Raises:
        MitsonarError: if the folder does not exist.
    """
    temporary = _part_of(Path(path))
    with temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file to write in parts; it takes the name of the path at the end, and vanishes on an error.

    Raises:
        MitsonarError: if the folder does not exist.
    """
    part = _part_of(path)
    try:
        with part.open("wb") as file:
            yield file
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _part_of(path: Path) -> Path:
    """Return the temporary file that becomes a path when it is complete; a missing folder is an error."""
    if not path.parent.is_dir():
        raise MitsonarError(f"cannot write {path}: there is no folder {path.parent}; create it first")
    return path.with_name(f".{path.name}.part")


def write_json(path: str | Path, value: dict[str, PlainValue]) -> None:
    """Write a JSON file atomically."""
    write_atomic(path, (json.dumps(value, indent=2) + "\n").encode())


def read_at_most(path: str | Path, limit: int) -> bytes:
    """Read a file up to ``limit`` + 1 bytes, which also works for a device that never ends.

    Raises:
        OSError, ValueError: as for :func:`open`.
    """
    parts: list[bytes] = []
    with Path(path).open("rb") as file:
        while sum(map(len, parts)) <= limit and (part := file.read(min(2**24, limit + 1))):
            parts.append(part)
    return b"".join(parts)[: limit + 1]


def refuse_irregular(path: str | Path, what: str, limit: int | None = None) -> None:
    """Reject anything but a regular file, such as a device that never ends or a pipe without a writer.

    Args:
        path: an existing path.
        what: type of file, for error messages.
        limit: largest size in bytes.

    Raises:
        MitsonarError: a folder, a device, a pipe or a socket; or a file larger than the limit.
    """
    try:
        status = Path(path).stat()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise MitsonarError(f"cannot read {what} {path}: {reason}; give an existing file") from None
    if not stat.S_ISREG(status.st_mode):
        raise MitsonarError(f"{what} {path} is a folder, a device or a pipe: give a file")
    if limit is not None and status.st_size > limit:
        raise MitsonarError(f"{what} {path} is larger than {limit:,} bytes: it is damaged, or something else")


SIMILAR = 0.7
"""Smallest similarity of a file's name at which a message suggests it."""


def missing_file(path: str | Path, otherwise: str = "") -> MitsonarError:
    """Return an error that suggests the file with the most similar name in the folder; ``otherwise`` if there is none."""
    if os.path.islink(path):
        return MitsonarError(f"no such file: {path} is a link to {os.readlink(path)}, which is missing; mend or replace it")
    try:
        names = {name.lower(): name for name in sorted(os.listdir(Path(path).parent))}
    except OSError:
        names = {}
    similar = difflib.get_close_matches(Path(path).name.lower(), names, n=1, cutoff=SIMILAR)
    suggestion = f"did you mean {Path(path).parent / names[similar[0]]}?" if similar else otherwise
    return MitsonarError(f"no such file: {path}{'; ' if suggestion else ''}{suggestion}")


def read_bytes(path: str | Path, what: str, limit: int) -> bytes:
    """Read the bytes of a file up to a limit.

    Args:
        path: path of the file.
        what: type of file, for error messages.
        limit: largest size in bytes.

    Raises:
        MitsonarError: no such file, not readable, or larger than the limit.
    """
    try:
        content = read_at_most(path, limit)
    except FileNotFoundError:
        raise missing_file(path) from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise MitsonarError(f"cannot read {what} {path}: {reason}; give an existing file") from None
    if len(content) > limit:
        raise MitsonarError(f"{what} {path} is larger than {limit:,} bytes: it is damaged, or something else")
    return content


def whole_lines(path: Path, what: str, limit: int) -> list[bytes]:
    """Read the lines of a file that is appended to, and truncate an incomplete last line left by an interrupted run.

    Args:
        path: path of the file; a missing file has no lines.
        what: type of file, for error messages.
        limit: largest size in bytes.

    Raises:
        MitsonarError: not readable, or larger than the limit.
    """
    if not path.exists():
        return []
    content = read_bytes(path, what, limit)
    complete = content[: content.rfind(b"\n") + 1]
    if len(complete) < len(content):
        with path.open("r+b") as file:
            file.truncate(len(complete))
    return complete.splitlines()


def read_json(path: str | Path, *, check: bool = True) -> dict[str, PlainValue]:
    """Read the object in a JSON file.

    Args:
        path: path of the file.
        check: see :func:`~mitsonar.io.files.parse_json`.

    Raises:
        MitsonarError: no such file, not JSON, not an object, or beyond the size limits.
    """
    value = parse_json(read_bytes(path, "file", MAX_JSON_BYTES), str(path), check=check)
    if not isinstance(value, dict):
        raise MitsonarError(f"{path} must hold a JSON object")
    return value


def read_yaml(path: str | Path, what: str, also: str = "") -> PlainValue:
    """Read the value in a YAML file.

    Args:
        path: path of the file.
        what: type of file, for error messages.
        also: alternatives to a file, for error messages.

    Raises:
        MitsonarError: no such file, not YAML, or beyond the size limits.
    """
    try:
        content = read_at_most(path, MAX_YAML_BYTES)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise MitsonarError(f"cannot read {what} {path}: {reason}; give a YAML file{also}") from None
    if len(content) > MAX_YAML_BYTES:
        raise MitsonarError(f"{path} is larger than {MAX_YAML_BYTES:,} bytes: it is not a {what}")
    try:
        return parse_yaml(content.decode("utf-8"), str(path))
    except UnicodeDecodeError as error:
        raise MitsonarError(f"{path} is not YAML: byte {error.start:,} is not valid UTF-8") from None


def read_npz(path: str | Path) -> dict[str, FileArray]:
    """Read the arrays of an npz file by name, numbers and strings, after checking their declared sizes.

    Raises:
        ValueError: a missing or empty file, a folder, another type of file; or an invalid list of parts, size or type.
        Exception: damaged bytes raise many types of errors, which the caller turns into a message.
    """
    try:
        with Path(path).open("rb") as raw:
            first_byte = raw.read(1)
    except OSError as error:
        raise ValueError(f"{error.strerror or error}") from None
    if not first_byte:
        raise ValueError("it is empty")
    if not zipfile.is_zipfile(path):
        raise ValueError("it is not an npz file, or was cut off")
    with zipfile.ZipFile(path) as file:  # each part is read to its end, since only then its checksum is verified
        parts = file.infolist()
        if any(entry.comment for entry in parts):  # a damaged comment length hides other parts
            raise ValueError("its list of parts is damaged")
        if len(parts) > MAX_PARTS or len({entry.filename for entry in parts}) < len(parts):
            raise ValueError("its list of parts holds a name twice, or too many")
        if sum(entry.compress_size for entry in parts) > Path(path).stat().st_size:
            raise ValueError("its parts overlap")
        for entry in parts:
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{entry.filename} has a compression that NumPy does not use")
            if entry.file_size > INFLATION * entry.compress_size + 64:
                raise ValueError(
                    f"{entry.filename} declares {entry.file_size:,} bytes, more than its compressed bytes can hold"
                )
        refuse_beyond_memory(sum(entry.file_size for entry in parts), str(path))
        return {entry.filename.removesuffix(".npy"): _array_in(file.read(entry), entry.filename) for entry in parts}


def refuse_beyond_memory(size: int, source: str) -> None:
    """Reject an array that does not fit into the memory of this machine.

    Args:
        size: size of the array in bytes.
        source: name of the file in error messages.

    Raises:
        MitsonarError: it exceeds half of the machine's memory.
    """
    memory = memory_bytes()
    if size > memory // 2:
        raise MitsonarError(
            f"{source} would take {size / 2**30:,.4g} GiB of memory, this machine has {memory / 2**30:,.4g}: it is damaged, "
            "or must be cut into pieces"
        )


def _array_in(content: bytes, name: str) -> FileArray:
    """Read one array of an npz file, after checking its header."""
    stream = io.BytesIO(content)
    versions = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    format_version = np.lib.format.read_magic(stream)
    if format_version not in versions:
        raise ValueError(f"{name} has the unknown version {format_version} of NumPy's format")
    shape, fortran_order, dtype = versions[format_version](stream)
    if dtype.hasobject or dtype.names is not None or dtype.kind not in "biufcU":
        raise ValueError(f"{name} holds neither numbers nor text but {str(dtype)[:60]}")
    if any(length < 0 for length in shape) or math.prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise ValueError(f"{name} declares the shape {str(shape)[:60]}, but has {len(content) - stream.tell():,} bytes")
    values = np.frombuffer(content, dtype, math.prod(shape), stream.tell()) if dtype.itemsize and math.prod(shape) else None
    if values is not None and dtype.kind == "U":
        code_points = values.view(np.dtype(np.uint32).newbyteorder(dtype.byteorder))
        if (code_points > MAX_CODE_POINT).any():  # NumPy accepts these code points, but they make other readers fail
            raise ValueError(f"{name} holds text that is not Unicode")
    array = np.zeros(shape, dtype) if values is None else values.reshape(shape, order="F" if fortran_order else "C")
    return np.array(array)  # writable


# ---------------- Validation of JSON and YAML contents
# Contents are tables, lists, strings and numbers of plausible size, without circular references.


PlainValue: TypeAlias = Any
"""A value of a file: a table, list, string, number, date or None. Its reader checks which."""

MAX_DEPTH = 40
"""Largest nesting depth of lists and tables."""

MAX_VALUES = 2_000_000
"""Largest number of values in a file, counting a referenced value each time."""

MAX_YAML_VALUES = 100_000
"""Largest number of values in a YAML file, which is written by hand."""

MAX_BRACKETS = 200
"""Largest number of open brackets in a YAML text, including those in comments."""

LARGEST_INTEGER = 2**64
"""Largest magnitude of an integer, which no seed or count exceeds."""

LARGEST_COUNT = 2**63 - 1
"""Largest count that NumPy can represent."""


def parse_json(text: str | bytes, source: str, *, check: bool = True) -> PlainValue:
    """Parse a JSON text.

    Args:
        text: content of the file.
        source: name of the file in error messages.
        check: whether to check depth, size and integers; otherwise the caller must call :func:`check_plain_value`.

    Raises:
        MitsonarError: not JSON, or a depth, size or integer beyond the limits of this module.
    """
    try:
        value = json.loads(text)
    except RecursionError:
        raise MitsonarError(f"{source} nests more than {MAX_DEPTH} deep: it is damaged") from None
    except ValueError as error:
        raise MitsonarError(f"cannot read {source}: it is not JSON ({' '.join(str(error).split())[:160]})") from None
    if check:
        check_plain_value(value, source)
    return value


def parse_yaml(text: str, source: str) -> PlainValue:
    """Parse a YAML text without executing any of it.

    Args:
        text: content of the file.
        source: name of the file in error messages.

    Raises:
        MitsonarError: not YAML, a circular reference, or a depth, size or integer beyond the limits of this module.
    """
    steps = ((c in "[{") - (c in "]}") for c in text if c in "[]{}")  # those in strings and comments as well
    if max(itertools.accumulate(steps), default=0) > MAX_BRACKETS:  # PyYAML would need seconds to reject it
        raise MitsonarError(f"{source} is not YAML: it nests more than {MAX_DEPTH} deep")
    loader: yaml.SafeLoader | None = None
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _check_nodes(node, source)
        value = loader.construct_document(node)
    except MitsonarError:
        raise
    except RecursionError:
        raise MitsonarError(f"{source} is not YAML: it nests more than {MAX_DEPTH} deep") from None
    except Exception as error:  # constructors of numbers and dates raise many types of errors
        raise MitsonarError(f"{source} is not YAML: {' '.join(str(error).split())[:300] or type(error).__name__}") from None
    finally:
        if loader is not None:
            loader.dispose()
    check_plain_value(value, source, MAX_YAML_VALUES)
    return value


def check_plain_value(value: object, source: str, most: int = MAX_VALUES) -> None:
    """Check that a value contains only tables, lists, strings, numbers and dates, within limits of depth and size.

    Args:
        value: value from a reader of JSON, YAML or pickles.
        source: name of the file in error messages.
        most: largest number of values that it may contain.

    Raises:
        MitsonarError: other types, or a value beyond the limits.
    """
    pending: list[tuple[object, int]] = [(value, 0)]
    count = 0
    while pending:
        item, depth = pending.pop()
        count += 1
        if depth > MAX_DEPTH or count > most:
            excess = f"nests more than {MAX_DEPTH} deep" if depth > MAX_DEPTH else f"holds more than {most:,} values"
            raise MitsonarError(f"{source} {excess}, or refers to itself: it is damaged")
        if isinstance(item, dict):
            pending += [(inner, depth + 1) for pair in item.items() for inner in pair]
        elif isinstance(item, list | tuple | set):
            pending += [(inner, depth + 1) for inner in item]
        elif type(item) is int:
            if abs(item) > LARGEST_INTEGER:
                raise MitsonarError(f"{source} holds an integer of {item.bit_length():,} bits: integers have at most 64")
        elif not (item is None or isinstance(item, str | bytes | bool | float | datetime.date)):
            raise MitsonarError(f"{source} holds a {type(item).__name__}: only tables, lists, texts and numbers are allowed")


def whole_number(value: object, name: str, low: int = 0, high: int = LARGEST_COUNT) -> int:
    """Return a value of a file after checking that it is an integer within limits.

    Raises:
        MitsonarError: not an integer, or outside ``low`` .. ``high``.
    """
    if type(value) is not int or not low <= value <= high:
        largest = "2^63" if high == LARGEST_COUNT else f"{high:,}"
        raise MitsonarError(f"{name} must be a whole number in {low:,}..{largest}: got {short_repr(value)}")
    return value


def finite_number(value: Any, name: str, above: float = -math.inf, below: float = math.inf) -> float:
    """Return a value of a file as a float after checking that it is a finite number.

    Raises:
        MitsonarError: not a number, not finite, or not between ``above`` and ``below``.
    """
    if type(value) not in (int, float) or not above < value < below or abs(value) > sys.float_info.max:
        lower = "" if above == -math.inf else f" above {above:g}"
        upper = "" if below == math.inf else f" below {below:g}"
        raise MitsonarError(f"{name} must be a finite number{lower}{upper}: got {short_repr(value)}")
    return float(value)


def _refuse_repeated_keys(node: yaml.MappingNode, source: str) -> None:
    """Refuse a key that a mapping holds twice, which YAML forbids and of which PyYAML takes the last."""
    seen = set()
    for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
        if (key.tag, key.value) in seen:
            line = key.start_mark.line + 1
            raise MitsonarError(f"{source}, line {line}: the key {short_repr(key.value)} occurs twice; leave one out")
        seen.add((key.tag, key.value))


def _check_nodes(node: yaml.Node, source: str) -> None:
    """Check the depth and size of a YAML document before its values are constructed, counting aliases in full."""
    pending, count = [(node, 0)], 0
    while pending:
        item, depth = pending.pop()
        count += 1
        if depth > MAX_DEPTH or count > MAX_YAML_VALUES:
            raise MitsonarError(
                f"{source} is not YAML that can be read: it nests more than {MAX_DEPTH} deep, refers to itself, or holds "
                f"more than {MAX_YAML_VALUES:,} values"
            )
        if isinstance(item, yaml.MappingNode):
            _refuse_repeated_keys(item, source)
            pending += [(inner, depth + 1) for pair in item.value for inner in pair]
        elif isinstance(item, yaml.SequenceNode):
            pending += [(inner, depth + 1) for inner in item.value]
