"""How methods outside mitsonar become estimators: optional packages, and classes of the user."""

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

import cv2
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, missing_package_error
from mitsonar.estimation.estimator import INPUTS, Estimate, Options, checked_options, rejected, two_frames
from mitsonar.geometry.ground import Attitude, GroundView, attitude_of
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.records.frames import SonarFrames

__all__ = [
    "CfarGicp",
    "FourierMellin",
    "GroundPair",
    "HasEstimate",
    "OwnEstimator",
    "StackReg",
    "created",
    "ground_pair",
    "own_class",
    "own_estimator",
    "package",
]


GUARD, TRAINING = 4, 20
"""Bins on either side of a cell that are left out, and bins beyond them over which the mean of its surroundings extends."""

SMOOTH = (3, 5)
"""Beams and bins over which levels are averaged before detection, so that a point is an echo rather than grain."""

NEIGHBOURS_M, VOXEL_M = (0.3, 0.1), 0.01
"""Largest distance of corresponding points, far then near, and edge of the cells in which points are merged [m]."""

FEWEST_POINTS = 30
"""Smallest number of points of a frame that can be registered."""

DEPENDENT = 1e-12
"""Smallest eigenvalue of a matrix of correlations above which a covariance counts as positive definite."""


@dataclass(frozen=True)
class CfarGicp:
    """The estimator ``cfar-gicp``: cell-averaging CFAR detections on the ground plane, registered by small_gicp.

    A detection is a cell above the mean of its surroundings in range, as a point of level ground.

    Args:
        threshold: ratio of the level to the mean of the surroundings at which a cell is a detection.

    Raises:
        MitsonarError: small_gicp is not installed.
    """

    threshold: float = 1.5

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def __post_init__(self) -> None:
        package("small_gicp")

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; the registration starts from the prior.

        Raises:
            MitsonarError: invalid frames, see :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
        """
        images = two_frames(frames)
        attitude = attitude_of(frames, "cfar-gicp", None, None)
        clouds = [self._points(image, frames, attitude) for image in images]
        if attitude.reason or min(len(cloud) for cloud in clouds) < FEWEST_POINTS:
            return rejected(attitude.reason or f"fewer than {FEWEST_POINTS} detections")
        to_first, converged = _to_first(Motion(0.0, 0.0, 0.0) if prior is None else prior.motion), False
        for distance in NEIGHBOURS_M:
            registration = package("small_gicp").align(
                *clouds,
                init_T_target_source=to_first,
                downsampling_resolution=VOXEL_M,
                max_correspondence_distance=distance,
                max_iterations=50,
                rotation_epsilon=1e-5,
                translation_epsilon=1e-5,
            )
            to_first, converged = registration.T_target_source, bool(registration.converged)
        return Estimate(_motion_of(to_first)) if converged else rejected("the registration does not converge")

    def _points(self, image: NDArray[np.float32], frames: SonarFrames, attitude: Attitude) -> NDArray[np.float64]:
        """Return detections as points ``(n, 3)`` [m]: starboard, forward, 0."""
        level = cv2.blur(image, SMOOTH)
        # mean of the training cells: the wide window without the guard cells
        wide, narrow = (2 * (GUARD + TRAINING) + 1, 2 * GUARD + 1)
        sums = [count * cv2.blur(image, (1, count)) for count in (wide, narrow)]
        around = (sums[0] - sums[1]) / (wide - narrow)
        summit = level >= cv2.dilate(level, np.ones((3, 3), np.uint8))
        points = attitude.ground(frames).points[summit & (level > self.threshold * around)]
        points = points[np.isfinite(points).all(axis=1)]
        return np.column_stack([points, np.zeros(len(points))])


def _to_first(motion: Motion) -> NDArray[np.float64]:
    """Return the matrix ``(4, 4)`` that takes points of the second frame to the first, after a motion (eq. 3.4)."""
    cos, sin = np.cos(motion.yaw), np.sin(motion.yaw)
    matrix = np.eye(4)
    matrix[:2, :2] = [[cos, sin], [-sin, cos]]
    matrix[:2, 3] = matrix[:2, :2] @ [motion.sideways, motion.forward]
    return matrix


def _motion_of(to_first: NDArray[np.float64]) -> Motion:
    """Return the motion of a matrix, the inverse of :func:`_to_first`."""
    yaw = float(np.arctan2(to_first[0, 1], to_first[0, 0]))
    sideways, forward = to_first[:2, :2].T @ to_first[:2, 3]
    return Motion(float(sideways), float(forward), yaw)


# ---------------- The estimator fourier-mellin


INSTALL = "pip install --no-deps fourier-mellin (its dependency opencv-python would replace opencv-python-headless)"


@dataclass(frozen=True)
class FourierMellin:
    """The estimator ``fourier-mellin``: log-polar spectra and phase correlation by the package fourier-mellin.

    It finds rotation, scale and translation of the frames as seen from above; the scale is dropped. The package takes square
    images and is misled by borders, so the images fall to 0 at their borders, within a square of twice their edge.

    Raises:
        MitsonarError: fourier-mellin is not installed.
    """

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def __post_init__(self) -> None:
        package("fourier_mellin", INSTALL)

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; the prior is ignored.

        Raises:
            MitsonarError: as for :func:`mitsonar.estimation.external.ground_pair`.
        """
        pair = ground_pair(frames, "fourier-mellin")
        if pair.reason:
            return rejected(pair.reason)
        square, corner = _square(pair.first.shape)
        images = [np.pad(_tapered(image), square) for image in (pair.first, pair.second)]
        registration = package("fourier_mellin", INSTALL).FourierMellin(images[0]).register_image(images[1])
        middle = (len(images[0]) - 1) / 2
        warp = np.array(cv2.getRotationMatrix2D((middle, middle), registration.rotation, 1.0), dtype=float)
        warp[:, 2] += registration.x, -registration.y  # the package counts rows upwards
        warp[:, 2] += warp[:, :2] @ np.array(corner) - np.array(corner)
        return pair.estimate(warp)


