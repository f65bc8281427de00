"""The folder of a run: begun, gone on with, replaced or refused. One way for all that write folders.

A run's folder holds ``run.json``: what kind of run it is, what was asked for, the versions of the packages that decide its
bits, and notes on how far it is. The file is whole at any moment, so that a run that was killed can go on. It is read as if
a stranger had written it: every value has its type, or one sentence says which has not.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mitsonar.errors import MitsonarError
from mitsonar.io.provenance import plain_json, refuse_other, shown, versions
from mitsonar.io.whole_files import read_json, write_json

__all__ = ["RUN_FILE", "RunDirectory", "RunKind", "refuse_to_replace"]

RUN_FILE = "run.json"

LEFT_BY_A_KILL = (".part", "writer.lock")
"""Ends of the names of files that a killed run may leave; a folder that holds only these is free."""

DEEPEST = 20
"""Levels of a run's file."""


@dataclass(frozen=True)
class RunKind:
    """A kind of run.

    Attributes:
        name: in ``run.json`` and in sentences: ``odometry``.
        outputs: names (or patterns) of all that a run writes beside ``run.json``. A resumed run keeps them, a replaced one
            loses them; nothing else in the folder is ever removed.
        notes: what ``run.json`` may tell of a run, with types: ``int`` is a count from 0, ``list`` holds texts and numbers.
        packages: those whose versions are kept.
        deciding: those without whose versions a run does not go on, since the rest would differ.
    """

    name: str
    outputs: tuple[str, ...]
    notes: Mapping[str, type]
    packages: tuple[str, ...] = ("mitsonar", "numpy")
    deciding: tuple[str, ...] = ()


@dataclass
class RunDirectory:
    """A run on disk. :meth:`begin` says which, :meth:`start` makes the folder, :meth:`note` and :meth:`finish` go along.

    Attributes:
        path: of the folder.
        kind: of the run.
        asked: what was asked for, as JSON gives it back; a run goes on only with the same.
        versions: of packages, when it was begun.
        notes: how far it is.
        finished: whether all outputs are whole.
        resumed: whether an earlier run goes on.
    """

    path: Path
    kind: RunKind
    asked: dict[str, Any]
    versions: dict[str, str]
    notes: dict[str, Any] = field(default_factory=dict)
    finished: bool = False
    resumed: bool = False
    _replaces: bool = False
    _started: bool = False

    @classmethod
    def begin(
        cls, path: str | Path, kind: RunKind, asked: Mapping[str, Any], *, resume: bool = False, overwrite: bool = False
    ) -> RunDirectory:
        """Say which run is meant: a new one, or the one that is there. Nothing is written yet.

        Args:
            path: of the folder.
            kind: of the run.
            asked: all that decides the results.
            resume: go on with a run that is there; without one, a new one begins.
            overwrite: replace a run that is there.

        Raises:
            MitsonarError: other things are there; a run that is neither resumed nor replaced, or was asked for otherwise.
        """
        if resume and overwrite:
            raise MitsonarError("--resume and --overwrite contradict each other: give one")
        new = cls(Path(path), kind, plain_json(asked), versions(kind.packages))
        if not _holds_a_run(new.path):
            return new
        had = _read(new.path, kind, damaged_will_do=overwrite)
        if overwrite or (resume and had._replaces):  # killed while what it replaces was removed
            new._replaces = True
            return new
        if not resume:
            raise MitsonarError(
                f"{new.path} exists and is kept as it is: --resume goes on with it, --overwrite begins anew, or choose "
                "another -o"
            )
        deciding = [{name: of.versions.get(name) for name in kind.deciding} for of in (had, new)]
        refuse_other(new.path, had.asked | deciding[0], new.asked | deciding[1])
        had.resumed = True
        return had

    @classmethod
    def open(cls, path: str | Path, kind: RunKind) -> RunDirectory:
        """Read the run in a folder.

        Raises:
            MitsonarError: none there, of another kind, or its file is damaged.
        """
        if not (Path(path) / RUN_FILE).is_file():
            raise MitsonarError(f"{path} holds no {kind.name}: there is no {Path(path) / RUN_FILE}")
        return _read(Path(path), kind)

    def start(self, **notes: Any) -> None:
        """Make the folder of a new run, without what it replaces; a run that goes on, or has started, stays as it is.

        Raises:
            MitsonarError: the folder cannot be written.
        """
        if self._started:
            return
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if self._replaces:
                self._write()
                _remove(self.path, self.kind.outputs)
                self._replaces = False
            self.note(**notes)
            self._started = True
        except OSError as error:
            raise MitsonarError(f"cannot write {self.path}: {error.strerror}; choose another -o") from None

    def note(self, **notes: Any) -> None:
        """Keep how far the run is."""
        self.notes |= plain_json(notes)
        self._write()

    def finish(self, **notes: Any) -> None:
        """Keep that all outputs are whole."""
        self.finished = True
        self.note(**notes)

    def count(self, name: str, most: int) -> int:
        """A note that counts, 0 where there is none.

        Raises:
            MitsonarError: it exceeds ``most``.
        """
        found = self.notes.get(name) or 0
        if found > most:
            raise _damage(self.path / RUN_FILE, f"{name} is at most {most}, got {found}")
        return int(found)

    def _write(self) -> None:
        unknown = set(self.notes) - set(self.kind.notes)
        assert not unknown, f"RunKind.notes lacks {unknown}"
        about = {"kind": self.kind.name, "finished": self.finished, "replaces": self._replaces}
        write_json(self.path / RUN_FILE, {**about, "asked": self.asked, "versions": self.versions, **self.notes})


