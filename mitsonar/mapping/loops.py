"""Appearance of the ground in frames, for finding places again: coarse views from above, and where two of them are alike."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import AnyEstimator, Estimate
from mitsonar.estimation.image.phase import GroundView, fan_places
from mitsonar.geometry.ground import attitude_of
from mitsonar.mapping.pairs import estimate_motions
from mitsonar.mapping.pose_graph import GraphSolution, PoseEdges, motion_derivatives, relative_motions
from mitsonar.mapping.series import ErrorCorrelation
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import Motion, MotionPrior, compose
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import SonarFrames

__all__ = [
    "Canvas",
    "CoarseView",
    "KeepLoop",
    "KnownLoops",
    "Likeness",
    "LoopSearch",
    "canvas_of",
    "likenesses",
    "search_loops",
]


Array = NDArray[np.float64]
Floats = NDArray[np.float32]

CELLS_A_REACH = 45
"""Cells of a coarse view over the horizontal distance to its middle."""

LOCAL = 4.0
"""Standard deviation over which the level of a view is taken out [cells]: what is slower is light, not ground."""

FEWEST_CELLS = 8
"""Fewest rows and columns of a canvas."""

LEAST_OVERLAP = 0.35
"""Least part of a view that another must show too."""

RIVAL_CELLS = 6
"""Distance from the best shift at which another one counts as another place [cells]."""


@dataclass(frozen=True)
class Canvas:
    """The ground before the sonar on which all frames of a run are drawn, whatever their heights.

    Attributes:
        view: the frame that decides which ground that is, with cells of some centimetres.
    """

    view: GroundView

    @classmethod
    def of(cls, frame: SonarFrames) -> Self | None:
        """Make the canvas of a run from one of its frames; None where it shows no ground.

        Raises:
            MitsonarError: no height or pitch.
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
        """Return the horizontal distance from the sonar to the middle of the ground that it sees [m]."""
        return (self.view.reach[2] + self.view.reach[3]) / 2

    @property
    def extent_m(self) -> float:
        """Return the shorter edge of the ground that it sees [m]."""
        left, right, near, far = self.view.reach
        return min(right - left, far - near)

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Return the size of transforms in which a shifted view does not wrap around."""
        rows, columns, _ = self.view.points.shape
        return cv2.getOptimalDFTSize(2 * rows), cv2.getOptimalDFTSize(2 * columns)

    def draw(self, frame: SonarFrames) -> CoarseView | None:
        """Draw one frame by its own height and attitude, without its light; None where it is known to show none."""
        try:
            own = attitude_of(frame, "a search for loops", None, None)
        except MitsonarError:
            return None
        if own.reason:
            return None
        row, column, shown = fan_places(own.ground(frame), frame.sonar, self.view.points)
        inside = shown.astype(np.float32)
        if inside.sum() < FEWEST_CELLS**2:
            return None
        bins = self.view.edge / float(np.median(np.diff(frame.range_m)))
        smooth = cv2.GaussianBlur(frame.matching_values()[0], (0, 0), sigmaX=0.5, sigmaY=max(0.4 * bins, 0.3))
        image = cv2.remap(np.asarray(smooth, dtype=np.float32), column, row, cv2.INTER_LINEAR)
        weight = cv2.GaussianBlur(inside, (0, 0), LOCAL) + 1e-6
        image = np.asarray((image - cv2.GaussianBlur(image * inside, (0, 0), LOCAL) / weight) * inside, dtype=np.float32)
        spread = float(np.sqrt((image**2).sum() / inside.sum()))
        return None if spread <= 0 else CoarseView(np.asarray(image / spread, dtype=np.float32), inside, self)


@dataclass(frozen=True)
class CoarseView:
    """A frame as seen from above, without its light, in cells of some centimetres.

    Attributes:
        image: mean 0 where inside, 0 elsewhere ``(rows, columns)``.
        inside: 1 where the sonar sees ground, else 0 ``(rows, columns)``.
        canvas: on which it is drawn.
    """

    image: Floats
    inside: Floats
    canvas: Canvas

    @cached_property
    def transforms(self) -> tuple[NDArray[np.complexfloating], ...]:
        """Return the conjugate spectra of the image, its square and its inside."""
        parts = (self.image, self.image * self.image, self.inside)
        return tuple(np.conj(np.fft.rfft2(part, self.canvas.shape)) for part in parts)


class Likeness(NamedTuple):
    """How alike two views are after a motion: their correlation where they overlap."""

    motion: Motion
    correlation: float


def likenesses(first: CoarseView, second: CoarseView, yaws: Array, expected: Array, window: Array) -> list[Likeness]:
    """Return where two views are most alike: for each yaw the best shift, and the best one at another place.

    The most alike come first.

    Args:
        first: the earlier view.
        second: the later one, on the same canvas.
        yaws: turns that are tried [rad] ``(n,)``.
        expected: sideways, forward [m] of the motion, around which is searched ``(2,)``.
        window: half width of the search, sideways and forward [m] ``(2,)``; the larger counts.
    """
    found = []
    for yaw in yaws:
        motion = Motion(float(expected[0]), float(expected[1]), float(yaw))
        found += _best_shifts(first, second, motion, window)
    return sorted(found, key=lambda one: -one.correlation)


def _best_shifts(first: CoarseView, second: CoarseView, motion: Motion, window: Array) -> list[Likeness]:
    """Return the best motions with the yaw of ``motion``, by the masked correlation of Padfield (2012) over all shifts."""
    canvas, reach = first.canvas, first.canvas.reach_m
    # turned about its middle, a view stays on the canvas; shifts do the rest
    turned = Motion(-reach * float(np.sin(motion.yaw)), reach * (float(np.cos(motion.yaw)) - 1), motion.yaw)
    warp = canvas.view.warp(turned)
    expected = np.linalg.solve(warp[:, :2], canvas.view.warp(motion)[:, 2] - warp[:, 2])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = first.image.shape[::-1]
    image, inside = (
        np.asarray(cv2.warpAffine(part, warp, size, flags=flags), dtype=np.float32) for part in (second.image, second.inside)
    )
    spectra = [np.fft.rfft2(part, canvas.shape) for part in (image, image * image, inside)]
    one, squared, there = first.transforms
    overlap, product, own, others, own_squared, others_squared = (
        np.fft.irfft2(a * b, canvas.shape)
        for a, b in (
            (there, spectra[2]),
            (one, spectra[0]),
            (one, spectra[2]),
            (there, spectra[0]),
            (squared, spectra[2]),
            (there, spectra[1]),
        )
    )
    count = np.maximum(overlap, 1.0)
    spread = np.maximum(own_squared - own**2 / count, 0) * np.maximum(others_squared - others**2 / count, 0)
    correlation = (product - own * others / count) / np.sqrt(spread + 1e-6 * count**2)
    rows, columns = (np.fft.fftfreq(n, 1 / n) for n in canvas.shape)
    edge = canvas.view.edge
    farthest = max(float(np.max(window)) / edge, 1.0)
    allowed = (np.abs(rows - expected[1]) <= farthest)[:, None] & (np.abs(columns - expected[0]) <= farthest)[None]
    allowed = allowed & (overlap >= LEAST_OVERLAP * float(first.inside.sum()))
    found: list[Likeness] = []
    while allowed.any() and len(found) < 2:
        row, column = np.unravel_index(int(np.where(allowed, correlation, -2).argmax()), canvas.shape)
        shifted = warp.astype(float)
        shifted[:, 2] += shifted[:, :2] @ [columns[column], rows[row]]
        found.append(Likeness(canvas.view.motion(shifted), float(correlation[row, column])))
        near = (np.abs(rows - rows[row]) < RIVAL_CELLS)[:, None] & (np.abs(columns - columns[column]) < RIVAL_CELLS)[None]
        allowed &= ~near
    return found


# ---------------- Loop closures: places that a sonar sees again, found by appearance and checked by registration
# Keyframes are compared where the covariance of the path allows that they show the same ground. A candidate must be
# alike enough, and more so than any other place that is possible. Then the estimator registers two frames from there. A
# loop counts only if others beside it agree with it; the pose graph is the last check.

Index = NDArray[np.intp]

SPACING = 0.07
"""Way of the ground through the window from one keyframe to the next, as a part of the reach."""

APART = 2.0
"""Way between the two frames of a loop at least, in extents of the ground seen: nearer frames overlap as neighbours do."""

GATE = 3.0
"""Standard deviations of the path within which the same place is looked for."""

MOST_COMPARED = 24
WIDEST_TURN = np.radians(60)
TURN_STEP = np.radians(3)
"""Most keyframes with which one is compared, largest turn to either side, and step of the turns that are tried."""

OVERLAP = 0.6
"""Distance of the middles of the grounds seen, in extents, within which frames can be alike."""

LEAST_LIKE = 0.5
"""Least correlation of two views of one place: those of other places reach 0.45 over rocks."""

RIVAL = 0.85
"""A place whose correlation reaches this part of the best one's makes it ambiguous."""

