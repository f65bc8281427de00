"""Motions between consecutive frames with their errors: composed to a path (Almanza-Medina, eq. 3.4), and scaled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory

__all__ = ["MotionSeries", "fit_scale", "path_of", "scaled"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MotionSeries:
    """Motions between consecutive frames, and what is known of their errors.

    Attributes:
        motions: sideways, forward [m], yaw [rad] ``(frames - 1, 3)`` (eq. 3.4).
        time_s: of the frames ``(frames,)``, increasing, not necessarily evenly.
        covariances: of the errors of the motions ``(frames - 1, 3, 3)`` [m, m, rad], where known.
        valid: False where a motion and its covariance must not be used ``(frames - 1,)``; None: all are valid.
        with_next: covariance of each motion's error (rows) with that of the next (columns) ``(frames - 2, 3, 3)``. Errors
            further apart depend on each other only through those between (Markov). None: errors are independent.

    Raises:
        MitsonarError: shapes that do not fit, times that do not increase, no valid motion, or a valid motion that is not
            finite or has no valid covariance.
    """

    motions: Array
    time_s: Array
    covariances: Array | None = None
    valid: NDArray[np.bool_] | None = None
    with_next: Array | None = None

    def __post_init__(self) -> None:
        count = len(self.time_s) - 1
        if count < 1:
            raise MitsonarError(f"a path needs two frames or more: got {count + 1}; give a longer run")
        if self.motions.shape != (count, 3):
            raise MitsonarError(f"motions must be ({count}, 3) for {count + 1} frame times: got {self.motions.shape}")
        if not (np.isfinite(self.time_s).all() and (np.diff(self.time_s) > 0).all()):
            raise MitsonarError("frame times must be finite and increase: sort the frames, or give their times")
        if self.believed.shape != (count,):
            raise MitsonarError(f"valid must be ({count},), one for each motion: got {self.believed.shape}")
        if not self.believed.any():
            raise MitsonarError(f"none of {count} motions is valid, so that there is no path: try another estimator")
        self._refuse(~np.isfinite(self.motions).all(axis=1), "is not finite")
        if self.covariances is not None:
            self._check_covariances(self.covariances)
        if self.with_next is not None and self.with_next.shape != (count - 1, 3, 3):
            raise MitsonarError(f"with_next must be ({count - 1}, 3, 3): got {self.with_next.shape}")

    def _check_covariances(self, covariances: Array) -> None:
        if covariances.shape != (len(self), 3, 3):
            raise MitsonarError(f"covariances must be ({len(self)}, 3, 3), one a motion: got {covariances.shape}")
        self._refuse(~np.isfinite(covariances).all(axis=(1, 2)), "has a covariance that is not finite")
        known = np.where(self.believed[:, None, None], covariances, np.eye(3))
        crooked = np.abs(known - known.swapaxes(1, 2)).max(axis=(1, 2)) > 1e-9 * np.abs(known).max(axis=(1, 2))
        least = np.linalg.eigvalsh(known)
        self._refuse(crooked | (least[:, 0] < -1e-9 * least[:, 2]), "has a covariance with a negative variance, or lopsided")

    def _refuse(self, bad: ArrayLike, what: str) -> None:
        where = np.flatnonzero(np.asarray(bad) & self.believed)
        if where.size:
            raise MitsonarError(
                f"the motion from frame {where[0]} to {where[0] + 1} {what} ({where.size} of {len(self)} are so): "
                "mark it as not valid, or leave it out"
            )

    def __len__(self) -> int:
        """Return the number of motions: one less than frames."""
        return len(self.time_s) - 1

    @classmethod
    def from_estimates(cls, estimates: Sequence[Estimate], time_s: ArrayLike) -> Self:
        """Collect the estimates of consecutive frames at ``time_s`` ``(frames,)`` [s].

        The series has covariances only if every valid estimate has one.
        """
        valid = np.array([estimate.valid for estimate in estimates], dtype=bool)
        unknown = np.full((3, 3), np.nan)
        covariances = [unknown if one.covariance is None else one.covariance for one in estimates]
        known = all(one.covariance is not None for one in estimates if one.valid)
        motions = np.array([one.motion for one in estimates], dtype=float).reshape(-1, 3)
        return cls(motions, np.asarray(time_s, dtype=float), np.array(covariances) if known else None, valid)

    @cached_property
    def believed(self) -> NDArray[np.bool_]:
        """Return which motions are valid ``(frames - 1,)``."""
        return np.ones(len(self), dtype=bool) if self.valid is None else self.valid

    @cached_property
    def step_s(self) -> Array:
        """Return the time from frame to frame ``(frames - 1,)`` [s]."""
        return np.diff(self.time_s)

    @cached_property
    def middle_s(self) -> Array:
        """Return the time half-way through each motion ``(frames - 1,)`` [s], at which it has its mean velocity."""
        return (self.time_s[1:] + self.time_s[:-1]) / 2

    @cached_property
    def velocity(self) -> Array:
        """Return the mean velocity of each motion in the vehicle's frame ``(frames - 1, 3)`` [m/s, m/s, rad/s]."""
        return self.motions / self.step_s[:, None]


