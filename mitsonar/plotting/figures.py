"""How results become figures: mosaics, paths, impulse responses, soundings, data sets and Cramer-Rao bounds."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.geometry.side_scan import GroundScan
from mitsonar.io.files import write_atomic
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import AXES
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plotting.fans import GAMMA
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.soundings import DvlReadings, Echogram, Soundings
from mitsonar.records.strips import StripImage

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "crlb_png",
    "dvl_figure",
    "echogram_figure",
    "ground_range_figure",
    "height_map_figure",
    "mosaic_figure",
    "path_figure",
    "quality_figure",
    "range_figure",
    "response_figure",
    "response_png",
    "save_figure",
    "save_sounding_figure",
    "side_scan_figure",
    "soundings_figure",
    "strip_figure",
    "waterfall_figure",
    "waterfall_png",
]


ALMANZA_COLOURS = {
    "estimated": ("red", "darkblue"),
    "true": ("limegreen", "cyan"),
    "recorded": ("limegreen", "cyan"),
}
"""Colours of the line and of the arrows of a path (Almanza-Medina, fig. 2.9 and 3.7)."""

OTHER_COLOURS = (("tab:orange", "tab:brown"), ("tab:purple", "tab:pink"), ("tab:olive", "tab:gray"))

ARROWS = 20
"""Largest number of headings drawn along a path."""

ARROW_TURN_RAD = math.radians(20)
"""Turn after which a heading is drawn again, however short the way."""

UNSEEN_COLOUR = "0.9"
"""Grey of cells that no frame observed."""

BAND_STD = 2
"""Half width of error bands [standard deviations]."""


class LevelMap(Protocol):
    """A map of levels, such as :class:`mitsonar.mapping.mosaic.Mosaic`; unknown cells are nan."""

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Return the west, east, south and north edge [m]."""

    @property
    def mean(self) -> NDArray[np.floating]:
        """Return the mean level of each cell ``(rows, columns)``, with the northernmost row first."""

    @property
    def std(self) -> NDArray[np.floating]:
        """Return the standard deviation over frames of the level of each cell, shaped as ``mean``."""

    @property
    def count(self) -> NDArray[np.integer]:
        """Return the number of frames that show each cell, shaped as ``mean``."""


def mosaic_figure(
    mosaic: LevelMap, paths: Mapping[str, Trajectory] | None = None, *, title: str = "", stretch: bool = False
) -> Figure:
    """Draw the mean level of a mosaic with a scale bar, and paths of the sonar with arrows along its heading.

    Args:
        mosaic: mosaic to draw.
        paths: paths to draw, keyed by their names in the legend. ``estimated`` and ``true`` have the colours of
            Almanza-Medina's figures: red line with dark blue arrows, and green line with cyan arrows.
        title: title of the figure.
        stretch: show levels evenly between their percentiles 0.5 and 99.5, as suits levels in dB.
    """
    figure, (axes,) = _maps(1, mosaic, paths)
    level = mosaic.mean
    if stretch:
        norm, shown = Normalize(*np.nanpercentile(level, [0.5, 99.5])), ""
    else:
        norm, shown = (
            PowerNorm(GAMMA, vmin=0, vmax=float(np.nanpercentile(level, 99.9)) or 1.0),
            f"; shown with gamma {GAMMA:g}",
        )
    image = axes.imshow(level, extent=mosaic.extent, cmap="copper", norm=norm, interpolation="antialiased")
    figure.colorbar(image, ax=axes, label=f"mean level (1 = full scale{shown})", fraction=0.04)
    _draw_paths(axes, paths or {})
    _finish_map(axes, mosaic, paths or {}, title)
    return figure


def quality_figure(mosaic: LevelMap, *, title: str = "") -> Figure:
    """Draw the standard deviation of the levels of the frames that observed each cell, and the number of these frames."""
    figure, (left, right) = _maps(2, mosaic, None)
    std = mosaic.std
    maximum = float(np.nanpercentile(std, 99.5)) if np.isfinite(std).any() else 1.0
    image = left.imshow(std, extent=mosaic.extent, cmap="magma", vmin=0, vmax=maximum or 1.0, interpolation="antialiased")
    figure.colorbar(image, ax=left, label="standard deviation of the frames' levels", fraction=0.04)
    count = np.where(mosaic.count > 0, mosaic.count, np.nan)
    image = right.imshow(count, extent=mosaic.extent, cmap="viridis", vmin=0, interpolation="antialiased")
    figure.colorbar(image, ax=right, label="frames that saw the cell", fraction=0.04)
    for axes in (left, right):
        _finish_map(axes, mosaic, {}, title if axes is left else "")
    return figure


