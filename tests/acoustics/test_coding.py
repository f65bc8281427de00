"""Codings of levels: there and back, ends, and what a step of 8 bits is in decibels."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.acoustics.levels import coded, decoded
from mitsonar.instruments.sonar import Coding, Sonar


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
