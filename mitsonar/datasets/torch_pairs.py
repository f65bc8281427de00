"""A data set as torch reads it: pairs (or more) of consecutive frames with their labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from mitsonar.acoustics.noise import NOISE_MODELS, NoiseModel, load_noise
from mitsonar.config.data_recipe import Recipe, Split, array_names
from mitsonar.datasets.arrangement import Arrangement, Labels, arrangement_of
from mitsonar.datasets.batches import Batches, StoredBatches
from mitsonar.datasets.ground_nodes import ground_of
from mitsonar.datasets.sample_index import Part
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.geometry.attitude import attitude_of
from mitsonar.motion.composition import motions
from mitsonar.records.sonar_frames import SonarFrames

__all__ = ["Samples", "SonarPairs"]

GROUND = "ground/"
"""Before the names of the ground's geometry in a raw sample."""

KEPT_BYTES = 2**28
"""Of an array of vectors that is kept in memory once it has been read."""


class Samples(Batches):
    """What stored and rendered samples share: how raw frames become inputs and labels.

    Attributes:
        recipe: of the data set.
        frames: of a sample.
        arrange: from frames to inputs.
        labels: from targets to labels and back.
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

    def finished(self, batch: dict[str, torch.Tensor], device: torch.device | str | None = None) -> tuple[Any, torch.Tensor]:
        """Inputs and labels of a batch of raw samples; noise and layout are made on ``device``."""
        moved = {name: values.to(device, non_blocking=True) for name, values in batch.items()}
        ground = {name.removeprefix(GROUND): moved.pop(name) for name in list(moved) if name.startswith(GROUND)}
        inputs = self.arrange(moved, moved["frames"], self.epoch_seed)
        return (inputs, ground) if self.ground else inputs, moved["label"]

    def ground_below(self, image: NDArray[Any], poses: NDArray[np.float64], height_m: NDArray[np.float64]) -> dict[str, Any]:
        """The geometry of a raw sample's frames, as networks that know it take it; by name, to be added to the sample.

        Args:
            image: of the one view ``(frames, bins, beams)``, without noise.
            poses: of the sonar.
            height_m: over the ground.
        """
        frames = self.frames_of(image, poses, height_m, time_s=np.arange(len(image), dtype=float))
        standing = attitude_of(frames, "the ground", None, None)
        return {f"{GROUND}{name}": values for name, values in ground_of(frames, standing).items()}

    def frames_of(
        self, image: NDArray[Any], poses: NDArray[np.float64], height_m: NDArray[np.float64], **more: Any
    ) -> SonarFrames:
        """Frames of the one view."""
        view = next(view for view in self.recipe.views if view.name == self.arrange.views[0])
        return SonarFrames(
            image=image,
            range_m=view.sonar.range_m,
            bearing_rad=view.bearing_rad,
            sonar=view.sonar,
            poses=poses,
            height_m=height_m,
            **more,
        )

    @property
    def stored_kind(self) -> str:
        """What samples are made of: images also where vectors are wanted and only images are there, or halves of them."""
        return self.arrange.kind if self.arrange.kind in self.recipe.kinds and not self.arrange.halves else "image"

    def at_noise(self, level: str) -> Arrangement:
        """The arrangement with one level of noise."""
        return replace(self.arrange, noise=load_noise(level), levels=())

    def described(self) -> dict[str, Any]:
        """What a checkpoint keeps of the samples that a network was trained on."""
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
            "noise": "; ".join(map(_said, arrange.levels or [arrange.noise])),
        }


class SonarPairs(StoredBatches, Samples, Dataset[Any]):
    """Samples of a data set's store, each ``frames`` consecutive frames with the motion between them.

    ``pairs[i]`` is ``(input, label)``, float32 tensors, ready for ``torch.utils.data.DataLoader``; :meth:`loader` does the
    same with noise and layout made on the device of the batch.

    Args:
        url: path or URL of the store.
        part: ``train``, ``validation``, ``test``, or ``all``.
        split: ``sequence`` (the thesis's: 95 % and 5 % of the sequences), ``scene`` (80, 10 and 10 % of the scenes: worlds
            that training never saw; scenes of one world stay together), or by, train, validation, test and seed as a
            dictionary or :class:`~mitsonar.config.data_recipe.Split`; default: the recipe's own.
        frames: of a sample; 1 gives heights as labels; default: the recipe's.
        views: which views; default: all.
        kind: ``image`` or ``vector``; default: what is stored.
        layout: ``side``, ``stack`` or ``channels``; see :class:`~mitsonar.datasets.arrangement.Arrangement`.
        coordinates: ``polar``, ``cartesian`` or ``both`` (then the input is a pair).
        cartesian_rows: pixels of a fan in the forward direction.
        range_levels: of vectors, neighbouring ones of the stored added up to so many (with their noise); default: as stored.
        halves: vectors of both halves of each image in azimuth (fig. 4.18), port first.
        noise: ``none``, ``low``, ``high``, ``chapter2``, three numbers, or a model; of a list each sample draws one.
        labels: ``raw`` (m, m, rad), ``quantised`` (0..31) or ``normx10`` (+-10); ``pairs.labels.decode`` goes back.
        seed: of noise and order; the split has its own (``Split.seed``), so that another seed never mixes its parts.
        ground: the input is a pair of images and the geometry of the ground below them, as ``corrnet`` takes it; labels are
            then the sonar's motions, not those of a vehicle that it is mounted on.
        one_a_sequence: only one sample of each sequence, for independent tests.

    Raises:
        MitsonarError: no finished data set there, words that are not known, a part without frames.
    """

    def __init__(
        self,
        url: str | Path,
        *,
        part: str = "train",
        split: str | Split | dict[str, Any] | None = None,
        one_a_sequence: bool = False,
        **arrangement: Any,
    ) -> None:
        self.store = DataStore.open(url)
        Samples.__init__(self, self.store.recipe, **arrangement)
        self.chosen = Part.of(self.store, part, split, self.frames, seed=self.seed, one_a_sequence=one_a_sequence)
        self.split, self.first = self.chosen.split, self.chosen.first
        self.scene, self.sequence = self.chosen.scene, self.chosen.sequence
        self.pose, self.motion = self.chosen.pose, self.chosen.motion
        self._grounds: dict[int, dict[str, Any]] = {}
        self._whole: dict[str, NDArray[Any]] = {}

    def __len__(self) -> int:
        return len(self.first)

    def frame_numbers(self, index: int) -> slice:
        """The frames of a sample, as numbered in the store."""
        return self.chosen.frame_numbers(index)

    def target(self, index: int) -> NDArray[np.float64]:
        """The mean motion from frame to frame (sideways m, forward m, yaw rad); of one frame its height over z = 0 [m]."""
        here = self.frame_numbers(index)
        if self.frames == 1:
            return self.pose[here, 2]
        if self.ground:  # in the axes of the sonar, which its geometry has
            return motions(self.pose[here]).mean(axis=0)
        return np.asarray(self.motion[here.start : here.stop - 1].mean(axis=0))

    def raw(self, index: int) -> dict[str, Any]:
        """A sample as it is stored: frames by view, their numbers, and the label; :meth:`finished` makes a batch of them."""
        here = self.frame_numbers(index)
        sample: dict[str, Any] = {
            "frames": np.arange(here.start, here.stop),
            "label": self.labels.encode(self.target(index)),
        }
        for name, (kind, view) in array_names(self.recipe).items():
            if view in self.arrange.views and kind == self.stored_kind:
                sample[view] = self._read(name, here)
            elif view in self.arrange.views and kind == "nonzero" and self.stored_kind == "vector":
                sample[f"nonzero_{view}"] = self._read(name, here).astype(np.int32)
        if self.ground:
            if index not in self._grounds:  # an epoch later it is the same
                image = sample[self.arrange.views[0]]
                self._grounds[index] = self.ground_below(image, self.pose[here], self.store.read("height_m", here))
            sample |= self._grounds[index]
        return sample

    def _read(self, name: str, here: slice) -> NDArray[Any]:
        """Frames of an array; vectors are small and kept in memory: reading them one by one costs more than learning."""
        levels = int(np.prod(self.store.modality.stored[name].shape))
        if self.stored_kind != "vector" or 4 * levels * len(self.sequence) > KEPT_BYTES:
            return self.store.read(name, here)
        if name not in self._whole:
            self._whole[name] = self.store.read(name)
        return self._whole[name][here]

    def __getstate__(self) -> dict[str, Any]:
        """For other processes, which read for themselves."""
        return {**vars(self), "_whole": {}}

    def sonar_frames(self, index: int, image: NDArray[Any] | None = None) -> SonarFrames:
        """A sample as frames, with noise, for estimators: image, poses, heights (one view).

        Args:
            index: of the sample.
            image: in place of the stored frames, like them ``(frames, bins, beams)``; it gets the same noise.
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


def _said(noise: NoiseModel) -> str:
    names = [name for name, model in NOISE_MODELS.items() if model == noise]
    return names[0] if names else f"{noise.mean:g},{noise.std:g},{noise.scale:g}"
