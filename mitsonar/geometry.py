"""Where a cell of a sonar image lies: directions of beams, scan conversion from (range, bearing) to metres, and the ground:
which point of it a cell shows, and how the cell moves with the sonar."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from array_api_compat import array_namespace, device, is_array_api_obj
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion import Pose, vehicle_rotation
from mitsonar.sonar import Bearing

__all__ = [
    "CartesianImage",
    "CartesianMap",
    "GroundGeometry",
    "cartesian_map",
    "directions",
    "moved",
    "nearest_known",
    "to_cartesian",
]


def directions(bearing: Bearing, bearing_rad: ArrayLike, elevation_rad: ArrayLike) -> NDArray[np.float64]:
    """Unit vectors ``(..., 3)`` as (starboard, forward, up) of the sonar's frame, for both kinds of bearing."""
    b, e = np.broadcast_arrays(np.asarray(bearing_rad, dtype=float), np.asarray(elevation_rad, dtype=float))
    if bearing == "azimuth":
        return np.stack([np.cos(e) * np.sin(b), np.cos(e) * np.cos(b), np.sin(e)], axis=-1)
    return np.stack([np.sin(b), np.cos(b) * np.cos(e), np.cos(b) * np.sin(e)], axis=-1)


@dataclass(frozen=True)
class GroundGeometry:
    """A sonar over level ground. Ground points are (starboard, forward) [m] in level axes that turn with its heading.

    Attributes:
        range_m: of the cells ``(bins,)`` [m].
        bearing_rad: of the cells ``(beams,)`` [rad].
        bearing: which angle that is.
        height_m: of the sonar over the ground.
        pitch_rad: > 0 looks down.
        roll_rad: > 0 puts starboard down.
    """

    range_m: NDArray[np.float64]
    bearing_rad: NDArray[np.float64]
    bearing: Bearing
    height_m: float
    pitch_rad: float
    roll_rad: float = 0.0

    @cached_property
    def turn(self) -> NDArray[np.float64]:
        """The sonar's starboard, forward and up in level axes, as columns ``(3, 3)``."""
        return np.asarray(vehicle_rotation(Pose(0, 0, 0, self.pitch_rad, self.roll_rad, 0)).as_matrix()[0])

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Ground points of the cells ``(bins, beams, 2)``; nan where a cell's arc does not meet the ground.

        Of the two places where an arc can meet it, the one nearer to the sonar's axis in elevation.
        """
        radius, b = np.meshgrid(self.range_m, self.bearing_rad, indexing="ij")
        starboard, forward, up = self.turn[2]  # how much of each points up
        if self.bearing == "azimuth":
            fixed, ahead, upward = 0.0, starboard * np.sin(b) + forward * np.cos(b), np.broadcast_to(up, b.shape)
        else:
            fixed, ahead, upward = starboard * np.sin(b), forward * np.cos(b), up * np.cos(b)
        # fixed + ahead cos e + upward sin e = -height / radius
        lean = np.arctan2(upward, ahead)
        with np.errstate(invalid="ignore", divide="ignore"):
            swing = np.arccos((-self.height_m / radius - fixed) / np.hypot(ahead, upward))
        one, other = (_within_pi(lean + sign * swing) for sign in (-1, 1))
        e = np.where(np.abs(one) <= np.abs(other), one, other)
        return np.asarray((directions(self.bearing, b, e) * radius[..., None] @ self.turn.T)[..., :2])

    def see(self, points: NDArray[np.floating]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Range [m] and bearing [rad] of ground points ``(..., 2)``."""
        s, f, u = self._in_sonar(points)
        radius = np.sqrt(s * s + f * f + u * u)
        return radius, np.arctan2(s, f) if self.bearing == "azimuth" else np.arcsin(s / radius)

    def elevation(self, points: NDArray[np.floating]) -> NDArray[Any]:
        """Elevation [rad] in the sonar's frame of ground points ``(..., 2)``."""
        s, f, u = self._in_sonar(points)
        return np.asarray(np.arctan2(u, np.hypot(s, f) if self.bearing == "azimuth" else f))

    @cached_property
    def derivative(self) -> NDArray[np.float64]:
        """How range [m] and bearing [rad] of each cell's ground point change with the motion (sideways, forward [m], yaw
        [rad]; eq. 3.4), at rest ``(bins, beams, 2, 3)``."""
        x, y = np.moveaxis(self.points, -1, 0)
        s, f, u = self._in_sonar(self.points)
        radius = np.sqrt(s * s + f * f + u * u)
        along = np.stack([x, y], axis=-1) / radius[..., None]
        aside, ahead = self.turn[:2, 0], self.turn[:2, 1]
        if self.bearing == "azimuth":
            turning = (f[..., None] * aside - s[..., None] * ahead) / (s * s + f * f)[..., None]
        else:
            turning = (aside - (s / radius)[..., None] * along) / np.sqrt(radius * radius - s * s)[..., None]
        one, none = np.ones_like(x), np.zeros_like(x)
        point = np.stack([np.stack([-one, none, -y], axis=-1), np.stack([none, -one, x], axis=-1)], axis=-2)
        return np.asarray(np.stack([along, turning], axis=-2) @ point)

    @cached_property
    def derivative_by_height(self) -> NDArray[np.float64]:
        """How range [m] and bearing [rad] of each cell's ground point change as the sonar rises [m] ``(bins, beams, 2)``."""
        s, f, u = self._in_sonar(self.points)
        radius = np.sqrt(s * s + f * f + u * u)
        along = self.height_m / radius
        aside, ahead = -self.turn[2, 0], -self.turn[2, 1]
        if self.bearing == "azimuth":
            turning = (f * aside - s * ahead) / (s * s + f * f)
        else:
            turning = (aside - (s / radius) * along) / np.sqrt(radius * radius - s * s)
        return np.stack([along, turning], axis=-1)

    def _in_sonar(self, points: NDArray[np.floating]) -> tuple[NDArray[Any], ...]:
        """Starboard, forward, up of ground points in the sonar's own axes."""
        x, y, turn = points[..., 0], points[..., 1], self.turn.astype(points.dtype)
        below = points.dtype.type(self.height_m)
        starboard, forward, up = (x * turn[0, k] + y * turn[1, k] - below * turn[2, k] for k in range(3))
        return starboard, forward, up


