"""Odometry: frames and an estimator become a path; what is killed goes on; what is not believed is bridged."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_frames import SONAR, START, as_zarr, over_ground, sway
from helpers import files_of, lit_plane, tiny_recipe
from matplotlib.figure import Figure
from numpy.typing import NDArray
from recording_files import aris_file, side_scan_echogram

from mitsonar.acoustics.levels import LocalContrast
from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.estimation.estimator import AnyEstimator, Estimate
from mitsonar.estimation.image.direct import Direct
from mitsonar.instruments.sonar import Sonar
from mitsonar.mapping import odometry_run
from mitsonar.mapping.loops import Canvas
from mitsonar.mapping.odometry import OdometryOptions, errors_along, odometry
from mitsonar.mapping.odometry_run import OdometryFolder, run_odometry, table_lines
from mitsonar.mapping.open_source import usual_loop, with_assumed_plane
from mitsonar.mapping.pairs import PAIRS_A_BATCH, EstimateStore, estimate_motions
from mitsonar.mapping.sensors import SensorNoise, simulated_sensors
from mitsonar.mapping.series import MotionSeries, bridged, path_of
from mitsonar.mapping.sources import FrameSource, load_frames, open_frames
from mitsonar.motion.composition import Motion, MotionPrior, motions
from mitsonar.motion.pose import Pose
from mitsonar.motion.sensors import Readings, VehicleSensors
from mitsonar.motion.trajectory import Trajectory
from mitsonar.recordings.write_xtf import write_xtf
from mitsonar.records.frames import SonarFrames

Array = NDArray[np.float64]

STD = np.array([1e-3, 5e-4, 2e-4])


def numbered(path: Trajectory) -> SonarFrames:
    """Frames that hold nothing but their number, for :class:`Told`."""
    image = np.broadcast_to(np.arange(len(path), dtype=np.float32)[:, None, None], (len(path), 3, 2)).copy()
    sonar = Sonar(beams=2, range_bins=3)
    heights = np.full(len(path), 2.5)
    return SonarFrames(image, sonar.range_m, sonar.bearing_rad, path.time_s, sonar, path.poses, heights)


@dataclass(frozen=True)
class Told:
    """An estimator that knows the answers ``(frames, frames)`` by the numbers in the images.

    Attributes:
        poses: the path that it tells.
        off: errors of the motions by the first frame ``(frames, 3)``.
        lost: first frames of motions that it does not believe.
        covariance: that it tells.
        deadly: the first frame at which its process ends.
    """

    poses: Array
    off: Array | None = None
    lost: tuple[int, ...] = ()
    covariance: Array | None = None
    deadly: int | None = None

    consumes = SonarFrames
    inputs = "nothing"
    digest = ""

    def estimate(self, frames: SonarFrames, /, prior: MotionPrior | None = None) -> Estimate:
        first, second = (int(number) for number in frames.image[:, 0, 0])
        if first == self.deadly:
            os._exit(9)
        if first in self.lost:
            return Estimate(Motion(0, 0, 0), None, False, f"correlates by 0.{first:02d} only")
        answer = motions(self.poses[[first, second]])[0]
        return Estimate(Motion(*(answer if self.off is None else answer + self.off[first])), self.covariance)


def told(path: Trajectory, **options: Any) -> tuple[SonarFrames, Told]:
    return numbered(path), Told(path.poses, **options)


# ---------------------------------------------------------------- path


def test_the_path_is_the_motions_composed_from_the_first_pose() -> None:
    path = sway(30)
    result = odometry(*told(path))
    np.testing.assert_allclose(result.path.poses, path.poses, atol=1e-12)
    np.testing.assert_array_equal(result.path.time_s, path.time_s)
    assert result.valid.all()
    elsewhere = odometry(*told(path), OdometryOptions(start=Pose(5, 6, 7, 0.1, 0.2, 1.0)))
    assert elsewhere.path.poses[0].tolist() == [5, 6, 7, 0.1, 0.2, 1.0]
    np.testing.assert_allclose(motions(elsewhere.path.poses), motions(path.poses), atol=1e-12)


def test_without_poses_the_path_begins_at_the_origin_with_what_is_known() -> None:
    path = sway(5)
    frames, estimator = told(path)
    frames.poses = None
    source = FrameSource.of(frames).with_geometry(pitch_rad=0.6)
    result = odometry(source, estimator)
    np.testing.assert_allclose(result.path.poses[0], [0, 0, 2.5, 0.6, 0, 0])
    assert result.true is None
    lengths = [(value, unit) for name, value, unit in result.rows() if name == "estimated path length"]
    assert len(lengths) == 1
    assert lengths[0][0] == pytest.approx(float(np.linalg.norm(motions(path.poses)[:, :2], axis=1).sum()))
    assert lengths[0][1] == "m"


def test_every_third_frame() -> None:
    path = sway(30)
    result = odometry(*told(path), OdometryOptions(every=3))
    assert result.frames.tolist() == list(range(0, 30, 3))
    np.testing.assert_allclose(result.path.poses, path.poses[::3], atol=1e-12)
    rows = {name: value for name, value, _ in result.rows()}
    assert rows["poses compared"] == 10
    assert rows["end-point error"] < 1e-6


def test_estimators_do_not_see_where_the_sonar_was() -> None:
    frames = numbered(sway(9))
    seen = FrameSource.of(frames).read([2, 3])
    assert seen.poses is not None
    np.testing.assert_array_equal(seen.poses[:, [0, 1, 5]], 0)
    np.testing.assert_allclose(seen.poses[:, [2, 3, 4]], np.tile([2.5, np.radians(35), 0], (2, 1)))
    assert seen.image[:, 0, 0].tolist() == [2, 3]
    np.testing.assert_array_equal(seen.time_s, frames.time_s[2:4])


def test_direct_finds_the_path_over_a_drawn_floor() -> None:
    path = sway(16)
    result = odometry(over_ground(path), Direct())
    errors = motions(result.path.poses) - motions(path.poses)
    assert result.valid.all()
    rmse = np.sqrt((errors**2).mean(axis=0))
    assert (rmse < [6e-4, 3e-4, 3e-4]).all(), rmse
    assert result.pose_covariances is not None
    assert result.pose_covariances.shape == (16, 3, 3)


def test_errors_over_relief_are_alike_and_those_over_even_ground_are_not() -> None:
    """First echoes tell; where they do not, relief is assumed. A smoothed path counts errors as independent."""
    result = odometry(over_ground(sway(16)), Direct())
    assert result.correlated is not None
    assert result.correlated.share == 0.9
    even, _, _ = lit_plane(Sonar(range_min=2.0, range_max=7.0), 2.5, np.radians(35))
    canvas = Canvas.of(even.select(np.array([0])))
    assert canvas is not None
    apart = replace(result, correlated=errors_along(result.series.motions, canvas))
    assert apart.correlated is not None
    assert apart.correlated.share == 0.0
    staying, message = result.pose_covariances, apart.pose_covariances
    assert staying is not None
    assert message is not None
    assert np.trace(staying[-1]) > 2 * np.trace(message[-1])
    assert odometry(over_ground(sway(16)), Direct(), OdometryOptions(smooth="kalman")).correlated is None


def test_a_gyroscope_over_even_ground_mends_the_heading_and_leaves_the_rest() -> None:
    """Errors there are noise: what the gyroscope tells of the turns of one motion says nothing of its neighbours."""
    count, rng = 300, np.random.default_rng(3)
    frames, _, _ = lit_plane(Sonar(range_min=2.0, range_max=7.0), 2.5, np.radians(35))
    poses = np.tile([0.0, 0.0, 2.5, np.radians(35), 0.0, 0.0], (count, 1))
    poses[:, 0] = 0.02 * np.arange(count)
    path = Trajectory(poses, np.arange(count) / 10)
    seen = replace(
        frames,
        image=np.broadcast_to(frames.image[0], (count, *frames.image.shape[1:])),
        poses=poses,
        time_s=path.time_s,
        height_m=poses[:, 2],
    )
    mixed = np.array([[1e-3, 0, -3.4e-3], [0, 1e-3, 0], [0, 0, 1e-3]])  # a turn is taken for a step aside
    moved = motions(poses) + rng.standard_normal((count - 1, 3)) @ mixed.T
    known = {k: Estimate(Motion(*one.tolist()), mixed @ mixed.T, True, "", {}) for k, one in enumerate(moved)}
    gyroscope = simulated_sensors(path, SensorNoise(gyro_deg_rth=1.0), seed=0)
    result = odometry(seen, Direct(), OdometryOptions(sensors=gyroscope), store=EstimateStore(known))
    off = result.path.poses[-1, :2] - poses[-1, :2]
    assert result.pose_covariances is not None
    message = np.sqrt(np.trace(result.pose_covariances[-1, :2, :2]))
    slope, length = 0.006, 0.02 * (count - 1)
    independent = np.sqrt(2 * (count - 1) * 1e-3**2 + 2 * (slope * length) ** 2)
    assert message == pytest.approx(independent, rel=0.25)
    assert np.hypot(*off) < 3 * message


@pytest.mark.thorough
def test_workers_change_no_bit() -> None:
    frames = over_ground(sway(3 * PAIRS_A_BATCH), noise=0.05)
    one, two = (odometry(frames, Direct(), OdometryOptions(workers=workers)) for workers in (1, 2))
    np.testing.assert_array_equal(one.path.poses, two.path.poses)
    assert one.series.covariances is not None
    np.testing.assert_array_equal(one.series.covariances, two.series.covariances)
    assert [e.reason for e in one.estimates] == [e.reason for e in two.estimates]


@pytest.mark.thorough
def test_a_worker_that_is_lost_is_said_to_be() -> None:
    had = os.environ.get("OMP_NUM_THREADS")
    with pytest.raises(MitsonarError, match="worker was lost"):
        odometry(*told(sway(40), deadly=20), OdometryOptions(workers=2))
    assert os.environ.get("OMP_NUM_THREADS") == had


# ---------------------------------------------------------------- what is not believed


@pytest.mark.parametrize("covariance", [None, np.diag(STD**2)], ids=["alone", "with covariances"])
def test_what_is_not_believed_is_bridged_and_the_rest_left_as_it_is(covariance: Array | None) -> None:
    """A straight path at one speed, uneven times: a bridge by velocity ends where the path does."""
    path = sway(30)
    speed = np.array([0.02, 0.1, 0.01])
    even = path_of(speed * np.diff(path.time_s)[:, None], START, path.time_s)
    lost = (0, 7, 8, 9, 28)
    result = odometry(*told(even, lost=lost, covariance=covariance))
    assert np.flatnonzero(~result.valid).tolist() == list(lost)
    np.testing.assert_allclose(result.path.poses, even.poses, atol=1e-6)
    stored = result.valid
    np.testing.assert_array_equal(result.series.motions[stored], np.array([e.motion for e in result.estimates])[stored])
    if covariance is None:
        assert result.series.covariances is None
        assert result.pose_covariances is None
    else:
        assert result.series.covariances is not None
        np.testing.assert_array_equal(result.series.covariances[stored], np.tile(covariance, (stored.sum(), 1, 1)))
        assert result.pose_covariances is not None


def test_a_bridge_s_covariance_grows_with_its_length() -> None:
    rng = np.random.default_rng(3)
    time = np.arange(60) / 10
    true = np.cumsum(rng.normal(0, 1e-3, (59, 3)), axis=0)
    covariances = np.tile(np.diag(STD**2), (59, 1, 1))
    valid = np.ones(59, dtype=bool)
    valid[20:31] = False
    series = bridged(MotionSeries(true + STD * rng.normal(size=true.shape), time, covariances, valid))
    assert series.covariances is not None
    spread = np.trace(series.covariances, axis1=1, axis2=2)
    assert spread[25] > 2 * spread[20] > 2 * spread[19]
    # honest: within some standard deviations of what it was
    assert (np.abs(series.motions[25] - true[25]) < 4 * np.sqrt(np.diag(series.covariances[25]))).all()


@pytest.mark.parametrize("covariance", [None, np.diag(STD**2)])
def test_one_believed_motion_is_enough(covariance: Array | None) -> None:
    path = path_of(np.tile([0, 0.01, 0.0], (5, 1)), START, np.arange(6.0))
    result = odometry(*told(path, lost=(0, 1, 3, 4), covariance=covariance))
    np.testing.assert_allclose(result.path.poses, path.poses, atol=1e-12)


def test_many_that_are_not_believed_are_warned_of_and_all_is_an_error() -> None:
    path = sway(31)
    assert odometry(*told(path, lost=(3, 4, 5))).warnings() == []
    (warning,) = odometry(*told(path, lost=(3, 4, 5, 6))).warnings()
    assert "4 of 30 motions (13 %) were rejected and bridged" in warning
    assert "4 times such as 'correlates by 0.03 only'" in warning
    with pytest.raises(MitsonarError, match=r"none of 30 motions is valid.*30 times such as 'correlates by 0.00 only'"):
        odometry(*told(path, lost=tuple(range(30))))


def test_a_pause_that_is_bridged_is_warned_of() -> None:
    """Frame 5 comes 50 minutes after frame 4; measured across the pause, nothing is a guess."""
    path = sway(41)
    paused = Trajectory(path.poses, path.time_s + 3000.0 * (np.arange(41) >= 5))
    (warning,) = odometry(*told(paused, lost=(4, 9))).warnings()
    assert warning.startswith("1 bridged motion took up to 3,000 s, over which the vehicle may have moved anywhere")
    assert odometry(*told(paused, lost=(9,))).warnings() == []


# ---------------------------------------------------------------- scale and smoothing


def test_scale_fits_what_was_shrunk() -> None:
    """Estimates of half, a third and twice the size, one of them lost: the fit undoes it, from the believed ones alone."""
    path = sway(30)
    shrunk = motions(path.poses) * (np.array([1 / 2, 1 / 3, 2]) - 1)
    words = {"off": np.vstack([shrunk, np.zeros(3)]), "covariance": np.diag(STD**2)}
    result = odometry(*told(path, lost=(4,), **words), OdometryOptions(scale="fit"))
    np.testing.assert_allclose(result.factors, [2, 3, 0.5], rtol=1e-9)
    stored = result.valid
    np.testing.assert_allclose(result.series.motions[stored], motions(path.poses)[stored], atol=1e-12)
    assert result.series.covariances is not None
    np.testing.assert_allclose(np.sqrt(np.diag(result.series.covariances[0])), STD * [2, 3, 0.5])
    rows = {name: value for name, value, _ in result.rows()}
    assert rows["scale of forward, fitted to the true path"] == pytest.approx(3)
    given = odometry(*told(path, **words), OdometryOptions(scale=[2, 3, 0.5]))
    np.testing.assert_allclose(given.path.poses, path.poses, atol=1e-9)
    assert "scale of yaw, as given" in [name for name, _, _ in given.rows()]


@pytest.mark.thorough
def test_smoothing_takes_noise_from_motions_and_hardly_changes_the_end() -> None:
    """Why `none` is the default: over ten draws, the RMSE of motions falls, and that of the end stays as it is."""
    path = sway(200)
    end: dict[str, list[float]] = {"none": [], "spline": [], "kalman": []}
    each: dict[str, list[float]] = {"none": [], "spline": [], "kalman": []}
    for seed in range(10):
        off = STD * np.random.default_rng(seed).normal(size=(200, 3))
        for smooth in end:
            options = OdometryOptions(smooth=smooth)  # type: ignore[arg-type]
            result = odometry(*told(path, off=off, covariance=np.diag(STD**2)), options)
            rows = {name: value for name, value, _ in result.rows()}
            end[smooth].append(rows["end-point error"])
            each[smooth].append(rows["motion error RMSE, sideways"])
    rms = {smooth: np.sqrt(np.mean(np.square(values))) for smooth, values in end.items()}
    for smooth in ("spline", "kalman"):
        assert np.mean(each[smooth]) < 0.65 * np.mean(each["none"])
        assert 0.9 < rms[smooth] / rms["none"] < 1.1, rms
    assert np.mean(each["none"]) == pytest.approx(1.0, rel=0.05)


def test_the_table_tells_what_a_hand_finds() -> None:
    path = sway(41)
    off = STD * np.random.default_rng(5).normal(size=(41, 3))
    result = odometry(*told(path, off=off, covariance=np.diag(STD**2)))
    rows = {name: (value, unit) for name, value, unit in result.rows()}
    driven = motions(path.poses)
    for k, (name, scale, unit) in enumerate((("sideways", 1e3, "mm"), ("forward", 1e3, "mm"), ("yaw", 57.29578, "deg"))):
        value, its_unit = rows[f"motion error RMSE, {name}"]
        assert value == pytest.approx(scale * np.sqrt((off[:40, k] ** 2).mean()))
        assert its_unit == unit
        assert rows[f"RMSE of always answering zero, {name}"][0] == pytest.approx(
            scale * np.sqrt((driven[:, k] ** 2).mean())
        )
        assert rows[f"estimated standard deviation of a motion, {name}"][0] == pytest.approx(scale * STD[k])
        slope = ((driven + off[:40])[:, k] * driven[:, k]).sum() / (driven[:, k] ** 2).sum()
        assert rows[f"slope over the true {name}"][0] == pytest.approx(slope)
    nees = ((off[:40] / STD) ** 2).sum(axis=1).mean() / 3
    assert rows["NEES"][0] == pytest.approx(nees)
    end = np.linalg.norm(result.path.poses[-1, :2] - path.poses[-1, :2])
    assert rows["end-point error"][0] == pytest.approx(1e3 * end)
    assert rows["end-point error"][1] == "mm"
    lines = table_lines(result.rows())
    assert lines[0].split("|")[2].strip() == "value"
    assert len({len(line) for line in lines}) == 1


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ("one", {}, "two frames or more: got 1"),
        ("", {"every": 30}, "got 30 from the frames, 1 of them used"),
        ("", {"every": 0}, "every must be at least 1"),
        ("still", {}, "increase: got 0, 0 s at frame 0"),
        ("nan", {}, "finite"),
        ("back", {}, "increase: got 5, 4 s at frame 0"),
        ("", {"smooth": "kalmann"}, "did you mean kalman"),
        ("", {"scale": "fitt"}, "three factors or fit"),
        ("no poses", {"scale": "fit"}, "true poses"),
        ("", {"scale": [1, 2]}, "three finite numbers"),
    ],
)
def test_what_cannot_be_driven_is_said(change: str, options: dict[str, Any], message: str) -> None:
    frames, estimator = told(sway(30))
    match change:
        case "one":
            frames = frames.select(slice(1))
        case "still":
            frames.time_s = np.zeros(30)
        case "nan":
            frames.time_s = np.full(30, np.nan)
        case "back":
            frames.time_s = np.arange(5.0, -25, -1)
        case "no poses":
            frames.poses = None
    with pytest.raises(MitsonarError, match=message):
        odometry(frames, estimator, OdometryOptions(**options))


def test_heights_of_an_altimeter_that_misses_frames_are_kept() -> None:
    """No plane is assumed in their place; motions of frames without a height are bridged."""
    source = FrameSource.of(over_ground(sway(6)))
    heights = np.array([2.5, 2.5, np.nan, np.nan, 2.5, 2.5])
    source = replace(source, poses=None, height_m=heights, pitch_rad=0.4)
    assert with_assumed_plane(source) is source
    result = odometry(source, "zero")
    assert result.estimates[2].reason == "no height was found in the frames"
    assert result.valid.tolist() == [True, True, False, True, True]
    with pytest.warns(MitsonarWarning, match="are assumed"):
        assert with_assumed_plane(replace(source, height_m=np.full(6, np.nan))).assumed_height


@pytest.mark.parametrize(
    ("time_s", "message"),
    [([], "got 0 from"), ([1.0], "got 1 from"), ([2.0, 1.0], "increase"), ([np.nan, np.nan], "finite")],
)
def test_frames_without_a_path_are_refused_before_sensors_are_read(time_s: list[float], message: str) -> None:
    frames = replace(over_ground(sway(2)), poses=None, height_m=None).select(slice(len(time_s)))
    source = replace(FrameSource.of(frames), time_s=np.array(time_s)).with_geometry(2.2, 0.4)
    time = np.arange(0.0, 9, 0.1)
    one = Readings(time, 0 * time, np.full(90, 1e-4))
    for sensors in (VehicleSensors(yaw_rate=one), VehicleSensors(yaw_rate=one, depth=one, pitch=one, roll=one)):
        with pytest.raises(MitsonarError, match=message):
            odometry(source, "zero", OdometryOptions(sensors=sensors))


# ---------------------------------------------------------------- sources


def count_noun(source: FrameSource) -> tuple[FrameSource, list[int]]:
    """A source that writes down how many frames are asked for."""
    sizes: list[int] = []

    def images(index: NDArray[np.intp]) -> NDArray[np.generic]:
        sizes.append(len(index))
        return source.images(index)

    return replace(source, images=images), sizes


def test_few_frames_are_in_memory_at_a_time() -> None:
    path = sway(100)
    source, sizes = count_noun(FrameSource.of(numbered(path)))
    estimate_motions(source, Told(path.poses), np.arange(100))
    assert max(sizes) == PAIRS_A_BATCH + 1
    assert sum(sizes) < 100 + 100 / PAIRS_A_BATCH + 1
    big = replace(FrameSource.of(over_ground(sway(2))), time_s=np.arange(5000.0))
    assert big.frames_per_chunk * SONAR.range_bins * SONAR.beams * 4 <= 8 * 2**20


def test_no_frame_is_read_alone() -> None:
    """The motion of beams that ping in groups needs a second frame."""
    source = FrameSource.of(numbered(sway(9)))
    per_chunk = source.frames_per_chunk
    many = np.arange(2 * per_chunk + 1) % 9
    sizes = [len(one) for one in source.chunks(many)]
    assert sum(sizes) == len(many)
    assert 2 < min(sizes) <= max(sizes) <= per_chunk
    assert [len(one) for one in source.chunks([4])] == [1]
    assert list(source.chunks([])) == []


def test_a_given_height_is_the_mean_over_a_path_that_heaves() -> None:
    path = sway(5).poses.copy()
    path[:, 2] = 7.0 + np.array([0.0, 0.1, 0.2, 0.1, 0.1])
    source = FrameSource.of(replace(over_ground(sway(5)), poses=None, height_m=None))
    index = np.array([1, 2, 4])
    assert source.heights_along(index, path[index]) is None
    heights = source.with_geometry(2.0).heights_along(index, path[index])
    np.testing.assert_allclose(heights, 2.0 + np.array([0.1, 0.2, 0.1]) - 0.4 / 3)  # type: ignore[arg-type]
    path[:, 2] *= 1000  # in millimetres
    with pytest.raises(MitsonarError, match=r"heaves by -33\.33\.\.66\.67 m about its mean, more than the height of 2 m"):
        source.with_geometry(2.0).heights_along(index, path[index])
    measured = replace(source, height_m=np.full(5, 2.0))
    np.testing.assert_array_equal(measured.heights_along(index, path[index]), 2.0)


def test_frames_that_read_otherwise_have_another_digest() -> None:
    frames = over_ground(sway(4))
    source = FrameSource.of(frames)
    others = [
        replace(source, like=replace(source.like, level="dB")),
        replace(source, like=replace(source.like, level_scale=2.0)),
        replace(source, rise_m=np.arange(4.0)),
        replace(source, pattern_db=np.ones(frames.image.shape[1:], np.float32)),
    ]
    assert len({one.digest() for one in [source, *others]}) == 1 + len(others)


def test_frames_are_the_same_wherever_they_lie(tmp_path: Path) -> None:
    frames = over_ground(sway(12))
    frames.elevation_rad = np.zeros_like(frames.image)
    (tmp_path / "short").mkdir()
    (tmp_path / "long").mkdir()
    frames.save(tmp_path / "short" / "frames.npz")
    as_zarr(frames, tmp_path / "long" / "frames.zarr")
    digests = []
    for where in ("short", "short/frames.npz", "long", "long/frames.zarr"):
        source = open_frames(tmp_path / where)
        assert len(source) == 12
        for index in ([3], [2, 3, 4], [1, 5, 9], [7, 2, 4]):
            read = source.read(index)
            np.testing.assert_array_equal(read.image, frames.image[index])
            assert frames.height_m is not None
            np.testing.assert_array_equal(read.height_m, frames.height_m[index])
            assert read.elevation_rad is None
        assert source.like.sonar == SONAR
        np.testing.assert_array_equal(source.poses, frames.poses)
        np.testing.assert_array_equal(load_frames(tmp_path / where).poses, frames.poses)  # not only what estimators may see
        digests.append(source.digest())
    assert len(set(digests)) == 1
    frames.image[5] += 0.001  # of the first, the middle and the last frame
    assert FrameSource.of(frames).digest() != digests[0]


def test_loops_are_closed_of_contrast_unless_told() -> None:
    """Over eight motions, or half of them where there are fewer than sixteen."""
    for frames, steps in ((20, 8), (12, 5), (6, 2), (4, 0)):
        source = FrameSource.of(over_ground(sway(frames)))
        assert usual_loop(source) == 0
        assert usual_loop(source.with_contrast(LocalContrast())) == steps


def test_the_attitude_of_a_long_recording_is_its_own(tmp_path: Path) -> None:
    """By which its motions are estimated where it has no poses: as of the same frames in memory."""
    frames = numbered(sway(12))
    frames.poses, frames.attitude_rad = None, np.column_stack([np.linspace(0.4, 0.6, 12), np.zeros(12), np.full(12, np.nan)])
    as_zarr(frames, tmp_path / "frames.zarr")
    source = open_frames(tmp_path)
    read = source.read([2, 7])
    assert read.poses is not None
    np.testing.assert_array_equal(read.poses[:, 3], frames.attitude_rad[[2, 7], 0])
    assert source.digest() == FrameSource.of(frames).digest()
    frames.attitude_rad[0, 0] = 0.3
    assert source.digest() != FrameSource.of(frames).digest()
    frames.attitude_rad[0, 0] = 99.0
    as_zarr(frames, tmp_path / "frames.zarr")
    with pytest.raises(MitsonarError, match=r"attitude_rad must lie in -7\.\.7"):
        open_frames(tmp_path)


def test_a_run_that_goes_on_gives_what_is_there(tmp_path: Path) -> None:
    as_zarr(numbered(sway(12)), tmp_path / "frames.zarr", done=7)
    with pytest.warns(MitsonarWarning, match="7 of 12 frames written"):
        source = open_frames(tmp_path)
    assert len(source) == 7
    np.testing.assert_array_equal(source.read([6]).image[0, 0], 6)


def test_times_of_beams_are_averaged() -> None:
    frames = numbered(sway(4))
    frames.time_s = frames.time_s[:, None] + np.array([0.0, 0.02])
    np.testing.assert_allclose(FrameSource.of(frames).time_s, frames.time_s[:, 0] + 0.01)


def test_geometry_is_given_where_it_lacks_and_only_there() -> None:
    frames = numbered(sway(4))
    frames.poses, frames.height_m = None, np.array([2.5, np.nan, 2.6, np.nan])
    source = FrameSource.of(frames).with_geometry(3.0, 0.5)
    seen = source.read([0, 1])
    assert seen.height_m is not None
    assert seen.poses is not None
    assert seen.height_m.tolist() == [2.5, 3.0]
    assert seen.poses[:, 3].tolist() == [0.5, 0.5]
    assert source.true is None
    with pytest.raises(MitsonarError, match="the frames have heights"):
        source.with_geometry(2.0)
    with pytest.raises(MitsonarError, match="the frames have a pitch"):
        FrameSource.of(numbered(sway(4))).with_geometry(pitch_rad=0.5)
    with pytest.raises(MitsonarError, match="above 0"):
        FrameSource.of(frames).with_geometry(-1.0)
    far = float(frames.range_m[-1])
    assert FrameSource.of(frames).with_geometry(far).given_height_m == far
    assert FrameSource.of(frames).with_geometry(far).with_geometry(pitch_rad=0.5).given_height_m == far
    with pytest.raises(MitsonarError, match="no ground is seen from a height of 3500 m: give heights in metres"):
        FrameSource.of(frames).with_geometry(3500.0)
    with pytest.raises(MitsonarError, match=r"-90..90"):
        FrameSource.of(frames).with_geometry(pitch_rad=2.0)
    leaning = FrameSource.of(replace(frames, attitude_rad=np.zeros((4, 3))))
    with pytest.warns(MitsonarWarning, match="replaces the pitch and roll of each frame"):
        leaning.with_geometry(pitch_rad=0.5)
    some = np.array([[0.0, 0, 0], [np.nan] * 3, [0.1, 0, 0], [0.1, 0, np.nan]])
    with pytest.warns(MitsonarWarning, match="replaces the pitch and roll of 3 of 4 frames, which sensors measured"):
        FrameSource.of(replace(frames, attitude_rad=some)).with_geometry(pitch_rad=0.5)


def test_a_planar_path_takes_the_frames_pitch_and_another_keeps_its_own() -> None:
    path = sway(10)
    frames = numbered(path)
    assert frames.poses is not None
    frames.poses[:, 3] += np.linspace(0, 0.1, 10)
    source = FrameSource.of(frames)
    some = slice(2, 9, 2)
    index, poses = source.along(Trajectory(path.poses[some], path.time_s[some] + 0.004))
    assert index.tolist() == [2, 4, 6, 8]
    np.testing.assert_array_equal(poses[:, 3], frames.poses[some, 3])
    np.testing.assert_array_equal(poses[:, [0, 1, 2, 5]], path.poses[some][:, [0, 1, 2, 5]])
    local = path.poses.copy()
    local[:, 3] = np.linspace(0.3, 0.5, 10)
    np.testing.assert_array_equal(source.along(Trajectory(local, path.time_s))[1], local)
    with pytest.raises(MitsonarError, match=r"no pose is within 0.01 s of a frame: give the path of this run"):
        source.along(Trajectory(path.poses, path.time_s + 100))
    with pytest.raises(MitsonarError, match=r"lasts from 1764424800 to 1764424800.9 s, "):
        source.along(Trajectory(path.poses, 1764424800 + 0.1 * np.arange(10.0)))
    # the path's own where sensors miss a frame
    lean = np.full((10, 3), 0.4)
    lean[3] = np.nan
    planar = Trajectory(path.poses * [1, 1, 0, 0, 0, 1], path.time_s)
    _, poses = FrameSource.of(replace(frames, poses=None, attitude_rad=lean)).along(planar)
    np.testing.assert_array_equal(poses[:, 3], np.where(np.arange(10) == 3, 0.0, 0.4))


@pytest.mark.learn
def test_a_data_set_s_sequences_are_runs(tmp_path: Path) -> None:
    """The longest unless told; pixels and noise as the reader of pairs gives them."""
    from mitsonar.datasets.make import make_dataset
    from mitsonar.datasets.samples import SonarPairs

    url = str(tmp_path / "tiny.zarr")
    make_dataset(tiny_recipe(), url, sequences=3)
    pairs = SonarPairs(url, part="all", frames=2, noise="low", seed=4)
    for sequence in (None, 2):
        source = open_frames(url, sequence=sequence).with_noise(NOISE_MODELS["low"], 4)
        number = sequence or 0
        mine = [k for k in range(len(pairs)) if pairs.sequence[pairs.first[k]] == number]
        assert len(source) == len(mine) + 1 == 5
        for k, place in enumerate(mine):
            one = pairs.sonar_frames(place)
            np.testing.assert_array_equal(source.read([k, k + 1]).image, one.image)
            assert source.poses is not None
            np.testing.assert_array_equal(source.poses[k : k + 2], one.poses)
        assert source.note == f"sequence {number} of 3{', the longest' if sequence is None else ''}: 5 frames"
    with pytest.raises(MitsonarError, match="no sequence 3: it has 3, numbered from 0"):
        open_frames(url, sequence=3)
    with pytest.raises(MitsonarError, match="no view 'left'"):
        open_frames(url, view="left")


def test_what_holds_no_frames_is_said(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "with one").mkdir()
    (tmp_path / "with one" / "a.aris").write_bytes(aris_file())
    (tmp_path / "with two").mkdir()
    (tmp_path / "with two" / "b.aris").write_bytes(aris_file())
    write_xtf(tmp_path / "with two" / "c.xtf", side_scan_echogram())
    (tmp_path / "with two" / "notes.txt").write_text("none")
    (tmp_path / "vehicle" / "ahead").mkdir(parents=True)
    numbered(sway(4)).save(tmp_path / "vehicle" / "ahead" / "frames.npz")
    write_xtf(tmp_path / "vehicle" / "c.xtf", side_scan_echogram())
    (tmp_path / "wrong.npz").write_bytes(b"no zip")
    (tmp_path / "empty.aris").touch()
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    as_zarr(numbered(sway(4)), tmp_path / "damaged.zarr")
    (tmp_path / "damaged.zarr" / "zarr.json").write_text("{")
    numbered(sway(4)).save(tmp_path / "frames.npz")
    for name, message in (
        ("empty", r"holds no frames\.npz or frames\.zarr: give frames\.npz"),
        ("with one", r"holds no frames\.npz or frames\.zarr: give the recording in it, .*with one.a\.aris"),
        ("with two", r"holds no frames\.npz or frames\.zarr: give one of the recordings in it: b\.aris, c\.xtf$"),
        ("vehicle", r"give one of the recordings in it: ahead, c\.xtf$"),
        ("none.aris", r"no such file: .*none\.aris; give frames\.npz, .* or a recording"),
        ("wrong.npz", r"cannot read frames .*: it is neither a whole frames\.npz nor a recording .*: ARIS \(\.aris\), "),
        ("empty.aris", r"cannot read frames .*empty\.aris: it is empty; give .* a recording: ARIS \(\.aris\), "),
        ("other.npz", "lacks image"),
        ("damaged.zarr", "cannot read frames"),
    ):
        with pytest.raises(MitsonarError, match=message):
            open_frames(tmp_path / name)
    with pytest.raises(MitsonarError, match="is neither a data set nor a recording"):
        open_frames(tmp_path, sequence=1)


# ---------------------------------------------------------------- folders

RESULTS = {
    *("run.json", "estimates.jsonl", "estimated.tum", "true.tum", "motions.csv", "covariances.npz"),
    *("table.md", "table.json", "path.png", "height_profile.csv"),
}


@pytest.fixture
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty figure in place of the path's, which takes half a second."""
    monkeypatch.setattr(odometry_run, "path_figure", lambda *_, **__: Figure(figsize=(1, 1)))


