"""Side-scans of a known ground, drawn ray by ray: a second route to what the corrections compute in closed form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.instruments.sounder import Sounder, load_sounder
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.utm import UtmOrigin
from mitsonar.records.soundings import Echogram

Array = NDArray[np.float64]
Pattern = Callable[[Array, Array], Array]

SOUNDER = load_sounder("sidescan").replace(range_min=0.0, range_max=25.0, range_bins=500, name="drawn")

RAYS = 20_001


def line(
    pings: int = 60, height: float = 6.0, heading: float = 0.0, pitch: float = 0.0, roll: float = 0.0, step: float = 0.25
) -> Array:
    """Poses along a straight line from (40, -20), above the ground at z = 0."""
    poses = np.zeros((pings, 6))
    poses[:, :2] = [40, -20] + step * np.arange(pings)[:, None] * [np.sin(heading), np.cos(heading)]
    poses[:, 2:] = [height, pitch, roll, heading]
    return poses


def blocks(x: Array, y: Array) -> Array:
    """Squares of 2 m, dark and bright, with soft edges that survive interpolation."""
    return np.asarray(0.5 + 0.4 * np.tanh(4 * np.sin(np.pi * x / 2)) * np.tanh(4 * np.sin(np.pi * y / 2)))


def drawn(
    poses: Array,
    pattern: Pattern = blocks,
    *,
    sounder: Sounder = SOUNDER,
    water: float = 1e-5,
    rng: np.random.Generator | None = None,
    origin: UtmOrigin | None = None,
) -> Echogram:
    """Levels of a pattern on the ground z = 0, seen by rays in the plane across the vehicle; speckle by a generator."""
    range_m = sounder.fan.range_m
    levels = np.full((len(poses), 2, len(range_m)), water)
    depression = np.linspace(-np.pi / 4, 3 * np.pi / 4, RAYS)  # beyond straight down, for a vehicle that rolls
    for row, pose in enumerate(poses):
        starboard, up = vehicle_rotation(pose[None]).as_matrix()[0].T[[0, 2]]
        for column, side in enumerate((-1, 1)):
            ray = np.cos(depression)[:, None] * side * starboard - np.sin(depression)[:, None] * up
            outward = ray @ (side * np.array([np.cos(pose[5]), -np.sin(pose[5]), 0.0])) > 0
            hits = (ray[:, 2] < -1e-3) & outward
            distance = -pose[2] / ray[hits, 2]
            point = pose[:2] + distance[:, None] * ray[hits, :2]
            order = np.argsort(distance)
            seen = range_m >= distance.min()
            x, y = (np.interp(range_m[seen], distance[order], point[order, axis]) for axis in range(2))
            levels[row, column, seen] = pattern(x, y)
    if rng is not None:
        levels = levels * rng.exponential(size=levels.shape)
    time_s: Array = 1.6e9 + 0.1 * np.arange(len(poses), dtype=np.float64)
    channels = [("port", "starboard").index(name) for name in sounder.channels]
    return Echogram(time_s, poses, sounder, levels[:, channels].astype(np.float32), poses[:, 2].copy(), origin)


def amplitude_to_level(value: Any, span_db: float = 60.0) -> Any:
    """The level of a mosaic, 0..1, of an intensity relative to full scale."""
    return 1 + 10 * np.log10(value) / span_db
