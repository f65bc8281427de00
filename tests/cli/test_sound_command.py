"""``mitsonar sound`` and moving bodies of ``mitsonar render`` as a user meets them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import Command, refused

from mitsonar.mapping.sources import load_frames
from mitsonar.motion.sensors import load_sensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames
from mitsonar.records.soundings import Echogram, Soundings
from mitsonar.simulation.scene import shipped_trajectory

FILES = {
    "sidescan": {"echogram.npz", "sidescan.xtf", "waterfall.png", "soundings.npz", "poses.tum"},
    "altimeter": {"echogram.npz", "echogram.png", "soundings.npz", "soundings.csv", "poses.tum"},
    "profiler": {"soundings.npz", "soundings.csv", "soundings.png", "soundings.ply", "poses.tum"},
    "dvl": {"soundings.npz", "dvl.csv", "dvl.png", "sensors.csv", "poses.tum"},
}
PATH = ("--trajectory", "shipped", "--frames", 4, "--quality", "draft", "--model", "physical")


@pytest.mark.parametrize("instrument", FILES)
def test_each_instrument_writes_what_it_promises(mitsonar: Command, tmp_path: Path, instrument: str) -> None:
    out = tmp_path / "out"
    done = mitsonar("sound", "flat_floor", "--instrument", instrument, *PATH, "-o", out)
    assert done.returncode == 0, done.stderr
    assert {one.name for one in out.iterdir()} == FILES[instrument] | {"run.json", "run.yaml"}
    result = Soundings.load(out / "soundings.npz")
    assert len(result) == len(Soundings.load(out)) == 4
    assert result.found.any()
    if instrument in ("sidescan", "altimeter"):
        assert Echogram.load(out / "echogram.npz").levels.max() == Echogram.load(out).levels.max() > 0
    if instrument == "dvl":
        assert load_sensors(out / "sensors.csv").forward is not None


def test_a_path_before_1970_has_all_files_but_the_xtf(mitsonar: Command, tmp_path: Path) -> None:
    level = np.array([[0, 0, 2.0, 0, 0, 0], [0, 0.5, 2.0, 0, 0, 0]])
    Trajectory(level, np.array([-2.0, -1.5])).save(tmp_path / "path.tum")
    arguments = ("--trajectory", tmp_path / "path.tum", "--quality", "draft", "--model", "physical", "-o", tmp_path / "out")
    done = mitsonar("sound", "flat_floor", "--instrument", "sidescan", *arguments)
    assert done.returncode == 0, done.stderr
    assert "there is no sidescan.xtf: times of an XTF file are seconds since 1970" in " ".join(done.stderr.split())
    written = {one.name for one in (tmp_path / "out").iterdir()}
    assert written == FILES["sidescan"] - {"sidescan.xtf"} | {"run.json", "run.yaml"}


def test_a_finished_run_is_kept(mitsonar: Command, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ("sound", "flat_floor", "--instrument", "altimeter", *PATH, "-o", out)
    assert mitsonar(*arguments).returncode == 0
    before = (out / "soundings.npz").read_bytes()
    refused(mitsonar(*arguments), "exists")
    again = mitsonar(*arguments, "--resume")
    assert again.returncode == 0, again.stderr
    assert (out / "soundings.npz").read_bytes() == before


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (("--instrument", "sonarr"), "sonarr"),
        (("--instrument", "dvl", "--set", "beams=4"), "one beam a fan"),
        (("--instrument", "dvl", "--set", "rangemax=4"), "rangemax"),
    ],
)
def test_mistakes_are_one_sentence(mitsonar: Command, tmp_path: Path, wrong: tuple[str, ...], says: str) -> None:
    refused(mitsonar("sound", "flat_floor", *wrong, "-o", tmp_path / "out"), says)
    assert not (tmp_path / "out").exists()


def test_a_body_moves_and_a_run_tells_where(mitsonar: Command, tmp_path: Path) -> None:
    """A ball that swims past: labels name it, its path lies in the run, and another path is another run."""
    scene, out = tmp_path / "ball.xml", tmp_path / "out"
    scene.write_text(
        """<scene version="3.0.0"><sensor type="imaging_sonar">
  <integer name="beams" value="16"/><integer name="rays_per_beam" value="60"/><integer name="rays_across" value="2"/>
  <integer name="range_bins" value="64"/><float name="range_min" value="2"/><float name="range_max" value="6"/>
  <transform name="to_world"><lookat origin="0,0,2.5" target="0,3.57,0" up="0,0,1"/></transform></sensor>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="20"/></transform></shape>
