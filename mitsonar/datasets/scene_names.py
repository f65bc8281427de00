"""Names of the shapes of a data set's scenes, which its labels number."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsonar.datasets.store import DataStore

__all__ = ["names_of_scenes"]


def names_of_scenes(store: DataStore) -> tuple[tuple[str, ...], dict[int, NDArray[np.int32]]]:
    """Return the names of all shapes of a data set, and the places among them of each scene's shapes.

    Names of a scene file are in the store; worlds that depend on a seed are built once more. The second part gives by the
    number of the scene the place of each ``shape_id``, and -1 for -1 ``(shapes + 1,)``. Both are empty where nothing is
    known: of frames that were recorded, and of scene files in stores of earlier versions.
    """
    if store.recipe.recorded is not None:
        return (), {}
    stored = store.about.get("shape_names")
    found: dict[int, tuple[str, ...]] = {}
    built: dict[tuple[str, int], tuple[str, ...]] = {}
    for number, scene in sorted(store.scenes.items()):
        family = store.recipe.family(scene.group)
        if family.called == "scene":
            if not isinstance(stored, list) or scene.group >= len(stored):
                return (), {}
            found[number] = tuple(map(str, stored[scene.group]))
        else:
            key = repr(family), scene.seed if family.seeded else 0
            if key not in built:
                built[key] = family.build(scene.seed).shape_names
            found[number] = built[key]
    names = tuple(dict.fromkeys(name for own in found.values() for name in own))
    if len(set(map(len, found.values()))) == 1 and len(set(found.values())) == 1:  # as the scenes number them
        return next(iter(found.values())), {}
    place = {name: at for at, name in enumerate(names)}
    return names, {number: np.array([*map(place.get, own), -1], dtype=np.int32) for number, own in found.items()}
