"""First returns of beams: the rule, laser scans and clouds of a head that turns in a room, read back by two readers."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import decoded
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from mitsonar import MitsonarError, MitsonarWarning, SonarFrames
from mitsonar.cli import application
from mitsonar.instruments.sonar import Sonar, group_of_beams, ping_interval_s, scanned, timed_path
from mitsonar.motion.trajectory import Trajectory
from mitsonar.recordings.first_returns import FirstReturns
from mitsonar.recordings.write_mcap import write_mcap
from mitsonar.records.frames import FrameStore

HEAD = scanned(
    Sonar(beams=1, beam_width_deg=2, azimuth_fov_deg=2, range_min=0.0, range_max=8.0, range_bins=1600, bearing="azimuth"),
    step_deg=3.6,
    overhead_s=0.05,
)
STEP_M = 8.0 / 1600
WALLS = (-2.0, 3.0, -1.5, 4.0)
"""West, east, south and north wall of a room [m]."""


def to_wall(place: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Distances to the walls of the room from places ``(n, 2)`` in headings ``(n,)`` (0 is north, east positive)."""
    east, north = np.sin(heading), np.cos(heading)
    west_wall, east_wall, south_wall, north_wall = WALLS
    with np.errstate(divide="ignore"):
        along = np.where(east > 0, (east_wall - place[:, 0]) / east, (west_wall - place[:, 0]) / east)
        across = np.where(north > 0, (north_wall - place[:, 1]) / north, (south_wall - place[:, 1]) / north)
    return np.asarray(np.minimum(along, across))


def room(velocity: tuple[float, float, float], sweeps: int = 2) -> SonarFrames:
    """Sweeps in the room of a head on a vehicle that moves with this velocity: east, north [m/s], turn [rad/s]."""
    duration = sweeps * len(HEAD.bearing_rad) * ping_interval_s(HEAD) * 1.01
    time = np.linspace(0, duration, 200)
    poses = np.zeros((200, 6))
    poses[:, :2], poses[:, 5] = time[:, None] * velocity[:2], velocity[2] * time
    timed = timed_path(HEAD, Trajectory(poses, time))
    time_s, beam_poses = timed.of_beams(HEAD)
    assert beam_poses is not None
    image = np.full((sweeps, HEAD.range_bins, HEAD.beams), 0.01, np.float32)
    for number in range(sweeps):
        pose = beam_poses[number]
        bins = np.rint(to_wall(pose[:, :2], pose[:, 5] + HEAD.bearing_rad) / STEP_M - 0.5).astype(int)
        for width, value in ((3, 0.1), (1, 0.6), (0, 0.9)):
            for offset in range(-width, width + 1):
                image[number, bins + offset, np.arange(HEAD.beams)] = value
        image[number, bins + 300 if (bins + 300).max() < HEAD.range_bins else bins, np.arange(HEAD.beams)] = 1.0
        image[number, :30] = 1.0  # ringing
    return SonarFrames(
        image=image,
        range_m=HEAD.range_m,
        bearing_rad=HEAD.bearing_rad,
        time_s=time_s,
        sonar=HEAD,
        poses=timed.frames.poses,
        beam_poses=beam_poses,
    )


def by_rosbags(path: Path) -> dict[str, list[Any]]:
    from rosbags.highlevel import AnyReader

    result = defaultdict(list)
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            result[connection.topic].append(reader.deserialize(raw, connection.msgtype))
    return dict(result)


def points_of(cloud: Any) -> np.ndarray:
    names = [one.name for one in cloud.fields]
    table = np.frombuffer(bytes(cloud.data), [(name, "<f4") for name in names])
    return np.column_stack([table[name] for name in ("x", "y", "z")]).astype(float)


def seconds(message: Any) -> float:
    return float(message.header.stamp.sec + 1e-9 * getattr(message.header.stamp, "nanosec", 0))


