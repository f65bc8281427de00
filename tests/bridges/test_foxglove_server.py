"""A live sonar with a client that knows the protocol and nothing of the SDK."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers import Command, essence, refused
from PIL import Image

pytest.importorskip("foxglove")
pytest.importorskip("websockets")

from mitsonar.bridges.foxglove import FoxgloveServer
from mitsonar.bridges.live import LivePing, PoseMailbox, live_pings
from mitsonar.bridges.live_client import LiveClient, image_of
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import load_sonar
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory
from mitsonar.plotting.fans import FanPictures
from mitsonar.records.frames import SonarFrames, to_uint8
from mitsonar.simulation.scene import load_scene
from mitsonar.simulation.simulator import Simulator

START = Pose(-3.4, -4.6, 2.2, float(np.radians(25)))
TOPICS = ("/sonar/fan", "/sonar/image", "/sonar/timing")


def small_sonar() -> Sonar:
    return load_sonar("didson300").replace(
        model="physical", range_min=2, range_max=8, quality="draft", range_bins=60, beams=24
    )


def client_of(port: int, topics: Sequence[str], **words: Any) -> LiveClient:
    return LiveClient(f"ws://127.0.0.1:{port}", topics, **words)


class Live(NamedTuple):
    """A server in a thread of the test."""

    port: int
    pings: list[Any]


@pytest.fixture(scope="module")
def simulator(variant: str) -> Simulator:
    """Compiled once."""
    return Simulator(load_scene("objects"), small_sonar())


@pytest.fixture
def live(simulator: Simulator) -> Iterator[Live]:
    mailbox, pings, ends = PoseMailbox(), list[Any](), threading.Event()
    server = FoxgloveServer(mailbox, port=0)
    path = Trajectory(np.array([START]), np.zeros(1))

    def loop() -> None:
        for ping in live_pings(simulator, mailbox, server, path, rate_hz=20.0):
            pings.append(ping)
            if ends.is_set():
                return

    thread = threading.Thread(target=loop)
    thread.start()
    yield Live(server.port, pings)
    ends.set()
    mailbox_pose(mailbox)
    thread.join(timeout=30)
    server.close()
    assert not thread.is_alive()


def mailbox_pose(mailbox: PoseMailbox) -> None:
    from mitsonar.bridges.live import PoseRequest

    mailbox.put(PoseRequest(START))


def ping_of(client: LiveClient, mark: str) -> dict[str, Any]:
    """The messages of the ping that a marked pose asked for, by topic."""
    stored: dict[int, dict[str, bytes]] = {}
    while True:
        message = client.receive()
        stored.setdefault(message.time_ns, {})[message.topic] = message.content
        report = json.loads(stored[message.time_ns].get("/sonar/timing", b"{}"))
        if report.get("id") == mark and len(stored[message.time_ns]) == 3:
            return {**stored[message.time_ns], "/sonar/timing": report}


@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
def test_a_pose_becomes_the_image_that_the_simulator_makes(live: Live) -> None:
    decoder = pytest.importorskip("mcap_ros2.decoder")
    client = client_of(live.port, TOPICS)
    assert client.info["capabilities"] == ["clientPublish"]
    assert client.channels["/sonar/fan"]["schemaName"] == "foxglove.CompressedImage"
    client.publish({"x": -3.4, "y": -4.0, "z": 2.2, "pitch": 25, "heading": 10, "id": "first"})
    got = ping_of(client, "first")
    ping = next(one for one in live.pings if one.request_id == "first")
    np.testing.assert_allclose(ping.frames.poses, [[-3.4, -4.0, 2.2, np.radians(25), 0, np.radians(10)]])
    expected = ping.frames.image[0]
    assert expected.max() > 0.1
    picture = Image.open(io.BytesIO(image_of(got["/sonar/fan"])))
    plain = FanPictures(ping.frames).picture(expected)
    assert (picture.format, picture.size) == ("JPEG", plain.shape[::-1])
    assert np.abs(np.asarray(picture, float) - plain).mean() < 3
    polar = decoded(decoder, client.channels["/sonar/image"], got["/sonar/image"])
    values = np.frombuffer(bytes(polar.image.data), np.uint8).reshape(60, 24)
    np.testing.assert_array_equal(values, to_uint8(expected))
    np.testing.assert_allclose(np.array(polar.ranges), ping.frames.range_m, rtol=1e-6)
    bearing = [np.arctan2(one.y, one.z) for one in polar.beam_directions]
    np.testing.assert_allclose(bearing, ping.frames.bearing_rad, atol=1e-12)
    assert (polar.image.beam_count, polar.image.dtype, polar.header.frame_id) == (24, 0, "sonar")
    assert polar.header.stamp.sec * 10**9 + polar.header.stamp.nanosec == ping.time_ns
    assert got["/sonar/timing"]["source"] == "client"
    assert 0 < got["/sonar/timing"]["render_ms"] <= got["/sonar/timing"]["latency_ms"] < 30_000
    client.close()


def decoded(decoder: Any, channel: dict[str, Any], content: bytes) -> Any:
    """A message as another library reads it by the schema that the server advertises."""
    from mcap.records import Schema

    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    schema = Schema(id=1, name=channel["schemaName"], encoding="ros2msg", data=channel["schema"].encode())
    result = decoder.DecoderFactory().decoder_for("cdr", schema)
    assert result is not None
    return result(content)


@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
def test_bad_poses_are_refused_with_one_sentence_each_and_the_next_is_rendered(live: Live) -> None:
    client = client_of(live.port, TOPICS)
    bad = {
        b"no json": "not JSON",
        b'{"x": "far"}': "x of pose must be a finite number",
        b'{"x": NaN}': "x of pose must be a finite number",
        b'{"x": 1, "id": 1e999}': "id of a pose must be a finite number or a string",  # JSON has no word for it
        b'{"x": 1, "id": NaN}': "id of a pose must be a finite number or a string",
        b'{"yaw": 3}': "has no key 'yaw'",
        b'{"x": 1e9}': "within 1e+06 m of the origin",
        b'{"pose": {"position": {"x": 1}, "orientation": {}}}': "quaternion of length 1",
        b"[1, 2, 3]": "a pose must be a JSON object",
        b"{" * 5000: "",
        b" " * 70_000: "at most 65,536 bytes",
    }
    for content, words in bad.items():
        client.publish(content)
        sentence = client.wait_for_status()
        assert sentence.startswith("invalid pose: "), sentence
        assert words in sentence
    assert len(client.status) == len(bad)
    client.publish({"x": -3.4, "y": -4.6, "z": 2.2, "pitch": 25, "id": "good"})
    assert ping_of(client, "good")["/sonar/timing"]["id"] == "good"
    client.close()


def test_another_topic_or_encoding_is_refused_with_one_sentence(live: Live) -> None:
    for words, expected in (({"pose_topic": "/move"}, "'/move'"), ({"encoding": "ros1"}, "'ros1'")):
        client = client_of(live.port, TOPICS, **words)
        assert expected in client.wait_for_status()
        client.publish({"x": 1})
        client.close()
    time.sleep(0.2)
    assert all(ping.source == "path" for ping in live.pings)


@pytest.mark.filterwarnings("ignore::mitsonar.errors.MitsonarWarning")
def test_poses_of_ros_are_understood(live: Live) -> None:
    """Heading 90 deg to starboard of north is along +x, the zero of ROS' yaw; pitch 25 deg down is a turn about its y."""
    client = client_of(live.port, TOPICS)
    half = np.radians(25) / 2
    turn = {"x": 0.0, "y": np.sin(half), "z": 0.0, "w": np.cos(half)}
    pose = {"position": {"x": -4.0, "y": 1.0, "z": 2.2}, "orientation": turn}
    client.publish({"header": {"frame_id": "world"}, "pose": pose, "id": "ros"})
    message = ping_of(client, "ros")["/sonar/timing"]
    got = [message[key] for key in ("x", "y", "z", "pitch", "roll", "heading")]
    np.testing.assert_allclose(got, [-4, 1, 2.2, 25, 0, 90], atol=1e-9)
    client.close()


