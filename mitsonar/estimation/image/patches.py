"""How patches of sonar images are chosen and aligned with other frames (Lucas and Kanade, 1981).

Patches are chosen where they can be found again. Shadows move over the ground when the sonar moves, so pixels in shadow and
at its edge have no weight.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.image.registration import blurred, central_differences

__all__ = ["COLUMNS", "ROWS", "Alignment", "PatchImage", "Patches", "align", "corners", "cut", "patch_image"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Index = NDArray[np.intp]

REACH = (8, 3)
"""Bins and beams of a patch to each side of its centre."""

SMOOTHING = (1.0, 0.6)
"""Standard deviations by which frames are smoothed [bins, beams]."""

SMOOTHING_CODED = (0.6, 0.4)
"""The same for frames with coded levels, which show speckle: it holds more of the motion than coarse content, whose shadows
move over the ground. With :data:`SMOOTHING`, paths ahead over rocks became 2 to 3 % too long."""

CELL = (26, 8)
"""Bins and beams of a grid cell in which one patch is chosen."""

SHADOW = 0.3
SHADOW_SURROUNDINGS = (25, 61)
"""Level of a shadow, as a fraction of the mean level, and the surroundings [beams, bins] over which that mean is taken."""

SHADOW_MARGIN = (3, 7)
"""Beams and bins of the neighbourhood of a shadow that is left out."""

LEAST_LIT = 0.5
"""Smallest fraction of a patch's weight outside shadows."""

BINS_PER_BEAM = 2.0
"""Number of bins that a beam counts as when slopes are compared to choose patches."""

FAINTEST = 1e-6
"""Smallest sum of squared slopes of a patch."""

ROUNDS = 8
LONGEST = np.array([2.0, 0.7])
STILL = np.array([0.004, 0.002])
"""Gauss-Newton iterations, the longest step of one, and the step below which a patch is finished [bins, beams]."""

CORRELATED = 3.0
"""Number of neighbouring pixels with correlated errors."""

FLOOR = np.array([0.05, 0.04])
"""Lower limit of an alignment's standard deviations at any contrast [bins, beams]: interpolation between cells."""

ROWS, COLUMNS = np.mgrid[-REACH[0] : REACH[0] + 1, -REACH[1] : REACH[1] + 1].reshape(2, -1).astype(float)
"""Offsets of a patch's pixels from its centre ``(pixels,)`` [bins, beams]."""

_TAPER = np.exp(-0.5 * ((ROWS / (0.7 * REACH[0])) ** 2 + (COLUMNS / (0.7 * REACH[1])) ** 2)).astype(np.float32)


class PatchImage(NamedTuple):
    """A smoothed frame, its slopes over bins and beams, and 1 where no shadow is near, each ``(bins, beams)``."""

    level: Floats
    by_bin: Floats
    by_beam: Floats
    lit: Floats


class Patches(NamedTuple):
    """Patches ``(n, pixels)``: values of weighted mean 0 and variance 1, and weights of sum 1."""

    values: Floats
    weights: Floats

    def take(self, index: Index | NDArray[np.bool_]) -> Patches:
        """Return a subset of the patches."""
        return Patches(self.values[index], self.weights[index])


class Alignment(NamedTuple):
    """Result of an alignment of patches.

    Attributes:
        shift: offset from the expected places ``(n, 2)`` [bins, beams].
        covariance: of the shift ``(n, 2, 2)``.
        correlation: of patch and frame at the shifted place ``(n,)``.
    """

    shift: Array
    covariance: Array
    correlation: Array


def patch_image(image: Floats, coded: bool = False) -> PatchImage:
    """Prepare a frame ``(bins, beams)`` for :func:`corners`, :func:`cut` and :func:`align`.

    Args:
        image: values for matching, of :meth:`mitsonar.records.frames.SonarFrames.matching_values`.
        coded: whether the levels of the frame are coded, as those of speckle are.
    """
    level = blurred(image, *(SMOOTHING_CODED if coded else SMOOTHING))
    shadow = (level < SHADOW * cv2.blur(level, SHADOW_SURROUNDINGS)).astype(np.uint8)
    lit = 1 - cv2.dilate(shadow, np.ones(SHADOW_MARGIN[::-1], np.uint8)).astype(np.float32)
    return PatchImage(level, *central_differences(level), np.asarray(lit, dtype=np.float32))


