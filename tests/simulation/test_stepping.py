"""A closed loop: simulators that are stepped count their pings, keep their gain, and give what one run gives."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import pytest
from helpers import diffuse, essence, floor, scene, sphere
from numpy.typing import ArrayLike

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.channel import ChannelSimulator
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

Model: TypeAlias = Literal["physical", "thesis"]

SONAR = Sonar(beams=12, range_bins=64, rays_per_beam=300, rays_across=2, seed=7)
PITCH = np.radians(35)
POSES = np.array([Pose(0.02 * k, 0.05 * k, 2.5 - 0.02 * k, PITCH, 0.01 * k, 0.02 * k) for k in range(5)])
NOISE = NOISE_MODELS["high"]


@pytest.fixture(scope="module")
def ground(variant: str) -> mi.Scene:
    """A floor of random cells with a sphere on it."""
    cells = {"type": "cell_noise", "cells": 2000.0, "seed": 3}
    return scene(floor=floor(diffuse(cells), 20), ball=sphere((0, 3.5, 0.2), 0.2, diffuse(0.9)))


def stepped(simulator: Simulator, poses: Iterable[ArrayLike] = POSES, **words: Any) -> list[SonarFrames]:
    return [simulator.step(pose, **words) for pose in poses]


def assert_same(steps: list[SonarFrames], whole: SonarFrames) -> None:
    """Every array, bit for bit."""
    assert [len(frame) for frame in steps] == [1] * len(whole)
    for name in ("image", "time_s", "poses", "height_m", "elevation_rad", "shape_id", "object_id", "shadow"):
        expected = getattr(whole, name)
        if expected is None:
            assert all(getattr(frame, name) is None for frame in steps)
        else:
            np.testing.assert_array_equal(np.concatenate([getattr(frame, name) for frame in steps]), expected)
    assert {frame.level_scale for frame in steps} == {whole.level_scale}
    for frame in steps:
        np.testing.assert_array_equal(frame.range_m, whole.range_m)
        np.testing.assert_array_equal(frame.bearing_rad, whole.bearing_rad)
        assert frame.sonar == whole.sonar


@pytest.mark.parametrize("model", ["physical", "thesis"])
@pytest.mark.parametrize("jitter", essence([True, False], True))
@pytest.mark.parametrize("labels", essence([True, False], True))
def test_stepping_is_one_run_with_the_same_gain(ground: mi.Scene, model: Model, jitter: bool, labels: bool) -> None:
    """With noise: both are drawn from the number of the ping."""
    sonar = SONAR.replace(model=model, jitter=jitter)
    gain = 1 / Simulator(ground, sonar).render(POSES).level_scale
    words: dict[str, Any] = {"noise": NOISE, "seed": 11, "labels": labels, "gain": gain}
    whole = Simulator(ground, sonar).render(POSES, **words)
    assert_same(stepped(Simulator(ground, sonar), **words), whole)


@pytest.mark.parametrize("model", ["physical", "thesis"])
def test_without_a_gain_the_first_frame_sets_it_and_a_run_told_so_is_the_same(ground: mi.Scene, model: Model) -> None:
    simulator = Simulator(ground, SONAR.replace(model=model))
    steps = stepped(simulator, noise=NOISE)
    first = Simulator(ground, SONAR.replace(model=model)).render(POSES[:1])
    assert steps[0].level_scale == first.level_scale
    assert_same(steps, Simulator(ground, SONAR.replace(model=model)).render(POSES, noise=NOISE, gain=simulator.gain))


def test_pings_of_a_loop_differ_where_rendering_each_alone_repeats_itself(ground: mi.Scene) -> None:
    """What was wrong: the number of the frame was always 0, and each call set its own gain."""
    still = [POSES[0]] * 3
    frames = stepped(Simulator(ground, SONAR), still, noise=NOISE)
    assert (frames[0].image != frames[1].image).mean() > 0.9
    assert (frames[1].image != frames[2].image).mean() > 0.9
    simulator = Simulator(ground, SONAR)
    alone = [simulator.render([pose], noise=NOISE) for pose in POSES]
    np.testing.assert_array_equal(alone[0].image[0], simulator.step(POSES[0], noise=NOISE).image[0])
    assert len({frame.level_scale for frame in alone}) > 1  # `render` calibrates each call
    assert len({frame.level_scale for frame in stepped(Simulator(ground, SONAR))}) == 1


def test_rendering_in_between_does_not_disturb_a_loop(ground: mi.Scene) -> None:
    simulator, expected = Simulator(ground, SONAR), stepped(Simulator(ground, SONAR), noise=NOISE)
    for pose, frame in zip(POSES, expected, strict=True):
        simulator.render(POSES[:2])
        np.testing.assert_array_equal(simulator.step(pose, noise=NOISE).image, frame.image)


def test_reset_begins_a_new_loop(ground: mi.Scene) -> None:
    simulator = Simulator(ground, SONAR)
    first = stepped(simulator, noise=NOISE)
    stored = simulator.gain
    simulator.reset()
    assert simulator.gain is None
    again = stepped(simulator, noise=NOISE)
    assert simulator.gain == stored
    for one, second in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.image, second.image)
        np.testing.assert_array_equal(one.time_s, second.time_s)


def test_a_loop_that_begins_in_empty_water_sets_its_gain_on_the_first_echoes(ground: mi.Scene) -> None:
    up = Pose(0, 0, 2.5, -1.2)
    simulator = Simulator(ground, SONAR)
    frames = stepped(simulator, [up, *POSES])
    assert not frames[0].image.any()
    assert frames[0].level_scale == 1
    assert frames[1].image.max() > 0.89
    whole = Simulator(ground, SONAR).render([up, *POSES], gain=simulator.gain)
    np.testing.assert_array_equal(np.concatenate([frame.image for frame in frames]), whole.image)


def test_times_follow_the_rate_or_are_told(ground: mi.Scene) -> None:
    simulator = Simulator(ground, SONAR)
    times = [float(simulator.step(POSES[0], time_s=time).time_s[0]) for time in (None, 0.37, None)]
    np.testing.assert_array_equal(times, [0.0, 0.37, 2 / SONAR.frame_rate_hz])


def test_what_a_step_refuses(ground: mi.Scene) -> None:
    simulator = Simulator(ground, SONAR)
    with pytest.raises(MitsonarError, match=r"a step takes one pose .*got \(5, 6\)"):
        simulator.step(POSES)
    simulator.step(POSES[0], gain=2.0)
    with pytest.raises(MitsonarError, match=r"the gain of a loop is constant, 2: got 3; leave gain out, or call reset\(\)"):
        simulator.step(POSES[1], gain=3.0)
    assert simulator.step(POSES[1]).level_scale == 0.5


def test_a_loop_warns_once_of_each_thing(ground: mi.Scene) -> None:
    up, simulator = Pose(0, 0, 2.5, -1.2), Simulator(ground, SONAR)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stepped(simulator, [up] * 3)
        output = [str(one.message) for one in caught if issubclass(one.category, MitsonarWarning)]
        assert len(output) == 1
        assert output[0].startswith("no ray hit anything in 1 frame")
        simulator.reset()
        simulator.step(up)
        assert len([one for one in caught if issubclass(one.category, MitsonarWarning)]) == 2


def test_ranges_outside_are_sought_for_the_warning_only(ground: mi.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another tracing, for a sentence that is given once, would cost every ping of a loop seconds in a large scene."""
    near, sought = Simulator(ground, SONAR.replace(range_max=4.4)), []
    monkeypatch.setattr(near, "window_range", lambda pose, ping, time_s: sought.append(ping))
    with pytest.warns(MitsonarWarning, match="lie outside the window"):
        stepped(near, POSES)
    assert sought == [0]


