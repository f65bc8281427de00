"""Many vehicles as one vector environment of Gymnasium: a step of all is one launch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from mitsonar.environments.sonar_fleet import SonarFleet, SonarSource
from mitsonar.environments.sonar_spaces import (
    Array,
    Observation,
    action_space,
    fan_of,
    fan_picture,
    observation_space,
    observed,
)
from mitsonar.environments.sonar_task import SonarTask, Table, TaskFields, Transition
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.bodies import Moving

__all__ = ["SonarVectorEnv"]


class SonarVectorEnv(VectorEnv[Observation, Array, Array]):
    """Vehicles with a sonar each in one scene, stepped together. They do not see each other.

    Vehicle k with the seed s sees, to the bit, what :class:`SonarEnv` with the seed s + k sees, whatever ``num_envs`` is.
    An episode that has ended begins anew with the next step, whose action for it counts for nothing.

    Args:
        scene: a scene, its file or name, or a :class:`Simulator`.
        sonar: the instrument, or its name; default: the scene's.
        num_envs: vehicles.
        moving: bodies that move, by the time since the begin of each episode.
        render_mode: ``rgb_array`` for pictures of the fans; default: none.
        autoreset_mode: ``NextStep``, or ``Disabled`` for ``reset(options={"reset_mask": ...})``.
        task: fields of :class:`mitsonar.environments.sonar_task.SonarTask`: ``start``, ``bounds``, ``reward`` ...

    Raises:
        MitsonarError: a value that is not allowed.
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
            raise MitsonarError(f"render_mode is rgb_array or None: got {render_mode!r}")
        modes = {mode.value: mode for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED)}
        name = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        if name not in modes:
            raise MitsonarError(f"autoreset_mode is {' or '.join(modes)}: got {name!r}")
        self.fleet = SonarFleet(
            scene,
            sonar,
            num_envs,
            moving,
            SonarTask.create({**task}, own=("num_envs", "moving", "render_mode", "autoreset_mode")),
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
        """Begin an episode of all vehicles, or of those of ``options["reset_mask"]`` ``(num_envs,)``.

        Args:
            seed: vehicle k has the seed ``seed + k``, or that of a list; default: generators go on.
            options: may hold ``reset_mask``.

        Raises:
            MitsonarError: another number of seeds, or no mask of booleans.
        """
        seeds = [seed + place for place in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        seeds = [None] * self.num_envs if seeds is None else list(seeds)
        which = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if len(seeds) != self.num_envs or which.shape != (self.num_envs,) or which.dtype != bool:
            raise MitsonarError(
                f"a seed and a boolean of reset_mask for each of {self.num_envs}: got {len(seeds)}, {which.shape}"
            )
        for place in np.flatnonzero(which):
            if seeds[place] is not None:
                self._generators[place] = seeding.np_random(seeds[place])[0]
        self.fleet.renew(which, self._generators)
        self._ended[which] = False
        self._image, altitude_m = self.fleet.look()
        return observed(self.fleet, self._image, altitude_m), _masked({"pose": self.fleet.poses.copy()}, which)

    def step(self, actions: ArrayLike) -> tuple[Observation, Table, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Move all vehicles by their actions ``(num_envs, 4)``, then ping in one launch.

        Returns:
            observations, rewards, terminated, truncated, infos, as Gymnasium has them, each ``(num_envs, ...)``: terminated
            where a vehicle collided or left its bounds, truncated after ``max_steps``. The infos hold ``pose``,
            ``clearance_m``, ``collided`` and ``outside``, and a mask of each with ``_`` before its name.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            MitsonarError: an episode has ended and resets are yours to do.
        """
        if self._image is None:
            raise ResetNeeded("call reset() before step()")
        fleet, renewed = self.fleet, self._ended.copy()
        if renewed.any() and self._mode is AutoresetMode.DISABLED:
            raise MitsonarError(f"{renewed.sum()} episodes have ended: reset them with options={{'reset_mask': ...}}")
        moved = fleet.advance(actions, renewed, self._generators)
        self._image = moved.image
        rewards = np.where(renewed, 0.0, fleet.rewards(moved))
        terminated = (moved.collided | moved.outside) & ~renewed
        truncated = (fleet.steps >= (np.inf if fleet.task.max_steps is None else fleet.task.max_steps)) & ~renewed
        self._ended = terminated | truncated
        return observed(fleet, moved.image, moved.altitude_m), rewards, terminated, truncated, _infos(moved, ~renewed)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each fan ``(rows, columns, 3)``, forward up; None before a ping, or without a mode."""
        if self.render_mode is None or self._image is None:
            return None
        fan = fan_of(self.fleet.sonar)
        return tuple(fan_picture(fan, image) for image in self._image)


def _infos(moved: Transition, which: NDArray[np.bool_]) -> dict[str, Any]:
    """Return what is known of the vehicles beside their observations."""
    whole = _masked({"pose": moved.poses.copy()}, np.ones(len(which), dtype=bool))
    table = {"clearance_m": moved.clearance_m.copy(), "collided": moved.collided.copy(), "outside": moved.outside.copy()}
    return whole | _masked(table, which)


def _masked(values: dict[str, Array], which: NDArray[np.bool_]) -> dict[str, Any]:
    """Return arrays by name, each with the mask of the vehicles that it holds for, as Gymnasium has it."""
    return values | {f"_{name}": which.copy() for name in values}
