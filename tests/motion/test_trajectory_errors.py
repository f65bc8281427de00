"""Errors of a path against the true one: closed forms, and agreement with evo, run as the command that it is."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import essence
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.mapping.series import path_of
from mitsonar.motion.errors import Alignment, absolute_errors, aligned, assess, associated, path_length, relative_errors
from mitsonar.motion.pose import Pose, poses_from, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory

Array = NDArray[np.float64]

START = Pose(3.0, -2.0, 2.5, np.radians(35), 0.0, 3.0)


def straight(frames: int = 101, step: float = 0.1, yaw: float = 0.0) -> Trajectory:
    """Forward by ``step`` m a frame."""
    return path_of(np.tile([0.0, step, yaw], (frames - 1, 1)), START, np.arange(frames) / 20)


def curved(frames: int = 150, seed: int = 0) -> tuple[Trajectory, Trajectory]:
    """A path in space with pitch and roll that change, and an estimate of it that strays."""
    rng = np.random.default_rng(seed)
    time = 100 + np.cumsum(rng.uniform(0.03, 0.08, frames))
    driven = np.column_stack([0.02 * np.sin(time), 0.04 + 0.02 * np.cos(2 * time), 0.02 * np.sin(0.7 * time)])[1:]
    true = path_of(driven, START, time)
    swing = np.column_stack([0 * time, 0 * time, 0.2 * np.sin(time), 0.1 * np.sin(2 * time), 0.1 * np.cos(time), 0 * time])
    noise = rng.normal(size=driven.shape) * [2e-3, 2e-3, 3e-3]
    start = START._replace(x=START.x + 0.3, y=START.y - 0.2, heading=START.heading + 0.3)
    estimated = path_of(driven + noise, start, time)
    wobble = rng.normal(size=(frames, 6)) * [0, 0, 5e-3, 5e-3, 5e-3, 0]
    return replace(estimated, poses=estimated.poses + swing + wobble), replace(true, poses=true.poses + swing)


def moved(path: Trajectory, x: float, y: float, turn: float) -> Trajectory:
    """The whole path turned clockwise about the world's origin, then shifted."""
    rotation = vehicle_rotation(Pose(0, 0, 0, heading=turn))[0]
    position = rotation.apply(path.poses[:, :3]) + np.array([x, y, 0])
    return Trajectory(poses_from(position, rotation * vehicle_rotation(path.poses)), path.time_s)


# ---------------------------------------------------------------- closed forms


def test_a_path_has_no_errors_against_itself() -> None:
    _, true = curved()
    errors = assess(true, true)
    got = np.array([value for name, value, _ in errors.rows() if "error" in name or "drift" in name])
    np.testing.assert_allclose(got, 0, atol=1e-4)  # mm, deg, %
    assert errors.frames == 150
    assert errors.pairs == 149
    assert errors.path_m == errors.estimated_path_m == path_length(true)


def test_a_scale_error_is_drift_in_percent() -> None:
    errors = assess(straight(step=0.098), straight(step=0.1), delta=10)
    np.testing.assert_allclose(errors.path_m, 10)
    np.testing.assert_allclose(errors.estimated_path_m, 9.8)
    np.testing.assert_allclose(errors.end_drift, 0.02)
    np.testing.assert_allclose(errors.end_error_m, 0.2)
    np.testing.assert_allclose(errors.absolute_max_m, 0.2)
    np.testing.assert_allclose(errors.absolute_rmse_m, 0.002 * np.sqrt(np.mean(np.arange(101) ** 2)))
    np.testing.assert_allclose(errors.relative_rmse_m, 0.02)
    assert errors.pairs == 10
    np.testing.assert_allclose(errors.absolute_angle_rmse_rad, 0, atol=1e-7)
    table = {name: (round(value, 6), unit) for name, value, unit in errors.rows()}
    assert table["end-point drift"] == (2.0, "% of path")
    assert table["relative error RMSE over 10 frames"] == (20.0, "mm")
    assert table["absolute error maximum, first pose aligned"] == (200.0, "mm")
    assert table["path length"] == (10.0, "m")
    assert table["poses compared"] == (101, "")


