"""A table of the thesis again: data made at a scale, its rows trained and evaluated one after the other, all on disk."""

from __future__ import annotations

import io
import json
import math
import platform
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, Protocol

from pydantic import ValidationError

from mitsonar.config.data_recipe import Recipe, load_recipe, recipe_from
from mitsonar.config.training_recipe import TrainingRecipe, load_training_recipe
from mitsonar.datasets.generation import make_dataset
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError, argument, complaint
from mitsonar.io.provenance import plain_json, refuse_other, versions
from mitsonar.io.run_directory import RunDirectory, RunKind
from mitsonar.io.storage import Storage
from mitsonar.io.whole_files import read_json, write_json, write_whole
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.training.document_tables import (
    Found,
    Reached,
    RowScore,
    load_tables,
    plain_table,
    rows_named,
    table_figure,
    table_lines,
    table_named,
    tables_with,
)
from mitsonar.training.evaluation import evaluate
from mitsonar.training.training_folder import TRAINING
from mitsonar.training.training_run import TrainingReport, train

__all__ = ["Effort", "Watch", "reproduce", "unseen_recipe"]

TABLES = RunKind(
    "tables",
    outputs=("table.md", "table.json", "table-*.png", "data", "runs", "rows"),
    notes={"tables": list, "recipes": dict},
    packages=("mitsonar", "mitsuba", "drjit", "torch", "lightning", "numpy"),
    replaced=False,
)

UNSEEN_SEED = 7919
"""Added to a data set's seed: worlds that training never saw."""

UNSEEN_SEQUENCES = (100, 1000)
"""Fewest (ten scenes, if the recipe has as many) and most sequences of unseen scenes; between, a twentieth of training's."""


@dataclass(frozen=True)
class Effort:
    """What is spent on each row; a folder has one and keeps it.

    Attributes:
        scale: part of the recipe's sequences that are made, 0..1.
        minutes: of training at most; None: until the recipe's epochs are done.
        batch: samples of a step instead of the recipe's; Adam's rate grows with its square root. None: the recipe's.
        changes: keys of the training recipes to change, dots between the levels; those that a table or row sets itself stay.

    Raises:
        MitsonarError: values outside these limits.
    """

    scale: float = 0.02
    minutes: float | None = 30.0
    batch: int | None = None
    changes: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1:
            raise MitsonarError(f"scale is a part of the thesis's data, above 0 and at most 1: got {self.scale:g}")
        if self.minutes is not None and not (self.minutes > 0 and math.isfinite(self.minutes)):
            raise MitsonarError(f"{argument('minutes')} of training of a row must be above 0: got {self.minutes:g}")
        if self.batch is not None and self.batch < 1:
            raise MitsonarError(f"a batch has 1 sample or more: got {self.batch}")

    def recipe(self, name: str, own: dict[str, Any] | None = None) -> TrainingRecipe:
        """The training recipe of that name, changed as this says, and then as a table and its row do.

        Raises:
            MitsonarError: keys that it has not, values outside their limits.
        """
        recipe = load_training_recipe(name, {**self.changes, **(own or {})})
        if self.batch is None or self.batch == recipe.batch:
            return recipe
        rate = recipe.optimiser.rate * math.sqrt(self.batch / recipe.batch)
        return recipe.replace(batch=self.batch, optimiser=recipe.optimiser.model_dump() | {"rate": rate})

    def sentence(self) -> str:
        """For people."""
        said = [f"scale {self.scale:g} of the recipes' data"]
        said.append("all epochs" if self.minutes is None else f"at most {self.minutes:g} minutes of training a row")
        if self.batch is not None:
            said.append(f"batches of {self.batch}, the rate scaled by the square root")
        if self.changes:
            keys = ", ".join(f"{key} {json.dumps(value)}" for key, value in self.changes.items())
            said.append(f"recipes changed, where a row has no value of its own: {keys}")
        return "; ".join(said)


Told = Callable[[int], None]
"""Called with how many more are done."""


class Watch(Protocol):
    """Who is told how far things are."""

    def begin(self, what: str, total: int, unit: str) -> Told:
        """Something begins that has so many parts."""

    def training(self, what: str) -> AbstractContextManager[tuple[Callable[[TrainingReport], None], Callable[[], bool]]]:
        """While a network is trained; yields what is called after each step, and what is asked then: whether to stop."""


class SilentWatch:
    """A watch that nobody keeps."""

    def begin(self, what: str, total: int, unit: str) -> Told:
        """Nothing is told."""
        return lambda done: None

    @contextmanager
    def training(self, what: str) -> Iterator[tuple[Callable[[TrainingReport], None], Callable[[], bool]]]:
        """Nothing is told, and training goes on."""
        yield lambda report: None, lambda: False


