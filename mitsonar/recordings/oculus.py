"""How is a recording of a Blueprint Subsea Oculus read? Message dumps (``.raw``) and logs (``.oculus``), versions 0 to 2.

Sources of the layouts are public readers: liboculus (BSD-3-Clause) for messages, and oculus_driver (its files under
BSD-3-Clause) for logs. Version 0 with 8-bit samples was checked on real pings. Version 2, other sample widths, row gains
and logs were not, as no such file was available. The authors of hydroformats (Apache-2.0) report that real logs have these
headers. They also report a real log of version 2 whose start times are in seconds and whose bearings are negative to port.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import preset
from mitsonar.io.files import INFLATION
from mitsonar.recordings.recording import (
    ELEVATION_PATTERN,
    Bytes,
    Facts,
    Header,
    Part,
    Pixels,
    Recording,
    in_time_order,
    layout,
    mapped,
    runs_of,
)
from mitsonar.records.frames import SonarFrames

__all__ = [
    "DUMP",
    "HEADER",
    "LATER",
    "LOG",
    "OLDER",
    "PING",
    "Messages",
    "OculusImages",
    "find_messages",
    "is_oculus",
    "read_oculus",
]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

FIRE = {
    "version": (8, "<u2"), "mode": (16, "u1"), "ping_rate": (17, "u1"), "gamma": (19, "u1"), "flags": (20, "u1"),
    "range_demand": (21, "<f8"), "gain_percent": (29, "<f8"), "salinity": (45, "<f8"),
}  # fmt: skip
"""Fields that all versions hold at the same offset."""

OLDER = layout(
    FIRE
    | {
        "number": (53, "<u4"), "status": (57, "<u4"), "frequency": (61, "<f8"), "sound_speed": (85, "<f8"),
        "start": (93, "<u4"), "width": (97, "u1"), "resolution": (98, "<f8"), "ranges": (106, "<u2"), "beams": (108, "<u2"),
        "image": (110, "<u4"), "image_size": (114, "<u4"), "size": (118, "<u4"),
    },
    122,
)  # fmt: skip
"""Fields of a message of version 0 or 1: offset from its start [bytes] and type."""

LATER = layout(
    FIRE
    | {
        "number": (89, "<u4"), "status": (93, "<u4"), "frequency": (97, "<f8"),
        "heading": (121, "<f8"), "pitch": (129, "<f8"), "roll": (137, "<f8"), "sound_speed": (145, "<f8"),
        "start": (153, "<f8"), "width": (161, "u1"), "resolution": (162, "<f8"), "ranges": (170, "<u2"),
        "beams": (172, "<u2"), "image": (190, "<u4"), "image_size": (194, "<u4"), "size": (198, "<u4"),
    },
    202,
)  # fmt: skip
"""Fields of a message of version 2."""

ROW_GAINS = 4
"""Bit of the flags: each image row begins with its gain, 4 bytes."""

RATES = {0: 10.0, 1: 15.0, 2: 40.0, 3: 5.0, 4: 2.0}
"""Maximum ping rates by their code [Hz]."""

RESOLUTION_TOLERANCE = 0.002
"""Relative change of the range resolution, caused by drift of the sound speed, up to which a window counts as the same."""

MAX_BEARING_DEG = 85.0
"""Largest plausible bearing [deg]."""

MAX_CELLS = 2**28
MAX_RANGE_M = 1e4
"""Largest plausible number of cells of an image, and largest plausible range [m]."""

MAX_STEP_S, MAX_TIME_S = 1e4, 1e11
"""Largest plausible time between two pings, and largest plausible time [s]."""

CLOCK_TOLERANCE_S = 1.0
"""Largest deviation from a constant offset with which the clocks of sonar and log count as synchronous [s]."""

BANDS = {
    "oculus-m750d-750khz": (6e5, 9e5),
    "oculus-m1200d-1200khz": (1e6, 1.5e6),
    "oculus-m1200d-2100khz": (1.9e6, 2.4e6),
}
"""Carrier bands [Hz] of the presets that supply elevation aperture and beam width."""

ELEVATION_DEG = 20.0
"""Elevation aperture if no preset supplies it [deg]."""


def read_oculus(path: str | Path) -> Recording:
    """Open a dump of Oculus messages or an Oculus log; pixels are read on demand.

    Row r lies at (r + 1/2) times the range resolution. Columns follow the bearings in each message, which need not be
    evenly spaced, from negative (port) to positive (starboard); the sonar is assumed to be mounted upright. Counts are
    amplitude^gamma, with gamma 0.5 for the gamma byte 127, and 1 for 0 and 255. If rows begin with a gain, counts are
    divided by its square root, as two public readers do. Images are uint8 if samples have 8 bits and no gains, otherwise
    float32.

    Times are those of the log, or the start times of version 2 [s]. A log of version 2 has both: then times are those of the
    sonar, which do not jitter, shifted to the clock of the log. The counter of older versions has no known unit: it rises by
    62.5 million per ping in real files, and one public driver calls it microseconds. Times of such a dump are computed from
    the ping numbers and the ping rate, or 10 Hz if the code of that rate is unknown.
    Attitude is that of version 2 [deg], whose pitch is assumed to be positive upwards.

    Raises:
        MitsonarError: if the file does not exist, has another format, is an encrypted log, or holds no readable ping.
    """
    data = mapped(path, "an Oculus recording", HEADER.size)
    name = str(path)
    messages = find_messages(data, name)
    pings, notes = _pings_of(messages)
    log = bool(np.isfinite(messages.time_s).any())
    time_s, time_notes = _times(pings, messages.time_s[pings.place])
    order, order_notes = in_time_order(time_s, pings.head["number"])
    pings = pings.select(order)
    parts = tuple(_part(messages, pings.select(run), time_s[order][run]) for _, run in runs_of(_windows(pings)))
    format_name = "Oculus log (.oculus)" if log or data[:2].tobytes() != b"SO" else "Oculus messages (.raw)"
    return Recording(name, format_name, parts, _facts(pings.head), (*notes, *time_notes, *order_notes, *_notes(pings.head)))


class _Pings(NamedTuple):
    """Readable pings.

    Attributes:
        place: index of the message of each ping ``(pings,)``.
        head: header fields ``(pings,)``.
        fan: index into ``fans`` of each ping ``(pings,)``.
        fans: distinct bearing tables, each ``(beams,)`` [deg].
    """

    place: Index
    head: Header
    fan: Index
    fans: list[Array]

    def select(self, index: Index) -> _Pings:
        return _Pings(self.place[index], self.head[index], self.fan[index], self.fans)


def _pings_of(messages: Messages) -> tuple[_Pings, list[str]]:
    """Return the pings whose header and bearings are plausible, and sentences on what is left out."""
    if not len(messages):
        raise MitsonarError(f"{messages.name} holds no ping of an Oculus: {len(messages.data):,} bytes without an image")
    # Pad every header to the size of the longest version, so that all of them are checked in one array operation.
    blocks = b"".join(messages.head(one, LATER.itemsize).ljust(LATER.itemsize, b"\0") for one in range(len(messages)))
    head = _fields(np.frombuffer(blocks, np.dtype((np.void, LATER.itemsize))))
    plausible = _are_plausible(head, messages.size)
    # Store each distinct bearing table once: pings of the same mode repeat it. -1 marks a table that is not plausible.
    fans: dict[bytes, int] = {}
    tables: list[Array] = []
    fan = np.full(len(messages), -1, dtype=np.intp)
    for one in np.flatnonzero(plausible):
        start, beams = (LATER if head["version"][one] >= 2 else OLDER).itemsize, int(head["beams"][one])
        content = messages.head(int(one), start + 2 * beams)[start:]
        if content not in fans:
            table = np.frombuffer(content, "<i2") / 100.0 if len(content) == 2 * beams else np.zeros(0)
            fans[content] = len(tables) if _is_fan(table) else -1
            tables += [table] if _is_fan(table) else []
        fan[one] = fans[content]
    place = np.flatnonzero(fan >= 0)
    notes = []
    if len(place) < len(messages):
        notes.append(f"left out: {count_noun(len(messages) - len(place), 'damaged ping')}")
    if messages.skipped:
        notes.append(
            f"left out: {count_noun(messages.skipped, 'message or item', 'messages or items')} of other kinds "
            "without an image"
        )
    if messages.left_over:
        notes.append(f"{messages.left_over:,} bytes are not a complete message and are left out")
    if not len(place):
        raise MitsonarError(f"{messages.name} holds no ping of an Oculus that can be read: {'; '.join(notes)}")
    return _Pings(place, head[place], fan[place], tables), notes


def _fields(blocks: NDArray[np.void]) -> Header:
    """Return the header fields of messages ``(n,)`` of any version; nan where an older version lacks a field."""
    older, later = (np.ndarray((len(blocks),), kind, blocks, 0, (LATER.itemsize,)) for kind in (OLDER, LATER))
    assert LATER.names is not None
    kinds = {name: "<f8" if name == "start" else LATER[name].str for name in LATER.names}
    fields = np.zeros(len(blocks), dtype=list(kinds.items()))
    is_later = later["version"] >= 2
    for name in LATER.names:
        fields[name] = np.where(is_later, later[name], older[name] if name in (OLDER.names or ()) else np.nan)
    return fields


def _are_plausible(head: Header, size: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which headers ``(n,)`` are plausible for messages of these sizes ``(n,)`` [bytes]."""
    ranges, beams, image = (head[name].astype(np.int64) for name in ("ranges", "beams", "image"))
    rows = ranges * beams * (np.minimum(head["width"], 3) + 1)
    start = np.where(head["version"] >= 2, LATER.itemsize, OLDER.itemsize)
    step = np.where((head["resolution"] > 1e-6) & (head["resolution"] < MAX_RANGE_M), head["resolution"], np.nan)
    return np.asarray(
        (head["version"] <= 2)
        & (head["width"] <= 3)
        & (ranges > 0)
        & (beams > 1)
        & (ranges * beams <= MAX_CELLS)
        & (step * ranges < MAX_RANGE_M)
        & (image >= start + 2 * beams)
        & (head["image_size"] >= rows)
        & (image + head["image_size"] <= size)
    )


