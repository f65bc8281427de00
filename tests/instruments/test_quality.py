"""Rays by the accuracy wanted: promises hold in closed form, explicit numbers win, the model thesis keeps its own."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from helpers import diffuse, essence, floor, floor_levels, scene, slope

from mitsonar.config.data import load_recipe
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import (
    FAR_GRAZING_RAD,
    QUALITIES,
    RAYS,
    Quality,
    Sonar,
    measured_errors,
    rays_across,
    rays_over_elevation,
)
from mitsonar.instruments.sounder import load_sonar, named_sonars, preset, sonar_from
from mitsonar.simulation.simulator import Simulator

PINGS = 4
BEAMS = 12

PROMISED = {"draft": 6.0, "standard": 1.0, "fine": 0.2}
"""Most that plain ground may err by with any preset, in % rms a ping."""


def test_the_names_are_one_list() -> None:
    assert tuple(QUALITIES) == get_args(get_args(Quality)[0])


def numbers(sonar: Sonar) -> tuple[int, int]:
    """Rays over elevation and across."""
    return sonar.rays_per_beam, sonar.rays_across


def plain_error(loaded: Any, sonar: Sonar) -> float:
    """Relative rms error of single pings on the reference ground, against the closed form; the ends left out."""
    height = sonar.range_max * np.sin(FAR_GRAZING_RAD)
    pitch = FAR_GRAZING_RAD + np.radians(sonar.elevation_fov_deg) / 2
    truth = floor_levels(sonar, height, pitch, 0.5)
    lit = truth > 0
    for shift in range(-8, 9):  # a beam's width changes where the field of view ends by up to four bins
        lit &= np.roll(truth > 0, shift, axis=0)
    simulator = Simulator(loaded, sonar)
    pings = [next(simulator.pings([[0, 0, height, pitch, 0, 0]], first=k)).levels[0] for k in range(PINGS)]
    return float(np.sqrt(np.mean([(ping[lit] / truth[lit] - 1) ** 2 for ping in pings])))


# ---------------------------------------------------------------- what is promised


@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("name", essence(["didson300", "oculus-m1200d-2100khz"], "didson300"))
def test_a_plain_floor_errs_by_what_is_printed(variant: str, name: str, quality: str) -> None:
    """The table was measured against many rays; this is against the integral. Not above it, and not far below."""
    whole = preset(name).replace(model="physical", quality=quality)
    few = whole.replace(beams=BEAMS, beam_width_deg=np.degrees(whole.beam_width_rad))
    assert numbers(few) == numbers(whole)
    stated = measured_errors()[1][name][quality].plain_percent / 100
    error = plain_error(scene(floor=floor(diffuse(0.5), 500.0)), few)
    assert stated / 2 < error < stated * 1.02, f"{100 * error:.3g} % where {100 * stated:.3g} % is stated"


def test_the_table_is_of_these_presets_and_these_rays() -> None:
    """After a change of the rule or a preset, run `python benchmarks/bench_quality.py --write`."""
    about, measured = measured_errors()
    assert about.strip()
    assert list(measured) == list(named_sonars())
    for name, rows in measured.items():
        assert list(rows) == list(QUALITIES)
        for quality, row in rows.items():
            assert (row.rays_per_beam, row.rays_across) == numbers(
                preset(name).replace(model="physical", quality=quality)
            ), (name, quality)


def test_each_quality_is_as_good_as_its_word() -> None:
    for name, rows in measured_errors()[1].items():
        for quality, row in rows.items():
            assert row.plain_percent <= PROMISED[quality], (name, quality)
        for better, worse in (("standard", "draft"), ("fine", "standard")):
            assert rows[better].plain_percent < rows[worse].plain_percent / 3
            assert rows[better].textured_percent < rows[worse].textured_percent
            assert rows[better].still_correlation > rows[worse].still_correlation - 0.05
        assert rows["standard"].textured_percent <= 40
        assert rows["fine"].textured_percent <= 20


@pytest.mark.parametrize("quality", ["standard", "fine"])
def test_pings_of_a_resting_sonar_differ_as_much_as_is_printed(variant: str, quality: str) -> None:
    """Over 15 mm cells the rays' jitter makes pings differ; without jitter they are the same."""
    whole = preset("didson300").replace(model="physical", quality=quality)
    sonar = whole.replace(beams=BEAMS, beam_width_deg=np.degrees(whole.beam_width_rad))
    cells = {"type": "cell_noise", "coordinates": "position", "cell_size": 0.015}
    rough, height = scene(floor=floor(diffuse(cells), 500.0)), sonar.range_max * np.sin(FAR_GRAZING_RAD)
    pose = [[0, 0, height, FAR_GRAZING_RAD + np.radians(sonar.elevation_fov_deg) / 2, 0, 0]]
    plain = floor_levels(sonar, height, pose[0][3], 0.5)
    lit = plain > 0.2 * plain.max()
    for jitter, expected in ((True, measured_errors()[1]["didson300"][quality].still_correlation), (False, 1.0)):
        simulator = Simulator(rough, sonar.replace(jitter=jitter))
        pings = [next(simulator.pings(pose, first=ping)).levels[0][lit] / plain[lit] for ping in range(PINGS)]
        result = np.corrcoef(pings)[np.triu_indices(PINGS, 1)].mean()
        assert result == pytest.approx(expected, abs=0.05)


