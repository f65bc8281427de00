"""CorrNet: two frames are matched cell by cell, and the known geometry turns the displacements into one motion (ours).

A shared encoder describes blocks of both frames. The second frame's blocks are sampled where the motion so far moves those
of the first. A local correlation volume gives each block a displacement (soft-argmax) and its 2 x 2 information matrix. One
weighted least-squares problem with the sonar's derivative turns them into a step of the motion, in closed form. Its normal
matrix gives the covariance. Finer iterations, on cells one beam wide, estimate the rest from the frames' differences and
slopes. Rocks lie above the ground of the geometry: a few layers estimate their height from both frames.

Correlation volumes and their lookup are from PWC-Net (Sun et al. 2018) and RAFT (Teed and Deng 2020); here the
flow has three parameters, and their derivative is known. The volume's second axis is the beam. The geometry defines how far
a motion shifts each cell along it, so the beams need not be evenly spaced.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsonar.datasets.modality import Fields
from mitsonar.datasets.samples import NODES
from mitsonar.errors import MitsonarError, shortened
from mitsonar.geometry.ground import moved

__all__ = [
    "STEP",
    "CorrNet",
    "GaussianHead",
    "Ground",
    "Matching",
    "Pair",
    "SlopeStep",
    "Slopes",
    "WarpGrid",
    "channels_last",
    "displacement",
    "likelihood",
    "quiet",
]


BLOCK = (16, 2)
"""Bins and beams of a block."""

FEWEST = (128, 16)
"""Fewest bins and beams of an image: smaller ones leave the first iteration too few blocks."""

RANGE_M = 4.4
"""Mean range at which the unit of length is 1 mm. The unit scales with the range, since images do not change with scale."""

TURN = 2.5e-4
"""Unit of yaw [rad]."""

JUDGED = 2
"""Finer iterations that compute weights. Later ones keep these weights."""

TALLEST = 0.2
"""Largest relief, as part of the height."""


class CorrNet(nn.Module):
    """A network that matches two frames with known geometry.

    Args:
        width: scales the channels.
        looks: number of iterations on blocks, which share their weights. The second reaches farther than the first.
        finer: number of iterations on differences and slopes, which share their weights, too.
        relief: whether the height above the ground is estimated for each cell.

    Raises:
        MitsonarError: a value out of its range.
    """

    needs: ClassVar[Fields] = {"layout": "channels", "ground": True}
    any_sonar: ClassVar[bool] = True
    has_covariance: ClassVar[bool] = True

    def __init__(self, *, width: float = 1.0, looks: int = 2, finer: int = 3, relief: bool = True) -> None:
        super().__init__()
        counts = all(isinstance(count, int) and count >= 1 for count in (looks, finer))
        if not isinstance(width, int | float) or not 0 < width < math.inf or not counts:
            raise MitsonarError(
                f"corrnet takes a width above 0, looks and finer of at least 1: got {shortened(width)}, {shortened(looks)} "
                f"and {shortened(finer)}"
            )
        self.options: Fields = {"width": width, "looks": looks, "finer": finer, "relief": relief}
        first, second, channels, hidden, filters = (max(2, round(width * count)) for count in (12, 24, 16, 16, 6))
        self.encoder = channels_last(
            nn.Conv2d(1, first, (8, 3), stride=(4, 1), padding=(2, 1)),
            nn.ReLU(),
            nn.Conv2d(first, second, (8, 4), stride=(4, 2), padding=(2, 1)),
            nn.ReLU(),
            nn.Conv2d(second, channels, 1),
        )
        self.relief = Relief(channels) if relief else None
        self.matching = Matching((1, 2), channels, hidden)
        self.slopes = Slopes(filters, hidden)
        self.scale = nn.Parameter(torch.tensor(0.0))
        self.floor = nn.Parameter(torch.tensor([-1.0, -2.0, -1.0]))
        self.share = nn.Parameter(torch.tensor(-4.0))

    def forward(self, images: Tensor, ground: Ground, start: Tensor | None = None) -> GaussianHead:
        """Estimate the motion between two frames.

        Args:
            images: ``(batch, 2, bins, beams)`` in 0..1.
            ground: a batch of :func:`mitsonar.datasets.samples.ground_at`.
            start: the motion with which the iterations begin ``(batch, 3)`` [m, m, rad]; default: none.

        Returns:
            The distribution of the motion; in training that of each iteration.

        Raises:
            MitsonarError: images that are too small, or not pairs.
        """
        if images.dim() != 4 or images.shape[1] != 2 or images.shape[2] < FEWEST[0] or images.shape[3] < FEWEST[1]:
            raise MitsonarError(
                f"corrnet takes (batch, 2, bins, beams) of {FEWEST[0]} bins and {FEWEST[1]} beams or more: got "
                f"{tuple(images.shape)}"
            )
        batch, size = images.shape[0], (images.shape[2], images.shape[3])
        frames = _even(images).reshape(2 * batch, 1, *size)
        blocks = tuple(cells.contiguous() for cells in _pair(self.encoder(frames)))
        cells = self.slopes.prepared(*_pair(self.slopes.filter(frames)))
        unit, estimates = _units(ground), []
        relief = None if self.relief is None else self.relief(*blocks)
        motion, judged = images.new_zeros(batch, 3) if start is None else start / unit, None
        warp_grid = WarpGrid(ground, unit, BLOCK, size, blocks[0].shape[-2:], relief)
        for _ in range(self.options["looks"]):
            motion, normal = self.matching(blocks, warp_grid, motion)
            estimates.append((motion, normal))
        warp_grid = WarpGrid(ground, unit, (STEP, 1), size, cells[0].shape[-2:], _resized(relief, cells[0]))
        for k in range(self.options["finer"]):
            motion, normal, judged = self.slopes(cells, warp_grid, motion, judged if k >= JUDGED else None)
            estimates.append((motion, normal))
        if not self.training:
            return self._head(motion, normal, unit)
        heads = [self._head(*estimate, unit) for estimate in estimates]
        return GaussianHead(*(torch.stack(values) for values in zip(*heads, strict=True)))

    def _head(self, motion: Tensor, normal: Tensor, unit: Tensor) -> GaussianHead:
        """Compute mean and covariance: cells have correlated errors, a floor remains, scale errors grow with the motion."""
        inverse = torch.linalg.inv(normal)
        far = motion.detach()
        covariance = torch.exp(2 * self.scale) * (inverse + inverse.mT) / 2 + torch.diag_embed(
            torch.exp(2 * self.floor) + torch.exp(2 * self.share) * far.square()
        )
        return GaussianHead(motion * unit, covariance * unit[:, :, None] * unit[:, None, :])


class Relief(nn.Module):
    """Height of each block above the ground, as part of the sonar's height, from both frames."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(2 * channels, 16, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(16, 16, 3, padding=2, dilation=2),
            nn.ReLU(),
            quiet(nn.Conv2d(16, 1, 1)),
        )

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Estimate the relief ``(batch, 1, rows, columns)`` from descriptions of both frames."""
        return TALLEST * torch.tanh(self.layers(torch.cat([first, second], dim=1)))


def _units(ground: Ground) -> Tensor:
    """Compute the units of motions ``(batch, 3)`` [m, m, rad]."""
    length = 1e-3 * ground["place"][:, 0].mean(dim=(1, 2)) / RANGE_M
    return torch.stack([length, length, torch.full_like(length, TURN)], dim=1)


def _even(images: Tensor) -> Tensor:
    """Scale pairs of frames to mean 0 and standard deviation 1: their levels hold no information on the motion."""
    mean, std = images.mean(dim=(1, 2, 3), keepdim=True), images.std(dim=(1, 2, 3), keepdim=True)
    return (images - mean) / (std + 1e-6)


def _pair(frames: Tensor) -> tuple[Tensor, ...]:
    """Separate first and second frames ``(batch, ...)`` of alternating frames ``(2 * batch, ...)``."""
    return frames.reshape(-1, 2, *frames.shape[1:]).unbind(dim=1)


def _resized(relief: Tensor | None, cells: Tensor) -> Tensor | None:
    """Interpolate the relief to cells of another size."""
    if relief is None or relief.shape[-2:] == cells.shape[-2:]:
        return relief
    return functional.interpolate(relief, size=cells.shape[-2:], mode="bilinear")


# ---------------- Cells matched by correlation: the displacement of each, its information, and the step of the motion
# that follows


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


# ---------------- The rest of a motion, from the differences of two frames along their slopes, as `direct` does, but
# with learnt filters
# The most informative detail is as fine as a beam, in both directions. So neither the slopes nor the second frame may be
# smoothed when it is sampled between its cells. Slopes are differences of fourth order, and the second frame is first
# interpolated to twice its resolution.
#
# Noise lengthens slopes and makes steps too short. Products of the slopes of both frames measure by how much, since their
# noise is independent.


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


# ---------------- Cells of one size under a motion of the sonar: where the second frame shows the ground of each, and
# the derivative


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


# ---------------- The output of networks that estimate their uncertainty: a Gaussian distribution of the motion, and
# its likelihood


class GaussianHead(NamedTuple):
    """Mean and covariance of motions: sideways, forward [m], yaw [rad].

    Attributes:
        mean: ``(batch, 3)``; in training ``(iterations, batch, 3)``, the last iteration last.
        covariance: ``(batch, 3, 3)``, or ``(iterations, batch, 3, 3)``.
    """

    mean: Tensor
    covariance: Tensor


SCALE = (1e-3, 1e-3, 2.5e-4)
"""Units of the likelihood [m, m, rad]. They are about as large as errors, so that float32 suffices."""


def likelihood(head: GaussianHead, target: Tensor, *, fading: float = 0.6) -> Tensor:
    """Compute the negative log-likelihood of the target, in units of mm, mm, 0.25 mrad, mean over the batch.

    Args:
        head: distribution of the motion.
        target: ``(batch, 3)`` [m, m, rad].
        fading: weight of an iteration relative to the next one.

    Returns:
        A scalar, summed over the iterations.
    """
    mean, covariance = head
    if mean.dim() == 2:
        mean, covariance = mean[None], covariance[None]
    scale = torch.tensor(SCALE, dtype=mean.dtype, device=mean.device)
    error = (mean - target) / scale
    factor = torch.linalg.cholesky(covariance / (scale[:, None] * scale))
    white = torch.linalg.solve_triangular(factor, error[..., None], upper=False)[..., 0]
    each = 0.5 * white.square().sum(-1) + factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    weight = fading ** torch.arange(len(mean) - 1, -1, -1, dtype=mean.dtype, device=mean.device)
    total: Tensor = (weight * each.mean(dim=1)).sum()
    return total