def nearest_known(known: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each node the row and column of the one whose values it takes: its own where it meets the ground, else the first
    farther out, in the nearest column that has one ``(ranges, bearings)``."""
    rows, columns = known.shape
    having = np.flatnonzero(known.any(axis=0))
    if not having.size:
        return np.zeros_like(known, dtype=np.intp), np.zeros_like(known, dtype=np.intp)
    column = having[np.abs(np.arange(columns)[:, None] - having).argmin(axis=1)]
    row = np.maximum(np.arange(rows)[:, None], known.argmax(axis=0)[column])
    return row, np.broadcast_to(column, row.shape)


def moved(points: Any, motion: Any) -> Any:
    """Where ground points ``(..., 2)`` lie for a sonar that has moved by (sideways, forward [m], yaw [rad]; eq. 3.4).

    NumPy or torch; the motion is three numbers, or an array like the points whose leading axes go with theirs.
    """
    xp = array_namespace(points)
    motion = xp.astype(motion if is_array_api_obj(motion) else xp.asarray(motion), points.dtype, copy=False)
    sideways, forward, yaw = (motion[..., k] for k in range(3))
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    x, y = points[..., 0], points[..., 1]
    return xp.stack([x * cos - y * sin - sideways, x * sin + y * cos - forward], axis=-1)


@dataclass(frozen=True)
class CartesianImage:
    """A fan in metres.

    Attributes:
        image: ``(rows, columns)`` float32, row 0 the farthest forward, column 0 most to port; nan outside the fan.
        extent: starboard from, to, forward from, to [m] of the image's edges (as matplotlib's ``extent``).
    """

    image: NDArray[np.float32]
    extent: tuple[float, float, float, float]


@dataclass(frozen=True)
class CartesianMap:
    """Which cells make each pixel of a fan: bilinear between the cells' centres, for many images of one sonar.

    Attributes:
        index: of four cells in the flattened image ``(4, rows, columns)`` int64.
        weight: of each, adding up to 1; all 0 outside the fan ``(4, rows, columns)`` float32.
        extent: as in :class:`CartesianImage`.
    """

    index: NDArray[np.int64]
    weight: NDArray[np.float32]
    extent: tuple[float, float, float, float]
    _kept: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def apply(self, image: Any) -> Any:
        """Fans ``(..., rows, columns)`` of images ``(..., bins, beams)``, NumPy or torch; 0 outside the fan."""
        xp = array_namespace(image)
        flat = xp.reshape(image, (-1, image.shape[-2] * image.shape[-1]))
        where = f"{xp.__name__} {device(image)}"
        if where not in self._kept:  # once on each device
            self._kept[where] = [xp.asarray(table, device=device(image)) for table in (self.index, self.weight)]
        index, weight = self._kept[where]
        fan = None
        for corner in range(4):
            part = xp.take(flat, xp.reshape(index[corner], (-1,)), axis=1) * xp.reshape(weight[corner], (-1,))
            fan = part if fan is None else fan + part
        return xp.reshape(fan, (*image.shape[:-2], *self.index.shape[1:]))


def cartesian_map(range_m: ArrayLike, bearing_rad: ArrayLike, rows: int = 800) -> CartesianMap:
    """The map of scan conversion: x = r sin b to starboard, y = r cos b forward.

    Args:
        range_m: centres of the bins [m], rising.
        bearing_rad: axes of the beams [rad], rising, not necessarily even.
        rows: pixels in the forward direction; pixels are square.

    Raises:
        MitsonarError: ranges or bearings that do not rise.
    """
    range_m, bearing_rad = (np.asarray(a, dtype=float) for a in (range_m, bearing_rad))
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
    inside = (radius >= near) & (radius <= far) & (angle >= port) & (angle <= starboard)
    bin_, over_bin = _cell(_place(radius, range_m, range_edges), range_m.size)
    beam, over_beam = _cell(_place(angle, bearing_rad, bearing_edges), bearing_rad.size)
    index, weight = [], []
    for next_bin in (0, 1):
        for next_beam in (0, 1):
            row, column = np.minimum(bin_ + next_bin, range_m.size - 1), np.minimum(beam + next_beam, bearing_rad.size - 1)
            index.append(row * bearing_rad.size + column)
            weight.append((over_bin if next_bin else 1 - over_bin) * (over_beam if next_beam else 1 - over_beam) * inside)
    extent = (float(left), float(right), float(low), float(high))
    return CartesianMap(np.stack(index), np.stack(weight).astype(np.float32), extent)


def to_cartesian(image: ArrayLike, range_m: ArrayLike, bearing_rad: ArrayLike, rows: int = 800) -> CartesianImage:
    """One image ``(bins, beams)`` as a fan in metres; see :func:`cartesian_map`.

    Raises:
        MitsonarError: shapes that do not fit, or ranges or bearings that do not rise.
    """
    image = np.asarray(image, dtype=float)
    wanted = np.size(range_m), np.size(bearing_rad)
    if image.shape != wanted:
        raise MitsonarError(f"image must be (bins, beams) = {wanted}: got {image.shape}")
    conversion = cartesian_map(range_m, bearing_rad, rows)
    fan = np.where(conversion.weight.any(axis=0), conversion.apply(image), np.nan).astype(np.float32)
    return CartesianImage(fan, conversion.extent)


def _within_pi(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _cell(place: NDArray[np.float64], count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The cell before a fractional index, and how far beyond it; the border cells' values hold beyond their centres."""
    held = np.clip(place, 0, count - 1)
    whole = np.minimum(held.astype(np.int64), max(count - 2, 0))
    return whole, held - whole


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
