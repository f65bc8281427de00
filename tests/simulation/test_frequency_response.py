"""The transform from echoes to responses: direct sums, pulses and mean energy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.simulation.channel import frequency_response, impulse_response

pytestmark = pytest.mark.usefixtures("variant")


def echoes(count: int = 3000, seed: int = 3) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0.012, 0.024, count), rng.uniform(0, 1, count)


@pytest.mark.parametrize("carrier", [80e3, 320e3])
def test_frequency_response_is_the_direct_sum(carrier: float) -> None:
    """Eq. 5.15, double precision, relative error under 1e-6 (found: 1e-9)."""
    sonar = ChannelSonar(carrier_hz=carrier)
    delay, amplitude = echoes()
    frequency, result = frequency_response(delay, amplitude, sonar)
    direct = np.exp(-2j * np.pi * np.outer(sonar.carrier_hz + frequency, delay)) @ amplitude
    assert len(frequency) == 721
    assert np.abs(result - direct).max() < 1e-8 * np.abs(direct).max()


@pytest.mark.gpu
def test_sums_on_the_device_are_those_of_the_host() -> None:
    from mitsonar.simulation import beams

    pytest.importorskip("cufinufft")
    rng = np.random.default_rng(0)
    turn, strength = rng.uniform(-np.pi, np.pi, 5000), rng.normal(size=(5000, 2)) @ np.array([1, 1j])
    k = np.arange(-360, 361)
    direct = np.exp(-1j * np.outer(k, turn)) @ strength
    assert np.abs(beams._sums_on_device(turn, strength, 721) - direct).max() < 1e-7 * np.abs(direct).max()


def test_response_is_the_sum_of_pulses_and_nothing_wraps() -> None:
    """Two routes: padded transform, and pulses written down in time; echoes at the very beginning too."""
    sonar = ChannelSonar()
    delay, amplitude = echoes(200)
    delay[:3] = 1e-5, 4e-5, 3e-4
    pulses = sonar.pulse(sonar.delay_s[:, None] - delay) @ (amplitude * np.exp(-2j * np.pi * sonar.carrier_hz * delay))
    result = impulse_response(delay, amplitude, sonar)
    assert np.abs(result - pulses).max() < 2e-6 * np.abs(pulses).max()
    band = np.asarray(np.fft.fftfreq(800, 1 / 8000), np.float64)
    unpadded = np.fft.ifft(np.exp(-2j * np.pi * band * 1e-5) * sonar.raised_cosine(band))
    assert np.abs(unpadded[-20:]).max() > 1e-3  # what padding crops
    assert np.abs(impulse_response([1e-5], [1.0], sonar)[-20:]).max() < 1e-5


def test_mean_energy_of_a_tap_is_that_of_its_echoes() -> None:
    """With random phases; z-test over 400 draws."""
    sonar = ChannelSonar()
    delay, amplitude = echoes(300)
    rng = np.random.default_rng(9)
    draws = np.array(
        [np.abs(impulse_response(delay, amplitude * np.exp(2j * np.pi * rng.random(300)), sonar)) ** 2 for _ in range(400)]
    )
    expected = sonar.pulse(sonar.delay_s[:, None] - delay) ** 2 @ amplitude**2
    inside = slice(110, 180)
    z = (draws.mean(axis=0) - expected)[inside] / (draws.std(axis=0)[inside] / 20)
    assert np.abs(z).max() < 4.5
    assert abs(z.mean()) < 4.5 / np.sqrt(10)  # neighbouring taps share echoes
