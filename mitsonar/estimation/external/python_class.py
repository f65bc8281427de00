"""Anybody's method as an estimator: a class with ``estimate(frames)``, named by its path in Python."""

from __future__ import annotations

import importlib
import os
import re
import sys
from dataclasses import dataclass
from functools import cached_property
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
        MitsonarError: no such module or class, or one without ``estimate``.
    """

    path: str

    consumes = SonarFrames
    inputs = "its own"
    digest = ""

    def __post_init__(self) -> None:
        if not callable(self._made.estimate):
            raise MitsonarError(f"{self.path}: estimate must be a method that takes two frames")

    @cached_property
    def _made(self) -> AnyObject:
        """Return an instance of the class."""
        module, _, name = self.path.partition(":")
        sys.path.insert(0, os.getcwd())
        try:
            made = vars(importlib.import_module(module))[name]()
            _ = made.estimate
        except ModuleNotFoundError as error:
            where = f"needs {error.name}, which is not installed" if error.name != module else "is no module here"
            raise MitsonarError(f"{self.path}: {module} {where}: start in its folder, or install it") from None
        except KeyError:
            raise MitsonarError(f"{self.path}: {module} has no {name}: give the name of a class in it") from None
        except AttributeError:
            raise MitsonarError(f"{self.path} has no method estimate(frames), which returns an Estimate") from None
        finally:
            sys.path.remove(os.getcwd())
        return made

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
