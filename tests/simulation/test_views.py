"""Views of one trace: segments add up to the whole, a receiver measures what geometry predicts."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import axes, box, diffuse, direction, essence, floor, plate, scene
from numpy.typing import ArrayLike

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.views import SEGMENTS, Receiver, Segment
from mitsonar.motion.pose import Pose, mounted
from mitsonar.simulation.simulator import Simulator

pytestmark = pytest.mark.usefixtures("variant")

DOWN = Pose(0, 0, 0, np.pi / 2, 0, -np.pi / 2)
"""A looking-down mount: bearing along the vehicle, elevation across it, negative to starboard."""


def looking_down(**fields: object) -> Sonar:
    given = {"azimuth_fov_deg": 100, "elevation_fov_deg": 100, "beams": 50, "rays_per_beam": 60, "rays_across": 1}
    return Sonar(**{**given, "range_min": 2.0, "range_max": 6.1, "range_bins": 64, **fields})


def levels(simulator: Simulator, poses: ArrayLike) -> dict[str, np.ndarray]:
    """Levels of each view."""
    batches = list(simulator.render_views(poses))
    return {
        view.name: np.concatenate([views[place].levels for views in batches]) for place, view in enumerate(simulator.views)
    }


# ---------------------------------------------------------------- segments


@pytest.mark.parametrize("model", ["thesis", "physical"])
def test_segments_add_up_to_the_whole(model: str) -> None:
    """Sums are exact, so halves and quadrants add up to the last bit of float32; and the whole is the plain image."""
    sonar = looking_down(model=model)
    world = scene(floor=floor(diffuse({"type": "cell_noise", "cells": 4000})), rock=box((0.6, 0.4, 0.2), (0.4, 0.5, 0.4)))
    poses = mounted([[0, 0, 2.5, 0, 0, 0.4], [0.3, -0.2, 2.2, 0, 0, 2.0]], DOWN)
    got = levels(Simulator(world, sonar, views=[Segment(sonar, name) for name in SEGMENTS]), poses)
    plain = next(Simulator(world, sonar).pings(poses)).levels
    np.testing.assert_array_equal(got["whole"], plain)
    np.testing.assert_allclose(got["starboard"] + got["port"], plain, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(np.concatenate([got["q2"], got["q1"]], axis=2), got["starboard"])
    np.testing.assert_array_equal(np.concatenate([got["q3"], got["q4"]], axis=2), got["port"])
    for number in "1234":
        whole, cone = got[f"q{number}"], got[f"c{number}"]
        assert cone.shape == whole.shape
        assert (cone <= whole * (1 + 1e-6)).all()
        assert 0.4 < cone.sum() / whole.sum() < 0.8  # a circle in a square holds 0.79 of it


def test_frames_are_of_all_beams() -> None:
    """A half has as many beams, a quadrant has not."""
    sonar, pose = looking_down(model="physical", quality="draft"), mounted([[0, 0, 2.5, 0, 0, 0.4]], DOWN)
    half, quadrant = (Simulator(scene(floor=floor()), sonar, views=[Segment(sonar, name)]) for name in ("port", "q1"))
    assert half.render(pose).image.shape == (1, 64, 50)
    with pytest.raises(MitsonarError, match=r"all 50 beams, but the first view, q1, has 25: .* use render_views"):
        quadrant.render(pose)


PLACES = [("q1", 1, 1), ("q2", 1, -1), ("q3", -1, -1), ("q4", -1, 1), ("c1", 1, 1), ("c3", -1, -1)]


@pytest.mark.parametrize(
    ("name", "starboard", "forward"),
    essence(PLACES, ("q1", 1, 1), ("q2", 1, -1), ("c3", -1, -1)),
)
def test_quadrants_look_where_their_names_say(name: str, starboard: int, forward: int) -> None:
    """Fore-starboard is the first, then clockwise: a ball off to one side of the vehicle is in that one alone."""
    sonar = looking_down()
    vehicle = Pose(5, -3, 2.5, 0, 0, np.radians(70))
    across, along, _ = axes(vehicle)
    place = np.array(vehicle[:3]) + 1.1 * (starboard * across + forward * along) - [0, 0, 2.3]
    world = scene(ball={"type": "sphere", "center": place.tolist(), "radius": 0.3, "bsdf": diffuse()})
    got = levels(Simulator(world, sonar, views=[Segment(sonar, second) for second in SEGMENTS]), mounted(vehicle, DOWN))
    for second, image in got.items():
        same = second[1:] == name[1:] or second in ("whole", "starboard" if starboard > 0 else "port")
        assert (image.sum() > 0) == same, second


def test_circular_segments_are_the_largest_cone_in_their_quadrant() -> None:
    """Every ray of the cone lies within one angle of its axis, and that angle reaches the quadrant's nearest border."""
    sonar = looking_down(beams=100, rays_per_beam=100)
    member = Segment(sonar, "c1").member.reshape(100, 100)
    bearing, elevation = np.meshgrid(sonar.bearing_rad, np.radians(50 - (np.arange(100) + 0.5)))
    axis = direction(sonar, np.radians(25), np.radians(-25))
    angle = np.degrees(np.arccos(direction(sonar, bearing, elevation) @ axis))
    radius = np.degrees(np.arcsin(np.cos(np.radians(25)) * np.sin(np.radians(25))))  # to the plane bearing = 0
    assert angle[member].max() <= radius < angle[member].max() + 1
    np.testing.assert_array_equal(member, angle <= radius)


