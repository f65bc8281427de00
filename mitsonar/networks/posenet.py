"""PoseNet, the best network on images of Almanza-Medina (3.3.2 and Table 4.1), after GeoNet (Yin and Shi, 2018)."""

from __future__ import annotations

from typing import ClassVar

from mitsonar.networks.blocks import ConvolutionNetwork, Table

__all__ = ["LAYERS", "PoseNet"]

KERNELS = (7, 5, 3, 3, 3, 3, 3, 3, 3)
CHANNELS = (32, 64, 128, 256, 512, 512, 512, 1024, 1024)
LAYERS: Table = tuple((kernel, channels, 2) for kernel, channels in zip(KERNELS, CHANNELS, strict=True))
"""Table 4.1."""


class PoseNet(ConvolutionNetwork):
    """Nine convolutions of stride 2, a mean over 4 x 4 cells, and a fully connected layer to the estimates.

    It reads any size: two frames side by side (512 x 192), three (512 x 288), two sensors (512 x 384), wide frames side by
    side (512 x 1024) or stacked (1024 x 512). The text has 3 (Q - 1) outputs. Here three frames have 3, too, since their
    motion is constant. Options and errors: :class:`~mitsonar.networks.blocks.ConvolutionNetwork`.
    """

    table: ClassVar[Table] = LAYERS
