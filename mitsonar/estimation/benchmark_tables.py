"""Tables of a comparison or an evaluation as Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mitsonar.errors import counted
from mitsonar.estimation.estimator import PlainTable
from mitsonar.io.files import write_whole
from mitsonar.motion.errors import AXES

__all__ = ["FEWEST_SCENES", "Cells", "Comparison", "markdown", "table_lines"]

FEWEST_SCENES = 10
"""Fewest scenes for clustered intervals; with fewer they are much too narrow."""


@dataclass(frozen=True)
class Comparison:
    """What a comparison of estimators found. Printed, it is its tables as Markdown, which a notebook shows as tables.

    Attributes:
        report: the content of ``table.json``: the settings; ``notes``, sentences that the reader needs; ``tables``, one a
            level of noise and variation; their ``rows`` are :class:`~mitsonar.estimation.benchmark.BenchmarkRow` as JSON.
    """

    report: PlainTable

    @property
    def rows(self) -> list[PlainTable]:
        """Return a row for each method, level of noise and variation: ``noise``, ``variation``, and numbers and texts.

        What has three numbers, sideways and forward [mm] and yaw [deg], is three entries: ``rmse_sideways_mm`` ... None
        where a number is not known.
        """
        return [
            {"noise": table["noise"], "variation": table["variation"], **_flat(row)}
            for table in self.report["tables"]
            for row in table["rows"]
        ]

    @property
    def notes(self) -> list[str]:
        """Return sentences that the reader needs."""
        return list(self.report["notes"])

    def columns(self) -> dict[str, list[object]]:
        """Return the columns of :attr:`rows` by name, as ``pandas.DataFrame`` takes them."""
        rows = self.rows
        return {name: [row[name] for row in rows] for name in rows[0]}

    def to_markdown(self) -> str:
        """Return the tables as ``mitsonar compare`` prints them."""
        report = self.report
        head = (
            f"{report['data']}: {counted(report['pairs'], 'pair')} of {counted(report['scenes'], 'scene')}, "
            f"{report['model']} model; sideways mm / forward mm / yaw deg"
        )
        return "\n".join([head, *(line for table in report["tables"] for line in table_lines(table))])

    def to_csv(self, path: str | Path | None = None) -> str:
        """Return :attr:`rows` as CSV, and write it to a file if one is given."""
        text, rows = io.StringIO(), self.rows
        writer = csv.DictWriter(text, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        if path is not None:
            write_whole(path, text.getvalue().encode())
        return text.getvalue()

    def __str__(self) -> str:
        return self.to_markdown()

    def _repr_markdown_(self) -> str:
        return self.to_markdown()


def _flat(row: PlainTable) -> PlainTable:
    """Return a row with an entry for each number."""
    flat: PlainTable = {}
    for name, value in row.items():
        if isinstance(value, list):
            ends = [axis.name if name in UNITLESS else f"{axis.name}_{axis.unit}" for axis in AXES]
            flat |= {f"{name}_{end}": one for end, one in zip(ends, value, strict=True)}
        else:
            flat[name] = value
    return flat


UNITLESS = ("slope", "skill", "over_limit")
"""Entries of a row that have no unit."""


def table_lines(table: PlainTable) -> list[str]:
    """Return a table of the report as lines of Markdown."""
    shown = markdown(table["rows"], COLUMNS)
    shown[0] = shown[0].replace("/ limit (rays)", f"/ limit ({table.get('limit_law', 'rays')})")
    lines = ["", f"noise {table['noise']}, {table['variation']}", "", *shown]
    if table["limits"]:
        known = {law: std for law, std in table["limits"].items() if any(value != 0 for value in std)}
        lines += ["", "limit of two frames: " + "; ".join(f"{law} {_three(std)}" for law, std in known.items())]
    others = [row for row in table["rows"] if row["method"] != table["reference"] and row["method"] != "zero"]
    for row in others:
        numbers = zip(row["over_reference"], row["over_reference_low"], row["over_reference_high"], DIGITS, strict=True)
        spans = (f"{value:+.{d}f} ({low:+.{d}f}..{high:+.{d}f})" for value, low, high, d in numbers)
        lines.append(
            f"{'' if row is not others[0] else chr(10)}{row['method']} less {table['reference']}: {' / '.join(spans)}  "
        )
    return lines


Cells = Mapping[str, Callable[[PlainTable], str]]
"""The text of a column, of a row."""


def markdown(rows: list[PlainTable], columns: Sequence[str], texts: Cells | None = None) -> list[str]:
    """Return the methods as lines of a Markdown table with these columns of ``texts``; default: of :data:`CELLS`."""
    text = CELLS if texts is None else texts
    cells = [list(columns), ["---"] * len(columns), *([text[column](row) for column in columns] for row in rows)]
    width = [max(len(row[k]) for row in cells) for k in range(len(columns))]
    return ["| " + " | ".join(cell.ljust(size) for cell, size in zip(row, width, strict=True)) + " |" for row in cells]


DIGITS = (2, 2, 4)


def _number(value: float | None, axis: int) -> str:
    return "-" if value is None else f"{value:.{DIGITS[axis]}f}"


def _three(values: list[float | None]) -> str:
    return " / ".join(_number(value, k) for k, value in enumerate(values))


def _joined(values: list[float | None], digits: int) -> str:
    return " / ".join("-" if value is None else f"{value:.{digits}f}" for value in values)


def _interval(row: PlainTable) -> str:
    ends = zip(row["rmse_low"], row["rmse_high"], strict=True)
    return " ".join(f"{_number(low, k)}..{_number(high, k)}" for k, (low, high) in enumerate(ends))


CELLS: Cells = {
    "method": lambda row: str(row["method"]) + (f" (learnt {row['learnt']})" if row.get("learnt") else ""),
    "RMSE": lambda row: _three(row["rmse"]),
    "RMSE, mm / mm / deg/100": lambda row: _joined(row["thesis"], 2),
    "95 % interval": _interval,
    "median": lambda row: _three(row["median"]),
    "95 %": lambda row: _three(row["p95"]),
    "slope": lambda row: _joined(row["slope"], 3),
    "bias": lambda row: _three(row["bias"]),
    "large": lambda row: _three(row["large"]),
    "fail": lambda row: str(row["failures"]),
    "skill": lambda row: _joined(row["skill"], 2),
    "/ limit (rays)": lambda row: _joined(row["over_limit"], 1),
    "nees": lambda row: "-" if row["nees"] is None else f"{row['nees']:.1f}",
    "ms": lambda row: f"{row['ms']:.1f}",
    "inputs": lambda row: str(row["inputs"]),
}
"""Those of a comparison or an evaluation."""

COLUMNS = (
    *("method", "RMSE", "95 % interval", "median", "95 %", "slope", "large", "fail", "skill", "/ limit (rays)", "nees"),
    *("ms", "inputs"),
)
