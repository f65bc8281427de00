"""The odometry benchmark: its sets, its rows against closed forms, its folder that goes on, and its command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from drawn_frames import over_ground, sway
from helpers import Command
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError
from mitsonar.estimation.named import Zero, create_estimator
from mitsonar.instruments.sounder import load_sonar
from mitsonar.mapping import odometry_run
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import path_length
from mitsonar.recordings.write_aris import write_aris
from mitsonar.records.frames import SonarFrames
from mitsonar.reproduction import odometry_benchmark
from mitsonar.reproduction.odometry_benchmark import (
    SETS,
    STEP_M,
    Case,
    RenderedSet,
    Wanted,
    benchmark_course,
    benchmark_lines,
    benchmark_odometry,
    dive_course,
    measure_row,
)
from mitsonar.worlds.families import ShipHull
from mitsonar.worlds.world import Floor, World, sloped

Row = dict[str, Any]


@pytest.fixture(autouse=True)
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """No figure of each path, which takes a second, and fewer pairs to time."""
    monkeypatch.setattr(odometry_run, "save_figure", lambda path, figure: None)
    monkeypatch.setattr(odometry_run, "path_figure", lambda *_, **__: None)
    monkeypatch.setattr(odometry_benchmark, "TIMED_PAIRS", 2)


@pytest.fixture(scope="module")
def frames() -> SonarFrames:
    """Twelve frames of a drawn floor, with true poses."""
    return over_ground(sway(12))


@pytest.fixture
def run_of(frames: SonarFrames, tmp_path: Path) -> Path:
    """The folder of a run of them."""
    folder = tmp_path / "run"
    folder.mkdir()
    frames.save(folder / "frames.npz")
    return folder


def row_of(frames: SonarFrames, method: str, folder: Path, **options: Any) -> Row:
    case = Case("drawn", "recorded", "none", method)
    return measure_row(case, FrameSource.of(frames), create_estimator(method), folder, **options)


# ---------------------------------------------------------------- sets


def test_the_course_moves_as_much_as_networks_were_trained_for() -> None:
    course = benchmark_course(260)
    moved = motions(course)
    assert np.linalg.norm(moved[:, :2], axis=1) == pytest.approx(STEP_M, rel=1e-9)
    assert np.abs(moved).max(axis=0)[0] == pytest.approx(STEP_M / 2, rel=0.02)
    assert np.degrees(np.abs(moved[:, 2]).max()) < 0.31
    np.testing.assert_allclose(course[0, :2] + course[-1, :2], 0, atol=1e-12)


def test_a_set_stands_where_its_sonar_sees_the_ground() -> None:
    """The height over a slope follows the course; the path has the length of its steps."""
    for name, one in SETS.items():
        path = one.path(260, 20.0)
        if one.flight is not None:
            continue
        height = path.poses[:, 2] - np.tan(np.radians(one.slope_deg)) * path.poses[:, 1]
        assert (height > 0.3).all(), name
        assert path_length(path) == pytest.approx(259 * STEP_M)
        assert one.sonar("still", "none").model == "physical"
        levels = [one.sonar("speckle", noise).noise_level_db for noise in ("none", "low", "high")]
        assert levels[:2] == [None, load_sonar(one.preset).noise_level_db]
        assert levels[2] == pytest.approx(float(levels[1] or 0) + one.raised_db)


def test_a_dive_moves_as_on_a_calm_day() -> None:
    level, gentle = (SETS[f"dive-aris3000-{flight}-11"].path(400, 20.0) for flight in ("level", "gentle"))
    assert path_length(level) == pytest.approx(399 * 0.04)
    np.testing.assert_allclose(level.poses[:, [0, 4, 5]], 0, atol=1e-12)
    np.testing.assert_allclose(np.diff(level.time_s), 0.1)
    vehicle = dive_course(400, 10.0, 11, 1.0)
    np.testing.assert_allclose(np.ptp(vehicle, axis=0)[2:] / 2, [0.04, *np.radians([2, 2, 8])], rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(motions(vehicle)[:, :2], axis=1), 0.04)
    np.testing.assert_allclose(gentle.poses[:, :2], vehicle[:, :2])
    assert not np.allclose(SETS["dive-aris3000-gentle-3"].path(400, 20.0).poses, gentle.poses)


def test_a_dive_has_its_presets_own_settings() -> None:
    for name, one in SETS.items():
        if one.flight is not None:
            stored = load_sonar(one.preset)
            result = one.sonar("speckle", "preset")
            assert (result.model, result.quality, result.noise_level_db) == (
                "coherent",
                stored.quality,
                stored.noise_level_db,
            ), name
            assert result.coding == stored.coding


def test_dives_are_a_table_over_their_worlds() -> None:
    """Failures add up, squared errors and NEES are means, drift is the median."""
    row = {"texture": "still", "noise": "preset", "method": "direct", "frames": 40, "pairs": 39, "note": "", "path_m": 1.5}
    rows = [
        row | {"set": f"dive-didson300-level-{seed}", "failures": seed == 3, "rmse": [rmse, 0.5, 0.01], "nees": nees}
        | {"bound": [0.1, 0.1, 0.001], "end_percent": drift, "ms": 20.0}
        for seed, rmse, nees, drift in ((3, 3.0, 1.0, 0.5), (11, 4.0, 2.0, 0.9), (20, 0.0, 0.5, 2.5))
    ]  # fmt: skip
    lost = {name: value for name, value in rows[0].items() if name not in ("path_m", "rmse", "nees", "bound", "end_percent")}
    lost |= {"set": "dive-didson300-gentle-3", "failures": 39}
    lines = [" ".join(line.split()) for line in benchmark_lines([*rows, lost])]
    nees = (38 * 1.0 + 39 * 2.0 + 39 * 0.5) / 116
    rms = np.sqrt(25 / 3)
    assert (
        f"| didson300 | still | level | 1 of 117 | {rms:.2f} / 0.50 / 0.010 | 0.10 / 0.10 / 0.001 | {nees:.2f} | 0.90 | 20 |"
    ) in lines
    assert "| didson300 | still | gentle | 39 of 39 | - | - | - | - | 20 |" in lines
    assert sum("still" in line for line in lines) == 2


def test_a_slope_turns_all_of_a_world() -> None:
    """Vertices of the slope lie over its floor as those of the level world do: same distances to the plane."""
    level = ShipHull(size_m=6, groups_a_side=(1, 2), anodes_a_side=(2, 3)).build(5)
    tilted = sloped(level, 10.0)
    normal = np.array([0.0, -np.sin(np.radians(10)), np.cos(np.radians(10))])
    for mesh, turned in zip(level.meshes, tilted.meshes, strict=True):
        np.testing.assert_allclose(turned.vertices @ normal, mesh.vertices[:, 2], atol=1e-12)
    assert level.floor is not None
    assert tilted.floor is not None
    assert '<rotate x="1" angle="10.0"/>' in tilted.floor.xml()
    assert "rotate" not in level.floor.xml()


def test_a_floor_off_the_origin_turns_as_meshes_do() -> None:
    """Corners of the plane lie at its height above the turned level plane, by the order of the transforms."""
    transform = ElementTree.fromstring(Floor(5.0, "<texture/>", z_m=0.7, slope_deg=10.0).xml()).find("transform")
    assert transform is not None
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    for step in transform:
        match step.tag:
            case "scale":
                corners *= float(step.attrib["value"])
            case "translate":
                corners[:, 2] += float(step.attrib["z"])
            case "rotate":
                corners = Rotation.from_euler("x", float(step.attrib["angle"]), degrees=True).apply(corners)
    normal = np.array([0.0, -np.sin(np.radians(10)), np.cos(np.radians(10))])
    np.testing.assert_allclose(corners @ normal, 0.7, atol=1e-12)


@pytest.mark.usefixtures("variant")
def test_the_ground_of_the_slope_rises_forward(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Heights below the sonar, by rays, against the plane in closed form."""
    small = replace(
        SETS["slope"], family=ShipHull(size_m=30, groups_a_side=(0, 0), anodes_a_side=(1, 1)), preset="didson300",
        window={"range_min": 4.0, "range_max": 9.0, "range_bins": 64, "beams": 16},
    )  # fmt: skip
    monkeypatch.setitem(odometry_benchmark.SETS, "slope", small)
    monkeypatch.setitem(odometry_benchmark.TEXTURES, "still", {"model": "physical", "rays_per_beam": 20, "rays_across": 1})
    source = RenderedSet("slope", "still", "none", 12, tmp_path).source(lambda what, count: _Quiet())
    assert source.poses is not None
    expected = source.poses[:, 2] - np.tan(np.radians(10)) * source.poses[:, 1]
    assert source.height_m is not None
    np.testing.assert_allclose(source.height_m, expected, atol=0.04)  # an anode is 0.03 m high


