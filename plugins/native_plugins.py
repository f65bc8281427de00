"""Restrict Mitsuba to loading code from its own folder.

Mitsuba looks for ``plugins/NAME.so`` next to the scene and in the current directory before it looks in its own folder, and
runs what it finds. A folder that comes with a scene could therefore run code. All creation of Mitsuba objects goes through
this module.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from mitsonar.errors import MitsonarError, did_you_mean, short_repr

__all__ = ["file_resolver", "foreign_names", "load_dict", "own_code_only", "search_folders", "search_in"]

LIBRARIES = (".so", ".dylib", ".dll")
"""File suffixes of Mitsuba's plugins on Linux, macOS and Windows."""

BUILT_IN = frozenset({"scene", "rgb", "spectrum"})
"""Types that Mitsuba creates without a plugin."""

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
"""Valid names of plugins written in Python."""

DECOYS = "mitsonar-plugins-"
"""Prefix of the names of folders with empty decoy files."""


@cache
def mitsuba_folder() -> Path:
    """Return the folder of Mitsuba, which contains its ``plugins`` and ``data``."""
    import mitsuba as mi

    return Path(str(mi.__file__)).resolve().parent


@cache
def mitsuba_names() -> frozenset[str]:
    """Return the names of Mitsuba's own plugins."""
    return frozenset(path.stem for path in (mitsuba_folder() / "plugins").iterdir() if path.suffix in LIBRARIES) | BUILT_IN


def foreign_names(names: Iterable[str]) -> list[str]:
    """Return the names that are not plugins of Mitsuba, and must therefore be classes registered in Python.

    Raises:
        MitsonarError: a path instead of a name.
    """
    foreign = sorted(set(names) - mitsuba_names())
    for name in foreign:
        if not NAME.fullmatch(name):
            raise MitsonarError(f"a type must be the name of a plugin, of letters, digits and _: got {short_repr(name)}")
    return foreign


@contextmanager
def own_code_only(names: Iterable[str]) -> Iterator[None]:
    """Prevent Mitsuba from loading any library but its own while it creates objects.

    Its own folder becomes the first of its search path. For any other name it finds an empty file, which it cannot load;
    classes registered in Python need no file.

    Args:
        names: names of the plugins to create.

    Raises:
        MitsonarError: a name that is a path, or that no plugin has.
    """
    foreign = foreign_names(names)
    try:
        with ExitStack() as stack:
            folders = [mitsuba_folder()]
            if foreign:
                folders.append(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=DECOYS))))
                _make_decoys(folders[-1] / "plugins", foreign)
            stack.enter_context(search_in(folders))
            yield
    except RuntimeError as error:
        unknown = re.search(r'Error while loading plugin ".*?([^/\\"]+)\.\w+"', str(error))
        if unknown is None:
            raise
        name = next((name for name in foreign if Path(name).stem == unknown[1] or name == unknown[1]), unknown[1])
        raise MitsonarError(
            f"there is no plugin {name}: Mitsuba has none of that name, and none is registered in Python"
            f"{did_you_mean(name, mitsuba_names())}"
        ) from None


def _make_decoys(folder: Path, names: list[str]) -> None:
    folder.mkdir()
    for name in names:
        for stem in {name, name.rpartition(".")[0] or name}:  # Mitsuba replaces the part after the last dot
            for ending in LIBRARIES:
                (folder / f"{stem}{ending}").touch()


@contextmanager
def search_in(folders: Iterable[str | Path]) -> Iterator[None]:
    """Prepend folders to Mitsuba's search path, in this order, for the duration of the context."""
    import mitsuba as mi

    before = file_resolver()
    resolver = mi.FileResolver(before)
    for folder in reversed(list(folders)):
        resolver.prepend(str(folder))
    use: Any = mi.set_file_resolver  # the stubs lack it
    use(resolver)
    try:
        yield
    finally:
        use(before)


def file_resolver() -> Any:
    """Return the resolver of the files that a scene refers to."""
    import mitsuba as mi

    resolver: Any = mi.file_resolver  # an `object` to Mitsuba's stubs
    return resolver()


def search_folders() -> list[Path]:
    """Return the folders that Mitsuba searches for files of a scene, excluding its own."""
    folders = [Path(str(folder)) for folder in file_resolver()]
    return [folder for folder in folders if folder.resolve() != mitsuba_folder() and not folder.name.startswith(DECOYS)]


def load_dict(parts: dict[str, Any], **options: bool) -> Any:
    """Create an object as ``mi.load_dict`` does, running only code of Mitsuba and of registered classes.

    Args:
        parts: as for ``mi.load_dict``.
        options: as for ``mi.load_dict``.

    Raises:
        MitsonarError: a type that no plugin has.
    """
    import mitsuba as mi

    with own_code_only(_types_in(parts)):
        return mi.load_dict(parts, **options)


def _types_in(parts: dict[str, Any]) -> Iterator[str]:
    for name, value in parts.items():
        if isinstance(value, dict):
            yield from _types_in(value)
        elif name == "type" and value != "ref":  # "ref" is not a plugin
            yield str(value)
