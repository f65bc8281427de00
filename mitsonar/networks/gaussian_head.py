"""The output of networks that estimate their uncertainty: a Gaussian distribution of the motion, and its likelihood."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["GaussianHead", "likelihood"]


class GaussianHead(NamedTuple):
    """Mean and covariance of motions: sideways, forward [m], yaw [rad].

    Attributes:
        mean: ``(batch, 3)``; in training ``(iterations, batch, 3)``, the last iteration last.
        covariance: ``(batch, 3, 3)``, or ``(iterations, batch, 3, 3)``.
    """

    mean: Tensor
    covariance: Tensor


SCALE = (1e-3, 1e-3, 2.5e-4)
"""Units of the likelihood [m, m, rad]. They are about as large as errors, so that float32 suffices."""


def likelihood(head: GaussianHead, target: Tensor, *, fading: float = 0.6) -> Tensor:
    """Compute the negative log-likelihood of the target, in units of mm, mm, 0.25 mrad, mean over the batch.

    Args:
        head: distribution of the motion.
        target: ``(batch, 3)`` [m, m, rad].
        fading: weight of an iteration relative to the next one.

    Returns:
        A scalar, summed over the iterations.
    """
    mean, covariance = head
    if mean.dim() == 2:
        mean, covariance = mean[None], covariance[None]
    scale = torch.tensor(SCALE, dtype=mean.dtype, device=mean.device)
    error = (mean - target) / scale
    factor = torch.linalg.cholesky(covariance / (scale[:, None] * scale))
    white = torch.linalg.solve_triangular(factor, error[..., None], upper=False)[..., 0]
    each = 0.5 * white.square().sum(-1) + factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    weight = fading ** torch.arange(len(mean) - 1, -1, -1, dtype=mean.dtype, device=mean.device)
    total: Tensor = (weight * each.mean(dim=1)).sum()
    return total
