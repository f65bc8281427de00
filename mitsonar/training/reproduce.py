"""Reproduction of a table of Almanza-Medina: make its data at a scale, train and evaluate its rows, keep all on disk."""

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
from typing import Protocol

from pydantic import ValidationError

from mitsonar.config.data import Recipe, load_recipe, recipe_from
from mitsonar.config.training import TrainingRecipe, load_training_recipe
from mitsonar.datasets.make import make_dataset
from mitsonar.datasets.samples import split_for
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError, argument, complaint
from mitsonar.io.files import read_json, write_json, write_whole
from mitsonar.io.runs import RunDirectory, RunKind, plain_json, refuse_other, versions
from mitsonar.io.storage import Storage
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.training.document_tables import load_tables, rows_named, split_name, table_named, tables_with
from mitsonar.training.evaluation import evaluate
from mitsonar.training.reproduced_tables import plain_table, table_figure, table_lines
from mitsonar.training.row_results import Found, Reached, RowScore
from mitsonar.training.training_folder import TRAINING
from mitsonar.training.training_journal import TrainingReport
from mitsonar.training.training_run import train
from mitsonar.training.training_types import JsonObject

__all__ = ["Effort", "Watch", "reproduce", "unseen_recipe"]

TABLES = RunKind(
    "tables",
    outputs=("table.md", "table.json", "table-*.png", "data", "runs", "rows"),
    notes={"tables": list, "recipes": dict},
    packages=("mitsonar", "mitsuba", "drjit", "torch", "lightning", "numpy"),
    replaced=False,
)

UNSEEN_SEED = 7919
"""Added to the seed of a data set, so that its worlds are not those of training."""

UNSEEN_SEQUENCES = (100, 1000)
"""Fewest (ten scenes) and most sequences of unseen scenes; between, a twentieth of the training sequences."""


QUICK_TRAINING: JsonObject = {
    "network.width": 1 / 32,
    "steps": 2,
    "epochs": None,
    "batch": 2,
    "validate": {"noise": ["none"], "pairs": 2, "every_steps": 2},
}
"""Changes of training recipes by a quick effort."""

QUICK_WORLDS: dict[str, JsonObject] = {
    "rocky-field": {"family": "rocky-field", "size_m": 60, "a_side": [8, 12]},
    "ship-hull": {"family": "ship-hull", "groups_a_side": [3, 3], "anodes_a_side": [3, 3]},
    "flat-objects": {"family": "flat-objects", "size_m": 30, "seabed_cells": 300, "rectangles": 20, "ellipses": 20},
}
"""Worlds of a quick effort, by family."""


@dataclass(frozen=True)
class Effort:
    """What is spent on each row. All rows in one folder have the same effort.

    Attributes:
        scale: part of the recipe's sequences that are made, 0..1.
        minutes: of training at most [min]; None: until the epochs of the recipe are done.
        batch: samples of a step in place of the recipe's; the learning rate is scaled by the square root. None: the
            recipe's.
        changes: keys of the training recipes to change, with dots between the levels. Keys that a table or a row sets are
            not changed.
        data: keys of the data set recipes to change, beside those that a training recipe changes.
        quick: a few coarse frames of small worlds and two steps of narrow networks, to see that a row can be trained.

    Raises:
        MitsonarError: a value is outside these limits.
    """

    scale: float = 0.02
    minutes: float | None = 30.0
    batch: int | None = None
    changes: JsonObject = field(default_factory=dict)
    data: JsonObject = field(default_factory=dict)
    quick: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1:
            raise MitsonarError(f"scale is a part of the data of Almanza-Medina, above 0 and at most 1: got {self.scale:g}")
        if self.minutes is not None and not (self.minutes > 0 and math.isfinite(self.minutes)):
            raise MitsonarError(f"{argument('minutes')} of training of a row must be above 0: got {self.minutes:g}")
        if self.batch is not None and self.batch < 1:
            raise MitsonarError(f"a batch has 1 sample or more: got {self.batch}")

    def recipe(self, name: str, own: JsonObject | None = None) -> TrainingRecipe:
        """Load the training recipe of that name, with the changes of this effort and then those of a table and its row.

        Raises:
            MitsonarError: an unknown key, or a value outside its limits.
        """
        recipe = load_training_recipe(name, {**self.changes, **(own or {}), **(QUICK_TRAINING if self.quick else {})})
        few = quick_data(load_recipe(recipe.data)) if self.quick else {}
        if few or self.data:
            recipe = recipe.replace(data_changes={**recipe.data_changes, **self.data, **few})
        if self.batch is None or self.batch == recipe.batch:
            return recipe
        rate = recipe.optimiser.rate * math.sqrt(self.batch / recipe.batch)
        return recipe.replace(batch=self.batch, optimiser=recipe.optimiser.model_dump() | {"rate": rate})

    def sentence(self) -> str:
        """Describe the effort for people."""
        if self.quick:
            return "two steps on a few coarse frames: these errors say nothing"
        parts = [f"scale {self.scale:g} of the recipes' data"]
        parts.append("all epochs" if self.minutes is None else f"at most {self.minutes:g} minutes of training a row")
        if self.batch is not None:
            parts.append(f"batches of {self.batch}, the rate scaled by the square root")
        if self.changes:
            keys = ", ".join(f"{key} {json.dumps(value)}" for key, value in self.changes.items())
            parts.append(f"recipes changed, where a row has no value of its own: {keys}")
        if self.data:
            keys = ", ".join(f"{key} {json.dumps(value)}" for key, value in self.data.items())
            parts.append(f"data changed: {keys}")
        return "; ".join(parts)


