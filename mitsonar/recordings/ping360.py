"""How is a recording of a Blue Robotics Ping360 read? Logs of Ping Viewer (``.bin``), and text that ``brping`` prints.

Sources of the layouts: Ping Viewer's page ``binary-structure`` for logs, and ping-protocol (messages 2300 and 2301). Text
and CSV of two real recordings were available, whose checksums are those of messages packed by this layout. The logs
themselves were not: ``.bin`` is tested on files of our tests only.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import preset
from mitsonar.recordings.recording import Bytes, Facts, Header, Recording, mapped
from mitsonar.recordings.sweeps import ScanPings, sweep_parts
from mitsonar.records.frames import SonarFrames

__all__ = ["is_ping360_log", "is_ping360_text", "read_ping360_log", "read_ping360_text", "scanning_frames"]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

DEVICE_DATA, AUTO_DEVICE_DATA = 2300, 2301
"""Numbers of the messages with samples: the answer to a request, and that of an automatic scan."""

FIELDS = ("gain", "angle", "duration", "period", "frequency", "samples")
"""Fields of a message: gain setting, angle [gradian], pulse [us], sample period [25 ns], carrier [kHz], samples."""

PAYLOADS = {DEVICE_DATA: struct.Struct("<xBHHHHHH"), AUTO_DEVICE_DATA: struct.Struct("<xBHHHH6xHH")}
"""Layout of a payload ahead of its samples: the fields, and the number of samples again."""

PING = np.dtype([*((name, "<u2") for name in FIELDS), ("place", "<i8"), ("size", "<i4"), ("time_s", "<f8")])
"""A ping: its fields, offset and size of its samples in the file [bytes], and its time [s], nan if unknown."""

TICK_S = 25e-9
"""Unit of the sample period [s]."""

FORWARD = 200
"""Angle of the head that points forward [gradian]: Ping Viewer shows it at the top, and angles increase clockwise."""

GRADIAN = math.pi / 200

SOUND_SPEED = 1500.0
"""Sound speed that Ping Viewer assumes by default [m/s]; recordings do not contain it."""

STEP_OVERHEAD_S = 0.02
"""Time of a ping beyond its echo, for files without times [s]; that of the preset ``ping360``."""

LOG_TITLES = (b"PingViewer", "PingViewer".encode("utf-16-be"))
"""First words of a log after the length of the title, as UTF-8 or UTF-16."""

TEXT_STARTS = (b"Header:", b"timestamp:", b'"<bound method P', b"<bound method Pi", b"-" * 16, b"ID: 2300", b"ID: 2301")
"""First bytes of text files, after empty lines."""

RECORD = re.compile(rb"\0\0\0(?:\x18\0\d\0\d\0:\0\d\0\d\0:\0\d\0\d\0\.\0\d\0\d\0\d|\x0c\d\d:\d\d:\d\d\.\d{3})", re.DOTALL)
"""Length and time with which a record of a log begins, as UTF-16 or UTF-8. A message follows."""

BLOCK = re.compile(
    rb"timestamp: '([^'\n]{1,80})'"
    rb"|ID: (2300|2301) - \w{1,40}\r?\nHeader:[^\n]{0,300}\nPayload:\r?\n((?:  - \w{1,40}: \d{1,9}\r?\n){1,20})  - data: \["
)
"""A time, or a message up to its samples, in text."""

VALUE = re.compile(rb"  - (\w+): (\d+)")
WORDS = re.compile(rb"'0x[0-9a-fA-F]{1,2}'(?:, '0x[0-9a-fA-F]{1,2}')*")
FAILED = re.compile(rb"\s*Checksum: \d{1,9} check: \d{1,9} pass: False")
TIME = re.compile(rb"(\d\d):(\d\d):(\d\d)\.(\d\d\d)")

LONGEST_WORD = 8
"""Largest number of characters of a sample in text, with quotes, comma and space."""

DAY_S = 86_400.0


def is_ping360_log(path: Path, first: bytes) -> bool:
    """Return whether a file with these first bytes is a log of Ping Viewer."""
    return first.startswith(b"\0\0\0") and first[4:].startswith(tuple(title[: len(first) - 4] for title in LOG_TITLES))


def is_ping360_text(path: Path, first: bytes) -> bool:
    """Return whether a file with these first bytes is the text of a Ping360's messages."""
    if not first.lstrip().startswith(TEXT_STARTS):
        return False
    try:
        with path.open("rb") as file:
            return BLOCK.search(file.read(4096)) is not None
    except OSError:
        return False


