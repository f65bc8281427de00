"""Points of the lattice on whole shapes, and that images and impulse responses have the same ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from channel_scenes import CELLS, received_from, scatterers_of, simulator
from helpers import box, diffuse, essence, floor, plate, scene, sphere
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose, to_world_matrices

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.points import SurfacePoints

pytestmark = pytest.mark.usefixtures("variant")

PITCH = 0.02

SONAR = Sonar(
    beams=16,
    azimuth_fov_deg=24.0,
    elevation_fov_deg=14.0,
    range_min=2.0,
    range_max=7.0,
    range_bins=100,
    frequency_hz=80e3,
    pulse_m=0.1,
    pattern="receive",
    absorption_db_per_m=0.0,
    scatterers_per_cell=4,
    model="coherent",
    scatterer_spacing_m=PITCH,
    sound_speed=1500.0,
)
POSE = Pose(0.3, -0.2, 2.0, pitch=np.radians(30), heading=np.radians(20))


def points_of(shape: mi.Shape, number: int = 0, seed: int = 0) -> SurfacePoints:
    from mitsonar.simulation.points import lattice_points

    return lattice_points(shape, number, PITCH, seed)


def found(body: dict[str, Any], number: int = 0, seed: int = 0) -> SurfacePoints:
    return points_of(scene(body=body).shapes()[0], number, seed)


@pytest.mark.parametrize("name", essence(["plate", "box", "sphere"], "plate", "box"))
def test_each_cell_has_one_point_on_the_surface(name: str) -> None:
    """Their areas pitch^2 / |n_a| add up to the shape's; without zeta the error is that of cells at the edges alone."""
    bodies = {
        "plate": (plate((0.3, 0.2, 1), (0.3, 0.2, 0.9), 1.0), 4.0),
        "box": (box((0.1, 0.2, 0.3), (0.5, 0.6, 0.7)), 8 * (0.5 * 0.6 + 0.5 * 0.7 + 0.6 * 0.7)),
        "sphere": (sphere((0, 0, 0), 0.8), 4 * np.pi * 0.64),
    }
    body, area = bodies[name]
    result = found(body)
    side = PITCH**2 / np.abs(result.normal).max(axis=1)
    assert side.sum() == pytest.approx(area, rel=0.01)
    assert np.linalg.norm(result.normal, axis=1) == pytest.approx(np.ones(len(side)), abs=1e-5)
    axis = np.abs(result.normal).argmax(axis=1)
    for k in range(3):
        for sign in (-1, 1):
            here = (axis == k) & (np.sign(np.take_along_axis(result.normal, axis[:, None], 1)[:, 0]) == sign)
            cell = np.floor(np.delete(result.place[here], k, axis=1).astype(float) / PITCH + 1e-6).astype(int)
            assert len(np.unique(cell, axis=0)) == len(cell)
    if name == "sphere":
        assert np.linalg.norm(result.place, axis=1) == pytest.approx(np.full(len(side), 0.8), abs=1e-5)


@pytest.mark.thorough
def test_points_follow_from_seed_and_shape() -> None:
    one, again = found(sphere((0, 0, 0), 0.3)), found(sphere((0, 0, 0), 0.3))
    assert all(np.array_equal(a, b) for a, b in zip(one, again, strict=True))
    for second in (found(sphere((0, 0, 0), 0.3), seed=1), found(sphere((0, 0, 0), 0.3), number=1)):
        assert len(set(second.phase) & set(one.phase)) < 10  # of numbers of 24 bits, a few are equal by chance


@pytest.mark.parametrize("seed", [2**32, 5 * 2**40])
def test_points_follow_from_all_bits_of_a_seed(seed: int) -> None:
    body = plate((0, 0, 0), (0, 0, 1), 0.5)
    one, second = found(body), found(body, seed=seed)
    assert len(set(second.phase) & set(one.phase)) < 10


def test_the_back_of_a_body_behind_its_front_is_found() -> None:
    """Rays go on behind what they hit. Mitsuba makes one shape of both sheets."""
    (both,) = scene(low=plate((0, 0, 0), (0, 0, 1), 1.0), high=plate((0, 0, 0.3), (0, 0, 1), 1.0)).shapes()
    result, one = points_of(both), found(plate((0, 0, 0), (0, 0, 1), 1.0))
    height = np.round(result.place[:, 2], 4)
    assert set(height) == {np.float32(0), np.float32(0.3)}
    for low in (0, 0.3):
        here = np.isclose(height, low)
        assert np.array_equal(np.sort(result.phase[here]), np.sort(one.phase))


def spread_over_grid(points: SurfacePoints, tracer: Any) -> NDArray[np.complex128]:
    """The field of points that all lie in sight, written from the equations: waves, and shares of six nodes."""
    former, sonar, fan = tracer.former, tracer.sonar, tracer.fan
    matrix = to_world_matrices(POSE)[0]
    way = points.place.astype(float) - matrix[:3, 3]
    range_m = np.linalg.norm(way, axis=1)
    starboard, up, forward = (way @ matrix[:3, :3]).T * np.array([[-1], [1], [1]])
    level = np.hypot(starboard, forward)
    sine, tangent = starboard / level, up / level
    cosine = np.abs((points.normal * way).sum(axis=1)) / range_m
    import mitsuba as mi

    from mitsonar.simulation.beams import elevation_gain, kernel_weights

    gain = np.array(elevation_gain(sonar, mi.Float(tangent.astype(np.float32))), dtype=float)
    size = np.sqrt(points.strength.astype(float)) * cosine / range_m**2 * gain
    wave = size * np.exp(1j * (points.phase.astype(float) - 4 * np.pi * range_m / tracer.wavelength))
    seen = (np.abs(sine) < fan.sine) & (np.abs(tangent) < fan.tangent) & (forward > 0)
    x, y = (sine - former.first_sine) / former.sine_step, (range_m - former.first_range) / former.range_step
    seen &= (x >= 0) & (x < former.sines - 1) & (y >= 0.5) & (y < former.ranges - 1.5)
    total = np.zeros((former.ranges, former.sines), complex)
    i, j = np.floor(x[seen]).astype(int), np.rint(y[seen]).astype(int)
    for k, share in enumerate((i + 1 - x[seen], x[seen] - i)):
        for m, over_range in zip((-1, 0, 1), kernel_weights(y[seen] - j), strict=True):
            np.add.at(total, (j + m, i + k), share * over_range * wave[seen])
    return total


