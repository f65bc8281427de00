"""What does a sonar that measures ranges leave, without images? Points of each ping, and files of them.

Multibeam echosounders in ROS (``marine_acoustic_msgs/SonarRanges``, whose beams point anywhere) and 3-D sonars have no image
of range and bearing, so that their pings are no frames of a fan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.io.files import whole_file
from mitsonar.io.ply import ply_header
from mitsonar.io.runs import refuse_to_replace
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.recordings.recording import Facts, in_time_order
from mitsonar.recordings.ros_messages import RANGES, BagFile, Message, Topic, short
from mitsonar.recordings.ros_pings import SONAR_AXES_IN_FLU
from mitsonar.recordings.ros_topics import TopicScan, motion_in
from mitsonar.recordings.write_mcap import CloudEncoder, write_clouds

__all__ = ["FORMATS", "RangePing", "RangeRecording", "ranges_topic", "read_ros_ranges", "write_points"]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

FORMATS = (".ply", ".csv", ".mcap")
"""Endings of files of points."""

CHUNK_PINGS = 64
"""Pings that are read at a time."""

MOST_RANGE_M = 1e5
"""Farther ranges are damage."""


class RangePing(NamedTuple):
    """The points of one ping.

    Attributes:
        points: positions as starboard, forward, up of the sonar ``(n, 3)`` [m].
        intensity: strengths that the sonar states ``(n,)``; nan where it states none.
    """

    points: Array
    intensity: NDArray[np.float32]


@dataclass(frozen=True)
class RangeRecording:
    """A recording of a sonar that measures ranges.

    Attributes:
        name: name of the file.
        format: readable name of the format.
        time_s: times of the pings ``(pings,)``, increasing [s].
        points: number of points of each ping ``(pings,)``.
        read: function that yields the pings with the given indices, in their order.
        poses: poses of the sonar ``(pings, 6)`` [m, rad]; None if unknown.
        facts: header values, keyed by name.
        notes: sentences on what was left out or assumed.
    """

    name: str
    format: str
    time_s: Array
    points: Index
    read: Callable[[Index], Iterator[RangePing]]
    poses: Array | None = None
    facts: Facts = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of pings."""
        return len(self.time_s)

    def pings(self) -> Iterator[RangePing]:
        """Read all pings in order of time, some at a time.

        Raises:
            MitsonarError: if a ping is damaged.
        """
        for start in range(0, len(self), CHUNK_PINGS):
            yield from self.read(np.arange(start, min(start + CHUNK_PINGS, len(self))))

    def in_world(self, index: int, points: Array) -> Array:
        """Return points of a ping in the world ``(n, 3)`` [m]; without poses as they are: starboard, forward, up."""
        if self.poses is None:
            return points
        pose = self.poses[index]
        return np.asarray(pose[:3] + vehicle_rotation(pose[None]).apply(points), dtype=np.float64)


