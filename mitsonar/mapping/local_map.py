"""How frames are registered to a map of landmarks of the last metres, instead of to the previous frame alone.

An estimator of motions between two frames describes the relief of the ground by one number, so that the path drifts as long
as the same rocks are in view. A map holds the height of each landmark, which many frames together determine. :func:`mapped`
takes each frame in turn. It predicts the pose from the motion between two frames, registers the frame to the landmarks,
updates the map if the sonar has moved on, and decides whether to use the result.
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
    "ImageAxes",
    "Landmarks",
    "Matches",
    "Registered",
    "level_turn",
    "map_attitudes",
    "mapped",
    "registered",
]


# ---------------- Landmarks


Array = NDArray[np.float64]
Index = NDArray[np.intp]

PIXELS = len(ROWS)

ANCHOR = np.array([0.1, 0.08])
"""Standard deviation of the position of a new landmark [bins, beams], due to the noise of its patch."""

LEAST_CORRELATION = 0.75
FARTHEST = np.array([8.0, 2.5])
"""Smallest correlation at which a patch counts as found, and its largest distance from the prediction [bins, beams]."""

EDGE = np.array([9.0, 2.4])
"""Smallest distance from the edge of the frame at which landmarks are searched for [bins, beams]."""

STALE = 0.92
"""Correlation below which a patch is cut again from the current frame."""

MISSED = 2
"""Number of successive keyframes without a landmark after which it is dropped."""

FAULTY = 8.0
"""Mean squared error, relative to the usual one, beyond which a landmark is dropped."""

BLOCKING = 4.0
"""Mean squared error beyond which a landmark blocks its place for a while, so that the same shadow is not chosen again."""

HEIGHT_STD_M = 0.3
"""Standard deviation of the height of a new landmark."""


@dataclass(frozen=True)
class ImageAxes:
    """The cells of the frames of a run.

    Attributes:
        range_m: ranges of the centres of the cells ``(bins,)`` [m].
        bearing_rad: bearings of the centres of the cells ``(beams,)`` [rad].
        bearing: kind of the bearings.
    """

    range_m: Array
    bearing_rad: Array
    bearing: Bearing

    def cells(self, polar: Array) -> Array:
        """Return row and column ``(..., 2)`` of range and bearing, extrapolated linearly beyond the last cells."""
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


class Matches(NamedTuple):
    """Landmarks that were found in a frame.

    Attributes:
        landmark: indices of the landmarks ``(n,)``.
        polar: range [m] and bearing [rad] ``(n, 2)``.
        covariance: covariances of range and bearing ``(n, 2, 2)``.
        correlation: correlations of the patches with the frame ``(n,)``.
    """

    landmark: Index
    polar: Array
    covariance: Array
    correlation: Array

    def take(self, index: Index | NDArray[np.bool_]) -> Matches:
        """Return the selected landmarks."""
        return Matches(self.landmark[index], self.polar[index], self.covariance[index], self.correlation[index])


def _empty(*shape: int) -> Array:
    return np.zeros((0, *shape))


@dataclass
class Landmarks:
    """A table of landmarks: those in use, and those that still constrain the poses of the map.

    Attributes:
        axes: cells of the frames.
        points: points, with z as height over the ground ``(l, 3)`` [m].
        covariance: covariances of the points ``(l, 3, 3)``.
        offsets: horizontal offsets of the pixels of each patch from the point ``(l, pixels, 2)`` [m].
        patches: appearance of the landmarks in frames.
        used: whether each landmark is still searched for ``(l,)``.
        faults: mean squared errors, relative to the usual one ``(l,)``.
        missed: number of keyframes since each landmark was found ``(l,)``.
        born: keyframe in which each landmark was chosen ``(l,)``.
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

    def find(self, image: PatchImage, view: Views) -> tuple[Matches, int]:
        """Find the landmarks in a frame taken from an expected view; also return how many it should show."""
        # 1. landmarks in use whose predicted place lies well inside the frame
        number = np.flatnonzero(self.used)
        if not len(number):
            return Matches(number, _empty(2), _empty(2, 2), _empty()), 0
        middle = polar_of(self.points[number], view, self.axes.bearing)
        place = self.axes.cells(middle)
        inside = (np.abs(place - self._middle) < self._half).all(axis=1)
        number, middle = number[inside], middle[inside]
        # 2. predict every pixel of their patches, which accounts for the rotation and distortion of the view; align them
        pixels = np.concatenate([self.offsets[number], np.zeros((len(number), PIXELS, 1))], axis=2)
        cells = self.axes.cells(polar_of((self.points[number][:, None] + pixels).reshape(-1, 3), view, self.axes.bearing))
        cells = cells.reshape(len(number), PIXELS, 2)
        there = align(image, self.patches.take(number), cells[..., 0], cells[..., 1])
        # 3. keep those that correlate well near the prediction, converted from cells to range and bearing
        good = (there.correlation > LEAST_CORRELATION) & (np.abs(there.shift) < FARTHEST).all(axis=1)
        spacing = self.axes.spacing(middle)
        covariance = there.covariance * spacing[:, :, None] * spacing[:, None, :]
        matches = Matches(number, middle + there.shift * spacing, covariance, there.correlation)
        return matches.take(good), len(number)

    @property
    def _middle(self) -> Array:
        size = [len(self.axes.range_m), len(self.axes.bearing_rad)]
        return np.asarray((np.array(size, dtype=np.float64) - 1) / 2)

    @property
    def _half(self) -> Array:
        return np.asarray(self._middle - EDGE)

    def observe(self, keyframe: int, matches: Matches) -> None:
        """Store the observations of a keyframe, and drop landmarks that were missed too often."""
        views = np.full(len(matches.landmark), keyframe, dtype=np.intp)
        new = Observations(views, matches.landmark, matches.polar, matches.covariance)
        self.seen = Observations(*(np.concatenate(pair) for pair in zip(self.seen, new, strict=True)))
        self.missed += self.used
        self.missed[matches.landmark] = 0
        self.used &= self.missed < MISSED

    def give_up(self) -> None:
        """Stop searching for all current landmarks, because the map restarts."""
        self.used[:] = False

    def renew(self, image: PatchImage, view: Views, matches: Matches) -> None:
        """Cut new patches for landmarks whose appearance has changed since they were chosen."""
        old = matches.take(matches.correlation < STALE)
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
        """Return the offsets of the pixels of patches from their centres, on level ground ``(n, pixels, 2)`` [m]."""
        rows = np.broadcast_to(row, (len(middle), PIXELS))
        pixels = self.axes.polar(rows, np.broadcast_to(column, rows.shape)).reshape(-1, 2)
        ground = points_at(pixels, np.repeat(height, PIXELS), view, self.axes.bearing).reshape(-1, PIXELS, 3)
        return np.asarray((ground - points_at(middle, height, view, self.axes.bearing)[:, None])[..., :2])

    def choose(self, image: PatchImage, view: Views, keyframe: int, height_m: float) -> None:
        """Choose new landmarks where a keyframe shows none.

        Args:
            image: image of the keyframe.
            view: view from which it was taken.
            keyframe: number of the keyframe.
            height_m: initial height of the new landmarks over the ground [m], until more frames show them.
        """
        # 1. corners away from existing landmarks, with the patches around them
        row, column = corners(image, self._taken(view, keyframe))
        polar = self.axes.polar(row.astype(float), column.astype(float))
        rows, columns = row[:, None] + ROWS, column[:, None] + COLUMNS
        patches, good = cut(image, rows, columns)
        # 2. their points at the assumed height; those that cannot lie on that plane are left out
        height = np.full(len(row), height_m)
        points = points_at(polar, height, view, self.axes.bearing)
        offsets = self._offsets(polar, rows, columns, height, view)
        good &= np.isfinite(points).all(axis=1) & np.isfinite(offsets).all(axis=(1, 2))
        if not good.any():
            return
        # 3. append them to every column of the table, with a first observation that anchors each
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
        """Return the covariance of new points, from range and bearing and from the prior of heights."""
        by_point = projection_of(points, view, self.axes.bearing).by_point
        information = by_point.transpose(0, 2, 1) @ np.linalg.inv(covariance) @ by_point
        information[:, 2, 2] += 1 / HEIGHT_STD_M**2
        return np.asarray(np.linalg.inv(information))

    def _taken(self, view: Views, keyframe: int) -> NDArray[np.bool_]:
        """Return the cells ``(bins, beams)`` occupied by landmarks in use, or by landmarks that recently proved bad."""
        taken = np.zeros((len(self.axes.range_m), len(self.axes.bearing_rad)), dtype=bool)
        there = self.used | ((self.faults > BLOCKING) & (self.born > keyframe - 25))
        if there.any():
            place = np.rint(self.axes.cells(polar_of(self.points[there], view, self.axes.bearing)))
            place = place[((place >= 0) & (place < taken.shape)).all(axis=1)].astype(np.intp)
            taken[place[:, 0], place[:, 1]] = True
        return taken

    def refine(self, number: Index, points: Array, covariance: Array, faults: Array) -> None:
        """Update landmarks with the result of a bundle adjustment, and drop those that fit badly."""
        self.points[number], self.covariance[number], self.faults[number] = points, covariance, faults
        self.used[number] &= faults < FAULTY

    def forget(self, first_view: int) -> None:
        """Delete unused landmarks that no keyframe from ``first_view`` on shows, so that memory stays constant."""
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
        """Return the landmarks that constrain the keyframes from ``first_view`` on, and all observations of them.

        Args:
            first_view: number of the first keyframe.
            fewest: smallest number of keyframes that must show a landmark.
            born: first keyframe whose landmarks count, because the map restarted there.

        Returns:
            Indices of the landmarks ``(n,)``, and their observations, in which landmarks are numbered in this order.
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
    """Return the fractional index of values on an increasing axis, extrapolated linearly beyond its ends."""
    cell = np.interp(values, axis, np.arange(len(axis), dtype=float))
    low, high = (values - axis[0]) / (axis[1] - axis[0]), (values - axis[-1]) / (axis[-1] - axis[-2]) + len(axis) - 1
    return np.asarray(np.where(values < axis[0], low, np.where(values > axis[-1], high, cell)))


def _value(place: Array, axis: Array) -> Array:
    """Return the value at a fractional index on an axis, the inverse of :func:`_place`."""
    value = np.interp(place, np.arange(len(axis), dtype=float), axis)
    low, high = axis[0] + place * (axis[1] - axis[0]), axis[-1] + (place - len(axis) + 1) * (axis[-1] - axis[-2])
    return np.asarray(np.where(place < 0, low, np.where(place > len(axis) - 1, high, value)))


# ---------------- Local map


USED = "used"
"""Value of ``about["map"]`` of an estimate whose motion comes from the map; otherwise it holds the reason why not."""

FRAMES_A_READ = 16

WINDOW = 30
"""Number of keyframes whose poses are adjusted."""

STORED_KEYFRAMES = 60
"""Number of keyframes whose observations are stored; older ones show no landmark still in view."""

MOVED = np.array([10.0, 2.2])
"""Median displacement of the landmarks since the last keyframe that triggers a new one [bins, beams]."""

FEWEST_VIEWS = 3
"""Smallest number of keyframes that must show a landmark for it to be adjusted."""

LOST = 0.6
"""Fraction of the landmarks of the last keyframe below which a new keyframe is made."""

LOST_STD = np.array([0.05, 0.05, np.radians(1)])
"""Standard deviations of a prediction without a valid motion [m, m, rad]."""

WORST = 25.0
"""Squared normalised error beyond which a landmark does not count as shown by a keyframe."""

RELIEF_M = 0.1
LEAST_RELIEF_M = 0.02
"""Mean height of visible relief over the ground [m]: if first echoes do not determine it, and its lower bound."""

CONTRAST = 0.6
"""Mean height of landmarks, as a fraction of the relief found by first echoes, which come from the tops."""

ATTITUDE_STD = np.array([2e-4, np.radians(2e-3), np.radians(2e-3)])
"""Standard deviations of height [m], pitch and roll [rad] from recorded poses."""

ROUGH_STD = np.array([0.01, np.radians(0.3), np.radians(0.3)])
"""Standard deviations of height [m], pitch and roll [rad] without recorded poses: heave and tilt are then estimated."""

HEIGHT_FRAMES = 401
"""Number of frames among which the largest heights are those over the ground, not over a rock."""

SAFETY = 8.0
"""Ratio of actual to formal variance of the map, measured over rocks.

