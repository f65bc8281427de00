"""The thesis's tables of trained networks, and what was reached here beside what it prints: as Markdown and as a figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.metrics import AXES, Axis

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "NOISES",
    "Found",
    "Reached",
    "Row",
    "Score",
    "Table",
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

CHAPTERS = ("chapter3", "chapter5")
"""Files of tables."""

Errors = Annotated[tuple[float, ...], Field(min_length=2, max_length=3)]
"""Sideways [mm], forward [mm], and yaw [deg] where the vehicle turns."""

Part = Literal["validation", "unseen"]

# ---------------------------------------------------------------- what the thesis prints


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Row(_Part):
    """One network of a table.

    Attributes:
        approach: what the thesis calls it.
        recipe: name of the training recipe; rows of several tables that are the same network name the same one.
        none: RMSE without noise.
        high: RMSE with high noise, where it is printed.
    """

    approach: str
    recipe: str
    none: Errors
    high: Errors | None = None

    @property
    def printed(self) -> dict[str, Errors]:
        """The errors that the thesis prints, by noise."""
        return {"none": self.none} | ({} if self.high is None else {"high": self.high})


class Table(_Part):
    """One table of the thesis.

    Attributes:
        name: its number.
        title: what its rows differ in.
        section: where the thesis speaks of it.
        note: what a reader should know who compares.
        differs: in what the thesis's validation and simulation are not ours.
        largest: the largest motions of its data, even within plus and minus these.
        rows: in the thesis's order.
    """

    name: str
    title: str
    section: str
    note: str = ""
    differs: str = (
        "The thesis chose and validated on the same pairs (8,000 in most tables); its scenes, gain and windows differ from "
        "ours."
    )
    largest: Errors = (20.0, 20.0, 0.45)
    rows: list[Row] = Field(min_length=1)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Numbers of a motion that its rows estimate."""
        return tuple(AXES[: len(self.largest)])

    @property
    def noises(self) -> dict[str, str]:
        """What it says errors with, and that for people."""
        return {noise: said for noise, said in NOISES.items() if noise in self.rows[0].printed}

    @property
    def no_motion(self) -> tuple[float, ...]:
        """RMSE of always answering no motion."""
        return tuple(end / np.sqrt(3) for end in self.largest)


@cache
def load_tables() -> dict[str, Table]:
    """All tables by their number."""
    folder = files("mitsonar.recipes") / "tables"
    texts = [(folder / f"{chapter}.yaml").read_text(encoding="utf-8") for chapter in CHAPTERS]
    return {name: Table(name=name, **fields) for text in texts for name, fields in yaml.safe_load(text).items()}


def table_named(name: str) -> Table:
    """The table of that number.

    Raises:
        MitsonarError: no such table.
    """
    tables = load_tables()
    if name not in tables:
        raise MitsonarError(f"no table {name!r}: {nearest_names(name, tables)}")
    return tables[name]


def rows_named(table: Table, names: list[str] | None = None) -> list[Row]:
    """Rows of a table by the names of their recipes, in the table's order; all where none is named.

    Raises:
        MitsonarError: no such row.
    """
    known = [row.recipe for row in table.rows]
    for name in names or []:
        if name not in known:
            raise MitsonarError(f"table {table.name} has no row {name!r}: {nearest_names(name, known)}")
    return [row for row in table.rows if not names or row.recipe in names]


def tables_with(recipe: str) -> list[str]:
    """The numbers of the tables that have a row of this recipe."""
    return [table.name for table in load_tables().values() if any(row.recipe == recipe for row in table.rows)]


# ---------------------------------------------------------------- what was reached here


