"""How CorrNet estimates motion: it matches two frames cell by cell, and known geometry turns the shifts into one motion.

A shared encoder computes descriptors of blocks in both frames. Those of the second frame are sampled where the current
motion estimate places the blocks of the first. A local correlation volume gives the displacement of each block
(soft-argmax) and its 2 x 2 information matrix. A weighted least-squares problem with the derivative of the sonar geometry
turns the displacements into a step of the motion, in closed form. Its normal matrix gives the covariance. Finer iterations,
on cells one beam wide, estimate the remainder from the differences and slopes of the frames. Because rocks rise above the
level ground of the geometry, a few layers estimate their height from both frames.

The network is ours. Correlation volumes and their lookup are from PWC-Net (Sun et al. 2018) and RAFT (Teed and Deng 2020);
here the flow has three parameters, and its derivative with respect to them is known. The second axis of the volume is the
beam. The geometry defines how far a motion shifts each cell along it, so the beams need not be evenly spaced.
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
from mitsonar.errors import MitsonarError, short_repr
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
"""Number of bins and beams in a block."""

MIN_SIZE = (128, 16)
"""Smallest number of bins and beams in an image; a smaller image has too few blocks for the first iteration."""

RANGE_M = 4.4
"""Mean range at which the unit of length is 1 mm [m]. The unit is proportional to range, as images do not show scale."""

YAW_UNIT = 2.5e-4
"""Unit of yaw [rad]."""

WEIGHTED_ITERATIONS = 2
"""Number of fine iterations that compute weights; later iterations reuse the last ones."""

MAX_RELIEF = 0.2
"""Largest relief, as a fraction of the sonar's height."""


