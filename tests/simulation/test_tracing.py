"""Rays against surfaces with a closed form: sphere and plates, both bearings, in the order of the film."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import (
    angles,
    axes,
    box,
    cells,
    diffuse,
    direction,
    essence,
    floor,
    place_of,
    plate,
    scene,
    sphere,
    world_directions,
)

from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose, to_world_matrices
from mitsonar.records.echoes import CHANNELS, Echoes
from mitsonar.simulation.scene import sonar_in
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = pytest.mark.usefixtures("variant")

POSE = Pose(1.0, 2.0, 3.0, 0.5, -0.2, 2.2)


def echoes(loaded: mi.Scene, sonar: Sonar, pose: Pose = POSE, ping: int = 0) -> Echoes:
    """One ping, film order."""
    return Simulator(loaded, sonar).tracer.film_echoes(pose, ping)


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_inside_a_sphere(bearing: str) -> None:
    """In the middle of a 10 m sphere: range 10, cosine 1, no extent in range, whatever the ray and its jitter."""
    sonar = Sonar(bearing=bearing, azimuth_fov_deg=130, elevation_fov_deg=100, beams=16, rays_per_beam=50)
    got = echoes(scene(ball=sphere(POSE[:3], 10, diffuse(0.7))), sonar)
    assert (got.hit == 1).all()
    np.testing.assert_allclose(got.range_m, 10, atol=1e-5)
    np.testing.assert_allclose(got.cosine, 1, atol=1e-5)
    np.testing.assert_allclose(got.near_m, 10, atol=1e-4)
    np.testing.assert_allclose(got.far_m, 10, atol=1e-4)
    np.testing.assert_allclose(got.reflectivity, 0.7, rtol=1e-6)
    ray = np.stack([got.x, got.y, got.z], 1) - POSE[:3]
    np.testing.assert_allclose(np.abs((ray * np.stack([got.nx, got.ny, got.nz], 1)).sum(1)), 10, atol=1e-4)


@pytest.mark.parametrize("slant", [0.0, 35.0])
@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_plate_at_five_metres(bearing: str, slant: float) -> None:
    """R = 5 (n . a) / (n . d) on the plate through the point 5 m along the axis a; cosine |n . d|."""
    sonar = Sonar(bearing=bearing, azimuth_fov_deg=40, elevation_fov_deg=20, beams=12, rays_per_beam=60, jitter=False)
    starboard, forward, up = axes(POSE)
    lean = np.radians(slant)
    normal = -np.cos(lean) * forward + np.sin(lean) * (0.8 * starboard + 0.6 * up)
    got = echoes(scene(plate=plate(POSE[:3] + 5 * forward, normal)), sonar)
    b, e = cells(sonar)
    half = np.radians(20) / 60 / 2

    def law(elevation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        toward = world_directions(sonar, POSE, b, elevation) @ normal
        return 5 * (forward @ normal) / toward, np.abs(toward)

    assert (got.hit == 1).all()
    radius, cosine = law(e)
    np.testing.assert_allclose(got.range_m, radius, rtol=1e-5)
    np.testing.assert_allclose(got.cosine, cosine, atol=1e-5)
    np.testing.assert_allclose(np.stack([got.nx, got.ny, got.nz], 1), np.broadcast_to(normal, (sonar.rays, 3)), atol=1e-5)
    ends = np.sort(np.stack([law(e - half)[0], law(e + half)[0]]), axis=0)
    # the tangent's error is R h^2 / 8 times 1 + 2 tan^2: 4e-5 m here
    np.testing.assert_allclose(got.near_m, ends[0], atol=1e-4)
    np.testing.assert_allclose(got.far_m, ends[1], atol=1e-4)
    if slant:
        assert np.median(got.far_m - got.near_m) > 50e-4


@pytest.mark.parametrize("jitter", [True, False])
@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_cells_of_a_plane_join_without_gap_or_overlap(bearing: str, jitter: bool) -> None:
    """Where one cell's range interval ends the next begins, wherever in its cell the ray is."""
    sonar = Sonar(bearing=bearing, beams=12, rays_per_beam=200, jitter=jitter)
    got = echoes(scene(floor=floor()), sonar, Pose(0, 0, 2.5, np.radians(35)))
    near, far = (values.reshape(200, sonar.columns) for values in (got.near_m, got.far_m))
    gap = near[:-1] - far[1:]  # rows go down, so ranges fall with the row
    length = far - near
    assert (length > 0).all()
    assert np.abs(gap).max() < 0.05 * length.min()
    radius = got.range_m.reshape(200, sonar.columns)
    if not jitter:
        assert ((near < radius) & (radius < far)).all()


