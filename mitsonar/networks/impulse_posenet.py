"""The PoseNets that read impulse responses side by side (Almanza-Medina, 5.3, fig. 5.5 and Table 5.1)."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from mitsonar.datasets.modality import Fields
from mitsonar.errors import MitsonarError, shortened
from mitsonar.networks.blocks import Network, SameAverage, Size, column_convolutions, glorot, scaled

__all__ = ["CHANNELS", "KERNELS", "LAYERS", "ImpulsePoseNet"]

KERNELS = (7, 5, 3, 3, 3, 3, 3, 3, 3)
"""Rows of the kernels, along the delay (Table 5.1)."""

CHANNELS = (32, 64, 128, 256, 512, 512, 512, 512, 512)

ACROSS = 4
"""Columns of a kernel."""

LAYERS = (6, 9)
"""Fewest and most convolutions of Table 5.2."""


class ImpulsePoseNet(Network):
    """A PoseNet for each receiver's block of columns, all joined in one fully connected layer to the estimates.

    Convolutions have stride 2 along the delay and 1 across. All but the last have batch normalisation and ReLU. A mean over
    4 x 4 cells follows. Dropout lies after the first ReLU and after the mean. A block keeps its 2 Q columns: "4 x 8" of
    Conv8 in Table 5.1 is a slip.

    Args:
        outputs: estimates.
        width: factor on the channels.
        dropout: rate in training.
        layers: convolutions, 6 to 9: those of Table 5.1 from the first on.
        receivers: M, blocks of columns.
        size: taps and columns of the input, 2 M Q.

    Raises:
        MitsonarError: a value out of its range, a number of columns that cannot be divided among the receivers.
    """

    needs: ClassVar[Fields] = {"kind": "response"}

    def __init__(
        self,
        *,
        outputs: int = 2,
        width: float = 1.0,
        dropout: float = 0.5,
        layers: int = 7,
        receivers: int = 4,
        size: Size = (800, 16),
    ) -> None:
        super().__init__(outputs=outputs, width=width, dropout=dropout, size=size)
        if not isinstance(layers, int) or not LAYERS[0] <= layers <= LAYERS[1]:
            raise MitsonarError(f"layers must be {LAYERS[0]} to {LAYERS[1]}, as in table 5.2: got {shortened(layers)}")
        if not isinstance(receivers, int) or receivers < 1 or size[1] % (2 * receivers):
            raise MitsonarError(
                f"size {list(size)} must have real and imaginary columns for each receiver: got receivers "
                f"{shortened(receivers)}; leave out receivers and size, which the data define"
            )
        self.options |= {"layers": layers, "receivers": receivers}
        self.nets = nn.ModuleList(_pose_net(layers, width, dropout) for _ in range(receivers))
        rows = size[0]
        for _ in range(layers):
            rows = -(-rows // 2)
        values = receivers * scaled(CHANNELS[layers - 1], width) * rows * (size[1] // receivers)
        self.regression = nn.Linear(values, outputs)
        glorot(self)

    def forward(self, matrix: Tensor) -> Tensor:
        """Estimate labels ``(batch, outputs)`` of packed matrices ``(batch, 1, taps, 2 M Q)``.

        Raises:
            MitsonarError: matrices of another size.
        """
        self.expect(matrix)
        blocks = matrix.chunk(len(self.nets), dim=-1)
        joined = torch.cat([net(block).flatten(1) for net, block in zip(self.nets, blocks, strict=True)], dim=1)
        return self.regression(joined)  # type: ignore[no-any-return]


def _pose_net(layers: int, width: float, dropout: float) -> nn.Sequential:
    """Build the convolutions of Table 5.1, the mean, and dropout, also after the first ReLU."""
    parts = column_convolutions(KERNELS[:layers], CHANNELS[:layers], ACROSS, width)
    parts.insert(3, nn.Dropout(dropout))
    return nn.Sequential(*parts, SameAverage(), nn.Dropout(dropout))