The normal equations assume independent errors, but the errors of patches are correlated.
"""


@dataclass
class _Map:
    """The state of the map that is carried from frame to frame.

    Attributes:
        landmarks: landmarks of the last metres.
        attitude_std: standard deviations of measured height [m], pitch and roll [rad] ``(3,)``.
        keyframes: frame number of each keyframe.
        poses: pose of each keyframe ``(6,)``.
        measured: measured height, pitch and roll of each keyframe ``(3,)``.
        begun: first keyframe since the map was last restarted.
        relief_m: mean height of visible relief over the ground [m].
        lean: adjusted minus measured height, pitch and roll of the last keyframe ``(3,)``.
        drift: covariance of x, y, heading that each keyframe adds ``(3, 3)``.
    """

    landmarks: Landmarks
    attitude_std: Array
    keyframes: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    measured: list[Array] = field(default_factory=list)
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
    """Estimate motions again, with a map of the last metres.

    The time per frame is constant, and so is the memory, apart from the result. The result depends only on the frames and
    the estimates, so that an interrupted run gives bit-identical results when repeated.

    Args:
        source: source of the frames, with heights and with pitches or poses.
        numbers: numbers of the frames used ``(n,)``.
        estimates: estimate of each pair of consecutive frames, which predicts where landmarks appear.
        progress: called with the number of frames processed since the last call.

    Returns:
        One estimate per motion; estimates that the map cannot replace keep their motions.

    Raises:
        MitsonarError: the height over the ground or the pitch is not known.
    """
    # 1. predict, register and update, frame by frame; a lean found by the last adjustment applies to the next frame too
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
    # 2. apply the adjustments of keyframes, which later frames improved, to the frames between them
    corrected = _corrected(np.array(path), state)
    refined = motions(corrected)
    drift = _drift_a_frame(state, len(path))
    return [_decided(one, refined[k], reasons[k + 1], drift[k + 1], corrected[k + 1]) for k, one in enumerate(estimates)]


# ---------------- Local map: prediction


def _axes(like: SonarFrames) -> ImageAxes:
    return ImageAxes(like.range_m, like.bearing_rad, like.sonar.bearing)


def map_attitudes(source: FrameSource, numbers: Index) -> tuple[Array, Array]:
    """Return height over the ground, pitch and roll of the frames, as poses ``(n, 6)``, and their standard deviations.

    The standard deviations ``(3,)`` are of height [m], pitch and roll [rad].

    Raises:
        MitsonarError: the height over the ground or the pitch is not known.
    """
    table = np.zeros((len(numbers), 6))
    heights = None if source.height_m is None else source.height_m[numbers]
    if heights is None or not np.isfinite(heights).any():
        raise MitsonarError(
            f"{source.name}: the local map needs the height over the ground, which the frames lack: give it, or "
            "leave the map out"
        )
    heights = np.where(np.isfinite(heights), heights, np.nanmedian(heights))
    if source.poses is not None and np.isfinite(source.poses[numbers, 2:5]).all():
        poses = source.poses[numbers]
        # over a rock, an altimeter measures less than the height over the ground: a low percentile of the ground's z
        ground = percentile_filter(poses[:, 2] - heights, 5, size=min(HEIGHT_FRAMES, len(heights)), mode="nearest")
        table[:, 2:5] = poses[:, 2:5]
        table[:, 2] -= ground
        table[0, 5] = poses[0, 5]
        return table, ATTITUDE_STD
    rise = 0.0 if source.rise_m is None else source.rise_m[numbers]
    table[:, 2] = rise + percentile_filter(heights - rise, 90, size=min(HEIGHT_FRAMES, len(heights)), mode="nearest")
    measured = None if source.attitude_rad is None else source.attitude_rad[numbers, :2]
    if source.pitch_rad is not None:
        table[:, 3] = source.pitch_rad
    elif measured is not None and np.isfinite(measured).all():
        table[:, 3:5] = measured
    else:
        raise MitsonarError(
            f"{source.name}: the local map needs the pitch of the sonar, which the frames lack: give it, or "
            "leave the map out"
        )
    return table, ROUGH_STD


def _images(source: FrameSource, numbers: Index) -> Iterator[tuple[SonarFrames, PatchImage]]:
    """Yield each frame with its image for patches; frames are read a few at a time."""
    for start in range(0, len(numbers), FRAMES_A_READ):
        frames = source.read(numbers[start : start + FRAMES_A_READ])
        values = frames.matching_values()
        for k in range(len(frames)):
            yield frames.select(slice(k, k + 1)), patch_image(values[k], coded=frames.level != "linear")


def _predicted(before: Array, estimate: Estimate, attitude: Array) -> Array:
    """Return the pose after a motion, with the measured height, pitch and roll."""
    pose = np.array(compose(Pose.from_row(float(value) for value in before), estimate.motion))
    pose[2:5] = attitude[2:5]
    return pose


def _spread(estimates: Sequence[Estimate], frame: int) -> Array:
    """Return the covariance of the predicted starboard, forward and heading of a frame ``(3, 3)``."""
    if frame == 0:
        return np.diag(PAIR_STD**2)
    one = estimates[frame - 1]
    if not one.valid:
        return np.diag(LOST_STD**2)
    known = np.diag((10 * PAIR_STD) ** 2) if one.covariance is None else np.asarray(one.covariance, dtype=float)
    return np.asarray(known + np.diag(PAIR_STD**2))


# ---------------- Local map: update


def _update(
    state: _Map,
    frame: int,
    frames: SonarFrames,
    image: PatchImage,
    answer: Registered,
    attitude: Array,
) -> Array:
    """Add a keyframe if the sonar has moved on, adjust the last ones, and return the pose of the frame."""
    # 1. a registered frame close to the last keyframe changes nothing; a frame that was not registered restarts the map
    if state.keyframes and not answer.reason and not _moved_on(state, answer):
        return answer.pose
    number, landmarks = len(state.keyframes), state.landmarks
    if answer.reason:
        landmarks.give_up()
        state.begun = number
    # 2. the new keyframe, with the drift of the one before until it is adjusted
    state.keyframes.append(frame)
    state.poses.append(answer.pose.copy())
    state.measured.append(attitude[2:5])
    state.drift.append(state.drift[-1] if state.drift else np.diag(PAIR_STD**2))
    # 3. store its observations, and adjust the window of keyframes
    good = answer.matches.take(answer.squared < WORST)
    if number and not answer.reason:
        landmarks.observe(number, good)
        landmarks.renew(image, Views.of(answer.pose), good)
        _adjust(state)
    # 4. choose new landmarks where it shows none, and delete old ones
    state.relief_m = _relief(frames, state.poses[-1], state.relief_m)
    view = Views.of(state.poses[-1])
    landmarks.choose(image, view, number, _usual_height(state))
    landmarks.forget(number - STORED_KEYFRAMES)
    return state.poses[-1].copy()


def _moved_on(state: _Map, answer: Registered) -> bool:
    """Return whether the landmarks of the last keyframe have moved far, or many of them are lost."""
    number = answer.matches.landmark
    if len(number) < max(FEWEST, LOST * int(state.landmarks.used.sum())):
        return bool(np.abs(answer.pose - state.poses[-1]).max() > 1e-6)
    axes, points = state.landmarks.axes, state.landmarks.points[number]
    current, previous = (
        axes.cells(polar_of(points, Views.of(pose), axes.bearing)) for pose in (answer.pose, state.poses[-1])
    )
    return bool((np.median(np.abs(current - previous), axis=0) > MOVED).any())


def _adjust(state: _Map) -> None:
    """Adjust the last keyframes and the landmarks that they show."""
    # 1. the keyframes of the window; the first one since the map restarted, and older ones that share landmarks, stay fixed
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
            np.array(state.measured[first:]),
            state.attitude_std,
            landmarks.points[number],
            seen._replace(view=seen.view - oldest),
            landmarks.axes.bearing,
            state.relief_m,
        )
    except LinAlgError:
        return  # the keyframes keep their registered poses
    # 2. take over the result
    landmarks.refine(number, new.points, new.point_covariance, new.faults)
    state.lean = new.poses[-1, 2:5] - state.measured[-1]
    state.poses[first:] = list(new.poses[first - oldest :])
    state.drift[-1] = _covariance_per_motion(new.last_covariance, np.array(state.poses[first - 1 :]))


def _covariance_per_motion(whole: Array, poses: Array) -> Array:
    """Return the covariance of one motion between poses ``(k, 6)``, of which equal ones add up to that of the last pose."""
    # a heading error of an early motion moves the last pose by its lever arm: remove the mean effect, and divide the rest
    lever = (poses[-1, :2] - poses[:-1, :2]).mean(axis=0)
    back = np.array([[1, 0, -lever[1]], [0, 1, lever[0]], [0, 0, 1]])
    return np.asarray(back @ whole @ back.T / (len(poses) - 1))


def _relief(frames: SonarFrames, pose: Array, before: float) -> float:
    """Return the mean height of visible relief over the ground [m], updated by first echoes if there are any."""
    attitude = attitude_of(frames, "the local map", float(pose[2]), float(pose[3]))
    if attitude.reason or attitude.first is None:
        return before
    measured = max(LEAST_RELIEF_M, CONTRAST * (float(pose[2]) - attitude.first.height_m))
    return 0.9 * before + 0.1 * measured


def _usual_height(state: _Map) -> float:
    """Return the height that is assumed for new landmarks [m]: the median of well-fitting ones, if there are enough."""
    known = state.landmarks.used & (state.landmarks.faults < 1.0)
    return float(np.median(state.landmarks.points[known, 2])) if known.sum() >= 4 * FEWEST else state.relief_m


# ---------------- Local map: decision


def _corrected(path: Array, state: _Map) -> Array:
    """Return the poses of all frames ``(n, 6)``: keyframes as last adjusted, and the frames between moved with them.

    A frame between two keyframes blends the corrections of both linearly.
    """
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
    """Return the covariance of x, y, heading that each frame adds ``(frames, 3, 3)``: an equal part of its keyframe's."""
    drift = np.zeros((frames, 3, 3))
    ends = [*state.keyframes[1:], frames - 1]
    for number, (start, end) in enumerate(zip(state.keyframes, ends, strict=True)):
        there = min(number + 1, len(state.drift) - 1)
        drift[start + 1 : end + 1] = SAFETY * state.drift[there] / max(end - start, 1)
    return drift


