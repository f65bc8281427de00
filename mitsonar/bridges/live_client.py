"""How a plain Python client talks to a live sonar: it publishes poses and receives messages."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from mitsonar.errors import MitsonarError
from mitsonar.io.files import PlainValue

__all__ = ["LiveClient", "LiveMessage", "image_of"]

PROTOCOL = Subprotocol("foxglove.sdk.v1")
POSE_CHANNEL, MESSAGE_OPCODE = 1, 1


class LiveMessage(NamedTuple):
    """A message received on a channel.

    Attributes:
        topic: topic of the channel.
        time_ns: time of the ping [ns].
        content: bytes of the message, in the encoding of the channel.
    """

    topic: str
    time_ns: int
    content: bytes


class LiveClient:
    """A client that subscribes to topics of ``mitsonar serve`` and publishes poses, over Foxglove's WebSocket protocol.

    In this protocol text frames are JSON, and binary frames are messages.

    Args:
        address: address of the server, such as ``ws://127.0.0.1:8765``.
        topics: topics to subscribe to.
        pose_topic: topic to publish poses on.
        encoding: encoding of the poses; the server reads ``json``.

    Attributes:
        channels: channels as the server advertises them, keyed by topic.
        status: status messages of the server, such as the reason why it refused a pose.
        info: the server's description of itself.

    Raises:
        MitsonarError: no server answers at the address, or it lacks a topic.
    """

    def __init__(
        self,
        address: str,
        topics: Sequence[str] = ("/sonar/fan", "/sonar/timing"),
        *,
        pose_topic: str = "/pose",
        encoding: str = "json",
    ) -> None:
        self.status: list[str] = []
        self.info: dict[str, PlainValue] = {}
        self.channels: dict[str, dict[str, PlainValue]] = {}
        self._exit_stack = contextlib.ExitStack()
        try:
            self._socket = self._exit_stack.enter_context(connect(address, subprotocols=[PROTOCOL], max_size=None))
        except (OSError, WebSocketException) as error:
            raise MitsonarError(f"no live sonar answers at {address} ({error}): start `mitsonar serve`") from None
        deadline = time.monotonic() + 20
        while not (self.info and all(topic in self.channels for topic in topics)):
            try:
                self._process_text(self._socket.recv(timeout=max(0.01, deadline - time.monotonic())))
            except TimeoutError:
                known_topics = ", ".join(self.channels)
                raise MitsonarError(
                    f"{address} lacks one of the topics {', '.join(topics)}: it has {known_topics}"
                ) from None
        self._topics = dict(enumerate(topics))
        subscriptions = [{"id": number, "channelId": self.channels[topic]["id"]} for number, topic in self._topics.items()]
        self._send(op="subscribe", subscriptions=subscriptions)
        self._send(
            op="advertise", channels=[{"id": POSE_CHANNEL, "topic": pose_topic, "encoding": encoding, "schemaName": "pose"}]
        )

    def publish(self, pose: dict[str, Any] | bytes) -> None:
        """Publish a pose: ``{"x": 1, "y": 0, "z": 2, "pitch": 30, "id": 7}``, in m and deg."""
        content = pose if isinstance(pose, bytes) else json.dumps(pose).encode()
        self._socket.send(struct.pack("<BI", MESSAGE_OPCODE, POSE_CHANNEL) + content)

    def receive(self, timeout_s: float = 30.0) -> LiveMessage:
        """Wait for the next message and return it; status messages received meanwhile are added to ``status``.

        Raises:
            TimeoutError: no message arrived in time.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            self._acknowledge()
            frame = self._socket.recv(timeout=max(0.01, deadline - time.monotonic()))
            if isinstance(frame, bytes):
                opcode, subscription, time_ns = struct.unpack_from("<BIQ", frame)
                if opcode == MESSAGE_OPCODE:
                    return LiveMessage(self._topics[subscription], time_ns, frame[13:])
            else:
                self._process_text(frame)

    def wait_for_status(self, timeout_s: float = 10.0) -> str:
        """Wait for the next status message of the server and return it; other messages received meanwhile are lost.

        Raises:
            TimeoutError: no status message arrived in time.
        """
        count, deadline = len(self.status), time.monotonic() + timeout_s
        while len(self.status) == count:
            self._process_text(self._socket.recv(timeout=max(0.01, deadline - time.monotonic())))
        return self.status[count]

    def close(self) -> None:
        """Close the connection."""
        self._exit_stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _acknowledge(self) -> None:
        """Make TCP acknowledge at once; the server delays a small message until the previous one is acknowledged (40 ms)."""
        with contextlib.suppress(AttributeError, OSError):  # the option exists on Linux only
            self._socket.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    def _send(self, **fields: PlainValue) -> None:
        self._socket.send(json.dumps(fields))

    def _process_text(self, frame: str | bytes) -> None:
        """Process a JSON frame of the server; ignore binary messages."""
        if isinstance(frame, bytes):
            return
        table = json.loads(frame)
        if table["op"] == "serverInfo":
            self.info = table
        elif table["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in table["channels"]}
        elif table["op"] == "status":
            self.status.append(table["message"])


def image_of(content: bytes) -> bytes:
    """Return the bytes of the picture in a ``foxglove.CompressedImage``: field 2 of the protobuf message.

    Raises:
        MitsonarError: the message is not of this type.
    """
    offset = 0
    try:
        while offset < len(content):
            key, offset = _varint(content, offset)
            length, offset = _varint(content, offset)
            if key == (2 << 3 | 2):
                return content[offset : offset + length]
            offset += length
    except IndexError:
        pass
    raise MitsonarError("this message is not a foxglove.CompressedImage: subscribe to /sonar/fan")


def _varint(content: bytes, offset: int) -> tuple[int, int]:
    """Return a variable-length integer of protobuf, and the offset of what follows."""
    value = shift = 0
    while True:
        byte = content[offset]
        value |= (byte & 127) << shift
        offset, shift = offset + 1, shift + 7
        if byte < 128:
            return value, offset
