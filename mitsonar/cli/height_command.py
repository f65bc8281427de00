"""``mitsonar height``: estimate the height over the ground of each frame, from the frames alone."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from mitsonar.cli.console import answered, progress_bar, say, warn
from mitsonar.cli.odometry_command import Frames
from mitsonar.cli.render_command import NOISE
from mitsonar.errors import MitsonarError, counted
from mitsonar.io.files import write_whole
from mitsonar.io.runs import refuse_to_replace

if TYPE_CHECKING:
    from mitsonar.estimation.height import HeightEstimate
    from mitsonar.mapping.open_source import ViewSource
    from mitsonar.mapping.sources import FrameSource

__all__ = ["height"]

AT_ONCE = 8
"""Number of frames that are read at a time."""


@answered
def height(
    frames: Frames,
    by: Annotated[str, typer.Option(help="Estimator: direct, or a checkpoint that was trained on heights.")] = "direct",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="CSV file to write, one line a frame.")] = None,
    pitch_deg: Annotated[float | None, typer.Option(help="Pitch [deg], > 0 is down, for frames without poses.")] = None,
    sequence: Annotated[int | None, typer.Option(help="Sequence of a data set (default: the longest).")] = None,
    view: Annotated[
        str | None, typer.Option(help="View of a data set (default: the first; of portions: whole, or all).")
    ] = None,
    noise: Annotated[str, typer.Option(help=f"{NOISE}.")] = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of that noise.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Estimate the height over the ground from first return and fall-off, or by a network, and compare it with the truth.

    `mitsonar odometry --height-by` passes such heights to the estimators of motion.
    """
    from mitsonar.estimation.height import height_estimator_from
    from mitsonar.mapping.odometry_benchmark import heights_csv, heights_lines
    from mitsonar.mapping.open_source import Reading, frames_for, views_for
    from mitsonar.mapping.sources import measured

    if out is not None:
        refuse_to_replace(out, overwrite=overwrite)
    estimator = height_estimator_from(by)
    source: FrameSource | ViewSource
    pitch = None if pitch_deg is None else math.radians(pitch_deg)
    reading = Reading(sequence, view, noise, seed, pitch_rad=pitch)
    portions = _portions(frames, view) if estimator.views is None else (estimator.views, estimator.kind)
    if estimator.views is not None and view is not None:
        raise MitsonarError(f"--view is not for {by}, which reads {', '.join(estimator.views)}: leave it out")
    if portions is not None:
        if pitch_deg is not None:
            raise MitsonarError("--pitch-deg is for frames without poses: a data set has poses")
        source = views_for(frames, *portions, reading)
    else:
        source = frames_for(frames, reading)
    if source.note:
        say(source.note)
    estimates: list[HeightEstimate] = []
    with progress_bar("measuring", len(source), "frames") as progress:
        for first in range(0, len(source), AT_ONCE):
            here = np.arange(first, min(first + AT_ONCE, len(source)))
            estimates += measured(source.read(here), estimator)[1]
            progress(len(here))
    true = None if source.sonar_poses is None else source.sonar_poses[:, 2]
    if out is not None:
        write_whole(out, heights_csv(source.time_s, estimates, true).encode())
    for line in heights_lines(estimates, true):
        say(line)
    lost = sum(not one.valid for one in estimates)
    given = (
        estimator.inputs
        if pitch_deg is None
        else f"pitch {pitch_deg:g} deg from the command line, which the frames cannot verify"
    )
    say(
        f"{counted(len(estimates), 'frame')} by {by} ({given}), {lost:,} invalid"
        + (f", in {out}" if out is not None else "")
    )
    if lost == len(estimates):
        warn(
            "no height was found: check the pitch, and that the window shows ground; the estimate needs echoes that fall off"
        )


def _portions(where: str, view: str | None) -> tuple[tuple[str, ...], str] | None:
    """Return views and their kind, of a data set of vectors alone or of portions of a view; else None."""
    from mitsonar.config.data import array_names
    from mitsonar.datasets.store import DataStore
    from mitsonar.mapping.sources import is_data_set

    if not is_data_set(where):
        return None
    recipe = DataStore.open(where).recipe
    kind = "image" if "image" in recipe.kinds else "vector"
    if kind == "image" and not recipe.segments:
        return None
    names = tuple(name for stored, name in array_names(recipe).values() if stored == kind)
    return (view,) if view is not None else ("whole",) if "whole" in names else names, kind