def in_world(message: Any, points: np.ndarray) -> np.ndarray:
    """Points of the frame ``sonar_link`` in the world, by the odometry."""
    pose = message.pose.pose
    turn = Rotation.from_quat([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
    return np.asarray(turn.apply(points) + np.array([pose.position.x, pose.position.y, pose.position.z]))


def from_walls(points: np.ndarray) -> np.ndarray:
    """Distances of points to the nearest wall."""
    gaps = [points[:, 0] - WALLS[0], points[:, 0] - WALLS[1], points[:, 1] - WALLS[2], points[:, 1] - WALLS[3]]
    return np.asarray(np.abs(np.array(gaps)).min(axis=0))


# ---------------------------------------------------------------- the rule


def test_the_strongest_bin_of_the_first_run_counts() -> None:
    sonar = Sonar(beams=5, range_bins=8, range_min=1.0, range_max=1.8)
    image = np.zeros((1, 8, 5), np.float32)
    image[0, :, 0] = [0, 0.01, 0.2, 0.5, 0.3, 0, 0.9, 0]  # a stronger one follows
    image[0, :, 1] = [0, 0.01, 0.05, 0.09, 0.02, 0, 0, 0]  # too weak
    image[0, :, 2] = [0, 0, 0, 0, 0, 0, 0, 0.1]  # at the level, in the last bin
    image[0, :, 3] = [1, 0, 0, 0.3, 0, 0.8, 0, 0]  # ringing ahead of the range
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar)
    found = FirstReturns(-10.0, from_m=1.1).find(frames)
    assert found.range_m[0] == pytest.approx([1.35, np.inf, 1.75, 1.35, np.inf])
    assert found.value[0] == pytest.approx([0.5, 0, 0.1, 0.3, 0])
    assert FirstReturns(-10.0).find(frames).range_m[0, 3] == pytest.approx(1.05)
    assert np.isinf(FirstReturns(-10.0, from_m=9.0).find(frames).range_m).all()


def test_a_return_has_a_largest_extent() -> None:
    """A lower level does not find a farther return, although the run of bins above it is longer."""
    sonar = Sonar(beams=2, range_bins=40, range_min=1.0, range_max=5.0)
    image = np.full((1, 40, 2), 0.02, np.float32)
    image[0, 5:35], image[0, 8], image[0, 30] = 0.2, 0.3, 0.9
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar)
    for level_db, expected in ((-3.0, 4.05), (-6.0, 1.85), (-9.0, 1.85), (-20.0, 1.55)):
        assert FirstReturns(level_db, length_m=0.55).find(frames).range_m[0] == pytest.approx(expected)
    assert FirstReturns(-9.0, length_m=10.0).find(frames).range_m[0] == pytest.approx(4.05)
    assert FirstReturns(-9.0, length_m=0.0).find(frames).range_m[0] == pytest.approx(1.55)
    with pytest.raises(MitsonarError, match="length_m"):
        FirstReturns(length_m=-1.0)


@pytest.mark.parametrize("level", ["dB", "gamma", "linear"])
def test_the_level_is_one_of_the_coding(level: str) -> None:
    """-20 dB re full scale is 0.01 of the intensity, 0.1 of the amplitude, and 0.75 of a span of 80 dB."""
    value = {"dB": 0.75, "gamma": 0.1**0.5, "linear": 0.01}[level]
    sonar = Sonar(beams=2, range_bins=4, range_min=1.0, range_max=1.4)
    image = np.zeros((1, 4, 2), np.float32)
    image[0, 1, 0], image[0, 2, 1] = value * 1.001, value * 0.999
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar, level=level)
    assert np.isfinite(FirstReturns(-20.0).find(frames).range_m[0]).tolist() == [True, False]


@pytest.mark.parametrize(("level_db", "from_m"), [(1.0, 0.0), (float("nan"), 0.0), (-20.0, -1.0), (-20.0, float("inf"))])
def test_rules_without_a_sense_are_refused(level_db: float, from_m: float) -> None:
    with pytest.raises(MitsonarError):
        FirstReturns(level_db, from_m)


# ---------------------------------------------------------------- messages


