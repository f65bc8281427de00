"""Reproduction of a table of Almanza-Medina: make its data at a scale, train and evaluate its rows, save all on disk."""

from __future__ import annotations

import io
import json
import math
import platform
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field
from datetime import date
from functools import cache
from importlib.resources import files
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from mitsonar.config.data import Recipe, load_recipe, recipe_from
from mitsonar.config.training import TrainingRecipe, TrainOptions, load_training_recipe
from mitsonar.datasets.make import make_dataset
from mitsonar.datasets.sample_index import split_for
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError, argument, suggest_names, validation_message
from mitsonar.io.files import read_json, write_atomic, write_json
from mitsonar.io.runs import RunDirectory, RunKind, check_same_settings, plain_json, versions
from mitsonar.io.storage import Storage
from mitsonar.motion.errors import AXES, Axis
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.training.data import JsonObject
from mitsonar.training.evaluate import evaluate
from mitsonar.training.journal import TRAINING, TrainingReport
from mitsonar.training.run import train

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "HEIGHT",
    "NOISES",
    "DocumentTable",
    "Effort",
    "Errors",
    "Found",
    "Part",
    "Reached",
    "RowScore",
    "ScriptedTable",
    "Strict",
    "TableRow",
    "Watch",
    "contents",
    "format_errors",
    "load_scripted",
    "load_tables",
    "plain_table",
    "reproduce",
    "rows_named",
    "split_name",
    "table_figure",
    "table_lines",
    "table_named",
    "tables_with",
    "unseen_recipe",
]


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
        scale: share of the recipe's sequences that are made, 0..1.
        minutes: largest duration of training [min]; None: until the epochs of the recipe are done.
        batch: samples per step; the learning rate is scaled by the square root. None: those of the recipe.
        changes: keys of the training recipes to change, with dots between the levels. Keys that a table or a row sets are
            not changed.
        data: keys of the data set recipes to change, in addition to those that a training recipe changes.
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
            raise MitsonarError(f"scale, the share of data that is made, must be above 0 and at most 1: got {self.scale:g}")
        if self.minutes is not None and not (self.minutes > 0 and math.isfinite(self.minutes)):
            raise MitsonarError(f"{argument('minutes')} of training of a row must be above 0: got {self.minutes:g}")
        if self.batch is not None and self.batch < 1:
            raise MitsonarError(f"batch must be at least 1: got {self.batch}")

    def recipe(self, name: str, row_set: JsonObject | None = None) -> TrainingRecipe:
        """Load the training recipe of that name, with the changes of this effort and then those of a table and its row.

        Raises:
            MitsonarError: an unknown key, or a value outside its limits.
        """
        recipe = load_training_recipe(name, {**self.changes, **(row_set or {}), **(QUICK_TRAINING if self.quick else {})})
        quick_changes = quick_data(load_recipe(recipe.data)) if self.quick else {}
        if quick_changes or self.data:
            recipe = recipe.replace(data_changes={**recipe.data_changes, **self.data, **quick_changes})
        if self.batch is None or self.batch == recipe.batch:
            return recipe
        rate = recipe.optimiser.rate * math.sqrt(self.batch / recipe.batch)
        return recipe.replace(batch=self.batch, optimiser=recipe.optimiser.model_dump() | {"rate": rate})

    def sentence(self) -> str:
        """Describe the effort for people."""
        if self.quick:
            return "two steps on a few coarse frames: these errors are meaningless"
        parts = [f"scale {self.scale:g} of the recipes' data"]
        parts.append("all epochs" if self.minutes is None else f"at most {self.minutes:g} minutes of training a row")
        if self.batch is not None:
            parts.append(f"batches of {self.batch}, the rate scaled by the square root")
        if self.changes:
            keys = ", ".join(f"{key} {json.dumps(value)}" for key, value in self.changes.items())
            parts.append(f"recipes changed, except for keys that a row sets: {keys}")
        if self.data:
            keys = ", ".join(f"{key} {json.dumps(value)}" for key, value in self.data.items())
            parts.append(f"data changed: {keys}")
        return "; ".join(parts)


Advance = Callable[[int], None]
"""Reports progress; called with the number of parts newly done."""

TrainingCallbacks = tuple[Callable[[TrainingReport], None], Callable[[], bool]]
"""Functions called after each step of a training: one takes the progress report, the other returns whether to stop."""


