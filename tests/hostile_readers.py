"""Readers of files, each with a small good file, how it is made hostile, and how it is read."""

from __future__ import annotations

import io
import shutil
import struct
import warnings
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from foreign_scenes import make_sdf, make_urdf
from helpers import HEARD, TINY, TINY_TRAINING, tiny_network, tiny_recipe, tiny_samples
from mutations import Rng, changed_arrays, changed_bytes, changed_json, changed_text, changed_value, npz
from recording_files import side_scan_echogram

from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.io.runs import RunDirectory, RunKind
from mitsonar.mapping.odometry_run import ODOMETRY, OdometryFolder
from mitsonar.mapping.sensors import SensorNoise, simulated_sensors
from mitsonar.motion.sensors import load_sensors, save_sensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.motion.utm import UtmOrigin
from mitsonar.records.frames import SonarFrames
from mitsonar.records.responses import ImpulseResponses
from mitsonar.simulation.runs import RENDERING, progress_of


@dataclass(frozen=True)
class Reader:
    """How one format is attacked.

    Attributes:
        make: writes good files into a folder.
        spoil: changes them there.
        read: reads them.
    """

    make: Callable[[Path], None]
    spoil: Callable[[Rng, Path], None]
    read: Callable[[Path], Any]


SONAR = Sonar(beams=4, range_bins=6, rays_per_beam=5, rays_across=1)


def frames() -> SonarFrames:
    rng = np.random.default_rng(0)
    shape = (3, 6, 4)
    return SonarFrames(
        image=rng.random(shape, dtype=np.float32),
        range_m=SONAR.range_m,
        bearing_rad=SONAR.bearing_rad,
        time_s=np.arange(3) / 10,
        sonar=SONAR,
        poses=rng.random((3, 6)),
        height_m=np.full(3, 2.5),
        shape_id=np.zeros(shape, np.int32),
        shadow=np.zeros(shape, np.uint8),
        about={"said": [1, 2.5, "x"]},
    )


def responses() -> ImpulseResponses:
    sonar = ChannelSonar(range_max=8.0, frequency_step_hz=40.0)
    shape = (2, len(sonar.receivers))
    return ImpulseResponses(
        response=np.ones((*shape, sonar.taps), np.complex64),
        time_s=np.arange(2.0),
        sonar=sonar,
        poses=np.zeros((2, 6)),
        velocity=np.zeros((2, 4)),
        height_m=np.full(2, 4.0),
        echoes=np.ones(shape, np.int64),
        dropped=np.zeros(shape, np.int64),
    )


# ---------------------------------------------------------------- ways to spoil


def spoil_file(name: str, how: Callable[[Rng, bytes], bytes]) -> Callable[[Rng, Path], None]:
    def spoil(rng: Rng, folder: Path) -> None:
        path = folder / name
        path.write_bytes(how(rng, path.read_bytes()))

    return spoil


def spoil_npz(name: str) -> Callable[[Rng, Path], None]:
    def how(rng: Rng, content: bytes) -> bytes:
        if rng.random() < 0.3:
            return changed_bytes(rng, content)
        with np.load(io.BytesIO(content)) as table:
            return npz(changed_arrays(rng, dict(table)))

    return spoil_file(name, how)