def _is_fan(bearings_deg: Array) -> bool:
    """Return whether bearings are strictly monotonic and lie in front of the sonar."""
    steps = np.diff(bearings_deg)
    return len(steps) > 0 and bool((steps > 0).all() or (steps < 0).all()) and np.abs(bearings_deg).max() <= MAX_BEARING_DEG


def _gained(head: Header) -> NDArray[np.bool_]:
    """Return whether the rows of each image begin with a gain: the flag is set and the image is large enough for it."""
    ranges = head["ranges"].astype(np.int64)
    stride = head["beams"].astype(np.int64) * (head["width"] + 1) + 4
    return np.asarray((head["flags"] & ROW_GAINS > 0) & (head["image_size"] >= ranges * stride))


def _times(pings: _Pings, logged_s: Array) -> tuple[Array, list[str]]:
    """Return the times of the pings ``(n,)`` [s], and a sentence if they are assumed."""
    head = pings.head
    start: Array = head["start"].astype(np.float64)
    has_clock = (head["version"] >= 2).all() and len(head) > 1 and _is_clock(start)
    if np.isfinite(logged_s).any():
        return (_shifted(start, logged_s) if has_clock else logged_s), []
    if has_clock:
        return start, []
    number = np.diff(head["number"].astype(np.int64))
    number = np.where((number > 0) & (number < 1_000_000), number, 1)
    codes = np.unique(head["ping_rate"])
    rate = RATES.get(int(codes[0]), 10.0) if len(codes) == 1 else 10.0
    reason = "the greatest ping rate" if len(codes) == 1 and int(codes[0]) in RATES else "assumed"
    note = f"the file holds no times in a known unit: they are computed from the ping numbers at {rate:g} Hz ({reason})"
    return np.concatenate([[0.0], np.cumsum(number)]) / rate, [note]


