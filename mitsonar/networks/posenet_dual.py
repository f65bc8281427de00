"""PoseNet on polar and Cartesian images together (Almanza-Medina, 3.4.7)."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from mitsonar.datasets.modality import Fields
from mitsonar.networks.blocks import Network, SameAverage, Size, convolutions, fully_connected, glorot, scaled, values_after
from mitsonar.networks.posenet import LAYERS

__all__ = ["PoseNetDual"]

VALUES = 1024
"""Values of the fully connected layer that reads both branches (ours: as many as a branch has)."""


class PoseNetDual(Network):
    """Two PoseNets whose averages are joined by a fully connected layer with a ReLU (ours) before the estimates.

    Dropout lies before that layer (ours).

    Args:
        outputs: estimates.
        width: factor on the channels and on the fully connected layer.
        dropout: rate in training.
        size: rows and columns of the polar input.
        cartesian_size: rows and columns of the Cartesian input.
        channels: of each input; with Almanza-Medina's 1 the frames are side by side.

    Raises:
        MitsonarError: a value out of its range.
    """

    needs: ClassVar[Fields] = {"coordinates": "both"}

    def __init__(
        self,
        *,
        outputs: int = 3,
        width: float = 1.0,
        dropout: float = 0.5,
        size: Size = (512, 192),
        cartesian_size: Size = (512, 512),
        channels: int = 1,
    ) -> None:
        sizes = {"size": size, "cartesian_size": cartesian_size}
        super().__init__(outputs=outputs, width=width, dropout=dropout, channels=channels, **sizes)
        self.polar = nn.Sequential(convolutions(LAYERS, channels, width) | {"average": SameAverage()})
        self.cartesian = nn.Sequential(convolutions(LAYERS, channels, width) | {"average": SameAverage()})
        values = sum(values_after(LAYERS, each, width) for each in sizes.values())
        self.dropout = nn.Dropout(dropout)
        self.layers = fully_connected([values, scaled(VALUES, width)])
        self.regression = nn.Linear(scaled(VALUES, width), outputs)
        glorot(self)

    def forward(self, polar: Tensor, cartesian: Tensor) -> Tensor:
        """Estimate labels ``(batch, outputs)`` of the same frames as polar and as Cartesian images, grey values 0..1.

        Args:
            polar: ``(batch, channels, rows, columns)`` of ``size``.
            cartesian: ``(batch, channels, rows, columns)`` of ``cartesian_size``.

        Raises:
            MitsonarError: frames of another size.
        """
        self.expect(polar)
        self.expect(cartesian, "cartesian_size")
        features = torch.cat((self.polar(polar).flatten(1), self.cartesian(cartesian).flatten(1)), dim=1)
        return self.regression(self.layers(self.dropout(features)))  # type: ignore[no-any-return]
