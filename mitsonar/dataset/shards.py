"""One shard of a data set: rendered, written, sealed, in whatever process it falls to."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.dataset.rendering import SceneRenderer
from mitsonar.dataset.store import DataStore
from mitsonar.simulation.variant import ensure_variant, release_memory

__all__ = ["forget", "make_shard"]

_OPEN: dict[str, DataStore] = {}
_RENDERER: dict[tuple[str, int], SceneRenderer] = {}
_ONE_AT_A_TIME = threading.Lock()
"""A process renders one shard at a time, whatever threads its scheduler has: they share one ray tracer."""


def make_shard(url: str, shard: int) -> int:
    """Render and write one shard; its number again. The store and the last scene stay open for the next call."""
    with _ONE_AT_A_TIME:
        store = _OPEN.get(url)
        if store is None:
            forget()
            store = _OPEN[url] = DataStore.open(url, write=True, unfinished=True)
            ensure_variant(store.about["variant"])
        store.write_shard(shard, _shard_values(store, shard))
    return shard


def forget() -> None:
    """Close what :func:`make_shard` keeps open."""
    _OPEN.clear()
    _RENDERER.clear()
    release_memory()


def _shard_values(store: DataStore, shard: int) -> dict[str, NDArray[Any]]:
    """All rendered arrays of a shard; frames of several scenes one after the other."""
    here = store.frames_of(shard)
    scene_of, poses = store.read("scene")[here], store.read("pose", here)
    firsts = _first_frames(store)
    parts: dict[str, list[NDArray[Any]]] = {}
    gain = float(store.about["gain"])
    for number in np.unique(scene_of):
        mine = np.flatnonzero(scene_of == number)
        first = here.start + int(mine[0]) - firsts[int(number)]
        for name, values in _renderer(store, int(number)).frames(poses[mine], first, gain).items():
            parts.setdefault(name, []).append(values)
    return {name: values[0] if len(values) == 1 else np.concatenate(values) for name, values in parts.items()}


def _first_frames(store: DataStore) -> dict[int, int]:
    """The first frame of each scene; frames of a scene are consecutive."""
    numbers, first = np.unique(store.read("scene"), return_index=True)
    return dict(zip(numbers.tolist(), first.tolist(), strict=True))


def _renderer(store: DataStore, scene: int) -> SceneRenderer:
    key = (store.place.url, scene)
    if key not in _RENDERER:
        _RENDERER.clear()  # before the next is loaded: two scenes would need twice the memory
        release_memory()
        _RENDERER[key] = SceneRenderer(store.recipe, store.scenes[scene])
    return _RENDERER[key]
