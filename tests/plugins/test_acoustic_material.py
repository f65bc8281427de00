"""The BSDF `acoustic_material`: its law in both models against closed forms, its variation, its mistakes, and cameras."""

from __future__ import annotations

import math
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import yaml
from helpers import Array, MitsubaDict, diffuse, essence, floor, scene

import mitsonar
from mitsonar.acoustics.materials import GRAZING_DEG, material, mu_at, mu_table, sigma_at, sigma_table, single_mu
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator

pytestmark = pytest.mark.usefixtures("variant")

SONAR = Sonar(azimuth_fov_deg=3, elevation_fov_deg=3, beams=12, range_min=4, range_max=6, range_bins=40, rays_per_beam=400,
              rays_across=40, gain_exponent=4, frequency_hz=3e5)  # fmt: skip
TABLE = (-45 + 30 * np.sin(np.radians(GRAZING_DEG)) - 5 * np.cos(4 * np.radians(GRAZING_DEG))).round(3).tolist()
ABSORBS_NOTHING = {"absorption_db_per_m": 0.0, "elevation_pattern": "box", "coding": "linear"}


def made_of(name: str | Path, **properties: object) -> MitsubaDict:
    return {"type": "acoustic_material", "material": str(name), **properties}


@pytest.fixture
def steep(tmp_path: Path) -> Path:
    """A table that rises by 30 dB, with a bump."""
    (tmp_path / "steep.yaml").write_text(yaml.safe_dump({"law": "table", "strength_db": TABLE}))
    return tmp_path / "steep.yaml"


def down(count: int, slant: float) -> mi.Ray3f:
    """Rays on the plane z = 0 at angles of incidence from 0 to `slant` rad."""
    angle = dr.linspace(mi.Float, 0, slant, count)
    return mi.Ray3f(mi.Point3f(0.013, 0.017, 2), mi.Vector3f(dr.sin(angle), 0, -dr.cos(angle)))


def reflectivity(loaded: mi.Scene, ray: mi.Ray3f, sonar: Sonar | None = SONAR) -> np.ndarray:
    from mitsonar.plugins.surfaces import Surfaces

    tables = Surfaces.from_scene(loaded)
    hit = (tables if sonar is None else tables.at_frequency_of(sonar)).hit(loaded, ray)
    assert np.array(hit.valid).all()
    return np.array(hit.reflectivity)


# ---------------------------------------------------------------- the law


def tilted(bsdf: MitsubaDict, incidence: float) -> mi.Scene:
    """A plate 5 m ahead (y) that turns its normal by `incidence`; seen from the sonar it is 10 cm wide and high."""
    upright = mi.ScalarTransform4f().translate([0, 5, 0]).rotate([1, 0, 0], 90 - math.degrees(incidence))
    size = upright.scale([0.05, 0.05 / math.cos(incidence), 1])
    return scene(plate={"type": "rectangle", "to_world": size, "bsdf": bsdf})


@pytest.mark.parametrize("degrees", [0, 20, 45, 60, 70, 80])
def test_a_plate_returns_sigma_times_area(steep: Path, degrees: int) -> None:
    """With a gain of R^4 all levels of a ping sum to the integral of sigma over the area, sigma A but for its curvature."""
    incidence = math.radians(degrees)
    (pings,) = Simulator(tilted(made_of(steep), incidence), SONAR).pings(np.zeros(6))
    side = np.linspace(-1, 1, 201) * 0.05
    x, along = np.meshgrid(side, side / math.cos(incidence))
    place = np.stack([x, 5 + along * math.sin(incidence), along * math.cos(incidence)])
    normal = np.array([0, -math.cos(incidence), math.sin(incidence)])
    cosine = np.abs(np.einsum("i,ijk->jk", normal, place)) / np.linalg.norm(place, axis=0)
    area = 0.01 / math.cos(incidence)
    sigma = sigma_at(material(steep), cosine, 3e5).mean()
    assert sigma == pytest.approx(float(sigma_at(material(steep), math.cos(incidence), 3e5)), rel=0.01)
    assert pings.levels.sum() == pytest.approx(sigma * area, rel=0.01)


