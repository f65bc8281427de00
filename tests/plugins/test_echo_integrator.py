"""The integrator `echo`: its channels, its misses, one ray a pixel, any camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers import MitsubaDict, box, diffuse, essence, floor, floor_levels, scene, sphere

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import Receiver
from mitsonar.motion.pose import Pose, to_world_matrices
from mitsonar.records.echoes import CHANNELS
from mitsonar.simulation.simulator import Simulator

pytestmark = pytest.mark.usefixtures("variant")


def camera(origin: tuple[float, ...] = (0, 0, 3), target: tuple[float, ...] = (0, 3, 0), **more: Any) -> MitsubaDict:
    """A perspective camera of 24 x 16 pixels."""
    film = {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    look = mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=[0, 0, 1])
    return {"type": "perspective", "fov": 60, "to_world": look, "film": film, **more}


def channels(sensor: MitsubaDict, **shapes: MitsubaDict) -> dict[str, np.ndarray]:
    """What `echo` records, by name, each ``(height, width)``; ``film`` is the film's own channel."""
    loaded = mi.load_dict({"type": "scene", "integrator": {"type": "echo"}, "sensor": sensor, **shapes})
    assert tuple(loaded.integrator().aov_names()) == CHANNELS
    image = np.array(mi.render(loaded))
    return {"film": image[..., 0], **{name: image[..., 1 + k] for k, name in enumerate(CHANNELS)}}


@pytest.mark.parametrize("near_clip", essence([0.01, 1.0, 3.0], 1.0))
def test_range_counts_from_the_camera_not_from_its_near_plane(near_clip: float) -> None:
    """In the middle of a 10 m sphere every range is 10 m and every cosine 1."""
    got = channels(camera((1, 2, 3), (4, 5, 3), near_clip=near_clip), around=sphere((1, 2, 3), 10))
    np.testing.assert_allclose(got["range_m"], 10, atol=1e-5)
    np.testing.assert_allclose(got["cosine"], 1, atol=1e-5)


def test_channels_agree_with_each_other() -> None:
    got = channels(camera(), floor=floor(diffuse(0.3)), box=box((0.5, 3, 0), (0.4, 0.4, 0.4), diffuse(0.8)))
    hit = got["hit"] == 1
    origin, point = np.array([0, 0, 3.0]), np.stack([got["x"], got["y"], got["z"]], -1)
    normal = np.stack([got["nx"], got["ny"], got["nz"]], -1)
    way = point - origin
    np.testing.assert_allclose(np.linalg.norm(way, axis=-1)[hit], got["range_m"][hit], rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1)[hit], 1, atol=1e-6)
    cosine = np.abs((way * normal).sum(-1))[hit] / got["range_m"][hit]
    np.testing.assert_allclose(got["cosine"][hit], cosine, atol=1e-5)
    np.testing.assert_allclose(got["film"], got["reflectivity"] * got["cosine"], rtol=1e-6)
    assert set(np.unique(got["reflectivity"][hit])) == {np.float32(0.3), np.float32(0.8)}
    on_floor = hit & (got["reflectivity"] == np.float32(0.3))
    assert np.abs(got["z"][on_floor]).max() < 1e-5
    assert (got["nz"][on_floor] == 1).all()


def test_a_miss_is_marked() -> None:
    """Looking level over the floor's edge: hit 0, shape_id -1, all others 0."""
    got = channels(camera((0, 0, 3), (0, 3, 2.5)), floor=floor(half=8))
    miss = got["hit"] == 0
    assert 0.2 < miss.mean() < 0.9
    assert (got["hit"][~miss] == 1).all()
    assert (got["shape_id"][miss] == -1).all()
    assert (got["shape_id"][~miss] == 0).all()
    for name in set(CHANNELS) - {"hit", "shape_id"}:
        assert (got[name][miss] == 0).all(), name
    nothing = channels({"type": "imaging_sonar", "beams": 2, "rays_per_beam": 3, "rays_across": 1})
    assert {name: np.unique(values).tolist() for name, values in nothing.items()} == {
        **{name: [0.0] for name in nothing},
        "shape_id": [-1.0],
    }


def test_other_sensors_have_no_cells() -> None:
    got = channels(camera(), floor=floor())
    hit = got["hit"] == 1
    np.testing.assert_array_equal(got["solid_angle_sr"], 0)
    np.testing.assert_array_equal(got["near_m"][hit], got["range_m"][hit])
    np.testing.assert_array_equal(got["far_m"][hit], got["range_m"][hit])


