"""XTF files of side-scans: what our writer writes, what pyxtf reads in them, the traps of the format, and a real file."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_files import side_scan_echogram

import mitsonar
from mitsonar.errors import MitsonarError, count_noun
from mitsonar.motion.utm import UtmOrigin
from mitsonar.recordings.side_scan import SideScan
from mitsonar.recordings.write_xtf import CHANNEL, FILE, PING, PING_CHANNEL, write_xtf
from mitsonar.records.soundings import Echogram

REAL = Path(__file__).resolve().parents[2].parent / "shared/data/real/opensidescan-iver2-xtf/scotsman-iver2.xtf"
with_sample = pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of ../shared/data/real")

ORIGIN = UtmOrigin(19, False, 512724.0, 5365826.0)


class Changed:
    """A file of our writer whose fields are set, byte by byte."""

    def __init__(self, folder: Path, echogram: Echogram | None = None) -> None:
        self.path = folder / "line.xtf"
        self.echogram = side_scan_echogram() if echogram is None else echogram
        write_xtf(self.path, self.echogram)
        self.data = bytearray(self.path.read_bytes())
        self.size = struct.unpack_from("<I", self.data, 1024 + 10)[0]

    def file(self, **fields: Any) -> Changed:
        self._set(FILE, 0, fields)
        return self

    def channels(self, **fields: Any) -> Changed:
        for number in range(2):
            self._set(CHANNEL, 256 + 128 * number, fields)
        return self

    def pings(self, which: range | None = None, **fields: Any) -> Changed:
        for number in range(len(self.echogram)) if which is None else which:
            self._set(PING, 1024 + number * self.size, fields)
        return self

    def headers(self, which: range | None = None, **fields: Any) -> Changed:
        """Headers of both channels."""
        step = 64 + 2 * self.echogram.levels.shape[2]
        for number in range(len(self.echogram)) if which is None else which:
            for side in range(2):
                self._set(PING_CHANNEL, 1024 + number * self.size + 256 + side * step, fields)
        return self

    def open(self) -> SideScan:
        self.path.write_bytes(self.data)
        return mitsonar.open_side_scan(self.path)

    def _set(self, kind: np.dtype[np.void], at: int, fields: dict[str, Any]) -> None:
        header = np.frombuffer(bytes(self.data[at : at + kind.itemsize]), np.uint8).copy()
        for name, value in fields.items():
            header.view(kind)[name] = value
        self.data[at : at + kind.itemsize] = header.tobytes()


def unturned(angle: Any) -> Any:
    return np.angle(np.exp(1j * angle))


@pytest.mark.parametrize("origin", [None, ORIGIN])
def test_what_is_written_is_read(tmp_path: Path, origin: UtmOrigin | None) -> None:
    written = side_scan_echogram(pings=40, origin=origin)
    file = Changed(tmp_path, written)
    recording = file.open()
    read = recording.part().read()
    assert recording.format == "XTF (.xtf)"
    assert not recording.notes
    np.testing.assert_allclose(read.time_s, written.time_s, atol=5e-3)
    np.testing.assert_allclose(read.poses[:, :5], written.poses[:, :5], atol=2e-6)
    assert np.abs(unturned(read.poses[:, 5] - written.poses[:, 5])).max() < 1e-5
    np.testing.assert_allclose(read.height_m, written.height_m)
    np.testing.assert_allclose(read.range_m, written.range_m, rtol=1e-6)
    largest = np.sqrt(written.levels.max())
    np.testing.assert_allclose(np.sqrt(read.levels), np.sqrt(written.levels) / largest, atol=0.5 / 32767 + 1e-6)
    assert read.origin == origin
    assert read.sounder.fan.frequency_hz == written.sounder.fan.frequency_hz
    assert read.sounder.mounts == written.sounder.mounts


def test_both_readers_agree(tmp_path: Path) -> None:
    pyxtf = pytest.importorskip("pyxtf")
    file = Changed(tmp_path)
    read = file.open().part().read()
    _, packets = pyxtf.xtf_read(str(file.path))
    for ping, levels in zip(packets[pyxtf.XTFHeaderType.sonar], read.levels, strict=True):
        amplitude = np.stack([ping.data[0][::-1], ping.data[1]]).astype(float)
        np.testing.assert_allclose(np.square(amplitude / 32767), levels, rtol=1e-5)


def test_pyxtf_reads_degrees_of_our_files(tmp_path: Path) -> None:
    pyxtf = pytest.importorskip("pyxtf")
    write_xtf(tmp_path / "line.xtf", side_scan_echogram(origin=ORIGIN))
    header, packets = pyxtf.xtf_read(str(tmp_path / "line.xtf"))
    first = packets[pyxtf.XTFHeaderType.sonar][0]
    assert header.NavUnits == 3
    expected = ORIGIN.to_degrees([[0.3, 0.3]])[0]
    assert (first.SensorYcoordinate, first.SensorXcoordinate) == pytest.approx(tuple(expected), abs=1e-12)


# ---------------------------------------------------------------- traps of the format


@pytest.mark.parametrize(
    ("stated", "computed", "speed"), [(750, 0, 1500), (740, 1490, 1480), (1490, 0, 1490), (0, 1470, 1470)]
)
def test_sound_speed_is_stored_as_half_of_it_or_whole(tmp_path: Path, stated: float, computed: float, speed: float) -> None:
    recording = Changed(tmp_path).pings(half_sound_speed=stated, sound_speed=computed).open()
    assert recording.part().sounder.fan.sound_speed == speed


def test_an_unknown_sound_speed_is_assumed_and_noted(tmp_path: Path) -> None:
    recording = Changed(tmp_path).pings(half_sound_speed=0, sound_speed=np.nan).open()
    assert recording.part().sounder.fan.sound_speed == 1500
    assert any("1500 m/s is assumed" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("in_ping", "in_file", "hertz"), [(600, 0, 6e5), (0, 120, 1.2e5), (0, 455_000, 4.55e5), (0, np.nan, None)]
)
def test_frequencies_are_khz_unless_they_are_large(
    tmp_path: Path, in_ping: int, in_file: float, hertz: float | None
) -> None:
    recording = Changed(tmp_path).channels(frequency_khz=in_file).headers(frequency_khz=in_ping).open()
    assert recording.part().sounder.fan.frequency_hz == hertz


def test_a_line_through_the_origin_of_a_local_world_is_no_gap(tmp_path: Path) -> None:
    written = side_scan_echogram(pings=12)
    moved = written.poses - [*written.poses[4, :2], 0, 0, 0, 0]
    recording = Changed(tmp_path, replace(written, poses=moved)).open()
    assert not recording.notes
    np.testing.assert_allclose(recording.part().poses[:, :2], moved[:, :2], atol=1e-9)


def test_pings_without_navigation_continue_the_track(tmp_path: Path) -> None:
    """The first ping of the real file holds zeros; here the first and the last."""
    written = side_scan_echogram(pings=12, origin=ORIGIN)
    nothing = {"x": 0, "y": 0, "ship_x": 0, "ship_y": 0, "heading_deg": 0, "pitch_deg": 0, "roll_deg": 0, "depth_m": 0}
    file = Changed(tmp_path, written)
    recording = file.pings(range(1), **nothing, altitude_m=0).pings(range(11, 12), **nothing).open()
    read = recording.part().read()
    assert any(note.startswith("2 pings without a position") for note in recording.notes)
    np.testing.assert_allclose(read.poses[:, :5], written.poses[:, :5], atol=1e-3)
    assert np.abs(unturned(read.poses[:, 5] - written.poses[:, 5])).max() < 1e-5
    assert np.isnan(read.height_m[0])
    assert np.isfinite(read.height_m[1:]).all()


def test_repeated_fixes_do_not_make_steps(tmp_path: Path) -> None:
    """A fix that is repeated until the next one comes, every third ping."""
    written = side_scan_echogram(pings=31)
    file = Changed(tmp_path, written)
    for ping in range(31):
        x, y = written.poses[ping - ping % 3, :2]
        file.pings(range(ping, ping + 1), x=x, y=y)
    recording = file.open()
    assert recording.facts["fixes"] == "11 in 31 pings"
    np.testing.assert_allclose(recording.part().poses[:, :2], written.poses[:, :2], atol=1e-9)


def test_wrong_fixes_are_left_out(tmp_path: Path) -> None:
    written = side_scan_echogram(pings=12, origin=ORIGIN)
    recording = Changed(tmp_path, written).pings(range(5, 6), x=12.0, y=-80.0).open()
    assert any(note.startswith("left out: positions of 1 ping") for note in recording.notes)
    np.testing.assert_allclose(recording.part().poses[:, :2], written.poses[:, :2], atol=1e-3)


def test_positions_of_the_ship_and_the_gyro_serve_where_the_sonar_has_none(tmp_path: Path) -> None:
    written = side_scan_echogram(pings=12)
    recording = Changed(tmp_path, written).pings(x=0, y=0, heading_deg=0).open()
    assert "positions are those of the ship" in recording.notes
    np.testing.assert_allclose(recording.part().poses, written.poses, atol=1e-5)


def test_without_a_heading_the_course_is_taken(tmp_path: Path) -> None:
    written = side_scan_echogram(pings=40, heading=2.5)
    recording = Changed(tmp_path, written).pings(heading_deg=0, gyro_deg=0).open()
    assert any("course of the track" in note for note in recording.notes)
    np.testing.assert_allclose(recording.part().poses[:, 5], 2.5, atol=1e-6)


def test_a_vehicle_that_stops_keeps_its_course(tmp_path: Path) -> None:
    """At rest for 20 s before it sets off, between two legs, and behind the second."""
    written = side_scan_echogram(pings=400, heading=2.5)
    moved = np.clip(np.arange(400.0) - 80, 0, 80) + np.clip(np.arange(400.0) - 240, 0, 80)
    poses = written.poses.copy()
    poses[:, :2] = 0.3 + 0.5 * moved[:, None] * [np.sin(2.5), np.cos(2.5)]
    recording = Changed(tmp_path, replace(written, poses=poses)).pings(heading_deg=0, gyro_deg=0).open()
    np.testing.assert_allclose(recording.part().poses[:, 5], 2.5, atol=1e-6)


def test_a_heading_of_north_is_not_taken_for_none(tmp_path: Path) -> None:
    """A line that drifts sideways, its bow to the north all along."""
    written = side_scan_echogram(pings=12, heading=1.2)
    north = written.poses.copy()
    north[:, 5] = 0
    recording = Changed(tmp_path, replace(written, poses=north)).open()
    assert np.abs(unturned(recording.part().poses[:, 5])).max() < 1e-6


def test_headings_across_the_track_are_noted(tmp_path: Path) -> None:
    written = side_scan_echogram(pings=60)
    turned = written.poses.copy()
    turned[:, 5] += np.radians(18)
    note = Changed(tmp_path, replace(written, poses=turned)).open().notes[-1]
    assert note.startswith("the track lies -18 deg from the headings")


def test_other_packets_are_counted_and_damage_costs_only_itself(tmp_path: Path) -> None:
    file = Changed(tmp_path)
    attitude = struct.pack("<HBBH4xI", 0xFACE, 3, 0, 0, 64) + bytes(50)
    unknown = struct.pack("<HBBH4xI", 0xFACE, 200, 0, 0, 128) + bytes(114)
    place = 1024 + file.size
    file.data[place:place] = attitude + unknown + b"\xce\xfa\0damaged bytes between packets"
    recording = file.open()
    assert len(recording) == 6
    notes = " ".join(recording.notes)
    assert "1 of kind 3" in notes
    assert "1 of kind 200" in notes
    assert "skipped: 32 bytes" in notes


def test_a_file_that_is_cut_off_gives_what_is_whole(tmp_path: Path) -> None:
    file = Changed(tmp_path)
    del file.data[-100:]
    recording = file.open()
    assert len(recording) == 5
    assert f"skipped: {file.size - 100:,} bytes" in recording.notes[0]


def test_channels_that_exceed_their_packet_are_left_out(tmp_path: Path) -> None:
    recording = Changed(tmp_path).headers(range(2, 3), samples=2**31).open()
    assert len(recording) == 5
    assert "left out: 1 ping with damaged channels" in recording.notes


def test_pings_at_one_time_are_spaced_evenly(tmp_path: Path) -> None:
    """A clock of whole seconds and four pings in each."""
    written = side_scan_echogram(pings=12)
    file = Changed(tmp_path, written)
    file.pings(hundredths=0)
    recording = file.open()
    assert any("spaced evenly" in note for note in recording.notes)
    np.testing.assert_allclose(np.diff(recording.part().time_s), 0.25)


def test_another_range_begins_another_part(tmp_path: Path) -> None:
    recording = Changed(tmp_path).headers(range(4, 6), slant_range_m=50).open()
    assert [len(part) for part in recording.parts] == [4, 2]
    assert recording.parts[1].sounder.fan.range_max == 50
    assert recording.part() is recording.parts[0]


def test_a_window_without_its_end_begins_after_its_delay(tmp_path: Path) -> None:
    file = Changed(tmp_path).headers(slant_range_m=0, delay_s=2 * 5 / 1500, duration_s=2 * 30 / 1500)
    fan = file.pings(half_sound_speed=750).open().part().sounder.fan
    assert (fan.range_min, fan.range_max) == pytest.approx((5, 35))


def test_another_start_of_the_window_begins_another_part(tmp_path: Path) -> None:
    """The same end and number of samples; a start that moves with the sound speed, by 1 cm, begins none."""
    delays = [2 * near / 1500 for near in (2.0, 2.01, 6.0)]
    file = Changed(tmp_path).pings(half_sound_speed=750)
    for first, delay in zip((0, 2, 4), delays, strict=True):
        file.headers(range(first, first + 2), delay_s=delay)
    recording = file.open()
    assert [len(part) for part in recording.parts] == [4, 2]
    starts = [part.sounder.fan.range_min for part in recording.parts]
    assert starts == pytest.approx([2.005, 6])


@pytest.mark.parametrize(
    ("kind", "code", "unipolar"), [("u1", 0, 1), ("i1", 8, 0), ("<i2", 3, 0), ("<i4", 2, 0), ("<f4", 5, 0)]
)
def test_samples_of_every_type(tmp_path: Path, kind: str, code: int, unipolar: int) -> None:
    """Port and starboard of 40 samples; signed ones alternate in sign."""
    dtype = np.dtype(kind)
    file = Changed(tmp_path)
    amplitude = np.arange(1, 41) * (1.0 if dtype.kind == "f" or dtype.itemsize == 1 else 100.0)
    signs = 1 if unipolar else np.where(np.arange(40) % 2, -1, 1)
    samples = (amplitude * signs).astype(dtype).tobytes()
    result = bytearray(file.channels(unipolar=unipolar, sample_bytes=dtype.itemsize, sample_format=code).data[:1024])
    for ping in range(6):
        at = 1024 + ping * file.size
        heads = [bytes(file.data[at + 256 + side * 144 : at + 320 + side * 144]) for side in range(2)]
        body = bytes(file.data[at : at + 256]) + heads[0] + samples + heads[1] + samples
        result += body[:10] + struct.pack("<I", len(body)) + body[14:]
    file.data = result
    levels = file.open().part().read().levels
    full = {1: 255.0, 2: 32767.0, 4: 2.0**31 - 1}[dtype.itemsize] if dtype.kind != "f" else 1.0
    np.testing.assert_allclose(levels[3, 1], (amplitude / full) ** 2, rtol=1e-5)
    np.testing.assert_allclose(levels[3, 0], levels[3, 1, ::-1])


def test_weights_scale_the_samples_of_some_sonars(tmp_path: Path) -> None:
    """EdgeTech's: 2^-N for each ping; of other sonars the field means nothing."""
    file = Changed(tmp_path)
    plain = file.open().part().read().levels
    file.headers(range(3), weight=2).headers(range(3, 6), weight=-1)
    np.testing.assert_array_equal(file.open().part().read().levels, plain)
    scaled = file.file(sensor=38).open().part().read().levels
    np.testing.assert_allclose(scaled[:3], plain[:3] / 16, rtol=1e-6)
    np.testing.assert_allclose(scaled[3:], plain[3:] * 4, rtol=1e-6)
    for damaged in (-32768, -31, 31, 32767):
        file.headers(weight=damaged)
        np.testing.assert_array_equal(file.open().part().read().levels, plain)