# ---------------------------------------------------------------- impulse responses


@pytest.mark.thorough
@pytest.mark.parametrize("model", ["scatterers", "rays"])
def test_stepped_channels_are_those_of_one_run(model: Literal["scatterers", "rays"]) -> None:
    """A velocity is told to each step: one pose alone does not say it."""
    sonar = ChannelSonar.create(model=model, range_max=9.0, points_per_m2=200.0)
    world = scene(floor=floor(diffuse({"type": "cell_noise", "cells": 300.0, "seed": 5}), 8))
    poses = np.array([Pose(0.1 * k, 0.2 * k, 5, 0, 0, 0.05 * k) for k in range(4)])
    flown = Trajectory(poses, np.arange(4) / sonar.frame_rate_hz)
    whole = ChannelSimulator(world, sonar).responses(flown)
    simulator = ChannelSimulator(world, sonar)
    for _ in range(2):
        steps = [simulator.step(pose, speed) for pose, speed in zip(poses, velocities(flown), strict=True)]
        for name in ("response", "time_s", "poses", "velocity", "height_m", "echoes", "dropped"):
            got = np.concatenate([getattr(step, name) for step in steps])
            np.testing.assert_array_equal(got, getattr(whole, name), err_msg=name)
        simulator.reset()
    with pytest.raises(MitsonarError, match="a step takes one pose"):
        simulator.step(poses, velocities(flown))
    assert simulator.step(poses[0], (0, 0, 0, 0), time_s=3.5).time_s[0] == 3.5
