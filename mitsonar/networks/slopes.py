"""What is left of a motion, from the differences of two frames along their slopes, as `direct` takes it, but with filters
and weights that were learnt.

Noise lengthens slopes and makes steps too short: slopes of one frame times those of the other tell by how much, since their
noise is not the same.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsonar.networks.look import Look
from mitsonar.networks.matching import Pair, quiet

__all__ = ["STEP", "Slopes"]

STEP = 2
"""Bins of a cell; a cell is one beam wide."""

TOGETHER = 4
"""Cells along range that are judged together."""

LONGEST = 8.0
"""Units that a step may be long; it begins near the end."""

LEAST_TRUE = 0.2
"""Of the square of slopes that is not noise: a step is lengthened by five times at most."""


class Slopes(nn.Module):
    """Gauss-Newton on filtered frames.

    Args:
        filters: number of filtered frames.
        hidden: channels of the layers that judge.
    """

    def __init__(self, filters: int, hidden: int) -> None:
        super().__init__()
        self.filters = filters
        self.filter = nn.Sequential(  # levels first: noise that only adds tells most by what is faint
            nn.Conv2d(1, filters, 1),
            nn.ReLU(),
            nn.Conv2d(filters, filters, (6, 3), stride=(STEP, 1), padding=(2, 1), bias=False),
        )
        self.judge = nn.Sequential(
            nn.Conv2d(3 * filters, hidden, 1),
            nn.ReLU(),
            nn.Conv2d(hidden, hidden, 3, padding=1),
            nn.ReLU(),
            quiet(nn.Conv2d(hidden, filters, 1)),
        )
        # at first slopes are central differences, smoothed across
        smooth, difference = torch.tensor([0.25, 0.5, 0.25]), torch.tensor([-0.25, -0.25, 0.0, 0.25, 0.25])
        wide, narrow = torch.tensor([0.1, 0.2, 0.4, 0.2, 0.1]), torch.tensor([-0.5, 0.0, 0.5])
        self.down = nn.Parameter((difference[:, None] * smooth).expand(filters, 1, 5, 3).clone())
        self.across = nn.Parameter((wide[:, None] * narrow).expand(filters, 1, 5, 3).clone())
        self.scale = nn.Parameter(torch.tensor(0.0))

    def prepared(self, first: Tensor, second: Tensor) -> Pair:
        """Both filtered frames, and the slopes of the first ``(batch, filters, rows, columns)``."""
        return first, second, *self._slopes(first)

    def forward(self, frames: Pair, look: Look, motion: Tensor) -> tuple[Tensor, Tensor]:
        """A better motion ``(batch, 3)`` in units, and the normal matrix ``(batch, 3, 3)`` behind it.

        Args:
            frames: of :meth:`prepared`.
            look: where these cells are.
            motion: found so far.
        """
        first, own = frames[0], frames[2:]
        second, inside = look.draw(frames[1], motion)
        residual = second - first
        weight = self._weight(first, second, residual) * inside[:, None]
        others = self._slopes(second)
        down, aside = ((a + b) / 2 for a, b in zip(own, others, strict=True))
        by_down, by_aside = weight * down, weight * aside
        along, across = (by_down * down).sum(dim=1), (by_aside * aside).sum(dim=1)
        information = torch.stack([along, across, (by_down * aside).sum(dim=1)], dim=1)
        pull = -torch.stack([(by_down * residual).sum(dim=1), (by_aside * residual).sum(dim=1)], dim=1)
        step, normal = look.solved(information, pull)
        true = (weight * (own[0] * others[0] + own[1] * others[1])).sum(dim=(1, 2, 3))
        part = (true / (along + across).sum(dim=(1, 2)).clamp(min=1e-12)).clamp(LEAST_TRUE, 1.0)[:, None]
        step = (step / part).clamp(-LONGEST, LONGEST)
        normal = normal * part[:, None] * torch.exp(self.scale)
        return motion + step, normal

    def _weight(self, first: Tensor, second: Tensor, residual: Tensor) -> Tensor:
        """Of each cell and filter, from what both frames have in common there."""
        powers = torch.cat([residual.square(), ((first + second) / 2).square(), first * second], dim=1)
        blocks = functional.avg_pool2d(powers, (TOGETHER, 1))
        weight = functional.softplus(self.judge(torch.log(blocks.abs() + 1e-3)))
        return functional.interpolate(weight, size=first.shape[-2:], mode="nearest")

    def _slopes(self, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Along range and across beams, by cell."""
        wide = functional.pad(frame, (1, 1, 2, 2), mode="replicate")
        down, across = (functional.conv2d(wide, kernel, groups=self.filters) for kernel in (self.down, self.across))
        return down, across