# ---------------------------------------------------------------- composition


def path_of(motions: ArrayLike, start: Pose, time_s: ArrayLike) -> Trajectory:
    """Compose motions to a path from ``start`` (Almanza-Medina, eq. 3.4).

    Each step is :func:`mitsonar.motion.composition.compose`; :func:`mitsonar.motion.composition.motions` is the inverse.
    Height, pitch and roll stay those of ``start``.

    Args:
        motions: sideways, forward [m], yaw [rad] ``(frames - 1, 3)``.
        start: the first pose.
        time_s: of the frames ``(frames,)`` [s].

    Raises:
        MitsonarError: shapes that do not fit, a motion that is not finite, times that do not increase.
    """
    series = MotionSeries(np.asarray(motions, dtype=float), np.asarray(time_s, dtype=float))
    sideways, forward, yaw = series.motions.T
    heading = start.heading + np.cumsum(yaw)
    sin, cos = np.sin(heading), np.cos(heading)
    poses = np.tile(np.asarray(start, dtype=float), (len(series) + 1, 1))
    poses[1:, 0] += np.cumsum(forward * sin + sideways * cos)
    poses[1:, 1] += np.cumsum(forward * cos - sideways * sin)
    poses[1:, 5] = heading
    return Trajectory(poses, series.time_s)


# ---------------------------------------------------------------- scale


def scaled(measured: MotionSeries, factors: ArrayLike) -> MotionSeries:
    """Multiply motions and their covariances by a factor for each of sideways, forward, yaw ``(3,)``.

    Almanza-Medina takes 2.3 for sideways (3.5.2), and 9.0 for sideways with 4.0 for forward (3.5.3).

    Raises:
        MitsonarError: not three finite factors.
    """
    factor = np.asarray(factors, dtype=float)
    if factor.shape != (3,) or not np.isfinite(factor).all():
        raise MitsonarError(f"scale factors are three finite numbers, for sideways, forward, yaw: got {factors!r}")
    both = np.outer(factor, factor)
    covariances, with_next = (None if c is None else c * both for c in (measured.covariances, measured.with_next))
    return replace(measured, motions=measured.motions * factor, covariances=covariances, with_next=with_next)


def fit_scale(estimated: ArrayLike, true: ArrayLike) -> Array:
    """Fit the factors ``(3,)`` from estimated to true motions, both ``(frames - 1, 3)``.

    Each axis is fitted by least squares through the origin. An axis whose estimates are all zero keeps the factor 1. Noise
    in the estimates lowers a factor by signal / (signal + noise) power.

    Raises:
        MitsonarError: motions of different shapes, or not finite.
    """
    e, t = np.asarray(estimated, dtype=float), np.asarray(true, dtype=float)
    if e.shape != t.shape or e.ndim != 2 or e.shape[1] != 3 or not (np.isfinite(e).all() and np.isfinite(t).all()):
        raise MitsonarError(
            f"scale factors need as many true as estimated motions (motions, 3): got {e.shape} and {t.shape}"
        )
    power = (e * e).sum(axis=0)
    return np.where(power > 0, (e * t).sum(axis=0) / np.where(power > 0, power, 1), 1.0)
