"""A data set as torch reads it: pairs (or more) of consecutive frames with their labels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from mitsonar.dataset.arrangement import Labels, arrangement_of
from mitsonar.dataset.ground import ground_of
from mitsonar.dataset.recipe import Recipe, Split, split_from
from mitsonar.dataset.split import deal, world_of
from mitsonar.dataset.store import DataStore, array_names
from mitsonar.errors import MitsonarError
from mitsonar.frames import SonarFrames
from mitsonar.height import standing_of
from mitsonar.motion import motions
from mitsonar.noise import NoiseModel

__all__ = ["Samples", "SonarPairs", "split_for"]

GROUND = "ground/"
"""Before the names of the ground's geometry in a raw sample."""

SEED_STEP = 1_000_003
"""Between the noise seeds of two epochs: more than any number of views."""


class Samples:
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
        )
        self.labels = Labels.of(labels, recipe, self.frames)
        self.seed, self.epoch, self.ground = seed, 0, ground
        if ground and (self.frames != 2 or len(self.arrange.views) != 1 or self.arrange.kind != "image"):
            raise MitsonarError(
                "the ground is that of pairs of images of one view: give frames=2, views='NAME' of "
                f"{', '.join(self.arrange.views)}, kind='image'"
            )

    def set_epoch(self, epoch: int) -> None:
        """Another epoch draws other noise, and another order in :meth:`SonarPairs.loader`."""
        self.epoch = epoch

    def finished(self, batch: dict[str, torch.Tensor], device: torch.device | str | None = None) -> tuple[Any, torch.Tensor]:
        """Inputs and labels of a batch of raw samples; noise and layout are made on ``device``."""
        moved = {name: values.to(device, non_blocking=True) for name, values in batch.items()}
        ground = {name.removeprefix(GROUND): moved.pop(name) for name in list(moved) if name.startswith(GROUND)}
        inputs = self.arrange(moved, moved["frames"], self.seed + SEED_STEP * self.epoch)
        return (inputs, ground) if self.ground else inputs, moved["label"]

    def ground_below(self, image: NDArray[Any], poses: NDArray[np.float64], height_m: NDArray[np.float64]) -> dict[str, Any]:
        """The geometry of a raw sample's frames, as networks that know it take it; by name, to be added to the sample.

        Args:
            image: of the one view ``(frames, bins, beams)``, without noise.
            poses: of the sonar.
            height_m: over the ground.
        """
        frames = self.frames_of(image, poses, height_m, time_s=np.arange(len(image), dtype=float))
        standing = standing_of(frames, "the ground", None, None)
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

    @property
    def stored_kind(self) -> str:
        """What samples are made of: images also where vectors are wanted and only images are there."""
        return self.arrange.kind if self.arrange.kind in self.recipe.kinds else "image"

    def one(self, sample: dict[str, Any]) -> tuple[Any, torch.Tensor]:
        """Input and label of one raw sample."""
        batch = {name: torch.as_tensor(values)[None] for name, values in sample.items()}
        inputs, label = self.finished(batch)
        return _first(inputs), label[0]


class SonarPairs(Dataset[Any], Samples):
    """Samples of a data set's store, each ``frames`` consecutive frames with the motion between them.

    ``pairs[i]`` is ``(input, label)``, float32 tensors, ready for ``torch.utils.data.DataLoader``; :meth:`loader` does the
    same with noise and layout made on the device of the batch.

    Args:
        url: path or URL of the store.
        part: ``train``, ``validation``, ``test``, or ``all``.
        split: ``sequence`` (the thesis's: 95 % and 5 % of the sequences), ``scene`` (80, 10 and 10 % of the scenes: worlds
            that training never saw; scenes of one world stay together), or by, train, validation, test and seed as a
            dictionary or :class:`~mitsonar.dataset.recipe.Split`; default: the recipe's own.
        frames: of a sample; 1 gives heights as labels; default: the recipe's.
        views: which views; default: all.
        kind: ``image`` or ``vector``; default: what is stored.
        layout: ``side``, ``stack`` or ``channels``; see :class:`~mitsonar.dataset.arrangement.Arrangement`.
        coordinates: ``polar``, ``cartesian`` or ``both`` (then the input is a pair).
        cartesian_rows: pixels of a fan in the forward direction.
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
        self.split = split_for(split, self.recipe)
        self.scene, self.sequence = self.store.read("scene"), self.store.read("sequence")
        self.pose, self.motion = self.store.read("pose"), self.store.read("motion")
        worlds = world_of(self.recipe, self.store.scenes)[self.scene]
        self._grounds: dict[int, dict[str, Any]] = {}
        self.first = self._samples(deal(worlds, self.sequence, self.split, part), one_a_sequence)
        if not len(self.first):
            raise MitsonarError(
                f"{self.store.place.url} has no sample of {self.frames} frames in part {part!r}: its sequences have "
                f"{np.bincount(self.sequence).max()} frames; ask for fewer frames, or another part"
            )

    def _samples(self, mine: NDArray[np.bool_], one_a_sequence: bool) -> NDArray[np.int64]:
        """The first frame of each sample: its sequence goes on for as many frames as it needs."""
        first = np.arange(max(0, len(self.sequence) - self.frames + 1))
        whole = mine[first] & (self.sequence[first] == self.sequence[first + self.frames - 1])
        first = first[whole]
        if one_a_sequence:
            rank = np.random.default_rng([self.seed, 5]).permutation(len(first))
            order = np.lexsort((rank, self.sequence[first]))
            first = np.sort(first[order][np.unique(self.sequence[first][order], return_index=True)[1]])
        return first

    def __len__(self) -> int:
        return len(self.first)

    def __getitem__(self, index: int) -> tuple[Any, torch.Tensor]:
        return self.one(self.raw(index))

    def frame_numbers(self, index: int) -> slice:
        """The frames of a sample, as numbered in the store."""
        first = int(self.first[index])
        return slice(first, first + self.frames)

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
                sample[view] = self.store.read(name, here)
            elif view in self.arrange.views and kind == "nonzero" and self.stored_kind == "vector":
                sample[f"nonzero_{view}"] = self.store.read(name, here).astype(np.int32)
        if self.ground:
            if index not in self._grounds:  # an epoch later it is the same
                image = sample[self.arrange.views[0]]
                self._grounds[index] = self.ground_below(image, self.pose[here], self.store.read("height_m", here))
            sample |= self._grounds[index]
        return sample

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
        image = self.arrange.noisy(sample, name, sample["frames"], self.seed + SEED_STEP * self.epoch)[0]
        return self.frames_of(
            np.asarray(image),
            self.pose[here],
            self.store.read("height_m", here),
            time_s=self.store.read("time_s", here),
            level_scale=float(self.store.about["level_scale"]),
        )

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
        order = torch.Generator().manual_seed(self.seed + SEED_STEP * self.epoch)
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

    pairs: SonarPairs

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self.pairs.raw(index)


def split_for(split: str | Split | dict[str, Any] | None, recipe: Recipe) -> Split:
    """The split that is asked for, of a data set of this recipe; see :class:`SonarPairs`.

    Raises:
        MitsonarError: a word or keys that are not known.
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
        case _:
            raise MitsonarError(f"split must be sequence, scene, or keys as in a recipe: got {split!r}")
