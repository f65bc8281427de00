"""How samples are rendered while a network trains: an endless stream of new worlds and motions that is never stored."""

from __future__ import annotations

import itertools
import multiprocessing
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Unpack

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import IterableDataset, get_worker_info

from mitsonar.config.data import Recipe, load_recipe, recipe_from
from mitsonar.datasets.make import SceneRenderer, calibrate
from mitsonar.datasets.modality import Scene, Values
from mitsonar.datasets.plan import scenes_of, sequences_of, world_seed
from mitsonar.datasets.samples import ArrangementOptions, Batch, Device, RawSample, Samples, SonarPairs
from mitsonar.errors import MitsonarError, check_argument_names
from mitsonar.motion.composition import motions
from mitsonar.motion.pose import mounted
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.device import ensure_variant, release_memory, use_threads

__all__ = ["RawStream", "RenderedPairs", "rerender"]


class RenderedPairs(IterableDataset[Batch], Samples):
    """Endless stream of rendered samples of a recipe.

    Its worlds and flights differ from those of any data set that ``dataset make`` writes, except for worlds that do not
    depend on a seed, such as scene files.

    Iteration yields ``(input, label)``, as :class:`~mitsonar.datasets.samples.SonarPairs` does. :meth:`loader` yields
    batches, with noise and layout computed on their device. Each worker of a ``DataLoader`` renders different worlds.
    Workers must be started by spawn, because the ray tracer does not survive a fork: ``DataLoader(pairs, num_workers=2,
    multiprocessing_context="spawn")``.

    Args:
        recipe: a recipe, its name, or a YAML file.
        seed: seed of worlds, flights, jitter and noise.
        length: number of samples per epoch over all workers; None: endless.
        sequences_per_world: number of sequences per world.
        buffer: number of samples from which the next one is drawn at random.
        gain: gain of the pixels; default: the gain that a data set of this recipe has, computed once at the start.
        arrangement: options of ``SonarPairs``: frames, views, kind, layout, coordinates, noise, labels.

    Attributes:
        worlds: the recipe, with the seed of the rendered worlds, flights and jitter.

    Raises:
        MitsonarError: the recipe or an option is unknown, or workers were forked.
    """

    def __init__(
        self,
        recipe: Recipe | str | Path,
        *,
        seed: int,
        length: int | None = None,
        sequences_per_world: int = 1000,
        buffer: int = 500,
        gain: float | None = None,
        **arrangement: Unpack[ArrangementOptions],
    ) -> None:
        option_names = ("seed", "length", "sequences_per_world", "buffer", "gain")
        check_argument_names(arrangement, (*option_names, *ArrangementOptions.__annotations__), type(self).__name__)
        recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
        Samples.__init__(self, recipe, seed=seed, **arrangement)
        if recipe.flight.kind != "random":
            raise MitsonarError(
                f"samples can be rendered for random flights only: got flight.kind {recipe.flight.kind}; make a data set"
            )
        if self.frames > recipe.flight.pings:
            raise MitsonarError(f"frames must be at most flight.pings, {recipe.flight.pings}: got {self.frames}")
        stream_seed = int(np.random.SeedSequence([self.seed, 9]).generate_state(1)[0] // 2)
        self.worlds = recipe_from({**recipe.model_dump(), "seed": stream_seed})  # rebuilt, since a copy keeps cached values
        self.length, self.sequences_per_world, self.buffer, self.gain = length, sequences_per_world, buffer, gain

    def __repr__(self) -> str:
        length = "endless" if self.length is None else f"{self.length:,}"
        return f"RenderedPairs({length} samples of {self.frames} frames, rendered from {self.recipe.name}, seed {self.seed})"

    def __iter__(self) -> Iterator[Batch]:
        for sample in self.raw():
            yield self.one(sample)

    def raw(self, skip: int = 0, share: tuple[int, int] | None = None) -> Iterator[RawSample]:
        """Yield the raw samples of this worker; :meth:`~mitsonar.datasets.samples.Samples.finished` makes a batch of them.

        Args:
            skip: number of samples to skip. They are not rendered, unless they lie between samples that are needed.
            share: index of this worker and number of workers; default: those of torch.
        """
        # 1. Divide the samples of the epoch among the workers.
        this_worker = self._set_up()
        worker, workers = share or this_worker
        self._calibrate()
        count = None if self.length is None else self.length // workers + (worker < self.length % workers)
        # 2. Replay the shuffled order up to ``skip``. Rendering starts at the first sample that is not skipped.
        order = self._order(worker, count)
        skipped: set[int] = set()
        first = 0
        for number in itertools.islice(order, skip):
            skipped.add(number)
            while first in skipped:
                skipped.remove(first)
                first += 1
        # 3. Render in sequence, and buffer samples until their turn in the shuffled order.
        stream = self._rendered(worker, workers, first)
        buffered: dict[int, RawSample] = {}
        for number in order:
            while number not in buffered:
                rendered_number, sample = next(stream)
                if rendered_number >= first and rendered_number not in skipped:
                    buffered[rendered_number] = sample
            yield buffered.pop(number)

    def _order(self, worker: int, length: int | None) -> Iterator[int]:
        """Yield sample numbers in shuffled order; each is drawn from a buffer of ``buffer`` numbers."""
        rng = np.random.default_rng([self.seed, 7, self.epoch, worker])
        waiting: list[int] = []

        def drawn() -> int:
            index = int(rng.integers(len(waiting)))
            waiting[index], waiting[-1] = waiting[-1], waiting[index]
            return waiting.pop()

        for number in itertools.count() if length is None else range(length):
            waiting.append(number)
            if len(waiting) >= self.buffer:
                yield drawn()
        while waiting:
            yield drawn()

    def loader(self, batch_size: int, *, device: Device = None, workers: int = 0) -> Iterator[Batch]:
        """Yield batches on a device.

        Args:
            batch_size: number of samples per batch.
            device: device of inputs and labels.
            workers: number of rendering processes; 0: render in this process.
        """
        if workers:  # calibrate once here, not in each worker
            ensure_variant()
            self._calibrate()
        yield from self.batches(RawStream(self, batch_size), batch_size, device, workers)

    def _calibrate(self) -> None:
        if self.gain is None:
            self.gain = calibrate(self.recipe)

    def _set_up(self) -> tuple[int, int]:
        """Set up the renderer, and return the index of this worker and the number of workers."""
        info = get_worker_info()
        if info is None:
            ensure_variant()
            return 0, 1
        if "drjit" in sys.modules and multiprocessing.current_process().name.startswith("Fork"):
            raise MitsonarError(
                "this worker was forked after the ray tracer had started, which is unsafe: give the DataLoader "
                'multiprocessing_context="spawn", or use RenderedPairs.loader'
            )
        ensure_variant()
        use_threads(1)
        return info.id, info.num_workers

    def _rendered(self, worker: int, workers: int, first: int = 0) -> Iterator[tuple[int, RawSample]]:
        """Render samples world by world, and yield each with its number.

        The stream starts with the first sample of the sequence that contains sample ``first``.
        """
        weights = np.array([group.count * group.sequences for group in self.worlds.scenes], dtype=float)
        samples_per_sequence = self.worlds.flight.pings - self.frames + 1
        world, sequence = divmod(first // samples_per_sequence, self.sequences_per_world)
        number = worker + (world + self.epoch * 10**6) * workers
        count = (first // samples_per_sequence) * samples_per_sequence
        while True:
            rng = np.random.default_rng([self.seed, 8, number])
            group = int(rng.choice(len(weights), p=weights / weights.sum()))
            scene = Scene(number, group, world_seed(self.worlds.seed, number), self.sequences_per_world)
            release_memory()
            for sample in self._samples_of_world(SceneRenderer(self.worlds, scene), sequence):
                yield count, sample
                count += 1
            number, sequence = number + workers, 0

    def _samples_of_world(self, renderer: SceneRenderer, begin: int = 0) -> Iterator[RawSample]:
        """Render samples of one world, starting at sequence ``begin``, with as many sequences per launch as fit."""
        assert self.gain is not None
        recipe, pings = renderer.recipe, renderer.recipe.flight.pings
        sequences_per_launch = max(1, renderer.simulator.model.pings_per_launch // pings)
        sequences = itertools.islice(sequences_of(recipe, renderer.scene), begin, None)
        first_number = renderer.scene.number * self.sequences_per_world * pings
        for start in range(begin, self.sequences_per_world, sequences_per_launch):
            vehicles = [next(sequences).vehicle for _ in range(min(sequences_per_launch, self.sequences_per_world - start))]
            poses = mounted(np.concatenate(vehicles), recipe.mount.pose)
            values = renderer.frames(poses, start * pings, self.gain)
            for k, vehicle in enumerate(vehicles):
                for first in range(pings - self.frames + 1):
                    yield self._sample(values, vehicle, poses, k * pings, first, first_number + start * pings)

    def _sample(
        self,
        values: dict[str, Values],
        vehicle: NDArray[np.float64],
        poses: NDArray[np.float64],
        begin: int,
        first: int,
        number: int,
    ) -> RawSample:
        """Cut one sample from a batch of frames.

        Args:
            values: arrays of all frames of the batch, keyed by name.
            vehicle: poses of the vehicle in the sample's sequence ``(pings, 6)`` [m, rad].
            poses: poses of the sonar in all frames of the batch ``(frames, 6)`` [m, rad].
            begin: index of the sequence's first frame in the batch.
            first: index of the sample's first frame in the sequence.
            number: number of the first frame of the batch, which seeds its noise.
        """
        here = slice(begin + first, begin + first + self.frames)
        if self.frames == 1:
            target = poses[here, 2]
        elif self.ground:
            target = motions(poses[here]).mean(axis=0)
        else:
            target = motions(vehicle[first : first + self.frames]).mean(axis=0)
        sample: RawSample = {
            "frames": np.arange(here.start, here.stop) + number,
            "label": self.labels.encode(target),
        }
        for view in self.arrange.views:
            suffix = self.recipe.suffix(view)
            sample[view] = values[f"{self.stored_kind}{suffix}"][here].copy()
            if self.stored_kind == "vector":
                sample[f"nonzero_{view}"] = values[f"nonzero{suffix}"][here].astype(np.int32)
        if self.ground:
            sample |= self.ground_below(sample[self.arrange.views[0]], poses[here], values["height_m"][here])
        return sample


class RawStream(IterableDataset[RawSample]):
    """Stream of raw samples for worker processes, which render but do not compute inputs.

    Args:
        pairs: the samples to render.
        batch_size: batch size of the loader.
        skip: number of batches already read. With the same number of workers, the loader continues with the next one.
        share: index of this loader and number of loaders, if several processes train together.
    """

    def __init__(self, pairs: RenderedPairs, batch_size: int = 1, skip: int = 0, share: tuple[int, int] = (0, 1)) -> None:
        self.pairs, self.batch_size, self.skip, self.share = pairs, batch_size, skip, share

    def __iter__(self) -> Iterator[RawSample]:
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        worker = (worker + self.skip) % workers  # torch always starts with worker 0
        batches_read = len(range(worker, self.skip, workers))  # batches come from the workers in rotation
        loader, loaders = self.share
        return self.pairs.raw(self.batch_size * batches_read, (loader * workers + worker, loaders * workers))


# ---------------- Rendering stored samples again


def rerender(
    pairs: SonarPairs,
    numbers: Sequence[int],
    *,
    shift: Callable[[int, NDArray[np.float64]], NDArray[np.float64]] | None = None,
    jitter: bool | None = None,
) -> Iterator[tuple[int, SonarFrames]]:
    """Render samples of a data set again, with changed poses (heave between pings, for example) or changed jitter.

    Gain and noise are as in the store.

    Args:
        pairs: samples of a store with images of one view. Its worlds are rebuilt.
        numbers: numbers of the samples.
        shift: function of a sample's number and its poses ``(frames, 6)`` [m, rad] that returns the poses to render. The
            frames keep the stored poses, heights and times.
        jitter: whether rays are jittered within their cells, differently in each ping; default: as in the data set.

    Yields:
        The number of a sample and its frames, scene by scene.

    Raises:
        MitsonarError: the store has vectors, or several views.
    """
    fields = pairs.recipe.model_dump()
    recipe = pairs.recipe if jitter is None else recipe_from({**fields, "sonar": {**fields["sonar"], "jitter": jitter}})
    gain = float(pairs.store.about["gain"])
    selected = np.asarray(numbers, dtype=np.int64)
    scene_of = pairs.scene[pairs.first[selected]]
    for scene in scenes_of(pairs.recipe, pairs.recipe.sequences):
        indices = selected[scene_of == scene.number]
        if not len(indices):
            continue
        renderer = SceneRenderer(recipe, scene)
        start = int(np.argmax(pairs.scene == scene.number))
        for index in indices.tolist():
            here = pairs.frame_slice(index)
            poses = pairs.pose[here] if shift is None else shift(index, pairs.pose[here])
            values = renderer.frames(poses, here.start - start, gain)
            yield index, pairs.sonar_frames(index, next(array for name, array in values.items() if name.startswith("image")))
        del renderer
        release_memory()
