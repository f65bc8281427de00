"""Files that a scene names: found within its own folder and the folders that the user allows, and nowhere else."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from mitsonar.errors import MitsonarError, shortened

__all__ = ["ModelSearch"]

LONGEST = 1024
"""Letters of a file's name in a scene, at most."""

PACKAGES = ("model://", "package://")
"""Begin of names whose next word is the name of a folder, of Gazebo and ROS."""


class ModelSearch:
    """Finds the files that a scene names.

    Args:
        file: of the scene.
        folders: where models and packages lie as well.

    Attributes:
        roots: folders within which a file must lie, without links.

    Raises:
        MitsonarError: the file, or one of the folders, is not there.
    """

    def __init__(self, file: Path, folders: Sequence[str | Path] = ()) -> None:
        if not os.path.lexists(file):
            raise MitsonarError(f"no such file: {file}")
        missing = [folder for folder in folders if not os.path.isdir(folder)]
        if missing:
            raise MitsonarError(f"there is no folder {missing[0]} to search: give a folder that holds models or packages")
        roots = (_without_links(file).parent, *(_without_links(folder) for folder in folders))
        self.roots = list(dict.fromkeys(roots))  # each once

    def find(self, name: str, beside: Path) -> Path:
        """Return the file or folder that a scene names.

        Args:
            name: a path, or ``model://``, ``package://`` or ``file://`` and one. ``model://NAME/...`` is the folder NAME
                within a folder that is searched, or that folder itself.
            beside: file that names it; a path without a scheme counts from there, then from the folders that are searched.

        Raises:
            MitsonarError: it is not there, lies outside the folders, or is an address of the net.
        """
        name = name.strip()
        if len(name) > LONGEST or "\0" in name or not name:
            raise MitsonarError(f"{beside} names the file {shortened(name)}: give a path of 1 to {LONGEST} letters")
        scheme = next((scheme for scheme in PACKAGES if name.startswith(scheme)), "")
        if not scheme and "://" in name and not name.startswith("file://"):
            raise MitsonarError(
                f"{beside} names {shortened(name)}: nothing is fetched from the net; download it, name it model://..., and "
                "give the folder by --search"
            )
        for candidate in self._candidates(name, scheme, beside):
            found = _without_links(candidate)
            if any(found.is_relative_to(root) for root in self.roots) and os.path.exists(found):
                return found
        candidates = [_without_links(path) for path in self._candidates(name, scheme, beside)]
        inside = any(path.is_relative_to(root) for path in candidates for root in self.roots)
        outside = any(os.path.exists(path) for path in candidates)
        missing = "there is no such file" if inside and not outside else "which is not"
        raise MitsonarError(
            f"{beside} names {shortened(name)}, {missing} within {', '.join(map(str, self.roots))}: give the folder that "
            "holds it by --search"
        )

    def _candidates(self, name: str, scheme: str, beside: Path) -> list[Path]:
        """List where a file may lie."""
        path = Path(name.removeprefix(scheme) if scheme else name.removeprefix("file://"))
        if not scheme:
            return [beside.parent / path, *(root / path for root in self.roots)]
        package, *rest = [part for part in path.parts if part not in ("/", ".")] or [""]
        return [
            *(root / package / Path(*rest) for root in self.roots),
            *(root / Path(*rest) for root in self.roots if root.name == package),
        ]


def _without_links(path: str | Path) -> Path:
    """Return a path without links. One that leads to itself stays as it is, where :meth:`Path.resolve` raises."""
    return Path(os.path.realpath(path))