def test_segments_count_only_their_own_rays() -> None:
    sonar = looking_down()
    view = Segment(sonar, "c2")
    (looks,) = Simulator(scene(floor=floor()), sonar, views=[view]).render_views(mounted([[0, 0, 2.5, 0, 0, 0]], DOWN))
    counts = looks[0].counts
    assert counts.inside.shape == (1, 25)
    assert counts.inside.sum() == view.member.sum()
    assert counts.nearer.sum() == counts.farther.sum() == counts.missed.sum() == 0


def test_segments_need_an_even_field() -> None:
    with pytest.raises(MitsonarError, match="even"):
        Segment(looking_down(beams=51), "q1")
    with pytest.raises(MitsonarError, match="q1"):
        Segment(looking_down(), "q9")


# ---------------------------------------------------------------- bistatic


def pair(model: str, offset: Pose, **fields: object) -> tuple[Sonar, Receiver]:
    """A transmitter of 24 x 8 columns, and a receiver of 24 beams."""
    across = {"beams": 192} if model == "thesis" else {"beams": 24, "rays_across": 8}
    shared = {"model": model, "range_bins": 60, "rays_per_beam": 300, **fields}
    transmitter = Sonar(**across, jitter=True, **shared)
    return transmitter, Receiver(transmitter, Sonar(beams=24, **shared), offset, "b")


@pytest.mark.parametrize("model", ["thesis", "physical"])
@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_a_receiver_at_the_transmitter_is_the_monostatic_sonar(model: str, bearing: str) -> None:
    world = scene(floor=floor(diffuse({"type": "cell_noise", "cells": 4000})), rock=box((0.1, 4.2, 0.2), (0.3, 0.2, 0.3)))
    transmitter, receiver = pair(model, Pose(0, 0, 0), bearing=bearing)
    pose = [Pose.from_degrees([0, 0, 2.5, 35, 0, 5])]
    received = levels(Simulator(world, transmitter, views=[receiver]), pose)["b"]
    local = next(Simulator(world, transmitter).pings(pose)).levels
    if model == "thesis":
        local = local.reshape(1, 60, 24, 8).sum(axis=3)
    error = np.abs(received - local).sum() / local.sum()
    assert error < 2e-3, f"sum of differences {error:.1e} of the whole"


@pytest.mark.parametrize("offset", [(0.8, 0, 0), (-0.5, 0, 0), (0.3, 0.4, -0.2)])
def test_a_single_point_is_heard_at_half_the_path_and_at_its_bearing(offset: tuple[float, float, float]) -> None:
    """A ball of 1 cm: range (|P - A| + |B - P|) / 2 and bearing in B's frame, for both kinds of bearing."""
    for bearing in ("azimuth", "cone"):
        transmitter, receiver = pair("thesis", Pose(*offset), bearing=bearing, range_bins=400, rays_per_beam=900)
        pose = Pose.from_degrees([1, 2, 2.5, 30, 0, 25])
        starboard, forward, up = axes(pose)
        a = np.array(pose[:3])
        b = a + np.array(offset) @ np.array([starboard, forward, up])
        point = a + 4.2 * forward + 0.25 * starboard + 0.1 * up
        world = scene(ball={"type": "sphere", "center": point.tolist(), "radius": 0.01, "bsdf": diffuse()})
        image = levels(Simulator(world, transmitter, views=[receiver]), [pose])["b"][0]
        assert image.sum() > 0
        bin_, beam = (np.average(np.arange(n), weights=image.sum(axis=axis)) for axis, n in ((1, 400), (0, 24)))
        sonar = receiver.sonar
        half = (np.linalg.norm(point - a) + np.linalg.norm(point - b)) / 2
        assert sonar.range_min + (bin_ + 0.5) * sonar.bin_m == pytest.approx(half, abs=0.02)
        way = (point - b) / np.linalg.norm(point - b)
        across, ahead, above = way @ starboard, way @ forward, way @ up
        expected = np.arctan2(across, ahead) if bearing == "azimuth" else np.arctan2(across, np.hypot(ahead, above))
        assert np.interp(beam, np.arange(24), sonar.bearing_rad) == pytest.approx(expected, abs=np.radians(0.7))


