"""XML of strangers: no document types, so no entities; a bounded size, depth and number of elements."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

from mitsonar.errors import MitsonarError, shortened
from mitsonar.io.files import read_bytes

__all__ = ["attribute_of", "number_of", "numbers_of", "read_xml", "refused"]

DEEPEST = 100
"""Largest depth of nested elements."""

MOST_ELEMENTS = 2_000_000
"""Largest number of elements of a file."""

LARGEST = 2**28
"""Largest size of a file [bytes]."""

FARTHEST = 1e9
"""Largest number that a file may give [m, rad]."""


class _Bounded(TreeBuilder):
    """Builds a tree of a bounded depth and size, and no document type."""

    def __init__(self) -> None:
        super().__init__()
        self.depth = self.count = 0

    def start(self, tag: str, attrs: dict[str, str]) -> Element:
        self.depth += 1
        self.count += 1
        if self.depth > DEEPEST:
            raise ValueError(f"its elements nest more than {DEEPEST} deep")
        if self.count > MOST_ELEMENTS:
            raise ValueError(f"it has more than {MOST_ELEMENTS:,} elements")
        return super().start(tag, attrs)

    def end(self, tag: str) -> Element:
        self.depth -= 1
        return super().end(tag)

    def doctype(self, name: str, pubid: str | None, system: str | None) -> NoReturn:
        """Refuse a document type before anything of it is read: entities may name files, or grow without bound."""
        raise ValueError("it has a document type (<!DOCTYPE>), which scenes do not need")


def read_xml(path: Path, what: str) -> Element:
    """Read the tree of an XML file.

    Args:
        path: of the file.
        what: kind of file, for errors: ``URDF file``.

    Raises:
        MitsonarError: it is unreadable, no XML, has a document type, or is too large or too deep.
    """
    parser = XMLParser(target=_Bounded())
    try:
        parser.feed(read_bytes(path, what, LARGEST))
        tree = parser.close()
    except (ParseError, ValueError, LookupError) as error:
        if isinstance(error, MitsonarError):
            raise
        raise MitsonarError(f"{path} is no {what}: {' '.join(str(error).split())[:160]}; export it again") from None
    assert isinstance(tree, Element)
    return tree


def refused(path: Path, element: Element, reason: str) -> MitsonarError:
    """Return the error for an element of a file; ``reason`` is what, got, allowed."""
    name = element.get("name")
    where = f"<{element.tag[:40]}{f' name={shortened(name)}' if name else ''}>"
    return MitsonarError(f"{path}, {where}: {reason}")


def attribute_of(path: Path, element: Element, key: str) -> str:
    """Return an attribute that must be there.

    Raises:
        MitsonarError: it is missing or empty.
    """
    value = element.get(key)
    if not value:
        raise refused(path, element, f"the attribute {key} is missing")
    return value


def numbers_of(path: Path, element: Element, text: str | None, count: int, default: tuple[float, ...]) -> tuple[float, ...]:
    """Return the numbers of an attribute or of the text of an element, separated by spaces.

    Args:
        path: of the file, for errors.
        element: for errors.
        text: of the numbers; None or empty: ``default``.
        count: how many.
        default: numbers where there is no text.

    Raises:
        MitsonarError: not that many finite numbers, or too large ones.
    """
    if text is None or not text.strip():
        return default
    try:
        values = tuple(float(word) for word in text.split()) if "_" not in text else ()
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(value) and abs(value) <= FARTHEST for value in values):
        raise refused(path, element, f"{count} finite numbers up to {FARTHEST:g} are needed: got {shortened(text.strip())}")
    return values


def number_of(path: Path, element: Element, text: str | None, default: float | None = None) -> float:
    """Return one number, as :func:`numbers_of` reads it.

    Raises:
        MitsonarError: it is no finite number, or missing and without a default.
    """
    if default is None and (text is None or not text.strip()):
        raise refused(path, element, "a number is missing")
    return numbers_of(path, element, text, 1, (default or 0.0,))[0]
