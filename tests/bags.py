"""ROS bags for tests, written by ``rosbags``: pings, odometry and transforms in ROS 1, ROS 2 (SQLite) and ROS 2 (MCAP)."""

from __future__ import annotations

import io
from collections import defaultdict
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from scipy import ndimage

from mitsonar.recordings.ros_messages import ros1_types, ros2_types

RosObject: TypeAlias = Any
"""An object of a message type that ``rosbags`` made."""

Sent: TypeAlias = tuple[str, float, RosObject]
"""Topic, time of reception [s], message."""


class Maker:
    """Makes messages of ROS 1 or ROS 2."""

    def __init__(self, ros1: bool) -> None:
        self.ros1, self.types = ros1, ros1_types() if ros1 else ros2_types()

    def make(self, kind: str, **fields: Any) -> RosObject:
        package, _, name = kind.partition("/")
        return self.types.types[f"{package}/msg/{name}"](**fields)

    def header(self, time_s: float, frame: str = "sonar") -> RosObject:
        nanoseconds = round(time_s * 1e9)
        stamp = self.make("builtin_interfaces/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def vector(self, values: Any, kind: str = "geometry_msgs/Vector3") -> RosObject:
        return self.make(kind, **dict(zip("xyzw", map(float, values), strict=False)))

    def ping(
        self,
        image: NDArray[Any],
        time_s: float,
        bearing_rad: NDArray[np.float64],
        range_m: NDArray[np.float64],
        *,
        beam_major: bool = False,
        forward: str = "z",
        frame: str = "sonar",
        big: bool = False,
    ) -> RosObject:
        """A ``ProjectedSonarImage``; the image ``(bins, beams)`` of any type, column 0 the first bearing."""
        zero, port, ahead = np.zeros_like(bearing_rad), -np.sin(bearing_rad), np.cos(bearing_rad)
        axes = (zero, port, ahead) if forward == "z" else (ahead, port, zero)
        letters = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"]
        stored = image.astype(image.dtype.newbyteorder(">" if big else "<"))
        flat = np.ascontiguousarray(stored.T if beam_major else stored)
        data = self.make(
            "marine_acoustic_msgs/SonarImageData",
            is_bigendian=big,
            dtype=letters.index(image.dtype.str[1:]),
            beam_count=image.shape[1],
            data=np.frombuffer(flat.tobytes(), np.uint8),
        )
        info = self.make(
            "marine_acoustic_msgs/PingInfo",
            frequency=1.2e6,
            sound_speed=1480.0,
            tx_beamwidths=np.full(len(zero), 0.35, np.float32),
            rx_beamwidths=np.full(len(zero), 0.01, np.float32),
        )
        return self.make(
            "marine_acoustic_msgs/ProjectedSonarImage",
            header=self.header(time_s, frame),
            ping_info=info,
            beam_directions=[self.vector(one) for one in np.stack(axes, axis=-1)],
            ranges=range_m.astype(np.float32),
            image=data,
        )

    def oculus(self, image: NDArray[np.uint8], time_s: float, centidegrees: NDArray[np.int16], step_m: float) -> RosObject:
        """An ``OculusPing`` with a PNG."""
        buffer = io.BytesIO()
        Image.fromarray(image).save(buffer, format="PNG")
        picture = self.make(
            "sensor_msgs/CompressedImage",
            header=self.header(time_s),
            format="mono8; png compressed",
            data=np.frombuffer(buffer.getvalue(), np.uint8),
        )
        fire = {"mode": 1, "gamma": 127, "flags": 0, "range": 10.0, "gain": 50.0, "speed_of_sound": 1490.0, "salinity": 0.0}
        return self.make(
            "sonar_oculus/OculusPing",
            header=self.header(time_s),
            fire_msg=self.make("sonar_oculus/OculusFire", header=self.header(time_s), **fire),
            ping_id=1,
            part_number=1,
            start_time=0,
            bearings=centidegrees,
            range_resolution=step_m,
            num_ranges=image.shape[0],
            num_beams=image.shape[1],
            ping=picture,
        )

    def echo(self, samples: bytes, angle: int, time_s: float, **changed: Any) -> RosObject:
        """A ``SonarEcho`` of a Ping360 at an angle [gradian], positive to port."""
        fields = {
            "gain": 1,
            "number_of_samples": len(samples),
            "transmit_frequency": 740,
            "speed_of_sound": 1480,
            "range": 4,
        }
        return self.make(
            "ping360_sonar/SonarEcho" if self.ros1 else "ping360_sonar_msgs/SonarEcho",
            header=self.header(time_s, "ping360"),
            angle=float(np.float32(angle * np.pi / 200)),
            intensities=np.frombuffer(samples, np.uint8),
            **fields | changed,
        )

    def raw(
        self, image: NDArray[np.uint8], time_s: float, angles: NDArray[np.float64], *, beam_major: bool, **changed: Any
    ) -> RosObject:
        """A ``RawSonarImage``; the image ``(bins, beams)``, column 0 the first angle."""
        flat, width = np.ascontiguousarray(image.T if beam_major else image), np.full(len(angles), 0.02, np.float32)
        fields = {
            "ping_info": self.make(
                "marine_acoustic_msgs/PingInfo",
                frequency=7.2e5,
                sound_speed=1480.0,
                tx_beamwidths=10 * width,
                rx_beamwidths=width,
            ),
            "sample_rate": 37_000.0,
            "samples_per_beam": len(image),
            "sample0": 50,
            "rx_angles": angles.astype(np.float32),
            "image": self.make(
                "marine_acoustic_msgs/SonarImageData",
                is_bigendian=False,
                dtype=0,
                beam_count=image.shape[1],
                data=flat.ravel(),
            ),
        }
        nothing = np.zeros(len(angles), np.float32)
        return self.make(
            "marine_acoustic_msgs/RawSonarImage",
            header=self.header(time_s),
            tx_delays=nothing,
            tx_angles=nothing,
            **fields | changed,
        )

    def ranges(
        self, range_m: Any, directions: Any, time_s: float, *, package: str = "marine_acoustic_msgs", **changed: Any
    ) -> RosObject:
        """A ``SonarRanges``, with directions ``(beams, 3)`` in the axes of its frame."""
        beams = len(range_m)
        flags = changed.pop("flags", np.zeros(beams, int))
        floats = {"ranges": range_m, "intensities": np.arange(beams), "transmit_delays": np.zeros(beams)} | changed
        info = {"frequency": 4e5, "sound_speed": 1490.0, "tx_beamwidths": np.zeros(0, np.float32)}
        return self.make(
            f"{package}/SonarRanges",
            header=self.header(time_s, "multibeam"),
            ping_info=self.make(f"{package}/PingInfo", rx_beamwidths=np.zeros(0, np.float32), **info),
            flags=[self.make(f"{package}/DetectionFlag", flag=int(one)) for one in flags],
            beam_unit_vec=[self.vector(one) for one in directions],
            **{name: np.asarray(one, np.float32) for name, one in floats.items()},
        )

    def pose(self, place: Any, quaternion: Any) -> RosObject:
        return self.make(
            "geometry_msgs/Pose",
            position=self.vector(place, "geometry_msgs/Point"),
            orientation=self.vector(quaternion, "geometry_msgs/Quaternion"),
        )

    def odometry(self, time_s: float, place: Any, quaternion: Any, child: str, world: str = "odom") -> RosObject:
        twist = self.make("geometry_msgs/Twist", linear=self.vector([0, 0, 0]), angular=self.vector([0, 0, 0]))
        pose = self.make("geometry_msgs/PoseWithCovariance", pose=self.pose(place, quaternion), covariance=np.zeros(36))
        return self.make(
            "nav_msgs/Odometry",
            header=self.header(time_s, world),
            child_frame_id=child,
            pose=pose,
            twist=self.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def pose_stamped(self, time_s: float, place: Any, quaternion: Any, world: str = "map") -> RosObject:
        return self.make("geometry_msgs/PoseStamped", header=self.header(time_s, world), pose=self.pose(place, quaternion))

    def transform(self, time_s: float, parent: str, child: str, place: Any, quaternion: Any) -> RosObject:
        where = self.make(
            "geometry_msgs/Transform",
            translation=self.vector(place),
            rotation=self.vector(quaternion, "geometry_msgs/Quaternion"),
        )
        header = self.header(time_s, parent)
        one = self.make("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=where)
        return self.make("tf2_msgs/TFMessage", transforms=[one])


def write_bag(path: Path, maker: Maker, sent: list[Sent]) -> Path:
    """Write a bag: of ROS 1 where the name ends with ``.bag``, else a folder, of MCAP where it ends with ``mcap``."""
    if maker.ros1:
        writer: Any = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if path.name.endswith("mcap") else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        connections = {}
        for topic, time_s, message in sent:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=maker.types)
            serialize = maker.types.serialize_ros1 if maker.ros1 else maker.types.serialize_cdr
            writer.write(connections[topic], round(time_s * 1e9), serialize(message, kind))
    return path


def decoded(path: Path) -> dict[str, list[RosObject]]:
    """The messages of an MCAP file by topic, as ``mcap-ros2-support`` decodes them."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    result = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            result[channel.topic].append(message)
    return dict(result)


# ---------------------------------------------------------------- pings

BEARING = np.radians(np.linspace(-30, 28, 24)) + 0.01 * np.sin(np.arange(24))
RANGE: NDArray[np.float64] = 1.0 + 0.05 * np.arange(40, dtype=np.float64)
TIME = 1_700_000_000 + np.array([0.1, 0.35, 0.5, 0.7, 1.0, 1.1])
KINDS = ["one.bag", "two", "three_mcap"]
"""A bag of ROS 1, one of ROS 2 in SQLite, one of ROS 2 in MCAP."""


def smooth(count: int = len(TIME), kind: type[np.generic] = np.uint8) -> NDArray[Any]:
    """Images whose neighbours resemble each other, as those of a sonar do ``(count, bins, beams)``."""
    noise = np.random.default_rng(5).normal(size=(count, len(RANGE), len(BEARING)))
    drawn = ndimage.gaussian_filter(noise, (0, 1.5, 1.5))
    level = (drawn - drawn.min()) / np.ptp(drawn)
    letters = np.dtype(kind)
    return np.asarray(level if letters.kind == "f" else level * np.iinfo(letters.name).max, dtype=letters)


def pings(maker: Maker, images: NDArray[Any], topic: str = "/sonar", **options: Any) -> list[Sent]:
    bearing, distance = options.pop("bearing_rad", BEARING), options.pop("range_m", RANGE)
    return [
        (topic, time + 0.02, maker.ping(image, time, bearing, distance, **options))
        for time, image in zip(TIME, images, strict=True)
    ]
