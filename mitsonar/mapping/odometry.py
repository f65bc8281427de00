"""Frames and an estimator become a path: motions between consecutive frames, bridged or smoothed, driven by eq. 3.4."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument, nearest_names
from mitsonar.estimation.estimator import AnyEstimator, Estimate, rejected
from mitsonar.mapping.frame_source import FrameSource
from mitsonar.mapping.measured_heights import without_height
from mitsonar.mapping.mode_continuity import continued
from mitsonar.mapping.open_source import Source
from mitsonar.mapping.trajectory_smoothing import (
    MotionSeries,
    fit_scale,
    kalman_smoothed,
    path_of,
    pose_covariances,
    scaled,
    spline_smoothed,
)
from mitsonar.motion.composition import motions
from mitsonar.motion.motion_errors import AXES, in_units, motion_errors
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.motion.trajectory_errors import assess, path_length
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["Odometry", "Row", "Smoothing", "bridged", "estimate_motions", "odometry", "series_of"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Row = tuple[str, float, str]
"""Name, value, unit."""

Smoothing = Literal["none", "spline", "kalman"]

PAIRS_A_BATCH = 8
"""What a worker is given at a time, and what a kill may cost."""

MANY = 0.1
"""Of the motions: when more are not believed, the path is rather a guess."""

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Odometry:
    """A path, and all that it was made of.

    Attributes:
        frames: numbers of the frames used, in their source ``(frames,)``.
        estimates: what the estimator said of each pair.
        series: the motions that the path is made of: scaled, bridged or smoothed; their covariances, where known.
        path: poses at the frames' times.
        true: where the sonar was, all frames of the source, where known.
        smooth: how the motions were smoothed.
        factors: that the estimates were multiplied by, for sideways, forward, yaw ``(3,)``.
        fitted: whether these factors come from the true path.
    """

    frames: Index
    estimates: list[Estimate]
    series: MotionSeries
    path: Trajectory
    true: Trajectory | None
    smooth: Smoothing
    factors: Array
    fitted: bool

    @property
    def believed(self) -> NDArray[np.bool_]:
        """Which motions the estimator stands for ``(frames - 1,)``; the others were bridged."""
        return np.array([estimate.valid for estimate in self.estimates], dtype=bool)

    @property
    def true_at_frames(self) -> Trajectory | None:
        """The true path at the frames used."""
        return None if self.true is None else Trajectory(self.true.poses[self.frames], self.true.time_s[self.frames])

    @cached_property
    def pose_covariances(self) -> Array | None:
        """Of x, y [m] and heading [rad] along the path ``(frames, 3, 3)``, as if motions erred independently; what they err
        in common, such as a scale by a wrong height, is not in it. None where the motions' covariances are not known."""
        if self.series.covariances is None:
            return None
        return pose_covariances(self.series, Pose(*self.path.poses[0]))

    def rows(self) -> list[Row]:
        """Name, value and unit of all that is told about the path: the one table for console, file and README."""
        count = len(self.estimates)
        rows: list[Row] = [("motions", count, ""), ("motions not believed, bridged", count - int(self.believed.sum()), "")]
        how = "fitted to the true path" if self.fitted else "as given"
        if self.fitted or (self.factors != 1).any():
            rows += [(f"scale of {axis.name}, {how}", float(f), "") for axis, f in zip(AXES, self.factors, strict=True)]
        if self.series.covariances is not None:
            told = np.sqrt(np.diagonal(self.series.covariances, axis1=1, axis2=2).mean(axis=0))
            rows += _by_axis("standard deviation of a motion as told", in_units(told))
        true = self.true_at_frames
        if self.true is None or true is None:
            return [*rows, ("estimated path length", path_length(self.path), "m")]
        errors = motion_errors(self.series.motions, motions(true.poses), np.ones(count, dtype=bool), self.series.covariances)
        rows += _by_axis("motion error RMSE", errors.rmse)
        rows += _by_axis("RMSE of always answering zero", errors.zero)
        rows += [(f"slope over the true {axis.name}", float(s), "") for axis, s in zip(AXES, errors.slope, strict=True)]
        if np.isfinite(errors.nees):
            rows.append(("squared motion error over its covariance, a third", errors.nees, ""))
        return rows + [(name, float(value), unit) for name, value, unit in assess(self.path, self.true).rows()]

    def warnings(self) -> list[str]:
        """What the user should know: how many motions are not believed, and why."""
        lost = [estimate.reason for estimate in self.estimates if not estimate.valid]
        if len(lost) <= MANY * len(self.estimates):
            return []
        part = 100 * len(lost) / len(self.estimates)
        return [
            f"{len(lost)} of {len(self.estimates)} motions ({part:.0f} %) are not believed and were bridged: {_usual(lost)}"
        ]


