"""What is told of a sonar's absorption: where the formula is extrapolated, and by how much water takes."""

from __future__ import annotations

import pytest

from mitsonar.acoustics.water import absorption_line, loss_notes, sonar_absorption
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import preset

LOW = Sonar.create(model="coherent", frequency_hz=4e5, beam_width_deg=1.0, pulse_m=0.02)


def test_above_1_mhz_it_is_told_once_as_a_line() -> None:
    """Of each imaging sonar; it is no warning."""
    sonar = preset("didson300")
    line = absorption_line(sonar)
    assert line == "absorption at 1,800 kHz: 1.05 dB/m one way, extrapolated: Francois and Garrison hold to 1 MHz"
    assert loss_notes(sonar) == []


def test_within_the_band_the_line_tells_the_value() -> None:
    line = absorption_line(LOW)
    assert line == f"absorption at 400 kHz: {sonar_absorption(LOW):.3g} dB/m one way"
    assert loss_notes(LOW) == []


@pytest.mark.parametrize(
    ("fields", "words"),
    [({"temperature_c": 30.0}, "temperature_c 30 lies outside"), ({"salinity_psu": 0.0}, "pure water alone")],
)
def test_water_outside_the_band_is_warned_of(fields: dict[str, float], words: str) -> None:
    for model in ("coherent", "physical"):
        (note,) = loss_notes(LOW.replace(model=model, pattern="two_way", **fields))
        assert words in note
        assert note.endswith("or give absorption_db_per_m")
    assert loss_notes(LOW.replace(absorption_db_per_m=0.1, **fields)) == []


def test_a_given_absorption_and_hard_boxes_tell_nothing() -> None:
    assert absorption_line(LOW.replace(absorption_db_per_m=0.1)) is None
    assert absorption_line(LOW.replace(model="physical")) is None
    assert absorption_line(Sonar()) is None
