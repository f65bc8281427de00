"""Cells of one size as the moving sonar sees them: where the second frame shows the ground of each, and how that changes."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from mitsonar.datasets.ground_nodes import NODES
from mitsonar.geometry.ground_plane import moved

__all__ = ["Ground", "WarpGrid", "displacement"]

Ground = dict[str, Tensor]
"""A batch of :func:`mitsonar.datasets.ground_nodes.ground_at`."""

HELD = 0.01
"""What holds a step back where the frames tell nothing: a standard deviation of ten units."""


class WarpGrid:
    """One size of cells: where they are, and how they move with the sonar.

    Args:
        ground: of :func:`mitsonar.datasets.ground_nodes.ground_at`, a batch.
        unit: of motions ``(batch, 3)``.
        step: bins and beams of a cell.
        size: bins and beams of the image.
        shape: rows and columns of cells.
        relief: above the ground as part of the height ``(batch, 1, rows, columns)``.
    """

    def __init__(
        self,
        ground: Ground,
        unit: Tensor,
        step: tuple[int, int],
        size: tuple[int, int],
        shape: tuple[int, ...],
        relief: Tensor | None,
    ) -> None:
        self.ground, self.unit, self.relief = ground, unit, relief
        self.over = [
            _from_nodes(nodes, length, every, count, unit.device)
            for nodes, length, every, count in zip(NODES, size, step, shape, strict=True)
        ]
        self.step = unit.new_tensor(step)[:, None, None]
        self.base, self.span = _borders(shape, unit)
        scale = unit[:, None, :, None, None] / self.step[:, None]
        derivative = self._on_cells(ground["derivative"] * scale)
        if relief is not None:
            self.by_relief = relief[:, :, None] * self._on_cells(ground["by_relief"] * scale)
            derivative = derivative + self.by_relief
        self.derivative = derivative.transpose(1, 2)
        self.crosswise = self.derivative.flip(2)

    def draw(self, second: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
        """The second frame where a motion takes the cells of the first, bilinear, and 1 where that is within it."""
        place = self.base + self.span * self._shift(motion)
        inside = (place.abs().amax(dim=1) <= 1 + 1e-3).to(second.dtype)  # rounding must not decide at the border
        grid = torch.stack([place[:, 1], place[:, 0]], dim=-1)
        return functional.grid_sample(second, grid, align_corners=True, padding_mode="border"), inside

    def solved(self, information: Tensor, pull: Tensor) -> tuple[Tensor, Tensor]:
        """The step of the motion ``(batch, 3)`` in units that least squares tells, and its normal matrix.

        Args:
            information: about each cell's displacement: along range, across beams, of both ``(batch, 3, rows, columns)``.
            pull: information times displacement, along range and across beams ``(batch, 2, rows, columns)``.
        """
        weighed = self.derivative * information[:, None, :2] + self.crosswise * information[:, None, 2:]
        flat = self.derivative.flatten(2)
        normal = weighed.flatten(2) @ flat.mT + HELD * torch.eye(3, dtype=pull.dtype, device=pull.device)
        return torch.linalg.solve(normal, flat @ pull.flatten(1)[..., None])[..., 0], normal

    def _shift(self, motion: Tensor) -> Tensor:
        """How far from each cell of the first frame the second shows its ground ``(batch, 2, rows, columns)`` [cells]."""
        shift = self._on_cells(displacement(self.ground, motion * self.unit) / self.step)
        if self.relief is not None:
            shift = shift + (self.by_relief * motion[:, None, :, None, None]).sum(dim=2)
        return shift

    def _on_cells(self, nodes: Tensor) -> Tensor:
        """From nodes ``(..., R, C)`` to cells ``(..., rows, columns)``, linear between them."""
        return self.over[0] @ nodes @ self.over[1].mT


def displacement(ground: Ground, motion: Tensor) -> Tensor:
    """How far from each node of the first frame the second shows its ground ``(batch, 2, R, C)``, in bins and beams.

    Args:
        ground: of :func:`mitsonar.datasets.ground_nodes.ground_at`, a batch of it.
        motion: ``(batch, 3)`` [m, m, rad].
    """
    points = moved(ground["points"], motion[:, None, None])
    turn, height = ground["turn"], ground["height"][:, None, None]
    sonar = points.flatten(1, 2) @ turn[:, :2] - height * turn[:, 2:]
    s, f, u = sonar.unflatten(1, points.shape[1:3]).unbind(dim=-1)
    # the two kinds of bearing may stand in one batch
    beside = torch.where(ground["cone"][:, None, None] > 0, torch.sqrt(f * f + u * u), f)
    radius, bearing = torch.sqrt(s * s + f * f + u * u), torch.atan2(s, beside)
    return (torch.stack([radius, bearing], dim=1) - ground["place"]) / ground["cell"]


def _borders(shape: tuple[int, ...], unit: Tensor) -> tuple[Tensor, Tensor]:
    """Where cells lie ``(2, rows, columns)`` when an image reaches from -1 to 1, and how long a cell is ``(2, 1, 1)``."""
    axes = [torch.linspace(-1, 1, count, dtype=unit.dtype, device=unit.device) for count in shape]
    span = unit.new_tensor([2 / (count - 1) for count in shape])
    return torch.stack(torch.meshgrid(*axes, indexing="ij")), span[:, None, None]


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # kept for a training, too, where an evaluation asks first
def _from_nodes(nodes: int, length: int, every: int, count: int, device: torch.device) -> Tensor:
    """Weights ``(count, nodes)`` of nodes, evenly from the first of ``length`` to the last, at the middles of cells."""
    middle = torch.arange(count, dtype=torch.float64) * every + (every - 1) / 2
    place = (middle * ((nodes - 1) / (length - 1))).clamp(0, nodes - 1)
    before = place.floor().clamp(max=nodes - 2)
    weight = torch.zeros(count, nodes, dtype=torch.float64)
    row = torch.arange(count)
    weight[row, before.long()] = 1 - (place - before)
    weight[row, before.long() + 1] = place - before
    return weight.to(torch.float32).to(device)
