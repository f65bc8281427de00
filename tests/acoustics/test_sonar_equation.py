"""The sonar equation: closed forms, round trips, and each level by a second route."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import integrate
from sonar_equation import (
    ambient_noise_db,
    apply_tvg,
    area_strength_db,
    decibels,
    echo_level_db,
    intensity_ratio,
    level_of_pressure,
    line_directivity_db,
    noise_level_db,
    noise_warning,
    power_sum_db,
    pressure_of_level,
    rectangle_directivity_db,
    thermal_noise_db,
    transmission_loss_db,
    tvg_db,
    two_way_amplitude,
    two_way_intensity,
    undo_tvg,
    volume_reverberation_db,
)

from mitsonar.errors import MitsonarError

RANGE = np.geomspace(0.1, 500, 200)


def test_levels_and_factors_are_inverse() -> None:
    level = np.linspace(-120, 240, 73)
    np.testing.assert_allclose(decibels(intensity_ratio(level)), level, atol=1e-12)
    np.testing.assert_allclose(level_of_pressure(pressure_of_level(level)), level, atol=1e-12)
    assert level_of_pressure(1.0) == 0  # dB re 1 uPa
    assert level_of_pressure(1e6) == pytest.approx(120)  # 1 Pa
    assert decibels(0.0) == -math.inf


def test_power_sum() -> None:
    assert power_sum_db(60.0, 60.0) == pytest.approx(60 + 10 * math.log10(2))
    assert power_sum_db(60.0) == pytest.approx(60)
    assert power_sum_db(60.0, -math.inf) == pytest.approx(60)
    np.testing.assert_allclose(power_sum_db(np.array([0.0, 10.0]), 10.0), [10 * math.log10(11), 10 + 10 * math.log10(2)])
    with pytest.raises(MitsonarError, match="needs at least one"):
        power_sum_db()


def test_an_echo_in_steps() -> None:
    """SL 200 dB, 10 m, 1 dB/m, a rigid sphere of 0.1 m radius: TS = 10 log(a^2 / 4) = -26.02 dB."""
    strength = decibels(0.1**2 / 4)
    assert strength == pytest.approx(-26.02, abs=0.005)
    assert transmission_loss_db(10.0, 1.0) == pytest.approx(20 + 10)
    assert echo_level_db(200.0, 10.0, 1.0, strength) == pytest.approx(200 - 40 - 20 - 26.02, abs=0.005)


def test_levels_and_the_factor_are_two_routes_to_one_number() -> None:
    level = echo_level_db(200.0, RANGE, 0.3, area_strength_db(0.01, 0.2))
    pressure = pressure_of_level(200.0) * two_way_amplitude(RANGE, 0.3) * math.sqrt(0.01 * 0.2)
    np.testing.assert_allclose(level, level_of_pressure(pressure), atol=1e-9)
    np.testing.assert_array_equal(two_way_intensity(RANGE, 0.3), two_way_amplitude(RANGE, 0.3) ** 2)
    assert two_way_amplitude(RANGE.astype(np.float32), 0.3).dtype == np.float64
    assert two_way_amplitude(2.0, 0.0) == 0.25


def test_a_lambert_floor_below() -> None:
    """All echoes of an endless floor straight below: mu 2 pi / (4 h^2) without absorption, by the sum of its rings."""
    height, mu = 3.0, 0.05
    edge = np.linspace(0, 300, 300_001)
    out = (edge[1:] + edge[:-1]) / 2
    distance = np.hypot(out, height)
    ring = 2 * np.pi * out * np.diff(edge)
    sum_db = decibels(
        intensity_ratio(echo_level_db(0.0, distance, 0.0, area_strength_db(mu * (height / distance) ** 2, ring))).sum()
    )
    assert sum_db == pytest.approx(decibels(mu * 2 * np.pi / (4 * height**2)), abs=1e-3)


def test_volume_reverberation_falls_with_the_square_of_the_range() -> None:
    """SL + Sv + 10 log(Omega c tau / 2) - 20 log R - 2 alpha R."""
    result = volume_reverberation_db(200.0, RANGE, 0.2, -70.0, solid_angle_sr=1e-3, extent_m=0.01)
    np.testing.assert_allclose(result, 200 - 70 - 50 - 20 * np.log10(RANGE) - 0.4 * RANGE, atol=1e-9)


# ---------------------------------------------------------------- gain


@pytest.mark.parametrize("log", [0.0, 20.0, 30.0, 40.0])
def test_gain_and_its_inverse(log: float) -> None:
    np.testing.assert_allclose(tvg_db(RANGE, log, 0.1), log * np.log10(RANGE) + 0.2 * RANGE, atol=1e-12)
    level = np.linspace(-20, 200, len(RANGE))
    np.testing.assert_allclose(undo_tvg(apply_tvg(level, RANGE, log, 0.1), RANGE, log, 0.1), level, atol=1e-11)


def test_forty_log_holds_a_point_and_twenty_log_the_volume() -> None:
    point = apply_tvg(echo_level_db(200.0, RANGE, 0.3, -20.0), RANGE, 40, 0.3)
    np.testing.assert_allclose(point, 180, atol=1e-9)
    volume = volume_reverberation_db(200.0, RANGE, 0.3, -70.0, solid_angle_sr=1e-3, extent_m=0.01)
    assert np.ptp(apply_tvg(volume, RANGE, 20, 0.3)) < 1e-9


# ---------------------------------------------------------------- noise


@pytest.mark.parametrize("khz", [100.0, 900.0, 1800.0])
def test_thermal_noise_is_that_of_boltzmann(khz: float) -> None:
    """Pressure of an isotropic field at temperature T: 4 pi k T rho f^2 / c a Hz; 0.5 dB is Mellen's rounding and T."""
    for kelvin, density, speed in ((278.0, 1028.0, 1470.0), (293.0, 1024.0, 1520.0)):
        pascal2 = 4 * math.pi * 1.380649e-23 * kelvin * density * (khz * 1e3) ** 2 / speed
        assert thermal_noise_db(khz * 1e3) == pytest.approx(decibels(pascal2 * 1e12), abs=0.5)


