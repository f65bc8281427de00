"""Training: the loss and schedule by hand, the same bits after kills, mistakes answered before it begins."""

from __future__ import annotations

import csv
import dataclasses
import inspect
import itertools
import json
import os
import signal
import subprocess
import sys
import textwrap
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
import yaml
import zarr
from helpers import TINY, tiny_recipe
from scipy.stats import multivariate_normal
from typer.testing import CliRunner

from mitsonar.datasets.make import make_dataset
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.io.runs import differences

torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
pytestmark = [pytest.mark.learn, pytest.mark.usefixtures("variant", "bare_curves")]

from mitsonar.cli.train import train as command  # noqa: E402
from mitsonar.config.training import (  # noqa: E402
    Loss,
    Optimiser,
    TrainingRecipe,
    TrainOptions,
    load_training_recipe,
    training_recipe_from,
)
from mitsonar.datasets.arrangement import Labels  # noqa: E402
from mitsonar.datasets.make import SceneRenderer  # noqa: E402
from mitsonar.datasets.rendered import RawStream, RenderedPairs  # noqa: E402
from mitsonar.datasets.samples import (  # noqa: E402
    JoinedPairs,
    SonarPairs,
)
from mitsonar.networks.checkpoint import Checkpoint  # noqa: E402
from mitsonar.networks.corrnet import GaussianHead  # noqa: E402
from mitsonar.training.data import (  # noqa: E402
    BatchesInMemory,
    Order,
    Validation,
    _Collation,
    finished,
    fits_on,
    material_of,
)
from mitsonar.training.evaluate import evaluate  # noqa: E402
from mitsonar.training.journal import TrainingReport, _score  # noqa: E402
from mitsonar.training.run import train  # noqa: E402
from mitsonar.training.step import create_loss, squared_error  # noqa: E402

FIELDS: dict[str, Any] = {
    "network": {"name": "posenet", "width": 0.03},
    "noise": ["none", "high"],
    "optimiser": {"rate": 1e-3},
    "batch": 8,
    "steps": 20,
    "validate": {"every_steps": 10, "pairs": 5, "noise": ["none", "low"]},
}
"""A training that takes a second."""


def recipe(**changes: Any) -> TrainingRecipe:
    """The small training with some keys changed."""
    return training_recipe_from({**FIELDS, **changes})


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small scenes of ten sequences: 76 pairs to learn from, 4 to validate on."""
    url = tmp_path_factory.mktemp("made") / "tiny.zarr"
    make_dataset(tiny_recipe(scenes=[{"count": 2, "sequences": 10}]), str(url))
    return url


@pytest.fixture(scope="module")
def whole(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small training, unbroken."""
    out = tmp_path_factory.mktemp("whole") / "run"
    train(TrainOptions(recipe(), made, out, threads=1, workers=0))
    return out


def weights(out: Path) -> dict[str, Any]:
    """Network and optimiser of a run's state, flat."""
    state = torch.load(out / "last.ckpt", weights_only=True)
    (optimiser,) = state["optimizer_states"]
    moments = {f"{number}.{name}": value for number, one in optimiser["state"].items() for name, value in one.items()}
    return {**state["state_dict"], **moments}


def assert_same(one: dict[str, Any], other: dict[str, Any]) -> None:
    """Bit for bit."""
    assert one.keys() == other.keys()
    for name, values in one.items():
        torch.testing.assert_close(values, other[name], rtol=0, atol=0, msg=name)


# ---------------------------------------------------------------- loss and schedule


def test_loss_is_that_of_the_equations() -> None:
    """Eq. 3.1 and 3.3 by hand: S = 2 samples of W = 3."""
    estimates = torch.tensor([[1.0, 2.0, 3.0], [12.0, -11.0, 0.0]])
    labels = torch.tensor([[0.0, 2.0, 5.0], [10.0, -10.0, 1.0]])
    square = (1 + 0 + 4) + (4 + 1 + 1)
    assert squared_error(estimates, labels).item() == pytest.approx(square / (2 * 2 * 3))
    penalised = square + 100 * (2**2 + 1**2)
    assert squared_error(estimates, labels, penalty=100).item() == pytest.approx(penalised / 12)
    coder = Labels.of("normx10", tiny_recipe(), 2)
    assert create_loss(Loss(penalty=100), coder)(estimates, labels).item() == pytest.approx(penalised / 12)
    narrow = create_loss(Loss(penalty=1, bounds=(-1, 2.5)), coder)(estimates, labels).item()
    assert narrow == pytest.approx((square + 0.5**2 + 9.5**2 + 10**2) / 12)


def test_bounds_of_the_penalty_are_the_largest_motions() -> None:
    """In the units of each kind of label: 0..31 of quantised ones."""
    estimates = torch.tensor([[-2.0, 33.0, 31.0]])
    loss = create_loss(Loss(penalty=10), Labels.of("quantised", tiny_recipe(), 2))
    assert loss(estimates, estimates).item() == pytest.approx(10 * (4 + 4) / 6)


def test_likelihood_is_the_density_of_a_gaussian() -> None:
    rng = np.random.default_rng(1)
    scale = np.array([1e-3, 1e-3, 2.5e-4])
    factor = rng.normal(size=(4, 3, 3))
    covariance = (factor @ factor.transpose(0, 2, 1) + np.eye(3)) * scale[:, None] * scale
    mean, target = rng.normal(size=(2, 4, 3)) * scale
    law = GaussianHead(torch.tensor(mean), torch.tensor(covariance))
    got = create_loss(Loss(kind="likelihood"), Labels.of("raw", tiny_recipe(), 2))(law, torch.tensor(target))
    density = [
        multivariate_normal(m / scale, c / scale[:, None] / scale).logpdf(t / scale)
        for m, c, t in zip(mean, covariance, target, strict=True)
    ]
    assert got.item() == pytest.approx(-np.mean(density) - 1.5 * np.log(2 * np.pi))


