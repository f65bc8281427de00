"""Paths by way of rough surfaces against closed forms (inside of a sphere) and against a sum over pairs of points."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import Array, diffuse, essence, floor, plate, scene, sphere

from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

ALL_ROUND = Sonar.create(model="physical", azimuth_fov_deg=360.0, elevation_fov_deg=180.0, beams=36, range_min=0.5,
                         range_max=8.5, range_bins=400, rays_per_beam=200, rays_across=4)  # fmt: skip
"""Sees all of a sphere around it."""


def levels(loaded: mi.Scene, sonar: Sonar, pose: Array | None = None, pings: int = 1) -> Array:
    """Mean levels ``(bins, beams)`` of some pings."""
    poses = np.tile(np.zeros(6) if pose is None else pose, (pings, 1))
    return np.asarray(sum(part.levels.sum(0, dtype=float) for part in Simulator(loaded, sonar).pings(poses)) / pings)


@pytest.mark.parametrize("mu", essence([0.05, 0.2, 1 / math.pi], 0.2))
def test_the_inside_of_a_sphere_multiplies_by_its_albedo(mu: float) -> None:
    """A Lambert ray in a sphere ends evenly over it: each reflection takes the albedo pi mu, ranges follow the chords.

    All that arrives in the beam that it left by comes with its reverse, in phase: 1 + 1 / beams.
    """
    radius = 2.0
    loaded = scene(ball=sphere((0, 0, 0), radius, diffuse(mu)))
    one, two, three = (levels(loaded, ALL_ROUND.replace(bounces=bounces)) for bounces in (1, 2, 3))
    albedo, together = math.pi * mu, 1 + 1 / ALL_ROUND.beams
    second, third = (two - one).sum(), (three - two).sum()
    assert second / one.sum() == pytest.approx(albedo * together, rel=0.01)
    assert third / one.sum() == pytest.approx(albedo**2 * together, rel=0.01)
    # a chord is shorter than c with probability c^2 / 4 a^2, and the path is a + c + a
    nearer = np.cumsum((two - one).sum(axis=1)) / second
    edge = ALL_ROUND.range_min + (np.arange(ALL_ROUND.range_bins) + 1) * ALL_ROUND.bin_m
    expected = np.clip((edge - radius) / radius, 0, 1) ** 2
    # what is heard in one beam twice has other chords: 1 part in 37
    assert np.abs(nearer - expected)[edge > radius + 0.05].max() < 0.025


def between_plates(first: tuple[Array, Array, Array], second: tuple[Array, Array, Array], mu: float) -> float:
    """The energy of all paths sonar, one plate, the other, sonar, both ways: a sum over pairs of points, sonar at 0.

    A plate is a corner and two sides.
    """
    n = 40
    step = (np.arange(n) + 0.5) / n
    places, normals, areas = [], [], []
    for corner, one, another in (first, second):
        grid = corner + step[:, None, None] * one + step[None, :, None] * another
        cross = np.cross(one, another)
        places.append(grid.reshape(-1, 3))
        normals.append(cross / np.linalg.norm(cross))
        areas.append(np.linalg.norm(cross) / n**2)
    ranges = [np.linalg.norm(place, axis=1) for place in places]
    straight = [np.abs(place @ n) / r**3 for place, n, r in zip(places, normals, ranges, strict=True)]  # cos / R^2
    way = places[1][None] - places[0][:, None]
    apart = np.linalg.norm(way, axis=2)
    exchanged = np.abs(way @ normals[0]) * np.abs(way @ normals[1]) / apart**4
    return float(2 * mu**2 * areas[0] * areas[1] * np.einsum("i,ij,j", straight[0], exchanged, straight[1]))


def test_two_plates_exchange_what_a_sum_over_pairs_says() -> None:
    """One beam that sees both: a path and its reverse arrive in phase, twice the energy. 2 %."""
    mu, half = 0.2, 0.5
    loaded = scene(
        low=plate((0, 4, -1), (0, 0, 1), half, diffuse(mu)), back=plate((0, 5.2, 0), (0, -1, 0), half, diffuse(mu))
    )
    low = np.array([-half, 4 - half, -1]), np.array([2 * half, 0, 0]), np.array([0, 2 * half, 0])
    back = np.array([-half, 5.2, -half]), np.array([2 * half, 0, 0]), np.array([0, 0, 2 * half])
    sonar = Sonar.create(model="physical", azimuth_fov_deg=40.0, elevation_fov_deg=60.0, beams=1, range_min=2.0,
                         range_max=8.0, range_bins=200, rays_per_beam=300, rays_across=200)  # fmt: skip
    one, two = (levels(loaded, sonar.replace(bounces=bounces), pings=6).sum() for bounces in (1, 2))
    # two normals apart: a plate's own points see no other of it
    assert two - one == pytest.approx(2 * between_plates(low, back, mu), rel=0.02)


def test_a_plane_alone_sends_back_no_more() -> None:
    """Nothing reflects twice over an open plane: the same bits, in both models."""
    loaded = scene(ground=floor(diffuse(0.3)))
    pose = np.array([0, 0, 2.5, math.radians(35), 0, 0])
    for model in ("physical", "coherent"):
        sonar = Sonar.create(model=model, frequency_hz=1.8e6, beams=24, azimuth_fov_deg=14.5, range_min=3.5, range_max=5.0,
                             range_bins=64)  # fmt: skip
        images = [next(iter(Simulator(loaded, sonar.replace(bounces=n)).pings(pose))) for n in (1, 3)]
        np.testing.assert_array_equal(images[0].levels, images[1].levels)
        np.testing.assert_array_equal(images[0].counts.inside, images[1].counts.inside)


def test_threads_and_batches_do_not_change_bits() -> None:
    import drjit as dr

    loaded = scene(ball=sphere((0, 0, 0), 2.0, diffuse(0.2)))
    sonar = ALL_ROUND.replace(bounces=3, rays_per_beam=50)
    poses = np.zeros((3, 6))
    before, result = dr.thread_count(), []
    try:
        for count, rays in ((1, 2**23), (3, 2**23), (2, sonar.rays)):
            dr.set_thread_count(count)
            parts = Simulator(loaded, sonar, rays_per_launch=rays).pings(poses)
            result.append(np.concatenate([part.levels for part in parts]))
    finally:
        dr.set_thread_count(before)
    np.testing.assert_array_equal(result[0], result[1])
    np.testing.assert_array_equal(result[0], result[2])
    assert (result[0][0] != result[0][1]).any()  # each ping draws its own directions
