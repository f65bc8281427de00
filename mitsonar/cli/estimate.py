"""Commands ``mitsonar odometry``, ``mosaic``, ``height``, ``crlb``, ``compare`` and ``benchmark``: estimate motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from mitsonar.cli.console import answered, command_line, numbers, progress_bar, say, say_json, warn
from mitsonar.cli.options import (
    NOISE,
    SIX,
    Frame,
    Noise,
    instrument_for,
    path_for,
    scene_parameters,
    sonar_changes,
    under_vehicle,
)
from mitsonar.cli.side_scan import MosaicRequest, lay_side_scan, refuse_options, side_scan_at
from mitsonar.errors import MitsonarError, count_noun, did_you_mean
from mitsonar.io.files import missing_file, write_atomic
from mitsonar.io.runs import kind_of_run, refuse_to_replace
from mitsonar.io.system import usable_cores

if TYPE_CHECKING:
    from mitsonar.estimation.crlb.report import Value
    from mitsonar.estimation.height import HeightEstimate
    from mitsonar.mapping.open_source import ViewSource
    from mitsonar.mapping.sources import FrameSource
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.records.frames import SonarFrames

__all__ = ["Frames", "Geometry", "benchmarks", "compare", "crlb", "height", "mosaic", "odometry", "odometry_benchmark"]


Frames = Annotated[
    str,
    typer.Argument(
        metavar="FRAMES|RUN|DATA.zarr", help="frames.npz, frames.zarr, the folder of a run, a data set or a recording."
    ),
]
Geometry = Annotated[
    Path | None, typer.Option(help="YAML file with the layout of the pictures of a recording.", dir_okay=False)
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
            help="zero, ecc, flow, phase, direct, corrnet, a checkpoint, or your class as my_module:MyEstimator; "
            "NAME:key=value:key=value. Of several checkpoints, separated by commas, the one trained nearest to the height "
            "is used. For impulse responses: zero, correlation, likelihood, impulse-posenet. Default: direct, or likelihood."
        ),
    ] = None,
    smooth: Annotated[str, typer.Option(help="none, spline or kalman. Invalid motions are bridged in any case.")] = "none",
    scale: Annotated[str | None, typer.Option(help="Factors of sideways,forward,yaw, or `fit` to the true path.")] = None,
    every: Annotated[int, typer.Option(help="Use every N-th frame.")] = 1,
    start: Annotated[str | None, typer.Option("--from", help=f"First pose: {SIX} (default: the true one, or 0).")] = None,
    frame: Frame = "mitsonar",
    height: Annotated[float | None, typer.Option(help="Height over the ground [m], for frames that lack it.")] = None,
    height_by: Annotated[
        str | None,
        typer.Option(help="Estimator of the height of each frame: direct, or a checkpoint trained on heights."),
    ] = None,
    pitch_deg: Annotated[float | None, typer.Option(help="Pitch [deg], > 0 is down, for frames without poses.")] = None,
    contrast: Annotated[
        str | None,
        typer.Option(
            help="What to match: levels, local (contrast) or moving (local, less the mean of the run). Default: local for "
            "recordings without heights, levels for all others."
        ),
    ] = None,
    closure: Annotated[
        int | None,
        typer.Option(
            help="Number of motions per closed loop, halved where loops do not close; covariances grow to explain the "
            "residuals. 0: none. Default: 8 with contrast (half the motions if fewer than 16), else 0."
        ),
    ] = None,
    sensors: Annotated[
        Path | None,
        typer.Option(
            help="CSV file of gyroscope, DVL, depth, attitude, compass or dead reckoning, with named columns of values and "
            "noise, or the columns of a trajectory; or a ROS bag. A pose graph adds them to the frames.",
        ),
    ] = None,
    local_map: Annotated[
        bool,
        typer.Option(
            "--map",
            help="Register frames to a map of the last metres instead of the last frame: less drift over rocks, but with "
            "speckle often more.",
        ),
    ] = False,
    loops: Annotated[bool, typer.Option("--loops", help="Detect revisited places and close the path there.")] = False,
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
    from mitsonar.mapping.odometry import OdometryOptions, loop_starts
    from mitsonar.mapping.odometry_run import run_odometry, table_lines
    from mitsonar.mapping.open_source import Reading, frames_for, open_source, record_at, usual_loop
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
    vehicle = None
    if sensors is not None:
        from mitsonar.mapping.sensors import open_sensors

        vehicle = open_sensors(sensors)
    source = open_source(frames, method, reading)
    if source.note:
        say(source.note)
    pairs = max(0, len(source) - 1) // max(1, every)
    steps = usual_loop(source) if closure is None else closure
    closing = len(loop_starts(pairs, steps)) if steps > 1 else 0
    frames_mapped = pairs + 1 if local_map else 0
    options = OdometryOptions(
        smooth=smooth,  # type: ignore[arg-type]  # other words are refused
        scale=factors,
        start=None if first is None else Pose.from_degrees(first),
        every=every,
        closure=steps,
        sensors=vehicle,
        loops=loops,
        local_map=local_map,
        workers=workers or max(1, min(usable_cores(), pairs // PAIRS_A_WORKER)),
    )
    with progress_bar("estimating", pairs + closing + frames_mapped, "pairs") as progress:
        result = run_odometry(
            source, estimator, method, out, options, frame=frame, overwrite=overwrite, resume=resume, progress=progress
        )
    for line in table_lines(result.rows()):
        say(line)
    for sentence in result.warnings():
        warn(sentence)
    count, lost = len(result.estimates), int((~result.valid).sum())
    if result.graph is not None and result.graph.sensors:
        say(f"sensors: {', '.join(result.graph.sensors)}")
    say(f"{count_noun(count, 'motion')} by {estimator} ({method.inputs}), {lost} invalid and bridged, in {out}")
    say(f"picture: {out / 'path.png'}")


# ---------------- ``mitsonar mosaic``: a map of the ground from frames and a path


@answered
def mosaic(
    frames: Frames,
    trajectory: Annotated[
        str | None,
        typer.Argument(
            help="Path: a TUM or CSV file, the folder of an odometry, or `true` for the poses in the frames.",
            show_default=False,
        ),
    ] = None,
    *,
    out: Annotated[
        Path,
        typer.Option(
            "-o", "--out", help="OUT.png for figures of the map and its quality (OUT.quality.png), or OUT.tif for a GeoTIFF."
        ),
    ],
    cell_mm: Annotated[float | None, typer.Option(help="Cell size of the map [mm] (default: 10; side-scans: 100).")] = None,
    blend: Annotated[
        str, typer.Option(help="weighted: all beams; centre: the plain mean of the middle beams.")
    ] = "weighted",
    centre_beams: Annotated[int, typer.Option(help="Number of middle beams for `centre`.")] = 24,
    flatten: Annotated[
        bool, typer.Option("--flatten/--no-flatten", help="Compensate the illumination of the ground.")
    ] = True,
    true: Annotated[Path | None, typer.Option(help="TUM or CSV file of the true path, to draw as well.")] = None,
    frame: Frame = "mitsonar",
    height: Annotated[float | None, typer.Option(help="Mean height over the ground [m], for frames that lack it.")] = None,
    pitch_deg: Annotated[float | None, typer.Option(help="Pitch [deg], > 0 is down, for frames without poses.")] = None,
    sequence: Annotated[int | None, typer.Option(help="Sequence of a data set (default: the longest).")] = None,
    view: Annotated[
        str | None, typer.Option(help="View of a data set, or topic of a ROS bag (default: the first, or the only one).")
    ] = None,
    geometry: Geometry = None,
    noise: Noise = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of that noise.")] = 0,
    stored_height: Annotated[
        bool, typer.Option("--stored-height", help="Side-scans: heights of the recording (default: by the first return).")
    ] = False,
    declination: Annotated[
        float, typer.Option(help="Side-scans: magnetic declination to add to headings [deg], > 0 is east.")
    ] = 0.0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
) -> None:
    """Lay frames, or pings of a side-scan, on the ground plane: mean level, standard deviation and count of each cell."""
    from mitsonar.mapping.mosaic import ILLUMINATION_FRAMES, MosaicOptions, build_mosaic, illumination, save_geotiff
    from mitsonar.mapping.odometry_run import ODOMETRY
    from mitsonar.mapping.open_source import Reading, frames_for, with_assumed_plane
    from mitsonar.mapping.sources import is_recording

    if kind_of_run(frames) == ODOMETRY.name:
        raise MitsonarError(
            f"{frames} is the folder of an odometry, and mosaic takes the frames first, the odometry second: "
            f"{command_line('mosaic', trajectory or 'FRAMES', frames, '-o', out)}"
        )
    if not trajectory:
        raise MitsonarError(
            "mosaic needs a path after the frames: give `true` for their poses, a TUM or CSV file, or the folder of an "
            "odometry"
        )
    quality = _checked_out(out, true, overwrite)
    scan = side_scan_at(frames)
    if scan is not None:
        of_frames = {"--view": view, "--geometry": geometry, "--noise": noise != "none", "--pitch-deg": pitch_deg}
        refuse_options(frames, {**of_frames, "--blend": blend != "weighted"})
        paths, _ = _paths(trajectory, true, frame)
        lay_side_scan(
            scan, MosaicRequest(out, quality, paths, sequence, cell_mm, height, stored_height, declination, flatten)
        )
        return
    if declination or stored_height:
        raise MitsonarError(f"--declination and --stored-height apply only to side-scans: got {frames}; leave them out")
    cell_mm = 10.0 if cell_mm is None else cell_mm
    options = MosaicOptions(cell_mm / 1e3, blend, centre_beams)  # type: ignore[arg-type]  # other words are refused
    paths, path_height = _paths(trajectory, true, frame)
    pitch = None if pitch_deg is None else math.radians(pitch_deg)
    source = frames_for(frames, Reading(sequence, view, noise, seed, height, pitch, geometry=geometry))
    if source.note:
        say(source.note)
    if source.height_m is None and path_height is not None:
        source = source.with_geometry(path_height)
    if source.height_m is None and is_recording(frames):
        source = with_assumed_plane(source)
    if trajectory == "true":
        if source.true is None:
            raise MitsonarError(
                f"{source.name} does not state where the sonar was: give a TUM or CSV file, or an odometry's folder"
            )
        paths = {"true": source.true}
    laid_along = next(iter(paths))
    index, poses = source.along(paths[laid_along])
    heights = source.heights_along(index, poses)
    if heights is None:
        raise MitsonarError(f"{source.name} holds no height over the ground: give --height")
    if source.height_m is not None and np.ptp(source.height_m[index]) == 0 < np.ptp(heights):
        say(f"height over level ground, by the heave of the path: {heights.min():.4g} to {heights.max():.4g} m")
    light = None
    if flatten:
        some = np.unique(np.linspace(0, len(index) - 1, min(ILLUMINATION_FRAMES, len(index))).astype(np.intp))
        light = illumination(source.read(index[some]), poses[some], heights[some])
    with progress_bar("laying", len(index), "frames") as progress:
        ground_map = build_mosaic(_counted(source.chunks(index), progress), poses, heights, options, illumination=light)
    if len(index) < len(source):
        warn(f"left out without a pose at their time: {len(source) - len(index):,} of {count_noun(len(source), 'frame')}")
    if ground_map.frames_without_ground:
        without, frames_added = ground_map.frames_without_ground, count_noun(ground_map.frames, "frame")
        warn(f"left out since they show no ground: {without:,} of {frames_added}")
    if ground_map.frames_past_nadir:
        past, of_all = ground_map.frames_past_nadir, count_noun(ground_map.frames, "frame")
        warn(
            f"in {past:,} of {of_all} the fan reaches past straight down, where an echo belongs to one of two places, ahead "
            "or astern: the map shows it at both"
        )
    if quality is None:
        save_geotiff(out, ground_map)
    else:
        from mitsonar.plotting.figures import mosaic_figure, quality_figure, save_figure

        name = Path(source.name).name
        save_figure(out, mosaic_figure(ground_map, paths, title=f"{name}, along the {laid_along} path"))
        save_figure(quality, quality_figure(ground_map, title=name))
    rows, columns = ground_map.mean.shape
    known = ground_map.std[np.isfinite(ground_map.std)]
    spread = f"median standard deviation {np.median(known):.4f}" if known.size else "no cell is lit by two frames"
    say(
        f"{count_noun(ground_map.frames, 'frame')} along the {laid_along} path: {rows:,} x {columns:,} cells of "
        f"{cell_mm:g} mm, {rows * cell_mm / 1e3:.4g} x {columns * cell_mm / 1e3:.4g} m; {spread}"
    )
    say(f"mosaic: {out}" + (f", quality: {quality}" if quality else " (bands: mean, standard deviation, count)"))


def _checked_out(out: Path, true: Path | None, overwrite: bool) -> Path | None:
    """Check the file to write, and return the file of the quality, if there is one."""
    kind = out.suffix.lower()
    if kind not in (".png", ".tif", ".tiff"):
        raise MitsonarError(f"-o must name a .png, .tif or .tiff file: got {out}")
    if not out.parent.is_dir():
        raise MitsonarError(f"there is no folder {out.parent}: make it, or choose another -o")
    if kind != ".png" and true is not None:
        raise MitsonarError("--true is drawn into a figure: give a .png as -o, or leave it out")
    quality = out.with_suffix(".quality.png") if kind == ".png" else None
    refuse_to_replace(out, *([] if quality is None else [quality]), overwrite=overwrite)
    return quality


def _paths(trajectory: str, true: Path | None, frame: str) -> tuple[dict[str, Trajectory], float | None]:
    """Load the paths by name, first the one of the map, and the height that an odometry was given."""
    from mitsonar.mapping.odometry_run import OdometryFolder
    from mitsonar.motion.trajectory import Trajectory, convention_named

    convention_named(frame)
    height = None
    paths: dict[str, Trajectory] = {}
    if Path(trajectory).is_dir():
        folder = OdometryFolder.open(trajectory)
        height = folder.height_m
        paths["estimated"] = folder.estimated
        if folder.true is not None:
            paths["true"] = folder.true
    elif trajectory != "true":
        if not Path(trajectory).exists():
            otherwise = f"give a TUM or CSV file, the folder of an odometry, or `true`{did_you_mean(trajectory, ['true'])}"
            raise missing_file(trajectory, otherwise)
        paths["estimated"] = Trajectory.load(trajectory, frame)
    if true is not None:
        if trajectory == "true":
            raise MitsonarError("--true and TRAJECTORY true are the same path: leave --true out")
        paths["true"] = Trajectory.load(true, frame)
    return paths, height


def _counted(chunks: Iterator[SonarFrames], progress: Callable[[int], None]) -> Iterator[SonarFrames]:
    for chunk in chunks:
        yield chunk
        progress(len(chunk))


# ---------------- ``mitsonar height``: estimate the height over the ground of each frame, from the frames alone


AT_ONCE = 8
"""Number of frames that are read at a time."""


@answered
def height(
    frames: Frames,
    by: Annotated[str, typer.Option(help="Estimator: direct, or a checkpoint trained on heights.")] = "direct",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="CSV file to write, one line a frame.")] = None,
    pitch_deg: Annotated[float | None, typer.Option(help="Pitch [deg], > 0 is down, for frames without poses.")] = None,
    sequence: Annotated[int | None, typer.Option(help="Sequence of a data set (default: the longest).")] = None,
    view: Annotated[
        str | None, typer.Option(help="View of a data set (default: the first; of portions: whole, or all).")
    ] = None,
    noise: Noise = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of that noise.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Estimate the height over the ground from first return and fall-off, or by a network, and compare it with the truth.

    `mitsonar odometry --height-by` passes these heights to the estimators of motion.
    """
    from mitsonar.estimation.height import heights_csv, heights_lines
    from mitsonar.estimation.named import height_estimator_from
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
        write_atomic(out, heights_csv(source.time_s, estimates, true).encode())
    for line in heights_lines(estimates, true):
        say(line)
    lost = sum(not one.valid for one in estimates)
    given = (
        estimator.inputs
        if pitch_deg is None
        else f"pitch {pitch_deg:g} deg from the command line, which the frames cannot verify"
    )
    say(
        f"{count_noun(len(estimates), 'frame')} by {by} ({given}), {lost:,} invalid"
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


# ---------------- ``mitsonar crlb``: the Cramer-Rao lower bound of motions, for a scene, sonar and noise, or for a
# data set


@answered
def crlb(
    source: Annotated[
        str, typer.Argument(metavar="SCENE|DATA.zarr", help="Mitsuba XML file, a shipped scene's name, or a data set.")
    ],
    noise: Annotated[str | None, typer.Option(help=f"{NOISE} (default: high; the model coherent adds its own).")] = None,
    start: Annotated[str | None, typer.Option("--from", help=f"Pose: {SIX}.")] = None,
    end: Annotated[
        str | None, typer.Option("--to", help="Last pose. The --poses are evenly spaced from --from to this one.")
    ] = None,
    poses: Annotated[int | None, typer.Option(help="Number of poses (default: 1; of a trajectory 20).")] = None,
    trajectory: Annotated[Path | None, typer.Option(help="Poses of a TUM or CSV file, or `shipped`.")] = None,
    frame: Frame = "mitsonar",
    sonar: Annotated[str | None, typer.Option(help="Preset (`mitsonar presets`) or YAML file.")] = None,
    model: Annotated[str | None, typer.Option(help="Model of the echo level: coherent, physical or thesis.")] = None,
    instrument: Annotated[
        str | None,
        typer.Option(
            help="Instead of a sonar: an instrument of several fans, preset or YAML file, on a vehicle at the poses."
        ),
    ] = None,
    segments: Annotated[
        str | None, typer.Option(help="Portions of the view of a sonar that looks down: q1,q2,q3,q4.")
    ] = None,
    degrees: Annotated[
        str,
        typer.Option(
            help="Degrees of freedom of the motion: 3 (sideways, forward, yaw), 6, or names of sideways, forward, rise, "
            "pitch, roll, yaw, separated by commas."
        ),
    ] = "3",
    largest: Annotated[
        str | None,
        typer.Option(help="M,DEG: largest standard deviations that count as an observation, with --degrees (0.1,5)."),
    ] = None,
    height: Annotated[
        float | None, typer.Option(help="Height over the ground [m]. The range window follows the floor.")
    ] = None,
    pairs: Annotated[int, typer.Option(help="Of a data set: number of pairs, one a sequence.")] = 20,
    part: Annotated[
        str | None, typer.Option(help="Of a data set: train, validation, test (default if the split has one) or all.")
    ] = None,
    vary: Annotated[
        str | None,
        typer.Option(
            help="NAME=V1,V2: height_m, pitch_deg, azimuth_fov_deg, elevation_fov_deg, beams, range_bins, window=3.2..5.6."
        ),
    ] = None,
    gain: Annotated[float | None, typer.Option(help="Constant gain (default: the data set's, or from the frames).")] = None,
    pings: Annotated[
        int | None, typer.Option(help="Pings in each half of the derivatives (default: until they suffice).")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the rays.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="PNG to write: the bound against the variable, or for each pose.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    parameter: Annotated[list[str] | None, typer.Option("-D", help="NAME=VALUE for the scene's $NAME.")] = None,
) -> None:
    """Compute the Cramer-Rao lower bound of sideways, forward and yaw between two pings, from derivatives of the renderer.

    One frame: scene and first pose are known. Two frames: both are noisy, and the relief is known. Distributions: `pixel`,
    the exact one of clipped, rounded pixels; `gaussian`, with the same mean and variance; `rays`, with the noise of the
    rays of a ping. In the model coherent: `grain`, scatterers known, in the receiver's noise; `ground`, expected level
    known, with independent speckle in each frame.

    With --vary the gain is computed for each value. If height, pitch or a field of view varies, both ends of the range
    window follow the nearest and farthest range of the floor. The number of bins stays.

    With --degrees 6 the motion has all six degrees of freedom, in level axes, and directions that two frames cannot show are
    named. With --instrument the information of all fans adds up: fans on several mounts, or the rows of a 3-D sonar.
    """
    from mitsonar.estimation.crlb.image import LARGEST
    from mitsonar.estimation.crlb.report import (
        BoundOptions,
        bounds_report,
        report_lines,
        subject_of_data,
        subject_of_scene,
    )
    from mitsonar.instruments.sounder import load_sounder
    from mitsonar.motion.composition import MotionStd, degrees_named
    from mitsonar.motion.trajectory import convention_named
    from mitsonar.simulation.scene import load_scene

    name, values = _variable(vary)
    limits = numbers(largest, 2, "--largest")
    options = BoundOptions(
        noise=noise,
        height_m=height,
        vary=name,
        values=values,
        gain=gain,
        pings=pings,
        degrees=degrees_named(degrees),
        largest=LARGEST if limits is None else MotionStd(limits[0], math.radians(limits[1])),
    )
    convention_named(frame)
    if Path(source).suffix == ".zarr" or "://" in source:
        scene_only = (start, end, poses, trajectory, sonar, model, instrument, segments, parameter)
        if any(value is not None for value in scene_only):
            raise MitsonarError(f"{source} is a data set, which defines sonar, poses and segments: leave these options out")
        subject = subject_of_data(source, pairs, part=part, seed=seed)
    else:
        loaded = load_scene(source, **scene_parameters(parameter or []))
        changes, attitude = sonar_changes(None, None, model, seed), None
        if instrument is None:
            sounder, (fan, attitude) = None, instrument_for(loaded, sonar, changes)
        else:
            if any(value is not None for value in (sonar, segments, vary, height)):
                raise MitsonarError(
                    "--instrument excludes --sonar, --segments, --vary and --height: leave these options out"
                )
            sounder = load_sounder(instrument).replace(**changes)
            fan = sounder.fan
        count = 20 if poses is None and trajectory else poses
        path = path_for(fan, attitude, source, count, start, end, trajectory, frame, counted="--poses")
        if sounder is not None:
            path = under_vehicle(path, sounder, trajectory)
        portions = segments.split(",") if segments else []
        subject = subject_of_scene(loaded, fan, path.poses, segments=portions, sounder=sounder)
    noiseless = options.noise_for(subject.sonar).scale == 0 and subject.sonar.model != "coherent"
    with progress_bar("differentiating", subject.poses * max(1, len(values)), "poses") as progress:
        report = bounds_report(source, subject, options, progress)
    if plot is not None:
        from mitsonar.io.files import write_atomic
        from mitsonar.plotting.figures import crlb_png

        write_atomic(plot, crlb_png(report))
    if as_json:
        say_json(report, indent=1)
        return
    for line in report_lines(report):
        say(line)
    if noiseless:
        warn(
            "without noise the echoes determine the motion without limit (`pixel`: -); `gaussian` counts rounding as "
            "variance 1 / (12 255^2), `rays` adds the noise of the rays of a ping"
        )
    if any(row["not_observable"] for row in report["rows"]):
        warn("inf: an axis is not observable, or the noise of the rays hides it: raise --pings to distinguish the two")
    if plot is not None:
        say(f"picture: {plot}")


def _variable(text: str | None) -> tuple[str | None, list[Value]]:
    """Parse ``NAME=V1,V2,...``; of ``window`` the values are intervals."""
    from mitsonar.errors import suggest_names
    from mitsonar.estimation.crlb.image import VARIABLES

    if text is None:
        return None, []
    name, _, rest = text.partition("=")
    if name not in VARIABLES:
        raise MitsonarError(f"--vary takes NAME=V1,V2,...: got {text!r}; {suggest_names(name, VARIABLES)}")
    try:
        values: list[Value] = []
        for word in rest.split(","):
            ends = [float(number) for number in word.split("..")]
            if len(ends) != (2 if name == "window" else 1):
                raise ValueError
            values.append((ends[0], ends[1]) if name == "window" else ends[0])
    except ValueError:
        example = "3.2..5.6,3..6" if name == "window" else "1,2.5,4"
        raise MitsonarError(f"--vary {name} takes numbers as {example}: got {rest!r}") from None
    return name, values


# ---------------- ``mitsonar compare``: estimators on the same pairs of a data set


@answered
def compare(
    data: Annotated[str, typer.Argument(metavar="DATA.zarr", help="Path or URL of a data set.")],
    estimators: Annotated[
        str | None,
        typer.Option(
            help="Names of estimators, checkpoints of networks, or your classes (my_module:MyEstimator), separated "
            "by commas; NAME:key=value:key=value gives options (default: all that need no training)."
        ),
    ] = None,
    noise: Annotated[
        str,
        typer.Option(
            help="Levels of noise, separated by commas (by ; if one is m,s,g): none, low, high, chapter2, a YAML file; for "
            "impulse responses signal-to-noise ratios: none,20 dB."
        ),
    ] = "none",
    part: Annotated[str | None, typer.Option(help="train, validation, test (default if the split has one) or all.")] = None,
    split: Annotated[
        str | None,
        typer.Option(help="sequence, scene or sample (default: that of the networks' training, else of the data set)."),
    ] = None,
    pairs: Annotated[int | None, typer.Option(min=2, help="Largest number of pairs, one a sequence.")] = None,
    perturb: Annotated[
        bool, typer.Option("--perturb", help="Add rows with wrong height, pitch, roll, sound speed and heave.")
    ] = False,
    jitter: Annotated[
        bool, typer.Option("--jitter", help="Add a row with jittered rays, which shows errors from the sampling pattern.")
    ] = False,
    prior: Annotated[
        bool, typer.Option("--prior", help="Add rows with a prior on the size of motions, as networks have.")
    ] = False,
    limit: Annotated[int, typer.Option(min=0, help="Number of pairs for the Cramer-Rao bound (images only); 0: none.")] = 10,
    reference: Annotated[str | None, typer.Option(help="Estimator to compare others with (default: the last).")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise, choice of pairs and bootstrap.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Folder for estimates, table.md and table.json; a stopped run is resumed."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare estimators on the same pairs. Failures count as zero motion. Bootstrap by scene, then sequence."""
    from mitsonar.estimation.compare import ComparisonOptions
    from mitsonar.estimation.compare import compare as compared

    options = ComparisonOptions(
        noise=noise,
        part=part,
        split=split,
        pairs=pairs,
        perturb=perturb,
        jitter=jitter,
        prior=prior,
        limit=limit,
        reference=reference,
        seed=seed,
    )
    comparison = compared(data, estimators, options, out=out, begin=lambda what, count: progress_bar(what, count, "pairs"))
    for sentence in comparison.notes:
        warn(sentence)
    if as_json:
        say_json(comparison.report, indent=1)
        return
    for line in comparison.to_markdown().splitlines():
        say(line)
    if out is not None:
        say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}")


# ---------------- ``mitsonar benchmark``: methods of all kinds on sets that everybody can make


def benchmarks() -> typer.Typer:
    """Create the group of commands."""
    app = typer.Typer(help="Compare methods on reproducible sets.", no_args_is_help=True)
    app.command("odometry")(odometry_benchmark)
    return app


@answered
def odometry_benchmark(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to make: table.md, table.json, rows.jsonl, sets, paths.")],
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="dive, rocks, slope, hull, or the path of a recording or a run; several times (default: those four). "
            "dive means 48 dives of eight sonars; dive-aris3000 or dive-aris3000-gentle-3 picks some.",
        ),
    ] = None,
    texture: Annotated[
        list[str] | None, typer.Option(help="Of simulated sets: still or speckle; several times (default: both).")
    ] = None,
    noise: Annotated[
        list[str] | None, typer.Option(help="Of rocks, slope and hull: none, low or high; several times (default: none).")
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="zero, ecc, phase, flow, direct, corrnet, corrnet-coherent, cfar-gicp, fourier-mellin, stackreg, a "
            "checkpoint, or your class as my_module:MyEstimator; several times (default: all; in speckle "
            "corrnet-coherent for corrnet)."
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(help="Frames of each set (default: 40 of a dive, 260 of another simulated set, all of a recording)."),
    ] = None,
    geometry: Geometry = None,
    bound: Annotated[int, typer.Option(min=0, help="Poses of the Cramer-Rao bound of simulated sets; 0: none.")] = 3,
    workers: Annotated[int, typer.Option(min=1, help="Number of processes that estimate.")] = 1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Add rows to an existing folder; an interrupted row resumes.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing benchmark.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare methods of odometry: drift, errors of motions relative to the bound, failures and time, a row each.

    Simulated sets are rendered once into OUT and stay there. Each row is written when it is complete. The table holds all
    rows of OUT.
    """
    from mitsonar.reproduction.odometry_benchmark import Wanted, benchmark_lines, benchmark_odometry

    chosen = {"sets": set_, "textures": texture, "noises": noise, "methods": method}
    selection = Wanted(
        **{name: tuple(words) for name, words in chosen.items() if words}, frames=frames, geometry=geometry, bound=bound
    )
    report = benchmark_odometry(
        selection,
        out,
        resume=resume,
        overwrite=overwrite,
        workers=workers,
        begin=lambda what, length: progress_bar(what, length, "parts"),
    )
    for sentence in report["notes"]:
        warn(sentence)
    if as_json:
        say_json(report, indent=1)
        return
    for line in benchmark_lines(report["rows"]):
        say(line)
    say(f"\ntables: {out / 'table.md'}, {out / 'table.json'}")
