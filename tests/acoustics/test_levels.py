"""Levels: the formula of each model in plain NumPy, and a bound that no echo exceeds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from mitsonar.acoustics.levels import (
    SMOOTHINGS,
    LocalContrast,
    coded,
    decoded,
    fitted_contrast,
    frame_correlation,
    largest_level,
    level,
)
from mitsonar.instruments.sonar import Coding, Sonar
from mitsonar.records.echoes import CHANNELS, Echoes


def echoes(sonar: Sonar, count: int = 2000) -> Echoes:
    """Random echoes within the window, some with the largest possible values."""
    rng = np.random.default_rng(0)
    values = {name: rng.random(count) for name in CHANNELS}
    values["range_m"] = rng.uniform(sonar.range_min, sonar.range_max, count)
    values["solid_angle_sr"] = 1e-5 * rng.random(count)
    values["range_m"][:2] = sonar.range_min, sonar.range_max
    values["reflectivity"][:2] = values["cosine"][:2] = 1
    values["solid_angle_sr"][:2] = 1e-5
    return Echoes(**values)


def test_thesis_is_reflectivity_times_cosine() -> None:
    """Almanza-Medina, eq. 2.2: C L, whatever range and solid angle."""
    sonar = Sonar(model="thesis", gain_exponent=3)
    got = echoes(sonar)
    np.testing.assert_array_equal(level(got, sonar, np.where), got.reflectivity * got.cosine)
    assert largest_level(sonar, 1e-5) == 1


@pytest.mark.parametrize("exponent", range(5))
def test_physical_is_spread_by_the_square_of_the_range(exponent: int) -> None:
    """C cos(theta) dOmega / R^2 times R^g."""
    sonar = Sonar(gain_exponent=exponent)
    got = echoes(sonar)
    expected = got.reflectivity * got.cosine * got.solid_angle_sr * got.range_m ** (exponent - 2.0)
    np.testing.assert_allclose(level(got, sonar, np.where), expected, rtol=1e-14)


@pytest.mark.parametrize("window", [(0.0, 2.0), (0.3, 0.9), (3.2, 5.6), (2.0, 100.0)])
@pytest.mark.parametrize("exponent", range(5))
def test_no_echo_exceeds_the_bound(exponent: int, window: tuple[float, float]) -> None:
    """Overflow is impossible because of it, also by the tails of footprints whose middle lies far outside the window;
    within the window it is not far from what can be."""
    sonar = Sonar(gain_exponent=exponent, range_min=window[0], range_max=window[1])
    bound = largest_level(sonar, 1e-5)
    result = echoes(sonar)
    assert bound / 17 <= level(result, sonar, np.where).max() <= bound * (1 + 1e-12)
    for factor in (0.0, 1e-3, 2.0, 4.0, 1e3):
        result.range_m[:] = factor * window[1]
        assert level(result, sonar, np.where).max() <= bound * (1 + 1e-12)


def test_far_beyond_the_window_the_law_is_held() -> None:
    """Only a footprint's tail reaches in from there: from four times the window's end on the gain stays."""
    sonar = Sonar(gain_exponent=4)
    got = echoes(sonar, 3)
    got.reflectivity[:] = got.cosine[:] = got.solid_angle_sr[:] = 1
    got.range_m[:] = 4 * 5.6, 5 * 5.6, 1e6
    np.testing.assert_allclose(level(got, sonar, np.where), (4 * 5.6) ** 2, rtol=1e-12)


def test_nearer_than_one_bin_the_law_is_held() -> None:
    sonar = Sonar(range_min=0, range_max=5.12, range_bins=512)  # bins of 1 cm
    got = echoes(sonar, 3)
    got.reflectivity[:] = got.cosine[:] = got.solid_angle_sr[:] = 1
    got.range_m[:] = 0, 0.005, 0.01
    np.testing.assert_allclose(level(got, sonar, np.where), 1e4, rtol=1e-12)


# ---------------------------------------------------------------- codings of levels: there and back, ends, and what a step


@pytest.mark.parametrize("coding", ["linear", "dB", "gamma"])
def test_there_and_back(coding: Coding) -> None:
    sonar = Sonar(pattern="two_way", coding=coding, coding_db=60.0)
    level = np.array([1.0, 0.5, 1e-3, 2e-6], np.float32)
    np.testing.assert_allclose(decoded(coded(level, sonar), sonar), level, rtol=2e-5)
    assert coded(np.array([7.0], np.float32), sonar) == 1


def test_ends_of_decibels() -> None:
    sonar = Sonar(pattern="two_way", coding="dB", coding_db=60.0)
    np.testing.assert_allclose(coded(np.array([1, 1e-3, 1e-6, 1e-9, 0], np.float32), sonar), [1, 0.5, 0, 0, 0], atol=1e-6)
    assert (coded(np.array([0, 1e-12], np.float32), sonar) >= 0).all()


def test_a_count_of_an_aris() -> None:
    values = decoded(np.array([200, 201]) / 255, Sonar(pattern="two_way", coding="dB", coding_db=80.0))
    assert 10 * np.log10(values[1] / values[0]) == pytest.approx(80 / 255)


def test_gamma_flattens_rayleigh_amplitudes() -> None:
    """The counts of an Oculus vary by 0.281 of their mean: the Weibull law of the root of a Rayleigh amplitude."""
    intensity = np.random.default_rng(1).exponential(0.01, 400_000).astype(np.float32)
    counts = coded(intensity, Sonar(pattern="two_way", coding="gamma", coding_gamma=0.5))
    assert counts.std() / counts.mean() == pytest.approx(0.2805, abs=2e-3)


# ---------------------------------------------------------------- local contrast: light that moves with the sonar is gone,

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
    assert frame_correlation(levels) > 0.5
    assert abs(frame_correlation(LocalContrast().apply(levels))) < 0.25


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
    assert frame_correlation(np.zeros((1, 4, 4), np.float32)) == 0
    assert LocalContrast().apply(np.zeros((0, 4, 4), np.float32)).shape == (0, 4, 4)
