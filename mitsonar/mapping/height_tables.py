"""Measured heights as a table, and in sentences."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mitsonar.estimation.height.direct_height import HeightEstimate

__all__ = ["heights_csv", "heights_lines"]

Array = NDArray[np.float64]


def heights_csv(time_s: Array, said: list[HeightEstimate], true: Array | None) -> str:
    """A table with a line a frame; empty where nothing is known.

    Args:
        time_s: of the frames ``(n,)``.
        said: of the frames.
        true: heights ``(n,)`` [m].
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["frame", "time_s", "height_m", "std_m", "believed", "reason", "true_z_m"])
    for k, one in enumerate(said):
        numbers = [f"{value:.6g}" if np.isfinite(value) else "" for value in (one.height_m, one.std_m)]
        z = "" if true is None else f"{true[k]:.6g}"
        table.writerow([k, f"{time_s[k]:.9g}", *numbers, int(one.valid), one.reason, z])
    return text.getvalue()


def heights_lines(said: list[HeightEstimate], true: Array | None) -> list[str]:
    """Sentences on the heights of all frames; ``true`` [m] ``(n,)``."""
    believed = np.array([one.valid for one in said], dtype=bool)
    heights = np.array([one.height_m for one in said])[believed]
    lines = []
    for reason in dict.fromkeys(one.reason for one in said if not one.valid):
        lines.append(f"not believed, {sum(one.reason == reason for one in said):,} frames: {reason}")
    if len(heights):
        lines.append(f"height {heights.min():.3f} .. {heights.max():.3f} m, median {np.median(heights):.3f} m")
    if true is not None and len(heights):
        error = heights - true[believed]
        rmse, middle = 100 * np.sqrt((error**2).mean()), 100 * np.median(np.abs(error))
        lines.append(f"against the true z: RMSE {rmse:.2f} cm, median {middle:.2f} cm, bias {100 * error.mean():+.2f} cm")
    return lines
