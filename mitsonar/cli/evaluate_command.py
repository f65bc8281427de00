"""``mitsonar evaluate``: the errors of a trained network on a data set."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mitsonar.cli.console import answered, progress_bar, say, say_json, warn
from mitsonar.errors import counted

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
            help="Levels of noise, separated by commas (by ; if one is m,s,g): none, low, high, a YAML file; for impulse "
            "responses none, 20 dB ... (default: none,low,high; for impulse responses none)."
        ),
    ] = None,
    part: Annotated[
        str | None, typer.Option(help="train, validation, test (default if the split has one) or all, split as in training.")
    ] = None,
    pairs: Annotated[int | None, typer.Option(min=1, help="Largest number of pairs, one a sequence.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Allow another sonar than that of training.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise, choice of pairs and bootstrap.")] = 0,
    batch: Annotated[int, typer.Option(min=1, help="Pairs at a time.")] = 16,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for table.md and table.json.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing tables.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Evaluate a trained network beside always answering zero. Bootstrap by scene, then sequence.

    `large` is the RMSE of motions beyond half the largest (10..20 mm of 20). Almanza-Medina prints yaw in
    deg/100.
    """
    checkpoint = checkpoint_from(run)
    from mitsonar.estimation.compare import FEWEST_SCENES
    from mitsonar.training.evaluate import evaluate as evaluated
    from mitsonar.training.evaluate import refuse_tables, report_lines, save_tables

    if out is not None:
        refuse_tables(out, overwrite=overwrite)
    levels = None if noise is None else list(dict.fromkeys(noise.split(";" if ";" in noise else ",")))
    with ExitStack() as bar:
        report = evaluated(
            checkpoint,
            data,
            noise=levels,
            part=part,
            pairs=pairs,
            force=force,
            seed=seed,
            batch=batch,
            begin=lambda count: bar.enter_context(progress_bar("evaluating", count, "pairs")),
        )
    report = {"run": run, **report}
    for sentence in report["notes"]:
        warn(sentence)
    if report["scenes"] < FEWEST_SCENES:
        warn(
            f"{counted(report['scenes'], 'scene')} only: the 95 % intervals are too narrow; evaluate on "
            f"{FEWEST_SCENES} or more"
        )
    lines = report_lines(report)
    if out is not None:
        save_tables(out, report)
    if as_json:
        say_json(report, indent=1)
        return
    for name, value in checkpoint.rows():
        say(f"{name:18} {value}")
    say("")
    for line in lines:
        say(line)
    if out is not None:
        say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}")


def checkpoint_from(run: str) -> Checkpoint:
    """Load the checkpoint that the command line names.

    Raises:
        MitsonarError: torch is missing, or there is no usable checkpoint.
    """
    from mitsonar.networks.checkpoint import Checkpoint

    return Checkpoint.load(run)
