"""The estimator ``fourier-mellin``: log-polar spectra and phase correlation by the package fourier-mellin."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.estimator import INPUTS, Estimate, rejected
from mitsonar.estimation.external.ground_pair import ground_pair, package
from mitsonar.motion.composition import MotionPrior
from mitsonar.records.frames import SonarFrames

__all__ = ["FourierMellin"]

INSTALL = "pip install --no-deps fourier-mellin (its dependency opencv-python would replace opencv-python-headless)"


@dataclass(frozen=True)
class FourierMellin:
    """Rotation, scale and translation of the frames as seen from above; the scale is dropped.

    The package takes squares, and is misled by borders: the pictures fall to 0 there, within a square of twice their edge.

    Raises:
        MitsonarError: fourier-mellin is not installed.
    """

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def __post_init__(self) -> None:
        package("fourier_mellin", INSTALL)

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; the prior is not used.

        Raises:
            MitsonarError: as :func:`mitsonar.estimation.external.ground_pair.ground_pair` does.
        """
        pair = ground_pair(frames, "fourier-mellin")
        if pair.reason:
            return rejected(pair.reason)
        square, corner = _square(pair.first.shape)
        images = [np.pad(_tapered(image), square) for image in (pair.first, pair.second)]
        found = package("fourier_mellin", INSTALL).FourierMellin(images[0]).register_image(images[1])
        middle = (len(images[0]) - 1) / 2
        warp = np.array(cv2.getRotationMatrix2D((middle, middle), found.rotation, 1.0), dtype=float)
        warp[:, 2] += found.x, -found.y  # it counts rows upwards
        warp[:, 2] += warp[:, :2] @ np.array(corner) - np.array(corner)
        return pair.estimate(warp)


def _square(shape: tuple[int, ...]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Return by how much a picture is padded before and after, rows then columns, and the column and row of its corner."""
    edge = 2 * max(shape)
    before = [(edge - size) // 2 for size in shape]
    around = [(first, edge - size - first) for first, size in zip(before, shape, strict=True)]
    return around, (before[1], before[0])


def _tapered(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a picture less its mean, that falls to 0 at its border."""
    window = cv2.createHanningWindow(image.shape[::-1], cv2.CV_32F)
    return np.asarray((image - image.mean()) * window, dtype=np.float32)