def test_rates_by_hand() -> None:
    halved = Optimiser(rate=1.0, halve_every=2)
    assert [halved.rate_at(step, 10, 60) for step in (0, 19, 20, 39, 40)] == [1, 1, 0.5, 0.5, 0.25]
    cosine = Optimiser(rate=1.0, schedule="cosine", warmup=4)
    assert [cosine.rate_at(step, 10, 24) for step in (0, 1, 3)] == [0.25, 0.5, 1.0]
    assert cosine.rate_at(14, 10, 24) == pytest.approx(0.5)
    assert cosine.rate_at(24, 10, 24) == pytest.approx(0.0)
    assert Optimiser(rate=0.5, schedule="constant").rate_at(10**6, 10, 20) == 0.5


# ---------------------------------------------------------------- recipes


def test_recipes_say_what_they_leave_out(tmp_path: Path) -> None:
    """The training of Almanza-Medina, from three lines; keys changed with dots; and back from what a run keeps."""
    path = tmp_path / "mine.yaml"
    path.write_text("network: posenet\ndata: mine-data.yaml\nnoise: low\n")
    message = load_training_recipe(path, {"network.width": 0.5, "validate.pairs": 7})
    assert message.network == {"name": "posenet", "width": 0.5}
    assert message.data == str(tmp_path / "mine-data.yaml")
    assert (message.batch, message.epochs, message.steps, message.optimiser.rate, message.optimiser.halve_every) == (
        4,
        32,
        None,
        1e-4,
        12,
    )
    assert recipe(noise=["none", "high"]).noise_text == "none or high"
    assert (message.labels, message.validation.pairs, message.length(38_000)) == ("normx10", 7, 32 * 38_000)
    (tmp_path / "again.yaml").write_text(yaml.safe_dump(message.plain()))
    assert load_training_recipe(tmp_path / "again.yaml") == message
    assert differences(message.plain(), message.replace(seed=3).plain()) == ["seed 0, not 3"]
    assert recipe().length(10) == 20
    assert recipe(steps=None, epochs=2.5).length(10) == 25


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"bach": 4}, "unknown training recipe key bach: did you mean batch"),
        ({"optimiser": {"rates": 1}}, "unknown training recipe key optimiser.rates: did you mean rate"),
        ({"validate": {"pairs": 0}}, "validate.pairs"),
        ({"noise": "loud"}, "noise must be none, low, high"),
        ({"noise": []}, "empty list"),
        ({"epochs": 3}, "either epochs or steps"),
        ({"epochs": np.inf, "steps": None}, "epochs: input should be a finite number"),
        ({"split": "world"}, "split must be sequence, scene"),
        ({"split": {"trian": 0.9}}, "did you mean train"),
        ({"loss": {"kind": "likelihood", "penalty": 1}}, "penalty applies only to kind mse"),
        ({"network": {"width": 1}}, "network must be a name"),
        ({"batch": "many"}, "batch"),
        ({"optimiser": {"rate": float("nan")}}, "optimiser.rate"),
    ],
)
def test_mistakes_in_recipes_are_answered(fields: dict[str, Any], sentence: str) -> None:
    with pytest.raises(MitsonarError, match=sentence):
        recipe(**fields)


# ---------------------------------------------------------------- what is read


def test_order_belongs_to_seed_and_epoch_and_is_skipped_by_index() -> None:
    """Every epoch deals all samples; from any step on the same as without a break; devices share each batch."""
    numbers = np.arange(100, 123)

    def order(start: int, share: tuple[int, int] = (0, 1), seed: int = 5) -> list[list[tuple[int, int]]]:
        return list(Order(numbers, 4, seed, start, 30, share))

    whole = order(0)
    assert [len(batch) for batch in whole] == [4] * 30
    for epoch in range(6):
        dealt = [number for batch in whole[5 * epoch : 5 * epoch + 5] for _, number in batch]
        assert len(set(dealt)) == 20
        assert {one for batch in whole[5 * epoch : 5 * epoch + 5] for one, _ in batch} == {epoch}
    assert whole[:5] != whole[5:10]
    assert order(0, seed=6) != whole
    for start in (1, 7, 29):
        assert order(start) == whole[start:]
    for batch, first, second in zip(whole, order(0, (0, 2)), order(0, (1, 2)), strict=True):
        assert sorted(first + second) == sorted(batch)


@pytest.mark.thorough
def test_of_several_noise_levels_each_sample_draws_one(made: Path) -> None:
    """Whole samples of one level, wherever they stand in a batch; another level in another epoch; all about as often."""
    words: dict[str, Any] = {"part": "all", "layout": "channels", "coordinates": "both", "cartesian_rows": 30, "seed": 3}
    mixed = SonarPairs(made, noise=["none", "low", "high"], **words)
    single = [SonarPairs(made, noise=level, **words) for level in ("none", "low", "high")]
    (batch, fans), _ = next(mixed.loader(len(mixed), shuffle=False))
    levels = []
    for index in range(len(mixed)):
        same = [k for k, pairs in enumerate(single) if torch.equal(pairs[index][0][0], batch[index])]
        assert len(same) == 1
        assert torch.equal(single[same[0]][index][0][1], fans[index])
        levels += same
        if index < 5:
            assert torch.equal(mixed[index][0][0], batch[index])
    counts = np.bincount(levels, minlength=3)
    assert (np.abs(counts - 80 / 3) < 3 * np.sqrt(80 * 2 / 9)).all(), counts  # three standard deviations
    mixed.set_epoch(1)
    single[2].set_epoch(1)
    again = [torch.equal(single[2][index][0][0], mixed[index][0][0]) for index in range(len(mixed))]
    assert [level == 2 for level in levels] != again
    with pytest.raises(MitsonarError, match="noise must be a name"):
        SonarPairs(made, noise=[])


