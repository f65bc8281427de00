"""How the estimator ``direct`` registers two frames, over level ground and over relief.

It is photometric Gauss-Newton in native polar coordinates. The exact geometry of a motion gives, for each cell of one
frame, where the other frame shows the same ground. Each frame is resampled at the cells of the other, and both differences
are used: if both frames are interpolated at once, a texture finer than a beam biases the estimate towards whole and half
beams. The slopes of the denoised mean of both frames turn differences into motion. Single differences, and whole blocks
that move independently, have Cauchy weights: relief and the ends of shadows are outliers. The sides of shadows move with the
bodies that cast them.

What else displaces the ground, an error of the height, a slope, or heave, pitch and roll that nothing measured, has priors.
Where the residuals show it, the motion is corrected.

The iteration starts from zero motion, or from a prior. Where that fails or the match is hardly distinct, ``phase`` finds a
start. Over far motions relief dominates the error, so the heights of blocks are estimated as well
(:func:`registered_over_relief`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import (
    FEWEST_BLOCKS,
    INPUTS,
    UNMEASURED,
    Estimate,
    correlation_of,
    correlation_rejection,
    is_distinct,
    prior_rejection,
    rejected,
    spread_of,
    two_frames,
)
from mitsonar.estimation.image.phase import Phase
from mitsonar.estimation.image.registration import (
    FEWEST_CELLS,
    SHADOW_SIDES,
    SHADOW_SIDES_CODED,
    Cells,
    DirectLevel,
    Fit,
    GroundNodes,
    StartPrior,
    blurred,
    by_block,
    cauchy,
    cell_blocks,
    central_differences,
    correlated_cells,
    is_resolved,
    noise_of,
    on_cells,
    products_by_block,
    register,
    sampled,
    shadow_lengths,
    slopes_of,
    smoothed,
)
from mitsonar.geometry.ground import STD_MEASURED, Attitude, attitude_of
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import LABELS, SonarFrames

__all__ = ["Direct", "is_far", "registered_over_relief"]


Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

LEVELS = (
    DirectLevel(8, (16.0, 4.0), (0.0, 0.0), 10),
    DirectLevel(4, (6.0, 1.5), (0.0, 0.0), 8),
    DirectLevel(1, (0.7, 0.5), (0.6, 0.4), 24),
)
"""Coarse to fine, for frames of linear levels, whose beams have hard edges."""

LEVELS_CODED = (*LEVELS[:-1], DirectLevel(1, (0.3, 0.3), (0.3, 0.3), 24))
"""Coarse to fine, for frames in decibels and other coded levels: their overlapping beams and pulses smooth them already.

Speckle moves with the ground at all scales, and bodies and shadows only with their relief: sideways errors in speckle are 20
to 40 % smaller than at twice the smoothing. Cubic interpolation would reduce them by another 5 to 20 %, but where a pulse is
shorter than a bin, it would pull motions towards whole bins by 2 to 4 % of one; linear interpolation is free of that.
"""

FAR_MODEL = 1.6
"""Squared errors over the jackknife's covariance, where block heights are estimated.

Measured 90 and 250 mm apart, over rocky fields with a DIDSON and an Oculus, with and without noise, and over a pattern with
and without speckle: 0.6 to 3.3, with a mean of 1.7.
"""

MOST_CELLS = 196_608
"""Largest number of cells registered, four times those of a DIDSON; averaging beams within their width loses nothing."""

FARTHEST = np.array([0.15, 0.15, np.radians(3)])
"""Largest valid distance of a motion from its start. Up to 100 mm and 2 deg it is always found; far beyond is noise."""

CLEARLY_FAR = 1.2
"""Motions this many times farther than :data:`FAR` count as far, whatever the finest level would show."""

FAR, FAR_CODED, FAR_RAD = 0.02, 0.03, float(np.radians(1.5))
"""Motions beyond this fraction of the height, or this turn, are far: relief dominates, and ``phase`` finds missed ones.

In speckle, which also covers the ground between rocks, relief dominates later: at 2.5 % of the height, errors over relief
would be 1.6 times larger. At 4 % the speckle has changed, and covariances over level ground would be too small. Where the
attitude is unknown, motions are far later, too, since registration over relief does not correct it.
"""

ROCKY_FIELD_STEEPNESS = 0.32
"""Squared ratio of height to range over rocky fields. Relief moves less at more grazing angles, as on a plate at 0.3 m."""

START_STD = np.array([0.05, 0.05, np.radians(1)])
"""Standard deviation of a prior that holds a motion at its start, so that noise cannot drive it where frames show little.

