"""How torch reads samples: raw ones by number, a batch of them finished on a device."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from mitsonar.config.data import Recipe
from mitsonar.datasets.arrangement import Labels
from mitsonar.datasets.modality import Fields

__all__ = ["SEED_STEP", "Batch", "Batches", "Device", "Inputs", "RawSample", "StoredBatches"]

Inputs: TypeAlias = Any
"""The input of a network: a tensor, a tuple of tensors, or a tensor and the tensors of the ground's geometry by name."""

Batch: TypeAlias = tuple[Inputs, Tensor]
"""Inputs and labels of a batch, or of one sample."""

RawSample: TypeAlias = dict[str, NDArray[Any]]
"""A sample as it is stored: frames by view, their numbers, and the label."""

Device: TypeAlias = torch.device | str | None
"""A device of torch; None: where the tensors are."""

SEED_STEP = 1_000_003
"""Difference of the noise seeds of two epochs: more than any number of views."""


class Batches:
    """What all samples share. Each kind of samples defines how a batch of raw ones is :meth:`finished`.

    Attributes:
        recipe: of the data set.
        labels: encodes and decodes targets.
        seed: of noise and order.
        epoch: changes both; see :meth:`set_epoch`.
    """

    recipe: Recipe
    labels: Labels
    seed: int
    epoch: int

    def finished(self, batch: dict[str, Tensor], device: Device = None) -> Batch:
        """Make inputs and labels of a batch of raw samples, on a device."""
        raise NotImplementedError

    def described(self) -> Fields:
        """Describe the samples, as a checkpoint of a network that was trained on them keeps it.

        The keys are ``arrangement``, ``sonar``, ``trained_at``, ``model`` and ``noise``.
        """
        raise NotImplementedError

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, which changes the noise, and the order in :meth:`StoredBatches.loader`."""
        self.epoch = epoch

    @property
    def epoch_seed(self) -> int:
        """Return the seed of the noise of this epoch."""
        return self.seed + SEED_STEP * self.epoch

    def one(self, sample: RawSample) -> Batch:
        """Make the input and the label of one raw sample."""
        batch = {name: torch.as_tensor(values)[None] for name, values in sample.items()}
        inputs, label = self.finished(batch)
        return _first(inputs), label[0]

    def batches(
        self,
        raw: Dataset[RawSample],
        batch_size: int,
        device: Device,
        workers: int,
        *,
        shuffle: bool | None = None,
        generator: torch.Generator | None = None,
        drop_last: bool = False,
    ) -> Iterator[Batch]:
        """Yield inputs and labels of batches of raw samples, which workers read or render, on a device.

        Args:
            raw: the samples.
            batch_size: samples of a batch.
            device: of inputs and labels.
            workers: processes that read or render; 0: this process.
            shuffle: whether the order is drawn.
            generator: from which it is drawn.
            drop_last: whether a last, smaller batch is left out.
        """
        pinned = device is not None and torch.device(device).type == "cuda"
        start = "spawn" if workers else None  # a fork after the ray tracer has started is unsafe
        loader: DataLoader[RawSample] = DataLoader(
            raw,
            batch_size=batch_size,
            num_workers=workers,
            pin_memory=pinned,
            multiprocessing_context=start,
            shuffle=shuffle,
            generator=generator,
            drop_last=drop_last,
        )
        for batch in loader:
            yield self.finished(batch, device)


class StoredBatches(Batches):
    """Samples of a store, which are numbered."""

    def __len__(self) -> int:
        raise NotImplementedError

    def raw(self, index: int) -> RawSample:
        """Read a sample as it is stored."""
        raise NotImplementedError

    def __getitem__(self, index: int) -> Batch:
        return self.one(self.raw(index))

    def loader(
        self,
        batch_size: int,
        *,
        device: Device = None,
        shuffle: bool = True,
        workers: int = 0,
        drop_last: bool = False,
    ) -> Iterator[Batch]:
        """Yield the batches of one epoch on a device. Their order is a function of seed and epoch."""
        order = torch.Generator().manual_seed(self.epoch_seed)
        yield from self.batches(
            _Raw(self), batch_size, device, workers, shuffle=shuffle, generator=order, drop_last=drop_last
        )


def _first(inputs: Inputs) -> Inputs:
    """Return the first sample of a batch."""
    if isinstance(inputs, tuple):
        return tuple(map(_first, inputs))
    return {name: values[0] for name, values in inputs.items()} if isinstance(inputs, dict) else inputs[0]


@dataclass(frozen=True)
class _Raw(Dataset[RawSample]):
    """The raw samples, for workers that only read."""

    samples: StoredBatches

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> RawSample:
        return self.samples.raw(index)