def odometry(
    frames: Source | SonarFrames,
    estimator: AnyEstimator,
    *,
    smooth: Smoothing = "none",
    scale: ArrayLike | Literal["fit"] | None = None,
    start: Pose | None = None,
    every: int = 1,
    workers: int = 1,
    known: Mapping[int, Estimate] | None = None,
    keep: Callable[[int, Estimate], None] = lambda number, estimate: None,
    progress: Callable[[int], None] = lambda pairs: None,
) -> Odometry:
    """The path that a sonar took, from its frames.

    Motions that are not believed are bridged: from those around them. ``smooth`` says what else is assumed of the vehicle:

    - ``none``: nothing. The path's end hardly depends on smoothing, since errors that average out in a smoothed motion
      average out in the sum as well, and corners stay corners.
    - ``spline``: the velocity changes slowly; how slowly is found by cross validation.
    - ``kalman``: the velocity walks at random; how far is found by maximum likelihood. Covariances are smoothed with it.

    Args:
        frames: of one run.
        estimator: what tells the motion between two frames.
        smooth: see above.
        scale: factors for sideways, forward, yaw ``(3,)``, or ``fit``: those that bring the believed motions nearest to the
            true ones.
        start: the first pose; default: the true one, or the origin with the height, pitch and roll of the first frame.
        every: use every so many frames only.
        workers: 1, this process; more, so many beside it. The result is the same, to the bit.
        known: estimates by the number of their pair, from an earlier try.
        keep: called with each new estimate.
        progress: called with the number of pairs that were added.

    Raises:
        MitsonarError: fewer than two frames, times that do not increase, frames without what the estimator needs, no motion
            that is believed, ``fit`` without true poses.
    """
    source = FrameSource.of(frames) if isinstance(frames, SonarFrames) else frames
    numbers = _frames_used(source, smooth, scale, every)
    estimates = estimate_motions(source, estimator, numbers, workers=workers, known=known, keep=keep, progress=progress)
    estimates = continued(estimates)
    measured = series_of(estimates, source.time_s[numbers])
    true = source.true
    factors = np.ones(3)
    if isinstance(scale, str):
        assert true is not None
        fit_on = measured.believed
        factors = fit_scale(measured.motions[fit_on], motions(true.poses[numbers])[fit_on])
    elif scale is not None:
        factors = np.asarray(scale, dtype=float)
    series = _SMOOTHED[smooth](scaled(measured, factors))
    path = path_of(series.motions, start or _start(source, int(numbers[0])), series.time_s)
    return Odometry(numbers, estimates, series, path, true, smooth, factors, isinstance(scale, str))


def _frames_used(source: Source, smooth: str, scale: ArrayLike | str | None, every: int) -> Index:
    """Numbers of the frames; what cannot work is refused before hours of estimating."""
    if every < 1:
        raise MitsonarError(f"{argument('every')} must be at least 1: got {every}")
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
            else f"{source.name} does not tell the true poses, which scale fit needs: give three factors"
        )
    return numbers


def _start(source: Source, first: int) -> Pose:
    """The true first pose, or what is known of it."""
    if source.poses is not None:
        return Pose(*(float(value) for value in source.poses[first]))
    height = 0.0 if source.height_m is None else float(np.nan_to_num(source.height_m[first]))
    return Pose(0.0, 0.0, height, source.pitch_rad or 0.0)


def _by_axis(what: str, values: Array) -> list[Row]:
    return [(f"{what}, {axis.name}", float(value), axis.unit) for axis, value in zip(AXES, values, strict=True)]


# ---------------------------------------------------------------- motions


def series_of(estimates: list[Estimate], time_s: ArrayLike) -> MotionSeries:
    """Estimates as a series.

    Raises:
        MitsonarError: none is believed; why is said.
    """
    if estimates and not any(estimate.valid for estimate in estimates):
        reasons = _usual([estimate.reason for estimate in estimates])
        raise MitsonarError(
            f"none of {len(estimates)} motions is believed, so that nothing tells the path ({reasons}): check what the "
            "estimator is told (height, attitude, window or receivers), or try another one"
        )
    return MotionSeries.from_estimates(estimates, time_s)


