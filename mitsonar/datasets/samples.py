"""The geometry of level ground as networks read it: at a few nodes of an image, in bins and beams."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias, TypedDict, Unpack

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from mitsonar.acoustics.noise import NOISE_MODELS, NoiseModel, load_noise
from mitsonar.config.data import SPLITS, Recipe, Split, array_names, split_from
from mitsonar.datasets.arrangement import Arrangement, Labels, arrangement_of
from mitsonar.datasets.modality import Fields, Values
from mitsonar.datasets.store import DataStore, deal, deal_samples, world_of
from mitsonar.errors import MitsonarError, refuse_unknown
from mitsonar.geometry.ground import Attitude, GroundGeometry, attitude_of, margin_of_light, nearest_known
from mitsonar.instruments.sonar import Bearing
from mitsonar.motion.composition import motions
from mitsonar.records.frames import SonarFrames

__all__ = [
    "NODES",
    "SEED_STEP",
    "AnySplit",
    "ArrangementOptions",
    "Batch",
    "Batches",
    "Device",
    "Inputs",
    "JoinedPairs",
    "Part",
    "RawSample",
    "SampleOptions",
    "Samples",
    "SonarPairs",
    "StoredBatches",
    "ground_at",
    "ground_of",
    "light_of",
    "split_for",
]


NODES = (17, 9)
"""Nodes along range and bearing. The geometry is smooth: linear interpolation between them errs by less than 1e-3 cells."""

RISE = 0.05
"""Part of the height by which the ground is raised and lowered to compute the derivative by relief."""


def ground_at(
    range_m: ArrayLike, bearing_rad: ArrayLike, bearing: Bearing, height_m: float, pitch_rad: float, roll_rad: float = 0.0
) -> dict[str, NDArray[np.float32]]:
    """Compute where the nodes of an image lie on the ground, and how they move with the sonar.

    Args:
        range_m: of the bins ``(bins,)`` [m], rising.
        bearing_rad: of the beams ``(beams,)`` [rad], rising.
        bearing: the kind of that angle.
        height_m: of the sonar over the ground [m].
        pitch_rad: > 0 tilts the sonar down.
        roll_rad: > 0 puts starboard down.

    Returns:
        By name, float32: ``points (R, C, 2)`` [m], ``turn (3, 3)``, ``height ()`` [m], ``place (2, R, C)`` range [m] and
        bearing [rad] of the nodes, ``cell (2, R, C)`` bin [m] and beam [rad] there, ``derivative (2, 3, R, C)`` in bins and
        beams by motion [m, m, rad], ``by_relief (2, 3, R, C)`` its change with relief above the ground, by parts of the
        height, ``cone ()``: 1 where the bearing is the angle of a cone.
    """
    axes = [np.asarray(values, dtype=float) for values in (range_m, bearing_rad)]
    index = [np.linspace(0, len(axis) - 1, count) for axis, count in zip(axes, NODES, strict=True)]
    nodes = [np.interp(at, np.arange(len(axis)), axis) for at, axis in zip(index, axes, strict=True)]
    cell = [np.interp(at, np.arange(len(axis)), np.gradient(axis)) for at, axis in zip(index, axes, strict=True)]
    geometry = GroundGeometry(nodes[0], nodes[1], bearing, height_m, pitch_rad, roll_rad)
    row, column = nearest_known(np.asarray(np.isfinite(geometry.points).all(axis=-1)))
    points = np.nan_to_num(geometry.points[row, column])
    cells = np.stack(np.meshgrid(*cell, indexing="ij"))

    def derivative(part: float) -> NDArray[np.float64]:
        """Compute the derivative by motion, over ground at this part of the height."""
        own = GroundGeometry(nodes[0], nodes[1], bearing, part * height_m, pitch_rad, roll_rad)
        values = np.nan_to_num(own.derivative[row, column]) / np.moveaxis(cells, 0, -1)[..., None]
        return np.moveaxis(values, (2, 3), (0, 1))

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
    """Compute the geometry of frames at their attitude over the ground; see :func:`ground_at`.

    Of two frames at known attitudes, ``points`` are those of the first frame, ``turn`` and ``height`` those of the second.
    """
    axes = frames.range_m, frames.bearing_rad, frames.sonar.bearing
    table = ground_at(*axes, attitude.height_m, attitude.pitch_rad, attitude.roll_rad)
    if len(attitude.apart) == 2:
        first, second = (ground_at(*axes, *attitude.of_frame(number)) for number in range(2))
        table |= {"points": first["points"], "place": first["place"], "turn": second["turn"], "height": second["height"]}
    return table


def light_of(frames: SonarFrames, attitude: Attitude) -> dict[str, NDArray[np.float32]]:
    """Compute how far inside the light the ground of each node lies, as ``lit (R, C)``; empty where its outline is left in.

    See :func:`mitsonar.geometry.ground.margin_of_light`. It stays in where
    little of the window is lit, as in training, which does without this table.
    """
    range_m, bearing_rad = (
        np.interp(np.linspace(0, len(axis) - 1, count), np.arange(len(axis)), axis)
        for axis, count in zip((frames.range_m, frames.bearing_rad), NODES, strict=True)
    )
    sonar, pitch_rad, roll_rad = frames.sonar, attitude.pitch_rad, attitude.roll_rad
    ground = GroundGeometry(range_m, bearing_rad, sonar.bearing, attitude.height_m, pitch_rad, roll_rad)
    margin = margin_of_light(ground, attitude, sonar.elevation_fov_deg, mostly=0.0)
    return {} if margin is None else {"lit": margin.astype(np.float32)}


# ---------------- How torch reads samples: raw ones by number, a batch of them finished on a device


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


# ---------------- Samples of a data set for torch: two or more consecutive frames with their labels


GROUND = "ground/"
"""Prefix of the names of the ground's geometry in a raw sample."""

