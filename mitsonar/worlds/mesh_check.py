"""Check a mesh before Mitsuba reads it: it checks no indices, and a wrong index ends the process."""

from __future__ import annotations

import functools
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.io.files import refuse_irregular

__all__ = ["CHECKS", "LARGEST_COORDINATE", "check_counts", "check_mesh", "refuse_foreign_format"]

LARGEST_COORDINATE = 1e12
"""Largest coordinate of vertices, normals and textures: beyond it single precision overflows."""

LONGEST_HEADER = 2**16
"""Largest size of a PLY header [bytes]."""

INFLATION = 1032
"""Largest ratio of inflated to deflated data."""

TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
"""Types of PLY properties to NumPy's types."""

ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


class _FaultError(ValueError):
    """A fault of a mesh file, in words."""


@dataclass
class _Element:
    """An element of a PLY header: its name, its count, and names and types of its properties.

    A list has the type of its count in ``counted``, and holds three values.
    """

    name: str
    count: int
    scalars: dict[str, str] = field(default_factory=dict)
    counted: dict[str, str] = field(default_factory=dict)

    def dtype(self, order: str) -> np.dtype[np.void]:
        """Return the type of one row of a binary file; a list is a count and three values."""
        parts: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for name, kind in self.scalars.items():
            if name in self.counted:
                parts += [(f"count of {name}", order + self.counted[name]), (name, order + kind, (3,))]
            else:
                parts.append((name, order + kind))
        return np.dtype(parts)


def check_mesh(path: str | Path, kind: str) -> None:
    """Check a mesh file, once in a process: counts against its size, indices against vertices, finite numbers.

    Args:
        path: of the file.
        kind: name of the Mitsuba plugin that reads it: ``ply``, ``obj`` or ``serialized``.

    Raises:
        MitsonarError: it is damaged, or has no triangles.
    """
    refuse_irregular(path, "mesh")
    try:
        known = Path(path).stat()
        _check_once(str(path), kind, known.st_size, known.st_mtime_ns)
    except OSError as error:
        raise MitsonarError(f"cannot read mesh {path}: {error.strerror}; give a {kind} file") from None


@functools.lru_cache(maxsize=1024)
def _check_once(path: str, kind: str, size: int, modified_ns: int) -> None:
    del size, modified_ns  # part of the key: a changed file is checked again
    content = Path(path).read_bytes()
    try:
        CHECKS[kind](content)
    except (_FaultError, ValueError, ArithmeticError, UnicodeDecodeError, struct.error, zlib.error, MemoryError) as error:
        if (other := _format_of(Path(path), content)) and other.lower() != kind:
            raise MitsonarError(_foreign(path, other, kind)) from None
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise MitsonarError(f"mesh {path} is damaged: {reason}; export it again") from None


FOREIGN_FORMATS = {
    **{"glb": "glTF", "gltf": "glTF", "dae": "COLLADA", "stl": "STL", "fbx": "FBX", "blend": "Blender", "3mf": "3MF"},
    **{"usd": "USD", "usda": "USD", "usdc": "USD", "usdz": "USD", "urdf": "URDF", "sdf": "SDF", "step": "STEP"},
}
"""Formats of models that Mitsuba does not read, by the end of a file's name."""

BEGINNINGS = {
    **{b"glTF": "glTF", b"ply": "PLY", b"solid": "STL", b"Kaydara FBX": "FBX", b"BLENDER": "Blender"},
    **{b"PXR-USDC": "USD", b"#usda": "USD", b"ISO-10303": "STEP"},
}
"""Formats by the first bytes of a file."""


def refuse_foreign_format(kind: str, filename: str) -> None:
    """Refuse a shape whose type is a format of models that Mitsuba lacks, such as ``glb``.

    Raises:
        MitsonarError: it is; the message says how to make a scene of the file.
    """
    if kind in FOREIGN_FORMATS:
        raise MitsonarError(_foreign(filename, FOREIGN_FORMATS[kind], kind))