def reproduce(
    table: str,
    out: str | Path,
    effort: Effort,
    *,
    rows: list[str] | None = None,
    workers: int = 1,
    accelerator: str = "auto",
    devices: str | int = "auto",
    watch: Watch | None = None,
) -> dict[str, Any]:
    """Make the data of a table's rows, train each, evaluate it, and write the table; or go on with one that was broken off.

    ``out`` holds ``table.md``, ``table.json`` and ``table-NUMBER.png``, written anew after each row; ``data/``, one data set
    for all rows that learn from the same, and one of unseen scenes; ``runs/``, one training a row; ``rows/``, what each
    row reached. Other tables may be asked for in the same folder: a row that is in both is trained once.

    Args:
        table: its number.
        out: the folder.
        effort: what is spent on each row.
        rows: their names; default: all of the table.
        workers: processes that render.
        accelerator: Lightning's word.
        devices: Lightning's word.
        watch: who is told how far things are.

    Returns:
        What ``table.json`` holds.

    Raises:
        MitsonarError: unknown names; a folder that holds other things, or was begun with other numbers or recipes.
    """
    known = table_named(table)
    recipes = {row.name: effort.recipe(row.recipe, {**known.set, **row.set}) for row in rows_named(known, rows)}
    data = {name: load_recipe(recipe.data, recipe.data_changes) for name, recipe in recipes.items()}
    crew = Crew(workers, accelerator, devices, watch or SilentWatch())
    with Storage(out).locked():
        bench = TableBuilder(RunDirectory.begin(out, TABLES, asdict(effort), resume=True), effort)
        bench.ask(table, recipes)
        report = bench.report()
        for name, recipe in recipes.items():
            if name not in bench.found():
                bench.work(name, recipe, data[name], crew)
                report = bench.report()
    return report


@dataclass(frozen=True)
class Crew:
    """Who does the work, which changes nothing in the folder: see :func:`reproduce`."""

    workers: int
    accelerator: str
    devices: str | int
    watch: Watch


@dataclass(frozen=True)
class TableBuilder:
    """The folder.

    Attributes:
        run: which tables are wanted, and the recipes of their rows.
        effort: what it was begun with.
    """

    run: RunDirectory
    effort: Effort

    @property
    def folder(self) -> Path:
        """Where it is."""
        return self.run.path

    @property
    def tables(self) -> list[str]:
        """Names of the tables that are wanted."""
        return self.run.notes.get("tables") or []

    @property
    def recipes(self) -> dict[str, Any]:
        """Recipes of the rows that were begun."""
        return self.run.notes.get("recipes") or {}

    def ask(self, table: str, recipes: dict[str, TrainingRecipe]) -> None:
        """Keep which tables are wanted, and the recipes of their rows.

        Raises:
            MitsonarError: a row was begun with another recipe.
        """
        self.run.start(tables=[], recipes={})
        had, asked = self.recipes, plain_json({name: recipe.plain() for name, recipe in recipes.items()})
        begun = {name: recipe for name, recipe in asked.items() if name in had}
        refuse_other(self.folder, {"row": {name: had[name] for name in begun}}, {"row": begun})
        tables = [name for name in load_tables() if name == table or name in self.tables]
        self.run.note(tables=tables, recipes=had | asked)

    def work(self, name: str, recipe: TrainingRecipe, data: Recipe, crew: Crew) -> None:
        """Data, training and evaluation of one row; each stays on disk when it is done, and is not done again."""
        sequences = max(1, round(self.effort.scale * data.sequences))
        table = table_named(tables_with(name)[0])
        other, fresh = unseen_recipe(data, sequences, table.unseen, recipe.input.frames)
        if table.unseen is not None:
            fresh = max(min(fresh, UNSEEN_SEQUENCES[0]), round(self.effort.scale * fresh))
        seen = self._made(data, sequences, crew)
        gain = DataStore.open(seen).about.get("gain")  # one sonar, whatever it looks at
        unseen = self._made(other if gain is None else other.model_copy(update={"gain": gain}), fresh, crew)
        checkpoint = self._trained(name, recipe, seen, crew)
        noises = list(table.noises)
        scores = [
            _scores(evaluate(checkpoint, url, noise=noises, part=part, begin=_teller(crew.watch, f"{name}, {said}")))
            for url, part, said in ((seen, "validation", "validation"), (unseen, "all", "unseen scenes"))
        ]
        reached = _reached(checkpoint, recipe, self._run(name))
        found = Found(recipe=name, validation=scores[0], unseen=scores[1], reached=reached)
        (self.folder / "rows").mkdir(exist_ok=True)
        write_json(self.folder / "rows" / f"{name}.json", found.model_dump(mode="json"))

    def _made(self, data: Recipe, sequences: int, crew: Crew) -> Path:
        """A data set; all rows of the same recipe read the same one."""
        path = self.folder / "data" / f"{data.name}-{data.digest()[:8]}.zarr"
        told: list[Told] = []

        def begun(frames: int, done: int) -> None:
            told.append(crew.watch.begin(f"rendering {path.stem}", frames, "frames"))
            told[0](done)

        make_dataset(
            data, str(path), sequences=sequences, workers=crew.workers, begun=begun, progress=lambda more: told[0](more)
        )
        return path

    def _run(self, name: str) -> Path:
        return self.folder / "runs" / name

    def _trained(self, name: str, recipe: TrainingRecipe, data: Path, crew: Crew) -> Checkpoint:
        """The network of a row."""
        run = self._run(name)
        words: dict[str, Any] = {"minutes": self.effort.minutes, "accelerator": crew.accelerator, "devices": crew.devices}
        with crew.watch.training(name) as (progress, stop):
            return train(recipe, data, run, resume=run.exists(), progress=progress, stop=stop, **words)

    def found(self) -> dict[str, Found]:
        """Rows that are done.

        Raises:
            MitsonarError: a file that is damaged.
        """
        rows = {}
        for path in sorted((self.folder / "rows").glob("*.json")):
            try:
                rows[path.stem] = Found(**read_json(path))
            except (ValidationError, TypeError) as error:
                said = complaint(error, Found, "row") if isinstance(error, ValidationError) else str(error)
                raise MitsonarError(f"{path} is damaged ({said}): remove it, and the row is evaluated again") from None
        return rows

    def report(self) -> dict[str, Any]:
        """Write the tables and figures of what there is."""
        found, version = self.found(), versions(("mitsonar",))["mitsonar"]
        tables = [table_named(name) for name in self.tables]
        lines = [f"`mitsonar reproduce`, mitsonar {version}: {self.effort.sentence()}."]
        for table in tables:
            lines += ["", *table_lines(table, found)]
            figure = table_figure(table, found, title=f"{table.kind} {table.name}, {table.title}; {self.effort.sentence()}")
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=80)
            write_whole(self.folder / f"table-{table.name}.png", buffer.getvalue())
        report = {"version": version, **self.run.asked, "recipes": self.recipes}
        report["tables"] = {table.name: plain_table(table, found) for table in tables}
        write_whole(self.folder / "table.md", ("\n".join(lines) + "\n").encode())
        write_json(self.folder / "table.json", report)
        return report


