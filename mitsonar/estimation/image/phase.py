"""How the estimators ``phase`` and ``ecc`` register two frames projected to the ground plane.

``phase`` is Fourier registration, rotation then translation, after Reddy and Chatterji (1996) as Hurtós et al. (2015) use
it for forward-looking sonar. Magnitudes of the spectra turn with the image and do not depend on its translation; after the
rotation is removed, phase correlation finds the translation. ``ecc`` is OpenCV's enhanced correlation coefficient
(Evangelidis and Psarakis, 2008).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import INPUTS, Estimate, blank, matching_rejection, rejected, two_frames
from mitsonar.geometry.ground import GroundView, attitude_of
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import SonarFrames

__all__ = ["Ecc", "Phase"]


Floats = NDArray[np.float32]

CELL_M = 0.012
"""Edge of a ground pixel [m], as long as the fan fits."""

MOST_CELLS = 512
"""Largest number of pixels along the longer side of the fan; a larger fan has larger pixels."""

ANGLES = 720
"""Directions into which half a turn of a spectrum is divided."""

BAND = (0.04, 0.25)
"""Spatial frequencies from which the rotation is estimated, in cycles per pixel of :data:`CELL_M`.

Below them lies the fan's outline, above them mostly noise.
"""

HIGHEST = 0.45
"""Highest usable frequency of any image, in cycles per pixel of that image."""

LOW_PASS_STD = 0.06
"""Standard deviation of the frequencies whose phases are compared, in cycles per pixel of :data:`CELL_M`."""

ROUNDS = 3
"""Rounds of rotation and translation, each after the frames have been aligned by the current motion."""


@dataclass(frozen=True)
class Phase:
    """Registration by phase correlation of the frames as seen from above.

    Args:
        height_m: height over the ground, used where the window shows no first echoes; default: that of the frames.
        pitch_rad: default: that of the frames.
        relief_m: mean height of the visible surface over the ground; default: from the first echoes, where the window
            shows them.
    """

    height_m: float | None = None
    pitch_rad: float | None = None
    relief_m: float | None = None

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def estimate(self, frames: SonarFrames, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; reject frames that hold nothing to match. A prior is ignored: all motions are searched.

        Raises:
            MitsonarError: invalid frames, see :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
        """
        images = two_frames(frames)
        attitude = attitude_of(frames, "phase", self.height_m, self.pitch_rad, self.relief_m)
        view = GroundView(frames, attitude, CELL_M, MOST_CELLS)
        first, second = (view.draw(image, number) for number, image in enumerate(images))
        if attitude.reason or blank(first) or blank(second):
            return rejected(attitude.reason or "nothing in the frames to match")
        if min(first.shape) < 32 or not view.inside.any():
            return rejected("the fan meets too little ground")
        # the first frame stays fixed: its spectra serve all rounds
        window = _window(view.inside)
        fixed, motion = _windowed(first, window), Motion(0.0, 0.0, 0.0)
        larger = view.edge / CELL_M
        turn, shift = (
            _PhaseCorrelation(_spectrum_by_angle(fixed, larger), LOW_PASS_STD),
            _PhaseCorrelation(fixed, LOW_PASS_STD * larger),
        )
        for _ in range(ROUNDS):
            # rotation first, since the spectra's magnitudes do not depend on the translation
            _, rows = turn.offset(_spectrum_by_angle(_windowed(_warped_back(second, view, motion), window), larger))
            motion = _turned(motion, -rows * np.pi / ANGLES)
            motion = _shifted(motion, shift.offset(_windowed(_warped_back(second, view, motion), window)), view)
        # accept the motion only if the aligned frames match, away from the fan's outline
        matched = _warped_back(second, view, motion)
        smooth = [cv2.GaussianBlur(image, (5, 5), 0) for image in (first, matched)]
        reason = matching_rejection(smooth[0], smooth[1], window > 0.3, correlated=4 * np.pi * 1.1**2)
        return Estimate(motion, None, not reason, reason, attitude.about)


def _window(inside: NDArray[np.bool_]) -> Floats:
    """Return a window that is 1 in the middle of the fan and falls to 0 at its outline ``(rows, columns)``."""
    padded = np.pad(inside.astype(np.uint8), 1)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    return np.asarray(np.sin(np.pi / 2 * np.minimum(distance / (0.5 * distance.max() + 1e-9), 1)) ** 2, dtype=np.float32)


