"""Which frames are for training, validation and test: sequences, whole worlds, or samples, assigned at random."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mitsonar.config.data_recipe import Recipe, Split
from mitsonar.datasets.plan import Scene
from mitsonar.errors import MitsonarError, meant
from mitsonar.worlds.world import Family

__all__ = ["PARTS", "deal", "world_of"]

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


def _counts(total: int, shares: NDArray[np.float64]) -> NDArray[np.int64]:
    """Divide ``total`` among the parts by their shares; a part with a share gets at least one."""
    counts = np.maximum(np.rint(shares * total).astype(np.int64), (shares > 0).astype(np.int64))
    largest = int(shares.argmax())
    counts[largest] = total - (counts.sum() - counts[largest])
    return np.maximum(counts, 0)


def _shares(split: Split) -> str:
    """Write the shares of all parts."""
    return ", ".join(f"{name} {getattr(split, name):.0%}" for name in PARTS)
