"""Every layout is read by the tool that it is for."""

from __future__ import annotations

import json
import pickle
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import TINY, Command, axes, direction, files_of, refused, tiny_recipe
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as some
from numpy.typing import NDArray
from PIL import Image

from mitsonar.bridges.export_formats import DetectorViews, detector_recipe, export_to
from mitsonar.bridges.export_source import LabelledPictures, class_rules, compress_run_lengths, open_export, run_lengths
from mitsonar.errors import MitsonarError
from mitsonar.geometry.fan import nearest_cells
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.plotting.fans import FanPictures
from mitsonar.records.frames import FrameStore, SonarFrames, to_uint8
from mitsonar.simulation.scene import shape_names_in, shipped_scenes

FRAMES, BINS, BEAMS = 5, 40, 24
SONAR = Sonar(beams=BEAMS, range_bins=BINS, azimuth_fov_deg=60)

AMPHORA = shipped_scenes()["objects"].parent / "meshes" / "amphora.ply"

SCENE = f"""<scene version="3.0.0">
    <integrator type="echo"/>
    <shape type="rectangle" id="seabed"><transform name="to_world"><scale value="6"/></transform></shape>
    <shape type="cylinder" id="pillar0"><point name="p0" value="1,1,0"/><point name="p1" value="1,1,2"/>
        <float name="radius" value="0.4"/></shape>
    <shape type="cylinder" id="pillar1"><point name="p0" value="-2,1,0"/><point name="p1" value="-2,1,2"/>
        <float name="radius" value="0.4"/></shape>
    <shape type="sphere"><point name="center" value="0,-2,0.4"/><float name="radius" value="0.5"/></shape>
    <shape type="ply"><string name="filename" value="{AMPHORA}"/></shape>
</scene>
"""
"""Shapes with ids and without."""

ROCKS = {"family": "rocky-field", "size_m": 12, "a_side": [5, 10]}


@pytest.fixture(scope="module")
def frames() -> SonarFrames:
    """Frames with two barrels of one mesh and a wall on sand, which move from frame to frame."""
    rng = np.random.default_rng(8)
    image = rng.random((FRAMES, BINS, BEAMS), np.float32)
    shape = np.zeros((FRAMES, BINS, BEAMS), np.int32)
    part = np.zeros_like(shape)
    for k in range(FRAMES):
        shape[k, 5 + k : 12 + k, 3:8], part[k, 5 + k : 12 + k, 3:8] = 2, 1
        shape[k, 20:26, 10 + k : 15 + k], part[k, 20:26, 10 + k : 15 + k] = 2, 2
        shape[k, 30, 2:20] = 1
    shape[:, :2], part[:, :2], image[:, :2] = -1, -1, 0
    poses = np.array([[0.3 * k, 0.1 * k, 2.5, 0.4, 0.05 * k, 0.2 * k] for k in range(FRAMES)])
    names: dict[str, Any] = {"shape_names": ("sand", "wall", "barrels"), "object_names": ("", "barrels 1", "barrels 2")}
    time = 100 + np.arange(FRAMES) / 10
    return SonarFrames(image, SONAR.range_m, SONAR.bearing_rad, time, SONAR, poses, shape_id=shape, object_id=part, **names)


@pytest.fixture(scope="module")
def run(frames: SonarFrames, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    frames.save(folder / "frames.npz")
    return folder


# ---------------------------------------------------------------- COCO and YOLO


@pytest.mark.e2e
@pytest.mark.parametrize("picture", ["polar", "fan"])
def test_coco_reads_boxes_masks_and_classes(
    mitsonar: Command, run: Path, frames: SonarFrames, tmp_path: Path, picture: str
) -> None:
    coco_api = pytest.importorskip("pycocotools.coco")
    out = tmp_path / "coco"
    done = mitsonar("frames", "export", run, "--to", "coco", "-o", out, "--without", "sand", "--picture", picture)
    assert done.returncode == 0, done.stderr
    parts = {part: coco_api.COCO(str(out / "annotations" / f"{part}.json")) for part in ("train", "validation", "test")}
    assert {part: coco.getImgIds() for part, coco in parts.items()} == {"train": [1, 2, 3], "validation": [4], "test": [5]}
    fans = FanPictures(frames)
    for number in range(FRAMES):
        part_of, coco = next((part, coco) for part, coco in parts.items() if number + 1 in coco.getImgIds())
        assert {one["name"]: one["id"] for one in coco.loadCats(coco.getCatIds())} == {"wall": 1, "barrels": 2}
        message = coco.loadImgs([number + 1])[0]
        pixels = np.asarray(Image.open(out / "images" / part_of / message["file_name"]))
        assert pixels.shape == (message["height"], message["width"])
        shape, part = frames.shape_id[number], frames.object_id[number]  # type: ignore[index]
        wanted_pixels = to_uint8(frames.image[number])
        if picture == "fan":
            shape, part = nearest_cells(fans.fan, shape, -1), nearest_cells(fans.fan, part, -1)
            wanted_pixels = fans.picture(frames.image[number])
        np.testing.assert_array_equal(pixels, wanted_pixels)
        result = coco.loadAnns(coco.getAnnIds(imgIds=[number + 1]))
        assert {(one["category_id"], one["attributes"]["object_name"]) for one in result} == {
            (1, ""),
            (2, "barrels 1"),
            (2, "barrels 2"),
        }
        for one in result:
            mask = coco.annToMask(one).astype(bool)
            expected = (shape == one["category_id"]) & (part == one["attributes"]["object"])
            np.testing.assert_array_equal(mask, expected)
            assert one["area"] == expected.sum() == mask.sum()
            rows, columns = np.nonzero(expected)
            x, y, width, height = one["bbox"]
            assert (x, y, x + width, y + height) == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)


