"""Tables of an evaluation: as Markdown, and as files in a folder."""

from __future__ import annotations

from pathlib import Path

from mitsonar.errors import MitsonarError
from mitsonar.estimation.compare import markdown
from mitsonar.io.files import write_json, write_whole
from mitsonar.io.runs import refuse_to_replace
from mitsonar.training.training_types import JsonObject

__all__ = ["refuse_tables", "report_lines", "save_tables"]

COLUMNS = (
    *("method", "RMSE", "RMSE, mm / mm / deg/100", "95 % interval", "median", "95 %", "slope", "bias", "large"),
    *("skill", "nees", "ms", "inputs"),
)


def report_lines(report: JsonObject) -> list[str]:
    """Format the tables of :func:`mitsonar.training.evaluation.evaluate` as Markdown."""
    units = "height mm" if len(report["names"]) == 1 else "sideways mm / forward mm / yaw deg"
    units = units.removesuffix(" / yaw deg") if len(report["names"]) == 2 else units
    lines = [
        f"{report['data']} ({report['recipe']}), part {report['part']} by {report['split']}: {report['pairs']} samples of "
        f"{report['scenes']} scenes, {report['model']} model; {units}"
    ]
    for table in report["tables"]:
        beyond = table["beyond"]
        lines += ["", f"noise {table['noise']}", "", *markdown(table["rows"], COLUMNS), ""]
        lines.append(
            f"beyond the targets of training: {beyond['true']:.1%} of the samples, {beyond['answers']:.1%} of the answers  "
        )
        known = [f"{axes} {'-' if value is None else f'{value:.2f}'}" for axes, value in table["correlations"].items()]
        if known:
            lines.append(f"correlations of errors: {', '.join(known)}  ")
    return lines


def refuse_tables(out: Path, *, overwrite: bool) -> None:
    """Refuse to replace the tables in a folder without ``overwrite``.

    Raises:
        MitsonarError: the folder holds tables, or the path is a file.
    """
    if out.exists() and not out.is_dir():
        raise MitsonarError(f"-o is a folder: got the file {out}")
    refuse_to_replace(out / "table.md", out / "table.json", overwrite=overwrite)


def save_tables(out: Path, report: JsonObject) -> None:
    """Write ``table.md`` and ``table.json``. The folder is created."""
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / "table.md", ("\n".join(report_lines(report)) + "\n").encode())
    write_json(out / "table.json", report)
