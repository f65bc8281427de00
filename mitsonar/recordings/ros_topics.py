"""What do the topics of a ROS bag hold? Motion of the sonar in mitsonar's convention, sonar messages, and pictures."""

from __future__ import annotations

import hashlib
import math
import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from mitsonar.errors import MitsonarError, count_noun
from mitsonar.motion.pose import poses_from
from mitsonar.motion.trajectory import CONVENTIONS
from mitsonar.recordings.pictures import Grey, Pictures, geometry_for, recording_of, refuse_size
from mitsonar.recordings.recording import Part, Recording
from mitsonar.recordings.ros_messages import FANS, PROJECTED, RAW, BagFile, Message, Topic, short
from mitsonar.recordings.ros_pings import SONAR_AXES_IN_FLU, PingLayout, decode_image, parse_layout

__all__ = ["Motion", "TopicScan", "motion_in", "read_ros_pictures", "with_motion"]


Array = NDArray[np.float64]
Index = NDArray[np.intp]

TRANSFORMS = "tf2_msgs/msg/TFMessage"
OLD_TRANSFORMS = "tf/msg/tfMessage"
ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
RANGE = "sensor_msgs/msg/Range"
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")

MAX_LINKS = 32
"""Maximum number of transforms between a sonar and the world."""

MAX_EXTRAPOLATION_S = 0.25
"""Time before the first pose and after the last one for which that pose is held constant [s]."""

MAX_COORDINATE_M = 1e8
"""Largest plausible coordinate of a position [m]."""

NORM_TOLERANCE = 0.1
"""Tolerated deviation of the norm of a quaternion from 1."""

UNKNOWN_HEADING_RAD2 = (2 * math.pi) ** 2
"""Variance of an IMU's turn about the vertical from which the heading counts as unknown [rad^2]."""

MAX_GAP_S = 2.0
"""Longest time between two poses over which poses are interpolated [s]."""


@dataclass(frozen=True)
class Motion:
    """Motion of a sonar at the times of its frames, from other topics; None where these do not contain it.

    Attributes:
        poses: poses ``(frames, 6)`` [m, rad].
        attitude_rad: pitch, roll, heading measured by an IMU ``(frames, 3)`` [rad].
        height_m: height measured by an altimeter ``(frames,)`` [m]; nan where unknown.
        notes: sentences on what is assumed about the poses, or why there are none.
        origin: description of the topic or transforms of the poses, and of the world frame.
    """

    poses: Array | None = None
    attitude_rad: Array | None = None
    height_m: Array | None = None
    notes: tuple[str, ...] = ()
    origin: str = ""


@dataclass
class Link:
    """Transforms from one frame to its parent over time.

    Attributes:
        parent: name of the parent frame.
        topic: topic that contains the transforms.
        fixed: whether the transform is constant.
        numbers: time [s], position [m] and quaternion x, y, z, w of each transform, one after another.
    """

    parent: str
    topic: str
    fixed: bool = False
    numbers: array[float] = field(default_factory=lambda: array("d"))

    def interpolated(self, time_s: Array) -> tuple[Array, Rotation] | None:
        """Return positions ``(n, 3)`` [m] and rotations at the given times; None if the transforms do not cover them."""
        # 1. Drop implausible transforms, and sort the others by time without duplicates.
        table = np.array(self.numbers).reshape(-1, 8)
        table = table[np.isfinite(table).all(axis=1) & (np.abs(table[:, 1:4]) < MAX_COORDINATE_M).all(axis=1)]
        table = table[(np.abs(table[:, 4:]) < 2).all(axis=1)]
        table = table[np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1) < NORM_TOLERANCE]
        table = table[np.unique(table[:, 0], return_index=True)[1]]
        if not len(table):
            return None
        # 2. Use a fixed transform at all times. A single one that may change is not enough.
        if self.fixed or len(table) == 1:
            last = np.repeat(table[-1:], len(time_s), axis=0)
            return (last[:, 1:4], Rotation.from_quat(last[:, 4:])) if self.fixed else None
        # 3. Reject times that are too far outside the covered interval, or too far from a transform within it.
        known = table[:, 0]
        clamped_s = np.clip(time_s, known[0], known[-1])
        after = np.clip(np.searchsorted(known, clamped_s), 1, len(known) - 1)
        distance_s = np.minimum(clamped_s - known[after - 1], known[after] - clamped_s)
        if np.abs(clamped_s - time_s).max() > MAX_EXTRAPOLATION_S or (distance_s > MAX_GAP_S / 2).any():
            return None
        # 4. Interpolate positions linearly, and rotations on the sphere.
        place = np.column_stack([np.interp(clamped_s, known, axis) for axis in table[:, 1:4].T])
        return place, Slerp(known, Rotation.from_quat(table[:, 4:]))(clamped_s)