class _Quiet:
    """Progress of nobody."""

    def __enter__(self) -> Any:
        return lambda done: None

    def __exit__(self, *_: object) -> None:
        return None


# ---------------------------------------------------------------- rows


def test_zero_errs_by_all_of_the_motion(frames: SonarFrames, tmp_path: Path) -> None:
    row = row_of(frames, "zero", tmp_path / "row", bound=np.array([1e-3, 1e-3, 1e-3]))
    assert frames.poses is not None
    true = motions(frames.poses)
    rms = np.sqrt((true**2).mean(axis=0)) * [1e3, 1e3, 180 / np.pi]
    np.testing.assert_allclose(row["rmse"], rms)
    np.testing.assert_allclose(row["over_bound"], rms / [1, 1, 0.18 / np.pi])
    ends = np.linalg.norm(frames.poses[-1, :2] - frames.poses[0, :2])
    assert row["end_percent"] == pytest.approx(100 * ends / row["path_m"])
    assert (row["failures"], row["pairs"], row["nees"]) == (0, 11, None)
    assert "drift_percent" not in row  # a path of 0.2 m holds no segment of 1 m


def test_a_method_is_judged_by_its_path_over_segments(frames: SonarFrames, tmp_path: Path, monkeypatch: Any) -> None:
    """The same frames as if they were 20 times as far apart: zero drifts by all of each segment's chord."""
    assert frames.poses is not None
    far = frames.poses * [20, 20, 1, 1, 1, 1]
    row = row_of(replace(frames, poses=far), "zero", tmp_path / "row")
    assert row["lengths_m"][0] == 1
    drift, low, high = row["drift_percent"]
    assert 95 < low <= drift <= high < 150  # frames are 0.2 m apart, so that a segment may be longer than its length


