"""Provenance of a result: digests, versions of packages, and how they differ from what is asked for now."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mitsonar.errors import MitsonarError
from mitsonar.io.plain_data import PlainValue

__all__ = [
    *("differences", "digest", "file_digest", "json_digest", "other_versions", "plain_json", "refuse_other", "shown"),
    "versions",
]

MOST_SHOWN = 4
"""Differences that one sentence names, at most."""

LONGEST_SHOWN = 60
"""Characters of a value in a sentence, at most."""


# ---------------------------------------------------------------- had and asked


def refuse_other(where: str | Path, had: Mapping[str, object], asked: Mapping[str, object], hint: str = "") -> None:
    """Refuse to resume a run with other settings than it was begun with.

    Args:
        where: path of the run.
        had: settings of the run.
        asked: settings that are asked for now.
        hint: how to ask for the same.

    Raises:
        MitsonarError: they differ; the message names each difference with both values.
    """
    other = differences(had, asked)
    if other:
        more = f"; and {len(other) - MOST_SHOWN} more" if len(other) > MOST_SHOWN else ""
        raise MitsonarError(
            f"{where} was begun with {'; '.join(other[:MOST_SHOWN])}{more}: ask for the same{hint}, or choose another -o"
        )


def differences(had: Mapping[str, object], asked: Mapping[str, object], within: str = "") -> list[str]:
    """List the keys whose values differ, dots between the levels, with both values: ``sonar.seed 0, not 5``."""
    found: list[str] = []
    for key in [*asked, *(key for key in had if key not in asked)]:
        one, other = had.get(key), asked.get(key)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found += differences(one, other, f"{within}{shown(key)}.")
        elif one != other:
            found.append(f"{within}{shown(key)} {shown(one)}, not {shown(other)}")
    return found


def shown(value: object) -> str:
    """Return a value as a sentence shows it, in one line; a long one is cut."""
    text = " ".join(str(value).split())
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


def plain_json(value: Mapping[str, object]) -> dict[str, PlainValue]:
    """Return a value as JSON reads it back. Arrays become lists; what JSON does not know becomes its text."""

    def known(one: PlainValue) -> PlainValue:
        return one.tolist() if hasattr(one, "tolist") else str(one)

    return dict(json.loads(json.dumps(value, default=known)))


# ---------------------------------------------------------------- digests and versions


def digest(*contents: bytes | str) -> str:
    """Return the SHA-256 of bytes and texts, one after another."""
    total = hashlib.sha256()
    for content in contents:
        total.update(content.encode() if isinstance(content, str) else content)
    return total.hexdigest()


def file_digest(path: str | Path) -> str:
    """Return the SHA-256 of a file; other files that it names are not read."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_digest(value: Mapping[str, object]) -> str:
    """Return the SHA-256 of a value's JSON; the order of keys does not count."""
    return digest(json.dumps(plain_json(value), sort_keys=True))


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Return the installed versions of packages by name."""
    found = {}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed as a package"
    return found


def other_versions(had: Mapping[str, object], packages: Iterable[str]) -> list[str]:
    """List the packages whose version has changed: ``mitsuba 3.8.0 (now 3.9.0)``."""
    return [f"{name} {had.get(name)} (now {now})" for name, now in versions(packages).items() if had.get(name) != now]
