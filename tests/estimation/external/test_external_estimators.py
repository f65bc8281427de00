"""Other packages as estimators: a known motion is found, an absent package is one sentence, anybody's class works."""

from __future__ import annotations

import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_frames import SONAR
from numpy.typing import NDArray
from scipy import ndimage

from mitsonar.errors import MitsonarError
from mitsonar.estimation.estimator import Estimate
from mitsonar.estimation.external import CfarGicp, ground_pair
from mitsonar.estimation.named import EXTERNAL, create_estimator
from mitsonar.geometry.ground import GroundGeometry, moved
from mitsonar.mapping.odometry import OdometryOptions, odometry
from mitsonar.motion.composition import Motion, MotionPrior, compose
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames

START = Pose.from_degrees([1.0, -2.0, 2.5, 35, 0, 40])
UNITS = np.array([1e3, 1e3, 180 / np.pi])
MODULES = {"cfar-gicp": "small_gicp", "fourier-mellin": "fourier_mellin", "stackreg": "pystackreg"}

ALLOWED = {"cfar-gicp": [25.0, 8.0, 0.5], "fourier-mellin": [25.0, 8.0, 0.5], "stackreg": [2.0, 2.0, 0.05]}
"""Errors on drawn ground in mm, mm, deg. A beam is 23 mm wide, which is as well as a detection knows its place."""


@pytest.fixture(scope="module")
def ground() -> NDArray[np.float64]:
    """Ground of fine grain with bright spots: some packages find nothing in what is smooth."""
    rng = np.random.default_rng(7)
    fine = ndimage.gaussian_filter(rng.normal(size=(700, 700)), 1)
    spots = ndimage.gaussian_filter((rng.random((700, 700)) < 0.004).astype(float), 1)
    return np.asarray(np.clip(0.15 + 0.05 * fine / fine.std() + 0.6 * spots / spots.max(), 0, 1))


def pair(ground: NDArray[np.float64], motion: Motion, start: Pose = START) -> SonarFrames:
    """Two frames of that ground, the motion apart, drawn by geometry alone."""
    poses = Trajectory(np.array([start, compose(start, motion)]), np.array([0.0, 0.1]))
    images = []
    for pose in poses.poses:
        seen = GroundGeometry(SONAR.range_m, SONAR.bearing_rad, SONAR.bearing, pose[2], pose[3], pose[4])
        place = moved(seen.points, (0.0, 0.0, -pose[5])) + pose[:2]
        images.append(ndimage.map_coordinates(ground, np.moveaxis(place, -1, 0)[::-1] / 0.02 + 350, order=1))
    image = np.array(images, np.float32)
    return SonarFrames(image, SONAR.range_m, SONAR.bearing_rad, poses.time_s, SONAR, poses.poses, poses.poses[:, 2].copy())


MOTIONS = [
    Motion(0.0, 0.0, 0.0),
    Motion(0.06, 0.0, 0.0),
    Motion(0.0, -0.06, 0.0),
    Motion(0.0, 0.0, 0.03),
    Motion(-0.03, 0.04, -0.02),
]


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("name", EXTERNAL)
def test_a_known_motion_is_found(name: str, motion: Motion, ground: NDArray[np.float64]) -> None:
    pytest.importorskip(MODULES[name])
    result = create_estimator(name).estimate(pair(ground, motion))
    assert result.valid, result.reason
    error = (np.array(result.motion) - motion) * UNITS
    assert (np.abs(error) < ALLOWED[name]).all(), f"{name}: {error} mm, mm, deg"


@pytest.mark.parametrize("name", EXTERNAL)
def test_empty_frames_are_rejected(name: str, ground: NDArray[np.float64]) -> None:
    pytest.importorskip(MODULES[name])
    frames = pair(ground, Motion(0.0, 0.0, 0.0))
    result = create_estimator(name).estimate(replace(frames, image=np.zeros_like(frames.image)))
    assert not result.valid
    assert result.reason


def test_a_prior_begins_the_registration_of_points(ground: NDArray[np.float64]) -> None:
    """A motion of 0.8 m lies beyond the neighbours of a point; from a prior nearby it is found."""
    pytest.importorskip("small_gicp")
    far = Motion(0.0, 0.8, 0.0)
    estimator, frames = CfarGicp(), pair(ground, far)
    prior = MotionPrior(Motion(0.02, 0.78, 0.0), np.eye(3))
    assert abs(estimator.estimate(frames).motion.forward - 0.8) > 0.1
    assert abs(estimator.estimate(frames, prior=prior).motion.forward - 0.8) < 0.02


@pytest.mark.parametrize("name", EXTERNAL)
def test_an_absent_package_is_one_sentence(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, MODULES[name], None)
    with pytest.raises(MitsonarError, match=r"which is not installed: pip install"):
        create_estimator(name)


