"""The estimator ``flow``: signs and sizes of known motions, honest covariances, no confident answer where there is none."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from helpers import essence
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, special

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.errors import MitsonarError
from mitsonar.estimation.image.flow import Flow
from mitsonar.geometry.ground import GroundGeometry
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator
from mitsonar.worlds.families import FlatObjects

UNITS = np.array([1e3, 1e3, 180 / np.pi])
START = Pose(0.3, -3.5, 2.5, np.radians(35), 0, 0.4)
CELL = 0.02
"""Cells of the painted ground [m]."""


def ground(seed: int) -> NDArray[np.float64]:
    """Reflectivity of 20 x 20 m, even in 0.2..0.5, correlated over some 4 cm; x = y = 0 is the middle of the array."""
    values = np.random.default_rng(seed).uniform(0, 1, (1000, 1000))
    smooth = ndimage.gaussian_filter(values, 2)
    return np.asarray(0.2 + 0.3 * special.ndtr((smooth - smooth.mean()) / smooth.std()))


def painted(
    motion: Motion, sonar: Sonar, seeds: tuple[int, int] = (1, 1), pose: Pose = START, lean: ArrayLike = 0.0
) -> SonarFrames:
    """Two frames, the motion apart, of painted level ground: each cell shows its ground point, without any ray tracing.

    The pose of the second changes by ``lean``, too.
    """
    poses = np.array([pose, compose(pose, motion)])
    poses[1] += lean
    images = []
    for seed, (x, y, height, pitch, roll, heading) in zip(seeds, poses, strict=True):
        aside, ahead = np.moveaxis(
            GroundGeometry(sonar.range_m, sonar.bearing_rad, sonar.bearing, height, pitch, roll).points, -1, 0
        )
        east = x + aside * np.cos(heading) + ahead * np.sin(heading)
        north = y - aside * np.sin(heading) + ahead * np.cos(heading)
        place = [np.nan_to_num(axis) / CELL + 500 for axis in (north, east)]
        images.append(np.where(np.isnan(east), 0, ndimage.map_coordinates(ground(seed), place, order=1)))
    return SonarFrames(
        np.array(images, np.float32), sonar.range_m, sonar.bearing_rad, np.array([0.0, 0.1]), sonar, poses, poses[:, 2]
    )


def changed(frames: SonarFrames, **fields: object) -> SonarFrames:
    """The frames with some fields replaced."""
    return SonarFrames(**{**vars(frames), **fields})


def noisy(frames: SonarFrames, noise: str, seed: int = 1) -> SonarFrames:
    """The frames with noise."""
    return changed(frames, image=NOISE_MODELS[noise].apply(frames.image, seed=seed, frames=np.arange(2)))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("size", essence([-5.0, -1.0, -0.3, 0.3, 1.0, 5.0], -0.3, 5.0))
def test_sign_and_size_of_each_axis(axis: int, size: float) -> None:
    """Motions of 6 to 100 mm and 0.12 to 2 deg along one axis."""
    motion = np.zeros(3)
    motion[axis] = size * np.array([0.02, 0.02, np.radians(0.4)])[axis]
    result = Flow(relief_m=0).estimate(painted(Motion(*motion), Sonar()))
    error = (np.array(result.motion) - motion) * UNITS
    assert result.valid, result.reason
    assert (np.abs(error) < [0.3, 0.1, 0.01]).all(), f"mm, mm, deg: {error}"


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
@pytest.mark.parametrize("match", ["map", "vector"])
@pytest.mark.parametrize("signs", essence([((1, 1, 1),), ((-1, 1, -1),), ((1, -1, -1),)], ((-1, 1, -1),)))
def test_all_three_at_once_for_both_bearings_and_matches(
    bearing: str, match: Literal["map", "vector"], signs: tuple[int, int, int]
) -> None:
    motion = np.array(signs) * [0.1, 0.1, np.radians(2)]
    sonar = Sonar.create(bearing=bearing, beam_layout="sine" if bearing == "cone" else "even")
    result = Flow(match=match, relief_m=0).estimate(painted(Motion(*motion), sonar))
    error = (np.array(result.motion) - motion) * UNITS
    assert result.valid, result.reason
    assert (np.abs(error) < [1.0, 0.3, 0.03]).all(), f"mm, mm, deg: {error}"


@pytest.mark.thorough
def test_covariance_says_the_errors_that_noise_makes() -> None:
    """The errors of ten noisy pairs, over the stated deviations, are of order one on each axis."""
    motion = np.array([0.012, -0.015, np.radians(0.3)])
    frames = painted(Motion(*motion), Sonar())
    over = []
    for seed in range(10):
        result = Flow(relief_m=0).estimate(noisy(frames, "high", seed))
        assert result.valid, result.reason
        assert result.covariance is not None
        over.append((np.array(result.motion) - motion) / np.sqrt(np.diag(result.covariance)))
    rms = np.sqrt(np.mean(np.square(over), axis=0))
    assert ((rms > 0.3) & (rms < 2.0)).all(), rms


@pytest.mark.parametrize(("axis", "change"), [(2, 0.01), (4, np.radians(0.4))])
def test_heave_and_roll_that_no_sensor_tells_are_further_unknowns(axis: int, change: float) -> None:
    """They look like 6 mm forwards, and like 9 mm aside with a yaw of 0.15 deg, unless the match may estimate them."""
    lean = np.zeros(6)
    lean[axis] = change
    motion, sonar = Motion(0.02, 0.02, 0.0), Sonar()
    frames, level = painted(motion, sonar, lean=lean), painted(motion, sonar)
    estimator = Flow(height_m=2.5, pitch_rad=START.pitch, relief_m=0)
    known = estimator.estimate(frames)
    wrong, unknown = (estimator.estimate(changed(frames, poses=poses)) for poses in (level.poses, None))
    assert known.covariance is not None
    assert unknown.covariance is not None
    error, corrected = (np.array(one.motion) - motion for one in (wrong, unknown))
    assert np.abs(error[:2]).max() > 4e-3
    assert np.abs(corrected[:2]).max() < np.abs(error[:2]).max() / 4
    assert corrected @ np.linalg.solve(unknown.covariance, corrected) < 6
    assert np.linalg.det(unknown.covariance) > np.linalg.det(known.covariance)
    if axis == 4:
        ground = GroundGeometry(frames.range_m, frames.bearing_rad, "azimuth", 2.5, START.pitch)
        of_networks = ground.motion_per_attitude(12, np.radians(7))[:, 2] * change  # which do not estimate it
        np.testing.assert_allclose(of_networks[[0, 2]], error[[0, 2]], rtol=0.4)


def test_height_is_a_further_unknown() -> None:
    """A height 6 % too large makes forward motion wrong; less so where height_std lets the match find it, at the price of a
    larger covariance where the height was right."""
    motion = Motion(0.0, 0.06, 0.0)
    frames = painted(motion, Sonar())
    stored, free = (Flow(height_m=2.65, relief_m=0, height_std=std).estimate(frames) for std in (0.0, 0.05))
    errors = [abs(result.motion.forward - motion.forward) * 1e3 for result in (stored, free)]
    assert errors[0] > 1.0
    assert errors[1] < 0.5 * errors[0]
    stored, free = (Flow(relief_m=0, height_std=std).estimate(noisy(frames, "high")) for std in (0.0, 0.05))
    assert stored.covariance is not None
    assert free.covariance is not None
    assert free.covariance[1, 1] > stored.covariance[1, 1]


@pytest.mark.thorough
def test_nothing_to_match_is_not_believed() -> None:
    """Blank frames, even frames, noise alone, frames of two places, one object on black: no confident wrong answer."""
    frames = painted(Motion(0.01, 0.01, 0.0), Sonar())
    blank = changed(frames, image=np.zeros_like(frames.image))
    even = changed(frames, image=np.full_like(frames.image, 0.5))
    elsewhere = painted(Motion(0.01, 0.01, 0.0), Sonar(), seeds=(1, 2))
    one = np.zeros_like(frames.image)
    one[0, 250:270, 45:50] = one[1, 246:266, 45:50] = 0.8
    wrong = {
        "blank": blank,
        "even": even,
        "noise": noisy(blank, "high"),
        "even, noise": noisy(even, "high"),
        "two places": elsewhere,
        "two places, noise": noisy(elsewhere, "high"),
        "one object": changed(frames, image=one),
        "one object, noise": noisy(changed(frames, image=one), "low"),
    }
    for match in ("map", "vector"):
        valid = [name for name, pair in wrong.items() if Flow(match=match).estimate(pair).valid]
        assert not valid, f"{match}: {valid}"


@pytest.mark.parametrize("geometry", [{"height_m": 1.2}, {"height_m": 6.0}, {"pitch_rad": 0.2}, {"pitch_rad": 1.1}])
def test_badly_wrong_geometry_is_not_believed(geometry: dict[str, Any]) -> None:
    result = Flow(**geometry).estimate(painted(Motion(0.01, 0.02, 0.005), Sonar()))
    assert not result.valid


def test_what_is_missing_or_wrong_is_said() -> None:
    frames = painted(Motion(0, 0, 0), Sonar(beams=24, range_bins=64))
    with pytest.raises(MitsonarError, match="flow needs height and pitch"):
        Flow().estimate(changed(frames, poses=None, height_m=None))
    with pytest.raises(MitsonarError, match="height must be above 0: got -1 m"):
        Flow(height_m=-1)
    with pytest.raises(MitsonarError, match="match must be map or vector: got 'grid'"):
        Flow(match="grid")  # type: ignore[arg-type]  # what the type forbids is tested
    with pytest.raises(MitsonarError, match="height_std must be 0 or more"):
        Flow(height_std=-0.1)
    with pytest.raises(MitsonarError, match="takes two frames: got 1"):
        Flow().estimate(frames.select(slice(0, 1)))
    assert np.allclose(Flow(height_m=2.5, pitch_rad=START.pitch).estimate(changed(frames, poses=None)).motion, 0, atol=1e-4)


@pytest.fixture(scope="module")
def simulator(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Simulator:
    """Flat objects: no relief, so that the geometry is exact."""
    folder = tmp_path_factory.mktemp("flat") / "world"
    scene = load_scene(FlatObjects(size_m=16, objects=(150, 150), seabed_cells=400).build(2).write(folder))
    return Simulator(scene, Sonar(rays_per_beam=300, rays_across=2))


@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("noise", ["none", "high"])
def test_rendered_frames(simulator: Simulator, noise: str) -> None:
    """A second route to the known motion: traced rays instead of painted cells."""
    motion = Motion(0.015, -0.012, np.radians(0.4))
    poses = Trajectory(np.array([START, compose(START, motion)]), np.array([0.0, 0.1]))
    result = Flow().estimate(simulator.render(poses, noise=NOISE_MODELS[noise], seed=3))
    error = (np.array(result.motion) - motion) * UNITS
    allowed = {"none": [3.0, 1.0, 0.07], "high": [6.0, 2.0, 0.12]}[noise]
    assert result.valid, result.reason
    assert (np.abs(error) < allowed).all(), f"{noise}, mm, mm, deg: {error}"


@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
@pytest.mark.usefixtures("variant")
def test_rendered_frames_of_two_places_are_not_believed(simulator: Simulator) -> None:
    apart = np.array([START, compose(START, Motion(2.0, 0, 1.0))])
    assert not Flow().estimate(simulator.render(Trajectory(apart, np.array([0.0, 0.1])))).valid
