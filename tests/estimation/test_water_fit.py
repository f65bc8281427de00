"""Glow and volume that were put into a recording come back; what is neither is not taken for them."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers import Array, diffuse, essence, floor, scene

from mitsonar.errors import MitsonarWarning
from mitsonar.estimation.sonar_fit import fit_sonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.records.frames import SonarFrames

if TYPE_CHECKING:
    import mitsuba as mi

SONAR = Sonar.create(model="coherent", frequency_hz=1.8e6, range_min=1.0, range_max=8.0, bearing="cone", beams=48,
                     beam_width_deg=0.3, absorption_db_per_m=0.5, noise_level_db=-95.0)  # fmt: skip

PLAIN: dict[str, Any] = {"noise_level_db": None, "near_glow_db": 0.0, "volume_db": None}


@pytest.fixture(scope="module")
def deep(variant: str) -> mi.Scene:
    return scene(floor=floor(diffuse(0.3)))


def recorded(deep: mi.Scene, height: float, step: tuple[float, float] = (0, 0), **fields: Any) -> SonarFrames:
    """Six frames above the floor, whose sonar says nothing of the water."""
    from mitsonar.simulation.simulator import Simulator

    poses = np.array([0, 0, height, math.radians(35), 0, 0]) + np.arange(6)[:, None] * np.array([*step, 0, 0, 0, 0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MitsonarWarning)
        frames = Simulator(deep, SONAR.replace(**fields)).render(poses)
    frames.sonar = frames.sonar.replace(**PLAIN)
    return frames


@pytest.mark.parametrize(("glow", "gone"), essence([(60.0, 1.8), (40.0, 2.2)], (60.0, 1.8)))
def test_a_glow_comes_back(deep: mi.Scene, glow: float, gone: float) -> None:
    sonar = fit_sonar(recorded(deep, 3.0, near_glow_db=glow, near_glow_m=gone)).sonar
    assert sonar.near_glow_m == pytest.approx(gone, rel=0.05)
    assert sonar.near_glow_db == pytest.approx(glow, rel=0.1)
    assert sonar.noise_level_db == pytest.approx(-95, abs=1)


@pytest.mark.thorough
def test_what_beams_glow_and_what_stays_comes_back(deep: mi.Scene) -> None:
    fields: dict[str, Any] = {"near_glow_db": 60.0, "near_glow_m": 1.8, "near_glow_edge_db": 15.0}
    built = recorded(deep, 3.0, **fields, near_glow_spread_db=4.0, near_glow_still=0.8)
    result = fit_sonar(built).sonar
    assert result.near_glow_db == pytest.approx(60, rel=0.1)
    assert result.near_glow_edge_db == pytest.approx(15, abs=3)
    assert result.near_glow_spread_db == pytest.approx(4, abs=1.2)
    assert result.near_glow_still == pytest.approx(0.8, abs=0.05)


def test_an_even_new_glow_has_no_structure(deep: mi.Scene) -> None:
    result = fit_sonar(recorded(deep, 3.0, near_glow_db=60.0, near_glow_m=1.8)).sonar
    assert abs(result.near_glow_edge_db) < 1
    assert result.near_glow_spread_db < 0.8
    assert result.near_glow_still < 0.15


def test_a_glow_of_few_bins_tells_no_beams() -> None:
    from mitsonar.estimation.sonar_fit import glow_by_beam

    at: Array = np.linspace(1, 4.99, 400)
    flat = np.ones((2, 400, 8))
    assert glow_by_beam(flat, 1.0, at, np.linspace(-0.2, 0.2, 8), (60.0, 1.05)) == (0.0, 0.0, 0.0)


def test_a_glow_far_out_keeps_its_height_where_it_is_seen() -> None:
    """A line of more than 120 dB at range 0 is laid through the middle of what is seen."""
    from mitsonar.estimation.sonar_fit import near_glow

    at: Array = np.linspace(2, 5.99, 400)
    excess: Array = np.maximum(0, 60 - 200 * (at - 2))
    result = near_glow(np.broadcast_to(10 ** (excess / 10)[None, :, None] * math.log(2), (1, 400, 8)), 1.0, at)
    assert result is not None
    assert result[0] == 120
    assert result[0] * (1 - 2.15 / result[1]) == pytest.approx(30, abs=3)


def test_a_glow_may_begin_behind_the_first_bins() -> None:
    """Some windows begin with darker bins."""
    from mitsonar.estimation.sonar_fit import near_glow

    at: Array = np.linspace(1, 4.99, 400)
    excess: Array = np.where(np.arange(400) < 8, 10.0, np.maximum(0, 60 * (1 - at / 1.5)))
    result = near_glow(np.broadcast_to(10 ** (excess / 10)[None, :, None] * math.log(2), (1, 400, 8)), 1.0, at)
    assert result == pytest.approx((60, 1.5), rel=0.02)


def test_volume_comes_back(deep: mi.Scene) -> None:
    """The bottom lies beyond the window."""
    result = fit_sonar(recorded(deep, 40.0, volume_db=-25.0, noise_level_db=-85.0))
    assert result.sonar.volume_db == pytest.approx(-25, abs=0.5)
    assert result.sonar.noise_level_db == pytest.approx(-85, abs=1)
    assert result.sonar.near_glow_db == 0
    assert any("new in every frame" in note for note in result.notes)


@pytest.mark.thorough
def test_a_bottom_is_no_volume_even_when_the_sonar_moves(deep: mi.Scene) -> None:
    """Its speckle is still, or found again at a shift, or its profile is another."""
    for step in ((0.0, 0.0), (0.0, 0.1), (0.06, 0.02)):
        assert fit_sonar(recorded(deep, 3.0, step)).sonar.volume_db is None


def test_one_frame_tells_no_volume(deep: mi.Scene) -> None:
    assert fit_sonar(recorded(deep, 40.0, volume_db=-25.0).select(slice(1))).sonar.volume_db is None
