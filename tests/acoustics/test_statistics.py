"""Statistics of frames against closed forms, on drawn speckle."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import Array
from scipy import ndimage, special

from mitsonar.acoustics import statistics
from mitsonar.acoustics.statistics import decibels

SHAPE = (4, 248, 90)


def field(shape: tuple[int, ...] = SHAPE, seed: int = 0) -> NDArrayC:
    """White complex Gaussian numbers of mean power 1."""
    real, imag = np.random.default_rng(seed).normal(0, np.sqrt(0.5), (2, *shape))
    return np.asarray(real + 1j * imag)


NDArrayC = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]


def intensity(shape: tuple[int, ...] = SHAPE, seed: int = 0) -> Array:
    return np.asarray(np.abs(field(shape, seed)) ** 2)


def ramp() -> Array:
    """A picture: levels that fall by 30 dB over range."""
    return np.asarray(-30 * np.linspace(0, 1, SHAPE[1])[:, None] * np.ones(SHAPE[2]))


# ---------------------------------------------------------------- levels and grain


def test_levels_of_exponential_intensities() -> None:
    """The quantile of p is -ln(1 - p)."""
    level = decibels(intensity((10, 400, 100)))
    expected = 10 * np.log10(np.log(1000) / -np.log(0.99))
    assert statistics.percentile_span_db(level) == pytest.approx(expected, abs=0.2)
    assert statistics.bright_over_median_db(level) == pytest.approx(10 * np.log10(np.log(1000) / np.log(2)), abs=0.1)
    assert statistics.zero_share([[0.0, 1.0], [2.0, 0.0]]) == 0.5
    assert decibels([0.0, 1.0, 100.0], -60).tolist() == [-60, 0, 20]


def test_grain_is_what_the_picture_is_not() -> None:
    """5.57 dB, over a falling picture too."""
    level = decibels(intensity())
    assert pytest.approx(5.57, abs=0.001) == statistics.RAYLEIGH_DB
    assert statistics.local_std_db(level) == pytest.approx(statistics.RAYLEIGH_DB, abs=0.06)
    assert statistics.local_std_db(level + ramp()) == pytest.approx(statistics.RAYLEIGH_DB, abs=0.07)
    assert statistics.local_std_db(ramp()[None]) < 0.2


@pytest.mark.parametrize("looks", [1, 2, 4])
def test_contrast_of_looks(looks: int) -> None:
    """The mean of n exponential intensities has the contrast 1 / sqrt(n)."""
    result = np.mean([intensity(seed=k) for k in range(looks)], axis=0)
    assert np.median(statistics.intensity_contrast(result)) == pytest.approx(looks**-0.5, rel=0.03)


def test_windows_hold_each_cell_once() -> None:
    values = np.arange(2 * 62 * 20.0).reshape(2, 62, 20)
    parts = statistics.window_values(values)
    assert parts.shape == (2 * 2 * 2, 31 * 9)
    np.testing.assert_array_equal(np.sort(parts[0]), np.sort(values[0, :31, :9].ravel()))
    assert len(statistics.intensity_contrast(np.zeros((1, 31, 9)))) == 0


# ---------------------------------------------------------------- memory


def test_correlation_of_frames_by_level() -> None:
    """The bright half keeps its field but for a part, the dark half is new: Li2(c^2) / (pi^2 / 6), and 0."""
    still, coherence = field((1, *SHAPE[1:])), 0.8
    moving = coherence * still + np.sqrt(1 - coherence**2) * field(SHAPE, 1)
    built = np.where(np.arange(SHAPE[1])[:, None] < 124, moving, field(SHAPE, 2))
    level = decibels(np.abs(built) ** 2) + ramp()
    at, result = statistics.correlation_by_level(level, parts=2)
    pairs = special.spence(1 - coherence**4) / (np.pi**2 / 6)  # of two frames: both differ from what stands still
    assert at[1] - at[0] == pytest.approx(15, abs=1)
    assert result == pytest.approx([0, pairs], abs=0.04)
    assert statistics.frame_correlation(level) > 0.7  # the picture
    assert statistics.frame_correlation(statistics.detrended(level[:, :124])) == pytest.approx(pairs, abs=0.03)
    assert np.isnan(statistics.frame_correlation(level[:1]))


@pytest.mark.parametrize(("axis", "along"), [(1, 0.7), (2, 0.6)])
def test_autocorrelation_of_a_known_process(axis: int, along: float) -> None:
    """An AR(1) field of coherence a^lag: its levels correlate by the dilogarithm of a^(2 lag)."""
    result = np.moveaxis(field((6, 400, 120)), axis, 0).copy()
    for k in range(1, len(result)):
        result[k] = along * result[k - 1] + np.sqrt(1 - along**2) * result[k]
    level = decibels(np.abs(np.moveaxis(result, 0, axis)) ** 2)
    expected = [special.spence(1 - along ** (2 * lag)) / (np.pi**2 / 6) for lag in (1, 2)]
    assert statistics.autocorrelation(level, axis) == pytest.approx(expected, abs=0.04)  # the local mean takes a part
    assert statistics.autocorrelation(level, 3 - axis) == pytest.approx([0, 0], abs=0.02)


# ---------------------------------------------------------------- the instrument


@pytest.mark.parametrize("groups", [1, 2, 3, 8])
def test_beams_of_a_ping_share_what_leaks(groups: int) -> None:
    """A leak of -8 dB, so of the same phase in all beams of a ping; neighbours overlap if they belong to one."""
    shape = (3, 400, 96)
    leak = field((*shape[:2], groups), 4)[..., np.arange(96) % groups] if groups > 1 else 0.0
    own = field(shape)
    overlapping = (own + np.roll(own, 1, axis=2)) / np.sqrt(2) if groups == 1 else own
    level = decibels(np.abs(overlapping + 10 ** (-8 / 20) * leak) ** 2) + ramp()[:1, :1]
    assert statistics.ping_groups(level) == groups
    assert statistics.ping_groups(level[..., :6]) == 1


@pytest.mark.parametrize("spread", [0.0, 0.3, 0.6])
def test_stripes_are_told_from_speckle(spread: float) -> None:
    gains = np.random.default_rng(3).normal(0, 1, 256)
    gains *= spread / gains.std()
    level = decibels(intensity((3, 600, 256))) + ramp()[:1, :1] + gains
    assert statistics.beam_stripes_db(level) == pytest.approx(spread, abs=0.1)


@pytest.mark.parametrize(("within", "between"), [(0.3, 0.8), (0.5, 0.0), (0.0, 0.6)])
def test_stripes_of_beams_are_told_from_those_of_ping_groups(within: float, between: float) -> None:
    rng, group = np.random.default_rng(4), np.arange(256) % 16
    gains, of_group = rng.normal(size=256), rng.normal(size=16)
    gains -= np.array([gains[group == one].mean() for one in group])
    gains *= within / gains.std()
    of_group *= between / of_group.std()
    level = decibels(intensity((3, 600, 256))) + gains + of_group[group]
    assert statistics.stripes_by_group_db(level, group) == pytest.approx((within, between), abs=0.16)
    whole = statistics.beam_stripes_db(level)
    assert statistics.stripes_by_group_db(level, np.zeros(256)) == pytest.approx((whole, 0))


def test_tails_behind_the_brightest() -> None:
    """Echoes whose power falls by 0.8 dB a bin; what lies beyond the picture is left out."""
    level = np.full((2, 200, 300), -90.0)
    level[:, 60:160, 7::100] = -0.8 * np.arange(100)[:, None]
    assert statistics.tail_db(level) == pytest.approx(-0.8 * np.array([10, 25, 50]), abs=1e-6)
    assert np.isnan(statistics.tail_db(level[:, :40])).tolist() == [False, False, True]


def test_profile_glow_and_edges() -> None:
    level = np.zeros((2, 400, 30)) - 40
    level[:, 100:300] = 0  # a lit patch, from one bin to the next
    rise, fall = statistics.edge_steps_db(level)
    assert (rise, fall) == pytest.approx((40, 40), abs=1e-6)
    slow = np.interp(np.arange(400), [100, 180, 260, 340], [-40, 0, 0, -20])[None, :, None] + np.zeros((2, 1, 30))
    rise, fall = statistics.edge_steps_db(slow)
    assert rise == pytest.approx(0.5 * 19, rel=0.05)
    assert fall == pytest.approx(0.25 * 19, rel=0.05)
    glow = 20 * np.exp(-np.arange(400) / 4) - 0.02 * np.arange(400)
    result = statistics.near_glow_db(glow[None, :, None] + np.zeros((2, 1, 30)))
    assert result[:10] == pytest.approx(20 * np.exp(-np.arange(10) / 4), abs=0.3)
    np.testing.assert_allclose(statistics.range_profile_db(slow), slow[0, :, 0], atol=1e-9)


@pytest.mark.parametrize("leak_db", [-60.0, -50.0])
def test_smear_of_targets(leak_db: float) -> None:
    """Beams leak into each other with random gains of a mean square: in noise 80 dB below the targets it comes back."""
    result = 1e-4 * field((4, 400, 96), 5)
    for bin_, beam in ((60, 70), (100, 20), (150, 10), (210, 60), (280, 80), (330, 40)):
        peak = np.exp(-((np.arange(-3, 4) / 1.2) ** 2))
        result[:, bin_ - 3 : bin_ + 4, beam] += 1.0 * peak
    result = result + 10 ** (leak_db / 20) * result @ field((96, 96), 6)
    power = np.abs(result) ** 2
    assert 10 * np.log10(statistics.leak_power([power])) == pytest.approx(leak_db, abs=1.0)
    assert statistics.smear_db(decibels(power)) == pytest.approx(80 + leak_db, abs=1.5)
    clean = np.abs(1e-4 * field((4, 400, 96), 5)) ** 2
    assert statistics.smear_db(decibels(clean)) == pytest.approx(0, abs=1.5)
    assert statistics.leak_power([clean]) == 0
    assert statistics.leak_power([power], limit=1e-9) == 0.0


def test_one_group_that_rises_by_chance_does_not_set_the_leak() -> None:
    """Twenty targets over eight groups: a group of one target errs by decibels, and that with the largest error by 20."""
    random = np.random.default_rng(1)
    result = 1e-4 * field((4, 400, 96), 5)
    for _ in range(20):
        bin_, beam = random.integers(10, 390), random.integers(0, 96)
        result[:, bin_ - 3 : bin_ + 4, beam] += np.exp(-((np.arange(-3, 4) / 1.2) ** 2))
    group = np.arange(96) % 8
    together = group[:, None] == group
    power = np.abs(result + 1e-3 * result @ (field((96, 96), 6) * together)) ** 2
    leak_db = 10 * np.log10(statistics.leak_power([power[..., group == one] for one in range(8)]))
    assert leak_db == pytest.approx(-60, abs=3.5)


def test_smoothing_adds_memory_only() -> None:
    """A moving mean of three lines correlates by 2/3 and 1/3 in the field."""
    result = ndimage.uniform_filter1d(field((6, 400, 120)), 3, axis=1)
    expected = [special.spence(1 - (k / 3) ** 2) / (np.pi**2 / 6) for k in (2, 1)]
    assert statistics.autocorrelation(decibels(np.abs(result) ** 2), 1) == pytest.approx(expected, abs=0.03)
