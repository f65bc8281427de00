"""Check how deep a scene's XML nests before Mitsuba reads it: its parser recurses, and a deep file ends the process."""

from __future__ import annotations

import re
from pathlib import Path

from mitsonar.errors import MitsonarError
from mitsonar.io.whole_files import read_bytes

__all__ = ["check_nesting"]

DEEPEST = 100
"""Largest depth of nested elements; scenes have about ten."""

LARGEST = 2**28
"""Largest size of an XML file [bytes]."""

ASIDE = re.compile(rb"<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>", re.DOTALL)
TAG = re.compile(rb"<(/?)([A-Za-z_][^\s/>]*+)((?:[^>\"']++|\"[^\"]*+\"|'[^']*+')*+)>")
ATTRIBUTE = re.compile(rb"([A-Za-z_]\w*)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")


def check_nesting(path: Path, parameters: dict[str, str], *, _seen: frozenset[Path] = frozenset()) -> None:
    """Check a scene's XML file and what it includes.

    Args:
        path: of the file.
        parameters: values of the scene's ``$name``, which may occur in the name of an included file.

    Raises:
        MitsonarError: elements nest too deep, or the file is too large.
    """
    content = ASIDE.sub(b"", read_bytes(path, "scene", LARGEST))
    values, depth = dict(parameters), 0
    for tag in TAG.finditer(content):
        closing, name, rest = tag.groups()
        depth += -1 if closing else 0 if rest.endswith(b"/") else 1
        if depth > DEEPEST:
            raise MitsonarError(f"{path} nests its elements more than {DEEPEST} deep: it is no scene")
        if name in (b"default", b"include"):
            given = {key.decode(): (one or other).decode("utf-8", "replace") for key, one, other in ATTRIBUTE.findall(rest)}
            if name == b"default":
                values.setdefault(given.get("name", ""), given.get("value", ""))
            else:
                _check_included(path, given.get("filename", ""), values, _seen | {path.resolve()})


def _check_included(path: Path, name: str, values: dict[str, str], seen: frozenset[Path]) -> None:
    """Check a file that another includes; Mitsuba itself reports one that is missing or includes itself."""
    for key in sorted(values, key=len, reverse=True):
        name = name.replace(f"${key}", values[key]) if key else name
    for folder in (path.parent, Path(), *(one.parent for one in seen)):
        found = folder / name
        if found.is_file() and found.resolve() not in seen and len(seen) < 20:
            return check_nesting(found, values, _seen=seen)
