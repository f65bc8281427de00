"""Building blocks of networks: layers that are padded and initialised as in MATLAB, and the common options.

"Ours" marks a choice that Almanza-Medina's text leaves open.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import ClassVar

from torch import Tensor, nn
from torch.nn import functional

from mitsonar.datasets.modality import Fields
from mitsonar.errors import MitsonarError, short_repr

__all__ = [
    "ConvolutionNetwork",
    "Network",
    "Quadrants",
    "RegressionNetwork",
    "SameAverage",
    "SameConv2d",
    "Size",
    "Table",
    "cells_after",
    "column_convolutions",
    "convolution",
    "convolutions",
    "fully_connected",
    "glorot",
    "scaled",
    "values_after",
]

Size = Sequence[int]
"""Rows and columns of an input."""

Table = Sequence[tuple[int, int, int]]
"""Kernel, channels and stride of each convolution."""


class Network(nn.Module):
    """Base class of networks, which stores the options so that a checkpoint can rebuild the network.

    Attributes:
        options: of the network, including defaults, as plain values.
        needs: required options of the arrangement of the input.
        any_sonar: whether the network works with sonars that it was not trained on.
        has_covariance: whether it returns a :class:`~mitsonar.networks.corrnet.GaussianHead` instead of labels.
    """

    needs: ClassVar[Fields] = {}
    any_sonar: ClassVar[bool] = False
    has_covariance: ClassVar[bool] = False

    def __init__(self, *, outputs: int, width: float, dropout: float, channels: int | None = None, **sizes: Size) -> None:
        """Check and store the common options.

        Raises:
            MitsonarError: a value is out of range.
        """
        super().__init__()
        counts = {"outputs": outputs} | ({} if channels is None else {"channels": channels})
        for name, count in counts.items():
            if not isinstance(count, int) or count < 1:
                raise MitsonarError(f"{name} must be a whole number of at least 1: got {short_repr(count)}")
        if not isinstance(width, int | float) or not 0 < width < math.inf:
            raise MitsonarError(f"width must be a number above 0 (1 for Almanza-Medina's channels): got {short_repr(width)}")
        if not isinstance(dropout, int | float) or not 0 <= dropout < 1:
            raise MitsonarError(f"dropout must be a rate from 0 to below 1: got {short_repr(dropout)}")
        self.options: Fields = {"width": width, "dropout": dropout, **counts}
        for name, size in sizes.items():
            if not _is_size(size):
                raise MitsonarError(
                    f"{name} must be the input's rows and columns, such as [512, 192]: got {short_repr(size)}"
                )
            self.options[name] = [int(length) for length in size]

    def expect(self, image: Tensor, name: str = "size") -> None:
        """Check that an input has the size of the network.

        Raises:
            MitsonarError: the number of channels, rows or columns differs.
        """
        expected = (self.options.get("channels", 1), *self.options[name])
        if image.dim() != 4 or tuple(image.shape[1:]) != expected:
            raise MitsonarError(
                f"this network reads (batch, {', '.join(map(str, expected))}): got {tuple(image.shape)}; arrange the frames "
                f"as in its training, or create it with {name}={list(image.shape[-2:])} and the same channels"
            )


def _is_size(size: object) -> bool:
    """Return whether the argument is a number of rows and a number of columns, each at least 1."""
    if not isinstance(size, Sequence) or len(size) != 2:
        return False
    return all(isinstance(length, int) for length in size) and min(size) >= 1


def scaled(channels: int, width: float) -> int:
    """Scale the number of channels of a layer by the width of its network; the result is at least 1."""
    return max(1, round(channels * width))


def cells_after(size: Size, strides: Iterable[int]) -> tuple[int, int]:
    """Compute rows and columns after layers with "same" padding; each stride divides them and rounds up."""
    rows, columns = size
    for stride in strides:
        rows, columns = -(-rows // stride), -(-columns // stride)
    return rows, columns


class SameConv2d(nn.Conv2d):
    """Convolution with the "same" padding of MATLAB.

    The output has ceil(input / stride) cells. Zeros are added on all sides; an odd one goes below or to the right.
    """

    def forward(self, input: Tensor) -> Tensor:
        """Convolve ``(batch, channels, rows, columns)``."""
        rows, columns = (
            _padding(length, kernel, stride)
            for length, kernel, stride in zip(input.shape[-2:], self.kernel_size, self.stride, strict=True)
        )
        if rows[0] == rows[1] and columns[0] == columns[1]:
            return functional.conv2d(input, self.weight, self.bias, self.stride, (rows[0], columns[0]))
        return functional.conv2d(functional.pad(input, (*columns, *rows)), self.weight, self.bias, self.stride)


def _padding(length: int, kernel: int, stride: int) -> tuple[int, int]:
    """Compute the numbers of zeros before and after the input along one axis."""
    total = max(0, (-(-length // stride) - 1) * stride + kernel - length)
    return total // 2, total - total // 2


class SameAverage(nn.Module):
    """Mean over 4 x 4 cells with stride 1 that preserves the size (Table 4.1).

    Along each axis a window covers one cell before, the cell, and two after. Cells outside the image do not count (ours), so
    a map of one cell does not change. By default MATLAB counts zeros there. They would divide the single cell that remains
    of 512 x 192 by 16, and slow down training of the last layer by as much.
    """

    def forward(self, image: Tensor) -> Tensor:
        """Average ``(batch, channels, rows, columns)``."""
        mean = functional.avg_pool2d(image, 4, stride=1, padding=2, count_include_pad=False)
        return mean[..., 1:, 1:]  # drop the first window, which has two cells before


def convolution(inputs: int, outputs: int, kernel: int, stride: int = 2) -> nn.Sequential:
    """Build a convolution without bias, which the batch normalisation would remove, then normalisation and ReLU."""
    return nn.Sequential(
        SameConv2d(inputs, outputs, kernel, stride, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def convolutions(table: Table, channels: int, width: float, *, bare_end: bool = True) -> OrderedDict[str, nn.Module]:
    """Build the layers ``conv1``, ``conv2`` ... of a table.

    Args:
        table: of the layers.
        channels: of the input.
        width: factor on the table's channels.
        bare_end: whether the last convolution has a bias instead of normalisation and ReLU.
    """
    layers: OrderedDict[str, nn.Module] = OrderedDict()
    for number, (kernel, full_channels, stride) in enumerate(table, start=1):
        bare = bare_end and number == len(table)
        kind = SameConv2d if bare else convolution
        layers[f"conv{number}"] = kind(channels, scaled(full_channels, width), kernel, stride)
        channels = scaled(full_channels, width)
    return layers


def column_convolutions(
    kernels: Sequence[int], table: Sequence[int], kernel_columns: int, width: float, channels: int = 1
) -> list[nn.Module]:
    """Build convolutions with stride 2 along rows and 1 across columns, which preserve the number of columns.

    Each is followed by normalisation and ReLU, except the last, which has a bias.

    Args:
        kernels: number of rows of each kernel.
        table: channels of each convolution.
        kernel_columns: number of columns of every kernel.
        width: factor on the table's channels.
        channels: of the input.
    """
    layers: list[nn.Module] = []
    for number, (kernel, full_channels) in enumerate(zip(kernels, table, strict=True), start=1):
        outputs, bare = scaled(full_channels, width), number == len(kernels)
        layers.append(SameConv2d(channels, outputs, (kernel, kernel_columns), (2, 1), bias=bare))
        layers += [] if bare else [nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]
        channels = outputs
    return layers


def values_after(table: Table, size: Size, width: float) -> int:
    """Compute the number of output values of the convolutions of a table, for an input of a given size."""
    rows, columns = cells_after(size, [stride for _, _, stride in table])
    return scaled(table[-1][1], width) * rows * columns


def fully_connected(sizes: Sequence[int]) -> nn.Sequential:
    """Build fully connected layers from sizes[0] values to sizes[-1], each followed by a ReLU."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class RegressionNetwork(Network):
    """Base of networks that end in a fully connected layer; a subclass builds the layers before it.

    Args:
        outputs: number of estimates.
        width: factor on the channels and on the sizes of fully connected layers.
        dropout: rate in training.
        size: rows and columns of the input; default: ``typical_size``.
        channels: of the input; with Almanza-Medina's 1 the frames are side by side.

    Raises:
        MitsonarError: a value is out of range.
    """

    typical_size: ClassVar[Size] = (512, 192)
    layers: nn.Sequential
    dropout: nn.Dropout

    def __init__(
        self,
        *,
        outputs: int = 3,
        width: float = 1.0,
        dropout: float = 0.5,
        size: Size | None = None,
        channels: int | None = 1,
    ) -> None:
        size = self.typical_size if size is None else size
        super().__init__(outputs=outputs, width=width, dropout=dropout, channels=channels, size=size)
        values = self.build(size, width, nn.Dropout(dropout), channels or 1)
        self.regression = nn.Linear(values, outputs)
        glorot(self)

    def build(self, size: Size, width: float, dropout: nn.Dropout, channels: int) -> int:
        """Add all layers but the last one, and return the number of values that it reads."""
        raise NotImplementedError

    def encode(self, image: Tensor) -> Tensor:
        """Compute the input ``(batch, values)`` of the last layer."""
        return self.dropout(self.layers(image).flatten(1))  # type: ignore[no-any-return]

    def forward(self, image: Tensor) -> Tensor:
        """Estimate labels ``(batch, outputs)`` from an input ``(batch, channels, rows, columns)`` with grey values in 0..1.

        Raises:
            MitsonarError: the input has another size.
        """
        self.expect(image)
        return self.regression(self.encode(image))  # type: ignore[no-any-return]