class Watch(Protocol):
    """Shows the progress of a reproduction."""

    def begin(self, what: str, total: int, unit: str) -> Advance:
        """Show that work of ``total`` parts begins, and return the function that reports its progress."""

    def training(self, what: str) -> AbstractContextManager[TrainingCallbacks]:
        """Return the context of the training of one network."""


class SilentWatch:
    """A watch that shows nothing."""

    def begin(self, what: str, total: int, unit: str) -> Advance:
        """Return a report that does nothing."""
        return lambda done: None

    @contextmanager
    def training(self, what: str) -> Iterator[TrainingCallbacks]:
        """Yield a report that does nothing, and a function that never stops training."""
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

    ``out`` holds ``table.md`` and ``table.json``, which are replaced after each row, and ``table-NUMBER.png`` of the tables
    with that row. ``data/`` holds one training data set for all rows with the same data, and one of unseen scenes.
    ``runs/`` holds one training per row, and ``rows/`` the result of each row. Several tables may share a folder: a row of
    both is trained once.

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
        MitsonarError: a name is unknown, or the folder has other files or was begun with another effort or recipe.
    """
    document_table = table_named(table)
    recipes = {
        row.name: effort.recipe(row.recipe, {**document_table.set, **row.set}) for row in rows_named(document_table, rows)
    }
    data = {name: load_recipe(recipe.data, recipe.data_changes) for name, recipe in recipes.items()}
    crew = Crew(workers, accelerator, devices, watch or SilentWatch())
    with Storage(out).locked():
        builder = TableBuilder(RunDirectory.begin(out, TABLES, asdict(effort), resume=True), effort)
        builder.add_table(table, recipes)
        report = builder.report([table])
        for name, recipe in recipes.items():
            if name not in builder.results():
                builder.make_row(name, recipe, data[name], crew)
                report = report if effort.quick else builder.report(tables_with(name))
        return builder.report([table]) if effort.quick else report


@dataclass(frozen=True)
class Crew:
    """Means of the work, which have no effect on the results: see :func:`reproduce`."""

    workers: int
    accelerator: str
    devices: str | int
    watch: Watch


@dataclass(frozen=True)
class TableBuilder:
    """The folder of a reproduction.

    Attributes:
        run: the requested tables, and the recipes of their rows.
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
        """Return the numbers of the requested tables."""
        return self.run.notes.get("tables") or []

    @property
    def recipes(self) -> JsonObject:
        """Return the recipes of the requested rows, keyed by the names of the rows."""
        return self.run.notes.get("recipes") or {}

    def add_table(self, table: str, recipes: dict[str, TrainingRecipe]) -> None:
        """Store a table and the recipes of its rows.

        Raises:
            MitsonarError: a row was begun with another recipe.
        """
        self.run.start(tables=[], recipes={})
        stored, requested = self.recipes, plain_json({name: recipe.plain() for name, recipe in recipes.items()})
        shared = {name: recipe for name, recipe in requested.items() if name in stored}
        check_same_settings(self.folder, {"row": {name: stored[name] for name in shared}}, {"row": shared})
        tables = [name for name in load_tables() if name == table or name in self.tables]
        self.run.note(tables=tables, recipes=stored | requested)

    def make_row(self, name: str, recipe: TrainingRecipe, data: Recipe, crew: Crew) -> None:
        """Make the data of one row, train and evaluate it. Results that are already on disk are reused."""
        document_table = table_named(tables_with(name)[0])
        scale = 1.0 if self.effort.quick else self.effort.scale
        sequences = max(1, round(scale * data.sequences))
        unseen_sequences = None if self.effort.quick else document_table.unseen
        unseen_data, unseen_count = unseen_recipe(data, sequences, unseen_sequences, recipe.input.frames)
        if unseen_sequences is not None:
            unseen_count = max(min(unseen_count, UNSEEN_SEQUENCES[0]), round(self.effort.scale * unseen_count))
        seen = self._make_data(data, sequences, crew)
        gain = DataStore.open(seen).about.get("gain")  # both data sets are of one sonar
        unseen = self._make_data(
            unseen_data if gain is None else unseen_data.model_copy(update={"gain": gain}), unseen_count, crew
        )
        checkpoint = self._train(name, recipe, seen, crew)
        noises = list(document_table.noises)[: 1 if self.effort.quick else None]
        parts = {"validation": (seen, "validation"), "unseen": (unseen, "all")}
        if split_for(recipe.resolved_split, data).test:
            parts["test"] = seen, "test"
        scores = {
            key: _scores(evaluate(checkpoint, url, noise=noises, part=part, begin=_progress(crew.watch, f"{name}, {key}")))
            for key, (url, part) in parts.items()
        }
        row_result = Found(recipe=name, **scores, reached=_reached(checkpoint, recipe, self._run(name)))
        (self.folder / "rows").mkdir(exist_ok=True)
        write_json(self.folder / "rows" / f"{name}.json", row_result.model_dump(mode="json"))

    def _make_data(self, data: Recipe, sequences: int, crew: Crew) -> Path:
        """Make a data set, or complete it. Rows with the same data recipe share it."""
        path = self.folder / "data" / f"{data.name}-{data.digest()[:8]}.zarr"
        advance: list[Advance] = []

        def begin(frames: int, done: int) -> None:
            advance.append(crew.watch.begin(f"rendering {path.stem}", frames, "frames"))
            advance[0](done)

        make_dataset(
            data, str(path), sequences=sequences, workers=crew.workers, begun=begin, progress=lambda more: advance[0](more)
        )
        return path

    def _run(self, name: str) -> Path:
        return self.folder / "runs" / name

    def _train(self, name: str, recipe: TrainingRecipe, data: Path, crew: Crew) -> Checkpoint:
        """Train the network of a row, or resume its training."""
        run = self._run(name)
        options = TrainOptions(
            recipe,
            data,
            run,
            minutes=self.effort.minutes,
            resume=run.exists(),
            accelerator=crew.accelerator,
            devices=crew.devices,
        )
        with crew.watch.training(name) as (progress, stop):
            return train(options, progress=progress, stop=stop)

    def results(self) -> dict[str, Found]:
        """Load the results of the rows that are done.

        Raises:
            MitsonarError: a file is damaged.
        """
        rows = {}
        for path in sorted((self.folder / "rows").glob("*.json")):
            try:
                rows[path.stem] = Found(**read_json(path))
            except (ValidationError, TypeError) as error:
                reason = validation_message(error, Found, "row") if isinstance(error, ValidationError) else str(error)
                raise MitsonarError(f"{path} is damaged ({reason}): remove it, and the row is evaluated again") from None
        return rows

    def report(self, drawn: Collection[str]) -> JsonObject:
        """Write all tables, and figures of the tables ``drawn``, of the rows that are done; return ``table.json``."""
        results, version = self.results(), versions(("mitsonar",))["mitsonar"]
        tables = [table_named(name) for name in self.tables]
        lines = [f"`mitsonar reproduce`, mitsonar {version}: {self.effort.sentence()}."]
        for table in tables:
            lines += ["", *table_lines(table, results)]
            if table.name not in drawn:
                continue
            figure = table_figure(
                table, results, title=f"{table.kind} {table.name}, {table.title}; {self.effort.sentence()}"
            )
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=80)
            write_atomic(self.folder / f"table-{table.name}.png", buffer.getvalue())
        report = {"version": version, **self.run.settings, "recipes": self.recipes}
        report["tables"] = {table.name: plain_table(table, results) for table in tables}
        write_atomic(self.folder / "table.md", ("\n".join(lines) + "\n").encode())
        write_json(self.folder / "table.json", report)
        return report


