"""Impulse responses: closed forms, direct sums, and scatterers that stay where they are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import pytest
from channel_scenes import LEVEL, C, cells_floor, points, received_from, scatterers_of, simulator
from helpers import diffuse, floor, plate, scene
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView, Hydrophone, four_receivers
from mitsonar.motion.composition import steady
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.responses import ImpulseResponses
from mitsonar.simulation.channel import ChannelSimulator, Paths, impulse_response

if TYPE_CHECKING:
    import mitsuba as mi


pytestmark = pytest.mark.usefixtures("variant")


def one_response(
    made: ChannelSimulator, pose: Pose = LEVEL, velocity: Sequence[float] | None = None
) -> NDArray[np.complex128]:
    (part,) = made.pings([pose], None if velocity is None else [velocity])
    return np.asarray(part.response[0], np.complex128)


# ---------------------------------------------------------------- one plate, two receivers


def test_one_plate_is_one_pulse_of_known_delay_magnitude_and_phase() -> None:
    sonar = ChannelSonar(receivers=(received_from((0.3, 0.1, 0)),), points_per_m2=1e4, seed=1)
    built = simulator(sonar, plate=plate((1, 7, 2), (-1, -7, 8), half=0.005))
    (place,) = points(built)
    sent, back = np.array(LEVEL[:3]), np.add(LEVEL[:3], (0.3, 0.1, 0))
    r_a, r_b = np.linalg.norm(place - sent), np.linalg.norm(place - back)
    normal = np.array([-1, -7, 8]) / np.linalg.norm([-1, -7, 8])
    cosines = abs(normal @ (place - sent)) / r_a * abs(normal @ (place - back)) / r_b
    (strength,), (phase,) = scatterers_of(built).strength, scatterers_of(built).phase  # the point's own, drawn once
    amplitude = np.sqrt(strength * cosines) * np.exp(1j * phase) / (r_a * r_b)
    delay = (r_a + r_b) / C
    expected = amplitude * sonar.pulse(sonar.delay_s - delay) * np.exp(-2j * np.pi * sonar.carrier_hz * delay)
    result = one_response(built)[0]
    assert np.abs(result - expected).max() < 1e-5 * np.abs(expected).max()
    assert np.abs(result).argmax() == round(delay * sonar.sampling_hz)


def test_two_receivers_differ_in_phase_as_their_ways_do() -> None:
    sonar = ChannelSonar(
        receivers=(received_from(), received_from((0.12, 0, 0)).model_copy(update={"name": "two"})), points_per_m2=1e4
    )
    result = simulator(sonar, plate=plate((6.005, 7.005, 0), (0, 0, 1), half=0.005))
    (place,) = points(result)
    way = [np.linalg.norm(place - np.array(LEVEL[:3]) - offset) for offset in sonar.offsets]
    first, second = one_response(result)
    peak = np.abs(first).argmax()
    expected = -2 * np.pi * sonar.carrier_hz * (way[1] - way[0]) / C
    difference = np.angle(second[peak] / first[peak]) - expected
    assert abs(np.angle(np.exp(1j * difference))) < 1e-4


def test_a_moving_vehicle_receives_later_or_sooner() -> None:
    sonar = ChannelSonar(receivers=(received_from(),), points_per_m2=1e4)
    result = simulator(sonar, plate=plate((0, 7, 0), (0, 0, 1), half=0.005))
    still, moving = result.paths(LEVEL), result.paths(LEVEL, [0, 2, 0, 0])
    forward = 7 / np.hypot(7, 10)
    assert (still.delay_s - moving.delay_s)[0] == pytest.approx(2 * forward * still.delay_s[0] / C, rel=1e-2)
    assert moving.doppler_hz[0] == pytest.approx(2 * 2 * forward / sonar.wavelength_m, rel=1e-2)


def test_turning_swings_receivers_around() -> None:
    """A receiver 0.5 m to starboard of a vehicle that turns to starboard moves back."""
    result = simulator(
        ChannelSonar(receivers=(received_from((0.5, 0, 0)),), points_per_m2=1e4),
        plate=plate((0, 9, 10), (0, -1, 0), half=0.005),
    )
    turned, straight = result.paths(LEVEL, [0, 0, 0, 0.8]), result.paths(LEVEL, [0, -0.4, 0, 0])
    assert turned.delay_s[0] == pytest.approx(straight.delay_s[0], abs=1e-12)
    assert turned.delay_s[0] > result.paths(LEVEL).delay_s[0]


# ---------------------------------------------------------------- from ping to ping


def rough_floor(half: float = 9.0, cells: int = 160, rms: float = 0.05) -> mi.Mesh:
    """A mesh of random heights, as wide as ``2 half``."""
    import mitsuba as mi

    edge = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(edge, edge)
    z = np.random.default_rng(4).normal(0, rms, x.shape)
    corner = np.arange((cells + 1) ** 2).reshape(x.shape)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, 1:].ravel(), corner[1:, :-1].ravel()
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(diffuse(0.5))
    mesh = mi.Mesh("rough", vertex_count=x.size, face_count=len(faces), props=props, has_vertex_normals=False)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.column_stack([x.ravel(), y.ravel(), z.ravel()]).astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    return mesh


STEPS_M = np.array([1e-4, 3e-4, 1e-3, 2e-3, 5e-3])


def correlations(
    made: ChannelSimulator, steps: NDArray[np.float64], places: NDArray[np.float64] | None = None
) -> NDArray[np.complex128]:
    """Correlation coefficients of responses with those ``steps`` ahead, over all places ``(receivers, steps)``."""
    places = np.zeros((1, 2)) if places is None else places
    product: NDArray[np.complex128] = np.zeros((), np.complex128)
    energy: NDArray[np.float64] = np.zeros(())
    for place in places:
        poses = np.zeros((len(steps) + 1, 6))
        poses[:, :2], poses[:, 2] = place, 8.0
        poses[1:, 1] += steps
        response = np.concatenate([part.response for part in made.pings(poses)]).astype(np.complex128)
        product = product + np.einsum("rt,srt->rs", response[0].conj(), response[1:])
        energy = energy + (np.abs(response) ** 2).sum(axis=2)
    return np.asarray(product / np.sqrt(energy[0] * energy[1:]).T)


@pytest.mark.thorough
def test_correlation_from_ping_to_ping_is_that_of_the_points() -> None:
    """On a rough floor, 0.1 to 5 mm apart: phase within 2 % of a direct sum over the anchored points, written down here."""
    sonar = ChannelSonar(range_max=20.0)
    built = simulator(sonar, floor=rough_floor())
    result = correlations(built, STEPS_M)[0]
    echo = scatterers_of(built)
    field = sonar.receivers[0].field
    responses = []
    for ahead in (0.0, *STEPS_M):
        sent = np.array([0, ahead, 8.0])
        received = np.add(sent, (0, 0.1, 0))
        out, back = echo.place - sent, echo.place - received
        r_a, r_b = np.linalg.norm(out, axis=1), np.linalg.norm(back, axis=1)
        cosines = np.einsum("pi,pi->p", out, echo.normal) * np.einsum("pi,pi->p", back, echo.normal) / (r_a * r_b)
        weight = field.sensitivity(*(field.axes @ (back / r_b[:, None]).T))
        amplitude = weight * np.sqrt(echo.strength * np.maximum(cosines, 0)) / (r_a * r_b)
        loud = np.flatnonzero(amplitude)
        zeta = np.exp(1j * echo.phase[loud])  # its size is in the strength
        responses.append(impulse_response((r_a + r_b)[loud] / C, amplitude[loud] * zeta, sonar))
    here, *there = responses
    direct = np.array([np.vdot(here, one) / np.linalg.norm(here) / np.linalg.norm(one) for one in there])
    assert np.abs(np.angle(result) / np.angle(direct) - 1)[1:].max() < 0.02
    assert np.abs(np.abs(result) - np.abs(direct)).max() < 0.02
    assert np.angle(result)[2] > 0.1  # going towards what it sees, the way gets shorter


def test_rays_of_the_vehicle_do_not_feel_its_motion() -> None:
    """The artefact that `scatterers` is without: over level ground rays keep their delays, only reflectivities change."""
    phases = {}
    for model in ("rays", "scatterers"):
        sonar = ChannelSonar(range_max=20.0, model=model)
        phases[model] = np.angle(correlations(simulator(sonar, floor=floor(diffuse(0.5), 9.0)), STEPS_M)[0])
    assert np.abs(phases["rays"]).max() < 1e-3
    assert phases["scatterers"][-1] > 0.5


@pytest.mark.thorough
def test_doppler_of_every_echo() -> None:
    """2 v cos / lambda, against the phase of the same points from a place that is really farther on."""
    sonar = ChannelSonar(receivers=(received_from(),), points_per_m2=200.0)
    result = simulator(sonar, floor=rough_floor())
    here, there = result.paths(LEVEL), result.paths(Pose(0, 2e-5, 10))
    rate = (here.delay_s - there.delay_s) * sonar.carrier_hz / 1e-5
    doppler = result.paths(LEVEL, [0, 2, 0, 0]).doppler_hz
    ahead = points(result)[result.tracer.trace(np.array(LEVEL), np.zeros(4), 0, ("counts",))["counts"]] - np.array(LEVEL[:3])
    cosine = ahead[:, 1] / np.linalg.norm(ahead, axis=1)
    steep = np.abs(cosine) > 0.1
    assert np.abs(doppler / (2 * 2 * cosine / sonar.wavelength_m) - 1)[steep].max() < 1e-5
    assert np.abs(rate / doppler - 1)[steep].max() < 1e-4


@pytest.mark.parametrize("velocity", [(0, 0, 0, 0.4), (0.5, 1.0, -0.2, 0.4), (0, 0, 0, -2.0)])
def test_doppler_in_a_turn_is_the_slope_of_the_delay(velocity: tuple[float, ...]) -> None:
    """-f d tau / dt of exact delays 2 ms apart, a receiver 0.5 m to starboard of the axis of the turn. What is left out is
    of second order: twice (v / c)^2 of the carrier, and the turning of the receiver's velocity while sound travels."""
    sonar = ChannelSonar(receivers=(received_from((0.5, 0, 0)),), points_per_m2=20.0)
    result = simulator(sonar, floor=floor(diffuse(0.5), 5.0))
    apart, turn = 1e-3, velocity[3]
    start, ahead = Pose(0.3, -0.2, 10, heading=0.7), np.array([np.sin(0.7), np.cos(0.7)])
    over_ground = [velocity[0] * ahead[1] + velocity[1] * ahead[0], velocity[1] * ahead[1] - velocity[0] * ahead[0]]
    rate = np.array([*over_ground, velocity[2], 0, 0, turn])
    before, after = (result.paths(Pose(*(start + sign * apart * rate)), velocity).delay_s for sign in (-1, 1))
    slope = -sonar.carrier_hz * (after - before) / (2 * apart)
    here = result.paths(start, velocity)
    fastest = np.linalg.norm(velocity[:3]) + abs(turn) * 0.5
    second_order = 3 * (fastest / C) ** 2 + abs(turn) * fastest * here.delay_s.max() / C
    assert np.ptp(slope) > 2
    assert np.abs(here.doppler_hz - slope).max() < sonar.carrier_hz * second_order


