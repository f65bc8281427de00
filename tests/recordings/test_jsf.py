"""JSF files of EdgeTech side-scans, which the tests write themselves by the published layout: no real file was at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recording_files import jsf_file, jsf_message, jsf_trace

import mitsonar
from mitsonar.errors import MitsonarError
from mitsonar.recordings.side_scan import SideScan


def opened(folder: Path, content: bytes) -> SideScan:
    (folder / "line.jsf").write_bytes(content)
    return mitsonar.open_side_scan(folder / "line.jsf")


def test_fields_lie_where_the_layout_has_them() -> None:
    """Offsets by the data file description, within the header of a trace."""
    trace = jsf_trace(np.array([1, 2, 3]), channel=1, subsystem=21, sound_speed=1512.5, altitude_mm=7000, weighting=4)
    assert trace[:2] == b"\x01\x16"
    assert trace[4:6] == (80).to_bytes(2, "little")
    assert (trace[7], trace[8]) == (21, 1)
    assert int.from_bytes(trace[12:16], "little") == 240 + 6 == len(trace) - 16
    body = trace[16:]
    assert np.frombuffer(body, "<f4", 1, 148) == 1512.5
    assert np.frombuffer(body, "<i4", 1, 144) == 7000
    assert np.frombuffer(body, "<i2", 1, 168) == 4
    assert np.frombuffer(body, "<u2", 1, 114) == 3
    assert body[240:] == bytes([1, 0, 2, 0, 3, 0])


def test_pings_are_placed_and_scaled(tmp_path: Path) -> None:
    recording = opened(tmp_path, jsf_file())
    assert recording.format == "JSF (.jsf)"
    echogram = recording.part().read()
    counts = (100 + np.arange(30)) / 2**3
    np.testing.assert_allclose(echogram.channel("port"), np.tile(counts**2, (5, 1)), rtol=1e-6)
    np.testing.assert_allclose(echogram.channel("starboard"), np.tile(4 * counts**2, (5, 1)), rtol=1e-6)
    fan = echogram.sounder.fan
    assert fan.bin_m == pytest.approx(40e-6 * 1480 / 2)
    assert fan.frequency_hz == 120e3
    np.testing.assert_allclose(echogram.time_s, 1_700_000_000 + 0.25 * np.arange(5))
    degrees = echogram.origin.to_degrees(echogram.poses[:, :2])  # type: ignore[union-attr]
    np.testing.assert_allclose(degrees[:, 0], 42 + np.arange(5) * 1e-5, atol=1e-9)
    np.testing.assert_allclose(degrees[:, 1], 15, atol=1e-9)
    np.testing.assert_allclose(np.degrees(echogram.poses[:, 3:5]), [[-182 * 180 / 32768, -2.0]] * 5, atol=1e-3)
    assert np.degrees(echogram.poses[0, 5]) == pytest.approx(359, abs=1e-6)  # no convergence on the central meridian
    np.testing.assert_allclose(echogram.poses[:, 2], -2.5)
    np.testing.assert_allclose(echogram.height_m, 6)
    assert any("1 of type 2002" in note for note in recording.notes)


def test_complex_samples_become_intensities(tmp_path: Path) -> None:
    pairs = np.array([[3, 4], [-6, 8], [0, -5]])
    content = b"".join(jsf_trace(pairs, channel=side) for side in (0, 1))
    np.testing.assert_allclose(opened(tmp_path, content).part().read().levels[0], [[25, 100, 25]] * 2)


def test_high_bits_extend_samples_and_frequencies_and_low_bits_the_interval(tmp_path: Path) -> None:
    many = np.full(70_000, 7)
    fields = {"samples": 70_000 - 65_536, "high_bits": 1 << 8 | 1 | 1 << 4, "low_bits": 128, "interval_ns": 400}
    content = b"".join(jsf_trace(many, channel=side, start_dahz=20_000, end_dahz=24_000, **fields) for side in (0, 1))
    fan = opened(tmp_path, content).part().sounder.fan
    assert fan.range_bins == 70_000
    assert fan.frequency_hz == 10 * (65_536 + 22_000)
    assert fan.range_max == pytest.approx(70_000 * 400.5e-9 * 740)


def test_a_window_may_begin_later(tmp_path: Path) -> None:
    content = b"".join(jsf_trace(np.arange(1, 51), channel=side, first_sample=100) for side in (0, 1))
    fan = opened(tmp_path, content).part().sounder.fan
    assert (fan.range_min, fan.range_max) == pytest.approx((100 * 0.0296, 150 * 0.0296))


def test_two_frequencies_are_two_parts(tmp_path: Path) -> None:
    """The same pings, and times, of the subsystems 20 and 21."""
    content = b""
    for ping in range(4):
        for subsystem, samples in ((20, 30), (21, 60)):
            for side in (0, 1):
                words = {"ping": ping, "time_s": 1_700_000_000 + ping}
                content += jsf_trace(np.arange(samples), channel=side, subsystem=subsystem, **words)
    recording = opened(tmp_path, content)
    assert [(len(part), part.sounder.fan.range_bins) for part in recording.parts] == [(4, 30), (4, 60)]
    assert [part.sounder.name for part in recording.parts] == ["EdgeTech, low frequency", "EdgeTech, high frequency"]
    np.testing.assert_allclose(np.diff(recording.parts[1].time_s), 1)


def test_values_without_their_flag_are_unknown(tmp_path: Path) -> None:
    part = opened(tmp_path, jsf_file(valid=1)).part()  # positions only
    assert np.isnan(part.height_m).all()
    assert not part.poses[:, 2:5].any()
    np.testing.assert_allclose(part.poses[:, 5], 0, atol=1e-6)  # course of the track: north
    old = opened(tmp_path, jsf_file(valid=0)).part()  # no flags at all
    np.testing.assert_allclose(old.height_m, 6)


def test_what_cannot_be_used_is_counted(tmp_path: Path) -> None:
    good = jsf_file(pings=3)
    counts = np.arange(1, 20)
    alone = jsf_trace(counts, channel=0, ping=77)
    unknown = jsf_trace(counts, channel=0, ping=78, format=300)
    continued = jsf_trace(counts, channel=0, ping=79, packet=2)
    too_long = jsf_trace(counts, channel=0, ping=80, samples=60_000)
    sub_bottom = jsf_trace(counts, channel=0, subsystem=0)
    content = good + alone + unknown + b"junk" + continued + too_long + sub_bottom + jsf_message(bytes(40))[:30]
    recording = opened(tmp_path, content)
    assert len(recording) == 3
    notes = " | ".join(recording.notes)
    assert "3 traces that are damaged, or of an unknown format" in notes
    assert "1 trace without the other side" in notes
    assert "1 of type 80" in notes
    assert "skipped: 34 bytes" in notes


def test_a_file_without_pings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match="holds no ping of a side-scan"):
        opened(tmp_path, jsf_message(b"serial text", kind=2002))
    with pytest.raises(MitsonarError, match="1 of one side only"):
        opened(tmp_path, jsf_trace(np.arange(9), channel=1))