def _format_of(path: Path, content: bytes) -> str:
    """Return the format of a model by its first bytes, else by the end of its name; empty where it is unknown."""
    for begin, name in BEGINNINGS.items():
        if content.startswith(begin):
            return name
    head = content[:1000]
    if b"<COLLADA" in head:
        return "COLLADA"
    if head.lstrip().startswith(b"{") and b'"asset"' in content:
        return "glTF"
    if len(content) > 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little"):
        return "STL"
    return FOREIGN_FORMATS.get(path.suffix.lower()[1:], "")


def _foreign(path: str, name: str, kind: str) -> str:
    """Describe what to do with a model in a format that Mitsuba's plugin does not read."""
    reads = f"Mitsuba's shape {kind} does not read it" if kind in CHECKS else f"Mitsuba has no shape {kind}"
    make = {
        "PLY": "name the shape ply",
        "USD": f"`mitsonar world import {path} -o FOLDER` makes a scene of it",
        "FBX": "export it as glTF, for `mitsonar world mesh`",
    }
    make |= {"URDF": make["USD"], "SDF": make["USD"]} | dict.fromkeys(("Blender", "3MF", "STEP"), make["FBX"])
    do = make.get(name, f"`mitsonar world mesh {path} -o FOLDER` makes a scene of it")
    return f"mesh {path} is a file of {name}, and {reads}: the formats are ply, obj and serialized; {do}"


def _check_triangles(indices: NDArray[np.generic], vertices: int, what: str = "a triangle names vertex") -> None:
    """Check that indices, which count from 0, name vertices."""
    if not indices.size:
        raise _FaultError("it has no triangles")
    low, high = int(indices.min()), int(indices.max())
    if low < 0 or high >= vertices:
        raise _FaultError(f"{what} {low if low < 0 else high:,}, there are {vertices:,} (counted from 0)")


def _check_numbers(values: NDArray[np.generic], what: str) -> None:
    if values.size and not np.abs(values).max() <= LARGEST_COORDINATE:
        raise _FaultError(f"{what} must be finite and at most {LARGEST_COORDINATE:g}")


# ---------------------------------------------------------------- PLY


def check_counts(path: Path) -> None:
    """Check that a PLY file has at least the bytes that its header promises; faces may have any number of corners.

    Raises:
        ValueError: it has fewer.
    """
    with path.open("rb") as file:
        order, elements, start = _ply_header(file.read(LONGEST_HEADER), strict=False)
    for element in elements:
        kinds = [element.counted.get(name, kind) for name, kind in element.scalars.items()]
        start += element.count * (2 * len(kinds) if order is None else sum(np.dtype(kind).itemsize for kind in kinds))
    size = path.stat().st_size
    if start > size + 1:
        raise _FaultError(f"its header promises {start:,} bytes at least, it has {size:,}")


def _check_ply(content: bytes) -> None:
    """Check a file in Stanford's PLY, binary or text."""
    order, elements, start = _ply_header(content)
    counts = {element.name: element.count for element in elements}
    if min(counts.get("vertex", 0), counts.get("face", 0)) < 1:
        raise _FaultError("it has no triangles")
    rows = _ply_rows_of_text(content[start:], elements) if order is None else _ply_rows(content, start, elements, order)
    for element, table in zip(elements, rows, strict=False):
        for name, kind in element.scalars.items():
            if name in element.counted and (table[f"count of {name}"] != 3).any():
                raise _FaultError(f"{element.name}: lists of {name} must have 3 entries, triangles")
            if kind.startswith("f") and element.name in ("vertex", "face"):
                _check_numbers(table[name], f"{name} of a {element.name}")
        if element.name == "face":
            _check_triangles(table[next(iter(element.counted))], counts["vertex"])


