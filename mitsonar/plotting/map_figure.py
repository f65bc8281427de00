"""Figures of mosaics and paths."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.io.files import write_whole
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import AXES
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plotting.fan_figure import GAMMA

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mitsonar.mapping.mosaic import Mosaic

__all__ = ["mosaic_figure", "path_figure", "quality_figure", "save_figure"]

ALMANZA_COLOURS = {"estimated": ("red", "darkblue"), "true": ("limegreen", "cyan")}
"""Line and arrows of a path (Almanza-Medina, fig. 2.9 and 3.7)."""

OTHER_COLOURS = (("tab:orange", "tab:brown"), ("tab:purple", "tab:pink"), ("tab:olive", "tab:gray"))

ARROWS = 20
"""Number of headings drawn along a path, about."""

UNSEEN = "0.9"
"""Grey of cells that no frame observed."""

BAND = 2
"""Half width of error bands [standard deviations]."""


def mosaic_figure(mosaic: Mosaic, paths: Mapping[str, Trajectory] | None = None, *, title: str = "") -> Figure:
    """Draw the mean level of a mosaic in metres, with a scale bar, and paths of the sonar with arrows along its heading.

    Args:
        mosaic: to draw.
        paths: by name, for the legend; ``estimated`` and ``true`` have the colours of Almanza-Medina's figures: red line and
            dark blue arrows, green line and cyan arrows.
        title: of the figure.
    """
    from matplotlib.colors import PowerNorm

    figure, (axes,) = _maps(1, mosaic, paths)
    level = mosaic.mean
    norm = PowerNorm(GAMMA, vmin=0, vmax=float(np.nanpercentile(level, 99.9)) or 1.0)
    shown = axes.imshow(level, extent=mosaic.extent, cmap="copper", norm=norm, interpolation="antialiased")
    figure.colorbar(shown, ax=axes, label=f"mean level (1 = full scale; shown with gamma {GAMMA:g})", fraction=0.04)
    _draw_paths(axes, paths or {})
    _finish_map(axes, mosaic, paths or {}, title)
    return figure


def quality_figure(mosaic: Mosaic, *, title: str = "") -> Figure:
    """Draw the standard deviation of the frames that observed each cell, and their number."""
    figure, (left, right) = _maps(2, mosaic, None)
    spread = mosaic.std
    top = float(np.nanpercentile(spread, 99.5)) if np.isfinite(spread).any() else 1.0
    shown = left.imshow(spread, extent=mosaic.extent, cmap="magma", vmin=0, vmax=top or 1.0, interpolation="antialiased")
    figure.colorbar(shown, ax=left, label="standard deviation of the frames' levels", fraction=0.04)
    count = np.where(mosaic.count > 0, mosaic.count, np.nan)
    shown = right.imshow(count, extent=mosaic.extent, cmap="viridis", vmin=0, interpolation="antialiased")
    figure.colorbar(shown, ax=right, label="frames that saw the cell", fraction=0.04)
    for axes in (left, right):
        _finish_map(axes, mosaic, {}, title if axes is left else "")
    return figure


def path_figure(
    paths: Mapping[str, Trajectory],
    *,
    motion_covariances: Mapping[str, NDArray[np.float64]] | None = None,
    pose_covariances: Mapping[str, NDArray[np.float64]] | None = None,
    title: str = "",
) -> Figure:
    """Draw paths from above, and over time the heading and the motion between frames on each axis (eq. 3.4).

    Args:
        paths: by name; colours as in :func:`mosaic_figure`.
        motion_covariances: of (sideways, forward [m], yaw [rad]) ``(frames - 1, 3, 3)`` of the paths that have them; nan
            where unknown. Bands show two standard deviations.
        pose_covariances: of (x, y [m], heading [rad]) ``(frames, 3, 3)``, for ellipses along the path and the band of the
            heading; two standard deviations too.
        title: of the figure.

    Raises:
        MitsonarError: no path, a covariance of an unknown path, or one whose shape does not fit its path.
    """
    from matplotlib.figure import Figure

    if not paths:
        raise MitsonarError("there is no path to draw: give at least one")
    of_motions = _checked(paths, motion_covariances or {}, "motion_covariances", fewer=1)
    of_poses = _checked(paths, pose_covariances or {}, "pose_covariances", fewer=0)
    figure = Figure(figsize=(13.0, 7.0), layout="constrained")
    grid = figure.add_gridspec(len(AXES) + 1, 2)
    above = figure.add_subplot(grid[:, 0])
    over_time = [figure.add_subplot(grid[0, 1])]
    over_time += [figure.add_subplot(grid[row, 1], sharex=over_time[0]) for row in range(1, len(AXES) + 1)]
    _draw_paths(above, paths)
    for name, line, _ in _colours(paths):
        path = paths[name]
        if name in of_poses:
            _draw_ellipses(above, path.poses[:, :2], of_poses[name][:, :2, :2], line)
        heading = np.degrees(np.unwrap(path.poses[:, 5]))
        _banded(over_time[0], path.time_s, heading, _std(of_poses.get(name), 2, math.degrees(1)), line)
        moved = motions(path.poses)
        for axis, (_, _, scale) in enumerate(AXES):
            band = _std(of_motions.get(name), axis, scale)
            _banded(over_time[1 + axis], path.time_s[1:], moved[:, axis] * scale, band, line)
    _label(above, over_time, title)
    return figure


def save_figure(path: str | Path, figure: Figure, *, dpi: int = 130) -> None:
    """Write a figure, whole or not at all, in the format of the name's ending: ``.png``, ``.pdf``, ``.svg``.

    Raises:
        MitsonarError: the ending is no format of figures.
    """
    kind = Path(path).suffix.lstrip(".").lower()
    known = figure.canvas.get_supported_filetypes()
    if kind not in known:
        raise MitsonarError(f"a figure's name must end in one of {', '.join(sorted(known))}: got {str(path)!r}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=dpi)
    write_whole(path, buffer.getvalue())


# ---------------------------------------------------------------- maps


def _maps(panels: int, mosaic: Mosaic, paths: Mapping[str, Trajectory] | None) -> tuple[Figure, list[Axes]]:
    """Create a figure of maps side by side, with the proportions of the ground and the paths."""
    from matplotlib.figure import Figure

    west, east, south, north = _view(mosaic, paths or {})
    height = float(np.clip(9.0 * (north - south) / (east - west), 3.5, 9.0))
    width = float(np.clip(height * (east - west) / (north - south), 3.5, 11.0))
    figure = Figure(figsize=(panels * (width + 1.6), height + 0.8), layout="compressed")
    axes = [figure.add_subplot(1, panels, 1 + panel, facecolor=UNSEEN) for panel in range(panels)]
    return figure, axes


def _view(mosaic: Mosaic, paths: Mapping[str, Trajectory]) -> tuple[float, float, float, float]:
    """Return west, east, south, north of a map and its paths [m], with a margin."""
    west, east, south, north = mosaic.extent
    places = [np.array([[west, south], [east, north]]), *(path.poses[:, :2] for path in paths.values())]
    low, high = np.min([p.min(axis=0) for p in places], axis=0), np.max([p.max(axis=0) for p in places], axis=0)
    margin = 0.04 * float((high - low).max())
    return low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin


def _finish_map(axes: Axes, mosaic: Mosaic, paths: Mapping[str, Trajectory], title: str) -> None:
    """Set limits, labels, scale bar and legend."""
    west, east, south, north = _view(mosaic, paths)
    axes.set(xlim=(west, east), ylim=(south, north), aspect="equal")
    axes.set(xlabel="x, east (m)", ylabel="y, north (m)", title=title)
    _scale_bar(axes, east - west)
    if paths:
        axes.legend(loc="upper left", fontsize="small")


def _scale_bar(axes: Axes, width_m: float) -> None:
    """Draw a bar of a round length, about a fifth of the map."""
    from matplotlib.patches import Rectangle

    length = _round_length(width_m / 5)
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    right, low, thick = east - 0.03 * (east - west), south + 0.03 * (north - south), 0.012 * (north - south)
    bar = Rectangle((right - length, low), length, thick, facecolor="black", edgecolor="white", zorder=5)
    axes.add_patch(bar)
    label = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
    box = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1.5}
    axes.text(right - length / 2, low + 2 * thick, label, ha="center", va="bottom", bbox=box, zorder=5)


def _round_length(wanted: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above ``wanted``."""
    power = 10.0 ** math.floor(math.log10(wanted))
    return max(step * power for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9))


