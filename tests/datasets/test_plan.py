"""Plans: motions within their box, labels that follow from poses, jumps and footprints as promised, for any size."""

from __future__ import annotations

from functools import cache
from itertools import islice

import numpy as np
import pytest
from helpers import essence, tiny_recipe, world_directions
from scipy import stats

from mitsonar.config.data import Recipe, load_recipe
from mitsonar.datasets.plan import Plan, footprint, run_poses, scenes_of, sequences_of
from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose, mounted

P = 1e-5


@cache
def long_plan() -> tuple[Recipe, Plan]:
    recipe = load_recipe("rocky-field")
    return recipe, Plan.of(recipe, 1200)


@pytest.mark.thorough
def test_labels_follow_from_poses_and_poses_from_labels() -> None:
    """To 1e-9: eq. 3.4 applied to each pose gives the next."""
    _, plan = long_plan()
    inner = np.flatnonzero(plan.sequence[1:] == plan.sequence[:-1])
    assert np.isnan(plan.motion[np.setdiff1d(np.arange(len(plan)), inner)]).all()
    for index in inner[::7]:
        after = compose(Pose(*plan.vehicle[index]), Motion(*plan.motion[index]))
        np.testing.assert_allclose(after, plan.vehicle[index + 1], atol=1e-9)


def test_motions_are_uniform_and_constant_in_a_sequence() -> None:
    _, plan = long_plan()
    first = np.flatnonzero(np.diff(plan.sequence, prepend=-1))
    motion = plan.motion[first] / [0.02, 0.02, np.radians(0.45)]
    for axis in range(3):
        assert stats.kstest(motion[:, axis], stats.uniform(-1, 2).cdf).pvalue > P
    assert np.abs(np.corrcoef(motion.T)[np.triu_indices(3, 1)]).max() * np.sqrt(len(motion)) < 4.5
    for step in (1, 2, 3):
        np.testing.assert_allclose(plan.motion[first + step], plan.motion[first], atol=1e-12)


def test_jumps_are_3_to_4_m_in_each_axis_with_any_heading() -> None:
    _, plan = long_plan()
    border = np.flatnonzero((np.diff(plan.sequence) > 0) & (np.diff(plan.scene) == 0))
    jump = np.abs(plan.vehicle[border + 1, :2] - plan.vehicle[border, :2])
    assert jump.min() >= 3 - 1e-9
    assert jump.max() <= 4 + 1e-9
    assert np.ptp(jump) > 0.95
    heading = plan.vehicle[np.flatnonzero(np.diff(plan.sequence, prepend=-1)), 5]
    assert heading.min() < -3
    assert heading.max() > 3


FLOWN = [("rocky-field", 300), ("ship-hull-physical", 150), ("looking-down-10m", 60), ("height-rocky", 60)]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "sequences"),
    essence(FLOWN, ("rocky-field", 300), ("looking-down-10m", 60)),
)
def test_no_footprint_leaves_its_scene(name: str, sequences: int) -> None:
    """Traced here in plain NumPy: every ray that meets the floor within the window meets it inside."""
    recipe = load_recipe(name)
    plan = Plan.of(recipe, sequences)
    sonar = recipe.instrument
    half = {scene.number: recipe.family(scene.group).half_m for scene in plan.scenes}
    bearing = np.radians(np.linspace(-1, 1, 9) * sonar.azimuth_fov_deg / 2)
    elevation = np.radians(np.linspace(-1, 1, 15) * sonar.elevation_fov_deg / 2)
    b, e = (grid.ravel() for grid in np.meshgrid(bearing, elevation))
    farthest = -np.inf
    for pose, scene in zip(plan.poses, plan.scene, strict=True):
        rays = world_directions(sonar, Pose(*pose), b, e)
        down = rays[:, 2] < -1e-6
        reach = pose[2] / -rays[down, 2]
        seen = reach <= sonar.range_max
        ground = pose[:2] + rays[down][seen][:, :2] * reach[seen, None]
        farthest = max(farthest, np.abs(ground).max(initial=0) - half[int(scene)])
    assert -3.0 < farthest <= 1e-9, farthest


