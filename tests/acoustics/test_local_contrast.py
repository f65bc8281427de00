"""Local contrast: light that moves with the sonar is gone, what stands on the ground stays, and noise sets the smoothing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from mitsonar.acoustics.levels import SMOOTHINGS, LocalContrast, alike, fitted_contrast

BINS, BEAMS = 256, 96


def ground(seed: int = 0) -> np.ndarray:
    """Stones [dB], of a few bins and beams."""
    rng = np.random.default_rng(seed)
    rough = ndimage.gaussian_filter(rng.normal(size=(BINS, BEAMS)), (5, 2))
    return np.asarray(6 * rough / rough.std(), dtype=np.float32)


def light() -> np.ndarray:
    """A lit patch and a fall with range [dB], as wide as the picture."""
    bins, beams = np.meshgrid(np.linspace(-1, 1, BINS), np.linspace(-1, 1, BEAMS), indexing="ij")
    return np.asarray(30 * np.exp(-((bins / 0.9) ** 2 + (beams / 1.1) ** 2)) - 15 * bins, dtype=np.float32)


def test_the_picture_of_the_ground_hardly_depends_on_the_light() -> None:
    plain, lit = LocalContrast().apply(np.stack([ground(), ground() + light()]))
    assert np.corrcoef(plain.ravel(), lit.ravel())[0, 1] > 0.85
    assert np.corrcoef(ground().ravel(), (ground() + light()).ravel())[0, 1] < 0.7


def test_two_grounds_in_one_light_are_not_alike() -> None:
    """Levels of other ground correlate by the light alone; that would pull estimates towards no motion."""
    levels = np.stack([ground(1) + light(), ground(2) + light()])
    assert alike(levels) > 0.5
    assert abs(alike(LocalContrast().apply(levels))) < 0.25


def test_values_lie_in_0_to_1_around_a_half() -> None:
    (contrast,) = LocalContrast().apply(np.stack([ground() + light()]))
    assert contrast.dtype == np.float32
    assert 0 <= contrast.min() < 0.3
    assert 0.7 < contrast.max() <= 1
    assert contrast.mean() == pytest.approx(0.5, abs=0.05)


def test_a_constant_picture_stays_even() -> None:
    """Levels of one value must not be blown up to a pattern."""
    (contrast,) = LocalContrast().apply(np.full((1, BINS, BEAMS), -40, np.float32))
    np.testing.assert_allclose(contrast, 0.5, atol=1e-4)


def test_noise_sets_the_smoothing() -> None:
    noise = np.random.default_rng(3).normal(size=(4, BINS, BEAMS)).astype(np.float32)
    still = np.stack([ground() + light()] * 4)
    clean, noisy = (fitted_contrast([still + level * noise]) for level in (0.1, 60))
    assert (clean.bins, clean.beams) == SMOOTHINGS[0]
    assert (noisy.bins, noisy.beams) == SMOOTHINGS[-1]


def test_fewer_than_two_pictures_are_not_alike() -> None:
    assert alike(np.zeros((1, 4, 4), np.float32)) == 0
    assert LocalContrast().apply(np.zeros((0, 4, 4), np.float32)).shape == (0, 4, 4)
