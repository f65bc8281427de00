"""What does every reader of side-scan files return? A recording in parts, each of which is read as an echogram.

A side-scan has one beam a side, so that its pings are no frames of a fan. They become the same record as those of a
simulated side-scan, :class:`mitsonar.records.soundings.Echogram`. This file also turns what file headers state about
positions, attitudes and instruments into poses and a :class:`mitsonar.instruments.sounder.Sounder`.
"""

from __future__ import annotations

import math
import os
import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.instruments.sounder import Sounder
from mitsonar.motion.utm import LATITUDES_DEG, UtmOrigin
from mitsonar.recordings.recording import Bytes, Facts
from mitsonar.records.soundings import Echogram

__all__ = [
    "Band",
    "Index",
    "Levels",
    "PingHeaders",
    "Placed",
    "SideScan",
    "SideScanPart",
    "amplitudes_of",
    "holds_echogram",
    "in_hertz",
    "marked_packets",
    "parts_of",
    "place_pings",
    "read_echogram",
    "sound_speed_of",
]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Levels = NDArray[np.float32]

SOUND_SPEEDS = (1300.0, 1800.0)
"""Plausible sound speeds [m/s]."""

ASSUMED_SOUND_SPEED = 1500.0
"""Sound speed for files that state none [m/s]."""

HERTZ_FROM = 10_000.0
"""Formats leave the unit of frequencies open: smaller numbers count as kHz, others as Hz."""

LARGEST_SAMPLE = 1e8
"""Amplitudes of floats must stay below this."""

MOST_WEIGHT = 30
"""Samples are scaled by 2^-N with a weight N of the file; larger weights are damage."""

TYPICAL = {"azimuth_fov_deg": 1.0, "elevation_fov_deg": 50.0, "tilt_deg": 30.0}
"""Beam width, vertical beam width and tilt for files that state none: the typical values that the XTF format names."""

FARTHEST_DEG = 1.0
"""Positions farther from the median are errors: in latitude, and in longitude times the cosine of the latitude [deg]."""

FARTHEST_M = 1e5
"""The same for positions in metres."""

WINDOW_TOLERANCE = 0.005
"""Ends of windows that move by less than this fraction of the range follow the sound speed, and begin no other part."""

VELOCITY_S = 5.0
"""Time over which the velocity is taken that extends the track before its first and behind its last fix [s]."""

SHORTEST_TRACK_M = 1.0
"""A track must be longer than this to give a course."""

LEAST_STEP_M = 0.1
"""Over :data:`VELOCITY_S` a vehicle must move this far to have a course: at rest it keeps its last one."""

LEAST_COURSE_M = 20.0
"""A track must be longer than this for its course to be compared with headings."""

UNUSUAL_DRIFT_DEG = 10.0
"""Mean difference of course and heading from which a note mentions it."""

PROBED_PINGS = 200
"""Pings, spread over a part, in which its last samples are looked at."""

LEAST_PROBED = 10
"""Fewer pings than these do not show that a sample is never filled."""

NEIGHBOURS = 16
"""Samples before the last ones with which these are compared."""

MOST_EQUAL = 0.1
"""Fraction of the neighbours up to which they may have the value of the fill."""

MOST_WEAK, WEAK = 8, 0.05
"""At most so many last samples are left out that stay below this fraction of the median of their neighbours.

Speckle brings a sample below a twentieth of the median in 3.4 % of all pings, and in all of ten pings never.
"""


@dataclass(frozen=True)
class SideScanPart:
    """Consecutive pings of one frequency and one window.

    Attributes:
        time_s: times of the pings ``(pings,)``, increasing [s since 1970 if the file records the date].
        poses: poses of the vehicle ``(pings, 6)`` [m, rad].
        height_m: height over the ground by the file ``(pings,)`` [m]; nan where unknown.
        sounder: the instrument.
        levels: function that reads the intensities ``(pings, channels, bins)``.
        origin: where on the Earth the origin of the poses lies, if known.
    """

    time_s: Array
    poses: Array
    height_m: Array
    sounder: Sounder
    levels: Callable[[], Levels]
    origin: UtmOrigin | None = None

    def __len__(self) -> int:
        """Return the number of pings."""
        return len(self.time_s)

    def read(self) -> Echogram:
        """Read all pings.

        Raises:
            MitsonarError: if samples are not numbers.
        """
        return Echogram(self.time_s, self.poses, self.sounder, self.levels(), self.height_m, self.origin)


