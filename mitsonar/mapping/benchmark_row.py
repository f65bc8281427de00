"""One row of the odometry benchmark: a method on the frames of one set, its path, errors, time and failures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.compare import Answers
from mitsonar.estimation.estimator import AnyEstimator, Estimate, PlainTable
from mitsonar.io.runs import RunDirectory
from mitsonar.mapping.benchmark_sets import PRESET
from mitsonar.mapping.frame_source import FrameSource
from mitsonar.mapping.odometry import Odometry
from mitsonar.mapping.odometry_run import ODOMETRY, OdometryFolder, run_odometry
from mitsonar.mapping.open_source import LOOP
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import (
    assess,
    cluster_resamples,
    distance_driven,
    in_units,
    motion_errors,
    path_length,
    segment_drift,
)
from mitsonar.motion.trajectory import Trajectory

__all__ = ["LENGTHS_M", "Case", "measured_row"]

Array = NDArray[np.float64]

LENGTHS_M = (1.0, 2.0, 5.0)
"""Lengths of the segments of drift [m]; KITTI has 100 to 800 m."""

TIMED_PAIRS = 15
"""Pairs whose estimates are timed, evenly spaced."""


@dataclass(frozen=True)
class Case:
    """What a row is of.

    Attributes:
        name: of the set, or the path of a recording.
        texture: ``still``, ``speckle``, or ``recorded``.
        noise: level.
        method: name of the estimator.
        geometry: file that tells how the pictures of a recording are laid out.
    """

    name: str
    texture: str
    noise: str
    method: str
    geometry: Path | None = field(default=None, compare=False)

    @property
    def words(self) -> tuple[str, str, str, str]:
        """Return set, texture, noise and method."""
        return self.name, self.texture, self.noise, self.method

    @property
    def command(self) -> str:
        """Return the words of the command line that make this row, after ``mitsonar benchmark odometry``."""
        geometry = [] if self.geometry is None else [f"--geometry {self.geometry}"]
        if self.texture == "recorded":
            return " ".join([f"--set {self.name}", *geometry, f"--method {self.method}"])
        noise = [] if self.noise == PRESET else [f"--noise {self.noise}"]
        return " ".join([f"--set {self.name} --texture {self.texture}", *noise, f"--method {self.method}"])


def measured_row(
    case: Case,
    source: FrameSource,
    estimator: AnyEstimator,
    folder: Path,
    *,
    bound: Array | None = None,
    workers: int = 1,
    progress: Callable[[int], None] = lambda pairs: None,
) -> PlainTable:
    """Estimate the path of a set, and compute what the table of the benchmark shows.

    Invalid motions are failures; they are bridged from their neighbours, as :func:`mitsonar.mapping.odometry.odometry` does.

    Args:
        case: what the row is of.
        source: of its frames.
        estimator: the method.
        folder: of the odometry; an interrupted one goes on.
        bound: of a motion ``(3,)`` [m, m, rad], where it is known.
        workers: processes beside this one.
        progress: called with the number of pairs that were added.

    Returns:
        Numbers, lists and texts, for JSON: None where a number is not known.

    Raises:
        MitsonarError: frames that the estimator does not take.
    """
    pairs = len(source) - 1
    row: PlainTable = dict(zip(("set", "texture", "noise", "method"), case.words, strict=True))
    row |= {"command": case.command, "inputs": estimator.inputs, "frames": len(source), "pairs": pairs, "note": ""}
    loop = LOOP if source.true is None and pairs > LOOP else 0
    try:
        found = run_odometry(
            source, case.method, estimator, folder, closure=loop, workers=workers, resume=True, progress=progress
        )
    except MitsonarError as error:
        estimates = _kept(folder)
        if len(estimates) < pairs or any(one.valid for one in estimates):
            raise
        return row | {"failures": pairs, "note": str(error), "ms": _milliseconds(source, estimator)}
    row |= {"failures": int((~found.believed).sum()), "ms": _milliseconds(source, estimator)}
    row |= {"estimated_path_m": path_length(found.path)}
    return row | (_without_truth(found) if found.true is None else _against_truth(found, found.true, bound))


def _kept(folder: Path) -> list[Estimate]:
    """Return the estimates of a row that failed."""
    if not (folder / "run.json").exists():
        return []
    return list(OdometryFolder(RunDirectory.open(folder, ODOMETRY)).kept().values())


def _without_truth(found: Odometry) -> PlainTable:
    """Return what is known of a path without truth: its ends, and what loops leave over."""
    end = found.path.poses[-1] - found.path.poses[0]
    row: PlainTable = {"net": [float(end[0]), float(end[1]), float(np.degrees(end[5]))]}
    row |= {"sums": in_units(found.series.motions.sum(axis=0)).tolist()}
    if found.closure is not None:
        row |= {"closure_steps": found.closure.steps, "closure": in_units(found.closure.rms).tolist()}
    return row


def _against_truth(found: Odometry, true: Trajectory, bound: Array | None) -> PlainTable:
    """Return the errors of a path: drift over segments, at the end, and of single motions."""
    at_frames = Trajectory(true.poses[found.frames], true.time_s[found.frames])
    row: PlainTable = {"path_m": path_length(at_frames)}
    drift = segment_drift(found.path, at_frames, LENGTHS_M)
    if drift is not None:
        percent, degrees = drift.intervals()
        row |= {"drift_percent": [drift.percent, *percent], "drift_deg_per_100m": [drift.deg_per_100m, *degrees]}
        row |= {"lengths_m": list(drift.lengths_m), "segments": len(drift.length_m), "blocks": len(np.unique(drift.blocks))}
    end = 100 * assess(found.path, at_frames).end_drift
    row |= {"end_percent": end if np.isfinite(end) else None}
    truth, block = motions(at_frames.poses), distance_driven(at_frames)[:-1] // LENGTHS_M[0]
    errors = motion_errors(found.series.motions, truth, np.ones(len(truth), dtype=bool), None, cluster_resamples(block))
    row |= {name: getattr(errors, name).tolist() for name in ("rmse", "rmse_low", "rmse_high", "zero", "bias")}
    nees = _nees(found.estimates, truth)
    row |= {"nees": nees if np.isfinite(nees) else None}
    if bound is not None:
        units = in_units(bound)
        known = (units > 0) & np.isfinite(units)
        times = np.divide(errors.rmse, units, out=np.zeros(3), where=known)
        row |= {"bound": units.tolist()} if np.isfinite(units).all() else {}
        row |= {"over_bound": [float(t) if k else None for t, k in zip(times, known, strict=True)]}
    return row


def _nees(estimates: list[Estimate], truth: Array) -> float:
    """Return a third of the mean normalised squared error of the valid estimates; nan where no covariance is known."""
    unknown = np.full((3, 3), np.nan)
    motion = np.array([one.motion for one in estimates], dtype=float)
    covariance = np.array([unknown if one.covariance is None else one.covariance for one in estimates])
    return motion_errors(motion, truth, np.array([one.valid for one in estimates], dtype=bool), covariance).nees


def _milliseconds(source: FrameSource, estimator: AnyEstimator) -> float:
    """Return the median processor time of an estimate, all threads together, after a first one that loads [ms]."""
    first = np.unique(np.linspace(0, len(source) - 2, TIMED_PAIRS).astype(int))
    timed, threads = Answers.unasked(len(first)), cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        estimator.estimate(source.read([first[0], first[0] + 1]))
        for index, number in enumerate(first):
            timed.ask(index, estimator, source.read([number, number + 1]))
    finally:
        cv2.setNumThreads(threads)
    return float(np.median(timed.ms))
