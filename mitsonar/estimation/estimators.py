"""All estimators by name."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import Any

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.estimation.direct import Direct
from mitsonar.estimation.ecc import Ecc
from mitsonar.estimation.estimator import Estimator
from mitsonar.estimation.flow import Flow
from mitsonar.estimation.phase import Phase
from mitsonar.estimation.zero import Zero

__all__ = ["ESTIMATORS", "create_estimator", "estimator_from"]

ESTIMATORS: dict[str, Callable[..., Estimator]] = {
    "zero": Zero,
    "ecc": Ecc,
    "flow": Flow,
    "phase": Phase,
    "direct": Direct,
}


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


def estimator_from(text: str) -> Estimator:
    """What the command line says: ``NAME``, or with numbers ``NAME:key=value:key=value``; angles as ``..._deg``.

    Raises:
        MitsonarError: unknown name or option, or not a number.
    """
    name, *words = text.split(":")
    if name not in ESTIMATORS and ("/" in name or "." in name):
        raise MitsonarError(
            f"no estimator {name!r}: networks from a checkpoint are not there yet; use {', '.join(ESTIMATORS)}"
        )
    if name not in ESTIMATORS:
        raise MitsonarError(f"unknown estimator {name!r}: {nearest_names(name, ESTIMATORS)}")
    known = _number_options(name)
    options = {}
    for word in words:
        key, _, value = word.partition("=")
        if not value:
            raise MitsonarError(f"an estimator is NAME or NAME:key=value:key=value: got {text!r}")
        if key not in known:
            raise MitsonarError(f"unknown option {key!r}: {name} takes {', '.join(known) or 'none'}")
        try:
            number = float(value)
        except ValueError:
            raise MitsonarError(f"{name}: {key} must be a number: got {value!r}") from None
        options[known[key]] = math.radians(number) if key.endswith("_deg") else number
    return create_estimator(name, **options)


def _number_options(name: str) -> dict[str, str]:
    """Options that are numbers, as the command line names them."""
    parameters = inspect.signature(ESTIMATORS[name]).parameters.values()
    numbers = [p.name for p in parameters if "float" in str(p.annotation) and "tuple" not in str(p.annotation)]
    return {option.replace("_rad", "_deg") if option.endswith("_rad") else option: option for option in numbers}
