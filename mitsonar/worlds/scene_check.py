"""Check that a scene is safe to load: its XML text, its parsed objects, and the files that they refer to.

Some damaged scenes and files crash Mitsuba or make it allocate without limit. These checks detect them first.
"""

from __future__ import annotations

import functools
import math
import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mitsonar.errors import MitsonarError, short_repr
from mitsonar.io.files import read_bytes, refuse_beyond_memory, refuse_irregular
from mitsonar.plugins.native_plugins import file_resolver, foreign_names
from mitsonar.worlds.world import Family, World

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = [
    "CHECKS",
    "LARGEST_COORDINATE",
    "SceneFile",
    "check_counts",
    "check_grid",
    "check_mesh",
    "check_parsed",
    "check_tensors",
    "check_text",
    "pixels_of",
    "refuse_foreign_format",
]


MAX_DEPTH = 100
"""Maximum depth of objects that contain or refer to each other."""

MAX_PATHS = 10**8
"""Maximum number of paths along references between objects; Mitsuba follows every one."""

MAX_PIXELS = 2**28
"""Maximum number of pixels of all pictures of a scene."""

BYTES_PER_PIXEL = 28
"""Memory that Mitsuba needs per pixel [bytes]: for the stored value and for its conversion to single precision."""

PICTURES = ("bitmap", "envmap")

CONTAINERS = {"blendbsdf": "bsdf", "merge": "shape", "shapegroup": "shape", "volume": "volume"}
"""Plugins that consist of other objects, and the type of those objects."""

REFRACTING = ("material", "int_ior", "ext_ior")
"""Properties that name a file of ``data/ior``, without its extension."""


def check_parsed(state: mi.parser.ParserState) -> None:
    """Check a scene that Mitsuba has parsed, before it creates the objects: names, numbers, references and files.

    Included files and parameters are resolved at this stage. Mitsuba's file resolver must search the scene's folders.

    Args:
        state: parsed state of the scene.

    Raises:
        MitsonarError: a plugin name is invalid, a number is not finite, references are too many or
            circular, a mesh or a picture is damaged, a named file is not a regular file, a bitmap has no file, or a group is
            empty.
    """
    import mitsuba as mi

    for node in state.nodes:
        if node.type == mi.ObjectType.Shape:
            refuse_foreign_format(node.props.plugin_name(), str(node.props.get("filename", "")))
    foreign_names(node.props.plugin_name() for node in state.nodes)
    _check_references(state)
    _refuse_incomplete(state)
    pixels = 0
    for node in state.nodes:
        for name in list(node.props):
            try:
                _check_numbers(node.props, name)
                pixels += _check_file(node, name)
            except MitsonarError as error:
                where = f"{node.props.plugin_name()} {node.props.id()}".strip()[:100]
                raise MitsonarError(f"{where}, {name[:60]}: {error}") from None
    if pixels > MAX_PIXELS:
        raise MitsonarError(
            f"its pictures have {pixels:,} pixels, more than the maximum of {MAX_PIXELS:,}: make them smaller"
        )
    refuse_beyond_memory(BYTES_PER_PIXEL * pixels, "its pictures")


def _check_numbers(props: mi.Properties, name: str) -> None:
    """Check that a number is not nan, and that transforms, vectors and colours are finite and not too large.

    Objects with coordinates beyond single precision would vanish silently.
    """
    import mitsuba as mi

    kinds = mi.Properties.Type
    kind = props.type(name)
    value: Any = props[name] if kind in (kinds.Float, kinds.Transform, kinds.Vector, kinds.Color) else 0.0
    if kind == kinds.Float and math.isnan(value):
        raise MitsonarError("got nan; give a number")
    if kind not in (kinds.Transform, kinds.Vector, kinds.Color):
        return
    numbers = np.array(value.matrix if kind == kinds.Transform else value, dtype=float)
    if not (np.abs(numbers) <= LARGEST_COORDINATE).all():
        invalid = numbers[~(np.abs(numbers) <= LARGEST_COORDINATE)][0]
        raise MitsonarError(f"got {invalid:g}; give finite numbers, with magnitudes up to {LARGEST_COORDINATE:g}")


def _check_file(node: mi.parser.SceneNode, name: str) -> int:
    """Check the file that a property names, if any; return its number of pixels, 0 unless it is a picture."""
    import mitsuba as mi

    if node.props.type(name) != mi.Properties.Type.String:
        return 0
    plugin, value = node.props.plugin_name(), str(node.props[name])
    for path in _named_files(value, name):
        if name != "filename":
            if not path.is_dir():
                refuse_irregular(path, "file")
        elif plugin in CHECKS:
            check_mesh(path, plugin)
        elif plugin in PICTURES:
            return pixels_of(path)
        elif plugin in ("gridvolume", "sdfgrid"):
            check_grid(path)
        elif plugin in ("measured", "measured_polarized"):
            check_tensors(path)
        else:
            refuse_irregular(path, "file")
            if plugin.startswith("ellipsoids"):
                _check_ellipsoids(path)
    return 0


def _check_ellipsoids(path: Path) -> None:
    try:
        check_counts(path)
    except ValueError as error:
        raise MitsonarError(f"{path} is damaged: {error}; export it again") from None


