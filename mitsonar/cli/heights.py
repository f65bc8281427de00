"""Command ``mitsonar heights``: a height map of the ground from frames with known poses."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from mitsonar.cli.console import answered, numbers, progress_bar, say
from mitsonar.cli.estimate import Frames, Geometry
from mitsonar.cli.options import Frame
from mitsonar.errors import MitsonarError, count_noun
from mitsonar.io.runs import refuse_to_replace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mitsonar.mapping.sources import FrameSource
    from mitsonar.motion.trajectory import Trajectory

__all__ = ["heights"]

USED = 8
"""Number of frames that are used unless others are chosen."""


@answered
def heights(
    frames: Frames,
    out: Annotated[
        list[Path],
        typer.Option(
            "-o", "--out", help="File to write: .ply (mesh), .tif (GeoTIFF), .npz (arrays) or .png (figure). Repeatable."
        ),
    ],
    only: Annotated[
        str | None,
        typer.Option(help=f"Numbers of the frames, such as 0 or 0,4,8 (default: at most {USED}, evenly spread)."),
    ] = None,
    cells: Annotated[int, typer.Option(help="Number of cells along an edge of the map.")] = 64,
    trajectory: Annotated[
        Path | None, typer.Option(help="TUM or CSV file of the path, for frames without poses.", dir_okay=False)
    ] = None,
    frame: Frame = "mitsonar",
    height: Annotated[
        float | None,
        typer.Option(help="Height of the first chosen frame over level ground [m] (default: over the lowest ground below)."),
    ] = None,
    pitch_deg: Annotated[float | None, typer.Option(help="Pitch [deg], > 0 is down, for one frame without a pose.")] = None,
    sequence: Annotated[int | None, typer.Option(help="Sequence of a data set (default: the longest).")] = None,
    view: Annotated[
        str | None, typer.Option(help="View of a data set, or topic of a ROS bag (default: the first, or the only one).")
    ] = None,
    geometry: Geometry = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the choice of held-out blocks.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
) -> None:
    """Map the heights of the ground, with standard deviations, from shading and shadows in frames with known poses.

    One frame is enough. `mitsonar height` estimates the height of the sonar instead.
    """
    from mitsonar.mapping.height_map import HeightMapOptions, fit_height_map, most_trials
    from mitsonar.mapping.height_map_files import FORMATS, save_height_map
    from mitsonar.mapping.open_source import Reading, frames_for
    from mitsonar.motion.trajectory import Trajectory, convention_named

    # 1. Options that cannot work are refused before anything is read.
    convention_named(frame)
    for file in out:
        if file.suffix.lower() not in (*FORMATS, ".png"):
            raise MitsonarError(f"-o must name a .ply, .tif, .npz or .png file: got {file}")
        if not file.parent.is_dir():
            raise MitsonarError(f"there is no folder {file.parent}: make it, or choose another -o")
    refuse_to_replace(*out, overwrite=overwrite)
    options = HeightMapOptions(cells, seed)
    pitch = None if pitch_deg is None else math.radians(pitch_deg)
    # 2. Frames and their poses.
    reading = Reading(sequence, view, pitch_rad=pitch, geometry=geometry)
    source = frames_for(frames, reading)
    if height is not None and source.height_m is None:
        source = frames_for(frames, replace(reading, height_m=height))
    if source.note:
        say(source.note)
    index = _chosen(only, len(source))
    path = None if trajectory is None else Trajectory.load(trajectory, frame)
    index, poses, height_m = _posed(source, index, path, height)
    # 3. The fit, and what it says.
    with progress_bar("fitting", most_trials(), "regularisers") as progress:
        result = fit_height_map(source.read(index), poses, height_m, options, progress)
    for file in out:
        if file.suffix.lower() == ".png":
            from mitsonar.plotting.figures import height_map_figure, save_figure

            maps = {"height": result.height_m, "standard deviation": result.std_m}
            save_figure(file, height_map_figure(result.extent, maps, title=Path(source.name).name))
        else:
            save_height_map(file, result)
    low, high = np.nanpercentile(result.height_m - result.ground_m, [1, 99])
    say(
        f"{count_noun(result.frames, 'frame')}: {cells} x {cells} cells of {1e3 * result.cell_m:.3g} mm, "
        f"{np.isfinite(result.height_m).mean():.0%} of them seen; heights {low:+.3f} .. {high:+.3f} m over level ground "
        f"(1 % and 99 %), median standard deviation {np.nanmedian(result.std_m):.3f} m"
    )
    chosen = result.regulariser
    say(
        f"regulariser: standard deviation {chosen.std_m:.3g} m, correlation length {chosen.length_m:.3g} m, best of "
        f"{len(result.trials) - 1} on held-out blocks, whose errors are {math.sqrt(result.dispersion):.1f} times those of "
        "speckle"
    )
    say(f"height map: {', '.join(map(str, out))}")


def _chosen(only: str | None, count: int) -> NDArray[np.intp]:
    """Return the numbers of the frames to use."""
    if only is None:
        return np.unique(np.linspace(0, count - 1, min(USED, count)).round().astype(np.intp))
    chosen = numbers(only, only.count(",") + 1, "--only")
    assert chosen is not None
    if any(value != int(value) or not 0 <= value < count for value in chosen) or len(set(chosen)) < len(chosen):
        raise MitsonarError(f"--only takes different numbers of frames in 0..{count - 1}: got {only}")
    return np.array(sorted(chosen), dtype=np.intp)


def _posed(
    source: FrameSource, index: NDArray[np.intp], path: Trajectory | None, height_m: float | None
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Return the frames that have a pose, their poses and their heights over level ground."""
    # 1. Poses: along the given path, of the frames, or for one frame its attitude alone.
    if path is not None:
        along, poses = source.along(path)
        known = np.isin(along, index)
        index, poses = along[known], poses[known]
        if not len(index):
            raise MitsonarError("the path has no pose at the time of any chosen frame: choose others with --only")
    elif source.sonar_poses is not None:
        poses = source.sonar_poses[index]
    else:
        attitudes = source.attitudes(index)
        if attitudes is None or len(index) > 1:
            raise MitsonarError(
                f"{source.name} does not state the poses of its frames, and heights depend on them: give --trajectory, or "
                "--only with one frame and its --height and --pitch-deg"
            )
        unknown = [name for name, value in zip(("pitch", "roll"), attitudes[0, 3:5], strict=True) if not np.isfinite(value)]
        if unknown:
            raise MitsonarError(
                f"frame {index[0]} of {source.name} has no known {' and '.join(unknown)}, and heights depend on it: choose "
                "another one with --only, give --pitch-deg, which takes the roll as 0, or --trajectory"
            )
        poses = np.nan_to_num(attitudes)  # position and heading: anything does
    # 2. Heights over level ground: frames hold those over what lies straight below, which may be a rock.
    if source.height_m is None:
        raise MitsonarError(f"{source.name} holds no height over the ground: give --height")
    below = source.height_m[index]
    if source.sonar_poses is None and path is None:  # one frame, above the origin
        poses[:, 2] = below if height_m is None else height_m
        return index, poses, poses[:, 2].copy()
    known = np.isfinite(below)  # beyond the edge of the scene, nothing is below
    ground = poses[0, 2] - height_m if height_m is not None else (poses[known, 2] - below[known]).min(initial=np.inf)
    return index, poses, np.asarray(poses[:, 2] - ground, dtype=np.float64)
