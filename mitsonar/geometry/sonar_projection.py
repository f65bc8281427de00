"""Points in space as a sonar receives them: range and bearing, their derivatives, and the points back from a height."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.geometry.ground_plane import arc_elevation
from mitsonar.instruments.sonar import Bearing
from mitsonar.instruments.views import directions
from mitsonar.motion.pose import vehicle_rotation

__all__ = ["Projection", "Views", "points_at", "polar_of", "projection_of"]

Array = NDArray[np.float64]

STEP = 1e-6
"""Step of an angle for the derivative of a rotation [rad]."""


class Views(NamedTuple):
    """Poses with their rotations, from which points are looked at.

    Attributes:
        poses: x, y, z [m], pitch, roll, heading [rad] ``(n, 6)``.
        rotations: from (starboard, forward, up) to the world ``(n, 3, 3)``.
        turns: their derivatives by pitch, roll and heading ``(n, 3, 3, 3)``: the second axis is the angle.
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
            beside = table.copy()
            beside[:, 3 + k] += STEP
            ahead = vehicle_rotation(beside).as_matrix()
            beside[:, 3 + k] -= 2 * STEP
            turns[:, k] = (ahead - vehicle_rotation(beside).as_matrix()) / (2 * STEP)
        return cls(table, rotations, turns)

    def take(self, index: NDArray[np.intp]) -> Views:
        """Return the views of given numbers, one a row."""
        return Views(self.poses[index], self.rotations[index], self.turns[index])


class Projection(NamedTuple):
    """Range [m] and bearing [rad] ``(n, 2)``, their derivatives by the point ``(n, 2, 3)`` and by the pose ``(n, 2, 6)``."""

    polar: Array
    by_point: Array
    by_pose: Array


def polar_of(points: Array, views: Views, bearing: Bearing) -> Array:
    """Compute range [m] and bearing [rad] ``(..., 2)`` of points ``(..., 3)``; one view, or one for each row of points."""
    shape = (len(views.poses), *(1,) * (points.ndim - 2))
    away = points - views.poses[:, :3].reshape(*shape, 3)
    # away @ R, for each view
    local = np.einsum("n...a,nab->n...b", away, np.broadcast_to(views.rotations, (len(away), 3, 3)))
    radius = np.sqrt((local * local).sum(axis=-1))
    starboard = local[..., 0]
    angle = np.arctan2(starboard, local[..., 1]) if bearing == "azimuth" else np.arcsin(starboard / radius)
    return np.stack([radius, angle], axis=-1)


def projection_of(points: Array, views: Views, bearing: Bearing) -> Projection:
    """Compute range and bearing of points ``(n, 3)`` and their derivatives; one view, or one for each point."""
    away = points - views.poses[:, :3]
    local = np.einsum("na,nab->nb", away, np.broadcast_to(views.rotations, (len(away), 3, 3)))
    radius = np.sqrt((local * local).sum(axis=1))
    along = local / radius[:, None]
    if bearing == "azimuth":
        level = local[:, 0] ** 2 + local[:, 1] ** 2
        angle = np.arctan2(local[:, 0], local[:, 1])
        across = np.stack([local[:, 1] / level, -local[:, 0] / level, np.zeros_like(level)], axis=1)
    else:
        sine = along[:, 0]
        angle = np.arcsin(sine)
        across = (np.array([1.0, 0.0, 0.0]) - sine[:, None] * along) / (radius * np.sqrt(1 - sine * sine))[:, None]
    by_local = np.stack([along, across], axis=1)
    by_point = np.einsum("nib,nab->nia", by_local, np.broadcast_to(views.rotations, (len(away), 3, 3)))
    turning = np.einsum("na,nkab->nkb", away, np.broadcast_to(views.turns, (len(away), 3, 3, 3)))
    by_angle = np.einsum("nib,nkb->nik", by_local, turning)
    return Projection(np.stack([radius, angle], axis=1), by_point, np.concatenate([-by_point, by_angle], axis=2))


def points_at(polar: Array, height_m: Array, views: Views, bearing: Bearing) -> Array:
    """Compute the points ``(..., 3)`` [m] that have a range, a bearing and a height.

    Args:
        polar: range [m] and bearing [rad] ``(n, ..., 2)``.
        height_m: of the points over the origin of the world ``(n, ...)``.
        views: one, or one for each row.
        bearing: kind of the bearing, ``azimuth`` or ``cone``.

    Returns:
        Of two points with these numbers the one nearer to the sonar's axis; nan where there is none.
    """
    shape = (len(views.poses), *(1,) * (polar.ndim - 2))
    radius, angle = polar[..., 0], polar[..., 1]
    rise = (height_m - views.poses[:, 2].reshape(shape)) / radius
    upward = views.rotations[:, 2].reshape(*shape, 3)
    elevation = arc_elevation(bearing, angle, rise, upward)
    local = directions(bearing, angle, elevation) * radius[..., None]
    turned = np.einsum("n...b,nab->n...a", local, np.broadcast_to(views.rotations, (len(local), 3, 3)))
    return np.asarray(turned + views.poses[:, :3].reshape(*shape, 3))
