"""The coherent model: energy, speckle, correlation under motion, point spread, losses, noise; closed forms and integrals."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import pytest
from coherent_scenes import BOXES, HEIGHT, PITCH, POSE, SONAR, imager
from helpers import Array, diffuse, essence, floor, scene, sphere
from numpy.typing import NDArray
from scipy import stats

from mitsonar.acoustics.noise import NOISE_MODELS
from mitsonar.acoustics.speckle import contrast
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.instruments.beams import Pulse, series, shaded_sinc
from mitsonar.instruments.sonar import Sonar, group_of_beams
from mitsonar.motion.pose import Pose, to_world_matrices
from mitsonar.simulation import beams, receiver_noise
from mitsonar.simulation.receiver_noise import TAPS, EchoTail, ReceiverNoise
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator
from mitsonar.worlds.families import RockyField

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.models.coherent import CoherentImager

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

Shape: TypeAlias = Callable[[Array], Array]


@pytest.fixture(scope="module")
def flat(variant: str) -> mi.Scene:
    return scene(floor=floor(diffuse(0.5)))


def crosstalk(sonar: Sonar) -> NDArray[np.complex64]:
    """Amplitudes between beams ``(from, to)`` of a sonar that has crosstalk."""
    gains = receiver_noise.crosstalk(sonar)
    assert gains is not None
    return gains


def images(source: CoherentImager, count: int, apart: float = 0.7) -> Array:
    """Complex images of places far apart: speckle of each is its own ``(count, bins, beams)``."""
    shifts = np.arange(count)[:, None] * np.array([apart, 0.31 * apart, 0, 0, 0, 0])
    return np.stack([source.image(POSE + shift, 0)[0] for shift in shifts])


def expected(sonar: Sonar, reflectivity: float = 0.5) -> Array:
    """Level of each bin of a floor ``(bins,)``: C cos dOmega / R^2 for a box as wide as the beam, on the axis.

    On a cone of bearing b at height h: sin(grazing) = h / R, and dOmega = width dR h / R^2 / |d elevation's cosine|.
    """
    r = sonar.range_m
    grazing = HEIGHT / r
    area = r * sonar.beam_width_rad * sonar.bin_m / np.sqrt(1 - grazing**2)
    return np.asarray(reflectivity * grazing**2 * area / r**4)


# ---------------------------------------------------------------- energy and statistics


def test_energy_is_that_of_the_physical_model(flat: mi.Scene) -> None:
    """16 places: 0.1 dB."""
    result = np.abs(images(imager(flat), 16)) ** 2
    truth = next(iter(Simulator(flat, BOXES).pings(POSE))).levels[0]
    assert 10 * np.log10(result.sum(axis=(1, 2)).mean() / truth.sum()) == pytest.approx(0, abs=0.1)
    middle = result[:, :, 20:28].mean(axis=(0, 2)).reshape(-1, 16).mean(axis=1)
    target = expected(SONAR).reshape(-1, 16).mean(axis=1)
    assert np.abs(10 * np.log10(middle / target)).max() < 0.6  # of some 500 independent cells each: 0.2 dB


def test_speckle_is_exponential(flat: mi.Scene) -> None:
    """Complex Gaussian: contrast 1, skewness 2, and Kolmogorov and Smirnov's test of thinned pixels."""
    result = np.abs(images(imager(flat), 12)) ** 2 / expected(SONAR)[:, None]
    assert result.std() / result.mean() == pytest.approx(1, abs=0.03)
    assert stats.skew(result.ravel()) == pytest.approx(2, abs=0.25)
    thinned = result[:, ::4, ::4].ravel()
    assert len(thinned) > 5000
    assert stats.kstest(thinned / thinned.mean(), "expon").pvalue > 0.01


@pytest.mark.thorough
@pytest.mark.parametrize("nu", essence([1.0, 4.0], 1.0))
def test_patches_make_speckle_heavier(flat: mi.Scene, nu: float) -> None:
    source = imager(flat, SONAR.replace(speckle_nu=nu, speckle_patch_m=0.15))
    result = np.abs(images(source, 40, apart=1.3)) ** 2 / expected(SONAR)[:, None]
    assert result.std() / result.mean() == pytest.approx(contrast(nu), rel=0.1)
    assert result.mean() == pytest.approx(1, abs=0.12)


@pytest.mark.thorough
def test_patches_go_softly_over_into_one_another(flat: mi.Scene) -> None:
    """Covariance of intensities beyond the speckle: 1 / nu times that of tents of unit patches, the cubic B-spline.

    At half a patch, one, one and a half and two patches, along the range over the floor: 0.72, 0.25, 0.03, 0.
    """
    nu, side = 1.0, 0.15
    built = np.abs(images(imager(flat, SONAR.replace(speckle_nu=nu, speckle_patch_m=side)), 40, apart=1.3)) ** 2
    built = built / expected(SONAR)[:, None] - 1
    ahead = np.sqrt(SONAR.range_m**2 - HEIGHT**2)
    result = []
    for patches in (0.5, 1.0, 1.5, 2.0):
        second = np.searchsorted(ahead, ahead + patches * side)
        first = np.flatnonzero(second < len(ahead))
        result.append((built[:, first] * built[:, second[first]]).mean() * nu)
    spline = [2 / 3 - 0.25 + 0.0625, 1 / 6, 0.5**3 / 6, 0.0]
    np.testing.assert_allclose(result, np.array(spline) / (2 / 3), atol=0.12)