@pytest.mark.thorough
def test_errors_fall_as_the_law_says(variant: str) -> None:
    """Plain: faster than 1 / rays over elevation. Textured: as 1 / sqrt(rays across) while each reads a cell of its own."""
    plain = scene(floor=floor(diffuse(0.5), 500.0))
    wide = preset("oculus-m1200d-1200khz").replace(model="physical", beams=1, azimuth_fov_deg=2, rays_across=1)
    counts = [50, 100, 200, 400]
    assert slope(counts, [plain_error(plain, wide.replace(rays_per_beam=count)) for count in counts]) < -1.0

    cells = {"type": "cell_noise", "coordinates": "position", "cell_size": 0.015}
    rough = scene(floor=floor(diffuse(cells), 500.0))
    height, pitch = wide.range_max * 0.2, FAR_GRAZING_RAD + np.radians(wide.elevation_fov_deg) / 2
    spread = []
    for across in (1, 2, 4, 8):
        simulator = Simulator(rough, wide.replace(rays_per_beam=60, rays_across=across))
        pings = [next(simulator.pings([[0, 0, height, pitch, 0, 0]], first=k)).levels[0] for k in range(40)]
        levels = np.array(pings)[:, 500:900]
        spread.append(np.sqrt(levels.var(axis=0, ddof=1).mean()) / levels.mean())
    assert spread[0] == pytest.approx(1 / np.sqrt(3), rel=0.1)  # evenly spread reflectivities: std over mean
    assert slope([1, 2, 4, 8], spread) == pytest.approx(-0.5, abs=0.06)


# ---------------------------------------------------------------- the rule


def test_rays_follow_from_geometry() -> None:
    """14 deg / tan(asin 0.2) is 1.197: over 3 %, 1 % and 0.25 %, the next even number."""
    elevation = np.radians(14)
    assert [rays_over_elevation(quality, elevation) for quality in QUALITIES] == [40, 120, 480]
    thin = np.radians(0.01)
    assert [rays_across(quality, thin, np.radians(30), 5.0) for quality in QUALITIES] == [1, 1, 1]
    narrow = np.radians(0.2)  # 17 mm at 5 m: every 7.5 and 3.75 mm
    assert [rays_across(quality, narrow, np.radians(30), 5.0) for quality in QUALITIES] == [1, 3, 5]
    broad = np.radians(10)  # the range changes by 0.1745 tan 60 deg across the beam at the edge: 6, 2 and 0.5 % a ray
    assert [rays_across(quality, broad, np.radians(120), 20.0) for quality in QUALITIES] == [6, 16, 61]
    assert rays_across("fine", 2 * np.pi, 2 * np.pi, 10.0) == 4096


@pytest.mark.parametrize("quality", QUALITIES)
def test_rays_over_elevation_are_even(quality: str) -> None:
    """Segments halve the field of view."""
    assert all(rays_over_elevation(quality, np.radians(fov)) % 2 == 0 for fov in np.linspace(0.01, 180, 500))


def test_rays_follow_again_where_the_geometry_changes() -> None:
    sonar = Sonar(quality="draft")
    assert sonar.replace(elevation_fov_deg=28).rays_per_beam == 80
    assert sonar.replace(quality="standard") == Sonar()
    assert pickle.loads(pickle.dumps(sonar)).replace(elevation_fov_deg=28).rays_per_beam == 80


def test_a_record_keeps_the_numbers_that_it_was_made_with() -> None:
    """A stored sonar has all numbers: another rule of a later version does not change it."""
    stored = Sonar.create(**preset("aris3000").model_dump())
    assert stored == preset("aris3000")
    assert set(RAYS) <= stored.model_fields_set
    assert stored.replace(elevation_fov_deg=30).rays_per_beam == stored.rays_per_beam


