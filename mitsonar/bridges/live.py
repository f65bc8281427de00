"""How a live sonar works: it renders a ping for the newest pose and publishes it, or plays a path while no pose arrives."""

from __future__ import annotations

import io
import math
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from threading import Event
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from mitsonar.acoustics.noise import NoiseModel
from mitsonar.errors import MitsonarError, did_you_mean, short_repr
from mitsonar.io.files import PlainValue, parse_json
from mitsonar.motion.pose import Pose, poses_from, vehicle_rotation
from mitsonar.motion.trajectory import CONVENTIONS, Trajectory
from mitsonar.plotting.fans import FanPictures
from mitsonar.records.frames import SonarFrames, to_uint8

__all__ = [
    "PROJECTED",
    "PROJECTED_TYPE",
    "FanEncoder",
    "LivePing",
    "LivePublisher",
    "Pinger",
    "PoseMailbox",
    "PoseRequest",
    "ReceivedPose",
    "live_pings",
    "parse_pose",
    "pose_from_ros",
    "pose_in_ros",
    "projected_image",
    "timing",
]


POLL_INTERVAL_S = 0.25
"""Longest wait for a pose before the loop checks again whether it should end [s]."""


@dataclass(frozen=True)
class LivePing:
    """One ping of a live sonar.

    Attributes:
        frames: one frame, with its pose.
        number: number of the ping since the start.
        time_ns: wall clock time when the pose arrived, or was taken from the path [ns].
        source: origin of the pose: ``client``, or ``path`` for the path that is played.
        request_id: value of ``id`` in the client's pose.
        dropped: number of poses that arrived since the previous ping and were not rendered.
        render_s: rendering time of the frame [s].
    """

    frames: SonarFrames
    number: int
    time_ns: int
    source: str
    request_id: PlainValue
    dropped: int
    render_s: float


class LivePublisher(Protocol):
    """Protocol of a publisher of pings, such as a Foxglove server or a ROS 2 node."""

    def publish(self, ping: LivePing) -> None:
        """Publish a ping to all subscribers."""

    def warn(self, message: str) -> None:
        """Send all subscribers a warning, for example about an invalid pose."""

    def close(self) -> None:
        """End all connections."""


class Pinger(Protocol):
    """Protocol of the simulator that the loop needs."""

    def step(self, pose: ArrayLike, *, noise: NoiseModel | None = None, seed: int = 0) -> SonarFrames:
        """Render the next ping."""


def live_pings(
    simulator: Pinger,
    mailbox: PoseMailbox,
    publisher: LivePublisher,
    path: Trajectory,
    *,
    rate_hz: float,
    noise: NoiseModel | None = None,
    seed: int = 0,
    quiet_s: float = 2.0,
    ends: Event | None = None,
) -> Iterator[LivePing]:
    """Render and publish pings until ``ends`` is set, and yield each one after it is published.

    The pose of a client is rendered at once. The path is played in a loop until the first pose arrives, and continues when
    no pose has arrived for ``quiet_s``. A path of a single pose gives one ping.

    Args:
        simulator: simulator of the scene and the sonar.
        mailbox: mailbox in which poses arrive.
        publisher: publisher of the pings.
        path: path to play while no pose arrives.
        rate_hz: rate of the pings along the path [Hz].
        noise: noise, a function of (seed, number of the ping, cell); default: none.
        seed: seed of the noise.
        quiet_s: time without a pose after which the path continues [s].
        ends: event that ends the loop between two pings; an exception within a ping would leave the renderer broken.

    Raises:
        MitsonarError: the rate or the time is not positive.
    """
    if not (rate_hz > 0 and quiet_s > 0):
        raise MitsonarError(f"rate_hz and quiet_s must be positive: got {rate_hz:g}, {quiet_s:g}")
    ends = Event() if ends is None else ends
    numbers, path_index, last_pose_s, due_s = count(), 0, -float("inf"), time.monotonic()
    while not ends.is_set():
        # 1. Wait for a pose. While the path plays, wait no longer than until its next ping is due.
        time_s = time.monotonic()
        playing = time_s - last_pose_s > quiet_s and (len(path) > 1 or path_index == 0)
        received, source = (
            mailbox.take(min(POLL_INTERVAL_S, max(0.0, due_s - time_s)) if playing else POLL_INTERVAL_S),
            "client",
        )
        if received is not None:
            last_pose_s = time.monotonic()
        elif playing and time.monotonic() >= due_s:
            pose = Pose.from_row(float(value) for value in path.poses[path_index % len(path)])  # the path plays in a loop
            received, source = ReceivedPose(PoseRequest(pose), time.time_ns(), 0), "path"
            path_index += 1
            due_s = max(due_s, time.monotonic() - 1 / rate_hz) + 1 / rate_hz  # at most one late ping is caught up
        else:
            continue
        # 2. Render the pose, and publish the ping. A pose that cannot be rendered gives a warning.
        start_s = time.perf_counter()
        try:
            frames = simulator.step(received.request.pose, noise=noise, seed=seed)
        except MitsonarError as error:
            publisher.warn(f"this pose cannot be rendered: {error}")
            continue
        render_s, request_id = time.perf_counter() - start_s, received.request.request_id
        ping = LivePing(frames, next(numbers), received.received_ns, source, request_id, received.dropped, render_s)
        publisher.publish(ping)
        yield ping