@pytest.mark.thorough
@pytest.mark.parametrize("scenery", essence(["floor", "corner", "patches"], "corner"))
def test_images_and_impulse_responses_have_one_field(scenery: str) -> None:
    """The points that a channel sonar stores, summed here in NumPy, give the field that the imaging sonar's rays find."""
    from mitsonar.simulation.channel import ChannelSimulator
    from mitsonar.simulation.points import SurfacePoints
    from mitsonar.simulation.simulator import Simulator

    shapes = {"floor": {"floor": floor(diffuse(0.4), 8.0)}}
    shapes["corner"] = {"ground": shapes["floor"]["floor"], "wall": plate((1, 5.5, 0), (-0.2, -1, 0.1), 6.0, diffuse(0.3))}
    shapes["patches"] = shapes["floor"]
    result = scene(**shapes[scenery])
    texture: dict[str, Any] = {"speckle_nu": 0.7, "speckle_patch_m": 0.3} if scenery == "patches" else {}
    channel = ChannelSonar(scatterer_spacing_m=PITCH, receivers=(received_from(),), **texture)
    stored = scatterers_of(ChannelSimulator(result, channel))
    points = SurfacePoints(stored.place, stored.normal, stored.strength, stored.phase)
    if scenery == "corner":  # of what hides what, each point before the wall's plane and above the ground is in sight
        before = ((points.place - [1, 5.5, 0]) @ np.array([-0.2, -1, 0.1])) > -1e-4
        points = SurfacePoints(*(values[before & (points.place[:, 2] > -1e-4)] for values in points))
    imager = Simulator(result, SONAR.replace(**texture)).model.imager
    assert imager is not None
    got = imager.tracer.field(np.array(POSE))[0].astype(complex)
    expected = spread_over_grid(points, imager.tracer)
    # at the seam of two surfaces a ray's cell holds points of one of them
    assert np.linalg.norm(got - expected) < {"floor": 1e-3, "corner": 0.02, "patches": 1e-3}[scenery] * np.linalg.norm(
        expected
    )


def test_patches_vary_by_a_gamma_law() -> None:
    """The same points and phases; factors of mean 1 whose variance is that of the patches, 9 / 4 nu."""
    plain = found(plate((0, 0, 0), (0, 0, 1), 4.0))
    from mitsonar.simulation.points import Patches, lattice_points

    nu = 2.0
    body = scene(body=plate((0, 0, 0), (0, 0, 1), 4.0)).shapes()[0]
    uneven = lattice_points(body, 0, PITCH, 0, Patches(nu, 0.1))
    assert np.array_equal(uneven.place, plain.place)
    assert np.array_equal(uneven.phase, plain.phase)
    factor = uneven.strength.astype(float) / plain.strength  # of each point's patch
    assert factor.mean() == pytest.approx(1, abs=0.05)
    assert factor.var() == pytest.approx(1 / (4 / 9 * nu), rel=0.1)


def test_a_texture_of_cells_joins_the_field() -> None:
    textured = floor(diffuse({**CELLS, "cells": 64.0}), 2.0)
    local, joined = (
        scatterers_of(simulator(ChannelSonar(scatterer_spacing_m=pitch), floor=textured)) for pitch in (None, PITCH)
    )
    assert len(local) == 64**2
    assert len(joined) == pytest.approx((4 / PITCH) ** 2, rel=0.01)
    assert joined.strength.sum() == pytest.approx(local.strength.sum(), rel=0.05)


def test_too_fine_a_lattice_is_refused() -> None:
    with pytest.raises(MitsonarError, match="scatterer_spacing_m"):
        simulator(ChannelSonar(scatterer_spacing_m=1e-4), floor=floor(diffuse(), 8.0))


def test_grain_stays_when_shapes_are_added_or_divided() -> None:
    """It follows the name of a shape up to a colon: another object, or a plate in two halves, changes nothing else."""
    from mitsonar.simulation.models.coherent import CoherentImager

    whole = plate((0, 3, 0), (0, -1, 0), 0.5, diffuse(0.5))
    ball = sphere((4.0, 3, 0), 0.1, diffuse(0.5))
    import mitsuba as mi

    turned = mi.ScalarTransform4f().translate([0, 3, 0]).rotate([1, 0, 0], 90)
    halves = {
        f"hull:{side}": {
            "type": "rectangle",
            "to_world": turned.translate([side * 0.25, 0, 0]).scale([0.25, 0.5, 1]),
            "bsdf": diffuse(0.5 + 1e-6 * side),  # Mitsuba joins shapes of one BSDF, which leaves them without a name
        }
        for side in (-1, 1)
    }
    scenes = [scene(hull=whole), scene(another=ball, hull=whole), mi.load_dict({"type": "scene", **halves})]
    first, second, third = (CoherentImager(one, SONAR).echoes(np.zeros(6))[0] for one in scenes)
    np.testing.assert_array_equal(first, second)
    assert np.abs(third - first).max() < 0.05 * np.abs(first).max()
