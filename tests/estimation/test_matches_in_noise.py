"""Matches that noise hides: how far they stand out, and what that costs in certainty."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.estimation.estimator import Excess, ambiguity, correlation_excess, correlation_of, correlation_rejection
from mitsonar.estimation.image.registration import DirectLevel, StartPrior

SIZE = (200, 96)


def images(share: float, lighting: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two images of variance 1 with this share of it in common, over lighting that all beams see alike."""
    rng = np.random.default_rng(5)
    common, *noise = rng.standard_normal((3, *SIZE))
    light = lighting * np.linspace(-1, 1, SIZE[0])[:, None]
    first, second = (np.sqrt(share) * common + np.sqrt(1 - share) * local + light for local in noise)
    return first, second, np.ones(SIZE, dtype=bool)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5])
def test_excess_is_the_share_in_common_whatever_the_lighting(share: float) -> None:
    """One standard deviation is 1 / sqrt(cells)."""
    std = 1 / np.sqrt(np.prod(SIZE))
    assert abs(correlation_excess(*images(share), aside=8).mean - share) < 4 * std
    lit = images(share, lighting=3.0)
    assert correlation_of(lit[0], lit[1]) > 0.7, "lighting alone correlates"
    shown = share / (1 + 3.0)  # variance of the light: 3
    assert correlation_excess(*lit, aside=8).mean == pytest.approx(shown, abs=4 * std)


def test_a_low_correlation_counts_where_it_stands_out() -> None:
    """0.1 of 19,200 cells is 14 standard deviations; without anything in common nothing is matched."""
    cells = float(np.prod(SIZE))
    for share, output in ((0.1, False), (0.0, True)):
        first, second, inside = images(share)
        excess = correlation_excess(first, second, inside, aside=8)
        correlation = correlation_of(first, second)
        assert bool(correlation_rejection(correlation, cells, excess)) is output
        assert correlation_rejection(correlation, cells), "without the comparison it is too low"
    assert not correlation_rejection(0.5, cells)


def test_a_match_among_few_rocks_must_stand_out_over_what_displaced_ones_scatter() -> None:
    """Two places of a rocky field correlated by 0.14 of 7 standard deviations of noise, and displaced as much either way."""
    assert not correlation_rejection(0.14, 2500, Excess(0.14, 0.01))
    assert correlation_rejection(0.14, 2500, Excess(0.14, 0.04))


def test_doubt_grows_as_a_match_stands_out_less() -> None:
    """Twice the covariance at 12 standard deviations; no more than 145 times, for a match that does not stand out at all."""
    assert ambiguity(0.12, 1e4) == pytest.approx(2.0)
    assert ambiguity(0.6, 1e4) == pytest.approx(1.04)
    assert ambiguity(-0.1, 1e4) == ambiguity(0.0, 1e4) == pytest.approx(145.0)


def test_a_prior_weighs_as_much_as_the_noise_of_cells_that_count_once() -> None:
    """Cells that smoothing makes alike are as many times one measurement; an infinite deviation holds nothing."""
    level = DirectLevel(4, (8.0, 1.5), (0.0, 0.0), 10)
    weight = StartPrior(np.zeros(3), np.array([0.05, np.inf, 0.01])).weight(0.2, level)
    np.testing.assert_allclose(weight, 4 * np.pi * 2.0 * 1.5 * 0.2**2 * np.array([400.0, 0.0, 1e4]))
