"""Mirrors of the model coherent against closed forms, and plates against Kirchhoff's integral in plain NumPy."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import trimesh
from helpers import Array, box, diffuse, essence, floor, plate, scene, sphere

from mitsonar.acoustics.materials import Material, material, mirror_amplitude
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.models.coherent import CoherentImager
    from mitsonar.simulation.multipath_coherent import MirrorTracer

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

SONAR = Sonar.create(model="coherent", frequency_hz=1.8e6, beams=96, azimuth_fov_deg=29.0, range_min=4.5, range_max=5.6,
                     range_bins=256, bearing="cone", elevation_pattern="box", absorption_db_per_m=0.0)  # fmt: skip
"""A DIDSON without a pattern over elevation."""

K = 2 * np.pi * 1.8e6 / 1500
RANGE = 5.0
STILL = np.zeros(6)


def imager(loaded: mi.Scene, sonar: Sonar = SONAR, **mirrors: tuple[float, float] | Material) -> CoherentImager:
    from mitsonar.simulation.models.coherent import CoherentImager

    return CoherentImager(loaded, sonar, mirrors)


def tracer(loaded: mi.Scene, sonar: Sonar = SONAR, **mirrors: tuple[float, float]) -> MirrorTracer:
    result = imager(loaded, sonar, **mirrors).glints
    assert result is not None
    return result


def echo(source: MirrorTracer, pose: Array = STILL) -> complex:
    """The sum of a field: what a receiver without a pattern hears. Deposit on the grid keeps it."""
    return complex(source.field(pose).astype(complex).sum())


def decibels(got: complex, wanted: complex) -> float:
    return float(20 * np.log10(abs(got) / abs(wanted)))


# ---------------------------------------------------------------- planes


def tilted(tilt_deg: float, about: str) -> Array:
    """The pose of a sonar that sees the origin's plate of normal -y from 5 m at this angle, about z or about x."""
    tilt = math.radians(tilt_deg)
    if about == "z":
        return np.array([-RANGE * math.sin(tilt), -RANGE * math.cos(tilt), 0, 0, 0, tilt])
    return np.array([0, -RANGE * math.cos(tilt), RANGE * math.sin(tilt), tilt, 0, 0])


def kirchhoff(size: float, pose: Array, step: float = 4e-4, k: float = K) -> complex:
    """Kirchhoff's integral over a square plate in y = 0, V = 1."""
    n = max(200, math.ceil(size / step))
    x = ((np.arange(n) + 0.5) / n - 0.5) * size
    r = np.sqrt((x[:, None] - pose[0]) ** 2 + pose[1] ** 2 + (x - pose[2]) ** 2)
    return complex((1j * k / (2 * np.pi) * abs(pose[1]) / r**3 * np.exp(-2j * k * r)).sum() * (size / n) ** 2)


@pytest.mark.parametrize("size", essence([0.02, 0.05, 0.1, 0.2, 0.3], 0.05, 0.3))
def test_plates_are_those_of_the_integral(size: float) -> None:
    """Amplitude within 0.5 dB and phase within 0.1, up to 1 deg of tilt; 0.5 deg for small plates, then side lobes."""
    source = tracer(scene(target=plate([0, 0, 0], [0, -1, 0], half=size / 2)), target=(1.0, 0.0))
    for tilt in (0.0, 0.25, 0.5, 1.0) if size > 0.05 else (0.0, 0.25, 0.5):
        for about in "zx":
            pose = tilted(tilt, about)
            ratio = echo(source, pose) / kirchhoff(size, pose)
            assert decibels(ratio, 1) == pytest.approx(0, abs=0.5), (tilt, about)
            assert np.angle(ratio) == pytest.approx(0, abs=0.1)


WIDE = SONAR.replace(frequency_hz=4.5e5, beams=24, azimuth_fov_deg=60.0, beam_width_deg=4.0, range_min=4.0, range_max=8.0,
                     pattern="receive")  # fmt: skip
"""Rays of this sonar are 9 cm apart at 5 m."""


