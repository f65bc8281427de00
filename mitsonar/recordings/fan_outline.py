"""The outline of a fan in its pictures, by which a told geometry is checked: straight edges, and a circular far arc.

The edges of a fan meet in its apex, also where the picture is squeezed sideways. Only one stretch of the columns makes the
far arc a circle about that apex. The half angle follows from the edges with that stretch.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.recordings.geometry_file import PictureGeometry

__all__ = ["Outline", "doubts", "outline_of"]

Doubles = NDArray[np.float64]

DARK = 16
"""Largest value 0..255 of a pixel that counts as outside of the fan: videos ring there."""

LEAST_ROWS = 24
"""Rows, and columns, that an edge or arc must have."""

OFF_PX = 1.5
"""Distance of a pixel inside a straight edge or the arc beyond which it does not belong to it [px]."""

AGREEING = 0.5
"""Least part of the pixels of an edge or arc that must belong to it."""

PASSES = 30

SAME_STRETCH, SAME_ANGLE_DEG, SAME_PX = 0.05, 0.75, 0.02
"""Differences of told and found geometry that are tolerated: relative, in degrees, and as part of ``far_px``."""


class Outline(NamedTuple):
    """What the outline of a fan tells.

    Attributes:
        apex_px: column and row where the edges meet.
        far_px: distance of the far arc from the apex, along the fan's axis [px].
        half_angle_deg: from the axis to an edge, with the stretch [deg].
        stretch: of the columns that makes the far arc a circle.
    """

    apex_px: tuple[float, float]
    far_px: float
    half_angle_deg: float
    stretch: float


def outline_of(brightest: NDArray[np.generic], *, forward: str = "up") -> Outline | None:
    """Find the outline of a fan.

    Args:
        brightest: largest value 0..255 of each pixel over some pictures ``(rows, columns)``.
        forward: ``up`` or ``down``, the direction in which ranges rise.

    Returns:
        None where there is none: no straight edges, no arc, or a fan that the picture cuts off.
    """
    mask = np.asarray(brightest) > DARK
    mask = mask if forward == "up" else mask[::-1]
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    if len(rows) < LEAST_ROWS or len(columns) < LEAST_ROWS:
        return None
    first = mask[rows].argmax(axis=1).astype(float)
    last = mask.shape[1] - 1 - mask[rows][:, ::-1].argmax(axis=1).astype(float)
    left, right = _edge(rows.astype(float), first), _edge(rows.astype(float), -last)
    if left is None or right is None or left[1] + right[1] <= 0.02:
        return None
    closing = left[1] + right[1]  # both edges lean inwards by so much a row
    row = (-right[0] - left[0]) / closing
    column = left[0] + left[1] * row
    top = mask[:, columns].argmax(axis=0).astype(float)
    arc = _arc(np.asarray(columns - column, dtype=float), np.asarray(row - top, dtype=float))
    if arc is None:
        return None
    far, stretch = arc
    half = math.degrees(math.atan(stretch * closing / 2))
    row = row if forward == "up" else mask.shape[0] - 1 - row
    return Outline((float(column), float(row)), far, half, stretch)


def doubts(geometry: PictureGeometry, brightest: NDArray[np.generic]) -> list[str]:
    """Compare a geometry with the outline of its pictures, and return sentences on what disagrees."""
    found = outline_of(brightest, forward=geometry.forward)
    if found is None:
        return ["the pictures show no outline of a fan: stretch and half angle could not be checked"]
    told = geometry.apex_px or (0.0, 0.0)
    notes = []
    half = float(geometry.half_angle_deg or 0.0)
    if abs(found.stretch / geometry.stretch - 1) > SAME_STRETCH:
        notes.append(
            f"the far arc is a circle with stretch {found.stretch:.3f}, and the edges then open {found.half_angle_deg:.2f} "
            f"deg to each side; the geometry tells stretch {geometry.stretch:g} and {half:g} deg: the pictures are "
            "squeezed, or the geometry is another one"
        )
    elif abs(found.half_angle_deg - half) > SAME_ANGLE_DEG:
        notes.append(
            f"the edges of the fan open {found.half_angle_deg:.2f} deg to each side, the geometry tells {half:g} deg"
        )
    off = math.hypot((found.apex_px[0] - told[0]) * geometry.stretch, found.apex_px[1] - told[1])
    if off > SAME_PX * geometry.far:
        notes.append(
            f"the edges of the fan meet at ({found.apex_px[0]:.1f}, {found.apex_px[1]:.1f}) px, the geometry tells apex_px "
            f"({told[0]:g}, {told[1]:g})"
        )
    elif abs(found.far_px - geometry.far) > SAME_PX * geometry.far:
        notes.append(f"the far arc lies at {found.far_px:.1f} px from the apex, the geometry tells far_px {geometry.far:g}")
    return notes


def _edge(row: Doubles, column: Doubles) -> tuple[float, float] | None:
    """Fit the straight edge on the low side of columns ``(n,)``: column = a + b row; None where they are no edge.

    Pixels inside the edge are dropped: they are dark parts of the fan. Columns fall until the far arc cuts them.
    """
    kept = np.ones(len(row), dtype=bool)
    for _ in range(PASSES):
        slope, start = np.polyfit(row[kept], column[kept], 1)
        inside = column - (start + slope * row)
        fresh = (inside < OFF_PX) & (inside > -3 * OFF_PX)
        fresh = fresh if fresh.sum() >= LEAST_ROWS else inside < np.median(inside)
        if (fresh == kept).all():
            break
        kept = fresh
    inside = column - (start + slope * row)
    good = np.abs(inside) < OFF_PX
    return (float(start), float(slope)) if good.sum() >= max(LEAST_ROWS, AGREEING * len(row)) else None


def _arc(x: Doubles, y: Doubles) -> tuple[float, float] | None:
    """Fit the far arc y^2 = far^2 - stretch^2 x^2 to pixels ``(n,)``: far [px] and stretch; None where they are no arc.

    Pixels below the arc are dropped: they are dark parts of the fan, or its edges.
    """
    kept = y > np.median(y) - 1e-9
    far, squared = 0.0, 0.0
    for _ in range(PASSES):
        table = np.column_stack([np.ones(int(kept.sum())), -(x[kept] ** 2)])
        (far_squared, squared), *_ = np.linalg.lstsq(table, y[kept] ** 2, rcond=None)
        if far_squared <= 0 or squared <= 0:
            return None
        far = math.sqrt(far_squared)
        off = np.sqrt(np.maximum(far_squared - squared * x**2, 0)) - y
        fresh = (off < OFF_PX) & (off > -3 * OFF_PX)
        if fresh.sum() < LEAST_ROWS or (fresh == kept).all():
            break
        kept = fresh
    enough = kept.sum() >= max(LEAST_ROWS, AGREEING * len(x))
    return (far, math.sqrt(squared)) if enough else None