@pytest.mark.parametrize("tilt", [45.0, pytest.param(60.0, marks=pytest.mark.slow)])
@pytest.mark.thorough
def test_doppler_of_an_angle(tilt: float) -> None:
    """Within 0.5 %: phase between responses 40 um apart of a narrow beam, mean over places. (A beam that moves over the
    ground changes which points it holds: the narrower, the more places are needed.)"""
    field = FieldOfView(shape="circular", tilt_deg=tilt, across_deg=4.0, taper=1.0)
    sonar = ChannelSonar(receivers=(Hydrophone(name="one", field=field),), points_per_m2=2500.0)
    result = simulator(sonar, floor=rough_floor(half=18.0, rms=0.01))
    speed, apart, places = 2.0, 2e-5, 100
    rng = np.random.default_rng(2)
    first = np.zeros((places, 6))
    first[:, :2], first[:, 2], first[:, 5] = rng.uniform(-3, 3, (places, 2)), 8.0, rng.uniform(0, 6, places)
    second = first.copy()
    second[:, :2] += np.stack([np.sin(first[:, 5]), np.cos(first[:, 5])], axis=1) * speed * apart
    here, there = (np.concatenate([part.response for part in result.pings(poses)]) for poses in (first, second))
    doppler = np.angle(np.vdot(here.astype(np.complex128), there.astype(np.complex128))) / (2 * np.pi * apart)
    assert doppler == pytest.approx(2 * speed * np.sin(np.radians(tilt)) / sonar.wavelength_m, rel=0.005)


