"""Poses of ROS, of NED and of mitsonar agree: closed forms, round trips, the same picture, and what is warned of."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Command, axes, refused
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.motion.pose import Pose, to_world_matrices
from mitsonar.motion.trajectory import CONVENTIONS, Trajectory, convention_named, sideways_or_up
from mitsonar.simulation.scene import shipped_scenes, shipped_trajectory

FRAMES = ("mitsonar", "ros-enu", "ned")


def random_poses(count: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    angles = rng.uniform(-1, 1, (count, 3)) * (np.pi / 2 * 0.98, np.pi, np.pi)
    return np.column_stack([rng.normal(0, 3, (count, 3)), angles])


def quietly(path: Path, frame: str) -> Trajectory:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MitsonarWarning)
        return Trajectory.load(path, frame)


def warned(path: Path, frame: str, **words: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Trajectory.load(path, frame, **words)
    return [str(one.message) for one in caught if issubclass(one.category, MitsonarWarning)]


# ---------------------------------------------------------------- closed forms


def body_in_world(pose: Pose, frame: str) -> np.ndarray:
    """A convention's rotation matrix, from its words: columns are the body's axes, rows the world's."""
    starboard, forward, up = axes(pose)
    east, north, upward = np.eye(3)
    match frame:
        case "ros-enu":
            body, world = (forward, -starboard, up), (east, north, upward)
        case "ned":
            body, world = (forward, starboard, -up), (north, east, -upward)
        case _:
            body, world = (starboard, forward, up), (east, north, upward)
    return np.array([[axis @ way for axis in body] for way in world])


@pytest.mark.parametrize("frame", FRAMES)
def test_a_tum_file_is_read_as_its_words_say(tmp_path: Path, frame: str) -> None:
    poses = random_poses(30)
    lines = []
    for number, row in enumerate(poses):
        x, y, z = row[:3]
        place = (y, x, -z) if frame == "ned" else (x, y, z)
        quaternion = Rotation.from_matrix(body_in_world(Pose(*row), frame)).as_quat()
        lines.append(" ".join(f"{value:.12f}" for value in (number, *place, *quaternion)))
    (tmp_path / "path.tum").write_text("\n".join(lines))
    loaded = quietly(tmp_path / "path.tum", frame)
    np.testing.assert_allclose(to_world_matrices(loaded.poses), to_world_matrices(poses), atol=1e-9)


@pytest.mark.parametrize(
    ("frame", "columns", "row"),
    [
        ("mitsonar", "roll_deg,pitch_deg,heading_deg", (0, 18, -4)),
        ("ros-enu", "roll_deg,pitch_deg,yaw_deg", (0, 18, 94)),
        ("ned", "roll_deg,pitch_deg,heading_deg", (0, -18, -4)),
        ("ned", "roll_rad,pitch_deg,yaw_deg", (0, -18, -4)),
    ],
)
def test_a_csv_file_is_read_as_its_words_say(tmp_path: Path, frame: str, columns: str, row: tuple[float, ...]) -> None:
    """Turn about the vertical first, then pitch, then roll, about the body's own axes."""
    place = (2, 1, -3) if frame == "ned" else (1, 2, 3)
    (tmp_path / "p.csv").write_text(f"time_s,x,y,z,{columns}\n0,{','.join(map(str, (*place, *row)))}\n")
    loaded = Trajectory.load(tmp_path / "p.csv", frame)
    np.testing.assert_allclose(loaded.poses, [[1, 2, 3, *np.radians([18, 0, -4])]], atol=1e-12)


@pytest.mark.parametrize("frame", ["ros-enu", "ned"])
def test_angles_are_those_of_the_rotation(frame: str) -> None:
    """Two routes: the signs of the angles, and the matrix Rz(turn) Ry(pitch) Rx(roll) that both conventions mean."""
    convention = CONVENTIONS[frame]
    angles = random_poses(50)[:, 3:]
    theirs = Rotation.from_euler("ZYX", angles[:, [2, 0, 1]])
    ours = np.column_stack([np.zeros((50, 3)), convention.angles_to_mitsonar(angles)])
    _, rotation = convention.to_mitsonar(np.zeros((50, 3)), theirs)
    expected = np.stack([np.array(axes(Pose(*row))).T for row in ours])
    np.testing.assert_allclose(rotation.as_matrix(), expected, atol=1e-12)
    np.testing.assert_allclose(convention.angles_from_mitsonar(ours[:, 3:]), angles, atol=1e-12)


