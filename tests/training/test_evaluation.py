"""Checkpoints in use: as estimators of `odometry` and `compare`, by `mitsonar evaluate`, and as ONNX."""

from __future__ import annotations

import importlib.util
import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_frames import over_ground, sway
from helpers import Command, essence, refused, run_python, tiny_recipe

from mitsonar.datasets.make import make_dataset
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion, motions
from mitsonar.motion.errors import in_units
from mitsonar.records.frames import SonarFrames

torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
pytestmark = [
    pytest.mark.learn,
    pytest.mark.usefixtures("variant"),
    pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning"),
]

from mitsonar.datasets.samples import Samples, SonarPairs  # noqa: E402
from mitsonar.estimation.compare import ComparisonOptions, compare  # noqa: E402
from mitsonar.estimation.learned import (  # noqa: E402
    HeightEnsemble,
    ImageNetwork,
)
from mitsonar.estimation.named import create_estimator  # noqa: E402
from mitsonar.networks.checkpoint import (  # noqa: E402
    Checkpoint,
    to_onnx,
)
from mitsonar.networks.create import create_network, options_for  # noqa: E402
from mitsonar.training.data import JsonObject  # noqa: E402
from mitsonar.training.evaluate import evaluate, predictions, samples_for  # noqa: E402

SAYS = np.array([0.004, -0.006, np.radians(0.1)])
"""What the networks here answer, whatever they see."""

SIZE = {"sonar__beams": 48, "sonar__range_bins": 256, "sonar__rays_per_beam": 300, "world__a_side": [25, 25]}


def constant(pairs: SonarPairs, says: Any = SAYS, name: str = "posenet", **about: Any) -> Checkpoint:
    """The checkpoint of a network that always gives one answer [m, m, rad]."""
    inputs, label = pairs[0]
    batch = tuple(part[None] for part in inputs) if isinstance(inputs, tuple) else inputs[None]
    network: Any = create_network(name, width=1 / 16, **options_for(name, batch, label[None]))
    with torch.no_grad():
        network.regression.weight.zero_()
        network.regression.bias.copy_(torch.from_numpy(pairs.labels.encode(says)))
    return Checkpoint.of(network, pairs, **about)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three small scenes of six pairs, fine enough to match."""
    url = tmp_path_factory.mktemp("made") / "small.zarr"
    make_dataset(tiny_recipe(scenes=[{"count": 3, "sequences": 6}], flight={"pings": 2}, **SIZE), str(url))
    return url


@pytest.fixture(scope="module")
def checkpoint(made: Path) -> Checkpoint:
    about: JsonObject = {"metrics": {"none": {"rmse": [3.0, 2.0, 0.1]}}, "trained": {"pairs": 100}}
    return constant(SonarPairs(made, part="all", labels="normx10"), **about)


@pytest.fixture(scope="module")
def run(checkpoint: Checkpoint, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training run."""
    folder = tmp_path_factory.mktemp("run")
    checkpoint.save(folder / "network.ckpt")
    return folder


@pytest.fixture(scope="module")
def pairs(made: Path) -> SonarPairs:
    return SonarPairs(made, part="all", one_per_sequence=True)


# ---------------------------------------------------------------- as an estimator


def test_it_answers_what_the_network_says(checkpoint: Checkpoint, pairs: SonarPairs) -> None:
    estimator = ImageNetwork(checkpoint)
    for number in range(3):
        result = estimator.estimate(pairs.sonar_frames(number))
        assert result.valid, result.reason
        assert np.allclose(result.motion, SAYS, atol=1e-7)
        assert result.covariance is not None
        assert np.allclose(np.sqrt(np.diag(result.covariance)), [3e-3, 2e-3, np.radians(0.1)])
    assert estimator.inputs == "nothing; height 2.5 m, pitch 35 deg fixed by training"


def test_it_sees_what_training_saw(pairs: SonarPairs, made: Path) -> None:
    """Frames reach the network as the data set's own arrangement gives them, fans too."""
    arrangements: dict[str, JsonObject] = {
        "posenet": {"layout": "stack"},
        "posenet_dual": {"coordinates": "both", "cartesian_rows": 64},
    }
    for name, words in arrangements.items():
        local = SonarPairs(made, part="all", one_per_sequence=True, labels="quantised", **words)
        inputs, label = local[0]
        batch = tuple(part[None] for part in inputs) if isinstance(inputs, tuple) else inputs[None]
        torch.manual_seed(4)
        network: Any = create_network(name, width=1 / 16, **options_for(name, batch, label[None]))
        with torch.no_grad():  # without training little of an image reaches the end
            for layer in network.modules():
                if isinstance(layer, torch.nn.Conv2d):
                    layer.weight.mul_(2)
        trained = Checkpoint.of(network, local)
        expected, _ = predictions(trained, local, numbers=[2, 5])
        result = [ImageNetwork(trained).estimate(pairs.sonar_frames(number)).motion for number in (2, 5)]
        assert np.allclose(result, expected, rtol=1e-4, atol=1e-7)
        assert not np.allclose(result[0], result[1], rtol=1e-3), "it looks at the frames"


