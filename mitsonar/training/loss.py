"""What training makes small (Almanza-Medina, 3.4): eq. 3.1, eq. 3.2-3.3 with the penalty, and the likelihood of a law."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mitsonar.config.training_recipe import Loss
from mitsonar.datasets.arrangement import Labels
from mitsonar.networks.gaussian_head import likelihood

__all__ = ["create_loss", "squared_error"]


def squared_error(
    estimates: Tensor, labels: Tensor, *, penalty: float = 0.0, low: Tensor | float = -10.0, high: Tensor | float = 10.0
) -> Tensor:
    """Eq. 3.1, or with a penalty eq. 3.3: squared errors and penalties, summed, over 2 S W.

    Args:
        estimates: ``(S, W)`` in label units.
        labels: ``(S, W)``.
        penalty: eta of eq. 3.2.
        low, high: u_1 and u_2 of eq. 3.2, for each of the W or for all.
    """
    square = (estimates - labels).square()
    if penalty:
        beyond = (low - estimates).clamp(min=0) + (estimates - high).clamp(min=0)
        square = square + penalty * beyond.square()
    return square.sum() / (2 * square.numel())


def create_loss(loss: Loss, labels: Labels) -> Callable[[Any, Tensor], Tensor]:
    """The loss of what a network says, against labels, as a recipe tells it."""
    if loss.kind == "likelihood":
        return likelihood
    low, high = (torch.from_numpy(labels.encode(end)) for end in (labels.low, labels.high))
    if loss.bounds is not None:
        low, high = (torch.full_like(low, bound) for bound in loss.bounds)

    def regression(estimates: Tensor, target: Tensor) -> Tensor:
        ends = {"low": low.to(estimates), "high": high.to(estimates)} if loss.penalty else {}
        return squared_error(estimates, target, penalty=loss.penalty, **ends)

    return regression
