"""How is a folder of PINGVerter read? Its index of frames states where in a file of samples each ping lies.

PINGVerter (Bodine, MIT licence) decodes logs of Humminbird, Lowrance, Garmin and Cerulean sonars, whose formats no maker has
published. ``pingverter.export_sonar_data_player_project`` writes the folder that is read here: ``manifest.json``,
``frames.jsonl`` and samples as unsigned integers of two bytes.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.io.files import parse_json, read_bytes
from mitsonar.recordings.recording import Bytes, mapped
from mitsonar.recordings.side_scan import (
    ASSUMED_SOUND_SPEED,
    Band,
    Index,
    Levels,
    PingHeaders,
    SideScan,
    in_hertz,
    parts_of,
    place_pings,
)

__all__ = ["is_pingverter", "read_pingverter"]

Array = NDArray[np.float64]

MANIFEST, FRAMES, SAMPLES = "manifest.json", "frames.jsonl", "samples.u16le"

MOST_MANIFEST_BYTES, MOST_INDEX_BYTES = 2**24, 2**31
"""Largest sizes of the manifest and of the index of frames [bytes]."""

SIDES = ("Port", "Starboard")

ENCODING = "uint16-le"

FULL_SCALE = 65535.0

PROFILE_PINGS = 200
"""Number of pings, spread over the log, by which the order of port samples is recognised."""


def is_pingverter(path: Path, first: bytes) -> bool:
    """Return whether a path is a folder with the files of PINGVerter."""
    return not first and all(os.path.isfile(path / name) for name in (MANIFEST, FRAMES, SAMPLES))


def read_pingverter(path: Path) -> SideScan:
    """Open a folder of PINGVerter; samples are read part by part.

    Heights over the ground are depths below the transducer, as the sonar's bottom lock states them. Logs of some sonars
    store port from its outermost sample inwards: the order that resembles starboard more is taken.

    Raises:
        MitsonarError: if a file is missing or damaged, or there are no pings of port and starboard with a range.
    """
    channels = _side_channels(parse_json(_content(path / MANIFEST, MOST_MANIFEST_BYTES), str(path / MANIFEST)), path)
    samples = mapped(path / SAMPLES, "a file of samples")
    index = _pings(path, tuple(channels), len(samples))
    if not index.pings:
        raise MitsonarError(f"{path} holds no ping of port and starboard with a range{index.summary()}")
    table = np.array([ping.values for ping in index.pings], dtype=float)
    placed = place_pings(_ping_headers(table))
    count = np.array([ping.samples for ping in index.pings], dtype=np.int64)
    begin = np.array([ping.begin for ping in index.pings], dtype=np.int64)
    levels = _Samples(samples, begin, count, reverse_port=False)
    reverse = _port_is_reversed(levels, count)
    frequency = _frequency_hz(channels)
    band = Band(
        rows=np.arange(len(count)),
        samples=count,
        range_min=table[:, 5],
        range_max=table[:, 6],
        frequency_hz=np.full(len(count), frequency),
        levels=_Samples(samples, begin, count, reverse_port=reverse),
        name="PINGVerter",
        sound_speed=ASSUMED_SOUND_SPEED,
    )
    parts, left_out = parts_of(band, placed)
    notes = [
        *index.notes(),
        *placed.notes,
        *left_out,
        f"the log states no sound speed: {ASSUMED_SOUND_SPEED:g} m/s is assumed",
    ]
    if reverse:
        notes.append("port samples are stored from the outermost inwards, as their likeness to starboard shows: turned")
    return SideScan(path.name, "log by PINGVerter (folder)", tuple(parts), placed.facts, tuple(notes))


# ---------------- Index


def _content(path: Path, most: int) -> bytes:
    """Return the bytes of a file of at most ``most``.

    Raises:
        MitsonarError: if it cannot be read, or is larger.
    """
    return read_bytes(path, "file of PINGVerter", min(most, path.stat().st_size))


def _side_channels(manifest: Any, path: Path) -> dict[int, dict[str, Any]]:
    """Return the descriptions of the port and the starboard channel, by their numbers.

    Raises:
        MitsonarError: if samples have another encoding, or a side is missing.
    """
    if not isinstance(manifest, dict):
        raise MitsonarError(f"{path / MANIFEST} must hold a JSON object")
    samples, listed = manifest.get("samples"), manifest.get("channels")
    if not isinstance(samples, dict) or samples.get("encoding") != ENCODING or not isinstance(listed, list):
        raise MitsonarError(f"{path / MANIFEST} describes no samples of {ENCODING}: let PINGVerter 2 export the log again")
    channels: dict[int, dict[str, Any]] = {}
    for side in SIDES:
        matching = [
            one
            for one in listed
            if isinstance(one, dict) and one.get("orientation") == side and type(one.get("channelId")) is int
        ]
        if not matching or matching[0]["channelId"] in channels:
            raise MitsonarError(f"{path / MANIFEST} has no side-scan channel {side.lower()}: the log is of another sonar")
        channels[matching[0]["channelId"]] = matching[0]
    return channels


class _Ping(NamedTuple):
    """Offsets of the port and starboard samples [bytes], samples of a side, and values that a frame states."""

    begin: tuple[int, int]
    samples: int
    values: tuple[float, ...]  # time, latitude, longitude, heading, depth, near range, far range


@dataclass(frozen=True)
class _Frames:
    """Pings of a log, and the number of frames that were left out."""

    pings: list[_Ping]
    one_sided: int
    damaged: int

    def notes(self) -> list[str]:
        """Return sentences on what was left out."""
        notes = []
        if self.one_sided:
            notes.append(f"left out: {count_noun(self.one_sided, 'frame')} without both sides or a range")
        if self.damaged:
            notes.append(f"left out: {count_noun(self.damaged, 'frame')} that are damaged")
        return notes

    def summary(self) -> str:
        """Return in words what there is, for an error message."""
        return f" ({self.one_sided:,} frames without both sides or a range, {self.damaged:,} damaged)"


def _pings(path: Path, channels: tuple[int, ...], size: int) -> _Frames:
    """Return the pings in the index of frames, whose samples lie in a file of ``size`` bytes.

    Raises:
        MitsonarError: if the index cannot be read.
    """
    pings: list[_Ping] = []
    one_sided = damaged = 0
    for number, line in enumerate(_content(path / FRAMES, MOST_INDEX_BYTES).splitlines()):
        try:
            frame = parse_json(line, f"frame {number}")
        except MitsonarError:
            frame = None
        if not isinstance(frame, dict) or not isinstance(frame.get("channels"), list):
            damaged += 1
            continue
        described: dict[int, dict[str, Any]] = {
            one["channelId"]: one for one in frame["channels"] if isinstance(one, dict) and type(one.get("channelId")) is int
        }
        sides = [described.get(one) for one in channels]
        if None in sides:
            one_sided += 1
            continue
        ping = _ping(frame, [one for one in sides if one is not None], size)
        if ping is None:
            damaged += 1
        elif not 0 < ping.values[6] <= 1e5:
            one_sided += 1
        else:
            pings.append(ping)
    return _Frames(pings, one_sided, damaged)


def _ping(frame: dict[str, Any], sides: list[dict[str, Any]], size: int) -> _Ping | None:
    """Return the ping of a frame; None if its samples do not lie in the file."""
    begin, counts = ([_whole(one.get(name)) for one in sides] for name in ("sampleOffset", "sampleCount"))
    first, count = counts[0], min(counts)
    if first != counts[1] or count < 1 or min(begin) < 0 or max(begin) + 2 * count > size:
        return None
    values = [_number(frame.get(name)) for name in ("timeSeconds", "lat", "lon", "headingDegrees")]
    values += [_number(sides[0].get(name)) for name in ("bottomDepthMeters", "minRangeMeters", "maxRangeMeters")]
    near, far = values[5], values[6]
    values[5] = near if 0 < near < far else 0.0  # nan too
    return _Ping((begin[0], begin[1]), count, tuple(values))


def _whole(value: object) -> int:
    """Return a whole number of JSON; -1 for anything else."""
    return value if isinstance(value, int) and not isinstance(value, bool) else -1


def _number(value: object) -> float:
    """Return a number of JSON; nan for anything else."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12 else np.nan