# ---------------------------------------------------------------- paths


def _colours(paths: Mapping[str, Trajectory]) -> Iterator[tuple[str, str, str]]:
    """Yield name, line colour and arrow colour of each path."""
    others = 0
    for name in paths:
        if name in ALMANZA_COLOURS:
            yield name, *ALMANZA_COLOURS[name]
        else:
            yield name, *OTHER_COLOURS[others % len(OTHER_COLOURS)]
            others += 1


def _label(above: Axes, over_time: list[Axes], title: str) -> None:
    """Set labels, legend and grids of :func:`path_figure`."""
    above.set(xlabel="x, east (m)", ylabel="y, north (m)", title=title, aspect="equal")
    above.set_adjustable("datalim")
    above.legend(loc="best")
    over_time[0].set_ylabel("heading (deg)")
    for axes, (name, unit, _) in zip(over_time[1:], AXES, strict=True):
        axes.set_ylabel(f"{name} ({unit})")
    over_time[-1].set_xlabel("time (s)")
    for axes in (above, *over_time):
        axes.grid(alpha=0.3)


def _draw_paths(axes: Axes, paths: Mapping[str, Trajectory]) -> None:
    """Draw lines with arrows along the heading, and mark the start."""
    for name, line, arrow in _colours(paths):
        poses = paths[name].poses
        axes.plot(poses[:, 0], poses[:, 1], color=line, label=name, linewidth=1.5, zorder=3)
        axes.plot(*poses[0, :2], marker="o", color=line, markersize=4, zorder=3)
        some = poses[_some(len(poses))]
        ahead = np.sin(some[:, 5]), np.cos(some[:, 5])
        axes.quiver(*some[:, :2].T, *ahead, color=arrow, scale=25, width=0.003, zorder=4)


