"""`direct6`: poses and motions in a known scene, near the bound where it can be, and as assumed where it cannot."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers import Array, box, diffuse, floor, scene, sphere
from scipy import ndimage

from mitsonar.acoustics.noise import NOISE_MODELS, expected_values
from mitsonar.errors import MitsonarError
from mitsonar.estimation.crlb.image import bounds_at
from mitsonar.estimation.image.direct6 import Direct6, _Linearised
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.composition import DEGREES, MotionStd, compose_six, six_between
from mitsonar.motion.pose import Pose
from mitsonar.records.frames import to_uint8

if TYPE_CHECKING:
    from mitsonar.simulation.simulator import Simulator

LOW, SIX = NOISE_MODELS["low"], tuple(DEGREES)
SONAR = Sonar(beams=24, range_bins=128, rays_per_beam=100, rays_across=4, range_min=3.6, range_max=5.6, model="physical")
POSE = Pose.from_degrees([0.3, -0.2, 2.5, 35, 0, 20])
START = MotionStd(0.01, float(np.radians(0.5)))


@lru_cache(maxsize=2)
def source(even: bool = False) -> tuple[Simulator, float]:
    """A floor of blotches of 50 mm with a stone and a block, or an even one; and the gain of its frames."""
    import mitsuba as mi

    from mitsonar.simulation.simulator import Simulator

    grain = ndimage.gaussian_filter(np.random.default_rng(5).random((1000, 1000)), 1.2, mode="wrap")
    picture = mi.Bitmap(np.clip(0.5 + (grain - 0.5) * 3, 0.02, 1).astype(np.float32)[..., None])
    blotches = {"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}
    objects: dict[str, Any] = {
        "stone": sphere([1.4, 3.0, 0.0], 0.15, diffuse(0.6)),
        "block": box([2.0, 3.2, 0.0], [0.2, 0.1, 0.1], diffuse(0.5)),
    }
    shapes = {"floor": floor()} if even else {"floor": floor(diffuse(blotches), 10.0), **objects}
    simulator = Simulator(scene(**shapes), SONAR.replace(jitter=True))
    return simulator, 0.6 / float(np.percentile(next(simulator.pings([POSE])).levels, 95))


def frame(number: int, pose: Pose = POSE, even: bool = False, pings: int = 1) -> Array:
    """The mean of some pings with noise, in grey values."""
    simulator, gain = source(even)
    levels = np.concatenate([batch.levels for batch in simulator.pings([pose] * pings, first=pings * (1000 + number))])
    echo = np.minimum(levels * np.float32(gain), np.float32(1)).mean(axis=0, keepdims=True)
    image = LOW.apply(echo, seed=5, frames=np.array([number]))
    return np.asarray(to_uint8(image)[0] / 255)


def near(pose: Pose, seed: int) -> Pose:
    return compose_six(pose, np.random.default_rng(seed).normal(size=6) * START.of(SIX))


def test_means_of_noisy_pixels_are_those_of_draws() -> None:
    for noise in NOISE_MODELS.values():
        for level in (0.02, 0.5, 0.97):
            image = np.full((4, 200, 200), level, np.float32)
            image[:, ::4] = 0  # three of four pixels hold an echo
            drawn = to_uint8(noise.apply(image, seed=3, frames=np.arange(4))) / 255
            expected = float(expected_values(noise, 0.75 * level, 0.75))
            tolerance = 5 * drawn.std() / np.sqrt(drawn.size) + (0.5 / 255 if noise.is_none else 0)
            assert abs(drawn.mean() - expected) < tolerance, (noise, level)


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_a_pose_and_a_motion_come_back() -> None:
    simulator, gain = source()
    estimator = Direct6(simulator, gain, LOW, START, pings=12)
    motion = np.array([0.03, 0.05, -0.02, 0.01, -0.02, 0.03])
    after = compose_six(POSE, motion)
    result = estimator.motion(np.stack([frame(1), frame(2, after)]), (near(POSE, 1), near(after, 2)))
    assert result.valid, result.reason
    assert (np.abs(result.motion - motion) < 4 * result.std).all(), (result.motion - motion) / result.std
    assert (result.std < 0.5 * np.sqrt(2) * START.of(SIX)).all()
    assert all(0.6 < one.misfit < 1.4 and one.observability.observable == 6 for one in result.poses)
    # the covariance is that of both poses, and little more where the motion is small
    both = sum(one.covariance for one in result.poses)
    np.testing.assert_allclose(np.diag(result.covariance), np.diag(both), rtol=0.2)


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_errors_are_those_of_the_bound() -> None:
    """Frames without the noise of rays: root mean square errors are near the bound, and no less, but for scatter."""
    simulator, gain = source()
    bounds = next(bounds_at(simulator, [POSE], LOW, gain, pings=32, degrees=SIX))
    prior = np.diag(1 / START.of(SIX) ** 2)
    information = bounds["image", "image", "gaussian"].information  # type: ignore[union-attr]
    least = np.sqrt(np.diag(np.linalg.inv(information + prior)))
    estimator = Direct6(simulator, gain, LOW, START, pings=24, ray_noise=False)
    errors = np.array([six_between(POSE, estimator.register(frame(k, pings=32), near(POSE, k)).pose) for k in range(8)])
    rmse = np.sqrt(np.mean(errors**2, axis=0))
    assert (rmse < 1.75 * least).all(), rmse / least  # 1.5, and the scatter of eight errors
    assert (rmse / least).mean() > 0.7, rmse / least
    assert (least < 0.4 * START.of(SIX)).all()  # the assumed pose hardly helps


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_what_a_frame_does_not_show_stays_as_assumed() -> None:
    """Over an even floor: height and attitude are found, position and heading keep their assumed values and variances."""
    simulator, gain = source(even=True)
    start = near(POSE, 3)
    result = Direct6(simulator, gain, LOW, START, pings=8).register(frame(1, even=True), start)
    assert result.valid, result.reason
    assert result.observability.unobservable == ("sideways", "forward", "yaw")
    hidden, shown = [0, 1, 5], [2, 3, 4]
    np.testing.assert_allclose(result.std[hidden], START.of(SIX)[hidden], rtol=1e-2)
    assert (np.abs(six_between(start, result.pose)) < 0.05 * START.of(SIX))[hidden].all()
    error = six_between(POSE, result.pose)
    assert (np.abs(error) < 4 * result.std)[shown].all(), error / result.std
    assert (result.std < 0.2 * START.of(SIX))[shown].all()


@pytest.mark.usefixtures("variant")
def test_information_within_its_noise_counts_for_nothing() -> None:
    bound: Any = SimpleNamespace(directions=lambda _scale: (np.array([100.0] * 5 + [900.0]), np.eye(6), 150.0))
    covariance = _Linearised(bound, np.zeros(6), 1.0).covariance(START)
    expected = np.square(START.of(SIX)) * np.array([1.0] * 5 + [1 / 901])
    np.testing.assert_allclose(covariance, np.diag(expected))


@pytest.mark.thorough
def test_frames_of_another_place_and_wrong_arguments_are_refused() -> None:
    simulator, gain = source()
    estimator = Direct6(simulator, gain, LOW, START, pings=4)
    elsewhere = estimator.register(frame(1, Pose.from_degrees([-3, 2, 2.5, 35, 0, -60])), POSE)
    assert "differs from the scene" in elsewhere.reason
    nothing = estimator.register(frame(1), Pose.from_degrees([0, 0, 2.5, -60, 0, 0]))
    assert "nothing that the assumed pose does not" in nothing.reason
    np.testing.assert_allclose(nothing.std, START.of(SIX))
    for image, words in (
        (np.zeros((128, 23)), "128 bins and 24 beams"),
        (np.full((128, 24), np.nan), "finite"),
        (np.full((128, 24), 200.0), "divide grey values by 255"),
    ):
        with pytest.raises(MitsonarError, match=words):
            estimator.register(image, POSE)
    with pytest.raises(MitsonarError, match="two frames: got 1"):
        estimator.motion(np.zeros((1, 128, 24)), (POSE, POSE))
    for fields, words in (({"gain": 0.0}, "gain above 0"), ({"pings": 0}, "pings of 1 or more")):
        with pytest.raises(MitsonarError, match=words):
            Direct6(**{"simulator": simulator, "gain": gain, **fields})  # type: ignore[arg-type]
    from mitsonar.simulation.simulator import Simulator

    grainy = Sonar.create(model="coherent", frequency_hz=1.8e6, beams=12, azimuth_fov_deg=3.6, beam_width_deg=0.3)
    with pytest.raises(MitsonarError, match="speckle of the model coherent"):
        Direct6(Simulator(simulator.tracer.scene, grainy), 1.0)
