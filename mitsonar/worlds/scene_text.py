"""Check a scene's XML before Mitsuba reads it: how deep it nests, what it includes, how its parameters grow.

Mitsuba's parser recurses, follows every include and copies every parameter without a limit. The check reads the text as that
parser does, once from its beginning to its end.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mitsonar.errors import MitsonarError, shortened
from mitsonar.io.files import read_bytes, refuse_irregular

__all__ = ["check_text"]

DEEPEST = 100
"""Largest depth of nested elements; scenes have about ten."""

LARGEST = 2**28
"""Largest size of a scene's XML with all that it includes [bytes]."""

LARGEST_SPECTRUM = 2**22
"""Largest size of the file of a spectrum [bytes]."""

MOST_ELEMENTS = 2_000_000
"""Largest number of elements."""

MOST_FILES = 1_000
"""Largest number of times that files are included."""

MOST_INCLUDED = 15
"""Largest depth of files that include each other: Mitsuba's own."""

MOST_PARAMETERS = 1_000
"""Largest number of parameters: Mitsuba compares each with each."""

LONGEST_VALUE = 2**16
"""Largest length of an attribute whose parameters are replaced."""

MOST_WORK = 2**31
"""Letters that Mitsuba may compare and move to replace parameters: about a second."""

SEARCH = 300
"""What a search for a parameter takes, in letters."""

SKIPPED = {b"<!--": b"-->", b"<![CDATA[": b"]]>", b"<?": b"?>"}
"""Begin and end of what is no element."""

NAME = rb"[A-Za-z_:\x80-\xff][A-Za-z0-9_:.\x80-\xff-]*+"
OPENED = re.compile(rb"<(" + NAME + rb")((?:\s*+" + NAME + rb"\s*+=\s*+(?:\"[^\"]*+\"|'[^']*+'))*+)\s*+(/?)>")
CLOSED = re.compile(rb"</(" + NAME + rb")\s*+>")
ATTRIBUTE = re.compile(rb"(" + NAME + rb")\s*+=\s*+(?:\"([^\"]*+)\"|'([^']*+)')")
DOCTYPE = re.compile(rb"<!DOCTYPE[^\[<>\"']*+>")
LATIN = re.compile(rb"\s*<\?xml[^>]*encoding\s*=\s*[\"'](?:iso-8859-1|latin1)[\"']", re.IGNORECASE)
ENTITY = re.compile(r"&(?:#([0-9]+)|#x([0-9a-fA-F]+)|(amp|lt|gt|quot|apos));")
ENTITIES = {"amp": "&", "lt": "<", "gt": ">", "quot": '"', "apos": "'"}


def check_text(path: Path, parameters: dict[str, str], folders: list[Path]) -> None:
    """Check a scene's XML file and what it includes.

    Args:
        path: of the file.
        parameters: values of the scene's ``$name``.
        folders: that Mitsuba searches for the files that the scene names.

    Raises:
        MitsonarError: it is no XML, nests too deep, is too large, includes too much, or reads something that is no file.
    """
    _Text(dict(parameters)).check(path, folders, 0)


