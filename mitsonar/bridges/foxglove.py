"""How a live sonar is served to Foxglove: it receives poses, and publishes fan, polar image, transform, pose and timing."""

from __future__ import annotations

import json
import threading
from typing import Any

import foxglove
import numpy as np
from foxglove.channels import CompressedImageChannel, FrameTransformChannel, PoseInFrameChannel
from foxglove.messages import CompressedImage, FrameTransform, Pose, PoseInFrame, Quaternion, Timestamp, Vector3
from foxglove.websocket import Capability, ServerListener
from numpy.typing import NDArray

from mitsonar.bridges.live import (
    PROJECTED,
    PROJECTED_TYPE,
    FanEncoder,
    LivePing,
    PoseMailbox,
    parse_pose,
    pose_in_ros,
    projected_image,
    timing,
)
from mitsonar.errors import MitsonarError, short_repr

__all__ = ["SONAR_FRAME", "WORLD_FRAME", "FoxgloveServer"]

SONAR_FRAME, WORLD_FRAME, POSE_TOPIC = "sonar", "world", "/pose"

CLOSE_TIMEOUT_S = 1.0
"""Longest time that :meth:`FoxgloveServer.close` waits for clients to disconnect [s]."""

NUMBER_FIELDS = ("number", "dropped", "pose_ns", "published_ns", "render_ms", "latency_ms")
TIMING_SCHEMA = {
    "type": "object",
    "title": "mitsonar.Timing",
    "properties": {
        **{name: {"type": "number"} for name in (*NUMBER_FIELDS, "x", "y", "z", "pitch", "roll", "heading")},
        "source": {"type": "string"},
    },
}


class FoxgloveServer:
    """WebSocket server that publishes pings to Foxglove clients, and receives the poses that they publish on ``/pose``.

    Args:
        mailbox: mailbox that the received poses are put into.
        host: address to listen on.
        port: port to listen on; 0 chooses a free one.

    Attributes:
        port: port that the server listens on.

    Raises:
        MitsonarError: the server cannot listen on the address.
    """

    def __init__(self, mailbox: PoseMailbox, host: str = "127.0.0.1", port: int = 8765) -> None:
        context = self._context = foxglove.Context()  # the channels are closed with it
        self._fan = CompressedImageChannel("/sonar/fan", context=context)
        schema = foxglove.Schema(name=PROJECTED_TYPE, encoding="ros2msg", data=PROJECTED.encode())
        self._polar = foxglove.Channel("/sonar/image", schema=schema, message_encoding="cdr", context=context)
        self._transform = FrameTransformChannel("/tf", context=context)
        self._pose = PoseInFrameChannel("/sonar/pose", context=context)
        self._timing = foxglove.Channel("/sonar/timing", schema=TIMING_SCHEMA, message_encoding="json", context=context)
        self._encoder = FanEncoder()
        try:
            self._server = foxglove.start_server(
                name="mitsonar",
                host=host,
                port=port,
                context=context,
                capabilities=[Capability.ClientPublish],
                supported_encodings=["json"],
                server_listener=_PoseListener(mailbox, self.warn),
                message_backlog_size=16,
            )
        except (RuntimeError, OSError) as error:
            raise MitsonarError(
                f"cannot listen on {host}:{port} ({' '.join(str(error).split())}): give another --port, or 0 for a free one"
            ) from None
        self.port = int(self._server.port)

    def publish(self, ping: LivePing) -> None:
        """Publish a ping.

        Images are encoded only for subscribers. The fan is sent first, because TCP may delay later messages.
        """
        frames, time_ns = ping.frames, ping.time_ns
        stamp = Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
        if self._fan.has_sinks():
            data = self._encoder.jpeg(frames)
            image = CompressedImage(timestamp=stamp, frame_id=SONAR_FRAME, data=data, format="jpeg")
            self._fan.log(image, log_time=time_ns)
        assert frames.poses is not None
        position_m, quaternion = pose_in_ros(frames.poses[0])
        position, rotation = _vector(position_m), _quaternion(quaternion)
        transform = FrameTransform(
            timestamp=stamp,
            parent_frame_id=WORLD_FRAME,
            child_frame_id=SONAR_FRAME,
            translation=position,
            rotation=rotation,
        )
        self._transform.log(transform, log_time=time_ns)
        pose = PoseInFrame(timestamp=stamp, frame_id=WORLD_FRAME, pose=Pose(position=position, orientation=rotation))
        self._pose.log(pose, log_time=time_ns)
        if self._polar.has_sinks():
            self._polar.log(projected_image(frames, time_ns, SONAR_FRAME), log_time=time_ns)
        self._timing.log(json.dumps(timing(ping)).encode(), log_time=time_ns)

    def warn(self, message: str) -> None:
        """Send a warning to all clients; Foxglove shows it in its Problems panel."""
        self._server.publish_status(message, foxglove.StatusLevel.Warning)

    def close(self) -> None:
        """Close all connections. Wait at most :data:`CLOSE_TIMEOUT_S`: a client that stopped reading never disconnects."""
        stopping = threading.Thread(target=self._server.stop, daemon=True)
        stopping.start()
        stopping.join(CLOSE_TIMEOUT_S)


class _PoseListener(ServerListener):
    """Listener that parses the clients' poses in the server's threads, and answers invalid ones with a warning."""

    def __init__(self, mailbox: PoseMailbox, warn: Any) -> None:
        self.mailbox, self.warn = mailbox, warn
        self._lock, self._channels = threading.Lock(), dict[tuple[int, int], str]()

    def on_client_advertise(self, client: Any, channel: Any) -> None:
        message = None
        if channel.topic != POSE_TOPIC:
            message = f"poses must be published on {POSE_TOPIC}: got the topic {short_repr(channel.topic)}"
        elif channel.encoding != "json":
            message = f"poses must be encoded as json: got the encoding {short_repr(channel.encoding)}"
        if message is not None:
            self.warn(message)
            return
        with self._lock:
            self._channels[client.id, channel.id] = channel.topic

    def on_client_unadvertise(self, client: Any, client_channel_id: int) -> None:
        with self._lock:
            self._channels.pop((client.id, client_channel_id), None)

    def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
        if (client.id, client_channel_id) not in self._channels:
            return
        try:
            self.mailbox.put(parse_pose(data))
        except MitsonarError as error:
            self.warn(f"invalid pose: {error}")


def _vector(values: NDArray[np.float64]) -> Vector3:
    x, y, z = (float(value) for value in values)
    return Vector3(x=x, y=y, z=z)


def _quaternion(values: NDArray[np.float64]) -> Quaternion:
    x, y, z, w = (float(value) for value in values)
    return Quaternion(x=x, y=y, z=z, w=w)
