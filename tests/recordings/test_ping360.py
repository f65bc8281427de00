"""Ping360: logs of Ping Viewer, text and CSV of ``brping``; sweeps of the head, their times, damaged messages."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
from recording_files import head_sweeps, ping360_message, ping360_text, ping_message, ping_viewer_log

from mitsonar import MitsonarError, open_recording
from mitsonar.geometry.fan import cartesian_map
from mitsonar.instruments.sonar import ping_interval_s, scans
from mitsonar.mapping.sources import recording_at
from mitsonar.recordings.pictures import write_frames
from mitsonar.recordings.recording import Recording

REAL = Path(__file__).resolve().parents[2].parent / "shared/data/real"
DECODED = REAL / "ping360-log/test_ping_log.decoded"
CSV = REAL / "ping360-objects/2024-03-13_15-50-16Gain_0.csv"

with_samples = pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of ../shared/data/real")

SECTOR = [*range(180, 221), *range(219, 180, -1), *range(180, 221), *range(219, 199, -1)]
"""A head that goes to and fro over 41 steps: two whole sweeps, a third, and half of a fourth."""

ROUND = [*range(380, 400), *range(0, 400), *range(0, 300)]
"""A head that goes round: 20 steps to the rear, a full turn, three quarters of the next."""


def log(path: Path, angles: list[int], interval_s: float = 0.05, **fields: int) -> Path:
    messages = [ping360_message(one, angle, **fields) for one, angle in zip(head_sweeps(angles), angles, strict=True)]
    path.write_bytes(ping_viewer_log(messages, [interval_s * one for one in range(len(angles))]))
    return path


def note_of(recording: Recording, word: str) -> str:
    return next(note for note in recording.notes if word in note)


# ---------------------------------------------------------------- real recordings

Parsed: TypeAlias = tuple[bytes, int, dict[str, int], int, int]
"""Samples, angle, other fields, mode and printed checksum of a message."""


def parsed(path: Path) -> list[Parsed]:
    """The messages of a text, read line by line."""
    names = ("gain_setting", "transmit_duration", "sample_period", "transmit_frequency")
    result: list[Parsed] = []
    values: dict[str, str] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        name, colon, value = line.strip(" -").partition(": ")
        if colon:
            values[name] = value
        if name == "Checksum":
            samples = bytes(int(word.strip("' "), 16) for word in values["data"].strip("[]").split(","))
            fields = {name: int(values[name]) for name in names}
            result.append((samples, int(values["angle"]), fields, int(values["mode"]), int(value.split()[0])))
    return result


@with_samples
def test_the_log_is_what_its_readme_says() -> None:
    """100 pings to and fro, one of them of 2 samples: two sweeps of 51 steps, mostly 33 ms a ping, 38 ms in the mean."""
    recording = open_recording(DECODED)
    assert (len(recording), len(recording.parts), recording.facts["pings"]) == (2, 1, 100)
    frames = recording.part().read([0, 1])
    assert frames.image.shape == (2, 1200, 51)
    assert np.degrees(frames.bearing_rad) == pytest.approx(0.9 * np.arange(1, 52))
    assert frames.range_m == pytest.approx((np.arange(1200) + 0.5) * 88 * 25e-9 * 750)
    assert frames.sonar.frequency_hz == 750e3
    assert ping_interval_s(frames.sonar) == pytest.approx(0.033, abs=0.001)
    assert np.diff(open_recording(DECODED).part().time_s) / 51 == pytest.approx(0.039, abs=0.002)
    rows = [[int(word, 16) for word in line.split()] for line in (DECODED.parent / "data.dat").read_text().splitlines()]
    assert (frames.image[0, :, 0] == rows[0]).all()
    assert not frames.image[0, :, 1].any()  # the ping of 2 samples
    assert np.array_equal(frames.image[0, :, 2:].T, rows[2:51])
    assert np.array_equal(frames.image[1, :, :0:-1].T, rows[50:])  # back, from the same last ping
    assert frames.time_s.shape == (2, 51)
    assert frames.time_s[0, [0, 50]] == pytest.approx([2.103, 4.080], abs=0.2)
    assert (np.diff(frames.time_s[0]) > 0).all()
    assert (np.diff(frames.time_s[1, 1:]) < 0).all()
    assert "1 ping with another window" in note_of(recording, "another window")
    assert "2 of 2 sweeps" in note_of(recording, "incomplete")


@with_samples
def test_walls_of_the_tank_are_straight() -> None:
    """A wall that is straight in metres shows that ranges and angles fit together, whatever the sound speed."""
    part = open_recording(CSV).part()
    assert "no times" in note_of(open_recording(CSV), "no times")
    frames = part.read([0])
    assert np.degrees(frames.bearing_rad) == pytest.approx(np.linspace(-45, 45, 101))
    level = frames.in_decibels()[0]
    chosen = (np.degrees(frames.bearing_rad) > 28) & (np.degrees(frames.bearing_rad) < 42)
    rows = (frames.range_m > 0.45) & (frames.range_m < 0.9)
    strongest = frames.range_m[rows][level[rows][:, chosen].argmax(axis=0)]
    starboard = strongest * np.sin(frames.bearing_rad[chosen])
    assert np.median(starboard) == pytest.approx(0.34, abs=0.04)
    assert np.percentile(np.abs(starboard - np.median(starboard)), 75) < 0.03


@with_samples
@pytest.mark.parametrize("path", [DECODED, CSV], ids=lambda path: path.suffix)
def test_printed_checksums_are_those_of_messages_packed_by_the_layout(path: Path) -> None:
    """Text of a real sonar, packed again as bytes, has the sums that its decoder printed: the layout is the real one."""
    packed = [
        (bytearray(ping360_message(samples, angle, **fields)), mode, total)
        for samples, angle, fields, mode, total in parsed(path)
    ]
    wrong = 0
    for message, mode, total in packed:
        message[8] = mode
        wrong += sum(message[:-2]) % 65536 != total
    assert len(packed) >= 100
    assert wrong == (path == DECODED)  # somebody has cut a ping of this text to 2 samples


@with_samples
def test_text_and_log_of_the_same_pings_are_the_same_frames(tmp_path: Path) -> None:
    """The real pings written as a log by its published layout."""
    messages = [ping360_message(samples, angle, **fields) for samples, angle, fields, _, _ in parsed(DECODED)]
    stamps = re.findall(r"timestamp: '(.*)'", DECODED.read_text(encoding="utf-8", errors="replace"))
    clocks = [stamp.replace("\\x00", "").split(":") for stamp in stamps]
    times = [3600 * int(hours) + 60 * int(minutes) + float(seconds) for hours, minutes, seconds in clocks][: len(messages)]
    (tmp_path / "a.bin").write_bytes(ping_viewer_log(messages, times))
    first, second = (open_recording(path).part().read([0, 1]) for path in (DECODED, tmp_path / "a.bin"))
    assert (first.image == second.image).all()
    assert first.time_s == pytest.approx(second.time_s, abs=1e-9)
    assert first.sonar == second.sonar


# ---------------------------------------------------------------- sweeps


def test_a_sector_becomes_sweeps_that_share_the_ping_of_a_turn(tmp_path: Path) -> None:
    recording = open_recording(log(tmp_path / "a.bin", SECTOR))
    part, samples = recording.part(), head_sweeps(SECTOR)
    frames = part.read(np.arange(4))
    assert frames.image.shape == (4, 20, 41)
    assert np.degrees(frames.bearing_rad) == pytest.approx(0.9 * np.arange(-20, 21))
    assert np.array_equal(frames.image[0].T, [list(one) for one in samples[:41]])
    assert np.array_equal(frames.image[1, :, ::-1].T, [list(one) for one in samples[40:81]])
    assert np.array_equal(frames.image[2].T, [list(one) for one in samples[80:121]])
    assert not frames.image[3, :, :20].any()
    assert frames.time_s[0] == pytest.approx(0.05 * np.arange(41), abs=1e-9)
    assert frames.time_s[1] == pytest.approx(0.05 * np.arange(80, 39, -1), abs=1e-9)
    assert part.time_s == pytest.approx(frames.time_s.mean(axis=1))
    assert scans(frames.sonar)
    assert frames.sonar.group_interval_s == pytest.approx(0.05)
    assert frames.sonar.range_max == pytest.approx(20 * 200 * 25e-9 * 750)
    assert "1 of 4 sweeps" in note_of(recording, "incomplete")


def test_a_round_sweep_ends_at_the_rear(tmp_path: Path) -> None:
    """Angle 0 is the rear and 200 is ahead, as Ping Viewer shows them; angles increase to starboard."""
    recording = open_recording(log(tmp_path / "a.bin", ROUND))
    frames, samples = recording.part().read([0, 1]), head_sweeps(ROUND)
    assert len(recording) == 2
    assert "20 pings of sweeps" in note_of(recording, "left out")
    assert np.degrees(frames.bearing_rad[[0, 100, 200, 300, 399]]) == pytest.approx([-180, -90, 0, 90, 179.1])
    assert np.array_equal(frames.image[0].T, [list(one) for one in samples[20:420]])
    assert frames.sonar.azimuth_fov_deg == 360
    assert not frames.image[1, :, 300:].any()
    # a picture of a full turn has no gap at the rear
    fan = cartesian_map(frames.range_m, frames.bearing_rad, rows=200)
    radius = np.hypot(*np.meshgrid(np.linspace(-1, 1, 200), np.linspace(-1, 1, 200)))
    assert fan.weight.sum(axis=0)[(radius < 0.97) & (radius > 0.05)] == pytest.approx(1)


def test_a_return_without_pings_starts_a_sweep(tmp_path: Path) -> None:
    angles = [*range(180, 221)] * 3
    recording = open_recording(log(tmp_path / "a.bin", angles))
    assert recording.part().read([0, 1, 2]).image.shape == (3, 20, 41)
    assert not any("incomplete" in note for note in recording.notes)


def test_lost_pings_leave_dark_beams_with_the_times_between(tmp_path: Path) -> None:
    angles = [one for one in [*range(180, 221), *range(219, 179, -1)] if one not in (190, 191)]
    angles.insert(10, 190)  # lost on the way back only
    recording = open_recording(log(tmp_path / "a.bin", [*angles, *range(181, 221)]))
    frames = recording.part().read(np.arange(len(recording)))
    assert frames.image.shape == (3, 20, 41)
    dark = ~frames.image.any(axis=1)
    assert np.argwhere(dark).tolist() == [[0, 11], [1, 10], [1, 11]]
    assert (np.diff(frames.time_s[0]) > 0).all()
    assert (np.diff(frames.time_s[1]) < 0).all()


def test_another_range_or_step_begins_another_part(tmp_path: Path) -> None:
    near = [ping360_message(one, angle) for one, angle in zip(head_sweeps(SECTOR), SECTOR, strict=True)]
    coarse = [*range(180, 221, 4), *range(216, 179, -4)]
    far = [
        ping360_message(one, angle, 2301, sample_period=400) for one, angle in zip(head_sweeps(coarse), coarse, strict=True)
    ]
    fine = [ping360_message(one, angle, sample_period=400) for one, angle in zip(head_sweeps(SECTOR), SECTOR, strict=True)]
    messages = [*near, *far, *fine]
    (tmp_path / "a.bin").write_bytes(ping_viewer_log(messages, [0.1 * one for one in range(len(messages))]))
    recording = open_recording(tmp_path / "a.bin")
    assert [part.read([0]).image.shape for part in recording.parts] == [(1, 20, 41), (1, 20, 11), (1, 20, 41)]
    windows = [part.like.sonar.range_max for part in recording.parts]
    assert windows[1] == pytest.approx(2 * windows[0])


def test_a_head_at_rest_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match="single angle"):
        open_recording(log(tmp_path / "a.bin", [200] * 5))


def test_a_copy_is_a_run_of_a_scanning_sonar_and_its_crop_is_one(tmp_path: Path) -> None:
    recording = open_recording(log(tmp_path / "a.bin", SECTOR))
    write_frames(recording, None, tmp_path / "copy")
    part = recording_at(tmp_path / "copy").part()
    copied, original = part.read([1, 2]), recording.part().read([1, 2])
    assert (copied.image == original.image).all()
    assert (copied.time_s == original.time_s).all()
    assert copied.sonar == original.sonar
    few = part.cropped((2, 18), (5, 25)).read([1])
    assert few.image.shape == (1, 16, 20)
    assert scans(few.sonar)
    assert (few.time_s == original.time_s[:1, 5:25]).all()


# ---------------------------------------------------------------- files


def test_text_of_brping_and_csv(tmp_path: Path) -> None:
    samples = head_sweeps(SECTOR)
    texts = [ping360_text(one, angle) for one, angle in zip(samples, SECTOR, strict=True)]
    stamps = ["".join(f"\\x00{letter}" for letter in f"00:00:{0.05 * one:06.3f}") for one in range(len(texts))]
    joined = "\n".join(f"timestamp: '{stamp}'\n{text}" for stamp, text in zip(stamps, texts, strict=True))
    (tmp_path / "a.txt").write_text(f"Header:\n    String: x\n\n{joined}\n")
    cells = ",".join(f'"<bound method PingMessage.unpack_msg_data of {text}>"' for text in texts)
    (tmp_path / "a.csv").write_text(cells)
    logged = open_recording(log(tmp_path / "a.bin", SECTOR)).part().read(np.arange(4))
    timed, plain = (open_recording(tmp_path / name) for name in ("a.txt", "a.csv"))
    assert (timed.part().read(np.arange(4)).image == logged.image).all()
    assert timed.part().read(np.arange(4)).time_s == pytest.approx(logged.time_s, abs=1e-9)
    assert (plain.part().read(np.arange(4)).image == logged.image).all()
    interval = 20 * 200 * 25e-9 + 0.02  # an echo and 20 ms
    assert np.diff(plain.part().read([0]).time_s[0]) == pytest.approx(interval)


@pytest.mark.parametrize("encoding", ["utf-16-be", "utf-8"])
def test_logs_of_either_encoding_with_other_messages(tmp_path: Path, encoding: str) -> None:
    messages = [ping360_message(one, angle) for one, angle in zip(head_sweeps(SECTOR), SECTOR, strict=True)]
    messages[3] = ping_message(1, b"\1\2") + messages[3]  # an answer ahead of the ping, in one record
    messages.insert(7, ping_message(4, bytes(10)))
    (tmp_path / "a.bin").write_bytes(
        ping_viewer_log(messages, [0.05 * one for one in range(len(messages))], encoding=encoding)
    )
    recording = open_recording(tmp_path / "a.bin")
    assert recording.facts["pings"] == len(SECTOR)
    assert recording.facts["system"] == "Arch Linux unknown"
    assert not any("damaged" in note for note in recording.notes)


def test_damaged_and_cut_messages_are_left_out_and_counted(tmp_path: Path) -> None:
    content = bytearray(log(tmp_path / "a.bin", SECTOR).read_bytes())
    record = len(ping_viewer_log([b""], [0.0])) - len(ping_viewer_log([], [])) + len(ping360_message(bytes(20), 200))
    first = len(ping_viewer_log([], []))
    content[first + 5 * record + record - 10] ^= 0xFF  # a sample
    content[first + 9 * record + 30] = 200  # the length of a message
    (tmp_path / "a.bin").write_bytes(content[:-7])
    recording = open_recording(tmp_path / "a.bin")
    assert recording.facts["pings"] == len(SECTOR) - 3
    assert "3 cut off or damaged messages" in note_of(recording, "damaged")


def test_samples_that_look_like_a_record_are_samples(tmp_path: Path) -> None:
    stamp = "00:00:01.000".encode("utf-16-be")
    samples = b"\0\0\0\x18" + stamp + b"\0\0\0\x04BR\0\0"
    messages = [ping360_message(samples, angle) for angle in range(190, 211)]
    (tmp_path / "a.bin").write_bytes(ping_viewer_log(messages, [0.05 * one for one in range(21)]))
    recording = open_recording(tmp_path / "a.bin")
    assert recording.facts["pings"] == 21
    assert (recording.part().read([0]).image[0] == np.frombuffer(samples, np.uint8)[:, None]).all()


def test_times_pass_midnight(tmp_path: Path) -> None:
    messages = [ping360_message(one, angle) for one, angle in zip(head_sweeps(SECTOR), SECTOR, strict=True)]
    times = [86_398 + 0.1 * one for one in range(len(messages))]
    (tmp_path / "a.bin").write_bytes(ping_viewer_log(messages, times))
    part = open_recording(tmp_path / "a.bin").part()
    assert np.diff(part.time_s) == pytest.approx([4, 4, 3.5], abs=1)


def test_logs_of_other_sensors_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(ping_viewer_log([ping_message(1300, bytes(40))] * 3, [0.0, 1.0, 2.0]))
    with pytest.raises(MitsonarError, match="holds no ping of a Ping360"):
        open_recording(tmp_path / "a.bin")


def test_messages_are_those_of_brping() -> None:
    """The maker's package packs the same bytes, where it is installed."""
    brping = pytest.importorskip("brping")
    message = brping.PingMessage(2300)
    samples = bytes(range(30))
    values = {"mode": 1, "gain_setting": 1, "angle": 77, "transmit_duration": 30, "sample_period": 200}
    values |= {"transmit_frequency": 750, "number_of_samples": 30, "data_length": 30}
    for name, value in values.items():
        setattr(message, name, value)
    message.data, message.src_device_id = samples, 2
    assert bytes(message.pack_msg_data()) == ping360_message(samples, 77)
