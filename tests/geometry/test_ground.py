"""The height over the visible surface: by first echoes, as given, and over ground that rises."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from drawn_frames import SONAR as FLOOR_SONAR
from drawn_frames import over_ground
from helpers import lit_plane

from mitsonar.errors import MitsonarError
from mitsonar.estimation.named import create_estimator
from mitsonar.geometry.fan import cartesian_map, to_cartesian
from mitsonar.geometry.ground import (
    STD_GIVEN,
    STD_MEASURED,
    TOPS,
    UNKNOWN_MOST,
    UNKNOWN_PER_S,
    Attitude,
    GroundGeometry,
    attitude_of,
    echo_heights,
    lit_margin,
    moved,
)
from mitsonar.instruments.beams import half_power
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

HEIGHT_M, PITCH_RAD = 2.2, np.radians(35)
SONAR = Sonar(range_min=2.0, range_max=7.0, range_bins=800)
TOLERANCE_M = 0.02
"""The frames are blurred along range by 2 bins of 6 mm."""
STD_BOTH = STD_GIVEN * STD_MEASURED / np.hypot(STD_GIVEN, STD_MEASURED)


def weighed(first_m: float) -> float:
    """The height by first echoes and the given one, each by its own standard deviation."""
    weights = 1 / np.array([STD_MEASURED * first_m, STD_GIVEN * HEIGHT_M]) ** 2
    return float(weights @ [first_m, HEIGHT_M] / weights.sum())


def test_level_ground_has_the_height_of_the_first_echoes() -> None:
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    result = attitude_of(frames, "a test", None, None)
    assert result.height_m == pytest.approx(HEIGHT_M, abs=TOLERANCE_M)
    assert result.first is not None
    assert result.height_m == pytest.approx(weighed(result.first.height_m))
    assert result.height_std_m == pytest.approx(STD_BOTH * HEIGHT_M, rel=0.01)
    assert abs(result.tops_m) < TOLERANCE_M
    assert result.even
    assert not result.reason


def test_rising_ground_has_the_mean_height_of_both_ends() -> None:
    """10 deg: the light ends 0.2 m higher than it begins; the height may be any between both, a uniform distribution."""
    frames, near, far = lit_plane(SONAR, HEIGHT_M, PITCH_RAD, 10.0)
    result = attitude_of(replace(frames, height_m=None), "a test", None, None)
    apart = near.mean() - far.mean()
    assert result.first is not None
    assert result.first.height_m == pytest.approx(near.mean(), abs=TOLERANCE_M)
    assert result.height_m == pytest.approx((near.mean() + far.mean()) / 2, abs=TOLERANCE_M)
    assert result.height_std_m == pytest.approx(np.hypot(STD_MEASURED * result.height_m, apart / np.sqrt(12)), rel=0.12)
    # whoever gives the relief means level ground
    given = attitude_of(frames, "a test", HEIGHT_M, None, relief_m=0.1)
    assert given.height_m == pytest.approx(HEIGHT_M - 0.1)
    assert given.first is None


def test_a_window_without_first_echoes_shows_rising_ground_by_its_last_ones() -> None:
    """Against the height that is told; over level ground the told one counts, with its own standard deviation."""
    window = SONAR.replace(range_min=3.9)
    level = attitude_of(lit_plane(window, HEIGHT_M, PITCH_RAD)[0], "a test", None, None)
    assert level.height_m == HEIGHT_M
    assert level.height_std_m == pytest.approx(STD_GIVEN * HEIGHT_M)
    assert level.first is None
    window = SONAR.replace(range_min=3.3)
    frames, _, far = lit_plane(window, HEIGHT_M, PITCH_RAD, 10.0)
    rising = attitude_of(frames, "a test", None, None)
    assert rising.first is None
    assert rising.height_m == pytest.approx(far.mean(), abs=0.1)
    assert rising.height_std_m > STD_GIVEN * HEIGHT_M


def test_rocks_on_level_ground_are_no_slope() -> None:
    """Rocks of 0.5 m in a third of the beams, shadows in another: 5 % between both ends, but the other beams end
    where level ground does."""
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    rocks, _, _ = lit_plane(SONAR, HEIGHT_M - 0.5, PITCH_RAD)
    image = frames.image.copy()
    image[:, frames.range_m > 4.0, 40:72] = 0
    shadows = attitude_of(replace(frames, image=image), "a test", None, None)
    assert shadows.even
    assert shadows.height_std_m == pytest.approx(STD_BOTH * shadows.height_m, rel=0.02)
    image[..., :32] = rocks.image[..., :32]
    result = attitude_of(replace(frames, image=image), "a test", None, None)
    assert not result.even
    assert result.height_std_m == pytest.approx(STD_BOTH * result.height_m, rel=0.02)


def test_ground_that_falls_is_taken_for_level() -> None:
    """Its light ends beyond most windows: only the first echoes count."""
    frames, near, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD, -5.0)
    result = attitude_of(frames, "a test", None, None)
    assert result.height_m == pytest.approx(weighed(near.mean() - result.tops_m), abs=TOLERANCE_M)
    assert result.height_std_m == pytest.approx(STD_BOTH * result.height_m, rel=0.02)


def test_a_given_height_is_not_overruled() -> None:
    """First echoes that contradict it by more than both know are reported, and do not count."""
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    result = attitude_of(replace(frames, height_m=np.full(2, 3.2)), "a test", None, None)
    assert result.height_m == 3.2
    assert result.height_std_m == pytest.approx(np.hypot(STD_GIVEN * 3.2, 3.2 - HEIGHT_M), rel=0.02)
    assert not result.reason
    assert result.doubt == "first echoes give a height of 2.19 m, not 3.20 m"
    near = attitude_of(replace(frames, height_m=np.full(2, 2.4)), "a test", None, None)
    assert not near.doubt
    assert HEIGHT_M < near.height_m < 2.25


def test_each_frame_has_its_own_height_pitch_and_roll() -> None:
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    assert attitude_of(frames, "a test", None, None).apart == ()
    poses = np.array([[0, 0, 2.0, 0.60, 0.02, 0], [0, 0, 2.02, 0.62, -0.02, 0]])
    result = attitude_of(replace(frames, poses=poses), "a test", None, None)
    mean = np.array([result.height_m, result.pitch_rad, result.roll_rad])
    np.testing.assert_allclose(
        np.array([result.of_frame(k) for k in range(2)]) - mean, poses[:, 2:5] - poses[:, 2:5].mean(axis=0)
    )
    assert result.ground(frames, 1).pitch_rad == pytest.approx(0.62)
    assert result.ground(frames).pitch_rad == pytest.approx(0.61)


def test_a_sonar_upside_down_rolls_about_half_a_turn() -> None:
    """Its roll jumps from 180 to -180 deg, whose mean is not 0."""
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    poses = np.array([[0, 0, 2.0, 0.6, np.pi - 0.02, 0], [0, 0, 2.0, 0.6, -np.pi + 0.04, 0]])
    result = attitude_of(replace(frames, poses=poses), "a test", None, None)
    assert result.roll_rad == pytest.approx(np.pi + 0.01)
    assert [result.of_frame(k)[2] for k in range(2)] == pytest.approx([np.pi - 0.02, np.pi + 0.04])


def test_first_echoes_of_a_sonar_upside_down_come_from_its_upper_edge() -> None:
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    first, turned = (echo_heights(frames, PITCH_RAD, roll).first for roll in (0.0, np.pi))
    assert first is not None
    assert turned is not None
    assert turned.height_m == pytest.approx(first.height_m)


@pytest.mark.parametrize(("given_m", "told"), [(2500.0, True), (0.5, True), (HEIGHT_M, False), (None, False)])
def test_a_height_beyond_both_ends_of_rising_ground_is_told(given_m: float | None, told: bool) -> None:
    """A height in millimetres, say: the ends of the light count, and the contradiction is reported."""
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD, 10.0)
    result = attitude_of(frames, "a test", given_m, PITCH_RAD)
    assert ("the ground rises" in result.doubt) == told
    assert result.height_m == pytest.approx(attitude_of(frames, "a test", None, PITCH_RAD).height_m)


@pytest.mark.parametrize(("axis", "change"), [(2, 0.006), (3, np.radians(0.4)), (4, np.radians(0.4))])
def test_heave_pitch_and_roll_look_like_motion_unless_they_are_unknown(axis: int, change: float) -> None:
    """Frames that heave, pitch or roll, registered as if they did not, err by what that looks like; unknown, by less.

    :meth:`GroundGeometry.motion_per_attitude` has that of heave and pitch; sideways and yaw share that of a roll by the
    contrast of the frames. Pitch hardly shows, since it leaves ranges as they are, nor a roll where bearings are azimuths.
    """
    poses = np.tile([0.0, 0.0, 2.5, np.radians(35), 0.0, 0.0], (2, 1))
    poses[1, axis] += change
    sonar = load_sonar("didson300").replace(model="physical") if axis == 4 else FLOOR_SONAR
    frames = over_ground(Trajectory(poses, np.array([0.0, 0.1])), sonar)
    estimator = create_estimator("direct")
    known = estimator.estimate(frames)
    level = poses.mean(axis=0, keepdims=True).repeat(2, axis=0)
    blind = level * [1, 1, np.nan, 1, 1, 1]
    wrong, unknown = (estimator.estimate(replace(frames, poses=one)) for one in (level, blind))
    assert wrong.covariance is not None
    assert unknown.covariance is not None
    error, corrected = (np.array(one.motion) - np.array(known.motion) for one in (wrong, unknown))
    if axis != 4:
        attitude = attitude_of(replace(frames, poses=level), "a test", None, None)
        seen = (
            attitude.ground(frames).motion_per_attitude(12, np.radians(frames.sonar.elevation_fov_deg) / 2)[:, axis - 2]
            * change
        )
        np.testing.assert_allclose(error, seen, atol=0.25 * np.abs(seen).max() + 2e-4)
    assert corrected @ np.linalg.solve(unknown.covariance, corrected) < 2
    if axis != 3:
        assert error @ np.linalg.solve(wrong.covariance, error) > 5
        assert np.abs(corrected[:2]).max() < np.abs(error[:2]).max() / 2


@pytest.mark.parametrize(("axis", "change"), [(2, 0.002), (4, np.radians(0.1))])
def test_noise_of_sensors_widens_by_what_the_frames_leave_of_it(axis: int, change: float) -> None:
    """An error of one height or roll moves the estimate; known as noise, it moves it less, and widens the covariance."""
    poses = np.tile([0.0, 0.0, 2.5, np.radians(35), 0.0, 0.0], (2, 1))
    poses[1, 1] = 0.02
    sonar = load_sonar("didson300").replace(model="physical")
    frames, estimator = over_ground(Trajectory(poses, np.array([0.0, 10.0])), sonar), create_estimator("direct")
    # 10 s apart, the errors of both frames are independent, so that each has half the variance of the change
    std = np.tile(change / np.sqrt(2) * np.eye(3)[axis - 2], (2, 1))
    off = [poses + sign * change * np.outer([0, 1], np.eye(6)[axis]) for sign in (-1, 1)]
    moved_by, left = (
        np.diff([estimator.estimate(replace(frames, poses=one, attitude_std=noise)).motion for one in off], axis=0)[0] / 2
        for noise in (None, std)
    )
    plain, noisy = (estimator.estimate(replace(frames, attitude_std=one)).covariance for one in (None, std))
    assert plain is not None
    assert noisy is not None
    k = int(np.argmax(np.abs(moved_by / np.sqrt(np.diag(plain)))))
    assert abs(left[k]) < abs(moved_by[k]) / 2
    assert left[k] ** 2 < noisy[k, k] - plain[k, k] < moved_by[k] ** 2
    assert moved_by[k] ** 2 > 2 * plain[k, k]


def test_an_unknown_roll_turns_the_motion() -> None:
    """A roll of 1.4 deg that is taken as 0 shifts ground ahead sideways; covariances hold it only if it is unknown."""
    poses = np.tile([0.0, 0.0, 2.5, np.radians(35), np.radians(1.4), 0.0], (2, 1))
    poses[1, 1] = 0.08
    sonar = load_sonar("didson300").replace(model="physical")
    frames, estimator = over_ground(Trajectory(poses, np.array([0.0, 0.1])), sonar), create_estimator("direct")
    level = poses * [1, 1, 1, 1, 0, 1]
    known, wrong = (estimator.estimate(replace(frames, poses=one)) for one in (poses, level))
    unknown = estimator.estimate(replace(frames, poses=level * [1, 1, np.nan, 1, 1, 1]))
    error = np.array(unknown.motion) - np.array(known.motion)
    np.testing.assert_allclose(unknown.motion, wrong.motion, atol=1e-6)
    assert unknown.covariance is not None
    assert wrong.covariance is not None
    assert error @ np.linalg.solve(wrong.covariance, error) > 5
    assert error @ np.linalg.solve(unknown.covariance, error) < 3


def test_heave_looks_like_a_step_along_the_grazing_ray() -> None:
    """Of a single range and a single beam, in closed form: d forward = -h / x d height."""
    narrow = GroundGeometry(np.array([4.0, 4.001]), np.array([-1e-6, 1e-6]), "azimuth", 2.4, np.radians(35))
    seen = narrow.motion_per_attitude(2, np.radians(7))
    assert seen[1, 0] == pytest.approx(-2.4 / 3.2, rel=1e-3)


def test_what_is_known_does_not_widen() -> None:
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    frames = replace(frames, time_s=np.array([0.0, 0.1]))
    poses = np.tile([0.0, 0.0, HEIGHT_M, PITCH_RAD, 0.0, 0.0], (2, 1))
    message = poses * [0, 0, np.nan, 1, 1, 0]
    by_sensors = message + np.array([[0, 0, 0, 0, 0, 0], [0, 0, 0, 0.001, 0, 0]])
    heave, pitch, roll = (0.1 * rate for rate in UNKNOWN_PER_S)
    for table, unsure in ((poses, (0, 0, 0)), (by_sensors, (heave, 0, 0)), (message, (heave, pitch, roll))):
        result = attitude_of(replace(frames, poses=table), "a test", None, None)
        assert result.unsure == pytest.approx(unsure)
    slow = attitude_of(replace(frames, poses=message, time_s=np.array([0.0, 9.0])), "a test", None, None)
    assert slow.unsure == UNKNOWN_MOST


# ---------------------------------------------------------------- scan conversion: metres where they belong, nothing outsid


def pixel_centres(extent: tuple[float, float, float, float], shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    left, right, low, high = extent
    x = left + (np.arange(shape[1]) + 0.5) * (right - left) / shape[1]
    y = high - (np.arange(shape[0]) + 0.5) * (high - low) / shape[0]
    return np.meshgrid(x, y)


@pytest.mark.parametrize("layout", ["even", "sine"])
def test_a_plane_of_levels_comes_out_as_that_plane(layout: str) -> None:
    sonar = Sonar(azimuth_fov_deg=130, beams=600, beam_layout=layout, range_min=2, range_max=10, range_bins=900)
    radius, bearing = np.meshgrid(sonar.range_m, sonar.bearing_rad, indexing="ij")
    level = 0.5 + 0.03 * radius * np.sin(bearing) + 0.02 * radius * np.cos(bearing)
    fan = to_cartesian(level, sonar.range_m, sonar.bearing_rad, rows=300)
    x, y = pixel_centres(fan.extent, fan.image.shape)
    r, b = np.hypot(x, y), np.arctan2(x, y)
    well_inside = (r > 2.05) & (r < 9.95) & (np.abs(b) < np.radians(64))
    np.testing.assert_allclose(fan.image[well_inside], (0.5 + 0.03 * x + 0.02 * y)[well_inside], atol=1e-4)
    outside = (r < 1.98) | (r > 10.02) | (np.abs(b) > np.radians(65.5))
    assert np.isnan(fan.image[outside]).all()


def test_extent_is_the_fan_s_box() -> None:
    sonar = Sonar(azimuth_fov_deg=60, beams=100, range_min=3, range_max=6, range_bins=200)
    left, right, low, high = to_cartesian(np.ones((200, 100)), sonar.range_m, sonar.bearing_rad).extent
    np.testing.assert_allclose([left, right, low, high], [-3, 3, 3 * np.cos(np.pi / 6), 6], atol=1e-9)


def test_starboard_is_right_and_far_is_up() -> None:
    sonar = Sonar(beams=9, range_bins=20)
    image = np.zeros((20, 9))
    image[-1, -1] = 1
    fan = np.nan_to_num(to_cartesian(image, sonar.range_m, sonar.bearing_rad).image)
    row, column = np.unravel_index(fan.argmax(), fan.shape)
    assert row < fan.shape[0] / 4
    assert column > 3 * fan.shape[1] / 4


def test_wrong_shapes_and_orders_are_refused() -> None:
    with pytest.raises(MitsonarError, match=r"\(2, 3\)"):
        to_cartesian(np.zeros((3, 2)), [1, 2], [0, 1, 2])
    with pytest.raises(MitsonarError, match="increase"):
        to_cartesian(np.zeros((2, 2)), [2, 1], [0, 1])


@pytest.mark.learn
def test_torch_converts_the_same() -> None:
    """One map for many images, on NumPy and torch: the same sums of four products."""
    import torch

    sonar = Sonar(azimuth_fov_deg=60, beams=20, range_bins=40)
    images = np.random.default_rng(2).random((3, 2, 40, 20), dtype=np.float32)
    conversion = cartesian_map(sonar.range_m, sonar.bearing_rad, 50)
    fans = conversion.apply(images)
    np.testing.assert_array_equal(conversion.apply(torch.from_numpy(images)).numpy(), fans)
    for one in range(3):
        expected = to_cartesian(images[one, 1], sonar.range_m, sonar.bearing_rad, rows=50)
        np.testing.assert_allclose(fans[one, 1], np.nan_to_num(expected.image), atol=1e-6)
        assert expected.extent == conversion.extent


# ---------------------------------------------------------------- ground

TILTS = [(35.0, 0.0), (20.0, 5.0), (50.0, -8.0)]


def tilted_ground(bearing: str, tilt: tuple[float, float]) -> GroundGeometry:
    pitch, roll = np.radians(tilt)
    return GroundGeometry(np.linspace(3.3, 5.5, 12), np.radians(np.linspace(-14, 14, 9)), bearing, 2.5, pitch, roll)  # type: ignore[arg-type]


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
@pytest.mark.parametrize("tilt", TILTS)
def test_cells_are_seen_where_they_lie(bearing: str, tilt: tuple[float, float]) -> None:
    """There and back; and the point is on the ground, by the sonar's rotation of motion.py."""
    ground = tilted_ground(bearing, tilt)
    radius, b = ground.to_polar(ground.points)
    np.testing.assert_allclose(radius, np.broadcast_to(ground.range_m[:, None], radius.shape), rtol=1e-12)
    np.testing.assert_allclose(b, np.broadcast_to(ground.bearing_rad, b.shape), atol=1e-12)
    pitch, roll = np.radians(tilt)
    pose = Pose(0, 0, 2.5, pitch, roll, 0.0)
    level = np.concatenate([ground.points, np.full((*radius.shape, 1), -2.5)], axis=-1).reshape(-1, 3)
    s, f, _ = vehicle_rotation(pose).inv().apply(level).T
    expected = np.arctan2(s, f) if bearing == "azimuth" else np.arcsin(s / np.linalg.norm(level, axis=1))
    np.testing.assert_allclose(b.ravel(), expected, atol=1e-12)


