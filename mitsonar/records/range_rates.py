"""How fast what each pixel shows comes nearer or goes away: the labels' truth of motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.views import directions
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["body_of_pixels", "range_rates"]

Array = NDArray[np.float64]


def range_rates(frames: SonarFrames, velocity: Array | None = None) -> NDArray[np.float32]:
    """Compute the rate of the range of the strongest echo of each pixel, like ``image`` [m/s]; nan where there is none.

    It is (v_echo - v_sonar) . d: positive where the echo goes away. A still sonar and scene give 0. What deforms moves as
    the axes of its body do.

    Args:
        frames: with poses, and rendered with labels.
        velocity: of the sonar in the world's axes ``(frames, 3)`` [m/s]; default: from its poses and times.

    Raises:
        MitsonarError: no labels, no poses, or one frame without a velocity.
    """
    if frames.elevation_rad is None or frames.poses is None:
        raise MitsonarError("range rates need labels and poses: render with --labels")
    time = frames.time_s if frames.time_s.ndim == 1 else frames.time_s.mean(axis=1)
    if velocity is None and len(frames) < 2:
        raise MitsonarError("one frame tells no velocity of the sonar: give velocity (1, 3) in m/s")
    own = np.gradient(frames.poses[:, :3], time, axis=0) if velocity is None else np.asarray(velocity, dtype=float)
    if own.shape != (len(frames), 3):
        raise MitsonarError(f"the sonar's velocity must be ({len(frames)}, 3) in m/s: got {own.shape}")
    found = np.full(frames.image.shape, np.nan, np.float32)
    bodies = body_of_pixels(frames)
    for number in range(len(frames)):
        bins, beams = np.nonzero(np.isfinite(frames.elevation_rad[number]))
        elevation = frames.elevation_rad[number, bins, beams]
        poses = frames.poses[None, number] if frames.beam_poses is None else frames.beam_poses[number]
        one = np.zeros_like(beams) if frames.beam_poses is None else beams
        own_axes = directions(frames.sonar.bearing, frames.bearing_rad[beams], elevation)
        way = np.einsum("nij,nj->ni", vehicle_rotation(poses).as_matrix()[one], own_axes)
        place = poses[one, :3] + way * frames.range_m[bins, None]
        moves = _velocity_at(frames, number, bodies[number, bins, beams], place) - own[number]
        found[number, bins, beams] = (moves * way).sum(axis=1)
    return found


def body_of_pixels(frames: SonarFrames) -> NDArray[np.int32]:
    """Return the place in ``body_names`` of the body that each pixel shows, like ``image``; -1: none that moves.

    Raises:
        MitsonarError: no labels.
    """
    if frames.object_id is None or frames.shape_id is None:
        raise MitsonarError("bodies of pixels need labels: render with --labels")
    found = np.full(frames.image.shape, -1, np.int32)
    for number, name in enumerate(frames.body_names):
        if name in frames.object_names:
            found[frames.object_id == frames.object_names.index(name)] = number
        if name in frames.shape_names:  # a mesh that numbers its own objects
            found[frames.shape_id == frames.shape_names.index(name)] = number
    return found


def _velocity_at(frames: SonarFrames, number: int, body: NDArray[np.int32], place: Array) -> Array:
    """Return the velocity of what is at places ``(n, 3)`` in one frame: v + w x r of its body, 0 of what is still."""
    found = np.zeros_like(place)
    if frames.body_poses is None or frames.body_velocities is None:
        return found
    on = body >= 0
    moves, middle = frames.body_velocities[number, body[on]], frames.body_poses[number, body[on], :3]
    found[on] = moves[:, :3] + np.cross(moves[:, 3:], place[on] - middle)
    return found