Advance = Callable[[int], None]
"""Reports progress: is called with how many more parts are done."""

TrainingCallbacks = tuple[Callable[[TrainingReport], None], Callable[[], bool]]
"""What is called after each step of a training: the progress report, and the question whether to stop."""


class Watch(Protocol):
    """Shows the progress of a reproduction."""

    def begin(self, what: str, total: int, unit: str) -> Advance:
        """Show that work of ``total`` parts begins, and return what reports its progress."""

    def training(self, what: str) -> AbstractContextManager[TrainingCallbacks]:
        """Return the context of the training of one network."""


class SilentWatch:
    """A watch that shows nothing."""

    def begin(self, what: str, total: int, unit: str) -> Advance:
        """Return a report that does nothing."""
        return lambda done: None

    @contextmanager
    def training(self, what: str) -> Iterator[TrainingCallbacks]:
        """Yield a report that does nothing, and a question that never stops training."""
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
) -> JsonObject:
    """Make the data of the rows of a table, train and evaluate each row, and write the table; or resume this.

    ``out`` holds ``table.md``, ``table.json`` and ``table-NUMBER.png``, which are replaced after each row. ``data/`` holds
    one training data set for all rows with the same data, and one of unseen scenes. ``runs/`` holds one training a row.
    ``rows/`` holds the result of each row. Several tables may share a folder: a row of both is trained once.

    Args:
        table: number of the table.
        out: folder of the results.
        effort: what is spent on each row.
        rows: names of rows; default: all rows of the table.
        workers: number of processes that render.
        accelerator: as in Lightning's trainer.
        devices: as in Lightning's trainer.
        watch: shows the progress; default: nothing is shown.

    Returns:
        The content of ``table.json``.

    Raises:
        MitsonarError: an unknown name; or the folder holds other things, or was begun with another effort or recipe.
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
                report = report if effort.quick else bench.report()
        return bench.report() if effort.quick else report


@dataclass(frozen=True)
class Crew:
    """How the work is done, which has no effect on the results: see :func:`reproduce`."""

    workers: int
    accelerator: str
    devices: str | int
    watch: Watch


@dataclass(frozen=True)
class TableBuilder:
    """The folder of a reproduction.

    Attributes:
        run: the tables asked for, and the recipes of their rows.
        effort: what is spent on each row.
    """

    run: RunDirectory
    effort: Effort

    @property
    def folder(self) -> Path:
        """Return the path of the folder."""
        return self.run.path

    @property
    def tables(self) -> list[str]:
        """Return the numbers of the tables asked for."""
        return self.run.notes.get("tables") or []

    @property
    def recipes(self) -> JsonObject:
        """Return the recipes of the rows asked for, by the names of the rows."""
        return self.run.notes.get("recipes") or {}

    def ask(self, table: str, recipes: dict[str, TrainingRecipe]) -> None:
        """Store a table and the recipes of its rows.

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
        """Make the data of one row, train and evaluate it. What is on disk already is not repeated."""
        table = table_named(tables_with(name)[0])
        scale = 1.0 if self.effort.quick else self.effort.scale
        sequences = max(1, round(scale * data.sequences))
        wanted = None if self.effort.quick else table.unseen
        other, fresh = unseen_recipe(data, sequences, wanted, recipe.input.frames)
        if wanted is not None:
            fresh = max(min(fresh, UNSEEN_SEQUENCES[0]), round(self.effort.scale * fresh))
        seen = self._made(data, sequences, crew)
        gain = DataStore.open(seen).about.get("gain")  # both data sets are of one sonar
        unseen = self._made(other if gain is None else other.model_copy(update={"gain": gain}), fresh, crew)
        checkpoint = self._trained(name, recipe, seen, crew)
        noises = list(table.noises)[: 1 if self.effort.quick else None]
        parts = {"validation": (seen, "validation"), "unseen": (unseen, "all")}
        if split_for(recipe.split_of, data).test:
            parts["test"] = seen, "test"
        scores = {
            what: _scores(evaluate(checkpoint, url, noise=noises, part=part, begin=_progress(crew.watch, f"{name}, {what}")))
            for what, (url, part) in parts.items()
        }
        found = Found(recipe=name, **scores, reached=_reached(checkpoint, recipe, self._run(name)))
        (self.folder / "rows").mkdir(exist_ok=True)
        write_json(self.folder / "rows" / f"{name}.json", found.model_dump(mode="json"))

    def _made(self, data: Recipe, sequences: int, crew: Crew) -> Path:
        """Make a data set, or complete it. Rows with the same data recipe share it."""
        path = self.folder / "data" / f"{data.name}-{data.digest()[:8]}.zarr"
        advance: list[Advance] = []

        def begun(frames: int, done: int) -> None:
            advance.append(crew.watch.begin(f"rendering {path.stem}", frames, "frames"))
            advance[0](done)

        make_dataset(
            data, str(path), sequences=sequences, workers=crew.workers, begun=begun, progress=lambda more: advance[0](more)
        )
        return path

    def _run(self, name: str) -> Path:
        return self.folder / "runs" / name

    def _trained(self, name: str, recipe: TrainingRecipe, data: Path, crew: Crew) -> Checkpoint:
        """Train the network of a row, or resume its training."""
        run = self._run(name)
        with crew.watch.training(name) as (progress, stop):
            return train(
                recipe,
                data,
                run,
                minutes=self.effort.minutes,
                resume=run.exists(),
                accelerator=crew.accelerator,
                devices=crew.devices,
                progress=progress,
                stop=stop,
            )

    def found(self) -> dict[str, Found]:
        """Load the results of the rows that are done.

        Raises:
            MitsonarError: a file is damaged.
        """
        rows = {}
        for path in sorted((self.folder / "rows").glob("*.json")):
            try:
                rows[path.stem] = Found(**read_json(path))
            except (ValidationError, TypeError) as error:
                reason = complaint(error, Found, "row") if isinstance(error, ValidationError) else str(error)
                raise MitsonarError(f"{path} is damaged ({reason}): remove it, and the row is evaluated again") from None
        return rows

    def report(self) -> JsonObject:
        """Write the tables and figures of the rows that are done, and return the content of ``table.json``."""
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