@pytest.mark.thorough
def test_batches_are_the_same_wherever_they_are_finished(made: Path) -> None:
    """Where they are read, as for a CPU, or on the device of the network: epoch and noise go with them."""
    message = recipe()
    material = material_of(message, made, render=False)
    assert material.numbers is not None
    order = Order(material.numbers, 8, 0, 12, 15, (0, 1))
    samples = material.samples
    assert isinstance(samples, SonarPairs)
    rows = [[{"epoch": epoch, **samples.raw(number)} for epoch, number in batch] for batch in order]
    read = [_Collation(samples, finish=True)(batch) for batch in rows]
    moved = [_Collation(samples, finish=False)(batch) for batch in rows]
    assert [batch["epoch"] for batch in read] == [1, 1, 1]
    samples.set_epoch(7)
    for one, second, planned in zip(read, moved, order, strict=True):
        inputs, label = finished(second, samples, torch.device("cpu"))
        assert torch.equal(inputs, one["inputs"])
        assert torch.equal(label, one["label"])
        assert one["frames"].tolist() == samples.first[[number for _, number in planned]].tolist()


@pytest.mark.slow
def test_rendered_samples_are_skipped_without_rendering_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worlds that lie behind are not built again; what waited in the buffer is."""
    words: dict[str, Any] = {"sequences_per_world": 3, "buffer": 6, "gain": 0.02, "noise": "none"}
    worlds: list[int] = []
    build = SceneRenderer.__init__

    def counted(self: SceneRenderer, described: Any, scene: Any) -> None:
        worlds.append(scene.number)
        build(self, described, scene)

    monkeypatch.setattr(SceneRenderer, "__init__", counted)
    pairs = RenderedPairs(tiny_recipe(), seed=1, **words)
    whole = list(itertools.islice(pairs.raw(), 46))
    assert worlds == list(range(5))
    worlds.clear()
    tail = list(itertools.islice(pairs.raw(skip=36), 10))
    assert worlds[0] >= 1
    assert worlds == list(range(worlds[0], 5))
    for one, second in zip(tail, whole[36:], strict=True):
        for name in one:
            np.testing.assert_array_equal(one[name], second[name])
    batches = list(itertools.islice(iter(RawStream(pairs, batch_size=6, skip=6)), 10))
    assert [sample["frames"][0] for sample in batches] == [sample["frames"][0] for sample in tail]


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Other scenes in another model: 38 pairs to learn from, 2 to validate on."""
    url = tmp_path_factory.mktemp("other") / "other.zarr"
    changes = {"name": "other", "seed": 8, "scenes": [{"count": 2, "sequences": 5}], "sonar__model": "physical"}
    make_dataset(tiny_recipe(**changes), str(url))
    return url


def test_two_data_sets_are_learnt_from_as_one(made: Path, other: Path) -> None:
    """Every sample of both once an epoch, each as its own set stores it, under frame numbers of its own."""
    message = recipe(noise="high", split={"train": 0.5, "validation": 0.5}, validate={"pairs": 15, "noise": ["none"]})
    joined = material_of(message, [made, other], render=False)
    alone = [material_of(message, one, render=False) for one in (made, other)]
    assert joined.epoch == sum(one.epoch for one in alone) == 60
    samples, sets = joined.samples, [one.samples for one in alone]
    assert isinstance(samples, JoinedPairs)
    assert isinstance(sets[0], SonarPairs)
    assert isinstance(sets[1], SonarPairs)
    for index, local, offset in ((3, sets[0].raw(3), 0), (43, sets[1].raw(3), 100)):
        result = samples.raw(index)
        np.testing.assert_array_equal(result["image"], local["image"])
        np.testing.assert_array_equal(result["label"], local["label"])
        np.testing.assert_array_equal(result["frames"], local["frames"] + offset)
    clean, noisy = (sets[1][3][0], samples[43][0])
    assert not torch.equal(clean, noisy)  # its own noise, not that of the frame of the same number
    samples.arrange, sets[1].arrange = samples.at_noise("none"), sets[1].at_noise("none")
    assert torch.equal(sets[1][3][0], samples[43][0])
    firsts = samples.first[numbers_of(joined.validation)]
    assert len(np.unique(samples.sequence[firsts])) == len(joined.validation) == 15  # one a sequence
    assert (joined.about["name"], joined.about["gain"]) == ("tiny and other", None)
    assert joined.about["digest"] != material_of(message, [other, made], render=False).about["digest"]


@pytest.mark.thorough
def test_a_motion_in_training_of_one_set_and_validation_of_another_is_told(made: Path, tmp_path: Path) -> None:
    """Two models of one recipe: a shorter set has the same sequences, but they are divided anew."""
    for name, sequences in (("short", 14), ("whole", None)):
        changes = {"name": name, "scenes": [{"count": 2, "sequences": 10}], "sonar__model": "physical", "gain": 0.02}
        make_dataset(tiny_recipe(**changes), str(tmp_path / name), sequences=sequences)
    message = recipe(split={"train": 0.5, "validation": 0.5}, validate={"pairs": None, "noise": ["none"]})
    with pytest.warns(MitsonarWarning, match="validation samples show a motion over a world that training sees") as warned:
        joined = material_of(message, [made, tmp_path / "short"], render=False)
    samples, unseen = joined.samples, joined.validation.samples
    assert isinstance(samples, JoinedPairs)
    assert isinstance(unseen, JoinedPairs)
    taught = {part.pose[first].tobytes() for part in samples.parts for first in part.first}
    common = sum(part.pose[first].tobytes() in taught for part in unseen.parts for first in part.first)
    assert str(warned[0].message).startswith(f"{common} of {len(unseen)} validation samples")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        material_of(message, [made, tmp_path / "whole"], render=False)


