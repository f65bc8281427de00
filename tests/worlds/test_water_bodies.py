"""Particles and nets: surfaces and normals in closed form, and the level of a cloud by the reverberation integral."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers import scene, sphere

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.simulator import Simulator
from mitsonar.worlds.sea import fishing_net_mesh, particle_mesh


def normals(vertices: Any, faces: Any) -> Any:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def test_particles_have_their_surface_and_face_outward() -> None:
    vertices, faces = particle_mesh(50, (1, 2, 3), 0.1, seed=1)
    area = normals(vertices, faces)
    assert np.linalg.norm(area, axis=1).sum() == pytest.approx(50 * 4 * np.sqrt(3) * 0.1**2)
    middles = vertices.reshape(50, 6, 3).mean(axis=1)
    out = vertices[faces].mean(axis=1) - np.repeat(middles, 8, axis=0)
    assert (np.einsum("ij,ij->i", area, out) > 0).all()
    assert (np.abs(middles) <= np.array([0.5, 1, 1.5])).all()


def test_a_net_has_its_bars() -> None:
    vertices, faces = fishing_net_mesh(1.0, 0.5, 0.1, 0.004)
    bars = 11 * 5 + 10 * 6
    assert len(faces) == 6 * bars
    area = normals(vertices, faces)
    assert np.linalg.norm(area, axis=1).sum() == pytest.approx(bars * 3 * 0.1 * 0.002 * np.sqrt(3))
    out = vertices[faces].mean(axis=1) - np.repeat(vertices.reshape(-1, 6, 3).mean(axis=1), 6, axis=0)
    assert (np.einsum("ij,ij->i", area, out) > 0).all()


@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
def test_a_cloud_reverberates_as_its_density_says(variant: str) -> None:
    """Sum over bins of level R^2 = n sigma dOmega dR, against a sphere of radius a: level R^4 = 2/3 pi mu a^2."""
    import mitsuba as mi

    sonar = Sonar.create(
        beams=12, azimuth_fov_deg=14, elevation_fov_deg=14, range_min=3, range_max=8, rays_per_beam=600, rays_across=30
    )

    def total(world: Any, low: float, high: float, power: int) -> float:
        levels = next(Simulator(world, sonar).pings([[0.0] * 6])).levels[0].sum(axis=1, dtype=float)
        inside = (sonar.range_m > low) & (sonar.range_m < high)
        return float((levels * sonar.range_m**power)[inside].sum())

    known = total(scene(ball=sphere((0, 5.1, 0), 0.1)), 3, 8, 4) / (2 / 3 * np.pi * 0.1**2)
    count, size, radius, result = 900, (2.0, 1.5, 2.0), 0.01, []
    for seed in range(4):
        vertices, faces = particle_mesh(count, size, radius, seed)
        mesh = mi.Mesh("cloud", len(vertices), len(faces))
        values = mi.traverse(mesh)
        values["vertex_positions"] = (vertices + np.array([0, 5, 0])).ravel().astype(np.float32)
        values["faces"] = faces.ravel().astype(np.uint32)
        values.update()
        result.append(total(scene(cloud=mesh), 4.5, 5.5, 2) / known)  # type: ignore[arg-type]
    density, cross_section = count / np.prod(size), 4 * np.sqrt(3) * radius**2 / 6
    solid_angle = np.radians(14) * 2 * np.sin(np.radians(7))
    assert np.mean(result) == pytest.approx(density * cross_section * solid_angle, rel=0.12)


def test_mistakes_are_told() -> None:
    with pytest.raises(MitsonarError, match="of positive size"):
        particle_mesh(0, (1, 1, 1), 0.1)
    with pytest.raises(MitsonarError, match="twine < opening"):
        fishing_net_mesh(1, 1, 0.1, 0.2)
