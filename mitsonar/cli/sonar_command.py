"""``mitsonar sonar``: sonars from recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from mitsonar.cli.console import answered, changes_of, command_line, say, warn
from mitsonar.cli.odometry_command import Geometry
from mitsonar.io.files import write_whole
from mitsonar.io.runs import refuse_to_replace

if TYPE_CHECKING:
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.records.frames import SonarFrames

__all__ = ["fit", "from_recording", "sonars"]


def sonars() -> typer.Typer:
    """Create the group of commands."""
    app = typer.Typer(help="Make a sonar's file from what a real sonar recorded.", no_args_is_help=True)
    app.command()(fit)
    app.command("from-recording")(from_recording)
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
    from mitsonar.records.frames import SonarFrames

    refuse_to_replace(out, overwrite=overwrite)
    told = _told(sonar, changes)
    _fit_and_write(SonarFrames.load(frames), told, out, measure_coding=measure_coding)


@answered
def from_recording(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording of a real sonar, or frames.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="YAML file to write, for --sonar.")],
    noise: Annotated[
        Path | None, typer.Option(help="YAML file to write noise, water and grain to; default: they stand in OUT too.")
    ] = None,
    sonar: Annotated[
        str | None, typer.Option(help="Preset or YAML file of what the file does not tell: beam width, patterns.")
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A field that is known, frequency_hz=1.8e6 for one."),
    ] = None,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames from the middle that are read.")] = 12,
    part: Annotated[int | None, typer.Option(min=0, help="Part of the recording (default: the longest).")] = None,
    topic: Annotated[str | None, typer.Option(help="Topic of a ROS bag (default: the only one).")] = None,
    geometry: Geometry = None,
    measure_coding: Annotated[
        bool, typer.Option("--measure-coding", help="Take span [dB] or gamma from the grain, not from the frames.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
) -> None:
    """Make a sonar that records like the one of a recording: its window, bins and beams, and its fitted noise.

    `mitsonar render` and recipes of data sets take it by --sonar. With --noise the files are laid over one another:
    --sonar sonar.yaml,noise.yaml.
    """
    from mitsonar.estimation.sonar_fit import as_instrument
    from mitsonar.mapping.sources import open_frames

    for path in (out, noise):
        if path is not None:
            refuse_to_replace(path, overwrite=overwrite)
    told = _told(sonar, changes)
    source = open_frames(file, sequence=part, view=topic, geometry=geometry)
    first = max(0, (len(source) - frames) // 2)
    chosen, notes = as_instrument(source.read(range(first, min(first + frames, len(source)))))
    _fit_and_write(chosen, told, out, noise, notes, measure_coding=measure_coding)


class _Told(NamedTuple):
    """A sonar that fitting starts from, and fields that are known."""

    sonar: Sonar | None
    fields: dict[str, Any]  # pairs of a command line, which the sonar checks


def _told(sonar: str | None, changes: list[str] | None) -> _Told:
    """Return what the user tells: faults of it are reported before frames are read."""
    from mitsonar.instruments.sounder import load_sonar

    return _Told(None if sonar is None else load_sonar(sonar), dict(changes_of(changes or [], None)))


def _fit_and_write(
    frames: SonarFrames,
    told: _Told,
    out: Path,
    noise: Path | None = None,
    notes: Sequence[str] = (),
    *,
    measure_coding: bool,
) -> None:
    """Fit a sonar to frames, write it to OUT, or its noise to another file, and say what was found."""
    from mitsonar.estimation.sonar_fit import NOISE_FIELDS, fit_sonar

    found = fit_sonar(frames, told.sonar, measure_coding=measure_coding, **told.fields)
    if noise is None:
        write_whole(out, found.yaml().encode())
    else:
        write_whole(out, found.yaml(leave=NOISE_FIELDS).encode())
        write_whole(noise, found.yaml(only=NOISE_FIELDS).encode())
    for line in found.lines():
        say(line)
    for note in (*notes, *found.notes):
        warn(note)
    say(f"{out}: {command_line('render', 'SCENE', '--sonar', out if noise is None else f'{out},{noise}')}")
