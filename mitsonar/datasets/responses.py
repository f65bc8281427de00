"""How impulse responses of a data set become samples for networks and estimators (Almanza-Medina, 5.2.5), with noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.acoustics.noise import parse_snr
from mitsonar.config.data import Recipe
from mitsonar.datasets.arrangement import WHICH_LEVEL, Labels
from mitsonar.datasets.sample_index import AnySplit, Part
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import motions
from mitsonar.records.responses import ImpulseResponses

__all__ = ["ImpulseSamples", "Leak", "Packing", "displacement_labels", "noise_power", "pack_responses", "with_noise"]


SIGNAL_ENERGY = (0.01, 0.99)
"""Fractions of the energy that mark the first and the last tap of the signal."""


def pack_responses(response: NDArray[np.complexfloating]) -> NDArray[np.float32]:
    """Pack responses ``(..., Q, M, taps)`` into matrices ``(..., taps, 2 M Q)`` (Almanza-Medina, 5.2.5).

    For each of M receivers, the columns are the real parts of its Q responses, then their imaginary parts. They are divided
    by the largest magnitude of the sample. A sample without signal remains 0.
    """
    pings, receivers, taps = response.shape[-3:]
    largest = np.abs(response).max(axis=(-3, -2, -1), keepdims=True)
    unit = np.moveaxis(response / np.where(largest > 0, largest, 1), -1, -3)  # (..., taps, Q, M)
    parts = np.stack([unit.real, unit.imag], axis=-1)  # (..., taps, Q, M, 2)
    columns = np.moveaxis(parts, -3, -1)  # (..., taps, M, 2, Q)
    return np.ascontiguousarray(columns.reshape(*response.shape[:-3], taps, 2 * pings * receivers), dtype=np.float32)


def noise_power(response: NDArray[np.complexfloating], snr_db: float) -> float:
    """Compute the variance of the complex noise per tap for a signal-to-noise ratio [dB].

    The signal power is the mean power over pings, receivers and taps of the responses ``(Q, M, taps)``, from the tap where
    1 % of the energy has arrived to the tap where 99 % has arrived. Taps outside this interval are ignored.
    """
    energy = (np.abs(response.astype(np.complex128)) ** 2).mean(axis=(0, 1))
    total = np.cumsum(energy)
    if total[-1] == 0:
        return 0.0
    first, last = np.searchsorted(total, np.array(SIGNAL_ENERGY) * total[-1])
    return float(energy[first : last + 1].mean() * 10 ** (-snr_db / 10))


def with_noise(
    response: NDArray[np.complexfloating], numbers: ArrayLike, snr_db: float | None, seed: int
) -> NDArray[np.complexfloating]:
    """Add white complex noise to the responses of one sample. Its random numbers depend on (seed, ping number).

    Args:
        response: responses without noise ``(Q, M, taps)``.
        numbers: ping numbers ``(Q,)``.
        snr_db: signal-to-noise ratio [dB], see :func:`noise_power`; None: no noise.
        seed: seed of the noise.
    """
    if snr_db is None:
        return response
    std = np.sqrt(noise_power(response, snr_db) / 2)
    draws = [np.random.default_rng([seed, int(number)]) for number in np.asarray(numbers)]
    parts = np.stack([rng.standard_normal((*response.shape[1:], 2)) for rng in draws])
    noisy = response + std * (parts[..., 0] + 1j * parts[..., 1])
    return np.asarray(noisy, dtype=response.dtype)


@dataclass(frozen=True)
class Packing:
    """Conversion of a batch of responses to network input.

    Attributes:
        receivers: names of the receivers, in order.
        levels: signal-to-noise ratios [dB], None for no noise. If there are several, one is drawn for each sample, as a
            function of the seed and the number of its first ping.
    """

    receivers: tuple[str, ...]
    levels: Sequence[float | None] = (None,)

    def received(self, response: NDArray[np.complexfloating], numbers: ArrayLike, seed: int) -> NDArray[np.complexfloating]:
        """Add noise to one sample ``(Q, M, taps)``. If there are several levels, one is drawn."""
        level = 0
        if len(self.levels) > 1:
            level = int(np.random.default_rng([seed, WHICH_LEVEL, int(np.asarray(numbers)[0])]).integers(len(self.levels)))
        return with_noise(response, numbers, self.levels[level], seed)

    def __call__(self, response: NDArray[np.complexfloating], numbers: ArrayLike, seed: int) -> NDArray[np.float32]:
        """Pack responses ``(batch, Q, M, taps)`` into matrices ``(batch, 1, taps, 2 M Q)``, with noise.

        Args:
            response: responses without noise.
            numbers: ping numbers ``(batch, Q)``.
            seed: seed of the noise.
        """
        rows = zip(response, np.asarray(numbers), strict=True)
        return pack_responses(np.stack([self.received(sample, pings, seed) for sample, pings in rows]))[:, None]


# ---------------- Samples for estimators, without torch


Leak = Literal["none", "one_ping", "strangers"]
"""Replacement of responses that removes the motion from a sample; see :class:`ImpulseSamples`."""

LEAKS = ("none", "one_ping", "strangers")


def displacement_labels(kind: str, recipe: Recipe, pings: int) -> Labels:
    """Return the labels of displacements from the first of ``pings`` pings to the last, with yaw if the recipe has it."""
    step = Labels.of(kind, recipe, 2)
    count = 3 if recipe.flight.yaw_deg > 0 else 2
    return Labels(kind, (pings - 1) * step.low[:count], (pings - 1) * step.high[:count], step.names[:count])


class ImpulseSamples:
    """Samples of a data set of impulse responses: Q consecutive pings and the displacement from the first to the last.

    Args:
        url: path or URL of the store.
        part: ``train``, ``validation``, ``test``, or ``all``.
        split: ``scene``, ``sequence``, keys of a recipe's split, or a :class:`~mitsonar.config.data.Split`; default: the
            split of the recipe.
        frames: number Q of pings per sample; default: as in the recipe.
        noise: ``none``, a signal-to-noise ratio such as ``20 dB`` (see :func:`noise_power`), or a list of them, from which
            one is drawn for each sample.
        labels: ``raw`` (m, m, rad), ``quantised`` or ``normx10``.
        seed: seed of the noise.
        leak: a test that removes the motion from the samples: whatever an estimator still learns has another source.
            ``one_ping`` repeats the first response; ``strangers`` takes all but the first response from a sample of another
            scene.
        one_per_sequence: whether to take only one sample from each sequence.

    Attributes:
        sonar: transmitter and receivers.
        arrange: packing of the responses, with noise.

    Raises:
        MitsonarError: there is no finished data set of responses, an option is unknown, or the part has no samples.
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
        one_per_sequence: bool = False,
    ) -> None:
        self.store, self._part = DataStore.open(url), part
        self.recipe = self.store.recipe
        self.sonar = self.recipe.channel_sonar
        self.frames = self.recipe.frames if frames is None else frames
        if self.frames < 2:
            raise MitsonarError(f"frames must be at least 2, for a first and a last ping: got {self.frames}")
        if leak not in LEAKS:
            raise MitsonarError(f"leak must be one of {', '.join(LEAKS)}: got {leak!r}")
        levels = [noise] if isinstance(noise, str) else list(noise)
        if not levels:
            raise MitsonarError("noise must be a ratio or a list of ratios, not an empty list: give 'none' for no noise")
        self.arrange = Packing(tuple(one.name for one in self.sonar.receivers), tuple(map(parse_snr, levels)))
        self.labels = displacement_labels(labels, self.recipe, self.frames)
        self.seed, self.epoch, self.leak = seed, 0, leak
        self.chosen = Part.of(self.store, part, split, self.frames, seed=seed, one_per_sequence=one_per_sequence)
        self.split, self.first = self.chosen.split, self.chosen.first
        self.scene, self.sequence = self.chosen.scene, self.chosen.sequence
        if leak == "strangers" and len(np.unique(self.scene[self.first])) < 2:
            raise MitsonarError(f"leak='strangers' needs two scenes, part {part!r} has one: read another part, or make more")

    def __len__(self) -> int:
        return len(self.first)

    def __repr__(self) -> str:
        receivers = len(self.arrange.receivers)
        return (
            f"{type(self).__name__}({len(self):,} samples of {self.frames} pings at {receivers} receivers, "
            f"part {self._part}, {self.recipe.name}: {self.store.place.url})"
        )

    def frame_slice(self, index: int) -> slice:
        """Return the slice of a sample's pings in the store."""
        return self.chosen.frame_slice(index)

    def target(self, index: int) -> NDArray[np.float64]:
        """Return the displacement from the first ping to the last (Almanza-Medina, eq. 3.4).

        Its components are sideways, forward [m] and, if the recipe has yaw, yaw [rad].
        """
        here = self.frame_slice(index)
        ends = self.chosen.pose[[here.start, here.stop - 1]]
        return np.asarray(motions(ends)[0, : len(self.labels.names)])

    def targets(self) -> NDArray[np.float64]:
        """Return the displacements of all samples ``(samples, 2 or 3)`` [m, m, rad]."""
        return np.array([self.target(index) for index in range(len(self))])

    def response(self, index: int) -> NDArray[np.complex64]:
        """Read the responses of a sample ``(Q, M, taps)`` without noise; ``leak`` selects responses to replace."""
        responses = self.store.read("response", self.frame_slice(index))
        if self.leak == "one_ping":
            return np.repeat(responses[:1], self.frames, axis=0)
        if self.leak == "strangers":
            strangers = np.flatnonzero(self.scene[self.first] != self.scene[self.first[index]])
            stranger = int(np.random.default_rng([self.seed, 11, int(self.first[index])]).choice(strangers))
            return np.concatenate([responses[:1], self.store.read("response", self.frame_slice(stranger))[1:]])
        return responses

    @property
    def noise_seed(self) -> int:
        """Return the seed of the noise."""
        return self.seed

    def received(self, index: int) -> NDArray[np.complexfloating]:
        """Read the responses of a sample ``(Q, M, taps)`` with noise."""
        here = self.frame_slice(index)
        return self.arrange.received(self.response(index), np.arange(here.start, here.stop), self.noise_seed)

    def matrix(self, index: int) -> NDArray[np.float32]:
        """Read the packed matrix ``(taps, 2 M Q)`` of a sample with noise."""
        return pack_responses(self.received(index))

    def responses(self, index: int) -> ImpulseResponses:
        """Read a sample with noise as :class:`ImpulseResponses`, the input of estimators."""
        here = self.frame_slice(index)
        per_ping = self._per_ping
        return ImpulseResponses(
            response=self.received(index),
            sonar=self.sonar,
            poses=self.chosen.pose[here],
            time_s=per_ping["time_s"][here],
            velocity=per_ping["velocity"][here],
            height_m=per_ping["height_m"][here],
        )

    @cached_property
    def _per_ping(self) -> dict[str, NDArray[np.float64]]:
        """Read the small arrays for all pings of the store; each is stored as a single chunk."""
        return {name: self.store.read(name) for name in ("time_s", "velocity", "height_m")}
