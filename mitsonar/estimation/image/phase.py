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
from mitsonar.geometry.ground import attitude_of
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import SonarFrames

__all__ = ["Phase"]

Floats = NDArray[np.float32]

CELL_M = 0.012
"""Edge of a pixel of the ground [m], while the fan fits."""

MOST_CELLS = 512
"""Pixels along the longer side of the fan; they are larger where it would have more."""

ANGLES = 720
"""Directions into which half a turn of a spectrum is divided."""

BAND = (0.04, 0.25)
"""Spatial frequencies that tell the rotation, in cycles a pixel of :data:`CELL_M`: below lies the fan's outline, above
mostly noise."""

HIGHEST = 0.45
"""Highest frequency of any picture, in its own pixels."""

LOW = 0.06
"""Standard deviation of the frequencies whose phases are compared, in cycles a pixel of :data:`CELL_M`."""

ROUNDS = 3
"""Rotation and translation, each found again after the frames have been brought together by what is known."""


@dataclass(frozen=True)
class Phase:
    """Registration by phase correlation of the frames as seen from above.

    Args:
        height_m: over the ground, where the window shows no first echoes; default: that of the frames.
        pitch_rad: default: that of the frames.
        relief_m: mean height over the ground of what is seen; default: from the first echoes, where the window shows them.
    """

    height_m: float | None = None
    pitch_rad: float | None = None
    relief_m: float | None = None

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def estimate(self, frames: SonarFrames, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; reject frames without anything to match. A prior is ignored: all motions are searched.

        Raises:
            MitsonarError: frames of :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
        """
        images = two_frames(frames)
        attitude = attitude_of(frames, "phase", self.height_m, self.pitch_rad, self.relief_m)
        view = GroundView(frames, attitude, CELL_M, MOST_CELLS)
        first, second = (view.draw(image, number) for number, image in enumerate(images))
        if attitude.reason or blank(first) or blank(second):
            return rejected(attitude.reason or "nothing in the frames to match")
        if min(first.shape) < 32 or not view.inside.any():
            return rejected("the fan meets too little ground")
        window = _window(view.inside)
        fixed, motion = _windowed(first, window), Motion(0.0, 0.0, 0.0)
        larger = view.edge / CELL_M
        turn, shift = _PhaseCorrelation(_spectrum_by_angle(fixed, larger), LOW), _PhaseCorrelation(fixed, LOW * larger)
        for _ in range(ROUNDS):
            _, rows = turn.offset(_spectrum_by_angle(_windowed(_back(second, view, motion), window), larger))
            motion = _turned(motion, -rows * np.pi / ANGLES)
            motion = _shifted(motion, shift.offset(_windowed(_back(second, view, motion), window)), view)
        matched = _back(second, view, motion)
        smooth = [cv2.GaussianBlur(image, (5, 5), 0) for image in (first, matched)]
        reason = matching_rejection(smooth[0], smooth[1], window > 0.3, alike=4 * np.pi * 1.1**2)
        return Estimate(motion, None, not reason, reason, attitude.about)


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


def _spectrum_by_angle(image: Floats, larger: float) -> Floats:
    """Logarithm of the spectrum's magnitude over half a turn ``(angles, frequencies)``, less the mean over angles.

    The frequencies are the same on the ground where pixels are so many times larger, as far as these show them. Pixels of a
    fan of 40 m have 0.14 m; then the upper half of what they show is used.
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
    """How far images lie off a first one, from the phases of their low frequencies alone; ``low`` in cycles a pixel."""

    def __init__(self, first: Floats, low: float) -> None:
        self.shape = [cv2.getOptimalDFTSize(2 * size) for size in first.shape]
        self.conjugate = np.conj(np.fft.rfft2(first, self.shape))
        frequency = np.hypot(np.fft.fftfreq(self.shape[0])[:, None], np.fft.rfftfreq(self.shape[1])[None, :])
        self.low = np.exp(-((frequency / low) ** 2) / 2)

    def offset(self, second: Floats) -> tuple[float, float]:
        """Return columns and rows by which the second lies off the first."""
        cross = self.conjugate * np.fft.rfft2(second, self.shape)
        peak = np.fft.fftshift(np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-30) * self.low, self.shape))
        row, column = np.unravel_index(int(peak[1:-1, 1:-1].argmax()), (self.shape[0] - 2, self.shape[1] - 2))
        near = np.log(np.maximum(peak[row : row + 3, column : column + 3], 1e-12 * float(peak.max()) + 1e-300))
        rows, columns = (_summit(line) for line in (near[:, 1], near[1]))
        return float(column + 1 + columns - self.shape[1] // 2), float(row + 1 + rows - self.shape[0] // 2)


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
