"""Spectra of wind waves: closed forms of Pierson and Moskowitz, the peak of JONSWAP, the dispersion of waves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.worlds.sea import GRAVITY, WaveSpectrum, jonswap, pierson_moskowitz, spreading


@pytest.mark.parametrize("wind", [1.0, 5.0, 15.0])
def test_a_developed_sea_has_the_height_and_peak_of_its_closed_form(wind: float) -> None:
    """m0 = alpha U^4 / (4 beta g^2) and omega_p^4 = 4 beta g^4 / (5 U^4), with the wind U at 19.5 m."""
    spectrum, high = pierson_moskowitz(wind), 1.026 * wind
    assert spectrum.significant_height_m == pytest.approx(4 * math.sqrt(0.0081 / (4 * 0.74)) * high**2 / GRAVITY, rel=1e-6)
    assert spectrum.peak_rad_s == pytest.approx(0.877 * GRAVITY / high, rel=1e-3)
    assert spectrum.peak_wavelength_m == pytest.approx(2 * math.pi * GRAVITY / spectrum.peak_rad_s**2)
    omega = np.linspace(0.5, 2, 3001) * spectrum.peak_rad_s
    assert omega[np.argmax(spectrum.density(omega))] == pytest.approx(spectrum.peak_rad_s, rel=1e-3)


def test_the_variance_of_short_waves_is_that_of_the_integral() -> None:
    """alpha g^2 / (5 omega_p^4) (1 - exp(-5/4 (omega_p / omega)^4)) above omega; the parts add to the whole."""
    spectrum = pierson_moskowitz(5.0)
    whole = 0.0081 * GRAVITY**2 / (5 * spectrum.peak_rad_s**4)
    for length in (0.3, 1.0, 20.0, 60.0):
        omega = math.sqrt(2 * math.pi * GRAVITY / length)
        expected = -whole * math.expm1(-1.25 * (spectrum.peak_rad_s / omega) ** 4)
        assert spectrum.variance(0.0, length) == pytest.approx(expected, rel=1e-5)
        assert spectrum.variance(length) + spectrum.variance(0.0, length) == pytest.approx(whole, rel=1e-6)
    assert spectrum.variance(0.0, 0.3) == pytest.approx(0.0081 / 4 * (0.3 / (2 * math.pi)) ** 2, rel=1e-3)
    assert spectrum.variance(1e6) == 0


def test_jonswap_has_its_peak() -> None:
    """3.3 times Pierson and Moskowitz's density there; its variance that of DNV-RP-C205, 3.5.5.5, to 0.5 %."""
    spectrum = jonswap(10.0, 50e3)
    plain = WaveSpectrum(spectrum.scale, spectrum.peak_rad_s)
    at = np.array([spectrum.peak_rad_s])
    assert spectrum.density(at) == pytest.approx(3.3 * plain.density(at))
    assert spectrum.variance() / plain.variance() == pytest.approx(1 / (1 - 0.287 * math.log(3.3)), rel=5e-3)
    assert spectrum.peak_rad_s == pytest.approx(22 * (GRAVITY**2 / (10.0 * 50e3)) ** (1 / 3), rel=1e-3)
    assert spectrum.scale == pytest.approx(0.076 * (100 / (50e3 * GRAVITY)) ** 0.22)
    far = 10 * at
    assert spectrum.density(far) == pytest.approx(plain.density(far))  # the tail has no peak


def test_a_fetch_that_does_not_fit_is_refused() -> None:
    """At the longest fetch the peak is that of the fully developed sea."""
    longest = 17_000 * 100 / GRAVITY
    assert jonswap(10.0, longest).peak_rad_s == pytest.approx(pierson_moskowitz(10.0).peak_rad_s, rel=1e-3)
    for fetch in (1.001 * longest, 500.0):
        with pytest.raises(MitsonarError, match=r"holds for fetches from 1\.02 to 173 km at a wind of 10 m/s: got"):
            jonswap(10.0, fetch)


@pytest.mark.parametrize("depth", [0.5, 5.0, math.inf])
def test_waves_obey_the_dispersion(depth: float) -> None:
    """omega^2 = g k tanh(k d), its inverse, and its slope by differences."""
    spectrum = pierson_moskowitz(8.0, depth)
    for k in (0.01, 0.3, 2.0, 50.0):
        omega = float(spectrum.frequency(np.array(k)))
        assert omega**2 == pytest.approx(GRAVITY * k * math.tanh(k * depth))
        assert spectrum.wavenumber(omega) == pytest.approx(k, rel=1e-9)
        near = spectrum.frequency(np.array([k * (1 - 1e-4), k * (1 + 1e-4)]))
        assert float(spectrum.group_speed(np.array(k))) == pytest.approx((near[1] - near[0]) / (2e-4 * k), rel=1e-6)
    shallow = spectrum.frequency(np.array(1e-4)) / 1e-4
    assert math.isinf(depth) or shallow == pytest.approx(math.sqrt(GRAVITY * depth), rel=1e-3)


def test_the_variance_over_wavenumbers_is_that_over_frequencies() -> None:
    """Also in shallow water, where both axes differ."""
    for depth in (3.0, math.inf):
        spectrum = pierson_moskowitz(6.0, depth)
        k = np.geomspace(spectrum.wavenumber(0.4 * spectrum.peak_rad_s), 2 * math.pi / 0.5, 20_000)
        assert np.trapezoid(spectrum.density_of_wavenumber(k), k) == pytest.approx(spectrum.variance(0.5), rel=1e-4)


def test_slopes_grow_with_the_logarithm_of_the_shortest_wave() -> None:
    """alpha / 2 ln(k2 / k1) in the tail of k^-3."""
    spectrum = pierson_moskowitz(5.0)
    gained = spectrum.mean_square_slope(0.1) - spectrum.mean_square_slope(0.5)
    assert gained == pytest.approx(0.0081 / 2 * math.log(5), rel=1e-3)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 2.0, 30.0])
def test_directions_share_the_waves(exponent: float) -> None:
    """Their shares add to 1; the mean cosine is s / (s + 1)."""
    angle = np.linspace(-np.pi, np.pi, 20_001)
    share = spreading(angle, exponent)
    assert np.trapezoid(share, angle) == pytest.approx(1, rel=1e-6)
    assert np.trapezoid(share * np.cos(angle), angle) == pytest.approx(exponent / (exponent + 1), abs=1e-6)
