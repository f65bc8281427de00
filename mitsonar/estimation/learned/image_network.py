"""The estimator that a checkpoint is: a trained network between two frames and a motion, with checks of the result."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mitsonar.datasets.arrangement import Arrangement
from mitsonar.datasets.samples import ground_of, light_of
from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import (
    LEAST_AT_BEST,
    Estimate,
    ambiguity,
    blank,
    correlation_excess,
    correlation_of,
    matching_rejection,
    rejected,
    two_frames,
    without_slow,
)
from mitsonar.estimation.image.phase import Phase
from mitsonar.estimation.learned.trained_network import BEYOND, Trained, TrainedInstrument, answer_of, one_thread
from mitsonar.estimation.prior_gate import prior_rejection
from mitsonar.geometry.ground import STD_MEASURED, Attitude, attitude_of
from mitsonar.instruments.sounder import sonar_from
from mitsonar.motion.composition import Motion, MotionPrior, inverse
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.networks.corrnet import GaussianHead, Ground, WarpGrid
from mitsonar.records.frames import SonarFrames

__all__ = ["ImageNetwork"]

Pair = tuple[NDArray[np.float32], NDArray[np.float32]]

SMOOTH = (2.0, 0.8)
"""Standard deviations of the filter before frames are matched [bins, beams]."""


class Comparison(NamedTuple):
    """How frames are compared that an answer has brought together: bins of a cell, smoothing [bins, beams]."""

    cell: int
    smoothing: tuple[float, float]

    @property
    def alike(self) -> float:
        """Return how many neighbouring cells count as one."""
        return 4 * math.pi * math.hypot(self.smoothing[0] / self.cell, 12**-0.5) * self.smoothing[1]


COMPARISONS = (Comparison(4, SMOOTH), Comparison(1, (0.7, 0.5)))
"""The second only where the first finds nothing: fine texture shows in noise that hides what is coarse."""

BLOCK = 16
"""Such cells and beams of the blocks over which what is matched must be spread."""

NOISY = 0.83
"""Correlation of matched frames below which noise shortens the network's steps, so that it goes on from its answer.

Without noise hulls have 0.84 and more, rocky fields 0.95; in high noise they have 0.82 and less, and 0.75 to 0.91. With 0.75
six of 200 pairs of hulls in high noise stopped short: squared errors of 8 to 44 times the covariance.
"""

OTHER_FAN = 1.5
"""Fans so many times wider or narrower than that of training are reported."""

FAR_MODEL = 4.0
"""Squared errors over the network's covariance for motions far beyond training, measured on rocky fields."""


