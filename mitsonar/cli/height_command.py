"""``mitsonar height``: how high the sonar is over the ground in each frame, from the frames alone."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from mitsonar.cli.console import answered, progress_bar, say, warn
from mitsonar.cli.odometry_command import Frames
from mitsonar.errors import MitsonarError
from mitsonar.io.run_directory import refuse_to_replace
from mitsonar.io.whole_files import write_whole

if TYPE_CHECKING:
    from mitsonar.estimation.height.direct_height import HeightEstimate
    from mitsonar.mapping.frame_source import FrameSource
    from mitsonar.mapping.view_source import ViewSource

__all__ = ["height"]

AT_ONCE = 8
"""Frames that are read at a time."""


@answered
def height(
    frames: Frames,
    by: Annotated[str, typer.Option(help="direct, or a checkpoint that was trained on heights.")] = "direct",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="CSV file to write, a line a frame.")] = None,
    pitch_deg: Annotated[float | None, typer.Option(help="Pitch, > 0 looks down, for frames without poses.")] = None,
    sequence: Annotated[int | None, typer.Option(help="Of a data set (default: the longest).")] = None,
    view: Annotated[str | None, typer.Option(help="Of a data set (default: the first; of portions: whole, or all).")] = None,
    noise: Annotated[str, typer.Option(help="Added: none, low, high, m,s,g or a YAML file.")] = "none",
    seed: Annotated[int, typer.Option(min=0, help="Of that noise.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
) -> None:
    """Tell the height over the ground from first return and fall-off, or by a network; beside it the true one, where known.

    `mitsonar odometry --height-by` gives estimators the heights found like this.
    """
    from mitsonar.estimation.height.named_height_estimators import height_estimator_from
    from mitsonar.mapping.height_tables import heights_csv, heights_lines
    from mitsonar.mapping.measured_heights import measured
    from mitsonar.mapping.open_source import Reading, frames_for, views_for

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
            raise MitsonarError("--pitch-deg is for frames without poses: a data set tells them")
        source = views_for(frames, *portions, reading)
    else:
        source = frames_for(frames, reading)
    if source.note:
        say(source.note)
    said: list[HeightEstimate] = []
    with progress_bar("measuring", len(source), "frames") as progress:
        for first in range(0, len(source), AT_ONCE):
            here = np.arange(first, min(first + AT_ONCE, len(source)))
            said += measured(source.read(here), estimator)[1]
            progress(len(here))
    true = None if source.sonar_poses is None else source.sonar_poses[:, 2]
    if out is not None:
        write_whole(out, heights_csv(source.time_s, said, true).encode())
    for line in heights_lines(said, true):
        say(line)
    lost = sum(not one.valid for one in said)
    given = estimator.inputs if pitch_deg is None else f"pitch {pitch_deg:g} deg as told, which the frames cannot check"
    say(f"{len(said):,} frames by {by} ({given}), {lost:,} not believed" + (f", in {out}" if out is not None else ""))
    if lost == len(said):
        warn("no height was found: check the pitch, and that the window shows ground; frames need echoes that fall off")


def _portions(where: str, view: str | None) -> tuple[tuple[str, ...], str] | None:
    """Views and their kind, of a data set that holds vectors alone, or portions of a view; None elsewhere."""
    from mitsonar.config.data_recipe import array_names
    from mitsonar.datasets.store import DataStore
    from mitsonar.mapping.frame_source import is_data_set

    if not is_data_set(where):
        return None
    recipe = DataStore.open(where).recipe
    kind = "image" if "image" in recipe.kinds else "vector"
    if kind == "image" and not recipe.segments:
        return None
    names = tuple(name for stored, name in array_names(recipe).values() if stored == kind)
    return (view,) if view is not None else ("whole",) if "whole" in names else names, kind
