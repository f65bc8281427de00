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
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsonar.datasets.modality import Fields
from mitsonar.errors import MitsonarError, shortened
from mitsonar.networks.gaussian_head import GaussianHead
from mitsonar.networks.matching import Matching, channels_last, quiet
from mitsonar.networks.slopes import STEP, Slopes
from mitsonar.networks.warp_grid import Ground, WarpGrid

__all__ = ["CorrNet"]

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
