"""What the thesis's networks are made of: layers padded and initialised as MATLAB does, and the options that all take."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, ClassVar

from torch import Tensor, nn
from torch.nn import functional

from mitsonar.errors import MitsonarError

__all__ = [
    "ConvolutionNetwork",
    "Network",
    "Quadrants",
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
"""(rows, columns) of an input."""

Table = Sequence[tuple[int, int, int]]
"""Kernel, channels and stride of each convolution."""


class Network(nn.Module):
    """A network whose options can be written down, so that a checkpoint can make it again.

    Attributes:
        options: what the network was made with, defaults included; plain values.
        needs: words of the input's arrangement that it cannot do without.
        any_sonar: whether it serves sonars that it was not trained on.
        says_law: whether it returns a :class:`~mitsonar.networks.gaussian_head.GaussianHead` rather than labels.
    """

    needs: ClassVar[dict[str, Any]] = {}
    any_sonar: ClassVar[bool] = False
    has_covariance: ClassVar[bool] = False

    def __init__(self, *, outputs: int, width: float, dropout: float, channels: int | None = None, **sizes: Size) -> None:
        """Check and keep the options that networks share.

        Raises:
            MitsonarError: a value that no network can have.
        """
        super().__init__()
        counts = {"outputs": outputs} | ({} if channels is None else {"channels": channels})
        for name, count in counts.items():
            if not isinstance(count, int) or count < 1:
                raise MitsonarError(f"{name} must be a whole number of at least 1: got {count!r}")
        if not isinstance(width, int | float) or not 0 < width < math.inf:
            raise MitsonarError(f"width must be a number above 0 (1 for the thesis's channels): got {width!r}")
        if not isinstance(dropout, int | float) or not 0 <= dropout < 1:
            raise MitsonarError(f"dropout must be a rate from 0 to below 1: got {dropout!r}")
        self.options: dict[str, Any] = {"width": width, "dropout": dropout, **counts}
        for name, size in sizes.items():
            if not _is_size(size):
                raise MitsonarError(f"{name} must be the input's rows and columns, such as [512, 192]: got {size!r}")
            self.options[name] = [int(length) for length in size]

    def expect(self, image: Tensor, name: str = "size") -> None:
        """Refuse an input of another size than the network was made for.

        Raises:
            MitsonarError: another number of channels, rows or columns.
        """
        made_for = (self.options.get("channels", 1), *self.options[name])
        if image.dim() != 4 or tuple(image.shape[1:]) != made_for:
            raise MitsonarError(
                f"this network reads (batch, {', '.join(map(str, made_for))}): got {tuple(image.shape)}; arrange the frames "
                f"as in its training, or make it with {name}={list(image.shape[-2:])} and as many channels"
            )


def _is_size(size: Any) -> bool:
    whole = isinstance(size, Sequence) and len(size) == 2 and all(isinstance(length, int) for length in size)
    return whole and min(size) >= 1


def scaled(channels: int, width: float) -> int:
    """Channels of a layer in a network of that width; at least 1."""
    return max(1, round(channels * width))


def cells_after(size: Size, strides: Iterable[int]) -> tuple[int, int]:
    """Rows and columns after layers of those strides with "same" padding: each divides and rounds up."""
    rows, columns = size
    for stride in strides:
        rows, columns = -(-rows // stride), -(-columns // stride)
    return rows, columns


class SameConv2d(nn.Conv2d):
    """Convolution with MATLAB's "same" padding: ceil(input / stride) cells, zeros around, an odd one below and right."""

    def forward(self, input: Tensor) -> Tensor:
        rows, columns = (
            _padding(length, kernel, stride)
            for length, kernel, stride in zip(input.shape[-2:], self.kernel_size, self.stride, strict=True)
        )
        if rows[0] == rows[1] and columns[0] == columns[1]:
            return functional.conv2d(input, self.weight, self.bias, self.stride, (rows[0], columns[0]))
        return functional.conv2d(functional.pad(input, (*columns, *rows)), self.weight, self.bias, self.stride)


