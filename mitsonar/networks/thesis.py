"""The networks of Almanza-Medina's thesis: for images, for vectors and for impulse responses.

"The text" is the thesis. "Ours" marks a choice that it leaves open.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from mitsonar.datasets.modality import Fields
from mitsonar.errors import MitsonarError, short_repr
from mitsonar.networks.blocks import (
    ConvolutionNetwork,
    Network,
    Quadrants,
    RegressionNetwork,
    SameAverage,
    SameConv2d,
    Size,
    Table,
    cells_after,
    column_convolutions,
    convolutions,
    fully_connected,
    glorot,
    scaled,
    values_after,
)

__all__ = [
    "IMPULSE_CHANNELS",
    "IMPULSE_LAYERS",
    "POSENET_LAYERS",
    "SFMNET_LAYERS",
    "SIZES",
    "Cnn1b",
    "Cnn4PoseNet",
    "Cnn4b",
    "CoarseFeatures",
    "ImpulsePoseNet",
    "PoseNet",
    "PoseNetDual",
    "PoseNetVec",
    "QuadPoseNet",
    "QuadrantNetwork",
    "SfMNet",
]


POSENET_KERNELS = (7, 5, 3, 3, 3, 3, 3, 3, 3)
"""Rows of the kernels of all PoseNets (Tables 4.1, 4.2 and 5.1)."""

POSENET_CHANNELS = (32, 64, 128, 256, 512, 512, 512, 1024, 1024)
POSENET_LAYERS: Table = tuple(
    (kernel, channels, 2) for kernel, channels in zip(POSENET_KERNELS, POSENET_CHANNELS, strict=True)
)
"""Kernel, channels and stride of each convolution (Table 4.1)."""


class PoseNet(ConvolutionNetwork):
    """PoseNet: nine convolutions of stride 2, a mean over 4 x 4 cells, and a fully connected layer.

    It is Almanza-Medina's best network on images (3.3.2 and Table 4.1), after GeoNet (Yin and Shi, 2018). It accepts any
    size: two frames side by side (512 x 192), three (512 x 288), two sensors (512 x 384), wide frames side by side (512 x
    1024) or stacked (1024 x 512). The text has 3 (Q - 1) outputs. Here three frames also have 3, because their motion is
    constant. See :class:`~mitsonar.networks.blocks.RegressionNetwork` for options and errors.
    """

    table: ClassVar[Table] = POSENET_LAYERS


# ---------------- PoseNet for polar and Cartesian images


DUAL_VALUES = 1024
"""Number of values of the fully connected layer that joins both branches (ours: the number of each branch)."""


class PoseNetDual(Network):
    """Two PoseNets, on polar and on Cartesian images of the same frames (Almanza-Medina, 3.4.7).

    A fully connected layer with a ReLU (ours) joins the averages of both before the estimates. Dropout is applied before
    that layer (ours).

    Args:
        outputs: number of estimates.
        width: factor on the channels and on the fully connected layer.
        dropout: rate in training.
        size: rows and columns of the polar input.
        cartesian_size: rows and columns of the Cartesian input.
        channels: of each input; with Almanza-Medina's 1 the frames are side by side.

    Raises:
        MitsonarError: a value is out of range.
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
        self.polar = nn.Sequential(convolutions(POSENET_LAYERS, channels, width) | {"average": SameAverage()})
        self.cartesian = nn.Sequential(convolutions(POSENET_LAYERS, channels, width) | {"average": SameAverage()})
        values = sum(values_after(POSENET_LAYERS, each, width) for each in sizes.values())
        self.dropout = nn.Dropout(dropout)
        self.layers = fully_connected([values, scaled(DUAL_VALUES, width)])
        self.regression = nn.Linear(scaled(DUAL_VALUES, width), outputs)
        glorot(self)

    def forward(self, polar: Tensor, cartesian: Tensor) -> Tensor:
        """Estimate labels ``(batch, outputs)`` from the same frames as polar and as Cartesian images.

        Args:
            polar: grey values in 0..1 ``(batch, channels, rows, columns)`` of ``size``.
            cartesian: grey values in 0..1 ``(batch, channels, rows, columns)`` of ``cartesian_size``.

        Raises:
            MitsonarError: the frames have another size.
        """
        self.expect(polar)
        self.expect(cartesian, "cartesian_size")
        features = torch.cat((self.polar(polar).flatten(1), self.cartesian(cartesian).flatten(1)), dim=1)
        return self.regression(self.layers(self.dropout(features)))  # type: ignore[no-any-return]


# ---------------- PoseNet for vectors


