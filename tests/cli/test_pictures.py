"""Fan pictures through the command line: a folder of PNG and a geometry file become a path and a mosaic."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from drawn_frames import over_ground, sway
from helpers import Command, refused
from PIL import Image

from mitsonar.geometry.fan import to_cartesian


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fans of a flat floor along a path that turns, as a viewer would export them; the truth stands beside."""
    path = tmp_path_factory.mktemp("fans")
    (path / "pictures").mkdir()
    flown = sway(10)
    frames = over_ground(flown)
    for k, image in enumerate(frames.image):
        fan = to_cartesian(image, frames.range_m, frames.bearing_rad, rows=500)
        microseconds = round((1.7e9 + flown.time_s[k]) * 1e6)
        Image.fromarray(np.rint(np.nan_to_num(fan.image) * 255).astype(np.uint8)).save(path / f"pictures/{microseconds}.png")
    left, _, low, high = fan.extent
    pixel = (high - low) / 500
    half = np.degrees(frames.bearing_rad[-1] + np.diff(frames.bearing_rad)[0] / 2)
    (path / "fan.yaml").write_text(
        f"layout: fan\napex_px: [{-left / pixel - 0.5}, {high / pixel - 0.5}]\nnear_px: {3.6 / pixel}\n"
        f"far_px: {5.4 / pixel}\nhalf_angle_deg: {half}\npixels_per_m: {1 / pixel}\nbeams: 96\nbins: 128\nlevel: linear\n"
        "bearing: azimuth\nelevation_fov_deg: 14\nheight_m: 2.5\npitch_deg: 35\n"
    )
    flown.save(path / "true.tum")
    return path


@pytest.mark.slow
def test_a_folder_of_fans_becomes_a_path_and_a_mosaic(mitsonar: Command, pictures: Path, tmp_path: Path) -> None:
    message = ["--geometry", str(pictures / "fan.yaml")]
    built = mitsonar("odometry", pictures / "pictures", "-o", tmp_path / "path", "--estimator", "direct", *message)
    assert built.returncode == 0, built.stderr
    assert "warning" not in built.stdout + built.stderr
    rows = list(csv.DictReader((tmp_path / "path/motions.csv").open()))
    result = np.array([[float(row[name]) for name in ("sideways_mm", "forward_mm", "yaw_deg")] for row in rows])
    step = np.diff(sway(10).poses, axis=0)
    assert np.degrees(step[:, 5]) == pytest.approx(result[:, 2], abs=0.02)
    assert np.hypot(*step[:, :2].T) * 1e3 == pytest.approx(np.hypot(*result[:, :2].T), abs=1.0)
    laid = mitsonar("mosaic", pictures / "pictures", tmp_path / "path", "-o", tmp_path / "map.png", *message)
    assert laid.returncode == 0, laid.stderr
    assert (tmp_path / "map.png").stat().st_size > 1000


def test_faults_are_one_sentence(mitsonar: Command, pictures: Path, tmp_path: Path) -> None:
    refused(mitsonar("odometry", pictures / "pictures", "-o", tmp_path / "a"), "give a geometry file", "--geometry FILE")
    bad = tmp_path / "bad.yaml"
    bad.write_text("layout: fan\nkx: 1.24\n")
    message = ["--geometry", bad]
    refused(mitsonar("odometry", pictures / "pictures", "-o", tmp_path / "a", *message), "unknown geometry key kx")
    refused(mitsonar("mosaic", pictures, "true", "-o", tmp_path / "a.png", *message), "is not a recording of pictures")
    assert not (tmp_path / "a").exists()