@pytest.mark.thorough
def test_density_changes_nothing(flat: mi.Scene) -> None:
    """Four times the points: the same energy within 0.1 dB, the same contrast."""
    result = [np.abs(images(imager(flat, SONAR.replace(scatterers_per_cell=n)), 16)) ** 2 for n in (6, 24)]
    assert 10 * np.log10(result[1].mean() / result[0].mean()) == pytest.approx(0, abs=0.1)


@pytest.mark.thorough
def test_rays_change_nothing_on_a_plane(flat: mi.Scene) -> None:
    """Each point counts once, whatever the rays; their rounding turns phases by 0.02."""
    one, second = (imager(flat, SONAR.replace(quality=name)).image(POSE, 0)[0] for name in ("standard", "fine"))
    assert np.linalg.norm(one - second) < 0.03 * np.linalg.norm(one)
    assert np.corrcoef((np.abs(one) ** 2).ravel(), (np.abs(second) ** 2).ravel())[0, 1] > 0.999


@pytest.mark.thorough
def test_rocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Silhouettes: twice the rays leave intensities correlated by 0.97, eight times by 0.95; energy as physical, 0.2 dB."""
    loaded = load_scene(RockyField(size_m=12, a_side=(24, 24)).build(3).write(tmp_path / "world"))
    one, second = (
        np.abs(imager(loaded, SONAR.replace(quality=name)).image(POSE, 0)[0]) ** 2 for name in ("standard", "fine")
    )
    assert np.corrcoef(one.ravel(), second.ravel())[0, 1] > 0.95
    with monkeypatch.context() as patch:
        patch.setattr(beams, "COLUMNS_A_BEAM", {"standard": 8})
        twice = np.abs(imager(loaded).image(POSE, 0)[0]) ** 2
    assert np.corrcoef(one.ravel(), twice.ravel())[0, 1] > 0.97
    places = POSE + np.arange(8)[:, None] * np.array([0.2, 0.15, 0, 0, 0, 0])
    result = sum(
        float((np.abs(imager(loaded, SONAR.replace(seed=seed)).image(pose, 0)[0]) ** 2).sum())
        for seed, pose in enumerate(places)
    )
    truth = sum(float(batch.levels.sum()) for batch in Simulator(loaded, BOXES).pings(places))
    assert 10 * math.log10(result / truth) == pytest.approx(0, abs=0.2)


@pytest.mark.thorough
def test_a_sphere_has_the_energy_of_lambert(variant: str) -> None:
    """Of a body that curves: 0.2 dB of the physical model, whose sphere is exact within 0.03 dB."""
    loaded = scene(ball=sphere((0, 4.4, 0), 0.3, diffuse(0.5)))
    pose = np.zeros(6)
    result = np.mean([(np.abs(imager(loaded, SONAR.replace(seed=k)).image(pose, 0)[0]) ** 2).sum() for k in range(8)])
    truth = next(iter(Simulator(loaded, BOXES).pings(pose))).levels.sum()
    assert 10 * math.log10(float(result / truth)) == pytest.approx(0, abs=0.2)


def test_far_from_the_origin_is_warned_of(flat: mi.Scene) -> None:
    far = POSE + np.array([5000.0, 0, 0, 0, 0, 0])
    with pytest.warns(MitsonarWarning, match=r"within \d+ m of the origin"):
        Simulator(scene(floor=floor(diffuse(0.5), half=1e4)), SONAR).render([Pose(*far)])


def test_rays_that_miss_points_are_told_with_the_pitch_that_would_do(flat: mi.Scene) -> None:
    """5 cm above the floor cells of rays reach far: what they cannot look through is told once; the pitch told is enough."""
    low = Pose(0, 0, 0.05, math.radians(0.5), 0, math.radians(45))
    sonar = SONAR.replace(beams=8, azimuth_fov_deg=2.4, elevation_fov_deg=2.0, range_max=12.0, scatterer_spacing_m=0.004)
    with pytest.warns(MitsonarWarning, match="scatterer_spacing_m of") as caught:
        Simulator(flat, sonar).render([low, low], labels=True)
    (message,) = [str(one.message) for one in caught if "scatterer_spacing_m of" in str(one.message)]
    rays, enough = re.match(r"([\d,]+) rays .* scatterer_spacing_m of ([\d.]+) m is enough", message).groups()  # type: ignore[union-attr]
    assert int(rays.replace(",", "")) == 2 * imager(flat, sonar).image(np.array(low), 0)[1].cut > 0
    result = imager(flat, sonar.replace(scatterer_spacing_m=float(enough))).image(np.array(low), 0)[1]
    assert result.cut == result.widest == 0


def test_neighbours_correlate_as_pattern_and_pulse_say(flat: mi.Scene) -> None:
    """The field's correlation is the pattern's autocorrelation over beams and the pulse's over bins."""
    result = images(imager(flat), 12)
    u = np.linspace(-0.1, 0.1, 200_001)
    r = np.linspace(-0.1, 0.1, 200_001)
    pattern, pulse = SONAR.aperture.pattern, imager(flat).former.pulse.shape
    for lag in (1, 2):
        over = [(result[:, :, lag:], result[:, :, :-lag]), (result[:, lag:], result[:, :-lag])]
        away = lag * SONAR.beam_spacing_rad, lag * SONAR.bin_m
        shape = (pattern, u, away[0]), (pulse, r, away[1])
        for (a, b), (f, x, step) in zip(over, shape, strict=True):
            truth = np.trapezoid(f(x) * f(x - step), x) / np.trapezoid(f(x) ** 2, x)
            got = np.abs(intensity_correlation(a, b))
            assert got == pytest.approx(truth**2, abs=0.03)


