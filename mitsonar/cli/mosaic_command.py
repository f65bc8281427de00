"""``mitsonar mosaic``: a map of the ground from frames and a path."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from mitsonar.cli.console import answered, command_line, progress_bar, say, warn
from mitsonar.cli.flown_path import Frame
from mitsonar.cli.odometry_command import Frames, Geometry
from mitsonar.cli.render_command import NOISE
from mitsonar.errors import MitsonarError, counted, meant
from mitsonar.io.runs import kind_of_run, refuse_to_replace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mitsonar.mapping.mosaic import Mosaic
    from mitsonar.mapping.sources import FrameSource
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.records.frames import SonarFrames

__all__ = ["mosaic"]


@answered
def mosaic(
    frames: Frames,
    trajectory: Annotated[
        str,
        typer.Argument(help="Path: a TUM or CSV file, the folder of an odometry, or `true` for the poses in the frames."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "-o", "--out", help="OUT.png for figures of the map and its quality (OUT.quality.png), or OUT.tif for a GeoTIFF."
        ),
    ],
    cell_mm: Annotated[float, typer.Option(help="Cell size of the map [mm].")] = 10.0,
    blend: Annotated[
        str, typer.Option(help="weighted: all beams; centre: the plain mean of the middle beams.")
    ] = "weighted",
    centre_beams: Annotated[int, typer.Option(help="Number of middle beams for `centre`.")] = 24,
    flatten: Annotated[
        bool, typer.Option("--flatten/--no-flatten", help="Compensate the illumination of the ground.")
    ] = True,
    true: Annotated[Path | None, typer.Option(help="TUM or CSV file of the true path, which is drawn too.")] = None,
    frame: Frame = "mitsonar",
    height: Annotated[float | None, typer.Option(help="Height over the ground [m], for frames that lack it.")] = None,
    pitch_deg: Annotated[float | None, typer.Option(help="Pitch [deg], > 0 is down, for frames without poses.")] = None,
    sequence: Annotated[int | None, typer.Option(help="Sequence of a data set (default: the longest).")] = None,
    view: Annotated[
        str | None, typer.Option(help="View of a data set, or topic of a ROS bag (default: the first, or the only one).")
    ] = None,
    geometry: Geometry = None,
    noise: Annotated[str, typer.Option(help=f"{NOISE}.")] = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of that noise.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
) -> None:
    """Lay frames on the ground plane along a path: mean level, standard deviation and count of each cell."""
    from mitsonar.mapping.mosaic import Mosaic, build_mosaic, illumination, save_geotiff
    from mitsonar.mapping.odometry_run import ODOMETRY
    from mitsonar.mapping.open_source import Reading, frames_for, with_assumed_plane
    from mitsonar.mapping.sources import is_recording

    if kind_of_run(frames) == ODOMETRY.name:
        raise MitsonarError(
            f"{frames} is the folder of an odometry, and mosaic takes the frames first, the odometry second: "
            f"{command_line('mosaic', trajectory, frames, '-o', out)}"
        )
    quality = _checked_out(out, true, overwrite)
    Mosaic(cell_mm / 1e3, blend, centre_beams=centre_beams)  # type: ignore[arg-type]  # refused before frames are read
    paths, path_height = _paths(trajectory, true, frame)
    pitch = None if pitch_deg is None else math.radians(pitch_deg)
    source = frames_for(frames, Reading(sequence, view, noise, seed, height, pitch, geometry=geometry))
    if source.note:
        say(source.note)
    if source.height_m is None and path_height is not None:
        source = source.with_geometry(path_height)
    if source.height_m is None and is_recording(frames):
        source = with_assumed_plane(source)
    if source.height_m is None:
        raise MitsonarError(f"{source.name} holds no height over the ground: give --height")
    if trajectory == "true":
        if source.true is None:
            raise MitsonarError(
                f"{source.name} does not state where the sonar was: give a TUM or CSV file, or an odometry's folder"
            )
        paths = {"true": source.true}
    laid_along = next(iter(paths))
    index, poses = source.along(paths[laid_along])
    heights = source.height_m[index]
    light = None
    if flatten:
        some = _spread(len(index))
        light = illumination(source.read(index[some]), poses[some], heights[some])
    with progress_bar("laying", len(index), "frames") as progress:
        found = build_mosaic(
            _counted(source.chunks(index), progress),
            poses,
            heights,
            cell_m=cell_mm / 1e3,
            blend=blend,  # type: ignore[arg-type]
            centre_beams=centre_beams,
            illumination=light,
        )
    if len(index) < len(source):
        warn(f"left out without a pose at their time: {len(source) - len(index):,} of {counted(len(source), 'frame')}")
    if found.frames_without_ground:
        warn(f"left out since they show no ground: {found.frames_without_ground:,} of {counted(found.frames, 'frame')}")
    if quality is None:
        save_geotiff(out, found)
    else:
        _save_figures(out, quality, found, paths, source, laid_along)
    rows, columns = found.mean.shape
    spread = float(np.nanmedian(found.std)) if np.isfinite(found.std).any() else float("nan")
    say(
        f"{counted(found.frames, 'frame')} along the {laid_along} path: {rows:,} x {columns:,} cells of {cell_mm:g} mm, "
        f"{rows * cell_mm / 1e3:.4g} x {columns * cell_mm / 1e3:.4g} m; median standard deviation {spread:.4f}"
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
            raise MitsonarError(
                f"there is no trajectory {trajectory}: give a TUM or CSV file, the folder of an odometry, or "
                f"`true`{meant(trajectory, ['true'])}"
            )
        paths["estimated"] = Trajectory.load(trajectory, frame)
    if true is not None:
        if trajectory == "true":
            raise MitsonarError("--true and TRAJECTORY true are one path: leave --true out")
        paths["true"] = Trajectory.load(true, frame)
    return paths, height


def _spread(count: int) -> NDArray[np.intp]:
    """Choose the frames that the illumination is estimated from."""
    from mitsonar.mapping.mosaic import ILLUMINATION_FRAMES

    return np.unique(np.linspace(0, count - 1, min(ILLUMINATION_FRAMES, count)).astype(np.intp))


def _counted(chunks: Iterator[SonarFrames], progress: Callable[[int], None]) -> Iterator[SonarFrames]:
    for chunk in chunks:
        yield chunk
        progress(len(chunk))


def _save_figures(
    out: Path, quality: Path, found: Mosaic, paths: dict[str, Trajectory], source: FrameSource, along: str
) -> None:
    from mitsonar.plotting.figures import mosaic_figure, quality_figure, save_figure

    name = Path(source.name).name
    save_figure(out, mosaic_figure(found, paths, title=f"{name}, along the {along} path"))
    save_figure(quality, quality_figure(found, title=name))
