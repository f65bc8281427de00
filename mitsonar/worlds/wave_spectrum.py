"""Spectra of wind waves: Pierson and Moskowitz's of a fully developed sea, JONSWAP's of a limited fetch.

    S(omega) = alpha g^2 omega^-5 exp(-5/4 (omega_p / omega)^4) gamma^r,  r = exp(-(omega - omega_p)^2 / (2 s^2 omega_p^2))

with s = 0.07 below the peak and 0.09 above it. A Pierson-Moskowitz spectrum has gamma = 1 (Pierson and Moskowitz, J.
Geophys. Res. 69 (1964), 5181-5190; Hasselmann et al., Measurements of wind-wave growth and swell decay during the Joint
North Sea Wave Project, Deutsche Hydrogr. Z. A8 (12), 1973). Waves obey omega^2 = g k tanh(k d).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError

__all__ = ["GRAVITY", "WaveSpectrum", "jonswap", "pierson_moskowitz", "spreading"]

GRAVITY = 9.81
"""[m/s^2]"""

TO_19_5_M = 1.026
"""Wind at 19.5 m, of Pierson and Moskowitz, over wind at 10 m (Stewart, Introduction to Physical Oceanography, 16.4)."""

LOWEST = 0.3
"""Waves of less than this part of the peak's frequency have no energy: exp(-154)."""

HIGHEST = 1000.0
"""Frequency over the peak's beyond which waves count no more: 1e-12 of the variance."""

REACH = (100.0, 17_000.0)
"""Fetch times g over the wind's square, least and largest: there the peak is that of a fully developed sea."""

STEPS = 4000
"""Steps of a sum over a factor of ten in frequency."""


