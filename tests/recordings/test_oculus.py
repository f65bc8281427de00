"""Oculus recordings: the real sample, every version, width and coding, dumps against logs, damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recording_files import oculus_log, oculus_ping, other_message, some_pings

from mitsonar import MitsonarError, open_recording
from mitsonar.errors import MitsonarWarning
from mitsonar.estimation.image.direct import Direct
from mitsonar.mapping.sources import open_frames

SAMPLE = Path(__file__).resolve().parents[2].parent / "shared/data/real/oculus-m1200d-three-pings/three_pings_8bit.raw"

with_sample = pytest.mark.skipif(not SAMPLE.exists(), reason="needs the recordings of ../shared/data/real")


@with_sample
def test_the_sample_is_what_its_readme_says() -> None:
    recording = open_recording(SAMPLE)
    assert (len(recording), len(recording.parts)) == (3, 1)
    assert recording.facts["ping_numbers"] == [415323, 415325]
    assert recording.facts["gain_percent"] == 50
    assert recording.facts["gamma"] == 127
    frames = recording.part().read([0, 1, 2])
    assert frames.image.shape == (3, 703, 256)
    assert frames.image.dtype == np.uint8
    assert np.diff(frames.range_m) == pytest.approx(0.002842, abs=5e-7)
    assert frames.sonar.range_max == pytest.approx(1.998, abs=5e-4)
    assert np.degrees(frames.bearing_rad[[0, -1]]) == pytest.approx([-30, 30])
    steps = np.degrees(np.diff(frames.bearing_rad))
    assert steps[0] == pytest.approx(0.26, abs=1e-6)
    assert steps[127] == pytest.approx(0.22, abs=1e-6)
    assert frames.sonar.sound_speed == pytest.approx(1490.66, abs=0.005)
    assert frames.sonar.name == "oculus-m1200d-2100khz"
    assert (frames.level, frames.sonar.coding_gamma) == ("gamma", 0.5)
    flat = frames.image.reshape(3, -1).astype(float)
    pairs = [np.corrcoef(flat[[one, one + 1]])[0, 1] for one in (0, 1)]
    assert pairs == pytest.approx([0.976, 0.974], abs=0.001)


@with_sample
def test_pixels_of_the_sample_are_the_bytes_of_the_file() -> None:
    raw = np.fromfile(SAMPLE, np.uint8).reshape(3, -1)[:, 2048 : 2048 + 703 * 256].reshape(3, 703, 256)
    assert (open_recording(SAMPLE).part().read([0, 1, 2]).image == raw).all()


@with_sample
def test_the_layout_of_the_beams_follows_the_sample() -> None:
    """The sonar's own beams, by layout and field of view, are the ones that the file tells, to the 0.01 deg of its table."""
    frames = open_recording(SAMPLE).part().like
    assert frames.sonar.beam_layout == "sine"
    assert np.degrees(frames.sonar.bearing_rad - frames.bearing_rad) == pytest.approx(0, abs=0.02)


@pytest.mark.thorough
@with_sample
def test_the_sonar_of_the_sample_is_estimated_to_stand_still() -> None:
    with pytest.warns(MitsonarWarning, match="no times in a known unit"):
        source = open_frames(SAMPLE).with_geometry(height_m=0.6, pitch_rad=np.radians(25)).with_contrast()
    for pair in ([0, 1], [1, 2]):
        result = Direct().estimate(source.read(pair))
        assert result.valid
        assert np.abs(result.motion[:2]).max() < 1e-3
        assert abs(result.motion[2]) < np.radians(0.05)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("longer", [0, 24])
def test_a_log_holds_what_the_dump_holds(tmp_path: Path, packed: bool, longer: int) -> None:
    pings = some_pings(4)
    (tmp_path / "a.raw").write_bytes(b"".join(pings))
    times = [1.6e9, 1.6e9 + 0.1, 1.6e9 + 0.3, 1.6e9 + 0.35]
    content = oculus_log(pings, times, packed=packed, header=48 + longer, item=40 + longer)
    (tmp_path / "a.oculus").write_bytes(content)
    dump, log = (open_recording(tmp_path / name) for name in ("a.raw", "a.oculus"))
    assert log.format == "Oculus log (.oculus)"
    assert not log.notes
    every = np.arange(4)
    one, second = dump.part().read(every), log.part().read(every)
    assert (one.image == second.image).all()
    assert (one.range_m == second.range_m).all()
    assert (one.bearing_rad == second.bearing_rad).all()
    assert second.time_s == pytest.approx(times, abs=1e-6)
    assert one.time_s == pytest.approx(np.array([0, 1, 2, 3]) / 10)
    assert "in a known unit" in dump.notes[0]


