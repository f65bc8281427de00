"""How the samples of one part of a data set are found: their frames, poses and scenes, without torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.config.data import SPLITS, Recipe, Split, split_from
from mitsonar.datasets.modality import Fields
from mitsonar.datasets.store import DataStore, frames_in_part, samples_in_part, world_numbers
from mitsonar.errors import MitsonarError

__all__ = ["AnySplit", "Part", "first_frames", "split_for"]

AnySplit: TypeAlias = str | Split | Fields | None
"""A split as a name, an object, or the keys of a recipe; None: the recipe's split."""


@dataclass(frozen=True)
class Part:
    """The samples in one part of a data set; the frames of a sample are consecutive and belong to one sequence.

    Attributes:
        split: assignment of the frames to parts.
        frames: number of frames per sample.
        first: first frame of each sample ``(samples,)``.
        scene, sequence: numbers of scene and sequence of each frame of the store ``(frames,)``.
        pose: of the sonar ``(frames, 6)`` [m, rad].
        motion: to the next frame ``(frames, 3)`` [m, m, rad].
    """

    split: Split
    frames: int
    first: NDArray[np.int64]
    scene: NDArray[np.int32]
    sequence: NDArray[np.int32]
    pose: NDArray[np.float64]
    motion: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        store: DataStore,
        part: str,
        split: AnySplit,
        frames: int,
        *,
        seed: int = 0,
        one_per_sequence: bool = False,
    ) -> Part:
        """Find the samples of a part.

        Args:
            store: of the data set.
            part: ``train``, ``validation``, ``test``, or ``all``.
            split: see :func:`split_for`.
            frames: number of frames per sample.
            seed: of the random choice of one sample per sequence.
            one_per_sequence: whether to take only one sample from each sequence.

        Raises:
            MitsonarError: the part or split is unknown, or the part has no samples.
        """
        resolved = split_for(split, store.recipe)
        scene, sequence, pose, motion = (store.read(name) for name in ("scene", "sequence", "pose", "motion"))
        first = first_frames(world_numbers(store.recipe, store.scenes)[scene], sequence, resolved, part, frames)
        if not len(first):
            raise MitsonarError(
                f"{store.place.url} has no sample of {frames} frames in part {part!r}: its sequences have "
                f"{np.bincount(sequence).max()} frames; request fewer frames, or another part"
            )
        if one_per_sequence:
            rank = np.random.default_rng([seed, 5]).permutation(len(first))
            order = np.lexsort((rank, sequence[first]))
            first = np.sort(first[order][np.unique(sequence[first][order], return_index=True)[1]])
        return cls(resolved, frames, first, scene, sequence, pose, motion)

    def frame_slice(self, index: int) -> slice:
        """Return the slice of the store's frames that a sample holds."""
        first = int(self.first[index])
        return slice(first, first + self.frames)


def first_frames(
    world: NDArray[np.int64], sequence: NDArray[np.int32], split: Split, part: str, frames: int
) -> NDArray[np.int64]:
    """Return the first frame of each sample in a part ``(samples,)``.

    Args:
        world: number of the world of each frame ``(all frames,)``.
        sequence: number of the sequence of each frame ``(all frames,)``.
        split: assignment of the frames to parts.
        part: ``train``, ``validation``, ``test``, or ``all``.
        frames: number of frames per sample.

    Raises:
        MitsonarError: the part is unknown, or there are too few worlds, sequences or samples for the parts.
    """
    first = np.arange(max(0, len(sequence) - frames + 1))
    first = first[sequence[first] == sequence[first + frames - 1]]
    if split.by == "sample":
        chosen = samples_in_part(sequence[first], split, part)
    else:
        chosen = frames_in_part(world, sequence, split, part)[first]
    return np.asarray(first[chosen])


def split_for(split: AnySplit, recipe: Recipe) -> Split:
    """Return the split of a data set of this recipe; see :class:`SonarPairs` for the choices.

    Raises:
        MitsonarError: unknown name or key.
    """
    if isinstance(split, Split):
        return split
    if isinstance(split, dict):
        return split_from(split)
    match split:
        case None:
            return recipe.split
        case "sequence":
            return recipe.split if recipe.split.by == "sequence" else Split()
        case "scene":
            return recipe.split if recipe.split.by == "scene" else Split(by="scene", train=0.8, validation=0.1, test=0.1)
        case "sample":
            return recipe.split if recipe.split.by == "sample" else Split(by="sample", train=0.9, validation=0.05, test=0.05)
        case _:
            raise MitsonarError(f"split must be {', '.join(SPLITS)}, or keys as in a recipe: got {split!r}")
