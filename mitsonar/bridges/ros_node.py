"""How a live sonar becomes a ROS 2 node, with the topics of the Foxglove server; it needs rclpy."""

from __future__ import annotations

import importlib
import json
import threading
from typing import Any

from mitsonar.bridges.live import (
    FanEncoder,
    LivePing,
    PoseMailbox,
    PoseRequest,
    pose_from_ros,
    pose_in_ros,
    projected_image,
    timing,
)
from mitsonar.errors import MitsonarError

__all__ = ["RosNode"]


class RosNode:
    """A ROS 2 node that publishes pings, and puts the poses of the topic ``pose`` into a mailbox.

    ``sonar/image`` is published only if ``marine_acoustic_msgs`` is installed.

    Args:
        mailbox: mailbox for the poses.
        name: name of the node.

    Raises:
        MitsonarError: rclpy or the standard messages are not installed.
    """

    def __init__(self, mailbox: PoseMailbox, name: str = "mitsonar") -> None:
        self._rclpy, messages = _ros("rclpy"), _ros("geometry_msgs.msg")
        self._messages, self._sensor, self._text = messages, _ros("sensor_msgs.msg"), _ros("std_msgs.msg")
        self._mailbox, self._encoder = mailbox, FanEncoder()
        self._rclpy.init(args=[])
        self.node = self._rclpy.create_node(name)
        self._fan = self.node.create_publisher(self._sensor.CompressedImage, "sonar/fan/compressed", 4)
        self._pose = self.node.create_publisher(messages.PoseStamped, "sonar/pose", 4)
        self._timing = self.node.create_publisher(self._text.String, "sonar/timing", 4)
        self._transform = _ros("tf2_ros").TransformBroadcaster(self.node)
        try:
            polar = importlib.import_module("marine_acoustic_msgs.msg").ProjectedSonarImage
        except ModuleNotFoundError:
            self._polar = None
            self.warn("marine_acoustic_msgs is not installed: sonar/image is not published")
        else:
            self._polar = self.node.create_publisher(polar, "sonar/image", 4)
        self.node.create_subscription(messages.PoseStamped, "pose", self._take, 1)
        self._spinning = threading.Thread(target=self._spin, daemon=True)
        self._spinning.start()

    def publish(self, ping: LivePing) -> None:
        """Publish a ping; the polar image is published as serialized bytes, which rclpy accepts instead of a message."""
        frames, time_ns = ping.frames, ping.time_ns
        assert frames.poses is not None
        position, quaternion = pose_in_ros(frames.poses[0])
        pose, transform = self._messages.PoseStamped(), self._messages.TransformStamped()
        fan = self._sensor.CompressedImage()
        for message, frame in ((pose, "world"), (transform, "world"), (fan, "sonar")):
            message.header.frame_id = frame
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(time_ns, 10**9)
        transform.child_frame_id = "sonar"
        for key, value in zip("xyz", position, strict=True):
            setattr(pose.pose.position, key, float(value))
            setattr(transform.transform.translation, key, float(value))
        for key, value in zip("xyzw", quaternion, strict=True):
            setattr(pose.pose.orientation, key, float(value))
            setattr(transform.transform.rotation, key, float(value))
        self._transform.sendTransform(transform)
        self._pose.publish(pose)
        fan.format, fan.data = "jpeg", self._encoder.jpeg(frames)
        self._fan.publish(fan)
        if self._polar is not None:
            self._polar.publish(projected_image(frames, time_ns, "sonar"))
        self._timing.publish(self._text.String(data=json.dumps(timing(ping))))

    def warn(self, message: str) -> None:
        """Log a warning."""
        self.node.get_logger().warning(message)

    def close(self) -> None:
        """Shut the node down."""
        self._rclpy.try_shutdown()
        self._spinning.join(timeout=2)

    def _spin(self) -> None:
        """Process messages until the node is shut down; the main thread handles Ctrl-C."""
        try:
            self._rclpy.spin(self.node)
        except Exception:  # the name of rclpy's ExternalShutdownException depends on the version
            if self._rclpy.ok():
                raise

    def _take(self, message: Any) -> None:
        """Put a received pose into the mailbox, or log why it is invalid."""
        position, orientation = message.pose.position, message.pose.orientation
        try:
            pose = pose_from_ros(
                [position.x, position.y, position.z], [orientation.x, orientation.y, orientation.z, orientation.w]
            )
        except MitsonarError as error:
            self.warn(f"invalid pose: {error}")
            return
        self._mailbox.put(PoseRequest(pose))


def _ros(name: str) -> Any:
    """Import a module of ROS 2.

    Raises:
        MitsonarError: the module is not installed.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise MitsonarError(
            f"--ros needs {error.name}, which comes with ROS 2, not from pip: install ROS 2, type "
            "`source /opt/ros/DISTRO/setup.bash` and use its Python; or leave out --ros and connect Foxglove"
        ) from None
