"""Commands ``mitsonar recording``, ``sonar`` and ``frames``: show, convert, fit and export frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, cast

import numpy as np
import typer

from mitsonar.cli.console import answered, changes_of, command_line, progress_bar, say, say_json, warn
from mitsonar.cli.estimate import Geometry
from mitsonar.cli.side_scan import convert_side_scan, refuse_options, show_side_scan, side_scan_at
from mitsonar.errors import MitsonarError, count_noun, suggest_names
from mitsonar.io.files import write_atomic
from mitsonar.io.runs import refuse_to_replace

if TYPE_CHECKING:
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.plotting.outlines import Outlines
    from mitsonar.recordings.range_pings import RangeRecording
    from mitsonar.recordings.recording import Part, Recording
    from mitsonar.recordings.side_scan import SideScan
    from mitsonar.records.frames import SonarFrames

__all__ = [
    "LEAST_SNR_DB",
    "Classes",
    "Least",
    "LeastSnr",
    "Out",
    "Picture",
    "Polygons",
    "Shares",
    "To",
    "Without",
    "calibrate",
    "classes_of",
    "convert",
    "exported",
    "fit",
    "frames",
    "from_recording",
    "info",
    "numbers_of",
    "recordings",
    "shares_of",
    "show",
    "sonars",
    "video",
]


File = Annotated[
    str, typer.Argument(metavar="FILE|RUN", help="A recording of a sonar, frames.npz, frames.zarr or the folder of a run.")
]
PartNumber = Annotated[int | None, typer.Option("--part", help="Part of the recording (default: the longest).")]
TopicName = Annotated[str | None, typer.Option("--topic", help="Topic of a ROS bag (default: the only sonar's).")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]
Span = Annotated[float, typer.Option("--span-db", help="Range of levels to show below the top [dB].")]
WIDEST_DB, DARK_DB = 300.0, 20.0
"""Largest span of a picture, and distance of the brightest thousandth of a dark frame from the top [dB]."""

Top = Annotated[
    float, typer.Option("--top-db", max=0, help="Level of the brightest colour [dB re full scale]; of dark frames -30, say.")
]
Without = Annotated[
    list[str] | None, typer.Option("--without", help="Name of a shape without boxes or outlines, such as the ground.")
]
Classes = Annotated[
    str,
    typer.Option(
        "--classes",
        help="Classes of shapes, GLOB=CLASS,...: pillar*=pillar,seabed*= (empty: left out). Default: their names without "
        "final numbers.",
    ),
]
Labels = Annotated[bool, typer.Option("--labels", help="Outline labelled objects, with a legend of their classes.")]


def recordings() -> typer.Typer:
    """Create the group of commands."""
    app = typer.Typer(help="Show and convert recordings of real sonars, and runs.", no_args_is_help=True)
    for command in (info, show, video, convert):
        app.command()(command)
    return app


@answered
def info(
    file: File,
    topic: TopicName = None,
    geometry: Geometry = None,
    handedness: Annotated[
        bool,
        typer.Option("--handedness", help="Check whether pictures are mirrored, by compass or poses."),
    ] = False,
    turn_deg: Annotated[
        float | None,
        typer.Option(help="Turn from the first to the last frame [deg], > 0 to starboard, in place of a compass."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print the contents of a recording: frames, parts, window, beams, rate, times, gaps, attitude, facts and notes."""
    from mitsonar.recordings.handedness import check_handedness
    from mitsonar.recordings.open import summary_lines, summary_of

    of_frames = {"--geometry": geometry, "--handedness": handedness, "--turn-deg": turn_deg}
    frameless: SideScan | RangeRecording | None = side_scan_at(file)
    if frameless is not None:
        refuse_options(file, {"--topic": topic, **of_frames})
    elif (frameless := ranges_at(file, topic, geometry)) is not None:
        refuse_options(file, of_frames, "holds points")
    if frameless is not None:
        if as_json:
            say_json(summary_of(frameless))
        else:
            say("\n".join(summary_lines(summary_of(frameless))))
        return
    recording = _opened(file, topic, geometry)
    summary = summary_of(recording)
    verdict = None
    if handedness or turn_deg is not None:
        verdict = check_handedness(recording.part(), None if turn_deg is None else math.radians(turn_deg))
    if as_json:
        extra = {} if verdict is None else {"handedness": verdict._asdict()}
        say_json({**summary, **extra})
        return
    for line in summary_lines(summary):
        say(line)
    if verdict is not None:
        why = f" ({verdict.reason})" if verdict.reason else ""
        say(
            f"handedness             {verdict.verdict}{why}: "
            f"correlation {verdict.correlation:.2f} over {count_noun(verdict.pairs, 'pair')}"
        )