def test_order_of_the_film_and_number_of_the_shape() -> None:
    """A ball up to starboard is seen in upper rows and right columns; shape_id is its place in the scene."""
    sonar = Sonar(azimuth_fov_deg=40, elevation_fov_deg=40, beams=20, rays_per_beam=50, rays_across=1, jitter=False)
    starboard, forward, up = axes(POSE)
    centre = np.array(POSE[:3]) + 4 * forward + 0.8 * starboard + 0.5 * up
    loaded = scene(wall=plate(POSE[:3] + 6 * forward, -forward), ball=sphere(centre, 0.25))
    got = echoes(loaded, sonar)
    rows, columns = np.nonzero(got.shape_id.reshape(50, 20) == place_of(loaded, "ball"))
    assert rows.size > 10
    b, e = np.degrees(np.arctan2(0.8, 4)), np.degrees(np.arctan2(0.5, np.hypot(0.8, 4)))
    assert columns.mean() == pytest.approx((b + 20) / 2 - 0.5, abs=0.5)
    assert rows.mean() == pytest.approx((20 - e) / 0.8 - 0.5, abs=0.5)
    assert set(np.unique(got.shape_id)) == {place_of(loaded, "ball"), place_of(loaded, "wall")}


def test_points_lie_on_their_rays() -> None:
    """Point = position + range times direction, with jitter; angles stay within the field of view."""
    sonar = Sonar(azimuth_fov_deg=60, elevation_fov_deg=40, beams=8, rays_per_beam=40)
    got = echoes(scene(ball=sphere((0, 0, 0), 20), box=box((1, -3, 0), (1, 1, 1))), sonar, ping=3)
    ray = (np.stack([got.x, got.y, got.z], 1) - POSE[:3]) / got.range_m[:, None]
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1, atol=1e-5)
    b, e = angles(sonar, ray @ np.array(axes(POSE)).T)
    assert np.degrees(np.abs(b)).max() < 30 + 1e-3
    assert np.degrees(np.abs(e)).max() < 20 + 1e-3
    np.testing.assert_allclose(direction(sonar, b, e) @ np.array(axes(POSE)), ray, atol=1e-6)


def test_height_is_measured_straight_down() -> None:
    simulator = Simulator(scene(floor=floor(half=10), box=box((3, 3, 0), (1, 1, 0.5))), Sonar(beams=2, rays_per_beam=4))
    poses = [Pose(0, 0, 2.5, 1.0, 0.3, 2.0), Pose(3, 3, 2.5), Pose(50, 0, 2.5), Pose(0, 0, -1)]
    np.testing.assert_allclose(next(simulator.pings(poses)).height_m, [2.5, 2.0, np.nan, np.nan], rtol=1e-6)


@pytest.mark.parametrize("bearing", essence(["azimuth", "cone"], "cone"))
def test_mi_render_gives_the_same_bits(bearing: str) -> None:
    """Two routes to one echo: the integrator in an XML scene, and the tracer that the simulator uses (ping 0)."""
    import mitsuba as mi

    matrix = to_world_matrices(POSE)[0].astype(np.float32)
    loaded = mi.load_string(f"""<scene version="3.0.0">
        <integrator type="echo"/>
        <sensor type="imaging_sonar">
            <integer name="beams" value="12"/> <integer name="rays_per_beam" value="50"/>
            <float name="elevation_fov_deg" value="50"/> <string name="bearing" value="{bearing}"/>
            <transform name="to_world"><matrix value="{" ".join(repr(float(v)) for v in matrix.ravel())}"/></transform>
        </sensor>
        <shape type="rectangle">
            <transform name="to_world"><scale value="5"/></transform>
            <bsdf type="diffuse"><texture type="perlin" name="reflectance"/></bsdf>
        </shape>
        <shape type="cube">
            <transform name="to_world"> <scale value="0.4"/> <translate x="2.5" y="0.5" z="0.3"/> </transform>
            <bsdf type="diffuse"><float name="reflectance" value="0.3"/></bsdf>
        </shape>
        <shape type="sphere">
            <point name="center" x="3.5" y="0" z="0"/> <float name="radius" value="0.5"/>
            <bsdf type="diffuse"><float name="reflectance" value="0.8"/></bsdf>
        </shape>
    </scene>""")
    image = np.array(mi.render(loaded))[..., -len(CHANNELS) :].reshape(-1, len(CHANNELS))
    result = sonar_in(loaded)
    assert result is not None
    local = Simulator(loaded).tracer.film_echoes(result[1], 0)
    assert set(np.unique(local.shape_id)) == {-1, 0, 1, 2}
    second = {name: np.abs(image[:, k] - getattr(local, name)).max() for k, name in enumerate(CHANNELS)}
    assert not any(second.values()), {name: f"differs by up to {value:.1e}" for name, value in second.items() if value}
