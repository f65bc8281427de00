"""How are files of Sound Metrics read? ARIS (``.aris``, DDF 5) and DIDSON (``.ddf``, DDF 3 and 4).

Source of the layout and the beam angles of ARIS: Sound Metrics, aris-file-sdk and aris-integration-sdk (MIT).

Sources of the layout of DIDSON: public readers of such files, the MATLAB reader of Sound Metrics as they quote it, and the
description of the format by Echoview. No real DIDSON file was available: the reader was tested on files that its tests
write by this description, not on a recording. The authors of hydroformats (Apache-2.0) report that ten recordings of
version 3 have headers of these sizes, this clock, and a sound speed at this offset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import preset
from mitsonar.recordings.recording import (
    ELEVATION_PATTERN,
    Bytes,
    EqualFrames,
    Facts,
    Header,
    Part,
    Recording,
    in_time_order,
    layout,
    mapped,
    runs_of,
)
from mitsonar.records.frames import SonarFrames

__all__ = [
    "BEAMS",
    "CHANNELS",
    "EARTH_M",
    "FILE",
    "FRAME",
    "FRAME_HEADER",
    "KINDS",
    "MOTION",
    "PINGS",
    "SIGNATURE",
    "SIGNATURES",
    "aris_bearings",
    "attitude_of",
    "didson_bearings",
    "empty_aris_frames",
    "facts_of",
    "height_of",
    "in_beam_order",
    "nominal_window",
    "notes_of",
    "poses_of",
    "read_aris",
    "read_didson",
    "windows_of",
]


# ---------------- Attitude, height and position from frame headers


Array = NDArray[np.float64]

MOTION = {
    "depth_m": (128, "<f4"), "altitude_m": (132, "<f4"), "heading_deg": (160, "<f4"), "pitch_deg": (164, "<f4"),
    "roll_deg": (168, "<f4"), "latitude_deg": (172, "<f8"), "longitude_deg": (180, "<f8"),
}  # fmt: skip
"""Fields common to the frame headers of DIDSON and ARIS files: offset [bytes] and type."""

EARTH_M = 6_371_008.8
"""Mean radius of the earth [m]."""

MAX_DEPTH_M = 1.2e4
MAX_HEIGHT_M = 1e4
"""Largest plausible depth, and largest plausible height above the ground [m]."""


def attitude_of(headers: Header) -> Array | None:
    """Return pitch, roll, heading ``(frames, 3)`` [rad] of the compass; None if all are zero, nan where implausible.

    Pitch is positive upwards in the compass, but positive downwards in the result, as in poses.
    """
    degrees = np.stack([-headers["pitch_deg"], headers["roll_deg"], headers["heading_deg"]], axis=1).astype(float)
    attitude = np.radians(np.where(np.abs(degrees) <= 360, degrees, np.nan))
    return attitude if np.any(attitude) else None


def height_of(headers: Header) -> Array | None:
    """Return the height above the ground ``(frames,)`` [m], nan where unknown; None if the vehicle never filled it in."""
    altitude_m = headers["altitude_m"].astype(float)
    known = np.isfinite(altitude_m) & (altitude_m > 0) & (altitude_m < MAX_HEIGHT_M)
    return np.where(known, altitude_m, np.nan) if known.any() else None


def poses_of(headers: Header, attitude_rad: Array | None) -> Array | None:
    """Return poses ``(frames, 6)`` computed from latitude and longitude; None if a frame lacks these or its attitude.

    Positions are metres east and north of the first frame, and the negative depth.
    """
    latitude, longitude = np.radians(headers["latitude_deg"]), np.radians(headers["longitude_deg"])
    known = (np.abs(latitude) < np.pi / 2) & (np.abs(longitude) <= np.pi) & ((latitude != 0) | (longitude != 0))
    if attitude_rad is None or not known.all() or not np.isfinite(attitude_rad).all():
        return None
    depth = headers["depth_m"].astype(float)
    east = (longitude - longitude[0]) * np.cos(latitude[0]) * EARTH_M
    north = (latitude - latitude[0]) * EARTH_M
    return np.column_stack([east, north, -np.where(np.abs(depth) < MAX_DEPTH_M, depth, 0.0), attitude_rad])


# ---------------- ARIS files


SIGNATURE = b"DDF\x05"

FILE_HEADER = 1024

FRAME = layout(
    MOTION
    | {
        "index": (0, "<u4"), "time_us": (4, "<u8"), "signature": (12, "S4"), "sonar_time_us": (20, "<u8"),
        "window_start_m": (52, "<f4"), "window_length_m": (56, "<f4"), "gain_db": (68, "<u4"), "temperature_c": (224, "<f4"),
        "ping_mode": (436, "<u4"), "high_frequency": (440, "<u4"), "pulse_us": (444, "<u4"),
        "cycle_us": (448, "<u4"), "sample_period_us": (452, "<u4"), "transmits": (456, "<u4"),
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
"""Number of beams of each ping mode."""

PINGS = {1: 3, 3: 6, 6: 4, 9: 8}
"""Number of pings of a frame in transmission order, by ping mode."""

CHANNELS = (10, 2, 14, 6, 8, 0, 12, 4, 11, 3, 15, 7, 9, 1, 13, 5)
"""Beam group of each receiver channel, in transmission order."""

ARIS_CODING_DB = 80.0
"""Dynamic range of the values 0..255 [dB]."""

MAX_SAMPLES = 65_536
ARIS_MIN_SPEED, ARIS_MAX_SPEED = 1000.0, 2000.0
MAX_RANGE_M = 1e4
"""Plausible values of a header: maximum samples per beam, sound speed [m/s], maximum end of the window [m]."""

SPEED_TOLERANCE = 0.002
"""Relative change of the sound speed up to which a window counts as the same."""


class Kind(NamedTuple):
    """A model of ARIS: its name, low and high carrier [Hz], and elevation aperture [deg] (data sheets)."""

    name: str
    low_hz: float
    high_hz: float
    elevation_deg: float


KINDS = {
    0: Kind("1800", 1.1e6, 1.8e6, 14.0),
    1: Kind("3000", 1.8e6, 3.0e6, 15.0),
    2: Kind("1200", 0.7e6, 1.2e6, 14.0),
}
"""ARIS models, keyed by the system number in the header."""

TELEPHOTO_ELEVATION_DEG = 3.0
"""Elevation aperture with the large lens [deg]; an assumption of mitsonar without a source."""


def read_aris(path: str | Path) -> Recording:
    """Open an ARIS recording; pixels are read on demand.

    Sample i lies at range r0 + i dr, where r0 and dr are ``start delay`` and ``sample period`` times half the sound speed.
    Values 0..255 represent 0..80 dB. Attitude is that of the sonar's compass; pitch > 0 points down. If the file holds
    latitudes and longitudes, positions are metres east and north of the first frame.

    Raises:
        MitsonarError: if the file does not exist, has another format, or holds no readable frame.
    """
    data = mapped(path, "an ARIS file", FILE_HEADER + FRAME.itemsize)
    name = str(path)
    if bytes(data[:4]) != SIGNATURE:
        raise MitsonarError(f"{name} is not an ARIS file: it begins with {bytes(data[:4])!r}, not with {SIGNATURE!r}")
    frames, beams = _aris_frames(data, name)
    headers = frames.table()
    valid, notes = _valid_frames(headers, frames)
    order, order_notes = in_time_order(np.where(valid, headers["time_us"] * 1e-6, np.nan), headers["index"])
    parts = tuple(_aris_part(frames, headers, order[run], beams) for _, run in runs_of(windows_of(headers[order])))
    return Recording(
        name, "ARIS 5 (.aris)", parts, facts_of(headers[order], beams), (*notes, *order_notes, *notes_of(headers[order]))
    )


def _aris_frames(data: Bytes, name: str) -> tuple[EqualFrames, int]:
    """Return the frames and the number of beams, as given by the first frame header."""
    first = np.frombuffer(data[FILE_HEADER : FILE_HEADER + FRAME.itemsize].tobytes(), FRAME)[0]
    mode, samples = int(first["ping_mode"]), int(first["samples"])
    if mode not in BEAMS or not 0 < samples <= MAX_SAMPLES:
        raise MitsonarError(
            f"{name}: the first frame states ping mode {mode} and {samples:,} samples per beam; valid are ping modes 1 to "
            f"12 and 1 to {MAX_SAMPLES:,} samples: the file is damaged"
        )
    frames = EqualFrames(data, FILE_HEADER, FRAME, samples * BEAMS[mode])
    if not len(frames):
        raise MitsonarError(
            f"{name} holds no complete frame: it has {len(data):,} bytes, and a frame takes {frames.stride:,}"
        )
    return frames, BEAMS[mode]


def _valid_frames(headers: Header, frames: EqualFrames) -> tuple[NDArray[np.bool_], list[str]]:
    """Return which frames have a plausible header, and sentences on the others."""
    first, stated_speed = headers[0], headers["sound_speed"].astype(float)
    speed = np.where((stated_speed > ARIS_MIN_SPEED) & (stated_speed < ARIS_MAX_SPEED), stated_speed, np.nan)
    valid = (headers["signature"] == SIGNATURE) & (headers["ping_mode"] == first["ping_mode"])
    valid &= headers["samples"] == first["samples"]
    end_us = headers["start_delay_us"] + headers["sample_period_us"] * headers["samples"].astype(float)
    valid &= (
        (headers["sample_period_us"] > 0)
        & (end_us * 1e-6 * speed / 2 < MAX_RANGE_M)
        & np.isin(headers["system"], list(KINDS))
    )
    has_table = valid & _has_beam_table(headers)
    valid = has_table if has_table.any() else valid  # if all frames lack a table, a later error names the missing one
    notes = []
    if not valid.all():
        notes.append(f"left out: {count_noun(int((~valid).sum()), 'frame')} with a damaged header")
    if frames.left_over:
        notes.append(f"the last {frames.left_over:,} bytes are not a complete frame and are left out")
    return valid, notes


def _has_beam_table(headers: Header) -> NDArray[np.bool_]:
    """Return which frames ``(frames,)`` have a table of beam angles."""
    beams, large_lens = BEAMS[int(headers["ping_mode"][0])], headers["large_lens"] != 0
    known = large_lens & (("telephoto", beams) in TABLES)
    for system, kind in KINDS.items():
        known |= ~large_lens & (headers["system"] == system) & ((kind.name, beams) in TABLES)
    return np.asarray(known, dtype=bool)


def windows_of(headers: Header) -> list[tuple[float, ...]]:
    """Return the values that determine the geometry of each frame; small drifts of the sound speed are ignored."""
    names = ("start_delay_us", "sample_period_us", "large_lens", "system", "high_frequency")
    keys, speed = [], 0.0
    for header in headers:
        if abs(float(header["sound_speed"]) - speed) > SPEED_TOLERANCE * speed:
            speed = float(header["sound_speed"])
        keys.append((speed, *(float(header[name]) for name in names)))
    return keys


def _aris_part(frames: EqualFrames, headers: Header, places: NDArray[np.intp], beams: int) -> Part:
    part_headers = headers[places]
    samples = int(part_headers["samples"][0])
    raw = _ArisSamples(
        frames, places, samples, beams, int(part_headers["ping_mode"][0]), bool(part_headers["reordered"].all())
    )
    attitude = attitude_of(part_headers)
    return Part(
        like=empty_aris_frames(part_headers, samples, beams),
        time_s=part_headers["time_us"] * 1e-6,
        images=raw,
        poses=poses_of(part_headers, attitude),
        attitude_rad=attitude,
        height_m=height_of(part_headers),
        gain_db=part_headers["gain_db"].astype(float),
    )


@dataclass(frozen=True)
class _ArisSamples:
    """Function that reads the images of a part of an ARIS file."""

    frames: EqualFrames
    places: NDArray[np.intp]
    samples: int
    beams: int
    mode: int
    reordered: bool

    def __call__(self, index: NDArray[np.intp]) -> Bytes:
        """Return images ``(n, bins, beams)``, column 0 farthest to port."""
        raw = self.frames.read(self.places[index], (self.samples, self.beams))
        if not self.reordered:
            flags = self.frames.headers()["reordered"][self.places[index]]
            raw = np.stack([one if flag else in_beam_order(one, self.mode) for one, flag in zip(raw, flags, strict=True)])
        return raw[:, :, ::-1]


def in_beam_order(samples: Bytes, mode: int) -> Bytes:
    """Reorder a frame ``(samples, beams)`` of a live stream by beam.

    A live stream holds pings x samples x 16 channels. Channel c of ping p is beam ``CHANNELS[c] * pings + p``.

    Raises:
        MitsonarError: if the order of the ping mode is not known.
    """
    if mode not in PINGS:
        known = ", ".join(str(one) for one in PINGS)
        raise MitsonarError(
            f"the order of ping mode {mode} is not known, only those of {known}: record it with the vendor's program"
        )
    pings = PINGS[mode]
    by_ping = samples.reshape(pings, -1, len(CHANNELS))
    beams = np.array(CHANNELS)[None, :] * pings + np.arange(pings)[:, None]
    ordered = np.empty((by_ping.shape[1], pings * len(CHANNELS)), dtype=samples.dtype)
    ordered[:, beams.ravel()] = by_ping.transpose(1, 0, 2).reshape(by_ping.shape[1], -1)
    return ordered


def empty_aris_frames(headers: Header, samples: int, beams: int) -> SonarFrames:
    """Return empty frames with the geometry of a part of an ARIS file."""
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
        elevation_pattern=ELEVATION_PATTERN,
        beams=beams,
        range_min=max(0.0, near - step / 2),  # ranges are centres of bins
        range_max=near + (samples - 0.5) * step,
        range_bins=samples,
        sound_speed=speed,
        bearing="cone",
        frequency_hz=kind.high_hz if first["high_frequency"] else kind.low_hz,
        frame_rate_hz=_rate(headers),
        coding="dB",
        coding_db=ARIS_CODING_DB,
        **_groups(first, _rate(headers)),
    )
    return SonarFrames(
        image=np.zeros((0, samples, beams), np.uint8),
        range_m=near + np.arange(samples, dtype=np.float64) * step,
        bearing_rad=bearings,
        time_s=np.zeros(0),
        sonar=sonar,
        level="dB",
    )


def _groups(first: Any, rate_hz: float) -> Facts:
    """Return the fields of a sonar that say how the beams of an ARIS ping; none where the header contradicts itself."""
    pings, cycle_s = PINGS.get(int(first["ping_mode"]), 1), float(first["cycle_us"]) * 1e-6
    if pings == 1 or not 0 < pings * cycle_s <= 1.05 / rate_hz:
        return {}
    return {"ping_groups": pings, "group_order": "interleaved_starboard", "group_interval_s": cycle_s}


def _rate(headers: Header) -> float:
    """Return the frame rate [Hz]: as stated in the header, or computed from the times."""
    stated = float(headers["frame_rate_hz"][0])
    if math.isfinite(stated) and 0 < stated < 1e3:
        return stated
    seconds = float(headers["time_us"][-1] - headers["time_us"][0]) * 1e-6
    return (len(headers) - 1) / seconds if seconds > 0 else 10.0


def facts_of(headers: Header, beams: int) -> Facts:
    """Return header values of an ARIS file, keyed by name."""
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
    known = headers["temperature_c"][np.isfinite(headers["temperature_c"])]  # the frames hold the attitude
    if len(known):
        facts["temperature_c"] = [float(known.min()), float(known.max())]
    return facts


def notes_of(headers: Header) -> list[str]:
    """Return sentences on what changes within the file."""
    gains = np.unique(headers["gain_db"])
    return [f"the receiver's gain changes between {gains[0]} and {gains[-1]} dB"] if len(gains) > 1 else []


# ---------------- DIDSON files

Index = NDArray[np.intp]

SIGNATURES = {b"DDF\x03": 3, b"DDF\x04": 4}
"""Versions, keyed by the first four bytes of a file."""

FILE = layout(
    {
        "signature": (0, "S4"), "frames": (4, "<u4"), "frame_rate_hz": (8, "<u4"), "high_frequency": (12, "<u4"),
        "beams": (16, "<u4"), "sample_rate_hz": (20, "<f4"), "samples": (24, "<u4"), "gain_db": (28, "<u4"),
        "start_code": (32, "<u4"), "length_code": (36, "<u4"), "reverse": (40, "<u4"), "serial": (44, "<u4"),
        "sound_speed": (384, "<u4"),
    },
    512,
)  # fmt: skip
"""Fields of the file header: offset [bytes] and type."""

COMMON = MOTION | {
    "index": (0, "<u4"), "time_s": (4, "<u4"), "signature": (12, "S4"), "year": (20, "<u4"), "month": (24, "<u4"),
    "day": (28, "<u4"), "hour": (32, "<u4"), "minute": (36, "<u4"), "second": (40, "<u4"), "hundredth": (44, "<u4"),
    "start_code": (52, "<u4"), "length_code": (56, "<u4"), "gain_db": (68, "<u4"), "config": (192, "<u4"),
}  # fmt: skip

FRAME_HEADER = {3: layout(COMMON, 256), 4: layout(COMMON, 1024)}
"""Structured types of a frame header, keyed by version."""

FILE_HEADERS = {3: (512,), 4: (1024, 512)}
"""Sizes of the file header [bytes] by version. Readers disagree on version 4: the signature of the frames decides."""

CLASSIC, LONG_RANGE = 1, 2
"""Bits of a frame's configuration: classic windows instead of extended ones; DIDSON-LR instead of DIDSON-S."""

