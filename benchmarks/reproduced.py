"""All tables and figures of Almanza-Medina: what was reached for each row, at which scale, by which command.

    python benchmarks/reproduced.py                      # write benchmarks/REPRODUCED.md from benchmarks/results/reproduced
    python benchmarks/reproduced.py add RUN              # take the rows of a folder of `mitsonar reproduce` first
    python benchmarks/reproduced.py curve RUN [RUN ...]  # where the schedule would end, from the log of a training
    python benchmarks/reproduced.py --quick              # train two steps of a row a chapter, and check the page
    python benchmarks/reproduced.py --quick --every-row  # of each recipe: ten minutes

A row is one file of `results/reproduced`: what `mitsonar reproduce` found, and its command.
"""

from __future__ import annotations

import argparse
import csv
import json
import shlex
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.io.files import write_atomic
from mitsonar.reproduction.tables import DocumentTable, Found, ScriptedTable, TableRow, contents, load_tables, tables_with

HERE = Path(__file__).resolve().parent
RESULTS, PAGE = HERE / "results" / "reproduced", HERE / "REPRODUCED.md"
HEAD = """# Tables and figures of Almanza-Medina, reproduced

Written by `python benchmarks/reproduced.py` from `benchmarks/results/reproduced`; change the script, not this page. RMSE,
sideways mm / forward mm / yaw deg, without noise; heights in cm. *By pair*: pairs dealt out one by one, as in the document,
whose training has seen pairs of the same sequences. *Other sequences*: of the same scenes. *Unseen*: scenes that no network
has seen. What comes out of it: [What these networks learn](../docs/guides/what-networks-learn.md),
[Results in full](RESULTS.md#networks).
"""

Array = NDArray[np.float64]
Texts = dict[str, str]
"""Cells of a row on the page, and its command."""

QUICK_TABLES = ("3.2", "4.12", "5.2")
"""A table of images, of vectors, and of impulse responses."""

EARLIER = "earlier.json"
"""Cells of rows that were trained before rows were kept, from the tables of RESULTS.md."""


