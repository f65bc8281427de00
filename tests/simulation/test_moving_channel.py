"""Impulse responses of bodies that move: against vehicles that move instead, the delay's equations, and its slope."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from channel_scenes import LEVEL, received_from, unmerged
from helpers import box, floor, plate

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.motion.bodies import Deforming, MeshSequence
from mitsonar.motion.pose import Pose, mount_between
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.channel import ChannelSimulator, Paths

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

SONAR = ChannelSonar(receivers=(received_from((0.3, 0.1, 0)),), points_per_m2=300, range_max=20.0)
SWIMS = Trajectory(np.array([[1, 2, 4, 0.1, 0.2, 0.3], [1.5, 4, 4.5, 0.3, -0.1, 1.1]]), np.array([0.0, 1.0]))
"""A fish that swims at 2.1 m/s, and turns by almost a radian a second."""

FAST = np.array([0.6, -0.8, 0.2, 0.0])
"""Velocity of a vehicle [m/s]."""


def fish() -> dict[str, Any]:
    return box((0, 0, 0), (0.2, 0.5, 0.15))


def in_order(paths: Paths) -> list[Any]:
    order = np.argsort(paths.delay_s)
    return [values[order] for values in (paths.delay_s, paths.amplitude, paths.doppler_hz)]


def test_a_body_elsewhere_is_a_vehicle_elsewhere() -> None:
    """Two routes: the body is moved and turned, or the sonar is by the inverse."""
    place = Pose(*SWIMS.at(np.array([0.4]))[0])
    rests = Trajectory(np.array([place]), np.zeros(1))
    moved = ChannelSimulator(unmerged(fish=fish()), SONAR, moving={"fish": rests}).paths(LEVEL)
    still = ChannelSimulator(unmerged(fish=fish()), SONAR).paths(mount_between(place, LEVEL))
    assert len(moved.delay_s) > 100
    for one, other, tolerance in zip(in_order(moved), in_order(still), (1e-9, 1e-7, 1e-6), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=tolerance)


def test_only_the_velocity_between_sonar_and_body_matters_at_low_speed() -> None:
    """A body that comes, and a vehicle that goes to it, have one Doppler shift."""
    path = Trajectory(np.array([[1, 2, 4, 0, 0, 0], [1.6, 1.2, 4.2, 0, 0, 0]]), np.array([0.0, 1.0]))
    rests = Trajectory(path.poses[:1], np.zeros(1))
    scene = unmerged(fish=fish())
    comes = ChannelSimulator(scene, SONAR, moving={"fish": path}).paths(LEVEL)
    goes = ChannelSimulator(scene, SONAR, moving={"fish": rests}).paths(LEVEL, -FAST)
    np.testing.assert_allclose(comes.doppler_hz, goes.doppler_hz, atol=1e-3)
    there = ChannelSimulator(scene, SONAR, moving={"fish": rests}).paths(LEVEL)
    shift = comes.delay_s - there.delay_s  # twice the way that the body makes until sound meets it
    np.testing.assert_allclose(shift, -comes.doppler_hz / SONAR.carrier_hz * there.delay_s / 2, rtol=0.03, atol=2e-8)


def test_doppler_is_the_slope_of_the_delay() -> None:
    slowly = Trajectory(SWIMS.poses, 20 * SWIMS.time_s)  # terms of second order in v / c are neglected
    result = ChannelSimulator(unmerged(fish=fish(), floor=floor(half=8)), SONAR, moving={"fish": slowly})
    step = 1e-4
    here, before, after = (result.paths(LEVEL, time_s=10 + offset).by("fish") for offset in (0.0, -step, step))
    assert len(here.delay_s) == len(before.delay_s) == len(after.delay_s) > 50
    slope = (after.delay_s - before.delay_s) / (2 * step)
    assert np.abs(here.doppler_hz).max() > 4
    np.testing.assert_allclose(here.doppler_hz, -slope * SONAR.carrier_hz, atol=2e-3)


def test_a_body_casts_its_shadow_where_it_is_then() -> None:
    path = Trajectory(np.array([[0, 0, 6, 0, 0, 0], [5, 0, 6, 0, 0, 0]], dtype=float), np.array([0.0, 1.0]))
    plank = box((0, 0, 0), (1, 1, 0.02))
    result = ChannelSimulator(unmerged(floor=floor(half=8), plank=plank), SONAR, moving={"plank": path})
    assert result.kinds == ("scatterer", "plank")
    for time_s, x in ((0.0, 0.0), (1.0, 5.0)):
        built = ChannelSimulator(unmerged(floor=floor(half=8), plank=box((x, 0, 6), (1, 1, 0.02))), SONAR).paths(LEVEL)
        seen = result.paths(LEVEL, time_s=time_s).by("scatterer")
        delay = np.sort(built.delay_s)
        np.testing.assert_allclose(np.sort(seen.delay_s), delay[delay > 2 * 9.5 / 1500], atol=1e-9)


def test_heights_are_those_above_still_shapes() -> None:
    """The fish lies below the sonar in its own axes, where nothing is."""
    away = Trajectory(np.array([[5, 0, 6, 0, 0, 0]], dtype=float), np.zeros(1))
    whole, floor_only = (
        ChannelSimulator(scene, SONAR, moving=moving).responses(Trajectory(np.array([LEVEL]), np.zeros(1))).height_m
        for scene, moving in ((unmerged(fish=box((0, 0, 1), (1, 1, 0.5)), floor=floor(half=8)), {"fish": away}),
                              (unmerged(floor=floor(half=8)), None))
    )  # fmt: skip
    np.testing.assert_array_equal(whole, floor_only)


def test_pings_place_bodies_at_their_times() -> None:
    scene = unmerged(fish=fish(), floor=floor(half=4))
    result = ChannelSimulator(scene, SONAR, moving={"fish": SWIMS})
    flown = Trajectory(np.repeat([LEVEL], 3, axis=0), np.array([0.0, 0.25, 0.75]))
    whole = result.responses(flown)
    steps = [result.step(LEVEL, np.zeros(4), time_s=time) for time in flown.time_s]
    np.testing.assert_array_equal(whole.response, np.concatenate([step.response for step in steps]))
    assert np.abs(whole.response[1] - whole.response[2]).max() > 0.1 * np.abs(whole.response).max()
    late = next(iter(result.pings(flown.poses[:1], first=4)))  # its number over the frame rate
    there = result.responses(Trajectory(flown.poses[:1], np.array([4 / SONAR.frame_rate_hz])))
    np.testing.assert_array_equal(late.response, there.response)


def test_a_body_is_also_seen_by_way_of_the_surface() -> None:
    """The way via a flat surface is that to the body's image above it."""
    sonar = SONAR.replace(bounces=2, receivers=(received_from(),))
    path = Trajectory(np.array([[1.0, 2, 4, 0, 0, 0], [1.6, 1.2, 4.2, 0, 0, 0]]), np.array([0.0, 1.0]))
    scene = unmerged(fish=fish(), surface=plate((0, 0, 12), (0, 0, -1)))
    result = ChannelSimulator(scene, sonar, mirrors={"surface": (-1.0, 0.0)}, moving={"fish": path})
    assert {"fish", "fish-surface", "surface-fish", "surface"} < set(result.kinds)
    paths = result.paths(LEVEL, time_s=0.5)
    direct, there, back = (paths.by(name) for name in ("fish", "surface-fish", "fish-surface"))
    assert len(there.delay_s)
    middle = np.array([1.3, 1.6, 4.1])
    ways = [float(np.linalg.norm(middle - (0, 0, z))) / 1500 for z in (10, 14)]
    assert direct.delay_s.mean() == pytest.approx(2 * ways[0], rel=0.05)
    for one in (there, back):
        assert one.delay_s.mean() == pytest.approx(sum(ways), rel=0.05)
    np.testing.assert_allclose(np.sort(there.doppler_hz), np.sort(back.doppler_hz), atol=0.5)
    with pytest.raises(MitsonarError, match="mirrors must not move: got fish"):
        ChannelSimulator(scene, sonar, mirrors={"fish": (-1.0, 0.0)}, moving={"fish": path})


def test_mistakes_say_what_to_do() -> None:
    scene = unmerged(fish=fish(), floor=floor())
    with pytest.raises(MitsonarError, match="model scatterers only: got rays while fish moves; choose --model scatterers"):
        ChannelSimulator(scene, SONAR.replace(model="rays"), moving={"fish": SWIMS})
    waves = Deforming(SWIMS, MeshSequence(np.zeros((2, 24, 3), np.float32), 1.0))
    with pytest.raises(MitsonarError, match="rigid bodies: fish deforms; give it a path without meshes"):
        ChannelSimulator(scene, SONAR, moving={"fish": waves})
