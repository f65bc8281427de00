"""All estimators of impulse responses that nothing was trained for, by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.estimation.estimator import Estimate
from mitsonar.estimation.impulse import ImpulseEstimator, pings_of
from mitsonar.estimation.impulse_correlation import Correlation
from mitsonar.estimation.impulse_likelihood import Likelihood
from mitsonar.motion import Motion
from mitsonar.responses import ImpulseResponses

__all__ = ["IMPULSE_ESTIMATORS", "ImpulseZero", "create_impulse_estimator"]


class ImpulseZero:
    """No motion, whatever is heard: the row that every table needs."""

    inputs = "nothing"

    def estimate(self, responses: ImpulseResponses) -> Estimate:
        """No motion."""
        pings_of(responses)
        return Estimate(Motion(0.0, 0.0, 0.0))


IMPULSE_ESTIMATORS: dict[str, Callable[..., ImpulseEstimator]] = {
    "zero": ImpulseZero,
    "correlation": Correlation,
    "likelihood": Likelihood,
}


def create_impulse_estimator(name: str, **options: Any) -> ImpulseEstimator:
    """The estimator of that name.

    Raises:
        MitsonarError: unknown name or option.
    """
    if name not in IMPULSE_ESTIMATORS:
        raise MitsonarError(f"unknown estimator {name!r}: {nearest_names(name, tuple(IMPULSE_ESTIMATORS))}")
    try:
        return IMPULSE_ESTIMATORS[name](**options)
    except TypeError as error:
        raise MitsonarError(f"estimator {name}: {error}") from None
