"""Speckle: the laws of its intensity, and what draws them.

Many scatterers in a resolution cell make a complex Gaussian field, whose intensity is exponential. Patches of unequal
strength make the K law (Jakeman and Pusey 1976, IEEE Trans. AP-24:806): a Gamma variable times an exponential one.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

__all__ = ["BLENDED", "contrast", "intensity_tail", "patch_amplitudes"]

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