# ---------------------------------------------------------------- explicit numbers win


def test_explicit_numbers_win_over_quality(tmp_path: Path) -> None:
    assert numbers(Sonar(quality="fine", rays_per_beam=33)) == (33, 8)
    assert numbers(Sonar(quality="fine", rays_across=3)) == (480, 3)
    assert numbers(Sonar(quality="fine", rays_per_beam=33, rays_across=3)) == (33, 3)
    assert numbers(sonar_from({"preset": "didson300", "quality": "draft", "rays_per_beam": 33})) == (33, 1)
    path = tmp_path / "mine.yaml"
    path.write_text("preset: didson300\nquality: fine\nrays_across: 5\n")
    assert numbers(load_sonar(path)) == (480, 5)
    assert numbers(load_sonar(path).replace(beams=10)) == (480, 5)


def test_a_quality_takes_the_place_of_earlier_numbers() -> None:
    """What is said later is meant: `--quality draft` for a scene or a file that states its rays."""
    stated = Sonar(rays_per_beam=33, rays_across=3)
    assert numbers(stated.replace(quality="draft")) == (40, 1)
    assert numbers(stated.replace(quality="draft", rays_per_beam=50)) == (50, 1)
    assert numbers(stated.replace(range_max=6)) == (33, 3)


@pytest.mark.parametrize("name", ["rocky-field-physical", "ship-hull-physical"])
def test_shipped_recipes_of_the_physical_model_state_their_rays(name: str) -> None:
    """Their pixels do not follow the default."""
    assert numbers(load_recipe(name).instrument) == (200, 8)


@pytest.mark.parametrize(("wrong", "near"), [("fien", "fine"), ("Standard", "standard"), ("drafts", "draft")])
def test_an_unknown_quality_names_the_nearest(wrong: str, near: str) -> None:
    message = rf"unknown quality '{wrong}': did you mean {near}\? Known: draft, standard, fine"
    with pytest.raises(MitsonarError, match=message):
        Sonar.create(quality=wrong)
    with pytest.raises(MitsonarError, match="unknown quality 3"):
        sonar_from({"preset": "didson300", "quality": 3})
    with pytest.raises(MitsonarError, match=r"unknown quality \['fine'\]"):
        sonar_from({"preset": "didson300", "quality": ["fine"]})


def test_an_unknown_quality_in_xml_names_the_nearest(variant: str) -> None:
    import mitsuba as mi

    assert mi.load_dict({"type": "imaging_sonar", "quality": "fine"}).sonar == Sonar(quality="fine")
    with pytest.raises(RuntimeError, match="unknown quality 'fien': did you mean fine"):
        mi.load_dict({"type": "imaging_sonar", "quality": "fien"})


# ---------------------------------------------------------------- the model thesis


@pytest.mark.parametrize("quality", QUALITIES)
def test_the_thesis_model_keeps_its_own_numbers(quality: str) -> None:
    for name in named_sonars():
        rays = 1000 if name == "lookdown100" else 700
        thesis = preset(name).replace(model="physical", quality=quality).replace(model="thesis")
        assert (thesis.rays_per_beam, thesis.across, thesis.columns) == (rays, 1, thesis.beams)
    assert Sonar(model="thesis", rays_per_beam=350).replace(quality=quality).rays_per_beam == 350
    assert Sonar(quality=quality).replace(model="thesis").replace(model="physical") == Sonar(quality=quality)


def test_the_thesis_model_is_untouched_bit_for_bit(variant: str) -> None:
    """Against the numbers of rays written out, and the recipes of the data sets against theirs."""
    loaded = scene(floor=floor(diffuse({"type": "cell_noise", "cells": 2000})))
    pose = [[0, 0, 2.5, np.radians(35), 0, 0]]
    default = preset("didson300").replace(model="thesis", quality="draft", jitter=True)
    explicit = Sonar.create(**{**default.model_dump(), "rays_per_beam": 700, "rays_across": 4, "quality": "standard"})
    first, second = (next(Simulator(loaded, sonar).pings(pose)).levels for sonar in (default, explicit))
    np.testing.assert_array_equal(first, second)
    assert first.any()
    for name, rays in {"rocky-field": 700, "ship-hull": 700, "looking-down": 1000, "rocky-field-two-sensors": 350}.items():
        sonar = load_recipe(name).instrument
        assert (sonar.model, sonar.rays_per_beam, sonar.across) == ("thesis", rays, 1)