def test_the_case_that_was_misread(tmp_path: Path) -> None:
    """Pitch 18, roll 0, heading -4 in FLU and ENU became pitch 0, roll 18, heading -94, in silence."""
    pose = Pose.from_degrees([0, 0, 3, 18, 0, -4])
    ahead = np.array([np.sin(pose.heading), np.cos(pose.heading), 0])
    quaternion = Rotation.from_euler("ZYX", [94, 18, 0], degrees=True).as_quat()
    lines = [(0.1 * k, *(np.array(pose[:3]) + 0.1 * k * ahead), *quaternion) for k in range(8)]
    np.savetxt(tmp_path / "ros.tum", lines)
    right = Trajectory.load(tmp_path / "ros.tum", "ros-enu")
    np.testing.assert_allclose(np.degrees(right.poses[:, 3:]), np.tile([18, 0, -4], (8, 1)), atol=1e-9)
    wrong = quietly(tmp_path / "ros.tum", "mitsonar")
    np.testing.assert_allclose(np.abs(np.degrees(wrong.poses[0, 3:])), [0, 18, 94], atol=1e-9)
    (output,) = warned(tmp_path / "ros.tum", "mitsonar")
    assert "looks sideways or at the sky in 8 of 8 frames" in output
    assert "read as ros-enu it would not: name the file's convention by --frame" in output
    assert not warned(tmp_path / "ros.tum", "ros-enu")


# ---------------------------------------------------------------- round trips


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("ending", ["tum", "csv"])
def test_round_trip(tmp_path: Path, frame: str, ending: str) -> None:
    flown = Trajectory(random_poses(40), 1.5 + np.arange(40) / 21)
    path = tmp_path / f"path.{ending}"
    flown.save(path, frame)
    back = quietly(path, frame)
    np.testing.assert_allclose(back.time_s, flown.time_s, atol=1e-9)
    np.testing.assert_allclose(back.poses[:, :3], flown.poses[:, :3], atol=1e-9)
    np.testing.assert_allclose(to_world_matrices(back.poses), to_world_matrices(flown.poses), atol=5e-9)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("ending", ["tum", "csv"])
def test_straight_down_keeps_its_attitude(tmp_path: Path, frame: str, ending: str) -> None:
    """Heading and roll are one angle there."""
    flown = Trajectory(np.array([[0, 0, 3, np.pi / 2, 0, 0.7], [0, 0.1, 3, np.pi / 2, 0.2, 0.7]]), np.arange(2.0))
    flown.save(tmp_path / f"down.{ending}", frame)
    back = Trajectory.load(tmp_path / f"down.{ending}", frame)
    np.testing.assert_allclose(to_world_matrices(back.poses), to_world_matrices(flown.poses), atol=2e-8)


def test_mitsonars_own_files_keep_their_bytes(tmp_path: Path) -> None:
    flown = Trajectory(random_poses(5), np.arange(5.0))
    flown.save(tmp_path / "a.tum")
    flown.save_tum(tmp_path / "b.tum")
    assert (tmp_path / "a.tum").read_bytes() == (tmp_path / "b.tum").read_bytes()


def test_all_conventions_and_files_give_the_same_picture(variant: str, tmp_path: Path) -> None:
    from mitsonar.simulation.scene import load_scene, sonar_in
    from mitsonar.simulation.simulator import Simulator

    loaded = load_scene("flat_floor")
    result = sonar_in(loaded)
    assert result is not None
    simulator = Simulator(loaded, result[0].replace(beams=16, range_bins=64, rays_per_beam=100))
    flown = Trajectory.load_tum(shipped_trajectory("flat_floor")).resample(3)
    images = []
    for frame in FRAMES:
        for ending in ("tum", "csv"):
            flown.save(tmp_path / f"{frame}.{ending}", frame)
            poses = Trajectory.load(tmp_path / f"{frame}.{ending}", frame).poses
            images.append(simulator.render(np.round(poses, 7)).image)
    assert images[0].any()
    for second in images[1:]:
        np.testing.assert_allclose(second, images[0], atol=1e-4)