def _ping_headers(table: Array) -> PingHeaders:
    """Return what frames state: time, latitude, longitude, heading, depth, near and far range ``(pings, 7)``."""
    unknown = np.full(len(table), np.nan)
    position = np.where((table[:, 1:3] != 0).any(axis=1)[:, None], table[:, 1:3], np.nan)
    heading = table[:, 3] if np.nansum(np.abs(table[:, 3])) else unknown
    return PingHeaders(
        time_s=table[:, 0],
        position=position,
        in_degrees=True,
        heading_deg=np.where(np.isfinite(position).all(axis=1) & (np.abs(heading) < 1e5), heading, np.nan),
        pitch_deg=unknown,
        roll_deg=unknown,
        depth_m=unknown,
        height_m=np.where((table[:, 4] > 0) & (table[:, 4] < 1e5), table[:, 4], np.nan),
    )


def _frequency_hz(channels: dict[int, dict[str, Any]]) -> float:
    """Return the middle of the band that the channels state [Hz]; nan if they state none."""
    port = next(iter(channels.values()))
    ends = [_number(port.get(name)) for name in ("startFrequencyHz", "endFrequencyHz")]
    middle = float(np.nan if np.isnan(ends).all() else np.nanmean(ends))
    return float(in_hertz(middle))


# ---------------- Samples


def _port_is_reversed(levels: _Samples, count: NDArray[np.int64]) -> bool:
    """Return whether port resembles starboard more if its samples are turned, over pings of the most common size."""
    sizes, times = np.unique(count, return_counts=True)
    same = np.flatnonzero(count == sizes[np.argmax(times)])
    some = same[:: max(1, len(same) // PROFILE_PINGS)]
    port, starboard = np.log(levels(some) + 1e-6).mean(axis=0)
    if np.ptp(port) == 0 or np.ptp(starboard) == 0:
        return False
    return bool(np.corrcoef(port[::-1], starboard)[0, 1] > np.corrcoef(port, starboard)[0, 1])


@dataclass(frozen=True)
class _Samples:
    """Function that reads the intensities of pings.

    Attributes:
        data: the file of samples.
        begin: offsets of the port and starboard samples ``(n, 2)`` [bytes].
        samples: samples of a side ``(n,)``.
        reverse_port: whether port samples are turned.
    """

    data: Bytes
    begin: NDArray[np.int64]
    samples: NDArray[np.int64]
    reverse_port: bool

    def __call__(self, pings: Index) -> Levels:
        """Return intensities ``(n, 2, bins)`` relative to full scale, squares of amplitudes, from near to far."""
        bins = int(self.samples[pings[0]])
        levels = np.empty((len(pings), 2, bins), np.float32)
        for row, ping in enumerate(pings):
            for side, at in enumerate(self.begin[ping]):
                raw = np.frombuffer(self.data[at : at + 2 * bins].tobytes(), "<u2")
                levels[row, side] = np.square(raw / FULL_SCALE)
        if self.reverse_port:
            levels[:, 0] = levels[:, 0, ::-1].copy()
        return levels
