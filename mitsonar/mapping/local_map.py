"""The local map: frames are registered to landmarks of the last metres, not to the last frame alone.

Motions between two frames take the relief of the ground as one number, and the path drifts as long as the same rocks are in
view. A map holds the height of each landmark, which many frames together tell. For each frame: predict its pose from the
motion between two frames, register it to the landmarks, update the map where the sonar has moved on, and decide whether the
answer is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError
from scipy.ndimage import percentile_filter

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.estimation.image.patches import COLUMNS, ROWS, Patches, PatchImage, align, corners, cut, patch_image
from mitsonar.geometry.fan import Views, points_at, polar_of, projection_of
from mitsonar.geometry.ground import attitude_of
from mitsonar.instruments.sonar import Bearing
from mitsonar.mapping.bundle import PLANAR, Observations, adjusted, cauchy, track_weight
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import Motion, compose, motions
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import SonarFrames

__all__ = [
    "FEWEST",
    "PAIR_STD",
    "USED",
    "Found",
    "ImageAxes",
    "Landmarks",
    "Registered",
    "level_turn",
    "map_attitudes",
    "mapped",
    "registered",
]


# ---------------- Landmarks of a local map: points of the ground with the patches by which frames show them, and
# their observations


Array = NDArray[np.float64]
Index = NDArray[np.intp]

PIXELS = len(ROWS)

ANCHOR = np.array([0.1, 0.08])
"""Standard deviation of where a new landmark is [bins, beams]: the noise of its patch."""

LEAST_ALIKE = 0.75
FARTHEST = np.array([8.0, 2.5])
"""Least correlation of a patch that was found, and how far from where it was looked for [bins, beams]."""

EDGE = np.array([9.0, 2.4])
"""Distance from the edge of the frame at which landmarks are looked for [bins, beams]."""

STALE = 0.92
"""Correlation below which a patch is cut anew."""

MISSED = 2
"""Keyframes in which a landmark may be missed before it is given up."""

FAULTY = 8.0
"""Mean squared error, in those of the usual one, beyond which a landmark is given up."""

BLOCKING = 4.0
"""Landmarks worse than this keep their place for a while, so that the same shadow is not chosen again."""

HEIGHT_STD_M = 0.3
"""Standard deviation of the height of a new landmark."""


@dataclass(frozen=True)
class ImageAxes:
    """Cells of the frames of a run: ranges [m] and bearings [rad] of their middles, and the kind of the bearings."""

    range_m: Array
    bearing_rad: Array
    bearing: Bearing

    def cells(self, polar: Array) -> Array:
        """Return row and column ``(..., 2)`` of range and bearing; beyond the last cells by the spacing there."""
        return np.stack([_place(polar[..., k], axis) for k, axis in enumerate(self._axes)], axis=-1)

    def polar(self, row: Array, column: Array) -> Array:
        """Return range and bearing ``(..., 2)`` of rows and columns."""
        places = (row, column)
        return np.stack([_value(place, axis) for place, axis in zip(places, self._axes, strict=True)], axis=-1)

    def spacing(self, polar: Array) -> Array:
        """Return the spacing of cells ``(n, 2)`` [m, rad] at range and bearing ``(n, 2)``."""
        return np.stack([np.interp(polar[:, k], axis, np.gradient(axis)) for k, axis in enumerate(self._axes)], axis=-1)

    @property
    def _axes(self) -> tuple[Array, Array]:
        return self.range_m, self.bearing_rad


class Found(NamedTuple):
    """Landmarks that a frame shows: number, range and bearing with covariance, correlation of the patch."""

    landmark: Index
    polar: Array
    covariance: Array
    correlation: Array

    def take(self, index: Index | NDArray[np.bool_]) -> Found:
        """Return some of them."""
        return Found(self.landmark[index], self.polar[index], self.covariance[index], self.correlation[index])


def _empty(*shape: int) -> Array:
    return np.zeros((0, *shape))


@dataclass
class Landmarks:
    """A table of landmarks, of those in use and of those that still hold the map's poses.

    Attributes:
        axes: of the frames.
        points: in metres over the ground ``(l, 3)``.
        covariance: of the points ``(l, 3, 3)``.
        offsets: of the patch's pixels from the point, level ``(l, pixels, 2)`` [m].
        patches: by which frames show them.
        used: whether they are still looked for ``(l,)``.
        faults: mean squared errors, in those of the usual one ``(l,)``.
        missed: keyframes since they were found ``(l,)``.
        born: keyframe in which they were chosen ``(l,)``.
        seen: observations in keyframes.
    """

    axes: ImageAxes
    points: Array = field(default_factory=lambda: _empty(3))
    covariance: Array = field(default_factory=lambda: _empty(3, 3))
    offsets: Array = field(default_factory=lambda: _empty(PIXELS, 2))
    patches: Patches = field(
        default_factory=lambda: Patches(np.zeros((0, PIXELS), np.float32), np.zeros((0, PIXELS), np.float32))
    )
    used: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    faults: Array = field(default_factory=_empty)
    missed: Index = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    born: Index = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    seen: Observations = field(
        default_factory=lambda: Observations(np.zeros(0, np.intp), np.zeros(0, np.intp), _empty(2), _empty(2, 2))
    )

    def find(self, image: PatchImage, view: Views) -> tuple[Found, int]:
        """Find the landmarks in a frame that a view is expected to have taken; and count those that it should show."""
        number = np.flatnonzero(self.used)
        if not len(number):
            return Found(number, _empty(2), _empty(2, 2), _empty()), 0
        middle = polar_of(self.points[number], view, self.axes.bearing)
        place = self.axes.cells(middle)
        inside = (np.abs(place - self._middle) < self._half).all(axis=1)
        number, middle = number[inside], middle[inside]
        pixels = np.concatenate([self.offsets[number], np.zeros((len(number), PIXELS, 1))], axis=2)
        cells = self.axes.cells(polar_of((self.points[number][:, None] + pixels).reshape(-1, 3), view, self.axes.bearing))
        cells = cells.reshape(len(number), PIXELS, 2)
        there = align(image, self.patches.take(number), cells[..., 0], cells[..., 1])
        good = (there.correlation > LEAST_ALIKE) & (np.abs(there.shift) < FARTHEST).all(axis=1)
        spacing = self.axes.spacing(middle)
        covariance = there.covariance * spacing[:, :, None] * spacing[:, None, :]
        found = Found(number, middle + there.shift * spacing, covariance, there.correlation)
        return found.take(good), len(number)

    @property
    def _middle(self) -> Array:
        size = [len(self.axes.range_m), len(self.axes.bearing_rad)]
        return np.asarray((np.array(size, dtype=np.float64) - 1) / 2)

    @property
    def _half(self) -> Array:
        return np.asarray(self._middle - EDGE)

    def observe(self, keyframe: int, found: Found) -> None:
        """Keep what a keyframe shows; give up landmarks that it misses again."""
        views = np.full(len(found.landmark), keyframe, dtype=np.intp)
        new = Observations(views, found.landmark, found.polar, found.covariance)
        self.seen = Observations(*(np.concatenate(pair) for pair in zip(self.seen, new, strict=True)))
        self.missed += self.used
        self.missed[found.landmark] = 0
        self.used &= self.missed < MISSED

    def give_up(self) -> None:
        """Look for none of the landmarks any more: the map is begun anew."""
        self.used[:] = False

    def renew(self, image: PatchImage, view: Views, found: Found) -> None:
        """Cut the patches anew of landmarks that look otherwise than when they were chosen."""
        old = found.take(found.correlation < STALE)
        if not len(old.landmark):
            return
        middle = self.axes.cells(old.polar)
        row, column = middle[:, :1] + ROWS, middle[:, 1:] + COLUMNS
        patches, inside = cut(image, row, column, self.patches.weights[old.landmark])
        offsets = self._offsets(old.polar, row, column, self.points[old.landmark, 2], view)
        good = inside & np.isfinite(offsets).all(axis=(1, 2))
        number = old.landmark[good]
        self.patches.values[number], self.offsets[number] = patches.values[good], offsets[good]

    def _offsets(self, middle: Array, row: Array, column: Array, height: Array, view: Views) -> Array:
        """Return where the pixels of patches lie beside their middles, on level ground ``(n, pixels, 2)`` [m]."""
        rows = np.broadcast_to(row, (len(middle), PIXELS))
        pixels = self.axes.polar(rows, np.broadcast_to(column, rows.shape)).reshape(-1, 2)
        ground = points_at(pixels, np.repeat(height, PIXELS), view, self.axes.bearing).reshape(-1, PIXELS, 3)
        return np.asarray((ground - points_at(middle, height, view, self.axes.bearing)[:, None])[..., :2])

    def choose(self, image: PatchImage, view: Views, keyframe: int, height_m: float) -> None:
        """Choose new landmarks where a keyframe shows none.

        Args:
            image: of the keyframe.
            view: that took it.
            keyframe: its number.
            height_m: of the new landmarks, until more frames show them.
        """
        row, column = corners(image, self._taken(view, keyframe))
        polar = self.axes.polar(row.astype(float), column.astype(float))
        rows, columns = row[:, None] + ROWS, column[:, None] + COLUMNS
        patches, good = cut(image, rows, columns)
        height = np.full(len(row), height_m)
        points = points_at(polar, height, view, self.axes.bearing)
        offsets = self._offsets(polar, rows, columns, height, view)
        good &= np.isfinite(points).all(axis=1) & np.isfinite(offsets).all(axis=(1, 2))
        if not good.any():
            return
        points, polar = points[good], polar[good]
        noise = self.axes.spacing(polar) * ANCHOR
        covariance = noise[:, :, None] ** 2 * np.eye(2)
        count, first = len(points), len(self.points)
        fresh = {
            "points": points,
            "covariance": self._covariance_of_new(points, view, covariance),
            "offsets": offsets[good],
            "used": np.ones(count, dtype=bool),
            "faults": np.ones(count),
            "missed": np.zeros(count, dtype=np.intp),
            "born": np.full(count, keyframe, dtype=np.intp),
        }
        for name, values in fresh.items():
            setattr(self, name, np.concatenate([getattr(self, name), values]))
        self.patches = Patches(*(np.concatenate(two) for two in zip(self.patches, patches.take(good), strict=True)))
        anchors = Observations(np.full(count, keyframe, dtype=np.intp), np.arange(first, first + count), polar, covariance)
        self.seen = Observations(*(np.concatenate(pair) for pair in zip(self.seen, anchors, strict=True)))

    def _covariance_of_new(self, points: Array, view: Views, covariance: Array) -> Array:
        """Return the covariance of new points: by range and bearing, and by the law of heights."""
        by_point = projection_of(points, view, self.axes.bearing).by_point
        information = by_point.transpose(0, 2, 1) @ np.linalg.inv(covariance) @ by_point
        information[:, 2, 2] += 1 / HEIGHT_STD_M**2
        return np.asarray(np.linalg.inv(information))

    def _taken(self, view: Views, keyframe: int) -> NDArray[np.bool_]:
        """Return the cells ``(bins, beams)`` of landmarks that are in use, or that were found to be bad of late."""
        taken = np.zeros((len(self.axes.range_m), len(self.axes.bearing_rad)), dtype=bool)
        there = self.used | ((self.faults > BLOCKING) & (self.born > keyframe - 25))
        if there.any():
            place = np.rint(self.axes.cells(polar_of(self.points[there], view, self.axes.bearing)))
            place = place[((place >= 0) & (place < taken.shape)).all(axis=1)].astype(np.intp)
            taken[place[:, 0], place[:, 1]] = True
        return taken

    def refine(self, number: Index, points: Array, covariance: Array, faults: Array) -> None:
        """Take what a bundle adjustment found for some landmarks; give up those that fit badly."""
        self.points[number], self.covariance[number], self.faults[number] = points, covariance, faults
        self.used[number] &= faults < FAULTY

    def forget(self, first_view: int) -> None:
        """Drop landmarks that are not in use and that no keyframe from ``first_view`` on shows: memory stays constant."""
        keep = self.used.copy()
        keep[self.seen.landmark[self.seen.view >= first_view]] = True
        if keep.all():
            return
        new = np.cumsum(keep) - 1
        seen = self.seen.take(keep[self.seen.landmark])
        self.seen = seen._replace(landmark=new[seen.landmark])
        for name in ("points", "covariance", "offsets", "used", "faults", "missed", "born"):
            setattr(self, name, getattr(self, name)[keep])
        self.patches = self.patches.take(keep)

    def holding(self, first_view: int, fewest: int, born: int) -> tuple[Index, Observations]:
        """Return landmarks that hold the keyframes from ``first_view`` on: their numbers, and all observations of them.

        Args:
            first_view: of the keyframes.
            fewest: keyframes that must show a landmark.
            born: keyframe before which landmarks do not count: the map was begun anew there.

        In these observations landmarks are numbered in this order.
        """
        times = np.bincount(self.seen.landmark, minlength=len(self.points))
        shown = np.zeros(len(self.points), dtype=bool)
        shown[self.seen.landmark[self.seen.view >= first_view]] = True
        number = np.flatnonzero(shown & (times >= fewest) & (self.born >= born))
        place = np.full(len(self.points), -1)
        place[number] = np.arange(len(number))
        seen = self.seen.take(place[self.seen.landmark] >= 0)
        return number, seen._replace(landmark=place[seen.landmark])


def _place(values: Array, axis: Array) -> Array:
    """Return where values stand on an increasing axis, in cells; beyond its ends by the spacing there."""
    cell = np.interp(values, axis, np.arange(len(axis), dtype=float))
    low, high = (values - axis[0]) / (axis[1] - axis[0]), (values - axis[-1]) / (axis[-1] - axis[-2]) + len(axis) - 1
    return np.asarray(np.where(values < axis[0], low, np.where(values > axis[-1], high, cell)))


def _value(place: Array, axis: Array) -> Array:
    """Return the value at a place on an axis, the inverse of :func:`_place`."""
    value = np.interp(place, np.arange(len(axis), dtype=float), axis)
    low, high = axis[0] + place * (axis[1] - axis[0]), axis[-1] + (place - len(axis) + 1) * (axis[-1] - axis[-2])
    return np.asarray(np.where(place < 0, low, np.where(place > len(axis) - 1, high, value)))


# ---------------- local map


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


# ---------------- Registration of a frame to the landmarks of a local map


FEWEST = 12
"""Fewest landmarks by which a frame is registered."""

LEAST_FOUND = 0.5
"""Least part of the landmarks in view that a frame must show. Without noise it is nine tenths; with noise of pixels that
hides the ground, a fifth."""

ROUNDS, STILL = 8, 1e-6
"""Gauss-Newton iterations of a registration, and the step below which they end [m, rad]."""

PAIR_SHARE = 0.1
PAIR_STD = np.array([1e-3, 1e-3, np.radians(0.03)])
"""Share of the information of the motion between two frames that counts: the map has seen the same frames; least standard
deviations of that motion [m, m, rad]."""

GATE = 16.0
"""Squared error, in covariances, beyond which a landmark is not where it was expected: noise that looks alike."""

ASTRAY = 25.0
"""Squared distance, in covariances, of the map's pose from the prediction, beyond which the map is not believed."""


