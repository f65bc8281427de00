"""Measured heights as a table, and in sentences."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mitsonar.estimation.height import HeightEstimate

__all__ = ["heights_csv", "heights_lines"]

Array = NDArray[np.float64]


def heights_csv(time_s: Array, estimates: list[HeightEstimate], true: Array | None) -> str:
    """Return a table with a line a frame; cells are empty where a number is not known.

    Args:
        time_s: of the frames ``(n,)`` [s].
        estimates: of the frames.
        true: true heights ``(n,)`` [m], where known.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["frame", "time_s", "height_m", "std_m", "believed", "reason", "true_z_m"])
    for k, one in enumerate(estimates):
        numbers = [f"{value:.6g}" if np.isfinite(value) else "" for value in (one.height_m, one.std_m)]
        z = "" if true is None else f"{true[k]:.6g}"
        table.writerow([k, f"{time_s[k]:.9g}", *numbers, int(one.valid), one.reason, z])
    return text.getvalue()


def heights_lines(estimates: list[HeightEstimate], true: Array | None) -> list[str]:
    """Return sentences on the heights of all frames; ``true`` holds the true heights ``(n,)`` [m], where known."""
    valid = np.array([one.valid for one in estimates], dtype=bool)
    heights = np.array([one.height_m for one in estimates])[valid]
    lines = []
    for reason in dict.fromkeys(one.reason for one in estimates if not one.valid):
        lines.append(f"not believed, {sum(one.reason == reason for one in estimates):,} frames: {reason}")
    if len(heights):
        lines.append(f"height {heights.min():.3f} .. {heights.max():.3f} m, median {np.median(heights):.3f} m")
    if true is not None and len(heights):
        error = heights - true[valid]
        rmse, middle = 100 * np.sqrt((error**2).mean()), 100 * np.median(np.abs(error))
        lines.append(f"against the true z: RMSE {rmse:.2f} cm, median {middle:.2f} cm, bias {100 * error.mean():+.2f} cm")
    return lines