@dataclass(frozen=True)
class SideScan:
    """A recording of a side-scan sonar, real or simulated.

    Attributes:
        name: name of the file.
        format: readable name of the format, such as ``XTF (.xtf)``.
        parts: one part for each frequency and window.
        facts: header values, keyed by name.
        notes: sentences on what was left out, sorted or assumed.
    """

    name: str
    format: str
    parts: tuple[SideScanPart, ...]
    facts: Facts = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not any(len(part) for part in self.parts):
            raise MitsonarError(f"{self.name} holds no ping of port and starboard that can be read: it is empty or damaged")

    def __len__(self) -> int:
        """Return the number of pings in all parts."""
        return sum(len(part) for part in self.parts)

    @property
    def longest(self) -> int:
        """Return the index of the part with the most pings; the first one if several are equally long."""
        return int(np.argmax([len(part) for part in self.parts]))

    def part(self, number: int | None = None) -> SideScanPart:
        """Return a part by its index; default: the longest.

        Raises:
            MitsonarError: if there is no such part.
        """
        if number is not None and not 0 <= number < len(self.parts):
            raise MitsonarError(f"{self.name} has no part {number}: it has {len(self.parts):,}, numbered from 0")
        return self.parts[self.longest if number is None else number]


ECHOGRAM = "echogram.npz"
"""Name of the echogram in the folder of a run."""


def holds_echogram(path: Path, first: bytes) -> bool:
    """Return whether a file is an echogram of mitsonar, or a folder holds one, by the names of its arrays."""
    file = path if first else path / ECHOGRAM
    if file.suffix != ".npz" or not os.path.isfile(file):
        return False
    try:
        with zipfile.ZipFile(file) as parts:
            return {"sounder.npy", "levels.npy", "height_m.npy"} <= set(parts.namelist())
    except Exception:  # damaged bytes raise errors of many kinds
        return False


def read_echogram(path: Path) -> SideScan:
    """Open an echogram of :meth:`mitsonar.records.soundings.Echogram.save`, or in the folder of a run, as a recording.

    Raises:
        MitsonarError: a file that cannot be read, or the echogram of another instrument.
    """
    echogram = Echogram.load(path / ECHOGRAM if os.path.isdir(path) else path)
    if echogram.sounder.kind != "sidescan":
        raise MitsonarError(f"{path} is the echogram of a {echogram.sounder.kind}, not of a side-scan")
    if (np.diff(echogram.time_s) <= 0).any():
        raise MitsonarError(f"{path} has pings that are not in order of time: it is damaged")
    part = SideScanPart(
        echogram.time_s,
        echogram.poses,
        echogram.height_m,
        echogram.sounder,
        lambda: echogram.levels,
        echogram.origin,
    )
    return SideScan(path.name, "echogram of mitsonar (.npz)", (part,))


# ---------------- Packets, and the numbers in them


def marked_packets(
    data: Bytes, mark: bytes, start: int, head: int, size_at: Callable[[memoryview, int], int]
) -> Iterator[tuple[int, int]]:
    """Yield the begin and end of each packet of a file [bytes], in order.

    A mark that occurs by chance, or whose packet does not fit into the file, is passed over: the search goes on behind its
    first byte.

    Args:
        data: the whole file.
        mark: first bytes of a packet.
        start: where the search begins [bytes].
        head: size of the header of a packet [bytes].
        size_at: function that returns the size of the packet whose header begins at an offset [bytes]; 0 for no packet.
    """
    view, pattern, offset = data.data, re.compile(re.escape(mark)), start
    while (hit := pattern.search(view, offset)) and hit.start() + head <= len(view):
        at = hit.start()
        size = size_at(view, at)
        if head <= size <= len(view) - at:
            yield at, at + size
            offset = at + size
        else:
            offset = at + 1