def height_map_figure(
    extent: tuple[float, float, float, float], maps: Mapping[str, NDArray[np.floating]], *, title: str = ""
) -> Figure:
    """Draw maps of heights with one scale of colours, and maps of standard deviations with another.

    Args:
        extent: west, east, south and north edge of the maps [m].
        maps: maps ``(rows, columns)`` [m] keyed by name, with the northernmost row first; nan where unknown. Names that
            begin with ``standard deviation`` have the second scale.
        title: title of the figure.
    """
    figure = Figure(figsize=(4.6 * len(maps), 4.4), layout="constrained")
    deviations = {name: values for name, values in maps.items() if name.startswith("standard deviation")}
    heights = [values for name, values in maps.items() if name not in deviations]
    low, high = (float(np.nanpercentile(np.stack(heights), part)) for part in (0.5, 99.5)) if heights else (0.0, 1.0)
    for number, (name, values) in enumerate(maps.items()):
        axes = figure.add_subplot(1, len(maps), number + 1)
        axes.set_facecolor(UNSEEN_COLOUR)
        scale: dict[str, Any] = {"cmap": "viridis", "vmin": low, "vmax": high}
        if name in deviations:
            scale = {"cmap": "magma", "vmin": 0.0, "vmax": float(np.nanpercentile(values, 99.5)) or 1.0}
        image = axes.imshow(values, extent=extent, interpolation="nearest", **scale)
        figure.colorbar(image, ax=axes, label="m", fraction=0.04)
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("x, east [m]")
        axes.set_ylabel("y, north [m]")
    if title:
        figure.suptitle(title, fontsize=11, parse_math=False)  # names of files may hold $
    return figure


def path_figure(
    paths: Mapping[str, Trajectory],
    *,
    motion_covariances: Mapping[str, NDArray[np.float64]] | None = None,
    pose_covariances: Mapping[str, NDArray[np.float64]] | None = None,
    title: str = "",
) -> Figure:
    """Draw paths from above, and their heading and motion between frames over time (eq. 3.4).

    Args:
        paths: paths to draw, keyed by name; colours as in :func:`mosaic_figure`.
        motion_covariances: covariances of the motions (sideways, forward [m], yaw [rad]) ``(frames - 1, 3, 3)``, keyed by
            path; nan where unknown. Bands show two standard deviations.
        pose_covariances: covariances of the poses (x, y [m], heading [rad]) ``(frames, 3, 3)``, keyed by path. Ellipses
            along the path and the band of the heading show two standard deviations.
        title: title of the figure.

    Raises:
        MitsonarError: there is no path, a covariance names an unknown path, or its shape does not fit its path.
    """
    if not paths:
        raise MitsonarError("there is no path to draw: give at least one")
    motion_bands = _checked_covariances(paths, motion_covariances or {}, "motion_covariances", fewer=1)
    pose_bands = _checked_covariances(paths, pose_covariances or {}, "pose_covariances", fewer=0)
    figure = Figure(figsize=(13.0, 7.0), layout="constrained")
    grid = figure.add_gridspec(len(AXES) + 1, 2)
    above = figure.add_subplot(grid[:, 0])
    over_time = [figure.add_subplot(grid[0, 1])]
    over_time += [figure.add_subplot(grid[row, 1], sharex=over_time[0]) for row in range(1, len(AXES) + 1)]
    _draw_paths(above, paths)
    start_s = min(float(path.time_s[0]) for path in paths.values())
    start_s = start_s if start_s > CLOCK_FROM_S else 0.0
    for name, line, _ in _path_colours(paths):
        path = paths[name]
        time_s = path.time_s - start_s
        if name in pose_bands:
            _draw_ellipses(above, path.poses[:, :2], pose_bands[name][:, :2, :2], line)
        heading = np.degrees(np.unwrap(path.poses[:, 5]))
        _plot_with_band(over_time[0], time_s, heading, _std(pose_bands.get(name), 2, math.degrees(1)), line)
        path_motions = motions(path.poses)
        for axis, (_, _, scale) in enumerate(AXES):
            band = _std(motion_bands.get(name), axis, scale)
            _plot_with_band(over_time[1 + axis], time_s[1:], path_motions[:, axis] * scale, band, line)
    _label_path(above, over_time, title)
    over_time[-1].set_xlabel("time since the first frame (s)" if start_s else "time (s)")
    return figure


