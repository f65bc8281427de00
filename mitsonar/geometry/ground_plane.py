"""Level ground: the ground point of each cell of a sonar image, and its motion with the sonar."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from array_api_compat import array_namespace, is_array_api_obj
from numpy.typing import NDArray

from mitsonar.arrays import AnyArray
from mitsonar.instruments.sonar import Bearing
from mitsonar.instruments.views import directions
from mitsonar.motion.pose import Pose, vehicle_rotation

__all__ = ["GroundGeometry", "arc_elevation", "moved", "nearest_known"]

SMALL = 1e-4
"""Step of differences [m, rad]."""


@dataclass(frozen=True)
class GroundGeometry:
    """A sonar over level ground. Ground points are (starboard, forward) [m] in level axes that turn with its heading.

    Attributes:
        range_m: of the cells ``(bins,)`` [m].
        bearing_rad: of the cells ``(beams,)`` [rad].
        bearing: kind of that angle, ``azimuth`` or ``cone``.
        height_m: of the sonar over the ground.
        pitch_rad: > 0 points down.
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
        """Return the sonar's starboard, forward and up in level axes, as columns ``(3, 3)``."""
        return _turn(self.pitch_rad, self.roll_rad)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """Return the ground points of the cells ``(bins, beams, 2)`` [m]; nan where a cell's arc does not meet the ground.

        An arc can meet the ground in two points. The one nearer to the sonar's axis in elevation counts.
        """
        radius, b = np.meshgrid(self.range_m, self.bearing_rad, indexing="ij")
        e = arc_elevation(self.bearing, b, -self.height_m / radius, self.turn[2])
        return np.asarray((directions(self.bearing, b, e) * radius[..., None] @ self.turn.T)[..., :2])

    def to_polar(self, points: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Compute range [m] and bearing [rad] of ground points ``(..., 2)``."""
        s, f, u = self._in_sonar(points)
        radius = np.sqrt(s * s + f * f + u * u)
        return radius, np.arctan2(s, f) if self.bearing == "azimuth" else np.arcsin(s / radius)

    def elevation(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Compute the elevation [rad] in the sonar's frame of ground points ``(..., 2)``."""
        s, f, u = self._in_sonar(points)
        return np.asarray(np.arctan2(u, np.hypot(s, f) if self.bearing == "azimuth" else f))

    @cached_property
    def derivative(self) -> NDArray[np.float64]:
        """Return the derivative of range [m] and bearing [rad] of each cell's ground point by the motion, at rest.

        The motion is sideways, forward [m], yaw [rad] (Almanza-Medina, eq. 3.4). Shape: ``(bins, beams, 2, 3)``.
        """
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
        """Return the derivative of range [m] and bearing [rad] of each cell's ground point by the sonar's height [m].

        Shape: ``(bins, beams, 2)``.
        """
        s, f, u = self._in_sonar(self.points)
        radius = np.sqrt(s * s + f * f + u * u)
        along = self.height_m / radius
        aside, ahead = -self.turn[2, 0], -self.turn[2, 1]
        if self.bearing == "azimuth":
            turning = (f * aside - s * ahead) / (s * s + f * f)
        else:
            turning = (aside - (s / radius) * along) / np.sqrt(radius * radius - s * s)
        return np.stack([along, turning], axis=-1)

    def motions_of_lean(self, along: int, half_rad: float) -> NDArray[np.float64]:
        """Compute the motions that a change of height, pitch and roll looks like from one ping to the next.

        The motion that moves the lit ground's ranges and bearings most alike, by least squares: ranges in bins, bearings in
        beams.

        Args:
            along: how many ranges and bearings of the cells count.
            half_rad: half the opening of the beams, which limits the lit ground [rad].

        Returns:
            Sideways, forward [m], yaw [rad] a metre of height, a radian of pitch and of roll, as columns ``(3, 3)``; 0 where
            the ground that is lit does not tell a motion.
        """
        bin_m, beam_rad = (float(np.median(np.abs(np.diff(axis)))) for axis in (self.range_m, self.bearing_rad))
        ranges, bearings = (np.linspace(axis[0], axis[-1], along) for axis in (self.range_m, self.bearing_rad))
        few = replace(self, range_m=ranges, bearing_rad=bearings)
        lit = np.isfinite(few.points).all(axis=-1) & (np.abs(few.elevation(few.points)) <= half_rad)
        if lit.sum() < 3:
            return np.zeros((3, 3))
        scale, points = np.array([bin_m, beam_rad]), few.points[lit]
        by_motion = few.derivative[lit] / scale[:, None]
        changes = []
        for name in ("height_m", "pitch_rad", "roll_rad"):
            ends = [replace(few, **{name: getattr(few, name) + sign * SMALL}).to_polar(points) for sign in (-1, 1)]
            changes.append((np.stack(ends[1], axis=-1) - np.stack(ends[0], axis=-1)) / (2 * SMALL) / scale)
        found = np.linalg.lstsq(by_motion.reshape(-1, 3), np.stack(changes, axis=-1).reshape(-1, 3), rcond=None)[0]
        return np.asarray(found)

    def _in_sonar(self, points: NDArray[np.floating]) -> tuple[NDArray[np.floating], ...]:
        """Return starboard, forward, up of ground points in the sonar's own axes."""
        x, y, turn = points[..., 0], points[..., 1], self.turn.astype(points.dtype)
        below = points.dtype.type(self.height_m)
        starboard, forward, up = (x * turn[0, k] + y * turn[1, k] - below * turn[2, k] for k in range(3))
        return starboard, forward, up


@lru_cache(maxsize=16)
def _turn(pitch: float, roll: float) -> NDArray[np.float64]:
    """Return the axes of a sonar; kept, since many geometries differ by their height alone."""
    axes = np.asarray(vehicle_rotation(Pose(0, 0, 0, pitch, roll, 0)).as_matrix()[0], dtype=np.float64)
    axes.setflags(write=False)
    return axes


def arc_elevation(
    bearing: Bearing, angle: NDArray[np.float64], rise: NDArray[np.float64], upward: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Compute the elevation [rad] at which the arc of a cell meets a level.

    Args:
        bearing: kind of the angle, ``azimuth`` or ``cone``.
        angle: bearings of the cells [rad].
        rise: height of the level over the sonar, as part of the range of each cell; like ``angle``.
        upward: how much of the sonar's starboard, forward and up points up ``(..., 3)``.

    Returns:
        Of the two points where an arc may meet the level, the one nearer to the sonar's axis; nan where there is none.
    """
    starboard, forward, up = np.moveaxis(np.asarray(upward), -1, 0)
    if bearing == "azimuth":
        fixed, ahead, above = 0.0, starboard * np.sin(angle) + forward * np.cos(angle), np.broadcast_to(up, angle.shape)
    else:
        fixed, ahead, above = starboard * np.sin(angle), forward * np.cos(angle), up * np.cos(angle)
    # fixed + ahead cos e + above sin e = rise
    lean = np.arctan2(above, ahead)
    with np.errstate(invalid="ignore", divide="ignore"):
        swing = np.arccos((rise - fixed) / np.hypot(ahead, above))
    one, other = (_within_pi(lean + sign * swing) for sign in (-1, 1))
    return np.where(np.abs(one) <= np.abs(other), one, other)


def nearest_known(known: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find for each node the node whose values it takes.

    A node on the ground takes its own. Another takes those of the first one farther out, in the nearest column with any.

    Args:
        known: whether a node meets the ground ``(ranges, bearings)``.

    Returns:
        Row and column, each ``(ranges, bearings)``.
    """
    rows, columns = known.shape
    having = np.flatnonzero(known.any(axis=0))
    if not having.size:
        return np.zeros_like(known, dtype=np.intp), np.zeros_like(known, dtype=np.intp)
    column = having[np.abs(np.arange(columns)[:, None] - having).argmin(axis=1)]
    row = np.maximum(np.arange(rows)[:, None], known.argmax(axis=0)[column])
    return row, np.broadcast_to(column, row.shape)


def moved(points: AnyArray, motion: AnyArray) -> AnyArray:
    """Compute the positions of ground points relative to a sonar that has moved (Almanza-Medina, eq. 3.4).

    Args:
        points: starboard, forward [m] ``(..., 2)``, of NumPy or torch.
        motion: sideways, forward [m], yaw [rad]; three numbers, or an array whose leading axes broadcast with the points'.
    """
    xp = array_namespace(points)
    motion = xp.astype(motion if is_array_api_obj(motion) else xp.asarray(motion), points.dtype, copy=False)
    sideways, forward, yaw = (motion[..., k] for k in range(3))
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    x, y = points[..., 0], points[..., 1]
    return xp.stack([x * cos - y * sin - sideways, x * sin + y * cos - forward], axis=-1)


def _within_pi(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
