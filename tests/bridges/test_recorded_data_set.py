"""Data sets of frames with known poses: the same pixels, poses and estimates as the files they come from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from drawn_frames import SONAR, as_zarr, over_ground, sway
from helpers import Command, refused
from numpy.typing import NDArray

from mitsonar import SonarFrames, Trajectory
from mitsonar.bridges.export_source import as_pixels, axes_of, frames_with_poses, write_recorded
from mitsonar.config.data import load_recipe, recipe_from
from mitsonar.datasets.make import check, make_dataset
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.estimation.compare import ComparisonOptions, compare
from mitsonar.estimation.named import create_estimator
from mitsonar.mapping.sources import load_frames, open_frames, poses_at, stretches
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import in_units
from mitsonar.recordings.open import open_recording
from mitsonar.recordings.write_aris import write_aris
from mitsonar.records.frames import to_uint8

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def frames() -> SonarFrames:
    return over_ground(sway(24))


@pytest.fixture(scope="module")
def places(frames: SonarFrames, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The frames as frames.npz, frames.zarr of 8-bit pixels, and ARIS; and a path of their poses."""
    folder = tmp_path_factory.mktemp("frames")
    frames.save(folder / "frames.npz")
    (folder / "run").mkdir()
    as_zarr(replace(frames, image=np.stack([to_uint8(one) for one in frames.image])), folder / "run/frames.zarr")
    write_aris(folder / "dive.aris", [frames], beams=96)
    Trajectory(true_poses(frames), frames.time_s).save_tum(folder / "true.tum")
    return {
        "npz": folder / "frames.npz",
        "zarr": folder / "run",
        "aris": folder / "dive.aris",
        "path": folder / "true.tum",
    }


def true_poses(frames: SonarFrames) -> Array:
    assert frames.poses is not None
    return frames.poses


def written(out: Path, *files: Path, **words: Any) -> DataStore:
    result = write_recorded([frames_with_poses(str(file), **words) for file in files], out)
    assert result.path == out
    return DataStore.open(out)


# ---------------------------------------------------------------- what is stored


@pytest.mark.parametrize(("kind", "pixel"), [("npz", "float32"), ("zarr", "uint8"), ("aris", "uint8")])
def test_pixels_axes_and_poses_are_those_of_the_file(places: dict[str, Path], tmp_path: Path, kind: str, pixel: str) -> None:
    source = open_frames(places[kind])
    there = replace(source.read(np.arange(len(source))), poses=source.poses)
    store = written(tmp_path / "data.zarr", places[kind])
    assert store.recipe.pixel == pixel
    assert np.array_equal(store.read("image"), there.image)
    assert np.array_equal(store.read("pose"), true_poses(there))
    assert there.height_m is not None
    assert np.array_equal(store.read("height_m"), there.height_m)
    assert np.allclose(store.read("range_m"), there.range_m, atol=1e-9)
    assert np.allclose(store.read("bearing_rad"), there.bearing_rad, atol=1e-9)
    assert np.array_equal(store.read("motion")[:-1], motions(true_poses(there)))
    assert np.allclose(store.read("time_s"), there.time_s - there.time_s[0])
    assert check(store) == []
    again = load_frames(tmp_path / "data.zarr")
    assert again.level == there.level
    assert np.array_equal(again.matching_values(), there.matching_values())
    assert np.allclose(again.range_m, there.range_m, atol=1e-9)


def test_the_recipe_says_where_frames_come_from(places: dict[str, Path], tmp_path: Path) -> None:
    recipe = written(tmp_path / "data.zarr", places["aris"], path=places["path"]).recipe
    assert recipe.recorded is not None
    (source,) = recipe.recorded.sources
    assert (source.name, source.poses, source.frames, source.left_out) == (str(places["aris"]), str(places["path"]), 24, 0)
    assert "ARIS" in source.format
    assert (recipe.recorded.level, recipe.instrument.beams) == ("dB", 96)
    assert recipe_from(recipe.model_dump(mode="json")) == recipe