def read_ping360_log(path: str | Path) -> Recording:
    """Open a log of Ping Viewer (``.bin``) that a Ping360 wrote; pixels are read on demand.

    A frame is a sweep of the head (:func:`mitsonar.recordings.sweeps.sweep_parts`). Sample i lies at (i + 1/2) periods of
    25 ns, at the sound speed that Ping Viewer assumes, 1500 m/s. An angle of 200 gradians is forward, and angles increase to
    starboard, as Ping Viewer shows them. The scale of the samples is not published: they are read as amplitudes. Times count
    from the start of the log.

    Raises:
        MitsonarError: if the file does not exist, is damaged, or holds no ping of a Ping360.
    """
    data = mapped(path, "a log of Ping Viewer", 8)
    pings, notes = _pings_of_log(data)
    return _recording(data, str(path), "Ping360 log (.bin)", pings, _log_facts(data), notes, text=False)


def read_ping360_text(path: str | Path) -> Recording:
    """Open messages of a Ping360 as text, which ``brping`` prints, or as the same text in cells of a CSV file.

    Geometry and samples are those of :func:`read_ping360_log`. Without times in the file, a ping is assumed to take its echo
    and 20 ms.

    Raises:
        MitsonarError: if the file does not exist, is damaged, or holds no ping of a Ping360.
    """
    data = mapped(path, "text of a Ping360", 8)
    pings, notes = _pings_of_text(data)
    return _recording(data, str(path), "Ping360 messages (text)", pings, {}, notes, text=True)


def scanning_frames(
    bins: int,
    bin_m: float,
    bearing_rad: Array,
    interval_s: float,
    *,
    name: str = "ping360",
    sound_speed: float = SOUND_SPEED,
    frequency_hz: float | None = None,
) -> SonarFrames:
    """Return empty frames of a Ping360, whose beams ``(beams,)`` are the steps of the head.

    Args:
        bins: number of samples of a ping.
        bin_m: distance of two samples [m].
        bearing_rad: bearings of the steps [rad], increasing.
        interval_s: time between pings [s].
        name: name of the sonar.
        sound_speed: sound speed [m/s].
        frequency_hz: carrier [Hz]; None if unknown.
    """
    head, beams = preset("ping360"), len(bearing_rad)
    assert isinstance(head, Sonar)
    step_deg = math.degrees(float(np.median(np.diff(bearing_rad))))
    span_deg = math.degrees(float(bearing_rad[-1] - bearing_rad[0]))
    sonar = Sonar.create(
        name=name,
        azimuth_fov_deg=min(360.0, span_deg + step_deg),
        elevation_fov_deg=head.elevation_fov_deg,
        beam_width_deg=head.beam_width_deg,
        beams=beams,
        ping_groups=beams,
        group_order="sequential",
        group_interval_s=min(interval_s, 1e3),
        frame_rate_hz=float(np.clip(1 / (beams * interval_s), 1e-6, 1e6)),
        range_min=0.0,
        range_max=bins * bin_m,
        range_bins=bins,
        sound_speed=sound_speed,
        frequency_hz=frequency_hz,
        coding="gamma",
        coding_gamma=1.0,
    )
    return SonarFrames(
        image=np.zeros((0, bins, beams), np.uint8),
        range_m=(np.arange(bins, dtype=np.float64) + 0.5) * bin_m,
        bearing_rad=bearing_rad,
        time_s=np.zeros(0),
        sonar=sonar,
        level="gamma",
    )


