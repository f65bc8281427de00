"""Tables of Almanza-Medina beside what was reached here: as Markdown, for programs, and as a figure."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsonar.training.document_tables import (
    HEIGHT,
    LOUD,
    NOISES,
    DocumentTable,
    TableRow,
    errors_said,
    split_name,
    tables_with,
)
from mitsonar.training.row_results import Found, Part
from mitsonar.training.training_types import JsonObject

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plain_table", "table_figure", "table_lines"]

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
    "pairs to learn from": lambda found: f"{found.reached.training_pairs:,}",
    "pairs seen (best after)": lambda found: f"{found.reached.pairs_seen:,} ({found.reached.pairs_best:,})",
    "epochs": lambda found: f"{found.reached.epochs:.2f} of {found.reached.epochs_asked:.3g}",
    "minutes": lambda found: f"{found.reached.minutes:.1f}",
    "batch, rate, precision": lambda found: f"{found.reached.batch}, {found.reached.rate:.3g}, {found.reached.precision}",
    "scored pairs: validation, unseen (scenes)": lambda found: (
        f"{found.validation['none'].pairs:,}, {found.unseen['none'].pairs:,} ({found.unseen['none'].scenes})"
    ),
    "scored pairs: other sequences": lambda found: f"{found.test['none'].pairs:,}" if found.test else "-",
    "on": lambda found: f"{found.reached.device}; {found.reached.machine}, threads: {found.reached.threads}",
    "date": lambda found: found.reached.date,
}
"""Columns that show the scale at which a row was reached."""


def table_lines(table: DocumentTable, found: Mapping[str, Found]) -> list[str]:
    """Format a table as Markdown. Rows that are not in ``found`` are shown as not trained yet."""
    first = next((found[row.name] for row in table.rows if row.name in found), None)
    split = first.reached.split if first else split_name(table.set.get("split", "sequence"))
    return [
        f"## {table.kind} {table.name}: {table.title} (Almanza-Medina, {table.section})",
        "",
        *_framed(_error_cells(table, found, first)),
        "",
        *([f"Note: {table.note}.", ""] if table.note else []),
        f"*validation* (split: {split}): {SPLITS[split]}; {' '.join(OF_PARTS[part] for part in _parts(table, found))} "
        f"{table.differs}{GAIN if 'high' in table.noises else ''}",
        "",
        "The scale at which each figure was reached:",
        "",
        *_framed(_reached_cells(table, found)),
    ]


def _parts(table: DocumentTable, found: Mapping[str, Found]) -> dict[Part, str]:
    """Return the parts that rows are scored on, with their headings: all but other sequences where no split has any."""
    tested = any(row.name in found and found[row.name].test for row in table.rows)
    return {part: heading for part, heading in PARTS.items() if part != "test" or tested}


def _noises(table: DocumentTable, found: Mapping[str, Found]) -> list[str]:
    """Return the noises that rows are scored with: none that is not printed and that no row has."""
    return [noise for noise in table.noises if noise != LOUD or any(noise in one.validation for one in found.values())]


def _error_cells(table: DocumentTable, found: Mapping[str, Found], first: Found | None) -> list[list[str]]:
    """Return the cells of errors and times: those of Almanza-Medina beside ours."""
    units = " / ".join(f"{axis.unit} {axis.name}" for axis in table.axes)
    parts = _parts(table, found)
    heights, timed = table.axes == (HEIGHT,), any(row.ms for row in table.rows)
    head, zero = ["RMSE of heights" if heights else f"RMSE, {units}"], ["*always answering no motion*"]
    for noise in _noises(table, found):
        printed = noise != LOUD
        head += [f"Almanza-Medina, {NOISES[noise]}"] * printed + [f"{part}, {NOISES[noise]}" for part in parts.values()]
        scores = [first.score(part, noise) if first else None for part in parts]
        zero += [errors_said(table.no_motion)] * printed
        zero += ["-" if score is None else errors_said(score.zero) for score in scores]
    cells = [head] if heights else [head, zero]
    for row in table.rows:
        ours = found.get(row.name)
        cells.append([row.approach])
        for noise in _noises(table, found):
            scores = [ours.score(part, noise) if ours else None for part in parts]
            mine = [row.said(score.rmse) if score is not None else "-" if ours else NOT_YET for score in scores]
            cells[-1] += [row.said(row.printed.get(noise))] * (noise != LOUD) + mine
    if timed:
        head += ["Almanza-Medina, ms", "here, ms"]
        for row, line in zip(table.rows, cells[-len(table.rows) :], strict=True):
            score = found[row.name].score("unseen", table.noises[0]) if row.name in found else None
            ms = None if score is None else score.ms
            line += ["-" if one is None else f"{one:.3g}" for one in (row.ms, ms)]
        zero += ["0", "0"]
    return cells


def _reached_cells(table: DocumentTable, found: Mapping[str, Found]) -> list[list[str]]:
    """Return the cells of the scale at which each row was reached."""
    cells = [["row", "recipe", "also in", *REACHED]]
    for row in table.rows:
        ours = found.get(row.name)
        others = ", ".join(name for name in tables_with(row.name) if name != table.name) or "-"
        recipe = row.recipe + "".join(f", {key}: {_short(value)}" for key, value in row.set.items())
        scale = [text(ours) for text in REACHED.values()] if ours else [NOT_YET, *["-"] * (len(REACHED) - 1)]
        cells.append([row.approach, recipe, others, *scale])
    return cells


def _short(value: object) -> str:
    return json.dumps(value).replace('"', "")


def plain_table(table: DocumentTable, found: Mapping[str, Found]) -> JsonObject:
    """Return a table for programs."""
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


def _framed(rows: list[list[str]]) -> list[str]:
    """Format cells as a Markdown table, whose head is the first row."""
    width = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["| " + " | ".join(cell.ljust(size) for cell, size in zip(row, width, strict=True)) + " |" for row in rows]
    return [lines[0], "|" + "|".join("-" * (size + 2) for size in width) + "|", *lines[1:]]


def table_figure(table: DocumentTable, found: Mapping[str, Found], *, title: str = "") -> Figure:
    """Draw bars of Almanza-Medina, validation, other sequences and unseen scenes.

    Whiskers are 95 % intervals. The dotted line is the RMSE of always estimating no motion.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 2.6 + 1.1 * len(table.rows)), layout="constrained")
    figure.suptitle("\n".join(wrap(title or f"{table.kind} {table.name}: {table.title}", 150)), fontsize="medium")
    noises = _noises(table, found)
    grid = figure.subplots(len(noises), len(table.axes), sharey=True, squeeze=False)
    position = {row.name: k for k, row in enumerate(table.rows) if row.name in found}
    handles: dict[str, Any] = {}
    shown = _parts(table, found)
    places: dict[Part, tuple[float, str]] = {"validation": (-0.08, "C0"), "test": (0.12, "C2"), "unseen": (0.32, "C1")}
    for panels, noise in zip(grid, noises, strict=True):
        for k, (panel, axis) in enumerate(zip(panels, table.axes, strict=True)):
            printed = [row.drawn(row.printed[noise])[k] if noise in row.printed else np.nan for row in table.rows]
            handles["Almanza-Medina"] = panel.barh(np.arange(len(printed)) - 0.28, printed, 0.18, color="0.6")
            for part, said in shown.items():
                offset, colour = places[part]
                known = [(row, found[row.name].score(part, noise)) for row in table.rows if row.name in found]
                scores = [(row, score) for row, score in known if score is not None]
                ends = np.array([[row.drawn(e)[k] for e in (s.low, s.rmse, s.high)] for row, s in scores]).reshape(-1, 3)
                low, rmse, high = ends.T
                whiskers = {"xerr": np.maximum([rmse - low, high - rmse], 0), "error_kw": {"linewidth": 0.8}}
                positions = [position[row.name] + offset for row, _ in scores]
                handles[said] = panel.barh(positions, rmse, 0.18, color=colour, **(whiskers if scores else {}))
            handles["no motion"] = panel.axvline(table.no_motion[k], color="black", linestyle=":")
            panel.set(title=f"{NOISES[noise]}: {axis.name}", xlabel=f"RMSE ({axis.unit})")
            panel.set_yticks(range(len(printed)), [_label(row, found.get(row.name)) for row in table.rows])
    grid[0, 0].invert_yaxis()
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
    return figure


def _label(row: TableRow, ours: Found | None) -> str:
    """Return the name of a row and the scale at which it was reached."""
    if ours is None:
        return f"{row.approach}\n{NOT_YET}"
    return (
        f"{row.approach}\n{ours.reached.training_pairs:,} pairs x {ours.reached.epochs:.2g}, {ours.reached.minutes:.3g} min"
    )