@pytest.mark.parametrize("full", [True, False])
def test_a_scan_of_a_head_at_rest_is_the_room(tmp_path: Path, full: bool) -> None:
    """Also where samples are written with 8 bits: ranges are those of the frames."""
    frames = room((0.0, 0.0, 0.0))
    write_mcap([frames], tmp_path / "a.mcap", full=full, returns=FirstReturns(-5.0, from_m=0.3))
    for messages in (by_rosbags(tmp_path / "a.mcap"), decoded(tmp_path / "a.mcap")):
        assert len(messages["/sonar/scan"]) == len(messages["/sonar/returns"]) == 2
        scan = messages["/sonar/scan"][1]
        assert scan.header.frame_id == "sonar_link"
        angle = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
        assert angle[-1] == pytest.approx(scan.angle_max, abs=1e-4)
        # REP 103: x is forward, angles are positive to port
        expected = to_wall(np.zeros((len(angle), 2)), -angle)
        assert np.asarray(scan.ranges) == pytest.approx(expected, abs=STEP_M / 2 + 1e-4)
        assert np.asarray(scan.intensities) == pytest.approx(0.9)
        # rays in order of time, the first at the time of the header
        order = np.argsort(frames.time_s[1])
        assert angle == pytest.approx(-frames.bearing_rad[order], abs=1e-5)
        assert seconds(scan) == pytest.approx(frames.time_s[1].min(), abs=1e-6)
        assert scan.time_increment == pytest.approx(ping_interval_s(HEAD), rel=1e-5)
        assert scan.scan_time == pytest.approx(HEAD.beams * ping_interval_s(HEAD), rel=1e-5)
        points = points_of(messages["/sonar/returns"][1])
        assert points == pytest.approx(
            np.column_stack([expected * np.cos(angle), expected * np.sin(angle), 0 * angle]), abs=0.01
        )


def test_points_of_a_moving_head_lie_on_the_walls(tmp_path: Path) -> None:
    """The cloud of a sweep takes the motion within it into account; without it, walls bend by decimetres."""
    frames = room((0.06, 0.1, 0.05))
    write_mcap([frames], tmp_path / "a.mcap", returns=FirstReturns(-5.0, from_m=0.3))
    messages = by_rosbags(tmp_path / "a.mcap")
    for cloud, odometry in zip(messages["/sonar/returns"], messages["/sonar/odometry"], strict=True):
        assert seconds(cloud) == seconds(odometry)
        assert from_walls(in_world(odometry, points_of(cloud))).max() < STEP_M
    scan, odometry = messages["/sonar/scan"][1], messages["/sonar/odometry"][1]
    angle = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    rigid = np.column_stack([scan.ranges * np.cos(angle), scan.ranges * np.sin(angle), 0 * angle])
    assert from_walls(in_world(odometry, rigid)).max() > 0.2


def test_a_sweep_back_has_its_rays_in_order_of_time(tmp_path: Path) -> None:
    frames = room((0.0, 0.0, 0.0), sweeps=1)
    frames.time_s = frames.time_s[:, ::-1].copy()
    write_mcap([frames], tmp_path / "a.mcap", returns=FirstReturns(-5.0, from_m=0.3))
    scan = by_rosbags(tmp_path / "a.mcap")["/sonar/scan"][0]
    assert scan.angle_increment > 0 > scan.angle_min  # from starboard to port
    assert seconds(scan) == pytest.approx(frames.time_s.min(), abs=1e-6)
    angle = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    assert scan.ranges == pytest.approx(to_wall(np.zeros((len(angle), 2)), -angle), abs=STEP_M / 2 + 1e-4)


def test_beams_of_one_ping_run_from_starboard_and_uneven_ones_are_no_scan(tmp_path: Path) -> None:
    sonar = Sonar(beams=4, range_bins=5, range_min=1.0, range_max=1.5)
    image = np.zeros((1, 5, 4), np.float32)
    image[0, [1, 2, 3], [0, 1, 2]] = 1.0
    even = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.array([7.0]), sonar)
    write_mcap([even], tmp_path / "a.mcap", returns=FirstReturns(-5.0))
    scan = by_rosbags(tmp_path / "a.mcap")["/sonar/scan"][0]
    assert (scan.time_increment, seconds(scan)) == (0, 7)
    assert scan.ranges == pytest.approx([np.inf, 1.35, 1.25, 1.15])
    assert scan.angle_min == pytest.approx(-sonar.bearing_rad[-1], abs=1e-6)
    uneven = SonarFrames(image, sonar.range_m, sonar.bearing_rad**3, np.array([7.0]), sonar)
    write_mcap([uneven], tmp_path / "b.mcap", returns=FirstReturns(-5.0))
    messages = by_rosbags(tmp_path / "b.mcap")
    assert "/sonar/scan" not in messages
    assert len(points_of(messages["/sonar/returns"][0])) == 3
    write_mcap([even], tmp_path / "c.mcap")
    assert not {"/sonar/scan", "/sonar/returns"} & set(by_rosbags(tmp_path / "c.mcap"))