@pytest.mark.thorough
@pytest.mark.parametrize("looks", essence([2, 3], 2))
def test_looks_average_the_power_of_shorter_pulses(flat: mi.Scene, looks: int) -> None:
    """The mean power stays: of ground, noise and water. The variance is the mean of c^2 over pairs of looks."""
    parts = {
        "ground": SONAR.replace(scatterers_per_cell=30.0),
        "noise": SONAR.replace(noise_level_db=-60.0, range_min=0.1, range_max=0.9),
        "water": SONAR.replace(volume_db=-40.0, range_min=0.6, range_max=1.0),
    }
    ahead = np.array([0.05, 0.03, 0, 0, 0, 0])
    for name, sonar in parts.items():
        several = imager(flat, sonar.replace(looks=looks))
        levels = [np.stack([one.levels(POSE + k * ahead, k)[0] for k in range(6)]) for one in (imager(flat, sonar), several)]
        assert levels[0].shape == levels[1].shape
        assert 10 * np.log10(levels[1].mean() / levels[0].mean()) == pytest.approx(0, abs=0.25), name
        for level, count in zip(levels, (1, looks), strict=True):
            apart = (np.arange(count) - np.arange(count)[:, None]) * (sonar.bin_m / count)
            pairs = Pulse(sonar.resolution_m / count).spectrum().coherence(apart) ** 2
            relative = level / level.mean(axis=(0, 2), keepdims=True)
            assert relative.std() == pytest.approx(pairs.mean() ** 0.5, rel=0.05), name


def intensity_correlation(a: Array, b: Array) -> float:
    """Correlation of the intensities, each less its mean over the places."""
    x, y = (np.abs(v) ** 2 for v in (a, b))
    x, y = (v - v.mean(axis=0) for v in (x, y))
    return float((x * y).sum() / np.sqrt((x * x).sum() * (y * y).sum()))


# ---------------------------------------------------------------- motion


def coherence(sonar: Sonar, pose: Array, moved: Array, beam: int, bin_: int) -> complex:
    """Correlation of one pixel's field before and after a motion, by integration over the floor around it."""
    assert sonar.frequency_hz is not None
    k = 2 * np.pi * sonar.frequency_hz / sonar.sound_speed
    pulse = Pulse(sonar.resolution_m).shape
    u0, r0 = np.sin(sonar.bearing_rad[beam]), sonar.range_m[bin_]
    u = u0 + np.linspace(-2.5, 2.5, 81) / sonar.aperture.length
    r = r0 + np.linspace(-2, 2, 161) * sonar.resolution_m
    u, r = (v.ravel() for v in np.meshgrid(u, r))
    # direction of sine u on the cone that meets the floor at range r: forward f and up l with f^2 + l^2 = 1 - u^2
    point = floor_points(pose, u, r)
    s1 = seen(sonar, pose, point, u0, r0, k, pulse)
    s2 = seen(sonar, moved, point, u0, r0, k, pulse)
    return complex((s1 * np.conj(s2)).sum() / np.sqrt((np.abs(s1) ** 2).sum() * (np.abs(s2) ** 2).sum()))


def floor_points(pose: Array, u: Array, r: Array) -> Array:
    """Points of the floor at sines ``u`` and ranges ``r`` of a sonar without roll: (n, 3)."""
    world = to_world_matrices(pose[None])[0]
    starboard, up, forward = -world[:3, 0], world[:3, 1], world[:3, 2]
    # z: up.z l + forward.z f + starboard.z u = -h / r
    down = -pose[2] / r - starboard[2] * u
    norm = np.hypot(up[2], forward[2])
    base, rest = np.arctan2(up[2], forward[2]), np.arccos(np.clip(down / (norm * np.sqrt(1 - u * u)), -1, 1))
    angle = base - rest  # elevation below the axis' own zero
    if np.cos(angle).mean() < 0:
        angle = base + rest
    f, lift = np.sqrt(1 - u * u) * np.cos(angle), np.sqrt(1 - u * u) * np.sin(angle)
    return np.asarray(pose[:3] + r[:, None] * (u[:, None] * starboard + f[:, None] * forward + lift[:, None] * up))


def seen(sonar: Sonar, pose: Array, point: Array, u0: float, r0: float, k: float, pulse: Shape) -> Array:
    world = to_world_matrices(pose[None])[0]
    way = point - pose[:3]
    r = np.linalg.norm(way, axis=1)
    u = way @ -world[:3, 0] / r
    return np.asarray(sonar.aperture.pattern(u0 - u) * pulse(r0 - r) * np.exp(-2j * k * r) * (pose[2] / r) / r**1.5)


