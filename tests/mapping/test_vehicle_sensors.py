"""Sensors of a vehicle: readings become motions with covariances; files go round, and hostile ones are refused."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_frames import over_ground, sway
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline

from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.estimation.estimator import Estimate, prior_rejection
from mitsonar.geometry.ground import UNKNOWN_PER_S, USUAL_LEAN_RAD, attitude_of
from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping.odometry import contradiction, follows_depth, graph_path, off_compass
from mitsonar.mapping.sensors import SensorNoise, open_sensors, simulated_sensors
from mitsonar.mapping.series import MotionSeries, path_of
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import Motion, motions
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.sensors import (
    ROOT_HOUR,
    SMOOTHED_S,
    Readings,
    VehicleSensors,
    leaning_mount,
    load_sensors,
    save_sensors,
    smoothed_change,
)
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

Array = NDArray[np.float64]

EXACT = SensorNoise(0.01, 0.0, 1e-3, 1e-6, 1e-6, (1e-4, 1e-2), 200.0, 1e-6)


def readings(time: Array, values: Array, std: float) -> Readings:
    return Readings(time, values, np.full(len(time), std))


# ---------------------------------------------------------------- motions


def test_exact_readings_give_the_true_motions() -> None:
    path = sway(60)
    sensors = simulated_sensors(path, EXACT)
    assert sensors.names == ["gyroscope", "DVL", "depth", "attitude", "compass", "dead reckoning"]
    true = motions(path.poses)
    gyro, dvl, dead = sensors.motions(path.time_s)
    assert gyro.pair.tolist() == dvl.pair.tolist() == dead.pair.tolist() == list(range(59))
    # readings of 5 ms straddle the frames, at which the velocity changes
    np.testing.assert_allclose(gyro.motions[:, 2], true[:, 2], atol=2e-4)
    np.testing.assert_allclose(dvl.motions[:, :2], true[:, :2], atol=2e-4)
    np.testing.assert_allclose(dead.motions, true, atol=2e-4)
    fused = sensors.priors(path.time_s)
    assert fused is not None
    np.testing.assert_allclose([one.motion for one in fused], true, atol=2e-4)
    risen = sensors.rises(path.time_s)
    assert risen is not None
    np.testing.assert_allclose(risen, 0, atol=1e-5)
    message = sensors.headings(path.time_s)
    off = message.heading - path.poses[message.pose, 5]
    np.testing.assert_allclose(off - 2 * np.pi * np.rint(off / (2 * np.pi)), 0, atol=1e-3)


def rolling() -> tuple[Trajectory, Trajectory]:
    """Return the paths of a vehicle that rolls, pitches and heaves, and of a sonar on it that looks 25 deg down."""
    time = np.arange(41) / 5
    swell = 2 * np.pi * time / 4
    poses = np.zeros((len(time), 6))
    poses[:, 1], poses[:, 2] = 0.06 * np.arange(len(time)), 2.2 + 0.1 * np.sin(swell)
    poses[:, 3:] = np.radians([2, 4, 10]) * np.sin(np.outer(swell, [1, 0.8, 0.5]) + np.array([1, 0, 0]))
    return Trajectory(poses, time), Trajectory(mounted(poses, Pose(0, 0, 0, np.radians(25))), time)


def test_a_sonar_that_looks_down_turns_as_the_vehicle_rolls() -> None:
    vehicle, sonar = rolling()
    # readings as fast as the poses: between them, headings of the two paths are interpolated differently
    noise = SensorNoise(1e-4, 0.0, 1e-9, 1e-9, 1e-9, (1e-9, 1e-9), 5.0, 1e-9)
    seen, expected = (simulated_sensors(path, noise) for path in (vehicle, sonar))
    on_sonar = seen.on_mount(np.radians(25))
    assert np.abs(np.diff(sonar.poses[:, 5] - vehicle.poses[:, 5])).max() > np.radians(0.3)
    for one, true in zip(on_sonar.motions(vehicle.time_s), expected.motions(vehicle.time_s), strict=True):
        np.testing.assert_allclose(one.motions[1:-1], true.motions[1:-1], atol=4e-4)
    np.testing.assert_allclose(on_sonar.heading.values[1:-1], expected.heading.values[1:-1], atol=4e-4)  # type: ignore[union-attr]


def test_turns_are_corrected_where_pitch_and_roll_both_have_readings() -> None:
    """A log whose roll ends before its pitch, and its gyroscope after both: beyond, the roll stays as it is."""
    time = np.arange(0, 20, 0.1)
    pitch, roll = (readings(time[:count], 0.1 * np.sin(time[:count]), 1e-3) for count in (180, 150))
    sensors = VehicleSensors(yaw_rate=readings(time, 0 * time, 1e-4), pitch=pitch, roll=roll).on_mount(0.4)
    assert sensors.yaw_rate is not None
    assert np.abs(sensors.yaw_rate.values[:149]).max() > 0.01
    np.testing.assert_array_equal(sensors.yaw_rate.values[150:], 0)


def test_frames_take_height_and_attitude_from_the_sensors_of_a_vehicle() -> None:
    vehicle, sonar = rolling()
    sensors = simulated_sensors(vehicle, SensorNoise(depth_m=1e-9, attitude_deg=1e-9, rate_hz=50.0))
    deep = simulated_sensors(vehicle, SensorNoise(depth_m=1e-9, rate_hz=50.0))
    sonar = Trajectory(sonar.poses[1:-1], sonar.time_s[1:-1])  # readings begin before the frames, and end after them
    frames = replace(over_ground(sway(len(sonar))), time_s=sonar.time_s)
    source = FrameSource.of(replace(frames, poses=None, height_m=None, attitude_rad=None))
    with pytest.raises(MitsonarError, match="the pitch of the sonar on it is not known"):
        source.with_sensors(sensors)
    unmeasured = replace(source, attitude_rad=np.full((len(sonar), 3), np.nan))
    with pytest.raises(MitsonarError, match="the pitch of the sonar on it is not known"):
        unmeasured.with_sensors(sensors)
    aided, _ = source.with_geometry(float(sonar.poses[:, 2].mean()), np.radians(25)).with_sensors(sensors)
    some = np.arange(len(sonar))
    poses = aided.attitudes(some)
    assert poses is not None
    assert aided.height_m is not None
    np.testing.assert_allclose(aided.height_m, sonar.poses[:, 2], atol=2e-3)
    np.testing.assert_allclose(poses[:, 3:5], sonar.poses[:, 3:5], atol=1e-3)
    later = replace(source, time_s=source.time_s + 5).with_geometry(2.2, np.radians(25))
    with pytest.warns(MitsonarWarning, match="the (depth|attitude) of simulated sensors is not used") as warned:
        kept, _ = later.with_sensors(sensors)
    assert len(warned) == 2
    assert kept.pitch_rad == later.pitch_rad
    with pytest.raises(MitsonarError, match="only one of pitch and roll of the vehicle: give both, in a file as"):
        replace(sensors, roll=None)
    # a depth sensor alone measures the heave, and leaves pitch and roll unknown
    heaving, _ = source.with_geometry(2.2, np.radians(25)).with_sensors(deep)
    unsure = attitude_of(heaving.read([3, 4]), "direct", None, None).unsure
    assert unsure.height_m < 1e-9
    assert min(unsure.pitch_rad, unsure.roll_rad) > np.radians(0.5)
    # it heaves 0.11 m/s rms, faster than on a calm day, and so may lean more
    assert heaving.attitude_std is not None
    faster = 0.1 * 2 * np.pi / 4 / np.sqrt(2) / UNKNOWN_PER_S.height_m
    np.testing.assert_allclose(heaving.attitude_std[:, 1:], faster * USUAL_LEAN_RAD, rtol=0.2)
    lean = attitude_of(heaving.read([3, 4]), "direct", None, None).mean_unsure
    assert lean == pytest.approx((0, *heaving.attitude_std[3, 1:]))
    assert max(attitude_of(aided.read([3, 4]), "direct", None, None).unsure) < 1e-9
    # the noise of readings reaches what is unsure of a pair: after smoothing, in the axes of the sonar
    coarse = simulated_sensors(vehicle, SensorNoise(depth_m=0.01, attitude_deg=0.1, rate_hz=20.0))
    noisy, _ = source.with_geometry(2.2, np.radians(25)).with_sensors(coarse)
    unsure = attitude_of(noisy.read([20, 21]), "direct", None, None).unsure
    expected = np.array([0.01, np.radians(0.1), np.radians(0.1) / np.cos(np.radians(25))])
    np.testing.assert_allclose(unsure, 0.2135 * expected, rtol=1e-3)


def test_smoothed_noise_has_the_variance_of_the_smoothing_matrix() -> None:
    """Two routes: the closed form of the spline's kernel, and the matrix that maps readings to smoothed values."""
    step, time = 0.05, np.arange(0, 10.01, 0.05)
    matrix = make_smoothing_spline(time, np.eye(len(time)), lam=SMOOTHED_S**4 / step)
    seen = readings(time, np.zeros(len(time)), 0.01)
    at = np.array([0.0, 0.1, 0.3, 5.0, 5.2, 5.4, 6.0, 9.9, 10.0])
    by_matrix = 0.01 * np.linalg.norm(matrix(at), axis=1)
    np.testing.assert_allclose(seen.smoothed_std(at)[3:7], by_matrix[3:7], rtol=1e-4)
    np.testing.assert_allclose(seen.smoothed_std(at), by_matrix, rtol=0.1)  # near the ends by a fit
    middle = seen.smoothed_std(at[3:7])
    for k in range(1, 4):
        change = 0.01 * np.linalg.norm(matrix(at[3 + k]) - matrix(at[3]))
        assert smoothed_change(middle[0], middle[k], at[3 + k] - at[3]) == pytest.approx(change, rel=1e-3)