class CorrNet(nn.Module):
    """Network that estimates motion and covariance by matching two frames with known ground geometry.

    Args:
        width: factor on the channels.
        looks: number of iterations on blocks, which share their parameters. The second reaches farther than the first.
        finer: number of iterations on differences and slopes, which also share their parameters.
        relief: whether to estimate the height of each cell above the ground.

    Raises:
        MitsonarError: a value is out of range.
    """

    needs: ClassVar[Fields] = {"layout": "channels", "ground": True}
    any_sonar: ClassVar[bool] = True
    has_covariance: ClassVar[bool] = True

    def __init__(self, *, width: float = 1.0, looks: int = 2, finer: int = 3, relief: bool = True) -> None:
        super().__init__()
        valid_counts = all(isinstance(count, int) and count >= 1 for count in (looks, finer))
        if not isinstance(width, int | float) or not 0 < width < math.inf or not valid_counts:
            raise MitsonarError(
                f"corrnet takes a width above 0, looks and finer of at least 1: got {short_repr(width)}, "
                f"{short_repr(looks)} and {short_repr(finer)}"
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
            start: initial motion of the iterations ``(batch, 3)`` [m, m, rad]; default: zero.

        Returns:
            The distribution of the motion; in training mode that of each iteration.

        Raises:
            MitsonarError: the images are too small, or not pairs.
        """
        if images.dim() != 4 or images.shape[1] != 2 or images.shape[2] < MIN_SIZE[0] or images.shape[3] < MIN_SIZE[1]:
            raise MitsonarError(
                f"corrnet takes (batch, 2, bins, beams) of {MIN_SIZE[0]} bins and {MIN_SIZE[1]} beams or more: got "
                f"{tuple(images.shape)}"
            )
        # 1. Compute descriptors of blocks, and filtered frames with their slopes for the finer iterations.
        batch, size = images.shape[0], (images.shape[2], images.shape[3])
        frames = _normalised(images).reshape(2 * batch, 1, *size)
        blocks = tuple(cells.contiguous() for cells in _split_pairs(self.encoder(frames)))
        cells = self.slopes.prepared(*_split_pairs(self.slopes.filter(frames)))
        # 2. Work in units of motion in which all three components are of similar size.
        unit, estimates = _units(ground), []
        relief = None if self.relief is None else self.relief(*blocks)
        motion, judged = images.new_zeros(batch, 3) if start is None else start / unit, None
        # 3. Coarse iterations: match blocks by correlation, which tolerates large displacements.
        warp_grid = WarpGrid(ground, unit, BLOCK, size, blocks[0].shape[-2:], relief)
        for _ in range(self.options["looks"]):
            motion, normal = self.matching(blocks, warp_grid, motion)
            estimates.append((motion, normal))
        # 4. Fine iterations: Gauss-Newton steps on small cells, which are accurate close to the result.
        warp_grid = WarpGrid(ground, unit, (STEP, 1), size, cells[0].shape[-2:], _resized(relief, cells[0]))
        for k in range(self.options["finer"]):
            motion, normal, judged = self.slopes(cells, warp_grid, motion, judged if k >= WEIGHTED_ITERATIONS else None)
            estimates.append((motion, normal))
        # 5. In training the likelihood sees every iteration, so that each one learns.
        if not self.training:
            return self._head(motion, normal, unit)
        heads = [self._head(*estimate, unit) for estimate in estimates]
        return GaussianHead(*(torch.stack(values) for values in zip(*heads, strict=True)))

    def _head(self, motion: Tensor, normal: Tensor, unit: Tensor) -> GaussianHead:
        """Compute mean and covariance of the motion.

        The inverse normal matrix is scaled, because errors of cells are correlated. A constant floor and a variance that
        grows with the square of the motion, for scale errors, are added.
        """
        inverse = torch.linalg.inv(normal)
        detached = motion.detach()
        covariance = torch.exp(2 * self.scale) * (inverse + inverse.mT) / 2 + torch.diag_embed(
            torch.exp(2 * self.floor) + torch.exp(2 * self.share) * detached.square()
        )
        return GaussianHead(motion * unit, covariance * unit[:, :, None] * unit[:, None, :])


class Relief(nn.Module):
    """Layers that estimate the height of each block above the ground from both frames, relative to the sonar's height."""

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
        """Estimate the relief ``(batch, 1, rows, columns)`` from the descriptors of both frames."""
        return MAX_RELIEF * torch.tanh(self.layers(torch.cat([first, second], dim=1)))


def _units(ground: Ground) -> Tensor:
    """Compute the units of motion ``(batch, 3)`` [m, m, rad]."""
    length = 1e-3 * ground["place"][:, 0].mean(dim=(1, 2)) / RANGE_M
    return torch.stack([length, length, torch.full_like(length, YAW_UNIT)], dim=1)


def _normalised(images: Tensor) -> Tensor:
    """Normalise pairs of frames to mean 0 and standard deviation 1, as their levels carry no information on motion."""
    mean, std = images.mean(dim=(1, 2, 3), keepdim=True), images.std(dim=(1, 2, 3), keepdim=True)
    return (images - mean) / (std + 1e-6)


def _split_pairs(frames: Tensor) -> tuple[Tensor, ...]:
    """Split alternating frames ``(2 * batch, ...)`` into first and second frames ``(batch, ...)``."""
    return frames.reshape(-1, 2, *frames.shape[1:]).unbind(dim=1)


def _resized(relief: Tensor | None, cells: Tensor) -> Tensor | None:
    """Interpolate the relief to the grid of other cells."""
    if relief is None or relief.shape[-2:] == cells.shape[-2:]:
        return relief
    return functional.interpolate(relief, size=cells.shape[-2:], mode="bilinear")


# ---------------- Coarse iterations: matching by correlation


Pair = tuple[Tensor, ...]
"""Cells of the first and of the second frame, and tensors derived from them."""

Context: TypeAlias = Any
"""Context object that torch passes from a function to its derivative; torch gives it no type."""

MIN_POWER = 1e-2
"""Mean square of a descriptor below which the cell is treated as empty."""


class Matching(nn.Module):
    """Layers that refine a motion by correlating each cell with the cells around its predicted position.

    Args:
        reach: number of cells searched on either side, along range and beams.
        channels: of the descriptors.
        hidden: channels of the intermediate layers.
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
        with torch.no_grad():  # initially average correlations over 3 x 3 cells; the judge has no effect
            self.smooth.weight.zero_()
            self.smooth.weight[range(count), range(count)] = 1 / 9

    def forward(self, cells: Pair, warp_grid: WarpGrid, motion: Tensor) -> tuple[Tensor, Tensor]:
        """Refine a motion by one step.

        Args:
            cells: descriptors of both frames ``(batch, channels, rows, columns)``.
            warp_grid: of these cells.
            motion: current estimate ``(batch, 3)``, in units.

        Returns:
            The motion ``(batch, 3)`` in units, and its normal matrix ``(batch, 3, 3)``.
        """
        # 1. Sample the second frame at the predicted positions, and measure the remaining displacements.
        second, inside = warp_grid.draw(cells[1], motion)
        displaced, factor = self.displaced(cells[0], second)
        # 2. Form the information matrix L L' of each cell; cells outside the frame get none.
        l11, l22, l21 = (factor * inside[:, None]).unbind(dim=1)
        along, across, mixed = l11 * l11, l21 * l21 + l22 * l22, l11 * l21
        # 3. Solve the weighted least-squares problem for the step of the motion.
        down, aside = displaced.unbind(dim=1)
        gradient = torch.stack([along * down + mixed * aside, mixed * down + across * aside], dim=1)
        step, normal = warp_grid.solved(torch.stack([along, across, mixed], dim=1), gradient)
        return motion + step, normal

    def displaced(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Estimate the displacement of each cell.

        Returns:
            Displacements ``(batch, 2, rows, columns)`` [cells], and the elements 11, 22 and 21 of the Cholesky factor L of
            their information matrix L L' ``(batch, 3, rows, columns)``.
        """
        # 1. Correlate normalised descriptors, so that brightness does not bias the match.
        first_unit, first_power = _unit_descriptions(first)
        second_unit, second_power = _unit_descriptions(second)
        volume = self._volume(first_unit, second_unit)
        # 2. Judge each cell by its correlations and by the power of its descriptors: faint cells carry little information.
        judged = self.judge(torch.cat([volume, first_power, second_power], dim=1))
        count = volume.shape[1]
        # 3. Displacement by soft-argmax over the smoothed correlations, which is differentiable and finer than a cell.
        share = torch.softmax(torch.exp(self.sharpness) * self.smooth(volume) + judged[:, :count], dim=1)
        shift = torch.stack([(share * place).sum(dim=1) for place in self.places], dim=1)
        # 4. Cholesky factor of the information, whose diagonal must be positive.
        diagonal = functional.softplus(judged[:, count : count + 2] - 1)
        return shift, torch.cat([diagonal, 0.3 * judged[:, count + 2 :]], dim=1)

    def _volume(self, first: Tensor, second: Tensor) -> Tensor:
        """Correlate each cell with the cells around its predicted position ``(batch, places, rows, columns)``."""
        down, across = self.reach
        padded = functional.pad(second, (across, across, down, down))
        if torch.is_grad_enabled() and (first.requires_grad or second.requires_grad):
            return _Correlations.apply(first, padded)  # type: ignore[no-any-return, no-untyped-call]
        return _correlations(first, padded)


def quiet(layer: nn.Conv2d) -> nn.Conv2d:
    """Set the parameters of a layer to 0, so that it has no effect before training, and return it."""
    for values in layer.parameters():
        nn.init.zeros_(values)
    return layer


def channels_last(*layers: nn.Module) -> nn.Sequential:
    """Join layers in torch's channels-last format, in which a CPU convolves few channels 1.5 times faster."""
    return nn.Sequential(*layers).to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def _unit_descriptions(cells: Tensor) -> tuple[Tensor, Tensor]:
    """Scale descriptors to mean square 1, and return them with the logarithm of their original mean square."""
    power = (cells * cells).mean(dim=1, keepdim=True) + MIN_POWER
    return cells * torch.rsqrt(power), torch.log(power)


def _shifted(first: Tensor, padded: Tensor) -> list[Tensor]:
    """Return all views of the padded frame that have the size of the other one, with range as the outer loop."""
    rows, columns = first.shape[-2:]
    down, across = (large - small + 1 for large, small in zip(padded.shape[-2:], (rows, columns), strict=True))
    return [padded[:, :, r : r + rows, c : c + columns] for r in range(down) for c in range(across)]


def _correlations(first: Tensor, padded: Tensor) -> Tensor:
    """Correlate each cell with all shifts of the padded frame, as means over the channels."""
    rows, columns = first.shape[-2:]
    shifted = padded.unfold(2, rows, 1).unfold(3, columns, 1)
    return (first[:, :, None, None] * shifted).mean(dim=1).flatten(1, 2)


class _Correlations(torch.autograd.Function):
    """:func:`_correlations` with a derivative that needs a third of the memory accesses of torch's derivative."""

    @staticmethod
    def forward(context: Context, first: Tensor, padded: Tensor) -> Tensor:
        context.save_for_backward(first, padded)
        return _correlations(first, padded)

    @staticmethod
    def backward(context: Context, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        first, padded = context.saved_tensors
        by_volume = gradients[0] / first.shape[1]
        by_first, by_padded = torch.zeros_like(first), torch.zeros_like(padded)
        for k, (part, by_part) in enumerate(zip(_shifted(first, padded), _shifted(first, by_padded), strict=True)):
            by_first.addcmul_(by_volume[:, k : k + 1], part)
            by_part.addcmul_(by_volume[:, k : k + 1], first)
        return by_first, by_padded


# ---------------- Fine iterations: differences and slopes


STEP = 2
"""Number of bins in a cell; a cell is one beam wide."""

POOL = (4, 2)
"""Numbers of cells along range and beams that share one weight."""

HALFWAY = (0.0243, -0.1351, 0.6079, 0.6079, -0.1351, 0.0243)
"""Lanczos weights (three lobes) of six cells for the value midway between them. Training changes them."""

MAX_STEP = 8.0
"""Largest step, in units; fine iterations start close to the result."""

MIN_SIGNAL_SHARE = 0.2
"""Smallest share of the squared slopes that is taken as signal; steps are lengthened by a factor of at most five."""


class SlopeStep(NamedTuple):
    """Slopes and weights of an iteration, which the next one may reuse.

    Attributes:
        down: slopes along range times their weight ``(batch, filters, rows, columns)``.
        aside: slopes across beams times their weight ``(batch, filters, rows, columns)``.
        information: about the displacement of each cell ``(batch, 3, rows, columns)``.
        signal_share: share of the squared slopes that is not noise ``(batch, 1)``.
    """

    down: Tensor
    aside: Tensor
    information: Tensor
    signal_share: Tensor


class Slopes(nn.Module):
    """Gauss-Newton steps on filtered frames, as in the estimator ``direct``, but with learnt filters.

    The most informative detail is as fine as a beam, in both directions. Therefore neither the slopes nor the second frame
    may be smoothed when it is sampled between its cells: slopes are differences of fourth order, and the second frame is
    first interpolated to twice its resolution.

    Noise makes slopes too steep and steps too short. The products of the slopes of both frames measure by how much, because
    their noise is independent.

    Args:
        filters: number of filtered frames.
        hidden: channels of the layers that compute weights.
    """

    def __init__(self, filters: int, hidden: int) -> None:
        super().__init__()
        levels = max(2, round(filters * 2 / 3))
        self.filter = channels_last(  # levels first: with additive noise, faint levels hold most information
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
            The first frame, the second frame at twice the resolution, and both slopes of the first.
        """
        first = first.contiguous()
        finer = _doubled(_doubled(second.contiguous(), self.across, 3), self.along, 2)
        return first, finer, _slope(first, 2), _slope(first, 3)

    def forward(
        self, frames: Pair, warp_grid: WarpGrid, motion: Tensor, judged: SlopeStep | None = None
    ) -> tuple[Tensor, Tensor, SlopeStep]:
        """Refine a motion by one step.

        Args:
            frames: result of :meth:`prepared`.
            warp_grid: of these cells.
            motion: current estimate ``(batch, 3)``, in units.
            judged: slopes and weights of an earlier iteration to reuse; by default they are computed.

        Returns:
            The motion ``(batch, 3)`` in units, its normal matrix ``(batch, 3, 3)``, and the slopes and weights.
        """
        first = frames[0]
        second, inside = warp_grid.draw(frames[1], motion)
        residual = second - first
        if judged is None:
            judged = self._judged(frames, second, residual, inside)
        gradient = -torch.stack([(judged.down * residual).sum(dim=1), (judged.aside * residual).sum(dim=1)], dim=1)
        step, normal = warp_grid.solved(judged.information, gradient)
        step = (step / judged.signal_share).clamp(-MAX_STEP, MAX_STEP)
        return motion + step, normal * judged.signal_share[..., None] * torch.exp(self.scale), judged

    def _judged(self, frames: Pair, second: Tensor, residual: Tensor, inside: Tensor) -> SlopeStep:
        """Compute slopes and weights from both frames at the current motion."""
        # 1. Average the slopes of both frames, whose noise is independent.
        first, first_slopes = frames[0], frames[2:]
        second_slopes = _slope(second, 2), _slope(second, 3)
        weight = self._weight(first, second, residual) * inside[:, None]
        down, aside = ((a + b) / 2 for a, b in zip(first_slopes, second_slopes, strict=True))
        # 2. Information about the displacement: weighted products of slopes, summed over filters.
        by_down, by_aside = weight * down, weight * aside
        along, across = (by_down * down).sum(dim=1), (by_aside * aside).sum(dim=1)
        # 3. Noise cancels in products of slopes of different frames, so their share of the information is the signal.
        common = (weight * (first_slopes[0] * second_slopes[0] + first_slopes[1] * second_slopes[1])).sum(dim=(1, 2, 3))
        signal_share = common / (along + across).sum(dim=(1, 2)).clamp(min=1e-12)
        information = torch.stack([along, across, (by_down * aside).sum(dim=1)], dim=1)
        return SlopeStep(by_down, by_aside, information, signal_share.clamp(MIN_SIGNAL_SHARE, 1.0)[:, None])

    def _weight(self, first: Tensor, second: Tensor, residual: Tensor) -> Tensor:
        """Compute the weight of each cell and filter from the local power of difference, mean and product of both frames."""
        apart, mean = _pooled(residual.square()), _pooled((first + second).square()) / 4
        powers = torch.cat([apart, mean, (mean - apart / 4).abs()], dim=1)  # the last one: of first times second
        weight = functional.softplus(self.judge(torch.log(powers + 1e-3)))
        return functional.interpolate(weight, size=first.shape[-2:], mode="nearest")


def _doubled(frame: Tensor, weights: Tensor, axis: int) -> Tensor:
    """Interpolate between the cells along an axis, 2 (range) or 3 (beams): ``n`` cells become ``2 n - 1``."""
    last = frame.shape[axis] - 1
    between = functional.conv2d(_padded(frame, axis), weights, groups=frame.shape[1])
    pairs = torch.stack([frame.narrow(axis, 0, last), between], dim=axis + 1).flatten(axis, axis + 1)
    return torch.cat([pairs, frame.narrow(axis, last, 1)], dim=axis)


def _slope(frame: Tensor, axis: int) -> Tensor:
    """Compute the slope per cell along an axis, to fourth order."""
    count, padded = frame.shape[axis], _padded(frame, axis)
    near, far = (padded.narrow(axis, 2 + k, count) - padded.narrow(axis, 2 - k, count) for k in (1, 2))
    return (2 / 3) * near - (1 / 12) * far


def _padded(frame: Tensor, axis: int) -> Tensor:
    """Pad an axis by two replicated cells at both ends."""
    return functional.pad(frame, (2, 2, 0, 0) if axis == 3 else (0, 0, 2, 2), mode="replicate")


def _pooled(values: Tensor) -> Tensor:
    """Average over the cells that share one weight."""
    rows, columns = (length // count for length, count in zip(values.shape[-2:], POOL, strict=True))
    values = values[:, :, : rows * POOL[0], : columns * POOL[1]]
    by_row = values.unflatten(2, (rows, POOL[0])).sum(dim=3)  # type: ignore[no-untyped-call]  # torch gives no types
    return sum(by_row[..., k :: POOL[1]] for k in range(POOL[1])) / math.prod(POOL)  # type: ignore[no-any-return]


# ---------------- Geometry of a grid of cells


Ground = dict[str, Tensor]
"""A batch of the arrays of :func:`mitsonar.datasets.samples.ground_at`, keyed by name."""

PRIOR = 0.01
"""Information of a weak zero-mean prior on the step, with a standard deviation of ten units, for frames without detail."""


class WarpGrid:
    """Grid of cells of one size: their positions, and how they move with the sonar.

    Args:
        ground: a batch of :func:`mitsonar.datasets.samples.ground_at`.
        unit: of motions ``(batch, 3)`` [m, m, rad].
        step: numbers of bins and beams in a cell.
        size: numbers of bins and beams in the image.
        shape: numbers of rows and columns of the grid.
        relief: height above the ground, as a fraction of the sonar's height ``(batch, 1, rows, columns)``.
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
        """Sample the second frame bilinearly at the positions to which a motion moves the cells of the first.

        Args:
            second: the second frame ``(batch, channels, rows, columns)``.
            motion: ``(batch, 3)``, in units.

        Returns:
            The samples, and a mask ``(batch, rows, columns)``: 1 if a sample lies within the frame, else 0.
        """
        place = self.base + self.span * self._shift(motion)
        inside = (place.abs().amax(dim=1) <= 1 + 1e-3).to(second.dtype)  # tolerate rounding at the border
        if self.lit is not None:
            inside = inside * self.lit
        grid = torch.stack([place[:, 1], place[:, 0]], dim=-1)
        return functional.grid_sample(second, grid, align_corners=True, padding_mode="border"), inside

    def solved(self, information: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Solve the least-squares problem for the step of the motion.

        Args:
            information: about the displacement of each cell: along range, across beams, and the off-diagonal element
                ``(batch, 3, rows, columns)``.
            gradient: of the squared error, negated: information times displacement, along range and across beams
                ``(batch, 2, rows, columns)``.

        Returns:
            The step ``(batch, 3)`` in units, and its normal matrix ``(batch, 3, 3)``.
        """
        weighed = self.derivative * information[:, None, :2] + self.crosswise * information[:, None, 2:]
        flat = self.derivative.flatten(2)
        normal = weighed.flatten(2) @ flat.mT + PRIOR * torch.eye(3, dtype=gradient.dtype, device=gradient.device)
        return torch.linalg.solve(normal, flat @ gradient.flatten(1)[..., None])[..., 0], normal

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
    # the two definitions of bearing may occur in one batch
    ahead = torch.where(ground["cone"][:, None, None] > 0, torch.sqrt(f * f + u * u), f)
    radius, bearing = torch.sqrt(s * s + f * f + u * u), torch.atan2(s, ahead)
    return (torch.stack([radius, bearing], dim=1) - ground["place"]) / ground["cell"]


def _borders(shape: tuple[int, ...], unit: Tensor) -> tuple[Tensor, Tensor]:
    """Compute positions ``(2, rows, columns)`` and sizes ``(2, 1, 1)`` of cells in image coordinates from -1 to 1."""
    axes = [torch.linspace(-1, 1, count, dtype=unit.dtype, device=unit.device) for count in shape]
    span = unit.new_tensor([2 / (count - 1) for count in shape])
    return torch.stack(torch.meshgrid(*axes, indexing="ij")), span[:, None, None]


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # the cache may pass tensors from evaluation to training
def _from_nodes(nodes: int, length: int, every: int, count: int, device: torch.device) -> Tensor:
    """Compute the linear interpolation weights ``(count, nodes)`` from evenly spaced nodes to the centres of cells.

    The nodes span ``length`` bins or beams; a cell has ``every`` bins or beams.
    """
    middle = torch.arange(count, dtype=torch.float64) * every + (every - 1) / 2
    place = (middle * ((nodes - 1) / (length - 1))).clamp(0, nodes - 1)
    before = place.floor().clamp(max=nodes - 2)
    weight = torch.zeros(count, nodes, dtype=torch.float64)
    row = torch.arange(count)
    weight[row, before.long()] = 1 - (place - before)
    weight[row, before.long() + 1] = place - before
    return weight.to(torch.float32).to(device)


# ---------------- Output distribution and likelihood


class GaussianHead(NamedTuple):
    """Gaussian distribution of motions: sideways, forward [m], yaw [rad].

    Attributes:
        mean: ``(batch, 3)``; in training mode ``(iterations, batch, 3)``, in the order of the iterations.
        covariance: ``(batch, 3, 3)``, or ``(iterations, batch, 3, 3)``.
    """

    mean: Tensor
    covariance: Tensor


SCALE = (1e-3, 1e-3, 2.5e-4)
"""Units of the likelihood [m, m, rad]. They are of the order of typical errors, so float32 suffices."""


def likelihood(head: GaussianHead, target: Tensor, *, fading: float = 0.6) -> Tensor:
    """Compute the mean negative log-likelihood of a batch of targets, in units of mm, mm and 0.25 mrad.

    Args:
        head: distribution of the motion.
        target: ``(batch, 3)`` [m, m, rad].
        fading: weight of an iteration relative to the next one.

    Returns:
        A scalar, the weighted sum over the iterations.
    """
    mean, covariance = head
    if mean.dim() == 2:
        mean, covariance = mean[None], covariance[None]
    # 1. Whiten the errors with the Cholesky factor, which also gives the determinant of the covariance.
    scale = torch.tensor(SCALE, dtype=mean.dtype, device=mean.device)
    error = (mean - target) / scale
    factor = torch.linalg.cholesky(covariance / (scale[:, None] * scale))
    white = torch.linalg.solve_triangular(factor, error[..., None], upper=False)[..., 0]
    each = 0.5 * white.square().sum(-1) + factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    # 2. Weight later iterations more, because the last one is the result.
    weight = fading ** torch.arange(len(mean) - 1, -1, -1, dtype=mean.dtype, device=mean.device)
    total: Tensor = (weight * each.mean(dim=1)).sum()
    return total