@dataclass
class _Text:
    """What is known of a scene's text so far.

    Attributes:
        values: of the parameters, by their names.
        size: of the files read [bytes].
        files: how many were read.
        elements: how many there were.
        work: letters compared and moved to replace parameters.
        longest_first: names of the parameters, in the order in which Mitsuba replaces them.
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
        """Check a file and what it includes; ``folders`` are searched for the files that it names."""
        if depth >= MOST_INCLUDED:
            raise MitsonarError(
                f"{path} is included {depth} files deep: {MOST_INCLUDED} are the most; does it include itself?"
            )
        self.files += 1
        if self.files > MOST_FILES:
            raise MitsonarError(f"{path} is one of more than {MOST_FILES:,} files that the scene includes: include fewer")
        refuse_irregular(path, "scene", LARGEST - self.size)
        content = _utf8(read_bytes(path, "scene", LARGEST - self.size), path)
        self.size += len(content)
        for name, attributes in self._elements(content, path):
            plain = b"$" not in attributes and b"&" not in attributes and name not in READ
            given = {} if plain else self._expanded(attributes, path)
            match name:
                case b"default":
                    self._add(given.get("name", ""), given.get("value", ""))
                case b"include":
                    inner = [path.parent, *folders]
                    found = _found(given.get("filename", ""), inner)
                    if found is not None:
                        self.check(found, inner, depth + 1)
                case b"path":
                    found = _found(given.get("value", ""), [path.parent, *folders])
                    folders[:0] = [found] if found is not None else []
                case b"spectrum":
                    found = _found(given.get("filename", ""), folders)
                    if found is not None:
                        refuse_irregular(found, "spectrum", LARGEST_SPECTRUM)

    def _elements(self, content: bytes, path: Path) -> Iterator[tuple[bytes, bytes]]:
        """Yield name and attributes of the elements."""
        opened: list[bytes] = []
        before, place = self.elements, content.find(b"<")
        while place >= 0:
            marked = content[place + 1 : place + 2] in (b"!", b"?")
            skipped = next((begin for begin in SKIPPED if marked and content.startswith(begin, place)), None)
            if skipped is not None:
                end = content.find(SKIPPED[skipped], place + len(skipped))
                if end < 0:
                    raise _malformed(path, content, place, f"a {skipped.decode()} does not end")
                place = content.find(b"<", end)
                continue
            if (found := OPENED.match(content, place)) is not None:
                name, attributes, closed = found.groups()
                if not opened and self.elements > before:
                    raise _malformed(path, content, place, "there is a second root element")
                self.elements += 1
                if self.elements > MOST_ELEMENTS:
                    raise MitsonarError(f"{path} has more than {MOST_ELEMENTS:,} elements: put the shapes into mesh files")
                if not closed:
                    opened.append(name)
                if len(opened) > DEEPEST:
                    raise MitsonarError(f"{path} nests its elements more than {DEEPEST} deep: it is no scene")
                yield name, attributes
            elif (found := CLOSED.match(content, place)) is not None:
                if not opened or opened.pop() != found[1]:
                    raise _malformed(path, content, place, "an element is closed that is not open")
            elif opened or (found := DOCTYPE.match(content, place)) is None:  # a document type may define entities
                raise _malformed(path, content, place, "the XML of an element or of one of its attributes is malformed")
            place = content.find(b"<", found.end())
        if opened:
            raise _malformed(path, content, len(content), f"<{opened[-1].decode('utf-8', 'replace')[:40]}> is not closed")

    def _expanded(self, attributes: bytes, path: Path) -> dict[str, str]:
        """Return attributes, their parameters replaced as Mitsuba replaces them."""
        found: dict[str, str] = {}
        for name, double, single in ATTRIBUTE.findall(attributes):
            raw = (double or single).replace(b"\r\n", b" ").translate(SPACES)
            value = ENTITY.sub(_character, raw.decode("utf-8", "surrogateescape"))
            if "$" in value:
                value = self._replaced(value, path)
            found.setdefault(name.decode("utf-8", "surrogateescape"), value)
        return found

    def _replaced(self, value: str, path: Path) -> str:
        for name in self.longest_first:
            key, new, place = f"${name}", self.values[name], 0
            self._work(len(value), path)
            while (place := value.find(key, place)) >= 0:
                if value[:place].endswith("\\"):
                    place += len(key)
                    continue
                value = value[:place] + new + value[place + len(key) :]
                place += len(new)
                self._work(len(value), path)
                if len(value) > LONGEST_VALUE:
                    raise MitsonarError(f"{path} has a value that its parameters make longer than {LONGEST_VALUE:,} letters")
        return value.replace("\\$", "$")

    def _work(self, letters: int, path: Path) -> None:
        self.work += letters + SEARCH
        if self.work > MOST_WORK:
            raise MitsonarError(f"{path} uses its parameters too often: write the values themselves")

    def _count(self, parameters: int) -> None:
        if parameters > MOST_PARAMETERS:
            raise MitsonarError(f"a scene may have {MOST_PARAMETERS:,} parameters: got more; write the values themselves")

    def _add(self, name: str, value: str) -> None:
        """Add the default of a parameter; a value that was given stays."""
        if name in self.values or not name:
            return
        self.values[name] = value
        self._count(len(self.values))
        place = next((k for k, other in enumerate(self.longest_first) if len(name) > len(other)), len(self.longest_first))
        self.longest_first.insert(place, name)


SPACES = bytes.maketrans(b"\t\r\n", b"   ")
"""White space in an attribute reads as blanks."""

READ = (b"default", b"include", b"path", b"spectrum")
"""Elements that are followed while the text is read."""


def _utf8(content: bytes, path: Path) -> bytes:
    """Return a text as UTF-8, also of the other encodings that Mitsuba knows by a mark or a declaration."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        try:
            content = content.decode("utf-16").encode()
        except UnicodeDecodeError:
            raise MitsonarError(f"{path} is not text: save it as UTF-8") from None
    elif LATIN.match(content):
        content = content.decode("latin-1").encode()
    if b"\0" in content:
        raise MitsonarError(f"{path} holds a zero byte: it is damaged, or not text in UTF-8")
    return content


def _character(found: re.Match[str]) -> str:
    """Return the character of an entity."""
    decimal, hexadecimal, name = found.groups()
    if name:
        return ENTITIES[name]
    digits = (decimal or hexadecimal).lstrip("0")
    number = int(digits or "0", 10 if decimal else 16) if len(digits) < 10 else 0x110000
    if not 0 < number < 0x110000 or 0xD800 <= number < 0xE000:
        raise MitsonarError(f"the scene has {shortened(found[0])}, which is no character")
    return chr(number)


def _found(name: str, folders: list[Path]) -> Path | None:
    """Return the file that Mitsuba finds for a name, None where there is none."""
    if not name or "\0" in name:
        return None
    try:
        return next((path for path in [*(folder / name for folder in folders), Path(name)] if path.exists()), None)
    except OSError:  # such as a name too long
        raise MitsonarError(f"there cannot be a file of the name {shortened(name)}") from None


def _malformed(path: Path, content: bytes, place: int, reason: str) -> MitsonarError:
    line = content.count(b"\n", 0, place) + 1
    return MitsonarError(f"{path}, line {line:,}: {reason}")
