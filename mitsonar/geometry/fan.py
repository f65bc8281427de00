"""Convert sonar images from (range, bearing) to metres, and points in space to range and bearing."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from array_api_compat import array_namespace, device
from numpy.typing import ArrayLike, NDArray

from mitsonar.arrays import AnyArray
from mitsonar.errors import MitsonarError
from mitsonar.geometry.ground import arc_elevation
from mitsonar.instruments.sonar import Bearing
from mitsonar.instruments.views import directions
from mitsonar.motion.pose import vehicle_rotation

__all__ = [
    "CartesianImage",
    "CartesianMap",
    "Projection",
    "Views",
    "cartesian_map",
    "nearest_cells",
    "points_at",
    "polar_of",
    "projection_of",
    "to_cartesian",
]


@dataclass(frozen=True)
class CartesianImage:
    """A scan-converted image (a fan) in metres.

    Attributes:
        image: ``(rows, columns)`` float32, with row 0 farthest forward and column 0 farthest to port; nan outside the fan.
        extent: limits of the image [m]: starboard from, to, forward from, to (as matplotlib's ``extent``).
    """

    image: NDArray[np.float32]
    extent: tuple[float, float, float, float]


@dataclass(frozen=True)
class CartesianMap:
    """Bilinear interpolation of the pixels of a fan from the cells of an image, reusable for many images of one sonar.

    Attributes:
        index: indices of four cells in the flattened image ``(4, rows, columns)`` int64.
        weight: their weights, which add up to 1; all 0 outside the fan ``(4, rows, columns)`` float32.
        extent: as in :class:`CartesianImage`.
    """

    index: NDArray[np.int64]
    weight: NDArray[np.float32]
    extent: tuple[float, float, float, float]
    _by_device: dict[str, list[AnyArray]] = field(default_factory=dict, repr=False, compare=False)

    def apply(self, image: AnyArray) -> AnyArray:
        """Convert images ``(..., bins, beams)``, NumPy or torch, to fans ``(..., rows, columns)``; 0 outside the fan."""
        xp = array_namespace(image)
        flat = xp.reshape(image, (-1, image.shape[-2] * image.shape[-1]))
        key = f"{xp.__name__} {device(image)}"
        if key not in self._by_device:  # once per device
            self._by_device[key] = [xp.asarray(table, device=device(image)) for table in (self.index, self.weight)]
        index, weight = self._by_device[key]
        fan = None
        for corner in range(4):
            part = xp.take(flat, xp.reshape(index[corner], (-1,)), axis=1) * xp.reshape(weight[corner], (-1,))
            fan = part if fan is None else fan + part
        return xp.reshape(fan, (*image.shape[:-2], *self.index.shape[1:]))


def nearest_cells(fan: CartesianMap, image: NDArray[np.generic], outside: object) -> NDArray[np.generic]:
    """Return the value of the cell nearest to each pixel of a fan, for labels, which must not be interpolated.

    Args:
        fan: scan conversion for the ranges and bearings of the image.
        image: ``(bins, beams)`` of any type.
        outside: value of the pixels outside the fan.

    Returns:
        ``(rows, columns)`` of the image's type.
    """
    corner = fan.weight.argmax(axis=0)[None]
    cell = np.take_along_axis(fan.index, corner, axis=0)[0]
    return np.where(fan.weight.any(axis=0), image.ravel()[cell], np.asarray(outside, dtype=image.dtype))


def cartesian_map(range_m: ArrayLike, bearing_rad: ArrayLike, rows: int = 800) -> CartesianMap:
    """Compute the map of a scan conversion: x = r sin b to starboard, y = r cos b forward.

    Args:
        range_m: centres of the bins [m], increasing.
        bearing_rad: axes of the beams [rad], increasing, not necessarily evenly spaced.
        rows: number of pixels in the forward direction; pixels are square.

    Raises:
        MitsonarError: ranges or bearings that do not increase.
    """
    range_m, bearing_rad = (np.asarray(a, dtype=float) for a in (range_m, bearing_rad))
    if (np.diff(range_m) <= 0).any() or (np.diff(bearing_rad) <= 0).any():
        raise MitsonarError("range_m and bearing_rad must increase: sort the image's rows and columns")
    range_edges, bearing_edges = _edges(range_m), _edges(bearing_rad)
    # Bounding box of the fan: its extremes lie at the edges, or where the fan crosses an axis.
    near, far = range_edges[[0, -1]]
    port, starboard = bearing_edges[[0, -1]]
    turns = np.clip([port, starboard, 0.0, -np.pi / 2, np.pi / 2], port, starboard)
    corners = np.array([near, far])[:, None]
    x, y = corners * np.sin(turns), corners * np.cos(turns)
    left, right, low, high = x.min(), x.max(), y.min(), y.max()
    # Polar coordinates of the pixel centres, farthest row first.
    pixel = (high - low) / rows
    columns = max(1, round((right - left) / pixel))
    forward = high - (np.arange(rows)[:, None] + 0.5) * pixel
    across = left + (np.arange(columns) + 0.5) * (right - left) / columns
    radius, angle = np.hypot(across, forward), np.arctan2(across, forward)
    angle = np.where(angle > starboard, angle - 2 * np.pi, angle)  # beams of a full turn may end short of the rear
    inside = (radius >= near) & (radius <= far) & (angle >= port) & (angle <= starboard)
    # Bilinear weights of the four cells around each pixel.
    bin_, over_bin = _cell(_fractional_index(radius, range_m, range_edges), range_m.size)
    beam, over_beam = _cell(_fractional_index(angle, bearing_rad, bearing_edges), bearing_rad.size)
    index, weight = [], []
    for next_bin in (0, 1):
        for next_beam in (0, 1):
            row, column = np.minimum(bin_ + next_bin, range_m.size - 1), np.minimum(beam + next_beam, bearing_rad.size - 1)
            index.append(row * bearing_rad.size + column)
            weight.append((over_bin if next_bin else 1 - over_bin) * (over_beam if next_beam else 1 - over_beam) * inside)
    extent = (float(left), float(right), float(low), float(high))
    return CartesianMap(np.stack(index), np.stack(weight).astype(np.float32), extent)


def to_cartesian(image: ArrayLike, range_m: ArrayLike, bearing_rad: ArrayLike, rows: int = 800) -> CartesianImage:
    """Convert one image ``(bins, beams)`` to a fan in metres; see :func:`~mitsonar.geometry.fan.cartesian_map`.

    Raises:
        MitsonarError: inconsistent shapes, or ranges or bearings that do not increase.
    """
    image = np.asarray(image, dtype=float)
    expected_shape = np.size(range_m), np.size(bearing_rad)
    if image.shape != expected_shape:
        raise MitsonarError(f"image must be (bins, beams) = {expected_shape}: got {image.shape}")
    conversion = cartesian_map(range_m, bearing_rad, rows)
    fan = np.where(conversion.weight.any(axis=0), conversion.apply(image), np.nan).astype(np.float32)
    return CartesianImage(fan, conversion.extent)


def _cell(index: NDArray[np.float64], count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Split a fractional index into a cell and the remainder, clamped to the centres of the outermost cells."""
    clamped = np.clip(index, 0, count - 1)
    cell = np.minimum(clamped.astype(np.int64), max(count - 2, 0))
    return cell, clamped - cell


def _edges(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the borders midway between centres, extrapolated by the same distance at both ends."""
    if centres.size == 1:
        return np.array([centres[0] * 0.99 - 1e-3, centres[0] * 1.01 + 1e-3])
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])


def _fractional_index(
    value: NDArray[np.float64], centres: NDArray[np.float64], edges: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the fractional index of a value among the centres."""
    known = np.concatenate([edges[:1], centres, edges[-1:]])
    return np.asarray(np.interp(value, known, np.concatenate([[-0.5], np.arange(centres.size), [centres.size - 0.5]])))


# ---------------- Projection of points in space


Array = NDArray[np.float64]

STEP = 1e-6
"""Step of the finite differences for the derivative of a rotation [rad]."""


class Views(NamedTuple):
    """Poses from which points are viewed, with their rotations.

    Attributes:
        poses: x, y, z [m], pitch, roll, heading [rad] ``(n, 6)``.
        rotations: rotations from (starboard, forward, up) to the world ``(n, 3, 3)``.
        turns: their derivatives by pitch, roll and heading ``(n, 3, 3, 3)``; the second axis is the angle.
    """

    poses: Array
    rotations: Array
    turns: Array

    @classmethod
    def of(cls, poses: Array) -> Views:
        """Compute the rotations of poses ``(n, 6)``."""
        table = np.atleast_2d(np.asarray(poses, dtype=float))
        rotations = vehicle_rotation(table).as_matrix()
        turns = np.empty((len(table), 3, 3, 3))
        for k in range(3):
            shifted = table.copy()
            shifted[:, 3 + k] += STEP
            ahead = vehicle_rotation(shifted).as_matrix()
            shifted[:, 3 + k] -= 2 * STEP
            turns[:, k] = (ahead - vehicle_rotation(shifted).as_matrix()) / (2 * STEP)
        return cls(table, rotations, turns)

    def take(self, index: NDArray[np.intp]) -> Views:
        """Return the views at given indices."""
        return Views(self.poses[index], self.rotations[index], self.turns[index])


class Projection(NamedTuple):
    """Range [m] and bearing [rad] ``(n, 2)``, with derivatives by the point ``(n, 2, 3)`` and by the pose ``(n, 2, 6)``."""

    polar: Array
    by_point: Array
    by_pose: Array


def polar_of(points: Array, views: Views, bearing: Bearing) -> Array:
    """Compute the range [m] and bearing [rad] ``(..., 2)`` of points ``(..., 3)``, for one view or one per row of points."""
    shape = (len(views.poses), *(1,) * (points.ndim - 2))
    away = points - views.poses[:, :3].reshape(*shape, 3)
    # away @ R for each view: world to sonar axes
    local = np.einsum("n...a,nab->n...b", away, np.broadcast_to(views.rotations, (len(away), 3, 3)))
    radius = np.sqrt((local * local).sum(axis=-1))
    starboard = local[..., 0]
    angle = np.arctan2(starboard, local[..., 1]) if bearing == "azimuth" else np.arcsin(starboard / radius)
    return np.stack([radius, angle], axis=-1)


def projection_of(points: Array, views: Views, bearing: Bearing) -> Projection:
    """Compute range and bearing of points ``(n, 3)`` and their derivatives, for one view or one per point."""
    # 1. Coordinates of the points in the sonar's axes.
    away = points - views.poses[:, :3]
    local = np.einsum("na,nab->nb", away, np.broadcast_to(views.rotations, (len(away), 3, 3)))
    radius = np.sqrt((local * local).sum(axis=1))
    # 2. Gradients of range and bearing with respect to these coordinates.
    along = local / radius[:, None]
    if bearing == "azimuth":
        level = local[:, 0] ** 2 + local[:, 1] ** 2
        angle = np.arctan2(local[:, 0], local[:, 1])
        across = np.stack([local[:, 1] / level, -local[:, 0] / level, np.zeros_like(level)], axis=1)
    else:
        sine = along[:, 0]
        angle = np.arcsin(sine)
        across = (np.array([1.0, 0.0, 0.0]) - sine[:, None] * along) / (radius * np.sqrt(1 - sine * sine))[:, None]
    # 3. Chain rule: by the point, and by the angles of the pose. The position of the sonar acts opposite to the point.
    by_local = np.stack([along, across], axis=1)
    by_point = np.einsum("nib,nab->nia", by_local, np.broadcast_to(views.rotations, (len(away), 3, 3)))
    turning = np.einsum("na,nkab->nkb", away, np.broadcast_to(views.turns, (len(away), 3, 3, 3)))
    by_angle = np.einsum("nib,nkb->nik", by_local, turning)
    return Projection(np.stack([radius, angle], axis=1), by_point, np.concatenate([-by_point, by_angle], axis=2))


def points_at(polar: Array, height_m: Array, views: Views, bearing: Bearing) -> Array:
    """Compute the points ``(..., 3)`` [m] with a given range, bearing and height.

    Args:
        polar: range [m] and bearing [rad] ``(n, ..., 2)``.
        height_m: heights of the points in the world ``(n, ...)``.
        views: one view, or one per row.
        bearing: type of bearing, ``azimuth`` or ``cone``.

    Returns:
        If two points match, the one closer to the sonar's axis; nan if there is none.
    """
    shape = (len(views.poses), *(1,) * (polar.ndim - 2))
    radius, angle = polar[..., 0], polar[..., 1]
    rise = (height_m - views.poses[:, 2].reshape(shape)) / radius
    upward = views.rotations[:, 2].reshape(*shape, 3)
    elevation = arc_elevation(bearing, angle, rise, upward)
    local = directions(bearing, angle, elevation) * radius[..., None]
    turned = np.einsum("n...b,nab->n...a", local, np.broadcast_to(views.rotations, (len(local), 3, 3)))
    return np.asarray(turned + views.poses[:, :3].reshape(*shape, 3))