# ---------------- Messages with poses


POSE_KEYS = ("x", "y", "z", "pitch", "roll", "heading")
OTHER_KEYS = ("id", "header", "timestamp", "frame_id", "pose")

MAX_POSITION_M = 1e6
"""Largest coordinate of a pose [m]; beyond it single precision would round to decimetres."""

MAX_MESSAGE_BYTES = 2**16
"""Largest size of a message with a pose [bytes]."""

ROS_CONVENTION = CONVENTIONS["ros-enu"]


@dataclass(frozen=True)
class PoseRequest:
    """A pose requested by a client.

    Attributes:
        pose: pose of the sonar [m, rad].
        request_id: value of ``id`` in the client's message; the timing of the ping returns it.
    """

    pose: Pose
    request_id: PlainValue = None


def parse_pose(message: bytes) -> PoseRequest:
    """Parse a pose from JSON.

    There are two forms. ``{"x", "y", "z", "pitch", "roll", "heading"}`` follows mitsonar's conventions, in m and deg;
    missing keys are 0. ``{"pose": {"position": {"x", "y", "z"}, "orientation": {"x", "y", "z", "w"}}}``, as in
    ``foxglove.PoseInFrame`` and ``geometry_msgs/PoseStamped``, follows REP 103: x forward, y to port, z up.

    Raises:
        MitsonarError: the message is not JSON, a key is unknown or missing, a value is not a finite number, the quaternion
            has length 0, or the position lies beyond 1000 km.
    """
    # 1. Parse the JSON, and check its keys and its id.
    if len(message) > MAX_MESSAGE_BYTES:
        raise MitsonarError(f"a pose must have at most {MAX_MESSAGE_BYTES:,} bytes: got {len(message):,}")
    table = parse_json(message, "the pose")
    if not isinstance(table, dict):
        raise MitsonarError(
            f"a pose must be a JSON object with {', '.join(POSE_KEYS)} (m, deg), or with the key pose: "
            f"got {short_repr(table)}"
        )
    unknown = [key for key in table if key not in (*POSE_KEYS, *OTHER_KEYS)]
    if unknown:
        raise MitsonarError(
            f"a pose has no key {short_repr(unknown[0])}{did_you_mean(unknown[0], POSE_KEYS)}: "
            f"give {', '.join(POSE_KEYS)} in m and deg, or pose"
        )
    request_id = table.get("id")
    if not isinstance(request_id, int | float | str | None) or (
        isinstance(request_id, float) and not math.isfinite(request_id)
    ):
        raise MitsonarError(f"id of a pose must be a finite number or a string: got {short_repr(request_id)}")
    # 2. Read the form of REP 103.
    if "pose" in table:
        extra_keys = [key for key in POSE_KEYS if key in table]
        if extra_keys:
            raise MitsonarError(f"a pose has both pose and {extra_keys[0]}: give one of them")
        nested = _check_keys(table["pose"], "pose", ("position", "orientation"))
        position = _numbers(nested.get("position", {}), "position", ("x", "y", "z"))
        orientation = _numbers(nested.get("orientation", {"w": 1.0}), "orientation", ("x", "y", "z", "w"))
        return PoseRequest(pose_from_ros(position, orientation), request_id)
    # 3. Read the form of six numbers.
    if not any(key in table for key in POSE_KEYS):
        raise MitsonarError(f"a pose has none of the keys {', '.join(POSE_KEYS)} and pose: give numbers in m and deg")
    values = _numbers({key: table[key] for key in POSE_KEYS if key in table}, "pose", POSE_KEYS)
    return PoseRequest(_check_position(Pose.from_degrees(values)), request_id)