LAST_CLASSIC, LONG_RANGE_SERIAL = 18, 15
"""Last serial number whose windows are classic whatever the configuration states; serial number of a long-range sonar."""

LENGTHS_M = {
    0: (1.25, 2.5, 5.0, 10.0, 20.0, 40.0),
    CLASSIC: (1.125, 2.25, 4.5, 9.0, 18.0, 36.0),
    LONG_RANGE: (2.5, 5.0, 10.0, 20.0, 40.0, 80.0),
    LONG_RANGE | CLASSIC: (2.25, 4.5, 9.0, 18.0, 36.0, 72.0),
}
"""Nominal window lengths [m] by configuration; code 0 is the first at high frequency, and the third at low frequency."""

STEPS_M = {0: 0.42, CLASSIC: 0.375}
"""Nominal step of the window start [m] at high frequency, extended and classic; twice as much at low frequency."""

MAX_START_CODE, MAX_LENGTH_CODE = 31, 3
"""Largest codes of the window start and length."""

DELAY_S = {True: 0.512e-3, False: 0.572e-3}
"""Time per step of the window start [s] at high frequency, for serials up to 18 and above; twice that at low frequency."""

FREQUENCIES_HZ = {0: (1.1e6, 1.8e6), LONG_RANGE: (0.7e6, 1.2e6)}
"""Carriers at low and high frequency [Hz] (data sheets)."""