Few beams hardly separate sideways motion from yaw. Without this prior, one pair in twenty of hulls in high noise was
off by 0.1 m.
"""

RELIEF_REACH = np.array([0.05, 0.05, np.radians(1)])
"""Largest distance from its start that the registration over relief reaches."""

LEVEL_REACH_STD = 2.0
"""Standard deviations of its smoothing that a level reaches."""

LARGEST_STD = np.array([0.02, 0.02, np.radians(0.5)])
"""Largest standard deviations [m, m, rad] of a valid estimate."""


@dataclass(frozen=True)
class _Task:
    """Two frames to register, with the attitude and the prior."""

    frames: SonarFrames
    images: tuple[Floats, Floats]
    attitude: Attitude
    prior: MotionPrior | None

    @property
    def relief_m(self) -> float:
        """Height [m] from which relief would move as it does here if seen as steeply as on rocky fields."""
        middle_m = float(self.frames.range_m[[0, -1]].mean())
        return max(self.attitude.height_m, ROCKY_FIELD_STEEPNESS * middle_m**2 / self.attitude.height_m)

    @property
    def far_m(self) -> float:
        """Length of a motion beyond which relief dominates its error [m]."""
        known = not any(self.attitude.unsure)
        return (FAR if known and self.frames.level == "linear" else FAR_CODED) * self.relief_m

    @cached_property
    def shadows(self) -> tuple[Floats, Floats] | None:
        """Lengths of the shadows of both frames; None where the frames hold no levels."""
        if self.frames.level == "contrast":
            return None
        linear = self.frames.level == "linear"  # other codings are matched by their fourth roots
        sides = SHADOW_SIDES if linear else SHADOW_SIDES_CODED
        roots = [np.maximum(image, 0) ** np.float32(0.25) if linear else image for image in self.images]
        return shadow_lengths(roots[0], sides), shadow_lengths(roots[1], sides)


@dataclass(frozen=True)
class Direct:
    """Photometric registration with the exact geometry of the sonar over level ground.

    Args:
        height_m: height over the ground, used where the window shows no first echoes; default: that of the frames.
        pitch_rad: default: that of the frames.
        relief_m: mean height of rocks and growth over the ground; default: from the first echoes where the window shows
            them, else 0. An unknown relief scales motions by an error of about its fraction of the height.
        heave_std_m: standard deviation of the rise or fall of the sonar between the frames; 0: none.
        levels: pyramid levels, coarse to fine; default: :data:`LEVELS`, or :data:`LEVELS_CODED` for coded levels.

    Raises:
        MitsonarError: a height that is not positive, or a negative or infinite ``heave_std_m``.
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
        """Estimate the motion and its covariance; reject frames that hold nothing to match.

        Args:
            frames: two frames.
            prior: where to start and how far to search; a motion that contradicts it is rejected. Default: start from zero
                motion. If that finds no motion, or no distinct one, :class:`Phase` finds the start, unless the prior
                shows that the motion is near.

        Returns:
            The estimate; ``start`` of ``about`` is ``zero``, ``prior`` or ``phase``.

        Raises:
            MitsonarError: invalid frames, see :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
        """
        images = two_frames(frames)
        attitude = attitude_of(frames, "direct", self.height_m, self.pitch_rad, self.relief_m)
        if attitude.reason:
            return rejected(attitude.reason)
        task = _Task(*_resolved(frames, images), attitude, prior)
        start = Motion(0.0, 0.0, 0.0) if prior is None else prior.motion
        near = self._estimate_from(task, start, "zero" if prior is None else "prior")
        # lighting over even ground correlates at any motion: a match that is hardly distinct may be far from the true one
        if (near.valid and near.about.get("distinct", True)) or (prior is not None and (3 * prior.std <= FARTHEST).all()):
            return near
        phase_estimate = Phase(self.height_m, self.pitch_rad, self.relief_m).estimate(frames)
        if not phase_estimate.valid or not is_far(phase_estimate.motion, FAR * attitude.height_m):
            return near  # the first registration has already searched near motions
        far = self._estimate_from(replace(task, prior=None), phase_estimate.motion, "phase")
        reason = far.reason or prior_rejection(far.motion, far.covariance, prior)
        return replace(far, valid=not reason, reason=reason)

    def _estimate_from(self, task: _Task, start: Motion, start_name: str) -> Estimate:
        """Register from a start: over level ground while the motion is near, over relief if it is far."""
        if self.heave_std_m:
            return self._over_level(task, start, start_name)
        if not is_far(start, task.far_m):
            near = self._over_level(task, start, start_name, until_far=True)
            if isinstance(near, Motion):
                far = self._over_relief(task, start, near, start_name)
                return far if far.valid else self._over_level(task, start, start_name)
            if not near.valid or not is_far(near.motion, task.far_m):
                return near
            far = self._over_relief(task, start, near.motion, start_name)
            return far if far.valid else near
        if task.prior is not None and (3 * task.prior.std > RELIEF_REACH).any():
            near = self._over_level(task, start, start_name)
            return self._over_relief(task, start, near.motion, start_name) if near.covariance is not None else near
        return self._over_relief(task, start, start, start_name)

    @overload
    def _over_level(self, task: _Task, start: Motion, start_name: str) -> Estimate: ...
    @overload
    def _over_level(self, task: _Task, start: Motion, start_name: str, *, until_far: bool) -> Estimate | Motion: ...
    def _over_level(self, task: _Task, start: Motion, start_name: str, *, until_far: bool = False) -> Estimate | Motion:
        """Register from a start over level ground.

        With ``until_far``, skip the finest level and return the motion alone if it is clearly far.
        """
        v = np.zeros(4 if self.heave_std_m else 3)
        v[:3] = start
        std = START_STD if task.prior is None else np.maximum(START_STD, task.prior.std)
        start_prior = StartPrior(v.copy(), np.append(std, self.heave_std_m)[: len(v)])
        fit = None
        levels, nodes = self._levels(task), GroundNodes(task.frames, task.attitude, heave=bool(self.heave_std_m))
        for number, level in enumerate(levels):
            # coarse to fine; leave out levels too coarse for the frames, and the finest for a clearly far motion
            last = number + 1 == len(levels)
            if not last and not is_resolved(len(task.images[0]), level):
                continue
            if last and until_far and is_far(Motion(*v[:3].tolist()), CLEARLY_FAR * task.far_m):
                return Motion(*v[:3].tolist())
            pair = smoothed(task.images[0], level), smoothed(task.images[1], level)
            cells = Cells(nodes, level, task.shadows)
            registration = register(pair, cells, v, level, last=last, prior=start_prior)
            if registration is None:
                return replace(rejected("nothing in the frames to match"), about={"start": start_name})
            v, fit = registration
        assert fit is not None
        about = {"heave_m": float(v[3])} if self.heave_std_m else {}
        return self._estimate_of_fit(task, start, v[:3], fit, {**about, "start": start_name})

    def _levels(self, task: _Task) -> tuple[DirectLevel, ...]:
        """Return the levels to run; skip those coarser than one that covers the uncertainty of the prior."""
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
            if bins <= LEVEL_REACH_STD * level.smoothing[0] and beams <= LEVEL_REACH_STD * level.smoothing[1]
        ]
        return levels[needed[-1] if needed else 0 :]

    def _over_relief(self, task: _Task, start: Motion, near: Motion, start_name: str) -> Estimate:
        """Register over relief from a nearby motion; the distance of the result is measured from ``start``."""
        registration = registered_over_relief(task.images, task.frames, task.attitude, np.array(near), task.shadows)
        if registration is None:
            return replace(rejected("nothing in the frames to match"), about={"start": start_name})
        return self._estimate_of_fit(task, start, *registration, {"start": start_name})

    def _estimate_of_fit(
        self, task: _Task, start: Motion, v: NDArray[np.float64], fit: Fit, about: dict[str, object]
    ) -> Estimate:
        """Return the estimate with its covariance, rejected if it must not be used."""
        covariance = fit.covariance + fit.by_unknown @ fit.by_unknown.T
        motion = Motion(*(float(x) for x in v))
        reason = _rejection(fit, covariance, v - np.array(start))
        reason = reason or prior_rejection(motion, covariance, task.prior)
        about = {"correlation": fit.correlation, "height_m": task.attitude.height_m, **about, **task.attitude.about}
        if fit.excess != UNMEASURED:
            about["distinct"] = is_distinct(fit.independent, fit.excess)
        if task.attitude.first is not None:
            first_m = task.attitude.first.height_m  # the motion uses a different height over rising ground
            about |= {"height_m": first_m, "height_std_m": STD_MEASURED * first_m}
        return Estimate(motion, covariance, not reason, reason, about)


