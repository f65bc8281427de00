"""All tables of results: benchmarks/RESULTS.md from the JSON files of benchmarks/results/tables.

    python benchmarks/tables.py           # check that the page is up to date; so does --quick
    python benchmarks/tables.py write     # write the page

A file holds a section: its title, its anchor, and one table or a list of `tables`. Each table has a note, the machine, date
and command that made it, columns, and rows. Cells are text, exactly as the scripts print them.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any, TypeGuard

from mitsonar.errors import MitsonarError
from mitsonar.io.files import write_atomic

HERE = Path(__file__).resolve().parent
RESULTS, PAGE = HERE / "results" / "tables", HERE / "RESULTS.md"
HEAD = """# Results in full

Written by `python benchmarks/tables.py write` from `benchmarks/results/tables`; change these files, not this page.
[Benchmarks](README.md) has what is measured, how to repeat it, and the headline of each area. "Almanza-Medina" is the
document that the model `thesis` and the published tables come from: [How to cite](../docs/cite.md). Machines were shared,
and their speed drifts: compare times within a table only.
"""

SECTIONS = (
    *("rendering", "several-reflections", "coherent-ping", "live", "realism", "blind-sorting", "recordings", "data-sets"),
    *("odometry", "hulls", "certainty", "any-start", "loops", "long-run", "odometry-benchmark", "dives", "registration"),
    *("gradients", "calibration", "height-maps", "trajectories", "limit", "six-degrees", "exactness", "speckle", "networks"),
    *("unseen-scenes", "table-31", "impulse-responses", "synthetic-aperture", "vectors", "gpu"),
    "house",
)
"""Files of results, in the order of the page."""

TEXTS = ("note", "machine", "date", "command")
"""What each table says of itself, besides its columns and rows; one of several also has a caption."""

Record = dict[str, Any]
"""An object of a JSON file."""


def main() -> None:
    """Write the page, or check it.

    Raises:
        SystemExit: the page differs from the results.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["check", "write"], nargs="?", default="check")
    parser.add_argument("--quick", action="store_true", help="check the page")
    options = parser.parse_args()
    text = page(RESULTS)
    if options.what == "write" and not options.quick:
        write_atomic(PAGE, text.encode())
        print(PAGE)
    elif not PAGE.is_file() or PAGE.read_text(encoding="utf-8") != text:
        raise SystemExit(f"{PAGE.name} differs from the results: run  python benchmarks/tables.py write")


def page(folder: Path) -> str:
    """Format all sections of a folder of results.

    Raises:
        MitsonarError: a file is missing, has no place on the page, or is malformed.
    """
    names = {path.stem for path in folder.glob("*.json")}
    if names != set(SECTIONS):
        odd = ", ".join(sorted(names ^ set(SECTIONS)))
        raise MitsonarError(f"files of {folder.name} and SECTIONS of tables.py differ by {odd}: add or remove them")
    return "\n".join([HEAD, *(section(folder / f"{name}.json") for name in SECTIONS)])


def section(path: Path) -> str:
    """Format the section of a file: its heading, whose anchor is that of the file, and its tables.

    Raises:
        MitsonarError: the file is malformed.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as fault:
        raise MitsonarError(f"{path.name} is no JSON: {fault}") from None
    require(record, ("title", "anchor"), path.name)
    if record["anchor"] != anchor(record["title"]):
        raise MitsonarError(f"{path.name}: the anchor of {record['title']!r} is {anchor(record['title'])!r}: write that")
    tables = record.get("tables", [record])
    if not isinstance(tables, list) or not tables:
        raise MitsonarError(f"{path.name}: 'tables' must be a list of at least one table")
    lines = [f"## {record['title']}", ""]
    for number, one in enumerate(tables, start=1):
        lines += table(one, f"{path.name}, table {number}", captioned="tables" in record)
    return "\n".join(lines)


def table(record: Record, where: str, captioned: bool) -> list[str]:
    """Format a table: caption, note, machine, date and command, then its rows.

    Args:
        record: the table.
        where: what messages call it.
        captioned: whether it must have a caption.

    Raises:
        MitsonarError: a key is missing, or a row has another length than the columns.
    """
    require(record, ("caption", *TEXTS) if captioned else TEXTS, where)
    columns, rows = record.get("columns"), record.get("rows")
    if not texts(columns) or not isinstance(rows, list) or not rows:
        raise MitsonarError(f"{where}: 'columns' must be texts, and 'rows' a list of at least one row")
    for number, row in enumerate(rows, start=1):
        if not texts(row) or len(row) != len(columns):
            raise MitsonarError(f"{where}: row {number} must be {len(columns)} texts, one for each column")
    lines = [f"**{record['caption']}.** {record['note']}" if captioned else record["note"], ""]
    lines += [f"{record['machine']}, {record['date']}:", "", "```sh", record["command"], "```", ""]
    lines += [line(columns), "|---" * len(columns) + "|", *map(line, rows), ""]
    for name, picture in record.get("pictures", {}).items():
        lines += [f"![{name}]({picture})", ""]
    return lines


def require(record: Record, keys: tuple[str, ...], where: str) -> None:
    """Check that a record has texts under these keys.

    Raises:
        MitsonarError: it is no object, or one is missing, empty or no text.
    """
    if not isinstance(record, dict):
        raise MitsonarError(f"{where} must be an object, not {type(record).__name__}")
    missing = [key for key in keys if not isinstance(record.get(key), str) or not record[key]]
    if missing:
        raise MitsonarError(f"{where} must have a text under {', '.join(map(repr, missing))}")


def texts(values: object) -> TypeGuard[list[str]]:
    """Whether these are texts, at least one."""
    return isinstance(values, list) and bool(values) and all(isinstance(value, str) for value in values)


def line(cells: list[str]) -> str:
    """Format a row of a Markdown table."""
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def anchor(title: str) -> str:
    """Return the anchor that GitHub gives a heading."""
    return re.sub(r"[^a-z0-9 -]", "", title.lower()).replace(" ", "-")


if __name__ == "__main__":
    try:
        main()
    except MitsonarError as fault:
        print(f"error: {fault}", file=sys.stderr)
        raise SystemExit(2) from None