def _named_files(value: str, name: str) -> Iterator[Path]:
    """Yield the files that Mitsuba finds for the value of a property."""
    if "\0" in value:
        raise MitsonarError("a value contains a zero byte: remove it")
    values = [f"data/ior/{value}.{part}.spd" for part in ("eta", "k")] if name in REFRACTING else [value]
    for candidate in values:
        path = Path(str(file_resolver().resolve(candidate)))
        try:
            if candidate and path.exists():
                yield path
        except OSError:  # for example a name that is too long
            if name == "filename":
                raise MitsonarError(f"no file can have the name {short_repr(value)}") from None


def _refuse_incomplete(state: mi.parser.ParserState) -> None:
    """Reject incomplete objects, on which Mitsuba crashes or fails late."""
    import mitsuba as mi

    kinds = mi.Properties.Type
    for node in state.nodes:
        plugin, types = node.props.plugin_name(), {name: node.props.type(name) for name in node.props}
        where = f"{plugin} {node.props.id()}".strip()[:100]
        if plugin == "bitmap" and types.get("filename") != kinds.String:
            raise MitsonarError(f'{where} has no file: give <string name="filename" value="..."/>')
        if plugin in CONTAINERS and kinds.ResolvedReference not in types.values():
            raise MitsonarError(f"{where} is empty: add a {CONTAINERS[plugin]} to it, or remove it")


def _check_references(state: mi.parser.ParserState) -> None:
    """Check the depth of references between objects, and the number of paths along them.

    Mitsuba's search for circular references follows every path.
    """
    import mitsuba as mi

    # 1. List the objects that each object contains or refers to.
    kinds = mi.Properties.Type
    ids = state.id_to_index
    children: list[list[int]] = []
    for node in state.nodes:
        references = []
        for name in list(node.props):
            kind = node.props.type(name)
            if kind == kinds.ResolvedReference:
                references.append(int(node.props[name].index()))
            elif kind == kinds.Reference and node.props[name].id() in ids:
                references.append(int(ids[node.props[name].id()]))
        children.append(references)
    # 2. Count paths and depth of each object after those of its children: a depth-first search without recursion. An object
    #    that is reached again while it is `waiting` closes a cycle.
    path_counts, depths = [0] * len(children), [0] * len(children)
    for root in range(len(children)):
        path = [] if path_counts[root] else [(root, iter(children[root]))]
        waiting = {root}
        while path:
            number, remaining = path[-1]
            child = next(remaining, None)
            if child is None:
                path_counts[number] = min(1 + sum(path_counts[one] for one in children[number]), MAX_PATHS + 1)
                depths[number] = 1 + max((depths[one] for one in children[number]), default=0)
                waiting.discard(number)
                path.pop()
            elif child in waiting:
                raise MitsonarError("its objects refer to each other in a cycle: remove one of the references")
            elif not path_counts[child]:
                path.append((child, iter(children[child])))
                waiting.add(child)
    if max(depths, default=0) > MAX_DEPTH:
        raise MitsonarError(f"its objects refer to each other more than {MAX_DEPTH} levels deep: it is not a scene")
    if sum(path_counts) > MAX_PATHS:
        raise MitsonarError(f"its objects refer to each other along more than {MAX_PATHS:,} paths: it is not a scene")


# ---------------- World ``scene``: a user's own file