@answered
def show(
    file: File,
    out: Annotated[Path, typer.Option("-o", "--out", help="PNG to write.")],
    frame: Annotated[int, typer.Option(min=0, help="Index of the frame in its part.")] = 0,
    part: PartNumber = None,
    topic: TopicName = None,
    geometry: Geometry = None,
    span_db: Span = 60.0,
    top_db: Top = 0.0,
    ground_range: Annotated[
        bool, typer.Option("--ground-range", help="Side-scans: over ground range, without the water column.")
    ] = False,
    height: Annotated[
        float | None, typer.Option(help="Side-scans: height over the ground [m] (default: by the first return).")
    ] = None,
    stored_height: Annotated[
        bool, typer.Option("--stored-height", help="Side-scans: heights of the recording (default: by the first return).")
    ] = False,
    labels: Labels = False,
    without: Without = None,
    classes: Classes = "",
    overwrite: Overwrite = False,
) -> None:
    """Draw one frame as a fan, or all pings of a side-scan as a waterfall, with axes in metres and a colour bar in dB."""
    from mitsonar.plotting.fans import save_fan, to_decibels

    if out.suffix.lower() != ".png":
        raise MitsonarError(f"{out}: pictures are written as .png: give this ending")
    scan = side_scan_at(file)
    if scan is not None:
        of_frames = {"--labels": labels, "--without": without, "--classes": classes, "--top-db": top_db}
        refuse_options(file, {"--frame": frame, "--topic": topic, "--geometry": geometry, **of_frames})
        show_side_scan(
            scan,
            out,
            part=part,
            span_db=span_db,
            ground_range=ground_range,
            height=height,
            stored_height=stored_height,
            overwrite=overwrite,
        )
        return
    if ground_range or stored_height or height is not None:
        raise MitsonarError(f"--ground-range and heights apply only to side-scans: got {file}; leave them out")
    refuse_to_replace(out, overwrite=overwrite)
    recording, outlines = _with_outlines(file, topic, geometry, part, labels=labels, without=without, classes=classes)
    read = recording.part(part).read([frame])
    frames = to_decibels(read, span_db, top_db)
    save_fan(out, frames, title=f"{Path(file).name}, frame {frame}", outlines=outlines, top_db=top_db)
    brightest_db = WIDEST_DB * (float(np.percentile(to_decibels(read, WIDEST_DB).image, 99.9)) - 1)
    if -WIDEST_DB < brightest_db < top_db - DARK_DB:
        suggested = 10 * math.ceil(brightest_db / 10)
        warn(
            f"the picture is dark: the brightest thousandth lies at {brightest_db:.0f} dB re full scale; "
            f"give --top-db {suggested}"
        )
    say(f"picture: {out}")


