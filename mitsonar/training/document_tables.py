"""The thesis's tables of trained networks, and what was reached here beside what it prints: as Markdown and as a figure."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.motion.motion_errors import AXES, Axis

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "NOISES",
    "DocumentTable",
    "Found",
    "Reached",
    "RowScore",
    "TableRow",
    "errors_said",
    "load_tables",
    "plain_table",
    "rows_named",
    "table_figure",
    "table_lines",
    "table_named",
    "tables_with",
]

NOISES = {"none": "noiseless", "high": "high noise"}
"""Of what validation is on: the halves of a table, where the thesis prints both."""

CHAPTERS = ("chapter3", "chapter4", "chapter5")
"""Files of tables."""

HEIGHT = Axis("height", "% of the interval", 1.0)
"""What tables of heights draw: one interval is 26 times the other."""

Errors = Annotated[tuple[float, ...], Field(min_length=1, max_length=3)]
"""Sideways [mm], forward [mm], and yaw [deg] where the vehicle turns; or height [mm]."""

Part = Literal["validation", "unseen"]

# ---------------------------------------------------------------- what the thesis prints


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TableRow(_Part):
    """One network of a table.

    Attributes:
        approach: what the thesis calls it.
        recipe: name of the training recipe.
        set: keys of it that this row changes, dots between the levels; they count over those of an effort.
        name: of the row, default: its recipe's; rows of several tables that are the same network have the same name.
        none: RMSE without noise, where it is printed and can be read.
        high: RMSE with high noise, likewise.
        ms: of an estimate, likewise.
        interval: over which the heights of training lie [m], of a network that tells heights.
    """

    approach: str
    recipe: str
    set: dict[str, Any] = Field(default_factory=dict)
    name: str
    none: Errors | None = None
    high: Errors | None = None
    ms: float | None = None
    interval: float | None = Field(None, gt=0)

    @model_validator(mode="before")
    @classmethod
    def _named(cls, fields: Any) -> Any:
        return {"name": fields.get("recipe"), **fields} if isinstance(fields, dict) else fields

    @property
    def printed(self) -> dict[str, Errors]:
        """The errors that the thesis prints, by noise."""
        both = {"none": self.none, "high": self.high}
        return {noise: errors for noise, errors in both.items() if errors is not None}

    def drawn(self, errors: tuple[float, ...]) -> tuple[float, ...]:
        """RMSE as a figure shows it; heights in percent of their interval."""
        return errors if self.interval is None else (errors[0] / 10 / self.interval,)

    def said(self, errors: tuple[float, ...] | None) -> str:
        """RMSE for people; of heights in cm and as a part of their interval."""
        if errors is None:
            return "-"
        if self.interval is None:
            return errors_said(errors)
        return f"{errors[0] / 10:.2f} cm ({errors[0] / 10 / self.interval:.2f} %)"


class DocumentTable(_Part):
    """One table of the thesis.

    Attributes:
        name: its number.
        title: what its rows differ in.
        figure: whether the thesis draws it.
        section: where the thesis speaks of it.
        note: what a reader should know who compares.
        differs: in what the thesis's validation and simulation are not ours.
        largest: the largest motions of its data, even within plus and minus these; of heights half the interval [%].
        set: keys of the recipes that all rows change.
        noises: of the samples that all rows are judged by.
        unseen: sequences of unseen scenes, each of as few pings as a sample has; default: part of the training's.
        rows: in the thesis's order.
    """

    name: str
    title: str
    figure: bool = False
    section: str
    note: str = ""
    differs: str = (
        "The thesis chose and validated on the same pairs (8,000 in most tables); its scenes, gain and windows differ from "
        "ours."
    )
    largest: Errors = (20.0, 20.0, 0.45)
    set: dict[str, Any] = Field(default_factory=dict)
    noises: list[Literal["none", "high"]] = ["none", "high"]
    unseen: int | None = Field(None, ge=1)
    rows: list[TableRow] = Field(min_length=1)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Numbers that its rows estimate."""
        return (HEIGHT,) if len(self.largest) == 1 else tuple(AXES[: len(self.largest)])

    @property
    def kind(self) -> str:
        """``DocumentTable``, or ``Figure``."""
        return "Figure" if self.figure else "DocumentTable"

    @property
    def no_motion(self) -> tuple[float, ...]:
        """RMSE of always answering no motion."""
        return tuple(end / np.sqrt(3) for end in self.largest)