def _carried(path: Array, old: Array, new: Array) -> Array:
    """Move poses ``(n, 6)`` rigidly in the plane, by the displacement from pose ``old`` to pose ``new``."""
    turn = new[5] - old[5]
    sin, cos = np.sin(turn), np.cos(turn)
    x, y = (path[:, :2] - old[:2]).T
    moved = path.copy()
    moved[:, 0], moved[:, 1] = new[0] + cos * x + sin * y, new[1] - sin * x + cos * y
    moved[:, 5] += turn
    return moved


def _decided(estimate: Estimate, motion: Array, reason: str, drift: Array, pose: Array) -> Estimate:
    """Return an estimate with the motion of the map, or the original estimate with the reason why it is not used."""
    if reason:
        about = {**estimate.about, "map": reason}
        return replace(estimate, about=about)
    turn = np.eye(3)
    turn[:2, :2] = level_turn(float(pose[5]))
    return Estimate(Motion(*motion.tolist()), turn @ drift @ turn.T, True, "", {"map": USED})


# ---------------- Registration of a frame to landmarks


FEWEST = 12
"""Smallest number of landmarks with which a frame is registered."""

LEAST_MATCHED = 0.5
"""Smallest fraction of the landmarks in view that a frame must show. The fraction is about 0.9 without noise, and 0.2 with
pixel noise that hides the ground."""

