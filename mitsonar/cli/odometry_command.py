"""``mitsonar odometry``: frames become the path that the sonar took."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Any

import typer

from mitsonar.cli.console import answered, numbers, progress_bar, say, warn
from mitsonar.cli.render_command import SIX, Frame
from mitsonar.errors import MitsonarError

__all__ = ["Frames", "odometry"]

Frames = Annotated[
    str, typer.Argument(metavar="FRAMES|RUN|DATA.zarr", help="frames.npz, frames.zarr, a run's folder, or a data set.")
]
PAIRS_A_WORKER = 50
"""Fewer do not pay for starting a process."""


@answered
def odometry(
    frames: Annotated[
        str,
        typer.Argument(
            metavar="RUN|FRAMES|DATA.zarr", help="A run of frames or impulse responses, or a data set of frames."
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to make: path, motions, table, figure.")],
    estimator: Annotated[
        str | None,
        typer.Option(
            help="zero, ecc, flow, phase, direct, corrnet, or a network's checkpoint; NAME:key=value:key=value; several "
            "checkpoints with commas: the one trained nearest to the height; of impulse responses: zero, correlation, "
            "likelihood."
        ),
    ] = None,
    smooth: Annotated[
        str, typer.Option(help="none, spline or kalman; motions that are not believed are bridged anyway.")
    ] = "none",
    scale: Annotated[str | None, typer.Option(help="Factors for sideways,forward,yaw, or `fit` to the true path.")] = None,
    every: Annotated[int, typer.Option(help="Use every so many frames only.")] = 1,
    start: Annotated[str | None, typer.Option("--from", help=f"First pose: {SIX} (default: the true one, or 0).")] = None,
    frame: Frame = "mitsonar",
    height: Annotated[float | None, typer.Option(help="Over the ground [m], for frames that lack it.")] = None,
    height_by: Annotated[
        str | None, typer.Option(help="Measure it in each frame: direct, or a checkpoint that was trained on heights.")
    ] = None,
    pitch_deg: Annotated[float | None, typer.Option(help="Pitch, > 0 looks down, for frames without poses.")] = None,
    sequence: Annotated[int | None, typer.Option(help="Of a data set (default: the longest).")] = None,
    view: Annotated[str | None, typer.Option(help="Of a data set (default: the first).")] = None,
    noise: Annotated[
        str, typer.Option(help="Added: none, low, high, m,s,g or a YAML file; to impulse responses a ratio such as '20 dB'.")
    ] = "none",
    seed: Annotated[int, typer.Option(min=0, help="Of that noise.")] = 0,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes (default: as many as pay, up to the cores).")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an odometry that is there.")] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with one that was broken off; path options may change.")
    ] = False,
) -> None:
    """Estimate the motion between all consecutive frames and drive the path that they tell.

    Writes into OUT: estimated.tum, true.tum where poses are known, motions.csv, covariances.npz, table.md, table.json,
    path.png, run.json, and estimates.jsonl, from which --resume goes on.
    """
    from mitsonar.estimation.named_estimators import estimator_from
    from mitsonar.mapping.odometry_run import run_odometry, table_lines
    from mitsonar.mapping.open_source import Reading, frames_for, open_source, record_at
    from mitsonar.motion.pose import Pose
    from mitsonar.records.sonar_frames import SonarFrames

    factors = scale if scale is None or scale == "fit" else numbers(scale, 3, "--scale (or fit)")
    first = numbers(start, 6, "--from")
    pitch = None if pitch_deg is None else math.radians(pitch_deg)
    reading = Reading(sequence, view, noise, seed, height, pitch, height_by)
    images = record_at(frames) is SonarFrames
    estimator = estimator or ("direct" if images else "likelihood")
    try:
        method = estimator_from(estimator)
    except MitsonarError:
        if images:
            frames_for(frames, reading)  # what is wrong with them is said first
        raise
    source = open_source(frames, method, reading)
    if source.note:
        say(source.note)
    pairs = max(0, len(source) - 1) // max(1, every)
    crew = workers or max(1, min(len(os.sched_getaffinity(0)), pairs // PAIRS_A_WORKER))
    words: dict[str, Any] = {
        "smooth": smooth,
        "scale": factors,
        "start": None if first is None else Pose.from_degrees(first),
    }
    with progress_bar("estimating", pairs, "pairs") as progress:
        found = run_odometry(
            source,
            estimator,
            method,
            out,
            **words,
            frame=frame,
            every=every,
            workers=crew,
            overwrite=overwrite,
            resume=resume,
            progress=progress,
        )
    for line in table_lines(found.rows()):
        say(line)
    for sentence in found.warnings():
        warn(sentence)
    count, lost = len(found.estimates), int((~found.believed).sum())
    say(f"{count:,} motions by {estimator} ({method.inputs}), {lost} not believed and bridged, in {out}")
    say(f"picture: {out / 'path.png'}")
