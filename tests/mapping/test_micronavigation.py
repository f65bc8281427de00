"""Micronavigation: disturbed paths come back within the bound, and images become as sharp as along the true path."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from aperture_scenes import array, responses_of, track
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.mapping.micronavigation import autofocus, displaced_phase_centres, sway_bound
from mitsonar.mapping.synthetic_aperture import focus
from mitsonar.motion.trajectory import velocities
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.strips import StripGrid

pytestmark = pytest.mark.usefixtures("variant")

PINGS, STEP, EVERY_S = 32, 0.2, 0.2


def detrended(values: NDArray[np.float64]) -> NDArray[np.float64]:
    number = np.arange(len(values))
    return np.asarray(values - np.polynomial.Polynomial.fit(number, values, 1)(number))


def navigated(found: ImpulseResponses, step: float = STEP, every_s: float = EVERY_S) -> ImpulseResponses:
    """The same responses, with a navigation that knows nothing of the sway."""
    straight = track(len(found), step, every_s)
    return replace(found, poses=straight.poses, velocity=velocities(straight))


SWAY = detrended(np.cumsum(np.random.default_rng(5).normal(0, 1e-3, PINGS)))


@cache
def quiet_field() -> ImpulseResponses:
    """Random ground along a path that sways by 1 mm from ping to ping."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(11, 24, 3000), rng.uniform(-4, 12, 3000), np.zeros(3000)])
    # levels that make the responses even over range
    sizes = (rng.normal(size=3000) + 1j * rng.normal(size=3000)) * np.hypot(points[:, 0], 8.0) ** 1.5 / 30
    return navigated(responses_of(array(8), track(PINGS, STEP, EVERY_S, SWAY), points, sizes))


def field(noise: float) -> ImpulseResponses:
    """The same with noise, a fraction of the mean level."""
    quiet = quiet_field()
    delay = quiet.delay_s
    level = np.sqrt(np.mean(np.abs(quiet.response[:, :, (delay > 0.019) & (delay < 0.031)]) ** 2))
    none = responses_of(array(8), track(PINGS, STEP, EVERY_S), [15.0, 0, 0], 0.0, noise * float(level))
    return replace(quiet, response=quiet.response + none.response)


@pytest.mark.thorough
@pytest.mark.parametrize(("noise", "coherence"), [(0.3, 1 / 1.09), (0.7, 1 / 1.49)])
def test_the_sway_comes_back_near_its_bound(noise: float, coherence: float) -> None:
    """Coherence 1 / (1 + noise^2); the error is at most 1.5 times the bound, which is 100 times below the sway."""
    found = displaced_phase_centres(field(noise), near_m=14.5)
    assert np.median(found.coherence) == pytest.approx(coherence, abs=0.03)
    error = found.sway_m - np.diff(SWAY)
    bound = float(np.sqrt(np.mean(found.sway_std_m**2)))
    assert bound < 0.05e-3
    # 31 errors: their rms scatters by 13 %; approximations of the geometry add 0.02 mm
    assert 0.7 * bound < np.sqrt(np.mean(error**2)) < 1.5 * np.hypot(bound, 0.02e-3)


def test_the_path_and_the_advance_come_back() -> None:
    quiet = quiet_field()
    found = displaced_phase_centres(quiet)
    assert detrended(found.path[:, 0]) == pytest.approx(detrended(SWAY), abs=0.2e-3)
    assert found.path[:, 1:] == pytest.approx(quiet.poses[:, 1:3])  # type: ignore[index]
    assert found.advance_m.mean() == pytest.approx(STEP, rel=0.01)
    assert found.coherence.min() > 0.98


