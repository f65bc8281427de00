"""Named numbers with units: errors of motions as every table prints them, and how sure they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError

__all__ = ["AXES", "Axis", "MotionErrors", "cluster_resamples", "in_units", "motion_errors"]

Array = NDArray[np.float64]


class Axis(NamedTuple):
    """One number of a motion: its name, the unit that is printed, and how many of it are 1 m or 1 rad."""

    name: str
    unit: str
    scale: float


AXES = (Axis("sideways", "mm", 1e3), Axis("forward", "mm", 1e3), Axis("yaw", "deg", 180 / np.pi))
"""Always in this order."""

LARGE = 0.5
"""Motions beyond this part of the largest are also told alone: methods that know the usual size do worse there."""


def in_units(motions: ArrayLike) -> Array:
    """Motions ``(..., 3)`` [m, m, rad] as mm, mm, deg."""
    return np.asarray(motions, dtype=float) * np.array([axis.scale for axis in AXES])


@dataclass(frozen=True)
class MotionErrors:
    """Errors of estimated motions, each ``(3,)``: sideways [mm], forward [mm], yaw [deg].

    Attributes:
        pairs: how many motions.
        failures: how many were not believed; they count as zero motion.
        rmse: root of the mean square.
        rmse_low: lower end of its 95 % interval (clustered bootstrap), where resamples were given,
        rmse_high: and upper end.
        median: of the absolute errors.
        p95: their 95th percentile.
        bias: mean error.
        slope: of the estimates over the true motions, by least squares through the origin; 1 is right, below 1 shrinks.
        large: RMSE of motions beyond half the largest, axis by axis.
        zero: RMSE of always answering zero.
        skill: 1 - rmse / zero.
        believed: RMSE of the believed ones alone.
        nees: squared errors over the covariance they were given, a third of it (1: honest); nan without covariances.
    """

    pairs: int
    failures: int
    rmse: Array
    rmse_low: Array
    rmse_high: Array
    median: Array
    p95: Array
    bias: Array
    slope: Array
    large: Array
    zero: Array
    skill: Array
    believed: Array
    nees: float


def motion_errors(
    estimated: Array,
    true: Array,
    valid: NDArray[np.bool_],
    covariances: Array | None = None,
    resamples: NDArray[np.int64] | None = None,
) -> MotionErrors:
    """Errors of estimated motions ``(n, 3)`` [m, m, rad] against the true ones; those not believed count as zero motion.

    Args:
        estimated: by a method.
        true: as they were.
        believe: which the method stands for ``(n,)``.
        covariances: it gave ``(n, 3, 3)``, nan where none.
        resamples: see :func:`cluster_resamples`.

    Raises:
        MitsonarError: shapes that do not fit, no motions.
    """
    if not len(true) or estimated.shape != true.shape or valid.shape != (len(true),):
        raise MitsonarError(
            "errors need as many estimates as true motions, one at least: got "
            f"{estimated.shape}, {true.shape}, {valid.shape}"
        )
    answer = in_units(np.where(valid[:, None], estimated, 0.0))
    truth = in_units(true)
    error = answer - truth
    rmse, zero = _rms(error), _rms(truth)
    low, high = rmse, rmse
    if resamples is not None:
        low, high = np.percentile(np.sqrt((error**2)[resamples].mean(axis=1)), [2.5, 97.5], axis=0)
    size = np.abs(truth)
    large = np.where(size > LARGE * size.max(axis=0), error, np.nan)
    power = (truth**2).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        slope, skill = (answer * truth).sum(axis=0) / power, 1 - rmse / zero
    return MotionErrors(
        pairs=len(true),
        failures=int((~valid).sum()),
        rmse=rmse,
        rmse_low=low,
        rmse_high=high,
        median=np.median(np.abs(error), axis=0),
        p95=np.percentile(np.abs(error), 95, axis=0),
        bias=error.mean(axis=0),
        slope=slope,
        large=_rms_of_known(large),
        zero=zero,
        skill=skill,
        believed=_rms(error[valid]) if valid.any() else np.full(3, np.nan),
        nees=_nees(estimated - true, covariances, valid),
    )


def cluster_resamples(scene: ArrayLike, *, count: int = 1000, seed: int = 0) -> NDArray[np.int64]:
    """Bootstrap by scene, then by sequence: places ``(count, n)`` in arrays of one pair a sequence.

    Each resample draws as many scenes as there are, with replacement, and from each as many of its sequences. Scenes differ
    in size: what is too much is left out, what lacks is drawn once more from the same scenes, so that each has n places.
    With few scenes intervals are too narrow: of true RMSEs they held 73 % with 5 scenes, 79 % with 10 and 88 % with 50, in
    a trial whose scenes differed by a factor of 1.8.
    """
    names, group = np.unique(np.asarray(scene), return_inverse=True)
    total = len(group)
    order, size = np.argsort(group, kind="stable"), np.bincount(group)
    start = np.concatenate([[0], np.cumsum(size)[:-1]])
    rng = np.random.default_rng([seed, 7])
    table = np.empty((count, total), dtype=np.int64)
    for row in table:
        drawn = rng.integers(len(names), size=len(names))
        of = np.repeat(drawn, size[drawn])
        of = np.concatenate([of, rng.choice(of, size=max(0, total - len(of)))])[:total]
        row[:] = order[start[of] + (rng.random(total) * size[of]).astype(np.int64)]
    return table


def _rms(error: Array) -> Array:
    return np.asarray(np.sqrt((error**2).mean(axis=0)))


def _rms_of_known(error: Array) -> Array:
    """Root of the mean square of what is not nan; nan where nothing is."""
    count = np.isfinite(error).sum(axis=0)
    return np.where(count > 0, np.sqrt(np.nansum(error**2, axis=0) / np.maximum(count, 1)), np.nan)


def _nees(error: Array, covariances: Array | None, valid: NDArray[np.bool_]) -> float:
    """Mean normalised squared error of the believed ones that have a covariance, a third of it."""
    if covariances is None:
        return float("nan")
    known = valid & np.isfinite(covariances).all(axis=(1, 2))
    if not known.any():
        return float("nan")
    solved = (np.linalg.pinv(covariances[known], hermitian=True) @ error[known][..., None])[..., 0]
    return float((error[known] * solved).sum(axis=1).mean() / 3)
