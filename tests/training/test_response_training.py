"""Networks on impulse responses: shapes of the table, batches, a training that ends in a checkpoint and its errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Command, impulse_recipe, refused

from mitsonar.datasets.make import make_dataset
from mitsonar.errors import MitsonarError

torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
pytestmark = [pytest.mark.learn, pytest.mark.usefixtures("variant", "bare_curves")]

from mitsonar.config.training import Optimiser, TrainOptions, load_training_recipe, shipped_training_recipes  # noqa: E402
from mitsonar.config.training import training_recipe_from as recipe_of  # noqa: E402
from mitsonar.datasets.samples import ImpulsePairs  # noqa: E402
from mitsonar.estimation.learned import ResponseNetwork  # noqa: E402
from mitsonar.estimation.named import create_estimator  # noqa: E402
from mitsonar.networks.blocks import SameAverage  # noqa: E402
from mitsonar.networks.checkpoint import Checkpoint  # noqa: E402
from mitsonar.networks.create import create_network  # noqa: E402
from mitsonar.records.responses import ImpulseResponses  # noqa: E402
from mitsonar.training.data import BatchesInMemory, Order, _Collation, fits_on  # noqa: E402
from mitsonar.training.evaluate import evaluate, predictions, samples_for  # noqa: E402
from mitsonar.training.run import train  # noqa: E402

FIELDS: dict[str, Any] = {
    "network": {"name": "impulse_posenet", "width": 0.03, "layers": 6},
    "data": "impulse-standard",
    "input": {"kind": "response", "frames": 3},
    "split": {"by": "scene", "train": 0.5, "validation": 0.5},
    "optimiser": {"rate": 1e-3, "halve_every": 20, "fall_to": 0.8},
    "batch": 4,
    "steps": 12,
    "noise": ["none", "20 dB"],
    "validate": {"every_steps": 6, "pairs": 6, "noise": ["none"]},
}
"""A training that takes a second."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """Two small scenes of ten sequences of three pings, without turns."""
    url = tmp_path_factory.mktemp("made") / "responses.zarr"
    make_dataset(impulse_recipe(scenes=[{"count": 2, "sequences": 10}], flight={"yaw_deg": 0.0}), str(url))
    return url


@pytest.fixture(scope="module")
def run(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small training, unbroken."""
    out = tmp_path_factory.mktemp("run") / "run"
    train(TrainOptions(recipe_of(FIELDS), made, out, threads=1, workers=0))
    return out


def test_batches_in_memory_are_those_of_the_loader(made: Path) -> None:
    pairs, cpu = ImpulsePairs(made, split={"by": "scene", "train": 0.5, "validation": 0.5}, frames=3), torch.device("cpu")
    assert not fits_on(cpu, pairs)
    order = Order(np.arange(len(pairs)), 4, 0, 0, 3, (0, 1))
    for keys, batch in zip(order, BatchesInMemory(pairs, order, cpu), strict=True):
        read = _Collation(pairs, finish=False)([{"epoch": epoch, **pairs.raw(number)} for epoch, number in keys])
        assert batch["epoch"] == read["epoch"]
        for name, values in read["raw"].items():
            assert torch.equal(values, batch["raw"][name]), name
    assert not ImpulsePairs(made, frames=3, leak="one_ping", part="all").arrays


# ---------------------------------------------------------------- the network

ROWS = ((400, 32), (200, 64), (100, 128), (50, 256), (25, 512), (13, 512), (7, 512), (4, 512), (2, 512))
"""Table 5.1: cells along the delay and channels of each convolution; 4 cells across in all of them."""


@pytest.mark.thorough
def test_the_layers_are_those_of_the_table() -> None:
    network: Any = create_network("impulse_posenet", layers=9).eval()
    shapes: list[tuple[str, tuple[int, ...]]] = []
    for layer in network.nets[2]:
        layer.register_forward_hook(lambda one, _, out: shapes.append((type(one).__name__, tuple(out.shape[1:]))))
    matrix = torch.randn(2, 1, 800, 16)
    with torch.no_grad():
        assert network(matrix).shape == (2, 2)
    convolutions = [shape for name, shape in shapes if name == "SameConv2d"]
    assert convolutions == [(channels, rows, 4) for rows, channels in ROWS]
    names = [name for name, _ in shapes]
    assert names.count("ReLU") == names.count("BatchNorm2d") == 8
    assert names[-2:] == ["SameAverage", "Dropout"]
    assert names.index("Dropout") == names.index("ReLU") + 1
    assert names.count("Dropout") == 2
    kernels = [
        tuple(part.weight.shape[-2:]) for part in network.nets[0] if hasattr(part, "weight") and part.weight.dim() == 4
    ]
    assert kernels == [(7, 4), (5, 4), *[(3, 4)] * 7]
    assert network.regression.in_features == 4 * 512 * 2 * 4
    standard = create_network("impulse_posenet")
    assert round(sum(part.numel() for part in standard.parameters()) / 1e6, 1) == 33.7  # docs/reference/files.md
    assert isinstance(network.nets[0][-2], SameAverage)


