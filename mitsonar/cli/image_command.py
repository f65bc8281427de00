"""``mitsonar image``: bin stored echoes into new frames, without tracing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsonar.cli.console import answered, numbers, progress_bar, say, warn
from mitsonar.cli.flown_path import Frame
from mitsonar.cli.render_command import NOISE
from mitsonar.errors import MitsonarError, counted

__all__ = ["image"]


@answered
def image(
    run_folder: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of a run that was rendered with --exr.")],
    bins: Annotated[int | None, typer.Option(help="Number of range bins (default: as rendered).")] = None,
    window: Annotated[str | None, typer.Option("--range", help="Range window from,to [m] (default: as rendered).")] = None,
    noise: Annotated[str, typer.Option(help=f"{NOISE}.")] = "none",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder to make (default: OUT/rebinned).")] = None,
    cartesian: Annotated[bool, typer.Option("--cartesian", help="Draw each frame with axes in metres.")] = False,
    frame: Frame = "mitsonar",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Resume a stopped run.")] = False,
) -> None:
    """Bin the stored echoes of a run into new frames, with other bins, another window or other noise."""
    from mitsonar.acoustics.noise import load_noise
    from mitsonar.motion.trajectory import convention_named
    from mitsonar.simulation.runs import Outputs, StoredEchoes, run

    outputs = Outputs(load_noise(noise), cartesian=cartesian, frame=convention_named(frame).name)
    ends = numbers(window, 2, "--range")
    if ends and not 0 <= ends[0] < ends[1]:
        raise MitsonarError(f"--range takes from,to in m, the near end first: got {window}")
    source = StoredEchoes(run_folder, bins=bins, window=(ends[0], ends[1]) if ends else None)
    folder = out or run_folder / "rebinned"
    if run_folder.resolve().is_relative_to(folder.resolve()):
        raise MitsonarError(f"-o {folder} would replace the echoes that are read: choose another folder")
    origin = {"echoes_of": str(run_folder), "echoes_recipe": source.asked}
    with progress_bar("binning", len(source.trajectory), "pings") as progress:
        report = run(
            source, source.trajectory, folder, outputs, origin=origin, overwrite=overwrite, resume=resume, progress=progress
        )
    for sentence in report.warnings:
        warn(sentence)
    say(f"{counted(report.frames, 'frame')} of {counted(source.sonar.range_bins, 'bin')} in {folder}")
    if report.pictures:
        say(f"pictures: {report.pictures[0]}")
