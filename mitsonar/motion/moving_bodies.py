"""Bodies of a scene that move: whose trajectories they follow, and where each is at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.motion.deforming import Deforming, VertexLaw
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import Trajectory

__all__ = ["VEHICLE", "BodyStates", "Moving", "MovingBodies"]

Moving: TypeAlias = Mapping[str, Trajectory | str | Path | Deforming | Sequence[Trajectory]]
"""Trajectories, or their TUM or CSV files, by the ids of the shapes that follow them; several: a shape in several places.

The word ``vehicle`` in place of a file stands for the path of the vehicle.
"""

VEHICLE = "vehicle"

VELOCITY_STEP_S = 1e-3
"""Time over which velocities are differences [s]."""

MOST_BODIES = 100_000


class BodyStates(NamedTuple):
    """Where bodies are, and how they move.

    Attributes:
        names: of the bodies; none: all is still.
        poses: ``(times, bodies, 6)`` [m, rad].
        velocities: ``(times, bodies, 6)`` [m/s, rad/s], see :meth:`MovingBodies.velocities`.
    """

    names: tuple[str, ...] = ()
    poses: NDArray[np.float64] | None = None
    velocities: NDArray[np.float64] | None = None

    def fields(self) -> dict[str, Any]:
        """Return these as fields of :class:`~mitsonar.records.sonar_frames.SonarFrames`."""
        return {"body_names": self.names, "body_poses": self.poses, "body_velocities": self.velocities}


@dataclass(frozen=True)
class MovingBodies:
    """Rigid bodies, each a shape of the scene at the poses of a trajectory.

    A body's own axes are those of the scene: a shape lies at pose 0 (x = y = z = 0, heading 0) where the scene has it, its
    bow along +y, its starboard side along +x. Before its first and after its last time a body stands still.

    Attributes:
        shapes: id of the shape of each body; bodies of one shape are neighbours.
        paths: trajectory of each body.
        deforming: vertices at a time of the shapes that deform, by their ids.
    """

    shapes: tuple[str, ...]
    paths: tuple[Trajectory, ...]
    deforming: Mapping[str, VertexLaw] = field(default_factory=dict)

    @classmethod
    def of(cls, moving: Moving, frame: str = "mitsonar", vehicle: Trajectory | None = None) -> MovingBodies:
        """Collect bodies, and read the trajectories that are files.

        Args:
            moving: trajectories by the ids of the shapes.
            frame: convention of files.
            vehicle: path of the vehicle, for the bodies that follow it.

        Raises:
            MitsonarError: no trajectory for a shape, too many, an unreadable file, or times that do not grow.
        """
        shapes: list[str] = []
        paths: list[Trajectory] = []
        deforming: dict[str, VertexLaw] = {}
        for name, given in moving.items():
            if isinstance(given, str) and given == VEHICLE:
                if vehicle is None:
                    raise MitsonarError(f"moving: {name} follows the vehicle, whose path is unknown here: give a trajectory")
                given = vehicle
            if isinstance(given, Deforming):
                deforming[name] = given.vertices
                given = given.path
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
        return cls(tuple(shapes), tuple(paths), deforming)

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

    def velocities(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return the velocity of each body at each time ``(times, bodies, 6)`` in the world's axes.

        Of its own origin [m/s], and the rotation vector a second [rad/s]: the means over half a millisecond before and
        after. A body rests before its first and after its last time; at these the motion beside them counts.
        """
        time = np.atleast_1d(np.asarray(time_s, dtype=float))
        found = np.zeros((len(time), len(self), 6))
        for number, path in enumerate(self.paths):
            first, last = path.time_s[0], path.time_s[-1]
            before, after = (np.clip(time + half, first, last) for half in (-VELOCITY_STEP_S / 2, VELOCITY_STEP_S / 2))
            moves = (time >= first) & (time <= last) & (after > before)
            if moves.any():
                begin, end, lasts = path.at(before[moves]), path.at(after[moves]), (after - before)[moves, None]
                found[moves, number, :3] = (end - begin)[:, :3] / lasts
                turn = vehicle_rotation(end) * vehicle_rotation(begin).inv()
                found[moves, number, 3:] = turn.as_rotvec() / lasts
        return found

    def states(self, time_s: ArrayLike) -> BodyStates:
        """Return names, poses and velocities at times."""
        return BodyStates(self.names, self.poses(time_s), self.velocities(time_s))

    def from_world(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return the first three rows of what turns points of the world to each body's axes ``(times, bodies, 3, 4)``."""
        poses = self.poses(time_s)
        turn = vehicle_rotation(poses.reshape(-1, 6)).as_matrix().reshape(*poses.shape[:2], 3, 3)
        back = turn.swapaxes(-1, -2)
        return np.concatenate([back, -(back @ poses[..., :3, None])], axis=-1)
