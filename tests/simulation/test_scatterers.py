"""Scatterers of the world: one in each cell, strengths, selection by a field of view, shadows, energy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from channel_scenes import CELLS, LEVEL, C, cells_floor, points, received_from, scatterers_of, simulator
from helpers import box, diffuse, essence, floor, scene, sphere

from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView, Hydrophone
from mitsonar.motion.pose import Pose
from mitsonar.simulation.channel import ChannelSimulator

if TYPE_CHECKING:
    pass

pytestmark = pytest.mark.usefixtures("variant")


def test_every_cell_has_one_point_inside_it_whoever_looks() -> None:
    result = simulator(ChannelSonar(), floor=cells_floor(cells=64.0))
    place = points(result)
    assert len(place) == 64**2
    cell = np.floor((place[:, :2] / 28 + 0.5) * 64).astype(int)
    assert len(np.unique(cell, axis=0)) == 64**2
    within = (place[:, :2] / 28 + 0.5) * 64 - cell
    for axis in within.T:  # uniform in the cell: Kolmogorov's distance
        assert np.abs(np.sort(axis) - (np.arange(64**2) + 0.5) / 64**2).max() < 1.63 / 64
    second = simulator(ChannelSonar(seed=8, range_max=20.0), floor=cells_floor(cells=64.0))
    assert np.array_equal(points(second), place)
    different = simulator(ChannelSonar(), floor=floor(diffuse({**CELLS, "cells": 64.0, "seed": 6}), 14.0))
    assert not np.array_equal(points(different), place)


@pytest.mark.thorough
@pytest.mark.parametrize("shape", essence(["rectangle", "mesh", "sphere"], "mesh"))
def test_strengths_add_up_to_reflectivity_times_area(shape: str) -> None:
    kinds = {
        "rectangle": (floor(diffuse(0.3), 2.0), 16.0),
        "mesh": (box((0, 0, 0), (1, 2, 3), diffuse(0.3)), 88.0),
        "sphere": (sphere((0, 0, 0), 1.5, diffuse(0.3)), 4 * np.pi * 2.25),
    }
    body, area = kinds[shape]
    strength = scatterers_of(simulator(ChannelSonar(points_per_m2=20_000.0), body=body)).strength
    # each is drawn with |zeta|^2, whose mean and standard deviation are 1: the sum is known to 1 / sqrt(n)
    assert strength.sum(dtype=float) == pytest.approx(0.3 * area, rel=4 / np.sqrt(len(strength)))


def test_a_textured_floor_has_the_strength_of_its_cells() -> None:
    result = simulator(ChannelSonar(), floor=cells_floor())
    assert scatterers_of(result).strength.sum() == pytest.approx(0.5 * 28**2, rel=0.01)


def test_a_textured_cube_has_the_strength_of_all_faces() -> None:
    """Its six faces share one square of uv, of which each place had a scatterer on one of them."""
    body = box((0, 0, 0), (1, 2, 3), diffuse({**CELLS, "cells": 40.0}))
    strength = scatterers_of(simulator(ChannelSonar(points_per_m2=200.0), body=body)).strength
    assert strength.sum(dtype=float) == pytest.approx(0.5 * 88, rel=5 / np.sqrt(len(strength)))


def test_a_textured_mesh_without_uv_has_scatterers() -> None:
    import mitsuba as mi

    mesh = mi.Mesh("body", 3, 1)
    values = mi.traverse(mesh)
    values["vertex_positions"], values["faces"] = mi.Float([0, 0, 0, 2, 0, 0, 0, 2, 0]), mi.UInt32([0, 1, 2])
    values.update()
    mesh.set_bsdf(mi.load_dict(diffuse({**CELLS, "low": 0.3, "high": 0.3})))
    strength = scatterers_of(simulator(ChannelSonar(points_per_m2=1000.0), body=mesh)).strength
    assert strength.sum(dtype=float) == pytest.approx(0.3 * 2, rel=4 / np.sqrt(len(strength)))


def test_a_field_of_view_selects_all_that_it_receives() -> None:
    field = FieldOfView(heading_deg=40.0, tilt_deg=35.0, across_deg=17.0, along_deg=60.0)
    for one in (
        field,
        field.model_copy(update={"shape": "circular"}),
        FieldOfView(tilt_deg=90.0, across_deg=100.0, along_deg=170.0),
    ):
        sonar = ChannelSonar(receivers=(Hydrophone(name="one", field=one),))
        result = simulator(sonar, floor=cells_floor(), body=box((3, 4, 1), (1, 1, 1)))
        pose = np.array([1.0, -2.0, 6.0, 0.2, -0.1, 0.7])
        stored = scatterers_of(result)
        arguments = result.tracer.candidates(pose, 0)
        from mitsonar.motion.pose import vehicle_rotation

        way = stored.place - pose[:3]
        unit = way / np.linalg.norm(way, axis=1)[:, None]
        local = unit @ vehicle_rotation(pose).as_matrix()[0] @ one.axes.T
        front = np.einsum("pi,pi->p", stored.normal, unit) < 0
        receives = np.flatnonzero((one.sensitivity(*local.T) > 0) & front)
        assert len(receives) > 100
        assert np.isin(receives, arguments).all()
        assert len(arguments) < 0.8 * len(stored)


def test_bodies_hide_what_is_behind_them() -> None:
    sonar = ChannelSonar(receivers=(received_from(),))
    bare = simulator(sonar, floor=cells_floor()).paths(LEVEL)
    hidden = simulator(sonar, floor=cells_floor(), lid=box((0, 0, 5), (1.0, 1.0, 0.01), diffuse(0.0))).paths(LEVEL)
    shadow = (2 * 1.0 * 10 / 4.99) ** 2
    assert 1 - len(hidden.delay_s) / len(bare.delay_s) == pytest.approx(shadow / 28**2, rel=0.1)
    assert hidden.delay_s.min() > 2 * 10.19 / C  # straight below nothing is left


@pytest.mark.thorough
def test_energy_is_that_of_the_imaging_sonar() -> None:
    """Two routes to the energy of the floor: echoes of a receiver at the transmitter, and pixels of an image.

    The mean over 12 headings, since the power |zeta|^2 of each of the 40,000 points in view is drawn.
    """
    from mitsonar.instruments.sonar import Sonar
    from mitsonar.simulation.simulator import Simulator

    field = FieldOfView(tilt_deg=40.0, across_deg=20.0, along_deg=30.0, taper=0.0)
    sonar = ChannelSonar(receivers=(Hydrophone(name="one", field=field),), points_per_m2=2000.0)
    ground = scene(floor=floor(diffuse(0.5), 16.0))
    result = ChannelSimulator(ground, sonar)
    received = [result.paths(Pose(0, 0, 10, heading=heading)).amplitude for heading in np.linspace(0, 2 * np.pi, 12, False)]
    fan = Sonar(
        azimuth_fov_deg=20.0,
        elevation_fov_deg=30.0,
        beams=20,
        range_min=5.0,
        range_max=25.0,
        bearing="cone",
        rays_per_beam=400,
    )
    (pings,) = Simulator(ground, fan).pings([Pose(0, 0, 10, np.radians(50))])
    energy = np.mean([(np.abs(amplitude) ** 2).sum() for amplitude in received])
    assert energy == pytest.approx(pings.levels.sum(), rel=0.01)


# ---------------------------------------------------------------- the phases of points


HEIGHT = 3.0

RECEIVER_HEADINGS_DEG = (
    Hydrophone(name="down", field=FieldOfView(shape="circular", tilt_deg=0.0, across_deg=40.0, taper=0.0)),
    Hydrophone(name="oblique", field=FieldOfView(shape="circular", tilt_deg=20.0, across_deg=10.0, taper=0.0)),
)
"""Cones with hard edges, straight down and aside."""

SURFACES = {
    "425 points": (425.0, {}),
    "cells of 29 mm": (1.0, {**CELLS, "cells": 414.0}),
    "1700 points": (1700.0, {}),
    "6800 points": (6800.0, {}),
    "cells of 15 mm": (1.0, {**CELLS, "cells": 822.0}),
}
"""Points a square metre, or a texture of cells, whose reflectivity is 0.5 in the mean, of a floor of 12 x 12 m."""


def incoherent(field: FieldOfView) -> float:
    """The energy of a level floor's echoes that add in power, reflectivity 0.5: an integral in steps of 4 mm."""
    line = np.arange(-4, 4, 0.004) + 0.002
    x, y = np.meshgrid(line, line)
    way = np.stack([x, y, np.full_like(x, -HEIGHT)]).reshape(3, -1)
    far = np.linalg.norm(way, axis=0)
    gain = field.sensitivity(*(field.axes @ (way / far)))
    return float((gain**2 * 0.5 * (HEIGHT / far) ** 2 / far**4).sum() * 0.004**2)