NOMINAL_SPEED = 1500.0
"""Sound speed if the file holds none [m/s]."""

DIDSON_MIN_SPEED, DIDSON_MAX_SPEED = 1300, 1700
"""Range of plausible sound speeds [m/s]."""

DIDSON_CODING_DB = 90.0
"""Dynamic range of the values 0..255 [dB]."""

WINDOW_TOLERANCE = 0.1
"""Relative difference between the window computed from timing and the nominal window beyond which a note is added."""

CLOCK = {
    "year": (1970, 2200), "month": (1, 12), "day": (1, 31), "hour": (0, 23), "minute": (0, 59), "second": (0, 60),
    "hundredth": (0, 99),
}  # fmt: skip
"""Fields of the sonar's clock, and their valid ranges."""

MAX_TIE_PERIODS = 3.0
"""Largest gap, in nominal frame periods per frame, over which frames with equal times are spread."""

LENS = {48: (1.0, 0.0015, 1.3351), 96: (1.012, 0.0030, 2.6829)}
"""Lens model by number of beams: beams from the axis = factor (cubic t^3 + linear t), with t in degrees from the axis."""


def read_didson(path: str | Path) -> Recording:
    """Open a DIDSON recording; pixels are read on demand.

    The window of each frame follows from the codes in its header and from the timing: it begins at ``code * delay * c / 2``,
    and sample n lies at (n + 1/2) ``c / (2 sample rate)`` from there. The sample rate of the file belongs to the window
    length in the file header; in frames of another length it changes in proportion. Without a sample rate, windows have
    their nominal lengths. A note reports where the window computed from timing differs from the nominal one. The sound speed
    is that of the file, or 1500 m/s.

    Values 0..255 represent 0..90 dB. Beam 0 is the one farthest to starboard, or farthest to port if ``reverse`` is not 0.
    Attitude is that of the sonar's compass. Times are those of the sonar's clock, local time with a resolution of 0.01 s;
    frames with equal times are spread evenly up to the next time.

    Raises:
        MitsonarError: if the file does not exist, has another format, or holds no readable frame.
    """
    name = str(path)
    data = mapped(path, "a DIDSON file", FILE.itemsize)
    version = SIGNATURES.get(data[:4].tobytes())
    if version is None:
        raise MitsonarError(f"{name} is not a DIDSON file: it begins with {data[:4].tobytes()!r}, not with DDF and 3 or 4")
    head = np.frombuffer(data[: FILE.itemsize].tobytes(), FILE)[0]
    frames = _didson_frames(data, head, version, name)
    headers = frames.table()
    valid = (
        (headers["signature"] == data[:4].tobytes())
        & (headers["start_code"] <= MAX_START_CODE)
        & (headers["length_code"] < 4)
    )
    notes = [f"left out: {count_noun(int((~valid).sum()), 'frame')} with a damaged header"] if not valid.all() else []
    notes += [f"the last {frames.left_over:,} bytes are not a complete frame and are left out"] if frames.left_over else []
    time_s, time_notes = _times(headers, head)
    order, order_notes = in_time_order(np.where(valid, time_s, np.nan), headers["index"])
    windows = _Windows(head)
    parts = tuple(
        _didson_part(frames, headers[order[run]], order[run], time_s[order[run]], windows)
        for _, run in runs_of([windows.key(one) for one in headers[order]])
    )
    notes = [*notes, *time_notes, *order_notes, *windows.notes(headers[order])]
    return Recording(name, f"DIDSON {version} (.ddf)", parts, _facts(head, headers[order], windows), tuple(notes))


