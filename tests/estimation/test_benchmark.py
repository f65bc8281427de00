"""Estimators side by side: the same pairs for all, wrong geometry told as announced, broken runs that go on."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Command, refused, tiny_recipe

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.datasets.make import make_dataset
from mitsonar.errors import MitsonarError
from mitsonar.motion.errors import cluster_resamples, in_units

torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
pytestmark = [
    pytest.mark.learn,
    pytest.mark.usefixtures("variant"),
    pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning"),
]

from mitsonar.datasets.rendered import rerender  # noqa: E402
from mitsonar.datasets.samples import SonarPairs  # noqa: E402
from mitsonar.estimation.compare import (  # noqa: E402  # noqa: E402
    VARIATIONS,
    Answers,
    ComparisonOptions,
    _heaved,
    _methods,
    answers_of,
    bounds_of_pairs,
    compare,
    frames_of,
    rows_of,
    with_prior,
)
from mitsonar.estimation.estimator import Estimate  # noqa: E402
from mitsonar.estimation.image.direct import Direct  # noqa: E402
from mitsonar.estimation.image.phase import Ecc  # noqa: E402
from mitsonar.estimation.named import (  # noqa: E402
    Zero,
    create_estimator,
)
from mitsonar.motion.composition import (  # noqa: E402
    Motion,
    MotionPrior,
)
from mitsonar.records.frames import SonarFrames  # noqa: E402


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three small scenes of four pairs, fine enough to register."""
    url = tmp_path_factory.mktemp("made") / "small.zarr"
    words = {"sonar__beams": 48, "sonar__range_bins": 256, "sonar__rays_per_beam": 300, "world__a_side": [25, 25]}
    make_dataset(tiny_recipe(scenes=[{"count": 3, "sequences": 4}], flight={"pings": 2}, **words), str(url))
    return url


@pytest.fixture(scope="module")
def pairs(made: Path) -> SonarPairs:
    return SonarPairs(made, part="all", frames=2, one_per_sequence=True, noise="low")


class Oracle:
    """Knows the truth; every third estimate is not valid."""

    consumes = SonarFrames
    inputs = "the truth"
    digest = ""

    def __init__(self, pairs: SonarPairs) -> None:
        self.pairs, self.asked = pairs, 0
        self.truth = {float(pairs.pose[pairs.first[k], 0]): pairs.target(k) for k in range(len(pairs))}

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        self.asked += 1
        assert frames.poses is not None
        motion = Motion(*self.truth[float(frames.poses[0, 0])])
        return Estimate(motion, np.eye(3) * 1e-6, valid=self.asked % 3 != 0)


def test_all_methods_get_the_same_pairs_and_failures_count(pairs: SonarPairs) -> None:
    numbers = list(range(len(pairs)))
    oracle = Oracle(pairs)
    answers = answers_of({"oracle": oracle, "zero": Zero()}, pairs, numbers)
    truth = np.array([pairs.target(k) for k in numbers])
    assert np.allclose(answers["oracle"].motion, truth)
    assert (~answers["oracle"].valid).sum() == len(numbers) // 3
    table = cluster_resamples(pairs.scene[pairs.first[numbers]], count=100)
    rows = {row.method: row for row in rows_of(answers, {"oracle": "", "zero": ""}, truth, table, reference="zero")}
    failed = in_units(truth[~answers["oracle"].valid])
    assert np.allclose(rows["oracle"].errors.rmse, np.sqrt((failed**2).sum(axis=0) / len(numbers)))
    assert np.allclose(rows["zero"].errors.rmse, rows["zero"].errors.zero)
    assert (rows["oracle"].over_reference < 0).all()
    assert (rows["zero"].over_reference == 0).all()
    plain = rows["oracle"].plain()
    assert plain["over_limit"] == [None, None, None]
    assert (rows["oracle"].over_reference_low <= rows["oracle"].over_reference).all()
    assert (rows["oracle"].over_reference <= rows["oracle"].over_reference_high).all()
    json.dumps(plain, allow_nan=False)