def test_rendering_is_not_resumed_with_other_validation_samples(made: Path, tmp_path: Path) -> None:
    """The best network would be chosen among errors on two sets of samples."""
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(DataStore.open(made).about["recipe"], sort_keys=False))
    message = recipe(data=str(tmp_path / "tiny.yaml"), validate={"pairs": 2, "noise": ["none"]})
    about = [material_of(message, data, render=True, gain=0.02).about for data in (made, None)]
    assert about[0]["name"] == about[1]["name"]
    assert about[0]["digest"] != about[1]["digest"]


@pytest.mark.thorough
def test_a_network_of_two_models_names_both(made: Path, other: Path, tmp_path: Path) -> None:
    stored = train(TrainOptions(recipe(steps=2), [made, other], tmp_path / "run", threads=1, workers=0))
    assert (stored.model, stored.data) == ("thesis and physical", "tiny and other")
    report = evaluate(stored, str(other), part="all", noise=["none"])
    assert not [note for note in report["notes"] if "model" in note]
    for data, pairs in ((made, 20), (other, 10)):  # also of the second data set
        taught = SonarPairs(data, split="sequence")
        seen = len(np.unique(taught.sequence[taught.first]))
        notes = evaluate(stored, str(data), part="all", noise=["none"])["notes"]
        assert f"training has seen {seen} of these {pairs} pairs" in notes[0]
    with pytest.raises(MitsonarError, match="begun with data tiny and other, not tiny"):
        train(TrainOptions(recipe(steps=2), made, tmp_path / "run", resume=True, threads=1, workers=0))


@pytest.mark.thorough
def test_data_sets_that_cannot_be_joined_are_refused(made: Path, tmp_path: Path) -> None:
    wider = tmp_path / "wider.zarr"
    make_dataset(tiny_recipe(scenes=[{"count": 2, "sequences": 5}], sonar__beams=14), str(wider))
    with pytest.raises(MitsonarError, match=r"agree in .*made.*tiny.zarr has beams .*wider.zarr has"):
        material_of(recipe(), [made, wider], render=False)
    with pytest.raises(MitsonarError, match="with --render at most one data set"):
        material_of(recipe(), [made, made], render=True)


def numbers_of(validation: Validation) -> list[int]:
    """The numbers of stored samples."""
    numbers = [row for row in validation.rows if isinstance(row, int)]
    assert len(numbers) == len(validation)
    return numbers


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["image", "vector"])
def test_batches_in_the_memory_of_a_device_are_those_of_the_loader(kind: str, tmp_path: Path) -> None:
    """Bit for bit, in raw samples and in finished ones with noise; CPUs read, and so do frames with ground geometry."""
    url = tmp_path / "both.zarr"
    make_dataset(tiny_recipe(scenes=[{"count": 1, "sequences": 10}], store="both"), str(url))
    pairs, cpu = SonarPairs(url, kind=kind, noise="high", split="sample"), torch.device("cpu")
    order = Order(np.arange(len(pairs)), 8, 0, 1, 6, (0, 1))
    assert not fits_on(cpu, pairs)
    for keys, batch in zip(order, BatchesInMemory(pairs, order, cpu), strict=True):
        read = _Collation(pairs, finish=False)([{"epoch": epoch, **pairs.raw(number)} for epoch, number in keys])
        assert batch["epoch"] == read["epoch"]
        assert torch.equal(batch["frames"], read["frames"])
        assert batch["raw"].keys() == read["raw"].keys()
        for name, values in read["raw"].items():
            assert values.dtype == batch["raw"][name].dtype
            assert torch.equal(values, batch["raw"][name]), name
        for one, other in zip(finished(batch, pairs, cpu), finished(read, pairs, cpu), strict=True):
            assert torch.equal(one, other)


def test_a_part_of_the_data_is_its_first_frames(made: Path) -> None:
    half = material_of(recipe(part_of_data=0.5, split={"train": 0.5, "validation": 0.5}), made, render=False)
    whole = material_of(recipe(split={"train": 0.5, "validation": 0.5}), made, render=False)
    assert half.numbers is not None
    assert isinstance(half.samples, SonarPairs)
    assert half.samples.first[half.numbers].max() + 2 <= 50
    assert 0 < half.epoch < whole.epoch == 40
    sequences = half.samples.sequence
    validation = half.validation
    assert isinstance(validation.samples, SonarPairs)
    assert max(validation.samples.first[numbers_of(validation)]) + 2 <= 50
    chosen = whole.validation
    assert isinstance(chosen.samples, SonarPairs)
    assert len({sequences[chosen.samples.first[row]] for row in numbers_of(chosen)}) == len(chosen) == 5  # one a sequence


# ---------------------------------------------------------------- runs


def test_the_command_has_the_options_of_a_training() -> None:
    parameters = set(inspect.signature(command).parameters)
    assert parameters - {"change"} == {one.name for one in dataclasses.fields(TrainOptions)}


KILLED = """
    import os, sys
    from mitsonar.io import files
    from mitsonar.config.training import TrainOptions
    from mitsonar.training.run import train

    if __name__ == "__main__":
        _, told, data, out, when, render = sys.argv

        def die():
            os.kill(os.getpid(), 9)

        def progress(report):
            if when == f"step {report.step}":
                die()

        if when == "writing":  # in the middle of the ninth state
            states, write, sync = [], files.write_atomic, os.fsync
            def counted(number):
                name = os.readlink(f"/proc/self/fd/{number}")
                states.append(name) if "last.ckpt" in name else None
                sync(number) if len(states) < 9 else (os.truncate(name, 1000), die())
            os.fsync = counted
        words = {"threads": 1, "workers": 0, "resume": True, "state_minutes": 0}
        train(TrainOptions(told, data or None, out, render=bool(render), **words), progress=progress)
"""


