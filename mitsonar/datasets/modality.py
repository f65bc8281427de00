"""A modality: one object that says what an instrument records of a ping, how it is simulated, checked, read and compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from mitsonar.errors import MitsonarError

if TYPE_CHECKING:
    from mitsonar.acoustics.noise import NoiseModel
    from mitsonar.config.data_recipe import Recipe
    from mitsonar.datasets.plan import Scene
    from mitsonar.instruments.imaging_sonar import Instrument

__all__ = [
    "Modality",
    "Read",
    "Renderer",
    "StoredArray",
    "StoredAxis",
    "empty_sentence",
    "ground_reach",
    "renderer_of",
    "samples_of",
]

Array = NDArray[np.float64]
Read = Callable[..., NDArray[Any]]
"""Values of an array of a store by its name, all or those of a slice of frames."""


@dataclass(frozen=True)
class StoredArray:
    """An array that is filled ping by ping.

    Attributes:
        kind: its type.
        about: a sentence on it, kept in the store.
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
    """One scene, loaded."""

    def __init__(self, recipe: Recipe, scene: Scene) -> None: ...

    @staticmethod
    def settled(recipe: Recipe) -> dict[str, Any]:
        """Return numbers of the whole data set, which are set before its first ping is recorded.

        Raises:
            MitsonarError: the first frames are empty.
        """

    def recorded(self, planned: dict[str, NDArray[Any]], first: int, about: dict[str, Any]) -> dict[str, NDArray[Any]]:
        """Return what is stored of consecutive pings of the scene, by name.

        Args:
            planned: what the plan says of them: ``pose``, and what the modality names.
            first: number of the first in the scene.
            about: attributes of the store.
        """


class Modality(Protocol):
    """What a recipe's instrument records, from simulation to comparison.

    Attributes:
        what: one ping's record is called.
        sonar: the instrument: its name, model and frame rate are what all have.
        stored: arrays that are filled ping by ping, those with a shape first.
        axes: arrays along their dimensions.
        attributes: of the store.
        settled: names of attributes that are numbers of the whole data set, set before its first ping is recorded.
        planned: arrays of the plan that are stored beside the poses.
        decided_by: packages whose versions decide what is recorded, beside those that always do.
        ping_bytes: of one ping, about.
        renderer_class: what renders a scene of the recipe, ``module:class``; see :func:`renderer_of`.
        samples_class: what reads the samples that estimators are compared on, ``module:class``.
        sample_frames: records of a sample in a comparison.
        estimators: that a comparison asks unless others are named, by name with commas between.
        variations: whether estimators can be told something wrong of its samples, in a comparison.
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
    def sonar(self) -> Instrument: ...
    @property
    def stored(self) -> dict[str, StoredArray]: ...
    @property
    def axes(self) -> dict[str, StoredAxis]: ...
    @property
    def attributes(self) -> dict[str, Any]: ...
    @property
    def ping_bytes(self) -> int: ...
    @property
    def sample_frames(self) -> int: ...

    def reach(self, height: float) -> Array:
        """Corners ``(n, 2)`` of what is seen of the ground z = 0, from a level vehicle so high, starboard, forward [m].

        Raises:
            MitsonarError: no ground is seen.
        """

    def noise_model(self, name: str) -> NoiseModel | None:
        """Return the noise of a name; None where the name is all there is to it.

        Raises:
            MitsonarError: unknown.
        """

    def empty(self, read: Read, here: slice) -> NDArray[np.bool_]:
        """Which of some pings hold no echo at all, in no view and at no receiver ``(pings,)``."""

    def faults(self, read: Read, here: slice) -> list[str]:
        """What is wrong with the values of some frames, a sentence each."""

    def warnings(self, read: Read) -> list[str]:
        """What the user should know of a finished data set, a sentence each."""


def renderer_of(modality: Modality) -> type[Renderer]:
    """Return the class that renders scenes; loaded here, so that reading a stored set enters no simulator."""
    found: type[Renderer] = resolve_name(modality.renderer_class)
    return found


def samples_of(modality: Modality, url: str | Path, **options: Any) -> Any:
    """Open the samples of a store, as estimators are compared on them.

    Raises:
        MitsonarError: options that do not fit, no samples in that part.
    """
    return resolve_name(modality.samples_class)(url, frames=modality.sample_frames, **options)


def ground_reach(eye: Array, directions: Array, range_max: float) -> Array:
    """Corners ``(n, 2)`` of where rays meet the ground z = 0 [m].

    Rays that meet it beyond ``range_max``, or never, count as far as that allows.

    Args:
        eye: where they start ``(3,)``.
        directions: ``(rays, 3)``, unit.
        range_max: of the instrument.

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


def empty_sentence(empty: Sequence[int], frames: int, looked_at: str = "") -> str:
    """What to say of frames without echoes.

    Args:
        empty: their numbers.
        frames: how many were looked at.
        looked_at: which these are, where not all.
    """
    which = ", ".join(f"{number:,}" for number in empty[:6]) + (" ..." if len(empty) > 6 else "")
    return (
        f"{len(empty):,} of {frames:,} frames{looked_at} are empty, without a single echo ({which}): there the sonar sees "
        "nothing of the scene within its window; check world.size_m, flight.height_m, mount, range_min and range_max, and "
        "make another data set"
    )