# ---------------------------------------------------------------- what is warned of


@pytest.mark.parametrize("pitch", [0, 18, 35, 60, 90])
@pytest.mark.parametrize("written", FRAMES)
@pytest.mark.parametrize("read", FRAMES)
def test_a_path_read_wrongly_is_warned_of(tmp_path: Path, pitch: float, written: str, read: str) -> None:
    """A vehicle that goes ahead, its sonar pitched down. Level, ENU and NED differ in left and right only: not seen."""
    heading = 0.3
    poses = [Pose(k * np.sin(heading), k * np.cos(heading), 3, np.radians(pitch), 0.01, heading) for k in range(6)]
    path = tmp_path / "path.csv"
    rotation = Rotation.from_matrix([np.array(axes(pose)).T for pose in poses])
    position, rotation = CONVENTIONS[written].from_mitsonar(np.array(poses)[:, :3], rotation)
    names = "time,x,y,z,qx,qy,qz,qw"
    np.savetxt(path, np.column_stack([np.arange(6), position, rotation.as_quat()]), delimiter=",", header=names, comments="")
    seen = bool(warned(path, read))
    level_and_both_from_navigation = pitch == 0 and "mitsonar" not in (written, read)
    assert seen == (written != read and not level_and_both_from_navigation)


def test_shipped_trajectories_look_at_their_scenes() -> None:
    for name in shipped_scenes():
        assert sideways_or_up(Trajectory.load_tum(shipped_trajectory(name)).poses).mean() == 0, name