def test_frames_of_ping_groups_keep_their_groups(frames: SonarFrames, tmp_path: Path) -> None:
    replace(frames, sonar=frames.sonar.replace(ping_groups=8)).save(tmp_path / "groups.npz")
    written(tmp_path / "data.zarr", tmp_path / "groups.npz")
    assert load_frames(tmp_path / "data.zarr").sonar.ping_groups == 8


def test_recipes_of_rendered_frames_keep_their_digest() -> None:
    """What stores and checkpoints keep of a recipe has no key more than before."""
    recipe = load_recipe("rocky-field")
    assert "recorded" not in recipe.model_dump()
    assert "recorded" not in recipe.model_dump(mode="json", exclude_defaults=True)


def test_several_files_are_scenes_and_cut_ones_sequences(places: dict[str, Path], tmp_path: Path) -> None:
    store = written(tmp_path / "data.zarr", places["npz"], places["zarr"], cut=5)
    assert np.bincount(store.read("sequence")).tolist() == [5, 5, 5, 5, 4] * 2
    assert np.bincount(store.read("scene")).tolist() == [24, 24]
    assert np.isnan(store.read("motion")[4]).all()
    assert store.recipe.split.by == "scene"
    first = np.asarray(load_frames(places["zarr"]).image, dtype=np.float32) / 255
    assert np.allclose(store.read("image", slice(24, 48)), first, atol=1e-6)
    assert check(store) == []


def test_what_the_user_should_know_is_said(places: dict[str, Path], frames: SonarFrames, tmp_path: Path) -> None:
    replace(frames, level_scale=0.5, height_m=None).save(tmp_path / "quiet.npz")
    Trajectory(true_poses(frames)[:20], frames.time_s[:20]).save_tum(tmp_path / "short.tum")
    quiet = frames_with_poses(str(tmp_path / "quiet.npz"), path=tmp_path / "short.tum")
    result = write_recorded([frames_with_poses(str(places["npz"])), quiet], tmp_path / "data.zarr")
    left, gains, heights = result.notes
    assert "quiet.npz: left out: 4 frames" in left
    assert "the gains of the files differ (levels of a pixel of 1 from 0.5 to 1)" in gains
    assert "give --height" in heights
    recipe = DataStore.open(tmp_path / "data.zarr").recipe
    assert recipe.recorded is not None
    assert [(one.frames, one.level_scale) for one in recipe.recorded.sources] == [(24, 1.0), (20, 0.5)]


def test_of_a_recording_that_changes_its_window_one_geometry_is_taken(frames: SonarFrames, tmp_path: Path) -> None:
    nearer = over_ground(sway(4), SONAR.replace(range_max=5.0))
    parts = [frames.select(slice(10)), replace(nearer, time_s=nearer.time_s + 10), frames.select(slice(10, None))]
    parts[2] = replace(parts[2], time_s=parts[2].time_s + 20)
    for number, one in enumerate(parts):
        write_aris(tmp_path / f"{number}.aris", [one], beams=96)
    recording = open_recording(tmp_path / "0.aris")
    others = [open_recording(tmp_path / f"{number}.aris").parts[0] for number in (1, 2)]
    joined = replace(recording, parts=(recording.parts[0], *others))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mitsonar.bridges.export_source.recording_at", lambda where, geometry: joined)
        result = frames_with_poses("dive.aris")
    assert ([len(one) for one in result.stretches], result.left_out) == ([10, 14], 4)


# ---------------------------------------------------------------- poses


def test_poses_are_interpolated_within_a_path(frames: SonarFrames) -> None:
    poses, time = true_poses(frames), frames.time_s
    path = Trajectory(poses[::2], time[::2])
    result, known = poses_at(path, time, "frames")
    assert known.tolist() == [True] * 23 + [False]
    assert np.array_equal(result[:-1:2], poses[:-1:2])
    assert np.allclose(result[:-1], poses[:-1], atol=2e-3)
    gap = Trajectory(poses[[0, 1, -2, -1]], time[[0, 1, -2, -1]])
    assert poses_at(gap, time, "frames")[1].tolist() == [True] * 2 + [False] * 20 + [True] * 2
    with pytest.raises(MitsonarError, match="no pose for the frames of dive"):
        poses_at(Trajectory(poses, time + 100), time, "dive")
    single = Trajectory(poses[:1], time[:1])
    assert poses_at(single, time, "frames")[1].sum() == 1


