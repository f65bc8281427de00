"""Bodies that move: against scenes that are built where the bodies are, and against closed forms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers import box, diffuse, floor, plate, separate, sphere

from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose, vehicle_rotation
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    pass

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

SONAR = Sonar.create(range_min=2, range_max=9, beams=12, azimuth_fov_deg=14, range_bins=256, quality="draft")
COHERENT = SONAR.replace(model="coherent", frequency_hz=1.8e6, bearing="cone", azimuth_fov_deg=3.6, scatterers_per_cell=6)
HERE = Pose(0, 0, 1.0, 0.1)


def fixed(pose: Pose) -> Trajectory:
    return Trajectory(np.array([pose]), np.zeros(1))


def along(*y: float, rate_hz: float = 1.0) -> Trajectory:
    return Trajectory(np.array([[0, one, 0, 0, 0, 0] for one in y], dtype=float), np.arange(len(y)) / rate_hz)


@pytest.mark.parametrize("changes", [{}, {"frequency_hz": 1.8e6, "pattern": "two_way", "bearing": "cone"}])
def test_a_moved_wall_is_a_wall_built_there(changes: dict[str, Any]) -> None:
    sonar = SONAR.replace(**changes)
    moved = separate(floor=floor(), wall=plate((0, 0, 0), (0, -1, 0)))
    result = Simulator(moved, sonar, moving={"wall": along(5, 7)}).render([HERE], gain=1.0)
    later = Simulator(moved, sonar, moving={"wall": along(5, 7)}).render(
        Trajectory(np.array([HERE]), np.array([0.5])), gain=1.0
    )
    for image, y in ((result.image, 5.0), (later.image, 6.0)):
        built = Simulator(separate(floor=floor(), wall=plate((0, y, 0), (0, -1, 0))), sonar).render([HERE], gain=1.0)
        np.testing.assert_allclose(image, built.image, atol=2e-4 * built.image.max())


def test_a_turned_body_is_one_built_turned() -> None:
    """Two routes: the body's trajectory turns it, or its vertices are turned."""
    import mitsuba as mi

    pose = Pose(0.3, 4.0, 1.0, 0.2, -0.3, 0.7)
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = vehicle_rotation(pose).as_matrix()[0], pose[:3]
    built = {**box((0, 0, 0), (0.5, 0.9, 0.3)), "to_world": mi.ScalarTransform4f(turn.tolist())}
    built["to_world"] = built["to_world"] @ mi.ScalarTransform4f().scale([0.5, 0.9, 0.3])
    want = Simulator(separate(floor=floor(), crate=built), SONAR).film_echoes(HERE, 0)
    body = separate(floor=floor(), crate=box((0, 0, 0), (0.5, 0.9, 0.3)))
    result = Simulator(body, SONAR, moving={"crate": fixed(pose)}).film_echoes(HERE, 0)
    same = np.abs(result.range_m - want.range_m) < 1e-4
    assert same.mean() > 0.998  # rays at edges may fall on either side
    for name in ("nx", "ny", "nz", "cosine", "near_m", "far_m"):
        np.testing.assert_allclose(getattr(result, name)[same], getattr(want, name)[same], atol=2e-3)


def test_speckle_rides_with_the_body() -> None:
    """Body and sonar that move as one give one field; a sonar that passes the body gives another."""
    wall = separate(wall=plate((0, 6, 0), (0.2, -1, 0.1), half=1.5))
    before, after = Pose(0, 0, 0), Pose(0.7, 0.4, 0.2, 0.1, -0.2, 0.5)
    path = Trajectory(np.array([before, after]), np.array([0.0, 1.0]))
    both = Simulator(wall, COHERENT, moving={"wall": path}).render(path, gain=1.0).to_linear().image
    still = Simulator(wall, COHERENT).render([before, Pose(0.02, 0, 0)], gain=1.0).to_linear().image
    np.testing.assert_allclose(both[0], still[0], atol=1e-3 * still.max())
    assert np.corrcoef(both[1].ravel(), still[0].ravel())[0, 1] > 0.99
    assert np.corrcoef(still[1].ravel(), still[0].ravel())[0, 1] < 0.9


def test_labels_tell_each_body() -> None:
    fish = [fixed(Pose(x, 4.0, 1.0)) for x in (-0.3, 0.3)]
    frames = Simulator(separate(floor=floor(), fish=sphere((0, 0, 0), 0.1)), SONAR, moving={"fish": fish}).render(
        [HERE], labels=True
    )
    assert frames.object_names[1:] == frames.body_names == ("fish 1", "fish 2")
    assert frames.object_id is not None
    assert frames.body_poses is not None
    np.testing.assert_allclose(frames.body_poses[0, :, 0], (-0.3, 0.3))
    for number, side in ((1, -1), (2, 1)):
        beams = np.nonzero((frames.object_id[0] == number).any(axis=0))[0]
        assert len(beams)
        assert (np.sign(frames.bearing_rad[beams]) == side).all()


