"""Which frames are for training, validation and test: sequences, whole worlds, or samples, assigned at random."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsonar.config.data import Recipe, Split
from mitsonar.datasets.plan import Scene
from mitsonar.errors import MitsonarError, meant
from mitsonar.worlds.world import Family

__all__ = ["PARTS", "deal", "deal_samples", "world_of"]

PARTS = ("train", "validation", "test")


def world_of(recipe: Recipe, scenes: dict[int, Scene]) -> NDArray[np.int64]:
    """Find the first scene with the same world, by number of the scene. Some worlds do not depend on their seed."""
    if recipe.recorded is not None:  # nobody knows whether two recordings are of one place
        return np.arange(max(scenes) + 1)
    known: dict[tuple[type[Family], str, int], int] = {}
    worlds = np.zeros(max(scenes) + 1, dtype=np.int64)
    for number, scene in sorted(scenes.items()):
        family = recipe.family(scene.group)
        world = (type(family), family.model_dump_json(), scene.seed if family.seeded else 0)
        worlds[number] = known.setdefault(world, number)
    return worlds


def deal(world: NDArray[np.int64], sequence: NDArray[np.int32], split: Split, part: str) -> NDArray[np.bool_]:
    """Mark the frames ``(frames,)`` of a part. Sequences, or worlds with all their frames, are assigned at random.

    Args:
        world: of each frame ``(frames,)``.
        sequence: of each frame ``(frames,)``.
        split: shares of the parts, and the seed.
        part: ``train``, ``validation``, ``test`` or ``all``.

    Raises:
        MitsonarError: unknown part, a part that the split lacks, fewer worlds or sequences than parts.
    """
    if part == "all":
        return np.ones(len(world), dtype=bool)
    if part not in PARTS:
        raise MitsonarError(f"part must be {', '.join(PARTS)} or all: got {part!r}{meant(part, (*PARTS, 'all'))}")
    shares = np.array([getattr(split, name) for name in PARTS])
    if shares[PARTS.index(part)] == 0:
        raise MitsonarError(f"the split by {split.by} has no {part} part: {_shares(split)}; give another split")
    owner = world if split.by == "scene" else sequence
    numbers = np.unique(owner)
    counts = _counts(len(numbers), shares)
    if (counts[shares > 0] == 0).any():
        raise MitsonarError(
            f"the data set has {len(numbers)} different {split.by}{'s' * (len(numbers) > 1)}, too few for {_shares(split)}: "
            "make more, give another split, or read part 'all'"
        )
    dealt = numbers[np.random.default_rng([split.seed, 6]).permutation(len(numbers))]
    ends = np.cumsum(counts)
    index = PARTS.index(part)
    return np.isin(owner, dealt[ends[index] - counts[index] : ends[index]])


def deal_samples(sequence: NDArray[np.int32], split: Split, part: str) -> NDArray[np.bool_]:
    """Mark the samples ``(samples,)`` of a part. Training and validation share sequences, whose samples are assigned one by
    one: these have the same motion and a frame in common. The test part, if there is one, is whole sequences.

    Args:
        sequence: of each sample ``(samples,)``.
        split: shares of the parts, and the seed.
        part: ``train``, ``validation``, ``test`` or ``all``.

    Raises:
        MitsonarError: as of :func:`deal`.
    """
    number = np.arange(len(sequence), dtype=np.int32)
    if part not in PARTS or not split.test:
        return deal(number.astype(np.int64), number, split, part)
    whole = Split(by="sequence", train=1 - split.test, validation=0.0, test=split.test, seed=split.seed)
    if part == "test":
        return deal(sequence.astype(np.int64), sequence, whole, part)
    marked = deal(sequence.astype(np.int64), sequence, whole, "train")
    rest = 1 - split.test
    shared = split.model_copy(update={"train": split.train / rest, "validation": split.validation / rest, "test": 0.0})
    marked[marked] = deal(number[marked].astype(np.int64), number[marked], shared, part)
    return marked


def _counts(total: int, shares: NDArray[np.float64]) -> NDArray[np.int64]:
    """Divide ``total`` among the parts by their shares; a part with a share gets at least one."""
    counts = np.maximum(np.rint(shares * total).astype(np.int64), (shares > 0).astype(np.int64))
    largest = int(shares.argmax())
    counts[largest] = total - (counts.sum() - counts[largest])
    return np.maximum(counts, 0)


def _shares(split: Split) -> str:
    """Write the shares of all parts."""
    return ", ".join(f"{name} {getattr(split, name):.0%}" for name in PARTS)
