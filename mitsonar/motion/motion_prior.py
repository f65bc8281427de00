"""What other sensors, or the last motions, tell of a motion before the frames are looked at."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.motion.composition import Motion

__all__ = ["MotionPrior"]


class MotionPrior(NamedTuple):
    """A motion between two frames as it is expected, with its covariance.

    Attributes:
        motion: sideways, forward [m], yaw [rad] (Almanza-Medina, eq. 3.4).
        covariance: of the motion ``(3, 3)`` [m, m, rad]; a component that nothing tells has a large variance.
    """

    motion: Motion
    covariance: NDArray[np.float64]

    @property
    def std(self) -> NDArray[np.float64]:
        """Return the standard deviations of sideways, forward [m] and yaw [rad] ``(3,)``."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=np.float64)
