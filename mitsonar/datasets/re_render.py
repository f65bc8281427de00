"""Pairs of a data set re-rendered with a change: heave between the pings, or rays that move within their cells."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from mitsonar.config.data import recipe_from
from mitsonar.datasets.plan import scenes_of
from mitsonar.datasets.scene_rendering import SceneRenderer
from mitsonar.datasets.torch_pairs import SonarPairs
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.device import release_memory

__all__ = ["re_rendered"]


def re_rendered(
    pairs: SonarPairs,
    numbers: Sequence[int],
    *,
    shift: Callable[[int, NDArray[np.float64]], NDArray[np.float64]] | None = None,
    jitter: bool | None = None,
) -> Iterator[tuple[int, SonarFrames]]:
    """Re-render samples of a data set. Yield (number, frames) scene by scene, with the stored gain and noise.

    Args:
        pairs: samples of a store of images of one view. Its worlds are rebuilt.
        numbers: of the samples.
        shift: from a sample's number and its poses ``(frames, 6)`` to the poses that are rendered. The frames
            keep the stored poses, heights and times.
        jitter: whether rays move at random within their cells in each ping; default: as in the data set.

    Raises:
        MitsonarError: a store of vectors, or of several views.
    """
    fields = pairs.recipe.model_dump()
    recipe = pairs.recipe if jitter is None else recipe_from({**fields, "sonar": {**fields["sonar"], "jitter": jitter}})
    gain = float(pairs.store.about["gain"])
    wanted = np.asarray(numbers, dtype=np.int64)
    scene_of = pairs.scene[pairs.first[wanted]]
    for scene in scenes_of(pairs.recipe, pairs.recipe.sequences):
        mine = wanted[scene_of == scene.number]
        if not len(mine):
            continue
        renderer = SceneRenderer(recipe, scene)
        start = int(np.argmax(pairs.scene == scene.number))
        for index in mine.tolist():
            here = pairs.frame_numbers(index)
            poses = pairs.pose[here] if shift is None else shift(index, pairs.pose[here])
            values = renderer.frames(poses, here.start - start, gain)
            yield index, pairs.sonar_frames(index, next(array for name, array in values.items() if name.startswith("image")))
        del renderer
        release_memory()