def motion_in(bag: BagFile, frame_id: str, axes: Array, time_s: Array) -> Motion:
    """Return the poses, attitudes and heights of a sonar from the other topics of its bag.

    Args:
        bag: bag with the topics.
        frame_id: coordinate frame of the sonar's messages.
        axes: starboard, forward and up of the sonar in that frame, as columns ``(3, 3)``.
        time_s: frame times ``(frames,)`` [s].

    Raises:
        MitsonarError: messages cannot be read, or lack fields of their type: their definition is in the bag.
    """
    topics = [one for one in bag.topics() if one.messages]
    try:
        others = _MotionSources(bag, topics, _transforms(bag, topics), _frame_name(frame_id), axes, time_s)
        return replace(others.poses(), attitude_rad=others.attitude(), height_m=others.heights())
    except MitsonarError:
        raise
    except (AttributeError, TypeError, ValueError) as error:
        raise MitsonarError(f"{bag.path}: the definition of a message is damaged or of another version: {error}") from None


def with_motion(part: Part, motion: Motion, places: Index) -> Part:
    """Return a part with the known motion of its frames, which have the indices ``places`` ``(n,)`` in ``motion``."""
    return replace(
        part,
        poses=part.poses if motion.poses is None else motion.poses[places],
        attitude_rad=part.attitude_rad if motion.attitude_rad is None else motion.attitude_rad[places],
        height_m=part.height_m if motion.height_m is None else motion.height_m[places],
    )