MOTIONS = {
    "side 1 mm": (0.001, 0, 0, 0, 0, 0),
    "side 5 mm": (0.005, 0, 0, 0, 0, 0),
    "side 10 mm": (0.01, 0, 0, 0, 0, 0),
    "side 20 mm": (0.02, 0, 0, 0, 0, 0),
    "side 40 mm": (0.04, 0, 0, 0, 0, 0),
    "forward 0.5 mm": (0, 0.0005, 0, 0, 0, 0),
    "forward 2 mm": (0, 0.002, 0, 0, 0, 0),
    "forward 4 mm": (0, 0.004, 0, 0, 0, 0),
    "forward 8 mm": (0, 0.008, 0, 0, 0, 0),
    "up 2 mm": (0, 0, 0.002, 0, 0, 0),
    "up 5 mm": (0, 0, 0.005, 0, 0, 0),
    "yaw 0.05 deg": (0, 0, 0, 0, 0, math.radians(0.05)),
    "yaw 0.1 deg": (0, 0, 0, 0, 0, math.radians(0.1)),
    "yaw 0.3 deg": (0, 0, 0, 0, 0, math.radians(0.3)),
}


ESSENCE = ("forward 2 mm",)
SHIFTS = np.arange(14)[:, None] * np.array([0.7, 0.2, 0, 0, 0, 0])
CELLS = np.ix_(np.arange(24, 168, 8), np.arange(4, 44, 3))
"""Bins and beams that are compared."""


@pytest.fixture(scope="module")
def before(flat: mi.Scene) -> tuple[CoherentImager, Array]:
    """The imager of all motions, and the cells of its images before the motion."""
    source = imager(flat)
    return source, np.stack([source.image(POSE + shift, 0)[0][CELLS] for shift in SHIFTS])


@pytest.mark.thorough
@pytest.mark.parametrize("name", essence(MOTIONS, *ESSENCE, rest=pytest.mark.slow))
def test_speckle_follows_a_motion_as_theory_says(before: tuple[CoherentImager, Array], name: str) -> None:
    """Fields before and after, weighted by the predicted phase of each pixel: the coherence within 0.03 of the integral."""
    source, motion = before[0], np.array(MOTIONS[name])
    bins, beams = (axis.ravel() for axis in CELLS)
    truth = np.array([[coherence(SONAR, POSE, POSE + motion, int(beam), int(bin_)) for beam in beams] for bin_ in bins])
    one = before[1]
    second = np.stack([source.image(POSE + shift + motion, 0)[0][CELLS] for shift in SHIFTS])
    top = float((one * np.conj(second) * np.exp(-1j * np.angle(truth))).sum().real)
    bottom = math.sqrt(float((np.abs(one) ** 2).sum()) * float((np.abs(second) ** 2).sum()))
    assert top / bottom == pytest.approx(np.abs(truth).mean(), abs=0.03)


def test_a_still_sonar_sees_the_same_speckle(flat: mi.Scene) -> None:
    """Bit for bit, in any order of pings, and in another simulator."""
    simulator = Simulator(flat, SONAR)
    moved = POSE + np.array([0.1, 0, 0, 0, 0, 0])
    one = simulator.render(np.stack([POSE, moved, POSE]), gain=1e6).image
    np.testing.assert_array_equal(one[0], one[2])
    assert not np.array_equal(one[0], one[1])
    np.testing.assert_array_equal(Simulator(flat, SONAR).render([POSE], gain=1e6).image[0], one[0])


def test_threads_do_not_change_bits(flat: mi.Scene) -> None:
    import drjit as dr

    before = dr.thread_count()
    try:
        fields = []
        for count in (1, 2, 3):
            dr.set_thread_count(count)
            fields.append(imager(flat).image(POSE, 0)[0])
    finally:
        dr.set_thread_count(before)
    np.testing.assert_array_equal(fields[0], fields[1])
    np.testing.assert_array_equal(fields[0], fields[2])


