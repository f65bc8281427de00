"""The odometry benchmark: methods on simulated sets and recordings, a row each, in a folder that can go on."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, MitsonarWarning, argument, nearest_names
from mitsonar.estimation.estimator import AnyEstimator, PlainTable
from mitsonar.estimation.named import EXTERNAL, create_estimator
from mitsonar.io.files import parse_json, read_json, whole_lines, write_json, write_whole
from mitsonar.io.runs import RunDirectory, RunKind, digest, versions
from mitsonar.mapping.benchmark_row import LENGTHS_M, Case, measured_row
from mitsonar.mapping.benchmark_sets import DIVE, NOISES, PRESET, SEED, SETS, TEXTURES, Begin, RenderedSet
from mitsonar.mapping.benchmark_table import benchmark_lines
from mitsonar.mapping.frame_source import FrameSource
from mitsonar.mapping.open_source import LOOP, Reading, open_source, record_at
from mitsonar.records.frames import SonarFrames

__all__ = ["METHODS", "Wanted", "benchmark_odometry"]

METHODS = ("zero", "ecc", "phase", "flow", "direct", "corrnet", "corrnet-coherent", *EXTERNAL)
"""Rows that are made unasked, but for :data:`OTHER_GRAIN`."""

OTHER_GRAIN = {"still": "corrnet-coherent", "speckle": "corrnet", "recorded": "corrnet"}
"""The network that was not trained for frames of a texture."""

SET_WORDS = (DIVE, *(name for name, one in SETS.items() if one.flight is None))

LARGEST_JOURNAL = 2**28

BENCHMARK = RunKind(
    "odometry benchmark",
    outputs=("rows.jsonl", "table.md", "table.json", "bounds", "paths", "sets", "worlds"),
    notes={},
    packages=("mitsonar", "numpy", "scipy", "mitsuba", "opencv-python-headless"),
    deciding=("mitsonar",),
)


@dataclass(frozen=True)
class Wanted:
    """Rows that are asked for: every method on every set, texture and level of noise.

    Attributes:
        sets: names of :data:`~mitsonar.mapping.benchmark_sets.SETS`, or paths of recordings and runs. The beginning
            of a name up to a hyphen means all of these sets: ``dive``, ``dive-aris3000``.
        textures: of :data:`~mitsonar.mapping.benchmark_sets.TEXTURES`, for simulated sets.
        noises: of :data:`~mitsonar.mapping.benchmark_sets.NOISES`, for simulated sets; dives have their preset's.
        methods: as :func:`~mitsonar.estimation.named.create_estimator` takes them; none: :data:`METHODS`, without
            those whose packages are not installed.
        frames: of each set at most; None: 40 of a dive, 260 of another simulated set, all of a recording.
        geometry: file that tells how the pictures of recordings are laid out.
        bound: poses of the Cramer-Rao bound of a simulated set; 0: none.
    """

    sets: Sequence[str] = SET_WORDS
    textures: Sequence[str] = tuple(TEXTURES)
    noises: Sequence[str] = ("none",)
    methods: Sequence[str] = ()
    frames: int | None = None
    geometry: Path | None = None
    bound: int = 3


def benchmark_odometry(
    wanted: Wanted,
    out: str | Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    workers: int = 1,
    begin: Begin = lambda what, length: nullcontext(lambda done: None),
) -> PlainTable:
    """Make the rows that are missing, and write the table of all rows in the folder.

    Args:
        wanted: the rows.
        out: folder: ``rows.jsonl`` with a line a row; ``table.md`` and ``table.json``; rendered sets, and the path of each
            row.
        resume: add rows to a folder that is there. Rows in it are kept, and an interrupted one goes on.
        overwrite: replace what is there.
        workers: processes that estimate.
        begin: called with each stage, for progress.

    Returns:
        The content of ``table.json``: ``rows``, and ``notes`` that the reader needs.

    Raises:
        MitsonarError: unknown names, no frames, or another benchmark in the folder.
    """
    cells = list(_cells(wanted))
    methods, notes = _methods(wanted)
    cases = [case for cell in cells for case in _cases(cell, methods, wanted)]
    settings = {"limit": wanted.frames, "seed": SEED, "lengths_m": LENGTHS_M}
    bench = _Bench(RunDirectory.begin(out, BENCHMARK, settings, resume=resume, overwrite=overwrite), wanted)
    bench.run.start()
    known = bench.rows()
    for case in cases:
        if case.words in known:
            continue
        try:
            row = bench.measure(case, methods[case.method], workers, begin)
        except MitsonarError as error:
            notes.append(f"{' '.join(case.words)}: {error}")
            continue
        bench.keep(row)
        known[case.words] = row
    return bench.finish(sorted(known.values(), key=_order), notes)


# ---------------------------------------------------------------- what is asked


def _methods(wanted: Wanted) -> tuple[dict[str, AnyEstimator], list[str]]:
    """Create the estimators by name. Of those that were not asked for, leave out those that cannot be, with a note."""
    if wanted.methods:
        asked = {name: create_estimator(name) for name in dict.fromkeys(wanted.methods)}
        other = [name for name, estimator in asked.items() if estimator.consumes not in (SonarFrames, object)]
        if other:
            raise MitsonarError(f"{other[0]} does not read frames of one view: the benchmark takes {', '.join(METHODS)}")
        return asked, []
    made, notes = {}, []
    for name in METHODS:
        try:
            made[name] = create_estimator(name)
        except MitsonarError as error:
            notes.append(f"no row of {name}: {error}")
    return made, notes


def _cells(wanted: Wanted) -> Iterator[Case]:
    """List sets with texture and noise, as cases without a method.

    Raises:
        MitsonarError: unknown names, or no such file.
    """
    for what, words, known in (("texture", wanted.textures, TEXTURES), ("noise", wanted.noises, NOISES)):
        for word in words:
            if word not in known:
                raise MitsonarError(f"unknown {what} {word!r}: {nearest_names(word, known)}")
    if wanted.frames is not None and wanted.frames < 3:
        raise MitsonarError(f"{argument('frames')} must be at least 3: got {wanted.frames}")
    for name in dict.fromkeys(wanted.sets):
        sets = [one for one in SETS if f"{one}-".startswith(f"{name}-")]
        if sets:
            yield from (
                Case(one, texture, noise, "")
                for one in sets
                for texture in wanted.textures
                for noise in (wanted.noises if SETS[one].flight is None else (PRESET,))
            )
        elif not Path(name).exists():
            raise MitsonarError(
                f"unknown set {name!r}: {nearest_names(name, SET_WORDS)}; or give the path of a recording or a run"
            )
        else:
            if record_at(name) is not SonarFrames:
                raise MitsonarError(f"{name} holds impulse responses, and the benchmark is of frames: give frames")
            yield Case(name, "recorded", "none", "", wanted.geometry)


def _cases(cell: Case, methods: dict[str, AnyEstimator], wanted: Wanted) -> Iterator[Case]:
    """List the rows of a cell."""
    unwanted = "" if wanted.methods else OTHER_GRAIN[cell.texture]
    yield from (replace(cell, method=name) for name in methods if name != unwanted)


def _order(row: PlainTable) -> tuple[int, str, str, int, int, str]:
    """Return where a row stands in the table: sets, textures, noises and methods in their own order, others after them."""
    places = [[*SETS], [*NOISES], [*METHODS]]
    words = row["set"], row["noise"], row["method"]
    at = [known.index(word) if word in known else len(known) for known, word in zip(places, words, strict=True)]
    return at[0], row["set"], "" if row["texture"] == "still" else row["texture"], at[1], at[2], row["method"]


# ---------------------------------------------------------------- the folder


class _Bench:
    """The folder of a benchmark.

    Attributes:
        told: sentences that opening recordings gave, each once; they are the same for every method.
    """

    def __init__(self, run: RunDirectory, wanted: Wanted) -> None:
        self.run, self.out, self.wanted = run, run.path, wanted
        self.told: dict[str, None] = {}
        self.journal = run.path / "rows.jsonl"

    def rows(self) -> dict[tuple[str, str, str, str], PlainTable]:
        """Return the rows of earlier runs. Cut off a line that a kill left half written.

        Raises:
            MitsonarError: the journal is damaged.
        """
        rows = {}
        for number, line in enumerate(whole_lines(self.journal, "journal", LARGEST_JOURNAL), start=1):
            try:
                row = parse_json(line, "the line")
                rows[row["set"], row["texture"], row["noise"], row["method"]] = row
            except Exception:  # a line leads to whatever its bytes do
                raise MitsonarError(f"{self.journal}, line {number} is damaged: start over with --overwrite") from None
        return rows

    def keep(self, row: PlainTable) -> None:
        """Add a row to the journal."""
        with self.journal.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def measure(self, case: Case, estimator: AnyEstimator, workers: int, begin: Begin) -> PlainTable:
        """Make a row; render its set where it is missing."""
        rendered = None
        if case.name in SETS:
            rendered = RenderedSet(
                case.name, case.texture, case.noise, self.wanted.frames or SETS[case.name].frames, self.out
            )
            source = rendered.source(begin)
        else:
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always", MitsonarWarning)
                source = _recorded(case, estimator, self.wanted.frames)
            self.told |= dict.fromkeys(str(one.message) for one in told if one.category is MitsonarWarning)
        bound = None if rendered is None or not self.wanted.bound else self._bound(case, rendered, begin)
        loops = 0 if source.true is not None else max(0, len(source) - 1 - LOOP)
        with begin(" ".join(case.words), len(source) - 1 + loops) as progress:
            folder = self.out / "paths" / _folder_name(case)
            return measured_row(case, source, estimator, folder, bound=bound, workers=workers, progress=progress)

    def _bound(self, case: Case, rendered: RenderedSet, begin: Begin) -> NDArray[np.float64] | None:
        """Return the bound of a set, computed once; None where it cannot be."""
        path = self.out / "bounds" / f"{case.name}-{case.texture}-{case.noise}-{self.wanted.bound}.json"
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            try:
                std = rendered.bound(self.wanted.bound, begin).tolist()
            except MitsonarError as error:
                write_json(path, {"std": None, "reason": str(error)})
            else:
                write_json(path, {"std": std, "reason": ""})
        std = read_json(path)["std"]
        return None if std is None else np.array(std, dtype=float)

    def finish(self, rows: list[PlainTable], notes: list[str]) -> PlainTable:
        """Write the table of all rows."""
        report: PlainTable = {**self.run.asked, "loop": LOOP, "notes": [*self.told, *notes], "rows": rows}
        report |= versions(BENCHMARK.packages)
        write_whole(self.out / "table.md", ("\n".join(benchmark_lines(rows)) + "\n").encode())
        write_json(self.out / "table.json", report)
        self.run.finish()
        return report


def _recorded(case: Case, estimator: AnyEstimator, frames: int | None) -> FrameSource:
    """Open a recording or a run, its first frames only.

    Raises:
        MitsonarError: fewer than two frames, or frames that the estimator does not take.
    """
    source = cast(FrameSource, open_source(case.name, estimator, Reading(geometry=case.geometry)))
    source = source if frames is None else _first(source, frames)
    if len(source) < 2:
        raise MitsonarError(f"a row of the benchmark needs two frames or more: got {len(source)} from {case.name}")
    return source


def _first(source: FrameSource, count: int) -> FrameSource:
    """Return the first frames of a source."""
    poses, attitude, height = source.poses, source.attitude_rad, source.height_m
    return replace(
        source,
        time_s=source.time_s[:count],
        poses=None if poses is None else poses[:count],
        attitude_rad=None if attitude is None else attitude[:count],
        height_m=None if height is None else height[:count],
    )


def _folder_name(case: Case) -> str:
    """Return the name of the folder of a row's path; that of a file tells its whole path by a digest."""
    name = case.name if case.name in SETS else f"{Path(case.name).stem}-{digest(str(Path(case.name).resolve()))[:8]}"
    plain = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in case.method)
    return "-".join((name, case.texture, case.noise, plain))
