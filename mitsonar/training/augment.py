"""Data augmentation: random changes of frames and motions that leave the motion known."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mitsonar.motion.composition import inverse
from mitsonar.networks.corrnet import Ground

__all__ = ["AUGMENTATIONS", "augmented"]

STRANGERS = 0.05
"""Part of the pairs whose second frame is another pair's. Nothing matches, and the covariance must be large."""

Augmented = tuple[Tensor, Ground, Tensor]
"""Images ``(batch, 2, bins, beams)``, geometry of the ground, and motions ``(batch, 3)`` [m, m, rad]."""


def augmented(inputs: tuple[Tensor, Ground], labels: Tensor, kinds: Sequence[str]) -> tuple[tuple[Tensor, Ground], Tensor]:
    """Change inputs and labels of a batch at random, by torch's generator.

    Args:
        inputs: images ``(batch, 2, bins, beams)`` and the geometry of the ground.
        labels: motions ``(batch, 3)`` [m, m, rad].
        kinds: keys of :data:`AUGMENTATIONS`, applied in this order.
    """
    images, ground = inputs
    batch = images, ground, labels
    for kind in kinds:
        batch = AUGMENTATIONS[kind](batch)
    images, ground, labels = batch
    return (images, ground), labels


def mirrored(batch: Augmented) -> Augmented:
    """Exchange port and starboard in half of the pairs.

    This holds for sonars without roll, whose beams are symmetric about the axis.
    """
    images, ground, labels = batch
    chosen = _some(labels, 0.5)
    images = torch.where(chosen[:, None, None, None], images.flip(-1), images)
    return images, ground, torch.where(chosen[:, None], labels * labels.new_tensor([-1.0, 1.0, -1.0]), labels)


def reversed_(batch: Augmented) -> Augmented:
    """Reverse the order of the frames in half of the pairs."""
    images, ground, labels = batch
    chosen = _some(labels, 0.5)
    images = torch.where(chosen[:, None, None, None], images.flip(1), images)
    return images, ground, torch.where(chosen[:, None], inverse(labels), labels)


def strange(batch: Augmented) -> Augmented:
    """Replace some second frames by those of other pairs."""
    images, ground, labels = batch
    chosen = _some(labels, STRANGERS)
    second = torch.where(chosen[:, None, None], images[:, 1].roll(1, dims=0), images[:, 1])
    return torch.stack([images[:, 0], second], dim=1), ground, labels


AUGMENTATIONS: dict[str, Callable[[Augmented], Augmented]] = {
    "mirror": mirrored,
    "reverse": reversed_,
    "strangers": strange,
}
"""Changes of a batch, by name."""


def _some(labels: Tensor, part: float) -> Tensor:
    """Draw which pairs are changed ``(batch,)``."""
    return torch.rand(len(labels), device=labels.device) < part
