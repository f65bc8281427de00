"""Manage the folder of a run: start, resume, replace or refuse it, in the same way for all commands that write folders.

The folder of a run holds ``run.json``: the type of run, its settings, the versions of the packages that determine its
results bit for bit, and notes on its progress. The file is complete at any time, so that an interrupted run can be resumed.
It is untrusted input: the type of every value is checked, and an invalid value is reported in one sentence.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import UnionType
from typing import Annotated, Any

from mitsonar.errors import MitsonarError, validation_message
from mitsonar.io.files import (
    LARGEST_COUNT,
    PlainValue,
    check_plain_value,
    finite_number,
    read_json,
    whole_number,
    write_json,
)

__all__ = [
    "CONFIG_FILE",
    "RUN_FILE",
    "RunDirectory",
    "RunKind",
    "changed_versions",
    "check_same_settings",
    "differences",
    "digest",
    "file_digest",
    "json_digest",
    "kind_of_run",
    "plain_json",
    "refuse_to_replace",
    "shown",
    "versions",
]


# ---------------- Provenance of results


MAX_DIFFERENCES = 4
"""Largest number of differences listed in one sentence."""

MAX_VALUE_LENGTH = 60
"""Largest number of characters of a value in a sentence."""


# ---------------- Comparison of settings


def check_same_settings(
    where: str | Path, stored: Mapping[str, object], requested: Mapping[str, object], hint: str = ""
) -> None:
    """Refuse to resume a run with settings that differ from those that it was started with.

    Args:
        where: path of the run.
        stored: settings of the existing run.
        requested: requested settings.
        hint: how to request the same settings.

    Raises:
        MitsonarError: they differ; the message names each difference with both values.
    """
    changes = differences(stored, requested)
    if changes:
        more = f"; and {len(changes) - MAX_DIFFERENCES} more" if len(changes) > MAX_DIFFERENCES else ""
        raise MitsonarError(
            f"{where} was begun with {'; '.join(changes[:MAX_DIFFERENCES])}{more}: request the same settings"
            f"{hint}, or choose another -o"
        )


def differences(stored: Mapping[str, object], requested: Mapping[str, object], within: str = "") -> list[str]:
    """List the keys whose values differ, with dots between levels and both values: ``sonar.seed 0, not 5``."""
    texts: list[str] = []
    for key in [*requested, *(key for key in stored if key not in requested)]:
        old, new = stored.get(key), requested.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            texts += differences(old, new, f"{within}{shown(key)}.")
        elif old != new:
            texts.append(f"{within}{shown(key)} {shown(old)}, not {shown(new)}")
    return texts


def shown(value: object) -> str:
    """Format a value for a sentence, in one line, truncated if long."""
    text = " ".join(str(value).split())
    return text if len(text) <= MAX_VALUE_LENGTH else f"{text[:MAX_VALUE_LENGTH]}..."


def plain_json(value: Mapping[str, object]) -> dict[str, PlainValue]:
    """Convert a value to what JSON returns on reading: arrays become lists, unknown types become strings."""

    def known(one: PlainValue) -> PlainValue:
        return one.tolist() if hasattr(one, "tolist") else str(one)

    return dict(json.loads(json.dumps(value, default=known)))


# ---------------- Digests and versions


def digest(*contents: bytes | str) -> str:
    """Return the SHA-256 of concatenated bytes and strings."""
    total = hashlib.sha256()
    for content in contents:
        total.update(content.encode() if isinstance(content, str) else content)
    return total.hexdigest()


def file_digest(path: str | Path) -> str:
    """Return the SHA-256 of a file, without the files that it refers to."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_digest(value: Mapping[str, object]) -> str:
    """Return the SHA-256 of the JSON of a value, independent of the order of keys."""
    return digest(json.dumps(plain_json(value), sort_keys=True))


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Return the installed versions of packages, by name."""
    installed = {}
    for package in packages:
        try:
            installed[package] = version(package)
        except PackageNotFoundError:
            installed[package] = "not installed as a package"
    return installed


def changed_versions(stored: Mapping[str, object], packages: Iterable[str]) -> list[str]:
    """List the packages whose version has changed: ``mitsuba 3.8.0 (now 3.9.0)``."""
    return [
        f"{name} {stored.get(name)} (now {current})"
        for name, current in versions(packages).items()
        if stored.get(name) != current
    ]


# ---------------- Run directory


RUN_FILE = "run.json"

CONFIG_FILE = "run.yaml"
"""Name of the file with the options of the command that began the run."""

PARTIAL_SUFFIXES = (".part", "writer.lock")
"""File name suffixes that a killed run may leave behind; a folder with only such files counts as empty."""


@dataclass(frozen=True)
class RunKind:
    """A type of run.

    Attributes:
        name: name in ``run.json`` and in messages, such as ``odometry``.
        outputs: names (or patterns) of everything that a run writes besides ``run.json``. A resumed run keeps them and a
            replaced run deletes them; nothing else in the folder is ever removed.
        notes: allowed notes in ``run.json``, with types: ``int`` is a non-negative count, ``list`` holds strings and
            numbers, ``float | None`` may be null.
        packages: packages whose versions are recorded.
        deciding: packages whose versions must be unchanged to resume a run, since the results would differ.
        replaced: whether its command supports ``--overwrite``.
    """

    name: str
    outputs: tuple[str, ...]
    notes: Mapping[str, type | UnionType]
    packages: tuple[str, ...] = ("mitsonar", "numpy")
    deciding: tuple[str, ...] = ()
    replaced: bool = True


@dataclass
class RunDirectory:
    """A run on disk.

    :meth:`begin` selects the run, :meth:`start` creates the folder, and :meth:`note` and :meth:`finish` record the progress.

    Attributes:
        path: path of the folder.
        kind: type of run.
        settings: settings of the run, as JSON returns them; a run is resumed only with the same settings.
        versions: versions of packages when the run was started.
        notes: progress of the run.
        finished: whether all outputs are complete.
        resumed: whether an earlier run is continued.
    """

    path: Path
    kind: RunKind
    settings: dict[str, Any]
    versions: dict[str, str]
    notes: dict[str, Any] = field(default_factory=dict)
    finished: bool = False
    resumed: bool = False
    _replaces: bool = False
    _started: bool = False

    @classmethod
    def begin(
        cls, path: str | Path, kind: RunKind, settings: Mapping[str, Any], *, resume: bool = False, overwrite: bool = False
    ) -> RunDirectory:
        """Select a new or an existing run, without writing anything.

        Args:
            path: path of the folder.
            kind: type of run.
            settings: all settings that determine the results.
            resume: resume an existing run; without one, a new run is started.
            overwrite: replace an existing run.

        Raises:
            MitsonarError: the folder holds other files, or a run that is neither resumed nor replaced, or has other
                settings.
        """
        if resume and overwrite:
            raise MitsonarError("--resume and --overwrite contradict each other: give one")
        new = cls(Path(path), kind, plain_json(settings), versions(kind.packages))
        if not _contains_run(new.path):
            return new
        existing = _read(new.path, kind, only_kind=overwrite)
        if overwrite or (resume and existing._replaces):  # killed while it removed the run that it replaces
            new._replaces = True
            return new
        if not resume:
            raise MitsonarError(
                f"{new.path} exists and is kept as it is: --resume continues it, --overwrite begins anew, or choose "
                "another -o"
            )
        deciding = [{name: run.versions.get(name) for name in kind.deciding} for run in (existing, new)]
        check_same_settings(new.path, existing.settings | deciding[0], new.settings | deciding[1])
        existing.resumed = True
        return existing

    @classmethod
    def open(cls, path: str | Path, kind: RunKind) -> RunDirectory:
        """Read the run in a folder.

        Raises:
            MitsonarError: no run, a run of another type, or a damaged file.
        """
        if not (Path(path) / RUN_FILE).is_file():
            raise MitsonarError(f"{path} holds no {kind.name}: there is no {Path(path) / RUN_FILE}")
        other_kind = kind_of_run(path)
        if other_kind not in ("", kind.name):
            raise MitsonarError(f"{path} holds no {kind.name} but a run of another kind, {other_kind}: give another folder")
        return _read(Path(path), kind)

    def start(self, **notes: Any) -> None:
        """Create the folder of a new run and remove the run that it replaces; no effect if resumed or already started.

        Raises:
            MitsonarError: the folder cannot be written.
        """
        if self._started:
            return
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if self._replaces:
                self._write()
                _remove(self.path, (*self.kind.outputs, CONFIG_FILE))
                self._replaces = False
            self.note(**notes)
            self._started = True
        except OSError as error:
            raise MitsonarError(f"cannot write {self.path}: {error.strerror}; choose another -o") from None

    def note(self, **notes: Any) -> None:
        """Record the progress of the run."""
        self.notes |= plain_json(notes)
        self._write()

    def finish(self, **notes: Any) -> None:
        """Record that all outputs are complete."""
        self.finished = True
        self.note(**notes)

    def count(self, name: str, most: int) -> int:
        """Return a note that is a count; 0 if absent.

        Raises:
            MitsonarError: it exceeds ``most``.
        """
        try:
            return whole_number(self.notes.get(name, 0), name, 0, most)
        except MitsonarError as error:
            raise self.damage(error) from None

    def amount(self, name: str) -> float | None:
        """Return a note that is a positive number; None if absent.

        Raises:
            MitsonarError: it is 0 or less.
        """
        try:
            return None if self.notes.get(name) is None else finite_number(self.notes[name], name, above=0)
        except MitsonarError as error:
            raise self.damage(error) from None

    def damage(self, reason: object) -> MitsonarError:
        """Return the error for a damaged run file, with its remedies."""
        remedy = "begin anew with --overwrite" if self.kind.replaced else "remove the folder"
        return MitsonarError(f"{self.path / RUN_FILE} is damaged ({reason}): {remedy}, or choose another -o")

    def _write(self) -> None:
        unknown = set(self.notes) - set(self.kind.notes)
        assert not unknown, f"RunKind.notes lacks {unknown}"
        about = {"kind": self.kind.name, "finished": self.finished, "replaces": self._replaces}
        write_json(self.path / RUN_FILE, {**about, "asked": self.settings, "versions": self.versions, **self.notes})


# ---------------- Existing files and runs


def refuse_to_replace(*paths: Path, overwrite: bool, option: str = "-o") -> None:
    """Check that output files do not exist, unless they may be overwritten.

    Raises:
        MitsonarError: a file exists.
    """
    for path in paths:
        if path.exists() and not (overwrite and path.is_file()):
            raise MitsonarError(f"{path} exists and is kept as it is: choose another {option}, or give --overwrite")


def kind_of_run(path: str | Path) -> str:
    """Return the type of the run in a folder, such as ``odometry``; empty without a run or with a damaged file."""
    try:
        kind = read_json(Path(path) / RUN_FILE, check=False).get("kind")
    except MitsonarError:
        return ""
    return kind if isinstance(kind, str) else ""


def _contains_run(path: Path) -> bool:
    """Return whether a folder holds a run; a missing or empty folder does not.

    Raises:
        MitsonarError: the folder holds other files.
    """
    if path.exists() and not path.is_dir():
        raise MitsonarError(f"{path} is a file and is kept as it is: choose a folder as -o")
    names = [one.name for one in path.iterdir() if not one.name.endswith(PARTIAL_SUFFIXES)] if path.exists() else []
    if names and RUN_FILE not in names:
        raise MitsonarError(f"{path} contains other files ({min(names)}) and is kept as it is: choose another -o")
    return bool(names)


def _read(path: Path, kind: RunKind, *, only_kind: bool = False) -> RunDirectory:
    """Read the run in a folder and check its values; of a run to be replaced, only its type is checked."""
    content = read_json(path / RUN_FILE, check=False)
    if content.get("kind") != kind.name:
        raise MitsonarError(f"{path} holds no {kind.name} of mitsonar and is kept as it is: choose another -o")
    run = RunDirectory(path, kind, {}, {})
    if only_kind:
        return run
    try:
        _check(content, kind)
    except MitsonarError as error:
        raise run.damage(error) from None
    run.settings, run.versions, run.finished = content["asked"], content["versions"], content["finished"]
    run.notes = {key: content[key] for key in kind.notes if key in content}
    run._replaces, run._started = content["replaces"], True
    return run


COMMON_KEYS: dict[str, Any] = {"kind": str, "finished": bool, "replaces": bool, "asked": dict, "versions": dict}
"""Keys of every run file."""


def _check(content: dict[str, Any], kind: RunKind) -> None:
    """Check that the keys of a file are those of a type of run, and that its values have the right types.

    Raises:
        MitsonarError: an invalid key or value.
    """
    from pydantic import ConfigDict, Field, ValidationError, create_model

    check_plain_value(content, "it")
    stricter: dict[Any, Any] = {int: Annotated[int, Field(ge=0, le=LARGEST_COUNT)], list: list[str | int | float]}
    fields: dict[str, Any] = {name: (expected, ...) for name, expected in COMMON_KEYS.items()}
    fields |= {name: (stricter.get(expected, expected), None) for name, expected in kind.notes.items()}
    model = create_model(
        "RunFile", __config__=ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, protected_namespaces=()), **fields
    )
    try:
        model.model_validate(content)
    except ValidationError as error:
        raise MitsonarError(validation_message(error, model, "run")) from None


def _remove(path: Path, outputs: Iterable[str]) -> None:
    """Remove the outputs of an earlier run of the same type."""
    for pattern in outputs:
        for one in path.glob(pattern):
            if one.is_dir() and not one.is_symlink():
                shutil.rmtree(one)
            else:
                one.unlink()
