"""Appearance of the ground in frames, for finding places again: coarse views from above, and where two of them are alike."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.image.phase import GroundView, fan_places
from mitsonar.geometry.ground import attitude_of
from mitsonar.motion.composition import Motion
from mitsonar.records.frames import SonarFrames

__all__ = ["Canvas", "CoarseView", "Likeness", "likenesses"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

CELLS_A_REACH = 45
"""Cells of a coarse view over the horizontal distance to its middle."""

LOCAL = 4.0
"""Standard deviation over which the level of a view is taken out [cells]: what is slower is light, not ground."""

FEWEST_CELLS = 8
"""Fewest rows and columns of a canvas."""

LEAST_OVERLAP = 0.35
"""Least part of a view that another must show too."""

RIVAL_CELLS = 6
"""Distance from the best shift at which another one counts as another place [cells]."""


@dataclass(frozen=True)
class Canvas:
    """The ground before the sonar on which all frames of a run are drawn, whatever their heights.

    Attributes:
        view: the frame that decides which ground that is, with cells of some centimetres.
    """

    view: GroundView

    @classmethod
    def of(cls, frame: SonarFrames) -> Self | None:
        """Make the canvas of a run from one of its frames; None where it shows no ground.

        Raises:
            MitsonarError: no height or pitch.
        """
        attitude = attitude_of(frame, "a search for loops", None, None)
        reach = GroundView(frame, attitude, 1.0).reach
        middle = (reach[2] + reach[3]) / 2
        if attitude.reason or not middle > 0:
            return None
        canvas = cls(GroundView(frame, attitude, middle / CELLS_A_REACH))
        return canvas if min(canvas.view.points.shape[:2]) >= FEWEST_CELLS else None

    @property
    def reach_m(self) -> float:
        """Return the horizontal distance from the sonar to the middle of the ground that it sees [m]."""
        return (self.view.reach[2] + self.view.reach[3]) / 2

    @property
    def extent_m(self) -> float:
        """Return the shorter edge of the ground that it sees [m]."""
        left, right, near, far = self.view.reach
        return min(right - left, far - near)

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Return the size of transforms in which a shifted view does not wrap around."""
        rows, columns, _ = self.view.points.shape
        return cv2.getOptimalDFTSize(2 * rows), cv2.getOptimalDFTSize(2 * columns)

    def draw(self, frame: SonarFrames) -> CoarseView | None:
        """Draw one frame by its own height and attitude, without its light; None where it is known to show none."""
        try:
            own = attitude_of(frame, "a search for loops", None, None)
        except MitsonarError:
            return None
        if own.reason:
            return None
        row, column, shown = fan_places(own.ground(frame), frame.sonar, self.view.points)
        inside = shown.astype(np.float32)
        if inside.sum() < FEWEST_CELLS**2:
            return None
        bins = self.view.edge / float(np.median(np.diff(frame.range_m)))
        smooth = cv2.GaussianBlur(frame.matching_values()[0], (0, 0), sigmaX=0.5, sigmaY=max(0.4 * bins, 0.3))
        image = cv2.remap(np.asarray(smooth, dtype=np.float32), column, row, cv2.INTER_LINEAR)
        weight = cv2.GaussianBlur(inside, (0, 0), LOCAL) + 1e-6
        image = np.asarray((image - cv2.GaussianBlur(image * inside, (0, 0), LOCAL) / weight) * inside, dtype=np.float32)
        spread = float(np.sqrt((image**2).sum() / inside.sum()))
        return None if spread <= 0 else CoarseView(np.asarray(image / spread, dtype=np.float32), inside, self)