def run(
    out: Path,
    path: Trajectory,
    estimator: AnyEstimator | None = None,
    options: OdometryOptions = OdometryOptions(),
    **how: Any,
) -> dict[str, bytes]:
    """An odometry's files, but for run.json, which tells the time, and the picture."""
    source = FrameSource.of(numbered(path))
    run_odometry(source, "told", estimator or Told(path.poses, covariance=np.diag(STD**2)), out, options, **how)
    files = files_of(out)
    assert set(files) == RESULTS
    return {name: content for name, content in files.items() if name not in ("run.json", "path.png")}


def test_motions_keep_the_times_of_a_clock(tmp_path: Path) -> None:
    """Seconds since 1970, as recordings count them, keep their fractions."""
    path = Trajectory(sway(4).poses, 1764424800.125 + 0.25 * np.arange(4.0))
    run(tmp_path / "out", path)
    rows = csv.DictReader((tmp_path / "out/motions.csv").open())
    assert [float(row["time_s"]) for row in rows] == path.time_s[1:].tolist()


def test_a_folder_holds_the_path_and_all_about_it(tmp_path: Path) -> None:
    path = sway(20)
    out = tmp_path / "out"
    run(out, path, Told(path.poses, lost=(4,), covariance=np.diag(STD**2)))
    folder = OdometryFolder.open(out)
    np.testing.assert_allclose(folder.estimated.poses[:4], path.poses[:4], atol=2e-8)
    assert folder.true is not None
    np.testing.assert_allclose(folder.true.poses, path.poses, atol=2e-8)
    rows = list(csv.DictReader((out / "motions.csv").open()))
    assert [int(row["frame"]) for row in rows] == list(range(1, 20))
    assert [row["believed"] for row in rows].count("0") == 1
    assert rows[4]["reason"] == "correlates by 0.04 only"
    driven = motions(path.poses)
    assert float(rows[9]["forward_mm"]) == pytest.approx(1e3 * driven[9, 1], abs=1e-6)
    assert float(rows[9]["yaw_std_deg"]) == pytest.approx(np.degrees(STD[2]), rel=1e-5)
    with np.load(out / "covariances.npz") as table:
        assert table["motion_covariances"].shape == (19, 3, 3)
        assert table["pose_covariances"].shape == (20, 3, 3)
        np.testing.assert_allclose(table["motion_covariances"][0], np.diag(STD**2))
    state = json.loads((out / "run.json").read_text())
    assert state["finished"]
    assert state["asked"]["estimator"] == "told"
    assert state["asked"]["options"]["lost"] == [4]
    assert (state["smooth"], state["not_believed"]) == ("none", 1)
    table = json.loads((out / "table.json").read_text())["rows"]
    assert {"name": "motions rejected, bridged", "value": 1.0, "unit": ""} in table
    assert (out / "table.md").read_text().count("\n") == len(table) + 2


