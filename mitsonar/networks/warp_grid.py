"""Cells of one size under a motion of the sonar: where the second frame shows the ground of each, and the derivative."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from mitsonar.datasets.samples import NODES
from mitsonar.geometry.ground import moved

__all__ = ["Ground", "WarpGrid", "displacement"]

Ground = dict[str, Tensor]
"""A batch of the tables of :func:`mitsonar.datasets.samples.ground_at`, by name."""

PRIOR = 0.01
"""Information of a weak prior of no step, with a standard deviation of ten units, for frames without detail."""


class WarpGrid:
    """Cells of one size: their positions, and how they move with the sonar.

    Args:
        ground: a batch of :func:`mitsonar.datasets.samples.ground_at`.
        unit: of motions ``(batch, 3)`` [m, m, rad].
        step: bins and beams of a cell.
        size: bins and beams of the image.
        shape: rows and columns of cells.
        relief: height above the ground as part of the sonar's height ``(batch, 1, rows, columns)``.
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
        self.lit = self._on_cells(ground["lit"]) > 0 if "lit" in ground else None

    def draw(self, second: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
        """Sample the second frame, bilinearly, where a motion moves the cells of the first.

        Args:
            second: the second frame ``(batch, channels, rows, columns)``.
            motion: ``(batch, 3)``, in units.

        Returns:
            The samples, and 1 where they lie within the frame, else 0 ``(batch, rows, columns)``.
        """
        place = self.base + self.span * self._shift(motion)
        inside = (place.abs().amax(dim=1) <= 1 + 1e-3).to(second.dtype)  # rounding must not decide at the border
        if self.lit is not None:
            inside = inside * self.lit
        grid = torch.stack([place[:, 1], place[:, 0]], dim=-1)
        return functional.grid_sample(second, grid, align_corners=True, padding_mode="border"), inside

    def solved(self, information: Tensor, pull: Tensor) -> tuple[Tensor, Tensor]:
        """Solve the least-squares problem for the step of the motion.

        Args:
            information: about each cell's displacement: along range, across beams, of both ``(batch, 3, rows, columns)``.
            pull: information times displacement, along range and across beams ``(batch, 2, rows, columns)``.

        Returns:
            The step ``(batch, 3)`` in units, and its normal matrix ``(batch, 3, 3)``.
        """
        weighed = self.derivative * information[:, None, :2] + self.crosswise * information[:, None, 2:]
        flat = self.derivative.flatten(2)
        normal = weighed.flatten(2) @ flat.mT + PRIOR * torch.eye(3, dtype=pull.dtype, device=pull.device)
        return torch.linalg.solve(normal, flat @ pull.flatten(1)[..., None])[..., 0], normal

    def _shift(self, motion: Tensor) -> Tensor:
        """Compute how far a motion moves the ground of each cell ``(batch, 2, rows, columns)`` [cells]."""
        shift = self._on_cells(displacement(self.ground, motion * self.unit) / self.step)
        if self.relief is not None:
            shift = shift + (self.by_relief * motion[:, None, :, None, None]).sum(dim=2)
        return shift

    def _on_cells(self, nodes: Tensor) -> Tensor:
        """Interpolate linearly from nodes ``(..., R, C)`` to cells ``(..., rows, columns)``."""
        return self.over[0] @ nodes @ self.over[1].mT


def displacement(ground: Ground, motion: Tensor) -> Tensor:
    """Compute how far a motion moves the ground of each node ``(batch, 2, R, C)``, in bins and beams.

    Args:
        ground: a batch of :func:`mitsonar.datasets.samples.ground_at`.
        motion: ``(batch, 3)`` [m, m, rad].
    """
    points = moved(ground["points"], motion[:, None, None])
    turn, height = ground["turn"], ground["height"][:, None, None]
    sonar = points.flatten(1, 2) @ turn[:, :2] - height * turn[:, 2:]
    s, f, u = sonar.unflatten(1, points.shape[1:3]).unbind(dim=-1)
    # a batch may hold both kinds of bearing
    beside = torch.where(ground["cone"][:, None, None] > 0, torch.sqrt(f * f + u * u), f)
    radius, bearing = torch.sqrt(s * s + f * f + u * u), torch.atan2(s, beside)
    return (torch.stack([radius, bearing], dim=1) - ground["place"]) / ground["cell"]


def _borders(shape: tuple[int, ...], unit: Tensor) -> tuple[Tensor, Tensor]:
    """Compute positions ``(2, rows, columns)`` and sizes ``(2, 1, 1)`` of cells in an image from -1 to 1."""
    axes = [torch.linspace(-1, 1, count, dtype=unit.dtype, device=unit.device) for count in shape]
    span = unit.new_tensor([2 / (count - 1) for count in shape])
    return torch.stack(torch.meshgrid(*axes, indexing="ij")), span[:, None, None]


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # cached: a training may use what an evaluation computed first
def _from_nodes(nodes: int, length: int, every: int, count: int, device: torch.device) -> Tensor:
    """Compute the weights ``(count, nodes)`` of evenly spaced nodes at the middles of cells.

    The nodes span ``length`` bins or beams; a cell has ``every`` of them.
    """
    middle = torch.arange(count, dtype=torch.float64) * every + (every - 1) / 2
    place = (middle * ((nodes - 1) / (length - 1))).clamp(0, nodes - 1)
    before = place.floor().clamp(max=nodes - 2)
    weight = torch.zeros(count, nodes, dtype=torch.float64)
    row = torch.arange(count)
    weight[row, before.long()] = 1 - (place - before)
    weight[row, before.long() + 1] = place - before
    return weight.to(torch.float32).to(device)
