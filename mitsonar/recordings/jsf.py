"""How is a JSF file of an EdgeTech side-scan read? By the published layout, with every size checked against the file.

Source of the layout: EdgeTech, JSF data file description, 0023492 revision M (2024): messages of type 80 hold one ping of
one channel each, a header of 240 bytes and samples. No file of a real sonar was at hand: the tests read files that they
write.
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
from mitsonar.recordings.recording import Bytes, Facts, Header, layout, mapped
from mitsonar.recordings.side_scan import (
    MOST_WEIGHT,
    Band,
    Index,
    Levels,
    PingHeaders,
    SideScan,
    SideScanPart,
    amplitudes_of,
    marked_packets,
    parts_of,
    place_pings,
    sound_speed_of,
)

__all__ = ["MESSAGE", "TRACE", "is_jsf", "read_jsf"]

Array = NDArray[np.float64]

MARK = b"\x01\x16"
"""First bytes of a message."""

MESSAGE = struct.Struct("<2sBBHBBBBHi")
"""Header of a message: mark, version, session, type, command, subsystem, channel, sequence, reserved, bytes that follow."""

SONAR_DATA = 80
"""Type of a message with one ping of one channel."""

MOST_TYPES = 10_000
"""Types of messages are smaller: larger ones are marks that occurred by chance."""

SIDE_SCANS = {20: "low frequency", 21: "high frequency", 22: "very high frequency"}
"""Subsystems that are side-scans."""

PORT, STARBOARD = 0, 1

TRACE = layout(
    {
        "time_s": (0, "<i4"), "first_sample": (4, "<u4"), "ping": (8, "<u4"), "high_bits": (16, "<u2"),
        "low_bits": (18, "<u2"), "valid": (30, "<u2"), "format": (34, "<i2"), "x": (80, "<i4"), "y": (84, "<i4"),
        "units": (88, "<i2"), "samples": (114, "<u2"), "interval_ns": (116, "<u4"), "start_dahz": (126, "<u2"),
        "end_dahz": (128, "<u2"), "depth_mm": (136, "<i4"), "altitude_mm": (144, "<i4"), "sound_speed": (148, "<f4"),
        "weighting": (168, "<i2"), "heading": (172, "<u2"), "pitch": (174, "<i2"), "roll": (176, "<i2"),
        "time_ms": (200, "<u4"), "packet": (220, "<u2"), "layback_m": (228, "<f4"),
    },
    240,
)  # fmt: skip
"""Fields of the header ahead of a ping's samples: offset [bytes] and type."""

POSITION, HEADING, ATTITUDE, ALTITUDE, DEPTH = (1 << bit for bit in (0, 3, 5, 6, 9))
"""Flags of ``valid``."""

DEGREES = 2
UNITS = {1: 1e-3, DEGREES: 1 / 600_000, 3: 0.1, 4: 0.01}
"""Size of a step of coordinates: mm, 10,000th of a minute of arc [deg], dm, cm."""

ANGLE_DEG = 180 / 32768
"""Step of pitch and roll."""

FORMATS = {0: ("<i2", 1), 1: ("<i2", 2), 8: ("<f4", 1)}
"""Type of samples and numbers a sample: envelopes, complex samples behind the matched filter, envelopes as floats."""


def is_jsf(path: Path, first: bytes) -> bool:
    """Return whether the first bytes of a file are those of a JSF message."""
    if not first.startswith(MARK) or len(first) < MESSAGE.size:
        return False
    kind, size = (int(MESSAGE.unpack_from(first)[field]) for field in (3, 9))
    return 0 < kind < MOST_TYPES and size >= 0


def read_jsf(path: Path) -> SideScan:
    """Open a JSF file; samples are read part by part.

    A part is one subsystem with one window: the messages of port and starboard with the same ping number. Values without
    their flag of validity are left out, unless the file sets no flags at all.

    Raises:
        MitsonarError: if the file does not exist, has another format, or holds no ping of port and starboard.
    """
    data = mapped(path, "a JSF file", MESSAGE.size)
    messages = _find_traces(data)
    if not messages.pairs:
        raise MitsonarError(f"{path} holds no ping of a side-scan with port and starboard samples{messages.summary()}")
    parts: list[SideScanPart] = []
    facts: Facts = {}
    notes = messages.notes(len(data))
    for subsystem, pairs in sorted(messages.pairs.items()):
        table = _table(data, [port for port, _ in pairs])
        headers, assumed = _ping_headers(table)
        placed = place_pings(headers)
        sound_speed, speed_note = sound_speed_of(table["sound_speed"])
        of_subsystem, left_out = parts_of(_band(data, table, pairs, subsystem, sound_speed), placed)
        parts += of_subsystem
        facts = placed.facts | facts
        notes += [*placed.notes, *assumed, *speed_note, *left_out]
    return SideScan(path.name, "JSF (.jsf)", tuple(parts), facts, tuple(dict.fromkeys(notes)))


