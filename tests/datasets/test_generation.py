"""Data sets on disk: what is stored is what the simulator renders, and nothing that goes wrong leaves anything wrong."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers import PROGRAM, TINY, Command, by_itself, essence, files_of, refused, tiny_recipe

from mitsonar.config.data import array_names
from mitsonar.datasets.make import FRAMES_A_SCENE, Queue, SceneRenderer, calibrate, check, forget, make_dataset, make_shard
from mitsonar.datasets.overview import info, sheet_figure
from mitsonar.datasets.plan import Plan, sequences_of
from mitsonar.datasets.store import PACKAGES, DataStore
from mitsonar.errors import MitsonarError
from mitsonar.io.runs import versions
from mitsonar.io.storage import Storage
from mitsonar.motion.pose import mounted
from mitsonar.records.frames import to_uint8
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(scope="module")
def made(tiny_data: Path) -> Path:
    """The tiny data set, made in one go."""
    return tiny_data


def copy_of(made: Path, folder: Path) -> Path:
    """A copy to do harm to."""
    import shutil

    return Path(shutil.copytree(made, folder / "tiny.zarr"))


def first_shard(store: DataStore, name: str = "image") -> Path:
    return Path(store.place.root) / store.key(name, 0)


# ---------------------------------------------------------------- what is stored


def test_frames_are_what_the_simulator_renders(made: Path, tmp_path: Path) -> None:
    """Two routes: each scene built, loaded and rendered here, by the public simulator, ping by ping."""
    store, recipe = DataStore.open(made), tiny_recipe()
    image, scene, gain = store.read("image"), store.read("scene"), store.about["gain"]
    for number, one in store.scenes.items():
        path, _ = recipe.family(one.group).prepare(one.seed, tmp_path / str(number))
        simulator = Simulator(load_scene(path), recipe.instrument)
        mine = np.flatnonzero(scene == number)
        for index in mine[::17]:
            ping = number * FRAMES_A_SCENE + int(index - mine[0])
            (pings,) = simulator.pings(store.read("pose")[index], first=ping)
            np.testing.assert_array_equal(image[index], to_uint8(np.clip(pings.levels[0] * np.float32(gain), 0, 1)))
            assert store.read("height_m")[index] == pings.height_m[0]
            assert store.read("dropped")[index] == (pings.counts.nearer + pings.counts.farther).sum()


def test_the_gain_is_set_on_20_frames_of_the_first_scene(made: Path) -> None:
    """The 99.9th percentile of their pixels becomes 0.9, however many frames are made."""
    store = DataStore.open(made)
    levels = store.read("image", slice(0, 20)) / 255
    assert np.percentile(levels, 99.9) == pytest.approx(0.9, abs=0.01)
    recipe = tiny_recipe()
    assert calibrate(recipe) == store.about["gain"]


def test_plan_and_store_say_the_same(made: Path) -> None:
    store, plan = DataStore.open(made), Plan.of(tiny_recipe())
    for name in ("scene", "sequence", "time_s", "motion"):
        np.testing.assert_array_equal(store.read(name), getattr(plan, name))
    np.testing.assert_array_equal(store.read("pose"), plan.poses)
    assert "vehicle_pose" not in store.group
    np.testing.assert_allclose(store.read("time_s")[:6] * tiny_recipe().instrument.frame_rate_hz, [0, 1, 2, 3, 4, 0])
    np.testing.assert_array_equal(store.read("range_m"), tiny_recipe().instrument.range_m)
    assert check(store) == []
    assert len(store) == 150
    assert store.shards > 1


def test_standing_still_shows_the_jitter_alone() -> None:
    """Without motion two frames are equal; with jitter they differ, by less than frames of different places."""
    still = {"flight__sideways_mm": 0.0, "flight__forward_mm": 0.0, "flight__yaw_deg": 0.0}
    for jitter in (False, True):
        recipe = tiny_recipe(**still, sonar__jitter=jitter, sonar__rays_per_beam=900)
        scene = Plan.of(recipe, 2).scenes[0]
        sequences = sequences_of(recipe, scene)
        poses = mounted(np.concatenate([next(sequences).vehicle for _ in range(2)]), recipe.mount.pose)
        image = SceneRenderer(recipe, scene).frames(poses, 0, calibrate(recipe))["image"].astype(float)
        within, across = np.abs(image[1] - image[0]).mean(), np.abs(image[5] - image[0]).mean()
        assert (within > 0) == jitter
        assert within < 0.7 * across


@pytest.mark.thorough
def test_any_zarr_reader_and_xarray_open_it(made: Path) -> None:
    """docs/guides/data-sets.md: no code of ours is needed."""
    import xarray
    import zarr

    group = zarr.open_group(made, mode="r")
    store = DataStore.open(made)
    np.testing.assert_array_equal(group["image"][7:9], store.read("image")[7:9])  # type: ignore[index]
    assert group.attrs["recipe"]["name"] == "tiny"  # type: ignore[index, call-overload]
    data = xarray.open_zarr(made, consolidated=False).set_coords(["range_m", "bearing_rad"])
    assert data.image.dims == ("frame", "range", "beam")
    near = data.swap_dims(range="range_m", beam="bearing_rad").image.sel(range_m=slice(3.2, 3.8))
    np.testing.assert_array_equal(near[7], store.read("image", 7)[store.read("range_m") < 3.8])
    assert data.image.dtype == np.uint8
    np.testing.assert_array_equal(data.image[3].values, store.read("image")[3])
    np.testing.assert_array_equal(data.motion[:4].values, store.read("motion")[:4])
    np.testing.assert_array_equal(data.time_s.values, store.read("time_s"))
    np.testing.assert_array_equal(data.scene.values, store.read("scene"))
    assert set(data.sizes) == {"frame", "range", "beam", "six", "three", "shard", "stored", "two"}
    assert "gain" in data.attrs


VARIANTS: dict[str, dict[str, Any]] = {
    "float32": {"pixel": "float32"},
    "labels": {"labels": ["elevation_rad", "shape_id", "object_id", "shadow"]},
    "vectors": {"store": "vectors"},
    "physical": {"sonar__model": "physical", "sonar__rays_across": 2},
    "segments": {
        "segments": ["whole", "q1", "c1"],
        "store": "both",
        "sonar__azimuth_fov_deg": 80.0,
        "sonar__elevation_fov_deg": 80.0,
        "sonar__range_min": 1.0,
        "mount__pitch_deg": 90.0,
        "mount__heading_deg": -90.0,
    },
    "two sensors": {
        "receivers": [{"name": n, "starboard_m": x, "sonar": {"beams": 12}} for n, x in (("fore", -0.5), ("aft", 0.5))],
        "sonar__beams": 96,
        "sonar__jitter": True,
        "mount__heading_deg": 90.0,
        "labels": ["elevation_rad"],
    },
    "heights": {"flight__pings": 1, "flight__height_m": [1.5, 3.0], "flight__jump_m": None, "frames": 1},
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", essence(sorted(VARIANTS), "labels", "segments", "two sensors", "vectors"))
def test_every_kind_of_data_set_is_made_and_checks(name: str, tmp_path: Path) -> None:
    recipe = tiny_recipe(scenes=[{"count": 1, "sequences": 10}], **VARIANTS[name])
    make_dataset(recipe, str(tmp_path / "data.zarr"))
    store = DataStore.open(tmp_path / "data.zarr")
    assert check(store) == []
    arrays = {key: store.read(key) for key in array_names(recipe)}
    assert all(len(values) == len(store) for values in arrays.values())
    match name:
        case "float32":
            assert arrays["image"].dtype == np.float32
            assert 0.5 < arrays["image"].max() <= 1
        case "labels":
            filled = arrays["image"] > 0
            assert (arrays["shape_id"][filled] >= 0).mean() > 0.999
            assert (arrays["shape_id"][~filled] == -1).all()
            assert np.isnan(arrays["elevation_rad"][~filled]).all()
            assert np.abs(np.degrees(arrays["elevation_rad"][filled])).max() <= 7
            assert (arrays["object_id"][filled] > 0).any()
        case "vectors":
            second = tiny_recipe(scenes=[{"count": 1, "sequences": 10}], pixel="float32")
            make_dataset(second, str(tmp_path / "images.zarr"))
            image = DataStore.open(tmp_path / "images.zarr").read("image")
            np.testing.assert_allclose(arrays["vector"], image.sum(axis=2, dtype=float), rtol=1e-6)
            np.testing.assert_array_equal(arrays["nonzero"], np.count_nonzero(image, axis=2))
        case "segments":
            assert arrays["image_whole"].shape[2] == 2 * arrays["image_q1"].shape[2]
            assert (arrays["vector_c1"] <= arrays["vector_q1"] * (1 + 1e-6)).all()
            assert np.abs(np.degrees(store.read("bearing_rad_q1")) - 40 * (np.arange(6) + 0.5) / 6).max() < 1e-9
            assert "vehicle_pose" in store.group
        case "two sensors":
            fore, aft = arrays["image_fore"], arrays["image_aft"]
            assert not np.array_equal(fore, aft)
            # each sensor is dark on its outer side, where the transmitter does not reach
            assert (fore[:, :, 0] > 0).mean() < 0.3 * (fore[:, :, 8] > 0).mean()
            assert (aft[:, :, -1] > 0).mean() < 0.3 * (aft[:, :, 3] > 0).mean()
        case "heights":
            z = store.read("pose")[:, 2]
            assert np.isnan(store.read("motion")).all()
            assert np.ptp(z) > 0.5


@pytest.mark.thorough
def test_one_scene_in_two_shards_and_two_scenes_in_one(tmp_path: Path) -> None:
    """Whatever way frames are cut into files, they are the same frames."""
    recipe = tiny_recipe(scenes=[{"count": 1, "sequences": 7}, {"count": 1, "sequences": 12}])
    make_dataset(recipe, str(tmp_path / "data.zarr"))
    store = DataStore.open(tmp_path / "data.zarr")
    scenes = [set(store.read("scene")[store.frames_of(shard)].tolist()) for shard in range(store.shards)]
    assert {0, 1} in scenes
    assert len(scenes) > 1
    plan, image = Plan.of(recipe), []
    for scene in plan.scenes:
        mine = plan.scene == scene.number
        image.append(SceneRenderer(recipe, scene).frames(plan.poses[mine], 0, store.about["gain"])["image"])
    np.testing.assert_array_equal(store.read("image"), np.concatenate(image))


# ---------------------------------------------------------------- workers, kills, faults


def command(folder: Path, *options: object, recipe: dict[str, Any] | None = None) -> list[str]:
    """The command line that makes the tiny data set in a folder."""
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(recipe or TINY, sort_keys=False))
    return ["dataset", "make", str(path), "-o", str(folder / "tiny.zarr"), *map(str, options)]


@pytest.mark.thorough
def test_a_worker_that_lives_on_makes_the_data_set_that_it_is_asked_for(tmp_path: Path) -> None:
    """The same folder, another seed: nothing of the first may be in the second."""
    import shutil

    url = tmp_path / "tiny.zarr"
    for seed in (1, 2):
        shutil.rmtree(url, ignore_errors=True)
        recipe = tiny_recipe(seed=seed)
        place = Storage(url)
        about = {"gain": 0.02, "level_scale": 50.0, "variant": "llvm_ad_mono", "versions": versions(PACKAGES)}
        store = DataStore.create(place, recipe, Plan.of(recipe, 3), about)
        make_shard(DataStore.open(url, write=True, unfinished=True), 0)
    here = store.frames_of(0)
    forget()
    alone = SceneRenderer(recipe, store.scenes[0]).frames(store.read("pose", here), 0, 0.02)
    np.testing.assert_array_equal(store.read("image", here), alone["image"])


@pytest.mark.thorough
def test_a_shard_that_vanishes_while_others_are_written_is_made_again(made: Path, tmp_path: Path) -> None:
    url = tmp_path / "tiny.zarr"
    harmed: list[Path] = []

    def harm(frames: int) -> None:
        if not harmed:
            harmed.append(first_shard(DataStore.open(url, unfinished=True)))
            harmed[0].unlink()

    make_dataset(tiny_recipe(), str(url), progress=harm)
    assert harmed
    assert files_of(url) == files_of(made)


@pytest.mark.parametrize(
    ("name", "harm"), [("pose", "truncate"), ("time_s", "delete"), ("motion", "change"), ("scene", "change")]
)
def test_what_the_plan_says_is_checked_and_mended(made: Path, tmp_path: Path, name: str, harm: str) -> None:
    import zarr

    url = copy_of(made, tmp_path)
    (chunk,) = [path for path in (url / name / "c").rglob("*") if path.is_file()]
    if harm == "change":
        array = zarr.open_group(url, mode="r+")[name]
        array[3] = np.asarray(array[3]) + 1  # type: ignore[index]
    elif harm == "truncate":
        chunk.write_bytes(chunk.read_bytes()[:20])
    else:
        chunk.unlink()
    assert any(name in fault for fault in check(DataStore.open(url)))
    make_dataset(tiny_recipe(), str(url), verify=True)
    assert check(DataStore.open(url)) == []
    assert files_of(url) == files_of(made)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("image/zarr.json", b"{"),
        ("image/zarr.json", None),
        ("zarr.json", b'{"zarr_format": 3, "node_type": "group", "attributes": {"kind": "mitsonar data set", "format": 1}}'),
    ],
)
def test_damaged_metadata_is_one_sentence(
    mitsonar: Command, made: Path, tmp_path: Path, name: str, content: bytes | None
) -> None:
    url = copy_of(made, tmp_path)
    (url / name).unlink()
    if content is not None:
        (url / name).write_bytes(content)
    for word in ("check", "info"):
        refused(mitsonar("dataset", word, url), "damaged")
    refused(mitsonar(*command(tmp_path, "--workers", 1, "--verify")), "damaged")


@pytest.mark.thorough
def test_killed_before_the_group_is_whole(made: Path, tmp_path: Path) -> None:
    """A file half written, or a group with arrays half made: begun anew."""
    url = tmp_path / "tiny.zarr"
    url.mkdir()
    (url / f"zarr.{uuid.uuid4().hex}.partial").write_bytes(b"{")  # as Zarr names it
    make_dataset(tiny_recipe(), str(url))
    assert files_of(url) == files_of(made)


def test_half_written_files_of_others_are_kept(tmp_path: Path) -> None:
    """A download, and what another program writes into a Zarr group of its own."""
    import zarr

    (tmp_path / "downloads").mkdir()
    (tmp_path / "downloads" / "film.partial").write_text("half a film")
    zarr.open_group(tmp_path / "other", mode="w")
    (tmp_path / "other" / f"zarr.{uuid.uuid4().hex}.partial").write_text("half a file")
    for name, words in (("downloads", "contains other files"), ("other", "not a mitsonar data set")):
        before = files_of(tmp_path / name)
        with pytest.raises(MitsonarError, match=words):
            make_dataset(tiny_recipe(), str(tmp_path / name))
        assert files_of(tmp_path / name) == before


def test_nothing_stays_of_what_cannot_be_made(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match="first frames are empty"):
        make_dataset(tiny_recipe(mount__pitch_deg=-35.0), str(tmp_path / "empty.zarr"))
    assert not (tmp_path / "empty.zarr").exists()


def test_what_only_looks_right_is_warned_of(tmp_path: Path) -> None:
    """Metres given as millimetres; a split without a training part is none of it."""
    result = make_dataset(
        tiny_recipe(
            flight__sideways_mm=0.02, flight__forward_mm=0.02, split={"by": "scene", "train": 0, "validation": 0, "test": 1}
        ),
        str(tmp_path / "still.zarr"),
        sequences=2,
    )
    assert [sentence for sentence in result.warnings if "in millimetres" in sentence]
    assert not [sentence for sentence in result.warnings if "split" in sentence]


@pytest.mark.parametrize("workers", [1, 2, 3, 7])
def test_workers_go_on_where_they_are(workers: int) -> None:
    """Every shard is handed out once, and a worker seldom leaves its stretch: elsewhere it must load a scene."""
    queue = Queue(list(range(100)))
    rng = np.random.default_rng(workers)
    speed = rng.uniform(0.5, 2, workers)
    ready = np.zeros(workers)
    result: dict[str, list[int]] = {str(number): [] for number in range(workers)}
    while queue:
        number = int(ready.argmin())
        result[str(number)].append(queue.next(str(number)))
        ready[number] += rng.uniform(0.8, 1.2) / speed[number]
    assert sorted(shard for mine in result.values() for shard in mine) == list(range(100))
    moves = sum(int((np.diff(mine) != 1).sum()) for mine in result.values())
    assert moves <= 4 * (workers - 1)


def test_shards_of_a_lost_worker_are_handed_out_again() -> None:
    queue = Queue([0, 1, 2])
    assert [queue.next("a"), queue.next("b")] == [0, 2]
    queue.forget(["b"])
    queue.give_back(0)
    assert [queue.next("b"), queue.next("b")] == [0, 1]
    assert not queue
    for _ in range(2):
        queue.give_back(1)
    queue.give_back(1)
    with pytest.raises(MitsonarError, match="again and again at shard 1"):
        queue.give_back(1)


@pytest.mark.e2e
@pytest.mark.thorough
def test_two_workers_make_the_same_bytes(made: Path, tmp_path: Path) -> None:
    done = by_itself(*command(tmp_path, "--workers", 2))
    assert done.returncode == 0, done.stderr
    assert files_of(tmp_path / "tiny.zarr") == files_of(made)


@pytest.mark.slow
@pytest.mark.e2e
def test_workers_of_a_scheduler_make_the_same_bytes_and_a_lost_one_is_replaced(made: Path, tmp_path: Path) -> None:
    """A scheduler by its address; one of its workers is killed while it renders, and nothing is lost."""
    environment = {**os.environ, "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "spawn"}

    def started(command: list[str]) -> subprocess.Popen[bytes]:
        quiet = subprocess.DEVNULL
        return subprocess.Popen(command, stdout=quiet, stderr=quiet, env=environment, cwd=tmp_path)

    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    place = tmp_path / "scheduler.json"
    scheduler = started([*dask, "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(place)])
    workers: list[subprocess.Popen[bytes]] = []
    try:
        address = _written(place, 90)["address"]
        worker = [
            sys.executable,
            "-m",
            "distributed.cli.dask_worker",
            address,
            "--nthreads",
            "1",
            "--no-dashboard",
            "--no-nanny",
        ]
        workers = [started(worker) for _ in range(2)]
        making = subprocess.Popen(
            [*PROGRAM, *command(tmp_path, "--scheduler", address)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        _wait(lambda: any((tmp_path / "tiny.zarr" / "seal" / "c").glob("*/*/*")), 150)
        workers[0].kill()
        _, output = making.communicate(timeout=180)
        assert making.returncode == 0, output
    finally:
        for process in [*workers, scheduler]:
            process.kill()
            process.wait()
    assert files_of(tmp_path / "tiny.zarr") == files_of(made)


def _written(path: Path, seconds: float) -> dict[str, str]:
    """What another process writes as JSON, once it has written all of it: the file is there before its content."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            return dict(json.loads(path.read_text()))
        except (FileNotFoundError, json.JSONDecodeError):
            assert time.monotonic() < deadline, f"{path.name} was not written in time"
            time.sleep(0.05)