@dataclass(frozen=True)
class Registered:
    """A frame's pose by the map, what it shows, its squared errors in covariances, and why it is not used."""

    pose: Array
    found: Found
    squared: Array
    reason: str = ""


def registered(landmarks: Landmarks, image: PatchImage, expected: Array, spread: Array) -> Registered:
    """Find the landmarks, and the pose from which the sonar receives them there.

    Args:
        landmarks: of the map.
        image: the frame.
        expected: its pose as predicted ``(6,)``.
        spread: covariance of starboard, forward [m], heading [rad] of the prediction ``(3, 3)``.
    """
    turn = np.eye(3)
    turn[:2, :2] = level_turn(expected[5])
    predicted = turn.T @ spread @ turn
    found, shown = landmarks.find(image, Views.of(expected))
    found = found.take(_residuals(landmarks, found, expected, predicted).squared < GATE)
    pose, prior = expected.copy(), PAIR_SHARE * np.linalg.inv(predicted)
    needed = max(FEWEST, int(LEAST_FOUND * shown))
    if len(found.landmark) < needed:
        few = f"the map finds {len(found.landmark)} of {shown} landmarks, {needed} are needed"
        return Registered(pose, found, np.zeros(len(found.landmark)), few)
    for _ in range(ROUNDS):
        at = _residuals(landmarks, found, pose, None)
        weight = cauchy(at.squared) * track_weight(landmarks.faults[found.landmark])
        weighted = at.by_pose.transpose(0, 2, 1) @ (at.inverse * weight[:, None, None])
        normal = (weighted @ at.by_pose).sum(axis=0) + prior
        pull = (weighted @ at.error[:, :, None])[:, :, 0].sum(axis=0) - prior @ (pose - expected)[PLANAR]
        step = np.linalg.solve(normal, pull)
        pose[PLANAR] += step
        if np.abs(step).max() < STILL:
            break
    off = (pose - expected)[PLANAR]
    if off @ np.linalg.solve(predicted, off) > ASTRAY:
        return Registered(expected, found, at.squared, "the map and the motion between two frames contradict each other")
    return Registered(pose, found, at.squared)