@answered
def video(
    file: File,
    out: Annotated[Path, typer.Option("-o", "--out", help="MP4 or AVI to write.")],
    part: PartNumber = None,
    topic: TopicName = None,
    geometry: Geometry = None,
    span_db: Span = 60.0,
    top_db: Top = 0.0,
    rate: Annotated[float | None, typer.Option(help="Frames per second (default: the recording's).")] = None,
    labels: Labels = False,
    without: Without = None,
    classes: Classes = "",
    overwrite: Overwrite = False,
) -> None:
    """Write frames as a video of fans."""
    from mitsonar.plotting.fans import write_fan_video

    recording, outlines = _with_outlines(file, topic, geometry, part, labels=labels, without=without, classes=classes)
    _say_notes(recording)
    chosen = recording.part(part)
    steps = np.diff(chosen.time_s)
    frame_rate_hz = 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else 10.0
    if rate is not None and not 0 < rate <= 1000:
        raise MitsonarError(f"--rate must lie in 0..1000 a second: got {rate:g}")
    with progress_bar("drawing", len(chosen), "frames") as progress:
        speed = rate or min(1000.0, frame_rate_hz)
        words = {"span_db": span_db, "top_db": top_db, "outlines": outlines, "overwrite": overwrite}
        count = write_fan_video(chosen.chunks(), out, speed, **words, progress=progress)  # type: ignore[arg-type]
    say(f"{count_noun(count, 'frame')} at {speed:.4g} a second in {out}")


@answered
def convert(
    file: File,
    out: Annotated[
        Path,
        typer.Option(
            "-o",
            "--out",
            help="FOLDER of a run, FILE.mcap or FILE.aris; side-scans: .xtf or .npz; points: .ply, .csv or .mcap.",
        ),
    ],
    part: PartNumber = None,
    topic: TopicName = None,
    geometry: Geometry = None,
    picture: Annotated[str, typer.Option(help="Format of the fans in an MCAP file: jpeg or png.")] = "jpeg",
    full: Annotated[
        bool, typer.Option("--full", help="MCAP: write samples bit for bit, uint8 or float32, and labels (default: 8 bit).")
    ] = False,
    labels: Annotated[bool, typer.Option("--labels", help="MCAP: write the points of labels, if any.")] = False,
    scan_db: Annotated[
        float | None,
        typer.Option(
            "--scan-db",
            help="MCAP: write the first return of each beam from this level on as LaserScan and PointCloud2 [dB re full "
            "scale].",
        ),
    ] = None,
    scan_from: Annotated[float, typer.Option("--scan-from", help="Range from which on --scan-db searches [m].")] = 0.0,
    beams: Annotated[
        int | None, typer.Option(help="Beams of an ARIS file: 48, 64, 96 or 128 (default: those of the frames).")
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(help="Path of the sonar to write with the frames: folder of an odometry, TUM or CSV file."),
    ] = None,
    crop_bins: Annotated[
        str | None, typer.Option("--crop-bins", help="Bins to keep, first,end: numbered from 0, end excluded.")
    ] = None,
    crop_beams: Annotated[
        str | None, typer.Option("--crop-beams", help="Beams to keep, first,end: from port, numbered from 0, end excluded.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Resume a stopped conversion to a folder.")] = False,
) -> None:
    """Convert frames to the folder of a run (frames.npz, or frames.zarr above 1,000 frames), to ROS (.mcap) or to .aris.

    Side-scans are converted to .xtf, or to the echogram of `mitsonar sound` (.npz); points of SonarRanges and of a Sonar
    3D-15 to .ply, .csv or .mcap.
    """
    from mitsonar.recordings.first_returns import FirstReturns
    from mitsonar.recordings.pictures import write_frames
    from mitsonar.recordings.write_mcap import write_mcap

    of_frames: dict[str, object] = {"--geometry": geometry, "--full": full, "--labels": labels, "--beams": beams}
    of_frames |= {"--crop-bins": crop_bins, "--crop-beams": crop_beams, "--resume": resume}
    of_frames |= {"--scan-db": scan_db, "--scan-from": scan_from or None, "--poses": poses}
    scan = side_scan_at(file)
    if scan is not None:
        refuse_options(file, {"--topic": topic, **of_frames})
        convert_side_scan(scan, out, part=part, overwrite=overwrite)
        return
    ranges = ranges_at(file, topic, geometry)
    if ranges is not None:
        refuse_options(file, {"--part": part, **of_frames}, "holds points")
        _convert_ranges(ranges, out, overwrite=overwrite)
        return
    if out.suffix and out.suffix not in (".mcap", ".aris") and not out.is_dir():
        raise MitsonarError(f"{out}: unknown ending; {suggest_names(out.suffix, ['.mcap', '.aris', 'none for a folder'])}")
    if (full or labels) and out.suffix != ".mcap":
        raise MitsonarError(f"--full and --labels apply only to MCAP files: got {out}; leave them out")
    if (scan_db is not None or scan_from) and out.suffix != ".mcap":
        raise MitsonarError(f"--scan-db and --scan-from apply only to MCAP files: got {out}; leave them out")
    if scan_from and scan_db is None:
        raise MitsonarError("--scan-from needs --scan-db, the least level of a return, such as --scan-db -20")
    if out.suffix not in (".mcap", ".aris") and "://" not in file and Path(file).resolve().is_relative_to(out.resolve()):
        raise MitsonarError(f"-o {out} would replace the frames that are read: choose another folder")
    if resume and out.suffix:
        raise MitsonarError("--resume applies only to folders, since a file is written whole: leave it out")
    returns = None if scan_db is None else FirstReturns(scan_db, scan_from)
    recording = _opened(file, topic, geometry)
    _say_notes(recording)
    chosen = recording.part(part)
    spans = [None if text is None else _span(text, option) for text, option in ((crop_bins, "bins"), (crop_beams, "beams"))]
    if len(recording.parts) > 1:
        number = recording.longest if part is None else part
        say(f"part {number} of {len(recording.parts):,}: {len(chosen):,} of {count_noun(len(recording), 'frame')}")
    if poses is not None:
        chosen = _along(chosen, poses, file)
        recording, part = replace(recording, format=f"{recording.format}, poses of {poses}", parts=(chosen,)), None
    if any(spans):
        chosen = chosen.cropped(*spans)
        # a resumed conversion compares formats, so that it does not go on with another crop
        crop = ", ".join(f"{what} {text}" for what, text in (("bins", crop_bins), ("beams", crop_beams)) if text)
        recording, part = replace(recording, format=f"{crop} of {recording.format}", parts=(chosen,)), None
    written = out
    with progress_bar("converting", len(chosen), "frames") as progress:
        if out.suffix == ".mcap":
            words = {"picture": picture, "full": full, "labels": labels, "returns": returns, "overwrite": overwrite}
            write_mcap(chosen.chunks(), out, **words, progress=progress)  # type: ignore[arg-type]
        elif out.suffix == ".aris":
            _to_aris(chosen, out, beams=beams, overwrite=overwrite, progress=progress)
        else:
            written = write_frames(recording, part, out, overwrite=overwrite, resume=resume, progress=progress)
    say(f"{count_noun(len(chosen), 'frame')} in {written}")


