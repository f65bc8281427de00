"""How the frames of a run become a path.

:func:`odometry` selects the frames, estimates the motion of each pair of consecutive frames, resolves ambiguous motions,
scales, bridges or smooths the motions, and composes them into a path (Almanza-Medina, eq. 3.4). With vehicle sensors or loop
closures, a pose graph replaces the composition (:func:`graph_path`). :func:`closure_of` measures quality without ground
truth, and :func:`height_profile` collects the height of the sonar over the ground along the path.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from statistics import median_low
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from mitsonar.errors import MitsonarError, argument, count_noun, suggest_names
from mitsonar.estimation.estimator import FROM_PRIOR, AnyEstimator, Estimate
from mitsonar.estimation.named import EstimatorLike, create_estimator
from mitsonar.mapping.local_map import USED, map_attitudes, mapped
from mitsonar.mapping.loops import Canvas, LoopSearch, canvas_of, search_loops
from mitsonar.mapping.open_source import Source
from mitsonar.mapping.pairs import EstimateStore, continued, estimate_motions
from mitsonar.mapping.pose_graph import OUTLIER, GraphSolution, PoseEdges, PoseGraph, relative_motions, solved
from mitsonar.mapping.series import (
    CorrelatedErrors,
    ErrorCorrelation,
    MotionSeries,
    bridged,
    fit_noise,
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
from mitsonar.motion.sensors import UNKNOWN_STD, Headings, VehicleSensors, leaning_mount, smoothed_change, wrapped
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

__all__ = [
    "ALTIMETER",
    "FIRST_ECHOES",
    "Closure",
    "GraphPath",
    "HeightProfile",
    "Odometry",
    "OdometryOptions",
    "Row",
    "Smoothing",
    "closure_of",
    "contradiction",
    "errors_along",
    "follows_depth",
    "graph_path",
    "height_profile",
    "loop_starts",
    "normalised_errors",
    "odometry",
    "off_compass",
    "series_of",
]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

Smoothing = Literal["none", "spline", "kalman"]


@dataclass(frozen=True, kw_only=True)
class OdometryOptions:
    """Choices of :func:`odometry`.

    Attributes:
        smooth: assumption about the velocity. ``none`` assumes nothing and preserves corners. ``spline`` assumes slow
            changes, with a period chosen by cross validation. ``kalman`` assumes a random walk, with a size chosen by
            maximum likelihood, and smooths the covariances too. Invalid motions are bridged in any case.
        scale: factors for sideways, forward, yaw ``(3,)``; ``fit`` fits valid to true motions by least squares.
        start: first pose; by default the true one, or the origin at the height of the first frame. Height, pitch and roll
            follow those of the frames along the path, where known.
        every: use only every ``every``-th frame.
        closure: number of motions over which loops are closed; covariances are inflated to explain the loop residuals.
            Where fewer than two such loops close, since the frames lie too far apart to be matched, it is halved. 0 closes
            none.
        sensors: sensors of the vehicle; they give the estimators a prior and enter the pose graph.
        loops: search for places seen again, and close the path there in a pose graph.
        local_map: also register frames to a map of the last metres; see :mod:`mitsonar.mapping.local_map`.
        workers: number of worker processes; 1 computes in this process. The result is bit-identical.

    Raises:
        MitsonarError: an option is outside its limits, or smoothing is combined with a pose graph.
    """

    smooth: Smoothing = "none"
    scale: ArrayLike | Literal["fit"] | None = None
    start: Pose | None = None
    every: int = 1
    closure: int = 0
    sensors: VehicleSensors | None = None
    loops: bool = False
    local_map: bool = False
    workers: int = 1

    def __post_init__(self) -> None:
        if self.every < 1:
            raise MitsonarError(f"{argument('every')} must be at least 1: got {self.every}")
        if self.closure < 0 or self.closure == 1:
            raise MitsonarError(f"{argument('closure')} must be 0, or 2 motions or more: got {self.closure}")
        if self.smooth not in get_args(Smoothing):
            raise MitsonarError(f"unknown smoothing {self.smooth!r}: {suggest_names(self.smooth, get_args(Smoothing))}")
        if isinstance(self.scale, str) and self.scale != "fit":
            raise MitsonarError(f"scale is three factors or fit: got {self.scale!r}")
        if self.smooth != "none" and (self.loops or self.sensors is not None):
            raise MitsonarError(
                f"{argument('smooth')} {self.smooth} and a pose graph of sensors or loops exclude each other: give one"
            )


def odometry(
    frames: Source | SonarFrames,
    estimator: EstimatorLike,
    options: OdometryOptions = OdometryOptions(),
    *,
    store: EstimateStore | None = None,
    progress: Callable[[int], None] = lambda pairs: None,
) -> Odometry:
    """Estimate the path of a sonar from its frames.

    Args:
        frames: frames of one run, in memory or as a source.
        estimator: estimates the motion between two frames; anything that
            :func:`~mitsonar.estimation.named.create_estimator` accepts: a name, a checkpoint, or an estimator object.
        options: which frames are used, and what the path is made of.
        store: estimates of an earlier run, to which new ones are added.
        progress: called with the number of pairs processed since the last call.

    Raises:
        MitsonarError: fewer than two frames, times that do not increase, frames that lack what the estimator needs, no valid
            motion, ``fit`` without true poses, or loops or a map in records that are not sonar frames.
    """
    # 1. select the frames, and reject impossible options before hours of estimating
    source = FrameSource.of(frames) if isinstance(frames, SonarFrames) else frames
    estimator, sensors = create_estimator(estimator), options.sensors
    numbers, shown = _frames_used(source, options)
    if sensors is not None and shown is not None:
        shown, sensors = shown.with_sensors(sensors, options.every)
        source = shown
    time_s, store = source.time_s[numbers], store or EstimateStore()
    # 2. estimate the motion of each pair, and resolve ambiguous motions by their neighbours
    priors = None if sensors is None else sensors.priors(time_s)
    estimates = estimate_motions(
        source, estimator, numbers, workers=options.workers, priors=priors, store=store, progress=progress
    )
    estimates = continued(estimates)
    doubt = "" if sensors is None else contradiction(sensors, estimates, time_s)
    if doubt and sum(one.valid for one in estimates) < 2:
        raise MitsonarError(doubt)
    if not doubt and sensors is not None and isinstance(source, FrameSource) and source.rise_m is not None:
        doubt = follows_depth(estimates, source.rise_m[numbers], sensors.name)
    # 3. inflate covariances to explain the loop residuals, and refine the motions by the local map
    steps = options.closure
    closing = closure_of(source, estimator, numbers, estimates, steps, progress) if steps else None
    while closing is None and (steps := steps // 2) > 1:
        closing = closure_of(source, estimator, numbers, estimates, steps)
    estimates = estimates if closing is None else closing.inflate_covariances(estimates)
    pairs = estimates  # the height profile needs their first echoes
    estimates = mapped(shown, numbers, estimates, progress) if options.local_map and shown is not None else estimates
    # 4. scale, bridge or smooth the motions, and compose them to a path
    measured = series_of(estimates, time_s)
    factors = _scale_factors(measured, source.true, numbers, options.scale)
    measured, first = scaled(measured, factors), options.start or _start(source, int(numbers[0]))
    series = {"none": bridged, "spline": spline_smoothed, "kalman": kalman_smoothed}[options.smooth](measured)
    path = path_of(series.motions, first, series.time_s)
    # 5. with sensors or loops, the pose graph replaces this path
    graph, start_known = None, options.start is not None or source.poses is not None
    if not doubt and sensors is not None and start_known:
        doubt = off_compass(sensors, path)
    if sensors is not None or options.loops:
        graph = graph_path(
            measured,
            first,
            start_known=start_known,
            sensors=sensors,
            search=None if not options.loops or shown is None else partial(search_loops, shown, estimator, numbers, store),
            source=shown,
            by_map=np.array([one.about.get("map") == USED for one in estimates], dtype=bool),
        )
        series, path = graph.series, graph.path
    # 6. complete the planar path: height, pitch and roll of the frames, height profile, correlation of the errors
    path = _with_known(path, source, numbers, by_sensors=sensors is not None and sensors.rises(time_s) is not None)
    heights = height_profile(source, numbers, pairs, sensors, path)
    correlated = None
    if shown is not None and options.smooth == "none" and graph is None:
        correlated = errors_along(series.motions, canvas_of(shown))
    return Odometry(
        numbers, estimates, series, path, source.true, options, factors, heights, closing, graph, correlated, doubt
    )


def _frames_used(source: Source, options: OdometryOptions) -> tuple[Index, FrameSource | None]:
    """Return the numbers of the frames to use, and the source if it holds sonar frames; reject options that do not fit."""
    numbers = np.arange(0, len(source), options.every)
    if len(numbers) < 2:
        used = f", {len(numbers)} of them used" if options.every > 1 else ""
        raise MitsonarError(f"odometry needs two frames or more: got {len(source)} from {source.name}{used}")
    source.check_times()
    if isinstance(options.scale, str) and source.poses is None:
        raise MitsonarError(f"{source.name} holds no true poses, which scale fit needs: give three factors")
    shown = source if isinstance(source, FrameSource) else None
    if options.loops and shown is None:
        raise MitsonarError(f"loops are searched in sonar frames, and {source.name} holds other records: leave loops out")
    if options.local_map:
        if shown is None:
            raise MitsonarError(f"a map is made of sonar frames, and {source.name} holds other records: leave the map out")
        map_attitudes(shown, numbers)  # raises if the frames lack height or pitch
    return numbers, shown


def _scale_factors(
    measured: MotionSeries, true: Trajectory | None, numbers: Index, scale: ArrayLike | Literal["fit"] | None
) -> Array:
    """Return the factors for sideways, forward, yaw ``(3,)``: ones, as given, or fitted to the true path."""
    if isinstance(scale, str):
        assert true is not None
        valid = measured.is_valid
        return fit_scale(measured.motions[valid], motions(true.poses[numbers])[valid])
    return np.ones(3) if scale is None else np.asarray(scale, dtype=float)


def _start(source: Source, first: int) -> Pose:
    """Return the true first pose; without truth, the origin with the known height, pitch and roll."""
    if source.poses is not None:
        return Pose.from_row(float(value) for value in source.poses[first])
    height = 0.0 if source.height_m is None else float(np.nan_to_num(source.height_m[first]))
    lean = source.attitudes(np.array([first])) if isinstance(source, FrameSource) else None
    pitch, roll = (0.0, 0.0) if lean is None else np.nan_to_num(lean[0, 3:5]).tolist()
    return Pose(0.0, 0.0, height, pitch, roll)


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


# ---------------- The result

Row = tuple[str, float, str]
"""Name, value and unit of a result."""

MANY = 0.1
"""Fraction of motions above which the user is warned that they are interpolated, or that their height is doubtful."""

LONG_S = 5.0
"""Duration of a bridged motion above which the user is warned that it is a guess [s]."""


@dataclass(frozen=True)
class Odometry:
    """An estimated path together with everything from which it was computed.

    Attributes:
        frames: numbers of the frames used, in their source ``(frames,)``.
        estimates: estimate of each pair of consecutive frames.
        series: motions of the path after scaling, bridging or smoothing, with covariances if known.
        path: poses at the times of the frames.
        true: true poses of the sonar at all frames of the source, if known.
        options: choices with which the path was made.
        factors: factors that multiplied the estimates, for sideways, forward, yaw ``(3,)``.
        heights: heights over the ground along the path.
        closure: residuals of short loops of motions, if requested.
        graph: solution of the pose graph, if sensors or loops were requested.
        correlated: how errors of motions over the same ground are correlated; None to use the correlation stored in
            ``series``, if any.
        doubt: how the frames contradict the sensors; empty if they agree.
    """

    frames: Index
    estimates: list[Estimate]
    series: MotionSeries
    path: Trajectory
    true: Trajectory | None
    options: OdometryOptions
    factors: Array
    heights: HeightProfile
    closure: Closure | None = None
    graph: GraphPath | None = None
    correlated: CorrelatedErrors | None = None
    doubt: str = ""

    @property
    def valid(self) -> NDArray[np.bool_]:
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
        rows: list[Row] = [("motions", count, ""), ("motions rejected, bridged", count - int(self.valid.sum()), "")]
        by_map = [one.about["map"] for one in self.estimates if "map" in one.about]
        if by_map:
            rows.append(("motions by the local map", by_map.count(USED), ""))
        fitted = isinstance(self.options.scale, str)
        how = "fitted to the true path" if fitted else "as given"
        if fitted or (self.factors != 1).any():
            rows += [(f"scale of {axis.name}, {how}", float(f), "") for axis, f in zip(AXES, self.factors, strict=True)]
        if self.series.covariances is not None:
            std = np.sqrt(np.diagonal(self.series.covariances, axis1=1, axis2=2).mean(axis=0))
            rows += _by_axis("estimated standard deviation of a motion", in_units(std))
        if self.closure is not None:
            over = f"closure over {self.closure.steps} motions"
            rows.append((f"{over}, loops", len(self.closure.residuals), ""))
            rows += [(f"{over}, loops refused", self.closure.refused, "")] if self.closure.refused else []
            rows += _by_axis(f"{over}, rms", in_units(self.closure.rms))
            rows += _by_axis(f"{over}, mean", in_units(self.closure.mean))
        true = self.true_at_frames
        rows += [] if self.graph is None else self.graph.rows(true)
        if self.true is None or true is None:
            return [*rows, ("estimated path length", path_length(self.path), "m")]
        errors = motion_errors(self.series.motions, motions(true.poses), np.ones(count, dtype=bool), self.series.covariances)
        rows += _by_axis("motion error RMSE", errors.rmse)
        rows += _by_axis("RMSE of always answering zero", errors.zero)
        rows += [(f"slope over the true {axis.name}", float(s), "") for axis, s in zip(AXES, errors.slope, strict=True)]
        if np.isfinite(errors.nees):
            rows.append(("NEES", errors.nees, ""))
        return rows + [(name, float(value), unit) for name, value, unit in assess(self.path, self.true).rows()]

    def warnings(self) -> list[str]:
        """Return warnings for the user: many motions invalid or not from the map, doubtful heights, untrained regimes."""
        lost = [estimate.reason for estimate in self.estimates if not estimate.valid]
        without = [one.about["map"] for one in self.estimates if one.about.get("map", USED) != USED]
        warnings = [self.doubt] if self.doubt else []
        outside_map = "; a map that is lost so often may drift more than pairs of frames: compare the path without it"
        for reasons, what, advice in (
            (lost, "were rejected and bridged", ""),
            (without, "are those of pairs of frames", outside_map),
        ):
            if len(reasons) > MANY * len(self.estimates):
                part = 100 * len(reasons) / len(self.estimates)
                warnings.append(
                    f"{len(reasons)} of {count_noun(len(self.estimates), 'motion')} ({part:.0f} %) {what}: "
                    f"{_frequent(reasons)}{advice}"
                )
        pauses_s = self.series.step_s[~self.valid]
        pauses_s = pauses_s[pauses_s > LONG_S]
        if len(pauses_s):
            warnings.append(
                f"{count_noun(len(pauses_s), 'bridged motion')} took up to {pauses_s.max():,.4g} s, over which the vehicle "
                "may have moved anywhere: rely on the path between such pauses only"
            )
        if self.options.closure and self.closure is None:
            warnings.append(
                f"no closure is given, since fewer than two loops of 2 to {self.options.closure} motions were matched: the "
                "frames may be too few, or too far apart for a match over several motions; record faster or swim slowly"
            )
        doubts = [str(one.about["doubt"]) for one in self.estimates if "doubt" in one.about]
        if len(doubts) > MANY * len(self.estimates):
            warnings.append(
                f"{len(doubts)} of {len(self.estimates)} pairs of frames contradict the height given, which "
                f"counts unless the ground rises: {_frequent(doubts)}; check height, pitch and elevation aperture (faint "
                "ground near the sonar looks so, too)"
            )
        untrained = dict.fromkeys(str(one.about["untrained"]) for one in self.estimates if "untrained" in one.about)
        warnings.extend(f"{one}: its covariances have not been learnt there" for one in untrained)
        return warnings


def _by_axis(what: str, values: Array) -> list[Row]:
    return [(f"{what}, {axis.name}", float(value), axis.unit) for axis, value in zip(AXES, values, strict=True)]


def _frequent(reasons: list[str]) -> str:
    """Return the three most frequent reasons as text; reasons that differ only in their numbers count as one."""
    kinds = Counter(re.sub(r"-?\d+(\.\d+)?", "#", reason) for reason in reasons).most_common(3)
    example = {re.sub(r"-?\d+(\.\d+)?", "#", reason): reason for reason in reversed(reasons)}
    return "; ".join(f"{count_noun(count, 'time')} such as {example[kind]!r}" for kind, count in kinds)


def series_of(estimates: list[Estimate], time_s: ArrayLike) -> MotionSeries:
    """Return the motions of estimates between the times ``time_s`` ``(frames,)`` [s] as a series.

    Raises:
        MitsonarError: no estimate is valid; the message gives the most frequent reasons.
    """
    if estimates and not any(estimate.valid for estimate in estimates):
        reasons = _frequent([estimate.reason for estimate in estimates])
        raise MitsonarError(
            f"none of {len(estimates)} motions is valid, so that there is no path ({reasons}): check what the estimator "
            "is given (height, attitude, window or receivers), or try another one"
        )
    return MotionSeries.from_estimates(estimates, time_s)


# ---------------- Closure: quality without ground truth

FEWEST = 2
"""Smallest number of loops from which errors are estimated."""

USUAL = float(chi2.median(3))
"""Median of the squared normalised residual of a loop whose covariances are right."""


@dataclass(frozen=True)
class Closure:
    """Residuals of short loops: ``steps`` single motions composed, minus the motion over all of them estimated at once.

    Attributes:
        steps: number of motions per loop.
        residuals: residual of each loop ``(loops, 3)``: sideways, forward [m], yaw [rad].
        factor: factor by which the covariances of the single motions must be multiplied to explain the residuals; at least
            1. nan if the covariances are not known.
        refused: number of loops left out, whose motion over all steps is a wrong match.
    """

    steps: int
    residuals: Array
    factor: float
    refused: int = 0

    @property
    def rms(self) -> Array:
        """Return the root mean square of the residuals ``(3,)`` [m, m, rad]."""
        return np.asarray(np.sqrt((self.residuals**2).mean(axis=0)))

    @property
    def mean(self) -> Array:
        """Return the mean of the residuals ``(3,)`` [m, m, rad]: the bias of the composed single steps."""
        return np.asarray(self.residuals.mean(axis=0))

    def inflate_covariances(self, estimates: Sequence[Estimate]) -> list[Estimate]:
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

    Loops follow one another without overlap, so that their errors are independent. In a short run they overlap, to give
    up to 16 loops. A motion over all steps is refused if its match is not distinct, or if it contradicts the single motions
    as one in 1,000 right ones would: beyond the stated covariances, and beyond those that explain the median loop. So one
    wrong match counts for nothing, and covariances that are too small for most loops still show.

    Args:
        source: source of the records.
        estimator: estimator that produced the single steps.
        numbers: numbers of the frames used ``(frames,)``.
        estimates: estimates of the single steps ``(frames - 1,)``.
        steps: number of motions per loop.
        progress: called with the number of loops processed, including those that are skipped.

    Returns:
        The closure; None if fewer than two loops have valid motions throughout and are not refused.
    """
    valid = np.array([one.valid for one in estimates], dtype=bool)
    residuals, squared, refused = [], [], 0
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
        if not whole.about.get("distinct", True):  # light that moves with the sonar matches at any motion
            refused += 1
            continue
        # residual: composed motion minus direct motion
        parts = list(estimates[start : start + steps])
        residual = _composed(np.array([one.motion for one in parts])) - np.asarray(whole.motion)
        residuals.append(residual)
        # squared residual normalised by its covariance: 3 on average if the covariances are right
        covariances = [one.covariance for one in (*parts, whole) if one.covariance is not None]
        total = np.sum(np.array(covariances), axis=0) if len(covariances) == steps + 1 else np.full((3, 3), np.nan)
        squared.append(float(residual @ np.linalg.solve(total, residual)))
    # the lower of two medians: of two loops that contradict each other, only the one nearer to the path remains
    scale = max(1.0, median_low(squared) / USUAL) if squared else 1.0
    agree = ~(np.array(squared) > OUTLIER * scale)  # nan without covariances, where no loop is refused
    refused += len(agree) - int(agree.sum())
    if agree.sum() < FEWEST:
        return None
    factor = float(np.mean(np.array(squared)[agree])) / 3
    return Closure(steps, np.array(residuals)[agree], factor if np.isnan(factor) else max(1.0, factor), refused)


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