@pytest.mark.thorough
def test_a_client_that_no_longer_reads_does_not_keep_the_server() -> None:
    server = FoxgloveServer(PoseMailbox(), port=0)
    client = client_of(server.port, ["/sonar/image"])
    sonar = small_sonar().replace(range_bins=1000, beams=500)
    image = np.zeros((1, sonar.range_bins, sonar.beams), np.float32)
    frames = SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar, np.array([START]))
    for number in range(60):  # half a megabyte each, more than all buffers hold
        server.publish(LivePing(frames, number, number, "path", None, 0, 0.0))
        time.sleep(0.005)
    closing = threading.Thread(target=server.close, daemon=True)
    closing.start()
    closing.join(timeout=3)
    assert not closing.is_alive()
    client._socket.socket.shutdown(socket.SHUT_RDWR)


# ---------------------------------------------------------------- the command

SERVE = ("serve", "objects", "--sonar", "didson300", "--model", "physical", "--quality", "draft", "--set", "range_bins=60")


def started(*words: str) -> tuple[subprocess.Popen[str], int]:
    """The command in a process of its own, and its port."""
    command = [sys.executable, "-m", "mitsonar", *SERVE, "--port", "0", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    assert process.stdout is not None
    line = process.stdout.readline()
    result = re.search(r"ws://127\.0\.0\.1:(\d+)", line)
    assert result, line + (process.communicate(timeout=20)[1] if process.poll() is not None else "")
    return process, int(result[1])


@pytest.mark.thorough
@pytest.mark.posix
@pytest.mark.e2e
@pytest.mark.parametrize("number", essence([signal.SIGINT, signal.SIGTERM], signal.SIGTERM, rest=pytest.mark.slow))
def test_a_path_is_played_and_a_signal_ends_the_server_cleanly(number: signal.Signals) -> None:
    process, port = started("--trajectory", "shipped", "--rate", "20")
    client = client_of(port, ["/sonar/timing"])
    message = [json.loads(client.receive().content) for _ in range(3)]
    assert [one["number"] for one in message] == list(range(message[0]["number"], message[0]["number"] + 3))
    assert {one["source"] for one in message} == {"path"}
    assert [message[0][key] for key in ("x", "y", "heading")] != [message[1][key] for key in ("x", "y", "heading")]
    process.send_signal(number)
    output, complained = process.communicate(timeout=20)
    assert process.returncode == 0, complained
    assert re.search(r"^\d+ pings$", output, re.MULTILINE)
    assert "Traceback" not in complained


@pytest.mark.thorough
@pytest.mark.e2e
def test_faults_of_the_command_are_one_sentence(mitsonar: Command, live: Live) -> None:
    refused(mitsonar(*SERVE, "--port", live.port, "--pings", 1), "cannot listen", "--port")
    with pytest.raises(MitsonarError, match="no live sonar answers"):
        LiveClient("ws://127.0.0.1:9")
    refused(mitsonar(*SERVE, "--rate", 0), "--rate must be positive")
    refused(mitsonar(*SERVE, "--trajectory", "none.tum"), "no trajectory")
    refused(mitsonar(*SERVE, "--ros", "--pings", 1), "--ros needs", "ROS 2")


@pytest.mark.thorough
@pytest.mark.e2e
def test_a_missing_package_names_the_extra(tmp_path: Path) -> None:
    from helpers import run_python

    script = f"""
        import sys
        from mitsonar.cli import main
        sys.stderr = sys.stdout
        sys.argv = ["mitsonar", *{SERVE!r}]
        try:
            main()
        except SystemExit as end:
            assert end.code == 2, end.code
    """
    assert "pip install 'mitsonar[live]'" in run_python(script, block=("foxglove",))


# ---------------------------------------------------------------- the loop


class Recorder:
    """A publisher and a simulator that keep what they were handed."""

    def __init__(self) -> None:
        self.pings: list[Any] = []
        self.said: list[str] = []

    def publish(self, ping: Any) -> None:
        self.pings.append(ping)

    def warn(self, message: str) -> None:
        self.said.append(message)

    def close(self) -> None: ...

    def step(self, pose: Any, **_: Any) -> SonarFrames:
        sonar = small_sonar()
        image = np.zeros((1, sonar.range_bins, sonar.beams), np.float32)
        return SonarFrames(image, sonar.range_m, sonar.bearing_rad, np.zeros(1), sonar, np.array([pose]))


def test_the_newest_pose_wins_and_the_path_goes_on_after_a_pause() -> None:
    both, mailbox = Recorder(), PoseMailbox()
    path = Trajectory(np.array([[k, 0, 2, 0, 0, 0] for k in range(3)], float), np.arange(3.0))
    pings = live_pings(both, mailbox, both, path, rate_hz=50.0, quiet_s=0.2)
    begun = time.monotonic()
    first = [next(pings) for _ in range(5)]
    assert 0.06 < time.monotonic() - begun < 2
    assert [one.frames.poses[0, 0] for one in first if one.frames.poses is not None] == [0, 1, 2, 0, 1]
    from mitsonar.bridges.live import PoseRequest

    for place in (7.0, 8.0, 9.0):
        mailbox.put(PoseRequest(Pose(place, 0, 2), request_id=place))
    arguments = next(pings)
    assert (arguments.request_id, arguments.dropped, arguments.source, arguments.number) == (9.0, 2, "client", 5)
    begun = time.monotonic()
    resumed = next(pings)
    assert time.monotonic() - begun > 0.15
    assert resumed.source == "path"
    assert resumed.frames.poses is not None
    assert resumed.frames.poses[0, 0] == 2
