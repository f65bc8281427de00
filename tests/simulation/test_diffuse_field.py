"""Paths by way of rough surfaces in coherent pings: the mean of their levels is that of the model physical."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import diffuse, essence, floor, plate, scene

from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

SONAR = Sonar.create(model="coherent", beams=48, azimuth_fov_deg=28.8, elevation_fov_deg=60.0, range_min=3.0, range_max=9.0,
                     range_bins=300, bearing="cone", frequency_hz=9e5, absorption_db_per_m=0.0, elevation_pattern="box",
                     scatterers_per_cell=1.0)  # fmt: skip
POSE = np.array([0, 0, 2.0, math.radians(20), 0, 0])


@pytest.fixture(scope="module")
def basin(variant: str) -> mi.Scene:
    return scene(ground=floor(diffuse(0.2)), wall=plate([0, 6, 0], [0, -1, 0], half=3, bsdf=diffuse(0.2)))


@pytest.mark.parametrize(("pattern", "bounces"), essence([("two_way", 2), ("two_way", 3), ("receive", 3)], ("receive", 3)))
@pytest.mark.thorough
def test_the_mean_is_that_of_the_model_physical(basin: mi.Scene, pattern: str, bounces: int) -> None:
    """Sums over all beams in six parts of the range: 12 % each, 4 % of all."""
    from mitsonar.simulation.models.coherent import CoherentImager

    sonar = SONAR.replace(pattern=pattern, bounces=bounces)
    expected = sonar.replace(model="physical", coding="linear")
    means = []
    for count in (bounces, 1):
        result = Simulator(basin, expected.replace(bounces=count)).pings(np.tile(POSE, (12, 1)))
        means.append(sum(part.levels.sum(axis=0, dtype=float) for part in result) / 12)
    target = (means[0] - means[1]).sum(axis=1)
    got = np.zeros(sonar.range_bins)
    for seed in range(3):
        diffuse_part = CoherentImager(basin, sonar.replace(seed=seed)).diffuse
        assert diffuse_part is not None
        field = np.zeros((diffuse_part.former.ranges, diffuse_part.former.sines), np.complex64)
        diffuse_part.add(POSE, field)
        got += (np.abs(diffuse_part.former.beams(field)) ** 2).sum(axis=1) / 3
    assert got.sum() == pytest.approx(target.sum(), rel=0.04)
    parts = np.array_split(np.flatnonzero((sonar.range_m > 6.3) & (sonar.range_m < 7.4)), 4)
    for part in parts:
        assert got[part].sum() == pytest.approx(target[part].sum(), rel=0.12)


def test_a_sonar_at_rest_sees_the_same_grain(basin: mi.Scene) -> None:
    import drjit as dr

    simulator = Simulator(basin, SONAR.replace(bounces=3))
    before, result = dr.thread_count(), []
    try:
        for count in (1, 3):
            dr.set_thread_count(count)
            result += [part.levels for part in simulator.pings(np.tile(POSE, (2, 1)))]
    finally:
        dr.set_thread_count(before)
    for levels in result[1:]:
        np.testing.assert_array_equal(levels, result[0])
