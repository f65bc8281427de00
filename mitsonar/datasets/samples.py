"""How frames of a data set become samples for training: inputs, labels and, if requested, the geometry of the ground."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias, TypedDict, Unpack

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, get_worker_info

from mitsonar.acoustics.noise import NOISE_MODELS, NoiseModel, format_snr, load_noise, parse_snr
from mitsonar.config.data import Recipe, array_names
from mitsonar.datasets.arrangement import Arrangement, Labels, arrangement_of
from mitsonar.datasets.modality import Fields, Values
from mitsonar.datasets.responses import ImpulseSamples, Packing
from mitsonar.datasets.sample_index import AnySplit, Part
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError, check_argument_names
from mitsonar.geometry.ground import Attitude, GroundGeometry, attitude_of, lit_margin, nearest_known
from mitsonar.instruments.sonar import Bearing
from mitsonar.motion.composition import motions
from mitsonar.records.frames import SonarFrames

__all__ = [
    "NODES",
    "SEED_STEP",
    "ArrangementOptions",
    "Batch",
    "Batches",
    "Device",
    "ImpulsePairs",
    "Inputs",
    "JoinedPairs",
    "RawSample",
    "SampleOptions",
    "Samples",
    "SonarPairs",
    "StoredBatches",
    "ground_at",
    "ground_of",
    "light_of",
]


NODES = (17, 9)
"""Number of nodes along range and bearing. Linear interpolation of the smooth geometry errs by less than 1e-3 cells."""

RISE = 0.05
"""Fraction of the height by which the ground is raised and lowered to compute the derivative with respect to relief."""


def ground_at(
    range_m: ArrayLike, bearing_rad: ArrayLike, bearing: Bearing, height_m: float, pitch_rad: float, roll_rad: float = 0.0
) -> dict[str, NDArray[np.float32]]:
    """Compute where the nodes of an image lie on level ground, and how they move with the sonar.

    Args:
        range_m: of the bins ``(bins,)`` [m], ascending.
        bearing_rad: of the beams ``(beams,)`` [rad], ascending.
        bearing: definition of the bearing angle.
        height_m: of the sonar above the ground [m].
        pitch_rad: of the sonar [rad], positive down.
        roll_rad: of the sonar [rad], positive with starboard down.

    Returns:
        Arrays of float32, keyed by name. ``points (R, C, 2)`` [m], ``turn (3, 3)``, ``height ()`` [m]. ``place (2, R, C)``:
        range [m] and bearing [rad] of the nodes. ``cell (2, R, C)``: size of a bin [m] and of a beam [rad] at the nodes.
        ``derivative (2, 3, R, C)``: derivative in bins and beams with respect to motion [m, m, rad].
        ``by_relief (2, 3, R, C)``: its derivative with respect to relief above the ground, as a fraction of the height.
        ``cone ()``: 1 if the bearing is a cone angle.
    """
    # 1. Place the nodes evenly in index, and measure the local size of a bin and of a beam there.
    axes = [np.asarray(values, dtype=float) for values in (range_m, bearing_rad)]
    index = [np.linspace(0, len(axis) - 1, count) for axis, count in zip(axes, NODES, strict=True)]
    nodes = [np.interp(position, np.arange(len(axis)), axis) for position, axis in zip(index, axes, strict=True)]
    cell = [np.interp(position, np.arange(len(axis)), np.gradient(axis)) for position, axis in zip(index, axes, strict=True)]
    geometry = GroundGeometry(nodes[0], nodes[1], bearing, height_m, pitch_rad, roll_rad)
    # 2. Where a node does not meet the ground, take the nearest node that does.
    row, column = nearest_known(np.asarray(np.isfinite(geometry.points).all(axis=-1)))
    points = np.nan_to_num(geometry.points[row, column])
    cells = np.stack(np.meshgrid(*cell, indexing="ij"))

    def derivative(part: float) -> NDArray[np.float64]:
        """Compute the derivative with respect to motion, for a sonar at this fraction of the height."""
        shifted = GroundGeometry(nodes[0], nodes[1], bearing, part * height_m, pitch_rad, roll_rad)
        values = np.nan_to_num(shifted.derivative[row, column]) / np.moveaxis(cells, 0, -1)[..., None]
        return np.moveaxis(values, (2, 3), (0, 1))

    # 3. Differentiate with respect to relief by central differences: higher ground is the same as a lower sonar.
    higher, lower = (derivative(1 - sign * RISE) for sign in (1, -1))
    table = {
        "points": points,
        "turn": geometry.turn,
        "height": np.array(height_m),
        "place": np.stack(np.broadcast_arrays(nodes[0][row], nodes[1][column])),
        "cell": cells,
        "derivative": derivative(1.0),
        "by_relief": (higher - lower) / (2 * RISE),
        "cone": np.array(float(bearing == "cone")),
    }
    return {name: np.array(values, dtype=np.float32) for name, values in table.items()}


def ground_of(frames: SonarFrames, attitude: Attitude) -> dict[str, NDArray[np.float32]]:
    """Compute the ground geometry of frames from their attitude; see :func:`ground_at` for the arrays.

    If the attitudes of two frames are known, ``points`` and ``place`` are those of the first frame, ``turn`` and ``height``
    those of the second.
    """
    axes = frames.range_m, frames.bearing_rad, frames.sonar.bearing
    table = ground_at(*axes, attitude.height_m, attitude.pitch_rad, attitude.roll_rad)
    if len(attitude.apart) == 2:
        first, second = (ground_at(*axes, *attitude.of_frame(number)) for number in range(2))
        table |= {"points": first["points"], "place": first["place"], "turn": second["turn"], "height": second["height"]}
    return table


def light_of(frames: SonarFrames, attitude: Attitude) -> dict[str, NDArray[np.float32]]:
    """Compute how far inside the insonified area the ground at each node lies, as ``lit (R, C)``.

    See :func:`mitsonar.geometry.ground.lit_margin`. The result is empty if the outline of the area is not to be masked,
    which is the case if little of the window is insonified. Training does not use this array.
    """
    range_m, bearing_rad = (
        np.interp(np.linspace(0, len(axis) - 1, count), np.arange(len(axis)), axis)
        for axis, count in zip((frames.range_m, frames.bearing_rad), NODES, strict=True)
    )
    sonar, pitch_rad, roll_rad = frames.sonar, attitude.pitch_rad, attitude.roll_rad
    ground = GroundGeometry(range_m, bearing_rad, sonar.bearing, attitude.height_m, pitch_rad, roll_rad)
    margin = lit_margin(ground, attitude, sonar.elevation_fov_deg, mostly=0.0)
    return {} if margin is None else {"lit": margin.astype(np.float32)}


# ---------------- Batches for torch


Inputs: TypeAlias = Any
"""Input of a network: a tensor, a tuple of tensors, or a tensor and a dictionary of ground geometry tensors."""

Batch: TypeAlias = tuple[Inputs, Tensor]
"""Inputs and labels of a batch, or of one sample."""

RawSample: TypeAlias = dict[str, NDArray[Any]]
"""A sample as stored: the frames keyed by view, their numbers, and the label."""

Device: TypeAlias = torch.device | str | None
"""A torch device; None keeps tensors where they are."""

SEED_STEP = 1_000_003
"""Difference between the noise seeds of two epochs; it exceeds any number of views."""


class Batches:
    """Base class of all samples; a subclass implements :meth:`finished`, which turns raw samples into a batch.

    Attributes:
        recipe: of the data set.
        labels: encoder and decoder of targets.
        seed: of noise and order.
        epoch: current epoch, which changes noise and order; see :meth:`set_epoch`.
    """

    recipe: Recipe
    labels: Labels
    seed: int
    epoch: int

    def finished(self, batch: dict[str, Tensor], device: Device = None) -> Batch:
        """Compute the inputs and labels of a batch of raw samples on a device."""
        raise NotImplementedError

    def described(self) -> Fields:
        """Return the description of the samples that is saved in the checkpoint of a network trained on them.

        The keys are ``arrangement``, ``sonar``, ``trained_at``, ``model`` and ``noise``.
        """
        raise NotImplementedError

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, which changes the noise and the order in :meth:`StoredBatches.loader`."""
        self.epoch = epoch

    @property
    def epoch_seed(self) -> int:
        """Return the noise seed of the current epoch."""
        return self.seed + SEED_STEP * self.epoch

    def one(self, sample: RawSample) -> Batch:
        """Compute the input and the label of one raw sample."""
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
        """Yield batches of inputs and labels on a device, from raw samples that workers read or render.

        Args:
            raw: the raw samples.
            batch_size: number of samples per batch.
            device: of inputs and labels.
            workers: number of processes that read or render; with 0 this process does.
            shuffle: whether to draw the order at random.
            generator: random generator for the order.
            drop_last: whether to omit a last, smaller batch.
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
    """Base class of the samples of a store, which are numbered."""

    def __len__(self) -> int:
        raise NotImplementedError

    def raw(self, index: int) -> RawSample:
        """Read a sample as stored."""
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
        """Yield the batches of one epoch on a device; their order depends on seed and epoch only."""
        order = torch.Generator().manual_seed(self.epoch_seed)
        yield from self.batches(
            _RawSamples(self), batch_size, device, workers, shuffle=shuffle, generator=order, drop_last=drop_last
        )


def _first(inputs: Inputs) -> Inputs:
    """Return the first sample of a batch."""
    if isinstance(inputs, tuple):
        return tuple(map(_first, inputs))
    return {name: values[0] for name, values in inputs.items()} if isinstance(inputs, dict) else inputs[0]


@dataclass(frozen=True)
class _RawSamples(Dataset[RawSample]):
    """Raw samples for worker processes, which only read."""

    samples: StoredBatches

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> RawSample:
        return self.samples.raw(index)


# ---------------- Samples of images and vectors


GROUND = "ground/"
"""Prefix of the names of ground geometry arrays in a raw sample."""

CACHED_BYTES = 2**31
"""Size of the arrays of a data set that are cached in memory [bytes]; processes that read for one training share it."""

CACHED_FROM = 16
"""An array is cached once one in so many of its frames has been read."""


class ArrangementOptions(TypedDict, total=False):
    """Options of samples of images and vectors; see :class:`SonarPairs`."""

    frames: int | None
    views: str | list[str] | None
    kind: str | None
    layout: str
    coordinates: str
    cartesian_rows: int
    noise: str | NoiseModel | Sequence[str | NoiseModel]
    labels: str
    ground: bool
    range_levels: int | None
    halves: bool


class SampleOptions(ArrangementOptions, total=False):
    """Options of :class:`ArrangementOptions`, and the seed."""

    seed: int


class Samples(Batches):
    """Base class of stored and rendered samples of images and vectors: turns raw frames into inputs and labels.

    Attributes:
        recipe: of the data set.
        frames: number of frames per sample.
        arrange: conversion of frames to inputs.
        labels: encoder and decoder of targets.
        seed: of noise and order.
        epoch: current epoch, which changes noise and order; see :meth:`set_epoch`.
        ground: whether inputs include the geometry of the ground.
    """

    def __init__(
        self,
        recipe: Recipe,
        *,
        frames: int | None = None,
        views: str | list[str] | None = None,
        kind: str | None = None,
        layout: str = "side",
        coordinates: str = "polar",
        cartesian_rows: int = 512,
        noise: str | NoiseModel | Sequence[str | NoiseModel] = "none",
        labels: str = "raw",
        seed: int = 0,
        ground: bool = False,
        range_levels: int | None = None,
        halves: bool = False,
    ) -> None:
        self.recipe = recipe
        self.frames = recipe.frames if frames is None else frames
        if self.frames < 1:
            raise MitsonarError(f"frames must be at least 1: got {frames}")
        self.arrange = arrangement_of(
            recipe,
            views=views,
            kind=kind,
            layout=layout,
            coordinates=coordinates,
            noise=noise,
            cartesian_rows=cartesian_rows,
            range_levels=range_levels,
            halves=halves,
        )
        self.labels = Labels.of(labels, recipe, self.frames)
        self.seed, self.epoch, self.ground = seed, 0, ground
        if ground and (self.frames != 2 or len(self.arrange.views) != 1 or self.arrange.kind != "image"):
            raise MitsonarError(
                "ground=True needs pairs of images of one view: give frames=2, views='NAME' of "
                f"{', '.join(self.arrange.views)}, kind='image'"
            )

    def finished(self, batch: dict[str, Tensor], device: Device = None) -> Batch:
        """Compute the inputs and labels of a batch of raw samples; noise and layout are computed on ``device``."""
        moved = {name: values.to(device, non_blocking=True) for name, values in batch.items()}
        ground = {name.removeprefix(GROUND): moved.pop(name) for name in list(moved) if name.startswith(GROUND)}
        inputs = self.arrange(moved, moved["frames"], self.epoch_seed)
        return (inputs, ground) if self.ground else inputs, moved["label"]

    def ground_below(self, image: Values, poses: NDArray[np.float64], height_m: NDArray[np.float64]) -> RawSample:
        """Compute the ground geometry of a raw sample's frames, keyed by the names that it has in the sample.

        Args:
            image: frames of the only view ``(frames, bins, beams)``, without noise.
            poses: of the sonar ``(frames, 6)`` [m, rad].
            height_m: of the sonar above the ground ``(frames,)`` [m].
        """
        frames = self.frames_of(image, poses, height_m, time_s=np.arange(len(image), dtype=float))
        attitude = attitude_of(frames, "the ground", None, None)
        return {f"{GROUND}{name}": values for name, values in ground_of(frames, attitude).items()}

    def frames_of(
        self,
        image: Values,
        poses: NDArray[np.float64],
        height_m: NDArray[np.float64],
        *,
        time_s: NDArray[np.float64],
        level_scale: float = 1.0,
    ) -> SonarFrames:
        """Build the :class:`SonarFrames` of the first view.

        Args:
            image: pixels ``(frames, bins, beams)``.
            poses: of the sonar ``(frames, 6)`` [m, rad].
            height_m: of the sonar above the ground ``(frames,)`` [m].
            time_s: time of each frame ``(frames,)`` [s].
            level_scale: level of a pixel of value 1.
        """
        view = next(view for view in self.recipe.views if view.name == self.arrange.views[0])
        return SonarFrames(
            image=image,
            range_m=view.sonar.range_m,
            bearing_rad=view.bearing_rad,
            sonar=view.sonar,
            poses=poses,
            height_m=height_m,
            time_s=time_s,
            level=self.recipe.level_of(view),
            level_scale=level_scale,
        )

    @property
    def stored_kind(self) -> str:
        """Return the kind of array to read; vectors come from images if only images are stored, and for halves."""
        return self.arrange.kind if self.arrange.kind in self.recipe.kinds and not self.arrange.halves else "image"

    def at_noise(self, level: str) -> Arrangement:
        """Return the arrangement with a single noise level.

        Raises:
            MitsonarError: unknown level.
        """
        return replace(self.arrange, noise=load_noise(level), levels=())

    def described(self) -> Fields:
        """Return the description of the samples for a checkpoint; see :meth:`Batches.described`."""
        recipe, mount, arrange = self.recipe, self.recipe.mount, self.arrange
        rows = {conversion.index.shape[1] for conversion in arrange.maps.values()}
        return {
            "arrangement": {
                "frames": self.frames,
                "views": list(arrange.views),
                "kind": arrange.kind,
                "layout": arrange.layout,
                "coordinates": arrange.coordinates,
                "cartesian_rows": rows.pop() if rows else 512,
                "ground": self.ground,
                "range_levels": arrange.range_levels,
                "halves": arrange.halves,
            },
            "sonar": {view.name: view.sonar.model_dump(mode="json") for view in recipe.views if view.name in arrange.views},
            "trained_at": {
                "height_m": [height + mount.up_m for height in recipe.flight.heights],
                "pitch_deg": mount.pitch_deg,
                "roll_deg": mount.roll_deg,
            },
            "model": recipe.instrument.model,
            "noise": "; ".join(map(_noise_name, arrange.levels or [arrange.noise])),
        }


class SonarPairs(StoredBatches, Samples, Dataset[Any]):
    """Samples of a stored data set: ``frames`` consecutive frames each, and the motion between them.

    ``pairs[i]`` is ``(input, label)``, float32 tensors, ready for ``torch.utils.data.DataLoader``. :meth:`loader` yields
    batches, with noise and layout computed on their device.

    Args:
        url: path or URL of the store.
        part: ``train``, ``validation``, ``test``, or ``all``.
        split: one of the following; default: the recipe's split.

            - ``scene``: 80, 10 and 10 % of the scenes. Validation and test use other worlds than training; scenes of one
              world stay together.
            - ``sequence``: 95 and 5 % of the sequences.
            - ``sample``: the split of Almanza-Medina. Single samples are assigned, 90 and 5 %, so samples for validation
              have a frame in common with samples for training; 5 % of the sequences are for test.
            - the keys by, train, validation, test and seed, as a dictionary or :class:`~mitsonar.config.data.Split`.
        frames: number of frames per sample; with 1 the labels are heights; default: that of the recipe.
        views: names of the views; default: all.
        kind: ``image`` or ``vector``; default: the stored kind.
        layout: ``side``, ``stack`` or ``channels``; see :class:`~mitsonar.datasets.arrangement.Arrangement`.
        coordinates: ``polar``, ``cartesian`` or ``both`` (then the input is a pair).
        cartesian_rows: number of pixels of a fan in the forward direction.
        range_levels: number of levels in a vector, whose bins are summed in groups, with their noise; default: one per bin.
        halves: whether images become vectors of their halves in azimuth (Almanza-Medina, fig. 4.18), port first.
        noise: ``none``, ``low``, ``high``, ``chapter2``, three numbers, or a model; from a list each sample draws one.
        labels: ``raw`` (m, m, rad), ``quantised`` (0..31) or ``normx10`` (+-10); ``pairs.labels.decode`` inverts them.
        seed: of noise and order. The split has a separate seed (``Split.seed``), so another seed never mixes its parts.
        ground: whether the input is images and the geometry of the ground below them, as ``corrnet`` requires. The labels
            are then motions of the sonar, not of the vehicle that carries it.
        one_per_sequence: whether to take only one sample from each sequence, for independent tests.

    Raises:
        MitsonarError: there is no finished data set, an option is unknown, or the part has no frames.
    """

    def __init__(
        self,
        url: str | Path,
        *,
        part: str = "train",
        split: AnySplit = None,
        one_per_sequence: bool = False,
        **arrangement: Unpack[SampleOptions],
    ) -> None:
        names = ("part", "split", "one_per_sequence")
        check_argument_names(arrangement, (*names, *SampleOptions.__annotations__), type(self).__name__)
        self.store, self._part = DataStore.open(url), part
        Samples.__init__(self, self.store.recipe, **arrangement)
        self.chosen = Part.of(self.store, part, split, self.frames, seed=self.seed, one_per_sequence=one_per_sequence)
        self.split, self.first = self.chosen.split, self.chosen.first
        self.scene, self.sequence = self.chosen.scene, self.chosen.sequence
        self.pose, self.motion = self.chosen.pose, self.chosen.motion
        self._grounds: dict[int, RawSample] = {}
        self._cached: dict[str, Values] = {}
        self._read_frames: dict[str, int] = {}

    def __repr__(self) -> str:
        return (
            f"SonarPairs({len(self):,} samples of {self.frames} frames, part {self._part}, {self.arrange.kind} of "
            f"{', '.join(list(self.arrange.views)[:4])}, {self.recipe.name}: {self.store.place.url})"
        )

    def __len__(self) -> int:
        return len(self.first)

    def frame_slice(self, index: int) -> slice:
        """Return the slice of the store's frames that a sample holds."""
        return self.chosen.frame_slice(index)

    def target(self, index: int) -> NDArray[np.float64]:
        """Return the mean motion from frame to frame (sideways [m], forward [m], yaw [rad]).

        The target of a sample with one frame is its height above z = 0 [m].
        """
        here = self.frame_slice(index)
        if self.frames == 1:
            return self.pose[here, 2]
        if self.ground:  # in the frame of the sonar, as the ground geometry
            return np.asarray(motions(self.pose[here]).mean(axis=0))
        return np.asarray(self.motion[here.start : here.stop - 1].mean(axis=0))

    @cached_property
    def arrays(self) -> dict[str, tuple[str, np.dtype[Any]]]:
        """Return the arrays of the store of which samples consist, keyed by their name in a sample: name and type there."""
        result = {}
        for name, (kind, view) in array_names(self.recipe).items():
            if view in self.arrange.views and kind == self.stored_kind:
                result[view] = name, self.store.array(name).dtype
            elif view in self.arrange.views and kind == "nonzero" and self.stored_kind == "vector":
                result[f"nonzero_{view}"] = name, np.dtype(np.int32)
        return result

    def raw(self, index: int) -> RawSample:
        """Read a sample as stored: the frames keyed by view, their numbers, and the label; see :meth:`finished`."""
        here = self.frame_slice(index)
        sample: RawSample = {
            "frames": np.arange(here.start, here.stop),
            "label": self.labels.encode(self.target(index)),
        }
        sample |= {key: self._read(name, here).astype(kind, copy=False) for key, (name, kind) in self.arrays.items()}
        if self.ground:
            if index not in self._grounds:  # cached: it is the same in every epoch
                image = sample[self.arrange.views[0]]
                self._grounds[index] = self.ground_below(image, self.pose[here], self.store.read("height_m", here))
            sample |= self._grounds[index]
        return sample

    def _read(self, name: str, here: slice) -> Values:
        """Read frames of an array, from memory once enough of them have been read: a read from disk takes 0.8 ms."""
        if name not in self._cached:
            length = int(np.prod(self.store.modality.stored[name].shape)) * self.store.array(name).dtype.itemsize
            worker = get_worker_info()
            room = CACHED_BYTES // (worker.num_workers if worker else 1) - sum(one.nbytes for one in self._cached.values())
            if length * len(self.sequence) > room:
                return self.store.read(name, here)
            self._read_frames[name] = self._read_frames.get(name, 0) + here.stop - here.start
            if CACHED_FROM * self._read_frames[name] < len(self.sequence):
                return self.store.read(name, here)
            self._cached[name] = self.store.read(name)
        return self._cached[name][here]

    def __getstate__(self) -> Fields:
        """Return the state without cached arrays, because other processes read them themselves."""
        return {**vars(self), "_cached": {}}

    def sonar_frames(self, index: int, image: Values | None = None) -> SonarFrames:
        """Read a sample of one view as :class:`SonarFrames` with noise, poses and heights, the input of estimators.

        Args:
            index: of the sample.
            image: pixels ``(frames, bins, beams)`` that replace the stored frames; they get the same noise.

        Raises:
            MitsonarError: the samples are vectors, or have several views.
        """
        if len(self.arrange.views) > 1 or self.arrange.kind != "image":
            raise MitsonarError(f"frames hold images of one view: choose one of {', '.join(self.arrange.views)}")
        here, (name,) = self.frame_slice(index), self.arrange.views
        sample = {key: np.asarray(values)[None] for key, values in self.raw(index).items()}
        if image is not None:
            sample[name] = image[None]
        arrange = self.arrange.for_sample(sample["frames"][0], self.epoch_seed)
        image = arrange.noisy(sample, name, sample["frames"], self.epoch_seed)[0]
        return self.frames_of(
            np.asarray(image),
            self.pose[here],
            self.store.read("height_m", here),
            time_s=self.store.read("time_s", here),
            level_scale=self.store.level_scale_of(int(self.scene[here.start])),
        )


