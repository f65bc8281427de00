"""Paths without a scatterer: the image method in closed form, an independent ray code, interference, blocked ways."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from channel_scenes import EVERYWHERE, C, unmerged
from helpers import box, diffuse, plate
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView, Hydrophone
from mitsonar.motion.pose import Pose
from mitsonar.simulation.channel import ChannelSimulator, Paths, frequency_response, impulse_response

if TYPE_CHECKING:
    import mitsuba as mi

pytestmark = pytest.mark.usefixtures("variant")

DEPTH = 20.0
BOTTOM = 1 / 3
"""Reflection of a bottom of twice the water's density and its sound speed, at every angle."""

SENT_FROM = Pose(0, 0, 15)
OFFSET = (0.0, 50.0, -7.0)
GUIDE = {"surface": (-1.0, 0.0), "seabed": (BOTTOM, 0.0)}


def hydrophone(place: tuple[float, float, float] = OFFSET, field: FieldOfView = EVERYWHERE) -> Hydrophone:
    return Hydrophone(name="one", position=place, field=field)


def instrument(**words: Any) -> ChannelSonar:
    given: dict[str, Any] = {"receivers": (hydrophone(),), "range_max": 60.0, "frequency_step_hz": 5.0, "direct": True}
    return ChannelSonar(**{**given, "bounces": 3, **words})


def guide(half: float = 200.0, **more: Any) -> mi.Scene:
    """A flat guide 20 m deep."""
    return unmerged(
        surface=plate((0, 0, DEPTH), (0, 0, -1), half=half), seabed=plate((0, 0, 0), (0, 0, 1), half=half), **more
    )


def images(reflections: int) -> list[tuple[str, float, float]]:
    """Name, height of the image and product of the coefficients, of up to so many reflections: written down by hand."""
    result = []
    for count in range(reflections + 1):
        for way in itertools.product(("surface", "seabed"), repeat=count):
            if any(one == next_ for one, next_ in itertools.pairwise(way)):
                continue
            z, v = float(SENT_FROM.z), 1.0
            for name in way:
                z, v = (2 * DEPTH - z, -v) if name == "surface" else (-z, BOTTOM * v)
            result.append(("-".join(way) or "direct", z, v))
    return result


def expected(reflections: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Delays and amplitudes in the order of :func:`images`."""
    length = np.array([np.hypot(OFFSET[1], SENT_FROM.z + OFFSET[2] - z) for _, z, _ in images(reflections)])
    return length / C, np.array([v for *_, v in images(reflections)]) / length


def decibels(got: NDArray[Any], wanted: NDArray[Any]) -> NDArray[np.float64]:
    return np.asarray(20 * np.log10(np.abs(got) / np.abs(wanted)))


def named(paths: Paths) -> list[str]:
    assert paths.kind is not None
    return [paths.kinds[k] for k in paths.kind]


@pytest.mark.parametrize("bounces", [1, 2, 3])
def test_a_guide_has_the_arrivals_of_the_image_method(bounces: int) -> None:
    """Delays within 1 ns, levels within 0.001 dB, sign included: 1 us and 0.5 dB are asked."""
    result = ChannelSimulator(guide(), instrument(bounces=bounces), mirrors=GUIDE)
    paths = result.paths(SENT_FROM)
    delay, amplitude = expected(bounces)
    assert named(paths) == [name for name, *_ in images(bounces)]
    assert len(paths.delay_s) == 1 + 2 * bounces
    assert np.abs(paths.delay_s - delay).max() < 1e-9
    assert np.abs(decibels(paths.amplitude, amplitude)).max() < 1e-3
    assert np.abs(np.angle(paths.amplitude / amplitude)).max() < 1e-6
    (part,) = result.pings([SENT_FROM])
    target = impulse_response(delay, amplitude, result.sonar)
    assert np.abs(part.response[0, 0] - target).max() < 1e-4 * np.abs(target).max()
    assert part.echoes[0, 0] == len(delay)


def test_a_guide_has_the_arrivals_of_bellhop(tmp_path: Path) -> None:
    """The same guide by another program: 1 us and 0.5 dB, up to three reflections. Seven paths, phases as well."""
    pelagic = pytest.importorskip("pelagic")
    file = tmp_path / "guide.env"
    depths = DEPTH - SENT_FROM.z, DEPTH - SENT_FROM.z - OFFSET[2]
    file.write_text(
        f"'guide'\n10000.0\n1\n'CVW'\n0 0.0 {DEPTH}\n0.0 {C} /\n{DEPTH} {C} /\n'A' 0.0\n{DEPTH} {C} 0.0 2.0 0.0 0.0 /\n"
        f"1\n{depths[0]} /\n1\n{depths[1]} /\n1\n{OFFSET[1] / 1000} /\n'A'\n6001\n-80.0 80.0 /\n0.0 {DEPTH + 1} 0.06\n"
    )
    result = pelagic.bellhop.load(str(file)).run().arrivals
    few = np.asarray(result.top_bounces) + np.asarray(result.bottom_bounces) <= 3
    delay = np.asarray(result.travel_time_s)[few]
    pressure = (np.asarray(result.amplitude) * np.exp(1j * np.asarray(result.phase_radians)))[few]
    ours = ChannelSimulator(guide(), instrument(), mirrors=GUIDE).paths(SENT_FROM)
    order, same = np.argsort(ours.delay_s), np.argsort(delay)
    assert len(same) == len(order) == 7
    assert np.abs(ours.delay_s[order] - delay[same]).max() < 1e-6
    assert np.abs(decibels(ours.amplitude[order], pressure[same])).max() < 0.5
    assert np.abs(np.angle(ours.amplitude[order] / pressure[same])).max() < 0.01


def test_a_hydrophone_pair_hears_its_surface_interfere() -> None:
    """Lloyd's mirror: H(f) = exp(-j k r) / r - exp(-j k r') / r' over the band, within 1e-4 of its mean."""
    sonar = instrument(bounces=1, bandwidth_hz=8e3, sampling_hz=16e3, rolloff=0.2)
    water = unmerged(surface=plate((0, 0, DEPTH), (0, 0, -1), half=200.0))
    paths = ChannelSimulator(water, sonar, mirrors={"surface": (-1.0, 0.0)}).paths(SENT_FROM)
    frequency, response = frequency_response(paths.delay_s, paths.amplitude, sonar)
    k = 2 * np.pi * (sonar.carrier_hz + frequency) / C
    straight, echo = np.hypot(50.0, 7.0), np.hypot(50.0, 17.0)
    target = np.exp(-1j * k * straight) / straight - np.exp(-1j * k * echo) / echo
    assert np.abs(response - target).max() < 1e-4 * np.abs(target).mean()
    assert np.abs(target).max() / np.abs(target).min() > 5  # it does interfere


