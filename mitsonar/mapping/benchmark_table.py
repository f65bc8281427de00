"""The tables of the odometry benchmark as Markdown: dives, drift of the other sets, then a part for each of these."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby

import numpy as np

from mitsonar.estimation.compare import Cells, markdown
from mitsonar.estimation.estimator import PlainTable
from mitsonar.mapping.benchmark_sets import DIVE
from mitsonar.motion.errors import AXES

__all__ = ["benchmark_lines"]

FEWEST_BLOCKS = 10
"""Fewest blocks of a path for intervals; with fewer they are too narrow."""

UNITS = " / ".join(f"{axis.name} {axis.unit}" for axis in AXES)


def benchmark_lines(rows: Sequence[PlainTable]) -> list[str]:
    """Return the rows, in their order, as lines of Markdown."""
    dives = [row for row in rows if row["set"].startswith(f"{DIVE}-")]
    parts = [list(group) for _, group in groupby([row for row in rows if row not in dives], key=_cell)]
    return [*_dives(dives), *_overview(parts), *(line for part in parts for line in _part(part))]


def _dives(rows: Sequence[PlainTable]) -> Iterator[str]:
    """Yield a table a method: a line a sonar, texture and flight, over the worlds of these."""
    for method in dict.fromkeys(row["method"] for row in rows):
        flown: dict[tuple[str, str, str], list[PlainTable]] = {}
        for row in rows:
            if row["method"] == method:
                preset, flight = _flown(row["set"])
                flown.setdefault((preset, row["texture"], flight), []).append(row)
        worlds = max(len(of) for of in flown.values())
        yield from ("", f"**Dives, {method}**: RMSE and bound: {UNITS}; of {worlds} worlds, drift is the median", "")
        yield from markdown([_dive(*key, of) for key, of in flown.items()], tuple(DIVE_CELLS), DIVE_CELLS)


def _flown(name: str) -> tuple[str, str]:
    """Return preset and flight of a dive's name."""
    preset, flight, _ = name.removeprefix(f"{DIVE}-").rsplit("-", 2)
    return preset, flight


def _dive(preset: str, texture: str, flight: str, rows: Sequence[PlainTable]) -> PlainTable:
    """Return the line of a dive from the rows of its worlds."""
    known = [row for row in rows if "path_m" in row]
    line: PlainTable = {"sonar": preset, "texture": texture, "flight": flight, "pairs": sum(row["pairs"] for row in rows)}
    line |= {"failures": sum(row["failures"] for row in rows), "ms": float(np.median([row["ms"] for row in rows]))}
    if not known:
        return line
    for name in ("rmse", "bound"):
        if all(row.get(name) is not None for row in known):
            line[name] = np.sqrt(np.mean([np.square(row[name]) for row in known], axis=0)).tolist()
    tried = [(row["nees"], row["pairs"] - row["failures"]) for row in known if row.get("nees") is not None]
    if tried:
        line["nees"] = float(np.average([nees for nees, _ in tried], weights=[count for _, count in tried]))
    drifts = [row["end_percent"] for row in known if row["end_percent"] is not None]
    line["end_percent"] = float(np.median(drifts)) if drifts else None
    return line


def _overview(parts: list[list[PlainTable]]) -> Iterator[str]:
    """Yield a table of drift in percent: a line a method, a column a set; nothing for a single set."""
    measured = [part for part in parts if any("path_m" in row for row in part)]
    drifts = {", ".join(_cell(part[0])): {row["method"]: row for row in part} for part in measured}
    if len(drifts) < 2:
        return
    methods = dict.fromkeys(name for of in drifts.values() for name in of)
    texts: Cells = {name: _drift_in(name) for name in drifts}
    lines: list[PlainTable] = [{"method": m, **{name: of.get(m, {}) for name, of in drifts.items()}} for m in methods]
    yield from ("", "Drift over segments, % of their length; after a comma the motions that failed, %", "")
    yield from markdown(lines, ("method", *drifts), {"method": CELLS["method"], **texts})


