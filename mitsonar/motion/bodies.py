"""Describe the moving bodies of a scene: their trajectories, and their poses, velocities and deformation at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mitsonar.errors import MitsonarError, validation_message
from mitsonar.io.files import read_yaml
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import Trajectory

__all__ = [
    "VEHICLE",
    "BodyMotion",
    "BodyStates",
    "Deforming",
    "MeshSequence",
    "Moving",
    "MovingBodies",
    "VertexFunction",
    "files_of",
    "motions_from",
    "read_motions",
]


# ---------------- Deforming bodies


VertexFunction: TypeAlias = Callable[[float], NDArray[Any]]
"""Vertices ``(vertices, 3)`` [m] in the body's axes at a time [s], in the order of the shape's mesh."""


@dataclass(frozen=True)
class Deforming:
    """A body that moves along a path and changes its shape.

    Attributes:
        path: path of the body; with a single pose it stays there.
        vertices: vertices of its mesh as a function of time.
    """

    path: Trajectory
    vertices: VertexFunction

    def __repr__(self) -> str:
        deformation = self.vertices
        description = (
            f"{len(deformation.vertices)} meshes"
            if isinstance(deformation, MeshSequence)
            else getattr(deformation, "__name__", type(deformation).__name__)
        )
        return f"Deforming({description} along {self.path})"


@dataclass(frozen=True)
class MeshSequence:
    """Vertices of a sequence of meshes, with linear interpolation in between.

    Attributes:
        vertices: ``(meshes, vertices, 3)`` [m].
        rate_hz: meshes per second; the first is at time 0.
        loop: whether the first mesh follows the last; otherwise the last one remains.
    """

    vertices: NDArray[np.float32]
    rate_hz: float
    loop: bool = True

    def __post_init__(self) -> None:
        if self.vertices.ndim != 3 or self.vertices.shape[2] != 3 or not len(self.vertices):
            raise MitsonarError(f"meshes are vertices (meshes, vertices, 3): got {self.vertices.shape}")
        if not 0 < self.rate_hz < np.inf:
            raise MitsonarError(f"rate_hz must be positive: got {self.rate_hz:g}; give the number of meshes per second")

    def __call__(self, time_s: float) -> NDArray[np.float32]:
        """Return the vertices ``(vertices, 3)`` at a time [s]; before time 0, the first mesh or the loop applies."""
        count = len(self.vertices)
        position = time_s * self.rate_hz
        position = position % count if self.loop else min(max(position, 0.0), count - 1.0)
        first = int(position)
        weight = np.float32(position - first)
        after = self.vertices[(first + 1) % count if self.loop else min(first + 1, count - 1)]
        return np.asarray(self.vertices[first % count] * (1 - weight) + after * weight, dtype=np.float32)


# ---------------- Moving bodies


Moving: TypeAlias = Mapping[str, Trajectory | str | Path | Deforming | Sequence[Trajectory]]
"""Trajectories, or their TUM or CSV files, by the ids of the shapes that follow them.