POSENETVEC_COLUMNS = 2
"""Columns of each kernel."""


class PoseNetVec(RegressionNetwork):
    """PoseNet for vectors, which preserves the number of columns (Almanza-Medina, 4.3.1 and Table 4.2).

    Nine convolutions of stride 2 along range and 1 across columns are followed by a mean over 4 x 4 cells and a fully
    connected layer. The input is vectors side by side, two of each portion of the field of view: 512 x 2 for the whole,
    512 x 8 for four quadrants. From one vector the network estimates the height (Table 4.4). Dropout is applied before the
    fully connected layer (ours, as in PoseNet; the text gives no position). See
    :class:`~mitsonar.networks.blocks.RegressionNetwork` for options and errors.
    """

    needs: ClassVar[Fields] = {"kind": "vector"}
    typical_size: ClassVar[Size] = (512, 8)

    def build(self, size: Size, width: float, dropout: nn.Dropout, channels: int) -> int:
        """Add the convolutions and the mean."""
        layers = column_convolutions(POSENET_KERNELS, POSENET_CHANNELS, POSENETVEC_COLUMNS, width, channels)
        self.layers = nn.Sequential(*layers, SameAverage())
        self.dropout = dropout
        rows, _ = cells_after(size, [2] * len(POSENET_KERNELS))
        return scaled(POSENET_CHANNELS[-1], width) * rows * size[1]


# ---------------- SfMNet


SFMNET_KERNELS = (7, 5, 3, 3, 3, 3, 3, 3, 3, 3)
SFMNET_CHANNELS = (32, 64, 128, 128, 256, 256, 512, 512, 1024, 1024)
SFMNET_STRIDES = (4, 3, 3, 2, 1, 2, 1, 2, 1, 2)
SFMNET_LAYERS: Table = tuple(zip(SFMNET_KERNELS, SFMNET_CHANNELS, SFMNET_STRIDES, strict=True))
"""Kernel, channels and stride of each convolution.

The channels are those of SfM-Net without its second layer of 64: 32, then twice 64 to 1024, as in the text.
"""


class SfMNet(ConvolutionNetwork):
    """SfMNet: ten convolutions, a mean over 4 x 4 cells, and a fully connected layer.

    It is the part of SfM-Net that estimates the motion of the camera (Almanza-Medina, 3.3.1; Vijayanarasimhan et al., 2017).
    The text gives neither the padding nor the extent of the average, which are those of PoseNet (ours). See
    :class:`~mitsonar.networks.blocks.RegressionNetwork` for options and errors.
    """

    table: ClassVar[Table] = SFMNET_LAYERS


# ---------------- CNN-1b


CNN1B_CHANNELS = (64, 20)
"""Channels of the two convolutions (ours, after Costante et al.; the text gives only their kernels)."""

SIZES = (2400, 1200, 600, 300)
"""Number of values of each fully connected layer. The text gives them for CNN-4b, and four layers for both networks."""


class CoarseFeatures(nn.Module):
    """Features of CNN-1b and of each quarter of CNN-4b: a coarse image after one convolution, and after two.

    The layers are ``coarse``, a mean over cells; ``conv1``, 9 x 9; ``pool1``, the maximum over 4 x 4; ``conv2``, 2 x 2; and
    ``pool2``, 2 x 2. The text leaves the following open, which is ours. The convolutions have ReLU, "same" padding and
    stride 1. Pools do not overlap, and cells that do not fill one are omitted, as in MATLAB. The text's layer that joins the
    outputs of both pools has no weights.

    Args:
        cells: number of rows and of columns in each mean.
        size: rows and columns of the input.
        width: factor on the channels.
        channels: of the input.
    """

    def __init__(self, *, cells: int, size: Size, width: float, channels: int = 1) -> None:
        super().__init__()
        first, second = (scaled(full, width) for full in CNN1B_CHANNELS)
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
        """Compute the features ``(batch, values)`` of images ``(batch, channels, rows, columns)``."""
        fine = self.pool1(self.conv1(self.coarse(image)))
        return torch.cat((fine.flatten(1), self.pool2(self.conv2(fine)).flatten(1)), dim=1)