@dataclass(init=False, eq=False)
class ImageNetwork(Trained):
    """A trained network.

    Args:
        checkpoint: of it; it must take two frames of one view.
        force: go on with another sonar than that of training.
        height_m: over the ground, where the window shows no first echoes; only for networks that know the geometry, as
        pitch_rad: is, and
        relief_m: mean height over the ground of what is seen.

    Raises:
        MitsonarError: a checkpoint that needs something else than two frames of one view, that does not fit its network, or
            whose geometry is fixed by training but given here.
    """

    height_m: float | None
    pitch_rad: float | None
    relief_m: float | None

    @property
    def consumes(self) -> type:
        """Return the class of records that it reads."""
        return SonarFrames

    def __init__(
        self,
        checkpoint: Checkpoint,
        *,
        force: bool = False,
        height_m: float | None = None,
        pitch_rad: float | None = None,
        relief_m: float | None = None,
    ) -> None:
        self._check_input(checkpoint)
        if not checkpoint.arrangement["ground"] and any(value is not None for value in (height_m, pitch_rad, relief_m)):
            raise MitsonarError(f"this {checkpoint.network} is given no geometry: {checkpoint.fixed} are fixed by training")
        self.force, self.height_m, self.pitch_rad, self.relief_m = force, height_m, pitch_rad, relief_m
        self._take(checkpoint)

    def _check_input(self, checkpoint: Checkpoint) -> None:
        """Whether the network reads what an estimator has."""
        words = checkpoint.arrangement
        if words["frames"] != 2 or len(words["views"]) != 1:
            raise MitsonarError(
                f"an estimator has two frames of one view: this {checkpoint.network} is given {words['frames']} frames of "
                f"{', '.join(words['views'])} as {words['kind']}s; use `mitsonar odometry` on a data set that holds them, "
                "`mitsonar evaluate`, or another checkpoint"
            )

    def estimate(self, frames: SonarFrames, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion and its covariance.

        A network that is given the geometry begins at a prior, and else at no motion. Where that fails, and nothing tells
        that the motion is near, :class:`~mitsonar.estimation.image.phase.Phase` finds the start. Other networks ignore a
        prior.

        Args:
            frames: two.
            prior: where to start; a motion that contradicts it is rejected.

        Returns:
            The estimate; ``start`` of ``about`` is ``zero``, ``prior`` or ``phase``.

        Raises:
            MitsonarError: not two frames, another sonar than that of training, frames without what the network needs.
        """
        images = two_frames(frames)
        for view in self._trained:
            self._check_instrument(view, TrainedInstrument.in_frames(frames.sonar, frames.range_m, frames.bearing_rad))
        if any(blank(image) for image in images):
            return rejected("nothing in the frames to match")
        attitude = self._attitude_of(frames)
        if attitude is not None and attitude.reason:
            return rejected(attitude.reason)
        if attitude is None:
            return self._from(frames, images, {}, None)
        ground = _batch({**ground_of(frames, attitude), **light_of(frames, attitude)})
        found = self._from(frames, images, ground, None if prior is None else prior.motion)
        if found.covariance is not None and _correlation_of_answer(images, ground, found.motion) < NOISY:
            found = self._again(frames, images, ground, found)
        found = self._judged(frames, found, prior, "zero" if prior is None else "prior", attitude, ground)
        doubtful = found.valid and _correlation_of_answer(images, ground, found.motion) < LEAST_AT_BEST
        is_near = prior is not None and not self._rejection_of_size(Motion(*(3 * prior.std)))
        if is_near or (found.valid and not doubtful):
            return found
        elsewhere = Phase(self.height_m, self.pitch_rad, self.relief_m).estimate(frames)
        if not elsewhere.valid or not self._rejection_of_size(elsewhere.motion):
            return found  # a motion nearby has been looked for
        second = self._from(frames, images, ground, elsewhere.motion)
        if self._rejection_of_size(second.motion, elsewhere.motion):  # phase errs by more than training's motions
            second = self._from(frames, images, ground, second.motion)
        second = self._judged(frames, second, prior, "phase", attitude, ground)
        if doubtful and (not second.valid or _correlation_of_answer(images, ground, second.motion) < LEAST_AT_BEST):
            return found
        return second

    def _judged(
        self,
        frames: SonarFrames,
        found: Estimate,
        prior: MotionPrior | None,
        named: str,
        attitude: Attitude,
        ground: Ground,
    ) -> Estimate:
        """Return an estimate that names its start, with the covariance of motions beyond training where it is one.

        Heights less certain than those of training join it, and unknown heave, pitch and roll. It is rejected where it
        contradicts a prior.
        """
        covariance = found.covariance
        if covariance is not None:
            covariance = FAR_MODEL * covariance if self._rejection_of_size(found.motion) else covariance
            unsure = (attitude.height_std_m / attitude.height_m) ** 2 - STD_MEASURED**2
            if unsure > 0:
                by_height = _by_height(ground, found.motion)
                covariance = covariance + unsure * np.outer(by_height, by_height)
            covariance = attitude.widened(covariance, frames)
        reason = found.reason or prior_rejection(found.motion, covariance, prior)
        return replace(
            found,
            covariance=covariance,
            valid=not reason,
            reason=reason,
            about={**found.about, **attitude.about, **self._untrained(frames), "start": named},
        )

    @cached_property
    def _fan_deg(self) -> float:
        """Return the field of view in azimuth of the data that trained the network [deg]."""
        trained = sonar_from(dict(self._checkpoint.data_recipe["sonar"]))
        return TrainedInstrument.of(trained).azimuth_fov_deg

    def _untrained(self, frames: SonarFrames) -> dict[str, str]:
        """Return what an estimate must report of frames unlike those of training, of a network that takes any sonar."""
        found = []
        if frames.sonar.model == "coherent" and "coherent" not in self._checkpoint.model:
            found.append("speckle")
        has = TrainedInstrument.in_frames(frames.sonar, frames.range_m, frames.bearing_rad)
        if abs(math.log(has.azimuth_fov_deg / self._fan_deg)) > math.log(OTHER_FAN):
            found.append(f"a fan of {has.azimuth_fov_deg:.3g} deg (but {self._fan_deg:.3g})")
        return {"untrained": f"{self._checkpoint.network} was not trained for {' or '.join(found)}"} if found else {}

    def _from(self, frames: SonarFrames, images: Pair, ground: Ground, start: Motion | None) -> Estimate:
        """Estimate the motion from a start of the network's iterations; None: no motion."""
        with torch.inference_mode(), one_thread():
            targets, covariances = self._checkpoint.decode(self._answer(frames, images, ground, start))
        if not np.isfinite(targets).all():
            return rejected("the network's answer is not finite")
        if targets.shape[1] != 3:
            raise MitsonarError(f"a motion has three numbers: this {self._checkpoint.network} says {targets.shape[1]}")
        if covariances is not None and not _is_covariance(covariances[0]):
            return rejected("the network's covariance is not positive: images unlike those of its training")
        motion = Motion(*targets[0].tolist())
        covariance = self._checkpoint.covariance if covariances is None else covariances[0]
        reason = self._rejection_of_geometry(frames) or self._rejection_of_size(motion, start)
        if not reason:
            reason = _rejection_of_answer(images, ground, motion) if ground else self._rejection_of_match(frames, images)
        return Estimate(motion, covariance, not reason, reason)

    def _again(self, frames: SonarFrames, images: Pair, ground: Ground, first: Estimate) -> Estimate:
        """Estimate once more, from an answer that noise may have held back, and back from the second frame.

        The mean of both ways counts. How far the answers go and how far they lie apart is not known better.
        """
        found = self._from(frames, images, ground, first.motion)
        if found.covariance is None:
            return found
        motion, apart = self._both_ways(frames, images, found.motion)
        went = np.array(found.motion) - np.array(first.motion)
        fine = COMPARISONS[-1]
        one, other, inside = _brought_together(images, ground, motion, fine)
        excess = correlation_excess(one, other, inside, BLOCK // 2).mean
        unsure = ambiguity(excess, inside.sum() / fine.alike)
        reason = found.reason or self._rejection_of_size(motion)
        covariance = unsure * found.covariance + np.outer(went, went) + np.outer(apart, apart) / 2
        return Estimate(motion, covariance, not reason, reason, found.about)

    def _both_ways(self, frames: SonarFrames, images: Pair, there: Motion) -> tuple[Motion, NDArray[np.float64]]:
        """Return the mean of a motion and of that from the second frame to the first, and how far they lie apart."""
        swapped = frames.select(np.array([1, 0]))
        attitude = self._attitude_of(swapped)
        if attitude is None or attitude.reason:
            return there, np.zeros(3)
        ground = _batch({**ground_of(swapped, attitude), **light_of(swapped, attitude)})
        back = self._from(swapped, images[::-1], ground, Motion(*inverse(np.array(there)).tolist()))
        if back.covariance is None:
            return there, np.zeros(3)
        apart = inverse(np.array(back.motion)) - np.array(there)
        return Motion(*(np.array(there) + apart / 2).tolist()), apart

    def _attitude_of(self, frames: SonarFrames) -> Attitude | None:
        """Height and pitch, for a network that is given them."""
        if not self._checkpoint.arrangement["ground"]:
            return None
        return attitude_of(frames, self._checkpoint.network, self.height_m, self.pitch_rad, self.relief_m)

    def _answer(self, frames: SonarFrames, images: Pair, ground: Ground, start: Motion | None) -> Tensor | GaussianHead:
        """Return the answer of the network, a batch of one."""
        (view,) = self._checkpoint.arrangement["views"]
        inputs = self._arrangement(frames)({view: torch.from_numpy(np.stack(images)[None])}, torch.arange(2)[None], 0)
        if not ground:
            return answer_of(self._network, inputs)
        image = cast(Tensor, inputs)  # networks that are given the ground read one image
        if start is None:
            return answer_of(self._network, (image, ground))
        return answer_of(self._network, (image, ground, torch.tensor([start], dtype=torch.float32)))

    def _arrangement(self, frames: SonarFrames) -> Arrangement:
        """From the frames to the network's input."""
        (view,) = self._checkpoint.arrangement["views"]
        return self._arranged({view: (frames.range_m, frames.bearing_rad)})

    # ---------------------------------------------------------------- rejections

    def _rejection_of_match(self, frames: SonarFrames, images: Pair) -> str:
        """Whether the frames show one place at all: they must be alike once shifted, as far as training's motions go."""
        first, second = (smooth(image, Comparison(1, SMOOTH)) for image in images)
        size = first.shape
        rows, columns = (min(reach, length // 3) for reach, length in zip(self._reach(frames), size, strict=True))
        middle = second[rows : size[0] - rows, columns : size[1] - columns]
        found = cv2.matchTemplate(without_slow(first, 32), without_slow(middle, 32), cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(found.argmax()), found.shape)
        there = first[row : row + middle.shape[0], column : column + middle.shape[1]]
        inside = np.ones(middle.shape, dtype=bool)
        return matching_rejection(there, middle, inside, alike=4 * math.pi * SMOOTH[0] * SMOOTH[1])

    def _reach(self, frames: SonarFrames) -> tuple[int, int]:
        """How far an echo can move between frames in bins and in beams, by the motions of training."""
        coder = self._checkpoint.coder
        sideways, forward, yaw = BEYOND * np.maximum(np.abs(coder.low), np.abs(coder.high))
        bin_m, beam_rad = (float(np.median(np.diff(axis))) for axis in (frames.range_m, frames.bearing_rad))
        outward = forward + sideways * math.sin(min(math.pi / 2, np.abs(frames.bearing_rad).max()))
        across = yaw + sideways / frames.range_m[0]
        return 2 + int(outward / bin_m), 2 + int(across / beam_rad)


def _batch(table: dict[str, NDArray[np.float32]]) -> Ground:
    """Return tensors of a batch of one."""
    return {name: torch.from_numpy(values)[None] for name, values in table.items()}


def _by_height(ground: Ground, motion: Motion) -> NDArray[np.float64]:
    """Return the derivative of an estimated motion by the height, as a part of it: other motions explain the same shifts."""
    lit = ground["lit"][0].numpy() >= 0 if "lit" in ground else np.ones(ground["derivative"].shape[-2:], dtype=bool)
    here, lower = (ground[name][0].numpy()[..., lit] for name in ("derivative", "by_relief"))
    change = np.tensordot(np.array(motion), lower, axes=(0, 1))
    return np.asarray(np.linalg.lstsq(np.moveaxis(here, 1, -1).reshape(-1, 3), change.ravel(), rcond=None)[0])


def _rejection_of_answer(images: Pair, ground: Ground, motion: Motion) -> str:
    """Whether the frames are alike once the second is drawn where the answer takes what the first shows."""
    coarse, fine = COMPARISONS
    reason = _mismatch(images, ground, motion, coarse)
    if reason and _correlation_of_answer(images, ground, motion) < LEAST_AT_BEST:
        return reason if _mismatch(images, ground, motion, fine) else ""
    return reason


def _mismatch(images: Pair, ground: Ground, motion: Motion, comparison: Comparison) -> str:
    """Return why the frames that an answer has brought together do not match; empty where they do."""
    first, second, inside = _brought_together(images, ground, motion, comparison)
    return matching_rejection(first, second, inside, alike=comparison.alike, block=BLOCK, aside=BLOCK // 2)


def _correlation_of_answer(images: Pair, ground: Ground, motion: Motion) -> float:
    """Return the correlation of the frames that an answer has brought together."""
    first, second, inside = _brought_together(images, ground, motion, COMPARISONS[0])
    return correlation_of(without_slow(first, BLOCK)[inside], without_slow(second, BLOCK)[inside])


def _brought_together(
    images: Pair, ground: Ground, motion: Motion, comparison: Comparison
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Return the first frame, the second one drawn at its cells, and which cells both show."""
    rows, beams = images[0].shape[0] // comparison.cell, images[0].shape[1]
    means = (image[: rows * comparison.cell].reshape(rows, comparison.cell, beams).mean(axis=1) for image in images)
    first, second = (smooth(mean, comparison) for mean in means)
    warp_grid = WarpGrid(ground, torch.ones(1, 3), (comparison.cell, 1), images[0].shape, first.shape, None)
    back, inside = warp_grid.draw(torch.from_numpy(second)[None, None], torch.tensor([motion]))
    return first, back[0, 0].numpy(), inside[0].numpy() > 0


def smooth(image: NDArray[np.float32], comparison: Comparison) -> NDArray[np.float32]:
    """With less noise."""
    bins, beams = comparison.smoothing
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigmaX=beams, sigmaY=bins / comparison.cell), dtype=np.float32)


def _is_covariance(matrix: NDArray[np.float64]) -> bool:
    """Return whether a matrix ``(3, 3)`` is finite, symmetric and not negative, as a series of motions asks."""
    if not np.isfinite(matrix).all() or np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max():
        return False
    least, _, largest = np.linalg.eigvalsh(matrix)
    return bool(least >= -1e-9 * largest)
