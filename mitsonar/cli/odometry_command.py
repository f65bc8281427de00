"""``mitsonar odometry``: estimate the path of the sonar from its frames or impulse responses."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated

import typer

from mitsonar.cli.console import answered, numbers, progress_bar, say, warn
from mitsonar.cli.flown_path import SIX, Frame
from mitsonar.cli.render_command import NOISE
from mitsonar.errors import MitsonarError, counted

__all__ = ["Frames", "Geometry", "odometry"]

Frames = Annotated[
    str,
    typer.Argument(
        metavar="FRAMES|RUN|DATA.zarr", help="frames.npz, frames.zarr, a run's folder, a data set or a recording."
    ),
]
Geometry = Annotated[
    Path | None, typer.Option(help="YAML file that tells how the pictures of a recording are laid out.", dir_okay=False)
]
PAIRS_A_WORKER = 50
"""Smallest number of pairs that is worth a process."""


@answered
def odometry(
    frames: Annotated[
        str,
        typer.Argument(
            metavar="RUN|FRAMES|DATA.zarr|FILE",
            help="A run of frames or impulse responses, a data set of frames, or a recording of a real sonar.",
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to make: path, motions, table, figure.")],
    estimator: Annotated[
        str | None,
        typer.Option(
            help="zero, ecc, flow, phase, direct, corrnet, a checkpoint, or a class of your own as my_module:MyEstimator; "
            "NAME:key=value:key=value. Of several checkpoints, separated by commas, the one trained nearest to the height "
            "is used. For impulse responses: zero, correlation, likelihood, impulse-posenet. Default: direct, or likelihood."
        ),
    ] = None,
    smooth: Annotated[str, typer.Option(help="none, spline or kalman. Invalid motions are bridged in any case.")] = "none",
    scale: Annotated[str | None, typer.Option(help="Factors of sideways,forward,yaw, or `fit` to the true path.")] = None,
    every: Annotated[int, typer.Option(help="Step between the frames that are used.")] = 1,
    start: Annotated[str | None, typer.Option("--from", help=f"First pose: {SIX} (default: the true one, or 0).")] = None,
    frame: Frame = "mitsonar",
    height: Annotated[float | None, typer.Option(help="Height over the ground [m], for frames that lack it.")] = None,
    height_by: Annotated[
        str | None,
        typer.Option(help="Estimator of the height of each frame: direct, or a checkpoint that was trained on heights."),
    ] = None,
    pitch_deg: Annotated[float | None, typer.Option(help="Pitch [deg], > 0 is down, for frames without poses.")] = None,
    contrast: Annotated[
        str | None,
        typer.Option(
            help="What is matched: levels, local (contrast) or moving (local, less the mean of the run). Default: local for "
            "recordings that tell no height, levels for all others."
        ),
    ] = None,
    closure: Annotated[
        int | None,
        typer.Option(
            help="Motions over which loops are closed; covariances are raised to what they leave over. 0: none. Default: 8 "
            "with contrast, half the motions where there are fewer than 16, else 0."
        ),
    ] = None,
    sensors: Annotated[
        Path | None,
        typer.Option(
            help="CSV file of gyroscope, DVL, depth, compass or dead reckoning, columns by name with unit and noise, also "
            "beside the poses of a trajectory; or a ROS bag. They join with the frames in a pose graph.",
        ),
    ] = None,
    local_map: Annotated[
        bool,
        typer.Option(
            "--map",
            help="Register frames to a map of the last metres, not to the last frame alone: over rocks paths drift a "
            "seventh as far or less, without noise.",
        ),
    ] = False,
    loops: Annotated[
        bool, typer.Option("--loops", help="Search for places that are seen again, and close the path there.")
    ] = False,
    sequence: Annotated[
        int | None, typer.Option(help="Sequence of a data set, or part of a recording (default: the longest).")
    ] = None,
    view: Annotated[
        str | None, typer.Option(help="View of a data set, or topic of a ROS bag (default: the first, or the only one).")
    ] = None,
    geometry: Geometry = None,
    noise: Annotated[
        str,
        typer.Option(help=f"{NOISE}; for impulse responses a ratio such as '20 dB'."),
    ] = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of that noise.")] = 0,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Number of processes (default: by the number of pairs and cores).")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing odometry.")] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Resume a stopped odometry; options of the path may change.")
    ] = False,
) -> None:
    """Estimate the motion between consecutive frames, and integrate the path.

    OUT holds estimated.tum, true.tum if poses are known, motions.csv, covariances.npz, height_profile.csv if heights are
    measured, table.md, table.json, path.png, run.json, and estimates.jsonl, from which --resume continues. With --loops
    also loops.csv.
    """
    from mitsonar.estimation.named import create_estimator
    from mitsonar.mapping.odometry import loop_starts
    from mitsonar.mapping.odometry_run import run_odometry, table_lines
    from mitsonar.mapping.open_source import Reading, frames_for, open_source, record_at, usual_loop
    from mitsonar.mapping.sensors import open_sensors
    from mitsonar.motion.pose import Pose
    from mitsonar.records.frames import SonarFrames

    factors = scale if scale is None or scale == "fit" else numbers(scale, 3, "--scale (or fit)")
    first = numbers(start, 6, "--from")
    pitch = None if pitch_deg is None else math.radians(pitch_deg)
    reading = Reading(sequence, view, noise, seed, height, pitch, height_by, geometry, contrast)
    images = record_at(frames) is SonarFrames
    estimator = estimator or ("direct" if images else "likelihood")
    try:
        method = create_estimator(estimator)
    except MitsonarError:
        if images:
            frames_for(frames, reading)  # faults of the frames are reported first
        raise
    vehicle = None if sensors is None else open_sensors(sensors)
    source = open_source(frames, method, reading)
    if source.note:
        say(source.note)
    pairs = max(0, len(source) - 1) // max(1, every)
    processes = workers or max(1, min(len(os.sched_getaffinity(0)), pairs // PAIRS_A_WORKER))
    steps = usual_loop(source) if closure is None else closure
    closing = len(loop_starts(pairs, steps)) if steps > 1 else 0
    frames_mapped = pairs + 1 if local_map else 0
    with progress_bar("estimating", pairs + closing + frames_mapped, "pairs") as progress:
        found = run_odometry(
            source,
            estimator,
            method,
            out,
            smooth=smooth,  # type: ignore[arg-type]  # other words are refused there
            scale=factors,
            start=None if first is None else Pose.from_degrees(first),
            frame=frame,
            every=every,
            closure=steps,
            sensors=vehicle,
            loops=loops,
            local_map=local_map,
            workers=processes,
            overwrite=overwrite,
            resume=resume,
            progress=progress,
        )
    for line in table_lines(found.rows()):
        say(line)
    for sentence in found.warnings():
        warn(sentence)
    count, lost = len(found.estimates), int((~found.believed).sum())
    if found.graph is not None and found.graph.sensors:
        say(f"sensors: {', '.join(found.graph.sensors)}")
    say(f"{counted(count, 'motion')} by {estimator} ({method.inputs}), {lost} invalid and bridged, in {out}")
    say(f"picture: {out / 'path.png'}")
