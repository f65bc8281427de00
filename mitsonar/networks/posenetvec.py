"""PoseNetVec: a PoseNet for vectors that keeps the number of columns (Almanza-Medina, 4.3.1 and Table 4.2)."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor, nn

from mitsonar.datasets.modality import Fields
from mitsonar.networks.blocks import Network, SameAverage, Size, column_convolutions, glorot, scaled

__all__ = ["CHANNELS", "KERNELS", "PoseNetVec"]

KERNELS = (7, 5, 3, 3, 3, 3, 3, 3, 3)
"""Rows of the kernels, along the range."""

CHANNELS = (32, 64, 128, 256, 512, 512, 512, 1024, 1024)

ACROSS = 2
"""Columns of a kernel."""


class PoseNetVec(Network):
    """Nine convolutions of stride 2 along the range and 1 across, a mean over 4 x 4 cells, a fully connected layer.

    It reads vectors side by side, two of each portion of the field of view: 512 x 2 of the whole, 512 x 8 of four quadrants.
    From one vector it estimates the height (Table 4.4). Dropout lies before the fully connected layer (ours, as in PoseNet;
    the text gives no position).

    Args:
        outputs: estimates.
        width: factor on the channels.
        dropout: rate in training.
        size: range levels and columns of the input.
        channels: of the input.

    Raises:
        MitsonarError: a value out of its range.
    """

    needs: ClassVar[Fields] = {"kind": "vector"}

    def __init__(
        self, *, outputs: int = 3, width: float = 1.0, dropout: float = 0.5, size: Size = (512, 8), channels: int = 1
    ) -> None:
        super().__init__(outputs=outputs, width=width, dropout=dropout, channels=channels, size=size)
        layers = column_convolutions(KERNELS, CHANNELS, ACROSS, width, channels)
        self.layers = nn.Sequential(*layers, SameAverage())
        self.dropout = nn.Dropout(dropout)
        rows, columns = size
        for _ in KERNELS:
            rows = -(-rows // 2)
        self.regression = nn.Linear(scaled(CHANNELS[-1], width) * rows * columns, outputs)
        glorot(self)

    def forward(self, vectors: Tensor) -> Tensor:
        """Estimate labels ``(batch, outputs)`` of vectors ``(batch, channels, levels, columns)``.

        Raises:
            MitsonarError: vectors of another size.
        """
        self.expect(vectors)
        return self.regression(self.dropout(self.layers(vectors).flatten(1)))  # type: ignore[no-any-return]
