"""``mitsonar recording``: look at recordings of real sonars and at runs, and convert them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from mitsonar.cli.console import answered, progress_bar, say, say_json, warn
from mitsonar.cli.odometry_command import Geometry
from mitsonar.errors import MitsonarError, counted, nearest_names
from mitsonar.io.runs import refuse_to_replace

if TYPE_CHECKING:
    from mitsonar.recordings.recording import Part, Recording
    from mitsonar.records.frames import SonarFrames

__all__ = ["convert", "info", "recordings", "show", "video"]

File = Annotated[
    str, typer.Argument(metavar="FILE|RUN", help="A recording of a sonar, frames.npz, frames.zarr or a run's folder.")
]
PartNumber = Annotated[int | None, typer.Option("--part", help="Part of the recording (default: the longest).")]
TopicName = Annotated[str | None, typer.Option("--topic", help="Topic of a ROS bag (default: the only sonar's).")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]
Span = Annotated[float, typer.Option("--span-db", help="Levels from full scale down that are shown [dB].")]


def recordings() -> typer.Typer:
    """Create the group of commands."""
    app = typer.Typer(help="Look at recordings of real sonars and at runs, and convert them.", no_args_is_help=True)
    for command in (
        info,
        show,
        video,
        answered(convert, {"beams": "--beams", "crop_bins": "--crop-bins", "crop_beams": "--crop-beams"}),
    ):
        app.command()(command)
    return app


@answered
def info(
    file: File,
    topic: TopicName = None,
    geometry: Geometry = None,
    handedness: Annotated[
        bool,
        typer.Option("--handedness", help="Tell whether pictures are mirrored, by the compass or poses."),
    ] = False,
    turn_deg: Annotated[
        float | None,
        typer.Option(help="Turn from the first to the last frame [deg], > 0 to starboard, without a compass."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print what a recording holds: frames, parts, window, beams, rate, times, gaps, attitude, facts and notes."""
    from mitsonar.recordings.handedness import handedness_of
    from mitsonar.recordings.open import summary_lines, summary_of

    recording = _opened(file, topic, geometry)
    summary = summary_of(recording)
    found = None
    if handedness or turn_deg is not None:
        found = handedness_of(recording.part(), None if turn_deg is None else math.radians(turn_deg))
    if as_json:
        told = {} if found is None else {"handedness": found._asdict()}
        say_json({**summary, **told})
        return
    for line in summary_lines(summary):
        say(line)
    if found is not None:
        why = f" ({found.reason})" if found.reason else ""
        say(
            f"handedness             {found.verdict}{why}: "
            f"correlation {found.correlation:.2f} over {counted(found.pairs, 'pair')}"
        )


@answered
def show(
    file: File,
    out: Annotated[Path, typer.Option("-o", "--out", help="PNG to write.")],
    frame: Annotated[int, typer.Option(min=0, help="Number of the frame in its part.")] = 0,
    part: PartNumber = None,
    topic: TopicName = None,
    geometry: Geometry = None,
    span_db: Span = 60.0,
    overwrite: Overwrite = False,
) -> None:
    """Draw one frame as a fan with axes in metres and a colour bar in dB."""
    from mitsonar.plotting.fans import coded_in_decibels, save_fan

    refuse_to_replace(out, overwrite=overwrite)
    recording = _opened(file, topic, geometry)
    frames = coded_in_decibels(recording.part(part).read([frame]), span_db)
    save_fan(out, frames, title=f"{Path(file).name}, frame {frame}")
    say(f"picture: {out}")


