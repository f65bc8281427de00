"""A calibration sphere: partial waves as the standard, to compare mirrors in images and in impulse responses with."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from channel_scenes import received_from, unmerged
from elastic_sphere import CARBIDE, length_at, strength
from helpers import diffuse, essence, scene, sphere

from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import Pose
from mitsonar.simulation.channel import ChannelSimulator
from mitsonar.worlds.world import Mesh

RHO, C = 1025.0, 1490.0
PLANE = CARBIDE.reflection(RHO, C)
RANGE = 3.0

ECHOSMS = {  # ESModel of echosms 0.24.0; spherets 1.0.8 has the first three, and stops at 50 orders, so at 0.5 MHz
    38e3: -42.392647959,
    200e3: -39.236935804,
    400e3: -38.307977101,
    900e3: -44.867273751,
    1.2e6: -40.533966642,
    1.8e6: -40.452508344,
    2.1e6: -37.330078368,
    3.0e6: -42.519586286,
}

BANDS = [(400e3, 20e3), (750e3, 100e3), (1.2e6, 200e3), (1.8e6, 200e3), (2.1e6, 200e3), (2.8e6, 200e3)]
"""Centre and half width [Hz] of the table in docs/physics.md#a-calibration-sphere."""


def band(centre_hz: float, half_hz: float) -> np.ndarray:
    return np.linspace(centre_hz - half_hz, centre_hz + half_hz, 201)


# ---------------------------------------------------------------- the standard


@pytest.mark.parametrize("frequency", ECHOSMS)
def test_partial_waves_are_those_of_another_package(frequency: float) -> None:
    assert strength(length_at(CARBIDE, frequency, RHO, C)) == pytest.approx(ECHOSMS[frequency], abs=1e-6)


def test_a_rigid_sphere_has_half_its_radius() -> None:
    rigid = CARBIDE._replace(density=1e12)
    assert strength(length_at(rigid, band(1.8e6, 2e5), RHO, C)) == pytest.approx(20 * math.log10(0.01905 / 2), abs=0.01)


@pytest.mark.thorough
def test_its_first_echo_is_that_of_a_mirror() -> None:
    """In time: V a / 2, 2 a / c before the centre's. Later echoes, from inside and around, add the rest of the power."""
    step = 2e3
    frequency = np.arange(0.4e6, 1.2e6, step)
    window = np.hanning(len(frequency))
    samples = 2**14
    echoes = np.abs(np.fft.ifft(length_at(CARBIDE, frequency, RHO, C) * window, samples)) * samples / window.sum()
    time_s = np.arange(samples) / (samples * step)
    time_s[samples // 2 :] -= 1 / step
    first = np.abs(time_s + 2 * CARBIDE.radius / C) < 5e-6
    assert 20 * np.log10(echoes[first].max() / (PLANE * CARBIDE.radius / 2)) == pytest.approx(0, abs=0.1)
    assert time_s[first][echoes[first].argmax()] == pytest.approx(-2 * CARBIDE.radius / C, abs=0.2e-6)
    later = (time_s > -15e-6) & (time_s < 200e-6)
    shares = [float((echoes[part] ** 2).sum()) for part in (first, later)]
    whole = strength(length_at(CARBIDE, frequency, RHO, C))
    front = 20 * math.log10(PLANE * CARBIDE.radius / 2)
    assert whole - front == pytest.approx(10 * math.log10(1 + shares[1] / shares[0]), abs=0.4)


# ---------------------------------------------------------------- the simulator


def image_strength(frequency: float) -> float:
    """Of the glint that the model coherent sums up over its field."""
    from mitsonar.simulation.models.coherent import CoherentImager

    sonar = Sonar.create(model="coherent", frequency_hz=frequency, sound_speed=C, beams=32, azimuth_fov_deg=10.0,
                         range_min=2.7, range_max=3.3, range_bins=128, bearing="cone", elevation_pattern="box",
                         absorption_db_per_m=0.0)  # fmt: skip
    centre = np.array([0.0, RANGE, 0.0])
    glints = CoherentImager(scene(ball=sphere(centre, CARBIDE.radius)), sonar, {"ball": (PLANE, 0.0)}).glints
    assert glints is not None
    near = RANGE - CARBIDE.radius
    return float(20 * np.log10(abs(glints.field(np.zeros(6)).astype(complex).sum()) * near * RANGE))


def channel_strength(frequency: float, folder: Path) -> float:
    """Of the paths that the facets of a sphere reflect."""
    ball = trimesh.creation.icosphere(5, CARBIDE.radius)
    path = folder / "ball.ply"
    path.write_bytes(Mesh("ball", np.add(ball.vertices, (0.0, RANGE, 0.0)), ball.faces).ply())
    loaded = unmerged(ball={"type": "ply", "filename": str(path), "face_normals": True, "bsdf": diffuse(1e-6)})
    sonar = ChannelSonar(receivers=(received_from((0.0, 0.0, 0.0)),), range_max=5.0, carrier_hz=frequency,
                         frequency_step_hz=50.0, bandwidth_hz=2000.0, sampling_hz=4000.0, points_per_m2=1.0,
                         sound_speed=C)  # fmt: skip
    paths = ChannelSimulator(loaded, sonar, mirrors={"ball": (PLANE, 0.0)}).paths(Pose(0, 0, 0)).by("ball")
    total = np.sum(paths.amplitude * np.exp(-2j * np.pi * frequency * paths.delay_s))
    return float(20 * np.log10(abs(total) * (RANGE - CARBIDE.radius) * RANGE))


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("centre", essence([one for one, _ in BANDS], 750e3))
def test_images_and_responses_have_its_front_and_lack_the_echoes_from_inside(centre: float, tmp_path: Path) -> None:
    front = 20 * math.log10(PLANE * CARBIDE.radius / 2)
    image, channel = image_strength(centre), channel_strength(centre, tmp_path)
    assert image == pytest.approx(front, abs=0.7)
    assert channel == pytest.approx(front, abs=0.5)
    whole = strength(length_at(CARBIDE, band(*next(one for one in BANDS if one[0] == centre)), RHO, C))
    assert 0.8 < whole - image < 3.0
