"""Frames whose beams ping one after another: drawn ground at known places, and what the estimators make of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import Array, essence
from scipy import ndimage

from mitsonar.estimation.image.ping_groups import along_path, at_one_moment, estimate_pair
from mitsonar.estimation.named import create_estimator
from mitsonar.instruments.sonar import Sonar, group_of_beams, ping_interval_s
from mitsonar.mapping.mosaic import MosaicOptions, build_mosaic
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import SonarFrames

HEIGHT, STEP_M = 2.5, 0.02
SONAR = Sonar.create(beams=96, azimuth_fov_deg=29.0, range_min=3.0, range_max=7.0, range_bins=300, bearing="cone",
                     ping_groups=8, frame_rate_hz=10.0)  # fmt: skip
GROUND = ndimage.gaussian_filter(np.random.default_rng(3).normal(size=(600, 600)), 2.5, mode="wrap")
GROUND = 0.4 + 0.1 * GROUND / GROUND.std()


def drawn(poses: Array) -> Array:
    """The brightness that each beam sees from a pose of its own ``(beams, 6)``, as an image ``(bins, beams)``."""
    r, bearing = SONAR.range_m[:, None], SONAR.bearing_rad
    starboard = r * np.sin(bearing)
    forward = np.sqrt(r**2 - HEIGHT**2 - starboard**2)
    sin, cos = np.sin(poses[:, 5]), np.cos(poses[:, 5])
    x, y = poses[:, 0] + forward * sin + starboard * cos, poses[:, 1] + forward * cos - starboard * sin
    return np.asarray(ndimage.map_coordinates(GROUND, [x / STEP_M, y / STEP_M], order=3, mode="grid-wrap"))


def pair_of(motion: Motion, *, grouped: bool) -> SonarFrames:
    """Two frames whose middles are a motion apart, 0.1 s; grouped beams ping on the way."""
    share = (group_of_beams(SONAR) - 3.5) * ping_interval_s(SONAR) / 0.1 * grouped
    images = []
    for middle in (Pose(0, 0, HEIGHT, 0.5), compose(Pose(0, 0, HEIGHT, 0.5), motion)):
        poses = [compose(middle, Motion(*(part * np.array(motion)))) for part in share]
        images.append(drawn(np.array(poses, dtype=float)))
    known = np.array([[0, 0, HEIGHT, 0.5, 0, 0]] * 2)
    time_s = np.array([0.0, 0.1])
    image = np.array(images, dtype=np.float32)
    heights = np.full(2, HEIGHT)
    return SonarFrames(image, SONAR.range_m, SONAR.bearing_rad, time_s, SONAR, poses=known, height_m=heights)


MOTIONS = {
    "forward": Motion(0.0, 0.04, 0.0),
    "sideways": Motion(0.03, 0.01, 0.0),
    "yaw": Motion(0.0, 0.0, 0.01),
    "all": Motion(-0.02, 0.04, 0.008),
}


@pytest.mark.parametrize("kind", essence(MOTIONS, "all"))
def test_frames_of_one_moment_are_those_of_a_single_ping(kind: str) -> None:
    """Places are known, so what is left is the interpolation: a third of the difference or less."""
    inner = np.s_[:, 20:-20, 6:-6]
    motion = MOTIONS[kind]
    truth, grouped = (pair_of(motion, grouped=grouped) for grouped in (False, True))
    before, after = (np.std((one.image - truth.image)[inner]) for one in (grouped, at_one_moment(grouped, motion)))
    assert after < 0.33 * before
    for changed in (replace(grouped, height_m=None), replace(grouped, image=np.rint(255 * grouped.image).astype(np.uint8))):
        assert np.std((at_one_moment(changed, motion).image - truth.image)[inner]) < 0.5 * before


def test_a_mosaic_of_grouped_frames_is_that_of_single_pings() -> None:
    """Along a curve, at 0.4 m/s; a sonar that names no groups keeps beams where they are."""
    middles = [Pose(0, 0, HEIGHT, 0.5)]
    for _ in range(7):
        middles.append(compose(middles[-1], MOTIONS["all"]))
    offsets = (group_of_beams(SONAR) - 3.5) * ping_interval_s(SONAR) / 0.1
    maps = {}
    for name, part in {"single": 0, "grouped": 1, "unknown": 1}.items():
        images = [
            drawn(np.array([compose(middle, Motion(*(part * share * np.array(MOTIONS["all"])))) for share in offsets]))
            for middle in middles
        ]
        image, poses = np.array(images, dtype=np.float32), np.array(middles)
        sonar = SONAR if name == "grouped" else SONAR.replace(ping_groups=1)
        time_s = 0.1 * np.arange(len(image), dtype=np.float64)
        frames = SonarFrames(image, SONAR.range_m, SONAR.bearing_rad, np.asarray(time_s, np.float64), sonar, poses=poses)
        maps[name] = build_mosaic(frames, height_m=HEIGHT, options=MosaicOptions(cell_m=0.02)).mean
    apart = {name: float(np.nanstd(maps[name] - maps["single"])) for name in ("grouped", "unknown")}
    assert apart["grouped"] < 0.4 * apart["unknown"]


@pytest.mark.parametrize("kind", essence(MOTIONS, "all"))
@pytest.mark.parametrize("name", essence(["direct", "flow"], "direct"))
def test_estimates_are_those_of_single_pings(kind: str, name: str) -> None:
    motion, estimator = MOTIONS[kind], create_estimator(name)
    grouped = pair_of(motion, grouped=True)
    unit = np.array([1e-3, 1e-3, 2e-4])
    raw, result = (
        np.array(estimate.motion) - np.array(motion)
        for estimate in (estimator.estimate(grouped), estimate_pair(estimator, grouped))
    )
    assert np.abs(result / unit).max() < 1
    assert np.linalg.norm(result / unit) < 0.5 * np.linalg.norm(raw / unit) + 0.2


def test_other_frames_are_estimated_once() -> None:
    single = pair_of(MOTIONS["forward"], grouped=False)
    single = replace(single, sonar=SONAR.replace(ping_groups=1))
    estimator = create_estimator("direct")
    assert estimate_pair(estimator, single).motion == estimator.estimate(single).motion


@pytest.mark.parametrize("bearing", ["cone", "azimuth"])
def test_without_motion_nothing_moves(bearing: str) -> None:
    """Nor do cells without ground: the water column, and borders of a wide fan."""
    sonar = SONAR.replace(bearing=bearing, range_min=1.0, azimuth_fov_deg=130.0)
    image = np.random.default_rng(1).random((2, 300, 96), dtype=np.float32)
    known = np.array([[0, 0, HEIGHT, 0.5, 0, 0]] * 2)
    pair = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.array([0.0, 0.1]), sonar, poses=known)
    for heights in (np.full(2, HEIGHT), np.full(2, np.nan), None):
        still = at_one_moment(replace(pair, height_m=heights), Motion(0.0, 0.0, 0.0))
        np.testing.assert_allclose(still.image, image, atol=1e-4)
    moved = at_one_moment(replace(pair, height_m=np.full(2, HEIGHT)), MOTIONS["all"])
    water = sonar.range_m < HEIGHT
    np.testing.assert_allclose(moved.image[:, water], image[:, water], atol=1e-6)


def test_the_ground_lies_by_the_pitch_of_the_mount_without_an_attitude() -> None:
    """Frames with a depth sensor have poses of that pitch, and attitudes of nan."""
    pair = replace(pair_of(MOTIONS["all"], grouped=True), height_m=None)
    marked = replace(pair, attitude_rad=np.full((2, 3), np.nan))
    one, other = (at_one_moment(each, MOTIONS["all"]).image for each in (pair, marked))
    np.testing.assert_array_equal(one, other)


def test_frames_of_equal_times_stay_where_they_are() -> None:
    """A frame that is repeated with its time has no speed, and does not scatter its beams."""
    pair = pair_of(MOTIONS["all"], grouped=True)
    image = pair.image[[0, 0, 1, 1]]
    poses = np.array(
        [Pose(0, 0, HEIGHT, 0.5), Pose(1e-4, 0, HEIGHT, 0.5), *[compose(Pose(0, 0, HEIGHT, 0.5), MOTIONS["all"])] * 2]
    )
    frames = replace(pair, image=image, time_s=np.array([0.0, 0.0, 0.1, 0.2]), poses=poses, height_m=np.full(4, HEIGHT))
    moved = along_path(frames, poses, np.full(4, HEIGHT))
    np.testing.assert_allclose(moved.image[0], image[0], atol=1e-3)


def test_frames_far_apart_in_time_are_estimated_once() -> None:
    """Pings of 75 ms do not matter over 10 s, between frames that close a loop."""
    pair = pair_of(MOTIONS["all"], grouped=True)
    far = replace(pair, time_s=np.array([0.0, 10.0]))
    estimator = create_estimator("direct")
    assert estimate_pair(estimator, far).motion == estimator.estimate(far).motion