class SceneFile(Family):
    """An existing Mitsuba XML file; the seed determines only the motion of the vehicle."""

    called: ClassVar[str] = "scene"
    described: ClassVar[str] = "docs/guides/data-sets.md, `A scene of your own`"

    file: str = Field(description="the XML file; in a recipe, relative to the recipe's folder")
    size_m: float = Field(gt=0, le=1e6, description="side length of the square around the origin to stay inside [m]")
    parameters: dict[str, str] = Field(default_factory=dict, description="values of the scene's $names")

    @property
    def seeded(self) -> bool:
        """Return False: the scene is the same for each seed."""
        return False

    def check_scene_extent(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Reject a ``size_m`` whose square extends beyond the shapes of the file, where frames would be empty.

        Args:
            low: minimum x, y, z of the scene ``(3,)`` [m].
            high: maximum x, y, z of the scene ``(3,)`` [m].

        Raises:
            MitsonarError: the square is too large, or the scene has no shapes.
        """
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise MitsonarError(f"{self.file} contains nothing that a sonar could see: give a scene with shapes")
        fits = 2 * max(0.0, float(min(-low[0], -low[1], high[0], high[1])))
        if self.size_m > fits * (1 + 1e-3):
            raise MitsonarError(
                f"world.size_m, {self.size_m:g} m, is too large for {self.file}, which covers x {low[0]:.3g}..{high[0]:.3g} "
                f"m and y {low[1]:.3g}..{high[1]:.3g} m: frames taken beyond it would be empty; give at most {fits:.3g} (a "
                "square around the origin), or enlarge the ground"
            )

    def build(self, seed: int) -> World:
        """Raise an error: the scene already exists.

        Raises:
            MitsonarError: always.
        """
        raise MitsonarError(f"{self.file} is already a scene: there is nothing to build")

    def prepare(self, seed: int, folder: Path) -> tuple[Path, dict[str, str]]:
        """Return the file and its parameters; nothing is written.

        Raises:
            MitsonarError: the file does not exist.
        """
        if not os.path.isfile(self.file):
            raise MitsonarError(f"no scene file {self.file}: world.file must name an existing Mitsuba XML file")
        return Path(self.file), self.parameters


# ---------------- XML text


MAX_XML_BYTES = 2**28
"""Maximum size of a scene's XML, including all files that it includes [bytes]."""

MAX_SPECTRUM_BYTES = 2**22
"""Maximum size of a spectrum file [bytes]."""

MAX_ELEMENTS = 2_000_000
"""Maximum number of elements."""

MAX_FILES = 1_000
"""Maximum number of files read, counting repeated includes."""

MAX_INCLUDE_DEPTH = 15
"""Maximum depth of nested includes, equal to Mitsuba's limit."""

MAX_PARAMETERS = 1_000
"""Maximum number of parameters; Mitsuba compares all pairs."""

MAX_VALUE_LENGTH = 2**16
"""Maximum length of an attribute after parameter substitution [characters]."""

MAX_WORK = 2**31
"""Maximum number of characters that Mitsuba may compare and move to substitute parameters; takes about a second."""

SEARCH_COST = 300
"""Cost of one search for a parameter, as an equivalent number of characters."""

SKIPPED = {b"<!--": b"-->", b"<![CDATA[": b"]]>", b"<?": b"?>"}
"""Start and end markers of markup that is not an element."""

NAME = rb"[A-Za-z_:\x80-\xff][A-Za-z0-9_:.\x80-\xff-]*+"
OPENED = re.compile(rb"<(" + NAME + rb")((?:\s*+" + NAME + rb"\s*+=\s*+(?:\"[^\"]*+\"|'[^']*+'))*+)\s*+(/?)>")
CLOSED = re.compile(rb"</(" + NAME + rb")\s*+>")
ATTRIBUTE = re.compile(rb"(" + NAME + rb")\s*+=\s*+(?:\"([^\"]*+)\"|'([^']*+)')")
DOCTYPE = re.compile(rb"<!DOCTYPE[^\[<>\"']*+>")
LATIN = re.compile(rb"\s*<\?xml[^>]*encoding\s*=\s*[\"'](?:iso-8859-1|latin1)[\"']", re.IGNORECASE)
ENTITY = re.compile(r"&(?:#([0-9]+)|#x([0-9a-fA-F]+)|(amp|lt|gt|quot|apos));")
ENTITIES = {"amp": "&", "lt": "<", "gt": ">", "quot": '"', "apos": "'"}


def check_text(path: Path, parameters: dict[str, str], folders: list[Path]) -> None:
    """Check the XML file of a scene, and the files that it includes, before Mitsuba reads them.

    Mitsuba's parser recurses, follows every include and copies every parameter without a limit. The check reads the text
    as that parser does, in one pass.

    Args:
        path: XML file of the scene.
        parameters: values of the scene's parameters ``$name``, keyed by name.
        folders: folders that Mitsuba searches for the files that the scene names.

    Raises:
        MitsonarError: the text is malformed, nests too deeply, is too large, includes too much, or refers to something
            that is not a regular file.
    """
    _Text(dict(parameters)).check(path, folders, 0)


@dataclass
class _Text:
    """State of the check of a scene's text.

    Attributes:
        values: values of the parameters, keyed by name.
        size: total size of the files read [bytes].
        files: number of files read.
        elements: number of elements read.
        work: characters compared and moved to replace parameters.
        longest_first: names of the parameters in the order in which Mitsuba replaces them, the longest first.
    """

    values: dict[str, str]
    size: int = 0
    files: int = 0
    elements: int = 0
    work: int = 0
    longest_first: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.longest_first = sorted(self.values, key=len, reverse=True)
        self._count(len(self.values))

    def check(self, path: Path, folders: list[Path], depth: int) -> None:
        """Check a file and its includes, and search ``folders`` for the files that it names; ``<path>`` adds a folder."""
        if depth >= MAX_INCLUDE_DEPTH:
            raise MitsonarError(
                f"{path} is included {depth} files deep, but the maximum is {MAX_INCLUDE_DEPTH}: does it include itself?"
            )
        self.files += 1
        if self.files > MAX_FILES:
            raise MitsonarError(f"{path} is one of more than {MAX_FILES:,} files that the scene includes: include fewer")
        refuse_irregular(path, "scene", MAX_XML_BYTES - self.size)
        content = _utf8(read_bytes(path, "scene", MAX_XML_BYTES - self.size), path)
        self.size += len(content)
        for name, attributes in self._elements(content, path):
            plain = b"$" not in attributes and b"&" not in attributes and name not in EVALUATED
            values = {} if plain else self._expanded(attributes, path)
            match name:
                case b"default":
                    self._add(values.get("name", ""), values.get("value", ""))
                case b"include":
                    include_folders = [path.parent, *folders]
                    target = _find_file(values.get("filename", ""), include_folders)
                    if target is not None:
                        self.check(target, include_folders, depth + 1)
                case b"path":
                    target = _find_file(values.get("value", ""), [path.parent, *folders])
                    folders[:0] = [target] if target is not None else []
                case b"spectrum":
                    target = _find_file(values.get("filename", ""), folders)
                    if target is not None:
                        refuse_irregular(target, "spectrum", MAX_SPECTRUM_BYTES)

    def _elements(self, content: bytes, path: Path) -> Iterator[tuple[bytes, bytes]]:
        """Yield the name and the attributes of each element."""
        open_elements: list[bytes] = []
        elements_before, position = self.elements, content.find(b"<")
        while position >= 0:
            marked = content[position + 1 : position + 2] in (b"!", b"?")
            skipped = next((begin for begin in SKIPPED if marked and content.startswith(begin, position)), None)
            if skipped is not None:
                end = content.find(SKIPPED[skipped], position + len(skipped))
                if end < 0:
                    raise _malformed(path, content, position, f"a {skipped.decode()} is not terminated")
                position = content.find(b"<", end)
                continue
            if (tag := OPENED.match(content, position)) is not None:
                name, attributes, closed = tag.groups()
                if not open_elements and self.elements > elements_before:
                    raise _malformed(path, content, position, "there is a second root element")
                self.elements += 1
                if self.elements > MAX_ELEMENTS:
                    raise MitsonarError(f"{path} has more than {MAX_ELEMENTS:,} elements: put the shapes into mesh files")
                if not closed:
                    open_elements.append(name)
                if len(open_elements) > MAX_DEPTH:
                    raise MitsonarError(f"{path} nests its elements more than {MAX_DEPTH} levels deep: it is not a scene")
                yield name, attributes
            elif (tag := CLOSED.match(content, position)) is not None:
                if not open_elements or open_elements.pop() != tag[1]:
                    raise _malformed(path, content, position, "a closing tag does not match an open element")
            # A longer document type may define entities.
            elif open_elements or (tag := DOCTYPE.match(content, position)) is None:
                raise _malformed(path, content, position, "the XML of an element or of one of its attributes is malformed")
            position = content.find(b"<", tag.end())
        if open_elements:
            raise _malformed(
                path, content, len(content), f"<{open_elements[-1].decode('utf-8', 'replace')[:40]}> is not closed"
            )

    def _expanded(self, attributes: bytes, path: Path) -> dict[str, str]:
        """Return attributes by name, with their parameters replaced as Mitsuba replaces them."""
        values: dict[str, str] = {}
        for name, double, single in ATTRIBUTE.findall(attributes):
            raw = (double or single).replace(b"\r\n", b" ").translate(SPACES)
            value = ENTITY.sub(_character, raw.decode("utf-8", "surrogateescape"))
            if "$" in value:
                value = self._replaced(value, path)
            values.setdefault(name.decode("utf-8", "surrogateescape"), value)
        return values

    def _replaced(self, value: str, path: Path) -> str:
        for name in self.longest_first:
            key, new, position = f"${name}", self.values[name], 0
            self._work(len(value), path)
            while (position := value.find(key, position)) >= 0:
                if value[:position].endswith("\\"):
                    position += len(key)
                    continue
                value = value[:position] + new + value[position + len(key) :]
                position += len(new)
                self._work(len(value), path)
                if len(value) > MAX_VALUE_LENGTH:
                    raise MitsonarError(
                        f"{path} has a value that parameter substitution makes longer than {MAX_VALUE_LENGTH:,} characters"
                    )
        return value.replace("\\$", "$")

    def _work(self, characters: int, path: Path) -> None:
        self.work += characters + SEARCH_COST
        if self.work > MAX_WORK:
            raise MitsonarError(f"{path} uses its parameters too often: write the values directly")

    def _count(self, parameters: int) -> None:
        if parameters > MAX_PARAMETERS:
            raise MitsonarError(f"a scene may have at most {MAX_PARAMETERS:,} parameters: write the values directly")

    def _add(self, name: str, value: str) -> None:
        """Add the default of a parameter, unless the parameter already has a value."""
        if name in self.values or not name:
            return
        self.values[name] = value
        self._count(len(self.values))
        position = next((k for k, other in enumerate(self.longest_first) if len(name) > len(other)), len(self.longest_first))
        self.longest_first.insert(position, name)


SPACES = bytes.maketrans(b"\t\r\n", b"   ")
"""Translation of whitespace in attributes to spaces."""

EVALUATED = (b"default", b"include", b"path", b"spectrum")
"""Elements whose attributes the check evaluates."""


def _utf8(content: bytes, path: Path) -> bytes:
    """Convert text to UTF-8 from UTF-16 with a byte order mark, or from Latin-1 with an XML declaration."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        try:
            content = content.decode("utf-16").encode()
        except UnicodeDecodeError:
            raise MitsonarError(f"{path} is not text: save it as UTF-8") from None
    elif LATIN.match(content):
        content = content.decode("latin-1").encode()
    if b"\0" in content:
        raise MitsonarError(f"{path} contains a zero byte: it is damaged, or not UTF-8 text")
    return content


def _character(entity: re.Match[str]) -> str:
    """Return the character that an entity represents."""
    decimal, hexadecimal, name = entity.groups()
    if name:
        return ENTITIES[name]
    digits = (decimal or hexadecimal).lstrip("0")
    number = int(digits or "0", 10 if decimal else 16) if len(digits) < 10 else 0x110000
    if not 0 < number < 0x110000 or 0xD800 <= number < 0xE000:
        raise MitsonarError(f"the scene has {short_repr(entity[0])}, which is not a character")
    return chr(number)


def _find_file(name: str, folders: list[Path]) -> Path | None:
    """Return the file that Mitsuba finds for a name, or None."""
    if not name or "\0" in name:
        return None
    try:
        return next((path for path in [*(folder / name for folder in folders), Path(name)] if path.exists()), None)
    except OSError:  # for example a name that is too long
        raise MitsonarError(f"no file can have the name {short_repr(name)}") from None


def _malformed(path: Path, content: bytes, place: int, reason: str) -> MitsonarError:
    line = content.count(b"\n", 0, place) + 1
    return MitsonarError(f"{path}, line {line:,}: {reason}")


# ---------------- Meshes: common checks


LARGEST_COORDINATE = 1e12
"""Largest magnitude of vertices, normals and texture coordinates; beyond it single precision overflows."""

MAX_PLY_HEADER_BYTES = 2**16
"""Maximum size of a PLY header [bytes]."""

MESH_INFLATION = 1032
"""Largest possible ratio of inflated to deflated data."""

TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
"""NumPy types, keyed by PLY type name."""

ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


class _FaultError(ValueError):
    """A fault of a mesh file; the message describes it."""


@dataclass
class _Element:
    """An element of a PLY header: its name, its count, and the types of its properties, keyed by name.

    For a list, ``scalars`` has the type of its values and ``counted`` the type of its count. Lists have three values.
    """

    name: str
    count: int
    scalars: dict[str, str] = field(default_factory=dict)
    counted: dict[str, str] = field(default_factory=dict)

    def dtype(self, order: str) -> np.dtype[np.void]:
        """Return the NumPy type of one row of a binary file; a list becomes a count and three values."""
        parts: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for name, kind in self.scalars.items():
            if name in self.counted:
                parts += [(f"count of {name}", order + self.counted[name]), (name, order + kind, (3,))]
            else:
                parts.append((name, order + kind))
        return np.dtype(parts)


def check_mesh(path: str | Path, kind: str) -> None:
    """Check a mesh file: counts against the file's size, indices against the number of vertices, and finite numbers.

    Mitsuba does not check indices, and an invalid index crashes it. An unchanged file is checked once per process.

    Args:
        path: mesh file.
        kind: name of the Mitsuba plugin that reads it: ``ply``, ``obj`` or ``serialized``.

    Raises:
        MitsonarError: the file is unreadable, damaged, or has no triangles.
    """
    refuse_irregular(path, "mesh")
    try:
        status = Path(path).stat()
        _check_once(str(path), kind, status.st_size, status.st_mtime_ns)
    except OSError as error:
        raise MitsonarError(f"cannot read mesh {path}: {error.strerror}; give a {kind} file") from None


@functools.lru_cache(maxsize=1024)
def _check_once(path: str, kind: str, size: int, modified_ns: int) -> None:
    del size, modified_ns  # part of the cache's key: a changed file is checked again
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
"""Model formats that Mitsuba does not read, keyed by file extension."""

BEGINNINGS = {
    **{b"glTF": "glTF", b"ply": "PLY", b"solid": "STL", b"Kaydara FBX": "FBX", b"BLENDER": "Blender"},
    **{b"PXR-USDC": "USD", b"#usda": "USD", b"ISO-10303": "STEP"},
}
"""Model formats, keyed by the first bytes of a file."""


def refuse_foreign_format(kind: str, filename: str) -> None:
    """Reject a shape whose type is a model format that Mitsuba does not read, such as ``glb``.

    Raises:
        MitsonarError: the type is such a format; the message explains how to convert the file to a scene.
    """
    if kind in FOREIGN_FORMATS:
        raise MitsonarError(_foreign(filename, FOREIGN_FORMATS[kind], kind))


def _format_of(path: Path, content: bytes) -> str:
    """Return the format of a model from its content, or else from its file extension; empty if unknown."""
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
    """Return a message that explains what to do with a model in a format that Mitsuba's plugin does not read."""
    problem = f"Mitsuba's shape {kind} does not read it" if kind in CHECKS else f"Mitsuba has no shape {kind}"
    remedies = {
        "PLY": "name the shape ply",
        "USD": f"`mitsonar world import {path} -o FOLDER` converts it to a scene",
        "FBX": "export it as glTF, for `mitsonar world mesh`",
    }
    remedies |= {"URDF": remedies["USD"], "SDF": remedies["USD"]} | dict.fromkeys(
        ("Blender", "3MF", "STEP"), remedies["FBX"]
    )
    advice = remedies.get(name, f"`mitsonar world mesh {path} -o FOLDER` converts it to a scene")
    return f"mesh {path} is in the format {name}, and {problem}: supported formats are ply, obj and serialized; {advice}"


def _check_triangles(indices: NDArray[np.generic], vertices: int, what: str = "a triangle refers to vertex") -> None:
    """Check that indices, counted from 0, refer to existing vertices."""
    if not indices.size:
        raise _FaultError("it has no triangles")
    low, high = int(indices.min()), int(indices.max())
    if low < 0 or high >= vertices:
        raise _FaultError(f"{what} {low if low < 0 else high:,}, but there are {vertices:,} (counted from 0)")


def _check_mesh_numbers(values: NDArray[np.generic], what: str) -> None:
    if values.size and not np.abs(values).max() <= LARGEST_COORDINATE:
        raise _FaultError(f"{what} must be finite and at most {LARGEST_COORDINATE:g}")


# ---------------- Meshes: PLY


def check_counts(path: Path) -> None:
    """Check that a PLY file has at least as many bytes as its header declares; faces may have any number of corners.

    Raises:
        ValueError: the file is too short.
    """
    with path.open("rb") as file:
        order, elements, start = _ply_header(file.read(MAX_PLY_HEADER_BYTES), strict=False)
    for element in elements:
        kinds = [element.counted.get(name, kind) for name, kind in element.scalars.items()]
        start += element.count * (2 * len(kinds) if order is None else sum(np.dtype(kind).itemsize for kind in kinds))
    size = path.stat().st_size
    if start > size + 1:
        raise _FaultError(f"its header declares at least {start:,} bytes, but it has {size:,}")


def _check_ply(content: bytes) -> None:
    """Check a PLY file, binary or text."""
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
                _check_mesh_numbers(table[name], f"{name} of a {element.name}")
        if element.name == "face":
            _check_triangles(table[next(iter(element.counted))], counts["vertex"])


def _ply_header(content: bytes, strict: bool = True) -> tuple[str | None, list[_Element], int]:
    """Parse a PLY header; return the byte order (None: text), the elements, and the offset of the data."""
    end = content.find(b"end_header", 0, MAX_PLY_HEADER_BYTES)
    stop = content.find(b"\n", end)
    if not content.startswith(b"ply") or end < 0 or stop < 0 or content[end + 10 : stop].strip():
        raise _FaultError("it has no PLY header")
    first, *lines = (line.split() for line in content[:end].decode("utf-8", "strict").splitlines())
    order, elements = "", list[_Element]()
    if first != ["ply"]:
        raise _FaultError("it has no PLY header")
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
                raise _FaultError(f"its header has an invalid line, {' '.join(words)[:60]!r}")
    if strict:
        _check_elements(elements)
    if not order:
        raise _FaultError("its header has no format")
    return (None if order == "ascii" else ORDERS[order]), elements, stop + 1


def _add_property(element: _Element, name: str, kind: str, counted: str | None = None) -> None:
    if name in element.scalars:
        raise _FaultError(f"its header declares {name} of {element.name} twice")
    element.scalars[name] = kind
    if counted is not None:
        element.counted[name] = counted


def _check_elements(elements: list[_Element]) -> None:
    """Check that a header has the elements and properties of a triangle mesh."""
    names = [element.name for element in elements]
    if len(set(names)) < len(names):
        raise _FaultError("its header declares an element twice")
    for element in elements:
        if element.name == "vertex" and (element.counted or not {"x", "y", "z"} <= set(element.scalars)):
            raise _FaultError("its vertices must have x, y and z, and no lists")
        if element.name == "face":
            lists = list(element.counted)
            if lists not in (["vertex_index"], ["vertex_indices"]) or element.scalars[lists[0]].startswith("f"):
                raise _FaultError("its faces must have one list of integers, vertex_index or vertex_indices")


def _ply_rows(content: bytes, start: int, elements: list[_Element], order: str) -> list[NDArray[np.void]]:
    """Read the tables of a binary file, up to its faces."""
    rows = []
    for element in elements:
        kind = element.dtype(order)
        if element.count * kind.itemsize > len(content) - start:
            raise _FaultError(f"{element.count:,} rows of {element.name} need more bytes than the file has")
        rows.append(np.frombuffer(content, kind, element.count, start))
        start += element.count * kind.itemsize
        if element.counted and element.name != "face" and (rows[-1][f"count of {next(iter(element.counted))}"] != 3).any():
            raise _FaultError(f"lists of {element.name} must have 3 entries")
        if {"vertex", "face"} <= {one.name for one in elements[: len(rows)]}:
            break  # Mitsuba ignores what follows
    if len(rows) == len(elements) and content[start:].strip(b" \t\r\n\0"):
        raise _FaultError(f"{len(content) - start:,} bytes remain after the data that its header declares")
    return rows


def _ply_rows_of_text(text: bytes, elements: list[_Element]) -> list[NDArray[np.void]]:
    """Read the tables of a text file, up to its faces."""
    words, start, rows = text.split(), 0, list[NDArray[np.void]]()
    for element in elements:
        width = len(element.scalars) + 3 * len(element.counted)
        if element.count * width > len(words) - start:
            raise _FaultError(f"{element.count:,} rows of {element.name} need more numbers than the file has")
        numbers = np.array(words[start : start + element.count * width], dtype=np.float64).reshape(element.count, width)
        rows.append(_as_table(numbers, element))
        start += element.count * width
        if {"vertex", "face"} <= {one.name for one in elements[: len(rows)]}:
            break
    if len(rows) == len(elements) and start < len(words):
        raise _FaultError(f"{len(words) - start:,} numbers remain after the data that its header declares")
    return rows


def _as_table(numbers: NDArray[np.float64], element: _Element) -> NDArray[np.void]:
    """Return the numbers of an element as a table with named columns; check that integer columns have integer values."""
    kinds: list[tuple[str, type] | tuple[str, type, tuple[int]]] = []
    for name in element.scalars:
        listed = name in element.counted
        kinds += [(f"count of {name}", np.float64), (name, np.float64, (3,))] if listed else [(name, np.float64)]
    table = np.ascontiguousarray(numbers).view(np.dtype(kinds)).reshape(-1)
    for name, kind in element.scalars.items():
        if not kind.startswith("f") and (table[name] != np.rint(table[name])).any():
            raise _FaultError(f"{name} of {element.name} must be integers")
    return table


# ---------------- Meshes: OBJ


def _check_obj(content: bytes) -> None:
    """Check a Wavefront OBJ file, whose faces refer to positions, texture coordinates and normals, counted from 1."""
    # 1. Collect the lines of each kind.
    lines: dict[bytes, list[list[bytes]]] = {b"v": [], b"vt": [], b"vn": [], b"f": []}
    for line in content.splitlines():
        words = line.partition(b"#")[0].split()
        if words and words[0] in lines:
            lines[words[0]].append(words[1:])
    # 2. Check positions, texture coordinates and normals.
    for name in (b"v", b"vt", b"vn"):
        fewest = 2 if name == b"vt" else 3
        if any(len(words) < fewest for words in lines[name]):
            raise _FaultError(f"a line of {name.decode()} has fewer than {fewest} numbers")
        _check_mesh_numbers(
            np.array([words[:fewest] for words in lines[name]], dtype=np.float64), f"numbers of {name.decode()}"
        )
    # 3. Check the indices of the faces; texture coordinates and normals are optional.
    if not lines[b"f"]:
        raise _FaultError("it has no triangles")
    if any(len(words) < 3 for words in lines[b"f"]):
        raise _FaultError("a face must have 3 corners or more")
    corners = [corner.split(b"/") for words in lines[b"f"] for corner in words]
    if any(len(corner) > 3 for corner in corners):
        raise _FaultError("a corner of a face must be v, v/vt, v//vn or v/vt/vn")
    for place, name in enumerate((b"v", b"vt", b"vn")):
        named = [corner[place] for corner in corners if len(corner) > place and (corner[place] or place == 0)]
        if any(len(word) > 12 for word in named):
            raise _FaultError("an index of a face is too large")
        if named:
            indices = np.array(named, dtype=np.int64) - 1
            _check_triangles(indices, len(lines[name]), f"a face refers to {name.decode()} number")


# ---------------- Meshes: Mitsuba's serialized format


def _check_serialized(content: bytes) -> None:
    """Check a file in Mitsuba's serialized format: deflated meshes, followed by a table of their offsets."""
    if len(content) < 8:
        raise _FaultError("it is too short")
    (count,) = struct.unpack_from("<I", content, len(content) - 4)
    _, version = struct.unpack_from("<HH", content)
    width = 8 if version >= 4 else 4
    table = len(content) - 4 - count * width
    if count < 1 or table < 4:
        raise _FaultError(f"it declares {count:,} meshes, more than fit in it")
    starts = np.frombuffer(content, "<u8" if width == 8 else "<u4", count, table).tolist()
    for start, stop in zip(starts, [*starts[1:], table], strict=True):
        if not start + 4 < stop <= table:
            raise _FaultError("its table of meshes points outside the file")
        _check_one_serialized(content[start:stop])


def _check_one_serialized(content: bytes) -> None:
    """Check one serialized mesh: a version, then deflated flags, name, counts, columns of numbers and triangles."""
    signature, version = struct.unpack_from("<HH", content)
    if signature != 0x041C or version not in (3, 4):
        raise _FaultError("it is not a serialized mesh of version 3 or 4")
    # 1. Inflate the data, up to the largest possible size.
    inflater = zlib.decompressobj()
    data = inflater.decompress(content[4:], max_length=MESH_INFLATION * len(content))
    # 2. Read flags and counts; a mesh of version 4 has its name between them. The flags determine precision and columns.
    (flags,) = struct.unpack_from("<I", data)
    start = 4 if version == 3 else data.index(b"\0", 4) + 1
    vertices, triangles = struct.unpack_from("<QQ", data, start)
    start += 16
    size = 8 if flags & 0x2000 else 4
    columns = 3 + 3 * bool(flags & 0x0001) + 2 * bool(flags & 0x0002) + 3 * bool(flags & 0x0008)
    if vertices * columns * size + triangles * 12 > len(data) - start:
        raise _FaultError(f"{vertices:,} vertices and {triangles:,} triangles need more bytes than the file has")
    # 3. Check the values.
    numbers = np.frombuffer(data, f"<f{size}", vertices * columns, start)
    _check_mesh_numbers(numbers, "its numbers")
    _check_triangles(np.frombuffer(data, "<u4", triangles * 3, start + numbers.nbytes), vertices)


CHECKS = {"ply": _check_ply, "obj": _check_obj, "serialized": _check_serialized}
"""Checks of mesh files, keyed by the name of the Mitsuba plugin that reads them."""


# ---------------- Pictures, grids and tensor files
# Their headers are checked before Mitsuba allocates what they declare.


MAX_PICTURE_HEADER_BYTES = 2**20
"""Number of bytes at the start of a picture that are searched for its size."""

PICTURE_INFLATION = 1100
"""Maximum ratio of the pixel data of a picture, at one bit per pixel, to its file size: that of deflate compression."""

FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG markers of the segments that contain the size."""

TENSORS = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 8, 8: 8, 9: 2, 10: 4, 11: 8}
"""Size of a value [bytes], keyed by the type number in a tensor file."""


def pixels_of(path: Path) -> int:
    """Return the number of pixels of a picture from its header: PNG, JPEG, OpenEXR, RGBE, PFM, PPM, BMP or TGA.

    A picture of more than three channels counts once for every three channels or part thereof.

    Args:
        path: picture file.

    Raises:
        MitsonarError: the file is not a picture of these formats, has no pixels, or more than its size allows.
    """
    refuse_irregular(path, "picture")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(MAX_PICTURE_HEADER_BYTES)
        file.seek(max(0, size - 18))
        tail = file.read(18)
    try:
        width, height, channels = _shape(head, tail)
    except (struct.error, ValueError, IndexError):
        raise MitsonarError(f"{path} is not a picture that Mitsuba reads: export it again as PNG, JPEG or OpenEXR") from None
    if min(width, height) < 1 or width * height > 8 * PICTURE_INFLATION * size:
        raise MitsonarError(f"picture {path} is damaged: {width:,} x {height:,} pixels in {size:,} bytes; export it again")
    return width * height * max(1, (channels + 2) // 3)


def _shape(head: bytes, tail: bytes) -> tuple[int, int, int]:
    """Return the width, height and number of channels of a picture from the first and last bytes of its file."""
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        width, height = struct.unpack_from(">II", head, 16)
        return width, height, 3
    if head.startswith(b"\xff\xd8"):
        return _jpeg_shape(head)
    if head.startswith(b"\x76\x2f\x31\x01"):
        return _exr_shape(head)
    if head.startswith(b"BM"):
        width, height = struct.unpack_from("<ii", head, 18)
        return width, abs(height), 3
    if head.startswith((b"PF", b"Pf", b"P6")):
        words = re.findall(rb"[^\s#]+", re.sub(rb"#[^\n]*", b"", head[2:2000]))
        return int(words[0]), int(words[1]), 3
    if head.startswith(b"#?"):
        size_line = re.search(rb"[+-][XY] (\d{1,9}) [+-][XY] (\d{1,9})\n", head[: 2**16])
        if size_line is None:
            raise ValueError
        return int(size_line[1]), int(size_line[2]), 3
    if tail != b"TRUEVISION-XFILE.\0":  # TGA is recognised by its footer
        raise ValueError
    width, height = struct.unpack_from("<HH", head, 12)
    return width, height, 3


def _jpeg_shape(head: bytes) -> tuple[int, int, int]:
    offset = 2
    while True:
        if head[offset] != 0xFF:
            raise ValueError
        marker = head[offset + 1]
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD7:  # padding, or a marker without a length
            offset += 1 if marker == 0xFF else 2
            continue
        length, _, height, width, channels = struct.unpack_from(">HBHHB", head, offset + 2)
        if marker in FRAMES:
            return width, height, channels
        offset += 2 + length


def _exr_shape(head: bytes) -> tuple[int, int, int]:
    """Return the width and height of the largest of data window, display window and tile, and the number of channels."""
    # Attributes follow the magic number and the version. Each has a name, a type, a length and a value; an empty name ends
    # the list.
    offset, width, height, channels, tile = 8, 0, 0, 0, 0
    while head[offset] != 0:
        name_end = head.index(b"\0", offset)
        kind_end = head.index(b"\0", name_end + 1)
        (length,) = struct.unpack_from("<i", head, kind_end + 1)
        name, value = head[offset:name_end], kind_end + 5
        if length < 0 or value + length > len(head):
            raise ValueError
        if name in (b"dataWindow", b"displayWindow"):
            left, top, right, bottom = struct.unpack_from("<4i", head, value)
            if right < left or bottom < top:
                raise ValueError
            width, height = max(width, right - left + 1), max(height, bottom - top + 1)
        elif name == b"channels":
            inner = value
            while head[inner] != 0:
                inner, channels = head.index(b"\0", inner) + 17, channels + 1
        elif name == b"tiles":
            tile = max(struct.unpack_from("<2I", head, value))
        offset = value + length
    return max(width, tile), max(height, tile), channels


def check_grid(path: Path) -> None:
    """Check a grid in Mitsuba's ``.vol`` format: its counts against the size of its file.

    Raises:
        MitsonarError: the header is invalid, or its counts do not match the size of the file.
    """
    refuse_irregular(path, "grid")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(48)
    if len(head) < 48 or head[:4] != b"VOL\x03":
        raise MitsonarError(f"grid {path} is damaged: it has no VOL header of version 3; export it again")
    kind, *counts = struct.unpack_from("<5i", head, 4)
    numbers = struct.unpack_from("<6f", head, 24)
    if kind != 1 or min(counts) < 1 or 4 * math.prod(counts) != size - 48 or not all(map(math.isfinite, numbers)):
        shape = " x ".join(f"{count:,}" for count in counts)
        raise MitsonarError(f"grid {path} is damaged: {shape} numbers of type {kind} in {size:,} bytes; export it again")


def check_tensors(path: Path) -> None:
    """Check a tensor file, as the BSDF ``measured`` reads it: offset and size of each tensor against the size of the file.

    Raises:
        MitsonarError: the header is invalid, or a tensor extends beyond the end of the file.
    """
    refuse_irregular(path, "table")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(MAX_PICTURE_HEADER_BYTES)
    try:
        if not head.startswith(b"tensor_file\0"):
            raise ValueError
        (count,) = struct.unpack_from("<I", head, 14)
        offset = 18
        for _ in range(count):
            (length,) = struct.unpack_from("<H", head, offset)
            dimensions, kind, start = struct.unpack_from("<HBQ", head, offset + 2 + length)
            offset += 13 + length
            shape = struct.unpack_from(f"<{dimensions}Q", head, offset)
            offset += 8 * dimensions
            if start + math.prod(shape) * TENSORS[kind] > size:
                raise ValueError
    except (struct.error, ValueError, KeyError):
        raise MitsonarError(
            f"table {path} is damaged: its header declares more than it contains; download it again"
        ) from None
