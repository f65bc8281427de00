"""Bodies that deform: a ball that grows is met at its own range, and a mesh that is bent is one that was built bent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Array, floor, separate, sphere
from test_moving_scene import SONAR, fixed

from mitsonar.errors import MitsonarError
from mitsonar.motion.bodies import Deforming
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.scene import load_meshes
from mitsonar.simulation.simulator import Simulator
from mitsonar.simulation.vehicle import CameraSimulator, camera_of

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")]

AWAY_M = 6.0


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three balls of radius 0.5, 1.0 and 1.5 m about the origin, the same triangles."""
    import trimesh

    folder = tmp_path_factory.mktemp("balls")
    for number, radius in enumerate((0.5, 1.0, 1.5)):
        trimesh.creation.icosphere(subdivisions=4, radius=radius).export(folder / f"{number}.ply")
    return sorted(folder.glob("*.ply"))


def first_range(image: Array, range_m: Array) -> float:
    """Nearest bin of the middle beams that reaches a fiftieth of their brightest."""
    middle = image[:, 5:7].mean(axis=1)
    return float(range_m[np.nonzero(middle > 0.02 * middle.max())[0][0]])


def test_clearances_are_of_the_shape_at_the_time_of_each_vehicle(balls: list[Path]) -> None:
    from mitsonar.simulation.tracing import Clearance

    growing = Deforming(fixed(Pose(0, AWAY_M, 0)), load_meshes(balls, 1.0, loop=False))
    scene = separate(ball={"type": "ply", "filename": str(balls[0])})
    clearance = Clearance(Simulator(scene, SONAR, moving={"ball": growing}).tracer)
    places, time_s = np.zeros((3, 3)), np.array([0.0, 1.0, 2.0])
    np.testing.assert_allclose(clearance.of(places, places, time_s), AWAY_M - 0.5 - 0.5 * time_s, atol=0.01)


@pytest.mark.parametrize(
    ("changes", "tolerance"),
    [({}, 0.02), ({"model": "coherent", "frequency_hz": 1.8e6, "bearing": "cone", "azimuth_fov_deg": 4.0}, 0.03)],
)
def test_a_ball_that_grows_comes_nearer(balls: list[Path], changes: dict[str, Any], tolerance: float) -> None:
    """Range of the nearest echo: 6 m - (0.5 m + 0.5 m/s t), also between two meshes."""
    sonar = SONAR.replace(range_bins=700, **changes)
    growing = Deforming(fixed(Pose(0, AWAY_M, 0)), load_meshes(balls, 1.0, loop=False))
    scene = separate(ball={"type": "ply", "filename": str(balls[0])}, floor=floor(half=0.1))
    path = Trajectory(np.zeros((5, 6)), np.linspace(0, 2, 5))
    frames = Simulator(scene, sonar, moving={"ball": growing}).render(path, gain=1e3, labels=not changes).to_linear()
    result = [first_range(image, frames.range_m) for image in frames.image]
    np.testing.assert_allclose(result, AWAY_M - 0.5 - 0.5 * path.time_s, atol=tolerance)
    if not changes:
        assert frames.object_id is not None
        assert (frames.object_id == frames.object_names.index("ball")).any(axis=(1, 2)).all()


def test_a_deformed_mesh_is_one_built_so(balls: list[Path]) -> None:
    """Two routes to range and normal of each ray: the vertices moved, or the mesh loaded where they are."""
    still = fixed(Pose(0, AWAY_M, 0))
    deformed = separate(ball={"type": "ply", "filename": str(balls[0])}, floor=floor())
    moving = {"ball": Deforming(still, load_meshes(balls, 1.0))}
    result = Simulator(deformed, SONAR, moving=moving).film_echoes(Pose(0, 0, 1), 0, time_s=2.0)
    built = separate(ball={"type": "ply", "filename": str(balls[2])}, floor=floor())
    want = Simulator(built, SONAR, moving={"ball": still}).film_echoes(Pose(0, 0, 1), 0)
    same = np.abs(result.range_m - want.range_m) < 1e-4
    assert same.mean() > 0.999
    for name in ("nx", "ny", "nz", "cosine", "reflectivity"):
        np.testing.assert_allclose(getattr(result, name)[same], getattr(want, name)[same], atol=2e-3)


