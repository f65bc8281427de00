"""Vectors: portions of a view summed over their beams, range levels, halves of images, and the network of table 4.2."""

from __future__ import annotations

import contextlib
import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import DOWN, Command, essence, tiny_recipe

from mitsonar.acoustics.noise import load_noise
from mitsonar.config.data import load_recipe
from mitsonar.datasets.make import SceneRenderer, make_dataset
from mitsonar.datasets.plan import scenes_of
from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import motions

torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
pytest.importorskip("lightning", reason="Lightning is not installed: install mitsonar[learn]")
pytestmark = [
    pytest.mark.learn,
    pytest.mark.usefixtures("variant", "bare_curves"),
    pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning"),
]

from mitsonar.config.training import Optimiser, TrainOptions, load_training_recipe, training_recipe_from  # noqa: E402
from mitsonar.datasets.samples import Samples, SonarPairs  # noqa: E402
from mitsonar.estimation.learned import (  # noqa: E402
    ImageNetwork,
    ViewNetwork,
    _rejection_of_profiles,
)
from mitsonar.estimation.named import create_estimator  # noqa: E402
from mitsonar.mapping.open_source import open_views  # noqa: E402
from mitsonar.networks.checkpoint import Checkpoint  # noqa: E402
from mitsonar.networks.create import create_network, options_for  # noqa: E402
from mitsonar.networks.profilenet import check_portions  # noqa: E402
from mitsonar.training.data import material_of  # noqa: E402
from mitsonar.training.evaluate import evaluate, predictions  # noqa: E402
from mitsonar.training.run import train  # noqa: E402
from mitsonar.training.step import network_for  # noqa: E402

GAINS = {"coherent": 268.0, "physical": 343.0}
"""Of the sets that the shipped ProfileNet has learnt from."""

PORTIONS: dict[str, Any] = {
    **DOWN,
    "mount__heading_deg": -90.0,
    "segments": ["c1", "c2", "c3", "c4"],
    "store": "vectors",
    "scenes": [{"count": 2, "sequences": 8}],
}


@pytest.fixture(scope="module")
def portions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four circular segments of a looking-down sonar, as vectors."""
    url = tmp_path_factory.mktemp("made") / "portions.zarr"
    make_dataset(tiny_recipe(**PORTIONS), str(url))
    return url


@pytest.fixture(scope="module")
def ahead(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a sonar that looks forward."""
    url = tmp_path_factory.mktemp("made") / "ahead.zarr"
    make_dataset(tiny_recipe(scenes=[{"count": 2, "sequences": 8}]), str(url))
    return url


# ---------------------------------------------------------------- what is read


def test_range_levels_are_those_of_a_sonar_with_fewer_bins(portions: Path) -> None:
    """Added up when read, against rendered with fewer bins: the same echoes."""
    pairs = SonarPairs(portions, part="all", range_levels=10, layout="channels", views=["c2"])
    few = tiny_recipe(**PORTIONS, sonar__range_bins=10)
    renderer = SceneRenderer(few, scenes_of(few, few.sequences)[0])
    here = pairs.frame_slice(3)
    (looks,) = renderer.render_views(pairs.pose[here], here.start)
    expected = looks[[view.name for view in renderer.simulator.views].index("c2")].levels.sum(axis=2)
    expected = expected * float(pairs.store.about["gain"])
    result = pairs[3][0].numpy()
    assert result.shape == (2, 10)
    # pixels at the maximum are cut off in the fine image, others lie on the border of two bins
    np.testing.assert_allclose(result.sum(axis=1), expected.sum(axis=1), rtol=0.02)
    assert np.median(np.abs(result - expected)[expected > 0] / expected[expected > 0]) < 1e-3


@pytest.mark.thorough
def test_halves_are_sums_over_port_and_starboard_beams(ahead: Path) -> None:
    """Port first, both pings of each (fig. 4.18); noise is drawn for each pixel before they are added up."""
    images = SonarPairs(ahead, part="all", layout="channels", noise="high", seed=4)
    halves = SonarPairs(ahead, part="all", kind="vector", halves=True, noise="high", seed=4)
    image, columns = images[5][0].numpy(), halves[5][0].numpy()[0]
    middle = image.shape[2] // 2
    expected = [part for side in (image[..., :middle], image[..., middle:]) for part in side.sum(axis=2)]
    np.testing.assert_allclose(columns.T, expected, rtol=1e-5)
    coarse = SonarPairs(ahead, part="all", kind="vector", halves=True, range_levels=20, noise="high", seed=4)
    np.testing.assert_allclose(coarse[5][0][0], columns.reshape(20, -1, 4).sum(axis=1), rtol=1e-5)
    assert coarse.described()["arrangement"]["range_levels"] == 20
    assert coarse.described()["arrangement"]["halves"] is True


