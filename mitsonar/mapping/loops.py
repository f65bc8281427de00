"""How places that the sonar sees again are found and closed as loops.

Frames are drawn as coarse views of the ground from above (:class:`Canvas`), and :func:`likenesses` correlates two of them.
:func:`search_loops` uses them to find candidates along a path, and checks each by registration.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import AnyEstimator, Estimate
from mitsonar.geometry.ground import GroundView, attitude_of, fan_places
from mitsonar.mapping.pairs import EstimateStore, estimate_motions
from mitsonar.mapping.pose_graph import GraphSolution, PoseEdges, motion_derivatives, relative_motions
from mitsonar.mapping.series import ErrorCorrelation
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import Motion, MotionPrior, compose
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import SonarFrames

__all__ = [
    "Canvas",
    "CoarseView",
    "LoopSearch",
    "ViewMatch",
    "canvas_of",
    "match_views",
    "search_loops",
]


Array = NDArray[np.float64]
Floats = NDArray[np.float32]

CELLS_A_REACH = 45
"""Number of cells of a coarse view per horizontal distance to its middle."""

LOCAL = 4.0
"""Standard deviation of the high-pass filter of a view [cells]: slower variation is illumination, not ground."""

FEWEST_CELLS = 8
"""Smallest number of rows and of columns of a canvas."""

LEAST_OVERLAP = 0.35
"""Smallest fraction of a view that the other view must show too."""

RIVAL_CELLS = 6
"""Distance from the best shift beyond which another shift counts as another place [cells]."""


@dataclass(frozen=True)
class Canvas:
    """The common grid of ground ahead of the sonar on which all frames of a run are drawn, whatever their heights.

    Attributes:
        view: view of the frame that defines this ground, with cells of some centimetres.
    """

    view: GroundView

    @classmethod
    def of(cls, frame: SonarFrames) -> Self | None:
        """Make the canvas of a run from one of its frames; return None if the frame shows no ground.

        Raises:
            MitsonarError: the frame has no height or pitch.
        """
        attitude = attitude_of(frame, "a search for loops", None, None)
        reach = GroundView(frame, attitude, 1.0).reach
        middle = (reach[2] + reach[3]) / 2
        if attitude.reason or not middle > 0:
            return None
        canvas = cls(GroundView(frame, attitude, middle / CELLS_A_REACH))
        return canvas if min(canvas.view.points.shape[:2]) >= FEWEST_CELLS else None

    @property
    def reach_m(self) -> float:
        """Return the horizontal distance from the sonar to the middle of the ground in view [m]."""
        return (self.view.reach[2] + self.view.reach[3]) / 2

    @property
    def extent_m(self) -> float:
        """Return the shorter edge of the ground in view [m]."""
        left, right, near, far = self.view.reach
        return min(right - left, far - near)

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Return the size of the Fourier transforms, large enough that shifted views do not wrap around."""
        rows, columns, _ = self.view.points.shape
        return cv2.getOptimalDFTSize(2 * rows), cv2.getOptimalDFTSize(2 * columns)

    def draw(self, frame: SonarFrames) -> CoarseView | None:
        """Draw a frame by its height and attitude, without its illumination; None if unknown, or with too little ground."""
        # 1. where each cell of the canvas lies in the frame; the height or attitude may be unknown
        try:
            attitude = attitude_of(frame, "a search for loops", None, None)
        except MitsonarError:
            return None
        if attitude.reason:
            return None
        row, column, shown = fan_places(attitude.ground(frame), frame.sonar, self.view.points)
        inside = shown.astype(np.float32)
        if inside.sum() < FEWEST_CELLS**2:
            return None
        # 2. resample, smoothed to the size of a cell against aliasing
        bins = self.view.edge / float(np.median(np.diff(frame.range_m)))
        smooth = cv2.GaussianBlur(frame.matching_values()[0], (0, 0), sigmaX=0.5, sigmaY=max(0.4 * bins, 0.3))
        image = cv2.remap(np.asarray(smooth, dtype=np.float32), column, row, cv2.INTER_LINEAR)
        # 3. subtract the local mean, which removes illumination, and normalise to unit variance
        weight = cv2.GaussianBlur(inside, (0, 0), LOCAL) + 1e-6
        image = np.asarray((image - cv2.GaussianBlur(image * inside, (0, 0), LOCAL) / weight) * inside, dtype=np.float32)
        spread = float(np.sqrt((image**2).sum() / inside.sum()))
        return None if spread <= 0 else CoarseView(np.asarray(image / spread, dtype=np.float32), inside, self)