@pytest.mark.slow
def test_correlation_does_not_depend_on_the_density_of_points() -> None:
    """Its curve over the way, at one density and at twice as many points: correlation 0.99 at least, means over places."""
    steps, places = np.linspace(0.5e-3, 20e-3, 12), np.random.default_rng(5).uniform(-2, 2, (8, 2))
    curves = []
    for density in (1000.0, 2000.0):
        result = simulator(ChannelSonar(range_max=20.0, points_per_m2=density), floor=rough_floor(half=12.0, cells=200))
        curves.append(correlations(result, steps, places))
    similar = abs(np.vdot(*curves)) / np.linalg.norm(curves[0]) / np.linalg.norm(curves[1])
    assert similar > 0.99


# ---------------------------------------------------------------- reports and refusals


def test_the_same_bits_however_many_pings_are_asked_for() -> None:
    result = simulator(ChannelSonar(), floor=cells_floor())
    flown, velocity = steady(LEVEL, (1.0, -0.5, 0.2), 20, 20.0)
    together = result.responses(flown, velocity).response
    for first in (0, 7, 19):
        (alone,) = result.pings(flown.poses[first : first + 1], velocity[first : first + 1])
        assert np.array_equal(alone.response[0], together[first])
    repeated = simulator(ChannelSonar(), floor=cells_floor()).responses(flown, velocity).response
    assert np.array_equal(repeated, together)


