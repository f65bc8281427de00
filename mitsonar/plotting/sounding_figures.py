"""Figures of what sounders give: waterfalls, echograms, soundings from above, range images, velocities of a DVL."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import counted
from mitsonar.records.soundings import DvlReadings, Echogram, Soundings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "dvl_figure",
    "echogram_figure",
    "range_figure",
    "save_sounding_figure",
    "soundings_figure",
    "waterfall_figure_of",
]

SPAN_DB = 50.0
"""Span of pictures of levels below full scale [dB]."""

MOST_POINTS = 200_000
"""Points that are drawn of a cloud, at most."""


def save_sounding_figure(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG, whole or absent."""
    part = path.with_name(f".{path.name}.part")
    figure.savefig(part, dpi=110, format="png", metadata={"Software": None})
    part.replace(path)


def waterfall_figure_of(echogram: Echogram) -> Figure:
    """Draw a side-scan's waterfall: port to the left, slant range athwart, the first ping below."""
    figure, axes = _figure(8.4, 5.2)
    level, channels = echogram.decibels(SPAN_DB), echogram.sounder.channels
    port, starboard = (level[:, channels.index(side)] for side in ("port", "starboard"))
    far, near = echogram.sounder.fan.range_max, echogram.sounder.fan.range_min
    along = _along(echogram)
    shown = {"cmap": "copper", "vmin": -SPAN_DB, "vmax": 0, "aspect": "auto", "origin": "lower", "interpolation": "nearest"}
    picture = axes.imshow(port[:, ::-1], extent=(-far, -near, *along), **shown)
    axes.imshow(starboard, extent=(near, far, *along), **shown)
    axes.set(xlim=(-far, far), ylim=along, xlabel="slant range, port - starboard (m)", ylabel="along the path (m)")
    figure.colorbar(picture, ax=axes, label="level (dB)")
    axes.set_title(f"{echogram.sounder.name}, {echogram.sounder.fan.model}, {counted(len(echogram), 'ping')}", fontsize=10)
    return figure


def echogram_figure(echogram: Echogram, soundings: Soundings | None = None) -> Figure:
    """Draw the levels of the first fan over time and range, and the detections over them."""
    figure, axes = _figure(8.4, 3.8)
    time_s, fan = echogram.time_s, echogram.sounder.fan
    half = 0.5 * (time_s[-1] - time_s[0]) / max(1, len(time_s) - 1) or 0.5 / fan.frame_rate_hz
    extent = (time_s[0] - half, time_s[-1] + half, fan.range_max, fan.range_min)
    shown = {"cmap": "viridis", "vmin": -SPAN_DB, "vmax": 0, "aspect": "auto", "interpolation": "nearest"}
    picture = axes.imshow(echogram.decibels(SPAN_DB)[:, 0].T, extent=extent, **shown)
    if soundings is not None:
        axes.plot(time_s, soundings.range_m[:, 0, 0], color="tab:red", lw=1, label="first echo")
        axes.legend(loc="lower right", fontsize=8)
    axes.set(xlabel="time (s)", ylabel="range (m)")
    axes.set_title(f"{echogram.sounder.name}, {fan.model}, {counted(len(echogram), 'ping')}", fontsize=10)
    figure.colorbar(picture, ax=axes, label="level (dB)")
    return figure


def soundings_figure(soundings: Soundings) -> Figure:
    """Draw the soundings from above, coloured by their height."""
    figure, axes = _figure(6.4, 5.2)
    points = soundings.points()[soundings.found]
    points = points[:: max(1, len(points) // MOST_POINTS)]
    low, high = np.percentile(points[:, 2], [1, 99]) if len(points) else (0, 1)
    drawn = axes.scatter(*points.T[:2], c=points[:, 2], s=1.5, lw=0, cmap="viridis", vmin=low, vmax=high)
    axes.set(xlabel="x, east (m)", ylabel="y, north (m)", aspect="equal")
    axes.set_title(f"{soundings.sounder.name}: {counted(int(soundings.found.sum()), 'sounding')}", fontsize=10)
    figure.colorbar(drawn, ax=axes, label="z (m)")
    return figure


def range_figure(soundings: Soundings, ping: int = 0) -> Figure:
    """Draw the range image of one ping: rows over beams."""
    figure, axes = _figure(7.6, 4.2)
    sounder = soundings.sounder
    half = np.degrees(np.abs(sounder.fan.bearing_rad).max())
    tall = sounder.rows * sounder.fan.elevation_fov_deg / 2
    image = soundings.range_m[ping, : sounder.rows]
    picture = axes.imshow(image, extent=(-half, half, -tall, tall), cmap="viridis_r", aspect="auto", interpolation="nearest")
    axes.set(xlabel="bearing (deg)", ylabel="elevation (deg)")
    axes.set_title(f"{sounder.name}, {sounder.fan.model}, ping {ping}", fontsize=10)
    figure.colorbar(picture, ax=axes, label="range (m)")
    return figure


def dvl_figure(readings: DvlReadings, true: NDArray[np.float64] | None = None) -> Figure:
    """Draw velocities with twice their standard deviation, and the altitude.

    Args:
        readings: of the DVL.
        true: velocities of the vehicle ``(pings, 3)`` [m/s], where known.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.4, 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    time_s = readings.soundings.time_s
    std = np.sqrt(np.diagonal(readings.covariance, axis1=1, axis2=2))
    for axis, (name, colour) in enumerate((("starboard", "tab:blue"), ("forward", "tab:orange"), ("up", "tab:green"))):
        middle = readings.velocity[:, axis]
        above.plot(time_s, middle, ".", ms=3, color=colour, label=name)
        above.fill_between(time_s, middle - 2 * std[:, axis], middle + 2 * std[:, axis], color=colour, alpha=0.2, lw=0)
        if true is not None:
            above.plot(time_s, true[:, axis], color="black", lw=0.8)
    above.set_ylabel("velocity (m/s)")
    above.legend(loc="upper right", fontsize=8, ncols=3)
    below.plot(time_s, readings.altitude_m, ".", ms=3, color="black")
    below.set(xlabel="time (s)", ylabel="altitude (m)")
    lost = int((~readings.locked).sum())
    above.set_title(
        f"{readings.soundings.sounder.name}: {counted(len(time_s), 'ping')}, {lost} without bottom lock", fontsize=10
    )
    return figure


def _figure(width: float, height: float) -> tuple[Figure, Any]:
    """Return a figure with one pair of axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def _along(echogram: Echogram) -> tuple[float, float]:
    """Return the first and the last edge of the pings along the path [m]; of a vehicle at rest they count pings."""
    steps = np.linalg.norm(np.diff(echogram.poses[:, :3], axis=0), axis=1)
    length = float(steps.sum())
    if length < 1e-9:
        return -0.5, len(echogram) - 0.5
    half = length / len(steps) / 2
    return -half, length + half
