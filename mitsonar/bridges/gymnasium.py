"""How vehicles with a sonar become environments of Gymnasium, one (SonarEnv) or many at once (SonarVectorEnv)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias, TypedDict, Unpack

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import register
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import NoiseModel, refuse_noise
from mitsonar.errors import MitsonarError, MitsonarWarning, argument, check_argument_names, short_repr, suggest_names
from mitsonar.geometry.fan import CartesianMap, cartesian_map
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.motion.bodies import Moving
from mitsonar.motion.composition import steered
from mitsonar.simulation.pings import constant_gain, to_image
from mitsonar.simulation.scene import load_scene, sonar_in
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.tracing import Clearance

__all__ = [
    "OBSERVABLE",
    "Array",
    "Observation",
    "Reward",
    "SonarEnv",
    "SonarFleet",
    "SonarSource",
    "SonarTask",
    "SonarVectorEnv",
    "TaskFields",
    "Transition",
    "action_space",
    "fan_of",
    "fan_picture",
    "observation_space",
    "observed",
]


# ---------------- Fleet of vehicles


SonarSource: TypeAlias = "Simulator | mi.Scene | str | Path"
"""Source of pings: a simulator, a scene, or the file or name of a scene."""

MAX_FIRST_PING = 2**31
"""Upper limit of the number of an episode's first ping, which is drawn at random."""


