"""A sonar is calibrated with frames of level ground: known values come back, with their errors, or are called unknown."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Array, Command, diffuse, floor, floor_levels, refused, scene

from mitsonar.acoustics.water import gain_of
from mitsonar.errors import MitsonarError, MitsonarWarning
from mitsonar.estimation.calibration import calibrate_sonar
from mitsonar.estimation.ground_levels import GroundModel, GroundProblem, reference_of
from mitsonar.estimation.sonar_fit import fit_sonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.records.frames import SonarFrames
from mitsonar.simulation.receiver_noise import crosstalk

ARIS = Path(__file__).resolve().parents[2].parent / "shared/data/real/aris1200-sdk-sample/sample.aris"

SHEET = Sonar.create(
    model="coherent", frequency_hz=1.2e6, range_min=1.0, range_max=9.0, range_bins=256, beams=48, azimuth_fov_deg=30,
    gain_exponent=2, elevation_fov_deg=14.0, absorption_db_per_m=0.4, quality="draft",
)  # fmt: skip
"""What a data sheet states; :data:`TRUE` differs."""

TRUE = {"taper_db": 3.0, "elevation_fov_deg": 16.0, "absorption_db_per_m": 0.5, "noise_level_db": -98.0}

PLACES = ((1.5, 20.0), (2.0, 30.0), (2.6, 25.0), (1.8, 15.0))
"""Heights [m] and pitches [deg], of which the medians are 1.9 m and 22.5 deg."""


def poses_at(places: tuple[tuple[float, float], ...], count: int, seed: int = 1) -> Array:
    """Poses over several parts of the ground, at the same heights and pitches."""
    draw = np.random.default_rng(seed)
    rows = [
        [*draw.uniform(-8, 8, 2), height, math.radians(pitch), 0, draw.uniform(0, 6)]
        for _ in range(count)
        for height, pitch in places
    ]
    return np.array(rows)


def edges_of(sonar: Sonar) -> Array:
    """Ranges between the bins [m]."""
    return np.asarray(sonar.range_min + np.arange(sonar.range_bins + 1) * sonar.bin_m, dtype=np.float64)


def drawn(
    places: tuple[tuple[float, float], ...], count: int, seed: int, gain_db: Array | float = 0.0, sheet: Sonar = SHEET
) -> SonarFrames:
    """Frames drawn from the law of the calibration itself: exponential intensities, independent from cell to cell."""
    true = sheet.replace(**TRUE, coding="linear")
    gains = crosstalk(true)
    leak = 0.0 if gains is None else np.abs(gains) ** 2
    model = GroundModel(true, true.bearing_rad, edges_of(true))
    noise = 10 ** (TRUE["noise_level_db"] / 10) * gain_of(true)[:, None]
    aside = np.square(np.sin(true.bearing_rad) / np.sin(true.bearing_rad[-1]))
    images, draw = [], np.random.default_rng(seed)
    poses = poses_at(places, count)
    for pose in poses:
        echo = 0.3 * model.levels(pose[2], math.degrees(pose[3]), 0.0, 16.0, 0.5, 0.0)
        echo = echo + np.dot(echo, leak)
        images.append((echo + noise) * 10 ** ((gain_db - 3.0 * aside) / 10))
    image = np.array(images)
    scale = 20 * float(image.max())
    image = image * draw.exponential(size=image.shape) / scale
    plain = sheet.replace(coding="linear", crosstalk_db=None)
    return SonarFrames(
        image.astype(np.float32), plain.range_m, plain.bearing_rad, np.arange(len(image)) / 10.0, plain, level="linear",
        poses=poses, level_scale=scale,
    )  # fmt: skip


@pytest.fixture(scope="module")
def simulated(variant: str) -> SonarFrames:
    """Coherent frames of a flat floor, whose poses err by 0.1 m and 1.5 deg."""
    from mitsonar.simulation.simulator import Simulator

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MitsonarWarning)
        frames = Simulator(scene(floor=floor(diffuse(0.3))), SHEET.replace(**TRUE)).render(poses_at(PLACES, 6))
    frames.sonar = SHEET
    assert frames.poses is not None
    frames.poses = frames.poses + np.array([0, 0, 0.1, math.radians(1.5), 0, 0])
    return frames


# ---------------- The model


@pytest.mark.parametrize("bearing", ["azimuth", "cone"])
def test_the_ground_has_the_levels_of_an_integral(bearing: str) -> None:
    """Without pattern: beams of a box integrate the same levels, less the broadening of beams to the sides."""
    known: dict[str, Any] = {"range_min": 3.0, "range_max": 9.0, "range_bins": 96, "beams": 24, "azimuth_fov_deg": 60}
    box = Sonar.create(**known, bearing=bearing, model="physical", elevation_fov_deg=120, gain_exponent=3)
    pattern = Sonar.create(
        **known, bearing=bearing, model="coherent", frequency_hz=1e6, gain_exponent=3, absorption_db_per_m=0.0
    )
    level = GroundModel(pattern, pattern.bearing_rad, edges_of(box)).levels(
        2.0, 20.0, 0.0, 14.0, 0.0, 0.0, least_pattern=1.0
    )
    np.testing.assert_allclose(level * np.cos(pattern.bearing_rad), floor_levels(box, 2.0, math.radians(20), 1.0), rtol=2e-3)


def test_absorption_exponent_and_pattern_multiply_the_levels() -> None:
    edges = np.linspace(2.0, 6.0, 200)
    model = GroundModel(SHEET, np.zeros(1), edges)
    plain = model.levels(1.0, 14.0, 0.0, 14.0, 0.0, 0.0)[:, 0]
    middle = (edges[1:] + edges[:-1]) / 2
    lossy = model.levels(1.0, 14.0, 0.0, 14.0, 0.5, 0.0)[:, 0]
    np.testing.assert_allclose(10 * np.log10(plain / lossy), middle, rtol=1e-3)
    steeper = model.levels(1.0, 14.0, 0.0, 14.0, 0.0, 1.0)[:, 0]
    np.testing.assert_allclose(np.gradient(np.log(steeper / plain), np.log(middle))[1:-1], 1.0, rtol=2e-3)
    # half the power where the ground is half the field of view below the axis
    whole = model.levels(1.0, 14.0, 0.0, 14.0, 0.0, 0.0, least_pattern=1.0)[:, 0]
    below = 1 / math.sin(math.radians(14 + 7))
    assert np.interp(below, middle, plain / whole) == pytest.approx(0.5, abs=0.01)


def test_blocks_of_a_wide_fan_have_the_mean_level_of_their_beams() -> None:
    wide = SHEET.replace(beams=128, azimuth_fov_deg=130)
    edges, place = edges_of(wide)[::4], (2.0, 25.0, 0.0, 16.0, 0.3, 0.0)
    beams = GroundModel(wide, wide.bearing_rad, edges).levels(*place).reshape(-1, 8, 16).mean(axis=2)
    block = GroundModel(wide, wide.bearing_rad.reshape(8, 16), edges)
    np.testing.assert_allclose(block.levels(*place), beams, rtol=1e-9)
    # their middle is not enough: the edges of the pattern cross the blocks
    middle = GroundModel(wide, wide.bearing_rad.reshape(8, 16).mean(axis=1), edges).levels(*place)
    lit = beams > 0.1 * beams.max()
    assert np.abs(10 * np.log10(middle[lit] / beams[lit])).max() > 0.1


def test_clipped_cells_do_not_lower_the_levels() -> None:
    """Of exponential intensities the mean is that of the clipped ones over the share that is not clipped."""
    whole, other = drawn(PLACES, 2, 3), drawn(PLACES, 2, 4)
    cut = replace(whole, image=np.minimum(6 * whole.image, 1), level_scale=whole.level_scale / 6)
    whole_mean, mean, other_mean = (
        problem.mean * frames.level_scale
        for frames in (whole, cut, other)
        for problem in [GroundProblem(frames, fit_sonar(frames).sonar, fit_sonar(frames), reference_of(frames))]
    )
    bright = other_mean > 0.5 * other_mean.max()  # independent of the speckle that is clipped
    assert (cut.image >= 1).mean() > 3e-4
    assert mean[bright].mean() == pytest.approx(whole_mean[bright].mean(), rel=5e-3)


# ---------------- Known values come back


@pytest.mark.thorough
def test_simulated_values_come_back(simulated: SonarFrames) -> None:
    result = calibrate_sonar(simulated)
    found = {name: one.value for name, one in result.parameters.items()}
    assert found["taper_db"] == pytest.approx(3.0, abs=0.5)
    assert found["pitch_deg"] == pytest.approx(22.5, abs=0.2)
    assert found["roll_deg"] == pytest.approx(0.0, abs=0.5)
    assert found["elevation_fov_deg"] == pytest.approx(16.0, rel=0.05)
    assert found["height_m"] == pytest.approx(1.9, rel=0.01)
    assert found["absorption_db_per_m"] == pytest.approx(0.5, abs=0.1)
    assert found["range_exponent"] == pytest.approx(0.0, abs=0.3)
    assert found["noise_level_db"] == pytest.approx(-98, abs=0.3)
    assert found["level_db"] == pytest.approx(10 * math.log10(0.3), abs=1.5)
    # within four of its own standard deviations, none of which is tiny
    true = {"taper_db": 3.0, "pitch_deg": 22.5, "elevation_fov_deg": 16.0, "height_m": 1.9, "absorption_db_per_m": 0.5}
    for name, value in true.items():
        assert abs(found[name] - value) < 4 * result.parameters[name].std, name
    assert result.held_out is not None
    assert result.held_out["calibrated"][0] > result.held_out["sonar fit"][0] + 0.1
    assert result.held_out["calibrated"][1] < result.held_out["sonar fit"][1]
    written = result.fit.sonar
    assert written.taper_db == pytest.approx(found["taper_db"], abs=0.01)
    assert written.elevation_fov_deg == pytest.approx(found["elevation_fov_deg"], abs=0.01)


@pytest.mark.slow
def test_errors_have_the_size_of_their_standard_deviations() -> None:
    """Draws of the model: the squared errors relative to the covariance have the mean 1."""
    names = ("height_m", "pitch_deg", "roll_deg", "taper_db", "elevation_fov_deg", "noise_level_db")
    true = (1.9, 22.5, 0.0, 3.0, 16.0, -98.0)
    squares = []
    for seed in range(12):
        result = calibrate_sonar(drawn(PLACES, 1, seed))
        squares.append(
            [((result.parameters[n].value - t) / result.parameters[n].std) ** 2 for n, t in zip(names, true, strict=True)]
        )
    assert 0.4 < np.mean(squares) < 2.0


@pytest.mark.thorough
def test_gains_of_beams_come_back() -> None:
    gain_db = np.random.default_rng(3).normal(0, 1.0, SHEET.beams)
    result = calibrate_sonar(drawn(PLACES, 1, 5, gain_db), beam_gains=True)
    assert result.beam_gain_db is not None
    assert np.corrcoef(result.beam_gain_db, gain_db)[0, 1] > 0.95
    assert result.fit.sonar.stripes_db == pytest.approx(gain_db.std(), abs=0.2)
    assert calibrate_sonar(drawn(PLACES, 1, 5, gain_db)).beam_gain_db is None


@pytest.mark.thorough
def test_crosstalk_of_a_wide_fan_comes_back() -> None:
    """Beams aside see the ground where the middle ones do not, so what leaks there looks like a wider pattern."""
    sheet = SHEET.replace(beams=96, azimuth_fov_deg=130, crosstalk_db=-30.0)
    frames = drawn(PLACES, 1, 21, sheet=sheet)
    result = calibrate_sonar(frames)
    leak = result.parameters["crosstalk_db"]
    assert leak.determined
    assert leak.value == pytest.approx(-30, abs=1.5)
    assert result.fit.sonar.crosstalk_db == pytest.approx(leak.value, abs=0.01)
    without = calibrate_sonar(frames, crosstalk_db=None)
    assert without.parameters["crosstalk_db"].std == 0
    assert result.held_out is not None
    assert without.held_out is not None
    assert result.held_out["calibrated"][0] > without.held_out["calibrated"][0]
    errors = [
        np.linalg.norm(
            [
                (one.parameters[name].value - true) / one.parameters[name].std
                for name, true in (("elevation_fov_deg", 16.0), ("pitch_deg", 22.5), ("taper_db", 3.0))
            ]
        )
        for one in (result, without)
    ]
    assert errors[0] < 4 < errors[1]


@pytest.mark.thorough
def test_crosstalk_that_level_ground_does_not_show_stays_unknown() -> None:
    """In a narrow fan all beams see the same ground, so leaks look like a higher level."""
    result = calibrate_sonar(drawn(PLACES, 1, 22, sheet=SHEET.replace(crosstalk_db=-40.0)))
    assert not result.parameters["crosstalk_db"].determined
    assert result.fit.sonar.crosstalk_db is None
    assert any("crosstalk_db" in line and "not determined" in line for line in result.lines())
    assert result.parameters["taper_db"].value == pytest.approx(3.0, abs=0.5)


@pytest.mark.thorough
def test_given_values_stay() -> None:
    result = calibrate_sonar(drawn(PLACES, 1, 7), taper_db=3.0, gain_exponent=2, height_m=1.9)
    for name, value in (("taper_db", 3.0), ("range_exponent", 0.0), ("height_m", 1.9)):
        assert (result.parameters[name].value, result.parameters[name].std) == (value, 0.0)
    assert result.fit.sonar.taper_db == 3.0
    assert result.notes == []


@pytest.mark.thorough
def test_absorption_that_the_gain_undoes_is_not_written() -> None:
    """The simulator's gain undoes the sonar's absorption, so it cannot hold another."""
    result = calibrate_sonar(drawn(PLACES, 1, 7), gain_exponent=2, gain_absorption=True)
    assert result.fit.sonar.absorption_db_per_m == SHEET.absorption_db_per_m


@pytest.mark.thorough
def test_one_place_does_not_determine_everything() -> None:
    """Without poses, a height and a width over elevation that are both larger give nearly the same levels."""
    frames = replace(drawn(PLACES[:1], 2, 9), poses=None)
    result = calibrate_sonar(frames)
    assert not result.parameters["elevation_fov_deg"].determined
    assert result.fit.sonar.elevation_fov_deg == SHEET.elevation_fov_deg  # the prior is not written as a result
    note = next(note for note in result.notes if note.startswith("elevation_fov_deg"))
    assert "height_m" in note or "pitch_deg" in note
    for name, value in (("height_m", 1.5), ("pitch_deg", 20.0)):
        assert abs(result.parameters[name].value - value) < 4 * result.parameters[name].std
    assert "gain and reflectivity together" in result.lines()[0]


@pytest.mark.thorough
def test_heights_place_the_ground() -> None:
    """Over ground at z = -3 m, frames that have their heights give what they do over ground at 0."""
    frames = drawn(PLACES, 1, 9)
    assert frames.poses is not None
    lowered = replace(frames, poses=frames.poses - [0, 0, 3, 0, 0, 0], height_m=frames.poses[:, 2])
    one, other = (calibrate_sonar(some).parameters for some in (frames, lowered))
    for name, parameter in one.items():
        assert other[name].value == pytest.approx(parameter.value, abs=0.01 * parameter.std)


def test_a_single_frame_holds_nothing_out() -> None:
    assert calibrate_sonar(drawn(PLACES[:1], 1, 9)).held_out is None


@pytest.mark.slow
@pytest.mark.skipif(not ARIS.exists(), reason="needs the recordings of ../shared/data/real")
def test_an_aris_over_a_bottom(mitsonar: Command, tmp_path: Path) -> None:
    done = mitsonar("sonar", "calibrate", ARIS, "-o", tmp_path / "aris.yaml")
    assert done.returncode == 0, done.stderr
    assert "elevation_fov_deg is not determined" in done.stderr
    assert load_sonar(tmp_path / "aris.yaml").taper_db == pytest.approx(5.4, abs=1.0)


# ---------------- What cannot work


@pytest.mark.thorough
def test_frames_without_ground_are_refused() -> None:
    water = drawn(PLACES, 1, 11)
    image = water.image.copy()
    image[:] = np.random.default_rng(0).exponential(1e-3, image.shape)
    with pytest.raises(MitsonarError, match=r"no ground above the noise|do not show level ground"):
        calibrate_sonar(replace(water, image=image))
    objects = water.image.copy()
    objects *= np.exp(np.random.default_rng(0).normal(0, 2.5, (1, 32, 12))).repeat(8, axis=1).repeat(4, axis=2)
    with pytest.raises(MitsonarError, match="do not show level ground"):
        calibrate_sonar(replace(water, image=(objects / objects.max()).astype(np.float32)))


def test_unusable_frames_are_refused() -> None:
    frames = drawn(PLACES, 1, 11)
    image = frames.image.copy()
    image[0, 0, 0] = np.nan
    with pytest.raises(MitsonarError, match="hold nan or inf"):
        calibrate_sonar(replace(frames, image=image))
    with pytest.raises(MitsonarError, match="needs a pattern over elevation: got elevation_pattern box"):
        calibrate_sonar(frames, elevation_pattern="box")
    for height in (-1.0, np.nan):
        with pytest.raises(MitsonarError, match=f"height must be positive: got {height:g} m"):
            calibrate_sonar(frames, height_m=height)
    bright = np.where(np.random.default_rng(1).random(frames.image.shape) < 0.9, 1.0, frames.image).astype(np.float32)
    with pytest.raises(MitsonarError, match=r"at least 200 blocks of cells with levels: got 0 of .* 100% are clipped"):
        calibrate_sonar(replace(frames, image=bright))


@pytest.mark.thorough
def test_the_command_writes_what_the_simulator_reads(mitsonar: Command, tmp_path: Path) -> None:
    drawn(PLACES, 2, 13).save(tmp_path / "frames.npz")
    out = tmp_path / "sonar.yaml"
    command = ("sonar", "calibrate", tmp_path / "frames.npz", "-o", out, "--set", "absorption_db_per_m=0.5")
    done = mitsonar(*command)
    assert done.returncode == 0, done.stderr
    assert "taper_db" in done.stdout
    assert "absorption_db_per_m     0.5 dB/m given" in done.stdout
    assert "held out, calibrated" in done.stdout
    assert load_sonar(out).taper_db == pytest.approx(3.0, abs=0.5)
    assert load_sonar(out).absorption_db_per_m == 0.5
    before = out.read_bytes()
    refused(mitsonar(*command), "exists", "--overwrite")
    refused(mitsonar(*command, "--overwrite", "--height", "-2"), "height must be positive")
    refused(mitsonar("sonar", "calibrate", tmp_path / "none.npz", "-o", tmp_path / "x.yaml"), "none.npz")
    assert out.read_bytes() == before