ROUNDS, STILL = 8, 1e-6
"""Largest number of Gauss-Newton iterations of a registration, and the step below which they end [m, rad]."""

PAIR_SHARE = 0.1
PAIR_STD = np.array([1e-3, 1e-3, np.radians(0.03)])
"""Fraction of the information of the motion between two frames that enters a registration, since the map has seen the same
frames; and the smallest standard deviations of that motion [m, m, rad]."""

GATE = 16.0
"""Squared normalised error beyond which a landmark is rejected as similar-looking noise."""

ASTRAY = 25.0
"""Squared normalised distance of the registered pose from the prediction beyond which the registration is rejected."""


@dataclass(frozen=True)
class Registered:
    """Result of registering a frame to the map.

    Attributes:
        pose: pose of the frame ``(6,)`` [m, rad].
        matches: landmarks found in the frame.
        squared: squared normalised error of each of them ``(n,)``.
        reason: why the result is not used; empty if it is.
    """

    pose: Array
    matches: Matches
    squared: Array
    reason: str = ""


def registered(landmarks: Landmarks, image: PatchImage, expected: Array, spread: Array) -> Registered:
    """Find the landmarks in a frame, and the pose of the sonar that fits their places.

    Only x, y and heading are estimated; height, pitch and roll stay as predicted.

    Args:
        landmarks: landmarks of the map.
        image: image of the frame.
        expected: predicted pose ``(6,)`` [m, rad].
        spread: covariance of starboard, forward [m], heading [rad] of the prediction ``(3, 3)``.
    """
    # 1. find the landmarks, and leave out those that the uncertainty of the prediction does not explain
    turn = np.eye(3)
    turn[:2, :2] = level_turn(expected[5])
    predicted = turn.T @ spread @ turn
    matches, shown = landmarks.find(image, Views.of(expected))
    matches = matches.take(_residuals(landmarks, matches, expected, predicted).squared < GATE)
    pose, prior = expected.copy(), PAIR_SHARE * np.linalg.inv(predicted)
    needed = max(FEWEST, int(LEAST_MATCHED * shown))
    if len(matches.landmark) < needed:
        few = f"the map finds {len(matches.landmark)} of {shown} landmarks, {needed} are needed"
        return Registered(pose, matches, np.zeros(len(matches.landmark)), few)
    # 2. Gauss-Newton with robust weights, and with the prediction as a weak prior
    for _ in range(ROUNDS):
        residuals = _residuals(landmarks, matches, pose, None)
        weight = cauchy(residuals.squared) * track_weight(landmarks.faults[matches.landmark])
        weighted = residuals.by_pose.transpose(0, 2, 1) @ (residuals.inverse * weight[:, None, None])
        normal = (weighted @ residuals.by_pose).sum(axis=0) + prior
        rhs = (weighted @ residuals.error[:, :, None])[:, :, 0].sum(axis=0) - prior @ (pose - expected)[PLANAR]
        step = np.linalg.solve(normal, rhs)
        pose[PLANAR] += step
        if np.abs(step).max() < STILL:
            break
    # 3. reject a pose that contradicts the prediction
    off = (pose - expected)[PLANAR]
    if off @ np.linalg.solve(predicted, off) > ASTRAY:
        return Registered(
            expected, matches, residuals.squared, "the map and the motion between two frames contradict each other"
        )
    return Registered(pose, matches, residuals.squared)


