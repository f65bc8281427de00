"""``mitsonar sonar``: sonars from recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsonar.cli.console import answered, changes_of, command_line, say, warn
from mitsonar.io.run_directory import refuse_to_replace
from mitsonar.io.whole_files import write_whole

__all__ = ["fit", "sonars"]


def sonars() -> typer.Typer:
    """Create the group of commands."""
    app = typer.Typer(help="Make a sonar's file from what a real sonar recorded.", no_args_is_help=True)
    app.command()(fit)
    app.callback()(lambda: None)  # a group stays a group with one command
    return app


@answered
def fit(
    frames: Annotated[Path, typer.Argument(help="Frames of the sonar: frames.npz, or a run's folder.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="YAML file to write, for --sonar.")],
    sonar: Annotated[
        str | None,
        typer.Option(help="Preset or YAML file of what frames do not tell: carrier, beam width, patterns."),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A field that is known, frequency_hz=1.8e6 for one."),
    ] = None,
    measure_coding: Annotated[
        bool, typer.Option("--measure-coding", help="Take span [dB] or gamma from the grain, not from the frames.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Fit noise, water, coding, stripes, crosstalk and speckle to a recording, and write a sonar that the simulator reads.

    Give frames of a resting or slow sonar whose darkest parts, shadows or black water, are noise. Bright speckle
    that is new in every frame counts as volume scattering: that holds for a sonar that rests.
    """
    from mitsonar.estimation.sonar_fit import fit_sonar
    from mitsonar.instruments.named_sonars import load_sonar
    from mitsonar.records.sonar_frames import SonarFrames

    refuse_to_replace(out, overwrite=overwrite)
    known = changes_of(changes or [], None)
    base = None if sonar is None else load_sonar(sonar)
    found = fit_sonar(SonarFrames.load(frames), base, measure_coding=measure_coding, **known)
    write_whole(out, found.yaml().encode())
    for line in found.lines():
        say(line)
    for note in found.notes:
        warn(note)
    say(f"{out}: {command_line('render', 'SCENE', '--sonar', out)}")
