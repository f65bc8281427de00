"""A sonar is fitted to what a simulated one recorded: what was put in must come out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Array, Command, diffuse, essence, floor, refused, scene, sphere

from mitsonar.errors import MitsonarError
from mitsonar.estimation.sonar_fit import fit_sonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.records.frames import SonarFrames

PLAIN = Sonar.create(model="coherent", frequency_hz=1.8e6, range_min=1.4, range_max=5.6, bearing="cone", gain_exponent=2,
                     beam_width_deg=0.3, absorption_db_per_m=0.0)  # fmt: skip

FITTED = {"looks": 1, "noise_level_db": None, "stripes_db": 0.0, "group_stripes_db": 0.0, "crosstalk_db": None,
          "speckle_nu": None, "near_glow_db": 0.0, "volume_db": None}  # fmt: skip


class Made(dict[str, SonarFrames]):
    """Six frames over a floor behind a buoy, black water before it; the sonar that frames state is plain. By the names of
    :data:`TRUE`, made when they are asked for."""

    def __missing__(self, name: str) -> SonarFrames:
        import warnings

        from mitsonar.errors import MitsonarWarning
        from mitsonar.simulation.simulator import Simulator

        loaded = scene(floor=floor(diffuse(0.3)), buoy=sphere((0.15, 1.75, 1.27), 0.06, diffuse(1.0)))
        poses = np.array([0, 0, 2.5, math.radians(35), 0, 0]) + np.arange(6)[:, None] * np.array([0.06, 0.02, 0, 0, 0, 0])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MitsonarWarning)
            frames = Simulator(loaded, PLAIN.replace(**TRUE[name])).render(poses)
        frames.sonar = frames.sonar.replace(**FITTED)
        self[name] = frames
        return frames


@pytest.fixture(scope="module")
def recordings(variant: str) -> Made:
    """Simulated recordings by name."""
    return Made()


TRUE: dict[str, dict[str, Any]] = {
    "dB": {"noise_level_db": -98.0, "stripes_db": 0.5, "crosstalk_db": -45.0, "speckle_nu": 2.0},
    "70 dB": {"noise_level_db": -102.0, "stripes_db": 1.0, "crosstalk_db": -50.0, "speckle_nu": 1.0, "coding_db": 70.0},
    "gamma": {"noise_level_db": -95.0, "stripes_db": 0.3, "coding": "gamma", "coding_gamma": 0.5},
    "groups": {"noise_level_db": -98.0, "stripes_db": 0.3, "group_stripes_db": 0.9, "ping_groups": 8},
    "unstated groups": {"noise_level_db": -98.0, "crosstalk_db": -30.0, "ping_groups": 8},
    "two looks": {"noise_level_db": -98.0, "looks": 2, "speckle_nu": 2.0},
    "linear": {"noise_level_db": -98.0, "coding": "linear", "absorption_db_per_m": 0.5, "gain_absorption": True},
}


def stripes(sonar: Sonar, spread: float) -> float:
    """The spread that the gains drawn from the seed do have."""
    return float(np.random.default_rng([sonar.seed, 0x57121]).normal(0, spread, sonar.beams).std())


def group_stripes(sonar: Sonar, spread: float) -> float:
    """As :func:`stripes`, of ping groups."""
    return float(np.random.default_rng([sonar.seed, 0x67726F75]).normal(0, spread, sonar.ping_groups).std())


@pytest.mark.thorough
@pytest.mark.parametrize("name", essence([name for name in TRUE if name != "unstated groups"], "dB"))
def test_what_was_put_in_comes_out(recordings: dict[str, SonarFrames], name: str) -> None:
    result, true = fit_sonar(recordings[name]), TRUE[name]
    sonar = result.sonar
    assert sonar.noise_level_db == pytest.approx(true["noise_level_db"], abs=1.0)
    assert sonar.stripes_db == pytest.approx(stripes(sonar, true.get("stripes_db", 0.0)), abs=0.15)
    assert sonar.group_stripes_db == pytest.approx(group_stripes(sonar, true.get("group_stripes_db", 0.0)), abs=0.15)
    if "crosstalk_db" in true:
        assert sonar.crosstalk_db == pytest.approx(true["crosstalk_db"], abs=3.5)
    else:  # the few beams of a ping group can be lifted by side lobes
        assert sonar.crosstalk_db is None or (sonar.ping_groups > 1 and sonar.crosstalk_db < -40)
    if "speckle_nu" in true:
        assert sonar.speckle_nu == pytest.approx(true["speckle_nu"], rel=0.3)
    else:
        assert sonar.speckle_nu is None or sonar.speckle_nu > 15
    assert sonar.near_glow_db == 0
    assert sonar.volume_db is None
    assert np.abs(result.glow_db[2:]).max() < 4
    assert result.bright_db == pytest.approx(10 * math.log10(0.9), abs=0.5)
    assert result.noise_db is not None
    assert -50 < result.noise_db < -25
    assert sonar.looks == true.get("looks", 1)
    assert result.notes == [] or (sonar.looks > 1 and "several looks" in result.notes[0])


@pytest.mark.thorough
def test_the_grain_tells_the_coding(recordings: dict[str, SonarFrames]) -> None:
    """Frames that state another coding than theirs."""
    frames = recordings["70 dB"].select(slice(None))
    frames.sonar = frames.sonar.replace(coding_db=90.0)
    stated, measured = fit_sonar(frames), fit_sonar(frames, measure_coding=True)
    assert stated.sonar.coding_db == 90
    assert "but the frames state 90" in stated.notes[0]
    assert measured.sonar.coding_db == pytest.approx(70, rel=0.08)
    gamma = recordings["gamma"].select(slice(None))
    gamma.sonar = gamma.sonar.replace(coding_gamma=1.0)
    assert fit_sonar(gamma, measure_coding=True).sonar.coding_gamma == pytest.approx(0.5, abs=0.05)
    assert fit_sonar(recordings["linear"]).speckle_gamma == pytest.approx(2, abs=0.15)


def test_clipped_frames_have_no_coding(recordings: dict[str, SonarFrames]) -> None:
    """The darkest two thirds of the cells become 0."""
    frames = recordings["70 dB"].select(slice(None))
    frames.image = np.where(frames.image > np.percentile(frames.image, 66), frames.image, 0)
    result = fit_sonar(frames)
    assert result.speckle_span_db is None
    assert "66 % of the cells have the smallest or the largest value" in result.notes[0]
    assert any("none, since the frames are clipped" in line for line in result.lines())
    assert not any("the grain suggests" in note for note in result.notes)


def test_eight_bit_and_a_named_sonar_do(recordings: dict[str, SonarFrames]) -> None:
    """Counts of uint8; what the frames do not tell comes from the preset, the window from the frames."""
    frames = recordings["dB"].select(slice(None))
    frames.image = np.rint(frames.image * 255).astype(np.uint8)
    result = fit_sonar(frames, load_sonar("aris3000"), frequency_hz=3e6, beam_width_deg=0.3)
    assert result.sonar.frequency_hz == 3e6
    assert (result.sonar.beams, result.sonar.range_min, result.sonar.name) == (96, 1.4, "aris3000")
    assert result.sonar.noise_level_db == pytest.approx(-98, abs=1.0)


def test_a_recording_without_scale_gets_one(recordings: dict[str, SonarFrames]) -> None:
    frames = recordings["dB"].select(slice(None))
    frames.level_scale = 1.0
    result = fit_sonar(frames)
    assert "levels have no scale" in result.notes[0]
    assert result.sonar.noise_level_db == pytest.approx(-98, abs=15)  # a reflectivity is assumed


def test_noise_that_does_not_show_is_not_invented(recordings: dict[str, SonarFrames]) -> None:
    frames = recordings["dB"].select(slice(None))
    still = frames.select(np.zeros(3, dtype=int))
    assert "it is not noise" in fit_sonar(still).notes[0]
    assert fit_sonar(still).sonar.noise_level_db is None
    frames.image = np.where(frames.image < 0.6, 0, frames.image).astype(np.float32)
    assert any("below the lowest level" in note for note in fit_sonar(frames).notes)


RESOLUTIONS = [(2.2, 1.2, 1, "dB"), (1.3, 0.9, 2, "dB"), (1.0, 1.6, 3, "dB"), (1.8, 1.3, 1, "gamma")]


@pytest.mark.usefixtures("variant")
@pytest.mark.filterwarnings("ignore:no ray hit")
@pytest.mark.parametrize(("bins", "beams", "looks", "coding"), essence(RESOLUTIONS, RESOLUTIONS[1]))
def test_noise_gives_pulse_beam_width_and_looks(bins: float, beams: float, looks: int, coding: str) -> None:
    """Of frames that hold noise alone: both resolutions within a tenth, looks exactly; those that are given are kept."""
    from mitsonar.simulation.simulator import Simulator

    spacing_deg = math.degrees(PLAIN.beam_spacing_rad)
    sonar = PLAIN.replace(noise_level_db=-70.0, pulse_m=bins * PLAIN.bin_m, beam_width_deg=beams * spacing_deg, looks=looks)
    sonar = sonar.replace(coding=coding, gain_exponent=0)
    frames = Simulator(scene(floor=floor(diffuse(0.3))), sonar).render(np.array([[0, 0, 50.0, 0, 0, 0]] * 3))
    frames.sonar = PLAIN.replace(coding=coding, gain_exponent=0)
    fit = fit_sonar(frames).sonar
    assert fit.looks == looks
    assert fit.pulse_m == pytest.approx(sonar.pulse_m, rel=0.12)
    assert fit.beam_width_deg == pytest.approx(sonar.beam_width_deg, rel=0.1)
    known = fit_sonar(frames, pulse_m=0.02, beam_width_deg=0.5, looks=2).sonar
    assert (known.pulse_m, known.beam_width_deg, known.looks) == (0.02, 0.5, 2)


OFFSETS = [(1, -10.0), (1, -3.0), (2, -5.0), (2, None), (3, -8.0)]


@pytest.mark.usefixtures("variant")
@pytest.mark.filterwarnings("ignore:no ray hit")
@pytest.mark.parametrize(("looks", "offset_db"), essence(OFFSETS, OFFSETS[2]))
def test_dark_noise_gives_the_offset_of_the_detector(looks: int, offset_db: float | None) -> None:
    """Noise within 1 dB, offset within 2 dB, and looks in spite of it."""
    from mitsonar.simulation.simulator import Simulator

    sonar = PLAIN.replace(noise_level_db=-70.0, pulse_m=1.2 * PLAIN.bin_m, looks=looks, gain_exponent=0)
    sonar = sonar.replace(detector_offset_db=None if offset_db is None else -70.0 + offset_db)
    frames = Simulator(scene(floor=floor(diffuse(0.3))), sonar).render(np.array([[0, 0, 50.0, 0, 0, 0]] * 3))
    frames.sonar = PLAIN.replace(gain_exponent=0)
    fit = fit_sonar(frames).sonar
    assert fit.looks == looks
    assert fit.noise_level_db == pytest.approx(-70, abs=1.0)
    if offset_db is None:
        assert fit.detector_offset_db is None
    else:
        assert fit.detector_offset_db == pytest.approx(-70 + offset_db, abs=2.0)


def test_beams_of_different_pings_are_noted() -> None:
    """Noise that neighbouring beams do not share at all is no narrow beam: the width stays, and a note asks for groups."""
    level = np.random.default_rng(2).gumbel(size=(3, 256, 48)) * -4.34
    level = level + 0.05 * np.roll(level, 1, axis=2)
    sonar = Sonar.create(beams=48, range_bins=256, coding="dB", coding_db=80.0)
    frames = SonarFrames(level / 80 + 0.5, sonar.range_m, sonar.bearing_rad, np.arange(3.0), sonar, level="dB")
    fit = fit_sonar(frames, frequency_hz=1.8e6, looks=1)
    assert fit.sonar.beam_width_deg == frames.sonar.beam_width_deg
    assert any("beams correlates by 0.0" in note and "ping_groups" in note for note in fit.notes)


@pytest.mark.thorough
def test_unstated_ping_groups(recordings: dict[str, SonarFrames]) -> None:
    frames = recordings["unstated groups"].select(slice(None))
    grouped = frames.sonar
    frames.sonar = grouped.replace(ping_groups=1)
    fit = fit_sonar(frames)
    assert fit.sonar.ping_groups == 8
    assert "beams 8 apart share what leaks from one to another" in fit.notes[0]
    assert fit_sonar(frames, ping_groups=1).sonar.ping_groups == 1
    frames.sonar = grouped
    base = Sonar.create(model="coherent", frequency_hz=1.8e6, bearing="cone")
    assert fit_sonar(frames, base).sonar.ping_groups == 8  # the recording states it, the base does not


def test_crosstalk_shows_in_the_group_of_a_narrow_target() -> None:
    """A target one beam wide: seven of eight groups have no strong echo, and nothing to say about the leak."""
    sonar = Sonar.create(beams=96, range_bins=400, ping_groups=8)
    rng = np.random.default_rng(0)
    echo, group = rng.exponential(size=(4, 400, 96)), np.arange(96) % 8
    strong = 1e5 * (1 + 3 * rng.exponential(size=(4, 16)))
    echo[:, 40:360:20, 43] += strong
    echo[:, 40:360:20, group == 3] += 10**-4.5 * strong[..., None] * rng.exponential(size=(4, 16, 12))
    frames = SonarFrames((echo / echo.max()).astype(np.float32), sonar.range_m, sonar.bearing_rad, np.arange(4.0), sonar)
    assert fit_sonar(frames, frequency_hz=1.8e6).sonar.crosstalk_db == pytest.approx(-45, abs=2)


def blank(bins: int = 128, beams: int = 32, value: Array | float = 0.5) -> SonarFrames:
    sonar = Sonar.create(beams=beams, range_bins=bins)
    image = np.zeros((2, bins, beams), np.float32) + np.float32(value)
    return SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.arange(2.0), sonar)


def test_one_small_frame_is_not_called_clipped() -> None:
    sonar = Sonar.create(beams=16, range_bins=96, coding="dB")
    level = 10 * np.log10(np.random.default_rng(2).exponential(size=(1, 96, 16))) / 80 + 0.6
    fit = fit_sonar(SonarFrames(level, sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar, level="dB"), frequency_hz=1.8e6)
    assert fit.speckle_span_db == pytest.approx(80, rel=0.2)
    assert not any("clipped" in one for one in (*fit.notes, *fit.lines()))


def test_known_fields_are_not_fitted() -> None:
    sonar = Sonar.create(beams=16, range_bins=96, frequency_hz=1.8e6, coding="linear")
    level = 0.01 * np.random.default_rng(2).exponential(size=(1, 96, 16))
    known: dict[str, Any] = {"noise_level_db": -50.0, "stripes_db": 1.5, "speckle_nu": 3.0, "near_glow_db": 5.0}
    fit = fit_sonar(SonarFrames(level, sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar), **known).sonar
    assert {name: getattr(fit, name) for name in known} == known


def test_frames_that_tell_nothing_are_refused() -> None:
    with pytest.raises(MitsonarError, match="at least one frame of 96 bins x 16 beams: got 2 of 64 x 32"):
        fit_sonar(blank(bins=64))
    with pytest.raises(MitsonarError, match="all cells have the same value"):
        fit_sonar(blank())
    varied = np.random.default_rng(0).exponential(0.05, (2, 128, 32)).clip(0, 1)
    with pytest.raises(MitsonarError, match="needs the carrier: give frequency_hz"):
        fit_sonar(blank(value=varied))
    varied[1, 40, 7] = np.nan
    with pytest.raises(MitsonarError, match="needs finite levels: the frames hold nan or inf"):
        fit_sonar(blank(value=varied), frequency_hz=1.8e6)


def test_the_command_writes_what_the_simulator_reads(
    recordings: dict[str, SonarFrames], mitsonar: Command, tmp_path: Path
) -> None:
    recordings["dB"].save(tmp_path / "frames.npz")
    done = mitsonar("sonar", "fit", tmp_path / "frames.npz", "-o", tmp_path / "mine.yaml", "--set", "focus_m=4")
    assert done.returncode == 0, done.stderr
    assert "crosstalk_db" in done.stdout
    assert "--sonar" in done.stdout
    read = load_sonar(tmp_path / "mine.yaml")
    assert read == fit_sonar(recordings["dB"], focus_m=4).sonar.replace(name=read.name)
    refused(mitsonar("sonar", "fit", tmp_path / "frames.npz", "-o", tmp_path / "mine.yaml"), "exists", "--overwrite")
    refused(mitsonar("sonar", "fit", tmp_path / "none.npz", "-o", tmp_path / "x.yaml"), "no such file: ")
    blank().save(tmp_path / "flat.npz")
    carrier = ("--set", "frequency_hz=1.8e6")
    refused(mitsonar("sonar", "fit", tmp_path / "flat.npz", "-o", tmp_path / "x.yaml", *carrier), "all cells have the same")
