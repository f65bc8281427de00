"""Figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mitsonar.geometry.fan import to_cartesian
from mitsonar.records.frames import SonarFrames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["fan_figure", "save_fan"]

GAMMA = 0.6
"""Power that levels are shown with, so that faint ground can be seen beside bright faces; the colour bar says it."""


def fan_figure(frames: SonarFrames, index: int = 0, *, title: str = "") -> Figure:
    """One frame as a fan with metre axes: forward up, starboard to the right."""
    from matplotlib.colors import Normalize, PowerNorm
    from matplotlib.figure import Figure

    fan = to_cartesian(frames.image[index], frames.range_m, frames.bearing_rad)
    left, right, low, high = fan.extent
    height = 6.0
    width = float(np.clip(height * (right - left) / (high - low), 3.0, 14.0))
    figure = Figure(figsize=(width + 1.6, height), layout="constrained")
    axes = figure.add_subplot(facecolor="black")
    values = fan.image / (255 if frames.image.dtype == np.uint8 else 1)
    if frames.level == "dB":
        low, high = frames.decibels_of(0.0), frames.decibels_of(1.0)
        values, norm = low + values * (high - low), Normalize(low, high)
        label = "level (dB re 1 uPa)" if frames.sonar.source_level_db else "level (dB re the source at 1 m)"
        label = "level (dB re full scale)" if (low, high) == (-frames.sonar.coding_db, 0.0) else label
        label += " with gain" if frames.sonar.gain_exponent or frames.sonar.gain_absorption else ""
    else:
        norm, label = PowerNorm(GAMMA, vmin=0, vmax=1), f"level (1 = full scale; shown with gamma {GAMMA:g})"
    shown = axes.imshow(values, extent=fan.extent, cmap="copper", norm=norm, interpolation="nearest")
    axes.set(xlabel="starboard (m)", ylabel="forward (m)", title=title)
    figure.colorbar(shown, ax=axes, label=label, fraction=0.04)
    return figure


def save_fan(path: str | Path, frames: SonarFrames, index: int = 0, *, title: str = "") -> None:
    """Write :func:`fan_figure` as PNG; whole or not at all."""
    import io

    from mitsonar.io.files import write_whole

    buffer = io.BytesIO()
    fan_figure(frames, index, title=title).savefig(buffer, format="png", dpi=110)
    write_whole(path, buffer.getvalue())