@pytest.mark.parametrize("surface", [*essence(list(SURFACES)[:2]), *essence(list(SURFACES)[2:], rest=pytest.mark.slow)])
def test_a_level_floor_returns_the_incoherent_level_and_rayleigh_statistics(surface: str) -> None:
    """Whatever the density of points: within 0.3 dB, 600 poses, some 2,000 independent taps. Without phases of their own
    the points straight below return 0.7, 2.3 and 6.1 dB more, cells of 15 mm 3.6 dB more, and aside 1.7 dB less."""
    density, texture = SURFACES[surface]
    sonar = ChannelSonar(
        bandwidth_hz=19.2e3,
        sampling_hz=32e3,
        frequency_step_hz=80.0,
        range_max=4.0,
        receivers=RECEIVER_HEADINGS_DEG,
        points_per_m2=density,
    )
    result = simulator(sonar, floor=floor(diffuse(texture or 0.5), 6.0))
    rng = np.random.default_rng(3)
    poses = np.zeros((600, 6))
    poses[:, :2], poses[:, 2], poses[:, 5] = rng.uniform(-4, 4, (600, 2)), HEIGHT, rng.uniform(0, 6, 600)
    response = np.concatenate([part.response for part in result.pings(poses)]).astype(np.complex128)
    power = np.abs(response) ** 2
    pulse = float((sonar.pulse(np.arange(-3000, 3000) / sonar.sampling_hz) ** 2).sum())
    expected = pulse * np.array([incoherent(look.field) for look in RECEIVER_HEADINGS_DEG])
    level = 10 * np.log10(power.sum(axis=2).mean(axis=0) / expected)
    assert np.abs(level).max() < 0.3, f"{level} dB"
    mean = power.mean(axis=0)
    loud = [np.flatnonzero(one > 0.3 * one.max())[::2] for one in mean]
    ratio = np.concatenate([(power[:, k, taps] / mean[k, taps]).ravel() for k, taps in enumerate(loud)])
    assert ratio.std() == pytest.approx(1, abs=0.05)  # of an exponential law; a mirror has 0
    coherent = [np.abs(response[:, k, taps].mean(axis=0)) ** 2 / mean[k, taps] for k, taps in enumerate(loud)]
    assert np.concatenate(coherent).max() < 10 / len(poses)  # exponential with mean 1 / 600


