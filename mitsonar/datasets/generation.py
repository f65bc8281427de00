"""Making a data set: shard by shard, by one process or many. A whole shard is never made twice, whatever was killed."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mitsonar.config.data import Recipe
from mitsonar.datasets.modalities import modality_of
from mitsonar.datasets.modality import empty_sentence, renderer_of
from mitsonar.datasets.plan import Plan, scenes_of
from mitsonar.datasets.split import PARTS, deal, world_of
from mitsonar.datasets.store import PACKAGES, DataStore
from mitsonar.datasets.workers import made_by
from mitsonar.errors import MitsonarError
from mitsonar.io.runs import refuse_other, versions
from mitsonar.io.storage import Storage
from mitsonar.simulation.device import ensure_variant

__all__ = ["Made", "make_dataset"]

HALF_A_GROUP = re.compile(r"zarr\.[0-9a-f]{32}\.partial")
"""What a kill leaves before anything else is there. Any other file belongs to the user."""

ROUNDS = 3
"""How often shards that are missing at the end are made."""

SHARDS_TO_CHECK = 32
"""Shards of a large data set that are searched for empty frames. `mitsonar dataset check` reads all of them."""


@dataclass(frozen=True)
class Made:
    """What making a data set did.

    Attributes:
        url: of the store.
        frames: of the data set.
        made: shards that this call wrote.
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
    """Make a data set, or continue one that was interrupted. The result is the same bit for bit.

    Args:
        recipe: of the data set.
        url: folder or URL of the store.
        sequences: only so many of the recipe's sequences.
        workers: processes on this machine; with 1 this process renders, with all its threads.
        scheduler: address of a running dask scheduler, whose workers render instead.
        verify: whether existing shards are compared with their digests, too, and remade where these differ.
        begun: called with the number of frames of the data set and the number of those that exist already.
        progress: called with the number of frames that were added.

    Raises:
        MitsonarError: the store is another data set, another process writes it, or it was begun with other versions.
    """
    if recipe.recorded is not None:
        raise MitsonarError(f"the recipe {recipe.name} is of recorded frames: `mitsonar dataset from-frames` copies them")
    storage = Storage(url)
    _refuse_other_files(storage)
    with storage.locked() as still_ours:
        variant = ensure_variant()
        store = _open_or_create(storage, recipe, sequences, variant, verify)
        _clear_parts(storage)
        todo = store.missing(verify=verify)
        begun(len(store), len(store) - _frames(store, todo))
        written = 0
        for _ in range(ROUNDS):  # what was damaged meanwhile is remade
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
            raise MitsonarError(f"{url}: shards vanish while others are written; does another program write there?")
        store.finish()
        return Made(storage.url, len(store), written, store.shards, _warnings(store))


def _refuse_other_files(storage: Storage) -> None:
    """Refuse a folder with other files: creating an array removes what has its name.

    Raises:
        MitsonarError: there are other files.
    """
    there = [name for name in storage.sizes() if not HALF_A_GROUP.fullmatch(name)]
    if there and "zarr.json" not in there:
        raise MitsonarError(f"{storage.url} holds other things ({min(there)}) and is kept as it is: choose another -o")


def _open_or_create(storage: Storage, recipe: Recipe, sequences: int | None, variant: str, verify: bool) -> DataStore:
    """Open the existing store if it is the same data set, or create a new one."""
    count = recipe.sequences if sequences is None else sequences
    scenes_of(recipe, count)  # refuses a wrong number before anything is rendered
    if "zarr.json" in storage.sizes():
        store = DataStore.open(storage, write=True, unfinished=True)
        _check_same(store, recipe, count, variant)
        if store.ready:
            if verify:
                store.mend_known(Plan.of(recipe, count))
            return store
    about = {**renderer_of(modality_of(recipe)).settled(recipe), "variant": variant, "versions": versions(PACKAGES)}
    return DataStore.create(storage, recipe, Plan.of(recipe, count), about)


def _check_same(store: DataStore, recipe: Recipe, sequences: int, variant: str) -> None:
    """Check that the store was begun with this recipe, number of sequences and variant.

    Raises:
        MitsonarError: it was not; the message names what differs.
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
    """Check that the missing shards would fit the existing ones.

    Raises:
        MitsonarError: the store was begun with other versions.
    """
    changed = store.other_versions()
    if changed:
        raise MitsonarError(
            f"{store.place.url} was begun with {', '.join(changed)}: the rest would differ from it; finish it with these "
            "versions, or choose another -o"
        )


def _clear_parts(storage: Storage) -> None:
    """Remove the partial files of a killed writer. A file gets its name only when it is whole."""
    if storage.local:
        for name in storage.sizes():
            if name.endswith(".partial"):
                storage.remove(name)


def _too_few(store: DataStore) -> list[str]:
    """Return a sentence if the recipe's own split has too few scenes or sequences."""
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
    """List what the user should know of a finished data set, a sentence each."""
    sentences = [*_too_few(store)]
    over_nothing = int(np.isnan(store.read("height_m")).sum())
    if over_nothing:
        sentences.append(
            f"nothing is below the sonar in {over_nothing:,} of {len(store):,} frames: world.size_m is larger than what the "
            "scene holds"
        )
    return [*sentences, *_empty(store), *store.modality.warnings(store.read)]


def _empty(store: DataStore) -> list[str]:
    """Return a sentence if frames hold no echo, in shards spread evenly over the data set."""
    shards = np.unique(np.linspace(0, store.shards - 1, min(SHARDS_TO_CHECK, store.shards)).round().astype(int))
    empty, frames = [], 0
    for shard in shards:
        here = store.frames_of(int(shard))
        try:
            empty += (here.start + np.flatnonzero(store.modality.empty(store.read, here))).tolist()
        except MitsonarError:  # damaged: `mitsonar dataset check` says which
            continue
        frames += here.stop - here.start
    checked = "" if frames == len(store) else f" that were checked (of {len(store):,})"
    return [empty_sentence(empty, frames, checked)] if empty else []