def save_figure(path: str | Path, figure: Figure, *, dpi: int = 130) -> None:
    """Write a figure in the format of the file's extension, such as ``.png``, ``.pdf`` or ``.svg``.

    The file is written completely or not at all.

    Raises:
        MitsonarError: the extension is not a format of figures.
    """
    kind = Path(path).suffix.lstrip(".").lower()
    known = figure.canvas.get_supported_filetypes()
    if kind not in known:
        raise MitsonarError(f"a figure's name must end in one of {', '.join(sorted(known))}: got {str(path)!r}")
    write_atomic(path, _encoded(figure, dpi, kind))


def _encoded(figure: Figure, dpi: int, kind: str = "png", **options: Any) -> bytes:
    """Return the bytes of a figure in a format of Matplotlib."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=dpi, **options)
    return buffer.getvalue()


# ---------------- Maps


def _maps(panels: int, mosaic: LevelMap, paths: Mapping[str, Trajectory] | None) -> tuple[Figure, list[Axes]]:
    """Create a figure of maps side by side, with the aspect ratio of the mosaic and the paths."""
    west, east, south, north = _view(mosaic, paths or {})
    height = float(np.clip(9.0 * (north - south) / (east - west), 3.5, 9.0))
    width = float(np.clip(height * (east - west) / (north - south), 3.5, 11.0))
    figure = Figure(figsize=(panels * (width + 1.6), height + 0.8), layout="compressed")
    axes = [figure.add_subplot(1, panels, 1 + panel, facecolor=UNSEEN_COLOUR) for panel in range(panels)]
    return figure, axes


def _view(mosaic: LevelMap, paths: Mapping[str, Trajectory]) -> tuple[float, float, float, float]:
    """Return the west, east, south and north limits of a map and its paths [m], with a margin."""
    west, east, south, north = mosaic.extent
    point_sets = [np.array([[west, south], [east, north]]), *(path.poses[:, :2] for path in paths.values())]
    low, high = (
        np.min([points.min(axis=0) for points in point_sets], axis=0),
        np.max([points.max(axis=0) for points in point_sets], axis=0),
    )
    margin = 0.04 * float((high - low).max())
    return low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin


def _finish_map(axes: Axes, mosaic: LevelMap, paths: Mapping[str, Trajectory], title: str) -> None:
    """Set limits, labels, scale bar and legend."""
    west, east, south, north = _view(mosaic, paths)
    axes.set(xlim=(west, east), ylim=(south, north), aspect="equal")
    axes.set(xlabel="x, east (m)", ylabel="y, north (m)")
    axes.set_title(title, parse_math=False)  # names of files may hold $
    _scale_bar(axes, east - west)
    if paths:
        axes.legend(loc="upper left", fontsize="small")


def _scale_bar(axes: Axes, width_m: float) -> None:
    """Draw a scale bar of a round length, about a fifth of the map's width."""
    from matplotlib.patches import Rectangle

    length = _round_length(width_m / 5)
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    right, low, thick = east - 0.03 * (east - west), south + 0.03 * (north - south), 0.012 * (north - south)
    bar = Rectangle((right - length, low), length, thick, facecolor="black", edgecolor="white", zorder=5)
    axes.add_patch(bar)
    label = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
    box = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1.5}
    axes.text(right - length / 2, low + 2 * thick, label, ha="center", va="bottom", bbox=box, zorder=5)