@pytest.mark.parametrize("size", [0.05, 0.1])
def test_mirrors_between_two_rays_echo(size: float) -> None:
    """Wherever the fan looks, a plate narrower than a column is that of the integral: 1 dB."""
    source = tracer(scene(target=plate([0, 0, 0], [0, -1, 0], half=size / 2)), WIDE, target=(1.0, 0.0))
    expected = kirchhoff(size, tilted(0, "z"), k=K / 4)
    for turned in np.linspace(0, 0.02, 7):
        pose = tilted(0, "z") + np.array([0, 0, 0, turned / 2, 0, turned])
        assert decibels(echo(source, pose), expected) == pytest.approx(0, abs=1.0)


@pytest.mark.parametrize("tilt_deg", [14.0, 22.0])
def test_edges_of_small_plates_echo_far_from_the_normal(tilt_deg: float) -> None:
    sonar = WIDE.replace(frequency_hz=4.5e4)
    source = tracer(scene(target=plate([0, 0, 0], [0, -1, 0], half=0.125)), sonar, target=(1.0, 0.0))
    pose = tilted(tilt_deg, "z")
    assert decibels(echo(source, pose), kirchhoff(0.25, pose, k=K / 40)) == pytest.approx(0, abs=1.0)


def test_a_mirror_narrower_than_the_finest_rays_is_warned_of() -> None:
    source = tracer(scene(target=plate([0, 0, 0], [0, -1, 0], half=0.005)), WIDE, target=(1.0, 0.0))
    with pytest.warns(MitsonarWarning, match=r"target: narrower than four of the finest rays.*choose a finer quality"):
        source.field(tilted(0, "z"))


def test_pieces_of_a_mesh_are_narrow_each_by_its_own_width(tmp_path: Path) -> None:
    """Two balls 3 m apart in one mesh, and a rod: second extents, not the box around all."""
    from mitsonar.simulation.mirrors import Mirrors
    from mitsonar.simulation.narrow_mirrors import NarrowMirrors

    balls = [trimesh.creation.icosphere(radius=0.1).apply_translation([x, 5, 0]) for x in (-1.5, 1.5)]
    rod = trimesh.creation.cylinder(0.02, 2.0).apply_translation([0, 5, 0])
    bodies = trimesh.util.concatenate([*balls, rod])
    assert isinstance(bodies, trimesh.Trimesh)
    bodies.export(path := tmp_path / "bodies.ply")
    loaded = scene(bodies={"type": "ply", "filename": str(path)})
    narrow = NarrowMirrors.from_scene(loaded, Mirrors(np.ones(1), np.zeros(1)))
    assert sorted(narrow.width) == pytest.approx([0.02 * math.sqrt(6), 0.2, 0.2], rel=0.02)
    assert len(narrow.corners) == len(balls[0].faces) * 2 + len(rod.faces)


def test_a_mesh_is_the_plate_that_its_face_is() -> None:
    one = tracer(scene(target=plate([0, 0, 0], [0, -1, 0], half=0.1)), target=(1.0, 0.0))
    second = tracer(scene(target=box([0, 0.05, 0], [0.1, 0.05, 0.1])), target=(1.0, 0.0))
    pose = tilted(0.25, "z")
    assert decibels(echo(one, pose), echo(second, pose)) == pytest.approx(0, abs=0.1)


@pytest.mark.parametrize("range_m", [2.0, 5.0])
def test_a_plane_is_a_mirror(range_m: float) -> None:
    """1 / 2R: 0.2 dB. A window over sine and range takes the edges of the fan away."""
    sonar = SONAR.replace(frequency_hz=3e5, azimuth_fov_deg=50.0, elevation_fov_deg=30.0, beams=40, range_min=range_m - 1,
                          range_max=range_m + 1, range_bins=64, elevation_pattern="receive")  # fmt: skip
    source = tracer(scene(wall=plate([0, range_m, 0], [0, -1, 0])), sonar, wall=(-1.0, 0.0))
    grid = source.former
    sine = grid.first_sine + np.arange(grid.sines) * grid.sine_step
    beyond = grid.first_range + np.arange(grid.ranges) * grid.range_step - range_m
    window = np.outer(*(np.cos(np.clip(x, 0, 1) * np.pi / 2) ** 2 for x in (beyond / 0.5, np.abs(sine) / 0.4)))
    total = complex((source.field(STILL).astype(complex) * window).sum())
    assert decibels(total, 1 / (2 * range_m)) == pytest.approx(0, abs=0.2)
    k = 2 * np.pi * 3e5 / sonar.sound_speed
    assert np.angle(-total * np.exp(2j * k * range_m)) == pytest.approx(0, abs=0.05)


