"""How a sonar image changes with the sonar's motion: central differences of rendered frames.

A frame with jitter is random. A frame without jitter is a discontinuous function of the pose: a ray crosses the border of
a bin or of a textured cell, or slides off a rock. The mean over the draws of the jitter, however, is differentiable. Its
derivative is estimated with common random numbers (both sides of a difference draw the same rays), over many pings, in two
halves that share no ping. Ray noise biases J' W J by its square. It does not bias J1' W J2.

A difference over 2 d is the derivative of the frame smoothed over a box of that length. If each axis were smoothed only
along itself, the three smoothings would differ, and a motion that is almost unobservable (sideways against yaw) would
appear observable. Each ping is therefore also displaced along the other axes, evenly within their boxes. All derivatives
are then derivatives of the same function.

The motion has three degrees of freedom by default, or any of the six of :data:`mitsonar.motion.composition.DEGREES`. Some
combinations of six hardly change a frame, such as a rise with a pitch and a motion ahead: their derivatives drown in the
noise of the rays, unless the step along them is longer. Steps may therefore lie along any directions (`basis`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import PLANAR, Motion, compose_six, six_of
from mitsonar.motion.pose import Pose, mounted
from mitsonar.simulation.simulator import Simulator

__all__ = [
    "FIRST_PING",
    "PINGS",
    "Derivative",
    "differentiate",
    "evenly",
    "jittered",
    "moved_poses",
    "step_for",
    "steps_for",
]

FIRST_PING = 2**40
"""First ping number of derivatives. No run or data set has so many pings, so its frames are independent of derivatives."""

STEP = 1 / 16
"""Step, as a fraction of the bin or beam by which it moves echoes.

