"""First returns and ground ranges of side-scans: against drawn ground, rendered ground, and a real altimeter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from drawn_side_scans import SOUNDER, drawn, line

import mitsonar
from mitsonar.errors import MitsonarError
from mitsonar.geometry.side_scan import ground_lines, to_ground_range, track_bottom
from mitsonar.instruments.sounder import load_sounder
from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.sounding import SounderSimulator

REAL = Path(__file__).resolve().parents[2].parent / "shared/data/real/opensidescan-iver2-xtf/scotsman-iver2.xtf"
BIN_M = 25.0 / 500


def bright(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.full_like(x, 0.1)


# ---------------------------------------------------------------- bottom


@pytest.mark.thorough
@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.35, 0.0), (-0.2, 0.1)])
def test_the_first_return_is_the_distance_to_the_ground_in_the_plane_of_the_beams(pitch: float, roll: float) -> None:
    """Heights from 3 to 9 m, within a bin."""
    poses = line(80, pitch=pitch, roll=roll)
    poses[:, 2] = 6 + 3 * np.sin(np.linspace(0, 6, 80))
    track = track_bottom(drawn(poses, bright))
    assert np.abs(track.range_m - poses[:, 2] / np.cos(pitch)).max() <= BIN_M
    assert np.abs(track.height_m - poses[:, 2]).max() <= BIN_M
    assert track.contrast.min() > 0.9


@pytest.mark.thorough
def test_speckle_and_noise_move_the_track_by_a_few_bins_at_most() -> None:
    """Exponential speckle, and water 17 dB below the bottom."""
    poses = line(200)
    poses[:, 2] = 6 + 2 * np.sin(np.linspace(0, 9, 200))
    track = track_bottom(drawn(poses, bright, water=2e-3, rng=np.random.default_rng(0)))
    error = track.range_m - poses[:, 2]
    assert np.sqrt(np.mean(error**2)) < 2 * BIN_M
    assert np.abs(error).max() < 6 * BIN_M


def test_what_swims_in_the_water_column_does_not_end_it() -> None:
    """A bright target of 3 pings and 6 bins above the bottom on one side, dead pings, and the transmitted pulse."""
    poses = line(60)
    echogram = drawn(poses, bright, rng=np.random.default_rng(1))
    levels = echogram.levels.copy()
    levels[20:23, 1, 70:76] = 0.5
    levels[40:43] = 1e-5
    levels[:, :, :4] = 1.0
    error = track_bottom(replace(echogram, levels=levels)).range_m - 6
    assert np.abs(error).max() < 4 * BIN_M


def test_ground_that_ends_is_no_second_water_column() -> None:
    """Beyond 12 m there is nothing, for three quarters of the window: the edge of a scene, or the reach of a weak sonar."""
    echogram = drawn(line(40), bright, sounder=SOUNDER.replace(range_max=50.0, range_bins=1000))
    levels = echogram.levels.copy()
    levels[:, :, 240:] = 1e-7
    assert np.abs(track_bottom(replace(echogram, levels=levels)).range_m - 6).max() <= BIN_M


def test_a_surface_echo_is_passed_by_its_range() -> None:
    echogram = drawn(line(40), bright)
    levels = echogram.levels.copy()
    levels[:, :, 40:60] = 0.1
    wide = replace(echogram, levels=levels)
    assert np.abs(track_bottom(wide, least_m=3.2).range_m - 6).max() <= BIN_M


def test_without_a_water_column_there_is_no_track() -> None:
    echogram = drawn(line(40), bright)
    rng = np.random.default_rng(5)
    noise = rng.exponential(size=echogram.levels.shape).astype(np.float32)
    for levels in (noise, np.zeros_like(noise), np.ones_like(noise)):
        with pytest.raises(MitsonarError, match="no water column ends in a bottom"):
            track_bottom(replace(echogram, levels=levels))
    with pytest.raises(MitsonarError, match="within the window"):
        track_bottom(echogram, least_m=30)
    with pytest.raises(MitsonarError, match="bins or more"):
        track_bottom(echogram, least_m=24.9)


@pytest.mark.usefixtures("variant")
@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
def test_the_first_return_of_a_rendered_side_scan_is_its_height() -> None:
    """A fan that reaches straight down, over a plane, from 3 to 5 m."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(60)}
    scene: mi.Scene = mi.load_dict({"type": "scene", "floor": floor}, optimize=False)
    sounder = load_sounder("sidescan").replace(
        model="physical", pattern="box", range_min=0, range_max=12, range_bins=240, quality="draft", elevation_fov_deg=130
    )
    path = Trajectory.between(Pose(0, 0, 3), Pose(0, 2, 5), frames=24, rate_hz=10)
    echogram = SounderSimulator(scene, sounder).echogram(path)
    track = track_bottom(echogram)
    np.testing.assert_allclose(echogram.height_m, path.poses[:, 2], atol=1e-3)
    assert np.abs(track.height_m - echogram.height_m).max() < 2 * 12 / 240


@pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of ../shared/data/real")
def test_the_first_return_of_a_real_file_follows_its_altimeter() -> None:
    """An altimeter of a vehicle that dives by 20 deg, over a bottom with relief: within 0.3 m, but for its mean."""
    echogram = mitsonar.open_side_scan(REAL).part().read()
    track = track_bottom(echogram)
    difference = (track.height_m - echogram.height_m)[1:]
    assert np.corrcoef(track.height_m[1:], echogram.height_m[1:])[0, 1] > 0.995
    assert 0.3 < np.median(difference) < 0.8
    assert difference.std() < 0.3
    assert np.abs(np.diff(track.range_m)).max() < 0.2
    assert np.median(track.contrast) > 0.8


# ---------------------------------------------------------------- ground range


@pytest.mark.parametrize("roll", [0.0, 0.15])
def test_a_stripe_on_the_ground_stays_where_it_is(roll: float) -> None:
    """Straight stripes along the track, from a height that changes: they bend over slant range, not over ground range."""
    poses = line(60, roll=roll)
    poses[:, 2] = np.linspace(3, 9, 60)

    def stripes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.05 + np.exp(-(((x - 40 - 12) / 0.3) ** 2)) + np.exp(-(((x - 40 + 7) / 0.3) ** 2))

    echogram = drawn(poses, stripes)
    scan = to_ground_range(echogram, poses[:, 2])
    starboard, port = scan.across_m > 9, (scan.across_m < -4) & (scan.across_m > -10)
    for columns, place in ((starboard, 12.0), (port, -7.0)):
        peak = scan.across_m[columns][np.nanargmax(scan.levels[:, columns], axis=1)]
        assert np.abs(peak - place).max() < 0.1
    slant = echogram.range_m[np.argmax(echogram.channel("starboard"), axis=1)]
    assert np.ptp(slant) > 2


def test_ground_range_leaves_out_what_lies_beyond_the_window() -> None:
    poses = line(10)
    poses[:, 2] = np.linspace(4, 24, 10)
    scan = to_ground_range(drawn(poses, bright), poses[:, 2])
    reach = np.sqrt(25**2 - poses[:, 2] ** 2)
    for row, far in zip(scan.levels, reach, strict=True):
        known = np.abs(scan.across_m[np.isfinite(row)])
        assert far - 0.15 < known.max() <= far
        np.testing.assert_allclose(row[np.isfinite(row) & (np.abs(scan.across_m) > 2)], 0.1, rtol=1e-5)
    assert len(to_ground_range(drawn(poses, bright), 5.0, columns=64).across_m) == 64


def test_lines_across_the_track_are_those_of_rays() -> None:
    """Random attitudes: rays in the plane of the beams hit the ground on the line, and none nearer than its foot."""
    rng = np.random.default_rng(7)
    poses = np.column_stack(
        [rng.uniform(-9, 9, (40, 2)), rng.uniform(2, 9, 40), rng.uniform(-0.4, 0.4, (40, 2)), rng.uniform(-4, 4, 40)]
    )
    lines = ground_lines(poses, poses[:, 2])
    for pose, nearest, foot, starboard in zip(poses, lines.nearest_m, lines.foot, lines.starboard, strict=True):
        axes = vehicle_rotation(pose[None]).as_matrix()[0]
        angle = np.linspace(0, 2 * np.pi, 7201)
        ray = np.cos(angle)[:, None] * axes[:, 0] + np.sin(angle)[:, None] * axes[:, 2]
        ray = ray[ray[:, 2] < -0.05]
        distance = -pose[2] / ray[:, 2]
        point = pose[:2] + distance[:, None] * ray[:, :2]
        assert distance.min() == pytest.approx(nearest, rel=1e-5)
        off = point - foot
        assert np.abs(off @ [starboard[1], -starboard[0]]).max() < 1e-9
        np.testing.assert_allclose(np.abs(off @ starboard), np.sqrt(np.maximum(distance**2 - nearest**2, 0)), atol=1e-6)


def test_heights_and_attitudes_are_checked() -> None:
    poses = line(3)
    for height in (0.0, [1.0, 2.0], [1.0, np.nan, 2.0], -3.0):
        with pytest.raises(MitsonarError, match="must be one number above 0"):
            ground_lines(poses, height)
    with pytest.raises(MitsonarError, match="straight up or down"):
        ground_lines(line(3, pitch=np.pi / 2), 5.0)
    with pytest.raises(MitsonarError, match="nowhere within the window of 25 m"):
        to_ground_range(drawn(poses, bright, sounder=SOUNDER), 26.0)