def _shifted(start_s: Array, logged_s: Array) -> Array:
    """Return the sonar's times shifted to the clock of the log ``(n,)`` [s]; those of the log if the clocks diverge."""
    offset_s = logged_s - start_s
    shift = np.nanmedian(offset_s)
    return start_s + shift if bool((np.abs(offset_s - shift) < CLOCK_TOLERANCE_S).all()) else logged_s


def _is_clock(time_s: Array) -> bool:
    """Return whether times are plausible: strictly increasing, by less than ``MAX_STEP_S`` at a time."""
    if not (np.abs(time_s) < MAX_TIME_S).all():
        return False
    steps = time_s[1:] - time_s[:-1]
    return bool(((steps > 0) & (steps < MAX_STEP_S)).all())


def _windows(pings: _Pings) -> list[tuple[float, ...]]:
    """Return the values that determine the geometry of each frame; small drifts of the range resolution are ignored."""
    keys, step = [], 0.0
    gained = _gained(pings.head)
    for one, ping in enumerate(pings.head):
        if abs(float(ping["resolution"]) - step) > RESOLUTION_TOLERANCE * step:
            step = float(ping["resolution"])
        rest = (ping["ranges"], pings.fan[one], ping["width"], ping["gamma"], ping["mode"], gained[one])
        keys.append((step, *(float(value) for value in rest)))
    return keys