def test_energy_on_a_plate_follows_the_bistatic_law() -> None:
    """Physical model, closed form: the integral over the plate of C cos(theta_A) cos(theta_B) dA / (R_A^2 R_B^2)."""
    offset = (0.7, 0.0, 0.0)
    transmitter, receiver = pair("physical", Pose(*offset), azimuth_fov_deg=60, elevation_fov_deg=40, range_max=8.0)
    point, normal, half = np.array([0.3, 4.0, 0.1]), np.array([0.2, -1.0, 0.3]), 0.5
    normal = normal / np.linalg.norm(normal)
    world = scene(plate=plate(point, normal, half, diffuse(0.5)))
    image = levels(Simulator(world, transmitter, views=[receiver]), [Pose(0, 0, 0)] * 8)["b"] / 8  # draws of the jitter
    x, weight = np.polynomial.legendre.leggauss(40)
    side = np.cross(normal, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    lift = np.cross(normal, side)
    s, t = np.meshgrid(x * half, x * half)
    places = point + s[..., None] * side + t[..., None] * lift
    to_a, to_b = -places, np.array(offset) - places
    r_a, r_b = np.linalg.norm(to_a, axis=-1), np.linalg.norm(to_b, axis=-1)
    value = 0.5 * np.abs(to_a @ normal) / r_a * np.abs(to_b @ normal) / r_b / (r_a * r_b) ** 2
    expected = (value * weight * weight[:, None]).sum() * half**2
    assert image.sum(dtype=float) == pytest.approx(expected, rel=2e-3)


def test_footprints_fill_the_bins_of_a_floor_evenly() -> None:
    """Against many more rays: the range interval of a ray's cell, for a path over two places, leaves no gaps."""
    pose = [Pose.from_degrees([0, 0, 2.5, 35, 0, 0])]
    images = []
    for rays in (300, 6000):
        transmitter, receiver = pair("physical", Pose(0.5, 0, 0), rays_per_beam=rays)
        images.append(levels(Simulator(scene(floor=floor()), transmitter, views=[receiver]), pose)["b"][0])
    few, many = images
    inner = many > 0.2 * many.max()
    inner[:, :1] = inner[:, -1:] = False
    relative = few[inner] / many[inner] - 1
    assert np.sqrt((relative**2).mean()) < 0.05
    assert abs(few.sum() / many.sum() - 1) < 2e-3


def test_what_the_receiver_cannot_see_is_not_received() -> None:
    """A wall between the two hides the transmitter's half of the floor; beams outside B's field of view stay dark."""
    transmitter, receiver = pair("thesis", Pose(1.2, 0, 0))
    pose = [Pose.from_degrees([0, 0, 2.5, 35, 0, 0])]
    free = levels(Simulator(scene(floor=floor()), transmitter, views=[receiver]), pose)["b"][0]
    wall = plate((0.6, 0, 1.6), (1, 0, 0), half=3.0)
    hidden = levels(Simulator(scene(floor=floor(), wall=wall), transmitter, views=[receiver]), pose)["b"][0]
    assert hidden.sum() < 0.3 * free.sum()
    lit = free.sum(axis=0) > 0
    assert lit[0]  # port beams of a receiver to starboard see what the transmitter lights
    assert not lit[-1]  # its starboard beams do not


def test_the_other_side_of_a_sheet_is_silent() -> None:
    """A receiver behind a sheet that the transmitter lights from the front has no echo of it."""
    transmitter, receiver = pair("thesis", Pose(0, 9, 0, 0, 0, np.pi))
    world = scene(sheet=plate((0, 4.5, 0), (0, -1, 0), half=0.8))
    assert levels(Simulator(world, transmitter, views=[receiver]), [Pose(0, 0, 0)])["b"].sum() == 0


def test_receivers_that_cannot_be_are_refused() -> None:
    transmitter = Sonar(beams=96, rays_across=4)
    with pytest.raises(MitsonarError, match="8 jittered columns"):
        Receiver(transmitter, Sonar(beams=96), Pose(0.5, 0, 0), "b")
    with pytest.raises(MitsonarError, match="jitter False"):
        Receiver(Sonar(beams=96, rays_across=8, jitter=False), Sonar(beams=96), Pose(0.5, 0, 0), "b")
    with pytest.raises(MitsonarError, match="model"):
        Receiver(Sonar(beams=96, rays_across=8), Sonar(beams=96, model="thesis"), Pose(0.5, 0, 0), "b")
    with pytest.raises(MitsonarError, match="range_min"):
        Receiver(Sonar(beams=96, rays_across=8), Sonar(beams=96), Pose(7, 0, 0), "b")
    with pytest.raises(MitsonarError, match="overlap"):
        Receiver(Sonar(beams=96, rays_across=8), Sonar(beams=96, beam_width_deg=1.0), Pose(0.5, 0, 0), "b")


def test_views_agree_with_themselves_whatever_else_is_traced() -> None:
    """One launch or many, alone or beside others: the same bits."""
    sonar = looking_down()
    world = scene(floor=floor(diffuse({"type": "cell_noise", "cells": 4000})))
    poses = mounted([[0.1 * k, 0, 2.5, 0, 0, 0.1 * k] for k in range(5)], DOWN)
    alone = levels(Simulator(world, sonar, views=[Segment(sonar, "q3")]), poses)["q3"]
    many = levels(
        Simulator(world, sonar, views=[Segment(sonar, n) for n in SEGMENTS], rays_per_launch=sonar.rays * 2), poses
    )
    np.testing.assert_array_equal(alone, many["q3"])
