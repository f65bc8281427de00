"""Sounders against closed forms: ranges over planes and slopes, shadows of a block, velocities of a DVL."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsonar.acoustics.levels import first_echoes, strongest_echoes
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import Sounder, load_sounder
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.soundings import solve_velocity
from mitsonar.simulation.sounding import SounderSimulator, dvl_readings

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

HEIGHT = 4.0
"""Of the vehicle over the floor [m]."""


def floor(slope_deg: float = 0.0, **shapes: object) -> mi.Scene:
    """A large plane through the origin that rises along +y, and other shapes."""
    up = mi.ScalarTransform4f().rotate([1, 0, 0], slope_deg).scale(60)
    scene: mi.Scene = mi.load_dict(
        {"type": "scene", "floor": {"type": "rectangle", "to_world": up}, **shapes}, optimize=False
    )
    return scene


def flown(pings: int = 2, speed: float = 0.5) -> Trajectory:
    """A straight path along +y at 10 pings a second."""
    start, end = Pose(0, 0, HEIGHT), Pose(0, speed * (pings - 1) / 10, HEIGHT)
    return Trajectory.between(start, end, frames=pings, rate_hz=10)


@pytest.mark.parametrize("slope_deg", [0.0, 8.0])
def test_an_altimeter_measures_the_nearest_ground(slope_deg: float) -> None:
    """Within its cone of 25 deg the nearest point of a plane lies at height times the cosine of the slope."""
    sounder = load_sounder("altimeter").replace(model="physical", pattern="box", range_min=1, range_max=8, quality="draft")
    result = SounderSimulator(floor(slope_deg), sounder).soundings(flown(1))
    expected = HEIGHT * np.cos(np.radians(slope_deg))
    assert abs(result.range_m.item() - expected) < 1.5 * sounder.fan.bin_m


def test_an_offset_of_the_detector_is_no_echo() -> None:
    """Out of reach of the ground, a receiver shows its noise and the constant of its detector only."""
    keys = {"range_min": 1, "range_max": 3, "range_bins": 40, "quality": "draft"}
    sounder = load_sounder("altimeter").replace(detector_offset_db=100.0, **keys)
    assert not SounderSimulator(floor(), sounder).soundings(flown(1)).found.any()


def test_soundings_of_a_plane_lie_on_it() -> None:
    """Half a bin, in beams within 40 deg of straight down."""
    sounder = load_sounder("profiler").replace(model="physical", pattern="box", range_min=2, range_max=10, quality="fine")
    result = SounderSimulator(floor(), sounder).soundings(flown(1))
    steep = np.abs(sounder.fan.bearing_rad) < np.radians(40)
    assert steep.sum() > 20
    off = result.points()[0, 0, steep, 2] * np.cos(sounder.fan.bearing_rad[steep])
    assert np.abs(off).max() < sounder.fan.bin_m / 2


def test_a_block_throws_the_shadow_of_its_height() -> None:
    """A side-scan over level ground: a wall of height h at y sideways hides the floor from y to y H / (H - h)."""
    block, side = 1.0, 6.0
    wall = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([side + 0.1, 0, block / 2]).scale([0.1, 5, block / 2]),
    }
    sounder = load_sounder("sidescan").replace(model="physical", pattern="box", range_min=3, range_max=14, quality="fine")
    echogram = SounderSimulator(floor(wall=wall), sounder).echogram(flown(1))
    received, range_m = echogram.channel("starboard")[0], echogram.range_m
    far_edge = (side + 0.2) * HEIGHT / (HEIGHT - block)  # the ray over the far upper edge
    begin, end = np.hypot(side, HEIGHT), np.hypot(far_edge, HEIGHT)  # from the foot of the wall on
    dark = range_m[(received == 0) & (range_m > 6.5)]
    assert abs(dark.min() - begin) < 2 * sounder.fan.bin_m
    assert abs(dark.max() - end) < 3 * sounder.fan.bin_m
    assert (echogram.channel("port")[0][range_m > 6.5] > 0).all()


def test_the_first_return_of_a_side_scan_is_its_height() -> None:
    """Nothing is nearer than the ground that its fan reaches."""
    sounder = load_sounder("sidescan").replace(model="physical", pattern="box", range_min=1, range_max=14, quality="draft")
    echogram = SounderSimulator(floor(), sounder).echogram(flown(1))
    lowest = abs(sounder.axes[:, 2]).max()
    steepest = np.arcsin(lowest) + np.radians(sounder.fan.elevation_fov_deg / 2)
    expected = HEIGHT / np.sin(min(steepest, np.pi / 2))
    for name in ("port", "starboard"):
        first = echogram.range_m[np.flatnonzero(echogram.channel(name)[0])[0]]
        assert abs(first - expected) < 2 * sounder.fan.bin_m


def test_velocities_of_a_dvl_keep_their_noise() -> None:
    """400 pings at 0.5 m/s: nees is 1 within four standard deviations, and the mean is the velocity."""
    sounder = load_sounder("dvl").replace(model="physical", pattern="box", range_min=0.5, quality="draft", scale_std=0.0)
    soundings = SounderSimulator(floor(), sounder).soundings(flown(400))
    readings = dvl_readings(soundings, seed=4)
    assert readings.locked.all()
    off = readings.velocity - [0.0, 0.5, 0.0]
    nees = np.einsum("pi,pij,pj->p", off, np.linalg.inv(readings.covariance), off) / 3
    assert abs(nees.mean() - 1) < 4 * np.sqrt(2 / (3 * len(off)))
    std = np.sqrt(readings.covariance[0].diagonal() / len(off))
    assert (np.abs(off.mean(axis=0)) < 4 * std).all()
    assert np.abs(readings.altitude_m - HEIGHT).max() < 2 * sounder.fan.bin_m


def test_a_janus_has_the_errors_of_its_formula() -> None:
    """Four beams, t from straight down and 45 deg from ahead: std of a rate over 2 cos(45 deg) sin(t), and 2 cos(t)."""
    tilt = np.radians(22.5)
    azimuth = np.radians([45, 135, 225, 315])
    axes = np.column_stack([np.sin(tilt) * np.sin(azimuth), np.sin(tilt) * np.cos(azimuth), np.full(4, -np.cos(tilt))])
    velocity = np.array([[0.1, 0.6, -0.05]])
    result, covariance = solve_velocity(-velocity @ axes.T, axes, 0.01)
    assert np.allclose(result, velocity)
    expected = 0.01 / np.array([np.sqrt(2) * np.sin(tilt), np.sqrt(2) * np.sin(tilt), 2 * np.cos(tilt)])
    assert np.allclose(np.sqrt(covariance[0].diagonal()), expected)


def test_three_beams_suffice_and_two_do_not() -> None:
    axes = load_sounder("dvl").axes
    velocity = np.array([0.1, 0.6, -0.05])
    rates = np.tile(-axes @ velocity, (2, 1))
    rates[0, 0], rates[1, :2] = np.nan, np.nan
    result, _ = solve_velocity(rates, axes, 0.01)
    assert np.allclose(result[0], velocity)
    assert np.isnan(result[1]).all()


def test_a_dvl_out_of_reach_loses_the_bottom() -> None:
    sounder = load_sounder("dvl").replace(model="physical", pattern="box", range_min=0.1, range_max=2, quality="draft")
    readings = dvl_readings(SounderSimulator(floor(), sounder).soundings(flown(2)))
    assert not readings.locked.any()
    assert np.isnan(readings.velocity).all()


def test_a_range_image_is_that_of_a_wall() -> None:
    """A wall 5 m ahead: ranges 5 m over the cosine of the angle to its normal, within a bin."""
    upright = mi.ScalarTransform4f().translate([0, 5, HEIGHT]).rotate([1, 0, 0], 90).scale(60)
    wall = {"type": "rectangle", "to_world": upright}
    preset = load_sounder("range-image").replace(model="physical", pattern="box", rows=8, beams=32, quality="draft")
    sounder = preset.replace(range_min=2, range_max=9)
    result = SounderSimulator(floor(wall=wall), sounder).soundings(flown(1))
    points = result.points()[0]
    ahead = np.isfinite(points[..., 1])
    assert ahead.mean() > 0.9
    assert np.median(np.abs(points[ahead][:, 1] - 5)) < sounder.fan.bin_m


def test_first_and_strongest_echoes_are_finer_than_a_bin() -> None:
    """A rise and a triangle between bins."""
    range_m, noise = np.linspace(0.0, 1.9, 20, dtype=np.float64), np.zeros(20)
    levels = np.maximum(1 - np.abs(range_m - 1.03) / 0.25, 0)
    assert abs(strongest_echoes(levels, range_m, noise, below_db=20, above_noise_db=0).range_m - 1.03) < 0.01
    begin = first_echoes(levels, range_m, noise, below_db=3.0103, above_noise_db=0).range_m
    half = 0.5 * levels.max()
    assert abs(float(np.interp(begin, range_m, levels)) - half) < 1e-3
    nothing = first_echoes(np.zeros(20), range_m, noise, below_db=10, above_noise_db=10)
    assert np.isnan(nothing.range_m)


def test_faults_are_told() -> None:
    with pytest.raises(MitsonarError, match="unknown instrument key"):
        load_sounder("dvl").replace(ranges=3)
    with pytest.raises(MitsonarError, match="one beam a fan"):
        Sounder.create(kind="altimeter", mounts={"down": (0, 0, 0, 90, 0, 0)}, beams=2)
    sounder = load_sounder("altimeter").replace(model="physical", pattern="box", quality="draft")
    heights = SounderSimulator(floor(), sounder).soundings(flown(1))
    with pytest.raises(MitsonarError, match="need soundings of a DVL"):
        dvl_readings(heights)
