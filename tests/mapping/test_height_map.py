"""Height maps: known ground is recovered within its standard deviations, mistakes are refused, files hold the map."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tifffile
import trimesh
from helpers import diffuse, floor, scene
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping import height_map
from mitsonar.mapping.height_map import HeightMap, HeightMapOptions, fit_height_map, most_trials, views_of
from mitsonar.mapping.height_map_files import save_height_map
from mitsonar.mapping.relief import ReliefView
from mitsonar.mapping.shadows import joined_shadow_heights, shadow_heights
from mitsonar.records.frames import SonarFrames

pytestmark = pytest.mark.filterwarnings("ignore:.* lie outside the window")

Array = NDArray[np.float64]

SONAR = Sonar(
    model="physical", elevation_fov_deg=16.0, azimuth_fov_deg=30.0, range_min=2.5, range_max=6.5, beams=32, range_bins=64
)
SMALL = HeightMapOptions(cells=24)
HEIGHT_M = 1.5
LOOKS = 4


def poses_around(count: int) -> Array:
    """Poses on a circle, which look at its middle."""
    turns = np.arange(count) * 2 * np.pi / max(1, count)
    return np.array([[-4 * math.sin(t), -4 * math.cos(t), HEIGHT_M, math.radians(20), 0, t] for t in turns])


def empty_frames(count: int) -> SonarFrames:
    image = np.ones((count, SONAR.range_bins, SONAR.beams), np.float32)
    return SonarFrames(image, SONAR.range_m, SONAR.bearing_rad, np.arange(count) / 10, SONAR)


def hills(view: ReliefView) -> Array:
    """Two hills on level ground."""
    x, y = view.grid.centres
    shape = sum(
        h * np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * 0.25**2)) for a, b, h in ((-0.4, 0.1, 0.3), (0.5, 0.4, 0.2))
    )
    return np.asarray(shape)


def drawn(count: int, height: float = 1.0, seed: int = 0) -> tuple[SonarFrames, Array, Array]:
    """Frames of the hills as the model has them, with speckle; poses, and the true map, north up."""
    frames, poses = empty_frames(count), poses_around(count)
    views, _ = views_of(frames, poses, np.full(count, HEIGHT_M), SMALL)
    true = height * hills(views[0])
    means = np.full((count, SONAR.range_bins, SONAR.beams), 1e-12)
    for image, view in zip(means, views, strict=True):
        levels = np.kron(0.3 * view.levels(true), np.ones((view.bins, view.beams)))
        image[: levels.shape[0], : levels.shape[1]] = levels
    levels = means * np.random.default_rng(seed).gamma(LOOKS, 1 / LOOKS, size=means.shape)
    scale = float(levels.max())
    return replace(frames, image=(levels / scale).astype(np.float32), level_scale=scale), poses, true[::-1]


@cache
def fitted(count: int) -> tuple[HeightMap, Array]:
    frames, poses, true = drawn(count)
    return fit_height_map(frames, poses, np.full(count, HEIGHT_M), SMALL), true


def rmse(values: Array, true: Array) -> float:
    return float(np.sqrt(np.nanmean(np.square(values - true))))


@pytest.mark.thorough
def test_one_frame_gives_hills_and_their_uncertainty() -> None:
    result, true = fitted(1)
    seen = np.isfinite(result.height_m)
    assert 0.4 < seen.mean() < 0.95
    assert rmse(result.height_m, true) < 0.6 * rmse(np.zeros_like(true), np.where(seen, true, np.nan))
    assert np.mean(np.abs(result.height_m - true)[seen] < 2 * result.std_m[seen]) > 0.8
    assert abs(result.reflectivity - 0.3) < 0.06
    assert result.regulariser in result.trials
    assert len(result.trials) <= most_trials() + 1
    assert result.regulariser.deviance == min(trial.deviance for trial in result.trials)


@pytest.mark.thorough
def test_frames_from_all_sides_give_a_better_map_than_one() -> None:
    one, several = fitted(1)[0], fitted(3)[0]
    true = fitted(3)[1]
    assert rmse(several.height_m, true) < 0.35 * rmse(np.zeros_like(true), true)
    assert np.nanmedian(several.std_m) < np.nanmedian(one.std_m)
    assert several.frames == 3
    assert abs(several.ground_m) < 1e-12


def test_the_standard_deviation_is_larger_in_shadow() -> None:
    result, _ = fitted(1)
    # Ground that level ground would show and the hills hide: behind the higher hill, seen from the south.
    x, y = result.centres
    hidden = (np.abs(x + 0.4) < 0.15) & (np.abs(y - 0.85) < 0.15)
    beside = (np.abs(x - 0.0) < 0.1) & (np.abs(y + 0.8) < 0.2)
    assert np.nanmean(result.std_m[hidden]) > 1.3 * np.nanmean(result.std_m[beside])


@pytest.mark.thorough
def test_speckle_of_the_simulator_leaves_a_box_in_place(variant: str) -> None:
    import mitsuba as mi

    from mitsonar.simulation.simulator import Simulator

    sonar = SONAR.replace(model="coherent", frequency_hz=1.8e6, range_bins=256, source_level_db=200, noise_level_db=70)
    to_world = mi.ScalarTransform4f().scale([0.4, 0.25, 0.2])
    box = {"type": "cube", "to_world": to_world, "bsdf": {"type": "twosided", "inner": diffuse(0.3)}}
    frames = Simulator(scene(floor=floor(diffuse(0.3)), box=box), sonar).render(poses_around(2))
    result = fit_height_map(frames, poses_around(2), np.full(2, HEIGHT_M), HeightMapOptions(cells=40))
    x, y = result.centres
    true = np.where((np.abs(x) < 0.4) & (np.abs(y) < 0.25), 0.2, 0.0)
    seen = np.isfinite(result.height_m)
    assert rmse(result.height_m, true) < 0.7 * rmse(np.zeros_like(true), np.where(seen, true, np.nan))
    assert abs(np.nanmedian(result.height_m[(np.abs(x) < 0.25) & (np.abs(y) < 0.1)]) - 0.2) < 0.08  # speckle of two frames


def test_a_shadow_gives_the_height_of_a_wall() -> None:
    frames, poses, _ = drawn(1)
    view = views_of(frames, poses, np.array([HEIGHT_M]), HeightMapOptions(cells=64))[0][0]
    wall = np.zeros((64, 64))
    wall[30:32] = 0.2
    heights = shadow_heights(view, view.levels(wall), 1.0)
    middle = heights[:, 28:36].max(axis=0)
    np.testing.assert_allclose(middle, 0.2, atol=0.03)
    assert not shadow_heights(view, view.levels(0 * wall), 1.0).any()


def test_frames_without_a_shadow_do_not_lower_a_wall() -> None:
    """A wall that only one of two frames shows has the height that this frame gives."""
    frames, poses, _ = drawn(2)
    views, _ = views_of(frames, poses, np.full(2, HEIGHT_M), HeightMapOptions(cells=64))
    wall = np.zeros((64, 64))
    wall[30:32] = 0.2
    levels = [views[0].levels(wall), views[1].levels(0 * wall)]
    np.testing.assert_allclose(joined_shadow_heights(views, levels, 1.0), shadow_heights(views[0], levels[0], 1.0))
    both = [view.levels(wall) for view in views]
    each = [shadow_heights(view, y, 1.0) for view, y in zip(views, both, strict=True)]
    shared = (each[0] > 0) & (each[1] > 0)
    assert shared.any()
    np.testing.assert_allclose(joined_shadow_heights(views, both, 1.0)[shared], np.mean(each, axis=0)[shared])


@pytest.mark.thorough
def test_the_same_frames_give_the_same_map() -> None:
    frames, poses, _ = drawn(1)
    again = fit_height_map(frames, poses, np.array([HEIGHT_M]), SMALL)
    np.testing.assert_array_equal(again.height_m, fitted(1)[0].height_m)


@pytest.mark.thorough
def test_a_rejected_regulariser_leaves_the_map_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same map comes out when only the regularisers are tried that the search has taken."""
    result, _ = fitted(1)
    tried = result.trials[1:]
    taken = [trial for k, trial in enumerate(tried) if all(trial.deviance < one.deviance for one in tried[:k])]
    assert len(taken) < len(tried), "some are rejected"
    parts = sorted(trial.std_m / HEIGHT_M for trial in taken)
    monkeypatch.setattr(height_map, "STDS", tuple(parts))
    monkeypatch.setattr(height_map, "FIRST", parts.index(tried[0].std_m / HEIGHT_M))
    frames, poses, _ = drawn(1)
    alone = fit_height_map(frames, poses, np.array([HEIGHT_M]), SMALL)
    assert alone.regulariser.std_m == pytest.approx(result.regulariser.std_m)
    np.testing.assert_allclose(alone.height_m, result.height_m, atol=1e-6)