@pytest.mark.parametrize("degrees", essence([0, 45, 75], 45))
def test_coherent_pings_return_the_same(steep: Path, degrees: int) -> None:
    """Speckle averaged over places: 0.3 dB. The floor's law against that of one number at the same angle."""
    sonar = Sonar.create(model="coherent", frequency_hz=1e6, beams=48, azimuth_fov_deg=14.5, beam_width_deg=0.3,
                         elevation_fov_deg=1, range_min=4.5, range_max=5.5, range_bins=128, bearing="cone",
                         quality="draft", **ABSORBS_NOTHING)  # fmt: skip
    pitch, height = math.radians(90 - degrees), 5 * math.cos(math.radians(degrees))
    shifts = np.arange(8)[:, None] * np.array([1.7, 0.9, 0, 0, 0, 0])
    poses = np.array([0, 0, height, pitch, 0, 0]) + shifts

    def energy(bsdf: MitsubaDict, sonar: Sonar = sonar) -> float:
        result = Simulator(scene(floor=floor(bsdf)), sonar).pings(poses)
        return float(np.mean([pings.levels.sum(axis=(1, 2)) for pings in result]))

    expected = float(mu_at(mu_table(material(steep), 1e6), math.cos(math.radians(degrees))))
    got = energy(made_of(steep)) / energy(diffuse(expected))
    smooth = energy(made_of(steep), sonar.replace(model="physical")) / energy(
        diffuse(expected), sonar.replace(model="physical")
    )
    assert 10 * math.log10(got) == pytest.approx(0, abs=0.3)
    assert 10 * math.log10(got / smooth) == pytest.approx(0, abs=0.1)


@pytest.mark.parametrize("name", ["sand", "rock", "steel"])
def test_rays_read_the_law_at_their_angle(name: str) -> None:
    flat_box = {"type": "cube", "to_world": mi.ScalarTransform4f().scale([99, 99, 1e-3]), "bsdf": made_of(name)}
    for shape in (floor(made_of(name)), flat_box):
        loaded = scene(floor=shape)
        got = reflectivity(loaded, down(500, 1.54))
        expected = mu_at(mu_table(material(name), 3e5), np.cos(np.linspace(0, 1.54, 500)))
        np.testing.assert_allclose(got, expected, rtol=3e-3)


def test_lambert_equals_diffuse_to_the_bit(tmp_path: Path) -> None:
    """The same levels in each model, as a flat plate and as a body with noise on it."""
    (tmp_path / "matt.yaml").write_text("law: lambert\nmu: 0.15")
    noise = {"type": "cell_noise", "cells": 100, "low": 0.2, "high": 0.4}
    for model in ("physical", "thesis"):
        sonar = SONAR.replace(model=model, gain_exponent=0, rays_per_beam=50)
        pose = np.array([0, 0, 3, math.radians(40), 0, 0])

        def levels(bsdf: MitsubaDict, sonar: Sonar = sonar, pose: np.ndarray = pose) -> np.ndarray:
            result = next(iter(Simulator(scene(floor=floor(bsdf, 20)), sonar).pings(pose)))
            assert result.levels.any()
            return result.levels

        np.testing.assert_array_equal(levels(made_of(tmp_path / "matt.yaml")), levels(diffuse(0.15)))
        varied = levels(made_of(tmp_path / "matt.yaml", reflectance=noise, reflectance_mean=0.15))
        np.testing.assert_allclose(varied, levels(diffuse(noise)), rtol=1e-6)


def test_the_thesis_ignores_the_law(steep: Path) -> None:
    sonar = SONAR.replace(model="thesis")
    np.testing.assert_allclose(reflectivity(scene(f=floor(made_of("steel"))), down(50, 1.5), sonar), 0.281, rtol=1e-6)
    normal = sigma_table(material(steep), 3e5)[90]
    np.testing.assert_allclose(reflectivity(scene(f=floor(made_of(steep))), down(50, 1.5), sonar), normal, rtol=1e-5)


