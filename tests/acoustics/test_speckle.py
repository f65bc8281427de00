"""The laws of speckle: moments against integrals of the tails."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, special

from mitsonar.acoustics.speckle import contrast, intensity_tail, patch_amplitudes, rician_information, score_components


@pytest.mark.parametrize("nu", [None, 0.5, 1.0, 2.0, 10.0])
def test_moments_of_the_tail(nu: float | None) -> None:
    x = np.linspace(0, 200, 200_001)
    tail = intensity_tail(x, nu)
    mean, square = np.trapezoid(tail, x), np.trapezoid(2 * x * tail, x)
    assert mean == pytest.approx(1, abs=2e-3)
    assert np.sqrt(square - mean**2) == pytest.approx(contrast(nu), rel=5e-3)


@pytest.mark.parametrize("nu", [0.5, 1.0, 4.0])
def test_patches_make_the_k_law(nu: float) -> None:
    rng = np.random.default_rng(7)
    table = patch_amplitudes(nu)
    patch = table[rng.integers(len(table), size=400_000)].astype(float)
    intensity = np.sort(patch**2 * rng.exponential(size=len(patch)))
    distance = np.abs(intensity_tail(intensity, nu) - np.linspace(1, 0, len(patch))).max()
    assert distance < 1.95 / np.sqrt(len(patch))  # Kolmogorov and Smirnov at 0.1 %


def test_no_patches() -> None:
    np.testing.assert_array_equal(patch_amplitudes(None), [1])


# ---------------------------------------------------------------- the Rice law: its information against the integral over i

Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


def score(amplitude: Array, power: float, noise: float) -> Array:
    """Derivative of the logarithm of the density of an amplitude by the power of the echo."""
    z = 2 * amplitude * np.sqrt(power) / noise
    return np.asarray((amplitude / np.sqrt(power) * special.i1e(z) / special.i0e(z) - 1) / noise)


@pytest.mark.parametrize("q", [1e-3, 0.07, 0.9, 5.0, 240.0])
@pytest.mark.parametrize("noise", [1.0, 3e-4])
def test_information_is_the_integral_of_the_squared_score(q: float, noise: float) -> None:
    power = q * noise

    def integrand(x: float) -> float:
        amplitude = np.array(x * np.sqrt(noise))
        density = 2 * x * np.exp(-((x - np.sqrt(q)) ** 2)) * special.i0e(2 * x * np.sqrt(q))
        return float(density * score(amplitude, power, noise) ** 2)

    expected = integrate.quad(integrand, max(0, np.sqrt(q) - 9), np.sqrt(q) + 9, epsrel=1e-9, limit=400)[0]
    np.testing.assert_allclose(rician_information(power, noise), expected, rtol=2e-3)


def test_limits_of_weak_and_strong_echoes() -> None:
    """Of the amplitude A 2 / N where it is Gaussian, and 4 A^2 / N^2 in noise: that of the logarithm falls as SNR^2."""
    noise = 0.25
    for power, by_amplitude in ((1e5, 2 / noise), (1e9, 2 / noise), (1e-7, 4e-7 / noise**2)):
        np.testing.assert_allclose(4 * power * rician_information(power, noise), by_amplitude, rtol=2e-4)
    assert rician_information(0.0, noise) == pytest.approx(1 / noise**2, rel=2e-4)


@pytest.mark.parametrize("q", [0.05, 1.0, 20.0])
def test_scores_of_cells_that_share_noise(q: float) -> None:
    """Two cells, echoes turned by 0.7 rad, noise of correlation 0.6: covariance of a million drawn scores."""
    rng, turned, common = np.random.default_rng(5), 0.7, 0.6
    first, another = (rng.normal(size=(2, 1_000_000, 2)) @ [1, 1j]) / np.sqrt(2)
    second = common * first + np.sqrt(1 - common**2) * another
    echoes = np.sqrt(q), np.sqrt(q) * np.exp(1j * turned)
    scores = [score(np.abs(echo + noise), q, 1.0) for echo, noise in zip(echoes, (first, second), strict=True)]
    result = float(np.mean(scores[0] * scores[1]) / rician_information(q, 1.0))
    part = score_components(q, 1.0)
    expected = part.linear**2 * common * np.cos(turned) + (part.power**2 + part.double**2 * np.cos(2 * turned)) * common**2
    assert result == pytest.approx(float(expected), abs=0.01)
    assert 0.95 < float(part.linear**2 + part.power**2 + part.double**2) <= 1 + 1e-6