def test_level_ground_is_refused() -> None:
    frames, poses, _ = drawn(1, height=0.0, seed=3)
    with pytest.raises(MitsonarError, match="show no relief"):
        fit_height_map(frames, poses, np.array([HEIGHT_M]), SMALL)


def test_what_cannot_work_is_refused() -> None:
    frames, poses, _ = drawn(1)
    known = np.array([HEIGHT_M])
    few = replace(frames, image=frames.image[:, :, :4], bearing_rad=frames.bearing_rad[:4])
    with pytest.raises(MitsonarError, match=r"8 beams and bins or more.*got 4 beams"):
        fit_height_map(few, poses, known)
    short = replace(frames, image=frames.image[:, :3], range_m=frames.range_m[:3])
    with pytest.raises(MitsonarError, match=r"got 32 beams and 3 bins"):
        fit_height_map(short, poses, known)
    with pytest.raises(MitsonarError, match="rotating head"):
        fit_height_map(replace(frames, sonar=SONAR.replace(ping_groups=32)), poses, known)
    with pytest.raises(MitsonarError, match="some are unknown"):
        fit_height_map(frames, poses, np.array([np.nan]))
    with pytest.raises(MitsonarError, match="shows no ground"):
        fit_height_map(frames, poses, np.array([30.0]))
    with pytest.raises(MitsonarError, match="shows no ground"):
        fit_height_map(frames, poses * [1, 1, 1, -1, 1, 1], known)
    edges = replace(frames, sonar=SONAR.replace(elevation_pattern="two_way"))
    with pytest.raises(MitsonarError, match="no frame shows ground within the elevation field of view"):
        fit_height_map(edges, poses * [1, 1, 1, 0.1, 1, 1], known)
    with pytest.raises(MitsonarError, match="one for each frame"):
        fit_height_map(frames, poses_around(2), known)
    with pytest.raises(MitsonarError, match="no echo"):
        fit_height_map(replace(frames, image=0 * frames.image), poses, known)
    with pytest.raises(MitsonarError, match="nan or inf"):
        fit_height_map(replace(frames, image=np.nan * frames.image), poses, known)
    with pytest.raises(MitsonarError, match="no levels"):
        fit_height_map(replace(frames, level="contrast"), poses, known)
    for cells in (8, 1000):
        with pytest.raises(MitsonarError, match=r"16\.\.96"):
            HeightMapOptions(cells)


