"""What goes wrong, in words a user can act on: what, got, allowed, what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = ["MitsonarError", "MitsonarWarning", "nearest_names"]


class MitsonarError(ValueError):
    """An input that mitsonar cannot work with. The command line prints it and exits with code 2."""


class MitsonarWarning(UserWarning):
    """A result that stands, but that the user should know something about."""


def nearest_names(wrong: str, names: Iterable[str]) -> str:
    """The known names, nearest to ``wrong`` first, for the end of an error message."""
    known = list(names)
    near = [name for name in known if wrong and wrong.lower() in name.lower()]
    near = near or difflib.get_close_matches(wrong.lower(), known, n=3, cutoff=0.5)
    return f"did you mean {' or '.join(near)}? Known: {', '.join(known)}" if near else f"known: {', '.join(known)}"
