"""What ``mitsonar recording`` and ``mitsonar mosaic`` do with side-scans, real and simulated."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mitsonar.cli.console import progress_bar, say, warn
from mitsonar.errors import MitsonarError, count_noun, suggest_names
from mitsonar.io.runs import refuse_to_replace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.recordings.side_scan import SideScan
    from mitsonar.records.soundings import Echogram

__all__ = ["MosaicRequest", "convert_side_scan", "lay_side_scan", "refuse_options", "show_side_scan", "side_scan_at"]


CLOCK_S = 0.02
"""Pings so far beyond a path belong to it still, since clocks of files tick in steps of 10 ms [s]."""


def side_scan_at(file: str) -> SideScan | None:
    """Open a side-scan recording; None if the path is something else."""
    if "://" in file:
        return None
    from mitsonar.recordings.open import detect_side_scan

    side_scan_format = detect_side_scan(file)
    return None if side_scan_format is None else side_scan_format.read(Path(file))


def refuse_options(file: str, options: Mapping[str, object], what: str = "is a side-scan") -> None:
    """Reject options of frames that were given for a side-scan or another recording without frames.

    Args:
        file: the recording, for the message.
        options: values of options, keyed by name; false values, None and 0 count as not given.
        what: what the recording is, as part of a sentence.

    Raises:
        MitsonarError: an option was given.
    """
    for name, value in options.items():
        if value:
            raise MitsonarError(f"{file} {what}, and {name} applies only to frames: leave it out")


def show_side_scan(
    recording: SideScan,
    out: Path,
    *,
    part: int | None,
    span_db: float,
    ground_range: bool,
    height: float | None,
    stored_height: bool,
    overwrite: bool,
) -> None:
    """Draw a waterfall over slant range, with its first return, or over ground range."""
    from mitsonar.geometry.side_scan import ground_lines, to_ground_range
    from mitsonar.plotting.figures import ground_range_figure, save_sounding_figure, side_scan_figure

    refuse_to_replace(out, overwrite=overwrite)
    _say_notes(recording)
    echogram = recording.part(part).read()
    title = f"{recording.name}: {echogram.sounder.name}, {count_noun(len(echogram), 'ping')}"
    if ground_range:
        height_m = _heights(echogram, height, stored=stored_height)
        figure = ground_range_figure(to_ground_range(echogram, height_m), span_db=span_db, title=title)
    else:
        try:
            nearest_m = ground_lines(echogram.poses, _heights(echogram, height, stored=stored_height)).nearest_m
        except MitsonarError as error:
            if height is not None or stored_height:
                raise
            warn(f"drawn without the first return: {error}")
            nearest_m = None
        figure = side_scan_figure(echogram, nearest_m, span_db=span_db, title=title)
    save_sounding_figure(figure, out)
    say(f"picture: {out}")


def _heights(echogram: Echogram, height: float | None, *, stored: bool) -> NDArray[np.float64]:
    """Return heights over the ground ``(pings,)`` [m]: the given one, those of the recording, or those by first returns.

    Raises:
        MitsonarError: both are requested, or the file states no heights, or no bottom can be tracked.
    """
    if height is not None and stored:
        raise MitsonarError("--height and --stored-height exclude each other: leave one out")
    if height is not None:
        return np.full(len(echogram), height)
    if stored:
        known = np.flatnonzero(np.isfinite(echogram.height_m))
        if not len(known):
            raise MitsonarError(
                "the recording states no height over the ground: leave out --stored-height, or give --height"
            )
        return np.interp(np.arange(len(echogram)), known, echogram.height_m[known])
    from mitsonar.geometry.side_scan import track_bottom

    return track_bottom(echogram).height_m


def convert_side_scan(recording: SideScan, out: Path, *, part: int | None, overwrite: bool) -> None:
    """Write a part as an XTF file, or as the echogram that ``mitsonar sound`` writes."""
    from mitsonar.recordings.write_xtf import write_xtf

    if out.suffix not in (".xtf", ".npz"):
        raise MitsonarError(
            f"{out}: a side-scan is converted to .xtf or .npz; {suggest_names(out.suffix or out.name, ['.xtf', '.npz'])}"
        )
    refuse_to_replace(out, overwrite=overwrite)
    _say_notes(recording)
    if len(recording.parts) > 1:
        number = recording.longest if part is None else part
        pings = len(recording.part(part))
        say(f"part {number} of {len(recording.parts):,}: {pings:,} of {count_noun(len(recording), 'ping')}")
    echogram = recording.part(part).read()
    if out.suffix == ".xtf":
        write_xtf(out, echogram)
    else:
        echogram.save(out)
    say(f"{count_noun(len(echogram), 'ping')} in {out}")


class MosaicRequest(NamedTuple):
    """What to lay, and how.

    Attributes:
        out: picture or GeoTIFF to write.
        quality: picture of the quality to write, if any.
        paths: paths by name, first the one of the map; empty for that of the recording.
        part: part of the recording.
        cell_mm: size of a cell [mm]; None for the default.
        height: height over the ground [m]; None to track the first return.
        stored_height: whether heights are those of the recording.
        declination: angle to add to headings [deg].
        flatten: whether levels are made even over angles.
    """

    out: Path
    quality: Path | None
    paths: Mapping[str, Trajectory]
    part: int | None
    cell_mm: float | None
    height: float | None
    stored_height: bool
    declination: float
    flatten: bool


def lay_side_scan(recording: SideScan, request: MosaicRequest) -> None:
    """Build the mosaic of a side-scan, write it and print its size."""
    from mitsonar.mapping.mosaic import MosaicOptions, save_geotiff
    from mitsonar.mapping.side_scan_mosaic import CELL_M, build_side_scan_mosaic
    from mitsonar.motion.trajectory import Trajectory

    _say_notes(recording)
    echogram = _with_poses(recording.part(request.part).read(), request)
    height_m = _heights(echogram, request.height, stored=request.stored_height)
    if request.height is None and not request.stored_height:
        _say_height(echogram, height_m)
    options = MosaicOptions(cell_m=CELL_M if request.cell_mm is None else request.cell_mm / 1e3)
    with progress_bar("laying", len(echogram), "pings") as progress:
        ground_map = build_side_scan_mosaic(echogram, height_m, options, flatten=request.flatten, progress=progress)
    if request.quality is None:
        save_geotiff(request.out, ground_map, echogram.origin)
    else:
        from mitsonar.plotting.figures import mosaic_figure, quality_figure, save_figure

        laid_along = {**request.paths, next(iter(request.paths), "recorded"): Trajectory(echogram.poses, echogram.time_s)}
        save_figure(request.out, mosaic_figure(ground_map, laid_along, title=recording.name, stretch=True))
        save_figure(request.quality, quality_figure(ground_map, title=recording.name))
    rows, columns = ground_map.mean.shape
    cell_m = ground_map.cell_m
    say(
        f"{count_noun(len(echogram), 'ping')}: {rows:,} x {columns:,} cells of {1e3 * cell_m:g} mm, "
        f"{rows * cell_m:.4g} x {columns * cell_m:.4g} m"
    )
    where = "a local world" if echogram.origin is None else f"EPSG:{echogram.origin.epsg}"
    bands = f", quality: {request.quality}" if request.quality else f" (bands: mean, standard deviation, count; {where})"
    say(f"mosaic: {request.out}{bands}")


def _with_poses(echogram: Echogram, request: MosaicRequest) -> Echogram:
    """Return the pings along the requested path, with the declination added to their headings."""
    if request.paths:
        path = next(iter(request.paths.values()))
        inside = (echogram.time_s > path.time_s[0] - CLOCK_S) & (echogram.time_s < path.time_s[-1] + CLOCK_S)
        if not inside.any():
            raise MitsonarError(
                f"the path covers {path.time_s[0]:.3f}..{path.time_s[-1]:.3f} s, and the pings "
                f"{echogram.time_s[0]:.3f}..{echogram.time_s[-1]:.3f} s: give a path with the clock of the recording"
            )
        if not inside.all():
            warn(f"left out beyond the path: {int((~inside).sum()):,} of {count_noun(len(echogram), 'ping')}")
        time_s = echogram.time_s[inside]
        echogram = replace(
            echogram,
            time_s=time_s,
            poses=path.at(np.clip(time_s, path.time_s[0], path.time_s[-1])),
            levels=echogram.levels[inside],
            height_m=echogram.height_m[inside],
        )
    poses = echogram.poses.copy()
    poses[:, 5] += math.radians(request.declination)
    return replace(echogram, poses=poses)


def _say_height(echogram: Echogram, height_m: NDArray[np.float64]) -> None:
    """Print the tracked height, and how it differs from that of the file."""
    line = f"height by the first return: {height_m.min():.2f}..{height_m.max():.2f} m"
    difference = (height_m - echogram.height_m)[np.isfinite(echogram.height_m)]
    if len(difference):
        line += f"; minus that of the file: median {np.median(difference):+.2f} m, spread {np.std(difference):.2f} m"
    say(line)


def _say_notes(recording: SideScan) -> None:
    for note in recording.notes:
        warn(note)