# ---------------------------------------------------------------- what is there


def refuse_to_replace(*paths: Path, overwrite: bool, option: str = "-o") -> None:
    """Keep files that are there, unless they may be replaced.

    Raises:
        MitsonarError: one is there.
    """
    for path in paths:
        if path.exists() and not (overwrite and path.is_file()):
            raise MitsonarError(f"{path} exists and is kept as it is: choose another {option}, or give --overwrite")


def _holds_a_run(path: Path) -> bool:
    """Whether a run is in a folder; not in one that is not there, or empty.

    Raises:
        MitsonarError: it holds other things.
    """
    if path.exists() and not path.is_dir():
        raise MitsonarError(f"{path} is a file and is kept as it is: choose a folder as -o")
    there = [one.name for one in path.iterdir() if not one.name.endswith(LEFT_BY_A_KILL)] if path.exists() else []
    if there and RUN_FILE not in there:
        raise MitsonarError(f"{path} holds other things ({min(there)}) and is kept as it is: choose another -o")
    return bool(there)


def _read(path: Path, kind: RunKind, *, damaged_will_do: bool = False) -> RunDirectory:
    """The run in a folder, every value of its type; of a damaged one that will be replaced, only the kind."""
    file = path / RUN_FILE
    told = read_json(file)
    if told.get("kind") != kind.name:
        raise MitsonarError(f"{path} holds no {kind.name} of mitsonar and is kept as it is: choose another -o")
    if damaged_will_do:
        return RunDirectory(path, kind, {}, {})
    if _deeper_than(told, DEEPEST):
        raise _damage(file, f"it has more than {DEEPEST} levels")
    expected = {**OWN, **kind.notes}
    for key, value in told.items():
        if key not in expected:
            raise _damage(file, f"unknown key {shown(key)}")
        if not _is(value, expected[key]) and not (value is None and key in kind.notes):
            raise _damage(file, f"{key} is {NAMES[expected[key]]}, got {shown(value)}")
    lacking = set(OWN) - set(told)
    if lacking:
        raise _damage(file, f"it lacks {min(lacking)}")
    notes = {key: told[key] for key in kind.notes if key in told}
    state = {"finished": told["finished"], "_replaces": told["replaces"], "_started": True}
    return RunDirectory(path, kind, told["asked"], told["versions"], notes, **state)


OWN: dict[str, type] = {"kind": str, "finished": bool, "replaces": bool, "asked": dict, "versions": dict}
"""Keys of every run's file."""

NAMES: dict[type, str] = {
    bool: "true or false",
    int: "a count",
    float: "a finite number",
    str: "a text",
    dict: "an object",
    list: "a list of texts and numbers",
}


def _is(value: object, expected: type) -> bool:
    """Whether a value that JSON gave is what is expected."""
    if expected is int:
        return type(value) is int and 0 <= value < 2**63
    if expected is float:
        return type(value) in (int, float) and abs(value) < 1e300  # type: ignore[arg-type, operator]
    if expected is list:
        return isinstance(value, list) and all(_is(one, str) or _is(one, float) for one in value)
    return type(value) is expected


def _deeper_than(value: object, levels: int) -> bool:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return levels < 0 or any(_deeper_than(one, levels - 1) for one in inner)


def _damage(file: Path, said: str) -> MitsonarError:
    return MitsonarError(f"{file} is damaged ({said}): remove the folder, or choose another -o")


def _remove(path: Path, outputs: Iterable[str]) -> None:
    """Remove what an earlier run of the same kind has written."""
    for pattern in outputs:
        for one in path.glob(pattern):
            if one.is_dir() and not one.is_symlink():
                shutil.rmtree(one)
            else:
                one.unlink()
