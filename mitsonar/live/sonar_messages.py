"""A ping as messages: the fan as JPEG, the polar image as ROS 2 has it, its timing."""

from __future__ import annotations

import io
import struct
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import csr_array

from mitsonar.io.files import PlainValue
from mitsonar.live.live_loop import LivePing
from mitsonar.plotting.fans import FanPictures
from mitsonar.records.frames import SonarFrames, to_uint8

__all__ = ["PROJECTED", "PROJECTED_TYPE", "FanEncoder", "projected_image", "timing"]

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
"""Definition of the message as ROS 2 writes it, without constants and comments."""

UINT8 = 0


class FanEncoder:
    """Encodes frames of one sonar as JPEG fans: those of :class:`FanPictures` to one step of 255, by a sparse matrix.

    Args:
        quality: of JPEG, 1..95.
    """

    def __init__(self, quality: int = 85) -> None:
        self.quality = quality
        self._inside: NDArray[np.intp] | None = None

    def jpeg(self, frames: SonarFrames, index: int = 0) -> bytes:
        """Return one frame's fan, forward up, starboard to the right, grey; black outside the fan."""
        buffer = io.BytesIO()
        Image.fromarray(self.picture(frames, index)).save(buffer, format="JPEG", quality=self.quality)
        return buffer.getvalue()

    def picture(self, frames: SonarFrames, index: int = 0) -> NDArray[np.uint8]:
        """Return one frame's fan ``(rows, columns)``, 0..255."""
        if self._inside is None:
            fan = FanPictures(frames).fan
            self._shape = fan.index.shape[1:]
            self._inside = np.flatnonzero(fan.weight.any(axis=0))
            cells = fan.index.reshape(4, -1)[:, self._inside].T
            parts = fan.weight.reshape(4, -1)[:, self._inside].T
            rows = np.arange(0, 4 * len(cells) + 1, 4)
            size = (len(cells), frames.image[0].size)
            self._matrix = csr_array((parts.ravel(), cells.ravel().astype(np.int32), rows), shape=size)
        image = frames.image[index]
        levels = image if image.dtype == np.uint8 else to_uint8(image)  # beam by beam, as sonars send them
        picture = np.zeros(self._shape, np.uint8)
        picture.reshape(-1)[self._inside] = self._matrix @ levels.reshape(-1).astype(np.float32) + np.float32(0.5)
        return picture


def projected_image(frames: SonarFrames, time_ns: int, frame_id: str, index: int = 0) -> bytes:
    """Encode a frame as ``marine_acoustic_msgs/msg/ProjectedSonarImage`` in CDR, little-endian.

    Beams lie in the message's own axes: z forward, x up, y to starboard. Data are 8 bit, all beams of the nearest range
    first.

    Args:
        frames: whose frame it is.
        time_ns: of the ping [ns].
        frame_id: name of the sonar's axes.
        index: of the frame.
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
    """Return number, pose, source and times of a ping, as JSON can hold them."""
    assert ping.frames.poses is not None
    six = ping.frames.poses[0]
    angles = np.degrees(six[3:])
    now = time.time_ns() if published_ns is None else published_ns
    return {
        "number": ping.number,
        "id": ping.mark,
        "source": ping.source,
        "dropped": ping.dropped,
        "pose_ns": ping.time_ns,
        "published_ns": now,
        "render_ms": round(1e3 * ping.render_s, 3),
        "latency_ms": round((now - ping.time_ns) / 1e6, 3),
        "x": float(six[0]),
        "y": float(six[1]),
        "z": float(six[2]),
        "pitch": float(angles[0]),
        "roll": float(angles[1]),
        "heading": float(angles[2]),
    }


class _Cdr:
    """Writes the common data representation: values aligned to their own size, counted from after the first 4 bytes."""

    def __init__(self) -> None:
        self.content = bytearray(b"\x00\x01\x00\x00")

    def align(self, size: int) -> None:
        self.content += bytes(-(len(self.content) - 4) % size)

    def pack(self, form: str, *values: float) -> None:
        """Append numbers of one size."""
        self.align(struct.calcsize(form[:2]))
        self.content += struct.pack(form, *values)

    def text(self, text: str) -> None:
        encoded = text.encode() + b"\x00"
        self.pack("<I", len(encoded))
        self.content += encoded

    def array(self, values: NDArray[Any], length: int | None = None) -> None:
        """Append an array with its length; ``length`` where its elements are rows."""
        self.pack("<I", values.size if length is None else length)
        if values.size:
            self.align(values.itemsize)
            self.content += values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()