def test_roughness_takes_what_rayleigh_says() -> None:
    """exp(-2 k^2 h^2 cos^2) for each reflection, h = 2 mm at 80 kHz."""
    height = 0.002
    smooth = ChannelSimulator(guide(), instrument(), mirrors=GUIDE).paths(SENT_FROM)
    rough = ChannelSimulator(guide(), instrument(points_per_m2=1e-3), mirrors={**GUIDE, "surface": (-1.0, height)}).paths(
        SENT_FROM
    )
    for name, z, _ in images(3):
        flat = abs(SENT_FROM.z + OFFSET[2] - z)
        cosine = flat / np.hypot(50.0, flat)
        loss = np.exp(-2 * (2 * np.pi * 80e3 / C * height * cosine) ** 2) ** name.split("-").count("surface")
        assert abs(rough.by(name).amplitude[0] / smooth.by(name).amplitude[0]) == pytest.approx(loss, rel=1e-4)


def test_what_is_in_the_way_blocks_a_path() -> None:
    """A wall from the bottom to 12.5 m leaves what passes above it; one of the surface's own size cuts its echo."""
    wall = box((0, 25, 6.25), (30, 0.1, 6.25), diffuse(0.1))
    behind = {"points_per_m2": 1.0}
    free = ChannelSimulator(guide(wall=wall), instrument(**behind), mirrors=GUIDE).paths(SENT_FROM)
    assert "direct" not in {name for name, *_ in images(3) if len(free.by(name).delay_s)}  # 11.5 m high at the wall
    assert len(free.by("surface").delay_s) == 1
    assert len(free.by("seabed").delay_s) == 0
    small = unmerged(surface=plate((0, 10, DEPTH), (0, 0, -1), half=2.0), seabed=plate((0, 0, 0), (0, 0, 1), half=200.0))
    cut = ChannelSimulator(small, instrument(bounces=1), mirrors=GUIDE).paths(SENT_FROM)  # its foot is at 19.2 m
    assert set(named(cut)) == {"direct", "seabed"}