def killed(told: Path, data: Path | str, out: Path, when: str, *, render: bool = False) -> None:
    """A training in a process of its own, ended by SIGKILL."""
    script = told.with_suffix(".py")
    script.write_text(textwrap.dedent(KILLED))
    call = [sys.executable, str(script), str(told), str(data), str(out), when, "yes" if render else ""]
    done = subprocess.run(call, capture_output=True, text=True, timeout=300)
    assert done.returncode == -signal.SIGKILL, done.stderr


@pytest.mark.linux
@pytest.mark.slow
@pytest.mark.e2e
def test_killed_runs_end_with_the_same_bits(made: Path, whole: Path, tmp_path: Path) -> None:
    """Killed while it writes its state, and in the middle of its second epoch: weights, optimiser, log as if unbroken."""
    message = tmp_path / "mine.yaml"
    message.write_text(yaml.safe_dump(FIELDS))
    killed(message, made, tmp_path / "broken", "writing")
    assert torch.load(tmp_path / "broken" / "last.ckpt", weights_only=True)["global_step"] == 8
    killed(message, made, tmp_path / "broken", "step 14")
    train(TrainOptions(message, made, tmp_path / "broken", resume=True, threads=1, workers=0))
    assert_same(weights(whole), weights(tmp_path / "broken"))
    logs = [list(csv.DictReader((out / "log.csv").open())) for out in (whole, tmp_path / "broken")]
    for one, second in zip(*logs, strict=True):
        assert {k: v for k, v in one.items() if k != "minutes"} == {k: v for k, v in second.items() if k != "minutes"}
    best = [Checkpoint.load(out) for out in (whole, tmp_path / "broken")]
    assert best[0].digest == best[1].digest


@pytest.mark.linux
@pytest.mark.slow
@pytest.mark.e2e
def test_killed_runs_that_render_end_with_the_same_bits(tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump({**TINY, "scenes": [{"count": 1, "sequences": 4}]}))
    message = tmp_path / "mine.yaml"
    message.write_text(yaml.safe_dump({**FIELDS, "data": "tiny.yaml", "steps": 8}))
    killed(message, "", tmp_path / "broken", "step 4", render=True)
    words: dict[str, Any] = {"render": True, "threads": 1, "workers": 0}
    train(TrainOptions(message, None, tmp_path / "whole", **words))
    result = train(TrainOptions(message, None, tmp_path / "broken", resume=True, **words))
    assert_same(weights(tmp_path / "whole"), weights(tmp_path / "broken"))
    assert result.data == "tiny"
    assert result.metrics["none"]["pairs"] == 5


@pytest.mark.slow
def test_validation_states_and_workers_do_not_touch_the_training(made: Path, whole: Path, tmp_path: Path) -> None:
    """Nor does the global state of torch: it is left as it was."""
    torch.manual_seed(7)
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    seldom = {**FIELDS["validate"], "every_steps": 100, "pairs": 2}
    train(TrainOptions(recipe(validate=seldom), made, tmp_path / "seldom", threads=1, workers=1, state_minutes=0))
    assert torch.equal(before, torch.get_rng_state())
    assert torch.get_num_threads() == threads
    assert not torch.are_deterministic_algorithms_enabled()
    assert_same(weights(whole), weights(tmp_path / "seldom"))


def test_the_network_kept_is_that_which_is_better_on_every_axis_alike() -> None:
    """A per cent of an axis that nobody tells does not outweigh the halving of another; levels of noise count alike."""
    zero = np.array([11.6, 11.6, 0.26])
    message, moved = np.array([0.4, 0.5, 0.190]), np.array([0.8, 0.7, 0.185])
    assert _score([message], zero) < _score([moved], zero)
    assert _score([message, moved], zero) == pytest.approx(np.sqrt(_score([message], zero) * _score([moved], zero)))
    assert _score([zero], zero) == pytest.approx(1)
    still = np.array([11.6, 0.0, 0.26])  # no sample moves forward
    assert _score([message], still) == pytest.approx(np.sqrt(0.4 / 11.6 * 0.190 / 0.26))
    assert _score([message], np.zeros(3)) == pytest.approx(message.mean())


