"""One shard of a data set: rendered, written and sealed, in any process."""

from __future__ import annotations

import threading

import numpy as np

from mitsonar.datasets.modality import Renderer, Values, renderer_of
from mitsonar.datasets.plan import Scene
from mitsonar.datasets.store import DataStore
from mitsonar.simulation.device import ensure_variant, release_memory

__all__ = ["forget", "make_shard"]

_RENDERER: dict[tuple[str, Scene], Renderer] = {}
"""The last scene, by all that it depends on: the recipe, and the scene's plan."""

_ONE_AT_A_TIME = threading.Lock()
"""A process renders one shard at a time, since the threads of a dask worker share one ray tracer."""


def make_shard(store: DataStore, shard: int) -> int:
    """Render and write one shard, and return its number. The last scene stays loaded for the next call."""
    with _ONE_AT_A_TIME:
        ensure_variant(store.about["variant"])
        store.write_shard(shard, _shard_values(store, shard))
    return shard


def forget() -> None:
    """Close the scene that :func:`make_shard` keeps loaded."""
    _RENDERER.clear()
    release_memory()


def _shard_values(store: DataStore, shard: int) -> dict[str, Values]:
    """Render all arrays of a shard, by name; frames of several scenes follow each other."""
    here = store.frames_of(shard)
    scene_of = store.read("scene")[here]
    planned = {name: store.read(name, here) for name in ("pose", *store.modality.planned)}
    firsts = _first_frames(store)
    parts: dict[str, list[Values]] = {}
    for number in np.unique(scene_of):
        mine = np.flatnonzero(scene_of == number)
        first = here.start + int(mine[0]) - firsts[int(number)]
        known = {name: values[mine] for name, values in planned.items()}
        for name, values in _renderer(store, int(number)).recorded(known, first, store.about).items():
            parts.setdefault(name, []).append(values)
    return {name: values[0] if len(values) == 1 else np.concatenate(values) for name, values in parts.items()}


def _first_frames(store: DataStore) -> dict[int, int]:
    """Find the first frame of each scene. Frames of a scene are consecutive."""
    numbers, first = np.unique(store.read("scene"), return_index=True)
    return dict(zip(numbers.tolist(), first.tolist(), strict=True))


def _renderer(store: DataStore, number: int) -> Renderer:
    """Return the renderer of a scene; the last one is kept."""
    scene = store.scenes[number]
    key = (store.recipe.model_dump_json(), scene)
    if key not in _RENDERER:
        forget()  # before the next is loaded: two scenes would need twice the memory
        _RENDERER[key] = renderer_of(store.modality)(store.recipe, scene)
    return _RENDERER[key]
