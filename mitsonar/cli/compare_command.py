"""``mitsonar compare``: estimators side by side on the same pairs of a data set."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from mitsonar.cli.console import answered, progress_bar, say, warn

__all__ = ["compare"]


@answered
def compare(
    data: Annotated[str, typer.Argument(metavar="DATA.zarr", help="Path or URL of a data set.")],
    estimators: Annotated[
        str | None,
        typer.Option(
            help="Names, or checkpoints of networks, with commas between them, each NAME or NAME:key=value:key=value "
            "(default: all that need no training)."
        ),
    ] = None,
    noise: Annotated[
        str,
        typer.Option(
            help="Levels with commas between them (or ; where one is m,s,g): none, low, high, chapter2, a YAML file; of "
            "impulse responses ratios: none,20 dB."
        ),
    ] = "none",
    part: Annotated[str | None, typer.Option(help="train, validation, test (default where it is), all.")] = None,
    pairs: Annotated[int | None, typer.Option(min=2, help="At most so many, each of a sequence of its own.")] = None,
    perturb: Annotated[
        bool, typer.Option("--perturb", help="Rows with wrong height, pitch, roll, sound speed, heave.")
    ] = False,
    jitter: Annotated[
        bool, typer.Option("--jitter", help="A row with rays that move: is it the sampling's pattern?")
    ] = False,
    prior: Annotated[bool, typer.Option("--prior", help="Rows that know how large motions are, as networks do.")] = False,
    limit: Annotated[
        int, typer.Option(min=0, help="Pairs over which the physical limit is computed; 0: none (of images only).")
    ] = 10,
    reference: Annotated[str | None, typer.Option(help="Method that others are compared with (default: the last).")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of noise, choice of pairs and bootstrap.")] = 0,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for answers, table.md and table.json; goes on.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print for programs.")] = False,
) -> None:
    """Errors of all methods on the same pairs; failures count as zero motion; bootstrap by scene, then sequence."""
    from mitsonar.estimation.benchmark_tables import table_lines
    from mitsonar.estimation.comparison_run import Asked
    from mitsonar.estimation.comparison_run import compare as compared

    asked = Asked(estimators, noise, part, pairs, perturb, jitter, prior, limit, reference, seed)
    report = compared(data, asked, out, begin=lambda what, count: progress_bar(what, count, "pairs"))
    for sentence in report["notes"]:
        warn(sentence)
    if as_json:
        say(json.dumps(report, indent=1))
        return
    say(
        f"{data}: {report['pairs']} pairs of {report['scenes']} scenes, {report['model']} model; sideways mm / forward mm / "
        "yaw deg"
    )
    for table in report["tables"]:
        for line in table_lines(table):
            say(line)
    if out is not None:
        say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}")
