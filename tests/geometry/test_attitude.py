"""The height over the visible surface: by first echoes, as told, and over ground that rises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn_frames import SONAR as FLOOR_SONAR
from drawn_frames import over_ground
from helpers import lit_plane

from mitsonar.estimation.named import create_estimator
from mitsonar.geometry.ground import STD_GIVEN, STD_MEASURED, UNKNOWN_MOST, UNKNOWN_PER_S, GroundGeometry, attitude_of
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.motion.trajectory import Trajectory

HEIGHT_M, PITCH_RAD = 2.2, np.radians(35)
SONAR = Sonar(range_min=2.0, range_max=7.0, range_bins=800)
TOLERANCE_M = 0.02
STD_BOTH = STD_GIVEN * STD_MEASURED / np.hypot(STD_GIVEN, STD_MEASURED)


def weighed(first_m: float) -> float:
    """The height by first echoes and the given one, each by its own standard deviation."""
    weights = 1 / np.array([STD_MEASURED * first_m, STD_GIVEN * HEIGHT_M]) ** 2
    return float(weights @ [first_m, HEIGHT_M] / weights.sum())


def test_level_ground_has_the_height_of_the_first_echoes() -> None:
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    found = attitude_of(frames, "a test", None, None)
    assert found.height_m == pytest.approx(HEIGHT_M, abs=TOLERANCE_M)
    assert found.first is not None
    assert found.height_m == pytest.approx(weighed(found.first.height_m))
    assert found.height_std_m == pytest.approx(STD_BOTH * HEIGHT_M, rel=0.01)
    assert abs(found.tops_m) < TOLERANCE_M
    assert found.even
    assert not found.reason


def test_rising_ground_has_the_mean_height_of_both_ends() -> None:
    """10 deg: the light ends 0.2 m higher than it begins; the height may be any between both, a uniform distribution."""
    frames, near, far = lit_plane(SONAR, HEIGHT_M, PITCH_RAD, 10.0)
    found = attitude_of(replace(frames, height_m=None), "a test", None, None)
    apart = near.mean() - far.mean()
    assert found.first is not None
    assert found.first.height_m == pytest.approx(near.mean(), abs=TOLERANCE_M)
    assert found.height_m == pytest.approx((near.mean() + far.mean()) / 2, abs=TOLERANCE_M)
    assert found.height_std_m == pytest.approx(np.hypot(STD_MEASURED * found.height_m, apart / np.sqrt(12)), rel=0.12)
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
    found = attitude_of(replace(frames, image=image), "a test", None, None)
    assert not found.even
    assert found.height_std_m == pytest.approx(STD_BOTH * found.height_m, rel=0.02)


def test_ground_that_falls_is_taken_for_level() -> None:
    """Its light ends beyond most windows: only the first echoes count."""
    frames, near, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD, -5.0)
    found = attitude_of(frames, "a test", None, None)
    assert found.height_m == pytest.approx(weighed(near.mean() - found.tops_m), abs=TOLERANCE_M)
    assert found.height_std_m == pytest.approx(STD_BOTH * found.height_m, rel=0.02)


def test_a_given_height_is_not_overruled() -> None:
    """First echoes that contradict it by more than both know are reported, and do not count."""
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    found = attitude_of(replace(frames, height_m=np.full(2, 3.2)), "a test", None, None)
    assert found.height_m == 3.2
    assert found.height_std_m == pytest.approx(np.hypot(STD_GIVEN * 3.2, 3.2 - HEIGHT_M), rel=0.02)
    assert not found.reason
    assert found.doubt == "first echoes give a height of 2.19 m, not 3.20 m"
    near = attitude_of(replace(frames, height_m=np.full(2, 2.4)), "a test", None, None)
    assert not near.doubt
    assert HEIGHT_M < near.height_m < 2.25


def test_each_frame_has_its_own_height_pitch_and_roll() -> None:
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    assert attitude_of(frames, "a test", None, None).apart == ()
    poses = np.array([[0, 0, 2.0, 0.60, 0.02, 0], [0, 0, 2.02, 0.62, -0.02, 0]])
    found = attitude_of(replace(frames, poses=poses), "a test", None, None)
    mean = np.array([found.height_m, found.pitch_rad, found.roll_rad])
    np.testing.assert_allclose(
        np.array([found.of_frame(k) for k in range(2)]) - mean, poses[:, 2:5] - poses[:, 2:5].mean(axis=0)
    )
    assert found.ground(frames, 1).pitch_rad == pytest.approx(0.62)
    assert found.ground(frames).pitch_rad == pytest.approx(0.61)


@pytest.mark.parametrize(("given_m", "told"), [(2500.0, True), (0.5, True), (HEIGHT_M, False), (None, False)])
def test_a_height_beyond_both_ends_of_rising_ground_is_told(given_m: float | None, told: bool) -> None:
    """A height in millimetres, say: the ends of the light count, and the contradiction is reported."""
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD, 10.0)
    found = attitude_of(frames, "a test", given_m, PITCH_RAD)
    assert ("the ground rises" in found.doubt) == told
    assert found.height_m == pytest.approx(attitude_of(frames, "a test", None, PITCH_RAD).height_m)


@pytest.mark.parametrize(("axis", "change"), [(2, 0.006), (3, np.radians(0.4)), (4, np.radians(0.4))])
def test_unknown_heave_pitch_and_roll_widen_by_what_they_look_like(axis: int, change: float) -> None:
    """Frames that heave, pitch or roll, registered as if they did not: the error is the one that the covariance expects.

    :meth:`GroundGeometry.motions_of_lean` tells that of heave and pitch; sideways and yaw share that of a roll as frames'
    contrast decides. Pitch hardly shows, since it leaves ranges as they are, nor a roll where bearings are azimuths.
    """
    poses = np.tile([0.0, 0.0, 2.5, np.radians(35), 0.0, 0.0], (2, 1))
    poses[1, axis] += change
    sonar = load_sonar("didson300").replace(model="physical") if axis == 4 else FLOOR_SONAR
    frames = over_ground(Trajectory(poses, np.array([0.0, 0.1])), sonar)
    estimator = create_estimator("direct")
    known = estimator.estimate(frames)
    blind = poses.mean(axis=0, keepdims=True).repeat(2, axis=0)
    blind[:, 2] = np.nan
    unknown = estimator.estimate(replace(frames, poses=blind))
    assert known.covariance is not None
    assert unknown.covariance is not None
    error = np.array(unknown.motion) - np.array(known.motion)
    if axis != 4:
        attitude = attitude_of(replace(frames, poses=blind), "a test", None, None)
        seen = (
            attitude.ground(frames).motions_of_lean(12, np.radians(frames.sonar.elevation_fov_deg) / 2)[:, axis - 2] * change
        )
        np.testing.assert_allclose(error, seen, atol=0.25 * np.abs(seen).max() + 2e-4)
    assert error @ np.linalg.solve(unknown.covariance, error) < 2
    if axis != 3:
        assert error @ np.linalg.solve(known.covariance, error) > 5


def test_heave_looks_like_a_step_along_the_grazing_ray() -> None:
    """Of a single range and a single beam, in closed form: d forward = -h / x d height."""
    narrow = GroundGeometry(np.array([4.0, 4.001]), np.array([-1e-6, 1e-6]), "azimuth", 2.4, np.radians(35))
    seen = narrow.motions_of_lean(2, np.radians(7))
    assert seen[1, 0] == pytest.approx(-2.4 / 3.2, rel=1e-3)


def test_what_is_known_does_not_widen() -> None:
    frames, _, _ = lit_plane(SONAR, HEIGHT_M, PITCH_RAD)
    frames = replace(frames, time_s=np.array([0.0, 0.1]))
    poses = np.tile([0.0, 0.0, HEIGHT_M, PITCH_RAD, 0.0, 0.0], (2, 1))
    told = poses * [0, 0, np.nan, 1, 1, 0]
    by_sensors = told + np.array([[0, 0, 0, 0, 0, 0], [0, 0, 0, 0.001, 0, 0]])
    heave, pitch, roll = (0.1 * rate for rate in UNKNOWN_PER_S)
    for table, unsure in ((poses, (0, 0, 0)), (by_sensors, (heave, 0, 0)), (told, (heave, pitch, roll))):
        found = attitude_of(replace(frames, poses=table), "a test", None, None)
        assert found.unsure == pytest.approx(unsure)
    slow = attitude_of(replace(frames, poses=told, time_s=np.array([0.0, 9.0])), "a test", None, None)
    assert slow.unsure == UNKNOWN_MOST
