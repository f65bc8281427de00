"""How is a side-scan echogram written as an XTF file? In the eXtended Triton Format, for programs that read such files.

Source of the layout: Triton Imaging, eXtended Triton Format (XTF), revision 42. A file header of 1,024 bytes is followed by
a record per ping: a ping header of 256 bytes, then for each channel a header of 64 bytes and its samples.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from mitsonar.errors import MitsonarError
from mitsonar.io.files import write_atomic
from mitsonar.motion.trajectory import Trajectory, velocities
from mitsonar.recordings.recording import Header, layout
from mitsonar.records.soundings import Echogram

__all__ = ["CHANNEL", "FILE", "FULL_COUNT", "PING", "PING_CHANNEL", "write_xtf"]

CHANNEL = layout(
    {
        "type": (0, "u1"), "sub": (1, "u1"), "correction": (2, "<u2"), "unipolar": (4, "<u2"), "sample_bytes": (6, "<u2"),
        "samples": (8, "<u4"), "name": (12, "S16"), "volt_scale": (28, "<f4"), "frequency_khz": (32, "<f4"),
        "along_deg": (36, "<f4"), "tilt_deg": (40, "<f4"), "width_deg": (44, "<f4"), "offset_m": (48, "3<f4"),
        "sample_format": (74, "u1"),
    },
    128,
)  # fmt: skip
"""Fields that describe a channel in the file header: offset [bytes] and type."""

FILE = layout(
    {
        "format": (0, "u1"), "system": (1, "u1"), "program": (2, "S8"), "version": (10, "S8"), "sonar": (18, "S16"),
        "sensor": (34, "<u2"), "note": (36, "S64"), "file": (100, "S64"), "nav_units": (164, "<u2"),
        "sonar_channels": (166, "<u2"), "bathymetry_channels": (168, "<u2"),
    },
    256,
)  # fmt: skip
"""Fields of the file header ahead of its six channel descriptions: offset [bytes] and type."""

PING = layout(
    {
        "magic": (0, "<u2"), "type": (2, "u1"), "channels": (4, "<u2"), "bytes": (10, "<u4"), "year": (14, "<u2"),
        "month": (16, "u1"), "day": (17, "u1"), "hour": (18, "u1"), "minute": (19, "u1"), "second": (20, "u1"),
        "hundredths": (21, "u1"), "day_of_year": (22, "<u2"), "event": (24, "<u4"), "ping": (28, "<u4"),
        "half_sound_speed": (32, "<f4"), "sound_speed": (72, "<f4"), "gyro_deg": (124, "<f4"), "ship_y": (128, "<f8"),
        "ship_x": (136, "<f8"), "speed_knots": (152, "<f4"), "y": (160, "<f8"), "x": (168, "<f8"),
        "layback_m": (184, "<f4"), "depth_m": (192, "<f4"), "altitude_m": (196, "<f4"), "second_altitude_m": (200, "<f4"),
        "pitch_deg": (204, "<f4"), "roll_deg": (208, "<f4"), "heading_deg": (212, "<f4"),
        "time_ms": (224, "<u4"),
    },
    256,
)  # fmt: skip
"""Fields of a ping header: offset [bytes] and type."""

PING_CHANNEL = layout(
    {
        "channel": (0, "<u2"), "slant_range_m": (4, "<f4"), "delay_s": (12, "<f4"), "duration_s": (16, "<f4"),
        "ping_s": (20, "<f4"), "frequency_khz": (26, "<u2"), "samples": (42, "<u4"), "millivolts": (46, "<u2"),
        "weight": (58, "<i2"),
    },
    64,
)  # fmt: skip
"""Fields of the header ahead of a channel's samples: offset [bytes] and type."""

FULL_COUNT = 32767
"""Count of the largest amplitude; readers may interpret two bytes as signed or unsigned."""

PORT, STARBOARD = 1, 2
METRES, DEGREES = 0, 3
"""Units of positions."""

END_S = 7_258_118_400.0
"""Begin of the year 2200 [s since 1970], before which times must lie."""

KNOTS = 3600 / 1852
PAD = 64
"""The size of a record is a multiple of this [bytes]."""


def write_xtf(path: str | Path, echogram: Echogram) -> None:
    """Write the echogram of a side-scan sonar; the file is complete or absent.

    Samples are amplitudes, scaled so that the largest of the file has 32,767 counts. Port samples run from the outermost bin
    inwards, as XTF requires. Positions are latitudes and longitudes if the echogram has an origin, otherwise metres east and
    north. Heights above the ground are those of the echogram. Times count from 1970.

    Raises:
        MitsonarError: if the echogram is not that of a side-scan sonar, or the format has no dates for its times.
    """
    sounder = echogram.sounder
    if sounder.kind != "sidescan":
        raise MitsonarError(f"XTF files hold side-scans: got the echogram of a {sounder.kind}; save it as .npz")
    first, last = float(echogram.time_s.min()), float(echogram.time_s.max())
    if not 0 <= first <= last < END_S:
        raise MitsonarError(
            f"times of an XTF file are seconds since 1970, to the year 2200: got {first:.10g} to {last:.10g} s; give the "
            "path other times"
        )
    largest = float(np.sqrt(echogram.levels.max())) or 1.0
    counts = np.rint(np.sqrt(echogram.levels) * (FULL_COUNT / largest)).astype("<i2")
    sides = [counts[:, sounder.channels.index("port"), ::-1], counts[:, sounder.channels.index("starboard")]]
    ping, channel = _ping_headers(echogram), _channel_headers(echogram)
    size = PING.itemsize + sum(PING_CHANNEL.itemsize + 2 * side.shape[1] for side in sides)
    padding = bytes(-size % PAD)
    ping["bytes"] = size + len(padding)
    parts = [_file_header(echogram, Path(path).name)]
    for number in range(len(echogram)):
        parts.append(ping[number].tobytes())
        for header, side in zip(channel, sides, strict=True):
            parts += [header.tobytes(), side[number].tobytes()]
        parts.append(padding)
    write_atomic(Path(path), b"".join(parts))