def test_turns_corrected_for_the_roll_state_its_noise() -> None:
    """Errors of the yaws of 20 dives over their variance; without the noise of the roll they would be 20 times as large."""
    vehicle, sonar = rolling()
    true, squared = motions(sonar.poses)[:, 2], []
    for seed in range(20):
        seen = simulated_sensors(vehicle, SensorNoise(0.3, attitude_deg=0.1), seed).on_mount(np.radians(25))
        priors = seen.priors(vehicle.time_s)
        assert priors is not None
        squared.append([(one.motion.yaw - yaw) ** 2 / one.covariance[2, 2] for one, yaw in zip(priors, true, strict=True)])
    assert np.mean(squared) == pytest.approx(1, abs=0.25)


def test_smoothing_takes_noise_out_and_little_of_a_sway() -> None:
    """The amplitude follows the closed form of a smoothing spline."""
    time, frames = np.arange(0, 20, 0.05), np.arange(5, 15, 0.2)
    swell = 0.1 * np.sin(2 * np.pi * time / 4)
    true = 0.1 * np.sin(2 * np.pi * frames / 4)
    noise = np.random.default_rng(3).normal(size=len(time)) * 0.01
    exact, smoothed = (readings(time, values, 0.01).smoothed(frames) for values in (swell, swell + noise))
    assert exact is not None
    assert smoothed is not None
    np.testing.assert_allclose(exact, true / (1 + (SMOOTHED_S * 2 * np.pi / 4) ** 4), atol=1e-5)
    assert np.std(smoothed - true) < 0.005
    assert readings(time, swell, 0.01).smoothed(frames + 10) is None
    # a pause of ten minutes is bridged by a line, though the vehicle rises before and after it
    pause = np.where(time > 10, time + 600, time)
    bridged = readings(pause, np.abs(time - 10), 0.01).smoothed(np.arange(5, 615, 0.2))
    assert bridged is not None
    assert bridged.min() > -0.05
    assert bridged.max() < 5.1
    constant = readings(time, np.full(len(time), 3.0), 0.01).smoothed(frames)
    assert constant is not None
    np.testing.assert_allclose(constant, 3, rtol=1e-9)


