"""Poses at the times of frames, from a path that was measured or estimated, and the stretches of frames that have them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Slerp

from mitsonar.errors import MitsonarError
from mitsonar.motion.pose import poses_from, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory

__all__ = ["poses_at", "stretches"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SAME_S = 0.01
"""Distance of a frame from a pose that is taken for it [s]: times in files are rounded."""

LONGEST_GAP_S = 1.0
"""Longest step of a path within which poses are interpolated [s]."""

PAUSE = 5.0
"""Step from frame to frame, as part of the median step, that ends a stretch."""

PLANAR = 1e-6
"""Smallest change of height, pitch or roll along a path [m, rad]: files round them."""


def poses_at(
    path: Trajectory, time_s: Array, name: str, attitude_rad: Array | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Interpolate a path at the times of frames.

    A frame has a pose where one of the path is within 10 ms of it, or where it lies between two that are at most a second
    apart. A path of odometry has one height, pitch and roll throughout. Pitch and roll are then those of the frames, if
    known.

    Args:
        path: its times rise.
        time_s: of the frames ``(frames,)`` [s].
        name: of the frames, for errors.
        attitude_rad: pitch, roll, heading of the frames by their own sensors ``(frames, 3)``; nan where unknown.

    Returns:
        Poses ``(frames, 6)`` [m, rad], and which frames have one ``(frames,)``; the others are nan.

    Raises:
        MitsonarError: the times of the path do not rise, or no frame has a pose.
    """
    times = path.time_s
    if not (np.diff(times) > 0).all():
        raise MitsonarError("the times of the path must rise: sort its poses")
    after = np.clip(np.searchsorted(times, time_s), 1, max(1, len(times) - 1)).astype(np.intp)
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    near = np.minimum(np.abs(times[before] - time_s), np.abs(times[after] - time_s)) <= SAME_S + 1e-9
    between = (times[before] <= time_s) & (time_s <= times[after]) & (times[after] - times[before] <= LONGEST_GAP_S)
    known = near | between
    if not known.any():
        raise MitsonarError(
            f"no pose for the frames of {name}: the path lasts from {times[0]:.10g} to {times[-1]:.10g} s, the frames from "
            f"{time_s[0]:.10g} to {time_s[-1]:.10g} s; give a path with the times of the frames"
        )
    poses = np.full((len(time_s), 6), np.nan)
    poses[known] = _interpolated(path, np.clip(time_s[known], times[0], times[-1]))
    if attitude_rad is not None and (np.ptp(path.poses[:, 2:5], axis=0) < PLANAR).all():
        told = known[:, None] & np.isfinite(attitude_rad[:, :2])
        poses[:, 3:5] = np.where(told, attitude_rad[:, :2], poses[:, 3:5])
    return poses, known


def stretches(known: NDArray[np.bool_], time_s: Array) -> list[slice]:
    """Return the stretches of two or more consecutive frames that have poses and follow each other without a pause.

    Args:
        known: which frames have a pose ``(frames,)``.
        time_s: of the frames ``(frames,)`` [s].
    """
    steps = np.diff(time_s)
    usual = float(np.median(steps)) if len(steps) else 0.0
    ends = np.flatnonzero(~(known[1:] & known[:-1]) | (steps > PAUSE * usual)) + 1
    borders = [0, *ends.tolist(), len(known)]
    return [slice(one, other) for one, other in pairwise(borders) if other - one > 1]


def _interpolated(path: Trajectory, time_s: Array) -> Array:
    """Return the poses of a path at times within it ``(n, 6)``: positions in straight lines, attitudes by the arc.

    At a time of the path the pose is the path's own to the bit.
    """
    if len(path) == 1:
        return np.repeat(path.poses, len(time_s), axis=0)
    position = np.column_stack([np.interp(time_s, path.time_s, axis) for axis in path.poses[:, :3].T])
    poses = poses_from(position, Slerp(path.time_s, vehicle_rotation(path.poses))(time_s))
    place = np.minimum(np.searchsorted(path.time_s, time_s), len(path) - 1)
    same = path.time_s[place] == time_s
    poses[same] = path.poses[place[same]]
    return np.asarray(poses, dtype=np.float64)
