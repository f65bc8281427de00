"""Tables of Almanza-Medina: every row has a recipe, printed numbers are beside ours, and a stopped run resumes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Command, refused
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mitsonar.config.data import Recipe, load_recipe
from mitsonar.datasets.store import DataStore
from mitsonar.errors import MitsonarError
from mitsonar.io.runs import RunDirectory
from mitsonar.motion.errors import in_units
from mitsonar.reproduction import tables
from mitsonar.reproduction.tables import (
    HIGHEST_NOISE,
    NOISES,
    Found,
    Reached,
    RowScore,
    contents,
    load_scripted,
    load_tables,
    rows_named,
    table_figure,
    table_lines,
    table_named,
    tables_with,
)

torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
pytest.importorskip("lightning", reason="Lightning is not installed: install mitsonar[learn]")
pytestmark = [
    pytest.mark.learn,
    pytest.mark.usefixtures("bare_curves"),
    pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning"),
]

from mitsonar.config.training import TrainingRecipe, load_training_recipe, shipped_training_recipes  # noqa: E402
from mitsonar.datasets.samples import Samples  # noqa: E402
from mitsonar.networks.checkpoint import Checkpoint  # noqa: E402
from mitsonar.networks.create import create_network, options_for  # noqa: E402
from mitsonar.reproduction.tables import Effort, TableBuilder, reproduce, unseen_recipe  # noqa: E402

TABLES = load_tables()
RECIPES = sorted({row.recipe for name, table in TABLES.items() if name[0] == "3" for row in table.rows})

# ---------------------------------------------------------------- the recipes


def test_every_row_has_a_recipe_and_every_network_of_the_document_its_rows() -> None:
    assert list(TABLES) == [
        "3.1",
        "3.2",
        "3.3",
        "3.4",
        "3.5",
        "3.6",
        "3.7",
        "3.10",
        "3.11",
        "4.12",
        "4.14",
        "4.15",
        "4.5",
        "5.2",
    ]
    assert [len(table.rows) for table in TABLES.values()] == [5, 6, 4, 2, 3, 2, 3, 3, 8, 12, 10, 11, 6, 17]
    assert set(RECIPES) <= set(shipped_training_recipes())
    assert len(RECIPES) == 28
    named = {load_training_recipe(name).network["name"] for name in RECIPES}
    assert named == {"sfmnet", "posenet", "cnn1b", "cnn4b", "cnn4posenet", "posenet_dual"}
    assert tables_with("posenet-normx10") == ["3.2", "3.3", "3.4", "3.6", "3.7"]
    for table in TABLES.values():  # the same network has the same numbers wherever it is printed
        for row in table.rows:
            others = [(TABLES[name], rows_named(TABLES[name], [row.name])[0]) for name in tables_with(row.name)]
            keys = {(str(table.set), str(second.set), table.unseen, str(table.noises)) for table, second in others}
            assert all(second.printed == row.printed for _, second in others)
            assert len(keys) == 1, row.name  # trained once and judged once for all of them
            load_training_recipe(row.recipe, {**table.set, **row.set})


def test_contents_hold_every_table_and_figure_of_results() -> None:
    """Chapters 2 to 5 of the document; its other tables and figures hold parameters and drawings."""
    names = [table.name for table in contents()]
    assert len(names) == len(set(names))
    chapters = [
        ["2.1", "figure-2.7"],
        ["3.1", "3.2", "3.3", "3.4", "3.5", "3.6", "3.7", "figure-3.7", "3.8", "figure-3.8", "3.9", "3.10", "3.11"],
        ["4.5", "4.12", "4.14", "4.15", "figure-4.16", "figure-4.17"],
        ["5.2", "5.3", "5.5", "5.6", "figure-5.10", "figure-5.11"],
    ]
    assert names == [name for chapter in chapters for name in chapter]
    scripted = load_scripted()
    assert scripted["3.8"].printed["Non-DL"] == "8.39 / 1.29 / 0.175, high noise 8.16 / 1.31 / 0.178"
    assert scripted["5.5"].printed["Ensemble (Bagged trees)"] == "17.77 mm"
    root = Path(__file__).parents[2]
    for table in scripted.values():
        script = root / table.command.split()[1]
        words = [word for word in table.command.split()[2:] if word.startswith("--")]
        text = script.read_text(encoding="utf-8")
        assert all(f'"{word}"' in text for word in words), table.name
        page, heading = table.results.split("#")
        heads = re.findall(r"^#+ (.*)", (root / page).read_text(encoding="utf-8"), re.MULTILINE)
        anchors = {re.sub(r"[^a-z0-9 -]", "", head.lower()).replace(" ", "-") for head in heads}
        assert heading in anchors, table.results
        with pytest.raises(MitsonarError, match="is made by a script of mitsonar's sources: run there  python benchmarks/"):
            table_named(table.name)


def test_an_effort_changes_data_beside_what_a_recipe_changes() -> None:
    row = load_training_recipe("portion-quadrants-vector")
    changed = Effort(data={"sonar.range_bins": 128}).recipe("portion-quadrants-vector")
    assert changed.data_changes == {**row.data_changes, "sonar.range_bins": 128}
    assert load_recipe(changed.data, changed.data_changes).store == "vectors"
    assert "data changed: sonar.range_bins 128" in Effort(data={"sonar.range_bins": 128}).sentence()


def test_the_numbers_are_those_of_the_reference() -> None:
    """The numbers are typed from the document, not from the tables."""
    expected = {
        ("3.1", "sfmnet-quantised"): "4.86 / 2.36 / .084 | 5.43 / 3.05 / .098",
        ("3.1", "posenet-quantised"): "2.81 / 1.44 / .049 | 11.32 / 6.42 / .199",
        ("3.1", "cnn1b-quantised"): "7.63 / 4.63 / .172 | 13.67 / 10.60 / .266",
        ("3.1", "cnn4b-quantised"): "4.22 / 2.27 / .089 | 12.41 / 13.26 / .291",
        ("3.1", "cnn4posenet-quantised"): "3.18 / 1.15 / .050 | 4.87 / 2.63 / .083",
        ("3.2", "posenet-normx10"): "2.84 / 1.00 / .052 | 6.54 / 3.39 / .170",
        ("3.3", "posenet-normx10-low-noise"): "2.94 / 1.26 / .056 | 3.63 / 1.50 / .070",
        ("3.4", "posenet-three-images"): "2.70 / 0.87 / .046 | 4.96 / 1.38 / .227",
        ("3.7", "posenet-polar-cartesian"): "2.60 / 1.07 / .047 | 4.99 / 2.27 / .086",
        ("3.10", "posenet-hull-high-noise"): "3.20 / 1.75 / .052 | 3.22 / 1.77 / .052",
        ("3.11", "posenet-two-sensors"): "1.42 / 2.17 / .044 | 6.13 / 7.47 / .156",
        ("3.11", "posenet-two-sensors-low-noise"): "2.33 / 3.05 / .070 | 3.34 / 4.37 / .089",
        ("4.12", "portion-quadrants-vector"): "2.2 / 2.2 / .045",
        ("4.15", "levels-128"): "1.0 / 1.0 / .025",
        ("4.5", "height-rocky-image"): "119.1",
        ("4.5", "height-hull-vector"): "12.0",
        ("4.5", "height-hull-image-high-noise"): "7.8",
        ("5.2", "impulse-standard"): "5.1 / 4.2",
        ("5.2", "impulse-wideband-19200"): "1.9 / 2.4",
        ("5.2", "impulse-ten-320khz"): "1.53 / 1.27",
    }
    for (table, recipe), text in expected.items():
        (row,) = rows_named(TABLES[table], [recipe])
        halves = [tuple(float(word) for word in half.split("/")) for half in text.split("|")]
        assert list(row.printed.values()) == halves, (table, recipe)
    uniform = np.random.default_rng(1).uniform(-1, 1, (10**6, 3)) * [0.02, 0.02, np.radians(0.45)]
    np.testing.assert_allclose(np.sqrt((in_units(uniform) ** 2).mean(axis=0)), TABLES["3.1"].no_motion, rtol=3e-3)


def test_recipes_say_what_the_text_says() -> None:
    for name in RECIPES:
        recipe = load_training_recipe(name)
        message = (recipe.batch, recipe.optimiser.kind, recipe.optimiser.rate, recipe.optimiser.halve_every, recipe.epochs)
        assert message == (4, "adam", 1e-4, 12, 32), name
        assert recipe.split == "sequence"  # tables deal pairs out as Almanza-Medina does, who trains for oneself does not
        assert set(NOISES) - {HIGHEST_NOISE} <= set(recipe.validation.noise)
        assert recipe.noise == ("low" if "low-noise" in name else "high" if "high-noise" in name else "none")
        assert recipe.labels == ("quantised" if "quantised" in name else "normx10")
        assert (recipe.loss.kind, recipe.loss.penalty) == ("mse", 100 if name == "posenet-penalty" else 0)
        assert recipe.about.startswith("Almanza-Medina table")
    assert all(table.set["split"] == "sample" for table in TABLES.values() if table.name.startswith("3."))
    pairs = {}
    for name in RECIPES:
        recipe = load_training_recipe(name)
        data = load_recipe(recipe.data, recipe.data_changes)
        assert (data.instrument.model, data.split.by, data.split.train) == ("thesis", "sequence", 0.95)
        pairs[name] = data.sequences * (data.flight.pings + 1 - recipe.input.frames)
    assert pairs["posenet-normx10"] == 160_000
    assert pairs["posenet-three-images"] == 120_000
    assert pairs["posenet-ten-scenes"] == pairs["posenet-wide-side"] == 40_000
    assert abs(pairs["posenet-hull"] - 80_000) < 50
    assert abs(pairs["posenet-sensor-1"] - 20_000) < 50


SIZES = {
    "posenet-three-images": (512, 288),
    "posenet-wide-side": (512, 1024),
    "posenet-wide-stack": (1024, 512),
    "posenet-two-sensors": (512, 384),
    "posenet-two-sensors-low-noise": (512, 384),
}
"""Rows and columns of inputs that are not 512 x 192."""


@pytest.mark.parametrize("name", RECIPES)
def test_network_of_a_recipe_reads_what_its_data_set_gives(name: str) -> None:
    recipe = load_training_recipe(name)
    samples = Samples(load_recipe(recipe.data, recipe.data_changes), **recipe.arrangement())
    views = {view.name: view for view in samples.recipe.views}
    raw = {"frames": torch.arange(samples.frames)[None], "label": torch.zeros(1, 3)}
    for chosen in samples.arrange.views:
        sonar = views[chosen].sonar
        raw[chosen] = torch.full((1, samples.frames, sonar.range_bins, sonar.beams), 100, dtype=torch.uint8)
    inputs, labels = samples.finished(raw)
    parts = inputs if isinstance(inputs, tuple) else (inputs,)
    if recipe.input.coordinates != "cartesian":
        assert parts[0].shape == (1, 1, *SIZES.get(name, (512, 192)))
    if recipe.input.coordinates != "polar":
        assert parts[-1].shape[:3] == (1, 1, 512)
    network = create_network(recipe.network["name"], **options_for(recipe.network["name"], inputs, labels), width=1 / 16)
    assert network.eval()(*parts).shape == labels.shape


# ---------------------------------------------------------------- tables


def score(value: float) -> RowScore:
    errors = (value, value / 2, value / 50)
    bounds = {"low": tuple(0.8 * e for e in errors), "high": tuple(1.3 * e for e in errors)}
    return RowScore(pairs=40, scenes=30, rmse=errors, slope=(0.9, 1.0, None), zero=(11.0, 12.0, 0.25), **bounds)


REACHED = Reached(
    training_pairs=3040,
    pairs_seen=18_000,
    pairs_best=16_000,
    epochs=18_000 / 3040,
    epochs_asked=32,
    minutes=30.02,
    device="CPU",
    machine="a processor, 2 cores",
    threads=2,
    batch=16,
    rate=2e-4,
    precision="32-true",
    split="sequence",
    date="2026-11-21",
)


@pytest.mark.thorough
def test_a_table_shows_all_rows_and_the_scale_of_each() -> None:
    table = table_named("3.7")
    halves = {"none": score(5.0), "high": score(7.0)}
    fresh = {"none": score(6.0), "high": score(8.0)}
    result = {"posenet-cartesian": Found(recipe="posenet-cartesian", validation=halves, unseen=fresh, reached=REACHED)}
    text = "\n".join(table_lines(table, result))
    (line,) = [line for line in text.splitlines() if line.startswith("| Cartesian") and "posenet" not in line]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells == [
        *("Cartesian", "3.36 / 1.08 / 0.051", "5.00 / 2.50 / 0.100", "6.00 / 3.00 / 0.120"),
        *("9.75 / 3.33 / 0.111", "7.00 / 3.50 / 0.140", "8.00 / 4.00 / 0.160"),
    ]
    second = {"none": score(5.5), "high": score(7.5)}  # of sequences that training has not seen
    three = result | {"posenet-cartesian": result["posenet-cartesian"].model_copy(update={"test": second})}
    wide = table_lines(table, three)
    (line,) = [line for line in wide if line.startswith("| Cartesian") and "posenet" not in line]
    assert [cell.strip() for cell in line.strip("|").split("|")][2:5] == [
        *("5.00 / 2.50 / 0.100", "5.50 / 2.75 / 0.110", "6.00 / 3.00 / 0.120"),
    ]
    loud = {"none": score(5.0), "high": score(7.0), HIGHEST_NOISE: score(5.2)}  # echoes of five times the gain
    gained = {"posenet-cartesian": result["posenet-cartesian"].model_copy(update={"validation": loud})}
    (line,) = [line for line in table_lines(table, gained) if line.startswith("| Cartesian") and "posenet" not in line]
    assert [cell.strip() for cell in line.strip("|").split("|")][7:] == ["5.20 / 2.60 / 0.104", "-"]
    assert len(table_figure(table, gained).axes) == 9
    assert len(table_figure(table, three).axes[0].patches) == len(table_figure(table, result).axes[0].patches) + 1
    (line,) = [line for line in text.splitlines() if line.startswith("| *always answering no motion*")]
    assert line.count("11.55 / 11.55 / 0.260") == 2
    assert line.count("11.00 / 12.00 / 0.250") == 4
    assert len([line for line in text.splitlines() if "2.60 / 1.07 / 0.047" in line and "not trained yet" in line]) == 1
    (line,) = [line for line in text.splitlines() if "posenet-cartesian" in line]
    message = ("3,040", "18,000 (16,000)", "5.92 of 32", "30.0", "16, 0.0002, 32-true", "40, 40 (30)", "2026-11-21")
    for word in (*message, "threads: 2", "a processor"):
        assert f" {word}" in line, word
    (line,) = [line for line in text.splitlines() if "posenet-normx10" in line]
    assert "3.2, 3.3, 3.4, 3.6" in line  # one training for five tables
    figure = table_figure(table, result)
    assert isinstance(figure, Figure)
    bars = [bar.get_width() for bar in figure.axes[0].patches if isinstance(bar, Rectangle)]
    assert sorted(bars) == pytest.approx(sorted([2.84, 3.36, 2.60, 5.0, 6.0]))
    assert "3,040 pairs x 5.9" in figure.axes[0].get_yticklabels()[1].get_text()
    table_figure(table, {})


def test_a_table_of_heights_says_them_in_cm_and_of_their_interval() -> None:
    def errors(value: float) -> RowScore:
        ends = {"low": (value,), "high": (value,), "zero": (2600.0,)}
        return RowScore(pairs=63, scenes=17, rmse=(value,), slope=(1.0,), ms=3.21, **ends)

    halves = {"none": errors(90.0), "high": errors(180.0)}
    name = "height-rocky-vector"
    result = {name: Found(recipe=name, validation=halves, unseen=halves, reached=REACHED)}
    lines = table_lines(table_named("4.5"), result)
    (line,) = [line for line in lines if line.startswith("| rocky field, vectors") and "height" not in line]
    assert [cell.strip() for cell in line.strip("|").split("|")] == [
        *("rocky field, vectors", "12.17 cm (1.35 %)", "9.00 cm (1.00 %)", "9.00 cm (1.00 %)"),
        *("-", "18.00 cm (2.00 %)", "18.00 cm (2.00 %)"),
    ]
    assert not any("always answering no motion" in line for line in lines[:8])
    figure = table_figure(table_named("4.5"), result)  # percent, since one interval is 26 times the other
    widths = [bar.get_width() for bar in figure.axes[0].patches if isinstance(bar, Rectangle)]
    np.testing.assert_allclose(sorted(w for w in widths if np.isfinite(w)), [1, 1, 119.1 / 90, 121.7 / 90, 24 / 7, 24 / 7])


def test_a_table_with_times_shows_them_beside_those_printed() -> None:
    timed = score(5.0).model_copy(update={"ms": 5.72})
    name = "portion-quadrants-vector"
    both = {"none": timed, "high": score(7.0)}
    lines = table_lines(table_named("4.12"), {name: Found(recipe=name, validation=both, unseen=both, reached=REACHED)})
    assert "Almanza-Medina, ms | here, ms" in " | ".join(cell.strip() for cell in lines[2].split("|"))
    (line,) = [line for line in lines if line.startswith("| four quadrants, vectors") and "portion" not in line]
    assert [cell.strip() for cell in line.split("|")][-3:-1] == ["27", "5.72"]
    (line,) = [line for line in lines if line.startswith("| whole view, images") and "portion" not in line]
    assert [cell.strip() for cell in line.split("|")][-3:-1] == ["160", "-"]


def test_unseen_scenes_of_a_table_that_says_how_many() -> None:
    data = load_recipe("looking-down", {"store": "vectors"})
    second, expected = unseen_recipe(data, 250, 1000, 2)
    assert (expected, second.sequences, second.flight.pings, second.seed) == (1000, 1000, 2, 7919)
    same, some = unseen_recipe(data, 250, None, 2)
    assert (some, same.sequences, same.flight.pings) == (100, 250, 5)


def test_rows_of_one_kind_learn_from_one_data_set() -> None:
    """Images of all portions from one trace, vectors from another; a key that a later version adds makes no third."""
    table = table_named("4.12")
    recipes = [load_training_recipe(row.recipe, {**table.set, **row.set}) for row in table.rows]
    data = [load_recipe(recipe.data, recipe.data_changes) for recipe in recipes]
    assert len({one.digest() for one in data}) == len({one.store for one in data}) == 2

    class Later(Recipe):
        added: int | None = None

    assert Later(**data[0].model_dump()).digest() == data[0].digest() != Later(**data[0].model_dump(), added=1).digest()


# ---------------------------------------------------------------- from nothing to a table

TINY: dict[str, Any] = {
    "network.width": 1 / 16,
    "data_changes": {
        "world.a_side": [4, 6],
        "scenes": [{"count": 2, "sequences": 8, "world": {"size_m": 20}}],
        "sonar.beams": 12,
        "sonar.rays_per_beam": 60,
        "sonar.range_bins": 40,
    },
    "steps": 12,
    "epochs": None,
    "validate": {"noise": ["none", "high"], "every_steps": 4},
}
ROWS = ["posenet-normx10", "posenet-penalty"]


def tiny(out: Path, rows: list[str] = ROWS, **effort: Any) -> dict[str, Any]:
    return reproduce("3.6", out, Effort(**{"scale": 1.0, "minutes": None, "changes": TINY, **effort}), rows=rows)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table that nothing broke off."""
    out = tmp_path_factory.mktemp("whole") / "tables"
    tiny(out)
    return out


