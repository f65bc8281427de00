"""The estimator ``ecc``: OpenCV's enhanced correlation coefficient (Evangelidis and Psarakis, 2008) on the ground plane."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import INPUTS, Estimate, blank, matching_rejection, rejected, two_frames
from mitsonar.estimation.image.ground_view import GroundView
from mitsonar.geometry.ground import attitude_of
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import SonarFrames

__all__ = ["Ecc"]

LEVELS = ((4, 9), (1, 5))
"""Edge of a pixel in fine ones, and size of OpenCV's Gaussian filter, coarse to fine."""

FINE = 0.43
"""Edge of a fine pixel in distances of neighbouring beams at the middle of the window: 0.01 m with a DIDSON at 4.4 m."""

SETTLED = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-5)


@dataclass(frozen=True)
class Ecc:
    """Rigid registration of the frames as seen from above.

    Args:
        height_m: over the ground, where the window shows no first echoes; default: that of the frames.
        pitch_rad: default: that of the frames.
        pixel_m: edge of a fine pixel [m]; default: 0.43 times the distance of beams at the middle of the window.

    Raises:
        MitsonarError: a pixel that is not positive.
    """

    height_m: float | None = None
    pitch_rad: float | None = None
    pixel_m: float | None = None

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def __post_init__(self) -> None:
        if self.pixel_m is not None and not self.pixel_m > 0:
            raise MitsonarError(f"ecc takes a pixel above 0 m: got {self.pixel_m:g}")

    def _pixel_m(self, frames: SonarFrames) -> float:
        """Return the edge of a fine pixel [m], to two digits."""
        if self.pixel_m is not None:
            return self.pixel_m
        spacing = float(np.ptp(frames.bearing_rad)) / (len(frames.bearing_rad) - 1)
        return float(f"{FINE * spacing * float(frames.range_m[0] + frames.range_m[-1]) / 2:.1e}")

    def estimate(self, frames: SonarFrames, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; reject frames for which OpenCV finds none. A prior is ignored.

        Raises:
            MitsonarError: frames of :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
        """
        images = two_frames(frames)
        attitude = attitude_of(frames, "ecc", self.height_m, self.pitch_rad)
        if attitude.reason or any(blank(image) for image in images):
            return rejected(attitude.reason or "nothing in the frames to match")
        motion = Motion(0.0, 0.0, 0.0)
        pixel_m = self._pixel_m(frames)
        for pixels, size in LEVELS:
            view = GroundView(frames, attitude, pixels * pixel_m)
            first, second = (view.draw(image, number) for number, image in enumerate(images))
            warp = view.warp(motion)
            mask = (view.inside * np.uint8(255)).astype(np.uint8)
            if min(first.shape) < 4 * size:
                return rejected("the fan meets too little ground")
            try:
                words = (warp, cv2.MOTION_EUCLIDEAN, SETTLED, size)
                warp = np.asarray(cv2.findTransformECCWithMask(first, second, mask, mask, *words)[1], dtype=np.float32)
            except cv2.error:
                return rejected("the correlation has no maximum nearby")
            motion = view.motion(warp)
        reason = self._rejection(first, second, warp, view.inside, size)
        return Estimate(motion, None, not reason, reason, attitude.about)

    @staticmethod
    def _rejection(
        first: NDArray[np.float32],
        second: NDArray[np.float32],
        warp: NDArray[np.float32],
        inside: NDArray[np.bool_],
        size: int,
    ) -> str:
        """Return the reason of a rejection, from images smoothed as in OpenCV; empty for a valid match."""
        smooth = [cv2.GaussianBlur(image, (size, size), 0) for image in (first, second)]
        back = cv2.warpAffine(smooth[1], warp, first.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        seen = cv2.warpAffine(
            inside.astype(np.float32), warp, first.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        edge = cv2.erode((inside & (seen > 0.99)).astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        return matching_rejection(smooth[0], back, edge, alike=4 * np.pi * (0.3 * ((size - 1) / 2 - 1) + 0.8) ** 2)
