"""Runs and data sets joined to one data set: the same pixels, poses, labels and names, and no frame in two parts."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from drawn_frames import SONAR, as_zarr, over_ground, sway
from helpers import Command, refused, tiny_recipe
from numpy.typing import NDArray

from mitsonar import SonarFrames
from mitsonar.acoustics.water import noise_of
from mitsonar.bridges.export_source import (
    FramesWithPoses,
    LabelledPictures,
    Stretch,
    axes_of,
    open_export,
    recorded_recipe,
    write_recorded,
)
from mitsonar.bridges.join_data import sources_at
from mitsonar.config.data import Split
from mitsonar.datasets.make import check, make_dataset
from mitsonar.datasets.modality import Scene
from mitsonar.datasets.store import DataStore, frames_in_part, world_numbers
from mitsonar.errors import MitsonarError
from mitsonar.mapping.sources import LabelledPart
from mitsonar.recordings.recording import Part

LABELS: dict[str, Any] = {"labels": ["shape_id", "object_id"], "scenes": [{"count": 2, "sequences": 3}]}


def labelled(names: tuple[str, ...], frames: int = 6, seed: int = 0) -> SonarFrames:
    """Frames of a floor whose cells show shapes at random."""
    drawn = over_ground(sway(frames))
    shape = np.random.default_rng(seed).integers(-1, len(names), drawn.image.shape, dtype=np.int32)
    return replace(drawn, shape_id=shape, shape_names=names)


def named(shape: NDArray[np.int32] | None, names: tuple[str, ...]) -> NDArray[np.str_]:
    """The names of shapes in place of their numbers."""
    assert shape is not None
    return np.array([*names, ""])[shape]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, SonarFrames]:
    """Two runs whose shapes have other numbers, frames.npz and frames.zarr, by path."""
    folder = tmp_path_factory.mktemp("runs")
    one, two = labelled(("sand", "wall")), labelled(("sand", "barrel", "wall"), 7, 1)
    (folder / "one").mkdir()
    (folder / "two").mkdir()
    one.save(folder / "one/frames.npz")
    as_zarr(two, folder / "two/frames.zarr")
    return {str(folder / "one"): one, str(folder / "two"): two}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, variant: str) -> list[str]:
    """Two data sets of one recipe with other worlds."""
    folder = tmp_path_factory.mktemp("made")
    urls = [str(folder / f"{seed}.zarr") for seed in (0, 7)]
    for url, seed in zip(urls, (0, 7), strict=True):
        make_dataset(tiny_recipe(seed=seed, **LABELS), url)
    return urls


def joined(out: Path, *places: str, **words: Any) -> DataStore:
    write_recorded([source for place in places for source in sources_at(place)], out, **words)
    store = DataStore.open(out)
    assert check(store) == []
    return store


# ---------------------------------------------------------------- what is stored


def test_labels_of_runs_keep_their_names(runs: dict[str, SonarFrames], tmp_path: Path) -> None:
    joined(tmp_path / "data.zarr", *runs)
    source = open_export(tmp_path / "data.zarr")
    there = source.read(slice(0, source.frames))
    expected = np.concatenate([named(run.shape_id, run.shape_names) for run in runs.values()])
    assert np.array_equal(named(there.shape_id, there.shape_names), expected)
    assert np.array_equal(there.image, np.concatenate([run.image for run in runs.values()]))
    assert source.labels == ("shape_id",)


def test_labels_can_be_left_out(runs: dict[str, SonarFrames], tmp_path: Path) -> None:
    store = joined(tmp_path / "data.zarr", *runs, labels=False)
    assert store.recipe.labels == []
    assert "shape_id" not in store.group


def test_data_sets_become_one_with_all_scenes(made: list[str], tmp_path: Path) -> None:
    stores = [DataStore.open(url) for url in made]
    store = joined(tmp_path / "data.zarr", *made)
    for name in ("image", "pose", "motion", "time_s", "height_m", "shape_id", "object_id", "saturated"):
        expected = np.concatenate([one.read(name) for one in stores])
        assert np.allclose(store.read(name), expected, rtol=0, atol=1e-12, equal_nan=True), name
    assert np.array_equal(store.read("scene"), np.concatenate([stores[0].read("scene"), stores[1].read("scene") + 2]))
    assert np.array_equal(
        store.read("sequence"), np.concatenate([stores[0].read("sequence"), stores[1].read("sequence") + 6])
    )
    assert store.recipe.split == stores[0].recipe.split
    assert len(set(world_numbers(store.recipe, store.scenes).tolist())) == 4
    exports = [open_export(url) for url in (str(tmp_path / "data.zarr"), *made)]
    shapes = [named(one.read(slice(0, one.frames)).shape_id, one.like.shape_names) for one in exports]
    assert np.array_equal(shapes[0], np.concatenate(shapes[1:]))


@pytest.mark.thorough
def test_a_joined_data_set_is_joined_again(made: list[str], tmp_path: Path) -> None:
    first = joined(tmp_path / "first.zarr", made[0])
    both = joined(tmp_path / "both.zarr", str(tmp_path / "first.zarr"), made[1])
    at_once = joined(tmp_path / "once.zarr", *made)
    for name in ("image", "pose", "shape_id", "scene", "sequence", "seal"):
        assert np.array_equal(both.read(name), at_once.read(name)), name
    assert np.array_equal(world_numbers(both.recipe, both.scenes), world_numbers(at_once.recipe, at_once.scenes))
    assert len(first) == len(both) // 2


@pytest.mark.learn
def test_torch_reads_the_pairs_of_both(made: list[str], tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from mitsonar import SonarPairs

    joined(tmp_path / "data.zarr", *made)
    words: dict[str, Any] = {"part": "all", "noise": "none", "labels": "raw"}
    one, two, both = (SonarPairs(url, **words) for url in (*made, str(tmp_path / "data.zarr")))
    assert len(both) == len(one) + len(two)
    for index, (pairs, inner) in {3: (one, 3), len(one) + 5: (two, 5)}.items():
        assert np.array_equal(both[index][0], pairs[inner][0])
        assert np.allclose(both[index][1], pairs[inner][1], atol=1e-6)
    parts = [SonarPairs(tmp_path / "data.zarr", part=part, split="scene") for part in ("train", "validation", "test")]
    scenes = [set(part.store.read("scene")[part.first].tolist()) for part in parts]
    assert sorted(number for one in scenes for number in one) == [0, 1, 2, 3]


def test_single_frames_stay_single(tmp_path: Path, variant: str) -> None:
    make_dataset(tiny_recipe(flight={"pings": 1}, frames=1, scenes=[{"sequences": 5}]), str(tmp_path / "single.zarr"))
    store = joined(tmp_path / "data.zarr", str(tmp_path / "single.zarr"))
    assert (len(store), store.about["sequences"], store.recipe.frames) == (5, 5, 1)
    assert np.isnan(store.read("motion")).all()


def test_scenes_keep_the_noise_that_was_raised() -> None:
    sonar = SONAR.replace(model="coherent", frequency_hz=1.8e6, noise_level_db=40.0)
    drawn = over_ground(sway(4), sonar)
    sources = [_source(drawn, name, raised_db=raised) for name, raised in (("a", 0.0), ("b", 6.0), ("c", 12.0))]
    recipe = recorded_recipe(sources, "joined")
    assert recipe.noise_raised_db([0, 1, 2]).tolist() == [0, 6, 12]
    assert not recorded_recipe(sources[:1], "joined").noise_db


def _source(frames: SonarFrames, name: str, **words: Any) -> FramesWithPoses:
    assert frames.poses is not None
    assert frames.height_m is not None
    part = Part(frames.select(slice(0)), frames.time_s, frames.image.__getitem__, frames.poses, height_m=frames.height_m)
    stretch = Stretch(part, 0, frames.time_s, frames.poses, frames.height_m)
    return FramesWithPoses(name, "drawn", "its own", axes_of(frames, name), 1.0, [stretch], 0, **words)


# ---------------------------------------------------------------- parts


def test_a_world_stays_in_one_part() -> None:
    """Scenes 0 and 2 show one world, and four shares of seeds never divide them."""
    worlds = ("x", "y", "x", "", "")
    drawn = [over_ground(sway(frames)) for frames in (4, 5, 6, 7, 8)]
    sources = [_source(one, f"run{place}", world=worlds[place]) for place, one in enumerate(drawn)]
    recipe = recorded_recipe(sources, "joined")
    numbers = world_numbers(recipe, {place: Scene(place, place, 0, 1) for place in range(5)})
    assert numbers.tolist() == [0, 1, 0, 3, 4]
    scene = np.repeat(np.arange(5), [4, 5, 6, 7, 8])
    for seed in range(8):
        split = Split(by="scene", train=0.5, validation=0.5, test=0.0, seed=seed)
        train = frames_in_part(numbers[scene], scene.astype(np.int32), split, "train")
        assert train[scene == 0].all() == train[scene == 2].all() == train[scene == 0].any()
    assert recipe.split.by == "scene"
    assert recorded_recipe([sources[0], sources[2]], "joined").split.by == "sequence"


def test_the_ratio_of_an_object_to_noise_is_that_of_its_own_file(tmp_path: Path) -> None:
    """Files of another noise and another gain: by those of the first, a barrel would lose its box, or noise get one."""
    drawn = over_ground(sway(4), SONAR.replace(model="coherent", frequency_hz=1.8e6, noise_level_db=-60.0))
    shape = np.full(drawn.image.shape, -1, dtype=np.int32)
    shape[:, 40:60, 30:50] = 0
    expected = []
    for name, noise_db, scale, snr_db in (("a", -60.0, 1e-4, 6.0), ("b", -50.0, 1e-4, 4.0), ("c", -60.0, 1e-2, 10.0)):
        sonar = drawn.sonar.replace(noise_level_db=noise_db)
        noise = np.broadcast_to(noise_of(sonar)[:, None] / scale, shape.shape)
        image = (noise * np.where(shape == 0, 1 + 10 ** (snr_db / 10), 1)).astype(np.float32)
        (tmp_path / name).mkdir()
        run = replace(drawn, image=image, sonar=sonar, level_scale=scale, shape_id=shape, shape_names=("barrel",))
        run.save(tmp_path / name / "frames.npz")
        expected += [{(0, 0): pytest.approx(snr_db, abs=1e-3)}] * len(run)
    joined(tmp_path / "data.zarr", *(str(tmp_path / name) for name in "abc"))
    source = open_export(tmp_path / "data.zarr")
    frames, pictures = source.read(slice(0, source.frames)), LabelledPictures(source.like)
    assert [pictures.snr_db(frames, k, float(source.raised_db[k])) for k in range(len(frames))] == expected
    again = sources_at(str(tmp_path / "data.zarr"))
    assert [source.level_scale for source in again] == [1e-4, 1e-4, 1e-2]


def test_a_sequence_of_both_is_refused(made: list[str], tmp_path: Path) -> None:
    make_dataset(tiny_recipe(**{**LABELS, "scenes": [{"count": 3, "sequences": 3}]}), str(tmp_path / "longer.zarr"))
    with pytest.raises(MitsonarError, match="have a sequence in common"):
        joined(tmp_path / "data.zarr", made[0], str(tmp_path / "longer.zarr"))
    assert not (tmp_path / "data.zarr").exists()


# ---------------------------------------------------------------- memory


@pytest.mark.slow
def test_one_run_at_a_time_is_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The peak of joining four runs in small shards is that of two."""
    monkeypatch.setattr("mitsonar.datasets.store.SHARD_BYTES", 2**20)
    frames = labelled(("sand", "wall"), 16)
    peaks = []
    for number in range(4):
        replace(frames, image=np.ascontiguousarray(np.roll(frames.image, number, axis=1))).save(tmp_path / f"{number}.npz")
    for count in (2, 4):
        tracemalloc.start()
        joined(tmp_path / f"{count}.zarr", *(str(tmp_path / f"{number}.npz") for number in range(count)))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    size = frames.image.nbytes * 2
    assert peaks[1] - peaks[0] < 0.5 * size, [peak / size for peak in peaks]