@dataclass(frozen=True)
class CoarseView:
    """A frame as seen from above, without its illumination, in cells of some centimetres.

    Attributes:
        image: normalised image, of mean 0 inside and 0 elsewhere ``(rows, columns)``.
        inside: 1 where the sonar sees ground, else 0 ``(rows, columns)``.
        canvas: canvas on which the frame is drawn.
    """

    image: Floats
    inside: Floats
    canvas: Canvas

    @cached_property
    def transforms(self) -> tuple[NDArray[np.complexfloating], ...]:
        """Return the conjugate spectra of the image, of its square and of its mask ``inside``."""
        parts = (self.image, self.image * self.image, self.inside)
        return tuple(np.conj(np.fft.rfft2(part, self.canvas.shape)) for part in parts)


class ViewMatch(NamedTuple):
    """The correlation of two views where they overlap, after a motion between them."""

    motion: Motion
    correlation: float


def match_views(first: CoarseView, second: CoarseView, yaws: Array, expected: Array, window: Array) -> list[ViewMatch]:
    """Return the motions at which two views correlate best, with the largest correlation first.

    Each yaw contributes the best shift, and the best shift at another place.

    Args:
        first: earlier view.
        second: later view, on the same canvas.
        yaws: turns to try [rad] ``(n,)``.
        expected: sideways, forward [m] of the expected motion, the centre of the search ``(2,)``.
        window: half width of the search, sideways and forward [m] ``(2,)``; the larger one applies to both.
    """
    matches = []
    for yaw in yaws:
        motion = Motion(float(expected[0]), float(expected[1]), float(yaw))
        matches += _best_shifts(first, second, motion, window)
    return sorted(matches, key=lambda one: -one.correlation)


def _best_shifts(first: CoarseView, second: CoarseView, motion: Motion, window: Array) -> list[ViewMatch]:
    """Return the two best motions with the yaw of ``motion``, by masked correlation over all shifts (Padfield, 2012)."""
    canvas, reach = first.canvas, first.canvas.reach_m
    # 1. turn the second view about its middle, so that it stays on the canvas; the correlation finds the shift
    turned = Motion(-reach * float(np.sin(motion.yaw)), reach * (float(np.cos(motion.yaw)) - 1), motion.yaw)
    warp = canvas.view.warp(turned)
    expected = np.linalg.solve(warp[:, :2], canvas.view.warp(motion)[:, 2] - warp[:, 2])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = first.image.shape[::-1]
    image, inside = (
        np.asarray(cv2.warpAffine(part, warp, size, flags=flags), dtype=np.float32) for part in (second.image, second.inside)
    )
    # 2. sums over the overlap, at every shift: number of cells, product, sums and squares of both images
    spectra = [np.fft.rfft2(part, canvas.shape) for part in (image, image * image, inside)]
    spectrum, squared, mask = first.transforms
    overlap, product, first_sum, second_sum, first_squares, second_squares = (
        np.fft.irfft2(a * b, canvas.shape)
        for a, b in (
            (mask, spectra[2]),
            (spectrum, spectra[0]),
            (spectrum, spectra[2]),
            (mask, spectra[0]),
            (squared, spectra[2]),
            (mask, spectra[1]),
        )
    )
    # 3. the correlation coefficient over the overlap
    count = np.maximum(overlap, 1.0)
    spread = np.maximum(first_squares - first_sum**2 / count, 0) * np.maximum(second_squares - second_sum**2 / count, 0)
    correlation = (product - first_sum * second_sum / count) / np.sqrt(spread + 1e-6 * count**2)
    # 4. only shifts within the window, with enough overlap
    rows, columns = (np.fft.fftfreq(n, 1 / n) for n in canvas.shape)
    edge = canvas.view.edge
    farthest = max(float(np.max(window)) / edge, 1.0)
    allowed = (np.abs(rows - expected[1]) <= farthest)[:, None] & (np.abs(columns - expected[0]) <= farthest)[None]
    allowed = allowed & (overlap >= LEAST_OVERLAP * float(first.inside.sum()))
    # 5. the best shift, then the best one away from it: the caller needs a rival to detect ambiguity
    best: list[ViewMatch] = []
    while allowed.any() and len(best) < 2:
        row, column = np.unravel_index(int(np.where(allowed, correlation, -2).argmax()), canvas.shape)
        shifted = warp.astype(float)
        shifted[:, 2] += shifted[:, :2] @ [columns[column], rows[row]]
        best.append(ViewMatch(canvas.view.motion(shifted), float(correlation[row, column])))
        near = (np.abs(rows - rows[row]) < RIVAL_CELLS)[:, None] & (np.abs(columns - columns[column]) < RIVAL_CELLS)[None]
        allowed &= ~near
    return best


