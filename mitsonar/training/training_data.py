"""What a training reads: batches whose order is a function of (seed, epoch, index), and samples to validate on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler, default_collate

from mitsonar.config.data_recipe import Recipe, load_recipe
from mitsonar.config.training_recipe import TrainingRecipe
from mitsonar.datasets.rendered_pairs import RawStream, RenderedPairs
from mitsonar.datasets.response_pairs import ImpulsePairs
from mitsonar.datasets.scene_rendering import calibrate
from mitsonar.datasets.torch_pairs import SonarPairs
from mitsonar.errors import MitsonarError
from mitsonar.simulation.variant import ensure_variant

__all__ = ["STEP", "Material", "Validation", "batches", "finished", "material_of", "seed_of"]

ORDER, STEP, CHOICE, WORLDS = 31, 32, 33, 34
"""Purposes of random numbers; see :func:`seed_of`."""

VALIDATION_WORLDS = 5
"""Worlds that rendered validation samples come from."""


def seed_of(*numbers: int) -> int:
    """A seed of 63 bits, a hash of whole numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> 1)


Kind = SonarPairs | RenderedPairs | ImpulsePairs
"""Of samples."""


@dataclass(frozen=True)
class Material:
    """What a network learns from.

    Attributes:
        samples: stored or rendered.
        numbers: of the stored samples that are for training; None: they are rendered.
        epoch: samples of an epoch.
        validation: what is validated on.
        about: what a resumed run must find again: name and digest of the data.
    """

    samples: Kind
    numbers: NDArray[np.int64] | None
    epoch: int
    validation: Validation
    about: dict[str, Any]


class Validation:
    """Samples that a network never learns from, with each level of noise; always the same ones, with the same noise.

    Args:
        samples: with raw labels.
        rows: the raw samples, or the numbers of stored ones.
        levels: names of noise levels.
    """

    def __init__(self, samples: Kind, rows: list[dict[str, Any]] | list[int], levels: list[str]) -> None:
        self.samples, self.rows = samples, rows
        self.arrangements: dict[str, Any] = {level: samples.at_noise(level) for level in dict.fromkeys(levels)}

    def __len__(self) -> int:
        return len(self.rows)

    def batches(self, size: int, device: torch.device | str | None = None) -> Iterator[tuple[str, Any, NDArray[np.float64]]]:
        """Noise level, inputs on a device, and true motions [m, rad] (or heights [m]), batch after batch."""
        for begin in range(0, len(self), size):
            rows = [
                self.samples.raw(row) if isinstance(row, int) else row  # type: ignore[call-arg, arg-type]
                for row in self.rows[begin : begin + size]
            ]
            raw = default_collate(rows)
            for level, arrangement in self.arrangements.items():
                self.samples.arrange = arrangement
                inputs, truth = self.samples.finished(raw, device)
                yield level, inputs, truth.cpu().numpy().astype(np.float64)


def material_of(recipe: TrainingRecipe, data: str | Path | None, *, render: bool, gain: float | None = None) -> Material:
    """What a recipe's network learns from: a data set's parts, or frames that are rendered as it learns.

    Args:
        recipe: of the training.
        data: path or URL of a data set; with ``render`` validation is on it.
        render: training samples are rendered, of the recipe of ``data`` or the one that the training's recipe names.
        gain: of rendered pixels, where it is known.

    Raises:
        MitsonarError: neither, no such data set, views or kinds it has not, too few samples.
    """
    if data is None and not render:
        raise MitsonarError("a training needs samples: give --data DATA.zarr, or --render to have them rendered")
    if not render:
        assert data is not None
        return _stored(recipe, data)
    if recipe.input.kind == "response":
        raise MitsonarError("impulse responses are not rendered in training: make a data set, and leave out --render")
    stored = None if data is None else _part(recipe, data, "validation", labels="raw")
    assert not isinstance(stored, ImpulsePairs)
    world = load_recipe(recipe.data, recipe.data_changes) if stored is None else stored.recipe
    if gain is None:
        ensure_variant()
        gain = calibrate(world) if stored is None else float(stored.store.about["gain"])
    samples = RenderedPairs(world, gain=gain, **recipe.arrangement())
    share = world.split.train if recipe.split == world.split.by else 1.0
    each = world.flight.pings - samples.frames + 1
    validation = _rendered_validation(recipe, world, gain) if stored is None else _validation(recipe, stored)
    about = {"name": world.name, "digest": world.digest("rendered"), "gain": gain}
    return Material(samples, None, max(1, round(world.sequences * share * recipe.part_of_data)) * each, validation, about)


def _stored(recipe: TrainingRecipe, data: str | Path) -> Material:
    pairs = _part(recipe, data, "train")
    numbers = np.flatnonzero(_within(recipe, pairs))
    if len(numbers) < recipe.batch:
        raise MitsonarError(
            f"{data} has {len(numbers)} samples for training, fewer than a batch of {recipe.batch}: make more, or "
            "lower batch"
        )
    validation = _validation(recipe, _part(recipe, data, "validation", labels="raw"))
    digest, gain = pairs.recipe.digest(len(pairs.store)), pairs.store.about.get("gain")
    about = {"name": pairs.recipe.name, "digest": digest, "gain": gain}
    return Material(pairs, numbers, len(numbers), validation, about)


def _part(recipe: TrainingRecipe, data: str | Path, part: str, **words: Any) -> SonarPairs | ImpulsePairs:
    kind = ImpulsePairs if recipe.input.kind == "response" else SonarPairs
    return kind(data, part=part, split=recipe.split_of, **{**recipe.arrangement(), **words})