def test_more_than_six_channels_enlarge_the_header(tmp_path: Path) -> None:
    """Port and starboard behind six other channels; samples of the others are not in the pings."""
    file = Changed(tmp_path)
    described = bytes(file.data[256 : 256 + 2 * 128])
    others = bytes(6 * 128)
    header = bytes(file.data[:256]) + others + described
    pings = bytearray(file.data[1024:])
    for ping in range(6):
        for side in range(2):
            at = ping * file.size + 256 + side * 144
            pings[at : at + 2] = struct.pack("<H", 6 + side)
    file.data = bytearray(header.ljust(2048, b"\0") + pings)
    recording = file.file(sonar_channels=8).open()
    assert len(recording) == 6
    assert not recording.notes


def test_what_is_no_side_scan_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match="holds no ping with port and starboard"):
        Changed(tmp_path).channels(type=0).open()
    with pytest.raises(MitsonarError, match="0 channels"):
        Changed(tmp_path).file(sonar_channels=0).open()
    with pytest.raises(MitsonarError, match="no such file"):
        mitsonar.open_side_scan(tmp_path / "absent.xtf")
    (tmp_path / "text.xtf").write_text("{not sonar}" * 200)
    with pytest.raises(MitsonarError, match=r"holds no ping|channels"):
        mitsonar.open_side_scan(tmp_path / "text.xtf")
    (tmp_path / "text.txt").write_text("x" * 3000)
    with pytest.raises(MitsonarError, match="is not a side-scan that mitsonar reads: it reads XTF"):
        mitsonar.open_side_scan(tmp_path / "text.txt")


