"""Files that are damaged or made to harm: every reader reads them well or refuses them by one sentence, and never ends."""

from __future__ import annotations

import io
import json
import struct
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers import TINY, Command, by_itself, refused
from hostile_readers import (
    ASKED,
    READERS,
    TALLY,
    attack,
    frames,
    make_checkpoint,
    make_exr,
    make_frames_zarr,
    make_meshes,
    make_odometry,
    make_run,
    make_store,
    read_exr,
    read_frames_zarr,
    read_meshes,
    read_odometry,
    read_run,
    read_store,
    responses,
    serialized,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as some
from mutations import changed_arrays, changed_bytes, limits, npz, outcome, with_part
from numcodecs import Pickle
from zarr.abc.codec import BytesBytesCodec
from zarr.registry import register_codec

import mitsonar
from mitsonar.acoustics.materials import material
from mitsonar.bridges.model_import import imported_world
from mitsonar.errors import MitsonarError, MitsonarWarning, short_repr
from mitsonar.io.storage import refuse_codecs
from mitsonar.records.frames import SonarFrames
from mitsonar.records.responses import ImpulseResponses
from mitsonar.worlds.meshes import mesh_world

OWN = {"data set, checked", "frames.zarr, resumed", "checkpoint", "run.json", "odometry"}
OWN |= {"recipe", "sonar, noise, training", "material"}
"""What this package writes itself, or pydantic checks."""

FOREIGN, FEW = 100, 12
"""Mutants in the tests that are run always: of files of others, and of its own or of Zarr, which takes 20 ms a mutant."""

learn = pytest.mark.learn


def cases() -> list[Any]:
    needs = {"checkpoint", "sonar, noise, training"}
    return [pytest.param(name, marks=learn if name in needs else ()) for name in READERS]


def refusal(read: Callable[[], Any]) -> str:
    """The sentence by which a reader refuses, within limits of time and memory."""
    with limits(), pytest.raises(MitsonarError) as error:
        read()
    return str(error.value)


# ---------------------------------------------------------------- paths

BY_PATH: dict[str, Callable[[str], object]] = {
    "checkpoint": lambda path: mitsonar.load_checkpoint(path),
    "frames": lambda path: mitsonar.load_frames(path),
    "SonarFrames": SonarFrames.load,
    "ImpulseResponses": ImpulseResponses.load,
    "trajectory": lambda path: mitsonar.Trajectory.load(path),
    "motions": lambda path: mitsonar.load_motions(path),
    "noise": lambda path: mitsonar.load_noise(path),
    "recipe": lambda path: mitsonar.load_recipe(path),
    "recording": lambda path: mitsonar.open_recording(path),
    "scene": lambda path: mitsonar.load_scene(path),
    "sensors": lambda path: mitsonar.load_sensors(path),
    "sonar": lambda path: mitsonar.load_sonar(path),
    "sounder": lambda path: mitsonar.load_sounder(path),
    "material": lambda path: material(path),
    "mesh": lambda path: mesh_world(f"{path}.obj"),
    "sdf": lambda path: imported_world(f"{path}.sdf"),
    "urdf": lambda path: imported_world(f"{path}.urdf"),
    "usd": lambda path: imported_world(f"{path}.usda"),
}
"""Readers that are given a path."""


@pytest.mark.parametrize("path", ["a" * 300, f"{'a' * 300}/b.yaml", "/".join(["a" * 200] * 30)], ids=len)
def test_a_path_that_is_too_long_is_refused(path: str, variant: str) -> None:
    """``Path.exists`` and its kind raise on such a path, where those of ``os.path`` answer."""
    for name, read in BY_PATH.items():
        assert path[:20] in refusal_without_limit(lambda read=read: read(path)), name  # type: ignore[misc]


@pytest.mark.posix
def test_a_link_to_itself_is_refused(tmp_path: Path, variant: str) -> None:
    for name, read in BY_PATH.items():
        path = tmp_path / name
        for ending in ("", ".obj", ".sdf", ".urdf", ".usda"):
            path.with_name(name + ending).symlink_to(path.with_name(name + ending))
        assert name in refusal_without_limit(lambda read=read, path=path: read(str(path)))  # type: ignore[misc]


def test_a_lone_carriage_return_in_a_path_is_refused(tmp_path: Path) -> None:
    (tmp_path / "path.csv").write_bytes(b"time_s,x,y,z,qx,qy,qz,qw\n0,1\r2,0,0,0,0,0,1\n")
    assert "path.csv: it is not a CSV table" in refusal(lambda: mitsonar.Trajectory.load(tmp_path / "path.csv"))


# ---------------------------------------------------------------- mutants


@pytest.mark.thorough
@pytest.mark.parametrize("name", cases())
def test_mutants_are_read_or_refused(name: str, tmp_path: Path) -> None:
    count = FEW if name in OWN or "zarr" in name or name == "data set" else FOREIGN
    result = attack(name, tmp_path, count)
    assert result["read"] + result["refused"] == count
    assert result["refused"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", cases())
def test_ten_thousand_mutants(name: str, tmp_path: Path) -> None:
    result = attack(name, tmp_path, 10_000, first=FOREIGN)
    print(f"\n{name}: {result['read']:,} read, {result['refused']:,} refused")
    assert min(result.values()) > 0


def test_the_harness_sees_what_it_looks_for() -> None:
    """Tracebacks, hangs and large allocations fail."""
    with pytest.raises(ZeroDivisionError):
        outcome(lambda: 1 / 0)
    with pytest.raises(MemoryError):
        outcome(lambda: np.ones(2**32))
    assert outcome(lambda: None) == "read"


def test_a_text_that_was_spoilt_is_spoilt_again() -> None:
    """The second change of a text of JSON finds no JSON there."""
    result = [changed_arrays(np.random.default_rng(seed), {"sonar": np.array('{"beams": 4,')}) for seed in range(30)]
    assert any(str(one.get("sonar", "")).startswith('{"be') for one in result)


# ---------------------------------------------------------------- hypothesis

values = some.recursive(
    some.none() | some.booleans() | some.integers(-(10**20), 10**20) | some.floats() | some.text(max_size=8),
    lambda inner: some.lists(inner, max_size=3) | some.dictionaries(some.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
quick = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)


@pytest.mark.thorough
@settings(quick, max_examples=10)
@given(key=some.sampled_from([*TINY["sonar"], "jitter", "seed", "sound_speed", "range_min", "range_max"]), value=values)
def test_any_value_of_a_sonar(key: str, value: Any) -> None:
    from mitsonar.instruments.sounder import sonar_from

    outcome(lambda: sonar_from({**TINY["sonar"], key: value}).bearing_rad)


@quick
@given(
    key=some.sampled_from(
        ["carrier_hz", "sampling_hz", "frequency_step_hz", "range_max", "bandwidth_hz", "receivers", "model"]
    ),
    value=values,
)
def test_any_value_of_a_channel(key: str, value: Any) -> None:
    from mitsonar.instruments.hydrophones import ChannelSonar

    outcome(lambda: ChannelSonar.create(**{key: value}).delay_s)


@quick
@given(content=some.text(max_size=60))
def test_any_text_as_yaml_and_json(content: str) -> None:
    from mitsonar.io.files import parse_json, parse_yaml

    outcome(lambda: parse_yaml(content, "it"))
    outcome(lambda: parse_json(content, "it"))


@quick
@given(content=some.binary(max_size=200))
def test_any_bytes_as_files(content: bytes, tmp_path: Path) -> None:
    from mitsonar.io.files import read_json
    from mitsonar.motion.trajectory import Trajectory
    from mitsonar.worlds.scene_check import check_mesh

    path = tmp_path / "any"
    path.write_bytes(content)
    (tmp_path / "run").mkdir(exist_ok=True)
    for read in (read_json, SonarFrames.load, ImpulseResponses.load, Trajectory.load_tum):
        outcome(lambda read=read: read(path))  # type: ignore[misc]
    for kind in ("ply", "obj", "serialized"):
        outcome(lambda kind=kind: check_mesh(path, kind))  # type: ignore[misc]


# ---------------------------------------------------------------- meshes that end Mitsuba


SCENE = """<scene version="3.0.0">
  <sensor type="imaging_sonar">
    <string name="preset" value="didson300"/>
    <integer name="beams" value="4"/><integer name="rays_per_beam" value="8"/><integer name="range_bins" value="8"/>
    <transform name="to_world"><lookat origin="0,-4,3" target="0,0,0" up="0,0,1"/></transform>
  </sensor>
  {}
</scene>"""

NAMED = {
    "plain": '<shape type="ply"><string name="filename" value="bad.ply"/></shape>',
    "parameter": '<default name="mesh" value="bad.ply"/><shape type="ply"><string name="filename" value="$mesh"/></shape>',
    "included": '<include filename="inner/part.xml"/>',
    "group": '<shape type="shapegroup" id="g"><shape type="ply"><string name="filename" value="bad.ply"/></shape></shape>'
    '<shape type="instance"><ref id="g"/></shape>',
}


def ply(index: int = 2, count: int = 3, vertices: int = 4, faces: int = 1, order: str = "little", x: float = 0.0) -> bytes:
    """Four vertices and one triangle."""
    letter = "<" if order == "little" else ">"
    head = f"ply\nformat binary_{order}_endian 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\n"
    head += f"property float z\nelement face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    body = struct.pack(f"{letter}12f", x, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0)
    return head.encode() + body + struct.pack(f"{letter}B3i", count, 0, 1, index)


@pytest.mark.parametrize("index", [4, -1, 10**5, 10**8, 2 * 10**9])
@pytest.mark.parametrize("order", ["little", "big"])
def test_an_index_beyond_the_vertices_is_refused(index: int, order: str, tmp_path: Path) -> None:
    from mitsonar.worlds.scene_check import check_mesh

    (tmp_path / "good.ply").write_bytes(ply(order=order))
    check_mesh(tmp_path / "good.ply", "ply")
    (tmp_path / "bad.ply").write_bytes(ply(index, order=order))
    assert "a triangle refers to vertex" in refusal(lambda: check_mesh(tmp_path / "bad.ply", "ply"))


@pytest.mark.parametrize("how", NAMED)
def test_a_scene_names_a_bad_mesh(how: str, tmp_path: Path, variant: str) -> None:
    """Through a default, an included file, a group: Mitsuba would read it and end the process."""
    from mitsonar.simulation.scene import load_scene

    (tmp_path / "bad.ply").write_bytes(ply(10**8))
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "part.xml").write_text(f'<scene version="3.0.0">{NAMED["plain"]}</scene>')
    (tmp_path / "scene.xml").write_text(SCENE.format(NAMED[how]))
    assert "a triangle refers to vertex 100,000,000" in refusal_without_limit(lambda: load_scene(tmp_path / "scene.xml"))
    (tmp_path / "bad.ply").write_bytes(ply(3))
    load_scene(tmp_path / "scene.xml")


def refusal_without_limit(read: Callable[[], Any]) -> str:
    with pytest.raises(MitsonarError) as error:
        read()
    return str(error.value)


def test_a_parameter_names_a_bad_mesh(tmp_path: Path, variant: str) -> None:
    from mitsonar.simulation.scene import load_scene

    (tmp_path / "good.ply").write_bytes(ply())
    (tmp_path / "other.ply").write_bytes(ply(99))
    (tmp_path / "scene.xml").write_text(SCENE.format(NAMED["parameter"].replace("bad.ply", "good.ply")))
    load_scene(tmp_path / "scene.xml")
    assert "refers to vertex 99" in refusal_without_limit(lambda: load_scene(tmp_path / "scene.xml", mesh="other.ply"))


@pytest.mark.parametrize("index", [10**5, 2 * 10**9])
def test_render_of_a_bad_mesh_is_one_sentence(index: int, mitsonar: Command, tmp_path: Path) -> None:
    """It was a segmentation fault, and a traceback."""
    (tmp_path / "bad.ply").write_bytes(ply(index))
    (tmp_path / "scene.xml").write_text(SCENE.format(NAMED["plain"]))
    refused(mitsonar("render", "scene.xml", "-o", "out", cwd=tmp_path), "bad.ply", "refers to vertex")


@pytest.mark.thorough
def test_render_of_a_bad_mesh_in_a_process_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "bad.ply").write_bytes(ply(10**8))
    (tmp_path / "scene.xml").write_text(SCENE.format(NAMED["plain"]))
    refused(by_itself("render", "scene.xml", "-o", "out", cwd=tmp_path), "bad.ply", "refers to vertex")


def test_amphora_mutants_never_end_mitsuba(tmp_path: Path) -> None:
    """Mutants that the check lets pass are given to Mitsuba, in processes of their own."""
    from mitsonar.simulation.scene import shipped_scenes
    from mitsonar.worlds.scene_check import check_mesh

    content = (shipped_scenes()["observatory"].parent / "meshes" / "amphora.ply").read_bytes()
    passed = 0
    for seed in range(40):
        path = tmp_path / f"{seed}.ply"
        path.write_bytes(changed_bytes(np.random.default_rng(seed), content))
        if outcome(lambda path=path: check_mesh(path, "ply")) == "read":  # type: ignore[misc]
            passed += 1
            if passed <= 2:
                script = (
                    "import sys, mitsuba as mi, drjit as dr; mi.set_variant('llvm_ad_mono');"
                    "s = mi.load_dict({'type': 'scene', 'a': {'type': 'ply', 'filename': sys.argv[1]}});"
                    "r = mi.Ray3f(mi.Point3f(0, 0, 9), mi.Vector3f(0, 0, -1)); print(s.ray_intersect(r).t)"
                )
                done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, timeout=120)
                assert done.returncode == 0, done.stderr[-500:]
    assert 0 < passed < 40


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (ply(count=4), "lists of vertex_indices must have 3"),
        (ply(vertices=10**9), "need more bytes than the file has"),
        (ply(faces=10**18), "need more bytes than the file has"),
        (ply(faces=0), "no triangles"),
        (ply(vertices=3), "bytes"),
        (ply(x=float("nan")), "finite"),
        (ply(x=float("inf")), "finite"),
        (ply() + b"more", "remain after"),
        (b"ply\n", "no PLY header"),
        (b"", "no PLY header"),
        (ply().replace(b"float x", b"float w"), "x, y and z"),
        (ply().replace(b"vertex_indices", b"vertex_indicos"), "vertex_index"),
        (ply().replace(b"element vertex 4", b"element vertex -4"), "header has an invalid line"),
        (ply().replace(b"element vertex 4", b"element vertex " + b"4" * 5000), "header has an invalid line"),
    ],
)
def test_a_ply_must_hold_what_it_promises(content: bytes, words: str, tmp_path: Path) -> None:
    from mitsonar.worlds.scene_check import check_mesh

    (tmp_path / "a.ply").write_bytes(content)
    output = refusal(lambda: check_mesh(tmp_path / "a.ply", "ply"))
    assert words in output
    assert "a.ply is damaged" in output