@pytest.mark.parametrize(("layers", "size", "receivers"), [(6, (800, 80), 4), (7, (800, 8), 2), (8, (1600, 16), 4)])
def test_every_row_of_table_5_2_has_its_network(layers: int, size: tuple[int, int], receivers: int) -> None:
    words = {"layers": layers, "size": list(size), "receivers": receivers}
    network: Any = create_network("impulse_posenet", width=0.05, outputs=3, **words)
    assert network(torch.randn(2, 1, *size)).shape == (2, 3)
    assert create_network("impulse_posenet", **network.options).options == network.options


def test_each_receiver_has_a_net_of_its_own() -> None:
    """What changes in one receiver's columns reaches the answer through its net alone."""
    network: Any = create_network("impulse_posenet", width=0.05).eval()
    matrix = torch.randn(1, 1, 800, 16, requires_grad=True)
    seen: list[Any] = []
    network.nets[1].register_forward_hook(lambda one, given, out: seen.append(given[0]))
    network(matrix)
    torch.testing.assert_close(seen[0], matrix[..., 4:8])


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"layers": 10}, "layers must be 6 to 9"),
        ({"receivers": 3}, "columns for each receiver: got receivers 3"),
        ({"width": 0}, "width must be a number above 0"),
    ],
)
def test_networks_that_cannot_be_are_refused(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(MitsonarError, match=sentence):
        create_network("impulse_posenet", **options)


# ---------------------------------------------------------------- batches


def test_batches_are_the_samples(made: Path) -> None:
    pairs = ImpulsePairs(made, part="all", noise="20 dB", labels="normx10", seed=3)
    inputs, labels = next(pairs.loader(5, shuffle=False))
    assert inputs.shape == (5, 1, 200, 24)
    assert labels.shape == (5, 2)
    for index in range(5):
        one, label = pairs[index]
        assert one.dtype == label.dtype == torch.float32
        torch.testing.assert_close(one, inputs[index], rtol=0, atol=0)
        np.testing.assert_array_equal(one[0].numpy(), pairs.matrix(index))
        np.testing.assert_allclose(pairs.labels.decode(label), pairs.target(index), atol=1e-7)
        assert one.abs().max() <= 1
    before = pairs[0][0]
    pairs.set_epoch(1)
    assert not torch.equal(pairs[0][0], before)
    order = [label for _, label in ImpulsePairs(made, part="all").loader(20)]
    assert not torch.equal(order[0], torch.stack([pairs[index][1] for index in range(20)]))


# ---------------------------------------------------------------- training


def test_the_rate_falls_by_a_fifth_every_20_epochs() -> None:
    """5.4.2."""
    optimiser = load_training_recipe("impulse-standard").optimiser
    assert [optimiser.rate_at(600 * epoch, 600, 1) for epoch in (0, 19, 20, 41)] == pytest.approx([5e-5, 5e-5, 4e-5, 3.2e-5])
    assert Optimiser().rate_at(12, 1, 1) == 5e-5


def test_training_recipes_are_the_rows_of_the_table() -> None:
    layers = {"160khz": 8, "wideband-9600": 8, "wideband-19200": 9, "circular-19200": 9, "ten-80khz": 6, "ten-160khz": 6}
    names = [name for name in shipped_training_recipes() if name.startswith("impulse-") and name != "impulse-posenet"]
    assert len(names) == 16
    for name in names:
        recipe = load_training_recipe(name)
        assert recipe.data == name
        assert recipe.network == {"name": "impulse_posenet", "layers": layers.get(name.removeprefix("impulse-"), 7)}
        assert (recipe.batch, recipe.optimiser.rate, recipe.input.kind) == (4, 5e-5, "response")
        assert recipe.input.frames == (10 if "-ten-" in name else 2)


def test_a_training_ends_in_a_checkpoint(made: Path, run: Path) -> None:
    checkpoint = Checkpoint.load(run)
    assert checkpoint.options["receivers"] == 4
    assert checkpoint.options["size"] == [200, 24]
    assert checkpoint.channel == impulse_recipe().channel_sonar
    assert checkpoint.noise == "none or 20 dB"
    assert len(checkpoint.metrics["none"]["rmse"]) == 2
    rows = dict(checkpoint.rows())
    assert "3 frames of front, left, back, right: response" in rows["input"]
    assert "80000 Hz, 4800 Hz wide, 200 taps" in rows["sonar"]
    samples = samples_for(checkpoint, made, part="validation", split={"train": 0.5, "validation": 0.5})
    output, law = predictions(checkpoint, samples)
    assert output.shape == (10, 2)
    assert law is None
    again = Checkpoint.from_bytes(checkpoint.to_bytes())
    assert again.digest == checkpoint.digest


def test_a_broken_training_goes_on_to_the_same_bits(made: Path, run: Path, tmp_path: Path) -> None:
    count = iter(range(100))
    with pytest.raises(KeyboardInterrupt):
        train(TrainOptions(recipe_of(FIELDS), made, tmp_path / "run", threads=1, workers=0), stop=lambda: next(count) >= 4)
    train(TrainOptions(recipe_of(FIELDS), made, tmp_path / "run", threads=1, workers=0, resume=True))
    assert Checkpoint.load(tmp_path / "run").digest == Checkpoint.load(run).digest


@pytest.mark.thorough
def test_errors_are_told_beside_no_motion(mitsonar: Command, made: Path, run: Path) -> None:
    report = evaluate(Checkpoint.load(run), made, noise=["none", "0 dB"])
    assert [table["noise"] for table in report["tables"]] == ["none", "0 dB"]
    network, zero = report["tables"][0]["rows"]
    assert len(network["rmse"]) == len(zero["slope"]) == 2
    pairs = ImpulsePairs(made, part="validation")
    np.testing.assert_allclose(zero["rmse"], 1e3 * np.sqrt((pairs.targets() ** 2).mean(axis=0)))
    done = mitsonar("evaluate", run, made, "--json")
    assert done.returncode == 0, done.stderr
    assert [table["noise"] for table in json.loads(done.stdout)["tables"]] == ["none"]
    assert "sideways mm / forward mm\n" in mitsonar("evaluate", run, made).stdout
    refused(mitsonar("evaluate", run, made, "--noise", "low"), "'20 dB', or none: got 'low'")


def test_another_instrument_is_refused(made: Path, run: Path, tmp_path: Path) -> None:
    url = tmp_path / "other.zarr"
    make_dataset(impulse_recipe(scenes=[{"count": 1, "sequences": 2}], channel={"carrier_hz": 60e3}), str(url))
    with pytest.raises(MitsonarError, match="a different channel sonar from that of received: carrier_hz differ"):
        evaluate(Checkpoint.load(run), url, part="all")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"noise": "high"},
            "noise of input.kind response must be a signal to noise ratio such as '20 dB', or none: got 'high'",
        ),
        ({"input": {"kind": "response", "layout": "stack"}}, "input.layout does not apply to kind response"),
        ({"input": {"kind": "image", "leak": "one_ping"}}, "input.leak does not apply to kind image"),
    ],
)
def test_mistakes_in_recipes_are_answered(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(MitsonarError, match=sentence):
        recipe_of({**FIELDS, **changes})


def test_what_does_not_go_together_is_answered(made: Path, tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match="not rendered in training"):
        train(TrainOptions(recipe_of(FIELDS), None, tmp_path / "run", render=True))
    with pytest.raises(MitsonarError, match="holds impulse responses, but images are needed"):
        train(
            TrainOptions(recipe_of({**FIELDS, "input": {}, "noise": "none", "network": "posenet"}), made, tmp_path / "run")
        )


# ---------------------------------------------------------------- estimates


def records(pairs: ImpulsePairs, index: int, **fields: Any) -> ImpulseResponses:
    """One sample as an estimator reads it."""
    response = pairs.response(index)
    low, high = pairs.recipe.flight.heights
    words = {
        "time_s": 0.05 * np.arange(len(response)),
        "sonar": pairs.sonar,
        "height_m": np.full(len(response), (low + high) / 2),
    }
    return ImpulseResponses(response, **{**words, **fields})


def test_a_checkpoint_estimates_what_evaluation_scores(made: Path, run: Path) -> None:
    pairs = ImpulsePairs(made, part="validation")
    expected, _ = predictions(Checkpoint.load(run), pairs)
    estimator = create_estimator(str(run))
    assert isinstance(estimator, ResponseNetwork)
    assert estimator.consumes is ImpulseResponses
    for index in range(3):
        result = estimator.estimate(records(pairs, index))
        np.testing.assert_allclose(result.motion[:2], expected[index], rtol=1e-4, atol=1e-7)
        assert result.motion.yaw == 0
        assert result.valid, result.reason
        assert result.covariance is not None
        promised = np.array(Checkpoint.load(run).rmse)
        assert 1e3 * np.sqrt(np.diag(result.covariance))[:2] == pytest.approx(promised)


def test_it_refuses_what_it_was_not_trained_for(made: Path, run: Path) -> None:
    pairs = ImpulsePairs(made, part="validation")
    estimator = create_estimator(str(run))
    with pytest.raises(MitsonarError, match=r"takes 3 pings: got 2"):
        estimator.estimate(records(pairs, 0).select(slice(2)))
    with pytest.raises(MitsonarError, match=r"sound_speed 1480.0, not 1500.0; train on that one, use likelihood"):
        estimator.estimate(records(pairs, 0, sonar=pairs.sonar.replace(sound_speed=1480.0)))
    slow = records(pairs, 0, sonar=pairs.sonar.replace(sound_speed=1480.0))
    forced = create_estimator(str(run), force=True).estimate(slow)
    assert forced.covariance is not None
    elsewhere = estimator.estimate(records(pairs, 0, height_m=np.full(3, 44.0)))
    assert not elsewhere.valid
    assert "was at 44.00 m" in elsewhere.reason
    loud = records(pairs, 0)
    silent = estimator.estimate(ImpulseResponses(0 * loud.response, loud.time_s, loud.sonar, height_m=loud.height_m))
    assert (silent.valid, silent.reason) == (False, "no receiver has any echo")
