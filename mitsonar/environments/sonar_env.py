"""One vehicle as an environment of Gymnasium."""

from __future__ import annotations

from typing import Any, Unpack

import gymnasium
import numpy as np
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
from mitsonar.environments.sonar_task import SonarTask, TaskFields
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.bodies import Moving

__all__ = ["SonarEnv"]


class SonarEnv(gymnasium.Env[Observation, Array]):
    """A vehicle with a sonar: the action is its velocity, the observation the sonar's image.

    It collides and ends near a surface, and ends outside its bounds. :class:`SonarVectorEnv` steps many at once.

    Args:
        scene: a scene, its file or name, or a :class:`Simulator`.
        sonar: the instrument, or its name; default: the scene's.
        moving: bodies that move, by the time since the begin of the episode.
        render_mode: ``rgb_array`` for pictures of the fan; default: none.
        task: fields of :class:`mitsonar.environments.sonar_task.SonarTask`: ``start``, ``bounds``, ``reward`` ...

    Raises:
        MitsonarError: a value that is not allowed.
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
            raise MitsonarError(f"render_mode is rgb_array or None: got {render_mode!r}")
        self.fleet = SonarFleet(scene, sonar, 1, moving, SonarTask.create({**task}, own=("moving", "render_mode")))
        self.render_mode = render_mode
        self.action_space, self.observation_space = action_space(), observation_space(self.fleet)
        self._image: NDArray[np.uint8] | None = None

    def __repr__(self) -> str:
        return f"SonarEnv({self.fleet.sonar}; observes {', '.join(self.fleet.task.observe)}, {self.fleet.step_s:g} s a step)"

    def __str__(self) -> str:
        return repr(self)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; return the first observation, and the info: the ``pose`` (6,) [m, rad]."""
        super().reset(seed=seed, options=options)
        self.fleet.renew(np.array([True]), [self.np_random])
        image, altitude_m = self.fleet.look()
        self._image = image[0]
        return _first(observed(self.fleet, image, altitude_m)), {"pose": self.fleet.poses[0].copy()}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move by the action ``(4,)``, then ping.

        Returns:
            observation, reward, terminated, truncated, info, as Gymnasium has them: terminated where the vehicle collided or
            left its bounds, truncated after ``max_steps``. The info holds ``pose`` (6,) [m, rad], ``clearance_m``,
            ``collided`` and ``outside``.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            MitsonarError: an action of another shape, or that is not finite.
        """
        if self._image is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        fleet = self.fleet
        moved = fleet.advance(np.asarray(action, dtype=float)[None], np.array([False]), [self.np_random])
        self._image = moved.image[0]
        info = {
            "pose": moved.poses[0].copy(),
            "clearance_m": float(moved.clearance_m[0]),
            "collided": bool(moved.collided[0]),
            "outside": bool(moved.outside[0]),
        }
        terminated = info["collided"] or info["outside"]
        truncated = fleet.task.max_steps is not None and int(fleet.steps[0]) >= fleet.task.max_steps
        reward = float(fleet.rewards(moved)[0])
        return _first(observed(fleet, moved.image, moved.altitude_m)), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture of the last ping's fan ``(rows, columns, 3)``, forward up; None before it, or without a mode."""
        if self.render_mode is None or self._image is None:
            return None
        return fan_picture(fan_of(self.fleet.sonar), self._image)


def _first(many: Observation) -> Observation:
    """Return the observation of the only vehicle."""
    return {name: values[0] for name, values in many.items()} if isinstance(many, dict) else many[0]
