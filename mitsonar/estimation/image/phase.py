"""The estimator ``phase``: Fourier registration on the ground plane, rotation then translation.

After Reddy and Chatterji (1996), as Hurtós et al. (2015) use it for forward-looking sonar: magnitudes of the spectra turn
with the image and do not see its translation; what remains after the rotation is a translation, for phase correlation.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.estimator import INPUTS, Estimate, blank, matching_rejection, rejected, two_frames
from mitsonar.estimation.image.ground_view import GroundView
from mitsonar.geometry.attitude import attitude_of
from mitsonar.motion.composition import Motion
from mitsonar.motion.motion_prior import MotionPrior
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["Phase"]

Floats = NDArray[np.float32]

CELL_M = 0.012
"""Edge of a pixel of the ground [m]."""

ANGLES = 720
"""Directions into which half a turn of a spectrum is divided."""

BAND = (0.04, 0.25)
"""Spatial frequencies that tell the rotation, in cycles a pixel: below lies the fan's outline, above mostly noise."""

LOW = 0.06
"""Standard deviation of the frequencies whose phases are compared, in cycles a pixel."""

ROUNDS = 3
"""Rotation and translation, each found again after the frames have been brought together by what is known."""


@dataclass(frozen=True)
class Phase:
    """Registration by phase correlation of the frames as seen from above.

    Args:
        height_m: over the ground, where the window shows no first echoes; default: that of the frames.
        pitch_rad: default: that of the frames.
    """

    height_m: float | None = None
    pitch_rad: float | None = None

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def estimate(self, frames: SonarFrames, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; reject frames without anything to match. A prior is ignored: all motions are searched.

        Raises:
            MitsonarError: frames of :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
        """
        images = two_frames(frames)
        attitude = attitude_of(frames, "phase", self.height_m, self.pitch_rad)
        view = GroundView(frames, attitude, CELL_M)
        first, second = (view.draw(image) for image in images)
        if attitude.reason or blank(first) or blank(second):
            return rejected(attitude.reason or "nothing in the frames to match")
        if min(first.shape) < 32 or not view.inside.any():
            return rejected("the fan meets too little ground")
        window = _window(view.inside)
        motion = Motion(0.0, 0.0, 0.0)
        for _ in range(ROUNDS):
            motion = _turned(motion, _rotation(first, _back(second, view, motion), window))
            motion = _shifted(motion, _translation(first, _back(second, view, motion), window), view)
        matched = _back(second, view, motion)
        smooth = [cv2.GaussianBlur(image, (5, 5), 0) for image in (first, matched)]
        reason = matching_rejection(smooth[0], smooth[1], window > 0.3, alike=4 * np.pi * 1.1**2)
        return Estimate(motion, None, not reason, reason)


def _window(inside: NDArray[np.bool_]) -> Floats:
    """1 in the middle of the fan, falling to 0 at its outline ``(rows, columns)``."""
    padded = np.pad(inside.astype(np.uint8), 1)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    return np.asarray(np.sin(np.pi / 2 * np.minimum(distance / (0.5 * distance.max() + 1e-9), 1)) ** 2, dtype=np.float32)


def _back(second: Floats, view: GroundView, motion: Motion) -> Floats:
    """Warp the second frame to the first."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(second, view.warp(motion), second.shape[::-1], flags=flags))


def _windowed(image: Floats, window: Floats) -> Floats:
    """Less its mean, times the window."""
    return np.asarray((image - np.average(image, weights=window)) * window, dtype=np.float32)


def _rotation(first: Floats, second: Floats, window: Floats) -> float:
    """How far the spectrum of the second is turned against that of the first [rad], clockwise seen from above."""
    spectra = [_spectrum_by_angle(_windowed(image, window)) for image in (first, second)]
    return -_offset(*spectra)[1] * np.pi / ANGLES


def _spectrum_by_angle(image: Floats) -> Floats:
    """Logarithm of the spectrum's magnitude over half a turn ``(angles, frequencies)``, less the mean over angles."""
    size = 2 * cv2.getOptimalDFTSize(max(image.shape))
    magnitude = np.fft.fftshift(np.abs(np.fft.rfft2(image, (size, size))), axes=0).astype(np.float32)
    angle = (np.arange(ANGLES, dtype=np.float32)[:, None] + 0.5) / ANGLES * np.pi - np.pi / 2
    frequency = np.arange(int(BAND[0] * size), int(BAND[1] * size), dtype=np.float32)[None, :]
    column, row = frequency * np.cos(angle), size // 2 + frequency * np.sin(angle)
    polar = np.log(cv2.remap(magnitude, column, row, cv2.INTER_LINEAR) + 1e-6)
    return np.asarray(polar - polar.mean(axis=0), dtype=np.float32)


def _translation(first: Floats, second: Floats, window: Floats) -> tuple[float, float]:
    """Columns and rows by which the second lies off the first."""
    return _offset(_windowed(first, window), _windowed(second, window))


def _offset(first: Floats, second: Floats) -> tuple[float, float]:
    """Columns and rows by which the second lies off the first, from the phases of their low frequencies alone."""
    shape = [cv2.getOptimalDFTSize(2 * size) for size in first.shape]
    cross = np.conj(np.fft.rfft2(first, shape)) * np.fft.rfft2(second, shape)
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :])
    low = np.exp(-((frequency / LOW) ** 2) / 2)
    peak = np.fft.fftshift(np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-30) * low, shape))
    row, column = np.unravel_index(int(peak[1:-1, 1:-1].argmax()), (shape[0] - 2, shape[1] - 2))
    near = np.log(np.maximum(peak[row : row + 3, column : column + 3], 1e-12 * float(peak.max()) + 1e-300))
    rows, columns = (_summit(line) for line in (near[:, 1], near[1]))
    return float(column + 1 + columns - shape[1] // 2), float(row + 1 + rows - shape[0] // 2)


def _summit(three: NDArray[np.float64]) -> float:
    """Where the parabola through three values, the middle one the largest, has its summit."""
    bend = three[0] - 2 * three[1] + three[2]
    return float(np.clip((three[0] - three[2]) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0


def _turned(motion: Motion, yaw: float) -> Motion:
    """Compose a motion with a turn on the spot: its steps are now along the new heading."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    sideways, forward = motion.sideways * cos - motion.forward * sin, motion.sideways * sin + motion.forward * cos
    return Motion(float(sideways), float(forward), motion.yaw + yaw)


def _shifted(motion: Motion, shift: tuple[float, float], view: GroundView) -> Motion:
    """Correct a motion by a residual shift: features displaced to starboard mean a motion to port."""
    warp = view.warp(motion).astype(float)
    warp[:, 2] += warp[:, :2] @ shift
    return view.motion(warp)
