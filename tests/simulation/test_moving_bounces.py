"""Bodies that move before mirrors that stand still: ghosts at the ranges of image sources, each ping anew."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from coherent_scenes import one_point
from helpers import Array, box, diffuse, essence, floor, plate, separate, sphere

from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.simulator import Simulator

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside|.*reflect more than")]

SONAR = Sonar.create(model="physical", beams=24, azimuth_fov_deg=28.8, elevation_fov_deg=60.0, range_min=3.0, range_max=9.0,
                     range_bins=600, frequency_hz=9e5, absorption_db_per_m=0.0, bounces=3, quality="draft")  # fmt: skip

COHERENT = Sonar.create(model="coherent", frequency_hz=9e5, beams=48, azimuth_fov_deg=28.8, elevation_fov_deg=60.0,
                        range_min=3.5, range_max=6.0, range_bins=500, elevation_pattern="box", absorption_db_per_m=0.0,
                        bounces=3)  # fmt: skip

RADIUS, DEPTH = 0.03, 1.0
BEGIN, SPEED = np.array([0.3, 4.5, -1.3]), np.array([-0.2, 0.5, 0.1])
"""Of the ball [m, m/s]."""

K = 2 * math.pi * 9e5 / 1500


def moving(begin: Array, speed: Array, seconds: float = 4.0) -> Trajectory:
    places = np.array([begin, begin + seconds * speed])
    return Trajectory(np.concatenate([places, np.zeros((2, 3))], axis=1), np.array([0.0, seconds]))


def swimming(place: Any = (0, 0, 0)) -> Any:
    """A ball below a mirror at z = 0."""
    return separate(
        top=plate((0, 2.5, 0), (0, 0, -1), half=50.0, bsdf=diffuse(0.0)), ball=sphere(place, RADIUS, diffuse(0.3))
    )


def test_a_moving_ball_has_its_ghosts_at_image_sources_in_each_ping() -> None:
    """In one launch of several moments: (R + R') / 2 and R', each 3/4 of the radius nearer, within one bin."""
    simulator = Simulator(
        swimming(), SONAR.replace(quality="standard"), mirrors={"top": (-1.0, 0.0)}, moving={"ball": moving(BEGIN, SPEED)}
    )
    time_s = np.array([0.0, 1.0, 2.5, 4.0])
    (pings,) = simulator.pings(np.tile([0, 0, -DEPTH, 0, 0, 0], (4, 1)), time_s=time_s)
    for levels, time in zip(pings.levels.sum(axis=2), time_s, strict=True):
        at = BEGIN + time * SPEED
        near, far = (float(np.linalg.norm(at - [0, 0, z])) for z in (-DEPTH, DEPTH))
        for range_m in ((near + far) / 2, far):
            inside = np.abs(SONAR.range_m - (range_m - RADIUS / 2)) < RADIUS
            middle = np.average(SONAR.range_m[inside], weights=levels[inside])
            assert middle == pytest.approx(range_m - 0.75 * RADIUS, abs=SONAR.bin_m)


@pytest.mark.parametrize(
    "changes", essence([{}, {"pattern": "receive", "bearing": "cone"}, {"ping_groups": 4}], {"ping_groups": 4})
)
def test_a_moved_body_is_one_built_there(changes: dict[str, Any]) -> None:
    """Light between rough surfaces and a mirror included: the walk draws the same directions."""
    sonar = SONAR.replace(bounces=3, **changes)
    pose = np.array([[0, 0, 1.0, -0.1, 0, 0]])
    shapes = {"ground": floor(diffuse(0.3)), "wall": plate((0, 7, 0), (0, -1, 0), bsdf=diffuse(0.2))}
    places = [np.array([0.0, 5.0, 0.6]), np.array([0.4, 5.5, 0.6])]
    moved = separate(**shapes, crate=box((0, 0, 0), (0.3, 0.3, 0.3), diffuse(0.3)))
    path = moving(places[0], places[1] - places[0], 1.0)
    simulator = Simulator(moved, sonar, mirrors={"wall": (0.8, 1e-4)}, moving={"crate": path})
    for place, time in zip(places, (0.0, 1.0), strict=True):
        built = separate(**shapes, crate=box(place, (0.3, 0.3, 0.3), diffuse(0.3)))
        (want,) = Simulator(built, sonar, mirrors={"wall": (0.8, 1e-4)}).pings(pose)
        (got,) = simulator.pings(pose, time_s=np.array([time]))
        off = np.abs(got.levels - want.levels)
        assert (off > 1e-3 * want.levels.max()).mean() < 2e-3  # rays at edges may go either way
        assert got.levels.sum() == pytest.approx(want.levels.sum(), rel=2e-3)


def test_a_moving_point_has_the_ghosts_of_image_sources() -> None:
    """Amplitudes and phases in closed form where the body has gone to: 1 % and 0.03 rad; the point goes with the body."""
    from mitsonar.simulation.models.coherent import CoherentImager
    from mitsonar.simulation.moving import motion_in
    from mitsonar.simulation.multipath_coherent import GhostTracer

    height, speed = 0.8, np.array([0.02, 0.3, -0.1])
    _, changes, at = one_point()
    loaded = separate(
        target=plate((0, 4.4, 0), (0, -1, 0), half=0.01, bsdf=diffuse(0.5)),
        top=plate((0, 0, height), (0, 0, -1), half=50.0, bsdf=diffuse(0.0)),
    )
    poses = np.array([np.zeros(6), [*(4 * speed), 0.02, -0.1, 0.04]])
    path = Trajectory(poses, np.array([0.0, 4.0]))
    motion = motion_in(loaded, {"target": path})
    local = COHERENT.replace(**changes)
    imager = CoherentImager(loaded, local, {"top": (-1.0, 0.0)}, motion=motion)
    for time in (0.0, 0.5, 2.0):  # where a ray that meets the plate has the point in its cell
        turn = vehicle_rotation(path.at(time)).as_matrix()[0]
        place, normal = turn @ at + time * speed, turn @ [0, 1, 0]
        cosines = normal @ place, normal @ (place - [0, 0, 2 * height])
        near, far = float(np.linalg.norm(place)), float(np.linalg.norm(place - [0, 0, 2 * height]))
        direct = complex(imager.tracer.field(np.zeros(6), time)[0].astype(complex).sum())
        scale = direct / (cosines[0] / near / near**2)
        sums = []
        for bounces in (2, 3):
            imager.tracer.sonar = local.replace(bounces=bounces)
            field = np.zeros((imager.former.ranges, imager.former.sines), np.complex64)
            GhostTracer(imager.tracer).add(np.zeros(6), field, time)
            sums.append(complex(field.astype(complex).sum()))
        for got, level, longer in (
            (sums[0], -2 * math.sqrt(cosines[0] / near * cosines[1] / far) / (near * far), far - near),
            (sums[1] - sums[0], cosines[1] / far / far**2, 2 * (far - near)),
        ):
            ratio = got / (scale * level * np.exp(-1j * K * longer))
            assert abs(ratio) == pytest.approx(1, rel=0.01), time
            assert np.angle(ratio) == pytest.approx(0, abs=0.03), time


@pytest.mark.thorough
def test_bodies_hide_mirrors_and_leave_those_beside_them_as_they_are() -> None:
    """A corner of two mirrors glints: with a body elsewhere as without it, and not at all behind the body."""
    shapes = {
        "left": plate((0, 5, 0), (1, -1, 0), half=0.3, bsdf=diffuse(0.0)),
        "right": plate((0, 5, 0), (-1, -1, 0), half=0.3, bsdf=diffuse(0.0)),
    }
    mirrors = {"left": (1.0, 0.0), "right": (1.0, 0.0)}
    sonar = COHERENT.replace(elevation_fov_deg=20.0, azimuth_fov_deg=14.4, pattern="receive", bounces=2)
    screen = box((0, 0, 0), (1.0, 0.05, 1.0), diffuse(0.0))
    path = moving(np.array([0, -3.0, 0]), np.array([0, 4.2, 0]), 1.0)
    simulator = Simulator(separate(**shapes, screen=screen), sonar, mirrors=mirrors, moving={"screen": path})
    (plain,) = Simulator(separate(**shapes), sonar, mirrors=mirrors).pings(np.zeros(6))
    behind, before = (next(iter(simulator.pings(np.zeros(6), time_s=[time]))).levels for time in (0.0, 1.0))
    assert plain.levels.max() > 0
    np.testing.assert_allclose(behind, plain.levels, atol=1e-4 * plain.levels.max())
    assert before.max() < 1e-6 * plain.levels.max()


def test_mirrors_that_move_are_refused() -> None:
    loaded = separate(top=floor(), ball=sphere((0, 3, 0), 0.1))
    path = moving(BEGIN, SPEED)
    for sonar in (SONAR, COHERENT):
        Simulator(loaded, sonar, moving={"ball": path}, mirrors={"top": (-1.0, 0.0)})
        with pytest.raises(MitsonarError, match="mirrors must not move: got ball, which moves"):
            Simulator(loaded, sonar, moving={"ball": path}, mirrors={"ball": (0.5, 0.0), "top": (-1.0, 0.0)})