def _drift_in(name: str) -> Callable[[PlainTable], str]:
    """Return what writes the drift and the failures of a method in a set."""

    def text(line: PlainTable) -> str:
        row = line[name]
        if not row:
            return ""
        failed = f", {100 * row['failures'] / row['pairs']:.0f}" if row["failures"] else ""
        return f"{row['drift_percent'][0]:.1f}{failed}" if row.get("drift_percent") else f"-{failed}"

    return text


def _cell(row: PlainTable) -> tuple[str, str, str]:
    return row["set"], row["texture"], row["noise"]


def _part(rows: list[PlainTable]) -> Iterator[str]:
    """Yield heading, facts and table of one set."""
    first = rows[0]
    true = [row for row in rows if "path_m" in row]
    noise = "" if first["texture"] == "recorded" else f", noise {first['noise']}"
    yield from ("", f"**{first['set']}, {first['texture']}{noise}**: {'; '.join(_facts(first, true))}", "")
    yield from markdown(rows, COLUMNS if true else CLOSURE_COLUMNS, CELLS)
    yield from (f"- {row['method']}: {row['note']}" for row in rows if row["note"])


def _facts(first: PlainTable, true: list[PlainTable]) -> Iterator[str]:
    """Yield what holds for all rows."""
    yield f"{first['frames']} frames"
    if not true:
        yield f"no truth; net motion and closure: {UNITS}"
        return
    one = true[0]
    yield f"path {one['path_m']:.2f} m; RMSE: {UNITS}"
    if one.get("bound") is not None:
        yield f"bound {_three(one['bound'])}"
    if "segments" in one:
        lengths = ", ".join(f"{length:g}" for length in one["lengths_m"])
        few = f", so few that intervals are too narrow (95 %, over {one['blocks']} blocks)"
        blocks = few if one["blocks"] < FEWEST_BLOCKS else f", 95 % intervals over {one['blocks']} blocks"
        yield f"{one['segments']} segments of {lengths} m{blocks}"


DIGITS = (2, 2, 3)


def _three(values: Sequence[float | None], digits: Sequence[int] = DIGITS) -> str:
    return " / ".join("-" if value is None else f"{value:.{d}f}" for value, d in zip(values, digits, strict=True))


def _spanned(row: PlainTable, name: str, digits: int) -> str:
    """Return a value with its interval."""
    if row.get(name) is None:
        return "-"
    value, low, high = row[name]
    return f"{value:.{digits}f} ({low:.{digits}f}..{high:.{digits}f})"


CELLS: Cells = {
    "method": lambda row: str(row["method"]),
    "drift %": lambda row: _spanned(row, "drift_percent", 1),
    "drift deg / 100 m": lambda row: _spanned(row, "drift_deg_per_100m", 0),
    "end %": lambda row: "-" if row.get("end_percent") is None else f"{row['end_percent']:.1f}",
    "RMSE": lambda row: _three(row["rmse"]) if "rmse" in row else "-",
    "/ bound": lambda row: _three(row["over_bound"], (0, 0, 0)) if "over_bound" in row else "-",
    "nees": lambda row: "-" if row.get("nees") is None else f"{row['nees']:.1f}",
    "net motion": lambda row: _three(row["sums"]) if "sums" in row else "-",
    "closure": lambda row: _three(row["closure"]) if "closure" in row else "-",
    "fail": lambda row: f"{row['failures']} of {row['pairs']}",
    "ms": lambda row: f"{row['ms']:.0f}",
}

DIVE_CELLS: Cells = {
    "sonar": lambda row: str(row["sonar"]),
    "texture": lambda row: str(row["texture"]),
    "flight": lambda row: str(row["flight"]),
    "rejected": lambda row: f"{row['failures']} of {row['pairs']}",
    "RMSE": CELLS["RMSE"],
    "bound": lambda row: _three(row["bound"]) if "bound" in row else "-",
    "NEES": lambda row: "-" if row.get("nees") is None else f"{row['nees']:.2f}",
    "drift %": lambda row: "-" if row.get("end_percent") is None else f"{row['end_percent']:.2f}",
    "ms": CELLS["ms"],
}

COLUMNS = ("method", "drift %", "drift deg / 100 m", "end %", "RMSE", "/ bound", "nees", "fail", "ms")
CLOSURE_COLUMNS = ("method", "net motion", "closure", "fail", "ms")