# ---------------- Sensors and loops: a pose graph in place of plain composition

DEFAULT_REACH_M = 3.0
"""Horizontal distance to the middle of the ground in view, if it is not known [m]."""

NOTHING = 1e-9
"""Correlation of errors that are independent of each other."""

CLEARLY_RELATED = 0.7
"""Correlation of the turns of frames and gyroscope above which their ratio shows the unit and the sign."""

NEARLY_RADIANS = 0.6
"""Smallest ratio of turns, in units of 57.3, that shows rad/s in place of deg/s."""

MEASURED = 0.5
"""Fraction of the standard deviation of an unknown component below which a sensor counts as measuring the component."""


@dataclass(frozen=True)
class GraphPath:
    """A path computed by a pose graph.

    Attributes:
        path: poses at the times of the frames.
        covariances: covariances of x, y [m], heading [rad] ``(frames, 3, 3)``.
        series: motions of the path, with their covariances.
        sensors: names of the sensors that were used.
        search: result of the search for loops; None if none was requested.
        accepted: whether each loop of the search agrees with all other measurements ``(loops,)``.
        end_moved_m: distance by which loops moved the end of the path [m].
        end_std_before_m: standard deviation of the position of the end without loops [m].
    """

    path: Trajectory
    covariances: Array
    series: MotionSeries
    sensors: tuple[str, ...]
    search: LoopSearch | None
    accepted: NDArray[np.bool_]
    end_moved_m: float
    end_std_before_m: float

    @property
    def end_std_m(self) -> float:
        """Return the standard deviation of the position of the end [m]."""
        return float(np.sqrt(np.trace(self.covariances[-1, :2, :2])))

    def rows(self, true: Trajectory | None) -> list[tuple[str, float, str]]:
        """Return name, value and unit of the results that the graph adds; ``true`` is the true path at the frames."""
        rows: list[tuple[str, float, str]] = []
        if self.search is not None:
            out = len(self.accepted) - int(self.accepted.sum())
            rows += [
                ("loops", float(self.accepted.sum()), ""),
                ("loops rejected", float(out + sum(self.search.rejected.values())), ""),
                ("pairs of views compared for loops", float(self.search.compared), ""),
                ("estimated standard deviation of the end, before loops", 1e3 * self.end_std_before_m, "mm"),
                ("end moved by loops", 1e3 * self.end_moved_m, "mm"),
            ]
        rows.append(("estimated standard deviation of the end", 1e3 * self.end_std_m, "mm"))
        if true is not None:
            each = normalised_errors(self.path, self.covariances, true)
            rows.append(("squared pose error over its covariance, a third, mean along the path", float(each.mean()), ""))
            rows.append(("squared pose error over its covariance, a third, at the end", float(each[-1]), ""))
        return rows


