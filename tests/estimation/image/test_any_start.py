"""Motions far from zero: found by phase or from a prior, over relief, and held against what was expected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.estimation.estimator import Estimate, prior_rejection
from mitsonar.estimation.image import direct
from mitsonar.estimation.image.direct import Direct, is_far
from mitsonar.estimation.image.registration import by_block, cell_blocks, on_cells
from mitsonar.estimation.named import create_estimator
from mitsonar.geometry.ground import FirstEchoes, attitude_of
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion, MotionPrior, compose, motions
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.scene import load_scene, shipped_trajectory, sonar_in
from mitsonar.simulation.simulator import Simulator
from mitsonar.worlds.families import RockyField

pytestmark = pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")

START = Pose(0.3, -3.5, 2.5, np.radians(35), 0, 0.4)
UNITS = np.array([1e3, 1e3, 180 / np.pi])
FAR = Motion(0.2, -0.18, np.radians(4.5))
ALLOWED = np.array([12.0, 8.0, 0.25])
"""Errors over relief in mm, mm, deg: 4 % of the steps, since dense rocks hide the floor and the first echoes err by 3 %."""

METHODS = ["direct", pytest.param("corrnet", marks=pytest.mark.learn)]


@pytest.fixture(scope="module")
def rocks(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Simulator:
    """A dense rocky field."""
    folder = tmp_path_factory.mktemp("far rocks") / "world"
    scene = load_scene(RockyField(size_m=16, a_side=(32, 32)).build(3).write(folder))
    return Simulator(scene, Sonar(rays_per_beam=300, rays_across=4))


@pytest.fixture(scope="module")
def far(rocks: Simulator) -> SonarFrames:
    """Two frames, 270 mm and 4.5 deg apart."""
    return two(rocks, FAR)


def two(simulator: Simulator, motion: Motion) -> SonarFrames:
    """Two frames, the motion apart."""
    poses = Trajectory(np.array([START, compose(START, motion)]), np.array([0.0, 0.1]))
    return simulator.render(poses, noise=NOISE_MODELS["none"], seed=3)


def expected(motion: Motion, *, mm: float, deg: float) -> MotionPrior:
    return MotionPrior(motion, np.diag([mm / 1e3, mm / 1e3, np.radians(deg)]) ** 2)


def off(found: Estimate, motion: Motion) -> NDArray[np.float64]:
    return np.asarray(np.abs(np.array(found.motion) - np.array(motion)) * UNITS, dtype=np.float64)


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("method", METHODS)
def test_far_motions_are_found_without_a_prior(far: SonarFrames, method: str) -> None:
    """Beyond the search from no motion; the covariance holds."""
    result = create_estimator(method).estimate(far)
    assert result.valid, result.reason
    assert result.about["start"] == "phase"
    assert (off(result, FAR) < ALLOWED).all(), f"mm, mm, deg: {off(result, FAR)}"
    assert result.covariance is not None
    assert (off(result, FAR) < 4 * np.sqrt(np.diag(result.covariance)) * UNITS).all()


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("method", METHODS)
def test_a_prior_is_where_it_starts(far: SonarFrames, method: str) -> None:
    """A prior that is 10 mm and 0.3 deg off, and says so."""
    message = Motion(FAR.sideways + 0.01, FAR.forward - 0.01, FAR.yaw + np.radians(0.3))
    result = create_estimator(method).estimate(far, expected(message, mm=10, deg=0.3))
    assert result.valid, result.reason
    assert result.about["start"] == "prior"
    assert (off(result, FAR) < ALLOWED).all(), f"mm, mm, deg: {off(result, FAR)}"


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("method", METHODS)
def test_a_wrong_prior_rejects(far: SonarFrames, method: str) -> None:
    """One that is sure of no motion: nothing is looked for elsewhere, and nothing is believed."""
    result = create_estimator(method).estimate(far, expected(Motion(0.0, 0.0, 0.0), mm=2, deg=0.1))
    assert not result.valid
    assert result.reason


@pytest.mark.usefixtures("variant")
def test_a_wide_prior_does_not_bar_the_search(far: SonarFrames) -> None:
    """A prior of half a metre tells nothing: phase finds the start."""
    result = Direct().estimate(far, expected(Motion(0.0, 0.0, 0.0), mm=500, deg=10))
    assert result.valid, result.reason
    assert result.about["start"] == "phase"


@pytest.mark.usefixtures("variant")
def test_a_near_motion_with_a_prior_is_that_without(rocks: Simulator) -> None:
    """The prior only chooses start and levels: at the finest level both end at one motion."""
    motion = Motion(0.015, -0.012, np.radians(0.4))
    frames = two(rocks, motion)
    alone, message = Direct().estimate(frames), Direct().estimate(frames, expected(motion, mm=1, deg=0.05))
    assert alone.about["start"] == "zero"
    assert message.valid, message.reason
    assert (off(message, alone.motion) < [0.1, 0.1, 0.003]).all()


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_swapped_far_frames_tell_the_opposite_motion(far: SonarFrames) -> None:
    """Two ways to one number: relief is drawn in the first frame, and the way back has another first frame."""
    there, back = (Direct().estimate(frames) for frames in (far, far.select(np.array([1, 0]))))
    home = compose(compose(Pose(0, 0, 0), there.motion), back.motion)
    assert (np.abs(home[:2]) < 5e-3).all()
    assert abs(home.heading) < np.radians(0.15)


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_light_over_even_ground_is_no_match() -> None:
    """Half metres over even gravel, with speckle: what is lit alike correlates by 0.4 near no motion. It was believed."""
    scene, way = load_scene("pattern", texture="photo_gravel"), Trajectory.load(shipped_trajectory("pattern"))
    sonar = sonar_in(scene)
    assert sonar is not None
    poses = way.resample(12).poses[2:6]
    frames = Simulator(scene, sonar[0]).render(poses)
    for first in range(3):
        answer = Direct().estimate(frames.select(slice(first, first + 2)))
        assert answer.valid, answer.reason
        assert answer.about["start"] == "phase"
        assert (off(answer, Motion(*motions(poses)[first])) < [40.0, 20.0, 0.7]).all()


def test_the_prior_gate_is_chi_square() -> None:
    """Three numbers, each 2.7 standard deviations off, are 21.9 of chi-square; 2.6 are 20.3."""
    prior = expected(Motion(0.1, 0.0, 0.0), mm=3, deg=0.3)
    local = np.diag([0.004, 0.004, np.radians(0.4)]) ** 2
    for times, rejected in ((2.6, False), (2.7, True)):
        apart = times * np.array([0.005, 0.005, np.radians(0.5)])
        motion = Motion(0.1 + apart[0], apart[1], apart[2])
        assert bool(prior_rejection(motion, local, prior)) == rejected
    assert "4.7 standard deviations" in prior_rejection(motion, local, prior)
    assert not prior_rejection(motion, local, None)


def test_an_unknown_component_does_not_hide_a_known_one() -> None:
    """The heading alone is expected, to 1 mrad: 5 standard deviations off are too many, 4 are not."""
    prior = MotionPrior(Motion(0.0, 0.0, 0.0), np.diag([1e10, 1e10, 1e-6]))
    assert "5.0 standard deviations" in prior_rejection(Motion(0.3, 2.0, 0.005), None, prior)
    assert not prior_rejection(Motion(0.3, 2.0, 0.004), None, prior)


def test_far_is_by_height_and_turn() -> None:
    assert not is_far(Motion(0.03, 0.03, 0.02), 0.05)
    assert is_far(Motion(0.03, 0.03, 0.02), 0.04)
    assert is_far(Motion(0.0, 0.0, -0.03), 0.05)


def test_sums_over_blocks_and_values_on_cells() -> None:
    """The rest belongs to the last block; a plane comes back as it was between the middles of blocks."""
    maps = np.random.default_rng(0).normal(size=(2, 11, 7))
    assert cell_blocks(maps.shape, (4, 3)) == (2, 2)
    sums = by_block(maps, (4, 3)).reshape(2, 2, 2)
    assert sums[1, 1, 0] == pytest.approx(maps[1, 4:, :3].sum())
    middles = np.add.outer(np.arange(3) * 4 + 1.5, 2.0 * (np.arange(4) * 2 + 0.5))
    cells = on_cells(middles, (12, 8), (4, 2))
    plane = np.add.outer(np.arange(12.0), 2.0 * np.arange(8))
    assert np.allclose(cells[2:10, 1:7], plane[2:10, 1:7], atol=1e-4)


# ---------------------------------------------------------------- certainty over relief


@pytest.mark.usefixtures("variant")
def test_far_covariances_know_the_relief_of_the_first_echoes(far: SonarFrames, monkeypatch: pytest.MonkeyPatch) -> None:
    """Contrast 0.1 m above the first echoes adds 0.1 m to the height's standard deviation: variances add, motions stay."""
    covariances, motion = [], []
    for tops_m in (0.0, 0.05, 0.1):
        told = replace(attitude_of(far, "direct", None, None), first=FirstEchoes(2.2, tops_m, False))
        monkeypatch.setattr(direct, "attitude_of", lambda *_, told=told: told)
        result = Direct().estimate(far, expected(FAR, mm=10, deg=0.3))
        assert result.covariance is not None
        covariances.append(result.covariance)
        motion.append(result.motion)
    assert motion[0] == motion[1] == motion[2]
    np.testing.assert_allclose(covariances[2] - covariances[0], 4 * (covariances[1] - covariances[0]), rtol=1e-6)
    assert covariances[2][1, 1] > 2 * covariances[0][1, 1]