def test_hydrophones_may_go_where_they_like_but_not_upside_down(tmp_path: Path) -> None:
    """A level vehicle that goes sideways is fine where nothing looks ahead."""
    sideways = Trajectory(np.array([Pose(0.1 * k, 0, 5) for k in range(5)]), np.arange(5.0))
    sideways.save(tmp_path / "a.tum")
    assert warned(tmp_path / "a.tum", "mitsonar")
    assert not warned(tmp_path / "a.tum", "mitsonar", looks_ahead=False)
    upside_down = Trajectory(np.array([Pose(0.1 * k, 0, 5, 0, np.pi) for k in range(5)]), np.arange(5.0))
    upside_down.save(tmp_path / "b.tum")
    assert warned(tmp_path / "b.tum", "mitsonar", looks_ahead=False)


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("frame", "text", "message"),
    [
        ("mitsonar", "", r"holds no pose: its first line must name the columns"),
        ("mitsonar", "time,x,y,z,qx,qy,qz,qw\n", r"there is no line below the names"),
        ("mitsonar", "x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,1\n", r"has no column time .*its columns must be time_s"),
        ("mitsonar", "time,x,x_m,y,z,qx,qy,qz,qw\n0,1,1,2,3,0,0,0,1\n", "has x in 2 columns"),
        (
            "mitsonar",
            "time,x,y,z,roll,pitch,heading\n0,1,2,3,0,0,0\n",
            "the column pitch has no unit; name it pitch_deg",
        ),
        ("mitsonar", "time,x,y,z,roll_deg,pitch_deg\n0,1,2,3,0,0\n", r"has no column heading .*heading_deg"),
        ("mitsonar", "time,x,y,z,roll_deg,roll_rad,pitch_deg,yaw_deg\n0,1,2,3,0,0,0,0\n", "has roll in 2 columns"),
        ("mitsonar", "time,x,y,z,qx,qy,qz,qw,yaw_deg\n0,1,2,3,0,0,0,1,0\n", "has the attitude twice, qx and yaw_deg"),
        ("mitsonar", "time,x,y,z,qx,qy,qz\n0,1,2,3,0,0,0\n", "has no column qw"),
        ("mitsonar", "time,x,y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,0\n", r"line 2: expected finite numbers .*quaternion of zero"),
        ("mitsonar", "time,x,y,z,qx,qy,qz,qw\n0,1,2,nan,0,0,0,1\n", "line 2: expected finite numbers"),
        ("mitsonar", "time,x,y,z,qx,qy,qz,qw\n17644248000000000,1,2,3,0,0,0,1\n", r"up to 1e\+12 \(times in s\)"),
        ("mitsonar", "time,x,y,z,qx,qy,qz,qw\n0,1,2\n", "line 2: expected finite numbers"),
        ("mitsonar", "time,x,y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n0,1,2,3,0,0,0,1\n", "line 3: time must increase"),
        (
            "mitsonar",
            "time,x,y,z,qx,qy,qz,qw\n1764424800.5,1,2,3,0,0,0,1\n1764424800.25,1,2,3,0,0,0,1\n",
            "got 1764424800.25 s after 1764424800.5 s; sort the lines",
        ),
        ("ros-enu", "time,x,y,z,roll_deg,pitch_deg,heading_deg\n0,1,2,3,0,0,0\n", r"has a heading, which turns clockwise"),
        ("ros", "time,x,y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n", r"unknown frame 'ros' of poses: did you mean ros-enu\?"),
    ],
)
def test_csv_files_that_are_none(tmp_path: Path, frame: str, text: str, message: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(MitsonarError, match=message):
        Trajectory.load(tmp_path / "p.csv", frame)


def test_columns_may_stand_in_any_order_beside_others(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(
        "\ufeffDepth, Yaw_deg ,z,y,x_m,Time,pitch_rad,roll_deg,note\n7,90,3,2,1,0.5,0.25,0,first\n\n7,90,3,2,1,0.6,0.25,0,\n"
    )
    loaded = Trajectory.load(tmp_path / "p.csv")
    np.testing.assert_allclose(loaded.poses, np.tile([1, 2, 3, 0.25, 0, np.pi / 2], (2, 1)), atol=1e-12)
    assert loaded.time_s.tolist() == [0.5, 0.6]


@pytest.mark.parametrize("written", FRAMES)
@pytest.mark.parametrize("read", FRAMES)
def test_a_file_that_says_its_convention_is_not_read_in_another(tmp_path: Path, written: str, read: str) -> None:
    Trajectory(np.array([Pose(0, 0, 3, 0.5)]), np.zeros(1)).save(tmp_path / "path.tum", written)
    if written == read:
        Trajectory.load(tmp_path / "path.tum", read)
        return
    with pytest.raises(
        MitsonarError,
        match=f"is in the convention {written}, but --frame is {read}: give --frame {written}, or a path in .* {read}",
    ):
        Trajectory.load(tmp_path / "path.tum", read)


def test_conventions_are_rotations() -> None:
    for name in FRAMES:
        for matrix in (convention_named(name).world, convention_named(name).body):
            assert np.linalg.det(np.array(matrix)) == pytest.approx(1)


# ---------------------------------------------------------------- the command line


def test_render_reads_and_writes_the_convention_that_is_named(variant: str, mitsonar: Command, tmp_path: Path) -> None:
    flown = Trajectory.load_tum(shipped_trajectory("flat_floor")).resample(2)
    flown.save(tmp_path / "ros.csv", "ros-enu")
    done = mitsonar(
        "render", "flat_floor", "-o", tmp_path / "ros", "--trajectory", tmp_path / "ros.csv", "--frame", "ros-enu"
    )
    assert done.returncode == 0, done.stderr
    assert "--frame" not in done.stderr
    first = (tmp_path / "ros" / "poses.tum").read_text().splitlines()[0]
    assert "(frame ros-enu: world east, north, up; body forward, left, up)" in first
    back = Trajectory.load(tmp_path / "ros" / "poses.tum", "ros-enu")
    np.testing.assert_allclose(to_world_matrices(back.poses), to_world_matrices(flown.poses), atol=1e-7)
    refused(
        mitsonar("render", "flat_floor", "-o", tmp_path / "x", "--trajectory", tmp_path / "ros.csv", "--frame", "enu"),
        "unknown frame 'enu'",
        "did you mean ros-enu",
    )


@pytest.mark.thorough
def test_the_figure_of_the_documentation_is_drawn(tmp_path: Path) -> None:
    script = Path(__file__).parents[2] / "docs" / "draw_conventions.py"
    done = subprocess.run([sys.executable, script, "--quick", "--out", tmp_path / "a.png"], check=False, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    assert (tmp_path / "a.png").stat().st_size > 5000
