"""Smoothed images, values between pixels, and slopes over bins and beams."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.image.direct_cells import DirectLevel

__all__ = ["FAINTEST", "blurred", "central_differences", "sampled", "slopes_of"]

Floats = NDArray[np.float32]

FAINTEST = 0.02
"""Residuals of this size are never outliers: patterns of rays and interpolation reach it without any noise."""

NEIGHBOURS = (3, 7)
"""Beams and bins within which the slopes' variance is compared with the noise (Wiener's filter)."""


def blurred(image: Floats, bins: float, beams: float) -> Floats:
    """Smooth an image ``(bins, beams)`` by a Gaussian of these standard deviations [bins, beams]; 0, 0: not at all."""
    if not bins and not beams:
        return image
    size = tuple(2 * int(np.ceil(3 * sigma)) + 1 for sigma in (beams, bins))
    least = 1e-3  # OpenCV takes 0 for the other one
    return np.asarray(
        cv2.GaussianBlur(image, size, sigmaX=max(beams, least), sigmaY=max(bins, least), borderType=cv2.BORDER_REPLICATE)
    )


def sampled(image: Floats, row: Floats, column: Floats) -> Floats:
    """Interpolate an image between pixels, bilinear."""
    return np.asarray(cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def slopes_of(image: Floats, level: DirectLevel, scale: float) -> tuple[Floats, Floats]:
    """Return central differences over bins and beams of the denoised image (Wiener's filter).

    ``scale`` is the standard deviation of a difference of two frames; their mean has half of it.
    """
    smooth = blurred(image, *level.slopes)
    if scale > FAINTEST:
        mean = cv2.blur(smooth, NEIGHBOURS)
        variance = cv2.blur(smooth * smooth, NEIGHBOURS) - mean * mean
        kept = np.maximum(0, 1 - np.float32(2 * (scale / 2) ** 2) / np.maximum(variance, np.float32(1e-9)))
        smooth = mean + (smooth - mean) * kept
    return central_differences(smooth)


HALVES = np.array([-0.5, 0.0, 0.5], dtype=np.float32)
ONE = np.ones(1, dtype=np.float32)


def central_differences(image: Floats) -> tuple[Floats, Floats]:
    """Return central differences over bins and over beams."""
    by_bin = cv2.sepFilter2D(image, -1, ONE, HALVES, borderType=cv2.BORDER_REPLICATE)
    by_beam = cv2.sepFilter2D(image, -1, HALVES, ONE, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(by_bin, dtype=np.float32), np.asarray(by_beam, dtype=np.float32)
