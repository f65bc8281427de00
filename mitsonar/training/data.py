"""Which samples a training uses: batches in an order that depends only on (seed, epoch, index), and validation samples."""

from __future__ import annotations

import math
import signal
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler, default_collate

from mitsonar.config.data import Recipe, load_recipe
from mitsonar.config.training import TrainingRecipe
from mitsonar.datasets.make import calibrate
from mitsonar.datasets.rendered import RawStream, RenderedPairs
from mitsonar.datasets.samples import ImpulsePairs, JoinedPairs, SonarPairs
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.io.runs import digest
from mitsonar.simulation.device import ensure_variant

if TYPE_CHECKING:
    from mitsonar.networks.corrnet import GaussianHead, Ground

    NetworkInput = Tensor | tuple[Tensor | Ground, ...]
    "One input of a network, or several, which are passed as separate arguments."
    NetworkOutput = Tensor | GaussianHead
    "Labels ``(batch, outputs)``, or motions with a covariance."
    from mitsonar.datasets.arrangement import Arrangement
    from mitsonar.datasets.responses import Packing

__all__ = [
    "STEP",
    "Array",
    "Batch",
    "JsonObject",
    "Material",
    "RawSample",
    "Validation",
    "batches",
    "finished",
    "material_of",
    "seed_of",
]


# ---------------- Types


Array = NDArray[np.float64]
"""Numbers in SI units, unless stated otherwise."""

JsonObject = dict[str, Any]
"""Content of a JSON file, a YAML file or a report: plain values, keyed by name."""

RawSample = dict[str, Any]
"""One sample as stored in a data set: arrays and numbers, keyed by name, before noise and arrangement."""

Batch = dict[str, Any]
"""Samples of one step: ``epoch``, ``frames``, and ``raw`` samples, or finished ``inputs`` and ``label``."""


# ---------------- Training and validation data


ORDER, STEP, CHOICE, WORLDS = 31, 32, 33, 34
"""Keys of the random streams, by purpose; see :func:`seed_of`."""

VALIDATION_WORLDS = 5
"""Number of worlds from which rendered validation samples come."""


