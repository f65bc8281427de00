"""Estimators: signs and sizes of known motions, honest covariances, and no confident answer where there is none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from drawn_frames import over_ground
from helpers import box, essence, scene

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.errors import MitsonarError
from mitsonar.estimation.image.direct import Direct
from mitsonar.estimation.image.phase import Ecc
from mitsonar.estimation.named import Zero, create_estimator, estimators_for
from mitsonar.geometry.ground import STD_MEASURED, Attitude, GroundView, attitude_of, moved
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.networks.shipped import SHIPPED
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator
from mitsonar.worlds.families import FlatObjects, RockyField

pytestmark = [
    pytest.mark.usefixtures("variant"),
    pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning"),
]

START = Pose(0.3, -3.5, 2.5, np.radians(35), 0, 0.4)
UNITS = np.array([1e3, 1e3, 180 / np.pi])
CLASSICAL = [name for name in estimators_for(SonarFrames) if name != "zero"]
TRAINED = [name for name in SHIPPED if name.startswith("corrnet")]
"""Those that read images; the others read vectors of views."""

METHODS = [*CLASSICAL, *(pytest.param(name, marks=pytest.mark.learn) for name in TRAINED)]

ALLOWED = {
    "direct": [3.0, 1.5, 0.07],
    "ecc": [3.0, 1.5, 0.07],
    "phase": [5.0, 2.0, 0.10],
    "flow": [8.0, 4.0, 0.25],
    "corrnet": [3.0, 1.5, 0.07],
    "corrnet-coherent": [4.0, 2.0, 0.10],
}
"""Errors on flat objects in mm, mm, deg. Large plates of one reflectivity, whose brightness belongs to the range and not to
the ground, hold estimates back."""


@pytest.fixture(scope="module")
def simulator(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Simulator:
    """Flat objects: no relief, so that the geometry is exact."""
    folder = tmp_path_factory.mktemp("flat") / "world"
    scene = load_scene(FlatObjects(size_m=16, objects=(150, 150), seabed_cells=400).build(2).write(folder))
    return Simulator(scene, Sonar(rays_per_beam=300, rays_across=4))


@pytest.fixture(scope="module")
def rocks(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Simulator:
    """A rocky field as dense as that of the issue's trial."""
    folder = tmp_path_factory.mktemp("rocks") / "world"
    scene = load_scene(RockyField(size_m=16, a_side=(32, 32)).build(3).write(folder))
    return Simulator(scene, Sonar(rays_per_beam=300, rays_across=4))


Pair = Callable[..., SonarFrames]


@pytest.fixture(scope="module")
def pair(simulator: Simulator) -> Pair:
    """Two frames over flat objects, a motion apart; each is rendered once."""
    known: dict[tuple[Motion, str], SonarFrames] = {}

    def frames(motion: Motion, noise: str = "none") -> SonarFrames:
        if (motion, noise) not in known:
            known[motion, noise] = two(simulator, motion, noise)
        return known[motion, noise]

    return frames


def two(simulator: Simulator, motion: Motion, noise: str = "none", start: Pose = START) -> SonarFrames:
    """Two frames, the motion apart."""
    poses = Trajectory(np.array([start, compose(start, motion)]), np.array([0.0, 0.1]))
    return simulator.render(poses, noise=NOISE_MODELS[noise], seed=3)


def changed(frames: SonarFrames, **fields: object) -> SonarFrames:
    """The frames with some fields replaced."""
    return SonarFrames(**{**vars(frames), **fields})


# ---------------------------------------------------------------- signs and sizes


@pytest.mark.parametrize(
    ("axis", "size"),
    essence(
        [(axis, size) for axis in range(3) for size in (-5.0, -1.0, -0.3, 0.3, 1.0, 5.0)], (0, -1.0), (1, 5.0), (2, -1.0)
    ),
)
@pytest.mark.parametrize("method", METHODS)
def test_sign_and_size_of_each_axis(pair: Pair, method: str, axis: int, size: float) -> None:
    """Motions along one axis of 6, 20 and 100 mm, or 0.12, 0.4 and 2 deg."""
    motion = np.zeros(3)
    motion[axis] = size * np.array([0.02, 0.02, np.radians(0.4)])[axis]
    result = create_estimator(method).estimate(pair(Motion(*motion)))
    error = (np.array(result.motion) - motion) * UNITS
    assert result.valid, result.reason
    beyond = 3 if method in TRAINED and abs(size) > 1 else 1  # beyond what it has learnt: phase finds where it starts
    assert (np.abs(error) < beyond * np.array(ALLOWED[method])).all(), f"mm, mm, deg: {error}"


