"""The compressed pulse: width, side lobes, and the transform of its band."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.instruments.beams import Pulse


def test_half_power_at_half_the_resolution() -> None:
    assert Pulse(0.02).shape(0.01) ** 2 == pytest.approx(0.5, abs=1e-9)
    r = np.linspace(0.03, 0.2, 10_000)
    assert 20 * np.log10(np.abs(Pulse(0.02).shape(r)).max()) == pytest.approx(-31.5, abs=0.1)


def test_it_is_the_transform_of_its_band() -> None:
    band, speed = 30e3, 1480.0
    pulse = Pulse.of_band(band, speed)
    assert pulse.bandwidth_hz(speed) == pytest.approx(band)
    f = (np.arange(4001) / 4000 - 0.5) * band
    weight = 1 + np.cos(2 * np.pi * f / band)
    r = np.linspace(-0.1, 0.1, 101)
    sums = np.trapezoid(weight * np.cos(2 * np.pi * f * (2 * r[:, None] / speed)), f, axis=1) / band
    np.testing.assert_allclose(pulse.shape(r), sums, atol=1e-6)


def test_equivalent_length_is_the_energy() -> None:
    # Parseval: 1.5 / B in delay for Hann's window, so 1.5 c / 2B in range
    pulse = Pulse.of_band(50e3, 1500.0)
    assert pulse.equivalent_m == pytest.approx(1.5 * 1500 / (2 * 50e3), rel=1e-4)
