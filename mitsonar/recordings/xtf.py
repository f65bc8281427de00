"""How is an XTF file of a side-scan read? By the published layout, with every size checked against the file.

Source of the layout: Triton Imaging, eXtended Triton Format (XTF), revision 42; :mod:`mitsonar.recordings.write_xtf` has its
fields. Packets of other kinds (attitude, bathymetry, serial text ...) are counted and left out. Bytes that are no packet are
skipped up to the next mark of one, so that a damaged packet costs only itself; the package pyxtf, which the tests compare
this reader with, gives up such a file, and reads no file of more than six channels.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.recordings.recording import Bytes, Facts, Header, mapped
from mitsonar.recordings.side_scan import (
    MOST_WEIGHT,
    SOUND_SPEEDS,
    Band,
    Index,
    Levels,
    PingHeaders,
    SideScan,
    SideScanPart,
    amplitudes_of,
    in_hertz,
    marked_packets,
    parts_of,
    place_pings,
    sound_speed_of,
)
from mitsonar.recordings.write_xtf import CHANNEL, DEGREES, FILE, FULL_COUNT, PING, PING_CHANNEL, PORT, STARBOARD

__all__ = ["is_xtf", "read_xtf"]

Array = NDArray[np.float64]

FORMAT = 0x7B
"""First byte of the file."""

HEADER_BYTES = 1024
"""Size of the file header with up to six channels, and step by which more channels enlarge it [bytes]."""

CHANNELS_IN_HEADER, CHANNELS_IN_STEP = 6, 8

MOST_CHANNELS = 256

MAGIC = b"\xce\xfa"
"""First bytes of a packet."""

PACKET = struct.Struct("<2xBxH4xI")
"""Kind of a packet, its number of channels, and its size [bytes]."""

CHANNEL_HEAD = struct.Struct("<H40xI")
"""Number of a channel, and its samples."""

SIDE_SCAN_PACKET = 0
"""Kind of a packet with the samples of side-scans and sub-bottom profilers."""

GROUND_RANGE = 2
"""Mark of a channel whose samples were resampled to ground range."""

IBM_FLOAT = 1
FORMATS = {2: "<i4", 3: "<i2", 5: "<f4", 8: "i1"}
"""NumPy types of samples by the code in a channel's description; 0 leaves it to the number of bytes."""

FULL_SCALES = {1: 255.0, 2: float(FULL_COUNT), 4: float(2**31 - 1)}
"""Count of full scale for integers of so many bytes; floats count as they are."""

WEIGHTED = (24, 35, 38, 48)
"""Sonars, by their code in the file header, whose samples are scaled by 2^-N with a weight N in each channel's header."""


