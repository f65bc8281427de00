"""Worlds: the same seed gives the same bytes, sizes and counts follow their definition, users' models become scenes."""

from __future__ import annotations

import hashlib
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers import Command, files_of, place_of
from PIL import Image
from scipy import stats

from mitsonar.errors import MitsonarError
from mitsonar.instruments.imaging_sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.simulation.imaging import Simulator
from mitsonar.simulation.scene import load_scene, sonar_in
from mitsonar.worlds.families import FAMILIES, create_family
from mitsonar.worlds.flat_objects import FlatObjects
from mitsonar.worlds.pattern import Pattern
from mitsonar.worlds.perlin_noise import perlin_reflectivity
from mitsonar.worlds.rocky_field import RockyField
from mitsonar.worlds.ship_hull import ShipHull
from mitsonar.worlds.user_mesh import mesh_world
from mitsonar.worlds.world import Mesh, stream, whole

P = 1e-5
"""Smallest p-value: seeds are fixed, so a right law fails never or always; one in 100,000 seeds."""

SMALL = {
    "rocky-field": {"size_m": 6, "a_side": (3, 5)},
    "ship-hull": {"size_m": 6, "groups_a_side": (1, 2), "anodes_a_side": (2, 3)},
    "pattern": {},
    "flat-objects": {"size_m": 6, "objects": (10, 20)},
}


