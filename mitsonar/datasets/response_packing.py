"""Impulse responses as input of networks (Almanza-Medina, 5.2.5), with noise at a signal-to-noise ratio; NumPy only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.datasets.arrangement import WHICH_LEVEL

__all__ = ["Packing", "noise_power", "packed", "with_noise"]

SIGNAL_ENERGY = (0.01, 0.99)
"""Parts of the energy between whose delays the signal lies."""


def packed(response: NDArray[np.complexfloating]) -> NDArray[np.float32]:
    """Pack responses ``(..., Q, M, taps)`` into matrices ``(..., taps, 2 M Q)`` (Almanza-Medina, 5.2.5).

    The columns are, for each of M receivers, the real parts of its Q responses, then their imaginary parts. They are divided
    by the largest magnitude of the sample. A sample without signal stays 0.
    """
    pings, receivers, taps = response.shape[-3:]
    largest = np.abs(response).max(axis=(-3, -2, -1), keepdims=True)
    unit = np.moveaxis(response / np.where(largest > 0, largest, 1), -1, -3)  # (..., taps, Q, M)
    parts = np.stack([unit.real, unit.imag], axis=-1)  # (..., taps, Q, M, 2)
    columns = np.moveaxis(parts, -3, -1)  # (..., taps, M, 2, Q)
    return np.ascontiguousarray(columns.reshape(*response.shape[:-3], taps, 2 * pings * receivers), dtype=np.float32)


def noise_power(response: NDArray[np.complexfloating], snr_db: float) -> float:
    """Compute the variance of the complex noise of each tap at a signal-to-noise ratio [dB].

    The signal is the mean power of the taps, over pings and receivers ``(Q, M, taps)``, from the tap where 1 % of the energy
    has arrived to the tap where 99 % has. Silence before and after does not count.
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
    """Add white complex noise, drawn from (seed, ping), to the responses ``(Q, M, taps)`` of one sample.

    Args:
        response: without noise.
        numbers: of the pings ``(Q,)``.
        snr_db: signal-to-noise ratio [dB], see :func:`noise_power`; None: no noise.
        seed: of the noise.
    """
    if snr_db is None:
        return response
    each = np.sqrt(noise_power(response, snr_db) / 2)
    draws = [np.random.default_rng([seed, int(number)]) for number in np.asarray(numbers)]
    parts = np.stack([rng.standard_normal((*response.shape[1:], 2)) for rng in draws])
    noisy = response + each * (parts[..., 0] + 1j * parts[..., 1])
    return np.asarray(noisy, dtype=response.dtype)


@dataclass(frozen=True)
class Packing:
    """Turns the responses of a batch into the input of a network.

    Attributes:
        receivers: their names, in order.
        levels: signal-to-noise ratios [dB], None for no noise; of several, each sample draws one by (seed, first ping).
    """

    receivers: tuple[str, ...]
    levels: Sequence[float | None] = (None,)

    def received(self, response: NDArray[np.complexfloating], numbers: ArrayLike, seed: int) -> NDArray[np.complexfloating]:
        """Add its noise to one sample ``(Q, M, taps)``."""
        level = 0
        if len(self.levels) > 1:
            level = int(np.random.default_rng([seed, WHICH_LEVEL, int(np.asarray(numbers)[0])]).integers(len(self.levels)))
        return with_noise(response, numbers, self.levels[level], seed)

    def __call__(self, response: NDArray[np.complexfloating], numbers: ArrayLike, seed: int) -> NDArray[np.float32]:
        """Pack responses ``(batch, Q, M, taps)`` into matrices ``(batch, 1, taps, 2 M Q)``, with noise.

        Args:
            response: without noise.
            numbers: of the pings ``(batch, Q)``.
            seed: of the noise.
        """
        rows = zip(response, np.asarray(numbers), strict=True)
        return packed(np.stack([self.received(one, mine, seed) for one, mine in rows]))[:, None]
