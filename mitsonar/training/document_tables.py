"""Tables of trained networks as Almanza-Medina prints them."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Annotated, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.motion.errors import AXES, Axis
from mitsonar.training.training_types import JsonObject

__all__ = [
    "HEIGHT",
    "NOISES",
    "DocumentTable",
    "Errors",
    "ScriptedTable",
    "Strict",
    "TableRow",
    "contents",
    "errors_said",
    "load_scripted",
    "load_tables",
    "rows_named",
    "split_name",
    "table_named",
    "tables_with",
]

LOUD: Literal["0.0274,0.0062,0.0274"] = "0.0274,0.0062,0.0274"
"""A fifth of the high noise: what echoes of five times the gain have. The baseline of Almanza-Medina hardly feels the high
noise (table 3.8: 8.39 and 8.16 mm), and ``ecc`` hardly feels this (0.98 and 1.02 mm; 1.89 with high noise)."""

NOISES = {"none": "noiseless", "high": "high noise", LOUD: "high noise, 5 times the gain"}
"""Noise of the validation samples, and the heading of its half of a table."""

CHAPTERS = ("chapter3", "chapter4", "chapter5")
"""Files of tables."""

HEIGHT = Axis("height", "% of the interval", 1.0)
"""Axis of figures of heights. Errors are relative: one interval of heights is 26 times the other."""

Errors = Annotated[tuple[float, ...], Field(min_length=1, max_length=3)]
"""Sideways [mm], forward [mm], and yaw [deg] where the vehicle turns; or height [mm]."""


class Strict(BaseModel):
    """A model that refuses unknown keys and cannot be changed."""

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
    def _named(cls, fields: object) -> object:
        return {"name": fields.get("recipe"), **fields} if isinstance(fields, dict) else fields

    @property
    def printed(self) -> dict[str, Errors]:
        """Return the errors that Almanza-Medina prints, by noise."""
        both = {"none": self.none, "high": self.high}
        return {noise: errors for noise, errors in both.items() if errors is not None}

    def drawn(self, errors: tuple[float, ...]) -> tuple[float, ...]:
        """Return an RMSE as a figure shows it: heights in percent of their interval."""
        return errors if self.interval is None else (errors[0] / 10 / self.interval,)

    def said(self, errors: tuple[float, ...] | None) -> str:
        """Format an RMSE for people: heights in cm and in percent of their interval."""
        if errors is None:
            return "-"
        if self.interval is None:
            return errors_said(errors)
        return f"{errors[0] / 10:.2f} cm ({errors[0] / 10 / self.interval:.2f} %)"


class DocumentTable(Strict):
    """One table of Almanza-Medina.

    Attributes:
        name: its number.
        title: what its rows differ in.
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
    noises: list[Literal["none", "high", "0.0274,0.0062,0.0274"]] = ["none", "high", LOUD]
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
        title: what it shows.
        section: of Almanza-Medina that describes it.
        command: that makes it, from the root of the sources.
        printed: what Almanza-Medina prints, row by row, as text.
        results: page and heading with ours.
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
    both: list[DocumentTable | ScriptedTable] = [*load_tables().values(), *load_scripted().values()]
    return sorted(both, key=lambda one: [int(number) for number in one.name.removeprefix("figure-").split(".")])


def table_named(name: str) -> DocumentTable:
    """Return the table of that number.

    Raises:
        MitsonarError: no such table, or one that a script makes.
    """
    tables, scripted = load_tables(), load_scripted()
    if name in scripted:
        raise MitsonarError(f"{name} is made by a script of mitsonar's sources: run there  {scripted[name].command}")
    if name not in tables:
        raise MitsonarError(f"no table {name!r}: {nearest_names(name, [one.name for one in contents()])}")
    return tables[name]


def rows_named(table: DocumentTable, names: list[str] | None = None) -> list[TableRow]:
    """Return the named rows of a table, in the order of the table; all rows if none is named.

    Raises:
        MitsonarError: no such row.
    """
    known = [row.name for row in table.rows]
    for name in names or []:
        if name not in known:
            raise MitsonarError(f"table {table.name} has no row {name!r}: {nearest_names(name, known)}")
    return [row for row in table.rows if not names or row.name in names]


def tables_with(name: str) -> list[str]:
    """Return the numbers of the tables that have a row of this name."""
    return [table.name for table in load_tables().values() if any(row.name == name for row in table.rows)]


def errors_said(errors: tuple[float, ...]) -> str:
    """Format the RMSE of each axis for people."""
    named = zip(errors, AXES, strict=False)
    return " / ".join(f"{value:.3f}" if axis.unit == "deg" else f"{value:.2f}" for value, axis in named)


def split_name(split: str | JsonObject) -> str:
    """Return what a split deals out: ``sample``, ``sequence`` or ``scene``."""
    return split if isinstance(split, str) else str(split["by"])