def _along(part: Part, path: Path, name: str) -> Part:
    """Return a part with the poses of a path.

    Raises:
        MitsonarError: no such path, or a frame has no pose in it.
    """
    from mitsonar.mapping.odometry_run import OdometryFolder
    from mitsonar.mapping.sources import poses_at
    from mitsonar.motion.trajectory import Trajectory

    trajectory = OdometryFolder.open(path).estimated if path.is_dir() else Trajectory.load(path)
    time_s = part.time_s if part.time_s.ndim == 1 else part.time_s.mean(axis=1)
    poses, known = poses_at(trajectory, time_s, name, part.attitude_rad)
    if not known.all():
        raise MitsonarError(
            f"{path} has no pose for {int((~known).sum()):,} of {count_noun(len(part), 'frame')} of {name}: give a path of "
            "the whole recording"
        )
    return replace(part, poses=poses, beam_poses=None)


def ranges_at(file: str, topic: str | None, geometry: Path | None) -> RangeRecording | None:
    """Open a recording of a sonar that measures ranges; None if the path, or with a geometry the bag, is something else."""
    if "://" in file:
        return None
    from mitsonar.recordings.open import detect_format, open_ranges

    if geometry is not None and detect_format(file) is not None:  # pictures in a bag, which may hold ranges, too
        return None
    return open_ranges(file, topic)