def _round_length(limit: float) -> float:
    """Return the largest number <= ``limit`` that is 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(limit))
    return max(step * power for step in (1, 2, 5) if step * power <= limit * (1 + 1e-9))


# ---------------- Paths


def _path_colours(paths: Mapping[str, Trajectory]) -> Iterator[tuple[str, str, str]]:
    """Yield name, line colour and arrow colour of each path."""
    others = 0
    for name in paths:
        if name in ALMANZA_COLOURS:
            yield name, *ALMANZA_COLOURS[name]
        else:
            yield name, *OTHER_COLOURS[others % len(OTHER_COLOURS)]
            others += 1


CLOCK_FROM_S = 1e6
"""Paths that begin later have times of a clock, such as seconds since 1970, and are drawn from their first frame [s]."""


def _label_path(above: Axes, over_time: list[Axes], title: str) -> None:
    """Set labels, legend and grids of :func:`path_figure`."""
    above.set(xlabel="x, east (m)", ylabel="y, north (m)", aspect="equal")
    above.set_title(title, parse_math=False)
    above.set_adjustable("datalim")
    above.legend(loc="best")
    over_time[0].set_ylabel("heading (deg)")
    for axes, (name, unit, _) in zip(over_time[1:], AXES, strict=True):
        axes.set_ylabel(f"{name} ({unit})")
    for axes in (above, *over_time):
        axes.grid(alpha=0.3)


def _draw_paths(axes: Axes, paths: Mapping[str, Trajectory]) -> None:
    """Draw lines with arrows along the heading and a mark at the start, which the legend explains."""
    colours = list(_path_colours(paths))
    for name, line, _ in colours:
        poses = paths[name].poses
        axes.plot(poses[:, 0], poses[:, 1], color=line, label=name, linewidth=1.5, zorder=3)
        axes.plot(*poses[0, :2], marker="o", color=line, markersize=4, zorder=3)
    spacing_m = max(axes.dataLim.width, axes.dataLim.height) / ARROWS
    for name, _, arrow in colours:
        arrow_poses = paths[name].poses[_arrow_indices(paths[name].poses, spacing_m)]
        direction = np.sin(arrow_poses[:, 5]), np.cos(arrow_poses[:, 5])
        axes.quiver(*arrow_poses[:, :2].T, *direction, color=arrow, scale=25, width=0.003, zorder=4)
    if paths:
        axes.plot([], [], linestyle="none", marker="o", color="grey", markersize=4, label="start")
        axes.plot([], [], linestyle="none", marker=r"$\rightarrow$", color="grey", markersize=10, label="heading")


def _sample_indices(frames: int) -> NDArray[np.intp]:
    """Return the numbers of the frames that get arrows and ellipses, evenly spread."""
    return np.unique(np.linspace(0, frames - 1, min(ARROWS, frames)).astype(np.intp))


def _arrow_indices(poses: NDArray[np.float64], spacing_m: float) -> list[int]:
    """Return the numbers of the frames that get arrows: those some way [m] or some turn after the one before."""
    chosen: list[int] = []
    for index in _sample_indices(len(poses)).tolist():
        last = poses[chosen[-1]] if chosen else None
        turn = 0.0 if last is None else abs(math.remainder(poses[index, 5] - last[5], 2 * math.pi))
        if last is None or math.dist(poses[index, :2], last[:2]) >= spacing_m or turn > ARROW_TURN_RAD:
            chosen.append(index)
    return chosen


def _draw_ellipses(axes: Axes, positions: NDArray[np.float64], covariance: NDArray[np.float64], colour: str) -> None:
    """Draw ellipses of two standard deviations around some of the positions ``(frames, 2)`` [m]."""
    from matplotlib.patches import Ellipse

    for index in _sample_indices(len(positions)):
        if np.isfinite(covariance[index]).all():
            variance, direction = np.linalg.eigh(covariance[index])
            width, height = 2 * BAND_STD * np.sqrt(np.maximum(variance, 0))
            angle = math.degrees(math.atan2(direction[1, 0], direction[0, 0]))
            axes.add_patch(
                Ellipse(tuple(positions[index]), width, height, angle=angle, color=colour, alpha=0.2, linewidth=0)
            )


def _checked_covariances(
    paths: Mapping[str, Trajectory], covariances: Mapping[str, NDArray[np.float64]], what: str, fewer: int
) -> dict[str, NDArray[np.float64]]:
    """Return covariances as arrays, after checking that they fit their paths.

    Args:
        paths: paths, keyed by name.
        covariances: covariances, keyed by path.
        what: name of the argument, for error messages.
        fewer: number of frames minus number of covariances.

    Raises:
        MitsonarError: a covariance names an unknown path, or has a wrong shape.
    """
    for name, values in covariances.items():
        if name not in paths:
            raise MitsonarError(f"{what} names a path that is not drawn: got {name!r}; paths: {', '.join(paths)}")
        expected_shape = (len(paths[name]) - fewer, 3, 3)
        if np.shape(values) != expected_shape:
            raise MitsonarError(f"{what} of {name} must be {expected_shape}: got {np.shape(values)}")
    return {name: np.asarray(values, dtype=float) for name, values in covariances.items()}


def _std(covariances: NDArray[np.float64] | None, axis: int, scale: float) -> NDArray[np.float64] | None:
    return None if covariances is None else scale * np.sqrt(covariances[:, axis, axis])


def _plot_with_band(
    axes: Axes, time: NDArray[np.float64], value: NDArray[np.float64], std: NDArray[np.float64] | None, colour: str
) -> None:
    """Draw a line with a band of two standard deviations."""
    axes.plot(time, value, color=colour, linewidth=1.0, marker="o" if len(time) == 1 else "", markersize=3)
    if std is not None:
        axes.fill_between(time, value - BAND_STD * std, value + BAND_STD * std, color=colour, alpha=0.2, linewidth=0)


# ---------------- Impulse responses


MIN_LEVEL_DB = -40.0
"""Lower end of the scale of a waterfall [dB]."""


def response_figure(responses: ImpulseResponses, ping: int = 0) -> Figure:
    """Draw the magnitude, real and imaginary parts of one ping over taps and range (Almanza-Medina, fig. 5.4)."""
    sonar, count = responses.sonar, len(responses.sonar.receivers)
    values = responses.response[ping] / max(float(np.abs(responses.response[ping]).max()), 1e-30)
    begin, end = _strong_taps(responses)
    figure = Figure(figsize=(9, 1.2 + 1.5 * count), layout="constrained")
    grid = figure.subplots(count, 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    taps = np.arange(begin, end)
    for axes, response, receiver in zip(grid, values, sonar.receivers, strict=True):
        axes.plot(taps, np.abs(response[begin:end]), color="black", lw=1.2, label="magnitude")
        axes.plot(taps, response[begin:end].real, color="tab:blue", lw=0.7, label="real")
        axes.plot(taps, response[begin:end].imag, color="tab:orange", lw=0.7, label="imaginary")
        axes.set_ylabel(receiver.name)
        axes.grid(alpha=0.3)
    taps_per_m = 2 * sonar.sampling_hz / sonar.sound_speed
    range_axis = grid[0].secondary_xaxis(
        "top", functions=(lambda tap: tap / taps_per_m, lambda range_m: range_m * taps_per_m)
    )
    range_axis.set_xlabel("half the path's length (m)")
    grid[0].legend(loc="upper right", fontsize=8, ncols=3)
    grid[-1].set_xlabel(f"tap ({1e3 / sonar.sampling_hz:.4g} ms each)")
    figure.suptitle(_title(responses, f"ping {ping}, divided by the largest magnitude"), fontsize=10)
    return figure


def waterfall_figure(responses: ImpulseResponses) -> Figure:
    """Draw the magnitude over time and delay at each receiver, in dB relative to the largest of all."""
    sonar, count = responses.sonar, len(responses.sonar.receivers)
    begin, end = _strong_taps(responses)
    level = np.abs(responses.response[:, :, begin:end])
    decibel = 20 * np.log10(np.maximum(level / max(float(level.max()), 1e-30), 10 ** (MIN_LEVEL_DB / 20)))
    time = responses.time_s
    half = 0.5 * (time[1] - time[0]) if len(time) > 1 else 0.5 / sonar.frame_rate_hz
    # Each row is centred on the time of its ping.
    extent = (1e3 * begin / sonar.sampling_hz, 1e3 * end / sonar.sampling_hz, time[-1] + half, time[0] - half)
    figure = Figure(figsize=(2.6 * count + 1.6, 4.5), layout="constrained")
    grid = figure.subplots(1, count, sharex=True, sharey=True, squeeze=False)[0]
    for number, (axes, receiver) in enumerate(zip(grid, sonar.receivers, strict=True)):
        image = axes.imshow(
            decibel[:, number],
            extent=extent,
            aspect="auto",
            cmap="magma",
            vmin=MIN_LEVEL_DB,
            vmax=0,
            interpolation="nearest",
        )
        axes.set(title=receiver.name, xlabel="delay (ms)")
    grid[0].set_ylabel("time (s)")
    figure.colorbar(image, ax=list(grid), label="dB of the largest of all receivers", fraction=0.04)
    figure.suptitle(_title(responses, count_noun(len(responses), "ping")), fontsize=10)
    return figure


def response_png(responses: ImpulseResponses) -> bytes:
    """Return :func:`response_figure` of the first ping as a PNG file."""
    return _encoded(response_figure(responses), 110)


def waterfall_png(responses: ImpulseResponses) -> bytes:
    """Return :func:`waterfall_figure` as a PNG file."""
    return _encoded(waterfall_figure(responses), 110)


def _strong_taps(responses: ImpulseResponses) -> tuple[int, int]:
    """Return the first tap with a visible level and the end of the last one (exclusive), with a margin."""
    level = np.abs(responses.response).max(axis=(0, 1))
    strong = np.flatnonzero(level > level.max() * 10 ** (MIN_LEVEL_DB / 20))
    if not level.max() > 0:
        return 0, len(level)
    margin = max(4, (strong[-1] - strong[0]) // 10)
    return max(0, int(strong[0] - margin)), min(len(level), int(strong[-1] + margin + 1))


def _title(responses: ImpulseResponses, what: str) -> str:
    sonar = responses.sonar
    bands = f"{sonar.carrier_hz / 1e3:g} kHz, bandwidth {sonar.bandwidth_hz / 1e3:g} kHz"
    return f"{sonar.title}, {sonar.model} model: {bands}; {what}"


# ---------------- Echo sounders, side-scan sonars and DVLs


SHOWN_SPAN_DB = 50.0
"""Range of levels shown, downwards from full scale [dB]."""

MAX_POINTS = 200_000
"""Approximate largest number of points drawn of a point cloud."""


def save_sounding_figure(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file, completely or not at all."""
    write_atomic(path, _encoded(figure, 110, metadata={"Software": None}))