def _padding(length: int, kernel: int, stride: int) -> tuple[int, int]:
    """Zeros before and after."""
    total = max(0, (-(-length // stride) - 1) * stride + kernel - length)
    return total // 2, total - total // 2


class SameAverage(nn.Module):
    """Mean over 4 x 4 cells, stride 1, as many cells out as in (Table 4.1): one cell before, itself, two after.

    Cells outside the image do not count (ours): a map of one cell stays as it is. Zeros that count, as MATLAB's do unless
    told otherwise, would divide the one cell that 512 x 192 leaves by 16, and slow down the last layer's learning as much.
    """

    def forward(self, image: Tensor) -> Tensor:
        mean = functional.avg_pool2d(image, 4, stride=1, padding=2, count_include_pad=False)
        return mean[..., 1:, 1:]  # the first window has two cells before


def convolution(inputs: int, outputs: int, kernel: int, stride: int = 2) -> nn.Sequential:
    """Convolution, batch normalisation, ReLU; the convolution has no bias, which the normalisation would take away again."""
    return nn.Sequential(
        SameConv2d(inputs, outputs, kernel, stride, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def convolutions(table: Table, channels: int, width: float, *, bare_end: bool = True) -> OrderedDict[str, nn.Module]:
    """``conv1``, ``conv2`` ... of a table.

    Args:
        table: of the layers.
        channels: of the input.
        width: factor on the table's channels.
        bare_end: the last convolution has a bias in place of normalisation and ReLU.
    """
    layers: OrderedDict[str, nn.Module] = OrderedDict()
    for place, (kernel, full, stride) in enumerate(table, start=1):
        bare = bare_end and place == len(table)
        kind = SameConv2d if bare else convolution
        layers[f"conv{place}"] = kind(channels, scaled(full, width), kernel, stride)
        channels = scaled(full, width)
    return layers


def column_convolutions(
    kernels: Sequence[int], table: Sequence[int], across: int, width: float, channels: int = 1
) -> list[nn.Module]:
    """Convolutions of stride 2 along the rows and 1 across columns, which stay as many as they are; each with normalisation
    and ReLU but for the last, which has a bias.

    Args:
        kernels: rows of each.
        table: channels of each.
        across: columns of all.
        width: factor on the table's channels.
        channels: of the input.
    """
    layers: list[nn.Module] = []
    for place, (kernel, full) in enumerate(zip(kernels, table, strict=True), start=1):
        outputs, bare = scaled(full, width), place == len(kernels)
        layers.append(SameConv2d(channels, outputs, (kernel, across), (2, 1), bias=bare))
        layers += [] if bare else [nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]
        channels = outputs
    return layers


def values_after(table: Table, size: Size, width: float) -> int:
    """Values that the convolutions of a table leave of an input of that size."""
    rows, columns = cells_after(size, [stride for _, _, stride in table])
    return scaled(table[-1][1], width) * rows * columns


def fully_connected(sizes: Sequence[int]) -> nn.Sequential:
    """Fully connected layers from sizes[0] values to sizes[-1], each followed by a ReLU."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class ConvolutionNetwork(Network):
    """Convolutions, a mean over 4 x 4 cells, and a fully connected layer to the estimates.

    Dropout stands before the fully connected layer (where, the text does not say: ours).

    Args:
        outputs: estimates.
        width: factor on the channels.
        dropout: rate in training.
        size: rows and columns of the input.
        channels: of the input; the thesis's 1 has the frames side by side.

    Raises:
        MitsonarError: a value out of its range.
    """

    table: ClassVar[Table]

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
        layers = convolutions(self.table, channels, width)
        self.layers = nn.Sequential(layers | {"average": SameAverage()})
        self.dropout = nn.Dropout(dropout)
        self.regression = nn.Linear(values_after(self.table, size, width), outputs)
        glorot(self)

    def forward(self, image: Tensor) -> Tensor:
        """Labels ``(batch, outputs)`` of frames ``(batch, channels, rows, columns)``, grey values 0..1.

        Raises:
            MitsonarError: frames of another size.
        """
        self.expect(image)
        return self.regression(self.dropout(self.layers(image).flatten(1)))  # type: ignore[no-any-return]


class Quadrants(nn.Module):
    """Two images side by side cut into quadrants: ``(batch, channels, rows, columns)`` becomes four pairs of quadrants.

    Each is ``(batch, channels, rows / 2, columns / 2)``, the quadrant of the left image beside that of the right: upper
    left, upper right, lower left, lower right (3.3.3).
    """

    def forward(self, pair: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
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
        """Rows and columns of a pair of quadrants.

        Raises:
            MitsonarError: rows that cannot be halved, or columns that cannot be cut into four.
        """
        rows, columns = pair
        if rows % 2 or columns % 4:
            raise MitsonarError(
                f"two images side by side are cut into quadrants: rows must be even and columns divisible by 4, got {rows} "
                f"x {columns}; choose other bins or beams, or a network that does not cut"
            )
        return rows // 2, columns // 2


def glorot(network: nn.Module) -> None:
    """MATLAB's initialisation: weights uniform as Glorot and Bengio (2010), biases 0."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