def told(out: Path) -> dict[str, Any]:
    """What rows reached, without what time it took."""
    rows = json.loads((out / "table.json").read_text())["tables"]["3.6"]["rows"]
    for row in rows:
        for key in ("minutes", "date"):
            row["ours"]["reached"].pop(key)
        for scores in (row["ours"][part] for part in ("validation", "test", "unseen")):
            assert all(score.pop("ms") > 0 for score in scores.values())
    return {row["recipe"]: row for row in rows}


@pytest.mark.e2e
@pytest.mark.thorough
def test_a_table_from_nothing(whole: Path) -> None:
    rows = told(whole)
    assert set(rows) == set(ROWS)
    assert len(list((whole / "data").iterdir())) == 2  # one for both rows, one of unseen scenes
    assert len({DataStore.open(str(path)).about["gain"] for path in (whole / "data").iterdir()}) == 1  # of one sonar
    for name, row in rows.items():
        ours = row["ours"]
        reached = {key: ours["reached"][key] for key in ("training_pairs", "pairs_seen", "batch", "rate", "threads")}
        assert reached == {
            "training_pairs": 57,  # 16 sequences of 4: one for test, and 3 of the other 60 for validation
            "pairs_seen": 48,
            "batch": 4,
            "rate": 1e-4,
            "threads": torch.get_num_threads(),
        }
        assert (ours["validation"]["none"]["pairs"], ours["test"]["none"]["pairs"]) == (3, 1)
        assert (ours["unseen"]["high"]["pairs"], ours["unseen"]["high"]["scenes"]) == (16, 2)
        stored = Checkpoint.load(whole / "runs" / name)
        assert stored.options["width"] == 1 / 16
        assert stored.recipe["loss"]["penalty"] == (100 if name == "posenet-penalty" else 0)
    text = (whole / "table.md").read_text()
    output = "scale 1 of the recipes' data; all epochs; recipes changed, except for keys that a row sets: network.width "
    assert output + "0.0625" in text
    assert "not trained yet" not in text
    assert (whole / "table-3.6.png").stat().st_size > 10_000


