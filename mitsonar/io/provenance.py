"""What a result was made of: digests, versions of packages, and how that differs from what is asked for now."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from mitsonar.errors import MitsonarError

__all__ = [
    *("differences", "digest", "file_digest", "json_digest", "other_versions", "plain_json", "refuse_other", "shown"),
    "versions",
]

MOST_SHOWN = 4
"""Differences that are named in one sentence."""

LONGEST_SHOWN = 60
"""Characters of a value in a sentence."""


# ---------------------------------------------------------------- had and asked


def refuse_other(where: str | Path, had: Mapping[str, Any], asked: Mapping[str, Any], hint: str = "") -> None:
    """Go on only with what a run was begun with.

    Args:
        where: it lies.
        had: what it was begun with.
        asked: what is asked for now.
        hint: how to ask for the same.

    Raises:
        MitsonarError: something else was asked for; what differs is named, with both values.
    """
    other = differences(had, asked)
    if other:
        more = f"; and {len(other) - MOST_SHOWN} more" if len(other) > MOST_SHOWN else ""
        raise MitsonarError(
            f"{where} was begun with {'; '.join(other[:MOST_SHOWN])}{more}: ask for the same{hint}, or choose another -o"
        )


def differences(had: Mapping[str, Any], asked: Mapping[str, Any], within: str = "") -> list[str]:
    """Keys whose values differ, dots between the levels, with both values: ``sonar.seed 0, not 5``."""
    found = []
    for key in [*asked, *(key for key in had if key not in asked)]:
        one, other = had.get(key), asked.get(key)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found += differences(one, other, f"{within}{shown(key)}.")
        elif one != other:
            found.append(f"{within}{shown(key)} {shown(one)}, not {shown(other)}")
    return found


def shown(value: object) -> str:
    """A value in a sentence, in one line; a long one is cut."""
    text = " ".join(str(value).split())
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


def plain_json(value: Mapping[str, Any]) -> dict[str, Any]:
    """As JSON gives it back; arrays become lists, and what JSON does not know its text."""

    def known(one: Any) -> Any:
        return one.tolist() if hasattr(one, "tolist") else str(one)

    return dict(json.loads(json.dumps(value, default=known)))


# ---------------------------------------------------------------- digests and versions


def digest(*contents: bytes | str) -> str:
    """SHA-256 of bytes and texts, one after another."""
    total = hashlib.sha256()
    for content in contents:
        total.update(content.encode() if isinstance(content, str) else content)
    return total.hexdigest()


def file_digest(path: str | Path) -> str:
    """SHA-256 of a file; other files that it names are not read."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_digest(value: Mapping[str, Any]) -> str:
    """SHA-256 of what JSON holds of a value, whatever the order of its keys."""
    return digest(json.dumps(plain_json(value), sort_keys=True))


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of packages by name."""
    found = {}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed as a package"
    return found


def other_versions(had: Mapping[str, Any], packages: Iterable[str]) -> list[str]:
    """Packages that are not here in the version that was had: ``mitsuba 3.8.0 (now 3.9.0)``."""
    return [f"{name} {had.get(name)} (now {now})" for name, now in versions(packages).items() if had.get(name) != now]
