"""The estimator ``stackreg``: rigid registration of pictures by pystackreg (Thevenaz, Ruttimann and Unser, 1998)."""

from __future__ import annotations

from dataclasses import dataclass

from mitsonar.estimation.estimator import INPUTS, Estimate, rejected
from mitsonar.estimation.external.ground_pair import ground_pair, package
from mitsonar.motion.composition import MotionPrior
from mitsonar.records.frames import SonarFrames

__all__ = ["StackReg"]


@dataclass(frozen=True)
class StackReg:
    """Least squares over a pyramid of the frames as seen from above.

    Raises:
        MitsonarError: pystackreg is not installed.
    """

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def __post_init__(self) -> None:
        package("pystackreg")

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; the prior is not used.

        Raises:
            MitsonarError: as :func:`mitsonar.estimation.external.ground_pair.ground_pair` does.
        """
        pair = ground_pair(frames, "stackreg")
        if pair.reason:
            return rejected(pair.reason)
        registration = package("pystackreg").StackReg(package("pystackreg").StackReg.RIGID_BODY)
        return pair.estimate(registration.register(pair.first, pair.second)[:2])