KEPT_BYTES = 2**28
"""Largest array of vectors that is kept in memory once it has been read."""


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
    """The same, and the seed."""

    seed: int


class Samples(Batches):
    """What stored and rendered samples share: how raw frames become inputs and labels.

    Attributes:
        recipe: of the data set.
        frames: number of frames of a sample.
        arrange: turns frames into inputs.
        labels: encodes and decodes targets.
        seed: of noise and order.
        epoch: changes both; see :meth:`set_epoch`.
        ground: whether inputs come with the geometry of the ground.
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
                "the ground is that of pairs of images of one view: give frames=2, views='NAME' of "
                f"{', '.join(self.arrange.views)}, kind='image'"
            )

    def finished(self, batch: dict[str, Tensor], device: Device = None) -> Batch:
        """Make inputs and labels of a batch of raw samples. Noise and layout are computed on ``device``."""
        moved = {name: values.to(device, non_blocking=True) for name, values in batch.items()}
        ground = {name.removeprefix(GROUND): moved.pop(name) for name in list(moved) if name.startswith(GROUND)}
        inputs = self.arrange(moved, moved["frames"], self.epoch_seed)
        return (inputs, ground) if self.ground else inputs, moved["label"]

    def ground_below(self, image: Values, poses: NDArray[np.float64], height_m: NDArray[np.float64]) -> RawSample:
        """Compute the ground's geometry for a raw sample's frames, by name, to be added to the sample.

        Args:
            image: of the one view ``(frames, bins, beams)``, without noise.
            poses: of the sonar ``(frames, 6)`` [m, rad].
            height_m: over the ground ``(frames,)`` [m].
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
        """Build the frames of the one view.

        Args:
            image: ``(frames, bins, beams)``.
            poses: of the sonar ``(frames, 6)`` [m, rad].
            height_m: over the ground ``(frames,)`` [m].
            time_s: of each frame ``(frames,)`` [s].
            level_scale: level of a pixel of 1.
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
        """Return the stored kind that is read. Vectors are made of images if only images are stored, and for halves."""
        return self.arrange.kind if self.arrange.kind in self.recipe.kinds and not self.arrange.halves else "image"

    def at_noise(self, level: str) -> Arrangement:
        """Return the arrangement with one level of noise.

        Raises:
            MitsonarError: an unknown level.
        """
        return replace(self.arrange, noise=load_noise(level), levels=())

    def described(self) -> Fields:
        """Describe the samples, as a checkpoint keeps it; see :meth:`~mitsonar.datasets.samples.Batches.described`."""
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
    """Samples of a data set's store. Each has ``frames`` consecutive frames and the motion between them.

    ``pairs[i]`` is ``(input, label)``, float32 tensors, ready for ``torch.utils.data.DataLoader``. :meth:`loader` yields
    batches, with noise and layout computed on their device.

    Args:
        url: path or URL of the store.
        part: ``train``, ``validation``, ``test``, or ``all``.
        split: ``scene`` (80, 10 and 10 % of the scenes: other worlds than those of training; scenes of one world stay
            together), ``sequence`` (95 and 5 % of the sequences), ``sample`` (Almanza-Medina's: samples are dealt out one by
            one, 90 and 5 %, so that those for validation have a frame in common with those of training; 5 % of the
            sequences are for test), or by, train, validation, test and seed as a dictionary or
            :class:`~mitsonar.config.data.Split`; default: the recipe's own.
        frames: number of frames of a sample; with 1 the labels are heights; default: the recipe's.
        views: which views; default: all.
        kind: ``image`` or ``vector``; default: what is stored.
        layout: ``side``, ``stack`` or ``channels``; see :class:`~mitsonar.datasets.arrangement.Arrangement`.
        coordinates: ``polar``, ``cartesian`` or ``both`` (then the input is a pair).
        cartesian_rows: pixels of a fan in the forward direction.
        range_levels: number of levels of a vector, whose bins are added up in groups, with their noise; default: one a bin.
        halves: whether images become vectors of their halves in azimuth (Almanza-Medina, fig. 4.18), port first.
        noise: ``none``, ``low``, ``high``, ``chapter2``, three numbers, or a model; of a list each sample draws one.
        labels: ``raw`` (m, m, rad), ``quantised`` (0..31) or ``normx10`` (+-10); ``pairs.labels.decode`` inverts them.
        seed: of noise and order. The split has its own (``Split.seed``), so that another seed never mixes its parts.
        ground: whether the input is images and the geometry of the ground below them, as ``corrnet`` takes it. The labels
            are then motions of the sonar, not those of the vehicle that carries it.
        one_a_sequence: whether only one sample of each sequence is taken, for independent tests.

    Raises:
        MitsonarError: no finished data set there, an unknown option, a part without frames.
    """

    def __init__(
        self,
        url: str | Path,
        *,
        part: str = "train",
        split: AnySplit = None,
        one_a_sequence: bool = False,
        **arrangement: Unpack[SampleOptions],
    ) -> None:
        own = ("part", "split", "one_a_sequence")
        refuse_unknown(arrangement, (*own, *SampleOptions.__annotations__), type(self).__name__)
        self.store, self._part = DataStore.open(url), part
        Samples.__init__(self, self.store.recipe, **arrangement)
        self.chosen = Part.of(self.store, part, split, self.frames, seed=self.seed, one_a_sequence=one_a_sequence)
        self.split, self.first = self.chosen.split, self.chosen.first
        self.scene, self.sequence = self.chosen.scene, self.chosen.sequence
        self.pose, self.motion = self.chosen.pose, self.chosen.motion
        self._grounds: dict[int, RawSample] = {}
        self._whole: dict[str, Values] = {}

    def __repr__(self) -> str:
        return (
            f"SonarPairs({len(self):,} samples of {self.frames} frames, part {self._part}, {self.arrange.kind} of "
            f"{', '.join(list(self.arrange.views)[:4])}, {self.recipe.name}: {self.store.place.url})"
        )

    def __len__(self) -> int:
        return len(self.first)

    def frame_numbers(self, index: int) -> slice:
        """Return the frames of a sample, as numbered in the store."""
        return self.chosen.frame_numbers(index)

    def target(self, index: int) -> NDArray[np.float64]:
        """Return the mean motion from frame to frame (sideways m, forward m, yaw rad).

        Of a sample of one frame the target is its height over z = 0 [m].
        """
        here = self.frame_numbers(index)
        if self.frames == 1:
            return self.pose[here, 2]
        if self.ground:  # in the axes of the sonar, which its geometry has
            return np.asarray(motions(self.pose[here]).mean(axis=0))
        return np.asarray(self.motion[here.start : here.stop - 1].mean(axis=0))

    def raw(self, index: int) -> RawSample:
        """Read a sample as it is stored: frames by view, their numbers, and the label; see :meth:`finished`."""
        here = self.frame_numbers(index)
        sample: RawSample = {
            "frames": np.arange(here.start, here.stop),
            "label": self.labels.encode(self.target(index)),
        }
        for name, (kind, view) in array_names(self.recipe).items():
            if view in self.arrange.views and kind == self.stored_kind:
                sample[view] = self._read(name, here)
            elif view in self.arrange.views and kind == "nonzero" and self.stored_kind == "vector":
                sample[f"nonzero_{view}"] = self._read(name, here).astype(np.int32)
        if self.ground:
            if index not in self._grounds:  # it is the same in every epoch
                image = sample[self.arrange.views[0]]
                self._grounds[index] = self.ground_below(image, self.pose[here], self.store.read("height_m", here))
            sample |= self._grounds[index]
        return sample

    def _read(self, name: str, here: slice) -> Values:
        """Read frames of an array. Vectors are small and kept in memory: reading each of them costs more than learning."""
        levels = int(np.prod(self.store.modality.stored[name].shape))
        if self.stored_kind != "vector" or 4 * levels * len(self.sequence) > KEPT_BYTES:
            return self.store.read(name, here)
        if name not in self._whole:
            self._whole[name] = self.store.read(name)
        return self._whole[name][here]

    def __getstate__(self) -> Fields:
        """Return the state without what was read: other processes read for themselves."""
        return {**vars(self), "_whole": {}}

    def sonar_frames(self, index: int, image: Values | None = None) -> SonarFrames:
        """Read a sample of one view as frames with noise, poses and heights, as estimators take it.

        Args:
            index: of the sample.
            image: replaces the stored frames ``(frames, bins, beams)``; it gets the same noise.

        Raises:
            MitsonarError: samples of vectors, or of several views.
        """
        if len(self.arrange.views) > 1 or self.arrange.kind != "image":
            raise MitsonarError(f"frames hold images of one view: choose one of {', '.join(self.arrange.views)}")
        here, (name,) = self.frame_numbers(index), self.arrange.views
        sample = {key: np.asarray(values)[None] for key, values in self.raw(index).items()}
        if image is not None:
            sample[name] = image[None]
        image = self.arrange.noisy(sample, name, sample["frames"], self.epoch_seed)[0]
        return self.frames_of(
            np.asarray(image),
            self.pose[here],
            self.store.read("height_m", here),
            time_s=self.store.read("time_s", here),
            level_scale=float(self.store.about["level_scale"]),
        )


def _noise_name(noise: NoiseModel) -> str:
    """Return the name of a noise model, or its three numbers."""
    names = [name for name, model in NOISE_MODELS.items() if model == noise]
    return names[0] if names else f"{noise.mean:g},{noise.std:g},{noise.scale:g}"


# ---------------- Samples of several data sets of one sonar, such as one in each model, joined for one training


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


# ---------------- The samples of a part of a data set: their frames, poses and scenes


AnySplit: TypeAlias = str | Split | Fields | None
"""A split by name, as an object, or by the keys of a recipe; None: the recipe's own."""