def test_other_meshes_must_hold_what_they_promise(tmp_path: Path) -> None:
    from mitsonar.worlds.scene_check import check_mesh

    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\n"
    box = np.eye(3)
    files = {
        "a.obj": (f"{corners}f 1 2 9\n".encode(), "refers to"),
        "b.obj": (f"{corners}vt 0 0\nf 1/1 2/1 3/7\n".encode(), "refers to"),
        "c.obj": (f"{corners}f 1 2\n".encode(), "3 corners"),
        "d.obj": (b"v 0 0 nan\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", "finite"),
        "e.serialized": (serialized(box, [[0, 1, 3]]), "refers to vertex 3"),
        "f.serialized": (serialized(box, [[0, 1, 2]], vertices=10**12), "more bytes"),
        "g.serialized": (serialized(box, [[0, 1, 2]], triangles=2**60), "more bytes"),
        "h.serialized": (serialized(box, [[0, 1, 2]])[:-4] + b"\xff\xff\xff\xff", "more than fit"),
    }
    for name, (content, words) in files.items():
        path = tmp_path / name
        path.write_bytes(content)
        assert words in refusal(lambda path=path: check_mesh(path, path.suffix[1:])), name  # type: ignore[misc]


def test_mitsuba_reads_what_the_check_was_given(tmp_path: Path, variant: str) -> None:
    """The serialized file of the tests is Mitsuba's format, and text and binary PLY are alike to the check."""
    import mitsuba as mi

    make_meshes(tmp_path)
    read_meshes(tmp_path)
    for name, kind in (("model.ply", "ply"), ("text.ply", "ply"), ("model.obj", "obj"), ("model.serialized", "serialized")):
        shape = mi.load_dict({"type": kind, "filename": str(tmp_path / name)})
        assert shape.face_count() == 12, name


