"""Water: absorption and speed of sound against published numbers, a second formula, and their bands."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mitsonar.acoustics.water import (
    Formula,
    Water,
    absorption_db_per_m,
    absorption_line,
    absorption_warning,
    loss_notes,
    pressure_bar,
    sonar_absorption,
    sound_speed_m_s,
    sound_speed_warning,
    unesco_speed_m_s,
)
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import preset

SEA = Water(temperature_c=10, salinity_psu=35, depth_m=0, ph=8)
FRESH = Water(temperature_c=15, salinity_psu=0)


@pytest.mark.parametrize(("mhz", "db_per_km"), [(0.1, 33.6), (0.3, 73.1), (1.0, 358.6)])
def test_numbers_of_francois_and_garrison(mhz: float, db_per_km: float) -> None:
    assert absorption_db_per_m(mhz * 1e6, SEA) * 1000 == pytest.approx(db_per_km, abs=0.1)


@pytest.mark.parametrize(
    ("mhz", "sea", "fresh"),
    [(0.9, 0.30, 0.21), (1.2, 0.50, 0.37), (1.8, 1.05, 0.84), (2.1, 1.42, 1.14), (3.0, 2.84, 2.34)],
)
def test_numbers_of_imaging_sonars(mhz: float, sea: float, fresh: float) -> None:
    """In dB/m at 10 m depth in the sea, and in fresh water of 15 deg C."""
    assert absorption_db_per_m(mhz * 1e6, SEA.model_copy(update={"depth_m": 10.0})) == pytest.approx(sea, abs=0.006)
    assert absorption_db_per_m(mhz * 1e6, FRESH) == pytest.approx(fresh, abs=0.006)


@pytest.mark.parametrize("temperature", [2.0, 10.0, 20.0])
@pytest.mark.parametrize("depth", [0.0, 1000.0])
def test_two_formulas_agree_within_ten_percent(temperature: float, depth: float) -> None:
    water = Water(temperature_c=temperature, depth_m=depth)
    frequency = np.geomspace(1e3, 1e6, 40)
    ratio = absorption_db_per_m(frequency, water, "ainslie-mccolm") / absorption_db_per_m(frequency, water)
    assert np.abs(ratio - 1).max() < 0.1, ratio


def test_pure_water_goes_with_the_square_of_the_frequency() -> None:
    """Its viscous absorption is 25e-15 Np s^2/m at 20 deg C (Pinkerton, 1949), within 2 %."""
    pure = Water(temperature_c=20, salinity_psu=0)
    assert absorption_db_per_m(3e6, pure) == pytest.approx(9 * absorption_db_per_m(1e6, pure), rel=1e-12)
    assert absorption_db_per_m(1e6, pure) == pytest.approx(25.3e-15 * 1e12 * 20 / math.log(10), rel=0.02)


@pytest.mark.parametrize("formula", ["francois-garrison", "ainslie-mccolm"])
def test_absorption_has_no_step_and_never_falls(formula: Formula) -> None:
    frequency = np.geomspace(100, 5e6, 400)
    assert (np.diff(absorption_db_per_m(frequency, SEA, formula)) > 0).all()
    warm = [absorption_db_per_m(1e6, Water(temperature_c=t), formula) for t in (19.999, 20.001)]
    assert warm[0] == pytest.approx(warm[1], rel=2e-3)
    salty = [absorption_db_per_m(1e5, Water(salinity_psu=s), formula) for s in (0.0, 1e-9)]
    assert salty[0] == pytest.approx(salty[1], rel=1e-5)


@pytest.mark.learn
@pytest.mark.parametrize("formula", ["francois-garrison", "ainslie-mccolm"])
def test_torch_gives_the_bits_of_numpy(formula: Formula) -> None:
    import torch

    frequency = np.geomspace(100, 5e6, 1001)
    result = absorption_db_per_m(torch.asarray(frequency), SEA, formula)
    np.testing.assert_array_equal(result.numpy(), absorption_db_per_m(frequency, SEA, formula))


def test_dr_jit_gives_the_bits_of_numpy(variant: str) -> None:
    import mitsuba as mi

    frequency = np.geomspace(100, 5e6, 1001)
    result = absorption_db_per_m(mi.Float64(frequency), SEA)
    np.testing.assert_array_equal(np.asarray(result), absorption_db_per_m(frequency, SEA))


# ---------------------------------------------------------------- speed


def test_check_value_of_unesco() -> None:
    """Fofonoff and Millard (1983): 1731.995 m/s at 40 deg C, 40 psu, 10,000 dbar; 7,500 dbar at 7,321.45 m and 30 deg."""
    assert unesco_speed_m_s(40, 40, 1000) == pytest.approx(1731.995, abs=5e-4)
    assert pressure_bar(7321.45, latitude_deg=30) == pytest.approx(750, abs=0.01)


def mackenzie(t: float, s: float, d: float) -> float:
    """Mackenzie, J. Acoust. Soc. Am. 70 (1981), 807-812: 2..30 deg C, 25..40 psu, to 8,000 m."""
    warm = 1448.96 + 4.591 * t - 5.304e-2 * t**2 + 2.374e-4 * t**3
    return warm + 1.340 * (s - 35) + 1.630e-2 * d + 1.675e-7 * d**2 - 1.025e-2 * t * (s - 35) - 7.139e-13 * t * d**3


def test_speed_agrees_with_mackenzie() -> None:
    assert mackenzie(25, 35, 1000) == pytest.approx(1550.744, abs=5e-4)  # his check value
    for t in (2.0, 10.0, 25.0):
        for s in (30.0, 35.0):
            for d in (0.0, 100.0, 1000.0):
                water = Water(temperature_c=t, salinity_psu=s, depth_m=d)
                assert sound_speed_m_s(water) == pytest.approx(mackenzie(t, s, d), abs=0.7), (t, s, d)


def test_speed_in_fresh_water() -> None:
    """Del Grosso and Mader (1972): 1482.343 m/s in pure water of 20 deg C; theirs and ours differ by 0.02 m/s."""
    assert sound_speed_m_s(Water(temperature_c=20, salinity_psu=0)) == pytest.approx(1482.343, abs=0.03)


# ---------------------------------------------------------------- bands and mistakes


@pytest.mark.parametrize(
    ("frequency", "fields", "formula", "said"),
    [
        (100e3, {}, "francois-garrison", None),
        (700e3, {"salinity_psu": 0.0}, "francois-garrison", None),
        (1.8e6, {}, "francois-garrison", "1,800 kHz is extrapolated: Francois and Garrison hold to 1,000 kHz"),
        (1.8e6, {}, "ainslie-mccolm", "Ainslie and McColm hold to 1,000 kHz"),
        (150.0, {}, "francois-garrison", "hold from 0.2 kHz"),
        (150.0, {}, "ainslie-mccolm", None),
        (100e3, {"salinity_psu": 0.0}, "francois-garrison", "in fresh water is that of pure water alone"),
        (100e3, {"temperature_c": 30.0}, "francois-garrison", "temperature_c 30 lies outside -2..22"),
        (700e3, {"temperature_c": 30.0}, "francois-garrison", None),
        (100e3, {"salinity_psu": 20.0}, "francois-garrison", "salinity_psu 20 lies outside 30..35"),
        (100e3, {"salinity_psu": 20.0}, "ainslie-mccolm", None),
        (100e3, {"depth_m": 5000.0}, "francois-garrison", "depth_m 5000 lies outside 0..3500"),
        (5e3, {"ph": 7.0}, "ainslie-mccolm", "ph 7 lies outside 7.7..8.3"),
        (100e3, {"ph": 7.0}, "ainslie-mccolm", None),
    ],
)
def test_what_lies_outside_a_band_is_said(
    frequency: float, fields: dict[str, float], formula: Formula, said: str | None
) -> None:
    result = absorption_warning(frequency, Water(**fields), formula)
    assert result is None if said is None else (said in str(result)), result


def test_band_of_the_speed() -> None:
    assert sound_speed_warning(FRESH) is None
    assert "temperature_c -2 lies outside 0..40" in str(sound_speed_warning(Water(temperature_c=-2)))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"temperature_c": 99}, "water temperature_c: input should be less than or equal to 40, got 99"),
        ({"salinity_psu": -1}, "water salinity_psu: input should be greater"),
        ({"ph": float("nan")}, "water ph: input should be a finite number"),
        ({"temprature_c": 3}, "unknown water key temprature_c: did you mean temperature_c"),
    ],
)
def test_a_mistake_is_one_sentence(fields: dict[str, float], message: str) -> None:
    with pytest.raises(MitsonarError, match=message) as caught:
        Water.create(**fields)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("frequency", [0, -1.0, float("nan"), float("inf")])
def test_no_frequency(frequency: float) -> None:
    with pytest.raises(MitsonarError, match="a frequency must be a finite number of Hz above 0"):
        absorption_db_per_m(frequency, SEA)


def test_unknown_formula() -> None:
    for ask in (absorption_db_per_m, absorption_warning):
        with pytest.raises(MitsonarError, match="known: francois-garrison, ainslie-mccolm; did you mean ainslie-mccolm"):
            ask(1e6, SEA, "ainslie")  # type: ignore[arg-type]


# ---------------------------------------------------------------- what is told of a sonar's absorption: where the formula i

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