def side_scan_figure(
    echogram: Echogram,
    first_return_m: NDArray[np.float64] | None = None,
    *,
    span_db: float = SHOWN_SPAN_DB,
    title: str | None = None,
) -> Figure:
    """Draw the waterfall of a side-scan sonar: slant range across with port to the left, the first ping at the bottom.

    Args:
        echogram: levels of port and starboard.
        first_return_m: slant range of the first return of each ping ``(pings,)`` [m], to draw as a line on either side.
        span_db: range of levels to show below full scale [dB].
        title: title of the figure; default: the instrument, its model and the number of pings.
    """
    figure, axes = _single_axes(8.4, 5.2)
    level, channels = echogram.decibels(span_db), echogram.sounder.channels
    port, starboard = (level[:, channels.index(side)] for side in ("port", "starboard"))
    far, near = echogram.sounder.fan.range_max, echogram.sounder.fan.range_min
    along = _path_extent(echogram)
    options = _waterfall_options(span_db)
    image = axes.imshow(port[:, ::-1], extent=(-far, -near, *along), **options)
    axes.imshow(starboard, extent=(near, far, *along), **options)
    if first_return_m is not None:
        place = along[0] + (np.arange(len(echogram)) + 0.5) * (along[1] - along[0]) / len(echogram)
        axes.plot(-first_return_m, place, color="cyan", lw=0.8, label="first return")
        axes.plot(first_return_m, place, color="cyan", lw=0.8)
        axes.legend(loc="lower right", fontsize=8)
    axes.set(xlim=(-far, far), ylim=along, xlabel="slant range, port - starboard (m)", ylabel=_along_label(echogram))
    figure.colorbar(image, ax=axes, label="level (dB)")
    usual = f"{echogram.sounder.name}, {echogram.sounder.fan.model}, {count_noun(len(echogram), 'ping')}"
    axes.set_title(usual if title is None else title, fontsize=10, parse_math=False)
    return figure