def test_times_of_a_dump_follow_the_numbers_at_the_ping_rate(tmp_path: Path) -> None:
    counts = np.ones((4, 3), int)
    pings = [oculus_ping(counts, number=number, ping_rate=1) for number in (5, 6, 9)]
    (tmp_path / "a.raw").write_bytes(b"".join(pings))
    recording = open_recording(tmp_path / "a.raw")
    assert recording.part().time_s == pytest.approx(np.array([0, 1, 4]) / 15)
    assert any("missing: 2 frames" in note for note in recording.notes)


@pytest.mark.parametrize("version", [0, 1, 2])
@pytest.mark.parametrize("width", [1, 2, 3, 4])
@pytest.mark.parametrize("gained", [False, True])
def test_every_version_width_and_rows_with_gains(tmp_path: Path, version: int, width: int, gained: bool) -> None:
    rng = np.random.default_rng(width)
    counts = rng.integers(0, 256**width, (2, 6, 5), dtype=np.int64)
    counts[0, 0, 0] = 256**width - 1
    gains = np.array([[100, 400, 900, 1600, 100, 3600], [400, 400, 900, 900, 10_000, 25]])
    pings = [oculus_ping(counts[one], version=version, width=width, gains=gains[one] if gained else None) for one in (0, 1)]
    (tmp_path / "a.raw").write_bytes(other_message() + pings[0] + other_message(0x55, 300) + pings[1])
    content = np.frombuffer(pings[1], np.uint8)
    assert int.from_bytes(content[10:14].tobytes(), "little") + 16 == len(content)
    recording = open_recording(tmp_path / "a.raw")
    frames = recording.part().read([0, 1])
    assert any("2 messages or items of other kinds" in note for note in recording.notes)
    expected = counts / (256.0**width - 1)
    if gained:
        expected = np.minimum(expected * np.sqrt(100 / gains)[:, :, None], 1)
    if width == 1 and not gained:
        assert frames.image.dtype == np.uint8
        assert (frames.image == counts).all()
    else:
        assert frames.image.dtype == np.float32
        assert frames.image == pytest.approx(expected, rel=1e-6, abs=1e-7)
    assert recording.facts["bits"] == 8 * width


def test_attitude_and_times_of_version_2(tmp_path: Path) -> None:
    counts = np.ones((4, 3), int)
    pings = [
        oculus_ping(counts, version=2, number=one, start=100 + one * one, heading=90.0, pitch=10.0, roll=-3.0)
        for one in (1, 2, 3)
    ]
    (tmp_path / "a.raw").write_bytes(b"".join(pings))
    part = open_recording(tmp_path / "a.raw").part()
    assert part.time_s == pytest.approx([101, 104, 109])
    assert part.attitude_rad is not None
    assert np.degrees(part.attitude_rad[0]) == pytest.approx([-10, -3, 90])


@pytest.mark.parametrize(("stops_s", "steady"), [(0.0, True), (5.0, False)])
def test_a_log_of_version_2_has_the_clock_of_the_sonar(tmp_path: Path, stops_s: float, steady: bool) -> None:
    """The log's times jitter by 20 ms, and two of them are equal. Where the clocks part they are taken as they are."""
    start = 50 + np.arange(6) / 10
    late = 1.6e9 + np.array([0.0, 0.02, -0.08, 0.01, 0.0, stops_s])
    pings = [oculus_ping(np.ones((4, 3)), version=2, number=one, start=start[one]) for one in range(6)]
    (tmp_path / "a.oculus").write_bytes(oculus_log(pings, list(start + late), packed=False))
    time_s = open_recording(tmp_path / "a.oculus").part().time_s
    assert time_s == pytest.approx(start + 1.6e9 if steady else np.unique(start + late), abs=0.02 if steady else 1e-6)
    assert (np.diff(time_s) == pytest.approx(0.1, abs=1e-5)) == steady


@pytest.mark.parametrize(("code", "gamma"), [(0, 1.0), (255, 1.0), (127, 0.5), (64, 64 / 254)])
def test_levels_follow_the_gamma_byte(tmp_path: Path, code: int, gamma: float) -> None:
    counts = np.array([[255, 128, 64]] * 2)
    (tmp_path / "a.raw").write_bytes(oculus_ping(counts, gamma=code))
    recording = open_recording(tmp_path / "a.raw")
    level = recording.part().read([0]).to_linear().image[0, 0]
    assert level == pytest.approx((np.array([255, 128, 64]) / 255) ** (2 / gamma), rel=1e-5)
    assert any("gamma byte" in note for note in recording.notes) == (code == 64)


@pytest.mark.parametrize(
    ("frequency", "name", "elevation"),
    [(2.1e6, "oculus-m1200d-2100khz", 12), (1.2e6, "oculus-m1200d-1200khz", 20), (750e3, "oculus-m750d-750khz", 20)],
)
def test_the_carrier_names_the_preset(tmp_path: Path, frequency: float, name: str, elevation: float) -> None:
    (tmp_path / "a.raw").write_bytes(oculus_ping(np.ones((4, 3)), frequency=frequency))
    sonar = open_recording(tmp_path / "a.raw").part().like.sonar
    assert (sonar.name, sonar.elevation_fov_deg, sonar.frequency_hz) == (name, elevation, frequency)
    assert sonar.vertical_pattern == "two_way"


