"""CNN-4PoseNet: a PoseNet on each quadrant of the two images (Almanza-Medina, 3.3.4)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mitsonar.errors import MitsonarError
from mitsonar.networks.blocks import (
    Network,
    Quadrants,
    SameAverage,
    Size,
    cells_after,
    convolutions,
    fully_connected,
    glorot,
    scaled,
    values_after,
)
from mitsonar.networks.posenet import LAYERS as POSENET

__all__ = ["Cnn4PoseNet", "QuadPoseNet"]

LAYERS = POSENET[:8]
"""Convolutions of a QuadPoseNet. The text gives their number and kernels; channels and strides are PoseNet's (ours)."""

VALUES = 1024
"""Values of each of its two fully connected layers."""


class QuadPoseNet(nn.Module):
    """Eight convolutions, with a fully connected layer on the last one and another on the first: coarse and fine features.

    The 5 x 5 average after the first convolution does not overlap (ours: MATLAB's stride of 1 would need 200 million weights
    after it). Cells that do not fill it are left out. The fully connected layers have a ReLU (ours). We read the text's
    layers of 2 x 1024 and 8 x 1024 values as these outputs side by side, without weights.

    Args:
        size: rows and columns of the input.
        width: factor on the channels and on the fully connected layers.
    """

    def __init__(self, *, size: Size, width: float) -> None:
        super().__init__()
        layers = convolutions(LAYERS, 1, width, bare_end=False)
        self.first = layers.pop("conv1")
        self.others = nn.Sequential(layers | {"average": SameAverage()})
        self.early = nn.AvgPool2d(5)
        rows, columns = (length // 5 for length in cells_after(size, [2]))
        if min(rows, columns) < 1:
            raise MitsonarError(f"quadrants side by side must have at least 9 x 9 cells: got {size[0]} x {size[1]}")
        values = scaled(VALUES, width)
        self.from_last = fully_connected([values_after(LAYERS, size, width), values])
        self.from_first = fully_connected([scaled(LAYERS[0][1], width) * rows * columns, values])
        self.values = 2 * values

    def forward(self, image: Tensor) -> Tensor:
        """Compute features ``(batch, values)`` of images ``(batch, 1, rows, columns)``."""
        first = self.first(image)
        last = self.from_last(self.others(first).flatten(1))
        return torch.cat((last, self.from_first(self.early(first).flatten(1))), dim=1)


class Cnn4PoseNet(Network):
    """Four pairs of quadrants, each with its own QuadPoseNet; a fully connected layer reads them all.

    Dropout lies before that layer (ours).

    Args:
        outputs: estimates.
        width: factor on the channels and on the sizes of the fully connected layers.
        dropout: rate in training.
        size: rows and columns of the input, two images side by side; rows even, columns divisible by 4.

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
        quarters = [QuadPoseNet(size=quadrant, width=width) for _ in range(4)]
        self.split = Quadrants()
        self.quarters = nn.ModuleList(quarters)
        self.dropout = nn.Dropout(dropout)
        self.regression = nn.Linear(sum(quarter.values for quarter in quarters), outputs)
        glorot(self)

    def forward(self, pair: Tensor) -> Tensor:
        """Estimate labels ``(batch, outputs)`` of two images side by side ``(batch, 1, rows, columns)``, grey values 0..1.

        Raises:
            MitsonarError: images of another size.
        """
        self.expect(pair)
        features = [quarter(image) for quarter, image in zip(self.quarters, self.split(pair), strict=True)]
        return self.regression(self.dropout(torch.cat(features, dim=1)))  # type: ignore[no-any-return]
