"""ARIS files (``.aris``, DDF 5) of Sound Metrics: header, frames, range axis by delay and period, beams by table.

Source of the layout: Sound Metrics, aris-file-sdk and aris-integration-sdk (MIT).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, counted
from mitsonar.instruments.sonar import Sonar
from mitsonar.recordings.beam_table import TABLES, aris_bearings
from mitsonar.recordings.header_motion import MOTION, attitude_of, height_of, poses_of
from mitsonar.recordings.ping_file import Bytes, EqualFrames, Header, layout, mapped
from mitsonar.recordings.recording import Facts, Part, Recording, in_time_order, runs_of
from mitsonar.records.frames import SonarFrames

__all__ = [
    "BEAMS",
    "CHANNELS",
    "FRAME",
    "KINDS",
    "PINGS",
    "SIGNATURE",
    "facts_of",
    "in_beam_order",
    "like_of",
    "notes_of",
    "read_aris",
    "windows_of",
]

SIGNATURE = b"DDF\x05"

FILE_HEADER = 1024

FRAME = layout(
    MOTION
    | {
        "index": (0, "<u4"), "time_us": (4, "<u8"), "signature": (12, "S4"), "sonar_time_us": (20, "<u8"),
        "window_start_m": (52, "<f4"), "window_length_m": (56, "<f4"), "gain_db": (68, "<u4"), "temperature_c": (224, "<f4"),
        "ping_mode": (436, "<u4"), "high_frequency": (440, "<u4"), "pulse_us": (444, "<u4"),
        "sample_period_us": (452, "<u4"), "transmits": (456, "<u4"),
        "frame_rate_hz": (460, "<f4"), "sound_speed": (464, "<f4"), "samples": (468, "<u4"), "start_delay_us": (476, "<u4"),
        "large_lens": (480, "<u4"), "system": (484, "<u4"), "serial": (488, "<u4"), "reordered": (516, "<u4"),
        "salinity": (520, "<u4"),
    },
    1024,
)  # fmt: skip
"""Fields of a frame's header: offset [bytes] and type."""

BEAMS = (
    dict.fromkeys((1, 2), 48)
    | dict.fromkeys((3, 4, 5), 96)
    | dict.fromkeys((6, 7, 8), 64)
    | dict.fromkeys(range(9, 13), 128)
)
"""Beams of each ping mode."""

PINGS = {1: 3, 3: 6, 6: 4, 9: 8}
"""Pings of a frame in transmission order, by ping mode."""

CHANNELS = (10, 2, 14, 6, 8, 0, 12, 4, 11, 3, 15, 7, 9, 1, 13, 5)
"""Group of beams that each channel of the receiver belongs to, in transmission order."""

CODING_DB = 80.0
"""Span of the values 0..255 [dB]."""

MOST_SAMPLES = 65_536
LEAST_SPEED, MOST_SPEED = 1000.0, 2000.0
LONGEST_M = 1e4
"""What a header may say: samples of a beam, sound speed [m/s], end of the window [m]."""

SAME_SPEED = 0.002
"""Relative change of the sound speed up to which a window counts as the same."""


class Kind(NamedTuple):
    """A type of ARIS: its name, carriers low and high [Hz], and opening over elevation [deg] (data sheets)."""

    name: str
    low_hz: float
    high_hz: float
    elevation_deg: float


KINDS = {
    0: Kind("1800", 1.1e6, 1.8e6, 14.0),
    1: Kind("3000", 1.8e6, 3.0e6, 15.0),
    2: Kind("1200", 0.7e6, 1.2e6, 14.0),
}
"""By the number in the header."""

TELEPHOTO_ELEVATION_DEG = 3.0
"""Opening over elevation with the large lens [deg]; ours, no source was seen."""


def read_aris(path: str | Path) -> Recording:
    """Open an ARIS recording; pixels are read on demand.

    Ranges are ``start delay`` and ``sample period`` times half the sound speed: sample i lies at r0 + i dr. Values 0..255
    stand for 0..80 dB. Attitude is that of the sonar's compass; pitch > 0 points down. Where the file holds latitudes and
    longitudes, poses are metres east and north of the first frame.

    Raises:
        MitsonarError: no such file, another format, or no frame that can be read.
    """
    data = mapped(path, "an ARIS file", FILE_HEADER + FRAME.itemsize)
    name = str(path)
    if bytes(data[:4]) != SIGNATURE:
        raise MitsonarError(f"{name} is no ARIS file: it begins with {bytes(data[:4])!r}, not with {SIGNATURE!r}")
    frames, beams = _frames_of(data, name)
    headers = frames.table()
    whole, notes = _whole(headers, frames)
    kept, sorting = in_time_order(np.where(whole, headers["time_us"] * 1e-6, np.nan), headers["index"])
    parts = tuple(_part(frames, headers, kept[run], beams) for _, run in runs_of(windows_of(headers[kept])))
    return Recording(
        name, "ARIS 5 (.aris)", parts, facts_of(headers[kept], beams), (*notes, *sorting, *notes_of(headers[kept]))
    )