@pytest.mark.parametrize("method", CLASSICAL)
def test_a_fan_of_forty_metres_is_answered(method: str) -> None:
    """Its pixels of the ground are wider than the texture by whose spectrum ``phase`` finds turns in smaller fans."""
    sonar = load_sonar("oculus-m750d-750khz").replace(beams=128, range_bins=512)
    poses = np.array([[0, 0, 4.0, np.radians(20), 0, 0], [0, 0.3, 4.0, np.radians(20), 0, 0.01]])
    frames = over_ground(Trajectory(poses, np.array([0.0, 0.1])), sonar)
    result = create_estimator(method).estimate(frames)
    assert result.valid or result.reason
    assert not result.valid or abs(result.motion.forward - 0.3) < 0.07  # half a pixel


@pytest.mark.parametrize("method", METHODS)
def test_all_three_at_once_on_rocks(rocks: Simulator, method: str) -> None:
    """The relief is not told: heights come from the first echoes."""
    motion = np.array([0.015, -0.012, np.radians(0.4)])
    result = create_estimator(method).estimate(two(rocks, Motion(*motion)))
    error = (np.array(result.motion) - motion) * UNITS
    assert result.valid, result.reason
    assert (np.abs(error) < np.array([1.5, 1, 1.5]) * ALLOWED[method]).all(), f"mm, mm, deg: {error}"


@pytest.mark.parametrize(("noise", "allowed"), [("none", [3.0, 1.0, 0.07]), ("high", [6.0, 2.0, 0.12])])
@pytest.mark.parametrize("method", ["direct", *(name for name in METHODS if name not in CLASSICAL)])
def test_covariances_hold_with_noise(pair: Pair, rocks: Simulator, method: str, noise: str, allowed: list[float]) -> None:
    """A network's hold on what it has learnt only: rocks; on large plates they are too small."""
    motion = Motion(0.015, -0.012, np.radians(0.4))
    result = create_estimator(method).estimate(pair(motion, noise) if method == "direct" else two(rocks, motion, noise))
    error = (np.array(result.motion) - motion) * UNITS
    assert result.valid, result.reason
    assert (np.abs(error) < allowed).all(), f"{noise}, mm, mm, deg: {error}"
    assert result.covariance is not None
    assert (np.linalg.eigvalsh(result.covariance) > 0).all()
    std = np.sqrt(np.diag(result.covariance)) * UNITS
    assert (np.abs(error) < 4 * std).all(), f"errors {error}, standard deviations {std}"


def test_direct_tells_heave_apart_from_forward(simulator: Simulator) -> None:
    """A sonar that has risen by 5 mm seems to have gone back by 3 to 5 mm, unless heave is known, or allowed for."""
    motion = Motion(0.005, 0.01, 0.002)
    second = compose(START, motion)
    poses = np.array([START, second._replace(z=second.z + 0.005)])
    frames = simulator.render(Trajectory(poses, np.array([0.0, 0.1])), seed=3)
    known = np.array(Direct().estimate(frames).motion) - motion
    assert abs(known[1]) < 3e-4
    assert frames.poses is not None
    frames = changed(frames, poses=frames.poses * [1, 1, 0, 1, 1, 1])
    stiff, free = (np.array(Direct(heave_std_m=std).estimate(frames).motion) - motion for std in (0.0, 0.01))
    assert abs(stiff[1]) > 2e-3
    assert abs(free[1]) < abs(stiff[1]) / 2
    about = Direct(heave_std_m=0.01).estimate(frames).about
    assert about["heave_m"] == pytest.approx(0.005, abs=3e-3)


def test_a_wrong_height_of_a_sonar_that_rolls_is_within_the_covariance() -> None:
    """Where the sonar rolls and heaves between frames, a wrong height moves the ground aside: two routes to the error."""
    sonar = load_sonar("didson300").replace(model="physical")
    second = [0.0, 0.04, 2.51, np.radians(35.5), np.radians(1.5), 0.0]
    poses = np.array([[0, 0, 2.5, np.radians(35), 0, 0], second])
    frames = over_ground(Trajectory(poses, np.array([0.0, 0.1])), sonar)
    low, message, high = (Direct(height_m=height_m, relief_m=0.0).estimate(frames) for height_m in (2.48, 2.5, 2.52))
    assert low.valid
    assert high.valid
    assert message.covariance is not None
    by_height = (np.array(high.motion) - low.motion) / 0.04
    assert abs(by_height[2]) > np.radians(0.02)  # a yaw of 0.02 deg a metre
    shift = STD_MEASURED * 2.5 * by_height
    assert shift @ np.linalg.solve(message.covariance, shift) < 2


