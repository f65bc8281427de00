"""The height over the visible surface: by first echoes, as told, and over ground that rises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import lit_plane

from mitsonar.geometry.attitude import STD_GIVEN, STD_MEASURED, attitude_of
from mitsonar.instruments.imaging_sonar import Sonar

HEIGHT_M, PITCH_RAD = 2.2, np.radians(35)
SONAR = Sonar(range_min=2.0, range_max=7.0, range_bins=800)
TOLERANCE_M = 0.02


def test_level_ground_has_the_height_of_the_first_echoes() -> None:
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    found = attitude_of(frames, "a test", None, None)
    assert found.height_m == pytest.approx(HEIGHT_M, abs=TOLERANCE_M)
    assert found.height_std_m == pytest.approx(STD_MEASURED * found.height_m)
    assert found.first is not None
    assert found.height_m == found.first.height_m
    assert abs(found.tops_m) < TOLERANCE_M
    assert found.even
    assert not found.reason


def test_rising_ground_has_the_mean_height_of_both_ends() -> None:
    """10 deg: the light ends 0.2 m higher than it begins; the height may be any between both, a uniform distribution."""
    frames, near, far = lit_plane(SONAR, HEIGHT_M, PITCH_RAD, 10.0)
    found = attitude_of(replace(frames, height_m=None), "a test", None, None)
    apart = near.mean() - far.mean()
    assert found.first is not None
    assert found.first.height_m == pytest.approx(near.mean(), abs=TOLERANCE_M)
    assert found.height_m == pytest.approx((near.mean() + far.mean()) / 2, abs=TOLERANCE_M)
    assert found.height_std_m == pytest.approx(np.hypot(STD_MEASURED * found.height_m, apart / np.sqrt(12)), rel=0.12)
    # whoever gives the relief means level ground
    given = attitude_of(frames, "a test", HEIGHT_M, None, relief_m=0.1)
    assert given.height_m == pytest.approx(HEIGHT_M - 0.1)
    assert given.first is None


def test_a_window_without_first_echoes_shows_rising_ground_by_its_last_ones() -> None:
    """Against the height that is told; over level ground the told one counts, with its own standard deviation."""
    window = SONAR.replace(range_min=3.9)
    level = attitude_of(lit_plane(window, HEIGHT_M, PITCH_RAD)[0], "a test", None, None)
    assert level.height_m == HEIGHT_M
    assert level.height_std_m == pytest.approx(STD_GIVEN * HEIGHT_M)
    assert level.first is None
    window = SONAR.replace(range_min=3.3)
    frames, _, far = lit_plane(window, HEIGHT_M, PITCH_RAD, 10.0)
    rising = attitude_of(frames, "a test", None, None)
    assert rising.first is None
    assert rising.height_m == pytest.approx(far.mean(), abs=0.1)
    assert rising.height_std_m > STD_GIVEN * HEIGHT_M


def test_rocks_on_level_ground_are_no_slope() -> None:
    """Rocks of 0.5 m in a third of the beams, shadows in another: 5 % between both ends. On even ground that is a slope."""
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    rocks, _, _ = lit_plane(SONAR, HEIGHT_M - 0.5, PITCH_RAD)
    image = frames.image.copy()
    image[:, frames.range_m > 4.0, 40:72] = 0
    shadows = attitude_of(replace(frames, image=image), "a test", None, None)
    assert shadows.even
    assert shadows.height_std_m > STD_MEASURED * shadows.height_m
    image[..., :32] = rocks.image[..., :32]
    found = attitude_of(replace(frames, image=image), "a test", None, None)
    assert not found.even
    assert found.height_std_m == pytest.approx(STD_MEASURED * found.height_m)


def test_ground_that_falls_is_taken_for_level() -> None:
    """Its light ends beyond most windows: only the first echoes count."""
    frames, near, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD, -5.0)
    found = attitude_of(frames, "a test", None, None)
    assert found.height_m == pytest.approx(near.mean() - found.tops_m, abs=TOLERANCE_M)
    assert found.height_std_m == pytest.approx(STD_MEASURED * found.height_m)


def test_a_told_height_that_first_echoes_contradict_is_rejected() -> None:
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    found = attitude_of(replace(frames, height_m=np.full(2, 3.2)), "a test", None, None)
    assert "height or pitch is wrong" in found.reason