def _recording(
    data: Bytes, name: str, words: str, table: Header, facts: Facts, notes: list[str], *, text: bool
) -> Recording:
    """Return the recording that consists of these pings."""
    if not len(table):
        raise MitsonarError(
            f"{name} holds no ping of a Ping360: {'; '.join(notes) or 'other messages only, or damaged ones'}"
        )
    table = table.copy()
    bin_s = table["period"] * TICK_S
    if np.isfinite(table["time_s"]).all():
        table["time_s"] = np.unwrap(table["time_s"], period=DAY_S)  # a clock of 24 hours
    else:
        steps_s = table["samples"] * bin_s + STEP_OVERHEAD_S
        table["time_s"] = np.cumsum(steps_s) - steps_s[0]
        notes.append(f"the file holds no times: a ping is assumed to take its echo and {1e3 * STEP_OVERHEAD_S:g} ms")
    pings = ScanPings(
        time_s=table["time_s"],
        bearing_rad=(table["angle"] - float(FORWARD)) * GRADIAN,
        windows=[(int(one["samples"]), int(one["period"]), int(one["frequency"])) for one in table],
        samples=_Samples(data, name, table, text),
    )

    def like(ping: int, bearing_rad: Array, interval_s: float) -> SonarFrames:
        one = table[ping]
        return scanning_frames(
            int(one["samples"]),
            float(bin_s[ping]) * SOUND_SPEED / 2,
            bearing_rad,
            interval_s,
            frequency_hz=1e3 * float(one["frequency"]) or None,
        )

    try:
        parts, more = sweep_parts(pings, like)
    except MitsonarError as error:
        raise MitsonarError(f"{name}: {error}") from None
    facts |= {"pings": len(table), "pulse_us": _limits(table["duration"]), "gain_setting": _limits(table["gain"])}
    if len(np.unique(table["gain"])) > 1:
        notes.append("the gain setting changes: 0 is low, 1 normal, 2 high")
    notes += [*more, f"the file holds no sound speed: {SOUND_SPEED:g} m/s is assumed, to which ranges are proportional"]
    notes.append("the scale of the samples is not published: they are read as amplitudes")
    return Recording(name, words, parts, facts, tuple(notes))


def _limits(values: NDArray[np.uint16]) -> int | list[int]:
    """Return the only value, or the smallest and the largest."""
    low, high = int(values.min()), int(values.max())
    return low if low == high else [low, high]


def _is_plausible(values: tuple[int, ...], count: int) -> bool:
    """Return whether the fields of a message, in the order of :data:`FIELDS`, and its number of samples fit together."""
    _, angle, _, period, _, samples = values
    return angle < 400 and period > 0 and samples == count > 1


@dataclass(frozen=True)
class _Samples:
    """Function that reads the samples of pings of one window.

    Attributes:
        data: the whole file.
        name: name of the file.
        table: all pings.
        text: whether samples are hexadecimal words instead of bytes.
    """

    data: Bytes
    name: str
    table: Header
    text: bool

    def __call__(self, index: Index) -> NDArray[np.uint8]:
        """Return the samples of pings ``(n, bins)``."""
        pings = self.table[index]
        result = np.zeros((len(pings), int(pings["samples"][0]) if len(pings) else 0), np.uint8)
        for row, place, size in zip(result, pings["place"].tolist(), pings["size"].tolist(), strict=True):
            content = self.data[place : place + size]
            row[:] = _hexadecimal(content.tobytes()) if self.text else content
        return result


def _hexadecimal(words: bytes) -> list[int]:
    """Return the numbers in a text such as ``'0x1', '0xff'``."""
    return [int(word, 16) for word in words.replace(b"'", b"").split(b",")]


# ---------------- Logs of Ping Viewer
# Numbers are big-endian. A log begins with a title, a version, and strings on the program; then follow records, each a time
# and a message of the sonar. A string or message is preceded by its length.


def _pings_of_log(data: Bytes) -> tuple[Header, list[str]]:
    """Return the pings of a log in order, and sentences on what is left out."""
    pings, end, records, lost = [], 0, 0, 0
    for match in RECORD.finditer(data):  # type: ignore[call-overload]
        if match.start() < end:
            continue  # bytes of a message that look like a time
        records += 1
        start = match.end() + 4
        size = int.from_bytes(data[match.end() : start].tobytes(), "big")
        if start + size > len(data):
            lost += 1
            continue
        end = start + size
        content = data[start:end].tobytes()
        for ping in _messages(content):
            if ping is None:
                lost += 1
            else:
                *values, place, count = ping
                pings.append((*values, start + place, count, _seconds(match.group().replace(b"\0", b""))))
    notes = [f"left out: {count_noun(lost, 'cut off or damaged message')}"] if lost else []
    return np.array(pings, PING) if records else np.zeros(0, PING), notes