def sound_speed_of(*stated: Array) -> tuple[float, list[str]]:
    """Return the median of the plausible sound speeds in the first field that has some [m/s], and a sentence if none has."""
    low, high = SOUND_SPEEDS
    for values in stated:
        plausible = values[(values >= low) & (values <= high)]
        if len(plausible):
            return float(np.median(plausible)), []
    return ASSUMED_SOUND_SPEED, [f"the file states no sound speed: {ASSUMED_SOUND_SPEED:g} m/s is assumed"]


def in_hertz(frequency: ArrayLike) -> Array:
    """Return frequencies of a file, which are in kHz below :data:`HERTZ_FROM`, in Hz."""
    stated = np.asarray(frequency, dtype=np.float64)
    return np.where(stated < HERTZ_FROM, 1e3 * stated, stated)


def amplitudes_of(raw: NDArray[Any], ping: int) -> Array:
    """Return the samples of a ping as doubles.

    Raises:
        MitsonarError: if a float is not a number, or too large for one.
    """
    if raw.dtype.kind == "f" and not (np.abs(raw) < LARGEST_SAMPLE).all():
        raise MitsonarError(f"ping {ping} has samples that are no finite amplitudes: the file is damaged")
    return raw.astype(np.float64)


# ---------------- Positions and attitudes


@dataclass(frozen=True)
class PingHeaders:
    """What a file states about its pings, one row a ping in the order of the file; nan where it states nothing.

    Attributes:
        time_s: times ``(pings,)`` [s].
        position: latitude and longitude [deg], or x east and y north [m] ``(pings, 2)``.
        in_degrees: whether positions are latitudes and longitudes.
        heading_deg: clockwise from true north ``(pings,)``.
        pitch_deg: positive with the bow up ``(pings,)``.
        roll_deg: positive with starboard down ``(pings,)``.
        depth_m: depth of the sonar below the surface ``(pings,)``.
        height_m: height of the sonar over the ground ``(pings,)``.
    """

    time_s: Array
    position: Array
    in_degrees: bool
    heading_deg: Array
    pitch_deg: Array
    roll_deg: Array
    depth_m: Array
    height_m: Array


class Placed(NamedTuple):
    """Poses of the pings of a file in order of time.

    Attributes:
        rows: indices of the pings in the file ``(n,)``.
        time_s: times ``(n,)``, increasing [s].
        poses: poses of the sonar ``(n, 6)`` [m, rad].
        height_m: heights over the ground ``(n,)`` [m]; nan where unknown.
        origin: where on the Earth the origin of the poses lies, if positions are latitudes and longitudes.
        facts: number of positions, and the first of them.
        notes: sentences on what was sorted, assumed or left out.
    """

    rows: Index
    time_s: Array
    poses: Array
    height_m: Array
    origin: UtmOrigin | None
    facts: Facts
    notes: list[str]


def place_pings(pings: PingHeaders) -> Placed:
    """Compute the pose of every ping with a valid time.

    Positions between two fixes are interpolated, since files repeat a fix until the next one arrives. Pings before the first
    and behind the last fix continue the track for at most two intervals of fixes. Without a heading the course of the track
    is taken.
    """
    rows, time_s, notes = _in_time_order(pings.time_s)
    known, position, origin, position_notes = _valid_positions(pings, rows)
    notes += position_notes
    facts: Facts = {}
    # 1. track: from the pings whose position is new
    xy = np.zeros((len(rows), 2))
    if known.any():
        place = np.flatnonzero(known)
        new = place[np.append(True, (np.diff(position[place], axis=0) != 0).any(axis=1))]
        facts["fixes"] = f"{len(new):,} in {count_noun(len(rows), 'ping')}"
        if origin is not None:
            facts["position"] = "{:.5f}, {:.5f} deg".format(*pings.position[rows[place[0]]])
        xy = _track(time_s, time_s[new], position[new])
    elif len(rows):
        notes.append("the file states no position: the pings are drawn as if the vehicle did not move")
    # 2. attitude: true headings become those of the grid
    heading = _filled(np.radians(pings.heading_deg[rows]), turns=True)
    if heading is None:
        heading = _course(time_s, xy)
        notes.append("the file states no heading: headings are the course of the track")
    else:
        if origin is not None and len(rows):
            heading = heading - origin.convergence_rad(origin.to_degrees(xy[:1]))[0]
        notes += _heading_note(time_s, xy, heading)
    pitch, roll, depth = (
        np.zeros(len(rows)) if (values := _filled(stated[rows])) is None else values
        for stated in (-np.radians(pings.pitch_deg), np.radians(pings.roll_deg), pings.depth_m)
    )
    poses = np.column_stack([xy, -depth, pitch, roll, heading])
    return Placed(rows, time_s, poses, pings.height_m[rows], origin, facts, notes)