SAME_PLACE = 0.12
"""Distance within which two likenesses mean one place, as a part of the reach."""

ASTRAY_CELLS, ASTRAY_RAD = 3.0, np.radians(4)
"""How far a registration may end from where appearance began it."""

WITNESS = 0.4
"""Distance of a lone loop from a frame that is registered as its witness, in those of keyframes."""

NEIGHBOURS = 6
"""Keyframes within which loops check each other."""

AGREEING_STD, AGREEING_WAY, AGREEING_M = 3.0, 0.03, 0.005
"""By how much two loops beside each other may differ: in standard deviations of both, of the way between them, and [m]."""

KnownLoops = Mapping[tuple[int, int, Motion], Estimate]
KeepLoop = Callable[[int, int, Motion, Estimate], None]
"""Registrations by the numbers of their frames in the source, and the motion from which they begin."""


@dataclass(frozen=True)
class LoopSearch:
    """What was found.

    Attributes:
        loops: frames of each loop, its motion and covariance.
        group: number of the stretch of the path to which each loop belongs ``(loops,)``.
        compared: pairs of keyframes whose views were compared.
        rejected: candidates that did not become loops, by reason.
    """

    loops: PoseEdges
    group: Index
    compared: int
    rejected: Counter[str]

    def outvoted(self, kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which loops belong to a stretch where fewer than two, or not most, were kept ``(loops,)``."""
        votes, voters = np.bincount(self.group, kept), np.bincount(self.group)
        return np.asarray(((votes < 2) | (2 * votes <= voters))[self.group])


class _Candidate(NamedTuple):
    """A later keyframe at an earlier frame: their numbers, and the motion between them by appearance."""

    first: int
    second: int
    motion: Motion


@dataclass(frozen=True)
class _Searched:
    """A path, its covariances, and the views of its keyframes."""

    own: Array
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
        """Return the horizontal distance from the sonar to the middle of the ground that it sees [m]."""
        return self.canvas.reach_m

    @property
    def extent(self) -> float:
        """Return the shorter edge of the ground that it sees [m]."""
        return self.canvas.extent_m

    @property
    def cell(self) -> float:
        """Return the edge of a cell of the views [m]."""
        return self.canvas.view.edge


def canvas_of(source: FrameSource) -> Canvas | None:
    """Return the ground before the sonar on which frames are compared; None where no frame is known to show any."""
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
    solution: GraphSolution,
    errors: ErrorCorrelation,
    canvas: Canvas,
    *,
    known: KnownLoops | None = None,
    keep: KeepLoop = lambda first, second, motion, estimate: None,
) -> LoopSearch:
    """Search a path for loops.

    Args:
        source: of the frames.
        estimator: registers two frames; it is given where appearance has them.
        numbers: of the frames used ``(frames,)``.
        solution: of the pose graph without loops.
        errors: how errors over the same ground depend on each other: loops side by side count as fewer.
        canvas: of :func:`canvas_of`.
        known: registrations of an earlier run.
        keep: called with each new one.

    Raises:
        MitsonarError: frames that cannot be read, or that tell no height or pitch.
    """
    searched = _searched(source, numbers, solution, canvas)
    register = _Register(source, estimator, numbers, searched, known or {}, keep)
    rejected: Counter[str] = Counter()
    compared, found = 0, []
    for second in (int(one) for one in searched.keys if int(one) in searched.views):
        alike, tried = _alike(searched, second)
        compared += tried
        reason, candidate = _unambiguous(searched, second, alike)
        if candidate is not None:
            estimate = register(candidate)
            reason = _astray(estimate, candidate.motion, searched)
            found += [] if reason else [(candidate, estimate)]
        rejected[reason] += bool(reason)
    loops = [loop for one in found for loop in _with_witness(one, found, register)]
    rejected["no other loop beside it agrees"] += len(found) - sum(one in found for one in loops)
    edges = _edges(sorted(loops, key=lambda one: one[0].second), searched, errors)
    way = searched.travelled[edges.second]
    group = np.cumsum(np.diff(way, prepend=way[:1]) > NEIGHBOURS * SPACING * searched.reach).astype(np.intp)
    return LoopSearch(edges, group, compared, +rejected)


def _searched(source: FrameSource, numbers: Index, solution: GraphSolution, canvas: Canvas) -> _Searched:
    """Choose keyframes, and draw their views."""
    poses, reach = solution.poses, canvas.reach_m
    moved = relative_motions(poses, np.arange(len(poses) - 1), np.arange(1, len(poses)))
    way = np.hypot(moved[:, 0] + reach * moved[:, 2], moved[:, 1])
    travelled = np.concatenate([[0.0], np.cumsum(way)])
    keys = np.unique(np.searchsorted(travelled, np.arange(0, travelled[-1] + 1e-9, SPACING * reach)))
    keys = np.unique(np.append(keys, len(poses) - 1)).astype(np.intp)
    drawn = {int(key): canvas.draw(source.read([numbers[key]])) for key in keys}
    views = {key: view for key, view in drawn.items() if view is not None}
    own, _ = solution.covariances()
    return _Searched(own, solution, keys, views, travelled, canvas)


# ---------------------------------------------------------------- appearance


def _alike(searched: _Searched, second: int) -> tuple[list[tuple[int, Likeness]], int]:
    """Return the likenesses of a keyframe with earlier ones that may show the same ground, and how many were compared."""
    apart = searched.travelled[second] - searched.travelled[searched.keys] >= APART * searched.extent
    earlier = np.array(
        [key for key in searched.keys[apart & (searched.keys < second)] if int(key) in searched.views], np.intp
    )
    if not earlier.size:
        return [], 0
    motions, covariances = _relative(searched, earlier, second)
    middle = np.array([0.0, searched.reach])
    sin, cos = np.sin(motions[:, 2]), np.cos(motions[:, 2])
    off = np.column_stack([-sin, cos]) * middle[1] - motions[:, :2] - middle
    spread = np.sqrt(np.trace(covariances[:, :2, :2], axis1=1, axis2=2) + searched.reach**2 * covariances[:, 2, 2])
    distance = np.linalg.norm(off, axis=1) - GATE * spread
    order = np.argsort(np.linalg.norm(off, axis=1) / (searched.extent + spread), kind="stable")
    chosen = order[distance[order] <= OVERLAP * searched.extent][:MOST_COMPARED]
    found = []
    for place in chosen:
        std = np.sqrt(np.diag(covariances[place]))
        turns = _turns(float(motions[place, 2]), float(std[2]))
        window = np.minimum(GATE * std[:2], 2 * searched.extent)
        first = int(earlier[place])
        views = searched.views[first], searched.views[second]
        found += [(first, one) for one in likenesses(*views, turns, motions[place, :2], window)]
    return found, len(chosen)


def _turns(expected: float, std: float) -> Array:
    """Return the turns that are tried [rad]."""
    count = int(np.ceil(min(GATE * std, WIDEST_TURN) / TURN_STEP))
    return np.asarray(expected + TURN_STEP * np.arange(-count, count + 1))


def _relative(searched: _Searched, first: Index, second: int) -> tuple[Array, Array]:
    """Return the motions from earlier frames to a later one by the path ``(n, 3)``, and their covariances."""
    cross = searched.solution.columns([second])[first, :, 0]
    others = np.full(len(first), second)
    by_first, by_second = motion_derivatives(searched.poses, first, others)
    both = by_first @ cross @ by_second.swapaxes(1, 2)
    covariances = by_first @ searched.own[first] @ by_first.swapaxes(1, 2) + both + both.swapaxes(1, 2)
    covariances = covariances + by_second @ searched.own[others] @ by_second.swapaxes(1, 2)
    return relative_motions(searched.poses, first, others), covariances


def _unambiguous(searched: _Searched, second: int, alike: list[tuple[int, Likeness]]) -> tuple[str, _Candidate | None]:
    """Return the only place that a keyframe may be at; or why there is none, empty where none is alike."""
    if not alike:
        return "", None
    first, best = max(alike, key=lambda one: one[1].correlation)
    if best.correlation < LEAST_LIKE:
        return "", None
    place = _middle_of(_composed(searched.poses[first], best.motion), searched.reach)
    for other, one in alike:
        there = _middle_of(_composed(searched.poses[other], one.motion), searched.reach)
        if one.correlation > RIVAL * best.correlation and np.hypot(*(there - place)) > SAME_PLACE * searched.reach:
            return "two places are alike", None
    return "", _nearest(searched, first, second, best.motion)


def _nearest(searched: _Searched, key: int, second: int, motion: Motion) -> _Candidate:
    """Return the frame around a keyframe from which the motion is smallest."""
    place = int(np.searchsorted(searched.keys, key))
    begin, end = searched.keys[max(0, place - 2)], searched.keys[min(len(searched.keys) - 1, place + 2)]
    there = np.vstack([searched.poses[begin : end + 1], _composed(searched.poses[key], motion)])
    count = len(there) - 1
    ways = relative_motions(there, np.arange(count), np.full(count, count))
    least = int(np.argmin(np.linalg.norm(ways * [1, 1, searched.reach], axis=1)))
    return _Candidate(int(begin) + least, second, Motion(*(float(value) for value in ways[least])))


def _composed(pose: Array, motion: Motion) -> Array:
    """Return x, y, heading after a motion (eq. 3.4)."""
    after = compose(Pose.from_row((pose[0], pose[1], 0.0, 0.0, 0.0, pose[2])), motion)
    return np.array([after.x, after.y, after.heading])


def _middle_of(pose: Array, reach: float) -> Array:
    """Return where the middle of the ground seen from a pose lies [m]."""
    return np.array([pose[0] + reach * np.sin(pose[2]), pose[1] + reach * np.cos(pose[2])])


# ---------------------------------------------------------------- registration


@dataclass(frozen=True)
class _Register:
    """Registers two frames from where appearance has them, or looks up what an earlier run found."""

    source: FrameSource
    estimator: AnyEstimator
    numbers: Index
    searched: _Searched
    known: KnownLoops
    keep: KeepLoop

    def __call__(self, candidate: _Candidate) -> Estimate:
        pair = int(self.numbers[candidate.first]), int(self.numbers[candidate.second])
        estimate = self.known.get((*pair, candidate.motion))
        if estimate is None:
            cell = self.searched.cell
            prior = MotionPrior(candidate.motion, np.diag([cell**2, cell**2, TURN_STEP**2]))
            estimate = estimate_motions(self.source, self.estimator, pair, priors=[prior])[0]
            self.keep(*pair, candidate.motion, estimate)
        return estimate


def _astray(estimate: Estimate, motion: Motion, searched: _Searched) -> str:
    """Return why a registration is no loop; empty where it is one."""
    if not estimate.valid:
        return "the registration is invalid"
    off = np.abs(np.asarray(estimate.motion) - np.asarray(motion))
    far = (off[:2] > ASTRAY_CELLS * searched.cell).any() or off[2] > ASTRAY_RAD
    return "the registration ends elsewhere than appearance" if far else ""


_Found = tuple[_Candidate, Estimate]


def _with_witness(one: _Found, found: list[_Found], register: _Register) -> list[_Found]:
    """Return a loop if another beside it puts it at the same place; a lone one with a new one as its witness; or none."""
    searched = register.searched
    beside = [other for other in found if other is not one and _is_beside(one, other, searched)]
    if any(_same_place(one, other, searched) for other in beside):
        return [one]
    for candidate in () if beside else _witnesses(one, searched):
        estimate = register(candidate)
        witness = candidate, estimate
        if not _astray(estimate, candidate.motion, searched) and _same_place(one, witness, searched):
            return [one, witness]
    return []


def _is_beside(one: _Found, other: _Found, searched: _Searched) -> bool:
    """Return whether two loops are of neighbouring keyframes."""
    way = abs(searched.travelled[other[0].second] - searched.travelled[one[0].second])
    return bool(way <= NEIGHBOURS * SPACING * searched.reach)


def _witnesses(one: _Found, searched: _Searched) -> list[_Candidate]:
    """Return the same loop from later frames a little before and after, the smaller motion first."""
    candidate, estimate = one
    there = _composed(searched.poses[candidate.first], estimate.motion)
    way, found = searched.travelled, []
    for off in (-WITNESS, WITNESS):
        other = int(np.searchsorted(way, way[candidate.second] + off * SPACING * searched.reach))
        if 0 < other < len(way) and other != candidate.second:
            onward = relative_motions(searched.poses, [candidate.second], [other])[0]
            ends = np.array([searched.poses[candidate.first], _composed(there, Motion(*onward.tolist()))])
            found.append(_Candidate(candidate.first, other, Motion(*relative_motions(ends, [0], [1])[0].tolist())))
    return sorted(found, key=lambda each: float(np.hypot(each.motion.sideways, each.motion.forward)))


def _same_place(one: _Found, other: _Found, searched: _Searched) -> bool:
    """Return whether two loops agree: by the path between their later frames both lead to one pose."""
    poses = searched.poses
    by_one = _composed(poses[one[0].first], one[1].motion)
    by_other = _composed(poses[other[0].first], other[1].motion)
    onward = relative_motions(poses, [one[0].second], [other[0].second])[0]
    there = _composed(by_one, Motion(*onward.tolist()))
    off = np.abs(relative_motions(np.array([by_other, there]), [0], [1])[0])
    variance = np.diag(_covariance_of(one[1], searched) + _covariance_of(other[1], searched))
    way = searched.travelled[[one[0].second, other[0].second]]
    limit = AGREEING_STD * np.sqrt([variance[:2].sum(), variance[2]])
    limit += (AGREEING_WAY * float(np.ptp(way)) + AGREEING_M) * np.array([1, 1 / searched.reach])
    return bool(np.hypot(off[0], off[1]) <= limit[0] and off[2] <= limit[1])


def _covariance_of(estimate: Estimate, searched: _Searched) -> Array:
    """Return the covariance of a registration; that of its appearance where it tells none."""
    rough = np.diag([searched.cell**2, searched.cell**2, TURN_STEP**2])
    return rough if estimate.covariance is None else np.asarray(estimate.covariance, dtype=float)


def _edges(found: list[_Found], searched: _Searched, errors: ErrorCorrelation) -> PoseEdges:
    """Return loops as edges. Errors of loops side by side are alike: they are made larger, so that their mean is honest."""
    if not found:
        return PoseEdges.none()
    motions = np.array([one.motion for _, one in found], dtype=float)
    known = [_covariance_of(one, searched) for _, one in found]
    slopes = errors.of(np.vstack([motions, motions[:1]]), searched.reach).slope_std
    scaled = (motions**2) @ (slopes**2).T
    alike = errors.share * np.exp(-SPACING / errors.length)
    covariances = (1 + alike) / (1 - alike) * (np.array(known) + scaled[:, None] * np.eye(3))
    first, second = (np.array([place[k] for place, _ in found], dtype=np.intp) for k in (0, 1))
    return PoseEdges(first, second, motions, covariances)