@dataclass(frozen=True)
class Part:
    """Samples of consecutive frames of one sequence.

    Attributes:
        split: that assigns the frames.
        frames: number of frames of a sample.
        first: the first frame of each sample ``(samples,)``.
        scene, sequence: of each frame of the store ``(frames,)``.
        pose: of the sonar ``(frames, 6)``.
        motion: to the next frame ``(frames, 3)``.
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
        one_a_sequence: bool = False,
    ) -> Part:
        """Find the samples of a part.

        Args:
            store: of the data set.
            part: ``train``, ``validation``, ``test``, or ``all``.
            split: see :func:`split_for`.
            frames: number of frames of a sample.
            seed: of the choice of one sample a sequence.
            one_a_sequence: whether only one sample of each sequence is taken.

        Raises:
            MitsonarError: unknown part or split, a part without samples.
        """
        dealt = split_for(split, store.recipe)
        scene, sequence, pose, motion = (store.read(name) for name in ("scene", "sequence", "pose", "motion"))
        first = np.arange(max(0, len(sequence) - frames + 1))
        first = first[sequence[first] == sequence[first + frames - 1]]
        if dealt.by == "sample":
            first = first[deal_samples(sequence[first], dealt, part)]
        else:
            first = first[deal(world_of(store.recipe, store.scenes)[scene], sequence, dealt, part)[first]]
        if not len(first):
            raise MitsonarError(
                f"{store.place.url} has no sample of {frames} frames in part {part!r}: its sequences have "
                f"{np.bincount(sequence).max()} frames; ask for fewer frames, or another part"
            )
        if one_a_sequence:
            rank = np.random.default_rng([seed, 5]).permutation(len(first))
            order = np.lexsort((rank, sequence[first]))
            first = np.sort(first[order][np.unique(sequence[first][order], return_index=True)[1]])
        return cls(dealt, frames, first, scene, sequence, pose, motion)

    def frame_numbers(self, index: int) -> slice:
        """Return the frames of a sample, as numbered in the store."""
        first = int(self.first[index])
        return slice(first, first + self.frames)


def split_for(split: AnySplit, recipe: Recipe) -> Split:
    """Return a split of a data set of this recipe; see :class:`~mitsonar.datasets.samples.SonarPairs`.

    Raises:
        MitsonarError: an unknown name or key.
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