def corners(image: PatchImage, taken: NDArray[np.bool_]) -> tuple[Index, Index]:
    """Choose the best patch of each cell of a grid (Shi and Tomasi, 1994).

    Args:
        image: a frame.
        taken: cells of the image ``(bins, beams)`` that already have a patch.

    Returns:
        Row and column of the patches' centres, each ``(n,)``.
    """
    # smaller eigenvalue of the structure tensor: large where a patch is distinct in both directions
    by_bin, by_beam = image.by_bin * image.lit, image.by_beam * (image.lit / np.float32(BINS_PER_BEAM))
    size = (0.7 * REACH[0], 0.7 * REACH[1])
    by_bin_squared, mixed, by_beam_squared = (
        blurred(product, *size) for product in (by_bin**2, by_bin * by_beam, by_beam**2)
    )
    eigenvalue = (by_bin_squared + by_beam_squared) / 2 - np.sqrt(((by_bin_squared - by_beam_squared) / 2) ** 2 + mixed**2)
    # leave out patches that would reach beyond the image
    rows, columns = (int(length) // cell * cell for length, cell in zip(eigenvalue.shape, CELL, strict=True))
    margin = [reach + 2 for reach in REACH]
    inside = np.zeros_like(eigenvalue)
    inside[margin[0] : -margin[0], margin[1] : -margin[1]] = eigenvalue[margin[0] : -margin[0], margin[1] : -margin[1]]
    # best pixel of each grid cell, unless the cell is too faint or already has a patch
    tiles, full = (_tiles(table[:rows, :columns]) for table in (inside, taken))
    best = tiles.argmax(axis=1)
    chosen = (tiles[np.arange(len(tiles)), best] > FAINTEST) & ~full.any(axis=1)
    tile, place = np.flatnonzero(chosen), best[chosen]
    tiles_per_row = columns // CELL[1]
    return tile // tiles_per_row * CELL[0] + place // CELL[1], tile % tiles_per_row * CELL[1] + place % CELL[1]


def cut(image: PatchImage, row: Array, column: Array, weights: Floats | None = None) -> tuple[Patches, NDArray[np.bool_]]:
    """Cut patches out of a frame.

    Args:
        image: the frame.
        row: row of each pixel ``(n, pixels)``.
        column: column of each pixel ``(n, pixels)``.
        weights: of patches that are renewed ``(n, pixels)``; None: from the shadows of this frame.

    Returns:
        The patches, and which of them lie within the frame and are lit enough ``(n,)``.
    """
    bins, beams = image.level.shape
    inside = (row.min(axis=1) > 1) & (row.max(axis=1) < bins - 2)
    inside &= (column.min(axis=1) >= 0) & (column.max(axis=1) <= beams - 1)
    if weights is None:
        weights = _TAPER * _sampled(image.lit, row, column)
        inside &= weights.sum(axis=1) > LEAST_LIT * _TAPER.sum()
        weights = weights / np.maximum(weights.sum(axis=1, keepdims=True), np.float32(1e-6))
    values, deviation = _normalised(_sampled(image.level, row, column), weights)
    return Patches(values / deviation, np.asarray(weights, dtype=np.float32)), inside


def align(image: PatchImage, patches: Patches, row: Array, column: Array) -> Alignment:
    """Shift patches until they fit a frame; gain and offset of each are free.

    Args:
        image: the frame.
        patches: ``n`` patches.
        row: expected row of each pixel in the frame ``(n, pixels)``.
        column: expected column of each pixel in the frame ``(n, pixels)``.
    """
    count = len(row)
    shift, normal = np.zeros((count, 2)), np.tile(np.eye(2), (count, 1, 1))
    residual, correlation = np.ones(count), np.zeros(count)
    moving = np.arange(count)
    for _ in range(ROUNDS):
        # sample the frame at the shifted places; centre levels and slopes, since the offset is free
        weights, template = patches.weights[moving], patches.values[moving]
        place = row[moving] + shift[moving, :1], column[moving] + shift[moving, 1:]
        level, deviation = _normalised(_sampled(image.level, *place), weights)
        by_bin, by_beam = (_centred(_sampled(slope, *place), weights) for slope in (image.by_bin, image.by_beam))
        # residual after the best gain
        match = (level * template * weights).sum(axis=1) / deviation[:, 0]
        remainder = level - template * match[:, None] * deviation
        # Gauss-Newton step from the 2 x 2 normal equations of each patch
        aa, ab, bb = (
            (one * other * weights).sum(axis=1).astype(float)
            for one, other in ((by_bin, by_bin), (by_bin, by_beam), (by_beam, by_beam))
        )
        gradient_a, gradient_b = (-(slope * remainder * weights).sum(axis=1).astype(float) for slope in (by_bin, by_beam))
        det = aa * bb - ab * ab + 1e-14
        step = np.stack([(bb * gradient_a - ab * gradient_b) / det, (aa * gradient_b - ab * gradient_a) / det], axis=1)
        step = np.clip(step, -LONGEST, LONGEST)
        shift[moving] += step
        # keep what the covariance needs; patches that settled leave the iteration
        normal[moving] = np.stack([np.stack([aa, ab], axis=-1), np.stack([ab, bb], axis=-1)], axis=-2)
        residual[moving], correlation[moving] = (remainder * remainder * weights).sum(axis=1), match
        moving = moving[(np.abs(step) > STILL).any(axis=1)]
        if not len(moving):
            break
    # covariance from the residuals, for as many independent pixels as the weights leave
    independent = 1 / ((patches.weights**2).sum(axis=1) * CORRELATED)
    covariance = np.linalg.inv(normal + 1e-9 * np.eye(2)) * (residual / independent)[:, None, None]
    return Alignment(shift, covariance + np.diag(FLOOR**2), correlation)


def _tiles(table: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return the cells of the grid as rows ``(cells, bins * beams of a cell)``."""
    rows, columns = (length // cell for length, cell in zip(table.shape, CELL, strict=True))
    return table.reshape(rows, CELL[0], columns, CELL[1]).swapaxes(1, 2).reshape(rows * columns, CELL[0] * CELL[1])


def _sampled(image: Floats, row: Array, column: Array) -> Floats:
    """Interpolate between pixels by cubic polynomials: linear ones smooth the content between beams."""
    if not row.size:
        return np.zeros(row.shape, dtype=np.float32)
    places = column.astype(np.float32), row.astype(np.float32)
    return np.asarray(cv2.remap(image, *places, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), dtype=np.float32)


def _centred(values: Floats, weights: Floats) -> Floats:
    return np.asarray(values - (values * weights).sum(axis=1, keepdims=True), dtype=np.float32)


def _normalised(values: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return values minus their mean, and their standard deviations ``(n, 1)``."""
    centred = _centred(values, weights)
    deviation = np.sqrt((centred * centred * weights).sum(axis=1, keepdims=True)) + np.float32(1e-6)
    return centred, np.asarray(deviation, dtype=np.float32)
