"""Sediments by their grain size, against numbers that reached us by another way, and against each other."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from mitsonar.acoustics.materials import SEDIMENTS, material, reflection, sediment_of, sigma_table
from mitsonar.errors import MitsonarError

JACKSON = {  # density, speed, loss, spectral strength in the project hyo2_openbst, after a program of D. R. Jackson
    0.5: (2.231, 1.2503, 0.01638, 2.2e-4),
    1.5: (1.845, 1.1782, 0.01624, 1.406e-4),
    2.5: (1.451, 1.1072, 0.01602, 8.6e-5),
    6.0: (1.149, 0.9873, 0.00386, 1.64e-5),
}


@pytest.mark.parametrize("phi", JACKSON)
def test_the_regressions_meet_numbers_of_another_source(phi: float) -> None:
    made, wanted = sediment_of(phi), JACKSON[phi]
    assert (made.density_ratio, made.sound_speed_ratio) == pytest.approx(wanted[:2], abs=6e-4)
    assert made.loss == pytest.approx(wanted[2], rel=2e-3)
    assert made.spectral_strength == pytest.approx(wanted[3], rel=5e-3)


@pytest.mark.parametrize("name", ["sand", "mud"])
def test_named_materials_lie_on_them(name: str) -> None:
    phi = {"sand": 1.5, "mud": 6.0}[name]
    own, made = material(name), sediment_of(phi)
    for key, value in made._asdict().items():
        assert getattr(own, key) == pytest.approx(value, rel=5e-3), key


def test_joints_of_the_regressions_are_small() -> None:
    """Steps where one polynomial ends and the next begins: 10 % at 1 phi (density) and 5 phi (roughness), 2 % elsewhere."""
    for joint, allowed in ((0.0, 0.002), (1.0, 0.11), (2.6, 0.01), (4.5, 0.01), (5.0, 0.1), (5.3, 0.02), (6.0, 0.02)):
        below, above = sediment_of(joint - 1e-9), sediment_of(joint + 1e-9)
        for key in ("density_ratio", "sound_speed_ratio", "loss", "spectral_strength"):
            assert getattr(below, key) == pytest.approx(getattr(above, key), rel=allowed), (joint, key)


def test_coarser_grains_reflect_more() -> None:
    facing = np.array([math.pi / 2])
    found = [abs(reflection(sediment_of(phi), facing)[0]) for phi in SEDIMENTS.values()]
    assert np.all(np.diff(found) < 1e-3)
    assert 0.3 < found[2] < 0.55
    assert found[-1] < 0.1


def test_a_file_names_the_grain_size(tmp_path: Path) -> None:
    path = tmp_path / "fine.yaml"
    path.write_text("grain_size_phi: 2.5\n")
    made = material(path)
    assert (made.law, made.name) == ("rough-fluid", "fine")
    assert (made.loss, made.spectral_exponent) == (sediment_of(2.5).loss, 3.25)
    assert made.band_hz == (10e3, 100e3)
    assert np.isfinite(sigma_table(made, 50e3)).all()
    path.write_text("grain_size_phi: 2.5\nloss: 0.02\n")
    assert material(path).loss == 0.02
    assert material(path).density_ratio == sediment_of(2.5).density_ratio


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("grain_size_phi: 9.5\n", r"must lie in -1\.\.9, sandy gravel to clay: got 9\.5"),
        ("grain_size_phi: .nan\n", r"must lie in -1\.\.9"),
        ("grain_size_phi: fine\n", "grain_size_phi in .* must be a number: got 'fine'"),
        ("grain_size_phi: true\n", "must be a number: got True"),
        ("grain_size_phi: 2\nmaterial: sand\n", "grain_size_phi and material both set the parameters"),
        ("grain_size_phi: 2\nlaw: lambert\nmu: 0.1\n", "law lambert has no key"),
    ],
)
def test_bad_grain_sizes(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(MitsonarError, match=message):
        material(path)
