"""The estimator ``fourier-mellin``: log-polar spectra and phase correlation by the package fourier-mellin."""

from __future__ import annotations

from dataclasses import dataclass

import cv2

from mitsonar.estimation.estimator import INPUTS, Estimate, rejected
from mitsonar.estimation.external.ground_pair import ground_pair, package
from mitsonar.motion.motion_prior import MotionPrior
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["FourierMellin"]

INSTALL = "pip install --no-deps fourier-mellin (its dependency opencv-python would replace opencv-python-headless)"


@dataclass(frozen=True)
class FourierMellin:
    """Rotation, scale and translation of the frames as seen from above; the scale is dropped.

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
        found = package("fourier_mellin", INSTALL).FourierMellin(pair.first).register_image(pair.second)
        rows, columns = pair.first.shape
        warp = cv2.getRotationMatrix2D(((columns - 1) / 2, (rows - 1) / 2), found.rotation, 1.0)
        warp[:, 2] += found.x, -found.y  # it counts rows upwards
        return Estimate(pair.motion(warp), about={"response": float(found.response)})
