"""The local map: frames are registered to landmarks of the last metres, not to the last frame alone.

Motions between two frames take the relief of the ground as one number, and the path drifts as long as the same rocks are in
view. A map holds the height of each landmark, which many frames together tell. For each frame: predict its pose from the
motion between two frames, register it to the landmarks, update the map where the sonar has moved on, and decide whether the
answer is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError
from scipy.ndimage import percentile_filter

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.estimation.image.patches import PatchImage, patch_image
from mitsonar.geometry.fan import Views, polar_of
from mitsonar.geometry.ground import attitude_of
from mitsonar.mapping.bundle_adjustment import adjusted
from mitsonar.mapping.frame_source import FrameSource
from mitsonar.mapping.landmarks import ImageAxes, Landmarks
from mitsonar.mapping.map_registration import FEWEST, PAIR_STD, Registered, level_turn, registered
from mitsonar.motion.composition import Motion, compose, motions
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import SonarFrames

__all__ = ["USED", "map_attitudes", "mapped"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

USED = "used"
"""What ``about["map"]`` of an estimate says where the map tells the motion; else it says why not."""

FRAMES_A_READ = 16

WINDOW = 30
"""Keyframes whose poses are adjusted."""

KEPT = 60
"""Keyframes whose observations are kept: older ones hold no landmark in view."""

MOVED = np.array([10.0, 2.2])
"""Median displacement of the landmarks since the last keyframe that makes another one [bins, beams]."""

FEWEST_VIEWS = 3
"""Keyframes that must show a landmark that is adjusted."""

LOST = 0.6
"""Part of the landmarks of the last keyframe below which another one is made."""

LOST_STD = np.array([0.05, 0.05, np.radians(1)])
"""Standard deviations of a prediction without a valid motion [m, m, rad]."""

WORST = 25.0
"""Squared error beyond which a keyframe does not show a landmark."""

RELIEF_M = 0.1
LEAST_RELIEF_M = 0.02
"""Mean height of what is seen over the ground: where first echoes do not tell it, and at least [m]."""

CONTRAST = 0.6
"""Mean height of landmarks, as part of the height of the contrast by first echoes: these come from the tops."""

ATTITUDE_STD = np.array([2e-4, np.radians(2e-3), np.radians(2e-3)])
"""Standard deviations of heights [m], pitches and rolls [rad] that poses tell."""

ROUGH_STD = np.array([0.01, np.radians(0.3), np.radians(0.3)])
"""The same where they are given for a whole run: heave and tilt are then estimated."""

HEIGHT_FRAMES = 401
"""Frames among which the greatest heights are those over the ground, not over a rock."""

SAFETY = 8.0
"""Squared errors over the covariance of the map's normal equations, measured over rocks: the errors of patches are alike."""


@dataclass
class _Map:
    """The state that goes from frame to frame.

    Attributes:
        landmarks: of the last metres.
        attitude_std: of heights [m], pitches and rolls [rad] ``(3,)``.
        keyframes: their number among the frames.
        poses: of the keyframes ``(6,)`` each.
        relief_m: mean height of what is seen over the ground.
        told: heights, pitches and rolls of the keyframes, as sensors tell them ``(3,)`` each.
        begun: first keyframe since the map was begun anew.
        lean: height, pitch and roll of the last keyframe, less what was told ``(3,)``.
        drift: covariance of x, y, heading that each keyframe adds ``(3, 3)`` each.
    """

    landmarks: Landmarks
    attitude_std: Array
    keyframes: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    told: list[Array] = field(default_factory=list)
    begun: int = 0
    relief_m: float = RELIEF_M
    lean: Array = field(default_factory=lambda: np.zeros(3))
    drift: list[Array] = field(default_factory=list)


def mapped(
    source: FrameSource,
    numbers: Index,
    estimates: Sequence[Estimate],
    progress: Callable[[int], None] = lambda frames: None,
) -> list[Estimate]:
    """Estimate the motions anew, with a map of the last metres.

    The time a frame is constant, and so is the memory but for the answer. The result is a function of the frames and the
    estimates: a run that was stopped gives the same bits again.

    Args:
        source: of the frames; it tells heights, and pitches or poses.
        numbers: of the frames used ``(n,)``.
        estimates: of each pair of consecutive frames: where a frame's landmarks are looked for.
        progress: called with the number of frames that were added.

    Returns:
        An estimate a motion; those that the map does not tell are as they were.

    Raises:
        MitsonarError: no height over the ground, or no pitch.
    """
    attitudes, std = map_attitudes(source, numbers)
    state = _Map(Landmarks(_axes(source.like)), std)
    path, reasons = [attitudes[0]], [""]
    for k, (frames, image) in enumerate(_images(source, numbers)):
        expected = attitudes[0].copy() if k == 0 else _predicted(path[-1], estimates[k - 1], attitudes[k])
        expected[2:5] += state.lean
        answer = registered(state.landmarks, image, expected, _spread(estimates, k))
        pose = _update(state, k, frames, image, answer, attitudes[k])
        if k:
            path.append(pose)
            reasons.append(answer.reason)
        progress(1)
    corrected = _corrected(np.array(path), state)
    found = motions(corrected)
    drift = _drift_a_frame(state, len(path))
    return [_decided(one, found[k], reasons[k + 1], drift[k + 1], corrected[k + 1]) for k, one in enumerate(estimates)]


