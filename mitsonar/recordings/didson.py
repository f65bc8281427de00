"""DIDSON files (``.ddf``, DDF 3 and 4) of Sound Metrics: frames, range axis by timing, beams of the lens.

Source: public readers of such files, Sound Metrics' MATLAB reader as they quote it, and what Echoview says of the format.
No real file was at hand: the reader was tested on files that its tests write by this description, not on a recording. The
authors of hydroformats (Apache-2.0) report that ten recordings of version 3 have headers of these sizes, this clock, and a
sound speed at this place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, counted
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import preset
from mitsonar.recordings.header_motion import MOTION, attitude_of, height_of, poses_of
from mitsonar.recordings.ping_file import Bytes, EqualFrames, Header, layout, mapped
from mitsonar.recordings.recording import Facts, Part, Recording, in_time_order, runs_of
from mitsonar.records.frames import SonarFrames

__all__ = ["FILE", "FRAME_HEADER", "SIGNATURES", "didson_bearings", "nominal_window", "read_didson"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SIGNATURES = {b"DDF\x03": 3, b"DDF\x04": 4}
"""First four bytes of a file and version."""

FILE = layout(
    {
        "signature": (0, "S4"), "frames": (4, "<u4"), "frame_rate_hz": (8, "<u4"), "high_frequency": (12, "<u4"),
        "beams": (16, "<u4"), "sample_rate_hz": (20, "<f4"), "samples": (24, "<u4"), "gain_db": (28, "<u4"),
        "start_code": (32, "<u4"), "length_code": (36, "<u4"), "reverse": (40, "<u4"), "serial": (44, "<u4"),
        "sound_speed": (384, "<u4"),
    },
    512,
)  # fmt: skip
"""Fields of the file's header: offset [bytes] and type."""

COMMON = MOTION | {
    "index": (0, "<u4"), "time_s": (4, "<u4"), "signature": (12, "S4"), "year": (20, "<u4"), "month": (24, "<u4"),
    "day": (28, "<u4"), "hour": (32, "<u4"), "minute": (36, "<u4"), "second": (40, "<u4"), "hundredth": (44, "<u4"),
    "start_code": (52, "<u4"), "length_code": (56, "<u4"), "gain_db": (68, "<u4"), "config": (192, "<u4"),
}  # fmt: skip

FRAME_HEADER = {3: layout(COMMON, 256), 4: layout(COMMON, 1024)}
"""Fields of a frame's header by version."""

FILE_HEADERS = {3: (512,), 4: (1024, 512)}
"""Sizes of the file's header [bytes] by version. Readers disagree on version 4: the frames' signature decides."""

CLASSIC, LONG_RANGE = 1, 2
"""Bits of a frame's configuration: classic windows instead of extended ones; DIDSON-LR instead of DIDSON-S."""

LAST_CLASSIC, LONG_RANGE_SERIAL = 18, 15
"""Serial numbers up to which windows are classic whatever the configuration says; the one of a long-range sonar."""

LENGTHS_M = {
    0: (1.25, 2.5, 5.0, 10.0, 20.0, 40.0),
    CLASSIC: (1.125, 2.25, 4.5, 9.0, 18.0, 36.0),
    LONG_RANGE: (2.5, 5.0, 10.0, 20.0, 40.0, 80.0),
    LONG_RANGE | CLASSIC: (2.25, 4.5, 9.0, 18.0, 36.0, 72.0),
}
"""Nominal lengths of windows [m] by configuration; code 0 is the first at high frequency, the third at low."""

STEPS_M = {0: 0.42, CLASSIC: 0.375}
"""Nominal step of the window's start [m] at high frequency, extended and classic; twice as much at low."""

MOST_START, MOST_LENGTH = 31, 3
"""Largest codes of a window's start and length."""

DELAY_S = {True: 0.512e-3, False: 0.572e-3}
"""Time of one step of the window's start [s] at high frequency, for serial numbers up to 18 and above; twice that at low."""

FREQUENCIES_HZ = {0: (1.1e6, 1.8e6), LONG_RANGE: (0.7e6, 1.2e6)}
"""Carriers at low and high frequency [Hz] (data sheets)."""

NOMINAL_SPEED = 1500.0
"""Sound speed where the file tells none [m/s]."""

