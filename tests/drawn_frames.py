"""Frames of a flat floor drawn by geometry alone, along a path that turns: what odometry and maps are tried on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import ndimage

from mitsonar.geometry.ground import GroundGeometry, moved
from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping.series import path_of
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import FrameStore, SonarFrames

SONAR = Sonar(bearing="azimuth", beams=96, range_bins=128, range_min=3.6, range_max=5.4)
START = Pose.from_degrees([1.0, -2.0, 2.5, 35, 0, 40])


def sway(frames: int) -> Trajectory:
    """A path that turns and changes its speed, at uneven times."""
    step = np.random.default_rng(1).uniform(0.08, 0.12, frames - 1)
    time = np.concatenate([[5.0], 5.0 + np.cumsum(step)])
    t = (time[1:] + time[:-1]) / 2
    velocity = np.column_stack([0.1 * np.sin(t), 0.12 + 0.04 * np.cos(0.7 * t), np.radians(3) * np.sin(0.5 * t)])
    return path_of(velocity * step[:, None], START, time)


def over_ground(path: Trajectory, sonar: Sonar = SONAR, noise: float = 0.01, tile_m: float = 14.0) -> SonarFrames:
    """Frames of a flat floor of smooth random reflectivity that repeats after 14 m, or a tile, drawn by geometry alone."""
    cell, rng = 0.02, np.random.default_rng(7)
    floor = ndimage.gaussian_filter(rng.uniform(0, 1, (700, 700)), 3)
    floor = np.clip(0.4 + (floor - floor.mean()) / floor.std() * 0.15, 0.02, 1)
    tile = round(tile_m / cell)
    floor = floor[:tile, :tile]
    images = []
    for pose in path.poses:
        geometry = GroundGeometry(sonar.range_m, sonar.bearing_rad, sonar.bearing, pose[2], pose[3], pose[4])
        place = moved(geometry.points, (0.0, 0.0, -pose[5])) + pose[:2]
        level = ndimage.map_coordinates(floor, np.moveaxis(place, -1, 0)[::-1] / cell + 350, order=1, mode="grid-wrap")
        images.append(np.clip(level + noise * rng.normal(size=level.shape), 0, 1))
    heights = path.poses[:, 2].copy()
    image = np.array(images, np.float32)
    return SonarFrames(image, sonar.range_m, sonar.bearing_rad, path.time_s, sonar, path.poses, heights)


def as_zarr(frames: SonarFrames, path: Path, done: int | None = None) -> None:
    store = FrameStore.create(path, len(frames), frames)
    store.write(0, frames.select(slice(done)))
