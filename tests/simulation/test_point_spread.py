"""Point spread of the model coherent: across beams, over range and elevation, and out of focus."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
from coherent_scenes import SONAR, imager, one_point
from helpers import Array, essence

from mitsonar.instruments.beams import Pattern
from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.beams import BeamFormer, elevation_end
from mitsonar.simulation.receiver_noise import ReceiverNoise

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.filterwarnings("ignore:.*lie outside the window")]

Shape: TypeAlias = Callable[[Array], Array]


SHADED = [("uniform", "receive"), ("hann", "two_way"), ("taylor", "receive")]


@pytest.mark.parametrize(("shading", "pattern"), essence(SHADED, ("hann", "two_way")))
def test_point_spread(shading: str, pattern: str) -> None:
    """Across beams and over range: 0.5 dB down to -25 dB, within -47 dB of the peak, and the tops of two side lobes."""
    narrow = {"beams": 256, "azimuth_fov_deg": 10.0, "beam_width_deg": 0.4, "range_min": 4.2, "range_max": 4.6}
    sonar = SONAR.replace(shading=shading, pattern=pattern, range_bins=256, pulse_m=0.02, elevation_pattern="box", **narrow)
    loaded, fields, _ = one_point()
    source = imager(loaded, sonar.replace(**fields))
    result = np.abs(source.image(np.zeros(6), 0)[0]).astype(float)
    range_m = sonar.range_m
    bin_, beam = np.unravel_index(result.argmax(), result.shape)
    for line, axis, shape in (
        (result[bin_], np.sin(sonar.bearing_rad), sonar.aperture.pattern),
        (result[:, beam], range_m, source.former.pulse.shape),
    ):
        truth = best_fit(line, axis, shape)
        level, expected = (20 * np.log10(np.maximum(v, 1e-9) / truth.max()) for v in (line, truth))
        main = expected > -35 if shading != "uniform" else expected > -25
        inner = main & (np.abs(np.arange(len(line)) - line.argmax()) < first_null(expected))
        assert np.abs(level - expected)[inner & (expected > -25)].max() < 0.5
        assert np.abs(line - truth)[inner].max() < 10 ** (-47 / 20) * truth.max()
        tops = side_lobes(expected)[:2]
        assert len(tops) == (2 if pattern == "receive" or axis is range_m else 1)
        for part in (slice(max(0, top - 2), top + 3) for top in tops):
            assert level[part].max() == pytest.approx(expected[part].max(), abs=1.0)


@pytest.mark.slow
def test_a_point_shows_the_lobes_of_an_array_with_errors() -> None:
    sonar = SONAR.replace(pattern="receive", elevation_pattern="box", beams=256, azimuth_fov_deg=20.0, beam_width_deg=0.4)
    loaded, fields, _ = one_point()
    source = imager(loaded, sonar.replace(array_error=0.3, **fields))
    result = np.abs(source.image(np.zeros(6), 0)[0]).astype(float)
    line = result[result.max(axis=1).argmax()]
    axis = np.sin(sonar.bearing_rad)
    shape = lambda away: np.abs(source.sonar.aperture.spectrum().at(away))  # noqa: E731
    truth = best_fit(line, axis, shape)
    beside = np.abs(axis - axis[truth.argmax()]) > 0.03
    assert 20 * np.log10(truth[beside].max() / truth.max()) > -35  # ideal lobes lie below -60 dB there
    assert np.abs(line - truth).max() < 0.01 * truth.max()


def best_fit(line: Array, axis: Array, shape: Shape) -> Array:
    """The shape at the place between samples where it fits best."""
    step = axis[1] - axis[0]
    places = axis[line.argmax()] + np.linspace(-1, 1, 401) * abs(step)
    fits = [np.abs(shape(axis - place)) for place in places]
    scale = [float(line @ fit / (fit @ fit)) for fit in fits]
    errors = [float(((line - a * fit) ** 2).sum()) for a, fit in zip(scale, fits, strict=True)]
    best = int(np.argmin(errors))
    return np.asarray(scale[best] * fits[best])


def first_null(level: Array) -> int:
    """Samples from the top to the first minimum on its right."""
    top = int(level.argmax())
    return int(np.flatnonzero(np.diff(level[top:]) > 0)[0])


def side_lobes(level: Array) -> list[int]:
    """Indices of the maxima right of the main lobe."""
    begin = int(level.argmax()) + first_null(level)
    part = level[begin:]
    return [begin + i for i in range(1, len(part) - 1) if part[i - 1] < part[i] >= part[i + 1] and part[i] > -75]


# ---------------------------------------------------------------- elevation


def upright_array(elevation: Array, half_deg: float, ways: int) -> Array:
    """Amplitude of an even line of elements, there only or there and back, half power at ``half_deg``: a plain sum."""
    place = (np.arange(1500) + 0.5) / 1500 - 0.5

    def sum_over(length: float, angle: Array) -> Array:
        waves = np.exp(2j * np.pi * length * place * np.sin(angle)[:, None])
        return np.asarray(waves.mean(axis=1).real ** ways)

    low, high = 0.0, 1 / math.sin(math.radians(half_deg))
    for _ in range(50):
        middle = (low + high) / 2
        power = float(sum_over(middle, np.array([math.radians(half_deg)]))[0]) ** 2
        low, high = (middle, high) if power > 0.5 else (low, middle)
    return sum_over(low, elevation)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("pattern", "ways", "least_db"), essence([("receive", 1, -35.0), ("two_way", 2, -29.5)], ("two_way", 2, -29.5))
)
def test_spread_over_elevation(pattern: Pattern, ways: int, least_db: float) -> None:
    """A point that the sonar nods past keeps its bearing: its level follows the array's sum, to where the fan ends."""
    loaded, fields, place = one_point(half=0.05)
    sonar = SONAR.replace(elevation_pattern=pattern, beams=16, azimuth_fov_deg=4.8, range_min=4.2, range_max=4.6,
                          range_bins=64, **fields)  # fmt: skip
    source, nods = imager(loaded, sonar), np.radians(np.arange(-20.0, 20.1, 0.5))
    images = [np.abs(source.image(np.array([0, 0, 0, nod, 0, 0]), 0)[0]).astype(float) for nod in nods]
    brightest = np.unravel_index(images[len(nods) // 2].argmax(), images[0].shape)
    result = np.array([image[brightest] for image in images])
    elevation = math.atan2(place[2], place[1]) + nods
    truth = upright_array(elevation, sonar.elevation_fov_deg / 2, ways)
    truth *= result.max() / truth[result.argmax()]
    level, expected = (20 * np.log10(np.maximum(np.abs(v), 1e-12) / result.max()) for v in (result, truth))
    seen = (expected > least_db) & (np.abs(elevation) < elevation_end(sonar))
    assert expected[seen].min() < least_db + 8
    assert np.abs(level - expected)[seen].max() < 0.1
    assert not result[np.abs(elevation) > elevation_end(sonar) + 0.005].any()


@pytest.mark.parametrize(("pattern", "ways"), [("receive", 1), ("two_way", 2)])
def test_law_over_elevation_to_the_second_side_lobe(pattern: Pattern, ways: int) -> None:
    """The law itself, beyond the fan: tops of both side lobes, -13.26 and -17.83 dB one way, within 0.02 dB."""
    import mitsuba as mi

    from mitsonar.simulation.beams import elevation_gain

    sonar = SONAR.replace(elevation_pattern=pattern, elevation_fov_deg=6.0)
    angle = np.radians(np.linspace(-30, 30, 3001))
    result = np.array(elevation_gain(sonar, mi.Float(np.tan(angle).astype(np.float32))), dtype=float)
    np.testing.assert_allclose(result, upright_array(angle, 3.0, ways), atol=1e-4)
    level = 20 * np.log10(np.maximum(np.abs(result), 1e-9))
    tops = side_lobes(level)[:2]
    np.testing.assert_allclose(level[tops], ways * np.array([-13.26, -17.83]), atol=0.02)


# ---------------------------------------------------------------- focus


def focused_sum(sonar: Sonar, place: Array, focus_m: float) -> Array:
    """Amplitude of a point in each beam ``(beams,)``, by exact ways to 4,000 elements of Hann's weights, there and back.

    Each element is delayed by its way to the point of the beam's axis at the focus.
    """
    assert sonar.frequency_hz is not None
    wavelength = sonar.sound_speed / sonar.frequency_hz
    x = ((np.arange(4000) + 0.5) / 4000 - 0.5) * sonar.aperture.length * wavelength
    weight = 1 + np.cos(2 * np.pi * x / (sonar.aperture.length * wavelength))
    to_point = np.sqrt((place[0] - x) ** 2 + place[1] ** 2 + place[2] ** 2)
    b = sonar.bearing_rad[:, None]
    to_focus = np.sqrt((focus_m * np.sin(b) - x) ** 2 + (focus_m * np.cos(b)) ** 2)
    one_way = (weight * np.exp(-2j * np.pi / wavelength * (to_point - to_focus))).sum(axis=1) / weight.sum()
    return np.asarray(np.abs(one_way) ** 2)


INSTRUMENTS = {
    "DIDSON": {"frequency_hz": 1.8e6, "beam_width_deg": 29 / 96},
    "ARIS": {"frequency_hz": 3.0e6, "beam_width_deg": 30.25 / 128},
}


QUICK = (("DIDSON", 2.0), ("ARIS", 3.0))


@pytest.mark.parametrize(
    ("name", "focus_m"),
    [
        (name, at) if (name, at) in QUICK else pytest.param(name, at, marks=pytest.mark.slow)
        for name in INSTRUMENTS
        for at in (2.0, 3.0, 4.4, 12.0)
    ],
)
@pytest.mark.thorough
def test_focus_against_exact_ways_to_the_elements(name: str, focus_m: float) -> None:
    """Near field of a lens: the level in each beam relative to the top in focus, 0.5 dB down to -30 dB, blurred or not."""
    loaded, fields, place = one_point()
    sonar = SONAR.replace(beams=64, azimuth_fov_deg=4.0, range_min=4.36, range_max=4.44, range_bins=10, **INSTRUMENTS[name],
                          **fields)  # fmt: skip
    images = [np.abs(imager(loaded, sonar.replace(focus_m=at)).image(np.zeros(6), 0)[0]) for at in (None, focus_m)]
    bin_ = np.unravel_index(images[0].argmax(), images[0].shape)[0]
    sharp, result = (image[bin_].astype(float) for image in images)
    in_focus, truth = (focused_sum(sonar, place, at) for at in (float(np.linalg.norm(place)), focus_m))
    level, expected = (
        20 * np.log10(np.maximum(v, 1e-9) / top) for v, top in ((result, sharp.max()), (truth, in_focus.max()))
    )
    seen = expected > -30
    assert seen.sum() > 8
    assert np.abs(level - expected)[seen].max() < 0.5
    if focus_m != 4.4:
        assert expected.max() < -0.5


# ---------------------------------------------------------------- the grid


ERRORS = [("uniform", "receive", -42), ("hann", "two_way", -46.5), ("taylor", "receive", -46)]


@pytest.mark.parametrize(("shading", "pattern", "error_db"), ERRORS)
def test_waves_between_the_nodes_have_pattern_and_pulse(shading: str, pattern: str, error_db: float) -> None:
    """Waves anywhere, spread and formed, against their patterns and pulses written down: power of the difference."""
    import mitsuba as mi

    from mitsonar.simulation.coherent_tracing import FieldSums

    sonar = SONAR.replace(shading=shading, pattern=pattern, beams=96, azimuth_fov_deg=30.0, beam_width_deg=0.6)
    sonar = sonar.replace(range_min=2.0, range_max=2.5, range_bins=100, pulse_m=0.01, source_level_db=0.0)
    former = BeamFormer(sonar)
    rng = np.random.default_rng(4)
    count = 40
    sine, range_m, phase = rng.uniform(-0.2, 0.2, count), rng.uniform(2.1, 2.4, count), rng.uniform(0, 6.28, count)
    level = np.exp(rng.normal(size=count)) * 1e-3
    wave = mi.Float(sine), mi.Float64(range_m), *map(mi.Float, (level, np.cos(phase), np.sin(phase)))
    gain = math.sqrt(sonar.beam_width_rad / sonar.aperture.equivalent_width * sonar.bin_m / former.pulse.equivalent_m)
    pulses = former.pulse.shape(sonar.range_m[:, None] - range_m) * (gain * level * np.exp(1j * phase))
    expected = pulses @ sonar.aperture.pattern(np.sin(sonar.bearing_rad)[:, None] - sine).T
    images = []
    for packed in (True, False):
        sums = FieldSums(former, 100.0, packed=packed)
        grid, field = sums.zeros(), np.zeros((former.ranges, former.sines), np.complex64)
        assert np.array(sums.add(grid, wave, mi.Bool(True))).all()
        sums.add_to(field, sums.values(grid))
        images.append(former.beams(field))
        error = np.square(np.abs(images[-1] - expected)).sum() / np.square(np.abs(expected)).sum()
        assert 10 * math.log10(error) < error_db
    np.testing.assert_allclose(images[0], images[1], atol=1e-5 * np.abs(expected).max())


def test_white_noise_has_unit_power_everywhere() -> None:
    """After the pulse, for draws that are farther apart than its samples; and neighbouring bins correlate as it says."""
    source = ReceiverNoise(SONAR, BeamFormer(SONAR))
    over_range = source.former.over_noise
    rows = over_range @ np.eye(over_range.columns, dtype=np.float32)
    np.testing.assert_allclose(np.square(rows).sum(axis=1), 1, atol=2e-3)
    np.testing.assert_allclose(rows @ rows.T, source.bin_correlation().toarray(), atol=2e-3)


@pytest.mark.parametrize("pulse_m", [None, 0.2])
def test_white_noise_has_unit_power_from_the_first_bin_of_a_window_that_begins_at_the_sonar(pulse_m: float | None) -> None:
    sonar = SONAR.replace(range_min=0.0, range_max=2.0, range_bins=100, pulse_m=pulse_m)
    over_range = BeamFormer(sonar).over_noise
    rows = over_range @ np.eye(over_range.columns, dtype=np.float32)
    np.testing.assert_allclose(np.square(rows).sum(axis=1), 1, atol=2e-3)
