"""The estimator ``zero``: always "no motion", the row that every table needs."""

from __future__ import annotations

from collections.abc import Sized

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.motion.pose import Motion

__all__ = ["Zero"]


class Zero:
    """No motion, whatever the records hold."""

    consumes = object
    inputs = "nothing"
    digest = ""

    def estimate(self, records: Sized, /) -> Estimate:
        """Answer no motion.

        Raises:
            MitsonarError: fewer than two records.
        """
        if len(records) < 2:
            raise MitsonarError(f"an estimator takes two frames, or two pings or more: got {len(records)}")
        return Estimate(Motion(0.0, 0.0, 0.0))