def _didson_frames(data: Bytes, head: np.void, version: int, name: str) -> EqualFrames:
    """Return the frames; the size of the file header is the one after which a frame with the signature begins."""
    beams, samples = int(head["beams"]), int(head["samples"])
    if beams not in LENS or not 0 < samples <= MAX_SAMPLES:
        raise MitsonarError(
            f"{name}: the file states {beams:,} beams and {samples:,} samples per beam; a DIDSON has 48 or 96 beams and 1 "
            f"to {MAX_SAMPLES:,} samples: the file is damaged"
        )
    for size in FILE_HEADERS[version]:
        if data[size + 12 : size + 16].tobytes() == data[:4].tobytes():
            frames = EqualFrames(data, size, FRAME_HEADER[version], beams * samples)
            if not len(frames):
                raise MitsonarError(
                    f"{name} holds no complete frame: it has {len(data):,} bytes, and a frame takes {frames.stride:,}"
                )
            return frames
    sizes = " or ".join(f"{size:,}" for size in FILE_HEADERS[version])
    raise MitsonarError(f"{name}: no frame begins after a header of {sizes} bytes: the file is cut off or damaged")


def _times(headers: Header, head: np.void) -> tuple[Array, list[str]]:
    """Return the times of the frames ``(frames,)`` [s] and notes on them.

    Times are those of the sonar's clock, or computed from frame numbers and frame rate if that clock never ran.
    """
    stated = int(head["frame_rate_hz"])
    rate = float(stated) if 0 < stated <= 100 else 10.0
    parts = {name: headers[name].astype(np.int64) for name in CLOCK}
    known = np.ones(len(headers), dtype=bool)
    for name, (least, most) in CLOCK.items():
        known &= (parts[name] >= least) & (parts[name] <= most)
    if known.any():
        months = np.where(known, (parts["year"] - 1970) * 12 + parts["month"] - 1, 0)
        days = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64) + parts["day"] - 1
        seconds = ((days * 24 + parts["hour"]) * 60 + parts["minute"]) * 60 + parts["second"]
        time_s = np.where(known, seconds + parts["hundredth"] / 100, np.nan)
        return _spread(time_s, headers["index"], 1 / rate)
    note = f"the sonar's clock gives no times: they are computed from the frame numbers at {rate:g} Hz"
    return headers["index"].astype(float) / rate, [note]