def spoil_tree(rng: Rng, folder: Path) -> None:
    """One or two files of a Zarr group."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    ours = sorted((path for path in paths if path.name == "zarr.json"), key=lambda path: len(path.parts))
    for _ in range(int(rng.integers(1, 3))):
        path = ours[0] if rng.random() < 0.4 else paths[int(rng.integers(len(paths)))]
        if rng.random() < 0.05:
            path.unlink(missing_ok=True)
        elif path.is_file():
            how = changed_json if path.name == "zarr.json" else changed_bytes
            try:
                path.write_bytes(how(rng, path.read_bytes()))
            except ValueError:  # changed before
                path.write_bytes(changed_bytes(rng, path.read_bytes()))


def spoil_yaml(name: str) -> Callable[[Rng, Path], None]:
    def how(rng: Rng, content: bytes) -> bytes:
        if rng.random() < 0.5:
            return changed_text(rng, content)
        return yaml.safe_dump(changed_value(rng, yaml.safe_load(content))).encode()

    return spoil_file(name, how)


# ---------------------------------------------------------------- frames and responses


def make_frames_zarr(folder: Path) -> None:
    from mitsonar.records.frames import FrameStore

    store = FrameStore.create(folder / "frames.zarr", 3, frames())
    store.write(0, frames())


def read_frames_zarr(folder: Path) -> None:
    from mitsonar.mapping.sources import open_frames

    SonarFrames.load(folder / "frames.zarr")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        open_frames(folder / "frames.zarr").read([0])


def resume_frames(folder: Path) -> None:
    from mitsonar.records.frames import FrameStore

    store = FrameStore.open(folder / "frames.zarr")
    store.check(3, SONAR, 1)


# ---------------------------------------------------------------- data sets


def make_store(folder: Path) -> None:
    from mitsonar.datasets.plan import Plan
    from mitsonar.datasets.store import PACKAGES, DataStore
    from mitsonar.io.runs import versions
    from mitsonar.io.storage import Storage

    recipe = tiny_recipe(sonar__beams=4, sonar__range_bins=6)
    plan = Plan.of(recipe, 10)
    about = {"gain": 1.0, "level_scale": 1.0, "variant": "llvm_ad_mono", "versions": versions(PACKAGES)}
    store = DataStore.create(Storage(folder / "data.zarr"), recipe, plan, about)
    store = DataStore.open(folder / "data.zarr", write=True, unfinished=True)
    for shard in range(store.shards):
        count = store.frames_of(shard).stop - store.frames_of(shard).start
        table = {name: np.ones((count, *one.shape), one.kind) for name, one in store.modality.stored.items()}
        store.write_shard(shard, table)
    store.finish()


def read_store(folder: Path) -> None:
    from mitsonar.datasets.store import DataStore

    store = DataStore.open(folder / "data.zarr")
    for name in ("pose", "motion", "sequence", "scene", *store.rendered, *store.modality.axes):
        store.read(name)
    store.missing()


def check_store(folder: Path) -> None:
    from mitsonar.datasets.make import check
    from mitsonar.datasets.store import DataStore

    check(DataStore.open(folder / "data.zarr"))


# ---------------------------------------------------------------- YAML


def make_recipe(folder: Path) -> None:
    (folder / "recipe.yaml").write_text(yaml.safe_dump(TINY))
    (folder / "heard.yaml").write_text(yaml.safe_dump(HEARD))


def read_recipe(folder: Path) -> None:
    from mitsonar.config.data import load_recipe

    load_recipe(folder / "recipe.yaml")
    load_recipe(folder / "heard.yaml")


def spoil_recipe(rng: Rng, folder: Path) -> None:
    spoil_yaml("recipe.yaml" if rng.random() < 0.6 else "heard.yaml")(rng, folder)


def make_sonar(folder: Path) -> None:
    fields = {"preset": "didson300", "name": "mine", "range_min": 1.0, "range_max": 9.0, "beams": 64, "jitter": False}
    (folder / "sonar.yaml").write_text(yaml.safe_dump(fields))
    (folder / "noise.yaml").write_text(yaml.safe_dump({"mean": 0.1, "std": 0.2, "scale": 0.3}))
    training = {"about": "x", "network": {"name": "posenet", "width": 0.25}, "epochs": 2.0, "noise": ["none", "low"]}
    (folder / "training.yaml").write_text(yaml.safe_dump(training))


def read_sonar(folder: Path) -> None:
    from mitsonar.acoustics.noise import load_noise
    from mitsonar.config.training import load_training_recipe
    from mitsonar.instruments.sounder import load_sonar

    load_sonar(folder / "sonar.yaml")
    load_noise(str(folder / "noise.yaml"))
    load_training_recipe(folder / "training.yaml")


def spoil_sonar(rng: Rng, folder: Path) -> None:
    spoil_yaml(str(rng.choice(["sonar.yaml", "noise.yaml", "training.yaml"])))(rng, folder)


def make_materials(folder: Path) -> None:
    table = {"law": "table", "strength_db": [-40.0 + k / 4 for k in range(91)], "frequency_max_hz": 2e6}
    plate = {"mu": 0.1, "reflection": 0.9, "roughness_m": 1e-4, "about": "a plate"}
    for name, fields in {"table": table, "plate": plate, "floor": {"material": "sand", "loss": 0.02}}.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(fields))


def read_materials(folder: Path) -> None:
    from mitsonar.acoustics.materials import material, sigma_table

    for name in ("table", "plate", "floor"):
        assert np.isfinite(sigma_table(material(folder / f"{name}.yaml"), 80e3)).all()


def spoil_materials(rng: Rng, folder: Path) -> None:
    spoil_yaml(str(rng.choice(["table.yaml", "plate.yaml", "floor.yaml"])))(rng, folder)


# ---------------------------------------------------------------- runs


ASKED: dict[str, Any] = {"scene": "x", "frames": 30, "sonar": SONAR.model_dump()}
TALLY: dict[str, Any] = {
    "frames": 10,
    "rays": {"inside": 5, "nearer": 0, "farther": 1, "missed": 2},
    "pixels": 9,
    "filled": 3,
    "saturated": 0,
    "worst": [1, 2],
    "empty": 1,
    "first_empty": [4, 0, 0, 0, 2],
    "cut": 0,
    "enough_m": 0.0,
}
STATE = {"frames_done": 10, "warnings": ["a"], "gain": 2.0, "tally": TALLY}


def begun(folder: Path, kind: RunKind, asked: dict[str, Any], **notes: Any) -> None:
    """The file of a run that was broken off."""
    run = RunDirectory.begin(folder, kind, asked)
    run.start(**notes)


def make_run(folder: Path) -> None:
    begun(folder, RENDERING, ASKED, **STATE)


def read_run(folder: Path) -> None:
    run = RunDirectory.begin(folder, RENDERING, ASKED, resume=True)
    if run.finished:
        return
    gain, tally = progress_of(run, SONAR, ASKED["frames"])
    assert 0 <= tally.frames <= 30
    assert 0 < gain < np.inf
    tally.warnings(Nearby(), np.zeros((30, 6)), np.zeros(30))


class Nearby:
    """A source whose returns lie outside the window, in any frame."""

    def window_range(self, pose: Any, ping: int, time_s: float) -> tuple[float, float]:
        return 0.1, 99.0

    def buried(self, pose: Any) -> str:
        return ""


def make_odometry(folder: Path) -> None:
    from mitsonar.estimation.estimator import Estimate
    from mitsonar.mapping.odometry_run import add_to_journal
    from mitsonar.motion.composition import Motion

    begun(folder, ODOMETRY, {"a": 1}, source="s", scale=None, seconds=1.5)
    estimate = Estimate(Motion(0.1, 0.2, 0.3), np.eye(3), True, "", {})
    for pair in range(3):
        add_to_journal(folder / "estimates.jsonl", {"pair": pair}, estimate)
        add_to_journal(folder / "loops.jsonl", {"first": pair, "second": 9, "guess": [0.1, 0.2, 0.3]}, estimate)


def make_sensors(folder: Path) -> None:
    noise = SensorNoise(1.0, 5.0, 0.02, 0.1, 2.0, (0.01, 0.1), rate_hz=5.0)
    path = Trajectory(np.linspace(np.zeros(6), np.ones(6), 4), np.arange(4.0))
    save_sensors(folder / "sensors.csv", simulated_sensors(path, noise))


def read_sensors(folder: Path) -> None:
    load_sensors(folder / "sensors.csv").motions(np.arange(4.0))


def read_odometry(folder: Path) -> None:
    OdometryFolder(RunDirectory.begin(folder, ODOMETRY, {"a": 1}, resume=True)).read_journals()


def spoil_odometry(rng: Rng, folder: Path) -> None:
    if rng.random() < 0.3:
        return spoil_file("run.json", changed_json)(rng, folder)
    path = folder / ("estimates.jsonl" if rng.random() < 0.5 else "loops.jsonl")
    first, *rest = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(changed_json(rng, first) + b"\n" + b"".join(rest))


# ---------------------------------------------------------------- checkpoints


def make_checkpoint(folder: Path) -> None:
    from mitsonar.networks.checkpoint import Checkpoint

    Checkpoint.of(tiny_network(), tiny_samples(), **TINY_TRAINING).save(folder / "network.ckpt")


def spoil_checkpoint(rng: Rng, folder: Path) -> None:
    import torch

    path = folder / "network.ckpt"
    if rng.random() < 0.4:
        path.write_bytes(changed_bytes(rng, path.read_bytes()))
        return
    table = torch.load(path, weights_only=True)
    weights = table.pop("weights")
    table = changed_value(rng, table)
    name = str(rng.choice(sorted(weights)))
    match int(rng.integers(6)):
        case 0:
            weights[name] = torch.zeros(1).expand(10**9)
        case 1:
            weights[name] = weights[name][..., None]
        case 2:
            weights[name] = torch.empty(10**12, device="meta")
        case _:
            pass
    if isinstance(table, dict):
        table["weights"] = weights
    torch.save(table, path)


def read_checkpoint(folder: Path) -> None:
    import torch

    from mitsonar.estimation.learned import answer_of
    from mitsonar.networks.checkpoint import Checkpoint

    result = Checkpoint.load(folder / "network.ckpt")
    network = result.build()
    result.rows(), result.coder, result.sonars, result.rmse, result.fixed
    answer_of(network, torch.zeros(1, 1, 40, 24))


# ---------------------------------------------------------------- meshes


def make_meshes(folder: Path) -> None:
    box = trimesh.creation.box()
    for kind in ("ply", "obj", "stl", "glb"):
        (folder / f"model.{kind}").write_bytes(_exported(box, kind))
    (folder / "text.ply").write_bytes(box.export(file_type="ply", encoding="ascii"))
    (folder / "model.serialized").write_bytes(serialized(box.vertices, box.faces))


def _exported(mesh: Any, kind: str) -> bytes:
    result = mesh.export(file_type=kind)
    return result.encode() if isinstance(result, str) else bytes(result)


def serialized(corners: Any, faces: Any, **counts: int) -> bytes:
    """A file of Mitsuba's own format with one mesh, version 4."""
    head = struct.pack("<I", 0x1000) + b"mesh\0"
    message = struct.pack("<QQ", counts.get("vertices", len(corners)), counts.get("triangles", len(faces)))
    packed = zlib.compress(head + message + np.asarray(corners, "<f4").tobytes() + np.asarray(faces, "<u4").tobytes())
    return struct.pack("<HH", 0x041C, 4) + packed + struct.pack("<QI", 0, 1)


