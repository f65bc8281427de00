"""``mitsonar sas`` as a user meets it."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import Command, Done, refused

from mitsonar.acoustics.water import Water, absorption_db_per_m
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.responses import ImpulseResponses
from mitsonar.records.strips import StripImage

ENDS = ("--from", "0,-1.2,2.5,0,0,0", "--to", "0,1.2,2.5,0,0,0", "--speed", 0.5)
SMALL = ("--element", 0.05, "--receivers", 4, "--set", "range_max=6", "--set", "carrier_hz=200e3")


@pytest.mark.thorough
def test_it_writes_what_it_promises_and_continues_where_it_was_interrupted(mitsonar: Command, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = mitsonar("sas", "flat_floor", *ENDS, *SMALL, "-o", out)
    assert done.returncode == 0, done.stderr
    assert "resolution 2.5 cm along" in done.stdout
    assert {one.name for one in out.iterdir()} == {"image.npz", "image.png", "responses", "run.json"}
    image = StripImage.load(out / "image.npz")
    assert image.grid.along_step_m == pytest.approx(0.0125)
    assert (np.abs(image.value) > 0).mean() > 0.9
    # phase centres 2.5 cm apart, four a ping: a ping every 10 cm
    responses = ImpulseResponses.load(out / "responses")
    assert len(responses) == 25
    assert responses.sonar.absorption_db_per_m == pytest.approx(float(absorption_db_per_m(200e3, Water())))
    stored = ImpulseResponses.load(out / "responses" / "responses.zarr", stored=True)
    np.testing.assert_array_equal(stored.response[3], responses.response[3])
    assert len(stored) == 25
    # a finished run is kept, and another grid is another run
    refused(mitsonar("sas", "flat_floor", *ENDS, *SMALL, "-o", out), "--resume continues it")
    refused(mitsonar("sas", "flat_floor", *ENDS, *SMALL, "--pixel", "0.05,0.05", "-o", out, "--resume"), "grid")
    # as after a kill: half of the pings, no picture
    half = tmp_path / "half"
    shutil.copytree(out, half)
    (half / "image.npz").unlink()
    (half / "responses" / "responses.npz").unlink()
    for folder, notes in ((half, {"measured": 0, "rows_done": 0}), (half / "responses", {"frames_done": 9})):
        about = json.loads((folder / "run.json").read_text())
        (folder / "run.json").write_text(json.dumps(about | {"finished": False} | notes))
    again = mitsonar("sas", "flat_floor", *ENDS, *SMALL, "-o", half, "--resume")
    assert again.returncode == 0, again.stderr
    np.testing.assert_array_equal(StripImage.load(half / "image.npz").value, image.value)


TANK = """<scene version="3.0.0">
    <shape type="rectangle" id="floor"><transform name="to_world"><scale value="8"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.05"/></bsdf></shape>
    <shape type="sphere" id="float"><float name="radius" value="0.2"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.9"/></bsdf></shape>