@cache
def load_tables() -> dict[str, DocumentTable]:
    """All tables by their number."""
    folder = files("mitsonar.recipes") / "tables"
    texts = [(folder / f"{chapter}.yaml").read_text(encoding="utf-8") for chapter in CHAPTERS]
    return {name: DocumentTable(name=name, **fields) for text in texts for name, fields in yaml.safe_load(text).items()}


def table_named(name: str) -> DocumentTable:
    """The table of that number.

    Raises:
        MitsonarError: no such table.
    """
    tables = load_tables()
    if name not in tables:
        raise MitsonarError(f"no table {name!r}: {nearest_names(name, tables)}")
    return tables[name]


def rows_named(table: DocumentTable, names: list[str] | None = None) -> list[TableRow]:
    """Rows of a table by their names, in the table's order; all where none is named.

    Raises:
        MitsonarError: no such row.
    """
    known = [row.name for row in table.rows]
    for name in names or []:
        if name not in known:
            raise MitsonarError(f"table {table.name} has no row {name!r}: {nearest_names(name, known)}")
    return [row for row in table.rows if not names or row.name in names]


def tables_with(name: str) -> list[str]:
    """The numbers of the tables that have a row of this name."""
    return [table.name for table in load_tables().values() if any(row.name == name for row in table.rows)]


# ---------------------------------------------------------------- what was reached here


class RowScore(_Part):
    """Errors on some samples, each sideways [mm], forward [mm], and yaw [deg] where the network estimates it.

    Attributes:
        pairs: how many.
        scenes: of how many scenes.
        rmse: root of the mean square.
        low: lower end of its 95 % interval,
        high: and upper end.
        slope: of the estimates over the true motions, no unit; null where nothing moved.
        zero: RMSE of always answering no motion.
        ms: processor time of an estimate on one core, as an evaluation takes it.
    """

    pairs: int
    scenes: int
    rmse: Errors
    low: Errors
    high: Errors
    slope: tuple[float | None, ...]
    zero: Errors
    ms: float | None = None


