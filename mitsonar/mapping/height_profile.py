"""The height of the sonar over the ground along a path, by first echoes or an altimeter, and where the ground lies."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.estimator import Estimate
from mitsonar.mapping.frame_source import FrameSource
from mitsonar.mapping.open_source import Source
from mitsonar.motion.sensors import VehicleSensors
from mitsonar.motion.trajectory import Trajectory

__all__ = ["ALTIMETER", "FIRST_ECHOES", "HeightProfile", "height_profile"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

FIRST_ECHOES, ALTIMETER = "first echoes", "altimeter"
"""What measured a height."""


@dataclass(frozen=True)
class HeightProfile:
    """Heights along a path; nan where nothing measured them.

    Attributes:
        frames: their numbers in the source ``(frames,)``.
        distance_m: horizontal way along the path ``(frames,)``.
        places: x, y of the ground that was measured ``(frames, 2)`` [m]. First echoes come from ground ahead of the sonar.
        height_m: of the sonar over that ground ``(frames,)``.
        std_m: standard deviation of the height ``(frames,)``; nan for an altimeter, which tells none.
        by: :data:`FIRST_ECHOES` or :data:`ALTIMETER` ``(frames,)``; empty where nothing measured it.
        ground_z_m: z of that ground in the coordinates of the path ``(frames,)``; nan where z is not measured.
        ground_depth_m: depth of that ground below the surface ``(frames,)``; nan without a depth sensor.
    """

    frames: Index
    distance_m: Array
    places: Array
    height_m: Array
    std_m: Array
    by: NDArray[np.str_]
    ground_z_m: Array
    ground_depth_m: Array

    def csv(self) -> str:
        """Return a table with a line a frame; cells are empty where nothing is known."""
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        names = ["distance_m", "x_m", "y_m", "height_m", "height_std_m", "ground_z_m", "ground_depth_m"]
        table.writerow(["frame", *names, "measured_by"])
        heights = self.height_m, self.std_m, self.ground_z_m, self.ground_depth_m
        rows = np.column_stack([self.distance_m, self.places, *heights])
        for frame, row, by in zip(self.frames, rows, self.by, strict=True):
            table.writerow([int(frame), *("" if np.isnan(value) else f"{value:.6f}" for value in row), str(by)])
        return text.getvalue()


def height_profile(
    source: Source, frames: Index, estimates: Sequence[Estimate], sensors: VehicleSensors | None, path: Trajectory
) -> HeightProfile:
    """Collect the heights over the ground along a path.

    First echoes count, where an estimator measured the height by them; else the heights that the frames tell. A height that
    the user gave is no measurement.

    Args:
        source: of the records.
        frames: numbers of those used ``(n,)``.
        estimates: of each pair of them; ``about`` may hold ``height_m`` and ``height_std_m``, of first echoes.
        sensors: of the vehicle.
        path: poses at the frames.
    """
    poses = path.poses
    height, std = (_at_frames(np.array([_told(one, name) for one in estimates])) for name in ("height_m", "height_std_m"))
    echoes = np.isfinite(height)
    altimeter = _altimeter(source, frames)
    height = np.where(echoes, height, altimeter)
    ahead = np.where(echoes, _ahead(source, frames, height), 0.0)
    places = poses[:, :2] + ahead[:, None] * np.column_stack([np.sin(poses[:, 5]), np.cos(poses[:, 5])])
    places[np.isnan(height)] = np.nan
    nothing = np.full(len(frames), np.nan)
    depth = None if sensors is None else sensors.depths(path.time_s)
    known = source.poses[frames, 2] if source.poses is not None else nothing if depth is None else poses[:, 2]
    return HeightProfile(
        frames=frames,
        distance_m=np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))]),
        places=places,
        height_m=height,
        std_m=std,
        by=np.where(echoes, FIRST_ECHOES, np.where(np.isfinite(altimeter), ALTIMETER, "")),
        ground_z_m=known - height,
        ground_depth_m=nothing if depth is None else depth + height,
    )


def _told(estimate: Estimate, name: str) -> float:
    """Return a height that first echoes tell; nan where they tell none."""
    return float(estimate.about[name]) if "height_std_m" in estimate.about else np.nan


def _at_frames(of_pairs: Array) -> Array:
    """Return the mean of what the pairs before and after each frame tell ``(frames,)``."""
    both = np.stack([np.append(of_pairs, np.nan), np.append(np.nan, of_pairs)])
    known = np.isfinite(both)
    count = known.sum(axis=0)
    return np.where(count > 0, np.where(known, both, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def _altimeter(source: Source, frames: Index) -> Array:
    """Return the heights that the frames tell ``(frames,)``; nan where they tell none, or those are given or assumed."""
    if source.height_m is None or (isinstance(source, FrameSource) and source.assumed_height):
        return np.full(len(frames), np.nan)
    heights = np.asarray(source.height_m[frames], dtype=float)
    given = np.nan if source.told_height_m is None else source.told_height_m
    return np.where(heights == given, np.nan, heights)


def _ahead(source: Source, frames: Index, height_m: Array) -> Array:
    """Return how far ahead of the sonar its steepest rays meet the ground, in the mean of the beams ``(frames,)`` [m]."""
    attitudes = source.attitudes(frames) if isinstance(source, FrameSource) else None
    if not isinstance(source, FrameSource) or attitudes is None:
        return np.zeros(len(frames))
    steepest = attitudes[:, 3] + np.radians(source.like.sonar.elevation_fov_deg) / 2
    return np.asarray(height_m / np.tan(steepest) * float(np.cos(source.like.bearing_rad).mean()))