It is small compared with both, and with the finest detail of textures. It is large enough that some rays cross a border;
otherwise only ray noise would remain. Halving it changes bounds by 2 % (model ``thesis``) to 10 % (``physical``), because
edges and nearest points of rocks have no characteristic length.
"""

PINGS = 8
"""Number of pings in each half, with which bounds of a full frame vary by 1 to 4 %."""


@dataclass(frozen=True)
class Derivative:
    """Mean of one view at one pose over the jitter, and its derivatives by the sonar's motion.

    Attributes:
        level: mean of the pixels before noise, after gain and clipped to 0..1 ``(bins, beams)``.
        filled: fraction of the pings in which a pixel holds an echo ``(bins, beams)``.
        variance: variance of a pixel's level between pings, which is the ray noise ``(bins, beams)``.
        jacobian: two independent estimates of the derivatives of level and filled by the k degrees of freedom, such as
            sideways, forward [1/m] and yaw [1/rad], float32 ``(2, bins, beams, 2, k)``.
        pings: number of pings in each half.
    """

    level: NDArray[np.float64]
    filled: NDArray[np.float64]
    variance: NDArray[np.float64]
    jacobian: NDArray[np.float32]
    pings: int


def differentiate(
    simulator: Simulator,
    poses: ArrayLike,
    gain: float,
    *,
    pings: int = PINGS,
    step: ArrayLike | None = None,
    first: int = FIRST_PING,
    degrees: Sequence[str] = PLANAR,
    mount: Pose | None = None,
    basis: NDArray[np.float64] | None = None,
) -> Iterator[list[Derivative]]:
    """Estimate the derivatives at each pose, one for each view of the simulator.

    The motion is that of eq. 3.4 (Almanza-Medina) at rest: sideways, forward and yaw, relative to the pose of the sonar; or
    any of the six degrees of freedom of :func:`mitsonar.motion.composition.compose_six`.

    Args:
        simulator: simulator of scene, sonar and views; rays are jittered here even if its sonar has no jitter.
        poses: sonar poses ``(n, 6)``: x, y, z [m], pitch, roll, heading [rad].
        gain: constant factor of the levels.
        pings: number of pings in each half, at least 1; one ping in each half takes 12 frames: both sides of 3 steps.
        step: half the distance between both sides ``(k,)`` [m, rad]; default: :func:`steps_for` the sonar.
        first: number of the first ping.
        degrees: names of the k degrees of freedom.
        mount: pose of the sonar in the axes of a vehicle, to which ``poses`` and motions then belong; None: the poses are
            those of the sonar.
        basis: directions of the steps ``(k, k)``, one a column, in the order of ``degrees`` [m, rad]; ``step`` is then in
            multiples of each. None: along the degrees of freedom. The derivatives are by these in any case.

    Yields:
        The derivatives at each pose, one for each view.

    Raises:
        MitsonarError: poses are not finite numbers ``(n, 6)``; there is no ping.
    """
    table = np.atleast_2d(np.asarray(poses, dtype=float))
    if table.ndim != 2 or table.shape[1] != 6 or not np.isfinite(table).all():
        raise MitsonarError(f"poses must be finite numbers (n, 6): got {table.shape}; give m and rad")
    if pings < 1:
        raise MitsonarError(f"a derivative needs at least 1 ping in each half: got {pings}")
    source = jittered(simulator)
    for number, pose in enumerate(table):
        steps = steps_for(source.sonar, degrees) if step is None else np.array(step, dtype=float)
        yield _derivatives_at(
            source,
            Pose.from_row(pose),
            gain,
            pings,
            steps,
            first + 2 * pings * number,
            degrees=degrees,
            mount=mount,
            basis=basis,
        )


def jittered(simulator: Simulator) -> Simulator:
    """Return a simulator whose rays are jittered within their cells, or the given one if its rays already are."""
    if simulator.sonar.jittered:
        return simulator
    sonar = simulator.sonar.replace(jitter=True)
    moving = None if simulator.motion is None else simulator.motion.bodies
    return Simulator(simulator.tracer.scene, sonar, views=simulator.views, mirrors=simulator.mirrors, moving=moving)


def step_for(sonar: Sonar, part: float = STEP) -> Motion:
    """Return steps [m, rad] that move echoes by a fraction of a bin (forward) and of a beam (sideways, yaw)."""
    middle = (sonar.range_min + sonar.range_max) / 2
    return Motion(part * sonar.beam_width_rad * middle, part * sonar.bin_m, part * sonar.beam_width_rad)


def steps_for(sonar: Sonar, degrees: Sequence[str] = PLANAR, part: float = STEP) -> NDArray[np.float64]:
    """Return steps ``(k,)`` [m, rad] along degrees of freedom: those of :func:`step_for`, a bin of rise, beams of angles."""
    sideways, forward, angle = step_for(sonar, part)
    steps = {"sideways": sideways, "forward": forward, "rise": forward, "pitch": angle, "roll": angle, "yaw": angle}
    return np.array([steps[name] for name in degrees])


def moved_poses(pose: Pose, motions: ArrayLike, degrees: Sequence[str], mount: Pose | None = None) -> NDArray[np.float64]:
    """Return the poses ``(n, 6)`` of a sonar after motions ``(n, k)`` along k degrees of freedom; see `differentiate`."""
    moved = np.array([compose_six(pose, motion) for motion in six_of(motions, degrees)])
    return moved if mount is None else mounted(moved, mount)


def _derivatives_at(
    source: Simulator,
    pose: Pose,
    gain: float,
    pings: int,
    step: NDArray[np.float64],
    first: int,
    *,
    degrees: Sequence[str],
    mount: Pose | None,
    basis: NDArray[np.float64] | None,
) -> list[Derivative]:
    """Render both sides of each step, in two halves, and return one derivative for each view."""
    # both sides of a step render the same ping numbers, hence the same jitter, at motions that differ along one axis only
    sums: list[_Sums] = []
    within = evenly(2 * pings, len(step)) * step
    for axis in range(len(step)):
        for side in (0, 1):
            motions = within.copy()
            motions[:, axis] = (2 * side - 1) * step[axis]
            moved = moved_poses(pose, motions if basis is None else motions @ basis.T, degrees, mount)
            for views in source.render_views(moved, first=first):
                sums = sums or [_Sums.empty(len(step), *batch.levels.shape[1:]) for batch in views]
                for total, batch in zip(sums, views, strict=True):
                    total.add(batch.levels, np.arange(len(batch)) + batch.first - first >= pings, gain, axis, side)
    return [total.derivative(pings, step, basis) for total in sums]


def evenly(count: int, axes: int = 3) -> NDArray[np.float64]:
    """Return points ``(count, axes)`` that fill the cube -1..1 evenly, as does every contiguous run of them.

    The points follow the additive recurrence of M. Roberts.
    """
    ratio = 1.2207440846057596  # the root of x^(axes + 1) = x + 1, of three axes
    if axes != 3:
        ratio = float(brentq(lambda x: x ** (axes + 1) - x - 1, 1.0, 2.0, xtol=1e-15))
    return np.asarray((np.arange(1, count + 1)[:, None] / ratio ** np.arange(1, axes + 1)) % 1 * 2 - 1)


@dataclass
class _Sums:
    """Sums over pings.

    Attributes:
        totals: sums of level and filled, by half, axis and side ``(2, k, 2, 2, bins, beams)``.
        squares: sums of squared levels over all pings ``(bins, beams)``.
    """

    totals: NDArray[np.float64]
    squares: NDArray[np.float64]

    @classmethod
    def empty(cls, axes: int, bins: int, beams: int) -> _Sums:
        return cls(np.zeros((2, axes, 2, 2, bins, beams)), np.zeros((bins, beams)))

    def add(self, levels: NDArray[np.float32], second: NDArray[np.bool_], gain: float, axis: int, side: int) -> None:
        """Add pings of one side; ``second`` marks those of the second half."""
        for half in (0, 1):
            image = np.minimum(levels[second == half] * np.float32(gain), np.float32(1))
            self.totals[half, axis, side, 0] += image.sum(axis=0, dtype=np.float64)
            self.totals[half, axis, side, 1] += (image > 0).sum(axis=0)
            self.squares += np.einsum("pij,pij->ij", image, image, dtype=np.float64)

    def derivative(self, pings: int, step: NDArray[np.float64], basis: NDArray[np.float64] | None) -> Derivative:
        """Compute differences over twice the steps, and means over all sides."""
        level, filled = self.totals.mean(axis=(0, 1, 2)) / pings
        jacobian = (self.totals[:, :, 1] - self.totals[:, :, 0]) / pings / (2 * step)[:, None, None, None]
        variance = np.maximum(self.squares / (4 * len(step) * pings) - level**2, 0.0)
        jacobian = np.moveaxis(jacobian, (1, 2), (4, 3))
        if basis is not None:
            jacobian = jacobian @ np.linalg.inv(basis)
        return Derivative(level, filled, variance, jacobian.astype(np.float32), pings)
