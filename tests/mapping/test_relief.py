"""The image of a height map: against the simulator, against closed forms of shadows, and its derivatives."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from helpers import diffuse, floor, scene
from numpy.typing import NDArray

from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping.relief import GroundCells, ReliefView, lit_ground
from mitsonar.worlds.world import Mesh

pytestmark = pytest.mark.filterwarnings("ignore:.* lie outside the window")

Array = NDArray[np.float64]

WINDOW = {"range_min": 2.5, "range_max": 6.5, "range_bins": 256, "beams": 48, "azimuth_fov_deg": 30.0}
SONAR = Sonar(model="physical", elevation_fov_deg=14.0, quality="fine", gain_exponent=2, **WINDOW)
POSE = np.array([0.3, -0.2, 1.5, math.radians(20), math.radians(2), 0.4])
GRID = GroundCells(-2.0, 0.0, 0.1, 64, 0.0)


def rendered(view: ReliefView, **shapes: dict[str, object]) -> Array:
    """What the simulator makes of a scene, in blocks."""
    from mitsonar.simulation.simulator import Simulator

    frames = Simulator(scene(**shapes), view.sonar).render([POSE], gain=1.0)
    return view.averaged(frames.image[0] * frames.level_scale)


def inner(view: ReliefView, reach: float = 0.9) -> NDArray[np.bool_]:
    """Blocks away from the border of the fan and of the lit ground."""
    inside = view.used.copy()
    inside[:, [0, 1, -2, -1]] = False
    points = lit_ground(view.sonar.replace(elevation_fov_deg=view.sonar.elevation_fov_deg * reach), view.bearing_rad,
                        view.range_m, POSE, 0.0)  # fmt: skip
    return inside & np.isfinite(points).all(axis=-1)


@pytest.mark.parametrize(
    "changes", [{}, {"bearing": "cone"}, {"gain_exponent": 4}, {"pattern": "two_way", "bearing": "cone"}]
)
def test_level_ground_has_the_levels_of_the_model_physical(changes: dict[str, object], variant: str) -> None:
    view = ReliefView(SONAR.replace(**changes), SONAR.bearing_rad, POSE, GRID)
    ratio = view.levels(np.zeros((64, 64)))[inner(view)] / rendered(view, floor=floor(diffuse(1.0)))[inner(view)]
    assert abs(np.mean(ratio) - 1) < 0.02
    assert np.quantile(np.abs(ratio - 1), 0.95) < 0.06


def test_waves_have_the_levels_of_the_model_physical(variant: str, tmp_path: Path) -> None:
    x, y = GRID.centres
    height = 0.04 * np.sin(2 * np.pi * x / 0.9) * np.cos(2 * np.pi * y / 1.3)
    number = np.arange(64 * 64).reshape(64, 64)
    first, right, up, both = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    faces = np.concatenate([np.column_stack([first, right, both]), np.column_stack([first, both, up])])
    vertices = np.column_stack([x.ravel(), y.ravel(), height.ravel()])
    path = tmp_path / "waves.ply"
    path.write_bytes(Mesh("waves", vertices, faces, np.ones(len(faces)), np.ones(len(faces), dtype=int)).ply())
    view = ReliefView(SONAR, SONAR.bearing_rad, POSE, GRID)
    body = {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": diffuse(1.0)}
    truth, model, used = rendered(view, waves=body), view.levels(height), inner(view, 0.8)
    assert np.corrcoef(truth[used], model[used])[0, 1] > 0.98
    assert abs(model[used].mean() / truth[used].mean() - 1) < 0.02
    flat = view.levels(np.zeros_like(height))
    assert np.corrcoef(truth[used], flat[used])[0, 1] < 0.8, "the waves must show, or the test is void"


@pytest.mark.parametrize("pattern", ["two_way", "receive"])
def test_wide_patterns_light_the_ground(pattern: str) -> None:
    """A pattern that is faint nowhere lights what a narrower one does, and more."""
    lit = []
    for wide in (30.0, 60.0, 90.0):
        sonar = SONAR.replace(elevation_fov_deg=wide, elevation_pattern=pattern)
        lit.append(np.isfinite(lit_ground(sonar, sonar.bearing_rad, sonar.range_m, POSE, 0.0)).all(axis=-1))
    assert lit[0].any()
    assert (lit[1] | ~lit[0]).all()
    assert (lit[2] | ~lit[1]).all()


def test_a_wall_hides_what_lies_within_its_shadow() -> None:
    # A wall 0.2 m high and one cell thick; a shadow from range a ends at b with 0.2 = H (1 - a / b).
    pose = np.array([0.0, 0.0, 1.5, math.radians(20), 0.0, 0.0])
    grid = GroundCells(-3.2, 1.0, 0.05, 128, 0.0)
    height = np.zeros((128, 128))
    height[50] = 0.2
    view = ReliefView(SONAR, SONAR.bearing_rad, pose, grid)
    middle = view.shape[1] // 2
    ratio = view.levels(height)[:, middle] / np.maximum(view.levels(0 * height)[:, middle], 1e-30)
    top = math.hypot(float(grid.centres[1][50, 0]), 1.3)
    end = top * 1.5 / 1.3
    dark = (view.range_m > top + 5 * view.block_m) & (view.range_m < end - 5 * view.block_m)
    lit = (view.range_m > end + 5 * view.block_m) & view.used[:, middle]
    assert min(dark.sum(), lit.sum()) > 5
    assert ratio[dark].max() < 1e-9
    np.testing.assert_allclose(ratio[lit], 1, atol=1e-9)


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_derivatives_are_those_of_differences(bearing: str) -> None:
    sonar = SONAR.replace(bearing=bearing, pattern="two_way", azimuth_fov_deg=90.0)
    view = ReliefView(sonar, sonar.bearing_rad, POSE, GRID)
    rng = np.random.default_rng(5)
    x, y = GRID.centres
    hills = 0.3 * np.exp(-((x - 0.5) ** 2 + (y - 3) ** 2) / 0.1) + rng.normal(0, 0.01, x.shape)
    assert (view.levels(hills) < 0.01 * view.levels(0 * hills))[view.used].mean() > 0.005, "there must be shadows"
    levels, derivative = view.derivative(hills)
    np.testing.assert_array_equal(levels, view.levels(hills))
    direction, step = rng.normal(size=x.shape), 1e-7
    numeric = (view.levels(hills + step * direction) - view.levels(hills - step * direction)) / (2 * step)
    analytic = (derivative @ direction.ravel()).reshape(view.shape)
    assert np.abs(numeric - analytic).max() < 1e-3 * np.abs(numeric).max()


def test_speckle_of_a_block_has_its_samples_at_most() -> None:
    coherent = SONAR.replace(model="coherent", frequency_hz=1.8e6)
    view = ReliefView(coherent, coherent.bearing_rad, POSE, GRID)
    assert 0.2 * view.bins * view.beams < view.looks < view.bins * view.beams
    assert ReliefView(coherent.replace(looks=3), coherent.bearing_rad, POSE, GRID).looks > view.looks
    assert math.isinf(ReliefView(SONAR, SONAR.bearing_rad, POSE, GRID).looks)
