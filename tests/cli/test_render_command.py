"""The command line as a user meets it: what it writes, what it answers to mistakes, what survives a kill."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers import Command, by_itself, refused
from PIL import Image

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import to_world_matrices
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames, to_uint8
from mitsonar.simulation.runs import Destination, RenderOptions, StoredEchoes, run
from mitsonar.simulation.scene import load_scene, shipped_scenes, shipped_trajectory, sonar_in
from mitsonar.simulation.simulator import Simulator

SENSOR = """<sensor type="imaging_sonar">
  <integer name="beams" value="16"/><integer name="rays_per_beam" value="60"/><integer name="rays_across" value="2"/>
  <integer name="range_bins" value="64"/>
  <transform name="to_world"><lookat origin="0,0,2.5" target="0,3.57,0" up="0,0,1"/></transform>
</sensor>"""
FLOOR = """<shape type="rectangle" id="floor"><transform name="to_world"><scale value="100"/></transform>
  <bsdf type="diffuse"><texture type="cell_noise" name="reflectance"><integer name="cells" value="$cells"/></texture></bsdf>
</shape>"""
DEFAULT = '<default name="cells" value="8000"/>'


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A floor of noise under a small sonar."""
    path = tmp_path / "floor.xml"
    path.write_text(f'<scene version="3.0.0">{DEFAULT}{SENSOR}{FLOOR}</scene>')
    return path


