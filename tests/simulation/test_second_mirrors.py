"""Out by one mirror and back by another: ranges, levels and phases of two image sources."""

from __future__ import annotations

import math

import numpy as np
import pytest
from coherent_scenes import one_point
from helpers import diffuse, plate, separate, sphere
from test_bounce_sums import ball

from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.simulator import Simulator

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

RADIUS, MU = 0.05, 0.3

SONAR = Sonar.create(model="physical", beams=60, azimuth_fov_deg=90.0, elevation_fov_deg=100.0, range_min=3.0, range_max=9.0,
                     range_bins=600, frequency_hz=9e5, absorption_db_per_m=0.0, bounces=3, rays_per_beam=2500)  # fmt: skip

COHERENT = Sonar.create(model="coherent", frequency_hz=9e5, beams=48, azimuth_fov_deg=28.8, elevation_fov_deg=60.0,
                        range_min=3.5, range_max=6.0, range_bins=500, elevation_pattern="box", absorption_db_per_m=0.0,
                        bounces=3)  # fmt: skip


@pytest.mark.parametrize("screened", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_a_ball_between_surface_and_wall_has_a_ghost_by_way_of_both(screened: bool) -> None:
    """Half of R' + R'' long, within one bin; both ways round, each in the beam that hears it, within 5 %."""
    at, depth, aside = np.array([0.0, 5.0, -2.4]), 2.2, 1.5
    shapes = {
        "top": plate((0, 2.5, 0), (0, 0, -1), half=50.0, bsdf=diffuse(0.0)),
        "wall": plate((aside, 0, 0), (-1, 0, 0), half=50.0, bsdf=diffuse(0.0)),
        "ball": sphere(at, RADIUS, diffuse(MU)),
    }
    if screened:  # where the way by the wall passes, and no other
        shapes["screen"] = plate((1.0, 3.33, -2.3), (0, -1, 0), half=0.15, bsdf=diffuse(0.0))
    mirrors = {"top": (-0.9, 0.0), "wall": (0.8, 1e-4)}
    poses = np.tile([0, 0, -depth, 0, 0, 0], (6, 1))
    result = Simulator(separate(**shapes), SONAR, mirrors=mirrors).pings(poses)
    levels = sum(part.levels.sum(axis=0, dtype=float) for part in result) / 6
    origin = np.array([0, 0, -depth])
    paths = at - np.array([0, 0, depth]), at - np.array([2 * aside, 0, -depth])
    first, second = (float(np.linalg.norm(way)) for way in paths)
    units = [way / length for way, length in zip(paths, (first, second), strict=True)]
    range_m = (first + second) / 2
    inside = np.abs(SONAR.range_m - (range_m - RADIUS / 2)) < RADIUS
    lossy = math.exp(-4 * (2 * math.pi * 9e5 / 1500 * 1e-4 * abs(units[1][0])) ** 2)
    each = 0.81 * 0.64 * lossy * MU * RADIUS**2 * ball(*units) / (first * second) ** 2
    if screened:
        assert levels[inside].sum() < 0.02 * each
        return
    middle = np.average(SONAR.range_m[inside], weights=levels[inside].sum(axis=1))
    assert middle == pytest.approx(range_m - 0.75 * RADIUS, abs=SONAR.bin_m)
    received = levels[inside].sum(axis=0)
    for bearing in (0.0, math.atan2(2 * aside, math.hypot(5.0, at[2] - origin[2]))):
        neighbours = np.abs(SONAR.bearing_rad - bearing) < math.radians(3)
        assert received[neighbours].sum() == pytest.approx(each, rel=0.05), bearing


@pytest.mark.parametrize(("pattern", "second"), [("receive", (0.45, 0, 0)), ("two_way", (0, 0, -0.7))])
def test_one_point_has_the_ghost_of_two_image_sources(pattern: str, second: tuple[float, float, float]) -> None:
    """2 V1 V2 sqrt(cos cos') / R' R'' at the phase of R' + R'', both ways round, within 1 % and 0.03 rad.

    An array that sends too hears mirrors above and below; others a wall aside as well.
    """
    from mitsonar.simulation.mirrors import mirror_of
    from mitsonar.simulation.models.coherent import CoherentImager
    from mitsonar.simulation.multipath_coherent import GhostTracer

    _, changes, at = one_point()
    foot, height = np.array(second, dtype=float), np.array([0, 0, 0.8])
    loaded = separate(
        target=plate((0, 4.4, 0), (0, -1, 0), half=0.01, bsdf=diffuse(0.5)),
        top=plate(height, (0, 0, -1), half=50.0, bsdf=diffuse(0.0)),
        other=plate(foot, -foot / np.linalg.norm(foot), half=50.0, bsdf=diffuse(0.0)),
    )
    mirrors = {"top": (-0.9, 0.0), "other": (0.7, 0.0)}
    imager = CoherentImager(loaded, COHERENT.replace(pattern=pattern, **changes), mirrors)
    direct = complex(imager.tracer.field(np.zeros(6))[0].astype(complex).sum())
    sums = []
    for parts in (None, mirror_of(loaded, mirrors)):
        field = np.zeros((imager.former.ranges, imager.former.sines), np.complex64)
        GhostTracer(imager.tracer, parts).add(np.zeros(6), field)
        sums.append(complex(field.astype(complex).sum()))
    near, *far = (float(np.linalg.norm(at - image)) for image in (np.zeros(3), 2 * height, 2 * foot))
    scale = direct / (at[1] / near / near**2)
    level = 2 * -0.9 * 0.7 * at[1] / math.sqrt(far[0] * far[1]) / (far[0] * far[1])
    k = 2 * math.pi * 9e5 / 1500
    ratio = (sums[1] - sums[0]) / (scale * level * np.exp(-1j * k * (sum(far) - 2 * near)))
    assert abs(ratio) == pytest.approx(1, rel=0.01)
    assert np.angle(ratio) == pytest.approx(0, abs=0.03)


def test_one_mirror_has_no_second() -> None:
    from mitsonar.simulation.mirrors import SecondMirrors, mirror_of, second_notes

    loaded = separate(
        **{f"wall{k}": plate((k + 1, 0, 0), (-1, 0, 0)) for k in range(9)}, ball=sphere((0, 3, 0), 0.1, diffuse(0.3))
    )
    for count, known in ((1, False), (2, True), (8, True), (9, False)):
        parts = mirror_of(loaded, {"ball": (0.5, 0.0), **{f"wall{k}": (0.5, 0.0) for k in range(count)}})
        assert (SecondMirrors.from_scene(loaded, parts, 1.0) is not None) == known
    notes = second_notes(loaded, {f"wall{k}": (0.5, 0.0) for k in range(9)})
    assert "have 9 planes" in notes[0]
    assert second_notes(loaded, {"wall1": (0.5, 0.0)}) == []
