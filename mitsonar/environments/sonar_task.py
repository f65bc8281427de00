"""What the vehicles of an environment may do, and what ends an episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self, TypeAlias, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError, argument, nearest_names, refuse_unknown

__all__ = ["OBSERVABLE", "Reward", "SonarTask", "TaskFields", "Transition"]

Table: TypeAlias = NDArray[np.float64]

OBSERVABLE = ("image", "altitude", "pose")
"""What can be observed."""

VELOCITY = ("starboard", "forward", "up", "turn")

FULL_TURNS = np.array([np.pi, np.pi, 4 * np.pi])
"""Largest pitch, roll and heading of a start [rad]; a heading may be drawn across 360 deg."""


@dataclass(frozen=True)
class Transition:
    """A step of all vehicles, from which rewards follow.

    Attributes:
        action: clipped to -1..1 ``(n, 4)``: starboard, forward, up, turn to starboard.
        before: poses before ``(n, 6)`` [m, rad].
        poses: after ``(n, 6)``.
        image: of the sonar ``(n, bins, beams)`` uint8.
        altitude_m: over what is straight below ``(n,)`` [m].
        clearance_m: to the nearest surface ``(n,)`` [m].
        collided: whether that is too near ``(n,)``.
        outside: whether the vehicle has left its bounds ``(n,)``.
    """

    action: Table
    before: Table
    poses: Table
    image: NDArray[np.uint8]
    altitude_m: Table
    clearance_m: Table
    collided: NDArray[np.bool_]
    outside: NDArray[np.bool_]


Reward: TypeAlias = Callable[[Transition], ArrayLike]
"""Gives the reward of each vehicle ``(n,)``, or one number for all."""


class TaskFields(TypedDict, total=False):
    """Fields of a :class:`SonarTask` as arguments of an environment."""

    start: ArrayLike | None
    bounds: Sequence[Sequence[float]] | NDArray[Any] | None
    max_velocity: tuple[float, float, float, float]
    step_s: float | None
    clearance_m: float
    max_steps: int | None
    observe: tuple[str, ...]
    reward: Reward | None
    gain: float | None
    noise: NoiseModel | None
    altimeter_m: float


@dataclass(frozen=True)
class SonarTask:
    """What vehicles may do. They are level, and move with the velocity of the action.

    Attributes:
        start: pose of the sonar at the begin of an episode, or two poses between which it is drawn, number by number
            [m, rad]; default: the pose of the scene's sonar.
        bounds: lowest and highest x, y, z [m]; who leaves them has ended. Default: none.
        max_velocity: of the actions -1 and 1: starboard, forward, up [m/s], turn [rad/s].
        step_s: duration of a step [s]; default: 1 / ``frame_rate_hz``.
        clearance_m: distance to a surface below which a vehicle has collided [m].
        max_steps: steps after which an episode is cut off; default: none.
        observe: of :data:`OBSERVABLE`; the image alone is a box, several are a dictionary.
        reward: of each step, by its :class:`Transition`; default: 0.
        gain: of the image; default: by eight poses of ``start``.
        noise: of the image; default: none.
        altimeter_m: an altitude beyond is told as this [m].

    Raises:
        MitsonarError: a value that is not allowed.
    """

    start: ArrayLike | None = None
    bounds: ArrayLike | None = None
    max_velocity: tuple[float, float, float, float] = (0.5, 1.0, 0.5, 0.5)
    step_s: float | None = None
    clearance_m: float = 0.3
    max_steps: int | None = None
    observe: tuple[str, ...] = ("image",)
    reward: Reward | None = None
    gain: float | None = None
    noise: NoiseModel | None = None
    altimeter_m: float = 100.0

    def __post_init__(self) -> None:
        for name, least in (("step_s", 1e-6), ("gain", 0.0), ("max_steps", 1), ("clearance_m", 0.0), ("altimeter_m", 1e-6)):
            value = getattr(self, name)
            known = int | np.integer if name == "max_steps" else int | float | np.number
            if value is not None and not (isinstance(value, known) and least <= value < np.inf):
                kind = "whole" if name == "max_steps" else "finite"
                raise MitsonarError(f"{argument(name)} must be a {kind} number of at least {least:g}: got {value!r}")
        if self.noise is not None and not isinstance(self.noise, NoiseModel):
            raise MitsonarError(f"noise is a NoiseModel, as mitsonar.acoustics.noise.load_noise gives: got {self.noise!r}")
        speeds = _numbers("max_velocity", self.max_velocity)
        if speeds.shape != (4,) or not (np.isfinite(speeds).all() and (speeds >= 0).all()):
            raise MitsonarError(f"max_velocity is four numbers of 0 or more, {', '.join(VELOCITY)}: got {self.max_velocity}")
        if not isinstance(self.observe, tuple | list):
            raise MitsonarError(f"observe is a tuple of image and others: got {self.observe!r}; give ('image',)")
        unknown = [name for name in self.observe if name not in OBSERVABLE]
        if unknown or "image" not in self.observe:
            wrong = str(unknown[0] if unknown else self.observe)
            raise MitsonarError(f"observe is a tuple of image and others: got {wrong!r}; {nearest_names(wrong, OBSERVABLE)}")
        self.refuse_outside(self.span)

    def refuse_outside(self, span: Table) -> None:
        """Refuse poses where episodes begin ``(2, 6)`` that lie outside the bounds, or whose angles are no radians.

        Raises:
            MitsonarError: one does, or is.
        """
        low, high = self.box
        for pose in span[np.isfinite(span).all(axis=1)]:
            shown = ", ".join(f"{value:g}" for value in pose)
            if (pose[:3] < low).any() or (pose[:3] > high).any():
                raise MitsonarError(
                    f"start lies outside bounds, where every episode ends at its first step: got {shown}, and bounds "
                    f"{low.tolist()}, {high.tolist()}; move one of them"
                )
            if (np.abs(pose[3:]) > FULL_TURNS).any():
                raise MitsonarError(f"start is x, y, z [m], pitch, roll, heading in rad: got {shown}; are these degrees?")

    @classmethod
    def create(cls, given: dict[str, Any], own: Sequence[str] = ()) -> Self:
        """Create a task from its fields by name; ``own`` are other arguments of an environment, for the message.

        Raises:
            MitsonarError: an unknown field, or a value that is not allowed.
        """
        refuse_unknown(given, (*(field.name for field in fields(cls)), *own), "an environment")
        return cls(**given)

    @property
    def span(self) -> Table:
        """Return the two poses between which episodes begin ``(2, 6)``; of nan without a start.

        Raises:
            MitsonarError: not one or two finite poses.
        """
        if self.start is None:
            return np.full((2, 6), np.nan)
        table = np.atleast_2d(_numbers("start", self.start))
        if table.shape not in ((1, 6), (2, 6)) or not np.isfinite(table).all():
            raise MitsonarError(f"start is one pose or two, of x, y, z [m], pitch, roll, heading [rad]: got {table.shape}")
        return np.asarray(np.broadcast_to(table, (2, 6)))

    @property
    def box(self) -> Table:
        """Return the lowest and the highest place ``(2, 3)`` [m].

        Raises:
            MitsonarError: they are not two places, the lower first.
        """
        if self.bounds is None:
            return np.array([[-np.inf] * 3, [np.inf] * 3])
        box = _numbers("bounds", self.bounds)
        if box.shape != (2, 3) or not (box[0] < box[1]).all():
            raise MitsonarError(f"bounds are the lowest and the highest x, y, z [m]: got {box.tolist()}")
        return box


def _numbers(name: str, value: object) -> Table:
    """Return numbers as a table.

    Raises:
        MitsonarError: they are none.
    """
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise MitsonarError(f"{name} is made of numbers, rows of one length: got {value!r}") from None
