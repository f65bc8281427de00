"""Motions and vehicles in YAML: every mistake is one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from mitsonar.errors import MitsonarError
from mitsonar.instruments.vehicle import load_vehicle_recipe
from mitsonar.motion.bodies import BodyMotion, files_of, read_motions


def test_a_path_or_keys(tmp_path: Path) -> None:
    file = tmp_path / "moving.yaml"
    file.write_text("fish: fish.tum\nray: {path: ray.tum, meshes: ray/*.ply, rate_hz: 5, loop: false}\nhull: vehicle\n")
    result = read_motions(file)
    assert result["fish"] == BodyMotion(path="fish.tum")
    assert result["ray"] == BodyMotion(path="ray.tum", meshes="ray/*.ply", rate_hz=5, loop=False)
    assert result["hull"].path == "vehicle"


def test_patterns_are_in_the_order_of_names(tmp_path: Path) -> None:
    for name in ("b.tum", "a.tum", "c.csv"):
        (tmp_path / name).touch()
    assert [one.name for one in files_of("*.tum", tmp_path)] == ["a.tum", "b.tum"]
    with pytest.raises(MitsonarError, match="no file matches"):
        files_of("*.ply", tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[1, 2]", "must hold `shape id: path` lines"),
        ("fish: {pth: a.tum}", "unknown motion key pth: did you mean path"),
        ("fish: {frame: ned}", "needs a path or meshes"),
        ("fish: 3", "takes a path"),
        ("fish: {path: a.tum, rate_hz: 0}", "rate_hz"),
    ],
)
def test_mistakes_of_motions(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "moving.yaml").write_text(text)
    with pytest.raises(MitsonarError, match=said):
        read_motions(tmp_path / "moving.yaml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sensors: {}", "sensors"),
        ("- a", "must hold the key sensors, and moving where bodies move"),
        ("sensors: {a: {sonar: didson300, camera: {}}}", "a sensor is one of .*got sonar and camera"),
        ("sensors: {a: {mount: [0, 0, 0, 0, 0, 0]}}", "got none"),
        ("sensors: {a: {camera: {fov: 3}}}", "sensor a: unknown sensor key camera.fov: did you mean fov_deg"),
        ("sensors: {a: didson300}", "sensor a takes keys"),
        ("sensors: {../up: {sonar: didson300}}", "that of its folder"),
        ("sensors: {a: {sonar: didson300}}\nmoving: {fish: 3}", "takes a path"),
    ],
)
def test_mistakes_of_vehicles(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "auv.yaml").write_text(text)
    with pytest.raises(MitsonarError, match=said):
        load_vehicle_recipe(tmp_path / "auv.yaml")