def test_a_file_that_is_still_being_written_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "scheduler.json"

    def write_slowly() -> None:
        for text in ("", '{"address": "tcp', '{"address": "tcp://here"}'):
            time.sleep(0.15)
            path.write_text(text)

    writer = threading.Thread(target=write_slowly)
    writer.start()
    assert _written(path, 30) == {"address": "tcp://here"}
    writer.join()
    with pytest.raises(AssertionError, match="not written in time"):
        _written(tmp_path / "never.json", 0.1)


def _wait(until: Callable[[], bool], seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < deadline, "nothing came in time"
        time.sleep(0.05)


@pytest.mark.thorough
def test_no_scheduler_there(mitsonar: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mitsonar.datasets.make.CONNECT_TIMEOUT", "1s")
    done = mitsonar(*command(tmp_path, "--scheduler", "tcp://127.0.0.1:9"))
    refused(done, "no dask scheduler", "tcp://127.0.0.1:9")


@pytest.mark.posix
@pytest.mark.slow
@pytest.mark.e2e
def test_killed_at_ten_random_moments_and_finished_it_is_the_unbroken_one(made: Path, tmp_path: Path) -> None:
    """kill -9, whatever it is doing; then the same command is repeated until it finishes."""
    rng = np.random.default_rng(int(os.environ.get("MITSONAR_KILL_SEED", "1")))
    arguments, url = command(tmp_path, "--workers", 1), tmp_path / "tiny.zarr"
    stored: list[dict[str, float]] = []
    for moment in rng.uniform(0.8, 3.2, 10):
        process = subprocess.Popen([*PROGRAM, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(moment)
        process.send_signal(signal.SIGKILL)
        process.wait()
        stored.append({str(path): path.stat().st_mtime_ns for path in url.glob("seal/c/*/*/*")})
    done = by_itself(*arguments)
    assert done.returncode == 0, done.stderr
    assert files_of(url) == files_of(made)
    for before, after in zip(stored, [*stored[1:], stored[-1]], strict=True):
        assert before.items() <= after.items()  # nothing whole is made twice
    last = {str(path): path.stat().st_mtime_ns for path in url.glob("seal/c/*/*/*")}
    assert stored[-1].items() <= last.items()


def test_stopped_between_the_last_file_and_its_seal(made: Path, tmp_path: Path) -> None:
    """Whole shards are kept and sealed, and not remade. Partial shards are remade, and their remains are removed."""
    url = copy_of(made, tmp_path)
    store = DataStore.open(url)
    (url / store.group["seal"].metadata.encode_chunk_key((0, 0, 0))).with_name("x")  # type: ignore[union-attr]
    seal = url / "seal" / "c" / "0" / "0" / "0"
    seal.unlink()
    image = first_shard(store)
    before = image.stat().st_mtime_ns
    (image.parent / "0.abc.partial").write_bytes(b"half a file")
    (url / store.key("image", 1)).unlink()
    report = make_dataset(tiny_recipe(), str(url))
    assert report.new_shards == 1
    assert image.stat().st_mtime_ns == before
    assert files_of(url) == files_of(made)


def test_a_truncated_shard_is_found_and_mended(made: Path, tmp_path: Path) -> None:
    url = copy_of(made, tmp_path)
    store = DataStore.open(url)
    path = first_shard(store)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    (fault,) = check(store)
    assert store.key("image", 0) in fault
    assert "damaged" in fault
    assert make_dataset(tiny_recipe(), str(url)).new_shards == 1
    assert files_of(url) == files_of(made)
    assert check(DataStore.open(url)) == []


def test_a_flipped_bit_is_found_and_mended(made: Path, tmp_path: Path) -> None:
    url = copy_of(made, tmp_path)
    store = DataStore.open(url)
    path = first_shard(store)
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 4
    path.write_bytes(content)
    assert len(check(store)) == 1
    with pytest.raises(MitsonarError, match="image is damaged"):
        store.read("image", store.frames_of(0))
    assert make_dataset(tiny_recipe(), str(url)).new_shards == 0  # the size is right
    assert make_dataset(tiny_recipe(), str(url), verify=True).new_shards == 1
    assert files_of(url) == files_of(made)


def test_wrong_labels_are_found(made: Path, tmp_path: Path) -> None:
    import zarr

    for number, (name, index, value, words) in enumerate(
        [
            ("motion", (3, 0), 0.019, "labels differ from poses"),
            ("pose", (7, 0), 9.9, "labels differ|footprint|jumps"),
            ("sequence", 149, 77, "sequence is damaged"),
            ("motion", (4, 1), 0.0, "last frame"),
            ("range_m", 0, 1.0, "range_m"),
        ]
    ):
        url = copy_of(made, tmp_path / str(number))
        zarr.open_group(url, mode="r+")[name][index] = value  # type: ignore[index]
        faults = check(DataStore.open(url))
        assert faults
        assert any(any(word in fault for word in words.split("|")) for fault in faults), faults


@pytest.mark.e2e
@pytest.mark.thorough
def test_a_second_writer_is_told_and_changes_nothing(made: Path, tmp_path: Path) -> None:
    url = tmp_path / "tiny.zarr"
    script = f"""
import time, sys
from mitsonar.io.storage import Storage
with Storage({str(url)!r}).locked():
    print("locked", flush=True)
    time.sleep(60)
"""
    holder = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "locked\n"
        refused(by_itself(*command(tmp_path, "--workers", 1)), "another process is writing", "nothing was changed")
        assert files_of(url) == {"writer.lock": b""}
    finally:
        holder.kill()
        holder.wait()
    make_dataset(tiny_recipe(), str(url))  # the lock ended with its owner
    assert files_of(url) == files_of(made)


def test_another_data_set_is_not_overwritten(made: Path, tmp_path: Path) -> None:
    before = files_of(made)
    with pytest.raises(MitsonarError, match=r"was begun with seed 0, not 3: request the same settings"):
        make_dataset(tiny_recipe(seed=3), str(made))
    with pytest.raises(MitsonarError, match="begun with sequences 30, not 12"):
        make_dataset(tiny_recipe(), str(made), sequences=12)
    with pytest.raises(MitsonarError, match=r"begun with sonar\.range_bins 40, not 41; split\.by sequence, not scene"):
        make_dataset(tiny_recipe(sonar__range_bins=41, split={"by": "scene", "train": 1.0, "validation": 0.0}), str(made))
    assert files_of(made) == before
    (tmp_path / "mine").write_text("years of work")
    with pytest.raises(MitsonarError, match=r"contains other files \(mine\) and is kept"):
        make_dataset(tiny_recipe(), str(tmp_path))
    with pytest.raises(MitsonarError, match="is a file"):
        make_dataset(tiny_recipe(), str(tmp_path / "mine"))
    assert files_of(tmp_path) == {"mine": b"years of work"}


def test_a_data_set_begun_with_another_version_is_not_mixed(made: Path, tmp_path: Path) -> None:
    import zarr

    url = copy_of(made, tmp_path)
    group = zarr.open_group(url, mode="r+")
    group.attrs["versions"] = {**dict(group.attrs["versions"]), "mitsuba": "3.8.0"}  # type: ignore[arg-type]
    make_dataset(tiny_recipe(), str(url))  # finished: nothing would be mixed
    first_shard(DataStore.open(url)).unlink()
    with pytest.raises(MitsonarError, match=r"begun with mitsuba 3\.8\.0"):
        make_dataset(tiny_recipe(), str(url))
    group.attrs["versions"] = dict(DataStore.open(made).about["versions"])
    group.attrs["variant"] = "cuda_ad_mono"
    with pytest.raises(MitsonarError, match="cuda_ad_mono"):
        make_dataset(tiny_recipe(), str(url))


@pytest.mark.thorough
def test_an_unfinished_data_set_is_not_read_by_accident(tmp_path: Path) -> None:
    url = str(tmp_path / "tiny.zarr")
    recipe = tiny_recipe()

    def stop(frames: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_dataset(recipe, url, progress=stop)
    with pytest.raises(MitsonarError, match=r"not finished.*: run the same"):
        DataStore.open(url)
    store = DataStore.open(url, unfinished=True)
    assert info(store)["shards"] == f"1 of {store.shards}"
    (fault,) = check(store)
    assert f"not finished: {store.shards - 1} of {store.shards} shards are not written" in fault
    assert make_dataset(recipe, url).new_shards == store.shards - 1


@pytest.mark.slow
@pytest.mark.e2e
def test_a_full_disk_is_said_and_loses_nothing(made: Path, tmp_path: Path) -> None:
    """A real file system of 120 kB; after making room, the same command goes on."""
    small = tmp_path / "small"
    small.mkdir()
    mounted_there = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=120k", "tmpfs", str(small)], capture_output=True)
    if mounted_there.returncode:
        pytest.skip("mounting a small file system is not allowed here")
    try:
        for workers in (1, 2):
            refused(by_itself(*command(small, "--workers", workers, recipe=TINY)), "No space left on device")
            url = small / "tiny.zarr"
            assert not list(url.rglob("*.partial"))
            store = DataStore.open(url, unfinished=True)
            assert 0 < int(store.seals().any(axis=(1, 2)).sum()) < store.shards
        subprocess.run(["mount", "-o", "remount,size=10m", str(small)], check=True)
        done = by_itself(*command(small, "--workers", 1))
        assert done.returncode == 0, done.stderr
        assert files_of(url) == files_of(made)
    finally:
        subprocess.run(["umount", str(small)], check=True)


@pytest.mark.posix
@pytest.mark.slow
@pytest.mark.e2e
def test_a_worker_that_dies_again_and_again_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = f"""
import os, sys
import mitsonar.datasets.make as workers
from mitsonar.datasets.make import make_dataset
from mitsonar.config.data import array_names
from helpers import tiny_recipe
from mitsonar.errors import MitsonarError

def die(url, shard):
    os.kill(os.getpid(), 9)

if __name__ == "__main__":
    workers._work = die
    try:
        make_dataset(tiny_recipe(), {str(tmp_path / "tiny.zarr")!r}, workers=2)
    except MitsonarError as error:
        print(error)
"""
    (tmp_path / "script.py").write_text(script)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "script.py")],
        capture_output=True,
        text=True,
        timeout=200,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
    )
    # dask gives a worker up that dies before it is known to have started, which a busy machine may show
    assert re.search("(a worker was|workers were) lost .*out of memory.*fewer workers", done.stdout), (
        done.stdout + done.stderr
    )


# ---------------------------------------------------------------- object storage


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Any:
    """An S3 server on loopback, and the URL of a bucket on it."""
    import s3fs
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://{host}:{port}"),
        ("AWS_ACCESS_KEY_ID", "testing"),
        ("AWS_SECRET_ACCESS_KEY", "testing"),
        ("AWS_DEFAULT_REGION", "us-east-1"),
    ):
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    name = f"sonar{port}"
    s3fs.S3FileSystem().mkdir(name)
    yield f"s3://{name}"
    server.stop()
    s3fs.S3FileSystem.clear_instance_cache()


def listed(url: str) -> dict[str, int]:
    place = Storage(url)
    place.fs.invalidate_cache()
    return place.sizes()


def objects_of(url: str) -> dict[str, bytes]:
    place = Storage(url)
    place.fs.invalidate_cache()
    return {name: place.read(name) for name in place.sizes()}


@pytest.mark.slow
@pytest.mark.e2e
def test_to_and_from_object_storage(made: Path, bucket: str, tmp_path: Path) -> None:
    """Against a real S3 server: made, killed, gone on with, checked, read; the bytes are those of the folder."""
    url = f"{bucket}/data/tiny.zarr"
    arguments = command(tmp_path, "--workers", 1)
    arguments[arguments.index("-o") + 1] = url
    process = subprocess.Popen([*PROGRAM, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _wait(lambda: any(name.startswith("seal/c/") for name in listed(url)), 60)
    process.kill()
    process.wait()
    refused(by_itself(*arguments), "is being written by process", "nothing was changed")  # its last sign is seconds old
    place = Storage(url)
    lock = json.loads(place.read("writer.json"))
    place.write("writer.json", json.dumps({**lock, "time": lock["time"] - 1000}).encode())
    done = by_itself(*arguments)
    assert done.returncode == 0, done.stderr
    assert objects_of(url) == files_of(made)
    store = DataStore.open(url)
    assert check(store) == []
    np.testing.assert_array_equal(store.read("image", slice(4, 9)), DataStore.open(made).read("image", slice(4, 9)))
    damaged = store.key("image", 1)
    place.write(damaged, place.read(damaged)[:100])
    place.fs.invalidate_cache()
    assert [fault for fault in check(store) if damaged in fault]
    done = by_itself(*arguments)
    assert done.returncode == 0, done.stderr
    assert objects_of(url) == files_of(made)


@pytest.mark.thorough
def test_object_storage_holds_the_bytes_of_a_folder(made: Path, bucket: str) -> None:
    """Made there; a shard that is cut short is found and remade; read from there."""
    url = f"{bucket}/data/tiny.zarr"
    make_dataset(tiny_recipe(), url)
    store, place = DataStore.open(url), Storage(url)
    damaged = store.key("image", 0)
    place.write(damaged, place.read(damaged)[:100])
    place.fs.invalidate_cache()
    assert [fault for fault in check(store) if damaged in fault]
    assert make_dataset(tiny_recipe(), url).new_shards == 1
    assert objects_of(url) == files_of(made)
    np.testing.assert_array_equal(store.read("image", slice(4, 9)), DataStore.open(made).read("image", slice(4, 9)))


def test_objects_of_others_are_kept(bucket: str) -> None:
    place = Storage(f"{bucket}/mine")
    place.write("image/years.jpg", b"years of work")
    with pytest.raises(MitsonarError, match=r"contains other files \(image/years.jpg\) and is kept"):
        make_dataset(tiny_recipe(), f"{bucket}/mine")
    assert place.read("image/years.jpg") == b"years of work"


@pytest.mark.e2e
@pytest.mark.slow
def test_storage_that_does_not_answer(bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    arguments = command(tmp_path, "--workers", 1)
    arguments[arguments.index("-o") + 1] = "s3://bucket/tiny.zarr"
    refused(by_itself(*arguments), "cannot list s3://bucket/tiny.zarr", "endpoint")


@pytest.mark.thorough
def test_a_writer_that_was_taken_over_stops(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a long stall another has gone on: this one must neither write on nor take the lock back."""
    monkeypatch.setattr("mitsonar.io.storage.HEARTBEAT_S", 0.05)
    place = Storage(f"{bucket}/stalled.zarr")
    with place.locked() as still_ours:
        still_ours()
        second = json.dumps({"owner": "other 1 x", "time": time.time()}).encode()
        place.write("writer.json", second)
        time.sleep(1.0)
        with pytest.raises(MitsonarError, match="has taken over"):
            still_ours()
    assert place.read("writer.json") == second
    place.remove("writer.json")


def test_a_store_that_is_not_there(bucket: str, tmp_path: Path) -> None:
    for url in (f"{bucket}/none.zarr", "s3://nobucket/none.zarr", str(tmp_path / "none.zarr")):
        with pytest.raises(MitsonarError, match="no data set at"):
            DataStore.open(url)
    with pytest.raises(MitsonarError, match="cannot use"):
        Storage("gopher://somewhere/data.zarr")


# ---------------------------------------------------------------- command line


@pytest.mark.thorough
def test_commands_look_at_a_data_set(mitsonar: Command, made: Path, tmp_path: Path) -> None:
    shown = mitsonar("dataset", "info", made)
    assert shown.returncode == 0, shown.stderr
    for words in ("150", "thesis", "mean / noise", "bytes a frame"):
        assert words in shown.stdout
    table = json.loads(mitsonar("dataset", "info", made, "--json").stdout)
    level = table["levels"]["image"]
    image = DataStore.open(made).read("image") / 255
    assert level["signal_mean"] == pytest.approx(image[image > 0].mean(), rel=1e-6)
    assert level["signal_over_noise"]["high"] == pytest.approx(level["signal_mean"] / 0.137)
    recipe = mitsonar("dataset", "info", made, "--recipe").stdout
    (tmp_path / "again.yaml").write_text(recipe)
    again = mitsonar("dataset", "make", tmp_path / "again.yaml", "-o", made)
    assert again.returncode == 0, again.stderr
    assert "0 shards made" in again.stdout
    checked = mitsonar("dataset", "check", made)
    assert "all is well" in checked.stdout
    drawn = mitsonar("dataset", "show", made, "--samples", 2, cwd=tmp_path)
    assert drawn.returncode == 0, drawn.stderr
    assert (tmp_path / "tiny.png").stat().st_size > 20_000


def test_commands_answer_mistakes(mitsonar: Command, made: Path, tmp_path: Path) -> None:
    refused(mitsonar("dataset", "make", "rocky", "-o", tmp_path / "x"), "no recipe 'rocky'", "rocky-field")
    refused(mitsonar("dataset", "make", "ship-hull", "-o", tmp_path / "x", "--scale", 2), "--scale")
    refused(mitsonar("dataset", "make", "ship-hull", "-o", tmp_path / "x", "--scale", 0.1, "--sequences", 3), "contradict")
    refused(mitsonar("dataset", "make", "ship-hull", "-o", tmp_path / "x", "--workers", 0), "--workers")
    refused(mitsonar("dataset", "make", "ship-hull", "-o", tmp_path / "x", "--set", "sonar"), "KEY=VALUE")
    refused(mitsonar("dataset", "make", "ship-hull", "-o", tmp_path / "x", "--set", "a=[1"), "YAML")
    refused(mitsonar("dataset", "check", tmp_path / "none.zarr"), "no data set at")
    refused(mitsonar("dataset", "show", made, "--view", "q1"), "unknown view q1")
    damaged = copy_of(made, tmp_path)
    first_shard(DataStore.open(damaged)).write_bytes(b"")
    done = mitsonar("dataset", "check", damaged)
    refused(done, "1 faults", "--verify")
    assert "image/c/0/0/0 is damaged" in done.stdout
    assert not (tmp_path / "x").exists()
    listed = mitsonar("dataset", "recipes")
    assert "rocky-field-physical" in listed.stdout
    printed = mitsonar("dataset", "recipes", "ship-hull").stdout
    assert yaml.safe_load(printed)["world"]["family"] == "ship-hull"


@pytest.mark.thorough
def test_worlds_from_the_command_line(mitsonar: Command, tmp_path: Path) -> None:
    result = mitsonar(
        "world", "rocky-field", "--size-m", 4, "--a-side", "2,3", "--rotation-deg", "-10,10", "-o", tmp_path / "w"
    )
    assert result.returncode == 0, result.stderr
    assert "triangles in" in result.stdout
    rendered = mitsonar("render", tmp_path / "w" / "scene.xml", "-o", tmp_path / "run")
    assert rendered.returncode == 0, rendered.stderr
    refused(mitsonar("world", "rocky-field", "-o", tmp_path / "w"), "kept as it is")
    refused(mitsonar("world", "rocky-field", "--a-side", 3, "-o", tmp_path / "x"), "--a-side", "2 numbers")
    refused(mitsonar("world", "rocky-field", "--a-side", "3,2", "-o", tmp_path / "x"), "low <= high")
    refused(mitsonar("world", "rocky-field", "--seed", -1, "-o", tmp_path / "x"), "--seed")
    refused(mitsonar("world", "mesh", tmp_path / "none.glb", "-o", tmp_path / "x"), "none.glb")
    helped = mitsonar("world", "ship-hull", "--help").stdout
    for words in ("--tube-width-m", "[m]", "0,0.4", "(ours)"):
        assert words in helped.replace("\n", " "), helped


@pytest.mark.thorough
def test_sheets_of_vectors_and_views(tmp_path: Path) -> None:
    recipe = tiny_recipe(scenes=[{"count": 1, "sequences": 10}], **VARIANTS["segments"] | {"store": "vectors"})
    make_dataset(recipe, str(tmp_path / "data.zarr"))
    store = DataStore.open(tmp_path / "data.zarr")
    sheet_figure(store, samples=2).savefig(tmp_path / "first.png")
    sheet_figure(store, samples=2, view="c1").savefig(tmp_path / "second.png")
    assert (tmp_path / "first.png").read_bytes() != (tmp_path / "second.png").read_bytes()


def test_a_sheet_of_one_sequence_has_its_motion_once(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its motions are equal but for rounding, which no histogram can divide into bins."""
    stored = DataStore.read

    def read(store: DataStore, name: str, *where: Any) -> Any:
        values = stored(store, name, *where)
        if name == "motion":
            values = np.full_like(values, 0.0209)
            values[0] = np.nextafter(0.0209, 1)
        return values

    monkeypatch.setattr(DataStore, "read", read)
    sheet_figure(DataStore.open(made), samples=1)


def test_shards_can_be_made_by_hand(made: Path, tmp_path: Path) -> None:
    """What a worker does, without anybody to tell it: the function is enough."""
    url = copy_of(made, tmp_path)
    store = DataStore.open(url)
    first_shard(store).unlink()
    assert make_shard(DataStore.open(url, write=True, unfinished=True), 0) == 0
    forget()
    assert files_of(url) == files_of(made)