def unseen_recipe(data: Recipe, learnt: int, wanted: int | None, frames: int) -> tuple[Recipe, int]:
    """The recipe of unseen scenes, and how many of its sequences are made.

    Args:
        data: that training learns from.
        learnt: sequences of it.
        wanted: sequences, of no more frames than a sample has; None: part of the training's.
        frames: of a sample.
    """
    fields = data.model_dump(mode="json") | {"name": f"{data.name}-unseen", "seed": (data.seed + UNSEEN_SEED) % 2**31}
    if wanted is None:
        few, most = UNSEEN_SEQUENCES
        return recipe_from(fields), min(data.sequences, max(few, min(most, learnt // 20)))
    many = -(-wanted // data.sequences)
    fields["flight"] |= {"pings": frames}
    fields["scenes"] = [group | {"sequences": many * group["sequences"]} for group in fields["scenes"]]
    return recipe_from(fields), wanted


def _teller(watch: Watch, what: str) -> Callable[[int], Told]:
    """For :func:`~mitsonar.training.evaluation.evaluate`."""
    return lambda total: watch.begin(f"evaluating {what}", total, "pairs")


def _scores(report: dict[str, Any]) -> dict[str, RowScore]:
    """What an evaluation found, by noise."""
    scores = {}
    for table in report["tables"]:
        row = next(row for row in table["rows"] if row["method"] == report["network"])
        scores[table["noise"]] = RowScore(
            pairs=report["pairs"],
            scenes=report["scenes"],
            low=row["rmse_low"],
            high=row["rmse_high"],
            **{key: row[key] for key in ("rmse", "slope", "zero", "ms")},
        )
    return scores


def _reached(checkpoint: Checkpoint, recipe: TrainingRecipe, folder: Path) -> Reached:
    """The scale of a training that has ended, from what it wrote.

    Raises:
        MitsonarError: that file is damaged.
    """
    try:
        return _as_told(checkpoint, recipe, RunDirectory.open(folder, TRAINING).notes)
    except (KeyError, TypeError, ZeroDivisionError, ValidationError) as error:
        raise MitsonarError(f"{folder} is damaged ({error}): remove it, and the row is trained again") from None


def _as_told(checkpoint: Checkpoint, recipe: TrainingRecipe, run: dict[str, Any]) -> Reached:
    seen = run["steps_done"] * recipe.batch
    machine = run["machine"]
    return Reached(
        training_pairs=run["epoch_samples"],
        pairs_seen=seen,
        pairs_best=checkpoint.trained["pairs"],
        epochs=seen / run["epoch_samples"],
        epochs_asked=run["steps"] * recipe.batch / run["epoch_samples"],
        minutes=run["minutes"],
        device=machine["gpu"] if "CUDA" in run["accelerator"] else "CPU",
        machine=f"{_processor()}, {machine['cores']} cores",
        threads=run["threads"],
        batch=recipe.batch,
        rate=recipe.optimiser.rate,
        precision=recipe.precision,
        split=recipe.split if isinstance(recipe.split, str) else str(recipe.split["by"]),
        date=date.today().isoformat(),
    )


def _processor() -> str:
    """The name of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