def is_xtf(path: Path, first: bytes) -> bool:
    """Return whether a file is XTF, by its first bytes and its name, or the mark of its first packet."""
    if not first or first[0] != FORMAT:
        return False
    if path.suffix.lower() == ".xtf":
        return True
    try:
        with path.open("rb") as file:
            file.seek(HEADER_BYTES)
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def read_xtf(path: Path) -> SideScan:
    """Open an XTF file; samples are read part by part.

    A part is a pair of port and starboard channels, of one frequency, with one range. Sound speeds may be stored as half of
    their value, which is doubled. Positions are those of the sonar, or else of the ship.

    Raises:
        MitsonarError: if the file does not exist, has another format, or holds no ping of port and starboard.
    """
    data = mapped(path, "an XTF file", HEADER_BYTES)
    if data[0] != FORMAT:
        raise MitsonarError(f"{path} is no XTF file: its first byte is {int(data[0])} instead of {FORMAT}")
    head = np.frombuffer(data[: FILE.itemsize].tobytes(), FILE)[0]
    channels, start = _channels(data, head, path.name)
    packets = _find_pings(data, start, channels)
    if not packets.offsets:
        raise MitsonarError(
            f"{path} holds no ping with port and starboard samples{packets.summary()}: it is damaged, or of another sonar"
        )
    table = np.frombuffer(b"".join(data[at : at + PING.itemsize].tobytes() for at in packets.offsets), PING)
    headers, notes = _ping_headers(table, in_degrees=int(head["nav_units"]) == DEGREES)
    placed = place_pings(headers)
    sound_speed, speed_note = _sound_speed(table)
    name = " ".join(_text(head[key]) for key in ("program", "sonar")).strip()
    parts: list[SideScanPart] = []
    for pair, lines in packets.pairs.items():
        band = _band(data, channels, pair, lines, name, sound_speed, weighted=int(head["sensor"]) in WEIGHTED)
        of_pair, left_out = parts_of(band, placed)
        parts += of_pair
        notes += left_out
    facts: Facts = {"recorded by": " ".join(_text(head[key]) for key in ("program", "version")), **placed.facts}
    if note := _text(head["note"]):
        facts["text"] = note
    ground_range = any(channels[side].correction == GROUND_RANGE for pair in packets.pairs for side in pair)
    if ground_range:
        notes.append("the file marks its samples as corrected to ground range: ranges are wrong by this correction")
    all_notes = (*packets.notes(len(data)), *placed.notes, *dict.fromkeys(notes), *speed_note)
    return SideScan(path.name, "XTF (.xtf)", tuple(parts), facts, all_notes)


def _text(raw: bytes) -> str:
    """Return the printable part of a text field, up to its first zero byte."""
    return "".join(one for one in bytes(raw).split(b"\0")[0].decode("latin-1") if one.isprintable()).strip()


# ---------------- File header


@dataclass(frozen=True)
class Channel:
    """The description of a channel in the file header.

    Attributes:
        kind: port, starboard, or another.
        samples: type of the samples; None if it is not supported.
        full_scale: amplitude of full scale.
        usual_samples: samples of a ping whose header states none.
        frequency: carrier, in kHz or Hz.
        correction: 1 for slant range, 2 for ground range.
        angles_deg: beam width along and across the track, and tilt [deg].
    """

    kind: int
    samples: np.dtype[np.generic] | None
    full_scale: float
    usual_samples: int
    frequency: float
    correction: int
    angles_deg: tuple[float, float, float]