def test_one_ray_a_pixel_whatever_the_sampler_says() -> None:
    """At the edge of a sphere an average of samples would lie between hit and miss."""
    ball = sphere((0, 3, 0), 1)
    once = channels(camera(), ball=ball)
    often = channels(camera(sampler={"type": "independent", "sample_count": 16}), ball=ball)
    assert set(np.unique(once["hit"])) == {0, 1}
    for name, values in once.items():
        np.testing.assert_array_equal(often[name], values, err_msg=name)


def test_rays_go_through_the_middle_of_pixels() -> None:
    """A perspective camera of 60 deg over 24 pixels: column k looks at tan = (1 - 2 (k + 1/2) / 24) tan 30 deg."""
    got = channels(camera((0, 0, 0), (0, 1, 0)), wall=box((0, 6, 0), (50, 1, 50)))
    column = np.arange(24) + 0.5
    tangent = (2 * column / 24 - 1) * np.tan(np.radians(30))
    np.testing.assert_allclose(got["x"][8] / got["y"][8], tangent, atol=1e-5)


def test_a_crop_is_a_part_of_the_whole() -> None:
    crop = {"crop_offset_x": 5, "crop_offset_y": 3, "crop_width": 10, "crop_height": 8}
    part_camera = camera()
    part_camera["film"] |= crop
    whole, part = (channels(source, floor=floor(), ball=sphere((0, 3, 0), 1)) for source in (camera(), part_camera))
    for name in ("hit", "shape_id"):
        np.testing.assert_array_equal(part[name], whole[name][3:11, 5:15], err_msg=name)
    np.testing.assert_allclose(part["range_m"], whole["range_m"][3:11, 5:15], rtol=1e-5)


def test_an_integrator_serves_one_scene_after_another() -> None:
    """Its tables follow the scene that is rendered."""
    integrator = mi.load_dict({"type": "echo"})
    scenes = [mi.load_dict({"type": "scene", "s": camera(), "f": floor(diffuse(value))}) for value in (0.2, 0.7)]
    for loaded, value in zip([*scenes, scenes[0]], (0.2, 0.7, 0.2), strict=True):
        image = np.array(mi.render(loaded, integrator=integrator))
        hit = image[..., 1] == 1
        np.testing.assert_allclose(image[..., 1 + CHANNELS.index("reflectivity")][hit], value, rtol=1e-6)


def test_reflectivity_follows_an_edited_scene() -> None:
    """``mi.traverse`` changes a reflectance; the next rendering shows it."""
    loaded = mi.load_dict(
        {"type": "scene", "i": {"type": "echo"}, "s": camera(), "box": box((0, 3, 0), (2, 2, 1), diffuse(0.2))}
    )
    place = 1 + CHANNELS.index("reflectivity")
    assert np.array(mi.render(loaded))[..., place].max() == pytest.approx(0.2)
    parameters = mi.traverse(loaded)
    parameters["box.bsdf.reflectance.value"] = mi.Float(0.6)
    parameters.update()
    assert np.array(mi.render(loaded))[..., place].max() == pytest.approx(0.6)
    assert dr.width(parameters["box.bsdf.reflectance.value"]) == 1


# ---------------------------------------------------------------- cells below 1.15 deg of grazing

LOW = 0.5
"""Height of a sonar that sees the floor as flat as 0.48 deg, at 60 m [m]."""


def low_sonar(**fields: Any) -> Sonar:
    """A fan of 14 deg from 3 m to 60 m; its uppermost rays meet no floor."""
    given = {"azimuth_fov_deg": 30, "beams": 12, "beam_width_deg": 0.3, "rays_per_beam": 700, "rays_across": 4}
    return Sonar(**{**given, "range_min": 3.0, "range_max": 60.0, "range_bins": 1000, **fields})