def test_sensitivity_is_that_of_departure_and_arrival() -> None:
    """A transmitter that looks up and forward sends by the surface, and a receiver that looks down hears the bottom."""
    up = FieldOfView(shape="circular", tilt_deg=108.8, heading_deg=0.0, across_deg=10.0, taper=1.0)
    sends = ChannelSimulator(guide(), instrument(transmitter=up), mirrors=GUIDE).paths(SENT_FROM)
    whole = ChannelSimulator(guide(), instrument(), mirrors=GUIDE).paths(SENT_FROM)
    # 18.78 deg of the surface echo is 0 from the axis; surface-seabed leaves at 33.4 deg, outside
    assert set(named(sends)) == {"surface"}
    assert abs(sends.amplitude[0]) == pytest.approx(abs(whole.by("surface").amplitude[0]), rel=1e-3)
    down = FieldOfView(shape="circular", tilt_deg=90 - 24.702, heading_deg=180.0, across_deg=6.0, taper=1.0)
    hears = ChannelSimulator(guide(), instrument(receivers=(hydrophone(field=down),)), mirrors=GUIDE).paths(SENT_FROM)
    assert set(named(hears)) == {"seabed"}


def test_turned_vehicles_have_the_same_water() -> None:
    """The same two places, by a pose with pitch, roll and heading and an offset that is turned back."""
    from mitsonar.motion.pose import vehicle_rotation

    pose = Pose(0, 0, 15, 0.3, -0.2, 1.1)
    back = vehicle_rotation(np.array(pose)).as_matrix()[0].T @ np.array(OFFSET)
    turned = instrument(receivers=(hydrophone(tuple(back.tolist())),))
    one, second = (
        ChannelSimulator(guide(), sonar, mirrors=GUIDE).paths(at)
        for sonar, at in ((instrument(), SENT_FROM), (turned, pose))
    )
    assert np.abs(one.delay_s - second.delay_s).max() < 1e-10
    assert np.abs(one.amplitude / second.amplitude - 1).max() < 1e-5


@pytest.mark.parametrize("velocity", [(1.0, 2.0, -0.5, 0.0), (0.0, 0.0, 0.0, 0.4)])
def test_doppler_is_the_slope_of_the_delay(velocity: tuple[float, ...]) -> None:
    """Finite difference of the delay over the vehicle's motion, a turn included, for every path."""
    sonar, step = instrument(), 1e-3
    result = ChannelSimulator(guide(), sonar, mirrors=GUIDE)

    def moved(time: float) -> Pose:
        vx, vy, vz, turn = (value * time for value in velocity)
        return Pose(vx, vy, 15 + vz, 0.0, 0.0, turn)

    early, late = (result.paths(moved(time), velocity) for time in (-step / 2, step / 2))
    here = result.paths(SENT_FROM, velocity)
    slope = -sonar.carrier_hz * (late.delay_s - early.delay_s) / step
    assert np.abs(here.doppler_hz).max() > 5 or velocity[3]
    assert here.doppler_hz == pytest.approx(slope, abs=0.02 + 3e-3 * np.abs(slope).max())


def test_a_moving_receiver_hears_where_it_is_then() -> None:
    """|A' - B - v tau| = c tau for every image."""
    velocity = (0.5, 10.0, 1.0, 0.0)
    paths = ChannelSimulator(guide(), instrument(), mirrors=GUIDE).paths(SENT_FROM, velocity)
    for (_, z, _), delay in zip(images(3), paths.delay_s, strict=True):
        there = np.array([0, 50.0, 8.0]) + np.array(velocity[:3]) * delay - np.array([0, 0, z])
        assert np.linalg.norm(there) / C == pytest.approx(delay, abs=1e-12)


def test_a_receiver_at_the_transmitter_hears_its_echo_only() -> None:
    sonar = instrument(receivers=(hydrophone((0, 0, 0)),), bounces=1)
    paths = ChannelSimulator(guide(), sonar, mirrors=GUIDE).paths(SENT_FROM)
    assert named(paths) == ["surface", "seabed"]
    assert paths.delay_s == pytest.approx([10 / C, 30 / C], abs=1e-9)
    assert paths.amplitude == pytest.approx([-0.1, BOTTOM / 30], rel=1e-5)


def test_echoes_from_beyond_the_range_are_counted() -> None:
    sonar = instrument(range_max=28.0)  # 56 m of path: direct, surface and seabed
    paths = ChannelSimulator(guide(), sonar, mirrors=GUIDE).paths(SENT_FROM)
    assert named(paths) == ["direct", "surface", "seabed"]
    assert paths.dropped == 4