def _convert_ranges(recording: RangeRecording, out: Path, *, overwrite: bool) -> None:
    """Write the points of all pings."""
    from mitsonar.recordings.range_pings import write_points

    _say_notes(recording)
    with progress_bar("converting", len(recording), "pings") as progress:
        count = write_points(recording, out, overwrite=overwrite, progress=progress)
    say(f"{count_noun(count, 'point')} of {count_noun(len(recording), 'ping')} in {out}")


def _span(text: str, what: str) -> tuple[int, int]:
    """Parse the two numbers of a span.

    Raises:
        MitsonarError: not two whole numbers.
    """
    words = text.split(",")
    if len(words) != 2 or not all(word.strip().isdecimal() for word in words):
        raise MitsonarError(f"--crop-{what} is two whole numbers, first,end, such as 0,512: got {text!r}")
    return int(words[0]), int(words[1])


def _opened(file: str, topic: str | None, geometry: Path | None) -> Recording:
    from mitsonar.mapping.sources import recording_at

    return recording_at(file, view=topic, geometry=geometry)


def _with_outlines(
    file: str,
    topic: str | None,
    geometry: Path | None,
    part: int | None,
    *,
    labels: bool,
    without: list[str] | None,
    classes: str,
) -> tuple[Recording, Outlines | None]:
    """Open frames, with the outlines of their labelled objects if these are shown."""
    if not labels:
        if without or classes:
            raise MitsonarError("--without and --classes choose among labels: give --labels too, or leave them out")
        return _opened(file, topic, geometry), None
    if topic is not None or geometry is not None:
        raise MitsonarError("--topic and --geometry read recordings, which have no labels: leave --labels out")
    from mitsonar.bridges.label_outlines import labelled_recording, outlines_of

    recording = labelled_recording(file)
    return recording, outlines_of(recording.part(part).read([]), classes_of(classes, without))


def _say_notes(recording: Recording | RangeRecording) -> None:
    for note in recording.notes:
        warn(note)


def _to_aris(part: Part, out: Path, *, beams: int | None, overwrite: bool, progress: Callable[[int], None]) -> None:
    """Write a part as an ARIS file and warn about necessary changes."""
    from mitsonar.recordings.write_aris import write_aris

    refuse_to_replace(out, overwrite=overwrite)
    part_file = out.with_name(f".{out.stem}.new.aris")  # the writer replaces nothing
    part_file.unlink(missing_ok=True)

    def count_noun() -> Iterator[SonarFrames]:
        for frames in part.chunks():
            yield frames
            progress(len(frames))

    try:
        written = write_aris(part_file, count_noun(), beams=beams)
        part_file.replace(out)
    finally:
        part_file.unlink(missing_ok=True)
    for note in written.notes:
        warn(note)


# ---------------- ``mitsonar sonar``: sonars from recordings


def sonars() -> typer.Typer:
    """Create the group of commands."""
    app = typer.Typer(help="Describe a sonar by its recordings.", no_args_is_help=True)
    app.command()(fit)
    app.command("from-recording")(from_recording)
    app.command()(calibrate)
    return app


