"""Fan pictures back to beams and bins: each cell is the mean of its own area in the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from mitsonar.errors import MitsonarError
from mitsonar.recordings.geometry_file import PictureGeometry

__all__ = ["FanSampler"]

Doubles = NDArray[np.float64]

MOST_WEIGHTS = 2**25
"""Weights of a sampler, at most: a quarter of a GiB."""

MOST_BEAMS = 1024
"""Beams that are made where their number is not told, at most."""

AT_A_TIME = 2**20
"""Weights that are computed at a time."""


@dataclass(frozen=True)
class FanSampler:
    """The linear map from a fan picture to beams and bins.

    Attributes:
        weights: of the picture's pixels in each cell ``(bins * beams, rows * columns)`` float32; rows of cells that lie in
            the picture add up to 1, the others hold nothing.
        bins: range bins.
        beams: beams.
    """

    weights: csr_array
    bins: int
    beams: int

    @classmethod
    def of(cls, geometry: PictureGeometry, rows: int, columns: int) -> FanSampler:
        """Make the map for pictures ``(rows, columns)``.

        A cell is covered by as many points, evenly, as it is wide in pixels. Each point reads the picture bilinearly. So a
        cell smaller than a pixel is interpolated, and a larger one is averaged. Averages are of picture values: of dB where
        the picture shows dB.

        Raises:
            MitsonarError: a fan outside the picture, or one that takes too much memory.
        """
        bins, beams = cell_counts(geometry)
        half = math.radians(float(geometry.half_angle_deg or 0.0))
        step = (geometry.far - geometry.near) / bins
        width = 2 * half / beams * geometry.far / max(1.0, geometry.stretch)
        across, along = (max(1, math.ceil(size - 1e-6)) for size in (width, step))
        count = bins * beams * across * along * 4
        if count > MOST_WEIGHTS:
            raise MitsonarError(
                f"a fan of {bins:,} bins and {beams:,} beams takes {count:,} weights: {MOST_WEIGHTS:,} at most; give "
                "smaller bins and beams in the geometry"
            )
        radius = geometry.near + (np.arange(bins * along) + 0.5) * (step / along)
        angle = -half + (np.arange(beams * across) + 0.5) * (2 * half / (beams * across))
        made = []
        at_once = max(1, AT_A_TIME // (beams * across * along * 4))
        for first in range(0, bins, at_once):
            some = radius[first * along : (first + at_once) * along].astype(float)
            made.append(_weights(geometry, some, angle.astype(float), (along, across), (rows, columns)))
        weights = vstack(made, format="csr")
        if not weights.nnz:
            raise MitsonarError(
                f"the fan of the geometry lies outside the pictures of {columns:,} x {rows:,} pixels: check apex_px, "
                "near_px, far_px and forward"
            )
        return cls(weights, bins, beams)

    def apply(self, picture: NDArray[np.generic]) -> NDArray[np.float32]:
        """Return the beams and bins ``(bins, beams)`` of a picture ``(rows, columns)``, float32 in 0..1; 0 outside it.

        Pictures are uint8 in 0..255, or float32 in 0..1.
        """
        values = np.ravel(picture).astype(np.float32)
        if picture.dtype == np.uint8:
            values *= np.float32(1 / 255)
        sampled = np.minimum(self.weights @ values, np.float32(1))  # weights of 1 in all are rounded
        return np.asarray(sampled, dtype=np.float32).reshape(self.bins, self.beams)


def cell_counts(geometry: PictureGeometry) -> tuple[int, int]:
    """Return the numbers of bins and beams of a fan: as told, or about one a pixel (beams: at mid range)."""
    bins = geometry.bins or max(2, round(geometry.far - geometry.near))
    half = math.radians(float(geometry.half_angle_deg or 0.0))
    arc = (geometry.near + geometry.far) / 2 * 2 * half / max(1.0, geometry.stretch)
    return bins, geometry.beams or int(np.clip(round(arc), 2, MOST_BEAMS))


def _weights(
    geometry: PictureGeometry, radius: Doubles, angle: Doubles, points: tuple[int, int], shape: tuple[int, int]
) -> csr_array:
    """Return the weights of some bins.

    Args:
        geometry: of the fan.
        radius: of the points ``(bins * points[0],)`` [px].
        angle: of the points ``(beams * points[1],)`` [rad], most to port first.
        points: of a cell along range and across.
        shape: rows and columns of the picture.
    """
    rows, columns = shape
    column, row = geometry.apex_px or (0.0, 0.0)
    sideways = (-1.0 if geometry.mirror else 1.0) / geometry.stretch
    u = column + sideways * radius[:, None] * np.sin(angle)
    v = row - (1.0 if geometry.forward == "up" else -1.0) * radius[:, None] * np.cos(angle)
    cell = np.arange(len(radius))[:, None] // points[0] * (len(angle) // points[1]) + np.arange(len(angle)) // points[1]
    inside = ((u >= -0.5) & (u <= columns - 0.5) & (v >= -0.5) & (v <= rows - 0.5)).ravel()
    u, v = (np.clip(axis.ravel()[inside], 0, most) for axis, most in ((u, columns - 1), (v, rows - 1)))
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    over, below = u - left, v - top
    pixels, parts = [], []
    for down in (0, 1):
        for right in (0, 1):
            pixels.append(np.minimum(top + down, rows - 1) * columns + np.minimum(left + right, columns - 1))
            parts.append((below if down else 1 - below) * (over if right else 1 - over))
    cells = len(radius) // points[0] * (len(angle) // points[1])
    index = np.tile(cell.ravel()[inside], 4)
    found = csr_array((np.concatenate(parts), (index, np.concatenate(pixels))), shape=(cells, rows * columns))
    total = found.sum(axis=1)
    scale = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0)
    found.data *= np.repeat(scale, np.diff(found.indptr))
    found.eliminate_zeros()
    return found.astype(np.float32)