def _frames_of(data: Bytes, name: str) -> tuple[EqualFrames, int]:
    """Return the frames and the number of beams, by the first header."""
    first = np.frombuffer(data[FILE_HEADER : FILE_HEADER + FRAME.itemsize].tobytes(), FRAME)[0]
    mode, samples = int(first["ping_mode"]), int(first["samples"])
    if mode not in BEAMS or not 0 < samples <= MOST_SAMPLES:
        raise MitsonarError(
            f"{name}: the first frame says ping mode {mode} and {samples:,} samples a beam; there are ping modes 1 to 12 "
            f"and samples 1 to {MOST_SAMPLES:,}: the file is damaged"
        )
    frames = EqualFrames(data, FILE_HEADER, FRAME, samples * BEAMS[mode])
    if not len(frames):
        raise MitsonarError(f"{name} holds no whole frame: {len(data):,} bytes, and a frame takes {frames.stride:,}")
    return frames, BEAMS[mode]


def _whole(headers: Header, frames: EqualFrames) -> tuple[NDArray[np.bool_], list[str]]:
    """Return which frames have a header that can be, and sentences on the others."""
    first, told = headers[0], headers["sound_speed"].astype(float)
    speed = np.where((told > LEAST_SPEED) & (told < MOST_SPEED), told, np.nan)
    whole = (headers["signature"] == SIGNATURE) & (headers["ping_mode"] == first["ping_mode"])
    whole &= headers["samples"] == first["samples"]
    end_us = headers["start_delay_us"] + headers["sample_period_us"] * headers["samples"].astype(float)
    whole &= (
        (headers["sample_period_us"] > 0) & (end_us * 1e-6 * speed / 2 < LONGEST_M) & np.isin(headers["system"], list(KINDS))
    )
    tabled = whole & _tabled(headers)
    whole = tabled if tabled.any() else whole  # where all frames lack a table, the error says which
    notes = []
    if not whole.all():
        notes.append(f"left out: {counted(int((~whole).sum()), 'frame')} with a damaged header")
    if frames.left_over:
        notes.append(f"the last {frames.left_over:,} bytes are no whole frame and are left out")
    return whole, notes


def _tabled(headers: Header) -> NDArray[np.bool_]:
    """Return which frames ``(frames,)`` have a table of beam angles."""
    beams, lens = BEAMS[int(headers["ping_mode"][0])], headers["large_lens"] != 0
    known = lens & (("telephoto", beams) in TABLES)
    for system, kind in KINDS.items():
        known |= ~lens & (headers["system"] == system) & ((kind.name, beams) in TABLES)
    return np.asarray(known, dtype=bool)


def windows_of(headers: Header) -> list[tuple[float, ...]]:
    """Return what the geometry of each frame follows from; small drifts of the sound speed count as none."""
    names = ("start_delay_us", "sample_period_us", "large_lens", "system", "high_frequency")
    keys, speed = [], 0.0
    for header in headers:
        if abs(float(header["sound_speed"]) - speed) > SAME_SPEED * speed:
            speed = float(header["sound_speed"])
        keys.append((speed, *(float(header[name]) for name in names)))
    return keys


def _part(frames: EqualFrames, headers: Header, places: NDArray[np.intp], beams: int) -> Part:
    mine = headers[places]
    samples = int(mine["samples"][0])
    raw = _Samples(frames, places, samples, beams, int(mine["ping_mode"][0]), bool(mine["reordered"].all()))
    attitude = attitude_of(mine)
    return Part(
        like=like_of(mine, samples, beams),
        time_s=mine["time_us"] * 1e-6,
        images=raw,
        poses=poses_of(mine, attitude),
        attitude_rad=attitude,
        height_m=height_of(mine),
        gain_db=mine["gain_db"].astype(float),
    )


