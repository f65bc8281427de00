"""Two frames as pictures of the ground without a border, for packages that register pictures and know no mask."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, explain_missing
from mitsonar.estimation.estimator import Estimate, rejected, two_frames
from mitsonar.estimation.image.ground_view import GroundView
from mitsonar.geometry.ground import attitude_of
from mitsonar.motion.composition import Motion
from mitsonar.records.frames import SonarFrames

__all__ = ["GroundPair", "ground_pair", "package"]

Picture = NDArray[np.float32]

PIXEL = 0.5
"""Edge of a pixel, in distances of neighbouring beams at the middle of the window."""

SMALLEST = 32
"""Rows and columns that a picture must have to be registered."""


@dataclass(frozen=True)
class GroundPair:
    """Two frames seen from above, cut to a rectangle that the fan fills.

    Attributes:
        first: picture of the first frame ``(rows, columns)``, row 0 farthest forward; empty where nothing is left.
        second: of the second.
        view: the pictures are a part of it.
        corner: column and row in the view of pixel (0, 0).
        reason: why the pair cannot be registered; empty where it can.
    """

    first: Picture
    second: Picture
    view: GroundView
    corner: tuple[int, int]
    reason: str

    def motion(self, warp: NDArray[np.floating]) -> Motion:
        """Return the motion of the warp ``(2, 3)`` that takes pixels (column, row) of the first picture to the second."""
        whole = np.array(warp, dtype=float)
        whole[:, 2] += np.array(self.corner) - whole[:, :2] @ np.array(self.corner)
        return self.view.motion(whole)

    def estimate(self, warp: NDArray[np.floating]) -> Estimate:
        """Return the estimate of such a warp; reject one that takes the pictures half apart."""
        rows, columns = self.first.shape
        corners = np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]], dtype=float)
        moved = np.abs(corners @ warp[:, :2].T + warp[:, 2] - corners)
        if not (moved < np.array([columns, rows]) / 2).all():
            return rejected("the pictures as registered do not overlap by half")
        return Estimate(self.motion(warp))


def ground_pair(frames: SonarFrames, name: str) -> GroundPair:
    """Draw two frames as pictures of level ground.

    Args:
        frames: two of them.
        name: of the estimator, for errors.

    Raises:
        MitsonarError: frames of :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
    """
    images = two_frames(frames)
    attitude = attitude_of(frames, name, None, None)
    spacing = float(np.ptp(frames.bearing_rad)) / (len(frames.bearing_rad) - 1)
    view = GroundView(frames, attitude, PIXEL * spacing * float(frames.range_m[0] + frames.range_m[-1]) / 2)
    rows, columns = _filled_rectangle(view.inside)
    first, second = (np.ascontiguousarray(view.draw(image, k)[rows, columns]) for k, image in enumerate(images))
    small = "" if min(first.shape) >= SMALLEST else "the fan meets too little ground"
    blank = "" if small or (np.ptp(first) > 0 and np.ptp(second) > 0) else "nothing in the frames to match"
    return GroundPair(first, second, view, (columns.start, rows.start), attitude.reason or small or blank)


def _filled_rectangle(inside: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return rows and columns of the largest rectangle about the middle column that lies inside; empty where none does."""
    best, area = (slice(0, 0), slice(0, 0)), 0
    middle = inside.shape[1] // 2
    for half in range(1, middle + 1):
        columns = slice(middle - half, middle + half)
        whole = np.concatenate([[False], inside[:, columns].all(axis=1), [False]])
        edges = np.flatnonzero(np.diff(whole.astype(np.int8)))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            if (stop - start) * 2 * half > area:
                best, area = (slice(int(start), int(stop)), columns), (stop - start) * 2 * half
    return best


def package(name: str, install: str = "") -> ModuleType:
    """Import a package that mitsonar does not need.

    Args:
        name: of the module.
        install: how to install it, where no extra of mitsonar does.

    Raises:
        MitsonarError: it is not installed; the sentence says what to do.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if install and error.name == name:
            raise MitsonarError(f"this estimator needs {name}, which is not installed: {install}") from None
        raise explain_missing(error) from None