def _spread(time_s: Array, number: Index, period_s: float) -> tuple[Array, list[str]]:
    """Return times ``(frames,)`` [s] in which frames with equal times but rising numbers are spread up to the next time."""
    # 1. Mark the first frame of each group. Equal times without a rising number are repeated frames, not a group.
    new = np.ones(len(time_s), dtype=bool)
    new[1:] = (np.diff(time_s) != 0) | (np.diff(number.astype(np.int64)) <= 0)
    if new.all():
        return time_s, []
    # 2. Find the time to the next group; the nominal duration replaces it at the end of the file and where frames are lost.
    begin = np.flatnonzero(new)
    count = np.diff(begin, append=len(time_s))
    gap = np.append(np.diff(time_s[begin]), np.nan)
    gap = np.where((gap > 0) & (gap < MAX_TIE_PERIODS * period_s * count), gap, period_s * count)
    # 3. Divide that time evenly among the frames of the group.
    group = np.cumsum(new) - 1
    part = (np.arange(len(time_s)) - begin[group]) / count[group]
    note = f"{count_noun(int((~new).sum()), 'frame')} with the time of the one before: spread evenly up to the next"
    return time_s + part * gap[group], [note]


@dataclass(frozen=True)
class _Windows:
    """Conversion of the window codes of a file's frames to metres."""

    head: np.void

    @property
    def high(self) -> bool:
        return int(self.head["high_frequency"]) == 1

    @property
    def old(self) -> bool:
        return int(self.head["serial"]) <= LAST_CLASSIC

    @property
    def sound_speed(self) -> float:
        stated = int(self.head["sound_speed"])
        return float(stated) if DIDSON_MIN_SPEED <= stated <= DIDSON_MAX_SPEED else NOMINAL_SPEED

    def config(self, header: np.void) -> int:
        """Return the configuration of a frame; for old sonars, which do not record it, it follows from the serial number."""
        config = int(header["config"]) & (CLASSIC | LONG_RANGE)
        config |= CLASSIC if self.old else 0
        return config | LONG_RANGE if int(self.head["serial"]) == LONG_RANGE_SERIAL else config

    def key(self, header: np.void) -> tuple[int, int, int]:
        """Return the values that determine the geometry of a frame: start code, length code and configuration."""
        return int(header["start_code"]), int(header["length_code"]), self.config(header)

    def nominal(self, header: np.void) -> tuple[float, float]:
        """Return the nominal start and length of a frame's window, as given by the tables [m]."""
        return nominal_window(*self.key(header), high=self.high)

    def timed(self, header: np.void) -> tuple[float, float]:
        """Return the start and length of a frame's window, computed from the timing [m]."""
        start, code, config = self.key(header)
        begin = start * DELAY_S[self.old] * (1 if self.high else 2) * self.sound_speed / 2
        rate, samples = float(self.head["sample_rate_hz"]), int(self.head["samples"])
        length = self.nominal(header)[1]
        if not (math.isfinite(rate) and 1e2 < rate < 1e8):
            return begin, length * self.sound_speed / NOMINAL_SPEED
        reference = int(self.head["length_code"])
        whole = nominal_window(0, reference if reference <= MAX_LENGTH_CODE else code, config, high=self.high)[1]
        return begin, samples * self.sound_speed / (2 * rate) * length / whole

    def notes(self, headers: Header) -> list[str]:
        """Return at most ten sentences: on what is assumed, and on windows for which timing and tables disagree."""
        notes = []
        if not DIDSON_MIN_SPEED <= int(self.head["sound_speed"]) <= DIDSON_MAX_SPEED:
            notes.append(f"the file holds no sound speed: {NOMINAL_SPEED:g} m/s is assumed")
        rate = float(self.head["sample_rate_hz"])
        if not (math.isfinite(rate) and 1e2 < rate < 1e8):
            notes.append("the file holds no sample rate: windows have their nominal lengths")
        for one in {self.key(header): header for header in headers}.values():
            (start, length), (expected, whole) = self.timed(one), self.nominal(one)
            if (
                abs(start - expected) > WINDOW_TOLERANCE * max(expected, 1.0)
                or abs(length - whole) > WINDOW_TOLERANCE * whole
            ):
                notes.append(
                    f"a window lies at {start:.3g} to {start + length:.3g} m by its timing, and nominally at "
                    f"{expected:.3g} to {expected + whole:.3g} m: the timing is used"
                )
        return notes[:10]