LEAST_SPEED, MOST_SPEED = 1300, 1700
"""What is believed of a sound speed [m/s]."""

CODING_DB = 90.0
"""Span of the values 0..255 [dB]."""

DIFFERS = 0.1
"""Part of the nominal window by which the one by timing may differ without a note."""

CLOCK = {
    "year": (1970, 2200), "month": (1, 12), "day": (1, 31), "hour": (0, 23), "minute": (0, 59), "second": (0, 60),
    "hundredth": (0, 99),
}  # fmt: skip
"""Fields of the sonar's clock, and what is believed of them."""

LONGEST_TIE = 3.0
"""Frames of one time are spread over the time to the next, at most so many times that of the frame rate."""

MOST_SAMPLES = 65_536

LENS = {48: (1.0, 0.0015, 1.3351), 96: (1.012, 0.0030, 2.6829)}
"""Of the lens, by number of beams: beams from the axis = factor (cubic t^3 + linear t), t in degrees from the axis."""


def read_didson(path: str | Path) -> Recording:
    """Open a DIDSON recording; pixels are read on demand.

    The window of each frame follows from its own codes and from the timing: it begins at ``code * delay * c / 2``, and
    sample n lies at (n + 1/2) ``c / (2 sample rate)`` from there. The file's sample rate belongs to the window's length in
    its header; in frames of another length it changes in proportion. Without a sample rate the nominal lengths stand in.
    A note says where timing and nominal window differ. The sound speed is that of the file, or 1500 m/s.

    Values 0..255 stand for 0..90 dB. Beam 0 is the one most to starboard, where ``reverse`` is not 0 the one most to port.
    Attitude is that of the sonar's compass. Times are the sonar's clock, local time to 0.01 s; frames that share one are
    spread evenly up to the next.

    Raises:
        MitsonarError: no such file, another format, or no frame that can be read.
    """
    name = str(path)
    data = mapped(path, "a DIDSON file", FILE.itemsize)
    version = SIGNATURES.get(data[:4].tobytes())
    if version is None:
        raise MitsonarError(f"{name} is no DIDSON file: it begins with {data[:4].tobytes()!r}, not with DDF and 3 or 4")
    head = np.frombuffer(data[: FILE.itemsize].tobytes(), FILE)[0]
    frames = _frames_of(data, head, version, name)
    headers = frames.table()
    whole = (
        (headers["signature"] == data[:4].tobytes()) & (headers["start_code"] <= MOST_START) & (headers["length_code"] < 4)
    )
    notes = [f"left out: {counted(int((~whole).sum()), 'frame')} with a damaged header"] if not whole.all() else []
    notes += [f"the last {frames.left_over:,} bytes are no whole frame and are left out"] if frames.left_over else []
    time_s, timing = _times(headers, head)
    kept, sorting = in_time_order(np.where(whole, time_s, np.nan), headers["index"])
    windows = _Windows(head)
    parts = tuple(
        _part(frames, headers[kept[run]], kept[run], time_s[kept[run]], windows)
        for _, run in runs_of([windows.key(one) for one in headers[kept]])
    )
    notes = [*notes, *timing, *sorting, *windows.notes(headers[kept])]
    return Recording(name, f"DIDSON {version} (.ddf)", parts, _facts(head, headers[kept], windows), tuple(notes))


def _frames_of(data: Bytes, head: np.void, version: int, name: str) -> EqualFrames:
    """Return the frames, behind the header of the file whose size puts the signature into them."""
    beams, samples = int(head["beams"]), int(head["samples"])
    if beams not in LENS or not 0 < samples <= MOST_SAMPLES:
        raise MitsonarError(
            f"{name}: the file says {beams:,} beams and {samples:,} samples a beam; a DIDSON has 48 or 96 beams and 1 to "
            f"{MOST_SAMPLES:,} samples: the file is damaged"
        )
    for size in FILE_HEADERS[version]:
        if data[size + 12 : size + 16].tobytes() == data[:4].tobytes():
            frames = EqualFrames(data, size, FRAME_HEADER[version], beams * samples)
            if not len(frames):
                raise MitsonarError(f"{name} holds no whole frame: {len(data):,} bytes, and a frame takes {frames.stride:,}")
            return frames
    sizes = " or ".join(f"{size:,}" for size in FILE_HEADERS[version])
    raise MitsonarError(f"{name}: no frame begins behind a header of {sizes} bytes: the file is cut off or damaged")


