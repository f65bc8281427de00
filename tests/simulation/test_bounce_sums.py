"""Ghosts in the model physical: ranges of image sources, levels in closed form, and what is refused."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from helpers import Array, diffuse, essence, floor, plate, scene, sphere

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import Segment
from mitsonar.simulation.simulator import Simulator

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

SONAR = Sonar.create(model="physical", beams=48, azimuth_fov_deg=28.8, elevation_fov_deg=60.0, range_min=3.0, range_max=9.0,
                     range_bins=600, frequency_hz=9e5, absorption_db_per_m=0.0)  # fmt: skip

RADIUS, MU = 0.03, 0.3


def under_surface(depth: float, place: Array, tilt_deg: float = 0.0) -> tuple[mi.Scene, Array]:
    """A small ball under a flat or leaning surface through (0, 2.5, 0), and the image of the sonar at (0, 0, -depth)."""
    tilt = math.radians(tilt_deg)
    normal = np.array([0, math.sin(tilt), -math.cos(tilt)])
    loaded = scene(top=plate((0, 2.5, 0), normal, half=50.0, bsdf=diffuse(0.0)), ball=sphere(place, RADIUS, diffuse(MU)))
    origin = np.array([0, 0, -depth])
    return loaded, origin - 2 * normal * (normal @ (origin - [0, 2.5, 0]))


def profile(loaded: mi.Scene, sonar: Sonar, depth: float, mirrors: dict[str, tuple[float, float]], pings: int = 8) -> Array:
    """The mean of some pings, summed over beams ``(bins,)``."""
    poses = np.tile([0, 0, -depth, 0, 0, 0], (pings, 1))
    result = Simulator(loaded, sonar, mirrors=mirrors).pings(poses)
    return np.asarray(sum(part.levels.sum(axis=(0, 2), dtype=float) for part in result) / pings)


def ball(first: Array, second: Array) -> float:
    """What a Lambert ball sends from one direction back to another, over mu a^2: 2/3 (sin psi + (pi - psi) cos psi)."""
    psi = math.acos(min(1.0, float(first @ second)))
    return 2 / 3 * (math.sin(psi) + (math.pi - psi) * math.cos(psi))


CASES = [
    (1.0, (0.3, 5.0, -1.3), 0.0),
    (0.6, (-0.5, 6.0, -1.0), 0.0),
    (1.0, (0.0, 4.5, -1.1), 3.0),
    (0.8, (0.0, 5.5, -0.7), -4.0),
]


@pytest.mark.thorough
@pytest.mark.parametrize(("depth", "place", "tilt"), essence(CASES, CASES[0], CASES[2]))
def test_ghosts_lie_where_image_sources_say(depth: float, place: tuple[float, float, float], tilt: float) -> None:
    """Ranges within one bin and levels within 5 %; a flat surface keeps the bearing, so both ways arrive in one beam."""
    at = np.array(place)
    loaded, image = under_surface(depth, at, tilt)
    paths = at - [0, 0, -depth], at - image
    near, far = (float(np.linalg.norm(way)) for way in paths)
    units = [way / length for way, length in zip(paths, (near, far), strict=True)]
    expected = {
        (near + far) / 2: 4 * MU * RADIUS**2 * ball(*units) / (near * far) ** 2,
        far: MU * RADIUS**2 * ball(units[0], units[0]) / far**4,
    }
    for bounces, ranges in ((2, list(expected)[:1]), (3, list(expected))):
        seen = profile(loaded, SONAR.replace(bounces=bounces), depth, {"top": (-1.0, 0.0)})
        for range_m in ranges:
            inside = np.abs(SONAR.range_m - (range_m - RADIUS / 2)) < RADIUS
            middle = np.average(SONAR.range_m[inside], weights=seen[inside])  # of a ball: 3/4 of its radius before its own
            assert middle == pytest.approx(range_m - 0.75 * RADIUS, abs=SONAR.bin_m), (bounces, range_m)
            assert seen[inside].sum() == pytest.approx(expected[range_m], rel=0.05)


def test_a_far_ghost_does_not_depend_on_where_the_window_begins() -> None:
    """Without a gain a level at 60 m is some 1e-6 of the largest that a surface at 0.1 m could give."""
    ball_far = sphere((0.0, 60.0, -4.0), 1.0, diffuse(MU))
    loaded = scene(top=plate((0, 0, 0), np.array([0.0, 0, -1]), half=500.0, bsdf=diffuse(0.0)), ball=ball_far)
    far = SONAR.replace(gain_exponent=0, elevation_fov_deg=30.0, range_max=80.0, rays_per_beam=200)
    result = []
    for begin, bins in ((0.1, 799), (40.0, 400)):
        two = far.replace(range_min=begin, range_bins=bins, bounces=2)
        whole = profile(loaded, two, 4.0, {"top": (-1.0, 0.0)}, 2)
        result.append(whole.sum() - profile(loaded, two.replace(bounces=1), 4.0, {}, 2).sum())
    assert result[0] > 0
    assert result[0] == pytest.approx(result[1], rel=1e-3)


def test_a_rough_surface_loses_by_its_height() -> None:
    """A path by one mirror loses exp(-4 k^2 h^2 cos^2) of its energy, by the same mirror twice that of its square."""
    at, depth = np.array([0.0, 5.0, -1.3]), 1.0
    loaded, image = under_surface(depth, at)
    cosine = (2.3) / float(np.linalg.norm(at - image))
    k, height = 2 * math.pi * 9e5 / 1500, 1e-4
    sonar = SONAR.replace(bounces=3)
    smooth, rough = (profile(loaded, sonar, depth, {"top": (-0.8, h)}) for h in (0.0, height))
    perfect = profile(loaded, sonar, depth, {"top": (1.0, 0.0)})
    share = math.exp(-4 * (k * height * cosine) ** 2)
    near, far = 5.009, float(np.linalg.norm(at - image))
    for range_m, power in (((near + far) / 2, 1), (far, 2)):
        inside = np.abs(sonar.range_m - range_m) < 0.06
        assert rough[inside].sum() / smooth[inside].sum() == pytest.approx(share**power, rel=0.02)
        assert smooth[inside].sum() / perfect[inside].sum() == pytest.approx(0.64**power, rel=1e-3)


def test_a_ghost_of_another_bearing_is_heard_by_arrays_that_only_receive() -> None:
    """By way of a wall aside: box and receive hear it in two beams; an array that sends too, hardly at all."""
    at = np.array([0.0, 5.0, 0.0])
    loaded = scene(wall=plate((1.0, 0, 0), (-1, 0, 0), half=50.0), ball=sphere(at, RADIUS, diffuse(MU)))
    near, far = 5.0, math.hypot(5, 2)
    sonar = SONAR.replace(bounces=2, azimuth_fov_deg=57.6)
    inside = np.abs(sonar.range_m - (near + far) / 2) < 0.06
    received = {}
    for pattern in ("box", "receive", "two_way"):
        local = sonar.replace(pattern=pattern, elevation_pattern="box")
        seen = (
            next(iter(Simulator(loaded, local, mirrors={"wall": (1.0, 0.0)}).pings(np.zeros(6))))
            .levels[0][inside]
            .sum(axis=0)
        )
        received[pattern] = seen
    for pattern in ("box", "receive"):
        brightest = set(np.sort(np.argsort(received[pattern])[-2:]).tolist()) | set(
            np.argsort(received[pattern])[-4:].tolist()
        )
        bearings = sonar.bearing_rad[sorted(brightest)]
        assert np.abs(bearings).min() < sonar.beam_spacing_rad
        assert np.abs(bearings - math.atan2(2, 5)).min() < sonar.beam_spacing_rad
    assert received["two_way"].sum() < 1e-3 * received["receive"].sum()


@pytest.mark.parametrize("layout", ["even", "sine"])
def test_beams_narrower_than_their_spacing_hear_their_width(layout: str) -> None:
    """Half as wide: of light between plates both ends must lie in beams, so less than half is heard."""
    loaded = scene(ground=floor(diffuse(0.2)), wall=plate((0, 5, 0), (0, -1, 0), half=3.0, bsdf=diffuse(0.2)))
    pose = np.array([0, 0, 2.0, math.radians(25), 0, 0])
    seen = []
    for part in (1.0, 0.5):
        width = part * SONAR.azimuth_fov_deg / SONAR.beams
        sonar = SONAR.replace(beam_layout=layout, beam_width_deg=width)
        one, two = (next(iter(Simulator(loaded, sonar.replace(bounces=n)).pings(pose))).levels.sum() for n in (1, 2))
        seen.append((two - one) / one)
    assert 0 < seen[1] < 0.7 * seen[0]


def test_labels_are_those_of_one_reflection() -> None:
    loaded = scene(ground=floor(diffuse(0.2)), wall=plate((0, 5, 0), (0, -1, 0), half=3.0, bsdf=diffuse(0.2)))
    pose = np.array([0, 0, 2.0, math.radians(25), 0, 0])
    result = [next(iter(Simulator(loaded, SONAR.replace(bounces=n)).pings(pose, labels=True))) for n in (1, 3)]
    for name, values in result[0].labels.items():
        np.testing.assert_array_equal(values, result[1].labels[name], err_msg=name)
    assert (result[1].levels != result[0].levels).any()


@pytest.mark.thorough
@pytest.mark.parametrize("pattern", ["box", "receive"])
def test_groups_of_beams_at_rest_are_one_ping(pattern: str) -> None:
    """Groups that ping from one pose make the image of all beams at once."""
    loaded, _ = under_surface(1.0, np.array([0.3, 5.0, -1.3]))
    mirrors, pose = {"top": (-1.0, 0.0)}, np.array([[0, 0, -1.0, 0, 0, 0]])
    sonar = SONAR.replace(bounces=2, pattern=pattern, beams=24, jitter=False)
    plain, grouped = (
        next(iter(Simulator(loaded, sonar.replace(ping_groups=groups), mirrors=mirrors).pings(pose))).levels
        for groups in (1, 4)
    )
    np.testing.assert_array_equal(plain, grouped)


def test_what_has_one_reflection_refuses_more() -> None:
    loaded, _ = under_surface(1.0, np.array([0.3, 5.0, -1.3]))
    several = SONAR.replace(bounces=2)
    with pytest.raises(MitsonarError, match="segments support one reflection"):
        Simulator(loaded, several, views=[Segment(several, "port")])
    with pytest.raises(MitsonarError, match="has no mirrors: give the sonar model coherent, or bounces 2"):
        Simulator(loaded, SONAR, mirrors={"top": (1.0, 0.0)})
    with pytest.raises(MitsonarError, match="give frequency_hz"):
        Simulator(loaded, several.replace(frequency_hz=None), mirrors={"top": (1.0, 1e-4)})
    with pytest.raises(MitsonarError, match="the model thesis supports one reflection"):
        SONAR.replace(model="thesis", bounces=2)
    for wrong in (0, 4, 1.5):
        with pytest.raises(MitsonarError, match="bounces"):
            SONAR.replace(bounces=wrong)


def test_bright_surfaces_are_told() -> None:
    loaded = scene(ground=floor(diffuse(0.5)))
    notes = Simulator(loaded, SONAR.replace(bounces=2)).notes
    assert any("above 1/pi" in note and "ground" in note for note in notes)
    merged = scene(ground=floor(diffuse(0.5)), wall=plate((0, 9, 0), (0, -1, 0), half=1.0, bsdf=diffuse(0.5)))
    assert any("via shape number 0 are" in note for note in Simulator(merged, SONAR.replace(bounces=2)).notes)
    assert not any("above 1/pi" in note for note in Simulator(loaded, SONAR).notes)
    assert not any("above 1/pi" in n for n in Simulator(scene(ground=floor(diffuse(0.3))), SONAR.replace(bounces=2)).notes)