@dataclass(frozen=True)
class _MotionSources:
    """The topics of a bag and the request of :func:`motion_in`."""

    bag: BagFile
    topics: list[Topic]
    links: dict[str, Link]
    frame: str
    axes: Array
    time_s: Array

    def poses(self) -> Motion:
        """Return the poses of the sonar from transforms, or else from a topic of odometry or poses.

        Transforms (TF) from the sonar's frame to a world frame take precedence. Next comes the only topic of odometry. If no
        fixed transforms connect its child frame with the sonar's, it is assumed to be that of the sonar, which a note
        reports. Last comes the only topic of poses, which is assumed to be that of the sonar. Several topics of a kind are
        ambiguous: then there are no poses, and a note lists the topics.
        """
        chain = _chain(self.links, self.frame)
        if chain and any(not one.fixed for one in chain):
            return _compose(chain, self.axes, self.time_s, "the transforms")
        source, notes = _only_pose_topic(self.bag, self.topics)
        if source is None:
            return Motion(notes=notes)
        child, link = source
        mount = _fixed_links(self.links, self.frame, child) if child else None
        if mount is None:
            note = (
                f"poses of {link.topic} are assumed to be those of the sonar: no transform leads from them to {self.frame!r}"
            )
            notes = (*notes, note)
        moved = _compose([*(mount or []), link], self.axes, self.time_s, link.topic)
        return replace(moved, notes=notes if moved.poses is not None else moved.notes)

    def attitude(self) -> Array | None:
        """Return pitch, roll and heading of the sonar ``(frames, 3)`` [rad] measured by the only IMU; None without one.

        Fixed transforms must connect the sonar's frame with that of the IMU. Its orientation is relative to east, north, up
        (REP 145). A heading whose variance exceeds :data:`UNKNOWN_HEADING_RAD2` is nan.
        """
        imus = [one for one in self.topics if one.kind == IMU]
        if len(imus) != 1:
            return None
        child, link, unknown = "", Link("", imus[0].name), array("d")
        for _, raw in self.bag.messages(imus[0].name):
            message = self.bag.decode(raw, IMU)
            child = _frame_name(message.header.frame_id)
            if float(message.orientation_covariance[0]) != -1:
                link.numbers.extend((_seconds(message), 0.0, 0.0, 0.0, *_numbers(message.orientation)))
                unknown.extend((_seconds(message), float(message.orientation_covariance[8] > UNKNOWN_HEADING_RAD2)))
        mount = _fixed_links(self.links, self.frame, child)
        if mount is None:
            return None
        poses = _compose([*mount, link], self.axes, self.time_s, link.topic).poses
        if poses is None:
            return None
        table = np.array(unknown).reshape(-1, 2)
        table = table[np.argsort(table[:, 0], kind="stable")]
        poses[np.interp(self.time_s, *table.T) > 0, 5] = np.nan
        return poses[:, 3:]

    def heights(self) -> Array | None:
        """Return heights above the ground ``(frames,)`` [m] by the only altimeter; nan where unknown, None without one.

        A topic belongs to an altimeter if its type is ``sensor_msgs/Range`` and its name contains ``alti``.
        """
        altimeters = [one for one in self.topics if one.kind == RANGE and "alti" in one.name.lower()]
        if len(altimeters) != 1:
            return None
        numbers = array("d")
        for _, raw in self.bag.messages(altimeters[0].name):
            message = self.bag.decode(raw, RANGE)
            numbers.extend((_seconds(message), float(message.range)))
        if not numbers:
            return None
        # Interpolate linearly, but only near a measurement. Implausible measurements become nan, and so do heights that
        # are interpolated from them.
        table = np.array(numbers).reshape(-1, 2)
        table = table[np.argsort(table[:, 0], kind="stable")]
        after = np.clip(np.searchsorted(table[:, 0], self.time_s), 1, max(1, len(table) - 1))
        ends = np.stack([table[after - 1], table[np.minimum(after, len(table) - 1)]])
        near = np.abs(ends[:, :, 0] - self.time_s).min(axis=0) <= MAX_GAP_S / 2
        table[~np.isfinite(table[:, 1]) | (table[:, 1] <= 0) | (table[:, 1] > MAX_COORDINATE_M), 1] = np.nan
        height = np.where(near, np.interp(self.time_s, table[:, 0], table[:, 1]), np.nan)
        return height if np.isfinite(height).any() else None


def _compose(chain: Sequence[Link], axes: Array, times: Array, source: str) -> Motion:
    """Return the poses that result from a chain of links from the sonar to the world.

    A world frame whose name ends with ``ned`` is converted from north, east, down.
    """
    place, turn = np.zeros((len(times), 3)), Rotation.from_matrix(np.repeat(axes[None], len(times), axis=0))
    for link in chain:
        link_pose = link.interpolated(times)
        if link_pose is None:
            return Motion(notes=(f"poses are not used: {link.topic} does not cover the times of all frames",))
        place, turn = link_pose[0] + link_pose[1].apply(place), link_pose[1] * turn
    world = chain[-1].parent
    if world.lower().endswith("ned"):
        down = Rotation.from_matrix(CONVENTIONS["ned"].world)
        place, turn = down.apply(place), down * turn
    return Motion(poses_from(place, turn), origin=f"{source}, in the frame {world!r}")


def _only_pose_topic(bag: BagFile, topics: Sequence[Topic]) -> tuple[tuple[str, Link] | None, tuple[str, ...]]:
    """Return child frame and transforms of the only topic of odometry, or else of poses; or None and notes on why."""
    for kinds, what in (((ODOMETRY,), "odometry"), (POSES, "poses")):
        candidates = [one for one in topics if one.kind in kinds]
        if len(candidates) > 1:
            names = ", ".join(one.name for one in candidates)
            return None, (f"poses are not used: the bag holds several topics of {what} ({names})",)
        if candidates:
            return _read_poses(bag, candidates[0]), ()
    return None, ()


