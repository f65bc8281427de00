"""Blocks of cells: whole groups of bins and beams, over which maps are summed."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["by_block", "cell_blocks", "on_cells", "products_by_block"]

Floats = NDArray[np.float32]


def cell_blocks(shape: tuple[int, ...], block: tuple[int, int]) -> tuple[int, int]:
    """Return the number of blocks along bins and beams; cells beyond the last whole block belong to it."""
    return max(shape[-2] // block[0], 1), max(shape[-1] // block[1], 1)


def by_block(maps: NDArray[np.floating], block: tuple[int, int]) -> NDArray[np.float64]:
    """Sum maps ``(..., bins, beams)`` over blocks ``(..., blocks)``."""
    means = [_means(one, block) for one in maps.reshape(-1, *maps.shape[-2:])]
    return _sums(means, cell_blocks(maps.shape, block), block).reshape(*maps.shape[:-2], -1)


def products_by_block(pairs: Sequence[tuple[Floats, Floats]], block: tuple[int, int]) -> NDArray[np.float64]:
    """Sum products of two maps ``(bins, beams)`` over blocks ``(pairs, blocks)``."""
    shape = pairs[0][0].shape
    product = np.empty(shape, dtype=np.float32)  # one for all: it stays in the processor's cache
    return _sums([_means(np.multiply(*pair, out=product), block) for pair in pairs], cell_blocks(shape, block), block)


def _means(values: NDArray[np.floating], block: tuple[int, int]) -> NDArray[np.floating]:
    """Average a map ``(bins, beams)`` over blocks; one that is not whole is filled with zeros ``(rows, columns)``."""
    over = [-(-size // edge) for size, edge in zip(values.shape, block, strict=True)]
    missing = [(0, count * edge - size) for count, edge, size in zip(over, block, values.shape, strict=True)]
    if any(after for _, after in missing):
        values = np.pad(values, missing)
    # OpenCV takes a third of the time of np.add.reduceat
    return np.asarray(cv2.resize(values, over[::-1], interpolation=cv2.INTER_AREA), dtype=values.dtype)


def _sums(means: list[NDArray[np.floating]], blocks: tuple[int, int], block: tuple[int, int]) -> NDArray[np.float64]:
    """Sum over blocks from their means ``(maps, blocks)``; cells beyond the last whole block belong to it."""
    sums = np.multiply(means, block[0] * block[1], dtype=np.float64)
    rows, columns = blocks
    if sums.shape[1:] != blocks:
        sums[:, rows - 1] += sums[:, rows:].sum(axis=1)
        sums[:, :, columns - 1] += sums[:, :, columns:].sum(axis=2)
    return np.asarray(sums[:, :rows, :columns].reshape(len(means), -1), dtype=np.float64)


def on_cells(table: NDArray[np.float64], shape: tuple[int, ...], block: tuple[int, int]) -> Floats:
    """Interpolate values of blocks ``(rows, columns)`` linearly to cells of this shape ``(bins, beams)``."""
    row, column = (
        ((np.arange(size) + 0.5) / edge - 0.5).astype(np.float32) for size, edge in zip(shape, block, strict=True)
    )
    column, row = (np.ascontiguousarray(axis) for axis in np.broadcast_arrays(column[None], row[:, None]))
    drawn = cv2.remap(table.astype(np.float32), column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(drawn, dtype=np.float32)
