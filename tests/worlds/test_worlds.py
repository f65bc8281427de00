"""Worlds: the same seed gives the same bytes, sizes and counts follow their definition, users' models become scenes."""

from __future__ import annotations

import hashlib
import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers import essence, files_of, place_of
from scipy import stats

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.simulation.scene import load_scene, sonar_in
from mitsonar.simulation.simulator import Simulator
from mitsonar.worlds.families import FAMILIES, FlatObjects, Pattern, RockyField, ShipHull, create_family, perlin_reflectivity
from mitsonar.worlds.world import BuiltFamily, Mesh, stream, whole

P = 1e-5
"""Smallest p-value. Seeds are fixed, so a right distribution fails never or always; one seed in 100,000 fails."""

SMALL: dict[str, dict[str, Any]] = {
    "rocky-field": {"size_m": 6, "a_side": (3, 5)},
    "ship-hull": {"size_m": 6, "groups_a_side": (1, 2), "anodes_a_side": (2, 3)},
    "pattern": {},
    "flat-objects": {"size_m": 6, "objects": (10, 20)},
    "sea-surface": {"size_m": 6, "step_m": 0.2, "wind_m_s": 3},
}


def parts(mesh: Mesh) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vertices and reflectivities of each object of a mesh."""
    ids = mesh.object_id
    assert ids is not None
    assert mesh.reflectivity is not None
    order = np.argsort(ids, kind="stable")
    borders = np.flatnonzero(np.diff(ids[order])) + 1
    return [(mesh.vertices[np.unique(mesh.faces[local])], mesh.reflectivity[local]) for local in np.split(order, borders)]


def extents(mesh: Mesh) -> np.ndarray:
    return np.array([np.ptp(vertices, axis=0) for vertices, _ in parts(mesh)])


def centres(mesh: Mesh) -> np.ndarray:
    return np.array([(vertices.min(axis=0) + vertices.max(axis=0)) / 2 for vertices, _ in parts(mesh)])


def is_uniform(values: np.ndarray, low: float, high: float) -> None:
    """Kolmogorov-Smirnov test."""
    result = stats.kstest(values, stats.uniform(low, high - low).cdf)
    assert result.pvalue > P, (
        f"not uniform in {low}..{high}: {values.min():.4f}..{values.max():.4f}, p = {result.pvalue:.1e}"
    )


# ---------------------------------------------------------------- bytes


@pytest.mark.parametrize("name", sorted(FAMILIES))
def test_the_same_seed_gives_the_same_bytes(name: str, tmp_path: Path) -> None:
    for folder, seed in (("a", 5), ("b", 5), ("c", 6)):
        create_family(name, **SMALL[name]).build(seed).write(tmp_path / folder)
    one, again, second = (files_of(tmp_path / folder) for folder in "abc")
    assert one == again
    assert one != second
    assert {"scene.xml"} < set(one)


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("rocky-field", "3784fcd1436ac1ac"),
        ("ship-hull", "99f91547c061b024"),
        ("pattern", "29b9b8621fa22918"),
        ("flat-objects", "24c278014424ccbc"),
        ("sea-surface", "a3c3c4c9fa7f95d5"),
    ],
)
def test_bytes_do_not_change_with_machine_or_version(name: str, wanted: str) -> None:
    """What other machines of a cluster must make, too; a change here changes all data sets of that seed."""
    world = create_family(name, **SMALL[name]).build(7)
    content = world.xml().encode() + b"".join(mesh.ply() for mesh in world.meshes)
    assert hashlib.sha256(content).hexdigest()[:16] == wanted


@pytest.mark.parametrize("name", sorted(name for name, family in FAMILIES.items() if issubclass(family, BuiltFamily)))
def test_a_sea_surface_is_one_shape_more(name: str, tmp_path: Path) -> None:
    """All else stays; it lies flat at its height, and reaches beyond the world."""
    plain, covered = (create_family(name, **SMALL[name], **more).build(7) for more in ({}, {"surface_m": 4.5}))
    content = covered.xml().replace(covered.surface.xml() if covered.surface else "", "")
    assert content.split() == plain.xml().split()
    loaded = load_scene(covered.write(tmp_path / "world"))
    surface = loaded.shapes()[place_of(loaded, "surface")]
    low, high = (np.array(end, dtype=float).ravel() for end in (surface.bbox().min, surface.bbox().max))
    np.testing.assert_allclose((low[2], high[2]), 4.5, rtol=1e-6)
    assert high[0] > create_family(name, **SMALL[name]).half_m + 20


def test_a_folder_that_holds_something_is_kept(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("years of work")
    with pytest.raises(MitsonarError, match="kept as it is"):
        RockyField(size_m=3, a_side=(2, 2)).build(0).write(tmp_path)
    assert files_of(tmp_path) == {"mine": b"years of work"}


def test_the_current_folder_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even an empty one: a shell cannot stay in a folder that is replaced."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MitsonarError, match="kept as it is"):
        RockyField(size_m=3, a_side=(2, 2)).build(0).write(".")


def test_hyphens_in_a_name_do_not_end_the_comment_of_a_scene() -> None:
    world = RockyField(size_m=3, a_side=(2, 2)).build(0)
    text = replace(world, about="wreck---x--y-").xml()
    root = ElementTree.fromstring(text, ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True)))
    assert root.tag == "scene"
    assert "<!-- wreck- - -x- -y- -->" in text


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
    expected = Rotation.from_euler("xyz", [30, 30, 30], degrees=True).apply(flat[0] - flat[0].mean(axis=0))
    np.testing.assert_allclose(turned[0] - turned[0].mean(axis=0), expected, atol=3e-6)
    anyhow = RockyField(**one).build(3).meshes[0].vertices.reshape(400, -1, 3)
    upright = flat - flat.mean(axis=1, keepdims=True)
    drawn = stream(3, 1, 0)
    drawn.random(400 * (2 + 1 + 3))  # places, heights, sizes come first
    wanted_turns = Rotation.from_euler("xyz", -165 + 265 * drawn.random((400, 3)), degrees=True)
    for before, after, turn in zip(upright, anyhow - anyhow.mean(axis=1, keepdims=True), wanted_turns, strict=True):
        result, error = Rotation.align_vectors(after, before)
        assert error < 1e-4
        assert np.degrees((turn * result.inv()).magnitude()) < 0.01


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
    within = np.mean([local.std() for mesh in world.meshes for _, local in parts(mesh)])
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

    expected = [0.5 + 0.75 * (noise(p / 0.7) + 0.5 * noise(2 * p / 0.7)) / 1.5 for p in places]
    np.testing.assert_allclose(got, np.clip(expected, 0, 1), atol=1e-12)


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


@pytest.mark.thorough
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
    local = np.array([(reflectivity.min(), reflectivity.max()) for _, reflectivity in parts(rectangles)])
    np.testing.assert_array_equal(local[:, 0], local[:, 1])
    is_uniform(local[:, 0], 0, 1)
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
@pytest.mark.parametrize(
    "name", essence(sorted(set(FAMILIES) - {"sea-surface"}), "rocky-field", "ship-hull")
)  # a sea surface has no objects: test_sea_surface.py
def test_worlds_render_and_tell_their_objects(name: str, tmp_path: Path) -> None:
    """The scene loads as it is, from the sonar that stands in it; labels name shapes and objects of the file."""
    world = create_family(name, **({"size_m": 20.0, "a_side": (20, 30)} if name == "rocky-field" else {})).build(4)
    scene = load_scene(world.write(tmp_path / "world"))
    result = sonar_in(scene)
    assert result is not None
    frames = Simulator(scene, result[0].replace(model="physical", rays_per_beam=200)).render(
        [result[1]], labels=True, gain=1.0
    )
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
def test_numbers_outside_their_limits_are_refused(fields: dict[str, object], words: str) -> None:
    with pytest.raises(MitsonarError, match=words):
        create_family("rocky-field", **fields)


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