def killed_at(number: int) -> Callable[[int], None]:
    done = 0

    def progress(pairs: int) -> None:
        nonlocal done
        done += pairs
        if done >= number:
            raise KeyboardInterrupt

    return progress


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.thorough)])
@pytest.mark.usefixtures("no_picture")
def test_a_killed_odometry_goes_on_to_the_same_files(tmp_path: Path, workers: int) -> None:
    path = sway(40)
    whole = run(tmp_path / "whole", path)
    out = tmp_path / "killed"
    with pytest.raises(KeyboardInterrupt):
        run(out, path, options=OdometryOptions(workers=workers), progress=killed_at(17))
    with pytest.raises(MitsonarError, match="not finished: run the same"):
        OdometryFolder.open(out)
    journal = out / "estimates.jsonl"
    assert 17 <= journal.read_text().count("\n") < 39
    with journal.open("a") as file:
        file.write('{"pair": 30, "motion": [0.1, 0')  # a line that a kill left half written
    assert run(out, path, resume=True) == whole
    assert run(out, path, resume=True) == whole


@pytest.mark.usefixtures("no_picture")
def test_path_options_may_change_when_it_goes_on(tmp_path: Path) -> None:
    """Nothing is estimated again: an estimator that would end the process is not asked."""
    path = sway(40)
    off = STD * np.random.default_rng(1).normal(size=(40, 3))
    first = Told(path.poses, off=off, covariance=np.diag(STD**2))
    out = tmp_path / "out"
    before = run(out, path, first)
    options = OdometryOptions(smooth="kalman", scale="fit")
    expected = run(tmp_path / "new", path, first, options)
    again = run(out, path, first, options, resume=True)
    assert again == expected
    assert again["estimates.jsonl"] == before["estimates.jsonl"]
    assert again["motions.csv"] != before["motions.csv"]


