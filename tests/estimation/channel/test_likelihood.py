"""Motion from impulse responses: the law against scatterers, estimators against known motions, limits, bad input."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from helpers import diffuse, floor, scene
from numpy.typing import NDArray
from points import PointGround, run
from threadpoolctl import threadpool_info, threadpool_limits

from mitsonar.errors import MitsonarError
from mitsonar.estimation.channel.correlation import Pings, bands_of, pings_of
from mitsonar.estimation.channel.covariance import ResponseCovariance, block_toeplitz, link_response
from mitsonar.estimation.channel.likelihood import Likelihood, judged, receiver_bands_of
from mitsonar.estimation.crlb.channel import channel_crlb, impulse_information
from mitsonar.estimation.named import create_estimator
from mitsonar.instruments.hydrophones import ChannelSonar, four_receivers
from mitsonar.motion.composition import Motion, compose
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.records.responses import ImpulseResponses
from mitsonar.simulation.channel import ChannelSimulator, impulse_response

HEIGHT = 4.0
SONAR = ChannelSonar.create(range_max=10.0, frequency_step_hz=20.0, receivers=four_receivers(across_deg=6.0))
"""Low over the ground: fewer points, and motions that are unlike at larger angles."""

SPEED = 0.8
"""The fastest that estimators look for here [m/s]: a small box is quickly prepared."""

BOTH = ["correlation", pytest.param("likelihood", marks=pytest.mark.slow)]
"""The law of a receiver and height takes seconds to prepare."""

OPTIONS: dict[str, dict[str, float]] = {"zero": {}, "correlation": {"speed": SPEED}, "likelihood": {"speed": SPEED}}

MOTIONS = (Motion(0.010, -0.004, 0.0), Motion(-0.021, 0.013, 0.0), Motion(0.004, 0.030, 0.0))


@lru_cache(maxsize=32)
def pair(motion: Motion, pings: int = 2, seed: int = 0, noise: float = 0.0) -> ImpulseResponses:
    """Pings over a ground of points."""
    ground = PointGround(seed, half_m=6.0)
    return run(SONAR, ground, motion, pings=pings, height_m=HEIGHT, noise=noise, seed=seed)


def simulator_over(half_m: float, seed: int) -> ChannelSimulator:
    """The simulator over cells of 24 mm, reflectivity 0..1: its points are the law's unknown scatterers."""
    texture = {"type": "cell_noise", "cells": round(2 * half_m / 0.0244), "seed": seed}
    return ChannelSimulator(scene(floor=floor(diffuse(texture), half_m)), SONAR)


def simulated(motion: Motion, seed: int) -> ImpulseResponses:
    """Two pings of the simulator."""
    start = Pose(0.0, 0.0, HEIGHT)
    flown = Trajectory(np.array([start, compose(start, motion)]), np.array([0.0, 0.05]))
    return simulator_over(6.0, seed).responses(flown, velocities(flown))


# ---------------------------------------------------------------- the law


