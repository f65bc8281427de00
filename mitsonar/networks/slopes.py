"""The rest of a motion, from the differences of two frames along their slopes, as `direct` does, but with learnt filters.

The most informative detail is as fine as a beam, in both directions. So neither the slopes nor the second frame may be
smoothed when it is sampled between its cells. Slopes are differences of fourth order, and the second frame is first
interpolated to twice its resolution.

Noise lengthens slopes and makes steps too short. Products of the slopes of both frames measure by how much, since their
noise is independent.
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
"""Bins of a cell. A cell is one beam wide."""

TOGETHER = (4, 2)
"""Cells along range and beams that share their weights."""

HALFWAY = (0.0243, -0.1351, 0.6079, 0.6079, -0.1351, 0.0243)
"""Lanczos weights (three lobes) of six cells for the value in their middle. Training changes them."""

LONGEST = 8.0
"""Longest step, in units. It starts close to the result."""

LEAST_TRUE = 0.2
"""Smallest part of the slopes' square that is not noise: a step is lengthened by a factor of at most five."""


class SlopeStep(NamedTuple):
    """Slopes and weights of an iteration, which the next one may keep.

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
    """Gauss-Newton steps on filtered frames.

    Args:
        filters: number of filtered frames.
        hidden: channels of the layers that compute weights.
    """

    def __init__(self, filters: int, hidden: int) -> None:
        super().__init__()
        levels = max(2, round(filters * 2 / 3))
        self.filter = channels_last(  # levels first: additive noise leaves most information in faint levels
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
        """Prepare filtered frames ``(batch, filters, rows, columns)``.

        Returns:
            The first frame, the second one at twice the resolution, and both slopes of the first.
        """
        first = first.contiguous()
        finer = _doubled(_doubled(second.contiguous(), self.across, 3), self.along, 2)
        return first, finer, _slope(first, 2), _slope(first, 3)

    def forward(
        self, frames: Pair, warp_grid: WarpGrid, motion: Tensor, judged: SlopeStep | None = None
    ) -> tuple[Tensor, Tensor, SlopeStep]:
        """Refine a motion by one step.

        Args:
            frames: of :meth:`prepared`.
            warp_grid: of these cells.
            motion: the estimate so far ``(batch, 3)``, in units.
            judged: slopes and weights of an earlier iteration, to be kept; default: they are computed.

        Returns:
            The motion ``(batch, 3)`` in units, its normal matrix ``(batch, 3, 3)``, and the slopes and weights.
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
        """Compute slopes and weights from both frames at the present motion."""
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
        """Compute the weight of each cell and filter from what both frames have in common there."""
        apart, mean = _together(residual.square()), _together((first + second).square()) / 4
        powers = torch.cat([apart, mean, (mean - apart / 4).abs()], dim=1)  # the last: of first times second
        weight = functional.softplus(self.judge(torch.log(powers + 1e-3)))
        return functional.interpolate(weight, size=first.shape[-2:], mode="nearest")


def _doubled(frame: Tensor, weights: Tensor, axis: int) -> Tensor:
    """Interpolate between the cells along an axis, 2 (range) or 3 (beams): ``n`` cells become ``2 n - 1``."""
    last = frame.shape[axis] - 1
    between = functional.conv2d(_wide(frame, axis), weights, groups=frame.shape[1])
    pairs = torch.stack([frame.narrow(axis, 0, last), between], dim=axis + 1).flatten(axis, axis + 1)
    return torch.cat([pairs, frame.narrow(axis, last, 1)], dim=axis)


def _slope(frame: Tensor, axis: int) -> Tensor:
    """Compute the slope by cell along an axis, to fourth order."""
    count, wide = frame.shape[axis], _wide(frame, axis)
    near, far = (wide.narrow(axis, 2 + k, count) - wide.narrow(axis, 2 - k, count) for k in (1, 2))
    return (2 / 3) * near - (1 / 12) * far


def _wide(frame: Tensor, axis: int) -> Tensor:
    """Pad two cells at both ends of an axis."""
    return functional.pad(frame, (2, 2, 0, 0) if axis == 3 else (0, 0, 2, 2), mode="replicate")


def _together(values: Tensor) -> Tensor:
    """Average the cells that share their weights."""
    rows, columns = (length // count for length, count in zip(values.shape[-2:], TOGETHER, strict=True))
    values = values[:, :, : rows * TOGETHER[0], : columns * TOGETHER[1]]
    by_row = values.unflatten(2, (rows, TOGETHER[0])).sum(dim=3)  # type: ignore[no-untyped-call]  # torch gives no types
    return sum(by_row[..., k :: TOGETHER[1]] for k in range(TOGETHER[1])) / math.prod(TOGETHER)  # type: ignore[no-any-return]