@pytest.mark.parametrize("gain_exponent", essence([0, 2], 2))
@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_a_flat_floor_is_whole_down_to_the_flattest_angles(bearing: str, gain_exponent: int) -> None:
    """Every bin of one ping against the integral of C cos dOmega / R^2: cells tile the range axis beyond R = 50 h too."""
    sonar, pitch = low_sonar(bearing=bearing, gain_exponent=gain_exponent), np.radians(6)
    truth = floor_levels(sonar, LOW, pitch, 0.5)
    got = next(Simulator(scene(floor=floor(half=2000.0)), sonar).pings([[0, 0, LOW, pitch, 0, 0]])).levels[0].astype(float)
    for part in (sonar.range_m < 50 * LOW, sonar.range_m >= 50 * LOW):
        assert (got[part] > 0).all(), f"{100 * (got[part] == 0).mean():.1f} % of the bins are empty"
        error = 10 * np.log10(got[part] / truth[part])
        assert np.percentile(np.abs(error), 95) < 0.5, f"95 % within {np.percentile(np.abs(error), 95):.2f} dB"
        assert np.abs(error).max() < 1.0
        assert abs(10 * np.log10(got[part].sum() / truth[part].sum())) < 0.02


@pytest.mark.parametrize("jitter", [True, False])
def test_flat_cells_join_without_gap_or_overlap(jitter: bool) -> None:
    """Where a cell ends the next begins, also where a cell is a tenth of the range long."""
    sonar = low_sonar(rays_per_beam=200, jitter=jitter)
    simulator = Simulator(scene(floor=floor(half=2000.0)), sonar)
    got = simulator.tracer.film_echoes([0, 0, LOW, np.radians(6), 0, 0], 0)
    near, far, radius = (values.reshape(200, sonar.columns) for values in (got.near_m, got.far_m, got.range_m))
    flat = (radius[:-1] > 60 * LOW) & (radius[1:] > 60 * LOW) & (radius[:-1] < 400 * LOW)
    assert flat.sum() > 5 * sonar.columns
    assert np.abs(near[:-1] - far[1:])[flat].max() < 2e-3
    assert (far - near)[:-1][flat].max() > 0.1 * radius[:-1][flat].min()


@pytest.mark.thorough
def test_bodies_do_not_reach_farther_beyond_their_horizon() -> None:
    """Where the edge of a cell misses, the slope is held: nothing lies R de / 0.02 beyond a ray, and little beyond."""
    radius, distance = 0.1, 4.0
    window = {"range_min": 3.8, "range_max": 5.0, "range_bins": 600}
    sonar = low_sonar(azimuth_fov_deg=4, beams=8, beam_width_deg=None, bearing="cone", **window)
    simulator = Simulator(scene(ball=sphere((0, distance, 0), radius)), sonar)
    levels = np.concatenate([pings.levels for pings in simulator.pings([[0, 0, 0, 0, 0, 0]] * 40)]).astype(float)
    horizon = np.sqrt(distance**2 - radius**2)
    beyond = levels[:, sonar.range_m - sonar.bin_m / 2 > horizon].sum() / levels.sum()
    assert beyond < 1.5e-3
    got = simulator.tracer.film_echoes([0, 0, 0, 0, 0, 0], 0)
    reach = 2 * distance * np.radians(14) / 700 / 0.02  # a ray may be at the other edge, and a beam's width is aside
    assert (got.far_m - got.range_m).max() < reach


def test_an_edge_on_another_surface_is_not_followed() -> None:
    """A step of the floor: cells at its brink end there, not on the lower floor behind it."""
    low, high = floor(half=2000.0), box((0, -30, 0.1), (50, 60, 0.1))  # the brink at 30 m is 0.2 m high
    sonar, pose = low_sonar(jitter=False), [0, 0, LOW + 0.2, np.radians(6), 0, 0]
    got = Simulator(scene(low=low, high=high), sonar).tracer.film_echoes(pose, 0)
    brink = (got.hit > 0) & (got.z > 0.1) & (np.abs(got.nz) > 0.5)
    assert got.range_m[brink].max() > 28
    behind = (got.far_m[brink] * got.y[brink] / got.range_m[brink]).max()
    assert 30 < behind < 30 + 30 * np.radians(14) / 700 / 0.02


@pytest.mark.thorough
def test_a_receiver_hears_a_whole_floor_too() -> None:
    """Half of the path by way of the edge: against ten times the rays, no gaps beyond R = 50 h."""
    result = []
    for rays in (700, 7000):
        sonar = low_sonar(rays_per_beam=rays, rays_across=8, beam_width_deg=None, range_min=26.0, range_bins=400)
        receiver = Receiver(sonar, sonar, Pose(0, 0, 0.3), "b")
        simulator = Simulator(scene(floor=floor(half=2000.0)), sonar, views=[receiver])
        result.append(next(simulator.render_views([[0, 0, LOW, 0.1, 0, 0]]))[0].levels[0].astype(float))
    few, many = result
    assert (few > 0).all()
    assert np.percentile(np.abs(10 * np.log10(few / many)), 95) < 0.5