def test_a_folder_names_the_recording_in_it(tmp_path: Path) -> None:
    Changed(tmp_path)
    for opened in (mitsonar.open_side_scan, mitsonar.open_recording):
        with pytest.raises(MitsonarError, match=r"mitsonar reads: give the recording in it, .*line\.xtf"):
            opened(tmp_path)


def test_side_scans_have_no_frames(tmp_path: Path) -> None:
    file = Changed(tmp_path)
    with pytest.raises(MitsonarError, match="a side-scan, which has pings in place of frames"):
        mitsonar.open_recording(file.path)
    with pytest.raises(MitsonarError, match="a side-scan, which has pings in place of frames"):
        mitsonar.load_frames(file.path)


def speckled(pings: int, fill: float | None, samples: int, *, side: int | None = None) -> Echogram:
    """Exponential speckle around 0.1, with the last samples of both sides, or of one, set to a value."""
    echogram = side_scan_echogram(pings=pings)
    levels = np.random.default_rng(3).exponential(0.1, echogram.levels.shape).clip(max=0.9).astype(np.float32)
    if fill is not None:
        levels[:, slice(None) if side is None else side, -samples:] = fill
    levels[0, 0, 0] = 1.0  # full scale of the writer
    return replace(echogram, levels=levels)


@pytest.mark.parametrize("fill", [0.0, 1.0])
@pytest.mark.parametrize("samples", [1, 9, 30])
def test_samples_that_no_ping_fills_are_left_out(tmp_path: Path, fill: float, samples: int) -> None:
    written = speckled(40, fill, samples)
    recording = Changed(tmp_path, written).open()
    read, bins = recording.part().read(), written.sounder.fan.range_bins
    assert read.levels.shape[2] == bins - samples
    np.testing.assert_allclose(read.range_m, written.range_m[:-samples], rtol=1e-6)
    np.testing.assert_allclose(np.sqrt(read.levels), np.sqrt(written.levels[..., :-samples]), atol=1e-4)
    assert recording.notes == (f"left out: {count_noun(samples, 'sample')} at the end of each side, never filled",)