def test_a_loop_over_copies_finds_what_bodies_one_by_one_do() -> None:
    """Six spheres as copies of one shape, and as six shapes; the nearer hides the farther."""
    rng = np.random.default_rng(3)
    poses = [Pose(*place) for place in rng.uniform((-0.6, 3, 0.3), (0.6, 6, 1.5), (6, 3))]
    one = separate(floor=floor(), ball=sphere((0, 0, 0), 0.2))
    result = Simulator(one, SONAR, moving={"ball": [fixed(pose) for pose in poses]}).film_echoes(HERE, 0)
    built = {f"ball{k}": sphere(pose[:3], 0.2) for k, pose in enumerate(poses)}
    want = Simulator(separate(floor=floor(), **built), SONAR).film_echoes(HERE, 0)
    assert (np.abs(result.range_m - want.range_m) < 1e-3).mean() > 0.998


def test_height_is_over_what_stands_still() -> None:
    """The vehicle's own body is under the sonar, and moves with it."""
    path = Trajectory.between(Pose(0, 0, 1.5), Pose(0, 1, 1.5), 2, 1.0)
    frame = separate(floor=floor(), skid=plate((0, 0, -0.5), (0, 0, 1), half=0.4))
    frames = Simulator(frame, SONAR, moving={"skid": path}).render(path)
    assert frames.height_m is not None
    np.testing.assert_allclose(frames.height_m, 1.5, atol=1e-5)


def test_steps_are_the_frames_of_a_run() -> None:
    loaded = separate(floor=floor(), wall=plate((0, 0, 0), (0, -1, 0)))
    path = Trajectory.between(HERE, Pose(0, 0.2, 1.0, 0.1), 3, 2.0)
    simulator = Simulator(loaded, SONAR, moving={"wall": along(5, 6, 7)})
    run = simulator.render(path, gain=2.0)
    steps = [
        simulator.step(pose, time_s=time, gain=2.0).image[0] for pose, time in zip(path.poses, path.time_s, strict=True)
    ]
    np.testing.assert_array_equal(run.image, steps)


def test_derivatives_of_a_sonar_without_jitter_see_the_bodies_where_they_were_placed() -> None:
    from mitsonar.simulation.derivatives import jittered

    loaded = separate(wall=plate((0, 0, 0), (0, -1, 0)))
    simulator = Simulator(loaded, SONAR.replace(jitter=False), moving={"wall": along(6)})
    nearest = jittered(simulator).film_echoes(Pose(0, 0, 0), 0).range_m.min()
    assert nearest == pytest.approx(6.0, abs=0.01)


def test_returns_outside_the_window_are_named_where_the_body_was() -> None:
    """A wall that moves off at 1 m/s is 20 m away at the frame's time, 15 s, and within the window at 0 s."""
    simulator = Simulator(separate(wall=plate((0, 0, 0), (0, -1, 0))), SONAR, moving={"wall": along(5, 25, rate_hz=0.05)})
    with pytest.warns(MitsonarWarning, match=r"lie outside the window 2\.\.9 m, in frame 0 at 20\.\d\d\.\."):
        simulator.render(Trajectory(np.zeros((1, 6)), np.array([15.0])))


@pytest.mark.parametrize(
    ("moving", "said"),
    [
        ({"wal": along(5)}, "the scene has no shape wal"),
        ({"wall": []}, "follows a Trajectory"),
        ({"wall": Trajectory(np.zeros((2, 6)), np.zeros(2))}, "increasing times"),
    ],
)
def test_mistakes_are_told(moving: Any, said: str) -> None:
    with pytest.raises(MitsonarError, match=said):
        Simulator(separate(floor=floor(), wall=plate((0, 0, 0), (0, -1, 0))), SONAR, moving=moving)


def test_scenes_with_instances_are_refused() -> None:
    with pytest.raises(MitsonarError, match=r"without instances: got cannon, barrel, boat; give these as meshes"):
        Simulator(load_scene("objects"), SONAR, moving={"sand": fixed(Pose(0, 0, 0))})


def test_poses_of_bodies_are_kept(tmp_path: Any) -> None:
    from mitsonar.records.frames import SonarFrames

    loaded = separate(floor=floor(diffuse()), wall=plate((0, 0, 0), (0, -1, 0)))
    frames = Simulator(loaded, SONAR, moving={"wall": along(5, 7)}).render(Trajectory.between(HERE, HERE, 3, 2.0))
    frames.save(tmp_path / "frames.npz")
    read = SonarFrames.load(tmp_path / "frames.npz")
    assert read.body_names == ("wall",)
    assert read.body_poses is not None
    np.testing.assert_allclose(read.body_poses[:, 0, 1], (5, 6, 7))
