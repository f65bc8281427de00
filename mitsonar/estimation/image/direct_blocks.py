"""Blocks of cells: whole groups of bins and beams, over which maps are summed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["block_of", "by_block", "cell_blocks", "on_cells"]

Floats = NDArray[np.float32]


def cell_blocks(shape: tuple[int, ...], block: tuple[int, int]) -> tuple[int, int]:
    """Return the number of blocks along bins and beams; cells beyond the last whole block belong to it."""
    return max(shape[-2] // block[0], 1), max(shape[-1] // block[1], 1)


def block_of(size: int, block: int) -> NDArray[np.intp]:
    """Return the block of each cell along an axis; cells beyond the last whole block belong to it."""
    return np.minimum(np.arange(size) // block, max(size // block, 1) - 1)


def by_block(maps: NDArray[np.floating], block: tuple[int, int]) -> NDArray[np.float64]:
    """Sum maps ``(..., bins, beams)`` over blocks ``(..., blocks)``."""
    starts = [np.arange(0, count * edge, edge) for count, edge in zip(cell_blocks(maps.shape, block), block, strict=True)]
    sums = np.add.reduceat(np.add.reduceat(maps, starts[0], axis=-2), starts[1], axis=-1)
    return np.asarray(sums.reshape(*maps.shape[:-2], -1), dtype=np.float64)


def on_cells(table: NDArray[np.float64], shape: tuple[int, ...], block: tuple[int, int]) -> Floats:
    """Interpolate values of blocks ``(rows, columns)`` linearly to cells of this shape ``(bins, beams)``."""
    row, column = (
        ((np.arange(size) + 0.5) / edge - 0.5).astype(np.float32) for size, edge in zip(shape, block, strict=True)
    )
    column, row = (np.ascontiguousarray(axis) for axis in np.broadcast_arrays(column[None], row[:, None]))
    drawn = cv2.remap(table.astype(np.float32), column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(drawn, dtype=np.float32)