@dataclass(frozen=True)
class _Samples:
    """The samples of a part's frames, as images."""

    frames: EqualFrames
    places: NDArray[np.intp]
    samples: int
    beams: int
    mode: int
    reordered: bool

    def __call__(self, index: NDArray[np.intp]) -> Bytes:
        """Return ``(n, bins, beams)``, column 0 most to port."""
        raw = self.frames.read(self.places[index], (self.samples, self.beams))
        if not self.reordered:
            flags = self.frames.headers()["reordered"][self.places[index]]
            raw = np.stack([one if flag else in_beam_order(one, self.mode) for one, flag in zip(raw, flags, strict=True)])
        return raw[:, :, ::-1]


def in_beam_order(samples: Bytes, mode: int) -> Bytes:
    """Return a frame ``(samples, beams)`` of a live stream in the order of its beams.

    A live stream holds pings x samples x 16 channels. Channel c of ping p is beam ``CHANNELS[c] * pings + p``.

    Raises:
        MitsonarError: a ping mode whose order is not known.
    """
    if mode not in PINGS:
        known = ", ".join(str(one) for one in PINGS)
        raise MitsonarError(
            f"the order of ping mode {mode} is not known: known are {known}; record it with the vendor's program"
        )
    pings = PINGS[mode]
    by_ping = samples.reshape(pings, -1, len(CHANNELS))
    beams = np.array(CHANNELS)[None, :] * pings + np.arange(pings)[:, None]
    ordered = np.empty((by_ping.shape[1], pings * len(CHANNELS)), dtype=samples.dtype)
    ordered[:, beams.ravel()] = by_ping.transpose(1, 0, 2).reshape(by_ping.shape[1], -1)
    return ordered


def like_of(headers: Header, samples: int, beams: int) -> SonarFrames:
    """Return frames without images: the geometry of a part."""
    first = headers[0]
    kind = KINDS[int(first["system"])]
    lens = bool(first["large_lens"])
    bearings = aris_bearings("telephoto" if lens else kind.name, beams)
    speed = float(np.median(headers["sound_speed"]))
    step = float(first["sample_period_us"]) * 1e-6 * speed / 2
    near = float(first["start_delay_us"]) * 1e-6 * speed / 2
    sonar = Sonar.create(
        name=f"aris{kind.name}",
        azimuth_fov_deg=float(np.degrees(bearings[-1] - bearings[0]) * beams / (beams - 1)),
        elevation_fov_deg=TELEPHOTO_ELEVATION_DEG if lens else kind.elevation_deg,
        beams=beams,
        range_min=near,
        range_max=near + samples * step,
        range_bins=samples,
        sound_speed=speed,
        bearing="cone",
        frequency_hz=kind.high_hz if first["high_frequency"] else kind.low_hz,
        frame_rate_hz=_rate(headers),
        coding="dB",
        coding_db=CODING_DB,
    )
    return SonarFrames(
        image=np.zeros((0, samples, beams), np.uint8),
        range_m=near + np.arange(samples, dtype=np.float64) * step,
        bearing_rad=bearings,
        time_s=np.zeros(0),
        sonar=sonar,
        level="dB",
    )


def _rate(headers: Header) -> float:
    """Return the frames a second: as stated, or by the times."""
    stated = float(headers["frame_rate_hz"][0])
    if math.isfinite(stated) and 0 < stated < 1e3:
        return stated
    seconds = float(headers["time_us"][-1] - headers["time_us"][0]) * 1e-6
    return (len(headers) - 1) / seconds if seconds > 0 else 10.0


def facts_of(headers: Header, beams: int) -> Facts:
    """Return what the headers tell, by name."""
    if not len(headers):
        return {}
    first = headers[0]
    names = (
        "ping_mode",
        "high_frequency",
        "large_lens",
        "serial",
        "sample_period_us",
        "start_delay_us",
        "pulse_us",
        "samples",
    )
    facts: Facts = {"system": f"ARIS {KINDS[int(first['system'])].name}", "beams": beams}
    facts |= {name: int(first[name]) for name in names} | {"gain_db": int(first["gain_db"])}
    facts["sound_speed"] = float(first["sound_speed"])
    known = headers["temperature_c"][np.isfinite(headers["temperature_c"])]  # attitude is in the frames, in our signs
    if len(known):
        facts["temperature_c"] = [float(known.min()), float(known.max())]
    return facts


def notes_of(headers: Header) -> list[str]:
    """Return sentences on what changes inside the file."""
    gains = np.unique(headers["gain_db"])
    return [f"the receiver's gain changes between {gains[0]} and {gains[-1]} dB"] if len(gains) > 1 else []
