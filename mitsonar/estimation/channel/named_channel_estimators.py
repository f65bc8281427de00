"""All estimators of impulse responses that nothing was trained for, by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.estimation.channel.channel_estimator import ImpulseEstimator, pings_of
from mitsonar.estimation.channel.correlation import Correlation
from mitsonar.estimation.channel.likelihood import Likelihood
from mitsonar.estimation.estimator import Estimate
from mitsonar.estimation.named_estimators import options_from
from mitsonar.motion.pose import Motion
from mitsonar.records.impulse_responses import ImpulseResponses

__all__ = ["IMPULSE_ESTIMATORS", "ImpulseZero", "create_impulse_estimator", "impulse_estimator_from"]


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


def impulse_estimator_from(text: str) -> ImpulseEstimator:
    """What the command line says: ``NAME`` or ``NAME:key=value:key=value``.

    Raises:
        MitsonarError: unknown name or option, not a number.
    """
    name, *words = text.split(":")
    options = options_from(name, words, IMPULSE_ESTIMATORS[name]) if name in IMPULSE_ESTIMATORS else {}
    return create_impulse_estimator(name, **options)
