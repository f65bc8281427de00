"""CNN-1b: two convolutions on a coarse image (Almanza-Medina, 3.3.3; Costante et al., 2016)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mitsonar.errors import MitsonarError
from mitsonar.networks.blocks import Network, SameConv2d, Size, fully_connected, glorot, scaled

__all__ = ["SIZES", "Cnn1b", "CoarseFeatures"]

CHANNELS = (64, 20)
"""Channels of the two convolutions (ours, after Costante et al.; the text gives only their kernels)."""

SIZES = (2400, 1200, 600, 300)
"""Values of the fully connected layers. The text gives them for CNN-4b, and four layers for both networks."""


class CoarseFeatures(nn.Module):
    """Features of CNN-1b and of each quarter of CNN-4b: a coarse image after one convolution, and after two.

    ``coarse``, a mean over cells; ``conv1``, 9 x 9; ``pool1``, the maximum over 4 x 4; ``conv2``, 2 x 2; ``pool2``, 2 x 2.
    The text is silent on the following, which is ours. The convolutions have ReLU, "same" padding and stride 1. Pools do not
    overlap, and cells that do not fill one are left out, as in MATLAB. The text's layer that joins the outputs of both pools
    has no weights.

    Args:
        cells: rows and columns of cells of a mean.
        size: rows and columns of the input.
        width: factor on the channels.
        channels: of the input.
    """

    def __init__(self, *, cells: int, size: Size, width: float, channels: int = 1) -> None:
        super().__init__()
        first, second = (scaled(full, width) for full in CHANNELS)
        self.coarse = nn.AvgPool2d(cells)
        self.conv1 = nn.Sequential(SameConv2d(channels, first, 9), nn.ReLU(inplace=True))
        self.pool1 = nn.MaxPool2d(4)
        self.conv2 = nn.Sequential(SameConv2d(first, second, 2), nn.ReLU(inplace=True))
        self.pool2 = nn.MaxPool2d(2)
        rows, columns = (length // cells // 4 for length in size)
        if min(rows, columns) < 2:
            raise MitsonarError(
                f"images must have at least {8 * cells} x {8 * cells} cells where the network first takes means over "
                f"{cells} x {cells}: got {size[0]} x {size[1]}"
            )
        self.values = first * rows * columns + second * (rows // 2) * (columns // 2)

    def forward(self, image: Tensor) -> Tensor:
        """Compute features ``(batch, values)`` of images ``(batch, channels, rows, columns)``."""
        fine = self.pool1(self.conv1(self.coarse(image)))
        return torch.cat((fine.flatten(1), self.pool2(self.conv2(fine)).flatten(1)), dim=1)


class Cnn1b(Network):
    """Means over 8 x 8 cells, two convolutions, and a fully connected network of four layers.

    Dropout lies before the fully connected network (ours; the text gives a rate, but no position).

    Args:
        outputs: estimates.
        width: factor on the channels and on the sizes of the fully connected layers.
        dropout: rate in training.
        size: rows and columns of the input, at least 64 each.
        channels: of the input; with Almanza-Medina's 1 the frames are side by side.

    Raises:
        MitsonarError: a value out of its range.
    """

    def __init__(
        self,
        *,
        outputs: int = 3,
        width: float = 1.0,
        dropout: float = 0.5,
        size: Size = (512, 192),
        channels: int = 1,
    ) -> None:
        super().__init__(outputs=outputs, width=width, dropout=dropout, channels=channels, size=size)
        self.features = CoarseFeatures(cells=8, size=size, width=width, channels=channels)
        self.dropout = nn.Dropout(dropout)
        self.layers = fully_connected([self.features.values, *(scaled(full, width) for full in SIZES)])
        self.regression = nn.Linear(scaled(SIZES[-1], width), outputs)
        glorot(self)

    def forward(self, image: Tensor) -> Tensor:
        """Estimate labels ``(batch, outputs)`` of frames ``(batch, channels, rows, columns)``, grey values 0..1.

        Raises:
            MitsonarError: frames of another size.
        """
        self.expect(image)
        return self.regression(self.layers(self.dropout(self.features(image))))  # type: ignore[no-any-return]
