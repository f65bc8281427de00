"""Cells of one size as the moving sonar sees them: where the second frame shows the ground of each, and how that changes."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from mitsonar.dataset.ground import NODES
from mitsonar.geometry import moved, seen

__all__ = ["Ground", "Look", "displacement", "drawn"]

Ground = dict[str, Tensor]
"""A batch of :func:`mitsonar.dataset.ground.ground_at`."""

HELD = 0.01
"""What holds a step back where the frames tell nothing: a standard deviation of ten units."""


class Look:
    """One size of cells: where they are, and how they move with the sonar.

    Args:
        ground: of :func:`mitsonar.dataset.ground.ground_at`, a batch.
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
        scale = unit[:, None, :, None, None] / self.step[:, None]
        self.derivative = self._on_cells(ground["derivative"] * scale)
        if relief is not None:
            self.by_relief = relief[:, :, None] * self._on_cells(ground["by_relief"] * scale)
            self.derivative = self.derivative + self.by_relief

    def draw(self, second: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
        """The second frame where a motion takes the cells of the first, and 1 where that is within it."""
        return drawn(second, self._shift(motion))

    def solved(self, information: Tensor, pull: Tensor) -> tuple[Tensor, Tensor]:
        """The step of the motion ``(batch, 3)`` in units that least squares tells, and its normal matrix.

        Args:
            information: about each cell's displacement: along range, across beams, of both ``(batch, 3, rows, columns)``.
            pull: information times displacement, along range and across beams ``(batch, 2, rows, columns)``.
        """
        batch = information.shape[0]
        along, across, both = (part[:, None] for part in information.unbind(dim=1))
        down, aside = self.derivative.unbind(dim=1)
        weighed = [along * down + both * aside, both * down + across * aside]
        flat = [part.reshape(batch, 3, -1) for part in (down, aside)]
        normal = HELD * torch.eye(3, dtype=pull.dtype, device=pull.device)
        for part, derivative in zip(weighed, flat, strict=True):
            normal = normal + part.reshape(batch, 3, -1) @ derivative.mT
        wanted = sum(d @ q.reshape(batch, -1, 1) for d, q in zip(flat, pull.unbind(dim=1), strict=True))
        return torch.linalg.solve(normal, wanted)[..., 0], normal

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
        ground: of :func:`mitsonar.dataset.ground.ground_at`, a batch of it.
        motion: ``(batch, 3)`` [m, m, rad].
    """
    points = moved(ground["points"], motion[:, None, None])
    turn, height = ground["turn"][:, None, None], ground["height"][:, None, None]
    # the two kinds of bearing may stand in one batch
    radius, azimuth = seen(points, turn, height, "azimuth")
    _, cone = seen(points, turn, height, "cone")
    bearing = torch.where(ground["cone"][:, None, None] > 0, cone, azimuth)
    return (torch.stack([radius, bearing], dim=1) - ground["place"]) / ground["cell"]


def drawn(cells: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Descriptions at places shifted from each cell, bilinear, and 1 where these are within the image."""
    rows, columns = cells.shape[-2:]
    row = torch.arange(rows, dtype=cells.dtype, device=cells.device)[:, None] + shift[:, 0]
    column = torch.arange(columns, dtype=cells.dtype, device=cells.device) + shift[:, 1]
    grid = torch.stack([column * (2 / (columns - 1)) - 1, row * (2 / (rows - 1)) - 1], dim=-1)
    inside = (grid.abs() <= 1 + 1e-3).all(dim=-1).to(cells.dtype)  # rounding must not decide at the border
    return functional.grid_sample(cells, grid, align_corners=True, padding_mode="border"), inside


@lru_cache(maxsize=64)
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
