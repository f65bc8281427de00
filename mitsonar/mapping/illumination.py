"""The illumination of a sonar over even ground, from a sample of its frames."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, argument
from mitsonar.mapping.frame_footprint import fan_of, levels_of, poses_and_heights
from mitsonar.records.frames import SonarFrames

__all__ = ["ILLUMINATION_FRAMES", "illumination"]

Floats = NDArray[np.float32]

ILLUMINATION_FRAMES = 20
"""Frames, spread over a run, that suffice for its illumination. The correlation of the mosaic with the true reflectivity of
the pattern's seabed is 0.789 with 20 frames, 0.788 with 300, and 0.381 without an illumination."""

SMOOTH_ILLUMINATION = (1 / 32, 1 / 8)
"""Standard deviations of its smoothing, in parts of the bins and of the beams: scenery goes, the pattern stays."""

FAINTEST_ILLUMINATION = 0.05
"""Smallest illumination, as a part of its mean; darker pixels are not raised further."""


def illumination(frames: SonarFrames, poses: ArrayLike | None = None, height_m: ArrayLike | None = None) -> Floats:
    """Return how brightly each cell of the image is lit over even ground ``(bins, beams)``, with mean 1; 1 beyond ground.

    It is the mean of frames that show different ground, smoothed within the lit part of the image. The height and the pitch
    of the sonar must stay about the same. :data:`~mitsonar.mapping.illumination.ILLUMINATION_FRAMES`
    frames, spread over the run, suffice.

    Args:
        frames: a sample of the run.
        poses: as in :meth:`~mitsonar.mapping.mosaic.Mosaic.add`.
        height_m: as in :meth:`~mitsonar.mapping.mosaic.Mosaic.add`.

    Raises:
        MitsonarError: as :meth:`~mitsonar.mapping.mosaic.Mosaic.add`; the frames show no ground, or nothing.
    """
    table, heights = poses_and_heights(frames, poses, height_m)
    mean = levels_of(frames).mean(axis=0)
    over_ground = np.isfinite(heights)
    if not over_ground.any():
        raise MitsonarError(f"the illumination needs frames over ground, of known height: give {argument('height_m')}")
    fan = fan_of(frames, table[over_ground].mean(axis=0), float(heights[over_ground].mean()))
    points = fan.ground.points
    lit = np.abs(fan.ground.elevation(points)) <= fan.half_elevation
    if not mean[lit].any():
        raise MitsonarError("the frames show no lit ground: check height, pitch, window, and that they are not blank")
    along, across = (part * size for part, size in zip(SMOOTH_ILLUMINATION, mean.shape, strict=True))

    def smooth(image: Floats) -> Floats:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), across, sigmaY=along, borderType=cv2.BORDER_CONSTANT))

    share = smooth(lit.astype(np.float32))
    known = share > 1e-3
    level = smooth(np.where(lit, mean, np.float32(0))) / np.maximum(share, np.float32(1e-3))
    level = level / level[lit].mean()
    return np.asarray(np.where(known, np.maximum(level, np.float32(FAINTEST_ILLUMINATION)), np.float32(1)))
