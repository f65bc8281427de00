"""The height profile: what measures it and where the ground lies, in a run's folder, and a slope at constant depth."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from drawn_frames import over_ground, sway
from numpy.typing import NDArray

from mitsonar.estimation.estimator import Estimate
from mitsonar.estimation.named import create_estimator
from mitsonar.mapping.odometry import ALTIMETER, FIRST_ECHOES, HeightProfile, height_profile, odometry
from mitsonar.mapping.odometry_run import run_odometry
from mitsonar.mapping.sensors import SensorNoise, simulated_sensors
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import Motion, MotionPrior
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.sensors import Readings, VehicleSensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

Array = NDArray[np.float64]

COUNT = 6


@pytest.fixture(scope="module")
def source() -> FrameSource:
    return FrameSource.of(over_ground(sway(COUNT)))


def profile_of(source: FrameSource, *heights: float | None, depth: bool = False) -> HeightProfile:
    """The profile along the true path; of each pair a height by first echoes, or None."""
    still = Motion(0.0, 0.0, 0.0)
    message = [{} if one is None else {"height_m": one, "height_std_m": 0.02 * one} for one in heights]
    estimates = [Estimate(still, about=one) for one in message]
    path = source.true
    assert path is not None
    sensors = simulated_sensors(path, SensorNoise(depth_m=1e-9), seed=0) if depth else None
    return height_profile(source, np.arange(len(source)), estimates, sensors, path)


def test_ground_lies_below_a_path_that_starts_elsewhere_than_the_true_one(source: FrameSource) -> None:
    """The z of the ground belongs to x and y beside it: to the path, not to the poses of the frames."""
    true = source.true
    assert true is not None
    still = [Estimate(Motion(0.0, 0.0, 0.0))] * (COUNT - 1)
    moved = Trajectory(true.poses + np.array([10.0, 20.0, 30.0, 0, 0, 0]), true.time_s)
    here, there = (height_profile(source, np.arange(COUNT), still, None, path) for path in (true, moved))
    np.testing.assert_allclose(there.places - here.places, np.tile([10.0, 20.0], (COUNT, 1)))
    np.testing.assert_allclose(there.ground_z_m - here.ground_z_m, 30.0)


def test_first_echoes_come_before_an_altimeter_and_lie_ahead(source: FrameSource) -> None:
    assert source.poses is not None
    assert source.height_m is not None
    result = profile_of(source, 2.0, None, None, 2.2, 2.4)
    np.testing.assert_allclose(result.height_m, [2.0, 2.0, source.height_m[2], 2.2, 2.3, 2.4])
    np.testing.assert_allclose(result.std_m, [0.04, 0.04, np.nan, 0.044, 0.046, 0.048])
    assert result.by.tolist() == [FIRST_ECHOES] * 2 + [ALTIMETER] + [FIRST_ECHOES] * 3
    np.testing.assert_allclose(result.ground_z_m, source.poses[:, 2] - result.height_m)
    steepest = source.poses[0, 3] + np.radians(source.like.sonar.elevation_fov_deg) / 2
    ahead = np.linalg.norm(result.places - source.poses[:, :2], axis=1)
    assert ahead[2] == 0
    assert ahead[0] == pytest.approx(2.0 / np.tan(steepest), rel=0.1)
    assert np.isnan(result.ground_depth_m).all()


def test_a_depth_sensor_tells_the_depth_of_the_ground(source: FrameSource) -> None:
    assert source.poses is not None
    result = profile_of(source, *[2.0] * 5, depth=True)
    np.testing.assert_allclose(result.ground_depth_m, 2.0 - source.poses[:, 2], atol=1e-6)


def test_a_height_that_is_given_is_no_measurement(source: FrameSource) -> None:
    bare = replace(source, height_m=None)
    for one in (bare, bare.with_geometry(2.5), replace(source, assumed_height=True)):
        result = profile_of(one, *[None] * 5)
        assert np.isnan(result.height_m).all()
        assert set(result.by) == {""}
    # nor is it with the heave of a depth sensor
    time = np.linspace(-1, 10, 200)
    depth = VehicleSensors(depth=Readings(time, 3 + 0.1 * np.sin(time), np.full(200, 0.01)))
    heaving, _ = replace(bare, poses=None, pitch_rad=0.4).with_geometry(2.5).with_sensors(depth)
    assert heaving.height_m is not None
    assert np.ptp(heaving.height_m) > 0.01
    still = [Estimate(Motion(0.0, 0.0, 0.0))] * 5
    assert source.true is not None
    assert set(height_profile(heaving, np.arange(6), still, depth, source.true).by) == {""}


@dataclass(frozen=True)
class Echoing:
    """Tells a height by first echoes with each motion."""

    consumes = SonarFrames
    inputs = "nothing"
    digest = ""

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        assert frames.poses is not None
        time = float(frames.time_s[0])
        heights = {"height_m": 2 + time / 10, "height_std_m": 0.04, "doubt": "first echoes give 2.0 m, not 9.0 m"}
        return Estimate(Motion(0.0, 0.02, 0.0), about={**heights, "correlation": 1.0})


@pytest.mark.thorough
def test_a_resumed_run_has_the_same_profile_and_warnings(source: FrameSource, tmp_path: Path) -> None:
    whole = run_odometry(source, "echoing", Echoing(), tmp_path / "run")
    table = (tmp_path / "run/height_profile.csv").read_bytes()
    rows = list(csv.DictReader(table.decode().splitlines()))
    assert [row["measured_by"] for row in rows] == [FIRST_ECHOES] * COUNT
    assert float(rows[-1]["distance_m"]) == pytest.approx(0.02 * (COUNT - 1))
    assert rows[0]["ground_depth_m"] == ""
    (tmp_path / "run/height_profile.csv").unlink()
    again = run_odometry(source, "echoing", Echoing(), tmp_path / "run", resume=True)
    assert "contradict the height given" in whole.warnings()[0]
    assert again.warnings() == whole.warnings()
    assert (tmp_path / "run/height_profile.csv").read_bytes() == table
    run_odometry(source, "zero", create_estimator("zero"), tmp_path / "run", overwrite=True)
    assert ALTIMETER in (tmp_path / "run/height_profile.csv").read_text()


@pytest.mark.thorough
def test_a_slope_shows_at_constant_depth(tmp_path: Path, variant: str) -> None:
    """Ground that rises forward by 10 deg: where first echoes put it is within their standard deviation of it."""
    from mitsonar.instruments.sounder import load_sonar
    from mitsonar.simulation.scene import load_scene
    from mitsonar.simulation.simulator import Simulator
    from mitsonar.worlds.families import Pattern
    from mitsonar.worlds.world import sloped

    sloped(Pattern(texture="photo_gravel").build(5), 10).write(tmp_path / "world")
    sonar = load_sonar("didson300").replace(
        range_min=2.2, range_max=5.0, range_bins=256, model="physical", rays_per_beam=1200, rays_across=1
    )
    vehicle = np.zeros((20, 6))
    vehicle[:, 1], vehicle[:, 2] = 0.04 * np.arange(20) - 5.2, 1.7  # its first echoes come from before the blocks
    poses = mounted(vehicle, Pose.from_degrees([0, 0, 0, 35, 0, 0]))
    frames = Simulator(load_scene(tmp_path / "world/scene.xml"), sonar).render(Trajectory(poses, np.arange(20) / 10), seed=1)
    result = odometry(frames, create_estimator("direct")).heights
    assert set(result.by) == {FIRST_ECHOES}
    off = (result.ground_z_m - np.tan(np.radians(10)) * result.places[:, 1]) / result.std_m
    assert np.sqrt(np.mean(off**2)) < 1, off
    rise = np.polyfit(result.places[:, 1], result.ground_z_m, 1)[0]
    assert np.degrees(np.arctan(rise)) == pytest.approx(10, abs=1)