def _part(messages: Messages, pings: _Pings, time_s: Array) -> Part:
    head, bearings = pings.head, np.radians(pings.fans[int(pings.fan[0])])
    falling = bool(bearings[0] > bearings[-1])
    images = OculusImages(
        messages=messages,
        place=pings.place,
        offset=head["image"].astype(np.int64),
        shape=(int(head["ranges"][0]), int(head["beams"][0])),
        width=int(head["width"][0]) + 1,
        gained=bool(_gained(head[:1])[0]),
        falling=falling,
    )
    like = _empty_frames(head, bearings[::-1] if falling else bearings, time_s, images)
    return Part(like=like, time_s=time_s, images=images, attitude_rad=_attitude(head))


def _empty_frames(head: Header, bearings: Array, time_s: Array, images: OculusImages) -> SonarFrames:
    """Return empty frames with the geometry of a part."""
    first = head[0]
    bins, beams = images.shape
    step = float(np.median(head["resolution"]))
    frequency = float(first["frequency"])
    known = _preset_name(frequency)
    named = preset(known) if known else None
    layout_name, fan_deg = _beam_layout(bearings)
    sonar = Sonar.create(
        name=known or "oculus",
        azimuth_fov_deg=fan_deg,
        elevation_fov_deg=named.elevation_fov_deg if named else ELEVATION_DEG,
        elevation_pattern=ELEVATION_PATTERN,
        beam_width_deg=named.beam_width_deg if named else None,
        beams=beams,
        range_min=0.0,
        range_max=bins * step,
        range_bins=bins,
        sound_speed=_speed(head),
        bearing="cone",
        beam_layout=layout_name,
        frequency_hz=frequency if 1e4 < frequency < 1e8 else None,
        frame_rate_hz=_rate(time_s),
        coding="gamma",
        coding_gamma=gamma_exponent(int(first["gamma"])),
    )
    return SonarFrames(
        image=np.zeros((0, bins, beams), np.uint8 if images.eight_bit else np.float32),
        range_m=(np.arange(bins, dtype=np.float64) + 0.5) * step,
        bearing_rad=bearings,
        time_s=np.zeros(0),
        sonar=sonar,
        level="gamma",
    )


def _preset_name(frequency: float) -> str | None:
    """Return the name of the preset for a carrier [Hz]; None if there is none."""
    return next((name for name, (low, high) in BANDS.items() if low < frequency < high), None)