# ---------------------------------------------------------------- predict


def _axes(like: SonarFrames) -> ImageAxes:
    return ImageAxes(like.range_m, like.bearing_rad, like.sonar.bearing)


def map_attitudes(source: FrameSource, numbers: Index) -> tuple[Array, Array]:
    """Return height over the ground, pitch and roll of the frames, as poses ``(n, 6)``, and their standard deviations.

    Raises:
        MitsonarError: no height over the ground, or no pitch.
    """
    table = np.zeros((len(numbers), 6))
    heights = None if source.height_m is None else source.height_m[numbers]
    if heights is None or not np.isfinite(heights).any():
        raise MitsonarError(
            f"{source.name}: the local map needs the height over the ground, and the frames tell none: give it, or "
            "leave the map out"
        )
    heights = np.where(np.isfinite(heights), heights, np.nanmedian(heights))
    if source.poses is not None and np.isfinite(source.poses[numbers, 2:5]).all():
        poses = source.poses[numbers]
        # an altimeter over a rock tells less than the height over the ground
        ground = percentile_filter(poses[:, 2] - heights, 5, size=min(HEIGHT_FRAMES, len(heights)), mode="nearest")
        table[:, 2:5] = poses[:, 2:5]
        table[:, 2] -= ground
        table[0, 5] = poses[0, 5]
        return table, ATTITUDE_STD
    table[:, 2] = percentile_filter(heights, 90, size=min(HEIGHT_FRAMES, len(heights)), mode="nearest")
    measured = None if source.attitude_rad is None else source.attitude_rad[numbers, :2]
    if source.pitch_rad is not None:
        table[:, 3] = source.pitch_rad
    elif measured is not None and np.isfinite(measured).all():
        table[:, 3:5] = measured
    else:
        raise MitsonarError(
            f"{source.name}: the local map needs the pitch of the sonar, and the frames tell none: give it, or "
            "leave the map out"
        )
    return table, ROUGH_STD


def _images(source: FrameSource, numbers: Index) -> Iterator[tuple[SonarFrames, PatchImage]]:
    """Read the frames, one after another, some at a time."""
    for start in range(0, len(numbers), FRAMES_A_READ):
        frames = source.read(numbers[start : start + FRAMES_A_READ])
        values = frames.matching_values()
        for k in range(len(frames)):
            yield frames.select(slice(k, k + 1)), patch_image(values[k])


def _predicted(before: Array, estimate: Estimate, attitude: Array) -> Array:
    """Return the pose after a motion, at the height and attitude that are told."""
    pose = np.array(compose(Pose.from_row(float(value) for value in before), estimate.motion))
    pose[2:5] = attitude[2:5]
    return pose


def _spread(estimates: Sequence[Estimate], frame: int) -> Array:
    """Return the covariance of starboard, forward and heading of the prediction of a frame ``(3, 3)``."""
    if frame == 0:
        return np.diag(PAIR_STD**2)
    one = estimates[frame - 1]
    if not one.valid:
        return np.diag(LOST_STD**2)
    known = np.diag((10 * PAIR_STD) ** 2) if one.covariance is None else np.asarray(one.covariance, dtype=float)
    return np.asarray(known + np.diag(PAIR_STD**2))


# ---------------------------------------------------------------- update


def _update(
    state: _Map,
    frame: int,
    frames: SonarFrames,
    image: PatchImage,
    answer: Registered,
    told: Array,
) -> Array:
    """Make a keyframe where the sonar has moved on, adjust the last ones, and return the pose of the frame."""
    if state.keyframes and not answer.reason and not _moved_on(state, answer):
        return answer.pose
    number, landmarks = len(state.keyframes), state.landmarks
    if answer.reason:
        landmarks.give_up()
        state.begun = number
    state.keyframes.append(frame)
    state.poses.append(answer.pose.copy())
    state.told.append(told[2:5])
    state.drift.append(state.drift[-1] if state.drift else np.diag(PAIR_STD**2))
    good = answer.found.take(answer.squared < WORST)
    if number and not answer.reason:
        landmarks.observe(number, good)
        landmarks.renew(image, Views.of(answer.pose), good)
        _adjust(state)
    state.relief_m = _relief(frames, state.poses[-1], state.relief_m)
    view = Views.of(state.poses[-1])
    landmarks.choose(image, view, number, _usual_height(state))
    landmarks.forget(number - KEPT)
    return state.poses[-1].copy()


