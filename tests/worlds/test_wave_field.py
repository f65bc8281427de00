"""Realised seas: variance, spectrum, slopes, dispersion, long waves; all against the spectrum they are drawn from."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from helpers import essence
from numpy.typing import NDArray
from scipy import stats

from mitsonar.worlds.sea import GRAVITY, SHORTEST, Sea, WaveSpectrum, jonswap, pierson_moskowitz, wave_heights

STEP = 0.25
SHORT = SHORTEST * STEP


def seas(spectrum: WaveSpectrum, count: int, seeds: int, time_s: float = 0.0, spread: float = 2.0) -> NDArray[np.float64]:
    """Heights of several seeds ``(seeds, count, count)``; the wind blows to +y."""
    return np.array([wave_heights(Sea(spectrum, 0.0, spread), count, STEP, seed, time_s) for seed in range(seeds)])


SPECTRA = [jonswap(6.0, 10e3), pierson_moskowitz(4.0), pierson_moskowitz(4.0, 1.5)]


@pytest.mark.parametrize("spectrum", essence(SPECTRA, SPECTRA[0]))
def test_heights_have_the_variance_of_the_spectrum(spectrum: WaveSpectrum) -> None:
    """Over 30 seeds within three standard errors, which are below 6 %."""
    each = (seas(spectrum, 121, 30) ** 2).mean(axis=(1, 2))
    error = each.std() / math.sqrt(len(each))
    assert error < 0.06 * each.mean()
    assert abs(each.mean() - spectrum.variance(SHORT)) < 3 * error


@pytest.mark.thorough
def test_a_small_patch_rides_on_long_waves() -> None:
    """On 4 m, where the peak is 88 m long, heights are Gaussian of the whole variance, and slopes those of the spectrum."""
    spectrum = pierson_moskowitz(10.0)
    result = seas(spectrum, 17, 150)
    middle = result[:, 8, 8]
    assert stats.kstest(middle / math.sqrt(spectrum.variance(SHORT)), stats.norm.cdf).pvalue > 1e-5
    assert middle.std() == pytest.approx(math.sqrt(spectrum.variance(SHORT)), rel=0.18)
    assert result.std(axis=(1, 2)).mean() < 0.25 * middle.std()


def test_slopes_are_those_of_the_spectrum() -> None:
    """Differences over two steps lose (sin(k d) / k d)^2: 3 % on the whole here. Downwind slopes are larger."""
    spectrum = pierson_moskowitz(4.0)
    result = seas(spectrum, 121, 20)
    along, across = np.diff(result, axis=1) / STEP, np.diff(result, axis=2) / STEP
    total = (along**2).mean() + (across**2).mean()
    assert 0.93 < total / spectrum.mean_square_slope(SHORT) < 1.01
    assert (along**2).mean() > 1.2 * (across**2).mean()
    even = seas(spectrum, 121, 20, spread=0.0)
    assert (np.diff(even, axis=1) ** 2).mean() == pytest.approx((np.diff(even, axis=2) ** 2).mean(), rel=0.05)


def test_the_periodogram_falls_with_the_fourth_power() -> None:
    """Level of the spectrum over wave vectors within 5 %, and its slope within 0.05, from 1.5 to 5 rad/m."""
    spectrum, count = pierson_moskowitz(4.0), 160
    window = np.outer(*[np.hanning(count)] * 2)
    power = (np.abs(np.fft.fft2(seas(spectrum, count, 12, spread=0.0) * window)) ** 2).mean(axis=0)
    power *= (STEP / (2 * np.pi)) ** 2 / (window**2).sum()
    axis = 2 * np.pi * np.fft.fftfreq(count, STEP)
    k = np.hypot(axis[:, None], axis)
    edges = np.geomspace(1.5, 5.0, 9)
    rings = [(k >= low) & (k < high) for low, high in itertools.pairwise(edges)]
    level = np.array([power[ring].mean() for ring in rings])
    expected = np.array([(spectrum.density_of_wavenumber(k[ring]) / (2 * np.pi * k[ring])).mean() for ring in rings])
    assert level == pytest.approx(expected, rel=0.12)
    assert (level / expected).mean() == pytest.approx(1, abs=0.05)
    slope, closed = (np.polyfit(np.log(edges[:-1]), np.log(values), 1)[0] for values in (level, expected))
    assert slope == pytest.approx(closed, abs=0.05)
    assert slope == pytest.approx(-4, abs=0.15)  # the foot of the peak is in the first rings
    assert power[k > 2 * np.pi / SHORT + 1].max() < 1e-3 * level[-1]  # shorter waves are not there


@pytest.mark.parametrize("depth", [math.inf, 1.0])
def test_waves_travel_with_the_wind_at_their_speed(depth: float) -> None:
    """The phase of each wave vector falls by omega t, omega^2 = g k tanh(k d), within 3 %."""
    spectrum, count, time = pierson_moskowitz(4.0, depth), 160, 0.15
    window = np.outer(*[np.hanning(count)] * 2)
    before, after = (np.fft.fft2(seas(spectrum, count, 8, at, spread=30.0) * window) for at in (2.0, 2.0 + time))
    cross = (after * before.conj()).sum(axis=0)
    k = 2 * np.pi * np.fft.fftfreq(count, STEP)
    for row in (8, 14, 24, 32):
        expected = math.sqrt(GRAVITY * k[row] * math.tanh(k[row] * depth))
        assert -np.angle(cross[row, 0]) / time == pytest.approx(expected, rel=0.03)


@pytest.mark.thorough
def test_two_times_of_a_sea_are_correlated_as_its_spectrum_says() -> None:
    """The mean product is the integral of S cos(omega t); the same time has the same heights."""
    spectrum, count, seeds = pierson_moskowitz(3.0), 121, 24
    first = seas(spectrum, count, seeds)
    assert np.array_equal(first[3], seas(spectrum, count, 4)[3])
    omega = np.linspace(0.4 * spectrum.peak_rad_s, float(spectrum.frequency(np.array(2 * np.pi / SHORT))), 4000)
    for time in (0.4, 1.1, 2.3):
        product = (first * seas(spectrum, count, seeds, time)).mean(axis=(1, 2))
        expected = np.trapezoid(spectrum.density(omega) * np.cos(omega * time), omega)
        assert abs(product.mean() - expected) < 3.5 * product.std() / math.sqrt(seeds)
        assert abs(product.mean() - expected) < 0.12 * spectrum.variance(SHORT)
