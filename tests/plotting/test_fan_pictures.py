"""Plain fan pictures: exact levels, label maps that mix nothing, and names that labels refer to."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import Command, scene, sphere
from PIL import Image

from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.plotting.fans import FanPictures
from mitsonar.records.frames import SonarFrames

SONAR = Sonar(beams=8, range_bins=24, rays_per_beam=40, rays_across=1, range_min=2.0, range_max=6.0, bearing="azimuth")


def drawn() -> SonarFrames:
    """A frame of two labels, 3 to port and 9 to starboard, with random levels."""
    image = np.random.default_rng(1).uniform(0.1, 1, (1, 24, 8)).astype(np.float32)
    shape_id = np.where(np.arange(8) < 4, 3, 9)[None, None] * np.ones((1, 24, 1))
    frames = SonarFrames(image, SONAR.range_m, SONAR.bearing_rad, np.zeros(1), SONAR)
    frames.shape_id = shape_id.astype(np.int32)
    frames.shadow = np.zeros((1, 24, 8), np.uint8)
    return frames


def test_a_pixel_at_a_cell_s_centre_has_its_level() -> None:
    frames = drawn()
    pictures = FanPictures(frames)
    shown = pictures.picture(frames.image[0])
    left, _, _, high = pictures.fan.extent
    for number, radius in ((5, frames.range_m[5]), (17, frames.range_m[17])):
        for beam, bearing in enumerate(frames.bearing_rad):
            row = (high - radius * np.cos(bearing)) / pictures.pixel_m
            column = (radius * np.sin(bearing) - left) / pictures.pixel_m
            near = shown[int(row) - 1 : int(row) + 2, int(column) - 1 : int(column) + 2]
            level = 255 * frames.image[0, number, beam]
            assert int(near.min()) - 45 <= level <= int(near.max()) + 45
    assert pictures.pixel_m == pytest.approx(SONAR.bin_m, rel=0.05)
    assert shown[-1, 0] == shown[0, 0] == 0  # outside the fan


def test_labels_are_never_mixed() -> None:
    frames = drawn()
    result = FanPictures(frames).labels(frames, 0)
    assert sorted(result) == ["shadow", "shape"]
    assert result["shape"].dtype == np.uint16
    assert set(np.unique(result["shape"])) == {0, 4, 10}  # outside, 3 + 1, 9 + 1; never anything between
    rows, columns = result["shape"].shape
    assert (result["shape"][rows // 2, : columns // 2 - 1] != 10).all()
    assert (result["shape"][rows // 2, columns // 2 + 1 :] != 4).all()


@pytest.mark.usefixtures("variant")
def test_labels_name_shapes_and_leave_out_faint_pixels() -> None:
    from mitsonar.simulation.simulator import Simulator

    world = scene(far=sphere([0, 5, 0], 0.8), near=sphere([0.2, 3, 0], 0.2))
    simulator = Simulator(world, SONAR)
    bare = simulator.render([Pose(0, 0, 0)])
    every = simulator.render([Pose(0, 0, 0)], labels=True)
    assert (bare.shape_names, bare.object_names) == ((), ())
    assert sorted(every.shape_names) == ["far", "near"]
    assert every.shape_id is not None
    seen = {every.shape_names[number] for number in np.unique(every.shape_id[every.shape_id >= 0])}
    assert seen == {"far", "near"}
    bright = simulator.render([Pose(0, 0, 0)], labels=True, label_floor=0.3)
    assert bright.shape_id is not None
    assert bright.shadow is not None
    np.testing.assert_array_equal(bright.image, every.image)
    np.testing.assert_array_equal(bright.shape_id >= 0, (every.shape_id >= 0) & (every.image > 0.3))
    assert ((bright.shadow > 0) & (bright.image > 0.3)).sum() == 0
    stepped = simulator.step([0, 0, 0, 0, 0, 0], labels=True, gain=1 / every.level_scale)
    assert stepped.shape_names == every.shape_names


def test_a_run_writes_them_and_says_the_names(mitsonar: Command, tmp_path: Path) -> None:
    words = ("--set", "range_bins=64", "--set", "beams=16", "--quality", "draft", "-o", tmp_path / "run")
    done = mitsonar("render", "flat_floor", "--fan", "--labels", "--label-floor", "0.01", *words)
    assert done.returncode == 0, done.stderr
    message = json.loads((tmp_path / "run" / "run.json").read_text())
    frames = SonarFrames.load(tmp_path / "run")
    assert message["shape_names"] == list(frames.shape_names) != []
    picture = np.array(Image.open(tmp_path / "run" / "fan" / "000000.png"))
    shapes = np.array(Image.open(tmp_path / "run" / "fan" / "000000.shape.png"))
    assert picture.shape == shapes.shape
    assert frames.shape_id is not None
    assert set(np.unique(shapes)) - {0} <= set(np.unique(frames.shape_id + 1))
    assert json.loads((tmp_path / "run" / "fan" / "fan.json").read_text())["pixel_m"] > 0
    assert str(tmp_path / "run" / "fan" / "000000.png") in done.stdout
    assert len(frames.select(slice(0, 1)).shape_names) == len(frames.shape_names)
