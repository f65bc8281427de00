"""Coherent ghosts of one point: ranges, amplitudes and phases of image sources, in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from coherent_scenes import one_point
from helpers import Array, diffuse, essence, plate, separate

from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.simulator import Simulator

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

SONAR = Sonar.create(model="coherent", frequency_hz=9e5, beams=48, azimuth_fov_deg=28.8, elevation_fov_deg=60.0,
                     range_min=3.5, range_max=6.0, range_bins=500, elevation_pattern="box", absorption_db_per_m=0.0,
                     bounces=3)  # fmt: skip

K = 2 * math.pi * 9e5 / 1500
SURFACE = 0.8
"""Height of the mirror over sonar and target [m]."""


def fields(mirror: tuple[float, float], sonar: Sonar) -> tuple[complex, complex, complex, Array]:
    """The sums of the waves of one point: seen straight, by way of the surface, and by it both ways; the point's place."""
    from mitsonar.simulation.models.coherent import CoherentImager

    _, fields, at = one_point()
    local = sonar.replace(**fields)
    loaded = separate(
        target=plate((0, 4.4, 0), (0, -1, 0), half=0.01, bsdf=diffuse(0.5)),
        top=plate((0, 0, SURFACE), (0, 0, -1), half=50.0, bsdf=diffuse(0.0)),
    )
    imager = CoherentImager(loaded, local, {"top": mirror})
    direct = complex(imager.tracer.field(np.zeros(6))[0].astype(complex).sum())
    result = []
    for bounces in (2, 3):
        from mitsonar.simulation.multipath_coherent import GhostTracer

        tracer = imager.tracer
        tracer.sonar = local.replace(bounces=bounces)
        field = np.zeros((imager.former.ranges, imager.former.sines), np.complex64)
        GhostTracer(tracer).add(np.zeros(6), field)
        result.append(complex(field.astype(complex).sum()))
    return direct, result[0], result[1] - result[0], at


@pytest.mark.parametrize("pattern", essence(["two_way", "receive"], "receive"))
@pytest.mark.parametrize(("reflection", "height"), essence([(-1.0, 0.0), (0.7, 1e-4)], (0.7, 1e-4)))
def test_one_point_has_the_ghosts_of_image_sources(pattern: str, reflection: float, height: float) -> None:
    """By way of the surface 2 V sqrt(cos cos') / R R', both ways by it V^2 cos' / R'^2: 1 % and 0.03 of a turn's radian."""
    direct, once, twice, at = fields((reflection, height), SONAR.replace(pattern=pattern))
    image = np.array([0, 0, 2 * SURFACE])
    near, far = float(np.linalg.norm(at)), float(np.linalg.norm(at - image))
    cosines = at[1] / near, at[1] / far
    slant = abs(at[2] - 2 * SURFACE) / far
    left = reflection * math.exp(-2 * (K * height * slant) ** 2)
    scale = direct / (cosines[0] / near**2)  # weight of the point, with the phase of 2 R
    for got, level, longer in (
        (once, 2 * left * math.sqrt(cosines[0] * cosines[1]) / (near * far), far - near),
        (twice, left**2 * cosines[1] / far**2, 2 * (far - near)),
    ):
        ratio = got / (scale * level * np.exp(-1j * K * longer))
        assert abs(ratio) == pytest.approx(1, rel=0.01)
        assert np.angle(ratio) == pytest.approx(0, abs=0.03)


def test_ghosts_lie_in_the_bins_of_image_sources() -> None:
    _, fields, at = one_point()
    loaded = separate(
        target=plate((0, 4.4, 0), (0, -1, 0), half=0.01, bsdf=diffuse(0.5)),
        top=plate((0, 0, SURFACE), (0, 0, -1), half=50.0, bsdf=diffuse(0.0)),
    )
    near, far = float(np.linalg.norm(at)), float(np.linalg.norm(at - [0, 0, 2 * SURFACE]))
    sonar = SONAR.replace(**fields)
    levels = next(iter(Simulator(loaded, sonar, mirrors={"top": (-1.0, 0.0)}).pings(np.zeros(6)))).levels[0].sum(axis=1)
    for range_m in (near, (near + far) / 2, far):
        around = np.flatnonzero(np.abs(sonar.range_m - range_m) < 0.08)
        assert sonar.range_m[around[levels[around].argmax()]] == pytest.approx(range_m, abs=sonar.bin_m)


@pytest.mark.thorough
def test_mirrors_out_of_sight_change_nothing() -> None:
    """A mirror behind the sonar: no ghosts; what is rough sends nothing from one plate to itself. Bits are the same."""
    loaded = separate(target=plate((0, 4.4, 0), (0, -1, 0), half=0.3), behind=plate((0, -5, 0), (0, 1, 0), half=0.3))
    images = [
        next(iter(Simulator(loaded, SONAR.replace(bounces=n), mirrors={"behind": (1.0, 0.0)}).pings(np.zeros(6)))).levels
        for n in (1, 3)
    ]
    np.testing.assert_array_equal(images[0], images[1])


def test_mirrored_rays_see_the_image() -> None:
    """The rows of a sonar mirrored at z = 1: the image of the origin lies at z = 2, up is down."""
    import mitsuba as mi

    from mitsonar.simulation.tracing import mirrored_lines

    lines = [[mi.Float64(float(i == j)) for j in range(4)] for i in range(3)]
    result = mirrored_lines(lines, mi.Normal3f(0, 0, -1), mi.Point3f(7, 8, 1))
    got = np.array([[float(np.array(value).ravel()[0]) for value in line] for line in result])
    np.testing.assert_allclose(got, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 2]], atol=1e-12)
