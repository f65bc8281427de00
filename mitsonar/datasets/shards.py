"""One shard of a data set: rendered, written, sealed, in whatever process it falls to."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.datasets.modality import Renderer, renderer_of
from mitsonar.datasets.plan import Scene
from mitsonar.datasets.store import DataStore
from mitsonar.simulation.variant import ensure_variant, release_memory

__all__ = ["forget", "make_shard"]

_RENDERER: dict[tuple[str, Scene], Renderer] = {}
"""The last scene, by all that it depends on: the recipe, and which of its scenes."""

_ONE_AT_A_TIME = threading.Lock()
"""A process renders one shard at a time, whatever threads its scheduler has: they share one ray tracer."""


def make_shard(store: DataStore, shard: int) -> int:
    """Render and write one shard; its number again. The last scene stays open for the next call."""
    with _ONE_AT_A_TIME:
        ensure_variant(store.about["variant"])
        store.write_shard(shard, _shard_values(store, shard))
    return shard


def forget() -> None:
    """Close what :func:`make_shard` keeps open."""
    _RENDERER.clear()
    release_memory()


def _shard_values(store: DataStore, shard: int) -> dict[str, NDArray[Any]]:
    """All rendered arrays of a shard; frames of several scenes one after the other."""
    here = store.frames_of(shard)
    scene_of = store.read("scene")[here]
    planned = {name: store.read(name, here) for name in ("pose", *store.modality.planned)}
    firsts = _first_frames(store)
    parts: dict[str, list[NDArray[Any]]] = {}
    for number in np.unique(scene_of):
        mine = np.flatnonzero(scene_of == number)
        first = here.start + int(mine[0]) - firsts[int(number)]
        known = {name: values[mine] for name, values in planned.items()}
        for name, values in _renderer(store, int(number)).recorded(known, first, store.about).items():
            parts.setdefault(name, []).append(values)
    return {name: values[0] if len(values) == 1 else np.concatenate(values) for name, values in parts.items()}


def _first_frames(store: DataStore) -> dict[int, int]:
    """The first frame of each scene; frames of a scene are consecutive."""
    numbers, first = np.unique(store.read("scene"), return_index=True)
    return dict(zip(numbers.tolist(), first.tolist(), strict=True))


def _renderer(store: DataStore, number: int) -> Renderer:
    scene = store.scenes[number]
    key = (store.recipe.model_dump_json(), scene)
    if key not in _RENDERER:
        forget()  # before the next is loaded: two scenes would need twice the memory
        _RENDERER[key] = renderer_of(store.modality)(store.recipe, scene)
    return _RENDERER[key]
