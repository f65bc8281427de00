"""How the estimator ``direct6`` finds all six degrees of freedom of a pose or of a motion in a known scene.

The scene is known: its shapes, its reflectivities and the noise of the pixels, as for the Cramer-Rao bound
(:mod:`mitsonar.estimation.crlb.image`). A renderer gives the expected frame at the assumed pose and its derivatives by the
motion, and a Gauss-Newton step of the whitened differences corrects the pose. Each frame is registered by itself; the motion
between two frames is that between their poses, with the covariance of both.

Steps of the derivatives go from large to small. A difference over a large step is the derivative of an image that is
smoothed over as large a motion, which finds poses that are farther off; details that it smooths away count as noise.

The assumed pose has a Gaussian error of given size. Directions that the frame cannot show
(:mod:`mitsonar.estimation.crlb.observability`) stay as they were assumed, with that variance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NOISE_MODELS, NoiseModel, expected_values
from mitsonar.errors import MitsonarError
from mitsonar.estimation.crlb.image import Bound, balanced_steps, fisher, pixel_terms
from mitsonar.estimation.crlb.observability import Observability, observability
from mitsonar.motion.composition import DEGREES, MotionStd, compose_six, six_between
from mitsonar.motion.pose import Pose
from mitsonar.simulation.derivatives import FIRST_PING, Derivative, differentiate, jittered, steps_for
from mitsonar.simulation.simulator import Simulator

__all__ = ["Direct6", "RegisteredPose", "SixMotion"]


NAMES = tuple(DEGREES)

GREYS = 255

COARSE = (1.0, 0.25)
"""Steps of the coarse derivatives, as a fraction of the standard deviations of the assumed pose."""

FINE = (None, None)
"""Rounds of the finest steps: sharp edges need the derivatives of a pose that is nearly the right one."""

COARSE_PINGS = 4
"""Factor of pings by which coarse derivatives have fewer than the finest."""

ITERATIONS = 6
"""Largest number of steps at each size."""

SETTLED = 0.2
"""Length of a step after which no further one of its size follows, in standard deviations."""

LONGEST_STEP = 2.0
"""Longest motion of a step, in steps of coarse derivatives, which hold no farther; of fine ones it is a bin or a beam."""

LARGEST_MISFIT = 1.4
"""Largest mean of the squared whitened differences of a valid pose; 1 is expected."""

START_STD = MotionStd(0.02, float(np.radians(1)))
"""Standard deviations of an assumed pose."""

SMALL = 1e-6
"""Change of the poses in the derivatives of a motion by them [m, rad]."""


@dataclass(frozen=True)
class RegisteredPose:
    """The pose of a frame in a known scene.

    Attributes:
        pose: of the sonar.
        covariance: of the motion from the true pose, in level axes and in the order of
            :data:`mitsonar.motion.composition.DEGREES` ``(6, 6)`` [m, rad]; that of the assumed pose along directions that
            the frame does not show.
        observability: the directions that the frame shows better than the assumed pose.
        misfit: mean of the squared whitened differences between the frame and the expected one; 1 is expected.
        steps: number of steps.
        reason: why the pose must not be used; empty if it is valid.
    """

    pose: Pose
    covariance: NDArray[np.float64]
    observability: Observability
    misfit: float
    steps: int
    reason: str = ""

    @property
    def valid(self) -> bool:
        """Return whether the pose may be used."""
        return not self.reason

    @property
    def std(self) -> NDArray[np.float64]:
        """Return the standard deviations ``(6,)`` [m, rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class SixMotion:
    """The motion between two frames with all six degrees of freedom.

    Attributes:
        motion: in the order of :data:`mitsonar.motion.composition.DEGREES` ``(6,)`` [m, rad].
        covariance: of the motion ``(6, 6)``: that of both poses.
        poses: both registered poses.
    """

    motion: NDArray[np.float64]
    covariance: NDArray[np.float64]
    poses: tuple[RegisteredPose, RegisteredPose]

    @property
    def valid(self) -> bool:
        """Return whether the motion may be used: where both poses are valid."""
        return all(one.valid for one in self.poses)

    @property
    def reason(self) -> str:
        """Return why the motion must not be used; empty if it is valid."""
        return "; ".join(f"frame {k}: {one.reason}" for k, one in enumerate(self.poses) if one.reason)

    @property
    def std(self) -> NDArray[np.float64]:
        """Return the standard deviations ``(6,)`` [m, rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class Direct6:
    """Registers frames to a known scene in six degrees of freedom.

    Args:
        simulator: of the scene and the sonar, of the model ``thesis`` or ``physical``, with one view.
        gain: gain of the frames, 1 / ``level_scale`` of :class:`mitsonar.SonarFrames`.
        noise: noise of the pixels.
        start_std: standard deviations of the assumed poses.
        pings: pings of each half of the finest derivatives.
        ray_noise: whether the frames have the noise of the rays of a single ping, as rendered ones; means of many pings and
            frames of a real sonar do not.

    Raises:
        MitsonarError: the model ``coherent``, whose speckle a known scene does not predict; several views; a gain that is
            not above 0, or no pings.
    """

    simulator: Simulator
    gain: float
    noise: NoiseModel = NOISE_MODELS["none"]
    start_std: MotionStd = START_STD
    pings: int = 32
    ray_noise: bool = True

    def __post_init__(self) -> None:
        if self.simulator.sonar.model == "coherent":
            raise MitsonarError(
                "direct6 predicts expected levels, and speckle of the model coherent is not among them: give a sonar of the "
                "model physical or thesis"
            )
        if len(self.simulator.views) != 1:
            raise MitsonarError(f"direct6 registers frames of one view: got {len(self.simulator.views)}")
        if not 0 < self.gain < np.inf or self.pings < 1:
            raise MitsonarError(f"direct6 takes a gain above 0 and pings of 1 or more: got {self.gain:g} and {self.pings}")
        object.__setattr__(self, "simulator", jittered(self.simulator))

    def motion(self, images: NDArray[np.float64], starts: tuple[Pose, Pose]) -> SixMotion:
        """Estimate the motion between two frames.

        Args:
            images: both frames ``(2, bins, beams)`` in 0..1.
            starts: the assumed poses of both.

        Raises:
            MitsonarError: images of another shape, or not finite numbers in 0..1.
        """
        if len(images) != 2:
            raise MitsonarError(f"a motion lies between two frames: got {len(images)}")
        before, after = (self.register(image, start) for image, start in zip(images, starts, strict=True))
        # derivatives of the motion by the deviation of either pose
        covariance = np.zeros((6, 6))
        for number, one in enumerate((before, after)):
            slopes = np.empty((6, 6))
            for axis, change in enumerate(np.eye(6) * SMALL):
                ends = []
                for side in (1, -1):
                    poses = [before.pose, after.pose]
                    poses[number] = compose_six(poses[number], side * change)
                    ends.append(six_between(*poses))
                slopes[:, axis] = (ends[0] - ends[1]) / (2 * SMALL)
            covariance += slopes @ one.covariance @ slopes.T
        return SixMotion(six_between(before.pose, after.pose), covariance, (before, after))

    def register(self, image: NDArray[np.float64], start: Pose) -> RegisteredPose:
        """Estimate the pose of a frame.

        Args:
            image: the frame ``(bins, beams)`` in 0..1.
            start: the assumed pose. It may be off by about two beams, two bins, or the finest details of the scene that it
                shows from afar, whichever is largest.

        Raises:
            MitsonarError: an image of another shape, or not finite numbers in 0..1.
        """
        sonar = self.simulator.sonar
        values = np.asarray(image, dtype=float)
        if values.shape != (sonar.range_bins, sonar.beams):
            raise MitsonarError(
                f"a frame of this sonar has {sonar.range_bins} bins and {sonar.beams} beams: got {values.shape}"
            )
        if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
            raise MitsonarError("values of a frame must be finite and in 0..1: divide grey values by 255")
        pose, steps, bound = start, 0, None
        for part in (*COARSE, *FINE):
            derivative = self._derivative(pose, part, steps, bound)
            reach = steps_for(sonar, NAMES, 1.0) if part is None else LONGEST_STEP * part * self.start_std.of(NAMES)
            level, filled = derivative.level, derivative.filled
            for iteration in range(ITERATIONS):
                # the derivatives of one pose serve all steps of a size; the expected frame is rendered anew
                if iteration:
                    level, filled = self._means(pose, steps)
                # details that coarse steps smooth away count as noise of the rays
                linear = self._linearised(values, derivative, level, filled, rays=part is not None or self.ray_noise)
                bound = linear.bound
                change = linear.step(six_between(pose, start), self.start_std)
                change /= max(1.0, float((np.abs(change) / reach).max()))
                pose, steps = compose_six(pose, change), steps + 1
                if (np.abs(change) <= np.sqrt(np.diag(linear.covariance(self.start_std))) * SETTLED).all():
                    break
        shown = observability(linear.bound, NAMES, largest=self.start_std, frames=1)
        reason = "" if shown.observable else "the frame shows nothing that the assumed pose does not"
        if not reason and linear.misfit > LARGEST_MISFIT:
            reason = f"the frame differs from the scene by {np.sqrt(linear.misfit):.3g} standard deviations of its pixels"
        return RegisteredPose(pose, linear.covariance(self.start_std), shown, linear.misfit, steps, reason)

    def _derivative(self, pose: Pose, part: float | None, number: int, bound: Bound | None) -> Derivative:
        """Differentiate the expected frame at a pose.

        Args:
            pose: where.
            part: one of :data:`COARSE`; None: the finest steps.
            number: chooses the pings.
            bound: a first bound, which balances the finest steps.
        """
        along: dict[str, Any] = {"degrees": NAMES, "first": self._first(number)}
        if part is not None:
            step, pings = part * self.start_std.of(NAMES), -(-self.pings // COARSE_PINGS)
            return next(differentiate(self.simulator, pose, self.gain, pings=pings, step=step, **along))[0]
        assert bound is not None
        basis, step = balanced_steps(bound, self.simulator.sonar, NAMES)
        return next(differentiate(self.simulator, pose, self.gain, pings=self.pings, step=step, basis=basis, **along))[0]

    def _means(self, pose: Pose, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the mean level and the fraction of filled pings of each pixel at a pose ``(bins, beams)``."""
        poses = np.tile(np.array(pose, dtype=float), (2 * self.pings, 1))
        levels = np.concatenate([batch.levels for batch in self.simulator.pings(poses, first=self._first(number))])
        image = np.minimum(levels * np.float32(self.gain), np.float32(1))
        return image.mean(axis=0, dtype=float), (image > 0).mean(axis=0)

    def _first(self, number: int) -> int:
        """Return the first ping of a step."""
        return FIRST_PING + 2 * self.pings * number

    def _linearised(
        self,
        values: NDArray[np.float64],
        derivative: Derivative,
        level: NDArray[np.float64],
        filled: NDArray[np.float64],
        *,
        rays: bool,
    ) -> _Linearised:
        """Compare a frame with the expected one, of given level and filled pixels."""
        terms = pixel_terms(derivative, self.noise)
        changing = derivative.jacobian.any(axis=(0, 3, 4))
        # without noise and rounding a pixel would determine the motion without limit
        variance = np.maximum(terms.information.variance + (terms.rays if rays else 0), 1 / (12 * GREYS**2))
        expected = expected_values(self.noise, level[changing], filled[changing])
        difference = values[changing] - expected
        slope = np.einsum("nj,njk->nk", terms.information.slope, terms.jacobian.mean(axis=0))
        bound = fisher(terms.jacobian, terms.information.matched(variance - terms.information.variance))
        misfit = float(np.mean(difference**2 / variance)) if len(difference) else 0.0
        return _Linearised(bound, slope.T @ (difference / variance), misfit)


@dataclass(frozen=True)
class _Linearised:
    """A frame compared with the expected one.

    Attributes:
        bound: information of the frame about the motion.
        gradient: of the log likelihood by the motion ``(6,)``.
        misfit: mean of the squared whitened differences.
    """

    bound: Bound
    gradient: NDArray[np.float64]
    misfit: float

    def step(self, to_start: NDArray[np.float64], start_std: MotionStd) -> NDArray[np.float64]:
        """Return the step ``(6,)`` to the most probable pose, given the motion to the assumed one."""
        scale = start_std.of(NAMES)
        size, axes, significant = self.bound.directions(scale)
        gradient = axes.T @ (scale * self.gradient + to_start / scale)
        return np.asarray(axes @ (gradient / (np.maximum(size, significant) + 1)) * scale)

    def covariance(self, start_std: MotionStd) -> NDArray[np.float64]:
        """Return the covariance of the most probable pose ``(6, 6)``."""
        scale = start_std.of(NAMES)
        size, axes, significant = self.bound.directions(scale)
        known = np.where(size > significant, size, 0.0)  # what is no more than its noise counts for nothing
        return np.asarray((axes / (known + 1)) @ axes.T * np.outer(scale, scale))