def ground_range_figure(scan: GroundScan, *, span_db: float = SHOWN_SPAN_DB, title: str = "") -> Figure:
    """Draw the waterfall of a side-scan sonar over ground range, port to the left, the first ping at the bottom."""
    figure, axes = _single_axes(8.4, 5.2)
    full_scale = float(np.nanpercentile(scan.levels, 99.9)) or 1.0
    level = 10 * np.log10(np.clip(scan.levels / full_scale, 10 ** (-span_db / 10), 1))
    along = _path_extent(scan.echogram)
    half = (scan.across_m[-1] - scan.across_m[0]) / (len(scan.across_m) - 1) / 2
    extent = (scan.across_m[0] - half, scan.across_m[-1] + half, *along)
    axes.set_facecolor(UNSEEN_COLOUR)
    image = axes.imshow(level, extent=extent, **_waterfall_options(span_db))
    axes.set(ylim=along, xlabel="ground range, port - starboard (m)", ylabel=_along_label(scan.echogram))
    figure.colorbar(image, ax=axes, label="level (dB)")
    axes.set_title(title, fontsize=10, parse_math=False)
    return figure


def _waterfall_options(span_db: float) -> dict[str, Any]:
    """Return the options of a picture of levels in dB whose first row is at the bottom.

    Raises:
        MitsonarError: the span is not in 0..300 dB.
    """
    if not 0 < span_db <= 300:
        raise MitsonarError(f"the span must lie in 0..300 dB: got {span_db:g}")
    return {
        "cmap": "copper",
        "vmin": -span_db,
        "vmax": 0,
        "aspect": "auto",
        "origin": "lower",
        "interpolation": "nearest",
    }


