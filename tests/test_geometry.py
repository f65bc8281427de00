"""Scan conversion: metres where they belong, nothing outside the fan."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.geometry import cartesian_map, to_cartesian
from mitsonar.sonar import Sonar


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