def _ply_header(content: bytes, strict: bool = True) -> tuple[str | None, list[_Element], int]:
    """Return byte order (None: text), elements, and offset of the data."""
    end = content.find(b"end_header", 0, LONGEST_HEADER)
    stop = content.find(b"\n", end)
    if not content.startswith(b"ply") or end < 0 or stop < 0 or content[end + 10 : stop].strip():
        raise _FaultError("it has no header of PLY")
    first, *lines = (line.split() for line in content[:end].decode("utf-8", "strict").splitlines())
    order, elements = "", list[_Element]()
    if first != ["ply"]:
        raise _FaultError("it has no header of PLY")
    for words in lines:
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", kind, "1.0"] if kind in ORDERS and not order:
                order = kind
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 20:
                elements.append(_Element(name, int(count)))
            case ["property", "list", counted, kind, name] if elements and {counted, kind} <= set(TYPES):
                _add_property(elements[-1], name, TYPES[kind], TYPES[counted])
            case ["property", kind, name] if elements and kind in TYPES:
                _add_property(elements[-1], name, TYPES[kind])
            case _:
                raise _FaultError(f"its header has the line {' '.join(words)[:60]!r}")
    if strict:
        _check_elements(elements)
    if not order:
        raise _FaultError("its header has no format")
    return (None if order == "ascii" else ORDERS[order]), elements, stop + 1


def _add_property(element: _Element, name: str, kind: str, counted: str | None = None) -> None:
    if name in element.scalars:
        raise _FaultError(f"its header names {name} of {element.name} twice")
    element.scalars[name] = kind
    if counted is not None:
        element.counted[name] = counted


def _check_elements(elements: list[_Element]) -> None:
    """Check that a header has the elements and properties of a triangle mesh."""
    names = [element.name for element in elements]
    if len(set(names)) < len(names):
        raise _FaultError("its header names an element twice")
    for element in elements:
        if element.name == "vertex" and (element.counted or not {"x", "y", "z"} <= set(element.scalars)):
            raise _FaultError("its vertices must have x, y and z, and no lists")
        if element.name == "face":
            lists = list(element.counted)
            if lists not in (["vertex_index"], ["vertex_indices"]) or element.scalars[lists[0]].startswith("f"):
                raise _FaultError("its faces must have one list of whole numbers, vertex_index or vertex_indices")


def _ply_rows(content: bytes, start: int, elements: list[_Element], order: str) -> list[NDArray[np.void]]:
    """Read the tables of a binary file, up to its faces."""
    rows = []
    for element in elements:
        kind = element.dtype(order)
        if element.count * kind.itemsize > len(content) - start:
            raise _FaultError(f"{element.count:,} of {element.name} need more bytes than are there")
        rows.append(np.frombuffer(content, kind, element.count, start))
        start += element.count * kind.itemsize
        if element.counted and element.name != "face" and (rows[-1][f"count of {next(iter(element.counted))}"] != 3).any():
            raise _FaultError(f"lists of {element.name} must have 3 entries")
        if {"vertex", "face"} <= {one.name for one in elements[: len(rows)]}:
            break  # Mitsuba reads no further
    if len(rows) == len(elements) and content[start:].strip(b" \t\r\n\0"):
        raise _FaultError(f"{len(content) - start:,} bytes are left over after what its header promises")
    return rows


def _ply_rows_of_text(text: bytes, elements: list[_Element]) -> list[NDArray[np.void]]:
    """Read the tables of a text file, up to its faces."""
    words, start, rows = text.split(), 0, list[NDArray[np.void]]()
    for element in elements:
        width = len(element.scalars) + 3 * len(element.counted)
        if element.count * width > len(words) - start:
            raise _FaultError(f"{element.count:,} of {element.name} need more numbers than are there")
        numbers = np.array(words[start : start + element.count * width], dtype=np.float64).reshape(element.count, width)
        rows.append(_as_table(numbers, element))
        start += element.count * width
        if {"vertex", "face"} <= {one.name for one in elements[: len(rows)]}:
            break
    if len(rows) == len(elements) and start < len(words):
        raise _FaultError(f"{len(words) - start:,} numbers are left over after what its header promises")
    return rows


def _as_table(numbers: NDArray[np.float64], element: _Element) -> NDArray[np.void]:
    """Return the columns of an element by name, and check that integers are whole numbers."""
    kinds: list[tuple[str, type] | tuple[str, type, tuple[int]]] = []
    for name in element.scalars:
        listed = name in element.counted
        kinds += [(f"count of {name}", np.float64), (name, np.float64, (3,))] if listed else [(name, np.float64)]
    table = np.ascontiguousarray(numbers).view(np.dtype(kinds)).reshape(-1)
    for name, kind in element.scalars.items():
        if not kind.startswith("f") and (table[name] != np.rint(table[name])).any():
            raise _FaultError(f"{name} of {element.name} must be whole numbers")
    return table