def test_without_a_sonar_one_number_stands_for_the_law(steep: Path) -> None:
    """As impulse responses take it, and `reflectivity_at`."""
    for name in ("steel", steep):
        loaded = scene(floor=floor(made_of(name)))
        np.testing.assert_allclose(reflectivity(loaded, down(50, 1.5), None), single_mu(material(name)), rtol=1e-6)
        from mitsonar.plugins.bsdf_reflectance import reflectivity_at

        si = loaded.ray_intersect(down(50, 1.5))
        got = np.array(reflectivity_at(loaded.shapes()[0].bsdf(), si))
        np.testing.assert_allclose(got, single_mu(material(name)), rtol=1e-6)


def test_flat_angles_stay_within_the_sums(tmp_path: Path) -> None:
    """A cross-section that is large at all angles: reflectivity times cosine is 1 at most, and nothing is infinite."""
    (tmp_path / "loud.yaml").write_text(yaml.safe_dump({"law": "table", "strength_db": [20.0] * 91}))
    loaded = scene(floor=floor(made_of(tmp_path / "loud.yaml"), 1e6))
    got = reflectivity(loaded, down(2000, 1.5707))
    assert np.isfinite(got).all()
    assert (got * np.cos(np.linspace(0, 1.5707, 2000))).max() < 1.001
    with pytest.warns(MitsonarWarning, match="material loud scatters more than sonars can sum"):
        Simulator(loaded, SONAR).render([[0, 0, 3, 0.7, 0, 0]])


# ---------------------------------------------------------------- variation, kinds of shapes


def test_only_the_relative_variation_counts() -> None:
    noise = {"type": "cell_noise", "cells": 60}
    plain = reflectivity(scene(f=floor(made_of("sand"), 3)), down(4000, 0.9))
    varied = reflectivity(scene(f=floor(made_of("sand", reflectance=noise), 3)), down(4000, 0.9))
    local = reflectivity(scene(f=floor(diffuse(noise), 3)), down(4000, 0.9))
    np.testing.assert_allclose(varied / plain, local / 0.5, rtol=1e-4)
    dark = reflectivity(scene(f=floor(made_of("sand", reflectance=0.05), 3)), down(4000, 0.9))
    np.testing.assert_allclose(dark, plain, rtol=1e-6)


def test_a_level_shifts_the_law_at_every_angle() -> None:
    ray = down(300, 0.9)
    plain, louder = (reflectivity(scene(f=floor(made_of("mud", **level), 3)), ray) for level in ({}, {"level_db": 6.0}))
    np.testing.assert_allclose(louder, plain * 10**0.6, rtol=1e-5)


def test_levels_of_images_follow_the_level_of_a_material() -> None:
    """Images are proportional to 10^(level_db / 10), so that d image / d level_db is ln(10) / 10 times the image."""
    loaded = scene(f=floor(made_of("sand")))
    sonar = SONAR.replace(model="physical", jitter=False)
    simulator, params = mitsonar.DifferentiableSimulator(loaded, sonar, edge_points=0), mi.traverse(loaded)
    key = next(key for key, _ in params if key.endswith("level_db"))
    dr.enable_grad(params[key])
    params.update()
    levels = simulator.levels([0, 0, 3.0, math.radians(40), 0, 0])
    dr.forward(params[key])
    image = np.array(levels)
    np.testing.assert_allclose(np.array(dr.grad(levels)), image * math.log(10) / 10, rtol=1e-4, atol=1e-9 * image.max())


CONSTANTS = {
    "density_ratio": ("mud", 0.05),
    "sound_speed_ratio": ("mud", 0.01),
    "loss": ("mud", 0.001),
    "volume": ("mud", 0.0005),
    "spectral_exponent": ("mud", 0.02),
    "spectral_strength": ("mud", 1e-6),
    "mu": ("sand-mhz", 0.001),
    "roughness_m": ("steel", 1e-5),
}
"""Constants of laws with a material that has them, and the step of a difference."""