def test_words_that_do_not_fit_are_refused(portions: Path, ahead: Path) -> None:
    with pytest.raises(MitsonarError, match=r"range_levels must divide the \d+ of the data set \(1, 2, .*: got 7"):
        SonarPairs(portions, range_levels=7)
    with pytest.raises(MitsonarError, match="for vectors: read kind='vector'"):
        SonarPairs(ahead, halves=True)
    with pytest.raises(MitsonarError, match="this data set holds vectors only"):
        SonarPairs(portions, halves=True)


def test_vectors_alone_lie_in_few_files(portions: Path) -> None:
    """A shard is as large as what it holds, not as the images that were summed: else writing costs more than rendering."""
    about = SonarPairs(portions, part="all").store.about
    assert about["shard_frames"] == 8 * 5  # a scene


def test_frames_are_read_once(portions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And come out of memory as they lie on disk; other processes read for themselves."""
    pairs = SonarPairs(portions, part="all", views=["c3"])
    once, again = [[pairs[k][0] for k in (4, 5, 6)] for _ in range(2)]
    assert set(pairs._cached) == {"vector_c3", "nonzero_c3"}
    assert pickle.loads(pickle.dumps(pairs))._cached == {}
    monkeypatch.setattr("mitsonar.datasets.samples.CACHED_BYTES", 0)
    uncached = SonarPairs(portions, part="all", views=["c3"])
    for k, cached in enumerate(zip(once, again, strict=True), 4):
        torch.testing.assert_close(cached, (uncached[k][0],) * 2, rtol=0, atol=0)
    assert not uncached._cached


# ---------------------------------------------------------------- the network

ROWS = ((256, 32), (128, 64), (64, 128), (32, 256), (16, 512), (8, 512), (4, 512), (2, 1024), (1, 1024))
"""Table 4.2: cells along the range and channels of each convolution; as many across as there are columns."""


@pytest.mark.parametrize("columns", [2, 8])
def test_the_layers_are_those_of_the_table(columns: int) -> None:
    network = create_network("posenetvec", size=[512, columns]).eval()
    shapes: list[tuple[str, tuple[int, ...]]] = []
    layers = network.get_submodule("layers")
    for layer in layers.children():
        layer.register_forward_hook(lambda one, _, out: shapes.append((type(one).__name__, tuple(out.shape[1:]))))
    with torch.no_grad():
        assert network(torch.rand(2, 1, 512, columns)).shape == (2, 3)
    assert [shape for name, shape in shapes if name == "SameConv2d"] == [(c, rows, columns) for rows, c in ROWS]
    names = [name for name, _ in shapes]
    assert names.count("BatchNorm2d") == names.count("ReLU") == 8
    assert names[-1] == "SameAverage"
    kernels = [
        tuple(part.get_parameter("weight").shape[-2:]) for part in layers.children() if type(part).__name__ == "SameConv2d"
    ]
    assert kernels == [(7, 2), (5, 2), *[(3, 2)] * 7]
    assert sum(part.numel() for part in network.parameters()) == 13_649_283 + (columns - 2) * 3072  # docs/reference/files.md


@pytest.mark.parametrize("size", [(16, 8), (1024, 4), (512, 1)])
def test_it_reads_any_levels_and_columns(size: tuple[int, int]) -> None:
    network = create_network("posenetvec", width=0.05, outputs=1, size=list(size)).eval()
    assert network(torch.rand(3, 1, *size)).shape == (3, 1)
    with pytest.raises(MitsonarError, match="this network reads"):
        network(torch.rand(3, 1, size[0], size[1] + 1))


MIRRORS = [([3, 2, 1, 0], (-1, 1, -1)), ([1, 0, 3, 2], (1, -1, -1)), ([2, 3, 0, 1], (-1, -1, 1))]
"""Quadrants from fore-starboard clockwise, seen in a mirror to the side, fore and aft, in both; and the motion there."""


def test_what_a_profile_net_says_turns_with_the_world() -> None:
    torch.manual_seed(3)
    network = create_network("profilenet", size=[64, 8], windows=5).eval()
    pair = torch.rand(2, 64, 4, 2)

    def told(vectors: Any) -> Any:
        with torch.no_grad():
            return network(vectors.reshape(2, 1, 64, 8))

    plain = told(pair)
    assert plain.abs().min() > 1e-4
    for order, signs in MIRRORS:
        torch.testing.assert_close(told(pair[:, :, order]), plain * torch.tensor(signs), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(told(pair.flip(-1)), -plain, rtol=1e-4, atol=1e-6)  # backwards in time
    torch.testing.assert_close(told(pair[..., :1].repeat(1, 1, 1, 2)), torch.zeros(2, 3), rtol=0, atol=1e-6)
    torch.testing.assert_close(told(0.1 * pair), plain, rtol=1e-3, atol=1e-5)  # another gain


@pytest.mark.thorough
def test_a_profile_net_learns_shifts_of_a_part_of_a_level() -> None:
    """Profiles of white ground, moved by up to half a level: unseen ones are told to a sixth of always answering nothing."""
    rng = np.random.default_rng(5)
    fine, moved = 16, 8

    def ground(count: int) -> tuple[Any, Any]:
        line = rng.random((count, 4, 66 * fine))
        shift = rng.integers(-moved, moved + 1, count)
        signs = np.array([1, -1, -1, 1])  # fore portions come nearer, aft ones go
        first = line[..., fine:-fine].reshape(count, 4, 64, fine).sum(axis=-1)
        second = (
            np.array(
                [
                    [np.roll(row, s * n)[fine:-fine] for row, s in zip(four, signs, strict=True)]
                    for four, n in zip(line, shift, strict=True)
                ]
            )
            .reshape(count, 4, 64, fine)
            .sum(axis=-1)
        )
        vectors = np.stack([first, second], axis=-1).transpose(0, 2, 1, 3).reshape(count, 1, 64, 8)
        return torch.from_numpy(vectors).float(), torch.from_numpy(np.outer(shift / moved, [0, 1, 0])).float()

    torch.manual_seed(0)
    network = create_network("profilenet", size=[64, 8], width=0.5, lags=2, windows=4)
    optimiser = torch.optim.AdamW(network.parameters(), lr=5e-3)
    inputs, labels = ground(1200)
    for _ in range(6):
        for pick in torch.randperm(len(inputs)).split(50):
            loss = (network(inputs[pick]) - labels[pick]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    unseen, truth = ground(200)
    with torch.no_grad():
        error = (network.eval()(unseen) - truth).square().mean(dim=0).sqrt()
    assert error[1] < truth[:, 1].square().mean().sqrt() / 6
    assert max(error[0], error[2]) < 0.1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"size": [64, 6]}, "one, two or four portions: got 6 columns"),
        ({"outputs": 1}, "and 1 outputs"),
        ({"taps": 4}, r"taps must be a whole number of at least 1 \(taps: odd\): got 4"),
        ({"size": [8, 8]}, "windows must be at most the 8 levels"),
    ],
)
def test_profile_nets_that_cannot_be_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(MitsonarError, match=said):
        create_network("profilenet", **{"size": [64, 8], **options})


@pytest.mark.parametrize(
    ("views", "fits"),
    [
        (["c1", "c2", "c3", "c4"], True),
        (["q4", "q3", "q2", "q1"], True),  # counterclockwise has the same mirror images
        (["q1", "q4"], True),
        (["q1", "q3"], False),  # one is the other turned, not mirrored
        (["q1", "q4", "q2", "q3"], False),
        (["c4", "c1", "c2", "c3"], False),
    ],
)
def test_a_profile_net_is_trained_on_portions_whose_symmetries_it_has(portions: Path, views: list[str], fits: bool) -> None:
    """Exchanged portions turn the signs of sideways and yaw by construction, which must be those of their mirror image."""
    expectation = contextlib.nullcontext() if fits else pytest.raises(MitsonarError, match="clockwise from fore-starboard")
    with expectation:
        check_portions(views)
    if views[0].startswith("c"):
        keys = {"kind": "vector", "views": views}
        network = {"name": "profilenet", "windows": 4, "width": 0.2}
        recipe = training_recipe_from({"network": network, "steps": 1, "batch": 2, "input": keys})
        material = material_of(recipe, portions, render=False)
        with expectation:
            network_for(recipe, material)


def test_the_schedule_of_the_chapter() -> None:
    """1e-4, half of it from epoch 12, 1e-5 from epoch 16 (4.4.1)."""
    rate = Optimiser(rate=1e-4, schedule="steps", steps=[(12, 5e-5), (16, 1e-5)])
    assert [rate.rate_at(10 * epoch, 10, 240) for epoch in (0, 11, 12, 15, 16, 23)] == [1e-4, 1e-4, 5e-5, 5e-5, 1e-5, 1e-5]
    for words in ({"schedule": "steps"}, {"steps": [(2, 1e-4)]}, {"schedule": "steps", "steps": [(2, 1e-4), (1, 1e-5)]}):
        with pytest.raises(ValueError, match="optimiser steps must be"):
            Optimiser(**words)


SMALL: dict[str, Any] = {
    "network": {"name": "posenetvec", "width": 1 / 16},
    "steps": 6,
    "validate": {"noise": ["none"], "every_steps": 3, "pairs": 4},
    "batch": 4,
}


@pytest.mark.thorough
def test_a_network_of_vectors_learns_and_is_evaluated(portions: Path, tmp_path: Path, mitsonar: Command) -> None:
    recipe = training_recipe_from({**SMALL, "input": {"kind": "vector", "range_levels": 20}})
    stored = train(TrainOptions(recipe, portions, tmp_path / "run"))
    assert stored.options["size"] == [20, 8]
    done = mitsonar("evaluate", tmp_path / "run", portions, "--part", "all", "--noise", "none")
    assert done.returncode == 0, done.stderr
    assert "posenetvec" in done.stdout
    with pytest.raises(MitsonarError, match="two frames of one view"):
        ImageNetwork(stored)


def test_a_network_of_halves_estimates_from_any_frames(ahead: Path, tmp_path: Path) -> None:
    """As the training arranged them: frames in, the same answer as from the data set."""
    recipe = training_recipe_from({**SMALL, "input": {"kind": "vector", "halves": True}})
    stored = train(TrainOptions(recipe, ahead, tmp_path / "run"))
    assert stored.options["size"][1] == 4
    frames = SonarPairs(ahead, part="all", layout="channels").sonar_frames(7)
    samples = SonarPairs(ahead, part="all", **stored.arrangement, labels=stored.labels["kind"])
    with torch.inference_mode():
        expected = samples.labels.decode(stored.build()(samples[7][0][None]))[0]
    np.testing.assert_allclose(ImageNetwork(stored).estimate(frames).motion, expected, rtol=1e-4, atol=1e-7)


def test_heights_of_vectors(portions: Path, tmp_path: Path) -> None:
    recipe = training_recipe_from({**SMALL, "input": {"kind": "vector", "frames": 1, "views": ["c1"]}})
    stored = train(TrainOptions(recipe, portions, tmp_path / "run"))
    assert (stored.options["size"][1], stored.options["outputs"]) == (1, 1)


SIZES = {
    "portion-whole-image": (512, 2000),
    "portion-whole-vector": (512, 2),
    "portion-side-image": (512, 2000),
    "portion-side-vector": (512, 2),
    "portion-quadrant-image": (512, 1000),
    "portion-quadrant-vector": (512, 2),
    "portion-quadrants-image": (512, 4000),
    "portion-quadrants-vector": (512, 8),
    "portion-circular-image": (512, 4000),
    "portion-circular-vector": (512, 8),
    "portion-circular-10m-vector": (512, 8),
    "height-rocky-image": (512, 1000),
    "height-rocky-vector": (512, 1),
    "height-hull-image": (512, 96),
    "height-hull-vector": (512, 1),
    "profilenet-circular-10m": (1024, 8),
    "profilenet-quadrants": (1024, 8),
    "profilenet-quadrants-coherent": (512, 8),
}
"""Range levels and columns that the networks of chapter 4 read (tables 4.1, 4.2, 4.4)."""


@pytest.mark.parametrize("name", SIZES)
def test_recipes_of_the_chapter(name: str) -> None:
    recipe = load_training_recipe(name)
    samples = Samples(load_recipe(recipe.data, recipe.data_changes), **recipe.arrangement())
    kind, frames = recipe.input.kind, recipe.input.frames
    raw: dict[str, Any] = {"frames": torch.arange(frames)[None], "label": torch.zeros(1, 1 if frames == 1 else 3)}
    for view in samples.recipe.views:
        levels, beams = view.sonar.range_bins, len(view.bearing_rad)
        raw[view.name] = torch.zeros(1, frames, levels, *([beams] if kind == "image" else []))
        raw[f"nonzero_{view.name}"] = torch.zeros(1, frames, levels, dtype=torch.int32)
    inputs, labels = samples.finished(raw)
    assert inputs.shape == (1, 1, *SIZES[name])
    network = create_network(recipe.network["name"], **options_for(recipe.network["name"], inputs, labels), width=1 / 16)
    assert network.eval()(inputs).shape == labels.shape
    assert recipe.noise == "none"
    if not name.startswith("profilenet"):
        rates = [recipe.optimiser.rate_at(epoch, 1, 24) for epoch in (0, 12, 16, 23)]
        assert rates == [1e-4, 5e-5, 1e-5, 1e-5]
        assert (recipe.epochs, recipe.batch, recipe.split) == (24, 4, "sequence")
        assert recipe.about.startswith("Almanza-Medina 4.")


def test_samples_dealt_out_one_by_one_are_on_both_sides(portions: Path) -> None:
    """Almanza-Medina's shuffle: half of what is validated shares a sequence, and so its motion, with what was learnt."""
    split = {"by": "sample", "train": 0.75, "validation": 0.25}
    parts = [SonarPairs(portions, part=part, split=split) for part in ("train", "validation")]
    firsts = [set(pairs.first.tolist()) for pairs in parts]
    whole = SonarPairs(portions, part="all")
    assert firsts[0] | firsts[1] == set(whole.first.tolist())
    assert not firsts[0] & firsts[1]
    assert len(firsts[1]) == round(len(whole) / 4)
    learnt, validated = (set(pairs.sequence[pairs.first].tolist()) for pairs in parts)
    assert len(validated & learnt) > 0.9 * len(validated)
    apart = [SonarPairs(portions, part=part, split={**split, "by": "sequence"}) for part in ("train", "validation")]
    assert not set(apart[0].sequence[apart[0].first].tolist()) & set(apart[1].sequence[apart[1].first].tolist())


# ---------------------------------------------------------------- odometry


@pytest.fixture(scope="module")
def learnt(portions: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a small network of four segments."""
    run = tmp_path_factory.mktemp("learnt") / "run"
    recipe = training_recipe_from({**SMALL, "input": {"kind": "vector", "views": ["c2", "c1", "c3", "c4"]}})
    train(TrainOptions(recipe, portions, run))
    return run


@pytest.mark.thorough
@pytest.mark.parametrize("noise", essence(["none", "high"], "high"))
def test_a_network_of_views_drives_a_path(
    portions: Path, learnt: Path, tmp_path: Path, mitsonar: Command, noise: str
) -> None:
    """Its motions are those that an evaluation of the same frames with the same noise says, and no truth leaks."""
    done = mitsonar(
        "odometry", portions, "--estimator", learnt, "--sequence", "3", "--noise", noise, "-o", tmp_path / "path"
    )
    assert done.returncode == 0, done.stderr
    assert "vectors of c2, c1, c3, c4" in done.stdout
    stored = Checkpoint.load(learnt)
    samples = SonarPairs(portions, part="all", **stored.arrangement, labels=stored.labels["kind"], noise=noise)
    mine = [number for number in range(len(samples)) if samples.sequence[samples.first[number]] == 3]
    expected, _ = predictions(stored, samples, numbers=mine)
    source = open_views(str(portions), ViewNetwork(stored).views, "vector", sequence=3).with_noise(load_noise(noise))
    seen = source.read(np.arange(len(source)))
    result = [ViewNetwork(stored).estimate(seen.select(slice(k, k + 2))).motion for k in range(len(seen) - 1)]
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-7)
    assert seen.poses is not None
    assert not seen.poses[:, [0, 1, 5]].any()
    # the path is the vehicle's, whose motion is learnt: the sonar on it looks 90 deg to port
    truth = [samples.target(number) for number in mine]
    np.testing.assert_allclose(motions(source.poses), truth, atol=1e-9)
    message = json.loads((tmp_path / "path" / "table.json").read_text())["rows"]
    (rmse,) = [one["value"] for one in message if one["name"] == "motion error RMSE, sideways"]
    assert rmse == pytest.approx(1e3 * np.sqrt(((expected - truth)[:, 0] ** 2).mean()), rel=1e-3)


def test_a_network_of_views_doubts_what_does_not_belong_together(portions: Path, learnt: Path) -> None:
    network = pickle.loads(pickle.dumps(ViewNetwork(Checkpoint.load(learnt))))
    source = open_views(str(portions), network.views, "vector", sequence=1)
    pair = source.read([0, 1])
    assert not _rejection_of_profiles(np.tile(np.random.default_rng(1).random((4, 1, 512)), (1, 2, 1)).astype(np.float32))
    strangers = np.random.default_rng(2).random((4, 2, 512)).astype(np.float32)
    assert "correlate by" in _rejection_of_profiles(strangers)
    blank = replace(pair, values={view: np.zeros_like(one) for view, one in pair.values.items()})
    assert network.estimate(blank).reason == "nothing in the frames to match"
    assert pair.height_m is not None
    assert pair.poses is not None
    high = network.estimate(replace(pair, height_m=pair.height_m * 3, poses=pair.poses * [1, 1, 3, 1, 1, 1]))
    assert "the sonar was at" in high.reason
    with pytest.raises(MitsonarError, match="two pings of c2, c1, c3, c4 are needed: got 3"):
        network.estimate(source.read([0, 1, 2]))
    second = {view: one.replace(range_max=2 * one.range_max) for view, one in pair.sonars.items()}
    with pytest.raises(MitsonarError, match="the frames are of didson300: window"):
        network.estimate(replace(pair, sonars=second))
    with pytest.raises(MitsonarError, match="must have the shape"):
        replace(pair, values={view: one[:, :-1] for view, one in pair.values.items()})


def test_a_network_of_views_needs_a_data_set_that_holds_them(
    portions: Path, ahead: Path, learnt: Path, tmp_path: Path, mitsonar: Command
) -> None:
    done = mitsonar("odometry", ahead, "--estimator", learnt, "-o", tmp_path / "path")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "has no vectors of view 'c2': it holds no vectors" in done.stderr
    frames = SonarPairs(ahead, part="all", layout="channels").sonar_frames(7)
    with pytest.raises(MitsonarError, match="takes vectors of c2, c1, c3, c4: use `mitsonar odometry`"):
        ViewNetwork(Checkpoint.load(learnt)).estimate(frames)
    with pytest.raises(MitsonarError, match="has no sequence 99"):
        open_views(str(portions), ["c1"], "vector", sequence=99)


# ---------------------------------------------------------------- the shipped one


@pytest.mark.thorough
@pytest.mark.parametrize("model", essence(["coherent", "physical"], "physical"))
def test_the_shipped_profilenet_knows_unseen_fields(tmp_path: Path, model: str) -> None:
    """Twelve pairs of a field that training has not seen: far better than no motion in both models."""
    scenes = [{"count": 1, "sequences": 12, "world": {"size_m": 30}}]
    changes = {"seed": 4713, "sonar.model": model, "flight.pings": 2, "scenes": scenes, "gain": GAINS[model]}
    make_dataset(load_recipe("looking-down-coherent", changes), str(tmp_path / "unseen.zarr"))
    stored = Checkpoint.load("profilenet-quadrants-coherent")
    report = evaluate(stored, str(tmp_path / "unseen.zarr"), part="all", noise=["none"])
    network, zero = (np.array(report["tables"][0]["rows"][k]["rmse"][:2]) for k in (0, 1))
    assert (network < zero / 2).all(), (network, zero)
    assert "model" not in " ".join(report["notes"])
    estimator = create_estimator("profilenet-quadrants-coherent")
    assert isinstance(estimator, ViewNetwork)
    motion = SonarPairs(tmp_path / "unseen.zarr", part="all").motion[::2]  # speckle changes with large motions
    smallest = int(np.abs(motion[:, :2]).max(axis=1).argmin())
    source = open_views(str(tmp_path / "unseen.zarr"), estimator.views, "vector", sequence=smallest)
    assert estimator.estimate(source.read([0, 1])).valid