def _beam_layout(bearings: Array) -> tuple[str, float]:
    """Return the beam layout, evenly spaced in the angle or in its sine, and the field of view [deg]."""
    variation = [float(np.std(steps) / np.mean(steps)) for steps in (np.diff(bearings), np.diff(np.sin(bearings)))]
    sides = len(bearings) / (len(bearings) - 1)
    if variation[0] <= variation[1]:
        return "even", min(180.0, float(np.degrees(bearings[-1] - bearings[0])) * sides)
    half = float(np.sin(bearings[-1]) - np.sin(bearings[0])) / 2 * sides
    return "sine", 2 * math.degrees(math.asin(min(1.0, half)))


def gamma_exponent(code: float) -> float:
    """Return the exponent encoded by a gamma byte: 1 for 0 and 255, otherwise the byte divided by 254 (127 is 0.5)."""
    return 1.0 if code in (0, 255) else code / 254


def _speed(head: Header) -> float:
    speed = head["sound_speed"][(head["sound_speed"] > 1000) & (head["sound_speed"] < 2000)]
    return float(np.median(speed)) if len(speed) else 1500.0


def _rate(time_s: Array) -> float:
    seconds = float(time_s[-1] - time_s[0])
    return min(1e6, (len(time_s) - 1) / seconds) if seconds > 0 else 10.0


def _attitude(head: Header) -> Array | None:
    """Return pitch, roll, heading ``(frames, 3)`` [rad], pitch positive downwards; None if no message holds them."""
    degrees = np.stack([-head["pitch"], head["roll"], head["heading"]], axis=1).astype(float)
    degrees = np.where(np.abs(degrees) <= 360, degrees, np.nan)
    return np.radians(degrees) if np.nan_to_num(degrees).any() else None


def _facts(head: Header) -> Facts:
    """Return header values, keyed by name."""
    if not len(head):
        return {}
    first = head[0]
    facts: Facts = {name: int(first[name]) for name in ("version", "mode", "gamma", "flags", "ranges", "beams")}
    facts |= {"bits": 8 * (int(first["width"]) + 1), "row_gains": bool(_gained(head[:1])[0])}
    facts |= {"ping_numbers": [int(head["number"][0]), int(head["number"][-1])]}
    for name, field in (("gain_percent", "gain_percent"), ("frequency_hz", "frequency"), ("sound_speed", "sound_speed")):
        if math.isfinite(first[field]):
            facts[name] = float(first[field])
    return facts


def _notes(head: Header) -> list[str]:
    """Return sentences on what changes within the file and on what is assumed."""
    notes = []
    gains = np.unique(head["gain_percent"][np.isfinite(head["gain_percent"])])
    if len(gains) > 1:
        notes.append(f"the gain changes between {gains[0]:.4g} and {gains[-1]:.4g} %")
    if _gained(head).any():
        notes.append(
            "rows have gains: counts were divided by their square roots, relative to the smallest gain of the first frame "
            "of each part"
        )
    codes = [int(code) for code in np.unique(head["gamma"]) if code not in (0, 127, 255)]
    if codes:
        notes.append(
            f"the gamma byte {codes[0]} is interpreted as the exponent {gamma_exponent(codes[0]):.3g}: "
            "only 0, 127 and 255 are known"
        )
    if not ((head["sound_speed"] > 1000) & (head["sound_speed"] < 2000)).any():
        notes.append("the messages hold no plausible sound speed: 1500 m/s is assumed; ranges do not depend on it")
    if not _preset_name(float(head["frequency"][0])):
        notes.append(f"no preset has this carrier: an elevation aperture of {ELEVATION_DEG:g} deg is assumed")
    return notes


# ---------------- Messages in a dump or a log


DUMP, LOG = b"SO", struct.pack("<I", 0x11223344)
"""First bytes of a message, and therefore of a dump; first bytes of a log."""

DATABASE = b"SQLite format 3\0"
"""First bytes of a log of ViewPoint 2, which is not supported."""

ITEM = struct.pack("<I", 0xAABBCCDD)
"""First bytes of an item in a log."""

HEADER = struct.Struct("<HHHHHIH")
"""Header of a message: mark, source, destination, kind, version, number of bytes that follow, spare."""

LOG_HEADER = struct.Struct("<II16sHH4xqd")
"""Header of a log: mark, size of this header, source, version, encryption, key, time."""