@pytest.mark.thorough
def test_the_noise_of_the_roll_is_in_each_motion_and_does_not_add_up() -> None:
    """Yaws and the last heading of the paths of 40 dives, over their variances."""
    vehicle, sonar = rolling()
    true, std = motions(sonar.poses), np.array([2e-3, 1e-3, 1e-3])
    squared = []
    for seed in range(40):
        seen = simulated_sensors(vehicle, SensorNoise(0.05, attitude_deg=0.2), seed).on_mount(np.radians(25))
        drawn = true + std * np.random.default_rng(seed).normal(size=true.shape)
        measured = MotionSeries(drawn, sonar.time_s, np.tile(np.diag(std**2), (len(true), 1, 1)))
        start = Pose.from_row(sonar.poses[0])
        found = graph_path(measured, start, start_known=True, sensors=seen, search=None, source=None)
        assert found.series.covariances is not None
        yaws = (found.series.motions[:, 2] - true[:, 2]) ** 2 / found.series.covariances[:, 2, 2]
        end = (found.path.poses[-1, 5] - sonar.poses[-1, 5]) ** 2 / found.covariances[-1, 2, 2]
        squared.append((yaws.mean(), end))
    # added up as if independent, the noise of 40 yaws would make the variance of the last heading ten times as large
    np.testing.assert_allclose(np.mean(squared, axis=0), 1, atol=0.35)


