"""SfMNet: the part of SfM-Net that estimates the camera's motion (Almanza-Medina, 3.3.1; Vijayanarasimhan et al., 2017)."""

from __future__ import annotations

from typing import ClassVar

from mitsonar.networks.blocks import ConvolutionNetwork, Table

__all__ = ["LAYERS", "SfMNet"]

KERNELS = (7, 5, 3, 3, 3, 3, 3, 3, 3, 3)
CHANNELS = (32, 64, 128, 128, 256, 256, 512, 512, 1024, 1024)
STRIDES = (4, 3, 3, 2, 1, 2, 1, 2, 1, 2)
LAYERS: Table = tuple(zip(KERNELS, CHANNELS, STRIDES, strict=True))
"""The channels are those of SfM-Net without its second layer of 64: 32, then twice 64 to 1024, as in the text."""


class SfMNet(ConvolutionNetwork):
    """Ten convolutions, a mean over 4 x 4 cells, and a fully connected layer to the estimates.

    The text gives neither padding nor the extent of the average: they are PoseNet's (ours).
    Options and errors: :class:`~mitsonar.networks.blocks.ConvolutionNetwork`.
    """

    table: ClassVar[Table] = LAYERS
