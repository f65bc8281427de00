"""One frame over level ground: its checked levels, its fan, and the ground that the fan covers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument
from mitsonar.geometry.ground import GroundGeometry
from mitsonar.instruments.views import directions
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import SonarFrames

__all__ = [
    "LONGEST_SIDE",
    "RAYS",
    "FrameFan",
    "band_limited",
    "checked_heights",
    "checked_poses",
    "fan_of",
    "fractional_index",
    "from_middle",
    "ground_outline",
    "levels_of",
    "middle_beams",
    "poses_and_heights",
    "squared_span",
]

Floats = NDArray[np.float32]

RAYS = 33
"""Rays over bearing, and over elevation, whose ends on the ground bound a footprint."""

LONGEST_SIDE = 32_766
"""Longest side of an image or a patch [cells]: the limit of OpenCV's remap."""


@dataclass(frozen=True)
class FrameFan:
    """The geometry of one frame over the ground, and half of its elevation field of view [rad]."""

    ground: GroundGeometry
    half_elevation: float

    @property
    def window(self) -> tuple[float, float]:
        """Return the near and the far end of the range bins [m]."""
        return _ends(self.ground.range_m)

    @property
    def sector(self) -> tuple[float, float]:
        """Return the port and the starboard end of the beams [rad]."""
        return _ends(self.ground.bearing_rad)


# ---------------------------------------------------------------- frames


def levels_of(frames: SonarFrames) -> Floats:
    """Return the images ``(frames, bins, beams)`` as float32 in 0..1, as estimators match them.

    Raises:
        MitsonarError: too few or too many bins or beams, axes that do not rise, pixels that are not finite.
    """
    _, bins, beams = frames.image.shape
    if min(bins, beams) < 2 or max(bins, beams) > LONGEST_SIDE:
        raise MitsonarError(f"a mosaic needs images of 2 to {LONGEST_SIDE:,} bins and beams: got {bins:,} x {beams:,}")
    if (np.diff(frames.range_m) <= 0).any() or (np.diff(frames.bearing_rad) <= 0).any():
        raise MitsonarError("range_m and bearing_rad must rise: sort the images' rows and columns")
    images = frames.matching_values()
    if not np.isfinite(images).all():
        raise MitsonarError("images must be finite: got inf or nan; 0 means no echo")
    return np.asarray(images)


