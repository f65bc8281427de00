"""Fan pictures that tests draw from a formula: value by range and bearing, independent of the code that is tested."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FAN = {"layout": "fan", "apex_px": (119.5, 210.25), "near_px": 60.0, "far_px": 200.0, "half_angle_deg": 28.0}
"""A fan within pictures of 240 x 200 pixels (columns by rows)."""


def drawn(
    value: Callable[[Array, Array], Array],
    *,
    rows: int = 200,
    columns: int = 240,
    stretch: float = 1.0,
    mirror: bool = False,
    forward: str = "up",
) -> NDArray[np.float32]:
    """Draw a fan of :data:`FAN`: ``value(radius_px, bearing_rad)`` of each pixel inside, 0 outside."""
    column, row = 119.5, 210.25
    v, u = np.indices((rows, columns), dtype=float)
    x = (u - column) * stretch * (-1 if mirror else 1)
    y = row - (v if forward == "up" else rows - 1 - v)
    radius, bearing = np.hypot(x, y), np.arctan2(x, y)
    inside = (radius >= 60) & (radius <= 200) & (np.abs(bearing) <= np.radians(28))
    return np.where(inside, value(radius, bearing), 0).astype(np.float32)