class Cnn1b(RegressionNetwork):
    """CNN-1b: means over 8 x 8 cells, two convolutions, and four fully connected layers.

    The network is from Almanza-Medina (3.3.3), after Costante et al. (2016). Dropout is applied before the fully connected
    layers (ours; the text gives a rate, but no position). Images have at least 64 rows and columns. See
    :class:`~mitsonar.networks.blocks.RegressionNetwork` for options and errors.
    """

    def build(self, size: Size, width: float, dropout: nn.Dropout, channels: int) -> int:
        """Add the convolutions and the fully connected layers."""
        self.features = CoarseFeatures(cells=8, size=size, width=width, channels=channels)
        self.dropout = dropout
        self.layers = fully_connected([self.features.values, *(scaled(full, width) for full in SIZES)])
        return scaled(SIZES[-1], width)

    def encode(self, image: Tensor) -> Tensor:
        """Compute the input ``(batch, values)`` of the last layer."""
        return self.layers(self.dropout(self.features(image)))  # type: ignore[no-any-return]


# ---------------- CNN-4b


class QuadrantNetwork(RegressionNetwork):
    """Base of networks that read each pair of quadrants of two images side by side by layers that share no weights (ours).

    Args:
        outputs: number of estimates.
        width: factor on the channels and on the sizes of the fully connected layers.
        dropout: rate in training.
        size: rows and columns of the input, two images side by side; rows even, columns divisible by 4.

    Raises:
        MitsonarError: a value is out of range, or the images cannot be cut into quadrants.
    """

    def __init__(self, *, outputs: int = 3, width: float = 1.0, dropout: float = 0.5, size: Size | None = None) -> None:
        super().__init__(outputs=outputs, width=width, dropout=dropout, size=size, channels=None)

    def quadrant(self, size: Size, width: float) -> CoarseFeatures | QuadPoseNet:
        """Build the layers of one pair of quadrants of that size."""
        raise NotImplementedError

    def build(self, size: Size, width: float, dropout: nn.Dropout, channels: int) -> int:
        """Add the layers of all quadrants."""
        quarters = [self.quadrant(Quadrants.size(size), width) for _ in range(4)]
        self.split = Quadrants()
        self.quarters = nn.ModuleList(quarters)
        self.dropout = dropout
        return sum(quarter.values for quarter in quarters)

    def encode(self, image: Tensor) -> Tensor:
        """Compute the features ``(batch, values)`` of all quadrants."""
        features = [quarter(part) for quarter, part in zip(self.quarters, self.split(image), strict=True)]
        return self.dropout(torch.cat(features, dim=1))  # type: ignore[no-any-return]


class Cnn4b(QuadrantNetwork):
    """CNN-4b: the convolutions of CNN-1b on each pair of quadrants of two images, and four fully connected layers.

    The network is from Almanza-Medina (3.3.3), after Costante et al. (2016). The convolutions read means over 4 x 4 cells.
    Images have at least 64 rows and columns. Dropout is applied before the fully connected layers (ours).
    """

    def quadrant(self, size: Size, width: float) -> CoarseFeatures:
        """Build the convolutions of one pair of quadrants."""
        return CoarseFeatures(cells=4, size=size, width=width)

    def build(self, size: Size, width: float, dropout: nn.Dropout, channels: int) -> int:
        """Add the convolutions of all quadrants and the fully connected layers."""
        values = super().build(size, width, dropout, channels)
        self.layers = fully_connected([values, *(scaled(full, width) for full in SIZES)])
        return scaled(SIZES[-1], width)

    def encode(self, image: Tensor) -> Tensor:
        """Compute the input ``(batch, values)`` of the last layer."""
        return self.layers(super().encode(image))  # type: ignore[no-any-return]


# ---------------- CNN-4PoseNet


CNN4POSENET_LAYERS = POSENET_LAYERS[:8]
"""Convolutions of a QuadPoseNet. The text gives their number and kernels; channels and strides are PoseNet's (ours)."""

CNN4POSENET_VALUES = 1024
"""Number of values of each of the two fully connected layers of a QuadPoseNet."""


