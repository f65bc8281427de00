"""Tables of a comparison or an evaluation as Markdown."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from mitsonar.estimation.estimator import PlainTable

__all__ = ["FEWEST_SCENES", "Cells", "markdown", "table_lines"]

FEWEST_SCENES = 10
"""Fewest scenes for clustered intervals; with fewer they are much too narrow."""


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
    "method": lambda row: str(row["method"]),
    "RMSE": lambda row: _three(row["rmse"]),
    "as in the thesis": lambda row: _joined(row["thesis"], 2),
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
