"""All estimators by name."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsonar.errors import MitsonarError, explain_missing, meant, nearest_names
from mitsonar.estimation.channel.correlation import Correlation
from mitsonar.estimation.channel.likelihood import Likelihood
from mitsonar.estimation.estimator import AnyEstimator
from mitsonar.estimation.external.cfar_gicp import CfarGicp
from mitsonar.estimation.external.fourier_mellin import FourierMellin
from mitsonar.estimation.external.python_class import PythonClass, names_python_class
from mitsonar.estimation.external.stackreg import StackReg
from mitsonar.estimation.image.direct import Direct
from mitsonar.estimation.image.ecc import Ecc
from mitsonar.estimation.image.flow import Flow
from mitsonar.estimation.image.phase import Phase
from mitsonar.estimation.zero import Zero
from mitsonar.networks.shipped import SHIPPED, shipped_path

if TYPE_CHECKING:
    from mitsonar.networks.checkpoint import Checkpoint

__all__ = [
    "ESTIMATORS",
    "EXTERNAL",
    "NAMES",
    "create_estimator",
    "estimator_from",
    "estimators_for",
    "load_checkpoint",
    "names_checkpoint",
    "options_from",
]

ESTIMATORS: dict[str, type[AnyEstimator]] = {
    "zero": Zero,
    "ecc": Ecc,
    "flow": Flow,
    "phase": Phase,
    "direct": Direct,
    "correlation": Correlation,
    "likelihood": Likelihood,
}
"""Estimators without training, of sonar frames or of impulse responses: see ``consumes``."""

EXTERNAL: dict[str, type[AnyEstimator]] = {
    "cfar-gicp": CfarGicp,
    "fourier-mellin": FourierMellin,
    "stackreg": StackReg,
}
"""Estimators by packages that mitsonar does not need: the extra ``bench``."""

UNTRAINED = ESTIMATORS | EXTERNAL

Options = dict[str, Any]
"""Options of an estimator by name: numbers, or yes and no."""

NAMES = (*UNTRAINED, *SHIPPED)


def estimators_for(record: type) -> tuple[str, ...]:
    """Return the names of the estimators that consume a class of records, such as ``SonarFrames``; no trained ones."""
    return tuple(name for name, made in ESTIMATORS.items() if made.consumes in (record, object))


def create_estimator(name: str, **options: object) -> AnyEstimator:
    """Create the estimator of that name.

    Raises:
        MitsonarError: unknown name or option; no torch for a trained one.
    """
    if name not in NAMES:
        raise MitsonarError(f"unknown estimator {name!r}: {nearest_names(name, NAMES)}")
    try:
        return _maker(name)(**options)
    except TypeError as error:
        raise MitsonarError(f"estimator {name}: {error}") from None


def estimator_from(text: str) -> AnyEstimator:
    """Create an estimator from a text of the command line.

    The text is a name, a checkpoint or the folder of a training run, or one of them with options:
    ``NAME:key=value:key=value``, angles as ``..._deg``; or a Python class, ``my_module:MyEstimator``. Of several checkpoints
    with commas between them, the one trained nearest to the height of the frames is used.

    Raises:
        MitsonarError: unknown name or option, not a number, no such checkpoint or one that cannot be used.
    """
    if "," in text and not os.path.exists(text):
        return _nearest([part.strip() for part in text.split(",") if part.strip()])
    name, *words = text.split(":")
    if name in NAMES:
        return create_estimator(name, **options_from(name, words, _maker(name)))
    if names_python_class(text):
        return PythonClass(text)
    if not names_checkpoint(name):
        names = nearest_names(name, NAMES)
        other = "a checkpoint, the folder of a training run, or a class as my_module:MyEstimator"
        raise MitsonarError(f"unknown estimator {name!r}: {names}; or give {other}")
    made = _trained(name)
    return made(**options_from(name, words, made))


def _nearest(texts: list[str]) -> AnyEstimator:
    """Create the ensemble of several checkpoints.

    Raises:
        MitsonarError: fewer than two, or estimators that are not networks.
    """
    made = [estimator_from(text) for text in texts]
    plain = [text for text, one in zip(texts, made, strict=True) if not one.digest]
    if plain or len(made) < 2:
        fault = f"{plain[0]} was not trained at a height" if plain else f"got {len(made)}"
        raise MitsonarError(f"commas stand between two or more checkpoints, of which the height chooses one: {fault}")
    from mitsonar.estimation.learned.height_ensemble import HeightEnsemble

    return HeightEnsemble(made)


def _maker(name: str) -> Callable[..., AnyEstimator]:
    """Return the function that creates the estimator of that name from options."""
    return UNTRAINED[name] if name in UNTRAINED else _trained(shipped_path(name))


def _trained(path: str | Path) -> Callable[..., AnyEstimator]:
    """Return the function that creates an estimator of a checkpoint from options.

    Raises:
        MitsonarError: no torch, no such checkpoint or one that cannot be used.
    """
    checkpoint = load_checkpoint(path)
    from mitsonar.estimation.learned.image_network import ImageNetwork
    from mitsonar.estimation.learned.view_network import ViewNetwork, reads_views

    return partial(ViewNetwork if reads_views(checkpoint) else ImageNetwork, checkpoint)


def names_checkpoint(name: str) -> bool:
    """Return whether a word of the command line is a path, not a name."""
    return "/" in name or "." in name or os.path.isdir(name)


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Load a checkpoint.

    Raises:
        MitsonarError: no torch, no such checkpoint or one that cannot be used.
    """
    try:
        from mitsonar.networks.checkpoint import Checkpoint
    except ModuleNotFoundError as error:
        raise explain_missing(error) from None
    return Checkpoint.load(path)


def options_from(name: str, words: list[str], made: Callable[..., object]) -> Options:
    """Parse the options of an estimator from words of the command line.

    Raises:
        MitsonarError: an unknown option, or a value that is not a number.
    """
    known, options = _numbers(made), {}
    for word in words:
        key, _, value = word.partition("=")
        if not value:
            raise MitsonarError(f"an estimator is NAME or NAME:key=value:key=value: got {':'.join([name, *words])!r}")
        if key not in known:
            raise MitsonarError(f"unknown option {key!r}: {name} takes {', '.join(known) or 'none'}{meant(key, known)}")
        try:
            number = float(value)
        except ValueError:
            raise MitsonarError(f"{name}: {key} must be a number: got {value!r}") from None
        option, kind = known[key]
        if "bool" in kind and number not in (0, 1):
            raise MitsonarError(f"{name}: {key} must be 0 or 1: got {value!r}")
        options[option] = bool(number) if "bool" in kind else math.radians(number) if key.endswith("_deg") else number
    return options


def _numbers(made: Callable[..., object]) -> dict[str, tuple[str, str]]:
    """Return the options that are numbers or yes and no: by their name on the command line, with own name and type."""
    parameters = inspect.signature(made).parameters.values()
    kinds = {one.name: str(one.annotation) for one in parameters}
    numbers = {name: kind for name, kind in kinds.items() if ("float" in kind or kind == "bool") and "tuple" not in kind}
    return {name.replace("_rad", "_deg") if name.endswith("_rad") else name: (name, kind) for name, kind in numbers.items()}