def test_a_carrier_of_no_preset_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.raw").write_bytes(oculus_ping(np.ones((4, 3)), frequency=375e3))
    recording = open_recording(tmp_path / "a.raw")
    assert any("no preset has this carrier" in note for note in recording.notes)
    assert recording.part().like.sonar.name == "oculus"


def test_windows_and_beams_that_change_make_parts(tmp_path: Path) -> None:
    counts = np.ones((4, 3), int)
    steps = (0.003, 0.003 * 1.0005, 0.006, 0.006)
    pings = [oculus_ping(counts, number=one, resolution=step) for one, step in enumerate(steps)]
    pings.append(oculus_ping(counts, number=4, resolution=0.006, bearings=np.array([-1000, 0, 2000])))
    (tmp_path / "a.raw").write_bytes(b"".join(pings))
    recording = open_recording(tmp_path / "a.raw")
    assert [len(part) for part in recording.parts] == [2, 2, 1]
    assert np.degrees(recording.parts[2].like.bearing_rad) == pytest.approx([-10, 0, 20])
    assert recording.parts[1].like.sonar.range_max == pytest.approx(0.024)


def test_beams_that_fall_are_turned(tmp_path: Path) -> None:
    counts = np.arange(12).reshape(4, 3)
    (tmp_path / "a.raw").write_bytes(oculus_ping(counts, bearings=np.array([2000, 0, -1000])))
    frames = open_recording(tmp_path / "a.raw").part().read([0])
    assert np.degrees(frames.bearing_rad) == pytest.approx([-10, 0, 20])
    assert (frames.image[0] == counts[:, ::-1]).all()


def test_damage_is_passed_over_and_said(tmp_path: Path) -> None:
    first, second, third, fourth = some_pings(4)
    second = second[:150] + second[160:]  # ten bytes lost on the way
    (tmp_path / "a.raw").write_bytes(first + second + third + fourth[:-5])
    recording = open_recording(tmp_path / "a.raw")
    assert len(recording) >= 1
    assert any("not a complete message" in note for note in recording.notes)
    (tmp_path / "one.raw").write_bytes(first)
    one = open_recording(tmp_path / "one.raw").part().read([0])
    assert (recording.part().read([0]).image == one.image).all()


def test_a_log_passes_over_what_is_between_items(tmp_path: Path) -> None:
    pings = some_pings(2)
    log = oculus_log(pings, [1.0, 2.0], packed=True)
    second = log.rindex(b"\xdd\xcc\xbb\xaa")
    (tmp_path / "a.oculus").write_bytes(log[:second] + b"what is this" + log[second:])
    recording = open_recording(tmp_path / "a.oculus")
    assert len(recording) == 2
    assert recording.notes == ("12 bytes are not a complete message and are left out",)


def test_packed_bytes_that_are_damaged_are_one_sentence(tmp_path: Path) -> None:
    log = bytearray(oculus_log(some_pings(1), [1.0], packed=True))
    log[-1] ^= 1  # of the checksum
    (tmp_path / "a.oculus").write_bytes(log)
    part = open_recording(tmp_path / "a.oculus").part()
    with pytest.raises(MitsonarError, match="cannot be unpacked"):
        part.read([0])


def test_an_encrypted_log_is_refused(tmp_path: Path) -> None:
    log = bytearray(oculus_log(some_pings(1), [1.0], packed=False))
    log[26] = 1
    (tmp_path / "a.oculus").write_bytes(log)
    with pytest.raises(MitsonarError, match="encrypted"):
        open_recording(tmp_path / "a.oculus")


def test_a_log_of_viewpoint_2_is_refused(tmp_path: Path) -> None:
    for name, reason in (("a.oculus", "ViewPoint 2"), ("a.db3", "not a database")):
        (tmp_path / name).write_bytes(b"SQLite format 3\0".ljust(4096, b"\0"))
        with pytest.raises(MitsonarError, match=reason):
            open_recording(tmp_path / name)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "is not a recording"),
        (b"SOS", "is not a recording"),
        (other_message(), "holds no ping"),
        (oculus_ping(np.ones((4, 3)), resolution=np.nan), "left out: 1 damaged ping"),
        (oculus_ping(np.ones((4, 3)), ranges=60_000), "left out: 1 damaged ping"),
        (oculus_ping(np.ones((4, 3)), bearings=np.array([0, 0, 1])), "left out: 1 damaged ping"),
        (b"\x44\x33\x22\x11", "cut off"),
    ],
)
def test_other_files_are_refused_in_one_sentence(tmp_path: Path, content: bytes, reason: str) -> None:
    (tmp_path / "a.raw").write_bytes(content)
    with pytest.raises(MitsonarError, match=reason):
        open_recording(tmp_path / "a.raw")
