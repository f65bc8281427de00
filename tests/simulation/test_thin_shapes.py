"""Rods thinner than the spacing of rays: the points that rays would find, energy by a closed form, no empty pings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from coherent_scenes import SONAR, imager
from helpers import Array, diffuse, essence, plate, scene

from mitsonar.simulation.simulator import Simulator

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

AHEAD, LENGTH = 4.45, 0.3
FAN = SONAR.replace(elevation_fov_deg=40.0)


def rod(diameter: float, folder: Path | None = None) -> dict[str, Any]:
    """An upright rod: a cylinder of Mitsuba's, or a mesh in a folder."""
    if folder is None:
        ends = {"p0": [0, AHEAD, -LENGTH / 2], "p1": [0, AHEAD, LENGTH / 2]}
        return {"type": "cylinder", **ends, "radius": diameter / 2, "bsdf": diffuse(0.5)}
    mesh = trimesh.creation.cylinder(diameter / 2, LENGTH, sections=32)
    mesh.apply_translation([0, AHEAD, 0])
    mesh.export(path := folder / f"{diameter}.ply")
    return {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": diffuse(0.5)}


def energies(shape: dict[str, Any], poses: Array) -> Array:
    """Energy of the echo at each pose, times R^4 / cos(elevation)^2: what a rod has at 1 m, level with it."""
    source = imager(scene(rod=shape), FAN)
    energy = np.array([np.square(np.abs(source.echoes(pose)[0])).sum(dtype=float) for pose in poses])
    level, whole = (
        np.hypot(poses[:, 0], AHEAD - poses[:, 1]),
        np.sqrt(poses[:, 0] ** 2 + (AHEAD - poses[:, 1]) ** 2 + poses[:, 2] ** 2),
    )
    return np.asarray(energy * whole**4 / (level / whole) ** 2)


@pytest.fixture
def poses() -> Array:
    """Heights apart, at which the points of a rod add up with other phases, and places within a bin and a beam."""
    rng = np.random.default_rng(1)
    result = np.zeros((60, 6))
    result[:, 0], result[:, 1], result[:, 2] = (
        rng.uniform(-0.1, 0.1, 60),
        rng.uniform(-0.02, 0.02, 60),
        np.linspace(-1, 1, 60),
    )
    return result


@pytest.mark.thorough
@pytest.mark.parametrize("diameter", essence([0.002, 0.004, 0.008], 0.004, rest=pytest.mark.slow))
@pytest.mark.parametrize("mesh", [True, False])
def test_a_thin_rod_has_the_energy_of_its_diameter_in_every_ping(
    poses: Array, tmp_path: Path, diameter: float, mesh: bool
) -> None:
    """Lambert's law on a cylinder has the sum of cos^2 dA = pi / 4 diameter length; speckle has std / mean of 1 at most.

    Rays are 5 mm apart; alone, they left 30 % of the pings of a rod of 4 mm empty, and 67 % of one of 2 mm.
    """
    folder = tmp_path if mesh else None
    thin, thick = energies(rod(diameter, folder), poses) / diameter, energies(rod(0.06, folder), poses) / 0.06
    assert 10 * math.log10(thin.mean() / thick.mean()) == pytest.approx(0, abs=1.5)
    assert thin.std() < 1.3 * thin.mean()
    assert thin.min() > 1e-3 * thin.mean()


@pytest.mark.parametrize("kind", ["cube", "rectangle"])
def test_its_points_are_those_that_rays_find(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """A wide body is traced either way, with patches of the grain: the same complex image but for its edges."""
    import mitsuba as mi

    turned = mi.ScalarTransform4f().translate([0, AHEAD, 0]).rotate([0.3, 0.2, 1], 30).rotate([1, 0, 0], 90)
    loaded = scene(body={"type": kind, "to_world": turned.scale([0.15, 0.2, 0.1]), "bsdf": diffuse(0.5)})
    sonar = FAN.replace(speckle_nu=1.0)
    pose = np.array([0.03, 0, 0.1, math.radians(1), 0, 0])
    by_rays = imager(loaded, sonar)
    assert by_rays.tracer.thin_points is None
    monkeypatch.setattr("mitsonar.simulation.thin_shapes.COLUMNS", 1000.0)
    by_points = imager(loaded, sonar)
    assert by_points.tracer.thin_points is not None
    first, second = by_rays.echoes(pose)[0].ravel(), by_points.echoes(pose)[0].ravel()
    alike = abs(np.vdot(first, second)) / np.linalg.norm(first) / np.linalg.norm(second)
    assert alike > 0.98
    assert np.linalg.norm(second) / np.linalg.norm(first) == pytest.approx(1, abs=0.02)


def test_what_hides_a_rod_hides_its_points() -> None:
    wall = plate((0, 4.2, 0), (0, -1, 0), half=0.3, bsdf=diffuse(0.0))
    open_view, hidden = (imager(scene(rod=rod(0.004), **others), FAN) for others in ({}, {"wall": wall}))
    assert open_view.echoes(np.zeros(6))[1].points > 50
    assert hidden.echoes(np.zeros(6))[1].points == 0


@pytest.mark.slow
def test_the_largest_shapes_are_left_to_the_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded = scene(first=rod(0.002), second={**rod(0.01), "p0": [0.2, AHEAD, -0.1], "p1": [0.2, AHEAD, 0.1]})
    source = imager(loaded, FAN).tracer
    assert np.array(source.is_thin).tolist() == [True, True]
    monkeypatch.setattr("mitsonar.simulation.thin_shapes.MOST_POINTS", 300)
    assert np.array(imager(loaded, FAN).tracer.is_thin).tolist() == [True, False]


@pytest.mark.slow
def test_instances_are_left_to_the_rays() -> None:
    group = {"type": "shapegroup", "rod": rod(0.01)}
    loaded = scene(group=group, one={"type": "instance", "group": {"type": "ref", "id": "group"}}, other=rod(0.004))
    source = imager(loaded, FAN)
    names = [shape.class_name() for shape in loaded.shapes()]
    assert np.array(source.tracer.is_thin).tolist() == [name != "Instance" for name in names]
    assert source.echoes(np.zeros(6))[1].points > 50


@pytest.mark.thorough
def test_shapes_without_points_are_left_to_the_rays() -> None:
    black = {**rod(0.004), "bsdf": diffuse(0.0)}
    source = imager(scene(rod=black), FAN)
    assert source.tracer.thin_points is None
    assert not source.echoes(np.zeros(6))[0].any()


def test_flipped_normals_change_nothing() -> None:
    plain, flipped = (imager(scene(rod={**rod(0.018), "flip_normals": flip}), FAN) for flip in (False, True))
    power = [(np.abs(one.echoes(np.zeros(6))[0]) ** 2).sum(axis=1) for one in (plain, flipped)]
    centroid = [float((FAN.range_m * one).sum() / one.sum()) for one in power]
    assert centroid == pytest.approx([AHEAD - 0.008] * 2, abs=0.004)


@pytest.mark.thorough
@pytest.mark.parametrize("mesh", [True, False])
def test_a_thin_shape_moves_between_pings(tmp_path: Path, mesh: bool) -> None:
    """By its vertices or its transform, as any other shape of a live scene."""
    import mitsuba as mi

    loaded = scene(rod=rod(0.004, tmp_path if mesh else None))
    simulator = Simulator(loaded, FAN.replace(coding="linear"))
    pose = np.zeros((1, 6))
    before = next(iter(simulator.pings(pose))).levels[0]
    params = mi.traverse(loaded)
    if mesh:
        place = np.array(params["rod.vertex_positions"]).reshape(-1, 3) + np.array([0, 0.2, 0])
        params["rod.vertex_positions"] = place.ravel()
    else:
        matrix = mi.ScalarTransform4f(np.array(params["rod.to_world"].matrix, dtype=float).reshape(4, 4))
        params["rod.to_world"] = mi.ScalarTransform4f().translate([0, 0.2, 0]) @ matrix
    params.update()
    after = next(iter(simulator.pings(pose))).levels[0]
    fresh = next(iter(Simulator(loaded, FAN.replace(coding="linear")).pings(pose))).levels[0]
    np.testing.assert_array_equal(after, fresh)
    assert after.sum() > 0.1 * before.sum()
    assert abs(int(after.sum(axis=1).argmax()) - int(before.sum(axis=1).argmax())) > 30