def _messages(content: bytes) -> list[tuple[int, ...] | None]:
    """Return the fields, offset and number of samples of each message with samples in a record; None for damaged ones.

    A message is ``BR``, length and number, two device numbers, the payload, and the sum of all bytes modulo 65536.
    """
    messages: list[tuple[int, ...] | None] = []
    # sums before each byte modulo 65536: a check costs the same however long a message says that it is
    totals = np.append(np.uint16(0), np.cumsum(np.frombuffer(content, np.uint8), dtype=np.uint16))
    start = content.find(b"BR")
    while 0 <= start <= len(content) - 10:
        length, number = struct.unpack_from("<HH", content, start + 2)
        end = start + 8 + length
        layout = PAYLOADS.get(number)
        if end + 2 > len(content):
            return [*messages, None] if layout else messages
        intact = (int(totals[end]) - int(totals[start])) % 2**16 == int.from_bytes(content[end : end + 2], "little")
        if layout is not None:
            *values, count = layout.unpack_from(content, start + 8) if length >= layout.size else (0,) * 7
            fits = intact and layout.size + count <= length and _is_plausible(tuple(values), count)
            messages.append((*values, start + 8 + layout.size, count) if fits else None)
        start = content.find(b"BR", end + 2 if intact else start + 2)
    return messages


def _log_facts(data: Bytes) -> Facts:
    """Return what the header of a log states of the program that wrote it; nothing if it is damaged."""
    content, place = data[:4096].tobytes(), 0
    texts: dict[str, str] = {}
    for name in ("title", "version", "commit", "built", "release", "system", "system_version"):
        if len(content) < place + 4:
            return {}
        size = int.from_bytes(content[place : place + 4], "big")
        place += 4
        if name == "version":
            texts[name] = str(size)
        elif size != 2**32 - 1:  # no text
            if size > 500:
                return {}
            texts[name] = content[place : place + size].replace(b"\0", b"").decode("ascii", "replace")
            place += size
    system = f"{texts.get('system', '')} {texts.get('system_version', '')}".strip()
    facts = {"log_version": texts["version"], "program": texts.get("built", ""), "system": system}
    return {name: "".join(filter(str.isprintable, value)) for name, value in facts.items() if value}


def _seconds(text: bytes) -> float:
    """Return the seconds of a time such as ``00:01:02.345``; nan if there is none."""
    match = TIME.search(text)
    if match is None:
        return math.nan
    hours, minutes, seconds, milliseconds = map(int, match.groups())
    return hours * 3600 + minutes * 60 + seconds + milliseconds / 1000


# ---------------- Text


def _pings_of_text(data: Bytes) -> tuple[Header, list[str]]:
    """Return the pings of a text in order, and sentences on what is left out."""
    pings, time_s, lost = [], math.nan, 0
    for match in BLOCK.finditer(data):  # type: ignore[call-overload]
        stamp, number, fields = match.groups()
        if stamp is not None:
            time_s = _seconds(stamp.replace(rb"\x00", b"").replace(b"\0", b""))
            continue
        ping = _text_ping(data, match.end(), int(number), {key: int(value) for key, value in VALUE.findall(fields)})
        if ping is None:
            lost += 1
        else:
            pings.append((*ping, time_s))
        time_s = math.nan  # a time belongs to one message
    notes = [f"left out: {count_noun(lost, 'cut off or damaged message')}"] if lost else []
    return np.array(pings, PING), notes


def _text_ping(data: Bytes, start: int, number: int, fields: dict[bytes, int]) -> tuple[int, ...] | None:
    """Return the fields, offset and size of the samples of a message whose samples begin at ``start``; None if damaged."""
    names = (b"gain_setting", b"angle", b"transmit_duration", b"sample_period", b"transmit_frequency", b"number_of_samples")
    values = tuple(fields.get(name, 0) for name in names)
    if max(values) > 2**16 - 1:
        return None
    limit = data[start : start + LONGEST_WORD * values[-1] + 300].tobytes()
    size = limit.find(b"]")
    words = limit[: max(size, 0)]
    fits = WORDS.fullmatch(words) and _is_plausible(values, words.count(b",") + 1)
    if not fits or FAILED.match(limit, size + 1):
        return None
    return (*values, start, size)