Several trajectories place a shape several times. The word ``vehicle`` in place of a file selects the path of the vehicle.
"""

VEHICLE = "vehicle"

VELOCITY_STEP_S = 1e-3
"""Time step of the finite differences for velocities [s]."""

MAX_BODIES = 100_000


class BodyStates(NamedTuple):
    """Poses and velocities of bodies.

    Attributes:
        names: names of the bodies; empty if nothing moves.
        poses: ``(times, bodies, 6)`` [m, rad].
        velocities: ``(times, bodies, 6)`` [m/s, rad/s], see :meth:`MovingBodies.velocities`.
    """

    names: tuple[str, ...] = ()
    poses: NDArray[np.float64] | None = None
    velocities: NDArray[np.float64] | None = None

    def fields(self) -> dict[str, Any]:
        """Return the states as fields of :class:`~mitsonar.records.frames.SonarFrames`."""
        return {"body_names": self.names, "body_poses": self.poses, "body_velocities": self.velocities}


@dataclass(frozen=True)
class MovingBodies:
    """Rigid bodies, each of which places a shape of the scene at the poses of a trajectory.

    The axes of a body are those of the scene: at pose 0 (x = y = z = 0, heading 0) a shape lies where the scene places it,
    with its bow along +y and its starboard side along +x. Before its first and after its last time a body is stationary.

    Attributes:
        shapes: shape id of each body; bodies of one shape are consecutive.
        paths: trajectory of each body.
        deforming: vertices of the deforming shapes as a function of time, by shape id.
    """

    shapes: tuple[str, ...]
    paths: tuple[Trajectory, ...]
    deforming: Mapping[str, VertexFunction] = field(default_factory=dict)

    @classmethod
    def of(cls, moving: Moving, frame: str = "mitsonar", vehicle: Trajectory | None = None) -> MovingBodies:
        """Create bodies, and read trajectories that are given as files.

        Args:
            moving: trajectories by shape id.
            frame: coordinate convention of the files.
            vehicle: path of the vehicle, for the bodies that follow it.

        Raises:
            MitsonarError: no trajectory for a shape, too many bodies, an unreadable file, or times that do not increase.
        """
        shapes: list[str] = []
        paths: list[Trajectory] = []
        deforming: dict[str, VertexFunction] = {}
        for name, motion in moving.items():
            if isinstance(motion, str) and motion == VEHICLE:
                if vehicle is None:
                    raise MitsonarError(f"moving: {name} follows the vehicle, whose path is unknown here: give a trajectory")
                motion = vehicle
            if isinstance(motion, Deforming):
                deforming[name] = motion.vertices
                motion = motion.path
            if isinstance(motion, str | Path):
                motion = Trajectory.load(motion, frame, looks_ahead=False)
            trajectories = [motion] if isinstance(motion, Trajectory) else list(motion)
            if not trajectories or not all(isinstance(item, Trajectory) for item in trajectories):
                raise MitsonarError(
                    f"moving: {name} follows a Trajectory, a TUM or CSV file, or a list of trajectories: got "
                    f"{type(motion).__name__ if trajectories else 'none'}"
                )
            for path in trajectories:
                path.at(path.time_s[0])  # rejects times that do not increase
            shapes += [name] * len(trajectories)
            paths += trajectories
        if len(paths) > MAX_BODIES:
            raise MitsonarError(f"moving: at most {MAX_BODIES:,} bodies: got {len(paths):,}")
        return cls(tuple(shapes), tuple(paths), deforming)

    def __len__(self) -> int:
        return len(self.paths)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the name of each body: that of its shape, numbered if a shape has several bodies: ``fish 2``."""
        counts: dict[str, int] = {}
        names = []
        for shape in self.shapes:
            counts[shape] = counts.get(shape, 0) + 1
            names.append(shape if self.shapes.count(shape) == 1 else f"{shape} {counts[shape]}")
        return tuple(names)

    def poses(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return the pose of each body at each time ``(times, bodies, 6)`` [m, rad]."""
        time = np.atleast_1d(np.asarray(time_s, dtype=float))
        return np.stack([path.at(time) for path in self.paths], axis=1)

    def velocities(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return the velocity of each body at each time ``(times, bodies, 6)`` in world axes.

        The components are the velocity of its origin [m/s] and its rotation vector per second [rad/s], as central
        differences over one millisecond. A body is stationary before its first and after its last time; at these times the
        one-sided difference is used.
        """
        time = np.atleast_1d(np.asarray(time_s, dtype=float))
        velocity = np.zeros((len(time), len(self), 6))
        for number, path in enumerate(self.paths):
            first, last = path.time_s[0], path.time_s[-1]
            before, after = (np.clip(time + offset, first, last) for offset in (-VELOCITY_STEP_S / 2, VELOCITY_STEP_S / 2))
            moving = (time >= first) & (time <= last) & (after > before)
            if moving.any():
                begin, end, duration = path.at(before[moving]), path.at(after[moving]), (after - before)[moving, None]
                velocity[moving, number, :3] = (end - begin)[:, :3] / duration
                rotation = vehicle_rotation(end) * vehicle_rotation(begin).inv()
                velocity[moving, number, 3:] = rotation.as_rotvec() / duration
        return velocity

    def states(self, time_s: ArrayLike) -> BodyStates:
        """Return the names, poses and velocities at given times."""
        return BodyStates(self.names, self.poses(time_s), self.velocities(time_s))

    def to_world(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return the first three rows of the transform from each body's axes to the world ``(times, bodies, 3, 4)``."""
        poses = self.poses(time_s)
        turn = vehicle_rotation(poses.reshape(-1, 6)).as_matrix().reshape(*poses.shape[:2], 3, 3)
        return np.concatenate([turn, poses[..., :3, None]], axis=-1)

    def from_world(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return the first three rows of the transform from the world to each body's axes ``(times, bodies, 3, 4)``."""
        rows = self.to_world(time_s)
        back = rows[..., :3].swapaxes(-1, -2)
        return np.concatenate([back, -(back @ rows[..., 3:])], axis=-1)


# ---------------- Motion of bodies in YAML files


SEE = " (see docs/guides/moving.md)"


class BodyMotion(BaseModel):
    """Motion and deformation of one shape of the scene, as given in a YAML file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    path: str | None = Field(
        None, description="a TUM or CSV file, several as school/*.tum, or vehicle; default: the body stays in its place"
    )
    frame: str = Field("mitsonar", description="convention of the file: mitsonar, ros-enu or ned")
    meshes: str | None = Field(None, description="PLY files of a mesh that deforms: fish/*.ply, in the order of their names")
    rate_hz: float = Field(10.0, gt=0, le=1e6, description="meshes a second [Hz]; the first is at time 0")
    loop: bool = Field(True, description="after the last mesh comes the first")

    @classmethod
    def create(cls, name: str, given: Any) -> Self:
        """Create the motion of a shape from its keys, or from a path alone.

        Raises:
            MitsonarError: an unknown key, a value of another type, or neither a path nor meshes.
        """
        fields = {"path": given} if isinstance(given, str) else given
        if not (isinstance(fields, dict) and all(isinstance(key, str) for key in fields)):
            raise MitsonarError(f"moving: {name} takes a path, or keys such as path and meshes: got {type(given).__name__}")
        try:
            motion = cls(**fields)
        except ValidationError as error:
            raise MitsonarError(f"moving: {name}: {validation_message(error, cls, 'motion', SEE)}") from None
        if motion.path is None and motion.meshes is None:
            raise MitsonarError(f"moving: {name} needs a path or meshes{SEE}")
        return motion


def read_motions(file: str | Path) -> dict[str, BodyMotion]:
    """Read a YAML file with lines ``id: path.tum``, or the keys of :class:`BodyMotion` below each id.

    Raises:
        MitsonarError: an unreadable file, or invalid keys.
    """
    return motions_from(read_yaml(file, "file of moving bodies"), str(file))


def motions_from(table: Any, source: str) -> dict[str, BodyMotion]:
    """Return the motions in a table, by shape id; ``source`` names the file in error messages.

    Raises:
        MitsonarError: not a table of ids, or invalid keys.
    """
    if not (isinstance(table, dict) and table and all(isinstance(name, str) for name in table)):
        raise MitsonarError(f"{source} must hold `shape id: path` lines{SEE}")
    return {name: BodyMotion.create(name, keys) for name, keys in table.items()}


def files_of(name: str, folder: Path) -> list[Path]:
    """Return the file with a name, or the files that match a pattern such as ``school/*.tum``, sorted by name.

    Raises:
        MitsonarError: no file matches.
    """
    pattern = folder / name
    matches = sorted(pattern.parent.glob(pattern.name)) if "*" in pattern.name else [pattern]
    if not matches:
        raise MitsonarError(f"no file matches {pattern}: give TUM, CSV or PLY files")
    return matches
