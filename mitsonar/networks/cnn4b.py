"""CNN-4b: CNN-1b on each quadrant of the two images (Almanza-Medina, 3.3.3; Costante et al., 2016)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mitsonar.networks.blocks import Network, Quadrants, Size, fully_connected, glorot, scaled
from mitsonar.networks.cnn1b import SIZES, CoarseFeatures

__all__ = ["Cnn4b"]


class Cnn4b(Network):
    """Four pairs of quadrants, each with CNN-1b's convolutions on means over 4 x 4 cells, and one fully connected network.

    The four share no weights. Dropout lies before the fully connected network. Both are ours.

    Args:
        outputs: estimates.
        width: factor on the channels and on the sizes of the fully connected layers.
        dropout: rate in training.
        size: rows and columns of the input, two images side by side; at least 64 each, rows even, columns divisible by 4.

    Raises:
        MitsonarError: a value out of its range, or images that cannot be cut into quadrants.
    """

    def __init__(
        self,
        *,
        outputs: int = 3,
        width: float = 1.0,
        dropout: float = 0.5,
        size: Size = (512, 192),
    ) -> None:
        super().__init__(outputs=outputs, width=width, dropout=dropout, size=size)
        quadrant = Quadrants.size(size)
        quarters = [CoarseFeatures(cells=4, size=quadrant, width=width) for _ in range(4)]
        values = sum(quarter.values for quarter in quarters)
        self.split = Quadrants()
        self.quarters = nn.ModuleList(quarters)
        self.dropout = nn.Dropout(dropout)
        self.layers = fully_connected([values, *(scaled(full, width) for full in SIZES)])
        self.regression = nn.Linear(scaled(SIZES[-1], width), outputs)
        glorot(self)

    def forward(self, pair: Tensor) -> Tensor:
        """Estimate labels ``(batch, outputs)`` of two images side by side ``(batch, 1, rows, columns)``, grey values 0..1.

        Raises:
            MitsonarError: images of another size.
        """
        self.expect(pair)
        features = [quarter(image) for quarter, image in zip(self.quarters, self.split(pair), strict=True)]
        return self.regression(self.layers(self.dropout(torch.cat(features, dim=1))))  # type: ignore[no-any-return]