def _along_label(echogram: Echogram) -> str:
    """Return what :func:`_path_extent` counts along."""
    moved = np.ptp(echogram.poses[:, :3], axis=0).max() > 0
    return "along the path (m)" if moved else "ping"


def strip_figure(image: StripImage, *, title: str = "", span_db: float = 50.0) -> Figure:
    """Draw a stripmap image to scale: the track runs upwards, starboard is to the right."""
    edges = [_outer_edges(values) for values in (image.grid.across_m, image.grid.along_m)]
    ratio = abs((edges[1][1] - edges[1][0]) / (edges[0][1] - edges[0][0]))
    figure, axes = _single_axes(8.4, min(max(7.0 * ratio, 2.4), 12.0))
    drawn = axes.imshow(
        image.decibels(span_db),
        extent=(*edges[0], *edges[1]),
        cmap="copper",
        vmin=-span_db,
        vmax=0,
        aspect="equal",
        origin="lower",
        interpolation="antialiased",
    )
    axes.set(xlim=sorted(edges[0]), ylim=edges[1], xlabel="ground range to starboard (m)", ylabel="along the track (m)")
    figure.colorbar(drawn, ax=axes, label="level (dB)", fraction=0.046 * min(ratio, 1.0), pad=0.02)
    axes.set_title(title, fontsize=10, parse_math=False)
    return figure


