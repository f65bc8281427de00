"""Vehicles with a sonar each, in one scene: they move, and ping together in one launch."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import refuse_noise
from mitsonar.environments.sonar_task import SonarTask, Table, Transition
from mitsonar.errors import MitsonarError, MitsonarWarning
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

__all__ = ["SonarFleet", "SonarSource"]

SonarSource: TypeAlias = "Simulator | mi.Scene | str | Path"
"""What pings: a simulator, a scene, or its file or name."""

FIRST_PINGS = 2**31
"""Numbers of first pings that episodes draw from."""


class SonarFleet:
    """Vehicles in one scene. What one of them sees does not depend on the others.

    An episode draws from its vehicle's own generator: six numbers for the start, and the number of its first ping, of which
    jitter and noise are functions.

    Args:
        source: of the pings.
        sonar: the instrument, or its name; default: the scene's.
        count: of vehicles.
        moving: bodies that move in the scene, by the time of the episode.
        task: what the vehicles may do.

    Attributes:
        poses: of the vehicles' sonars ``(count, 6)`` [m, rad].
        steps: of each since the begin of its episode ``(count,)``.

    Raises:
        MitsonarError: no vehicle, a source that is no scene, no start, or one where every episode ends.

    Warns:
        MitsonarWarning: the start seems to lie below the seabed.
    """

    def __init__(
        self, source: SonarSource, sonar: Sonar | str | None, count: int, moving: Moving | None, task: SonarTask
    ) -> None:
        if not (isinstance(count, int | np.integer) and 1 <= count <= 100_000):
            raise MitsonarError(f"num_envs must be a whole number in 1..100000: got {count!r}")
        if not isinstance(source, Simulator | str | Path) and not hasattr(source, "shapes"):
            raise MitsonarError(f"scene is a scene, its file or name, or a Simulator: got {type(source).__name__}")
        if isinstance(source, Simulator):
            if sonar is not None or moving is not None:
                raise MitsonarError("a simulator has its sonar and its moving bodies: leave sonar and moving out")
            self.simulator = source
        else:
            scene = load_scene(source) if isinstance(source, str | Path) else source
            instrument = load_sonar(sonar) if isinstance(sonar, str) else sonar
            self.simulator = Simulator(scene, instrument, moving=moving)
        self.sonar, self.task = self.simulator.sonar, task
        refuse_noise(task.noise, self.sonar)
        self.step_s = 1 / self.sonar.frame_rate_hz if task.step_s is None else task.step_s
        from mitsonar.simulation.tracing import Clearance  # now that the simulator has set a variant

        self._clearance = Clearance(self.simulator.tracer)
        self._span = self._start_of(task)
        self._check_start()
        self.gain = self._gain() if task.gain is None else task.gain
        self.poses = np.repeat(self._span[:1], count, axis=0)
        self.steps = np.zeros(count, dtype=np.int64)
        self._first = np.zeros(count, dtype=np.int64)

    @property
    def clearance(self) -> Clearance:
        """Return what measures the clearance in the scene as it is now."""
        if self._clearance.tracer is not self.simulator.tracer:  # the simulator has followed a change of the scene
            self._clearance = type(self._clearance)(self.simulator.tracer)
        return self._clearance

    def _start_of(self, task: SonarTask) -> Table:
        """Return the poses between which episodes begin."""
        if task.start is not None:
            return task.span
        found = sonar_in(self.simulator.tracer.scene)
        if found is None:
            raise MitsonarError("the scene has no sonar whose pose episodes could begin at: give start, a pose or two")
        span = np.repeat(np.asarray(found[1], dtype=float)[None], 2, axis=0)
        task.refuse_outside(span)
        return span

    def _check_start(self) -> None:
        """Refuse a start at whose ends the vehicle collides; warn where it seems to lie below the seabed."""
        places = self._span[:, :3]
        clearance_m = self.clearance.of(places, places, np.zeros(2))
        if (clearance_m < self.task.clearance_m).all():
            raise MitsonarError(
                f"start is {clearance_m.max():.3g} m from a surface, nearer than clearance_m {self.task.clearance_m:g}: "
                "every episode would end at its first step; move it, or lower clearance_m"
            )
        below, above = (self.clearance.straight(places, way) for way in ((0, 0, -1), (0, 0, 1)))
        if (np.isinf(below) & np.isfinite(above)).all():
            warnings.warn(
                f"below start there is nothing, and a surface {above.min():.3g} m above it: a vehicle under the seabed sees "
                "it from below; nothing is wrong where that is a hull or ice",
                MitsonarWarning,
                stacklevel=4,
            )

    def _gain(self) -> float:
        """Return the constant gain by eight poses between those of the start, always the same."""
        part = np.random.Generator(np.random.PCG64(0)).random((8, 6))
        return constant_gain(self.simulator.pings(self._span[0] + part * np.ptp(self._span, axis=0)))[0]

    def renew(self, which: NDArray[np.bool_], generators: Sequence[np.random.Generator]) -> None:
        """Begin new episodes of the vehicles ``which`` ``(count,)``."""
        for number in map(int, np.flatnonzero(which)):
            part = generators[number].random(6)
            self.poses[number] = self._span[0] + part * (self._span[1] - self._span[0])
            self._first[number] = generators[number].integers(FIRST_PINGS)
            self.steps[number] = 0

    def look(self) -> tuple[NDArray[np.uint8], Table]:
        """Ping from all vehicles in one launch; return images ``(count, bins, beams)`` and altitudes ``(count,)`` [m].

        In the model ``coherent`` they ping one after the other.
        """
        numbers = [int(number) for number in self._first + self.steps]
        batches = list(self.simulator.pings(self.poses, first=numbers, time_s=self.time_s))
        image = to_image(np.concatenate([pings.levels for pings in batches]), self.gain, self.sonar)
        if self.task.noise is not None:
            image = self.task.noise.apply(image, seed=self.sonar.seed, frames=np.array(numbers))
        height_m = np.concatenate([pings.height_m for pings in batches])
        altitude_m = np.minimum(np.nan_to_num(height_m, nan=np.inf), self.task.altimeter_m)
        return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8), altitude_m

    @property
    def time_s(self) -> Table:
        """Return the time of each vehicle since the begin of its episode ``(count,)`` [s]."""
        return np.asarray(self.steps * self.step_s, dtype=float)

    def advance(
        self, action: ArrayLike, renewed: NDArray[np.bool_], generators: Sequence[np.random.Generator]
    ) -> Transition:
        """Move all vehicles by their actions, but those ``renewed`` to the begin of a new episode; then ping.

        Args:
            action: ``(count, 4)``, clipped to -1..1.
            renewed: vehicles whose episode has ended ``(count,)``.
            generators: of the vehicles.

        Raises:
            MitsonarError: an action of another shape, or that is not finite.
        """
        given = np.asarray(action, dtype=float)
        if given.shape != (len(self.poses), 4) or not np.isfinite(given).all():
            raise MitsonarError(f"an action is four finite numbers for each of {len(self.poses)}: got {_wrong(given)}")
        taken, before = np.clip(given, -1, 1), self.poses.copy()
        self.poses = steered(before, taken * np.asarray(self.task.max_velocity), self.step_s)
        self.steps += 1
        self.renew(renewed, generators)
        before[renewed] = self.poses[renewed]
        image, altitude_m = self.look()
        clearance_m = self.clearance.of(before[:, :3], self.poses[:, :3], self.time_s)
        low, high = self.task.box
        outside = ((self.poses[:, :3] < low) | (self.poses[:, :3] > high)).any(axis=1)
        collided = clearance_m < self.task.clearance_m
        return Transition(taken, before, self.poses.copy(), image, altitude_m, clearance_m, collided, outside)

    def rewards(self, step: Transition) -> Table:
        """Return the rewards of a step ``(count,)``.

        Raises:
            MitsonarError: the reward function gives other than one finite number for each vehicle, or for all.
        """
        if self.task.reward is None:
            return np.zeros(len(self.poses))
        found = np.asarray(self.task.reward(step), dtype=float)
        if found.shape not in ((len(self.poses),), ()) or not np.isfinite(found).all():
            raise MitsonarError(f"reward must give {len(self.poses)} finite numbers, or one for all: got {_wrong(found)}")
        return np.array(np.broadcast_to(found, len(self.poses)))


def _wrong(given: Table) -> str:
    """Return what is wrong with numbers: one that is not finite, with its place, else their shape."""
    bad = np.argwhere(~np.isfinite(given))
    place = bad[0].tolist() if len(bad) else []
    return f"{given[tuple(place)]} at {place}" if len(bad) else f"the shape {given.shape}"