def test_another_process_gets_the_same(checkpoint: Checkpoint, pairs: SonarPairs) -> None:
    estimator = ImageNetwork(checkpoint, force=True)
    copied = pickle.loads(pickle.dumps(estimator))
    assert (copied.digest, copied.force, copied.inputs) == (estimator.digest, True, estimator.inputs)
    assert copied.estimate(pairs.sonar_frames(1)).motion == estimator.estimate(pairs.sonar_frames(1)).motion


def changed(frames: SonarFrames, **fields: Any) -> SonarFrames:
    return SonarFrames(**{**vars(frames), **fields})


def posed(frames: SonarFrames, column: int, value: float, **fields: Any) -> SonarFrames:
    assert frames.poses is not None
    poses = frames.poses.copy()
    poses[:, column] = value
    return changed(frames, poses=poses, **fields)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: changed(f, image=f.image * 0), "nothing in the frames"),
        (lambda f: changed(f, image=np.stack([f.image[0], np.full_like(f.image[0], 0.5)])), "nothing in the frames"),
        (lambda f: changed(f, image=np.random.default_rng(0).random(f.image.shape, dtype=np.float32)), "correlate by"),
        (lambda f: changed(f, image=np.stack([f.image[0], f.image[0, ::-1]])), "correlate by"),
        (lambda f: posed(f, 2, 2.1, height_m=np.full(2, 2.1)), "was at 2.10 m: height 2.5 m"),
        (lambda f: posed(f, 3, np.radians(38)), "a pitch of 38.0 deg: height 2.5 m, pitch 35 deg"),
        (lambda f: posed(f, 4, np.radians(-4)), "a roll of -4.0 deg"),
    ],
)
def test_it_doubts(
    checkpoint: Checkpoint, pairs: SonarPairs, change: Callable[[SonarFrames], SonarFrames], words: str
) -> None:
    result = ImageNetwork(checkpoint).estimate(change(pairs.sonar_frames(2)))
    assert not result.valid
    assert words in result.reason


def test_what_it_does_not_doubt(checkpoint: Checkpoint, pairs: SonarPairs) -> None:
    """A rock straight below, an altimeter that agrees where z does not count from the ground, no poses, a still sonar."""
    frames = pairs.sonar_frames(2)
    nan = np.full(2, np.nan)
    for fine in (
        changed(frames, height_m=np.full(2, 2.05)),
        posed(frames, 2, 0.0, height_m=np.full(2, 2.6)),
        changed(frames, poses=None, height_m=None),
        changed(frames, height_m=nan),
        posed(frames, 3, np.radians(36.5)),
        changed(frames, image=np.stack([frames.image[0], frames.image[0]])),
    ):
        assert ImageNetwork(checkpoint).estimate(fine).valid


def test_answers_beyond_the_box_are_invalid(made: Path, pairs: SonarPairs) -> None:
    local = SonarPairs(made, part="all")
    for size, valid in ((0.0235, True), (0.0245, False), (np.nan, False)):
        trained = constant(local, [0.0, -size, 0.0])
        if np.isnan(size):
            trained = replace(constant(local), weights={k: v * float("inf") for k, v in constant(local).weights.items()})
        result = ImageNetwork(trained).estimate(pairs.sonar_frames(2))
        assert result.valid == valid, result
    assert "not finite" in result.reason
    assert "forward -24.5 mm is beyond the motions of training, -20..20 mm" in (
        ImageNetwork(constant(local, [0.0, -0.0245, 0.0])).estimate(pairs.sonar_frames(2)).reason
    )
    network = ImageNetwork(constant(local))
    assert "forward 24.5 mm, counted from the start, is beyond" in (
        network._rejection_of_size(Motion(0.0, 0.1245, 0.0), Motion(0.0, 0.1, 0.0))
    )