@pytest.mark.usefixtures("no_picture")
def test_another_odometry_is_not_gone_on_with(tmp_path: Path) -> None:
    path = sway(20)
    out = tmp_path / "out"
    run(out, path)
    before = files_of(out)
    with pytest.raises(MitsonarError, match="exists and is kept"):
        run(out, path)
    with pytest.raises(MitsonarError, match=r"was begun with options\.covariance .*, not None"):
        run(out, path, Told(path.poses), resume=True)
    with pytest.raises(MitsonarError, match="was begun with every 1, not 2"):
        run(out, path, options=OdometryOptions(every=2), resume=True)
    with pytest.raises(MitsonarError, match="was begun with frames_sha256"):
        run(out, replace(path, poses=path.poses + 1), Told(path.poses, covariance=np.diag(STD**2)), resume=True)
    with pytest.raises(MitsonarError, match="contradict"):
        run(out, path, overwrite=True, resume=True)
    assert files_of(out) == before
    journal = out / "estimates.jsonl"
    journal.write_text(journal.read_text().replace('"motion"', '"emotion"', 1))
    with pytest.raises(MitsonarError, match=r"estimates.jsonl, line 1 is damaged"):
        run(out, path, resume=True)
    run(out, path, overwrite=True)


def test_a_journal_holds_what_estimators_of_users_report(tmp_path: Path) -> None:
    """Numbers of NumPy, and a covariance that nothing uses since the motion is invalid."""
    about = {"height_m": np.float32(2.5), "height_std_m": np.float64(0.1), "modes": np.eye(4)[:2]}
    estimates = [
        Estimate(Motion(0.1, 0.2, 0.3), np.eye(3), about=about),
        Estimate(Motion(0.0, 0.0, 0.0), -np.eye(3), False, "nothing there"),
    ]
    for pair, estimate in enumerate(estimates):
        odometry_run.add_to_journal(tmp_path / "journal", {"pair": pair}, estimate)
    (_, first), (key, second) = odometry_run.read_journal(tmp_path / "journal", "pair")
    assert first.about == {"height_m": 2.5, "height_std_m": 0.1, "modes": np.eye(4)[:2].tolist()}
    assert key == {"pair": 1}
    assert second.reason == "nothing there"