def test_band_and_directivity_of_noise() -> None:
    assert thermal_noise_db(1e6) == pytest.approx(45)
    assert thermal_noise_db(1e6, 1e4, 30.0) == pytest.approx(45 + 40 - 30)
    assert noise_level_db(1e6, 1e4, 30.0) == thermal_noise_db(1e6, 1e4, 30.0)
    assert noise_level_db(1e6, 1e4, 30.0, receiver_db=55.0) == pytest.approx(55 + 10 * math.log10(2))
    sea = noise_level_db(2e4, 100.0, 10.0, wind_m_s=8.0, shipping=0.2)
    assert sea == pytest.approx(ambient_noise_db(2e4, wind_m_s=8.0, shipping=0.2) + 20 - 10)


def test_noise_of_the_sea() -> None:
    """The shape of the curves of Wenz: wind rules at 1 kHz, ships at 100 Hz, and heat far above 100 kHz."""
    windy, calm = (ambient_noise_db(1e3, wind_m_s=wind) for wind in (20.0, 0.0))
    assert 15 < windy - calm < 35
    busy = [
        ambient_noise_db(hz, wind_m_s=5.0, shipping=1.0) - ambient_noise_db(hz, wind_m_s=5.0, shipping=0.0)
        for hz in (100.0, 2e4)
    ]
    assert busy[0] > 10
    assert busy[1] < 0.5
    assert ambient_noise_db(1e6, wind_m_s=5.0) == pytest.approx(thermal_noise_db(1e6), abs=0.1)
    assert ambient_noise_db(1e3, wind_m_s=5.0) == pytest.approx(61, abs=1)  # about 60 dB in his figures


# ---------------------------------------------------------------- directivity