def test_only_the_requested_table_is_drawn(tmp_path: Path) -> None:
    bench = TableBuilder(RunDirectory.begin(tmp_path / "both", tables.TABLES, {}), Effort(quick=True))
    for name in ("3.2", "3.6"):
        bench.add_table(name, {})
    assert set(bench.report(["3.6"])["tables"]) == {"3.2", "3.6"}
    assert [path.name for path in (tmp_path / "both").glob("*.png")] == ["table-3.6.png"]


@pytest.mark.thorough
def test_unseen_scenes_are_evaluated_as_the_network_says(whole: Path) -> None:
    """RMSE in the table against the network asked by hand."""
    (url,) = (path for path in (whole / "data").iterdir() if "unseen" in path.name)
    (seen,) = (path for path in (whole / "data").iterdir() if "unseen" not in path.name)
    from mitsonar.datasets.samples import SonarPairs

    pairs, before = SonarPairs(url, part="all", one_per_sequence=True, labels="normx10"), SonarPairs(seen, part="all")
    assert pairs.recipe.seed != before.recipe.seed
    assert not set(map(tuple, pairs.pose)) & set(map(tuple, before.pose))
    network = Checkpoint.load(whole / "runs" / ROWS[0]).build()
    with torch.inference_mode():
        output = [pairs.labels.decode(network(pairs[k][0][None]))[0] for k in range(len(pairs))]
    error = in_units(np.array(output) - [pairs.target(k) for k in range(len(pairs))])
    expected = told(whole)[ROWS[0]]["ours"]["unseen"]["none"]["rmse"]
    np.testing.assert_allclose(np.sqrt((error**2).mean(axis=0)), expected, rtol=1e-4)


