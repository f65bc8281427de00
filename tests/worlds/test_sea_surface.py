"""The world ``sea-surface``: what the mesh holds and what it leaves, its shape, its material, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.worlds.families import create_family
from mitsonar.worlds.sea import SeaSurface

SMALL: dict[str, Any] = {"size_m": 8.0, "step_m": 0.25, "wind_m_s": 3.0, "water_m": 6.0}


@pytest.mark.parametrize("more", [{}, {"step_m": 0.05}, {"spectrum": "jonswap", "fetch_km": 1.0}])
def test_mesh_and_roughness_share_the_variance(more: dict[str, Any]) -> None:
    """Squares of both rms heights add to that of all waves."""
    state = SeaSurface(**{**SMALL, **more}).state
    assert state.rms_m**2 + state.roughness_m**2 == pytest.approx(state.significant_height_m**2 / 16, rel=1e-5)
    assert 0 < state.roughness_m < state.rms_m


def test_a_tenth_of_the_step_leaves_a_tenth_of_the_roughness() -> None:
    """sqrt(alpha) / 2 k in the tail, k that of waves of four steps."""
    for step in (0.2, 0.02):
        state = SeaSurface(**{**SMALL, "size_m": 2.0, "step_m": step}).state
        assert state.roughness_m == pytest.approx(math.sqrt(0.0081) / 2 * 4 * step / (2 * math.pi), rel=0.05 * step)


def test_the_mesh_is_a_square_that_faces_down() -> None:
    sea = SeaSurface(**SMALL)
    mesh = sea.surface(3)
    assert (len(mesh.vertices), len(mesh.faces)) == (33**2, 2 * 32**2)
    assert mesh.vertices[:, :2].min(axis=0) == pytest.approx([-4, -4])
    assert mesh.vertices[:, :2].max(axis=0) == pytest.approx([4, 4])
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal[:, 2] < 0).all()
    assert -normal[:, 2].sum() / 2 == pytest.approx(64)
    assert abs(mesh.vertices[:, 2].mean() - 6) < 0.2
    assert 0.5 < mesh.vertices[:, 2].std() / sea.state.rms_m < 1.6


def test_no_wind_is_a_flat_surface() -> None:
    sea = SeaSurface(**{**SMALL, "wind_m_s": 0.0, "step_m": 5.0})
    mesh = sea.surface(0)
    assert len(mesh.faces) == 2
    assert (mesh.vertices[:, 2] == 6).all()
    assert sea.state.roughness_m == sea.state.rms_m == 0
    assert sea.build(1).about == "sea-surface, seed 1: flat"


def test_a_sea_goes_on_in_time() -> None:
    """A moment later is nearly the same surface; the option is the argument."""
    sea = SeaSurface(**SMALL)
    first, soon, later = (sea.surface(3, time).vertices[:, 2] for time in (0.0, 0.02, 30.0))
    assert np.abs(soon - first).max() < 0.03
    assert (soon != first).any()
    assert abs(np.corrcoef(first, later)[0, 1]) < 0.9
    assert np.array_equal(SeaSurface(**SMALL, time_s=30.0).surface(3).vertices[:, 2], later)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("wind", [0.0, 3.0])
def test_the_scene_has_the_surface_as_a_mirror(wind: float, tmp_path: Path) -> None:
    """The shapes' ids, the mirror part of its material, and a sonar below: a flat mirror sends nothing back to it."""
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.simulation.mirrors import mirror_of
    from mitsonar.simulation.scene import load_scene, sonar_in
    from mitsonar.simulation.simulator import Simulator

    sea = SeaSurface(**{**SMALL, "wind_m_s": wind})
    path = sea.build(2).write(tmp_path / "sea")
    scene = load_scene(path)
    assert sorted(shape.id() for shape in scene.shapes()) == ["seabed", "surface"]
    mirrors = mirror_of(scene, "materials")
    assert mirrors is not None
    place = [shape.id() for shape in scene.shapes()].index("surface")
    assert mirrors.reflection[place] == -1
    assert mirrors.roughness_m[place] == pytest.approx(sea.state.roughness_m, rel=1e-3)
    result = sonar_in(scene)
    assert result is not None
    sonar, pose = result
    (ping,) = Simulator(scene, Sonar.create(**{**sonar.model_dump(), "beams": 8, "model": "physical"})).pings([pose])
    assert (np.asarray(ping.levels).sum() > 0) == (wind > 0)
    assert len(SeaSurface(**SMALL, seabed_cells=0).build(0).xml().split("<shape")) == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"step_m": 4.0, "size_m": 40.0}, r"a quarter of the peak's wavelength, 2 m at a wind of 3 m/s.*: got 4 m"),
        ({"step_m": 2.0}, r"size_m must be at least 8 step_m, 16 m: got 8 m"),
        (
            {"step_m": 0.005},
            r"at most 2,000,000 triangles, and 8 m in steps of 0.005 m would have 5,120,000: give a step",
        ),
        ({"spectrum": "jonswap", "fetch_km": 400.0}, r"holds for fetches from .* km at a wind of 3 m/s: got 400 km"),
        ({"wind_m_s": 41.0}, r"wind_m_s.*less than or equal to 40, got 41"),
        ({"wind_m_s": float("nan")}, r"wind_m_s"),
        ({"time_s": float("inf")}, r"time_s"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(options: dict[str, Any], said: str) -> None:
    with pytest.raises(MitsonarError, match=said) as refusal:
        create_family("sea-surface", **{**SMALL, **options})
    assert "\n" not in str(refusal.value)


@pytest.mark.usefixtures("variant")
@pytest.mark.thorough
def test_images_have_ghosts_where_the_flat_surface_says_and_waves_take_a_part(tmp_path: Path) -> None:
    """A ball of 5 cm, 0.8 m below: one way by the surface half the way round, both ways the image's range; within 5 mm."""
    import mitsuba as mi
    from helpers import diffuse

    from mitsonar.instruments.sonar import Sonar
    from mitsonar.simulation.simulator import Simulator

    straight, image = 4.4 - 0.05, math.hypot(4.4, 1.6) - 0.05
    ranges_m = straight, (straight + image) / 2, image
    keys = {"elevation_fov_deg": 60, "range_min": 3.5, "range_max": 7, "range_bins": 700}
    sonar = Sonar.create(model="physical", bounces=3, frequency_hz=9e5, **keys)
    near = [np.abs(sonar.range_m - range_m) < 0.03 for range_m in ranges_m]

    def levels(wind: float, seed: int) -> NDArray[np.float64]:
        SeaSurface(wind_m_s=wind, size_m=12.0, step_m=0.05).save(tmp_path / "sea.ply", seed)
        surface = {"type": "ply", "filename": str(tmp_path / "sea.ply"), "face_normals": True, "bsdf": diffuse(0.0)}
        ball = {"type": "sphere", "center": [0, 4.4, 9.2], "radius": 0.05, "bsdf": diffuse(0.3)}
        scene = mi.load_dict({"type": "scene", "surface": surface, "ball": ball}, optimize=False)
        (ping,) = Simulator(scene, sonar, mirrors={"surface": (-1.0, 0.0)}).pings(np.array([0, 0, 9.2, 0, 0, 0]))
        return np.asarray(np.asarray(ping.levels[0], dtype=float).sum(axis=1))

    flat = levels(0.0, 0)
    for part, range_m in zip(near, ranges_m, strict=True):
        first = np.flatnonzero(flat[part] > 0.2 * flat[part].max())[0]
        assert sonar.range_m[part][first] == pytest.approx(range_m, abs=0.005)
    waves = np.mean([levels(2.0, seed) for seed in range(4)], axis=0)
    left = [waves[part].sum() / flat[part].sum() for part in near]
    assert left[0] == pytest.approx(1, abs=1e-3)
    assert 0.2 < left[1] < 0.9
