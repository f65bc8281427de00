"""Estimate heights from the lengths of shadows, as an operator does with a ruler."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mitsonar.mapping.relief import ReliefView

__all__ = ["joined_shadow_heights", "shadow_heights"]

Array = NDArray[np.float64]

DARK = 0.15
"""Level below which a block is in shadow, relative to level ground."""


def joined_shadow_heights(views: Sequence[ReliefView], levels: Sequence[Array], reflectivity: float) -> Array:
    """Estimate heights from the shadows of several frames: the mean of those that place an object in a cell.

    Args:
        views: views of the frames, on one grid.
        levels: their levels in blocks.
        reflectivity: reflectivity of the ground.

    Returns:
        Heights ``(cells, cells)`` [m], with the southernmost row first; level ground where no frame places an object.
    """
    ground = views[0].grid.ground_m
    above = np.array([shadow_heights(view, y, reflectivity) - ground for view, y in zip(views, levels, strict=True)])
    return np.asarray(ground + above.sum(axis=0) / np.maximum((above > 0).sum(axis=0), 1))


def shadow_heights(view: ReliefView, levels: Array, reflectivity: float) -> Array:
    """Estimate heights from the lengths of shadows: an object whose shadow spans the ranges a to b is H (1 - a / b) high.

    The object is placed before its shadow, as deep as it is high; all other ground is level.

    Args:
        view: view of the frame.
        levels: its levels in blocks.
        reflectivity: reflectivity of the ground.

    Returns:
        Heights ``(cells, cells)`` [m], with the southernmost row first.
    """
    grid = view.grid
    above = float(view.position[2] - grid.ground_m)
    # 1. Blocks that are dark in comparison with level ground, without single ones.
    flat = view.levels(np.full((grid.cells, grid.cells), grid.ground_m)) * reflectivity
    smooth = ndimage.uniform_filter(levels - view.noise, 3)
    dark = (smooth < DARK * flat) & view.used
    dark = ndimage.median_filter(dark.astype(np.uint8), 3) > 0
    # 2. Column of blocks and horizontal distance of each cell.
    x, y = grid.centres
    _, column = view.blocks_of(np.stack([x, y, np.full_like(x, grid.ground_m)], axis=-1))
    distance = np.hypot(x - view.position[0], y - view.position[1])
    heights = np.zeros_like(x)
    # 3. Each run of dark blocks along a beam is the shadow of an object.
    edges = view.range_m[0] + (np.arange(view.shape[0] + 1) - 0.5) * view.block_m
    for beam in range(view.shape[1]):
        change = np.diff(np.r_[0, dark[:, beam].astype(int), 0])
        for begin, end in zip(np.flatnonzero(change > 0), np.flatnonzero(change < 0), strict=True):
            first, last = edges[max(begin - 1, 0)], edges[min(end + 1, view.shape[0])]  # smoothing has shortened the run
            height = above * (1 - first / last)
            top = math.sqrt(max(first**2 - (above - height) ** 2, 0.0))
            before = (column == beam) & (distance <= top) & (distance > top - max(height, grid.cell_m))
            heights[before] = np.maximum(heights[before], height)
    return heights + grid.ground_m
