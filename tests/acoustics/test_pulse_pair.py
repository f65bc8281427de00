"""Noise of a range rate that is measured by pulse pairs, as Doppler velocity logs do: where the A50's preset has it from."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mitsonar.instruments.sounder import load_sounder


def pulse_pair_std(
    frequency_hz: float, lag_s: float, samples: int, correlation: float, sound_speed: float = 1500.0
) -> float:
    """Compute the standard deviation of a range rate [m/s] from the phase between two pulses.

    The phase of the correlation of ``samples`` independent complex pairs has the variance (1 - rho^2) / (2 N rho^2), the
    Cramer-Rao bound (Rodriguez and Martin 1992, IEE Proc. F 139:147, eq. 25). A phase is 4 pi f lag / c times the rate.
    """
    phase = math.sqrt((1 - correlation**2) / (2 * samples * correlation**2))
    return sound_speed / (4 * math.pi * frequency_hz * lag_s) * phase


def test_the_preset_of_the_a50_has_the_noise_of_pulse_pairs() -> None:
    assert load_sounder("a50").beam_std_m_s == pytest.approx(pulse_pair_std(1e6, 0.25e-3, 200, 0.93), rel=0.01)


def test_the_phase_of_correlated_pairs_varies_as_the_bound_says() -> None:
    """2,000 estimates from 200 pairs each of complex normal samples."""
    generator = np.random.default_rng(5)
    first, another = (generator.normal(size=(2000, 200, 2)) @ [1, 1j] for _ in range(2))
    second = 0.93 * first + math.sqrt(1 - 0.93**2) * another
    phase = np.angle((second * first.conj()).sum(axis=1))
    rate = 1500 * phase / (4 * math.pi * 1e6 * 0.25e-3)
    assert rate.std() == pytest.approx(pulse_pair_std(1e6, 0.25e-3, 200, 0.93), rel=0.06)