def test_a_few_last_samples_of_one_byte_are_left_out(tmp_path: Path) -> None:
    """As in the real file: the last amplitudes vary, below 128 of 32,767 counts."""
    written = speckled(40, None, 0)
    written.levels[..., -2:] *= 1e-5
    assert Changed(tmp_path, written).open().part().sounder.fan.range_bins == written.sounder.fan.range_bins - 2


@pytest.mark.parametrize(
    "written",
    [
        speckled(40, None, 0),
        speckled(9, 0.0, 4),  # too few pings to decide
        speckled(40, 0.0, 4, side=1),  # one side is filled
        replace(speckled(40, None, 0), levels=np.full_like(speckled(40, None, 0).levels, 0.5)),
    ],
    ids=["speckle", "few pings", "one side", "constant"],
)
def test_samples_that_may_be_echoes_stay(tmp_path: Path, written: Echogram) -> None:
    recording = Changed(tmp_path, written).open()
    assert recording.part().sounder.fan.range_bins == written.sounder.fan.range_bins
    assert not recording.notes


def test_echoes_that_fade_below_a_count_stay(tmp_path: Path) -> None:
    """Absorption takes them to 0, within a few tens of samples, without a step."""
    written = speckled(40, None, 0)
    bins = written.levels.shape[2]
    written.levels[...] *= np.exp(-40 * np.arange(bins) / bins).astype(np.float32)
    written.levels[0, 0, 0] = 1.0
    part = Changed(tmp_path, written).open().part()
    assert (part.read().levels[..., -1] == 0).all()
    assert part.sounder.fan.range_bins == bins


