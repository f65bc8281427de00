"""The path of an odometry with other sensors and loops: a pose graph in place of plain composition."""

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
"""Horizontal distance to the ground that is seen, where it is not known [m]."""

NOTHING = 1e-9
"""Correlation of errors that do not depend on each other."""

HALF_TOLD = 0.5
"""A sensor tells a component whose standard deviation is below this part of that of unknown ones."""


@dataclass(frozen=True)
class LoopTask:
    """What a search for loops needs.

    Attributes:
        estimator: registers two frames.
        numbers: of the frames used ``(frames,)``.
        known: registrations of an earlier run.
        keep: called with each new one.
    """

    estimator: AnyEstimator
    numbers: Index
    known: KnownLoops | None = None
    keep: KeepLoop = lambda first, second, motion, estimate: None


@dataclass(frozen=True)
class GraphPath:
    """A path by a pose graph.

    Attributes:
        path: poses at the times of the frames.
        covariances: of x, y [m], heading [rad] ``(frames, 3, 3)``.
        series: the motions of the path, with their covariances.
        sensors: names of the sensors that were used.
        search: for loops; None where none was asked for.
        kept: which loops of the search agree with all else ``(loops,)``.
        end_moved_m: by how far loops moved the end of the path [m].
        end_std_m: standard deviation of the position of the end before loops [m].
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
        """Return name, value and unit of what the graph adds to the results; ``true`` is the true path at the frames."""
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
    """Return the squared error of each pose but the first over its covariance, a third of it ``(frames - 1,)``.

    Args:
        path: the estimated path.
        covariances: of x, y [m], heading [rad] ``(frames, 3, 3)``.
        true: the true path, at the same times.
    """
    off = (path.poses - true.poses)[1:, [0, 1, 5]]
    off[:, 2] = wrapped(off[:, 2])
    solution = np.linalg.solve(covariances[1:], off[..., None])[..., 0]
    return np.asarray((off * solution).sum(axis=1) / 3)


def errors_along(motions: Array, canvas: Canvas | None) -> CorrelatedErrors:
    """Return how errors of consecutive motions ``(n, 3)`` depend on each other.

    Args:
        motions: sideways, forward [m], yaw [rad].
        canvas: the ground that frames show; None: not known how far ahead of the sonar.
    """
    return _law_over(canvas).of(motions, DEFAULT_REACH_M if canvas is None else canvas.reach_m)


def _law_over(canvas: Canvas | None) -> ErrorCorrelation:
    """Return the law of errors over ground: without relief errors are noise, which no two pairs share."""
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
        measured: the estimated motions, scaled; some may be invalid.
        bridge: fills in invalid ones.
        start: the first pose.
        start_known: whether its heading is known; else a compass tells it.
        sensors: of the vehicle.
        loops: a search for loops; None: none.
        source: of the frames, where they show ground: how far ahead of the sonar.
        by_map: which motions are those of a map ``(motions,)``: its errors are not those of two frames. None: no map.

    Raises:
        MitsonarError: sensors that cover no frame, or motions that tell no covariance and are too few to estimate one.
    """
    canvas = None if source is None else canvas_of(source)
    errors = _law_over(canvas)
    graph = _graph(measured, bridge, start, start_known, sensors)
    correlated = errors_along(graph.chain.motions, canvas)
    # motions left to the sensors say nothing of the errors of their neighbours
    wide = np.diagonal(graph.chain.covariances, axis1=1, axis2=2) >= UNKNOWN_STD**2
    left = np.asarray(wide.all(axis=1), dtype=bool)
    apart = left[1:] | left[:-1]
    if by_map is not None:
        apart |= by_map[1:] != by_map[:-1]
    onward = np.where(apart, NOTHING, correlated.onward)
    graph = replace(graph, correlated=correlated._replace(onward=onward))
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
    """Solve a graph with loops; stretches where most loops disagree with all else lose the others too."""
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
    """Put estimated motions and sensors together."""
    if measured.covariances is None:
        covariances = np.tile(np.diag(fit_noise(measured) ** 2), (len(measured), 1, 1))
        measured = replace(measured, covariances=covariances)
    whole = bridge(measured)
    assert whole.covariances is not None
    chain = PoseEdges.chain(whole.motions, whole.covariances.copy())
    others, bias, headings = PoseEdges.none(), None, Headings.none()
    if sensors is not None:
        told = sensors.motions(measured.time_s)
        chain.covariances[~measured.believed & _told(sensors, measured.time_s)] = np.diag(UNKNOWN_STD**2)
        if told:
            pair, motions, covariances, bias = (np.concatenate(parts) for parts in zip(*told, strict=True))
            others = PoseEdges(pair, pair + 1, motions, covariances)
        headings = sensors.headings(measured.time_s)
    bias = None if bias is None or not bias.any() else bias
    at_start, first = np.zeros((3, 3)), start
    poses = path_of(whole.motions, first, measured.time_s).poses[:, [0, 1, 5]]
    if headings.pose.size and not start_known:
        at_start[2, 2] = np.pi**2
        turn = float(headings.heading[0] - poses[headings.pose[0], 2])
        poses = path_of(whole.motions, first._replace(heading=first.heading + turn), measured.time_s).poses[:, [0, 1, 5]]
    return PoseGraph(poses, chain, others, bias, headings=headings, at_start=at_start)


def _told(sensors: VehicleSensors, time_s: Array) -> NDArray[np.bool_]:
    """Return which motions the sensors tell by themselves ``(frames - 1,)``."""
    priors = sensors.priors(time_s)
    if priors is None:
        return np.zeros(len(time_s) - 1, dtype=bool)
    return np.array([(one.std < HALF_TOLD * UNKNOWN_STD).all() for one in priors], dtype=bool)
