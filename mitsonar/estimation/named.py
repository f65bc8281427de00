"""How an estimator is created from a name, a checkpoint or a user's class; and the estimator ``zero``."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np

from mitsonar.errors import MitsonarError, did_you_mean, missing_package_error, suggest_names
from mitsonar.estimation.channel.correlation import Correlation, pings_of
from mitsonar.estimation.channel.likelihood import Likelihood
from mitsonar.estimation.estimator import AnyEstimator, Estimate, Options, Record, checked_options, two_frames
from mitsonar.estimation.external import (
    CfarGicp,
    FourierMellin,
    HasEstimate,
    StackReg,
    created,
    own_class,
    own_estimator,
)
from mitsonar.estimation.height import DirectHeight, HeightEstimator
from mitsonar.estimation.image.direct import Direct
from mitsonar.estimation.image.flow import Flow
from mitsonar.estimation.image.phase import Ecc, Phase
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.networks.shipped import SHIPPED, shipped_path
from mitsonar.records.frames import SonarFrames
from mitsonar.records.responses import ImpulseResponses

if TYPE_CHECKING:
    from torch import nn

    from mitsonar.networks.checkpoint import Checkpoint

__all__ = [
    "ESTIMATORS",
    "EXTERNAL",
    "NAMES",
    "EstimatorLike",
    "Zero",
    "create_estimator",
    "estimators_for",
    "height_estimator_from",
    "load_checkpoint",
    "names_checkpoint",
    "options_from",
]


CHECKS: dict[type, Callable[..., object]] = {SonarFrames: two_frames, ImpulseResponses: pings_of}
"""The checks of the other estimators: ``zero`` rejects what they reject."""


class Zero:
    """Always estimates zero motion, the baseline of every comparison."""

    consumes = object
    inputs = "nothing"
    digest = ""

    def estimate(self, records: Record, /, prior: MotionPrior | None = None) -> Estimate:
        """Return zero motion; a prior is ignored.

        Raises:
            MitsonarError: records that no other estimator accepts.
        """
        CHECKS.get(type(records), len)(records)
        return Estimate(Motion(0.0, 0.0, 0.0))


# ---------------- Estimators by name


ESTIMATORS: dict[str, type[AnyEstimator]] = {
    "zero": Zero,
    "ecc": Ecc,
    "flow": Flow,
    "phase": Phase,
    "direct": Direct,
    "correlation": Correlation,
    "likelihood": Likelihood,
}
"""Estimators without training, of sonar frames or impulse responses; see ``consumes``."""

EXTERNAL: dict[str, type[AnyEstimator]] = {
    "cfar-gicp": CfarGicp,
    "fourier-mellin": FourierMellin,
    "stackreg": StackReg,
}
"""Estimators from optional packages, installed by the extra ``bench``."""

UNTRAINED = ESTIMATORS | EXTERNAL

EstimatorLike: TypeAlias = "str | os.PathLike[str] | HasEstimate | type[HasEstimate] | nn.Module | type[nn.Module]"
"""What :func:`create_estimator` accepts."""

NAMES = (*UNTRAINED, *SHIPPED)


def estimators_for(record: type) -> tuple[str, ...]:
    """Return the names of the untrained estimators that consume a class of records, such as ``SonarFrames``."""
    return tuple(name for name, estimator in ESTIMATORS.items() if estimator.consumes in (record, object))


def create_estimator(estimator: EstimatorLike, **options: object) -> AnyEstimator:
    """Create an estimator from the name of a built-in one, a checkpoint, or a class of the user.

    Args:
        estimator: one of

            - a name such as ``direct``; a checkpoint or the folder of a training run such as ``out/posenet``; or a class
              of the user as ``my_module:MyEstimator``. Options may follow, with angles as ``..._deg``:
              ``direct:height_m=2.5:pitch_deg=30``. Of several checkpoints separated by commas, the one trained nearest to
              the height of the frames is used;
            - a class with a method ``estimate(frames)`` or ``estimate(frames, prior=None)`` that returns an
              :class:`~mitsonar.estimation.estimator.Estimate`, or an instance of it;
            - a ``torch.nn.Module`` that takes images ``(batch, 2, bins, beams)`` in 0..1 and returns sideways, forward [m]
              and yaw [rad] ``(batch, 3)``. With the option ``samples``, the ``SonarPairs`` of its training, its inputs and
              outputs are those of the training.
        options: options of the estimator, by argument name, with angles as ``..._rad``.

    Raises:
        MitsonarError: unknown name or option, a checkpoint that is missing or cannot be used, torch not installed, a class
            that cannot be created or has no ``estimate``.
    """
    if isinstance(estimator, str):
        return _from_text(estimator, options)
    if isinstance(estimator, os.PathLike):
        return _create(os.fspath(estimator), _factory_of_checkpoint(os.fspath(estimator)), options)
    if isinstance(estimator, type) and _is_ours(estimator):
        return _create(estimator.__name__, cast(Callable[..., AnyEstimator], estimator), options)
    if isinstance(estimator, type):
        return own_estimator(created(estimator, options, estimator.__name__), {})
    if _is_ours(type(estimator)) and not options and hasattr(estimator, "estimate"):
        return cast(AnyEstimator, estimator)
    return own_estimator(estimator, options)


def _is_ours(kind: type) -> bool:
    """Return whether a class belongs to mitsonar."""
    return kind.__module__.partition(".")[0] == "mitsonar"


def _from_text(text: str, options: Options) -> AnyEstimator:
    """Create the estimator that a string names; see :func:`create_estimator`."""
    if "," in text and not os.path.exists(text):
        return _ensemble_of([part.strip() for part in text.split(",") if part.strip()], options)
    name, *words = text.split(":")
    if name in NAMES:
        factory = _factory_of(name)
        return _create(name, factory, {**options_from(name, words, factory), **options})
    user_estimator = own_class(text, options)
    if user_estimator is not None:
        return user_estimator
    if not names_checkpoint(name):
        names = suggest_names(name, NAMES)
        alternatives = "a checkpoint, the folder of a training run, or a class as my_module:MyEstimator"
        raise MitsonarError(f"unknown estimator {name!r}: {names}; or give {alternatives}")
    factory = _factory_of_checkpoint(name)
    return _create(name, factory, {**options_from(name, words, factory), **options})


def _create(name: str, factory: Callable[..., AnyEstimator], options: Options) -> AnyEstimator:
    """Create an estimator from options keyed by argument name.

    Raises:
        MitsonarError: an unknown option, or a value that is not a number where one is needed.
    """
    for key, value in checked_options(name, options, factory).items():
        kind = str(inspect.signature(factory).parameters[key].annotation)
        is_number = isinstance(value, int | float | np.number) or (value is None and "None" in kind)
        if kind.removesuffix(" | None") in ("float", "bool", "int") and not is_number:
            raise MitsonarError(f"{name}: {key} must be a number: got {value!r}")
    return factory(**options)


def _ensemble_of(texts: list[str], options: Options) -> AnyEstimator:
    """Create the ensemble of several checkpoints.

    Raises:
        MitsonarError: fewer than two, or estimators that are not networks.
    """
    estimators = [_from_text(text, options) for text in texts]
    untrained = [text for text, one in zip(texts, estimators, strict=True) if not one.digest]
    if untrained or len(estimators) < 2:
        problem = f"{untrained[0]} was not trained at a height" if untrained else f"got {len(estimators)}"
        raise MitsonarError(
            f"a comma-separated list names two or more checkpoints, from which the height selects one: {problem}"
        )
    from mitsonar.estimation.learned import HeightEnsemble

    return HeightEnsemble(estimators)


def _factory_of(name: str) -> Callable[..., AnyEstimator]:
    """Return the function that creates the estimator of this name from options."""
    return UNTRAINED[name] if name in UNTRAINED else _factory_of_checkpoint(shipped_path(name))


def _factory_of_checkpoint(path: str | Path) -> Callable[..., AnyEstimator]:
    """Return the function that creates the estimator of a checkpoint from options.

    Raises:
        MitsonarError: torch not installed, or a checkpoint that is missing or cannot be used.
    """
    checkpoint = load_checkpoint(path)
    from mitsonar.estimation.learned import ImageNetwork, ResponseNetwork, ViewNetwork, reads_views

    if checkpoint.channel is not None:
        return partial(ResponseNetwork, checkpoint)
    return partial(ViewNetwork if reads_views(checkpoint) else ImageNetwork, checkpoint)


def names_checkpoint(name: str) -> bool:
    """Return whether a word of the command line is a path rather than a name."""
    return "/" in name or "." in name or os.path.isdir(name)


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Load a checkpoint.

    Raises:
        MitsonarError: torch not installed, or a checkpoint that is missing or cannot be used.
    """
    try:
        from mitsonar.networks.checkpoint import Checkpoint
    except ModuleNotFoundError as error:
        raise missing_package_error(error) from None
    return Checkpoint.load(path)