def pose_from_ros(position: ArrayLike, quaternion: ArrayLike) -> Pose:
    """Convert a pose from the conventions of REP 103 to mitsonar's.

    Args:
        position: x, y, z ``(3,)`` [m], z up.
        quaternion: x, y, z, w ``(4,)``, the rotation from (forward, port, up) to the world.

    Raises:
        MitsonarError: the quaternion has length 0, or the position lies beyond 1000 km.
    """
    rotation_xyzw = np.asarray(quaternion, dtype=float)
    length = float(np.linalg.norm(rotation_xyzw))
    if not 1e-6 < length < 1e6:
        raise MitsonarError(f"the orientation of a pose must be a quaternion of length 1: got length {length:g}")
    positions, rotations = ROS_CONVENTION.to_mitsonar(
        np.asarray(position, dtype=float).reshape(1, 3), Rotation.from_quat(rotation_xyzw[None] / length)
    )
    return _check_position(Pose(*(float(value) for value in poses_from(positions, rotations)[0])))


def pose_in_ros(pose: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Convert a pose ``(6,)`` [m, rad] to REP 103: position ``(3,)`` [m] and quaternion ``(4,)`` x, y, z, w."""
    table = np.atleast_2d(np.asarray(pose, dtype=float))
    position, rotation = ROS_CONVENTION.from_mitsonar(table[:, :3], vehicle_rotation(table))
    return position[0], rotation.as_quat(canonical=True)[0]


def _check_position(pose: Pose) -> Pose:
    """Return the pose, after checking that it is near enough to the origin to be rendered.

    Raises:
        MitsonarError: the pose is too far away.
    """
    if max(abs(value) for value in pose[:3]) > MAX_POSITION_M:
        raise MitsonarError(
            f"a pose must lie within {MAX_POSITION_M:g} m of the origin: got {', '.join(f'{v:g}' for v in pose[:3])}"
        )
    return pose


def _check_keys(value: PlainValue, name: str, keys: tuple[str, ...]) -> dict[str, PlainValue]:
    """Return a JSON object, after checking that it has known keys only.

    Raises:
        MitsonarError: the value is not an object, or has unknown keys.
    """
    if not isinstance(value, dict):
        raise MitsonarError(f"{name} must be an object with {', '.join(keys)}: got {short_repr(value)}")
    unknown = [key for key in value if key not in keys]
    if unknown:
        raise MitsonarError(f"{name} has no key {short_repr(unknown[0])}: allowed are {', '.join(keys)}")
    return value


def _numbers(value: PlainValue, name: str, keys: tuple[str, ...]) -> list[float]:
    """Return the numbers of a JSON object in the order of ``keys``; missing ones are 0.

    Raises:
        MitsonarError: a key is unknown, or a value is not a finite number.
    """
    table = _check_keys(value, name, keys)
    for key, number in table.items():
        fine = isinstance(number, int | float) and not isinstance(number, bool)
        if not fine or not math.isfinite(number):
            raise MitsonarError(f"{key} of {name} must be a finite number: got {short_repr(number)}")
    return [float(table.get(key, 0.0)) for key in keys]


# ---------------- Mailbox of poses


@dataclass(frozen=True)
class ReceivedPose:
    """A pose and the time of its arrival.

    Attributes:
        request: the requested pose.
        received_ns: wall clock time of its arrival [ns].
        dropped: number of earlier poses that it replaced before they were rendered.
    """

    request: PoseRequest
    received_ns: int
    dropped: int


class PoseMailbox:
    """A mailbox that contains only the newest pose: threads of a server put poses, and the loop takes them."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: ReceivedPose | None = None

    def put(self, request: PoseRequest) -> None:
        """Deliver a pose, and drop the one that is still waiting, if any."""
        with self._changed:
            waiting = self._newest
            dropped = 0 if waiting is None else waiting.dropped + 1
            self._newest = ReceivedPose(request, time.time_ns(), dropped)
            self._changed.notify_all()

    def take(self, wait_s: float) -> ReceivedPose | None:
        """Return the newest pose and empty the mailbox; return None if no pose arrives within ``wait_s`` [s]."""
        with self._changed:
            if self._newest is None and wait_s > 0:
                self._changed.wait(wait_s)
            taken, self._newest = self._newest, None
            return taken


# ---------------- Messages of a ping


PROJECTED_TYPE = "marine_acoustic_msgs/msg/ProjectedSonarImage"

PROJECTED = "\n".join(
    (
        "std_msgs/Header header",
        "marine_acoustic_msgs/PingInfo ping_info",
        "geometry_msgs/Vector3[] beam_directions",
        "float32[] ranges",
        "marine_acoustic_msgs/SonarImageData image",
        "=" * 80,
        "MSG: std_msgs/Header",
        "builtin_interfaces/Time stamp",
        "string frame_id",
        "=" * 80,
        "MSG: builtin_interfaces/Time",
        "int32 sec",
        "uint32 nanosec",
        "=" * 80,
        "MSG: marine_acoustic_msgs/PingInfo",
        "float32 frequency",
        "float32 sound_speed",
        "float32[] tx_beamwidths",
        "float32[] rx_beamwidths",
        "=" * 80,
        "MSG: geometry_msgs/Vector3",
        "float64 x",
        "float64 y",
        "float64 z",
        "=" * 80,
        "MSG: marine_acoustic_msgs/SonarImageData",
        "bool is_bigendian",
        "uint32 dtype",
        "uint32 beam_count",
        "uint8[] data",
        "",
    )
)
"""Definition of the message in the format of ROS 2, without constants and comments."""

UINT8 = 0


class FanEncoder:
    """An encoder of the frames of one sonar as JPEG pictures of the fan.

    A sparse matrix maps cells to pixels. The pictures equal those of :class:`FanPictures` to within one step of 255.

    Args:
        quality: quality of the JPEG, 1..95.
    """

    def __init__(self, quality: int = 85) -> None:
        self.quality = quality
        self._inside: NDArray[np.intp] | None = None

    def jpeg(self, frames: SonarFrames, index: int = 0) -> bytes:
        """Return the fan of one frame as a grey JPEG: forward up, starboard to the right, black outside the fan."""
        buffer = io.BytesIO()
        Image.fromarray(self.picture(frames, index)).save(buffer, format="JPEG", quality=self.quality)
        return buffer.getvalue()

    def picture(self, frames: SonarFrames, index: int = 0) -> NDArray[np.uint8]:
        """Return the fan of one frame ``(rows, columns)``, 0..255."""
        # The first frame sets up the matrix: each row has the four cells and weights of a pixel inside the fan.
        if self._inside is None:
            fan = FanPictures(frames).fan
            self._shape = fan.index.shape[1:]
            self._inside = np.flatnonzero(fan.weight.any(axis=0))
            cells = fan.index.reshape(4, -1)[:, self._inside].T
            weights = fan.weight.reshape(4, -1)[:, self._inside].T
            rows = np.arange(0, 4 * len(cells) + 1, 4)
            size = (len(cells), frames.image[0].size)
            self._matrix = csr_array((weights.ravel(), cells.ravel().astype(np.int32), rows), shape=size)
        image = frames.image[index]
        levels = image if image.dtype == np.uint8 else to_uint8(image)  # quantised in polar coordinates, as sonars send them
        picture = np.zeros(self._shape, np.uint8)
        picture.reshape(-1)[self._inside] = self._matrix @ levels.reshape(-1).astype(np.float32) + np.float32(0.5)
        return picture


def projected_image(frames: SonarFrames, time_ns: int, frame_id: str, index: int = 0) -> bytes:
    """Encode a frame as ``marine_acoustic_msgs/msg/ProjectedSonarImage`` in CDR, little-endian.

    Beam directions have the axes of the message: z forward, x up, y to starboard. Data are 8 bit, with all beams of the
    nearest range first.

    Args:
        frames: frames to encode from.
        time_ns: time of the ping [ns].
        frame_id: name of the sonar's coordinate frame.
        index: index of the frame.
    """
    sonar, image = frames.sonar, frames.image[index]
    bearing = np.asarray(frames.bearing_rad, dtype=float)
    directions = np.column_stack([np.zeros(len(bearing)), np.sin(bearing), np.cos(bearing)])
    writer = _Cdr()
    writer.pack("<iI", *divmod(time_ns, 10**9))
    writer.text(frame_id)
    writer.pack("<ff", sonar.frequency_hz or 0.0, sonar.sound_speed)
    writer.array(np.full(len(bearing), np.radians(sonar.elevation_fov_deg), np.float32))
    writer.array(np.full(len(bearing), sonar.beam_width_rad, np.float32))
    writer.array(directions, len(directions))
    writer.array(frames.range_m.astype(np.float32))
    writer.pack("<?", False)
    writer.pack("<II", UINT8, len(bearing))
    writer.array(np.ascontiguousarray(image if image.dtype == np.uint8 else to_uint8(image)))
    return bytes(writer.content)


def timing(ping: LivePing, published_ns: int | None = None) -> dict[str, PlainValue]:
    """Return the number, source, times and pose of a ping (m, deg) as a JSON object."""
    assert ping.frames.poses is not None
    pose = ping.frames.poses[0]
    angles = np.degrees(pose[3:])
    sent_ns = time.time_ns() if published_ns is None else published_ns
    return {
        "number": ping.number,
        "id": ping.request_id,
        "source": ping.source,
        "dropped": ping.dropped,
        "pose_ns": ping.time_ns,
        "published_ns": sent_ns,
        "render_ms": round(1e3 * ping.render_s, 3),
        "latency_ms": round((sent_ns - ping.time_ns) / 1e6, 3),
        "x": float(pose[0]),
        "y": float(pose[1]),
        "z": float(pose[2]),
        "pitch": float(angles[0]),
        "roll": float(angles[1]),
        "heading": float(angles[2]),
    }


class _Cdr:
    """Writer of the common data representation (CDR): values are aligned to their size, relative to the fifth byte."""

    def __init__(self) -> None:
        self.content = bytearray(b"\x00\x01\x00\x00")

    def align(self, size: int) -> None:
        self.content += bytes(-(len(self.content) - 4) % size)

    def pack(self, form: str, *values: float) -> None:
        """Append numbers, aligned to the size of the first."""
        self.align(struct.calcsize(form[:2]))
        self.content += struct.pack(form, *values)

    def text(self, text: str) -> None:
        encoded = text.encode() + b"\x00"
        self.pack("<I", len(encoded))
        self.content += encoded

    def array(self, values: NDArray[Any], length: int | None = None) -> None:
        """Append an array after its length, which is ``length`` if its elements are rows."""
        self.pack("<I", values.size if length is None else length)
        if values.size:
            self.align(values.itemsize)
            self.content += values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()
