"""Spaces of actions and observations, and observations in their layout."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mitsonar.environments.sonar_fleet import SonarFleet
from mitsonar.environments.sonar_task import Table
from mitsonar.geometry.fan import CartesianMap, cartesian_map
from mitsonar.instruments.sonar import Sonar

__all__ = ["Array", "Observation", "action_space", "fan_of", "fan_picture", "observation_space", "observed"]

Array: TypeAlias = NDArray[np.generic]
Observation: TypeAlias = "Array | dict[str, Array]"
"""The image, or several arrays by name."""

FARTHEST = 1e9
"""No number of a pose is larger [m, rad]."""

PICTURE_ROWS = 400


def action_space() -> spaces.Box:
    """Return the space of actions: starboard, forward, up, turn, each as a part of its largest value."""
    return spaces.Box(-1.0, 1.0, (4,), np.float32)


def observation_space(fleet: SonarFleet) -> spaces.Space[Observation]:
    """Return the space of one vehicle's observation: ``(bins, beams, 1)`` uint8, or a dictionary with it."""
    sonar, task = fleet.sonar, fleet.task
    known: dict[str, spaces.Space[Array]] = {
        "image": spaces.Box(0, 255, (sonar.range_bins, sonar.beams, 1), np.uint8),
        "altitude": spaces.Box(0.0, task.altimeter_m, (1,), np.float32),
        "pose": spaces.Box(-FARTHEST, FARTHEST, (6,), np.float64),
    }
    chosen = {name: known[name] for name in task.observe}
    made: spaces.Space[Observation] = known["image"] if len(chosen) == 1 else spaces.Dict(chosen)  # type: ignore[assignment]
    return made


def observed(fleet: SonarFleet, image: NDArray[np.uint8], altitude_m: Table) -> Observation:
    """Return the observations of all vehicles, with the vehicle as the first axis."""
    known: dict[str, Array] = {
        "image": image[..., None].copy(),
        "altitude": altitude_m[:, None].astype(np.float32),
        "pose": fleet.poses.copy(),
    }
    chosen = {name: known[name] for name in fleet.task.observe}
    return known["image"] if len(chosen) == 1 else chosen


def fan_of(sonar: Sonar) -> CartesianMap:
    """Return the map from images to pictures of the fan."""
    return cartesian_map(sonar.range_m, sonar.bearing_rad, PICTURE_ROWS)


def fan_picture(fan: CartesianMap, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture of the fan ``(rows, columns, 3)`` uint8, forward up, of one image ``(bins, beams)``."""
    grey = np.rint(fan.apply(image.astype(np.float32))).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