def seed_of(*numbers: int) -> int:
    """Return a seed of 63 bits as a hash of integers."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> 1)


Stored = SonarPairs | JoinedPairs | ImpulsePairs
"""Samples of data sets."""

Kind = Stored | RenderedPairs
"""Samples for training."""


@dataclass(frozen=True)
class Material:
    """Data of a training.

    Attributes:
        samples: stored or rendered samples.
        numbers: numbers of the stored samples for training; None if samples are rendered.
        epoch: number of samples per epoch.
        validation: validation samples.
        about: name, digest and gain of the data, which must be the same in a resumed run.
    """

    samples: Kind
    numbers: NDArray[np.int64] | None
    epoch: int
    validation: Validation
    about: JsonObject


class Validation:
    """Samples that training does not use, at each noise level; samples and noise are the same in every validation.

    Args:
        samples: stored or rendered samples with labels of kind ``raw``.
        rows: raw samples, or numbers of stored samples.
        levels: names of the noise levels.
    """

    def __init__(self, samples: Kind, rows: list[RawSample] | list[int], levels: list[str]) -> None:
        self.samples, self.rows = samples, rows
        self.arrangements: dict[str, Arrangement | Packing] = {
            level: samples.at_noise(level) for level in dict.fromkeys(levels)
        }

    def __len__(self) -> int:
        return len(self.rows)

    def batches(self, size: int, device: torch.device | str | None = None) -> Iterator[tuple[str, NetworkInput, Array]]:
        """Yield the noise level, inputs on a device, and true motions [m, m, rad] or heights [m] of each batch."""
        for begin in range(0, len(self), size):
            rows = [self.samples.raw(row) if isinstance(row, int) else row for row in self.rows[begin : begin + size]]
            raw = default_collate(rows)
            for level, arrangement in self.arrangements.items():
                self.samples.arrange = arrangement
                inputs, truth = self.samples.finished(raw, device)
                yield level, inputs, truth.cpu().numpy().astype(np.float64)


def material_of(
    recipe: TrainingRecipe, data: str | Path | Sequence[str | Path] | None, *, render: bool, gain: float | None = None
) -> Material:
    """Open the data of a training: parts of data sets, or frames that are rendered during training.

    Args:
        recipe: of the training.
        data: path or URL of a data set, or of several, which are joined. With ``render`` one, for validation only.
        render: render training samples, by the recipe of ``data`` or the one that ``recipe`` names.
        gain: of rendered pixels, if it is known.

    Raises:
        MitsonarError: neither ``data`` nor ``render`` is given, a data set does not exist, lacks views or kinds or has too
            few samples, or several data sets cannot be joined.
    """
    sets = [] if data is None else [data] if isinstance(data, str | Path) else list(data)
    if not sets and not render:
        raise MitsonarError("training needs samples: give --data DATA.zarr, or --render to render them")
    if not render:
        return _stored(recipe, sets)
    if len(sets) > 1:
        raise MitsonarError(
            f"with --render at most one data set, for validation: got {len(sets)}; omit --render, or give one"
        )
    if recipe.input.kind == "response":
        raise MitsonarError("impulse responses are not rendered in training: make a data set, and omit --render")
    stored = _part(recipe, sets[0], "validation", labels="raw") if sets else None
    assert not isinstance(stored, ImpulsePairs)
    world = load_recipe(recipe.data, recipe.data_changes) if stored is None else stored.recipe
    if gain is None:
        ensure_variant()
        gain = calibrate(world) if stored is None else float(stored.store.about["gain"])
    samples = RenderedPairs(world, gain=gain, **recipe.arrangement())
    share = world.split.train if recipe.split == world.split.by else 1.0
    per_sequence = world.flight.pings - samples.frames + 1
    validation = _rendered_validation(recipe, world, gain) if stored is None else _validation(recipe, stored)
    validated_on = [] if stored is None else [len(stored.store)]  # else --resume could exchange the validation samples
    about = {"name": world.name, "digest": world.digest("rendered", *validated_on), "gain": gain}
    return Material(
        samples, None, max(1, round(world.sequences * share * recipe.part_of_data)) * per_sequence, validation, about
    )


def _stored(recipe: TrainingRecipe, sets: list[str | Path]) -> Material:
    pairs = _joined(recipe, sets, "train")
    numbers = np.flatnonzero(_in_used_part(recipe, pairs))
    if len(numbers) < recipe.batch:
        raise MitsonarError(
            f"{' and '.join(map(str, sets))}: {len(numbers)} samples for training, fewer than a batch of {recipe.batch}: "
            "make more, or lower batch"
        )
    unseen = _joined(recipe, sets, "validation", labels="raw")
    validation = _validation(recipe, unseen)
    if isinstance(pairs, JoinedPairs) and isinstance(unseen, JoinedPairs):
        _warn_of_common_samples(_shown_by(pairs, numbers.tolist()), _shown_by(unseen, validation.rows))
    return Material(pairs, numbers, len(numbers), validation, _about(pairs))


def _shown_by(pairs: JoinedPairs, numbers: Sequence[int | RawSample]) -> list[tuple[str, int, bytes]]:
    """Return world, seed and first pose of samples, which are equal if two of them show one motion over one world."""
    shown = []
    for part in pairs.parts:
        recipe, scenes = part.recipe, part.store.scenes
        worlds = {number: "" if recipe.recorded else repr(recipe.family(one.group)) for number, one in scenes.items()}
        for first in part.first.tolist():
            scene = int(part.scene[first])
            shown.append((worlds[scene], scenes[scene].seed, part.pose[first].tobytes()))
    return [shown[number] for number in numbers if isinstance(number, int)]


def _warn_of_common_samples(training: list[tuple[str, int, bytes]], validation: list[tuple[str, int, bytes]]) -> None:
    """Warn if data sets of one seed, but of other sizes, put one motion over one world into training and validation."""
    known = set(training)
    common = sum(one in known for one in validation)
    if common:
        warnings.warn(
            f"{common} of {len(validation)} validation samples show a motion over a world that training sees in another "
            "data set, so errors of validation are too small: make one of the data sets with another --seed, or both with "
            "the same scenes and sequences",
            MitsonarWarning,
            stacklevel=4,
        )


def _joined(recipe: TrainingRecipe, sets: list[str | Path], part: str, **options: str) -> Stored:
    """Open a part of one data set, or of several as one.

    Raises:
        MitsonarError: several data sets hold impulse responses, or do not fit each other.
    """
    if len(sets) == 1:
        return _part(recipe, sets[0], part, **options)
    opened = [_part(recipe, data, part, **options) for data in sets]
    pairs = [samples for samples in opened if isinstance(samples, SonarPairs)]
    if len(pairs) < len(opened):
        raise MitsonarError(f"training on impulse responses takes one data set: got {len(sets)}; give --data once")
    return JoinedPairs(pairs)


def _about(pairs: Stored) -> JsonObject:
    """Return name, digest and gain of the data, which must be the same in a resumed run; joined data sets have no gain.

    ``sequences`` has the number of sequences in each data set, keyed by the digest of its recipe.
    """
    if not isinstance(pairs, JoinedPairs):
        data_digest, gain = pairs.recipe.digest(len(pairs.store)), pairs.store.about.get("gain")
        sequences = {pairs.recipe.digest(): pairs.store.about["sequences"]}
        return {"name": pairs.recipe.name, "digest": data_digest, "gain": gain, "sequences": sequences}
    digests = [part.recipe.digest(len(part.store)) for part in pairs.parts]
    sequences = {part.recipe.digest(): part.store.about["sequences"] for part in pairs.parts}
    total = digest(" ".join(digests))[:16]
    return {"name": pairs.described()["data"], "digest": total, "gain": None, "sequences": sequences}


def _part(recipe: TrainingRecipe, data: str | Path, part: str, **options: str) -> SonarPairs | ImpulsePairs:
    kind = ImpulsePairs if recipe.input.kind == "response" else SonarPairs
    return kind(data, part=part, split=recipe.resolved_split, **{**recipe.arrangement(), **options})


def _in_used_part(recipe: TrainingRecipe, pairs: Stored) -> NDArray[np.bool_]:
    """Mark the samples ``(samples,)`` that lie in the used part of the data, which is the first frames of each data set."""
    if isinstance(pairs, JoinedPairs):
        return np.concatenate([_in_used_part(recipe, part) for part in pairs.parts])
    return np.asarray(pairs.first + pairs.frames <= recipe.part_of_data * len(pairs.store))


def _validation(recipe: TrainingRecipe, pairs: Stored) -> Validation:
    """Choose stored validation samples from as many sequences as possible."""
    settings = recipe.validation
    numbers = np.flatnonzero(_in_used_part(recipe, pairs))
    if not len(numbers):
        raise MitsonarError(
            f"the used part of the data, {recipe.part_of_data:g}, has no validation sample: raise part_of_data, or make more"
        )
    numbers = np.random.default_rng([recipe.seed, CHOICE]).permutation(numbers)
    # Rank the samples within their sequence: take the first sample of each sequence, then the second ...
    sequence = pairs.sequence[pairs.first[numbers]]
    order = np.argsort(sequence, kind="stable")
    starts = np.flatnonzero(np.diff(sequence[order], prepend=-1))
    rank = np.empty(len(numbers), dtype=np.int64)
    rank[order] = np.arange(len(numbers)) - np.repeat(starts, np.diff(starts, append=len(numbers)))
    chosen = numbers[np.argsort(rank, kind="stable")][: settings.pairs]
    return Validation(pairs, sorted(int(number) for number in chosen), [*settings.noise, *recipe.noises])


def _rendered_validation(recipe: TrainingRecipe, world: Recipe, gain: float) -> Validation:
    """Render validation samples of a few worlds that training does not use."""
    settings = recipe.validation
    count = settings.pairs or 500
    options = {**recipe.arrangement(), "labels": "raw", "seed": seed_of(recipe.seed, WORLDS) >> 33}
    per_sequence = world.flight.pings - recipe.input.frames + 1
    length = -(-count // (max(per_sequence, 1) * VALIDATION_WORLDS))
    samples = RenderedPairs(world, gain=gain, length=count, buffer=1, sequences_per_world=length, **options)
    return Validation(samples, list(samples.raw()), [*settings.noise, *recipe.noises])


# ---------------- Batches


def batches(
    material: Material,
    recipe: TrainingRecipe,
    start: int,
    stop: int,
    *,
    device: torch.device,
    workers: int = 0,
    share: tuple[int, int] = (0, 1),
) -> DataLoader[Batch] | BatchesInMemory:
    """Return the batches for steps ``start`` to ``stop`` of a training.

    The batch of a step does not depend on ``start``, and skipped batches are not read. On a CPU, the processes that read
    also finish the samples. Otherwise :func:`finished` does this on the device. A data set that fits into the memory of a
    GPU is copied there once.

    Args:
        material: data of the training.
        recipe: of the training.
        start: first step.
        stop: step after the last one.
        device: of the network.
        workers: number of processes that read or render.
        share: index of this device, and number of devices.
    """
    collation = _Collation(material.samples, finish=device.type == "cpu")
    options: JsonObject = {
        "num_workers": workers,
        "collate_fn": collation,
        "pin_memory": device.type == "cuda",
        "multiprocessing_context": "spawn" if workers else None,  # a fork is unsafe once the ray tracer runs
        "worker_init_fn": _leave_signals,
    }
    size = recipe.batch // share[1]
    if isinstance(material.samples, RenderedPairs):
        return DataLoader(RawStream(material.samples, size, start, share), batch_size=size, **options)
    assert material.numbers is not None
    order = Order(material.numbers, recipe.batch, recipe.seed, start, stop, share)
    if not isinstance(material.samples, JoinedPairs) and fits_on(device, material.samples):
        return BatchesInMemory(material.samples, order, device)
    return DataLoader(_Stored(material.samples), batch_sampler=order, **options)


def _leave_signals(worker: int) -> None:
    """Ignore signals in a worker process, because they may reach all processes of a job, and the first one ends the rest."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