def test_axis_beam_over_a_level_floor() -> None:
    ground = GroundGeometry(np.array([2.0, 4.0]), np.array([0.0]), "azimuth", 2.5, np.radians(35))
    np.testing.assert_allclose(ground.points[1, 0], [0, np.sqrt(4.0**2 - 2.5**2)], atol=1e-12)
    assert np.isnan(ground.points[0]).all()


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_a_point_moves_as_poses_do(bearing: str) -> None:
    """A fixed point of the world, seen from two poses of motion.py (eq. 3.4)."""
    ground = tilted_ground(bearing, (35.0, 0.0))
    motion = Motion(0.06, -0.09, np.radians(2.0))
    first = Pose(3.0, -2.0, 2.5, 0, 0, 1.1)
    second = compose(first, motion)

    def level(pose: Pose, points: np.ndarray) -> np.ndarray:
        return np.asarray(vehicle_rotation(pose).inv().apply(points - np.array(pose[:3])))

    flat = ground.points.reshape(-1, 2)
    world = vehicle_rotation(first).apply(np.column_stack([flat, np.full(len(flat), -2.5)])) + np.array(first[:3])
    np.testing.assert_allclose(moved(flat, motion), level(second, world)[:, :2], atol=1e-12)


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
@pytest.mark.parametrize("tilt", TILTS)
def test_derivative_by_differences(bearing: str, tilt: tuple[float, float]) -> None:
    ground = tilted_ground(bearing, tilt)
    for axis, step in enumerate(1e-5 * np.eye(3)):
        (r1, b1), (r2, b2) = (ground.to_polar(moved(ground.points, sign * step)) for sign in (-1, 1))
        difference = np.stack([r2 - r1, b2 - b1], axis=-1) / 2e-5
        np.testing.assert_allclose(ground.derivative[..., axis], difference, atol=1e-8)