@pytest.mark.parametrize("name", essence(CONSTANTS, "spectral_exponent", "mu"))
def test_levels_of_images_follow_the_constants_of_a_law(name: str) -> None:
    """The derivative is that of a difference between images with other constants, also after a step."""
    material, step = CONSTANTS[name]
    loaded = scene(f=floor(made_of(material)))
    simulator = mitsonar.DifferentiableSimulator(loaded, SONAR.replace(model="physical", jitter=False), edge_points=0)
    params, pose = mi.traverse(loaded), [0, 0, 3.0, math.radians(40), 0, 0]
    key = next(key for key, _ in params if key.endswith(f".{name}"))
    begin = float(params[key][0])

    def image_at(value: float) -> Array:
        params[key] = mi.Float(value)
        params.update()
        return np.array(simulator.levels(pose), dtype=np.float64)

    expected = (image_at(begin + step) - image_at(begin - step)) / (2 * step)
    params[key] = mi.Float(begin)
    dr.enable_grad(params[key])
    params.update()
    levels = simulator.levels(pose)
    dr.forward(params[key])
    result = np.array(dr.grad(levels), dtype=np.float64)
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(result, expected, rtol=0.01, atol=2e-3 * np.abs(expected).max())


def test_small_constants_have_derivatives(tmp_path: Path) -> None:
    """The step is relative: a strength of 2e-7 m^0.75 is far below the usual ones, and stays above 0."""
    from mitsonar.plugins.material_laws import law_rows, material_of

    mud = material("mud").model_dump(exclude_none=True, exclude={"source", "about"})
    (tmp_path / "smooth.yaml").write_text(yaml.safe_dump({**mud, "spectral_strength": 2e-7}))
    loaded = scene(f=floor(made_of(tmp_path / "smooth.yaml")))
    bsdf, params = material_of(loaded.shapes()[0]), mi.traverse(loaded)
    assert bsdf is not None
    constant = params["f.bsdf.spectral_strength"]
    dr.enable_grad(constant)
    laws = law_rows([bsdf], SONAR)
    dr.forward(constant)
    above, below = (
        mu_table(bsdf.material.model_copy(update={"spectral_strength": 2e-7 + step}), SONAR.frequency_hz or 0.0).values
        for step in (1e-9, -1e-9)
    )
    expected = (above - below)[:-1] / 2e-9 / bsdf.mu
    np.testing.assert_allclose(np.array(dr.grad(laws))[0:180:2], expected, rtol=1e-3)


def test_strengths_of_a_tabulated_law_have_derivatives(steep: Path) -> None:
    """One decibel more at every angle is one decibel more of the image; each cell depends on the angles that it sees."""
    loaded = scene(f=floor(made_of(steep)))
    simulator = mitsonar.DifferentiableSimulator(loaded, SONAR.replace(model="physical", jitter=False), edge_points=0)
    params = mi.traverse(loaded)
    key = next(key for key, _ in params if key.endswith("strength_db"))
    dr.enable_grad(params[key])
    params.update()
    levels = simulator.levels([0, 0, 3.0, math.radians(40), 0, 0])
    dr.backward(dr.sum(levels))
    by_angle = np.array(dr.grad(params[key]))
    assert by_angle.sum() == pytest.approx(math.log(10) / 10 * np.array(levels).sum(), rel=1e-3)
    assert np.flatnonzero(by_angle).min() >= 30  # grazing angles of the ranges 4 to 6 m from a height of 3 m
    assert np.flatnonzero(by_angle).max() <= 49