def test_room_for_points_grows(flat: mi.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """More points than there is room for at first: the list is made again, and nothing is lost."""
    expected, counts = imager(flat).tracer.field(POSE)
    monkeypatch.setattr("mitsonar.simulation.coherent_tracing.POINTS_A_RAY", 0.01)
    field, again = imager(flat).tracer.field(POSE)
    np.testing.assert_array_equal(field, expected)
    assert again == counts
    assert again.points > 0.01 * imager(flat).tracer.fan.rays


# ---------------------------------------------------------------- levels


def test_absorption_and_gain(flat: mi.Scene) -> None:
    lossy = SONAR.replace(absorption_db_per_m=0.6, gain_exponent=4)
    clear, dimmed = (imager(flat, one).levels(POSE, 0)[0] for one in (SONAR, lossy))
    change = 10 * np.log10(dimmed / clear)
    target = 40 * np.log10(SONAR.range_m) - 2 * 0.6 * SONAR.range_m
    np.testing.assert_allclose(change, np.broadcast_to(target[:, None], change.shape), atol=1e-3)
    undone = imager(flat, lossy.replace(gain_absorption=True)).levels(POSE, 0)[0]
    np.testing.assert_allclose(10 * np.log10(undone / clear), 40 * np.log10(SONAR.range_m)[:, None] + 0 * change, atol=1e-3)


def test_noise_has_its_level_and_is_a_function_of_the_ping(flat: mi.Scene) -> None:
    sonar = SONAR.replace(source_level_db=200.0, noise_level_db=80.0)
    source = imager(flat, sonar)
    draws = np.stack([source.receiver.noise(ping) for ping in range(12)])
    assert 10 * np.log10((np.abs(draws) ** 2).mean()) == pytest.approx(-120, abs=0.1)
    np.testing.assert_array_equal(draws[3], source.receiver.noise(3))
    across = np.abs((draws[:, :, 1:] * draws[:, :, :-1].conj()).mean()) / (np.abs(draws) ** 2).mean()
    u = np.linspace(-0.2, 0.2, 100_001)
    length = sonar.aperture.length
    receive = [shaded_sinc((u - away) * length, series("hann")) for away in (0, sonar.beam_spacing_rad)]
    assert across == pytest.approx((receive[0] * receive[1]).sum() / (receive[0] ** 2).sum(), abs=0.03)
    assert np.abs((draws[0] * draws[1].conj()).mean()) / (np.abs(draws) ** 2).mean() < 0.05


def test_volume_reverberation_has_its_level(flat: mi.Scene) -> None:
    """Sv + 10 log of the cell's volume - 40 log R - 2 alpha R; new in each ping."""
    sonar = SONAR.replace(volume_db=-60.0, absorption_db_per_m=0.5)
    source = imager(flat, sonar)
    result = (np.abs(np.stack([source.receiver.volume(ping) for ping in range(12)])) ** 2).mean(axis=(0, 2))
    r = sonar.range_m
    cell = r**2 * sonar.beam_width_rad * math.radians(sonar.elevation_fov_deg) * sonar.bin_m
    truth = -60 + 10 * np.log10(cell) - 40 * np.log10(r) - 2 * 0.5 * r
    assert np.abs(10 * np.log10(result) - truth).reshape(-1, 16).mean(axis=1).max() < 0.6
    assert 10 * np.log10(result).mean() == pytest.approx(truth.mean(), abs=0.1)
    assert not np.array_equal(source.receiver.volume(0), source.receiver.volume(1))


def test_near_glow_falls_evenly_in_decibels(flat: mi.Scene) -> None:
    sonar = SONAR.replace(range_min=0.2, range_max=1.1, noise_level_db=-120.0, near_glow_db=30.0, near_glow_m=0.8)
    source = imager(flat, sonar)
    result = 10 * np.log10((np.abs(np.stack([source.receiver.noise(ping) for ping in range(12)])) ** 2).mean(axis=(0, 2)))
    truth = -120 + 30 * np.maximum(0, 1 - sonar.range_m / 0.8)
    assert np.abs((result - truth).reshape(-1, 16).mean(axis=1)).max() < 0.3


GLOWING: dict[str, float] = {
    "range_min": 0.2,
    "range_max": 1.1,
    "noise_level_db": -120.0,
    "near_glow_db": 60.0,
    "near_glow_m": 0.8,
}


@pytest.mark.thorough
def test_near_glow_falls_from_the_middle_beam_outwards(flat: mi.Scene) -> None:
    """As the square of the sine of the bearing; the median beam keeps the level; each beam has its own by the seed."""
    sonar = SONAR.replace(**GLOWING, near_glow_edge_db=20.0)
    seen = np.stack([imager(flat, sonar).receiver.noise(ping) for ping in range(40)])[:, sonar.range_m < 0.4]
    result = 10 * np.log10((np.abs(seen) ** 2).mean(axis=0))
    line = -120 + 60 * (1 - sonar.range_m[sonar.range_m < 0.4] / 0.8)
    square = (np.sin(sonar.bearing_rad) / np.sin(sonar.bearing_rad[-1])) ** 2
    np.testing.assert_allclose((result - line[:, None]).mean(axis=0), -20 * (square - 0.25), atol=0.4)
    spread = sonar.replace(near_glow_spread_db=5.0)
    second = np.stack([imager(flat, spread).receiver.noise(ping) for ping in range(40)])[:, sonar.range_m < 0.4]
    local = (10 * np.log10((np.abs(second) ** 2).mean(axis=0)) - result).mean(axis=0)
    assert local.std() == pytest.approx(5, abs=1.2)
    redrawn = imager(flat, spread.replace(seed=7)).receiver.noise(0)[sonar.range_m < 0.4]
    assert np.corrcoef(np.log(np.abs(redrawn)).mean(axis=0), np.log(np.abs(second[0])).mean(axis=0))[0, 1] < 0.9


@pytest.mark.thorough
def test_a_part_of_the_near_glow_stays_and_its_power_is_kept(flat: mi.Scene) -> None:
    """The field of two pings has that coherence where the glow is far above the noise, and none behind it."""
    sonar = SONAR.replace(**GLOWING)
    power = [np.zeros(0)] * 2
    for k, still in enumerate((0.0, 0.7)):
        draws = np.stack([imager(flat, sonar.replace(near_glow_still=still)).receiver.noise(ping) for ping in range(24)])
        power[k] = 10 * np.log10((np.abs(draws) ** 2).mean(axis=(0, 2)))
        for part, target in ((sonar.range_m < 0.4, still), (sonar.range_m > 0.8, 0.0)):
            grain = draws[:, part] / np.sqrt((np.abs(draws[:, part]) ** 2).mean(axis=(0, 2)))[None, :, None]
            shared = (grain[1:] * grain[:-1].conj()).mean()
            assert abs(shared) == pytest.approx(target, abs=0.05)
    assert np.abs((power[1] - power[0]).reshape(-1, 16).mean(axis=1)).max() < 0.8


def test_bright_speckle_stays_and_noise_changes(flat: mi.Scene) -> None:
    """A still sonar: pixels far above the noise keep their grain, pixels at its level do not."""
    level = 10 * math.log10(float(expected(SONAR).mean()))
    for above, low, high in ((30.0, 0.98, 1.0), (0.0, 0.15, 0.35)):
        source = imager(flat, SONAR.replace(noise_level_db=level - above))
        one, second = (np.log10(np.abs(source.image(POSE, ping)[0]) ** 2) for ping in (0, 1))
        assert low <= np.corrcoef(one.ravel(), second.ravel())[0, 1] <= high


def test_crosstalk_and_stripes(flat: mi.Scene) -> None:
    plain = imager(flat).image(POSE, 0)[0]
    leaky = imager(flat, sonar := SONAR.replace(crosstalk_db=-30.0))
    np.testing.assert_allclose(leaky.image(POSE, 0)[0] - plain, plain @ crosstalk(sonar), atol=1e-9)
    np.testing.assert_array_equal(leaky.image(POSE, 0)[0], imager(flat, sonar).image(POSE, 0)[0])
    striped = np.abs(imager(flat, SONAR.replace(stripes_db=0.5)).image(POSE, 0)[0] / plain)
    np.testing.assert_allclose(striped, striped[:1] + 0 * striped, rtol=1e-5)
    assert 0.3 < (20 * np.log10(striped[0])).std() < 0.8


def test_taper_falls_with_the_square_of_the_bearing(flat: mi.Scene) -> None:
    sonar = SONAR.replace(noise_level_db=-90.0)
    ratio = np.abs(imager(flat, sonar.replace(taper_db=11.0)).image(POSE, 0)[0] / imager(flat, sonar).image(POSE, 0)[0])
    sine = np.sin(sonar.bearing_rad)
    np.testing.assert_allclose(20 * np.log10(ratio), np.tile(-11 * (sine / sine.max()) ** 2, (len(ratio), 1)), atol=1e-3)


def test_the_detector_adds_a_constant_to_the_power(flat: mi.Scene) -> None:
    sonar = SONAR.replace(noise_level_db=-90.0, source_level_db=180.0, gain_exponent=2)
    plain, _, _ = imager(flat, sonar).levels(POSE, 0)
    result, _, _ = imager(flat, sonar.replace(detector_offset_db=-95.0)).levels(POSE, 0)
    np.testing.assert_allclose(result, plain + 10**-27.5 * sonar.range_m[:, None] ** 2, rtol=1e-5)


def test_beams_and_ping_groups_have_gains_and_offsets_of_their_own(flat: mi.Scene) -> None:
    """Spreads as drawn from 100 seeds; a frame of groups differs from an even one by the gains of the groups."""
    sonar = SONAR.replace(ping_groups=4, coding="linear", gain_exponent=0, source_level_db=180.0)
    spread = sonar.replace(group_stripes_db=0.8, detector_offset_db=-90.0, detector_spread_db=0.5)
    group, gains, offsets = group_of_beams(spread), [], []
    for seed in range(100):
        receiver = ReceiverNoise(spread.replace(seed=seed), beams.BeamFormer(spread))
        gain_db = 20 * np.log10(receiver.stripes)
        assert all(np.ptp(gain_db[group == one]) < 1e-5 for one in range(4))
        gains.append([gain_db[group == one][0] for one in range(4)])
        offsets.append(10 * np.log10(receiver.offset))
    assert np.std(gains) == pytest.approx(0.8, rel=0.1)
    assert np.std(offsets) == pytest.approx(0.5, rel=0.05)
    assert np.mean(offsets) == pytest.approx(-270, abs=0.05)
    even, result = (next(iter(Simulator(flat, each).pings(POSE))).levels[0] for each in (sonar, spread))
    receiver = ReceiverNoise(spread, beams.BeamFormer(spread))
    np.testing.assert_allclose(result, even * receiver.stripes**2 + receiver.offset, rtol=1e-3)


def test_tails_are_sparse_and_have_the_power_and_length_that_are_given() -> None:
    """Over 60 seeds, the power of a beam's taps is tail_db, and a share exp(-x / tail_m) of it is farther than x."""
    sonar = SONAR.replace(tail_db=-17.0, tail_m=0.1)
    power = np.stack([np.abs(EchoTail(sonar.replace(seed=seed)).response) ** 2 for seed in range(60)])
    assert 10 * np.log10(power.sum(axis=1).mean()) == pytest.approx(-17, abs=0.3)
    assert power[:, 0].max() == 0
    behind = np.arange(power.shape[1]) * sonar.bin_m
    farther = np.array([power[:, behind > x].sum() for x in (0.05, 0.1, 0.2)]) / power.sum()
    np.testing.assert_allclose(farther, np.exp(-(np.array([0.05, 0.1, 0.2]) - sonar.resolution_m) / 0.1), rtol=0.2)
    assert (power > 0).sum(axis=1).max() <= TAPS


def test_tails_follow_echoes_as_a_causal_filter(flat: mi.Scene) -> None:
    sonar = SONAR.replace(tail_db=-12.0, tail_m=0.05)
    plain, result = (imager(flat, each).echoes(POSE)[0] for each in (SONAR, sonar))
    response = EchoTail(sonar).response
    response[0] = 1
    target = [np.convolve(beam, taps)[: SONAR.range_bins] for beam, taps in zip(plain.T, response.T, strict=True)]
    np.testing.assert_allclose(result, np.array(target).T, atol=1e-5 * float(np.abs(plain).max()))


def test_a_limiter_of_gaussian_signals() -> None:
    """Gain E y z* and power E |y|^2 of clipped draws, as the closed forms say."""
    real, imag = np.random.default_rng(1).normal(0, math.sqrt(0.5), (2, 400_000))
    z = real + 1j * imag
    limit = np.array([0.02, 0.3, 1.0, 4.0, 20.0])
    gain, distortion = receiver_noise.limiter(limit)
    clipped = [z * np.minimum(1, math.sqrt(u) / np.abs(z)) for u in limit]
    np.testing.assert_allclose(gain, [(y * z.conj()).mean().real for y in clipped], rtol=5e-3)
    np.testing.assert_allclose(gain**2 + distortion, [(np.abs(y) ** 2).mean() for y in clipped], rtol=5e-3)


@pytest.mark.parametrize("over_db", essence([20.0, 6.0, -3.0], 6.0))
def test_a_saturated_receiver_has_the_power_that_clipping_leaves(over_db: float) -> None:
    """Noise of all beams, over_db above the limit of the elements, keeps the share 1 - exp(-u) of its power."""
    wide = SONAR.replace(source_level_db=180.0, noise_level_db=100.0)
    elements_db = 100 + 10 * math.log10(SONAR.beams * SONAR.beam_spacing_rad / SONAR.beam_width_rad)
    sonar = wide.replace(saturation_db=elements_db - over_db)
    receiver = ReceiverNoise(sonar, beams.BeamFormer(sonar))
    noise = np.stack([receiver.noise(ping) for ping in range(20)])
    result = np.stack([receiver.clipped(image, ping) for ping, image in enumerate(noise)])
    kept = -np.expm1(-(10 ** (-over_db / 10)))
    assert np.square(np.abs(result)).mean() / np.square(np.abs(noise)).mean() == pytest.approx(kept, rel=0.03)
    quiet = receiver.noise(0) * np.complex64(0.01)
    np.testing.assert_array_equal(receiver.clipped(quiet, 0), quiet)


def test_a_limit_below_the_noise_is_told(flat: mi.Scene) -> None:
    loud = SONAR.replace(source_level_db=180.0, noise_level_db=80.0)
    assert not any("saturation_db" in note for note in imager(flat, loud.replace(saturation_db=100.0)).notes)
    assert any(
        "saturation_db -20 is below the noise, 80 dB" in note
        for note in imager(flat, loud.replace(saturation_db=-20.0)).notes
    )


def test_a_glint_that_saturates_lights_all_beams_at_its_range(flat: mi.Scene) -> None:
    """Its own echo is compressed; other ranges keep their bits."""
    sonar = SONAR.replace(source_level_db=180.0)
    image = imager(flat, sonar).image(POSE, 0)[0]
    image[100, 20] = 1e4 * np.abs(image).max()
    power_db = 10 * math.log10(float(np.square(np.abs(image[100])).mean())) + 180
    saturated = sonar.replace(saturation_db=power_db + 10 * math.log10(SONAR.beams) - 10)
    result = ReceiverNoise(saturated, beams.BeamFormer(saturated)).add(image.copy(), 0)
    others = np.arange(SONAR.beams) != 20
    assert np.abs(result[100, 20]) < 0.5 * np.abs(image[100, 20])
    assert np.median(np.abs(result[100, others])) > 10 * np.median(np.abs(image[100, others]))
    np.testing.assert_array_equal(np.delete(result, 100, axis=0), np.delete(image, 100, axis=0))


@pytest.mark.parametrize("groups", [1, 8])
def test_crosstalk_falls_with_distance_and_stays_in_a_ping_group(groups: int) -> None:
    sonar = SONAR.replace(beams=96, crosstalk_db=-40.0, ping_groups=groups)
    power = np.mean([np.abs(crosstalk(sonar.replace(seed=seed))) ** 2 for seed in range(200)], axis=0)
    away = np.abs(np.arange(96)[:, None] - np.arange(96))
    same = (away % groups == 0) & (away > 0)
    assert not power[~same].any()
    assert 10 * np.log10(power[same].mean()) == pytest.approx(-40, abs=0.1)
    near, far = (10 * np.log10(power[away == channels * groups].mean()) for channels in (1, 8))
    assert near - far == pytest.approx(20 / 3 * math.log10(8), abs=0.5)


def test_groups_leak_only_among_themselves(flat: mi.Scene) -> None:
    """A frame of groups at rest is that of one ping, with the crosstalk of each group."""
    sonar = SONAR.replace(crosstalk_db=-20.0, coding="linear", ping_groups=4)
    frame = next(iter(Simulator(flat, sonar).pings(POSE))).levels[0]
    plain, one = imager(flat, SONAR), imager(flat, sonar.replace(ping_groups=1))
    image = plain.image(POSE, 0)[0]
    target = np.abs(image + image @ crosstalk(sonar)) ** 2 * plain.gain[:, None]
    np.testing.assert_allclose(frame, target, rtol=1e-3, atol=1e-5 * target.max())
    assert np.abs(one.image(POSE, 0)[0] - image - image @ crosstalk(sonar)).max() > 0.01 * np.abs(image).max()


def test_pings_at_rest_share_their_echoes(flat: mi.Scene) -> None:
    """Two pings from one pose differ in noise only, as if each were traced."""
    source = imager(flat, SONAR.replace(noise_level_db=-90.0))
    first, second, again = (source.image(POSE, ping, again=again)[0] for ping, again in ((0, False), (1, False), (1, True)))
    np.testing.assert_array_equal(second, again)
    np.testing.assert_allclose(first - source.receiver.noise(0), second - source.receiver.noise(1), atol=1e-9)


def test_elevation_pattern_is_three_db_down_at_the_field_of_view(flat: mi.Scene) -> None:
    """Skirts instead of edges: the level at the upper edge's range is 3 dB below that without pattern."""
    wide = {"range_min": 3.2, "range_max": 6.4, "range_bins": 512, "elevation_fov_deg": 14.0}
    box, skirt = (
        (np.abs(images(imager(flat, SONAR.replace(elevation_pattern=name, **wide)), 8)) ** 2).mean(axis=(0, 2))
        for name in ("box", "two_way")
    )
    r = SONAR.replace(**wide).range_m
    edges = [HEIGHT / math.sin(PITCH + sign * math.radians(7)) for sign in (1, -1)]
    for edge, inside in zip(edges, (1, -1), strict=True):
        near = np.abs(r - (edge + inside * 0.12)) < 0.1
        angle = np.abs(np.arcsin(HEIGHT / r[near]) - PITCH)
        x = 0.318883 / math.sin(math.radians(7)) * np.sin(angle)
        assert 10 * np.log10(skirt[near].mean() / box[near].mean()) == pytest.approx(
            10 * math.log10(float((np.sinc(x) ** 4).mean())), abs=0.5
        )
    beyond = r > edges[1] + 0.3
    assert box[beyond].mean() < 1e-3 * skirt[beyond].mean()


def test_frames_carry_decibels(flat: mi.Scene) -> None:
    sonar = SONAR.replace(source_level_db=200.0, gain_exponent=0, coding_db=70.0)
    frames = Simulator(flat, sonar).render([POSE])
    assert frames.level == "dB"
    level = frames.decibels_of(0) + frames.image[0] * (frames.decibels_of(1) - frames.decibels_of(0))
    truth = 200 + 10 * np.log10(imager(flat, sonar).levels(POSE, 0)[0])
    stored = (frames.image[0] > 0.01) & (frames.image[0] < 1)
    np.testing.assert_allclose(level[stored], truth[stored], atol=1e-3)
    assert frames.decibels_of(1) - frames.decibels_of(0) == pytest.approx(70)


def test_labels_come_with_speckle(flat: mi.Scene) -> None:
    sonar = SONAR.replace(noise_level_db=-150.0)
    frames = Simulator(flat, sonar).render([POSE], labels=True)
    assert frames.shape_id is not None
    assert frames.shadow is not None
    assert (frames.shape_id[0, 10:-10] == 0).all()
    assert not frames.shadow[0, 10:-10].any()


def test_what_it_cannot_do_is_refused(flat: mi.Scene) -> None:
    with pytest.raises(MitsonarError, match="give the sonar noise_level_db"):
        Simulator(flat, SONAR).render([Pose(*POSE)], noise=NOISE_MODELS["low"])


def test_too_few_points_are_told_with_the_spacing_that_would_do(flat: mi.Scene) -> None:
    """A resolution cell at 4 m is 4 m x 0.3 deg by one bin; four points in it take half the root of its area."""
    with pytest.warns(MitsonarWarning, match=r"holds 0\.25 points at 4 m.* scatterer_spacing_m of ([\d.]+) m is enough"):
        Simulator(flat, SONAR.replace(scatterer_spacing_m=0.02)).render([Pose(*POSE)])
    (message,) = imager(flat, SONAR.replace(scatterer_spacing_m=0.02)).notes
    enough = float(message.split(" m is enough")[0].rsplit(" ", 1)[1])
    assert enough == pytest.approx(math.sqrt(4 * math.radians(0.3) * SONAR.bin_m) / 2, rel=0.05)
    assert not imager(flat, SONAR.replace(scatterer_spacing_m=0.97 * enough)).notes