def _within(recipe: TrainingRecipe, pairs: SonarPairs | ImpulsePairs) -> NDArray[np.bool_]:
    """Which samples lie in the part of the data that is used."""
    return np.asarray(pairs.first + pairs.frames <= recipe.part_of_data * len(pairs.store))


def _validation(recipe: TrainingRecipe, pairs: SonarPairs | ImpulsePairs) -> Validation:
    """Stored samples, those of other sequences first."""
    wanted = recipe.validation
    numbers = np.flatnonzero(_within(recipe, pairs))
    if not len(numbers):
        raise MitsonarError(
            f"the part of the data that is used, {recipe.part_of_data:g}, holds no validation sample: raise "
            "part_of_data, or make more"
        )
    numbers = np.random.default_rng([recipe.seed, CHOICE]).permutation(numbers)
    # how many of its sequence come before it: the first of each sequence, then the second ...
    sequence = pairs.sequence[pairs.first[numbers]]
    order = np.argsort(sequence, kind="stable")
    starts = np.flatnonzero(np.diff(sequence[order], prepend=-1))
    rank = np.empty(len(numbers), dtype=np.int64)
    rank[order] = np.arange(len(numbers)) - np.repeat(starts, np.diff(starts, append=len(numbers)))
    chosen = numbers[np.argsort(rank, kind="stable")][: wanted.pairs]
    return Validation(pairs, sorted(int(number) for number in chosen), [*wanted.noise, *recipe.noises])


def _rendered_validation(recipe: TrainingRecipe, world: Recipe, gain: float) -> Validation:
    """Samples of a few worlds of their own, rendered once."""
    wanted = recipe.validation
    count = wanted.pairs or 500
    words = {**recipe.arrangement(), "labels": "raw", "seed": seed_of(recipe.seed, WORLDS) >> 33}
    each = world.flight.pings - recipe.input.frames + 1
    length = -(-count // (max(each, 1) * VALIDATION_WORLDS))
    samples = RenderedPairs(world, gain=gain, length=count, buffer=1, sequences_a_world=length, **words)
    return Validation(samples, list(samples.raw()), [*wanted.noise, *recipe.noises])


# ---------------------------------------------------------------- batches


def batches(
    material: Material,
    recipe: TrainingRecipe,
    start: int,
    stop: int,
    *,
    device: torch.device,
    workers: int = 0,
    share: tuple[int, int] = (0, 1),
) -> DataLoader[Any]:
    """Batches ``start`` to ``stop`` of a training, whatever was read before; none that is skipped is read.

    On a CPU they are finished where they are read, else on the device: :func:`finished`.

    Args:
        material: what is learnt from.
        recipe: of the training.
        start: first step.
        stop: step after the last.
        device: that the network is on.
        workers: processes that read or render.
        share: number of this device and how many there are.
    """
    together = _Together(material.samples, finish=device.type == "cpu")
    words: dict[str, Any] = {
        "num_workers": workers,
        "collate_fn": together,
        "pin_memory": device.type == "cuda",
        "multiprocessing_context": "spawn" if workers else None,  # a fork after the ray tracer has started is unsafe
    }
    size = recipe.batch // share[1]
    if isinstance(material.samples, RenderedPairs):
        return DataLoader(RawStream(material.samples, size, start, share), batch_size=size, **words)
    assert material.numbers is not None
    order = Order(material.numbers, recipe.batch, recipe.seed, start, stop, share)
    return DataLoader(_Stored(material.samples), batch_sampler=order, **words)


class Order(Sampler[list[tuple[int, int]]]):
    """(epoch, sample) of each batch from step ``start`` on: each epoch deals out the samples anew, by (seed, epoch).

    What does not fill a batch at the end of an epoch is left to other epochs.
    """

    def __init__(
        self, numbers: NDArray[np.int64], batch: int, seed: int, start: int, stop: int, share: tuple[int, int]
    ) -> None:
        self.numbers, self.batch, self.seed, self.start, self.stop, self.share = numbers, batch, seed, start, stop, share

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        one, of = self.share
        known, dealt = -1, self.numbers
        for step in range(self.start, self.stop):
            epoch, place = divmod(step, len(self.numbers) // self.batch)
            if epoch != known:
                known, dealt = epoch, np.random.default_rng([self.seed, ORDER, epoch]).permutation(self.numbers)
            yield [(epoch, int(number)) for number in dealt[place * self.batch : (place + 1) * self.batch][one::of]]


@dataclass(frozen=True)
class _Stored(Dataset[Any]):
    """Raw samples with their epoch, for workers that only read."""

    pairs: SonarPairs | ImpulsePairs

    def __getitem__(self, key: tuple[int, int]) -> dict[str, Any]:
        epoch, number = key
        return {"epoch": epoch, **self.pairs.raw(number)}


@dataclass(frozen=True)
class _Together:
    """Raw samples become a batch: ``epoch``, ``frames``, and ``raw``, or finished ``inputs`` and ``label``."""

    samples: Kind
    finish: bool

    def __call__(self, rows: list[dict[str, Any]]) -> dict[str, Any]:
        epoch = rows[0].get("epoch", 0)
        raw = default_collate([{name: values for name, values in row.items() if name != "epoch"} for row in rows])
        batch = {"epoch": epoch, "frames": raw["frames"][:, 0].clone()}
        if not self.finish:
            return {**batch, "raw": raw}
        self.samples.set_epoch(epoch)
        inputs, label = self.samples.finished(raw)
        return {**batch, "inputs": inputs, "label": label}


def finished(batch: dict[str, Any], samples: Kind, device: torch.device) -> tuple[Any, Tensor]:
    """Inputs and labels of a batch on a device."""
    if "inputs" in batch:
        return batch["inputs"], batch["label"]
    samples.set_epoch(batch["epoch"])
    return samples.finished(batch["raw"], device)
