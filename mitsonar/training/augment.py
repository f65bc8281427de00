"""More from the same samples: frames and their motions changed in ways that leave the motion known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from mitsonar.motion.composition import inverse

__all__ = ["AUGMENTATIONS", "augmented"]

STRANGERS = 0.05
"""Part of the pairs whose second frame is another pair's: nothing can be matched, and the law must be wide."""

Batch = tuple[Tensor, dict[str, Tensor], Tensor]


def augmented(inputs: Any, labels: Tensor, kinds: Sequence[str]) -> tuple[Any, Tensor]:
    """Inputs and labels of a batch, changed at random by torch's generator.

    Args:
        inputs: images ``(batch, 2, bins, beams)`` and the geometry of the ground.
        labels: motions ``(batch, 3)`` [m, m, rad].
        kinds: of :data:`AUGMENTATIONS`, in this order.
    """
    images, ground = inputs
    batch = images, ground, labels
    for kind in kinds:
        batch = AUGMENTATIONS[kind](batch)
    images, ground, labels = batch
    return (images, ground), labels


def mirrored(batch: Batch) -> Batch:
    """Port and starboard change places in half of the pairs: for sonars without roll, beams evenly about the axis."""
    images, ground, labels = batch
    chosen = _some(labels, 0.5)
    images = torch.where(chosen[:, None, None, None], images.flip(-1), images)
    return images, ground, torch.where(chosen[:, None], labels * labels.new_tensor([-1.0, 1.0, -1.0]), labels)


def reversed_(batch: Batch) -> Batch:
    """Half of the pairs run backwards."""
    images, ground, labels = batch
    chosen = _some(labels, 0.5)
    images = torch.where(chosen[:, None, None, None], images.flip(1), images)
    return images, ground, torch.where(chosen[:, None], inverse(labels), labels)


def strange(batch: Batch) -> Batch:
    """Some second frames are those of other pairs."""
    images, ground, labels = batch
    chosen = _some(labels, STRANGERS)
    second = torch.where(chosen[:, None, None], images[:, 1].roll(1, dims=0), images[:, 1])
    return torch.stack([images[:, 0], second], dim=1), ground, labels


AUGMENTATIONS: dict[str, Callable[[Batch], Batch]] = {
    "mirror": mirrored,
    "reverse": reversed_,
    "strangers": strange,
}
"""Ways to change a batch."""


def _some(labels: Tensor, part: float) -> Tensor:
    """Which pairs are chosen ``(batch,)``."""
    return torch.rand(len(labels), device=labels.device) < part