def test_an_advance_that_the_navigation_has_wrong_is_measured() -> None:
    """Pings 0.18 m apart, 0.2 m by the navigation: the coherence peaks between two shifts of the array."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(11, 24, 3000), rng.uniform(-4, 8, 3000), np.zeros(3000)])
    sizes = rng.normal(size=3000) + 1j * rng.normal(size=3000)
    found = navigated(responses_of(array(8), track(12, 0.18, EVERY_S), points, sizes))
    assert displaced_phase_centres(found).advance_m.mean() == pytest.approx(0.18, abs=0.004)


def test_the_bound_is_that_of_the_phase() -> None:
    """Against simulated phases of two Gaussian signals of coherence 0.8."""
    rng = np.random.default_rng(0)
    common, one, two = (rng.normal(size=(2000, 300)) + 1j * rng.normal(size=(2000, 300)) for _ in range(3))
    first, second = common + 0.5 * one, common + 0.5 * two
    phase = np.angle((first * second.conj()).sum(axis=1))
    bound = sway_bound(0.8, 300, 4 * np.pi)
    assert phase.std() == pytest.approx(bound, rel=0.06)
    assert sway_bound(0.8, 300, 0.015, 0.5) == pytest.approx(2 * sway_bound(0.8, 300, 0.015))
    assert sway_bound(0.0, 300, 0.015) == np.inf


def test_what_has_no_overlap_is_refused() -> None:
    quiet = quiet_field()
    with pytest.raises(MitsonarError, match=r"overlap by two or more only up to 0\.1 m"):
        displaced_phase_centres(navigated(responses_of(array(4), track(6, STEP), [15.0, 0, 0], 1.0)))
    with pytest.raises(MitsonarError, match="three or more receivers"):
        displaced_phase_centres(navigated(responses_of(array(2), track(6, 0.1), [15.0, 0, 0], 1.0), 0.1))
    with pytest.raises(MitsonarError, match="height"):
        displaced_phase_centres(replace(quiet, height_m=None))
    with pytest.raises(MitsonarError, match="taps"):
        displaced_phase_centres(quiet, near_m=24.4)


def test_the_ground_is_the_median_below_the_pings_that_know_it() -> None:
    quiet = quiet_field()
    poses = np.array(quiet.poses)
    poses[:, 2] += np.linspace(0, 1, PINGS)
    heights = poses[:, 2] + 2.0  # ground at z = -2
    heights[:20] = np.nan
    assert replace(quiet, poses=poses, height_m=heights).ground_m == pytest.approx(-2.0)
    for unknown in ({"poses": None}, {"height_m": None}, {"height_m": np.full(PINGS, np.nan)}):
        assert replace(quiet, **unknown).ground_m is None
    with pytest.raises(MitsonarError, match="height_m above 0"):
        displaced_phase_centres(replace(quiet, height_m=np.zeros(PINGS)))


def with_noise_alone(quiet: ImpulseResponses, pings: list[int]) -> ImpulseResponses:
    """The same, but some pings hold noise alone."""
    rng = np.random.default_rng(2)
    response = quiet.response.copy()
    shape = (len(pings), *response.shape[1:])
    response[pings] = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    return replace(quiet, response=response)


@pytest.mark.thorough
def test_pairs_that_are_not_coherent_are_counted_and_refused_if_there_are_no_others() -> None:
    found = displaced_phase_centres(with_noise_alone(quiet_field(), [10]))
    assert np.flatnonzero(np.isnan(found.sway_m)).tolist() == [9, 10]
    assert found.unused == 2
    assert displaced_phase_centres(quiet_field()).unused == 0
    with pytest.raises(MitsonarError, match=r"no pair of pings is as coherent .* 0\.3: the best of 31 has 0\.0.*autofocus"):
        displaced_phase_centres(with_noise_alone(quiet_field(), list(range(PINGS))))


def sharpness(found: ImpulseResponses, grid: StripGrid, path: NDArray[np.float64] | None = None) -> float:
    power = np.abs(focus(found, grid, path=path).value.astype(complex)) ** 2
    return float((power**2).mean() / power.mean() ** 2)


@pytest.mark.slow
def test_autofocus_makes_an_image_as_sharp_as_along_the_true_path() -> None:
    """A sway of 5 mm, a third of the wavelength, with a period of 4 m, over ground with some stones."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(13, 17, 2000), rng.uniform(-2, 11, 2000), np.zeros(2000)])
    sizes = rng.normal(size=2000) + 1j * rng.normal(size=2000)
    sizes[:30] *= 30
    sway = detrended(5e-3 * np.sin(2 * np.pi * np.arange(45) * STEP / 4 + 0.3))
    measured = responses_of(array(4), track(45, STEP, EVERY_S, sway), points, sizes)
    grid = StripGrid(0, 0, 0, 0, 2.0, 0.025, 200, 13.0, 0.02, 200)
    true, lost = sharpness(measured, grid), sharpness(navigated(measured), grid)
    assert lost < 0.4 * true
    path = autofocus(navigated(measured), grid)
    assert sharpness(navigated(measured), grid, path) > 0.9 * true
    # a sway that changes slowly over the aperture of 2.5 m only shifts the image: the rest comes back
    error = (path[:, 0] - sway)[10:-10]
    number = np.linspace(-1, 1, len(error))
    error = error - np.polynomial.Polynomial.fit(number, error, 3)(number)
    assert np.sqrt(np.mean(error**2)) < 0.15 * sway.std()
    assert path[:, 1:] == pytest.approx(measured.poses[:, 1:3], abs=1e-9)  # type: ignore[index]