# ---------------------------------------------------------------- refusals


def test_what_differs_is_said(
    mitsonar: Command, runs: dict[str, SonarFrames], made: list[str], frames_without: Path, tmp_path: Path
) -> None:
    out = tmp_path / "data.zarr"
    one, two = runs
    bare, unnamed, coded = (frames_without / name for name in ("bare.npz", "unnamed.npz", "coded.npz"))
    words = "the labels shape_id", "no labels", "--no-labels"
    refused(mitsonar("dataset", "from-frames", one, bare, "-o", out), *words)
    refused(mitsonar("dataset", "from-frames", one, unnamed, "-o", out), "names its shapes and", "--no-labels")
    refused(mitsonar("dataset", "from-frames", one, coded, "-o", out), "another sonar", "level gamma, not linear")
    refused(mitsonar("dataset", "from-frames", one, made[0], "-o", out), "another sonar", "range_bins 40, not 128")
    refused(mitsonar("dataset", "from-frames", *made, "--poses", "a.tum", "-o", out), "--poses does not apply")
    refused(mitsonar("dataset", "from-frames", *made, "--cut", 4, made[0], "-o", out), "given twice")
    assert not out.exists()
    done = mitsonar("dataset", "from-frames", one, bare, "--no-labels", "-o", out)
    assert done.returncode == 0, done
    before = DataStore.open(out).seals()
    refused(mitsonar("dataset", "from-frames", one, two, "-o", out), "exists and is kept as it is")
    assert np.array_equal(DataStore.open(out).seals(), before)