@pytest.mark.thorough
def test_a_run_keeps_what_it_promises(
    made: Path, tmp_path: Path, bare_curves: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best network's errors, computed again from its file; the log; the picture; a network that has learnt."""
    monkeypatch.setattr("mitsonar.training.journal.curve_figure", bare_curves)
    reports: list[TrainingReport] = []
    labels: dict[str, Any] = {"labels": "quantised", "noise": "none", "optimiser": {"rate": 3e-3}, "steps": 60}
    labels |= {"split": {"train": 0.8, "validation": 0.2}, "validate": {"every_steps": 20, "pairs": None, "noise": ["low"]}}
    message = recipe(**labels, network={"name": "posenet", "width": 0.06, "dropout": 0.0}, part_of_data=0.4)
    out = tmp_path / "run"
    best = train(TrainOptions(message, made, out, threads=1), progress=reports.append)
    rows = list(csv.DictReader((out / "log.csv").open()))
    assert [int(row["step"]) for row in rows] == [20, 40, 60]
    assert [report.step for report in reports] == list(range(1, 61))
    assert reports[-1].loss < 0.5 * reports[5].loss
    assert reports[-1].rmse[0] < reports[5].rmse[0]
    pairs = SonarPairs(made, part="validation", split=labels["split"])
    truth = np.array([pairs.target(index) for index in range(len(pairs))])
    stored = [index for index in range(len(pairs)) if pairs.first[index] + 2 <= 0.4 * 100]
    network = best.build()
    with torch.no_grad():
        result = best.coder.decode(network(torch.stack([pairs[index][0] for index in stored])))
    rmse = np.sqrt(((result - truth[stored]) ** 2).mean(axis=0)) * [1e3, 1e3, 180 / np.pi]
    np.testing.assert_allclose(best.metrics["none"]["rmse"], rmse, rtol=1e-5)
    row = next(row for row in rows if int(row["step"]) == best.trained["steps"])
    assert float(row["none sideways (mm)"]) == pytest.approx(rmse[0], rel=1e-4)
    assert float(row["low yaw (deg)"]) == pytest.approx(best.metrics["low"]["rmse"][2], rel=1e-4)
    assert (out / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "curve.png").stat().st_size > 10_000
    assert best.recipe == message.plain()
    assert load_training_recipe(out / "recipe.yaml") == message


def test_a_stop_leaves_a_network_and_a_row_of_the_log(made: Path, tmp_path: Path) -> None:
    """Even the first step's; a run without a network, which was killed, asks for more minutes."""
    message = recipe(steps=3, validate={"every_steps": 100, "pairs": 4, "noise": ["none"]})
    with pytest.raises(KeyboardInterrupt):
        train(TrainOptions(message, made, tmp_path / "run", threads=1), stop=lambda: True)
    stored = Checkpoint.load(tmp_path / "run")
    (row,) = csv.DictReader((tmp_path / "run" / "log.csv").open())
    assert (stored.trained["steps"], int(row["step"])) == (1, 1)
    assert stored.trained["sequences"] == {DataStore.open(made).recipe.digest(): 20}
    assert float(row["none sideways (mm)"]) == pytest.approx(stored.metrics["none"]["rmse"][0], rel=1e-4)
    (tmp_path / "run" / "network.ckpt").unlink()
    with pytest.raises(
        MitsonarError, match=r"stopped before it validated once, and has used its 1e-09 minutes .* resume it with more"
    ):
        train(TrainOptions(message, made, tmp_path / "run", resume=True, minutes=1e-9))
    assert train(TrainOptions(message, made, tmp_path / "run", resume=True, minutes=5)).trained["steps"] == 3


@pytest.mark.thorough
def test_runs_that_are_there_are_kept(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    message = recipe(steps=2)
    first = train(TrainOptions(message, made, out, threads=1))
    with pytest.raises(MitsonarError, match="--resume continues it, --overwrite begins anew"):
        train(TrainOptions(message, made, out))
    with pytest.raises(MitsonarError, match=r"begun with recipe\.optimiser\.rate 0\.001, not 0\.002"):
        train(TrainOptions(recipe(steps=2, optimiser={"rate": 2e-3}), made, out, resume=True))
    second = tmp_path / "other.zarr"
    make_dataset(tiny_recipe(scenes=[{"count": 2, "sequences": 10}], seed=3), str(second))
    with pytest.raises(MitsonarError, match="begun with digest"):
        train(TrainOptions(message, second, out, resume=True))
    before = weights(out)
    assert train(TrainOptions(message, made, out, resume=True, threads=1)).digest == first.digest  # nothing was left to do
    assert_same(before, weights(out))
    assert train(TrainOptions(message, made, out, overwrite=True, threads=1)).digest == first.digest
    (out / "last.ckpt").write_bytes((out / "last.ckpt").read_bytes()[:5000])
    with pytest.raises(MitsonarError, match=r"last\.ckpt is damaged"):
        train(TrainOptions(message, made, out, resume=True))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("all of it")
    for resume, overwrite in ((False, False), (True, False), (False, True)):
        with pytest.raises(MitsonarError, match=r"contains other files \(thesis\.txt\) and is kept"):
            train(TrainOptions(message, made, tmp_path / "mine", resume=resume, overwrite=overwrite))


def test_a_loss_that_is_not_finite_stops_and_says_where(tmp_path: Path) -> None:
    """One pixel of a stored frame is not a number: its step is named, and the state on disk is that of the step before."""
    url = tmp_path / "spoilt.zarr"
    make_dataset(tiny_recipe(scenes=[{"count": 1, "sequences": 20}], pixel="float32"), str(url))
    message = recipe(steps=9, noise="none")
    learnt = material_of(message, url, render=False)
    assert learnt.numbers is not None
    assert isinstance(learnt.samples, SonarPairs)
    first = int(learnt.samples.first[learnt.numbers[20]])  # begins one sample and ends none, where a sequence begins
    frame = first - first % 5
    stored: Any = zarr.open_group(str(url), mode="r+")["image"]
    stored[frame, 17, 5] = np.nan
    order = list(Order(learnt.numbers, 8, 0, 0, 9, (0, 1)))
    step = next(k for k, batch in enumerate(order) if frame in learnt.samples.first[[number for _, number in batch]])
    with pytest.raises(MitsonarError) as caught:
        train(TrainOptions(message, url, tmp_path / "run", threads=1, state_minutes=0))
    output = str(caught.value)
    for part in (
        "the loss became nan in epoch 1",
        f"step {step + 1} of 9 (step {step + 1} overall)",
        "at learning rate 0.001",
        f" {frame}",
        "lower optimiser.rate",
    ):
        assert part in output
    assert str(frame) in output.split("frames ")[1].split(":")[0].split(", ")
    state = torch.load(tmp_path / "run" / "last.ckpt", weights_only=True)
    assert state["global_step"] == step
    assert all(torch.isfinite(values).all() for values in state["state_dict"].values())


def test_weights_that_are_not_finite_after_the_last_step_are_named(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss was finite before it, so no step is at fault, and there is no network to keep."""
    step = torch.optim.Adam.step

    def spoilt(self: Any, closure: Any = None) -> Any:
        loss = step(self, closure)
        torch.nn.init.constant_(self.param_groups[0]["params"][0], np.nan)
        return loss

    monkeypatch.setattr(torch.optim.Adam, "step", spoilt)
    with pytest.raises(MitsonarError, match=r"kept no network: its weights were not finite .* lower optimiser\.rate"):
        train(TrainOptions(recipe(steps=1), made, tmp_path / "run", threads=1))


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"network": "posnet"}, "unknown network 'posnet': did you mean posenet"),
        ({"network": {"name": "posenet", "widht": 1}}, "unknown option 'widht' of posenet"),
        ({"network": {"name": "posenet", "outputs": 2}}, "does not return the 3 values of the labels"),
        ({"network": {"name": "posenet", "size": [100, 100]}}, "this network reads"),
        ({"network": "posenet_dual"}, "needs input coordinates both: got polar"),
        ({"loss": {"kind": "likelihood"}, "labels": "raw"}, "needs loss.kind mse"),
        ({"input": {"frames": 6}}, "no sample of 6 frames"),
        ({"input": {"views": ["port"]}}, "unknown view port"),
        ({"input": {"kind": "vector", "layout": "stack"}}, "vectors have no cartesian form"),
        ({"split": {"train": 0.0, "validation": 1.0}}, "no train part"),
        ({"split": {"train": 1.0, "validation": 0.0}}, "no validation part"),
        ({"part_of_data": 0.02}, "fewer than a batch"),
        ({"batch": 1000}, "fewer than a batch of 1000"),
    ],
)
def test_what_does_not_go_together_is_refused_before_training(
    made: Path, tmp_path: Path, fields: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(MitsonarError, match=sentence):
        train(TrainOptions(recipe(**fields), made, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_words_that_do_not_go_together_are_refused(made: Path, tmp_path: Path) -> None:
    for words, sentence in (
        ({"minutes": 0}, "minutes must be above 0"),
        ({"scale": 2.0}, r"--scale must lie in 0\.\.1"),
        ({"pairs": 3}, "--pairs must be at least the batch size"),
        ({"devices": 3, "accelerator": "cpu", "strategy": "ddp"}, "a batch of 8 cannot be shared by 3 devices"),
        ({"accelerator": "abacus"}, "do not work here"),
        ({"accelerator": "cpu", "precision": "bf16-mixed"}, "precision bf16-mixed needs a GPU"),
        ({"resume": True, "overwrite": True}, "contradict each other"),
        ({"threads": 0}, "--threads must be at least 1"),
    ):
        with pytest.raises(MitsonarError, match=sentence):
            train(TrainOptions(recipe(), made, tmp_path / "run", **words))
    with pytest.raises(MitsonarError, match=r"--data DATA\.zarr, or --render"):
        train(TrainOptions(recipe(), None, tmp_path / "run"))
    with pytest.raises(MitsonarError, match="no data set at"):
        train(TrainOptions(recipe(), tmp_path / "none.zarr", tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_vectors_without_images_are_told_from_images(tmp_path: Path) -> None:
    make_dataset(tiny_recipe(store="vectors", scenes=[{"sequences": 20}]), str(tmp_path / "sums.zarr"))
    with pytest.raises(MitsonarError, match="holds vectors only"):
        train(TrainOptions(recipe(), tmp_path / "sums.zarr", tmp_path / "run"))
    heights = recipe(input={"kind": "vector", "frames": 1}, steps=2)
    assert train(TrainOptions(heights, tmp_path / "sums.zarr", tmp_path / "run", threads=1)).labels["names"] == [
        "height (m)"
    ]
    header = (tmp_path / "run" / "log.csv").read_text().splitlines()[0]
    assert "none height (mm)" in header


# ---------------------------------------------------------------- command line


def run_command(*words: object) -> Any:
    """The command, in this process."""
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(command)
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.thorough
def test_the_command_line_trains_stops_in_time_and_goes_on(made: Path, tmp_path: Path) -> None:
    """Its own sentences, and nothing of Lightning's."""
    message, out = tmp_path / "mine.yaml", tmp_path / "run"
    message.write_text(yaml.safe_dump({**FIELDS, "steps": 100_000, "split": {"train": 0.8, "validation": 0.2}}))
    options = ["--data", made, "-o", out, "--threads", 1, "--set", "optimiser.rate=2e-3", "--scale", 0.9]
    done = run_command(message, *options, "--minutes", 0.02)
    assert done.exit_code == 0, done.output
    assert "RMSE, noise none" in done.stdout
    assert f"network: {out / 'network.ckpt'}" in done.stdout
    assert all(line.startswith("epoch ") for line in done.stderr.splitlines()), done.stderr
    assert "; validation, noise none " in done.stderr
    state = torch.load(out / "last.ckpt", weights_only=True)["global_step"]
    assert 6 <= state < 2000
    stored = load_training_recipe(out / "recipe.yaml")
    assert (stored.optimiser.rate, stored.part_of_data) == (2e-3, 0.9)
    spent = json.loads((out / "run.json").read_text())["minutes"]
    again = run_command(message, *options, "--minutes", spent + 0.01, "--resume")
    assert again.exit_code == 0, again.output
    assert torch.load(out / "last.ckpt", weights_only=True)["global_step"] > state
    refused = run_command(message, *options)
    assert refused.exit_code == 2
    assert refused.stderr.startswith("error: ")
    assert "--resume" in refused.stderr


@pytest.mark.thorough
def test_rows_of_the_log_between_validations_tell_the_errors_in_training(
    made: Path, tmp_path: Path, bare_curves: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a row for each line that is printed; the picture and TensorBoard show them, too."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monkeypatch.setattr("mitsonar.training.journal.curve_figure", bare_curves)
    monkeypatch.setattr("mitsonar.training.journal.LOG_SECONDS", 0.0)
    message, out = tmp_path / "mine.yaml", tmp_path / "run"
    validate = {"every_steps": 4, "pairs": 4, "noise": ["none"]}
    message.write_text(yaml.safe_dump({**FIELDS, "steps": 6, "validate": validate}))
    done = run_command(message, "--data", made, "-o", out, "--threads", 1)
    assert done.exit_code == 0, done.output
    rows = list(csv.DictReader((out / "log.csv").open()))
    assert [int(row["step"]) for row in rows] == [1, 2, 3, 4, 5, 6]
    assert [row["none sideways (mm)"] != "" for row in rows] == [False, False, False, True, False, True]
    lines = [line for line in done.stderr.splitlines() if line.startswith("epoch ")]
    for line, row in zip(lines, rows, strict=True):
        assert f"training RMSE {float(row['training sideways (mm)']):.3g}/" in line
        assert ("; validation, noise none " in line) == (row["none sideways (mm)"] != "")
    assert (out / "curve.png").stat().st_size > 10_000
    events = EventAccumulator(str(out / "tensorboard")).Reload()
    loss, validated = (events.Scalars(name) for name in ("loss", "none sideways (mm)"))
    assert [one.step for one in loss] == [1, 2, 3, 4, 5, 6]
    assert [one.value for one in validated] == pytest.approx(
        [float(rows[k]["none sideways (mm)"]) for k in (3, 5)], rel=1e-4
    )


@pytest.mark.posix
@pytest.mark.thorough
def test_ctrl_c_keeps_the_state_of_a_whole_step(made: Path, whole: Path, tmp_path: Path) -> None:
    """And the run goes on to the same bits."""
    message, out = tmp_path / "mine.yaml", tmp_path / "run"
    message.write_text(yaml.safe_dump(FIELDS))

    def interrupt(report: TrainingReport) -> None:
        if report.step == 9:
            os.kill(os.getpid(), signal.SIGINT)

    from mitsonar.cli.train import stop_on_signals

    with stop_on_signals() as stop, pytest.raises(KeyboardInterrupt):
        train(TrainOptions(message, made, out, threads=1), progress=interrupt, stop=stop)
    assert torch.load(out / "last.ckpt", weights_only=True)["global_step"] in (9, 10)
    train(TrainOptions(message, made, out, resume=True, threads=1))
    assert_same(weights(out), weights(whole))


@pytest.mark.posix
@pytest.mark.thorough
@pytest.mark.e2e
def test_a_signal_to_all_processes_of_a_training_stops_it_after_its_step(made: Path, tmp_path: Path) -> None:
    """As a cluster sends it: the process that reads samples does not end before the one that trains."""
    message, out = tmp_path / "mine.yaml", tmp_path / "run"
    message.write_text(yaml.safe_dump({**FIELDS, "steps": 100_000, "validate": {"every_steps": 3, "pairs": 4}}))
    words = ("train", message, "--data", made, "-o", out, "--threads", 1, "--workers", 1)
    call = [sys.executable, "-m", "mitsonar", *map(str, words)]
    with subprocess.Popen(call, stderr=subprocess.PIPE, text=True, start_new_session=True) as running:
        assert running.stderr is not None
        assert running.stderr.readline().startswith("epoch ")
        os.killpg(running.pid, signal.SIGTERM)
        output = running.stderr.read()
    assert running.returncode == 143, output
    assert "Traceback" not in output
    steps = torch.load(out / "last.ckpt", weights_only=True)["global_step"]
    assert steps == int(list(csv.DictReader((out / "log.csv").open()))[-1]["step"])


@pytest.mark.slow
@pytest.mark.e2e
def test_two_devices_share_a_training(made: Path, tmp_path: Path) -> None:
    """Two processes on this CPU; a batch is one batch, however many share it."""
    message = tmp_path / "mine.yaml"
    message.write_text(yaml.safe_dump(FIELDS))
    script = tmp_path / "two.py"
    script.write_text(
        textwrap.dedent("""
        import sys
        from mitsonar.config.training import TrainOptions
        from mitsonar.training.run import train
        if __name__ == "__main__":
            train(TrainOptions(*sys.argv[1:], accelerator="cpu", devices=2, strategy="ddp", threads=1))
        """)
    )
    call = [sys.executable, str(script), str(message), str(made), str(tmp_path / "run")]
    done = subprocess.run(call, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert Checkpoint.load(tmp_path / "run").trained["pairs"] % 8 == 0
    assert torch.load(tmp_path / "run" / "last.ckpt", weights_only=True)["global_step"] == 20


def test_a_training_begins_with_the_weights_that_it_is_told(made: Path, whole: Path, tmp_path: Path) -> None:
    """One step at no rate to speak of leaves them; those of another network are refused."""
    stored = Checkpoint.load(whole).build().state_dict()
    message = {"start": str(whole), "seed": 5, "steps": 1, "optimiser": {"rate": 1e-12}}
    again = train(TrainOptions(recipe(**message), made, tmp_path / "again", threads=1, workers=0)).build().state_dict()
    second = (
        train(TrainOptions(recipe(**{**message, "start": None}), made, tmp_path / "other", threads=1, workers=0))
        .build()
        .state_dict()
    )
    learnt = [name for name in stored if "running" not in name and "num_batches" not in name]
    assert all(torch.allclose(again[name], stored[name], atol=1e-9) for name in learnt)
    assert not all(torch.allclose(second[name], stored[name], atol=1e-3) for name in learnt)
    with pytest.raises(MitsonarError, match="start contains the weights of posenet"):
        train(TrainOptions(recipe(**message, network={"name": "sfmnet", "width": 1 / 16}), made, tmp_path / "no"))
