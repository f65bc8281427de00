"""How ROS sonar messages become images: geometry, coding and samples of projected and raw images and of ``OculusPing``."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitsonar.recordings.oculus import gamma_exponent
from mitsonar.recordings.ros_messages import DTYPES, PROJECTED, RAW, Message

__all__ = ["SONAR_AXES_IN_FLU", "PingLayout", "decode_image", "is_beam_major", "parse_layout", "samples_of"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Samples = NDArray[np.generic]

RED, GREEN, BLUE = 0.299, 0.587, 0.114
"""Luminance weights of the colours (ITU-R BT.601)."""

CHANNELS = {
    "mono8": (1.0,),
    "8UC1": (1.0,),
    "rgb8": (RED, GREEN, BLUE),
    "bgr8": (BLUE, GREEN, RED),
    "8UC3": (BLUE, GREEN, RED),
    "rgba8": (RED, GREEN, BLUE, 0.0),
    "bgra8": (BLUE, GREEN, RED, 0.0),
}
"""Channel weights of the supported encodings of ``sensor_msgs/Image``."""

RANGE_RTOL = 0.002
"""Relative tolerance for equal ranges; drift of the sound speed changes them slightly."""

BEARING_ATOL_RAD = 1e-4
"""Absolute tolerance for equal bearings [rad]."""

CENTIDEGREE = math.pi / 18_000
"""Unit of the bearings in Oculus messages [rad]."""

SONAR_AXES_IN_FLU: Array = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
"""Unit vectors to starboard, forward and up as columns, in the axes forward, left, up (REP 103)."""

MAX_DIRECTION = 1e6
"""Largest plausible component of a beam direction; drivers write unit vectors."""

MIN_CORRELATION_MARGIN = 0.05
"""Difference between two correlations above which they decide the order of the samples."""


@dataclass(frozen=True)
class PingLayout:
    """Geometry and coding of the image in a message, without its samples.

    Attributes:
        range_m: centres of the bins ``(bins,)`` [m].
        bearing_rad: bearings of the beam axes ``(beams,)`` [rad], increasing, starboard positive.
        order: columns of the message in order of bearing ``(beams,)``.
        dtype: NumPy name of the sample type.
        axes: unit vectors to starboard, forward and up as columns, in the axes of the message's frame ``(3, 3)``.
        frame_id: coordinate frame of the message.
        frequency_hz: carrier frequency [Hz]; 0 if unknown.
        sound_speed: sound speed [m/s]; 0 if unknown.
        elevation_rad: elevation aperture [rad]; 0 if unknown.
        beam_width_rad: beam width [rad]; 0 if unknown.
        gamma: exponent of the amplitude coding: value = amplitude^gamma.
    """

    range_m: Array
    bearing_rad: Array
    order: Index
    dtype: str
    axes: Array
    frame_id: str = ""
    frequency_hz: float = 0.0
    sound_speed: float = 0.0
    elevation_rad: float = 0.0
    beam_width_rad: float = 0.0
    gamma: float = 1.0

    @property
    def cells(self) -> int:
        """Return the number of samples."""
        return len(self.range_m) * len(self.bearing_rad)

    def is_compatible_with(self, other: PingLayout) -> bool:
        """Return whether frames of both layouts belong to the same part of a recording."""
        return (
            self.range_m.shape == other.range_m.shape
            and self.bearing_rad.shape == other.bearing_rad.shape
            and (self.dtype, self.frame_id, self.gamma) == (other.dtype, other.frame_id, other.gamma)
            and bool((self.order == other.order).all())
            and bool(np.allclose(self.range_m, other.range_m, rtol=RANGE_RTOL, atol=0))
            and bool(np.allclose(self.bearing_rad, other.bearing_rad, rtol=0, atol=BEARING_ATOL_RAD))
        )


def parse_layout(message: Message, kind: str) -> PingLayout:
    """Return the layout of a message.

    Args:
        message: decoded message.
        kind: type of the message.

    Raises:
        ValueError: the message is damaged: its sizes or numbers are inconsistent.
    """
    layout = _projected(message) if kind in PROJECTED else _raw(message) if kind in RAW else _oculus(message)
    rising = np.all(np.diff(layout.range_m) > 0) and np.all(np.diff(layout.bearing_rad) > 0)
    if not (layout.cells and rising and np.isfinite(layout.range_m).all() and layout.range_m[0] >= 0):
        raise ValueError("ranges or bearings are empty or not increasing")
    if kind in (*PROJECTED, *RAW) and len(message.image.data) != layout.cells * np.dtype(layout.dtype).itemsize:
        raise ValueError("the number of samples does not match ranges and beams")
    return layout


def samples_of(message: Message, kind: str, layout: PingLayout, *, beam_major: bool = False) -> Samples:
    """Return the samples of a message ``(bins, beams)`` in their stored type, column 0 farthest to port.

    Args:
        message: decoded message.
        kind: type of the message.
        layout: layout of the message, or a compatible one.
        beam_major: whether the samples of each beam are contiguous, instead of those of each range, as drivers write them.

    Raises:
        ValueError: the number of samples does not match the layout, or a picture cannot be decoded.
    """
    shape = (len(layout.range_m), len(layout.bearing_rad))
    if kind in (*PROJECTED, *RAW):
        flat = np.frombuffer(np.asarray(message.image.data, np.uint8).tobytes(), layout.dtype)
        if flat.size != layout.cells:
            raise ValueError("the number of samples does not match ranges and beams")
        image = flat.reshape(shape[::-1]).T if beam_major else flat.reshape(shape)
    else:
        image = decode_image(message.ping)
        if image.shape != shape:
            raise ValueError(f"the picture is {image.shape[0]} x {image.shape[1]}, not {shape[0]} x {shape[1]}")
    return image[:, layout.order]


def is_beam_major(flat: Sequence[Samples], bins: int, beams: int) -> bool:
    """Return whether the samples of each beam are contiguous, judging by the correlation of the samples.

    ``SonarImageData`` is defined as one beam after another. However, the drivers of Oculus sonars, and the simulators whose
    files were available, write one range after another. The number of samples is the same, but neighbouring cells are
    correlated: they are ``beams`` samples apart if written by range, and ``bins`` samples apart if written by beam. If the
    correlations do not decide, for instance because there are as many bins as beams, the order of the drivers is assumed.

    Args:
        flat: stored samples of several frames, each ``(bins * beams,)``.
        bins: number of ranges.
        beams: number of beams.
    """
    if bins == beams or min(bins, beams) < 2:
        return False
    by_range = np.mean([_correlation(one, beams) for one in flat])
    by_beam = np.mean([_correlation(one, bins) for one in flat])
    return bool(by_beam > by_range + MIN_CORRELATION_MARGIN)


def _correlation(values: Samples, lag: int) -> float:
    """Return the autocorrelation of values at a lag; 0 if they are constant."""
    known = np.nan_to_num(values.astype(np.float64), posinf=0, neginf=0)
    first, second = known[:-lag] - known[:-lag].mean(), known[lag:] - known[lag:].mean()
    power = math.sqrt(float(first @ first) * float(second @ second))
    return float(first @ second) / power if power > 0 else 0.0


def _projected(message: Message) -> PingLayout:
    """Return the layout of a ``ProjectedSonarImage``."""
    vectors = np.array([(one.x, one.y, one.z) for one in message.beam_directions], dtype=float).reshape(-1, 3)
    bearing, axes = _bearings(vectors)
    order = np.argsort(bearing, kind="stable")
    info = message.ping_info
    ranges: Array = np.asarray(message.ranges).astype(np.float64)
    return PingLayout(
        range_m=ranges,
        bearing_rad=bearing[order],
        order=order,
        dtype=_sample_type(message.image),
        axes=axes,
        frame_id=str(message.header.frame_id),
        frequency_hz=_positive_or_zero(info.frequency),
        sound_speed=_positive_or_zero(info.sound_speed),
        elevation_rad=_median_angle(info.tx_beamwidths),
        beam_width_rad=_median_angle(info.rx_beamwidths),
    )


def _sample_type(image: Message) -> str:
    """Return the NumPy name of the sample type of a ``SonarImageData``."""
    if int(image.dtype) not in DTYPES:
        raise ValueError(f"unknown sample type {image.dtype}")
    return (">" if image.is_bigendian else "<") + DTYPES[int(image.dtype)]


def _raw(message: Message) -> PingLayout:
    """Return the layout of a ``RawSonarImage``.

    Sample i has the two-way travel time (sample0 + i) / sample_rate. Receive angles are positive to starboard, as drivers
    write them. The message has no beam directions: the axes of its frame are assumed to be forward, left, up (REP 103).
    """
    angles: Array = np.asarray(message.rx_angles).astype(np.float64)
    if not len(angles) or not (np.abs(angles) <= math.pi).all():
        raise ValueError("receive angles are missing or beyond half a turn")
    order = np.argsort(angles, kind="stable")
    info, rate, count = message.ping_info, float(message.sample_rate), int(message.samples_per_beam)
    speed = _positive_or_zero(info.sound_speed)
    if not (0 < rate < 1e9 and 0 < count <= len(message.image.data) and speed):
        raise ValueError("invalid sample rate, number of samples or sound speed")
    return PingLayout(
        range_m=np.asarray((int(message.sample0) + np.arange(count)) * (speed / 2 / rate), dtype=np.float64),
        bearing_rad=angles[order],
        order=order,
        dtype=_sample_type(message.image),
        axes=SONAR_AXES_IN_FLU,
        frame_id=str(message.header.frame_id),
        frequency_hz=_positive_or_zero(info.frequency),
        sound_speed=speed,
        elevation_rad=_median_angle(info.tx_beamwidths),
        beam_width_rad=_median_angle(info.rx_beamwidths),
    )


def _bearings(vectors: Array) -> tuple[Array, Array]:
    """Return the bearings of beam directions ``(beams, 3)`` [rad], and starboard, forward and up in their axes as columns.

    Forward is the z axis, as the message definition states, or the x axis, as in Gazebo. The y axis points to port in both
    cases: this is what the Oculus driver (y = -sin) and Gazebo (REP 103) write, and what ``sonar_image_proc`` draws.
    """
    if not len(vectors) or not (np.abs(vectors) < MAX_DIRECTION).all() or not (np.abs(vectors).max(axis=1) > 0).all():
        raise ValueError("beam directions are missing, zero or not finite")
    forward = 0 if np.abs(vectors[:, 0]).mean() > np.abs(vectors[:, 2]).mean() else 2
    axis = np.eye(3)
    starboard = -axis[1]
    up = np.cross(starboard, axis[forward])
    return np.arctan2(-vectors[:, 1], vectors[:, forward]), np.column_stack([starboard, axis[forward], up])


def _oculus(message: Message) -> PingLayout:
    """Return the layout of an ``OculusPing``. The axes of its frame are assumed to be forward, left, up (REP 103)."""
    bearing = np.asarray(message.bearings, dtype=float) * CENTIDEGREE
    if len(bearing) != int(message.num_beams):
        raise ValueError("the number of bearings does not match that of beams")
    order = np.argsort(bearing, kind="stable")
    step, bins = float(message.range_resolution), int(message.num_ranges)
    if not (0 < step < 100 and 0 < bins < 2**16):
        raise ValueError("invalid range resolution or number of ranges")
    fire = message.fire_msg
    return PingLayout(
        range_m=np.asarray((np.arange(bins) + 0.5) * step, dtype=np.float64),
        bearing_rad=bearing[order],
        order=order,
        dtype="|u1",
        axes=SONAR_AXES_IN_FLU,
        frame_id=str(message.header.frame_id),
        frequency_hz=_positive_or_zero(getattr(message, "frequency", 0.0)),
        sound_speed=_positive_or_zero(getattr(message, "speed_of_sound", 0.0)) or _positive_or_zero(fire.speed_of_sound),
        gamma=gamma_exponent(int(fire.gamma)),
    )


@np.errstate(over="ignore", invalid="ignore")
def decode_image(picture: Message) -> NDArray[np.uint8]:
    """Return the grey values ``(rows, columns)`` of a ``sensor_msgs/Image`` or ``CompressedImage``.

    Raises:
        ValueError: the picture cannot be decoded, or the number of its samples does not match its size.
    """
    data = np.asarray(picture.data, np.uint8)
    if hasattr(picture, "format"):
        from PIL import Image

        try:
            with Image.open(io.BytesIO(data.tobytes())) as shown:
                return np.asarray(shown.convert("L"))
        except Exception as error:  # damaged pictures raise many kinds of errors
            raise ValueError(f"a picture cannot be decoded: {error}") from None
    rows, columns = int(picture.height), int(picture.width)
    if picture.encoding not in CHANNELS:
        raise ValueError(f"unsupported picture encoding {picture.encoding}: mitsonar reads {', '.join(CHANNELS)}")
    channels = len(CHANNELS[picture.encoding])
    width = columns * channels
    stride = int(picture.step) if int(picture.step) * rows == len(data) else width
    if stride < width or stride * rows != len(data):
        raise ValueError("the number of a picture's samples does not match its height and width")
    values = data.reshape(rows, stride)[:, :width].reshape(rows, columns, channels)
    return np.asarray(np.rint(values @ np.array(CHANNELS[picture.encoding])), dtype=np.uint8)


def _positive_or_zero(value: object) -> float:
    """Return a value as a float if it is finite and positive, otherwise 0."""
    number = float(value)  # type: ignore[arg-type]
    return number if math.isfinite(number) and number > 0 else 0.0


def _median_angle(values: object) -> float:
    """Return the median of the angles between 0 and 2 pi [rad]; 0 if there are none."""
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known) & (known > 0) & (known < 2 * math.pi)]
    return float(np.median(known)) if len(known) else 0.0
