"""``mitsonar evaluate``: the errors of a trained network on a data set."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitsonar.cli.console import answered, progress_bar, say, warn

if TYPE_CHECKING:
    from mitsonar.networks.checkpoint import Checkpoint

__all__ = ["Run", "checkpoint_from", "evaluate"]

Run = Annotated[str, typer.Argument(metavar="RUN", help="Folder of a training, a checkpoint, or corrnet.")]


@answered
def evaluate(
    run: Run,
    data: Annotated[str, typer.Argument(metavar="DATA.zarr", help="Path or URL of a data set.")],
    noise: Annotated[
        str | None,
        typer.Option(
            help="Levels with commas between them (or ; where one is m,s,g): none, low, high, a YAML file; of impulse "
            "responses none, 20 dB ... Default: none,low,high; of responses none."
        ),
    ] = None,
    part: Annotated[
        str | None, typer.Option(help="train, validation, test (default where it is), all; dealt out as in training.")
    ] = None,
    pairs: Annotated[int | None, typer.Option(min=1, help="At most so many, each of a sequence of its own.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Also with another sonar than that of training.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of noise, choice of pairs and bootstrap.")] = 0,
    batch: Annotated[int, typer.Option(min=1, help="Pairs at a time.")] = 16,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for table.md and table.json.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace tables that are there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print for programs.")] = False,
) -> None:
    """Errors of a trained network beside always answering zero; bootstrap by scene, then sequence.

    `large` is the RMSE of motions beyond half the largest (10..20 mm of 20), `as in the thesis` has yaw in 1/100 deg.
    """
    checkpoint = checkpoint_from(run)
    from mitsonar.estimation.benchmark_tables import FEWEST_SCENES
    from mitsonar.training.evaluation import evaluate as evaluated
    from mitsonar.training.evaluation_tables import refuse_tables, report_lines, save_tables

    if out is not None:
        refuse_tables(out, overwrite=overwrite)
    levels = None if noise is None else list(dict.fromkeys(noise.split(";" if ";" in noise else ",")))
    words: dict[str, Any] = {"part": part, "pairs": pairs, "force": force, "seed": seed, "batch": batch}
    with ExitStack() as bar:
        report = evaluated(
            checkpoint,
            data,
            noise=levels,
            **words,
            begin=lambda count: bar.enter_context(progress_bar("evaluating", count, "pairs")),
        )
    report = {"run": run, **report}
    for sentence in report["notes"]:
        warn(sentence)
    if report["scenes"] < FEWEST_SCENES:
        warn(f"{report['scenes']} scenes only: the 95 % intervals are too narrow; evaluate on {FEWEST_SCENES} or more")
    lines = report_lines(report)
    if out is not None:
        save_tables(out, report)
    if as_json:
        say(json.dumps(report, indent=1))
        return
    for name, value in checkpoint.rows():
        say(f"{name:18} {value}")
    say("")
    for line in lines:
        say(line)
    if out is not None:
        say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}")


def checkpoint_from(run: str) -> Checkpoint:
    """The checkpoint that the command line names.

    Raises:
        MitsonarError: no torch, or no checkpoint there that can be used.
    """
    from mitsonar.networks.checkpoint import Checkpoint

    return Checkpoint.load(run)