@answered
def fit(
    frames: Annotated[Path, typer.Argument(help="Frames of the sonar: frames.npz, or the folder of a run.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="YAML file to write, for --sonar.")],
    sonar: Annotated[
        str | None,
        typer.Option(help="Preset or YAML file for what frames do not contain: carrier, beam width, patterns."),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Set a known field, for example frequency_hz=1.8e6."),
    ] = None,
    measure_coding: Annotated[
        bool,
        typer.Option(
            "--measure-coding", help="Measure span [dB] or gamma from the grain instead of reading it from the frames."
        ),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Fit noise, water, coding, stripes, crosstalk and speckle to a recording, and write a sonar for the simulator.

    Give frames of a resting or slow sonar whose darkest parts, shadows or black water, are noise. For a resting sonar,
    speckle that differs in every frame counts as volume scattering.
    """
    from mitsonar.mapping.sources import is_recording
    from mitsonar.recordings.open import frameless_words
    from mitsonar.records.frames import SonarFrames

    refuse_to_replace(out, overwrite=overwrite)
    known = _known_fields(sonar, changes)
    if is_recording(frames):
        raise MitsonarError(f"{frames} is a recording: give `{command_line('sonar', 'from-recording', frames, '-o', out)}`")
    if words := frameless_words(frames):
        raise MitsonarError(words)
    _fit_and_write(SonarFrames.load(frames), known, out, measure_coding=measure_coding)


@answered
def from_recording(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording of a real sonar, or frames.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="YAML file to write, for --sonar.")],
    noise: Annotated[Path | None, typer.Option(help="Separate YAML file for noise, water and grain (default: OUT).")] = None,
    sonar: Annotated[
        str | None, typer.Option(help="Preset or YAML file for what the recording does not contain: beam width, patterns.")
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Set a known field, for example frequency_hz=1.8e6."),
    ] = None,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Number of frames to read, from the middle.")] = 12,
    part: Annotated[int | None, typer.Option(min=0, help="Part of the recording (default: the longest).")] = None,
    topic: Annotated[str | None, typer.Option(help="Topic of a ROS bag (default: the only one).")] = None,
    geometry: Geometry = None,
    measure_coding: Annotated[
        bool,
        typer.Option(
            "--measure-coding", help="Measure span [dB] or gamma from the grain instead of reading it from the frames."
        ),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
) -> None:
    """Describe the sonar of a recording: its window, bins and beams, and its fitted noise.

    `mitsonar render --sonar` reads the file. With --noise name both files: --sonar sonar.yaml,noise.yaml.
    """
    from mitsonar.estimation.sonar_fit import as_instrument
    from mitsonar.mapping.sources import open_frames

    if noise is not None and noise.resolve() == out.resolve():
        raise MitsonarError(f"-o and --noise both name {out}: give two files, or leave --noise out for one with everything")
    for path in (out, noise):
        if path is not None:
            refuse_to_replace(path, overwrite=overwrite)
    known = _known_fields(sonar, changes)
    source = open_frames(file, sequence=part, view=topic, geometry=geometry)
    first = max(0, (len(source) - frames) // 2)
    chosen, notes = as_instrument(source.read(range(first, min(first + frames, len(source)))))
    _fit_and_write(chosen, known, out, noise, notes, measure_coding=measure_coding)


@answered
def calibrate(
    file: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording of a real sonar, frames or a run.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="YAML file to write, for --sonar.")],
    sonar: Annotated[
        str | None,
        typer.Option(help="Preset or YAML file for what the recording does not contain: beam width, patterns, priors."),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Set a known field, which is not fitted: absorption_db_per_m=0.4."),
    ] = None,
    height: Annotated[float | None, typer.Option(help="Known height over the ground, the median over frames [m].")] = None,
    pitch: Annotated[float | None, typer.Option(help="Known pitch, the median over frames, > 0 looks down [deg].")] = None,
    roll: Annotated[float | None, typer.Option(help="Known roll, the median over frames [deg].")] = None,
    beam_gains: Annotated[
        bool, typer.Option("--beam-gains", help="Fit the gain of every beam, which gives stripes_db, besides the taper.")
    ] = False,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Number of frames to read, spread evenly.")] = 60,
    part: Annotated[int | None, typer.Option(min=0, help="Part of the recording (default: the longest).")] = None,
    topic: Annotated[str | None, typer.Option(help="Topic of a ROS bag (default: the only one).")] = None,
    geometry: Geometry = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Calibrate taper, elevation pattern, absorption and noise with frames of level ground, and write a sonar.

    Height, pitch and roll are fitted too. Every second frame is held out to compare the likelihood with that of `sonar fit`.
    """
    from mitsonar.estimation.calibration import calibrate_sonar
    from mitsonar.estimation.sonar_fit import as_instrument
    from mitsonar.mapping.sources import open_frames

    refuse_to_replace(out, overwrite=overwrite)
    known = _known_fields(sonar, changes)
    source = open_frames(file, sequence=part, view=topic, geometry=geometry)
    which = np.unique(np.linspace(0, len(source) - 1, min(frames, len(source))).astype(int))
    chosen, notes = as_instrument(source.read([int(k) for k in which]))
    _check_carrier(chosen, known)
    result = calibrate_sonar(
        chosen, known.sonar, height_m=height, pitch_deg=pitch, roll_deg=roll, beam_gains=beam_gains, **known.fields
    )
    write_atomic(out, result.yaml().encode())
    for line in result.lines():
        say(line)
    for note in (*notes, *result.notes):
        warn(note)
    say(f"{out}: {command_line('render', 'SCENE', '--sonar', out)}")


class _KnownFields(NamedTuple):
    """A sonar that fitting starts from, and fields that are known."""

    sonar: Sonar | None
    fields: dict[str, Any]  # pairs of a command line, which the sonar checks


def _known_fields(sonar: str | None, changes: list[str] | None) -> _KnownFields:
    """Return the sonar and fields that the user gives; their faults are reported before frames are read."""
    from mitsonar.instruments.sounder import load_sonar

    return _KnownFields(None if sonar is None else load_sonar(sonar), dict(changes_of(changes or [], None)))


def _check_carrier(frames: SonarFrames, known: _KnownFields) -> None:
    """Reject frames without a carrier, which the model coherent needs, if the user gives none.

    Raises:
        MitsonarError: no carrier in the frames, the sonar or the fields.
    """
    stated = (frames.sonar if known.sonar is None else known.sonar).frequency_hz
    if stated is None and "frequency_hz" not in known.fields:
        raise MitsonarError(
            "neither the frames nor a preset state the carrier: give --set frequency_hz=1.8e6, for example, or "
            "--sonar PRESET"
        )


def _fit_and_write(
    frames: SonarFrames,
    known: _KnownFields,
    out: Path,
    noise: Path | None = None,
    notes: Sequence[str] = (),
    *,
    measure_coding: bool,
) -> None:
    """Fit a sonar to frames, write it to OUT, or its noise to another file, and print the result."""
    from mitsonar.estimation.sonar_fit import NOISE_FIELDS, fit_sonar

    _check_carrier(frames, known)
    fitted = fit_sonar(frames, known.sonar, measure_coding=measure_coding, **known.fields)
    if noise is None:
        write_atomic(out, fitted.yaml().encode())
    else:
        write_atomic(out, fitted.yaml(leave=NOISE_FIELDS).encode())
        write_atomic(noise, fitted.yaml(only=NOISE_FIELDS).encode())
    for line in fitted.lines():
        say(line)
    for note in (*notes, *fitted.notes):
        warn(note)
    say(f"{out}: {command_line('render', 'SCENE', '--sonar', out if noise is None else f'{out},{noise}')}")


# ---------------- ``mitsonar frames``: frames of a run or a recording, for other tools


OF_RUN = 0.7, 0.15, 0.15
"""Shares of training, validation and test of a run's frames."""

LEAST_SNR_DB = 3.0
"""Default of the export module, which is not imported yet."""

To = Annotated[str, typer.Option("--to", help="coco, yolo, webdataset, huggingface, kitti or neusis.")]
Out = Annotated[Path, typer.Option("-o", "--out", help="Folder to make; complete or absent.")]
Picture = Annotated[str, typer.Option(help="polar, or fan: forward up, starboard to the right.")]
Least = Annotated[int, typer.Option(min=1, help="Minimum number of pixels of an object.")]
LeastSnr = Annotated[
    float,
    typer.Option("--least-snr-db", help="Minimum signal-to-noise ratio of an object [dB]; -inf: all labelled objects."),
]
Shares = Annotated[
    str | None,
    typer.Option(
        "--split",
        help="Shares of training, validation and test (default: the recipe's; for COCO and YOLO of a run 0.7,0.15,0.15).",
    ),
]
Polygons = Annotated[bool, typer.Option("--polygons", help="YOLO: write outlines instead of boxes.")]


def frames() -> typer.Typer:
    """Create the group of commands."""
    app = typer.Typer(help="Export frames to other tools.", no_args_is_help=True)
    app.command()(export)

    @app.callback()
    def group() -> None:
        """Keep the name of the only command."""

    return app


@answered
def export(
    run: Annotated[
        str, typer.Argument(metavar="RUN|FILE", help="The folder of a run, frames.npz, frames.zarr, or a recording.")
    ],
    to: To,
    out: Out,
    picture: Picture = "polar",
    without: Without = None,
    classes: Classes = "",
    least: Least = 1,
    least_snr_db: LeastSnr = LEAST_SNR_DB,
    split: Shares = None,
    polygons: Polygons = False,
) -> None:
    """Export frames in the layout of another tool. COCO and YOLO need labels, KITTI and neusis poses."""
    from mitsonar.mapping.sources import is_data_set

    if is_data_set(run):
        raise MitsonarError(f"{run} is a data set: {command_line('dataset', 'export', run)} exports it")
    rules = classes_of(classes, without)
    shares = shares_of(split) or (OF_RUN if to in ("coco", "yolo") else None)
    exported(run, to, out, picture, rules, least, least_snr_db, shares, polygons, None)


def classes_of(classes: str, without: list[str] | None) -> list[tuple[str, str]]:
    """Parse the rules of classes."""
    from mitsonar.bridges.export_source import class_rules

    return [*((name, "") for name in without or []), *class_rules(classes)]


def shares_of(split: str | None) -> tuple[float, float, float] | None:
    """Parse the shares of training, validation and test.

    Raises:
        MitsonarError: not three numbers.
    """
    if split is None:
        return None
    train, validation, test = numbers_of(split, "--split", 3)
    return train, validation, test


def numbers_of(text: str, option: str, count: int | None) -> list[float]:
    """Parse comma-separated numbers of an option.

    Raises:
        MitsonarError: not numbers, or not the given count.
    """
    try:
        numbers = [float(one) for one in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or len(numbers) != (count or len(numbers)) or not all(map(math.isfinite, numbers)):
        raise MitsonarError(f"{option} takes {count or 'some'} numbers, separated by commas: got {text!r}")
    return numbers


def exported(
    where: str,
    to: str,
    out: Path,
    picture: str,
    classes: list[tuple[str, str]],
    least: int,
    least_snr_db: float,
    split: tuple[float, float, float] | None,
    polygons: bool,
    view: str | None,
    every_class: bool = False,
) -> None:
    """Export frames and print their folder."""
    from mitsonar.bridges.export_formats import export_to
    from mitsonar.bridges.export_source import PictureKind, open_export

    source = open_export(where, view=view, split=split)
    words = {"classes": classes, "least": least, "least_snr_db": least_snr_db, "polygons": polygons}
    with progress_bar("exporting", source.frames, "frames") as progress:
        kind = cast(PictureKind, picture)
        report = export_to(to, source, out, picture=kind, every_class=every_class, progress=progress, **words)  # type: ignore[arg-type]
    say(f"{count_noun(source.frames, 'frame')} as {to}: {out}")
    for part in ("train", "validation", "test"):
        counts = ", ".join(f"{name} {report.boxes[part, name]:,}" for name in report.classes)
        if to in ("coco", "yolo") and (source.part == part).any():
            say(f"{part:10} {int((source.part == part).sum()):,} pictures, boxes: {counts}")
    if to in ("coco", "yolo") and report.faint + report.small:
        faint, small = f"{report.faint:,} below {least_snr_db:g} dB over the noise", f"{report.small:,} below {least} pixels"
        say(f"without a box: {faint}, {small}")
