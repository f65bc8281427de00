"""Speckle: the laws of its intensity, and what draws them.

Many scatterers in a resolution cell make a complex Gaussian field, whose intensity is exponential. Patches of unequal
strength make the K law (Jakeman and Pusey 1976, IEEE Trans. AP-24:806): a Gamma variable times an exponential one.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

__all__ = ["BLENDED", "ScoreShares", "contrast", "intensity_tail", "patch_amplitudes", "rician_information", "score_shares"]


ENTRIES = 4096
"""Entries of the table of patch amplitudes."""

BLENDED = 4 / 9
"""What bilinear weights between patches leave of the variance of their power: two thirds along each axis."""


def contrast(nu: float | None) -> float:
    """Return standard deviation over mean of the intensity, of shape ``nu`` of the K law; None: exponential."""
    return 1.0 if nu is None else math.sqrt(1 + 2 / nu)


def intensity_tail(intensity: ArrayLike, nu: float | None) -> NDArray[np.float64]:
    """Return the probability that an intensity of mean 1 exceeds a value, of the same shape.

    Args:
        intensity: 0 and more.
        nu: shape of the K law; None: exponential.
    """
    x = np.asarray(intensity, dtype=float)
    if nu is None:
        return np.asarray(np.exp(-x), dtype=np.float64)
    least = max(1e-5, (nu - 1) / 100)  # below it the tail is 1 within 0.3 %, and Bessel's function overflows
    z = np.maximum(2 * np.sqrt(nu * x), least)
    return np.asarray(2 * (z / 2) ** nu * special.kv(nu, z) / special.gamma(nu), dtype=np.float64)


def patch_amplitudes(nu: float | None) -> NDArray[np.float32]:
    """Return the table that turns a uniform number into the amplitude of a patch ``(ENTRIES,)``, or ``(1,)`` ones.

    It holds the root of a Gamma variable of shape ``nu`` and mean 1 at the middles of ENTRIES equal probabilities. The model
    coherent draws patches of shape :data:`BLENDED` times ``nu``, since it goes evenly from one to the next.
    """
    if nu is None:
        return np.ones(1, np.float32)
    amplitude = np.sqrt(special.gammaincinv(nu, (np.arange(ENTRIES) + 0.5) / ENTRIES) / nu)
    return np.asarray(amplitude / np.sqrt(np.mean(amplitude**2)), dtype=np.float32)


# ---------------- What an amplitude tells about an echo in a receiver's noise: the Rice law, exact, by tables of its
# integrals
# A cell holds |s + n|, s the echo and n circular complex Gaussian noise of power N (Rice 1945, Bell Syst. Tech. J.
# 24:46). With q = |s|^2 / N, R = |s + n| / sqrt(N) and the score u of the power |s|^2, u N = (R / sqrt(q)) I1 / I0(2 R
# sqrt(q)) - 1, the Fisher information of the power is g(q) / N^2, g(q) = E[(u N)^2]. It is 1 without an echo, and 1 /
# (2 q) for strong ones, where the amplitude is Gaussian of variance N / 2.
#
# Noise that neighbouring cells share correlates their scores. Hermite polynomials of the noise, turned by the phase of the
# echo, are orthogonal: those of n, |n|^2 and n^2 hold nearly all of a score.


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
