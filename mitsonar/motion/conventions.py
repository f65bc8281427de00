"""Conventions of poses by name: mitsonar's own, that of ROS (REP 103), and that of navigation at sea.

| name | world: x, y, z | body: x, y, z | pitch > 0 | roll > 0 | turn about the vertical |
|---|---|---|---|---|---|
| ``mitsonar`` | east, north, up | starboard, forward, up | looks down | starboard down | heading, clockwise from north |
| ``ros-enu`` | east, north, up | forward, left, up | looks down | starboard down | yaw, anticlockwise from east |
| ``ned`` | north, east, down | forward, right, down | looks up | starboard down | heading, clockwise from north |

East and north are names of the world's first two axes: which way they lie on the earth is the user's choice.
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
    """How a file tells poses.

    Attributes:
        name: as it is asked for.
        axes: of world and body, in words.
        world: its world axes in mitsonar's ``(3, 3)``: columns.
        body: (starboard, forward, up) in its body axes ``(3, 3)``: columns.
        signs: of pitch, roll and the turn about the vertical, against mitsonar's.
        north: its turn about the vertical where the heading is 0 [rad].
        turn: what it calls that turn in a table's column; the first is written.
    """

    name: str
    axes: str
    world: tuple[tuple[int, int, int], ...]
    body: tuple[tuple[int, int, int], ...]
    signs: tuple[int, int, int]
    north: float
    turn: tuple[str, ...]

    def to_ours(self, position: Table, rotation: Rotation) -> tuple[Table, Rotation]:
        """Positions ``(n, 3)`` in mitsonar's world, and the rotations of (starboard, forward, up) to it.

        Args:
            position: in this convention's world [m].
            rotation: of its body to its world.
        """
        world, body = Rotation.from_matrix(self.world), Rotation.from_matrix(self.body)
        return world.apply(position), world * rotation * body

    def from_ours(self, position: Table, rotation: Rotation) -> tuple[Table, Rotation]:
        """The inverse of :meth:`to_ours`."""
        world, body = Rotation.from_matrix(self.world), Rotation.from_matrix(self.body)
        return world.inv().apply(position), world.inv() * rotation * body.inv()

    def angles_to_ours(self, angles: Table) -> Table:
        """Pitch, roll, heading ``(n, 3)`` [rad] as mitsonar has them.

        Args:
            angles: pitch, roll and turn about the vertical ``(n, 3)`` [rad]; that turn first, then pitch, then roll.
        """
        return np.asarray((angles - (0, 0, self.north)) * self.signs)

    def angles_from_ours(self, angles: Table) -> Table:
        """The inverse of :meth:`angles_to_ours`."""
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
    """The convention of that name.

    Raises:
        MitsonarError: unknown name.
    """
    if name not in CONVENTIONS:
        raise MitsonarError(f"unknown frame {name!r} of poses: {nearest_names(name, CONVENTIONS)}")
    return CONVENTIONS[name]


LEVEL = math.sin(math.radians(10))
"""An axis whose vertical part is smaller lies level."""

ON_ITS_SIDE = math.sin(math.radians(45))
"""A starboard axis whose vertical part is larger does not lie beside the sonar."""

ALONG = math.cos(math.radians(60))
"""A sonar whose axis lies farther from the way it goes, ahead and astern, looks across it."""


def sideways_or_up(poses: Table, *, looks_ahead: bool = True) -> NDArray[np.bool_]:
    """In which frames a sonar would look at the sky or sideways, as it does when a file is read in a wrong convention.

    At the sky: its axis rises by more than 10 deg. Sideways: its starboard axis is 45 deg off the level or more; or its own
    axis is level to 10 deg while its starboard axis is not, or while it moves across that axis (60..120 deg).

    Args:
        poses: x, y, z [m], pitch, roll, heading [rad] ``(frames, 6)``.
        looks_ahead: False where it looks down from a level vehicle, as hydrophones do: then it looks sideways where the
            vehicle's own axes are 45 deg off the level, and at the sky where the vehicle lies upside down.

    Returns:
        ``(frames,)``.
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
