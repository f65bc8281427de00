"""Heights by the ends of the light: closed forms of planes that rise, and what hides an end."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from helpers import lit_plane

from mitsonar.geometry.ground import TOPS, echo_heights
from mitsonar.instruments.beams import half_power
from mitsonar.instruments.sonar import Sonar
from mitsonar.records.frames import SonarFrames

HEIGHT_M, PITCH_RAD = 2.2, np.radians(35)
SONAR = Sonar(range_min=2.0, range_max=7.0, range_bins=800)
TOLERANCE_M = 0.02
"""The frames are blurred along range by 2 bins of 6 mm."""


@pytest.mark.parametrize("slope_deg", [0.0, 5.0, 10.0])
def test_both_ends_of_the_light_lie_on_the_plane(slope_deg: float) -> None:
    frames, near, far = lit_plane(SONAR, HEIGHT_M, PITCH_RAD, slope_deg)
    found = echo_heights(frames, PITCH_RAD, 0.0)
    assert found.first is not None
    assert found.first.height_m + found.first.tops_m == pytest.approx(near.mean(), abs=TOLERANCE_M)
    assert found.last_m == pytest.approx(far.mean(), abs=TOLERANCE_M)
    assert found.ends_m == pytest.approx((near.mean() + far.mean()) / 2, abs=TOLERANCE_M)
    if not slope_deg:
        assert found.first.even
        assert found.last_m == pytest.approx(HEIGHT_M, abs=TOLERANCE_M)


def test_contrast_lies_above_the_mean_of_the_first_echoes() -> None:
    """By half the height between that mean and the lowest tenth: a third of the beams see rocks of 0.4 m."""
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    rocks, _, _ = lit_plane(SONAR, HEIGHT_M - 0.4, PITCH_RAD)
    image = frames.image.copy()
    image[..., :32] = rocks.image[..., :32]
    found = echo_heights(replace(frames, image=image), PITCH_RAD, 0.0)
    assert found.first is not None
    assert not found.first.even
    assert found.first.tops_m == pytest.approx(TOPS * 0.4 / 3, abs=TOLERANCE_M)
    assert found.first.height_m == pytest.approx(HEIGHT_M - 0.4 / 3 - found.first.tops_m, abs=TOLERANCE_M)


def test_a_window_that_cuts_an_end_does_not_show_it() -> None:
    """The light of level ground lies between 3.3 and 4.7 m on the axis, and up to 5.6 m at the sides."""
    late = echo_heights(lit_plane(SONAR.replace(range_min=3.9), HEIGHT_M, PITCH_RAD)[0], PITCH_RAD, 0.0)
    assert late.first is None
    assert late.last_m == pytest.approx(HEIGHT_M, abs=TOLERANCE_M)
    early = echo_heights(lit_plane(SONAR.replace(range_max=4.5), HEIGHT_M, PITCH_RAD)[0], PITCH_RAD, 0.0)
    assert early.first is not None
    assert early.last_m is None
    assert early.ends_m is None


@pytest.mark.parametrize(
    ("pattern", "fov_deg", "pitch_deg", "height_m", "window_m"),
    [
        ("two_way", 14, 35, 2.5, (2, 7)),
        ("receive", 14, 35, 2.5, (3, 7)),
        ("two_way", 12, 20, 2.0, (1, 9)),
        ("two_way", 20, 20, 4.0, (3, 20)),
        ("two_way", 14, 35, 2.5, (3.2, 5.6)),
    ],
)
def test_a_skirt_of_the_light_does_not_lower_the_height(
    pattern: Literal["two_way", "receive"], fov_deg: float, pitch_deg: float, height_m: float, window_m: tuple[float, float]
) -> None:
    """The light of rays a thousandth of a degree apart, summed into bins, under the pattern of a uniform aperture."""
    sonar = Sonar(model="physical", pattern=pattern, elevation_fov_deg=fov_deg, range_bins=800)
    sonar = sonar.replace(range_min=window_m[0], range_max=window_m[1])
    half = np.radians(fov_deg / 2)
    elevation = np.radians(np.arange(-50, fov_deg, 1e-3))
    down = np.sin(np.radians(pitch_deg) - elevation)
    power = {"two_way": 4, "receive": 2}[pattern]
    gain = np.abs(np.sinc(half_power((), power) * np.sin(elevation) / np.sin(half))) ** power
    meets = down > height_m / 20
    ranges = height_m / down[meets]
    level = np.histogram(
        ranges, np.linspace(*window_m, 801), weights=(gain * down)[meets] * ranges ** (sonar.gain_exponent - 2)
    )[0]
    image = np.tile(level[:, None] / level.max(), (2, 1, sonar.beams)).astype(np.float32)
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.arange(2.0), sonar)
    found = echo_heights(frames, np.radians(pitch_deg), 0.0)
    assert found.first is not None
    at_the_middle = found.first.height_m / np.cos(sonar.bearing_rad).mean()  # the cone's beams aside go down less
    assert at_the_middle == pytest.approx(height_m, rel=0.01)


def test_shallow_rays_and_local_contrast_show_no_end() -> None:
    """The shallowest rays go down by 9 deg: far echoes are faint there, whatever the ground."""
    pitch = np.radians(16)
    window = SONAR.replace(range_max=20.0)
    assert echo_heights(lit_plane(window, HEIGHT_M, pitch)[0], pitch, 0.0).last_m is None
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    assert echo_heights(replace(frames, level="contrast"), PITCH_RAD, 0.0).first is None
