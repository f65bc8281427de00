"""Beam patterns against the literature's side lobes, against SciPy's windows, and against sums over the aperture."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal.windows import taylor

from mitsonar.instruments.beams import SHADINGS, Aperture, Pulse, Shading, series

LOBES_DB = {"uniform": -13.26, "hann": -31.47, "hamming": -42.68, "taylor": -30.3}
"""Highest side lobe of each shading (Harris 1978, table 1; Taylor by design)."""


@pytest.mark.parametrize("two_way", [False, True])
@pytest.mark.parametrize("shading", SHADINGS)
def test_side_lobes_and_width(shading: Shading, two_way: bool) -> None:
    aperture = Aperture(0.01, shading, two_way)
    assert aperture.pattern(0.005) ** 2 == pytest.approx(0.5, abs=1e-9)  # half power at half the width
    u = np.linspace(0, 8 / aperture.length, 80_001)
    level = 20 * np.log10(np.abs(aperture.pattern(u)) + 1e-12)
    null = int(np.flatnonzero(np.diff(level) > 0)[0])
    assert level[null:].max() == pytest.approx(LOBES_DB[shading] * (1 + two_way), abs=0.02 * (1 + two_way))


def test_taylor_is_scipys() -> None:
    x = (np.arange(4096) + 0.5) / 4096 - 0.5
    local = 1 + sum(2 * part * np.cos(2 * np.pi * m * x) for m, part in enumerate(series("taylor"), 1))
    window = taylor(4096, 4, 30, norm=False)
    np.testing.assert_allclose(local, window / window.mean(), atol=1e-9)


@pytest.mark.parametrize("shading", SHADINGS)
def test_the_pattern_is_the_sum_over_the_aperture(shading: Shading) -> None:
    aperture = Aperture(0.02, shading, two_way=False)
    u = np.linspace(-0.1, 0.1, 201)
    np.testing.assert_allclose(aperture.spectrum().at(u), aperture.pattern(u), atol=2e-4)


@pytest.mark.thorough
def test_an_array_out_of_focus_is_wider_and_lower() -> None:
    aperture = Aperture(0.005)
    sharp, blurred = (np.abs(aperture.spectrum(bend * 8e-4).at(np.linspace(-0.05, 0.05, 4001))) for bend in (0.0, 0.4))
    assert blurred[2000] < 0.9 * sharp[2000]
    assert (blurred > blurred.max() / 2).sum() > 1.05 * (sharp > sharp.max() / 2).sum()
    near = complex(Aperture(0.005).spectrum(0.01 * 8e-4).at(0.0))
    assert abs(abs(near) - 1) < 2e-3  # far from the near field's edge nothing changes


@pytest.mark.thorough
@pytest.mark.parametrize("shading", SHADINGS)
def test_array_errors_raise_lobes_everywhere(shading: Shading) -> None:
    """Beside the main lobe the mean power is error^2 sum w^2 of elements half a wavelength apart, each a short sinc."""
    aperture, u = Aperture(0.02, shading, two_way=False), np.linspace(-0.6, 0.6, 490)
    lobes = [Aperture(0.02, shading, False, 0.2, seed).spectrum().at(u) - aperture.pattern(u) for seed in range(60)]
    elements = round(2 * aperture.length)
    x = (np.arange(elements) + 0.5) / elements - 0.5
    weight = sum((2 * part * np.cos(2 * np.pi * m * x) for m, part in enumerate(series(shading), 1)), np.ones(elements))
    floor = 0.2**2 * np.square(weight / weight.sum()).sum() * np.sinc(u / 2) ** 2
    ratio = np.square(np.abs(lobes)).mean(axis=0) / floor
    assert 10 * np.log10(ratio.reshape(-1, 49).mean(axis=1)) == pytest.approx(0, abs=1.0)
    assert np.square(np.abs(lobes)).sum(axis=0).mean() / floor.mean() / 60 == pytest.approx(1, abs=0.05)


def test_equivalent_width_is_the_integral() -> None:
    # of sinc(x)^2, both ways sinc(x)^4: 1 and 2/3 of a wavelength over the aperture
    assert Aperture(0.01, "uniform", False).equivalent_width * Aperture(0.01, "uniform", False).length == pytest.approx(
        1, abs=0.004
    )
    both = Aperture(0.01, "uniform", True)
    assert both.equivalent_width * both.length == pytest.approx(2 / 3, abs=1e-5)


def test_reach_ends_the_side_lobes() -> None:
    aperture = Aperture(0.01, "hann", False)
    beyond = np.linspace(aperture.reach(40), 30 / aperture.length, 10_000)
    assert 20 * np.log10(np.abs(aperture.pattern(beyond[1:])).max()) <= -40


# ---------------------------------------------------------------- the compressed pulse: width, side lobes, and the transfor


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