SCRIPT = """
import os, signal, sys
def kill(event, args, left=[{times}]):
    if event == "os.rename" and {name!r} in str(args[1]):
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(kill)
sys.path[:0] = {tests!r}
from pathlib import Path
from test_reproduce import tiny
tiny(Path({out!r}))
"""
"""Makes the table until the file is about to get its name for the so-manieth time."""

IN_TRAINING = (f"runs/{ROWS[0]}/last.ckpt", 2)
EVERYWHERE = [
    *(("tables/run.json", 1), (".zarr/", 5), ("unseen", 3), (f"runs/{ROWS[0]}/run.json", 1)),
    *((f"runs/{ROWS[0]}/network.ckpt", 1), IN_TRAINING, (f"rows/{ROWS[0]}.json", 1), ("table.json", 2)),
]


@pytest.mark.posix
@pytest.mark.parametrize(
    "moments",
    [pytest.param([IN_TRAINING], marks=pytest.mark.thorough), pytest.param(EVERYWHERE, marks=pytest.mark.slow)],
    ids=["once", "again"],
)
@pytest.mark.e2e
def test_killed_and_called_again_it_reaches_the_same_table(
    moments: list[tuple[str, int]], whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "tables"
    threads = {"OMP_NUM_THREADS": str(torch.get_num_threads())}  # sums in another order have other last bits
    for name, times in moments:
        script = SCRIPT.format(tests=[str(Path(__file__).parents[k]) for k in (0, 1)], out=str(out), name=name, times=times)
        done = subprocess.run([sys.executable, "-c", script], env={**os.environ, **threads}, timeout=300)
        assert done.returncode == -signal.SIGKILL, f"{name} was not written {times} times"
    assert "not trained yet" in (out / "table.md").read_text()
    tiny(out)
    assert told(out) == told(whole)
    for name in ROWS:
        mine, others = (Checkpoint.load(folder / "runs" / name).weights for folder in (out, whole))
        assert all(torch.equal(mine[key], others[key]) for key in others)


@pytest.mark.slow
def test_what_is_done_is_not_done_again(whole: Path) -> None:
    before = told(whole)
    runs = {path: path.stat().st_mtime_ns for path in (whole / "runs").rglob("*") if path.is_file()}
    (whole / "rows" / f"{ROWS[0]}.json").unlink()  # evaluated again, not trained again
    tiny(whole)
    assert told(whole) == before
    assert {path: path.stat().st_mtime_ns for path in (whole / "runs").rglob("*") if path.is_file()} == runs
    report = reproduce("3.2", whole, Effort(1.0, None, None, TINY), rows=[ROWS[0]])  # another table with the same network
    done = {row["recipe"]: row["status"] for row in report["tables"]["3.2"]["rows"]}
    assert done.pop(ROWS[0]) == "done"
    assert set(done.values()) == {"not trained yet"}
    assert list(report["tables"]) == ["3.2", "3.6"]
    assert {path: path.stat().st_mtime_ns for path in (whole / "runs").rglob("*") if path.is_file()} == runs


# ---------------------------------------------------------------- mistakes


def test_names_and_numbers_that_are_wrong() -> None:
    with pytest.raises(MitsonarError, match=r"no table '3\.22': .*3\.2"):
        reproduce("3.22", "nowhere", Effort())
    with pytest.raises(MitsonarError, match=r"table 3\.1 has no row 'posnet-quantised': did you mean posenet-quantised"):
        reproduce("3.1", "nowhere", Effort(), rows=["posnet-quantised"])
    for scale in (0, -0.5, 1.5, float("nan")):
        with pytest.raises(MitsonarError, match="above 0 and at most 1"):
            Effort(scale=scale)
    for minutes in (0, -1, float("nan"), float("inf")):
        with pytest.raises(MitsonarError, match="minutes of training of a row must be above 0"):
            Effort(minutes=minutes)
    with pytest.raises(MitsonarError, match="batch must be at least 1: got 0"):
        Effort(batch=0)
    with pytest.raises(MitsonarError, match="unknown training recipe key lables"):
        reproduce("3.1", "nowhere", Effort(changes={"lables": "raw"}))
    assert not Path("nowhere").exists()


def test_a_larger_batch_has_a_larger_rate() -> None:
    recipe = Effort(batch=64).recipe("posenet-penalty")
    assert recipe.batch == 64
    assert recipe.optimiser.rate == pytest.approx(4e-4)
    assert (recipe.loss.penalty, recipe.optimiser.halve_every) == (100, 12)
    assert Effort(batch=4).recipe("posenet-penalty") == load_training_recipe("posenet-penalty")
    assert "batches of 64, the rate scaled by the square root" in Effort(batch=64).sentence()
    assert isinstance(Effort().recipe("posenet-hull"), TrainingRecipe)


@pytest.mark.thorough
def test_a_folder_keeps_to_what_it_was_begun_with(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match=r"was begun with scale 1\.0, not 0\.5: "):
        tiny(whole, scale=0.5)
    with pytest.raises(MitsonarError, match=r"was begun with minutes None, not 2\.0; batch None, not 8: "):
        tiny(whole, minutes=2.0, batch=8)
    with pytest.raises(MitsonarError, match=r"was begun with changes\.steps 12, not 13"):
        tiny(whole, changes={**TINY, "steps": 13})
    about = whole / "run.json"
    stored = about.read_text()
    about.write_text(stored.replace('"penalty": 100.0', '"penalty": 50.0'))  # as if the recipe's file had changed
    with pytest.raises(MitsonarError, match=r"was begun with row\.posenet-penalty\.loss\.penalty 50\.0, not 100\.0"):
        tiny(whole)
    for damaged, output in (
        (stored[:-40], "cannot read"),
        ("{}", "no tables of mitsonar"),
        (stored.replace('"scale"', '"scala"'), "scala"),
    ):
        about.write_text(damaged)
        with pytest.raises(MitsonarError, match=output):
            tiny(whole)
    about.write_text(stored)
    row = whole / "rows" / f"{ROWS[0]}.json"
    fine = row.read_text()
    row.write_text(fine.replace('"validation"', '"valid"'))
    with pytest.raises(MitsonarError, match=r"posenet-normx10\.json is damaged"):
        tiny(whole)
    row.write_text(fine)
    (tmp_path / "thesis.docx").write_text("mine")
    with pytest.raises(MitsonarError, match=r"contains other files \(thesis\.docx\) and is kept"):
        tiny(tmp_path)
    assert os.listdir(tmp_path) == ["thesis.docx"]


def test_the_command_lists_its_tables_and_answers_to_mistakes(mitsonar: Command, tmp_path: Path) -> None:
    listed = mitsonar("reproduce")
    assert listed.returncode == 0, listed.stderr
    for name in RECIPES:
        assert f" {name} " in listed.stdout
    assert "posenet-normx10                  2.84 / 1.00 / 0.052   6.54 / 3.39 / 0.170   Polar" in listed.stdout
    assert "impulse-standard                 5.10 / 4.20   standard" in listed.stdout
    out = tmp_path / "none"
    refused(mitsonar("reproduce", "3.2"), "table 3.2 needs a folder: give -o")
    refused(mitsonar("reproduce", "3.12", "-o", out), "no table '3.12'", "3.10")
    refused(mitsonar("reproduce", "3.9"), "3.9 is made by a script", "python benchmarks/bench_compare.py")
    refused(
        mitsonar("reproduce", "3.1", "--rows", "posenet", "-o", out), "no row 'posenet'", "did you mean posenet-quantised"
    )
    assert not out.exists()


@pytest.mark.thorough
def test_the_command_prints_the_table_that_is_there(mitsonar: Command, whole: Path) -> None:
    words = [word for key, value in TINY.items() for word in ("--set", f"{key}={json.dumps(value)}")]
    again = mitsonar("reproduce", "3.6", "-o", whole, "--scale", 1, "--minutes", 0, *words)
    assert again.returncode == 0, again.stderr
    assert (whole / "table.md").read_text().rstrip() in again.stdout
