"""The ROS 2 node against modules that have ROS' names and nothing behind them: no ROS is at hand where tests run.

It holds what the node hands to ROS; that ROS takes it, no test here can show.
"""

from __future__ import annotations

import io
import json
import sys
import threading
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mitsonar.bridges.live import LivePing, PoseMailbox
from mitsonar.bridges.ros_node import RosNode
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.records.frames import SonarFrames


class Message:
    """A message: its fields appear when they are asked for."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)

    def __getattr__(self, name: str) -> Any:
        self.__dict__[name] = Message()
        return self.__dict__[name]


class Ros:
    """What the node asks of rclpy, kept."""

    def __init__(self) -> None:
        self.sent: dict[str, list[Any]] = {}
        self.said: list[str] = []
        self.taken: dict[str, Any] = {}
        self.moved: list[Any] = []
        self.down = threading.Event()

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        return SimpleNamespace(publish=self.sent.setdefault(topic, []).append)

    def create_subscription(self, kind: type, topic: str, call: Any, depth: int) -> None:
        self.taken[topic] = call

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=self.said.append)


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Ros:
    result = Ros()

    def module(name: str, **names: Any) -> None:
        one = ModuleType(name)
        one.__dict__.update(names)
        monkeypatch.setitem(sys.modules, name, one)

    module("rclpy", init=lambda args: None, create_node=lambda name: result, spin=lambda node: result.down.wait(20))
    sys.modules["rclpy"].__dict__.update(ok=lambda: True, try_shutdown=result.down.set)
    module("tf2_ros", TransformBroadcaster=lambda node: SimpleNamespace(sendTransform=result.moved.append))
    names = {"geometry": ("PoseStamped", "TransformStamped"), "sensor": ("CompressedImage",), "std": ("String",)}
    for package, kinds in names.items():
        module(f"{package}_msgs")
        module(f"{package}_msgs.msg", **dict.fromkeys(kinds, Message))
    return result


def ping() -> LivePing:
    sonar = Sonar(beams=12, range_bins=30)
    image = np.random.default_rng(1).random((1, 30, 12), np.float32)
    poses = np.array([[1.0, 2, 3, 0, 0, np.pi / 2]])  # along +x: the unit quaternion of ROS
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar, poses)
    return LivePing(frames, 4, 12_000_000_034, "client", "a", 0, 0.01)


def test_a_ping_is_published_with_pose_and_time(ros: Ros) -> None:
    node = RosNode(PoseMailbox())
    assert ros.said == ["marine_acoustic_msgs is not installed: sonar/image is not published"]
    node.publish(ping())
    node.close()
    (pose,) = ros.sent["sonar/pose"]
    assert (pose.header.frame_id, pose.header.stamp.sec, pose.header.stamp.nanosec) == ("world", 12, 34)
    np.testing.assert_allclose([pose.pose.position.x, pose.pose.position.y, pose.pose.position.z], [1, 2, 3])
    turn = pose.pose.orientation
    np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], [0, 0, 0, 1], atol=1e-12)
    assert (ros.moved[0].child_frame_id, ros.moved[0].transform.translation.z) == ("sonar", 3)
    (fan,) = ros.sent["sonar/fan/compressed"]
    assert (Image.open(io.BytesIO(fan.data)).format, fan.format) == ("JPEG", "jpeg")
    assert json.loads(ros.sent["sonar/timing"][0].data)["number"] == 4
    assert "sonar/image" not in ros.sent


def test_a_pose_is_taken_and_a_wrong_one_refused(ros: Ros) -> None:
    mailbox = PoseMailbox()
    node = RosNode(mailbox)
    place, turn = Message(x=1.0, y=2.0, z=3.0), Message(x=0.0, y=0.0, z=0.0, w=1.0)
    ros.taken["pose"](Message(pose=Message(position=place, orientation=turn)))
    taken = mailbox.take(0)
    assert taken is not None
    np.testing.assert_allclose(taken.request.pose, [1, 2, 3, 0, 0, np.pi / 2], atol=1e-12)
    ros.taken["pose"](Message(pose=Message(position=place, orientation=Message(x=0.0, y=0.0, z=0.0, w=0.0))))
    assert mailbox.take(0) is None
    assert ros.said[-1].startswith("invalid pose: the orientation")
    node.close()


def test_without_ros_a_sentence_says_what_to_do() -> None:
    with pytest.raises(MitsonarError, match="comes with ROS 2, not from pip"):
        RosNode(PoseMailbox())