def _read_poses(bag: BagFile, topic: Topic) -> tuple[str, Link]:
    """Return the child frame (empty for poses) and the transforms of a topic of odometry or poses."""
    child, link = "", Link("", topic.name)
    for _, raw in bag.messages(topic.name):
        message = bag.decode(raw, topic.kind)
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        link.parent = _frame_name(message.header.frame_id)
        child = _frame_name(getattr(message, "child_frame_id", ""))
        link.numbers.extend((_seconds(message), *_numbers(pose.position), *_numbers(pose.orientation)))
    return child, link


def _transforms(bag: BagFile, topics: Sequence[Topic]) -> dict[str, Link]:
    """Return the transforms of the bag, keyed by child frame."""
    links: dict[str, Link] = {}
    for topic in topics:
        if topic.kind not in (TRANSFORMS, OLD_TRANSFORMS):
            continue
        fixed = topic.name.endswith("tf_static")
        for _, raw in bag.messages(topic.name):
            for one in bag.decode(raw, topic.kind).transforms:
                child, parent = _frame_name(one.child_frame_id), _frame_name(one.header.frame_id)
                link = links.setdefault(child, Link(parent, topic.name, fixed))
                if link.parent == parent:
                    transform = one.transform
                    link.numbers.extend((_seconds(one), *_numbers(transform.translation), *_numbers(transform.rotation)))
    return links


def _chain(links: dict[str, Link], frame: str) -> list[Link]:
    """Return the links from a frame up to its root; an empty list if they are cyclic or more than ``MAX_LINKS``."""
    chain: list[Link] = []
    while frame in links:
        chain.append(links[frame])
        frame = links[frame].parent
        if len(chain) > MAX_LINKS:
            return []
    return chain


def _fixed_links(links: dict[str, Link], frame: str, target: str) -> list[Link] | None:
    """Return the fixed links from a frame up to another frame; None if these do not connect the two."""
    if frame == target:
        return []
    names = list(_parents(links, frame))
    if target not in names:
        return None
    chain = _chain(links, frame)[: names.index(target) + 1]
    return chain if all(link.fixed for link in chain) else None


def _parents(links: dict[str, Link], frame: str) -> Iterator[str]:
    """Yield the ancestors of a frame, nearest first."""
    for link in _chain(links, frame):
        yield link.parent


def _frame_name(name: object) -> str:
    """Return the name of a frame without the leading slash that it may have in ROS 1."""
    return str(name).lstrip("/")


def _seconds(message: Message) -> float:
    """Return the time in a message's header [s]."""
    stamp = message.header.stamp
    return float((int(stamp.sec) * 10**9 + int(stamp.nanosec)) / 10**9)


def _numbers(vector: Message) -> tuple[float, ...]:
    """Return the components x, y, z, and w if present."""
    return tuple(float(getattr(vector, name)) for name in ("x", "y", "z", "w") if hasattr(vector, name))


# ---------------- Scan of a topic


STAMP = 12
"""Size of a message up to the end of its time stamp [bytes], which follows a counter (ROS 1) or encoding bytes (ROS 2)."""

MAX_READ_GAP = 8
"""Largest distance between two requested frames up to which those in between are read rather than skipped."""