def main() -> None:
    """Write the page, after adding rows if requested."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["write", "add", "curve"], nargs="?", default="write")
    parser.add_argument("runs", type=Path, nargs="*", help="folders of `mitsonar reproduce`; of curve: of trainings")
    parser.add_argument("--quick", action="store_true", help="train two steps of a row of each chapter, and check the page")
    parser.add_argument("--every-row", action="store_true", help="with --quick: of each recipe, ten minutes")
    arguments = parser.parse_args()
    if arguments.quick:
        return quick(arguments.every_row)
    if arguments.what == "curve":
        for run in arguments.runs:
            print(curve(run))
        return None
    for run in arguments.runs if arguments.what == "add" else []:
        add(run)
    write_atomic(PAGE, page(results()).encode())
    print(PAGE)


def quick(every_row: bool) -> None:
    """Train two steps of a row of each chapter, or of each recipe, and check that the page is what the results say.

    Raises:
        SystemExit: it is not.
    """
    from mitsonar.reproduction.tables import Effort, reproduce

    done: set[str] = set()
    with tempfile.TemporaryDirectory(prefix="reproduced-") as folder:
        for number, table in load_tables().items():
            rows = {row.recipe: row.name for row in table.rows if row.recipe not in done}
            if not rows or not (every_row or number in QUICK_TABLES):
                continue
            names = list(rows.values())[: None if every_row else 1]
            result = reproduce(number, Path(folder) / "tables", Effort(quick=True), rows=names, workers=1)
            left = [
                row["name"] for row in result["tables"][number]["rows"] if row["name"] in names and row["status"] != "done"
            ]
            if left:
                raise SystemExit(f"rows of table {number} were not trained: {', '.join(left)}")
            done |= set(list(rows)[: len(names)])
            print(f"{number}: {', '.join(names)}", flush=True)
    if PAGE.read_text(encoding="utf-8") != page(results()):
        raise SystemExit(f"{PAGE.name} is not what the results say: run  python benchmarks/reproduced.py")


def add(run: Path) -> None:
    """Take the rows of a folder of `mitsonar reproduce`, with the command that makes them.

    Raises:
        MitsonarError: no such folder, or one without rows.
    """
    rows = sorted((run / "rows").glob("*.json"))
    if not rows:
        raise MitsonarError(f"{run} holds no rows: give the folder of `mitsonar reproduce`")
    effort = json.loads((run / "run.json").read_text(encoding="utf-8"))["asked"]
    RESULTS.mkdir(parents=True, exist_ok=True)
    for path in rows:
        result = json.loads(path.read_text(encoding="utf-8"))
        table = {"command": command(path.stem, effort), **Found(**result).model_dump(mode="json")}
        write_atomic(RESULTS / path.name, (json.dumps(table, indent=1) + "\n").encode())


def command(row: str, effort: dict[str, object]) -> str:
    """Return the command that makes a row with an effort."""
    words = ["mitsonar", "reproduce", tables_with(row)[0], "--rows", row, "--scale", f"{effort['scale']:g}"]
    words += ["--minutes", f"{effort['minutes'] or 0:g}"]
    words += ["--batch", str(effort["batch"])] if effort["batch"] else []
    for option, key in (("--set", "changes"), ("--data", "data")):
        changes = effort.get(key) or {}
        assert isinstance(changes, dict)
        for name, value in changes.items():
            words += [option, f"{name}={value if isinstance(value, str) else json.dumps(value)}"]
    return shlex.join(words)


def results() -> dict[str, Texts]:
    """Load what was reached for each row, as the cells of the page and its command."""
    rows = {row.name: row for table in load_tables().values() for row in table.rows}
    result: dict[str, Texts] = json.loads((RESULTS / EARLIER).read_text(encoding="utf-8"))
    for path in sorted(RESULTS.glob("*.json")):
        if path.name != EARLIER:
            fields = json.loads(path.read_text(encoding="utf-8"))
            result[path.stem] = texts_of(rows[path.stem], fields.pop("command"), Found(**fields))
    return result


def texts_of(row: TableRow, words: str, ours: Found) -> Texts:
    """Format what was reached for a row."""
    parts = {"by_pair": "validation", "other": "test", "unseen": "unseen"}
    scores = {name: ours.score(part, "none") for name, part in parts.items()}  # type: ignore[arg-type]
    texts = {name: "-" if score is None else row.format_errors(score.rmse) for name, score in scores.items()}
    if ours.reached.split != "sample":
        texts |= {"by_pair": "-", "other": texts["by_pair"]}
    noisy, reached = ours.score("validation", "high"), ours.reached
    planned = reached.training_pairs * reached.epochs_asked
    parts_of_command = shlex.split(words)
    given = [word.partition("=")[2] for word in parts_of_command if word.startswith("network.width=")]
    data = [parts_of_command[place + 1] for place, word in enumerate(parts_of_command) if word == "--data"]
    return texts | {
        "high": "-" if noisy is None else row.format_errors(noisy.rmse),
        "seen": f"{reached.pairs_seen:,} of {planned:,.0f} ({reached.training_pairs:,} different)",
        "width": "; ".join([given[-1] if given else "1", *data]),
        "reached": f"{reached.minutes:.0f}, {reached.machine}, {reached.date}",
        "command": words,
    }


def page(results: dict[str, Texts]) -> str:
    """Format the page: every table and figure, and what was reached of each row."""
    lines = [HEAD]
    for table in contents():
        lines += [f"## {title(table)}", ""]
        lines += scripted(table) if isinstance(table, ScriptedTable) else trained(table, results)
        lines.append("")
    commands = [f"- {name}: `{texts['command']}`" for name, texts in sorted(results.items())]
    return "\n".join([*lines, "## Commands", "", *commands, ""])


def title(table: DocumentTable | ScriptedTable) -> str:
    """Return the heading of a table or figure."""
    figure = table.name.startswith("figure-") or (isinstance(table, DocumentTable) and table.figure)
    return f"{'Figure' if figure else 'Table'} {table.name.removeprefix('figure-')}: {table.title}"


def scripted(table: ScriptedTable) -> list[str]:
    """Format what a script makes: its command, where its results are, and what the document prints."""
    there = table.results.removeprefix("benchmarks/")
    lines = [f"`{table.command}`: [results]({there})"]
    if table.printed:
        lines += ["", "| row | Almanza-Medina |", "|---|---|"]
        lines += [f"| {row} | {text} |" for row, text in table.printed.items()]
    return lines


COLUMNS = {
    "by_pair": "by pair",
    "other": "other sequences",
    "unseen": "unseen",
    "high": "high noise, by pair",
    "seen": "pairs seen",
    "width": "width; data",
    "reached": "minutes, processor, date",
}
"""What is shown of a row that was reached, and the heads of these columns."""


def trained(table: DocumentTable, results: dict[str, Texts]) -> list[str]:
    """Format the rows of a table of networks."""
    heads = ["row", "Almanza-Medina", "its high noise", *COLUMNS.values()]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for row in table.rows:
        printed = [row.format_errors(row.printed.get(noise)) for noise in ("none", "high")]
        texts = results.get(row.name, {"by_pair": "not trained yet"})
        lines.append(f"| {' | '.join([row.approach, *printed, *(texts.get(key, '-') for key in COLUMNS)])} |")
    return lines


def curve(run: Path) -> str:
    """Fit error = a pairs^-b to the validations of a training, and say where its schedule would end.

    The first third of the pairs is left out, where a network learns that there is a motion at all.
    """
    if not (run / "log.csv").is_file():
        raise MitsonarError(f"{run} holds no log.csv: give the folder of a training")
    with (run / "log.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file)]
    about = json.loads((run / "run.json").read_text(encoding="utf-8"))
    names = [name for name in list(rows[0])[6:] if not name.startswith("training ")]
    whole = about["steps"] * about["asked"]["recipe"]["batch"]
    lines = [f"{run.name}: {rows[-1]['pairs']} of {whole:,} pairs"]
    for name in names:
        both = np.array([(float(row["pairs"]), float(row[name])) for row in rows if row[name]])
        lines.append(f"  {name}: {fitted(both, whole)}")
    return "\n".join(lines)


def fitted(both: Array, whole: int) -> str:
    """Fit a power law to pairs seen and errors ``(n, 2)``, and extrapolate it."""
    late = both[both[:, 0] > both[-1, 0] / 3]
    if len(late) < 3:
        return "too few validations"
    seen, error = np.log(late).T
    slope, start = np.polyfit(seen, error, 1)
    return f"{both[-1, 1]:.3g} now, falls as pairs^{slope:.2f}, {np.exp(start) * whole**slope:.3g} after {whole:,}"


if __name__ == "__main__":
    try:
        main()
    except MitsonarError as fault:
        print(f"error: {fault}", file=sys.stderr)
        raise SystemExit(2) from None
