"""The Cramer-Rao lower bound of motion in the model ``coherent``, whose pixels are |s + n|: speckle s, receiver's noise n.

*Grain known*: an oracle owns the scatterers, so s is a function of the pose. A pixel has the Rice law
(:mod:`mitsonar.acoustics.speckle`), and what changes with the motion is |s|^2. Only amplitudes are observed: the phase of s,
which turns once in a quarter of a millimetre, tells nothing. Neighbouring cells share noise.

*Ground known*: an oracle knows the expected level of every cell, as that of the other models does, but no scatterers: each
frame has grain of its own, as after a motion of more than the grain's size. An intensity is exponential; its score is the
intensity over its mean, and scores of two cells covary as the squared coherence of their fields.

Both are what the best weighted sum of the scores of single pixels can use. `ground` is optimistic in two ways: speckle
correlates as on even ground, though a dark cell beside a bright one shows that one's grain; and patches of ``speckle_nu``,
which belong to the grain, are not in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.levels import coding_slope
from mitsonar.acoustics.speckle import rician_information, score_shares
from mitsonar.errors import MitsonarError
from mitsonar.estimation.crlb.fisher_bound import Bound, fisher_by
from mitsonar.estimation.crlb.score_covariance import CellCorrelation, ScoreCovariance
from mitsonar.instruments.sonar import Quality, Sonar
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose
from mitsonar.simulation.derivatives import FIRST_PING, PINGS, differentiate, evenly, step_for
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    from mitsonar.simulation.coherent import CoherentImager

__all__ = ["SPECKLE_LAWS", "CellScores", "SpeckleBounds", "expected_sonar", "grain_law"]

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

SPECKLE_LAWS: dict[str, str] = {
    "grain": "scatterers and ground are known: amplitudes in the receiver's noise, rounded to grey values",
    "ground": "the expected level is known, the grain is new in each frame: intensities of speckle and noise",
}

GRAIN_PINGS, GROUND_PINGS = 2, 4
"""Places at which each half of the derivatives is taken: bounds vary by 1 to 3 %."""

GRAIN_STEP = 1 / 8
"""Step of the grain's derivatives, as a part of a bin (forward) and of a beam (sideways, yaw): a tenth of the grain."""

OTHER_RAYS: dict[str, Quality] = {"draft": "standard", "standard": "fine", "fine": "standard"}
"""Quality of the rays of the other half."""

AGREEING = 0.5
"""Echoes on which two sets of rays disagree by a larger part are left out: sharp edges, thin tops of rocks. So are expected
levels that vary by a larger part from ping to ping of moving rays."""

GREYS = 255


class SpeckleBounds:
    """Bounds of one coherent sonar in one scene.

    Args:
        simulator: of the model ``coherent``.
        gain: that of the frames.

    Raises:
        MitsonarError: another model.
    """

    def __init__(self, simulator: Simulator, gain: float) -> None:
        if simulator.coherent is None:
            raise MitsonarError(f"bounds of speckle are for the model coherent: got {simulator.sonar.model}")
        self.sonar, self.gain = simulator.sonar, gain
        self.imager = simulator.coherent
        self.halves = self.imager, self.imager.of_quality(OTHER_RAYS[self.sonar.quality])
        mirrors = simulator.mirrors if self.sonar.bounces > 1 else None  # one reflection has no expected level of a mirror
        self.expected = Simulator(simulator.tracer.scene, expected_sonar(self.sonar), mirrors=mirrors)
        noise, volume = self.imager.noise_powers()
        self.noise = np.broadcast_to((noise + volume)[:, None], (self.sonar.range_bins, self.sonar.beams))
        beams = self.imager.beam_correlations()
        share = float(volume.sum()) / max(float((noise + volume).sum()), 1e-300)
        bins = self.imager.bin_correlation().astype(float)
        self.of_noise = CellCorrelation(bins, (1 - share) * beams[0] + share * beams[1])
        self.of_speckle = CellCorrelation(bins, beams[2])

    def at(self, poses: ArrayLike, *, pings: int | None = None) -> Iterator[dict[str, Bound]]:
        """Bounds by law of :data:`SPECKLE_LAWS`, at each pose.

        Args:
            poses: of the sonar ``(n, 6)``.
            pings: of each half of the derivatives; default: 2 for the grain, 4 for the ground.
        """
        for number, pose in enumerate(np.atleast_2d(np.asarray(poses, dtype=float))):
            first = FIRST_PING + 32 * PINGS * number
            yield {"grain": self.grain(pose, pings).bound(), "ground": self.ground(pose, pings, first).bound()}

    def grain(self, pose: Floats, pings: int | None = None) -> CellScores:
        """Return what cells tell of the motion where the scatterers are known.

        Differences are those of the power of echoes, by two sets of rays.

        Args:
            pose: of the sonar ``(6,)``.
            pings: see :meth:`at`.
        """
        step = np.array(step_for(self.sonar, GRAIN_STEP))
        jacobian = np.stack([_power_slopes(imager, pose, step, pings or GRAIN_PINGS) for imager in self.halves])
        echo, other = (imager.echoes(pose)[0].astype(np.complex128) for imager in self.halves)
        level = np.abs(echo) ** 2 + self.noise
        scale = self.gain * self.imager.gain.astype(float)[:, None]
        slope = coding_slope(level * scale, self.sonar) * scale
        use = (slope > 0) & (np.abs(echo - other) < AGREEING * np.abs(echo + other) / 2)
        rounding = np.divide(1 / (12 * GREYS**2), slope**2, out=np.full_like(slope, np.inf), where=use)
        return CellScores(jacobian, *grain_law(echo, self.noise, self.of_noise, rounding))

    def ground(self, pose: Floats, pings: int | None = None, first: int = FIRST_PING) -> CellScores:
        """Return what cells tell of the motion where the expected level is known.

        Differences are those of the expected level, over level and noise.

        Args:
            pose: of the sonar ``(6,)``.
            pings: see :meth:`at`.
            first: number of the first ping, of which the rays' jitter is a function.
        """
        gain = 0.01 / float(next(self.expected.pings(pose[None], first=first)).levels.max())
        (derivative,) = next(differentiate(self.expected, pose, gain, pings=pings or GROUND_PINGS, first=first))
        level = derivative.level + self.noise * self.imager.gain[:, None] * gain
        known = (level > 0) & (derivative.variance < (AGREEING * level) ** 2)
        safe = np.where(known, level, 1)
        echo = np.where(known, derivative.level, 0) / safe
        other = np.where(known, 1 - echo, 0.0)
        parts = [
            (echo, self.of_speckle * self.of_speckle),
            (np.sqrt(2 * echo * other), self.of_speckle * self.of_noise),
            (other, self.of_noise * self.of_noise),
        ]
        jacobian = derivative.jacobian[..., 0, :] / safe[..., None]
        return CellScores(jacobian, known.astype(float), ScoreCovariance.of(parts, level.shape))