# ---------------- Loop closure: search

Index = NDArray[np.intp]

SPACING = 0.07
"""Displacement of the ground through the window from one keyframe to the next, as a fraction of the reach."""

APART = 2.0
"""Smallest distance travelled between the two frames of a loop, in extents of the ground in view.

Closer frames overlap anyway, as neighbours do.
"""

GATE = 3.0
"""Number of standard deviations of the path within which the same place is searched for."""

MOST_COMPARED = 24
WIDEST_TURN = np.radians(60)
TURN_STEP = np.radians(3)
"""Largest number of keyframes to compare with one, largest turn to either side, and step between turns [rad]."""

OVERLAP = 0.6
"""Largest distance between the middles of the ground in two views, in extents, at which the views can match."""

LEAST_CORRELATION = 0.5
"""Smallest correlation of two views of one place; views of different places reach 0.45 over rocks."""

RIVAL = 0.85
"""Fraction of the best correlation at which another place makes the match ambiguous."""

SAME_PLACE = 0.12
"""Distance within which two matches mean the same place, as a fraction of the reach."""

ASTRAY_CELLS, ASTRAY_RAD = 3.0, np.radians(4)
"""How far a registration may end from the motion found by appearance [cells, rad]."""

WITNESS = 0.4
"""Distance from a lone loop to the frame that is registered to confirm it, in distances between keyframes."""

NEIGHBOURS = 6
"""Number of keyframes within which loops confirm each other."""

AGREEING_STD, AGREEING_FRACTION, AGREEING_M = 3.0, 0.03, 0.005
"""Largest difference of two neighbouring loops: standard deviations of both, fraction of the distance between them, [m]."""