def quick_data(data: Recipe) -> JsonObject:
    """Return the changes of a data set recipe by a quick effort: few sequences over two small worlds, few rays."""
    coarse: JsonObject = {"channel.rays": 500} if data.channel else {"sonar.rays_per_beam": 60}
    sequences = 6 if data.flight.pings > 2 else 12
    return {**coarse, "world": QUICK_WORLDS[data.world["family"]], "scenes": [{"count": 2, "sequences": sequences}]}


def unseen_recipe(data: Recipe, training_sequences: int, sequences: int | None, frames: int) -> tuple[Recipe, int]:
    """Return the recipe of unseen scenes, and the number of its sequences to make.

    Args:
        data: recipe of the training data.
        training_sequences: number of training sequences.
        sequences: number of sequences, each with the frames of one sample; None: a share of ``training_sequences``.
        frames: frames of a sample.
    """
    fields = data.model_dump(mode="json") | {"name": f"{data.name}-unseen", "seed": (data.seed + UNSEEN_SEED) % 2**31}
    if sequences is None:
        fewest, most = UNSEEN_SEQUENCES
        return recipe_from(fields), min(data.sequences, max(fewest, min(most, training_sequences // 20)))
    repeats = -(-sequences // data.sequences)
    fields["flight"] |= {"pings": frames}
    fields["scenes"] = [group | {"sequences": repeats * group["sequences"]} for group in fields["scenes"]]
    return recipe_from(fields), sequences


def _progress(watch: Watch, what: str) -> Callable[[int], Advance]:
    """Return the argument ``begin`` of :func:`~mitsonar.training.evaluate.evaluate`."""
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
    """Return the scale of a finished training from its folder.

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


# ---------------- Tables of trained networks as Almanza-Medina prints them


HIGHEST_NOISE: Literal["0.0274,0.0062,0.0274"] = "0.0274,0.0062,0.0274"
"""A fifth of the high noise: what echoes of five times the gain have. The baseline of Almanza-Medina hardly feels the high
noise (table 3.8: 8.39 and 8.16 mm), and ``ecc`` hardly feels this (0.98 and 1.02 mm; 1.89 with high noise)."""

NOISES = {"none": "noiseless", "high": "high noise", HIGHEST_NOISE: "high noise, 5 times the gain"}
"""Noise of the validation samples, and the heading of its half of a table."""

CHAPTERS = ("chapter3", "chapter4", "chapter5")
"""Files of tables."""

HEIGHT = Axis("height", "% of the interval", 1.0)
"""Axis of figures of heights. Errors are relative: one interval of heights is 26 times the other."""

Errors = Annotated[tuple[float, ...], Field(min_length=1, max_length=3)]
"""Sideways [mm], forward [mm], and yaw [deg] where the vehicle turns; or height [mm]."""


class Strict(BaseModel):
    """An immutable model that rejects unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TableRow(Strict):
    """One network of a table.

    Attributes:
        approach: its name in Almanza-Medina.
        recipe: name of the training recipe.
        set: keys of the recipe that this row changes, with dots between the levels. They override those of an effort.
        name: of the row; default: name of its recipe. The same network has the same name in all tables.
        none: RMSE without noise, if it is printed and legible.
        high: RMSE with high noise, if it is printed and legible.
        ms: duration of one estimate [ms], if it is printed and legible.
        interval: width of the interval of training heights [m]; only of networks that estimate heights.
    """

    approach: str
    recipe: str
    set: JsonObject = Field(default_factory=dict)
    name: str
    none: Errors | None = None
    high: Errors | None = None
    ms: float | None = None
    interval: float | None = Field(None, gt=0)

    @model_validator(mode="before")
    @classmethod
    def _default_name(cls, fields: object) -> object:
        return {"name": fields.get("recipe"), **fields} if isinstance(fields, dict) else fields

    @property
    def printed(self) -> dict[str, Errors]:
        """Return the errors that Almanza-Medina prints, by noise."""
        both = {"none": self.none, "high": self.high}
        return {noise: errors for noise, errors in both.items() if errors is not None}

    def drawn(self, errors: tuple[float, ...]) -> tuple[float, ...]:
        """Return an RMSE as a figure shows it: heights in percent of their interval."""
        return errors if self.interval is None else (errors[0] / 10 / self.interval,)

    def format_errors(self, errors: tuple[float, ...] | None) -> str:
        """Format an RMSE for people: heights in cm and in percent of their interval."""
        if errors is None:
            return "-"
        if self.interval is None:
            return format_errors(errors)
        return f"{errors[0] / 10:.2f} cm ({errors[0] / 10 / self.interval:.2f} %)"


class DocumentTable(Strict):
    """One table of Almanza-Medina.

    Attributes:
        name: its number.
        title: property in which its rows differ.
        figure: whether Almanza-Medina draws it as a figure.
        section: of Almanza-Medina that describes it.
        note: remark for readers who compare.
        differs: how validation and simulation of Almanza-Medina differ from ours.
        largest: the largest motions of its data, which are uniform within plus and minus these; for heights half the
            interval [%].
        set: keys of the recipes that all rows change.
        noises: noise of the samples that all rows are scored on.
        unseen: number of sequences of unseen scenes, each with the pings of one sample; default: a part of the number of
            training sequences.
        rows: in the order of Almanza-Medina.
    """

    name: str
    title: str
    figure: bool = False
    section: str
    note: str = ""
    differs: str = (
        "Almanza-Medina selected and validated networks on the same pairs (8,000 in most tables). Scenes, gain and windows "
        "there differ from ours."
    )
    largest: Errors = (20.0, 20.0, 0.45)
    set: JsonObject = Field(default_factory=dict)
    noises: list[Literal["none", "high", "0.0274,0.0062,0.0274"]] = ["none", "high", HIGHEST_NOISE]
    unseen: int | None = Field(None, ge=1)
    rows: list[TableRow] = Field(min_length=1)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Return the axes that its rows estimate."""
        return (HEIGHT,) if len(self.largest) == 1 else tuple(AXES[: len(self.largest)])

    @property
    def kind(self) -> str:
        """Return ``Table``, or ``Figure``."""
        return "Figure" if self.figure else "Table"

    @property
    def no_motion(self) -> tuple[float, ...]:
        """Return the RMSE of always estimating no motion."""
        return tuple(end / np.sqrt(3) for end in self.largest)


class ScriptedTable(Strict):
    """A table or figure of Almanza-Medina that a script of ``benchmarks/`` makes: of methods, paths, times.

    Attributes:
        name: its number, of a figure with ``figure-`` before it.
        title: its content.
        section: of Almanza-Medina that describes it.
        command: that makes it, from the root of the sources.
        printed: values that Almanza-Medina prints, row by row, as text.
        results: page and heading of our results.
    """

    name: str
    title: str
    section: str
    command: str
    printed: dict[str, str] = Field(default_factory=dict)
    results: str


@cache
def load_tables() -> dict[str, DocumentTable]:
    """Load all tables, by number."""
    folder = files("mitsonar.recipes") / "tables"
    texts = [(folder / f"{chapter}.yaml").read_text(encoding="utf-8") for chapter in CHAPTERS]
    return {name: DocumentTable(name=name, **fields) for text in texts for name, fields in yaml.safe_load(text).items()}


@cache
def load_scripted() -> dict[str, ScriptedTable]:
    """Load the tables and figures that scripts make, by number."""
    text = (files("mitsonar.recipes") / "tables" / "scripted.yaml").read_text(encoding="utf-8")
    return {name: ScriptedTable(name=name, **fields) for name, fields in yaml.safe_load(text).items()}


def contents() -> list[DocumentTable | ScriptedTable]:
    """List all tables and figures that can be reproduced, in the order of their chapters and numbers."""
    tables: list[DocumentTable | ScriptedTable] = [*load_tables().values(), *load_scripted().values()]
    return sorted(tables, key=lambda table: [int(number) for number in table.name.removeprefix("figure-").split(".")])


def table_named(name: str) -> DocumentTable:
    """Return the table of that number.

    Raises:
        MitsonarError: no such table, or one that a script makes.
    """
    tables, scripted = load_tables(), load_scripted()
    if name in scripted:
        raise MitsonarError(f"{name} is made by a script of mitsonar's sources: run there  {scripted[name].command}")
    if name not in tables:
        raise MitsonarError(f"no table {name!r}: {suggest_names(name, [one.name for one in contents()])}")
    return tables[name]


def rows_named(table: DocumentTable, names: list[str] | None = None) -> list[TableRow]:
    """Return the named rows of a table, in the order of the table; all rows if none is named.

    Raises:
        MitsonarError: no such row.
    """
    known = [row.name for row in table.rows]
    for name in names or []:
        if name not in known:
            raise MitsonarError(f"table {table.name} has no row {name!r}: {suggest_names(name, known)}")
    return [row for row in table.rows if not names or row.name in names]


def tables_with(name: str) -> list[str]:
    """Return the numbers of the tables that have a row of this name."""
    return [table.name for table in load_tables().values() if any(row.name == name for row in table.rows)]


def format_errors(errors: tuple[float, ...]) -> str:
    """Format the RMSE of each axis for people."""
    named = zip(errors, AXES, strict=False)
    return " / ".join(f"{value:.3f}" if axis.unit == "deg" else f"{value:.2f}" for value, axis in named)


def split_name(split: str | JsonObject) -> str:
    """Return the unit of a split: ``sample``, ``sequence`` or ``scene``."""
    return split if isinstance(split, str) else str(split["by"])


# ---------------- Our result of a row: its errors, and the scale of its training


Part = Literal["validation", "test", "unseen"]
"""Samples that a row is scored on."""


class RowScore(Strict):
    """Errors on some samples: sideways [mm], forward [mm], and yaw [deg] if the network estimates it; or height [mm].

    Attributes:
        pairs: number of pairs.
        scenes: number of scenes that they are of.
        rmse: root mean square error.
        low: lower end of its 95 % interval.
        high: upper end of its 95 % interval.
        slope: of the estimates over the true motions, without unit; null where nothing moved.
        zero: RMSE of always estimating no motion.
        ms: processor time of one estimate on one core [ms], as an evaluation measures it.
    """

    pairs: int
    scenes: int
    rmse: Errors
    low: Errors
    high: Errors
    slope: tuple[float | None, ...]
    zero: Errors
    ms: float | None = None


class Reached(Strict):
    """The scale at which a row was reached.

    Attributes:
        training_pairs: number of training samples.
        pairs_seen: samples seen in training; a sample counts each time that it is seen.
        pairs_best: samples seen when the evaluated network was saved, the best by validation.
        epochs: pairs_seen over training_pairs.
        epochs_asked: number of epochs in the recipe.
        minutes: duration of training [min].
        device: device of training.
        machine: processor of that machine.
        threads: number of threads.
        batch: samples of one step.
        rate: initial learning rate.
        precision: of the training.
        split: how validation samples are separated from training: ``sample``, ``sequence`` or ``scene``.
        date: day on which training ended.
    """

    training_pairs: int
    pairs_seen: int
    pairs_best: int
    epochs: float
    epochs_asked: float
    minutes: float
    device: str
    machine: str
    threads: int
    batch: int
    rate: float
    precision: str
    split: str
    date: str


class Found(Strict):
    """Errors of one row, and the scale at which they were reached.

    Attributes:
        recipe: name of the row.
        validation: errors by noise, on the part of the data set that is not used for training.
        test: errors by noise, on the sequences excluded from training and validation; empty if there are none.
        unseen: errors by noise, on the scenes of a data set with another seed.
        reached: scale of the training.
    """

    recipe: str
    validation: dict[str, RowScore]
    test: dict[str, RowScore] = Field(default_factory=dict)
    unseen: dict[str, RowScore]
    reached: Reached

    def score(self, part: Part, noise: str) -> RowScore | None:
        """Return the errors on one part with one noise; None where there are no such samples."""
        scores: dict[str, RowScore] = getattr(self, part)
        return scores.get(noise)


# ---------------- Tables of Almanza-Medina with our results: as Markdown, for programs, and as a figure


NOT_YET = "not trained yet"

SPLITS = {
    "sequence": "one pair a sequence of those kept from training, of the same scenes",
    "scene": "one pair a sequence of those kept from training, of other scenes",
    "sample": "pairs dealt out one by one, as in Almanza-Medina (3.2.1, 4.2.2), one a sequence; training used pairs of the "
    "same sequences, with the same motion and a frame in common",
}
"""By the split of a recipe: how validation samples are separated from training."""

PARTS: dict[Part, str] = {"validation": "validation", "test": "other sequences", "unseen": "unseen scenes"}

GAIN = (
    " *high noise*: here the mean echo is 0.44 of the scale of this noise. The gain of Almanza-Medina is not known, and "
    "must have been several times larger: the baseline there hardly feels the noise (table 3.8: 8.39 and 8.16 mm). With 5 "
    "times the gain ours does not either: 0.98 and 1.02 mm."
)
"""Note on columns with high noise."""

OF_PARTS: dict[Part, str] = {
    "validation": "the network that a training keeps is the best on them.",
    "test": "*other sequences*: one pair a sequence of those kept from training and validation, of the same scenes.",
    "unseen": "*unseen scenes*: one pair a sequence of a data set with another seed, whose scenes no network has seen.",
}
"""Note on each."""

REACHED: dict[str, Callable[[Found], str]] = {
    "pairs to learn from": lambda result: f"{result.reached.training_pairs:,}",
    "pairs seen (best after)": lambda result: f"{result.reached.pairs_seen:,} ({result.reached.pairs_best:,})",
    "epochs": lambda result: f"{result.reached.epochs:.2f} of {result.reached.epochs_asked:.3g}",
    "minutes": lambda result: f"{result.reached.minutes:.1f}",
    "batch, rate, precision": lambda result: (
        f"{result.reached.batch}, {result.reached.rate:.3g}, {result.reached.precision}"
    ),
    "scored pairs: validation, unseen (scenes)": lambda result: (
        f"{result.validation['none'].pairs:,}, {result.unseen['none'].pairs:,} ({result.unseen['none'].scenes})"
    ),
    "scored pairs: other sequences": lambda result: f"{result.test['none'].pairs:,}" if result.test else "-",
    "on": lambda result: f"{result.reached.device}; {result.reached.machine}, threads: {result.reached.threads}",
    "date": lambda result: result.reached.date,
}
"""Columns that show the scale at which a row was reached."""


def table_lines(table: DocumentTable, results: Mapping[str, Found]) -> list[str]:
    """Format a table as Markdown. Rows that are not in ``results`` are shown as not trained yet."""
    first = next((results[row.name] for row in table.rows if row.name in results), None)
    split = first.reached.split if first else split_name(table.set.get("split", "sequence"))
    return [
        f"## {table.kind} {table.name}: {table.title} (Almanza-Medina, {table.section})",
        "",
        *_framed(_error_cells(table, results, first)),
        "",
        *([f"Note: {table.note}.", ""] if table.note else []),
        f"*validation* (split: {split}): {SPLITS[split]}; {' '.join(OF_PARTS[part] for part in _parts(table, results))} "
        f"{table.differs}{GAIN if 'high' in table.noises else ''}",
        "",
        "The scale at which each figure was reached:",
        "",
        *_framed(_reached_cells(table, results)),
    ]


def _parts(table: DocumentTable, results: Mapping[str, Found]) -> dict[Part, str]:
    """Return the parts that rows are scored on, with their headings; other sequences only if a split has any."""
    tested = any(row.name in results and results[row.name].test for row in table.rows)
    return {part: heading for part, heading in PARTS.items() if part != "test" or tested}


def _noises(table: DocumentTable, results: Mapping[str, Found]) -> list[str]:
    """Return the noises that rows are scored with; one that is not printed only if a row has it."""
    return [
        noise
        for noise in table.noises
        if noise != HIGHEST_NOISE or any(noise in result.validation for result in results.values())
    ]


def _error_cells(table: DocumentTable, results: Mapping[str, Found], first: Found | None) -> list[list[str]]:
    """Return the cells of errors and times, Almanza-Medina's and ours."""
    units = " / ".join(f"{axis.unit} {axis.name}" for axis in table.axes)
    parts = _parts(table, results)
    heights, timed = table.axes == (HEIGHT,), any(row.ms for row in table.rows)
    head, zero = ["RMSE of heights" if heights else f"RMSE, {units}"], ["*always answering no motion*"]
    for noise in _noises(table, results):
        printed = noise != HIGHEST_NOISE
        head += [f"Almanza-Medina, {NOISES[noise]}"] * printed + [f"{part}, {NOISES[noise]}" for part in parts.values()]
        scores = [first.score(part, noise) if first else None for part in parts]
        zero += [format_errors(table.no_motion)] * printed
        zero += ["-" if score is None else format_errors(score.zero) for score in scores]
    cells = [head] if heights else [head, zero]
    for row in table.rows:
        result = results.get(row.name)
        cells.append([row.approach])
        for noise in _noises(table, results):
            scores = [result.score(part, noise) if result else None for part in parts]
            our_cells = [
                row.format_errors(score.rmse) if score is not None else "-" if result else NOT_YET for score in scores
            ]
            cells[-1] += [row.format_errors(row.printed.get(noise))] * (noise != HIGHEST_NOISE) + our_cells
    if timed:
        head += ["Almanza-Medina, ms", "here, ms"]
        for row, line in zip(table.rows, cells[-len(table.rows) :], strict=True):
            score = results[row.name].score("unseen", table.noises[0]) if row.name in results else None
            ms = None if score is None else score.ms
            line += ["-" if value is None else f"{value:.3g}" for value in (row.ms, ms)]
        zero += ["0", "0"]
    return cells


def _reached_cells(table: DocumentTable, results: Mapping[str, Found]) -> list[list[str]]:
    """Return the cells of the scale at which each row was reached."""
    cells = [["row", "recipe", "also in", *REACHED]]
    for row in table.rows:
        result = results.get(row.name)
        others = ", ".join(name for name in tables_with(row.name) if name != table.name) or "-"
        recipe = row.recipe + "".join(f", {key}: {_short(value)}" for key, value in row.set.items())
        scale = [text(result) for text in REACHED.values()] if result else [NOT_YET, *["-"] * (len(REACHED) - 1)]
        cells.append([row.approach, recipe, others, *scale])
    return cells


def _short(value: object) -> str:
    return json.dumps(value).replace('"', "")


def plain_table(table: DocumentTable, results: Mapping[str, Found]) -> JsonObject:
    """Return a table for programs."""
    rows = []
    for row in table.rows:
        result = results.get(row.name)
        rows.append(
            {
                "approach": row.approach,
                "recipe": row.recipe,
                "set": row.set,
                "name": row.name,
                "also_in": [name for name in tables_with(row.name) if name != table.name],
                "thesis": {noise: list(errors) for noise, errors in row.printed.items()},
                "thesis_ms": row.ms,
                "interval_m": row.interval,
                "status": "done" if result else NOT_YET,
                "ours": result.model_dump(mode="json", exclude={"recipe"}) if result else None,
            }
        )
    facts = {"title": table.title, "section": table.section, "note": table.note, "units": [axis.unit for axis in table.axes]}
    return {**facts, "no_motion": list(table.no_motion), "rows": rows}


def _framed(rows: list[list[str]]) -> list[str]:
    """Format cells as a Markdown table, whose head is the first row."""
    width = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["| " + " | ".join(cell.ljust(size) for cell, size in zip(row, width, strict=True)) + " |" for row in rows]
    return [lines[0], "|" + "|".join("-" * (size + 2) for size in width) + "|", *lines[1:]]


def table_figure(table: DocumentTable, results: Mapping[str, Found], *, title: str = "") -> Figure:
    """Draw bars of Almanza-Medina, validation, other sequences and unseen scenes.

    Whiskers are 95 % intervals. The dotted line is the RMSE of always estimating no motion.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 2.6 + 1.1 * len(table.rows)), layout="constrained")
    figure.suptitle("\n".join(wrap(title or f"{table.kind} {table.name}: {table.title}", 150)), fontsize="medium")
    noises = _noises(table, results)
    grid = figure.subplots(len(noises), len(table.axes), sharey=True, squeeze=False)
    position = {row.name: k for k, row in enumerate(table.rows) if row.name in results}
    handles: dict[str, Any] = {}
    shown = _parts(table, results)
    bars: dict[Part, tuple[float, str]] = {"validation": (-0.08, "C0"), "test": (0.12, "C2"), "unseen": (0.32, "C1")}
    for panels, noise in zip(grid, noises, strict=True):
        for k, (panel, axis) in enumerate(zip(panels, table.axes, strict=True)):
            printed = [row.drawn(row.printed[noise])[k] if noise in row.printed else np.nan for row in table.rows]
            handles["Almanza-Medina"] = panel.barh(np.arange(len(printed)) - 0.28, printed, 0.18, color="0.6")
            for part, heading in shown.items():
                offset, colour = bars[part]
                row_scores = [(row, results[row.name].score(part, noise)) for row in table.rows if row.name in results]
                scores = [(row, score) for row, score in row_scores if score is not None]
                ends = np.array([[row.drawn(e)[k] for e in (s.low, s.rmse, s.high)] for row, s in scores]).reshape(-1, 3)
                low, rmse, high = ends.T
                whiskers = {"xerr": np.maximum([rmse - low, high - rmse], 0), "error_kw": {"linewidth": 0.8}}
                positions = [position[row.name] + offset for row, _ in scores]
                handles[heading] = panel.barh(positions, rmse, 0.18, color=colour, **(whiskers if scores else {}))
            handles["no motion"] = panel.axvline(table.no_motion[k], color="black", linestyle=":")
            panel.set(title=f"{NOISES[noise]}: {axis.name}", xlabel=f"RMSE ({axis.unit})")
            panel.set_yticks(range(len(printed)), [_label(row, results.get(row.name)) for row in table.rows])
    grid[0, 0].invert_yaxis()
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
    return figure


def _label(row: TableRow, result: Found | None) -> str:
    """Return the name of a row and the scale at which it was reached."""
    if result is None:
        return f"{row.approach}\n{NOT_YET}"
    return (
        f"{row.approach}\n{result.reached.training_pairs:,} pairs x {result.reached.epochs:.2g}, "
        f"{result.reached.minutes:.3g} min"
    )
