"""Folders of the UXO data set as its export script writes them: headers, side, poses of the rotator, lacking files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from mitsonar import MitsonarError, open_recording
from mitsonar.mapping.sources import open_frames

COLUMNS = {
    "FrameTime": 0, "PingMode": 6, "SamplePeriod": 10, "SampleStartDelay": 2000, "SoundSpeed": 1500.0, "SamplesPerBeam": 40,
    "ReceiverGain": 12, "CompassHeading": 33.0, "CompassPitch": -20.0, "CompassRoll": 2.0, "FrequencyHiLow": 1,
    "TheSystemType": 1, "LargeLens": 0, "FrameRate": 10.0, "SonarPan": 1.0,
}  # fmt: skip

FORWARD_IS_Y = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""Rotator whose axes forward, starboard, down are y, x, -z of the tank."""


def written(path: Path, frames: int = 5, **changed: list[float]) -> NDArray[np.uint8]:
    """Write a recording's folder, and return its samples as the sonar recorded them."""
    (path / "aris_raw").mkdir(parents=True)
    samples = np.random.default_rng(7).integers(1, 256, (frames, 40, 64), dtype=np.uint8)
    turn = FORWARD_IS_Y * Rotation.from_euler("xyz", [0, -20, 30], degrees=True)  # 20 deg nose down, 30 deg to starboard
    with (path / "aris_frame_meta.csv").open("w") as meta, (path / "ar3.csv").open("w") as rotator:
        headers, poses = csv.writer(meta), csv.writer(rotator)
        headers.writerow(["FrameIndex", *COLUMNS])
        poses.writerow(["aris_frame_idx", "pos.x", "pos.y", "pos.z", "rot.x", "rot.y", "rot.z", "rot.w"])
        for k in range(frames):
            row = COLUMNS | {"FrameTime": 1_690_000_000_000_000 + k * 100_000} | {n: v[k] for n, v in changed.items()}
            headers.writerow([100 + k, *row.values()])
            poses.writerow([100 + k, 1.0 + 0.1 * k, 2.0, -0.5, *turn.as_quat()])
            Image.fromarray(samples[k]).save(path / f"aris_raw/{100 + k:04}.pgm")
    return samples


def test_frames_ranges_and_side_are_those_of_an_aris_file(tmp_path: Path) -> None:
    samples = written(tmp_path)
    recording = open_recording(tmp_path)
    assert (recording.format, len(recording), recording.notes) == ("UXO data set (ARIS as PGM)", 5, ())
    frames = recording.part().read(np.arange(5))
    assert (frames.image == samples[:, :, ::-1]).all()  # beam 0 of the sonar is the one most to starboard
    assert frames.range_m[[0, -1]] == pytest.approx([1.5, 1.5 + 39 * 0.0075])
    assert np.degrees(frames.bearing_rad[[0, -1]]) == pytest.approx([-14.887, 14.887], abs=0.01)
    assert frames.time_s == pytest.approx(1.69e9 + np.arange(5) * 0.1)
    assert frames.level == "dB"
    assert frames.sonar.frequency_hz == 3.0e6
    assert np.degrees(frames.attitude_rad[0]) == pytest.approx([20, 2, 33])  # type: ignore[index]
    assert recording.part().gain_db == pytest.approx([12.0] * 5)


def test_poses_are_those_of_the_sonar_on_the_rotator(tmp_path: Path) -> None:
    written(tmp_path)
    poses = open_recording(tmp_path).part().poses
    assert poses is not None
    assert np.degrees(poses[:, 3:]) == pytest.approx(np.tile([20.0, 0, 30], (5, 1)), abs=1e-6)
    ahead = np.array([np.sin(np.radians(30)), np.cos(np.radians(30)), 0]) * np.cos(np.radians(20))
    ahead[2] = -np.sin(np.radians(20))
    assert poses[2, :3] == pytest.approx(np.array([1.2, 2.0, -0.5]) - 0.108725 * ahead)
    assert open_frames(tmp_path).true is not None


def test_windows_that_change_make_parts(tmp_path: Path) -> None:
    written(tmp_path, SampleStartDelay=[2000, 2000, 2400, 2400, 2400])
    recording = open_recording(tmp_path)
    assert [len(part) for part in recording.parts] == [2, 3]
    assert recording.part(1).like.range_m[0] == pytest.approx(1.8)
    assert recording.part(1).poses is not None
    assert recording.part(1).poses[0, 0] - recording.part(0).poses[0, 0] == pytest.approx(0.2)  # type: ignore[index]


def test_what_is_missing_or_damaged_is_left_out_and_told(tmp_path: Path) -> None:
    written(tmp_path, SoundSpeed=[1500, 0, 1500, 1500, 1500])
    (tmp_path / "aris_raw/0104.pgm").unlink()
    Image.fromarray(np.zeros((40, 64), np.uint8)).save(tmp_path / "aris_raw/0200.pgm")
    (tmp_path / "ar3.csv").write_text("aris_frame_idx,pos.x,pos.y,pos.z,rot.x,rot.y,rot.z,rot.w\n100,0,0,0,0,0,0,1\n")
    recording = open_recording(tmp_path)
    assert len(recording) == 3
    notes = " ".join(recording.notes)
    for part in ("1 row of", "1 frame of", "1 picture without a row", "no valid one for 2 frames", "missing: 1 frame"):
        assert part in notes
    assert recording.part().poses is None
    Image.fromarray(np.zeros((39, 64), np.uint8)).save(tmp_path / "aris_raw/0102.pgm")
    with pytest.raises(MitsonarError, match=r"0102\.pgm has 64 x 39 pixels, the others 64 x 40"):
        recording.part().read([0, 1, 2])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("FrameIndex\n1\n", "has no column FrameTime"),
        ("", "holds no table"),
        ("FrameIndex,FrameTime\n1\n", "row 2 of .* has 1 cells"),
        (
            "FrameIndex,FrameTime,PingMode,SamplePeriod,SampleStartDelay,SoundSpeed,SamplesPerBeam\n100,x,y,z,,nan,1e99\n",
            "no frame",
        ),
    ],
)
def test_damaged_tables_are_refused(tmp_path: Path, text: str, reason: str) -> None:
    written(tmp_path)
    (tmp_path / "aris_frame_meta.csv").write_text(text)
    with pytest.raises(MitsonarError, match=reason):
        open_recording(tmp_path)


def test_a_geometry_is_refused(tmp_path: Path) -> None:
    written(tmp_path)
    with pytest.raises(MitsonarError, match="contains its geometry"):
        open_recording(tmp_path, tmp_path / "geometry.yaml")