def test_a_gyroscope_s_noise_grows_with_the_root_of_time() -> None:
    """1 deg/h^0.5 is 1 deg after an hour, 1/60 deg after a second."""
    assert np.degrees(ROOT_HOUR) * 60 == pytest.approx(1)
    time = np.arange(0, 3600.0, 0.5)
    gyro = VehicleSensors(yaw_rate=readings(time, np.zeros(len(time)), ROOT_HOUR))
    (hour,) = gyro.motions(np.array([0.0, 3599.5]))
    assert np.degrees(np.sqrt(hour.covariances[0, 2, 2])) == pytest.approx(1, rel=1e-3)
    (second,) = gyro.motions(np.array([10.0, 11.0]))
    assert np.degrees(np.sqrt(second.covariances[0, 2, 2])) == pytest.approx(1 / 60, rel=1e-6)
    assert np.sqrt(second.covariances[0, 0, 0]) >= 10


def test_readings_average_and_draws_have_the_variance_that_is_told() -> None:
    path = sway(200)
    errors, squared = [], []
    for seed in range(5):
        sensors = simulated_sensors(path, SensorNoise(20.0, 0.0, 0.05, rate_hz=50), seed)
        gyro, dvl = sensors.motions(path.time_s)
        true = motions(path.poses)
        errors.append((gyro.motions - true)[:, 2] / np.sqrt(gyro.covariances[:, 2, 2]))
        off = dvl.motions - true
        off[:, 2] -= gyro.motions[:, 2] - true[:, 2]  # the turn that the DVL borrowed
        squared.append((off[:, None] @ np.linalg.inv(dvl.covariances) @ off[..., None]).ravel())
    assert np.std(errors) == pytest.approx(1, abs=0.1)
    assert np.mean(squared) / 2 == pytest.approx(1, abs=0.2)


def test_draws_of_a_bias_and_of_dead_reckoning_are_as_told() -> None:
    path = sway(40)
    drift = [simulated_sensors(path, SensorNoise(1e-6, 1000.0), seed).motions(path.time_s)[0] for seed in range(40)]
    whole = np.array([(one.motions[:, 2] - motions(path.poses)[:, 2]).sum() / one.bias[:, 2].sum() for one in drift])
    assert np.sqrt((whole**2).mean()) == pytest.approx(1, abs=0.35)
    off = []
    for seed in range(30):
        (dead,) = simulated_sensors(path, SensorNoise(walk=(0.01, 0.5)), seed).motions(path.time_s)
        off.append((dead.motions - motions(path.poses)) / np.sqrt(np.diagonal(dead.covariances, axis1=1, axis2=2)))
    assert np.std(off, axis=(0, 1)) == pytest.approx(np.ones(3), abs=0.2)


def test_gaps_and_ends_are_not_bridged() -> None:
    time = np.concatenate([np.arange(0, 5, 0.1), np.arange(10, 15, 0.1)])
    gyro = VehicleSensors(yaw_rate=readings(time, np.ones(len(time)), 1e-3))
    frames = np.arange(-2.0, 20.0)
    (message,) = gyro.motions(frames)
    covered = [(frames[k], frames[k + 1]) for k in message.pair]
    assert covered == [(float(t), float(t + 1)) for t in (0, 1, 2, 3, 10, 11, 12, 13)]
    np.testing.assert_allclose(message.motions[:, 2], 1, rtol=1e-6)
    with pytest.raises(MitsonarError, match=r"no reading at the times of the frames, 50\.\.52 s"):
        gyro.motions(np.array([50.0, 51, 52]))


def test_no_compass_reading_counts_for_two_frames() -> None:
    compass = VehicleSensors(heading=readings(np.arange(0, 10, 1.0), np.linspace(6.1, 6.5, 10), 0.02))
    frames = np.arange(0, 9, 0.1)
    message = compass.headings(frames)
    assert message.pose.tolist() == [*range(0, 90, 10), 89]
    np.testing.assert_allclose(np.unwrap(message.heading)[:9], np.linspace(6.1, 6.5, 10)[:9] - 2 * np.pi, atol=1e-9)
    assert compass.priors(frames) is None