def _in_time_order(time_s: Array) -> tuple[Index, Array, list[str]]:
    """Sort pings by time, and space those evenly that share a time, since clocks of files tick slower than sonars ping.

    Returns:
        The indices of the pings with a valid time, their times, and sentences on what was sorted or left out.
    """
    known = np.isfinite(time_s)
    rows = np.flatnonzero(known)[np.argsort(time_s[known], kind="stable")]
    notes = [] if known.all() else [f"left out: {count_noun(int((~known).sum()), 'ping')} without a valid time"]
    if (np.diff(rows) < 0).any():
        notes.append("pings are not in order of time: they were sorted")
    ticks, first, count = np.unique(time_s[rows], return_index=True, return_counts=True)
    if len(ticks) == len(rows):
        return rows, ticks, notes
    gap = np.diff(ticks)
    gap = np.append(gap, np.median(gap) if len(gap) else 1.0)
    usual = float(np.median(gap / count))
    share = np.minimum(gap / count, usual)  # a pause behind pings that share a time stays a pause
    within = np.arange(len(rows)) - np.repeat(first, count)
    notes.append(f"{count_noun(len(rows) - len(ticks), 'ping')} at the time of the one before: spaced evenly")
    return rows, np.repeat(ticks, count) + within * np.repeat(share, count), notes


class _Positions(NamedTuple):
    """Which pings have a position, the positions ``(n, 2)`` [m], their origin, and notes."""

    known: NDArray[np.bool_]
    xy: Array
    origin: UtmOrigin | None
    notes: list[str]


def _valid_positions(pings: PingHeaders, rows: Index) -> _Positions:
    """Return the valid positions in metres."""
    stated = pings.position[rows]
    known: NDArray[np.bool_] = np.asarray(np.isfinite(stated).all(axis=1))
    if pings.in_degrees:
        known &= (stated[:, 0] >= LATITUDES_DEG[0]) & (stated[:, 0] <= LATITUDES_DEG[1]) & (np.abs(stated[:, 1]) <= 180)
    if not known.any():
        return _Positions(known, stated, None, [])
    centre = np.median(stated[known], axis=0)
    away = np.abs(np.where(known[:, None], stated, centre) - centre)
    if pings.in_degrees:
        away[:, 1] = np.minimum(away[:, 1], 360 - away[:, 1]) * math.cos(math.radians(centre[0]))
    far = (away > (FARTHEST_DEG if pings.in_degrees else FARTHEST_M)).any(axis=1)
    known &= ~far
    notes = []
    if far.any():
        notes.append(f"left out: positions of {count_noun(int(far.sum()), 'ping')}, far from those of the others")
    if not known.any():
        return _Positions(known, stated, None, notes)
    if (~known & ~far).any():
        without = count_noun(int((~known & ~far).sum()), "ping")
        notes.append(f"{without} without a position: placed by the nearest fixes")
    if not pings.in_degrees:
        return _Positions(known, stated, None, notes)
    origin = UtmOrigin.near(*stated[known][0])
    xy = np.zeros_like(stated)
    xy[known] = origin.to_world(stated[known])
    return _Positions(known, xy, origin, notes)


def _track(time_s: Array, fix_s: Array, fixes: Array) -> Array:
    """Interpolate fixes ``(k, 2)`` to the times of pings ``(n, 2)`` [m]; extend them by two of their intervals at most."""
    xy = np.column_stack([np.interp(time_s, fix_s, column) for column in fixes.T])
    if len(fixes) < 2:
        return xy
    longest = 2 * float(np.median(np.diff(fix_s)))
    near_end = max(0, int(np.searchsorted(fix_s, fix_s[-1] - VELOCITY_S)) - 1)
    near_begin = min(len(fix_s) - 1, int(np.searchsorted(fix_s, fix_s[0] + VELOCITY_S)))
    for first, last, at, side in ((0, near_begin, 0, time_s < fix_s[0]), (near_end, -1, -1, time_s > fix_s[-1])):
        velocity = (fixes[last] - fixes[first]) / (fix_s[last] - fix_s[first])
        xy[side] += np.clip(time_s[side] - fix_s[at], -longest, longest)[:, None] * velocity
    return xy