def test_pictures_hold_nothing_but_the_fan(ground: NDArray[np.float64]) -> None:
    """The rectangle lies inside; its warp is that of the whole view, about another corner."""
    result = ground_pair(pair(ground, Motion(0.0, 0.0, 0.0)), "it")
    column, row = result.corner
    rows, columns = result.first.shape
    assert result.view.inside[row : row + rows, column : column + columns].all()
    motion = Motion(0.02, -0.01, 0.03)
    whole = result.view.warp(motion).astype(float)
    cut = whole.copy()
    cut[:, 2] += whole[:, :2] @ result.corner - result.corner
    np.testing.assert_allclose(result.motion(cut), motion, atol=1e-6)
    assert result.estimate(cut).valid
    apart = cut + np.array([[0, 0, 0.6 * columns], [0, 0, 0]])
    assert "overlap by less than half" in result.estimate(apart).reason


# ---------------------------------------------------------------- anybody's class

MINE = '''
from mitsonar.estimation.estimator import Estimate
from mitsonar.motion.composition import Motion

class Fixed:
    """Always the same motion."""
    def estimate(self, frames):
        return Estimate(Motion(0.01 * len(frames), 0.0, 0.0))

class Biased:
    """Answers by its options, and where it is told to begin."""
    def __init__(self, key=1, name="", wide_rad=0.0):
        self.key, self.name = key, name
    def estimate(self, frames, prior=None):
        start = 0.0 if prior is None else prior.motion.forward
        return Estimate(Motion(self.key, start, 0.0), reason=self.name)

class Demanding:
    def estimate(self, frames, other):
        pass

class Failing:
    def estimate(self, frames):
        return frames.weights

class Bare:
    def estimate(self, frames):
        return 0.01, 0.0, 0.0

class Other:
    pass

class Unpicklable(Fixed):
    def __init__(self):
        self.answer = lambda: None

class KeyMissing(Fixed):
    def __init__(self):
        {}["weights"]

class AttributeMissing(Fixed):
    def __init__(self):
        self.weights

class Needy(Fixed):
    def __init__(self, weights):
        pass
'''


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_module.py").write_text(MINE)
    (tmp_path / "broken_module.py").write_text("nothing_of_this_name")
    (tmp_path / "moving_module.py").write_text(f"import os\nos.chdir('..')\n{MINE}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "my_module", raising=False)


@pytest.mark.usefixtures("mine")
def test_a_class_of_the_users_own_is_an_estimator(ground: NDArray[np.float64]) -> None:
    estimator = create_estimator("my_module:Fixed")
    frames = pair(ground, Motion(0.0, 0.0, 0.0))
    assert estimator.estimate(frames).motion == Motion(0.02, 0.0, 0.0)
    with pytest.raises(MitsonarError, match="my_module:Bare: estimate must return an Estimate: got tuple"):
        create_estimator("my_module:Bare").estimate(frames)


@pytest.mark.parametrize(
    ("covariance", "reason"),
    [
        (np.eye(2), r"must be 3 x 3 or None: got \(2, 2\)"),
        (np.zeros((3, 3)), "variances above 0: got variances 0, 0, 0 m"),
        (np.diag([1e-6, -1e-6, 1e-8]), "variances above 0: got variances 1e-06, -1e-06, 1e-08"),
        (np.diag([1e-6, np.nan, 1e-8]), "finite and symmetric"),
        (np.array([[1.0, 0.5, 0.0], [0.1, 1.0, 0.0], [0.0, 0.0, 1.0]]), "symmetric"),
        (np.diag([1e-6, 1e-6, 1e-9]) + 5e-10 * np.eye(3)[[2, 1, 0]] * [0, 0, 1], "symmetric"),
        (1e-8 * np.ones((3, 3)), "positive definite: components depend on each other"),
    ],
)
def test_a_covariance_that_is_none_is_one_sentence(
    covariance: NDArray[np.float64], reason: str, ground: NDArray[np.float64]
) -> None:
    class Odd:
        def __init__(self, valid: bool) -> None:
            self.valid = valid

        def estimate(self, frames: SonarFrames) -> Estimate:
            return Estimate(Motion(0.0, 0.0, 0.0), covariance, self.valid)

    frames = pair(ground, Motion(0.0, 0.0, 0.0))
    with pytest.raises(MitsonarError, match=reason):
        create_estimator(Odd(valid=True)).estimate(frames)
    if covariance.shape == (3, 3):  # of a rejected motion, which nothing uses
        assert not create_estimator(Odd(valid=False)).estimate(frames).valid


@pytest.mark.usefixtures("mine")
@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("my_module:Missing", "my_module has no Missing"),
        ("my_module:Other", r"has no method estimate\(frames\)"),
        ("no_module_of_this_name:Fixed", "is not a module here: start in its folder, or install it"),
        ("my_module:KeyMissing", r"KeyMissing\(\) raises KeyError \('weights'\)"),
        ("my_module:AttributeMissing", r"AttributeMissing\(\) raises AttributeError \(.* no attribute 'weights'"),
        ("my_module:Needy", r"Needy\(\) raises TypeError \(.*\): it must need no arguments"),
        ("my_module:Biased:kye=5", r"unknown option 'kye': my_module:Biased takes key, name, wide_rad; did you mean key\?"),
        ("my_module:Biased:key", r"is my_module:MyEstimator or my_module:MyEstimator:key=value"),
        ("my_module:Demanding", r"Demanding: estimate\(frames, other\) must take the frames alone, or the frames and"),
        ("broken_module:Fixed", r"broken_module raises NameError \(.*nothing_of_this_name.*\) when it is imported"),
    ],
)
def test_what_is_no_estimator_is_one_sentence(text: str, reason: str) -> None:
    with pytest.raises(MitsonarError, match=reason):
        create_estimator(text)