@given(some.arrays(np.bool_, st.tuples(st.integers(1, 40), st.integers(1, 40))))
@settings(max_examples=60, deadline=None)
def test_masks_are_those_of_the_tool(mask: NDArray[np.bool_]) -> None:
    masks = pytest.importorskip("pycocotools.mask")
    counts = compress_run_lengths(run_lengths(mask))
    assert counts.encode() == masks.encode(np.asfortranarray(mask.astype(np.uint8)))["counts"]


@pytest.mark.e2e
def test_yolo_has_a_line_an_object(mitsonar: Command, run: Path, frames: SonarFrames, tmp_path: Path) -> None:
    import yaml

    out = tmp_path / "yolo"
    words = ("frames", "export", run, "--to", "yolo", "--without", "sand")
    assert mitsonar(*words, "-o", out).returncode == 0
    message = yaml.safe_load((out / "data.yaml").read_text())
    places = {"train": "images/train", "val": "images/val", "test": "images/test"}
    assert message == {**places, "names": {0: "wall", 1: "barrels"}}
    for number, part in enumerate(["train", "train", "train", "val", "test"]):
        assert Image.open(out / "images" / part / f"{number:06d}.png").size == (BEAMS, BINS)
        rows = np.loadtxt(out / "labels" / part / f"{number:06d}.txt", ndmin=2)
        assert rows[:, 0].tolist() == [0, 1, 1]
        middle = [(2 + 9) / BEAMS, 30.5 / BINS, 18 / BEAMS, 1 / BINS]
        np.testing.assert_allclose(rows[0, 1:], middle, atol=1e-6)
        np.testing.assert_allclose(rows[1, 1:], [5.5 / BEAMS, (8.5 + number) / BINS, 5 / BEAMS, 7 / BINS], atol=1e-6)
    cv2 = pytest.importorskip("cv2")
    assert mitsonar(*words, "-o", tmp_path / "outlines", "--polygons").returncode == 0
    wall, *barrels = (tmp_path / "outlines" / "labels" / "train" / "000001.txt").read_text().splitlines()
    corners = np.array([(2, 30), (20, 30), (20, 31), (2, 31)]) / (BEAMS, BINS)  # one bin high, which has no outline
    np.testing.assert_allclose(np.array(wall.split(), float), [0, *corners.ravel()], atol=1e-6)
    for line in barrels:
        kind, *numbers = line.split()
        points = np.array(numbers, float).reshape(-1, 2) * (BEAMS, BINS) - 0.5
        drawn = cv2.fillPoly(np.zeros((BINS, BEAMS), np.uint8), [points.round().astype(np.int32)], 1)
        assert (frames.shape_id[1][drawn > 0] == int(kind) + 1).all()  # type: ignore[index]
        assert drawn.sum() in ((frames.object_id[1] == 1).sum(), (frames.object_id[1] == 2).sum())  # type: ignore[index]


def test_parts_of_an_object_are_one_outline(frames: SonarFrames, tmp_path: Path) -> None:
    """YOLO takes each line for an object: a barrel in three parts is one, and its outline holds them all."""
    shape = np.full(frames.image.shape, -1, np.int32)
    for rows, columns in ((slice(5, 9), slice(2, 6)), (slice(12, 20), slice(10, 14)), (slice(30, 31), slice(3, 9))):
        shape[:, rows, columns] = 2
    replace(frames, shape_id=shape, object_id=None).save(tmp_path / "frames.npz")
    source = open_export(tmp_path / "frames.npz", split=(0.5, 0.25, 0.25))
    export_to("yolo", source, tmp_path / "yolo", polygons=True, least_snr_db=-np.inf)
    (line,) = (tmp_path / "yolo" / "labels" / "train" / "000000.txt").read_text().splitlines()
    points = np.array(line.split()[1:], float).reshape(-1, 2) * (BEAMS, BINS) - 0.5
    cv2 = pytest.importorskip("cv2")
    drawn = cv2.fillPoly(np.zeros((BINS, BEAMS), np.uint8), [points.round().astype(np.int32)], 1)
    assert (drawn[shape[0] == 2] == 1).mean() > 0.9
    assert drawn.sum() < 2 * (shape[0] == 2).sum()


