"""How is a recording in a ROS bag read? ROS 1 (.bag) and ROS 2 (a folder, .db3 or .mcap), sonar images or pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, count_noun, suggest_names
from mitsonar.instruments.sonar import Sonar
from mitsonar.recordings.recording import ELEVATION_PATTERN, Facts, Part, Pixels, Recording, in_time_order, runs_of
from mitsonar.recordings.ros_echoes import read_ros_echoes
from mitsonar.recordings.ros_messages import (
    ECHOES,
    FANS,
    PROJECTED,
    RANGES,
    RAW,
    SONARS,
    WRITTEN,
    BagFile,
    Topic,
    frames_like,
    short,
)
from mitsonar.recordings.ros_pings import PingLayout, is_beam_major, samples_of
from mitsonar.recordings.ros_topics import TopicScan, motion_in, read_ros_pictures, with_motion
from mitsonar.records.frames import SonarFrames

__all__ = ["read_ros_bag", "sonar_topic"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Samples = NDArray[np.generic]

ELEVATION_DEG = 20.0
"""Elevation aperture if the bag holds none [deg]; that of an Oculus M750d, and of an M1200d at its low frequency."""

ORDER_FRAMES = 8
"""Maximum number of frames from which the order of samples is determined."""

MAX_DELAY_S = 86_400.0
"""Largest difference between the times of header and reception that is reported as a delay [s]."""


@np.errstate(over="ignore", invalid="ignore")
def read_ros_bag(path: str | Path, geometry: str | Path | None = None, topic: str | None = None) -> Recording:
    """Open the recording of a sonar in a ROS bag; pixels are read on demand.

    Times are those in the headers of the messages, or those of reception if the header times are all 0 or all equal. Values
    are assumed to be amplitudes. Poses are those of the bag if they are unambiguous
    (:mod:`mitsonar.recordings.ros_topics`). A file that mitsonar wrote contains its sonar and coding
    (:mod:`mitsonar.recordings.ros_messages`).

    Args:
        path: path of a ``.bag``, ``.mcap`` or ``.db3`` file, or of the folder of a ROS 2 bag.
        geometry: a geometry file, for topics of pictures; sonar images contain their geometry.
        topic: topic of the sonar or of the pictures; default: the only sonar topic, or with a geometry the only topic of
            pictures.

    Raises:
        MitsonarError: if the bag is damaged, has no sonar topic, or has several of which none is chosen.
    """
    # 1. Choose the topic, and scan its messages once.
    bag = BagFile(path)
    chosen = sonar_topic(bag, topic, FANS if geometry is not None else SONARS)
    if chosen.kind in FANS:
        return read_ros_pictures(bag, chosen, None if geometry is None else Path(geometry))
    if geometry is not None:
        raise MitsonarError(f"{path}: {chosen.name} contains its geometry: omit {geometry}")
    if chosen.kind in ECHOES:
        return read_ros_echoes(bag, chosen)
    scan = TopicScan(bag, chosen)
    scan.read()
    if not scan.layouts:
        raise MitsonarError(f"{path}: no message of {chosen.name} can be read: {scan.reason or 'there is none'}")
    # 2. Determine what all parts share: order of time, coding, poses, and the metadata of a file written by mitsonar.
    order, notes = in_time_order(scan.frame_times())
    notes = [*scan.notes(), *notes]
    coding = _coding(scan, order, notes)
    numbers = np.array(scan.numbers)[order]
    layout = scan.layouts[numbers[0]]
    times = scan.frame_times()[order]
    motion = motion_in(bag, layout.frame_id, layout.axes, times)
    written = _written_frames(scan, layout, coding)
    # 3. Make a part of each run of frames with the same layout.
    parts = []
    for number, run in runs_of(numbers.tolist()):
        layout = scan.layouts[int(str(number))]
        like, images = _empty_frames(layout, times[run], scan.topic.name), _Frames(scan, order[run], layout, coding)
        part = with_motion(Part(like, times[run], images), motion, run)
        if written is not None:
            like, span_db = written
            part = replace(part, like=like, images=part.images if span_db is None else _Levels(part.images, span_db))
        parts.append(part)
    if not all(one.elevation_rad for one in scan.layouts):
        notes.append(f"the bag does not state the elevation aperture: {ELEVATION_DEG:g} deg are assumed")
    facts = _facts(scan, order) | ({"poses": motion.origin} if motion.origin else {})
    format_name = f"ROS {1 if bag.is_ros1 else 2} bag, {short(chosen.kind)}"
    return Recording(str(path), format_name, tuple(parts), facts, (*notes, *motion.notes))


def sonar_topic(bag: BagFile, topic: str | None = None, kinds: Sequence[str] = SONARS) -> Topic:
    """Return the topic of the sonar: the one with the given name, or the only one of the given types.

    Args:
        bag: bag with the topics.
        topic: name of the topic; None selects the only one.
        kinds: message types among which the only topic is searched for.

    Raises:
        MitsonarError: if there is no such topic or there are several, or the type of the named one is not supported.
    """
    topics = bag.topics()
    readable = [one for one in topics if one.kind in (*SONARS, *FANS) and one.messages]
    if topic is not None:
        named = next((one for one in topics if one.name == topic), None)
        if named is None:
            raise MitsonarError(f"{bag.path} has no topic {topic!r}: {suggest_names(topic, [one.name for one in topics])}")
        if named not in readable:
            raise MitsonarError(
                f"{bag.path}: {topic} holds {count_noun(named.messages, 'message')} {short(named.kind)}; a sonar's "
                f"are {_type_names(*kinds)}"
            )
        return named
    candidates = [one for one in readable if one.kind in kinds]
    if len(candidates) > 1:
        raise MitsonarError(
            f"{bag.path} holds several sonars: choose one of the topics {', '.join(one.name for one in candidates)} "
            "(topic= in Python, --topic or --view on the command line)"
        )
    if not candidates:
        others = ", ".join(f"{one.name} ({short(one.kind)})" for one in topics[:8]) or "none"
        if any(one.kind in RANGES for one in topics):
            others += "; SonarRanges hold no image: `mitsonar recording convert` writes their points"
        more = "; pictures need a geometry file (--geometry)" if readable and not set(FANS) & set(kinds) else ""
        raise MitsonarError(f"{bag.path} holds no messages {_type_names(*kinds)}: its topics are {others}{more}")
    return candidates[0]


def _type_names(*kinds: str) -> str:
    """Return the names of types as part of a sentence."""
    return " or ".join(short(one) for one in kinds if not one.startswith(("acoustic_msgs", "ping360_sonar/")))


class Coding(NamedTuple):
    """Conversion of samples to pixels: whether those of a beam are contiguous, and the divisor of floats."""

    beam_major: bool
    scale: float


def _coding(scan: TopicScan, order: Index, notes: list[str]) -> Coding:
    """Return how samples are converted to pixels, and append sentences on it to ``notes``.

    Raises:
        MitsonarError: if samples are floats below 0.
    """
    if scan.low < 0:
        raise MitsonarError(
            f"{scan.bag.path}: {scan.topic.name} holds floats from {scan.low:.4g} to {scan.high:.4g}; the message "
            "does not state the reference of levels in dB: convert them to amplitudes of 0..1"
        )
    scale = scan.high if scan.high > 1 else 1.0
    if scale > 1:
        notes.append(f"samples are floats up to {scale:.6g}: they are divided by it")
    layout = scan.layouts[scan.numbers[int(order[0])]]
    if scan.topic.kind not in (*PROJECTED, *RAW):
        return Coding(False, scale)
    same_layout = order[np.array(scan.numbers)[order] == scan.numbers[int(order[0])]]
    sample = same_layout[np.unique(np.linspace(0, len(same_layout) - 1, ORDER_FRAMES).astype(int))]
    flat = [np.frombuffer(np.asarray(one.image.data, np.uint8).tobytes(), layout.dtype) for _, one in scan.frames(sample)]
    beam_major = is_beam_major(flat, len(layout.range_m), len(layout.bearing_rad))
    if beam_major:
        notes.append("samples are stored beam by beam, unlike those of drivers, according to their correlation")
    return Coding(beam_major, scale)


@dataclass(frozen=True)
class _Levels:
    """Function that reads images, and converts samples in dB over a dynamic range to linear levels."""

    samples: Callable[[Index], Pixels]
    span_db: float

    def __call__(self, index: Index) -> Pixels:
        """Return levels relative to full scale ``(n, bins, beams)`` float32; 0 for no echo."""
        level = 10 ** ((np.arange(256) / 255 - 1) * self.span_db / 10)
        level[0] = 0
        return np.asarray(level.astype(np.float32)[self.samples(index)], dtype=np.float32)


def _written_frames(scan: TopicScan, layout: PingLayout, coding: Coding) -> tuple[SonarFrames, float | None] | None:
    """Return empty frames with the geometry and coding that mitsonar wrote, and the dynamic range of samples [dB].

    The dynamic range is None if samples are the values of the images. The result is None if mitsonar did not write the bag,
    or if its record does not describe the images of this topic.
    """
    path = scan.bag.path
    if path.suffix != ".mcap" or scan.topic.name != WRITTEN or len(scan.layouts) > 1 or coding != Coding(False, 1.0):
        return None
    record = frames_like(path, np.dtype(np.uint8 if _is_uint8(layout) else np.float32))
    if record is None or record[0].image.shape[1:] != (len(layout.range_m), len(layout.bearing_rad)):
        return None
    like, span_db = record
    same_ranges = np.allclose(like.range_m, layout.range_m, rtol=1e-6)
    fits = same_ranges and np.allclose(like.bearing_rad, layout.bearing_rad, atol=1e-6)
    return (like, span_db if _is_uint8(layout) else None) if fits else None


@dataclass(frozen=True)
class _Frames:
    """Function that reads the images of a part."""

    scan: TopicScan
    places: Index
    layout: PingLayout
    coding: Coding

    @np.errstate(over="ignore", invalid="ignore")
    def __call__(self, index: Index) -> Pixels:
        """Return images ``(n, bins, beams)``, uint8 or float32, column 0 farthest to port."""
        message_index = self.places[index]
        shape = (len(index), len(self.layout.range_m), len(self.layout.bearing_rad))
        image = np.zeros(shape, np.uint8 if _is_uint8(self.layout) else np.float32)
        for place, message in self.scan.frames(message_index):
            try:
                raw = samples_of(message, self.scan.topic.kind, self.layout, beam_major=self.coding.beam_major)
            except ValueError as error:
                raise MitsonarError(
                    f"{self.scan.bag.path}: a message of {self.scan.topic.name} is damaged: {error}"
                ) from None
            image[message_index == place] = _to_pixels(raw, self.coding.scale)
        return image


def _is_uint8(layout: PingLayout) -> bool:
    return np.dtype(layout.dtype) == np.uint8


def _to_pixels(raw: Samples, scale: float) -> Pixels:
    """Convert samples to float32 in 0..1; uint8 samples are returned unchanged."""
    if raw.dtype == np.uint8:
        return raw
    if raw.dtype.kind == "f":
        known = np.nan_to_num(raw.astype(np.float32), nan=0, posinf=0, neginf=0)
        return known if scale == 1 else known / np.float32(scale)
    most = np.iinfo(np.dtype(raw.dtype.name)).max
    return np.asarray(np.maximum(raw, 0) / most, dtype=np.float32)


def _empty_frames(layout: PingLayout, time_s: Array, name: str) -> SonarFrames:
    """Return empty frames with the geometry of a part."""
    bins, beams = len(layout.range_m), len(layout.bearing_rad)
    steps = np.diff(layout.range_m) if bins > 1 else np.array([min(0.01, layout.range_m[0])])
    across = np.diff(layout.bearing_rad).mean() if beams > 1 else layout.beam_width_rad or math.radians(1)
    sonar = Sonar.create(
        name=name.strip("/").replace("/", "_") or "ros",
        azimuth_fov_deg=min(360.0, math.degrees(float(layout.bearing_rad[-1] - layout.bearing_rad[0] + across))),
        elevation_fov_deg=min(180.0, math.degrees(layout.elevation_rad) or ELEVATION_DEG),
        elevation_pattern=ELEVATION_PATTERN,
        beams=beams,
        range_min=max(0.0, float(layout.range_m[0] - steps[0] / 2)),
        range_max=float(layout.range_m[-1] + steps[-1] / 2),
        range_bins=bins,
        sound_speed=layout.sound_speed if 1000 < layout.sound_speed < 2000 else 1500.0,
        beam_width_deg=math.degrees(layout.beam_width_rad) or None,
        frequency_hz=layout.frequency_hz if 0 < layout.frequency_hz <= 1e8 else None,
        frame_rate_hz=_rate(time_s),
        coding="gamma",
        coding_gamma=layout.gamma,
    )
    return SonarFrames(
        image=np.zeros((0, bins, beams), np.uint8 if _is_uint8(layout) else np.float32),
        range_m=layout.range_m,
        bearing_rad=layout.bearing_rad,
        time_s=np.zeros(0),
        sonar=sonar,
        level="gamma",
    )


def _rate(time_s: Array) -> float:
    """Return the frame rate [Hz], computed from the times."""
    steps = np.diff(time_s)
    return float(np.clip(1 / np.median(steps), 1e-3, 1e6)) if len(steps) else 10.0


def _facts(scan: TopicScan, order: Index) -> Facts:
    """Return values that the bag holds, keyed by name."""
    first = scan.layouts[scan.numbers[int(order[0])]]
    facts: Facts = {
        "topic": scan.topic.name,
        "type": short(scan.topic.kind),
        "frame_id": first.frame_id,
        "samples": first.dtype,
    }
    if first.sound_speed:
        facts["sound_speed"] = first.sound_speed
    if first.frequency_hz:
        facts["frequency_hz"] = first.frequency_hz
    delay = np.array(scan.received, dtype=float)[order] * 1e-9 - scan.frame_times()[order]
    if np.abs(delay).max() < MAX_DELAY_S:
        facts["received_after_s"] = [round(float(delay.min()), 6), round(float(delay.max()), 6)]
    return facts