def test_motions_that_all_fail_are_a_row(frames: SonarFrames, tmp_path: Path) -> None:
    empty = replace(frames, image=np.zeros_like(frames.image))
    row = row_of(empty, "ecc", tmp_path / "row")
    assert row["failures"] == row["pairs"] == 11
    assert "none of 11 motions is valid" in row["note"]


def test_without_truth_loops_are_closed(frames: SonarFrames, tmp_path: Path) -> None:
    assert frames.poses is not None
    blind = replace(frames, poses=None, attitude_rad=frames.poses[:, 3:6])
    row = row_of(blind, "direct", tmp_path / "row")
    assert "rmse" not in row
    assert row["closure_steps"] == 8
    assert max(row["closure"][:2]) < 3  # mm
    np.testing.assert_allclose(row["sums"][:2], motions(frames.poses).sum(axis=0)[:2] * 1e3, atol=8)


def test_the_overview_has_a_column_a_set() -> None:
    row = {"texture": "still", "noise": "none", "frames": 9, "pairs": 8, "failures": 2, "note": "", "ms": 1.0, "path_m": 2.0}
    rows = [
        row | {"set": "rocks", "method": "ecc", "drift_percent": [3.25, 2.0, 4.0]},
        row | {"set": "rocks", "method": "flow", "failures": 0, "drift_percent": [1.0, 0.5, 2.0]},
        row | {"set": "hull", "method": "ecc"},
    ]
    lines = benchmark_lines(rows)
    assert [" ".join(line.split()) for line in lines[3:7]] == [
        "| method | rocks, still, none | hull, still, none |",
        "| --- | --- | --- |",
        "| ecc | 3.2, 25 | -, 25 |",
        "| flow | 1.0 | |",
    ]
    failed = [{**row, "method": "first"} for row in rows if row["method"] == "ecc"]
    for row in failed:
        row.pop("path_m", None)
    first = [row for pair in zip(failed, [row for row in rows if row["method"] == "ecc"], strict=True) for row in pair]
    assert any("| rocks, still, none | hull, still, none |" in " ".join(line.split()) for line in benchmark_lines(first))