def test_frames_show_that_the_height_is_wrong() -> None:
    """At the middle of the window, a height of 2.6 m for 2.5 makes 40 mm forward 2 % too long: 0.8 mm."""
    poses = np.array([[0, 0, 2.5, np.radians(35), 0, 0], [0, 0.04, 2.5, np.radians(35), 0, 0]])
    frames = over_ground(Trajectory(poses, np.array([0.0, 0.1])), load_sonar("didson300").replace(model="physical"))
    results = [Direct(height_m=height_m, relief_m=0.0).estimate(frames) for height_m in (2.4, 2.5, 2.6)]
    errors = np.array([result.motion for result in results]) - [0, 0.04, 0]
    assert np.abs(errors[:, 1]).max() < 5e-4
    for error, result in zip(errors, results, strict=True):
        assert result.covariance is not None
        assert error @ np.linalg.solve(result.covariance, error) < 3 * 3


def test_frames_show_heave_and_lean_that_nothing_measured() -> None:
    """A rise of 6 mm looks like 4 mm backward, a roll of 0.3 deg like a turn and a motion aside."""
    sonar = load_sonar("didson300").replace(model="physical")
    second = [0.0, 0.04, 2.506, np.radians(35.2), np.radians(0.3), 0.0]
    poses = np.array([[0, 0, 2.5, np.radians(35), 0, 0], second])
    frames = changed(over_ground(Trajectory(poses, np.array([0.0, 0.1])), sonar), poses=None)
    result = Direct(height_m=2.503, pitch_rad=np.radians(35.1), relief_m=0.0).estimate(frames)
    error = np.array(result.motion) - [0, 0.04, 0]
    assert (np.abs(error) < [1e-3, 5e-4, np.radians(0.02)]).all(), f"mm, mm, deg: {error * UNITS}"
    assert result.covariance is not None
    assert error @ np.linalg.solve(result.covariance, error) < 3 * 3


def test_swapped_frames_tell_the_opposite_motion(pair: Pair) -> None:
    """The way back: direct treats both frames alike, so that the middle frame's motion only changes its sign, up to
    the step at which its iteration ends, which differs between processors."""
    frames = pair(Motion(0.015, -0.012, np.radians(0.4)))
    there = Direct().estimate(frames)
    back = Direct().estimate(frames.select(np.array([1, 0])))
    assert back.motion.yaw == pytest.approx(-there.motion.yaw, abs=1e-5)
    home = compose(compose(Pose(0, 0, 0), there.motion), back.motion)
    assert np.allclose(home[:2], 0, atol=1e-4)


# ---------------------------------------------------------------- nothing to believe


@pytest.mark.thorough
@pytest.mark.parametrize("method", METHODS)
def test_nothing_to_match_is_not_believed(pair: Pair, simulator: Simulator, method: str) -> None:
    """A blank frame, noise alone, frames of two different places."""
    estimator = create_estimator(method)
    frames = pair(Motion(0.0, 0.0, 0.0))
    blank = changed(frames, image=np.zeros_like(frames.image))
    half = changed(frames, image=np.stack([frames.image[0], blank.image[0]]))
    noise = NOISE_MODELS["high"].apply(blank.image, seed=1, frames=np.arange(2))
    for name, seen in {"blank": blank, "one blank": half, "noise": changed(frames, image=noise)}.items():
        result = estimator.estimate(seen)
        assert not result.valid, name
        assert result.reason
    elsewhere = two(simulator, Motion(2.0, 0.0, 1.0))
    assert not estimator.estimate(elsewhere).valid, "elsewhere"


@pytest.mark.parametrize("method", METHODS)
def test_one_object_alone_is_not_believed(method: str) -> None:
    """A box of unknown height on nothing: its sideways motion and the sonar's turn look alike."""
    only = Simulator(scene(thing=box([0, 0, 0.2], [0.2, 0.2, 0.2])), Sonar(rays_per_beam=300))
    start = Pose(0.0, -3.6, 2.5, np.radians(35), 0, 0)
    frames = only.render(Trajectory(np.array([start, compose(start, Motion(0.01, 0.01, 0.003))]), np.array([0.0, 0.1])))
    assert (frames.image > 0).mean() > 0.003
    result = create_estimator(method).estimate(changed(frames, height_m=np.full(2, 2.5)))
    assert not result.valid


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "wrong", essence([{"height_m": 4.0}, {"height_m": 1.2}, {"pitch_rad": np.radians(10)}], {"height_m": 4.0})
)
def test_wrong_geometry_is_reported(rocks: Simulator, method: str, wrong: dict[str, float]) -> None:
    """First echoes give another height. The given one counts, with a covariance that holds both."""
    motion = Motion(0.01, 0.01, 0.003)
    result = create_estimator(method, **wrong).estimate(two(rocks, motion))
    assert not result.valid or result.about["doubt"].startswith("first echoes give a height of")
    if result.valid and method == "direct":
        assert result.covariance is not None
        off = np.array(result.motion) - motion
        assert off @ np.linalg.solve(result.covariance, off) < 16