</scene>"""


@pytest.mark.thorough
def test_a_body_is_where_its_path_says(mitsonar: Command, tmp_path: Path) -> None:
    """A float that rests 3.5 m abeam of the middle of the track; the same run is not resumed with another path."""
    (tmp_path / "tank.xml").write_text(TANK)
    for name, y in (("here", 0.0), ("there", 0.5)):
        Trajectory(np.array([[3.5, y, 0.2, 0, 0, 0]]), np.zeros(1)).save(tmp_path / f"{name}.tum")

    def run(path: str, *more: str) -> Done:
        moving = ("--moving", f"float={tmp_path / path}.tum")
        return mitsonar("sas", tmp_path / "tank.xml", *ENDS, *SMALL, *moving, *more, "-o", tmp_path / "out")

    done = run("here")
    assert done.returncode == 0, done.stderr
    image = StripImage.load(tmp_path / "out" / "image.npz")
    along, across = np.meshgrid(image.grid.along_m - 1.2, image.grid.across_m, indexing="ij")  # from the middle
    power = np.abs(image.value) ** 2
    near = np.hypot(along, across - 3.4) < 0.3  # its near side appears a little nearer, since it stands above the ground
    assert power[near].mean() > 5 * power[(np.abs(along) > 0.35) & (np.abs(across - 3.4) < 0.3)].mean()
    refused(run("there", "--resume"), "moving")
    refused(mitsonar("sas", tmp_path / "tank.xml", *ENDS, *SMALL, "--moving", f"boat={tmp_path / 'here.tum'}"), "boat")


@pytest.mark.slow
def test_another_navigation_is_corrected(mitsonar: Command, tmp_path: Path) -> None:
    """Flown with a sway of 1 mm; the navigation knows a straight line."""
    straight = Trajectory.between(Pose(0, -1.2, 2.5), Pose(0, 1.2, 2.5), 97, 20.0)
    flown = straight.poses.copy()
    flown[:, 0] += 1e-3 * np.sin(2 * np.pi * np.arange(97) / 40)
    straight.save(tmp_path / "straight.tum")
    Trajectory(flown, straight.time_s).save(tmp_path / "flown.tum")
    out = tmp_path / "out"
    paths = ("--trajectory", tmp_path / "flown.tum", "--navigation", tmp_path / "straight.tum")
    done = mitsonar("sas", "flat_floor", *paths, *SMALL, "--correct", "dpc", "-o", out)
    assert done.returncode == 0, done.stderr
    assert "displaced phase centres: coherence" in done.stdout
    with (out / "micronavigation.csv").open() as file:
        rows = list(csv.DictReader(file))
    responses = ImpulseResponses.load(out / "responses")
    assert responses.poses is not None
    sway = np.array([float(row["sway_m"]) for row in rows])
    assert sway == pytest.approx(np.diff(responses.poses[:, 0]), abs=5e-5)
    assert len(Trajectory.load(out / "corrected.tum")) == len(responses)
    again = mitsonar("sas", "flat_floor", *paths, *SMALL, "--correct", "dpc", "-o", out, "--resume")
    assert again.returncode == 0, again.stderr


@pytest.mark.slow
def test_pairs_of_pings_without_coherence_are_named(mitsonar: Command, tmp_path: Path) -> None:
    """One fix of the navigation is 0.5 m off to the side, beyond the delays that are compared."""
    straight = Trajectory.between(Pose(0, -1.2, 2.5), Pose(0, 1.2, 2.5), 49, 10.0)
    wrong = straight.poses.copy()
    wrong[24, 0] += 0.5
    straight.save(tmp_path / "straight.tum")
    Trajectory(wrong, straight.time_s).save(tmp_path / "wrong.tum")
    out = tmp_path / "out"
    paths = ("--trajectory", tmp_path / "straight.tum", "--navigation", tmp_path / "wrong.tum")
    done = mitsonar("sas", "flat_floor", *paths, *SMALL, "--correct", "dpc", "-o", out)
    assert done.returncode == 0, done.stderr
    with (out / "micronavigation.csv").open() as file:
        unused = sum(row["sway_m"] == "nan" for row in csv.DictReader(file))
    assert 1 <= unused < 10
    assert f"{unused} of 48 pairs of pings not used" in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ((*ENDS, "--frames", 9), "the aperture is aliased"),
        (("--from", "0,0,2.5,0,0,0"), "give a path"),
        (("--trajectory", "path.tum", "--speed", 1.5), "path.tum has times of its own: leave --speed out"),
        (("--from", "0,0,2.5,0,0,0", "--to", "0,0,2.5,0,0,0"), "path that moves"),
        ((*ENDS[:4], "--speed", 60), "before the echo from 6 m is back"),
        ((*ENDS, "--side", "up"), "port or starboard"),
        ((*ENDS, "--correct", "dcp"), "did you mean dpc"),
        ((*ENDS, "--weighting", "taylor"), "uniform or hann"),
        ((*ENDS, "--pixel", "0,1"), "--pixel"),
        ((*ENDS, "--range", "2,30"), "--range"),
        ((*ENDS, "--set", "carrier=3"), "carrier_hz"),
        ((*ENDS, "--set", "carrier_hz=high"), "must be a number"),
        ((*ENDS, "--set", "rolloff=1"), "sets rolloff itself"),
        ((*ENDS, "--navigation", "none.tum"), "none.tum"),
        (("--from", "0,-0.2,2.5,0,0,0", "--to", "0,0.2,2.5,0,0,0", "--speed", 0.5), "shorter than the aperture"),
        (("--from", "0,-1.2,2.5,0,0,90", "--to", "0,1.2,2.5,0,0,90", "--speed", 0.5), "head along"),
    ],
)
def test_what_cannot_work_is_one_sentence(mitsonar: Command, tmp_path: Path, wrong: tuple[object, ...], says: str) -> None:
    refused(mitsonar("sas", "flat_floor", *wrong, *SMALL, "-o", tmp_path / "out"), says)
    assert not (tmp_path / "out").exists()