def test_what_is_told_wrongly_is_what_the_row_says(pairs: SonarPairs) -> None:
    message = {number: frames for number, frames in frames_of(pairs, [0, 1], "as given")}
    changes: dict[str, Callable[[SonarFrames], np.float64]] = {
        "height 5 %": lambda f: np.asarray(f.height_m)[0],
        "pitch 1 deg": lambda f: np.degrees(np.asarray(f.poses)[0, 3]),
        "roll 1 deg": lambda f: np.degrees(np.asarray(f.poses)[0, 4]),
        "sound speed 1 %": lambda f: f.range_m[100],
    }
    for variation, change in changes.items():
        for number, frames in frames_of(pairs, [0, 1], variation):
            was, became = change(message[number]), change(frames)
            size = became / was - 1 if "%" in variation else became - was
            expected = (1 if number % 2 == 0 else -1) * (float(variation.split()[-2]) / (100 if "%" in variation else 1))
            assert size == pytest.approx(expected), variation
            assert (frames.image == message[number].image).all()
    assert {"heave 5 mm", "jitter", "as given"} < set(VARIATIONS)


def test_compare_in_python_is_the_table_of_the_command(
    made: Path, pairs: SonarPairs, mitsonar: Command, tmp_path: Path
) -> None:
    """Estimators of one's own, by an object and by name; rows, CSV and columns hold what the table holds."""
    oracle = Oracle(pairs)
    result = compare(
        made, {"oracle": oracle, "zero": "zero", "again": Zero}, ComparisonOptions(part="all", noise="none,low", limit=0)
    )
    rows = result.rows
    assert [(row["noise"], row["method"]) for row in rows] == [
        (noise, name) for noise in ("none", "low") for name in ("oracle", "zero", "again")
    ]
    assert rows[0]["rmse_sideways_mm"] < rows[1]["rmse_sideways_mm"] == rows[1]["zero_sideways_mm"]
    assert rows[0]["rmse_yaw_deg"] == result.report["tables"][0]["rows"][0]["rmse"][2]
    assert result.columns()["method"] == ["oracle", "zero", "again"] * 2
    text = result.to_csv(tmp_path / "table.csv")
    assert (tmp_path / "table.csv").read_text() == text
    assert [row["method"] for row in csv.DictReader(text.splitlines())] == result.columns()["method"]
    assert text.count("\n") == 7
    plain = compare(made, ["zero"], ComparisonOptions(part="all", limit=0, pairs=4))
    done = mitsonar("compare", made, "--estimators", "zero", "--part", "all", "--limit", "0", "--pairs", "4")
    assert done.returncode == 0, done.stderr
    of_command, of_python = (re.sub(r"\S+ +\| nothing", "MS", text).strip() for text in (done.stdout, str(plain)))
    assert of_command == of_python
    with pytest.raises(MitsonarError, match="two estimators are named Zero: give a dictionary"):
        compare(made, [Zero, Zero()], ComparisonOptions(part="all"))
    with pytest.raises(MitsonarError, match=r"^reference must be one of zero: got 'zeor'; did you mean zero\?"):
        compare(made, "zero", ComparisonOptions(part="all", reference="zeor"))
    with pytest.raises(MitsonarError, match=r"^estimators must name one or more: got none"):
        compare(made, ",", ComparisonOptions(part="all"))


def test_a_single_pair_is_refused_with_what_gives_more(made: Path, tmp_path: Path) -> None:
    """The four pings of one sequence are one pair; all of the data set is no way out."""
    one = {"scenes": [{"count": 1, "sequences": 1}], "flight": {"pings": 4}}
    make_dataset(tiny_recipe(**one), str(tmp_path / "one.zarr"))
    with pytest.raises(MitsonarError, match=r"one a sequence: got 1 in the part all; give a larger data set$"):
        compare(tmp_path / "one.zarr", "zero", ComparisonOptions(part="all"))
    with pytest.raises(MitsonarError, match=r"got 1 in the part validation; give part all, or a larger data set$"):
        compare(made, "zero", ComparisonOptions())


