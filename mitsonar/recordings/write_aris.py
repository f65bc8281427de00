"""How are frames written as an ARIS file (``.aris``, DDF 5)? Frames of any sonar, simulated or real, for other programs."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, argument, count_noun
from mitsonar.instruments.sonar import Sonar, ping_interval_s
from mitsonar.recordings.recording import CHUNK_BYTES, Bytes, Header, layout
from mitsonar.recordings.sound_metrics import ARIS_CODING_DB as CODING_DB
from mitsonar.recordings.sound_metrics import (
    ARIS_MAX_SPEED as MAX_SPEED,
)
from mitsonar.recordings.sound_metrics import (
    ARIS_MIN_SPEED as MIN_SPEED,
)
from mitsonar.recordings.sound_metrics import (
    BEAMS,
    EARTH_M,
    FRAME,
    KINDS,
    MAX_SAMPLES,
    PINGS,
    SIGNATURE,
    TABLES,
    aris_bearings,
)
from mitsonar.records.frames import SonarFrames

__all__ = [
    "ORIGIN_DEG",
    "ArisTable",
    "ArisWindow",
    "Values",
    "WrittenAris",
    "half_spacing",
    "interpolated",
    "table_of",
    "window_of",
    "write_aris",
]


# ---------------- Axes of an ARIS file


Array = NDArray[np.float64]

Values = NDArray[np.float32] | NDArray[np.uint8]
"""Values 0..255 of images ``(n, bins, beams)``."""

MAX_AXIS_ERROR = 0.05
"""Largest deviation of the written range axis from that of the frames, in bins, up to which nothing is interpolated."""


@dataclass(frozen=True)
class ArisTable:
    """A beam table of the vendor, and the header fields that select it.

    Attributes:
        beams: number of beams.
        bearings: bearings ``(beams,)`` [rad], from port to starboard.
        system: number of the ARIS model.
        lens: 1 with the large lens, otherwise 0.
        high: 1 at the high frequency, otherwise 0.
    """

    beams: int
    bearings: Array
    system: int
    lens: int
    high: int


@dataclass(frozen=True)
class ArisWindow:
    """A range axis in whole microseconds.

    Attributes:
        delay_us: delay of the first sample [us].
        period_us: sample period [us].
        samples: number of samples.
        sound_speed: sound speed [m/s].
        exact: whether the axis is that of the frames, so that nothing is interpolated.
    """

    delay_us: int
    period_us: int
    samples: int
    sound_speed: float
    exact: bool

    @property
    def step_m(self) -> float:
        """Return the range step between samples [m]."""
        return self.period_us * 1e-6 * self.sound_speed / 2

    @property
    def start_m(self) -> float:
        """Return the range of the first sample [m]."""
        return self.delay_us * 1e-6 * self.sound_speed / 2


def interpolated(values: NDArray[Any], have: Array, want: Array, *, axis: int) -> NDArray[np.float32]:
    """Interpolate values linearly along an axis; the result is 0 more than half a step beyond its ends.

    Args:
        values: images ``(n, bins, beams)``.
        have: coordinates of the values along the axis, increasing.
        want: coordinates of the result.
        axis: number of the axis.
    """
    place = np.interp(want, have, np.arange(len(have)))
    low = np.clip(place.astype(np.intp), 0, max(0, len(have) - 2))
    shape = [1, 1, 1]
    shape[axis] = len(want)
    part = (place - low).astype(np.float32).reshape(shape)
    result = (
        np.take(values, low, axis=axis) * (1 - part) + np.take(values, np.minimum(low + 1, len(have) - 1), axis=axis) * part
    )
    first, last = (have[1] - have[0]) / 2, (have[-1] - have[-2]) / 2
    inside = (want >= have[0] - first) & (want <= have[-1] + last)
    return np.asarray(result * inside.reshape(shape), dtype=np.float32)


def half_spacing(bearings: Array) -> float:
    """Return half the mean angle between beams [rad]; 0 for a single beam."""
    return float(np.diff(bearings).mean()) / 2 if len(bearings) > 1 else 0.0


def table_of(bearings: Array, sonar: Sonar, beams: int | None) -> tuple[ArisTable, float]:
    """Return the beam table nearest to the given bearings, and its largest deviation from them [rad].

    Args:
        bearings: bearings of the frames ``(beams,)`` [rad].
        sonar: sonar of the frames; its name and carrier decide between equally near tables.
        beams: number of beams to interpolate to; None keeps that of the frames. If it differs from theirs, only the
            outermost bearings are compared.

    Raises:
        MitsonarError: if there is no table with this number of beams, or none is near enough without interpolation.
    """
    numbers = sorted(set(BEAMS.values()))
    count = len(bearings) if beams is None else beams
    fan = f"{len(bearings)} beams from {np.degrees(bearings[0]):.4g} to {np.degrees(bearings[-1]):.4g} deg"
    if count not in numbers:
        known = ", ".join(str(one) for one in numbers)
        raise MitsonarError(f"an ARIS file holds {known} beams: got {fan}; give {argument('beams')} 128 to interpolate them")
    tables = [_table_for(kind, count, sonar) for kind, number in TABLES if number == count]
    edge = max(abs(bearings[0]), abs(bearings[-1]))

    def deviation(table: ArisTable) -> float:
        if len(bearings) == count:
            return float(np.abs(table.bearings - bearings).max())
        return float(abs(table.bearings[-1] - edge))

    smallest = min(deviation(table) for table in tables)
    nearest = [table for table in tables if deviation(table) <= smallest + 1e-9]
    table = min(
        nearest,
        key=lambda one: (sonar.name != f"aris{KINDS[one.system].name}", _carrier_difference(one.system, one.high, sonar)),
    )
    if beams is None and smallest > half_spacing(bearings):
        raise MitsonarError(
            f"no ARIS has {fan}: the nearest table has {count} up to {np.degrees(table.bearings[-1]):.4g} deg; give "
            f"{argument('beams')} {count} to interpolate them"
        )
    return table, smallest


def _table_for(kind: str, beams: int, sonar: Sonar) -> ArisTable:
    """Return a table with the ARIS model and frequency, among those that use it, that are nearest to the given sonar."""
    systems = [one for one in KINDS if kind in ("telephoto", KINDS[one].name)]
    choices = [(system, high) for system in systems for high in (1, 0)]
    chosen = min(
        choices, key=lambda one: (sonar.name != f"aris{KINDS[one[0]].name}", _carrier_difference(one[0], one[1], sonar))
    )
    return ArisTable(beams, aris_bearings(kind, beams), chosen[0], int(kind == "telephoto"), chosen[1])


def _carrier_difference(system: int, high: int, sonar: Sonar) -> float:
    """Return the distance between the carriers of an ARIS model and a sonar [Hz]; 0 if that of the sonar is unknown."""
    carrier = KINDS[system].high_hz if high else KINDS[system].low_hz
    return abs(carrier - sonar.frequency_hz) if sonar.frequency_hz else 0.0


def window_of(range_m: Array, sound_speed: float) -> ArisWindow:
    """Return a range axis in whole microseconds: that of the frames if possible, otherwise the next finer one.

    Args:
        range_m: ranges of the frames ``(bins,)`` [m].
        sound_speed: sound speed [m/s].

    Raises:
        MitsonarError: if the format cannot hold the sound speed or the window.
    """
    if not MIN_SPEED < sound_speed < MAX_SPEED:
        raise MitsonarError(
            f"an ARIS file holds sound speeds of {MIN_SPEED:g} to {MAX_SPEED:g} m/s: got {sound_speed:g}; write "
            "frames with another sound speed"
        )
    speed = float(np.float32(sound_speed))
    bins = len(range_m)
    # 1. Round delay and period to whole microseconds, and compare the resulting axis with that of the frames.
    step = (range_m[-1] - range_m[0]) / (bins - 1) if bins > 1 else speed * 1e-6
    period, delay = step * 2e6 / speed, range_m[0] * 2e6 / speed
    whole = max(1, round(period))
    axis = (round(delay) + np.arange(bins) * whole) * speed * 5e-7
    if np.abs(axis - range_m).max() < MAX_AXIS_ERROR * step:
        window = ArisWindow(round(delay), whole, bins, speed, exact=True)
    else:
        # 2. If they differ, shorten the period, so that interpolation loses no resolution, and cover the same window.
        finer = max(1, int(period + 1e-6))
        samples = int((range_m[-1] * 2e6 / speed - round(delay)) / finer + 1e-6) + 1
        window = ArisWindow(round(delay), finer, samples, speed, exact=False)
    if not 0 < window.samples <= MAX_SAMPLES or window.delay_us >= 1e8 or window.period_us >= 1e6:
        raise MitsonarError(
            f"an ARIS file holds up to {MAX_SAMPLES:,} samples per beam: the frames' {bins:,} bins from {range_m[0]:.4g} "
            f"to {range_m[-1]:.4g} m take {window.samples:,}; write a shorter window"
        )
    return window


# ---------------- Writer


FILE = layout(
    {
        "signature": (0, "S4"), "frames": (4, "<u4"), "high_frequency": (12, "<u4"), "beams": (16, "<u4"),
        "samples": (24, "<u4"), "window_start_m": (32, "<f4"), "window_length_m": (36, "<f4"), "size": (424, "<u8"),
        "large_lens": (452, "<u4"),
    },
    1024,
)  # fmt: skip
"""Fields of the file header that are filled in: offset [bytes] and type."""

MODES = {48: 1, 96: 3, 64: 6, 128: 9}
"""Ping mode that is written for each number of beams."""

SALINITIES = (0, 15, 35)
"""Salinities that a header may hold [parts per thousand]: fresh, brackish and sea water."""

ORIGIN_DEG = (0.0, -30.0)
"""Default latitude and longitude of x = y = 0 [deg]: in the open Atlantic, on the equator."""

MAX_TIME_S = 2.0**53 / 1e6
"""Latest time that a float represents exactly in whole microseconds [s]."""


class WrittenAris(NamedTuple):
    """Report of a written file: its path, its number of frames, and sentences on what had to be changed."""

    path: Path
    frames: int
    notes: tuple[str, ...]


def write_aris(
    path: str | Path,
    frames: SonarFrames | Iterable[SonarFrames],
    *,
    beams: int | None = None,
    origin_deg: tuple[float, float] = ORIGIN_DEG,
) -> WrittenAris:
    """Write frames as an ARIS file, which is either complete or absent.

    Values become 0..255 over 80 dB below full scale. 8-bit values in that coding are preserved exactly; others are converted
    from their levels. An ARIS file holds no bearings: beams are those of the nearest table of the vendor. Ranges consist of
    a delay and a period in whole microseconds; frames with other ranges are interpolated along range. Attitude is written to
    the fields of the compass. The path, if poses are known, is written to the fields of the GPS receiver and of the depth.
    On reading, a compass with nothing but zeros counts as missing.

    Args:
        path: path of the file; it must end in ``.aris`` and must not exist.
        frames: all frames, or chunks of them in order of time, of one geometry.
        beams: number of beams to interpolate to, 48, 64, 96 or 128; default: that of the frames, which must fit a table.
        origin_deg: latitude and longitude of x = y = 0 [deg].

    Raises:
        MitsonarError: if the file exists, there are no frames, or the format cannot hold their beams, ranges or times.
    """
    path = Path(path)
    if path.suffix.lower() != ".aris":
        raise MitsonarError(f"an ARIS file ends in .aris: got {path}; rename it")
    if path.exists():
        raise MitsonarError(f"{path} exists: give another name, or remove it first")
    if not path.parent.is_dir():
        raise MitsonarError(f"there is no folder {path.parent}: create it first")
    part = path.with_name(f".{path.name}.part")
    chunks = _chunks(frames) if isinstance(frames, SonarFrames) else frames
    try:
        with part.open("wb") as file:
            writer = _Writer(file, beams, origin_deg)
            for chunk in chunks:
                writer.add(chunk)
            writer.finish()
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise MitsonarError(f"cannot write {path}: {error.strerror or error}") from None
    finally:
        part.unlink(missing_ok=True)
    return WrittenAris(path, writer.count, tuple(writer.notes()))


def _chunks(frames: SonarFrames) -> Iterator[SonarFrames]:
    """Yield frames in chunks of about ``CHUNK_BYTES``."""
    count = max(1, CHUNK_BYTES // max(1, 4 * frames.image[:1].size))
    for start in range(0, len(frames), count):
        yield frames.select(slice(start, start + count))


class _Writer:
    """Incremental writer of frames; the first chunk determines the form of the file."""

    def __init__(self, file: IO[bytes], beams: int | None, origin_deg: tuple[float, float]) -> None:
        self.file, self.beams, self.origin_deg = file, beams, origin_deg
        self.count, self.last_us, self.echoes, self.lost = 0, -1, 0, 0
        self.form: _Form | None = None
        self.first_latitude = origin_deg[0]

    def add(self, frames: SonarFrames) -> None:
        """Append frames to the file."""
        if not len(frames):
            return
        if self.form is None:
            self.form = _form_of(frames, self.beams)
            self.file.write(bytes(FILE.itemsize))
        elif not self.form.fits(frames):
            raise MitsonarError(
                "all frames of an ARIS file have one geometry: write each part of the recording to its own file"
            )
        time_us = self._times(frames)
        codes = self.form.image(self._codes(frames))
        heads = self.form.headers(frames, time_us, self.count)
        self._fill_positions(heads, frames)
        for head, image in zip(heads, codes, strict=True):
            self.file.write(head.tobytes())
            self.file.write(image[:, ::-1].tobytes())  # beam 0 is the one farthest to starboard
        self.count += len(frames)

    def finish(self) -> None:
        """Write the file header, which requires the final number of frames."""
        if self.form is None:
            raise MitsonarError("there are no frames to write")
        head = np.zeros(1, FILE)
        window, table = self.form.window, self.form.table
        fields = {
            "signature": SIGNATURE, "frames": self.count, "high_frequency": table.high, "beams": table.beams,
            "samples": window.samples, "window_start_m": window.start_m, "size": self.file.tell(),
            "window_length_m": window.samples * window.step_m, "large_lens": table.lens,
        }  # fmt: skip
        for name, value in fields.items():
            head[name] = value
        self.file.seek(0)
        self.file.write(head.tobytes())

    def notes(self) -> list[str]:
        """Return sentences on what had to be changed."""
        notes = list(self.form.notes) if self.form else []
        if self.lost:
            share = 100 * self.lost / self.echoes
            notes.append(f"{share:.2g} % of the echoes lie {CODING_DB:g} dB or more below full scale: they become 0")
        return notes

    def _times(self, frames: SonarFrames) -> NDArray[np.int64]:
        """Return the times of frames ``(n,)`` in whole microseconds."""
        time_s = frames.time_s.mean(axis=1) if frames.time_s.ndim == 2 else frames.time_s
        if not (np.isfinite(time_s).all() and (time_s >= 0).all() and (time_s < MAX_TIME_S).all()):
            raise MitsonarError("times of an ARIS file must be seconds since 1970, from 0: the frames have other times")
        time_us = np.rint(time_s * 1e6).astype(np.int64)
        if time_us[0] <= self.last_us or (np.diff(time_us) <= 0).any():
            raise MitsonarError("times of frames must increase by at least a microsecond: sort the frames by their times")
        self.last_us = int(time_us[-1])
        return time_us

    def _codes(self, frames: SonarFrames) -> Values:
        """Return values 0..255 over 80 dB ``(n, bins, beams)``: unchanged if they have that coding, or from their levels."""
        if frames.level == "dB" and frames.sonar.coding_db == CODING_DB:
            return frames.image if frames.image.dtype == np.uint8 else np.clip(frames.image, 0, 1) * np.float32(255)
        level = frames.to_linear().image
        with np.errstate(divide="ignore"):
            codes = (1 + np.log10(level) * np.float32(10 / CODING_DB)) * np.float32(255)
        has_echo = frames.image > 0
        self.echoes += int(np.count_nonzero(has_echo))
        self.lost += int(np.count_nonzero(has_echo & (codes < 0.5)))
        return np.where(has_echo, np.clip(codes, 0, 255), np.float32(0))

    def _fill_positions(self, heads: Header, frames: SonarFrames) -> None:
        """Fill in latitude, longitude and depth if poses are known."""
        if frames.poses is None:
            return
        east, north, up = frames.poses[:, :3].T
        latitude = self.origin_deg[0] + np.degrees(north / EARTH_M)
        if not self.count:
            self.first_latitude = float(latitude[0])
        longitude = self.origin_deg[1] + np.degrees(east / (EARTH_M * np.cos(np.radians(self.first_latitude))))
        if not ((np.abs(latitude) < 90) & (np.abs(longitude) <= 180)).all():
            raise MitsonarError(
                f"the path leaves the earth from {argument('origin_deg')} {self.origin_deg}: give another origin, latitude "
                "in -90..90 and longitude in -180..180 deg"
            )
        heads["latitude_deg"], heads["longitude_deg"], heads["depth_m"] = latitude, longitude, -up


@dataclass(frozen=True)
class _Form:
    """Conversion of frames of one geometry to those of an ARIS file.

    Attributes:
        like: empty frames with the geometry.
        table: beam table of the file.
        window: range axis of the file.
        turned: whether images are interpolated over bearing.
        notes: sentences on what had to be changed.
    """

    like: SonarFrames
    table: ArisTable
    window: ArisWindow
    turned: bool
    notes: tuple[str, ...]

    def fits(self, frames: SonarFrames) -> bool:
        """Return whether frames have the same geometry."""
        same = (frames.range_m.shape, frames.bearing_rad.shape) == (self.like.range_m.shape, self.like.bearing_rad.shape)
        return (
            same
            and bool((frames.range_m == self.like.range_m).all() and (frames.bearing_rad == self.like.bearing_rad).all())
            and frames.sonar.sound_speed == self.like.sonar.sound_speed
        )

    def image(self, codes: Values) -> Bytes:
        """Return values ``(n, samples, beams)`` on the axes of the file, interpolated only along axes that differ."""
        if not self.window.exact:
            ranges_m = self.window.start_m + np.arange(self.window.samples, dtype=np.float64) * self.window.step_m
            codes = interpolated(codes, self.like.range_m, ranges_m, axis=1)
        if self.turned:
            codes = interpolated(codes, self.like.bearing_rad, self.table.bearings, axis=2)
        return np.rint(codes).astype(np.uint8)

    def headers(self, frames: SonarFrames, time_us: NDArray[np.int64], first: int) -> Header:
        """Return the headers of frames ``(n,)``."""
        sonar, window, table = frames.sonar, self.window, self.table
        heads = np.zeros(len(frames), FRAME)
        fields = {
            "index": first + np.arange(len(frames)), "time_us": time_us, "sonar_time_us": time_us, "signature": SIGNATURE,
            "window_start_m": window.start_m, "window_length_m": window.samples * window.step_m,
            "temperature_c": sonar.temperature_c, "ping_mode": MODES[table.beams], "high_frequency": table.high,
            "pulse_us": max(1, round(2e6 * sonar.resolution_m / sonar.sound_speed)), "sample_period_us": window.period_us,
            "transmits": 1, "frame_rate_hz": sonar.frame_rate_hz, "sound_speed": window.sound_speed,
            "samples": window.samples, "start_delay_us": window.delay_us, "large_lens": table.lens, "system": table.system,
            "reordered": 1, "salinity": min(SALINITIES, key=lambda one: abs(one - sonar.salinity_psu)),
        }  # fmt: skip
        if sonar.ping_groups == PINGS[MODES[table.beams]] and sonar.group_order == "interleaved_starboard":
            fields["cycle_us"] = round(1e6 * ping_interval_s(sonar))
        attitude = frames.attitude_rad if frames.attitude_rad is not None else frames.poses
        if attitude is not None:
            pitch, roll, heading = np.degrees(attitude[:, -3:]).T
            fields |= {"pitch_deg": -pitch, "roll_deg": roll, "heading_deg": heading % 360}
        if frames.height_m is not None:
            fields["altitude_m"] = np.nan_to_num(frames.height_m)
        for name, values in fields.items():
            heads[name] = values
        return heads


def _form_of(frames: SonarFrames, beams: int | None) -> _Form:
    """Choose the beam table and the range axis for frames.

    Raises:
        MitsonarError: if beams fit no table, or the format cannot hold the sound speed or the window.
    """
    if min(len(frames.range_m), len(frames.bearing_rad)) < 2:
        raise MitsonarError("frames of an ARIS file have at least 2 bins and 2 beams: give an image, not a profile")
    table, deviation = table_of(frames.bearing_rad, frames.sonar, beams)
    window = window_of(frames.range_m, frames.sonar.sound_speed)
    turned = deviation > half_spacing(frames.bearing_rad) or table.beams != len(frames.bearing_rad)
    notes = []
    if turned:
        low, high = np.degrees(table.bearings[[0, -1]])
        notes.append(
            f"{count_noun(len(frames.bearing_rad), 'beam')} interpolated to {table.beams}, from {low:.4g} to {high:.4g} deg"
        )
    elif deviation > np.radians(1e-3):
        notes.append(
            "the beams are those of the vendor's table: they differ from those of the frames by "
            f"{np.degrees(deviation):.2g} deg"
        )
    if not window.exact:
        step = float(np.diff(frames.range_m).mean()) if len(frames.range_m) > 1 else window.step_m
        notes.append(f"ranges were interpolated from steps of {step:.5g} m to {window.step_m:.5g} m: whole microseconds")
    return _Form(frames.select(slice(0)), table, window, turned, tuple(notes))