def parts(mesh: Mesh) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vertices and reflectivities of each object of a mesh."""
    ids = mesh.object_id
    assert ids is not None
    assert mesh.reflectivity is not None
    order = np.argsort(ids, kind="stable")
    borders = np.flatnonzero(np.diff(ids[order])) + 1
    return [(mesh.vertices[np.unique(mesh.faces[own])], mesh.reflectivity[own]) for own in np.split(order, borders)]


def extents(mesh: Mesh) -> np.ndarray:
    return np.array([np.ptp(vertices, axis=0) for vertices, _ in parts(mesh)])


def centres(mesh: Mesh) -> np.ndarray:
    return np.array([(vertices.min(axis=0) + vertices.max(axis=0)) / 2 for vertices, _ in parts(mesh)])


def is_uniform(values: np.ndarray, low: float, high: float) -> None:
    """Kolmogorov-Smirnov test."""
    found = stats.kstest(values, stats.uniform(low, high - low).cdf)
    assert found.pvalue > P, f"not uniform in {low}..{high}: {values.min():.4f}..{values.max():.4f}, p = {found.pvalue:.1e}"


# ---------------------------------------------------------------- bytes


@pytest.mark.parametrize("name", sorted(FAMILIES))
def test_the_same_seed_gives_the_same_bytes(name: str, tmp_path: Path) -> None:
    for folder, seed in (("a", 5), ("b", 5), ("c", 6)):
        create_family(name, **SMALL[name]).build(seed).write(tmp_path / folder)
    one, again, other = (files_of(tmp_path / folder) for folder in "abc")
    assert one == again
    assert one != other
    assert {"scene.xml"} < set(one)


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("rocky-field", "3784fcd1436ac1ac"),
        ("ship-hull", "99f91547c061b024"),
        ("pattern", "29b9b8621fa22918"),
        ("flat-objects", "24c278014424ccbc"),
    ],
)
def test_bytes_do_not_change_with_machine_or_version(name: str, wanted: str) -> None:
    """What other machines of a cluster must make, too; a change here changes all data sets of that seed."""
    world = create_family(name, **SMALL[name]).build(7)
    content = world.xml().encode() + b"".join(mesh.ply() for mesh in world.meshes)
    assert hashlib.sha256(content).hexdigest()[:16] == wanted


def test_a_folder_that_holds_something_is_kept(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("years of work")
    with pytest.raises(MitsonarError, match="kept as it is"):
        RockyField(size_m=3, a_side=(2, 2)).build(0).write(tmp_path)
    assert files_of(tmp_path) == {"mine": b"years of work"}


# ---------------------------------------------------------------- rocky field


def test_rocks_follow_their_definition() -> None:
    """Almanza-Medina, 3.2.1: sizes 0..0.45 m, centres 0..0.45 m high, one rock in each step of the grid."""
    family = RockyField(size_m=30, cubes_a_side=40, cylinders_a_side=40, capsules_a_side=40, rotation_deg=(0, 0))
    world = family.build(11)
    assert [mesh.name for mesh in world.meshes] == ["cubes", "cylinders", "capsules"]
    for mesh in world.meshes:
        size, centre = extents(mesh), centres(mesh)
        assert len(size) == 1600
        for axis in range(3):
            is_uniform(size[:, axis], 0, 0.45)
        is_uniform(centre[:, 2], 0, 0.45)
        step = np.floor((centre[:, :2] + 15) / 0.75).astype(int)
        assert sorted(map(tuple, step)) == list(itertools.product(range(40), range(40)))
        for axis in range(2):
            is_uniform((centre[:, axis] + 15) % 0.75, 0, 0.75)
        corners = np.abs(np.corrcoef(size.T)[np.triu_indices(3, 1)]) * np.sqrt(1600)
        assert corners.max() < 4.5


def test_rotations_are_about_each_axis_within_their_limits() -> None:
    """A turned unit box betrays its rotation: its edges are the columns of the matrix."""
    from scipy.spatial.transform import Rotation

    one = {"cubes_a_side": 20, "cylinders_a_side": 0, "capsules_a_side": 0, "rock_size_m": (1, 1), "centre_height_m": (0, 0)}
    flat = RockyField(**one, rotation_deg=(0, 0)).build(3).meshes[0].vertices.reshape(400, -1, 3)
    turned = RockyField(**one, rotation_deg=(30, 30)).build(3).meshes[0].vertices.reshape(400, -1, 3)
    wanted = Rotation.from_euler("xyz", [30, 30, 30], degrees=True).apply(flat[0] - flat[0].mean(axis=0))
    np.testing.assert_allclose(turned[0] - turned[0].mean(axis=0), wanted, atol=3e-6)
    anyhow = RockyField(**one).build(3).meshes[0].vertices.reshape(400, -1, 3)
    upright = flat - flat.mean(axis=1, keepdims=True)
    drawn = stream(3, 1, 0)
    drawn.random(400 * (2 + 1 + 3))  # places, heights, sizes come first
    wanted_turns = Rotation.from_euler("xyz", -165 + 265 * drawn.random((400, 3)), degrees=True)
    for before, after, turn in zip(upright, anyhow - anyhow.mean(axis=1, keepdims=True), wanted_turns, strict=True):
        found, error = Rotation.align_vectors(after, before)
        assert error < 1e-4
        assert np.degrees((turn * found.inv()).magnitude()) < 0.01


def test_numbers_of_rocks_are_drawn_from_30_to_130() -> None:
    """Chi-square of the draw that decides them, and a field's own counts."""
    draws = np.array([whole(stream(seed, 1, kind), (30, 130)) for seed in range(400) for kind in range(3)])
    assert draws.min() == 30
    assert draws.max() == 130
    assert stats.chisquare(np.bincount(draws - 30, minlength=101)).pvalue > P
    family = RockyField(a_side=(3, 9))
    counts = [tuple(len(parts(mesh)) for mesh in family.build(seed).meshes) for seed in range(8)]
    assert all(np.sqrt(n) in range(3, 10) for each in counts for n in each)
    assert len(set(counts)) > 4


def test_objects_are_numbered_through_and_have_their_own_reflectivity() -> None:
    world = RockyField(a_side=(8, 8)).build(1)
    ids = [mesh.object_id for mesh in world.meshes]
    assert [(i.min(), i.max()) for i in ids if i is not None] == [(1, 64), (65, 128), (129, 192)]
    values = np.concatenate([mesh.reflectivity for mesh in world.meshes if mesh.reflectivity is not None])
    assert 0 <= values.min() < 0.25
    assert 0.75 < values.max() <= 1
    within = np.mean([own.std() for mesh in world.meshes for _, own in parts(mesh)])
    assert 0.02 < within < values.std()  # Perlin's noise varies over a rock, less than between rocks