class Order(Sampler[list[tuple[int, int]]]):
    """Sampler that yields the (epoch, sample) pairs of each batch from step ``start`` to ``stop``.

    Each epoch has a permutation of the samples that depends on (seed, epoch). Samples that do not fill a batch at the end of
    an epoch are omitted from that epoch.
    """

    def __init__(
        self, numbers: NDArray[np.int64], batch: int, seed: int, start: int, stop: int, share: tuple[int, int]
    ) -> None:
        self.numbers, self.batch, self.seed, self.start, self.stop, self.share = numbers, batch, seed, start, stop, share

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        rank, size = self.share
        current_epoch, order = -1, self.numbers
        for step in range(self.start, self.stop):
            epoch, position = divmod(step, len(self.numbers) // self.batch)
            if epoch != current_epoch:
                current_epoch, order = epoch, np.random.default_rng([self.seed, ORDER, epoch]).permutation(self.numbers)
            yield [(epoch, int(number)) for number in order[position * self.batch : (position + 1) * self.batch][rank::size]]


MEMORY_SHARE = 0.5
"""A data set is copied to a GPU if it fills at most this fraction of the memory that is free."""


def fits_on(device: torch.device, pairs: SonarPairs | ImpulsePairs) -> bool:
    """Return whether a data set can be kept in the memory of a GPU; frames with ground geometry cannot."""
    if device.type != "cuda" or not pairs.arrays or (isinstance(pairs, SonarPairs) and pairs.ground):
        return False
    shapes = [(pairs.store.array(name).shape, kind.itemsize) for name, kind in pairs.arrays.values()]
    return sum(math.prod(shape) * size for shape, size in shapes) <= MEMORY_SHARE * torch.cuda.mem_get_info(device)[0]


class BatchesInMemory:
    """Batches of raw samples from a data set in the memory of a device: the same samples that a loader reads from disk.

    Args:
        pairs: samples without ground geometry.
        order: yields the (epoch, sample) pairs of each batch.
        device: holds the frames or responses.
    """

    def __init__(self, pairs: SonarPairs | ImpulsePairs, order: Order, device: torch.device) -> None:
        self.pairs, self.order, self.device = pairs, order, device

    def __iter__(self) -> Iterator[Batch]:
        pairs, device = self.pairs, self.device
        tables = {
            key: torch.from_numpy(pairs.store.read(name).astype(kind, copy=False)).to(device)
            for key, (name, kind) in pairs.arrays.items()
        }
        labels = torch.from_numpy(pairs.labels.encode(np.stack([pairs.target(index) for index in range(len(pairs))])))
        first, offsets = torch.from_numpy(pairs.first), torch.arange(pairs.frames)
        for keys in self.order:
            numbers = torch.tensor([number for _, number in keys])
            frames = first[numbers, None] + offsets
            here = frames.to(device)
            raw = {"frames": frames, "label": labels[numbers], **{key: table[here] for key, table in tables.items()}}
            yield {"epoch": keys[0][0], "frames": frames[:, 0].clone(), "raw": raw}


@dataclass(frozen=True)
class _Stored(Dataset[RawSample]):
    """Raw samples with their epoch, for worker processes that only read."""

    pairs: Stored

    def __getitem__(self, key: tuple[int, int]) -> RawSample:
        epoch, number = key
        return {"epoch": epoch, **self.pairs.raw(number)}


@dataclass(frozen=True)
class _Collation:
    """Collation of raw samples to a batch: ``epoch``, ``frames``, and ``raw``, or finished ``inputs`` and ``label``."""

    samples: Kind
    finish: bool

    def __call__(self, rows: list[RawSample]) -> Batch:
        epoch = rows[0].get("epoch", 0)
        raw = default_collate([{name: values for name, values in row.items() if name != "epoch"} for row in rows])
        batch = {"epoch": epoch, "frames": raw["frames"][:, 0].clone()}
        if not self.finish:
            return {**batch, "raw": raw}
        self.samples.set_epoch(epoch)
        inputs, label = self.samples.finished(raw)
        return {**batch, "inputs": inputs, "label": label}


def finished(batch: Batch, samples: Kind, device: torch.device) -> tuple[NetworkInput, Tensor]:
    """Return the inputs and labels of a batch on a device."""
    if "inputs" in batch:
        return batch["inputs"], batch["label"]
    samples.set_epoch(batch["epoch"])
    return samples.finished(batch["raw"], device)
