"""The cells of a map: the box that holds them, and the running sums of their levels."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Box", "CellSums", "accumulate", "box_around", "with_slack"]

Floats = NDArray[np.float32]


class Box(NamedTuple):
    """A box of cells, counted from the world's origin: the first and one past the last, northwards and eastwards."""

    south: int
    north: int
    west: int
    east: int

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of rows and columns."""
        return self.north - self.south, self.east - self.west


class CellSums(NamedTuple):
    """Sums of each cell ``(rows, columns)``: mean, weighted squares about it, weight, squared weights, frames."""

    mean: Floats
    squares: Floats
    weight: Floats
    weight2: Floats
    seen: Floats


def accumulate(cells: CellSums, value: Floats, weight: Floats) -> None:
    """Update the weighted mean and the squares about it in place (West 1979): no cancellation in float32."""
    cells.weight[...] += weight
    before = value - cells.mean
    cells.mean[...] += before * (weight / np.maximum(cells.weight, np.float32(1e-30)))
    cells.squares[...] += weight * before * (value - cells.mean)
    cells.weight2[...] += weight * weight
    cells.seen[...] += weight > 0


def box_around(boxes: Iterable[Box]) -> Box:
    """Return the smallest box around boxes."""
    south, north, west, east = zip(*boxes, strict=True)
    return Box(min(south), max(north), min(west), max(east))


def with_slack(old: Box, new: Box, slack: float) -> Box:
    """Return the new box, enlarged on those sides where the old one had to grow."""
    if not math.prod(old.shape):
        return new
    rows, columns = (math.ceil(slack * size) for size in old.shape)
    return Box(
        new.south - rows * (new.south < old.south),
        new.north + rows * (new.north > old.north),
        new.west - columns * (new.west < old.west),
        new.east + columns * (new.east > old.east),
    )
