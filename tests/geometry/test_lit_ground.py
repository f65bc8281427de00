"""The outline of the light: where it lies, and where it must be left out."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.geometry.ground import Attitude, GroundGeometry, margin_of_light

FOV_DEG = 14.0


def grazing(given_m: float | None = None, height_m: float = 0.32) -> tuple[GroundGeometry, Attitude]:
    """A look at a plate from 0.32 m, pitch 4 deg: lit from 1.7 m on."""
    attitude = Attitude(height_m, 0.01, np.radians(4), given_m=given_m)
    range_m = np.linspace(1.5, 5.0, 351)
    return GroundGeometry(range_m, np.zeros(1), "azimuth", height_m, attitude.pitch_rad), attitude


def first_lit_m(ground: GroundGeometry, attitude: Attitude) -> float:
    margin = margin_of_light(ground, attitude, FOV_DEG)
    assert margin is not None
    return float(ground.range_m[(margin[:, 0] > 0).argmax()])


def test_light_begins_where_the_steepest_rays_meet_the_ground() -> None:
    """The margin is 1 less the angle off the axis, as part of 0.9 of the half field of view."""
    ground, attitude = grazing()
    margin = margin_of_light(ground, attitude, FOV_DEG)
    assert margin is not None
    off_axis_deg = np.abs(np.degrees(np.arcsin(0.32 / ground.range_m)) - 4)
    np.testing.assert_allclose(margin[:, 0], 1 - off_axis_deg / 6.3, atol=1e-9)
    assert first_lit_m(ground, attitude) == pytest.approx(0.32 / np.sin(np.radians(10.3)), abs=0.01)


def test_the_outline_lies_on_the_floor_and_not_on_the_tubes() -> None:
    """Tubes of 40 mm answer first: over them the light seems to begin 0.2 m nearer, and its outline would be matched."""
    hidden, told = first_lit_m(*grazing(height_m=0.28)), first_lit_m(*grazing(given_m=0.32, height_m=0.28))
    assert told == pytest.approx(0.32 / np.sin(np.radians(10.3)), abs=0.01)
    assert told - hidden == pytest.approx(0.04 / np.sin(np.radians(10.3)), abs=0.01)
    rock_below = first_lit_m(*grazing(given_m=0.25, height_m=0.28))
    assert rock_below == hidden, "a rock straight below tells too small a height"


def test_rocks_keep_the_outline_even_ground_and_dark_windows_do_not() -> None:
    """From 2.5 m, pitch 35 deg: 0.65 of the window 3.2 to 5.6 m is lit."""
    attitude = Attitude(2.5, 0.05, np.radians(35))
    ground = GroundGeometry(np.linspace(3.2, 5.6, 97), np.zeros(1), "azimuth", 2.5, attitude.pitch_rad)
    assert margin_of_light(ground, attitude, FOV_DEG) is None
    even = Attitude(2.5, 0.05, np.radians(35), even=True)
    assert margin_of_light(ground, even, FOV_DEG) is not None
    wide = GroundGeometry(np.linspace(3.2, 12.0, 97), np.zeros(1), "azimuth", 2.5, attitude.pitch_rad)
    assert margin_of_light(wide, attitude, FOV_DEG) is not None
    assert margin_of_light(wide, attitude, FOV_DEG, mostly=0.0) is None
