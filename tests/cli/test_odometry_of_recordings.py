"""`mitsonar odometry FILE` and `mosaic` with a recording, as with a run: an ARIS file written from drawn frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_frames import over_ground, sway
from helpers import Command, refused

from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import motions
from mitsonar.motion.trajectory import Trajectory
from mitsonar.recordings.write_aris import write_aris

SONAR = Sonar(
    bearing="azimuth", beams=96, range_bins=256, range_min=3.6, range_max=5.4, azimuth_fov_deg=28, elevation_fov_deg=14,
    coding="dB", coding_db=80.0, frequency_hz=1.8e6,
)  # fmt: skip


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty frames of a drawn floor as an ARIS 1800 would record them: dB, no poses, no height."""
    frames = over_ground(sway(20), SONAR)
    decibels = np.clip(1 + np.log10(np.maximum(frames.image, 1e-8)) / 8, 0, 1).astype(np.float32)
    path = tmp_path_factory.mktemp("recorded") / "dive.aris"
    write_aris(path, replace(frames, image=decibels, level="dB", poses=None, height_m=None), beams=96)
    return path


@pytest.mark.thorough
def test_the_path_of_a_recording_is_that_of_its_sonar(recording: Path, mitsonar: Command, tmp_path: Path) -> None:
    done = mitsonar("odometry", recording, "-o", tmp_path / "path", "--height", 2.5, "--pitch-deg", 35, "--closure", 8)
    assert done.returncode == 0, done.stderr
    assert "closure over 8 motions, rms, forward" in done.stdout
    result = Trajectory.load(tmp_path / "path" / "estimated.tum")
    errors = motions(result.poses) - motions(sway(20).poses)
    assert np.sqrt((errors**2).mean(axis=0))[:2].max() < 0.002
    assert np.degrees(np.sqrt((errors[:, 2] ** 2).mean())) < 0.05
    laid = mitsonar("mosaic", recording, tmp_path / "path", "-o", tmp_path / "map.png")
    assert laid.returncode == 0, laid.stderr
    assert (tmp_path / "map.png").exists()


@pytest.mark.thorough
def test_without_a_height_one_is_assumed_and_told(recording: Path, mitsonar: Command, tmp_path: Path) -> None:
    done = mitsonar("odometry", recording, "-o", tmp_path / "path", "--workers", 1, "--closure", 0, "--every", 5)
    assert done.returncode == 0, done.stderr
    assert "has no height over the ground" in done.stderr
    assert "give --height and --pitch-deg" in done.stderr
    assert "closure" not in done.stdout


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--contrast", "locl"], "unknown contrast 'locl'"),
        (["--closure", "1"], "must be 0, or 2 motions or more"),
        (["--sequence", "3"], "has no part 3"),
    ],
)
def test_wrong_options_are_refused(
    recording: Path, mitsonar: Command, tmp_path: Path, options: list[str], reason: str
) -> None:
    refused(mitsonar("odometry", recording, "-o", tmp_path / "path", *options), reason)