@pytest.mark.thorough
def test_far_covariances_hold_over_rocks(rocks: Simulator) -> None:
    """Squared errors of 14 pairs over their covariances; blocks' gradients without a jackknife gave 2.2."""
    random, nees = np.random.default_rng(4), []
    for _ in range(14):
        east, north, heading = random.uniform(-1, 1, 3) * [2, 2, 3]
        start = START._replace(x=START.x + east, y=START.y + north, heading=heading)
        motion = Motion(*(random.uniform(-1, 1, 3) * [0.2, 0.2, 0.08]))
        poses = Trajectory(np.array([start, compose(start, motion)]), np.array([0.0, 0.1]))
        frames = rocks.render(poses, noise=NOISE_MODELS["none"], seed=3)
        result = Direct().estimate(frames, expected(motion, mm=10, deg=0.3))
        assert result.covariance is not None
        error = np.array(result.motion) - motion
        nees.append(error @ np.linalg.solve(result.covariance, error) / 3)
    assert 0.4 < np.mean(nees) < 1.6


def test_smaller_cells_tell_no_more(far: SonarFrames) -> None:
    """The covariance over relief is that of whole blocks: bins cut in half hold nothing new."""
    middles = (far.range_m[1:] + far.range_m[:-1]) / 2
    between = (far.image[:, 1:] + far.image[:, :-1]) / 2
    image = np.stack([far.image[:, 1:], between], axis=2).reshape(2, -1, far.image.shape[2])
    finer = changed(far, range_m=np.sort(np.append(far.range_m[1:], middles)), image=image)
    whole, cut = (Direct().estimate(frames, expected(FAR, mm=10, deg=0.3)) for frames in (far, finer))
    assert whole.covariance is not None
    assert cut.covariance is not None
    assert np.diag(cut.covariance) == pytest.approx(np.diag(whole.covariance), rel=0.5)


def changed(frames: SonarFrames, **fields: object) -> SonarFrames:
    """The frames with some fields replaced."""
    return SonarFrames(**{**vars(frames), **fields})
