"""CorrNet: two frames are matched cell by cell, and the known geometry turns what the cells say into one motion (ours).

A shared encoder, which strides along range only, describes the cells of both frames. The second frame's cells are drawn
where the motion found so far takes those of the first; a local correlation volume gives each cell a displacement
(soft-argmax) and how sure it is of it (a 2 x 2 information matrix). One weighted least-squares problem with the sonar's
derivative turns all of them into a step of the motion, in closed form; its normal matrix tells the covariance. Coarse looks
begin, looks at all cells with tied weights follow. Rocks stand above the ground that the geometry knows: a few layers guess
from both frames by how much.

Correlation volumes and their lookup are from PWC-Net (Sun et al. 2018) and RAFT (Teed and Deng 2020); here flow has
three parameters, and their derivative is known. The volume's second axis is the beam: how far a motion shifts each cell
along it, sine or angle, the geometry says, so even beams are not needed.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsonar.dataset.ground import NODES
from mitsonar.errors import MitsonarError
from mitsonar.geometry import moved, seen
from mitsonar.networks.law import MotionLaw

__all__ = ["CorrNet", "displacement"]

STRIDE = 8
"""Bins of a cell; a cell is one beam wide."""

COARSE = 2
"""Cells that one cell of the first look is long and wide."""

FEWEST = (16 * STRIDE, 16)
"""Bins and beams of an image that gives the first look something to match."""

RANGE_M = 4.4
"""Mean range at which the unit of length is 1 mm, of turns 0.25 mrad: lengths scale with the scene, images then do not
change."""

TURN = 2.5e-4

HELD = 0.01
"""What holds a step back where the frames tell nothing: a standard deviation of ten units."""

TALLEST = 0.2
"""Relief that can be guessed, as part of the height."""

FAINT = 1e-2
"""Mean square of a description below which it counts as nothing."""

Ground = dict[str, Tensor]


class CorrNet(nn.Module):
    """Matching with known geometry.

    Args:
        width: scales the channels.
        looks: at all cells, after the coarse one; their weights are tied.
        relief: whether the height of what is seen above the ground is guessed for each cell.

    Raises:
        MitsonarError: a value that no network can have.
    """

    needs: ClassVar[dict[str, Any]] = {"layout": "channels", "ground": True}
    any_sonar: ClassVar[bool] = True
    says_law: ClassVar[bool] = True

    def __init__(self, *, width: float = 1.0, looks: int = 2, relief: bool = True) -> None:
        super().__init__()
        if not isinstance(width, int | float) or not 0 < width < math.inf or not isinstance(looks, int) or looks < 1:
            raise MitsonarError(f"corrnet takes a width above 0 and one look or more: got {width!r} and {looks!r}")
        self.options = {"width": width, "looks": looks, "relief": relief}
        first, second, channels = (max(2, round(width * count)) for count in (12, 24, 16))
        self.looks = looks
        self.encoder = nn.Sequential(
            nn.Conv2d(1, first, (8, 3), stride=(4, 1), padding=(2, 1)),
            nn.ReLU(),
            nn.Conv2d(first, second, (4, 3), stride=(2, 1), padding=(1, 1)),
            nn.ReLU(),
            nn.Conv2d(second, channels, 1),
        )
        self.coarse = Matching((1, 2), channels, max(4, round(16 * width)))
        self.fine = Matching((1, 1), channels, max(4, round(16 * width)))
        self.relief = Relief(channels) if relief else None
        self.scale = nn.Parameter(torch.tensor(0.0))
        self.floor = nn.Parameter(torch.tensor([-1.0, -2.0, -1.0]))
        self.share = nn.Parameter(torch.tensor(-4.0))

    def forward(self, images: Tensor, ground: Ground) -> MotionLaw:
        """The motion between two frames.

        Args:
            images: ``(batch, 2, bins, beams)`` in 0..1.
            ground: a batch of :func:`mitsonar.dataset.ground.ground_at`.

        Raises:
            MitsonarError: images that are too small, or not pairs.
        """
        if images.dim() != 4 or images.shape[1] != 2 or images.shape[2] < FEWEST[0] or images.shape[3] < FEWEST[1]:
            raise MitsonarError(
                f"corrnet takes (batch, 2, bins, beams) of {FEWEST[0]} bins and {FEWEST[1]} beams or more: got "
                f"{tuple(images.shape)}"
            )
        batch, size = images.shape[0], (images.shape[2], images.shape[3])
        described = self.encoder(_even(images).reshape(2 * batch, 1, *size))
        cells = described.reshape(batch, 2, *described.shape[1:]).unbind(dim=1)
        blocks = tuple(functional.avg_pool2d(frame, COARSE) for frame in cells)
        unit = _units(ground)
        relief = None if self.relief is None else self.relief(*blocks)
        step, laws = images.new_zeros(batch, 3), []
        first = Look(ground, unit, (STRIDE * COARSE, COARSE), size, blocks[0].shape[-2:], relief)
        for _ in range(2):  # the second look reaches what was beyond the first one's blocks
            step, normal = first.solve(self.coarse, blocks, step)
            laws.append(self._law(step, normal, unit))
        if relief is not None:
            relief = functional.interpolate(relief, size=cells[0].shape[-2:], mode="bilinear")
        further = Look(ground, unit, (STRIDE, 1), size, cells[0].shape[-2:], relief)
        for _ in range(self.looks):
            step, normal = further.solve(self.fine, cells, step)
            laws.append(self._law(step, normal, unit))
        if not self.training:
            return laws[-1]
        return MotionLaw(*(torch.stack(values) for values in zip(*laws, strict=True)))

    def _law(self, step: Tensor, normal: Tensor, unit: Tensor) -> MotionLaw:
        """Mean and covariance: what cells say is not independent, something remains always, and scale errors grow with the
        motion."""
        inverse = torch.linalg.inv(normal)
        far = step.detach()
        covariance = torch.exp(2 * self.scale) * (inverse + inverse.mT) / 2 + torch.diag_embed(
            torch.exp(2 * self.floor) + torch.exp(2 * self.share) * far.square()
        )
        return MotionLaw(step * unit, covariance * unit[:, :, None] * unit[:, None, :])


class Matching(nn.Module):
    """Displacement of each cell and its information, from the correlation with the cells around its place.

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
            _quiet(nn.Conv2d(hidden, count + 3, 1)),
        )
        with torch.no_grad():  # at first correlations are averaged over 3 x 3 cells, and nothing is judged
            self.smooth.weight.zero_()
            self.smooth.weight[range(count), range(count)] = 1 / 9

    def forward(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Displacements ``(batch, 2, rows, columns)`` [cells], and the factor L of their information L L'
        ``(batch, 3, rows, columns)``: its 11, 22 and 21."""
        one, one_size = _unit_descriptions(first)
        other, other_size = _unit_descriptions(second)
        volume = self._volume(one, other)
        judged = self.judge(torch.cat([volume, one_size, other_size], dim=1))
        count = volume.shape[1]
        share = torch.softmax(torch.exp(self.sharpness) * self.smooth(volume) + judged[:, :count], dim=1)
        displaced = torch.stack([(share * place).sum(dim=1) for place in self.places], dim=1)
        sure = functional.softplus(judged[:, count : count + 2] - 1)
        return displaced, torch.cat([sure, 0.3 * judged[:, count + 2 :]], dim=1)

    def _volume(self, one: Tensor, other: Tensor) -> Tensor:
        """Correlations ``(batch, places, rows, columns)`` of each cell with the cells around its place."""
        down, across = self.reach
        wide = functional.pad(other, (across, across, down, down))
        if torch.is_grad_enabled() and (one.requires_grad or other.requires_grad):
            return _Correlations.apply(one, wide)  # type: ignore[no-any-return, no-untyped-call]
        return _correlations(one, wide)


def _shifted(one: Tensor, wide: Tensor) -> list[Tensor]:
    """Views of the wide frame, each as large as the other one, along range first."""
    rows, columns = one.shape[-2:]
    down, across = (large - small + 1 for large, small in zip(wide.shape[-2:], (rows, columns), strict=True))
    return [wide[:, :, r : r + rows, c : c + columns] for r in range(down) for c in range(across)]


def _correlations(one: Tensor, wide: Tensor) -> Tensor:
    """Of each cell with all shifts of the other frame, mean over the channels."""
    return torch.stack([(one * part).sum(dim=1) for part in _shifted(one, wide)], dim=1) / one.shape[1]


class _Correlations(torch.autograd.Function):
    """:func:`_correlations` with a derivative that touches memory a third as often as torch's own."""

    @staticmethod
    def forward(context: Any, one: Tensor, wide: Tensor) -> Tensor:
        context.save_for_backward(one, wide)
        return _correlations(one, wide)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        one, wide = context.saved_tensors
        by_volume = gradients[0] / one.shape[1]
        by_one, by_wide = torch.zeros_like(one), torch.zeros_like(wide)
        for k, (part, by_part) in enumerate(zip(_shifted(one, wide), _shifted(one, by_wide), strict=True)):
            by_one.addcmul_(by_volume[:, k : k + 1], part)
            by_part.addcmul_(by_volume[:, k : k + 1], one)
        return by_one, by_wide


class Relief(nn.Module):
    """How far what each block shows stands above the ground, as part of the height, from both frames."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(2 * channels, 16, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(16, 16, 3, padding=2, dilation=2),
            nn.ReLU(),
            _quiet(nn.Conv2d(16, 1, 1)),
        )

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """``(batch, 1, rows, columns)``."""
        return TALLEST * torch.tanh(self.layers(torch.cat([first, second], dim=1)))


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

    def solve(self, matching: Matching, cells: tuple[Tensor, ...], motion: Tensor) -> tuple[Tensor, Tensor]:
        """A better motion ``(batch, 3)`` in units, and the normal matrix ``(batch, 3, 3)`` behind it."""
        batch = motion.shape[0]
        second, inside = _drawn(cells[1], self._shift(motion))
        displaced, sure = matching(cells[0], second)
        l11, l22, l21 = (sure * inside[:, None]).unbind(dim=1)
        down, across = self.derivative.unbind(dim=1)
        # rows of L' J and of L' d
        rows = torch.stack([l11[:, None] * down + l21[:, None] * across, l22[:, None] * across], dim=2)
        wanted = torch.stack([l11 * displaced[:, 0] + l21 * displaced[:, 1], l22 * displaced[:, 1]], dim=1)
        rows = rows.reshape(batch, 3, -1)
        normal = rows @ rows.mT + HELD * torch.eye(3, dtype=rows.dtype, device=rows.device)
        pull = rows @ wanted.reshape(batch, -1, 1)
        return motion + torch.linalg.solve(normal, pull)[..., 0], normal

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


def _quiet(layer: nn.Conv2d) -> nn.Conv2d:
    """A layer that says nothing before it has learnt."""
    for values in layer.parameters():
        nn.init.zeros_(values)
    return layer


def _units(ground: Ground) -> Tensor:
    """Units of motions ``(batch, 3)`` [m, m, rad]."""
    length = 1e-3 * ground["place"][:, 0].mean(dim=(1, 2)) / RANGE_M
    return torch.stack([length, length, torch.full_like(length, TURN)], dim=1)


def _even(images: Tensor) -> Tensor:
    """Pairs of frames with mean 0 and standard deviation 1: levels carry no motion."""
    mean, std = images.mean(dim=(1, 2, 3), keepdim=True), images.std(dim=(1, 2, 3), keepdim=True)
    return (images - mean) / (std + 1e-6)


def _unit_descriptions(cells: Tensor) -> tuple[Tensor, Tensor]:
    """Descriptions of mean square 1, and the logarithm of what it was."""
    power = (cells * cells).mean(dim=1, keepdim=True) + FAINT
    return cells * torch.rsqrt(power), torch.log(power)


def _drawn(cells: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
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