def _course(time_s: Array, xy: Array) -> Array:
    """Return the direction of the track at each ping ``(n,)`` [rad].

    A vehicle that stops keeps its last course, before it sets off it has its first one, and one that never moves has 0.
    """
    if len(xy) < 2 or np.linalg.norm(np.ptp(xy, axis=0)) < SHORTEST_TRACK_M:
        return np.zeros(len(xy))
    half = VELOCITY_S / 2
    ahead, behind = (np.column_stack([np.interp(time_s + dt, time_s, one) for one in xy.T]) for dt in (half, -half))
    east, north = (ahead - behind).T
    moving = np.flatnonzero(np.hypot(east, north) >= LEAST_STEP_M)
    if not len(moving):
        return np.zeros(len(xy))
    last = moving[np.maximum(np.searchsorted(moving, np.arange(len(xy)), side="right") - 1, 0)]
    return np.unwrap(np.arctan2(east[last], north[last]))


def _heading_note(time_s: Array, xy: Array, heading: Array) -> list[str]:
    """Return a sentence if headings differ much from the course of the track."""
    if len(xy) < 2 or np.linalg.norm(np.ptp(xy, axis=0)) < LEAST_COURSE_M:
        return []
    difference = np.angle(np.exp(1j * (_course(time_s, xy) - heading)))
    middle = float(np.degrees(np.angle(np.exp(1j * difference).mean())))
    if abs(middle) < UNUSUAL_DRIFT_DEG:
        return []
    return [
        f"the track lies {middle:+.0f} deg from the headings in the mean: they may be magnetic (mosaic --declination), or a "
        "current sets the vehicle"
    ]


def _filled(values: Array, turns: bool = False) -> Array | None:
    """Fill unknown values by interpolation between pings; None if all are unknown."""
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return None
    stated = np.unwrap(values[known]) if turns else values[known]
    return np.interp(np.arange(len(values)), known, stated)


# ---------------- Windows and instruments


@dataclass(frozen=True)
class Band:
    """The pings of one pair of port and starboard channels, as a file describes them; nan or 0 where it states nothing.

    Attributes:
        rows: index of each ping among the :class:`PingHeaders` ``(n,)``.
        samples: samples of a side ``(n,)``.
        range_min: start of the window ``(n,)`` [m].
        range_max: end of the window ``(n,)`` [m].
        frequency_hz: carrier ``(n,)`` [Hz].
        levels: function that reads intensities ``(k, 2, samples)`` of pings ``(k,)`` with equal numbers of samples, by their
            indices in this band.
        name: name of the sonar.
        sound_speed: [m/s].
        azimuth_fov_deg: beam width along the track [deg].
        elevation_fov_deg: beam width across the track [deg].
        tilt_deg: angle of the axis below the horizon [deg].
    """

    rows: Index
    samples: NDArray[np.int64]
    range_min: Array
    range_max: Array
    frequency_hz: Array
    levels: Callable[[Index], Levels]
    name: str
    sound_speed: float
    azimuth_fov_deg: float = 0.0
    elevation_fov_deg: float = 0.0
    tilt_deg: float = 0.0


def parts_of(band: Band, placed: Placed) -> tuple[list[SideScanPart], list[str]]:
    """Return one part for each run of pings with the same number of samples and about the same window, and notes.

    The last samples of a side are left out where no ping of the run fills them.

    Raises:
        MitsonarError: a value of the instrument is outside its limits.
    """
    # 1. pings of the band in order of time, without those that have no valid time
    order = np.full(max(band.rows.max(initial=-1), placed.rows.max(initial=-1)) + 1, -1)
    order[placed.rows] = np.arange(len(placed.rows))
    here = order[band.rows]
    pings = np.argsort(here, kind="stable")[int((here < 0).sum()) :]
    # 2. runs of equal windows
    parts, notes = [], []
    for run in _windows(band.samples[pings], band.range_min[pings], band.range_max[pings]):
        members = pings[run]
        where = here[members]
        time_s = placed.time_s[where]
        empty = _empty_bins(band, members)
        bins = int(band.samples[members[0]]) - empty
        if empty:
            notes.append(f"left out: {count_noun(empty, 'sample')} at the end of each side, never filled")
        parts.append(
            SideScanPart(
                time_s=time_s,
                poses=placed.poses[where],
                height_m=placed.height_m[where],
                sounder=_sounder(band, members, time_s, bins),
                levels=partial(_first_bins, band, members, bins),
                origin=placed.origin,
            )
        )
    return parts, list(dict.fromkeys(notes))


