"""Bounds of six degrees of freedom: derivatives against geometry, what cannot be observed, fans that add up, receivers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from crlb_command import command, floor_scene
from helpers import box, diffuse, floor, scene
from scipy import ndimage

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.errors import MitsonarError
from mitsonar.estimation.channel.likelihood import receiver_bands_of
from mitsonar.estimation.crlb.channel import PARAMETERS, channel_bound, channel_crlb, impulse_information
from mitsonar.estimation.crlb.image import Bound, SpeckleBounds, balanced_steps, bounds_at, cramer_rao_bound
from mitsonar.estimation.crlb.observability import ALL_MOUNTS, bounds_of_fans, observability
from mitsonar.geometry.ground import GroundGeometry
from mitsonar.instruments.hydrophones import ChannelSonar, Hydrophone
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import Sounder
from mitsonar.motion.composition import DEGREES, PLANAR, MotionStd
from mitsonar.motion.pose import Pose

if TYPE_CHECKING:
    from mitsonar.simulation.simulator import Simulator

LOW, NONE = NOISE_MODELS["low"], NOISE_MODELS["none"]
SIX = tuple(DEGREES)
SONAR = Sonar(beams=16, range_bins=64, rays_per_beam=200, rays_across=4, range_min=3.8, range_max=5.2)
POSE = Pose.from_degrees([0.3, -0.2, 2.5, 35, 0, 0])
VEHICLE = Pose.from_degrees([0.3, -0.2, 2.5, 0, 0, 0])
LEVEL, UPRIGHT = (0.0, 0.0, 0.0, 35.0, 0.0, 0.0), (0.0, 0.0, 0.0, 35.0, 90.0, 0.0)
NO_ERROR = np.zeros((6,) * 4)


def bitmap(values: np.ndarray) -> dict[str, Any]:
    import mitsuba as mi

    picture = mi.Bitmap(np.asarray(values, np.float32)[..., None])
    return {"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}


def blotches() -> dict[str, Any]:
    grain = ndimage.gaussian_filter(np.random.default_rng(5).random((400, 400)), 1.5, mode="wrap")
    return bitmap(np.clip(0.5 + (grain - 0.5) * 3, 0.02, 1))


def simulator(sonar: Sonar, **shapes: dict[str, Any]) -> Simulator:
    from mitsonar.simulation.simulator import Simulator

    return Simulator(scene(**shapes), sonar)


def gain_of(source: Simulator, peak: float = 0.7) -> float:
    return peak / float(next(source.pings([POSE])).levels.max())


# ---------------------------------------------------------------- derivatives


@pytest.mark.usefixtures("variant")
def test_a_ramp_moves_with_the_height_as_geometry_says() -> None:
    """Reflectivity c + k y: at a constant range a rise of the sonar moves the ground of a cell, whose level changes by k
    times that shift beside the change over an even floor."""
    from mitsonar.simulation.derivatives import differentiate

    half, sonar = 10.0, SONAR.replace(model="physical")
    place = (np.arange(256) + 0.5) / 256 * 2 * half - half
    ramp = np.repeat((0.5 + 0.04 * place)[:, None], 256, axis=1)
    source, even = (simulator(sonar, floor=floor(diffuse(texture), half)) for texture in (bitmap(ramp), 1.0))
    gain = gain_of(even, 0.3)
    (result,), (flat,) = (next(differentiate(one, POSE, gain, pings=10, degrees=("rise",))) for one in (source, even))
    by_rise, by_rise_even = (one.jacobian[..., 0, 0].mean(axis=0, dtype=float) for one in (result, flat))
    # cells of the same elevations above and below, whose number of rays does not change
    inner = np.zeros(flat.level.shape, dtype=bool)
    inner[8:-8] = (flat.filled == 1)[8:-8]
    forward = [
        GroundGeometry(sonar.range_m, sonar.bearing_rad, sonar.bearing, 2.5 + rise, POSE.pitch).points[..., 1]
        for rise in (0.01, -0.01)
    ]
    shift, ahead = (forward[0] - forward[1]) / 0.02, (forward[0] + forward[1]) / 2
    change = by_rise - (0.5 + 0.04 * (POSE.y + ahead)) * by_rise_even
    np.testing.assert_allclose(change[inner].sum(), (0.04 * shift * flat.level)[inner].sum(), rtol=0.02)


@pytest.mark.usefixtures("variant")
def test_the_same_sonar_on_a_vehicle_has_the_same_derivatives() -> None:
    """Two routes: the pose of the sonar, and that of a level vehicle with the sonar as its mount; and steps along others."""
    from mitsonar.simulation.derivatives import differentiate, steps_for

    source = simulator(SONAR, floor=floor(diffuse(blotches()), 10))
    gain = gain_of(source)
    (alone,) = next(differentiate(source, POSE, gain, pings=2, degrees=SIX))
    (carried,) = next(differentiate(source, VEHICLE, gain, pings=2, degrees=SIX, mount=Pose.from_degrees(LEVEL)))
    assert alone.jacobian.shape == (2, 64, 16, 2, 6)
    scale = np.abs(alone.jacobian).max(axis=(0, 1, 2, 3))
    assert (np.abs(alone.jacobian - carried.jacobian).mean(axis=(0, 1, 2, 3)) < 1e-3 * scale).all()
    (same,) = next(
        differentiate(source, POSE, gain, pings=2, degrees=SIX, basis=2 * np.eye(6), step=steps_for(SONAR, SIX) / 2)
    )
    np.testing.assert_allclose(same.jacobian, alone.jacobian, atol=1e-3 * float(scale.max()))


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_three_of_six_have_the_information_of_three() -> None:
    source = simulator(SONAR, floor=floor(diffuse(blotches()), 10))
    gain = gain_of(source)
    three, six = (
        next(bounds_at(source, [POSE], LOW, gain, pings=24, degrees=names))["image", "image", "pixel"]
        for names in (PLANAR, SIX)
    )
    assert three is not None
    assert six is not None
    chosen = [SIX.index(name) for name in PLANAR]
    scale = np.sqrt(np.diag(three.information))
    difference = (six.information[np.ix_(chosen, chosen)] - three.information) / np.outer(scale, scale)
    assert np.abs(difference).max() < 0.15, difference
    assert (six.std()[chosen] > three.std()).all()  # more unknowns
    np.testing.assert_array_equal(cramer_rao_bound(source, [POSE], LOW, gain, pings=24)[0], three.std(2))


# ---------------------------------------------------------------- what can be observed


@pytest.mark.usefixtures("variant")
def test_an_even_floor_shows_height_and_attitude_only() -> None:
    source = simulator(SONAR.replace(model="physical", range_min=3.0, range_max=6.0), floor=floor())
    bound = next(bounds_at(source, [POSE], LOW, gain_of(source), pings=8, degrees=SIX))["image", "image", "gaussian"]
    assert bound is not None
    shown = observability(bound, SIX)
    assert shown.observable == 3
    assert shown.unobservable == ("sideways", "forward", "yaw")
    assert not shown.undecided
    std = bound.std()
    assert np.isinf(std[[0, 1, 5]]).all()
    assert (std[[2, 3, 4]] < 0.01).all()


def test_directions_are_named_and_compared_with_the_largest() -> None:
    information = np.diag([1e8, 1e8, 1e8, 1e8, 1e8, 0.0])
    shown = observability(Bound(information, NO_ERROR), SIX)
    assert (shown.observable, shown.unobservable) == (5, ("yaw",))
    # sideways and yaw only ever together, at a range of 1.15 m, where both limits weigh as much
    sight = np.array([1.0, 0, 0, 0, 0, 1.15])
    information = np.diag([0, 1e8, 1e8, 1e8, 1e8, 0]) + 1e8 * np.outer(sight, sight)
    shown = observability(Bound(information, NO_ERROR), SIX, largest=MotionStd(0.1, 0.1 / 1.15))
    assert (shown.observable, shown.unobservable) == (5, ("sideways and yaw",))
    # known to 2 degrees: observable by a limit of 5 degrees, not by one of 1 degree; two frames double the variance
    information = np.diag([1e8, 1e8, 1e8, 1e8, 1e8, 1 / np.radians(2) ** 2])
    bound = Bound(information, NO_ERROR)
    assert observability(bound, SIX, frames=1).std[-1] == pytest.approx(2 / 5)
    assert observability(bound, SIX).std[-1] == pytest.approx(np.sqrt(2) * 2 / 5)
    assert observability(bound, SIX, largest=MotionStd(0.1, float(np.radians(1)))).unobservable == ("yaw",)
    for limits in ((0.0, 1.0), (1.0, np.nan), (np.inf, 1.0)):
        with pytest.raises(MitsonarError, match="above 0 and finite"):
            MotionStd(*limits)


def test_noisy_derivatives_leave_a_direction_undecided() -> None:
    """Information that its error may hide or make up: neither observable nor not."""
    reason = NO_ERROR.copy()
    for error, undecided in ((1e4, ("yaw",)), (1e-4, ())):
        reason[5, 5, 5, 5] = error**2
        shown = observability(Bound(np.diag([1e8, 1e8, 1e8, 1e8, 1e8, 1e-6]), reason), SIX)
        assert shown.undecided == undecided
        assert shown.unobservable == (() if undecided else ("yaw",))
        assert shown.observable == 5


def test_steps_are_balanced() -> None:
    """Directions that change a frame a hundred times less get steps a hundred times longer, up to the longest."""
    unit = np.array([SONAR.beam_width_rad * 4.5, SONAR.bin_m, SONAR.bin_m, *[SONAR.beam_width_rad] * 3])
    sizes = np.array([1.0, 1.0, 1.0, 1.0, 1 / 4, 1e-8])
    basis, step = balanced_steps(Bound(np.diag(sizes / unit**2), NO_ERROR), SONAR, SIX)
    longest = np.sort((np.abs(basis) * step).max(axis=1) / unit)
    np.testing.assert_allclose(longest, [1 / 16] * 4 + [1 / 8, 1 / 4], rtol=1e-6)


# ---------------------------------------------------------------- instruments of several fans


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_information_of_fans_adds_up() -> None:
    fan = SONAR.replace(model="physical", beams=8, rays_per_beam=100)
    source = simulator(fan, floor=floor(diffuse(blotches()), 10), block=box([1.4, 3.9, 0.1], [0.2, 0.1, 0.2], diffuse(0.6)))
    gain = gain_of(source)
    crossed = Sounder(kind="range-image", fan=fan, mounts={"level": LEVEL, "upright": UPRIGHT})
    sums = next(bounds_of_fans(source, crossed, [VEHICLE], LOW, gain, pings=4))
    whole, *parts = (sums[name, "image", "gaussian"] for name in (ALL_MOUNTS, "level", "upright"))
    alone = next(bounds_at(source, [POSE], LOW, gain, pings=4, degrees=SIX))["image", "image", "gaussian"]
    assert whole is not None
    assert alone is not None
    assert parts[0] is not None
    np.testing.assert_array_equal(whole.information, sum(one.information for one in parts if one is not None))
    np.testing.assert_allclose(parts[0].std(), alone.std(), rtol=0.1)
    assert (whole.std() <= parts[0].std()).all()
    # rows of one mount are one instrument: a 3-D sonar
    rows = Sounder(kind="range-image", fan=fan.replace(elevation_fov_deg=7.0), mounts={"ahead": LEVEL}, rows=2)
    stack = next(bounds_of_fans(source, rows, [VEHICLE], LOW, gain, pings=4))
    assert {key[0] for key in stack} == {"ahead"}
    each = []
    for row in rows.mount_poses.tolist():
        bounds = next(bounds_at(source, [VEHICLE], LOW, gain, pings=4, degrees=SIX, mount=Pose.from_row(row)))
        each.append(bounds["image", "image", "gaussian"].information)  # type: ignore[union-attr]
    total = np.sum(each, axis=0)
    np.testing.assert_allclose(stack["ahead", "image", "gaussian"].information, total)  # type: ignore[union-attr]


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_speckle_has_bounds_of_six_degrees() -> None:
    sonar = Sonar.create(model="coherent", frequency_hz=1.8e6, beams=12, azimuth_fov_deg=3.6, beam_width_deg=0.3,
                         range_min=4.0, range_max=4.25, range_bins=48, bearing="cone", noise_level_db=-75)  # fmt: skip
    source = simulator(sonar, floor=floor(diffuse(blotches()), 10))
    three, six = (SpeckleBounds(source, 1.0, names) for names in (PLANAR, SIX))
    pose = np.array(POSE, dtype=float)
    chosen = [SIX.index(name) for name in PLANAR]
    grain = [bounds.grain(pose, 1).bound() for bounds in (three, six)]
    assert (np.diag(grain[1].information)[chosen] / np.diag(grain[0].information) > 0.7).all()
    assert (np.diag(grain[1].information)[chosen] / np.diag(grain[0].information) < 1.4).all()
    ground = six.ground(pose, 2).bound()
    assert ground.information.shape == (6, 6)
    assert (np.diag(ground.information) < np.diag(grain[1].information)).all()
    carried = SpeckleBounds(source, 1.0, SIX, Pose.from_degrees(LEVEL)).grain(np.array(VEHICLE, dtype=float), 1).bound()
    np.testing.assert_allclose(np.diag(carried.information), np.diag(grain[1].information), rtol=0.02)
    fans = Sounder(kind="range-image", fan=sonar, mounts={"ahead": LEVEL})
    sums = next(bounds_of_fans(source, fans, [VEHICLE], NONE, 1.0, pings=1))
    assert set(sums) == {("ahead", "image", "grain"), ("ahead", "image", "ground")}
    with pytest.raises(MitsonarError, match="its own noise"):
        next(bounds_of_fans(source, fans, [VEHICLE], LOW, 1.0))


# ---------------------------------------------------------------- impulse responses

CHANNEL, HEIGHT = ChannelSonar(), 10.0


@pytest.mark.thorough
def test_pitch_and_roll_of_receivers_a_quarter_turn_apart() -> None:
    """Turned by 90 deg the motion changes its axes, and pitch and roll change places."""
    one, two = (
        channel_bound(CHANNEL, HEIGHT, motion, snr_db=20.0) for motion in ([0.01, 0, 0, 0, 0, 0], [0, 0.01, 0, 0, 0, 0])
    )
    assert np.isfinite(one.std()).all()
    np.testing.assert_allclose(one.std()[[0, 1, 2, 3, 4, 5]], two.std()[[1, 0, 2, 4, 3, 5]], rtol=1e-3)


@pytest.mark.thorough
def test_named_degrees_are_the_parameters_of_the_information() -> None:
    motion = [0.01, 0.02, 0.001, 0.0, 0.0, 0.0005]
    named = channel_bound(CHANNEL, HEIGHT, motion, ("yaw", "sideways"), snr_db=20.0)
    information = impulse_information(CHANNEL, HEIGHT, [0.01, 0.02, 0.0005, 0.001], snr_db=20.0, free=(2, 0))
    np.testing.assert_array_equal(named.information, information)
    np.testing.assert_allclose(
        named.std(), channel_crlb(CHANNEL, HEIGHT, [0.01, 0.02, 0.0005, 0.001], snr_db=20.0, free=(2, 0))
    )
    assert set(PARAMETERS) == set(DEGREES)


def test_a_small_pitch_lifts_a_receiver_on_a_long_lever_only() -> None:
    """Delays after a turn by an angle: those of a receiver that is moved by the turn itself, in level axes."""
    from mitsonar.estimation.channel.covariance import link_response

    angle, points = 0.01, np.array([[0.3, 5.0], [-1.0, 4.0]])
    ahead = Hydrophone(name="ahead", position=(0.0, 1.0, 0.0), field=CHANNEL.receivers[0].field)
    sonar = CHANNEL.replace(receivers=(ahead.model_dump(),))
    tilted = link_response(sonar, ahead, HEIGHT, points, (0, 0, 0), (0, 0), (angle, 0.0))
    moved = np.array([0.0, np.cos(angle), -np.sin(angle)])  # nose down
    ground = np.column_stack([points, np.full(2, -HEIGHT)])
    expected = (np.linalg.norm(ground, axis=1) + np.linalg.norm(ground - moved, axis=1)) / sonar.sound_speed
    np.testing.assert_allclose(tilted.delay, expected, rtol=1e-12)
    # looking further down is a receiver whose field is tilted less from straight down
    field = ahead.field.model_copy(update={"tilt_deg": ahead.field.tilt_deg - np.degrees(angle)})
    other = Hydrophone(name="ahead", position=tuple(moved), field=field)
    level = link_response(CHANNEL.replace(receivers=(other.model_dump(),)), other, HEIGHT, points, (0, 0, 0), (0, 0))
    np.testing.assert_allclose(tilted.amplitude, level.amplitude, rtol=1e-9)


@pytest.mark.thorough
def test_scores_of_drawn_responses_have_the_information_of_pitch_and_roll() -> None:
    """Monte Carlo: responses drawn by the covariance of two pings; their scores covary as the information says."""
    from mitsonar.estimation.channel.covariance import block_toeplitz

    names = ("forward", "rise", "pitch", "roll")
    single = CHANNEL.replace(receivers=(CHANNEL.receivers[0].model_dump(),))
    (band,) = receiver_bands_of(single, HEIGHT, 0.05, 0.006)
    law = band.law
    motion = np.array([0.0, 0.005, 0.0, 0.0, 0.0, 0.0])

    def covariance(at: np.ndarray) -> np.ndarray:
        return block_toeplitz([law.covariance(at, lag) for lag in range(2)])

    noise = 0.01 * float(np.diag(covariance(motion)).real.mean())
    local = covariance(motion) + noise * np.eye(len(covariance(motion)))
    inverse, slopes = np.linalg.inv(local), []
    for name in names:
        step = 2e-4 * np.eye(6)[PARAMETERS.index(name)]
        slopes.append((covariance(motion + step) - covariance(motion - step)) / 4e-4)
    rng, root = np.random.default_rng(1), np.linalg.cholesky(local)
    white = (rng.normal(size=(12_000, len(local))) + 1j * rng.normal(size=(12_000, len(local)))) / np.sqrt(2)
    whitened = white @ root.T @ inverse.T
    scores = np.stack([np.einsum("ni,ij,nj->n", whitened.conj(), one, whitened).real for one in slopes])
    bound = channel_bound(single, HEIGHT, [0, 0.005, 0, 0, 0, 0], names, snr_db=20.0).information
    scale = np.sqrt(np.diag(bound))
    np.testing.assert_allclose(np.cov(scores) / np.outer(scale, scale), bound / np.outer(scale, scale), atol=0.1)


# ---------------------------------------------------------------- the command


FANS = """kind: range-image
mounts: {level: [0, 0, 0, 35, 0, 0], upright: [0, 0, 0, 35, 90, 0]}
model: physical
beams: 8
azimuth_fov_deg: 20
range_min: 3.2
range_max: 5.6
range_bins: 32
"""


@pytest.mark.thorough
@pytest.mark.usefixtures("variant")
def test_the_command_names_what_cannot_be_observed(tmp_path: Path) -> None:
    path, fans, picture = tmp_path / "floor.xml", tmp_path / "fans.yaml", tmp_path / "six.png"
    path.write_text(floor_scene())
    fans.write_text(FANS)
    code, text = command(path, "--degrees", 6, "--noise", "low", "--model", "physical", "--pings", 4, "--plot", picture)
    assert code == 0, text
    assert "sideways / forward / rise / pitch / roll / yaw" in text
    assert "one frame: mm / mm / mm / deg / deg / deg" in text
    assert "3 of 6 directions observable; not sideways, forward, yaw" in text
    assert picture.stat().st_size > 10_000
    place = ("--instrument", fans, "--from", "0,0,2.5,0,0,0", "--noise", "low", "--pings", 2)
    code, text = command(path, *place, "--degrees", "rise,pitch", "--json")
    assert code == 0, text
    report = json.loads(text[text.index("{") : text.rindex("}") + 1])
    assert report["units"] == ["rise mm", "pitch deg"]
    assert {row["portion"] for row in report["rows"]} == {ALL_MOUNTS, "level", "upright"}
    assert all(len(row["observable_each"]) == 1 for row in report["rows"])
    for words, output in (
        (["--degrees", "5"], "give 3, 6 or names"),
        (["--largest", "0.1"], "takes 2 numbers"),
        (["--largest", "0,5"], "above 0"),
        ([*place, "--sonar", "didson300"], "--instrument excludes"),
        (["--instrument", fans, "--noise", "low"], "gives no pose"),
    ):
        code, text = command(path, *words)
        assert code == 2, text
        assert output in text, text
