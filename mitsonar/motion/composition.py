"""How motions between pings compose to poses (Almanza-Medina, eq. 3.4), and how poses give motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import ArrayLike, NDArray

from mitsonar.arrays import AnyArray
from mitsonar.errors import MitsonarError, suggest_names
from mitsonar.motion.pose import Pose, mounted, plain_number, poses_from, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory

__all__ = [
    "DEGREES",
    "PLANAR",
    "Motion",
    "MotionPrior",
    "MotionStd",
    "compose",
    "compose_six",
    "degrees_named",
    "inverse",
    "motions",
    "six_between",
    "six_of",
    "steady",
    "steered",
]


DEGREES = {
    "sideways": "to starboard [m]",
    "forward": "ahead [m]",
    "rise": "up [m]",
    "pitch": "nose down, about the level axis to starboard [rad]",
    "roll": "port side up, about the level axis ahead [rad]",
    "yaw": "to starboard, about the vertical axis [rad]",
}
"""The six degrees of freedom of a motion, in level axes of the new heading, in this order; angles turn about the pose."""

PLANAR = ("sideways", "forward", "yaw")
"""The degrees of freedom of :class:`Motion`."""


class Motion(NamedTuple):
    """Motion between two pings: sideways [m], forward [m], yaw [rad], in axes of the second heading (eq. 3.4)."""

    sideways: float
    forward: float
    yaw: float

    def __repr__(self) -> str:
        return f"Motion({', '.join(f'{name}={plain_number(value)!r}' for name, value in self._asdict().items())})"


def compose(pose: Pose, motion: Motion) -> Pose:
    """Compute the pose after a motion, which is given in axes of the *new* heading (Almanza-Medina, eq. 3.4)."""
    heading = pose.heading + motion.yaw
    sin, cos = np.sin(heading), np.cos(heading)
    x = pose.x + motion.forward * sin + motion.sideways * cos
    y = pose.y + motion.forward * cos - motion.sideways * sin
    return Pose.from_row((float(x), float(y), pose.z, pose.pitch, pose.roll, float(heading)))


def compose_six(pose: Pose, motion: ArrayLike) -> Pose:
    """Compute the pose after a motion with all six degrees of freedom.

    The pose first moves as in :func:`compose`, then rises. It turns about its position with a level vehicle of the new
    heading, which rolls and then pitches; the attitude that the pose had relative to the level vehicle stays. Without rise,
    pitch and roll the result is that of :func:`compose`, bit for bit.

    Args:
        pose: the pose before the motion, at any attitude.
        motion: the motion in the order of :data:`DEGREES` ``(6,)`` [m, rad].
    """
    sideways, forward, rise, pitch, roll, yaw = (float(value) for value in np.asarray(motion, dtype=float))
    moved = compose(pose, Motion(sideways, forward, yaw))
    if not (rise or pitch or roll):
        return moved
    level = (moved.x, moved.y, moved.z + rise, pitch, roll, moved.heading)
    tilt = Pose.from_row((0.0, 0.0, 0.0, pose.pitch, pose.roll, 0.0))
    return Pose.from_row(mounted([level], tilt)[0].tolist())


def six_between(before: Pose, after: Pose) -> NDArray[np.float64]:
    """Return the motion ``(6,)`` that leads from one pose to another by :func:`compose_six`.

    The angles of the level vehicle between are unique while it pitches by less than 90 deg.
    """
    tilt = vehicle_rotation(Pose.from_row((0.0, 0.0, 0.0, before.pitch, before.roll, 0.0)))
    level = poses_from(after[:3], vehicle_rotation(after) * tilt.inv())[0]
    planar = motions([(*before[:3], 0, 0, before.heading), (*level[:3], 0, 0, level[5])])[0]
    return np.array([planar[0], planar[1], after.z - before.z, level[3], level[4], planar[2]])


def six_of(motion: ArrayLike, degrees: Sequence[str]) -> NDArray[np.float64]:
    """Return motions ``(..., 6)`` from some of their degrees of freedom ``(..., k)``; the others are 0."""
    values = np.asarray(motion, dtype=float)
    six = np.zeros((*values.shape[:-1], len(DEGREES)))
    six[..., [list(DEGREES).index(name) for name in degrees]] = values
    return six


def degrees_named(text: str) -> tuple[str, ...]:
    """Return degrees of freedom from ``3``, ``6`` or their names separated by commas, in the order of :data:`DEGREES`.

    Raises:
        MitsonarError: an unknown name, or none.
    """
    if text.strip() in ("3", "6"):
        return PLANAR if text.strip() == "3" else tuple(DEGREES)
    names = {word.strip() for word in text.split(",")}
    for name in sorted(names - set(DEGREES)):
        raise MitsonarError(f"unknown degree of freedom {name[:40]!r}: give 3, 6 or names; {suggest_names(name, DEGREES)}")
    return tuple(name for name in DEGREES if name in names)


def inverse(motion: AnyArray) -> AnyArray:
    """Invert motions ``(..., 3)`` (sideways, forward [m], yaw [rad]; eq. 3.4), as arrays of NumPy or torch."""
    xp = array_namespace(motion)
    sideways, forward, yaw = (motion[..., k] for k in range(3))
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    return xp.stack([-(sideways * cos + forward * sin), -(forward * cos - sideways * sin), -yaw], axis=-1)


def motions(poses: ArrayLike) -> NDArray[np.float64]:
    """Compute the motion from each pose to the next, as :func:`compose` applies it (Almanza-Medina, eq. 3.4).

    Args:
        poses: x, y, z [m], pitch, roll, heading [rad] ``(frames, 6)``.

    Returns:
        Sideways, forward [m], yaw [rad] within -pi..pi ``(frames - 1, 3)``.
    """
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    (x, y), heading = np.diff(table[:, :2], axis=0).T, table[1:, 5]
    sin, cos = np.sin(heading), np.cos(heading)
    turn = np.diff(table[:, 5])
    yaw = turn - 2 * np.pi * np.rint(turn / (2 * np.pi))
    return np.column_stack([x * cos - y * sin, x * sin + y * cos, yaw])


def steady(
    start: Pose, velocity: tuple[float, float, float], frames: int, rate_hz: float
) -> tuple[Trajectory, NDArray[np.float64]]:
    """Simulate a level vehicle with constant velocity in body axes, which moves along an arc.

    Args:
        start: first pose.
        velocity: velocity to starboard and forward [m/s], and turn rate [rad/s].
        frames: number of poses.
        rate_hz: poses per second [Hz].

    Returns:
        The trajectory, and its velocities ``(frames, 4)`` as in :func:`mitsonar.motion.trajectory.velocities`.
    """
    sideways, forward, turn = velocity
    time = np.arange(frames) / rate_hz
    angle = turn * time
    # integrals over time of the cosine and sine of the turned angle a: t sin(a)/a and t (1 - cos a)/a
    cos_integral, sin_integral = time * np.sinc(angle / np.pi), time * np.sin(angle / 2) * np.sinc(angle / (2 * np.pi))
    sin, cos = np.sin(start.heading), np.cos(start.heading)
    right, ahead = sideways * cos_integral + forward * sin_integral, forward * cos_integral - sideways * sin_integral
    poses = np.tile(np.array(start, dtype=float), (frames, 1))
    poses[:, 0] += right * cos + ahead * sin
    poses[:, 1] += ahead * cos - right * sin
    poses[:, 5] += angle
    return Trajectory(poses, time), np.tile([sideways, forward, 0.0, turn], (frames, 1))


# ---------------- Steering


def steered(poses: ArrayLike, velocity: ArrayLike, step_s: float) -> NDArray[np.float64]:
    """Compute the poses of level vehicles after a step; the inverse of :func:`mitsonar.motion.trajectory.velocities`.

    Constant velocity and turn rate in body axes lead along an arc. Its chord is shorter than the arc by the sinc of half the
    turn. Pitch and roll do not change.

    Args:
        poses: poses before the step ``(n, 6)`` [m, rad].
        velocity: velocity to starboard, forward, up [m/s], and turn rate to starboard [rad/s] ``(n, 4)``.
        step_s: duration of the step [s].
    """
    poses, velocity = np.asarray(poses, dtype=float), np.asarray(velocity, dtype=float)
    starboard, forward, up, turn = (velocity * step_s).T
    middle = poses[:, 5] + turn / 2
    chord_ratio = np.sinc(turn / (2 * np.pi))
    sin, cos = np.sin(middle) * chord_ratio, np.cos(middle) * chord_ratio
    after = poses.copy()
    after[:, 0] += starboard * cos + forward * sin
    after[:, 1] += forward * cos - starboard * sin
    after[:, 2] += up
    after[:, 5] += turn
    return after


# ---------------- Priors


@dataclass(frozen=True)
class MotionStd:
    """Standard deviations of a motion: of its lengths and of its angles.

    Attributes:
        length_m: of sideways, forward and rise [m].
        angle_rad: of pitch, roll and yaw [rad].

    Raises:
        MitsonarError: one is not above 0.
    """

    length_m: float = 0.1
    angle_rad: float = field(default=float(np.radians(5)))

    def __post_init__(self) -> None:
        if not (0 < self.length_m < np.inf and 0 < self.angle_rad < np.inf):
            raise MitsonarError(
                "standard deviations of a motion must be above 0 and finite: got "
                f"{self.length_m:g} m and {np.degrees(self.angle_rad):g} deg"
            )

    def of(self, degrees: Sequence[str]) -> NDArray[np.float64]:
        """Return them by degree of freedom ``(k,)`` [m, rad]."""
        return np.array([self.length_m if "[m]" in DEGREES[name] else self.angle_rad for name in degrees])


class MotionPrior(NamedTuple):
    """The expected motion between two frames with its covariance, from other sensors or from earlier motions.

    Attributes:
        motion: sideways, forward [m], yaw [rad] (Almanza-Medina, eq. 3.4).
        covariance: covariance of the motion ``(3, 3)`` [m, m, rad]; an unknown component has a large variance.
    """

    motion: Motion
    covariance: NDArray[np.float64]

    @property
    def std(self) -> NDArray[np.float64]:
        """Return the standard deviations of sideways, forward [m] and yaw [rad] ``(3,)``."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=np.float64)