def _square(shape: tuple[int, ...]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Return the padding of an image before and after, rows then columns, and the column and row of its corner."""
    edge = 2 * max(shape)
    before = [(edge - size) // 2 for size in shape]
    around = [(first, edge - size - first) for first, size in zip(before, shape, strict=True)]
    return around, (before[1], before[0])


def _tapered(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an image minus its mean that falls to 0 at its border."""
    window = cv2.createHanningWindow(image.shape[::-1], cv2.CV_32F)
    return np.asarray((image - image.mean()) * window, dtype=np.float32)


# ---------------- Frames as images of the ground without border


Picture = NDArray[np.float32]

RELATIVE_PIXEL = 0.5
"""Edge of a pixel relative to the beam spacing at the middle of the window."""

SMALLEST_IMAGE = 32
"""Smallest number of rows and columns of an image that can be registered."""


@dataclass(frozen=True)
class GroundPair:
    """Two frames seen from above, cut to a rectangle that the fan fills, for packages that cannot mask images.

    Attributes:
        first: image of the first frame ``(rows, columns)``, row 0 farthest forward; empty where nothing is left.
        second: image of the second frame.
        view: the view of which the images are a part.
        corner: column and row in the view of pixel (0, 0).
        reason: why the pair cannot be registered; empty if it can.
    """

    first: Picture
    second: Picture
    view: GroundView
    corner: tuple[int, int]
    reason: str

    def motion(self, warp: NDArray[np.floating]) -> Motion:
        """Return the motion of the warp ``(2, 3)`` that takes pixels (column, row) of the first image to the second."""
        view_warp = np.array(warp, dtype=float)
        view_warp[:, 2] += np.array(self.corner) - view_warp[:, :2] @ np.array(self.corner)
        return self.view.motion(view_warp)

    def estimate(self, warp: NDArray[np.floating]) -> Estimate:
        """Return the estimate of such a warp; reject one that displaces the images by half their size or more."""
        rows, columns = self.first.shape
        corners = np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]], dtype=float)
        moved = np.abs(corners @ warp[:, :2].T + warp[:, 2] - corners)
        if not (moved < np.array([columns, rows]) / 2).all():
            return rejected("the registered images overlap by less than half")
        return Estimate(self.motion(warp))


