"""The likelihood of one motion by one receiver, with its gradient and information."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.estimation.channel.motion_search import ReceiverBand
from mitsonar.estimation.channel.response_covariance import block_toeplitz

__all__ = ["MotionScore", "judged"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

NOISE = np.logspace(-6, 1.5, 46)
"""Variances of noise that are tried, as parts of the mean power; the error of the covariance integral lies below."""


class MotionScore(NamedTuple):
    """The log likelihood of a motion by one receiver.

    Attributes:
        likelihood: its logarithm.
        gradient: by the free parameters of the motion ``(k,)``.
        information: Fisher information of them ``(k, k)``.
        noise: its variance, as a part of the mean power.
    """

    likelihood: float
    gradient: Array
    information: Array
    noise: float


def judged(receiver_band: ReceiverBand, response: Complex, motion: Array, free: Sequence[int], depth: int) -> MotionScore:
    """Score a motion from ping to ping by the pings of one receiver ``(pings, taps)``.

    Each ping is conditioned on ``depth`` pings before it. Level and variance of noise take their most likely values.
    """
    here, turn = receiver_band.turn @ motion, receiver_band.turn[np.ix_(free, free)]
    blocks = [receiver_band.law.slopes(here, lag, free if lag else ()) for lag in range(depth + 1)]
    taps = blocks[0].shape[1]
    power = float(np.diag(blocks[0][0]).real.mean())
    runs = [
        _PingRuns.of(response, [block[0] for block in blocks[:pings]], sign) for pings, sign in ((depth + 1, 1), (depth, -1))
    ]
    parts = [part for part in runs if part is not None]
    noise = NOISE * power
    energy = sum(part.sign * (part.power[:, None] / (part.size[:, None] + noise)).sum(axis=0) for part in parts)
    there = energy > 0  # what is left of ping given ping may be nothing, where a motion fits not at all
    level = np.where(there, energy, 1.0) / response.size
    log = sum(part.sign * part.count * np.log(part.size[:, None] + noise).sum(axis=0) for part in parts)
    likelihood = np.where(there, -response.size * np.log(level) - log, -np.inf)
    best = int(likelihood.argmax())
    gradient, information = np.zeros(len(free)), np.zeros((len(free),) * 2)
    for part in parts if free and there[best] else []:
        slopes = [
            block_toeplitz([np.zeros((taps, taps), dtype=complex), *(block[1 + k] for block in blocks[1 : part.pings])])
            for k in range(len(free))
        ]
        one, two = part.score(slopes, noise[best], float(level[best]))
        gradient, information = gradient + part.sign * one, information + part.sign * two
    return MotionScore(float(likelihood[best]), turn.T @ gradient, turn.T @ information @ turn, float(NOISE[best]))


@dataclass(frozen=True)
class _PingRuns:
    """Runs of consecutive pings, with the eigenvectors of their covariance.

    Attributes:
        sign: 1, or -1 for the pings that are conditioned on.
        pings: number in a run.
        size: eigenvalues ``(n,)``.
        vectors: eigenvectors ``(n, n)``.
        inside: the runs as coefficients of the eigenvectors ``(n, runs)``.
    """

    sign: int
    pings: int
    size: Array
    vectors: Complex
    inside: Complex

    @classmethod
    def of(cls, response: Complex, blocks: list[Complex], sign: int) -> _PingRuns | None:
        """Collect all runs as long as there are blocks; those that are conditioned on begin with the second ping."""
        first = 0 if sign > 0 else 1
        last = len(response) - len(blocks) + (0 if sign > 0 else -1)
        if not blocks or last < first:
            return None
        runs = np.array([response[k : k + len(blocks)].ravel() for k in range(first, last + 1)]).T
        size, vectors = np.linalg.eigh(block_toeplitz(blocks))
        return cls(sign, len(blocks), np.maximum(size, 0.0), vectors, vectors.conj().T @ runs)

    @property
    def count(self) -> int:
        """Return the number of runs."""
        return int(self.inside.shape[1])

    @property
    def power(self) -> Array:
        """Return the power along each eigenvector, of all runs."""
        return np.asarray((np.abs(self.inside) ** 2).sum(axis=1))

    def score(self, slopes: list[Complex], noise: float, level: float) -> tuple[Array, Array]:
        """Return gradient ``(k,)`` and information ``(k, k)``."""
        solved = self.vectors @ (self.inside / (self.size + noise)[:, None])
        inverse = (self.vectors / (self.size + noise)) @ self.vectors.conj().T
        turned = [inverse @ slope for slope in slopes]
        gradient = [
            np.vdot(solved, slope @ solved).real / level - self.count * np.trace(one).real
            for slope, one in zip(slopes, turned, strict=True)
        ]
        information = [[self.count * float(np.sum(one * two.T).real) for two in turned] for one in turned]
        return np.array(gradient), np.array(information)
