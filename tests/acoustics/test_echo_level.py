"""Levels: the formula of each model in plain NumPy, and a bound that no echo exceeds."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.acoustics.levels import largest_level, level
from mitsonar.instruments.sonar import Sonar
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
    wanted = got.reflectivity * got.cosine * got.solid_angle_sr * got.range_m ** (exponent - 2.0)
    np.testing.assert_allclose(level(got, sonar, np.where), wanted, rtol=1e-14)


@pytest.mark.parametrize("window", [(0.0, 2.0), (0.3, 0.9), (3.2, 5.6), (2.0, 100.0)])
@pytest.mark.parametrize("exponent", range(5))
def test_no_echo_exceeds_the_bound(exponent: int, window: tuple[float, float]) -> None:
    """Overflow is impossible because of it, also by the tails of footprints whose middle lies far outside the window;
    within the window it is not far from what can be."""
    sonar = Sonar(gain_exponent=exponent, range_min=window[0], range_max=window[1])
    bound = largest_level(sonar, 1e-5)
    found = echoes(sonar)
    assert bound / 17 <= level(found, sonar, np.where).max() <= bound * (1 + 1e-12)
    for factor in (0.0, 1e-3, 2.0, 4.0, 1e3):
        found.range_m[:] = factor * window[1]
        assert level(found, sonar, np.where).max() <= bound * (1 + 1e-12)


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
