"""Ghosts: scatterers that sound reaches by way of mirrors, there, back, or both."""

from __future__ import annotations

import numpy as np
import pytest
from channel_scenes import C, points, received_from, scatterers_of, unmerged
from helpers import diffuse, plate
from numpy.typing import NDArray

from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView
from mitsonar.motion.pose import Pose
from mitsonar.simulation.channel import ChannelSimulator

pytestmark = pytest.mark.usefixtures("variant")

SURFACE, WALL = (-0.9, 0.0), (0.5, 0.0)
MIRRORS = {"surface": SURFACE, "wall": WALL}
POSE = Pose(0, 0, 6)
OFFSET = (0.4, 0.3, 0.0)
NORMAL = np.array([-0.35, -0.8, 0.5]) / np.linalg.norm([-0.35, -0.8, 0.5])


def target(**more: object) -> dict[str, object]:
    """One scatterer 8 m ahead below a surface at 10 m, beside a wall at x = 5."""
    return {
        "plate": plate((1.0, 8.0, 4.0), NORMAL, half=0.005),
        "surface": plate((0, 0, 10), (0, 0, -1), half=40.0),
        "wall": plate((5, 0, 0), (-1, 0, 0), half=40.0),
        **more,
    }


def open_water(**more: object) -> dict[str, object]:
    """The same without the wall."""
    return {name: shape for name, shape in target(**more).items() if name != "wall"}


def instrument(**words: object) -> ChannelSonar:
    return ChannelSonar(**{"receivers": (received_from(OFFSET),), "points_per_m2": 1e4, "bounces": 3, **words})


def mirrored(place: NDArray[np.float64], names: tuple[str, ...]) -> NDArray[np.float64]:
    """The image of a place by mirrors one after another."""
    for name in names:
        place = place.copy()
        if name == "surface":
            place[2] = 20 - place[2]
        else:
            place[0] = 10 - place[0]
    return place


WAYS = [
    ((), ()),
    *[((name,), ()) for name in MIRRORS],
    *[((), (name,)) for name in MIRRORS],
    *[((one,), (other,)) for one in MIRRORS for other in MIRRORS],
]
"""Mirrors there and back; both twice on one side come in the test of counts."""


@pytest.mark.parametrize(("out", "back"), WAYS)
def test_ghosts_are_where_images_are(out: tuple[str, ...], back: tuple[str, ...]) -> None:
    """Delay within 1 ns, amplitude within 0.01 dB and its phase: zeta sqrt(C dA cos cos) V ... / (r_A r_B)."""
    result = ChannelSimulator(unmerged(**target()), instrument(), mirrors=MIRRORS)
    (place,) = points(result)
    (strength,), (phase,) = scatterers_of(result).strength, scatterers_of(result).phase
    name = "-".join([*out, "scatterer", *reversed(back)])
    path = result.paths(POSE).by(name)
    sent, received = mirrored(np.array(POSE[:3]), out), mirrored(np.add(POSE[:3], OFFSET), back)
    paths = place - sent, place - received
    r_a, r_b = (np.linalg.norm(way) for way in paths)
    cosines = (NORMAL @ paths[0] / r_a) * (NORMAL @ paths[1] / r_b)
    v = np.prod([MIRRORS[mirror][0] for mirror in (*out, *back)])
    assert path.delay_s == pytest.approx([(r_a + r_b) / C], abs=1e-9)
    assert path.amplitude == pytest.approx([v * np.exp(1j * phase) * np.sqrt(strength * cosines) / (r_a * r_b)], rel=1e-3)


def test_the_number_of_bounces_bounds_the_ways() -> None:
    """One: the scatterer; two: a mirror there or back; three: two mirrors, of which one order is open."""
    names = []
    for bounces in (1, 2, 3):
        paths = ChannelSimulator(unmerged(**target()), instrument(bounces=bounces), mirrors=MIRRORS).paths(POSE)
        assert paths.kind is not None
        names.append({paths.kinds[k] for k in paths.kind} - {"surface", "wall", "surface-wall", "wall-surface"})
    assert names[0] == {"scatterer"}
    assert names[1] - names[0] == {f"{m}-scatterer" for m in MIRRORS} | {f"scatterer-{m}" for m in MIRRORS}
    both = {f"{a}-scatterer-{b}" for a in MIRRORS for b in MIRRORS}
    assert both < names[2] - names[1]
    twice = names[2] - names[1] - both
    assert len(twice) == 2  # surface and wall in one of both orders, there and back
    assert {name.replace("scatterer", "").strip("-") for name in twice} <= {"surface-wall", "wall-surface"}


def test_without_mirrors_nothing_changes() -> None:
    """The direct echoes of a simulator with mirrors have the bits of one without, on shapes that are no mirrors."""
    shapes = unmerged(**target())
    plain = ChannelSimulator(unmerged(plate=target()["plate"]), instrument(bounces=1)).paths(POSE)
    with_mirrors = ChannelSimulator(shapes, instrument(), mirrors=MIRRORS).paths(POSE).by("scatterer")
    assert np.array_equal(plain.delay_s, with_mirrors.delay_s)
    assert np.array_equal(plain.amplitude, with_mirrors.amplitude)


