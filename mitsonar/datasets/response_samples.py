"""Impulse responses of a data set, sample by sample, for estimators and regressors; NumPy only."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mitsonar.acoustics.noise import snr_of
from mitsonar.config.data import Recipe
from mitsonar.datasets.arrangement import Labels
from mitsonar.datasets.response_packing import Packing, packed
from mitsonar.datasets.sample_index import AnySplit, Part
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import motions
from mitsonar.records.responses import ImpulseResponses

__all__ = ["ImpulseSamples", "Leak", "displacement_labels"]

Leak = Literal["none", "one_ping", "strangers"]
"""What a sample keeps of the motion; see :class:`ImpulseSamples`."""

LEAKS = ("none", "one_ping", "strangers")


def displacement_labels(kind: str, recipe: Recipe, pings: int) -> Labels:
    """Return the labels of displacements from the first of ``pings`` pings to the last; yaw only where the recipe turns."""
    step = Labels.of(kind, recipe, 2)
    count = 3 if recipe.flight.yaw_deg > 0 else 2
    return Labels(kind, (pings - 1) * step.low[:count], (pings - 1) * step.high[:count], step.names[:count])


class ImpulseSamples:
    """Samples of a data set of impulse responses: Q consecutive pings and the displacement from the first to the last.

    Args:
        url: path or URL of the store.
        part: ``train``, ``validation``, ``test``, or ``all``.
        split: ``scene``, ``sequence``, keys, or a :class:`~mitsonar.config.data.Split`; default: the recipe's own.
        frames: Q, pings of a sample; default: the recipe's.
        noise: ``none``, a signal-to-noise ratio such as ``20 dB`` (see
            :func:`~mitsonar.datasets.response_packing.noise_power`), or a list of them, of which each sample draws one.
        labels: ``raw`` (m, m, rad), ``quantised`` or ``normx10``.
        seed: of the noise.
        leak: for tests of where an estimator finds the motion. ``one_ping`` repeats the first response, ``strangers`` takes
            all but the first response from a sample of another scene. Neither holds the motion.
        one_a_sequence: whether only one sample of each sequence is taken.

    Attributes:
        sonar: the instrument.
        arrange: packing and noise.

    Raises:
        MitsonarError: no finished data set of responses there, an unknown option, a part without samples.
    """

    def __init__(
        self,
        url: str | Path,
        *,
        part: str = "train",
        split: AnySplit = None,
        frames: int | None = None,
        noise: str | Sequence[str] = "none",
        labels: str = "normx10",
        seed: int = 0,
        leak: Leak = "none",
        one_a_sequence: bool = False,
    ) -> None:
        self.store, self._part = DataStore.open(url), part
        self.recipe = self.store.recipe
        self.sonar = self.recipe.channel_sonar
        self.frames = self.recipe.frames if frames is None else frames
        if self.frames < 2:
            raise MitsonarError(f"a sample has two pings or more, first and last: got frames {self.frames}")
        if leak not in LEAKS:
            raise MitsonarError(f"leak must be one of {', '.join(LEAKS)}: got {leak!r}")
        levels = [noise] if isinstance(noise, str) else list(noise)
        if not levels:
            raise MitsonarError("noise is a ratio or a list of them: got an empty list; give none for no noise")
        self.arrange = Packing(tuple(one.name for one in self.sonar.receivers), tuple(map(snr_of, levels)))
        self.labels = displacement_labels(labels, self.recipe, self.frames)
        self.seed, self.epoch, self.leak = seed, 0, leak
        self.chosen = Part.of(self.store, part, split, self.frames, seed=seed, one_a_sequence=one_a_sequence)
        self.split, self.first = self.chosen.split, self.chosen.first
        self.scene, self.sequence = self.chosen.scene, self.chosen.sequence
        if leak == "strangers" and len(np.unique(self.scene[self.first])) < 2:
            raise MitsonarError(f"strangers are of two scenes, part {part!r} has one: read another part, or make more")

    def __len__(self) -> int:
        return len(self.first)

    def __repr__(self) -> str:
        receivers = len(self.arrange.receivers)
        return (
            f"{type(self).__name__}({len(self):,} samples of {self.frames} pings at {receivers} receivers, "
            f"part {self._part}, {self.recipe.name}: {self.store.place.url})"
        )

    def frame_numbers(self, index: int) -> slice:
        """Return the pings of a sample, as numbered in the store."""
        return self.chosen.frame_numbers(index)

    def target(self, index: int) -> NDArray[np.float64]:
        """Return the displacement from the first ping to the last (Almanza-Medina, eq. 3.4).

        It is sideways, forward [m] and, if the recipe turns, yaw [rad].
        """
        here = self.frame_numbers(index)
        ends = self.chosen.pose[[here.start, here.stop - 1]]
        return np.asarray(motions(ends)[0, : len(self.labels.names)])

    def targets(self) -> NDArray[np.float64]:
        """Return the displacements of all samples ``(samples, 2 or 3)``."""
        return np.array([self.target(index) for index in range(len(self))])

    def response(self, index: int) -> NDArray[np.complex64]:
        """Read the responses of a sample ``(Q, M, taps)``, without noise, changed as ``leak`` says."""
        mine = self.store.read("response", self.frame_numbers(index))
        if self.leak == "one_ping":
            return np.repeat(mine[:1], self.frames, axis=0)
        if self.leak == "strangers":
            others = np.flatnonzero(self.scene[self.first] != self.scene[self.first[index]])
            other = int(np.random.default_rng([self.seed, 11, int(self.first[index])]).choice(others))
            return np.concatenate([mine[:1], self.store.read("response", self.frame_numbers(other))[1:]])
        return mine

    @property
    def noise_seed(self) -> int:
        """Return the seed of the noise."""
        return self.seed

    def received(self, index: int) -> NDArray[np.complexfloating]:
        """Read the responses of a sample ``(Q, M, taps)``, with its noise."""
        here = self.frame_numbers(index)
        return self.arrange.received(self.response(index), np.arange(here.start, here.stop), self.noise_seed)

    def matrix(self, index: int) -> NDArray[np.float32]:
        """Read the packed matrix ``(taps, 2 M Q)`` of a sample, with its noise."""
        return packed(self.received(index))

    def responses(self, index: int) -> ImpulseResponses:
        """Read a sample with its noise, as estimators take it."""
        here = self.frame_numbers(index)
        known = self._per_ping
        return ImpulseResponses(
            response=self.received(index),
            sonar=self.sonar,
            poses=self.chosen.pose[here],
            time_s=known["time_s"][here],
            velocity=known["velocity"][here],
            height_m=known["height_m"][here],
        )

    @cached_property
    def _per_ping(self) -> dict[str, NDArray[np.float64]]:
        """Read the small arrays of the whole store, one chunk each."""
        return {name: self.store.read(name) for name in ("time_s", "velocity", "height_m")}