@pytest.fixture
def frames_without(tmp_path: Path) -> Path:
    """Frames without labels, without names, and of another coding."""
    frames = labelled(("sand", "wall"))
    folder = tmp_path / "frames"
    folder.mkdir()
    replace(frames, shape_id=None, shape_names=()).save(folder / "bare.npz")
    replace(frames, shape_names=()).save(folder / "unnamed.npz")
    replace(frames, level="gamma").save(folder / "coded.npz")
    return folder


@pytest.mark.parametrize("number", [2, -2])
def test_shapes_that_do_not_exist_are_refused(tmp_path: Path, number: int) -> None:
    source = _source(over_ground(sway(4)), "dive", labels=("shape_id",), shape_names=("sand", "wall"))
    stretch = source.stretches[0]
    shape = np.full((4, 128, 96), number, np.int32)
    inner = stretch.part
    part = LabelledPart(
        inner.like, inner.time_s, inner.images, inner.poses, height_m=inner.height_m, labels=lambda i: {"shape_id": shape[i]}
    )
    broken = replace(source, stretches=[replace(stretch, part=part)])
    with pytest.raises(MitsonarError, match=rf"shape_id of dive must lie in -1..1: got {number}"):
        write_recorded([broken], tmp_path / "data.zarr")
    assert list(tmp_path.iterdir()) == []


