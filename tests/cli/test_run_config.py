"""``--config run.yaml``: a run repeats from the file that it wrote, the command line overrides it, mistakes are named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from helpers import Command, refused

SCENE = """<scene version="3.0.0"><default name="size" value="50"/>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="$size"/></transform></shape>
</scene>"""

QUICK = ("--quality", "draft", "--model", "physical", "--set", "beams=8", "--set", "range_bins=32")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "floor.xml"
    path.write_text(SCENE)
    return path


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(one.relative_to(folder)): one.read_bytes() for one in sorted(folder.rglob("*")) if one.is_file()}


def test_a_run_repeats_byte_for_byte(mitsonar: Command, tmp_path: Path, scene: Path) -> None:
    """With options of all kinds: flags, numbers, words, pairs, lists of numbers."""
    poses = ("--from", "0,0,2.5,40,0,0", "--to", "0.1,0.2,2.5,40,0,10", "--frames", "2", "--speed", "0.5")
    more = ("--labels", "--label-floor", "0.01", "--noise", "low", "--seed", "0", "-D", "size=40", "--fan")
    mitsonar("render", scene, "--sonar", "didson300", *QUICK, *poses, *more, "-o", tmp_path / "a")
    table = yaml.safe_load((tmp_path / "a/run.yaml").read_text())
    assert table["command"] == "render"
    assert table["set"] == {"beams": 8, "range_bins": 32}
    assert (table["labels"], table["seed"], table["parameters"]) == (True, 0, {"size": 40})
    assert table["from"] == "0,0,2.5,40,0,0"
    assert not {"out", "overwrite", "resume", "config", "exr"} & set(table)
    mitsonar("render", "--config", tmp_path / "a/run.yaml", "-o", tmp_path / "b")
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")


def test_the_command_line_overrides_the_file(mitsonar: Command, tmp_path: Path, scene: Path) -> None:
    """Single keys of --set too; the run writes what it used."""
    table = {"scene": str(scene), "sonar": "didson300", "quality": "draft", "model": "physical", "frames": 2}
    table |= {"from": [0, 0, 2.5, 40, 0, 0], "set": {"beams": 8, "range_bins": 32}, "parameters": {"size": 40}}
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(table))
    options = ("--frames", "1", "--set", "beams=6", "--set", "seed=3")
    mitsonar("render", "--config", tmp_path / "c.yaml", *options, "-o", tmp_path / "a")
    sonar = json.loads((tmp_path / "a/run.json").read_text())["asked"]["sonar"]
    assert (sonar["beams"], sonar["range_bins"], sonar["seed"]) == (6, 32, 3)
    used = yaml.safe_load((tmp_path / "a/run.yaml").read_text())
    assert used["frames"] == 1
    assert used["set"] == {"beams": 6, "range_bins": 32, "seed": 3}
    assert used["from"] == "0,0,2.5,40,0,0"
    plain = ("--sonar", "didson300", "--quality", "draft", "--model", "physical", "--set", "range_bins=32", *options)
    mitsonar("render", scene, *plain, "--from", "0,0,2.5,40,0,0", "-D", "size=40", "-o", tmp_path / "b")
    assert (tmp_path / "a/frames.npz").read_bytes() == (tmp_path / "b/frames.npz").read_bytes()


def test_a_run_that_replaces_another_replaces_its_file(mitsonar: Command, tmp_path: Path, scene: Path) -> None:
    base = ("render", scene, "--sonar", "didson300", *QUICK, "--from", "0,0,2.5,40,0,0", "-o", tmp_path / "a")
    mitsonar(*base)
    before = (tmp_path / "a/run.yaml").read_bytes()
    refused(mitsonar(*base), "exists")
    mitsonar(*base, "--resume")
    assert (tmp_path / "a/run.yaml").read_bytes() == before
    mitsonar(*base, "--seed", "5", "--overwrite")
    assert yaml.safe_load((tmp_path / "a/run.yaml").read_text())["seed"] == 5


@pytest.mark.thorough
def test_soundings_repeat_too(mitsonar: Command, tmp_path: Path, scene: Path) -> None:
    sound = (
        "sound",
        scene,
        "--instrument",
        "altimeter",
        "--from",
        "0,0,3,0,0,0",
        "--quality",
        "draft",
        "--model",
        "physical",
    )
    mitsonar(*sound, "-o", tmp_path / "a")
    mitsonar("sound", "--config", tmp_path / "a/run.yaml", "-o", tmp_path / "b")
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")
    refused(mitsonar("render", "--config", tmp_path / "a/run.yaml"), "of the command 'sound', not of render")


def test_all_sensors_of_a_vehicle_repeat(mitsonar: Command, tmp_path: Path, scene: Path) -> None:
    """The folder of the vehicle holds the options, those of its sensors do not."""
    sonar = "{beams: 8, range_bins: 32, range_min: 1, range_max: 6, quality: draft}"
    (tmp_path / "v.yaml").write_text(f"sensors:\n  ahead: {{sonar: {sonar}, mount: [0, 0, 0, 30, 0, 0]}}\n")
    poses = ("--from", "0,0,2.5,0,0,0", "--to", "0,1,2.5,0,0,0", "--frames", "2", "--speed", "1")
    mitsonar("render", scene, "--vehicle", tmp_path / "v.yaml", *poses, "-o", tmp_path / "a")
    mitsonar("render", "--config", tmp_path / "a/run.yaml", "-o", tmp_path / "b")
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")
    assert [str(one.relative_to(tmp_path / "a")) for one in (tmp_path / "a").rglob("run.yaml")] == ["run.yaml"]
    assert (tmp_path / "a/ahead/frames.npz").exists()


@pytest.mark.slow
def test_impulse_responses_repeat_too(mitsonar: Command, tmp_path: Path, scene: Path) -> None:
    mitsonar("impulse", scene, "--from", "0,0,3,0,0,0", "--velocity", "0.1,0.2", "--frames", "2", "-o", tmp_path / "c")
    mitsonar("impulse", "--config", tmp_path / "c/run.yaml", "-o", tmp_path / "d")
    assert files_of(tmp_path / "c")["responses.npz"] == files_of(tmp_path / "d")["responses.npz"]
    assert files_of(tmp_path / "c")["run.yaml"] == files_of(tmp_path / "d")["run.yaml"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("framess: 3", "unknown key 'framess': did you mean frames"),
        ("resume: true", "unknown key 'resume'"),
        ("range_max: 6", "range_max is a key of the sonar: give it below `set`, as range_max: 6"),
        ("- a\n- b", "must hold options of `mitsonar render`"),
        ("labels: 3", "labels must be true or false: got 3"),
        ("set: beams=8", "set must hold KEY: VALUE pairs"),
        ("set: {beams: [1, 2]}", "set.beams must be a word or a number"),
        ("sonar: {a: 1}", "sonar must be a word or a number"),
        ("a: [", "is not YAML"),
        ("&a [*a]", ""),
        ("set: {beamz: 3}", "beamz"),
    ],
)
def test_mistakes_in_a_file_are_named(mitsonar: Command, tmp_path: Path, scene: Path, text: str, sentence: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    refused(
        mitsonar("render", scene, "--sonar", "didson300", "--config", tmp_path / "c.yaml", "-o", tmp_path / "a"), sentence
    )
    assert not (tmp_path / "a").exists()


def test_words_that_are_no_numbers_are_refused(mitsonar: Command, tmp_path: Path, scene: Path) -> None:
    (tmp_path / "c.yaml").write_text("frames: three")
    done = mitsonar("render", scene, "--config", tmp_path / "c.yaml")
    assert done.returncode == 2
    assert "--frames" in done.stderr


def test_a_missing_file_is_named(mitsonar: Command, tmp_path: Path) -> None:
    refused(mitsonar("render", "--config", tmp_path / "none.yaml"), "cannot read configuration")