def test_equal_materials_have_constants_of_their_own() -> None:
    """Two halves of a floor, which differ for cameras only: the image depends on each by a constant of its own."""
    place = mi.ScalarTransform4f()
    halves = [
        {**floor(made_of("mud", reflectance=0.4 + 0.1 * k)), "to_world": place.translate([6 * k - 3, 3, 0]).scale(3)}
        for k in range(2)
    ]
    loaded = scene(port=halves[0], starboard=halves[1])
    simulator = mitsonar.DifferentiableSimulator(loaded, SONAR.replace(model="physical", jitter=False), edge_points=0)
    params, pose, parts = mi.traverse(loaded), [0, 0, 3.0, math.radians(40), 0, 0], []
    for key in ("port.bsdf.volume", "starboard.bsdf.volume"):
        dr.enable_grad(params[key])
        params.update()
        levels = simulator.levels(pose)
        dr.forward(params[key])
        parts.append(np.array(dr.grad(levels)).sum(axis=0))
        dr.disable_grad(params[key])
    port, starboard = parts
    assert (port[:5] > 0).all()
    assert (starboard[:5] == 0).all()
    assert (starboard[7:] > 0).all()
    assert (port[7:] == 0).all()


def test_constants_outside_their_limits_are_refused() -> None:
    params = mi.traverse(scene(f=floor(made_of("mud"))))
    key = next(key for key, _ in params if key.endswith("density_ratio"))
    params[key] = mi.Float(0.1)
    with pytest.raises(MitsonarError, match=r"density_ratio.*0\.5.*got 0\.1"):
        params.update()


def test_materials_and_other_surfaces_side_by_side() -> None:
    """Numbers of materials, mirrors, and bits of shapes that have none."""
    from mitsonar.plugins.surfaces import Surfaces

    def at(k: int) -> MitsubaDict:
        return {"type": "cube" if k % 2 else "rectangle", "to_world": mi.ScalarTransform4f().translate([3 * k, 0, 0])}

    wrapped = {"type": "twosided", "inner": made_of("sand", reflectance=0.2)}
    bsdfs = {"a": made_of("steel"), "b": diffuse(0.3), "c": made_of("sand"), "d": wrapped, "e": made_of("steel")}
    loaded = scene(**{name: {**at(k), "bsdf": bsdf} for k, (name, bsdf) in enumerate(bsdfs.items())})
    tables = Surfaces.from_scene(loaded).at_frequency_of(SONAR)
    assert not tables.notes or all("extrapolated" in note for note in tables.notes)
    hit = tables.hit(loaded, mi.Ray3f(mi.Point3f(3 * dr.arange(mi.Float, 6), 0.1, 5), mi.Vector3f(0.01, 0, -1)))
    numbers = np.array(hit.material)[:5].tolist()
    names = [tables.materials[number].material.name if number >= 0 else "" for number in numbers]
    assert names == ["steel", "", "sand", "sand", "steel"]
    v, rough = (np.array(part)[:5] for part in tables.mirror(hit.material))
    np.testing.assert_allclose(v, [0.94, 0, 0, 0, 0.94], rtol=1e-6)
    np.testing.assert_allclose(rough, [1e-4, 0, 0, 0, 1e-4], rtol=1e-6)
    assert np.array(hit.reflectivity)[1] == np.float32(0.3)
    assert np.array(hit.material)[5] == -1


def test_a_scene_without_materials_gathers_nothing() -> None:
    from mitsonar.plugins.surfaces import Surfaces

    tables = Surfaces.from_scene(scene(floor=floor()))
    assert tables.at_frequency_of(SONAR) is tables
    assert not tables.lawful


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "twosided", "front": made_of("sand"), "back": made_of("rock")},
        {"type": "blendbsdf", "weight": 0.5, "a": made_of("sand"), "b": diffuse(0.2)},
    ],
    ids=["two materials", "a material beside a BSDF"],
)
def test_a_shape_has_one_material(bsdf: MitsubaDict) -> None:
    with pytest.raises(MitsonarError, match=r"shape floor must have a single material: .*sand"):
        Simulator(scene(floor=floor(bsdf)), SONAR)


# ---------------------------------------------------------------- files, mistakes, cameras

XML = """<scene version="3.0.0">
    <default name="name" value="mine.yaml"/>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><scale value="20"/></transform>
        <bsdf type="acoustic_material">
            <string name="material" value="$name"/> <float name="reflectance" value="0.3"/>
        </bsdf>
    </shape>
    <emitter type="constant"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, -5" target="0, 1, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="8"/> <integer name="height" value="8"/></film>
    </sensor>
    <integrator type="path"/>
</scene>"""


