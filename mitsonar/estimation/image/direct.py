"""The estimator ``direct``: photometric Gauss-Newton in native polar coordinates, over level ground.

The exact geometry of a motion gives, for each cell of one frame, where the other frame shows the same ground. Each frame is
drawn at the cells of the other, and both differences are used: where both frames are interpolated at once, a texture finer
than a beam biases the estimate towards whole and half beams. The slopes of the mean of both frames, denoised, turn
differences into motion. Single differences, and whole blocks that move on their own, have Cauchy weights: shadow edges and
relief are outliers.

It starts from no motion, or from a prior. Where that fails or hardly stands out, ``phase`` finds a start. Over far motions
relief decides: there the heights of blocks are estimated, too (:mod:`mitsonar.estimation.image.direct_relief`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import (
    FEWEST_BLOCKS,
    INPUTS,
    UNMEASURED,
    Estimate,
    correlation_rejection,
    rejected,
    stands_out,
    two_frames,
)
from mitsonar.estimation.image.direct_cells import Cells, DirectLevel
from mitsonar.estimation.image.direct_nodes import GroundNodes
from mitsonar.estimation.image.direct_registration import Fit, Held, is_resolved, register, smoothed
from mitsonar.estimation.image.direct_relief import registered_over_relief
from mitsonar.estimation.image.phase import Phase
from mitsonar.estimation.prior_gate import prior_rejection
from mitsonar.geometry.ground import STD_MEASURED, Attitude, attitude_of
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import LABELS, SonarFrames

__all__ = ["Direct", "is_far"]

Floats = NDArray[np.float32]

LEVELS = (
    DirectLevel(8, (16.0, 4.0), (0.0, 0.0), 10),
    DirectLevel(4, (6.0, 1.5), (0.0, 0.0), 8),
    DirectLevel(1, (0.7, 0.5), (0.6, 0.4), 24),
)
"""Coarse to fine, for frames of linear levels: beams with hard edges."""

LEVELS_CODED = (*LEVELS[:-1], DirectLevel(1, (0.5, 0.5), (0.6, 0.4), 24))
"""For frames in decibels and other coded levels, whose beams and pulses overlap: these smooth by themselves.

Errors in speckle are 5 to 20 % smaller than with :data:`LEVELS`; those with hard edges would be 5 to 8 % larger. They would
be smaller by another 5 % without what is as coarse as the illumination, but loops of a recording close at wrong places."""

MODEL = 1.4
"""Squared errors over the jackknife's covariance, measured at 60 places over rocky fields: 0.9 to 2.3 in speckle, 0.7 to 1.8
in still texture, of six sonars."""

FAR_MODEL = 2.2
"""Squared errors over the covariance of the blocks' pulls where their heights are estimated, measured on dives over rocky
fields with a DIDSON, an ARIS and an Oculus, with speckle and without, 40 and 200 mm apart: 0.7 to 4.9, in the mean 2.2."""

MOST_CELLS = 196_608
"""Most cells that are registered, four times those of a DIDSON. Beams within their own width are averaged at no loss."""

FARTHEST = np.array([0.15, 0.15, np.radians(3)])
"""Farthest from its start that a motion is valid. Up to 100 mm and 2 deg it is always found; what is far beyond is noise."""

CLEARLY = 1.2
"""Motions so many times farther than :data:`FAR` are far whatever the finest level would say."""

FAR, FAR_RAD = 0.02, float(np.radians(1.5))
"""Motions beyond this part of the height, or this turn, are far: relief decides, and ``phase`` finds those missed."""

GRAZING = 0.32
"""Squared height over range of those fields: in a look that grazes more, relief moves less, as a plate from 0.3 m shows."""

HELD = np.array([0.05, 0.05, np.radians(1)])
"""Standard deviation of a prior of no motion from the start: noise must not drive one where the frames tell little.