def test_perlin_is_the_published_noise() -> None:
    """Against a scalar transcription of its definition: ramps of lattice gradients, eased between them."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-20, 60, (200, 3))
    got = perlin_reflectivity(places, 0.7, (0, 1), stream(3))
    draws = stream(3)
    order = np.argsort(draws.random(256))
    kinds = np.floor(draws.random(256) * 12).astype(int)
    edges = [g for g in itertools.product((-1, 0, 1), repeat=3) if sum(map(abs, g)) == 2]

    def noise(place: np.ndarray) -> float:
        corner = np.floor(place).astype(int)
        inside = place - corner
        ease = inside**3 * (inside * (inside * 6 - 15) + 10)
        total = 0.0
        for offset in itertools.product((0, 1), repeat=3):
            x, y, z = corner + offset
            gradient = edges[kinds[(order[(order[x % 256] + y) % 256] + z) % 256]]
            weight = np.prod([e if o else 1 - e for e, o in zip(ease, offset, strict=True)])
            total += weight * np.dot(gradient, inside - offset)
        return total

    wanted = [0.5 + 0.75 * (noise(p / 0.7) + 0.5 * noise(2 * p / 0.7)) / 1.5 for p in places]
    np.testing.assert_allclose(got, np.clip(wanted, 0, 1), atol=1e-12)


# ---------------------------------------------------------------- hull, flat objects, pattern


def test_tubes_and_anodes_follow_their_definition() -> None:
    """Almanza-Medina, 3.2.2: axes, lengths and heights uniform; tubes of a group side by side; all on the plate."""
    counts = {"groups_a_side": (12, 12), "tubes_a_group": (3, 3), "anodes_a_side": (25, 25)}
    tubes, anodes = ShipHull(size_m=100, **counts).build(2).meshes
    shape = parts(tubes)
    assert len(shape) == 12 * 12 * 3
    middle = np.array([vertices.mean(axis=0) for vertices, _ in shape])
    span = [np.linalg.svd(v[:, :2] - v[:, :2].mean(axis=0), full_matrices=False) for v, _ in shape]
    along = np.array([axes[0] for _, _, axes in span])
    length = np.array([np.ptp(v[:, :2] @ a) for (v, _), a in zip(shape, along, strict=True)])
    width = np.array([np.ptp(v[:, :2] @ np.array([-a[1], a[0]])) for (v, _), a in zip(shape, along, strict=True)])
    is_uniform(length, 1, 3)
    is_uniform(width, 0, 0.4)
    is_uniform(extents(tubes)[:, 2], 0, 0.05)
    assert np.abs([v[:, 2].min() for v, _ in shape]).max() < 1e-6
    for first in range(0, len(shape), 3):
        (ax, ay), (bx, by) = along[first], along[first + 1]
        assert abs(ax * by - ay * bx) < 1e-4
        apart = np.linalg.norm(middle[first + 1, :2] - middle[first, :2])
        assert apart == pytest.approx((width[first] + width[first + 1]) / 2, abs=1e-5)
    axes = np.array([np.linalg.svd(v[:, :2] - v[:, :2].mean(axis=0), full_matrices=False)[1] for v, _ in parts(anodes)])
    # a ring of 16 points twice, and the middle twice: the singular value is the half axis times sqrt(16)
    is_uniform(axes[:, 0] / 2, 0.15, 0.3)
    is_uniform(axes[:, 1] / 2, 0.05, 0.1)
    is_uniform(extents(anodes)[:, 2], 0, 0.03)


def test_flat_objects_follow_their_definition() -> None:
    """Almanza-Medina, 5.4.1; tops of overlapping objects differ, or the ray tracer would see now one, now the other."""
    counts = []
    for seed in range(6):
        world = FlatObjects().build(seed)
        counts += [len(np.unique(mesh.object_id)) for mesh in world.meshes if mesh.object_id is not None]
    assert all(2000 <= count <= 5000 for count in counts)
    assert len(set(counts)) > 9
    rectangles, ellipses = world.meshes
    assert rectangles.reflectivity is not None
    own = np.array([(reflectivity.min(), reflectivity.max()) for _, reflectivity in parts(rectangles)])
    np.testing.assert_array_equal(own[:, 0], own[:, 1])
    is_uniform(own[:, 0], 0, 1)
    is_uniform(centres(rectangles)[:, 0], -25, 25)
    corners = np.array([vertices[vertices[:, 2] < 1e-9] for vertices, _ in parts(rectangles)])
    edge = np.sort(np.linalg.norm(corners[:, 1:] - corners[:, :1], axis=2), axis=1)[:, :2]
    is_uniform(edge.ravel(), 0.2, 1)
    top = np.concatenate([[vertices[:, 2].max() for vertices, _ in parts(mesh)] for mesh in (rectangles, ellipses)])
    assert 0.001 - 1e-9 <= top.min() < top.max() < 0.0013
    middle = np.concatenate([centres(rectangles), centres(ellipses)])[:, :2]
    size = np.concatenate([extents(rectangles), extents(ellipses)])[:, :2]
    overlap = 0
    for first in range(300):
        gap = np.linalg.norm(middle[first + 1 :] - middle[first], axis=1)
        close = first + 1 + np.flatnonzero(gap < (size[first].min() + size[first + 1 :].min(axis=1)) / 2)
        assert np.abs(top[close] - top[first]).min(initial=1) > 4e-6
        overlap += len(close)
    assert overlap > 300


def test_the_pattern_is_the_shipped_scene() -> None:
    """Two routes to one picture: the generated world and scenes/pattern.xml, which was written by hand."""
    import tempfile

    poses = [Pose.from_degrees([x, -4.2, 2.5, 35, 0, turn]) for x, turn in ((-1, 0), (0, 10), (1.5, 60), (-1.5, -50))]
    sonar = Sonar(rays_per_beam=150)
    for texture, seed in (("gaussian", 1), ("perlin_low", 3), ("photo_rock", 0)):
        with tempfile.TemporaryDirectory() as folder:
            world = load_scene(Pattern(texture=texture).build(seed).write(Path(folder) / "world"))
        ours, theirs = (
            Simulator(scene, sonar).render(poses, gain=1.0).image
            for scene in (world, load_scene("pattern", texture=texture))
        )
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-7)


@pytest.mark.filterwarnings("ignore:.*outside the window")
@pytest.mark.parametrize("name", sorted(FAMILIES))
def test_worlds_render_and_tell_their_objects(name: str, tmp_path: Path) -> None:
    """The scene loads as it is, from the sonar that stands in it; labels name shapes and objects of the file."""
    world = create_family(name, **({"size_m": 20.0, "a_side": (20, 30)} if name == "rocky-field" else {})).build(4)
    scene = load_scene(world.write(tmp_path / "world"))
    found = sonar_in(scene)
    assert found is not None
    frames = Simulator(scene, found[0].replace(rays_per_beam=200)).render([found[1]], labels=True, gain=1.0)
    assert np.isfinite(frames.image).all()
    assert 0.02 < (frames.image > 0).mean() < 0.98
    assert frames.object_id is not None
    assert frames.shape_id is not None
    floor = place_of(scene, "plate" if name == "ship-hull" else "seabed")
    seen = frames.shape_id >= 0
    np.testing.assert_array_equal(frames.object_id[seen & (frames.shape_id == floor)], 0)
    for mesh in world.meshes:
        mine = frames.object_id[frames.shape_id == place_of(scene, mesh.name)]
        assert mesh.object_id is not None
        assert np.isin(mine, mesh.object_id).all()
    assert len(np.unique(frames.object_id)) > 2


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"size": 3}, "size_m"),
        ({"size_m": -1}, "greater than 0"),
        ({"rock_size_m": (0.5, 0.1)}, "low <= high"),
        ({"a_side": (1, 1e9)}, "a_side"),
        ({"rock_reflectivity": (0, float("nan"))}, "finite"),
    ],
)
def test_numbers_outside_their_limits_are_refused(fields: dict[str, Any], words: str) -> None:
    with pytest.raises(MitsonarError, match=words):
        create_family("rocky-field", **fields)


# ---------------------------------------------------------------- users' models


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
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, baseColorFactor=[255, 255, 255, 255])
        wall.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
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
    wanted = [0.2126 + (0.7152 + 0.0722) * LINEAR[0], 0.2126 * LINEAR[1]]
    np.testing.assert_allclose(seen_reflectivity(tmp_path / "luminance"), wanted, atol=2e-3)
    mesh_world(tmp_path / f"wall.{suffix}", reflectivity=0.3).write(tmp_path / "number")
    np.testing.assert_allclose(seen_reflectivity(tmp_path / "number"), [0.3, 0.3], atol=1e-6)


@pytest.mark.parametrize("suffix", ["stl", "glb", "obj", "ply", "dae"])
def test_models_are_turned_scaled_and_put_on_the_seabed(suffix: str, tmp_path: Path) -> None:
    model = trimesh.creation.box((200, 100, 300))  # mm, longest upright
    model.apply_translation((5000, -300, 40))
    along = {"z": np.eye(4), "y": trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])}
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
    scene.export(tmp_path / "many.glb")
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
        ("flat.obj", b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "all in one place|cannot read"),
        ("junk.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n", "triangles|cannot read"),
        ("junk.stl", b"solid nothing\nendsolid nothing\n", "triangles|cannot read"),
        ("junk.dae", b"<COLLADA/>", "triangles|cannot read"),
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


@pytest.mark.filterwarnings("ignore:.*outside the window")
@pytest.mark.skipif(not real_models(), reason="the shared data is not here")
@pytest.mark.parametrize("path", real_models(), ids=lambda path: path.stem)
def test_real_models_render(path: Path, tmp_path: Path) -> None:
    scene = load_scene(mesh_world(path).write(tmp_path / "world"))
    found = sonar_in(scene)
    assert found is not None
    frames = Simulator(scene, found[0].replace(rays_per_beam=200)).render([found[1]], labels=True, gain=1.0)
    assert frames.object_id is not None
    assert (frames.object_id >= 1).mean() > 0.005


@pytest.mark.parametrize(
    ("fields", "left"),
    [
        ({"groups_a_side": (0, 0)}, ["anodes"]),
        ({"anodes_a_side": (0, 0)}, ["tubes"]),
        ({"tubes_a_group": (0, 0)}, ["anodes"]),
        ({"tubes_a_group": (0, 2)}, ["tubes", "anodes"]),
        ({"groups_a_side": (0, 0), "anodes_a_side": (0, 0)}, []),
    ],
)
def test_hulls_without_some_of_their_objects(fields: dict[str, Any], left: list[str]) -> None:
    for seed in range(6):
        assert [mesh.name for mesh in ShipHull(**fields).build(seed).meshes] == left


@pytest.mark.parametrize(
    ("factor", "reflectivity", "wanted"),
    [([128, 128, 128, 255], "luminance", 128 / 255), ([128, 0, 0, 255], "red", 128 / 255), (None, "luminance", 1.0)],
)
def test_colour_factors_of_gltf_are_linear(
    factor: list[int] | None, reflectivity: str, wanted: float, tmp_path: Path
) -> None:
    box = trimesh.creation.box((1, 1, 1))
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=factor)
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    box.export(tmp_path / "box.glb")
    (mesh,) = mesh_world(tmp_path / "box.glb", reflectivity=reflectivity).meshes
    np.testing.assert_allclose(mesh.reflectivity, wanted, atol=1e-6)


def test_a_model_in_the_wrong_unit_is_warned_of(mitsonar: Command, tmp_path: Path) -> None:
    trimesh.creation.box((1000, 2000, 500)).export(tmp_path / "box.stl")
    assert mesh_world(tmp_path / "box.stl").size_m == pytest.approx(2000)
    for scale, warned in ((1, True), (0.001, False)):
        done = mitsonar("world", "mesh", tmp_path / "box.stl", "--scale", scale, "-o", tmp_path / str(scale))
        assert done.returncode == 0, done.stderr
        assert ("0.001 for millimetres" in done.stderr) == warned


def test_a_model_without_colours_is_half_reflecting(tmp_path: Path) -> None:
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.stl")
    (mesh,) = mesh_world(tmp_path / "box.stl").meshes
    np.testing.assert_array_equal(mesh.reflectivity, 0.5)