def _channels(data: Bytes, head: np.void, name: str) -> tuple[list[Channel], int]:
    """Return the channels in the file header, and the size of the header [bytes].

    Raises:
        MitsonarError: if there are no channels, too many, or more than the file can hold.
    """
    count = int(head["sonar_channels"]) + int(head["bathymetry_channels"])
    steps = max(0, -(-(count - CHANNELS_IN_HEADER) // CHANNELS_IN_STEP))
    start = HEADER_BYTES * (1 + steps)
    if not 1 <= count <= MOST_CHANNELS or start > len(data):
        raise MitsonarError(f"{name} states {count:,} channels, and 1 to {MOST_CHANNELS} are allowed: its header is damaged")
    raw = data[FILE.itemsize : FILE.itemsize + count * CHANNEL.itemsize].tobytes()
    return [_channel(one) for one in np.frombuffer(raw, CHANNEL)], start


def _channel(header: np.void) -> Channel:
    """Return a channel by its description."""
    size, code = int(header["sample_bytes"]), int(header["sample_format"])
    kind: str | None = FORMATS.get(code, f"<i{size}" if size in FULL_SCALES else "") or None
    if code == IBM_FLOAT:
        kind = None
    if kind is not None and kind.endswith(("i1", "i2", "i4")) and header["unipolar"]:
        kind = kind.replace("i", "u")
    samples = None if kind is None else np.dtype(kind)
    full_scale = 1.0 if samples is None or samples.kind == "f" else FULL_SCALES[samples.itemsize]
    return Channel(
        int(header["type"]),
        samples,
        full_scale,
        int(header["samples"]),
        float(header["frequency_khz"]),
        int(header["correction"]),
        (float(header["along_deg"]), float(header["width_deg"]), float(header["tilt_deg"])),
    )


# ---------------- Packets


class Side(NamedTuple):
    """One channel of a ping: offset of its header, offset of its samples [bytes], and number of samples."""

    header: int
    begin: int
    samples: int


class Line(NamedTuple):
    """One ping of a pair of channels: number of the ping, and both sides."""

    ping: int
    port: Side
    starboard: Side


@dataclass
class Packets:
    """What the packets of a file hold.

    Attributes:
        offsets: offsets of the packets with pings of side-scans [bytes].
        pairs: pings of each pair of port and starboard channels, keyed by their numbers.
        others: number of packets of other kinds, by kind.
        damaged: number of packets whose channels exceed them or do not fit together.
        bytes: size of all packets [bytes].
    """

    start: int
    offsets: list[int] = field(default_factory=list)
    pairs: dict[tuple[int, int], list[Line]] = field(default_factory=dict)
    others: Counter[int] = field(default_factory=Counter)
    damaged: int = 0
    bytes: int = 0

    def notes(self, size: int) -> list[str]:
        """Return sentences on what was left out of a file of ``size`` bytes."""
        notes = []
        if self.damaged:
            notes.append(f"left out: {count_noun(self.damaged, 'ping')} with damaged channels")
        if self.others:
            kinds = ", ".join(f"{count:,} of kind {kind}" for kind, count in self.others.most_common(5))
            notes.append(f"left out: packets other than pings of side-scans ({kinds})")
        if left_over := size - self.start - self.bytes:
            notes.append(f"skipped: {count_noun(left_over, 'byte')} that belong to no complete packet")
        return notes

    def summary(self) -> str:
        """Return in words which packets there are, for an error message."""
        counts = f"{self.damaged:,} damaged, {sum(self.others.values()):,} of other kinds"
        return f" (packets: {counts})" if self.damaged or self.others else ""


def _find_pings(data: Bytes, start: int, channels: list[Channel]) -> Packets:
    """Find all pings of side-scans; only headers are read."""
    ports, starboards = ([number for number, one in enumerate(channels) if one.kind == side] for side in (PORT, STARBOARD))
    pairs = list(zip(ports, starboards, strict=False))
    packets, view = Packets(start), data.data
    for at, _ in marked_packets(data, MAGIC, start, PACKET.size, lambda view, at: int(PACKET.unpack_from(view, at)[2])):
        kind, count, size = PACKET.unpack_from(view, at)
        packets.bytes += size
        if kind != SIDE_SCAN_PACKET:
            packets.others[kind] += 1
            continue
        sides = _sides(view, at, size, count, channels)
        lines = {
            pair: (sides[pair[0]], sides[pair[1]])
            for pair in pairs
            if pair[0] in sides and pair[1] in sides and sides[pair[0]].samples == sides[pair[1]].samples
        }
        if not lines:
            packets.damaged += 1
            continue
        for pair, (port, starboard) in lines.items():
            packets.pairs.setdefault(pair, []).append(Line(len(packets.offsets), port, starboard))
        packets.offsets.append(at)
    return packets


def _sides(view: memoryview, at: int, size: int, count: int, channels: list[Channel]) -> dict[int, Side]:
    """Return the channels of a ping that lie within its packet, by their numbers."""
    sides: dict[int, Side] = {}
    begin, end = at + PING.itemsize, at + size
    for place in range(count):
        if begin + PING_CHANNEL.itemsize > end:
            break
        number, samples = CHANNEL_HEAD.unpack_from(view, begin)
        if number >= len(channels):  # not numbered as in the file header
            number = place
        if number >= len(channels) or number in sides:
            break
        channel = channels[number]
        samples = samples or channel.usual_samples
        if channel.samples is None or samples < 1:
            break
        header, begin = begin, begin + PING_CHANNEL.itemsize
        if begin + samples * channel.samples.itemsize > end:
            break
        sides[number] = Side(header, begin, samples)
        begin += samples * channel.samples.itemsize
    return sides


# ---------------- Ping headers


def _ping_headers(table: Header, *, in_degrees: bool) -> tuple[PingHeaders, list[str]]:
    """Return what the headers ``(pings,)`` state, and sentences on what was assumed."""
    notes = []
    names = ("heading_deg", "pitch_deg", "roll_deg", "depth_m")
    without_attitude = np.all([table[name] == 0 for name in names], axis=0)
    # 1. positions: the sonar's, or the ship's where the file has none of the sonar; zeros are none, except in local metres
    sonar, ship = (np.column_stack([table[f"{whose}y"], table[f"{whose}x"]]) for whose in ("", "ship_"))
    if not (sonar != 0).any() and (ship != 0).any():
        sonar = ship
        notes.append("positions are those of the ship")
    zero = (sonar == 0).all(axis=1)
    without = zero if in_degrees or zero.all() else zero & without_attitude
    position = np.where(without[:, None], np.nan, sonar)
    if (table["layback_m"] != 0).any():
        notes.append("the file states a layback, which positions do not include")
    # 2. sensors: a ping without a position and without any attitude states nothing; a column of zeros states nothing
    silent = without & without_attitude
    values = {name: _floats(table, name) for name in names}
    values = {name: np.where(silent | ~(np.abs(stated) < 1e5), np.nan, stated) for name, stated in values.items()}
    if not np.nansum(np.abs(values["heading_deg"])):
        gyro = _floats(table, "gyro_deg")
        values["heading_deg"] = np.where((np.abs(gyro) < 1e5) & (gyro != 0).any(), gyro, np.nan)
    first, second = _floats(table, "altitude_m"), _floats(table, "second_altitude_m")
    height_m = np.where(first > 0, first, second)
    return (
        PingHeaders(
            time_s=_times(table),
            position=position if in_degrees else position[:, ::-1],
            in_degrees=in_degrees,
            heading_deg=values["heading_deg"],
            pitch_deg=values["pitch_deg"],
            roll_deg=values["roll_deg"],
            depth_m=values["depth_m"],
            height_m=np.where((height_m > 0) & (height_m < 1e5), height_m, np.nan),
        ),
        notes,
    )


def _floats(table: Header, name: str) -> Array:
    """Return a field of headers as doubles; nan of damaged bytes may be of the kind that signals."""
    with np.errstate(invalid="ignore"):
        return np.asarray(table[name].astype(np.float64))


def _times(table: Header) -> Array:
    """Return the times of pings ``(pings,)`` in seconds since 1970; nan where date or time are not valid."""
    year, month, day = (table[name].astype(np.int64) for name in ("year", "month", "day"))
    clock = {name: table[name].astype(np.int64) for name in ("hour", "minute", "second", "hundredths")}
    valid = (year >= 1970) & (year <= 2200) & (month >= 1) & (month <= 12) & (day >= 1) & (day <= 31)
    for name, end in (("hour", 24), ("minute", 60), ("second", 61), ("hundredths", 100)):
        valid &= clock[name] < end
    months = np.where(valid, (year - 1970) * 12 + month - 1, 0).astype("datetime64[M]")
    days = months.astype("datetime64[D]").astype(np.int64) + day - 1
    seconds = days * 86400 + clock["hour"] * 3600 + clock["minute"] * 60 + clock["second"]
    return np.where(valid, seconds + clock["hundredths"] / 100, np.nan)


def _sound_speed(table: Header) -> tuple[float, list[str]]:
    """Return the median sound speed [m/s] by the headers, and a sentence if it was assumed.

    The field holds half of the sound speed by the format, since echoes go there and back; some programs store all of it.
    """
    stated, computed = _floats(table, "half_sound_speed"), _floats(table, "sound_speed")
    return sound_speed_of(np.where(stated < SOUND_SPEEDS[1] / 2, 2 * stated, stated), computed)


# ---------------- Samples


def _band(
    data: Bytes,
    channels: list[Channel],
    pair: tuple[int, int],
    lines: list[Line],
    name: str,
    sound_speed: float,
    *,
    weighted: bool,
) -> Band:
    """Return the pings of a pair of channels."""
    table, starboard = (_channel_headers(data, [getattr(line, side) for line in lines]) for side in ("port", "starboard"))
    # int64: the absolute value of -32,768 overflows 16 bits
    weight = np.column_stack([table["weight"], starboard["weight"]]).astype(np.int64) * weighted
    weight[np.abs(weight) > MOST_WEIGHT] = 0
    slant, delay, duration = (_floats(table, name) for name in ("slant_range_m", "delay_s", "duration_s"))
    duration = np.where((duration > 0) & (duration < 1e3), duration, np.nan)
    near = np.where((delay > 0) & (delay < 1e3), delay, 0) * sound_speed / 2
    far = np.where((slant > 0) & (slant <= 1e5), slant, np.nan_to_num(near + duration * sound_speed / 2))
    near = np.where(near < far, near, 0.0)
    stated = np.where(table["frequency_khz"] > 0, table["frequency_khz"], channels[pair[0]].frequency).astype(float)
    along, across, tilt = channels[pair[0]].angles_deg
    begin = np.array([[line.port.begin, line.starboard.begin] for line in lines], dtype=np.int64)
    samples = np.array([line.port.samples for line in lines], dtype=np.int64)
    usable = np.flatnonzero(far > 0)
    return Band(
        rows=np.array([line.ping for line in lines], dtype=np.intp)[usable],
        samples=samples[usable],
        range_min=near[usable],
        range_max=far[usable],
        frequency_hz=in_hertz(stated)[usable],
        levels=_Samples(data, begin[usable], samples[usable], weight[usable], (channels[pair[0]], channels[pair[1]])),
        name=name,
        sound_speed=sound_speed,
        azimuth_fov_deg=along,
        elevation_fov_deg=across,
        tilt_deg=tilt,
    )


def _channel_headers(data: Bytes, sides: list[Side]) -> Header:
    """Return the headers of channels ``(n,)``."""
    raw = b"".join(data[one.header : one.header + PING_CHANNEL.itemsize].tobytes() for one in sides)
    return np.frombuffer(raw, PING_CHANNEL)


@dataclass(frozen=True)
class _Samples:
    """Function that reads the intensities of pings.

    Attributes:
        data: the whole file.
        begin: offsets of the port and starboard samples ``(n, 2)`` [bytes].
        samples: number of samples of a side ``(n,)``.
        weight: exponents N of a scale 2^-N ``(n, 2)``.
        sides: the channels.
    """

    data: Bytes
    begin: NDArray[np.int64]
    samples: NDArray[np.int64]
    weight: NDArray[np.int64]
    sides: tuple[Channel, Channel]

    def __call__(self, pings: Index) -> Levels:
        """Return intensities ``(n, 2, bins)`` relative to full scale, squares of amplitudes, from near to far.

        Raises:
            MitsonarError: if a sample is not a number, or too large for one.
        """
        bins = int(self.samples[pings[0]])
        levels = np.empty((len(pings), 2, bins), np.float32)
        for side, channel in enumerate(self.sides):
            kind = channel.samples
            assert kind is not None  # channels without a type have no pings
            for row, ping in enumerate(pings):
                at = int(self.begin[ping, side])
                raw = np.frombuffer(self.data[at : at + bins * kind.itemsize].tobytes(), kind)
                scale = 2.0 ** -float(self.weight[ping, side]) / channel.full_scale
                levels[row, side] = np.square(amplitudes_of(raw, int(ping)) * scale)
        levels[:, 0] = levels[:, 0, ::-1].copy()  # port is stored from its outermost sample inwards
        return levels