def _times(headers: Header, head: np.void) -> tuple[Array, list[str]]:
    """Return the times of the frames ``(frames,)`` [s] by the sonar's clock; by the frame rate where that never ran."""
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
    note = f"the sonar's clock tells no times: frames follow each other at {rate:g} Hz, by their numbers"
    return headers["index"].astype(float) / rate, [note]


def _spread(time_s: Array, number: Index, period_s: float) -> tuple[Array, list[str]]:
    """Return times ``(frames,)`` [s] with frames of one time, but of rising numbers, spread up to the time of the next."""
    new = np.ones(len(time_s), dtype=bool)
    new[1:] = (np.diff(time_s) != 0) | (np.diff(number.astype(np.int64)) <= 0)
    if new.all():
        return time_s, []
    begin = np.flatnonzero(new)
    count = np.diff(begin, append=len(time_s))
    gap = np.append(np.diff(time_s[begin]), np.nan)
    gap = np.where((gap > 0) & (gap < LONGEST_TIE * period_s * count), gap, period_s * count)
    group = np.cumsum(new) - 1
    part = (np.arange(len(time_s)) - begin[group]) / count[group]
    note = f"{counted(int((~new).sum()), 'frame')} with the clock of the one before: spread evenly up to the next"
    return time_s + part * gap[group], [note]


@dataclass(frozen=True)
class _Windows:
    """How the windows of a file's frames follow from their codes."""

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
        return float(stated) if LEAST_SPEED <= stated <= MOST_SPEED else NOMINAL_SPEED

    def config(self, header: np.void) -> int:
        """Return the configuration of a frame, which old sonars do not tell."""
        told = int(header["config"]) & (CLASSIC | LONG_RANGE)
        told |= CLASSIC if self.old else 0
        return told | LONG_RANGE if int(self.head["serial"]) == LONG_RANGE_SERIAL else told

    def key(self, header: np.void) -> tuple[int, int, int]:
        """Return what the geometry of a frame follows from."""
        return int(header["start_code"]), int(header["length_code"]), self.config(header)

    def nominal(self, header: np.void) -> tuple[float, float]:
        """Return start and length of a frame's window by the tables [m]."""
        return nominal_window(*self.key(header), high=self.high)

    def timed(self, header: np.void) -> tuple[float, float]:
        """Return start and length of a frame's window by the timing [m]."""
        start, code, config = self.key(header)
        begin = start * DELAY_S[self.old] * (1 if self.high else 2) * self.sound_speed / 2
        rate, samples = float(self.head["sample_rate_hz"]), int(self.head["samples"])
        length = self.nominal(header)[1]
        if not (math.isfinite(rate) and 1e2 < rate < 1e8):
            return begin, length * self.sound_speed / NOMINAL_SPEED
        reference = int(self.head["length_code"])
        whole = nominal_window(0, reference if reference <= MOST_LENGTH else code, config, high=self.high)[1]
        return begin, samples * self.sound_speed / (2 * rate) * length / whole

    def notes(self, headers: Header) -> list[str]:
        """Return sentences on what is assumed, and on windows whose timing and tables differ."""
        notes = []
        if not LEAST_SPEED <= int(self.head["sound_speed"]) <= MOST_SPEED:
            notes.append(f"the file tells no sound speed: {NOMINAL_SPEED:g} m/s is taken")
        rate = float(self.head["sample_rate_hz"])
        if not (math.isfinite(rate) and 1e2 < rate < 1e8):
            notes.append("the file tells no sample rate: windows have their nominal lengths")
        for one in {self.key(header): header for header in headers}.values():
            (start, length), (expected, whole) = self.timed(one), self.nominal(one)
            if abs(start - expected) > DIFFERS * max(expected, 1.0) or abs(length - whole) > DIFFERS * whole:
                notes.append(
                    f"a window lies at {start:.3g} to {start + length:.3g} m by its timing, and nominally at "
                    f"{expected:.3g} to {expected + whole:.3g} m: the timing is taken"
                )
        return notes[:10]