def test_the_check_costs_milliseconds_once(tmp_path: Path) -> None:
    from mitsonar.simulation.scene import shipped_scenes
    from mitsonar.worlds.scene_check import _check_once, check_mesh

    path = shipped_scenes()["observatory"].parent / "meshes" / "observatory.ply"
    _check_once.cache_clear()
    begun = time.process_time()
    check_mesh(path, "ply")
    assert time.process_time() - begun < 0.1
    check_mesh(path, "ply")
    assert _check_once.cache_info().hits == 1


def test_a_deep_scene_is_refused(tmp_path: Path) -> None:
    """Mitsuba's XML parser calls itself: 10,000 elements within each other end the process."""
    deep = '<shape type="shapegroup">' * 10_000 + "</shape>" * 10_000
    (tmp_path / "deep.xml").write_text(f'<scene version="3.0.0">{deep}</scene>')
    (tmp_path / "outer.xml").write_text(
        '<scene version="3.0.0"><default name="f" value="deep"/><include filename="$f.xml"/></scene>'
    )
    from mitsonar.simulation.scene import load_scene

    for name in ("deep.xml", "outer.xml"):
        assert "deep" in refusal_without_limit(lambda name=name: load_scene(tmp_path / name))  # type: ignore[misc]


# ---------------------------------------------------------------- user's models


