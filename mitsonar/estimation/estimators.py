"""All estimators by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.estimation.direct import Direct
from mitsonar.estimation.estimator import Estimator
from mitsonar.estimation.zero import Zero

__all__ = ["ESTIMATORS", "create_estimator"]

ESTIMATORS: dict[str, Callable[..., Estimator]] = {"zero": Zero, "direct": Direct}


def create_estimator(name: str, **options: Any) -> Estimator:
    """The estimator of that name.

    Raises:
        MitsonarError: unknown name or option.
    """
    if name not in ESTIMATORS:
        raise MitsonarError(f"unknown estimator {name!r}: {nearest_names(name, ESTIMATORS)}")
    try:
        return ESTIMATORS[name](**options)
    except TypeError as error:
        raise MitsonarError(f"estimator {name}: {error}") from None