def _some(frames: int) -> NDArray[np.intp]:
    """Select the frames with arrows and ellipses."""
    return np.unique(np.linspace(0, frames - 1, min(ARROWS, frames)).astype(np.intp))


def _draw_ellipses(axes: Axes, place: NDArray[np.float64], covariance: NDArray[np.float64], colour: str) -> None:
    """Draw ellipses of two standard deviations around some of the positions ``(frames, 2)``."""
    from matplotlib.patches import Ellipse

    for one in _some(len(place)):
        if np.isfinite(covariance[one]).all():
            variance, direction = np.linalg.eigh(covariance[one])
            width, height = 2 * BAND * np.sqrt(np.maximum(variance, 0))
            turn = math.degrees(math.atan2(direction[1, 0], direction[0, 0]))
            axes.add_patch(Ellipse(tuple(place[one]), width, height, angle=turn, color=colour, alpha=0.2, linewidth=0))


def _checked(
    paths: Mapping[str, Trajectory], covariances: Mapping[str, NDArray[np.float64]], what: str, fewer: int
) -> dict[str, NDArray[np.float64]]:
    """Return covariances as arrays, after a check that they fit their paths.

    Raises:
        MitsonarError: an unknown path, or another shape.
    """
    for name, values in covariances.items():
        if name not in paths:
            raise MitsonarError(f"{what} names no path that is drawn: got {name!r}; paths: {', '.join(paths)}")
        wanted = (len(paths[name]) - fewer, 3, 3)
        if np.shape(values) != wanted:
            raise MitsonarError(f"{what} of {name} must be {wanted}: got {np.shape(values)}")
    return {name: np.asarray(values, dtype=float) for name, values in covariances.items()}


def _std(covariances: NDArray[np.float64] | None, axis: int, scale: float) -> NDArray[np.float64] | None:
    return None if covariances is None else scale * np.sqrt(covariances[:, axis, axis])


def _banded(
    axes: Axes, time: NDArray[np.float64], value: NDArray[np.float64], std: NDArray[np.float64] | None, colour: str
) -> None:
    """Draw a line with a band of two standard deviations."""
    axes.plot(time, value, color=colour, linewidth=1.0)
    if std is not None:
        axes.fill_between(time, value - BAND * std, value + BAND * std, color=colour, alpha=0.2, linewidth=0)