# ---------------------------------------------------------------- attitude


def test_the_sonar_s_own_sensors_tell_pitch_and_roll_where_poses_do_not() -> None:
    sonar = Sonar(beams=24, range_bins=64)
    lean = np.radians(np.array([[30, 2, 90], [32, 4, np.nan]]))
    image, time, height = np.ones((2, 64, 24), np.float32), np.arange(2.0), np.full(2, 2.5)
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, time, sonar, attitude_rad=lean, height_m=height)
    message = attitude_of(frames, "a test", None, None)
    assert np.degrees([message.pitch_rad, message.roll_rad]) == pytest.approx([31, 3])


# ---------------------------------------------------------------- the outline of the light: where it lies, and where it mus

FOV_DEG = 14.0


def grazing(given_m: float | None = None, height_m: float = 0.32) -> tuple[GroundGeometry, Attitude]:
    """A look at a plate from 0.32 m, pitch 4 deg: lit from 1.7 m on."""
    attitude = Attitude(height_m, 0.01, np.radians(4), given_m=given_m)
    range_m = np.linspace(1.5, 5.0, 351)
    return GroundGeometry(range_m, np.zeros(1), "azimuth", height_m, attitude.pitch_rad), attitude


def first_lit_m(ground: GroundGeometry, attitude: Attitude) -> float:
    margin = lit_margin(ground, attitude, FOV_DEG)
    assert margin is not None
    return float(ground.range_m[(margin[:, 0] > 0).argmax()])


