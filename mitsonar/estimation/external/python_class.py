"""Anybody's method as an estimator: a class with ``estimate(frames)``, named by its path in Python."""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.motion.composition import Motion
from mitsonar.motion.motion_prior import MotionPrior
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["PythonClass", "names_python_class"]

AnyObject = Any
"""An instance of somebody's class."""

PATH = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def names_python_class(text: str) -> bool:
    """Return whether a word of the command line names a class, as ``my_module:MyEstimator`` does."""
    return PATH.fullmatch(text) is not None


@dataclass(frozen=True)
class PythonClass:
    """An estimator that is a class of the user's own module, which lies in the current folder or is installed.

    Args:
        path: ``my_module:MyEstimator``. The class is created without arguments.

    Raises:
        MitsonarError: no such module or class, one without ``estimate``, or one that cannot be imported or created.
    """

    path: str

    consumes = SonarFrames
    inputs = "its own"
    digest = ""

    def __post_init__(self) -> None:
        _ = self._folder, self._made

    def __getstate__(self) -> dict[str, str]:
        """Return what a worker needs to import the class again: an instance of it need not be picklable."""
        return {"path": self.path, "_folder": self._folder}

    @cached_property
    def _folder(self) -> str:
        """Return the folder that was current at first, where the module may lie."""
        return os.getcwd()

    @cached_property
    def _made(self) -> AnyObject:
        """Return an instance of the class."""
        module, _, name = self.path.partition(":")
        with _importable(self._folder):
            found = vars(self._imported(module)).get(name)
            if found is None:
                raise MitsonarError(f"{self.path}: {module} has no {name}: give the name of a class in it")
            try:
                made = found()
            except Exception as error:
                raise MitsonarError(f"{self.path}: {name}() raises {_told(error)}: it must need no arguments") from error
        try:
            estimate = made.estimate
        except AttributeError:
            raise MitsonarError(f"{self.path} has no method estimate(frames), which returns an Estimate") from None
        if not callable(estimate):
            raise MitsonarError(f"{self.path}: estimate must be a method that takes two frames")
        return made

    def _imported(self, module: str) -> ModuleType:
        """Return the module of that name."""
        try:
            return importlib.import_module(module)
        except ModuleNotFoundError as error:
            where = f"needs {error.name}, which is not installed" if error.name != module else "is no module here"
            raise MitsonarError(f"{self.path}: {module} {where}: start in its folder, or install it") from None
        except Exception as error:
            raise MitsonarError(f"{self.path}: {module} raises {_told(error)} when it is imported") from error

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion by the class, which is not handed the prior.

        Raises:
            MitsonarError: it returns no :class:`~mitsonar.estimation.estimator.Estimate`.
        """
        found = self._made.estimate(frames)
        try:
            motion = Motion(*(float(value) for value in found.motion))
            return Estimate(motion, found.covariance, bool(found.valid), str(found.reason), found.about)
        except (AttributeError, TypeError):
            raise MitsonarError(f"{self.path}: estimate must return an Estimate: got {type(found).__name__}") from None


@contextmanager
def _importable(folder: str) -> Iterator[None]:
    """Let modules of a folder be imported."""
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        with suppress(ValueError):  # a module may have changed the search path itself
            sys.path.remove(folder)


def _told(error: Exception) -> str:
    return f"{type(error).__name__} ({error})"