def test_delay_of_a_resting_and_of_a_moving_receiver() -> None:
    """At rest the sum of both ways; moving, it meets its own equation to a rounding error."""
    receiver, points = SONAR.receivers[3], np.array([[3.0, 0.4], [1.0, -0.2]])
    there, back = np.hypot(np.hypot(*points.T), HEIGHT), np.hypot(np.hypot(points[:, 0] - 0.1, points[:, 1]), HEIGHT)
    rest = link_response(SONAR, receiver, HEIGHT, points, (0, 0, 0), (0, 0)).delay
    np.testing.assert_allclose(rest, (there + back) / 1500.0, rtol=1e-14)
    moving = link_response(SONAR, receiver, HEIGHT, points, (0, 0, 0), (2.0, -1.0)).delay
    place = np.array([0.1, 0.0]) + moving[:, None] * [2.0, -1.0]
    met = (there + np.hypot(np.hypot(*(points - place).T), HEIGHT)) / 1500.0
    np.testing.assert_allclose(moving, met, rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("source", ["points", "simulator"])
@pytest.mark.usefixtures("variant")
def test_covariance_of_scatterers_drawn_at_random(source: str) -> None:
    """Products of taps over 12 grounds against the law, by a z-test of their weighted sum: of points written down in NumPy,
    and of the simulator's own."""
    motion, law = Motion(0.012, 0.03, 0.0), ResponseCovariance(SONAR, SONAR.receivers[0], HEIGHT, 0.05)
    local, shared = (law.covariance(motion, lag) for lag in (0, 1))
    grounds = [simulated(motion, seed) if source == "simulator" else pair(motion, seed=seed) for seed in range(12)]
    z = np.array([ground.response[:, 0, law.taps] for ground in grounds])
    # a sum of products that the law says is real, and as large as its energy times the mean strength of 1/2
    message = np.einsum("nk,kl,nl->n", z[:, 0], shared.conj(), z[:, 1].conj()) / (np.abs(shared) ** 2).sum() / 0.5
    error = np.std(message.real, ddof=1) / np.sqrt(len(message))
    assert abs(message.real.mean() - 1) < 3.5 * error, f"{message.real.mean():.3f} +- {error:.3f}"
    assert abs(message.imag.mean()) < 3.5 * np.std(message.imag, ddof=1) / np.sqrt(len(message))
    energy = (np.abs(z) ** 2).mean(axis=(0, 1)).sum() / (0.5 * np.diag(local).real.sum())
    assert abs(energy - 1) < 0.25, f"energy {energy:.3f} of the law's"


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_energy_at_every_delay_is_that_of_the_simulator() -> None:
    """Fifths of the taps within 0.3 dB of the law's, four receivers at 300 poses over cells; near nadir and aside."""
    law = ResponseCovariance(SONAR, SONAR.receivers[0], HEIGHT, 0.05)  # of all receivers, in their own axes
    rng, poses = np.random.default_rng(1), np.zeros((300, 6))
    poses[:, :2], poses[:, 2], poses[:, 5] = rng.uniform(-7, 7, (300, 2)), HEIGHT, rng.uniform(0, 6, 300)
    received = np.concatenate([part.response for part in simulator_over(12.0, 7).pings(poses)])[:, :, law.taps]
    result: NDArray[np.float64] = (np.abs(received) ** 2).mean(axis=(0, 1))
    message = 0.5 * np.diag(law.covariance(Motion(0.0, 0.0, 0.0), 0)).real
    pairs = zip(*(np.array_split(power, 5) for power in (result, message)), strict=True)
    fifths = [10 * np.log10(of_simulator.sum() / of_law.sum()) for of_simulator, of_law in pairs]
    assert np.abs(fifths).max() < 0.3, f"{np.round(fifths, 2)} dB"


def test_covariance_is_that_of_one_ground() -> None:
    """Hermitian, and together with the other ping's positive; the other way round it is the adjoint."""
    law = ResponseCovariance(SONAR, SONAR.receivers[1], HEIGHT, 0.05)
    local, shared = (law.covariance((0.02, 0.01, 0.004), lag) for lag in (0, 1))
    size = np.linalg.eigvalsh(block_toeplitz([local, shared]))
    np.testing.assert_allclose(local, local.conj().T, atol=1e-12 * abs(local).max())
    assert size.min() > -1e-4 * size.max()


def test_slopes_are_those_of_differences() -> None:
    """Within the part of the carrier that the band is: pulses are held still."""
    law, motion = ResponseCovariance(SONAR, SONAR.receivers[0], HEIGHT, 0.05), np.array([0.02, -0.01, 0.002, 0.001])
    slopes = law.slopes(motion, 1, (0, 1, 2, 3))
    np.testing.assert_allclose(slopes[0], law.covariance(motion), atol=1e-9 * abs(slopes[0]).max())
    for number in range(4):
        step = 1e-4 * np.eye(4)[number]
        by_difference = (law.covariance(motion + step) - law.covariance(motion - step)) / 2e-4
        error = np.linalg.norm(slopes[1 + number] - by_difference) / np.linalg.norm(by_difference)
        assert error < (0.05 if number != 2 else 0.2), f"number {number}: {error:.3f}"


@pytest.mark.thorough
def test_law_is_the_same_for_receivers_of_one_kind() -> None:
    """What is computed for a look forward serves the other three, turned."""
    motion = np.array([0.02, -0.012, 0.0, 0.0])
    for receiver_band, receiver in zip(receiver_bands_of(SONAR, HEIGHT, 0.05, 0.1), SONAR.receivers, strict=True):
        local = ResponseCovariance(SONAR, receiver, HEIGHT, 0.05, 0.1)
        expected, got = local.covariance(motion), receiver_band.law.covariance(receiver_band.turn @ motion)
        np.testing.assert_allclose(got, expected, atol=1e-4 * abs(expected).max())


def test_gradient_is_the_slope_of_the_likelihood() -> None:
    receiver_band = receiver_bands_of(SONAR, HEIGHT, 0.05, 0.1)[3]
    z = pair(MOTIONS[0], noise=2e-4).response[:, 3, receiver_band.law.taps].astype(complex)
    at = np.array([MOTIONS[0].sideways + 2e-4, MOTIONS[0].forward - 1e-4, 0.0, 0.0])
    message = judged(receiver_band, z, at, (0, 1), 1)
    for number in (0, 1):
        step = 2e-5 * np.eye(4)[number]
        high, low = (judged(receiver_band, z, at + sign * step, (), 1).likelihood for sign in (1, -1))
        size = np.sqrt(message.information[number, number])
        assert abs((high - low) / 4e-5 - message.gradient[number]) < 0.1 * size + 0.1 * abs(message.gradient[number])


# ---------------------------------------------------------------- known motions


@pytest.mark.parametrize(
    ("name", "bound_mm"), [("correlation", 2.0), pytest.param("likelihood", 0.5, marks=pytest.mark.slow)]
)
def test_known_motions_come_back(name: str, bound_mm: float) -> None:
    estimator = create_estimator(name, **OPTIONS[name])
    answers = [estimator.estimate(pair(motion, seed=seed)) for seed, motion in enumerate(MOTIONS)]
    error = 1e3 * (np.array([answer.motion for answer in answers]) - np.array(MOTIONS))
    assert all(answer.valid for answer in answers), [answer.reason for answer in answers]
    assert np.abs(error[:, :2]).max() < bound_mm, error
    got, true = np.array([answer.motion for answer in answers])[:, :2], np.array(MOTIONS)[:, :2]
    assert abs((got * true).sum() / (true**2).sum() - 1) < 0.05


@pytest.mark.slow
def test_likelihood_is_nearer_than_correlation_over_many_grounds() -> None:
    """On one ground either may be; over twelve the default's errors are the smaller ones, and as large as it says."""
    motion = Motion(0.0056, 0.0028, 0.0)
    answers = {
        name: [create_estimator(name, **OPTIONS[name]).estimate(pair(motion, seed=200 + seed)) for seed in range(12)]
        for name in ("likelihood", "correlation")
    }
    errors = {name: np.array([one.motion for one in result])[:, :2] - motion[:2] for name, result in answers.items()}
    rmse = {name: 1e3 * np.sqrt((error**2).sum(axis=1).mean()) for name, error in errors.items()}
    assert rmse["likelihood"] < 0.9 * rmse["correlation"], rmse
    laws = [np.asarray(one.covariance)[:2, :2] for one in answers["likelihood"]]
    nees = [error @ np.linalg.solve(law, error) / 2 for error, law in zip(errors["likelihood"], laws, strict=True)]
    assert 0.3 < np.mean(nees) < 2.5, np.round(nees, 2)


def test_linear_algebra_of_the_likelihood_uses_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """With two, which wait for each other, a pair took 11 to 52 s of processor time, not 1.3 s."""
    threads: list[int] = []

    def counted(responses: ImpulseResponses) -> Pings:
        threads.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        return pings_of(responses)

    monkeypatch.setattr("mitsonar.estimation.channel.likelihood.pings_of", counted)
    quiet = replace(pair(MOTIONS[0]), response=np.zeros_like(pair(MOTIONS[0]).response))
    with threadpool_limits(2, "blas"):
        assert not Likelihood().estimate(quiet).valid
    assert set(threads) == {1}


@pytest.mark.parametrize("name", BOTH)
def test_many_pings(name: str) -> None:
    motion = Motion(0.05, -0.07, 0.0)
    answer = create_estimator(name, speed=1.6).estimate(pair(motion, pings=6, seed=3))
    error = 1e3 * (np.array(answer.motion) - motion)[:2]
    assert answer.valid, answer.reason
    assert np.abs(error).max() < 2.0, error


@pytest.mark.thorough
def test_covariance_tells_how_far_off() -> None:
    answer = Likelihood(speed=SPEED).estimate(pair(MOTIONS[1], seed=1, noise=1e-4))
    error = (np.array(answer.motion) - MOTIONS[1])[:2]
    assert answer.covariance is not None
    assert error @ np.linalg.solve(answer.covariance[:2, :2], error) < 20


@pytest.mark.parametrize("name", BOTH)
def test_two_grounds_have_nothing_in_common(name: str) -> None:
    """The leak test: pings of different scenes tell nothing, and the estimators say so."""
    first, second = pair(MOTIONS[0], seed=0), pair(MOTIONS[0], seed=1)
    mixed = replace(first, response=np.array([first.response[0], second.response[1]]))
    answer = create_estimator(name, **OPTIONS[name]).estimate(mixed)
    assert not answer.valid
    assert answer.reason


# ---------------------------------------------------------------- the limit


def test_limit_falls_with_noise_and_grows_with_what_is_unknown() -> None:
    motion = (0.02, 0.01, 0.0)
    quiet, loud = (channel_crlb(SONAR, HEIGHT, motion, snr_db=snr) for snr in (40.0, 10.0))
    assert (quiet < loud).all()
    message = impulse_information(SONAR, HEIGHT, motion, free=(0, 1, 2))
    two = impulse_information(SONAR, HEIGHT, motion, free=(0, 1))
    np.testing.assert_allclose(message[:2, :2], two, rtol=1e-6)
    assert (np.linalg.inv(message)[[0, 1], [0, 1]] >= np.linalg.inv(two)[[0, 1], [0, 1]] * (1 - 1e-9)).all()


def test_limit_is_the_same_forward_and_sideways() -> None:
    """Four receivers, a quarter turn apart."""
    one, two = channel_crlb(SONAR, HEIGHT, (0.03, 0.01, 0.0)), channel_crlb(SONAR, HEIGHT, (-0.01, 0.03, 0.0))
    np.testing.assert_allclose(one, two[::-1], rtol=1e-6)


@pytest.mark.thorough
def test_turns_show_where_receivers_sit_beside_their_look() -> None:
    """On a lever across the look a turn moves the receiver along it; on a lever along the look it hardly shows."""
    turned = [(0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (-0.3, 0.0, 0.0), (0.0, -0.3, 0.0)]
    neighbours = [one.model_copy(update={"position": at}) for one, at in zip(SONAR.receivers, turned, strict=True)]
    motion = (0.01, 0.005, 0.0)
    along, across = (
        channel_crlb(
            SONAR.replace(receivers=tuple(one.model_dump() for one in receiver_bands)), HEIGHT, motion, free=(0, 1, 2)
        )[2]
        for receiver_bands in (SONAR.receivers, neighbours)
    )
    assert across < along / 3, np.degrees([across, along])


@pytest.mark.slow
def test_likelihood_reaches_its_limit() -> None:
    """Motions that are not ambiguous: normalised errors of 24 pairs about 1."""
    rng, normalised = np.random.default_rng(0), []
    for seed in range(24):
        sideways, forward = rng.uniform(-0.02, 0.02, 2).tolist()
        motion = Motion(sideways, forward, 0.0)
        answer = Likelihood(speed=SPEED).estimate(pair(motion, seed=100 + seed, noise=1e-4))
        error = (np.array(answer.motion) - motion)[:2]
        assert answer.covariance is not None
        normalised.append(error @ np.linalg.solve(answer.covariance[:2, :2], error) / 2)
    assert 0.5 < np.median(normalised) / np.log(2) < 3, np.round(normalised, 2)


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize("name", ["zero", "correlation", "likelihood"])
def test_bad_responses_are_refused(name: str) -> None:
    estimator, good = create_estimator(name, **OPTIONS[name]), pair(MOTIONS[0])
    with pytest.raises(MitsonarError, match="two pings or more: got 1"):
        estimator.estimate(good.select(slice(0, 1)))
    broken = good.response.copy()
    broken[1, 2, 5] = np.nan
    with pytest.raises(MitsonarError, match="nan or inf"):
        estimator.estimate(replace(good, response=broken))
    with pytest.raises(MitsonarError, match="evenly spaced"):
        estimator.estimate(replace(good, time_s=np.array([0.0, 0.0])))


@pytest.mark.parametrize("name", BOTH)
def test_height_is_needed(name: str) -> None:
    unknown = replace(pair(MOTIONS[0]), height_m=None)
    with pytest.raises(MitsonarError, match="height_m"):
        create_estimator(name, **OPTIONS[name]).estimate(unknown)
    with pytest.raises(MitsonarError, match="height_m must be above 0"):
        create_estimator(name, height_m=-1.0).estimate(unknown)
    given = create_estimator(name, height_m=HEIGHT, speed=SPEED).estimate(unknown)
    assert np.abs(np.array(given.motion) - MOTIONS[0]).max() < 2e-3


@pytest.mark.parametrize("name", BOTH)
def test_silent_receivers_are_left_out(name: str) -> None:
    good = pair(MOTIONS[0])
    one_quiet, all_quiet = good.response.copy(), np.zeros_like(good.response)
    one_quiet[:, 1] = 0
    answer = create_estimator(name, **OPTIONS[name]).estimate(replace(good, response=one_quiet))
    assert np.abs(np.array(answer.motion) - MOTIONS[0]).max() < 3e-3
    nothing = create_estimator(name, **OPTIONS[name]).estimate(replace(good, response=all_quiet))
    assert not nothing.valid
    assert "no receiver" in nothing.reason


@pytest.mark.parametrize("name", BOTH)
def test_two_receivers_are_enough(name: str) -> None:
    good = pair(MOTIONS[0])
    fewer = SONAR.replace(receivers=(SONAR.receivers[0], SONAR.receivers[3]))
    answer = create_estimator(name, **OPTIONS[name]).estimate(replace(good, response=good.response[:, [0, 3]], sonar=fewer))
    assert np.abs(np.array(answer.motion) - MOTIONS[0]).max() < 3e-3


@pytest.mark.parametrize("name", ["correlation", "likelihood"])
def test_pings_too_far_apart_are_refused_at_once(name: str) -> None:
    """Motions of hundreds of wavelengths would take minutes and gigabytes."""
    good = pair(MOTIONS[0])
    with pytest.raises(MitsonarError, match=r"10 s apart at up to 2\.1 m/s .*:speed="):
        create_estimator(name).estimate(replace(good, time_s=good.time_s[0] + np.array([0.0, 10.0])))


@pytest.mark.thorough
def test_parts_of_a_band_hold_all_of_it_and_tell_independently() -> None:
    """Echoes in each part of the whole's response are those that the part would hear; two parts have nothing in common."""
    wide = SONAR.replace(bandwidth_hz=9600.0, sampling_hz=16000.0)
    parts = bands_of(wide)
    assert [part.sonar.bandwidth_hz for part in parts] == [4800.0] * 2
    assert [part.sonar.carrier_hz for part in parts] == [76400.0, 83600.0]
    assert bands_of(SONAR)[0].sonar == SONAR.replace()
    delay = np.array([0.0061, 0.0093])
    whole = impulse_response(delay, [1.0, 0.5], wide)
    for part in parts:
        expected = impulse_response(delay, [1.0, 0.5], part.sonar)
        np.testing.assert_allclose(part.part_of(whole)[100:], expected[100:], atol=2e-3 * np.abs(expected).max())
    ground = [PointGround(seed, half_m=6.0) for seed in range(8)]
    received = np.array([run(wide, one, MOTIONS[0], pings=2, height_m=HEIGHT).response[0, 0] for one in ground])
    low, high = (part.part_of(received)[:, 45:90] for part in parts[:2])
    likeness = np.abs((low * high.conj()).sum(axis=0)) / np.sqrt((np.abs(low) ** 2).sum(0) * (np.abs(high) ** 2).sum(0))
    assert np.mean(likeness**2) < 2 / len(ground)


def test_unknown_names_and_options_are_refused() -> None:
    with pytest.raises(MitsonarError, match="unknown estimator"):
        create_estimator("likelyhood")
    with pytest.raises(MitsonarError, match="likelihood"):
        create_estimator("likelihood", hight_m=1.0)
    assert create_estimator("likelihood:yaw=1:speed=0.5") == Likelihood(yaw=True, speed=0.5)
    with pytest.raises(MitsonarError, match="unknown option 'hight_m': correlation takes height_m, speed"):
        create_estimator("correlation:hight_m=3")
    with pytest.raises(MitsonarError, match="speed must be a number"):
        create_estimator("likelihood:speed=fast")