def test_priors_join_sensors_by_their_information() -> None:
    time = np.arange(0, 10, 0.1)
    yaw_rate, forward, none = (
        readings(time, np.full(100, value), std) for value, std in ((0.2, 0.01), (0.5, 0.1), (0.0, 0.1))
    )
    both = VehicleSensors(yaw_rate, none, forward)
    message = both.priors(np.array([2.0, 3.0]))
    assert message is not None
    (one,) = message
    np.testing.assert_allclose(one.motion[2], 0.2, rtol=1e-3)
    np.testing.assert_allclose(one.motion[:2], [-0.5 * np.sin(0.1), 0.5 * np.cos(0.1)], rtol=2e-3)
    assert one.std[2] == pytest.approx(0.01, rel=1e-3)
    # ten readings of 0.1 m/s over a second
    np.testing.assert_allclose(one.std[:2], 0.1 * np.sqrt(0.1), rtol=0.02)


# ---------------------------------------------------------------- files


def test_a_file_holds_all_readings(tmp_path: Path) -> None:
    path = sway(20)
    for noise in (SensorNoise(1.0, 5.0, 0.02, 0.1, 2.0, (0.01, 0.1), attitude_deg=0.5), SensorNoise(gyro_deg_rth=1.0)):
        sensors = simulated_sensors(path, noise, 3)
        save_sensors(tmp_path / "s.csv", sensors)
        read = load_sensors(tmp_path / "s.csv")
        assert read.names == sensors.names
        assert read.bias_std == pytest.approx(sensors.bias_std)
        for one, two in zip(sensors.motions(path.time_s), read.motions(path.time_s), strict=True):
            np.testing.assert_allclose(one.motions, two.motions, atol=1e-9)
            np.testing.assert_allclose(one.covariances, two.covariances, rtol=1e-6)
        np.testing.assert_array_equal(read.headings(path.time_s).pose, sensors.headings(path.time_s).pose)
        if noise.attitude_deg is not None:
            np.testing.assert_allclose(read.attitudes(path.time_s[1:-1]), sensors.attitudes(path.time_s[1:-1]), atol=1e-9)  # type: ignore[arg-type]


def test_sensors_of_other_times_share_a_file(tmp_path: Path) -> None:
    file = tmp_path / "two.csv"
    file.write_text(
        "time,yaw_rate_deg_s,yaw_rate_noise_deg_rth,depth_m,depth_std_m,by\n0,1,0.1,,,x\n1,2,,5,0.1,y\n2,,,6,,z\n"
    )
    read = load_sensors(file)
    assert read.yaw_rate is not None
    assert read.depth is not None
    assert read.yaw_rate.time_s.tolist() == [0, 1]
    np.testing.assert_allclose(np.degrees(read.yaw_rate.values), [1, 2])
    np.testing.assert_allclose(read.yaw_rate.std, 0.1 * ROOT_HOUR)
    assert read.depth.values.tolist() == [5, 6]
    assert read.sideways is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no table"),
        ("time_s,depth\n0,1\n", "no column of a sensor"),
        ("depth_m,depth_std_m\n0,1\n", "needs one column of times"),
        ("time_s,time,depth_m,depth_std_m\n0,0,1,1\n", "needs one column of times"),
        ("time_s,depth_m\n0,1\n", "add the column depth_std_m"),
        ("time_s,depth_m,depth_std_m\n0,1,\n", "depth_std_m is empty"),
        ("time_s,depth_m,depth_std_m\n0,1,0\n", "above 0"),
        ("time_s,depth_m,depth_std_m\n0,1,-1\n", "above 0"),
        ("time_s,depth_m,depth_std_m\n0,one,1\n", "row 2: depth_m must be a number: got 'one'"),
        ("time_s,depth_m,depth_std_m\n0,nan,1\n", "must be a number"),
        ("time_s,depth_m,depth_std_m\n0,inf,1\n", "must be a number"),
        ("time_s,depth_m,depth_std_m\n0,1_0,1\n", "must be a number"),
        ("time_s,depth_m,depth_std_m\n17644248000000000,1,1\n", r"'17644248000000000'; numbers up to 1e\+12 are read"),
        ("time_s,depth_m,depth_std_m\n,1,1\n", "time_s must be a number"),
        ("time_s,depth_m,depth_std_m\n1,1,1\n0,1,1\n", "column depth_m: times of readings must increase"),
        ("time_s,depth_m,depth_std_m\n0,,1\n", "hold no reading"),
        ("time_s,depth_m,depth_m,depth_std_m\n0,1,1,1\n", "more than once"),
        ("time_s,depth_m,depth_std_m\n0,1\n", "cells"),
        ("time_s,reckoned_x_m\n0,1\n", "no column reckoned_y_m"),
    ],
)
def test_files_that_tell_no_sensors_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "s.csv").write_text(text)
    with pytest.raises(MitsonarError, match=message):
        load_sensors(tmp_path / "s.csv")