def test_a_yaw_bias_is_heading_drift() -> None:
    """0.05 deg a frame over 0.1 m a frame is 50 deg per 100 m, clockwise; also past 180 deg."""
    errors = assess(straight(yaw=np.radians(0.05)), straight())
    table = {name: (round(value, 6), unit) for name, value, unit in errors.rows()}
    assert table["heading drift"] == (50.0, "deg per 100 m")
    assert table["heading error at the end"] == (5.0, "deg")
    assert table["relative attitude error RMSE over 1 frame"] == (0.05, "deg")
    second = assess(straight(yaw=np.radians(-5)), straight())
    np.testing.assert_allclose(np.degrees(second.end_heading_rad), -500)
    wrapped = straight(yaw=np.radians(-5))
    wrapped.poses[:, 5] = (wrapped.poses[:, 5] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(assess(wrapped, straight()).end_heading_rad, second.end_heading_rad)


def test_a_loop_that_does_not_close() -> None:
    """A circle of n chords with one of yaw missed by a: the end lies a chord of that angle from where it should."""
    n, d, a = 72, 0.1, 0.02
    driven = np.tile([0, d, 2 * np.pi / n], (n, 1))
    true = path_of(driven, START, np.arange(n + 1.0))
    driven[n // 2, 2] += a
    errors = assess(path_of(driven, START, np.arange(n + 1.0)), true)
    corner = true.poses[n // 2, :2]
    np.testing.assert_allclose(errors.end_error_m, 2 * np.sin(a / 2) * np.linalg.norm(true.poses[-1, :2] - corner))
    np.testing.assert_allclose(errors.end_drift, errors.end_error_m / (n * d))


def test_turning_on_the_spot_has_no_drift_per_length() -> None:
    spin = np.tile([0, 0, np.radians(0.4)], (300, 1))
    time = np.arange(301) / 20
    errors = assess(path_of(spin * 1.01, START, time), path_of(spin, START, time))
    np.testing.assert_allclose(np.degrees(errors.end_heading_rad), 1.2)
    assert np.isnan(errors.end_drift)
    assert np.isnan(errors.heading_drift_rad_per_m)


# ---------------------------------------------------------------- alignment


@pytest.mark.parametrize("align", ["first", "plane", "space"])
def test_alignment_undoes_a_turn_and_a_shift(align: Alignment) -> None:
    _, true = curved()
    away = moved(true, 5.0, -3.0, 2.0)
    distance, angle = absolute_errors(away, true, align)
    np.testing.assert_allclose(distance, 0, atol=1e-12)
    np.testing.assert_allclose(angle, 0, atol=1e-7)
    distance, angle = absolute_errors(away, true, "none")
    np.testing.assert_allclose(angle, 2.0, atol=1e-7)
    assert distance.min() > 1


@pytest.mark.parametrize("align", ["plane", "space"])
def test_alignment_brings_all_positions_nearest(align: Alignment) -> None:
    """A further turn about the vertical or a shift makes it worse, and so does alignment by the first pose."""
    estimated, true = curved()
    best = aligned(estimated, true, align)

    def error(path: Trajectory) -> float:
        return float(((path.poses[:, :2] - true.poses[:, :2]) ** 2).sum())

    for x, y, turn in ((1e-3, 0, 0), (-1e-3, 0, 0), (0, 1e-3, 0), (0, -1e-3, 0), (0, 0, 1e-3), (0, 0, -1e-3)):
        assert error(moved(best, x, y, turn)) > error(best)
    assert error(aligned(estimated, true, "first")) > error(best)


def test_alignment_in_the_plane_leaves_height_pitch_and_roll() -> None:
    estimated, true = curved()
    np.testing.assert_allclose(aligned(estimated, true, "plane").poses[:, 2:5], estimated.poses[:, 2:5], atol=1e-12)


def test_what_cannot_be_aligned() -> None:
    true = straight(11)
    aligned(straight(11, yaw=0.01), true, "plane")  # a straight path can, in the plane
    with pytest.raises(MitsonarError, match="straight path does not determine the rotation about itself"):
        aligned(straight(11, yaw=0.01), true, "space")
    with pytest.raises(MitsonarError, match="path without motion"):
        aligned(straight(11, step=0.0), true, "plane")
    with pytest.raises(MitsonarError, match="the paths must have equal numbers of poses: got 10 and 11"):
        absolute_errors(straight(10), true)
    with pytest.raises(MitsonarError, match="align must be one of none, first, plane, space: got 'umeyama'"):
        aligned(true, true, "umeyama")  # type: ignore[arg-type]


# ---------------------------------------------------------------- relative errors


def test_relative_errors_by_metres() -> None:
    """Steps of 0.1 m that should just make a metre; a forward scale of 1.1 errs by 0.1 m each."""
    distance, angle = relative_errors(straight(step=0.11), straight(step=0.1), 1.0, "metres")
    np.testing.assert_allclose(distance, np.full(10, 0.1))
    np.testing.assert_allclose(angle, 0, atol=1e-7)
    distance, _ = relative_errors(straight(step=0.11), straight(step=0.1), 1.0, "metres", overlapping=True)
    np.testing.assert_allclose(distance, np.full(91, 0.1))


def test_relative_errors_do_not_see_where_the_path_lies() -> None:
    estimated, true = curved()
    before = relative_errors(estimated, true, 7)
    after = relative_errors(moved(estimated, 5, -3, 2.0), true, 7)
    np.testing.assert_allclose(after, before, atol=1e-9)


@pytest.mark.parametrize(
    ("delta", "unit", "message"),
    [
        (0, "frames", "1, 2, ... frames or a positive number of metres: got 0 frames"),
        (1.5, "frames", "got 1.5 frames"),
        (-1, "metres", "got -1 metres"),
        (11, "frames", r"11 poses over 1 m, is shorter than 11 frames"),
        (2, "metres", "shorter than 2 metres"),
        (1, "miles", "got 1 miles"),
    ],
)
def test_deltas_that_cannot_be(delta: float, unit: str, message: str) -> None:
    with pytest.raises(MitsonarError, match=message):
        relative_errors(straight(11), straight(11), delta, unit)  # type: ignore[arg-type]
    with pytest.raises(MitsonarError, match="the paths must have equal numbers of poses"):
        relative_errors(straight(10), straight(11))


# ---------------------------------------------------------------- association


def test_poses_are_matched_by_their_times() -> None:
    """An estimate of every third frame, a little late, with one frame that nothing belongs to."""
    true = straight(61)
    some = np.arange(0, 61, 3)
    late = np.append(true.time_s[some] + 0.004, 3.5)
    mine, theirs = associated(late, true.time_s)
    assert mine.tolist() == list(range(21))
    assert theirs.tolist() == some.tolist()
    estimated = Trajectory(np.vstack([true.poses[some], true.poses[-1:]]), late)
    errors = assess(estimated, true)
    assert errors.frames == 21
    np.testing.assert_allclose([errors.absolute_max_m, errors.end_error_m], 0, atol=1e-12)
    assert errors.path_m == path_length(true)
    assert associated(true.time_s, true.time_s, 0.0)[0].size == 61


def test_a_pose_is_matched_once() -> None:
    mine, theirs = associated(np.array([0.0, 0.004, 0.1]), np.array([0.003, 0.1]))
    assert mine.tolist() == [1, 2]
    assert theirs.tolist() == [0, 1]


def test_the_true_path_is_measured_with_all_its_poses() -> None:
    """A zigzag that is estimated at every second corner only: the way driven is that of the zigzag."""
    corners = np.zeros((9, 6))
    corners[:, 0], corners[:, 1] = np.arange(9) % 2, np.arange(9.0)
    true = Trajectory(corners, np.arange(9.0))
    errors = assess(Trajectory(corners[2::2], np.arange(2.0, 9, 2)), true)
    np.testing.assert_allclose(errors.path_m, 6 * np.sqrt(2))
    np.testing.assert_allclose(errors.estimated_path_m, 6)


def test_paths_of_other_times() -> None:
    true = straight(11)
    later = replace(true, time_s=true.time_s + 60)
    with pytest.raises(MitsonarError, match=r"\(60..60.5 s\) is within 0.01 s .* \(0..0.5 s\): the nearest is 59.5 s away"):
        assess(later, true)
    with pytest.raises(MitsonarError, match="two poses or more at equal times: got 1"):
        assess(replace(true, time_s=true.time_s + 0.5), true)
    with pytest.raises(MitsonarError, match="times of the estimated path must increase"):
        associated(true.time_s[::-1], true.time_s)


# ---------------------------------------------------------------- evo


def evo(folder: Path, command: str, *options: str) -> Array:
    """The errors that evo finds between the files true.tum and estimated.tum of a folder."""
    program = Path(sys.executable).parent / command
    if not program.is_file():
        pytest.skip(f"{command} is not installed beside Python")
    result = folder / f"{command}{'_'.join(options)}.zip".replace("/", "")
    home = folder / "home"  # evo writes its settings there
    home.mkdir(exist_ok=True)
    environment = os.environ | {"HOME": str(home), "MPLBACKEND": "agg"}
    call = [str(program), "tum", "true.tum", "estimated.tum", *options, "--save_results", str(result), "--no_warnings"]
    done = subprocess.run(
        call, cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with zipfile.ZipFile(result) as archive, archive.open("error_array.npy") as file:
        return np.asarray(np.load(file))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trajectory, Trajectory]:
    """A folder with both paths as TUM files, and what these hold."""
    folder = tmp_path_factory.mktemp("evo")
    estimated, true = curved()
    estimated.save_tum(folder / "estimated.tum")
    true.save_tum(folder / "true.tum")
    return folder, Trajectory.load_tum(folder / "estimated.tum"), Trajectory.load_tum(folder / "true.tum")


@pytest.mark.parametrize(
    ("align", "options"),
    essence([("none", []), ("first", ["--align_origin"]), ("space", ["--align"])], ("space", ["--align"])),
)
def test_absolute_errors_are_those_of_evo(
    recorded: tuple[Path, Trajectory, Trajectory], align: Alignment, options: list[str]
) -> None:
    folder, estimated, true = recorded
    expected = evo(folder, "evo_ape", *options)
    distance, _ = absolute_errors(estimated, true, align)
    np.testing.assert_allclose(distance, expected, rtol=0, atol=1e-9)
    assert expected.size == 150
    assert expected.max() > 0.01


def test_absolute_angles_are_those_of_evo(recorded: tuple[Path, Trajectory, Trajectory]) -> None:
    folder, estimated, true = recorded
    expected = evo(folder, "evo_ape", "--align", "-r", "angle_deg")
    _, angle = absolute_errors(estimated, true, "space")
    np.testing.assert_allclose(np.degrees(angle), expected, rtol=0, atol=1e-6)


def test_errors_aligned_in_the_plane_are_those_of_evo(tmp_path: Path) -> None:
    """evo knows no alignment in the plane; of paths at one height its alignment in space is the same."""
    flat = [replace(path, poses=path.poses * [1, 1, 0, 0, 0, 1]) for path in curved()]
    for name, path in zip(("estimated", "true"), flat, strict=True):
        path.save_tum(tmp_path / f"{name}.tum")
    estimated, true = (Trajectory.load_tum(tmp_path / f"{name}.tum") for name in ("estimated", "true"))
    distance, _ = absolute_errors(estimated, true, "plane")
    np.testing.assert_allclose(distance, evo(tmp_path, "evo_ape", "--align"), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("delta", "unit", "overlapping", "options"),
    [
        pytest.param(1, "frames", False, [], marks=pytest.mark.thorough),
        pytest.param(7, "frames", True, ["--delta", "7", "--all_pairs"], marks=pytest.mark.thorough),
        (0.5, "metres", False, ["--delta", "0.5", "--delta_unit", "m", "--pairs_from_reference"]),
    ],
    ids=["each frame", "every 7 frames", "each half metre"],
)
def test_relative_errors_are_those_of_evo(
    recorded: tuple[Path, Trajectory, Trajectory], delta: float, unit: str, overlapping: bool, options: list[str]
) -> None:
    folder, estimated, true = recorded
    distance, _ = relative_errors(estimated, true, delta, unit, overlapping=overlapping)  # type: ignore[arg-type]
    np.testing.assert_allclose(distance, evo(folder, "evo_rpe", *options), rtol=0, atol=1e-9)
    assert distance.size > 10


def test_relative_angles_are_those_of_evo(recorded: tuple[Path, Trajectory, Trajectory]) -> None:
    folder, estimated, true = recorded
    _, angle = relative_errors(estimated, true)
    expected = evo(folder, "evo_rpe", "-r", "angle_deg")
    np.testing.assert_allclose(np.degrees(angle), expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        np.degrees(assess(estimated, true).relative_angle_rmse_rad), np.sqrt(np.mean(expected**2)), rtol=1e-6
    )