def test_a_mesh_holds_the_known_cells(tmp_path: Path) -> None:
    result, _ = fitted(1)
    save_height_map(tmp_path / "map.ply", result)
    mesh = trimesh.load_mesh(tmp_path / "map.ply", process=False)
    known = np.isfinite(result.height_m)
    assert len(mesh.vertices) == known.sum()
    x, y = result.centres
    np.testing.assert_allclose(mesh.vertices, np.column_stack([x[known], y[known], result.height_m[known]]), atol=1e-5)
    assert (mesh.face_normals[:, 2] > 0).all(), "faces point up"
    stored = mesh.metadata["_ply_raw"]["vertex"]["data"]["std_m"]
    np.testing.assert_allclose(np.ravel(stored), result.std_m[known], rtol=1e-6)


def test_a_mesh_far_from_the_origin_keeps_its_cells(tmp_path: Path) -> None:
    far = replace(fitted(1)[0], west_m=500_000.0, north_m=6_000_000.0)
    save_height_map(tmp_path / "map.ply", far)
    mesh = trimesh.load_mesh(tmp_path / "map.ply", process=False)
    known = np.isfinite(far.height_m)
    x, y = far.centres
    np.testing.assert_allclose(mesh.vertices[:, :2], np.column_stack([x[known], y[known]]), rtol=0, atol=1e-6)


def test_a_geotiff_is_north_up_and_in_metres(tmp_path: Path) -> None:
    result, _ = fitted(1)
    save_height_map(tmp_path / "map.tif", result)
    with tifffile.TiffFile(tmp_path / "map.tif") as file:
        page = file.pages[0]
        assert isinstance(page, tifffile.TiffPage)
        bands, tags = file.asarray(), page.tags
        assert tags["ModelPixelScaleTag"].value[:2] == (result.cell_m, result.cell_m)
        assert tags["ModelTiepointTag"].value[3:5] == (result.west_m, result.north_m)
    np.testing.assert_array_equal(bands, np.stack([result.height_m, result.std_m]).astype(np.float32))


def test_arrays_and_other_endings(tmp_path: Path) -> None:
    result, _ = fitted(1)
    save_height_map(tmp_path / "map.npz", result)
    with np.load(tmp_path / "map.npz", allow_pickle=False) as table:
        np.testing.assert_array_equal(table["std_m"], result.std_m)
        assert table["trials"].shape == (len(result.trials), 3)
    with pytest.raises(MitsonarError, match="must end in one of"):
        save_height_map(tmp_path / "map.obj", result)
