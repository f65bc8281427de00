"""Samples of several data sets of one sonar, such as one in each model, joined for one training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor
from torch.utils.data import Dataset

from mitsonar.datasets.arrangement import Arrangement
from mitsonar.datasets.batches import Batch, Device, RawSample, StoredBatches
from mitsonar.datasets.modality import Fields
from mitsonar.datasets.torch_pairs import SonarPairs
from mitsonar.errors import MitsonarError

__all__ = ["JoinedPairs"]


class JoinedPairs(StoredBatches, Dataset[Any]):
    """Samples of several data sets, one set after the other. Samples, frames and sequences are numbered through all sets.

    The first set arranges all samples and encodes all labels.

    Args:
        parts: samples of each data set, arranged alike.

    Attributes:
        parts: as given.
        frames: number of frames of a sample.
        first: first frame of each sample ``(samples,)``.
        sequence: of each frame ``(frames,)``.

    Raises:
        MitsonarError: other views, window, beams, pixels, mount, heights or largest motions than those of the first set.
    """

    def __init__(self, parts: Sequence[SonarPairs]) -> None:
        self.parts = tuple(parts)
        leader = self.parts[0]
        for part in self.parts[1:]:
            _refuse_others(leader, part)
        self.recipe, self.labels, self.frames = leader.recipe, leader.labels, leader.frames
        self.seed, self.epoch = leader.seed, leader.epoch
        self._samples = np.cumsum([0, *map(len, self.parts)])
        self._frames = np.cumsum([0, *(len(part.sequence) for part in self.parts)])
        before = np.cumsum([0, *(int(part.sequence.max()) + 1 for part in self.parts)])
        self.first = np.concatenate([part.first + n for part, n in zip(self.parts, self._frames, strict=False)])
        self.sequence = np.concatenate([part.sequence + n for part, n in zip(self.parts, before, strict=False)])

    def __len__(self) -> int:
        return int(self._samples[-1])

    @property
    def arrange(self) -> Arrangement:
        """Return what turns frames into inputs."""
        return self.parts[0].arrange

    @arrange.setter
    def arrange(self, arrange: Arrangement) -> None:
        self.parts[0].arrange = arrange

    def at_noise(self, level: str) -> Arrangement:
        """Return the arrangement with one level of noise.

        Raises:
            MitsonarError: an unknown level.
        """
        return self.parts[0].at_noise(level)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, which changes noise and order."""
        self.epoch = epoch
        self.parts[0].set_epoch(epoch)

    def raw(self, index: int) -> RawSample:
        """Read a sample as it is stored."""
        place = int(np.searchsorted(self._samples, index, side="right")) - 1
        sample = self.parts[place].raw(index - int(self._samples[place]))
        return {**sample, "frames": sample["frames"] + self._frames[place]}  # so that no two sets share their noise

    def finished(self, batch: dict[str, Tensor], device: Device = None) -> Batch:
        """Make inputs and labels of a batch of raw samples of any of the sets, on a device."""
        return self.parts[0].finished(batch, device)

    def described(self) -> Fields:
        """Describe the samples, as a checkpoint keeps it: of the first set, with the models and names of all."""
        told = [part.described() for part in self.parts]
        names = [part.recipe.name for part in self.parts]
        return {**told[0], "model": _listed([one["model"] for one in told]), "data": _listed(names)}


def _listed(names: list[str]) -> str:
    return " and ".join(dict.fromkeys(names))


def _refuse_others(leader: SonarPairs, part: SonarPairs) -> None:
    """Refuse a data set whose samples are other inputs or labels than those of the first.

    Raises:
        MitsonarError: they are.
    """
    mine, its = (_what_must_agree(pairs) for pairs in (leader, part))
    other = [name for name in mine if mine[name] != its[name]]
    if other:
        name = other[0]
        raise MitsonarError(
            f"data sets of one training agree in {', '.join(mine)}: {leader.store.place.url} has {name} {mine[name]}, "
            f"{part.store.place.url} has {its[name]}; train on one of them, or make the other anew"
        )


def _what_must_agree(pairs: SonarPairs) -> Fields:
    """Return what decides the form of inputs and labels, by name."""
    views = [view for view in pairs.recipe.views if view.name in pairs.arrange.views]
    told = pairs.described()
    return {
        "views": pairs.arrange.views,
        "window": [(one.sonar.range_min, one.sonar.range_max, one.sonar.range_bins) for one in views],
        "beams": [(len(one.bearing_rad), *np.degrees(one.bearing_rad[[0, -1]]).round(6).tolist()) for one in views],
        "pixels": (pairs.stored_kind, pairs.recipe.pixel),
        "heights and mount": told["trained_at"],
        "largest motions": (pairs.labels.names, pairs.labels.high.tolist()),
    }
