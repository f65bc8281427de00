"""What a recording is, in rows: frames, parts, window, beams, rate, times, gaps, attitude, poses, facts and notes."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import counted
from mitsonar.recordings.recording import Part, Recording

__all__ = ["Summary", "summary_lines", "summary_of"]

Array = NDArray[np.float64]

Summary: TypeAlias = dict[str, Any]
"""Values by name as JSON holds them: numbers, texts, lists and tables of them."""

GAP = 2.5
"""A gap is a step between frames beyond this many usual ones."""

SINCE_S = 946_684_800.0
"""Times beyond this are dates: 2000-01-01 [s since 1970]."""


def summary_of(recording: Recording) -> Summary:
    """Return what a recording is; angles in degrees, all else SI."""
    return {
        "name": recording.name,
        "format": recording.format,
        "frames": len(recording),
        "parts": [_part_of(part) for part in recording.parts],
        "facts": dict(recording.facts),
        "notes": list(recording.notes),
    }


def _part_of(part: Part) -> Summary:
    """Return what a part is."""
    like, sonar = part.like, part.like.sonar
    bearing = np.degrees(like.bearing_rad)
    steps = np.diff(like.range_m)
    found: Summary = {
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
        **_times_of(part.time_s),
    }
    if part.attitude_rad is not None:
        names = ("pitch_deg", "roll_deg", "heading_deg")
        turned = np.unwrap(part.attitude_rad, axis=0) if np.isfinite(part.attitude_rad).all() else part.attitude_rad
        found |= {name: _ends(np.degrees(values)) for name, values in zip(names, turned.T, strict=True)}
    if part.poses is not None:
        found["path_m"] = float(np.linalg.norm(np.diff(part.poses[:, :3], axis=0), axis=1).sum())
    for name in ("height_m", "gain_db"):
        values = getattr(part, name)
        if values is not None:
            found[name] = _ends(values)
    return found


def _times_of(time_s: Array) -> Summary:
    """Return first and last time, rate and gaps."""
    time = time_s if time_s.ndim == 1 else time_s.mean(axis=1)
    found: Summary = {"first_s": float(time[0]), "last_s": float(time[-1])} if len(time) else {}
    steps = np.diff(time)
    if len(steps) and np.median(steps) > 0:
        usual = float(np.median(steps))
        wide = steps[steps > GAP * usual]
        found |= {"rate_hz": 1 / usual, "gaps": len(wide), "longest_step_s": float(steps.max())}
    return found


def _ends(values: Array) -> list[float] | None:
    """Return the least and the greatest known value; None where none is known."""
    known = values[np.isfinite(values)]
    return [float(known.min()), float(known.max())] if len(known) else None


def summary_lines(summary: Summary) -> list[str]:
    """Return a summary as a table of two columns, a line each."""
    rows = [("file", summary["name"]), ("format", summary["format"]), ("frames", f"{summary['frames']:,}")]
    for number, part in enumerate(summary["parts"]):
        if len(summary["parts"]) > 1:
            rows.append((f"part {number}", counted(part["frames"], "frame")))
        rows += _rows_of(part)
    rows += [(f"fact {name}", _shown(value)) for name, value in summary["facts"].items()]
    rows += [("note", note) for note in summary["notes"]]
    width = max(len(name) for name, _ in rows)
    return [f"{name:<{width}}  {value}" for name, value in rows]


def _rows_of(part: Summary) -> list[tuple[str, str]]:
    """Return the rows of a part."""
    low, high = part["window_m"]
    step = "" if part["bin_m"] is None else f" of {part['bin_m'] * 1e3:.4g} mm"
    first, last = part["bearing_deg"]
    rows = [
        ("sonar", part["sonar"]),
        ("window", f"{low:.4g}..{high:.4g} m, {counted(part['bins'], 'bin')}{step}"),
        ("beams", f"{part['beams']:,} from {first:.4g} to {last:.4g} deg, {part['elevation_fov_deg']:.4g} deg high"),
        ("level", f"{part['level']}, {part['samples']}"),
        ("sound speed", f"{part['sound_speed']:.6g} m/s"),
    ]
    if part["frequency_hz"]:
        rows.append(("carrier", f"{part['frequency_hz'] / 1e3:,.6g} kHz"))
    if "first_s" in part:
        rows.append(
            ("times", f"{_date(part['first_s'])} to {_date(part['last_s'])}, {part['last_s'] - part['first_s']:.6g} s")
        )
    if "rate_hz" in part:
        longest = f"; the longest step takes {part['longest_step_s']:.4g} s" if part["gaps"] else ""
        rows.append(("rate", f"{part['rate_hz']:.4g} Hz, {counted(part['gaps'], 'gap')}{longest}"))
    units = {"pitch_deg": "deg", "roll_deg": "deg", "heading_deg": "deg", "height_m": "m", "gain_db": "dB"}
    for name, unit in units.items():
        if part.get(name) is not None:
            least, most = part[name]
            rows.append((name.rpartition("_")[0], f"{least:.4g}..{most:.4g} {unit}"))
    if "path_m" in part:
        rows.append(("poses", f"known; the path is {part['path_m']:.4g} m long"))
    return rows


def _date(time_s: float) -> str:
    """Return a time: as a date in UTC where it is one, else in seconds."""
    if time_s < SINCE_S:
        return f"{time_s:.6g} s"
    return datetime.fromtimestamp(time_s, UTC).isoformat(sep=" ", timespec="milliseconds").removesuffix("+00:00")


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list) and len(value) == 2 and all(isinstance(one, int | float) for one in value):
        return f"{value[0]:.6g}..{value[1]:.6g}"
    if isinstance(value, list):
        return ", ".join(_shown(one) for one in value)
    return str(value)