<shape type="sphere" id="ball"><float name="radius" value="0.3"/></shape></scene>"""
    )
    poses = np.array([[-0.5, 3.5, 0.4, 0, 0, 0], [0.5, 3.5, 0.4, 0, 0, 0]], dtype=float)
    Trajectory(poses, np.array([0.0, 0.4])).save(tmp_path / "ball.tum")
    arguments = ("render", scene, "--frames", 5, "--labels", "--moving", f"ball={tmp_path / 'ball.tum'}", "-o", out)
    done = mitsonar(*arguments)
    assert done.returncode == 0, done.stderr
    frames = SonarFrames.load(out)
    assert frames.body_names == ("ball",)
    assert frames.body_poses is not None
    np.testing.assert_allclose(frames.body_poses[:, 0, 0], np.linspace(-0.5, 0.5, 5), atol=1e-6)
    assert frames.object_id is not None
    number = frames.object_names.index("ball")
    beams = [np.nonzero((one == number).any(axis=0))[0].mean() for one in frames.object_id]
    assert (np.diff(beams) > 0).all()  # to starboard
    assert len(Trajectory.load_tum(out / "bodies" / "ball.tum")) == 5
    refused(mitsonar("render", scene, "--moving", f"bell={tmp_path / 'ball.tum'}", "-o", tmp_path / "no"), "bell", "ball")


@pytest.mark.thorough
def test_frames_that_take_time_are_read_and_followed(mitsonar: Command, tmp_path: Path) -> None:
    """The file keeps a time and a pose for each beam; odometry and conversions take the middle of each frame."""
    run, out = tmp_path / "run", tmp_path / "path"
    arguments = (
        "--trajectory",
        "shipped",
        "--frames",
        3,
        "--model",
        "physical",
        "--quality",
        "draft",
        "--set",
        "ping_groups=8",
    )
    assert mitsonar("render", "flat_floor", *arguments, "-o", run).returncode == 0
    stored = SonarFrames.load(run)
    assert stored.time_s.shape == (3, 96)
    assert stored.beam_poses is not None
    assert stored.beam_poses.shape == (3, 96, 6)
    read = load_frames(run)
    np.testing.assert_allclose(read.time_s, stored.time_s.mean(axis=1))
    np.testing.assert_array_equal(read.image, stored.image)
    done = mitsonar("odometry", run, "--estimator", "zero", "-o", out)
    assert done.returncode == 0, done.stderr
    done = mitsonar("recording", "convert", run, "-o", tmp_path / "again")
    assert done.returncode == 0, done.stderr


@pytest.mark.thorough
def test_poses_are_named_and_an_instrument_that_looks_down_is_warned_of_on_a_pitched_path(
    mitsonar: Command, tmp_path: Path
) -> None:
    """The shipped path is that of a forward-looking sonar: `render` flies it, a DVL rides level below it."""
    quick = ("--quality", "draft", "--model", "physical", "-o")
    shipped = Trajectory.load_tum(shipped_trajectory("flat_floor"))
    seen = mitsonar("render", "flat_floor", "--trajectory", "shipped", "--frames", 2, *quick, tmp_path / "seen")
    assert "poses: of the sonar, at pitch 35 deg" in seen.stdout
    dvl = ("sound", "flat_floor", "--instrument", "dvl", "--trajectory")
    done = mitsonar(*dvl, "shipped", "--frames", 2, *quick, tmp_path / "level")
    assert "poses: of the vehicle, at pitch 0 deg; mounted on it: beam-1 pitch 67.5, heading 45 deg" in done.stdout
    assert done.stderr == ""
    flown = Trajectory.load_tum(tmp_path / "level" / "poses.tum").poses
    np.testing.assert_allclose(flown[:, 3:5], 0, atol=1e-9)
    np.testing.assert_allclose(flown[0, [0, 1, 2, 5]], shipped.poses[0, [0, 1, 2, 5]], atol=1e-9)
    tilted = mitsonar(*dvl, tmp_path / "seen" / "poses.tum", *quick, tmp_path / "tilted")
    assert tilted.returncode == 0
    assert (
        "the vehicle flies at pitch 35, roll 0 deg, and the dvl on it looks down or aside from a level one" in tilted.stderr
    )
    assert "the path must be the vehicle's, not that of a sonar on it" in tilted.stderr
    ahead = ("--instrument", "range-image", "--trajectory", tmp_path / "seen" / "poses.tum", "--frames", 1)
    assert "vehicle flies at" not in mitsonar("sound", "flat_floor", *ahead, *quick, tmp_path / "ahead").stderr
