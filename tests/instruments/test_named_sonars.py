"""Named sonars and YAML files: every preset is valid and sourced, every mistake is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import diffuse, floor, floor_levels, scene

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import RAYS, Sonar
from mitsonar.instruments.sounder import load_sonar, named_sonars, preset, sonar_from
from mitsonar.simulation.simulator import Simulator


@pytest.mark.parametrize("name", named_sonars())
def test_preset_is_valid_and_every_number_has_a_source(name: str) -> None:
    sonar, sources = preset(name), named_sonars()[name].sources
    assert sonar.name == name
    assert named_sonars()[name].about.strip()
    assert all(isinstance(source, str) and len(source.strip()) >= 4 for source in sources.values())
    given = {key for key, value in sonar.model_dump().items() if value != getattr(Sonar(), key)} - {"name", *RAYS}
    assert not set(RAYS) & sonar.model_fields_set  # they follow from quality
    assert given <= set(sources)  # nothing differs from the defaults without a source
    assert {"azimuth_fov_deg", "elevation_fov_deg", "beams", "range_min", "range_max", "range_bins"} <= set(sources)
    assert {key: getattr(sonar, key) for key in sources} == named_sonars()[name].values


def test_numbers_of_the_reference() -> None:
    """DIDSON 300 has 29 x 14 deg, 96 beams, 512 bins and 21 frames/s; lookdown100 is Almanza-Medina's."""
    didson, down = preset("didson300"), preset("lookdown100")
    assert (didson.azimuth_fov_deg, didson.elevation_fov_deg, didson.beams, didson.range_bins) == (29, 14, 96, 512)
    assert didson.frame_rate_hz == 21
    assert (preset("aris3000").beams, preset("aris3000").range_bins) == (128, 1344)
    assert (down.azimuth_fov_deg, down.elevation_fov_deg, down.beams, down.range_bins) == (100, 100, 1000, 512)
    assert (down.range_min, down.range_max, down.bearing) == (2.0, 6.1, "azimuth")


@pytest.mark.parametrize("name", named_sonars())
def test_beams_leave_no_direction_unseen(name: str) -> None:
    """Each beam reaches its neighbours' edges, also where axes lie at equal steps of the sine, and the ends of the fan."""
    sonar = preset(name)
    axes, half = sonar.bearing_rad, sonar.beam_width_rad / 2
    assert np.diff(axes).max() <= sonar.beam_width_rad * (1 + 1e-9)
    assert axes[-1] + half >= np.radians(sonar.azimuth_fov_deg) / 2 * (1 - 1e-9)


@pytest.mark.parametrize("name", ["aris3000", "didson300", "oculus-m1200d-2100khz"])
def test_beams_receive_width_over_spacing_times_what_arrives(variant: str, name: str) -> None:
    """Sixteen beams of a preset over a floor: their sum against the integral over the fan, each direction counted once."""
    whole = preset(name).replace(model="physical")
    few = {"beams": 16, "azimuth_fov_deg": 16 * np.degrees(whole.beam_spacing_rad), "beam_layout": "even"}
    sonar = whole.replace(**few, rays_per_beam=200, rays_across=8)
    height, pitch = 0.3 * whole.range_max, np.radians(25)
    once = floor_levels(sonar.replace(beam_width_deg=None), height, pitch, 0.5).sum()
    simulator = Simulator(scene(floor=floor(diffuse(0.5))), sonar)
    received = next(simulator.pings([[0, 0, height, pitch, 0, 0]])).levels.sum(dtype=float)
    share = sonar.beam_width_rad / sonar.beam_spacing_rad
    assert share > 1 - 1e-9
    assert received / once == pytest.approx(share, rel=2e-3)


@pytest.mark.parametrize(
    ("wrong", "near"), [("didson30", "didson300"), ("Aris3000", "aris3000"), ("gemini720is", "gemini-720is")]
)
def test_unknown_preset_names_the_nearest(wrong: str, near: str) -> None:
    with pytest.raises(MitsonarError, match=rf"unknown sonar preset '{wrong}': did you mean {near}") as caught:
        load_sonar(wrong)
    assert all(name in str(caught.value) for name in named_sonars())


def test_yaml_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("beams: 12\nrange_max: 7.5\nbearing: cone\n")
    assert load_sonar(path) == Sonar(name="mine", beams=12, range_max=7.5, bearing="cone")


def test_yaml_file_changes_a_preset(tmp_path: Path) -> None:
    path = tmp_path / "didson_near.YML"
    path.write_text("preset: didson300\nrange_min: 1.0\nname: near\n")
    assert load_sonar(str(path)) == preset("didson300").replace(range_min=1.0, name="near")


def test_sonar_from_leaves_its_argument() -> None:
    fields = {"preset": "aris3000", "beams": 64}
    assert sonar_from(fields) == preset("aris3000").replace(beams=64)
    assert fields == {"preset": "aris3000", "beams": 64}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("beams: [1", "is not YAML"),
        ("beams: 12\nrange_max: 5\nbeams: 64\n", "line 3: the key 'beams' occurs twice; leave one out"),
        ("- beams\n- 12\n", "must hold `key: value` lines"),
        ("", "must hold `key: value` lines"),
        ("12: 3\n", "must hold `key: value` lines"),
        ("beems: 12\n", "unknown sonar key beems: did you mean beams"),
        ("preset: didson30\n", "unknown sonar preset 'didson30': did you mean didson300"),
        ("preset: didson300\nbeems: 12\n", "unknown sonar key beems: did you mean beams"),
        ("preset: didson300\nrange_min: 9\n", "range_max must exceed range_min: got 5.6 m <= 9 m"),
        ("beams: many\n", "beams: .*got 'many'"),
    ],
)
def test_bad_yaml_files(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(MitsonarError, match=message) as caught:
        load_sonar(path)
    assert "\n" not in str(caught.value)


def test_a_long_name_is_cut(tmp_path: Path) -> None:
    (tmp_path / "long.yaml").write_text(f"preset: '{'9' * 5000}'\n")
    with pytest.raises(MitsonarError, match=r"unknown sonar preset '9+\.\.\.9+': known: ") as caught:
        load_sonar(tmp_path / "long.yaml")
    assert len(str(caught.value)) < 500


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match=r"cannot read sonar file .*absent\.yaml: No such file"):
        load_sonar(tmp_path / "absent.yaml")
    (tmp_path / "latin.yaml").write_bytes("name: Meßgerät".encode("latin-1"))
    with pytest.raises(MitsonarError, match="is not YAML"):
        load_sonar(tmp_path / "latin.yaml")
    (tmp_path / "sonar.txt").write_text("beams: 12")
    with pytest.raises(MitsonarError, match=r"ends in \.yaml: got .*sonar\.txt"):
        load_sonar(tmp_path / "sonar.txt")


def test_the_default_model_is_explained_where_it_is_chosen() -> None:
    """Presets of real sonars have a carrier, and are coherent; a bare sonar has none, and is physical."""
    assert Sonar().model == "physical"
    real = [preset(name) for name in named_sonars() if preset(name).frequency_hz is not None]
    assert real
    assert {sonar.model for sonar in real} == {"coherent"}
    described = Sonar.model_fields["model"].description or ""
    assert "as presets of real sonars" in described
    assert "needs a frequency_hz" in described