def test_pitch_of_a_planar_path_is_that_of_the_frames(frames: SonarFrames) -> None:
    flat = true_poses(frames) * [1, 1, 1, 0, 0, 1]
    message = np.tile([0.3, 0.02, np.nan], (24, 1))
    message[3] = np.nan
    result, _ = poses_at(Trajectory(flat, frames.time_s), frames.time_s, "frames", message)
    assert np.allclose(result[:, 3], [0.3] * 3 + [0] + [0.3] * 20)
    assert np.allclose(result[:, 4], [0.02] * 3 + [0] + [0.02] * 20)


def test_stretches_end_at_pauses_and_where_poses_are_missing() -> None:
    time = np.array([0, 1, 2, 3, 4, 5, 20, 21.0])
    known = np.array([1, 1, 1, 0, 1, 1, 1, 1], dtype=bool)
    assert stretches(known, time) == [slice(0, 3), slice(4, 6), slice(6, 8)]
    assert stretches(known[:1], time[:1]) == []


# ---------------------------------------------------------------- what it is for


@pytest.mark.thorough
def test_compare_gives_the_errors_of_the_estimator_on_the_run(
    places: dict[str, Path], frames: SonarFrames, tmp_path: Path
) -> None:
    written(tmp_path / "data.zarr", places["npz"])
    report = compare(tmp_path / "data.zarr", "zero,direct", ComparisonOptions(part="all")).report
    rows = {row["method"]: row for row in report["tables"][0]["rows"]}
    truth = motions(true_poses(frames))
    direct = create_estimator("direct")
    pairs = [frames.select(slice(number, number + 2)) for number in range(len(truth))]
    result = np.array([direct.estimate(pair).motion for pair in pairs])
    expected = np.sqrt((in_units(result - truth) ** 2).mean(axis=0))
    assert np.allclose(rows["direct"]["rmse"], expected, rtol=1e-6)
    assert (np.array(rows["direct"]["rmse"]) < 0.2 * np.array(rows["zero"]["rmse"])).all()
    with pytest.raises(MitsonarError, match="have no world"):
        compare(tmp_path / "data.zarr", "zero", ComparisonOptions(part="all", perturb=True))