def normalised_errors(path: Trajectory, covariances: Array, true: Trajectory) -> Array:
    """Return a third of the squared error of each pose but the first, normalised by its covariance ``(frames - 1,)``.

    The expected value is 1 if the covariances are right.

    Args:
        path: estimated path.
        covariances: covariances of x, y [m], heading [rad] ``(frames, 3, 3)``.
        true: true path, at the same times.
    """
    off = (path.poses - true.poses)[1:, [0, 1, 5]]
    off[:, 2] = wrapped(off[:, 2])
    solution = np.linalg.solve(covariances[1:], off[..., None])[..., 0]
    return np.asarray((off * solution).sum(axis=1) / 3)


def contradiction(sensors: VehicleSensors, estimates: Sequence[Estimate], time_s: Array) -> str:
    """Return a sentence where the frames contradict the sensors in many motions, with the likely cause; else nothing.

    The slope of the turns of the frames over those of the gyroscope shows its unit and sign.

    Args:
        sensors: sensors of the vehicle.
        estimates: estimate of each pair of frames, with the sensors as a prior.
        time_s: times of the frames ``(frames,)`` [s].
    """
    count, against = len(estimates), sum(FROM_PRIOR in one.reason for one in estimates)
    if against <= MANY * count:
        return ""
    cause = "check time_s, in seconds and in the clock of the recording, and the units and signs of its columns"
    if sensors.pitch is None:
        cause += "; a sonar that looks down turns as the vehicle rolls, which vehicle_pitch_deg and vehicle_roll_deg correct"
    gyro = sensors.yaw_rate
    if gyro is not None:
        compared = gyro.covers(time_s) & np.array([one.valid or FROM_PRIOR in one.reason for one in estimates])
        seen = np.array([one.motion.yaw for one in estimates])[compared]
        turned = (gyro.means(time_s) * np.diff(time_s))[compared]
        if len(seen) > 2 and _rolls_against(sensors, seen - turned, time_s, compared):
            return f"{against} of {count_noun(count, 'motion')} contradict {sensors.name}: {WRONG_ROLL}"
        slope = float(seen @ turned / max(float(turned @ turned), np.finfo(float).tiny))
        if len(seen) > 2 and abs(np.corrcoef(seen, turned)[0, 1]) > CLEARLY_RELATED:
            faults = []
            if NEARLY_RADIANS < np.radians(abs(slope)) < 1 / NEARLY_RADIANS:
                faults.append("to hold rad/s, so that it must be multiplied by 57.3")
            if slope < 0:
                faults.append("to have the wrong sign, since it is positive clockwise seen from above")
            cause = (
                f"yaw_rate_deg_s seems {' and '.join(faults)}"
                if faults
                else f"the frames turn {slope:.2g} times as far; {cause}"
            )
    return f"{against} of {count_noun(count, 'motion')} contradict {sensors.name}: {cause}"


