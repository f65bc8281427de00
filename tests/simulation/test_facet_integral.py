"""Mirrors that are no planes: Kirchhoff's integral over facets against image sources, a direct sum, and the law of waves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from channel_scenes import C
from helpers import essence
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mitsonar.simulation.mirror_paths import FacetEchoes

pytestmark = pytest.mark.usefixtures("variant")

CARRIER = 20e3
SENT_FROM, HEARD_AT = np.array([0.0, -3.0, -6.0]), np.array([1.0, 4.0, -8.0])
STILL = np.zeros(3)


def facets(half: float, cells: int) -> NDArray[np.float64]:
    """Triangles of a square grid ``(n, 3, 3)`` at z = 0."""
    edge = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(edge, edge)
    at = np.stack([x, y, np.zeros_like(x)], axis=-1)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    return np.concatenate([np.stack(three, axis=-2).reshape(-1, 3, 3) for three in ((a, b, c), (a, c, d))])


def echo(corners: NDArray[np.float64], height: float = 0.0, carrier: float = CARRIER) -> tuple[complex, FacetEchoes]:
    """Sum of all facets at the carrier, and the echoes."""
    from mitsonar.simulation.mirror_paths import facet_echoes
    from mitsonar.simulation.mirrors import MirrorFacets

    result = facet_echoes(MirrorFacets("waves", corners, -1.0, height), SENT_FROM, HEARD_AT, STILL, carrier, C)
    return complex((result.amplitude * np.exp(-2j * np.pi * carrier * result.delay)).sum()), result


def test_the_mean_phase_of_a_triangle_is_that_of_a_fine_sum() -> None:
    """Slow, fast, degenerate and constant phases; 1e-3 is the sum's own error, 1e-9 that of the series."""
    from mitsonar.simulation.mirror_paths import phase_mean

    grid = (np.arange(900) + 0.5) / 900
    u, v = (axis.ravel() for axis in np.meshgrid(grid, grid))
    inside = u + v < 1
    weights = np.stack([1 - u - v, u, v])[:, inside]
    for phase in ([0.0, 1.0, 3.0], [40.0, -7.0, 12.0], [2.0, 2.0, 9.0], [5.0, 5.0, 5.0], [1.0, 1.004, 0.997]):
        mean = np.exp(-1j * (np.array(phase) @ weights)).mean()
        assert phase_mean(np.array([phase]))[0] == pytest.approx(mean, abs=2e-3)
    edge = np.array([[0.0, 0.005, 0.00999], [0.0, 0.005, 0.01001]])
    assert abs(np.diff(phase_mean(edge))[0]) < 2e-5  # the series joins the closed form


def test_a_plane_of_facets_is_its_image_source() -> None:
    """-1 / r' at the image's delay: 0.3 dB and 0.05 rad; the rest is the diffraction of its edge."""
    total, result = echo(facets(15.0, 150))
    length = np.linalg.norm(HEARD_AT * (1, 1, -1) - SENT_FROM)
    expected = -np.exp(-2j * np.pi * CARRIER * length / C) / length
    assert abs(20 * np.log10(abs(total / expected))) < 0.3
    assert abs(np.angle(total / expected)) < 0.05
    assert result.lit.all()


def test_facets_may_be_of_any_size_below_the_fresnel_radius() -> None:
    """Half the step changes the sum by less than 2 %."""
    coarse, fine = echo(facets(8.0, 100))[0], echo(facets(8.0, 200))[0]
    assert abs(coarse / fine - 1) < 0.02


@pytest.mark.thorough
def test_the_mean_field_of_random_heights_falls_as_rayleigh_says() -> None:
    """Independent plane heights of rms h move the phase: their mean is exp(-2 k^2 h^2 cos^2), as the roughness gives it."""
    height, rng = 0.006, np.random.default_rng(3)
    flat = facets(15.0, 150)
    total, _ = echo(flat)
    rough, _ = echo(flat, height)
    heights = rng.normal(0, height, 200)
    mean = np.mean([echo(flat + np.array([0, 0, z]))[0] for z in heights[:60]])
    cosine = 14.0 / np.linalg.norm(HEARD_AT * (1, 1, -1) - SENT_FROM)
    loss = np.exp(-2 * (2 * np.pi * CARRIER / C * height * cosine) ** 2)
    assert abs(rough / total) == pytest.approx(loss, rel=0.03)
    assert abs(mean / total) == pytest.approx(loss, abs=4 * height * 4 * np.pi * CARRIER / C / np.sqrt(60) / 4)


@pytest.mark.thorough
@pytest.mark.parametrize("step", essence([0.4, 0.5], 0.4))
def test_the_mean_field_of_a_sea_does_not_depend_on_what_its_mesh_holds(step: float) -> None:
    """Two scales: waves of the mesh by Kirchhoff, shorter ones by the loss; together exp(-2 k^2 h^2 cos^2) of all.

    150 seas of 2 m/s at 8 kHz, within three standard errors of 0.06: a loss of 0.41.
    """
    from mitsonar.worlds.sea import SeaSurface

    carrier, seeds = 8e3, 150
    sea = SeaSurface(wind_m_s=2.0, size_m=16.0, step_m=step, spreading=0.0)
    meshes = (sea.surface(seed) for seed in range(seeds))
    flat, _ = echo(facets(8.0, round(16 / step)), carrier=carrier)
    corners = ((mesh.vertices - (0, 0, sea.water_m))[mesh.faces] for mesh in meshes)
    fields = np.array([echo(one, sea.state.roughness_m, carrier)[0] for one in corners]) / flat
    cosine = 14.0 / np.linalg.norm(HEARD_AT * (1, 1, -1) - SENT_FROM)
    height = sea.state.significant_height_m / 4
    loss = np.exp(-2 * (2 * np.pi * carrier / C * height * cosine) ** 2)
    error = fields.std() / np.sqrt(seeds)
    assert error < 0.07
    assert abs(fields.mean() - loss) < 3 * error
    assert loss < 0.45
