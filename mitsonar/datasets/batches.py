"""How torch reads samples: raw ones by number, a batch of them finished on a device."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset

from mitsonar.config.data_recipe import Recipe
from mitsonar.datasets.arrangement import Labels

__all__ = ["SEED_STEP", "Batches", "StoredBatches"]

SEED_STEP = 1_000_003
"""Between the noise seeds of two epochs: more than any number of views."""


class Batches:
    """What all samples share; a kind of samples says how a batch of raw ones is :meth:`finished`.

    Attributes:
        recipe: of the data set.
        labels: from targets to labels and back.
        seed: of noise and order.
        epoch: changes both; see :meth:`set_epoch`.
    """

    recipe: Recipe
    labels: Labels
    seed: int
    epoch: int

    def finished(self, batch: dict[str, Any], device: torch.device | str | None = None) -> tuple[Any, torch.Tensor]:
        """Inputs and labels of a batch of raw samples, on a device."""
        raise NotImplementedError

    def described(self) -> dict[str, Any]:
        """What a checkpoint keeps of the samples that a network was trained on: ``arrangement``, ``sonar``, ``trained_at``,
        ``model``, ``noise``."""
        raise NotImplementedError

    def set_epoch(self, epoch: int) -> None:
        """Another epoch draws other noise, and another order in :meth:`StoredBatches.loader`."""
        self.epoch = epoch

    @property
    def epoch_seed(self) -> int:
        """Seed of the noise of this epoch."""
        return self.seed + SEED_STEP * self.epoch

    def one(self, sample: dict[str, Any]) -> tuple[Any, torch.Tensor]:
        """Input and label of one raw sample."""
        batch = {name: torch.as_tensor(values)[None] for name, values in sample.items()}
        inputs, label = self.finished(batch)
        return _first(inputs), label[0]

    def batches(
        self, raw: Dataset[Any], batch_size: int, device: torch.device | str | None, workers: int, **words: Any
    ) -> Iterator[tuple[Any, torch.Tensor]]:
        """Inputs and labels of batches of raw samples, which workers read or render, on a device."""
        pinned = device is not None and torch.device(device).type == "cuda"
        start = "spawn" if workers else None  # a fork after the ray tracer has started is unsafe
        loader = DataLoader(
            raw, batch_size=batch_size, num_workers=workers, pin_memory=pinned, multiprocessing_context=start, **words
        )
        for batch in loader:
            yield self.finished(batch, device)


class StoredBatches(Batches):
    """Samples of a store, which have numbers."""

    def __len__(self) -> int:
        raise NotImplementedError

    def raw(self, index: int) -> dict[str, Any]:
        """A sample as it is stored."""
        raise NotImplementedError

    def __getitem__(self, index: int) -> tuple[Any, torch.Tensor]:
        return self.one(self.raw(index))

    def loader(
        self,
        batch_size: int,
        *,
        device: torch.device | str | None = None,
        shuffle: bool = True,
        workers: int = 0,
        drop_last: bool = False,
    ) -> Iterator[tuple[Any, torch.Tensor]]:
        """Batches of one epoch on a device; their order is a function of seed and epoch."""
        order = torch.Generator().manual_seed(self.epoch_seed)
        words = {"shuffle": shuffle, "generator": order, "drop_last": drop_last}
        yield from self.batches(_Raw(self), batch_size, device, workers, **words)


def _first(inputs: Any) -> Any:
    """The first sample of a batch."""
    if isinstance(inputs, tuple):
        return tuple(map(_first, inputs))
    return {name: values[0] for name, values in inputs.items()} if isinstance(inputs, dict) else inputs[0]


@dataclass(frozen=True)
class _Raw(Dataset[Any]):
    """The raw samples, for workers that only read."""

    samples: StoredBatches

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self.samples.raw(index)