FOLLOWS, FOLLOWS_CLEARLY = 0.25, 0.9
"""Motion ahead for each metre of rise [m/m], and its correlation with the rise, from which motions follow the depth."""

FEWEST_TO_FOLLOW = 10
"""Smallest number of motions from which such a correlation is no accident."""


def follows_depth(estimates: Sequence[Estimate], rise_m: Array, name: str) -> str:
    """Return a sentence where motions ahead follow the depth, which then has a wrong sign or unit; else nothing.

    A rise that is not taken out looks like motion ahead: the ground recedes. One that is taken out twice does so, reversed.

    Args:
        estimates: estimate of each pair of frames.
        rise_m: rise of the sonar by its depth, at each frame ``(frames,)`` [m].
        name: of the sensors.
    """
    valid = np.flatnonzero([one.valid for one in estimates])
    if len(valid) < FEWEST_TO_FOLLOW:
        return ""
    ahead, rise = np.array([one.motion.forward for one in estimates])[valid], np.diff(rise_m)[valid]
    ahead, rise = (values - np.polyval(np.polyfit(valid, values, 2), valid) for values in (ahead, rise))
    slope = float(ahead @ rise / max(float(rise @ rise), np.finfo(float).tiny))
    if abs(slope) < FOLLOWS or abs(np.corrcoef(ahead, rise)[0, 1]) < FOLLOWS_CLEARLY:
        return ""
    # in too small a unit, such as feet, a rise that is taken out too often looks like one of the wrong sign
    sign = "the sign of depth_m, which grows downwards, and " if slope > 0 else ""
    cause = f"check {sign}that {'it' if sign else 'depth_m'} is in metres"
    return f"motions ahead follow the depth of {name}, by {slope:.2g} m for each metre that it rises: {cause}"


