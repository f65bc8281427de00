"""The estimator ``zero``: always "no motion", the row that every table needs."""

from __future__ import annotations

from collections.abc import Callable

from mitsonar.estimation.channel.pings import pings_of
from mitsonar.estimation.estimator import Estimate, Record, two_frames
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import SonarFrames
from mitsonar.records.responses import ImpulseResponses

__all__ = ["Zero"]

CHECKS: dict[type, Callable[..., object]] = {SonarFrames: two_frames, ImpulseResponses: pings_of}
"""The checks of the other estimators: what they reject, this one rejects."""


class Zero:
    """Estimates no motion, whatever the records hold."""

    consumes = object
    inputs = "nothing"
    digest = ""

    def estimate(self, records: Record, /, prior: MotionPrior | None = None) -> Estimate:
        """Return no motion; a prior is ignored.

        Raises:
            MitsonarError: records that no other estimator takes.
        """
        CHECKS.get(type(records), len)(records)
        return Estimate(Motion(0.0, 0.0, 0.0))