@dataclass(frozen=True)
class LoopSearch:
    """Result of a search for loops.

    Attributes:
        loops: frames of each loop, with its motion and covariance.
        group: index of the stretch of the path to which each loop belongs ``(loops,)``.
        compared: number of pairs of keyframes whose views were compared.
        rejected: number of candidates that did not become loops, by reason.
    """

    loops: PoseEdges
    group: Index
    compared: int
    rejected: Counter[str]

    def outvoted(self, accepted: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return whether each loop is in a stretch where fewer than two, or no majority, were accepted ``(loops,)``."""
        votes, voters = np.bincount(self.group, accepted), np.bincount(self.group)
        return np.asarray(((votes < 2) | (2 * votes <= voters))[self.group])


class _Candidate(NamedTuple):
    """A possible loop: an earlier frame, a later keyframe, and the motion between them by appearance."""

    first: int
    second: int
    motion: Motion


@dataclass(frozen=True)
class _Searched:
    """A path with its covariances, keyframes and their views.

    Attributes:
        covariances: marginal covariances of the poses ``(frames, 3, 3)``.
        solution: solution of the pose graph without loops.
        keys: frames that are keyframes ``(keyframes,)``.
        views: view of each keyframe that shows ground.
        travelled: distance that the ground has moved through the window ``(frames,)`` [m].
        canvas: canvas of all views.
    """

    covariances: Array
    solution: GraphSolution
    keys: Index
    views: dict[int, CoarseView]
    travelled: Array
    canvas: Canvas

    @property
    def poses(self) -> Array:
        """Return x, y [m] and heading [rad] along the path ``(frames, 3)``."""
        return self.solution.poses

    @property
    def reach(self) -> float:
        """Return the horizontal distance from the sonar to the middle of the ground in view [m]."""
        return self.canvas.reach_m

    @property
    def extent(self) -> float:
        """Return the shorter edge of the ground in view [m]."""
        return self.canvas.extent_m

    @property
    def cell(self) -> float:
        """Return the edge of a cell of the views [m]."""
        return self.canvas.view.edge


def canvas_of(source: FrameSource) -> Canvas | None:
    """Return the canvas on which the frames of a source are compared; None if none of five frames shows ground."""
    for number in np.unique(np.linspace(0, len(source) - 1, 5).astype(np.intp)):
        frame = source.read([number])
        try:
            canvas = None if frame.poses is None else Canvas.of(frame)
        except MitsonarError:  # no height
            canvas = None
        if canvas is not None:
            return canvas
    return None


def search_loops(
    source: FrameSource,
    estimator: AnyEstimator,
    numbers: Index,
    store: EstimateStore,
    solution: GraphSolution,
    errors: ErrorCorrelation,
    canvas: Canvas,
) -> LoopSearch:
    """Search a path for loops, by appearance and registration.

    Keyframes are compared if the covariance of the path allows that they show the same ground. A candidate must correlate
    well enough, and better than any other possible place. The estimator then registers the two frames, starting from the
    motion found by appearance. A loop counts only if a neighbouring loop agrees with it; the pose graph is the last check.

    Args:
        source: source of the frames.
        estimator: registers two frames, with the motion found by appearance as prior.
        numbers: numbers of the frames used ``(frames,)``.
        store: registrations of an earlier run, to which new ones are added.
        solution: solution of the pose graph without loops.
        errors: correlation of errors over the same ground, by which neighbouring loops count as fewer.
        canvas: canvas from :func:`canvas_of`.

    Raises:
        MitsonarError: frames cannot be read, or lack height or pitch.
    """
    # 1. choose keyframes and draw their views
    searched = _searched(source, numbers, solution, canvas)
    register = _Register(source, estimator, numbers, searched, store)
    # 2. for each keyframe: one unambiguous place by appearance, confirmed by registration
    rejected: Counter[str] = Counter()
    compared, registered = 0, []
    for second in (int(one) for one in searched.keys if int(one) in searched.views):
        matches, tried = _matches(searched, second)
        compared += tried
        reason, candidate = _unambiguous(searched, second, matches)
        if candidate is not None:
            estimate = register(candidate)
            reason = _astray(estimate, candidate.motion, searched)
            registered += [] if reason else [(candidate, estimate)]
        rejected[reason] += bool(reason)
    # 3. keep loops that a neighbour or a new witness confirms
    loops = [loop for one in registered for loop in _with_witness(one, registered, register)]
    rejected["no neighbouring loop agrees"] += len(registered) - sum(one in registered for one in loops)
    edges = _edges(sorted(loops, key=lambda one: one[0].second), searched, errors)
    # 4. group loops by stretches of the path, within which they later vote
    travelled = searched.travelled[edges.second]
    group = np.cumsum(np.diff(travelled, prepend=travelled[:1]) > NEIGHBOURS * SPACING * searched.reach).astype(np.intp)
    return LoopSearch(edges, group, compared, +rejected)


def _searched(source: FrameSource, numbers: Index, solution: GraphSolution, canvas: Canvas) -> _Searched:
    """Choose keyframes at equal displacements of the ground in view, and draw their views."""
    poses, reach = solution.poses, canvas.reach_m
    moved = relative_motions(poses, np.arange(len(poses) - 1), np.arange(1, len(poses)))
    displacement = np.hypot(moved[:, 0] + reach * moved[:, 2], moved[:, 1])
    travelled = np.concatenate([[0.0], np.cumsum(displacement)])
    keys = np.unique(np.searchsorted(travelled, np.arange(0, travelled[-1] + 1e-9, SPACING * reach)))
    keys = np.unique(np.append(keys, len(poses) - 1)).astype(np.intp)
    drawn = {int(key): canvas.draw(source.read([numbers[key]])) for key in keys}
    views = {key: view for key, view in drawn.items() if view is not None}
    covariances, _ = solution.covariances()
    return _Searched(covariances, solution, keys, views, travelled, canvas)


# ---------------- Loop closure: appearance


def _matches(searched: _Searched, second: int) -> tuple[list[tuple[int, ViewMatch]], int]:
    """Return the matches of a keyframe with earlier ones that may show the same ground, and how many were compared."""
    # 1. earlier keyframes far enough back along the path
    apart = searched.travelled[second] - searched.travelled[searched.keys] >= APART * searched.extent
    earlier = np.array(
        [key for key in searched.keys[apart & (searched.keys < second)] if int(key) in searched.views], np.intp
    )
    if not earlier.size:
        return [], 0
    # 2. distance between the middles of the ground in both views, in the axes of the later frame, and its uncertainty
    motions, covariances = _relative(searched, earlier, second)
    middle = np.array([0.0, searched.reach])
    sin, cos = np.sin(motions[:, 2]), np.cos(motions[:, 2])
    off = np.column_stack([-sin, cos]) * middle[1] - motions[:, :2] - middle
    spread = np.sqrt(np.trace(covariances[:, :2, :2], axis1=1, axis2=2) + searched.reach**2 * covariances[:, 2, 2])
    # 3. those that may overlap within the uncertainty, the most probable first
    distance = np.linalg.norm(off, axis=1) - GATE * spread
    order = np.argsort(np.linalg.norm(off, axis=1) / (searched.extent + spread), kind="stable")
    chosen = order[distance[order] <= OVERLAP * searched.extent][:MOST_COMPARED]
    # 4. correlate the views over the turns and shifts that the uncertainty allows
    matches = []
    for place in chosen:
        std = np.sqrt(np.diag(covariances[place]))
        turns = _turns(float(motions[place, 2]), float(std[2]))
        window = np.minimum(GATE * std[:2], 2 * searched.extent)
        first = int(earlier[place])
        views = searched.views[first], searched.views[second]
        matches += [(first, one) for one in match_views(*views, turns, motions[place, :2], window)]
    return matches, len(chosen)


def _turns(expected: float, std: float) -> Array:
    """Return the turns to try [rad], within :data:`GATE` standard deviations of the expected one."""
    count = int(np.ceil(min(GATE * std, WIDEST_TURN) / TURN_STEP))
    return np.asarray(expected + TURN_STEP * np.arange(-count, count + 1))


def _relative(searched: _Searched, first: Index, second: int) -> tuple[Array, Array]:
    """Return the motions from earlier frames to a later one along the path ``(n, 3)``, and their covariances."""
    cross = searched.solution.columns([second])[first, :, 0]
    others = np.full(len(first), second)
    by_first, by_second = motion_derivatives(searched.poses, first, others)
    both = by_first @ cross @ by_second.swapaxes(1, 2)
    covariances = by_first @ searched.covariances[first] @ by_first.swapaxes(1, 2) + both + both.swapaxes(1, 2)
    covariances = covariances + by_second @ searched.covariances[others] @ by_second.swapaxes(1, 2)
    return relative_motions(searched.poses, first, others), covariances


def _unambiguous(searched: _Searched, second: int, matches: list[tuple[int, ViewMatch]]) -> tuple[str, _Candidate | None]:
    """Return the one candidate of a keyframe; or why there is none, with an empty reason if no view matches."""
    if not matches:
        return "", None
    first, best = max(matches, key=lambda one: one[1].correlation)
    if best.correlation < LEAST_CORRELATION:
        return "", None
    place = _middle_of(_composed(searched.poses[first], best.motion), searched.reach)
    for other, one in matches:
        there = _middle_of(_composed(searched.poses[other], one.motion), searched.reach)
        if one.correlation > RIVAL * best.correlation and np.hypot(*(there - place)) > SAME_PLACE * searched.reach:
            return "two places look similar", None
    return "", _nearest(searched, first, second, best.motion)


def _nearest(searched: _Searched, key: int, second: int, motion: Motion) -> _Candidate:
    """Return the candidate from the frame near a keyframe for which the motion is smallest."""
    # all frames within two keyframes: a smaller motion leaves more overlap for the registration
    place = int(np.searchsorted(searched.keys, key))
    begin, end = searched.keys[max(0, place - 2)], searched.keys[min(len(searched.keys) - 1, place + 2)]
    there = np.vstack([searched.poses[begin : end + 1], _composed(searched.poses[key], motion)])
    count = len(there) - 1
    motions = relative_motions(there, np.arange(count), np.full(count, count))
    least = int(np.argmin(np.linalg.norm(motions * [1, 1, searched.reach], axis=1)))
    return _Candidate(int(begin) + least, second, Motion(*(float(value) for value in motions[least])))


def _composed(pose: Array, motion: Motion) -> Array:
    """Return x, y, heading of a pose after a motion (eq. 3.4)."""
    after = compose(Pose.from_row((pose[0], pose[1], 0.0, 0.0, 0.0, pose[2])), motion)
    return np.array([after.x, after.y, after.heading])


def _middle_of(pose: Array, reach: float) -> Array:
    """Return x, y of the middle of the ground in view from a pose [m]."""
    return np.array([pose[0] + reach * np.sin(pose[2]), pose[1] + reach * np.cos(pose[2])])


# ---------------- Loop closure: registration


@dataclass(frozen=True)
class _Register:
    """Registration of two frames from the motion found by appearance, or by looking up the result of an earlier run."""

    source: FrameSource
    estimator: AnyEstimator
    numbers: Index
    searched: _Searched
    store: EstimateStore

    def __call__(self, candidate: _Candidate) -> Estimate:
        pair = int(self.numbers[candidate.first]), int(self.numbers[candidate.second])
        estimate = self.store.loops.get((*pair, candidate.motion))
        if estimate is None:
            cell = self.searched.cell
            prior = MotionPrior(candidate.motion, np.diag([cell**2, cell**2, TURN_STEP**2]))
            estimate = estimate_motions(self.source, self.estimator, pair, priors=[prior])[0]
            self.store.add_loop(*pair, candidate.motion, estimate)
        return estimate


def _astray(estimate: Estimate, motion: Motion, searched: _Searched) -> str:
    """Return why a registration is rejected as a loop; empty if it is accepted."""
    if not estimate.valid:
        return "the registration is invalid"
    off = np.abs(np.asarray(estimate.motion) - np.asarray(motion))
    far = (off[:2] > ASTRAY_CELLS * searched.cell).any() or off[2] > ASTRAY_RAD
    return "the registration ends elsewhere than appearance" if far else ""


_Loop = tuple[_Candidate, Estimate]


def _with_witness(one: _Loop, others: list[_Loop], register: _Register) -> list[_Loop]:
    """Return a loop that a neighbour confirms; a lone loop together with a new one that confirms it; or nothing."""
    searched = register.searched
    neighbours = [other for other in others if other is not one and _is_neighbour(one, other, searched)]
    if any(_same_place(one, other, searched) for other in neighbours):
        return [one]
    for candidate in () if neighbours else _witnesses(one, searched):
        estimate = register(candidate)
        witness = candidate, estimate
        if not _astray(estimate, candidate.motion, searched) and _same_place(one, witness, searched):
            return [one, witness]
    return []


def _is_neighbour(one: _Loop, other: _Loop, searched: _Searched) -> bool:
    """Return whether the later frames of two loops are neighbouring keyframes."""
    distance = abs(searched.travelled[other[0].second] - searched.travelled[one[0].second])
    return bool(distance <= NEIGHBOURS * SPACING * searched.reach)


def _witnesses(one: _Loop, searched: _Searched) -> list[_Candidate]:
    """Return candidates for the same loop from frames slightly before and after the later one, smaller motion first."""
    candidate, estimate = one
    there = _composed(searched.poses[candidate.first], estimate.motion)
    travelled, candidates = searched.travelled, []
    for off in (-WITNESS, WITNESS):
        other = int(np.searchsorted(travelled, travelled[candidate.second] + off * SPACING * searched.reach))
        if 0 < other < len(travelled) and other != candidate.second:
            onward = relative_motions(searched.poses, [candidate.second], [other])[0]
            ends = np.array([searched.poses[candidate.first], _composed(there, Motion(*onward.tolist()))])
            candidates.append(_Candidate(candidate.first, other, Motion(*relative_motions(ends, [0], [1])[0].tolist())))
    return sorted(candidates, key=lambda each: float(np.hypot(each.motion.sideways, each.motion.forward)))


def _same_place(one: _Loop, other: _Loop, searched: _Searched) -> bool:
    """Return whether two loops agree: with the path between their later frames, both predict the same pose."""
    # 1. both predictions of the later frame of the second loop, and their difference
    poses = searched.poses
    by_one = _composed(poses[one[0].first], one[1].motion)
    by_other = _composed(poses[other[0].first], other[1].motion)
    onward = relative_motions(poses, [one[0].second], [other[0].second])[0]
    there = _composed(by_one, Motion(*onward.tolist()))
    off = np.abs(relative_motions(np.array([by_other, there]), [0], [1])[0])
    # 2. the limit allows for the errors of both registrations and for the drift of the path between them
    variance = np.diag(_covariance_of(one[1], searched) + _covariance_of(other[1], searched))
    travelled = searched.travelled[[one[0].second, other[0].second]]
    limit = AGREEING_STD * np.sqrt([variance[:2].sum(), variance[2]])
    limit += (AGREEING_FRACTION * float(np.ptp(travelled)) + AGREEING_M) * np.array([1, 1 / searched.reach])
    return bool(np.hypot(off[0], off[1]) <= limit[0] and off[2] <= limit[1])


def _covariance_of(estimate: Estimate, searched: _Searched) -> Array:
    """Return the covariance of a registration; without one, that of the match by appearance."""
    rough = np.diag([searched.cell**2, searched.cell**2, TURN_STEP**2])
    return rough if estimate.covariance is None else np.asarray(estimate.covariance, dtype=float)


def _edges(loops: list[_Loop], searched: _Searched, errors: ErrorCorrelation) -> PoseEdges:
    """Return loops as edges of a pose graph, whose errors are independent.

    Errors of neighbouring loops are correlated. Their covariances are inflated, so that the covariance of their mean is
    right.
    """
    if not loops:
        return PoseEdges.none()
    motions = np.array([one.motion for _, one in loops], dtype=float)
    known = [_covariance_of(one, searched) for _, one in loops]
    # errors in proportion to the motion, which registrations do not report
    slopes = errors.along(np.vstack([motions, motions[:1]]), searched.reach).slope_std
    scaled = (motions**2) @ (slopes**2).T
    # the mean of a first-order chain with correlation r has (1 + r) / (1 - r) times the variance of independent errors
    correlation = errors.share * np.exp(-SPACING / errors.length)
    covariances = (1 + correlation) / (1 - correlation) * (np.array(known) + scaled[:, None] * np.eye(3))
    first, second = (np.array([place[k] for place, _ in loops], dtype=np.intp) for k in (0, 1))
    return PoseEdges(first, second, motions, covariances)
