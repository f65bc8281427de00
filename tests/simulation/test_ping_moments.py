"""Frames that take time against closed forms: a wall seen while the vehicle drives or turns, a tank wall that is scanned."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers import Array, diffuse, essence, plate, scene

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar, group_of_beams, scanned
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.simulator import Simulator

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

FLAT = {"elevation_fov_deg": 0.2, "bearing": "azimuth"}
BOXES = Sonar.create(
    beams=24, azimuth_fov_deg=24, range_min=3, range_max=6, range_bins=1500, quality="draft", ping_groups=8,
    group_interval_s=0.02, **FLAT,
)  # fmt: skip
PATTERN = BOXES.replace(pattern="two_way", frequency_hz=1.8e6, shading="hann")
COHERENT = PATTERN.replace(model="coherent", absorption_db_per_m=0.0, range_bins=600, elevation_fov_deg=2.0)
WALL_M, SPEED, TURN = 5.0, 2.0, 0.8
"""A beam of 1 deg meets the wall over up to 20 mm of range: with a pattern, few rays tell its middle to half of that."""


def measured(frames: SonarFrames) -> Array:
    """Range of the echo's middle in each beam [m], by level."""
    level = frames.to_linear().image[0].astype(float)
    level[level < 0.02 * level.max(axis=0)] = 0
    return np.asarray((frames.range_m[:, None] * level).sum(axis=0) / level.sum(axis=0))


def wall() -> Any:
    return scene(wall=plate((0, WALL_M, 0), (0, -1, 0), bsdf=diffuse(0.8)))


BACK, SIDES = (BOXES.replace(group_order=order) for order in ("interleaved_starboard", "sequential"))


@pytest.mark.parametrize(
    ("sonar", "tolerance"),
    essence(
        [(BOXES, 0.003), (BACK, 0.003), (SIDES, 0.003), (PATTERN, 0.012), (COHERENT, 0.02)], (BACK, 0.003), (COHERENT, 0.02)
    ),
)
def test_a_vehicle_that_drives_skews_a_wall(sonar: Sonar, tolerance: float) -> None:
    """Range of beam b: (5 m - v t) / cos b, with the time t of its group."""
    path = Trajectory.between(Pose(0, 0, 0), Pose(0, SPEED, 0), 2, 1.0)
    frames = Simulator(wall(), sonar).render(path).select(slice(0, 1))
    time = (np.arange(8)[group_of_beams(sonar)] - 3.5) * 0.02
    expected = (WALL_M - SPEED * time) / np.cos(sonar.bearing_rad)
    np.testing.assert_allclose(frames.time_s[0], time, atol=1e-12)
    assert frames.beam_poses is not None
    np.testing.assert_allclose(frames.beam_poses[0, :, 1], SPEED * time, atol=1e-12)
    np.testing.assert_allclose(measured(frames), expected, atol=tolerance)
    still = measured(Simulator(wall(), sonar.replace(ping_groups=1)).render([Pose(0, 0, 0)]))
    assert np.abs(still - expected).max() > 0.1


@pytest.mark.parametrize(("sonar", "tolerance"), [(BOXES, 0.003), (PATTERN, 0.012)])
def test_a_vehicle_that_turns_skews_a_wall(sonar: Sonar, tolerance: float) -> None:
    """Range of beam b: 5 m / cos(b + w t)."""
    path = Trajectory.between(Pose(0, 0, 0), Pose(0, 0, 0, heading=TURN), 2, 1.0)
    frames = Simulator(wall(), sonar).render(path).select(slice(0, 1))
    time = (np.arange(8)[group_of_beams(sonar)] - 3.5) * 0.02
    np.testing.assert_allclose(measured(frames), WALL_M / np.cos(sonar.bearing_rad + TURN * time), atol=tolerance)


def test_groups_that_do_not_move_are_one_ping() -> None:
    still = Simulator(wall(), BOXES).render([Pose(0, 0, 0)] * 2, gain=1.0)
    np.testing.assert_array_equal(still.image, Simulator(wall(), BOXES.replace(ping_groups=1)).render(
        [Pose(0, 0, 0)] * 2, gain=1.0).image)  # fmt: skip


ONE = Sonar.create(
    beams=1, azimuth_fov_deg=2, elevation_fov_deg=2, range_min=1, range_max=9, range_bins=1600, quality="draft",
    bearing="azimuth",
)  # fmt: skip


def tank(radius: float) -> Any:
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([0, 0, -5])
    return scene(tank={"type": "cylinder", "p0": [0, 0, 0], "p1": [0, 0, 10], "radius": radius, "to_world": place,
                       "bsdf": {"type": "twosided", "bsdf": diffuse(0.8)}})  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "tolerance"),
    essence(
        [({}, 0.006), ({"model": "coherent", "frequency_hz": 7.5e5, "bearing": "cone", "absorption_db_per_m": 0.0}, 0.03)],
        ({}, 0.006),
    ),
)
def test_a_tank_that_is_scanned_under_way(changes: dict[str, Any], tolerance: float) -> None:
    """The head at (0, v t) meets the circle of radius 5 m along its bearing b at -y cos b + sqrt(25 - y^2 sin^2 b)."""
    sonar = scanned(ONE.replace(**changes), step_deg=6.0, overhead_s=0.02)
    sweep, speed = 60 * (2 * 9 / 1500 + 0.02), 0.5
    path = Trajectory.between(Pose(0, 0, 0), Pose(0, 3 * speed, 0), 4, 1.0)
    frames = Simulator(tank(5.0), sonar).render(path)
    assert len(frames) == 1
    assert frames.time_s.shape == (1, 60)
    time = (np.arange(60) + 0.5) * sweep / 60
    np.testing.assert_allclose(frames.time_s[0], time)
    y, bearing = speed * time, sonar.bearing_rad
    expected = -y * np.cos(bearing) + np.sqrt(25 - (y * np.sin(bearing)) ** 2)
    np.testing.assert_allclose(measured(frames), expected, atol=tolerance)
    assert np.abs(expected - 5).max() > 0.5
    assert frames.beam_poses is not None
    for place, off in ((frames.beam_poses[0, :, 1], tolerance), (0.0, speed * sweep)):  # by the pose of each beam; by none
        radius = np.hypot(measured(frames) * np.sin(bearing), place + measured(frames) * np.cos(bearing))
        assert np.abs(radius - 5).max() == pytest.approx(off, abs=max(tolerance, 0.05 * off))


def test_what_has_no_groups_is_refused() -> None:
    simulator = Simulator(wall(), BOXES)
    with pytest.raises(MitsonarError, match=r"\(frames, 6\) or \(frames, 8, 6\)"):
        next(simulator.pings(np.zeros((1, 7, 6))))
    with pytest.raises(MitsonarError, match="one for each pose"):
        next(simulator.pings(np.zeros((2, 6)), time_s=[0.0]))
