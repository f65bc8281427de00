"""Pose, motion and trajectory: their conventions, eq. 3.4, and TUM files."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest
from helpers import axes

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion, compose, motions
from mitsonar.motion.pose import Pose, mounted, pose_from_to_world, to_world_matrices
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.pings import moments_of

RIGHT_ANGLE = np.pi / 2


def random_poses(count: int) -> np.ndarray:
    """Poses ``(count, 6)`` with pitch within +-89 deg, roll and heading anywhere."""
    rng = np.random.default_rng(1)
    limits = np.array([50, 50, 50, np.radians(89), np.pi, np.pi])
    return rng.uniform(-limits, limits, (count, 6))


def sensor_axes(pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starboard, forward and up by ``to_world``: starboard is local -x, forward +z, up +y."""
    turn = to_world_matrices(pose)[0, :3, :3]
    return -turn[:, 0], turn[:, 2], turn[:, 1]


@pytest.mark.parametrize(
    ("pose", "starboard", "forward"),
    [
        (Pose(0, 0, 0), (1, 0, 0), (0, 1, 0)),
        (Pose(0, 0, 0, heading=RIGHT_ANGLE), (0, -1, 0), (1, 0, 0)),  # clockwise seen from above
        (Pose(0, 0, 0, pitch=RIGHT_ANGLE), (1, 0, 0), (0, 0, -1)),  # pitch > 0 looks down
        (Pose(0, 0, 0, roll=RIGHT_ANGLE), (0, 0, -1), (0, 1, 0)),  # roll > 0 puts starboard down
        (Pose(0, 0, 0, pitch=RIGHT_ANGLE, heading=RIGHT_ANGLE), (0, -1, 0), (0, 0, -1)),
        (Pose(0, 0, 0, roll=RIGHT_ANGLE, heading=RIGHT_ANGLE), (0, 0, -1), (1, 0, 0)),
    ],
)
def test_conventions_at_right_angles(pose: Pose, starboard: tuple[int, ...], forward: tuple[int, ...]) -> None:
    got = sensor_axes(pose)
    np.testing.assert_allclose(got[0], starboard, atol=1e-15)
    np.testing.assert_allclose(got[1], forward, atol=1e-15)
    np.testing.assert_allclose(got[2], np.cross(starboard, forward), atol=1e-15)


def test_conventions_at_random_poses() -> None:
    """Rotation = heading, then pitch, then roll, intrinsic."""
    table = random_poses(200)
    for row in table:
        np.testing.assert_allclose(sensor_axes(Pose(*row)), axes(Pose(*row)), atol=1e-14)
    np.testing.assert_array_equal(to_world_matrices(table)[:, :3, 3], table[:, :3])