def test_light_begins_where_the_steepest_rays_meet_the_ground() -> None:
    """The margin is 1 less the angle off the axis, as part of 0.9 of the half field of view."""
    ground, attitude = grazing()
    margin = lit_margin(ground, attitude, FOV_DEG)
    assert margin is not None
    off_axis_deg = np.abs(np.degrees(np.arcsin(0.32 / ground.range_m)) - 4)
    np.testing.assert_allclose(margin[:, 0], 1 - off_axis_deg / 6.3, atol=1e-9)
    assert first_lit_m(ground, attitude) == pytest.approx(0.32 / np.sin(np.radians(10.3)), abs=0.01)


def test_the_outline_lies_on_the_floor_and_not_on_the_tubes() -> None:
    """Tubes of 40 mm answer first: over them the light seems to begin 0.2 m nearer, and its outline would be matched."""
    hidden, message = first_lit_m(*grazing(height_m=0.28)), first_lit_m(*grazing(given_m=0.32, height_m=0.28))
    assert message == pytest.approx(0.32 / np.sin(np.radians(10.3)), abs=0.01)
    assert message - hidden == pytest.approx(0.04 / np.sin(np.radians(10.3)), abs=0.01)
    rock_below = first_lit_m(*grazing(given_m=0.25, height_m=0.28))
    assert rock_below == hidden, "a rock straight below tells too small a height"