class Score(_Part):
    """Errors on some samples, each sideways [mm], forward [mm], and yaw [deg] where the network estimates it.

    Attributes:
        pairs: how many.
        scenes: of how many scenes.
        rmse: root of the mean square.
        low: lower end of its 95 % interval,
        high: and upper end.
        slope: of the estimates over the true motions, no unit; null where nothing moved.
        zero: RMSE of always answering no motion.
    """

    pairs: int
    scenes: int
    rmse: Errors
    low: Errors
    high: Errors
    slope: tuple[float | None, ...]
    zero: Errors


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
        recipe: its name.
        validation: errors by noise on the part of the data set that was kept from training.
        unseen: errors by noise on scenes that training never saw, from a data set of another seed.
        reached: with what.
    """

    recipe: str
    validation: dict[str, Score]
    unseen: dict[str, Score]
    reached: Reached

    def score(self, part: Part, noise: str) -> Score:
        """Errors on one part with one noise."""
        return (self.validation if part == "validation" else self.unseen)[noise]


# ---------------------------------------------------------------- side by side

NOT_YET = "not trained yet"

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


def table_lines(table: Table, found: Mapping[str, Found]) -> list[str]:
    """A table as Markdown; rows that are not in ``found`` stay visible."""
    first = next((found[row.recipe] for row in table.rows if row.recipe in found), None)
    units = " / ".join(f"{axis.unit} {axis.name}" for axis in table.axes)
    errors = [[f"RMSE, {units}"], ["*always answering no motion*"]]
    for noise, said in table.noises.items():
        errors[0] += [f"thesis, {said}", *(f"{part}, {said}" for part in PARTS.values())]
        zero = (errors_said(first.score(part, noise).zero) if first else "-" for part in PARTS)
        errors[1] += [errors_said(table.no_motion), *zero]
    reached = [["row", "recipe", "also in", *REACHED]]
    for row in table.rows:
        ours = found.get(row.recipe)
        errors.append([row.approach])
        for noise, printed in row.printed.items():
            mine = (errors_said(ours.score(part, noise).rmse) if ours else NOT_YET for part in PARTS)
            errors[-1] += [errors_said(printed), *mine]
        others = ", ".join(name for name in tables_with(row.recipe) if name != table.name) or "-"
        cells = [tell(ours) for tell in REACHED.values()] if ours else [NOT_YET, *["-"] * (len(REACHED) - 1)]
        reached.append([row.approach, row.recipe, others, *cells])
    split = first.reached.split if first else "sequence"
    return [
        f"## Table {table.name}: {table.title} (Almanza-Medina, {table.section})",
        "",
        *_framed(errors),
        "",
        *([f"Note: {table.note}.", ""] if table.note else []),
        f"*validation* (split: {split}): one pair a sequence of those kept from training, "
        f"{'of the same scenes, as in the thesis' if split == 'sequence' else 'of other scenes'}; the network kept of a "
        "training is the best on them. *unseen scenes*: one pair a sequence of a data set of another seed, whose scenes no "
        f"network has seen: what a user meets. {table.differs}",
        "",
        "The scale at which each figure was reached:",
        "",
        *_framed(reached),
    ]


def plain_table(table: Table, found: Mapping[str, Found]) -> dict[str, Any]:
    """A table for programs."""
    rows = []
    for row in table.rows:
        ours = found.get(row.recipe)
        rows.append(
            {
                "approach": row.approach,
                "recipe": row.recipe,
                "also_in": [name for name in tables_with(row.recipe) if name != table.name],
                "thesis": {noise: list(errors) for noise, errors in row.printed.items()},
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


def table_figure(table: Table, found: Mapping[str, Found], *, title: str = "") -> Figure:
    """Bars: the thesis, validation, unseen scenes; whiskers are 95 % intervals, the line is always answering no motion."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 2.6 + 1.1 * len(table.rows)), layout="constrained")
    figure.suptitle("\n".join(wrap(title or f"Table {table.name}: {table.title}", 150)), fontsize="medium")
    grid = figure.subplots(len(table.noises), len(table.axes), sharey=True, squeeze=False)
    place = {row.recipe: k for k, row in enumerate(table.rows) if row.recipe in found}
    handles: dict[str, Any] = {}
    for panels, (noise, said) in zip(grid, table.noises.items(), strict=True):
        for k, (panel, axis) in enumerate(zip(panels, table.axes, strict=True)):
            printed = [row.printed[noise][k] for row in table.rows]
            handles["thesis"] = panel.barh(np.arange(len(printed)) - 0.27, printed, 0.25, color="0.6")
            for offset, colour, (part, name) in zip((0.0, 0.27), ("C0", "C1"), PARTS.items(), strict=True):
                scores = {where + offset: found[recipe].score(part, noise) for recipe, where in place.items()}
                spread = [[max(0.0, s.rmse[k] - s.low[k]), max(0.0, s.high[k] - s.rmse[k])] for s in scores.values()]
                whiskers = {"xerr": np.array(spread).T, "error_kw": {"linewidth": 0.8}} if scores else {}
                rmse = [score.rmse[k] for score in scores.values()]
                handles[name] = panel.barh(list(scores), rmse, 0.25, color=colour, **whiskers)
            handles["no motion"] = panel.axvline(table.no_motion[k], color="black", linestyle=":")
            panel.set(title=f"{said}: {axis.name}", xlabel=f"RMSE ({axis.unit})")
            panel.set_yticks(range(len(printed)), [_label(row, found.get(row.recipe)) for row in table.rows])
    grid[0, 0].invert_yaxis()
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
    return figure


def _label(row: Row, ours: Found | None) -> str:
    """A row, and the scale at which it was reached."""
    if ours is None:
        return f"{row.approach}\n{NOT_YET}"
    return (
        f"{row.approach}\n{ours.reached.training_pairs:,} pairs x {ours.reached.epochs:.2g}, {ours.reached.minutes:.3g} min"
    )