# ---------------------------------------------------------------- WebDataset and Hugging Face


@pytest.mark.e2e
def test_webdataset_decodes_samples(
    mitsonar: Command, run: Path, frames: SonarFrames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    webdataset = pytest.importorskip("webdataset")
    from mitsonar.bridges import export_formats

    monkeypatch.setattr(export_formats, "SAMPLES_PER_SHARD", 2)
    assert mitsonar("frames", "export", run, "--to", "webdataset", "-o", tmp_path / "wds").returncode == 0
    shards = sorted(map(str, (tmp_path / "wds").glob("train-*.tar")))
    assert [Path(one).name for one in shards] == [f"train-{k:06d}.tar" for k in range(3)]
    samples = list(webdataset.WebDataset(shards, shardshuffle=False).decode("pil"))
    assert [one["__key__"] for one in samples] == [f"{k:06d}" for k in range(FRAMES)]
    for number, one in enumerate(samples):
        np.testing.assert_array_equal(np.asarray(one["png"].convert("L")), to_uint8(frames.image[number]))
        assert one["json"]["time_s"] == frames.time_s[number]
        np.testing.assert_allclose(one["json"]["heading_deg"], np.degrees(0.2 * number))
        assert one["json"]["regions"]["name"] == ["sand", "wall", "barrels", "barrels"]
    import io
    import tarfile

    with tarfile.open(shards[0]) as tar:
        entry = tar.extractfile("000000.shape.png")
        assert entry is not None
        shape = np.asarray(Image.open(io.BytesIO(entry.read())))
    np.testing.assert_array_equal(shape, frames.shape_id[0] + 1)  # type: ignore[index]


@pytest.mark.e2e
@pytest.mark.thorough
def test_hugging_face_loads_pictures_and_metadata(
    mitsonar: Command, run: Path, frames: SonarFrames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    datasets = pytest.importorskip("datasets")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    out = tmp_path / "hf"
    assert mitsonar("frames", "export", run, "--to", "huggingface", "-o", out).returncode == 0
    data = datasets.load_dataset(str(out), split="train", cache_dir=str(tmp_path / "cache"))
    assert len(data) == FRAMES
    for number, row in enumerate(data):
        np.testing.assert_array_equal(np.asarray(row["image"].convert("L")), to_uint8(frames.image[number]))
        np.testing.assert_allclose([row["x_m"], row["pitch_deg"]], [0.3 * number, np.degrees(0.4)])
        assert row["objects"]["name"] == ["sand", "wall", "barrels", "barrels"]
        assert row["objects"]["bbox"][1] == [2, 30, 18, 1]


@pytest.mark.e2e
@pytest.mark.thorough
def test_croissant_reads_the_records(mitsonar: Command, run: Path, frames: SonarFrames, tmp_path: Path) -> None:
    croissant = pytest.importorskip("mlcroissant")
    out = tmp_path / "hf"
    assert mitsonar("frames", "export", run, "--to", "huggingface", "-o", out).returncode == 0
    data = croissant.Dataset(jsonld=str(out / "croissant.json"))
    records = list(data.records("train"))
    assert not data.metadata.ctx.issues.errors
    assert len(records) == FRAMES
    np.testing.assert_allclose([one["train/heading_deg"] for one in records], np.degrees(0.2 * np.arange(FRAMES)))
    assert [one["train/file_name"] for one in records] == [f"{k:06d}.png".encode() for k in range(FRAMES)]


# ---------------------------------------------------------------- KITTI and neusis


@pytest.mark.e2e
def test_kitti_poses_are_relative_to_the_first_frame(
    mitsonar: Command, run: Path, frames: SonarFrames, tmp_path: Path
) -> None:
    files = pytest.importorskip("evo.tools.file_interface")
    assert mitsonar("frames", "export", run, "--to", "kitti", "-o", tmp_path / "kitti").returncode == 0
    path = files.read_kitti_poses_file(str(tmp_path / "kitti" / "poses" / "00.txt"))
    assert path.num_poses == FRAMES
    assert path.check()[0]
    np.testing.assert_allclose(path.poses_se3[0], np.eye(4), atol=1e-12)
    poses = frames.poses
    assert poses is not None
    starboard, forward, up = axes(Pose(*poses[0]))
    for number, matrix in enumerate(path.poses_se3):
        step = poses[number, :3] - poses[0, :3]
        np.testing.assert_allclose(matrix[:3, 3], [step @ starboard, -step @ up, step @ forward], atol=1e-9)
        ahead = axes(Pose(*poses[number]))[1]
        np.testing.assert_allclose(matrix[:3, 2], [ahead @ starboard, -ahead @ up, ahead @ forward], atol=1e-9)
    times = np.loadtxt(tmp_path / "kitti" / "sequences" / "00" / "times.txt")
    np.testing.assert_allclose(times, np.arange(FRAMES) / 10, atol=1e-6)


@pytest.mark.e2e
def test_points_of_neusis_lie_where_ours_do(mitsonar: Command, run: Path, frames: SonarFrames, tmp_path: Path) -> None:
    """A pixel's point by the formulas of neusis (x forward, bearing growing with the column), against ours."""
    assert mitsonar("frames", "export", run, "--to", "neusis", "-o", tmp_path / "views").returncode == 0
    message = json.loads((tmp_path / "views" / "Config.json").read_text())["agents"][0]["sensors"][0]
    assert message["sensor_type"] == "ImagingSonar"
    angles = message["configuration"]
    across = np.radians(angles["Azimuth"])
    for number in range(FRAMES):
        state = pickle.loads((tmp_path / "views" / "Data" / f"{number:06d}.pkl").read_bytes())
        image, to_world = state["ImagingSonar"], state["PoseSensor"]
        assert image.shape == (BINS, BEAMS)
        for row, column in ((3, 0), (17, BEAMS - 1), (39, 7)):
            radius = angles["RangeMin"] + (row + 0.5) * (angles["RangeMax"] - angles["RangeMin"]) / BINS
            theta, phi = -across / 2 + (column + 0.5) * across / BEAMS, 0.07
            local = [radius * np.cos(theta) * np.cos(phi), radius * np.sin(theta) * np.cos(phi), radius * np.sin(phi), 1]
            theirs = (to_world @ local)[:3]
            beam = BEAMS - 1 - column
            assert image[row, column] == frames.image[number, row, beam]
            ours = frames.range_m[row] * direction(frames.sonar, frames.bearing_rad[beam], phi)
            turned = vehicle_rotation(frames.poses[number]).apply(ours)[0] + frames.poses[number, :3]  # type: ignore[index]
            np.testing.assert_allclose(theirs, turned, atol=1e-6)


@pytest.mark.parametrize(("layout", "first", "warns"), [("even", 0, False), ("sine", 0, True), ("even", 4, True)])
def test_neusis_warns_of_beams_that_it_places_elsewhere(
    frames: SonarFrames, tmp_path: Path, layout: str, first: int, warns: bool
) -> None:
    bearing = SONAR.replace(beam_layout=layout).bearing_rad[first:]
    named: dict[str, Any] = {"shape_id": None, "object_id": None, "shape_names": (), "object_names": ()}
    moved = replace(frames, image=frames.image[:, :, first:], bearing_rad=bearing, **named)
    moved.save(tmp_path / "frames.npz")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        export_to("neusis", open_export(tmp_path / "frames.npz"), tmp_path / "views")
    assert len(caught) == warns
    assert all("neusis places beams at even angles about the axis" in str(one.message) for one in caught)


# ---------------------------------------------------------------- sources, and the folder


@pytest.mark.e2e
def test_a_data_set_is_exported_by_its_split(mitsonar: Command, tmp_path: Path, variant: str) -> None:
    from mitsonar.datasets.make import make_dataset
    from mitsonar.datasets.store import DataStore

    recipe = tiny_recipe(labels=["shape_id"], split={"by": "sequence", "train": 0.5, "validation": 0.5})
    make_dataset(recipe, str(tmp_path / "tiny.zarr"), sequences=4)
    store = DataStore.open(str(tmp_path / "tiny.zarr"))
    out = tmp_path / "wds"
    done = mitsonar("dataset", "export", tmp_path / "tiny.zarr", "--to", "webdataset", "-o", out)
    assert done.returncode == 0, done.stderr
    counts = json.loads((out / "about.json").read_text())["samples"]
    assert counts == {"train": len(store) // 2, "validation": len(store) // 2}
    assert mitsonar("dataset", "export", tmp_path / "tiny.zarr", "--to", "kitti", "-o", tmp_path / "kitti").returncode == 0
    assert sorted(path.name for path in (tmp_path / "kitti" / "poses").iterdir()) == [f"{k:02d}.txt" for k in range(4)]
    refused(mitsonar("frames", "export", tmp_path / "tiny.zarr", "--to", "coco", "-o", out), "is a data set")
    refused(mitsonar("dataset", "export", tmp_path / "none", "--to", "coco", "-o", out), "no data set")


def test_a_long_run_on_disk_gives_the_same_files(frames: SonarFrames, run: Path, tmp_path: Path) -> None:
    store = FrameStore.create(tmp_path / "frames.zarr", FRAMES, frames)
    store.write(0, frames)
    split = (0.7, 0.15, 0.15)
    export_to("coco", open_export(tmp_path / "frames.zarr", split=split), tmp_path / "of_zarr")
    export_to("coco", open_export(run, split=split), tmp_path / "of_npz")
    ours, theirs = files_of(tmp_path / "of_zarr"), files_of(tmp_path / "of_npz")
    for table in (ours, theirs):
        for part in [name for name in table if name.endswith(".json")]:
            message = json.loads(table.pop(part))
            table[part] = json.dumps([message["images"], message["annotations"], message["categories"]]).encode()
    assert ours == theirs


def test_frames_of_a_long_run_keep_poses_and_attitudes(frames: SonarFrames, tmp_path: Path) -> None:
    assert frames.poses is not None
    tilted = replace(frames, attitude_rad=frames.poses[:, 3:] + 0.01)
    FrameStore.create(tmp_path / "frames.zarr", FRAMES, tilted).write(0, tilted)
    some = open_export(tmp_path / "frames.zarr").read(slice(1, 3))
    for name in ("poses", "attitude_rad", "shape_id"):
        assert np.array_equal(getattr(some, name), getattr(tilted, name)[1:3]), name


@pytest.mark.e2e
def test_what_cannot_be_exported_is_refused_and_leaves_nothing(
    mitsonar: Command, run: Path, frames: SonarFrames, tmp_path: Path
) -> None:
    (tmp_path / "there").mkdir()
    words = ("frames", "export", run, "-o")
    refused(mitsonar(*words, tmp_path / "there", "--to", "coco"), "exists and is kept")
    refused(mitsonar(*words, ".", "--to", "coco"), "exists and is kept")
    refused(mitsonar(*words, tmp_path / "new", "--to", "cocoa"), "unknown layout", "coco")
    refused(mitsonar(*words, tmp_path / "new", "--to", "coco", "--picture", "round"), "polar or fan")
    refused(mitsonar(*words, tmp_path / "new", "--to", "coco", "--without", "sandy"), "no shape is named", "sand")
    refused(mitsonar(*words, tmp_path / "new", "--to", "coco", "--polygons"), "--polygons")
    refused(mitsonar(*words, tmp_path / "new", "--to", "coco", "--classes", "sand"), "GLOB=CLASS")
    refused(mitsonar(*words, tmp_path / "new", "--to", "coco", "--classes", "*="), "no class is left")
    refused(mitsonar(*words, tmp_path / "new", "--to", "coco", "--least", "1000"), "no object is visible", "--least")
    refused(mitsonar(*words, tmp_path / "new", "--to", "coco", "--split", "0.5,0.5"), "3 numbers")
    refused(mitsonar(*words, tmp_path / "new", "--to", "coco", "--split", "0.5,0.5,0.5"), "add up to 1")
    bare = SonarFrames(frames.image, frames.range_m, frames.bearing_rad, frames.time_s, SONAR)
    bare.save(tmp_path / "bare.npz")
    refused(mitsonar("frames", "export", tmp_path / "bare.npz", "--to", "yolo", "-o", tmp_path / "new"), "--labels")
    refused(mitsonar("frames", "export", tmp_path / "bare.npz", "--to", "kitti", "-o", tmp_path / "new"), "no poses")
    assert {path.name for path in tmp_path.iterdir()} == {"there", "bare.npz"}
    assert mitsonar("frames", "export", tmp_path / "bare.npz", "--to", "webdataset", "-o", tmp_path / "new").returncode == 0


def test_an_export_that_breaks_off_leaves_nothing_and_a_killed_one_is_replaced(run: Path, tmp_path: Path) -> None:
    source, out = open_export(run, split=(0.7, 0.15, 0.15)), tmp_path / "out"

    def full(done: int) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        export_to("coco", source, out, progress=full)
    assert not list(tmp_path.iterdir())
    part = tmp_path / ".out.part"
    part.mkdir()
    with pytest.raises(MitsonarError, match="not an unfinished export of mitsonar"):
        export_to("coco", source, out)
    (part / ".mitsonar-export").touch()
    (part / "half").touch()
    export_to("coco", source, out)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert {path.name for path in out.iterdir()} == {"annotations", "images"}


def test_few_frames_are_read_at_a_time(frames: SonarFrames, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mitsonar.bridges import export_source

    monkeypatch.setattr(export_source, "CHUNK_BYTES", 2 * BINS * BEAMS * 12)
    sizes = [len(piece) for _, piece in open_export(run).chunks()]
    assert sizes == [2, 2, 1]


def test_small_regions_are_left_out(frames: SonarFrames) -> None:
    few = LabelledPictures(frames, least=19)
    assert [(one.kind, one.number) for one in few.regions(frames, 0)] == [(0, 0), (2, 1), (2, 2)]
    result: list[Any] = LabelledPictures(frames).regions(frames, 0)
    assert len(result) == 4


# ---------------------------------------------------------------- classes, and what stands above the noise


def test_names_that_differ_by_a_number_are_one_class_and_globs_decide_first(frames: SonarFrames) -> None:
    def classes_of(names: tuple[str, ...], rules: str = "") -> tuple[list[str], list[str]]:
        result = LabelledPictures(replace(frames, shape_names=names), classes=class_rules(rules))
        return result.classes, result.left_out

    assert classes_of(("seabed", "pillar0", "pillar1")) == (["seabed", "pillar"], [])
    assert classes_of(("mk82", "pot_1", "pot_02")) == (["mk82", "pot"], [])
    assert classes_of(("seabed", "pillar0", "ball"), "seabed*=, pillar*=post") == (["post", "ball"], ["seabed"])
    assert classes_of(("seabed", "pillar0", "ball"), "ball=ball,*=") == (["ball"], ["seabed", "pillar0"])
    with pytest.raises(MitsonarError, match="no shape is named 'pilar"):
        classes_of(("seabed", "pillar0", "ball"), "pilar*=post")


@pytest.mark.parametrize("raised_db", [0.0, 6.0])
def test_boxes_around_pure_noise_are_left_out(raised_db: float) -> None:
    """Rayleigh amplitudes: a barrel of 6 dB over the noise, and a wall 20 dB below it."""
    sonar = Sonar(beams=BEAMS, range_bins=BINS, model="coherent", frequency_hz=1e6, noise_level_db=-50.0, gain_exponent=2)
    rng = np.random.default_rng(3)
    expected = np.tile(10**-5 * sonar.range_m[:, None] ** 2, (1, BEAMS)) * 10 ** (raised_db / 10)
    shape = np.full((1, BINS, BEAMS), -1, np.int32)
    shape[0, 5:15, 3:10], shape[0, 22:30, 8:16] = 0, 1
    expected = expected + expected * np.where(shape[0] == 0, 10**0.6, np.where(shape[0] == 1, 0.01, 0))
    scale = 1e-2  # a level of 0.01 is full scale
    image = np.clip(expected * rng.exponential(size=expected.shape) / scale, 0, 1).astype(np.float32)[None]
    words: dict[str, Any] = {"level": "linear", "level_scale": scale, "shape_names": ("barrel", "wall")}
    one = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar, shape_id=shape, **words)
    result = LabelledPictures(one)
    assert [region.shape for region in result.regions(one, 0, raised_db)] == [0]
    assert result.faint == 1
    ratios = result.snr_db(one, 0, raised_db)
    assert ratios[0, 0] == pytest.approx(6, abs=1)
    assert ratios[1, 0] < 0
    assert len(LabelledPictures(one, least_snr_db=-np.inf).regions(one, 0)) == 2


def test_noise_of_other_models_is_that_of_cells_without_an_echo(frames: SonarFrames) -> None:
    image = np.full((1, BINS, BEAMS), 0.1, np.float32)
    shape = np.full(image.shape, -1, np.int32)
    shape[0, 5:15, 3:10], image[0, 5:15, 3:10], shape[0, 22:30, 8:16] = 0, 0.5, 1
    one = replace(frames.select(slice(0, 1)), image=image, shape_id=shape, object_id=None)
    assert LabelledPictures(one).snr_db(one, 0) == {(0, 0): pytest.approx(10 * np.log10(4)), (1, 0): -np.inf}
    image[shape < 0] = 0
    assert LabelledPictures(one).snr_db(one, 0) == {(0, 0): np.inf, (1, 0): np.inf}


def test_stretches_of_a_run_are_disjoint_and_cover_it(run: Path, tmp_path: Path) -> None:
    for split in ((0.7, 0.15, 0.15), (0.5, 0.5, 0.0), (0.0, 1.0, 0.0)):
        parts = open_export(run, split=split).part
        assert len(parts) == FRAMES
        assert set(parts) == {part for part, share in zip(("train", "validation", "test"), split, strict=True) if share}
    SonarFrames.load(run).select(slice(0, 2)).save(tmp_path / "two.npz")
    with pytest.raises(MitsonarError, match="need at least one frame each: got 2; give more"):
        open_export(tmp_path / "two.npz", split=(0.7, 0.15, 0.15))


@pytest.mark.e2e
def test_a_data_set_of_ones_own_scene_has_the_names_of_its_shapes(mitsonar: Command, tmp_path: Path, variant: str) -> None:
    import yaml

    from mitsonar.datasets.make import make_dataset

    (tmp_path / "scene.xml").write_text(SCENE)
    recipe = tiny_recipe(
        world={"family": "scene", "file": str(tmp_path / "scene.xml"), "size_m": 12},
        scenes=[{"count": 2, "sequences": 4}],
        labels=["shape_id"],
        split={"by": "sequence", "train": 0.5, "validation": 0.25, "test": 0.25},
    )
    make_dataset(recipe, str(tmp_path / "own.zarr"))
    out = tmp_path / "yolo"
    done = mitsonar("dataset", "export", tmp_path / "own.zarr", "--to", "yolo", "--without", "seabed", "-o", out)
    assert done.returncode == 0, done.stderr
    message = yaml.safe_load((out / "data.yaml").read_text())
    assert message["names"] == {0: "pillar", 1: "sphere", 2: "amphora"}
    pictures = {part: {path.name for path in (out / message[part]).iterdir()} for part in ("train", "val", "test")}
    assert sum(map(len, pictures.values())) == len(set().union(*pictures.values())) == 8 * recipe.flight.pings
    for part in pictures:
        for path in (out / "labels" / part).iterdir():
            rows = np.array(path.read_text().split(), float).reshape(-1, 5)
            assert set(rows[:, 0]) <= {0, 1, 2}
            assert (rows[:, 1:] > 0).all()
            assert (rows[:, 1:3] + rows[:, 3:] / 2 <= 1 + 1e-6).all()


def test_worlds_that_lack_a_kind_are_numbered_by_names(tmp_path: Path, variant: str) -> None:
    """Two groups of scenes whose shapes have other numbers: a name is the same class in both."""
    from mitsonar.datasets.make import make_dataset
    from mitsonar.datasets.store import DataStore

    pattern = {"family": "pattern"}
    recipe = tiny_recipe(
        world={}, labels=["shape_id"], scenes=[{"sequences": 1, "world": ROCKS}, {"sequences": 1, "world": pattern}]
    )
    make_dataset(recipe, str(tmp_path / "two.zarr"))
    source = open_export(tmp_path / "two.zarr")
    names = source.like.shape_names
    assert names == ("seabed", "cubes", "cylinders", "capsules", "blocks", "bars")
    store = DataStore.open(str(tmp_path / "two.zarr"))
    shape, half = store.read("shape_id"), len(store) // 2
    seen = source.read(slice(0, source.frames)).shape_id
    assert seen is not None
    np.testing.assert_array_equal(seen[:half], shape[:half])
    np.testing.assert_array_equal(seen[half:], np.array([0, 4, 5, -1])[shape[half:]])


# ---------------------------------------------------------------- a detector's data set, by one command

LITTLE = ("--set", "sonar.quality=draft", "--set", "sonar.beams=64", "--set", "sonar.range_bins=200", "--workers", "1")


@pytest.mark.e2e
@pytest.mark.thorough
def test_one_command_makes_a_detectors_data_set(mitsonar: Command, tmp_path: Path) -> None:
    import yaml

    coco_api = pytest.importorskip("pycocotools.coco")
    (tmp_path / "scene.xml").write_text(SCENE.replace('value="6"', 'value="7"'))
    words: tuple[object, ...] = (
        "dataset",
        "detector",
        tmp_path / "scene.xml",
        "--sonar",
        "oculus-m750d-1200khz",
        "--frames",
        12,
        *LITTLE,
    )
    words = (*words, "--noise-db", "0,20", "--least-snr-db", "0", "--split", "0.5,0.25,0.25")
    done = mitsonar(*words, "--to", "yolo", "--picture", "fan", "-o", tmp_path / "yolo")
    assert done.returncode == 0, done.stderr
    assert "ground, without a class: seabed" in done.stdout
    message = yaml.safe_load((tmp_path / "yolo" / "data.yaml").read_text())
    assert message["names"] == {0: "pillar", 1: "sphere", 2: "amphora"}
    pictures = {
        part: {path.name for path in (tmp_path / "yolo" / message[part]).iterdir()} for part in ("train", "val", "test")
    }
    assert {part: len(names) for part, names in pictures.items()} == {"train": 6, "val": 3, "test": 3}
    assert len(set().union(*pictures.values())) == 12
    sizes = set()
    for part, names in pictures.items():
        for name in names:
            sizes.add(Image.open(tmp_path / "yolo" / message[part] / name).size)
            label = (tmp_path / "yolo" / "labels" / part / name).with_suffix(".txt")
            rows = np.array(label.read_text().split(), float).reshape(-1, 5)
            assert set(rows[:, 0]) <= set(message["names"])
            assert (rows[:, 1:3] - rows[:, 3:] / 2 >= -1e-6).all()
            assert (rows[:, 1:3] + rows[:, 3:] / 2 <= 1 + 1e-6).all()
    assert len(sizes) == 1
    out = tmp_path / "coco"
    again = mitsonar(
        "dataset", "export", tmp_path / "yolo.zarr", "--to", "coco", "--classes", "seabed=,pillar*=post", "-o", out
    )
    assert again.returncode == 0, again.stderr
    coco = coco_api.COCO(str(out / "annotations" / "train.json"))
    assert [one["name"] for one in coco.loadCats(coco.getCatIds())] == ["post", "sphere", "amphora"]
    refused(mitsonar(*words, "--to", "yolo", "-o", tmp_path / "yolo"), "exists and is kept")


@pytest.mark.e2e
def test_what_a_detectors_data_set_cannot_be_made_of(mitsonar: Command, tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(SCENE)
    bare = SCENE[: SCENE.index('<shape type="cylinder')] + "</scene>"
    (tmp_path / "bare.xml").write_text(bare)
    words = ("dataset", "detector", tmp_path / "scene.xml", "-o", tmp_path / "out")
    named = (*words, "--sonar", "oculus-m750d-1200khz")
    refused(mitsonar(*words), "no sensor of type imaging_sonar")
    refused(mitsonar(*named, "--frames", 2), "--frames must be at least 3")
    refused(mitsonar(*named, "--to", "kitti"), "--to is coco or yolo")
    refused(mitsonar(*named, "--height", "0.1,2"), "--height must be at least 0.3 m")
    refused(mitsonar(*named, "--height", "2"), "--height takes 2 numbers")
    refused(mitsonar("dataset", "detector", tmp_path / "bare.xml", "-o", tmp_path / "out"), "contains only ground")
    assert {path.name for path in tmp_path.iterdir()} == {"scene.xml", "bare.xml"}


def test_worlds_of_a_recipe_are_split_by_scene(tmp_path: Path) -> None:
    (tmp_path / "rocks.yaml").write_text(json.dumps({**TINY, "world": ROCKS, "scenes": [{"count": 6, "sequences": 10}]}))
    views = DetectorViews(60, split=(0.5, 0.25, 0.25))
    recipe, rules, _ = detector_recipe(tmp_path / "rocks.yaml", views, "oculus-m750d-1200khz")
    assert (len(recipe.scenes), recipe.sequences, recipe.split.by, recipe.flight.pings) == (6, 60, "scene", 1)
    assert rules == [("seabed", "")]


def test_recipes_of_runs_give_random_views_and_those_of_scene_files_the_file(tmp_path: Path) -> None:
    assert detector_recipe("pattern-runs", DetectorViews(12))[0].flight.kind == "random"
    world = {"family": "scene", "file": "wreck/scene.xml", "size_m": 20}
    (tmp_path / "own.yaml").write_text(json.dumps({**TINY, "world": world}))
    with pytest.raises(MitsonarError, match=r"flies over the scene .*scene\.xml: give that file in place of the recipe"):
        detector_recipe(tmp_path / "own.yaml", DetectorViews(12))


def test_views_of_a_scene_are_clear_of_its_objects_and_drawn_in_pitch(tmp_path: Path, variant: str) -> None:
    from mitsonar.datasets.plan import Plan

    (tmp_path / "scene.xml").write_text(SCENE)
    views = DetectorViews(60, heights=(0.6, 1.8), pitch_deg=(5, 20), noise_db=(0, 6, 12))
    recipe, _, _ = detector_recipe(tmp_path / "scene.xml", views, "oculus-m750d-1200khz")
    plan = Plan.of(recipe)
    assert len(plan) == 60
    for x, y in ((1, 1), (-2, 1)):  # the pillars, 0.4 m thick and 0.3 m more
        assert (np.abs(plan.poses[:, :2] - (x, y)).max(axis=1) >= 0.7 - 1e-6).all()
    pitch = np.degrees(plan.poses[:, 3])
    assert pitch.min() >= 5
    assert pitch.max() <= 20
    assert np.ptp(pitch) > 10
    assert sorted({*recipe.noise_raised_db(plan.scene)}) == [0, 6, 12]
    assert len(np.unique(plan.poses, axis=0)) == 60
    again, _, _ = detector_recipe(tmp_path / "scene.xml", views, "oculus-m750d-1200khz")
    np.testing.assert_array_equal(Plan.of(again).poses, plan.poses)


def test_a_window_is_cut_to_the_ground_unless_it_is_chosen(tmp_path: Path, variant: str) -> None:
    (tmp_path / "scene.xml").write_text(SCENE)
    named = tmp_path / "scene.xml", DetectorViews(6, heights=(0.6, 1.8)), "oculus-m750d-750khz"
    cut, _, notes = detector_recipe(*named)
    assert cut.instrument.range_max < 20
    assert any("to fit into" in note for note in notes)
    chosen, _, notes = detector_recipe(*named, {"sonar.range_max": 3.0})
    assert (chosen.instrument.range_max, chosen.instrument.range_bins) == (3.0, load_sonar(named[2]).range_bins)
    assert not any("to fit into" in note for note in notes)


def test_visible_labels_reach_beyond_the_half_power_beam(variant: str) -> None:
    """A sphere 9 deg above the axis of a beam that is 12 deg wide: pictures show it, and so do these labels."""
    from helpers import floor, scene, sphere

    from mitsonar.simulation.pings import labels_above
    from mitsonar.simulation.simulator import Simulator

    words: dict[str, Any] = {"azimuth_fov_deg": 30, "elevation_fov_deg": 12, "range_min": 1, "range_max": 5}
    sonar = Sonar(beams=32, range_bins=100, model="physical", pattern="two_way", frequency_hz=9e5, quality="draft", **words)
    world = scene(floor=floor(), ball=sphere((0, 3, 2 + 3 * np.tan(np.radians(9))), 0.15))
    (pings,) = Simulator(world, sonar).pings(np.array([[0, 0, 2, 0, 0, 0.0]]), labels=True)
    gain = 0.9 / float(pings.levels.max())
    shown = labels_above(pings, gain, np.full((100, 1), 1e-4))
    ball = shape_names_in(world).index("ball")
    assert (shown["shape_id"] == ball).sum() > 5
    assert (shown["shape_id"] == ball).sum() <= (pings.labels["shape_id"] == ball).sum()
    assert shown["shadow"].shape == pings.levels.shape