def _resolved(frames: SonarFrames, images: tuple[Floats, Floats]) -> tuple[SonarFrames, tuple[Floats, Floats]]:
    """Reduce frames to :data:`MOST_CELLS` cells or fewer by averaging bins and beams.

    Beams closer together than their width are averaged first, then the axis with more cells.
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
    trimmed = (image[: rows * along, : columns * across] for image in images)
    image = np.stack([cv2.resize(one, (columns, rows), interpolation=cv2.INTER_AREA) for one in trimmed]).astype(np.float32)
    axes = (frames.range_m, rows, along), (frames.bearing_rad, columns, across)
    range_m, bearing_rad = (axis[: count * size].reshape(count, size).mean(axis=1) for axis, count, size in axes)
    unset_fields: dict[str, Any] = dict.fromkeys((*LABELS, "beam_poses"))
    return replace(frames, image=image, range_m=range_m, bearing_rad=bearing_rad, **unset_fields), (image[0], image[1])


def is_far(motion: Motion, far_m: float) -> bool:
    """Return whether a motion is longer than this [m], or turns farther than :data:`FAR_RAD`."""
    return bool(np.hypot(motion.sideways, motion.forward) > far_m or abs(motion.yaw) > FAR_RAD)


def _rejection(fit: Fit, covariance: NDArray[np.float64], from_start: NDArray[np.float64]) -> str:
    """Return why an estimate is rejected, given its distance from the start; empty if it is valid."""
    std = np.sqrt(np.diag(covariance))
    if not fit.converged:
        return "the iteration did not settle"
    mismatch = correlation_rejection(fit.correlation, fit.independent, fit.excess)
    if mismatch:
        return mismatch
    if (np.abs(from_start) > FARTHEST).any():
        return "a motion beyond 150 mm or 3 deg of its start is farther than the coarsest level searches"
    if fit.blocks < FEWEST_BLOCKS:
        return "too small a part of the frames holds anything to match"
    if not (std < LARGEST_STD).all():
        return f"standard deviations of {1e3 * std[0]:.1f}, {1e3 * std[1]:.1f} mm, {np.degrees(std[2]):.2f} deg"
    return ""


# ---------------- Far motions over relief

Pair = tuple[Floats, Floats]

RELIEF_LEVELS = (
    DirectLevel(4, (6.0, 1.5), (0.0, 0.0), 6),
    DirectLevel(2, (2.0, 0.8), (0.0, 0.0), 6),
    DirectLevel(1, (0.3, 0.3), (0.3, 0.3), 12),
)
"""Coarse to fine: the first reaches 50 mm and 1 deg from the start; the last is finer than that of near motions."""

RELIEF_BLOCK = (32, 12)
"""Bins and beams that share one height."""

CORRELATED_BLOCKS = (1, 2)
"""Blocks along bins and beams whose errors are correlated."""

RELIEF_STD = 0.048
"""Standard deviation of a block's height, as a fraction of the sonar's: 0.12 m at 2.5 m."""

ILLUMINATION = (12.0, 4.0)
"""Bins and beams beyond which brightness variations come from the sonar, which moves, and not from the ground."""

CORRELATED_RESIDUALS = 20.0
"""Residuals that count as one: those of a block err together where its ground deviates from the model."""

PAIRS = tuple((k, right) for k in range(4) for right in range(k, 4))
"""Pairs of motion and height whose products are the upper half of a symmetric matrix."""

SETTLED = np.array([3e-4, 3e-4, 6e-5])
"""Steps below which an iteration ends [m, m, rad]: a fifth of the error that remains over relief."""

LARGEST_HEIGHT_STEP = 0.06
"""Largest change of a height in one iteration, as a fraction of the sonar's height."""

