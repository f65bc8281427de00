"""The sensor `imaging_sonar`: its film, the directions of its rays against plain NumPy, its jitter, its solid angles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import MitsubaDict, angles, axes, cells, direction, essence
from scipy import stats

from mitsonar.arrays import DeviceArray
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import preset
from mitsonar.motion.pose import Pose, to_world_matrices

if TYPE_CHECKING:
    from mitsonar.plugins.imaging_sonar_sensor import Fan, ImagingSonar

pytestmark = pytest.mark.usefixtures("variant")

POSE = Pose(1.0, -2.0, 3.0, 0.4, -0.2, 2.1)

KINDS: dict[str, MitsubaDict] = {
    "azimuth": {"bearing": "azimuth"},
    "cone": {"bearing": "cone"},
    "azimuth, narrow beams": {"bearing": "azimuth", "beam_width_deg": 1.1},
    "cone, sine layout": {"bearing": "cone", "beam_layout": "sine", "beam_width_deg": 2.0},
    "azimuth, thesis": {"bearing": "azimuth", "model": "thesis"},
    "cone, thesis": {"bearing": "cone", "model": "thesis"},
}


def sensor(pose: Pose = POSE, **fields: Any) -> ImagingSonar:
    """A sensor of 8 beams, 100 x 60 deg, at a pose."""
    given = {"azimuth_fov_deg": 100.0, "elevation_fov_deg": 60.0, "beams": 8, "rays_per_beam": 12}
    given |= {"rays_across": 4, **fields}
    to_world = mi.ScalarTransform4f(to_world_matrices(pose)[0])
    return cast("ImagingSonar", mi.load_dict({"type": "imaging_sonar", "to_world": to_world, **given}))


def rays(source: mi.Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions ``(rays, 3)`` in the world, film order."""
    width, height = source.film().size()
    index = dr.arange(mi.UInt32, width * height)
    place = mi.Point2f((mi.Float(index % width) + 0.5) / width, (mi.Float(index // width) + 0.5) / height)
    time: DeviceArray = 0
    half: DeviceArray = 0.5
    ray, weight = source.sample_ray_differential(time, half, place, mi.Point2f(0.5))
    assert (np.array(weight) == 1).all()
    return np.broadcast_to(np.array(ray.o).T, (width * height, 3)), np.array(ray.d).T


def local(world: np.ndarray, pose: Pose = POSE) -> np.ndarray:
    """Directions as (starboard, forward, up) of a pose."""
    return np.asarray(world @ np.array(axes(pose)).T)


def fan(source: ImagingSonar) -> Fan:
    """The sensor's own record of all its rays."""
    width, height = source.film().size()
    index = dr.arange(mi.UInt32, width * height)
    return source.film_fan(mi.Point2f((mi.Float(index % width) + 0.5) / width, (mi.Float(index // width) + 0.5) / height))


# ---------------------------------------------------------------- properties and film


def test_properties_are_those_of_a_sonar() -> None:
    fields: MitsubaDict = {
        **{"azimuth_fov_deg": 33.0, "elevation_fov_deg": 9.0, "beams": 5, "rays_per_beam": 7, "range_min": 1.5},
        **{"range_max": 2.5, "range_bins": 11, "sound_speed": 1480.0, "bearing": "cone", "beam_layout": "sine"},
        **{"beam_width_deg": 0.7, "rays_across": 3, "jitter": False, "seed": 4, "model": "thesis"},
        **{"gain_exponent": 2, "frame_rate_hz": 15.0, "quality": "fine", "thesis_rays": 6},
        **{"frequency_hz": 1e6, "bandwidth_hz": 2e4, "pattern": "receive", "shading": "taylor", "focus_m": 4.0, "looks": 2},
        **{"elevation_pattern": "box", "scatterers_per_cell": 5.0, "scatterer_spacing_m": 0.01, "speckle_nu": 2.0},
        **{"speckle_patch_m": 0.2, "source_level_db": 210.0, "noise_level_db": 60.0, "absorption_db_per_m": 0.3},
        **{"temperature_c": 4.0, "salinity_psu": 0.5, "water_depth_m": 3.0, "ph": 7.0, "gain_absorption": True},
        **{
            "bounces": 1,
            "ping_groups": 5,
            "group_order": "sequential",
            "group_interval_s": 0.004,
            "group_overhead_s": 0.001,
            "volume_db": -70.0,
            "near_glow_db": 30.0,
            "near_glow_m": 0.4,
        },
        **{
            "near_glow_edge_db": 12.0,
            "near_glow_spread_db": 2.0,
            "near_glow_still": 0.9,
            "array_error": 0.1,
            "taper_db": 3.0,
        },
        **{"detector_offset_db": -60.0, "detector_spread_db": 0.5, "group_stripes_db": 0.25},
        **{"tail_db": -17.0, "tail_m": 0.08, "saturation_db": -20.0},
        **{"crosstalk_db": -49.0, "stripes_db": 0.5, "coding": "gamma", "coding_db": 90.0, "coding_gamma": 0.6},
    }
    assert set(fields) == set(Sonar.model_fields) - {"name", "pulse_m"}  # the band says it
    loaded = mi.load_dict({"type": "imaging_sonar", **fields})
    assert loaded.sonar == Sonar(**fields)
    assert mi.load_dict({"type": "imaging_sonar", "bounces": 3}).sonar == Sonar(bounces=3)
    assert mi.load_dict({"type": "imaging_sonar"}).sonar == Sonar()


def test_preset_and_what_changes_it() -> None:
    loaded = mi.load_dict({"type": "imaging_sonar", "preset": "aris3000", "beams": 4, "rays_per_beam": 3})
    assert loaded.sonar == preset("aris3000").replace(beams=4, rays_per_beam=3)


def test_pose_is_read_from_to_world() -> None:
    np.testing.assert_allclose(sensor().pose, POSE, atol=1e-6)
    origin, _ = rays(sensor())
    np.testing.assert_allclose(origin, np.broadcast_to(POSE[:3], origin.shape), rtol=1e-6)


@pytest.mark.parametrize(("model", "size"), [("physical", (32, 12)), ("thesis", (8, 12))])
def test_film_follows_from_beams_and_rays(model: str, size: tuple[int, int]) -> None:
    film = sensor(model=model).film()
    assert tuple(film.size()) == size
    assert film.rfilter().is_box_filter()


def film(width: int, height: int, rfilter: str = "box", **more: Any) -> MitsubaDict:
    return {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": rfilter}, **more}


def test_film_that_agrees_is_taken() -> None:
    assert tuple(sensor(film=film(32, 12)).film().size()) == (32, 12)


CROP: MitsubaDict = {"crop_width": 8, "crop_height": 12, "crop_offset_x": 0, "crop_offset_y": 0}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"film": film(768, 576)}, r"the film must be 32 x 12 pixels.* got 768 x 576; remove the film"),
        ({"film": film(32, 12, **CROP)}, r"the film must be 32 x 12 pixels.* got 8 x 12"),
        ({"film": film(32, 12, "gaussian")}, r"the film must have a box filter"),
        ({"beems": 3}, r"beems"),
        ({"preset": "didson30"}, r"unknown sonar preset 'didson30': did you mean didson300"),
        ({"beams": 0}, r"sonar beams: .* got 0"),
        ({"range_max": 1.0}, r"range_max must exceed range_min: got 1 m <= 3\.2 m"),
        ({"ping": -1}, r"ping must be 0 or more: got -1"),
        ({"to_world": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]}, r"only rotate and translate"),
    ],
)
def test_contradictions_are_errors_that_say_so(fields: MitsubaDict, message: str) -> None:
    if "to_world" in fields:
        fields = {"to_world": mi.ScalarTransform4f(fields["to_world"])}
    with pytest.raises(RuntimeError, match=message):
        sensor(**fields)


# ---------------------------------------------------------------- directions of the rays


@pytest.mark.parametrize("kind", KINDS)
def test_directions_follow_the_formulas(kind: str) -> None:
    """The direction d follows azimuth or cone, rays at the middle of their cells, row 0 highest, column 0 most to port."""
    source = sensor(**KINDS[kind], jitter=False)
    bearing, elevation = cells(source.sonar)
    _, d = rays(source)
    np.testing.assert_allclose(local(d), direction(source.sonar, bearing, elevation), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-6)


def test_port_is_left_and_up_is_above() -> None:
    source = sensor(jitter=False)
    d = local(rays(source)[1]).reshape(12, 32, 3)
    assert (np.diff(d[:, :, 0], axis=1) > 0).all()  # to starboard with the column
    assert (np.diff(d[:, :, 2], axis=0) < 0).all()  # down with the row


def place_in_cell(source: ImagingSonar) -> tuple[np.ndarray, np.ndarray]:
    """Where each ray is in its cell, 0..1 across and along, ``(rays over elevation, rays across)``."""
    sonar = source.sonar
    size = (sonar.beam_width_rad / sonar.across, np.radians(sonar.elevation_fov_deg) / sonar.rays_per_beam)
    result = zip(angles(sonar, local(rays(source)[1])), cells(sonar), size, strict=True)
    across, along = ((got - middle) / step + 0.5 for got, middle, step in result)
    shape = (sonar.rays_per_beam, sonar.columns)
    return across.reshape(shape), along.reshape(shape)


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_jitter_stays_in_its_cell_and_fills_it(bearing: str) -> None:
    """Within the cell to float32's 1e-6 rad of its 5e-3, and uniform there (Kolmogorov and Smirnov)."""
    for axis in place_in_cell(sensor(bearing=bearing, rays_per_beam=200)):
        assert -1e-3 < axis.min() < 0.01
        assert 0.99 < axis.max() < 1 + 1e-3
        assert stats.kstest(axis.ravel(), "uniform").pvalue > 1e-4


def test_neighbouring_rays_are_moved_independently() -> None:
    """Correlations of the two coordinates, and of rays up to four columns or rows apart, within 4.5 / sqrt(rays)."""
    across, along = place_in_cell(sensor(rays_per_beam=400))
    pairs = {"the two coordinates": (across, along)}
    for name, axis in (("across", across), ("along", along)):
        for step in range(1, 5):
            pairs[f"{name}, {step} columns apart"] = (axis[:, step:], axis[:, :-step])
            pairs[f"{name}, {step} rows apart"] = (axis[step:], axis[:-step])
    z = {name: np.corrcoef(a.ravel(), b.ravel())[0, 1] * np.sqrt(a.size) for name, (a, b) in pairs.items()}
    assert all(abs(value) < 4.5 for value in z.values()), {name: f"z = {value:.1f}" for name, value in z.items()}


def test_jitter_is_another_draw_each_ping_and_repeats_with_the_seed() -> None:
    def drawn(**fields: Any) -> np.ndarray:
        return rays(sensor(**fields))[1]

    first = drawn(seed=3, ping=5)
    np.testing.assert_array_equal(drawn(seed=3, ping=5), first)
    still = drawn(jitter=False)
    for second in (drawn(seed=3, ping=6), drawn(seed=4, ping=5), still):
        assert (np.abs(second - first).max(axis=1) > 0).mean() > 0.99
    a, b = (drawn(seed=3, ping=ping, rays_per_beam=300) - drawn(jitter=False, rays_per_beam=300) for ping in (0, 1))
    for axis in range(3):  # and an independent one
        assert abs(np.corrcoef(a[:, axis], b[:, axis])[0, 1]) * np.sqrt(len(a)) < 4.5


@pytest.mark.parametrize("jitter", [True, False])
@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_edges_and_middle_of_the_cell_follow_from_the_ray(bearing: str, jitter: bool) -> None:
    source = sensor(bearing=bearing, jitter=jitter)
    bearing_of_cell, elevation_of_cell = cells(source.sonar)
    got = fan(source)
    b, e = angles(source.sonar, local(rays(source)[1]))
    height = np.radians(60) / 12
    np.testing.assert_allclose(np.array(got.elevation) + np.zeros(len(e)), e, atol=1e-6)
    np.testing.assert_allclose(e + np.array(got.above), elevation_of_cell + height / 2, atol=2e-6)
    np.testing.assert_allclose(e + np.array(got.below), elevation_of_cell - height / 2, atol=2e-6)
    np.testing.assert_allclose(b + np.array(got.aside), bearing_of_cell, atol=2e-6)


@pytest.mark.parametrize("jitter", [True, False])
@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_solid_angles_add_up_to_that_of_the_field_of_view(bearing: str, jitter: bool) -> None:
    """Azimuth: the integral of cos(e) de da = 2 sin(E/2) A. Cone: of cos(b) db de = 2 sin(A/2) E."""
    source = sensor(bearing=bearing, jitter=jitter)
    across, along = np.radians(100), np.radians(60)
    total = {"azimuth": 2 * np.sin(along / 2) * across, "cone": 2 * np.sin(across / 2) * along}[bearing]
    cell = np.array(fan(source).solid_angle) + np.zeros(source.sonar.rays)
    assert cell.sum(dtype=float) == pytest.approx(total, rel=1e-6)
    b, e = cells(source.sonar)
    factor = np.cos(e) if bearing == "azimuth" else np.cos(b)
    np.testing.assert_allclose(cell / cell.max(), factor / factor.max(), rtol=1e-6)


@pytest.mark.parametrize("jitter", essence([True, False], True))
@pytest.mark.parametrize("kind", ["azimuth", "cone", "cone, sine layout"])
def test_lift_and_side_are_the_derivatives(kind: str, jitter: bool) -> None:
    """Against central differences of the formulas in float64, at the rays' own angles."""
    source = sensor(**KINDS[kind], jitter=jitter)
    got, sonar, step = fan(source), source.sonar, 1e-4

    def seen(vector: DeviceArray) -> np.ndarray:  # sensor axes (port, up, forward) to (starboard, forward, up)
        port, up, forward = (np.array(axis) + np.zeros(sonar.rays) for axis in vector)
        return np.stack([-port, forward, up], axis=1)

    b, e = angles(sonar, seen(got.d))
    lift = (direction(sonar, b, e + step) - direction(sonar, b, e - step)) / (2 * step)
    side = (direction(sonar, b + step, e) - direction(sonar, b - step, e)) / (2 * step)
    np.testing.assert_allclose(seen(got.lift), lift, atol=2e-6)
    np.testing.assert_allclose(seen(got.side), side, atol=2e-6)
    np.testing.assert_allclose(seen(got.d) @ np.array(axes(POSE)), rays(source)[1], atol=1e-6)
