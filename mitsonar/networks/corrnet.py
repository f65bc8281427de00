"""CorrNet: two frames are matched cell by cell, and the known geometry turns what the cells say into one motion (ours).

A shared encoder describes blocks of both frames. The second frame's blocks are drawn where the motion found so far takes
those of the first; a local correlation volume gives each block a displacement (soft-argmax) and how sure it is of it (a
2 x 2 information matrix). One weighted least-squares problem with the sonar's derivative turns all of them into a step of
the motion, in closed form; its normal matrix tells the covariance. Finer looks, one beam wide, take what is left from the
frames' differences and slopes. Rocks stand above the ground that the geometry knows: a few layers guess from both frames
by how much.

Correlation volumes and their lookup are from PWC-Net (Sun et al. 2018) and RAFT (Teed and Deng 2020); here flow has
three parameters, and their derivative is known. The volume's second axis is the beam: how far a motion shifts each cell
along it, sine or angle, the geometry says, so even beams are not needed.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsonar.errors import MitsonarError
from mitsonar.networks.gaussian_head import GaussianHead
from mitsonar.networks.matching import Matching, channels_last, quiet
from mitsonar.networks.slopes import STEP, Slopes
from mitsonar.networks.warp_grid import Ground, WarpGrid

__all__ = ["CorrNet"]

BLOCK = (16, 2)
"""Bins and beams that are described together."""

FEWEST = (128, 16)
"""Bins and beams of an image that gives the first look something to match."""

RANGE_M = 4.4
"""Mean range at which the unit of length is 1 mm, of turns 0.25 mrad: lengths scale with the scene, images then do not
change."""

TURN = 2.5e-4

JUDGED = 2
"""Finer looks that judge anew; later ones keep what these have found."""

TALLEST = 0.2
"""Relief that can be guessed, as part of the height."""


class CorrNet(nn.Module):
    """Matching with known geometry.

    Args:
        width: scales the channels.
        looks: at blocks, their weights tied: the second reaches what was beyond the first one's blocks.
        finer: looks at differences and slopes, tied as well.
        relief: whether the height of what is seen above the ground is guessed for each cell.

    Raises:
        MitsonarError: a value that no network can have.
    """

    needs: ClassVar[dict[str, Any]] = {"layout": "channels", "ground": True}
    any_sonar: ClassVar[bool] = True
    has_covariance: ClassVar[bool] = True

    def __init__(self, *, width: float = 1.0, looks: int = 2, finer: int = 3, relief: bool = True) -> None:
        super().__init__()
        counts = all(isinstance(count, int) and count >= 1 for count in (looks, finer))
        if not isinstance(width, int | float) or not 0 < width < math.inf or not counts:
            raise MitsonarError(
                f"corrnet takes a width above 0, looks and finer of at least 1: got {width!r}, {looks!r} and {finer!r}"
            )
        self.options: dict[str, Any] = {"width": width, "looks": looks, "finer": finer, "relief": relief}
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

    def forward(self, images: Tensor, ground: Ground) -> GaussianHead:
        """The motion between two frames.

        Args:
            images: ``(batch, 2, bins, beams)`` in 0..1.
            ground: a batch of :func:`mitsonar.datasets.ground_nodes.ground_at`.

        Returns:
            The law of the motion; in training that of each look.

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
        unit, laws = _units(ground), []
        relief = None if self.relief is None else self.relief(*blocks)
        motion, judged = images.new_zeros(batch, 3), None
        warp_grid = WarpGrid(ground, unit, BLOCK, size, blocks[0].shape[-2:], relief)
        for _ in range(self.options["looks"]):
            motion, normal = self.matching(blocks, warp_grid, motion)
            laws.append((motion, normal))
        warp_grid = WarpGrid(ground, unit, (STEP, 1), size, cells[0].shape[-2:], _resized(relief, cells[0]))
        for k in range(self.options["finer"]):
            motion, normal, judged = self.slopes(cells, warp_grid, motion, judged if k >= JUDGED else None)
            laws.append((motion, normal))
        if not self.training:
            return self._law(motion, normal, unit)
        return GaussianHead(*(torch.stack(values) for values in zip(*(self._law(*law, unit) for law in laws), strict=True)))

    def _law(self, motion: Tensor, normal: Tensor, unit: Tensor) -> GaussianHead:
        """Mean and covariance: what cells say is not independent, something remains always, and scale errors grow with the
        motion."""
        inverse = torch.linalg.inv(normal)
        far = motion.detach()
        covariance = torch.exp(2 * self.scale) * (inverse + inverse.mT) / 2 + torch.diag_embed(
            torch.exp(2 * self.floor) + torch.exp(2 * self.share) * far.square()
        )
        return GaussianHead(motion * unit, covariance * unit[:, :, None] * unit[:, None, :])


class Relief(nn.Module):
    """How far what each block shows stands above the ground, as part of the height, from both frames."""

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
        """``(batch, 1, rows, columns)``."""
        return TALLEST * torch.tanh(self.layers(torch.cat([first, second], dim=1)))


def _units(ground: Ground) -> Tensor:
    """Units of motions ``(batch, 3)`` [m, m, rad]."""
    length = 1e-3 * ground["place"][:, 0].mean(dim=(1, 2)) / RANGE_M
    return torch.stack([length, length, torch.full_like(length, TURN)], dim=1)


def _even(images: Tensor) -> Tensor:
    """Pairs of frames with mean 0 and standard deviation 1: levels carry no motion."""
    mean, std = images.mean(dim=(1, 2, 3), keepdim=True), images.std(dim=(1, 2, 3), keepdim=True)
    return (images - mean) / (std + 1e-6)


def _pair(frames: Tensor) -> tuple[Tensor, ...]:
    """First and second frames ``(batch, ...)`` of frames in turn ``(2 * batch, ...)``."""
    return frames.reshape(-1, 2, *frames.shape[1:]).unbind(dim=1)


def _resized(relief: Tensor | None, cells: Tensor) -> Tensor | None:
    """Relief at cells of another size."""
    if relief is None or relief.shape[-2:] == cells.shape[-2:]:
        return relief
    return functional.interpolate(relief, size=cells.shape[-2:], mode="bilinear")
