"""The shipped PoseNet: motions over worlds that it has not seen, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mitsonar.config.data import load_recipe
from mitsonar.datasets.make import make_dataset
from mitsonar.errors import MitsonarError
from mitsonar.motion.errors import in_units

torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
pytestmark = [pytest.mark.learn, pytest.mark.usefixtures("variant")]

from mitsonar.datasets.samples import SonarPairs  # noqa: E402
from mitsonar.estimation.named import create_estimator  # noqa: E402
from mitsonar.networks.checkpoint import Checkpoint  # noqa: E402

UNSEEN, GAIN = 730_022, 0.0462
"""A seed that no training has, and the gain of its data set: a sonar has one."""


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> SonarPairs:
    """Two worlds of twelve pairs."""
    path = tmp_path_factory.mktemp("unseen") / "unseen.zarr"
    scenes = [{"count": 2, "sequences": 12, "world": {"size_m": 30}}]
    fields = {"scenes": scenes, "flight.pings": 2, "seed": UNSEEN, "gain": GAIN}
    make_dataset(load_recipe("rocky-field", fields), str(path))
    return SonarPairs(path, part="all")


@pytest.mark.thorough
def test_it_knows_motions_over_worlds_that_it_has_not_seen(pairs: SonarPairs) -> None:
    """Within twice the errors that its file promises; the covariance is that of these."""
    network = create_estimator("posenet")
    result = [network.estimate(pairs.sonar_frames(k)) for k in range(len(pairs))]
    assert all(one.valid for one in result), [one.reason for one in result]
    truth = np.array([pairs.target(k) for k in range(len(pairs))])
    rmse = np.sqrt((in_units(np.array([one.motion for one in result]) - truth) ** 2).mean(axis=0))
    promised = np.array(Checkpoint.load("posenet").metrics["none"]["rmse"])
    assert (promised < [2.5, 0.8, 0.045]).all()
    assert (rmse < 2 * promised).all(), rmse
    covariance = result[0].covariance
    assert covariance is not None
    np.testing.assert_allclose(in_units(np.sqrt(np.diag(covariance))), promised)


@pytest.mark.thorough
def test_it_refuses_what_it_has_not_learnt(pairs: SonarPairs) -> None:
    """Another sonar is an error; another height or pitch makes an estimate invalid."""
    network, frames = create_estimator("posenet"), pairs.sonar_frames(0)
    assert frames.poses is not None
    assert frames.height_m is not None
    higher, steeper = frames.poses.copy(), frames.poses.copy()
    higher[:, 2] += 1.0
    steeper[:, 3] += np.radians(5)
    inverted = frames.poses.copy()
    inverted[:, 4] = np.radians([179.9, -179.9])  # whose mean is not 0
    for changed in (
        replace(frames, poses=higher, height_m=frames.height_m + 1.0),
        replace(frames, poses=steeper),
        replace(frames, poses=inverted),
    ):
        result = network.estimate(changed)
        assert not result.valid
        assert "height 2.5 m, pitch 35 deg are fixed by training" in result.reason
    with pytest.raises(MitsonarError, match=r"trained on the sonar .* window"):
        network.estimate(replace(frames, range_m=frames.range_m + 1.0))


@pytest.mark.thorough
def test_one_that_was_trained_with_noise_knows_motions_in_noise(pairs: SonarPairs) -> None:
    noisy = SonarPairs(pairs.store.place.url, part="all", noise="high")
    truth = np.array([noisy.target(k) for k in range(len(noisy))])
    rmse = {}
    for name in ("posenet", "posenet-noise"):
        network = create_estimator(name)
        result = [network.estimate(noisy.sonar_frames(k)).motion for k in range(len(noisy))]
        rmse[name] = np.sqrt((in_units(np.array(result) - truth) ** 2).mean(axis=0))
    promised = np.array(Checkpoint.load("posenet-noise").metrics["high"]["rmse"])
    assert (promised < [3.6, 1.5, 0.07]).all()  # Almanza-Medina, table 3.3, by pair: 3.63 / 1.50 / 0.070
    assert (rmse["posenet-noise"] < 2 * promised).all(), rmse
    assert (rmse["posenet-noise"] < rmse["posenet"]).all(), rmse