def quick_data(data: Recipe) -> JsonObject:
    """Return the changes of a data set recipe by a quick effort: few sequences over two small worlds, few rays."""
    coarse: JsonObject = {"channel.rays": 500} if data.channel else {"sonar.rays_per_beam": 60}
    sequences = 6 if data.flight.pings > 2 else 12
    return {**coarse, "world": QUICK_WORLDS[data.world["family"]], "scenes": [{"count": 2, "sequences": sequences}]}


def unseen_recipe(data: Recipe, learnt: int, wanted: int | None, frames: int) -> tuple[Recipe, int]:
    """Return the recipe of unseen scenes, and how many of its sequences are made.

    Args:
        data: recipe of the training data.
        learnt: number of training sequences.
        wanted: number of sequences, each with the frames of one sample; None: a part of ``learnt``.
        frames: frames of a sample.
    """
    fields = data.model_dump(mode="json") | {"name": f"{data.name}-unseen", "seed": (data.seed + UNSEEN_SEED) % 2**31}
    if wanted is None:
        few, most = UNSEEN_SEQUENCES
        return recipe_from(fields), min(data.sequences, max(few, min(most, learnt // 20)))
    many = -(-wanted // data.sequences)
    fields["flight"] |= {"pings": frames}
    fields["scenes"] = [group | {"sequences": many * group["sequences"]} for group in fields["scenes"]]
    return recipe_from(fields), wanted


def _progress(watch: Watch, what: str) -> Callable[[int], Advance]:
    """Return the argument ``begin`` of :func:`~mitsonar.training.evaluation.evaluate`."""
    return lambda total: watch.begin(f"evaluating {what}", total, "pairs")


def _scores(report: JsonObject) -> dict[str, RowScore]:
    """Return the errors of an evaluation, by noise."""
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
    """Return the scale of a finished training, as its folder states it.

    Raises:
        MitsonarError: the folder is damaged.
    """
    try:
        return _scale(checkpoint, recipe, RunDirectory.open(folder, TRAINING).notes)
    except (KeyError, TypeError, ZeroDivisionError, ValidationError) as error:
        raise MitsonarError(f"{folder} is damaged ({error}): remove it, and the row is trained again") from None


def _scale(checkpoint: Checkpoint, recipe: TrainingRecipe, run: JsonObject) -> Reached:
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
        split=split_name(recipe.split),
        date=date.today().isoformat(),
    )


def _processor() -> str:
    """Return the name of the processor of this machine."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