def write_points(
    recording: RangeRecording, path: str | Path, *, overwrite: bool = False, progress: Callable[[int], None] | None = None
) -> int:
    """Write all points as PLY, CSV or MCAP, and return their number; the file is complete or absent.

    PLY and CSV hold world coordinates if poses are known, else starboard, forward and up of the sonar. MCAP holds a
    ``PointCloud2`` a ping on ``/sonar/returns``, and the poses on ``/tf``. Unknown intensities are nan in CSV, else 0.

    Raises:
        MitsonarError: another suffix, no points, or a file that exists or cannot be written.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise MitsonarError(f"{path}: points are written as {', '.join(FORMATS)}: give one of these endings")
    refuse_to_replace(path, overwrite=overwrite)
    total, count = int(recording.points.sum()), 0
    if not total:
        raise MitsonarError(f"{recording.name} holds no valid range: there is nothing to write")
    if path.suffix == ".mcap":
        encoder = CloudEncoder(moving=recording.poses is not None)
        write_clouds(path, encoder, _clouds(recording, encoder, progress))
        return total
    with whole_file(path) as file:
        file.write(ply_header(PLY_ROW, total) if path.suffix == ".ply" else b"time_s,ping,x_m,y_m,z_m,intensity\n")
        for index, ping in enumerate(recording.pings()):
            xyz = recording.in_world(index, ping.points)
            if path.suffix == ".ply":
                file.write(_ply_rows(xyz, ping.intensity))
            else:
                head = np.broadcast_to([recording.time_s[index], index], (len(xyz), 2))
                rows = np.column_stack([head, xyz, ping.intensity])
                np.savetxt(file, rows, fmt=["%.9f", "%d", "%.6f", "%.6f", "%.6f", "%.6g"], delimiter=",")
            count += len(xyz)
            if progress is not None:
                progress(1)
    return count


PLY_ROW = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "<f4")])


def _ply_rows(xyz: Array, intensity: NDArray[np.float32]) -> bytes:
    rows = np.zeros(len(xyz), PLY_ROW)
    rows["x"], rows["y"], rows["z"] = xyz.T
    rows["intensity"] = np.nan_to_num(intensity)
    return rows.tobytes()


def _clouds(recording: RangeRecording, encoder: CloudEncoder, progress: Callable[[int], None] | None) -> Iterator[Any]:
    """Yield the encoded messages of all pings."""
    for index, ping in enumerate(recording.pings()):
        pose = None if recording.poses is None else recording.poses[index]
        yield from encoder.messages(float(recording.time_s[index]), ping.points, np.nan_to_num(ping.intensity), pose)
        if progress is not None:
            progress(1)


# ---------------- ``SonarRanges`` in ROS bags


def ranges_topic(bag: BagFile, topic: str | None) -> Topic | None:
    """Return the topic of ``SonarRanges`` with a name, or the only one; None if there is none.

    Raises:
        MitsonarError: if there are several, and none is chosen.
    """
    topics = [one for one in bag.topics() if one.kind in RANGES and one.messages and topic in (None, one.name)]
    if len(topics) > 1:
        raise MitsonarError(
            f"{bag.path} holds several sonars: choose one by --topic {', '.join(one.name for one in topics)}"
        )
    return topics[0] if topics else None


@dataclass
class _RangeScan(TopicScan):
    """Index of the pings of a topic.

    Attributes:
        points: number of valid ranges of each ping.
        beams: number of beams of each ping.
        delay_s: largest transmit delay of a beam [s].
        nearest: least range [m].
        farthest: largest range [m].
        info: coordinate frame, carrier [Hz] and sound speed [m/s] of the first ping.
    """

    points: list[int] = field(default_factory=list)
    beams: list[int] = field(default_factory=list)
    delay_s: float = 0.0
    nearest: float = np.inf
    farthest: float = 0.0
    info: tuple[str, float, float] = ("", 0.0, 0.0)

    def _number(self, raw: bytes, known: dict[bytes, int], heads: dict[int, int]) -> int:
        """Note what a message holds.

        Raises:
            ValueError: the message is damaged.
        """
        message = self.bag.decode(raw, self.topic.kind)
        ping = _ping(message)
        if not self.points:
            about = message.ping_info
            self.info = (str(message.header.frame_id), float(about.frequency), float(about.sound_speed))
        if len(ping.points):
            range_m = np.linalg.norm(ping.points, axis=1)
            self.nearest, self.farthest = min(self.nearest, range_m.min()), max(self.farthest, range_m.max())
        delays = np.asarray(message.transmit_delays, dtype=float)
        self.delay_s = max(self.delay_s, float(np.max(delays[np.isfinite(delays)], initial=0.0)))
        self.points.append(len(ping.points))
        self.beams.append(len(message.ranges))
        return 0


@np.errstate(over="ignore", invalid="ignore")
def _ping(message: Message) -> RangePing:
    """Return the valid ranges of a ``SonarRanges`` as points, in the axes forward, left, up of its frame.

    Beams with a flag, and ranges that are 0 or not finite, have none.

    Raises:
        ValueError: fields have different numbers of beams, or directions are damaged.
    """
    range_m = np.asarray(message.ranges).astype(np.float64)
    beams = len(range_m)
    vectors = np.array([(one.x, one.y, one.z) for one in message.beam_unit_vec], dtype=float).reshape(-1, 3)
    flags = np.array([one.flag for one in message.flags], dtype=int)
    intensity = np.asarray(message.intensities).astype(np.float32)
    if len(vectors) != beams or len(flags) not in (0, beams) or len(intensity) not in (0, beams):
        raise ValueError("ranges, directions, flags and intensities have different numbers of beams")
    length = np.linalg.norm(np.where(np.abs(vectors) < 1e6, vectors, np.nan), axis=1)
    valid = (range_m > 0) & (range_m < MOST_RANGE_M) & (length > 1e-6)
    if len(flags):
        valid &= flags == 0
    points = vectors[valid] * (range_m[valid] / length[valid])[:, None]
    strength = intensity[valid] if len(intensity) else np.full(int(valid.sum()), np.nan, np.float32)
    strength = np.where(np.isfinite(strength), strength, np.nan).astype(np.float32)
    return RangePing(points @ SONAR_AXES_IN_FLU, strength)


def read_ros_ranges(bag: BagFile, topic: Topic) -> RangeRecording:
    """Open a topic of ``SonarRanges``; points are read on demand.

    Poses are those of the bag, at the time of the header. The frame of the directions is taken as forward, left, up
    (REP 103); poses by transforms hold for any axes.

    Raises:
        MitsonarError: if no message can be read.
    """
    scan = _RangeScan(bag, topic)
    scan.read()
    order, notes = in_time_order(scan.frame_times(), what="ping") if scan.received else (np.zeros(0, np.intp), [])
    if not len(order):
        raise MitsonarError(f"{bag.path}: no message of {topic.name} can be read: {scan.reason or 'there is none'}")
    time_s = scan.frame_times()[order]
    frame, frequency_hz, sound_speed = scan.info
    motion = motion_in(bag, frame, SONAR_AXES_IN_FLU, time_s)
    if scan.delay_s > 0:
        notes.append(f"beams transmit up to {scan.delay_s:.4g} s after the time of the header: their motion is not removed")

    def read(index: Index) -> Iterator[RangePing]:
        places = order[index]
        pings = {place: _ping(message) for place, message in scan.frames(places)}
        for place in places:
            yield pings[int(place)]

    facts: Facts = {"topic": topic.name, "type": short(topic.kind), "frame_id": frame, "beams": max(scan.beams)}
    facts |= {"range_m": [float(scan.nearest), float(scan.farthest)]} if scan.farthest else {}
    known = {"frequency_hz": frequency_hz, "sound_speed": sound_speed}
    facts |= {name: value for name, value in known.items() if np.isfinite(value) and value > 0}
    facts |= {"poses": motion.origin} if motion.origin else {}
    bad = 1 - sum(scan.points) / max(1, sum(scan.beams))
    if bad > 0:
        notes.append(f"left out: {bad:.1%} of the beams, which are flagged or have no range")
    return RangeRecording(
        str(bag.path),
        f"ROS {1 if bag.is_ros1 else 2} bag, {short(topic.kind)}",
        time_s,
        np.array(scan.points, dtype=np.intp)[order],
        read,
        motion.poses,
        facts,
        (*scan.notes(), *notes, *motion.notes),
    )
