"""How are sonar frames written as an MCAP file? As ROS 2 messages, for Foxglove, RViz and ``ros2 bag play``."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from mitsonar.errors import MitsonarError, MitsonarWarning, missing_package_error
from mitsonar.geometry.fan import CartesianMap, cartesian_map
from mitsonar.instruments.sonar import frame_period_s
from mitsonar.instruments.views import directions
from mitsonar.io.files import whole_file
from mitsonar.io.runs import refuse_to_replace
from mitsonar.motion.pose import vehicle_rotation
from mitsonar.motion.trajectory import CONVENTIONS
from mitsonar.recordings.first_returns import BeamReturns, FirstReturns, beam_times, return_points
from mitsonar.recordings.ros_messages import PROJECTED, RECORD, WRITTEN, metadata_of, ros2_types
from mitsonar.records.frames import LABELS, PER_FRAME, SonarFrames, to_float32, to_uint8

if TYPE_CHECKING:
    from mcap.writer import Writer

__all__ = [
    "BODY",
    "SENSOR",
    "SPAN_DB",
    "TOPICS",
    "WORLD",
    "CloudEncoder",
    "Encoded",
    "FrameEncoder",
    "nanoseconds",
    "write_clouds",
    "write_mcap",
]


SPAN_DB = 80.0
"""Dynamic range below full scale that 8-bit samples of linear images cover [dB]; a step is 0.31 dB."""

CHUNK_BYTES = 4 * 2**20
"""Size of the chunks that are compressed separately [bytes]."""


def write_mcap(
    chunks: Iterable[SonarFrames],
    path: str | Path,
    *,
    picture: str = "jpeg",
    full: bool = False,
    labels: bool = False,
    returns: FirstReturns | None = None,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Write frames of one sonar as MCAP (profile ``ros2``, CDR, Zstandard chunks); the file is complete or absent.

    Topics are ``/sonar/image`` (``marine_acoustic_msgs/ProjectedSonarImage``) and ``/sonar/fan/compressed``
    (``sensor_msgs/CompressedImage``); with poses also ``/sonar/odometry`` (``nav_msgs/Odometry``) and ``/tf``, with
    attitudes ``/sonar/imu`` (``sensor_msgs/Imu``), with heights ``/sonar/altitude`` (``sensor_msgs/Range``). Times in
    headers are those of the frames.

    Samples have 8 bits. Values in the codings dB and gamma are multiplied by 255. Linear levels are stored in dB over
    :data:`~mitsonar.recordings.write_mcap.SPAN_DB`, which
    :func:`~mitsonar.recordings.open.open_recording` converts back to levels. A metadata record holds the sonar, exact ranges
    and bearings, the coding, and a description of how samples are converted to levels.

    Args:
        chunks: frames of one geometry in chunks; the first chunk determines which arrays all of them must have.
        path: path of the file; its name must end with ``.mcap``.
        picture: format of the fans: ``jpeg``, or ``png``, which is larger.
        full: whether to write samples exactly as they are, float32 or uint8, and labels.
        labels: whether to write ``/sonar/points`` (``sensor_msgs/PointCloud2``) of frames with elevations, which is about as
            large as all other topics together.
        returns: rule by which the first return of each beam is written as ``/sonar/scan`` (``sensor_msgs/LaserScan``, if
            the beams are evenly spaced) and ``/sonar/returns`` (``sensor_msgs/PointCloud2``); default: none is written.
        overwrite: whether to replace an existing file.
        progress: function that is called with the number of newly written frames.

    Returns:
        The number of frames.

    Raises:
        MitsonarError: if the file exists, its name has another suffix, there are no frames, or ROS cannot represent their
            times.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        raise MitsonarError(f"{path} must end with .mcap: ROS recognises bags by their suffix")
    refuse_to_replace(path, overwrite=overwrite)
    span_db: list[float] = []
    tally = _Tally(returns)
    pairs = ((_reduced(frames, full, labels, span_db), tally.find(frames)) for frames in chunks)
    with whole_file(path) as file:
        writer = _writer(file)
        count = _write(writer, pairs, picture, span_db, progress or (lambda done: None))
        writer.finish()  # type: ignore[no-untyped-call]
    for note in tally.notes():
        warnings.warn(note, MitsonarWarning, stacklevel=2)
    return count


def write_clouds(path: Path, encoder: CloudEncoder, messages: Iterable[Encoded]) -> None:
    """Write encoded messages as MCAP (profile ``ros2``); the file is complete or absent.

    Raises:
        MitsonarError: if the file cannot be written.
    """
    with whole_file(path) as file:
        writer = _writer(file)
        writer.start(profile="ros2", library="mitsonar")
        channels = _channels(writer, encoder)
        for number, message in enumerate(messages):
            _add(writer, channels, message, number)
        writer.finish()  # type: ignore[no-untyped-call]


class _Tally:
    """First returns of all frames, counted for notes on the rule that finds them."""

    def __init__(self, rule: FirstReturns | None) -> None:
        self.rule, self.beams, self.returned, self.nearest = rule, 0, 0, 0

    def find(self, frames: SonarFrames) -> BeamReturns | None:
        if self.rule is None:
            return None
        returns = self.rule.find(frames)
        begin = frames.range_m[frames.range_m >= self.rule.from_m][:1]
        self.beams += returns.range_m.size
        self.returned += int(np.isfinite(returns.range_m).sum())
        self.nearest += int((returns.range_m == begin).sum()) if len(begin) else 0
        return returns

    def notes(self) -> list[str]:
        return [] if self.rule is None else self.rule.doubts(self.beams, self.returned, self.nearest)


def _writer(file: object) -> Writer:
    try:
        from mcap.writer import CompressionType, Writer
    except ModuleNotFoundError as error:
        raise missing_package_error(error) from None
    return Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)  # type: ignore[arg-type]


def _reduced(frames: SonarFrames, full: bool, labels: bool, span_db: list[float]) -> SonarFrames:
    """Return frames with the samples and arrays that are written; ``span_db`` is set if linear levels become dB."""
    if full:
        return frames
    if not labels:
        nothing: dict[str, Any] = dict.fromkeys(LABELS)
        frames = replace(frames, **nothing)
    if frames.image.dtype == np.uint8:
        return frames
    if frames.level != "linear":
        return replace(frames, image=to_uint8(frames.image))
    span_db[:] = [SPAN_DB]
    with np.errstate(divide="ignore"):
        value = 1 + np.log10(np.clip(frames.image, 0, 1)) * np.float32(10 / SPAN_DB)
    return replace(frames, image=to_uint8(np.where(frames.image > 0, np.maximum(value, np.float32(1e-6)), np.float32(0))))


Chunk: TypeAlias = tuple[SonarFrames, BeamReturns | None]
"""Frames as they are written, and the first returns of the original frames."""


def _write(
    writer: Writer, chunks: Iterator[Chunk], picture: str, span_db: list[float], progress: Callable[[int], None]
) -> int:
    """Write all frames, and return their number."""
    chunk = next((one for one in chunks if len(one[0])), None)
    if chunk is None:
        raise MitsonarError("there are no frames to write")
    first, returns = chunk
    encoder = FrameEncoder(first.select(slice(0)), picture, returns=returns is not None)
    writer.start(profile="ros2", library="mitsonar")
    writer.add_metadata(RECORD, metadata_of(first, span_db[0] if span_db else None))
    channels = _channels(writer, encoder)
    count, fixed = 0, False
    for frames, returns in _all(chunk, chunks):
        for message in encoder.messages(frames, returns):
            if not fixed:
                _add(writer, channels, encoder.fixed(message.time_ns), 0)
                fixed = True
            _add(writer, channels, message, count)
            if message.topic == WRITTEN:
                count += 1
                progress(1)
    return count


def _all(first: Chunk, rest: Iterator[Chunk]) -> Iterator[Chunk]:
    """Yield the first chunk and all others.

    Raises:
        MitsonarError: if frames have another geometry or other arrays.
    """
    yield first
    for one in rest:
        if one[0].image.shape[1:] != first[0].image.shape[1:] or _known(one[0]) != _known(first[0]):
            raise MitsonarError("all frames of an MCAP file must have one geometry and the same arrays: write two files")
        yield one


def _known(frames: SonarFrames) -> list[bool]:
    """Return which optional arrays frames have."""
    return [getattr(frames, name) is not None for name in PER_FRAME]


def _channels(writer: Writer, encoder: _RosEncoder) -> dict[str, int]:
    """Register types and topics, and return the channel number of each topic."""
    schemas: dict[str, int] = {}
    channels = {}
    for topic in encoder.topics:
        kind = TOPICS[topic]
        if kind not in schemas:
            schemas[kind] = writer.register_schema(kind, "ros2msg", encoder.definition(topic).encode())
        channels[topic] = writer.register_channel(topic, "cdr", schemas[kind], _quality(topic))
    return channels


def _quality(topic: str) -> dict[str, str]:
    """Return the metadata of a channel: fixed transforms are latched for late subscribers."""
    if topic != "/tf_static":
        return {}
    ever = "{sec: 9223372036, nsec: 854775807}"
    quality = f"{{history: 1, depth: 1, reliability: 1, durability: 1, deadline: {ever}, lifespan: {ever}, liveliness: 1, "
    return {
        "offered_qos_profiles": f"- {quality}liveliness_lease_duration: {ever}, avoid_ros_namespace_conventions: false}}"
    }


def _add(writer: Writer, channels: dict[str, int], message: Encoded, sequence: int) -> None:
    writer.add_message(channels[message.topic], message.time_ns, message.data, message.time_ns, sequence)


# ---------------- Encoding of frames as ROS 2 messages
# | frame | axes | parent |
# |---|---|---|
# | ``map`` | east, north, up (REP 103) | |
# | ``sonar_link`` | forward, left, up (REP 103) | ``map``, by the pose of the sonar |
# | ``sonar`` | down, left, forward, as drivers write ``ProjectedSonarImage`` | ``sonar_link``, fixed |


Array = NDArray[np.float64]

RosObject: TypeAlias = Any
"""An instance of a message type created by ``rosbags``."""

WORLD, BODY, SENSOR = "map", "sonar_link", "sonar"
"""Names of the coordinate frames."""

TOPICS = {
    WRITTEN: PROJECTED[0],
    "/sonar/fan/compressed": "sensor_msgs/msg/CompressedImage",
    "/sonar/points": "sensor_msgs/msg/PointCloud2",
    "/sonar/scan": "sensor_msgs/msg/LaserScan",
    "/sonar/returns": "sensor_msgs/msg/PointCloud2",
    "/sonar/odometry": "nav_msgs/msg/Odometry",
    "/sonar/imu": "sensor_msgs/msg/Imu",
    "/sonar/altitude": "sensor_msgs/msg/Range",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}
"""Topics that may be written, with their types."""

MAX_FAN_ROWS = 800
"""Maximum number of rows of a fan."""

PICTURES = {"png": ("PNG", {"compress_level": 3}), "jpeg": ("JPEG", {"quality": 92})}
"""Formats of fans: name and options in Pillow."""

UINT8, FLOAT32 = 0, 8
"""Codes of sample types in ``SonarImageData``."""

UNKNOWN_VARIANCE = 1e6
"""Variance of a heading that is not known [rad^2]."""

EVEN_RTOL = 1e-3
"""Relative tolerance for equal steps between beams, which a laser scan requires."""

POINT_TYPES = {np.dtype(np.float32): 7, np.dtype(np.int32): 5}
"""Codes of field types in ``PointField``."""


class Encoded(NamedTuple):
    """An encoded message: its topic, time [ns] and bytes."""

    topic: str
    time_ns: int
    data: bytes


class _RosEncoder:
    """Encoder of ROS 2 messages (CDR)."""

    topics: Sequence[str] = ()
    """Topics of the messages."""

    def __init__(self) -> None:
        self.types = ros2_types()

    def definition(self, topic: str) -> str:
        """Return the definition of a topic's message type, including those of its nested types."""
        return self.types.generate_msgdef(TOPICS[topic], ros_version=2)[0]

    def _encoded(self, topic: str, time: int, message: RosObject) -> Encoded:
        return Encoded(topic, time, bytes(self.types.serialize_cdr(message, TOPICS[topic], little_endian=True)))

    def _make(self, kind: str, **fields: RosObject) -> RosObject:
        """Create a message of the given type."""
        package, _, name = kind.partition("/")
        return self.types.types[f"{package}/msg/{name}"](**fields)

    def _header(self, time: int, frame: str) -> RosObject:
        stamp = self._make("builtin_interfaces/Time", sec=time // 10**9, nanosec=time % 10**9)
        return self._make("std_msgs/Header", stamp=stamp, frame_id=frame)

    def _vector(self, values: Array, kind: str = "geometry_msgs/Vector3") -> RosObject:
        return self._make(kind, **dict(zip("xyzw", (float(one) for one in values), strict=False)))

    def _cloud(self, table: dict[str, NDArray[Any]], time: int) -> RosObject:
        """Return a point cloud with the given fields, each ``(points,)``."""
        kind = np.dtype([(name, one.dtype.newbyteorder("<")) for name, one in table.items()])
        points = np.zeros(len(table["x"]), kind)
        for name, one in table.items():
            points[name] = one
        fields = [
            self._make("sensor_msgs/PointField", name=name, offset=4 * index, datatype=POINT_TYPES[one.dtype], count=1)
            for index, (name, one) in enumerate(table.items())
        ]
        return self._make(
            "sensor_msgs/PointCloud2",
            header=self._header(time, BODY),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=kind.itemsize,
            row_step=kind.itemsize * len(points),
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=True,
        )

    def _transform(self, parent: str, child: str, time: int, place: Array, turn: Rotation) -> RosObject:
        transform = self._make(
            "geometry_msgs/Transform",
            translation=self._vector(place),
            rotation=self._vector(turn.as_quat(canonical=True), "geometry_msgs/Quaternion"),
        )
        header = self._header(time, parent)
        one = self._make("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=transform)
        return self._make("tf2_msgs/TFMessage", transforms=[one])


class CloudEncoder(_RosEncoder):
    """Encoder of the points of pings: ``/sonar/returns`` (``sensor_msgs/PointCloud2``), and ``/tf`` of a moving sonar.

    Args:
        moving: whether poses are encoded.
    """

    def __init__(self, *, moving: bool) -> None:
        super().__init__()
        self.topics = ["/sonar/returns", *(["/tf"] if moving else [])]

    def messages(
        self, time_s: float, points: Array, intensity: NDArray[np.float32], pose: Array | None
    ) -> Iterator[Encoded]:
        """Encode the points of a ping, as starboard, forward, up ``(n, 3)`` [m], and the pose of the sonar ``(6,)``.

        Raises:
            MitsonarError: if ROS cannot represent the time.
        """
        (time,) = nanoseconds(np.array([time_s]))
        starboard, forward, up = points.T
        table = {"x": forward, "y": -starboard, "z": up, "intensity": intensity}
        cloud = self._cloud({name: one.astype(np.float32) for name, one in table.items()}, time)
        yield self._encoded("/sonar/returns", time, cloud)
        if pose is not None:
            yield self._encoded("/tf", time, self._transform(WORLD, BODY, time, *_ros_pose(pose)))


class FrameEncoder(_RosEncoder):
    """Encoder of frames of one sonar as ROS 2 messages (CDR).

    Args:
        like: frames with the sonar, ranges, bearings, level and arrays of all frames to encode; its images are not read.
        picture: format of the fans, ``png`` or ``jpeg``.
        returns: whether first returns are encoded, too.

    Raises:
        MitsonarError: if the format is unknown.
    """

    def __init__(self, like: SonarFrames, picture: str = "png", *, returns: bool = False) -> None:
        if picture not in PICTURES:
            raise MitsonarError(f"fans are written as {' or '.join(PICTURES)}: got {picture!r}")
        super().__init__()
        self.like, self.picture, self.returns = like, picture, returns
        self.topics = self._topics()

    def _topics(self) -> list[str]:
        """Return the topics to which frames are encoded."""
        needs = {
            "/sonar/points": self.like.elevation_rad,
            "/sonar/odometry": self.like.poses,
            "/tf": self.like.poses,
            "/sonar/imu": self.like.attitude_rad,
            "/sonar/altitude": self.like.height_m,
        }
        absent = [name for name, values in needs.items() if values is None]
        absent += [] if self.returns else ["/sonar/scan", "/sonar/returns"]
        absent += [] if self._has_even_beams else ["/sonar/scan"]
        return [name for name in TOPICS if name not in absent]

    def messages(self, frames: SonarFrames, returns: BeamReturns | None = None) -> Iterator[Encoded]:
        """Encode frames and their first returns, and yield the messages in order of time."""
        time_s = frames.time_s if frames.time_s.ndim == 1 else frames.time_s.mean(axis=1)
        for index, time in enumerate(nanoseconds(time_s)):
            yield self._encoded(WRITTEN, time, self._image(frames, index, time))
            yield self._encoded("/sonar/fan/compressed", time, self._fan(frames, index, time))
            if frames.elevation_rad is not None:
                yield self._encoded("/sonar/points", time, self._points(frames, index, time))
            if returns is not None:
                if self._has_even_beams:
                    yield self._encoded("/sonar/scan", time, self._scan(frames, index, time, returns))
                cloud = self._return_cloud(frames, index, time, returns)
                yield self._encoded("/sonar/returns", time, cloud)
            if frames.attitude_rad is not None:
                yield self._encoded("/sonar/imu", time, self._imu(frames.attitude_rad[index], time))
            if frames.height_m is not None:
                yield self._encoded("/sonar/altitude", time, self._altitude(float(frames.height_m[index]), time))
            if frames.poses is not None:
                place, turn = _ros_pose(frames.poses[index])
                yield self._encoded("/tf", time, self._transform(WORLD, BODY, time, place, turn))
                yield self._encoded("/sonar/odometry", time, self._odometry(time, place, turn))

    def fixed(self, time: int) -> Encoded:
        """Encode the fixed transform from the frame ``sonar`` to the frame ``sonar_link``."""
        turn = Rotation.from_matrix([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
        return self._encoded("/tf_static", time, self._transform(BODY, SENSOR, time, np.zeros(3), turn))

    # ------------------------------------------------------------ images

    @cached_property
    def _directions(self) -> list[RosObject]:
        """Directions of the beam axes in the frame ``sonar``: y to port, z forward."""
        bearing = self.like.bearing_rad
        axes = np.stack([np.zeros_like(bearing), -np.sin(bearing), np.cos(bearing)], axis=-1)
        return [self._vector(one) for one in axes]

    @cached_property
    def _ping_info(self) -> RosObject:
        sonar, beams = self.like.sonar, len(self.like.bearing_rad)
        return self._make(
            "marine_acoustic_msgs/PingInfo",
            frequency=float(sonar.frequency_hz or 0),
            sound_speed=sonar.sound_speed,
            tx_beamwidths=np.full(beams, math.radians(sonar.elevation_fov_deg), np.float32),
            rx_beamwidths=np.full(beams, sonar.beam_width_rad, np.float32),
        )

    def _image(self, frames: SonarFrames, index: int, time: int) -> RosObject:
        """Return a polar image; the samples of a range are contiguous, as drivers write them."""
        image = frames.image[index]
        image = image if image.dtype == np.uint8 else image.astype("<f4")
        data = self._make(
            "marine_acoustic_msgs/SonarImageData",
            is_bigendian=False,
            dtype=UINT8 if image.dtype == np.uint8 else FLOAT32,
            beam_count=image.shape[1],
            data=np.frombuffer(np.ascontiguousarray(image).tobytes(), np.uint8),
        )
        return self._make(
            "marine_acoustic_msgs/ProjectedSonarImage",
            header=self._header(time, SENSOR),
            ping_info=self._ping_info,
            beam_directions=self._directions,
            ranges=self.like.range_m.astype(np.float32),
            image=data,
        )

    @cached_property
    def _map(self) -> CartesianMap:
        rows = min(MAX_FAN_ROWS, max(2, len(self.like.range_m)))
        return cartesian_map(self.like.range_m, self.like.bearing_rad, rows=rows)

    def _fan(self, frames: SonarFrames, index: int, time: int) -> RosObject:
        """Return a picture of the fan: forward is up, starboard is right, and pixels outside are 0."""
        fan = to_uint8(np.asarray(self._map.apply(to_float32(frames.image[index]))))
        buffer = io.BytesIO()
        name, options = PICTURES[self.picture]
        Image.fromarray(fan).save(buffer, format=name, **options)
        return self._make(
            "sensor_msgs/CompressedImage",
            header=self._header(time, SENSOR),
            format=self.picture,
            data=np.frombuffer(buffer.getvalue(), np.uint8),
        )

    def _points(self, frames: SonarFrames, index: int, time: int) -> RosObject:
        """Return the positions of the cells with a known elevation and an echo as a point cloud, with value and labels."""
        assert frames.elevation_rad is not None
        image, elevation = frames.image[index], frames.elevation_rad[index]
        rows, columns = np.nonzero(np.isfinite(elevation) & (image > 0))
        unit_vectors = directions(frames.sonar.bearing, frames.bearing_rad[columns], elevation[rows, columns])
        starboard, forward, up = (unit_vectors * frames.range_m[rows, None]).T
        value = to_float32(image[rows, columns])
        table: dict[str, NDArray[Any]] = {"x": forward, "y": -starboard, "z": up, "intensity": value}
        table = {name: one.astype(np.float32) for name, one in table.items()}
        labels = {"shape_id": frames.shape_id, "object_id": frames.object_id}
        table |= {name: one[index][rows, columns].astype(np.int32) for name, one in labels.items() if one is not None}
        return self._cloud(table, time)

    # ------------------------------------------------------------ first returns

    @cached_property
    def _has_even_beams(self) -> bool:
        """Return whether the beams are evenly spaced, as a laser scan requires."""
        steps = np.diff(self.like.bearing_rad)
        return len(steps) > 0 and bool(np.allclose(steps, steps.mean(), rtol=EVEN_RTOL, atol=0))

    def _scan(self, frames: SonarFrames, index: int, time: int, returns: BeamReturns) -> RosObject:
        """Return the first returns as a laser scan: angles are positive to port, and rays follow in order of time.

        The header has the time of the first ray. Rays of beams that ping at once, or in interleaved groups, run from
        starboard to port at one time. The range of a ray without a return is infinite (REP 117).
        """
        bearing, ranges, value = frames.bearing_rad, returns.range_m[index], returns.value[index]
        times, sonar = beam_times(frames, index), frames.sonar
        if times is not None and (np.diff(times) > 0).any() and (np.diff(times) < 0).any():
            times = None
        from_starboard = times is None or times[0] > times[-1]
        order = slice(None, None, -1) if from_starboard else slice(None)
        angle = -bearing[order]
        first = time if times is None else nanoseconds(times[order][:1])[0]
        return self._make(
            "sensor_msgs/LaserScan",
            header=self._header(first, BODY),
            angle_min=float(angle[0]),
            angle_max=float(angle[-1]),
            angle_increment=float((angle[-1] - angle[0]) / (len(angle) - 1)),
            time_increment=0.0 if times is None else float(abs(times[-1] - times[0]) / (len(times) - 1)),
            scan_time=float(frame_period_s(sonar)),
            range_min=max(float(sonar.range_min), returns.from_m),
            range_max=float(sonar.range_max),
            ranges=ranges[order].astype(np.float32),
            intensities=value[order].astype(np.float32),
        )

    def _return_cloud(self, frames: SonarFrames, index: int, time: int, returns: BeamReturns) -> RosObject:
        """Return the first returns as a point cloud in the plane of the beams, with the value of each."""
        has_return = np.isfinite(returns.range_m[index])
        starboard, forward, up = return_points(frames, index, returns.range_m[index])[has_return].T
        value = returns.value[index][has_return]
        table = {"x": forward, "y": -starboard, "z": up, "intensity": value}
        return self._cloud({name: one.astype(np.float32) for name, one in table.items()}, time)

    # ------------------------------------------------------------ poses

    def _odometry(self, time: int, place: Array, turn: Rotation) -> RosObject:
        """Return the pose of the sonar as odometry; a covariance of -1 marks the twist as unknown."""
        zero, unknown = np.zeros(3), np.zeros(36)
        unknown[0] = -1
        pose = self._make(
            "geometry_msgs/Pose",
            position=self._vector(place, "geometry_msgs/Point"),
            orientation=self._vector(turn.as_quat(canonical=True), "geometry_msgs/Quaternion"),
        )
        twist = self._make("geometry_msgs/Twist", linear=self._vector(zero), angular=self._vector(zero))
        return self._make(
            "nav_msgs/Odometry",
            header=self._header(time, WORLD),
            child_frame_id=BODY,
            pose=self._make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=self._make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=unknown),
        )

    def _imu(self, attitude: Array, time: int) -> RosObject:
        """Return pitch, roll, heading ``(3,)`` [rad] as the orientation of an IMU; a covariance of -1 marks unknowns.

        If the heading alone is unknown, it is 0 with a variance that no angle has.
        """
        known = bool(np.isfinite(attitude[:2]).all())
        _, turn = _ros_pose(np.concatenate([np.zeros(3), np.where(np.isfinite(attitude), attitude, 0)]))
        unknown, covariance = np.zeros(9), np.zeros(9)
        unknown[0], covariance[8] = -1, 0 if np.isfinite(attitude[2]) else UNKNOWN_VARIANCE
        return self._make(
            "sensor_msgs/Imu",
            header=self._header(time, BODY),
            orientation=self._vector(turn.as_quat(canonical=True), "geometry_msgs/Quaternion"),
            orientation_covariance=covariance if known else unknown,
            angular_velocity=self._vector(np.zeros(3)),
            angular_velocity_covariance=unknown,
            linear_acceleration=self._vector(np.zeros(3)),
            linear_acceleration_covariance=unknown,
        )

    def _altitude(self, height_m: float, time: int) -> RosObject:
        """Return the height above the ground [m] as a range of an altimeter; infinite if unknown (REP 117)."""
        return self._make(
            "sensor_msgs/Range",
            header=self._header(time, BODY),
            radiation_type=0,
            field_of_view=0.0,
            min_range=0.0,
            max_range=1e5,
            range=height_m if math.isfinite(height_m) else math.inf,
        )


def nanoseconds(time_s: Array) -> list[int]:
    """Return times ``(n,)`` [s] as whole nanoseconds.

    Whole seconds, and dates since 1970, are restored exactly on reading.

    Raises:
        MitsonarError: if ROS cannot represent the times.
    """
    time_s = np.where(abs(time_s) < 5e-10, 0.0, time_s)  # the middle of a sweep about 0 s
    wrong = time_s[~((time_s >= 0) & (time_s < 2**31))]
    if wrong.size:
        raise MitsonarError(
            f"frame times must lie in 0..2^31 s for ROS, and with first returns those of all pings: got {wrong[0]:.15g} s; "
            "write the frames with other times, such as those of `mitsonar render --trajectory`"
        )
    whole = np.floor(time_s)
    return [int(one) * 10**9 + round(float(part) * 1e9) for one, part in zip(whole, time_s - whole, strict=True)]


def _ros_pose(pose: Array) -> tuple[Array, Rotation]:
    """Return the position and rotation of a pose ``(6,)`` in the convention of ROS."""
    place, turn = CONVENTIONS["ros-enu"].from_mitsonar(pose[None, :3], vehicle_rotation(pose))
    return place[0], turn[0]