class SonarFleet:
    """Vehicles with one sonar each in one scene; they ping together in one launch.

    The observations of a vehicle do not depend on the others. An episode draws from the generator of its vehicle: six
    numbers for the start, and the number of its first ping, which determines jitter and noise.

    Args:
        source: simulator, scene, or the file or name of a scene.
        sonar: sonar or its name; default: that of the scene.
        count: number of vehicles.
        moving: bodies that move in the scene, by the time since the start of the episode.
        task: start, limits and rewards of the vehicles.

    Attributes:
        poses: poses of the vehicles' sonars ``(count, 6)`` [m, rad].
        steps: number of steps since the start of each episode ``(count,)``.

    Raises:
        MitsonarError: there are no vehicles, no start, the source is not a scene, or every episode would end at once.

    Warns:
        MitsonarWarning: the start seems to lie below the seabed.
    """

    def __init__(
        self, source: SonarSource, sonar: Sonar | str | None, count: int, moving: Moving | None, task: SonarTask
    ) -> None:
        if not (isinstance(count, int | np.integer) and 1 <= count <= 100_000):
            raise MitsonarError(f"num_envs must be a whole number in 1..100000: got {count!r}")
        if not isinstance(source, Simulator | str | Path) and not hasattr(source, "shapes"):
            raise MitsonarError(f"scene must be a scene, its file or name, or a Simulator: got {type(source).__name__}")
        if isinstance(source, Simulator):
            if sonar is not None or moving is not None:
                raise MitsonarError("a Simulator defines its sonar and its moving bodies: leave out sonar and moving")
            self.simulator = source
        else:
            scene = load_scene(source) if isinstance(source, str | Path) else source
            instrument = load_sonar(sonar) if isinstance(sonar, str) else sonar
            self.simulator = Simulator(scene, instrument, moving=moving)
        self.sonar, self.task = self.simulator.sonar, task
        refuse_noise(task.noise, self.sonar)
        self.step_s = 1 / self.sonar.frame_rate_hz if task.step_s is None else task.step_s
        from mitsonar.simulation.tracing import Clearance  # needs the variant that the simulator has set

        self._clearance = Clearance(self.simulator.tracer)
        self._span = self._start_poses(task)
        self._check_start()
        self.gain = self._gain() if task.gain is None else task.gain
        self.poses = np.repeat(self._span[:1], count, axis=0)
        self.steps = np.zeros(count, dtype=np.int64)
        self._first_pings = np.zeros(count, dtype=np.int64)

    @property
    def clearance(self) -> Clearance:
        """Return the object that measures clearances in the current state of the scene."""
        if self._clearance.tracer is not self.simulator.tracer:  # the simulator has updated to a changed scene
            self._clearance = type(self._clearance)(self.simulator.tracer)
        return self._clearance

    def _start_poses(self, task: SonarTask) -> Table:
        """Return the two poses between which episodes begin ``(2, 6)`` [m, rad]."""
        if task.start is not None:
            return task.span
        scene_sonar = sonar_in(self.simulator.tracer.scene)
        if scene_sonar is None:
            raise MitsonarError("the scene has no sonar, at whose pose episodes would begin: give start, one pose or two")
        span = np.repeat(np.asarray(scene_sonar[1], dtype=float)[None], 2, axis=0)
        task.refuse_outside(span)
        return span

    def _check_start(self) -> None:
        """Refuse a start whose two poses both collide; warn if it seems to lie below the seabed."""
        positions = self._span[:, :3]
        clearance_m = self.clearance.of(positions, positions, np.zeros(2))
        if (clearance_m < self.task.clearance_m).all():
            raise MitsonarError(
                f"start is {clearance_m.max():.3g} m from a surface, which is less than clearance_m "
                f"{self.task.clearance_m:g}, so every episode would end at its first step; move start, or lower clearance_m"
            )
        below, above = (self.clearance.straight(positions, direction) for direction in ((0, 0, -1), (0, 0, 1)))
        if (np.isinf(below) & np.isfinite(above)).all():
            warnings.warn(
                f"there is no surface below start, and one {above.min():.3g} m above it: a vehicle under the seabed sees it "
                "from below; ignore this if the surface is a hull or ice",
                MitsonarWarning,
                stacklevel=4,
            )

    def _gain(self) -> float:
        """Return the constant gain, determined from eight poses between those of the start, always the same ones."""
        fractions = np.random.Generator(np.random.PCG64(0)).random((8, 6))
        return constant_gain(self.simulator.pings(self._span[0] + fractions * np.ptp(self._span, axis=0)))[0]

    def renew(self, which: NDArray[np.bool_], generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes for the vehicles selected by the mask ``which`` ``(count,)``."""
        for vehicle in map(int, np.flatnonzero(which)):
            fractions = generators[vehicle].random(6)
            self.poses[vehicle] = self._span[0] + fractions * (self._span[1] - self._span[0])
            self._first_pings[vehicle] = generators[vehicle].integers(MAX_FIRST_PING)
            self.steps[vehicle] = 0

    def look(self) -> tuple[NDArray[np.uint8], Table]:
        """Ping from all vehicles in one launch; return images ``(count, bins, beams)`` and altitudes ``(count,)`` [m].

        With the model ``coherent`` the vehicles ping one after the other.
        """
        ping_numbers = [int(number) for number in self._first_pings + self.steps]
        batches = list(self.simulator.pings(self.poses, first=ping_numbers, time_s=self.time_s))
        image = to_image(np.concatenate([pings.levels for pings in batches]), self.gain, self.sonar)
        if self.task.noise is not None:
            image = self.task.noise.apply(image, seed=self.sonar.seed, frames=np.array(ping_numbers))
        height_m = np.concatenate([pings.height_m for pings in batches])
        altitude_m = np.minimum(np.nan_to_num(height_m, nan=np.inf), self.task.altimeter_m)
        return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8), altitude_m

    @property
    def time_s(self) -> Table:
        """Return the time of each vehicle since the start of its episode ``(count,)`` [s]."""
        return np.asarray(self.steps * self.step_s, dtype=float)

    def advance(
        self, action: ArrayLike, renewed: NDArray[np.bool_], generators: Sequence[np.random.Generator]
    ) -> Transition:
        """Move all vehicles by their actions, or to the start of a new episode, then ping.

        Args:
            action: actions ``(count, 4)``, clipped to -1..1.
            renewed: mask of the vehicles that begin a new episode and ignore their action ``(count,)``.
            generators: random number generators of the vehicles.

        Raises:
            MitsonarError: the actions have a wrong shape, or are not finite.
        """
        # 1. Move all vehicles, and put those with a new episode at its start.
        actions = _numbers_of(action)
        if actions.shape != (len(self.poses), 4) or not np.isfinite(actions).all():
            raise MitsonarError(
                f"an action must be four finite numbers for each of {len(self.poses)}: got {_fault_of(actions)}"
            )
        clipped, before = np.clip(actions, -1, 1), self.poses.copy()
        self.poses = steered(before, clipped * np.asarray(self.task.max_velocity), self.step_s)
        self.steps += 1
        self.renew(renewed, generators)
        before[renewed] = self.poses[renewed]
        # 2. Ping, and find the clearance along the whole step, so that no vehicle passes through a thin surface.
        image, altitude_m = self.look()
        clearance_m = self.clearance.of(before[:, :3], self.poses[:, :3], self.time_s)
        low, high = self.task.box
        outside = ((self.poses[:, :3] < low) | (self.poses[:, :3] > high)).any(axis=1)
        collided = clearance_m < self.task.clearance_m
        return Transition(clipped, before, self.poses.copy(), image, altitude_m, clearance_m, collided, outside)

    def rewards(self, step: Transition) -> Table:
        """Return the rewards of a step ``(count,)``.

        Raises:
            MitsonarError: the reward function returns neither one finite number per vehicle nor one for all.
        """
        if self.task.reward is None:
            return np.zeros(len(self.poses))
        rewards = np.asarray(self.task.reward(step), dtype=float)
        if rewards.shape not in ((len(self.poses),), ()) or not np.isfinite(rewards).all():
            raise MitsonarError(
                f"reward must return {len(self.poses)} finite numbers, or one for all: got {_fault_of(rewards)}"
            )
        return np.array(np.broadcast_to(rewards, len(self.poses)))


def _numbers_of(action: ArrayLike) -> Table:
    """Return actions as numbers.

    Raises:
        MitsonarError: they are not numbers, or ragged.
    """
    try:
        return np.asarray(action, dtype=float)
    except (TypeError, ValueError):
        raise MitsonarError(f"an action must be four finite numbers: got {short_repr(action)}") from None


def _fault_of(values: Table) -> str:
    """Describe the fault of an array: its first value that is not finite, with its index, otherwise its shape."""
    faulty = np.argwhere(~np.isfinite(values))
    index = faulty[0].tolist() if len(faulty) else []
    return f"{values[tuple(index)]} at {index}" if len(faulty) else f"the shape {values.shape}"


# ---------------- Spaces and observations


Array: TypeAlias = NDArray[np.generic]
Observation: TypeAlias = "Array | dict[str, Array]"
"""The image, or several arrays keyed by name."""

MAX_POSE = 1e9
"""Bound of the numbers of a pose in the observation space [m, rad]."""

PICTURE_ROWS = 400


def action_space() -> spaces.Box:
    """Return the space of actions: starboard, forward, up and turn, each as a fraction of its largest value."""
    return spaces.Box(-1.0, 1.0, (4,), np.float32)


def observation_space(fleet: SonarFleet) -> spaces.Space[Observation]:
    """Return the observation space of one vehicle: the image ``(bins, beams, 1)`` uint8, or a dictionary with it."""
    sonar, task = fleet.sonar, fleet.task
    available: dict[str, spaces.Space[Array]] = {
        "image": spaces.Box(0, 255, (sonar.range_bins, sonar.beams, 1), np.uint8),
        "altitude": spaces.Box(0.0, task.altimeter_m, (1,), np.float32),
        "pose": spaces.Box(-MAX_POSE, MAX_POSE, (6,), np.float64),
    }
    selected = {name: available[name] for name in task.observe}
    space: spaces.Space[Observation] = available["image"] if len(selected) == 1 else spaces.Dict(selected)  # type: ignore[assignment]
    return space


def observed(fleet: SonarFleet, image: NDArray[np.uint8], altitude_m: Table) -> Observation:
    """Return the observations of all vehicles; the first axis is the vehicle."""
    available: dict[str, Array] = {
        "image": image[..., None].copy(),
        "altitude": altitude_m[:, None].astype(np.float32),
        "pose": fleet.poses.copy(),
    }
    selected = {name: available[name] for name in fleet.task.observe}
    return available["image"] if len(selected) == 1 else selected


def fan_of(sonar: Sonar) -> CartesianMap:
    """Return the map from images ``(bins, beams)`` to pictures of the fan."""
    return cartesian_map(sonar.range_m, sonar.bearing_rad, PICTURE_ROWS)


def fan_picture(fan: CartesianMap, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Draw an image ``(bins, beams)`` as a picture of the fan ``(rows, columns, 3)`` uint8, forward up."""
    grey = np.rint(fan.apply(image.astype(np.float32))).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


# ---------------- Environment of one vehicle


class SonarEnv(gymnasium.Env[Observation, Array]):
    """A vehicle with a sonar: the action is its velocity, the observation is the sonar's image.

    An episode ends when the vehicle comes too near to a surface, or leaves its bounds. :class:`SonarVectorEnv` steps many
    vehicles at once.

    Args:
        scene: a scene, its file or name, or a :class:`Simulator`.
        sonar: sonar or its name; default: that of the scene.
        moving: bodies that move, by the time since the start of the episode.
        render_mode: ``rgb_array`` for pictures of the fan; default: none.
        task: fields of :class:`mitsonar.bridges.gymnasium.SonarTask`: ``start``, ``bounds``, ``reward`` ...

    Raises:
        MitsonarError: a value is not allowed.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  # as Gymnasium has it

    def __init__(
        self,
        scene: SonarSource,
        sonar: Sonar | str | None = None,
        *,
        moving: Moving | None = None,
        render_mode: str | None = None,
        **task: Unpack[TaskFields],
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise MitsonarError(f"render_mode must be rgb_array or None: got {render_mode!r}")
        self.fleet = SonarFleet(
            scene, sonar, 1, moving, SonarTask.create({**task}, other_arguments=("moving", "render_mode"))
        )
        self.render_mode = render_mode
        self.action_space, self.observation_space = action_space(), observation_space(self.fleet)
        self._image: NDArray[np.uint8] | None = None

    def __repr__(self) -> str:
        return f"SonarEnv({self.fleet.sonar}; observes {', '.join(self.fleet.task.observe)}, {self.fleet.step_s:g} s a step)"

    def __str__(self) -> str:
        return repr(self)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; return the first observation, and the info with the ``pose`` (6,) [m, rad]."""
        super().reset(seed=seed, options=options)
        self.fleet.renew(np.array([True]), [self.np_random])
        image, altitude_m = self.fleet.look()
        self._image = image[0]
        return _single(observed(self.fleet, image, altitude_m)), {"pose": self.fleet.poses[0].copy()}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move by the action ``(4,)``, then ping.

        Returns:
            observation, reward, terminated, truncated, info, as Gymnasium defines them. The episode is terminated if the
            vehicle collided or left its bounds, and truncated after ``max_steps``. The info contains ``pose`` (6,) [m, rad],
            ``clearance_m``, ``collided`` and ``outside``.

        Raises:
            gymnasium.error.ResetNeeded: :meth:`reset` has not been called yet.
            MitsonarError: the action has a wrong shape, or is not finite.
        """
        if self._image is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        fleet = self.fleet
        transition = fleet.advance(_numbers_of(action)[None], np.array([False]), [self.np_random])
        self._image = transition.image[0]
        info = {
            "pose": transition.poses[0].copy(),
            "clearance_m": float(transition.clearance_m[0]),
            "collided": bool(transition.collided[0]),
            "outside": bool(transition.outside[0]),
        }
        terminated = info["collided"] or info["outside"]
        truncated = fleet.task.max_steps is not None and int(fleet.steps[0]) >= fleet.task.max_steps
        reward = float(fleet.rewards(transition)[0])
        return _single(observed(fleet, transition.image, transition.altitude_m)), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture of the last ping's fan ``(rows, columns, 3)``, forward up.

        Return None before the first ping, and if ``render_mode`` is None.
        """
        if self.render_mode is None or self._image is None:
            return None
        return fan_picture(fan_of(self.fleet.sonar), self._image)


def _single(observation: Observation) -> Observation:
    """Return the observation of the only vehicle."""
    return {name: values[0] for name, values in observation.items()} if isinstance(observation, dict) else observation[0]


# ---------------- Task of the vehicles


Table: TypeAlias = NDArray[np.float64]

OBSERVABLE = ("image", "altitude", "pose")
"""Names of the observations that an environment can return."""

VELOCITY_NAMES = ("starboard", "forward", "up", "turn")

MAX_START_ANGLES_RAD = np.array([np.pi, np.pi, 4 * np.pi])
"""Largest pitch, roll and heading of a start [rad]; the interval of headings may cross 360 deg."""


@dataclass(frozen=True)
class Transition:
    """One step of all vehicles, from which a reward function computes the rewards.

    Attributes:
        action: actions, clipped to -1..1 ``(n, 4)``: starboard, forward, up, turn to starboard.
        before: poses before the step ``(n, 6)`` [m, rad].
        poses: poses after the step ``(n, 6)`` [m, rad].
        image: images of the sonars ``(n, bins, beams)`` uint8.
        altitude_m: heights above the surface straight below ``(n,)`` [m].
        clearance_m: distances to the nearest surface ``(n,)`` [m].
        collided: whether each clearance is too small ``(n,)``.
        outside: whether each vehicle has left its bounds ``(n,)``.
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
"""Function that returns the reward of each vehicle ``(n,)``, or one number for all."""


class TaskFields(TypedDict, total=False):
    """Fields of a :class:`SonarTask`, as keyword arguments of an environment."""

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
    """The task of an environment: start, limits, observations and rewards.

    Vehicles are level, and move with the velocity of the action.

    Attributes:
        start: pose of the sonar at the start of an episode, or two poses between which each number is drawn [m, rad];
            default: the pose of the scene's sonar.
        bounds: lowest and highest x, y, z [m]; an episode ends outside them. Default: none.
        max_velocity: velocity of the action 1: starboard, forward, up [m/s], turn [rad/s].
        step_s: duration of a step [s]; default: 1 / ``frame_rate_hz``.
        clearance_m: distance to a surface below which a vehicle has collided [m].
        max_steps: number of steps after which an episode is truncated; default: none.
        observe: names of :data:`OBSERVABLE`; the image alone gives a box, several give a dictionary.
        reward: reward function of a :class:`Transition`; default: 0.
        gain: gain of the image; default: determined from eight poses of ``start``.
        noise: noise of the image; default: none.
        altimeter_m: largest altitude that is reported [m].

    Raises:
        MitsonarError: a value is not allowed.
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
        for name, minimum in (
            ("step_s", 1e-6),
            ("gain", 0.0),
            ("max_steps", 1),
            ("clearance_m", 0.0),
            ("altimeter_m", 1e-6),
        ):
            value = getattr(self, name)
            types = int | np.integer if name == "max_steps" else int | float | np.number
            if value is not None and not (isinstance(value, types) and minimum <= value < np.inf):
                kind = "whole" if name == "max_steps" else "finite"
                raise MitsonarError(f"{argument(name)} must be a {kind} number of at least {minimum:g}: got {value!r}")
        if self.noise is not None and not isinstance(self.noise, NoiseModel):
            raise MitsonarError(
                f"noise must be a NoiseModel, such as mitsonar.acoustics.noise.load_noise returns: got {self.noise!r}"
            )
        speeds = _numbers("max_velocity", self.max_velocity)
        if speeds.shape != (4,) or not (np.isfinite(speeds).all() and (speeds >= 0).all()):
            raise MitsonarError(
                f"max_velocity must be four numbers of 0 or more, {', '.join(VELOCITY_NAMES)}: got {self.max_velocity}"
            )
        if not isinstance(self.observe, tuple | list):
            raise MitsonarError(f"observe must be a tuple that contains image: got {self.observe!r}; give ('image',)")
        unknown = [name for name in self.observe if name not in OBSERVABLE]
        if unknown or "image" not in self.observe:
            wrong = str(unknown[0] if unknown else self.observe)
            raise MitsonarError(
                f"observe must be a tuple that contains image: got {wrong!r}; {suggest_names(wrong, OBSERVABLE)}"
            )
        self.refuse_outside(self.span)

    def refuse_outside(self, span: Table) -> None:
        """Check that the poses between which episodes begin ``(2, 6)`` lie within the bounds, with angles in radians.

        Raises:
            MitsonarError: a pose lies outside the bounds, or its angles are too large for radians.
        """
        low, high = self.box
        for pose in span[np.isfinite(span).all(axis=1)]:
            shown = ", ".join(f"{value:g}" for value in pose)
            if (pose[:3] < low).any() or (pose[:3] > high).any():
                raise MitsonarError(
                    f"start lies outside bounds, so every episode would end at its first step: got {shown}, and bounds "
                    f"{low.tolist()}, {high.tolist()}; move one of them"
                )
            if (np.abs(pose[3:]) > MAX_START_ANGLES_RAD).any():
                raise MitsonarError(
                    f"start must be x, y, z [m], pitch, roll, heading in rad: got {shown}; are these degrees?"
                )

    @classmethod
    def create(cls, given: dict[str, Any], other_arguments: Sequence[str] = ()) -> Self:
        """Create a task from its fields.

        Args:
            given: fields, keyed by name.
            other_arguments: other arguments of the environment, named in the error message for an unknown field.

        Raises:
            MitsonarError: a field is unknown, or a value is not allowed.
        """
        check_argument_names(given, (*(field.name for field in fields(cls)), *other_arguments), "an environment")
        return cls(**given)

    @property
    def span(self) -> Table:
        """Return the two poses between which episodes begin ``(2, 6)`` [m, rad]; nan without a start.

        Raises:
            MitsonarError: ``start`` is not one or two finite poses.
        """
        if self.start is None:
            return np.full((2, 6), np.nan)
        table = np.atleast_2d(_numbers("start", self.start))
        if table.shape not in ((1, 6), (2, 6)) or not np.isfinite(table).all():
            raise MitsonarError(
                f"start must be one pose or two, of x, y, z [m], pitch, roll, heading [rad]: got {table.shape}"
            )
        return np.asarray(np.broadcast_to(table, (2, 6)))

    @property
    def box(self) -> Table:
        """Return the lowest and the highest position ``(2, 3)`` [m]; infinite without bounds.

        Raises:
            MitsonarError: ``bounds`` are not two positions, the lower one first.
        """
        if self.bounds is None:
            return np.array([[-np.inf] * 3, [np.inf] * 3])
        box = _numbers("bounds", self.bounds)
        if box.shape != (2, 3) or not (box[0] < box[1]).all():
            raise MitsonarError(f"bounds must be the lowest and the highest x, y, z [m]: got {box.tolist()}")
        return box


def _numbers(name: str, value: object) -> Table:
    """Convert a value to an array of numbers.

    Raises:
        MitsonarError: it does not consist of numbers.
    """
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise MitsonarError(f"{name} must consist of numbers, in rows of equal length: got {value!r}") from None


# ---------------- Vector environment of many vehicles


class SonarVectorEnv(VectorEnv[Observation, Array, Array]):
    """Vehicles with one sonar each in one scene, stepped together in one launch. They do not see each other.

    Vehicle k with the seed s observes, to the bit, what :class:`SonarEnv` with the seed s + k observes, for any
    ``num_envs``. After an episode ends, the next step begins a new one and ignores that vehicle's action.

    Args:
        scene: a scene, its file or name, or a :class:`Simulator`.
        sonar: sonar or its name; default: that of the scene.
        num_envs: number of vehicles.
        moving: bodies that move, by the time since the start of each episode.
        render_mode: ``rgb_array`` for pictures of the fans; default: none.
        autoreset_mode: ``NextStep``, or ``Disabled`` for ``reset(options={"reset_mask": ...})``.
        task: fields of :class:`mitsonar.bridges.gymnasium.SonarTask`: ``start``, ``bounds``, ``reward`` ...

    Raises:
        MitsonarError: a value is not allowed.
    """

    metadata = {  # noqa: RUF012  # as Gymnasium has it
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        scene: SonarSource,
        sonar: Sonar | str | None = None,
        num_envs: int = 64,
        *,
        moving: Moving | None = None,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **task: Unpack[TaskFields],
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise MitsonarError(f"render_mode must be rgb_array or None: got {render_mode!r}")
        modes = {mode.value: mode for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED)}
        name = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        if name not in modes:
            raise MitsonarError(f"autoreset_mode must be {' or '.join(modes)}: got {name!r}")
        self.fleet = SonarFleet(
            scene,
            sonar,
            num_envs,
            moving,
            SonarTask.create({**task}, other_arguments=("num_envs", "moving", "render_mode", "autoreset_mode")),
        )
        self.num_envs, self.render_mode, self._mode = num_envs, render_mode, modes[name]
        self.metadata = {**self.metadata, "autoreset_mode": self._mode}
        self.single_action_space, self.single_observation_space = action_space(), observation_space(self.fleet)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._generators: list[np.random.Generator] = [seeding.np_random()[0] for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, dtype=bool)
        self._image: NDArray[np.uint8] | None = None

    def __repr__(self) -> str:
        sonar, task = self.fleet.sonar, self.fleet.task
        return (
            f"SonarVectorEnv({self.num_envs} of {sonar}; observes {', '.join(task.observe)}, {self.fleet.step_s:g} s a step)"
        )

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode for all vehicles, or for those in ``options["reset_mask"]`` ``(num_envs,)``.

        Args:
            seed: vehicle k has the seed ``seed + k``, or item k of a list; default: the generators continue.
            options: may contain ``reset_mask``.

        Raises:
            MitsonarError: the number of seeds or the shape of the mask is wrong, or the mask is not boolean.
        """
        seeds = [seed + vehicle for vehicle in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        seeds = [None] * self.num_envs if seeds is None else list(seeds)
        renewed = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if len(seeds) != self.num_envs or renewed.shape != (self.num_envs,) or renewed.dtype != bool:
            raise MitsonarError(
                f"reset needs a seed and a boolean of reset_mask for each of {self.num_envs} vehicles: got {len(seeds)} "
                f"seeds and a mask of shape {renewed.shape}"
            )
        for vehicle in np.flatnonzero(renewed):
            if seeds[vehicle] is not None:
                self._generators[vehicle] = seeding.np_random(seeds[vehicle])[0]
        self.fleet.renew(renewed, self._generators)
        self._ended[renewed] = False
        self._image, altitude_m = self.fleet.look()
        return observed(self.fleet, self._image, altitude_m), _masked({"pose": self.fleet.poses.copy()}, renewed)

    def step(self, actions: ArrayLike) -> tuple[Observation, Table, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Move all vehicles by their actions ``(num_envs, 4)``, then ping in one launch.

        Returns:
            observations, rewards, terminated, truncated, infos, as Gymnasium defines them, each ``(num_envs, ...)``. An
            episode is terminated if its vehicle collided or left its bounds, and truncated after ``max_steps``. The infos
            contain ``pose``, ``clearance_m``, ``collided`` and ``outside``, and a mask for each, named with a leading ``_``.

        Raises:
            gymnasium.error.ResetNeeded: :meth:`reset` has not been called yet.
            MitsonarError: an episode has ended, and automatic resets are disabled.
        """
        if self._image is None:
            raise ResetNeeded("call reset() before step()")
        fleet, renewed = self.fleet, self._ended.copy()
        if renewed.any() and self._mode is AutoresetMode.DISABLED:
            raise MitsonarError(f"{renewed.sum()} episodes have ended: reset them with options={{'reset_mask': ...}}")
        transition = fleet.advance(actions, renewed, self._generators)
        self._image = transition.image
        rewards = np.where(renewed, 0.0, fleet.rewards(transition))
        terminated = (transition.collided | transition.outside) & ~renewed
        truncated = (fleet.steps >= (np.inf if fleet.task.max_steps is None else fleet.task.max_steps)) & ~renewed
        self._ended = terminated | truncated
        return (
            observed(fleet, transition.image, transition.altitude_m),
            rewards,
            terminated,
            truncated,
            _infos(transition, ~renewed),
        )

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each vehicle's fan ``(rows, columns, 3)``, forward up.

        Return None before the first ping, and if ``render_mode`` is None.
        """
        if self.render_mode is None or self._image is None:
            return None
        fan = fan_of(self.fleet.sonar)
        return tuple(fan_picture(fan, image) for image in self._image)


def _infos(transition: Transition, valid: NDArray[np.bool_]) -> dict[str, Any]:
    """Return the infos of a step; ``valid`` masks the vehicles for which clearance and ends are valid."""
    pose_info = _masked({"pose": transition.poses.copy()}, np.ones(len(valid), dtype=bool))
    arrays = {
        "clearance_m": transition.clearance_m.copy(),
        "collided": transition.collided.copy(),
        "outside": transition.outside.copy(),
    }
    return pose_info | _masked(arrays, valid)


def _masked(values: dict[str, Array], valid: NDArray[np.bool_]) -> dict[str, Any]:
    """Add to each array the mask of the vehicles for which it is valid, in Gymnasium's convention."""
    return values | {f"_{name}": valid.copy() for name in values}


register(
    id="mitsonar/Sonar-v0",
    entry_point="mitsonar.bridges.gymnasium:SonarEnv",
    vector_entry_point="mitsonar.bridges.gymnasium:SonarVectorEnv",
)
