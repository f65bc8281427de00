"""Samples rendered while a network trains, never stored: other worlds and other motions as long as it asks."""

from __future__ import annotations

import itertools
import multiprocessing
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import IterableDataset, get_worker_info

from mitsonar.config.data_recipe import Recipe, load_recipe, recipe_from
from mitsonar.datasets.plan import Scene, sequences_of, world_seed
from mitsonar.datasets.scene_rendering import SceneRenderer, calibrate
from mitsonar.datasets.torch_pairs import Samples
from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import motions
from mitsonar.motion.pose import mounted
from mitsonar.simulation.variant import ensure_variant, release_memory, use_threads

__all__ = ["RawStream", "RenderedPairs"]


class RenderedPairs(IterableDataset[Any], Samples):
    """Endless samples of a recipe's kind, whose worlds and flights are in no data set that ``dataset make`` writes (a world
    that does not depend on its seed, as a scene file, stays what it is).

    Iterating gives ``(input, label)`` as :class:`~mitsonar.datasets.torch_pairs.SonarPairs` does; :meth:`loader` gives
    batches with
    noise and layout made on their device. Each worker of a ``DataLoader`` renders worlds of its own; workers must be started
    by spawn, since the ray tracer does not survive a fork: ``DataLoader(pairs, num_workers=2,
    multiprocessing_context="spawn")``.

    Args:
        recipe: a recipe, its name, or a YAML file.
        seed: of worlds, flights, jitter and noise.
        length: samples of an epoch over all workers; None: no end.
        sequences_a_world: sequences before the next world is built.
        buffer: samples among which the next is drawn.
        gain: of the pixels; default: that of the recipe's own data set, which is computed first.
        arrangement: as for ``SonarPairs``: frames, views, kind, layout, coordinates, noise, labels.

    Attributes:
        worlds: the recipe with the seed that its worlds, flights and jitter have here.

    Raises:
        MitsonarError: unknown recipe or words; workers that were forked.
    """

    def __init__(
        self,
        recipe: Recipe | str | Path,
        *,
        seed: int,
        length: int | None = None,
        sequences_a_world: int = 1000,
        buffer: int = 500,
        gain: float | None = None,
        **arrangement: Any,
    ) -> None:
        recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
        Samples.__init__(self, recipe, seed=seed, **arrangement)
        if recipe.flight.kind != "random":
            raise MitsonarError("frames are rendered in training for random flights only: runs have an end, make a data set")
        if self.frames > recipe.flight.pings:
            raise MitsonarError(f"frames must be at most flight.pings, {recipe.flight.pings}: got {self.frames}")
        own_seed = int(np.random.SeedSequence([self.seed, 9]).generate_state(1)[0] // 2)
        self.worlds = recipe_from({**recipe.model_dump(), "seed": own_seed})  # a copy would keep what it has cached
        self.length, self.sequences_a_world, self.buffer, self.gain = length, sequences_a_world, buffer, gain

    def __iter__(self) -> Iterator[tuple[Any, torch.Tensor]]:
        for sample in self.raw():
            yield self.one(sample)

    def raw(self, skip: int = 0, share: tuple[int, int] | None = None) -> Iterator[dict[str, Any]]:
        """Raw samples of this worker; :meth:`~mitsonar.datasets.torch_pairs.Samples.finished` makes inputs of a batch of
        them.

        Args:
            skip: so many samples, which are not rendered, but for those among which the next ones were still waiting.
            share: number of the worker and how many there are; default: as torch says.
        """
        known = self._ready()
        worker, workers = share or known
        self._calibrate()
        mine = None if self.length is None else self.length // workers + (worker < self.length % workers)
        order = self._order(worker, mine)
        gone: set[int] = set()
        first = 0
        for number in itertools.islice(order, skip):
            gone.add(number)
            while first in gone:
                gone.remove(first)
                first += 1
        rendered = self._rendered(worker, workers, first)
        waiting: dict[int, dict[str, Any]] = {}
        for number in order:
            while number not in waiting:
                place, sample = next(rendered)
                if place >= first and place not in gone:
                    waiting[place] = sample
            yield waiting.pop(number)

    def _order(self, worker: int, length: int | None) -> Iterator[int]:
        """Numbers of the samples as rendered, in the order in which they are given: one of ``buffer`` that wait."""
        rng = np.random.default_rng([self.seed, 7, self.epoch, worker])
        waiting: list[int] = []

        def drawn() -> int:
            place = int(rng.integers(len(waiting)))
            waiting[place], waiting[-1] = waiting[-1], waiting[place]
            return waiting.pop()

        for number in itertools.count() if length is None else range(length):
            waiting.append(number)
            if len(waiting) >= self.buffer:
                yield drawn()
        while waiting:
            yield drawn()

    def loader(
        self, batch_size: int, *, device: torch.device | str | None = None, workers: int = 0
    ) -> Iterator[tuple[Any, torch.Tensor]]:
        """Batches on a device."""
        if workers:  # once here, not in each of them
            ensure_variant()
            self._calibrate()
        yield from self.batches(RawStream(self, batch_size), batch_size, device, workers)

    def _calibrate(self) -> None:
        if self.gain is None:
            self.gain = calibrate(self.recipe)

    def _ready(self) -> tuple[int, int]:
        """Number of this worker and how many there are; the renderer is set up for it."""
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

    def _rendered(self, worker: int, workers: int, first: int = 0) -> Iterator[tuple[int, dict[str, Any]]]:
        """Samples with their numbers in the order in which they are rendered, world after world, from ``first`` on or a few
        before it, where its sequence begins."""
        weights = np.array([group.count * group.sequences for group in self.worlds.scenes], dtype=float)
        of_sequence = self.worlds.flight.pings - self.frames + 1
        turn, sequence = divmod(first // of_sequence, self.sequences_a_world)
        number = worker + (turn + self.epoch * 10**6) * workers
        count = (first // of_sequence) * of_sequence
        while True:
            rng = np.random.default_rng([self.seed, 8, number])
            group = int(rng.choice(len(weights), p=weights / weights.sum()))
            scene = Scene(number, group, world_seed(self.worlds.seed, number), self.sequences_a_world)
            release_memory()
            for sample in self._of_world(SceneRenderer(self.worlds, scene), sequence):
                yield count, sample
                count += 1
            number, sequence = number + workers, 0

    def _of_world(self, renderer: SceneRenderer, begin: int = 0) -> Iterator[dict[str, Any]]:
        """Samples of one world from a sequence on, as many sequences a launch as fit."""
        assert self.gain is not None
        recipe, pings = renderer.recipe, renderer.recipe.flight.pings
        together = max(1, renderer.simulator.pings_per_launch // pings)
        sequences = itertools.islice(sequences_of(recipe, renderer.scene), begin, None)
        before = renderer.scene.number * self.sequences_a_world * pings
        for start in range(begin, self.sequences_a_world, together):
            flown = [next(sequences).vehicle for _ in range(min(together, self.sequences_a_world - start))]
            poses = mounted(np.concatenate(flown), recipe.mount.pose)
            values = renderer.frames(poses, start * pings, self.gain)
            for k, vehicle in enumerate(flown):
                for first in range(pings - self.frames + 1):
                    yield self._sample(values, vehicle, poses, k * pings, first, before + start * pings)

    def _sample(
        self, values: dict[str, Any], vehicle: Any, poses: Any, begin: int, first: int, number: int
    ) -> dict[str, Any]:
        """One sample of a batch of frames."""
        here = slice(begin + first, begin + first + self.frames)
        if self.frames == 1:
            target = vehicle[first : first + 1, 2]
        elif self.ground:
            target = motions(poses[here]).mean(axis=0)
        else:
            target = motions(vehicle[first : first + self.frames]).mean(axis=0)
        sample: dict[str, Any] = {
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


class RawStream(IterableDataset[Any]):
    """The raw samples, for workers that only render.

    Args:
        pairs: what to render.
        batch_size: of the loader.
        skip: batches that were read before: with as many workers as then, the loader goes on with the next.
        share: number of this loader and how many there are, where several processes train together.
    """

    def __init__(self, pairs: RenderedPairs, batch_size: int = 1, skip: int = 0, share: tuple[int, int] = (0, 1)) -> None:
        self.pairs, self.batch_size, self.skip, self.share = pairs, batch_size, skip, share

    def __iter__(self) -> Iterator[dict[str, Any]]:
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        worker = (worker + self.skip) % workers  # torch asks worker 0 first, whoever's turn it was
        had = len(range(worker, self.skip, workers))  # batches come from the workers in turn
        loader, loaders = self.share
        return self.pairs.raw(self.batch_size * had, (loader * workers + worker, loaders * workers))