def test_a_folder_holds_the_estimates_of_its_estimators_only(made: Path, tmp_path: Path) -> None:
    """Another estimator under the same name must not get the estimates of the first."""
    options = ComparisonOptions(part="all", limit=0, pairs=2)
    compare(made, {"mine": Zero()}, options, out=tmp_path / "out")
    with pytest.raises(MitsonarError, match="class Zero, not Ecc"):
        compare(made, {"mine": Ecc()}, options, out=tmp_path / "out")
    compare(made, {"mine": Direct(height_m=2.0)}, options, out=tmp_path / "other")
    with pytest.raises(MitsonarError, match=r"begun with estimators\.mine\.height_m 2\.0, not 3\.0"):
        compare(made, {"mine": Direct(height_m=3.0)}, options, out=tmp_path / "other")


def test_a_network_gets_the_input_of_its_training(pairs: SonarPairs) -> None:
    """With its samples: their layout and labels."""

    class Sums(torch.nn.Module):  # type: ignore[misc, name-defined]
        def forward(self, images: Any) -> Any:
            self.seen = images
            return torch.tensor([[10.0, -10.0, 0.0]])

    local = SonarPairs(pairs.store.place.url, part="all", labels="normx10", noise="high")
    estimator: Any = create_estimator(Sums(), samples=local)
    result = estimator.estimate(pairs.sonar_frames(3))
    assert result.motion == pytest.approx([local.labels.high[0], local.labels.low[1], 0.0])
    expected = torch.cat([*torch.from_numpy(pairs.sonar_frames(3).image)], dim=1)
    assert torch.equal(estimator._wrapped._network.seen[0, 0], expected)
    assert list(_methods([estimator])) == ["Sums"], "the row of a table is named after the network, not after what wraps it"


@pytest.mark.thorough
def test_rendered_again_unchanged_is_what_is_stored(pairs: SonarPairs) -> None:
    """World, gain, jitter, noise: bit for bit."""
    numbers = [1, 5, 9]
    seen = dict(rerender(pairs, numbers))
    assert sorted(seen) == numbers
    for number, frames in seen.items():
        assert (frames.image == pairs.sonar_frames(number).image).all()
    rest = np.zeros((2, 6))
    assert [_heaved(k, rest)[1, 2] for k in (0, 1)] == pytest.approx([0.005, -0.005])
    heaved = dict(frames_of(pairs, numbers, "heave 5 mm"))
    moved = [(heaved[k].image[0] != seen[k].image[0]).mean() for k in numbers]
    assert max(moved) == 0, "the first ping stays"
    assert all((heaved[k].image[1] != seen[k].image[1]).mean() > 0.05 for k in numbers)
    assert all(np.array_equal(np.asarray(heaved[k].poses), np.asarray(seen[k].poses)) for k in numbers), "what is told stays"
    jittered = dict(frames_of(pairs, numbers, "jitter"))
    assert all((jittered[k].image[0] != seen[k].image[0]).mean() > 0.05 for k in numbers)


def test_a_prior_shrinks_what_is_unsure_and_leaves_what_is_sure() -> None:
    answers = Answers.unasked(2)
    answers.motion[:] = 0.01
    answers.covariance[0], answers.covariance[1] = np.eye(3) * 1e-12, np.eye(3) * 1.0
    result = with_prior(answers, np.full(3, 0.02)).motion
    assert np.allclose(result[0], 0.01, rtol=1e-6)
    assert (np.abs(result[1]) < 1e-5).all()


@pytest.mark.thorough
def test_limits_are_below_what_is_reached(pairs: SonarPairs) -> None:
    """The bound by the rays' own noise at high noise is positive, and below direct's errors."""
    loud = SonarPairs(pairs.store.place.url, part="all", frames=2, one_per_sequence=True, noise="high")
    result = bounds_of_pairs(loud, [6], NOISE_MODELS["high"])
    assert (result["pixel"] > 0).all()
    assert (result["pixel"] < result["gaussian"]).all()
    assert (result["gaussian"] < result["rays"]).all()
    numbers = list(range(len(loud)))
    answers = answers_of({"direct": Direct()}, loud, numbers)["direct"]
    errors = answers.motion - np.array([loud.target(k) for k in numbers])
    assert (np.sqrt((errors**2).mean(axis=0)) > result["pixel"]).all()


