"""How is a recording of unknown format opened? By the first bytes of the file, or the files in the folder.

Recordings of imaging sonars hold frames, those of side-scans echograms, and those of other multibeams points.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.io.files import missing_file
from mitsonar.recordings.gemini import is_gemini, read_gemini
from mitsonar.recordings.jsf import is_jsf, read_jsf
from mitsonar.recordings.oculus import is_oculus, read_oculus
from mitsonar.recordings.pictures import (
    holds_pictures,
    is_picture_stack,
    is_video,
    read_picture_folder,
    read_picture_stack,
    read_picture_video,
)
from mitsonar.recordings.ping360 import is_ping360_log, is_ping360_text, read_ping360_log, read_ping360_text
from mitsonar.recordings.pingverter import is_pingverter, read_pingverter
from mitsonar.recordings.public_sets import is_canoe, is_neusis, is_uxo, read_canoe, read_neusis, read_uxo
from mitsonar.recordings.range_pings import RangeRecording, ranges_topic, read_ros_ranges
from mitsonar.recordings.recording import Part, Recording
from mitsonar.recordings.ros_messages import SONARS, BagFile, is_ros_bag
from mitsonar.recordings.ros_reader import read_ros_bag
from mitsonar.recordings.side_scan import SideScan, SideScanPart, holds_echogram, read_echogram
from mitsonar.recordings.sonar_3d15 import is_range_images, read_range_images
from mitsonar.recordings.sound_metrics import SIGNATURE, SIGNATURES, read_aris, read_didson
from mitsonar.recordings.xtf import is_xtf, read_xtf
from mitsonar.records.frames import frames_in

__all__ = [
    "FORMATS",
    "SIDE_SCANS",
    "Format",
    "SideScanFormat",
    "Summary",
    "detect_format",
    "detect_side_scan",
    "frameless_words",
    "known_formats",
    "open_ranges",
    "open_recording",
    "open_side_scan",
    "recordings_in",
    "summary_lines",
    "summary_of",
]


FIRST_BYTES = 16
"""Number of leading bytes of a file by which its format is recognised."""


class Format(NamedTuple):
    """A recording format and its reader.

    Attributes:
        words: readable name.
        fits: function that returns whether a path with these first bytes (empty for a folder) has the format.
        read: function that opens a recording, given its path, a geometry file or None, and the topic of the sonar or None.
    """

    words: str
    fits: Callable[[Path, bytes], bool]
    read: Callable[[Path, Path | None, str | None], Recording]


def _without_topic(read: Callable[[Path, Path | None], Recording]) -> Callable[[Path, Path | None, str | None], Recording]:
    """Wrap a reader of a format whose files hold a single sonar, so that it rejects a topic."""

    def checked(path: Path, geometry: Path | None, topic: str | None) -> Recording:
        if topic is not None:
            raise MitsonarError(f"{path} is a recording of one sonar without topics or views: omit {topic!r}")
        return read(path, geometry)

    return checked


def _without_geometry(read: Callable[[Path], Recording]) -> Callable[[Path, Path | None, str | None], Recording]:
    """Wrap a reader of a format whose files hold a single sonar and its geometry, so that it rejects a geometry file."""

    def checked(path: Path, geometry: Path | None) -> Recording:
        if geometry is not None:
            raise MitsonarError(f"{path} contains its geometry: omit {geometry}")
        return read(path)

    return _without_topic(checked)


FORMATS: tuple[Format, ...] = (
    Format("ARIS (.aris)", lambda path, first: first.startswith(SIGNATURE), _without_geometry(read_aris)),
    Format("DIDSON (.ddf)", lambda path, first: first[:4] in SIGNATURES, _without_geometry(read_didson)),
    Format("Oculus (.raw, .oculus)", is_oculus, _without_geometry(read_oculus)),
    Format("Ping360 (.bin of Ping Viewer)", is_ping360_log, _without_geometry(read_ping360_log)),
    Format("Ping360 messages as text or CSV", is_ping360_text, _without_geometry(read_ping360_text)),
    Format("Gemini (.glf)", is_gemini, _without_geometry(read_gemini)),
    Format("ROS bags (.bag, .mcap, .db3, folders)", is_ros_bag, read_ros_bag),
    Format("folders of UXO (DFKI)", is_uxo, _without_geometry(read_uxo)),
    Format("folders of CANOE", is_canoe, _without_geometry(read_canoe)),
    Format("folders of views (neusis)", is_neusis, _without_geometry(read_neusis)),
    Format("stacks of pictures (.npz)", is_picture_stack, _without_topic(read_picture_stack)),
    Format("videos (.avi, .mp4)", is_video, _without_topic(read_picture_video)),
    Format("folders of pictures (PNG, JPEG, PGM)", holds_pictures, _without_topic(read_picture_folder)),
)
"""All formats of frames, in the order in which they are tried."""


class SideScanFormat(NamedTuple):
    """A format of side-scan recordings and its reader.

    Attributes:
        words: readable name.
        fits: function that returns whether a path with these first bytes (empty for a folder) has the format.
        read: function that opens a recording.
    """

    words: str
    fits: Callable[[Path, bytes], bool]
    read: Callable[[Path], SideScan]


SIDE_SCANS: tuple[SideScanFormat, ...] = (
    SideScanFormat("XTF (.xtf)", is_xtf, read_xtf),
    SideScanFormat("JSF (.jsf)", is_jsf, read_jsf),
    SideScanFormat("folders of PINGVerter", is_pingverter, read_pingverter),
    SideScanFormat("echograms of mitsonar (.npz, folders of runs)", holds_echogram, read_echogram),
)
"""All formats of side-scans, in the order in which they are tried."""


def detect_format(path: str | Path) -> Format | None:
    """Return the format of a file or folder; None if it is not a recording with frames or does not exist."""
    first = _first_bytes(Path(path))
    return None if first is None else next((one for one in FORMATS if one.fits(Path(path), first)), None)


def detect_side_scan(path: str | Path) -> SideScanFormat | None:
    """Return the format of a file or folder; None if it is not a side-scan or does not exist."""
    first = _first_bytes(Path(path))
    return None if first is None else next((one for one in SIDE_SCANS if one.fits(Path(path), first)), None)


def _first_bytes(path: Path) -> bytes | None:
    """Return the first bytes of a file; none of a folder; None if there is neither or it cannot be read."""
    if os.path.isfile(path):
        try:
            with path.open("rb") as file:
                return file.read(FIRST_BYTES)
        except OSError:
            return None
    return b"" if os.path.isdir(path) else None


MOST_TRIED, MOST_NAMED = 100, 5
"""Entries of a folder that are tried as recordings, and recordings that a message names."""


def recordings_in(folder: Path) -> str:
    """Return advice that names the recordings in a folder, which is none itself; empty if it holds none."""
    try:
        entries = sorted(folder.iterdir())[:MOST_TRIED] if os.path.isdir(folder) else []
    except OSError:
        return ""
    inside = [one for one in entries if frames_in(one) is not None or detect_format(one) is not None or frameless_words(one)]
    if len(inside) < 2:
        return f"give the recording in it, {inside[0]}" if inside else ""
    more = f" and {len(inside) - MOST_NAMED:,} more" if len(inside) > MOST_NAMED else ""
    return f"give one of the recordings in it: {', '.join(one.name for one in inside[:MOST_NAMED])}{more}"


def known_formats() -> str:
    """Return the names of all formats as one string, for messages."""
    frameless = ", ".join((*(one.words for one in SIDE_SCANS), "Sonar 3D-15 (.sonar)"))
    return f"{', '.join(one.words for one in FORMATS)}; without frames: {frameless}"


def open_recording(path: str | Path, geometry: str | Path | None = None, topic: str | None = None) -> Recording:
    """Open a recording of a real sonar; pixels are read on demand.

    Args:
        path: path of a file or folder; its content determines the format (docs/guides/recordings.md).
        geometry: a geometry file, for pictures. Other formats contain their geometry.
        topic: topic of the sonar in a ROS bag; default: the only one.

    Raises:
        MitsonarError: if the path does not exist, has no known format or is damaged, if there is no such topic, or if a
            geometry is given that is not needed.
    """
    recording_format = detect_format(path)
    if recording_format is None:
        if not os.path.exists(path):
            raise missing_file(path)
        if words := frameless_words(path):
            raise MitsonarError(words)
        advice = recordings_in(Path(path)) or f"it reads {known_formats()}"
        raise MitsonarError(f"{path} is not a recording that mitsonar reads: {advice}")
    return recording_format.read(Path(path), None if geometry is None else Path(geometry), topic)


def frameless_words(path: str | Path) -> str:
    """Return the message for a side-scan, or a recording of ranges, where frames are needed; empty for anything else."""
    if detect_side_scan(path) is not None:
        return (
            f"{path} is a side-scan, which has pings in place of frames: `mitsonar recording info`, `show` and `convert` "
            "and `mitsonar mosaic` take it, and mitsonar.open_side_scan in Python"
        )
    if is_range_images(Path(path), _first_bytes(Path(path)) or b""):
        return (
            f"{path} holds points of each ping in place of frames: `mitsonar recording info` and `convert` take it, and "
            "mitsonar.recordings.open.open_ranges in Python"
        )
    return ""


def open_ranges(path: str | Path, topic: str | None = None) -> RangeRecording | None:
    """Open a recording of a sonar that measures ranges: a ``.sonar`` file, or a ROS bag with ``SonarRanges``.

    Args:
        path: path of a file or folder; its content determines the format (docs/guides/recordings.md).
        topic: topic of the sonar in a ROS bag; default: the only one, if the bag has no images of a sonar.

    Returns:
        The recording; None if the path is something else.

    Raises:
        MitsonarError: if the file is damaged, or has several such topics of which none is chosen.
    """
    path, first = Path(path), _first_bytes(Path(path))
    if first is not None and is_range_images(path, first):
        if topic is not None:
            raise MitsonarError(f"{path} is a recording of one sonar without topics: omit {topic!r}")
        return read_range_images(path)
    if first is None or not is_ros_bag(path, first):
        return None
    bag = BagFile(path)
    if topic is None and any(one.kind in SONARS and one.messages for one in bag.topics()):
        return None
    chosen = ranges_topic(bag, topic)
    return None if chosen is None else read_ros_ranges(bag, chosen)


def open_side_scan(path: str | Path) -> SideScan:
    """Open a recording of a side-scan sonar, real or simulated; samples are read part by part.

    Args:
        path: an XTF or JSF file, a folder of PINGVerter, the echogram of a simulated side-scan, or the folder of its run
            (docs/guides/side-scan.md).

    Raises:
        MitsonarError: if the path does not exist, has no known format, is damaged, or holds no pings of both sides.
    """
    side_scan_format = detect_side_scan(path)
    if side_scan_format is None:
        if not os.path.exists(path):
            raise missing_file(path)
        advice = recordings_in(Path(path)) or f"it reads {', '.join(one.words for one in SIDE_SCANS)}"
        raise MitsonarError(f"{path} is not a side-scan that mitsonar reads: {advice}")
    return side_scan_format.read(Path(path))


# ---------------- Summary of a recording


Array = NDArray[np.float64]

Summary: TypeAlias = dict[str, Any]
"""JSON values, keyed by name: numbers, strings, lists and dictionaries of them."""

GAP_RATIO = 2.5
"""A time step between frames counts as a gap if it exceeds this multiple of the median step."""

DATES_FROM_S, DATES_TO_S = 946_684_800.0, 32_503_680_000.0
"""Times from the first to the second are shown as dates: 2000-01-01 to 3000-01-01 [s since 1970]."""


def summary_of(recording: Recording | SideScan | RangeRecording) -> Summary:
    """Return a summary of a recording; angles are in degrees, all other values in SI units.

    The summary lists frames or pings, format, facts and notes, and of each part its window, beams or sides, rate, times,
    gaps, attitude and path length.
    """
    if isinstance(recording, SideScan):
        unit, parts = "pings", [_side_scan_summary(part) for part in recording.parts]
    elif isinstance(recording, RangeRecording):
        unit, parts = "pings", [_range_summary(recording)]
    else:
        unit, parts = "frames", [_part_summary(part) for part in recording.parts]
    return {
        "name": recording.name,
        "format": recording.format,
        unit: len(recording),
        "parts": parts,
        "facts": dict(recording.facts),
        "notes": list(recording.notes),
    }


def _part_summary(part: Part) -> Summary:
    """Return the summary of a part."""
    like, sonar = part.like, part.like.sonar
    bearing = np.degrees(like.bearing_rad)
    steps = np.diff(like.range_m)
    summary: Summary = {
        "frames": len(part),
        "sonar": sonar.name,
        "window_m": [sonar.range_min, sonar.range_max],
        "bins": len(like.range_m),
        "bin_m": float(np.median(steps)) if len(steps) else None,
        "beams": len(like.bearing_rad),
        "bearing_deg": [float(bearing[0]), float(bearing[-1])],
        "elevation_fov_deg": sonar.elevation_fov_deg,
        "frequency_hz": sonar.frequency_hz,
        "sound_speed": sonar.sound_speed,
        "level": like.level,
        "samples": str(like.image.dtype),
        **_time_summary(part.time_s),
    }
    if part.attitude_rad is not None:
        names = ("pitch_deg", "roll_deg", "heading_deg")
        unwrapped = np.unwrap(part.attitude_rad, axis=0) if np.isfinite(part.attitude_rad).all() else part.attitude_rad
        summary |= {name: _limits(np.degrees(values)) for name, values in zip(names, unwrapped.T, strict=True)}
    if part.poses is not None:
        summary["path_m"] = float(np.linalg.norm(np.diff(part.poses[:, :3], axis=0), axis=1).sum())
    for name in ("height_m", "gain_db"):
        values = getattr(part, name)
        if values is not None:
            summary[name] = _limits(values)
    return summary


def _side_scan_summary(part: SideScanPart) -> Summary:
    """Return the summary of a part of a side-scan."""
    fan = part.sounder.fan
    attitude = np.unwrap(part.poses[:, 3:], axis=0)
    summary: Summary = {
        "pings": len(part),
        "sonar": part.sounder.name,
        "window_m": [fan.range_min, fan.range_max],
        "bins": fan.range_bins,
        "bin_m": (fan.range_max - fan.range_min) / fan.range_bins,
        "sides": list(part.sounder.channels),
        "frequency_hz": fan.frequency_hz,
        "sound_speed": fan.sound_speed,
        **_time_summary(part.time_s),
        **{
            name: _limits(np.degrees(values))
            for name, values in zip(("pitch_deg", "roll_deg", "heading_deg"), attitude.T, strict=True)
        },
        "depth_m": _limits(-part.poses[:, 2]) if (part.poses[:, 2] < 0).any() else None,
        "height_m": _limits(part.height_m),
        "path_m": float(np.linalg.norm(np.diff(part.poses[:, :3], axis=0), axis=1).sum()),
    }
    if part.origin is not None:
        summary["origin"] = {"epsg": part.origin.epsg, "east_m": part.origin.east_m, "north_m": part.origin.north_m}
    return summary


def _range_summary(recording: RangeRecording) -> Summary:
    """Return the summary of a recording of ranges."""
    summary: Summary = {
        "points": int(recording.points.sum()),
        "points_of_ping": [int(recording.points.min()), int(recording.points.max())],
        **_time_summary(recording.time_s),
    }
    if recording.poses is not None:
        summary["path_m"] = float(np.linalg.norm(np.diff(recording.poses[:, :3], axis=0), axis=1).sum())
    return summary


def _time_summary(time_s: Array) -> Summary:
    """Return first and last time, rate and gaps."""
    time = time_s if time_s.ndim == 1 else time_s.mean(axis=1)
    summary: Summary = {"first_s": float(time[0]), "last_s": float(time[-1])} if len(time) else {}
    steps = np.diff(time)
    if len(steps) and np.median(steps) > 0:
        usual = float(np.median(steps))
        wide = steps[steps > GAP_RATIO * usual]
        summary |= {"rate_hz": 1 / usual, "gaps": len(wide), "longest_step_s": float(steps.max())}
    return summary


def _limits(values: Array) -> list[float] | None:
    """Return the minimum and maximum of the known values; None if none is known."""
    known = values[np.isfinite(values)]
    return [float(known.min()), float(known.max())] if len(known) else None


def summary_lines(summary: Summary) -> list[str]:
    """Return the lines of a summary, formatted as a table of two columns."""
    unit = "pings" if "pings" in summary else "frames"
    rows = [("file", summary["name"]), ("format", summary["format"]), (unit, f"{summary[unit]:,}")]
    for number, part in enumerate(summary["parts"]):
        if len(summary["parts"]) > 1:
            rows.append((f"part {number}", count_noun(part[unit], unit[:-1])))
        rows += _part_rows(part)
    rows += [(f"fact {name}", _format_value(value)) for name, value in summary["facts"].items()]
    rows += [("note", note) for note in summary["notes"]]
    width = max(len(name) for name, _ in rows)
    return [f"{name:<{width}}  {value}" for name, value in rows]


def _part_rows(part: Summary) -> list[tuple[str, str]]:
    """Return the table rows of a part: name and value."""
    if "points" in part:
        fewest, most = part["points_of_ping"]
        rows = [("points", f"{part['points']:,}, {fewest:,}..{most:,} a ping")]
    else:
        rows = _window_rows(part)
    if "first_s" in part:
        duration_s = part["last_s"] - part["first_s"]
        rows.append(("times", f"{_format_time(part['first_s'])} to {_format_time(part['last_s'])}, {duration_s:.6g} s"))
    if "rate_hz" in part:
        longest = f"; the longest step takes {part['longest_step_s']:.4g} s" if part["gaps"] else ""
        rows.append(("rate", f"{part['rate_hz']:.4g} Hz, {count_noun(part['gaps'], 'gap')}{longest}"))
    units = {"pitch_deg": "deg", "roll_deg": "deg", "heading_deg": "deg", "depth_m": "m", "height_m": "m", "gain_db": "dB"}
    for name, unit in units.items():
        if part.get(name) is not None:
            least, most = part[name]
            rows.append((name.rpartition("_")[0], f"{least:.4g}..{most:.4g} {unit}"))
    if "path_m" in part:
        rows.append(("poses", f"known; the path is {part['path_m']:.4g} m long"))
    if "origin" in part:
        origin = part["origin"]
        rows.append(("origin", f"{origin['east_m']:.0f} m east, {origin['north_m']:.0f} m north in EPSG:{origin['epsg']}"))
    return rows


def _window_rows(part: Summary) -> list[tuple[str, str]]:
    """Return the table rows of the sonar of a part: window, beams or sides, coding, sound speed and carrier."""
    low, high = part["window_m"]
    step = "" if part["bin_m"] is None else f" of {part['bin_m'] * 1e3:.4g} mm"
    rows = [("sonar", part["sonar"]), ("window", f"{low:.4g}..{high:.4g} m, {count_noun(part['bins'], 'bin')}{step}")]
    if "sides" in part:
        rows.append(("sides", ", ".join(part["sides"])))
    else:
        first, last = part["bearing_deg"]
        rows.append(
            ("beams", f"{part['beams']:,} from {first:.4g} to {last:.4g} deg, {part['elevation_fov_deg']:.4g} deg high")
        )
        rows.append(("level", f"{part['level']}, {part['samples']}"))
    rows.append(("sound speed", f"{part['sound_speed']:.6g} m/s"))
    if part["frequency_hz"]:
        rows.append(("carrier", f"{part['frequency_hz'] / 1e3:,.6g} kHz"))
    return rows


def _format_time(time_s: float) -> str:
    """Format a time: as a date in UTC if it is one, otherwise in seconds."""
    if not DATES_FROM_S <= time_s < DATES_TO_S:
        return f"{time_s:.6g} s"
    return datetime.fromtimestamp(time_s, UTC).isoformat(sep=" ", timespec="milliseconds").removesuffix("+00:00")


def _format_value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list) and len(value) == 2 and all(isinstance(one, int | float) for one in value):
        return f"{value[0]:.6g}..{value[1]:.6g}"
    if isinstance(value, list):
        return ", ".join(_format_value(one) for one in value)
    return str(value)
