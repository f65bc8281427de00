"""Where a cell of a sonar image lies: directions of beams, and scan conversion from (range, bearing) to metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from mitsonar.errors import MitsonarError
from mitsonar.sonar import Bearing

__all__ = ["CartesianImage", "directions", "to_cartesian"]


def directions(bearing: Bearing, bearing_rad: ArrayLike, elevation_rad: ArrayLike) -> NDArray[np.float64]:
    """Unit vectors ``(..., 3)`` as (starboard, forward, up) of the sonar's frame, for both kinds of bearing (docs/sonar.md)."""
    b, e = np.broadcast_arrays(np.asarray(bearing_rad, dtype=float), np.asarray(elevation_rad, dtype=float))
    if bearing == "azimuth":
        return np.stack([np.cos(e) * np.sin(b), np.cos(e) * np.cos(b), np.sin(e)], axis=-1)
    return np.stack([np.sin(b), np.cos(b) * np.cos(e), np.cos(b) * np.sin(e)], axis=-1)


@dataclass(frozen=True)
class CartesianImage:
    """A fan in metres.

    Attributes:
        image: ``(rows, columns)`` float32, row 0 the farthest forward, column 0 most to port; nan outside the fan.
        extent: starboard from, to, forward from, to [m] of the image's edges (as matplotlib's ``extent``).
    """

    image: NDArray[np.float32]
    extent: tuple[float, float, float, float]


def to_cartesian(image: ArrayLike, range_m: ArrayLike, bearing_rad: ArrayLike, rows: int = 800) -> CartesianImage:
    """Scan conversion: x = r sin b to starboard, y = r cos b forward, bilinear between the cells' centres.

    Args:
        image: ``(bins, beams)``.
        range_m: centres of the bins [m], rising.
        bearing_rad: axes of the beams [rad], rising, not necessarily even.
        rows: pixels in the forward direction; pixels are square.

    Raises:
        MitsonarError: shapes that do not fit, or ranges or bearings that do not rise.
    """
    image, range_m, bearing_rad = (np.asarray(a, dtype=float) for a in (image, range_m, bearing_rad))
    if image.shape != (range_m.size, bearing_rad.size):
        raise MitsonarError(f"image must be (bins, beams) = ({range_m.size}, {bearing_rad.size}): got {image.shape}")
    if (np.diff(range_m) <= 0).any() or (np.diff(bearing_rad) <= 0).any():
        raise MitsonarError("range_m and bearing_rad must rise: sort the image's rows and columns")
    range_edges, bearing_edges = _edges(range_m), _edges(bearing_rad)
    near, far = range_edges[[0, -1]]
    port, starboard = bearing_edges[[0, -1]]
    turns = np.clip([port, starboard, 0.0, -np.pi / 2, np.pi / 2], port, starboard)
    corners = np.array([near, far])[:, None]
    x, y = corners * np.sin(turns), corners * np.cos(turns)
    left, right, low, high = x.min(), x.max(), y.min(), y.max()
    pixel = (high - low) / rows
    columns = max(1, round((right - left) / pixel))
    forward = high - (np.arange(rows)[:, None] + 0.5) * pixel
    across = left + (np.arange(columns) + 0.5) * (right - left) / columns
    radius, angle = np.hypot(across, forward), np.arctan2(across, forward)
    place = np.stack([_place(radius, range_m, range_edges), _place(angle, bearing_rad, bearing_edges)])
    inside = (radius >= near) & (radius <= far) & (angle >= port) & (angle <= starboard)
    fan = np.where(inside, map_coordinates(image, place, order=1, mode="nearest"), np.nan).astype(np.float32)
    return CartesianImage(fan, (float(left), float(right), float(low), float(high)))


def _edges(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Borders half-way between centres, and as far out at both ends."""
    if centres.size == 1:
        return np.array([centres[0] * 0.99 - 1e-3, centres[0] * 1.01 + 1e-3])
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])


def _place(value: NDArray[np.float64], centres: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fractional index of a value among the centres."""
    known = np.concatenate([edges[:1], centres, edges[-1:]])
    return np.interp(value, known, np.concatenate([[-0.5], np.arange(centres.size), [centres.size - 0.5]]))
