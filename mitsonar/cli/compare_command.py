"""``mitsonar compare``: estimators on the same pairs of a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsonar.cli.console import answered, progress_bar, say, say_json, warn
from mitsonar.errors import counted

__all__ = ["compare"]


@answered
def compare(
    data: Annotated[str, typer.Argument(metavar="DATA.zarr", help="Path or URL of a data set.")],
    estimators: Annotated[
        str | None,
        typer.Option(
            help="Names of estimators or checkpoints of networks, separated by commas: NAME or NAME:key=value:key=value "
            "(default: all that need no training)."
        ),
    ] = None,
    noise: Annotated[
        str,
        typer.Option(
            help="Levels of noise, separated by commas (by ; if one is m,s,g): none, low, high, chapter2, a YAML file; for "
            "impulse responses signal-to-noise ratios: none,20 dB."
        ),
    ] = "none",
    part: Annotated[str | None, typer.Option(help="train, validation, test (default if the split has one) or all.")] = None,
    pairs: Annotated[int | None, typer.Option(min=2, help="Largest number of pairs, one a sequence.")] = None,
    perturb: Annotated[
        bool, typer.Option("--perturb", help="Add rows with wrong height, pitch, roll, sound speed and heave.")
    ] = False,
    jitter: Annotated[
        bool, typer.Option("--jitter", help="Add a row with jittered rays, which shows errors from the sampling pattern.")
    ] = False,
    prior: Annotated[
        bool, typer.Option("--prior", help="Add rows with a prior on the size of motions, as networks have.")
    ] = False,
    limit: Annotated[int, typer.Option(min=0, help="Number of pairs for the Cramer-Rao bound (images only); 0: none.")] = 10,
    reference: Annotated[
        str | None, typer.Option(help="Estimator that others are compared with (default: the last).")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise, choice of pairs and bootstrap.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Folder for estimates, table.md and table.json; a stopped run is resumed."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare estimators on the same pairs. Failures count as zero motion. Bootstrap by scene, then sequence."""
    from mitsonar.estimation.benchmark_tables import table_lines
    from mitsonar.estimation.comparison_run import Asked
    from mitsonar.estimation.comparison_run import compare as compared

    asked = Asked(estimators, noise, part, pairs, perturb, jitter, prior, limit, reference, seed)
    report = compared(data, asked, out, begin=lambda what, count: progress_bar(what, count, "pairs"))
    for sentence in report["notes"]:
        warn(sentence)
    if as_json:
        say_json(report, indent=1)
        return
    say(
        f"{data}: {counted(report['pairs'], 'pair')} of "
        f"{counted(report['scenes'], 'scene')}, {report['model']} model; sideways mm / forward mm / "
        "yaw deg"
    )
    for table in report["tables"]:
        for line in table_lines(table):
            say(line)
    if out is not None:
        say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}")
