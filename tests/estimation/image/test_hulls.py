"""A grazing look at a hull: its outline of light must not hold motions back, and noise must not drive them off."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.estimation.named import create_estimator
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator
from mitsonar.worlds.families import ShipHull

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.usefixtures("variant"),
    pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning"),
]

UNITS = np.array([1e3, 1e3, 180 / np.pi])
START = Pose(3.0, -4.0, 0.32, np.radians(4), 0.0, 2.8)
MOTION = Motion(-0.012, 0.018, np.radians(0.3))


@pytest.fixture(scope="module")
def hull(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Simulator:
    """A plate with tubes and anodes, 0.32 m below the sonar."""
    scene = load_scene(ShipHull(size_m=16).build(5).write(tmp_path_factory.mktemp("hull") / "world"))
    return Simulator(scene, Sonar(model="physical", range_min=1.5, range_max=5.0, rays_per_beam=200, rays_across=8))


@pytest.mark.parametrize("noise", ["none", "low"])
@pytest.mark.parametrize("method", ["direct", pytest.param("corrnet", marks=pytest.mark.learn)])
def test_the_outline_of_the_light_holds_nothing_back(hull: Simulator, method: str, noise: str) -> None:
    """It moves with the sonar: matched, it took 2.2 mm off this motion of corrnet in low noise (squared error 28)."""
    poses = Trajectory(np.array([START, compose(START, MOTION)]), np.array([0.0, 0.1]))
    result = create_estimator(method).estimate(hull.render(poses, noise=NOISE_MODELS[noise], seed=3))
    error = (np.array(result.motion) - MOTION) * UNITS
    assert result.valid, result.reason
    assert abs(error[1]) < 1.8, f"mm, mm, deg: {error}"
    assert result.covariance is not None
    assert error @ np.linalg.solve(result.covariance * np.outer(UNITS, UNITS), error) < 21.1, f"mm, mm, deg: {error}"