def test_a_model_of_infinite_extent(tmp_path: Path) -> None:
    from mitsonar.worlds.meshes import mesh_world

    text = "v -1.7e308 0 0\nv 1.7e308 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "far.obj").write_text(text)
    assert "far.obj" in refusal(lambda: mesh_world(tmp_path / "far.obj"))
    (tmp_path / "wide.obj").write_text(text.replace("1.7e308", "1e9"))
    assert "give the scale" in refusal(lambda: mesh_world(tmp_path / "wide.obj"))


def test_a_model_that_promises_millions_of_points(tmp_path: Path) -> None:
    from mitsonar.worlds.meshes import mesh_world

    (tmp_path / "many.ply").write_bytes(ply(vertices=169_000_000))
    assert "promises" in refusal(lambda: mesh_world(tmp_path / "many.ply"))
    make_meshes(tmp_path)
    content = (tmp_path / "model.glb").read_bytes()
    length = struct.unpack_from("<I", content, 12)[0]
    tree = json.loads(content[20 : 20 + length])
    tree["accessors"][0]["count"] = 169_000_000
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest)) + struct.pack("<I4s", len(text), b"JSON")
    (tmp_path / "many.glb").write_bytes(head + text + rest)
    assert "169,000,000" in refusal(lambda: mesh_world(tmp_path / "many.glb"))


# ---------------------------------------------------------------- Zarr


class Hostile(BytesBytesCodec):
    """A codec of a package that happens to be installed."""

    decoded = 0

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Hostile:
        return cls()

    def to_dict(self) -> dict[str, Any]:
        return {"name": "hostile"}

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: Any) -> int:
        return input_byte_length

    async def _decode_single(self, chunk_data: Any, chunk_spec: Any) -> Any:
        Hostile.decoded += 1
        return chunk_data


@pytest.mark.parametrize("name", ["frames.zarr", "data set"])
def test_a_codec_that_is_not_of_zarr_itself_is_refused_before_it_decodes(name: str, tmp_path: Path) -> None:
    register_codec("hostile", Hostile)
    make, read, array = {
        "frames.zarr": (make_frames_zarr, read_frames_zarr, "frames.zarr/image"),
        "data set": (make_store, read_store, "data.zarr/pose"),
    }[name]
    make(tmp_path)
    path = tmp_path / array / "zarr.json"
    about = json.loads(path.read_text())
    path.write_text(json.dumps(about | {"codecs": [*about["codecs"], {"name": "hostile"}]}))
    with pytest.raises(MitsonarError):
        read(tmp_path)
    assert Hostile.decoded == 0


def test_responses_in_the_format_that_may_hold_pickles_are_not_resumed(tmp_path: Path) -> None:
    import zarr

    group = zarr.open_group(tmp_path / "responses.zarr", mode="w", zarr_format=2)
    array = group.create_array("height_m", shape=(3,), dtype="f8", chunks=(3,), filters=[Pickle()], compressors=None)
    with pytest.raises(ValueError, match="version 2"):
        refuse_codecs(array)


# ---------------------------------------------------------------- npz


@pytest.mark.parametrize("name", ["sonar", "about"])
def test_text_that_is_not_unicode_is_refused(name: str, tmp_path: Path) -> None:
    """NumPy makes a text of any numbers, and pydantic ends on it with what is no ``Exception``."""
    responses().save(tmp_path / "responses.npz")
    table = dict(np.load(tmp_path / "responses.npz"))
    letters = np.atleast_1d(table[name]).view(np.uint32).copy()
    letters[1] = 0x110000
    table[name] = letters.view(table[name].dtype)[0]
    np.savez(tmp_path / "responses.npz", **table)
    assert f"{name}.npy holds text that is not Unicode" in refusal(lambda: ImpulseResponses.load(tmp_path / "responses.npz"))


BAD_FRAMES: dict[str, tuple[dict[str, Any], str]] = {
    "a scalar for an array": ({"range_m": np.array(3.0)}, "range_m must be float"),
    "text for an array": ({"image": np.array("x")}, "image must be"),
    "an array for text": ({"level": np.zeros(3)}, "level must be a single string"),
    "a scale of nan": ({"level_scale": np.array(np.nan)}, "level_scale must be a finite number"),
    "complex pixels": ({"image": np.zeros((3, 6, 4), complex)}, "image must be"),
    "pixels of nan": ({"image": np.full((3, 6, 4), np.nan, np.float32)}, "nan or inf"),
    "negative pixels": ({"image": np.full((3, 6, 4), -1, np.float32)}, "must lie in 0"),
    "pixels above 1": ({"image": np.full((3, 6, 4), 2, np.float32)}, "0..1"),
    "ranges that fall": ({"range_m": np.arange(6.0)[::-1].copy()}, "must increase"),
    "ranges of inf": ({"range_m": np.array([1, 2, 3, 4, 5, np.inf])}, "nan or inf"),
    "bearings that fall": ({"bearing_rad": -np.arange(4.0)}, "must"),
    "times that go back": ({"time_s": np.array([0.0, 2.0, 1.0])}, "must not decrease"),
    "times of nan": ({"time_s": np.array([0.0, np.nan, 1.0])}, "nan or inf"),
    "poses of five": ({"poses": np.zeros((3, 5))}, "poses must be float"),
    "poses of inf": ({"poses": np.full((3, 6), np.inf)}, "nan or inf"),
    "a negative height": ({"height_m": np.array([1.0, -2.0, 1.0])}, "must lie in 0"),
    "labels of floats": ({"shape_id": np.zeros((3, 6, 4))}, "shape_id must be int"),
    "shadow of 7": ({"shadow": np.full((3, 6, 4), 7, np.uint8)}, "0..2"),
    "a list as sonar": ({"sonar": np.array("[1]")}, "sonar is not a JSON object"),
    "deep JSON": ({"sonar": np.array("[" * 100_000)}, "sonar is not JSON"),
    "a huge integer": ({"sonar": np.array('{"beams": ' + "9" * 5000 + "}")}, "sonar"),
    "about a list": ({"about": np.array("[1]")}, "about"),
}


