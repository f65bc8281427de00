"""Making a data set: shard by shard, by one process or many; what is whole is never made twice, whatever was killed."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mitsonar.config.data_recipe import Recipe
from mitsonar.datasets.modalities import modality_of
from mitsonar.datasets.modality import empty_sentence, renderer_of
from mitsonar.datasets.plan import Plan, scenes_of
from mitsonar.datasets.split import PARTS, deal, world_of
from mitsonar.datasets.store import PACKAGES, DataStore
from mitsonar.datasets.workers import made_by
from mitsonar.errors import MitsonarError
from mitsonar.io.provenance import refuse_other, versions
from mitsonar.io.storage import Storage
from mitsonar.simulation.variant import ensure_variant

__all__ = ["Made", "make_dataset"]

HALF_A_GROUP = re.compile(r"zarr\.[0-9a-f]{32}\.partial")
"""What a kill leaves before anything else is there; any other file is somebody's."""

ROUNDS = 3
"""How often shards that are not there at the end are made."""


@dataclass(frozen=True)
class Made:
    """What making a data set did.

    Attributes:
        url: where it lies.
        frames: of the data set.
        made: shards that were written now.
        shards: of the data set.
        warnings: a sentence each.
    """

    url: str
    frames: int
    made: int
    shards: int
    warnings: list[str]


def make_dataset(
    recipe: Recipe,
    url: str,
    *,
    sequences: int | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    verify: bool = False,
    begun: Callable[[int, int], None] = lambda frames, done: None,
    progress: Callable[[int], None] = lambda frames: None,
) -> Made:
    """Make a data set, or go on with one that was broken off; the result is the same bit for bit.

    Args:
        recipe: what it is.
        url: folder or URL of the store.
        sequences: only so many of the recipe's sequences.
        workers: processes on this machine; one renders in this process, with all its threads.
        scheduler: address of a dask scheduler that runs already; its workers render instead.
        verify: compare what is there with its digests, not only sizes, and make again what differs.
        begun: called with the frames of the data set and those that are there already.
        progress: called with the number of frames that were added.

    Raises:
        MitsonarError: the store is another data set, is written by somebody else, or was begun with other versions.
    """
    place = Storage(url)
    _refuse_what_is_not_ours(place)
    with place.locked() as still_ours:
        variant = ensure_variant()
        store = _begun_or_new(place, recipe, sequences, variant, verify)
        _clear_parts(place)
        todo = store.missing(verify=verify)
        begun(len(store), len(store) - _frames(store, todo))
        written = 0
        for _ in range(ROUNDS):  # what somebody damaged meanwhile is made again
            if not todo:
                break
            _check_versions(store)
            store.unfinish()
            for shard in made_by(store, todo, workers=workers, scheduler=scheduler):
                still_ours()
                progress(_frames(store, [shard]))
            written += len(todo)
            todo = store.missing()
        if todo:
            raise MitsonarError(f"{url}: shards vanish while others are written; does somebody else write there?")
        store.finish()
        return Made(place.url, len(store), written, store.shards, _warnings(store))


def _refuse_what_is_not_ours(place: Storage) -> None:
    """Arrays are made by removing what has their names: there must be nothing else."""
    there = [name for name in place.sizes() if not HALF_A_GROUP.fullmatch(name)]
    if there and "zarr.json" not in there:
        raise MitsonarError(f"{place.url} holds other things ({min(there)}) and is kept as it is: choose another -o")


def _begun_or_new(place: Storage, recipe: Recipe, sequences: int | None, variant: str, verify: bool) -> DataStore:
    """The store that is there, if it is the same data set, or a new one."""
    count = recipe.sequences if sequences is None else sequences
    scenes_of(recipe, count)  # before anything is rendered: are there so many?
    if "zarr.json" in place.sizes():
        store = DataStore.open(place, write=True, unfinished=True)
        _check_same(store, recipe, count, variant)
        if store.ready:
            if verify:
                store.mend_known(Plan.of(recipe, count))
            return store
    about = {**renderer_of(modality_of(recipe)).settled(recipe), "variant": variant, "versions": versions(PACKAGES)}
    return DataStore.create(place, recipe, Plan.of(recipe, count), about)


def _check_same(store: DataStore, recipe: Recipe, sequences: int, variant: str) -> None:
    """The store was begun as this recipe, with these versions.

    Raises:
        MitsonarError: it was not; what differs is named.
    """
    about = store.about
    asked = {**recipe.model_dump(mode="json"), "sequences": sequences}
    had = {**about["recipe"], "sequences": about["sequences"]}
    refuse_other(store.place.url, had, asked, " (`mitsonar dataset info --recipe` prints the recipe)")
    if about["variant"] != variant:
        raise MitsonarError(
            f"{store.place.url} was begun with {about['variant']}, this is {variant}, which differs in the last bits: set "
            f"MITSONAR_VARIANT={about['variant']}, or choose another -o"
        )


def _check_versions(store: DataStore) -> None:
    """What is still to be rendered fits what is there.

    Raises:
        MitsonarError: it was begun with other versions.
    """
    changed = store.other_versions()
    if changed:
        raise MitsonarError(
            f"{store.place.url} was begun with {', '.join(changed)}: the rest would differ from it; finish it with these "
            "versions, or choose another -o"
        )


def _clear_parts(place: Storage) -> None:
    """Remove what a killed writer left half written; files get their name only when they are whole."""
    if place.local:
        for name in place.sizes():
            if name.endswith(".partial"):
                place.remove(name)


def _too_few(store: DataStore) -> list[str]:
    """Whether the recipe's own split can be read."""
    split = store.recipe.split
    worlds = world_of(store.recipe, store.scenes)[store.read("scene")]
    try:
        deal(worlds, store.read("sequence"), split, max(PARTS, key=lambda part: getattr(split, part)))
    except MitsonarError as error:
        return [str(error)]
    return []


def _frames(store: DataStore, shards: list[int]) -> int:
    return sum(store.frames_of(shard).stop - store.frames_of(shard).start for shard in shards)


def _warnings(store: DataStore) -> list[str]:
    """What the user should know of a finished data set."""
    sentences = [*_too_few(store)]
    over_nothing = int(np.isnan(store.read("height_m")).sum())
    if over_nothing:
        sentences.append(
            f"nothing is below the sonar in {over_nothing:,} of {len(store):,} frames: world.size_m is larger than what the "
            "scene holds"
        )
    return [*sentences, *_empty(store), *store.modality.warnings(store.read)]


SHARDS_TO_LOOK_AT = 32
"""Of a large data set: to read all of it again would take minutes, and `mitsonar dataset check` does."""


def _empty(store: DataStore) -> list[str]:
    """Whether frames hold no echo, in shards spread evenly over the data set."""
    shards = np.unique(np.linspace(0, store.shards - 1, min(SHARDS_TO_LOOK_AT, store.shards)).round().astype(int))
    empty, frames = [], 0
    for shard in shards:
        here = store.frames_of(int(shard))
        try:
            empty += (here.start + np.flatnonzero(store.modality.empty(store.read, here))).tolist()
        except MitsonarError:  # damaged: `mitsonar dataset check` says which
            continue
        frames += here.stop - here.start
    looked_at = "" if frames == len(store) else f" that were looked at (of {len(store):,})"
    return [empty_sentence(empty, frames, looked_at)] if empty else []