Sideways and yaw are told apart by few beams; without it one pair in twenty of hulls in high noise went off by 0.1 m."""

NEARBY = np.array([0.05, 0.05, np.radians(1)])
"""Farthest from a start that the registration over relief reaches."""

COVERED = 2.0
"""Standard deviations of its smoothing that a level reaches."""

LARGEST_STD = np.array([0.02, 0.02, np.radians(0.5)])
"""Largest standard deviations [m, m, rad] of a valid estimate."""


@dataclass(frozen=True)
class _Task:
    """Two frames to be registered, and what is known of them."""

    frames: SonarFrames
    images: tuple[Floats, Floats]
    attitude: Attitude
    prior: MotionPrior | None

    @property
    def relief_m(self) -> float:
        """Height [m] from which relief, seen as steeply as rocky fields are, would move as it does here."""
        middle_m = float(self.frames.range_m[[0, -1]].mean())
        return max(self.attitude.height_m, GRAZING * middle_m**2 / self.attitude.height_m)


@dataclass(frozen=True)
class Direct:
    """Photometric registration with the exact geometry of the sonar over level ground.

    Args:
        height_m: over the ground, where the window shows no first echoes; default: that of the frames.
        pitch_rad: default: that of the frames.
        relief_m: mean height of rocks and growth over the ground; default: from the first echoes, where the window shows
            them, else 0. An unknown relief scales motions wrongly by about its part of the height.
        heave_std_m: how far the sonar may have risen or sunk between the frames; 0: not at all.
        levels: coarse to fine; default: :data:`LEVELS`, or :data:`LEVELS_CODED` for coded levels.

    Raises:
        MitsonarError: a height or a heave that is not positive.
    """

    height_m: float | None = None
    pitch_rad: float | None = None
    relief_m: float | None = None
    heave_std_m: float = 0.0
    levels: tuple[DirectLevel, ...] | None = None

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def __post_init__(self) -> None:
        if not 0 <= self.heave_std_m < np.inf or (self.height_m is not None and not self.height_m > 0):
            raise MitsonarError(
                "direct takes a height above 0 m and a heave_std_m of 0 or more: got "
                f"{self.height_m} and {self.heave_std_m:g}"
            )

    def estimate(self, frames: SonarFrames, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion and its covariance; reject frames without anything to match.

        Args:
            frames: two.
            prior: where to start and how far to search; a motion that contradicts it is rejected. Default: it starts from no
                motion. Where that finds none, or none that stands out, and nothing tells that the motion is near,
                :class:`Phase` finds the start.

        Returns:
            The estimate; ``start`` of ``about`` is ``zero``, ``prior`` or ``phase``.

        Raises:
            MitsonarError: frames of :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
        """
        images = two_frames(frames)
        attitude = attitude_of(frames, "direct", self.height_m, self.pitch_rad, self.relief_m)
        if attitude.reason:
            return rejected(attitude.reason)
        task = _Task(*_resolved(frames, images), attitude, prior)
        start = Motion(0.0, 0.0, 0.0) if prior is None else prior.motion
        found = self._from(task, start, "zero" if prior is None else "prior")
        # light over even ground correlates at any motion: a match that hardly stands out may be far from the true one
        if (found.valid and found.about.get("stands_out", True)) or (
            prior is not None and (3 * prior.std <= FARTHEST).all()
        ):
            return found
        elsewhere = Phase(self.height_m, self.pitch_rad, self.relief_m).estimate(frames)
        if not elsewhere.valid or not is_far(elsewhere.motion, attitude.height_m):
            return found  # a motion nearby has been looked for
        second = self._from(replace(task, prior=None), elsewhere.motion, "phase")
        reason = second.reason or prior_rejection(second.motion, second.covariance, prior)
        return replace(second, valid=not reason, reason=reason)

    def _from(self, task: _Task, start: Motion, named: str) -> Estimate:
        """Register from a start: over level ground while the motion is near, over relief where it is far."""
        if self.heave_std_m:
            return self._over_level(task, start, named)
        if not is_far(start, task.relief_m):
            near = self._over_level(task, start, named, until_far=True)
            if isinstance(near, Motion):
                far = self._over_relief(task, start, near, named)
                return far if far.valid else self._over_level(task, start, named)
            if not near.valid or not is_far(near.motion, task.relief_m):
                return near
            far = self._over_relief(task, start, near.motion, named)
            return far if far.valid else near
        if task.prior is not None and (3 * task.prior.std > NEARBY).any():
            near = self._over_level(task, start, named)
            return self._over_relief(task, start, near.motion, named) if near.covariance is not None else near
        return self._over_relief(task, start, start, named)

    @overload
    def _over_level(self, task: _Task, start: Motion, named: str) -> Estimate: ...
    @overload
    def _over_level(self, task: _Task, start: Motion, named: str, *, until_far: bool) -> Estimate | Motion: ...
    def _over_level(self, task: _Task, start: Motion, named: str, *, until_far: bool = False) -> Estimate | Motion:
        """Register from a start over level ground; ``until_far``: no finer than shows that the motion is clearly far."""
        v = np.zeros(4 if self.heave_std_m else 3)
        v[:3] = start
        std = HELD if task.prior is None else np.maximum(HELD, task.prior.std)
        held = Held(v.copy(), np.append(std, self.heave_std_m)[: len(v)])
        fit = None
        levels, nodes = self._levels(task), GroundNodes(task.frames, task.attitude, heave=bool(self.heave_std_m))
        for number, level in enumerate(levels):
            last = number + 1 == len(levels)
            if not last and not is_resolved(len(task.images[0]), level):
                continue
            if last and until_far and is_far(Motion(*v[:3].tolist()), CLEARLY * task.relief_m):
                return Motion(*v[:3].tolist())
            pair = smoothed(task.images[0], level), smoothed(task.images[1], level)
            cells = Cells(nodes, level)
            found = register(pair, cells, v, level, last=last, held=held)
            if found is None:
                return replace(rejected("nothing in the frames to match"), about={"start": named})
            v, fit = found
        assert fit is not None
        about = {"heave_m": float(v[3])} if self.heave_std_m else {}
        return self._judged(task, start, v[:3], fit, MODEL, {**about, "start": named})

    def _levels(self, task: _Task) -> tuple[DirectLevel, ...]:
        """Return the levels that are needed: none that is coarser than one which reaches all that a prior leaves open."""
        levels = self.levels or (LEVELS if task.frames.level == "linear" else LEVELS_CODED)
        if task.prior is None:
            return levels
        range_m, bearing_rad = task.frames.range_m, task.frames.bearing_rad
        step = 3 * float(np.hypot(*task.prior.std[:2]))
        bins = step / float(np.median(np.diff(range_m)))
        beams = (3 * task.prior.std[2] + step / float(range_m.mean())) / float(np.median(np.diff(bearing_rad)))
        needed = [
            number
            for number, level in enumerate(levels)
            if bins <= COVERED * level.smoothing[0] and beams <= COVERED * level.smoothing[1]
        ]
        return levels[needed[-1] if needed else 0 :]

    def _over_relief(self, task: _Task, start: Motion, near: Motion, named: str) -> Estimate:
        """Register over relief, from a motion that is near; the result counts from the start."""
        found = registered_over_relief(task.images, task.frames, task.attitude, np.array(near))
        if found is None:
            return replace(rejected("nothing in the frames to match"), about={"start": named})
        # far motions match the ground between rocks, too: rocks look different from elsewhere
        std = float(np.hypot(task.attitude.height_std_m, task.attitude.tops_m))
        unsure = replace(task, attitude=replace(task.attitude, height_std_m=std))
        return self._judged(unsure, start, *found, FAR_MODEL, {"start": named})

    def _judged(
        self, task: _Task, start: Motion, v: NDArray[np.float64], fit: Fit, model: float, about: dict[str, object]
    ) -> Estimate:
        """Return the estimate with its covariance, rejected where it must not be used."""
        height = fit.by_height[:3] * task.attitude.height_std_m
        covariance = model * fit.covariance[:3, :3] + np.outer(height, height)
        motion = Motion(*(float(x) for x in v))
        reason = _rejection(fit, covariance, v - np.array(start))
        lean = fit.by_lean[:3] * task.attitude.unsure * ([0, 1, 1] if self.heave_std_m else [1, 1, 1])
        covariance = covariance + lean @ lean.T
        reason = reason or prior_rejection(motion, covariance, task.prior)
        about = {"correlation": fit.correlation, "height_m": task.attitude.height_m, **about, **task.attitude.about}
        if fit.excess != UNMEASURED:
            about["stands_out"] = stands_out(fit.independent, fit.excess)
        if task.attitude.first is not None:
            first_m = task.attitude.first.height_m  # over ground that rises the motion has another one
            about |= {"height_m": first_m, "height_std_m": STD_MEASURED * first_m}
        return Estimate(motion, covariance, not reason, reason, about)


