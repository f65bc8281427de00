"""``mitsonar compare``: estimators on the same pairs of a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsonar.cli.console import answered, progress_bar, say, say_json, warn

__all__ = ["compare"]


@answered
def compare(
    data: Annotated[str, typer.Argument(metavar="DATA.zarr", help="Path or URL of a data set.")],
    estimators: Annotated[
        str | None,
        typer.Option(
            help="Names of estimators, checkpoints of networks, or classes of your own (my_module:MyEstimator), separated "
            "by commas; NAME:key=value:key=value gives options (default: all that need no training)."
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
    split: Annotated[
        str | None,
        typer.Option(help="sequence, scene or sample (default: that of the networks' training, else of the data set)."),
    ] = None,
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
    from mitsonar.estimation.compare import compare as compared

    found = compared(
        data,
        estimators,
        noise=noise,
        part=part,
        split=split,
        pairs=pairs,
        perturb=perturb,
        jitter=jitter,
        prior=prior,
        limit=limit,
        reference=reference,
        seed=seed,
        out=out,
        begin=lambda what, count: progress_bar(what, count, "pairs"),
    )
    for sentence in found.notes:
        warn(sentence)
    if as_json:
        say_json(found.report, indent=1)
        return
    for line in found.to_markdown().splitlines():
        say(line)
    if out is not None:
        say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}")
