"""How are messages in ROS bags accessed and defined? ROS 1 bags, ROS 2 bags and MCAP files, read by ``rosbags``."""

from __future__ import annotations

import json
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from mitsonar.errors import MitsonarError, missing_package_error
from mitsonar.io.files import finite_number, parse_json
from mitsonar.records.frames import SonarFrames

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys.store import Typestore

__all__ = [
    "DTYPES",
    "ECHOES",
    "FANS",
    "OCULUS",
    "PROJECTED",
    "RANGES",
    "RAW",
    "RECORD",
    "SONARS",
    "WRITTEN",
    "BagFile",
    "Message",
    "Topic",
    "frames_like",
    "is_ros_bag",
    "metadata_of",
    "ros1_types",
    "ros2_types",
    "short",
]


Message: TypeAlias = Any
"""A decoded message; its definition in the bag determines its fields."""

ROS1 = b"#ROSBAG V"
MCAP = b"\x89MCAP0\r\n"
SQLITE = b"SQLite format 3\x00"

SUFFIXES = {ROS1: ".bag", MCAP: ".mcap", SQLITE: ".db3"}
"""Required suffixes of single-file bags, keyed by their first bytes."""


REPAIRS = {".bag": "rosbag reindex", ".mcap": "mcap recover"}
"""Commands that repair a bag that its recorder did not close, keyed by suffix."""


class Topic(NamedTuple):
    """A topic: its name, its message type (such as ``sensor_msgs/msg/Image``) and its number of messages."""

    name: str
    kind: str
    messages: int


def is_ros_bag(path: Path, first: bytes) -> bool:
    """Return whether a file with these first bytes, or a folder, is a ROS bag."""
    if not first and path.is_dir():
        return _is_ros2_folder(path)
    return first.startswith((ROS1, MCAP)) or (first.startswith(SQLITE) and path.suffix == ".db3")


def _is_ros2_folder(path: Path) -> bool:
    try:
        with (path / "metadata.yaml").open("rb") as file:
            return b"rosbag2_bagfile_information" in file.read(4096)
    except OSError:
        return False