class Reached(_Part):
    """The scale at which a row was reached.

    Attributes:
        training_pairs: samples to learn from.
        pairs_seen: samples that were learnt from, each as often as it was,
        pairs_best: and until the network that is evaluated, the best by validation.
        epochs: pairs_seen over training_pairs.
        epochs_asked: of the recipe.
        minutes: of training.
        device: that it was trained on,
        machine: and the processor beside it,
        threads: with so many threads.
        batch: samples of a step.
        rate: of the optimiser at the start.
        precision: of the training.
        split: how validation was kept from training, ``sequence`` or ``scene``.
        date: of the end of training.
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


class Found(_Part):
    """What a row reached here.

    Attributes:
        recipe: the row's name.
        validation: errors by noise on the part of the data set that was kept from training.
        unseen: errors by noise on scenes that training never saw, from a data set of another seed.
        reached: with what.
    """

    recipe: str
    validation: dict[str, RowScore]
    unseen: dict[str, RowScore]
    reached: Reached

    def score(self, part: Part, noise: str) -> RowScore:
        """Errors on one part with one noise."""
        return (self.validation if part == "validation" else self.unseen)[noise]


# ---------------------------------------------------------------- side by side

NOT_YET = "not trained yet"

SPLITS = {
    "sequence": "one pair a sequence of those kept from training, of the same scenes, as in the thesis",
    "scene": "one pair a sequence of those kept from training, of other scenes",
    "sample": "pairs dealt out one by one, as in chapter 4 of the thesis, one a sequence; pairs of the same sequences, "
    "with the same motion and a frame in common, were learnt from",
}
"""How validation was kept from training."""

PARTS: dict[Part, str] = {"validation": "validation", "unseen": "unseen scenes"}

REACHED: dict[str, Callable[[Found], str]] = {
    "pairs to learn from": lambda found: f"{found.reached.training_pairs:,}",
    "pairs seen (best after)": lambda found: f"{found.reached.pairs_seen:,} ({found.reached.pairs_best:,})",
    "epochs": lambda found: f"{found.reached.epochs:.2f} of {found.reached.epochs_asked:.3g}",
    "minutes": lambda found: f"{found.reached.minutes:.1f}",
    "batch, rate, precision": lambda found: f"{found.reached.batch}, {found.reached.rate:.3g}, {found.reached.precision}",
    "scored pairs: validation, unseen (scenes)": lambda found: (
        f"{found.validation['none'].pairs:,}, {found.unseen['none'].pairs:,} ({found.unseen['none'].scenes})"
    ),
    "on": lambda found: f"{found.reached.device}; {found.reached.machine}, threads: {found.reached.threads}",
    "date": lambda found: found.reached.date,
}
"""Columns that say with what a row was reached."""


def table_lines(table: DocumentTable, found: Mapping[str, Found]) -> list[str]:
    """A table as Markdown; rows that are not in ``found`` stay visible."""
    first = next((found[row.name] for row in table.rows if row.name in found), None)
    split = first.reached.split if first else "sequence"
    return [
        f"## {table.kind} {table.name}: {table.title} (Almanza-Medina, {table.section})",
        "",
        *_framed(_error_cells(table, found, first)),
        "",
        *([f"Note: {table.note}.", ""] if table.note else []),
        f"*validation* (split: {split}): {SPLITS[split]}; the network kept of a "
        "training is the best on them. *unseen scenes*: one pair a sequence of a data set of another seed, whose scenes no "
        f"network has seen: what a user meets. {table.differs}",
        "",
        "The scale at which each figure was reached:",
        "",
        *_framed(_reached_cells(table, found)),
    ]


def _error_cells(table: DocumentTable, found: Mapping[str, Found], first: Found | None) -> list[list[str]]:
    """Errors, the thesis's beside ours, and times where it has some."""
    units = " / ".join(f"{axis.unit} {axis.name}" for axis in table.axes)
    heights, timed = table.axes == (HEIGHT,), any(row.ms for row in table.rows)
    head, zero = ["RMSE of heights" if heights else f"RMSE, {units}"], ["*always answering no motion*"]
    for noise in table.noises:
        head += [f"thesis, {NOISES[noise]}", *(f"{part}, {NOISES[noise]}" for part in PARTS.values())]
        answered = (errors_said(first.score(part, noise).zero) if first else "-" for part in PARTS)
        zero += [errors_said(table.no_motion), *answered]
    cells = [head] if heights else [head, zero]
    for row in table.rows:
        ours = found.get(row.name)
        cells.append([row.approach])
        for noise in table.noises:
            mine = (row.said(ours.score(part, noise).rmse) if ours else NOT_YET for part in PARTS)
            cells[-1] += [row.said(row.printed.get(noise)), *mine]
    if timed:
        head += ["thesis, ms", "here, ms"]
        for row, line in zip(table.rows, cells[-len(table.rows) :], strict=True):
            ms = found[row.name].score("unseen", table.noises[0]).ms if row.name in found else None
            line += ["-" if one is None else f"{one:.3g}" for one in (row.ms, ms)]
        zero += ["0", "0"]
    return cells


def _reached_cells(table: DocumentTable, found: Mapping[str, Found]) -> list[list[str]]:
    """With what each row was reached."""
    cells = [["row", "recipe", "also in", *REACHED]]
    for row in table.rows:
        ours = found.get(row.name)
        others = ", ".join(name for name in tables_with(row.name) if name != table.name) or "-"
        recipe = row.recipe + "".join(f", {key}: {_short(value)}" for key, value in row.set.items())
        told = [tell(ours) for tell in REACHED.values()] if ours else [NOT_YET, *["-"] * (len(REACHED) - 1)]
        cells.append([row.approach, recipe, others, *told])
    return cells