class ConvolutionNetwork(RegressionNetwork):
    """Network of convolutions, a mean over 4 x 4 cells, and a fully connected layer; a subclass sets the convolutions.

    Dropout is applied before the fully connected layer (ours; the text gives no position). See :class:`RegressionNetwork`
    for options and errors.
    """

    table: ClassVar[Table]

    def build(self, size: Size, width: float, dropout: nn.Dropout, channels: int) -> int:
        """Add the convolutions and the mean."""
        self.layers = nn.Sequential(convolutions(self.table, channels, width) | {"average": SameAverage()})
        self.dropout = dropout
        return values_after(self.table, size, width)


class Quadrants(nn.Module):
    """Division of two images side by side into four pairs of quadrants.

    The input is ``(batch, channels, rows, columns)``. Each pair is ``(batch, channels, rows / 2, columns / 2)``, with the
    quadrant of the left image to the left of that of the right image. Their order is upper left, upper right, lower left,
    lower right (Almanza-Medina, 3.3.3).
    """

    def forward(self, pair: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the four pairs of quadrants of two images side by side."""
        batch, channels, rows, columns = pair.shape
        cut = pair.reshape(batch, channels, 2, rows // 2, 2, 2, columns // 4)  # half of rows, row, image, half, column
        upper_left, upper_right, lower_left, lower_right = (
            cut[:, :, down, :, :, right].reshape(batch, channels, rows // 2, columns // 2)
            for down in (0, 1)
            for right in (0, 1)
        )
        return upper_left, upper_right, lower_left, lower_right

    @staticmethod
    def size(pair: Size) -> tuple[int, int]:
        """Compute rows and columns of a pair of quadrants.

        Raises:
            MitsonarError: the number of rows is odd, or the number of columns is not divisible by 4.
        """
        rows, columns = pair
        if rows % 2 or columns % 4:
            raise MitsonarError(
                f"two images side by side are cut into quadrants: rows must be even and columns divisible by 4, got {rows} "
                f"x {columns}; choose other bins or beams, or a network that does not cut"
            )
        return rows // 2, columns // 2


def glorot(network: nn.Module) -> None:
    """Initialise a network as MATLAB does: uniform weights after Glorot and Bengio (2010), biases 0."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