@dataclass(frozen=True)
class CoarseView:
    """A frame as seen from above, without its light, in cells of some centimetres.

    Attributes:
        image: mean 0 where inside, 0 elsewhere ``(rows, columns)``.
        inside: 1 where the sonar sees ground, else 0 ``(rows, columns)``.
        canvas: on which it is drawn.
    """

    image: Floats
    inside: Floats
    canvas: Canvas

    @cached_property
    def transforms(self) -> tuple[NDArray[np.complexfloating], ...]:
        """Return the conjugate spectra of the image, its square and its inside."""
        parts = (self.image, self.image * self.image, self.inside)
        return tuple(np.conj(np.fft.rfft2(part, self.canvas.shape)) for part in parts)


class Likeness(NamedTuple):
    """How alike two views are after a motion: their correlation where they overlap."""

    motion: Motion
    correlation: float


def likenesses(first: CoarseView, second: CoarseView, yaws: Array, expected: Array, window: Array) -> list[Likeness]:
    """Return where two views are most alike: for each yaw the best shift, and the best one at another place.

    The most alike come first.

    Args:
        first: the earlier view.
        second: the later one, on the same canvas.
        yaws: turns that are tried [rad] ``(n,)``.
        expected: sideways, forward [m] of the motion, around which is searched ``(2,)``.
        window: half width of the search, sideways and forward [m] ``(2,)``; the larger counts.
    """
    found = []
    for yaw in yaws:
        motion = Motion(float(expected[0]), float(expected[1]), float(yaw))
        found += _best_shifts(first, second, motion, window)
    return sorted(found, key=lambda one: -one.correlation)


def _best_shifts(first: CoarseView, second: CoarseView, motion: Motion, window: Array) -> list[Likeness]:
    """Return the best motions with the yaw of ``motion``, by the masked correlation of Padfield (2012) over all shifts."""
    canvas, reach = first.canvas, first.canvas.reach_m
    # turned about its middle, a view stays on the canvas; shifts do the rest
    turned = Motion(-reach * float(np.sin(motion.yaw)), reach * (float(np.cos(motion.yaw)) - 1), motion.yaw)
    warp = canvas.view.warp(turned)
    expected = np.linalg.solve(warp[:, :2], canvas.view.warp(motion)[:, 2] - warp[:, 2])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = first.image.shape[::-1]
    image, inside = (
        np.asarray(cv2.warpAffine(part, warp, size, flags=flags), dtype=np.float32) for part in (second.image, second.inside)
    )
    spectra = [np.fft.rfft2(part, canvas.shape) for part in (image, image * image, inside)]
    one, squared, there = first.transforms
    overlap, product, own, others, own_squared, others_squared = (
        np.fft.irfft2(a * b, canvas.shape)
        for a, b in (
            (there, spectra[2]),
            (one, spectra[0]),
            (one, spectra[2]),
            (there, spectra[0]),
            (squared, spectra[2]),
            (there, spectra[1]),
        )
    )
    count = np.maximum(overlap, 1.0)
    spread = np.maximum(own_squared - own**2 / count, 0) * np.maximum(others_squared - others**2 / count, 0)
    correlation = (product - own * others / count) / np.sqrt(spread + 1e-6 * count**2)
    rows, columns = (np.fft.fftfreq(n, 1 / n) for n in canvas.shape)
    edge = canvas.view.edge
    farthest = max(float(np.max(window)) / edge, 1.0)
    allowed = (np.abs(rows - expected[1]) <= farthest)[:, None] & (np.abs(columns - expected[0]) <= farthest)[None]
    allowed = allowed & (overlap >= LEAST_OVERLAP * float(first.inside.sum()))
    found: list[Likeness] = []
    while allowed.any() and len(found) < 2:
        row, column = np.unravel_index(int(np.where(allowed, correlation, -2).argmax()), canvas.shape)
        shifted = warp.astype(float)
        shifted[:, 2] += shifted[:, :2] @ [columns[column], rows[row]]
        found.append(Likeness(canvas.view.motion(shifted), float(correlation[row, column])))
        near = (np.abs(rows - rows[row]) < RIVAL_CELLS)[:, None] & (np.abs(columns - columns[column]) < RIVAL_CELLS)[None]
        allowed &= ~near
    return found
