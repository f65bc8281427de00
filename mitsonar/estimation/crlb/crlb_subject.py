"""What a bound is asked for: poses in one scene, or first poses of a data set's pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mitsonar.config.data import MirrorKeys
from mitsonar.datasets.make import SceneRenderer
from mitsonar.datasets.store import DataStore, deal, world_of
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import Segment, View, Whole
from mitsonar.simulation.device import release_memory
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = ["Place", "Subject", "subject_of_data", "subject_of_scene"]


@dataclass(frozen=True)
class Place:
    """A scene, and the poses in it.

    Attributes:
        scene: Mitsuba's.
        poses: of the sonar ``(n, 6)``.
        heights: over the ground ``(n,)`` [m].
        seed: of the scatterers here; None: the sonar's.
    """

    scene: mi.Scene
    poses: NDArray[np.float64]
    heights: NDArray[np.float64]
    seed: int | None = None


@dataclass(frozen=True)
class Subject:
    """What a bound is asked for.

    Attributes:
        sonar: the instrument.
        views: its views, made for a sonar; None where they cannot be made for another.
        places: one after another, so that only one scene is in memory.
        poses: in all of them.
        gain: constant; None: set on the frames.
        mirrors: of all scenes.
    """

    sonar: Sonar
    views: Callable[[Sonar], list[View]]
    places: Callable[[], Iterator[Place]]
    poses: int
    gain: float | None
    mirrors: MirrorKeys = None


def subject_of_scene(
    scene: mi.Scene, sonar: Sonar, poses: NDArray[np.float64], *, segments: list[str], gain: float | None = None
) -> Subject:
    """Poses in one scene.

    Args:
        scene: Mitsuba's.
        sonar: the instrument.
        poses: of the sonar ``(n, 6)``.
        segments: names of portions of a looking-down sonar's view; none: all of it.
        gain: constant; None: set on the frames.

    Raises:
        MitsonarError: a pose over nothing.
    """
    heights = np.concatenate([batch.height_m for batch in Simulator(scene, sonar).pings(poses)])
    if not np.isfinite(heights).all():
        raise MitsonarError("nothing is below the sonar at some pose: give a pose over the scene with --from")
    place = Place(scene, poses, heights)
    return Subject(sonar, lambda other: _views(other, segments), lambda: iter([place]), len(heights), gain)


def subject_of_data(
    source: str, pairs: int, *, part: str | None = None, gain: float | None = None, seed: int | None = None
) -> Subject:
    """First poses of pairs of a data set, scene by scene.

    Args:
        source: path or URL.
        pairs: how many, each of a sequence of its own.
        part: of the data set; None: that which training does not see.
        gain: constant; None: the data set's.
        seed: of the rays; None: the data set's.

    Raises:
        MitsonarError: no pair, or no data set.
    """
    if pairs < 1:
        raise MitsonarError(f"--pairs must be at least 1: got {pairs}")
    store = DataStore.open(source)
    recipe = store.recipe
    scene, sequence, pose, height = (store.read(name) for name in ("scene", "sequence", "pose", "height_m"))
    part = part or recipe.split.unseen
    mine = np.flatnonzero(deal(world_of(recipe, store.scenes)[scene], sequence, recipe.split, part) & np.isfinite(height))
    first = mine[np.unique(sequence[mine], return_index=True)[1]]
    if not len(first):
        raise MitsonarError(f"{source} has no frame over ground in part {part!r}: give --part all")
    chosen = first[np.unique(np.linspace(0, len(first) - 1, min(pairs, len(first))).round().astype(int))]

    def places() -> Iterator[Place]:
        for number in np.unique(scene[chosen]):
            here = chosen[scene[chosen] == number]
            renderer = SceneRenderer(recipe, store.scenes[int(number)])
            yield Place(renderer.simulator.tracer.scene, pose[here], height[here], renderer.simulator.sonar.seed)
            del renderer
            release_memory()

    def views(other: Sonar) -> list[View]:
        if recipe.receivers and other != own:
            raise MitsonarError("--vary and --height need one sonar that sends and hears: this data set has receivers")
        return recipe.views if recipe.receivers else _views(other, recipe.segments)

    own = recipe.instrument if seed is None else recipe.instrument.replace(seed=seed)
    gain = float(store.about["gain"]) if gain is None else gain
    return Subject(own, views, places, len(chosen), gain, recipe.mirrors)


def _views(sonar: Sonar, segments: list[str]) -> list[View]:
    return [Segment(sonar, name) for name in segments] or [Whole(sonar)]