FIRST_HEADINGS, OFF_COMPASS = 20, 5.0
"""Readings of a compass that are compared with the first heading, and the standard deviations by which they may differ."""


def off_compass(sensors: VehicleSensors, path: Trajectory) -> str:
    """Return a sentence where the compass contradicts a known first heading, by which the path would twist; else nothing.

    Args:
        sensors: sensors of the vehicle.
        path: path of the motions alone, from the known first pose.
    """
    headings = sensors.headings(path.time_s)
    if not headings.pose.size:
        return ""
    first = slice(FIRST_HEADINGS)
    off = headings.heading[first] - path.poses[headings.pose[first], 5]
    turn = float(np.angle(np.exp(1j * off).mean()))
    if abs(turn) <= OFF_COMPASS * float(np.median(headings.std[first])):
        return ""
    return (
        f"the compass of {sensors.name} is {np.degrees(turn):+.0f} deg off the first heading, so that the path twists until "
        "both agree: give a first pose with the heading of the compass, correct its declination, or leave it out"
    )


WRONG_ROLL = "vehicle_roll_deg seems to have the wrong sign, since it is positive with starboard down"


def _rolls_against(sensors: VehicleSensors, unexplained: Array, time_s: Array, compared: NDArray[np.bool_]) -> bool:
    """Return whether the turns [rad] that the gyroscope leaves unexplained are twice those of the roll, reversed."""
    lean = sensors.attitudes(time_s)
    if lean is None:
        return False
    turned = np.diff(leaning_mount(lean, sensors.mount_rad)[:, 2])[compared]
    power = float(turned @ turned)
    related = power > 0 and abs(np.corrcoef(unexplained, turned)[0, 1]) > CLEARLY_RELATED
    return bool(related and -3 < float(unexplained @ turned) / power < -1)


