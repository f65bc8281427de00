"""What a network's covariances know of the height: closed forms by the geometry at two heights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers import lit_plane

from mitsonar.datasets.samples import ground_at
from mitsonar.estimation.named import create_estimator
from mitsonar.geometry.ground import STD_MEASURED, Attitude
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import Motion

pytest.importorskip("torch")
image_network = pytest.importorskip("mitsonar.estimation.learned")

pytestmark = [pytest.mark.learn, pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

HEIGHT_M, PITCH_RAD = 2.5, np.radians(35)
SONAR = Sonar(range_bins=256)
MOTION = Motion(0.02, -0.012, np.radians(0.4))
COHERENT = {"model": "coherent", "frequency_hz": 1.8e6}


def test_other_heights_explain_the_same_shifts_by_other_motions() -> None:
    """Shifts from one height, solved at heights 1 % lower and higher, by least squares over all nodes."""
    low, here, high = (
        ground_at(SONAR.range_m, SONAR.bearing_rad, "azimuth", part * HEIGHT_M, PITCH_RAD) for part in (0.99, 1.0, 1.01)
    )
    shifts = np.tensordot(np.array(MOTION), here["derivative"], axes=(0, 1)).ravel()
    lower, higher = (
        np.linalg.lstsq(np.moveaxis(one["derivative"], 1, -1).reshape(-1, 3), shifts, rcond=None)[0] for one in (low, high)
    )
    result = image_network._by_height(image_network._batch(here), MOTION)
    np.testing.assert_allclose(result, (higher - lower) / 0.02, rtol=0.02, atol=1e-5)
    assert result[1] / MOTION.forward > 0.2, "a sonar that looks down by 35 deg scales forward motions by the height"


def test_heights_less_certain_than_in_training_join_the_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Variances add: what is beyond training is twice as much at the root of 7 times its standard deviation as at twice."""
    frames, _, _ = lit_plane(Sonar(), HEIGHT_M, PITCH_RAD)
    frames = replace(frames, image=np.stack([frames.image[0], np.roll(frames.image[0], -3, axis=0)]))
    result = []
    for part in (1.0, 2.0, 7**0.5):
        told = Attitude(HEIGHT_M, part * STD_MEASURED * HEIGHT_M, PITCH_RAD)
        monkeypatch.setattr(image_network, "attitude_of", lambda *_, told=told: told)
        result.append(create_estimator("corrnet").estimate(frames))
    as_trained, twice, more = (one.covariance for one in result)
    assert as_trained is not None
    assert twice is not None
    assert more is not None
    assert result[0].motion == result[1].motion == result[2].motion
    np.testing.assert_allclose(more - as_trained, 2 * (twice - as_trained), rtol=1e-6)
    assert np.linalg.matrix_rank(twice - as_trained, tol=1e-6 * np.abs(twice - as_trained).max()) == 1
    by_forward = abs(result[0].motion.forward) * 0.2 * STD_MEASURED
    assert twice[1, 1] - as_trained[1, 1] > 3 * by_forward**2


@pytest.mark.parametrize(
    ("changes", "method", "told"),
    [
        ({}, "corrnet", ""),
        (COHERENT, "corrnet", "corrnet was not trained for speckle"),
        (COHERENT, "corrnet-coherent", ""),
        ({"azimuth_fov_deg": 60.0}, "corrnet-coherent", "corrnet was not trained for a fan of 60 deg (but 29)"),
        ({**COHERENT, "azimuth_fov_deg": 60.0}, "corrnet", "for speckle or a fan of 60 deg (but 29)"),
    ],
)
def test_what_a_network_was_not_trained_for_is_told(changes: dict[str, Any], method: str, told: str) -> None:
    """By texture and fan."""
    frames, _, _ = lit_plane(Sonar(range_bins=256, model="physical"), HEIGHT_M, PITCH_RAD)
    sonar = frames.sonar.replace(**changes)
    frames = replace(frames, sonar=sonar, bearing_rad=sonar.bearing_rad, time_s=np.array([0.0, 0.1]))
    assert told in create_estimator(method).estimate(frames).about.get("untrained", "")
    assert ("untrained" in create_estimator(method).estimate(frames).about) == bool(told)