ITEM_HEADER = struct.Struct("<IIHH4xdH2xII")
"""Header of an item: mark, size of this header, kind, version, time [s], compression, decompressed and stored bytes."""

PING = 0x23
"""Kind of message that holds an image."""

KINDS = (0x15, 0x22, PING, 0x55, 0x80, 0xFF)
"""All kinds of message."""

MAX_VERSION = 2
"""Latest supported version of a message."""

MESSAGE_ITEM = 10
"""Kind of item that holds one message."""

MAX_HEADER_BYTES = 4096
MAX_MESSAGE_BYTES = 2**26
"""Largest plausible header in a log, and largest plausible size of a decompressed message [bytes]."""

CHUNK_BYTES = 4096
"""Number of compressed bytes that are decompressed at a time."""


class _MessageLocation(NamedTuple):
    """Location of a message in a file: offset, stored bytes, decompressed bytes (0 if not compressed), item time [s]."""

    begin: int
    stored: int
    unpacked: int
    time_s: float


@dataclass(frozen=True)
class Messages:
    """The image messages of a file.

    Attributes:
        name: name of the file.
        data: the whole file.
        begin: offset of each message ``(messages,)`` [bytes].
        stored: size of each message in the file ``(messages,)`` [bytes].
        unpacked: decompressed size of each message ``(messages,)`` [bytes]; 0 if it is not compressed.
        time_s: time of each message in the log ``(messages,)`` [s]; nan where unknown.
        left_over: number of bytes of the file that belong to no message.
        skipped: number of messages of other kinds.
    """

    name: str
    data: Bytes
    begin: NDArray[np.int64]
    stored: NDArray[np.int64]
    unpacked: NDArray[np.int64]
    time_s: NDArray[np.float64]
    left_over: int = 0
    skipped: int = 0

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.begin)

    @property
    def size(self) -> NDArray[np.int64]:
        """Return the size of each message including its header ``(messages,)`` [bytes]."""
        return np.where(self.unpacked > 0, self.unpacked, self.stored)

    def head(self, number: int, count: int) -> bytes:
        """Return the first ``count`` bytes of a message; fewer if it is shorter or damaged."""
        begin, stored = int(self.begin[number]), int(self.stored[number])
        if not self.unpacked[number]:
            return self.data[begin : begin + min(stored, count)].tobytes()
        try:
            return _decompress(self.data.data[begin : begin + stored], min(count, int(self.unpacked[number])))
        except zlib.error:
            return b""

    def whole(self, number: int) -> Bytes:
        """Return all bytes of a message.

        Raises:
            MitsonarError: if compressed bytes are damaged.
        """
        begin, stored, size = int(self.begin[number]), int(self.stored[number]), int(self.unpacked[number])
        if not size:
            return self.data[begin : begin + stored]
        try:
            content = _decompress(self.data.data[begin : begin + stored], size)
        except zlib.error as error:
            raise MitsonarError(f"{self.name}: the message at byte {begin:,} cannot be unpacked: {error}") from None
        if len(content) < size:
            raise MitsonarError(
                f"{self.name}: the message at byte {begin:,} unpacks to {len(content):,} bytes, not to {size:,}"
            )
        return np.frombuffer(content, np.uint8)


def is_oculus(path: Path, first: bytes) -> bool:
    """Return whether the first bytes of a file, 16 or more, are those of a dump or a log."""
    if first.startswith(LOG) or (first.startswith(DATABASE) and path.suffix.lower() == ".oculus"):
        return True
    if not first.startswith(DUMP) or len(first) < HEADER.size:
        return False
    kind, version = HEADER.unpack_from(first)[3:5]
    return kind in KINDS and version <= MAX_VERSION


