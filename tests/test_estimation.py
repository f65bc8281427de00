"""Estimators: signs and sizes of known motions, honest covariances, and no confident answer where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.estimation.direct import Direct
from mitsonar.estimation.estimators import create_estimator
from mitsonar.estimation.zero import Zero
from mitsonar.frames import SonarFrames
from mitsonar.motion import Motion, Pose, Trajectory, compose
from mitsonar.noise import NOISE_MODELS
from mitsonar.simulation.imaging import Simulator
from mitsonar.simulation.scenes import load_scene
from mitsonar.simulation.worlds.flat_objects import FlatObjects
from mitsonar.sonar import Sonar

pytestmark = pytest.mark.usefixtures("variant")

START = Pose(0.3, -3.5, 2.5, np.radians(35), 0, 0.4)
UNITS = np.array([1e3, 1e3, 180 / np.pi])


@pytest.fixture(scope="module")
def simulator(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Simulator:
    """Flat objects: no relief, so that the geometry is exact."""
    folder = tmp_path_factory.mktemp("flat") / "world"
    scene = load_scene(FlatObjects(size_m=16, objects=(150, 150), seabed_cells=400).build(2).write(folder))
    return Simulator(scene, Sonar(rays_per_beam=300, rays_across=4))


def pair(simulator: Simulator, motion: Motion, noise: str = "none") -> SonarFrames:
    """Two frames, the motion apart."""
    second = compose(START, motion)
    poses = Trajectory(np.array([START, second]), np.array([0.0, 0.1]))
    return simulator.render(poses, noise=NOISE_MODELS[noise], seed=3)


@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
def test_direct_has_the_sign_and_size_of_each_axis(simulator: Simulator, axis: int, sign: int, size: float) -> None:
    """Motions of 6 to 60 mm and 0.15 to 1.5 deg along one axis.

    Large plates of one reflectivity, whose brightness belongs to the range and not to the ground: they hold estimates back.
    """
    motion = np.zeros(3)
    motion[axis] = sign * size * np.array([0.02, 0.02, np.radians(0.5)])[axis]
    found = Direct().estimate(pair(simulator, Motion(*motion)))
    error = (np.array(found.motion) - motion) * UNITS
    assert found.believe, found.reason
    assert (np.abs(error) < [3.0, 1.0, 0.07]).all(), f"mm, mm, deg: {error}"


@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
def test_direct_with_all_three_at_once_and_noise(simulator: Simulator) -> None:
    motion = Motion(0.015, -0.012, np.radians(0.4))
    for noise, allowed in (("none", [3.0, 1.0, 0.07]), ("high", [6.0, 2.0, 0.12])):
        found = Direct().estimate(pair(simulator, motion, noise))
        error = (np.array(found.motion) - motion) * UNITS
        assert found.believe, found.reason
        assert (np.abs(error) < allowed).all(), f"{noise}, mm, mm, deg: {error}"
        assert found.covariance is not None
        assert (np.linalg.eigvalsh(found.covariance) > 0).all()


@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
def test_nothing_to_match_is_not_believed(simulator: Simulator) -> None:
    """A blank frame, noise alone, and frames of two different places."""
    frames = pair(simulator, Motion(0, 0, 0))
    blank = SonarFrames(**{**vars(frames), "image": np.zeros_like(frames.image)})
    assert not Direct().estimate(blank).believe
    noise = NOISE_MODELS["high"].apply(blank.image, seed=1, frames=np.arange(2))
    assert not Direct().estimate(SonarFrames(**{**vars(frames), "image": noise})).believe
    elsewhere = simulator.render(Trajectory(np.array([START, compose(START, Motion(2.0, 0, 1.0))]), np.array([0.0, 0.1])))
    assert not Direct().estimate(elsewhere).believe


def test_what_is_missing_is_said() -> None:
    sonar = Sonar(beams=8, range_bins=16)
    bare = SonarFrames(np.zeros((2, 16, 8), np.float32), sonar.range_m, sonar.bearing_rad, np.arange(2.0), sonar)
    with pytest.raises(MitsonarError, match="needs height and pitch"):
        Direct().estimate(bare)
    with pytest.raises(MitsonarError, match="takes two frames: got 1"):
        Zero().estimate(bare.select(slice(0, 1)))
    with pytest.raises(MitsonarError, match="did you mean direct"):
        create_estimator("dierct")
    with pytest.raises(MitsonarError, match="estimator direct"):
        create_estimator("direct", heigth_m=2)
    assert create_estimator("zero").estimate(bare).motion == Motion(0, 0, 0)