@pytest.mark.slow
def test_an_aris_file_and_its_path_are_compared(mitsonar: Command, places: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "dive.zarr"
    done = mitsonar("dataset", "from-frames", places["aris"], "--poses", places["path"], "--cut", 6, "-o", out)
    assert done.returncode == 0, done
    assert "24 frames in 4 sequences" in done.stdout
    report = compare(out, "zero,direct", ComparisonOptions(part="all")).report
    zero, direct = (np.array(row["rmse"]) for row in report["tables"][0]["rows"])
    assert (direct < 0.3 * zero).all(), (direct, zero)
    assert mitsonar("compare", out, "--estimators", "zero,direct").returncode == 0
    assert mitsonar("dataset", "info", out).returncode == 0
    assert mitsonar("dataset", "show", out, "-o", tmp_path / "a.png").returncode == 0
    assert list(tmp_path.glob(".*")) == []


@pytest.mark.learn
@pytest.mark.thorough
def test_a_network_is_trained_on_it_and_evaluated(places: dict[str, Path], tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from mitsonar.config.training import TrainOptions, training_recipe_from
    from mitsonar.networks.checkpoint import Checkpoint
    from mitsonar.training.evaluate import evaluate
    from mitsonar.training.run import train

    data = tmp_path / "data.zarr"
    written(data, places["aris"], cut=6)
    recipe = training_recipe_from(
        {
            "network": {"name": "corrnet", "width": 0.5},
            "input": {"layout": "channels", "ground": True},
            "labels": "raw",
            "noise": ["none"],
            "loss": {"kind": "likelihood"},
            "batch": 4,
            "steps": 3,
            "validate": {"every_steps": 3, "pairs": 4, "noise": ["none"]},
        }
    )
    train(TrainOptions(recipe, data, tmp_path / "net"))
    checkpoint = Checkpoint.load(tmp_path / "net")
    assert checkpoint.data_recipe["recorded"]["level"] == "dB"
    assert np.allclose(checkpoint.trained_at["height_m"], 2.5)
    row, _ = evaluate(checkpoint, data, noise=["none"], part="validation")["tables"][0]["rows"]
    assert np.isfinite(row["rmse"]).all()


# ---------------------------------------------------------------- refusals


def test_refusals_say_what_to_give(mitsonar: Command, places: dict[str, Path], frames: SonarFrames, tmp_path: Path) -> None:
    out = tmp_path / "data.zarr"
    replace(frames, poses=None).save(tmp_path / "bare.npz")
    refused(mitsonar("dataset", "from-frames", tmp_path / "bare.npz", "-o", out), "contains no poses", "--poses")
    unknown = replace(frames, height_m=None, poses=true_poses(frames) * [1, 1, 0, 1, 1, 1])
    unknown.save(tmp_path / "low.npz")
    refused(mitsonar("dataset", "from-frames", tmp_path / "low.npz", "-o", out), "give --height")
    second = over_ground(sway(3), SONAR.replace(range_max=5.0))
    second.save(tmp_path / "other.npz")
    both = (places["npz"], tmp_path / "other.npz")
    refused(mitsonar("dataset", "from-frames", *both, "-o", out), "another sonar", "range_max 5.0, not 5.4")
    refused(mitsonar("dataset", "from-frames", places["npz"], places["npz"], "-o", out), "given twice")
    path = ("--poses", places["path"])
    refused(mitsonar("dataset", "from-frames", places["npz"], *path, *path, "-o", out), "once for each of 1 files")
    refused(mitsonar("dataset", "from-frames", places["npz"], "-o", "s3://bucket/a.zarr"), "a folder here")
    refused(mitsonar("dataset", "from-frames", places["npz"], "--height", "-1", "-o", out), "above 0 m")
    assert not out.exists()
    assert list(tmp_path.glob(".*")) == []
    assert mitsonar("dataset", "from-frames", tmp_path / "low.npz", "--height", "2.5", "-o", out).returncode == 0
    assert (DataStore.open(out).read("height_m") == 2.5).all()
    refused(mitsonar("dataset", "from-frames", places["npz"], "-o", out), "exists and is kept")
    with pytest.raises(MitsonarError, match="is a data set: sources_of_data_set reads it"):
        frames_with_poses(str(out))


def test_pixels_that_cannot_be_leave_nothing_behind(places: dict[str, Path], frames: SonarFrames, tmp_path: Path) -> None:
    image = frames.image.copy()
    image[13, 5, 5] = np.inf
    source = frames_with_poses(str(places["npz"]))
    part = replace(source.stretches[0].part, images=image.__getitem__)
    damaged = replace(source, stretches=[replace(source.stretches[0], part=part)])
    with pytest.raises(MitsonarError, match=r"allowed 0\.\.1: it is damaged"):
        write_recorded([damaged], tmp_path / "data.zarr")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(MitsonarError, match="damaged"):
        as_pixels(np.full((1, 2, 2), np.nan, np.float32), "float32", "a")


def test_axes_that_no_sonar_has_are_refused_or_kept(frames: SonarFrames) -> None:
    uneven = frames.range_m.copy()
    uneven[60:] += 0.02
    with pytest.raises(MitsonarError, match="not at even steps"):
        axes_of(replace(frames, range_m=uneven), "dive")
    with pytest.raises(MitsonarError, match="contrast"):
        axes_of(replace(frames, level="contrast"), "dive")
    bent = frames.bearing_rad + 0.01 * np.sin(7 * frames.bearing_rad)
    result = axes_of(replace(frames, bearing_rad=bent), "dive")
    assert result.bearing_rad is not None
    assert np.array_equal(result.bearing_rad, bent)
    assert axes_of(frames, "dive").bearing_rad is None
    assert "bearings" in result.differences_from(axes_of(frames, "dive"))[-1]


def test_nothing_is_rendered_of_recorded_frames(places: dict[str, Path], tmp_path: Path) -> None:
    recipe = written(tmp_path / "data.zarr", places["npz"]).recipe
    with pytest.raises(MitsonarError, match="`mitsonar dataset from-frames` copies them"):
        make_dataset(recipe, str(tmp_path / "again.zarr"))
    with pytest.raises(MitsonarError, match="holds recorded frames and no worlds"):
        recipe.family(0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"flight": {"kind": "random"}}, "belong together"),
        ({"recorded": None}, "belong together"),
        ({"world": {"family": "rocky-field"}}, "leave out world"),
        ({"scenes": [{"sequences": 1}, {"sequences": 1}]}, "one scene"),
        ({"bearings": [0.0, 0.1]}, "2 of 96 beams"),
        ({"bearings": [0.1, 0.0]}, "must increase"),
        ({"bearings": [float("nan")] * 96}, "must increase"),
        ({"level": "contrast"}, "level"),
    ],
)
def test_hostile_recipes_are_refused(places: dict[str, Path], tmp_path: Path, change: dict[str, Any], words: str) -> None:
    out = tmp_path / "data.zarr"
    recipe = written(out, places["npz"]).recipe.model_dump(mode="json")
    within = recipe["recorded"] if set(change) & {"bearings", "level"} else recipe
    within |= change
    with pytest.raises(MitsonarError, match=words):
        recipe_from(recipe)
    zarr.open_group(out, mode="r+").attrs["recipe"] = recipe
    with pytest.raises(MitsonarError, match=r"damaged|no data set at"):
        DataStore.open(out)


