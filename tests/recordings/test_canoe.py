"""Sequences of CANOE as its reference tells them: bearings in rows of bytes, poses of any sensor frame, damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from mitsonar import MitsonarError, open_recording
from mitsonar.recordings.public_sets import bearings_in

Array = NDArray[np.float64]

START = 1_755_800_000_000_000
BEARINGS = np.round(np.degrees(np.arcsin(np.linspace(-0.9, 0.9, 80))) * 100).astype(np.int16)
"""Uneven, as those of an Oculus [0.01 deg]."""

HEADER = "t,x,y,z,r,p,y,vx,vy,vz,wx,wy,wz,vx_bod,vy_bod,vz_bod"


def two_rows(bearings: NDArray[np.int16], kind: str) -> NDArray[np.uint8]:
    """Bytes of the bearings: low above high, high above low, or one after the other."""
    if kind == "along":
        return bearings.astype("<i2").view(np.uint8).reshape(2, -1)
    order = "<i2" if kind == "low" else ">i2"
    return bearings.astype(order).view(np.uint8).reshape(-1, 2).T


def written(path: Path, kind: str = "low", bearings: NDArray[np.int16] = BEARINGS, frames: int = 6) -> NDArray[np.uint8]:
    """Write the pictures of a sequence, and return them below their bearings."""
    (path / "sonar").mkdir(parents=True)
    (path / "calib").mkdir()
    images = np.random.default_rng(4).integers(1, 256, (frames, 30, len(bearings)), dtype=np.uint8)
    for k, image in enumerate(images):
        Image.fromarray(np.vstack([two_rows(bearings, kind), image])).save(path / f"sonar/{START + k * 70_000}.png")
    return images


def with_poses(path: Path, axes: Array, *, inverse: bool = False, frames: int = 6, skip: int = -1) -> Array:
    """Write poses of a boat in a turn, and return positions and headings ``(frames, 4)``.

    Args:
        path: of the sequence.
        axes: starboard, forward, up in the sensor's frame, as columns.
        inverse: whether the product of the reference turns from world to sensor.
        frames: rows.
        skip: row to leave out.
    """
    heading = np.radians(20 + 8 * np.arange(frames))
    position = np.column_stack([np.cumsum(np.sin(heading)), np.cumsum(np.cos(heading)), np.full(frames, -0.3)])
    (path / "novatel").mkdir()
    lines = [HEADER]
    for k in range(frames):
        body = Rotation.from_euler("Z", -heading[k])  # starboard, forward, up to the world
        sensor = body * Rotation.from_matrix(axes).inv()
        product = sensor.inv() if inverse else sensor
        angles = -product.as_euler("XYZ")
        local = axes @ [0.02, 1.4, 0]
        world = sensor.apply(local)
        numbers = [*position[k], *angles, *world, 0, 0, 0, *local]
        if k != skip:
            lines.append(f"{START + k * 70_000}," + ",".join(f"{one:.9f}" for one in numbers))
    (path / "novatel/sonar_poses.csv").write_text("\n".join(lines) + "\n")
    return np.column_stack([position, heading])


@pytest.mark.parametrize("kind", ["low", "high", "along"])
@pytest.mark.parametrize("sign", [1, -1])
def test_bearings_are_found_in_any_order_of_bytes(tmp_path: Path, kind: str, sign: int) -> None:
    bearings = (sign * BEARINGS).astype(np.int16)
    images = written(tmp_path, kind, bearings)
    recording = open_recording(tmp_path)
    assert recording.format == "CANOE data set (Oculus as PNG)"
    frames = recording.part().read(np.arange(6))
    assert np.degrees(frames.bearing_rad) == pytest.approx(np.sort(bearings * 0.01), abs=1e-9)
    assert (frames.image == images[:, :, ::sign]).all()
    assert frames.time_s == pytest.approx(START * 1e-6 + np.arange(6) * 0.07)
    assert frames.sonar.range_max == 30
    assert len(frames.range_m) == 30
    assert any("poses are not known" in note for note in recording.notes)


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize(
    "axes",
    [
        np.eye(3),  # starboard, forward, up: as the reference says of the receiver
        np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),  # x forward, y port, z up
        np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),  # x forward, y starboard, z down
    ],
)
def test_poses_are_found_whatever_the_axes_of_the_sensor_are(tmp_path: Path, axes: Array, inverse: bool) -> None:
    written(tmp_path)
    flown = with_poses(tmp_path, axes, inverse=inverse)
    recording = open_recording(tmp_path)
    poses = recording.part().poses
    assert poses is not None
    assert poses[:, :3] == pytest.approx(flown[:, :3], abs=1e-6)
    assert poses[:, 5] == pytest.approx(flown[:, 3], abs=1e-6)
    assert poses[:, 3:5] == pytest.approx(np.zeros((6, 2)), abs=1e-6)


def test_pictures_without_a_pose_are_left_out(tmp_path: Path) -> None:
    written(tmp_path)
    flown = with_poses(tmp_path, np.eye(3), skip=2)
    recording = open_recording(tmp_path)
    assert "left out: 1 picture without a pose" in recording.notes
    assert recording.part().poses[:, 0] == pytest.approx(np.delete(flown[:, 0], 2), abs=1e-6)  # type: ignore[index]


def test_poses_that_contradict_themselves_are_left_out(tmp_path: Path) -> None:
    written(tmp_path)
    with_poses(tmp_path, np.eye(3))
    path = tmp_path / "novatel/sonar_poses.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()]
    turned = [[*row[:13], row[14], row[13], "1.0"] for row in rows[1:]]  # velocities of another frame
    path.write_text("\n".join([HEADER, *(",".join(row) for row in turned)]))
    recording = open_recording(tmp_path)
    assert recording.part().poses is None
    assert any("angles and velocities disagree" in note for note in recording.notes)
    path.write_text(HEADER + "\n" + ",".join(["1"] * 16))
    assert any("poses of 0 of 6 pictures" in note for note in open_recording(tmp_path).notes)
    path.write_text("t,x\n1,2\n")
    with pytest.raises(MitsonarError, match="has 2 columns: 16 are needed"):
        open_recording(tmp_path)


def test_sizes_that_change_make_parts_and_cut_pictures_are_left_out(tmp_path: Path) -> None:
    written(tmp_path)
    narrow = BEARINGS[4:-4]
    for k in (6, 7, 8):
        image = np.vstack([two_rows(narrow, "low"), np.full((50, len(narrow)), 9, np.uint8)])
        Image.fromarray(image).save(tmp_path / f"sonar/{START + k * 70_000}.png")
    last = tmp_path / f"sonar/{START + 8 * 70_000}.png"
    last.write_bytes(last.read_bytes()[:-30])
    recording = open_recording(tmp_path)
    assert [len(part) for part in recording.parts] == [6, 2]
    assert recording.part(1).read([0]).image.shape == (1, 50, 72)
    assert any("left out: 1 picture cut off" in note for note in recording.notes)


def test_pictures_without_bearings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match="not increasing or decreasing bearings"):
        bearings_in(np.random.default_rng(1).integers(0, 256, (2, 40), dtype=np.uint8), "a.png")
    written(tmp_path)
    name = f"sonar/{START + 70_000}.png"
    Image.fromarray(np.full((32, 80), 7, np.uint8)).save(tmp_path / name)
    recording = open_recording(tmp_path)
    with pytest.raises(MitsonarError, match="different bearings from those of the pictures before it"):
        recording.part().read([0, 1])
