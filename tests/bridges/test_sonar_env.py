"""Environments of Gymnasium: clean by its checker, and many together see what each sees alone."""

from __future__ import annotations

import warnings
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from mitsonar.bridges.gymnasium import SonarEnv, SonarTask, SonarVectorEnv, TaskFields
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator

SONAR = Sonar(model="physical", beams=16, range_bins=32, range_min=1, range_max=8, quality="draft")
START = [[-4, -6, 2, 0.4, 0, -0.5], [4, -4, 3, 0.5, 0, 0.5]]


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(load_scene("flat_floor"), SONAR)


def test_the_checker_of_gymnasium_finds_nothing() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        named: dict[str, Any] = {"scene": "flat_floor", "sonar": SONAR, "start": START}
        result = gymnasium.make("mitsonar/Sonar-v0", observe=("image", "altitude", "pose"), render_mode="rgb_array", **named)
        check_env(result.unwrapped)


def test_vehicles_stepped_together_see_what_each_sees_alone(simulator: Simulator) -> None:
    many, one = SonarVectorEnv(simulator, num_envs=64, start=START), SonarEnv(simulator, start=START)
    actions = np.random.default_rng(0).uniform(-1, 1, (2, 64, 4))
    together = [many.reset(seed=5)[0], *(many.step(action)[0] for action in actions)]
    for place in range(0, 64, 7):
        alone = [one.reset(seed=5 + place)[0], *(one.step(action[place])[0] for action in actions)]
        for all_of_them, local in zip(together, alone, strict=True):
            assert isinstance(all_of_them, np.ndarray)
            assert isinstance(local, np.ndarray)
            np.testing.assert_array_equal(all_of_them[place], local)
    first = together[0]
    assert isinstance(first, np.ndarray)
    assert first.max() > 100
    assert not np.array_equal(first[0], first[1])


def test_a_vehicle_that_sinks_collides_and_begins_anew(simulator: Simulator) -> None:
    start = [0, -5, 1.0, 0.4, 0, 0]
    env = SonarVectorEnv(simulator, num_envs=2, start=start, step_s=1.0, clearance_m=0.4)
    env.reset(seed=0)
    down, stay = [0, 0, -1, 0], [0, 0, 0, 0]
    terminated = env.step(np.array([down, stay]))[2]
    assert not terminated.any()  # at 0.5 m
    _, _, terminated, truncated, info = env.step(np.array([down, stay]))
    assert terminated.tolist() == [True, False]
    assert not truncated.any()
    assert info["collided"].tolist() == [True, False]
    _, _, terminated, _, info = env.step(np.array([down, stay]))
    assert not terminated.any()
    np.testing.assert_allclose(info["pose"][0], start)
    assert info["_collided"].tolist() == [False, True]


def test_bounds_steps_and_rewards_count(simulator: Simulator) -> None:
    env = SonarEnv(
        simulator,
        start=[0, -5, 2, 0.4, 0, np.pi / 2],
        bounds=[[-9, -9, 0], [0.5, 9, 9]],
        step_s=0.4,
        max_steps=3,
        reward=lambda step: step.poses[:, 0] - step.before[:, 0],
    )
    env.reset(seed=1)
    _, reward, terminated, truncated, info = env.step([0, 1, 0, 0])  # ahead is +x
    assert reward == pytest.approx(0.4)
    assert not terminated
    assert not truncated
    _, _, terminated, _, info = env.step([0, 1, 0, 0])
    assert terminated
    assert info["outside"]
    assert env.step([0, 0, 0, 0])[3]