CHECKED = {"model.ply": "ply", "text.ply": "ply", "model.obj": "obj", "model.serialized": "serialized"}


def spoil_mesh(rng: Rng, folder: Path) -> None:
    name = str(rng.choice(sorted(CHECKED)))
    text = name in ("text.ply", "model.obj")
    spoil_file(name, changed_text if text else changed_bytes)(rng, folder)


def read_meshes(folder: Path) -> None:
    from mitsonar.worlds.scene_check import _check_once, check_mesh

    _check_once.cache_clear()
    for name, kind in CHECKED.items():
        check_mesh(folder / name, kind)


def spoil_model(rng: Rng, folder: Path) -> None:
    name = str(rng.choice(["model.ply", "text.ply", "model.obj", "model.stl", "model.glb"]))
    spoil_file(name, changed_text if name in ("text.ply", "model.obj") else changed_bytes)(rng, folder)
    (folder / "chosen").write_text(name)


def read_model(folder: Path) -> None:
    from mitsonar.worlds.meshes import mesh_world

    chosen = folder / "chosen"
    mesh_world(folder / (chosen.read_text() if chosen.exists() else "model.ply"), floor=False)


# ---------------------------------------------------------------- scenes of other simulators


def make_foreign(folder: Path) -> None:
    make_urdf(folder)
    make_sdf(folder)


