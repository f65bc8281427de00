"""``mitsonar odometry``: frames become the path that the sonar took."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitsonar.cli.console import answered, numbers, progress_bar, say, warn
from mitsonar.cli.render_command import SIX
from mitsonar.errors import MitsonarError

if TYPE_CHECKING:
    from mitsonar.mapping.frame_source import FrameSource
    from mitsonar.mapping.odometry import Method, Source
    from mitsonar.mapping.view_source import ViewSource

__all__ = ["Frames", "frames_from", "odometry", "views_from"]

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
    from mitsonar.mapping.odometry_run import run_odometry, table_lines
    from mitsonar.mapping.response_source import holds_responses
    from mitsonar.motion.pose import Pose

    factors = scale if scale is None or scale == "fit" else numbers(scale, 3, "--scale (or fit)")
    first = numbers(start, 6, "--from")
    source: Source
    method: Method
    if holds_responses(frames):
        if any(option is not None for option in (sequence, view, pitch_deg, height_by)):
            raise MitsonarError(
                "--sequence, --view, --height-by and --pitch-deg belong to frames; impulse responses have none of them"
            )
        estimator = estimator or "likelihood"
        source, method = _responses(frames, estimator, noise, seed, height)
    else:
        from mitsonar.estimation.named_estimators import estimator_from

        estimator = estimator or "direct"
        try:
            method = estimator_from(estimator)
        except MitsonarError:
            frames_from(frames, sequence, view, noise, seed, height, pitch_deg)  # what is wrong with them is said first
            raise
        views, kind = getattr(method, "views", None), getattr(method, "kind", "image")
        if views is not None:
            if any(option is not None for option in (view, height, pitch_deg)):
                raise MitsonarError("--view, --height and --pitch-deg are not for a network that reads views of a data set")
            seen: FrameSource | ViewSource = views_from(frames, views, kind, sequence, noise, seed)
        else:
            if height is not None and height_by is not None:
                raise MitsonarError("--height tells the height and --height-by measures it: give one of them")
            seen = frames_from(frames, sequence, view, noise, seed, height, pitch_deg)
        if height_by is not None:
            from mitsonar.estimation.height.named_height_estimators import height_estimator_from

            seen = seen.with_heights_by(height_estimator_from(height_by))
        source = seen
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


def _responses(where: str, estimator: str, noise: str, seed: int, height: float | None) -> tuple[Source, Method]:
    """Impulse responses and their estimator."""
    from mitsonar.estimation.channel.named_channel_estimators import impulse_estimator_from
    from mitsonar.mapping.response_source import open_responses

    return open_responses(where).told(noise, seed, height), impulse_estimator_from(estimator)


def views_from(where: str, views: tuple[str, ...], kind: str, sequence: int | None, noise: str, seed: int) -> ViewSource:
    """The views of a data set that a network reads.

    Raises:
        MitsonarError: none there.
    """
    from mitsonar.acoustics.noise import load_noise
    from mitsonar.mapping.view_source import open_views

    return open_views(where, views, kind, sequence=sequence).with_noise(load_noise(noise), seed)


def frames_from(
    where: str,
    sequence: int | None,
    view: str | None,
    noise: str,
    seed: int,
    height: float | None,
    pitch_deg: float | None,
) -> FrameSource:
    """The frames that the options say.

    Raises:
        MitsonarError: none there, or options that do not fit them.
    """
    import math

    from mitsonar.acoustics.noise import load_noise
    from mitsonar.mapping.frame_source import open_frames

    added = load_noise(noise)
    source = open_frames(where, sequence=sequence, view=view)
    if not len(source):
        raise MitsonarError(f"{source.name} holds no frames: give those of a finished run")
    return source.with_noise(added, seed).with_geometry(height, None if pitch_deg is None else math.radians(pitch_deg))
