"""Errors of motions with names and units, as every table prints them, and their confidence intervals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError

__all__ = ["AXES", "Axis", "MotionErrors", "cluster_resamples", "in_units", "motion_errors"]

Array = NDArray[np.float64]


class Axis(NamedTuple):
    """One number of a motion: its name, its printed unit, and the factor from m or rad to that unit."""

    name: str
    unit: str
    scale: float


AXES = (Axis("sideways", "mm", 1e3), Axis("forward", "mm", 1e3), Axis("yaw", "deg", 180 / np.pi))
"""The numbers of a motion, always in this order."""

LARGE = 0.5
"""Motions beyond this part of the largest get a separate error: methods that learned the usual size are worse there."""


def in_units(motions: ArrayLike) -> Array:
    """Convert motions ``(..., 3)`` from m, m, rad to mm, mm, deg."""
    scaled: Array = np.asarray(motions, dtype=float) * np.array([axis.scale for axis in AXES])
    return scaled


@dataclass(frozen=True)
class MotionErrors:
    """Errors of estimated motions, each ``(3,)``: sideways [mm], forward [mm], yaw [deg].

    Attributes:
        pairs: number of motions.
        failures: number of rejected estimates; they count as zero motion.
        rmse: root of the mean square.
        rmse_low: lower end of its 95 % interval (clustered bootstrap), where resamples were given.
        rmse_high: upper end of that interval.
        median: of the absolute errors.
        p95: their 95th percentile.
        bias: mean error.
        slope: of the estimates over the true motions, by least squares through the origin. 1 is unbiased; below 1 the
            estimates are too small.
        large: RMSE of motions beyond half the largest, axis by axis.
        zero: RMSE of the answer zero for every motion.
        skill: 1 - rmse / zero.
        believed: RMSE of the valid estimates alone.
        nees: normalised estimation error squared, a third of it (1: consistent); nan without covariances.
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
    """Compute the errors of estimated motions against the true ones. Rejected estimates count as zero motion.

    Args:
        estimated: sideways, forward [m], yaw [rad] ``(n, 3)``.
        true: the same of the true motions.
        valid: False for estimates that the method rejected ``(n,)``.
        covariances: of the estimates ``(n, 3, 3)``, nan where unknown.
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
    low, high = (rmse, rmse) if resamples is None else _rms_interval(error, resamples)
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
    """Draw bootstrap samples by scene, then by sequence.

    Each resample draws as many scenes as there are, with replacement, and from each as many of its sequences. Scenes differ
    in size. So surplus draws are left out, and missing ones are drawn from the same scenes, until each resample has n.

    With few scenes the intervals are too narrow. In a trial whose scenes differed by a factor of 1.8 they held the true RMSE
    in 73 % of cases with 5 scenes, 79 % with 10 and 88 % with 50.

    Args:
        scene: of each sequence ``(n,)``.
        count: number of resamples.
        seed: of the draws.

    Returns:
        Indices ``(count, n)`` into arrays of one pair a sequence.
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


def _rms_interval(error: Array, resamples: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the 95 % interval of the root of the mean square."""
    low, high = np.percentile(np.sqrt((error**2)[resamples].mean(axis=1)), [2.5, 97.5], axis=0)
    return low, high


def _rms(error: Array) -> Array:
    return np.asarray(np.sqrt((error**2).mean(axis=0)))


def _rms_of_known(error: Array) -> Array:
    """Return the root of the mean square of the values that are not nan; nan where there are none."""
    count = np.isfinite(error).sum(axis=0)
    return np.where(count > 0, np.sqrt(np.nansum(error**2, axis=0) / np.maximum(count, 1)), np.nan)


def _nees(error: Array, covariances: Array | None, valid: NDArray[np.bool_]) -> float:
    """Return the mean normalised squared error of the valid estimates that have a covariance, a third of it."""
    if covariances is None:
        return float("nan")
    known = valid & np.isfinite(covariances).all(axis=(1, 2))
    if not known.any():
        return float("nan")
    solved = (np.linalg.pinv(covariances[known], hermitian=True) @ error[known][..., None])[..., 0]
    return float((error[known] * solved).sum(axis=1).mean() / 3)