def test_another_sonar_is_refused_unless_forced(checkpoint: Checkpoint, pairs: SonarPairs) -> None:
    frames = pairs.sonar_frames(2)
    second = frames.sonar.replace(name="mine", elevation_fov_deg=20, bearing="cone")
    with pytest.raises(MitsonarError) as error:
        ImageNetwork(checkpoint).estimate(changed(frames, sonar=second, range_m=frames.range_m + 0.5))
    for words in (
        "DIDSON",
        "mine",
        "bearing cone, not azimuth",
        "elevation_fov_deg 20, not 14",
        "window 3.7..6.1 m, not 3.2..5.6 m",
    ):
        assert words.lower() in str(error.value).lower()
    assert ImageNetwork(checkpoint, force=True).estimate(changed(frames, sonar=second)).valid
    assert ImageNetwork(checkpoint).estimate(changed(frames, range_m=frames.range_m * 1.01)).valid, "sound speed errs"
    coarse = changed(frames, image=frames.image[:, ::2], range_m=frames.range_m[::2])
    with pytest.raises(MitsonarError, match="bins 128, not 256"):
        ImageNetwork(checkpoint).estimate(coarse)
    with pytest.raises(MitsonarError, match=r"\(1, 1, 128, 96\)"):
        ImageNetwork(checkpoint, force=True).estimate(coarse)


def test_checkpoints_that_two_frames_cannot_serve(checkpoint: Checkpoint) -> None:
    words = checkpoint.arrangement
    for change in ({"frames": 3}, {"views": ["left", "right"]}, {"kind": "vector", "views": ["q1", "q2"]}):
        with pytest.raises(MitsonarError, match=r"two frames of one view.*evaluate"):
            ImageNetwork(replace(checkpoint, arrangement={**words, **change}))
    with pytest.raises(MitsonarError, match=r"takes no geometry: height 2\.5 m, pitch 35 deg are fixed by training"):
        ImageNetwork(checkpoint, height_m=2.0)


# ---------------------------------------------------------------- with the geometry of the ground


@pytest.fixture(scope="module")
def geometric(made: Path) -> Checkpoint:
    """A corrnet as it begins."""
    torch.manual_seed(1)
    local = SonarPairs(made, part="all", ground=True, layout="channels")
    return Checkpoint.of(create_network("corrnet", width=0.5), local)


def test_networks_that_know_the_geometry_are_given_it(
    geometric: Checkpoint, made: Path, pairs: SonarPairs, tmp_path: Path
) -> None:
    """As an estimator it says what it says of the data set's own samples; another sonar and height are welcome."""
    estimator = ImageNetwork(geometric)
    expected, laws = predictions(geometric, samples_for(geometric, made, part="all"), numbers=[2, 5])
    assert laws is not None
    for place, number in enumerate((2, 5)):
        result = estimator.estimate(pairs.sonar_frames(number))
        assert np.allclose(result.motion, expected[place], rtol=1e-3, atol=1e-7)
        assert result.covariance is not None
        assert np.allclose(result.covariance, laws[place], rtol=1e-3, atol=1e-12)
    frames = pairs.sonar_frames(2)
    assert estimator.inputs.startswith("pitch; height")
    assert geometric.sonar == {}
    bare = changed(frames, poses=None, height_m=None)
    with pytest.raises(MitsonarError, match="corrnet needs height and pitch"):
        estimator.estimate(bare)
    geometric.save(tmp_path / "network.ckpt")
    message = create_estimator(f"{tmp_path}:height_m=2.5:pitch_deg=35").estimate(bare)
    assert np.allclose(message.motion, estimator.estimate(frames).motion, rtol=1e-3, atol=1e-7)
    second = frames.sonar.replace(beams=40)
    fewer = changed(frames, image=frames.image[:, :, 4:44], bearing_rad=frames.bearing_rad[4:44], sonar=second)
    assert np.isfinite(estimator.estimate(fewer).motion).all()
    wrong = estimator.estimate(changed(frames, height_m=np.full(2, 6.0)))
    assert not wrong.valid


def test_a_trained_corrnet_comes_along(mitsonar: Command, made: Path, pairs: SonarPairs) -> None:
    """By name: as an estimator, here and in other processes, and for `evaluate`; a path is a path."""
    checkpoint = Checkpoint.load("corrnet")
    assert (checkpoint.network, checkpoint.recipe["data"]) == ("corrnet", "rocky-field")
    assert checkpoint.trained["pairs"] > 10_000
    estimator = create_estimator("corrnet")
    assert create_estimator("corrnet:force=0").digest == checkpoint.digest
    frames = pairs.sonar_frames(2)
    there = pickle.loads(pickle.dumps(estimator)).estimate(frames)
    assert there.motion == estimator.estimate(frames).motion
    assert there.covariance is not None
    done = mitsonar("evaluate", "corrnet", made, "--part", "all", "--pairs", "4", "--noise", "none")
    assert done.returncode == 0, done.stderr
    assert "corrnet" in done.stdout
    refused(mitsonar("evaluate", "./corrnet", made), "no checkpoint", "or corrnet")