@pytest.mark.parametrize("model", ["scatterers", "rays"])
def test_echoes_from_too_far_are_dropped_and_counted(model: Literal["scatterers", "rays"]) -> None:
    far = ChannelSonar(model=model, range_max=12.0, frequency_step_hz=10.0)
    (near_part,), (far_part,) = (
        simulator(sonar, floor=cells_floor()).pings([LEVEL]) for sonar in (ChannelSonar(model=model), far)
    )
    assert (near_part.dropped == 0).all()
    assert (far_part.dropped > 0).all()
    assert np.array_equal(far_part.dropped + far_part.echoes, near_part.echoes)
    late = int(24 / C * far.sampling_hz) + 8
    assert np.abs(far_part.response[:, :, late:]).max() < 1e-2 * np.abs(far_part.response).max()


def test_height_is_measured() -> None:
    (part,) = simulator(ChannelSonar(), floor=cells_floor()).pings([LEVEL, Pose(100, 0, 10)])
    assert part.height_m[0] == pytest.approx(10.0)
    assert np.isnan(part.height_m[1])
    assert not part.response[1].any()


def test_no_surface_to_carry_scatterers() -> None:
    with pytest.raises(MitsonarError, match="no surface that can carry scatterers"):
        ChannelSimulator(scene(), ChannelSonar())
    with pytest.raises(MitsonarError, match="no surface that can carry scatterers"):
        ChannelSimulator(scene(floor=floor(diffuse(0.5), 0.001)), ChannelSonar())
    with pytest.raises(MitsonarError, match="more than"):
        ChannelSimulator(scene(floor=floor(diffuse(0.5), 1e4)), ChannelSonar())