@pytest.mark.parametrize("length", [0.05, 0.5, 1.0, 3.7, 50.0])
def test_directivity_of_a_line_is_the_mean_of_its_pattern(length: float) -> None:
    """In wavelengths; the mean over the sphere of sinc^2(L u) is an integral over u = sin(angle)."""
    mean = integrate.quad(lambda u: np.sinc(length * u) ** 2, 0, 1, limit=500)[0]
    assert line_directivity_db(length * 0.02, 0.02) == pytest.approx(-decibels(mean), abs=1e-6)
    if length >= 50:
        assert line_directivity_db(length, 1.0) == pytest.approx(decibels(2 * length), abs=0.05)


@pytest.mark.parametrize(("width", "height"), [(1.0, 1.0), (2.0, 2.0), (2.0, 5.0), (10.0, 5.0)])
def test_directivity_of_a_rectangle_is_the_mean_of_its_pattern(width: float, height: float) -> None:
    """In wavelengths, over the half space before the baffle."""
    node, weight = np.polynomial.legendre.leggauss(200)
    angle = ((node + 1) * np.pi / 4)[:, None]
    around = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    across = np.sinc(width * np.sin(angle) * np.cos(around)) * np.sinc(height * np.sin(angle) * np.sin(around))
    power = 2 * np.pi * ((across**2 * np.sin(angle)).mean(axis=1) @ weight) * np.pi / 4
    assert rectangle_directivity_db(width, height, 1.0) == pytest.approx(decibels(4 * np.pi / power), abs=0.2)


# ---------------------------------------------------------------- libraries and mistakes


@pytest.mark.learn
def test_torch_gives_the_numbers_of_numpy() -> None:
    import torch

    there = torch.asarray(RANGE)
    functions: tuple[Callable[[Any], Any], ...] = (
        lambda r: echo_level_db(200.0, r, 0.3, -20.0),
        lambda r: tvg_db(r, 30, 0.2),
        lambda r: two_way_amplitude(r, 0.2),
        lambda r: power_sum_db(transmission_loss_db(r, 0.1), 20.0),
        lambda r: ambient_noise_db(r * 1e3, wind_m_s=4.0),
    )
    for function in functions:
        result = function(there)
        assert result.dtype == torch.float64
        np.testing.assert_allclose(result.numpy(), function(RANGE), rtol=1e-13, atol=1e-12)


def test_the_factor_in_dr_jit(variant: str) -> None:
    import drjit as dr
    import mitsuba as mi

    result = np.asarray(two_way_amplitude(mi.Float64(RANGE), 0.3, exp=dr.exp))
    np.testing.assert_allclose(result, two_way_amplitude(RANGE, 0.3), rtol=1e-13)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda: thermal_noise_db(1e6, 0.0), "bandwidth_hz must be a finite number above 0: got 0.0"),
        (lambda: ambient_noise_db(1e3, wind_m_s=-1.0), "wind_m_s must be a finite speed from 0: got -1.0"),
        (lambda: ambient_noise_db(1e3, wind_m_s=1.0, shipping=2.0), "shipping must lie in 0..1: got 2.0"),
        (lambda: line_directivity_db(0.0, 0.1), "length_m must be a finite number above 0"),
        (lambda: line_directivity_db(1.0, float("nan")), "wavelength_m must be a finite number above 0"),
        (lambda: rectangle_directivity_db(1.0, 0.05, 0.1), "at least one wavelength, 0.1 m: got 0.05 m"),
    ],
)
def test_a_mistake_is_one_sentence(ask: Callable[[], object], message: str) -> None:
    with pytest.raises(MitsonarError, match=message):
        ask()


def test_noise_outside_its_band_is_told() -> None:
    assert noise_warning(1e5) is None
    assert noise_warning(30e3, wind_m_s=5.0) is None
    assert noise_warning(3e5, wind_m_s=5.0) is None  # thermal noise is among the powers
    assert "at 30 kHz is too low for the sea" in str(noise_warning(30e3))
    assert "at 0.5 Hz is extrapolated" in str(noise_warning(0.5, wind_m_s=5.0))
    with pytest.raises(MitsonarError, match="must be a finite number above 0"):
        noise_warning(0.0)