def _noise_name(noise: NoiseModel) -> str:
    """Return the name of a noise model, or its three numbers."""
    names = [name for name, model in NOISE_MODELS.items() if model == noise]
    return names[0] if names else f"{noise.mean:g},{noise.std:g},{noise.scale:g}"


# ---------------- Samples of several data sets


class JoinedPairs(StoredBatches, Dataset[Any]):
    """Concatenated samples of several data sets of one sonar, such as one data set per sonar model.

    Samples, frames and sequences are numbered consecutively over all sets. The first set arranges all samples and encodes
    all labels.

    Args:
        parts: samples of each data set, with the same arrangement.

    Attributes:
        parts: as given.
        frames: number of frames per sample.
        first: first frame of each sample ``(samples,)``.
        sequence: sequence number of each frame ``(frames,)``.

    Raises:
        MitsonarError: views, window, beams, pixels, mount, heights or largest motions differ from those of the first set.
    """

    def __init__(self, parts: Sequence[SonarPairs]) -> None:
        self.parts = tuple(parts)
        leader = self.parts[0]
        for part in self.parts[1:]:
            _check_agreement(leader, part)
        self.recipe, self.labels, self.frames = leader.recipe, leader.labels, leader.frames
        self.seed, self.epoch = leader.seed, leader.epoch
        self._samples = np.cumsum([0, *map(len, self.parts)])
        self._frames = np.cumsum([0, *(len(part.sequence) for part in self.parts)])
        sequence_offsets = np.cumsum([0, *(int(part.sequence.max()) + 1 for part in self.parts)])
        self.first = np.concatenate([part.first + n for part, n in zip(self.parts, self._frames, strict=False)])
        self.sequence = np.concatenate([part.sequence + n for part, n in zip(self.parts, sequence_offsets, strict=False)])

    def __len__(self) -> int:
        return int(self._samples[-1])

    @property
    def arrange(self) -> Arrangement:
        """Return the conversion of frames to inputs."""
        return self.parts[0].arrange

    @arrange.setter
    def arrange(self, arrange: Arrangement) -> None:
        self.parts[0].arrange = arrange

    def at_noise(self, level: str) -> Arrangement:
        """Return the arrangement with a single noise level.

        Raises:
            MitsonarError: unknown level.
        """
        return self.parts[0].at_noise(level)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, which changes noise and order."""
        self.epoch = epoch
        self.parts[0].set_epoch(epoch)

    def raw(self, index: int) -> RawSample:
        """Read a sample as stored."""
        part = int(np.searchsorted(self._samples, index, side="right")) - 1
        sample = self.parts[part].raw(index - int(self._samples[part]))
        return {**sample, "frames": sample["frames"] + self._frames[part]}  # so that no two sets share noise

    def finished(self, batch: dict[str, Tensor], device: Device = None) -> Batch:
        """Compute the inputs and labels of a batch of raw samples from any of the sets on a device."""
        return self.parts[0].finished(batch, device)

    def described(self) -> Fields:
        """Return the description for a checkpoint: that of the first set, with the models and names of all sets."""
        descriptions = [part.described() for part in self.parts]
        names = [part.recipe.name for part in self.parts]
        return {**descriptions[0], "model": _join_names([one["model"] for one in descriptions]), "data": _join_names(names)}


def _join_names(names: list[str]) -> str:
    return " and ".join(dict.fromkeys(names))


def _check_agreement(leader: SonarPairs, part: SonarPairs) -> None:
    """Refuse a data set whose inputs or labels have another form than those of the first.

    Raises:
        MitsonarError: its inputs or labels differ.
    """
    expected, actual = (_common_properties(pairs) for pairs in (leader, part))
    differing = [name for name in expected if expected[name] != actual[name]]
    if differing:
        name = differing[0]
        raise MitsonarError(
            f"data sets of one training must agree in {', '.join(expected)}: {leader.store.place.url} has {name} "
            f"{expected[name]}, {part.store.place.url} has {actual[name]}; train on one of them, or make the other again"
        )


def _common_properties(pairs: SonarPairs) -> Fields:
    """Return the properties that determine the form of inputs and labels, keyed by name."""
    views = [view for view in pairs.recipe.views if view.name in pairs.arrange.views]
    description = pairs.described()
    return {
        "views": pairs.arrange.views,
        "window": [(one.sonar.range_min, one.sonar.range_max, one.sonar.range_bins) for one in views],
        "beams": [(len(one.bearing_rad), *np.degrees(one.bearing_rad[[0, -1]]).round(6).tolist()) for one in views],
        "pixels": (pairs.stored_kind, pairs.recipe.pixel),
        "heights and mount": description["trained_at"],
        "largest motions": (pairs.labels.names, pairs.labels.high.tolist()),
    }


# ---------------- Samples of impulse responses


class ImpulsePairs(ImpulseSamples, StoredBatches, Dataset[Batch]):
    """Samples of impulse responses for torch; ``pairs[i]`` is ``(input, label)``, float32 tensors.

    The input is ``(1, taps, 2 M Q)``: for each of M receivers the real parts of its Q responses, then their imaginary parts,
    one column each, divided by the largest magnitude of the sample (Almanza-Medina, 5.2.5). The label is the displacement
    from the first ping to the last: sideways, forward, and yaw if the recipe has yaw. Arguments and
    errors are those of :class:`~mitsonar.datasets.responses.ImpulseSamples`.
    """

    @property
    def noise_seed(self) -> int:
        """Return the seed of the noise, which changes with the epoch."""
        return self.epoch_seed

    @property
    def arrays(self) -> dict[str, tuple[str, np.dtype[Any]]]:
        """Return the arrays of the store of which samples consist, as in `SonarPairs`; none if ``leak`` replaces pings."""
        return {"response": ("response", np.dtype(np.complex64))} if self.leak == "none" else {}

    def raw(self, index: int) -> RawSample:
        """Read a sample as stored: the responses ``(Q, M, taps)``, the numbers of the pings, and the label."""
        here = self.frame_slice(index)
        label = self.labels.encode(self.target(index))
        return {"frames": np.arange(here.start, here.stop), "response": self.response(index), "label": label}

    def finished(self, batch: dict[str, Tensor], device: Device = None) -> Batch:
        """Compute the matrices and labels of a batch of raw samples on a device."""
        response, numbers = (torch.as_tensor(batch[name]).cpu().numpy() for name in ("response", "frames"))
        inputs = torch.from_numpy(self.arrange(response, numbers, self.noise_seed))
        return inputs.to(device, non_blocking=True), torch.as_tensor(batch["label"]).to(device, non_blocking=True)

    def at_noise(self, level: str) -> Packing:
        """Return the packing with a single noise level.

        Raises:
            MitsonarError: unknown level.
        """
        return replace(self.arrange, levels=(parse_snr(level),))

    def described(self) -> Fields:
        """Return the description for a checkpoint; see :meth:`~mitsonar.datasets.samples.Batches.described`."""
        low, high = self.recipe.flight.heights
        return {
            "arrangement": {
                "frames": self.frames,
                "views": list(self.arrange.receivers),
                "kind": "response",
                "layout": "columns",
                "coordinates": "delay",
                "cartesian_rows": self.sonar.taps,
                "ground": False,
            },
            "sonar": {"channel": self.sonar.model_dump(mode="json")},
            "trained_at": {"height_m": [low, high], "pitch_deg": 0.0, "roll_deg": 0.0},
            "model": self.sonar.model,
            "noise": "; ".join(map(format_snr, self.arrange.levels)),
        }