@pytest.mark.parametrize("name", BAD_FRAMES)
def test_frames_that_cannot_be(name: str, tmp_path: Path) -> None:
    change, words = BAD_FRAMES[name]
    path = tmp_path / "frames.npz"
    frames().save(path)
    with np.load(path) as table:
        path.write_bytes(npz({**table, **change}))
    assert words in refusal(lambda: SonarFrames.load(path))


BAD_RESPONSES: dict[str, tuple[dict[str, Any], str]] = {
    "a scalar": ({"response": np.array(1j)}, "response must be complex"),
    "floats": ({"response": np.zeros((2, 4, 200))}, "response must be complex"),
    "nan": ({"velocity": np.full((2, 4), np.nan)}, "nan or inf"),
    "negative counts": ({"echoes": np.full((2, 4), -1)}, "must lie in 0"),
    "counts of floats": ({"echoes": np.ones((2, 4))}, "echoes must be int"),
    "times that go back": ({"time_s": np.array([1.0, 0.0])}, "must not decrease"),
    "deep JSON": ({"sonar": np.array("[" * 100_000)}, "sonar is not JSON"),
}


@pytest.mark.parametrize("name", BAD_RESPONSES)
def test_responses_that_cannot_be(name: str, tmp_path: Path) -> None:
    change, words = BAD_RESPONSES[name]
    path = tmp_path / "responses.npz"
    responses().save(path)
    with np.load(path) as table:
        path.write_bytes(npz({**table, **change}))
    assert words in refusal(lambda: ImpulseResponses.load(path))


def header(shape: str, descr: str = "<f8") -> bytes:
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.parametrize(
    "part",
    [
        header("(1000000000000,)"),
        header("(-1, 3)"),
        header("(3,)", "|O"),
        header("(" * 200 + ")" * 200),
        header(f"({'9' * 6000},)"),
        b"\x93NUMPY\x09\x00",
        b"",
    ],
)
def test_an_npz_promises_no_more_than_its_bytes(part: bytes, tmp_path: Path) -> None:
    path = tmp_path / "frames.npz"
    frames().save(path)
    path.write_bytes(with_part(path.read_bytes(), "time_s.npy", part))
    assert "cannot read frames" in refusal(lambda: SonarFrames.load(path))


def test_a_part_that_would_unpack_beyond_memory(tmp_path: Path) -> None:
    """The list of parts says 2 TB of a part that has 20 bytes."""
    path = tmp_path / "frames.npz"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("image.npy", b"0" * 1000)
        file.filelist[0].file_size = 2**41
    path.write_bytes(buffer.getvalue())
    assert "more than its compressed bytes can hold" in refusal(lambda: SonarFrames.load(path))


# ---------------------------------------------------------------- Zarr