@pytest.mark.thorough
def test_command_prints_a_table_and_goes_on(mitsonar: Command, made: Path, tmp_path: Path) -> None:
    words = ("compare", made, "--part", "all", "--noise", "none,high", "--limit", 0, "--estimators", "zero,ecc,direct")
    done = mitsonar(*words, "-o", tmp_path / "out", "--prior")
    assert done.returncode == 0, done.stderr
    assert "noise none, as given" in done.stdout
    assert "| zero " in done.stdout
    assert "direct with prior" in done.stdout
    assert "ecc less direct" in done.stdout
    table = json.loads((tmp_path / "out" / "table.json").read_text())
    by_name = {row["method"]: row for row in table["tables"][0]["rows"]}
    assert by_name["direct"]["rmse"][0] < 0.4 * by_name["zero"]["rmse"][0]
    # broken off: half of the answers have gone
    (path,) = (tmp_path / "out").glob("answers-high-*-as-given.npz")
    with np.load(path) as stored:
        arrays = {name: stored[name].copy() for name in stored.files}
    arrays["direct/ms"][6:] = np.nan
    arrays["direct/motion"][6:] = 99
    np.savez(path, **arrays)
    again = mitsonar(*words, "-o", tmp_path / "out", "--prior", "--json")
    assert again.returncode == 0, again.stderr
    report = json.loads(again.stdout)
    for before, after in zip(table["tables"], report["tables"], strict=True):
        assert [row["rmse"] for row in before["rows"]] == [row["rmse"] for row in after["rows"]]
    refused(mitsonar(*words, "--pairs", 5, "-o", tmp_path / "out"), "was begun with pairs", "not 5", "choose another -o")


def test_mistakes_are_said(mitsonar: Command, made: Path, tmp_path: Path) -> None:
    refused(mitsonar("compare", made, "--estimators", "dierct"), "unknown estimator", "did you mean direct")
    refused(mitsonar("compare", made, "--part", "all", "--reference", "ecc", "--estimators", "zero"), "--reference")
    refused(mitsonar("compare", made, "--part", "all", "--noise", "loud"), "noise must be")
    refused(mitsonar("compare", tmp_path / "none.zarr"), "none.zarr")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thing").write_text("mine")
    refused(mitsonar("compare", made, "--part", "all", "-o", tmp_path / "full"), "contains other files")


def test_damaged_answers_are_said(mitsonar: Command, made: Path, tmp_path: Path) -> None:
    words = ("compare", made, "--part", "all", "--limit", 0, "--estimators", "zero", "--pairs", 4, "-o", tmp_path / "out")
    assert mitsonar(*words).returncode == 0
    (path,) = (tmp_path / "out").glob("answers-*.npz")
    path.write_bytes(path.read_bytes()[:200])
    refused(mitsonar(*words), "is damaged", "remove it")


@pytest.mark.thorough
def test_an_axis_that_never_moves_and_a_turned_mount(mitsonar: Command, tmp_path: Path) -> None:
    """The truth is the sonar's motion, not the vehicle's; tables have no number for an axis without motion."""
    words = {"sonar__beams": 48, "sonar__range_bins": 256, "sonar__rays_per_beam": 200, "world__a_side": [25, 25]}
    mount = {"mount__heading_deg": 90.0, "mount__forward_m": 0.3}
    flight = {"pings": 2, "yaw_deg": 0}
    make_dataset(
        tiny_recipe(scenes=[{"count": 2, "sequences": 3}], flight=flight, **words, **mount), str(tmp_path / "m.zarr")
    )
    command = ("compare", tmp_path / "m.zarr", "--part", "all", "--limit", 0, "--estimators", "zero,direct")
    done = mitsonar(*command, "--json")
    assert done.returncode == 0, done.stderr
    assert "2 scenes only" in done.stderr
    (table,) = json.loads(done.stdout)["tables"]
    direct = table["rows"][1]
    assert direct["slope"][2] is None
    assert direct["slope"][1] > 0.8
    assert direct["rmse"][1] < 2.0