def options_from(name: str, words: list[str], factory: Callable[..., object]) -> Options:
    """Parse the options of an estimator from words of the command line.

    Raises:
        MitsonarError: an unknown option, or a value that is not a number.
    """
    known, options = _numeric_options(factory), {}
    for word in words:
        key, _, value = word.partition("=")
        if not value:
            raise MitsonarError(f"an estimator is NAME or NAME:key=value:key=value: got {':'.join([name, *words])!r}")
        if key not in known:
            raise MitsonarError(
                f"unknown option {key!r}: {name} takes {', '.join(known) or 'none'}{did_you_mean(key, known)}"
            )
        try:
            number = float(value)
        except ValueError:
            raise MitsonarError(f"{name}: {key} must be a number: got {value!r}") from None
        option, kind = known[key]
        if "bool" in kind and number not in (0, 1):
            raise MitsonarError(f"{name}: {key} must be 0 or 1: got {value!r}")
        options[option] = bool(number) if "bool" in kind else math.radians(number) if key.endswith("_deg") else number
    return options


def _numeric_options(factory: Callable[..., object]) -> dict[str, tuple[str, str]]:
    """Return the numeric and boolean options: argument name and type, keyed by name on the command line."""
    parameters = inspect.signature(factory).parameters.values()
    kinds = {one.name: str(one.annotation) for one in parameters}
    numbers = {name: kind for name, kind in kinds.items() if ("float" in kind or kind == "bool") and "tuple" not in kind}
    return {name.replace("_rad", "_deg") if name.endswith("_rad") else name: (name, kind) for name, kind in numbers.items()}


# ---------------- Height estimators by name


def height_estimator_from(text: str) -> HeightEstimator:
    """Create a height estimator from ``direct``, a checkpoint or the folder of a training run, optionally with options.

    Raises:
        MitsonarError: a missing checkpoint, one that estimates motions, or an unknown option.
    """
    name, *words = text.split(":")
    if name == "direct":
        return DirectHeight(**options_from(name, words, DirectHeight))
    if not names_checkpoint(name):
        raise MitsonarError(
            "a height estimator is direct, a checkpoint or the folder of a training run: got "
            f"{name!r}{did_you_mean(name, ['direct'])}"
        )
    from mitsonar.estimation.height_network import HeightNetwork  # loads torch

    checkpoint = load_checkpoint(name)
    factory = partial(HeightNetwork, checkpoint)
    return factory(**options_from(name, words, factory))