@pytest.mark.thorough
def test_its_own_covariances_are_judged(geometric: Checkpoint, made: Path) -> None:
    row, _ = evaluate(geometric, made, noise=["none"], part="all")["tables"][0]["rows"]
    local = samples_for(geometric, made, part="all")
    output, laws = predictions(geometric, local)
    assert laws is not None
    error = output - np.array([local.target(k) for k in range(len(local))])
    nees = np.mean([e @ np.linalg.solve(law, e) for e, law in zip(error, laws, strict=True)]) / 3
    assert row["nees"] == pytest.approx(nees, rel=1e-6)
    assert row["inputs"].startswith("pitch; height")


# ---------------------------------------------------------------- on the command line


def test_estimators_are_named_by_checkpoint_or_folder(
    run: Path, pairs: SonarPairs, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    frames = pairs.sonar_frames(2)
    monkeypatch.chdir(run.parent)
    for text in (f"{run}/network.ckpt", str(run), run.name, f"{run}:force=1"):
        assert np.allclose(create_estimator(text).estimate(frames).motion, SAYS, atol=1e-7)
    for text, words in {
        f"{run}:force=2": "force must be 0 or 1",
        f"{run}:levels=2": "takes force, height_m, pitch_deg, relief_m",
        f"{run}:height_m=2": "takes no geometry",
        f"{run}/absent.ckpt": "no checkpoint",
        str(tmp_path): "holds no network.ckpt",
        "dierct": "did you mean direct.*or give a checkpoint",
    }.items():
        with pytest.raises(MitsonarError, match=words):
            create_estimator(text)
    assert np.allclose(create_estimator(run, force=True).estimate(frames).motion, SAYS, atol=1e-7)


@pytest.mark.thorough
def test_without_torch_the_extra_is_named(run: Path) -> None:
    output = run_python(
        f"""
        from mitsonar.errors import MitsonarError
        from mitsonar.estimation.named import create_estimator
        create_estimator("direct")
        try:
            create_estimator({str(run)!r})
        except MitsonarError as error:
            print(error)
        """,
        block=("torch",),
    )
    assert "pip install 'mitsonar[learn]'" in output


@pytest.mark.thorough
def test_odometry_and_compare_take_checkpoints(
    mitsonar: Command, checkpoint: Checkpoint, made: Path, run: Path, tmp_path: Path
) -> None:
    """Motions are the constant answer, and errors those that follow; another network is not gone on with."""
    sonar = Sonar(bearing="azimuth", beams=48, range_bins=256, range_min=3.2, range_max=5.6)
    over_ground(sway(12), sonar).save(tmp_path / "frames.npz")
    done = mitsonar("odometry", tmp_path / "frames.npz", "--estimator", run, "-o", tmp_path / "out1")
    assert done.returncode == 0, done.stderr
    assert "fixed by training" in done.stdout
    message = [json.loads(line) for line in (tmp_path / "out1" / "estimates.jsonl").read_text().splitlines()]
    assert len(message) == 11
    assert all(np.allclose(one["motion"], SAYS, atol=1e-7) and one["valid"] for one in message)
    stated = json.loads((tmp_path / "out1" / "run.json").read_text())
    assert stated["asked"]["options"]["digest"] == checkpoint.digest
    table = ("compare", made, "--part", "all", "--limit", 0, "--estimators", f"zero,{run}")
    done = mitsonar(*table, "-o", tmp_path / "table", "--json")
    assert done.returncode == 0, done.stderr
    _, row = json.loads(done.stdout)["tables"][0]["rows"]
    truth = SonarPairs(made, part="all", one_per_sequence=True)
    valid = [ImageNetwork(checkpoint).estimate(truth.sonar_frames(k)).valid for k in range(len(truth))]
    answers = np.where(np.array(valid)[:, None], SAYS, 0)  # frames of so few cells may hold too little to match
    errors = in_units(answers - np.array([motions(truth.pose[truth.frame_slice(k)])[0] for k in range(len(truth))]))
    assert row["failures"] == valid.count(False) <= 2
    assert np.allclose(row["rmse"], np.sqrt((errors**2).mean(axis=0)), rtol=1e-5)
    again = mitsonar(*table, "-o", tmp_path / "table", "--json")
    assert json.loads(again.stdout)["tables"][0]["rows"][1] == row
    constant(truth, SAYS / 2).save(run / "network.ckpt")
    try:
        refused(mitsonar(*table, "-o", tmp_path / "table"), "was begun with networks", "choose another -o")
        refused(
            mitsonar("odometry", tmp_path / "frames.npz", "--estimator", run, "-o", tmp_path / "out1", "--resume"),
            "was begun with options.digest",
        )
    finally:
        checkpoint.save(run / "network.ckpt")


@pytest.mark.slow
def test_workers_of_odometry_say_the_same(mitsonar: Command, run: Path, tmp_path: Path) -> None:
    sonar = Sonar(bearing="azimuth", beams=48, range_bins=256, range_min=3.2, range_max=5.6)
    over_ground(sway(20), sonar).save(tmp_path / "frames.npz")
    for workers in (1, 2):
        words = ("--estimator", run, "--workers", workers, "-o", tmp_path / f"out{workers}")
        assert mitsonar("odometry", tmp_path / "frames.npz", *words).returncode == 0
    first, second = ((tmp_path / f"out{workers}" / "estimates.jsonl").read_bytes() for workers in (1, 2))
    assert first == second


def test_a_comparison_marks_pairs_that_a_network_may_have_learnt_from(mitsonar: Command, made: Path, tmp_path: Path) -> None:
    """By default it takes the part that training left out; another split is told, with the number of pairs that it mixes."""
    by_scene = {"by": "scene", "train": 0.67, "validation": 0.33, "seed": 2}
    about: JsonObject = {"recipe": {"split": by_scene}, "metrics": {"none": {"rmse": [3.0, 2.0, 0.1]}}}
    message = constant(SonarPairs(made, part="train", split=by_scene, labels="normx10"), **about)
    message.save(tmp_path / "network.ckpt")
    taught = set(SonarPairs(made, part="train", split=by_scene).first)
    result = compare(made, {"zero": "zero", "net": ImageNetwork(message)}, ComparisonOptions(limit=0))
    assert (result.report["pairs"], result.report["split"]["by"]) == (6, "scene")
    assert [row["learnt"] for row in result.rows] == [0, 0]
    assert not any("was trained on" in sentence for sentence in result.notes)
    by_sequence = SonarPairs(made, part="train", split="sequence", one_per_sequence=True)
    mixed = sum(first in taught for first in by_sequence.first)
    assert 0 < mixed < len(by_sequence)
    words = ("--split", "sequence", "--part", "train", "--limit", 0, "--estimators", f"zero,{tmp_path / 'network.ckpt'}")
    done = mitsonar("compare", made, *words)
    assert done.returncode == 0, done.stderr
    assert f"network.ckpt (learnt {mixed})" in done.stdout
    assert f"was trained on {mixed} of the {len(by_sequence)} pairs" in done.stderr
    assert "too small; take the part validation, or other data" in done.stderr
    refused(mitsonar("compare", made, "--split", "world"), "split must be sequence, scene")
    second = constant(SonarPairs(made, part="all", labels="normx10"), recipe={"split": "sequence"})
    with pytest.raises(
        MitsonarError, match="trained on other parts of this data set: a by scene, b by sequence; choose split"
    ):
        compare(made, {"a": ImageNetwork(message), "b": ImageNetwork(second)}, ComparisonOptions(limit=0))
    both = compare(
        made,
        {"both": HeightEnsemble([ImageNetwork(message), ImageNetwork(message)])},
        ComparisonOptions(part="train", limit=0),
    )
    assert [row["learnt"] for row in both.rows] == [both.report["pairs"]]
    rendered = replace(message, trained={"rendered": True})
    assert not rendered.learnt(by_sequence).any()


@pytest.mark.thorough
@pytest.mark.parametrize("by", ["sequence", "scene"])
def test_what_was_learnt_is_known_in_a_shorter_data_set_of_the_recipe(made: Path, tmp_path: Path, by: str) -> None:
    """Its sequences are in the longer one, but in other parts: their poses tell which of them training has had."""
    recipe = tiny_recipe(scenes=[{"count": 3, "sequences": 6}], flight={"pings": 2}, **SIZE)
    make_dataset(recipe, str(tmp_path / "short.zarr"), sequences=10)
    split = {"by": by, "train": 0.67, "validation": 0.33, "seed": 1}
    for trained, other, count in ((made, tmp_path / "short.zarr", 18), (tmp_path / "short.zarr", made, 10)):
        if by == "scene" and count == 10:
            continue  # a single scene has no parts
        taught = SonarPairs(trained, part="train", split=split, labels="normx10")
        about: JsonObject = {"recipe": {"split": split}, "trained": {"sequences": {recipe.digest(): count}}}
        network, everything = constant(taught, **about), SonarPairs(other, part="all")
        poses = {taught.pose[first].tobytes() for first in taught.first}
        expected = [everything.pose[first].tobytes() in poses for first in everything.first]
        assert network.learnt(everything).tolist() == expected
        assert 0 < sum(expected) < len(expected) or (by == "scene" and len(everything.store.scenes) == 1)


def test_evaluate_prints_the_errors_that_follow(mitsonar: Command, made: Path, run: Path, tmp_path: Path) -> None:
    words = ("evaluate", run, made, "--part", "all", "--noise", "none,high")
    done = mitsonar(*words, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    for output in (
        "18 samples of 3 scenes, thesis model",
        "noise high",
        "| posenet",
        "| zero",
        "fixed by training",
        "trained on",
        "correlations of errors: sideways-forward ",
    ):
        assert output in done.stdout
    assert "training has seen 17 of these 18 pairs: errors on unseen pairs may be larger" in done.stderr
    assert "3 scenes only" in done.stderr
    report = json.loads((tmp_path / "out" / "table.json").read_text())
    truth = SonarPairs(made, part="all", one_per_sequence=True)
    motion = np.array([truth.target(k) for k in range(len(truth))])
    error, power = in_units(SAYS - motion), (motion**2).sum(axis=0)
    assert [table["noise"] for table in report["tables"]] == ["none", "high"]
    for table in report["tables"]:
        row, zero = table["rows"]
        assert np.allclose(row["rmse"], np.sqrt((error**2).mean(axis=0)), rtol=1e-5)
        assert np.allclose(row["thesis"], np.array(row["rmse"]) * [1, 1, 100])
        together = np.asarray(np.corrcoef(error.T))[[0, 0, 1], [1, 2, 2]]
        assert table["correlations"] == {
            name: pytest.approx(value, rel=1e-4)
            for name, value in zip(("sideways-forward", "sideways-yaw", "forward-yaw"), together, strict=True)
        }
        assert np.allclose(row["median"], np.median(np.abs(error), axis=0), rtol=1e-5)
        assert np.allclose(row["bias"], error.mean(axis=0), rtol=1e-5)
        assert np.allclose(row["slope"], (SAYS * motion).sum(axis=0) / power, rtol=1e-4, atol=1e-7)
        assert np.allclose(zero["rmse"], np.sqrt((in_units(motion) ** 2).mean(axis=0)))
        assert (np.array(row["rmse_low"]) < row["rmse"]).all()
        assert table["beyond"] == {"true": 0.0, "answers": 0.0}
        assert row["ms"] > 0
    refused(mitsonar(*words, "-o", tmp_path / "out"), "exists and is kept", "--overwrite")
    assert mitsonar(*words, "-o", tmp_path / "out", "--overwrite").returncode == 0
    parts = json.loads(mitsonar("evaluate", run, made, "--noise", "none", "--pairs", 1, "--json").stdout)
    assert (parts["part"], parts["pairs"]) == ("validation", 1)


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Small data sets of other kinds, made when they are first needed: vectors, two sensors, another sonar."""
    folder = tmp_path_factory.mktemp("many")
    two = [{"name": name, "starboard_m": side, "sonar": {"beams": 12}} for name, side in (("left", -0.5), ("right", 0.5))]
    recipes: dict[str, dict[str, Any]] = {
        "high": {"flight": {"pings": 4, "height_m": [2.2, 3.0]}, "store": "both"},
        "two": {"receivers": two, "flight": {"pings": 2}, "sonar__beams": 96, "sonar__jitter": True},
        "other": {"sonar__beams": 16, "sonar__range_max": 6.0, "flight": {"pings": 2}, "mount": {"pitch_deg": 30.0}},
    }

    def make(name: str) -> Path:
        url = folder / f"{name}.zarr"
        if not url.exists():
            make_dataset(tiny_recipe(scenes=[{"count": 2, "sequences": 6}], **recipes[name]), str(url))
        return url

    return make


@pytest.mark.parametrize(
    ("data", "words"),
    essence(
        [
            ("high", {"frames": 3}),
            ("high", {"frames": 2, "kind": "vector"}),
            ("high", {"frames": 2, "coordinates": "cartesian", "cartesian_rows": 24, "layout": "channels"}),
            ("two", {"frames": 2}),
            ("two", {"views": ["right"], "layout": "stack"}),
        ],
        ("high", {"frames": 3}),
        ("high", {"frames": 2, "kind": "vector"}),
    ),
)
def test_all_arrangements_are_evaluated(many: Callable[[str], Path], data: str, words: dict[str, Any]) -> None:
    local = SonarPairs(many(data), part="all", labels="normx10", one_per_sequence=True, **words)
    report = evaluate(constant(local), many(data), noise=["low"], part="all")
    error = in_units(SAYS - np.array([local.target(k) for k in range(len(local))]))
    assert np.allclose(report["tables"][0]["rows"][0]["rmse"], np.sqrt((error**2).mean(axis=0)), rtol=1e-5)


def test_heights_are_evaluated_in_mm(many: Callable[[str], Path], mitsonar: Command, tmp_path: Path) -> None:
    local = SonarPairs(many("high"), part="all", labels="normx10", frames=1, one_per_sequence=True)
    trained = constant(local, [2.5])
    trained.save(tmp_path / "network.ckpt")
    done = mitsonar("evaluate", tmp_path, many("high"), "--part", "all", "--noise", "none", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "height mm" in done.stdout
    row, zero = json.loads((tmp_path / "out" / "table.json").read_text())["tables"][0]["rows"]
    truth = np.array([local.target(k)[0] for k in range(len(local))])
    assert row["rmse"] == pytest.approx([1e3 * np.sqrt(((2.5 - truth) ** 2).mean())], rel=1e-5)
    assert row["bias"] == pytest.approx([1e3 * (2.5 - truth).mean()], rel=1e-5)
    assert zero["rmse"] == pytest.approx([1e3 * np.sqrt(((2.6 - truth) ** 2).mean())], rel=1e-5)
    assert row["slope"] == pytest.approx([(-0.1 * (truth - 2.6)).sum() / ((truth - 2.6) ** 2).sum()], rel=1e-4)


@pytest.mark.thorough
def test_data_that_do_not_fit_are_refused(
    mitsonar: Command, many: Callable[[str], Path], run: Path, checkpoint: Checkpoint, made: Path, tmp_path: Path
) -> None:
    done = mitsonar("evaluate", run, many("other"))
    refused(done, "beams 16, not 48", "window 3.2..6 m, not 3.2..5.6 m", "--force", "didson300")
    # what any sonar may serve: the same network, made for sizes that fit
    local = SonarPairs(many("other"), part="all", one_per_sequence=True)
    second = replace(constant(local), sonar=checkpoint.sonar)
    with pytest.raises(MitsonarError, match="beams 16, not 48"):
        evaluate(second, many("other"), part="all")
    report = evaluate(second, many("other"), noise=["none"], part="all", force=True)
    assert "beams 16, not 48" in report["notes"][0]
    elsewhere = evaluate(
        replace(second, sonar={}, trained_at={**second.trained_at, "pitch_deg": 35.0}),
        many("other"),
        noise=["none"],
        part="all",
    )
    assert "pitch 30 deg" in elsewhere["notes"][1]
    refused(mitsonar("evaluate", run, many("other"), "--force"), "(1, 1, 40, 32)", "(batch, 1, 256, 96)")
    refused(mitsonar("evaluate", run, many("two")), "unknown view image")
    refused(mitsonar("evaluate", run, tmp_path / "none.zarr"), "none.zarr")
    refused(mitsonar("evaluate", run, made, "--noise", "loud"), "noise must be")
    refused(mitsonar("evaluate", run, made, "--part", "test"), "no test part")
    refused(mitsonar("evaluate", tmp_path, made), "holds no network.ckpt")
    vectors = tmp_path / "vectors.zarr"
    make_dataset(
        tiny_recipe(store="vectors", flight={"pings": 2}, scenes=[{"sequences": 4}], **{**SIZE, "world__a_side": [3, 3]}),
        str(vectors),
    )
    refused(mitsonar("evaluate", run, vectors), "holds vectors only")
    broken = tmp_path / "broken.zarr"
    shutil.copytree(made, broken)
    shutil.rmtree(broken / "motion")
    refused(mitsonar("evaluate", run, broken), "motion")
    (tmp_path / "newer.ckpt").write_bytes(replace(checkpoint, format=2, version="9.9").to_bytes())
    refused(mitsonar("evaluate", tmp_path / "newer.ckpt", made), "format 2", "mitsonar 9.9")


def test_the_split_is_that_of_the_training(made: Path, checkpoint: Checkpoint) -> None:
    by_scene = replace(checkpoint, recipe={"split": {"by": "scene", "train": 0.34, "validation": 0.33, "test": 0.33}})
    result = samples_for(by_scene, made)
    assert len(set(result.scene[result.first])) == 1
    report = evaluate(by_scene, made, noise=["none"])
    assert (report["part"], report["split"], report["scenes"]) == ("test", "scene", 1)


# ---------------------------------------------------------------- ONNX


def trained_like(name: str, **words: Any) -> Checkpoint:
    """Of a random network whose statistics are not 0 and 1, made for 64 x 64 cells."""
    sizes = {"size": (64, 64)} | ({"cartesian_size": (48, 40)} if name == "posenet_dual" else {})
    torch.manual_seed(2)
    network: Any = create_network(name, width=1 / 4 if name == "cnn4b" else 1 / 16, **sizes)
    for layer in network.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.running_mean.uniform_(-0.1, 0.1)
            layer.running_var.uniform_(0.5, 2)
    return Checkpoint.of(network, Samples(tiny_recipe(), labels="normx10", **words))


def agrees(content: bytes, checkpoint: Checkpoint, batch: int) -> dict[str, str]:
    """What the file tells of itself, once onnxruntime gave what torch gives."""
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(3)
    inputs = {one.name: rng.random((batch, *one.shape[1:]), dtype=np.float32) for one in session.get_inputs()}
    expected = checkpoint.build()(*(torch.from_numpy(values) for values in inputs.values())).numpy()
    (result,) = session.run(["labels"], inputs)
    assert result.shape == (batch, 3)
    assert np.abs(result - expected).max() < 1e-4 * np.abs(expected).max()
    about: dict[str, str] = session.get_modelmeta().custom_metadata_map
    return about


@pytest.mark.slow
def test_onnx_says_the_same() -> None:
    checkpoint = trained_like("cnn4b")
    about = agrees(to_onnx(checkpoint, 2), checkpoint, 2)
    assert json.loads(about["labels"]) == checkpoint.labels
    assert json.loads(about["sonar"])["image"]["beams"] == 12
    assert (about["network"], about["mitsonar_version"]) == ("cnn4b", checkpoint.version)


def test_a_checkpoint_of_half_size_says_nearly_the_same(mitsonar: Command, tmp_path: Path) -> None:
    checkpoint = trained_like("posenet")
    checkpoint.save(tmp_path / "network.ckpt")
    done = mitsonar("export", tmp_path, "--half", tmp_path / "half.ckpt")
    assert done.returncode == 0, done.stderr
    small = Checkpoint.load(tmp_path / "half.ckpt")
    sizes = [(tmp_path / name).stat().st_size for name in ("half.ckpt", "network.ckpt")]
    assert sizes[0] < 0.6 * sizes[1]
    image = torch.rand((4, 1, 64, 64), generator=torch.Generator().manual_seed(1))
    result, expected = small.build()(image), checkpoint.build()(image)
    assert result.dtype == torch.float32
    assert float((result - expected).abs().max()) < 2e-3 * float(expected.abs().max())
    assert (small.options, small.labels, small.trained) == (checkpoint.options, checkpoint.labels, checkpoint.trained)
    refused(mitsonar("export", tmp_path), "nothing to write: give --onnx FILE.onnx, --half FILE.ckpt, or both")
    refused(mitsonar("export", tmp_path, "--half", tmp_path / "half.ckpt"), "half.ckpt")
    refused(mitsonar("export", tmp_path, "--half", tmp_path / "half.onnx"), "--half must name an .ckpt file")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["posenet", "sfmnet", "cnn1b", "cnn4posenet", "posenet_dual"])
def test_every_network_becomes_onnx(name: str) -> None:
    checkpoint = trained_like(name, coordinates="both" if name == "posenet_dual" else "polar", cartesian_rows=48)
    agrees(to_onnx(checkpoint), checkpoint, 3)
    agrees(to_onnx(checkpoint, 1), checkpoint, 1)


@pytest.mark.slow
def test_the_geometry_goes_into_onnx(geometric: Checkpoint, made: Path) -> None:
    """Motion and covariance, for any number of samples, on ground that the tracer has not seen."""
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(to_onnx(geometric, None), providers=["CPUExecutionProvider"])
    samples = samples_for(geometric, made, part="all")
    for numbers in ([3], [0, 4, 7, 9]):
        images, grounds = zip(*(samples[number][0] for number in numbers), strict=True)
        image, ground = torch.stack(images), {name: torch.stack([one[name] for one in grounds]) for name in grounds[0]}
        table = {name: values.numpy() for name, values in {"image": image, **ground}.items()}
        result = session.run(["motion", "covariance"], {one.name: table[one.name] for one in session.get_inputs()})
        expected = geometric.build()(image, ground)
        for got, want in zip(result, expected, strict=True):
            assert np.abs(got - want.numpy()).max() < 1e-4 * np.abs(want.numpy()).max()


@pytest.mark.slow
def test_export_writes_a_file_once(mitsonar: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = trained_like("posenet")
    checkpoint.save(tmp_path / "network.ckpt")
    path = tmp_path / "network.onnx"
    words = ("export", tmp_path, "--onnx")
    done = mitsonar(*words, path, "--batch", "dynamic")
    assert done.returncode == 0, done.stderr
    assert str(path) in done.stdout
    assert not done.stderr
    before = path.read_bytes()
    agrees(before, checkpoint, 5)
    refused(mitsonar(*words, path), "exists and is kept", "--overwrite")
    refused(mitsonar(*words, tmp_path / "network.txt"), ".onnx")
    refused(mitsonar(*words, tmp_path / "no" / "network.onnx"), "folder")
    refused(mitsonar(*words, path, "--batch", "none", "--overwrite"), "--batch")
    find_spec = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "onnxscript" else find_spec(name))
    refused(mitsonar(*words, path, "--overwrite"), "writing ONNX needs onnxscript", "mitsonar[learn]")
    assert path.read_bytes() == before
    monkeypatch.setattr("mitsonar.networks.checkpoint.to_onnx", lambda checkpoint, batch: b"new")
    assert mitsonar(*words, path, "--overwrite").returncode == 0
    assert path.read_bytes() == b"new"
