"""Interface to the kinds of instrument of data sets: how pings are simulated, stored, checked, read and compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from mitsonar.errors import MitsonarError

if TYPE_CHECKING:
    from mitsonar.acoustics.noise import NoiseModel
    from mitsonar.config.data import Recipe
    from mitsonar.instruments.sonar import Instrument

__all__ = [
    "Fields",
    "Modality",
    "Read",
    "Renderer",
    "Scene",
    "StoredArray",
    "StoredAxis",
    "Values",
    "empty_sentence",
    "ground_reach",
    "renderer_of",
    "samples_of",
]

Array = NDArray[np.float64]

Values: TypeAlias = NDArray[Any]
"""Values of a stored array, of any data type."""

Fields: TypeAlias = dict[str, Any]
"""JSON fields, keyed by name."""

OpenedSamples: TypeAlias = Any
"""Instance of the class that :attr:`Modality.samples_class` names; the class is imported only when it is needed."""

Read = Callable[..., Values]
"""Function that reads the values of a stored array by name, either all of them or those of a slice of frames."""


@dataclass(frozen=True)
class StoredArray:
    """An array that is filled ping by ping.

    Attributes:
        kind: data type.
        about: description, saved in the store.
        shape: shape of the values of one ping.
        dims: names of the dimensions in ``shape``.
    """

    kind: np.dtype[Any]
    about: str
    shape: tuple[int, ...] = ()
    dims: tuple[str, ...] = ()


@dataclass(frozen=True)
class StoredAxis:
    """Coordinates along a dimension, known before the first ping."""

    values: Array
    dim: str
    about: str


@dataclass(frozen=True)
class Scene:
    """One scene of a data set.

    Attributes:
        number: index of the scene in the data set.
        group: index of its group in the recipe.
        seed: seed of its world.
        sequences: number of its sequences.
    """

    number: int
    group: int
    seed: int
    sequences: int


class Renderer(Protocol):
    """Renderer of one loaded scene."""

    def __init__(self, recipe: Recipe, scene: Scene) -> None: ...

    @staticmethod
    def fixed_attributes(recipe: Recipe) -> Fields:
        """Compute the attributes of the whole data set that must be known before its first ping is recorded.

        Raises:
            MitsonarError: the first frames are empty.
        """

    def recorded(self, planned: dict[str, Values], first: int, about: Fields) -> dict[str, Values]:
        """Render consecutive pings of the scene, and return the arrays to store, keyed by name.

        Args:
            planned: values of the plan for these pings: ``pose``, and the arrays in the modality's ``planned``.
            first: number of the first ping in the scene.
            about: attributes of the store.
        """


class Modality(Protocol):
    """Everything that depends on the kind of record of a recipe's instrument, from simulation to comparison.

    Attributes:
        what: noun for the record of one ping.
        sonar: the instrument; every instrument has a name, a model and a frame rate.
        stored: arrays that are filled ping by ping, those with a shape first.
        axes: coordinates along their dimensions.
        attributes: attributes of the store.
        fixed_attributes: names of the numeric attributes that apply to the whole data set and are set before its first ping.
        planned: arrays of the plan that are stored in addition to the poses.
        result_packages: packages whose versions affect the recorded values, in addition to those that always do.
        ping_bytes: approximate size of one ping [bytes].
        renderer_class: class that renders a scene of the recipe, as ``module:class``; see :func:`renderer_of`.
        samples_class: class that reads the samples on which estimators are compared, as ``module:class``.
        sample_frames: number of records per sample in a comparison.
        estimators: default estimators of a comparison, as names separated by commas.
        variations: whether a comparison can give estimators wrong assumptions about its samples.
    """

    what: str
    fixed_attributes: tuple[str, ...]
    planned: tuple[str, ...]
    result_packages: tuple[str, ...]
    renderer_class: str
    samples_class: str
    estimators: str
    variations: bool

    @property
    def sonar(self) -> Instrument:
        """Return the instrument."""

    @property
    def stored(self) -> dict[str, StoredArray]:
        """Return the arrays that are filled ping by ping, those with a shape first."""

    @property
    def axes(self) -> dict[str, StoredAxis]:
        """Return the coordinates along the dimensions of the arrays."""

    @property
    def attributes(self) -> Fields:
        """Return the attributes of the store."""

    @property
    def ping_bytes(self) -> int:
        """Return the approximate size of one ping [bytes]."""

    @property
    def sample_frames(self) -> int:
        """Return the number of records per sample in a comparison."""

    def reach(self, height: float, pitch: float = 0.0) -> Array:
        """Compute the footprint of the instrument on a vehicle at a height [m] and a pitch [rad], positive down.

        Returns:
            Corners ``(n, 2)`` on the ground z = 0, starboard and forward of the vehicle [m].

        Raises:
            MitsonarError: the ground is out of range.
        """

    def noise_model(self, name: str) -> NoiseModel | None:
        """Return the noise model with the given name, or None if the name alone defines the noise.

        Raises:
            MitsonarError: unknown name.
        """

    def empty(self, read: Read, here: slice) -> NDArray[np.bool_]:
        """Mark the pings ``(pings,)`` that have no echo in any view or at any receiver."""

    def faults(self, read: Read, here: slice) -> list[str]:
        """Check the values of some frames, and return one sentence per fault."""

    def warnings(self, read: Read) -> list[str]:
        """Return warnings for the user about a finished data set, one sentence each."""


def renderer_of(modality: Modality) -> type[Renderer]:
    """Import the class that renders scenes; the import is deferred so that reading a store loads no simulator."""
    renderer: type[Renderer] = resolve_name(modality.renderer_class)
    return renderer


def samples_of(modality: Modality, url: str | Path, **options: Any) -> OpenedSamples:
    """Open the samples of a store on which estimators are compared.

    Args:
        modality: of the store's recipe.
        url: path or URL of the store.
        **options: further arguments of the class that :attr:`Modality.samples_class` names.

    Raises:
        MitsonarError: the options do not fit the store, or the selected part has no samples.
    """
    return resolve_name(modality.samples_class)(url, frames=modality.sample_frames, **options)


def ground_reach(eye: Array, directions: Array, range_max: float) -> Array:
    """Compute the corners ``(n, 2)`` [m] of the convex hull of the points where rays meet the ground z = 0.

    Rays that meet the ground beyond ``range_max``, or never, are ended on the ground at that range.

    Args:
        eye: origin of the rays ``(3,)`` [m].
        directions: unit vectors ``(rays, 3)``.
        range_max: maximum range of the instrument [m].

    Raises:
        MitsonarError: the ground is out of range.
    """
    height = float(eye[2])
    if height <= 0 or height >= range_max:
        raise MitsonarError(
            f"the sonar cannot see the ground: it is {height:g} m above it, but range_max is {range_max:g} m; lower "
            "height_m or raise range_max"
        )
    max_distance = math.sqrt(range_max**2 - height**2)
    horizontal = np.hypot(directions[:, 0], directions[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(directions[:, 2] < 0, height * horizontal / -directions[:, 2], np.inf)
    distance = np.minimum(ground, max_distance)
    unit = directions[:, :2] / np.maximum(horizontal, 1e-12)[:, None]
    points = eye[:2] + unit * distance[:, None]
    return np.asarray(points[ConvexHull(points).vertices])


def empty_sentence(empty: Sequence[int], frames: int, checked: str = "") -> str:
    """Return the warning about frames without echoes.

    Args:
        empty: numbers of the empty frames.
        frames: number of frames that were checked.
        checked: description of the frames that were checked, if not all.
    """
    which = ", ".join(f"{number:,}" for number in empty[:6]) + (" ..." if len(empty) > 6 else "")
    return (
        f"{len(empty):,} of {frames:,} frames{checked} contain no echoes ({which}): in them, the sonar sees "
        "nothing of the scene within its window; check world.size_m, flight.height_m, mount, range_min and range_max, and "
        "make the data set again"
    )
