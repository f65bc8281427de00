"""What is left of a motion, from the differences of two frames along their slopes, as `direct` takes it, but with filters
and weights that were learnt.

What tells most is as fine as a beam, in both directions: neither slopes nor the second frame, when it is drawn between its
cells, may be smoothed. So slopes are differences of fourth order, and the second frame is made twice as fine before.

Noise lengthens slopes and makes steps too short: slopes of one frame times those of the other tell by how much, since their
noise is not the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsonar.networks.matching import Pair, channels_last, quiet
from mitsonar.networks.warp_grid import WarpGrid

__all__ = ["STEP", "SlopeStep", "Slopes"]

STEP = 2
"""Bins of a cell; a cell is one beam wide."""

TOGETHER = (4, 2)
"""Cells along range and beams that are judged together."""

HALFWAY = (0.0243, -0.1351, 0.6079, 0.6079, -0.1351, 0.0243)
"""Lanczos' weights of six cells for what lies in their middle (three lobes); training changes them."""

LONGEST = 8.0
"""Units that a step may be long; it begins near the end."""

LEAST_TRUE = 0.2
"""Of the square of slopes that is not noise: a step is lengthened by five times at most."""


class SlopeStep(NamedTuple):
    """What a look has found out that the next one may keep.

    Attributes:
        down: slopes along range times their weight ``(batch, filters, rows, columns)``.
        aside: likewise across beams.
        information: about each cell's displacement ``(batch, 3, rows, columns)``.
        true: part of the slopes' square that is not noise ``(batch, 1)``.
    """

    down: Tensor
    aside: Tensor
    information: Tensor
    true: Tensor


class Slopes(nn.Module):
    """Gauss-Newton on filtered frames.

    Args:
        filters: number of filtered frames.
        hidden: channels of the layers that judge.
    """

    def __init__(self, filters: int, hidden: int) -> None:
        super().__init__()
        levels = max(2, round(filters * 2 / 3))
        self.filter = channels_last(  # levels first: noise that only adds tells most by what is faint
            nn.Conv2d(1, levels, 1),
            nn.ReLU(),
            nn.Conv2d(levels, filters, (6, 5), stride=(STEP, 1), padding=(2, 2), bias=False),
        )
        self.judge = nn.Sequential(
            nn.Conv2d(3 * filters, hidden, 1),
            nn.ReLU(),
            nn.Conv2d(hidden, hidden, 3, padding=1),
            nn.ReLU(),
            quiet(nn.Conv2d(hidden, filters, 1)),
        )
        halfway = torch.tensor(HALFWAY) / sum(HALFWAY)
        self.along = nn.Parameter(halfway.reshape(6, 1).repeat(filters, 1, 1, 1))
        self.across = nn.Parameter(halfway.repeat(filters, 1, 1, 1))
        self.scale = nn.Parameter(torch.tensor(0.0))

    def prepared(self, first: Tensor, second: Tensor) -> Pair:
        """The first filtered frame, the second one twice as fine, and the slopes of the first
        ``(batch, filters, rows, columns)``."""
        first = first.contiguous()
        finer = _doubled(_doubled(second.contiguous(), self.across, 3), self.along, 2)
        return first, finer, _slope(first, 2), _slope(first, 3)

    def forward(
        self, frames: Pair, warp_grid: WarpGrid, motion: Tensor, judged: SlopeStep | None = None
    ) -> tuple[Tensor, Tensor, SlopeStep]:
        """A better motion ``(batch, 3)`` in units, the normal matrix ``(batch, 3, 3)`` behind it, and what was judged.

        Args:
            frames: of :meth:`prepared`.
            look: where these cells are.
            motion: found so far.
            judged: of a look nearby, to be kept.
        """
        first = frames[0]
        second, inside = warp_grid.draw(frames[1], motion)
        residual = second - first
        if judged is None:
            judged = self._judged(frames, second, residual, inside)
        pull = -torch.stack([(judged.down * residual).sum(dim=1), (judged.aside * residual).sum(dim=1)], dim=1)
        step, normal = warp_grid.solved(judged.information, pull)
        step = (step / judged.true).clamp(-LONGEST, LONGEST)
        return motion + step, normal * judged.true[..., None] * torch.exp(self.scale), judged

    def _judged(self, frames: Pair, second: Tensor, residual: Tensor, inside: Tensor) -> SlopeStep:
        """Slopes and weights, from what both frames show where they are now."""
        first, own = frames[0], frames[2:]
        others = _slope(second, 2), _slope(second, 3)
        weight = self._weight(first, second, residual) * inside[:, None]
        down, aside = ((a + b) / 2 for a, b in zip(own, others, strict=True))
        by_down, by_aside = weight * down, weight * aside
        along, across = (by_down * down).sum(dim=1), (by_aside * aside).sum(dim=1)
        common = (weight * (own[0] * others[0] + own[1] * others[1])).sum(dim=(1, 2, 3))
        true = common / (along + across).sum(dim=(1, 2)).clamp(min=1e-12)
        information = torch.stack([along, across, (by_down * aside).sum(dim=1)], dim=1)
        return SlopeStep(by_down, by_aside, information, true.clamp(LEAST_TRUE, 1.0)[:, None])

    def _weight(self, first: Tensor, second: Tensor, residual: Tensor) -> Tensor:
        """Of each cell and filter, from what both frames have in common there."""
        apart, mean = _together(residual.square()), _together((first + second).square()) / 4
        powers = torch.cat([apart, mean, (mean - apart / 4).abs()], dim=1)  # the last: of first times second
        weight = functional.softplus(self.judge(torch.log(powers + 1e-3)))
        return functional.interpolate(weight, size=first.shape[-2:], mode="nearest")


def _doubled(frame: Tensor, weights: Tensor, axis: int) -> Tensor:
    """With what lies between the cells along an axis, 2 (range) or 3 (beams): ``2 n - 1`` of them."""
    last = frame.shape[axis] - 1
    between = functional.conv2d(_wide(frame, axis), weights, groups=frame.shape[1])
    pairs = torch.stack([frame.narrow(axis, 0, last), between], dim=axis + 1).flatten(axis, axis + 1)
    return torch.cat([pairs, frame.narrow(axis, last, 1)], dim=axis)


def _slope(frame: Tensor, axis: int) -> Tensor:
    """By cell along an axis, to fourth order."""
    count, wide = frame.shape[axis], _wide(frame, axis)
    near, far = (wide.narrow(axis, 2 + k, count) - wide.narrow(axis, 2 - k, count) for k in (1, 2))
    return (2 / 3) * near - (1 / 12) * far


def _wide(frame: Tensor, axis: int) -> Tensor:
    """With two more cells at both ends of an axis."""
    return functional.pad(frame, (2, 2, 0, 0) if axis == 3 else (0, 0, 2, 2), mode="replicate")


def _together(values: Tensor) -> Tensor:
    """Means of the cells that are judged together."""
    rows, columns = (length // count for length, count in zip(values.shape[-2:], TOGETHER, strict=True))
    values = values[:, :, : rows * TOGETHER[0], : columns * TOGETHER[1]]
    by_row = values.unflatten(2, (rows, TOGETHER[0])).sum(dim=3)
    return sum(by_row[..., k :: TOGETHER[1]] for k in range(TOGETHER[1])) / math.prod(TOGETHER)  # type: ignore[no-any-return]
