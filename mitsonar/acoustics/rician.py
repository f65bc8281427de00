"""What an amplitude tells about an echo in a receiver's noise: the Rice law, exact, by tables of its integrals.

A cell holds |s + n|, s the echo and n circular complex Gaussian noise of power N (Rice 1945, Bell Syst. Tech. J. 24:46).
With q = |s|^2 / N, R = |s + n| / sqrt(N) and the score u of the power |s|^2, u N = (R / sqrt(q)) I1 / I0(2 R sqrt(q)) - 1,
the Fisher information of the power is g(q) / N^2, g(q) = E[(u N)^2]. It is 1 without an echo, and 1 / (2 q) for strong ones,
where the amplitude is Gaussian of variance N / 2.

Noise that neighbouring cells share correlates their scores. Hermite polynomials of the noise, turned by the phase of the
echo, are orthogonal: those of n, |n|^2 and n^2 hold nearly all of a score.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

__all__ = ["ScoreShares", "rician_information", "score_shares"]

NODES = 80
"""Nodes of the Gauss-Hermite integral along each axis of the complex plane."""

DECADES = (-5.0, 5.0)
"""Ends of the tables, as powers of ten of q. Beyond them the limits hold within 1e-5."""

A_DECADE = 16
"""Entries of a decade."""


class ScoreShares(NamedTuple):
    """Roots of the parts of a score's variance, with their signs; their squares add to 1 or less.

    Attributes:
        linear: of Re n, in phase with the echo ``(...)``.
        power: of |n|^2 - 1 ``(...)``.
        double: of Re n^2 ``(...)``.
    """

    linear: NDArray[np.float64]
    power: NDArray[np.float64]
    double: NDArray[np.float64]


def rician_information(power: ArrayLike, noise: ArrayLike) -> NDArray[np.float64]:
    """Compute the Fisher information of an amplitude about the power of its echo ``(...)``, in 1 / power^2.

    Args:
        power: of the echo, 0 or more ``(...)``.
        noise: mean power of the noise, above 0 ``(...)``.
    """
    noise = np.asarray(noise, dtype=float)
    q = np.asarray(power, dtype=float) / noise
    least, most = (10.0**end for end in DECADES)
    table = _tables()
    found = np.exp(np.interp(np.log(np.clip(q, least, most)), table.log_q, table.log_information))
    return np.asarray(found * np.minimum(1, most / np.maximum(q, most)) / noise**2, dtype=np.float64)


def score_shares(power: ArrayLike, noise: ArrayLike) -> ScoreShares:
    """Compute what the score of an amplitude consists of; the arguments are those of :func:`rician_information`."""
    least, most = (10.0**end for end in DECADES)
    q = np.clip(np.asarray(power, dtype=float) / np.asarray(noise, dtype=float), least, most)
    table = _tables()
    return ScoreShares(*(np.interp(np.log(q), table.log_q, values) for values in table.shares))


class _Tables(NamedTuple):
    """Integrals by the logarithm of q: information, and the shares."""

    log_q: NDArray[np.float64]
    log_information: NDArray[np.float64]
    shares: ScoreShares


@lru_cache(maxsize=1)
def _tables() -> _Tables:
    """Integrate score and polynomials over the noise."""
    q = np.logspace(*DECADES, round((DECADES[1] - DECADES[0]) * A_DECADE) + 1)
    node, weight = np.polynomial.hermite.hermgauss(NODES)
    x, y = np.meshgrid(node, node, indexing="ij")
    weights = np.outer(weight, weight) / np.pi
    amplitude = np.sqrt(q)[:, None, None]
    radius = np.hypot(amplitude + x, y)
    z = 2 * radius * amplitude
    score = radius / amplitude * special.i1e(z) / special.i0e(z) - 1
    parts = (np.sqrt(2) * x, x * x + y * y - 1, x * x - y * y)  # each of variance 1
    information = np.einsum("qij,ij->q", score * score, weights)
    shares = (np.einsum("qij,ij->q", score, weights * part) / np.sqrt(information) for part in parts)
    return _Tables(np.log(q), np.log(information), ScoreShares(*shares))
