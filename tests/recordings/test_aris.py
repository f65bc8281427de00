"""ARIS files: header, range axis and beams of the sample, order of live streams, damaged frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from recording_files import aris_file

from mitsonar import MitsonarError, open_recording
from mitsonar.instruments.sonar import Sonar, group_of_beams
from mitsonar.mapping.sources import open_frames
from mitsonar.recordings.recording import in_time_order, runs_of
from mitsonar.recordings.sound_metrics import BEAMS, PINGS, in_beam_order

REAL = Path(__file__).resolve().parents[2].parent / "shared/data/real"
SAMPLE = REAL / "aris1200-sdk-sample/sample.aris"

with_samples = pytest.mark.skipif(not SAMPLE.exists(), reason="needs the recordings of ../shared/data/real")


@with_samples
def test_the_sample_is_what_its_readme_says() -> None:
    recording = open_recording(SAMPLE)
    assert (len(recording), len(recording.parts), recording.notes) == (6, 1, ())
    frames = recording.part().read(np.arange(6))
    assert frames.image.shape == (6, 2000, 48)
    assert frames.image.dtype == np.uint8
    assert recording.facts["system"] == "ARIS 1200"
    assert recording.facts["serial"] == 1098
    assert frames.sonar.sound_speed == pytest.approx(1435.93, abs=0.01)
    assert frames.range_m[0] == pytest.approx(3.298, abs=5e-4)
    assert np.diff(frames.range_m) == pytest.approx(0.01005, abs=2e-6)
    assert frames.sonar.range_max == pytest.approx(23.396, abs=5e-4)
    assert np.degrees(frames.bearing_rad[[0, -1]]) == pytest.approx([-7.34, 7.34], abs=0.07)
    assert (np.diff(frames.bearing_rad) > 0).all()
    assert np.diff(frames.time_s).min() > 0.1524
    assert np.diff(frames.time_s).max() < 0.1535
    assert (frames.sonar.ping_groups, frames.sonar.group_order) == (3, "interleaved_starboard")
    assert frames.sonar.group_interval_s == pytest.approx(2 * 23.4 / 1436, rel=0.02)  # an echo's time
    assert frames.attitude_rad is not None
    pitch, roll, heading = np.degrees(frames.attitude_rad).T
    assert 2.0 <= pitch.min() <= pitch.max() <= 2.45  # its compass says -2.0 to -2.4: nose down
    assert -2.85 <= roll.min() <= roll.max() <= -2.65
    assert 49.0 <= heading.min() <= heading.max() <= 50.45


@with_samples
def test_consecutive_frames_of_the_sample_correlate_as_measured() -> None:
    frames = open_recording(SAMPLE).part().read([0, 1])
    assert np.corrcoef(frames.image.reshape(2, -1).astype(float))[0, 1] == pytest.approx(0.835, abs=0.01)


@with_samples
def test_beam_0_of_the_file_is_the_last_column() -> None:
    raw = np.fromfile(SAMPLE, np.uint8, offset=2048)[: 2000 * 48].reshape(2000, 48)
    image = open_recording(SAMPLE).part().read([0]).image[0]
    assert (image[:, -1] == raw[:, 0]).all()
    assert (image[:, 0] == raw[:, -1]).all()


@pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of ../shared/data/real")
@pytest.mark.parametrize(("name", "mode", "beams"), [("1_1200", 1, 48), ("1_1800", 1, 48), ("3", 3, 96), ("9", 9, 128)])
def test_live_streams_are_put_in_the_order_of_beams_bit_for_bit(name: str, mode: int, beams: int) -> None:
    folder = REAL / "aris-reorder-fixtures"
    given, expected = (np.fromfile(folder / f"{kind}_pingmode_{name}.dat", np.uint8) for kind in ("input", "expected"))
    assert (in_beam_order(given.reshape(-1, beams), mode) == expected.reshape(-1, beams)).all()


@pytest.mark.parametrize("mode", PINGS)
def test_ping_groups_are_those_of_a_live_stream(mode: int) -> None:
    """Samples that hold the number of their ping, put in the order of beams, beam 0 at starboard."""
    pings = PINGS[mode]
    stream = np.repeat(np.arange(pings, dtype=np.uint8), 10 * 16).reshape(10, -1)
    groups = in_beam_order(stream, mode)[0, ::-1]
    sonar = Sonar.create(beams=BEAMS[mode], ping_groups=pings, group_order="interleaved_starboard")
    np.testing.assert_array_equal(groups, group_of_beams(sonar))


def test_the_order_of_other_ping_modes_is_refused() -> None:
    with pytest.raises(MitsonarError, match="ping mode 2 is not known"):
        in_beam_order(np.zeros((8, 48), np.uint8), 2)


def written(path: Path, **changed: ArrayLike) -> Path:
    """Write an ARIS 3000 of 5 frames; fields of the headers may be changed ``(frames,)``."""
    path.write_bytes(aris_file(frames=5, samples=40, **changed))
    return path


def test_bins_of_the_sonar_lie_at_the_ranges_of_the_frames(tmp_path: Path) -> None:
    frames = open_recording(written(tmp_path / "a.aris")).part().read([0])
    assert frames.sonar.range_m == pytest.approx(frames.range_m, abs=1e-9)


def test_frames_are_sorted_repeated_ones_dropped_and_missing_ones_counted(tmp_path: Path) -> None:
    times, numbers = np.array([3, 1, 1, 2, 7]) * 100_000, np.array([3, 1, 1, 2, 7])
    recording = open_recording(written(tmp_path / "a.aris", time_us=times, index=numbers))
    assert recording.part().time_s == pytest.approx([0.1, 0.2, 0.3, 0.7])
    assert "sorted" in " ".join(recording.notes)
    assert "left out: 1 frame at the time of the one before" in " ".join(recording.notes)
    assert "missing: 3 frames" in " ".join(recording.notes)


def test_a_window_that_changes_makes_parts_and_small_drifts_of_the_speed_none(tmp_path: Path) -> None:
    delays, speed = np.array([2000, 2000, 3000, 3000, 3000]), np.array([1500, 1500.5, 1501, 1500, 1500])
    recording = open_recording(written(tmp_path / "a.aris", start_delay_us=delays, sound_speed=speed))
    assert [len(part) for part in recording.parts] == [2, 3]
    assert recording.longest == 1
    assert recording.part().like.range_m[0] == pytest.approx(3000e-6 * 1500 / 2)
    source = open_frames(tmp_path / "a.aris")
    assert (len(source), source.note) == (3, "part 1 of 2, the longest: 3 frames")
    assert len(open_frames(tmp_path / "a.aris", sequence=0)) == 2
    with pytest.raises(MitsonarError, match="has no part 2"):
        open_frames(tmp_path / "a.aris", sequence=2)


def test_damaged_headers_are_left_out_and_a_cut_file_keeps_its_whole_frames(tmp_path: Path) -> None:
    path = written(
        tmp_path / "a.aris", ping_mode=np.array([6, 6, 77, 6, 6]), sound_speed=np.array([1500, np.nan, 1500, 1500, 1500])
    )
    path.write_bytes(path.read_bytes()[:-10])
    recording = open_recording(path)
    assert len(recording) == 2
    assert any("left out: 2 frames with a damaged header" in note for note in recording.notes)
    assert any("not a complete frame" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("field", "values"),
    [("large_lens", [0, 0, 1, 0, 0]), ("system", [1, 1, 2, 1, 1]), ("sample_period_us", [10, 10, 900_000, 10, 10])],
)
def test_one_frame_that_cannot_be_is_left_out(tmp_path: Path, field: str, values: list[int]) -> None:
    """No lens, no other ARIS has 64 beams, and no window ends 27 km away."""
    recording = open_recording(written(tmp_path / "a.aris", **{field: values}))
    assert [len(part) for part in recording.parts] == [4]
    assert any("left out: 1 frame with a damaged header" in note for note in recording.notes)


def test_a_file_without_a_table_of_its_beams_says_which(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match="no beam angles are known for an ARIS 1200 with 64 beams"):
        open_recording(written(tmp_path / "a.aris", system=2))


def test_positions_become_metres_east_and_north(tmp_path: Path) -> None:
    latitude, longitude = -32 + np.arange(5) * 1e-5, -52 + np.arange(5) * 2e-5
    part = open_recording(
        written(tmp_path / "a.aris", latitude_deg=latitude, longitude_deg=longitude, heading_deg=[30.0] * 5)
    ).part()
    assert part.poses is not None
    assert part.poses[-1, :2] == pytest.approx([8e-5 * 111_195 * np.cos(np.radians(32)), 4e-5 * 111_195], rel=1e-4)
    assert np.degrees(part.poses[:, 5]) == pytest.approx(30)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"DDF\x05", "the file is cut off"),
        (b"DDF\x05".ljust(3000, b"\0"), "ping mode 0"),
        (b"PK\x03\x04".ljust(3000, b"\0"), "is not a recording that mitsonar reads"),
        (b"", "is not a recording that mitsonar reads"),
    ],
)
def test_other_files_are_refused_in_one_sentence(tmp_path: Path, content: bytes, reason: str) -> None:
    (tmp_path / "a.aris").write_bytes(content)
    with pytest.raises(MitsonarError, match=reason):
        open_recording(tmp_path / "a.aris")


def test_times_that_are_nan_are_left_out() -> None:
    stored, notes = in_time_order([2.0, np.nan, 1.0])
    assert stored.tolist() == [2, 0]
    assert notes[0].startswith("left out: 1 frame without a valid time")


def test_runs_keep_their_order() -> None:
    assert [(key, places.tolist()) for key, places in runs_of([1, 1, 2, 1])] == [(1, [0, 1]), (2, [2]), (1, [3])]