def nominal_window(start: int, code: int, config: int, *, high: bool) -> tuple[float, float]:
    """Return the start and length of a window, as given by the tables of Sound Metrics [m].

    Args:
        start: code of the window start, 0 to 31.
        code: code of the window length, 0 to 3.
        config: configuration bits of the frame: 1 classic, 2 long range, both, or 0.
        high: whether the sonar operates at high frequency.
    """
    begin = start * STEPS_M[config & CLASSIC] * (1 if high else 2)
    return begin, LENGTHS_M[config][code + (0 if high else 2)]


@cache
def didson_bearings(beams: int) -> Array:
    """Return the bearings of a DIDSON's beams ``(beams,)`` [rad], from port to starboard, starboard positive.

    They follow the empirical polynomial of the lens without its even terms. These would shift the fan by 0.4 deg, to a side
    that depends on the image orientation of the reader from which the polynomial was taken. Beams are not evenly spaced: of
    96 beams, those in the middle are 0.37 deg apart, those at the sides 0.22 deg. The beam tables of the ARIS 1800, which
    has the same number of beams and field of view, show the same (0.35 and 0.21 deg). For this reason the polynomial is
    preferred to an even spacing of 0.3 deg.

    Args:
        beams: number of beams, 48 or 96.
    """
    factor, cubic, linear = LENS[beams]
    # The polynomial maps angle to beam number and increases monotonically: invert it by interpolation on a fine grid.
    angles = np.linspace(-20.0, 20.0, 40_001)
    degrees = np.interp(np.arange(beams) - (beams - 1) / 2, factor * (cubic * angles**3 + linear * angles), angles)
    return np.asarray(np.radians(degrees))


