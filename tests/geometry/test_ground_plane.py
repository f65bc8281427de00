"""Scan conversion: metres where they belong, nothing outside the fan."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.geometry.fan import cartesian_map, to_cartesian
from mitsonar.geometry.ground import GroundGeometry, attitude_of, moved
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.records.frames import SonarFrames


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
    with pytest.raises(MitsonarError, match="rise"):
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
        wanted = to_cartesian(images[one, 1], sonar.range_m, sonar.bearing_rad, rows=50)
        np.testing.assert_allclose(fans[one, 1], np.nan_to_num(wanted.image), atol=1e-6)
        assert wanted.extent == conversion.extent


# ---------------------------------------------------------------- ground

TILTS = [(35.0, 0.0), (20.0, 5.0), (50.0, -8.0)]


def over_ground(bearing: str, tilt: tuple[float, float]) -> GroundGeometry:
    pitch, roll = np.radians(tilt)
    return GroundGeometry(np.linspace(3.3, 5.5, 12), np.radians(np.linspace(-14, 14, 9)), bearing, 2.5, pitch, roll)  # type: ignore[arg-type]


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
@pytest.mark.parametrize("tilt", TILTS)
def test_cells_are_seen_where_they_lie(bearing: str, tilt: tuple[float, float]) -> None:
    """There and back; and the point is on the ground, by the sonar's rotation of motion.py."""
    ground = over_ground(bearing, tilt)
    radius, b = ground.to_polar(ground.points)
    np.testing.assert_allclose(radius, np.broadcast_to(ground.range_m[:, None], radius.shape), rtol=1e-12)
    np.testing.assert_allclose(b, np.broadcast_to(ground.bearing_rad, b.shape), atol=1e-12)
    pitch, roll = np.radians(tilt)
    pose = Pose(0, 0, 2.5, pitch, roll, 0.0)
    level = np.concatenate([ground.points, np.full((*radius.shape, 1), -2.5)], axis=-1).reshape(-1, 3)
    s, f, _ = vehicle_rotation(pose).inv().apply(level).T
    wanted = np.arctan2(s, f) if bearing == "azimuth" else np.arcsin(s / np.linalg.norm(level, axis=1))
    np.testing.assert_allclose(b.ravel(), wanted, atol=1e-12)


def test_axis_beam_over_a_level_floor() -> None:
    ground = GroundGeometry(np.array([2.0, 4.0]), np.array([0.0]), "azimuth", 2.5, np.radians(35))
    np.testing.assert_allclose(ground.points[1, 0], [0, np.sqrt(4.0**2 - 2.5**2)], atol=1e-12)
    assert np.isnan(ground.points[0]).all()


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_a_point_moves_as_poses_do(bearing: str) -> None:
    """A fixed point of the world, seen from two poses of motion.py (eq. 3.4)."""
    ground = over_ground(bearing, (35.0, 0.0))
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
    ground = over_ground(bearing, tilt)
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
    told = attitude_of(frames, "a test", None, None)
    assert np.degrees([told.pitch_rad, told.roll_rad]) == pytest.approx([31, 3])
