"""Model the statistics of speckle intensity, and tabulate the amplitudes of random patches.

Many scatterers in a resolution cell form a complex Gaussian field with exponential intensity. Patches of unequal strength
give the K distribution (Jakeman and Pusey 1976, IEEE Trans. AP-24:806): the product of a Gamma and an exponential variable.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

__all__ = [
    "BLENDED_VARIANCE",
    "ScoreComponents",
    "contrast",
    "intensity_tail",
    "patch_amplitudes",
    "rician_information",
    "score_components",
]


ENTRIES = 4096
"""Number of entries in the table of patch amplitudes."""

BLENDED_VARIANCE = 4 / 9
"""Share of the variance of the patch power that remains after bilinear interpolation: two thirds along each axis."""


def contrast(nu: float | None) -> float:
    """Return the standard deviation of the intensity divided by its mean.

    Args:
        nu: shape parameter of the K distribution; None: exponential distribution.
    """
    return 1.0 if nu is None else math.sqrt(1 + 2 / nu)


def intensity_tail(intensity: ArrayLike, nu: float | None) -> NDArray[np.float64]:
    """Return the probability that an intensity of mean 1 exceeds a threshold ``(...)``.

    Args:
        intensity: threshold, 0 or more ``(...)``.
        nu: shape parameter of the K distribution; None: exponential distribution.
    """
    x = np.asarray(intensity, dtype=float)
    if nu is None:
        return np.asarray(np.exp(-x), dtype=np.float64)
    least = max(1e-5, (nu - 1) / 100)  # below it, the tail is 1 within 0.3 % and the Bessel function overflows
    z = np.maximum(2 * np.sqrt(nu * x), least)
    return np.asarray(2 * (z / 2) ** nu * special.kv(nu, z) / special.gamma(nu), dtype=np.float64)


def patch_amplitudes(nu: float | None) -> NDArray[np.float32]:
    """Return a lookup table ``(ENTRIES,)`` from a uniform random number to a patch amplitude; ones ``(1,)`` without ``nu``.

    The table contains the square root of a Gamma variable with shape parameter ``nu`` and mean 1, at the midpoints of
    ENTRIES intervals of equal probability. The coherent model uses the shape parameter :data:`BLENDED` times ``nu``, because
    it interpolates between patches.
    """
    if nu is None:
        return np.ones(1, np.float32)
    amplitude = np.sqrt(special.gammaincinv(nu, (np.arange(ENTRIES) + 0.5) / ENTRIES) / nu)
    return np.asarray(amplitude / np.sqrt(np.mean(amplitude**2)), dtype=np.float32)


# ---------------- Fisher information of Rician amplitudes
# A cell holds |s + n|, where s is the echo and n is circular complex Gaussian noise of power N (Rice 1945, Bell Syst. Tech.
# J. 24:46). Let q = |s|^2 / N, R = |s + n| / sqrt(N), and u be the score of the power |s|^2, so that u N = (R / sqrt(q)) I1
# / I0(2 R sqrt(q)) - 1. The Fisher information of the power is g(q) / N^2 with g(q) = E[(u N)^2]. It is 1 without an echo,
# and 1 / (2 q) for strong echoes, whose amplitude is Gaussian of variance N / 2. The integrals are tabulated.
#
# Noise shared by neighbouring cells correlates their scores. Hermite polynomials of the noise, rotated by the phase of the
# echo, are orthogonal. Those of n, |n|^2 and n^2 account for nearly all of a score.


NODES = 80
"""Number of nodes of the Gauss-Hermite quadrature along each axis of the complex plane."""

DECADES = (-5.0, 5.0)
"""Limits of the tables, as decimal logarithms of q. Beyond them the asymptotic limits hold within 1e-5."""

ENTRIES_PER_DECADE = 16
"""Number of table entries per decade of q."""


class ScoreComponents(NamedTuple):
    """Decomposition of a score: signed square roots of the shares of its variance. Their squares sum to at most 1.

    Attributes:
        linear: share of Re n, in phase with the echo ``(...)``.
        power: share of |n|^2 - 1 ``(...)``.
        double: share of Re n^2 ``(...)``.
    """

    linear: NDArray[np.float64]
    power: NDArray[np.float64]
    double: NDArray[np.float64]


def rician_information(power: ArrayLike, noise: ArrayLike) -> NDArray[np.float64]:
    """Compute the Fisher information that an amplitude carries about the power of its echo ``(...)``, in 1 / power^2.

    Args:
        power: power of the echo, 0 or more ``(...)``.
        noise: mean power of the noise, above 0 ``(...)``.
    """
    noise = np.asarray(noise, dtype=float)
    q = np.asarray(power, dtype=float) / noise
    least, most = (10.0**end for end in DECADES)
    table = _tables()
    information = np.exp(np.interp(np.log(np.clip(q, least, most)), table.log_q, table.log_information))
    return np.asarray(information * np.minimum(1, most / np.maximum(q, most)) / noise**2, dtype=np.float64)


def score_components(power: ArrayLike, noise: ArrayLike) -> ScoreComponents:
    """Decompose the score of an amplitude into polynomials of the noise. Arguments: see :func:`rician_information`."""
    least, most = (10.0**end for end in DECADES)
    q = np.clip(np.asarray(power, dtype=float) / np.asarray(noise, dtype=float), least, most)
    table = _tables()
    return ScoreComponents(*(np.interp(np.log(q), table.log_q, values) for values in table.shares))


class _Tables(NamedTuple):
    """Integrals tabulated over the logarithm of q: the information and the shares."""

    log_q: NDArray[np.float64]
    log_information: NDArray[np.float64]
    shares: ScoreComponents


@lru_cache(maxsize=1)
def _tables() -> _Tables:
    """Integrate the score and the polynomials over the noise."""
    q = np.logspace(*DECADES, round((DECADES[1] - DECADES[0]) * ENTRIES_PER_DECADE) + 1)
    # Quadrature over the complex Gaussian noise n = x + i y of unit power.
    node, weight = np.polynomial.hermite.hermgauss(NODES)
    x, y = np.meshgrid(node, node, indexing="ij")
    weights = np.outer(weight, weight) / np.pi
    amplitude = np.sqrt(q)[:, None, None]
    # The score uses exponentially scaled Bessel functions, which do not overflow.
    radius = np.hypot(amplitude + x, y)
    z = 2 * radius * amplitude
    score = radius / amplitude * special.i1e(z) / special.i0e(z) - 1
    parts = (np.sqrt(2) * x, x * x + y * y - 1, x * x - y * y)  # each of variance 1
    # The information is the variance of the score; each share is its projection on a unit-variance polynomial.
    information = np.einsum("qij,ij->q", score * score, weights)
    shares = (np.einsum("qij,ij->q", score, weights * part) / np.sqrt(information) for part in parts)
    return _Tables(np.log(q), np.log(information), ScoreComponents(*shares))