def test_beams_of_interleaved_groups_have_one_time(tmp_path: Path) -> None:
    """A scan can state that its rays follow one another, but not that each fourth beam pings at once."""
    sonar = Sonar(beams=8, ping_groups=4, range_bins=5, range_min=1.0, range_max=1.5)
    image = np.ones((1, 5, 8), np.float32)
    time_s, _ = timed_path(sonar, Trajectory(np.zeros((1, 6)), np.array([7.0]))).of_beams(sonar)
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, time_s, sonar)
    with pytest.warns(MitsonarWarning, match="where the search begins"):
        write_mcap([frames], tmp_path / "a.mcap", returns=FirstReturns(-5.0))
    scan = by_rosbags(tmp_path / "a.mcap")["/sonar/scan"][0]
    assert (scan.time_increment, seconds(scan)) == (0, 7)
    assert scan.angle_min == pytest.approx(-sonar.bearing_rad[-1], abs=1e-6)


def test_a_sweep_that_begins_before_ros_has_times_is_refused_with_the_time(tmp_path: Path) -> None:
    """A sweep at a single pose without a path has its middle at 0 s."""
    frames = room((0, 0, 0), sweeps=1)
    frames.time_s -= frames.time_s.mean()
    begin = frames.time_s.min()
    with pytest.raises(MitsonarError, match=f"all pings: got {begin:.15g} s; .* `mitsonar render --trajectory`"):
        write_mcap([frames], tmp_path / "a.mcap", returns=FirstReturns(-5.0))
    write_mcap([frames], tmp_path / "b.mcap")  # one time a sweep, its middle


def test_levels_that_find_nothing_or_ringing_are_noted(tmp_path: Path) -> None:
    sonar = Sonar(beams=4, range_bins=5, range_min=1.0, range_max=1.5)
    image = np.zeros((1, 5, 4), np.float32)
    image[0, 2:, :3] = 0.5
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.array([7.0]), sonar)
    with pytest.warns(MitsonarWarning, match=r"no beam has a return of -1 dB or more from 0 m on: give a lower level"):
        write_mcap([frames], tmp_path / "a.mcap", returns=FirstReturns(-1.0))
    with pytest.warns(MitsonarWarning, match=r"3 of 3 returns are at 1.22 m, where the search begins"):
        write_mcap([frames], tmp_path / "b.mcap", returns=FirstReturns(-20.0, from_m=1.22))
    assert by_rosbags(tmp_path / "b.mcap")["/sonar/scan"][0].range_min == pytest.approx(1.22)


@pytest.mark.parametrize("packed", [True, False])
def test_the_command_writes_scans_of_a_run_with_the_poses_of_its_beams(tmp_path: Path, packed: bool) -> None:
    frames = room((0.06, 0.1, 0.05))
    run = tmp_path / "run"
    run.mkdir()
    store = FrameStore.create(run / "frames.zarr", len(frames), frames.select(slice(0)))
    store.write(0, frames)
    if packed:
        store.pack(run / "frames.npz")
    command = ["recording", "convert", str(run), "-o", str(tmp_path / "a.mcap"), "--scan-db", "-5", "--scan-from", "0.3"]
    result = CliRunner().invoke(application(), command)
    assert result.exit_code == 0, result.output
    messages = by_rosbags(tmp_path / "a.mcap")
    cloud, odometry = messages["/sonar/returns"][1], messages["/sonar/odometry"][1]
    assert from_walls(in_world(odometry, points_of(cloud))).max() < STEP_M
    assert seconds(messages["/sonar/scan"][1]) == pytest.approx(frames.time_s[1].min(), abs=1e-6)
    assert group_of_beams(HEAD).tolist() == list(range(HEAD.beams))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["-o", "out/run", "--scan-db", "-5"], "apply only to MCAP files"),
        (["-o", "a.mcap", "--scan-from", "1"], "--scan-from needs --scan-db"),
        (["-o", "a.mcap", "--scan-db", "5"], "--scan-db is a level relative to full scale"),
        (["-o", "a.mcap", "--scan-db", "-5", "--scan-from", "-1"], "--scan-from must be a range"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path: Path, options: list[str], sentence: str) -> None:
    room((0.0, 0.0, 0.0), sweeps=1).save(tmp_path / "frames.npz")
    result = CliRunner().invoke(application(), ["recording", "convert", str(tmp_path / "frames.npz"), *options])
    assert result.exit_code == 2
    assert sentence in " ".join(result.output.split())