def test_render_writes_all_that_it_promises(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = [
        "--frames",
        3,
        "--to",
        "0.2,0.1,2.5,35,0,5",
        "--cartesian",
        "--exr",
        "--labels",
        "--noise",
        "low",
        "--seed",
        4,
    ]
    done = mitsonar("render", scene, "-o", out, *options)
    assert done.returncode == 0, done.stderr
    assert str(out) in done.stdout
    frames = SonarFrames.load(out)
    assert frames.image.shape == (3, 64, 16)
    assert frames.image.dtype == np.float32
    assert frames.shape_id is not None
    assert set(np.unique(frames.shape_id)) <= {-1, 0}
    assert frames.height_m is not None
    np.testing.assert_allclose(frames.height_m, 2.5, atol=1e-5)
    for index in range(3):
        picture = np.array(Image.open(out / "images" / f"{index:06d}.png"))
        np.testing.assert_array_equal(picture, to_uint8(frames.image[index]))
        assert (out / "cartesian" / f"{index:06d}.png").stat().st_size > 5000
        assert (out / "echoes" / f"{index:06d}.exr").is_file()
    path = Trajectory.load_tum(out / "poses.tum")
    assert frames.poses is not None
    np.testing.assert_allclose(path.poses, frames.poses, atol=1e-7)
    np.testing.assert_allclose(path.poses[-1], [0.2, 0.1, 2.5, np.radians(35), 0, np.radians(5)], atol=1e-7)
    about = json.loads((out / "run.json").read_text())
    assert about["finished"]
    assert about["asked"]["sonar"]["seed"] == 4
    assert about["asked"]["noise"] == NOISE_MODELS["low"].model_dump()
    assert about["gain"] == pytest.approx(1 / frames.level_scale)
    assert {"mitsuba", "drjit", "numpy"} <= set(about["versions"])


def test_without_options_one_frame_from_the_pose_in_the_scene(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    done = mitsonar("render", scene, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    frames = SonarFrames.load(tmp_path / "out" / "floor")
    result = sonar_in(load_scene(scene))
    assert result is not None
    assert len(frames) == 1
    assert frames.poses is not None
    np.testing.assert_allclose(frames.poses[0], np.array(result[1]))
    same = Simulator(load_scene(scene)).render([result[1]])
    np.testing.assert_array_equal(frames.image, same.image)
    assert frames.level_scale == same.level_scale


def test_stored_echoes_are_binned_again_to_the_same_bits_and_to_others(
    mitsonar: Command, scene: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert mitsonar("render", scene, "-o", out, "--frames", 2, "--exr").returncode == 0
    assert mitsonar("image", out).returncode == 0
    np.testing.assert_array_equal(SonarFrames.load(out / "rebinned").image, SonarFrames.load(out).image)
    done = mitsonar("image", out, "--bins", 32, "--range", "4,5.5", "-o", tmp_path / "other")
    assert done.returncode == 0, done.stderr
    assert "outside the window" in done.stderr
    fewer = SonarFrames.load(tmp_path / "other")
    assert fewer.image.shape == (2, 32, 16)
    np.testing.assert_allclose(fewer.range_m[[0, -1]], [4 + 1.5 / 64, 5.5 - 1.5 / 64])
    assert fewer.poses is not None
    traced = Simulator(load_scene(scene), fewer.sonar)
    levels = np.concatenate([pings.levels for pings in traced.pings(fewer.poses)])
    np.testing.assert_allclose(np.minimum(levels, fewer.level_scale), fewer.image * fewer.level_scale, rtol=1e-6)


@pytest.mark.thorough
def test_quality_and_numbers_of_rays_are_chosen_on_the_command_line(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    def rays(*options: object) -> tuple[str, int, int]:
        done = mitsonar("render", scene, "-o", tmp_path / "out", "--overwrite", *options)
        assert done.returncode == 0, done.stderr
        sonar = SonarFrames.load(tmp_path / "out").sonar
        assert sonar is not None
        return sonar.quality, sonar.rays_per_beam, sonar.rays_across

    message = rays()  # the scene's own numbers
    draft = Sonar(beams=16, quality="draft")
    assert rays("--quality", "draft") == ("draft", draft.rays_per_beam, draft.rays_across) != message
    assert rays("--set", "quality=draft") == rays("--quality", "draft")
    assert rays("--quality", "draft", "--set", "rays_per_beam=20") == ("draft", 20, draft.rays_across)
    assert rays("--set", "rays_per_beam=20", "--set", "rays_across=3")[1:] == (20, 3)
    assert rays("--model", "thesis")[1:] == message[1:]
    refused(mitsonar("render", scene, "--quality", "fien"), "unknown quality 'fien': did you mean fine?")
    refused(mitsonar("render", scene, "--quality", "fine", "--model", "thesis"), "quality applies to the model physical")
    refused(mitsonar("render", scene, "--set", "rays_per_bem=20"), "did you mean rays_per_beam")
    refused(mitsonar("render", scene, "--set", "rays_per_beam"), "--set takes KEY=VALUE: got 'rays_per_beam'")
    refused(mitsonar("render", scene, "--set", "preset=aris3000"), "name it with --sonar")
    refused(mitsonar("render", scene, "--quality", "fine", "--set", "quality=draft"), "contradict each other")


def test_bad_input_is_answered_by_one_sentence(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "o"
    good = scene.read_text()

    def variant(text: str) -> Path:
        path = tmp_path / "bad.xml"
        path.write_text(text)
        return path

    refused(mitsonar("render", tmp_path / "none.xml"), "none.xml", "flat_floor")
    refused(mitsonar("render", "sunken_shp"), "sunken_ship")
    refused(mitsonar("render", variant("<scene version='3.0.0'><bla"), "-o", out), "bad.xml", "XML")
    refused(mitsonar("render", variant(good.replace('"beams"', '"beems"')), "-o", out), "beems")
    refused(
        mitsonar("render", variant(good.replace('name="beams" value="16"', 'name="beams" value="0"')), "-o", out), "beams"
    )
    window = '<float name="range_max" value="3"/>'
    text = good.replace("<transform", window + "<transform", 1)
    refused(mitsonar("render", variant(text), "-o", out), "range_max must exceed range_min", "3 m <= 3.2 m")
    text = good.replace("<transform", '<film type="hdrfilm"/><transform', 1)
    refused(mitsonar("render", variant(text), "-o", out), "film", "32 x 60", "remove")
    refused(mitsonar("render", variant(good.replace(SENSOR, "")), "-o", out), "imaging_sonar", "--sonar")
    refused(mitsonar("render", variant(good.replace(SENSOR, "")), "--sonar", "didson300", "-o", out), "--from")
    refused(mitsonar("render", scene, "--sonar", "didson30", "-o", out), "didson300")
    refused(mitsonar("render", scene, "--sonar", tmp_path / "no.yaml", "-o", out), "no.yaml")
    refused(mitsonar("render", scene, "--model", "phisical", "-o", out), "model", "physical")
    refused(mitsonar("render", scene, "--from", "0,0,nan,0,0,0", "-o", out), "finite")
    refused(mitsonar("render", scene, "--from", "0,0,1", "-o", out), "--from", "6 numbers")
    refused(mitsonar("render", scene, "--frames", 0, "-o", out), "--frames", "at least 1")
    refused(mitsonar("render", scene, "--noise", "loud", "-o", out), "noise", "low")
    refused(mitsonar("render", scene, "-D", "cells", "-o", out), "NAME=VALUE")
    tum = tmp_path / "broken.tum"
    tum.write_text("# t x y z q\n0 0 0 2 0 0 0 1\n1 0 0 2 0 0 zero 1\n")
    refused(mitsonar("render", scene, "--trajectory", tum, "-o", out), "line 3", "zero")
    refused(mitsonar("image", tmp_path), "run.json")
    assert not out.exists()


def test_an_out_that_exists_is_kept(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("years of work")
    refused(mitsonar("render", scene, "-o", mine), "contains other files (thesis.tex)", "kept", "-o")
    refused(mitsonar("render", scene, "-o", mine, "--overwrite"), "contains other files")
    assert (mine / "thesis.tex").read_text() == "years of work"
    out = tmp_path / "out"
    assert mitsonar("render", scene, "-o", out).returncode == 0
    before = (out / "frames.npz").read_bytes()
    refused(mitsonar("render", scene, "-o", out, "--seed", 5), "exists")
    refused(mitsonar("render", scene, "-o", out, "--seed", 5, "--resume"), "was begun with sonar.seed 0, not 5")
    assert (out / "frames.npz").read_bytes() == before
    assert mitsonar("render", scene, "-o", out, "--seed", 5, "--overwrite").returncode == 0
    assert (out / "frames.npz").read_bytes() != before


@pytest.mark.thorough
def test_without_llvm_the_error_names_the_command(scene: Path, tmp_path: Path) -> None:
    done = by_itself("render", scene, "-o", tmp_path / "o", DRJIT_LIBLLVM_PATH="/nonexistent", CUDA_VISIBLE_DEVICES="")
    refused(done, "libLLVM", "apt-get install")


def test_a_seed_changes_the_jitter_and_a_parameter_the_scene(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    images = []
    for name, options in (("a", []), ("b", ["--seed", 1]), ("c", ["-D", "cells=50"]), ("d", [])):
        assert mitsonar("render", scene, "-o", tmp_path / name, *options).returncode == 0
        images.append(SonarFrames.load(tmp_path / name).image)
    np.testing.assert_array_equal(images[0], images[3])
    assert not np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


@pytest.mark.posix
@pytest.mark.thorough
def test_a_killed_run_leaves_whole_frames_and_resumes_to_the_same_bits(
    mitsonar: Command, scene: Path, tmp_path: Path
) -> None:
    options = ["--frames", 60, "--to", "1,1,2.5,35,0,20", "--noise", "high"]
    assert mitsonar("render", scene, "-o", tmp_path / "whole", *options).returncode == 0
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "mitsonar", "render", str(scene), "-o", str(out), *map(str, options)]
    # few rays a launch make many batches, so that the kill comes between them
    command += ["--rays-per-launch", "20000"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    done = 0
    deadline = time.monotonic() + 120
    while done < 20 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
        if (out / "run.json").exists():
            done = json.loads((out / "run.json").read_text())["frames_done"]
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert 20 <= done < 60, done
    half = SonarFrames.load(out)
    whole = SonarFrames.load(tmp_path / "whole")
    assert 20 <= len(half) < 60
    np.testing.assert_array_equal(half.image, whole.image[: len(half)])
    for picture in sorted((out / "images").glob("*.png")):
        Image.open(picture).load()
    done_again = subprocess.run([*command, "--resume"], capture_output=True, text=True)
    assert done_again.returncode == 0, done_again.stderr
    finished = SonarFrames.load(out)
    for name in ("image", "poses", "height_m", "time_s"):
        np.testing.assert_array_equal(getattr(finished, name), getattr(whole, name))
    assert finished.level_scale == whole.level_scale
    for picture in sorted((tmp_path / "whole" / "images").glob("*.png")):
        assert (out / "images" / picture.name).read_bytes() == picture.read_bytes()
    state = json.loads((out / "run.json").read_text())
    assert state["tally"] == json.loads((tmp_path / "whole" / "run.json").read_text())["tally"]
    assert not (out / "frames.zarr").exists()
    assert mitsonar("render", scene, "-o", out, *options, "--resume").returncode == 0


def test_a_long_run_stays_zarr(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import mitsonar.simulation.runs as runs

    simulator = Simulator(load_scene(scene))
    path = Trajectory(np.tile([0, 0, 2.5, np.radians(35), 0, 0], (5, 1)), np.arange(5.0))
    run(simulator, path, RenderOptions(NOISE_MODELS["none"]), Destination(tmp_path / "npz"))
    monkeypatch.setattr(runs, "MAX_NPZ_FRAMES", 4)
    run(simulator, path, RenderOptions(NOISE_MODELS["none"]), Destination(tmp_path / "zarr"))
    assert not (tmp_path / "zarr" / "frames.npz").exists()
    np.testing.assert_array_equal(SonarFrames.load(tmp_path / "zarr").image, SonarFrames.load(tmp_path / "npz").image)


def test_stored_echoes_have_no_pattern(scene: Path, tmp_path: Path) -> None:
    """Echoes of rays are those ahead of pattern and absorption, and frames of them state so."""
    loaded = load_scene(scene)
    placed = sonar_in(loaded)
    assert placed is not None
    sonar = placed[0].replace(pattern="two_way", absorption_db_per_m=1.0)
    path = Trajectory(np.array([placed[1]]), np.zeros(1))
    run(Simulator(loaded, sonar), path, RenderOptions(NOISE_MODELS["none"], exr=True), Destination(tmp_path / "out"))
    source = StoredEchoes(tmp_path / "out")
    (pings,) = source.pings(path.poses)
    (boxes,) = Simulator(loaded, placed[0]).pings(path.poses)
    np.testing.assert_array_equal(pings.levels, boxes.levels)
    assert (source.sonar.beam_pattern, source.sonar.absorption_db_per_m) == ("box", None)


def test_broken_echoes_are_named(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert mitsonar("render", scene, "-o", out, "--exr").returncode == 0
    (out / "echoes" / "000000.exr").write_bytes(b"not an image")
    with pytest.raises(MitsonarError, match=r"000000\.exr"):
        list(StoredEchoes(out).pings(np.zeros((1, 6))))


def test_presets_scenes_and_doctor_print(mitsonar: Command) -> None:
    listed = mitsonar("presets")
    assert listed.returncode == 0
    assert "oculus-m1200d-2100khz" in listed.stdout
    one = mitsonar("presets", "gemini-720is")
    assert "0703-SOM-00002" in one.stdout
    assert re.search(r"rays_across +4 +from quality", one.stdout)
    assert re.search(r"absorption at 720 kHz: 0\.2\d+ dB/m one way$", one.stdout, re.MULTILINE)
    assert re.search(r"1,800 kHz: 1\.05 dB/m one way, extrapolated: ", mitsonar("presets", "didson300").stdout)
    errors = r"^gemini-720is +58 x 1 .*% / .*172 x 4 .*% / .*686 x 8 .*% / \d+ %  0\.\d\d$"
    for printed in (listed.stdout, one.stdout):  # rays and errors of each quality
        assert re.search(errors, printed, re.MULTILINE)
    refused(mitsonar("presets", "gemini"), "gemini-720is")
    instruments = ("ping2", "a50", "deltat-837", "sonar-3d-15", "starfish-450f")
    assert all(re.search(rf"^{name} +\w", listed.stdout, re.MULTILINE) for name in instruments)
    surfaces = mitsonar("materials").stdout
    assert re.search(r"sand-mhz +extrapolated +100\.\.3000 +lambert +-21\.5 ", surfaces)
    assert re.search(r"steel +computed +100\.\.3000 ", surfaces)
    assert "Olson, Lyons and Saebo" in mitsonar("materials", "rock-mhz").stdout
    refused(mitsonar("materials", "snd"), "did you mean sand")
    ping = mitsonar("presets", "ping2")
    assert re.search(r"mounts +\{'down'.* ours: straight down", ping.stdout)
    assert re.search(r"range_max +30 +ours, inside the instrument's 100 m", ping.stdout)
    assert "starfish-450f: Blueprint" in mitsonar("presets", "sidescan").stdout
    assert "sunken_ship" in mitsonar("scenes").stdout
    doctor = mitsonar("doctor")
    assert doctor.returncode == 0, doctor.stderr
    assert "all is well" in doctor.stdout
    assert "rays traced and binned" in doctor.stdout


LONG_TO_COMPILE = ("hydrophones", "objects", "observatory", "pattern", "sunken_ship")
"""Scenes of many materials or textures; the commands of the README render `pattern` along its trajectory."""


@pytest.mark.parametrize("name", LONG_TO_COMPILE)
def test_scenes_that_take_long_are_hit_along_their_trajectory(name: str) -> None:
    """Single rays along the axis of the sonar, from each pose in the middle of the path: each meets the scene."""
    import mitsuba as mi

    scene, path = load_scene(name), Trajectory.load_tum(shipped_trajectory(name))
    result = sonar_in(scene)
    assert result is not None
    poses = np.vstack([result[1], path.poses])
    ahead = to_world_matrices(poses)[:, :3, 2]
    rays = mi.Ray3f(mi.Point3f(*poses[:, :3].T.astype(np.float32)), mi.Vector3f(*ahead.T.astype(np.float32)))
    hits = scene.ray_intersect_preliminary(rays)
    away = np.where(np.array(hits.is_valid()), np.array(hits.t), np.inf)
    assert ((away > result[0].range_min) & (away < result[0].range_max)).mean() > 0.9, away


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.thorough) if name in LONG_TO_COMPILE else name
        for name in sorted(shipped_scenes())
    ],
)
def test_shipped_scenes_render_and_have_a_trajectory_to_fly(name: str) -> None:
    path = Trajectory.load_tum(shipped_trajectory(name))
    scene = load_scene(name)
    result = sonar_in(scene)
    assert result is not None
    frames = Simulator(scene).render([result[1], path.poses[len(path) // 2]], labels=True)
    assert frames.shape_id is not None
    lit = (frames.shape_id >= 0).mean(axis=(1, 2))  # noise and side lobes fill every pixel of a coherent image
    assert (lit > 0.05).all(), lit
    assert (lit < 0.98).all(), lit


@pytest.mark.thorough
def test_texture_parameter_of_the_pattern() -> None:
    images = []
    for texture in ("gaussian", "perlin_low", "photo_gravel"):
        scene = load_scene("pattern", texture=texture)
        result = sonar_in(scene)
        assert result is not None
        images.append(Simulator(scene, result[0].replace(rays_per_beam=100)).render([result[1]]).image)
    for index, image in enumerate(images):
        assert all(not np.array_equal(image, second) for second in images[index + 1 :])
    with pytest.raises(MitsonarError, match="mud"):
        load_scene("pattern", texture="mud")


@pytest.mark.thorough
def test_a_run_killed_after_its_last_frame_is_finished_by_resume(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mitsonar.records.frames import FrameStore

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    path = Trajectory(np.tile([0, 0, 2.5, np.radians(35), 0, 0], (3, 1)), np.arange(3.0))
    options = RenderOptions(NOISE_MODELS["none"])
    with monkeypatch.context() as patch:
        patch.setattr(FrameStore, "pack", killed)
        with pytest.raises(KeyboardInterrupt):
            run(Simulator(load_scene(scene)), path, options, Destination(tmp_path / "run"))
    assert not json.loads((tmp_path / "run" / "run.json").read_text())["finished"]
    run(Simulator(load_scene(scene)), path, options, Destination(tmp_path / "run", resume=True))
    assert json.loads((tmp_path / "run" / "run.json").read_text())["finished"]
    assert len(SonarFrames.load(tmp_path / "run")) == 3


def test_echoes_are_not_replaced_by_what_is_made_of_them(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert mitsonar("render", scene, "-o", out, "--exr").returncode == 0
    refused(mitsonar("image", out, "-o", out, "--overwrite"), "echoes", "another folder")
    refused(mitsonar("image", out, "-o", tmp_path, "--overwrite"), "another folder")
    assert (out / "echoes" / "000000.exr").is_file()


def test_a_damaged_state_is_not_gone_on_with(scene: Path, tmp_path: Path) -> None:
    """Killed in the middle, then written by a stranger: one sentence each, and the true state still goes on."""
    path = Trajectory(np.tile([0, 0, 2.5, np.radians(35), 0, 0], (3, 1)), np.arange(3.0))
    simulator, options = Simulator(load_scene(scene), rays_per_launch=4_000), RenderOptions(NOISE_MODELS["none"])
    calls: list[int] = []

    def killed(frames: int) -> None:
        calls.append(frames)
        if len(calls) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(simulator, path, options, Destination(tmp_path / "run", progress=killed))
    file = tmp_path / "run" / "run.json"
    stored = file.read_text()
    state = json.loads(stored)
    assert 0 < state["frames_done"] < 3
    for damage, output in (
        ({"frames_done": 4}, r"frames_done must be a whole number in 0\.\.3: got 4"),
        ({"frames_done": "1"}, "run frames_done: input should be a valid integer, got '1'"),
        ({"gain": 0.0}, "gain must be a finite number above 0"),
        ({"tally": {**state["tally"], "frames": "1"}}, r"damaged \(frames of the tally must be a whole number"),
        ({"tally": {**state["tally"], "worst": 3}}, r"damaged \(worst of the tally must be two counts"),
        ({"tally": None}, r"damaged \(run tally: input should be a valid dictionary, got None"),
    ):
        file.write_text(json.dumps(state | damage))
        with pytest.raises(MitsonarError, match=output):
            run(simulator, path, options, Destination(tmp_path / "run", resume=True))
    file.write_text(stored)
    run(simulator, path, options, Destination(tmp_path / "run", resume=True))
    run(simulator, path, options, Destination(tmp_path / "whole"))
    np.testing.assert_array_equal(SonarFrames.load(tmp_path / "run").image, SonarFrames.load(tmp_path / "whole").image)


def test_all_sensors_of_a_scene_in_one_run(mitsonar: Command, tmp_path: Path) -> None:
    """Each has its folder; a finished run is resumed for nothing; wrong pairs of options are one sentence."""
    second = SENSOR.replace('type="imaging_sonar"', 'type="imaging_sonar" id="down"').replace("0,3.57,0", "0,2,0")
    (tmp_path / "two.xml").write_text(f'<scene version="3.0.0">{DEFAULT}{SENSOR}{second}{FLOOR}</scene>')
    arguments = ("render", tmp_path / "two.xml", "--all-sensors", "--frames", 2, "-o", tmp_path / "out")
    done = mitsonar(*arguments)
    assert done.returncode == 0, done.stderr
    assert len(SonarFrames.load(tmp_path / "out" / "down")) == len(SonarFrames.load(tmp_path / "out" / "sensor0")) == 2
    assert mitsonar(*arguments, "--resume").returncode == 0
    refused(mitsonar(*arguments), "kept as it is")
    refused(mitsonar(*arguments, "--sonar", "didson300", "--overwrite"), "--sonar names one sonar")
    groups = (*arguments[:-1], tmp_path / "groups", "--set", "ping_groups=2", "--exr")
    refused(mitsonar(*groups), "sensor sensor0: echoes of each ray are stored only if a frame is one ping")
    assert not (tmp_path / "groups").exists()


# ---------------------------------------------------------------- how fast, and how often


@pytest.mark.parametrize("speed", [0.01, 0.0125])
def test_frames_of_a_head_are_its_sweeps_at_any_speed(speed: float) -> None:
    """A metre takes 100 or 80 s, and a sweep of a ping360 19 s: three of them end on the way."""
    from mitsonar.cli.options import path_for
    from mitsonar.instruments.sonar import timed_path
    from mitsonar.instruments.sounder import preset

    head, ends = preset("ping360"), ("0,0,2,10,0,0", "1,0,2,10,0,0")
    path = path_for(head, None, "flat_floor", 3, *ends, None, "mitsonar", speed)
    assert len(timed_path(head, path).frames) == 3
    assert path.poses[-1, 0] == pytest.approx(speed * path.time_s[-1])
    with pytest.raises(MitsonarError, match="room for 2: got 3"):
        path_for(head, None, "flat_floor", 3, *ends, None, "mitsonar", 0.025)


def test_speed_and_sweeps_are_as_asked_and_haste_is_told(mitsonar: Command, tmp_path: Path) -> None:
    out, draft = tmp_path / "o", ("--model", "physical", "--quality", "draft", "--set", "beams=8", "--overwrite")
    way = ("--from", "0,0,2,30,0,0", "--to", "0,3,2,30,0,0", "--frames", 4)
    done = mitsonar("render", "flat_floor", "--sonar", "didson300", *way, "-o", out, *draft)
    assert "moves 3 m in 0.143 s, 21 m/s" in done.stderr
    done = mitsonar("render", "flat_floor", "--sonar", "didson300", *way, "--speed", 2, "-o", out, *draft)
    assert done.returncode == 0, done.stderr
    assert "the vehicle moves" not in done.stderr
    assert np.loadtxt(out / "poses.tum")[:, 0] == pytest.approx([0, 0.5, 1, 1.5])
    refused(mitsonar("render", "flat_floor", "--speed", 1, "-o", out), "--speed must be above 0 m/s, and needs")
    head = ("render", "objects", "--sonar", "ping360", "--set", "range_max=10", "--trajectory", "shipped", "-o", out)
    refused(mitsonar(*head, "--frames", 5), "a sweep lasts 13.33 s", "--frames counts the sweeps")


def test_pings_that_overlap_are_told(mitsonar: Command, tmp_path: Path) -> None:
    arguments = (
        "--sonar",
        "didson300",
        "--from",
        "0,0,2,30,0,0",
        "--frames",
        2,
        "--model",
        "physical",
        "--quality",
        "draft",
    )
    done = mitsonar("render", "flat_floor", *arguments, "--set", "ping_groups=8", "-o", tmp_path / "o")
    assert "they overlap, which no instrument can do; lower frame_rate_hz to 16.7" in done.stderr
    stored = mitsonar("render", "flat_floor", *arguments, "--set", "ping_groups=8", "-o", tmp_path / "o", "--resume")
    assert "they overlap" in stored.stderr
    slower = ("--set", "ping_groups=8", "--set", "frame_rate_hz=16")
    assert "overlap" not in mitsonar("render", "flat_floor", *arguments, *slower, "-o", tmp_path / "p").stderr
