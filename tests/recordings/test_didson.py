"""DIDSON files, written by the tests after the format's description: every window rule, beams, handedness, times, damage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_files import didson_file

from mitsonar import MitsonarError, open_recording
from mitsonar.recordings.recording import Recording
from mitsonar.recordings.sound_metrics import aris_bearings, didson_bearings, nominal_window

IMAGES = np.random.default_rng(2).integers(0, 256, (6, 32, 96))


def opened(folder: Path, images: np.ndarray[Any, Any] = IMAGES, **told: Any) -> Recording:
    (folder / "a.ddf").write_bytes(didson_file(images, **told))
    return open_recording(folder / "a.ddf")


@pytest.mark.parametrize(("version", "header"), [(3, 512), (4, 1024), (4, 512)])
@pytest.mark.parametrize("beams", [48, 96])
def test_pixels_times_and_handedness(tmp_path: Path, version: int, header: int, beams: int) -> None:
    images = IMAGES[:, :, :beams]
    recording = opened(tmp_path, images, version=version, header=header)
    frames = recording.part().read(np.arange(6))
    assert (frames.image == images[:, :, ::-1]).all()  # beam 0 is the one most to starboard
    assert (np.diff(frames.bearing_rad) > 0).all()
    assert frames.time_s == pytest.approx(1275609598 + np.arange(6) * 0.12, abs=1e-6)  # 2010-06-03 23:59:58
    assert (frames.level, frames.sonar.coding_db) == ("dB", 90.0)
    assert frames.sonar.frequency_hz == (1.8e6 if beams == 96 else 1.1e6)
    assert recording.format == f"DIDSON {version} (.ddf)"
    flipped = opened(tmp_path, images, version=version, header=header, file={"reverse": 1})
    assert (flipped.part().read([3]).image[0] == images[3]).all()


@pytest.mark.parametrize("high", [True, False])
@pytest.mark.parametrize("config", [0, 1, 2, 3])
@pytest.mark.parametrize("code", [0, 1, 2, 3])
def test_windows_follow_their_codes(tmp_path: Path, high: bool, config: int, code: int) -> None:
    """A sample rate that fits the table makes timing and nominal window agree to the 5 % of their different steps."""
    images = IMAGES[:2] if high else IMAGES[:2, :, :48]
    length = nominal_window(0, code, config, high=high)[1]
    first = {"sample_rate_hz": 32 * 1500 / (2 * length), "length_code": code, "high_frequency": int(high)}
    recording = opened(tmp_path, images, file=first, config=config, length_code=code, start_code=10)
    like = recording.part().like
    delay = 0.572e-3 * (1 if high else 2)
    start = 10 * delay * 1500 / 2
    assert like.sonar.range_min == pytest.approx(start)
    assert like.sonar.range_max - like.sonar.range_min == pytest.approx(length)
    assert like.range_m == pytest.approx(start + (np.arange(32) + 0.5) * length / 32)
    assert nominal_window(10, code, config, high=high)[0] == pytest.approx(start, rel=0.13)
    assert like.sonar.name == ("didson-lr" if config & 2 else "didson")


def test_nominal_windows_are_those_of_the_tables() -> None:
    assert [nominal_window(0, code, 0, high=True)[1] for code in range(4)] == [1.25, 2.5, 5, 10]
    assert [nominal_window(0, code, 1, high=False)[1] for code in range(4)] == [4.5, 9, 18, 36]
    assert [nominal_window(0, code, 3, high=False)[1] for code in range(4)] == [9, 18, 36, 72]
    assert nominal_window(2, 0, 1, high=True)[0] == 0.75
    assert nominal_window(2, 0, 2, high=False)[0] == pytest.approx(1.68)


@pytest.mark.parametrize(
    ("serial", "system", "windows", "delay"),
    [
        (200, "DIDSON-S", "extended", 0.572e-3),
        (19, "DIDSON-S", "extended", 0.572e-3),
        (18, "DIDSON-S", "classic", 0.512e-3),
        (15, "DIDSON-LR", "classic", 0.512e-3),
    ],
)
def test_serial_numbers_override_the_configuration(
    tmp_path: Path, serial: int, system: str, windows: str, delay: float
) -> None:
    recording = opened(tmp_path, file={"serial": serial})
    assert recording.facts["system"] == system
    assert recording.facts["windows"] == windows
    assert recording.part().like.sonar.range_min == pytest.approx(4 * delay * 1500 / 2)


def test_windows_that_change_inside_the_file_make_parts(tmp_path: Path) -> None:
    starts, lengths = np.array([4, 4, 4, 6, 6, 6]), np.array([3, 3, 2, 2, 2, 2])
    recording = opened(tmp_path, start_code=starts, length_code=lengths)
    assert [len(part) for part in recording.parts] == [2, 1, 3]
    first, second, third = (part.like.sonar for part in recording.parts)
    assert first.range_max - first.range_min == pytest.approx(10)
    assert second.range_max - second.range_min == pytest.approx(5)
    assert third.range_min == pytest.approx(first.range_min * 1.5)
    assert (recording.parts[2].read([1]).image[0] == IMAGES[4, :, ::-1]).all()


@pytest.mark.parametrize("version", [3, 4])
def test_the_sound_speed_of_the_file_scales_the_window(tmp_path: Path, version: int) -> None:
    untold = opened(tmp_path, version=version)
    assert any("no sound speed" in note for note in untold.notes)
    (tmp_path / "b.ddf").write_bytes(didson_file(IMAGES, version=version, file={"sound_speed": 1450}))
    slower = open_recording(tmp_path / "b.ddf")
    assert not slower.notes
    assert slower.part().like.range_m == pytest.approx(untold.part().like.range_m * 1450 / 1500)


def test_a_sample_rate_that_is_missing_or_strange_is_said(tmp_path: Path) -> None:
    missing = opened(tmp_path, file={"sample_rate_hz": 0.0})
    assert any("no sample rate" in note for note in missing.notes)
    assert missing.part().like.sonar.range_max - missing.part().like.sonar.range_min == pytest.approx(10)
    strange = opened(tmp_path, file={"sample_rate_hz": 5000.0})
    assert any("the timing is used" in note for note in strange.notes)


@pytest.mark.parametrize(("beams", "steps"), [(96, (0.220, 0.368)), (48, (0.449, 0.748))])
def test_beams_of_the_lens_are_uneven_as_those_of_the_aris_1800(beams: int, steps: tuple[float, float]) -> None:
    bearings = np.degrees(didson_bearings(beams))
    assert bearings == pytest.approx(-bearings[::-1], abs=1e-3)
    result = np.diff(bearings)
    assert (result[0], result[beams // 2]) == pytest.approx(steps, abs=2e-3)
    assert bearings[-1] + result[-1] / 2 == pytest.approx(14.4, abs=0.15)
    measured = np.degrees(aris_bearings("1800", beams))
    scale = measured[-1] / bearings[-1]
    even = (np.arange(beams) - (beams - 1) / 2) * 2 * measured[-1] / (beams - 1)
    assert np.std(bearings * scale - measured) < 0.5 * np.std(even - measured)


def test_frames_without_a_clock_follow_the_frame_rate(tmp_path: Path) -> None:
    recording = opened(tmp_path, year=0)
    assert recording.part().time_s == pytest.approx(np.arange(6) / 8)
    assert any("8 Hz" in note for note in recording.notes)


def test_frames_of_one_time_are_spread_up_to_the_next(tmp_path: Path) -> None:
    """A clock of whole seconds, 3 frames a second, the last second cut off: 8 frames a second are stated."""
    recording = opened(tmp_path, second=np.array([5, 5, 5, 6, 6, 9]), hundredth=0)
    time_s = recording.part().time_s
    assert time_s - time_s[0] == pytest.approx([0, 1 / 3, 2 / 3, 1, 1 + 1 / 8, 4])
    assert any("3 frames with the time of the one before" in note for note in recording.notes)


def test_attitude_and_height(tmp_path: Path) -> None:
    part = opened(tmp_path, pitch_deg=-20.0, heading_deg=350.0, altitude_m=2.5).part()
    assert part.attitude_rad is not None
    assert np.degrees(part.attitude_rad[0]) == pytest.approx([20, 0, 350])
    assert part.height_m is not None
    assert part.height_m == pytest.approx(2.5)


def test_damaged_frames_are_left_out(tmp_path: Path) -> None:
    content = didson_file(IMAGES, start_code=np.array([4, 4, 99, 4, 4, 4]))
    (tmp_path / "a.ddf").write_bytes(content[:-7])
    recording = open_recording(tmp_path / "a.ddf")
    assert len(recording) == 4
    assert any("left out: 1 frame with a damaged header" in note for note in recording.notes)
    assert any("not a complete frame" in note for note in recording.notes)
    assert any("missing: 1 frame" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"DDF\x03", "cut off"),
        (b"DDF\x03".ljust(2000, b"\0"), "0 beams"),
        (didson_file(IMAGES)[:600], "no complete frame"),
        (didson_file(IMAGES, version=4, header=900), "no frame begins"),
        (didson_file(IMAGES, file={"samples": 2**31}), "the file is damaged"),
        (didson_file(IMAGES, file={"beams": 97}), "97 beams"),
        (didson_file(IMAGES, start_code=32), "no frame that can be read"),
    ],
)
def test_other_files_are_refused_in_one_sentence(tmp_path: Path, content: bytes, reason: str) -> None:
    (tmp_path / "a.ddf").write_bytes(content)
    with pytest.raises(MitsonarError, match=reason):
        open_recording(tmp_path / "a.ddf")