class BagFile:
    """A ROS bag, opened when it is first read and closed with this object; a copy in another process opens it again.

    Raises:
        MitsonarError: if the bag is damaged, or its suffix is not the one that its format requires.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._reader: AnyReader | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the open file, which stays in its process."""
        return {"path": self.path, "_reader": None}

    @property
    def is_ros1(self) -> bool:
        """Return whether this is a ROS 1 bag."""
        return self.path.suffix == ".bag"

    def topics(self) -> list[Topic]:
        """Return all topics, sorted by name."""
        with self._readable():
            topics = self._open().topics
            return [Topic(name, one.msgtype or "several types", one.msgcount) for name, one in sorted(topics.items())]

    def messages(self, topic: str, start: int | None = None, stop: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Read the raw messages of a topic in the order in which they were received.

        Args:
            topic: name of the topic.
            start: earliest time of reception, inclusive [ns]; default: no limit.
            stop: latest time of reception, exclusive [ns]; default: no limit.

        Yields:
            Time of reception [ns] and bytes of each message.
        """
        with self._readable():
            reader = self._open()
            connections = [one for one in reader.connections if one.topic == topic]
            for _, time, raw in reader.messages(connections, start=start, stop=stop):
                yield time, bytes(raw)

    def decode(self, raw: bytes, kind: str) -> Message:
        """Decode a raw message of the given type."""
        with self._readable():
            return self._open().deserialize(raw, kind)

    def _open(self) -> AnyReader:
        if self._reader is not None:
            return self._reader
        try:
            from rosbags.highlevel import AnyReader
        except ModuleNotFoundError as error:
            raise missing_package_error(error) from None
        self._check_name()
        reader = AnyReader([self.path], default_typestore=ros1_types() if self.is_ros1 else ros2_types())
        reader.open()
        weakref.finalize(self, reader.close)
        self._reader = reader
        return reader

    def _check_name(self) -> None:
        """Check that the suffix matches the content, because ``rosbags`` recognises formats by the suffix."""
        if self.path.is_dir():
            return
        with self.path.open("rb") as file:
            first = file.read(len(SQLITE))
        for begin, end in SUFFIXES.items():
            if first.startswith(begin) and self.path.suffix != end:
                raise MitsonarError(f"{self.path} is a bag whose name must end with {end}: rename it")

    @contextmanager
    def _readable(self) -> Iterator[None]:
        """Convert any exception that a damaged bag causes to a MitsonarError of one sentence."""
        try:
            yield
        except (MitsonarError, GeneratorExit):
            raise
        except Exception as error:  # a damaged bag raises errors of many kinds
            reason = " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
            repair = REPAIRS.get(self.path.suffix)
            raise MitsonarError(
                f"cannot read the bag {self.path}: {reason}; the file is cut off, damaged or of another format"
                + (f": `{repair}` may repair it" if repair else "")
            ) from None


# ---------------- Definitions of sonar messages
# They serve bags that lack definitions, and files that mitsonar writes. Names, types and order of the fields are those of
# the public definitions; ``tests/recordings/test_ros_bag.py`` compares their MD5 sums with the published ones. Sources:
#
# - ``marine_acoustic_msgs``: apl-ocean-engineering/marine_msgs (BSD-3-Clause), ``ProjectedSonarImage``, ``PingInfo``,
#   ``SonarImageData``, ``RawSonarImage``, ``SonarRanges``, ``DetectionFlag``. The older package ``acoustic_msgs`` has the
#   same messages.
# - ``ping360_sonar_msgs``: CentraleNantesRobotics/ping360_sonar (MIT), ``SonarEcho``; in ROS 1 part of ``ping360_sonar``.
# - ``sonar_oculus``: MarineRoboticsGroup/sonar_oculus, ``OculusPing``, ``OculusFire``, in which pings of BlueROVs with an
#   Oculus are recorded. Older versions hold a ``sensor_msgs/Image``; their bags contain the definition.
# - ``tf2_msgs``: ros/geometry2 (BSD-3-Clause), ``TFMessage``, which ``rosbags`` lacks for ROS 1.


PROJECTED = ("marine_acoustic_msgs/msg/ProjectedSonarImage", "acoustic_msgs/msg/ProjectedSonarImage")
"""Types of polar images that hold beam directions and bin ranges."""

RAW = ("marine_acoustic_msgs/msg/RawSonarImage", "acoustic_msgs/msg/RawSonarImage")
"""Types of polar images that hold receive angles and a sample rate."""

OCULUS = ("sonar_oculus/msg/OculusPing",)
"""Types of polar images of an Oculus."""

ECHOES = ("ping360_sonar_msgs/msg/SonarEcho", "ping360_sonar/msg/SonarEcho")
"""Types of single pings of a Ping360."""

RANGES = ("marine_acoustic_msgs/msg/SonarRanges", "acoustic_msgs/msg/SonarRanges")
"""Types of the ranges of a multibeam, one a beam, whose directions are free; they hold no image."""

SONARS = (*PROJECTED, *RAW, *OCULUS, *ECHOES)
"""All types that contain their geometry."""

FANS = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
"""Types of pictures, which only a geometry given by the user turns into metric fans."""

DTYPES = {0: "u1", 1: "i1", 2: "u2", 3: "i2", 4: "u4", 5: "i4", 6: "u8", 7: "i8", 8: "f4", 9: "f8"}
"""NumPy type codes, keyed by the value of ``SonarImageData.dtype``."""

PING_INFO = """
float32 frequency
float32 sound_speed
float32[] tx_beamwidths
float32[] rx_beamwidths
"""

SONAR_IMAGE_DATA = """
bool is_bigendian
uint32 DTYPE_UINT8=0
uint32 DTYPE_INT8=1
uint32 DTYPE_UINT16=2
uint32 DTYPE_INT16=3
uint32 DTYPE_UINT32=4
uint32 DTYPE_INT32=5
uint32 DTYPE_UINT64=6
uint32 DTYPE_INT64=7
uint32 DTYPE_FLOAT32=8
uint32 DTYPE_FLOAT64=9
uint32 dtype
uint32 beam_count
uint8[] data
"""

PROJECTED_SONAR_IMAGE = """
std_msgs/Header header
PingInfo ping_info
geometry_msgs/Vector3[] beam_directions
float32[] ranges
SonarImageData image
"""

RAW_SONAR_IMAGE = """
std_msgs/Header header
PingInfo ping_info
float32 sample_rate
uint32 samples_per_beam
uint32 sample0
float32[] tx_delays
float32[] tx_angles
float32[] rx_angles
SonarImageData image
"""

DETECTION_FLAG = """
uint8 DETECT_OK=0
uint8 DETECT_BAD_SONAR=1
uint8 DETECT_BAD_FILTER=2
uint8 DETECT_BAD_USER=4
uint8 flag
"""

SONAR_RANGES = """
std_msgs/Header header
PingInfo ping_info
DetectionFlag[] flags
float32[] transmit_delays
float32[] intensities
geometry_msgs/Vector3[] beam_unit_vec
float32[] ranges
"""

SONAR_ECHO = """
std_msgs/Header header
float32 angle
uint8 gain
uint16 number_of_samples
uint16 transmit_frequency
uint16 speed_of_sound
uint8 range
uint8[] intensities
"""

OCULUS_FIRE = """
std_msgs/Header header
uint8 mode
uint8 gamma
uint8 flags
float64 range
float64 gain
float64 speed_of_sound
float64 salinity
"""

OCULUS_PING = """
std_msgs/Header header
OculusFire fire_msg
uint32 ping_id
uint16 part_number
uint32 start_time
int16[] bearings
float64 range_resolution
uint32 num_ranges
uint32 num_beams
sensor_msgs/CompressedImage ping
"""

TRANSFORMS = """
geometry_msgs/TransformStamped[] transforms
"""

DEFINITIONS = {
    **{
        f"{package}/msg/{name}": text
        for package in ("marine_acoustic_msgs", "acoustic_msgs")
        for name, text in (
            ("PingInfo", PING_INFO),
            ("SonarImageData", SONAR_IMAGE_DATA),
            ("ProjectedSonarImage", PROJECTED_SONAR_IMAGE),
            ("RawSonarImage", RAW_SONAR_IMAGE),
            ("DetectionFlag", DETECTION_FLAG),
            ("SonarRanges", SONAR_RANGES),
        )
    },
    **dict.fromkeys(ECHOES, SONAR_ECHO),
    "sonar_oculus/msg/OculusFire": OCULUS_FIRE,
    "sonar_oculus/msg/OculusPing": OCULUS_PING,
    "tf2_msgs/msg/TFMessage": TRANSFORMS,
}
"""Text of each definition, keyed by message type."""


@cache
def ros1_types() -> Typestore:
    """Return the message types of ROS 1 (Noetic), extended by those of sonars."""
    from rosbags.typesys import Stores

    return _with_sonars(Stores.ROS1_NOETIC)


@cache
def ros2_types() -> Typestore:
    """Return the message types of ROS 2 (Humble), extended by those of sonars."""
    from rosbags.typesys import Stores

    return _with_sonars(Stores.ROS2_HUMBLE)


def _with_sonars(store: object) -> Typestore:
    from rosbags.typesys import get_types_from_msg, get_typestore

    types = get_typestore(store)  # type: ignore[arg-type]
    for name, text in DEFINITIONS.items():
        types.register(get_types_from_msg(text, name))
    return types


def short(kind: str) -> str:
    """Return the name of a type in the notation of ROS 1: ``sensor_msgs/Image``."""
    return kind.replace("/msg/", "/")


# ---------------- Metadata record of an MCAP file
# The record holds what ROS messages cannot: the sonar, its exact axes, and the coding of samples.


RECORD = "mitsonar"
"""Name of the metadata record."""

WRITTEN = "/sonar/image"
"""Topic of the images that the record describes."""

FIELDS = ("sonar", "level", "level_scale", "range_m", "bearing_rad")


def metadata_of(frames: SonarFrames, span_db: float | None = None) -> dict[str, str]:
    """Return the metadata record of frames: JSON strings, keyed by name.

    Args:
        frames: frames of the file.
        span_db: dynamic range over which samples encode linear levels in dB [dB]; None if samples are values in the coding
            of the frames.
    """
    table = {
        "sonar": frames.sonar.model_dump(),
        "level": frames.level,
        "level_scale": frames.level_scale,
        "range_m": frames.range_m.tolist(),
        "bearing_rad": frames.bearing_rad.tolist(),
        "samples": _describe_coding(frames, span_db),
    }
    table |= {} if span_db is None else {"span_db": span_db}
    return {name: json.dumps(value) for name, value in table.items()}


def _describe_coding(frames: SonarFrames, span_db: float | None) -> str:
    """Describe in words how samples are converted to levels relative to full scale."""
    value, sonar = "sample / 255" if frames.image.dtype == np.uint8 else "sample", frames.sonar
    zero = "0 is no echo; "
    if span_db is not None or frames.level == "dB":
        text = f"{zero if span_db else ''}level in dB = {span_db or sonar.coding_db:g} * ({value} - 1)"
    elif frames.level == "gamma":
        text = f"level in dB = {20 / sonar.coding_gamma:g} * log10({value})"
    elif frames.level == "linear":
        text = f"{zero}level in dB = 10 * log10({value})"
    else:
        return "contrast: there are no levels"
    return f"{text}, relative to full scale, which is {10 * np.log10(frames.level_scale) + sonar.source_level_db:.6g} dB"


def frames_like(path: Path, images: np.dtype[np.generic]) -> tuple[SonarFrames, float | None] | None:
    """Return empty frames as described by the metadata record of a file, and the dynamic range of their samples.

    Args:
        path: path of an ``.mcap`` file.
        images: type of the images.

    Returns:
        The frames and the dynamic range [dB], which is None if samples are the values of the images. None without a record.

    Raises:
        MitsonarError: if the record is damaged.
    """
    record = _record_in(path)
    if record is None:
        return None
    source = f"the metadata record of {path}"
    missing = [name for name in FIELDS if name not in record]
    if missing:
        raise MitsonarError(f"{source} lacks {', '.join(missing)}: the file is damaged")
    value = {name: parse_json(record[name], f"{name} in {source}") for name in FIELDS}
    try:
        axes = {name: np.array(value[name], dtype=np.float64).reshape(-1) for name in ("range_m", "bearing_rad")}
        table = {name: np.array(value[name]) for name in ("level", "level_scale")} | {"sonar": np.array(record["sonar"])}
        empty = {"image": np.zeros((0, *(len(one) for one in axes.values())), images), "time_s": np.zeros(0)}
    except (TypeError, ValueError) as error:
        raise MitsonarError(f"{source} is damaged: {error}") from None
    span_db = None
    if "span_db" in record:
        span_db = finite_number(parse_json(record["span_db"], f"span_db in {source}"), f"span_db in {source}", above=0)
        empty["image"] = empty["image"].astype(np.float32)
    return SonarFrames.from_arrays({**axes, **table, **empty}, source), span_db


def _record_in(path: Path) -> dict[str, str] | None:
    """Return mitsonar's metadata record of a file; None if it has none."""
    try:
        from mcap.reader import make_reader
    except ModuleNotFoundError as error:
        raise missing_package_error(error) from None
    try:
        with path.open("rb") as file:
            return next((one.metadata for one in make_reader(file).iter_metadata() if one.name == RECORD), None)
    except Exception as error:  # a damaged file raises errors of many kinds
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise MitsonarError(f"cannot read the metadata of {path}: {reason}; the file is damaged") from None