class QuadPoseNet(nn.Module):
    """Features of a pair of quadrants: eight convolutions, with fully connected layers on the first and on the last.

    The layer on the first convolution gives fine features, that on the last one coarse features. The windows of the 5 x 5
    average after the first convolution do not overlap (ours: MATLAB's stride of 1 would need 200 million weights after it).
    Cells that do not fill a window are omitted. The fully connected layers have a ReLU (ours). We interpret the text's
    layers of 2 x 1024 and 8 x 1024 values as these outputs side by side, without weights.

    Args:
        size: rows and columns of the input.
        width: factor on the channels and on the fully connected layers.
    """

    def __init__(self, *, size: Size, width: float) -> None:
        super().__init__()
        layers = convolutions(CNN4POSENET_LAYERS, 1, width, bare_end=False)
        self.first = layers.pop("conv1")
        self.others = nn.Sequential(layers | {"average": SameAverage()})
        self.early = nn.AvgPool2d(5)
        rows, columns = (length // 5 for length in cells_after(size, [2]))
        if min(rows, columns) < 1:
            raise MitsonarError(f"quadrants side by side must have at least 9 x 9 cells: got {size[0]} x {size[1]}")
        values = scaled(CNN4POSENET_VALUES, width)
        self.from_last = fully_connected([values_after(CNN4POSENET_LAYERS, size, width), values])
        self.from_first = fully_connected([scaled(CNN4POSENET_LAYERS[0][1], width) * rows * columns, values])
        self.values = 2 * values

    def forward(self, image: Tensor) -> Tensor:
        """Compute the features ``(batch, values)`` of images ``(batch, 1, rows, columns)``."""
        first = self.first(image)
        last = self.from_last(self.others(first).flatten(1))
        return torch.cat((last, self.from_first(self.early(first).flatten(1))), dim=1)


class Cnn4PoseNet(QuadrantNetwork):
    """CNN-4PoseNet: a QuadPoseNet on each pair of quadrants of two images, and a fully connected layer on all of them.

    The network is from Almanza-Medina (3.3.4). Dropout is applied before the last layer (ours).
    """

    def quadrant(self, size: Size, width: float) -> QuadPoseNet:
        """Build the layers of one pair of quadrants."""
        return QuadPoseNet(size=size, width=width)


# ---------------- PoseNet for impulse responses


IMPULSE_CHANNELS = (32, 64, 128, 256, 512, 512, 512, 512, 512)

IMPULSE_COLUMNS = 4
"""Columns of each kernel."""

IMPULSE_LAYERS = (6, 9)
"""Smallest and largest number of convolutions in Table 5.2."""


class ImpulsePoseNet(Network):
    """PoseNet for impulse responses: one PoseNet per receiver, joined by a fully connected layer.

    The network is from Almanza-Medina (5.3, fig. 5.5 and Table 5.1). Convolutions have stride 2 along delay and 1 across
    columns. All but the last have batch normalisation and ReLU. A mean over 4 x 4 cells follows. Dropout is applied after
    the first ReLU and after the mean. Each receiver has a block of 2 Q columns, whose number does not change: "4 x 8" for
    Conv8 in Table 5.1 is a slip.

    Args:
        outputs: number of estimates.
        width: factor on the channels.
        dropout: rate in training.
        layers: number of convolutions, 6 to 9: the first ones of Table 5.1.
        receivers: M, the number of blocks of columns.
        size: taps and columns of the input, 2 M Q.

    Raises:
        MitsonarError: a value is out of range, or the columns cannot be divided among the receivers.
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
        if not isinstance(layers, int) or not IMPULSE_LAYERS[0] <= layers <= IMPULSE_LAYERS[1]:
            raise MitsonarError(
                f"layers must be {IMPULSE_LAYERS[0]} to {IMPULSE_LAYERS[1]}, as in table 5.2: got {short_repr(layers)}"
            )
        if not isinstance(receivers, int) or receivers < 1 or size[1] % (2 * receivers):
            raise MitsonarError(
                f"size {list(size)} must have real and imaginary columns for each receiver: got receivers "
                f"{short_repr(receivers)}; leave out receivers and size, which the data define"
            )
        self.options |= {"layers": layers, "receivers": receivers}
        self.nets = nn.ModuleList(_pose_net(layers, width, dropout) for _ in range(receivers))
        rows, _ = cells_after(size, [2] * layers)
        values = receivers * scaled(IMPULSE_CHANNELS[layers - 1], width) * rows * (size[1] // receivers)
        self.regression = nn.Linear(values, outputs)
        glorot(self)

    def forward(self, matrix: Tensor) -> Tensor:
        """Estimate labels ``(batch, outputs)`` from packed matrices ``(batch, 1, taps, 2 M Q)``.

        Raises:
            MitsonarError: the matrices have another size.
        """
        self.expect(matrix)
        blocks = matrix.chunk(len(self.nets), dim=-1)
        joined = torch.cat([net(block).flatten(1) for net, block in zip(self.nets, blocks, strict=True)], dim=1)
        return self.regression(joined)  # type: ignore[no-any-return]


def _pose_net(layers: int, width: float, dropout: float) -> nn.Sequential:
    """Build the convolutions of Table 5.1 and the mean, with dropout after the first ReLU and after the mean."""
    parts = column_convolutions(POSENET_KERNELS[:layers], IMPULSE_CHANNELS[:layers], IMPULSE_COLUMNS, width)
    parts.insert(3, nn.Dropout(dropout))
    return nn.Sequential(*parts, SameAverage(), nn.Dropout(dropout))