# ---------------------------------------------------------------- the folder


def table_of(folder: Path) -> list[Row]:
    rows: list[Row] = json.loads((folder / "table.json").read_text())["rows"]
    return [{name: value for name, value in row.items() if name != "ms"} for row in rows]


@pytest.mark.thorough
def test_a_killed_benchmark_goes_on_to_the_same_bits(run_of: Path, tmp_path: Path) -> None:
    expected = Wanted((str(run_of),), methods=("zero", "direct", "flow"))
    benchmark_odometry(expected, tmp_path / "whole")
    broken = tmp_path / "broken"
    benchmark_odometry(replace(expected, methods=("zero", "direct")), broken)
    journal = broken / "rows.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(lines[0] + lines[1][:40])  # killed while the second row was written
    estimates = next((broken / "paths").glob("*direct")) / "estimates.jsonl"
    stored = estimates.read_bytes().splitlines(keepends=True)
    estimates.write_bytes(b"".join(stored[:7]) + stored[7][:20])
    benchmark_odometry(expected, broken, resume=True)
    assert table_of(broken) == table_of(tmp_path / "whole")
    assert estimates.read_bytes() == b"".join(stored)


def test_rows_come_one_by_one_and_are_not_made_again(run_of: Path, tmp_path: Path, monkeypatch: Any) -> None:
    out = tmp_path / "bench"
    benchmark_odometry(Wanted((str(run_of),), methods=("zero",)), out)
    with pytest.raises(MitsonarError, match="--resume continues it"):
        benchmark_odometry(Wanted((str(run_of),), methods=("flow",)), out)
    first = table_of(out)
    monkeypatch.setattr(Zero, "estimate", None)  # asked again, it would fail
    report = benchmark_odometry(Wanted((str(run_of),), methods=("zero", "flow")), out, resume=True)
    assert [row["method"] for row in report["rows"]] == ["zero", "flow"]
    assert table_of(out)[0] == first[0]
    with pytest.raises(MitsonarError, match="limit"):
        benchmark_odometry(Wanted((str(run_of),), methods=("zero",), frames=5), out, resume=True)


@pytest.mark.filterwarnings("default")
def test_what_is_assumed_of_a_recording_is_told_once(tmp_path: Path, frames: SonarFrames) -> None:
    decibels = np.clip(1 + np.log10(np.maximum(frames.image, 1e-8)) / 8, 0, 1).astype(np.float32)
    sonar = frames.sonar.replace(coding="dB", coding_db=80.0, frequency_hz=1.8e6, azimuth_fov_deg=28)
    blind = replace(frames, image=decibels, level="dB", poses=None, height_m=None, sonar=sonar)
    write_aris(tmp_path / "dive.aris", blind, beams=96)
    expected = Wanted((str(tmp_path / "dive.aris"),), methods=("zero", "flow"), frames=4)
    report = benchmark_odometry(expected, tmp_path / "bench")
    assert [row["frames"] for row in report["rows"]] == [4, 4]
    assert sum("has no height over the ground" in note for note in report["notes"]) == 1