def test_rocks_keep_the_outline_even_ground_and_dark_windows_do_not() -> None:
    """From 2.5 m, pitch 35 deg: 0.65 of the window 3.2 to 5.6 m is lit."""
    attitude = Attitude(2.5, 0.05, np.radians(35))
    ground = GroundGeometry(np.linspace(3.2, 5.6, 97), np.zeros(1), "azimuth", 2.5, attitude.pitch_rad)
    assert lit_margin(ground, attitude, FOV_DEG) is None
    even = Attitude(2.5, 0.05, np.radians(35), even=True)
    assert lit_margin(ground, even, FOV_DEG) is not None
    wide = GroundGeometry(np.linspace(3.2, 12.0, 97), np.zeros(1), "azimuth", 2.5, attitude.pitch_rad)
    assert lit_margin(wide, attitude, FOV_DEG) is not None
    assert lit_margin(wide, attitude, FOV_DEG, mostly=0.0) is None


# ---------------------------------------------------------------- heights by the ends of the light: closed forms of planes


@pytest.mark.parametrize("slope_deg", [0.0, 5.0, 10.0])
def test_both_ends_of_the_light_lie_on_the_plane(slope_deg: float) -> None:
    frames, near, far = lit_plane(SONAR, HEIGHT_M, PITCH_RAD, slope_deg)
    result = echo_heights(frames, PITCH_RAD, 0.0)
    assert result.first is not None
    assert result.first.height_m + result.first.tops_m == pytest.approx(near.mean(), abs=TOLERANCE_M)
    assert result.last_m == pytest.approx(far.mean(), abs=TOLERANCE_M)
    assert result.ends_m == pytest.approx((near.mean() + far.mean()) / 2, abs=TOLERANCE_M)
    if not slope_deg:
        assert result.first.even
        assert result.last_m == pytest.approx(HEIGHT_M, abs=TOLERANCE_M)