def test_compose_is_equation_3_4() -> None:
    """Motion (dx sideways, dy forward, dtheta), along the new heading."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        pose = Pose(*rng.uniform(-3, 3, 6))
        dx, dy, turn = rng.uniform(-1, 1, 3)
        after = compose(pose, Motion(dx, dy, turn))
        starboard, forward, _ = axes(Pose(0, 0, 0, heading=pose.heading + turn))
        moved = np.array(pose[:2]) + (dx * starboard + dy * forward)[:2]
        np.testing.assert_allclose(after, [*moved, pose.z, pose.pitch, pose.roll, pose.heading + turn], atol=1e-12)


def test_old_and_new_heading_differ_by_less_than_a_fifth_of_a_millimetre() -> None:
    """By up to 0.16 mm at 20 mm and 0.45 deg a frame."""
    turn = np.radians(0.45)
    new = np.array(compose(Pose(0, 0, 0), Motion(0, 0.02, turn))[:2])
    assert np.linalg.norm(new - [0, 0.02]) == pytest.approx(0.157e-3, rel=0.01)


def test_pose_and_to_world_invert_each_other() -> None:
    table = random_poses(500)
    back = np.array([pose_from_to_world(matrix) for matrix in to_world_matrices(table)])
    np.testing.assert_allclose(back, table, atol=1e-9)


@pytest.mark.parametrize("pitch", [RIGHT_ANGLE, -RIGHT_ANGLE, RIGHT_ANGLE - 1e-7, RIGHT_ANGLE - 1e-4])
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_looking_straight_down_or_up(pitch: float, kind: type) -> None:
    """Heading and roll are one angle there: the matrix must come back, also from Mitsuba's float32."""
    for heading in np.radians(np.arange(-175, 180, 15)):
        matrix = to_world_matrices(Pose(1, 2, 3, pitch, 0.3, heading))[0].astype(kind)
        pose = pose_from_to_world(matrix)
        np.testing.assert_allclose(to_world_matrices(pose)[0], matrix, atol=2e-7)
        assert pose_from_to_world(to_world_matrices(Pose(1, 2, 3, RIGHT_ANGLE, 0, heading))[0]) == pytest.approx(
            (1, 2, 3, RIGHT_ANGLE, 0, heading), abs=1e-7
        )


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([2.0, 2.0, 2.0, 1.0]), "only rotate and translate: got a scale"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "mirror"),
        (np.array([[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "shear"),
        (np.diag([np.nan, 1.0, 1.0, 1.0]), "must be finite"),
        (np.array([[1, 0, 0, np.inf], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "must be finite"),
    ],
)
def test_to_world_that_is_no_pose(matrix: np.ndarray, message: str) -> None:
    with pytest.raises(MitsonarError, match=message):
        pose_from_to_world(matrix)


def test_pose_in_degrees() -> None:
    assert Pose.from_degrees([1, 2, 3, 35, 0, 90]) == pytest.approx((1, 2, 3, np.radians(35), 0, RIGHT_ANGLE))
    with pytest.raises(MitsonarError, match=r"six numbers.*got 5"):
        Pose.from_degrees([1, 2, 3, 4, 5])
    with pytest.raises(MitsonarError, match="finite: got 1,2,nan"):
        Pose.from_degrees([1, 2, np.nan, 4, 5, 6])


# ---------------------------------------------------------------- trajectories


def test_between_runs_linearly_as_the_numbers_are_given() -> None:
    start, end = Pose(0, 0, 2, 0.1, 0, np.radians(350)), Pose.from_row((1, 2, 2, 0.3, 0, np.radians(370)))
    flown = Trajectory.between(start, end, 5, rate_hz=20)
    np.testing.assert_allclose(flown.poses[2], [0.5, 1, 2, 0.2, 0, np.radians(360)], atol=1e-12)
    np.testing.assert_array_equal(flown.poses[[0, -1]], [start, end])
    np.testing.assert_allclose(flown.time_s, np.arange(5) / 20)
    assert len(Trajectory.between(start, end, 1, 10)) == 1
    with pytest.raises(MitsonarError, match="frames must be at least 1: got 0"):
        Trajectory.between(start, end, 0, 10)


def test_resample_goes_straight_and_turns_the_shortest_way() -> None:
    poses = np.array(
        [[0, 0, 1, 0, 0, np.radians(170)], [2, 0, 1, 0, 0, np.radians(-170)], [2, 4, 1, 0, 0, np.radians(-170)]]
    )
    flown = Trajectory(poses, np.array([0.0, 1.0, 3.0])).resample(7)
    np.testing.assert_allclose(flown.time_s, np.arange(7) / 2, atol=1e-12)
    np.testing.assert_allclose(flown.poses[:, :2], [[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [2, 3], [2, 4]], atol=1e-12)
    turned = np.degrees(flown.poses[:, 5]) % 360
    np.testing.assert_allclose(turned, [170, 180, 190, 190, 190, 190, 190], atol=1e-9)
    np.testing.assert_allclose(flown.poses[:, 3:5], 0, atol=1e-12)


def test_resample_at_its_own_times_changes_nothing() -> None:
    poses = random_poses(9)
    flown = Trajectory(poses, np.linspace(5, 7, 9))
    again = flown.resample(9)
    np.testing.assert_allclose(to_world_matrices(again.poses), to_world_matrices(poses), atol=1e-9)
    np.testing.assert_allclose(again.time_s, flown.time_s)


def test_resample_of_one_pose_stays_there() -> None:
    still = Trajectory(random_poses(1), np.array([3.0])).resample(4)
    np.testing.assert_array_equal(still.poses, np.repeat(random_poses(1), 4, axis=0))
    assert (np.diff(still.time_s) > 0).all()
    with pytest.raises(MitsonarError, match="frames must be at least 1"):
        still.resample(0)


@pytest.mark.parametrize(
    ("poses", "time"),
    [(np.zeros((3, 6)), np.arange(2.0)), (np.zeros((3, 5)), np.arange(3.0)), (np.zeros((0, 6)), np.zeros(0))],
)
def test_trajectory_of_another_shape(poses: np.ndarray, time: np.ndarray) -> None:
    with pytest.raises(MitsonarError, match=r"poses \(frames, 6\) with a time each"):
        Trajectory(poses, time)


def test_trajectory_must_be_finite() -> None:
    with pytest.raises(MitsonarError, match="must be finite"):
        Trajectory(np.full((1, 6), np.nan), np.zeros(1))
    with pytest.raises(MitsonarError, match="must be finite"):
        Trajectory(np.zeros((1, 6)), np.array([np.inf]))


# ---------------------------------------------------------------- TUM files


def test_tum_round_trip(tmp_path: Path) -> None:
    flown = Trajectory(random_poses(40), 1.5 + np.arange(40) / 21)
    flown.save_tum(tmp_path / "path.tum")
    back = Trajectory.load_tum(tmp_path / "path.tum")
    np.testing.assert_allclose(back.time_s, flown.time_s, atol=1e-9)
    np.testing.assert_allclose(back.poses[:, :3], flown.poses[:, :3], atol=1e-9)
    np.testing.assert_allclose(to_world_matrices(back.poses), to_world_matrices(flown.poses), atol=5e-9)


def test_tum_quaternion_turns_starboard_forward_up_to_the_world(tmp_path: Path) -> None:
    """Heading 90 deg clockwise is -90 deg about z; a quaternion need not have length 1, comments and blanks are skipped."""
    (tmp_path / "path.tum").write_text(f"# time x y z qx qy qz qw\n\n0.5 1 2 3 0 0 {-2 * np.sqrt(0.5)} {2 * np.sqrt(0.5)}\n")
    loaded = Trajectory.load_tum(tmp_path / "path.tum")
    np.testing.assert_allclose(loaded.poses, [[1, 2, 3, 0, 0, RIGHT_ANGLE]], atol=1e-12)
    assert loaded.time_s.tolist() == [0.5]


GOOD = "0 0 0 0 0 0 0 1"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 0 0 0 0 0 1", "expected `time x y z qx qy qz qw`"),
        ("1 0 0 0 0 0 0 1 9", "expected `time x y z qx qy qz qw`"),
        ("1 0 0 oops 0 0 0 1", "expected .* got '1 0 0 oops 0 0 0 1'"),
        ("1 0 nan 0 0 0 0 1", "finite numbers"),
        ("1 0 0 inf 0 0 0 1", "finite numbers"),
        ("1764424800000000000 0 0 0 0 0 0 1", r"up to 1e\+12 \(times in s\)"),
        ("1 0 0 0 0 0 0 0", "a quaternion other than zero"),
        ("0 0 0 0 0 0 0 1", "time must increase"),
        ("-1 0 0 0 0 0 0 1", "time must increase"),
    ],
)
def test_tum_errors_name_the_line(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "path.tum").write_text(f"# comment\n{GOOD}\n\n{line}\n5 0 0 0 0 0 0 1\n")
    with pytest.raises(MitsonarError, match=message) as caught:
        Trajectory.load_tum(tmp_path / "path.tum")
    assert "path.tum" in str(caught.value)
    assert "line 4" in str(caught.value)


def test_tum_files_that_hold_nothing(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match=r"no such file: .*absent\.tum"):
        Trajectory.load_tum(tmp_path / "absent.tum")
    (tmp_path / "empty.tum").write_text("# nothing\n")
    with pytest.raises(MitsonarError, match="holds no pose"):
        Trajectory.load_tum(tmp_path / "empty.tum")
    (tmp_path / "binary.tum").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(MitsonarError, match="not text"):
        Trajectory.load_tum(tmp_path / "binary.tum")


def test_motions_invert_compose() -> None:
    """To 1e-12, also across the heading's 360 degrees."""
    rng = np.random.default_rng(4)
    pose, poses, driven = Pose(3.0, -2.0, 2.5, 0.6, 0.1, np.pi - 0.01), [], []
    poses.append(pose)
    for _ in range(60):
        sideways, forward = rng.uniform(-0.02, 0.02, 2)
        motion = Motion(sideways, forward, rng.uniform(-0.02, 0.05))
        pose = compose(pose, motion)
        pose = pose._replace(heading=(pose.heading + np.pi) % (2 * np.pi) - np.pi)
        poses.append(pose)
        driven.append(motion)
    np.testing.assert_allclose(motions(poses), driven, atol=1e-12)
    assert np.ptp([pose.heading for pose in poses]) > 6


def test_a_mount_is_a_pose_in_the_vehicles_axes() -> None:
    vehicle = Pose(1.0, 2.0, 3.0, 0, 0, np.radians(30))
    ahead = mounted(vehicle, Pose(0, 0.5, 0, np.radians(35)))[0]
    starboard, forward, _ = axes(vehicle)
    np.testing.assert_allclose(ahead[:3], np.array(vehicle[:3]) + 0.5 * forward, atol=1e-12)
    np.testing.assert_allclose(ahead[3:], np.radians([35, 0, 30]), atol=1e-12)
    sideways = Pose(*mounted(vehicle, Pose(0, 0, 0, np.radians(35), 0, RIGHT_ANGLE))[0])
    np.testing.assert_allclose(np.degrees([sideways.pitch, sideways.heading]), [35, 120], atol=1e-9)
    np.testing.assert_allclose(axes(sideways)[1] @ starboard, np.cos(np.radians(35)), atol=1e-12)
    # straight down with its azimuth fore-aft: bearing grows forward, elevation to port
    down = Pose(*mounted(vehicle, Pose(0, 0, 0, RIGHT_ANGLE, 0, -RIGHT_ANGLE))[0])
    got = sensor_axes(down)
    np.testing.assert_allclose(got[0], forward, atol=1e-9)
    np.testing.assert_allclose(got[1], [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(got[2], -starboard, atol=1e-9)


def test_a_pitched_mount_keeps_the_rest_to_the_bit() -> None:
    table = random_poses(20)
    table[:, 3:5] = 0
    got = mounted(table, Pose(0, 0, 0, 0.61))
    np.testing.assert_array_equal(got[:, [0, 1, 2, 4, 5]], table[:, [0, 1, 2, 4, 5]])
    np.testing.assert_array_equal(got[:, 3], 0.61)


@pytest.mark.parametrize("angles", [{"pitch": 35.0}, {"roll": -10.0}, {"heading": 90.0}])
def test_degrees_where_radians_are_meant_are_refused(angles: dict[str, float]) -> None:
    (name,) = angles
    with pytest.raises(MitsonarError, match=rf"{name} of a pose is in radians.*got .*use Pose\.from_degrees for degrees"):
        Pose(0, 0, 2.5, **angles)


def test_headings_may_go_on_turning() -> None:
    """In degrees, along a path, from a row, and through a pickle: the same numbers, not wrapped."""
    turned = Pose.from_degrees([0, 0, 2.5, 35, 0, 730])
    assert np.degrees(turned.heading) == pytest.approx(730)
    further = compose(turned, Motion(0.1, 0.2, 0.3))
    assert further.heading == turned.heading + 0.3
    path = Trajectory.between(turned, further, 3, 1.0)
    row = Pose.from_row(path.poses[-1])
    for same in (row, pickle.loads(pickle.dumps(row)), copy.deepcopy(row), row._replace(x=row.x)):
        assert isinstance(same, Pose)
        assert same == further
    assert Pose(0, 0, 0, heading=-2 * np.pi).heading == -2 * np.pi


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        ((0, 0, 2.5, 1e18, 0, 0), r"a pose's angle must be at most 1e\+06 rad: got 1e\+18 rad"),
        ((0, 1e30, 2.5, 0, 0, 0), r"a pose's position must be at most 1e\+12 m: got 1e\+30 m"),
    ],
)
def test_poses_beyond_reach_are_refused(pose: tuple[float, ...], words: str) -> None:
    """Nothing could be rendered there; earlier, a picture without an echo came out."""
    with pytest.raises(MitsonarError, match=words):
        moments_of(Sonar(), [Pose.from_row(pose)], None, 0)
    with pytest.raises(MitsonarError, match=words):
        Trajectory(np.array([pose]), np.zeros(1))
    with pytest.raises(MitsonarError, match="at most"):
        Pose.from_degrees(pose)
