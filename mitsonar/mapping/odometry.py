"""How the frames of a run become a path.

:func:`odometry` selects the frames, estimates the motion of each pair of consecutive frames, resolves ambiguous motions,
scales, bridges or smooths the motions, and composes them into a path (Almanza-Medina, eq. 3.4). With vehicle sensors or loop
closures, a pose graph replaces the composition. :func:`closure_of` measures quality without ground truth, and
:func:`height_profile` collects the height of the sonar over the ground along the path.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument, counted, nearest_names
from mitsonar.estimation.estimator import AnyEstimator, Estimate
from mitsonar.estimation.named import EstimatorLike, create_estimator
from mitsonar.mapping.graph_odometry import GraphPath, LoopTask, errors_along, graph_path
from mitsonar.mapping.local_map import USED, map_attitudes, mapped
from mitsonar.mapping.loops import KeepLoop, KnownLoops, canvas_of
from mitsonar.mapping.open_source import Source
from mitsonar.mapping.pairs import continued, estimate_motions
from mitsonar.mapping.pose_graph import CorrelatedErrors
from mitsonar.mapping.series import (
    MotionSeries,
    fit_scale,
    kalman_smoothed,
    path_of,
    pose_covariances,
    scaled,
    spline_smoothed,
)
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import AXES, assess, in_units, motion_errors, path_length
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import VehicleSensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

__all__ = [
    "ALTIMETER",
    "FIRST_ECHOES",
    "Closure",
    "HeightProfile",
    "Odometry",
    "Row",
    "Smoothing",
    "bridged",
    "closure_of",
    "height_profile",
    "loop_starts",
    "odometry",
    "series_of",
]


# ---------------- Closure: quality without ground truth


Array = NDArray[np.float64]
Index = NDArray[np.intp]

FEWEST = 2
"""Smallest number of loops from which errors are estimated."""


@dataclass(frozen=True)
class Closure:
    """Residuals of short loops: ``steps`` single motions composed, minus the motion over all of them estimated at once.

    Attributes:
        steps: number of motions per loop.
        residuals: residual of each loop ``(loops, 3)``: sideways, forward [m], yaw [rad].
        factor: factor by which the covariances of the single motions must be multiplied to explain the residuals; at least
            1. nan if the covariances are not known.
    """

    steps: int
    residuals: Array
    factor: float

    @property
    def rms(self) -> Array:
        """Return the root mean square of the residuals ``(3,)`` [m, m, rad]."""
        return np.asarray(np.sqrt((self.residuals**2).mean(axis=0)))

    @property
    def mean(self) -> Array:
        """Return the mean of the residuals ``(3,)`` [m, m, rad]: the bias of the composed single steps."""
        return np.asarray(self.residuals.mean(axis=0))

    def honest(self, estimates: Sequence[Estimate]) -> list[Estimate]:
        """Return the estimates with covariances that explain the residuals.

        Covariances are multiplied by ``factor``. An estimate without a covariance gets the mean square of the residuals
        divided by ``steps + 1``: the single motions of a loop and the motion over all of them contribute equal parts.
        """
        share = np.diag((self.residuals**2).mean(axis=0) / (self.steps + 1))
        factor = self.factor if np.isfinite(self.factor) else 1.0
        known = [np.asarray(one.covariance) * factor if one.covariance is not None else share for one in estimates]
        return [replace(one, covariance=covariance) for one, covariance in zip(estimates, known, strict=True)]


def closure_of(
    source: Source,
    estimator: AnyEstimator,
    numbers: Index,
    estimates: Sequence[Estimate],
    steps: int,
    progress: Callable[[int], None] = lambda pairs: None,
) -> Closure | None:
    """Compare composed single motions with motions that are estimated over several steps at once.

    Loops follow one another without overlap, so that their errors are independent. In a short run they overlap to give 16
    loops, or as many as fit.

    Args:
        source: source of the records.
        estimator: estimator that produced the single steps.
        numbers: numbers of the frames used ``(frames,)``.
        estimates: estimates of the single steps ``(frames - 1,)``.
        steps: number of motions per loop.
        progress: called with the number of loops processed, including those that are skipped.

    Returns:
        The closure; None if fewer than two loops have valid motions throughout.
    """
    valid = np.array([one.valid for one in estimates], dtype=bool)
    residuals, explained = [], []
    for start in (int(one) for one in loop_starts(len(estimates), steps)):
        # a loop with an invalid single motion has no composition to compare
        if not valid[start : start + steps].all():
            progress(1)
            continue
        # estimate the motion from the first to the last frame of the loop directly
        ends = np.array([numbers[start], numbers[start + steps]])
        whole = estimate_motions(source, estimator, ends)[0]
        progress(1)
        if not whole.valid:
            continue
        # residual: composed motion minus direct motion
        parts = list(estimates[start : start + steps])
        residual = _composed(np.array([one.motion for one in parts])) - np.asarray(whole.motion)
        residuals.append(residual)
        # normalised squared residual per degree of freedom: 1 on average if the covariances are right
        covariances = [one.covariance for one in (*parts, whole) if one.covariance is not None]
        if len(covariances) == steps + 1:
            total = np.sum(np.array(covariances), axis=0)
            explained.append(float(residual @ np.linalg.solve(total, residual)) / 3)
    if len(residuals) < FEWEST:
        return None
    factor = max(1.0, float(np.mean(explained))) if len(explained) == len(residuals) else float("nan")
    return Closure(steps, np.array(residuals), factor)


def loop_starts(motions: int, steps: int) -> Index:
    """Return the first motion of each loop of ``steps`` motions ``(loops,)``, in a run of ``motions`` motions."""
    stride = max(1, min(steps, (motions - steps) // 15 if motions > steps else 1))
    return np.arange(0, motions - steps + 1, stride, dtype=np.intp)


def _composed(motions: Array) -> Array:
    """Compose consecutive motions ``(steps, 3)`` to one motion ``(3,)`` in the axes of the last heading (eq. 3.4)."""
    heading = np.cumsum(motions[:, 2])
    turn = heading[-1] - heading
    sideways = motions[:, 0] * np.cos(turn) - motions[:, 1] * np.sin(turn)
    forward = motions[:, 0] * np.sin(turn) + motions[:, 1] * np.cos(turn)
    return np.array([sideways.sum(), forward.sum(), heading[-1]])


# ---------------- Height over the ground along a path


FIRST_ECHOES, ALTIMETER = "first echoes", "altimeter"
"""Possible sources of a measured height."""


@dataclass(frozen=True)
class HeightProfile:
    """Heights of the sonar over the ground along a path; nan where no height was measured.

    Attributes:
        frames: frame numbers in the source ``(frames,)``.
        distance_m: horizontal distance travelled along the path ``(frames,)`` [m].
        places: x, y of the ground to which the height refers ``(frames, 2)`` [m]. First echoes come from ground ahead of
            the sonar.
        height_m: height of the sonar over that ground ``(frames,)`` [m].
        std_m: standard deviation of the height ``(frames,)`` [m]; nan for an altimeter, which reports none.
        by: :data:`FIRST_ECHOES` or :data:`ALTIMETER` ``(frames,)``; empty where no height was measured.
        ground_z_m: z of that ground in the coordinates of the path ``(frames,)`` [m]; nan if z is not measured.
        ground_depth_m: depth of that ground below the surface ``(frames,)`` [m]; nan without a depth sensor.
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
        """Return a CSV table with one line per frame; unknown values are empty cells."""
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

    A height that an estimator measured from first echoes takes precedence over the height recorded with the frame. A height
    given by the user does not count as a measurement.

    Args:
        source: source of the records.
        frames: numbers of the frames used ``(n,)``.
        estimates: estimate of each pair of consecutive frames; ``about`` may hold ``height_m`` and ``height_std_m``,
            measured from first echoes.
        sensors: sensors of the vehicle, if any.
        path: poses at the frames.
    """
    # 1. heights: estimates belong to pairs, so each frame takes the mean of its two pairs; the altimeter fills the rest
    poses = path.poses
    height, std = (_at_frames(np.array([_told(one, name) for one in estimates])) for name in ("height_m", "height_std_m"))
    echoes = np.isfinite(height)
    altimeter = _altimeter(source, frames)
    height = np.where(echoes, height, altimeter)
    # 2. the ground measured: straight below for an altimeter, where the steepest rays land for first echoes
    ahead = np.where(echoes, _ahead(source, frames, height), 0.0)
    places = poses[:, :2] + ahead[:, None] * np.column_stack([np.sin(poses[:, 5]), np.cos(poses[:, 5])])
    places[np.isnan(height)] = np.nan
    # 3. z of the ground needs a measured z of the sonar: odometry alone keeps its height constant
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
    """Return a value measured from first echoes, by its name in ``about``; nan if there is none."""
    return float(estimate.about[name]) if "height_std_m" in estimate.about else np.nan


def _at_frames(of_pairs: Array) -> Array:
    """Return the mean of the finite values of the pairs before and after each frame ``(frames,)``."""
    both = np.stack([np.append(of_pairs, np.nan), np.append(np.nan, of_pairs)])
    known = np.isfinite(both)
    count = known.sum(axis=0)
    return np.where(count > 0, np.where(known, both, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def _altimeter(source: Source, frames: Index) -> Array:
    """Return the heights recorded with the frames ``(frames,)`` [m]; nan where unknown, given by the user or assumed."""
    if source.height_m is None or (isinstance(source, FrameSource) and source.assumed_height):
        return np.full(len(frames), np.nan)
    heights = np.asarray(source.height_m[frames], dtype=float)
    given = np.nan if source.told_height_m is None else source.told_height_m
    return np.where(heights == given, np.nan, heights)


def _ahead(source: Source, frames: Index, height_m: Array) -> Array:
    """Return how far ahead of the sonar its steepest rays meet the ground, averaged over the beams ``(frames,)`` [m]."""
    attitudes = source.attitudes(frames) if isinstance(source, FrameSource) else None
    if not isinstance(source, FrameSource) or attitudes is None:
        return np.zeros(len(frames))
    steepest = attitudes[:, 3] + np.radians(source.like.sonar.elevation_fov_deg) / 2
    return np.asarray(height_m / np.tan(steepest) * float(np.cos(source.like.bearing_rad).mean()))


# ---------------- Odometry

Row = tuple[str, float, str]
"""Name, value and unit of a result."""

Smoothing = Literal["none", "spline", "kalman"]

MANY = 0.1
"""Fraction of invalid motions above which the user is warned that much of the path is interpolated."""


@dataclass(frozen=True)
class Odometry:
    """An estimated path together with everything from which it was computed.

    Attributes:
        frames: numbers of the frames used, in their source ``(frames,)``.
        estimates: estimate of each pair of consecutive frames.
        series: motions of the path after scaling, bridging or smoothing, with covariances if known.
        path: poses at the times of the frames.
        true: true poses of the sonar at all frames of the source, if known.
        smooth: how the motions were smoothed.
        factors: factors that multiplied the estimates, for sideways, forward, yaw ``(3,)``.
        fitted: whether these factors were fitted to the true path.
        heights: heights over the ground along the path.
        closure: residuals of short loops of motions, if requested.
        graph: solution of the pose graph, if sensors or loops were requested.
        correlated: how errors of motions over the same ground are correlated; None to use the correlation stored in
            ``series``, if any.
    """

    frames: Index
    estimates: list[Estimate]
    series: MotionSeries
    path: Trajectory
    true: Trajectory | None
    smooth: Smoothing
    factors: Array
    fitted: bool
    heights: HeightProfile
    closure: Closure | None = None
    graph: GraphPath | None = None
    correlated: CorrelatedErrors | None = None

    @property
    def believed(self) -> NDArray[np.bool_]:
        """Return whether each motion is valid ``(frames - 1,)``; invalid motions were bridged."""
        return np.array([estimate.valid for estimate in self.estimates], dtype=bool)

    @property
    def true_at_frames(self) -> Trajectory | None:
        """Return the true path at the frames used; None if it is not known."""
        return None if self.true is None else Trajectory(self.true.poses[self.frames], self.true.time_s[self.frames])

    @cached_property
    def pose_covariances(self) -> Array | None:
        """Return the covariances of x, y [m] and heading [rad] along the path ``(frames, 3, 3)``.

        Errors of motions over the same ground are correlated as
        :class:`~mitsonar.mapping.series.ErrorCorrelation` describes, except for motions from the local map. Errors of
        smoothed motions, and of records that do not show the ground, are taken as independent. With sensors or loops the
        covariances are the marginals of the pose graph. None if the covariances of the motions are not known.
        """
        if self.graph is not None:
            return self.graph.covariances
        if self.series.covariances is None:
            return None
        by_map = np.array([one.about.get("map") == USED for one in self.estimates], dtype=bool)
        return pose_covariances(self.series, Pose.from_row(self.path.poses[0]), correlated=self.correlated, alone=by_map)

    def rows(self) -> list[Row]:
        """Return name, value and unit of every result, as shown on the console, in the files and in the README."""
        count = len(self.estimates)
        rows: list[Row] = [("motions", count, ""), ("motions rejected, bridged", count - int(self.believed.sum()), "")]
        by_map = [one.about["map"] for one in self.estimates if "map" in one.about]
        if by_map:
            rows.append(("motions by the local map", by_map.count(USED), ""))
        how = "fitted to the true path" if self.fitted else "as given"
        if self.fitted or (self.factors != 1).any():
            rows += [(f"scale of {axis.name}, {how}", float(f), "") for axis, f in zip(AXES, self.factors, strict=True)]
        if self.series.covariances is not None:
            std = np.sqrt(np.diagonal(self.series.covariances, axis1=1, axis2=2).mean(axis=0))
            rows += _by_axis("standard deviation of a motion as told", in_units(std))
        if self.closure is not None:
            rows += _by_axis(f"closure over {self.closure.steps} motions, rms", in_units(self.closure.rms))
            rows += _by_axis(f"closure over {self.closure.steps} motions, mean", in_units(self.closure.mean))
        true = self.true_at_frames
        rows += [] if self.graph is None else self.graph.rows(true)
        if self.true is None or true is None:
            return [*rows, ("estimated path length", path_length(self.path), "m")]
        errors = motion_errors(self.series.motions, motions(true.poses), np.ones(count, dtype=bool), self.series.covariances)
        rows += _by_axis("motion error RMSE", errors.rmse)
        rows += _by_axis("RMSE of always answering zero", errors.zero)
        rows += [(f"slope over the true {axis.name}", float(s), "") for axis, s in zip(AXES, errors.slope, strict=True)]
        if np.isfinite(errors.nees):
            rows.append(("NEES (1 is honest)", errors.nees, ""))
        return rows + [(name, float(value), unit) for name, value, unit in assess(self.path, self.true).rows()]

    def warnings(self) -> list[str]:
        """Return warnings for the user: many motions invalid or not from the map, doubtful heights, untrained regimes."""
        lost = [estimate.reason for estimate in self.estimates if not estimate.valid]
        without = [one.about["map"] for one in self.estimates if one.about.get("map", USED) != USED]
        told = []
        for reasons, what in ((lost, "were rejected and bridged"), (without, "are those of pairs of frames")):
            if len(reasons) > MANY * len(self.estimates):
                part = 100 * len(reasons) / len(self.estimates)
                told.append(
                    f"{len(reasons)} of {counted(len(self.estimates), 'motion')} ({part:.0f} %) {what}: {_usual(reasons)}"
                )
        doubts = [str(one.about["doubt"]) for one in self.estimates if "doubt" in one.about]
        if doubts:
            told.append(
                f"{len(doubts)} of {len(self.estimates)} pairs of frames contradict the height that they are given, which "
                f"counts unless the ground rises: {_usual(doubts)}; check height and pitch (faint ground near the sonar "
                "looks so, too)"
            )
        untrained = dict.fromkeys(str(one.about["untrained"]) for one in self.estimates if "untrained" in one.about)
        told.extend(f"{one}: its covariances have not been learnt there" for one in untrained)
        return told


def odometry(
    frames: Source | SonarFrames,
    estimator: EstimatorLike,
    *,
    smooth: Smoothing = "none",
    scale: ArrayLike | Literal["fit"] | None = None,
    start: Pose | None = None,
    every: int = 1,
    closure: int = 0,
    sensors: VehicleSensors | None = None,
    loops: bool = False,
    local_map: bool = False,
    workers: int = 1,
    known: Mapping[int, Estimate] | None = None,
    keep: Callable[[int, Estimate], None] = lambda number, estimate: None,
    known_loops: KnownLoops | None = None,
    keep_loop: KeepLoop = lambda first, second, motion, estimate: None,
    progress: Callable[[int], None] = lambda pairs: None,
) -> Odometry:
    """Estimate the path of a sonar from its frames.

    Invalid motions are bridged from their neighbours. ``smooth`` selects a further assumption about the velocity. ``none``
    assumes nothing and preserves corners. ``spline`` assumes slow changes, with a period chosen by cross validation.
    ``kalman`` assumes a random walk, with a size chosen by maximum likelihood, and smooths the covariances too.

    Args:
        frames: frames of one run, in memory or as a source.
        estimator: estimates the motion between two frames; anything that
            :func:`~mitsonar.estimation.named.create_estimator` accepts: a name, a checkpoint, or an estimator object.
        smooth: smoothing of the motions, see above.
        scale: factors for sideways, forward, yaw ``(3,)``; ``fit`` fits valid to true motions by least squares.
        start: first pose; by default the true one, or the origin at the height of the first frame. Height, pitch and roll
            follow those of the frames along the path, where known.
        every: use only every ``every``-th frame.
        closure: number of motions over which loops are closed; covariances are inflated to explain the loop residuals. 0
            closes none.
        sensors: sensors of the vehicle; they give the estimators a prior and enter the pose graph.
        loops: search for places seen again, and close the path there in a pose graph.
        local_map: also register frames to a map of the last metres; see :mod:`mitsonar.mapping.local_map`.
        workers: number of worker processes; 1 computes in this process. The result is bit-identical.
        known: estimates of an earlier run, by pair number.
        keep: called with the number and the estimate of each new pair.
        known_loops: loop registrations of an earlier run.
        keep_loop: called with both frames, the initial guess and the estimate of each new loop registration.
        progress: called with the number of pairs processed since the last call.

    Raises:
        MitsonarError: fewer than two frames, times that do not increase, frames that lack what the estimator needs, no valid
            motion, ``fit`` without true poses, loops in records that are not sonar frames, or smoothing of a pose graph.
    """
    # 1. select the frames, and reject impossible options before hours of estimating
    source = FrameSource.of(frames) if isinstance(frames, SonarFrames) else frames
    estimator = create_estimator(estimator)
    numbers = _frames_used(source, smooth, scale, every, closure)
    time_s, shown = source.time_s[numbers], _ground_shown(source, sensors, smooth, loops, local_map)
    if local_map and shown is not None:
        map_attitudes(shown, numbers)  # raises if the frames lack height or pitch
    # 2. estimate the motion of each pair, and resolve ambiguous motions by their neighbours
    estimate = partial(estimate_motions, priors=None if sensors is None else sensors.priors(time_s))
    estimates = estimate(source, estimator, numbers, workers=workers, known=known, keep=keep, progress=progress)
    estimates = continued(estimates)
    # 3. inflate covariances to explain the loop residuals, and refine the motions by the local map
    closing = closure_of(source, estimator, numbers, estimates, closure, progress) if closure else None
    estimates = estimates if closing is None else closing.honest(estimates)
    pairs = estimates  # the height profile needs their first echoes
    estimates = mapped(shown, numbers, estimates, progress) if local_map and shown is not None else estimates
    # 4. scale, bridge or smooth the motions, and compose them to a path
    measured = series_of(estimates, time_s)
    factors = _scale_factors(measured, source.true, numbers, scale)
    measured, first = scaled(measured, factors), start or _start(source, int(numbers[0]))
    series = _SMOOTHED[smooth](measured)
    path = path_of(series.motions, first, series.time_s)
    fitted = isinstance(scale, str)
    # 5. with sensors or loops, the pose graph replaces this path
    graph = None
    if sensors is not None or loops:
        task = LoopTask(estimator, numbers, known_loops, keep_loop) if loops else None
        known_start = start is not None or source.poses is not None
        by_map = np.array([one.about.get("map") == USED for one in estimates], dtype=bool)
        graph = graph_path(
            measured, bridged, first, start_known=known_start, sensors=sensors, loops=task, source=shown, by_map=by_map
        )
        series, path = graph.series, graph.path
    # 6. complete the planar path: height, pitch and roll of the frames, height profile, correlation of the errors
    path = _with_known(path, source, numbers, by_sensors=sensors is not None and sensors.rises(time_s) is not None)
    heights = height_profile(source, numbers, pairs, sensors, path)
    alike = (
        None if shown is None or smooth != "none" or graph is not None else errors_along(series.motions, canvas_of(shown))
    )
    return Odometry(numbers, estimates, series, path, source.true, smooth, factors, fitted, heights, closing, graph, alike)


def _ground_shown(
    source: Source, sensors: VehicleSensors | None, smooth: str, loops: bool, local_map: bool
) -> FrameSource | None:
    """Return the source if it holds sonar frames, else None. Reject options that exclude each other or need sonar frames."""
    if smooth != "none" and (loops or sensors is not None):
        raise MitsonarError(
            f"{argument('smooth')} {smooth} and a pose graph of sensors or loops exclude each other: give one"
        )
    shown = source if isinstance(source, FrameSource) else None
    if loops and shown is None:
        raise MitsonarError(f"loops are searched in sonar frames, and {source.name} holds other records: leave loops out")
    if local_map and shown is None:
        raise MitsonarError(f"a map is made of sonar frames, and {source.name} holds other records: leave the map out")
    return shown


def _frames_used(source: Source, smooth: str, scale: ArrayLike | str | None, every: int, closure: int) -> Index:
    """Return the numbers of the frames to use. Reject impossible arguments early, before hours of estimating."""
    if every < 1:
        raise MitsonarError(f"{argument('every')} must be at least 1: got {every}")
    if closure < 0 or closure == 1:
        raise MitsonarError(f"{argument('closure')} must be 0, or 2 motions or more: got {closure}")
    numbers = np.arange(0, len(source), every)
    if len(numbers) < 2:
        used = f", {len(numbers)} of them used" if every > 1 else ""
        raise MitsonarError(f"odometry needs two frames or more: got {len(source)} from {source.name}{used}")
    source.check_times()
    if smooth not in get_args(Smoothing):
        raise MitsonarError(f"unknown smoothing {smooth!r}: {nearest_names(smooth, get_args(Smoothing))}")
    if isinstance(scale, str) and (scale != "fit" or source.poses is None):
        raise MitsonarError(
            f"scale is three factors or fit: got {scale!r}"
            if scale != "fit"
            else f"{source.name} holds no true poses, which scale fit needs: give three factors"
        )
    return numbers


def _scale_factors(
    measured: MotionSeries, true: Trajectory | None, numbers: Index, scale: ArrayLike | Literal["fit"] | None
) -> Array:
    """Return the factors for sideways, forward, yaw ``(3,)``: ones, as given, or fitted to the true path."""
    if isinstance(scale, str):
        assert true is not None
        valid = measured.believed
        return fit_scale(measured.motions[valid], motions(true.poses[numbers])[valid])
    return np.ones(3) if scale is None else np.asarray(scale, dtype=float)


def _start(source: Source, first: int) -> Pose:
    """Return the true first pose; without truth, the origin with the known height and pitch."""
    if source.poses is not None:
        return Pose.from_row(float(value) for value in source.poses[first])
    height = 0.0 if source.height_m is None else float(np.nan_to_num(source.height_m[first]))
    return Pose(0.0, 0.0, height, source.pitch_rad or 0.0)


def _with_known(path: Trajectory, source: Source, numbers: Index, *, by_sensors: bool) -> Trajectory:
    """Add the changes of height, pitch and roll of the frames to a path of planar motions, where they are known.

    Args:
        path: poses at the frames; changes count from its first pose.
        source: source of the records.
        numbers: numbers of the frames.
        by_sensors: whether a depth sensor has already set the heights.
    """
    known = source.attitudes(numbers) if isinstance(source, FrameSource) else None
    known = source.poses[numbers] if known is None and source.poses is not None else known
    if known is None or not np.isfinite(known[:, 2:5]).all():
        return path
    poses = path.poses.copy()
    poses[:, 3:5] += known[:, 3:5] - known[0, 3:5]
    if source.poses is not None and not by_sensors:
        poses[:, 2] += known[:, 2] - known[0, 2]
    return Trajectory(poses, path.time_s)


def _by_axis(what: str, values: Array) -> list[Row]:
    return [(f"{what}, {axis.name}", float(value), axis.unit) for axis, value in zip(AXES, values, strict=True)]


# ---------------- Series of motions


def series_of(estimates: list[Estimate], time_s: ArrayLike) -> MotionSeries:
    """Return the motions of estimates between the times ``time_s`` ``(frames,)`` [s] as a series.

    Raises:
        MitsonarError: no estimate is valid; the message gives the most frequent reasons.
    """
    if estimates and not any(estimate.valid for estimate in estimates):
        reasons = _usual([estimate.reason for estimate in estimates])
        raise MitsonarError(
            f"none of {len(estimates)} motions is valid, so that there is no path ({reasons}): check what the estimator "
            "is given (height, attitude, window or receivers), or try another one"
        )
    return MotionSeries.from_estimates(estimates, time_s)


def bridged(measured: MotionSeries) -> MotionSeries:
    """Fill in invalid motions from the valid ones, which stay as measured.

    If covariances are known, the Kalman smoother fills the gaps and supplies their covariances. Otherwise the velocity is
    interpolated linearly between its neighbours.
    """
    known = np.flatnonzero(measured.believed)
    if known.size == len(measured):
        return measured
    if measured.covariances is not None and known.size > 1:
        filled = kalman_smoothed(measured)
        fill, fill_covariances = filled.motions, filled.covariances
    else:
        middle = measured.middle_s
        velocity = np.column_stack([np.interp(middle, middle[known], v[known]) for v in measured.velocity.T])
        fill, fill_covariances = velocity * measured.step_s[:, None], None
    together = np.where(measured.believed[:, None], measured.motions, fill)
    if fill_covariances is None or measured.covariances is None:
        return MotionSeries(together, measured.time_s)
    covariances = np.where(measured.believed[:, None, None], measured.covariances, fill_covariances)
    return MotionSeries(together, measured.time_s, covariances)


_SMOOTHED: dict[str, Callable[[MotionSeries], MotionSeries]] = {
    "none": bridged,
    "spline": spline_smoothed,
    "kalman": kalman_smoothed,
}


def _usual(reasons: list[str]) -> str:
    """Return the three most frequent reasons as text; reasons that differ only in their numbers count as one."""
    kinds = Counter(re.sub(r"-?\d+(\.\d+)?", "#", reason) for reason in reasons).most_common(3)
    example = {re.sub(r"-?\d+(\.\d+)?", "#", reason): reason for reason in reversed(reasons)}
    return "; ".join(f"{counted(count, 'time')} such as {example[kind]!r}" for kind, count in kinds)
