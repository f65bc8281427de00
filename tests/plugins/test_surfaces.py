"""Surfaces: the rule for every BSDF, and tables that say the same as Mitsuba itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import MitsubaDict, box, diffuse, floor, place_of, scene, sphere

if TYPE_CHECKING:
    from mitsonar.plugins.surfaces import Surfaces

pytestmark = pytest.mark.usefixtures("variant")


def surfaces(loaded: mi.Scene) -> Surfaces:
    from mitsonar.plugins.surfaces import Surfaces

    return Surfaces.from_scene(loaded)


def rays_down(count: int = 4000, reach: float = 2.0, slant: float = 0.3) -> mi.Ray3f:
    """Rays from 5 m above to random places around the origin."""
    rng = np.random.default_rng(4)
    start = np.column_stack([rng.uniform(-reach, reach, (count, 2)), np.full(count, 5.0)])
    way = np.column_stack([rng.normal(0, slant, (count, 2)), np.full(count, -1.0)])
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return mi.Ray3f(mi.Point3f(*start.T.astype(np.float32)), mi.Vector3f(*way.T.astype(np.float32)))


def assert_same_as_mitsuba(loaded: mi.Scene, ray: mi.Ray3f | None = None, least: float = 0.2) -> np.ndarray:
    """Distance, normal, reflectivity and shape against ``ray_intersect`` and ``eval_diffuse_reflectance``."""
    ray = rays_down() if ray is None else ray
    hit, si = surfaces(loaded).hit(loaded, ray), loaded.ray_intersect(ray)
    local = np.array(si.bsdf().eval_diffuse_reflectance(si)[0])
    valid = np.array(si.is_valid())
    assert valid.mean() > least
    np.testing.assert_array_equal(np.array(hit.valid), valid)
    np.testing.assert_allclose(np.array(hit.t)[valid], np.array(si.t)[valid], rtol=1e-6)
    np.testing.assert_allclose(np.array(hit.n).T[valid], np.array(si.n).T[valid], atol=1e-6)
    reflectivity = np.array(hit.reflectivity)[valid]
    np.testing.assert_allclose(reflectivity, np.clip(local[valid], 0, 1), atol=1e-6)
    for number, shape in enumerate(loaded.shapes()):
        if shape.bsdf() is not None:
            seen = np.array(si.shape == mi.ShapePtr(shape)) & valid
            assert (np.array(hit.shape_id)[seen] == number).all(), shape.id()
    return np.asarray(reflectivity)


# ---------------------------------------------------------------- the rule for BSDFs

DIELECTRIC = {"type": "dielectric"}
RULE: dict[str, tuple[MitsubaDict, float, str]] = {
    "diffuse": (diffuse(0.3), 0.3, ""),
    "twosided": ({"type": "twosided", "b": diffuse(0.35)}, 0.35, ""),
    "plastic": ({"type": "plastic", "diffuse_reflectance": 0.25}, 0.25, ""),
    "mask": ({"type": "mask", "opacity": 0.5, "b": diffuse(0.45)}, 0.45, ""),
    "bumpmap": ({"type": "bumpmap", "t": {"type": "checkerboard"}, "b": diffuse(0.15)}, 0.15, ""),
    "principled": ({"type": "principled", "base_color": {"type": "uniform", "value": 0.4}}, 0.4, "approximated"),
    "blend": ({"type": "blendbsdf", "weight": 0.25, "a": diffuse(0.2), "b": diffuse(0.6)}, 0.3, "approximated"),
    "dielectric": (DIELECTRIC, 0.5, "without"),
    "conductor": ({"type": "conductor", "material": "Au"}, 0.5, "without"),
    "null": ({"type": "null"}, 0.5, "without"),
    "masked glass": ({"type": "mask", "opacity": 0.5, "b": DIELECTRIC}, 0.5, "without"),
    "blend with glass": ({"type": "blendbsdf", "weight": 0.25, "a": diffuse(0.2), "b": DIELECTRIC}, 0.5, "without"),
}


@pytest.mark.parametrize("mesh", [True, False], ids=["mesh", "rectangle"])
def test_reflectivity_of_every_kind_of_bsdf(mesh: bool) -> None:
    """One shape of each kind side by side, one ray down on each."""
    shapes = {}
    for k, (name, (bsdf, _, _)) in enumerate(RULE.items()):
        at = mi.ScalarTransform4f().translate([3 * k, 0, 0])
        shapes[name.replace(" ", "_")] = {"type": "cube" if mesh else "rectangle", "to_world": at, "bsdf": bsdf}
    loaded = scene(**shapes)
    result = surfaces(loaded)
    ray = mi.Ray3f(mi.Point3f(3 * dr.arange(mi.Float, len(RULE)), 0.1, 5), mi.Vector3f(0.01, 0, -1))
    hit = result.hit(loaded, ray)
    got = dict(zip(RULE, np.array(hit.reflectivity), strict=True))
    assert got == pytest.approx({name: value for name, (_, value, _) in RULE.items()}, abs=1e-6)
    assert [loaded.shapes()[k].id() for k in np.array(hit.shape_id)] == list(shapes)
    notes = {"approximated": "is not diffuse", "without": "has no diffuse reflectance: reflectivity 0.5 is used"}
    for kind, words in notes.items():
        note = [text for text in result.notes if words in text]
        assert len(note) == 1
        names = note[0].split("the BSDF of ")[1].split(" is " if kind == "approximated" else " has ")[0].split(", ")
        assert sorted(names) == sorted(name.replace(" ", "_") for name, rule in RULE.items() if rule[2] == kind)
    assert len(result.notes) == 2


def test_diffuse_scenes_need_no_note() -> None:
    assert surfaces(scene(floor=floor(), ball=sphere((0, 0, 0), 1), box=box((2, 0, 0), (1, 1, 1)))).notes == []


def test_reflectivity_stays_within_0_and_1() -> None:
    bright = {"type": "uniform", "value": 0.9}
    loaded = scene(box=box((0, 0, 0), (1, 1, 1), {"type": "diffuse", "reflectance": {**bright, "value": 1.7}}))
    hit = surfaces(loaded).hit(loaded, mi.Ray3f(mi.Point3f(0, 0, 5), mi.Vector3f(0, 0, -1)))
    assert np.array(hit.reflectivity).tolist() == [1.0]


# ---------------------------------------------------------------- the same as Mitsuba


def smooth_bitmap() -> MitsubaDict:
    values = np.random.default_rng(5).random((8, 8, 1), dtype=np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "wrap_mode": "mirror"}


@pytest.mark.thorough
def test_textured_meshes() -> None:
    """Bitmap, checkerboard, noise by uv and by position, and a texture within `twosided`, side by side."""
    checkers = {"type": "checkerboard", "color0": 0.2, "color1": 0.9, "to_uv": mi.ScalarTransform3f().scale(4)}
    by_position = {"type": "perlin", "coordinates": "position", "cell_size": 2.0, "octaves": 1}
    bsdfs = {
        "bitmap": diffuse(smooth_bitmap()),
        "checkers": diffuse(checkers),
        "perlin": diffuse({"type": "perlin", "cells": 3}),
        "position": diffuse(by_position),
        "twosided": {"type": "twosided", "b": diffuse(smooth_bitmap())},
    }
    loaded = scene(
        **{name: box((0.8 * k - 1.6, 0, 0), (0.35, 1.5, 0.5), bsdf) for k, (name, bsdf) in enumerate(bsdfs.items())}
    )
    result = assert_same_as_mitsuba(loaded)
    assert len(np.unique(result)) > 1000


def sheet(attribute: str, centre: float = 0.0) -> mi.Mesh:
    """A bumpy sheet of 800 triangles, 441 corners with smooth normals, a random ``attribute``."""
    count = 21
    x, y = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-2, 2, count))
    z = 0.2 * np.sin(3 * x) * np.cos(2 * y)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    near, far = [corner, corner + 1, corner + count + 1], [corner, corner + count + 1, corner + count]
    faces = np.concatenate([np.column_stack(near), np.column_stack(far)])
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(diffuse({"type": "mesh_attribute", "name": attribute}))
    mesh = mi.Mesh("sheet", vertex_count=x.size, face_count=len(faces), has_vertex_normals=True, props=properties)
    values = np.random.default_rng(6).random(len(faces) if attribute.startswith("face") else x.size, dtype=np.float32)
    mesh.add_attribute(attribute, 1, values)  # type: ignore[arg-type]  # the stubs know no NumPy arrays here
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.column_stack([x.ravel() + centre, y.ravel(), z.ravel()]).astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


@pytest.mark.thorough
def test_attributes_of_a_mesh_from_above_and_below() -> None:
    """By face (in the table) and by vertex (asked); the geometric normal counts, not the smooth one."""
    loaded = scene(by_face=sheet("face_reflectivity", -1), by_vertex=sheet("vertex_reflectivity", 1))  # type: ignore[arg-type]
    down = rays_down()
    assert len(np.unique(assert_same_as_mitsuba(loaded, down))) > 1000
    assert_same_as_mitsuba(loaded, mi.Ray3f(mi.Point3f(down.o.x, down.o.y, -5), mi.Vector3f(down.d.x, down.d.y, -down.d.z)))
    si = loaded.ray_intersect(down)
    valid = np.array(si.is_valid())
    assert np.abs(np.array(si.n).T[valid] - np.array(si.sh_frame.n).T[valid]).max() > 0.01


@pytest.mark.thorough
def test_shapes_that_are_no_meshes() -> None:
    plain, noise = diffuse(0.3), diffuse({"type": "perlin", "cells": 4})
    cylinder = {"type": "cylinder", "p0": [-2, 1, 0], "p1": [2, 1, 0], "radius": 0.3, "bsdf": plain}
    disk = {"type": "disk", "bsdf": noise, "to_world": mi.ScalarTransform4f().translate([0, -1, 0.2])}
    assert_same_as_mitsuba(
        scene(ball=sphere((0.3, 0, 0), 0.8, noise), cylinder=cylinder, disk=disk, floor=floor(plain, 1.0))
    )


@pytest.mark.thorough
def test_instances() -> None:
    """Their points, normals and reflectivities are Mitsuba's; the shape is the instance, not the group's member."""
    group = {
        "type": "shapegroup",
        "ball": sphere((0, 0, 0), 0.5, diffuse(0.8)),
        "box": box((0, 0, 1), (0.2, 0.2, 0.2), diffuse(0.6)),
    }
    turn = mi.ScalarTransform4f().translate([1, 0.5, 0]).rotate([1, 0, 0], 40)
    loaded = scene(
        group=group,
        first={"type": "instance", "ref": {"type": "ref", "id": "group"}},
        floor=floor(diffuse(0.3), 3.0),
        second={"type": "instance", "to_world": turn, "ref": {"type": "ref", "id": "group"}},
    )
    result = assert_same_as_mitsuba(loaded)
    assert {0.8, 0.6} <= {round(float(value), 6) for value in result}
    ray = mi.Ray3f(mi.Point3f([0, 1, -2], [0, 0.5, 2], 5), mi.Vector3f(0, 0, -1))
    hit = surfaces(loaded).hit(loaded, ray)
    expected = [place_of(loaded, name) for name in ("first", "second", "floor")]
    assert np.array(hit.shape_id).tolist() == expected


def test_mixed_scene_keeps_its_shapes_apart() -> None:
    """Meshes in the tables, with and without texture, beside shapes that are asked."""
    loaded = scene(
        floor=floor(diffuse(0.1), 5.0),
        plain=box((-1, -1, 0), (0.5, 0.5, 0.5), diffuse(0.7)),
        ball=sphere((1, 1, 0), 0.6, diffuse(smooth_bitmap())),
        painted=box((1, -1, 0), (0.5, 0.5, 0.5), diffuse(smooth_bitmap())),
        sheet=sheet("face_reflectivity"),  # type: ignore[arg-type]
    )
    assert_same_as_mitsuba(loaded, least=0.9)


def test_an_empty_scene_hits_nothing() -> None:
    empty = scene()
    hit = surfaces(empty).hit(empty, mi.Ray3f(mi.Point3f(0, 0, [1, 2]), mi.Vector3f(0, 0, -1)))
    assert not np.array(hit.valid).any()


def test_two_faces_have_two_reflectivities(variant: str) -> None:
    """`twosided` with another BSDF on the back: which one counts depends on the side that the ray comes from."""
    from mitsonar.plugins.surfaces import Surfaces

    both = {"type": "twosided", "front": diffuse(0.2), "back": diffuse(0.8)}
    tables = Surfaces.from_scene(loaded := scene(floor=floor(both)))
    ray = mi.Ray3f(mi.Point3f([0.1, 0.1], [0.2, 0.2], [3, -3]), mi.Vector3f([0, 0], [0, 0], [-1, 1]))
    np.testing.assert_allclose(tables.hit(loaded, ray).reflectivity, [0.2, 0.8], rtol=1e-6)