@dataclass(frozen=True)
class _DidsonImages:
    """Function that reads the images of a part of a DIDSON file."""

    frames: EqualFrames
    places: Index
    shape: tuple[int, int]
    flipped: bool

    def __call__(self, index: Index) -> Bytes:
        """Return images ``(n, bins, beams)``, column 0 farthest to port."""
        raw = self.frames.read(self.places[index], self.shape)
        return raw[:, :, ::-1] if self.flipped else raw


def _didson_part(frames: EqualFrames, headers: Header, places: Index, time_s: Array, windows: _Windows) -> Part:
    shape = (int(windows.head["samples"]), int(windows.head["beams"]))
    attitude = attitude_of(headers)
    return Part(
        like=_didson_sonar(headers[0], windows, time_s),
        time_s=time_s,
        images=_DidsonImages(frames, places, shape, flipped=int(windows.head["reverse"]) == 0),
        poses=poses_of(headers, attitude),
        attitude_rad=attitude,
        height_m=height_of(headers),
        gain_db=headers["gain_db"].astype(float),
    )


def _didson_sonar(header: np.void, windows: _Windows, time_s: Array) -> SonarFrames:
    """Return empty frames with the geometry of a part of a DIDSON file."""
    samples, beams = int(windows.head["samples"]), int(windows.head["beams"])
    start, length = windows.timed(header)
    bearings = didson_bearings(beams)
    far = windows.config(header) & LONG_RANGE
    seconds = float(time_s[-1] - time_s[0])
    sonar = Sonar.create(
        name="didson-lr" if far else "didson",
        azimuth_fov_deg=float(np.degrees(bearings[-1] - bearings[0])) * beams / (beams - 1),
        elevation_fov_deg=preset("didson300").elevation_fov_deg,
        elevation_pattern=ELEVATION_PATTERN,
        beams=beams,
        range_min=start,
        range_max=start + length,
        range_bins=samples,
        sound_speed=windows.sound_speed,
        bearing="cone",
        frequency_hz=FREQUENCIES_HZ[far][windows.high],
        frame_rate_hz=min(1e6, (len(time_s) - 1) / seconds) if seconds > 0 else 10.0,
        coding="dB",
        coding_db=DIDSON_CODING_DB,
    )
    return SonarFrames(
        image=np.zeros((0, samples, beams), np.uint8),
        range_m=sonar.range_m,
        bearing_rad=bearings,
        time_s=np.zeros(0),
        sonar=sonar,
        level="dB",
    )