@pytest.mark.parametrize("velocity", [[[0, 0, 0]], [[np.nan, 0, 0, 0]], [[1000, 0, 0, 0]]])
def test_velocities_that_cannot_be(velocity: list[list[float]]) -> None:
    with pytest.raises(MitsonarError, match="velocity"):
        list(simulator(ChannelSonar(), floor=cells_floor(cells=32.0)).pings([LEVEL], velocity))


def test_responses_are_saved_whole(tmp_path: Path) -> None:
    result = simulator(ChannelSonar(receivers=four_receivers(across_deg=20.0)[:2]), floor=cells_floor(cells=64.0))
    flown, velocity = steady(LEVEL, (1.0, -0.5, 0.2), 3, 20.0)
    responses = result.responses(flown, velocity)
    for name in ("responses.npz", "responses.zarr"):
        responses.save(tmp_path / name)
        back = ImpulseResponses.load(tmp_path / name)
        assert back.sonar == responses.sonar
        for key, values in responses.arrays().items():
            assert np.array_equal(back.arrays()[key], values)
    (tmp_path / "responses.npz").write_bytes(b"PK no")
    with pytest.raises(MitsonarError, match="cannot read responses"):
        ImpulseResponses.load(tmp_path)


def test_paths_add_up_to_the_response() -> None:
    result = simulator(ChannelSonar(), floor=cells_floor())
    (part,) = result.pings([LEVEL], [[1.0, 2.0, 0.0, 0.0]])
    for receiver in range(4):
        received: Paths = result.paths(LEVEL, [1.0, 2.0, 0.0, 0.0], receiver)
        assert len(received.delay_s) == part.echoes[0, receiver]
        expected = impulse_response(received.delay_s, received.amplitude, result.sonar)
        assert np.abs(part.response[0, receiver] - expected).max() < 2e-6 * np.abs(expected).max()


def test_another_instrument_may_use_the_same_scatterers() -> None:
    ground, sonar = scene(floor=cells_floor()), ChannelSonar()
    first, second = ChannelSimulator(ground, sonar), sonar.replace(carrier_hz=40e3)
    shared = ChannelSimulator(ground, second, like=first)
    assert scatterers_of(shared) is scatterers_of(first)
    assert np.array_equal(one_response(shared), one_response(ChannelSimulator(ground, second)))
    assert scatterers_of(ChannelSimulator(ground, sonar.replace(seed=3), like=first)) is not scatterers_of(first)


def test_a_trajectory_alone_is_at_rest() -> None:
    result = simulator(ChannelSonar(), floor=cells_floor(cells=64.0))
    flown = Trajectory(np.array([LEVEL]), np.zeros(1))
    assert np.array_equal(result.responses(flown).response, result.responses(flown, np.zeros((1, 4))).response)


# ---------------------------------------------------------------- lines, absorption, boxes


def test_absorption_lowers_each_echo_by_the_length_of_its_path() -> None:
    """One plate: amplitude times 10^(-a c tau / 20), delay and phase as without."""
    clear = ChannelSonar(receivers=(received_from((0.3, 0.1, 0)),), points_per_m2=1e4, seed=1)
    results = [
        simulator(one, plate=plate((1, 7, 2), (-1, -7, 8), half=0.005)).paths(LEVEL)
        for one in (clear, clear.replace(absorption_db_per_m=0.5))
    ]
    assert results[0].delay_s == pytest.approx(results[1].delay_s, abs=1e-15)
    loss = 20 * np.log10(np.abs(results[0].amplitude / results[1].amplitude))
    assert loss == pytest.approx(0.5 * C * results[0].delay_s, rel=1e-4)
    with pytest.raises(MitsonarError, match="absorption_db_per_m"):
        clear.replace(absorption_db_per_m=-1)