def poses_and_heights(
    frames: SonarFrames, poses: ArrayLike | None, height_m: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return poses ``(frames, 6)`` and heights ``(frames,)``: as given, or those of the frames.

    Raises:
        MitsonarError: neither are there, or their number or values do not fit.
    """
    if poses is None and frames.poses is None:
        raise MitsonarError("the frames have no poses: give poses, such as those of an estimated path")
    if height_m is None and frames.height_m is None:
        raise MitsonarError(f"the frames hold no height: give {argument('height_m')}, the sonar's height over the ground")
    table = checked_poses(frames.poses if poses is None else poses)
    if len(table) != len(frames):
        raise MitsonarError(f"each frame needs a pose: got {len(table)} poses for {len(frames)} frames")
    return table, checked_heights(frames.height_m if height_m is None else height_m, len(frames))


def checked_heights(height_m: ArrayLike | None, count: int) -> NDArray[np.float64]:
    """Return one height a frame ``(count,)`` [m]; nan where unknown.

    Raises:
        MitsonarError: another number of heights, or a height that is not above 0.
    """
    heights = np.asarray(height_m, dtype=float)
    if heights.shape not in ((), (count,)):
        raise MitsonarError(
            f"{argument('height_m')} must be one number, or one for each of {count} frames: got {heights.shape}"
        )
    if (heights <= 0).any():
        raise MitsonarError(f"{argument('height_m')} must be above 0: got {np.nanmin(heights):g} m")
    return np.broadcast_to(heights, count)


def checked_poses(poses: ArrayLike | None) -> NDArray[np.float64]:
    """Return poses ``(frames, 6)`` [m, rad].

    Raises:
        MitsonarError: another shape, or a pose that is not finite.
    """
    table = np.asarray(poses, dtype=float)
    if table.ndim != 2 or table.shape[1] != 6 or not np.isfinite(table).all():
        raise MitsonarError(f"poses must be (frames, 6), finite: got {table.shape}, x, y, z [m], pitch, roll, heading [rad]")
    return table


# ---------------------------------------------------------------- geometry of one frame


def fan_of(frames: SonarFrames, pose: NDArray[np.float64], height: float) -> FrameFan:
    """Return the geometry of a frame at a pose and a height [m] over the ground."""
    at = Pose.from_row(pose)
    ground = GroundGeometry(frames.range_m, frames.bearing_rad, frames.sonar.bearing, float(height), at.pitch, at.roll)
    return FrameFan(ground, math.radians(frames.sonar.elevation_fov_deg) / 2)


def middle_beams(fan: FrameFan, image: Floats, beams: int) -> tuple[FrameFan, Floats]:
    """Return the fan and the image ``(bins, beams)`` of the beams in the middle alone."""
    first = max(0, (image.shape[1] - beams) // 2)
    middle = slice(first, first + beams)
    ground = replace(fan.ground, bearing_rad=fan.ground.bearing_rad[middle])
    return replace(fan, ground=ground), np.ascontiguousarray(image[:, middle])


def ground_outline(fan: FrameFan) -> NDArray[np.float64] | None:
    """Return ground points ``(n, 2)`` in heading axes around all that a frame can show; None where it shows no ground.

    Rays that meet the ground beyond the far end of the window, or never, end where the window ends.
    """
    ground, far = fan.ground, fan.window[1]
    if not ground.height_m < far:  # nan too
        return None
    b, e = np.meshgrid(np.linspace(*fan.sector, RAYS), np.linspace(-1, 1, RAYS) * fan.half_elevation)
    x, y, z = np.moveaxis(directions(ground.bearing, b, e) @ ground.turn.T, -1, 0)
    level = np.maximum(np.hypot(x, y), 1e-12)
    with np.errstate(divide="ignore"):
        meets = np.where(z < 0, ground.height_m * level / -z, np.inf)
    distance = np.minimum(meets, math.sqrt(far**2 - ground.height_m**2)) / level
    return np.stack([x * distance, y * distance], axis=-1).reshape(-1, 2)


def _ends(centres: NDArray[np.float64]) -> tuple[float, float]:
    """Return the outer edges of cells with these centres, as wide as their neighbours."""
    return float(1.5 * centres[0] - 0.5 * centres[1]), float(1.5 * centres[-1] - 0.5 * centres[-2])


def from_middle(value: NDArray[np.floating], low: float, high: float) -> Floats:
    """Return the distance from the middle of two ends, as a part of half their distance: 1 at either end."""
    return np.asarray(np.abs(value - np.float32((low + high) / 2)) / np.float32((high - low) / 2), dtype=np.float32)


def fractional_index(value: Floats, centres: NDArray[np.float64]) -> Floats:
    """Return the fractional index of values among centres that rise."""
    steps = np.diff(centres)
    if np.allclose(steps, steps[0], rtol=1e-6, atol=0):  # ten times as fast
        return np.asarray((value - np.float32(centres[0])) / np.float32(steps.mean()))
    return np.interp(value, centres, np.arange(centres.size)).astype(np.float32)


def band_limited(image: Floats, bins2: float, beams2: float) -> Floats:
    """Smooth an image as far as a cell of the map spans more than a bin or a beam, so that fine texture is averaged.

    Variances add up: a square of w bins has w^2 / 12, of which each bin has 1 / 12 already.

    Args:
        image: ``(bins, beams)``.
        bins2: squared width of a cell of the map in bins.
        beams2: in beams.
    """
    along, across = (math.sqrt(max(width2 - 1, 0) / 12) for width2 in (bins2, beams2))
    if max(along, across) == 0:
        return image
    kernel = (2 * math.ceil(3 * across) + 1, 2 * math.ceil(3 * along) + 1)
    # a sigma of 0 would mean one that suits the kernel, which here is a single cell
    return np.asarray(cv2.GaussianBlur(image, kernel, across or 1.0, sigmaY=along or 1.0, borderType=cv2.BORDER_REPLICATE))


def squared_span(indices: Floats, weight: Floats) -> float:
    """Return the squared width of a cell of the map in bins or beams: the median over some cells that the frame shows."""
    rows, columns = (slice(1, None, max(1, size // 16)) for size in indices.shape)
    before = slice(0, -1, rows.step), slice(0, -1, columns.step)
    here, seen = indices[rows, columns], weight[rows, columns] > 0
    squared = np.square(here - indices[before[0], columns]) + np.square(here - indices[rows, before[1]])
    return float(np.median(squared[seen])) if seen.any() else 0.0
