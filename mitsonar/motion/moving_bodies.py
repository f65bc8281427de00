"""Bodies of a scene that move: whose trajectories they follow, and where each is at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import Trajectory

__all__ = ["Moving", "MovingBodies"]

Moving: TypeAlias = Mapping[str, Trajectory | str | Path | Sequence[Trajectory]]
"""Trajectories, or their TUM or CSV files, by the ids of the shapes that follow them; several: a shape in several places."""

MOST_BODIES = 100_000


@dataclass(frozen=True)
class MovingBodies:
    """Rigid bodies, each a shape of the scene at the poses of a trajectory.

    A body's own axes are those of the scene: a shape lies at pose 0 (x = y = z = 0, heading 0) where the scene has it, its
    bow along +y, its starboard side along +x. Before its first and after its last time a body stands still.

    Attributes:
        shapes: id of the shape of each body; bodies of one shape are neighbours.
        paths: trajectory of each body.
    """

    shapes: tuple[str, ...]
    paths: tuple[Trajectory, ...]

    @classmethod
    def of(cls, moving: Moving, frame: str = "mitsonar") -> MovingBodies:
        """Collect bodies, and read the trajectories that are files.

        Args:
            moving: trajectories by the ids of the shapes.
            frame: convention of files.

        Raises:
            MitsonarError: no trajectory for a shape, too many, an unreadable file, or times that do not grow.
        """
        shapes: list[str] = []
        paths: list[Trajectory] = []
        for name, given in moving.items():
            if isinstance(given, str | Path):
                given = Trajectory.load(given, frame, looks_ahead=False)
            many = [given] if isinstance(given, Trajectory) else list(given)
            if not many or not all(isinstance(one, Trajectory) for one in many):
                raise MitsonarError(
                    f"moving: {name} follows a Trajectory, a TUM or CSV file, or a list of trajectories: got "
                    f"{type(given).__name__ if many else 'none'}"
                )
            for path in many:
                path.at(path.time_s[0])  # refuses times that do not grow
            shapes += [name] * len(many)
            paths += many
        if len(paths) > MOST_BODIES:
            raise MitsonarError(f"moving: at most {MOST_BODIES:,} bodies: got {len(paths):,}")
        return cls(tuple(shapes), tuple(paths))

    def __len__(self) -> int:
        return len(self.paths)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the name of each body: that of its shape, with a number where a shape has several: ``fish 2``."""
        seen: dict[str, int] = {}
        found = []
        for shape in self.shapes:
            seen[shape] = seen.get(shape, 0) + 1
            found.append(shape if self.shapes.count(shape) == 1 else f"{shape} {seen[shape]}")
        return tuple(found)

    def poses(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return the pose of each body at each time ``(times, bodies, 6)`` [m, rad]."""
        time = np.atleast_1d(np.asarray(time_s, dtype=float))
        return np.stack([path.at(time) for path in self.paths], axis=1)

    def from_world(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return the first three rows of what turns points of the world to each body's axes ``(times, bodies, 3, 4)``."""
        poses = self.poses(time_s)
        turn = vehicle_rotation(poses.reshape(-1, 6)).as_matrix().reshape(*poses.shape[:2], 3, 3)
        back = turn.swapaxes(-1, -2)
        return np.concatenate([back, -(back @ poses[..., :3, None])], axis=-1)