class CellScores(NamedTuple):
    """What the cells of a frame tell of the motion.

    Attributes:
        jacobian: two independent estimates of how the cells' numbers change with the motion ``(2, bins, beams, 3)``.
        weight: Fisher information of each cell about its number ``(bins, beams)``.
        covariance: of the standardised scores.
    """

    jacobian: Floats
    weight: Floats
    covariance: ScoreCovariance

    def bound(self) -> Bound:
        """Compute the bound J1' W^1/2 C^-1 W^1/2 J2."""
        return fisher_by(np.asarray(self.jacobian, dtype=float).reshape(2, -1, 1, 3), self._weigh)

    def _weigh(self, values: Floats) -> Floats:
        """Return W^1/2 C^-1 W^1/2 of values ``(cells, 1, 3)``."""
        root = np.sqrt(self.weight)
        maps = np.moveaxis(values.reshape(*root.shape, 3), 2, 0)
        return np.moveaxis(root * self.covariance.solve(root * maps), 0, 2).reshape(-1, 1, 3)


def grain_law(
    echo: Complex, noise: Floats, shared: CellCorrelation, rounding: ArrayLike = 0.0
) -> tuple[Floats, ScoreCovariance]:
    """Compute what amplitudes tell about the power of an echo whose noiseless field is known.

    Args:
        echo: the noiseless field ``(bins, beams)``.
        noise: mean power of the noise ``(bins, beams)``; all 0: only rounding is left.
        shared: correlation of the noise of two cells.
        rounding: variance of the power by rounding ``(bins, beams)``; inf where a pixel is not to be used.

    Returns:
        The information of each cell ``(bins, beams)`` and the covariance of their scores.

    Raises:
        MitsonarError: neither noise nor rounding.
    """
    power = np.abs(echo) ** 2
    rounding = np.broadcast_to(np.asarray(rounding, dtype=float), power.shape)
    if not (noise > 0).all():
        if not (rounding > 0).all():
            raise MitsonarError("without noise amplitudes tell the motion without limit: give the sonar noise_level_db")
        return 1 / rounding, ScoreCovariance([], np.ones(power.shape))
    variance = 1 / rician_information(power, noise)
    total = variance + rounding
    kept = np.sqrt(variance / total)  # part of the score's standard deviation that is not rounding
    shares = score_shares(power, noise)
    turn = np.exp(1j * np.angle(echo))
    parts = [
        (kept * shares.linear * turn, shared),
        (kept * shares.power, shared * shared),
        (kept * shares.double * turn**2, shared * shared),
    ]
    return 1 / total, ScoreCovariance.of(parts, power.shape)


def expected_sonar(sonar: Sonar) -> Sonar:
    """Return the sonar whose levels are the means of many coherent pings."""
    patterns = {"pattern": sonar.beam_pattern, "elevation_pattern": sonar.vertical_pattern}
    return sonar.replace(model="physical", quality="fine", **patterns)


def _power_slopes(imager: CoherentImager, pose: Floats, step: Floats, pings: int) -> Floats:
    """Return the derivative of the power of echoes by the motion ``(bins, beams, 3)``: mean over places within the step."""
    within = evenly(pings) * step
    slopes = np.zeros((imager.sonar.range_bins, imager.sonar.beams, 3))
    for axis in range(3):
        for motion in within:
            for side in (1, -1):
                moved = motion.copy()
                moved[axis] = side * step[axis]
                echo = imager.echoes(np.array(compose(Pose.from_row(pose), Motion(*moved))))[0]
                slopes[..., axis] += side * (echo.real.astype(float) ** 2 + echo.imag.astype(float) ** 2)
    return slopes / (2 * step * pings)