DERIVATIVE_STEPS = (2e-3, 2e-3, 5e-4, 0.04)
"""Steps of numerical derivatives [m, m, rad], and of the height as a fraction of the sonar's: 0.1 m at 2.5 m."""


class _Equations(NamedTuple):
    """Normal equations of motion and block heights.

    Attributes:
        normal: of the motion, from each block ``(3, 3, blocks)``.
        cross: cross terms of motion and heights ``(3, blocks)``.
        height: diagonal term of each block's height ``(blocks,)``.
        gradients: gradient by the motion, from each block ``(3, blocks)``.
        height_gradient: gradient by each height ``(blocks,)``.
        noise: variance of the residuals, times the number of residuals that count as one.
        correlation: of the first frame and the second, resampled.
        cells: number of cells used.
    """

    normal: NDArray[np.float64]
    cross: NDArray[np.float64]
    height: NDArray[np.float64]
    gradients: NDArray[np.float64]
    height_gradient: NDArray[np.float64]
    noise: float
    correlation: float
    cells: int

    def without_heights(
        self, prior: float, height_offsets: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return normal matrix ``(3, 3)`` and gradient ``(3,)`` of the motion; heights are eliminated (Schur complement).

        Args:
            prior: information of each height [1/m^2].
            height_offsets: heights minus their prior mean ``(blocks,)`` [m].
        """
        normal = self.reduced_normals(prior).sum(axis=-1)
        return normal, self.reduced_gradients(prior, height_offsets).sum(axis=1)

    def reduced_normals(self, prior: float) -> NDArray[np.float64]:
        """Return each block's normal matrix of the motion, its height eliminated ``(3, 3, blocks)``."""
        return self.normal - self.cross[:, None] * self.cross / (self.height + self.noise * prior)

    def reduced_gradients(self, prior: float, height_offsets: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return each block's gradient by the motion, its height eliminated ``(3, blocks)``; see :meth:`without_heights`."""
        height_steps = (self.height_gradient + self.noise * prior * height_offsets) / (self.height + self.noise * prior)
        return self.gradients - self.cross * height_steps


class _ResampledFrame(NamedTuple):
    """One frame resampled at the cells of the other, as maps ``(bins, beams)``.

    Attributes:
        before: levels of the first frame.
        after: levels of the second frame.
        inside: which cells count.
        slopes: slopes over bins and over beams.
        jacobian: derivatives of the residual by motion and height ``(4, bins, beams)``.
        weighted: the same times the weights.
        scale: standard deviation of the residuals.
        shown: row and column of each cell in the frame to which the blocks belong; None: it is this frame.
    """

    before: Floats
    after: Floats
    inside: NDArray[np.bool_]
    slopes: tuple[Floats, Floats]
    jacobian: Floats
    weighted: Floats
    scale: float
    shown: tuple[Floats, Floats] | None


class _ReliefLevel:
    """One pyramid level: its frames, its cells, and the derivatives at the motion with which it begins."""

    def __init__(
        self, images: Pair, nodes: GroundNodes, v: NDArray[np.float64], level: DirectLevel, shadows: Pair | None
    ) -> None:
        self.level = level
        self.nodes, self.cells = nodes, Cells(nodes, level, shadows)
        slow = ILLUMINATION[0] / level.step, ILLUMINATION[1]
        self.images = tuple(one - blurred(one, *slow) for one in (smoothed(image, level) for image in images))
        self.shape = self.images[0].shape
        self.block = max(1, RELIEF_BLOCK[0] // level.step), RELIEF_BLOCK[1]
        self.blocks = cell_blocks(self.shape, self.block)
        steps = np.array([*DERIVATIVE_STEPS[:3], DERIVATIVE_STEPS[3] * nodes.attitude.height_m])
        self.sides = [self.cells.derivatives(v, steps, back=back) for back in (False, True)]  # (4, 2, bins, beams) each
        self.mean = self._mean(nodes.frames, nodes.attitude)

    def _mean(self, frames: SonarFrames, attitude: Attitude) -> NDArray[np.float64]:
        """Return the prior mean of the heights ``(blocks,)`` [m]: level ground, as far as the fan illuminates it.

        Echoes from nearer than the fan meets level ground come from above it, and echoes from beyond come from below.
        """
        half = np.radians(frames.sonar.elevation_fov_deg) / 2
        middle = by_block(self.cells.grid.range_m[:, None], (self.block[0], 1)) / by_block(
            np.ones((self.shape[0], 1)), (self.block[0], 1)
        )
        low, high = (attitude.height_m - middle * np.sin(attitude.pitch_rad + sign * half) for sign in (1, -1))
        return np.repeat(np.clip(0.0, low, np.maximum(low, high)), self.blocks[1])

    def equations(self, v: NDArray[np.float64], heights: NDArray[np.float64]) -> _Equations | None:
        """Return the normal equations at a motion and heights; None where too few cells remain."""
        sides = self._resample(v, heights)
        if sides is None:
            return None
        first = sides[0]
        sums = (self._block_sums(side, side.after - side.before) for side in sides)
        total = np.sum(list(sums), axis=0)  # motion-motion, motion-residual, height-motion, height-height, height-residual
        by_motion, cross, height = total[:12].reshape(3, 4, -1), total[12:15], total[15:]
        correlation = correlation_of(first.before[first.inside], first.after[first.inside])
        return _Equations(
            by_motion[:, :3],
            cross,
            height[0],
            by_motion[:, 3],
            height[1],
            CORRELATED_RESIDUALS * first.scale**2,
            correlation,
            int(first.inside.sum()),
        )

    def gradients_by_lean(self, v: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of all gradients by :meth:`GroundNodes.leaning_shift` ``(5, 4, blocks)``."""
        sides, shifts = self._resample(v, heights), self.cells.leaning_shift_of_cells(v)
        assert sides is not None
        sums = [
            np.sum([self._block_sums(side, side.slopes[0] * bins + side.slopes[1] * beams) for side in sides], axis=0)
            for bins, beams in shifts
        ]
        return np.stack(sums)[:, [3, 7, 11, 16]]

    def _resample(self, v: NDArray[np.float64], heights: NDArray[np.float64]) -> list[_ResampledFrame] | None:
        """Resample each frame at the cells of the other; return None where too few cells remain."""
        relief = on_cells(heights.reshape(self.blocks), self.shape, self.block)
        scale, resampled = 0.0, []
        for back, derivatives in zip((False, True), self.sides, strict=True):
            # displace the cells by the motion, then by the height of their block, which belongs to the first frame
            level_shift = self.cells.shift(v, back=back)
            lift = relief if not back else sampled(relief, *self._places(level_shift))
            row, column = self._places(level_shift + derivatives[3] * lift)
            inside = self._inside(row, column)
            if inside.sum() < FEWEST_CELLS:
                return None
            # both residuals are second minus first, so that they share one scale and one sign
            warped = sampled(self.images[0 if back else 1], row, column)
            before, after = (warped, self.images[1]) if back else (self.images[0], warped)
            residual = after - before
            if not back:
                scale = noise_of(residual[inside][::5])
            # slopes of the mean of both frames times the derivatives of the displacement give the Jacobian
            weight = cauchy(residual, scale) * inside
            slopes = slopes_of((before + after) * np.float32(0.5), self.level, scale)
            jacobian = (slopes[0] * derivatives[:, 0] + slopes[1] * derivatives[:, 1]) * np.float32(-1 if back else 1)
            shown = self._places(level_shift) if back else None  # blocks belong to the first frame
            resampled.append(_ResampledFrame(before, after, inside, slopes, jacobian, jacobian * weight, scale, shown))
        return resampled

    def _block_sums(self, side: _ResampledFrame, residual: Floats) -> NDArray[np.float64]:
        """Return sums over blocks ``(17, blocks)``: motion by motion, motion by residual, height by all."""
        jacobian, weighted = side.jacobian, side.weighted
        pairs = [(weighted[k], right) for k in range(3) for right in jacobian[k:3]]  # the other half is symmetric
        pairs += [(weighted[k], residual) for k in range(3)]
        pairs += [(weighted[3], right) for right in (*jacobian, residual)]
        sums = self._sums(side, pairs)
        # restore the full rows from the symmetric half
        return np.asarray(sums[[0, 1, 2, 6, 1, 3, 4, 7, 2, 4, 5, 8, *range(9, 14)]])

    def _sums(self, side: _ResampledFrame, pairs: list[tuple[Floats, Floats]]) -> NDArray[np.float64]:
        """Return sums of products of maps over blocks ``(products, blocks)``."""
        if side.shown is None:
            return products_by_block(pairs, self.block)
        place = [
            np.clip(where // edge, 0, count - 1).astype(np.intp)
            for where, edge, count in zip(side.shown, self.block, self.blocks, strict=True)
        ]
        number = (place[0] * self.blocks[1] + place[1]).ravel()
        count = self.blocks[0] * self.blocks[1]
        return np.stack([np.bincount(number, (a * b).ravel(), minlength=count) for a, b in pairs])

    def without_noise(self, equations: _Equations, prior: float, v: Doubles, heights: Doubles) -> _Equations | None:
        """Return equations whose second derivatives hold no noise of the slopes, if they still determine the motion.

        None where too few cells remain.

        Slopes of one frame, as the gradient uses them, times those of the other, whose noise is independent. Outliers count
        with the derivative of weight times residual, which is negative.
        """
        sides, total = self._resample(v, heights), np.zeros((len(PAIRS), len(heights)))
        if sides is None:
            return None
        for side, derivatives in zip(sides, self.sides, strict=True):
            weight = cauchy(side.after - side.before, side.scale)
            weight *= np.float32(0.25) * (2 * weight - 1) * side.inside
            frames, middle = (side.before, side.after), (side.before + side.after) * np.float32(0.5)
            products = np.zeros((len(PAIRS), *self.shape), np.float32)
            for used, seen in (frames, frames[::-1]):
                slopes = slopes_of(used, self.level, side.scale, like=middle), central_differences(seen)
                one, other = (by[0] * derivatives[:, 0] + by[1] * derivatives[:, 1] for by in slopes)
                products += [one[k] * other[right] + one[right] * other[k] for k, right in PAIRS]
            total += self._sums(side, [(weight, product) for product in products])
        # a block whose height the frames do not share keeps its prior height
        shared = total[9] > 0
        normal = total[[0, 1, 2, 1, 4, 5, 2, 5, 7]].reshape(3, 3, -1)
        clean = equations._replace(normal=normal, cross=total[[3, 6, 8]] * shared, height=total[9] * shared)
        return clean if np.linalg.eigvalsh(clean.reduced_normals(prior).sum(axis=-1))[0] > 0 else equations

    def _places(self, shift: Floats) -> tuple[Floats, Floats]:
        """Return rows and columns of displaced cells."""
        return self.cells.row + shift[0], self.cells.column + shift[1]

    def _inside(self, row: Floats, column: Floats) -> NDArray[np.bool_]:
        """Return which cells meet ground that both frames show ``(bins, beams)``."""
        bins, beams = self.shape
        inside = (row >= 1) & (row <= bins - 2) & (column >= 1) & (column <= beams - 2)
        inside[: max(1, self.cells.usable.start)] = False
        inside[-1], inside[:, 0], inside[:, -1] = False, False, False
        return inside if self.cells.seen is None else np.asarray(inside & (self.cells.seen > 0), dtype=np.bool_)


def registered_over_relief(
    images: Pair,
    frames: SonarFrames,
    attitude: Attitude,
    start: NDArray[np.float64],
    shadows: Pair | None = None,
) -> tuple[NDArray[np.float64], Fit] | None:
    """Register two frames over relief from a start near the motion; return None if there is nothing to match.

    A rock of 0.3 m seen from 2.5 m moves 10 % more or less than level ground: 20 mm of a motion of 200 mm. Over motions of
    20 mm that is lost among the bins; over far motions it is most of the error. Each block of cells therefore has a height
    with a Gaussian prior. The heights are eliminated block by block (Schur complement), so that a step costs as much as one
    without them. Cells are left out one by one where the other frame does not show them: a turn of 6 deg hides a fifth of a
    narrow fan.

    Args:
        images: both frames ``(bins, beams)`` in 0..1.
        frames: the same frames, with their axes.
        attitude: of the sonar; its height is that over the mean of the visible ground.
        start: sideways, forward [m], yaw [rad] ``(3,)``.
        shadows: lengths of the shadows of both frames, see :func:`~mitsonar.estimation.image.registration.shadow_lengths`.

    Returns:
        The motion ``(3,)`` and its fit, whose derivative by height is that by the mean of the heights.
    """
    v, heights, shape = np.asarray(start, dtype=np.float64), None, (0, 0)
    prior = 1 / (RELIEF_STD * attitude.height_m) ** 2
    equations, converged = None, False
    nodes = GroundNodes(frames, attitude, heave=False)
    for number, level in enumerate(RELIEF_LEVELS):
        if number + 1 < len(RELIEF_LEVELS) and not is_resolved(len(images[0]), level):
            continue
        relief_level = _ReliefLevel(images, nodes, v, level, shadows)
        # heights of the coarser level, resampled to the blocks of this one
        if heights is not None:
            table = heights.reshape(shape).astype(np.float32)
            heights = cv2.resize(table, relief_level.blocks[::-1]).ravel().astype(np.float64)
        heights, shape = relief_level.mean.copy() if heights is None else np.asarray(heights), relief_level.blocks
        for _ in range(level.iterations):
            # Gauss-Newton step of the motion with the heights eliminated
            equations = relief_level.equations(v, heights)
            if equations is None:
                return None
            normal, gradient = equations.without_heights(prior, heights - relief_level.mean)
            if np.linalg.eigvalsh(normal)[0] <= 0:
                return None
            step = -np.linalg.solve(normal, gradient)
            # back-substitute the heights; limit their change, since the slopes are valid over short distances only
            height_normal = equations.height + equations.noise * prior
            change = (
                -(
                    equations.height_gradient
                    + equations.noise * prior * (heights - relief_level.mean)
                    + equations.cross.T @ step
                )
                / height_normal
            )
            largest_change = LARGEST_HEIGHT_STEP * attitude.height_m
            v, heights = v + step, heights + np.clip(change, -largest_change, largest_change)
            converged = bool((np.abs(step) < SETTLED).all())
            if converged:
                break
    assert equations is not None
    assert heights is not None
    equations = relief_level.without_noise(equations, prior, v, heights)
    if equations is None:
        return None
    return v, _assessed(equations, prior, v, heights, relief_level, converged=converged)


def _assessed(
    equations: _Equations, prior: float, v: Doubles, heights: Doubles, level: _ReliefLevel, *, converged: bool
) -> Fit:
    """Return the fit: covariance, and sensitivity to the mean height and to differences of height, pitch and roll.

    The covariance is the jackknife's over blocks, whose gradients include all errors common to a block: noise, speckle,
    relief.
    """
    # motion per gradient, with the heights eliminated
    normals, gradients = equations.reduced_normals(prior), equations.reduced_gradients(prior, heights - level.mean)
    normal = normals.sum(axis=-1)
    inverse = np.linalg.inv(normal)
    # the change without each of the blocks gives the covariance; where one holds all information, it is very large
    left_out, pulls = (
        by_block(values.reshape(*values.shape[:-1], *level.blocks), CORRELATED_BLOCKS) for values in (normals, gradients)
    )
    remaining = normal[..., None] * (1 + 1e-9) - left_out
    changes = np.linalg.solve(np.moveaxis(remaining, -1, 0), pulls.T[..., None])[..., 0]
    prior_weight = equations.noise * prior
    # far motions also match the ground between rocks, since rocks look different from elsewhere
    attitude, prior_weight = level.nodes.attitude, equations.noise * prior
    height_std = float(np.hypot(attitude.height_std_m, attitude.tops_m))
    by_unknown = [inverse @ (equations.cross @ (prior_weight / (equations.height + prior_weight))) * height_std]
    if any(attitude.unsure):
        # these differences change the gradients of both motion and heights; eliminate the heights as above
        lean = level.gradients_by_lean(v, heights)
        reduced = lean[:, :3] - equations.cross * (lean[:, 3:] / (equations.height + prior_weight))
        by_unknown += list(attitude.lean_std[:, None] * (reduced.sum(axis=-1) @ inverse))
    return Fit(
        converged=converged,
        covariance=np.asarray(FAR_MODEL * (changes.T @ changes), dtype=np.float64),
        by_unknown=np.stack(by_unknown, axis=1),
        correlation=equations.correlation,
        independent=equations.cells / correlated_cells(level.level),
        blocks=spread_of(equations.height),
    )
