"""Backscatter of a sea floor that is a rough, absorbing fluid with scatterers within: roughness and volume added.

Roughness is the small-slope approximation of first order for a power-law spectrum. It becomes the Kirchhoff approximation
near normal incidence and first-order perturbation at low grazing angles, without a rule to join them (Jackson and
Richardson, High-Frequency Seafloor Acoustics, 2007). APL-UW TR 9407 (1994) joins the same two limits by an interpolation,
averages the second over the slopes of the large roughness, and has a law of its own for rock; these three parts are not
here. The volume term is that of TR 9407 and of Mourad and Jackson (1989).

Not modelled: shear waves (rock), layers, gas, scattering more than once. Slopes must be small: far above 100 kHz rough
floors scatter more at low angles than at steep ones, which is a fault of the approximation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import hankel1

__all__ = ["Sediment", "rough_fluid_sigma", "roughness_sigma", "structure_integral", "volume_sigma"]

Angles = NDArray[np.float64]

LOWEST_COSINE = 1e-5
"""Cosine that stands for normal incidence, where the formula is 0 / 0."""


class Sediment(NamedTuple):
    """A rough fluid below water.

    Attributes:
        density_ratio: rho, density over that of the water.
        sound_speed_ratio: nu, speed of sound over that of the water.
        loss: delta, imaginary over real part of the wavenumber.
        volume: sigma_2, volume scattering cross-section per unit volume and steradian over the attenuation in dB per length.
        spectral_exponent: gamma of the spectrum of heights ``W(K) = w K^-gamma``, 2..4. The integral of W over the plane of
            wave vectors is the mean square height.
        spectral_strength: w [m^(4 - gamma)].
    """

    density_ratio: float
    sound_speed_ratio: float
    loss: float
    volume: float
    spectral_exponent: float
    spectral_strength: float


def rough_fluid_sigma(sediment: Sediment, grazing_rad: Angles, wavenumber: float) -> Angles:
    """Compute the scattering cross-section per unit area and steradian ``(n,)`` [1/sr].

    Args:
        sediment: the sea floor.
        grazing_rad: angle between ray and surface, 0..pi/2 ``(n,)``.
        wavenumber: 2 pi f / c of the water [rad/m].
    """
    return roughness_sigma(sediment, grazing_rad, wavenumber) + volume_sigma(sediment, grazing_rad)


def roughness_sigma(sediment: Sediment, grazing_rad: Angles, wavenumber: float) -> Angles:
    """Compute the part of the roughness, ``sin^2 |Y|^2 I(q) / (8 pi cos^2)`` ``(n,)`` [1/sr].

    Y is the factor of first-order perturbation for two fluids, I the integral of :func:`structure_integral`, and
    ``q = 2 C^2 k^2 sin^2 (2 k cos)^(-2 alpha)`` with ``alpha = gamma / 2 - 1`` and the structure constant C^2.

    Args:
        sediment: the sea floor.
        grazing_rad: angle between ray and surface, 0..pi/2 ``(n,)``.
        wavenumber: of the water [rad/m].
    """
    sine, cosine = np.sin(grazing_rad), np.maximum(np.cos(grazing_rad), LOWEST_COSINE)
    alpha = sediment.spectral_exponent / 2 - 1
    below = _sine_below(sediment, cosine)
    rho, kappa = sediment.density_ratio, _relative_wavenumber(sediment)
    factor = ((rho - 1) ** 2 * cosine**2 + rho**2 - kappa**2) / (rho * sine + below) ** 2
    q = 2 * structure_constant(sediment) * (wavenumber * sine) ** 2 * (2 * wavenumber * cosine) ** (-2 * alpha)
    return np.asarray((sine * np.abs(factor) / cosine) ** 2 * structure_integral(q, alpha) / (8 * math.pi))


def structure_constant(sediment: Sediment) -> float:
    """Return C^2 [m^(2 - 2 alpha)]: heights a distance r apart differ by ``C^2 r^(2 alpha)`` in the mean square."""
    alpha = sediment.spectral_exponent / 2 - 1
    gammas = math.gamma(2 - alpha) / (alpha * (1 - alpha) * math.gamma(1 + alpha))
    return 2 * math.pi * sediment.spectral_strength * 2 ** (-2 * alpha) * gammas


def structure_integral(q: Angles, alpha: float) -> Angles:
    """Compute ``I(q)``, the integral of ``exp(-q u^(2 alpha)) J0(u) u`` over u from 0, ``(n,)``.

    J0 is the real part of a Hankel function. On a ray turned into the upper half of the complex plane both factors decay; a
    sum over even steps of log u then converges exponentially. Below q = 1 the integral of ``H0(u) u``, which is zero, is
    taken away first.

    Args:
        q: 0 or more ``(n,)``.
        alpha: 0..1, both excluded.
    """
    turn = min(math.pi / 4, math.pi / (8 * alpha))
    found = np.zeros_like(q)
    for k, one in enumerate(q):
        if one > 0:
            begin, end = -19.0, math.log(40 / math.sin(turn))  # of log u: beyond, nothing is left
            if one >= 1:
                begin -= math.log(one) / (2 * alpha)
                end = min(end, math.log(40 / (one * math.cos(2 * alpha * turn))) / (2 * alpha))
            t = np.exp(np.arange(begin, end, 0.04))
            u = t * np.exp(1j * turn)
            exponent = -one * t ** (2 * alpha) * np.exp(2j * alpha * turn)
            decay = np.exp(exponent) if one >= 1 else np.expm1(exponent)
            found[k] = 0.04 * np.sum(decay * hankel1(0, u) * u * u).real
    return found


def volume_sigma(sediment: Sediment, grazing_rad: Angles) -> Angles:
    """Compute the part of the volume ``(n,)`` [1/sr]: ``5 delta sigma_2 |1 - V^2|^2 sin^2 / (nu ln 10 |P|^2 Im P)``.

    V is the reflection coefficient, P the sine of the grazing angle below the surface times its relative wavenumber.

    Args:
        sediment: the sea floor.
        grazing_rad: angle between ray and surface, 0..pi/2 ``(n,)``.
    """
    sine, below = np.sin(grazing_rad), _sine_below(sediment, np.cos(grazing_rad))
    through = np.abs(1 - reflection(sediment, grazing_rad) ** 2) ** 2 * sine**2
    scale = 5 * sediment.loss * sediment.volume / (sediment.sound_speed_ratio * math.log(10))
    return np.asarray(scale * through / (np.abs(below) ** 2 * below.imag))


def reflection(sediment: Sediment, grazing_rad: Angles) -> NDArray[np.complex128]:
    """Compute the reflection coefficient of the flat surface, of pressures ``(n,)``."""
    ratio = sediment.density_ratio * np.sin(grazing_rad) / _sine_below(sediment, np.cos(grazing_rad))
    return np.asarray((ratio - 1) / (ratio + 1))


def _relative_wavenumber(sediment: Sediment) -> complex:
    """Return kappa, the wavenumber below over that of the water."""
    return (1 + 1j * sediment.loss) / sediment.sound_speed_ratio


def _sine_below(sediment: Sediment, cosine: Angles) -> NDArray[np.complex128]:
    """Return P, the vertical wavenumber below over the wavenumber of the water ``(n,)``."""
    return np.asarray(np.sqrt(_relative_wavenumber(sediment) ** 2 - cosine**2))
