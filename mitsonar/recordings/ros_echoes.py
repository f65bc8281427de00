"""How is a Ping360 in a ROS bag read? Its pings, ``SonarEcho``, become sweeps of the head."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.recordings.ping360 import SOUND_SPEED, scanning_frames
from mitsonar.recordings.recording import Part, Recording
from mitsonar.recordings.ros_messages import BagFile, Topic, short
from mitsonar.recordings.ros_pings import SONAR_AXES_IN_FLU
from mitsonar.recordings.ros_topics import Motion, TopicScan, motion_in, with_motion
from mitsonar.recordings.sweeps import ScanPings, Sweep, sweep_parts
from mitsonar.records.frames import SonarFrames

__all__ = ["read_ros_echoes"]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

MAX_ANGLE_RAD = 1e3
"""Largest plausible angle of a head [rad]."""


@dataclass(frozen=True)
class Window:
    """What the pings of a frame share: number of samples, range [m], carrier [kHz] and sound speed [m/s]."""

    samples: int
    range_m: int
    frequency_khz: int
    sound_speed: int


@dataclass
class EchoScan(TopicScan):
    """Index of the pings of a topic.

    Attributes:
        angles: angle of the head of each ping [rad].
        windows: window of each ping.
        frame_id: coordinate frame of the first ping.
    """

    angles: list[float] = field(default_factory=list)
    windows: list[Window] = field(default_factory=list)
    frame_id: str = ""

    def _number(self, raw: bytes, known: dict[bytes, int], heads: dict[int, int]) -> int:
        """Note the angle and window of a message.

        Raises:
            ValueError: the message is damaged.
        """
        message = self.bag.decode(raw, self.topic.kind)
        angle, count = float(message.angle), len(message.intensities)
        window = Window(count, int(message.range), int(message.transmit_frequency), int(message.speed_of_sound))
        if not (math.isfinite(angle) and abs(angle) < MAX_ANGLE_RAD and count > 1 and window.range_m > 0):
            raise ValueError("invalid angle, range or number of samples")
        self.frame_id = self.frame_id or str(message.header.frame_id)
        self.angles.append(angle)
        self.windows.append(window)
        return 0

    def samples(self, index: Index) -> NDArray[np.uint8]:
        """Return the samples of pings of one window ``(n, bins)``."""
        result = np.zeros((len(index), self.windows[int(index[0])].samples if len(index) else 0), np.uint8)
        for place, message in self.frames(index):
            result[index == place] = np.asarray(message.intensities, np.uint8)
        return result


@np.errstate(over="ignore", invalid="ignore")
def read_ros_echoes(bag: BagFile, topic: Topic) -> Recording:
    """Open the pings of a Ping360 in a ROS bag; pixels are read on demand.

    A frame is a sweep of the head (:func:`mitsonar.recordings.sweeps.sweep_parts`). Angles are positive to port and 0 is
    forward, as in the laser scans of the same driver. Sample i lies at (i + 1/2) of the range divided by the number of
    samples. Poses are those of the bag, interpolated at the time of each ping.

    Args:
        bag: bag with the topic.
        topic: topic of type ``SonarEcho``.

    Raises:
        MitsonarError: if no message can be read, or the head does not turn.
    """
    scan = EchoScan(bag, topic)
    scan.read()
    times = scan.frame_times() if scan.received else np.zeros(0)
    if not np.isfinite(times).any():
        raise MitsonarError(f"{bag.path}: no message of {topic.name} can be read: {scan.reason or 'there is none'}")
    known = np.flatnonzero(np.isfinite(times))
    times = np.interp(np.arange(len(times)), known, times[known])  # a header without a time lies between its neighbours
    pings = ScanPings(times, -np.array(scan.angles), scan.windows, scan.samples)

    def like(ping: int, bearing_rad: Array, interval_s: float) -> SonarFrames:
        window = scan.windows[ping]
        return scanning_frames(
            window.samples,
            window.range_m / window.samples,
            bearing_rad,
            interval_s,
            name=topic.name.strip("/").replace("/", "_") or "ping360",
            sound_speed=float(window.sound_speed) if 1000 < window.sound_speed < 2000 else SOUND_SPEED,
            frequency_hz=1e3 * window.frequency_khz or None,
        )

    try:
        parts, more = sweep_parts(pings, like)
    except MitsonarError as error:
        raise MitsonarError(f"{bag.path}: {topic.name}: {error}") from None
    every_time = np.concatenate([times, *(part.time_s for part in parts)])
    motion = motion_in(bag, scan.frame_id, SONAR_AXES_IN_FLU, every_time)
    notes = [*scan.notes(), *more, "the scale of the samples is not published: they are read as amplitudes", *motion.notes]
    facts = {"topic": topic.name, "type": short(topic.kind), "frame_id": scan.frame_id, "pings": len(times)}
    facts |= {"poses": motion.origin} if motion.origin else {}
    moved, first = [], len(times)
    for part in parts:
        moved.append(_with_motion(part, motion, first))
        first += len(part)
    return Recording(
        str(bag.path), f"ROS {1 if bag.is_ros1 else 2} bag, {short(topic.kind)}", tuple(moved), facts, tuple(notes)
    )


def _with_motion(part: Part, motion: Motion, first: int) -> Part:
    """Return a part with the poses of its beams and frames, and with attitudes and heights.

    Args:
        part: a part whose images are those of :class:`~mitsonar.recordings.sweeps.Sweep`.
        motion: motion at the times of all pings, followed by those of all frames.
        first: index of the first frame of the part in ``motion``.
    """
    sweep = part.images
    assert isinstance(sweep, Sweep)
    part = with_motion(part, motion, np.arange(first, first + len(part)))
    if motion.poses is None:
        return part
    # A beam that was not scanned takes the pose at the nearest ping of its sweep.
    nearest = np.empty_like(sweep.ping_of)
    for row, pings in zip(nearest, sweep.ping_of, strict=True):
        scanned = np.flatnonzero(pings >= 0)
        row[:] = pings[scanned[np.rint(np.interp(np.arange(len(pings)), scanned, np.arange(len(scanned)))).astype(np.intp)]]
    return replace(part, beam_poses=motion.poses[nearest])