def ground_pair(frames: SonarFrames, name: str) -> GroundPair:
    """Project two frames to images of level ground.

    Args:
        frames: two frames.
        name: name of the estimator, for errors.

    Raises:
        MitsonarError: invalid frames, see :func:`mitsonar.estimation.estimator.two_frames`, or no height or pitch.
    """
    images = two_frames(frames)
    attitude = attitude_of(frames, name, None, None)
    spacing = float(np.ptp(frames.bearing_rad)) / (len(frames.bearing_rad) - 1)
    view = GroundView(frames, attitude, RELATIVE_PIXEL * spacing * float(frames.range_m[0] + frames.range_m[-1]) / 2)
    rows, columns = _filled_rectangle(view.inside)
    first, second = (np.ascontiguousarray(view.draw(image, k)[rows, columns]) for k, image in enumerate(images))
    small = "" if min(first.shape) >= SMALLEST_IMAGE else "the fan meets too little ground"
    blank = "" if small or (np.ptp(first) > 0 and np.ptp(second) > 0) else "nothing in the frames to match"
    return GroundPair(first, second, view, (columns.start, rows.start), attitude.reason or small or blank)


def _filled_rectangle(inside: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return rows and columns of the largest rectangle inside, centred on the middle column; empty if there is none."""
    best, area = (slice(0, 0), slice(0, 0)), 0
    middle = inside.shape[1] // 2
    for half in range(1, middle + 1):
        columns = slice(middle - half, middle + half)
        whole = np.concatenate([[False], inside[:, columns].all(axis=1), [False]])
        edges = np.flatnonzero(np.diff(whole.astype(np.int8)))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            if (stop - start) * 2 * half > area:
                best, area = (slice(int(start), int(stop)), columns), (stop - start) * 2 * half
    return best


def package(name: str, install: str = "") -> ModuleType:
    """Import an optional package.

    Args:
        name: name of the module.
        install: how to install it, where no extra of mitsonar does.

    Raises:
        MitsonarError: it is not installed; the message explains how to install it.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if install and error.name == name:
            raise MitsonarError(f"this estimator needs {name}, which is not installed: {install}") from None
        raise missing_package_error(error) from None


# ---------------- Estimators of the user


AnyObject = Any
"""An instance of a user's class, or the class."""

PATH = re.compile(r"([A-Za-z_][\w.]*:[A-Za-z_]\w*)((?::.*)?)", flags=re.DOTALL)


class HasEstimate(Protocol):
    """An object with the method ``estimate(frames)``, or ``estimate(frames, prior)``."""

    @property
    def estimate(self) -> Callable[..., Estimate]:
        """Return the method."""


@dataclass(init=False, eq=False)
class OwnEstimator:
    """An estimator that wraps an object of the user.

    Args:
        path: its name in messages and files: ``my_module:MyEstimator``, or that of its class.
        wrapped: the object. ``estimate`` takes records, and a ``prior`` if it has an argument of that name. Attributes
            ``consumes``, ``inputs`` and ``digest`` are used if present, as in
            :class:`~mitsonar.estimation.estimator.Estimator`; otherwise it consumes ``SonarFrames``.
        recreate: recreates the object in another process, where it need not be picklable.

    Raises:
        MitsonarError: an object without a method ``estimate`` that takes records only, or records and a prior.
    """

    path: str

    def __init__(self, path: str, wrapped: AnyObject, recreate: _FromText | None = None) -> None:
        self.path, self._wrapped, self._recreate = path, wrapped, recreate
        consumes = getattr(wrapped, "consumes", SonarFrames)
        if not isinstance(consumes, type):
            raise MitsonarError(f"{path}: consumes must be a class such as mitsonar.SonarFrames: got {consumes!r}")
        self.consumes: type = consumes
        self.inputs = str(getattr(wrapped, "inputs", "custom"))
        self.digest = str(getattr(wrapped, "digest", ""))
        try:
            estimate = wrapped.estimate
        except AttributeError:
            raise MitsonarError(f"{path} has no method estimate(frames), which returns an Estimate") from None
        if not callable(estimate):
            raise MitsonarError(f"{path}: estimate must be a method that takes two frames")
        self._takes_prior = _takes_prior(path, estimate)

    def __reduce__(self) -> tuple[Callable[..., OwnEstimator], tuple[object, ...]]:
        """Return how another process recreates the estimator."""
        if self._recreate is not None:
            return self._recreate, ()
        try:
            return _unpickled, (self.path, pickle.dumps(self._wrapped))
        except Exception as error:
            raise MitsonarError(
                f"{self.path} cannot be sent to another process ({_words_of(error)}): use one worker, or name it as "
                "my_module:MyEstimator"
            ) from error

    def estimate(self, records: AnyObject, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion by the object, which gets the prior if it takes one.

        Raises:
            MitsonarError: it raises an error, or does not return an :class:`~mitsonar.estimation.estimator.Estimate`.
        """
        try:
            estimate = self._wrapped.estimate(records, **({"prior": prior} if self._takes_prior else {}))
        except MitsonarError:
            raise
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            location = f"{os.path.basename(last.filename)}, line {last.lineno}"
            raise MitsonarError(f"{self.path}: estimate raises {_words_of(error)} at {location}") from error
        try:
            motion = Motion(*(float(value) for value in estimate.motion))
            covariance = None if estimate.covariance is None else self._covariance(estimate.covariance, bool(estimate.valid))
            return Estimate(motion, covariance, bool(estimate.valid), str(estimate.reason), estimate.about)
        except (AttributeError, TypeError):
            raise MitsonarError(f"{self.path}: estimate must return an Estimate: got {type(estimate).__name__}") from None

    def _covariance(self, values: AnyObject, valid: bool) -> NDArray[np.float64]:
        """Return a covariance as an array of 3 x 3, positive definite if the motion is valid."""
        covariance = np.asarray(values, dtype=np.float64)
        if covariance.shape != (3, 3):
            raise MitsonarError(f"{self.path}: the covariance of an Estimate must be 3 x 3 or None: got {covariance.shape}")
        if not valid:  # nothing uses it
            return covariance
        variances, largest = np.diag(covariance), np.abs(covariance).max()
        plausible = np.isfinite(largest) and (variances > 0).all()
        if not plausible or not np.allclose(covariance, covariance.T, atol=1e-9 * largest):
            got = ", ".join(f"{one:.3g}" for one in variances)
            raise MitsonarError(
                f"{self.path}: the covariance of an Estimate must be finite and symmetric, with variances above 0: got "
                f"variances {got} m^2, m^2, rad^2; give None where it is unknown"
            )
        scale = np.sqrt(variances)
        if np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0] < DEPENDENT:
            raise MitsonarError(
                f"{self.path}: the covariance of an Estimate must be positive definite: components depend on each other; "
                "add the variance of each component's own noise, or give None"
            )
        return covariance


def own_estimator(wrapped: AnyObject, options: Options, recreate: _FromText | None = None, name: str = "") -> OwnEstimator:
    """Return an object of the user, or a PyTorch network, as an estimator.

    Args:
        wrapped: the object.
        options: options, which only a network takes: see :class:`~mitsonar.estimation.learned.OwnNetwork`.
        recreate: recreates it in another process.
        name: its name in messages; default: that of its class.

    Raises:
        MitsonarError: an object that is neither, or options that it does not take.
    """
    name = name or type(wrapped).__name__
    if not hasattr(wrapped, "estimate") and _is_network(wrapped):
        from mitsonar.estimation.learned import OwnNetwork

        return OwnEstimator(name, OwnNetwork(wrapped, **checked_options(name, options, OwnNetwork, but=1)), recreate)
    if options:
        raise MitsonarError(f"{name} is already an instance and takes no options: got {', '.join(options)}; give its class")
    return OwnEstimator(name, wrapped, recreate)


def own_class(text: str, options: Options) -> OwnEstimator | None:
    """Return the estimator that a string names: ``my_module:MyEstimator``, optionally with ``:key=value``.

    The module lies in the current folder or is installed. Values are numbers, true, false, or strings.

    Returns:
        The estimator; None if the string is not of that form.

    Raises:
        MitsonarError: no such module or class, one without ``estimate``, one that cannot be imported or created, or an
            option that it does not take.
    """
    match = PATH.fullmatch(text)
    if match is None:
        return None
    values = dict(options)
    for setting in match[2].split(":")[1:]:
        key, equals, value = setting.partition("=")
        if not (key and equals):
            raise MitsonarError(f"a class is my_module:MyEstimator or my_module:MyEstimator:key=value: got {text!r}")
        values[key] = _value(value)
    return _FromText(match[1], os.getcwd(), values)()


@dataclass(frozen=True)
class _FromText:
    """Creates the estimator that a string names, in this and in other processes.

    Attributes:
        path: ``my_module:MyEstimator``.
        folder: folder that may contain its module.
        options: options of the class.
    """

    path: str
    folder: str
    options: Options

    def __call__(self) -> OwnEstimator:
        module, _, name = self.path.partition(":")
        with _importable(self.folder):
            definition = vars(self._imported(module)).get(name)
            if definition is None:
                raise MitsonarError(f"{self.path}: {module} has no {name}: give the name of a class in it")
            instance = (
                created(definition, self.options, self.path)
                if callable(definition) and not _is_network(definition)
                else definition
            )
        parts = [self.path, *(f"{key}={value}" for key, value in self.options.items())]
        return own_estimator(instance, {}, self, ":".join(parts))

    def _imported(self, module: str) -> ModuleType:
        """Return the module of that name."""
        try:
            return importlib.import_module(module)
        except ModuleNotFoundError as error:
            problem = f"needs {error.name}, which is not installed" if error.name != module else "is not a module here"
            raise MitsonarError(f"{self.path}: {module} {problem}: start in its folder, or install it") from None
        except Exception as error:
            raise MitsonarError(f"{self.path}: {module} raises {_words_of(error)} when it is imported") from error


def created(factory: Callable[..., object], options: Options, name: str) -> AnyObject:
    """Return an instance of a user's class.

    Raises:
        MitsonarError: it cannot be created with these options.
    """
    checked_options(name, options, factory)
    arguments = ", ".join(f"{key}={value!r}" for key, value in options.items())
    try:
        return factory(**options)
    except Exception as error:
        hint = "" if options else ": it must need no arguments, or give them as options"
        raise MitsonarError(f"{name}: {name.rpartition(':')[2]}({arguments}) raises {_words_of(error)}{hint}") from error


def _unpickled(path: str, content: bytes) -> OwnEstimator:
    return OwnEstimator(path, pickle.loads(content))


def _is_network(candidate: AnyObject) -> bool:
    """Return whether an object is a PyTorch network, without importing torch: a network's owner has already done so."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(candidate, torch.nn.Module)


def _takes_prior(path: str, estimate: Callable[..., object]) -> bool:
    """Return whether a method ``estimate`` has an argument ``prior``.

    Raises:
        MitsonarError: it needs other arguments.
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
    """Return the value of a word of the command line: a truth value, a number or a string."""
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


@contextmanager
def _importable(folder: str) -> Iterator[None]:
    """Allow imports of modules from a folder."""
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        with suppress(ValueError):  # a module may have changed the search path
            sys.path.remove(folder)


def _words_of(error: Exception) -> str:
    return f"{type(error).__name__} ({error})"


# ---------------- The estimator stackreg


@dataclass(frozen=True)
class StackReg:
    """The estimator ``stackreg``: rigid registration by pystackreg (Thevenaz, Ruttimann and Unser, 1998).

    It is least squares over a pyramid of the frames as seen from above.

    Raises:
        MitsonarError: pystackreg is not installed.
    """

    consumes = SonarFrames
    inputs = INPUTS
    digest = ""

    def __post_init__(self) -> None:
        package("pystackreg")

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        """Estimate the motion; the prior is ignored.

        Raises:
            MitsonarError: as for :func:`mitsonar.estimation.external.ground_pair`.
        """
        pair = ground_pair(frames, "stackreg")
        if pair.reason:
            return rejected(pair.reason)
        registration = package("pystackreg").StackReg(package("pystackreg").StackReg.RIGID_BODY)
        return pair.estimate(registration.register(pair.first, pair.second)[:2])