def nominal_window(start: int, code: int, config: int, *, high: bool) -> tuple[float, float]:
    """Return start and length of a window by Sound Metrics' tables [m].

    Args:
        start: code of the window's start, 0 to 31.
        code: code of its length, 0 to 3.
        config: of the frame: 1 classic, 2 long range, or both, or 0.
        high: at high frequency.
    """
    begin = start * STEPS_M[config & CLASSIC] * (1 if high else 2)
    return begin, LENGTHS_M[config][code + (0 if high else 2)]


@cache
def didson_bearings(beams: int) -> Array:
    """Return the bearings of a DIDSON's beams ``(beams,)`` [rad], most to port first, starboard positive.

    They follow the empirical polynomial of the lens, without its even terms: these shift the fan by 0.4 deg, to a side that
    depends on how the reader that it comes from turns its images. Beams are not even: 0.37 deg apart in the middle and 0.22
    at the sides, of 96. Beam tables of the ARIS 1800, which has the same number of beams and field of view, show the same
    (0.35 and 0.21 deg), so that the polynomial was preferred to even beams of 0.3 deg.

    Args:
        beams: 48 or 96.
    """
    factor, cubic, linear = LENS[beams]
    angles = np.linspace(-20.0, 20.0, 40_001)
    degrees = np.interp(np.arange(beams) - (beams - 1) / 2, factor * (cubic * angles**3 + linear * angles), angles)
    return np.asarray(np.radians(degrees))


@dataclass(frozen=True)
class _Images:
    """The images of a part's frames."""

    frames: EqualFrames
    places: Index
    shape: tuple[int, int]
    flipped: bool

    def __call__(self, index: Index) -> Bytes:
        """Return ``(n, bins, beams)``, column 0 most to port."""
        raw = self.frames.read(self.places[index], self.shape)
        return raw[:, :, ::-1] if self.flipped else raw


def _part(frames: EqualFrames, headers: Header, places: Index, time_s: Array, windows: _Windows) -> Part:
    shape = (int(windows.head["samples"]), int(windows.head["beams"]))
    attitude = attitude_of(headers)
    return Part(
        like=_like(headers[0], windows, time_s),
        time_s=time_s,
        images=_Images(frames, places, shape, flipped=int(windows.head["reverse"]) == 0),
        poses=poses_of(headers, attitude),
        attitude_rad=attitude,
        height_m=height_of(headers),
        gain_db=headers["gain_db"].astype(float),
    )


def _like(header: np.void, windows: _Windows, time_s: Array) -> SonarFrames:
    """Return frames without images: the geometry of a part."""
    samples, beams = int(windows.head["samples"]), int(windows.head["beams"])
    start, length = windows.timed(header)
    bearings = didson_bearings(beams)
    far = windows.config(header) & LONG_RANGE
    seconds = float(time_s[-1] - time_s[0])
    sonar = Sonar.create(
        name="didson-lr" if far else "didson",
        azimuth_fov_deg=float(np.degrees(bearings[-1] - bearings[0])) * beams / (beams - 1),
        elevation_fov_deg=preset("didson300").elevation_fov_deg,
        beams=beams,
        range_min=start,
        range_max=start + length,
        range_bins=samples,
        sound_speed=windows.sound_speed,
        bearing="cone",
        frequency_hz=FREQUENCIES_HZ[far][windows.high],
        frame_rate_hz=min(1e6, (len(time_s) - 1) / seconds) if seconds > 0 else 10.0,
        coding="dB",
        coding_db=CODING_DB,
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
    """Return what the headers tell, by name."""
    if not len(headers):
        return {}
    names = ("high_frequency", "beams", "samples", "reverse", "serial")
    config = windows.config(headers[0])
    facts: Facts = {"system": "DIDSON-LR" if config & LONG_RANGE else "DIDSON-S"}
    facts |= {"windows": "classic" if config & CLASSIC else "extended"} | {name: int(head[name]) for name in names}
    facts |= {"gain_db": int(headers["gain_db"][0]), "sound_speed": windows.sound_speed}
    rate = float(head["sample_rate_hz"])
    return facts | ({"sample_rate_hz": rate} if math.isfinite(rate) else {})