def spoil_sdf(rng: Rng, folder: Path) -> None:
    spoil_file(str(rng.choice(["harbour.sdf", "buoy/buoy.sdf", "buoy/model.config"])), changed_text)(rng, folder)


def read_foreign(path: Path) -> None:
    from mitsonar.bridges.model_import import imported_world

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        world = imported_world(path, joints={"shoulder": 0.5} if path.suffix == ".urdf" else {"hinge": 0.5})
    assert all(np.isfinite(mesh.vertices).all() for mesh in world.meshes)


# ---------------------------------------------------------------- recordings


def read_recording(path: Path) -> None:
    """Read all frames of a recording, and check that they can be."""
    from mitsonar import open_recording
    from mitsonar.recordings.open import detect_side_scan, open_ranges

    if detect_side_scan(path) is not None:
        read_side_scan(path)
        return
    ranges = open_ranges(path)
    if ranges is not None:
        assert (np.diff(ranges.time_s) > 0).all()
        for count, ping in zip(ranges.points, ranges.pings(), strict=True):
            assert ping.points.shape == (count, 3)
            assert np.isfinite(ping.points).all()
            assert not np.isinf(ping.intensity).any()
        return
    recording = open_recording(path)
    assert all("\n" not in note for note in recording.notes)
    for part in recording.parts:
        assert (np.diff(part.time_s) > 0).all()
        assert np.isfinite(part.time_s).all()
        for axis in (part.like.range_m, part.like.bearing_rad):
            assert np.isfinite(axis).all()
            assert (np.diff(axis) > 0).all()
        for frames in part.chunks():
            assert frames.image.dtype in (np.uint8, np.float32)
            if frames.image.dtype != np.uint8:
                assert np.isfinite(frames.image).all()
                assert frames.image.min() >= 0
                assert frames.image.max() <= 1
            assert np.isfinite(frames.to_linear().image).all()
            assert frames.poses is None or np.isfinite(frames.poses).all()


