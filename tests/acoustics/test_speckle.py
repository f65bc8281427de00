"""The laws of speckle: moments against integrals of the tails."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.acoustics.speckle import contrast, intensity_tail, patch_amplitudes


@pytest.mark.parametrize("nu", [None, 0.5, 1.0, 2.0, 10.0])
def test_moments_of_the_tail(nu: float | None) -> None:
    x = np.linspace(0, 200, 2_000_001)
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
