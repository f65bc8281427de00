"""Worlds from users' models: formats, colours, units, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers import Command
from PIL import Image

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.simulation.scene import load_scene, sonar_in
from mitsonar.simulation.simulator import Simulator
from mitsonar.worlds.meshes import mesh_world


def painted(kind: str) -> trimesh.Trimesh:
    """A wall 2 m wide, 1 m high in the plane y = 0: its upper half bright red, its lower half dark."""
    vertices = np.array([[-1, 0, 0], [1, 0, 0], [1, 0, 0.5], [-1, 0, 0.5], [1, 0, 1], [-1, 0, 1]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]])
    wall = trimesh.Trimesh(vertices, faces, process=False)
    bright, dark = [255, 100, 100, 255], [51, 0, 0, 255]
    if kind == "faces":
        wall.visual = trimesh.visual.ColorVisuals(wall, face_colors=[dark, dark, bright, bright])
    elif kind == "vertices":
        wall = trimesh.Trimesh(vertices[faces].reshape(-1, 3), np.arange(12).reshape(-1, 3), process=False)
        wall.visual = trimesh.visual.ColorVisuals(wall, vertex_colors=[dark] * 6 + [bright] * 6)
    else:
        picture = Image.fromarray(np.array([[bright[:3]] * 8] * 8 + [[dark[:3]] * 8] * 8, dtype=np.uint8))
        uv = np.column_stack([(vertices[:, 0] + 1) / 2, vertices[:, 2]])
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, baseColorFactor=[255, 255, 255, 255])  # type: ignore[no-untyped-call]
        wall.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)  # type: ignore[no-untyped-call]
    return wall


def seen_reflectivity(folder: Path) -> tuple[float, float]:
    """What rays read on the upper and on the lower half of the wall."""
    scene = load_scene(folder / "scene.xml")
    sonar = Sonar(azimuth_fov_deg=10, elevation_fov_deg=10, beams=9, rays_per_beam=40, rays_across=1, jitter=False)
    halves = []
    for z in (0.75, 0.25):
        echoes = Simulator(scene, sonar).film_echoes(Pose(0, -1, z), 0)
        halves.append(float(np.median(echoes.reflectivity)))
        assert (echoes.hit > 0).all()
    return halves[0], halves[1]


LINEAR = (100 / 255 + 0.055) ** 2.4 / 1.055**2.4, (0.2 + 0.055) ** 2.4 / 1.055**2.4
"""The linear light of the green and blue of `bright`, and of the red of `dark`."""


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [("faces", "ply"), ("vertices", "ply"), ("vertices", "glb"), ("picture", "glb"), ("picture", "obj")],
)
def test_colours_become_reflectivity(kind: str, suffix: str, tmp_path: Path) -> None:
    wall = painted(kind)
    if suffix == "glb":  # glTF has y up
        wall.apply_transform(np.linalg.inv([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]))
    wall.export(tmp_path / f"wall.{suffix}")
    mesh_world(tmp_path / f"wall.{suffix}", reflectivity="red").write(tmp_path / "red")
    np.testing.assert_allclose(seen_reflectivity(tmp_path / "red"), [1, 0.2], atol=2e-3)
    mesh_world(tmp_path / f"wall.{suffix}", reflectivity="luminance").write(tmp_path / "luminance")
    expected = [0.2126 + (0.7152 + 0.0722) * LINEAR[0], 0.2126 * LINEAR[1]]
    np.testing.assert_allclose(seen_reflectivity(tmp_path / "luminance"), expected, atol=2e-3)
    mesh_world(tmp_path / f"wall.{suffix}", reflectivity=0.3).write(tmp_path / "number")
    np.testing.assert_allclose(seen_reflectivity(tmp_path / "number"), [0.3, 0.3], atol=1e-6)


@pytest.mark.parametrize("suffix", ["stl", "glb", "obj", "ply", "dae"])
def test_models_are_turned_scaled_and_put_on_the_seabed(suffix: str, tmp_path: Path) -> None:
    model = trimesh.creation.box((200, 100, 300))  # mm, longest upright
    model.apply_translation((5000, -300, 40))
    lying = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])  # type: ignore[no-untyped-call]
    along = {"z": np.eye(4), "y": lying}
    up = "y" if suffix == "glb" else "z"
    model.apply_transform(along[up])
    model.export(tmp_path / f"box.{suffix}")
    world = mesh_world(tmp_path / f"box.{suffix}", scale=0.001)
    (mesh,) = world.meshes
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-0.1, -0.05, 0], atol=1e-6)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [0.1, 0.05, 0.3], atol=1e-6)
    turned = mesh_world(tmp_path / f"box.{suffix}", scale=0.001, up="x").meshes[0]
    assert np.ptp(turned.vertices[:, 2]) == pytest.approx(0.2, abs=1e-6)
    oriented = trimesh.Trimesh(turned.vertices, turned.faces)
    assert oriented.volume == pytest.approx(0.006, rel=1e-4)  # turned, not mirrored: the surface still faces outward


def test_many_parts_become_one_mesh_with_a_number_each(tmp_path: Path) -> None:
    scene = trimesh.Scene([trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(subdivisions=1)])
    scene.add_geometry(painted("picture"))
    scene.export(tmp_path / "many.glb")  # type: ignore[no-untyped-call]
    world = mesh_world(tmp_path / "many.glb")
    assert [mesh.name for mesh in world.meshes] == ["model", "textured_0"]
    assert len(np.unique(np.concatenate([mesh.object_id for mesh in world.meshes if mesh.object_id is not None]))) == 3
    scene_file = world.write(tmp_path / "out")
    assert (tmp_path / "out" / "textures" / "textured_0.png").is_file()
    load_scene(scene_file)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("none.glb", None, "no model file"),
        ("model.fbx", b"x", "cannot read models of type .fbx"),
        ("junk.glb", b"junk", "cannot read"),
        ("empty.glb", b"", "cannot read"),
        ("empty.obj", b"", "triangles|cannot read"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "triangles|cannot read"),
        ("broken.obj", b"v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "not finite|cannot read"),
        ("outside.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cannot read"),
        ("flat.obj", b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "all coincide|cannot read"),
        ("junk.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n", "triangles|cannot read"),
        ("junk.stl", b"solid nothing\nendsolid nothing\n", "triangles|cannot read"),
        ("junk.dae", b"<COLLADA/>", "triangles|cannot read"),
        ("entities.dae", b'<!DOCTYPE a [<!ENTITY e "ee">]><COLLADA/>', "document type"),
    ],
)
def test_broken_and_empty_models_are_named(name: str, content: bytes | None, words: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(MitsonarError, match=words) as error:
        mesh_world(tmp_path / name)
    assert name in str(error.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scale": 0}, "scale"),
        ({"scale": float("nan")}, "scale"),
        ({"up": "w"}, "up must be"),
        ({"reflectivity": "blue"}, "red, luminance"),
        ({"reflectivity": 1.5}, "0..1"),
    ],
)
def test_wrong_options_for_models_are_named(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.ply")
    with pytest.raises(MitsonarError, match=words):
        mesh_world(tmp_path / "box.ply", **options)


def real_models() -> list[Path]:
    folder = Path(__file__).resolve().parents[3] / "shared" / "data" / "meshes"
    return sorted(folder.glob("*.dae"))


@pytest.mark.filterwarnings("ignore:.*outside the window", "ignore:.*farther than imaging sonars reach")
@pytest.mark.skipif(not real_models(), reason="the shared data is not here")
@pytest.mark.parametrize("path", real_models(), ids=lambda path: path.stem)
def test_real_models_render(path: Path, tmp_path: Path) -> None:
    scene = load_scene(mesh_world(path).write(tmp_path / "world"))
    result = sonar_in(scene)
    assert result is not None
    frames = Simulator(scene, result[0].replace(model="physical", rays_per_beam=200)).render(
        [result[1]], labels=True, gain=1.0
    )
    assert frames.object_id is not None
    assert (frames.object_id >= 1).mean() > 0.005


@pytest.mark.parametrize(
    ("factor", "reflectivity", "wanted"),
    [([128, 128, 128, 255], "luminance", 128 / 255), ([128, 0, 0, 255], "red", 128 / 255), (None, "luminance", 1.0)],
)
def test_colour_factors_of_gltf_are_linear(
    factor: list[int] | None, reflectivity: str, wanted: float, tmp_path: Path
) -> None:
    box = trimesh.creation.box((1, 1, 1))
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=factor)  # type: ignore[no-untyped-call]
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)  # type: ignore[no-untyped-call]
    box.export(tmp_path / "box.glb")
    (mesh,) = mesh_world(tmp_path / "box.glb", reflectivity=reflectivity).meshes
    assert mesh.reflectivity is not None
    np.testing.assert_allclose(mesh.reflectivity, wanted, atol=1e-6)


def test_a_model_in_the_wrong_unit_is_warned_of(mitsonar: Command, tmp_path: Path) -> None:
    trimesh.creation.box((1000, 2000, 500)).export(tmp_path / "box.stl")
    assert mesh_world(tmp_path / "box.stl").size_m == pytest.approx(2000)
    for scale, warned in ((1, True), (0.001, False)):
        done = mitsonar("world", "mesh", tmp_path / "box.stl", "--scale", scale, "-o", tmp_path / str(scale))
        assert done.returncode == 0, done.stderr
        assert ("0.001 where the unit is a millimetre" in done.stderr) == warned


def test_a_model_without_colours_is_half_reflecting(tmp_path: Path) -> None:
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.stl")
    (mesh,) = mesh_world(tmp_path / "box.stl").meshes
    np.testing.assert_array_equal(mesh.reflectivity, 0.5)


@pytest.mark.parametrize(("edge", "scale", "warned"), [(400, 1, "400 m large"), (400, 0.001, ""), (400, 0.0001, "0.04 m")])
def test_a_model_of_another_unit_is_warned_of(
    mitsonar: Command, tmp_path: Path, edge: float, scale: float, warned: str
) -> None:
    trimesh.creation.box((edge, edge, edge)).export(tmp_path / "box.stl")
    done = mitsonar("world", "mesh", tmp_path / "box.stl", "-o", tmp_path / "out", "--scale", scale)
    assert done.returncode == 0
    assert ("--scale 0.001 where the unit is a millimetre" in done.stderr) == bool(warned)
    assert warned in done.stderr