def test_damaged_names_are_no_crash(runs: dict[str, SonarFrames], tmp_path: Path) -> None:
    joined(tmp_path / "data.zarr", *runs)
    attributes = zarr.open_group(tmp_path / "data.zarr", mode="r+").attrs
    damaged: list[Any] = [7, [["sand"]], [["sand"], 3], "sand"]
    for names in damaged:
        attributes["shape_names"] = names
        with pytest.raises(MitsonarError, match="attribute shape_names must list the names of 2 groups"):
            open_export(tmp_path / "data.zarr")
    attributes["shape_names"] = [["sand"], ["sand", "wall"]]
    with pytest.raises(MitsonarError, match=r"shape_id of scene 0 must lie in -1\.\.0"):
        next(open_export(tmp_path / "data.zarr").chunks())


def test_several_views_are_refused(tmp_path: Path, variant: str) -> None:
    receivers = [{"name": name, "starboard_m": x, "sonar": {"beams": 12}} for name, x in (("fore", -0.5), ("aft", 0.5))]
    recipe = tiny_recipe(scenes=[{"sequences": 1}], receivers=receivers, sonar__beams=96, sonar__jitter=True)
    make_dataset(recipe, str(tmp_path / "views.zarr"))
    with pytest.raises(MitsonarError, match="has the views fore, aft"):
        sources_at(str(tmp_path / "views.zarr"))