# ---------------- Messages


class Trace(NamedTuple):
    """One ping of one channel: offset of its header [bytes], and samples."""

    header: int
    samples: int


@dataclass
class Messages:
    """What the messages of a file hold.

    Attributes:
        pairs: port and starboard traces of each ping, keyed by subsystem.
        others: number of messages of other kinds, by type.
        damaged: number of traces whose samples exceed their message or have an unknown format.
        alone: number of traces without the other side.
        bytes: size of all messages [bytes].
    """

    pairs: dict[int, list[tuple[Trace, Trace]]] = field(default_factory=dict)
    others: Counter[int] = field(default_factory=Counter)
    damaged: int = 0
    alone: int = 0
    bytes: int = 0

    def notes(self, size: int) -> list[str]:
        """Return sentences on what was left out of a file of ``size`` bytes."""
        notes = []
        if self.damaged:
            notes.append(f"left out: {count_noun(self.damaged, 'trace')} that are damaged, or of an unknown format")
        if self.alone:
            notes.append(f"left out: {count_noun(self.alone, 'trace')} without the other side")
        if self.others:
            kinds = ", ".join(f"{count:,} of type {kind}" for kind, count in self.others.most_common(5))
            notes.append(f"left out: messages other than pings of side-scans ({kinds})")
        if size > self.bytes:
            notes.append(f"skipped: {count_noun(size - self.bytes, 'byte')} that belong to no complete message")
        return notes

    def summary(self) -> str:
        """Return in words which messages there are, for an error message."""
        return (
            f" (messages: {self.damaged:,} damaged, {self.alone:,} of one side only, {sum(self.others.values()):,} of other "
            "types)"
        )


def _find_traces(data: Bytes) -> Messages:
    """Find all pings of side-scans, and pair port and starboard; only headers are read."""
    messages, view = Messages(), data.data
    waiting: dict[tuple[int, int], dict[int, Trace]] = {}
    for at, end in marked_packets(data, MARK, 0, MESSAGE.size, _size_at):
        _, _, _, kind, _, subsystem, channel, _, _, _ = MESSAGE.unpack_from(view, at)
        messages.bytes += end - at
        if kind != SONAR_DATA or subsystem not in SIDE_SCANS or channel not in (PORT, STARBOARD):
            messages.others[kind] += 1
            continue
        trace, ping = _trace(view, at + MESSAGE.size, end)
        if trace is None:
            messages.damaged += 1
            continue
        sides = waiting.setdefault((subsystem, ping), {})
        messages.alone += channel in sides  # a ping number that repeats
        sides[channel] = trace
        if len(sides) == 2:
            del waiting[subsystem, ping]
            if sides[PORT].samples == sides[STARBOARD].samples:
                messages.pairs.setdefault(subsystem, []).append((sides[PORT], sides[STARBOARD]))
            else:
                messages.alone += 2
    messages.alone += sum(map(len, waiting.values()))
    return messages


def _size_at(view: memoryview, at: int) -> int:
    """Return the size of a message with its header [bytes]; 0 if there is none."""
    _, _, _, kind, _, _, _, _, _, size = MESSAGE.unpack_from(view, at)
    return MESSAGE.size + int(size) if 0 < kind < MOST_TYPES and size >= 0 else 0


def _trace(view: memoryview, at: int, end: int) -> tuple[Trace | None, int]:
    """Return the trace in a message and its ping number; no trace if it does not fit or cannot be decoded."""
    if at + TRACE.itemsize > end:
        return None, 0
    header = np.frombuffer(view[at : at + TRACE.itemsize], TRACE)[0]
    ping, code = int(header["ping"]), int(header["format"])
    samples = int(_samples(header))
    if code not in FORMATS or samples < 1 or header["packet"] > 1 or abs(int(header["weighting"])) > MOST_WEIGHT:
        return None, ping
    kind, numbers = FORMATS[code]
    fits = at + TRACE.itemsize + samples * numbers * np.dtype(kind).itemsize <= end
    return (Trace(at, samples) if fits and header["interval_ns"] > 0 else None), ping


def _samples(header: Header | np.void) -> NDArray[np.int64]:
    """Return the numbers of samples, whose highest bits are stored apart."""
    return np.asarray(header["samples"].astype(np.int64) + ((header["high_bits"].astype(np.int64) >> 8 & 15) << 16))