def changed_metadata(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def set_attributes(folder: Path, **fields: Any) -> None:
    changed_metadata(folder / "zarr.json", lambda value: value["attributes"].update(fields))


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stores")
    make_store(folder)
    return folder / "data.zarr"


@pytest.fixture
def spoilt(data_set: Path, tmp_path: Path) -> Path:
    import shutil

    return Path(shutil.copytree(data_set, tmp_path / "data.zarr"))


@pytest.mark.parametrize(
    "fields",
    [
        *({"frames": value} for value in (10**12, 10**18, 1e300, "50", 49)),
        *({"sequences": 10**12}, {"shard_frames": 0}, {"chunk_frames": None}, {"level_scale": -1}),
        *({"scenes": value} for value in ([], None, [{"number": 0, "group": 9, "seed": 0, "sequences": 10}])),
        *({"recipe": {"name": []}}, {"versions": 5}, {"finished": "yes"}),
    ],
    ids=str,
)
def test_attributes_of_a_data_set_that_cannot_be(fields: dict[str, Any], spoilt: Path) -> None:
    """``frames`` of 10^12 hung the check, of 10^18 ended the process."""
    from mitsonar.datasets.store import DataStore

    set_attributes(spoilt, **fields)
    assert "damaged" in refusal(lambda: DataStore.open(spoilt))


def test_check_of_a_promise_of_10_to_the_12_frames(spoilt: Path, mitsonar: Command) -> None:
    set_attributes(spoilt, frames=10**12)
    refused(mitsonar("dataset", "check", spoilt), "damaged")


@pytest.mark.parametrize(
    ("name", "length"), [("image", 10**12), ("sequence", 10**18), ("seal", 0), ("range_m", -1), ("range_m", 1e300)]
)
def test_arrays_of_a_data_set_of_another_shape(name: str, length: Any, spoilt: Path) -> None:
    from mitsonar.datasets.store import DataStore

    changed_metadata(spoilt / name / "zarr.json", lambda value: value["shape"].__setitem__(0, length))
    store = DataStore.open(spoilt)
    assert name in refusal(lambda: store.read(name))


@pytest.mark.parametrize("length", [0, -1, 10**15])
def test_chunks_of_a_data_set_that_cannot_be(length: int, spoilt: Path) -> None:
    from mitsonar.datasets.store import DataStore

    def change(value: dict[str, Any]) -> None:
        value["chunk_grid"]["configuration"]["chunk_shape"][0] = length

    changed_metadata(spoilt / "pose" / "zarr.json", change)
    store = DataStore.open(spoilt)
    assert "pose" in refusal(lambda: store.read("pose"))


def test_numbers_of_sequences_that_cannot_be(spoilt: Path) -> None:
    """``bincount`` would ask for memory by the largest."""
    import zarr

    from mitsonar.datasets.store import DataStore

    group: Any = zarr.open_group(spoilt, mode="r+")
    group["sequence"][3] = 2**31 - 1
    assert "sequence is damaged" in refusal(lambda: DataStore.open(spoilt).read("sequence"))


@pytest.mark.parametrize("rows", [10**12, 10**18, 0])
def test_frames_of_a_run_of_10_to_the_12_rows(rows: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    make_frames_zarr(tmp_path)
    for name in ("image", "time_s", "poses", "height_m", "shape_id", "shadow"):
        changed_metadata(tmp_path / "frames.zarr" / name / "zarr.json", lambda value: value["shape"].__setitem__(0, rows))
    assert "frames.zarr" in refusal(lambda: SonarFrames.load(tmp_path / "frames.zarr"))
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("done", [10**12, -1, "3"])
def test_frames_done_of_a_run_that_cannot_be(done: Any, tmp_path: Path) -> None:
    make_frames_zarr(tmp_path)
    set_attributes(tmp_path / "frames.zarr", frames_done=done)
    assert "frames_done" in refusal(lambda: SonarFrames.load(tmp_path / "frames.zarr"))


def test_a_run_without_frames_has_none_to_read(tmp_path: Path) -> None:
    """The index of a frame that is not there was a traceback."""
    from mitsonar.mapping.sources import load_frames, open_frames

    make_frames_zarr(tmp_path)
    path = tmp_path / "frames.zarr"
    assert f"{path} has no frame 3: it holds 3, numbered from 0" in refusal(lambda: open_frames(path).read([0, 3]))
    assert "has no frame -1" in refusal(lambda: open_frames(path).read([-1]))
    set_attributes(path, frames_done=0)
    with pytest.warns(MitsonarWarning, match="0 of 3 frames written"):
        source = open_frames(path)
    assert f"{path} has no frame 0: it holds 0" in refusal(lambda: source.read([0]))
    with pytest.warns(MitsonarWarning, match="0 of 3 frames written"):
        assert load_frames(path).image.shape == (0, 6, 4)


def test_a_shard_without_a_seal_is_sealed_by_its_writer_only(spoilt: Path) -> None:
    """Who only reads was asked to write the seal, a traceback."""
    from mitsonar.datasets.store import SEAL, DataStore

    store = DataStore.open(spoilt, write=True)
    store.array(SEAL)[0] = 0
    assert DataStore.open(spoilt).missing() == [0]
    assert not DataStore.open(spoilt).seals()[0].any()
    assert store.missing() == []
    assert DataStore.open(spoilt).missing() == []


# ---------------------------------------------------------------- YAML and JSON


LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefghi", "bcdefghij", strict=True)
)
MERGES = "a: &a {k: 1}\n" + "".join(
    f"{name}: &{name} {{<<: [{', '.join([f'*{before}'] * 9)}]}}\n"
    for before, name in zip("abcdefghi", "bcdefghij", strict=True)
)
HOSTILE_YAML = {
    "5,000 digits": "beams: " + "9" * 5000,
    "5,000 hexadecimal digits": "beams: 0x" + "f" * 5000,
    "a list for a number": "beams: [1, 2]",
    "a table for a number": "beams: {a: 1}",
    "itself": "beams: &a [*a]",
    "itself as a key": "&a ? *a : 1",
    "laughs": LAUGHS,
    "laughs by merging": MERGES,
    "deep": "beams: " + "[" * 5000,
    "deep and whole": "beams: " + "[" * 100 + "]" * 100,
    "python": "beams: !!python/object/apply:os.system ['true']",
    "an empty integer": "beams: !!int ''",
    "a date that cannot be": "beams: 2001-99-99",
    "keys of numbers": "1: 2",
    "a key of 900 letters": "x" * 900 + ": 1",
    "a key of 5,000 letters": "? " + "x" * 5000 + "\n: 1",
    "a byte of 0": "beams: \0",
    "large": "name: " + "x" * 2**21,
    "nan": "range_min: .nan",
    "inf": "range_max: .inf",
}


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *(("recipe", name) for name in HOSTILE_YAML),
        *(
            (kind, name)
            for kind in ("sonar", "noise", "training")
            for name in ("laughs", "itself as a key", "python", "large")
        ),
    ],
)
def test_yaml_made_to_harm(kind: str, name: str, tmp_path: Path) -> None:
    from mitsonar.acoustics.noise import load_noise
    from mitsonar.config.data import load_recipe
    from mitsonar.instruments.sounder import load_sonar

    path = tmp_path / f"{kind}.yaml"
    path.write_text(HOSTILE_YAML[name])
    read: dict[str, Callable[[Any], Any]] = {"recipe": load_recipe, "sonar": load_sonar, "noise": load_noise}
    if kind == "training":
        pytest.importorskip("torch")
        from mitsonar.config.training import load_training_recipe

        read["training"] = load_training_recipe
    begun = time.monotonic()
    assert len(refusal(lambda: read[kind](str(path)))) < 2000
    assert time.monotonic() - begun < 10


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("seed", 10**400), ("frames", [1]), ("flight.pings", {"a": 1}), ("flight.height_m", "x")),
        *(("sonar.beams", float("nan")), ("world.size_m", None), ("split.seed", 10**400)),
    ],
)
def test_values_of_a_recipe_that_cannot_be(key: str, value: Any) -> None:
    import copy

    from mitsonar.config.data import recipe_from, set_key

    fields = copy.deepcopy(TINY)
    set_key(fields, key, value)
    assert len(refusal(lambda: recipe_from(fields))) < 1000


LONG = "long" * 2000


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("world.family", LONG), ("receivers", [{"name": f"{LONG} "}]), ("segments", [LONG]), ("sonar.quality", LONG)),
        *((f"sonar.{LONG}", 1), (f"flight.{LONG}", 1), (f"world.{LONG}", 1), ("sonar.preset", LONG)),
    ],
    ids=lambda value: short_repr(value)[:20],
)
def test_long_words_of_a_recipe_are_cut(key: str, value: Any) -> None:
    """A refusal repeated a stranger's word whole."""
    import copy

    from mitsonar.config.data import recipe_from, set_key

    fields = copy.deepcopy(TINY)
    set_key(fields, key, value)
    assert len(refusal(lambda: recipe_from(fields))) < 1000