class _Residuals(NamedTuple):
    """Residuals of landmarks at a pose.

    Attributes:
        error: observed minus predicted range [m] and bearing [rad] ``(n, 2)``.
        inverse: inverse covariances of the errors ``(n, 2, 2)``.
        squared: squared normalised errors ``(n,)``.
        by_pose: derivatives of the predictions by x, y, heading ``(n, 2, 3)``.
    """

    error: Array
    inverse: Array
    squared: Array
    by_pose: Array


def _residuals(landmarks: Landmarks, matches: Matches, pose: Array, predicted: Array | None) -> _Residuals:
    """Return the residuals of found landmarks at a pose, whose covariance ``predicted`` enters theirs if it is given."""
    projected = projection_of(landmarks.points[matches.landmark], Views.of(pose), landmarks.axes.bearing)
    error, by_pose = matches.polar - projected.polar, projected.by_pose[:, :, PLANAR]
    covariance = landmarks.covariance[matches.landmark]
    spread = matches.covariance + projected.by_point @ covariance @ projected.by_point.transpose(0, 2, 1)
    if predicted is not None:
        spread = spread + by_pose @ predicted @ by_pose.transpose(0, 2, 1)
    inverse = np.asarray(np.linalg.inv(spread), dtype=np.float64)
    return _Residuals(error, inverse, np.einsum("ni,nij,nj->n", error, inverse, error), by_pose)


def level_turn(heading: float) -> Array:
    """Return the matrix that rotates world x, y into starboard, forward ``(2, 2)``."""
    sin, cos = np.sin(heading), np.cos(heading)
    return np.array([[cos, -sin], [sin, cos]])
