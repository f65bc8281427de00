"""Cells matched by correlation: the displacement of each, its information, and the step of the motion that follows."""

from __future__ import annotations

from typing import Any, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsonar.networks.warp_grid import WarpGrid

__all__ = ["Matching", "Pair", "channels_last", "quiet"]

Pair = tuple[Tensor, ...]
"""Cells of the first and of the second frame, and further tensors of them."""

Context: TypeAlias = Any
"""What torch keeps between a function and its derivative; torch gives it no type."""

FAINT = 1e-2
"""Mean square of a description below which it is treated as empty."""


class Matching(nn.Module):
    """Displacement of each cell and its information, from the correlation with the cells around its predicted position.

    Args:
        reach: cells searched each way, along range and beams.
        channels: of the descriptions.
        hidden: channels of the layers between.
    """

    def __init__(self, reach: tuple[int, int], channels: int, hidden: int) -> None:
        super().__init__()
        self.reach = reach
        down, across = (torch.arange(-far, far + 1.0) for far in reach)
        places = torch.stack([down.repeat_interleave(len(across)), across.repeat(len(down))])
        self.places: Tensor
        self.register_buffer("places", places[:, :, None, None], persistent=False)
        count = places.shape[1]
        self.sharpness = nn.Parameter(torch.tensor(2.0))
        self.smooth = nn.Conv2d(count, count, 3, padding=1, bias=False)
        self.judge = nn.Sequential(
            nn.Conv2d(count + 2, hidden, 1),
            nn.ReLU(),
            nn.Conv2d(hidden, hidden, 3, padding=1),
            nn.ReLU(),
            quiet(nn.Conv2d(hidden, count + 3, 1)),
        )
        with torch.no_grad():  # at first correlations are averaged over 3 x 3 cells, and the judge has no effect
            self.smooth.weight.zero_()
            self.smooth.weight[range(count), range(count)] = 1 / 9

    def forward(self, cells: Pair, warp_grid: WarpGrid, motion: Tensor) -> tuple[Tensor, Tensor]:
        """Refine a motion by one step.

        Args:
            cells: descriptions of both frames ``(batch, channels, rows, columns)``.
            warp_grid: of these cells.
            motion: the estimate so far ``(batch, 3)``, in units.

        Returns:
            The motion ``(batch, 3)`` in units, and its normal matrix ``(batch, 3, 3)``.
        """
        second, inside = warp_grid.draw(cells[1], motion)
        displaced, sure = self.displaced(cells[0], second)
        l11, l22, l21 = (sure * inside[:, None]).unbind(dim=1)
        along, across, both = l11 * l11, l21 * l21 + l22 * l22, l11 * l21
        down, aside = displaced.unbind(dim=1)
        pull = torch.stack([along * down + both * aside, both * down + across * aside], dim=1)
        step, normal = warp_grid.solved(torch.stack([along, across, both], dim=1), pull)
        return motion + step, normal

    def displaced(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Estimate the displacement of each cell.

        Returns:
            Displacements ``(batch, 2, rows, columns)`` [cells], and the elements 11, 22 and 21 of the factor L of their
            information L L' ``(batch, 3, rows, columns)``.
        """
        one, one_size = _unit_descriptions(first)
        other, other_size = _unit_descriptions(second)
        volume = self._volume(one, other)
        judged = self.judge(torch.cat([volume, one_size, other_size], dim=1))
        count = volume.shape[1]
        share = torch.softmax(torch.exp(self.sharpness) * self.smooth(volume) + judged[:, :count], dim=1)
        moved_by = torch.stack([(share * place).sum(dim=1) for place in self.places], dim=1)
        sure = functional.softplus(judged[:, count : count + 2] - 1)
        return moved_by, torch.cat([sure, 0.3 * judged[:, count + 2 :]], dim=1)

    def _volume(self, one: Tensor, other: Tensor) -> Tensor:
        """Correlate each cell with the cells around its predicted position ``(batch, places, rows, columns)``."""
        down, across = self.reach
        wide = functional.pad(other, (across, across, down, down))
        if torch.is_grad_enabled() and (one.requires_grad or other.requires_grad):
            return _Correlations.apply(one, wide)  # type: ignore[no-any-return, no-untyped-call]
        return _correlations(one, wide)


def quiet(layer: nn.Conv2d) -> nn.Conv2d:
    """Set a layer's parameters to 0, so that it has no effect before training."""
    for values in layer.parameters():
        nn.init.zeros_(values)
    return layer


def channels_last(*layers: nn.Module) -> nn.Sequential:
    """Join layers in torch's channels-last format, with which a CPU convolves few channels 1.5 times faster."""
    return nn.Sequential(*layers).to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def _unit_descriptions(cells: Tensor) -> tuple[Tensor, Tensor]:
    """Scale descriptions to mean square 1. Return them and the logarithm of their mean square."""
    power = (cells * cells).mean(dim=1, keepdim=True) + FAINT
    return cells * torch.rsqrt(power), torch.log(power)


def _shifted(one: Tensor, wide: Tensor) -> list[Tensor]:
    """List the views of the wide frame that have the size of the other one, along range first."""
    rows, columns = one.shape[-2:]
    down, across = (large - small + 1 for large, small in zip(wide.shape[-2:], (rows, columns), strict=True))
    return [wide[:, :, r : r + rows, c : c + columns] for r in range(down) for c in range(across)]


def _correlations(one: Tensor, wide: Tensor) -> Tensor:
    """Correlate each cell with all shifts of the other frame, mean over the channels."""
    rows, columns = one.shape[-2:]
    shifted = wide.unfold(2, rows, 1).unfold(3, columns, 1)
    return (one[:, :, None, None] * shifted).mean(dim=1).flatten(1, 2)


class _Correlations(torch.autograd.Function):
    """:func:`_correlations` with a derivative that touches memory a third as often as torch's own."""

    @staticmethod
    def forward(context: Context, one: Tensor, wide: Tensor) -> Tensor:
        context.save_for_backward(one, wide)
        return _correlations(one, wide)

    @staticmethod
    def backward(context: Context, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        one, wide = context.saved_tensors
        by_volume = gradients[0] / one.shape[1]
        by_one, by_wide = torch.zeros_like(one), torch.zeros_like(wide)
        for k, (part, by_part) in enumerate(zip(_shifted(one, wide), _shifted(one, by_wide), strict=True)):
            by_one.addcmul_(by_volume[:, k : k + 1], part)
            by_part.addcmul_(by_volume[:, k : k + 1], one)
        return by_one, by_wide