# ---------------------------------------------------------------- spheres


def ball_echo(radius: float, centre: Array, k: float = K) -> complex:
    """A rigid sphere's echo where k a is large: a / 2 R (R + a), R its nearest range; a^2 / 4 far away."""
    away = float(np.linalg.norm(centre)) - radius
    return complex(radius / (2 * away * (away + radius)) * np.exp(-2j * k * away))


SPHERES = [(0.01, 4.0), (0.05, 3.0), (0.05, 10.0), (0.1, 5.0), (0.25, 3.0), (0.25, 10.0)]


@pytest.mark.parametrize(("radius", "range_m"), essence(SPHERES, (0.01, 4.0), (0.25, 3.0)))
def test_spheres_have_a_quarter_of_their_square(radius: float, range_m: float) -> None:
    """0.5 dB, on the axis of the fan and beside it."""
    sonar = SONAR.replace(range_min=range_m - 0.5, range_max=range_m + 0.5)
    for aside in ((0.0, 0.0), (0.013, 0.021)):
        centre = np.array([aside[0], range_m + radius, aside[1]])
        ratio = echo(tracer(scene(ball=sphere(centre, radius)), sonar, ball=(1.0, 0.0))) / ball_echo(radius, centre)
        assert decibels(ratio, 1) == pytest.approx(0, abs=0.5)
        assert np.angle(ratio) == pytest.approx(0, abs=0.1)


@pytest.mark.thorough
@pytest.mark.parametrize("words", essence([{}, {"pulse_m": 0.012, "beam_width_deg": 0.9, "pattern": "receive"}], {}))
def test_target_strength_is_read_from_an_image(words: dict[str, float | str]) -> None:
    """The sum of the levels over bins and beams, times spacing over width, times R^4: a^2 / 4 within 0.5 dB."""
    sonar = SONAR.replace(**words)
    for aside in (0.0, 0.01, 0.02):
        centre = np.array([aside, 5.1, 0.011])
        image = imager(scene(ball=sphere(centre, 0.1)), sonar, ball=(1.0, 0.0)).image(STILL, 0)[0]
        seen = float((np.abs(image) ** 2).sum()) * sonar.beam_spacing_rad / sonar.beam_width_rad
        assert 10 * np.log10(seen / abs(ball_echo(0.1, centre)) ** 2) == pytest.approx(0, abs=0.5)


