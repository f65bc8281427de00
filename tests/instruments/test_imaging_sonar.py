"""The instrument: defaults, cell centres, derived numbers, and errors that name what is wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

import mitsonar
from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView
from mitsonar.instruments.sonar import Sonar

DEFAULTS = {
    "name": "custom",
    "azimuth_fov_deg": 29.0,
    "elevation_fov_deg": 14.0,
    "beams": 96,
    "range_min": 3.2,
    "range_max": 5.6,
    "range_bins": 512,
    "sound_speed": 1500.0,
    "bearing": "azimuth",
    "beam_layout": "even",
    "beam_width_deg": None,
    "jitter": None,
    "seed": 0,
    "model": "physical",
    "gain_exponent": 0,
    "frame_rate_hz": 10.0,
    "quality": "standard",
    "thesis_rays": 700,
    "rays_per_beam": 120,  # 14 deg / (tan(asin 0.2) 0.01), the next even number
    "rays_across": 4,
    "frequency_hz": None,
    "bandwidth_hz": None,
    "pulse_m": None,
    "pattern": None,
    "shading": "hann",
    "looks": 1,
    "elevation_pattern": None,
    "bounces": 1,
    "ping_groups": 1,
    "group_order": "interleaved",
    "group_interval_s": None,
    "group_overhead_s": 0.0,
    "focus_m": None,
    "scatterers_per_cell": 6.0,
    "scatterer_spacing_m": None,
    "speckle_nu": None,
    "speckle_patch_m": 0.1,
    "source_level_db": 0.0,
    "noise_level_db": None,
    "volume_db": None,
    "near_glow_db": 0.0,
    "near_glow_m": 0.5,
    "near_glow_edge_db": 0.0,
    "near_glow_spread_db": 0.0,
    "near_glow_still": 0.0,
    "absorption_db_per_m": None,
    "temperature_c": 10.0,
    "salinity_psu": 35.0,
    "water_depth_m": 10.0,
    "ph": 8.0,
    "gain_absorption": False,
    "crosstalk_db": None,
    "stripes_db": 0.0,
    "taper_db": 0.0,
    "group_stripes_db": 0.0,
    "tail_db": None,
    "tail_m": 0.1,
    "saturation_db": None,
    "array_error": 0.0,
    "detector_offset_db": None,
    "detector_spread_db": 0.0,
    "coding": None,
    "coding_db": 80.0,
    "coding_gamma": 0.5,
}


def test_fields_and_defaults() -> None:
    assert Sonar().model_dump() == DEFAULTS
    assert all(field.description for field in Sonar.model_fields.values())


@pytest.mark.parametrize(("fov", "beams"), [(29.0, 96), (100.0, 1), (30.0, 7)])
def test_beams_sit_at_cell_centres(fov: float, beams: int) -> None:
    bearing = np.degrees(Sonar(azimuth_fov_deg=fov, beams=beams).bearing_rad)
    spacing = fov / beams
    np.testing.assert_allclose(bearing, -fov / 2 + spacing * (np.arange(beams) + 0.5), atol=1e-12)
    assert np.abs(bearing).max() < fov / 2  # never on an edge
    np.testing.assert_allclose(bearing, -bearing[::-1], atol=1e-12)


def test_range_bins_are_given_by_their_centres() -> None:
    sonar = Sonar(range_min=2.0, range_max=4.0, range_bins=4)
    np.testing.assert_allclose(sonar.range_m, [2.25, 2.75, 3.25, 3.75], rtol=1e-15)
    assert sonar.bin_m == 0.5


def test_sine_layout_steps_evenly_in_the_sine() -> None:
    sonar = Sonar(azimuth_fov_deg=120, beams=16, beam_layout="sine")
    edge = np.sin(np.radians(60))
    np.testing.assert_allclose(np.sin(sonar.bearing_rad), edge * ((np.arange(16) + 0.5) / 8 - 1), atol=1e-15)
    assert np.diff(sonar.bearing_rad)[0] > np.diff(sonar.bearing_rad)[8]  # wider towards the edges


def test_physical_and_thesis_differ_in_rays_jitter_and_width() -> None:
    physical = Sonar(beams=10, rays_per_beam=20, rays_across=4, beam_width_deg=0.3)
    thesis = physical.replace(model="thesis")
    assert (physical.across, physical.columns, physical.rays, physical.jittered) == (4, 40, 800, True)
    assert (thesis.across, thesis.columns, thesis.rays, thesis.jittered) == (1, 10, 200, False)
    assert physical.beam_width_rad == pytest.approx(np.radians(0.3))
    assert thesis.beam_width_rad == thesis.beam_spacing_rad == pytest.approx(np.radians(2.9))
    assert Sonar().beam_width_rad == Sonar().beam_spacing_rad


@pytest.mark.parametrize("model", ["physical", "thesis"])
@pytest.mark.parametrize("jitter", [True, False])
def test_jitter_can_be_forced(model: str, jitter: bool) -> None:
    assert Sonar(model=model, jitter=jitter).jittered is jitter


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"range_min": 4.0, "range_max": 4.0}, r"range_max must exceed range_min: got 4 m <= 4 m"),
        ({"range_min": 5.0, "range_max": 4.0}, r"range_max must exceed range_min: got 4 m <= 5 m"),
        ({"beams": 0}, r"beams: .*greater than or equal to 1, got 0"),
        ({"beams": 2.5}, r"beams: .*integer.*2\.5"),
        ({"rays_per_beam": 0}, r"rays_per_beam: .*got 0"),
        ({"range_bins": -3}, r"range_bins: .*got -3"),
        ({"azimuth_fov_deg": 0}, r"azimuth_fov_deg: .*greater than 0, got 0"),
        ({"azimuth_fov_deg": 361}, r"azimuth_fov_deg: .*360, got 361"),
        ({"elevation_fov_deg": float("nan")}, r"elevation_fov_deg: .*got nan"),
        ({"range_max": float("inf")}, r"range_max: .*got inf"),
        ({"bearing": "sideways"}, r"bearing: .*azimuth.*cone.*got 'sideways'"),
        ({"model": "real"}, r"model: .*physical.*thesis.*got 'real'"),
        ({"gain_exponent": 5}, r"gain_exponent: .*4, got 5"),
        ({"seed": -1}, r"seed: .*got -1"),
        ({"bearing": "cone", "azimuth_fov_deg": 200}, r"cone bearing covers at most 180 deg: got azimuth_fov_deg 200"),
        ({"beam_layout": "sine", "azimuth_fov_deg": 200}, r"beam_layout sine covers at most 180 deg"),
        ({"pattern": "two_way", "azimuth_fov_deg": 200}, r"pattern covers at most 180 deg: got azimuth_fov_deg 200"),
        ({"beams": 60_000, "rays_per_beam": 900_000, "rays_across": 4}, r"at most 268,435,456 rays: got 216,000,000,000"),
    ],
)
def test_errors_say_what_and_got(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(MitsonarError, match=message) as caught:
        Sonar.create(**fields)
    assert "\n" not in str(caught.value)


def test_unknown_key_names_the_nearest() -> None:
    with pytest.raises(MitsonarError, match=r"unknown sonar key azimut_fov_deg: did you mean azimuth_fov_deg"):
        Sonar.create(azimut_fov_deg=20)
    with pytest.raises(MitsonarError, match=r"unknown sonar key qqq: known: .*range_bins"):
        Sonar.create(qqq=20)


def test_replace_checks_again_and_leaves_the_original() -> None:
    sonar = Sonar(beams=5)
    assert sonar.replace(beams=6).beams == 6
    assert sonar.beams == 5
    with pytest.raises(MitsonarError, match="range_max must exceed range_min"):
        sonar.replace(range_min=9.0)
    with pytest.raises(ValidationError):
        sonar.beams = 7  # type: ignore[misc]


@pytest.mark.parametrize(
    "fields", [{"azimuth_fov_deg": 180, "beam_width_deg": 10}, {"azimuth_fov_deg": 60, "beam_width_deg": 200}]
)
def test_a_cone_ends_at_ninety_degrees(fields: dict[str, float]) -> None:
    with pytest.raises(MitsonarError, match="beams end at 90 deg"):
        Sonar.create(bearing="cone", **fields)


def test_patterns_and_coding_follow_from_the_model() -> None:
    coherent = Sonar.create(model="coherent", frequency_hz=1.8e6)
    assert (coherent.beam_pattern, coherent.vertical_pattern, coherent.value_coding) == ("two_way", "two_way", "dB")
    assert (Sonar().beam_pattern, Sonar().vertical_pattern, Sonar().value_coding) == ("box", "box", "linear")
    thesis = Sonar.create(model="thesis", pattern="two_way")
    assert (thesis.beam_pattern, thesis.vertical_pattern) == ("box", "box")
    assert Sonar().resolution_m == Sonar().bin_m
    assert Sonar(pulse_m=0.02).resolution_m == 0.02
    assert Sonar(bandwidth_hz=50e3).resolution_m == pytest.approx(1.44 * 1500 / 2 / 50e3, rel=1e-3)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({}, "needs the carrier"),
        ({"frequency_hz": 1e6, "azimuth_fov_deg": 180}, "at most 170 x 170 deg"),
        ({"frequency_hz": 1.8}, "give it in Hz, at least 1.15e"),  # MHz taken for Hz
        ({"frequency_hz": 1e6, "pattern": "box"}, "give pattern receive or two_way"),
        ({"frequency_hz": 1e6, "azimuth_fov_deg": 160, "beams": 1}, "at least half a wavelength"),
        ({"frequency_hz": 1e6, "pulse_m": 0.1, "bandwidth_hz": 1e4}, "give one of them"),
    ],
)
def test_a_coherent_sonar_that_cannot_be_is_refused(fields: dict[str, Any], words: str) -> None:
    with pytest.raises(MitsonarError, match=words):
        Sonar.create(model="coherent", **fields)


@pytest.mark.parametrize("shading", ["uniform", "hann", "taylor"])
@pytest.mark.parametrize("model", ["coherent", "physical"])
def test_the_widest_beam_that_is_told_would_do(model: str, shading: str) -> None:
    """An aperture below half a wavelength is refused with the beam width that just needs one."""
    fields: dict[str, Any] = {"model": model, "frequency_hz": 1e6, "pattern": "two_way", "shading": shading, "beams": 1}
    with pytest.raises(MitsonarError, match=r"takes 0\.\d+; give beam_width_deg below ([\d.]+)") as caught:
        Sonar.create(**fields, azimuth_fov_deg=160.0, beam_width_deg=160.0)
    message = float(str(caught.value).split("below ")[1].split()[0].rstrip("."))
    assert Sonar.create(**fields, azimuth_fov_deg=100.0, beam_width_deg=message).aperture.length == pytest.approx(
        0.5, rel=0.01
    )
    assert Sonar.create(**{**fields, "model": "thesis"}, azimuth_fov_deg=160.0).beam_pattern == "box"


def test_the_title_names_an_instrument_or_says_that_it_has_no_name() -> None:
    assert Sonar().title == "unnamed sonar"
    assert Sonar(name="rov").title == "rov"
    assert ChannelSonar().title == "unnamed channel sonar"


@pytest.mark.parametrize(
    ("kind", "given", "words"),
    [
        (mitsonar.Sonar, {"beamz": 3}, "unknown sonar key beamz: did you mean beams"),
        (mitsonar.Sonar, {"beams": "many"}, "sonar beams: input should be a valid integer.* got 'many'"),
        (mitsonar.ChannelSonar, {"carier_hz": 8e4}, "unknown channel sonar key carier_hz: did you mean carrier_hz"),
        (mitsonar.Sounder, {"kind": "dvl"}, "instrument lacks fan"),
        (mitsonar.SeaSurface, {"wind": 3}, "unknown sea-surface key wind: did you mean wind_m_s"),
        (NoiseModel, {"mean": 2}, "noise mean: input should be less than or equal to 1, got 2"),
        (FieldOfView, {"tilt": 2}, "unknown field of view key tilt: did you mean tilt_deg"),
    ],
)
def test_a_class_answers_a_mistake_as_create_does(kind: Any, given: dict[str, object], words: str) -> None:
    """One sentence of a MitsonarError, which is a ValueError as pydantic's own is."""
    with pytest.raises(MitsonarError, match=words) as caught:
        kind(**given)
    assert isinstance(caught.value, ValueError)