@pytest.fixture
def xml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene in a folder that is not the current one."""
    monkeypatch.chdir("/")
    (tmp_path / "scene.xml").write_text(XML)
    (tmp_path / "mine.yaml").write_text("material: sand\nvolume: 0.001")
    return tmp_path / "scene.xml"


def test_a_file_counts_from_the_scene(xml: Path) -> None:
    from mitsonar.plugins.surfaces import Surfaces

    (one,) = Surfaces.from_scene(load_scene(xml)).materials
    assert (one.material.name, one.material.volume) == ("mine", 0.001)


def test_cameras_see_a_diffuse_surface_from_both_sides(xml: Path) -> None:
    """Under a white sky a matt body shows its reflectance; and here from below."""
    image = np.array(mi.render(load_scene(xml), spp=64))
    assert image.mean() == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("snad", "did you mean sand"),
        ("none.yaml", "none.yaml"),
        ("", "needs a material: concrete"),
    ],
)
def test_a_missing_material_is_named(xml: Path, name: str, words: str) -> None:
    with pytest.raises(MitsonarError, match=words) as caught:
        load_scene(xml, name=name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        *("law: lambert\nmu: 5", "law: lambert", "- 1", "law: table\nstrength_db: [1, 2]"),
        *("a: &a [*a, *a]", "mu: .nan", "\x00", "!!python/object:os.system {}"),
    ],
)
def test_a_hostile_file_is_refused(xml: Path, content: str) -> None:
    (xml.parent / "mine.yaml").write_text(content)
    with pytest.raises(MitsonarError):
        load_scene(xml)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "shapes"),
    [
        ("sunken_ship", {"seabed": "sand-mhz", "rocks": "stone", "ship": "steel"}),
        ("observatory", {"seabed": "sand-mhz", "torpedo": "steel", "cable": "rubber", "amphora": "fired_clay"}),
    ],
)
def test_shipped_scenes_have_materials_that_hold_at_their_carrier(name: str, shapes: dict[str, str]) -> None:
    loaded = load_scene(name)
    simulator = Simulator(loaded)
    assert simulator.notes == []
    result = {shape.id(): shape.bsdf() for shape in loaded.shapes()}
    assert {key: result[key].material.name for key in shapes} == shapes


@pytest.mark.parametrize("name", ["flat_floor", "pattern", "objects"])
def test_floors_of_measured_scenes_take_a_material_on_demand(name: str) -> None:
    """Unasked they are what they were: a diffuse BSDF."""
    shape = load_scene(name).shapes()
    assert not any(type(one.bsdf()).__name__ == "AcousticMaterial" for one in shape)
    arguments = [one.bsdf() for one in load_scene(name, floor_material="gravel").shapes()]
    assert [one.material.name for one in arguments if type(one).__name__ == "AcousticMaterial"] == ["gravel"]


@pytest.mark.thorough
def test_no_material_is_a_diffuse_surface() -> None:
    noise = {"type": "cell_noise", "cells": 50}
    got = reflectivity(scene(f=floor(made_of("none", reflectance=noise), 3)), down(900, 0.9))
    np.testing.assert_array_equal(got, reflectivity(scene(f=floor(diffuse(noise), 3)), down(900, 0.9)))
    with pytest.raises(RuntimeError, match="reflectance_mean"):
        mi.load_dict(made_of("none", reflectance_mean=0.3))


def test_a_reflectance_without_mean(tmp_path: Path) -> None:
    black = {"type": "uniform", "value": 0.0}
    with pytest.raises(RuntimeError, match="whose mean is above 0"):
        mi.load_dict(made_of("sand", reflectance=black))
    by_face = {"type": "mesh_attribute", "name": "face_reflectivity"}
    with pytest.raises(RuntimeError, match="give it as reflectance_mean"):
        mi.load_dict(made_of("sand", reflectance=by_face))
    assert mi.load_dict(made_of("sand", reflectance=by_face, reflectance_mean=0.5)) is not None