def test_coarse_cells_are_warned_of() -> None:
    """The sonar's cells are 6.5 mm, half the Fresnel radius of a sphere of 5 cm is 2.3 mm; divided, none is too large."""
    from mitsonar.simulation.multipath_coherent import MirrorTracer

    source = tracer(scene(ball=sphere([0, 5.05, 0], 0.05)), ball=(1.0, 0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        source.field(STILL)
    from mitsonar.simulation.mirrors import mirror_of

    mirrors = mirror_of(source.scene, {"ball": (1.0, 0.0)})
    assert mirrors is not None
    coarse = MirrorTracer(source.scene, SONAR, source.former, mirrors, finest=1)
    with pytest.warns(MitsonarWarning, match=r"half the Fresnel radius.*[\d,]+ rays are needed"):
        coarse.field(STILL)
    with warnings.catch_warnings():  # said once
        warnings.simplefilter("error")
        coarse.field(STILL)


# ---------------------------------------------------------------- rough and off


def test_roughness_takes_its_share() -> None:
    """The mirror's amplitude falls by exp(-2 k^2 h^2), what is scattered keeps 1 - exp(-4 k^2 h^2 cos^2) of its energy."""
    loaded = scene(target=plate([0, 5, 0], [0, -1, 0], half=0.05))
    smooth = echo(tracer(loaded, target=(1.0, 0.0)))
    for height in (2e-5, 1e-4):
        ratio = echo(tracer(loaded, target=(0.8, height))) / smooth
        assert abs(ratio) == pytest.approx(0.8 * math.exp(-2 * (K * height) ** 2), rel=2e-3)
        sources = imager(loaded), imager(loaded, target=(0.8, height))
        scattered = [np.abs(source.tracer.field(STILL)[0]).sum() for source in sources]
        assert scattered[1] / scattered[0] == pytest.approx(math.sqrt(1 - math.exp(-4 * (K * height) ** 2)), rel=2e-3)
    assert not imager(loaded, target=(0.8, 0.0)).tracer.field(STILL)[0].any()


def test_a_material_gives_its_mirror_part() -> None:
    result = Material.create(law="lambert", mu=0.1, reflection=0.7, roughness_m=5e-5)
    loaded = scene(target=plate([0, 5, 0], [0, -1, 0], half=0.05))
    source = imager(loaded, target=result).glints
    assert source is not None
    expected = float(mirror_amplitude(result, 1.0, 1.8e6))
    assert abs(echo(source) / echo(tracer(loaded, target=(1.0, 0.0)))) == pytest.approx(expected, rel=2e-3)


@pytest.mark.thorough
def test_without_mirrors_the_bits_are_the_same() -> None:
    loaded = scene(ground=floor(diffuse(0.5)), behind=sphere([0, -5, 2.5], 0.3))
    pose = np.array([0, 0, 2.5, math.radians(35), 0, 0])
    plain = imager(loaded)
    assert plain.glints is None
    assert plain.tracer.mirrors is None
    image = plain.image(pose, 0)[0]
    lambert = Material.create(law="lambert", mu=0.1)
    for part in ({"ground": (0.0, 1e-4)}, {"ground": lambert}):
        off = imager(loaded, **part)
        assert off.glints is None
        np.testing.assert_array_equal(off.image(pose, 0)[0], image)
    unseen = imager(loaded, behind=(1.0, 0.0))
    assert unseen.glints is not None
    np.testing.assert_array_equal(unseen.image(pose, 0)[0], image)


def test_threads_and_repeats_do_not_change_bits() -> None:
    import drjit as dr

    source = tracer(scene(ball=sphere([0.1, 5.1, 0], 0.1)), ball=(1.0, 0.0))
    before, fields = dr.thread_count(), [source.field(STILL)]
    try:
        for count in (1, 2, 3):
            dr.set_thread_count(count)
            fields.append(source.field(STILL))
    finally:
        dr.set_thread_count(before)
    for field in fields[1:]:
        np.testing.assert_array_equal(field, fields[0])


def test_a_mirror_glints_through_the_simulator() -> None:
    """A smooth plate at 5 m returns 10 dB and more above the matt one, and only where it faces the sonar."""
    loaded = scene(target=plate([0, 5, 0], [0, -1, 0], half=0.15))
    brightest = [
        next(iter(Simulator(loaded, SONAR, mirrors=part).pings(STILL))).levels.max() for part in (None, {"target": (1.0, 0)})
    ]
    assert 10 * np.log10(brightest[1] / brightest[0]) > 10
    leaning = tracer(scene(target=plate([0, 5, 0], [1, -1, 0], half=0.15)), target=(1.0, 0.0))
    assert abs(echo(leaning)) < 1e-3 * 1 / (2 * RANGE)


def test_mistakes_are_one_sentence() -> None:
    loaded = scene(target=plate([0, 5, 0], [0, -1, 0], half=0.15))
    with pytest.raises(MitsonarError, match="no shape hull: known: target"):
        imager(loaded, hull=(1.0, 0.0))
    for part in ((1.5, 0.0), (1.0, -1e-4), (math.nan, 0.0), (0.5, math.inf)):
        with pytest.raises(MitsonarError, match=r"must lie in -1\.\.1"):
            imager(loaded, target=part)
    with pytest.raises(MitsonarError, match="model physical has no mirrors"):
        Simulator(loaded, SONAR.replace(model="physical", coding="linear"), mirrors={"target": (1.0, 0.0)})


def test_materials_bring_their_mirror_parts(variant: str) -> None:
    """Steel named in the scene is the mirror that its numbers make, and scatters the rest once."""
    from mitsonar.simulation.mirrors import mirror_of

    steel = {"type": "acoustic_material", "material": "steel"}
    loaded = scene(plate=plate((0, 5, 0), (0, -1, 0), half=0.05, bsdf=steel))
    result = mirror_of(loaded, "materials")
    assert result is not None
    local = material("steel")
    assert (result.reflection[0], result.roughness_m[0]) == (local.reflection, local.roughness_m)
    with pytest.raises(MitsonarError, match="or `materials`"):
        mirror_of(loaded, "all")  # type: ignore[arg-type]  # a slip of the user's
