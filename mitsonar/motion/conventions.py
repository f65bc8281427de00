"""Conventions of poses by name: mitsonar's own, that of ROS (REP 103), and that of navigation at sea.

| name | world: x, y, z | body: x, y, z | pitch > 0 | roll > 0 | turn about the vertical |
|---|---|---|---|---|---|
| ``mitsonar`` | east, north, up | starboard, forward, up | looks down | starboard down | heading, clockwise from north |
| ``ros-enu`` | east, north, up | forward, left, up | looks down | starboard down | yaw, anticlockwise from east |
| ``ned`` | north, east, down | forward, right, down | looks up | starboard down | heading, clockwise from north |

East and north are names of the world's first two axes. The user chooses their directions on the earth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, nearest_names

__all__ = ["CONVENTIONS", "Convention", "convention_named", "sideways_or_up"]

Table = NDArray[np.float64]


@dataclass(frozen=True)
class Convention:
    """A convention for the poses of a file.

    Attributes:
        name: for the user, ``ros-enu``.
        axes: of world and body, in words.
        world: its world axes in mitsonar's world, as columns ``(3, 3)``.
        body: starboard, forward and up in its body axes, as columns ``(3, 3)``.
        signs: of pitch, roll and the turn about the vertical, relative to mitsonar's.
        north: its turn about the vertical at heading 0 [rad].
        turn: names of that turn in a table's column; the first is written.
    """

    name: str
    axes: str
    world: tuple[tuple[int, int, int], ...]
    body: tuple[tuple[int, int, int], ...]
    signs: tuple[int, int, int]
    north: float
    turn: tuple[str, ...]

    def to_ours(self, position: Table, rotation: Rotation) -> tuple[Table, Rotation]:
        """Convert positions and attitudes to mitsonar's convention.

        Args:
            position: in this convention's world ``(n, 3)`` [m].
            rotation: of its body to its world.

        Returns:
            Positions ``(n, 3)`` in mitsonar's world [m], and the rotations of (starboard, forward, up) to it.
        """
        world, body = Rotation.from_matrix(self.world), Rotation.from_matrix(self.body)
        return world.apply(position), world * rotation * body

    def from_ours(self, position: Table, rotation: Rotation) -> tuple[Table, Rotation]:
        """Convert positions and attitudes from mitsonar's convention, the inverse of :meth:`to_ours`."""
        world, body = Rotation.from_matrix(self.world), Rotation.from_matrix(self.body)
        return world.inv().apply(position), world.inv() * rotation * body.inv()

    def angles_to_ours(self, angles: Table) -> Table:
        """Convert angles to mitsonar's pitch, roll, heading ``(n, 3)`` [rad].

        Args:
            angles: pitch, roll and turn about the vertical ``(n, 3)`` [rad]; the rotation takes the turn first,
                then pitch, then roll.
        """
        return np.asarray((angles - (0, 0, self.north)) * self.signs)

    def angles_from_ours(self, angles: Table) -> Table:
        """Convert angles from mitsonar's convention: the inverse of :meth:`angles_to_ours`."""
        return np.asarray(angles * self.signs + (0, 0, self.north))


CONVENTIONS = {
    one.name: one
    for one in (
        Convention(
            "mitsonar",
            "world east, north, up; body starboard, forward, up",
            ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
            ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
            (1, 1, 1),
            0.0,
            ("heading", "yaw"),
        ),
        Convention(
            "ros-enu",
            "world east, north, up; body forward, left, up",
            ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
            ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
            (1, 1, -1),
            math.pi / 2,
            ("yaw",),
        ),
        Convention(
            "ned",
            "world north, east, down; body forward, right, down",
            ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
            ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
            (-1, 1, 1),
            0.0,
            ("heading", "yaw"),
        ),
    )
}
"""The conventions that pose files may have, by name."""


def convention_named(name: str) -> Convention:
    """Return the convention of a name.

    Raises:
        MitsonarError: unknown name.
    """
    if name not in CONVENTIONS:
        raise MitsonarError(f"unknown frame {name!r} of poses: {nearest_names(name, CONVENTIONS)}")
    return CONVENTIONS[name]


LEVEL = math.sin(math.radians(10))
"""An axis is level where its vertical part is smaller."""

ON_ITS_SIDE = math.sin(math.radians(45))
"""A sonar lies on its side where the vertical part of its starboard axis is larger."""

ALONG = math.cos(math.radians(60))
"""A sonar points across its course where the part of its axis along the course, ahead or astern, is smaller."""


def sideways_or_up(poses: Table, *, looks_ahead: bool = True) -> NDArray[np.bool_]:
    """Detect the frames in which a sonar points at the sky or sideways. A file read in a wrong convention has many.

    At the sky: its axis rises by more than 10 deg. Sideways: its starboard axis is 45 deg off the level or more; or its own
    axis is level to 10 deg while its starboard axis is not, or while it moves across that axis (60..120 deg).

    Args:
        poses: x, y, z [m], pitch, roll, heading [rad] ``(frames, 6)``.
        looks_ahead: False for a sonar that points down from a level vehicle, as hydrophones do. It points sideways where the
            vehicle's own axes are 45 deg off the level, and at the sky where the vehicle is upside down.

    Returns:
        True for these frames ``(frames,)``.
    """
    pitch, roll, heading = poses[:, 3:].T
    rises, leans, up = -np.sin(pitch), np.abs(np.sin(roll) * np.cos(pitch)), np.cos(roll) * np.cos(pitch)
    if not looks_ahead:
        return np.asarray(up < ON_ITS_SIDE)
    level = np.abs(rises) < LEVEL
    way = np.gradient(poses[:, :2], axis=0) if len(poses) > 1 else np.zeros((1, 2))
    length = np.linalg.norm(way, axis=1)
    ahead = np.abs(way[:, 0] * np.sin(heading) + way[:, 1] * np.cos(heading))
    across = (length > 1e-6) & (ahead < ALONG * length)
    return np.asarray((rises > LEVEL) | (leans > ON_ITS_SIDE) | (level & ((leans > LEVEL) | across)))
