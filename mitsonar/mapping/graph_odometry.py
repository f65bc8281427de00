"""How other sensors and loops enter the path of an odometry, by a pose graph in place of plain composition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import AnyEstimator
from mitsonar.mapping.loops import Canvas, KeepLoop, KnownLoops, LoopSearch, canvas_of, search_loops
from mitsonar.mapping.pose_graph import CorrelatedErrors, GraphSolution, PoseEdges, PoseGraph, relative_motions, solved
from mitsonar.mapping.series import ErrorCorrelation, MotionSeries, fit_noise, path_of
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import UNKNOWN_STD, Headings, VehicleSensors, wrapped
from mitsonar.motion.trajectory import Trajectory

__all__ = ["GraphPath", "LoopTask", "graph_path", "normalised_errors"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

DEFAULT_REACH_M = 3.0
"""Horizontal distance to the middle of the ground in view, if it is not known [m]."""

NOTHING = 1e-9
"""Correlation of errors that are independent of each other."""

HALF_TOLD = 0.5
"""Fraction of the standard deviation of an unknown component below which a sensor counts as measuring the component."""


@dataclass(frozen=True)
class LoopTask:
    """Request for a search for loops.

    Attributes:
        estimator: registers two frames.
        numbers: numbers of the frames used ``(frames,)``.
        known: registrations of an earlier run.
        keep: called with each new registration.
    """

    estimator: AnyEstimator
    numbers: Index
    known: KnownLoops | None = None
    keep: KeepLoop = lambda first, second, motion, estimate: None


@dataclass(frozen=True)
class GraphPath:
    """A path computed by a pose graph.

    Attributes:
        path: poses at the times of the frames.
        covariances: covariances of x, y [m], heading [rad] ``(frames, 3, 3)``.
        series: motions of the path, with their covariances.
        sensors: names of the sensors that were used.
        search: result of the search for loops; None if none was requested.
        kept: whether each loop of the search agrees with all other measurements ``(loops,)``.
        end_moved_m: distance by which loops moved the end of the path [m].
        end_std_m: standard deviation of the position of the end without loops [m].
    """

    path: Trajectory
    covariances: Array
    series: MotionSeries
    sensors: tuple[str, ...]
    search: LoopSearch | None
    kept: NDArray[np.bool_]
    end_moved_m: float
    end_std_m: float

    @property
    def end_told_m(self) -> float:
        """Return the standard deviation of the position of the end [m]."""
        return float(np.sqrt(np.trace(self.covariances[-1, :2, :2])))

    def rows(self, true: Trajectory | None) -> list[tuple[str, float, str]]:
        """Return name, value and unit of the results that the graph adds; ``true`` is the true path at the frames."""
        rows: list[tuple[str, float, str]] = []
        if self.search is not None:
            out = len(self.kept) - int(self.kept.sum())
            rows += [
                ("loops", float(self.kept.sum()), ""),
                ("loops rejected", float(out + sum(self.search.rejected.values())), ""),
                ("pairs of views compared for loops", float(self.search.compared), ""),
                ("standard deviation of the end as told, before loops", 1e3 * self.end_std_m, "mm"),
                ("end moved by loops", 1e3 * self.end_moved_m, "mm"),
            ]
        rows.append(("standard deviation of the end as told", 1e3 * self.end_told_m, "mm"))
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


def errors_along(motions: Array, canvas: Canvas | None) -> CorrelatedErrors:
    """Return the correlation of the errors of consecutive motions ``(n, 3)``.

    Args:
        motions: sideways, forward [m], yaw [rad].
        canvas: ground that the frames show; None if its distance from the sonar is not known.
    """
    return _law_over(canvas).of(motions, DEFAULT_REACH_M if canvas is None else canvas.reach_m)


def _law_over(canvas: Canvas | None) -> ErrorCorrelation:
    """Return the error model over this ground; without relief, errors are noise, independent from pair to pair."""
    return ErrorCorrelation(share=0.0) if canvas is not None and canvas.view.attitude.even else ErrorCorrelation()


def graph_path(
    measured: MotionSeries,
    bridge: Callable[[MotionSeries], MotionSeries],
    start: Pose,
    *,
    start_known: bool,
    sensors: VehicleSensors | None,
    loops: LoopTask | None,
    source: FrameSource | None,
    by_map: NDArray[np.bool_] | None = None,
) -> GraphPath:
    """Compute the path that agrees best with estimated motions, sensors and loops.

    Args:
        measured: estimated motions, scaled; some may be invalid.
        bridge: fills in invalid motions.
        start: first pose.
        start_known: whether the heading of the first pose is known; otherwise a compass determines it, if there is one.
        sensors: sensors of the vehicle, if any.
        loops: request for a search for loops; None for none.
        source: source of the frames if they show the ground, from which the distance of the ground is known.
        by_map: whether each motion comes from a local map ``(motions,)``, whose errors are not correlated with those of
            pairs of frames. None: no map.

    Raises:
        MitsonarError: the sensors cover no frame, or the motions have no covariance and are too few to estimate one.
    """
    # 1. the graph of motions and sensors, with errors correlated over the same ground
    canvas = None if source is None else canvas_of(source)
    errors = _law_over(canvas)
    graph = _graph(measured, bridge, start, start_known, sensors)
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
    search = None
    if loops is not None:
        if source is None or canvas is None:
            raise MitsonarError("a search for loops needs frames that show level ground: give the height and the pitch")
        search = search_loops(
            source, loops.estimator, loops.numbers, before, errors, canvas, known=loops.known, keep=loops.keep
        )
        after = _closed(replace(graph, start=before.poses), search, before)
    return _path_of(after, before, measured.time_s, start, sensors, search)


def _closed(graph: PoseGraph, search: LoopSearch, before: GraphSolution) -> GraphSolution:
    """Solve a graph with loops, leaving out all loops of a stretch where most disagree with the other measurements."""
    if not len(search.loops.first):
        return before
    after = solved(replace(graph, loops=search.loops))
    out = after.kept & search.outvoted(after.kept)
    if not out.any():
        return after
    kept = after.kept & ~out
    rest = solved(replace(graph, loops=search.loops.at(kept))) if kept.any() else before
    kept[kept] = rest.kept if kept.any() else True
    return replace(rest, kept=kept)


def _path_of(
    solution: GraphSolution,
    before: GraphSolution,
    time_s: Array,
    start: Pose,
    sensors: VehicleSensors | None,
    search: LoopSearch | None,
) -> GraphPath:
    """Collect the path, its covariances and its motions."""
    count = len(time_s)
    own, following = solution.covariances()
    poses = np.tile(np.asarray(start, dtype=float), (count, 1))
    poses[:, [0, 1, 5]] = solution.poses
    rises = None if sensors is None else sensors.rises(time_s)
    poses[:, 2] += 0.0 if rises is None else rises
    moved = relative_motions(solution.poses, np.arange(count - 1), np.arange(1, count))
    covariances = solution.motion_covariances(own, following)
    last = count - 1
    end = before.columns([last])[last, :2, 0, :2]
    return GraphPath(
        path=Trajectory(poses, time_s),
        covariances=own,
        series=MotionSeries(moved, time_s, (covariances + covariances.swapaxes(1, 2)) / 2),
        sensors=() if sensors is None else tuple(sensors.names),
        search=search,
        kept=solution.kept,
        end_moved_m=float(np.hypot(*(solution.poses[-1] - before.poses[-1])[:2])),
        end_std_m=float(np.sqrt(np.trace(end))),
    )


def _graph(
    measured: MotionSeries,
    bridge: Callable[[MotionSeries], MotionSeries],
    start: Pose,
    start_known: bool,
    sensors: VehicleSensors | None,
) -> PoseGraph:
    """Assemble the pose graph of estimated motions and sensors."""
    # 1. the chain of estimated motions, bridged, with covariances
    if measured.covariances is None:
        covariances = np.tile(np.diag(fit_noise(measured) ** 2), (len(measured), 1, 1))
        measured = replace(measured, covariances=covariances)
    whole = bridge(measured)
    assert whole.covariances is not None
    chain = PoseEdges.chain(whole.motions, whole.covariances.copy())
    # 2. motions and headings of the sensors; where these suffice, a bridged motion must not count as a measurement
    others, bias, headings = PoseEdges.none(), None, Headings.none()
    if sensors is not None:
        told = sensors.motions(measured.time_s)
        chain.covariances[~measured.believed & _told(sensors, measured.time_s)] = np.diag(UNKNOWN_STD**2)
        if told:
            pair, motions, covariances, bias = (np.concatenate(parts) for parts in zip(*told, strict=True))
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


def _told(sensors: VehicleSensors, time_s: Array) -> NDArray[np.bool_]:
    """Return whether the sensors alone determine each motion ``(frames - 1,)``."""
    priors = sensors.priors(time_s)
    if priors is None:
        return np.zeros(len(time_s) - 1, dtype=bool)
    return np.array([(one.std < HALF_TOLD * UNKNOWN_STD).all() for one in priors], dtype=bool)