@dataclass
class TopicScan:
    """Index of the messages of a topic, built in one pass; memory grows by some tens of bytes per message.

    Attributes:
        bag: bag with the topic.
        topic: topic of the sonar.
        received: time of reception of each readable message [ns].
        nth: index of each message among those received at the same time.
        stamps: time in the header of each message [s].
        numbers: index of the layout of each message.
        layouts: distinct layouts.
        lost: number of unreadable messages.
        reason: why the first of them is unreadable.
        low: smallest sample, if samples are floats.
        high: largest sample, if samples are floats.
        gaps: whether some float samples are not finite.
    """

    bag: BagFile
    topic: Topic
    received: list[int] = field(default_factory=list)
    nth: list[int] = field(default_factory=list)
    stamps: list[float] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    layouts: list[PingLayout] = field(default_factory=list)
    lost: int = 0
    reason: str = ""
    low: float = math.inf
    high: float = -math.inf
    gaps: bool = False

    def read(self) -> None:
        """Read all messages once; a message is not decoded if another one had the same bytes ahead of its samples."""
        known: dict[bytes, int] = {}
        heads: dict[int, int] = {}
        last, count = -1, 0
        for time, raw in self.bag.messages(self.topic.name):
            count = count + 1 if time == last else 0
            last = time
            try:
                number = self._number(raw, known, heads)
            except (MitsonarError, ValueError, TypeError, AttributeError) as error:
                self.lost, self.reason = self.lost + 1, self.reason or str(error)
                continue
            self.received.append(time)
            self.nth.append(count)
            self.stamps.append(_stamp(raw, self.bag.is_ros1))
            self.numbers.append(number)

    def _number(self, raw: bytes, known: dict[bytes, int], heads: dict[int, int]) -> int:
        """Return the index of a message's layout; 0 for pictures, which have none.

        Args:
            raw: bytes of the message.
            known: layout index by the digest of the bytes between time stamp and samples; is extended.
            heads: offset of the samples by size of the message [bytes]; is extended.
        """
        if self.topic.kind in FANS:
            return 0
        # 1. Look the layout up by the bytes ahead of the samples, which saves decoding the message.
        head = heads.get(len(raw))
        if head is not None:
            number = known.get(_digest(raw[STAMP:head]))
            if number is not None:
                layout = self.layouts[number]
                self._measure(raw[head : head + layout.cells * np.dtype(layout.dtype).itemsize], number)
                return number
        # 2. Decode the message, and find a compatible layout.
        message = self.bag.decode(raw, self.topic.kind)
        layout = parse_layout(message, self.topic.kind)
        number = next((index for index, one in enumerate(self.layouts) if one.is_compatible_with(layout)), len(self.layouts))
        if number == len(self.layouts):
            self.layouts.append(layout)
        # 3. Remember the bytes ahead of the samples for the messages that follow.
        if self.topic.kind in (*PROJECTED, *RAW):
            samples = np.asarray(message.image.data, np.uint8).tobytes()
            self._measure(samples, number)
            head = _offset_of_samples(raw, samples)
            if head is not None:
                heads[len(raw)] = head
                known[_digest(raw[STAMP:head])] = number
        return number

    def _measure(self, samples: bytes, number: int) -> None:
        """Update the minimum and maximum of float samples, and whether all are finite."""
        kind = np.dtype(self.layouts[number].dtype)
        if kind.kind == "f" and samples:
            values = np.frombuffer(samples, kind)
            finite = values[np.isfinite(values)]
            self.gaps |= len(finite) < len(values)
            if len(finite):
                self.low, self.high = min(self.low, float(finite.min())), max(self.high, float(finite.max()))

    def frame_times(self) -> Array:
        """Return the times of the frames ``(frames,)`` [s]: those of the headers, or of reception if headers have none."""
        if not self._is_stamped():
            return np.array(self.received, dtype=float) * 1e-9
        stamps = np.array(self.stamps)
        unset = (stamps < 0) | ((stamps == 0) & ((stamps == 0).sum() > 1))  # a simulation may begin at 0
        return np.where(unset, np.nan, stamps)

    def _is_stamped(self) -> bool:
        """Return whether the headers hold times."""
        return bool(np.any(self.stamps)) and (len(self.stamps) == 1 or np.ptp(self.stamps) > 0)

    def notes(self) -> list[str]:
        """Return sentences on what was left out or assumed."""
        notes = [] if not self.lost else [f"left out: {count_noun(self.lost, 'message')} that cannot be read: {self.reason}"]
        if not self._is_stamped():
            notes.append("the headers hold no times: times are those at which the messages were received")
        if self.gaps:
            notes.append("samples that are nan or inf are read as 0")
        return notes

    def frames(self, places: Index) -> Iterator[tuple[int, Message]]:
        """Read and decode the messages with the given indices; yield index and message in increasing order."""
        indices = np.unique(places)
        if not len(indices):
            return
        for run in np.split(indices, np.flatnonzero(np.diff(indices) > MAX_READ_GAP) + 1):
            index_by_message = {(self.received[place], self.nth[place]): int(place) for place in run}
            times = [time for time, _ in index_by_message]
            last, count = -1, 0
            for time, raw in self.bag.messages(self.topic.name, min(times), max(times) + 1):
                count = count + 1 if time == last else 0
                last = time
                if (time, count) in index_by_message:
                    yield index_by_message[time, count], self.bag.decode(raw, self.topic.kind)