def test_readings_that_are_none_are_refused() -> None:
    time = np.arange(3.0)
    good = readings(time, time, 1.0)
    for change, message in (
        ({"values": np.zeros(2)}, "a time, a value"),
        ({"values": np.array([0, np.nan, 0])}, "finite"),
        ({"time_s": np.zeros(3)}, "increase"),
        ({"time_s": 1764424800.5 - time}, "got 1764424799.5 s after 1764424800.5"),
        ({"std": np.zeros(3)}, "above 0"),
    ):
        with pytest.raises(MitsonarError, match=message):
            replace(good, **change)
    with pytest.raises(MitsonarError, match="hold no reading"):
        VehicleSensors()
    with pytest.raises(MitsonarError, match="too short"):
        simulated_sensors(sway(3), SensorNoise(gyro_deg_rth=1.0, rate_hz=1.0))


# ---------------------------------------------------------------- columns of a trajectory


FLOWN = "time_s,x_m,y_m,z_m,roll_deg,pitch_deg,heading_deg,yaw_rate_deg_s,yaw_rate_noise_deg_rth,compass_deg,compass_std_deg"


def flown(folder: Path) -> Path:
    """Write a trajectory whose rows hold readings too; the last row holds readings only."""
    rows = ["0,5,6,2.5,0,35,90,2,1,10,3", "0.5,5,7,2.5,0,35,90,4,,,", "1,5,8,2.5,0,35,90,,,12,", "1.5,,,,,,,6,,,"]
    (folder / "trajectory.csv").write_text("\n".join([FLOWN, *rows]) + "\n")
    return folder / "trajectory.csv"


def test_sensors_are_columns_of_a_trajectory(tmp_path: Path) -> None:
    """The heading beside poses is theirs: only ``compass_deg`` is a compass."""
    read = load_sensors(flown(tmp_path))
    assert read.names == ["gyroscope", "compass"]
    assert read.yaw_rate is not None
    assert read.heading is not None
    np.testing.assert_allclose(np.degrees(read.yaw_rate.values), [2, 4, 6])
    np.testing.assert_allclose(np.degrees(read.heading.values), [10, 12])
    np.testing.assert_allclose(np.degrees(read.heading.std), [3, 3])


def test_a_trajectory_with_sensors_is_read_without_them(tmp_path: Path) -> None:
    path = Trajectory.load(flown(tmp_path))
    np.testing.assert_allclose(path.time_s, [0, 0.5, 1])
    np.testing.assert_allclose(path.poses[:, 1], [6, 7, 8])
    np.testing.assert_allclose(np.degrees(path.poses[:, 5]), 90)


def test_true_poses_beside_readings_are_never_read(tmp_path: Path) -> None:
    read = load_sensors(flown(tmp_path))
    second = tmp_path / "other.csv"
    second.write_text(flown(tmp_path).read_text().replace(",5,", ",-55,").replace(",90,", ",17,"))
    assert load_sensors(second).digest() == read.digest()


def test_a_heading_with_a_deviation_beside_poses_is_no_compass(tmp_path: Path) -> None:
    file = flown(tmp_path)
    file.write_text(file.read_text().replace("compass_deg", "yaw_of_compass").replace("compass_std_deg", "heading_std_deg"))
    with pytest.warns(MitsonarWarning, match="compass_deg"):
        assert load_sensors(file).names == ["gyroscope"]
    file.write_text("time_s,x,y,z,roll_deg,pitch_deg,heading_deg\n0,0,0,2,0,35,0\n1,0,1,2,0,35,0\n")
    with pytest.raises(MitsonarError, match=r"no column of a sensor.*compass_deg"):
        load_sensors(file)