def test_contrast_lies_above_the_mean_of_the_first_echoes() -> None:
    """By half the height between that mean and the lowest tenth: a third of the beams see rocks of 0.4 m."""
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    rocks, _, _ = lit_plane(SONAR, HEIGHT_M - 0.4, PITCH_RAD)
    image = frames.image.copy()
    image[..., :32] = rocks.image[..., :32]
    result = echo_heights(replace(frames, image=image), PITCH_RAD, 0.0)
    assert result.first is not None
    assert not result.first.even
    assert result.first.tops_m == pytest.approx(TOPS * 0.4 / 3, abs=TOLERANCE_M)
    assert result.first.height_m == pytest.approx(HEIGHT_M - 0.4 / 3 - result.first.tops_m, abs=TOLERANCE_M)


def test_a_window_that_cuts_an_end_does_not_show_it() -> None:
    """The light of level ground lies between 3.3 and 4.7 m on the axis, and up to 5.6 m at the sides."""
    late = echo_heights(
        lit_plane(SONAR.replace(range_min=3.9), HEIGHT_M, PITCH_RAD)[0],
        PITCH_RAD,
        0.0,
    )
    assert late.first is None
    assert late.last_m == pytest.approx(HEIGHT_M, abs=TOLERANCE_M)
    early = echo_heights(
        lit_plane(SONAR.replace(range_max=4.5), HEIGHT_M, PITCH_RAD)[0],
        PITCH_RAD,
        0.0,
    )
    assert early.first is not None
    assert early.last_m is None
    assert early.ends_m is None