def test_absorption_also_lowers_the_direct_arrival() -> None:
    far = ChannelSonar(receivers=(received_from((0, 8, 0)),), direct=True, absorption_db_per_m=0.25)
    arrivals = simulator(far, floor=cells_floor(half=2.0, cells=64.0)).paths(LEVEL).by("direct")
    assert abs(arrivals.amplitude[0]) == pytest.approx(10 ** (-0.25 * 8 / 20) / 8, rel=1e-5)


@pytest.mark.thorough
def test_a_line_weighs_the_echoes_of_a_plate_by_its_pattern() -> None:
    """Plates at several angles off the beam, side lobes with their sign included."""
    wide = ChannelSonar(receivers=(received_from(),), points_per_m2=1e5)
    line = FieldOfView.of_line(0.1, wide.wavelength_m, heading_deg=90, tilt_deg=60, along_deg=90)
    narrow = wide.replace(transmitter=FieldOfView(), receivers=(Hydrophone(name="one", field=line),))
    narrow = narrow.replace(transmitter=FieldOfView(shape="all"))
    for along in (0.0, 0.8, 1.5, 2.5, 3.3):
        built = [simulator(sonar, plate=plate((10, along, 3), (-10, -along, 7), half=0.005)) for sonar in (narrow, wide)]
        away = points(built[0]) - np.array(LEVEL[:3])
        expected = np.sinc(0.1 / wide.wavelength_m * away[:, 1] / np.linalg.norm(away, axis=1))
        ratio = built[0].paths(LEVEL).amplitude / built[1].paths(LEVEL).amplitude
        np.testing.assert_allclose(ratio, expected, atol=1e-4)
    gone = simulator(narrow, plate=plate((10, 5, 3), (-10, -5, 7), half=0.005)).paths(LEVEL)
    assert not len(gone.delay_s)  # beyond the second null
    with pytest.raises(MitsonarError, match="shape line"):
        narrow.replace(model="rays")


def test_a_box_leaves_the_points_inside_as_they_are() -> None:
    sonar = ChannelSonar(points_per_m2=50.0)
    every = points(simulator(sonar, ground=floor(diffuse(0.5), 12.0)))
    box = np.array([[-3.0, 2.0, -1.0], [4.0, 9.0, 1.0]])
    some = ChannelSimulator(scene(ground=floor(diffuse(0.5), 12.0)), sonar, within=box)
    inside = every[((every >= box[0]) & (every <= box[1])).all(axis=1)]
    assert {tuple(row) for row in points(some)} == {tuple(row) for row in inside}
    cells = ChannelSimulator(scene(ground=cells_floor(half=12.0, cells=64.0)), sonar, within=box)
    assert 0 < len(points(cells)) < 64**2 / 4
    with pytest.raises(MitsonarError, match="no surface within"):
        ChannelSimulator(scene(ground=floor(diffuse(0.5), 12.0)), sonar, within=box + 100)


def test_the_box_holds_all_that_is_seen() -> None:
    sonar = ChannelSonar(range_max=12.0, points_per_m2=30.0)
    poses = np.array([[0, 0, 8, 0, 0, 0], [1, 3, 8, 0.05, 0, 0.3]])
    whole = simulator(sonar, ground=floor(diffuse(0.5), 20.0))
    some = ChannelSimulator(scene(ground=floor(diffuse(0.5), 20.0)), sonar, within=sonar.box_seen_from(poses))
    assert len(points(some)) < len(points(whole)) / 2
    for one, other in zip(whole.pings(poses), some.pings(poses), strict=True):
        np.testing.assert_array_equal(one.echoes, other.echoes)
        assert np.abs(one.response - other.response).max() < 1e-6 * np.abs(one.response).max()
