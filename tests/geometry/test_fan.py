"""Points as a sonar receives them: against the level ground's own geometry, and against numerical derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.geometry.fan import Views, points_at, polar_of, projection_of
from mitsonar.geometry.ground import GroundGeometry
from mitsonar.instruments.sonar import Bearing

POSE = np.array([1.2, -0.7, 2.5, np.radians(35), np.radians(4), np.radians(70)])
POINTS = np.array([[4.0, 0.2, 0.1], [4.6, -0.9, 0.4], [3.8, -0.5, 0.0]])


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_derivatives_are_those_of_the_projection(bearing: Bearing) -> None:
    projected = projection_of(POINTS, Views.of(POSE), bearing)
    step = 1e-6
    for k in range(3):
        aside = np.eye(3)[k] * step
        slope = (polar_of(POINTS + aside, Views.of(POSE), bearing) - polar_of(POINTS - aside, Views.of(POSE), bearing)) / (
            2 * step
        )
        np.testing.assert_allclose(projected.by_point[:, :, k], slope, atol=1e-7)
    for k in range(6):
        aside = np.eye(6)[k] * step
        slope = (polar_of(POINTS, Views.of(POSE + aside), bearing) - polar_of(POINTS, Views.of(POSE - aside), bearing)) / (
            2 * step
        )
        np.testing.assert_allclose(projected.by_pose[:, :, k], slope, atol=1e-6)


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_points_come_back_from_range_bearing_and_height(bearing: Bearing) -> None:
    views = Views.of(np.stack([POSE, POSE + np.array([0.1, 0.2, 0.05, 0.01, -0.02, 0.1]), POSE]))
    polar = polar_of(POINTS, views, bearing)
    np.testing.assert_allclose(points_at(polar, POINTS[:, 2], views, bearing), POINTS, atol=1e-9)
    assert np.isnan(points_at(np.array([[1.0, 0.0]]), np.zeros(1), Views.of(POSE), bearing)).all(), "too near for the ground"


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_level_ground_is_that_of_the_ground_geometry(bearing: Bearing) -> None:
    pose = np.array([0, 0, 2.5, np.radians(35), np.radians(3), 0.0])
    ranges, bearings = np.linspace(3.2, 5.6, 7), np.radians(np.linspace(-14, 14, 5))
    ground = GroundGeometry(ranges, bearings, bearing, 2.5, pose[3], pose[4])
    cells = np.stack(np.meshgrid(ranges, bearings, indexing="ij"), axis=-1).reshape(-1, 2)
    points = points_at(cells, np.zeros(len(cells)), Views.of(pose), bearing)
    np.testing.assert_allclose(points[:, :2], ground.points.reshape(-1, 2), atol=1e-9)
    np.testing.assert_allclose(polar_of(points, Views.of(pose), bearing), cells, atol=1e-9)