def _stamp(raw: bytes, ros1: bool) -> float:
    """Return the time in the header at the beginning of a raw message [s]; 0 if the message is too short."""
    if len(raw) < STAMP:
        return 0.0
    order = "<" if ros1 or raw[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack(f"{order}{'I' if ros1 else 'i'}I", raw[4:STAMP])
    return float((seconds * 10**9 + nanoseconds) / 10**9)  # a single rounding, so that written times are restored exactly


def _offset_of_samples(raw: bytes, samples: bytes) -> int | None:
    """Return the offset of the samples at the end of a message; None if they are not there.

    Up to three bytes of padding may follow the samples.
    """
    for filled in range(4):
        head = len(raw) - len(samples) - filled
        if (
            head >= STAMP + 4
            and int.from_bytes(raw[head - 4 : head], "little") == len(samples)
            and raw[head : head + len(samples)] == samples
        ):
            return head
    return None


def _digest(head: bytes) -> bytes:
    return hashlib.blake2b(head, digest_size=16).digest()


# ---------------- Topics of pictures


def read_ros_pictures(bag: BagFile, topic: Topic, geometry: Path | None) -> Recording:
    """Open a topic of pictures; they are read on demand.

    Poses are those of the bag. The frame of the pictures is assumed to be forward, left, up (REP 103).

    Args:
        bag: bag with the topic.
        topic: topic of type ``sensor_msgs/Image`` or ``sensor_msgs/CompressedImage``.
        geometry: a geometry file; default: ``FILE.yaml`` or ``geometry.yaml`` next to the bag.

    Raises:
        MitsonarError: if there is no geometry or no readable picture, or the geometry does not fit the pictures.
    """
    picture_geometry, geometry_path = geometry_for(bag.path, geometry)
    scan = TopicScan(bag, topic)
    scan.read()
    if not scan.received:
        raise MitsonarError(f"{bag.path}: no message of {topic.name} can be read: {scan.reason or 'there is none'}")

    def read(place: int) -> Grey:
        (picture_message,) = (message for _, message in scan.frames(np.array([place])))
        try:
            picture = decode_image(picture_message)
        except ValueError as error:
            raise MitsonarError(f"{bag.path}: message {place:,} of {topic.name}: {error}") from None
        if picture.shape != shape:
            raise MitsonarError(
                f"{bag.path}: message {place:,} of {topic.name} has {picture.shape[1]:,} x {picture.shape[0]:,} pixels, the "
                f"first one {shape[1]:,} x {shape[0]:,}: split the bag where the size changes"
            )
        return picture

    (_, message) = next(scan.frames(np.array([0])))
    try:
        rows, columns = decode_image(message).shape
    except ValueError as error:
        raise MitsonarError(f"{bag.path}: the first message of {topic.name}: {error}") from None
    refuse_size(rows, columns, f"a message of {topic.name}")
    shape = (rows, columns)
    pictures = Pictures(
        bag.path,
        f"ROS {1 if bag.is_ros1 else 2} bag, {short(topic.kind)}",
        shape,
        tuple(str(place) for place in range(len(scan.received))),
        read,
        scan.frame_times(),
        facts={"topic": topic.name, "type": short(topic.kind), "frame_id": str(message.header.frame_id)},
        notes=tuple(scan.notes()),
    )
    return _with_poses(recording_of(pictures, picture_geometry, geometry_path), bag, str(message.header.frame_id))


def _with_poses(recording: Recording, bag: BagFile, frame_id: str) -> Recording:
    """Return the recording with the motion of the sonar from other topics of the bag."""
    part = recording.parts[0]
    motion = motion_in(bag, frame_id, SONAR_AXES_IN_FLU, part.time_s)
    part = with_motion(part, motion, np.arange(len(part)))
    facts = recording.facts | ({"poses": motion.origin} if motion.origin else {})
    return replace(recording, parts=(part,), facts=facts, notes=(*recording.notes, *motion.notes))