def read_side_scan(path: Path) -> None:
    """Read all pings of a side-scan, and check that they can be shown."""
    from mitsonar import open_side_scan
    from mitsonar.recordings.open import summary_lines, summary_of

    recording = open_side_scan(path)
    assert all("\n" not in line for line in summary_lines(summary_of(recording)))
    for part in recording.parts:
        assert (np.diff(part.time_s) > 0).all()
        assert np.isfinite(part.poses).all()
        echogram = part.read()
        assert np.isfinite(echogram.levels).all()
        assert echogram.levels.min() >= 0
        assert not (echogram.height_m <= 0).any()
        assert (np.diff(echogram.range_m) > 0).all()
        assert np.isfinite(echogram.decibels()).all()


# ---------------------------------------------------------------- trajectories and echoes


def make_tum(folder: Path) -> None:
    lines = [f"{k / 10} {k} 0 2.5 0 0 {np.sin(k / 20)} {np.cos(k / 20)}\n" for k in range(5)]
    (folder / "path.tum").write_text("# time x y z qx qy qz qw\n" + "".join(lines))


def read_tum(folder: Path) -> None:
    from mitsonar.motion.trajectory import Trajectory

    result = Trajectory.load_tum(folder / "path.tum")
    assert np.isfinite(result.poses).all()
    assert (np.diff(result.time_s) > 0).all()


def make_exr(folder: Path) -> None:
    from mitsonar.records.echoes import CHANNELS, Echoes, save_exr

    values = np.full(20, 0.5, np.float32)
    save_exr(folder / "e.exr", Echoes(**dict.fromkeys(CHANNELS, values)), SONAR)


def read_exr(folder: Path) -> None:
    from mitsonar.records.echoes import load_exr

    load_exr(folder / "e.exr", SONAR)