def find_messages(data: Bytes, name: str) -> Messages:
    """Find all image messages in a dump or a log.

    Messages follow one another in a dump (``.raw``), and are the content of items in a log (``.oculus``). Only headers are
    read, so that a file of any size opens at once. Bytes that belong to no message are skipped.

    Args:
        data: the whole file.
        name: name of the file, for error messages.

    Raises:
        MitsonarError: if the file is neither a dump nor a log, or the log is encrypted.
    """
    first = data[:16].tobytes()
    if first.startswith(DATABASE):
        raise MitsonarError(f"{name} is a log of ViewPoint 2, a database: export it in the format of ViewPoint 1")
    if first.startswith(LOG):
        return _find_in_log(data, name)
    if not first.startswith(DUMP):
        raise MitsonarError(
            f"{name} is not a recording of an Oculus: it begins with {first[:4]!r}, not with {DUMP!r} (.raw) or {LOG!r} "
            "(.oculus)"
        )
    return _find_in_dump(data, name)


class _MessageCollector:
    """Collector of message locations; compact arrays need only a few bytes per message."""

    def __init__(self) -> None:
        self.locations = [array("q"), array("q"), array("q")]
        self.times = array("d")
        self.bytes = 0
        self.skipped = 0

    def add(self, location: _MessageLocation) -> None:
        for column, value in zip(self.locations, location[:3], strict=True):
            column.append(value)
        self.times.append(location.time_s)

    def messages(self, data: Bytes, name: str) -> Messages:
        begin, stored, unpacked = (np.array(column, dtype=np.int64) for column in self.locations)
        left_over = len(data) - self.bytes
        return Messages(name, data, begin, stored, unpacked, np.array(self.times), left_over, self.skipped)


def _find_in_dump(data: Bytes, name: str) -> Messages:
    collector, view, mark, offset = _MessageCollector(), data.data, re.compile(re.escape(DUMP)), 0
    while hit := mark.search(view, offset):
        offset = hit.start()
        if offset + HEADER.size > len(view):
            break
        kind, version, follow = HEADER.unpack_from(view, offset)[3:6]
        if kind not in KINDS or version > MAX_VERSION or offset + HEADER.size + follow > len(view):
            offset += 1  # the mark occurred by chance: continue the search after its first byte
            continue
        size = HEADER.size + follow
        collector.bytes += size
        if kind == PING:
            collector.add(_MessageLocation(offset, size, 0, np.nan))
        else:
            collector.skipped += 1
        offset += size
    return collector.messages(data, name)


def _find_in_log(data: Bytes, name: str) -> Messages:
    view = data.data
    if len(view) < LOG_HEADER.size:
        raise MitsonarError(
            f"{name} has {len(view):,} bytes, fewer than the {LOG_HEADER.size} of a log's header: the file is cut off"
        )
    offset, encryption = (LOG_HEADER.unpack_from(view)[one] for one in (1, 4))
    if encryption:
        raise MitsonarError(f"{name} is encrypted (kind {encryption}): export it without encryption")
    if not LOG_HEADER.size <= offset <= MAX_HEADER_BYTES:
        offset = LOG_HEADER.size
    collector, mark = _MessageCollector(), re.compile(re.escape(ITEM))
    collector.bytes = offset
    while hit := mark.search(view, offset):
        offset = hit.start()
        if offset + ITEM_HEADER.size > len(view):
            break
        _, head, kind, _, time_s, packing, unpacked, follow = ITEM_HEADER.unpack_from(view, offset)
        if not ITEM_HEADER.size <= head <= MAX_HEADER_BYTES or offset + head + follow > len(view):
            offset += 1  # the mark occurred by chance: continue the search after its first byte
            continue
        begin, time_s = offset + head, time_s if abs(time_s) < 1e11 else np.nan
        collector.bytes += head + follow
        if kind == MESSAGE_ITEM and follow > HEADER.size and packing in (0, 1):
            _add_item(collector, view, _MessageLocation(begin, follow, unpacked if packing else 0, time_s))
        else:
            collector.skipped += 1
        offset = begin + follow
    return collector.messages(data, name)


