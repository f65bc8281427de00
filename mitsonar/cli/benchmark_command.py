"""``mitsonar benchmark``: methods of all kinds on sets that everybody can make."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsonar.cli.console import answered, progress_bar, say, say_json, warn
from mitsonar.cli.odometry_command import Geometry

__all__ = ["benchmarks", "odometry_benchmark"]


def benchmarks() -> typer.Typer:
    """Create the group of commands."""
    app = typer.Typer(help="Compare methods on sets that everybody can make.", no_args_is_help=True)
    app.command("odometry")(answered(odometry_benchmark, {"frames": "--frames"}))
    return app


def odometry_benchmark(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to make: table.md, table.json, rows.jsonl, sets, paths.")],
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="dive, rocks, slope, hull, or the path of a recording or a run; several times (default: those four). "
            "dive means 36 dives of six sonars; dive-aris3000 or dive-aris3000-gentle-3 picks some.",
        ),
    ] = None,
    texture: Annotated[
        list[str] | None, typer.Option(help="Of simulated sets: still or speckle; several times (default: both).")
    ] = None,
    noise: Annotated[
        list[str] | None, typer.Option(help="Of rocks, slope and hull: none, low or high; several times (default: none).")
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="zero, ecc, phase, flow, direct, corrnet, corrnet-coherent, cfar-gicp, fourier-mellin, stackreg, a "
            "checkpoint, or a class of yours as my_module:MyEstimator; several times (default: all; in speckle "
            "corrnet-coherent for corrnet)."
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(help="Frames of each set (default: 40 of a dive, 260 of another simulated set, all of a recording)."),
    ] = None,
    geometry: Geometry = None,
    bound: Annotated[int, typer.Option(min=0, help="Poses of the Cramer-Rao bound of simulated sets; 0: none.")] = 3,
    workers: Annotated[int, typer.Option(min=1, help="Number of processes that estimate.")] = 1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Add rows to a folder that is there; an interrupted row goes on.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a benchmark that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare methods of odometry: drift, errors of motions over their bound, failures and time, a row each.

    Simulated sets are rendered once into OUT and kept. Each row is written when it is made. The table holds all rows of OUT.
    """
    from mitsonar.mapping.odometry_benchmark import Wanted, benchmark_lines, benchmark_odometry

    asked = {"sets": set_, "textures": texture, "noises": noise, "methods": method}
    wanted = Wanted(
        **{name: tuple(words) for name, words in asked.items() if words}, frames=frames, geometry=geometry, bound=bound
    )
    report = benchmark_odometry(
        wanted,
        out,
        resume=resume,
        overwrite=overwrite,
        workers=workers,
        begin=lambda what, length: progress_bar(what, length, "parts"),
    )
    for sentence in report["notes"]:
        warn(sentence)
    if as_json:
        say_json(report, indent=1)
        return
    for line in benchmark_lines(report["rows"]):
        say(line)
    say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}")