@pytest.mark.parametrize(
    ("pattern", "fov_deg", "pitch_deg", "height_m", "window_m"),
    [
        ("two_way", 14, 35, 2.5, (2, 7)),
        ("receive", 14, 35, 2.5, (3, 7)),
        ("two_way", 12, 20, 2.0, (1, 9)),
        ("two_way", 20, 20, 4.0, (3, 20)),
        ("two_way", 14, 35, 2.5, (3.2, 5.6)),
    ],
)
def test_a_skirt_of_the_light_does_not_lower_the_height(
    pattern: Literal["two_way", "receive"], fov_deg: float, pitch_deg: float, height_m: float, window_m: tuple[float, float]
) -> None:
    """The light of rays a thousandth of a degree apart, summed into bins, under the pattern of a uniform aperture."""
    sonar = Sonar(model="physical", pattern=pattern, elevation_fov_deg=fov_deg, range_bins=800)
    sonar = sonar.replace(range_min=window_m[0], range_max=window_m[1])
    half = np.radians(fov_deg / 2)
    elevation = np.radians(np.arange(-50, fov_deg, 1e-3))
    down = np.sin(np.radians(pitch_deg) - elevation)
    power = {"two_way": 4, "receive": 2}[pattern]
    gain = np.abs(np.sinc(half_power((), power) * np.sin(elevation) / np.sin(half))) ** power
    meets = down > height_m / 20
    ranges = height_m / down[meets]
    level = np.histogram(
        ranges, np.linspace(*window_m, 801), weights=(gain * down)[meets] * ranges ** (sonar.gain_exponent - 2)
    )[0]
    image = np.tile(level[:, None] / level.max(), (2, 1, sonar.beams)).astype(np.float32)
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.arange(2.0), sonar)
    result = echo_heights(frames, np.radians(pitch_deg), 0.0)
    assert result.first is not None
    at_the_middle = result.first.height_m / np.cos(sonar.bearing_rad).mean()  # the cone's beams aside go down less
    assert at_the_middle == pytest.approx(height_m, rel=0.01)
    # of a recorded sonar only the pattern over elevation is known; wrong heights are doubted, true ones are not
    recorded = replace(frames, sonar=sonar.replace(pattern="box", elevation_pattern=pattern))
    for factor in (0.5, 0.75, 1, 1.3, 2):
        attitude = attitude_of(recorded, "a test", factor * height_m, np.radians(pitch_deg))
        assert bool(attitude.doubt) == (factor != 1)


def test_shallow_rays_and_local_contrast_show_no_end() -> None:
    """The shallowest rays go down by 9 deg: far echoes are faint there, whatever the ground."""
    pitch = np.radians(16)
    window = SONAR.replace(range_max=20.0)
    assert echo_heights(lit_plane(window, HEIGHT_M, pitch)[0], pitch, 0.0).last_m is None
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    assert echo_heights(replace(frames, level="contrast"), PITCH_RAD, 0.0).first is None