def _facts(head: np.void, headers: Header, windows: _Windows) -> Facts:
    """Return header values of a DIDSON file, keyed by name."""
    if not len(headers):
        return {}
    names = ("high_frequency", "beams", "samples", "reverse", "serial")
    config = windows.config(headers[0])
    facts: Facts = {"system": "DIDSON-LR" if config & LONG_RANGE else "DIDSON-S"}
    facts |= {"windows": "classic" if config & CLASSIC else "extended"} | {name: int(head[name]) for name in names}
    facts |= {"gain_db": int(headers["gain_db"][0]), "sound_speed": windows.sound_speed}
    rate = float(head["sample_rate_hz"])
    return facts | ({"sample_rate_hz": rate} if math.isfinite(rate) else {})


# ---------------- Beam angles of ARIS sonars


TABLES = {
    ("telephoto", 48): "aris_telephoto_48",
    ("telephoto", 96): "aris_telephoto_96",
    ("1200", 48): "aris1200_1800_48",
    ("1800", 48): "aris1200_1800_48",
    ("1800", 96): "aris1800_96",
    ("3000", 64): "aris3000_64",
    ("3000", 128): "aris3000_128",
}
"""Names of the beam tables, keyed by lens or model of the sonar and number of beams."""


@cache
def aris_bearings(kind: str, beams: int) -> NDArray[np.float64]:
    """Return the bearings of an ARIS sonar's beams ``(beams,)`` [rad], from port to starboard, starboard positive.

    The tables are from aris-file-sdk (Sound Metrics, MIT). Beam 0 is the one farthest to starboard in a file, and the one
    with the smallest angle in a table. The bearing of a beam is therefore the negative angle of its row, and bearings from
    port to starboard are the negated table in reverse order.

    Args:
        kind: ``1200``, ``1800`` or ``3000``, or ``telephoto`` for any of them with the large lens.
        beams: number of beams.

    Raises:
        MitsonarError: if there is no table for them.
    """
    if (kind, beams) not in TABLES:
        known = ", ".join(f"{one} with {number}" for one, number in TABLES)
        raise MitsonarError(f"no beam angles are known for an ARIS {kind} with {beams} beams: known are {known}")
    lines = (
        files("mitsonar.recordings")
        .joinpath(f"beam_tables/{TABLES[kind, beams]}.csv")
        .read_text(encoding="utf-8")
        .splitlines()
    )
    degrees = np.array([float(line.split(",")[1]) for line in lines[1:]])
    return np.asarray(-np.radians(degrees)[::-1])