PRIOR = MotionPrior(Motion(0.0, 0.7, 0.0), np.eye(3))


@pytest.mark.usefixtures("mine")
def test_one_door_for_estimators_of_ones_own(ground: NDArray[np.float64]) -> None:
    """An instance, a class with options, and a text with options; each gets the prior if it takes one, and not if not."""
    frames = pair(ground, Motion(0.0, 0.0, 0.0))
    built = create_estimator("my_module:Biased:key=5:name=mine")
    kind: Any = type(getattr(built, "_wrapped"))  # noqa: B009
    for one in (built, create_estimator(kind(5, "mine")), create_estimator(kind, key=5, name="mine"), kind(5, "mine")):
        result = create_estimator(one).estimate(frames, PRIOR)
        assert result.motion == Motion(5.0, 0.7, 0.0)
        assert result.reason == "mine"
    for text in ("my_module:Fixed", "my_module:Biased:key=0.02"):
        assert odometry(frames, text).estimates[0].motion == Motion(0.02, 0.0, 0.0)
    assert create_estimator("my_module:Fixed").estimate(frames, PRIOR).motion == Motion(0.02, 0.0, 0.0)
    with pytest.raises(MitsonarError, match=r"my_module:Failing: estimate raises AttributeError \(.*weights.*line 2\d"):
        odometry(frames, "my_module:Failing")
    with pytest.raises(MitsonarError, match=r"unknown option 'kye': Biased takes key, name, wide_rad; did you mean key\?"):
        create_estimator(kind, kye=5)
    with pytest.raises(MitsonarError, match="Biased is already an instance and takes no options: got key; give its class"):
        create_estimator(kind(), key=5)
    with pytest.raises(MitsonarError, match=r"int has no method estimate\(frames\)"):
        create_estimator(5)  # type: ignore[arg-type]  # anything may be given


def test_what_cannot_be_sent_to_workers_is_one_sentence(ground: NDArray[np.float64]) -> None:
    class Local:
        def estimate(self, frames: SonarFrames) -> Estimate:
            return Estimate(Motion(0.01, 0.0, 0.0))

    frames = pair(ground, Motion(0.0, 0.0, 0.0))
    assert odometry(frames, Local()).estimates[0].motion.sideways == 0.01
    with pytest.raises(MitsonarError, match=r"Local cannot be sent to another process .*: use one worker, or name it as"):
        odometry(frames, Local, OdometryOptions(workers=2))


@pytest.mark.learn
def test_a_network_of_torch_is_an_estimator(ground: NDArray[np.float64]) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")

    class Means(torch.nn.Module):  # type: ignore[misc, name-defined]  # torch is imported here
        """Labels: the means of both images, and no turn."""

        def forward(self, images: Any) -> Any:
            assert images.shape[:2] == (1, 2)
            assert not self.training
            return torch.stack([images[:, 0].mean(), images[:, 1].mean(), images.new_zeros(())])[None]

    frames = pair(ground, Motion(0.0, 0.05, 0.0))
    network = Means()
    result = odometry(frames, network).estimates[0]
    assert result.motion == pytest.approx([*frames.image.mean(axis=(1, 2)), 0.0], rel=1e-5)
    assert result.covariance is None
    assert network.training, "the user's network stays as it is"
    with pytest.raises(MitsonarError, match="unknown option 'layout': Means takes samples"):
        create_estimator(network, layout="side")
    with pytest.raises(MitsonarError, match=r"must return labels \(batch, 3\): got a tensor of \(1, 2, 128, 96"):
        create_estimator(torch.nn.Identity()).estimate(frames)


@pytest.mark.thorough
@pytest.mark.usefixtures("mine")
def test_a_worker_imports_the_class_again(ground: NDArray[np.float64], tmp_path: Path) -> None:
    """Its search path lacks the folder of the module, as that of the installed command does."""
    assert not {"", str(tmp_path)} & set(sys.path)
    estimator = create_estimator("my_module:Unpicklable")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        result = pool.submit(estimator.estimate, pair(ground, Motion(0.0, 0.0, 0.0))).result()
    assert result.motion == Motion(0.02, 0.0, 0.0)


@pytest.mark.usefixtures("mine")
def test_a_module_that_changes_the_folder_is_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "moving_module", raising=False)
    before = list(sys.path)
    create_estimator("moving_module:Fixed")
    assert sys.path == before
