"""Local contrast of sonar images: what stands out of its neighbourhood, in standard deviations of the image.

A real sonar lights the ground unevenly: a bright patch, stripes of beams, a fall with range. This light moves with the
sonar, so that estimators that match levels are pulled towards no motion. Its scale is that of the patch, larger than that of
stones and their shadows. So the mean of a neighbourhood is taken out of levels in dB. Its spread is not: dividing by it made
the errors of closure five times larger on a real recording. Speckle and noise that are new in each frame are smoothed away,
as far as the frames themselves say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

__all__ = ["SPREAD", "LocalContrast", "alike", "fitted_contrast"]

Images = NDArray[np.float32]

SPREAD = 8.0
"""Standard deviations over the range of the values, 0 to 1."""

SMOOTHINGS = ((1.0, 0.5), (2.0, 0.7), (4.0, 1.0), (8.0, 1.4), (16.0, 2.0))
"""Smoothings that are tried, least first: standard deviations of Gaussians [bins, beams]."""

ENOUGH = 0.75
"""Correlation of consecutive frames at which they need no more smoothing."""

NEIGHBOURHOOD = (0.12, 0.3)
"""Standard deviation of the Gaussian that a neighbourhood is, as part of the bins and of the beams."""

LEAST_SPREAD_DB = 0.5
"""Spread of an image [dB] below which it is taken for even: its noise must not be blown up."""


@dataclass(frozen=True)
class LocalContrast:
    """How levels become contrast.

    Attributes:
        bins: standard deviation of the smoothing along range [bins].
        beams: and across beams [beams].
    """

    bins: float = 4.0
    beams: float = 1.0

    def apply(self, level_db: Images) -> Images:
        """Return the contrast of images ``(frames, bins, beams)`` [dB] in 0..1: 0.5 is the mean of the neighbourhood."""
        return np.stack([self._of(one) for one in level_db]) if len(level_db) else level_db.astype(np.float32)

    def _of(self, level_db: Images) -> Images:
        smooth = ndimage.gaussian_filter(level_db, (self.bins, self.beams), mode="nearest", output=np.float32)
        around = [part * size for part, size in zip(NEIGHBOURHOOD, smooth.shape, strict=True)]
        rest = smooth - ndimage.gaussian_filter(smooth, around, mode="nearest")
        contrast = rest / np.float32(max(float(rest.std()), LEAST_SPREAD_DB))
        return np.asarray(np.clip(np.float32(0.5) + contrast / np.float32(SPREAD), 0, 1), dtype=np.float32)


def alike(images: Images) -> float:
    """Return the mean correlation of consecutive images ``(frames, bins, beams)``; 0 for fewer than two."""
    flat = images.reshape(len(images), -1).astype(np.float64)
    flat = flat - flat.mean(axis=1, keepdims=True)
    size = np.sqrt((flat * flat).sum(axis=1))
    products = (flat[1:] * flat[:-1]).sum(axis=1)
    norms = size[1:] * size[:-1]
    return float(np.mean(np.where(norms > 0, products / np.where(norms > 0, norms, 1), 0))) if len(images) > 1 else 0.0


def fitted_contrast(runs: Sequence[Images]) -> LocalContrast:
    """Choose the least smoothing by which consecutive images are alike.

    They correlate by 0.75 then. Where none of the smoothings reaches it, the one with the largest correlation is taken.

    Args:
        runs: consecutive images, each ``(frames, bins, beams)`` [dB].
    """
    found, best = LocalContrast(*SMOOTHINGS[0]), -1.0
    for bins, beams in SMOOTHINGS:
        tried = LocalContrast(bins, beams)
        correlation = float(np.mean([alike(tried.apply(run)) for run in runs]))
        if correlation > best:
            found, best = tried, correlation
        if correlation >= ENOUGH:
            break
    return found