@dataclass(frozen=True)
class WaveSpectrum:
    """A spectrum of wave heights.

    Attributes:
        scale: Phillips' constant alpha.
        peak_rad_s: frequency of the peak omega_p [rad/s].
        enhancement: gamma of the peak, 1 or more.
        depth_m: of the water, for the dispersion alone [m]; infinite by default.
    """

    scale: float
    peak_rad_s: float
    enhancement: float = 1.0
    depth_m: float = math.inf

    def density(self, omega: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the density S of variance over frequency ``(...)`` [m^2 s].

        Args:
            omega: frequencies above 0 ``(...)`` [rad/s].
        """
        over = omega / self.peak_rad_s
        width = np.where(over <= 1, 0.07, 0.09)
        peak = self.enhancement ** np.exp(-((over - 1) ** 2) / (2 * width**2))
        return np.asarray(self.scale * GRAVITY**2 * omega**-5.0 * np.exp(-1.25 * over**-4.0) * peak)

    def frequency(self, wavenumber: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the frequency of waves ``(...)`` [rad/s], given wavenumbers ``(...)`` [rad/m]."""
        return np.asarray(np.sqrt(GRAVITY * wavenumber * np.tanh(wavenumber * self.depth_m)))

    def wavenumber(self, omega: float) -> float:
        """Return the wavenumber of a frequency [rad/m], by Newton's method on the dispersion."""
        k = omega**2 / GRAVITY
        if math.isinf(self.depth_m):
            return k
        k = max(k, omega / math.sqrt(GRAVITY * self.depth_m))  # from above: the method then falls to the root
        for _ in range(50):
            slope, found = self.group_speed(np.array(k)), self.frequency(np.array(k))
            k -= float((found - omega) / slope)
        return k

    def group_speed(self, wavenumber: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return d omega / d k ``(...)`` [m/s]."""
        twice = np.minimum(2 * wavenumber * self.depth_m, 100.0)  # beyond it the water is deep
        return np.asarray(self.frequency(wavenumber) / (2 * wavenumber) * (1 + twice / np.sinh(twice)))

    def density_of_wavenumber(self, wavenumber: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the density of variance over the length of the wave vector ``(...)`` [m^3]."""
        return self.density(self.frequency(wavenumber)) * self.group_speed(wavenumber)

    @property
    def peak_wavelength_m(self) -> float:
        """Return the length of the waves at the peak [m]."""
        return 2 * math.pi / self.wavenumber(self.peak_rad_s)

    @property
    def significant_height_m(self) -> float:
        """Return four times the rms height of all waves [m]."""
        return 4 * math.sqrt(self.variance())

    def variance(self, shortest_m: float = 0.0, longest_m: float = math.inf) -> float:
        """Return the variance of the waves of a range of lengths [m^2]."""
        omega = self._band(shortest_m, longest_m)
        return float(np.trapezoid(self.density(omega) * omega, np.log(omega)))

    def mean_square_slope(self, shortest_m: float) -> float:
        """Return the mean square of the slope of all waves down to a length, both axes together."""
        omega = self._band(shortest_m, math.inf)
        low, high = (self.wavenumber(float(end)) for end in (omega[0], omega[-1]))
        k = np.geomspace(low, high, len(omega))
        return float(np.trapezoid(self.density_of_wavenumber(k) * k**3, np.log(k)))

    def _band(self, shortest_m: float, longest_m: float) -> NDArray[np.float64]:
        """Return frequencies of waves between two lengths, evenly on a log axis."""
        low, high = LOWEST * self.peak_rad_s, HIGHEST * self.peak_rad_s
        if longest_m < math.inf:
            low = max(low, float(self.frequency(np.array(2 * math.pi / longest_m))))
        if shortest_m > 0:
            high = min(high, float(self.frequency(np.array(2 * math.pi / shortest_m))))
        if high <= low:
            return np.array([low, low])
        return np.geomspace(low, high, math.ceil(STEPS * math.log10(high / low)) + 2)


def pierson_moskowitz(wind_m_s: float, depth_m: float = math.inf) -> WaveSpectrum:
    """Return the spectrum of a fully developed sea: alpha 0.0081, beta 0.74.

    Args:
        wind_m_s: speed of the wind 10 m above the sea, above 0 [m/s].
        depth_m: of the water, for the dispersion [m].
    """
    peak = (0.8 * 0.74) ** 0.25 * GRAVITY / (TO_19_5_M * wind_m_s)
    return WaveSpectrum(0.0081, peak, 1.0, depth_m)


def jonswap(wind_m_s: float, fetch_m: float, depth_m: float = math.inf) -> WaveSpectrum:
    """Return the spectrum of a sea that grows with the fetch: gamma 3.3.

    Args:
        wind_m_s: speed of the wind 10 m above the sea, above 0 [m/s].
        fetch_m: way over which the wind blows [m].
        depth_m: of the water, for the dispersion [m].

    Raises:
        MitsonarError: a fetch below what was measured, or at which the peak would lie below that of a fully developed sea.
    """
    least, grown = (reach * wind_m_s**2 / GRAVITY for reach in REACH)
    if not least <= fetch_m <= grown:
        raise MitsonarError(
            f"jonswap holds for fetches from {least / 1000:.3g} to {grown / 1000:.3g} km at a wind of {wind_m_s:g} m/s: got "
            f"{fetch_m / 1000:g} km; change fetch_km, or choose pierson-moskowitz for a fully developed sea"
        )
    reach = GRAVITY * fetch_m / wind_m_s**2
    peak = 2 * math.pi * 3.5 * GRAVITY / wind_m_s * reach ** (-1 / 3)
    return WaveSpectrum(0.076 * reach**-0.22, peak, 3.3, depth_m)


def spreading(angle: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
    """Return the share of the waves by direction, ``cos^2s(angle / 2)`` times what makes its integral 1 ``(...)`` [1/rad].

    It is that of Longuet-Higgins, Cartwright and Smith (Ocean Wave Spectra, 1963), with one s at all frequencies.

    Args:
        angle: from the direction that the wind blows to ``(...)`` [rad].
        exponent: s, 0 or more; 0: all directions alike.
    """
    s = exponent
    log_factor = (2 * s - 1) * math.log(2) - math.log(math.pi) + 2 * math.lgamma(s + 1) - math.lgamma(2 * s + 1)
    return np.asarray(math.exp(log_factor) * np.cos(angle / 2) ** (2 * s))
