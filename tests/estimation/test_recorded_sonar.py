"""Sonars of recordings: axes that are even in the angle or its sine come back, and what is neither is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import Command

from mitsonar.errors import MitsonarError
from mitsonar.estimation.sonar_fit import NOISE_FIELDS, as_instrument
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.records.frames import SonarFrames

OCULUS = Path(__file__).resolve().parents[2].parent / "shared/data/real/oculus-m1200d-three-pings/three_pings_8bit.raw"


def frames_of(sonar: Sonar) -> SonarFrames:
    image = np.zeros((1, sonar.range_bins, sonar.beams), np.uint8)
    return SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar)


@pytest.mark.parametrize("layout", ["even", "sine"])
def test_the_axes_of_a_sonar_come_back(layout: str) -> None:
    real = Sonar.create(beams=64, azimuth_fov_deg=80, beam_layout=layout, range_min=0.5, range_max=4, range_bins=200)
    message = replace(frames_of(real), sonar=Sonar(beams=64, range_bins=200))
    result, notes = as_instrument(message)
    assert result.sonar.beam_layout == layout
    np.testing.assert_allclose(result.sonar.bearing_rad, real.bearing_rad, atol=1e-12)
    np.testing.assert_allclose(result.sonar.range_m, real.range_m, atol=1e-12)
    assert not notes


def test_beams_that_are_neither_are_told_by_how_much() -> None:
    frames = frames_of(Sonar(beams=64))
    bent = frames.bearing_rad + np.radians(0.3) * np.sin(np.linspace(0, 2 * np.pi, 64))
    _, (note,) = as_instrument(replace(frames, bearing_rad=bent))
    assert note.startswith("the beams are not evenly spaced: up to 0.2")


def test_a_fan_off_the_axis_is_told() -> None:
    frames = frames_of(Sonar(beams=64))
    result, (note,) = as_instrument(replace(frames, bearing_rad=frames.bearing_rad + np.radians(2)))
    assert "centred on 2 deg" in note
    np.testing.assert_allclose(result.sonar.bearing_rad, frames.sonar.bearing_rad, atol=1e-12)


@pytest.mark.parametrize("size", [{"beams": 1, "range_bins": 64}, {"beams": 64, "range_bins": 1}])
def test_one_beam_or_bin_is_refused(size: dict[str, int]) -> None:
    with pytest.raises(MitsonarError, match="needs two or more bins and beams: got"):
        as_instrument(frames_of(Sonar(**size)))


@pytest.mark.skipif(not OCULUS.exists(), reason="needs the recordings of ../shared/data/real")
def test_an_oculus_becomes_a_sonar_and_its_noise(mitsonar: Command, tmp_path: Path) -> None:
    sonar, noise = tmp_path / "sonar.yaml", tmp_path / "noise.yaml"
    done = mitsonar("sonar", "from-recording", OCULUS, "-o", sonar, "--noise", noise)
    assert done.returncode == 0, done.stderr
    result = load_sonar(sonar)
    assert (result.beams, result.range_bins, result.beam_layout, result.model) == (256, 703, "sine", "coherent")
    assert np.degrees(result.bearing_rad[[0, -1]]) == pytest.approx([-30, 30], abs=0.01)
    assert result.noise_level_db is None
    together = load_sonar(f"{sonar},{noise}")
    assert together.noise_level_db == pytest.approx(-108, abs=2)
    fields = {name for name, value in together.model_dump().items() if value != getattr(result, name)}
    assert fields <= set(NOISE_FIELDS)
    over = load_sonar(f"didson300,{noise}")
    assert (over.noise_level_db, over.beams, over.name) == (together.noise_level_db, 96, "didson300")
    again = mitsonar("sonar", "from-recording", OCULUS, "-o", sonar, "--noise", noise)
    assert again.returncode == 2
    assert "--overwrite" in again.stderr
