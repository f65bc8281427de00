"""Estimates are held against what was expected: a motion that a prior all but excludes is rejected."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.motion.errors import in_units

__all__ = ["prior_rejection"]

LARGEST_SQUARE = 21.1
"""Chi-square of three numbers that one right estimate in ten thousand exceeds."""


def prior_rejection(motion: Motion, covariance: NDArray[np.float64] | None, prior: MotionPrior | None) -> str:
    """Return why a motion contradicts its prior; empty where it does not, or where there is no prior.

    The squared distance is measured by the sum of both covariances, and compared with chi-square of three numbers at 0.9999.

    Args:
        motion: estimated from the frames alone.
        covariance: of it ``(3, 3)`` [m, m, rad]; None: unknown, and not counted.
        prior: what was expected.
    """
    if prior is None:
        return ""
    apart = np.array(motion) - np.array(prior.motion)
    together = prior.covariance if covariance is None else prior.covariance + covariance
    std = np.sqrt(np.diag(together))
    std[std == 0] = 1
    scaled = apart / std  # else a component of large variance makes the solver drop the others
    square = float(scaled @ np.linalg.lstsq(together / np.outer(std, std), scaled, rcond=None)[0])
    if square <= LARGEST_SQUARE:
        return ""
    sideways, forward, yaw = in_units(apart)
    off = np.sqrt(square)
    return f"the motion is {sideways:.0f}, {forward:.0f} mm, {yaw:.2f} deg from the prior: {off:.1f} standard deviations"