def _short(value: Any) -> str:
    return json.dumps(value).replace('"', "")


def plain_table(table: DocumentTable, found: Mapping[str, Found]) -> dict[str, Any]:
    """A table for programs."""
    rows = []
    for row in table.rows:
        ours = found.get(row.name)
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
                "status": "done" if ours else NOT_YET,
                "ours": ours.model_dump(mode="json", exclude={"recipe"}) if ours else None,
            }
        )
    about = {"title": table.title, "section": table.section, "note": table.note, "units": [axis.unit for axis in table.axes]}
    return {**about, "no_motion": list(table.no_motion), "rows": rows}


def errors_said(errors: tuple[float, ...]) -> str:
    """RMSE along the axes, for people."""
    named = zip(errors, AXES, strict=False)
    return " / ".join(f"{value:.3f}" if axis.unit == "deg" else f"{value:.2f}" for value, axis in named)


def _framed(rows: list[list[str]]) -> list[str]:
    """Cells as a Markdown table, the first row its head."""
    width = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["| " + " | ".join(cell.ljust(size) for cell, size in zip(row, width, strict=True)) + " |" for row in rows]
    return [lines[0], "|" + "|".join("-" * (size + 2) for size in width) + "|", *lines[1:]]


def table_figure(table: DocumentTable, found: Mapping[str, Found], *, title: str = "") -> Figure:
    """Bars: the thesis, validation, unseen scenes; whiskers are 95 % intervals, the line is always answering no motion."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 2.6 + 1.1 * len(table.rows)), layout="constrained")
    figure.suptitle("\n".join(wrap(title or f"{table.kind} {table.name}: {table.title}", 150)), fontsize="medium")
    grid = figure.subplots(len(table.noises), len(table.axes), sharey=True, squeeze=False)
    place = {row.name: k for k, row in enumerate(table.rows) if row.name in found}
    handles: dict[str, Any] = {}
    for panels, noise in zip(grid, table.noises, strict=True):
        for k, (panel, axis) in enumerate(zip(panels, table.axes, strict=True)):
            printed = [row.drawn(row.printed[noise])[k] if noise in row.printed else np.nan for row in table.rows]
            handles["thesis"] = panel.barh(np.arange(len(printed)) - 0.27, printed, 0.25, color="0.6")
            for offset, colour, (part, said) in zip((0.0, 0.27), ("C0", "C1"), PARTS.items(), strict=True):
                rows = [row for row in table.rows if row.name in found]
                scores = [(row, found[row.name].score(part, noise)) for row in rows]
                ends = np.array([[row.drawn(e)[k] for e in (s.low, s.rmse, s.high)] for row, s in scores]).reshape(-1, 3)
                low, rmse, high = ends.T
                whiskers = {"xerr": np.maximum([rmse - low, high - rmse], 0), "error_kw": {"linewidth": 0.8}}
                places = [place[row.name] + offset for row in rows]
                handles[said] = panel.barh(places, rmse, 0.25, color=colour, **(whiskers if rows else {}))
            handles["no motion"] = panel.axvline(table.no_motion[k], color="black", linestyle=":")
            panel.set(title=f"{NOISES[noise]}: {axis.name}", xlabel=f"RMSE ({axis.unit})")
            panel.set_yticks(range(len(printed)), [_label(row, found.get(row.name)) for row in table.rows])
    grid[0, 0].invert_yaxis()
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
    return figure


def _label(row: TableRow, ours: Found | None) -> str:
    """A row, and the scale at which it was reached."""
    if ours is None:
        return f"{row.approach}\n{NOT_YET}"
    return (
        f"{row.approach}\n{ours.reached.training_pairs:,} pairs x {ours.reached.epochs:.2g}, {ours.reached.minutes:.3g} min"
    )