# ---------------------------------------------------------------- a real file


@with_sample
def test_a_real_file_is_read_as_pyxtf_reads_it() -> None:
    pyxtf = pytest.importorskip("pyxtf")
    recording = mitsonar.open_side_scan(REAL)
    part = recording.part()
    assert len(recording.parts) == 1
    assert len(part) == 461
    assert part.sounder.fan.frequency_hz == 600e3
    assert part.sounder.fan.sound_speed == 1500
    # the recorder wrote one byte of the last sample of each side
    assert "left out: 1 sample at the end of each side, never filled" in recording.notes
    assert part.sounder.fan.range_max == pytest.approx(29.98 * 1023 / 1024, abs=0.01)
    assert part.origin is not None
    assert part.origin.epsg == 32619
    assert recording.facts["fixes"] == "219 in 461 pings"
    assert 50 < np.linalg.norm(part.poses[-1, :2] - part.poses[0, :2]) < 60
    assert np.linalg.norm(np.diff(part.poses[:, :2], axis=0), axis=1).max() < 0.3  # the first ping too
    levels = part.read().levels
    _, packets = pyxtf.xtf_read(str(REAL))
    pings = packets[pyxtf.XTFHeaderType.sonar]
    amplitude = np.array([[ping.data[0][::-1], ping.data[1]] for ping in pings], dtype=float)
    np.testing.assert_allclose(levels, np.square(amplitude[..., :-1] / 32767), rtol=1e-5)
    assert (amplitude[..., -1] < 128).all()
    for name, column, sign in (("SensorPitch", 3, -1), ("SensorRoll", 4, 1)):
        stated = np.array([getattr(ping, name) for ping in pings[1:]])
        np.testing.assert_allclose(np.degrees(part.poses[1:, column]), sign * stated, atol=1e-5)