def test_a_screen_hides_a_ghost_or_the_target() -> None:
    """A screen below the surface's foot hides its ghosts; one in the direct way leaves the ghost there and back."""
    above = plate((0.5, 4.0, 8.0), (0.13, -1, 0.07), half=1.8, bsdf=diffuse(0.0))
    paths = ChannelSimulator(unmerged(**open_water(screen=above)), instrument(), mirrors={"surface": SURFACE}).paths(POSE)
    assert len(paths.by("surface-scatterer").delay_s) == len(paths.by("scatterer-surface").delay_s) == 0
    assert len(paths.by("scatterer").delay_s) == 1
    below = plate((0.5, 4.0, 3.0), (0.13, -1, 0.07), half=2.9, bsdf=diffuse(0.0))
    paths = ChannelSimulator(unmerged(**open_water(screen=below)), instrument(), mirrors={"surface": SURFACE}).paths(POSE)
    assert len(paths.by("scatterer").delay_s) == len(paths.by("surface-scatterer").delay_s) == 0
    assert len(paths.by("surface-scatterer-surface").delay_s) == 1


def test_points_of_a_mirror_have_no_ghost_in_itself() -> None:
    """A rough bottom scatters what its mirror loses, and is no ghost of its own; in the surface it has one."""
    shapes = unmerged(floor=plate((0, 0, 0), (0, 0, 1), half=1.0), surface=plate((0, 0, 10), (0, 0, -1), half=40.0))
    result = ChannelSimulator(shapes, instrument(points_per_m2=400.0), mirrors={"floor": (0.5, 1e-3), "surface": SURFACE})
    paths = result.paths(POSE)
    assert len(paths.by("floor-scatterer").delay_s) == len(paths.by("scatterer-floor").delay_s) == 0
    assert len(paths.by("scatterer").delay_s) == len(paths.by("surface-scatterer").delay_s) == len(points(result))
    bare = ChannelSimulator(shapes, instrument(points_per_m2=400.0), mirrors={"surface": SURFACE}).paths(POSE)
    place = points(result)
    cosine = [(6 - 0) / np.linalg.norm(place - start, axis=1) for start in (POSE[:3], np.add(POSE[:3], OFFSET))]
    k = 2 * np.pi * 80e3 / C
    lost = np.sqrt(1 - np.exp(-((k * 1e-3 * (cosine[0] + cosine[1])) ** 2)))
    ratio = np.sort(np.abs(paths.by("scatterer").amplitude / bare.by("scatterer").amplitude))
    assert ratio == pytest.approx(np.sort(lost), rel=1e-4)


def test_a_ghost_is_in_the_field_of_view_of_its_direction() -> None:
    """A receiver that looks up hears the target by the surface only."""
    up = FieldOfView(shape="circular", tilt_deg=128.0, heading_deg=8.0, across_deg=30.0)
    sonar = instrument(receivers=(received_from(OFFSET, **up.model_dump()),))
    paths = ChannelSimulator(unmerged(**open_water()), sonar, mirrors={"surface": SURFACE}).paths(POSE)
    assert paths.kind is not None
    assert {paths.kinds[k] for k in paths.kind} == {"scatterer-surface", "surface-scatterer-surface"}


@pytest.mark.parametrize("velocity", [(1.0, 2.0, -0.5, 0.0), (0.0, 0.0, 0.0, 0.4)])
def test_doppler_of_ghosts_is_the_slope_of_their_delay(velocity: tuple[float, ...]) -> None:
    result, step = ChannelSimulator(unmerged(**target()), instrument(), mirrors=MIRRORS), 1e-3

    def moved(time: float) -> Pose:
        vx, vy, vz, turn = (value * time for value in velocity)
        return Pose(vx, vy, 6 + vz, 0.0, 0.0, turn)

    early, late = (result.paths(moved(time), velocity) for time in (-step / 2, step / 2))
    here = result.paths(POSE, velocity)
    slope = -result.sonar.carrier_hz * (late.delay_s - early.delay_s) / step
    assert len(slope) > 9
    turning = 0.08 if velocity[3] else 0.0  # centripetal acceleration while sound travels: 0.4^2 / s^2 * 0.5 m * 15 ms
    assert here.doppler_hz == pytest.approx(slope, abs=0.02 + 3e-3 * np.abs(slope).max() + turning)


def test_shared_scatterers_keep_their_mirrors_apart() -> None:
    """``like`` shares points, not mirrors."""
    shapes = unmerged(**target(floor=plate((0, 0, 0), (0, 0, 1), half=1.0)))
    few = {"points_per_m2": 10.0}
    first = ChannelSimulator(shapes, instrument(bounces=2, **few), mirrors=MIRRORS)
    same = ChannelSimulator(shapes, instrument(bounces=3, **few), mirrors=MIRRORS, like=first)
    assert scatterers_of(first) is scatterers_of(same)
    second = ChannelSimulator(shapes, instrument(bounces=1, **few), like=first)
    assert len(scatterers_of(second)) > len(scatterers_of(first))  # surface and wall scatter where they are no mirrors