def _moved_on(state: _Map, answer: Registered) -> bool:
    """Return whether the landmarks of the last keyframe have moved by much, or are lost."""
    number = answer.found.landmark
    if len(number) < max(FEWEST, LOST * int(state.landmarks.used.sum())):
        return bool(np.abs(answer.pose - state.poses[-1]).max() > 1e-6)
    axes, points = state.landmarks.axes, state.landmarks.points[number]
    now, then = (axes.cells(polar_of(points, Views.of(pose), axes.bearing)) for pose in (answer.pose, state.poses[-1]))
    return bool((np.median(np.abs(now - then), axis=0) > MOVED).any())


def _adjust(state: _Map) -> None:
    """Adjust the last keyframes and the landmarks that they show."""
    last, landmarks = len(state.poses), state.landmarks
    first = max(state.begun + 1, last - WINDOW)
    number, seen = landmarks.holding(first, FEWEST_VIEWS, state.begun)
    if first >= last or len(number) < FEWEST:
        return
    oldest = int(seen.view.min())
    poses = np.array(state.poses[oldest:])
    try:
        new = adjusted(
            poses,
            first - oldest,
            np.array(state.told[first:]),
            state.attitude_std,
            landmarks.points[number],
            seen._replace(view=seen.view - oldest),
            landmarks.axes.bearing,
            state.relief_m,
        )
    except LinAlgError:
        return  # the keyframes stay as they were registered
    landmarks.refine(number, new.points, new.point_covariance, new.faults)
    state.lean = new.poses[-1, 2:5] - state.told[-1]
    state.poses[first:] = list(new.poses[first - oldest :])
    state.drift[-1] = _of_one(new.last_covariance, np.array(state.poses[first - 1 :]))


def _of_one(whole: Array, poses: Array) -> Array:
    """Return the covariance of each of the motions between poses ``(k, 6)``, alike ones that add up to that of the last."""
    lever = (poses[-1, :2] - poses[:-1, :2]).mean(axis=0)
    back = np.array([[1, 0, -lever[1]], [0, 1, lever[0]], [0, 0, 1]])
    return np.asarray(back @ whole @ back.T / (len(poses) - 1))


def _relief(frames: SonarFrames, pose: Array, before: float) -> float:
    """Return the mean height of what is seen over the ground, by first echoes where there are any."""
    attitude = attitude_of(frames, "the local map", float(pose[2]), float(pose[3]))
    if attitude.reason or attitude.first is None:
        return before
    measured = max(LEAST_RELIEF_M, CONTRAST * (float(pose[2]) - attitude.first.height_m))
    return 0.9 * before + 0.1 * measured


def _usual_height(state: _Map) -> float:
    """Return the height at which new landmarks are taken to lie."""
    known = state.landmarks.used & (state.landmarks.faults < 1.0)
    return float(np.median(state.landmarks.points[known, 2])) if known.sum() >= 4 * FEWEST else state.relief_m


# ---------------------------------------------------------------- decide


def _corrected(path: Array, state: _Map) -> Array:
    """Return the poses of all frames ``(n, 6)``: keyframes as adjusted last, and the frames between them carried along."""
    corrected = path.copy()
    for number, start in enumerate(state.keyframes):
        end = state.keyframes[number + 1] if number + 1 < len(state.keyframes) else len(path) - 1
        near = _carried(path[start : end + 1], path[start], state.poses[number])
        if number + 1 < len(state.keyframes):
            far = _carried(path[start : end + 1], path[end], state.poses[number + 1])
            share = np.linspace(0, 1, end - start + 1)[:, None]
            near = near + share * (far - near)
        corrected[start : end + 1] = near
    return corrected


def _drift_a_frame(state: _Map, frames: int) -> Array:
    """Return the covariance of x, y, heading that each frame adds ``(frames, 3, 3)``: that of its keyframe, shared."""
    drift = np.zeros((frames, 3, 3))
    ends = [*state.keyframes[1:], frames - 1]
    for number, (start, end) in enumerate(zip(state.keyframes, ends, strict=True)):
        there = min(number + 1, len(state.drift) - 1)
        drift[start + 1 : end + 1] = SAFETY * state.drift[there] / max(end - start, 1)
    return drift


def _carried(path: Array, old: Array, new: Array) -> Array:
    """Move poses rigidly, in the plane, by what takes one pose to another."""
    turn = new[5] - old[5]
    sin, cos = np.sin(turn), np.cos(turn)
    x, y = (path[:, :2] - old[:2]).T
    moved = path.copy()
    moved[:, 0], moved[:, 1] = new[0] + cos * x + sin * y, new[1] - sin * x + cos * y
    moved[:, 5] += turn
    return moved


def _decided(estimate: Estimate, motion: Array, reason: str, drift: Array, pose: Array) -> Estimate:
    """Return the map's answer, or the estimate where it has none."""
    if reason:
        about = {**estimate.about, "map": reason}
        return replace(estimate, about=about)
    turn = np.eye(3)
    turn[:2, :2] = level_turn(float(pose[5]))
    return Estimate(Motion(*motion.tolist()), turn @ drift @ turn.T, True, "", {"map": USED})