def test_long_words_of_frames_and_data_sets_are_cut(spoilt: Path, tmp_path: Path) -> None:
    from mitsonar.datasets.store import DataStore

    path = tmp_path / "frames.npz"
    frames().save(path)
    with np.load(path) as table:
        path.write_bytes(npz({**table, "level": np.array(LONG)}))
    assert len(refusal(lambda: SonarFrames.load(path))) < 1000
    set_attributes(spoilt, format=LONG)
    assert len(refusal(lambda: DataStore.open(spoilt))) < 1000


def test_aliases_that_help_are_read(tmp_path: Path) -> None:
    from mitsonar.instruments.sounder import load_sonar

    (tmp_path / "s.yaml").write_text("range_min: &near 1.0\nrange_max: 9\nazimuth_fov_deg: *near\n")
    assert load_sonar(tmp_path / "s.yaml").azimuth_fov_deg == 1.0


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"a":' * 5000, '{"a": ' + "9" * 5000 + "}", '{"a": 1' + "0" * 400 + "}", "[]", "\0"]
)
def test_json_made_to_harm(text: str, tmp_path: Path) -> None:
    from mitsonar.io.files import read_json

    (tmp_path / "a.json").write_text(text)
    assert "a.json" in refusal(lambda: read_json(tmp_path / "a.json"))


@pytest.mark.posix
def test_a_device_that_never_ends() -> None:
    from mitsonar.io.files import read_yaml

    assert "larger than" in refusal(lambda: read_yaml("/dev/zero", "recipe"))


@pytest.mark.parametrize("value", ["3", 3.0, True, None, [3], 2**63, 10**5000, float("nan"), -1], ids=short_repr)
def test_what_is_no_count_is_refused(value: Any) -> None:
    from mitsonar.io.files import whole_number

    assert refusal(lambda: whole_number(value, "beams")).startswith("beams must be a whole number in 0..2^63: got ")
    assert whole_number(2**63 - 1, "beams") == 2**63 - 1


NO_NUMBERS: list[Any] = ["3", True, None, [3.0], float("nan"), float("inf"), -float("inf"), 10**400, -(10**5000)]


@pytest.mark.parametrize("value", NO_NUMBERS, ids=short_repr)
def test_what_is_no_finite_number_is_refused(value: Any) -> None:
    from mitsonar.io.files import finite_number

    assert refusal(lambda: finite_number(value, "gain")).startswith("gain must be a finite number: got ")
    for number in (0, 2.0):
        output = refusal(lambda number=number: finite_number(number, "gain", above=0, below=2))  # type: ignore[misc]
        assert output == f"gain must be a finite number above 0 below 2: got {number}"
    assert finite_number(1, "gain", above=0, below=2) == 1.0


@pytest.mark.parametrize(
    "content", ["[" * 100_000, "[]", "\0", '{"owner": "a"}', '{"owner": "a", "time": 1' + "0" * 400 + "}", '{"time": NaN}']
)
def test_a_writer_that_nobody_could_be_is_replaced(content: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who says that it writes an object storage; deep JSON was a traceback."""
    from mitsonar.io.storage import Storage

    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    place = Storage("memory://hostile")
    place.write("writer.json", content.encode())
    with place.locked() as still_ours:
        still_ours()


# ---------------------------------------------------------------- run.json


BAD_STATES: dict[str, dict[str, Any]] = {
    **{f"frames_done {value}": {"frames_done": value} for value in ("3", 31, 9)},
    **{f"gain {value}": {"gain": value} for value in (0, float("nan"))},
    "no tally": {"tally": None},
    "tally of texts": {"tally": {**TALLY, "pixels": "9"}},
    "worst frame": {"tally": {**TALLY, "worst": [1, 99]}},
    "an empty frame that is not told": {"tally": {**TALLY, "first_empty": []}},
    "more saturated pixels than pixels": {"tally": {**TALLY, "pixels": 0, "filled": 0, "saturated": 1}},
    "asked": {"asked": [1]},
    "another key": {"more": 1},
}


def changed_run(folder: Path, **changes: Any) -> None:
    changed_metadata(folder / "run.json", lambda value: value.update(changes))


@pytest.mark.parametrize("name", BAD_STATES)
def test_a_run_that_cannot_go_on(name: str, tmp_path: Path) -> None:
    """Counts of another type were tracebacks on --resume."""
    make_run(tmp_path)
    read_run(tmp_path)
    changed_run(tmp_path, **BAD_STATES[name])
    output = refusal(lambda: read_run(tmp_path))
    assert "damaged" in output
    assert "--overwrite" in output


def test_a_run_without_gain_cannot_be_resumed(tmp_path: Path) -> None:
    make_run(tmp_path)
    for name, words in (("gain", "has no gain"), ("tally", "tally must hold")):
        before = (tmp_path / "run.json").read_bytes()
        changed_metadata(tmp_path / "run.json", lambda value, name=name: value.pop(name))  # type: ignore[misc]
        assert words in refusal(lambda: read_run(tmp_path))
        (tmp_path / "run.json").write_bytes(before)


def test_what_differs_is_said_in_one_short_line(tmp_path: Path) -> None:
    """Keys and values are a stranger's: of any length, with ends of lines."""
    make_run(tmp_path)
    changed_run(tmp_path, asked={**ASKED, "k" * 9000: 1, "line\nline": "a\nb"})
    output = refusal(lambda: read_run(tmp_path))
    assert "line line a b, not None" in output
    assert len(output) < 1000


def test_an_odometry_that_cannot_go_on(tmp_path: Path) -> None:
    make_odometry(tmp_path)
    before = (tmp_path / "run.json").read_bytes()
    for change in ({"asked": [1]}, {"asked": 5}, {"factors": [None]}, {"seconds": "1"}, {"workers": 1.5}):
        changed_run(tmp_path, **change)
        assert "damaged" in refusal(lambda: read_odometry(tmp_path))
        (tmp_path / "run.json").write_bytes(before)
    good: dict[str, Any] = {"pair": 0, "motion": [0, 0, 0], "covariance": None, "valid": True, "reason": ""}
    lines: list[dict[str, Any]] = [
        {"pair": "1"},
        {"pair": -1},
        {"motion": [1]},
        {"motion": [1, 2, float("nan")]},
        {"covariance": [[1]]},
        {"about": 3},
    ]
    lines += [{"valid": 1}, {"reason": None}, {"covariance": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]}]
    for line in lines:
        (tmp_path / "estimates.jsonl").write_text(json.dumps(good | line) + "\n")
        assert "line 1 is damaged" in refusal(lambda: read_odometry(tmp_path))


@pytest.mark.posix
def test_a_journal_that_never_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_odometry(tmp_path)
    (tmp_path / "estimates.jsonl").unlink()
    (tmp_path / "estimates.jsonl").symlink_to("/dev/zero")
    monkeypatch.setattr("mitsonar.mapping.odometry_run.LARGEST_JOURNAL", 1000)
    assert "larger than 1,000 bytes" in refusal(lambda: read_odometry(tmp_path))


def test_answers_that_promise_more_than_is_there(tmp_path: Path) -> None:
    """A comparison is gone on with: its tables of answers are a stranger's too."""
    from mitsonar.estimation.compare import Answers, kept_answers

    folder, methods = kept_answers(tmp_path / "out", {"a": 1}), {"flow": None}
    folder.keep("high", "none", {"flow": Answers.unasked(4)})
    assert folder.load("high", "none", methods, 4)["flow"].ms.shape == (4,)  # type: ignore[arg-type, index]
    path = tmp_path / "out" / "answers-high-none.npz"
    path.write_bytes(with_part(path.read_bytes(), "flow/ms.npy", header("(1000000000000,)")))
    assert "is damaged" in refusal(lambda: folder.load("high", "none", methods, 4))  # type: ignore[arg-type]
    changed_run(tmp_path / "out", finished="no")
    assert "remove the folder" in refusal(lambda: kept_answers(tmp_path / "out", {"a": 1}))


@pytest.mark.parametrize("height", ["3", -1.0, float("nan")])
def test_a_height_of_an_odometry_that_cannot_be(height: Any, tmp_path: Path) -> None:
    from mitsonar.mapping.odometry_run import OdometryFolder

    make_odometry(tmp_path)
    changed_run(tmp_path, finished=True, asked={"height_m": height})
    assert "height_m must be a finite number" in refusal(lambda: OdometryFolder.open(tmp_path).height_m)
    changed_run(tmp_path, asked={"height_m": 3})
    assert OdometryFolder.open(tmp_path).height_m == 3.0


# ---------------------------------------------------------------- checkpoints, echoes, trajectories


@learn
@pytest.mark.parametrize("how", ["expanded", "meta", "sparse", "wide", "frames", "rmse"])
def test_checkpoints_that_ask_for_too_much(how: str, tmp_path: Path) -> None:
    """An expanded tensor of a few bytes asked for 4 GB."""
    import torch

    from mitsonar.networks.checkpoint import Checkpoint

    make_checkpoint(tmp_path)
    path = tmp_path / "network.ckpt"
    table = torch.load(path, weights_only=True)
    name = next(iter(table["weights"]))
    match how:
        case "expanded":
            table["weights"][name] = torch.zeros(1).expand(10**9)
        case "meta":
            table["weights"][name] = torch.empty(10**12, device="meta")
        case "sparse":
            table["weights"][name] = torch.eye(3).to_sparse()
        case "wide":
            table["options"]["width"] = 500.0
        case "frames":
            table["arrangement"]["frames"] = 10**9
        case _:
            table["options"]["size"] = [10**6, 10**6]
    torch.save(table, path)
    refusal(lambda: Checkpoint.load(path).build())


@learn
def test_an_answer_of_another_arity(tmp_path: Path) -> None:
    import torch

    from mitsonar.estimation.learned import answer_of
    from mitsonar.networks.checkpoint import Checkpoint

    make_checkpoint(tmp_path)
    checkpoint = Checkpoint.load(tmp_path / "network.ckpt")
    network, image = checkpoint.build(), torch.zeros(1, 1, 40, 24)
    assert "cannot take" in refusal(lambda: answer_of(network, (image, image, image)))
    assert "its labels are" in refusal(lambda: checkpoint.decode(torch.zeros(1, 7)))
    assert "its labels are" in refusal(lambda: checkpoint.decode((image, image)))  # type: ignore[arg-type]


def test_echoes_that_promise_more_than_is_there(tmp_path: Path) -> None:
    make_exr(tmp_path)
    path = tmp_path / "e.exr"
    content = path.read_bytes()
    place = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    path.write_bytes(content[: place + 8] + struct.pack("<ii", 2**30, 2**30) + content[place + 16 :])
    assert "e.exr" in refusal(lambda: read_exr(tmp_path))
    path.write_bytes(content[: len(content) // 2])
    assert "e.exr" in refusal(lambda: read_exr(tmp_path))


@pytest.mark.parametrize(
    "line",
    [
        *("0 0 0 0 0 0 0 nan", "0 1e300 0 0 0 0 0 1", "0 0 0 0 1e300 0 0 1", "0 0 0 0 0 0 0 0", "0 1_0 0 0 0 0 0 1"),
        *("inf 0 0 0 0 0 0 1", "0 0 0", "a b c d e f g h", "0 " * 5000),
    ],
)
def test_lines_of_a_trajectory_that_cannot_be(line: str, tmp_path: Path) -> None:
    from mitsonar.motion.trajectory import Trajectory

    (tmp_path / "p.tum").write_text(line + "\n")
    assert "line 1" in refusal(lambda: Trajectory.load_tum(tmp_path / "p.tum"))


def test_times_of_a_trajectory_do_not_go_back(tmp_path: Path) -> None:
    from mitsonar.motion.trajectory import Trajectory

    (tmp_path / "p.tum").write_text("1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n")
    assert "time must increase" in refusal(lambda: Trajectory.load_tum(tmp_path / "p.tum"))


def test_good_files_are_those_of_yaml() -> None:
    """What the tests call a recipe is one."""
    assert yaml.safe_load(yaml.safe_dump(TINY)) == TINY