READERS: dict[str, Reader] = {
    "frames.npz": Reader(
        lambda folder: frames().save(folder / "frames.npz"),
        spoil_npz("frames.npz"),
        lambda folder: SonarFrames.load(folder / "frames.npz"),
    ),
    "responses.npz": Reader(
        lambda folder: responses().save(folder / "responses.npz"),
        spoil_npz("responses.npz"),
        lambda folder: ImpulseResponses.load(folder / "responses.npz"),
    ),
    "echogram.npz": Reader(
        lambda folder: side_scan_echogram(origin=UtmOrigin(19, False, 5e5, 5e6)).save(folder / "echogram.npz"),
        spoil_npz("echogram.npz"),
        lambda folder: read_side_scan(folder / "echogram.npz"),
    ),
    "frames.zarr": Reader(make_frames_zarr, spoil_tree, read_frames_zarr),
    "frames.zarr, resumed": Reader(make_frames_zarr, spoil_tree, resume_frames),
    "responses.zarr": Reader(
        lambda folder: responses().save(folder / "responses.zarr"),
        spoil_tree,
        lambda folder: ImpulseResponses.load(folder / "responses.zarr"),
    ),
    "data set": Reader(make_store, spoil_tree, read_store),
    "data set, checked": Reader(make_store, spoil_tree, check_store),
    "recipe": Reader(make_recipe, spoil_recipe, read_recipe),
    "sonar, noise, training": Reader(make_sonar, spoil_sonar, read_sonar),
    "material": Reader(make_materials, spoil_materials, read_materials),
    "run.json": Reader(make_run, spoil_file("run.json", changed_json), read_run),
    "odometry": Reader(make_odometry, spoil_odometry, read_odometry),
    "sensors": Reader(make_sensors, spoil_file("sensors.csv", changed_text), read_sensors),
    "checkpoint": Reader(make_checkpoint, spoil_checkpoint, read_checkpoint),
    "mesh of a scene": Reader(make_meshes, spoil_mesh, read_meshes),
    "user's model": Reader(make_meshes, spoil_model, read_model),
    "URDF": Reader(make_foreign, spoil_file("crane.urdf", changed_text), lambda folder: read_foreign(folder / "crane.urdf")),
    "SDF": Reader(make_foreign, spoil_sdf, lambda folder: read_foreign(folder / "harbour.sdf")),
    "trajectory": Reader(make_tum, spoil_file("path.tum", changed_text), read_tum),
    "echoes": Reader(make_exr, spoil_file("e.exr", changed_bytes), read_exr),
}


def attack(name: str, folder: Path, count: int, first: int = 0, readers: Mapping[str, Reader] = READERS) -> dict[str, int]:
    """So many mutants of a reader's files: how many were read and refused."""
    from mutations import outcome

    reader = readers[name]
    good, bad = folder / "good", folder / "bad"
    good.mkdir()
    reader.make(good)
    content = {path.relative_to(good): path.read_bytes() for path in sorted(good.rglob("*")) if path.is_file()}
    assert outcome(lambda: reader.read(_copied(content, bad))) == "read", "the good file is refused"
    result = {"read": 0, "refused": 0}
    for seed in range(first, first + count):
        _copied(content, bad)
        reader.spoil(np.random.default_rng([seed, *name.encode()]), bad)
        try:
            result[outcome(lambda: reader.read(bad))] += 1
        except BaseException as error:
            stored = folder / f"mutant_{seed}"
            shutil.copytree(bad, stored)
            raise AssertionError(
                f"{name}, mutant {seed}: {type(error).__name__}: {str(error)[:300]}; kept in {stored}"
            ) from error
    return result


def _copied(content: dict[Path, bytes], folder: Path) -> Path:
    """The good files again, whatever a mutant or its reader has made of them; folders stay, removing them is slow."""
    for path in [path for path in folder.rglob("*") if path.is_file() and path.relative_to(folder) not in content]:
        path.unlink()
    for path, bytes_ in content.items():
        there = folder / path
        there.parent.mkdir(parents=True, exist_ok=True)
        if not there.is_file() or there.read_bytes() != bytes_:
            there.write_bytes(bytes_)
    return folder
