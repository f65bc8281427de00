"""``mitsonar impulse``: what it writes, resumes, warns of and refuses."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from helpers import PROGRAM, Command, refused
from PIL import Image

from mitsonar.records.responses import ImpulseResponses
from mitsonar.worlds.sea import SeaSurface

SCENE = """<scene version="3.0.0">
    <default name="half" value="13"/>
    <sensor type="channel_sonar">
        <string name="receivers" value="front, right{names}"/>{more}
        <transform name="to_world"><lookat origin="0, 0, 10" target="0, 1, 10" up="0, 0, 1"/></transform>
    </sensor>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><scale value="$half"/></transform>
        <bsdf type="diffuse"><texture type="cell_noise" name="reflectance"><float name="cells" value="200"/></texture></bsdf>
    </shape>
</scene>"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "floor.xml"
    path.write_text(SCENE.format(names="", more=""))
    return path


@pytest.mark.thorough
def test_it_writes_responses_and_figures(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = mitsonar("impulse", scene, "--velocity", "2,-1", "--frames", 20, "-o", out)
    assert done.returncode == 0, done.stderr
    assert "20 pings (scatterers model, unnamed channel sonar: front, right) of 800 taps" in done.stdout
    assert "spread factor" in done.stdout
    assert "changes the phase by up to" in done.stdout
    assert "overspread" in done.stderr  # at half the speed no receiver's own factor is above 0.3
    npz, stored = ImpulseResponses.load(out), ImpulseResponses.load(out / "responses.zarr")
    assert npz.response.dtype == np.complex64
    assert npz.response.shape == (20, 2, 800)
    assert np.array_equal(npz.response, stored.response)
    assert np.load(out / "responses.npz")["delay_s"][1] == 1 / 8000
    assert npz.poses is not None
    assert np.allclose(npz.poses[-1, :3] - npz.poses[0, :3], (2 * 19 / 20, -19 / 20, 0))
    assert npz.velocity is not None
    assert np.array_equal(npz.velocity, [[2, -1, 0, 0]] * 20)
    for name in ("response.png", "waterfall.png"):
        assert np.ptp(np.asarray(Image.open(out / name))) > 100
    again = mitsonar("impulse", scene, "--velocity", "2,-1", "--frames", 20, "-o", out)
    refused(again, "kept as it is", "--resume")
    assert mitsonar("impulse", scene, "--velocity", "2,-1", "--frames", 20, "-o", out, "--resume").returncode == 0
    refused(mitsonar("impulse", scene, "--frames", 20, "-o", out, "--resume"), "was begun with", "poses_sha256", "velocity")


@pytest.mark.posix
@pytest.mark.slow
def test_killed_and_resumed_it_is_the_unbroken_one(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    arguments = ["impulse", scene, "--velocity", "1,-0.5,3", "--frames", 400]
    whole = mitsonar(*arguments, "-o", tmp_path / "whole")
    assert whole.returncode == 0, whole.stderr
    out = tmp_path / "broken"
    process = subprocess.Popen(
        [*PROGRAM, *map(str, arguments), "-o", str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    state, deadline = out / "run.json", time.monotonic() + 150
    while time.monotonic() < deadline and process.poll() is None:
        if state.is_file() and 0 < json.loads(state.read_text())["frames_done"] < 400:
            break
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = int(json.loads((out / "run.json").read_text())["frames_done"])
    assert 0 < done < 400
    assert not (out / "responses.npz").exists()
    assert mitsonar(*arguments, "-o", out, "--resume").returncode == 0
    first, second = (ImpulseResponses.load(folder) for folder in (tmp_path / "whole", out))
    assert np.array_equal(first.response, second.response)


@pytest.mark.thorough
def test_a_course_by_name_and_keys_of_the_instrument(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = mitsonar(
        "impulse", scene, "--trajectory", "diagonal", "--frames", 5, "--model", "rays", "--set", "rays=2000",
        "--set", "carrier_hz=40e3", "-o", out,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    responses = ImpulseResponses.load(out)
    assert (responses.sonar.model, responses.sonar.rays, responses.sonar.carrier_hz) == ("rays", 2000, 40e3)
    assert responses.velocity is not None
    assert np.allclose(responses.velocity[:, :2], 1.0)


@pytest.mark.thorough
def test_fewer_pings_of_a_path_keep_its_velocity_and_some_receivers_may_do(
    mitsonar: Command, scene: Path, tmp_path: Path
) -> None:
    """A circle of 5 m in 20 s: chords across it would be another velocity."""
    out = tmp_path / "out"
    words = ("--trajectory", "circle", "--frames", 4, "--set", "receivers=right")
    done = mitsonar("impulse", scene, *words, "-o", out)
    assert done.returncode == 0, done.stderr
    responses = ImpulseResponses.load(out)
    assert [one.name for one in responses.sonar.receivers] == ["right"]
    assert responses.velocity is not None
    np.testing.assert_allclose(np.hypot(*responses.velocity[:, :2].T), 2 * np.pi * 5 / 20, rtol=0.01)
    assert repr(responses).startswith("ImpulseResponses(4 pings, 1 receivers (right), 800 taps")


@pytest.mark.thorough
def test_standing_still_is_told(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    done = mitsonar("impulse", scene, "--frames", 2, "-o", tmp_path / "out")
    assert "does not move" in done.stderr
    response = ImpulseResponses.load(tmp_path / "out").response
    np.testing.assert_allclose(response[1], response[0], atol=1e-6 * np.abs(response).max())


@pytest.mark.thorough
def test_a_receiver_that_hears_nothing_is_named(mitsonar: Command, tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(
        SCENE.format(
            names=", up",
            more='<float name="up_heading_deg" value="0"/><float name="up_tilt_deg" value="170"/>'
            '<point name="up_position" value="0, 0, 20"/>',
        )
    )
    done = mitsonar("impulse", path, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "receiver up has no echo in 1 of 1 ping" in done.stderr
    assert "above 90: upwards" in done.stderr
    assert "receiver up is 20 m from the transmitter: positions are in metres" in done.stderr
    assert "receiver front" not in done.stderr
    assert not ImpulseResponses.load(tmp_path / "out").response[0, 2].any()


@pytest.mark.thorough
def test_echoes_from_too_far_are_told(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    done = mitsonar("impulse", scene, "--set", "range_max=12", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "came from beyond range_max 12 m and were dropped" in done.stderr


def test_mistakes_are_answered(mitsonar: Command, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    refused(mitsonar("impulse", scene, "--set", "frequency_step_hz=20"), "frequency_step_hz must be below", "give")
    refused(mitsonar("impulse", scene, "--set", "bandwidth_hz=9600"), "sampling_hz must be at least")
    refused(mitsonar("impulse", scene, "--set", "carrier_hz=0"), "carrier_hz must exceed")
    refused(mitsonar("impulse", scene, "--set", "carrier"), "KEY=VALUE")
    refused(mitsonar("impulse", scene, "--model", "points"), "scatterers")
    refused(mitsonar("impulse", scene, "--velocity", "1"), "--velocity takes vx,vy or vx,vy,turn")
    refused(mitsonar("impulse", scene, "--velocity", "900,0"), "a tenth of the sound speed", "m/s")
    refused(mitsonar("impulse", scene, "--set", "receivers=front,bow"), "among the receivers front, right: got 'bow'")
    refused(mitsonar("impulse", scene, "--set", "transmitter=all"), "in the scene or in Python")
    refused(mitsonar("impulse", scene, "--from", "0,0,-10,0,0,0"), "no receiver has an echo", "(0, 0, -10) m")
    refused(mitsonar("impulse", scene, "--trajectory", "sqare"), "unknown course 'sqare'", "square")
    refused(mitsonar("impulse", scene, "--trajectory", tmp_path / "no.tum"), "no such file: ")
    refused(mitsonar("impulse", scene, "--trajectory", "square", "--velocity", "1,1"), "contradict")
    refused(mitsonar("impulse", "flat_floor"), "no channel_sonar", "--from")
    bare = tmp_path / "bare.xml"
    bare.write_text('<scene version="3.0.0"/>')
    refused(mitsonar("impulse", bare, "--from", "0,0,10,0,0,0"), "no surface that can carry scatterers")
    assert not (tmp_path / "out").exists()  # nothing was begun


SEA = """<scene version="3.0.0">
    <sensor type="channel_sonar">
        <string name="receivers" value="front"/><string name="shape" value="all"/>
        <transform name="to_world"><lookat origin="0, 0, 3" target="0, 1, 3" up="0, 0, 1"/></transform>
    </sensor>
    <shape type="ply" id="surface">
        <string name="filename" value="sea/meshes/surface.ply"/>
        <bsdf type="acoustic_material"><string name="material" value="sea/surface.yaml"/></bsdf>
    </shape>
</scene>"""


@pytest.mark.thorough
def test_a_sea_surface_is_a_mirror_of_ones_own_scene(mitsonar: Command, tmp_path: Path) -> None:
    """`world sea-surface`, then its material (--mirrors) or numbers of one's own (--mirror) give the same bits."""
    result = mitsonar("world", "sea-surface", "--wind-m-s", 2, "--size-m", 8, "--step-m", 0.1, "-o", tmp_path / "sea")
    assert result.returncode == 0, result.stderr
    height = SeaSurface(wind_m_s=2.0, size_m=8.0, step_m=0.1).state.roughness_m
    assert f"waves below 0.4 m are its roughness, rms {height:.3g} m" in result.stdout
    scene = tmp_path / "mine.xml"
    scene.write_text(SEA)
    runs = {}
    for name, more in {"own": ["--mirror", f"surface=-1,{height:.4g}"], "material": ["--mirrors"], "none": []}.items():
        done = mitsonar("impulse", scene, "--set", "points_per_m2=1", *more, "-o", tmp_path / name)
        assert done.returncode == 0, done.stderr
        runs[name] = ImpulseResponses.load(tmp_path / name).response
        assert json.loads((tmp_path / name / "run.json").read_text())["asked"].get("mirrors") == (
            {"own": {"surface": [-1.0, float(f"{height:.4g}")]}, "material": True}.get(name)
        )
    assert np.array_equal(runs["own"], runs["material"])
    assert np.abs(runs["own"] - runs["none"]).max() > 0.1 * np.abs(runs["none"]).max()


@pytest.mark.thorough
def test_bodies_move(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    """The command places a body at the times of its pings, and says on which path it went."""
    fish = '<shape type="cube" id="fish"><transform name="to_world"><scale value="0.3"/></transform></shape></scene>'
    scene.write_text(scene.read_text().replace("</scene>", fish))
    (tmp_path / "fish.tum").write_text("0 0 0 4 0 0 0 1\n0.1 2 0 4 0 0 0 1\n")
    runs = {}
    for name, more in {"moves": ["--moving", f"fish={tmp_path / 'fish.tum'}"], "rests": []}.items():
        done = mitsonar("impulse", scene, "--frames", 2, "--set", "points_per_m2=50", *more, "-o", tmp_path / name)
        assert done.returncode == 0, done.stderr
        assert ("does not move" in done.stderr) == (name == "rests")
        runs[name] = ImpulseResponses.load(tmp_path / name).response[:, 0]
    early = slice(0, 8 * 12)  # before 9 m there and back: the fish alone
    assert np.abs(runs["rests"][:, early]).max() < 0.2 * np.abs(runs["moves"][:, early]).max()
    first, later = np.abs(runs["moves"][:, early])
    assert np.abs(first - later).max() > 0.2 * first.max()
    assert "fish" in json.loads((tmp_path / "moves" / "run.json").read_text())["asked"]["moving"]
    done = mitsonar("impulse", scene, "--model", "rays", "--moving", f"fish={tmp_path / 'fish.tum'}", "-o", tmp_path / "x")
    refused(done, "model scatterers only", "got rays while fish moves")


def test_mirrors_that_do_not_fit_are_refused(mitsonar: Command, scene: Path, tmp_path: Path) -> None:
    for given, *words in (
        (["--mirror", "floor=-1"], "--mirror NAME=V,H takes 2 numbers, separated by commas: got '-1'"),
        (["--mirror", "=-1,0"], "--mirror takes NAME=V,H, reflection and rms height [m] of a shape: got '=-1,0'"),
        (["--mirror", "floor=-1,0", "--mirrors"], "give only one"),
        (["--mirror", "flor=-1,0"], "the scene has no shape flor: did you mean floor?"),
        (["--mirror", "floor=-2,0"], "must lie in -1..1"),
        (["--mirrors", "--set", "bounces=2"], "bounces 2 need mirrors"),
    ):
        refused(mitsonar("impulse", scene, *given, "-o", tmp_path / "out"), *words)
