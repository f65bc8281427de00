"""Mirrors of waves: their mean plane, their ghosts, their shadows, and what users are told."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from channel_scenes import C, received_from, unmerged
from helpers import diffuse, essence, plate
from numpy.typing import NDArray

from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.motion.pose import Pose
from mitsonar.simulation.channel import ChannelSimulator
from mitsonar.worlds.sea import SeaSurface
from mitsonar.worlds.world import Mesh

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.mirrors import FlatMirrors

pytestmark = pytest.mark.usefixtures("variant")

SEA = SeaSurface(wind_m_s=1.5, size_m=24.0, step_m=0.2, spreading=0.0)
POSE = Pose(0, 0, 6)
OFFSET = (0.4, 0.3, 0.0)
CARRIER = 10e3


def loaded(mesh: Mesh, folder: Path) -> dict[str, Any]:
    """A mesh as a shape of Mitsuba."""
    path = folder / "surface.ply"
    path.write_bytes(mesh.ply())
    return {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": diffuse(0.1)}


def instrument(**words: object) -> ChannelSonar:
    given: dict[str, Any] = {"receivers": (received_from(OFFSET),), "range_max": 40.0, "frequency_step_hz": 5.0}
    given |= {"carrier_hz": CARRIER, "bandwidth_hz": 2000.0, "sampling_hz": 4000.0, "points_per_m2": 1.0}
    return ChannelSonar(**{**given, **words})


def mirrors_of(scene: mi.Scene, reflection: float = -1.0, height: float = 0.0) -> FlatMirrors:
    from mitsonar.simulation.mirrors import flat_mirrors, mirror_of

    return flat_mirrors(scene, mirror_of(scene, {"surface": (reflection, height)}))


def ridges(height: float, length: float) -> Mesh:
    """Waves of one length along y, at z = 10, facing down: in steps of 0.1 m."""
    flat = SeaSurface(wind_m_s=1.5, size_m=24.0, step_m=0.1).surface(0)
    vertices = flat.vertices.copy()
    vertices[:, 2] = 10 + height * np.sin(2 * np.pi * vertices[:, 1] / length)
    return Mesh("surface", vertices, flat.faces)


def test_the_mean_plane_of_waves_has_their_rms_height(tmp_path: Path) -> None:
    """Of 0.1 m ridges 0.1 / sqrt 2, with the roughness in squares; every point lies within the slab."""
    result = mirrors_of(unmerged(surface=loaded(ridges(0.1, 2.0), tmp_path)), -0.9, 0.02)
    assert not result.planes
    (mean,) = result.means
    assert np.abs(mean.normal) == pytest.approx([0, 0, 1], abs=2e-3)
    assert abs(mean.offset) == pytest.approx(10, abs=1e-3)
    assert mean.roughness_m == pytest.approx(np.hypot(0.1 / np.sqrt(2), 0.02), rel=0.01)
    assert mean.slab_m == pytest.approx(0.1, rel=0.15)
    assert (mean.name, mean.reflection) == ("surface", -0.9)
    assert result.reflecting(1) == []
    assert result.reflecting(2) == [mean]


def test_what_is_no_plane_with_waves_makes_no_ghosts(tmp_path: Path) -> None:
    """A ball of facets; with several reflections a note says so."""
    import trimesh

    ball = trimesh.creation.icosphere(3, 2.0)
    scene = unmerged(surface=loaded(Mesh("surface", np.add(ball.vertices, (0, 0, 9)), ball.faces), tmp_path))
    result = mirrors_of(scene)
    assert result.means == []
    assert result.notes_on(1) == []
    assert result.notes_on(2) == ["the mirror surface is not a plane with waves: it reflects once and makes no ghosts"]
    built = ChannelSimulator(scene, instrument(bounces=3), mirrors={"surface": (-1.0, 0.0)})
    assert built.kinds == ("scatterer", "surface")


@pytest.mark.slow
@pytest.mark.parametrize("out", essence([True, False], True))
def test_ghosts_by_waves_are_those_of_their_mean_plane_with_the_loss_of_all_waves(out: bool, tmp_path: Path) -> None:
    """Delay and amplitude of a flat plate at that plane, whose roughness is that of all waves; crests hide nothing."""
    target = plate((1.0, 8.0, 4.0), (-0.35, -0.8, 0.5), half=0.1)
    waves = unmerged(plate=target, surface=loaded(SEA.surface(5), tmp_path))
    height = SEA.state.roughness_m
    (mean,) = mirrors_of(waves, -1.0, height).means
    assert mean.roughness_m == pytest.approx(SEA.state.significant_height_m / 4, rel=0.3)
    flat = unmerged(
        plate=target, surface=plate(mean.offset * mean.normal, -mean.normal * np.sign(mean.normal[2]), half=12.0)
    )
    sonar = instrument(points_per_m2=25.0, bounces=3)
    name = "surface-scatterer" if out else "scatterer-surface"
    by_waves = ChannelSimulator(waves, sonar, mirrors={"surface": (-1.0, height)}).paths(POSE)
    by_plate = ChannelSimulator(flat, sonar, mirrors={"surface": (-1.0, mean.roughness_m)}).paths(POSE)
    for way in (name, "surface-scatterer-surface"):
        one, second = strongest(by_waves.by(way)), strongest(by_plate.by(way))
        assert one[0] == pytest.approx(second[0], abs=1e-9)
        assert one[1] == pytest.approx(second[1], rel=1e-3)
    smooth = ChannelSimulator(flat, sonar, mirrors={"surface": (-1.0, 0.0)}).paths(POSE)
    assert abs(strongest(by_waves.by(name))[1]) < 0.8 * abs(strongest(smooth.by(name))[1])


def strongest(paths: Any) -> tuple[float, complex]:
    """Delay and amplitude of the strongest path: that of the target."""
    place = int(np.argmax(np.abs(paths.amplitude)))
    return float(paths.delay_s[place]), complex(paths.amplitude[place])


def test_single_echoes_of_waves_are_kirchhoffs_integral(tmp_path: Path) -> None:
    """Where no crest is in the way, the sum of all facets at every frequency; over a sea it differs from the flat one."""
    from mitsonar.simulation.mirror_paths import facet_echoes

    scene = unmerged(surface=loaded(SEA.surface(5), tmp_path))
    roughness = SEA.state.roughness_m
    built = ChannelSimulator(scene, instrument(), mirrors={"surface": (-1.0, roughness)})
    paths = built.paths(POSE).by("surface")
    (waves,) = built.tracer.flat.facets
    start, end = np.array(POSE[:3]), np.add(POSE[:3], OFFSET)
    result = facet_echoes(waves, start, end, np.zeros(3), CARRIER, C)
    assert len(paths.delay_s) == len(result.delay)  # straight above all facets are seen

    def total(delay: NDArray[np.float64], amplitude: NDArray[np.complex128]) -> complex:
        return complex((amplitude * np.exp(-2j * np.pi * CARRIER * delay)).sum())

    expected = total(result.delay, result.amplitude)
    assert total(paths.delay_s, paths.amplitude) == pytest.approx(expected, rel=1e-4)
    assert abs(expected * 2 * 4.0 + np.exp(-2j * np.pi * CARRIER * 8.0 / C)) > 0.1  # no plane's


def test_crests_hide_facets_from_a_sonar_at_grazing(tmp_path: Path) -> None:
    """The facets that are seen are those whose line to the sonar stays below the waves: all but 2 % at edges of shadows."""
    from mitsonar.simulation.scatterers import link_table

    height, length = 0.3, 3.0
    scene = unmerged(surface=loaded(ridges(height, length), tmp_path))
    one = received_from((0.0, 0.002, 0.0))
    result = ChannelSimulator(scene, instrument(receivers=(one,)), mirrors={"surface": (-1.0, 0.0)})
    (waves,) = result.tracer.flat.facets
    place = Pose(0, -11.0, 8.8)
    seen = result.without_scatterer._lit(waves, link_table(result.sonar, 0, np.array(place), np.zeros(4)), scene)
    some = slice(None, None, 23)
    middle, seen = waves.corners[some].mean(axis=1), seen[some]
    part = np.linspace(0.003, 0.997, 500)[:, None]
    y, z = (np.array(place[axis]) * (1 - part) + middle[:, axis] * part for axis in (1, 2))
    clear = (z < 10 + height * np.sin(2 * np.pi * y / length) + 2e-3).all(axis=0)
    assert 0.3 < clear.mean() < 0.9
    assert (seen == clear).mean() > 0.98


def test_facets_that_are_too_large_are_told_of(tmp_path: Path) -> None:
    """0.28 m is less than half the Fresnel radius at 5 kHz, and more at 80 kHz."""
    scene = unmerged(surface=loaded(SEA.surface(5), tmp_path))
    for carrier, message in ((5e3, False), (80e3, True)):
        result = ChannelSimulator(scene, instrument(carrier_hz=carrier), mirrors={"surface": (-1.0, 0.0)})
        result.paths(POSE)
        assert bool(result.notes) == message
    (note,) = result.notes
    assert note.startswith(
        "the facets of the mirror surface are 0.28 m long where its echo comes from, more than half the F"
    )
    result.paths(POSE)
    assert len(result.notes) == 1


def test_several_reflections_by_waves_are_told_of(tmp_path: Path) -> None:
    scene = unmerged(surface=loaded(SEA.surface(5), tmp_path))
    (note,) = ChannelSimulator(scene, instrument(bounces=2), mirrors={"surface": (-1.0, 0.0)}).notes
    assert "have the coherent part of its mean plane, with the loss of its waves' rms height, 0.01" in note
    assert ChannelSimulator(scene, instrument(), mirrors={"surface": (-1.0, 0.0)}).notes == []