def _outer_edges(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the outer edges of the first and the last of evenly spaced pixels."""
    half = 0.5 * float(values[1] - values[0]) if len(values) > 1 else 0.5
    return float(values[0]) - half, float(values[-1]) + half


def echogram_figure(echogram: Echogram, soundings: Soundings | None = None) -> Figure:
    """Draw the levels of the first channel over time and range, with the detections on top."""
    figure, axes = _single_axes(8.4, 3.8)
    time_s, fan = echogram.time_s, echogram.sounder.fan
    half = 0.5 * (time_s[-1] - time_s[0]) / max(1, len(time_s) - 1) or 0.5 / fan.frame_rate_hz
    extent = (time_s[0] - half, time_s[-1] + half, fan.range_max, fan.range_min)
    options = {"cmap": "viridis", "vmin": -SHOWN_SPAN_DB, "vmax": 0, "aspect": "auto", "interpolation": "nearest"}
    image = axes.imshow(echogram.decibels(SHOWN_SPAN_DB)[:, 0].T, extent=extent, **options)
    if soundings is not None:
        axes.plot(time_s, soundings.range_m[:, 0, 0], color="tab:red", lw=1, label="first echo")
        axes.legend(loc="lower right", fontsize=8)
    axes.set(xlabel="time (s)", ylabel="range (m)")
    axes.set_title(f"{echogram.sounder.name}, {fan.model}, {count_noun(len(echogram), 'ping')}", fontsize=10)
    figure.colorbar(image, ax=axes, label="level (dB)")
    return figure


def soundings_figure(soundings: Soundings) -> Figure:
    """Draw the soundings from above, coloured by their height."""
    figure, axes = _single_axes(6.4, 5.2)
    points = soundings.points()[soundings.found]
    points = points[:: max(1, len(points) // MAX_POINTS)]
    low, high = np.percentile(points[:, 2], [1, 99]) if len(points) else (0, 1)
    scatter = axes.scatter(*points.T[:2], c=points[:, 2], s=1.5, lw=0, cmap="viridis", vmin=low, vmax=high)
    axes.set(xlabel="x, east (m)", ylabel="y, north (m)", aspect="equal")
    axes.set_title(f"{soundings.sounder.name}: {count_noun(int(soundings.found.sum()), 'sounding')}", fontsize=10)
    figure.colorbar(scatter, ax=axes, label="z (m)")
    return figure


def range_figure(soundings: Soundings, ping: int = 0) -> Figure:
    """Draw the range image of one ping: rows over beams."""
    figure, axes = _single_axes(7.6, 4.2)
    sounder = soundings.sounder
    half_bearing = np.degrees(np.abs(sounder.fan.bearing_rad).max())
    half_elevation = sounder.rows * sounder.fan.elevation_fov_deg / 2
    range_image = soundings.range_m[ping, : sounder.rows]
    image = axes.imshow(
        range_image,
        extent=(-half_bearing, half_bearing, -half_elevation, half_elevation),
        cmap="viridis_r",
        aspect="auto",
        interpolation="nearest",
    )
    axes.set(xlabel="bearing (deg)", ylabel="elevation (deg)")
    axes.set_title(f"{sounder.name}, {sounder.fan.model}, ping {ping}", fontsize=10)
    figure.colorbar(image, ax=axes, label="range (m)")
    return figure


def dvl_figure(readings: DvlReadings, true: NDArray[np.float64] | None = None) -> Figure:
    """Draw the velocities of a DVL with bands of two standard deviations, and the altitude.

    Args:
        readings: readings of the DVL.
        true: true velocities of the vehicle ``(pings, 3)`` [m/s], if known.
    """
    figure = Figure(figsize=(8.4, 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    time_s = readings.soundings.time_s
    std = np.sqrt(np.diagonal(readings.covariance, axis1=1, axis2=2))
    for axis, (name, colour) in enumerate((("starboard", "tab:blue"), ("forward", "tab:orange"), ("up", "tab:green"))):
        velocity = readings.velocity[:, axis]
        above.plot(time_s, velocity, ".", ms=3, color=colour, label=name)
        above.fill_between(time_s, velocity - 2 * std[:, axis], velocity + 2 * std[:, axis], color=colour, alpha=0.2, lw=0)
        if true is not None:
            above.plot(time_s, true[:, axis], color="black", lw=0.8)
    above.set_ylabel("velocity (m/s)")
    above.legend(loc="upper right", fontsize=8, ncols=3)
    below.plot(time_s, readings.altitude_m, ".", ms=3, color="black")
    below.set(xlabel="time (s)", ylabel="altitude (m)")
    unlocked = int((~readings.locked).sum())
    above.set_title(
        f"{readings.soundings.sounder.name}: {count_noun(len(time_s), 'ping')}, {unlocked} without bottom lock", fontsize=10
    )
    return figure


def _single_axes(width: float, height: float) -> tuple[Figure, Any]:
    """Return a figure with one pair of axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def _path_extent(echogram: Echogram) -> tuple[float, float]:
    """Return where the first ping begins and the last one ends along the path [m], or in pings for a vehicle at rest."""
    steps = np.linalg.norm(np.diff(echogram.poses[:, :3], axis=0), axis=1)
    length = float(steps.sum())
    if length < 1e-9:
        return -0.5, len(echogram) - 0.5
    half = length / len(steps) / 2
    return -half, length + half


# ---------------- Cramer-Rao bounds


Report: TypeAlias = Mapping[str, Any]
"""A report of :mod:`mitsonar.estimation.crlb.report`, with the bounds under the key ``rows``."""


def crlb_png(report: Report) -> bytes:
    """Return a figure of the bounds for two frames, over the varied quantity or over the poses, as a PNG file."""
    name = report["vary"]
    rows = -(-len(report["units"]) // 3)
    figure = Figure(figsize=(11, 3.6 * rows), layout="constrained")
    panels = figure.subplots(rows, min(len(report["units"]), 3), squeeze=False).ravel()
    for panel in panels[len(report["units"]) :]:
        panel.set_axis_off()
    series: dict[str, list[tuple[float | str, list[float | None]]]] = {}
    for row in report["rows"]:
        label = " ".join([row["portion"], row["data"], row["law"]])
        if name is None:
            series[label] = list(enumerate(row["two_frames_each"]))
        elif row["two_frames"] is not None:
            x = "..".join(f"{v:g}" for v in row[name]) if name == "window" else row[name]
            series.setdefault(label, []).append((x, row["two_frames"]))
    for axis, (panel, unit) in enumerate(zip(panels, report["units"], strict=False)):
        for label, points in series.items():
            known = [(x, std[axis]) for x, std in points if std[axis] is not None]
            panel.plot([x for x, _ in known], [y for _, y in known], "o-" if name else ".", label=label, markersize=4)
        panel.set(xlabel=name or "pose", ylabel=unit, yscale="log")
        panel.grid(alpha=0.3, which="both")
    panels[0].legend(fontsize=7)
    figure.suptitle(f"least standard deviation of two frames, noise {report['noise']}", fontsize=10)
    return _encoded(figure, 120)
