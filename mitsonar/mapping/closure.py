"""Closure, a quality without truth: single motions composed, less the motion over all of them estimated at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.estimator import AnyEstimator, Estimate
from mitsonar.mapping.open_source import Source
from mitsonar.mapping.pair_estimation import estimate_motions

__all__ = ["Closure", "closure_of", "loop_starts"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

FEWEST = 2
"""Loops from which errors are judged."""


@dataclass(frozen=True)
class Closure:
    """Loops over ``steps`` motions: composed, less estimated at once.

    Attributes:
        steps: motions of a loop.
        residuals: sideways, forward [m], yaw [rad] that each loop leaves over ``(loops, 3)``.
        factor: by which the covariances of single motions must be multiplied, so that they explain the residuals; at
            least 1. nan where they are not known.
    """

    steps: int
    residuals: Array
    factor: float

    @property
    def rms(self) -> Array:
        """Return the root of the mean square of the residuals ``(3,)`` [m, m, rad]."""
        return np.asarray(np.sqrt((self.residuals**2).mean(axis=0)))

    @property
    def mean(self) -> Array:
        """Return the mean of the residuals ``(3,)`` [m, m, rad]: single steps are too long or too short by it."""
        return np.asarray(self.residuals.mean(axis=0))

    def honest(self, estimates: Sequence[Estimate]) -> list[Estimate]:
        """Return the estimates with covariances that explain the residuals.

        Covariances are multiplied by the factor. Estimates without one get the mean square of the residuals, of which each
        of the motions of a loop and the one over all of them hold an equal part.
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
    """Estimate motions over several steps at once, and compare them with the single steps composed.

    Loops follow one another without overlap, so that their errors are independent. Of a short run they overlap, so that
    there are 16 of them, or as many as fit.

    Args:
        source: of the records.
        estimator: the one of the single steps.
        numbers: of the frames used ``(frames,)``.
        estimates: of the single steps ``(frames - 1,)``.
        steps: motions of a loop.
        progress: called with the number of loops that were added, also of those left out.

    Returns:
        The closure; None where fewer than two loops have valid motions throughout.
    """
    valid = np.array([one.valid for one in estimates], dtype=bool)
    residuals, explained = [], []
    for start in (int(one) for one in loop_starts(len(estimates), steps)):
        if not valid[start : start + steps].all():
            progress(1)
            continue
        ends = np.array([numbers[start], numbers[start + steps]])
        whole = estimate_motions(source, estimator, ends)[0]
        progress(1)
        if not whole.valid:
            continue
        parts = list(estimates[start : start + steps])
        residual = _composed(np.array([one.motion for one in parts])) - np.asarray(whole.motion)
        residuals.append(residual)
        covariances = [one.covariance for one in (*parts, whole) if one.covariance is not None]
        if len(covariances) == steps + 1:
            total = np.sum(np.array(covariances), axis=0)
            explained.append(float(residual @ np.linalg.solve(total, residual)) / 3)
    if len(residuals) < FEWEST:
        return None
    factor = max(1.0, float(np.mean(explained))) if len(explained) == len(residuals) else float("nan")
    return Closure(steps, np.array(residuals), factor)


def loop_starts(motions: int, steps: int) -> Index:
    """Return the first motion of each loop over ``steps`` of so many motions."""
    stride = max(1, min(steps, (motions - steps) // 15 if motions > steps else 1))
    return np.arange(0, motions - steps + 1, stride, dtype=np.intp)


def _composed(motions: Array) -> Array:
    """Return the motion ``(3,)`` of consecutive motions ``(steps, 3)``, in axes of the last heading (eq. 3.4)."""
    heading = np.cumsum(motions[:, 2])
    turn = heading[-1] - heading
    sideways = motions[:, 0] * np.cos(turn) - motions[:, 1] * np.sin(turn)
    forward = motions[:, 0] * np.sin(turn) + motions[:, 1] * np.cos(turn)
    return np.array([sideways.sum(), forward.sum(), heading[-1]])