def test_zeta_is_gaussian_and_white() -> None:
    """Powers exponential, phases uniform (Kolmogorov), neighbours without likeness, in cells and on the lattice."""
    for texture, density in (({**CELLS, "cells": 200.0, "low": 0.5, "high": 0.5}, 400), (0.5, 170)):
        stored = scatterers_of(simulator(ChannelSonar(points_per_m2=170.0), floor=floor(diffuse(texture), 5.0)))
        count = len(stored)
        assert count == pytest.approx(100 * density, rel=1e-3 if texture == 0.5 else 0)
        levels = (np.arange(count) + 0.5) / count
        power = stored.strength * (density / 0.5)
        assert np.abs(np.sort(1 - np.exp(-power)) - levels).max() < 1.63 / np.sqrt(count)
        assert np.abs(np.sort(stored.phase / (2 * np.pi) + 0.5) - levels).max() < 1.63 / np.sqrt(count)
        zeta = np.sqrt(power) * np.exp(1j * stored.phase)
        for step in (1, 2, 200):
            assert abs((zeta[step:] * zeta[:-step].conj()).mean()) < 4 / np.sqrt(count)
        assert abs(zeta.mean()) < 4 / np.sqrt(count)
        assert abs((zeta**2).mean()) < 4 * np.sqrt(2 / count)


def test_zeta_stays_with_its_point() -> None:
    """Another pose, velocity, carrier and number of receivers: the same phases of the same points, to the bit."""
    ground = scene(floor=cells_floor(half=3.0, cells=40.0), block=box((1, 1, 0.5), (0.2, 0.2, 0.2)))
    one = ChannelSimulator(ground, ChannelSonar(receivers=(received_from(),)))
    two = ChannelSimulator(ground, ChannelSonar(receivers=(received_from((0.2, 0, 0)),), carrier_hz=40e3, range_max=24.0))
    arguments = np.arange(len(points(one)), dtype=np.uint32)
    phase = one.tracer.trace(np.array(LEVEL), np.zeros(4), 0, ("phase",), arguments)["phase"]
    moved = np.array([1.0, -2.0, 6.0, 0.2, -0.1, 0.7])
    assert np.array_equal(two.tracer.trace(moved, np.array([1, 2, 0, 0.3]), 0, ("phase",), arguments)["phase"], phase)
    assert np.array_equal(scatterers_of(one).phase, phase)
    assert np.array_equal(scatterers_of(two).strength, scatterers_of(one).strength)


def test_zeta_is_of_the_seed_that_places_its_point() -> None:
    """Of a texture of cells its own, of other surfaces the sonar's."""

    def phases(seed: int, texture: float | dict[str, object]) -> set[float]:
        result = simulator(ChannelSonar(seed=seed), floor=floor(diffuse(texture), 1.0))
        return set(map(float, scatterers_of(result).phase))

    assert phases(1, {**CELLS, "cells": 30.0}) == phases(2, {**CELLS, "cells": 30.0})
    assert not phases(1, {**CELLS, "cells": 30.0}) & phases(1, {**CELLS, "cells": 30.0, "seed": 6})
    assert phases(1, 0.5) == phases(1, 0.3)
    assert len(phases(1, 0.5) & phases(2, 0.5)) < 10  # of 6,800 numbers of 24 bits, a few are equal by chance
