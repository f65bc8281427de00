"""Beams, pulse and losses of the model physical: energy in closed form, and the mean of coherent pings."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import Array, diffuse, essence, floor, scene, sphere

from mitsonar.acoustics.water import sonar_absorption
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import named_sonars, preset
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

POSE = np.array([0, 0, 2.5, math.radians(35), 0, 0])
DIDSON = Sonar.create(
    **{"bearing": "cone", "azimuth_fov_deg": 14.5, "beams": 48, "beam_width_deg": 0.3, "frequency_hz": 1.8e6},
    **{"pattern": "two_way", "absorption_db_per_m": 0.4, "range_min": 3.4, "range_max": 6.0, "range_bins": 384},
)


@pytest.fixture(scope="module")
def flat(variant: str) -> mi.Scene:
    return scene(floor=floor(diffuse(0.5)))


def levels(loaded: mi.Scene, sonar: Sonar, pose: Array = POSE) -> Array:
    result: Array = next(iter(Simulator(loaded, sonar).pings(pose))).levels[0].astype(float)
    return result


@pytest.mark.parametrize("pattern", essence(["two_way", "receive"], "two_way"))
def test_it_is_the_mean_of_coherent_pings(flat: mi.Scene, pattern: str) -> None:
    """Of 16 places, over all beams: bins joined by 16 within 0.4 dB, skirts included; all of it within 0.1 dB."""
    sonar = DIDSON.replace(pattern=pattern, gain_exponent=2)
    expected = levels(flat, sonar).mean(axis=1)
    coherent = Simulator(flat, sonar.replace(model="coherent"))
    shifts = np.arange(16)[:, None] * np.array([0.7, 0.2, 0, 0, 0, 0])
    result = np.mean([pings.levels[0] for pings in coherent.pings(POSE + shifts)], axis=(0, 2))
    assert 10 * np.log10(result.sum() / expected.sum()) == pytest.approx(0, abs=0.1)
    ratio = result.reshape(-1, 16).sum(axis=1) / expected.reshape(-1, 16).sum(axis=1)
    assert np.abs(10 * np.log10(ratio)).max() < 0.4


@pytest.mark.thorough
@pytest.mark.parametrize("layout", ["even", "sine"])
def test_a_wide_fan_is_the_mean_of_coherent_pings_at_all_bearings(flat: mi.Scene, layout: str) -> None:
    """Beams broaden to the sides, by the cosine of the bearing, 0.42 at the edge; eighths of the fan within 0.5 dB."""
    sonar = DIDSON.replace(
        azimuth_fov_deg=130, beams=64, beam_width_deg=2.0, beam_layout=layout, elevation_fov_deg=40, gain_exponent=2
    )
    pose = np.array([0, 0, 2.0, math.radians(25), 0, 0])
    expected = levels(flat, sonar, pose)
    coherent = Simulator(flat, sonar.replace(model="coherent"))
    shifts = np.arange(12)[:, None] * np.array([0.7, 0.2, 0, 0, 0, 0])
    result = np.mean([pings.levels[0] for pings in coherent.pings(pose + shifts)], axis=0)
    ratio = result.reshape(384, 8, 8).sum(axis=(0, 2)) / expected.reshape(384, 8, 8).sum(axis=(0, 2))
    assert np.abs(10 * np.log10(ratio)).max() < 0.5


@pytest.mark.parametrize("name", essence(sorted(set(named_sonars()) - {"lookdown100"}), "didson300"))
def test_the_sonar_equation_holds_for_every_preset(name: str) -> None:
    """A Lambert sphere at 1 to 40 m: SL - 40 log R - 2 alpha R + 10 log(2 pi C a^2 / 3), within 0.5 dB.

    The echo's energy, summed over bins and beams, counts in each beam that hears it: width over spacing.
    """
    base = preset(name)
    places = [r for r in (1.0, 2.0, 4.4, 8.0, 20.0, 39.0) if base.range_min + 0.5 < r < base.range_max - 0.5]
    assert places
    beams = max(8, round(12 * base.beams / base.azimuth_fov_deg))
    narrow = {"ping_groups": 1, "azimuth_fov_deg": 12.0, "beams": beams, "beam_layout": "even"}
    sonar = base.replace(
        model="physical", frequency_hz=base.frequency_hz or 1e6, pattern="two_way", gain_exponent=0, gain_absorption=False,
        beam_width_deg=math.degrees(base.beam_width_rad), rays_per_beam=900, rays_across=16, **narrow,
    )  # fmt: skip
    for r in places:
        radius = 0.02 * r
        loaded = scene(target=sphere((0, r, 0), radius, diffuse(0.5)))
        energy = levels(loaded, sonar, np.zeros(6)).sum()
        crowd = sonar.beam_width_rad / sonar.beam_spacing_rad
        level = 200 + 10 * math.log10(energy / crowd)
        front = r - radius  # the near side is nearest: the mean of 1 / R^4 over the cap is a little above that of the middle
        strength = 10 * math.log10(2 * math.pi * 0.5 * radius**2 / 3)
        truth = [200 - 40 * math.log10(x) - 2 * sonar_absorption(sonar) * x + strength for x in (r, front)]
        assert truth[0] - 0.5 <= level <= truth[1] + 0.5, f"{name} at {r} m"


def test_absorption_follows_from_the_water() -> None:
    sonar = DIDSON.replace(absorption_db_per_m=None)
    fresh = sonar.replace(salinity_psu=0.0, temperature_c=15.0)
    assert sonar_absorption(sonar) == pytest.approx(1.05, abs=0.03)  # 1.8 MHz, 10 deg C, 35, 10 m
    assert sonar_absorption(fresh) == pytest.approx(0.84, abs=0.03)
    assert sonar_absorption(sonar.replace(pattern=None)) == 0


def test_all_effects_off_are_the_hard_boxes(flat: mi.Scene) -> None:
    """No pattern: the bits of a sonar that was never told of patterns."""
    plain = Sonar(bearing="cone", beams=16, range_bins=64)
    message = plain.replace(frequency_hz=1.8e6, shading="taylor", source_level_db=200.0, speckle_nu=2.0, temperature_c=4.0)
    np.testing.assert_array_equal(levels(flat, message), levels(flat, plain))


def test_labels_lie_where_the_boxes_are(flat: mi.Scene) -> None:
    frames = Simulator(flat, DIDSON).render([POSE], labels=True)
    boxes = Simulator(flat, DIDSON.replace(pattern=None, absorption_db_per_m=None)).render([POSE], labels=True)
    assert frames.image.shape == boxes.image.shape
    assert frames.shape_id is not None
    assert boxes.shape_id is not None
    lit = boxes.shape_id[0] == 0
    assert (frames.shape_id[0][lit] == 0).mean() > 0.99


def test_absorption_without_a_pattern_is_refused(flat: mi.Scene) -> None:
    with pytest.raises(MitsonarError, match="give pattern two_way"):
        Simulator(flat, Sonar(absorption_db_per_m=0.3))


def test_bins_before_the_window_begin_at_the_sonar_at_least() -> None:
    """75 bins of 1.6 / 300 m are 0.4 m and, by rounding, 6e-17 m more."""
    from mitsonar.simulation.models.physical import ExpectedFormer

    sonar = DIDSON.replace(range_min=0.4, range_max=2.0, range_bins=300, pulse_m=0.2, quality="draft", beams=4)
    former = ExpectedFormer(sonar)
    assert former.extra_bins[0] == 75
    assert former.traced.range_min == 0