def _first_bins(band: Band, pings: Index, bins: int) -> Levels:
    """Read the intensities of the first bins ``(n, 2, bins)``."""
    return band.levels(pings)[..., :bins]


def _empty_bins(band: Band, pings: Index) -> int:
    """Return how many last samples of both sides none of :data:`PROBED_PINGS` pings fills; 0 if too few pings decide."""
    if len(pings) < LEAST_PROBED:
        return 0
    probed = pings[np.unique(np.linspace(0, len(pings) - 1, PROBED_PINGS).astype(int))]
    try:
        levels = band.levels(probed)
    except MitsonarError:  # of a damaged ping, which reading the part reports
        return 0
    return min(_empty_end(levels[:, side]) for side in range(levels.shape[1]))


def _empty_end(levels: Levels) -> int:
    """Return how many last samples of a side ``(pings, bins)`` no ping fills.

    Such samples have one value in all pings, and those before them another, as behind the fill of a recorder; echoes that
    fade below the least count do not end so. Or they are a few samples that are much weaker in every ping than those before
    them, such as amplitudes of which one byte was written.
    """
    bins = int(levels.shape[1])
    varies = np.flatnonzero((levels != levels[:1]).any(axis=0))
    if not len(varies):
        return 0
    end = int(varies[-1]) + 1
    if end < bins and (levels[:, max(0, end - NEIGHBOURS) : end] == levels[0, end]).mean() > MOST_EQUAL:
        end = bins
    for begin in range(max(1, end - MOST_WEAK), end):
        if levels[:, begin:end].max() < WEAK * np.median(levels[:, max(0, begin - NEIGHBOURS) : begin]):
            return bins - begin
    return bins - end


def _windows(samples: NDArray[np.int64], range_min: Array, range_max: Array) -> list[Index]:
    """Return the indices of each run of pings with the same number of samples and about the same window."""
    runs: list[list[int]] = []
    count, begin, end = -1, 0.0, 0.0
    for number, (size, near, far) in enumerate(zip(samples.tolist(), range_min.tolist(), range_max.tolist(), strict=True)):
        if size != count or not max(abs(near - begin), abs(far - end)) <= WINDOW_TOLERANCE * end:
            runs.append([])
            count, begin, end = size, near, far
        runs[-1].append(number)
    return [np.asarray(run, dtype=np.intp) for run in runs]


def _sounder(band: Band, pings: Index, time_s: Array, bins: int) -> Sounder:
    """Return the instrument of the first bins of some pings, with :data:`TYPICAL` angles where the file states none."""
    angles = {}
    for name, typical in TYPICAL.items():
        angle = float(getattr(band, name))
        angles[name] = angle if 0 < angle <= 90 else typical  # nan too
    tilt = angles.pop("tilt_deg")
    known: dict[str, float] = {}
    frequency_hz = float(np.median(band.frequency_hz[pings]))
    if 0 < frequency_hz < 1e8:  # nan is not
        known["frequency_hz"] = frequency_hz
    if len(time_s) > 1:
        known["frame_rate_hz"] = min(1e6, 1 / max(1e-6, float(np.median(np.diff(time_s)))))
    near, far = (float(np.median(ends[pings])) for ends in (band.range_min, band.range_max))
    return Sounder.create(
        name=band.name or "side-scan",
        kind="sidescan",
        mounts={"port": (0, 0, 0, tilt, 0, -90), "starboard": (0, 0, 0, tilt, 0, 90)},
        beams=1,
        bearing="cone",
        range_min=near,
        range_max=near + (far - near) * (bins / int(band.samples[pings[0]])),
        range_bins=bins,
        sound_speed=band.sound_speed,
        **angles,
        **known,
    )
