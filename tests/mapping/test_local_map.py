"""The local map: a path over relief whose pair motions are wrong in one way comes back straight and as long as it is."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mitsonar.config.data import load_recipe
from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.estimation.named import Zero
from mitsonar.geometry.fan import Views, polar_of
from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping import local_map
from mitsonar.mapping.local_map import ImageAxes, mapped
from mitsonar.mapping.odometry import OdometryOptions, odometry, series_of
from mitsonar.mapping.pairs import EstimateStore
from mitsonar.mapping.series import MotionSeries, path_of, pose_covariances
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import Motion, motions
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import Readings, VehicleSensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator
from mitsonar.worlds.families import RockyField

FRAMES, STEP_M = 48, 0.02
WRONG = np.array([0.0, 0.97, np.radians(0.03)])
"""What is wrong with the motions between two frames: too short by 3 %, and a turn of 0.03 deg each."""


@lru_cache(maxsize=2)
def run(heave_m: float = 0.0) -> SonarFrames:
    """Return frames of a path straight on over bright points: half on the ground, half on a relief of 0.25 m."""
    rng = np.random.default_rng(7)
    points = np.column_stack([rng.uniform(-2, 2, 9000), rng.uniform(1, 8, 9000), rng.exponential(0.25, 9000)])
    points[::2, 2] = 0
    bright = rng.uniform(0.2, 1, 9000).astype(np.float32)
    sonar = Sonar(
        range_min=3.2, range_max=5.6, range_bins=400, beams=96, azimuth_fov_deg=29, bearing="cone", model="physical"
    )
    poses = np.zeros((FRAMES, 6))
    poses[:, 1], poses[:, 2], poses[:, 3] = STEP_M * np.arange(FRAMES), 2.5, np.radians(35)
    poses[:, 2] += heave_m * np.sin(np.arange(FRAMES) / 4)
    ranges, bearings = sonar.range_m, sonar.bearing_rad
    axes, images = ImageAxes(ranges, bearings, "cone"), []
    for pose in poses:
        cells = axes.cells(polar_of(points, Views.of(pose), "cone"))
        images.append(_drawn(cells, bright))
    image = np.stack(images) / np.max(images)
    return SonarFrames(
        image=image.astype(np.float32),
        range_m=ranges,
        bearing_rad=bearings,
        time_s=np.arange(FRAMES) / 10,
        sonar=sonar,
        poses=poses,
        height_m=np.full(FRAMES, 2.5),
    )


def _drawn(cells: NDArray[np.float64], bright: NDArray[np.float32]) -> NDArray[np.float32]:
    """Draw points between cells: each shares its brightness with its four neighbours, and the image is smoothed."""
    image = np.zeros((404, 100), dtype=np.float32)
    low = np.floor(cells).astype(int)
    part = cells - low
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = np.abs(1 - row - part[:, 0]) * np.abs(1 - column - part[:, 1])
        r, c = low[:, 0] + row + 2, low[:, 1] + column + 2
        inside = (r >= 0) & (r < 404) & (c >= 0) & (c < 100)
        np.add.at(image, (r[inside], c[inside]), (share * bright)[inside])
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigmaX=0.8, sigmaY=1.5)[2:-2, 2:-2])


def wrong_estimates() -> list[Estimate]:
    """Return motions that are wrong in one way, with covariances that believe them to half of that."""
    poses = run().poses
    assert poses is not None
    true = motions(poses)
    wrong = true * [1, WRONG[1], 1] + [0, 0, WRONG[2]]
    return [Estimate(Motion(*one.tolist()), np.diag([3e-4, 3e-4, 3e-4]) ** 2) for one in wrong]


@pytest.mark.thorough
def test_the_map_takes_out_what_pairs_of_frames_get_wrong() -> None:
    frames = run()
    result = mapped(FrameSource.of(frames), np.arange(FRAMES), wrong_estimates())
    assert all(one.about["map"] == "used" for one in result)
    series = series_of(result, frames.time_s)
    assert frames.poses is not None
    start = Pose(*frames.poses[0])
    path, before = (
        path_of(moves, start, frames.time_s).poses
        for moves in (series.motions, series_of(wrong_estimates(), frames.time_s).motions)
    )
    error, plain = path[-1] - frames.poses[-1], before[-1] - frames.poses[-1]
    length = STEP_M * (FRAMES - 1)
    assert abs(plain[1]) > 0.025 * length
    assert abs(error[1]) < 0.008 * length, "the length of the path"
    assert abs(error[5]) < 0.15 * abs(plain[5])
    assert abs(error[0]) < 0.01 * length
    covariance = pose_covariances(series, start)[-1]
    assert 1e-4 < np.sqrt(covariance[0, 0]) < 0.02


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* lie outside the window")
@pytest.mark.parametrize("seed", [7, 904])
def test_a_path_ahead_over_speckled_rocks_is_as_long_as_it_is(seed: int, tmp_path: Path) -> None:
    # with patches as smooth as those of still ground, and landmarks drawn to the ground, it was 3 % too long
    world, parameters = RockyField(size_m=50).prepare(seed, tmp_path / "world")
    coded = {"coding": "gamma", "coding_gamma": 0.5, "gain_exponent": 4}
    sonar = load_recipe("rocky-field-physical").instrument.replace(model="coherent", quality="standard", **coded)
    poses = np.zeros((120, 6))
    poses[:, 1], poses[:, 2], poses[:, 3] = 0.0054 * np.arange(120) - 5.2, 2.5, np.radians(35)
    frames = Simulator(load_scene(world, **parameters), sonar).render(Trajectory(poses, np.arange(120) / 21), seed=1)
    path = odometry(frames, "direct", OdometryOptions(local_map=True)).path.poses
    assert path[-1, 1] - path[0, 1] == pytest.approx(0.0054 * 119, rel=0.01)


@pytest.mark.thorough
def test_heave_that_no_sensor_tells_is_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = run(0.012)
    blind = FrameSource.of(replace(frames, poses=None)).with_geometry(pitch_rad=np.radians(35))
    errors = []
    for std in (local_map.ROUGH_STD, local_map.ATTITUDE_STD):
        monkeypatch.setattr(local_map, "ROUGH_STD", std)
        result = mapped(blind, np.arange(FRAMES), wrong_estimates())
        errors.append(abs(sum(one.motion.forward for one in result) - STEP_M * (FRAMES - 1)))
    assert errors[0] < 0.5 * errors[1], "heave changes the length of the path where it is not estimated"


def test_heave_by_a_depth_sensor_moves_the_sonar_and_not_the_ground() -> None:
    frames = replace(run(), poses=None, height_m=None)
    rise = 0.2 * np.sin(np.arange(FRAMES) / 4)
    depth = Readings(frames.time_s, 10 - rise, np.full(FRAMES, 1e-3))
    source = FrameSource.of(frames).with_geometry(2.5, np.radians(35)).with_sensors(VehicleSensors(depth=depth))[0]
    assert source.rise_m is not None
    table, _ = local_map.map_attitudes(source, np.arange(FRAMES))
    np.testing.assert_allclose(table[:, 2], 2.5 + source.rise_m - source.rise_m.mean())


def test_a_window_s_covariance_is_shared_among_motions_that_add_up_to_it() -> None:
    """Twenty alike motions ahead that turn about the ground: they come back, but for how levers scatter about their mean."""
    count, step = 20, 0.05
    one = np.array([[1.2e-5, 0.0, -3.4e-6], [0.0, 4e-8, 0.0], [-3.4e-6, 0.0, 1e-6]])
    series = MotionSeries(np.tile([0.0, step, 0.0], (count, 1)), np.arange(count + 1.0), np.tile(one, (count, 1, 1)))
    whole = pose_covariances(series, Pose(0, 0, 0))[-1]
    poses = path_of(series.motions, Pose(0, 0, 0), series.time_s).poses
    scatter = np.diag([one[2, 2] * step**2 * (count**2 - 1) / 12, 0, 0])
    np.testing.assert_allclose(local_map._covariance_per_motion(whole, poses), one + scatter, rtol=1e-9, atol=1e-18)


def test_the_answer_is_a_function_of_frames_and_estimates() -> None:
    frames = run().select(slice(0, 20))
    first, second = (mapped(FrameSource.of(frames), np.arange(20), wrong_estimates()[:19]) for _ in range(2))
    assert [one.motion for one in first] == [one.motion for one in second]


def test_frames_that_show_nothing_keep_the_motion_of_the_pair() -> None:
    frames = run().select(slice(0, 12))
    dark = frames.image.copy()
    dark[6:] = 0
    estimates = wrong_estimates()[:11]
    result = mapped(FrameSource.of(replace(frames, image=dark)), np.arange(12), estimates)
    assert [one.about["map"] == "used" for one in result[:5]] == [True] * 5
    assert all("landmarks" in one.about["map"] for one in result[5:])
    assert result[8].motion == estimates[8].motion


def test_frames_without_a_height_are_refused() -> None:
    frames = replace(run().select(slice(0, 4)), height_m=None)
    with pytest.raises(MitsonarError, match="height over the ground"):
        mapped(FrameSource.of(frames), np.arange(4), wrong_estimates()[:3])


def test_odometry_tells_what_the_map_did() -> None:
    frames = run().select(slice(0, 16))
    known, options = EstimateStore(dict(enumerate(wrong_estimates()[:15]))), OdometryOptions(local_map=True)
    result = odometry(frames, Zero(), options, store=known)
    assert ("motions by the local map", 15, "") in result.rows()
    assert result.warnings() == []
    plain = odometry(frames, Zero(), store=known)
    assert frames.poses is not None
    errors = [np.linalg.norm((one.path.poses - frames.poses)[-1, :2]) for one in (result, plain)]
    assert errors[0] < 0.5 * errors[1]
    dark = frames.image.copy()
    dark[4:] = 0
    blind = odometry(replace(frames, image=dark), Zero(), options, store=known)
    assert "are those of pairs of frames" in blind.warnings()[0]
    assert "compare the path without it" in blind.warnings()[0]
