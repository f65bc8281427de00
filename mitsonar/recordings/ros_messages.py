"""Definitions of the ROS messages of sonars, for bags that lack them and for files that are written.

Names, types and order of the fields are those of the public definitions. ``tests/recordings/test_ros_bag.py`` compares their
MD5 sums with the published ones. Sources:

- ``marine_acoustic_msgs``: apl-ocean-engineering/marine_msgs (BSD-3-Clause), ``ProjectedSonarImage``, ``PingInfo``,
  ``SonarImageData``. The older package ``acoustic_msgs`` has the same messages.
- ``sonar_oculus``: MarineRoboticsGroup/sonar_oculus, ``OculusPing``, ``OculusFire``, as the pings of BlueROVs with an Oculus
  are recorded. Older versions hold a ``sensor_msgs/Image``; their bags bring the definition along.
- ``tf2_msgs``: ros/geometry2 (BSD-3-Clause), ``TFMessage``, which ``rosbags`` lacks for ROS 1.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

__all__ = ["DTYPES", "FANS", "OCULUS", "PROJECTED", "ros1_types", "ros2_types", "short"]

PROJECTED = ("marine_acoustic_msgs/msg/ProjectedSonarImage", "acoustic_msgs/msg/ProjectedSonarImage")
"""Types of polar images with directions of beams and ranges of bins."""

OCULUS = ("sonar_oculus/msg/OculusPing",)
"""Types of polar images of an Oculus."""

FANS = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
"""Types of pictures. They are fans in metres only by a geometry that the user gives."""

DTYPES = {0: "u1", 1: "i1", 2: "u2", 3: "i2", 4: "u4", 5: "i4", 6: "u8", 7: "i8", 8: "f4", 9: "f8"}
"""NumPy's letters for the numbers in ``SonarImageData.dtype``."""

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
        )
    },
    "sonar_oculus/msg/OculusFire": OCULUS_FIRE,
    "sonar_oculus/msg/OculusPing": OCULUS_PING,
    "tf2_msgs/msg/TFMessage": TRANSFORMS,
}
"""Text of each definition by its type."""


@cache
def ros1_types() -> Typestore:
    """Return the types of ROS 1 (Noetic) with those of sonars."""
    from rosbags.typesys import Stores

    return _with_sonars(Stores.ROS1_NOETIC)


@cache
def ros2_types() -> Typestore:
    """Return the types of ROS 2 (Humble) with those of sonars."""
    from rosbags.typesys import Stores

    return _with_sonars(Stores.ROS2_HUMBLE)


def _with_sonars(store: object) -> Typestore:
    from rosbags.typesys import get_types_from_msg, get_typestore

    types = get_typestore(store)  # type: ignore[arg-type]
    for name, text in DEFINITIONS.items():
        types.register(get_types_from_msg(text, name))
    return types


def short(kind: str) -> str:
    """Return the name of a type as ROS 1 writes it: ``sensor_msgs/Image``."""
    return kind.replace("/msg/", "/")