def test_a_compass_has_one_column(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("time_s,heading_deg,heading_std_deg,compass_deg,compass_std_deg\n0,1,1,1,1\n1,1,1,1,1\n")
    with pytest.raises(MitsonarError, match="leave one out"):
        load_sensors(tmp_path / "s.csv")


def test_the_folder_of_a_trajectory_may_be_given(tmp_path: Path) -> None:
    flown(tmp_path)
    assert open_sensors(tmp_path).digest() == load_sensors(tmp_path / "trajectory.csv").digest()
    (tmp_path / "empty").mkdir()
    with pytest.raises(MitsonarError, match=r"no trajectory\.csv"):
        open_sensors(tmp_path / "empty")


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (
            lambda time, rate: (time, np.radians(rate)),
            "yaw_rate_deg_s seems to hold rad/s, so that it must be multiplied by",
        ),
        (lambda time, rate: (time, -rate), "yaw_rate_deg_s seems to have the wrong sign, since it is positive clockwise"),
        (lambda time, rate: (time, -np.radians(rate)), "by 57.3 and to have the wrong sign"),
        (
            lambda time, rate: (time[0] + 1e3 * (time - time[0]), rate),
            "check time_s, in seconds and in the clock of the recording",
        ),
        (lambda time, rate: (time, rate), ""),
    ],
)
def test_a_gyroscope_that_the_frames_contradict_is_named_with_the_likely_cause(
    change: Callable[[Array, Array], tuple[Array, Array]], cause: str
) -> None:
    """The frames give the true motions; those that differ from the gyroscope's are rejected, as estimators do."""
    path = sway(60)
    gyro = simulated_sensors(path, SensorNoise(gyro_deg_rth=0.3)).yaw_rate
    assert gyro is not None
    time, rate = change(gyro.time_s, gyro.values)
    sensors = VehicleSensors(readings(time, rate, gyro.std[0]), name="the sensors of s.csv")
    estimates, covariance = [], np.diag([1e-3, 1e-3, np.radians(0.02)]) ** 2
    for moved, prior in zip(motions(path.poses), sensors.priors(path.time_s) or [], strict=True):
        motion = Motion(*(float(value) for value in moved))
        reason = prior_rejection(motion, covariance, prior)
        estimates.append(Estimate(motion, covariance, not reason, reason))
    sentence = contradiction(sensors, estimates, path.time_s)
    assert sentence.startswith(
        f"{sum(not one.valid for one in estimates)} of 59 motions contradict the sensors of s.csv"
    ) == (cause != "")
    assert cause in sentence


def test_a_roll_of_the_wrong_sign_is_named() -> None:
    """The sonar, pitched by 25 deg, turns as the vehicle rolls; with the sign reversed the gyroscope errs by twice that."""
    time, pitch = np.arange(0, 12, 0.02), np.radians(25)
    roll = np.radians(4) * np.sin(1.3 * time)
    still = 0 * time
    covariance = np.diag([1e-3, 1e-3, np.radians(0.02)]) ** 2
    frames_s = np.arange(1, 11, 0.2)
    heading = leaning_mount(np.column_stack([0 * frames_s, np.interp(frames_s, time, roll)]), pitch)[:, 2]
    for sign in (1, -1):
        sensors = VehicleSensors(
            yaw_rate=readings(time, still, 1e-5),
            pitch=readings(time, still, 1e-3),
            roll=readings(time, sign * roll, 1e-3),
            name="the sensors of s.csv",
        ).on_mount(pitch)
        estimates: list[Estimate] = []
        for yaw, prior in zip(np.diff(heading), sensors.priors(frames_s) or [], strict=True):
            motion = Motion(0.0, 0.0, float(yaw))
            reason = prior_rejection(motion, covariance, prior)
            estimates.append(Estimate(motion, covariance, not reason, reason))
        sentence = contradiction(sensors, estimates, frames_s)
        assert ("vehicle_roll_deg seems to have the wrong sign" in sentence) == (sign < 0)