def _warped_back(second: Floats, view: GroundView, motion: Motion) -> Floats:
    """Warp the second frame to the first."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(second, view.warp(motion), second.shape[::-1], flags=flags))


def _windowed(image: Floats, window: Floats) -> Floats:
    """Return the image minus its mean, times the window."""
    return np.asarray((image - np.average(image, weights=window)) * window, dtype=np.float32)


def _spectrum_by_angle(image: Floats, larger: float) -> Floats:
    """Return the log magnitude of the spectrum over half a turn ``(angles, frequencies)``, minus the mean over angles.

    The frequencies are the same on the ground if pixels are larger by the factor ``larger``, as far as these resolve them.
    Pixels of a fan of 40 m have 0.14 m; then the upper half of the resolved frequencies is used.
    """
    band = min(larger * BAND[0], HIGHEST / 2), min(larger * BAND[1], HIGHEST)
    size = 2 * cv2.getOptimalDFTSize(max(image.shape))
    magnitude = np.fft.fftshift(np.abs(np.fft.rfft2(image, (size, size))), axes=0).astype(np.float32)
    angle = (np.arange(ANGLES, dtype=np.float32)[:, None] + 0.5) / ANGLES * np.pi - np.pi / 2
    frequency = np.arange(int(band[0] * size), int(band[1] * size), dtype=np.float32)[None, :]
    column, row = frequency * np.cos(angle), size // 2 + frequency * np.sin(angle)
    polar = np.log(cv2.remap(magnitude, column, row, cv2.INTER_LINEAR) + 1e-6)
    return np.asarray(polar - polar.mean(axis=0), dtype=np.float32)


class _PhaseCorrelation:
    """Measures the offset of images from a first one, using the phases of frequencies below ``low`` [cycles per pixel]."""

    def __init__(self, first: Floats, low: float) -> None:
        self.shape = [cv2.getOptimalDFTSize(2 * size) for size in first.shape]
        self.conjugate = np.conj(np.fft.rfft2(first, self.shape))
        frequency = np.hypot(np.fft.fftfreq(self.shape[0])[:, None], np.fft.rfftfreq(self.shape[1])[None, :])
        self.low = np.exp(-((frequency / low) ** 2) / 2)

    def offset(self, second: Floats) -> tuple[float, float]:
        """Return columns and rows by which the second image is offset from the first."""
        # whiten the cross spectrum, so that phases alone count; keep low frequencies
        cross = self.conjugate * np.fft.rfft2(second, self.shape)
        peak = np.fft.fftshift(np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-30) * self.low, self.shape))
        # highest peak, refined by parabolas through the logarithms of its neighbours
        row, column = np.unravel_index(int(peak[1:-1, 1:-1].argmax()), (self.shape[0] - 2, self.shape[1] - 2))
        near = np.log(np.maximum(peak[row : row + 3, column : column + 3], 1e-12 * float(peak.max()) + 1e-300))
        rows, columns = (_summit(line) for line in (near[:, 1], near[1]))
        return float(column + 1 + columns - self.shape[1] // 2), float(row + 1 + rows - self.shape[0] // 2)


def _summit(values: NDArray[np.float64]) -> float:
    """Return the vertex of the parabola through three values, of which the middle one is the largest."""
    curvature = values[0] - 2 * values[1] + values[2]
    return float(np.clip((values[0] - values[2]) / (2 * curvature), -0.5, 0.5)) if curvature < 0 else 0.0


def _turned(motion: Motion, yaw: float) -> Motion:
    """Compose a motion with a turn in place: its translation is then along the new heading."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    sideways, forward = motion.sideways * cos - motion.forward * sin, motion.sideways * sin + motion.forward * cos
    return Motion(float(sideways), float(forward), motion.yaw + yaw)


def _shifted(motion: Motion, shift: tuple[float, float], view: GroundView) -> Motion:
    """Correct a motion by a residual shift: features displaced to starboard mean a motion to port."""
    warp = view.warp(motion).astype(float)
    warp[:, 2] += warp[:, :2] @ shift
    return view.motion(warp)


# ---------------- The estimator ecc


LEVELS = ((4, 9), (1, 5))
"""Edge of a pixel in fine pixels, and size of OpenCV's Gaussian filter, coarse to fine."""

FINE = 0.43
"""Edge of a fine pixel relative to the beam spacing at the middle of the window: 0.01 m with a DIDSON at 4.4 m."""

SETTLED = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-5)


@dataclass(frozen=True)
class Ecc:
    """Rigid registration of the frames as seen from above.

    Args:
        height_m: height over the ground, used where the window shows no first echoes; default: that of the frames.
        pitch_rad: default: that of the frames.
        pixel_m: edge of a fine pixel [m]; default: 0.43 times the beam spacing at the middle of the window.

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
            MitsonarError: invalid frames, see :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
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
                arguments = (warp, cv2.MOTION_EUCLIDEAN, SETTLED, size)
                warp = np.asarray(cv2.findTransformECCWithMask(first, second, mask, mask, *arguments)[1], dtype=np.float32)
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
        """Return why a match is rejected, from images smoothed as in OpenCV; empty if it is valid."""
        smooth = [cv2.GaussianBlur(image, (size, size), 0) for image in (first, second)]
        warped = cv2.warpAffine(smooth[1], warp, first.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        seen = cv2.warpAffine(
            inside.astype(np.float32), warp, first.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        edge = cv2.erode((inside & (seen > 0.99)).astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        return matching_rejection(smooth[0], warped, edge, correlated=4 * np.pi * (0.3 * ((size - 1) / 2 - 1) + 0.8) ** 2)