class _Residuals(NamedTuple):
    """Of landmarks at a pose: errors ``(n, 2)``, inverse covariances, squares in covariances, derivatives by the pose."""

    error: Array
    inverse: Array
    squared: Array
    by_pose: Array


def _residuals(landmarks: Landmarks, found: Found, pose: Array, predicted: Array | None) -> _Residuals:
    """Compare where landmarks were found with where a pose has them; with the covariance of the pose, where it is given."""
    projected = projection_of(landmarks.points[found.landmark], Views.of(pose), landmarks.axes.bearing)
    error, by_pose = found.polar - projected.polar, projected.by_pose[:, :, PLANAR]
    covariance = landmarks.covariance[found.landmark]
    spread = found.covariance + projected.by_point @ covariance @ projected.by_point.transpose(0, 2, 1)
    if predicted is not None:
        spread = spread + by_pose @ predicted @ by_pose.transpose(0, 2, 1)
    inverse = np.asarray(np.linalg.inv(spread), dtype=np.float64)
    return _Residuals(error, inverse, np.einsum("ni,nij,nj->n", error, inverse, error), by_pose)


def level_turn(heading: float) -> Array:
    """Return what turns x and y of the world into starboard and forward ``(2, 2)``."""
    sin, cos = np.sin(heading), np.cos(heading)
    return np.array([[cos, -sin], [sin, cos]])