def _table(data: Bytes, traces: list[Trace]) -> Header:
    """Return the headers of traces ``(n,)``."""
    return np.frombuffer(b"".join(data[one.header : one.header + TRACE.itemsize].tobytes() for one in traces), TRACE)


# ---------------- Ping headers


def _ping_headers(table: Header) -> tuple[PingHeaders, list[str]]:
    """Return what the headers ``(pings,)`` state, and sentences on what was assumed."""
    notes = []
    flags_set = bool((table["valid"] != 0).any())

    def stated(flag: int, name: str, scale: float) -> Array:
        known = (table["valid"] & flag) != 0 if flags_set else table[name] != 0
        return np.where(known, table[name] * scale, np.nan)

    # most pings decide the unit of positions
    units, counts = np.unique(table["units"], return_counts=True)
    unit = int(units[np.argmax(counts)])
    known = (table["units"] == unit) & (unit in UNITS) & ((table["x"] != 0) | (table["y"] != 0))
    if flags_set:
        known &= (table["valid"] & POSITION) != 0
    position = np.column_stack([table["x"], table["y"]]) * UNITS.get(unit, 1.0)
    position[~known] = np.nan
    if (table["layback_m"] != 0).any():
        notes.append("the file states a layback, which positions do not include")
    milliseconds = np.where(table["time_ms"] < 86_400_000, table["time_ms"] % 1000, 0)
    altitude = stated(ALTITUDE, "altitude_mm", 1e-3)
    return (
        PingHeaders(
            time_s=np.where(table["time_s"] > 0, table["time_s"] + milliseconds / 1000, np.nan),
            position=position[:, ::-1] if unit == DEGREES else position,
            in_degrees=unit == DEGREES,
            heading_deg=stated(HEADING, "heading", 0.01),
            pitch_deg=stated(ATTITUDE, "pitch", ANGLE_DEG),
            roll_deg=stated(ATTITUDE, "roll", ANGLE_DEG),
            depth_m=stated(DEPTH, "depth_mm", 1e-3),
            height_m=np.where((altitude > 0) & (altitude < 1e5), altitude, np.nan),
        ),
        notes,
    )


# ---------------- Samples


def _band(data: Bytes, port: Header, pairs: list[tuple[Trace, Trace]], subsystem: int, sound_speed: float) -> Band:
    """Return the pings of a subsystem, given the headers of its port traces."""
    samples = _samples(port)
    step_m = (port["interval_ns"] + (port["low_bits"] & 255) / 256) * 1e-9 * sound_speed / 2
    near = port["first_sample"] * step_m
    high = port["high_bits"].astype(np.int64)
    start, end = port["start_dahz"] + ((high & 15) << 16), port["end_dahz"] + ((high >> 4 & 15) << 16)
    starboard = _table(data, [one for _, one in pairs])
    usable = np.flatnonzero(near + samples * step_m <= 1e5)
    return Band(
        rows=usable,
        samples=samples[usable],
        range_min=near[usable],
        range_max=(near + samples * step_m)[usable],
        frequency_hz=(5.0 * (start + end))[usable],
        levels=_Traces(data, [pairs[one] for one in usable], (port[usable], starboard[usable])),
        name=f"EdgeTech, {SIDE_SCANS[subsystem]}",
        sound_speed=sound_speed,
    )


@dataclass(frozen=True)
class _Traces:
    """Function that reads the intensities of pings.

    Attributes:
        data: the whole file.
        pairs: port and starboard traces of each ping.
        headers: headers of port and of starboard ``(n,)``.
    """

    data: Bytes
    pairs: list[tuple[Trace, Trace]]
    headers: tuple[Header, Header]

    def __call__(self, pings: Index) -> Levels:
        """Return intensities ``(n, 2, bins)``, squares of amplitudes, from near to far.

        Raises:
            MitsonarError: if a sample is not a number, or too large for one.
        """
        levels = np.empty((len(pings), 2, self.pairs[pings[0]][0].samples), np.float32)
        for row, ping in enumerate(pings):
            for side, trace in enumerate(self.pairs[ping]):
                header = self.headers[side][ping]
                kind, numbers = FORMATS[int(header["format"])]
                begin = trace.header + TRACE.itemsize
                count = trace.samples * numbers * np.dtype(kind).itemsize
                raw = np.frombuffer(self.data[begin : begin + count].tobytes(), kind)
                power = np.square(amplitudes_of(raw, int(ping)).reshape(-1, numbers)).sum(axis=1)
                levels[row, side] = power * 4.0 ** -int(header["weighting"])
        return levels
