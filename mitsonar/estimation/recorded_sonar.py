"""The instrument of a recording, as the simulator takes it: its window and bins, and a layout of its beams."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from mitsonar.records.frames import SonarFrames

__all__ = ["NOISE_FIELDS", "as_instrument"]

Layout = Literal["even", "sine"]

NOISE_FIELDS = (
    *("noise_level_db", "volume_db", "near_glow_db", "near_glow_m", "near_glow_edge_db", "near_glow_spread_db"),
    *("near_glow_still", "stripes_db", "crosstalk_db", "speckle_nu", "speckle_patch_m"),
)
"""Fields of a sonar that are noise, water and grain, not the instrument's geometry."""

TELLING = 0.1
"""Distance of a beam from its place in the layout that the user is told of, as part of the beams' distance."""


def as_instrument(frames: SonarFrames) -> tuple[SonarFrames, list[str]]:
    """Return the frames with a sonar of their own axes, and sentences on what it cannot say.

    Beams are laid out at even angles, or at even sines of them, whichever is nearer to the bearings of the frames. The
    window begins half a bin before the first range and ends half a bin behind the last.
    """
    bearings, ranges = frames.bearing_rad, frames.range_m
    count = len(bearings)
    middle = (bearings[0] + bearings[-1]) / 2
    layouts: dict[Layout, float] = {}
    for layout in ("even", "sine"):
        layouts[layout] = _opening(bearings - middle, layout)
    sonars = {
        layout: frames.sonar.replace(
            beams=count,
            azimuth_fov_deg=float(np.degrees(opening)),
            beam_layout=layout,
            range_min=max(0.0, float(ranges[0] - (ranges[1] - ranges[0]) / 2)),
            range_max=float(ranges[-1] + (ranges[-1] - ranges[-2]) / 2),
            range_bins=len(ranges),
        )
        for layout, opening in layouts.items()
    }
    away = {layout: float(np.abs(sonar.bearing_rad + middle - bearings).max()) for layout, sonar in sonars.items()}
    chosen = min(sonars, key=lambda layout: away[layout])
    spacing = float(bearings[-1] - bearings[0]) / (count - 1)
    notes = []
    if away[chosen] > TELLING * spacing:
        notes.append(
            f"the beams are not even: up to {np.degrees(away[chosen]):.2g} deg from the layout {chosen} of the simulator, "
            f"which is {away[chosen] / spacing:.2g} of their distance"
        )
    if abs(middle) > TELLING * spacing:
        notes.append(f"the fan is centred on {np.degrees(middle):.2g} deg; the simulator's is centred on the axis")
    return replace(frames, sonar=sonars[chosen]), notes


def _opening(bearings: np.ndarray, layout: Layout) -> float:
    """Return the field of view [rad] by which a layout's outermost beams are those of centred bearings ``(beams,)``."""
    outer, count = float(np.abs(bearings[[0, -1]]).mean()), len(bearings)
    if layout == "even":
        return 2 * outer * count / (count - 1)
    return float(2 * np.arcsin(min(1.0, np.sin(outer) * count / (count - 1))))