def test_masked_resets_and_wrong_arguments(simulator: Simulator) -> None:
    env = SonarVectorEnv(simulator, num_envs=2, start=START, max_steps=1, autoreset_mode="Disabled")
    env.reset(seed=0)
    truncated = env.step(np.zeros((2, 4)))[3]
    assert truncated.all()
    with pytest.raises(MitsonarError, match="2 episodes have ended"):
        env.step(np.zeros((2, 4)))
    env.reset(options={"reset_mask": np.array([True, True])})
    with pytest.raises(MitsonarError, match=r"four finite numbers for each of 2: got nan at \[0, 0\]"):
        env.step(np.full((2, 4), np.nan))
    for wrong_action in ("left", [[0, 1], [0]], [["x"] * 4] * 2):
        with pytest.raises(MitsonarError, match="four finite numbers: got"):
            env.step(wrong_action)
    for wrong in ({"start": [1, 2]}, {"bounds": [[1, 1, 1], [0, 0, 0]]}, {"observe": ("pose",)}, {"max_steps": 0}):
        with pytest.raises(MitsonarError):
            SonarEnv(simulator, **wrong)
    with pytest.raises(MitsonarError, match="num_envs"):
        SonarVectorEnv(simulator, num_envs=0)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"strat": [0, 0, 2, 0, 0, 0]}, "no argument strat: did you mean start"),
        ({"start": "here"}, "start must consist of numbers"),
        ({"start": [[1, 2], [3]]}, "start must consist of numbers"),
        ({"bounds": "wide"}, "bounds must consist of numbers"),
        ({"max_velocity": "fast"}, "max_velocity must consist of numbers"),
        ({"max_steps": "9"}, "whole number"),
        ({"max_steps": 2.5}, "whole number"),
        ({"observe": "image"}, "tuple that contains image"),
        ({"observe": 3}, "tuple that contains image"),
        ({"noise": "low"}, "noise must be a NoiseModel"),
    ],
)
def test_mistakes_are_answered_in_a_sentence(simulator: Simulator, wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(MitsonarError, match=said):
        SonarEnv(simulator, **{"start": START, **wrong})


def test_what_is_no_scene_is_refused(simulator: Simulator) -> None:
    nothing: Any = None
    with pytest.raises(MitsonarError, match="got NoneType"):
        SonarEnv(nothing, SONAR, start=START)
    count: Any = 2.0
    with pytest.raises(MitsonarError, match="whole number in 1"):
        SonarVectorEnv(simulator, num_envs=count)


@pytest.mark.parametrize(
    ("task", "said"),
    [
        ({"start": [0, -5, 12, 0.4, 0, 0], "bounds": [[-9, -9, 0.3], [9, 9, 5]]}, "start lies outside bounds"),
        ({"start": [[0, -5, 2, 0, 0, 0], [0, -5, 0.1, 0, 0, 0]], "bounds": [[-9, -9, 0.3], [9, 9, 5]]}, "outside bounds"),
        ({"start": [0, -5, 2, 25, 0, 90]}, "heading in rad: got 0, -5, 2, 25, 0, 90; are these degrees"),
        ({"start": [0, -5, 0.05, 0.4, 0, 0]}, r"start is 0.05 m from a surface, which is less than clearance_m 0.3"),
        ({"start": START, "foo": 1}, "no argument foo: known: start, bounds"),
        ({"start": START, "bound": 1}, "did you mean bounds"),
    ],
)
def test_a_start_where_every_episode_ends_is_refused(task: dict[str, Any], said: str, simulator: Simulator) -> None:
    with pytest.raises(MitsonarError, match=said):
        SonarVectorEnv(simulator, num_envs=2, **task)
    with pytest.raises(MitsonarError, match=said):
        SonarEnv(simulator, **task)


def test_a_start_below_the_seabed_is_warned_of(simulator: Simulator) -> None:
    with pytest.warns(MitsonarWarning, match="there is no surface below start, and one 2 m above it"):
        SonarEnv(simulator, start=[0, -5, -2, 0.4, 0, 0], gain=1.0)


def test_steps_before_a_reset_are_refused_as_gymnasium_does(simulator: Simulator) -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        SonarEnv(simulator, start=START).step(np.zeros(4))
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        SonarVectorEnv(simulator, num_envs=2, start=START).step(np.zeros((2, 4)))


def test_a_reward_may_be_one_number_and_a_wrong_one_is_shown(simulator: Simulator) -> None:
    one, two = (SonarVectorEnv(simulator, num_envs=n, start=START, reward=lambda step: 1.5) for n in (1, 2))
    for env, count in ((one, 1), (two, 2)):
        env.reset(seed=0)
        np.testing.assert_array_equal(env.step(np.zeros((count, 4)))[1], np.full(count, 1.5))
    alone = SonarEnv(simulator, start=START, reward=lambda step: 1.0)
    alone.reset(seed=0)
    assert alone.step(np.zeros(4))[1] == 1.0
    for reward, output in ((lambda step: [0, np.nan], r"got nan at \[1\]"), (lambda step: np.zeros(3), r"the shape \(3,\)")):
        bad = SonarVectorEnv(simulator, num_envs=2, start=START, reward=reward)
        bad.reset(seed=0)
        with pytest.raises(MitsonarError, match=output):
            bad.step(np.zeros((2, 4)))


def test_a_mistyped_argument_of_an_environment_is_one_sentence() -> None:
    with pytest.raises(MitsonarError, match=r"an environment has no argument boundz: did you mean bounds\?"):
        SonarEnv("flat_floor", boundz=1)  # type: ignore[call-arg]
    with pytest.raises(MitsonarError, match=r"an environment has no argument num_env: did you mean num_envs\?"):
        SonarVectorEnv("flat_floor", num_env=2)  # type: ignore[call-arg]
    assert list(TaskFields.__annotations__) == [field.name for field in fields(SonarTask)]


def test_a_step_returns_what_gymnasium_names_in_its_order(simulator: Simulator) -> None:
    env = SonarEnv(simulator, start=START, max_steps=1)
    _, info = env.reset(seed=0)
    assert list(info) == ["pose"]
    _, reward, terminated, truncated, info = env.step(np.zeros(4))
    assert (type(reward), terminated, truncated) == (float, False, True)
    assert sorted(info) == ["clearance_m", "collided", "outside", "pose"]
    words = " ".join((SonarEnv.step.__doc__ or "").split())
    assert "observation, reward, terminated, truncated, info" in words


def test_an_environment_follows_its_scene() -> None:
    """A floor that rises is seen, and collided with: tables and clearance are of the scene as it is."""
    import mitsuba as mi

    scene = load_scene("flat_floor")
    env = SonarEnv(scene, SONAR, start=[0, -5, 2, 0.4, 0, 0], clearance_m=0.3)
    env.reset(seed=0)
    before, _, terminated, _, _ = env.step(np.zeros(4))
    values: Any = mi.traverse(scene)
    values["floor.to_world"] = mi.ScalarTransform4f().translate([0, 0, 1.8]).scale(20)
    values.update()
    after, _, collided, _, _ = env.step(np.zeros(4))
    assert (terminated, collided) == (False, True)
    assert not np.array_equal(np.asarray(before), np.asarray(after))