def _add_item(collector: _MessageCollector, view: memoryview, item: _MessageLocation) -> None:
    """Add an item if its message holds an image.

    The content of a compressed item begins with its decompressed size, most significant byte first.
    """
    if item.unpacked:
        size = int.from_bytes(view[item.begin : item.begin + 4], "big")
        most = min(MAX_MESSAGE_BYTES, INFLATION * item.stored)
        if size != item.unpacked or not HEADER.size < size <= most:
            collector.skipped += 1
            return
        item = item._replace(begin=item.begin + 4, stored=item.stored - 4)
        try:
            head = _decompress(view[item.begin : item.begin + item.stored], HEADER.size)
        except zlib.error:
            head = b""
    else:
        head = bytes(view[item.begin : item.begin + HEADER.size])
    if len(head) == HEADER.size and head[:2] == DUMP and HEADER.unpack(head)[3] == PING:
        collector.add(item)
    else:
        collector.skipped += 1


def _decompress(packed: memoryview, count: int) -> bytes:
    """Decompress the first ``count`` bytes, or all if there are fewer; never allocates more than that.

    Raises:
        zlib.error: if the bytes are damaged.
    """
    content, unpacker = bytearray(), zlib.decompressobj()
    for start in range(0, len(packed), CHUNK_BYTES):
        content += unpacker.decompress(packed[start : start + CHUNK_BYTES], count - len(content))
        while unpacker.unconsumed_tail and len(content) < count:
            content += unpacker.decompress(unpacker.unconsumed_tail, count - len(content))
        if len(content) >= count or unpacker.eof:
            break
    return bytes(content)


# ---------------- Images


@dataclass(frozen=True)
class OculusImages:
    """Function that reads the images of a part: rows of counts of 8 to 32 bits, each with or without a gain.

    Attributes:
        messages: messages of the file.
        place: index of the message of each frame ``(frames,)``.
        offset: offset of each frame's image in its message ``(frames,)`` [bytes].
        shape: number of bins and of beams.
        width: size of a count [bytes].
        gained: whether each row begins with its gain.
        falling: whether the first beam of a message is the one farthest to starboard.
    """

    messages: Messages
    place: Index
    offset: NDArray[np.int64]
    shape: tuple[int, int]
    width: int
    gained: bool
    falling: bool

    @property
    def eight_bit(self) -> bool:
        """Return whether images are the unchanged bytes of the file."""
        return self.width == 1 and not self.gained

    def __call__(self, index: Index) -> Pixels:
        """Return images ``(n, bins, beams)``, column 0 farthest to port.

        Counts are scaled relative to the smallest gain of the part's first frame.
        """
        images: Pixels = np.empty((len(index), *self.shape), np.uint8 if self.eight_bit else np.float32)
        reference = self._rows(0)[0].min(initial=np.inf) if self.gained and len(index) else 1.0
        for one, frame in enumerate(index):
            gains, counts = self._rows(int(frame))
            if self.eight_bit:
                images[one] = counts
            else:
                scale = np.sqrt(reference / gains)[:, None] if self.gained else 1.0
                images[one] = np.minimum(counts * (scale / (256.0**self.width - 1)), 1.0)
        return images[:, :, ::-1] if self.falling else images

    def _rows(self, frame: int) -> tuple[Array, NDArray[Any]]:
        """Return the row gains ``(bins,)`` and the counts ``(bins, beams)`` of a frame."""
        bins, beams = self.shape
        begin, stride = int(self.offset[frame]), beams * self.width + 4 * self.gained
        whole = self.messages.whole(int(self.place[frame]))
        rows = whole[begin : begin + bins * stride].reshape(bins, stride)
        if not self.gained:
            return np.ones(bins), _counts(rows, self.width)
        gains = np.ascontiguousarray(rows[:, :4]).view("<u4")[:, 0].astype(float)
        return np.maximum(gains, 1.0), _counts(rows[:, 4:], self.width)


def _counts(rows: NDArray[np.uint8], width: int) -> NDArray[Any]:
    """Return counts ``(bins, beams)`` assembled from 1 to 4 bytes each, least significant byte first."""
    if width == 1:
        return rows
    parts = rows.reshape(len(rows), -1, width)
    counts = np.zeros(parts.shape[:2], np.uint32)
    for one in range(width):
        counts |= parts[:, :, one].astype(np.uint32) << np.uint32(8 * one)
    return counts