# ---------------------------------------------------------------- derivatives


def relief(folder: Path) -> MitsubaDict:
    """Gentle waves under a sonar that sees nothing else."""
    ground = trimesh.creation.box((10, 10, 0.1)).subdivide().subdivide().subdivide()
    ground.vertices[:, 2] += 0.04 * np.sin(2 * ground.vertices[:, 0]) * np.cos(1.5 * ground.vertices[:, 1])
    ground.export(folder / "ground.ply")
    return {"type": "ply", "filename": str(folder / "ground.ply"), "face_normals": True, "bsdf": diffuse(0.4)}


@pytest.mark.parametrize("moved", ["ground", "sonar"])
def test_ranges_have_the_derivatives_of_central_differences(tmp_path: Path, moved: str) -> None:
    """Of the sums of ranges, ends of cells and heights of points, by the height of the ground and of the sonar."""
    pose = to_world_matrices(np.array([[0, -3, 2.0, 0.6, 0, 0]]))[0]
    sensor = {"type": "imaging_sonar", "beams": 24, "rays_per_beam": 40, "to_world": mi.ScalarTransform4f(pose)}
    loaded = mi.load_dict({"type": "scene", "integrator": {"type": "echo"}, "sonar": sensor, "ground": relief(tmp_path)})
    params = mi.traverse(loaded)
    place, stood = mi.Float(params["ground.vertex_positions"]), mi.Transform4f(params["sonar.to_world"])

    def rendered(height: mi.Float) -> mi.TensorXf:
        if moved == "ground":
            upward = dr.arange(mi.UInt32, dr.width(place)) % 3 == 2
            params["ground.vertex_positions"] = dr.select(upward, place + height, place)
        else:
            params["sonar.to_world"] = mi.Transform4f().translate(mi.Vector3f(0, 0, height)) @ stood
        params.update()
        return mi.render(loaded, params, spp=1)

    height = mi.Float(0)
    dr.enable_grad(height)
    image = rendered(height)
    dr.forward(height)
    slope = np.array(dr.grad(image))
    above, below = (np.array(rendered(mi.Float(step))).astype(float) for step in (1e-3, -1e-3))
    assert (above[..., 1] == 1).all()
    for name in ("range_m", "near_m", "far_m", *(["z"] if moved == "ground" else [])):
        channel = 1 + CHANNELS.index(name)
        truth = (above - below)[..., channel].sum() / 2e-3
        assert slope[..., channel].sum() == pytest.approx(truth, rel=1e-3)


def test_reflectivity_has_derivatives_by_the_reflectance(tmp_path: Path) -> None:
    sensor = {"type": "imaging_sonar", "beams": 8, "rays_per_beam": 16}
    shapes = {"ground": relief(tmp_path), "sonar": {**sensor, "to_world": mi.ScalarTransform4f().look_at(
        origin=[0, 0, 3], target=[0, 2, 0], up=[0, 0, 1])}}  # fmt: skip
    loaded = mi.load_dict({"type": "scene", "integrator": {"type": "echo"}, **shapes})
    params = mi.traverse(loaded)
    level = mi.Float(0.4)
    dr.enable_grad(level)
    params["ground.bsdf.reflectance.value"] = type(params["ground.bsdf.reflectance.value"])(level)
    params.update()
    image = mi.render(loaded, params, spp=1)
    dr.forward(level)
    reflectivity = 1 + CHANNELS.index("reflectivity")
    slope, hit = np.array(dr.grad(image))[..., reflectivity], np.array(image)[..., 1] == 1
    np.testing.assert_allclose(slope, hit, atol=1e-4)
    assert hit.all()


def test_a_pose_that_scales_is_refused() -> None:
    loaded = mi.load_dict({"type": "scene", "integrator": {"type": "echo"}, "sonar": {"type": "imaging_sonar"}})
    params = mi.traverse(loaded)
    params["sonar.to_world"] = mi.Transform4f().scale(2)
    with pytest.raises(MitsonarError, match="may only rotate and translate"):
        params.update()
