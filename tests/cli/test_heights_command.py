"""The command `heights` as a user meets it: what it writes, and what it answers to mistakes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import Command, diffuse, floor, refused, scene

from mitsonar.cli.heights import _posed
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

pytestmark = pytest.mark.filterwarnings("ignore:.* lie outside the window")

POSES = np.array([[0.0, -4.0, 1.5, np.radians(20), 0.0, 0.0], [0.0, 4.0, 1.5, np.radians(20), 0.0, np.pi]])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """A run's folder: two frames of a ball that is half buried in a floor."""
    from mitsonar.simulation.simulator import Simulator

    ball = {"type": "sphere", "center": [0, 0, 0], "radius": 0.3, "bsdf": {"type": "twosided", "inner": diffuse(0.5)}}
    sonar = Sonar(
        model="physical", elevation_fov_deg=16.0, azimuth_fov_deg=30.0, range_min=2.5, range_max=6.5, beams=32, range_bins=64
    )
    frames = Simulator(scene(floor=floor(), ball=ball), sonar).render(POSES)
    speckle = np.random.default_rng(1).gamma(4, 1 / 4, frames.image.shape)
    levels = frames.image * speckle
    folder = tmp_path_factory.mktemp("ball")
    replace(frames, image=(levels / levels.max()).astype(np.float32), level_scale=float(levels.max())).save(
        folder / "frames.npz"
    )
    return folder


@pytest.fixture(scope="module")
def bare(run: Path) -> Path:
    """The same frames without poses and heights."""
    path = run / "bare.npz"
    replace(SonarFrames.load(run), poses=None, height_m=None).save(path)
    return path


@pytest.mark.thorough
def test_a_run_becomes_a_mesh_a_geotiff_arrays_and_a_figure(mitsonar: Command, run: Path, tmp_path: Path) -> None:
    names = ["map.ply", "map.tif", "map.npz", "map.png"]
    out = [word for name in names for word in ("-o", tmp_path / name)]
    done = mitsonar("heights", run, *out, "--cells", 32)
    assert done.returncode == 0, done
    assert "2 frames: 32 x 32 cells" in done.stdout
    assert "held-out blocks" in done.stdout
    assert all((tmp_path / name).stat().st_size > 500 for name in names)
    with np.load(tmp_path / "map.npz") as table:
        height, cell, west, north = (table[name] for name in ("height_m", "cell_m", "west_m", "north_m"))
    steps = (np.arange(32) + 0.5) * cell
    x, y = np.meshgrid(west + steps, north - steps)
    true = np.sqrt(np.maximum(0.09 - x**2 - y**2, 0))
    seen = np.isfinite(height)
    assert np.sqrt(np.mean(np.square(height - true)[seen])) < 0.6 * np.sqrt(np.mean(np.square(true[seen])))
    refused(mitsonar("heights", run, "-o", tmp_path / "map.ply"), "map.ply", "--overwrite")


@pytest.mark.thorough
def test_one_frame_without_a_pose_takes_height_and_pitch(mitsonar: Command, bare: Path, tmp_path: Path) -> None:
    words = ["heights", bare, "-o", tmp_path / "map.npz", "--cells", 20]
    refused(mitsonar(*words, "--only", 0), "does not state the poses", "--height and --pitch-deg")
    refused(mitsonar(*words, "--height", 1.5, "--pitch-deg", 20), "does not state the poses", "--trajectory")
    refused(mitsonar(*words, "--only", 0, "--pitch-deg", 20), "give --height")
    done = mitsonar(*words, "--only", 0, "--height", 1.5, "--pitch-deg", 20)
    assert done.returncode == 0, done
    assert "1 frame:" in done.stdout
    with np.load(tmp_path / "map.npz") as table:
        assert table["ground_m"] == 0


@pytest.mark.thorough
def test_a_pitch_or_roll_that_the_frame_lacks_is_not_taken_as_level(mitsonar: Command, bare: Path, tmp_path: Path) -> None:
    known = np.array([[np.radians(20), 0.0, 0.0], [np.nan, np.nan, np.nan]])
    replace(SonarFrames.load(bare), attitude_rad=known).save(tmp_path / "tilted.npz")
    words = ["heights", tmp_path / "tilted.npz", "-o", tmp_path / "map.npz", "--cells", 20, "--height", 1.5]
    done = mitsonar(*words, "--only", 0)
    assert done.returncode == 0, done
    refused(mitsonar(*words, "--overwrite", "--only", 1), "frame 1 of", "no known pitch and roll", "give --pitch-deg")
    done = mitsonar(*words, "--overwrite", "--only", 1, "--pitch-deg", 20)
    assert done.returncode == 0, done
    known[1, 0] = np.radians(20)
    replace(SonarFrames.load(bare), attitude_rad=known).save(tmp_path / "tilted.npz")
    refused(mitsonar(*words, "--overwrite", "--only", 1), "frame 1 of", "no known roll, and")


@pytest.mark.thorough
def test_a_path_gives_the_poses(mitsonar: Command, run: Path, bare: Path, tmp_path: Path) -> None:
    Trajectory(POSES, SonarFrames.load(run).time_s).save(tmp_path / "path.tum")
    words = ["heights", bare, "-o", tmp_path / "map.npz", "--cells", 20, "--trajectory", tmp_path / "path.tum"]
    done = mitsonar(*words, "--height", 1.5)
    assert done.returncode == 0, done
    assert "2 frames" in done.stdout
    refused(mitsonar(*words, "--overwrite"), "give --height")


def test_mistakes_are_answered_before_anything_is_read(mitsonar: Command, run: Path, tmp_path: Path) -> None:
    refused(mitsonar("heights", "none.npz", "-o", tmp_path / "map.obj"), "-o must name a .ply, .tif, .npz or .png file")
    refused(mitsonar("heights", "none.npz", "-o", tmp_path / "no" / "map.ply"), "there is no folder")
    refused(mitsonar("heights", "none.npz", "-o", tmp_path / "a.ply", "--cells", 5), "--cells must lie in 16..96: got 5")
    for only in ("7", "0,0", "0.5"):
        refused(mitsonar("heights", run, "-o", tmp_path / "a.ply", "--only", only), "--only takes different numbers")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("given", "expected"), [(None, [1.5, 1.5, 1.6]), (1.45, [1.45, 1.45, 1.55])])
def test_heights_are_those_over_level_ground(given: float | None, expected: list[float]) -> None:
    """Frames hold the height over what lies straight below: the second is over a rock."""
    poses = np.array([[0, 0, 1.5, 0.4, 0, 0], [1, 0, 1.5, 0.4, 0, 0], [2, 0, 1.6, 0.4, 0, 0]])
    source: Any = SimpleNamespace(sonar_poses=poses, height_m=np.array([1.5, 1.3, 1.6]), name="run")
    index, taken, height_m = _posed(source, np.arange(3), None, given)
    assert list(index) == [0, 1, 2]
    np.testing.assert_array_equal(taken, poses)
    np.testing.assert_allclose(height_m, expected)
    # where nothing is below a frame, the other frames know the ground
    source.height_m[1] = np.nan
    np.testing.assert_allclose(_posed(source, np.arange(3), None, given)[2], expected)
