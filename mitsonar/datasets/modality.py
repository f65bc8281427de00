"""A modality: one object that says what an instrument records of a ping, how it is simulated, checked, read and compared."""

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
    from mitsonar.datasets.plan import Scene
    from mitsonar.instruments.sonar import Instrument

__all__ = [
    "Fields",
    "Modality",
    "Read",
    "Renderer",
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
"""Values of a stored array; their type is the array's own."""

Fields: TypeAlias = dict[str, Any]
"""Attributes or keys by name, as JSON holds them."""

OpenedSamples: TypeAlias = Any
"""An object of the class that :attr:`Modality.samples_class` names, which is loaded only when it is used."""

Read = Callable[..., Values]
"""Reads values of an array of a store by its name, all or those of a slice of frames."""


@dataclass(frozen=True)
class StoredArray:
    """An array that is filled ping by ping.

    Attributes:
        kind: its type.
        about: a description, kept in the store.
        shape: of one ping's values.
        dims: names of these dimensions.
    """

    kind: np.dtype[Any]
    about: str
    shape: tuple[int, ...] = ()
    dims: tuple[str, ...] = ()


@dataclass(frozen=True)
class StoredAxis:
    """Values along a dimension, known from the start."""

    values: Array
    dim: str
    about: str


class Renderer(Protocol):
    """Renders one scene, which is loaded."""

    def __init__(self, recipe: Recipe, scene: Scene) -> None: ...

    @staticmethod
    def settled(recipe: Recipe) -> Fields:
        """Compute the numbers of the whole data set, which are set before its first ping is recorded.

        Raises:
            MitsonarError: the first frames are empty.
        """

    def recorded(self, planned: dict[str, Values], first: int, about: Fields) -> dict[str, Values]:
        """Render consecutive pings of the scene. Return what is stored of them, by name.

        Args:
            planned: values of the plan for these pings: ``pose``, and what the modality names.
            first: number of the first in the scene.
            about: attributes of the store.
        """


class Modality(Protocol):
    """Everything that depends on what a recipe's instrument records, from simulation to comparison.

    Attributes:
        what: the name of one ping's record.
        sonar: the instrument; all have a name, a model and a frame rate.
        stored: arrays that are filled ping by ping, those with a shape first.
        axes: arrays along their dimensions.
        attributes: of the store.
        settled: names of attributes that are numbers of the whole data set, set before its first ping is recorded.
        planned: arrays of the plan that are stored beside the poses.
        decided_by: packages whose versions decide what is recorded, beside those that always do.
        ping_bytes: approximate size of one ping.
        renderer_class: what renders a scene of the recipe, ``module:class``; see :func:`renderer_of`.
        samples_class: what reads the samples that estimators are compared on, ``module:class``.
        sample_frames: records of a sample in a comparison.
        estimators: that a comparison runs unless others are named, by name with commas between.
        variations: whether a comparison can give estimators wrong assumptions on its samples.
    """

    what: str
    settled: tuple[str, ...]
    planned: tuple[str, ...]
    decided_by: tuple[str, ...]
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
        """Return the arrays along dimensions."""

    @property
    def attributes(self) -> Fields:
        """Return the attributes of the store."""

    @property
    def ping_bytes(self) -> int:
        """Return the approximate size of one ping [bytes]."""

    @property
    def sample_frames(self) -> int:
        """Return the number of records of a sample in a comparison."""

    def reach(self, height: float, pitch: float = 0.0) -> Array:
        """Compute the footprint of a vehicle at a height [m] and a pitch [rad], > 0 down.

        Returns:
            Corners ``(n, 2)`` on the ground z = 0, starboard and forward of the vehicle [m].

        Raises:
            MitsonarError: no ground is seen.
        """

    def noise_model(self, name: str) -> NoiseModel | None:
        """Return the noise model of a name, or None if the name alone defines the noise.

        Raises:
            MitsonarError: unknown name.
        """

    def empty(self, read: Read, here: slice) -> NDArray[np.bool_]:
        """Find the pings without any echo, in all views or at all receivers ``(pings,)``."""

    def faults(self, read: Read, here: slice) -> list[str]:
        """Check the values of some frames. Return a sentence for each fault."""

    def warnings(self, read: Read) -> list[str]:
        """List what the user should know of a finished data set, a sentence each."""


def renderer_of(modality: Modality) -> type[Renderer]:
    """Load the class that renders scenes. It is loaded here, so that reading a stored set loads no simulator."""
    found: type[Renderer] = resolve_name(modality.renderer_class)
    return found


def samples_of(modality: Modality, url: str | Path, **options: Any) -> OpenedSamples:
    """Open the samples of a store, as estimators are compared on them.

    Raises:
        MitsonarError: options that do not fit, no samples in that part.
    """
    return resolve_name(modality.samples_class)(url, frames=modality.sample_frames, **options)


def ground_reach(eye: Array, directions: Array, range_max: float) -> Array:
    """Compute the corners ``(n, 2)`` of the area where rays meet the ground z = 0 [m].

    Rays that meet it beyond ``range_max``, or never, end at that range.

    Args:
        eye: where the rays start ``(3,)`` [m].
        directions: ``(rays, 3)``, unit.
        range_max: of the instrument [m].

    Raises:
        MitsonarError: the ground is out of range.
    """
    above = float(eye[2])
    if above <= 0 or above >= range_max:
        raise MitsonarError(
            f"the sonar sees no ground: it is {above:g} m over it, range_max is {range_max:g} m; lower height_m or "
            "raise range_max"
        )
    across = math.sqrt(range_max**2 - above**2)
    level = np.hypot(directions[:, 0], directions[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(directions[:, 2] < 0, above * level / -directions[:, 2], np.inf)
    distance = np.minimum(ground, across)
    unit = directions[:, :2] / np.maximum(level, 1e-12)[:, None]
    points = eye[:2] + unit * distance[:, None]
    return np.asarray(points[ConvexHull(points).vertices])


def empty_sentence(empty: Sequence[int], frames: int, checked: str = "") -> str:
    """Write the sentence on frames without echoes.

    Args:
        empty: their numbers.
        frames: number of frames that were checked.
        checked: which frames these are, unless all.
    """
    which = ", ".join(f"{number:,}" for number in empty[:6]) + (" ..." if len(empty) > 6 else "")
    return (
        f"{len(empty):,} of {frames:,} frames{checked} are empty, without a single echo ({which}): there the sonar sees "
        "nothing of the scene within its window; check world.size_m, flight.height_m, mount, range_min and range_max, and "
        "make another data set"
    )
