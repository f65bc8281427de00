"""Samples of a data set for torch: two or more consecutive frames with their labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from mitsonar.acoustics.noise import NOISE_MODELS, NoiseModel, load_noise
from mitsonar.config.data import Recipe, array_names
from mitsonar.datasets.arrangement import Arrangement, Labels, arrangement_of
from mitsonar.datasets.batches import Batch, Batches, Device, RawSample, StoredBatches
from mitsonar.datasets.ground_nodes import ground_of
from mitsonar.datasets.modality import Fields, Values
from mitsonar.datasets.sample_index import AnySplit, Part
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError, refuse_unknown
from mitsonar.geometry.ground import attitude_of
from mitsonar.motion.composition import motions
from mitsonar.records.frames import SonarFrames

__all__ = ["ArrangementOptions", "SampleOptions", "Samples", "SonarPairs"]

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
        """Describe the samples, as a checkpoint keeps it; see :meth:`~mitsonar.datasets.batches.Batches.described`."""
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