# ---------------------------------------------------------------- height and ground


def test_height_comes_from_first_echoes(pair: Pair) -> None:
    """Over a flat floor the steepest rays end at the sonar's height: a given height of 8 % less or more moves it by 2 %."""
    frames = pair(Motion(0.0, 0.0, 0.0))
    for message in (np.full(2, 2.3), np.full(2, 2.7), None):
        attitude = attitude_of(changed(frames, height_m=message), "direct", None, None)
        assert attitude.height_m == pytest.approx(2.5, rel=0.02)
        assert attitude.pitch_rad == pytest.approx(np.radians(35))
        assert not attitude.reason
    assert attitude_of(frames, "direct", 2.4, None, relief_m=0.1).height_m == pytest.approx(2.3)
    late = slice(300, None)  # a window that begins within the lit floor shows no first echoes
    cut = changed(frames, image=frames.image[:, late], range_m=frames.range_m[late])
    assert attitude_of(cut, "direct", None, None).height_m == pytest.approx(2.5, rel=1e-3)


def test_what_is_missing_is_said() -> None:
    sonar = Sonar(beams=8, range_bins=16)
    bare = SonarFrames(np.zeros((2, 16, 8), np.float32), sonar.range_m, sonar.bearing_rad, np.arange(2.0), sonar)
    for method in CLASSICAL:
        with pytest.raises(MitsonarError, match=f"{method} needs height and pitch"):
            create_estimator(method).estimate(bare)
        with pytest.raises(MitsonarError, match="takes two frames: got 1"):
            create_estimator(method, height_m=2.0, pitch_rad=0.6).estimate(bare.select(slice(0, 1)))
    with pytest.raises(MitsonarError, match="takes two frames: got 1"):
        Zero().estimate(bare.select(slice(0, 1)))
    with pytest.raises(MitsonarError, match="did you mean direct"):
        create_estimator("dierct")
    with pytest.raises(
        MitsonarError, match=r"'height': direct takes height_m, pitch_rad, relief_m, heave_std_m.*; did you mean height_m\?"
    ):
        create_estimator("direct", height=2)
    with pytest.raises(MitsonarError, match="direct: height_m must be a number: got 'high'"):
        create_estimator("direct", height_m="high")
    with pytest.raises(MitsonarError, match="above 0"):
        Direct(height_m=1.0, pitch_rad=0.6, relief_m=1.5).estimate(bare)
    with pytest.raises(MitsonarError, match="heave_std_m"):
        Direct(heave_std_m=-1)
    assert create_estimator("zero").estimate(bare).motion == Motion(0, 0, 0)


def test_estimators_are_named_with_options_on_one_line() -> None:
    assert create_estimator("direct") == Direct()
    assert create_estimator("direct:height_m=2.5:heave_std_m=0.005") == Direct(height_m=2.5, heave_std_m=0.005)
    assert create_estimator("ecc:pitch_deg=30") == Ecc(pitch_rad=np.radians(30))
    for text, words in {
        "direct:height_m": "NAME:key=value",
        "direct:height_m=high": "must be a number",
        "direct:levels=3": "takes height_m, pitch_deg, relief_m, heave_std_m",
        "posenet.ckpt": "checkpoint",
    }.items():
        with pytest.raises(MitsonarError, match=words):
            create_estimator(text)


def test_a_view_of_the_ground_moves_with_the_motion(pair: Pair) -> None:
    """Its warp is `moved` in pixels, and `motion` undoes it."""
    view = GroundView(pair(Motion(0.0, 0.0, 0.0)), Attitude(2.5, 0.05, np.radians(35)), 0.02)
    motion = Motion(0.03, -0.07, 0.02)
    warp = view.warp(motion)
    left, _, _, far = view.reach
    column, row = 31.0, 17.0
    ground = np.array([left + (column + 0.5) * view.edge, far - (row + 0.5) * view.edge])
    there = moved(ground, motion)
    expected = [(there[0] - left) / view.edge - 0.5, (far - there[1]) / view.edge - 0.5]
    assert np.allclose(warp @ [column, row, 1], expected, atol=1e-4)
    assert np.allclose(view.motion(warp), motion, atol=1e-6)
