"""Losses of training: eq. 3.1, eq. 3.2-3.3 with the penalty (Almanza-Medina, 3.4), and the Gaussian likelihood."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mitsonar.config.training import Loss
from mitsonar.datasets.arrangement import Labels
from mitsonar.networks.corrnet import GaussianHead, likelihood

if TYPE_CHECKING:
    from mitsonar.training.training_types import NetworkOutput

__all__ = ["create_loss", "squared_error"]


def squared_error(
    estimates: Tensor, labels: Tensor, *, penalty: float = 0.0, low: Tensor | float = -10.0, high: Tensor | float = 10.0
) -> Tensor:
    """Return the loss of eq. 3.1, or with a penalty that of eq. 3.3: the sum of squared errors and penalties over 2 S W.

    Args:
        estimates: ``(S, W)`` in label units.
        labels: ``(S, W)`` in label units.
        penalty: eta of eq. 3.2.
        low: u_1 of eq. 3.2, one value or one for each of the W labels.
        high: u_2 of eq. 3.2, one value or one for each of the W labels.
    """
    square = (estimates - labels).square()
    if penalty:
        beyond = (low - estimates).clamp(min=0) + (estimates - high).clamp(min=0)
        square = square + penalty * beyond.square()
    return square.sum() / (2 * square.numel())


def create_loss(loss: Loss, labels: Labels) -> Callable[[NetworkOutput, Tensor], Tensor]:
    """Return the loss of a network's output ``(batch, outputs)`` against labels, as a recipe defines it."""
    if loss.kind == "likelihood":
        return _likelihood
    low, high = (torch.from_numpy(labels.encode(end)) for end in (labels.low, labels.high))
    if loss.bounds is not None:
        low, high = (torch.full_like(low, bound) for bound in loss.bounds)

    def regression(estimates: NetworkOutput, target: Tensor) -> Tensor:
        assert isinstance(estimates, Tensor)
        ends = {"low": low.to(estimates), "high": high.to(estimates)} if loss.penalty else {}
        return squared_error(estimates, target, penalty=loss.penalty, **ends)

    return regression


def _likelihood(estimates: NetworkOutput, target: Tensor) -> Tensor:
    assert isinstance(estimates, GaussianHead)
    return likelihood(estimates, target)