def bridged(measured: MotionSeries) -> MotionSeries:
    """Motions as measured; those that are not believed are filled in from the others: by the Kalman smoother, which tells
    how far to trust it, where covariances are known, else by straight lines between the velocities around them."""
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
    """The most frequent reasons, whatever the numbers in them."""
    kinds = Counter(re.sub(r"-?\d+(\.\d+)?", "#", reason) for reason in reasons).most_common(3)
    example = {re.sub(r"-?\d+(\.\d+)?", "#", reason): reason for reason in reversed(reasons)}
    return "; ".join(f"{count} times such as {example[kind]!r}" for kind, count in kinds)


# ---------------------------------------------------------------- estimating


def estimate_motions(
    source: Source,
    estimator: AnyEstimator,
    frames: ArrayLike,
    *,
    workers: int = 1,
    known: Mapping[int, Estimate] | None = None,
    keep: Callable[[int, Estimate], None] = lambda number, estimate: None,
    progress: Callable[[int], None] = lambda pairs: None,
) -> list[Estimate]:
    """What an estimator says of each pair of consecutive frames; some are in memory at a time.

    Args:
        source: where the frames are.
        estimator: what tells the motion.
        frames: numbers of the frames ``(n,)``; pair k is of the k-th and the next of them.
        workers: 1, this process; more, so many beside it, with one thread each.
        known: estimates by the number of their pair, from an earlier try.
        keep: called with each new estimate, in order.
        progress: called with the number of pairs that were added.

    Raises:
        MitsonarError: frames that cannot be read, or that lack what the estimator needs; a worker that was lost.
    """
    numbers = np.asarray(frames, dtype=np.intp)
    estimates = {pair: estimate for pair, estimate in (known or {}).items() if pair < len(numbers) - 1}
    if estimates:
        progress(len(estimates))
    batches = _batches([pair for pair in range(len(numbers) - 1) if pair not in estimates])
    made = _made_here if workers <= 1 else _made_beside
    with closing(made(source, estimator, numbers, batches, workers)) as found:
        for batch, answers in found:
            for pair, answer in zip(batch, answers, strict=True):
                estimates[pair] = answer
                keep(pair, answer)
            progress(len(batch))
    return [estimates[pair] for pair in range(len(numbers) - 1)]


def _batches(pairs: list[int]) -> list[range]:
    """Pairs that follow each other, a few at a time."""
    batches: list[range] = []
    for pair in pairs:
        if batches and batches[-1].stop == pair and len(batches[-1]) < PAIRS_A_BATCH:
            batches[-1] = range(batches[-1].start, pair + 1)
        else:
            batches.append(range(pair, pair + 1))
    return batches


def _made_here(
    source: Source, estimator: AnyEstimator, numbers: Index, batches: list[range], workers: int
) -> Generator[tuple[range, list[Estimate]]]:
    """Estimates of this process."""
    with _one_opencv_thread():
        for batch in batches:
            yield batch, _estimates(estimator, source.read(numbers[batch.start : batch.stop + 1]))


def _made_beside(
    source: Source, estimator: AnyEstimator, numbers: Index, batches: list[range], workers: int
) -> Generator[tuple[range, list[Estimate]]]:
    """Estimates of processes that are started anew; this one reads the frames."""
    with _one_thread_each():
        pool = ProcessPoolExecutor(
            min(workers, max(1, len(batches))), multiprocessing.get_context("spawn"), _begin_worker, (estimator,)
        )
        waiting: deque[tuple[range, Future[list[Estimate]]]] = deque()
        try:
            for batch in batches:
                waiting.append((batch, pool.submit(_in_worker, source.read(numbers[batch.start : batch.stop + 1]))))
                if len(waiting) > 2 * workers:
                    first, answers = waiting.popleft()
                    yield first, answers.result()
            while waiting:
                first, answers = waiting.popleft()
                yield first, answers.result()
        except BrokenProcessPool:
            raise MitsonarError(
                "a worker was lost: it was killed, or the memory did not suffice; go on with fewer workers"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def _estimates(estimator: Any, frames: Any) -> list[Estimate]:
    """Of consecutive frames or pings."""
    pairs = [frames.select(slice(k, k + 2)) for k in range(len(frames) - 1)]
    return [rejected("no height was found in the frames") if without_height(p) else estimator.estimate(p) for p in pairs]


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    had = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(had)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that are started meanwhile compute with one thread: libraries read this when they are loaded."""
    had = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in had.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


_worker: AnyEstimator
"""Of this process, where it is a worker."""


def _begin_worker(estimator: AnyEstimator) -> None:
    global _worker
    _worker = estimator
    cv2.setNumThreads(1)
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches all processes of a terminal: the first one stops the others
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _in_worker(frames: Any) -> list[Estimate]:
    return _estimates(_worker, frames)
