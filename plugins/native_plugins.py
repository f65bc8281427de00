"""Where Mitsuba may load code from: its own folder, and nowhere else.

Mitsuba looks for ``plugins/NAME.so`` beside the scene and in the current directory before it looks in its own folder, and
runs what it finds: a folder that comes with a scene could run code. So all that lets Mitsuba create objects does it here.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from mitsonar.errors import MitsonarError, meant, shortened

__all__ = ["file_resolver", "foreign_names", "load_dict", "own_code_only", "search_folders", "search_in"]

LIBRARIES = (".so", ".dylib", ".dll")
"""Endings of Mitsuba's plugins on Linux, macOS and Windows."""

BUILT_IN = frozenset({"scene", "rgb", "spectrum"})
"""Types that Mitsuba creates without a plugin."""

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
"""What the name of a plugin written in Python may look like."""

DECOYS = "mitsonar-plugins-"
"""What the name of a folder of empty files begins with."""


@cache
def own_folder() -> Path:
    """Return the folder of Mitsuba, which holds its ``plugins`` and ``data``."""
    import mitsuba as mi

    return Path(str(mi.__file__)).resolve().parent


@cache
def own_names() -> frozenset[str]:
    """Return the names of Mitsuba's own plugins."""
    return frozenset(path.stem for path in (own_folder() / "plugins").iterdir() if path.suffix in LIBRARIES) | BUILT_IN


def foreign_names(names: Iterable[str]) -> list[str]:
    """Return the names that are no plugins of Mitsuba: only a class registered in Python may stand behind them.

    Raises:
        MitsonarError: one is no name but a path.
    """
    found = sorted(set(names) - own_names())
    for name in found:
        if not NAME.fullmatch(name):
            raise MitsonarError(f"a type must be the name of a plugin, of letters, digits and _: got {shortened(name)}")
    return found


@contextmanager
def own_code_only(names: Iterable[str]) -> Iterator[None]:
    """Keep Mitsuba from every library but its own while it creates objects.

    Its own folder comes first of those that it searches. For any other name it finds an empty file, which it cannot load;
    classes registered in Python need no file.

    Args:
        names: of the plugins that are created.

    Raises:
        MitsonarError: a name is a path; or no plugin has that name.
    """
    foreign = foreign_names(names)
    try:
        with ExitStack() as stack:
            folders = [own_folder()]
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
            f"{meant(name, own_names())}"
        ) from None


def _make_decoys(folder: Path, names: list[str]) -> None:
    folder.mkdir()
    for name in names:
        for stem in {name, name.rpartition(".")[0] or name}:  # Mitsuba replaces what follows the last dot
            for ending in LIBRARIES:
                (folder / f"{stem}{ending}").touch()


@contextmanager
def search_in(folders: Iterable[str | Path]) -> Iterator[None]:
    """Let Mitsuba search these folders first, in this order, and afterwards as before."""
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
    """Return what finds the files that a scene names."""
    import mitsuba as mi

    resolver: Any = mi.file_resolver  # an `object` to Mitsuba's stubs
    return resolver()


def search_folders() -> list[Path]:
    """Return the folders that Mitsuba searches for files of a scene, without its own."""
    found = [Path(str(folder)) for folder in file_resolver()]
    return [folder for folder in found if folder.resolve() != own_folder() and not folder.name.startswith(DECOYS)]


def load_dict(parts: dict[str, Any], **options: bool) -> Any:
    """Create an object as ``mi.load_dict`` does, with no code but Mitsuba's own and that of registered classes.

    Args:
        parts: as for ``mi.load_dict``.
        options: as for ``mi.load_dict``.

    Raises:
        MitsonarError: no plugin has one of the names.
    """
    import mitsuba as mi

    with own_code_only(_types_in(parts)):
        return mi.load_dict(parts, **options)


def _types_in(parts: dict[str, Any]) -> Iterator[str]:
    for name, value in parts.items():
        if isinstance(value, dict):
            yield from _types_in(value)
        elif name == "type" and value != "ref":  # which names no plugin
            yield str(value)