def _file_header(echogram: Echogram, name: str) -> bytes:
    """Return the file header, including the descriptions of its channels."""
    sounder, fan = echogram.sounder, echogram.sounder.fan
    header = np.zeros((), FILE)
    header["format"], header["system"], header["program"], header["version"] = 0x7B, 1, b"mitsonar", b"1"
    header["sonar"], header["file"] = sounder.name.encode()[:15], name.encode()[:63]
    header["note"] = b"written by mitsonar; metres, east and north" if echogram.origin is None else b"written by mitsonar"
    header["nav_units"], header["sonar_channels"] = METRES if echogram.origin is None else DEGREES, 2
    channels = np.zeros(6, CHANNEL)
    for one, kind, side in zip(channels, (PORT, STARBOARD), ("port", "starboard"), strict=False):
        mount = sounder.mounts[side]
        one["type"], one["unipolar"], one["sample_bytes"], one["samples"] = kind, 1, 2, fan.range_bins
        one["name"], one["volt_scale"], one["sample_format"] = side.encode(), 1.0, 3
        one["frequency_khz"] = (fan.frequency_hz or 0) / 1000
        one["along_deg"], one["width_deg"], one["tilt_deg"] = fan.azimuth_fov_deg, fan.elevation_fov_deg, mount[3]
        one["offset_m"] = mount[:3]
    return header.tobytes() + channels.tobytes()


def _ping_headers(echogram: Echogram) -> Header:
    """Return the headers of the pings ``(pings,)``."""
    sounder, poses = echogram.sounder, echogram.poses
    header = np.zeros(len(echogram), PING)
    header["magic"], header["channels"] = 0xFACE, 2
    header["event"] = header["ping"] = np.arange(1, len(echogram) + 1)
    header["sound_speed"], header["half_sound_speed"] = sounder.fan.sound_speed, sounder.fan.sound_speed / 2
    east, north, convergence = poses[:, 0], poses[:, 1], np.zeros(len(poses))
    if echogram.origin is not None:
        degrees = echogram.origin.to_degrees(poses[:, :2])
        (north, east), convergence = degrees.T, echogram.origin.convergence_rad(degrees)
    header["x"] = header["ship_x"] = east
    header["y"] = header["ship_y"] = north
    header["depth_m"], header["altitude_m"] = np.maximum(0, -poses[:, 2]), np.nan_to_num(echogram.height_m)
    pitch, roll, heading = np.degrees(poses[:, 3:] + np.multiply.outer(convergence, [0, 0, 1])).T
    header["pitch_deg"], header["roll_deg"] = -pitch, roll  # XTF: bow up is positive
    # readers take a heading of 0 for one that was not recorded
    header["heading_deg"] = header["gyro_deg"] = np.where(heading % 360 == 0, 360.0, heading % 360)
    trajectory = Trajectory(poses, echogram.time_s)
    header["speed_knots"] = np.linalg.norm(velocities(trajectory)[:, :3], axis=1) * KNOTS
    header["time_ms"] = np.rint(1000 * (echogram.time_s - echogram.time_s[0]))
    for row, time_s in zip(header, echogram.time_s, strict=True):
        date = datetime.fromtimestamp(round(float(time_s), 2), UTC)
        row["year"], row["month"], row["day"], row["day_of_year"] = date.year, date.month, date.day, date.timetuple().tm_yday
        row["hour"], row["minute"], row["second"] = date.hour, date.minute, date.second
        row["hundredths"] = round(date.microsecond / 1e4) % 100
    return header


def _channel_headers(echogram: Echogram) -> Header:
    """Return the headers ahead of the samples of port and starboard ``(2,)``."""
    fan = echogram.sounder.fan
    header = np.zeros(2, PING_CHANNEL)
    header["channel"] = [0, 1]
    header["slant_range_m"], header["samples"], header["millivolts"] = fan.range_max, fan.range_bins, 1000
    header["delay_s"] = 2 * fan.range_min / fan.sound_speed
    header["duration_s"] = 2 * (fan.range_max - fan.range_min) / fan.sound_speed
    step = float(np.diff(echogram.time_s).mean()) if len(echogram) > 1 else 1 / fan.frame_rate_hz
    header["ping_s"], header["frequency_khz"] = step, min(65535, round((fan.frequency_hz or 0) / 1000))
    return header