@answered
def video(
    file: File,
    out: Annotated[Path, typer.Option("-o", "--out", help="MP4 or AVI to write.")],
    part: PartNumber = None,
    topic: TopicName = None,
    geometry: Geometry = None,
    span_db: Span = 60.0,
    rate: Annotated[float | None, typer.Option(help="Frames a second (default: those of the recording).")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write the frames as a video of fans."""
    from mitsonar.plotting.fans import write_fan_video

    recording = _opened(file, topic, geometry)
    _say_notes(recording)
    chosen = recording.part(part)
    steps = np.diff(chosen.time_s)
    found = 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else 10.0
    if rate is not None and not 0 < rate <= 1000:
        raise MitsonarError(f"--rate must lie in 0..1000 a second: got {rate:g}")
    with progress_bar("drawing", len(chosen), "frames") as progress:
        speed = rate or min(1000.0, found)
        count = write_fan_video(chosen.chunks(), out, speed, span_db=span_db, overwrite=overwrite, progress=progress)
    say(f"{counted(count, 'frame')} at {speed:.4g} a second in {out}")


def convert(
    file: File,
    out: Annotated[Path, typer.Option("-o", "--out", help="FOLDER of a run, FILE.mcap or FILE.aris to make.")],
    part: PartNumber = None,
    topic: TopicName = None,
    geometry: Geometry = None,
    picture: Annotated[str, typer.Option(help="Format of the fans in an MCAP file: jpeg or png.")] = "jpeg",
    full: Annotated[
        bool, typer.Option("--full", help="MCAP: samples bit for bit, float32 where they are, and labels (default: 8 bit).")
    ] = False,
    labels: Annotated[bool, typer.Option("--labels", help="MCAP: the points of the labels, where there are.")] = False,
    beams: Annotated[
        int | None, typer.Option(help="Beams of an ARIS file: 48, 64, 96 or 128 (default: those of the frames).")
    ] = None,
    crop_bins: Annotated[
        str | None, typer.Option("--crop-bins", help="Bins to keep: first,end, numbered from 0, the end not counted.")
    ] = None,
    crop_beams: Annotated[str | None, typer.Option("--crop-beams", help="Beams to keep, likewise, from port.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Resume a stopped conversion to a folder.")] = False,
) -> None:
    """Convert frames to the folder of a run (frames.npz, or frames.zarr of more than 1,000), to ROS (.mcap) or to .aris."""
    from mitsonar.recordings.pictures import write_frames
    from mitsonar.recordings.write_mcap import write_mcap

    if out.suffix and out.suffix not in (".mcap", ".aris") and not out.is_dir():
        raise MitsonarError(f"{out}: unknown ending; {nearest_names(out.suffix, ['.mcap', '.aris', 'none for a folder'])}")
    if (full or labels) and out.suffix != ".mcap":
        raise MitsonarError(f"--full and --labels are of MCAP files: got {out}; leave them out")
    if resume and out.suffix:
        raise MitsonarError("--resume is for folders: files are whole or absent")
    recording = _opened(file, topic, geometry)
    _say_notes(recording)
    chosen = recording.part(part)
    spans = [None if text is None else _span(text, option) for text, option in ((crop_bins, "bins"), (crop_beams, "beams"))]
    if len(recording.parts) > 1:
        number = recording.longest if part is None else part
        say(f"part {number} of {len(recording.parts):,}: {len(chosen):,} of {counted(len(recording), 'frame')}")
    if any(spans):
        chosen = chosen.cropped(*spans)
        # a resumed conversion compares formats, so that it does not go on with another crop
        crop = ", ".join(f"{what} {text}" for what, text in (("bins", crop_bins), ("beams", crop_beams)) if text)
        recording, part = replace(recording, format=f"{crop} of {recording.format}", parts=(chosen,)), None
    made = out
    with progress_bar("converting", len(chosen), "frames") as progress:
        if out.suffix == ".mcap":
            words = {"picture": picture, "full": full, "labels": labels, "overwrite": overwrite}
            write_mcap(chosen.chunks(), out, **words, progress=progress)  # type: ignore[arg-type]
        elif out.suffix == ".aris":
            _to_aris(chosen, out, beams=beams, overwrite=overwrite, progress=progress)
        else:
            made = write_frames(recording, part, out, overwrite=overwrite, resume=resume, progress=progress)
    say(f"{counted(len(chosen), 'frame')} in {made}")


def _span(text: str, what: str) -> tuple[int, int]:
    """Return the numbers of a span.

    Raises:
        MitsonarError: something else than two whole numbers.
    """
    words = text.split(",")
    if len(words) != 2 or not all(word.strip().isdecimal() for word in words):
        raise MitsonarError(f"--crop-{what} is two whole numbers, first,end, such as 0,512: got {text!r}")
    return int(words[0]), int(words[1])


def _opened(file: str, topic: str | None, geometry: Path | None) -> Recording:
    from mitsonar.mapping.sources import recording_at

    return recording_at(file, view=topic, geometry=geometry)


def _say_notes(recording: Recording) -> None:
    for note in recording.notes:
        warn(note)


def _to_aris(part: Part, out: Path, *, beams: int | None, overwrite: bool, progress: Callable[[int], None]) -> None:
    """Write a part as an ARIS file; what had to be changed is warned of."""
    from mitsonar.recordings.write_aris import write_aris

    refuse_to_replace(out, overwrite=overwrite)
    part_file = out.with_name(f".{out.stem}.new.aris")  # the writer replaces nothing
    part_file.unlink(missing_ok=True)

    def counted() -> Iterator[SonarFrames]:
        for frames in part.chunks():
            yield frames
            progress(len(frames))

    try:
        written = write_aris(part_file, counted(), beams=beams)
        part_file.replace(out)
    finally:
        part_file.unlink(missing_ok=True)
    for note in written.notes:
        warn(note)