@pytest.mark.parametrize(
    ("slope", "cause"),
    [(0.87, "the sign of depth_m"), (0.3, "in metres"), (-0.44, "check that depth_m is in metres"), (0.02, ""), (0.0, "")],
)
def test_motions_that_follow_the_depth_are_doubted(slope: float, cause: str) -> None:
    rng = np.random.default_rng(4)
    rise = 0.1 * np.sin(np.arange(40) / 3)
    ahead = 0.06 + 1e-3 * rng.normal(size=39) + slope * np.diff(rise)
    estimates = [Estimate(Motion(0.0, float(one), 0.0), None, number % 7 != 0) for number, one in enumerate(ahead)]
    doubt = follows_depth(estimates, rise, "s.csv")
    assert cause in doubt
    assert (doubt == "") == (cause == "")
    assert follows_depth(estimates[:9], rise[:10], "s.csv") == ""


def test_a_compass_off_the_known_first_heading_is_doubted() -> None:
    """The path would twist towards the compass within some frames: 60 deg, though no motion turns."""
    count = 100
    time_s, noise = np.arange(count, dtype=np.float64) * 0.1, math.radians(1)
    values = math.radians(179) + noise * np.random.default_rng(0).normal(size=count)
    sensors = VehicleSensors(heading=Readings(time_s, values, np.full(count, noise)), name="the sensors of dive.csv")
    moved, covariance = np.tile([0, 0.03, 0], (count - 1, 1)), np.diag([1e-3, 1e-3, np.radians(0.05)]) ** 2
    for heading_deg, cause in ((119.0, r"the compass of the sensors of dive.csv is \+60 deg off the first"), (-180.0, "^$")):
        start = Pose.from_degrees([0, 0, 2, 0, 0, heading_deg])
        assert re.search(cause, off_compass(sensors, path_of(moved, start, time_s)))
        series = MotionSeries(moved, time_s, np.tile(covariance, (count - 1, 1, 1)))
        path = graph_path(series, start, start_known=True, sensors=sensors, search=None, source=None).path
        assert (np.ptp(path.poses[:20, 5]) > np.radians(30)) == (heading_deg > 0)
    assert not off_compass(VehicleSensors(depth=Readings(time_s, time_s, np.ones(count))), path)


def test_a_gyroscope_without_the_roll_of_the_vehicle_counts_little() -> None:
    """A sonar that looks 25 deg down turns by tan(25 deg) of the roll, 4 deg/s on a calm day."""
    time_s = np.arange(10) / 5
    image = np.zeros((10, 20, 12), np.float32)
    sonar = Sonar.create(beams=12, range_bins=20)
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, time_s, sonar)
    source = replace(FrameSource.of(frames), pitch_rad=math.radians(25))
    sensors = VehicleSensors(yaw_rate=readings(np.linspace(-0.1, 2.2, 116), np.zeros(116), 1e-5), name="s.csv")
    with pytest.warns(MitsonarWarning, match=r"by 25 deg turns by some 0\.37 deg in a motion.*add vehicle_pitch_deg"):
        _, widened = source.with_sensors(sensors)
    (measured,) = widened.motions(time_s)
    turn = math.tan(math.radians(25)) * math.radians(4) * 0.2
    np.testing.assert_allclose(np.sqrt(measured.covariances[:, 2, 2]), turn, rtol=1e-3)
    # of every second frame, a motion takes twice as long; rolls apart by more than half a second differ by 2 deg
    for every, seen, factor in ((2, "0.75", 2), (5, "0.93", 2.5)):
        with pytest.warns(MitsonarWarning, match=f"by some {re.escape(seen)} deg in a motion"):
            _, seldom = source.with_sensors(sensors, every)
        (measured,) = seldom.motions(time_s[::every])
        np.testing.assert_allclose(np.sqrt(measured.covariances[:, 2, 2]), factor * turn, rtol=1e-3)
    _, level = replace(source, pitch_rad=0.0).with_sensors(sensors)
    np.testing.assert_array_equal(level.yaw_rate.std, sensors.yaw_rate.std)  # type: ignore[union-attr]


def test_sensors_of_another_clock_are_refused_with_both_clocks() -> None:
    time = 1.7e9 + np.arange(20.0)
    sensors = VehicleSensors(depth=readings(time, time, 0.1), name="the sensors of s.csv")
    with pytest.raises(MitsonarError, match=r"the sensors of s\.csv hold no reading .* 0\.\.5 s, but at 1700000000\.\."):
        sensors.priors(np.arange(6.0))
