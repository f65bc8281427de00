"""The estimator ``zero``: always "no motion", the row that every table needs."""

from __future__ import annotations

from mitsonar.estimation.estimator import Estimate, two_frames
from mitsonar.motion.pose import Motion
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["Zero"]


class Zero:
    """No motion, whatever is seen."""

    inputs = "nothing"

    def estimate(self, frames: SonarFrames) -> Estimate:
        """No motion."""
        two_frames(frames)
        return Estimate(Motion(0.0, 0.0, 0.0))