# ---------------------------------------------------------------- rendered


@pytest.mark.learn
@pytest.mark.slow
def test_rendered_runs_are_compared_and_fine_tuned_on(mitsonar: Command, variant: str, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    for name, end in (("one", "-0.43,-4.76,2.5,35,0,2"), ("two", "-0.58,-4.8,2.5,35,0,-1")):
        path = ("--from", "-0.5,-4.85,2.5,35,0,0", "--to", end, "--frames", 8)
        done = mitsonar("render", "pattern", *path, "--model", "physical", "-o", tmp_path / name)
        assert done.returncode == 0, done
    out = tmp_path / "both.zarr"
    done = mitsonar("dataset", "from-frames", tmp_path / "one", tmp_path / "two", "-o", out)
    assert done.returncode == 0, done
    assert "16 frames in 2 sequences" in done.stdout
    store = DataStore.open(out)
    assert check(store) == []
    assert np.array_equal(store.read("image", slice(8, 16)), SonarFrames.load(tmp_path / "two").image)
    report = compare(out, "zero,direct", ComparisonOptions(part="all")).report
    zero, direct = (np.array(row["rmse"]) for row in report["tables"][0]["rows"])
    assert (direct < 0.2 * zero).all(), (direct, zero)
    (tmp_path / "tune.yaml").write_text(FINE_TUNING, encoding="utf-8")
    done = mitsonar("train", tmp_path / "tune.yaml", "--data", out, "-o", tmp_path / "net")
    assert done.returncode == 0, done
    done = mitsonar("evaluate", tmp_path / "net", out, "--noise", "none", "--part", "validation")
    assert done.returncode == 0, done
    done = mitsonar("compare", out, "--estimators", f"zero,{tmp_path / 'net'}")
    assert done.returncode == 0, done


FINE_TUNING = """
network: corrnet
start: corrnet
input: {layout: channels, ground: true}
labels: raw
noise: [none]
split: scene
loss: {kind: likelihood}
optimiser: {rate: 1.0e-5}
batch: 4
steps: 2
validate: {noise: [none], pairs: 4, every_steps: 2}
"""
"""A training that begins with the shipped corrnet."""