# ---------------------------------------------------------------- OBJ


def _check_obj(content: bytes) -> None:
    """Check a file in Wavefront OBJ, whose faces name positions, texture coordinates and normals from 1."""
    lines: dict[bytes, list[list[bytes]]] = {b"v": [], b"vt": [], b"vn": [], b"f": []}
    for line in content.splitlines():
        words = line.partition(b"#")[0].split()
        if words and words[0] in lines:
            lines[words[0]].append(words[1:])
    for name in (b"v", b"vt", b"vn"):
        fewest = 2 if name == b"vt" else 3
        if any(len(words) < fewest for words in lines[name]):
            raise _FaultError(f"a line {name.decode()} has fewer than {fewest} numbers")
        _check_numbers(np.array([words[:fewest] for words in lines[name]], dtype=np.float64), f"numbers of {name.decode()}")
    if not lines[b"f"]:
        raise _FaultError("it has no triangles")
    if any(len(words) < 3 for words in lines[b"f"]):
        raise _FaultError("a face must have 3 corners or more")
    corners = [corner.split(b"/") for words in lines[b"f"] for corner in words]
    if any(len(corner) > 3 for corner in corners):
        raise _FaultError("a corner of a face is v, v/vt, v//vn or v/vt/vn")
    for place, name in enumerate((b"v", b"vt", b"vn")):
        named = [corner[place] for corner in corners if len(corner) > place and (corner[place] or place == 0)]
        if any(len(word) > 12 for word in named):
            raise _FaultError("an index of a face is not a number that can be")
        if named:
            indices = np.array(named, dtype=np.int64) - 1
            _check_triangles(indices, len(lines[name]), f"a face names, of its {name.decode()}, number")


# ---------------------------------------------------------------- Mitsuba's own


def _check_serialized(content: bytes) -> None:
    """Check a file of Mitsuba's serialized meshes: several deflated meshes, with a table of offsets at the end."""
    if len(content) < 8:
        raise _FaultError("it is too short")
    (count,) = struct.unpack_from("<I", content, len(content) - 4)
    _, number = struct.unpack_from("<HH", content)
    width = 8 if number >= 4 else 4
    table = len(content) - 4 - count * width
    if count < 1 or table < 4:
        raise _FaultError(f"it promises {count:,} meshes, more than fit in it")
    starts = np.frombuffer(content, "<u8" if width == 8 else "<u4", count, table).tolist()
    for start, stop in zip(starts, [*starts[1:], table], strict=True):
        if not start + 4 < stop <= table:
            raise _FaultError("its table of meshes points outside it")
        _check_one_serialized(content[start:stop])


def _check_one_serialized(content: bytes) -> None:
    """Check one serialized mesh."""
    ours, number = struct.unpack_from("<HH", content)
    if ours != 0x041C or number not in (3, 4):
        raise _FaultError("it is no serialized mesh of version 3 or 4")
    unpack = zlib.decompressobj()
    data = unpack.decompress(content[4:], max_length=INFLATION * len(content))
    (flags,) = struct.unpack_from("<I", data)
    start = 4 if number == 3 else data.index(b"\0", 4) + 1
    vertices, triangles = struct.unpack_from("<QQ", data, start)
    start += 16
    size = 8 if flags & 0x2000 else 4
    columns = 3 + 3 * bool(flags & 0x0001) + 2 * bool(flags & 0x0002) + 3 * bool(flags & 0x0008)
    if vertices * columns * size + triangles * 12 > len(data) - start:
        raise _FaultError(f"{vertices:,} vertices and {triangles:,} triangles need more bytes than are there")
    numbers = np.frombuffer(data, f"<f{size}", vertices * columns, start)
    _check_numbers(numbers, "its numbers")
    _check_triangles(np.frombuffer(data, "<u4", triangles * 3, start + numbers.nbytes), vertices)


CHECKS = {"ply": _check_ply, "obj": _check_obj, "serialized": _check_serialized}
"""Checks by the name of the Mitsuba plugin that reads the file."""
