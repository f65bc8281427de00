"""Anybody's method as an estimator: an object with ``estimate(frames)``, a class of such objects, or a network of torch."""

from __future__ import annotations

import importlib
import inspect
import os
import pickle
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, meant
from mitsonar.estimation.estimator import Estimate, Options
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import SonarFrames

__all__ = ["HasEstimate", "OwnEstimator", "checked_options", "created", "own_class", "own_estimator"]

AnyObject = Any
"""An instance of somebody's class, or the class."""

PATH = re.compile(r"([A-Za-z_][\w.]*:[A-Za-z_]\w*)((?::.*)?)", flags=re.DOTALL)


class HasEstimate(Protocol):
    """An object with the method ``estimate(frames)``, or ``estimate(frames, prior)``."""

    @property
    def estimate(self) -> Callable[..., Estimate]:
        """Return the method."""


@dataclass(init=False, eq=False)
class OwnEstimator:
    """An estimator that is an object of the user's own.

    Args:
        path: its name in messages and files: ``my_module:MyEstimator``, or that of its class.
        made: the object. ``estimate`` takes records, and a ``prior`` if it has an argument of that name. Attributes
            ``consumes``, ``inputs`` and ``digest`` count where it has them, as in
            :class:`~mitsonar.estimation.estimator.Estimator`; otherwise it consumes ``SonarFrames``.
        again: makes the object in another process, where it need not be picklable.

    Raises:
        MitsonarError: an object without a method ``estimate`` that takes records only, or records and a prior.
    """

    path: str

    def __init__(self, path: str, made: AnyObject, again: _FromText | None = None) -> None:
        self.path, self._made, self._again = path, made, again
        consumes = getattr(made, "consumes", SonarFrames)
        if not isinstance(consumes, type):
            raise MitsonarError(f"{path}: consumes must be a class such as mitsonar.SonarFrames: got {consumes!r}")
        self.consumes: type = consumes
        self.inputs = str(getattr(made, "inputs", "its own"))
        self.digest = str(getattr(made, "digest", ""))
        try:
            estimate = made.estimate
        except AttributeError:
            raise MitsonarError(f"{path} has no method estimate(frames), which returns an Estimate") from None
        if not callable(estimate):
            raise MitsonarError(f"{path}: estimate must be a method that takes two frames")
        self._takes_prior = _takes_prior(path, estimate)

    def __reduce__(self) -> tuple[Callable[..., OwnEstimator], tuple[object, ...]]:
        """Return what another process makes it of."""
        if self._again is not None:
            return self._again, ()
        try:
            return _unpickled, (self.path, pickle.dumps(self._made))
        except Exception as error:
            raise MitsonarError(
                f"{self.path} cannot be sent to another process ({_words_of(error)}): use one worker, or name it as "
                "my_module:MyEstimator"
            ) from error

    def estimate(self, records: AnyObject, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion by the object, which gets the prior where it takes one.

        Raises:
            MitsonarError: it raises an error, or returns no :class:`~mitsonar.estimation.estimator.Estimate`.
        """
        try:
            found = self._made.estimate(records, **({"prior": prior} if self._takes_prior else {}))
        except MitsonarError:
            raise
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{os.path.basename(last.filename)}, line {last.lineno}"
            raise MitsonarError(f"{self.path}: estimate raises {_words_of(error)} at {where}") from error
        try:
            motion = Motion(*(float(value) for value in found.motion))
            covariance = None if found.covariance is None else self._covariance(found.covariance)
            return Estimate(motion, covariance, bool(found.valid), str(found.reason), found.about)
        except (AttributeError, TypeError):
            raise MitsonarError(f"{self.path}: estimate must return an Estimate: got {type(found).__name__}") from None

    def _covariance(self, given: AnyObject) -> NDArray[np.float64]:
        """Return a covariance as an array of 3 x 3."""
        covariance = np.asarray(given, dtype=np.float64)
        if covariance.shape != (3, 3):
            raise MitsonarError(f"{self.path}: the covariance of an Estimate must be 3 x 3 or None: got {covariance.shape}")
        return covariance


def own_estimator(made: AnyObject, options: Options, again: _FromText | None = None, name: str = "") -> OwnEstimator:
    """Return an object of the user's own, or a network of torch, as an estimator.

    Args:
        made: the object.
        options: only a network takes one: see :class:`~mitsonar.estimation.learned.own_network.OwnNetwork`.
        again: makes it in another process.
        name: in messages; default: that of its class.

    Raises:
        MitsonarError: an object that is none of both, or options that it does not take.
    """
    name = name or type(made).__name__
    if not hasattr(made, "estimate") and _is_network(made):
        from mitsonar.estimation.learned.own_network import OwnNetwork

        return OwnEstimator(name, OwnNetwork(made, **checked_options(name, options, OwnNetwork, but=1)), again)
    if options:
        raise MitsonarError(f"{name} is made already and takes no options: got {', '.join(options)}; give its class")
    return OwnEstimator(name, made, again)


def own_class(text: str, options: Options) -> OwnEstimator | None:
    """Return the estimator that a text names: ``my_module:MyEstimator``, with ``:key=value`` or not.

    The module lies in the current folder or is installed. Values are numbers, true, false, or texts.

    Returns:
        The estimator; None where the text is not of that form.

    Raises:
        MitsonarError: no such module or class, one without ``estimate``, one that cannot be imported or created, an option
            that it does not take.
    """
    found = PATH.fullmatch(text)
    if found is None:
        return None
    values = dict(options)
    for word in found[2].split(":")[1:]:
        key, equals, value = word.partition("=")
        if not (key and equals):
            raise MitsonarError(f"a class is my_module:MyEstimator or my_module:MyEstimator:key=value: got {text!r}")
        values[key] = _value(value)
    return _FromText(found[1], os.getcwd(), values)()


def checked_options(name: str, options: Options, made: Callable[..., object], but: int = 0) -> Options:
    """Return the options after a check of their names.

    Args:
        name: of the estimator, for the message.
        options: by name.
        made: what takes them.
        but: how many of its first arguments are no options.

    Raises:
        MitsonarError: an option that it does not take.
    """
    try:
        parameters = list(inspect.signature(made).parameters.values())[but:]
    except (TypeError, ValueError):  # made in C, without a signature
        return options
    if any(one.kind is one.VAR_KEYWORD for one in parameters):
        return options
    known = [one.name for one in parameters if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)]
    for key in options:
        if key not in known:
            raise MitsonarError(f"unknown option {key!r}: {name} takes {', '.join(known) or 'none'}{meant(key, known)}")
    return options


@dataclass(frozen=True)
class _FromText:
    """Makes the estimator that a text names, here and in other processes.

    Attributes:
        path: ``my_module:MyEstimator``.
        folder: where its module may lie.
        options: of the class.
    """

    path: str
    folder: str
    options: Options

    def __call__(self) -> OwnEstimator:
        module, _, name = self.path.partition(":")
        with _importable(self.folder):
            found = vars(self._imported(module)).get(name)
            if found is None:
                raise MitsonarError(f"{self.path}: {module} has no {name}: give the name of a class in it")
            made = created(found, self.options, self.path) if callable(found) and not _is_network(found) else found
        words = [self.path, *(f"{key}={value}" for key, value in self.options.items())]
        return own_estimator(made, {}, self, ":".join(words))

    def _imported(self, module: str) -> ModuleType:
        """Return the module of that name."""
        try:
            return importlib.import_module(module)
        except ModuleNotFoundError as error:
            where = f"needs {error.name}, which is not installed" if error.name != module else "is no module here"
            raise MitsonarError(f"{self.path}: {module} {where}: start in its folder, or install it") from None
        except Exception as error:
            raise MitsonarError(f"{self.path}: {module} raises {_words_of(error)} when it is imported") from error


def created(found: Callable[..., object], options: Options, name: str) -> AnyObject:
    """Return an instance of a class of the user's own.

    Raises:
        MitsonarError: it cannot be created of these options.
    """
    checked_options(name, options, found)
    words = ", ".join(f"{key}={value!r}" for key, value in options.items())
    try:
        return found(**options)
    except Exception as error:
        needs = "" if options else ": it must need no arguments, or give them as options"
        raise MitsonarError(f"{name}: {name.rpartition(':')[2]}({words}) raises {_words_of(error)}{needs}") from error


def _unpickled(path: str, content: bytes) -> OwnEstimator:
    return OwnEstimator(path, pickle.loads(content))


def _is_network(made: AnyObject) -> bool:
    """Return whether it is a network of torch, which is not loaded for that: whoever has a network has loaded it."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(made, torch.nn.Module)


def _takes_prior(path: str, estimate: Callable[..., object]) -> bool:
    """Return whether a method ``estimate`` has an argument ``prior``.

    Raises:
        MitsonarError: it needs others.
    """
    try:
        signature = inspect.signature(estimate)
    except (TypeError, ValueError):
        return False
    takes = "prior" in signature.parameters
    try:
        signature.bind(None, **({"prior": None} if takes else {}))
    except TypeError:
        raise MitsonarError(
            f"{path}: estimate{signature} must take the frames alone, or the frames and an argument prior"
        ) from None
    return takes


def _value(text: str) -> bool | int | float | str:
    """Return the value that a word of the command line stands for."""
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


@contextmanager
def _importable(folder: str) -> Iterator[None]:
    """Let modules of a folder be imported."""
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        with suppress(ValueError):  # a module may have changed the search path itself
            sys.path.remove(folder)


def _words_of(error: Exception) -> str:
    return f"{type(error).__name__} ({error})"