def test_footprint_of_a_level_floor() -> None:
    """Its corners in closed form; edge beams meet the floor at up to 5.54 m."""
    sonar, height, pitch = load_recipe("rocky-field").instrument, 2.5, np.radians(35)
    reach = footprint(sonar, Pose(0, 0, 0, pitch), height)
    slant = np.sort(np.hypot(np.hypot(*reach.T), height))
    edge = max(np.radians(sonar.azimuth_fov_deg) / 2, sonar.bearing_rad[-1] + sonar.beam_width_rad / 2)
    e = np.radians(np.array([-1, 1]) * sonar.elevation_fov_deg / 2)
    corners = height / (np.cos(e) * np.cos(edge) * np.sin(pitch) - np.sin(e) * np.cos(pitch))
    np.testing.assert_allclose(slant, np.repeat(corners, 2), rtol=1e-12)
    assert slant[-1] == pytest.approx(5.54, abs=0.01)
    with pytest.raises(MitsonarError, match="cannot see the ground"):
        footprint(sonar, Pose(0, 0, 0, np.radians(35)), 6.0)


def test_a_small_data_set_is_the_beginning_of_each_scene_of_a_large_one() -> None:
    recipe = tiny_recipe(scenes=[{"count": 3, "sequences": 40}])
    small, large = Plan.of(recipe, 60), Plan.of(recipe, 120)
    for scene in (0, 1, 2):
        mine, theirs = (plan.poses[plan.scene == scene] for plan in (small, large))
        assert 0 < len(mine) < len(theirs)
        np.testing.assert_array_equal(mine, theirs[: len(mine)])


def test_sequences_are_spread_in_proportion() -> None:
    recipe = load_recipe("rocky-field")
    for expected, scenes in ((40_000, 30), (400, 30), (200, 20), (25, 2), (7, 1), (1, 1)):
        result = scenes_of(recipe, expected)
        assert sum(scene.sequences for scene in result) == expected
        assert len(result) == scenes
        local = [1000 if scene.number < 10 else 1500 for scene in result]
        share = expected * np.array(local) / sum(local)
        assert np.abs([scene.sequences for scene in result] - share).max() <= 1
    assert len({scene.seed for scene in scenes_of(recipe, 40_000)}) == 30
    for wrong in (0, 40_001):
        with pytest.raises(MitsonarError, match="40,000 sequences"):
            scenes_of(recipe, wrong)


def test_small_scenes_open_others_early() -> None:
    recipe = tiny_recipe(scenes=[{"count": 6, "sequences": 3}])
    assert [scene.sequences for scene in scenes_of(recipe, 17)] == [2, 3, 3, 3, 3, 3]


def test_a_footprint_too_large_for_its_scene_is_an_error_not_a_loop() -> None:
    recipe = tiny_recipe(world__size_m=3.0)
    with pytest.raises(MitsonarError, match="use a larger scene"):
        next(sequences_of(recipe, scenes_of(recipe, 1)[0]))


@pytest.mark.thorough
def test_heights_are_uniform() -> None:
    recipe = load_recipe("height-hull")
    sequences = islice(sequences_of(recipe, scenes_of(recipe, 3000)[0]), 200)
    heights = np.array([sequence.vehicle[0, 2] for sequence in sequences])
    assert stats.kstest(heights, stats.uniform(0.2, 0.35).cdf).pvalue > P


def test_runs_over_the_pattern() -> None:
    """Almanza-Medina, 2.3: frames and lengths of the three runs."""
    legs, diagonal, turn = (run_poses(name, 2.5) for name in ("legs", "diagonal", "turn"))
    assert (len(legs), len(diagonal), len(turn)) == (950, 300, 300)
    ends = legs[[0, 249, 349, 599, 699, 949], :2]
    expected = np.array([[5, 0], [0, 1.2], [-5, 0], [0, 1.1], [5, 0]])
    np.testing.assert_allclose(np.diff(ends, axis=0), expected, atol=1e-9)
    steps = np.linalg.norm(np.diff(legs[:, :2], axis=0), axis=1)
    assert steps.max() < 0.0202
    np.testing.assert_allclose(diagonal[-1] - diagonal[0], [5, 2.3, 0, 0, 0, 0], atol=1e-9)
    assert np.degrees(turn[-1, 5] - turn[0, 5]) == pytest.approx(120)
    assert np.ptp(turn[:, :3], axis=0).max() == 0


def test_mounted_sonars_keep_the_vehicle_s_motion() -> None:
    """Two sensors point to starboard: the sonar's pose turns by 90 deg, the label stays the vehicle's."""
    recipe = load_recipe("rocky-field-two-sensors")
    plan = Plan.of(recipe, 10)
    np.testing.assert_allclose(plan.poses, mounted(plan.vehicle, recipe.mount.pose), atol=1e-12)
    turn = np.degrees(plan.poses[:, 5] - plan.vehicle[:, 5]) % 360
    np.testing.assert_allclose(turn, 90, atol=1e-6)
    np.testing.assert_allclose(plan.poses[:, :3], plan.vehicle[:, :3], atol=1e-12)