def test_the_scene_itself_is_left_alone(balls: list[Path]) -> None:
    scene = separate(ball={"type": "ply", "filename": str(balls[0])}, floor=floor())
    sonar, here = SONAR.replace(range_min=0), [Pose(0, -3, 0)]
    before = Simulator(scene, sonar, moving={}).render(here, gain=1.0).image
    moving = {"ball": Deforming(fixed(Pose(0, 0, 0)), load_meshes(balls, 1.0))}
    changed = Simulator(scene, sonar, moving=moving).render(Trajectory(np.array(here), np.array([1.0])), gain=1.0).image
    assert np.abs(changed - before).max() > 0.1 * before.max()
    np.testing.assert_array_equal(Simulator(scene, sonar, moving={}).render(here, gain=1.0).image, before)


def test_a_camera_sees_it_grow(balls: list[Path]) -> None:
    """The disc of a ball of radius r at 6 m covers pi (f r / sqrt(36 - r^2))^2 pixels, f of the camera in pixels."""
    ball = {"type": "ply", "filename": str(balls[0]), "bsdf": {"type": "diffuse", "reflectance": 0.05}}
    scene = separate(ball=ball, light={"type": "constant"})
    moving = {"ball": Deforming(fixed(Pose(0, AWAY_M, 0)), load_meshes(balls, 1.0, loop=False))}
    camera = CameraSimulator(scene, camera_of(60.0, 160, 120, 16), moving=moving)
    pixels = [float((one < 200).sum()) for one in camera.pictures(np.zeros((3, 6)), [0.0, 1.0, 2.0])]
    radius, focal = np.array([0.5, 1.0, 1.5]), 80 / np.tan(np.radians(30))
    np.testing.assert_allclose(pixels, np.pi * (focal * radius) ** 2 / (AWAY_M**2 - radius**2), rtol=0.04)


def test_mistakes_are_told(balls: list[Path], tmp_path: Path) -> None:
    import trimesh

    moving = {"ball": Deforming(fixed(Pose(0, 0, 0)), load_meshes(balls, 1.0))}
    with pytest.raises(MitsonarError, match="only meshes can deform: ball"):
        Simulator(separate(ball=sphere((0, 0, 0), 1)), SONAR, moving=moving)
    scene = separate(ball={"type": "ply", "filename": str(balls[0])})
    for wrong in (np.zeros((3, 3)), np.full((2562, 3), np.nan)):
        moving = {"ball": Deforming(fixed(Pose(0, 5, 0)), lambda time_s, wrong=wrong: wrong)}  # type: ignore[misc]
        with pytest.raises(MitsonarError, match="ball has 2562 vertices"):
            Simulator(scene, SONAR, moving=moving).render([Pose(0, 0, 0)])
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / "other.ply")
    with pytest.raises(MitsonarError, match="other triangles"):
        load_meshes([balls[0], tmp_path / "other.ply"], 1.0)


def test_a_deforming_mesh_keeps_its_reflectivities() -> None:
    """Those of facets are attributes, as in all generated worlds; at rest the body is the one of the scene."""
    import mitsuba as mi

    cube = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 4, 0])})
    mesh = mi.Mesh("body", cube.vertex_count(), cube.face_count())
    old, new = mi.traverse(cube), mi.traverse(mesh)
    new["vertex_positions"], new["faces"] = old["vertex_positions"], old["faces"]
    new.update()
    mesh.add_attribute("face_reflectivity", 1, np.linspace(0.3, 0.9, mesh.face_count()).tolist())
    mesh.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "face_reflectivity"}}))
    shapes: Any = {"body": mesh}
    loaded = separate(**shapes)
    rest = np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)
    moving = {"body": Deforming(fixed(Pose(0, 0, 0)), lambda time_s: rest)}
    images = [Simulator(loaded, SONAR, moving=one).render([Pose(0, 0, 0)], gain=1.0).image for one in (moving, None)]
    assert images[1].any()
    np.testing.assert_allclose(images[0], images[1], atol=1e-5 * images[1].max())
