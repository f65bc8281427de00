"""Loops: found on a circle over a drawn floor, never where places are alike, kept in a run's folder, and in its path."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from drawn_frames import SONAR, over_ground
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.mapping.loops import Canvas, match_views
from mitsonar.mapping.odometry import Odometry, OdometryOptions, odometry
from mitsonar.mapping.odometry_run import run_odometry
from mitsonar.mapping.pose_graph import PoseEdges
from mitsonar.mapping.sensors import SensorNoise, simulated_sensors
from mitsonar.mapping.series import path_of
from mitsonar.mapping.sources import FrameSource
from mitsonar.motion.composition import Motion, MotionPrior, motions
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import save_sensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

Array = NDArray[np.float64]

COARSE = SONAR.replace(beams=48, range_bins=64)
STD = np.array([1e-3, 1e-3, 2e-3])
DRIFT = 0.006
START = Pose.from_degrees([1.0, -2.0, 2.5, 35, 0, 40])
LOOPS = OdometryOptions(loops=True)


def circle(frames: int = 127, round_frames: int = 120) -> Trajectory:
    """A circle of 2.4 m in diameter, and on for some frames over the ground that was seen first."""
    turn = 2 * np.pi / round_frames
    return path_of(np.tile([0.0, 1.2 * turn, turn], (frames - 1, 1)), START, np.arange(float(frames)))


@dataclass(frozen=True)
class Drifting:
    """Tells the motion between two frames by their times, with errors of ``STD``; motions beyond 0.3 m are invalid.

    Motions of consecutive frames are too large by ``DRIFT``.

    Attributes:
        path: the true one.
        period: along x, after which all looks the same: motions beyond half of it are told without it; 0: none.
    """

    path: Trajectory
    period: float = 0.0

    consumes = SonarFrames
    inputs = "nothing"
    digest = ""

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        pair = np.searchsorted(self.path.time_s, frames.time_s)
        poses = self.path.poses[pair].copy()
        if self.period:
            poses[1, 1] -= self.period * np.rint((poses[1, 1] - poses[0, 1]) / self.period)
        answer = motions(poses)[0] * (1 + DRIFT * (pair[1] - pair[0] == 1))
        drawn = answer + STD * np.random.default_rng(pair.tolist()).normal(size=3)
        far = np.hypot(*answer[:2]) > 0.3 or abs(answer[2]) > 0.2
        return Estimate(Motion(*drawn.tolist()), np.diag(STD**2), not far, "too far" if far else "")


@pytest.fixture(scope="module")
def round_trip() -> tuple[SonarFrames, Drifting]:
    path = circle()
    return over_ground(path, COARSE), Drifting(path)


# ---------------------------------------------------------------- appearance


def test_the_most_alike_shift_is_the_motion() -> None:
    """A frame and another 0.4 m and 6 deg on: the coarse views tell the motion to within a cell and a step."""
    moved = np.array([0.15, 0.35, np.radians(6)])
    path = path_of(moved[None], START, np.arange(2.0))
    frames = over_ground(path, COARSE)
    canvas = Canvas.of(frames.select(slice(1)))
    assert canvas is not None
    views = [canvas.draw(frames.select(slice(k, k + 1))) for k in range(2)]
    assert views[0] is not None
    assert views[1] is not None
    turns = np.radians(np.arange(-12, 13, 3.0))
    best = match_views(views[0], views[1], turns, np.zeros(2), np.full(2, 1.0))[0]
    assert best.correlation > 0.6
    np.testing.assert_allclose(best.motion[:2], moved[:2], atol=canvas.view.edge)
    assert best.motion[2] == pytest.approx(moved[2], abs=np.radians(3))
    exact = match_views(views[0], views[0], np.zeros(1), np.zeros(2), np.full(2, 1.0))[0]
    assert exact.correlation == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(exact.motion, 0, atol=1e-6)


def kept_loops(found: Odometry) -> PoseEdges:
    """The loops that were kept."""
    assert found.graph is not None
    assert found.graph.search is not None
    return found.graph.search.loops.select(found.graph.accepted)


def test_blank_frames_have_no_view() -> None:
    frames = over_ground(circle(2), COARSE)
    canvas = Canvas.of(frames.select(slice(1)))
    assert canvas is not None
    assert canvas.draw(replace(frames.select(slice(1)), image=np.zeros_like(frames.image[:1]))) is None


# ---------------------------------------------------------------- loops


@pytest.mark.thorough
def test_a_circle_is_closed_where_it_began(round_trip: tuple[SonarFrames, Drifting]) -> None:
    frames, estimator = round_trip
    path = estimator.path
    plain, closed = odometry(frames, estimator), odometry(frames, estimator, LOOPS)
    assert plain.graph is None
    assert closed.graph is not None
    loops = kept_loops(closed)
    assert len(loops.first) >= 2
    assert closed.graph.accepted.all()
    # every loop is between frames a whole round apart
    assert (np.abs(loops.second - loops.first - 120) <= 4).all(), loops
    rows = {name: value for name, value, _ in closed.rows()}
    before = {name: value for name, value, _ in plain.rows()}
    assert rows["loops"] == len(loops.first)
    assert rows["end-point error"] < 0.35 * before["end-point error"]
    assert (
        rows["estimated standard deviation of the end"] < rows["estimated standard deviation of the end, before loops"] / 5
    )
    moved = np.hypot(*(closed.path.poses[-1] - plain.path.poses[-1])[:2])
    assert rows["end moved by loops"] == pytest.approx(1e3 * moved, rel=0.05)
    assert rows["squared pose error over its covariance, a third, mean along the path"] < 3
    # the middle of the path is known less well than its ends, and the covariances say so
    spread = np.trace(closed.graph.covariances[:, :2, :2], axis1=1, axis2=2)
    assert spread[60] > 4 * spread[-1]
    np.testing.assert_allclose(motions(closed.path.poses), closed.series.motions, atol=1e-9)
    assert len(closed.path) == len(path)


def test_places_beyond_the_path_s_covariance_are_not_taken_for_one_another() -> None:
    """A straight way over a floor that repeats after 14 m: perfect likeness, and an estimator that believes it."""
    path = path_of(np.tile([0.0, 0.12, 0.0], (125, 1)), START._replace(heading=0.0), np.arange(126.0))
    frames = over_ground(path, COARSE)
    source = FrameSource.of(frames)
    canvas = Canvas.of(source.read([0]))
    assert canvas is not None
    # the floor does repeat: frames of a multiple of its period are alike
    again = over_ground(
        Trajectory(path.poses[:2] + np.array([[0] * 6, [0, 13.88, 0, 0, 0, 0]]), np.arange(2.0)), COARSE, noise=0.0
    )
    first, second = (canvas.draw(again.select(slice(k, k + 1))) for k in range(2))
    assert first is not None
    assert second is not None
    assert match_views(first, second, np.zeros(1), np.zeros(2), np.full(2, 0.3))[0].correlation > 0.95
    result = odometry(frames, Drifting(path, period=14.0), LOOPS)
    assert result.graph is not None
    assert len(kept_loops(result).first) == 0


@pytest.mark.thorough
def test_a_floor_that_repeats_within_the_covariance_is_ambiguous(round_trip: tuple[SonarFrames, Drifting]) -> None:
    """Tiles of 0.8 m: many places are alike, and no loop is taken, although the estimator would confirm each."""
    path = circle()
    frames = over_ground(path, COARSE, tile_m=0.8)
    loose = 3 * STD

    @dataclass(frozen=True)
    class Loose(Drifting):
        def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
            return replace(super().estimate(frames), covariance=np.diag(loose**2))

    result = odometry(frames, Loose(path), LOOPS)
    assert result.graph is not None
    assert result.graph.search is not None
    assert result.graph.search.rejected["two places look similar"] > 0
    assert len(kept_loops(result).first) == 0


@pytest.mark.thorough
def test_wrong_registrations_are_no_loops(round_trip: tuple[SonarFrames, Drifting]) -> None:
    """An estimator that is lost between distant frames: registrations that end elsewhere, or contradict each other."""
    frames, estimator = round_trip

    @dataclass(frozen=True)
    class Lost(Drifting):
        size: float = 1.0

        def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
            right = super().estimate(frames)
            if np.ptp(frames.time_s) < 2:
                return right
            rng = np.random.default_rng(int(frames.time_s[1]))
            off = self.size * np.array([*rng.uniform(0.1, 0.2, 2) * rng.choice([-1, 1], 2), 0.0])
            return replace(right, motion=Motion(*(np.asarray(right.motion) + off).tolist()))

    far = odometry(frames, Lost(estimator.path, size=4.0), LOOPS)
    near = odometry(frames, Lost(estimator.path, size=1.0), LOOPS)
    assert far.graph is not None
    assert near.graph is not None
    assert far.graph.search is not None
    assert far.graph.search.rejected["the registration ends elsewhere than appearance"] > 0
    assert len(kept_loops(far).first) == 0
    assert len(kept_loops(near).first) == 0


# ---------------------------------------------------------------- with sensors, and in a folder


def test_a_gyroscope_lowers_the_error_of_the_end(round_trip: tuple[SonarFrames, Drifting]) -> None:
    frames, estimator = round_trip
    plain = odometry(frames, estimator)
    gyro = simulated_sensors(estimator.path, SensorNoise(gyro_deg_rth=0.1, depth_m=1e-4), 4)
    result = odometry(frames, estimator, OdometryOptions(sensors=gyro))
    assert result.graph is not None
    assert result.graph.sensors == ("gyroscope", "depth")
    errors = [np.abs(one.path.poses[-1, 5] - estimator.path.poses[-1, 5]) for one in (plain, result)]
    assert errors[1] < 0.2 * errors[0]
    np.testing.assert_allclose(result.path.poses[:, 2], 2.5, atol=1e-3)
    assert result.graph.covariances[-1, 2, 2] < 1e-5


def test_motions_without_an_estimate_are_those_of_the_sensors(round_trip: tuple[SonarFrames, Drifting]) -> None:
    frames, estimator = round_trip

    @dataclass(frozen=True)
    class Blind(Drifting):
        def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
            right = super().estimate(frames)
            return right if frames.time_s[0] % 40 < 20 else replace(right, valid=False, reason="blind")

    sensors = simulated_sensors(estimator.path, SensorNoise(gyro_deg_rth=0.1, velocity_m_s=1e-3), 4)
    result = odometry(frames, Blind(estimator.path), OdometryOptions(sensors=sensors))
    assert (~result.valid).sum() >= 60
    off = result.series.motions - motions(estimator.path.poses)
    assert np.abs(off[~result.valid]).max() < 3e-3


def test_a_compass_tells_the_first_heading_where_nothing_else_does(round_trip: tuple[SonarFrames, Drifting]) -> None:
    frames, estimator = round_trip
    blind = FrameSource.of(replace(frames, poses=None)).with_geometry(pitch_rad=float(np.radians(35)))
    sensors = simulated_sensors(estimator.path, SensorNoise(compass_deg=2.0, rate_hz=1.0), 5)
    result = odometry(blind, estimator, OdometryOptions(sensors=sensors))
    assert result.graph is not None
    assert np.degrees(result.path.poses[0, 5]) == pytest.approx(40, abs=2)
    assert np.degrees(np.sqrt(result.graph.covariances[0, 2, 2])) < 1


@pytest.mark.thorough
def test_a_run_s_folder_keeps_registrations_and_resumes_to_the_same_bits(
    round_trip: tuple[SonarFrames, Drifting], tmp_path: Path
) -> None:
    frames, estimator = round_trip
    source = FrameSource.of(frames, "circle")
    save_sensors(tmp_path / "gyro.csv", sensors := simulated_sensors(estimator.path, SensorNoise(gyro_deg_rth=5.0), 4))
    options = OdometryOptions(sensors=sensors, loops=True, every=2)
    once = run_odometry(source, "drifting", estimator, tmp_path / "out", options)
    assert once.graph is not None
    files = ("estimated.tum", "motions.csv", "loops.csv", "loops.jsonl", "table.md")
    bits = {name: (tmp_path / "out" / name).read_bytes() for name in files}
    rows = list(csv.DictReader((tmp_path / "out" / "loops.csv").open()))
    assert len(rows) == len(once.graph.accepted)
    assert {row["kept"] for row in rows} == {"1"}
    # a kill in the middle of the registrations
    lines = bits["loops.jsonl"].splitlines(keepends=True)
    assert len(lines) >= 2
    (tmp_path / "out" / "loops.jsonl").write_bytes(lines[0] + lines[1][:20])

    @dataclass(frozen=True)
    class Counting(Drifting):
        def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
            arguments.append(float(np.ptp(frames.time_s)))
            return super().estimate(frames)

    arguments: list[float] = []
    run_odometry(source, "drifting", Counting(estimator.path), tmp_path / "out", options, resume=True)
    assert len(arguments) == len(lines) - 1
    assert min(arguments) > 2
    assert {name: (tmp_path / "out" / name).read_bytes() for name in files} == bits
    (tmp_path / "out" / "loops.jsonl").write_bytes(b'{"first": 1, "motion": [0, 0, 0]}\n')
    with pytest.raises(MitsonarError, match=r"loops.jsonl, line 1 is damaged"):
        run_odometry(source, "drifting", estimator, tmp_path / "out", options, resume=True)
    with pytest.raises(MitsonarError, match="sensors_sha256"):
        run_odometry(source, "drifting", estimator, tmp_path / "out", replace(options, sensors=None), resume=True)


def test_what_a_pose_graph_cannot_do_is_refused(round_trip: tuple[SonarFrames, Drifting]) -> None:
    frames, estimator = round_trip
    with pytest.raises(MitsonarError, match="exclude each other"):
        OdometryOptions(loops=True, smooth="kalman")
    blind = FrameSource.of(replace(frames, poses=None))
    with pytest.raises(MitsonarError, match="give the height and the pitch"):
        odometry(blind, estimator, LOOPS)
    late = simulated_sensors(Trajectory(estimator.path.poses, estimator.path.time_s + 1000), SensorNoise(gyro_deg_rth=1.0))
    with pytest.raises(MitsonarError, match=r"no reading at the times of the frames, 0\.\.126 s"):
        odometry(frames, estimator, OdometryOptions(sensors=late))