def errors_along(motions: Array, canvas: Canvas | None) -> CorrelatedErrors:
    """Return the correlation of the errors of consecutive motions ``(n, 3)``.

    Args:
        motions: sideways, forward [m], yaw [rad].
        canvas: ground that the frames show; None if its distance from the sonar is not known.
    """
    return _error_model(canvas).along(motions, DEFAULT_REACH_M if canvas is None else canvas.reach_m)


def _error_model(canvas: Canvas | None) -> ErrorCorrelation:
    """Return the error model over this ground; without relief, errors are noise, independent from pair to pair."""
    return ErrorCorrelation(share=0.0) if canvas is not None and canvas.view.attitude.even else ErrorCorrelation()


def graph_path(
    measured: MotionSeries,
    start: Pose,
    *,
    start_known: bool,
    sensors: VehicleSensors | None,
    search: Callable[[GraphSolution, ErrorCorrelation, Canvas], LoopSearch] | None,
    source: FrameSource | None,
    by_map: NDArray[np.bool_] | None = None,
) -> GraphPath:
    """Compute the path that agrees best with estimated motions, sensors and loops.

    Args:
        measured: estimated motions, scaled; some may be invalid.
        start: first pose.
        start_known: whether the heading of the first pose is known; otherwise a compass determines it, if there is one.
        sensors: sensors of the vehicle, if any.
        search: searches for loops, given the solution without them; None for no search.
        source: source of the frames if they show the ground, from which the distance of the ground is known.
        by_map: whether each motion comes from a local map ``(motions,)``, whose errors are not correlated with those of
            pairs of frames. None: no map.

    Raises:
        MitsonarError: the sensors cover no frame, or the motions have no covariance and are too few to estimate one.
    """
    # 1. the graph of motions and sensors, with errors correlated over the same ground
    canvas = None if source is None else canvas_of(source)
    errors = _error_model(canvas)
    graph = _graph(measured, start, start_known, sensors)
    correlated = errors_along(graph.chain.motions, canvas)
    # 2. errors are independent next to motions that only sensors determine, and where the map begins or ends
    wide = np.diagonal(graph.chain.covariances, axis1=1, axis2=2) >= UNKNOWN_STD**2
    left = np.asarray(wide.all(axis=1), dtype=bool)
    apart = left[1:] | left[:-1]
    if by_map is not None:
        apart |= by_map[1:] != by_map[:-1]
    onward = np.where(apart, NOTHING, correlated.onward)
    graph = replace(graph, correlated=correlated._replace(onward=onward))
    # 3. solve without loops; its covariances guide the search for loops, with which the graph is solved again
    before = after = solved(graph)
    loops = None
    if search is not None:
        if canvas is None:
            raise MitsonarError("a search for loops needs frames that show level ground: give the height and the pitch")
        loops = search(before, errors, canvas)
        after = _closed(replace(graph, start=before.poses), loops, before)
    return _path_of(after, before, graph.chain, measured.time_s, start, sensors, loops)


