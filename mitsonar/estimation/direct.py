"""The estimator ``direct``: photometric Gauss-Newton in native polar coordinates, over level ground.

Both frames are drawn half a motion apart from an unknown frame in the middle, so that both are interpolated alike and
second-order terms of the geometry cancel: cell c is seen at c - D v / 2 in the first and at c + D v / 2 in the second, D the
exact derivative of (bin, beam) by the motion. Residuals are weighed by Cauchy's law: shadow edges and relief are outliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate, two_frames
from mitsonar.frames import SonarFrames
from mitsonar.geometry import GroundGeometry
from mitsonar.motion import Motion
from mitsonar.sonar import Bearing

__all__ = ["Direct"]

Floats = NDArray[np.float32]


class Level(NamedTuple):
    """One step from coarse to fine: every so many bins, smoothed over bins and beams, for so many iterations."""

    step: int
    bins: float
    beams: float
    iterations: int


LEVELS = (Level(4, 6.0, 1.5, 8), Level(1, 1.0, 0.6, 12))

STILL = np.array([1e-5, 1e-5, 2e-6])
"""Steps below which an iteration ends [m, m, rad]."""

CAUCHY = 4.0
"""Residuals of so many standard deviations have half the weight."""

FAINTEST = 0.02
"""Residuals of this size are never outliers: patterns of rays and interpolation reach it without any noise."""

FEWEST_CELLS = 500
LEAST_CORRELATION = 8.0
LARGEST_STD = np.array([0.02, 0.02, np.radians(0.5)])
"""What an estimate that is to be believed must have: cells; correlation of the frames as matched, over that of independent
noise in as many cells; standard deviations."""


class _Fit(NamedTuple):
    motion: NDArray[np.float64]
    covariance: NDArray[np.float64]
    correlation: float
    cells: float
    converged: bool


@dataclass(frozen=True)
class Direct:
    """Photometric registration with the exact geometry of the sonar over level ground.

    Args:
        height_m: over the ground; default: what the frames say.
        pitch_rad: default: what the frames say.
        relief_m: mean height over the ground of what is seen: rocks, growth. Motions are scaled wrongly by about its part
            of the height where it is not given.
        levels: coarse to fine.
    """

    height_m: float | None = None
    pitch_rad: float | None = None
    relief_m: float = 0.0
    levels: tuple[Level, ...] = LEVELS

    inputs = "height and pitch"

    def estimate(self, frames: SonarFrames) -> Estimate:
        """The motion, its covariance, and whether to believe it; zero motion where there is nothing to match."""
        first, second = two_frames(frames)
        height, pitch, roll = self._geometry(frames)
        range_m, bearing_rad = tuple(frames.range_m.tolist()), tuple(frames.bearing_rad.tolist())
        v = np.zeros(3)
        fit = None
        for level in self.levels:
            ground = _cells(range_m, bearing_rad, frames.sonar.bearing, height, pitch, roll, level.step)
            fit = _register(_smoothed(first, level), _smoothed(second, level), *ground, v, level)
            if fit is None:
                return Estimate(Motion(0.0, 0.0, 0.0), None, False, "nothing in the frames to match")
            v = fit.motion
        assert fit is not None
        turn = _to_new_heading(v)
        about = {"correlation": fit.correlation, "cells": fit.cells}
        covariance = turn @ fit.covariance @ turn.T
        reason = _doubt(fit)
        return Estimate(Motion(*(float(x) for x in turn @ v)), covariance, not reason, reason, about)

    def _geometry(self, frames: SonarFrames) -> tuple[float, float, float]:
        """Height over what is seen, pitch and roll, the mean of both frames."""
        height = self.height_m if self.height_m is not None else _mean(frames.height_m)
        pose = None if frames.poses is None else frames.poses.mean(axis=0)
        pitch = self.pitch_rad if self.pitch_rad is not None else (None if pose is None else float(pose[3]))
        if height is None or pitch is None:
            raise MitsonarError(
                "direct needs height and pitch: the frames lack height_m or poses; give height_m and pitch_rad to it"
            )
        if not height - self.relief_m > 0:
            raise MitsonarError(f"the height over what is seen must be above 0: got {height:g} m less {self.relief_m:g} m")
        return height - self.relief_m, pitch, 0.0 if pose is None else float(pose[4])


def _mean(values: NDArray[np.float64] | None) -> float | None:
    known = None if values is None else values[np.isfinite(values)]
    return float(known.mean()) if known is not None and len(known) else None


@lru_cache(maxsize=16)
def _cells(
    range_m: tuple[float, ...],
    bearing_rad: tuple[float, ...],
    bearing: Bearing,
    height: float,
    pitch: float,
    roll: float,
    step: int,
) -> tuple[Floats, NDArray[np.bool_]]:
    """Derivative of (bin, beam) by the motion in the middle frame ``(bins, beams, 2, 3)``, and which cells have one."""
    ranges, axes = np.array(range_m), np.array(bearing_rad)
    ground = GroundGeometry(ranges[step // 2 :: step], axes, bearing, height, pitch, roll)
    places = np.stack(
        [
            np.broadcast_to((step * np.gradient(ranges))[step // 2 :: step, None], ground.points.shape[:2]),
            np.broadcast_to(np.gradient(axes), ground.points.shape[:2]),
        ],
        axis=-1,
    )
    derivative = ground.derivative / places[..., None]
    known = np.isfinite(derivative).all(axis=(2, 3))
    return np.nan_to_num(derivative).astype(np.float32), known


def _smoothed(image: Floats, level: Level) -> Floats:
    """Every so many bins of the smoothed image."""
    smooth = ndimage.gaussian_filter(image, (level.bins, level.beams), mode="nearest", truncate=3)
    return np.ascontiguousarray(smooth[level.step // 2 :: level.step])


def _register(
    first: Floats, second: Floats, derivative: Floats, known: NDArray[np.bool_], start: NDArray[np.float64], level: Level
) -> _Fit | None:
    """Gauss-Newton from a start; None where there is nothing to match."""
    v = start.copy()
    bins, beams = first.shape
    row, column = np.meshgrid(np.arange(bins, dtype=np.float32), np.arange(beams, dtype=np.float32), indexing="ij")
    converged = False
    for _ in range(level.iterations):
        half = derivative @ (v / 2).astype(np.float32)
        inner = _inner(half, bins, beams)
        if inner is None:
            return None
        before = _at(first, row - half[..., 0], column - half[..., 1])
        after = _at(second, row + half[..., 0], column + half[..., 1])
        by_bin, by_beam = _slopes((before + after) * np.float32(0.5))
        jacobian = by_bin[..., None] * derivative[..., 0, :] + by_beam[..., None] * derivative[..., 1, :]
        use = known[inner]
        j, r = jacobian[inner][use], (after - before)[inner][use]
        scale = max(1.4826 * float(np.median(np.abs(r[::5]))) if r.size else 0.0, FAINTEST)
        weight = 1 / (1 + (r / (CAUCHY * scale)) ** 2)
        weighted = j * weight[:, None]
        normal = (weighted.T @ j).astype(np.float64)
        if len(r) < FEWEST_CELLS or np.linalg.cond(normal / np.outer(*[np.sqrt(np.diag(normal)) + 1e-30] * 2)) > 1e8:
            return None
        step = -np.linalg.solve(normal, (weighted.T @ r).astype(np.float64))
        v = v + step
        converged = bool((np.abs(step) < STILL).all())
        if converged:
            break
    inverse = np.linalg.inv(normal)
    # smoothed noise is alike in neighbouring cells: as many cells count once as a smoothing kernel covers
    alike = 4 * np.pi * max(level.bins / level.step, 0.28) * max(level.beams, 0.28)
    spread = weighted * r[:, None]
    covariance = inverse @ (spread.T @ spread).astype(np.float64) @ inverse * alike
    a, b = before[inner][use], after[inner][use]
    moving = float(a.std() * b.std())
    correlation = float(((a - a.mean()) * (b - b.mean())).mean()) / moving if moving > 0 else 0.0
    return _Fit(v, covariance, correlation, len(r) / alike, converged)


def _inner(half: Floats, bins: int, beams: int) -> tuple[slice, slice] | None:
    """Cells that stay within both images; None where none does."""
    margin = [int(np.ceil(np.abs(half[..., axis]).max())) + 1 for axis in (0, 1)]
    if not (2 * margin[0] < bins and 2 * margin[1] < beams):
        return None
    return slice(margin[0], bins - margin[0]), slice(margin[1], beams - margin[1])


def _at(image: Floats, row: Floats, column: Floats) -> Floats:
    """Values between pixels, bilinear."""
    bins, beams = image.shape
    row, column = np.clip(row, 0, bins - 1.001), np.clip(column, 0, beams - 1.001)
    i, j = row.astype(np.int32), column.astype(np.int32)
    over_row, over_column = row - i, column - j
    flat, place = image.ravel(), i * beams + j
    near, far = flat[place], flat[place + beams]
    near = near + (flat[place + 1] - near) * over_column
    far = far + (flat[place + beams + 1] - far) * over_column
    return np.asarray(near + (far - near) * over_row, dtype=np.float32)


def _slopes(image: Floats) -> tuple[Floats, Floats]:
    """Central differences over bins and over beams."""
    by_bin, by_beam = np.zeros_like(image), np.zeros_like(image)
    by_bin[1:-1] = (image[2:] - image[:-2]) / 2
    by_beam[:, 1:-1] = (image[:, 2:] - image[:, :-2]) / 2
    return by_bin, by_beam


def _to_new_heading(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrix that turns a motion in the middle frame's axes into one along the new heading (eq. 3.4).

    Twice half the way s and half the turn: first s, then the turn, then s again: R(yaw / 2) s + s.
    """
    cos, sin = np.cos(v[2] / 2), np.sin(v[2] / 2)
    turn = np.eye(3)
    turn[:2, :2] = (np.array([[cos, -sin], [sin, cos]]) + np.eye(2)) / 2
    return turn


def _doubt(fit: _Fit) -> str:
    """Why not to believe an estimate; empty where nothing speaks against it."""
    std = np.sqrt(np.diag(fit.covariance))
    if not fit.converged:
        return "the iteration did not settle"
    if fit.correlation < LEAST_CORRELATION / np.sqrt(fit.cells):
        return f"the frames as matched correlate by {fit.correlation:.2f} only"
    if (std > LARGEST_STD).any():
        return f"standard deviations of {1e3 * std[0]:.1f}, {1e3 * std[1]:.1f} mm, {np.degrees(std[2]):.2f} deg"
    return ""