def test_a_method_that_takes_other_frames_is_a_note(run_of: Path, tmp_path: Path, monkeypatch: Any) -> None:
    (tmp_path / "mine.py").write_text("class Choosy:\n    def estimate(self, frames):\n        return None\n")
    monkeypatch.chdir(tmp_path)
    report = benchmark_odometry(Wanted((str(run_of),), methods=("mine:Choosy", "zero")), tmp_path / "bench")
    assert [row["method"] for row in report["rows"]] == ["zero"]
    assert "mine:Choosy: mine:Choosy: estimate must return an Estimate" in report["notes"][0]


def test_an_absent_package_is_a_note_unless_it_was_asked_for(run_of: Path, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(odometry_benchmark, "METHODS", ("zero", "stackreg"))
    monkeypatch.setitem(__import__("sys").modules, "pystackreg", None)
    report = benchmark_odometry(Wanted((str(run_of),)), tmp_path / "bench")
    assert "pip install 'mitsonar[bench]'" in report["notes"][0]
    with pytest.raises(MitsonarError, match="the estimator stackreg needs pystackreg"):
        benchmark_odometry(Wanted((str(run_of),), methods=("stackreg",)), tmp_path / "other")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--set", "rock"], "unknown set 'rock': did you mean rocks?"),
        (["--texture", "speckled"], "unknown texture 'speckled': did you mean speckle?"),
        (["--noise", "loud"], "unknown noise 'loud': did you mean low?"),
        (["--method", "dirct"], "unknown estimator 'dirct': did you mean direct?"),
        (["--method", "likelihood"], "likelihood does not read frames of one view"),
        (["--frames", "2"], "--frames must be at least 3: got 2"),
    ],
)
def test_what_cannot_be_made_is_one_sentence(mitsonar: Command, options: list[str], reason: str, tmp_path: Path) -> None:
    done = mitsonar("benchmark", "odometry", *options, "-o", tmp_path / "bench")
    assert done.returncode == 2
    assert reason in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "bench").exists()


def test_a_word_before_a_hyphen_means_all_such_sets(tmp_path: Path, monkeypatch: Any) -> None:
    arguments: list[str] = []

    def measured(self: Any, case: Case, *_: Any) -> Row:
        arguments.append(case.name)
        raise MitsonarError("not rendered")

    monkeypatch.setattr(odometry_benchmark._Bench, "measure", measured)
    benchmark_odometry(Wanted(("dive-gemini-720is",), ("still",), methods=("zero",)), tmp_path / "few")
    flown = [f"dive-gemini-720is-{flight}-{seed}" for flight in ("level", "gentle") for seed in (3, 11, 20)]
    assert arguments == flown
    arguments.clear()
    benchmark_odometry(Wanted(methods=("zero",)), tmp_path / "all")
    assert len(arguments) == 2 * (48 + 3)
    assert {"rocks", *flown} < set(arguments)


def small_hull(self: ShipHull, seed: int) -> World:
    return BUILD(ShipHull(size_m=14, groups_a_side=(2, 3), anodes_a_side=(4, 5)), seed)


BUILD = ShipHull.build


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_one_command_renders_a_set_and_makes_its_row(mitsonar: Command, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(ShipHull, "build", small_hull)
    monkeypatch.setitem(odometry_benchmark.TEXTURES["speckle"], "quality", "draft")
    command = ("benchmark", "odometry", "--set", "hull", "--texture", "speckle", "--frames", 3, "--bound", 0, "-o", tmp_path)
    done = mitsonar(*command, "--method", "flow", "--resume")
    assert done.returncode == 0, done.stderr
    assert "**hull, speckle, noise none**: 3 frames; path 0.04 m" in done.stdout
    assert (tmp_path / "sets" / "hull-speckle-none" / "frames.npz").exists()
    again = mitsonar(*command, "--method", "zero", "--resume", "--json")
    rows = json.loads(again.stdout)["rows"]
    assert [row["method"] for row in rows] == ["zero", "flow"]
    assert rows[1]["command"] == "--set hull --texture speckle --noise none --method flow"
    assert "| flow " in (tmp_path / "table.md").read_text()