@pytest.mark.usefixtures("no_picture")
def test_folders_of_others_are_kept(tmp_path: Path) -> None:
    path = sway(20)
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("years of work")
    for overwrite, resume in ((False, False), (True, False), (False, True)):
        with pytest.raises(MitsonarError, match="kept as it is"):
            run(mine, path, overwrite=overwrite, resume=resume)
    assert files_of(mine) == {"thesis.tex": b"years of work"}
    out = tmp_path / "out"
    run(out, path)
    (out / "note.txt").write_text("mine")
    with pytest.raises(AssertionError):  # of `run`: a file of others stays
        run(out, path, overwrite=True)
    assert (out / "note.txt").read_text() == "mine"


def test_nothing_is_left_where_nothing_was_estimated(tmp_path: Path) -> None:
    frames = over_ground(sway(4))
    frames.height_m = frames.poses = None
    with pytest.raises(MitsonarError, match="needs height and pitch"):
        run_odometry(FrameSource.of(frames), "direct", Direct(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_picture")
def test_a_height_that_a_stranger_wrote_is_refused(tmp_path: Path) -> None:
    run(tmp_path / "out", sway(5))
    file = tmp_path / "out" / "run.json"
    state = json.loads(file.read_text())
    for height in ("2", -1.0, True, 1e400):
        file.write_text(json.dumps({**state, "asked": {**state["asked"], "height_m": height}}))
        with pytest.raises(MitsonarError, match=r"run\.json is damaged \(height_m must be "):
            _ = OdometryFolder.open(tmp_path / "out").height_m
    file.write_text(json.dumps({**state, "asked": {**state["asked"], "height_m": 2.5}}))
    assert OdometryFolder.open(tmp_path / "out").height_m == 2.5