def _closed(graph: PoseGraph, search: LoopSearch, before: GraphSolution) -> GraphSolution:
    """Solve a graph with loops, leaving out all loops of a stretch where most disagree with the other measurements."""
    if not len(search.loops.first):
        return before
    after = solved(replace(graph, loops=search.loops))
    out = after.accepted & search.outvoted(after.accepted)
    if not out.any():
        return after
    accepted = after.accepted & ~out
    rest = solved(replace(graph, loops=search.loops.select(accepted))) if accepted.any() else before
    accepted[accepted] = rest.accepted if accepted.any() else True
    return replace(rest, accepted=accepted)


def _path_of(
    solution: GraphSolution,
    before: GraphSolution,
    chain: PoseEdges,
    time_s: Array,
    start: Pose,
    sensors: VehicleSensors | None,
    search: LoopSearch | None,
) -> GraphPath:
    """Collect the path, its covariances and its motions."""
    count = len(time_s)
    covariances, following = solution.covariances()
    poses = np.tile(np.asarray(start, dtype=float), (count, 1))
    poses[:, [0, 1, 5]] = solution.poses
    rises = None if sensors is None else sensors.rises(time_s)
    poses[:, 2] += 0.0 if rises is None else rises
    moved = relative_motions(solution.poses, np.arange(count - 1), np.arange(1, count))
    motion_covariances = solution.motion_covariances(covariances, following)
    # yaws of the graph are those of the sensors, with the noise of the roll by which they were corrected. Where frames show
    # only a sum of sideways motion and yaw, the former errs, too. The noise does not add up, so that no edge has it
    if sensors is not None:
        turn = sensors.turn_std(time_s)
        by_yaw = chain.covariances[:, :, 2] / chain.covariances[:, 2, 2][:, None]
        by_yaw = by_yaw * smoothed_change(turn[:-1], turn[1:], np.diff(time_s))[:, None]
        motion_covariances = motion_covariances + by_yaw[:, :, None] * by_yaw[:, None]
        covariances[:, 2, 2] += smoothed_change(turn[:1], turn, time_s - time_s[0]) ** 2
    last = count - 1
    end = before.columns([last])[last, :2, 0, :2]
    return GraphPath(
        path=Trajectory(poses, time_s),
        covariances=covariances,
        series=MotionSeries(moved, time_s, (motion_covariances + motion_covariances.swapaxes(1, 2)) / 2),
        sensors=() if sensors is None else tuple(sensors.names),
        search=search,
        accepted=solution.accepted,
        end_moved_m=float(np.hypot(*(solution.poses[-1] - before.poses[-1])[:2])),
        end_std_before_m=float(np.sqrt(np.trace(end))),
    )