def test_a_mesh_of_planes_is_a_tank() -> None:
    """A closed box as one shape: six planes, each single reflection as its own image has it."""
    tank = box((0, 0, 0), (3.0, 4.0, 2.0), diffuse(0.1))
    sonar = instrument(receivers=(hydrophone((0.5, 0.7, -0.3)),), bounces=2)
    result = ChannelSimulator(unmerged(tank=tank), sonar, mirrors={"tank": (-0.8, 0.0)})
    start, end = np.array([0.2, -0.4, 0.5]), np.array([0.7, 0.3, 0.2])
    paths = result.paths(Pose(*start))
    target = {round(float(np.linalg.norm(end - start)), 6): 1.0}
    half = np.array([3.0, 4.0, 2.0])
    walls = [(axis, side) for axis in range(3) for side in (-1, 1)]
    for axis, side in walls:
        image = start.copy()
        image[axis] = 2 * side * half[axis] - image[axis]
        target[round(float(np.linalg.norm(end - image)), 6)] = -0.8
        for another, second in walls:
            if (another, second) != (axis, side):
                twice = image.copy()
                twice[another] = 2 * second * half[another] - twice[another]
                # two walls of two axes share an image in both orders: sound takes one of them
                target[round(float(np.linalg.norm(end - twice)), 6)] = 0.64
    assert len(paths.delay_s) == len(target) == 1 + 6 + 3 * 4 + 3 * 2
    order = np.argsort(paths.delay_s)
    assert paths.delay_s[order] * C == pytest.approx(sorted(target), abs=2e-6)
    lengths = np.array(sorted(target))
    assert paths.amplitude[order] * lengths == pytest.approx([target[length] for length in sorted(target)], rel=1e-5)


@pytest.mark.thorough
def test_more_orders_of_planes_than_can_be_traced_are_refused() -> None:
    plates = {f"p{k}": plate((0, 0, 30.0 + k), (0, 0, -1), half=1.0) for k in range(40)}
    parts = dict.fromkeys(plates, (0.5, 0.0))
    with pytest.raises(MitsonarError, match=r"the 40 planes of the mirrors in 60,840 orders of 3: at most 20,000"):
        ChannelSimulator(unmerged(**plates), instrument(bounces=3), mirrors=parts)
    assert len(ChannelSimulator(unmerged(**plates), instrument(bounces=1), mirrors=parts).kinds) == 42


def test_mirrors_that_do_not_fit_are_refused() -> None:
    with pytest.raises(MitsonarError, match="bounces 3 need mirrors, and the scene has none: give reflection"):
        ChannelSimulator(guide(), instrument(points_per_m2=1e-3))
    with pytest.raises(MitsonarError, match="the scene has no shape surfase"):
        ChannelSimulator(guide(), instrument(), mirrors={"surfase": (-1.0, 0.0)})
    with pytest.raises(MitsonarError, match="bounces and direct need the model scatterers"):
        instrument(bounces=1).replace(model="rays")
    with pytest.raises(MitsonarError, match="mirrors need the model scatterers: got the model rays"):
        ChannelSimulator(guide(), ChannelSonar(model="rays"), mirrors=GUIDE)
    with pytest.raises(MitsonarError, match="bounces"):
        ChannelSonar().replace(bounces=4)
    with pytest.raises(MitsonarError, match="no kind of path is named 'surfice'"):
        ChannelSimulator(guide(), instrument(), mirrors=GUIDE).paths(SENT_FROM).by("surfice")


# ---------------------------------------------------------------- slips


def test_receivers_have_names_and_numbers() -> None:
    simulator = ChannelSimulator(guide(), instrument(), mirrors=GUIDE)
    by_name, by_number = (simulator.paths(SENT_FROM, receiver=one) for one in ("one", 0))
    np.testing.assert_array_equal(by_name.delay_s, by_number.delay_s)
    for wrong in ("two", 1, -1, 0.0, True, None):
        with pytest.raises(MitsonarError, match=r"receiver must be a name of one, or a number 0\.\.0: got"):
            simulator.paths(SENT_FROM, receiver=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("part", [-1.0, None, (1.0,), (1.0, 0.0, 0.0), "steel", ("x", 0)])
def test_a_mirror_that_is_no_pair_is_told(part: Any) -> None:
    with pytest.raises(MitsonarError, match=r"mirrors: surface needs a pair, .* such as \(-1\.0, 0\.0\): got"):
        ChannelSimulator(guide(), instrument(), mirrors={"surface": part})


def test_mirrors_of_materials_where_there_are_none_are_told() -> None:
    assert not any("no mirrors" in note for note in ChannelSimulator(guide(), instrument(), mirrors=GUIDE).notes)
    (note,) = ChannelSimulator(guide(half=5.0), instrument(bounces=1), mirrors="materials").notes
    assert "the scene has no mirrors: no shape has an acoustic_material with reflection and roughness_m" in note
    with pytest.raises(MitsonarError, match="mirrors must be mirror parts keyed by shape id, or `materials`: got 5"):
        ChannelSimulator(guide(), instrument(), mirrors=5)  # type: ignore[arg-type]