def _resolved(frames: SonarFrames, images: tuple[Floats, Floats]) -> tuple[SonarFrames, tuple[Floats, Floats]]:
    """Return frames of at most :data:`MOST_CELLS` cells: the means of as many bins and beams as that takes.

    Beams that are closer than their width are averaged first, then what has the more cells.
    """
    bins, beams = images[0].shape
    width = float(np.median(np.diff(frames.bearing_rad))) / frames.sonar.beam_width_rad
    along = across = 1
    while (bins // along) * (beams // across) > MOST_CELLS:
        finer = (across + 1) * width <= 1 or beams // across > bins // along
        along, across = (along, across + 1) if finer else (along + 1, across)
    if along == across == 1:
        return frames, images
    rows, columns = bins // along, beams // across
    cut = (image[: rows * along, : columns * across] for image in images)
    image = np.stack([cv2.resize(one, (columns, rows), interpolation=cv2.INTER_AREA) for one in cut]).astype(np.float32)
    axes = (frames.range_m, rows, along), (frames.bearing_rad, columns, across)
    range_m, bearing_rad = (axis[: count * size].reshape(count, size).mean(axis=1) for axis, count, size in axes)
    without: dict[str, Any] = dict.fromkeys((*LABELS, "beam_poses"))
    return replace(frames, image=image, range_m=range_m, bearing_rad=bearing_rad, **without), (image[0], image[1])


def is_far(motion: Motion, height_m: float) -> bool:
    """Return whether relief decides over a motion, seen from this height [m]."""
    return bool(np.hypot(motion.sideways, motion.forward) > FAR * height_m or abs(motion.yaw) > FAR_RAD)


def _rejection(fit: Fit, covariance: NDArray[np.float64], off: NDArray[np.float64]) -> str:
    """Return the reason of a rejection; empty for a valid estimate, which is so far off its start."""
    std = np.sqrt(np.diag(covariance))
    if not fit.converged:
        return "the iteration did not settle"
    mismatch = correlation_rejection(fit.correlation, fit.independent, fit.excess)
    if mismatch:
        return mismatch
    if (np.abs(off) > FARTHEST).any():
        return "a motion beyond 150 mm or 3 deg of its start is farther than the coarsest level searches"
    if fit.blocks < FEWEST_BLOCKS:
        return "too small a part of the frames holds anything to match"
    if not (std < LARGEST_STD).all():
        return f"standard deviations of {1e3 * std[0]:.1f}, {1e3 * std[1]:.1f} mm, {np.degrees(std[2]):.2f} deg"
    return ""