def _graph(
    measured: MotionSeries,
    start: Pose,
    start_known: bool,
    sensors: VehicleSensors | None,
) -> PoseGraph:
    """Assemble the pose graph of estimated motions and sensors."""
    # 1. the chain of estimated motions, bridged, with covariances
    if measured.covariances is None:
        covariances = np.tile(np.diag(fit_noise(measured) ** 2), (len(measured), 1, 1))
        measured = replace(measured, covariances=covariances)
    whole = bridged(measured)
    assert whole.covariances is not None
    chain = PoseEdges.chain(whole.motions, whole.covariances.copy())
    # 2. motions and headings of the sensors; where these suffice, a bridged motion must not count as a measurement
    others, bias, headings = PoseEdges.none(), None, Headings.none()
    if sensors is not None:
        measurements = sensors.motions(measured.time_s)
        chain.covariances[~measured.is_valid & _determined(sensors, measured.time_s)] = np.diag(UNKNOWN_STD**2)
        if measurements:
            pair, motions, covariances, bias = (np.concatenate(parts) for parts in zip(*measurements, strict=True))
            others = PoseEdges(pair, pair + 1, motions, covariances)
        headings = sensors.headings(measured.time_s)
    bias = None if bias is None or not bias.any() else bias
    # 3. initial guess; an unknown first heading begins near that of the compass, so that Gauss-Newton converges
    at_start, first = np.zeros((3, 3)), start
    poses = path_of(whole.motions, first, measured.time_s).poses[:, [0, 1, 5]]
    if headings.pose.size and not start_known:
        at_start[2, 2] = np.pi**2
        turn = float(headings.heading[0] - poses[headings.pose[0], 2])
        poses = path_of(whole.motions, first._replace(heading=first.heading + turn), measured.time_s).poses[:, [0, 1, 5]]
    return PoseGraph(poses, chain, others, bias, headings=headings, at_start=at_start)


def _determined(sensors: VehicleSensors, time_s: Array) -> NDArray[np.bool_]:
    """Return whether the sensors alone determine each motion ``(frames - 1,)``."""
    priors = sensors.priors(time_s)
    if priors is None:
        return np.zeros(len(time_s) - 1, dtype=bool)
    return np.array([(one.std < MEASURED * UNKNOWN_STD).all() for one in priors], dtype=bool)


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
    height, std = (
        _at_frames(np.array([_from_first_echoes(one, name) for one in estimates])) for name in ("height_m", "height_std_m")
    )
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
    known = nothing if source.poses is None and depth is None else poses[:, 2]
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


def _from_first_echoes(estimate: Estimate, name: str) -> float:
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
    given = np.nan if source.given_height_m is None else source.given_height_m
    by_user = heights == given
    if isinstance(source, FrameSource) and source.rise_m is not None:  # which `with_sensors` adds to a given height
        by_user |= heights == (given + source.rise_m - source.rise_m.mean())[frames]
    return np.where(by_user, np.nan, heights)


def _ahead(source: Source, frames: Index, height_m: Array) -> Array:
    """Return how far ahead of the sonar its steepest rays meet the ground, averaged over the beams ``(frames,)`` [m]."""
    attitudes = source.attitudes(frames) if isinstance(source, FrameSource) else None
    if not isinstance(source, FrameSource) or attitudes is None:
        return np.zeros(len(frames))
    steepest = attitudes[:, 3] + np.radians(source.like.sonar.elevation_fov_deg) / 2
    return np.asarray(height_m / np.tan(steepest) * float(np.cos(source.like.bearing_rad).mean()))
